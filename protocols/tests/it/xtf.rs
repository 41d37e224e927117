//! Compares XTF with its published tables and with a file that pyxtf accepts, and parses random bytes.

use crate::support::{assert_same, feed_to_end, le, table};
use echotank_protocols::WireError;
use echotank_protocols::xtf::{
    Attitude, ChannelHeader, ChannelInfo, ChannelKind, FileHeader, NavUnits, Ping, PingHeader,
    SampleFormat, Samples, XtfFraming, XtfStream, emit_ping, packet_type,
};
use proptest::prelude::*;

/// 2025-06-15 15:06:40.123456789 UTC.
const UTC_NS: i64 = 1_750_000_000_123_456_789;

fn channel(kind: ChannelKind, format: SampleFormat, name: &str) -> ChannelInfo {
    ChannelInfo {
        kind,
        format,
        name: name.into(),
        frequency_khz: 430.0,
        horizontal_beam_deg: 0.3,
        tilt_deg: 20.0,
        beam_width_deg: 50.0,
        volt_scale: 5.0,
        offset_m: [0.1, 0.2, 0.3],
        offset_yaw_pitch_roll_deg: [0.4, 0.5, 0.6],
    }
}

fn file(formats: &[SampleFormat]) -> FileHeader {
    FileHeader {
        program: "tank".into(),
        program_version: "1.2".into(),
        sonar_name: "SIMULATED".into(),
        sonar_type: 0,
        note: "made up".into(),
        file_name: "a.xtf".into(),
        nav_units: NavUnits::LatitudeLongitude,
        nav_latency_ms: -7,
        channels: formats
            .iter()
            .enumerate()
            .map(|(i, &format)| {
                let kind = [ChannelKind::Port, ChannelKind::Starboard][i % 2];
                channel(kind, format, "chan")
            })
            .collect(),
    }
}

#[test]
fn the_file_header_matches_tables_c_and_d() {
    let f = |value: f32| value.to_le_bytes();
    let mut fields: Vec<(usize, Vec<u8>)> = vec![
        (0, vec![0x7B, 1]),
        (2, b"tank".to_vec()),
        (10, b"1.2".to_vec()),
        (18, b"SIMULATED".to_vec()),
        (36, b"made up".to_vec()),
        (100, b"a.xtf".to_vec()),
        (164, vec![3, 0]),
        (166, vec![2, 0]),
        (204, (-7_i32).to_le_bytes().to_vec()),
    ];
    for (i, (kind, width, code)) in [(1, 2, 3), (2, 4, 5)].into_iter().enumerate() {
        let at = 256 + 128 * i;
        fields.extend([
            (at, vec![kind, i as u8]),
            (at + 2, vec![1, 0, 1, 0, width, 0]),
            (at + 8, 1024_u32.to_le_bytes().to_vec()),
            (at + 12, b"chan".to_vec()),
            (at + 28, f(5.0).to_vec()),
            (at + 32, f(430.0).to_vec()),
            (at + 36, f(0.3).to_vec()),
            (at + 40, f(20.0).to_vec()),
            (at + 44, f(50.0).to_vec()),
            (at + 48, [f(0.1), f(0.2), f(0.3)].concat()),
            (at + 60, [f(0.4), f(0.5), f(0.6)].concat()),
            (at + 74, vec![code]),
        ]);
    }
    let fields: Vec<(usize, &[u8])> = fields.iter().map(|(at, v)| (*at, &v[..])).collect();
    let golden = table(1024, &fields);
    let header = file(&[SampleFormat::U16, SampleFormat::F32]);
    let mut bytes = Vec::new();
    header.emit(&mut bytes);
    assert_same(&bytes, &golden, "file header");
    assert_eq!(FileHeader::parse(&golden), Ok(header));
}

fn ping_header() -> PingHeader {
    let mut header = PingHeader {
        event_number: 3,
        ping_number: 41,
        sound_velocity_one_way_m_per_s: 750.0,
        ship_speed_kn: 3.5,
        ship_gyro_deg: 359.9,
        ship_y: -36.8,
        ship_x: -121.8,
        sensor_speed_kn: 3.25,
        sensor_y: -36.75,
        sensor_x: -121.75,
        sensor_depth_m: 3.25,
        sensor_altitude_m: 20.5,
        sensor_pitch_deg: 3.0,
        sensor_roll_deg: 5.0,
        sensor_heading_deg: 359.5,
        heave_up_m: -0.25,
        yaw_deg: 0.5,
        ..PingHeader::default()
    };
    header.set_utc_ns(UTC_NS);
    header
}

#[test]
fn a_ping_matches_tables_h_and_i() {
    let f = |value: f32| value.to_le_bytes();
    // 15:06:40.12 rounded; the tags are whole milliseconds of the day.
    let ms = 54_400_123_u32.to_le_bytes();
    let golden = table(
        // 256 + 64 + 3 x 2 + 64 + 2 x 2 = 394, padded to 448.
        448,
        &[
            (0, &[0xCE, 0xFA, 0, 0, 2, 0]),
            (10, &448_u32.to_le_bytes()),
            (14, &2025_u16.to_le_bytes()),
            (16, &[6, 15, 15, 6, 40, 12]),
            (22, &166_u16.to_le_bytes()),
            (24, &le(&[3_u32, 41])),
            (32, &f(750.0)),
            (120, &le(&[3.5_f32, 359.9])),
            (128, &le(&[-36.8_f64, -121.8])),
            (148, &[15, 6, 40, 12]),
            (152, &f(3.25)),
            (160, &le(&[-36.75_f64, -121.75])),
            (192, &le(&[3.25_f32, 20.5])),
            (204, &le(&[3.0_f32, 5.0, 359.5, -0.25, 0.5])),
            (224, &ms),
            (232, &ms),
            // First channel.
            (256, &0_u16.to_le_bytes()),
            (260, &f(75.0)),
            (268, &le(&[0.001_f32, 0.1, 0.2])),
            (280, &le(&[4_u16, 430])),
            (284, &[1, 0, 2, 0, 3, 0]),
            (298, &3_u32.to_le_bytes()),
            (302, &5000_u16.to_le_bytes()),
            (314, &(-2_i16).to_le_bytes()),
            (320, &[0x34, 0x12, 0xFF, 0xFF, 0, 0]),
            // Second channel.
            (326, &1_u16.to_le_bytes()),
            (326 + 42, &2_u32.to_le_bytes()),
            (326 + 64, &[7, 0, 8, 0]),
        ],
    );
    let file = file(&[SampleFormat::U16, SampleFormat::U16]);
    let first = ChannelHeader {
        channel: 0,
        slant_range_m: 75.0,
        time_delay_s: 0.001,
        time_duration_s: 0.1,
        seconds_per_ping: 0.2,
        processing_flags: 4,
        frequency_khz: 430,
        initial_gain_code: 1,
        gain_code: 2,
        bandwidth_khz: 3,
        millivolt_scale: 5000,
        weight: -2,
        ..ChannelHeader::default()
    };
    let second = ChannelHeader {
        channel: 1,
        ..ChannelHeader::default()
    };
    let mut bytes = Vec::new();
    let channels = [
        (first, Samples::U16(&[0x1234, 0xFFFF, 0])),
        (second, Samples::U16(&[7, 8])),
    ];
    let range = emit_ping(&mut bytes, &file, &ping_header(), &channels);
    assert_eq!(range, 0..448);
    assert_same(&bytes, &golden, "ping");
    let ping = Ping::parse(&golden, &file).unwrap();
    assert_eq!(ping.header.utc_ns(), Some(1_750_000_000_120_000_000));
    assert_eq!(
        ping.channels[0].values().collect::<Vec<_>>(),
        [4660.0, 65535.0, 0.0]
    );
    assert_eq!(ping.channels[0].header.weight, -2);
    assert_eq!(ping.channels[1].values().collect::<Vec<_>>(), [7.0, 8.0]);
}

#[test]
fn attitude_matches_table_e() {
    let golden = table(
        64,
        &[
            (0, &[0xCE, 0xFA, 3, 0]),
            (10, &64_u32.to_le_bytes()),
            (22, &le(&[123_456_u32, 1_750_000_000])),
            (30, &le(&[3.0_f32, 5.0, -0.25])),
            (46, &54_400_123_u32.to_le_bytes()),
            (50, &359.9_f32.to_le_bytes()),
            (54, &2025_u16.to_le_bytes()),
            (56, &[6, 15, 15, 6, 40]),
            (61, &123_u16.to_le_bytes()),
        ],
    );
    let attitude = Attitude {
        utc_ns: UTC_NS,
        pitch_deg: 3.0,
        roll_deg: 5.0,
        heave_up_m: -0.25,
        heading_deg: 359.9,
    };
    let mut bytes = Vec::new();
    attitude.emit(&mut bytes);
    assert_same(&bytes, &golden, "attitude");
    let read = Attitude::parse(&golden).unwrap();
    assert_eq!(read.utc_ns, UTC_NS / 1000 * 1000);
    assert_eq!(
        Attitude {
            utc_ns: UTC_NS,
            ..read
        },
        attitude
    );
}

/// Five pings of two channels, which pyxtf can read.
#[test]
fn a_file_that_another_reader_accepts_parses() {
    let bytes =
        std::fs::read(concat!(env!("CARGO_MANIFEST_DIR"), "/tests/data/proto.xtf")).unwrap();
    let header = FileHeader::parse(&bytes).unwrap();
    assert_eq!(header.channels.len(), 2);
    assert_eq!(header.nav_units, NavUnits::LatitudeLongitude);
    let mut stream = XtfStream::new(XtfFraming::default());
    let mut pings = 0;
    stream.feed(&bytes[FileHeader::SIZE_BYTES..], |packet| {
        let ping = Ping::parse(packet.unwrap(), &header).unwrap();
        assert_eq!(ping.header.start.packet_type, packet_type::SONAR);
        assert_eq!(ping.channels.len(), 2);
        assert!(ping.channels[0].values().len() > 100);
        pings += 1;
    });
    assert_eq!((pings, stream.skipped_bytes()), (5, 0));
}

#[test]
fn truncated_and_oversized_data_are_refused() {
    let truncated = |error: Option<WireError>| {
        assert!(
            matches!(error, Some(WireError::Truncated { .. })),
            "{error:?}"
        );
    };
    truncated(FileHeader::parse(&[0x7B; 1023]).err());
    let file = file(&[SampleFormat::U32]);
    let mut bytes = Vec::new();
    let channels = [(ChannelHeader::default(), Samples::U32(&[1, 2, 3]))];
    emit_ping(&mut bytes, &file, &ping_header(), &channels);
    truncated(Ping::parse(&bytes[..bytes.len() - 1], &file).err());
    let mut huge = bytes.clone();
    huge[256 + 42..256 + 46].fill(0xFF);
    truncated(Ping::parse(&huge, &file).err());
    let mut many = bytes.clone();
    many[4] = 2;
    assert!(matches!(
        Ping::parse(&many, &file),
        Err(WireError::Unsupported { got: 2, .. })
    ));
    let mut long = bytes.clone();
    long[13] = 0xFF;
    assert!(matches!(
        Ping::parse(&long, &file),
        Err(WireError::Oversized { .. })
    ));
    truncated(Attitude::parse(&[0xCE, 0xFA, 3]).err());
}

proptest! {
    #[test]
    fn no_bytes_make_a_parser_panic(
        mut bytes in proptest::collection::vec(any::<u8>(), 0..1500),
        spoil in proptest::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 0..4),
    ) {
        let file = file(&[SampleFormat::U8, SampleFormat::U16, SampleFormat::U32, SampleFormat::F32]);
        let _ = FileHeader::parse(&bytes);
        if let Some(first) = bytes.first_mut() { *first = 0x7B; }
        if let Ok(header) = FileHeader::parse(&bytes) {
            let mut again = Vec::new();
            header.emit(&mut again);
            let read = FileHeader::parse(&again).unwrap();
            prop_assert_eq!(read.channels.len(), header.channels.len());
        }
        let mut good = Vec::new();
        let channels = [
            (ChannelHeader::default(), Samples::U8(&[1, 2, 3])),
            (ChannelHeader::default(), Samples::U16(&[1, 2])),
            (ChannelHeader::default(), Samples::U32(&[1])),
            (ChannelHeader::default(), Samples::F32(&[])),
        ];
        emit_ping(&mut good, &file, &PingHeader::default(), &channels);
        Attitude { utc_ns: 5, pitch_deg: 0.0, roll_deg: 0.0, heave_up_m: 0.0, heading_deg: 0.0 }.emit(&mut good);
        for (at, value) in spoil {
            let at = at.index(good.len());
            good[at] = value;
        }
        for bytes in [&bytes, &good] {
            feed_to_end(XtfFraming { max_packet_bytes: 4096 }, bytes, usize::MAX, |packet| {
                if let Ok(packet) = packet {
                    if let Ok(ping) = Ping::parse(packet, &file) {
                        let _ = ping.header.utc_ns();
                        assert!(ping.channels.iter().map(|c| c.values().len()).sum::<usize>() <= packet.len());
                    }
                    let _ = Attitude::parse(packet);
                }
            });
        }
    }

    #[test]
    fn samples_of_every_format_round_trip(u8s in any::<Vec<u8>>(), u16s in any::<Vec<u16>>(), u32s in any::<Vec<u32>>()) {
        let floats: Vec<f32> = u16s.iter().map(|&v| f32::from(v) / 7.0).collect();
        let file = file(&[SampleFormat::U8, SampleFormat::U16, SampleFormat::U32, SampleFormat::F32]);
        let all = [Samples::U8(&u8s), Samples::U16(&u16s), Samples::U32(&u32s), Samples::F32(&floats)];
        let mut bytes = vec![1, 2, 3];
        let range = emit_ping(&mut bytes, &file, &PingHeader::default(), &all.map(|s| (ChannelHeader::default(), s)));
        prop_assert_eq!(range.len() % 64, 0);
        let ping = Ping::parse(&bytes[range], &file).unwrap();
        let got: Vec<Vec<f64>> = ping.channels.iter().map(|c| c.values().collect()).collect();
        prop_assert_eq!(&got[0], &u8s.iter().map(|&v| v.into()).collect::<Vec<f64>>());
        prop_assert_eq!(&got[1], &u16s.iter().map(|&v| v.into()).collect::<Vec<f64>>());
        prop_assert_eq!(&got[2], &u32s.iter().map(|&v| v.into()).collect::<Vec<f64>>());
        prop_assert_eq!(&got[3], &floats.iter().map(|&v| v.into()).collect::<Vec<f64>>());
    }

    #[test]
    fn times_round_trip_to_five_milliseconds(utc_ns in 0..4_102_444_800_000_000_000_i64) {
        let mut header = PingHeader::default();
        header.set_utc_ns(utc_ns);
        prop_assert!((header.utc_ns().unwrap() - utc_ns).abs() <= 5_000_000);
    }
}
