//! Frames that an Omniscan 450 and a Surveyor 240 send, and frames that their clients send, in sequence.

use std::path::Path;

use echotank_protocols::ping_protocol::common::{
    AckMessage, DeviceInformation, ProtocolVersion, emit_nack,
};
use echotank_protocols::ping_protocol::omniscan450::{
    OsMonoProfileHead, OsPingParams, SetSpeedOfSound, emit_2198,
};
use echotank_protocols::ping_protocol::surveyor240::{
    AtofHead, AtofPoint, AttitudeReport, SetPingParameters, WaterStats, YzHead, emit_3011,
    emit_3012,
};

use super::*;

pub(crate) fn write(folder: &Path) -> std::io::Result<()> {
    let mut file = Vec::new();
    DeviceInformation {
        device_type: 0,
        device_revision: 1,
        firmware: [1, 2, 3],
    }
    .emit_frame(&mut file, 1, 0);
    ProtocolVersion { version: [1, 0, 0] }.emit_frame(&mut file, 1, 0);
    AckMessage { acked_id: 116 }.emit_frame(&mut file, 1, 0);
    emit_nack(&mut file, 1, 0, 2197, "out of range");
    OsPingParams {
        start_mm: 1000,
        length_mm: 50_000,
        msec_per_ping: 20,
        pulse_len_percent: 0.002,
        filter_duration_percent: 0.0015,
        gain_index: -1,
        num_results: 1200,
        enable: 1,
    }
    .emit_frame(&mut file, 0, 1);
    SetSpeedOfSound {
        speed_of_sound_mm_per_s: 1_500_000,
    }
    .emit_frame(&mut file, 0, 1);
    SetPingParameters {
        start_mm: 500,
        end_mm: 30_000,
        sos_mps: SOUND_SPEED_M_PER_S,
        gain_index: -1,
        msec_per_ping: 100,
        diagnostic_injected_signal: 0,
        ping_enable: 1,
        enable_channel_data: 0,
        reserved_for_raw_data: 0,
        enable_yz_point_data: 1,
        enable_atof_data: 1,
        target_ping_hz: 240_000,
        n_range_steps: 400,
        pulse_len_steps: 1.5,
    }
    .emit_frame(&mut file, 0, 1);
    WaterStats {
        temperature_c: 12.5,
        pressure_bar: 1.25,
    }
    .emit_frame(&mut file, 1, 0);
    for p in 0..3_u32 {
        let head = OsMonoProfileHead {
            ping_number: p,
            length_mm: 50_000,
            timestamp_ms: 100 * p,
            ping_hz: 450_000,
            sos_dmps: 15_000,
            channel_number: 1,
            pulse_duration_s: 1e-4,
            max_pwr_db: 90.0,
            min_pwr_db: 10.0,
            vehicle_heading_deg: HEADING_DEG as f32,
            ..OsMonoProfileHead::default()
        };
        let line: Vec<u16> = (0..1200)
            .map(|k| (i32::from(count(p.into(), 0, k)) + 20_000) as u16)
            .collect();
        emit_2198(&mut file, 1, 0, &head, &line);
        let utc_msec = UTC_NS as u64 / 1_000_000 + 100 * u64::from(p);
        AttitudeReport {
            up: AttitudeReport::up_from(
                ROLL_PORT_UP_DEG.to_radians(),
                PITCH_BOW_UP_DEG.to_radians(),
            ),
            utc_msec,
            pwr_up_msec: 100 * p,
        }
        .emit_frame(&mut file, 1, 0);
        let points: Vec<AtofPoint> = (0..200)
            .map(|k| AtofPoint {
                angle_rad: f32::from(count(p.into(), 1, k)) / 32_768.0,
                two_way_time_s: (i32::from(count(p.into(), 2, k)) + 20_000) as f32 / 1_048_576.0,
            })
            .collect();
        let head = AtofHead {
            pwr_up_msec: 100 * p,
            utc_msec,
            listening_s: 0.04,
            sos_mps: SOUND_SPEED_M_PER_S,
            ping_number: p,
            ping_hz: 240_000,
            pulse_s: 1e-4,
            ..AtofHead::default()
        };
        emit_3012(&mut file, 1, 0, &head, &points);
        let yz: Vec<[f32; 2]> = (0..100)
            .map(|k| [count(p.into(), 3, 2 * k), count(p.into(), 3, 2 * k + 1)].map(f32::from))
            .collect();
        let head = YzHead {
            ping_number: p,
            sos_mps: SOUND_SPEED_M_PER_S,
            water_c: 12.5,
            water_bar: -1000.0,
            ..YzHead::default()
        };
        emit_3011(&mut file, 1, 0, &head, &yz);
    }
    std::fs::write(folder.join("sample.ping"), file)
}
