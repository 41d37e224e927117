//! Compares NORBIT WBMS and Imagenex 872 with their published layouts, and parses random bytes.

use crate::support::{assert_same, feed_to_end, le, table};
use echotank_protocols::WireError;
use echotank_protocols::imagenex872::{
    ECHO_BYTES, Side, SwitchCommand, SwitchFraming, SwitchStream, emit_answer, parse_answer,
};
use echotank_protocols::wbms::{
    Backscatter, BackscatterHead, Bathymetry, BathymetryHead, Command, CommandError, Detection,
    Packet, Tail, WbmsFraming, answer, commands_in, crc32, emit_backscatter,
    emit_backscatter_beam_major, emit_bathymetry, packet_type,
};
use proptest::prelude::*;

const TIME_S: f64 = 1_750_000_000.125;

fn bathymetry_head() -> BathymetryHead {
    BathymetryHead {
        sound_velocity_m_per_s: 1500.0,
        sample_rate_hz: 78_125.0,
        detections: 0,
        ping_number: 7,
        time_s: TIME_S,
        time_net_s: TIME_S + 0.25,
        ping_rate_hz: 10.0,
        sub_type: 0,
        beam_distribution: 2,
        sonar_mode: 1,
        time_uncertainty_s: 1e-6,
        multiping: 1,
        multiping_sequence: 0,
        tx_angle_rad: 0.1,
        gain: 2.0,
        tx_frequency_hz: 400e3,
        tx_bandwidth_hz: 80e3,
        tx_length_s: 5e-4,
        sound_velocity_raw_m_per_s: 1500.5,
        tx_voltage: 90.0,
        swath_direction_rad: 0.2,
        swath_opening_rad: 2.1,
        gate_tilt_rad: 0.3,
    }
}

fn with_crc(mut packet: Vec<u8>) -> Vec<u8> {
    let crc = crc32(&packet[24..]);
    packet[20..24].copy_from_slice(&crc.to_le_bytes());
    packet
}

#[test]
fn the_crc_equals_that_of_zlib() {
    // The standard check value of CRC-32.
    assert_eq!(crc32(b"123456789"), 0xCBF4_3926);
    assert_eq!(crc32(b""), 0);
}

#[test]
fn bathymetry_matches_its_table() {
    let f = |value: f32| value.to_le_bytes();
    let golden = with_crc(table(
        132,
        &[
            (0, &le(&[0xDEAD_BEEF_u32, 1, 132, 4])),
            (24, &le(&[1500.0_f32, 78_125.0])),
            (32, &le(&[1_u32, 7])),
            (40, &TIME_S.to_le_bytes()),
            (48, &(TIME_S + 0.25).to_le_bytes()),
            (56, &f(10.0)),
            (62, &[2, 1]),
            (64, &f(1e-6)),
            (68, &1_u16.to_le_bytes()),
            (
                72,
                &le(&[0.1_f32, 2.0, 400e3, 80e3, 5e-4, 1500.5, 90.0, 0.2, 2.1, 0.3]),
            ),
            // One detection.
            (112, &2083_u32.to_le_bytes()),
            (116, &f(-0.5)),
            (120, &le(&[2000_u16, 2200])),
            (124, &f(1234.5)),
            (128, &3_u16.to_le_bytes()),
            (130, &[3, 200]),
        ],
    ));
    let detection = Detection {
        sample_number: 2083,
        angle_rad: -0.5,
        upper_gate: 2000,
        lower_gate: 2200,
        intensity: 1234.5,
        flags: 3,
        quality_flags: 3,
        quality: 200,
    };
    let mut bytes = Vec::new();
    emit_bathymetry(&mut bytes, &bathymetry_head(), &[detection]);
    assert_same(&bytes, &golden, "type 1");
    let read = Bathymetry::parse(&Packet::parse(&golden).unwrap()).unwrap();
    assert_eq!(read.detections().collect::<Vec<_>>(), [detection]);
    assert_eq!(read.head.time_s, TIME_S);
    let mut spoiled = golden.clone();
    spoiled[131] ^= 1;
    assert!(matches!(
        Packet::parse(&spoiled),
        Err(WireError::Checksum { .. })
    ));
}

fn backscatter_head() -> BackscatterHead {
    BackscatterHead {
        sound_velocity_m_per_s: 1500.0,
        sample_rate_hz: 78_125.0,
        time_s: TIME_S,
        t0_samples: -3,
        gain: 2.0,
        swath_direction_rad: 0.2,
        swath_opening_rad: 2.1,
        tx_frequency_hz: 400e3,
        tx_bandwidth_hz: 80e3,
        tx_length_s: 5e-4,
        tx_amplitude: 15,
        ping_rate_hz: 10.0,
        ping_number: 7,
        time_net_s: TIME_S + 0.25,
        beams_of_former: 256,
        vga_t0: 10,
        vga_g0_db: 1.5,
        vga_t1: 20,
        vga_g1_db: 2.5,
        tx_angle_rad: 0.1,
        tx_voltage: 90.0,
        beam_distribution: 2,
        sonar_mode: 1,
        gate_tilt_rad: 0.3,
        time_uncertainty_s: 1e-6,
        ..BackscatterHead::default()
    }
}

#[test]
fn water_column_side_scan_and_snippets_match_their_table() {
    let f = |value: f32| value.to_le_bytes();
    let golden = |kind: u32, beams: u32, samples: u32, behind: &[u8]| {
        let head = table(
            192,
            &[
                (0, &0xDEAD_BEEF_u32.to_le_bytes()),
                (4, &kind.to_le_bytes()),
                (8, &(192 + behind.len() as u32).to_le_bytes()),
                (12, &4_u32.to_le_bytes()),
                (24, &le(&[1500.0_f32, 78_125.0])),
                (32, &beams.to_le_bytes()),
                (36, &samples.to_le_bytes()),
                (40, &TIME_S.to_le_bytes()),
                (48, &3_u32.to_le_bytes()),
                (52, &(-3_i32).to_le_bytes()),
                (56, &f(2.0)),
                (64, &le(&[0.2_f32, 2.1, 400e3, 80e3, 5e-4])),
                (84, &15_u32.to_le_bytes()),
                (100, &f(10.0)),
                (108, &7_u32.to_le_bytes()),
                (112, &(TIME_S + 0.25).to_le_bytes()),
                (120, &256_u32.to_le_bytes()),
                (124, &10_i32.to_le_bytes()),
                (128, &f(1.5)),
                (132, &20_i32.to_le_bytes()),
                (136, &f(2.5)),
                (144, &le(&[0.1_f32, 90.0])),
                (152, &[2, 1]),
                (156, &le(&[0.3_f32, 1e-6])),
            ],
        );
        with_crc([&head, behind].concat())
    };
    let samples = [1_i16, -2, 300, -400, 5, 6];
    let sample_bytes: Vec<u8> = samples.iter().flat_map(|s| s.to_le_bytes()).collect();
    let angles = [-0.5_f32, 0.0, 0.5];
    let angle_bytes = angles.map(f32::to_le_bytes).concat();
    let (starts, detections) = ([10_u16, 11, 12], [20_u16, 21, 22]);
    let u16_bytes = [starts, detections]
        .as_flattened()
        .iter()
        .flat_map(|v| v.to_le_bytes())
        .collect::<Vec<u8>>();
    for (tail, golden) in [
        (
            Tail::WaterColumn {
                angles_rad: &angles,
            },
            golden(2, 3, 2, &[&sample_bytes[..], &angle_bytes].concat()),
        ),
        (Tail::SideScan, golden(5, 2, 3, &sample_bytes)),
        (
            Tail::Snippets {
                angles_rad: &angles,
                start_samples: &starts,
                detection_samples: &detections,
            },
            golden(
                4,
                3,
                2,
                &[&sample_bytes[..], &angle_bytes, &u16_bytes].concat(),
            ),
        ),
    ] {
        let mut bytes = Vec::new();
        emit_backscatter(&mut bytes, &backscatter_head(), &samples, tail);
        assert_same(&bytes, &golden, "backscatter");
        let beams = match tail {
            Tail::SideScan => 2,
            Tail::WaterColumn { angles_rad } | Tail::Snippets { angles_rad, .. } => {
                angles_rad.len()
            }
        };
        let of_beam = |beam| samples.iter().skip(beam).step_by(beams);
        let by_beam: Vec<i16> = (0..beams).flat_map(of_beam).copied().collect();
        bytes.clear();
        emit_backscatter_beam_major(&mut bytes, &backscatter_head(), &by_beam, tail);
        assert_same(&bytes, &golden, "backscatter by beam");
        let read = Backscatter::parse(&Packet::parse(&golden).unwrap()).unwrap();
        assert_eq!(read.values().collect::<Vec<_>>(), samples.map(f64::from));
        match read.packet_type {
            packet_type::SIDE_SCAN => assert_eq!(read.angles_rad().len(), 0),
            _ => assert_eq!(read.angles_rad().collect::<Vec<_>>(), angles),
        }
        let snippets: Vec<_> = read.snippets().collect();
        let expected: &[(u16, u16)] = match read.packet_type {
            packet_type::SNIPPETS => &[(10, 20), (11, 21), (12, 22)],
            _ => &[],
        };
        assert_eq!(snippets, expected);
    }
}

#[test]
fn commands_parse_with_and_without_line_ends() {
    let read = |text: &str| commands_in(text).collect::<Result<Vec<_>, _>>().unwrap();
    assert_eq!(
        read("set_range 1 50\r\nset_rate -1\r\nset_tx 400 80 15 500 # loud\r\nset_power"),
        [
            Command::RangeM {
                start: 1.0,
                stop: 50.0,
                depths: None
            },
            Command::RateHz(-1.0),
            Command::Tx {
                frequency_khz: 400.0,
                bandwidth_khz: 80.0,
                amplitude: 15,
                length_us: 500.0
            },
            Command::Query("set_power".into()),
        ]
    );
    assert_eq!(read("set_power 1"), [Command::Power(true)]);
    assert_eq!(
        read("set_range 1 50 2 30\nsound_velocity -1\nsound_velocity 1480.5\nexit\n\n"),
        [
            Command::RangeM {
                start: 1.0,
                stop: 50.0,
                depths: Some((2.0, 30.0))
            },
            Command::SoundVelocity(None),
            Command::SoundVelocity(Some(1480.5)),
            Command::Exit,
        ]
    );
    assert_eq!(
        answer("set_range", &[1.0, 50.5], ""),
        "set_range 1 50.5\r\n"
    );
    assert_eq!(
        answer("set_rate", &[60.0], "clipped\r\nx"),
        "set_rate 60 # clipped  x\r\n"
    );
}

#[test]
fn commands_beyond_their_limits_are_refused_with_the_limit() {
    let refused = |line: &str| Command::parse(line).unwrap_err();
    assert_eq!(
        refused("set_rate 61").to_string(),
        "set_rate takes -1 to 60, not 61"
    );
    assert_eq!(
        refused("set_range 50 10").to_string(),
        "set_range takes 50 to 10000, not 10"
    );
    assert_eq!(
        refused("set_tx 400 80 16 500").to_string(),
        "set_tx takes 0 to 15, not 16"
    );
    assert_eq!(
        refused("set_tx 400 80").to_string(),
        "set_tx takes four arguments, not 2"
    );
    assert_eq!(
        refused("set_gate_tilt nan").to_string(),
        "set_gate_tilt: \"nan\" is not a number"
    );
    assert_eq!(
        refused("reboot now").to_string(),
        "unknown command \"reboot\""
    );
    assert!(matches!(
        refused(&"x".repeat(600)),
        CommandError::TooLong { got: 600 }
    ));
    assert!(matches!(
        refused("serial 5"),
        CommandError::Arguments {
            command: "serial",
            ..
        }
    ));
    assert_eq!(
        Command::parse("set_mode"),
        Ok(Command::Query("set_mode".into()))
    );
}

#[test]
fn imagenex_commands_and_answers_match_the_client_s_bytes() {
    let golden = table(
        27,
        &[
            (0, &[0xFE, 0x44]),
            (3, &[50]),
            (7, &[2, 40]),
            (10, &[30]),
            (18, &[2]),
            (26, &[0xFD]),
        ],
    );
    let command = SwitchCommand {
        range_m: 50,
        frequency_index: 2,
        data_gain: 40,
        balance_gain: 30,
        side: Side::Starboard,
    };
    let mut bytes = Vec::new();
    command.emit(&mut bytes);
    assert_same(&bytes, &golden, "switch command");
    assert_eq!(SwitchCommand::parse(&golden), Ok(command));
    for (at, value) in [(3, 51), (7, 3), (18, 1)] {
        let mut wrong = golden.clone();
        wrong[at] = value;
        assert!(
            matches!(SwitchCommand::parse(&wrong), Err(WireError::Unsupported { got, .. }) if got == u64::from(value))
        );
    }
    let mut echo = [0; ECHO_BYTES];
    (echo[0], echo[999]) = (7, 9);
    bytes.clear();
    emit_answer(&mut bytes, &echo);
    let golden = table(
        1013,
        &[(0, b"IMX"), (12, &[7]), (1011, &[9]), (1012, &[0xFC])],
    );
    assert_same(&bytes, &golden, "answer");
    assert_eq!(parse_answer(&golden), Ok(&echo));
}

proptest! {
    #[test]
    fn no_bytes_make_a_parser_panic_and_no_byte_is_lost(
        bytes in proptest::collection::vec(any::<u8>(), 0..400),
        numbers in any::<[u32; 3]>(),
        kind in 0..8_u32,
        text: String,
        spoil in any::<(prop::sample::Index, u8)>(),
        cut in 1..100_usize,
    ) {
        for command in commands_in(&text) { let _ = format!("{command:?}"); }
        let _ = commands_in(&format!("set_range {} {}\nset_tx {text}", numbers[0], text)).count();
        let (mut good, mut forged) = (Vec::new(), vec![0; 24 + bytes.len()]);
        emit_bathymetry(&mut good, &bathymetry_head(), &[Detection::default(); 3]);
        emit_backscatter(&mut good, &backscatter_head(), &[1, 2, 3, 4], Tail::SideScan);
        SwitchCommand { range_m: 50, frequency_index: 0, data_gain: 0, balance_gain: 0, side: Side::Port }.emit(&mut good);
        let at = spoil.0.index(good.len());
        good[at] ^= spoil.1;
        // A valid header and checksum around random contents, with any numbers of beams and samples.
        forged[..4].copy_from_slice(&0xDEAD_BEEF_u32.to_le_bytes());
        forged[4..8].copy_from_slice(&kind.to_le_bytes());
        let size = forged.len() as u32;
        forged[8..12].copy_from_slice(&size.to_le_bytes());
        forged[12] = 4;
        forged[24..].copy_from_slice(&bytes);
        if bytes.len() > 28 {
            forged[32..36].copy_from_slice(&numbers[0].to_le_bytes());
            forged[36..40].copy_from_slice(&numbers[1].to_le_bytes());
            forged[48..52].copy_from_slice(&(numbers[2] % 0x18).to_le_bytes());
        }
        let forged = with_crc(forged);
        for bytes in [&bytes, &good, &forged] {
            let _ = SwitchCommand::parse(bytes);
            let _ = parse_answer(bytes);
            let mut switch = SwitchStream::new(SwitchFraming);
            let mut commands = 0;
            switch.feed(bytes, |command| commands += usize::from(command.is_ok_and(|c| SwitchCommand::parse(c).is_ok())));
            prop_assert!(commands * 27 <= bytes.len());
            feed_to_end(WbmsFraming, bytes, cut, |packet| {
                if let Ok(packet) = packet.and_then(Packet::parse) {
                    if let Ok(read) = Bathymetry::parse(&packet) { assert!(read.detections().count() * 20 <= packet.payload.len()); }
                    if let Ok(read) = Backscatter::parse(&packet) { assert!(read.values().len() <= packet.payload.len()); }
                }
            });
        }
    }

    #[test]
    fn samples_round_trip(samples in proptest::collection::vec(any::<i16>(), 0..300), beams in 1..7_usize) {
        let samples = &samples[..samples.len() / beams * beams];
        let angles: Vec<f32> = (0..beams).map(|beam| beam as f32).collect();
        let mut bytes = vec![1];
        let range = emit_backscatter(&mut bytes, &BackscatterHead::default(), samples, Tail::WaterColumn { angles_rad: &angles });
        let read = Backscatter::parse(&Packet::parse(&bytes[range]).unwrap()).unwrap();
        prop_assert_eq!(read.values().collect::<Vec<_>>(), samples.iter().map(|&s| f64::from(s)).collect::<Vec<_>>());
        prop_assert_eq!(read.angles_rad().collect::<Vec<_>>(), angles);
    }
}
