//! Three pings of three channels: u16, f32 and u8, with attitude packets between them.

use std::path::Path;

use echotank_protocols::xtf::{
    Attitude, ChannelHeader, ChannelInfo, ChannelKind, FileHeader, NavUnits, PingHeader,
    SampleFormat, Samples, emit_ping,
};

use super::*;

const SAMPLES: u64 = 500;

pub(crate) fn write(folder: &Path) -> std::io::Result<()> {
    let channel = |kind, format, name: &str| ChannelInfo {
        kind,
        format,
        name: name.into(),
        frequency_khz: 430.0,
        horizontal_beam_deg: 0.3,
        tilt_deg: 20.0,
        beam_width_deg: 50.0,
        volt_scale: 5.0,
        offset_m: [0.0; 3],
        offset_yaw_pitch_roll_deg: [0.0; 3],
    };
    let header = FileHeader {
        program: "tank".into(),
        program_version: "1".into(),
        sonar_name: "SIMULATED".into(),
        sonar_type: 0,
        note: String::new(),
        file_name: "sample.xtf".into(),
        nav_units: NavUnits::LatitudeLongitude,
        nav_latency_ms: 0,
        channels: vec![
            channel(ChannelKind::Port, SampleFormat::U16, "Port 430"),
            channel(ChannelKind::Starboard, SampleFormat::F32, "Stbd 430"),
            channel(ChannelKind::Port, SampleFormat::U8, "Port 8 bit"),
        ],
    };
    let mut file = Vec::new();
    header.emit(&mut file);
    for p in 0..3_u32 {
        let utc_ns = UTC_NS + i64::from(p) * 100_000_000;
        Attitude {
            utc_ns,
            pitch_deg: PITCH_BOW_UP_DEG as f32,
            roll_deg: ROLL_PORT_UP_DEG as f32,
            heave_up_m: 0.25,
            heading_deg: HEADING_DEG as f32,
        }
        .emit(&mut file);
        let mut ping = PingHeader {
            ping_number: p,
            sound_velocity_one_way_m_per_s: SOUND_SPEED_M_PER_S / 2.0,
            ship_y: LATITUDE_DEG,
            ship_x: LONGITUDE_DEG,
            sensor_y: LATITUDE_DEG,
            sensor_x: LONGITUDE_DEG,
            sensor_pitch_deg: PITCH_BOW_UP_DEG as f32,
            sensor_roll_deg: ROLL_PORT_UP_DEG as f32,
            sensor_heading_deg: HEADING_DEG as f32,
            sensor_altitude_m: 20.0,
            heave_up_m: 0.25,
            ..PingHeader::default()
        };
        ping.set_utc_ns(utc_ns);
        let count = |c: u64, k| i32::from(count(p.into(), c, k)) + 20_000;
        let port: Vec<u16> = (0..SAMPLES).map(|k| count(0, k) as u16).collect();
        let starboard: Vec<f32> = (0..SAMPLES).map(|k| count(1, k) as f32 / 512.0).collect();
        let bytes: Vec<u8> = (0..SAMPLES).map(|k| (count(2, k) % 256) as u8).collect();
        let channel = |channel| ChannelHeader {
            channel,
            slant_range_m: 37.5,
            time_duration_s: 0.05,
            seconds_per_ping: 0.1,
            frequency_khz: 430,
            ..ChannelHeader::default()
        };
        emit_ping(
            &mut file,
            &header,
            &ping,
            &[
                (channel(0), Samples::U16(&port)),
                (channel(1), Samples::F32(&starboard)),
                (channel(2), Samples::U8(&bytes)),
            ],
        );
    }
    std::fs::write(folder.join("sample.xtf"), file)
}
