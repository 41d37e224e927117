//! Compares JSF with its published tables and with a file that third-party readers accept, and parses random bytes.

use crate::support::{assert_same, bytes_of, feed_to_end, le, table};
use echotank_protocols::WireError;
use echotank_protocols::jsf::control::{Control, Value, error_code, is_command};
use echotank_protocols::jsf::sensors::SensorTime;
use echotank_protocols::jsf::sonar_data::{DataFormat, SonarDataHeader, validity};
use echotank_protocols::jsf::{
    Dvl2080, FileTime426, JsfFraming, JsfStream, Message, MessageHeader, Nmea2002, PitchRoll2020,
    Pressure2060, Situation2091, SonarData80, SystemInformation182, block_float, command_type,
    describe, emit_80, emit_message, message_type, subsystem,
};
use proptest::prelude::*;

/// 2025-06-15 15:06:40.123 UTC.
const UTC_NS: i64 = 1_750_000_000_123_000_000;

fn ping() -> SonarDataHeader {
    let mut header = SonarDataHeader {
        ping_number: 7,
        data_format: DataFormat::AnalyticUnfiltered.code(),
        sample_interval_ns: 29_000,
        sample_frequency_hz: 34_483,
        weighting: 12,
        adc_largest: 32_000,
        software_version: *b"1.2.3\0",
        ..SonarDataHeader::default()
    };
    header.set_samples(70_000);
    header.set_utc_ns(UTC_NS);
    header.set_frequencies_hz(420e3, 860e3);
    header.set_sweep_length_s(12.345e-3);
    header.set_position_rad((-36.8_f64).to_radians(), (-121.8_f64).to_radians());
    header.set_heading_rad(359.9_f64.to_radians());
    header.set_pitch_roll_rad(3_f64.to_radians(), 5_f64.to_radians());
    header.set_altitude_m(20.5);
    header.set_depth_m(3.25);
    header.set_sound_speed_m_per_s(1500.0);
    header.set_course_rad(123.45_f64.to_radians());
    header.set_speed_m_per_s(3.21 * 1852.0 / 3600.0);
    header
}

#[test]
fn message_80_matches_tables_2_1_to_2_9() {
    let i16s = |values: &[i16]| le(values);
    let valid: u16 = 1 << 13 | 1 | 2 | 4 | 8 | 32 | 64 | 512 | 1 << 14;
    let golden = table(
        240,
        &[
            (0, &1_750_000_000_i32.to_le_bytes()),
            (8, &7_u32.to_le_bytes()),
            // 70 000 samples = 0x1_1170; 42 000 daHz fits 16 bits, 86 000 daHz = 0x1_4FF0.
            (16, &0x0110_u16.to_le_bytes()),
            (18, &(45_u16 << 8).to_le_bytes()),
            // 1/100 knot, and 345 us.
            (20, &(345_u16 << 4 | 1).to_le_bytes()),
            (28, &i16s(&[1])),
            (30, &valid.to_le_bytes()),
            (34, &i16s(&[9])),
            (80, &le(&[-73_080_000_i32, -22_080_000])),
            (88, &i16s(&[2])),
            (114, &0x1170_u16.to_le_bytes()),
            (116, &29_000_u32.to_le_bytes()),
            (126, &le(&[42_000_u16, 0x4FF0, 12])),
            (136, &3_250_i32.to_le_bytes()),
            (140, &34_483_u16.to_le_bytes()),
            (144, &20_500_i32.to_le_bytes()),
            (148, &1500_f32.to_le_bytes()),
            (156, &i16s(&[2025, 166, 15, 6, 40, 3])),
            (168, &i16s(&[12, 1])),
            (172, &35_990_u16.to_le_bytes()),
            // 3 and 5 degrees / 180 x 32768 = 546.1 and 910.2.
            (174, &i16s(&[546, 910])),
            (186, &i16s(&[15, 6, 40, 123, 32, 166, 2025])),
            (200, &54_400_123_u32.to_le_bytes()),
            (204, &32_000_u16.to_le_bytes()),
            (210, b"1.2.3"),
            (216, &(-1_i32).to_le_bytes()),
            (220, &1_u16.to_le_bytes()),
            (222, &i16s(&[100])),
        ],
    );
    let bytes = bytes_of(|buf| ping().emit(buf));
    assert_same(&bytes, &golden, "message 80");
    let read = SonarDataHeader::parse(&golden).unwrap();
    assert_eq!(read, ping());
    assert_eq!(read.samples(), 70_000);
    assert_eq!(read.frequencies_hz(), (420e3, 860e3));
    assert_eq!(read.utc_ns(), UTC_NS);
    let near = |got: f64, want: f64, tolerance: f64| {
        assert!((got - want).abs() <= tolerance, "{got} for {want}");
    };
    near(read.sweep_length_s(), 12.345e-3, 1e-12);
    let (latitude, longitude) = read.position_rad().unwrap();
    near(latitude.to_degrees(), -36.8, 1e-6);
    near(longitude.to_degrees(), -121.8, 1e-6);
    near(read.heading_rad().unwrap().to_degrees(), 359.9, 0.005);
    let (pitch, roll) = read.pitch_roll_rad().unwrap();
    // Half a step of 180/32768 degrees.
    near(pitch.to_degrees(), 3.0, 0.0028);
    near(roll.to_degrees(), 5.0, 0.0028);
    near(read.course_rad().unwrap().to_degrees(), 123.45, 1e-9);
    near(read.speed_m_per_s().unwrap() / 1852.0 * 3600.0, 3.21, 1e-9);
    near(read.altitude_m().unwrap(), 20.5, 1e-9);
    near(read.depth_m().unwrap(), 3.25, 1e-9);
}

#[test]
fn the_header_of_a_message_matches_section_2_1() {
    let mut buf = vec![0xAA; 3];
    let header = MessageHeader {
        session: 4,
        sequence: 9,
        ..MessageHeader::data(2020, 101, 2)
    };
    let range = emit_message(&mut buf, &header, |buf| buf.extend([1, 2, 3]));
    assert_eq!(range, 3..22);
    let golden = table(
        19,
        &[
            (0, &[0x01, 0x16, 0x0D, 4]),
            (4, &2020_u16.to_le_bytes()),
            (6, &[2, 101, 2, 9]),
            (12, &3_i32.to_le_bytes()),
            (16, &[1, 2, 3]),
        ],
    );
    assert_same(&buf[range], &golden, "header");
}

#[test]
fn sensor_messages_match_their_tables() {
    let time = SensorTime::from_utc_ns(UTC_NS);
    let (s, ms) = (1_750_000_000_i32.to_le_bytes(), 123_i32.to_le_bytes());

    let attitude = PitchRoll2020 {
        time,
        acceleration: [1, -2, 3],
        rate: [-4, 5, -6],
        pitch: 546,
        roll: -910,
        temperature_dc: 123,
        device_info: 0xBEEF,
        heave_down_mm: -250,
        heading_cdeg: 35_990,
        validity: 0x17FF,
        yaw_cdeg: 1234,
    };
    let golden = table(
        44,
        &[
            (0, &s),
            (4, &ms),
            (12, &le(&[1_i16, -2, 3, -4, 5, -6, 546, -910, 123])),
            (30, &0xBEEF_u16.to_le_bytes()),
            (32, &(-250_i16).to_le_bytes()),
            (34, &35_990_u16.to_le_bytes()),
            (36, &0x17FF_i32.to_le_bytes()),
            (40, &1234_i16.to_le_bytes()),
        ],
    );
    assert_same(&bytes_of(|b| attitude.emit(b)), &golden, "2020");
    assert_eq!(PitchRoll2020::parse(&golden), Ok(attitude));

    let pressure = Pressure2060 {
        time,
        pressure_mpsi: 14_696,
        temperature_mc: 12_345,
        salinity_ppm: 35_000,
        validity: 0x3F,
        conductivity_us_per_cm: 42_000,
        sound_velocity_mm_per_s: 1_500_123,
        depth_m: 17,
    };
    let golden = table(
        76,
        &[
            (0, &s),
            (4, &ms),
            (
                12,
                &le(&[14_696_i32, 12_345, 35_000, 0x3F, 42_000, 1_500_123, 17]),
            ),
        ],
    );
    assert_same(&bytes_of(|b| pressure.emit(b)), &golden, "2060");
    assert_eq!(Pressure2060::parse(&golden), Ok(pressure));

    let dvl = Dvl2080 {
        time,
        validity: 0x1FFF,
        distance_cm: [2000, 2001, 2002, 2003],
        velocity_mm_per_s: [-100, 1500, 20],
        water_velocity_mm_per_s: [-101, 1501, 21],
        depth_dm: 33,
        pitch_cdeg: 300,
        roll_cdeg: -500,
        heading_cdeg: 35_990,
        salinity_ppt: 35,
        temperature_cc: 1234,
        sound_velocity_m_per_s: 1500,
    };
    let golden = table(
        72,
        &[
            (0, &s),
            (4, &ms),
            (12, &0x1FFF_u32.to_le_bytes()),
            (16, &le(&[2000_i32, 2001, 2002, 2003])),
            (32, &le(&[-100_i16, 1500, 20, -101, 1501, 21])),
            (44, &33_u16.to_le_bytes()),
            (46, &le(&[300_i16, -500])),
            (50, &le(&[35_990_u16, 35])),
            (54, &le(&[1234_i16, 1500])),
        ],
    );
    assert_same(&bytes_of(|b| dvl.emit(b)), &golden, "2080");
    assert_eq!(Dvl2080::parse(&golden), Ok(dvl));

    let situation = Situation2091 {
        time,
        validity: 0x1FFF,
        velocity_axes: 1,
        source_time_100ns: 17_500_000_001_230_000,
        latitude_deg: -36.8,
        longitude_deg: -121.8,
        depth_m: 3.25,
        altitude_m: 20.5,
        heave_down_m: -0.25,
        velocity_1_m_per_s: 1.5,
        velocity_2_m_per_s: -0.1,
        velocity_down_m_per_s: 0.02,
        pitch_deg: 3.0,
        roll_deg: 5.0,
        heading_deg: 359.9,
        sound_speed_m_per_s: 1500.0,
        water_temperature_c: 12.34,
    };
    let golden = table(
        100,
        &[
            (0, &s),
            (4, &ms),
            (12, &0x1FFF_u32.to_le_bytes()),
            (16, &[1]),
            (20, &17_500_000_001_230_000_u64.to_le_bytes()),
            (28, &le(&[-36.8_f64, -121.8])),
            (
                44,
                &le(&[
                    3.25_f32, 20.5, -0.25, 1.5, -0.1, 0.02, 3.0, 5.0, 359.9, 1500.0, 12.34,
                ]),
            ),
        ],
    );
    assert_same(&bytes_of(|b| situation.emit(b)), &golden, "2091");
    assert_eq!(Situation2091::parse(&golden), Ok(situation));

    let system = SystemInformation182 {
        system_type: 4,
        low_rate_io: 0,
        software_version: 1,
        subsystems: 2,
        serial_ports: 3,
        serial_number: 77,
    };
    let golden: Vec<u8> = [4, 0, 1, 2, 3, 77_i32]
        .iter()
        .flat_map(|v| v.to_le_bytes())
        .collect();
    assert_same(&bytes_of(|b| system.emit(b)), &golden, "182");
    assert_eq!(
        SystemInformation182::parse(&[&golden[..], &[1; 50]].concat()),
        Ok(system)
    );

    let mut file_time = Vec::new();
    let range = FileTime426 { time }.emit_message(&mut file_time);
    assert_same(&file_time[range][16..], &[s, ms].concat(), "426");
    assert_eq!(time.to_utc_ns(), UTC_NS);

    let nmea = Nmea2002 {
        time,
        source: 1,
        sentence: b"$GPZDA,150640.12,15,06,2025,,*62\r\n",
    };
    let mut bytes = Vec::new();
    let range = nmea.emit_message(&mut bytes, 0);
    let golden = [
        &s[..],
        &ms,
        &[1, 0, 0, 0],
        b"$GPZDA,150640.12,15,06,2025,,*62",
    ]
    .concat();
    assert_same(&bytes[range][16..], &golden, "2002");
    assert_eq!(
        Nmea2002::parse(&golden).unwrap().sentence,
        b"$GPZDA,150640.12,15,06,2025,,*62"
    );
}

fn set(message_type: u16, value: Value) -> Control {
    Control {
        message_type,
        command_type: command_type::SET,
        subsystem: 20,
        channel: 1,
        session: 2,
        sequence: 3,
        value,
    }
}

/// Bytes that LSTS DUNE sends, and the answers it expects.
#[test]
fn commands_of_a_public_client_parse_and_have_the_expected_answers() {
    let set_range = table(
        20,
        &[
            (0, &[0x01, 0x16, 13]),
            (4, &128_u16.to_le_bytes()),
            (6, &[0, 21, 0, 0]),
            (12, &le(&[4_i32, 50_000])),
        ],
    );
    let control = Control::parse(&Message::parse(&set_range).unwrap()).unwrap();
    assert_eq!(control.value, Value::Number(50_000));
    // GET of the same value without a body, and with stale bytes.
    let get = table(
        16,
        &[
            (0, &[0x01, 0x16, 13]),
            (4, &128_u16.to_le_bytes()),
            (6, &[1, 21, 0, 5]),
        ],
    );
    let mut stale = [&get[..], &[9, 9, 9, 9]].concat();
    stale[12] = 4;
    for bytes in [&get, &stale] {
        let asked = Control::parse(&Message::parse(bytes).unwrap()).unwrap();
        assert_eq!(
            (asked.command_type, &asked.value),
            (command_type::GET, &Value::None)
        );
        let mut answer = Vec::new();
        asked.reply(Value::Number(50_000)).emit(&mut answer);
        let golden = table(
            20,
            &[
                (0, &[0x01, 0x16, 13]),
                (4, &128_u16.to_le_bytes()),
                (6, &[2, 21, 0, 5]),
                (12, &le(&[4_i32, 50_000])),
            ],
        );
        assert_same(&answer, &golden, "reply to 128");
        answer.clear();
        asked
            .refuse(error_code::UNKNOWN_SUBSYSTEM)
            .emit(&mut answer);
        assert_eq!((answer[6], answer[16]), (3, 3));
    }
    let value = Value::Coupling {
        master_subsystem: 21,
        divisor: 2,
        delay_us: 300,
    };
    let coupling = set(message_type::PING_COUPLING, value);
    let bytes = bytes_of(|buf| coupling.emit(buf));
    let golden: Vec<u8> = [21, 2, 300_u32]
        .iter()
        .flat_map(|v| v.to_le_bytes())
        .collect();
    assert_same(&bytes[16..], &golden, "129");
    assert_eq!(
        Control::parse(&Message::parse(&bytes).unwrap()),
        Ok(coupling)
    );
}

#[test]
fn every_command_round_trips_and_unknown_types_are_refused() {
    for kind in 0..=u16::MAX {
        if !is_command(kind) {
            continue;
        }
        let value = match kind {
            22 => Value::Time {
                seconds: 1,
                milliseconds: 2,
            },
            129 => Value::Coupling {
                master_subsystem: 20,
                divisor: 1,
                delay_us: 0,
            },
            123 => Value::PulseName("400-1ms.spf".into()),
            _ => Value::Number(-5),
        };
        let control = set(kind, value);
        let bytes = bytes_of(|buf| control.emit(buf));
        assert_eq!(
            Control::parse(&Message::parse(&bytes).unwrap()),
            Ok(control),
            "{kind}"
        );
    }
    let kinds: Vec<u16> = (0..=u16::MAX).filter(|&kind| is_command(kind)).collect();
    assert_eq!(
        kinds,
        [
            22, 25, 41, 44, 45, 83, 120, 121, 122, 123, 124, 125, 128, 129, 133, 140, 141, 142
        ]
    );
    let mut bytes = Vec::new();
    emit_message(
        &mut bytes,
        &MessageHeader {
            command_type: 0,
            ..MessageHeader::data(999, 0, 0)
        },
        |_| {},
    );
    assert!(matches!(
        Control::parse(&Message::parse(&bytes).unwrap()),
        Err(WireError::Unsupported { got: 999, .. })
    ));
}

/// 60 messages 80 in formats 0, 1, 9 of subsystems 20, 21, 40, which pyjsf, pingverter and sidescantools can read.
#[test]
fn a_file_that_other_readers_accept_round_trips_byte_for_byte() {
    let file = std::fs::read(concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/tests/data/proto_iq.jsf"
    ))
    .unwrap();
    let mut stream = JsfStream::new(JsfFraming::default());
    let (mut back, mut formats) = (Vec::new(), std::collections::BTreeMap::new());
    stream.feed(&file, |message| {
        let message = Message::parse(message.unwrap()).unwrap();
        if message.header.message_type != message_type::SONAR_DATA {
            emit_message(&mut back, &message.header, |buf| {
                buf.extend_from_slice(message.body)
            });
            return;
        }
        let data = SonarData80::parse(message.body).unwrap();
        *formats
            .entry((message.header.subsystem, data.header.data_format))
            .or_insert(0) += 1;
        let shorts: Vec<i16> = data.shorts().collect();
        let at = back.len();
        emit_80(
            &mut back,
            message.header.subsystem,
            message.header.channel,
            &data.header,
            &shorts,
        );
        // Version and sequence are those of the file.
        back[at + 2] = message.header.protocol_version;
        back[at + 9] = message.header.sequence;
    });
    assert_eq!(stream.skipped_bytes(), 0);
    assert_eq!(formats.values().sum::<i32>(), 60, "{formats:?}");
    assert_eq!(
        formats
            .keys()
            .map(|key| key.1)
            .collect::<std::collections::BTreeSet<_>>(),
        [0, 1, 9].into()
    );
    // Bytes that the manual calls reserved are emitted as 0.
    let first_difference = back.iter().zip(&file).position(|(b, f)| b != f);
    assert_eq!(first_difference, None, "of {} bytes", file.len());
    assert_eq!(back.len(), file.len());
}

#[test]
fn messages_are_complete_for_any_division_of_the_stream_and_after_invalid_bytes() {
    let mut bytes = Vec::new();
    for port in 0..5 {
        Situation2091::default().emit_message(&mut bytes, port);
        bytes.extend_from_slice(&[0x01, 0x16, 0x00][..usize::from(port % 4)]);
    }
    bytes.extend_from_slice(&[
        0x01, 0x16, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0xff, 0xff, 0xff, 0xff,
    ]);
    Situation2091::default().emit_message(&mut bytes, 5);
    for cut in [1, 2, 7, 16, 115, 116, 117, 10_000] {
        let mut stream = JsfStream::new(JsfFraming {
            max_body_bytes: 1000,
        });
        let mut ports = Vec::new();
        for chunk in bytes.chunks(cut) {
            stream.feed(chunk, |message| {
                if let Ok(bytes) = message {
                    ports.push(Message::parse(bytes).unwrap().header.channel);
                }
            });
        }
        assert_eq!(ports, [0, 1, 2, 3, 4, 5], "cut every {cut} bytes");
        assert_eq!(
            stream.skipped_bytes(),
            1 + 2 + 3 + 16,
            "cut every {cut} bytes"
        );
    }
}

#[test]
fn one_byte_short_is_truncated_and_a_huge_count_reserves_nothing() {
    let body = |len: usize| vec![0; len];
    let short = |error: Result<(), WireError>| {
        assert!(
            matches!(error, Err(WireError::Truncated { .. })),
            "{error:?}"
        );
    };
    short(SonarData80::parse(&body(239)).map(|_| ()));
    short(PitchRoll2020::parse(&body(43)).map(|_| ()));
    short(Pressure2060::parse(&body(75)).map(|_| ()));
    short(Dvl2080::parse(&body(71)).map(|_| ()));
    short(Situation2091::parse(&body(99)).map(|_| ()));
    short(SystemInformation182::parse(&body(23)).map(|_| ()));
    short(FileTime426::parse(&body(7)).map(|_| ()));
    short(Nmea2002::parse(&body(11)).map(|_| ()));
    let mut huge = body(300);
    (huge[17], huge[114], huge[115]) = (0x0F, 0xFF, 0xFF);
    short(SonarData80::parse(&huge).map(|_| ()));
    huge[34] = 4;
    assert!(matches!(
        SonarData80::parse(&huge),
        Err(WireError::Unsupported { got: 4, .. })
    ));
    let mut message = body(16);
    message[..2].copy_from_slice(&[0x01, 0x16]);
    message[12..].fill(0xff);
    assert!(matches!(
        Message::parse(&message),
        Err(WireError::Oversized { .. })
    ));
}

#[test]
fn unknown_values_are_described_as_unknown() {
    let header = SonarDataHeader::default();
    assert_eq!(header.position_rad(), None);
    assert_eq!(header.heading_rad(), None);
    assert_eq!(header.pitch_roll_rad(), None);
    assert_eq!(header.validity, 0);
    let mut header = header;
    header.set_heading_rad(359.9999_f64.to_radians());
    assert_eq!(
        (header.heading_cdeg, header.validity),
        (0, validity::HEADING)
    );
}

/// Bytes that often resemble valid messages.
fn nearly_messages() -> impl Strategy<Value = Vec<u8>> {
    let kinds = [
        22_u16, 80, 120, 123, 129, 182, 426, 2002, 2020, 2060, 2080, 2091, 9999,
    ];
    proptest::collection::vec(
        (
            proptest::sample::select(kinds.to_vec()),
            any::<[u8; 4]>(),
            proptest::collection::vec(any::<u8>(), 0..400),
            any::<bool>(),
        ),
        0..4,
    )
    .prop_map(|parts| {
        let mut bytes = Vec::new();
        for (kind, flags, mut body, is_small) in parts {
            if is_small && body.len() > 116 {
                // Few samples and a supported format.
                body[17] = 0;
                body[34..36].copy_from_slice(&[[0, 1, 2, 9][usize::from(flags[3] % 4)], 0]);
                body[115] = 0;
            }
            let header = MessageHeader {
                command_type: flags[0] % 5,
                ..MessageHeader::data(kind, flags[1], flags[2])
            };
            emit_message(&mut bytes, &header, |buf| buf.extend(body));
        }
        bytes
    })
}

proptest! {
    #[test]
    fn no_bytes_make_a_parser_panic(bytes in proptest::collection::vec(any::<u8>(), 0..600), mut good in nearly_messages(), spoil in any::<(prop::sample::Index, u8)>()) {
        if !good.is_empty() {
            let at = spoil.0.index(good.len());
            good[at] ^= spoil.1;
        }
        for bytes in [&bytes, &good] {
            feed_to_end(JsfFraming { max_body_bytes: 4096 }, bytes, usize::MAX, |message| match message {
                Ok(message) => {
                    assert!(!describe(message).is_empty());
                    let read = Message::parse(message).unwrap();
                    if let Ok(data) = SonarData80::parse(read.body) {
                        assert!(data.values().len() * 2 <= read.body.len());
                    }
                    if let Ok(control) = Control::parse(&read) {
                        let again = bytes_of(|buf| control.emit(buf));
                        assert_eq!(Control::parse(&Message::parse(&again).unwrap()).unwrap(), control);
                    }
                }
                Err(error) => assert!(!error.to_string().is_empty()),
            });
            describe(bytes);
        }
    }

    #[test]
    fn header_bytes_that_are_not_reserved_round_trip(bytes in proptest::collection::vec(any::<u8>(), 240)) {
        let read = SonarDataHeader::parse(&bytes).unwrap();
        let mut back = Vec::new();
        read.emit(&mut back);
        let mut expected = bytes;
        for reserved in [12..16, 22..28, 32..34, 40..44, 48..80, 124..126, 178..182, 206..210, 224..226, 232..236, 238..240] {
            expected[reserved].fill(0);
        }
        // NaN stays NaN, bit for bit.
        prop_assert_eq!(back, expected);
    }

    #[test]
    fn samples_round_trip_in_all_formats_with_their_scale(
        samples in proptest::collection::vec(-1e3_f32..1e3, 0..200), format in 0..4_usize
    ) {
        let format = [DataFormat::Envelope, DataFormat::Analytic, DataFormat::Real, DataFormat::AnalyticUnfiltered][format];
        let samples = &samples[..samples.len() / 2 * 2];
        let mut shorts = Vec::new();
        let scaled = block_float::quantise(samples, &mut shorts);
        let mut header = SonarDataHeader { data_format: format.code(), weighting: scaled.weighting, ..SonarDataHeader::default() };
        header.set_samples(samples.len() / format.shorts_per_sample());
        let mut buf = Vec::new();
        let range = emit_80(&mut buf, subsystem::SIDE_SCAN_HIGH, 1, &header, &shorts);
        let message = Message::parse(&buf[range]).unwrap();
        let data = SonarData80::parse(message.body).unwrap();
        prop_assert_eq!(data.header, header);
        prop_assert_eq!(data.shorts().collect::<Vec<_>>(), shorts);
        let half_step = 0.5 * 2.0_f64.powi(-i32::from(scaled.weighting));
        for (value, &sample) in data.values().zip(samples) {
            prop_assert!((value - f64::from(sample)).abs() <= half_step);
        }
    }
}
