//! Bathymetry and water column of a flat bottom 20 m below a WBMS, 20 pings, as its streams contain them.

use std::path::Path;

use echotank_protocols::wbms::{
    BackscatterHead, BathymetryHead, Detection, Tail, emit_backscatter, emit_bathymetry,
};

use super::*;

const BEAMS: usize = 256;
const DEPTH_M: f64 = 20.0;
const SAMPLE_RATE_HZ: f64 = 78_125.0;
const SWATH_DEG: f64 = 120.0;
const SAMPLES: usize = 400;

pub(crate) fn write(folder: &Path) -> std::io::Result<()> {
    let (mut bathymetry, mut water_column, mut side_scan) = (Vec::new(), Vec::new(), Vec::new());
    let angles: Vec<f32> = (0..BEAMS)
        .map(|beam| {
            let part = beam as f64 / (BEAMS - 1) as f64 - 0.5;
            (part * SWATH_DEG.to_radians()) as f32
        })
        .collect();
    let c = f64::from(SOUND_SPEED_M_PER_S);
    for p in 0..20_u32 {
        let time_s = UTC_NS as f64 * 1e-9 + 0.1 * f64::from(p);
        let head = BathymetryHead {
            sound_velocity_m_per_s: SOUND_SPEED_M_PER_S,
            sample_rate_hz: SAMPLE_RATE_HZ as f32,
            ping_number: p + 1,
            time_s,
            time_net_s: time_s,
            ping_rate_hz: 10.0,
            beam_distribution: 2,
            sonar_mode: 1,
            multiping: 1,
            gain: 1.0,
            tx_frequency_hz: 400e3,
            tx_bandwidth_hz: 80e3,
            tx_length_s: 5e-4,
            sound_velocity_raw_m_per_s: SOUND_SPEED_M_PER_S,
            tx_voltage: f32::NAN,
            swath_opening_rad: SWATH_DEG.to_radians() as f32,
            ..BathymetryHead::default()
        };
        let detections: Vec<Detection> = angles
            .iter()
            .map(|&angle_rad| {
                let range_m = DEPTH_M / f64::from(angle_rad).cos();
                Detection {
                    sample_number: (range_m * 2.0 * SAMPLE_RATE_HZ / c).round() as u32,
                    angle_rad,
                    intensity: 1000.0,
                    flags: 1,
                    quality_flags: 3,
                    quality: 255,
                    ..Detection::default()
                }
            })
            .collect();
        emit_bathymetry(&mut bathymetry, &head, &detections);
        let head = BackscatterHead {
            sound_velocity_m_per_s: SOUND_SPEED_M_PER_S,
            sample_rate_hz: SAMPLE_RATE_HZ as f32,
            time_s,
            time_net_s: time_s,
            gain: 1.0,
            swath_opening_rad: SWATH_DEG.to_radians() as f32,
            tx_frequency_hz: 400e3,
            ping_rate_hz: 10.0,
            ping_number: p + 1,
            beams_of_former: BEAMS as u32,
            ..BackscatterHead::default()
        };
        let numbers = |beams: usize| -> Vec<i16> {
            (0..SAMPLES)
                .flat_map(|k| (0..beams).map(move |c| count(p.into(), c as u64, k as u64)))
                .collect()
        };
        let tail = Tail::WaterColumn {
            angles_rad: &angles,
        };
        emit_backscatter(&mut water_column, &head, &numbers(BEAMS), tail);
        emit_backscatter(&mut side_scan, &head, &numbers(2), Tail::SideScan);
    }
    std::fs::write(folder.join("sample_bathymetry.wbms"), bathymetry)?;
    std::fs::write(folder.join("sample_water_column.wbms"), water_column)?;
    std::fs::write(folder.join("sample_side_scan.wbms"), side_scan)
}
