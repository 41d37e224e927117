//! Three pings of messages 80 in formats 0, 1 and 9, with sensor messages between them.

use std::path::Path;

use echotank_protocols::jsf::sensors::SensorTime;
use echotank_protocols::jsf::{
    DataFormat, Dvl2080, FileTime426, Nmea2002, PitchRoll2020, Pressure2060, Situation2091,
    SonarDataHeader, SystemInformation182, block_float, emit_80, subsystem,
};

use super::*;

const SAMPLES: usize = 500;

pub(crate) fn write(folder: &Path) -> std::io::Result<()> {
    let mut file = Vec::new();
    let time = SensorTime::from_utc_ns(UTC_NS);
    FileTime426 { time }.emit_message(&mut file);
    SystemInformation182 {
        system_type: 4,
        subsystems: 3,
        serial_ports: 1,
        serial_number: 77_001,
        ..SystemInformation182::default()
    }
    .emit_message(&mut file);
    for ping in 0..3_u32 {
        let utc_ns = UTC_NS + i64::from(ping) * 100_000_000;
        let time = SensorTime::from_utc_ns(utc_ns);
        PitchRoll2020 {
            time,
            pitch: (PITCH_BOW_UP_DEG / 180.0 * 32_768.0).round() as i16,
            roll: (ROLL_PORT_UP_DEG / 180.0 * 32_768.0).round() as i16,
            heave_down_mm: -250,
            heading_cdeg: 35_990,
            validity: 1 << 6 | 1 << 7 | 1 << 8 | 1 << 9,
            ..PitchRoll2020::default()
        }
        .emit_message(&mut file, 0);
        Pressure2060 {
            time,
            pressure_mpsi: 14_696,
            sound_velocity_mm_per_s: 1_500_000,
            validity: 1 | 1 << 4,
            ..Pressure2060::default()
        }
        .emit_message(&mut file, 0);
        Nmea2002 {
            time,
            source: 1,
            sentence: b"$GPHDT,359.90,T*0F",
        }
        .emit_message(&mut file, 0);
        Dvl2080::default().emit_message(&mut file, 0);
        Situation2091::default().emit_message(&mut file, 0);
        for (subsystem, format) in [
            (subsystem::SIDE_SCAN_LOW, DataFormat::Envelope),
            (subsystem::SIDE_SCAN_HIGH, DataFormat::Analytic),
            (subsystem::BATHYMETRY_LOW, DataFormat::AnalyticUnfiltered),
        ] {
            for channel in 0..2_u8 {
                let shorts = SAMPLES * format.shorts_per_sample();
                // Fractions of a volt that block floating point represents exactly.
                let volts: Vec<f32> = (0..shorts)
                    .map(|k| f32::from(count(ping.into(), channel.into(), k as u64)) / 512.0)
                    .collect();
                let mut data = Vec::new();
                let scaled = block_float::quantise(&volts, &mut data);
                let mut header = SonarDataHeader {
                    ping_number: ping + 1,
                    data_format: format.code(),
                    weighting: scaled.weighting,
                    adc_largest: scaled.largest,
                    sample_interval_ns: 20_000,
                    sample_frequency_hz: 50_000,
                    ..SonarDataHeader::default()
                };
                header.set_samples(SAMPLES);
                header.set_utc_ns(utc_ns);
                header.set_frequencies_hz(420e3, 440e3);
                header.set_sweep_length_s(2.5e-3);
                header.set_position_rad(LATITUDE_DEG.to_radians(), LONGITUDE_DEG.to_radians());
                header.set_heading_rad(HEADING_DEG.to_radians());
                header.set_pitch_roll_rad(
                    PITCH_BOW_UP_DEG.to_radians(),
                    ROLL_PORT_UP_DEG.to_radians(),
                );
                header.set_altitude_m(20.0);
                header.set_sound_speed_m_per_s(SOUND_SPEED_M_PER_S);
                emit_80(&mut file, subsystem, channel, &header, &data);
            }
        }
    }
    std::fs::write(folder.join("sample.jsf"), file)
}
