//! Compares the Ping protocol with its makers' published definitions, and parses random bytes.

use std::ops::Range;

use crate::support::{assert_same, feed_to_end, le, table};
use echotank_protocols::WireError;
use echotank_protocols::ping_protocol::common::*;
use echotank_protocols::ping_protocol::omniscan450::*;
use echotank_protocols::ping_protocol::surveyor240::*;
use echotank_protocols::ping_protocol::{
    Frame, MAX_FRAME_BYTES, Message, PingFraming, PingStream, checksum, emit_frame, message_id,
};
use proptest::prelude::*;

/// Compares the payload of an emitted frame with its table.
fn check(id: u16, golden: &[u8], emit: impl FnOnce(&mut Vec<u8>) -> Range<usize>) {
    let mut buf = vec![9];
    let range = emit(&mut buf);
    let frame = Frame::parse(&buf[range]).unwrap();
    assert_eq!(
        (frame.message_id, frame.source, frame.destination),
        (id, 1, 2)
    );
    assert_same(frame.payload, golden, &id.to_string());
}

#[test]
fn a_frame_is_byte_for_byte() {
    let mut buf = Vec::new();
    GeneralRequest { requested_id: 4 }.emit_frame(&mut buf, 0, 255);
    // 0x42 + 0x52 + 2 + 6 + 255 + 4 = 415 = 0x19F.
    assert_same(
        &buf,
        &[0x42, 0x52, 2, 0, 6, 0, 0, 255, 4, 0, 0x9F, 0x01],
        "general request",
    );
    buf[9] ^= 1;
    assert!(matches!(
        Frame::parse(&buf),
        Err(WireError::Checksum {
            stored: 0x19F,
            computed: 0x1A0,
            ..
        })
    ));
    assert_eq!(checksum(&[255; 300]), (300 * 255_u32 % 65_536) as u16);
}

#[test]
fn omniscan_450_matches_its_definition() {
    let params = OsPingParams {
        start_mm: 1000,
        length_mm: 50_000,
        msec_per_ping: 20,
        pulse_len_percent: 0.002,
        filter_duration_percent: 0.0015,
        gain_index: -1,
        num_results: 1200,
        enable: 1,
    };
    let golden = table(
        36,
        &[
            (0, &le(&[1000_u32, 50_000, 20])),
            (20, &le(&[0.002_f32, 0.0015])),
            (28, &(-1_i16).to_le_bytes()),
            (30, &1200_u16.to_le_bytes()),
            (32, &[1]),
        ],
    );
    check(2197, &golden, |buf| params.emit_frame(buf, 1, 2));
    assert_eq!(OsPingParams::parse(&golden), Ok(params));

    let head = OsMonoProfileHead {
        ping_number: 7,
        start_mm: 0,
        length_mm: 50_000,
        timestamp_ms: 123_456,
        ping_hz: 450_000,
        gain_index: 3,
        num_results: 0,
        sos_dmps: 15_000,
        channel_number: 1,
        pulse_duration_s: 1e-4,
        analog_gain: 20.0,
        max_pwr_db: 90.0,
        min_pwr_db: 10.0,
        transducer_heading_deg: 269.9,
        vehicle_heading_deg: 359.9,
    };
    let golden = table(
        58,
        &[
            (0, &7_u32.to_le_bytes()),
            (8, &le(&[50_000_u32, 123_456, 450_000])),
            (20, &le(&[3_u16, 3, 15_000])),
            (26, &[1, 0]),
            (28, &le(&[1e-4_f32, 20.0, 90.0, 10.0, 269.9, 359.9])),
            (52, &le(&[0_u16, 65_535, 32_768])),
        ],
    );
    let results = [10.0, 90.0, 50.0].map(|db| quantise_db(db, 10.0, 90.0));
    check(2198, &golden, |buf| emit_2198(buf, 1, 2, &head, &results));
    let profile = OsMonoProfile::parse(&golden).unwrap();
    assert_eq!(profile.results().collect::<Vec<_>>(), results);
    for (got, want) in profile.results_db().zip([10.0, 90.0, 50.0]) {
        // Half a step of 80 dB / 65535.
        assert!((got - want).abs() <= 0.00062, "{got} for {want}");
    }
    assert_eq!(quantise_db(f32::NAN, 10.0, 90.0), 0);
    assert_eq!(quantise_db(1e9, 10.0, 90.0), 65_535);
    assert_eq!(quantise_db(-1e9, 10.0, 90.0), 0);

    let sos = SetSpeedOfSound {
        speed_of_sound_mm_per_s: 1_500_000,
    };
    check(116, &1_500_000_u32.to_le_bytes(), |buf| {
        sos.emit_frame(buf, 1, 2)
    });
    let sync = SyncChannel {
        channel_number: 1,
        number_of_channels: 2,
    };
    check(169, &[1, 2], |buf| sync.emit_frame(buf, 1, 2));
}

#[test]
fn surveyor_240_matches_its_definition() {
    let params = SetPingParameters {
        start_mm: 500,
        end_mm: 30_000,
        sos_mps: 1500.0,
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
    };
    let golden = table(
        36,
        &[
            (0, &le(&[500_i32, 30_000])),
            (8, &1500_f32.to_le_bytes()),
            (12, &le(&[-1_i16, 100])),
            (19, &[1, 0, 0, 1, 1]),
            (24, &240_000_i32.to_le_bytes()),
            (28, &400_u16.to_le_bytes()),
            (32, &1.5_f32.to_le_bytes()),
        ],
    );
    check(3023, &golden, |buf| params.emit_frame(buf, 1, 2));
    assert_eq!(SetPingParameters::parse(&golden), Ok(params));

    let head = AtofHead {
        pwr_up_msec: 5,
        utc_msec: 1_750_000_000_123,
        listening_s: 0.04,
        sos_mps: 1500.0,
        ping_number: 7,
        ping_hz: 240_000,
        pulse_s: 1e-4,
        flags: 0,
        num_points: 0,
    };
    let points = [(-0.5, 0.02), (0.5, 0.025)].map(|(angle_rad, two_way_time_s)| AtofPoint {
        angle_rad,
        two_way_time_s,
    });
    let golden = table(
        72,
        &[
            (0, &5_u32.to_le_bytes()),
            (4, &1_750_000_000_123_u64.to_le_bytes()),
            (12, &le(&[0.04_f32, 1500.0])),
            (20, &le(&[7_u32, 240_000])),
            (28, &1e-4_f32.to_le_bytes()),
            (36, &2_u16.to_le_bytes()),
            (40, &le(&[-0.5_f32, 0.02])),
            (56, &le(&[0.5_f32, 0.025])),
        ],
    );
    check(3012, &golden, |buf| emit_3012(buf, 1, 2, &head, &points));
    assert_eq!(
        AtofPointData::parse(&golden)
            .unwrap()
            .points()
            .collect::<Vec<_>>(),
        points
    );

    let head = YzHead {
        timestamp_msec: 5,
        ping_number: 7,
        sos_mps: 1500.0,
        up: [0.1, 0.2, 0.9],
        water_c: 12.5,
        water_bar: -1000.0,
        heave_m: 0.0,
        start_m: 0.5,
        end_m: 30.0,
        num_points: 0,
    };
    let golden = table(
        108,
        &[
            (0, &le(&[5_u32, 7])),
            (8, &le(&[1500.0_f32, 0.1, 0.2, 0.9])),
            (76, &le(&[12.5_f32, -1000.0])),
            (88, &le(&[0.5_f32, 30.0])),
            (98, &1_u16.to_le_bytes()),
            (100, &le(&[-3.0_f32, -20.0])),
        ],
    );
    check(3011, &golden, |buf| {
        emit_3011(buf, 1, 2, &head, &[[-3.0, -20.0]])
    });
    assert_eq!(
        YzPointData::parse(&golden)
            .unwrap()
            .points()
            .collect::<Vec<_>>(),
        [[-3.0, -20.0]]
    );

    let attitude = AttitudeReport {
        up: AttitudeReport::up_from(5_f64.to_radians(), 3_f64.to_radians()),
        utc_msec: 1_750_000_000_123,
        pwr_up_msec: 5,
    };
    // Bow up by 3 degrees: sin 3; port up by 5: cos 3 sin 5; cos 3 cos 5.
    let golden = table(
        36,
        &[
            (0, &le(&[0.052_335_957_f32, 0.087_036_3, 0.994_829_4])),
            (24, &1_750_000_000_123_u64.to_le_bytes()),
            (32, &5_u32.to_le_bytes()),
        ],
    );
    let read = AttitudeReport::parse(&golden).unwrap();
    for (got, want) in attitude.up.iter().zip(read.up) {
        assert!((got - want).abs() < 1e-6, "{got} for {want}");
    }
    assert_eq!(
        AttitudeReport {
            up: read.up,
            ..attitude
        },
        read
    );
    check(504, &golden, |buf| read.emit_frame(buf, 1, 2));
    let utc = UtcResponse {
        utc_msec: 1_750_000_000_123,
        accuracy_msec: 4,
    };
    let golden = [
        &1_750_000_000_123_u64.to_le_bytes()[..],
        &4_u32.to_le_bytes(),
    ]
    .concat();
    check(15, &golden, |buf| utc.emit_frame(buf, 1, 2));
    let water = WaterStats {
        temperature_c: 12.5,
        pressure_bar: 1.25,
    };
    let golden = [12.5_f32.to_le_bytes(), 1.25_f32.to_le_bytes()].concat();
    check(118, &golden, |buf| water.emit_frame(buf, 1, 2));
}

#[test]
fn common_messages_parse_as_their_types() {
    let mut buf = Vec::new();
    DeviceInformation {
        device_type: 0,
        device_revision: 1,
        firmware: [1, 2, 3],
    }
    .emit_frame(&mut buf, 1, 0);
    ProtocolVersion { version: [1, 0, 0] }.emit_frame(&mut buf, 1, 0);
    emit_nack(&mut buf, 1, 0, 2197, "length_mm is out of range");
    AckMessage { acked_id: 116 }.emit_frame(&mut buf, 1, 0);
    emit_utc_request(&mut buf, 1, 0);
    emit_frame(&mut buf, 4321, 1, 0, |buf| buf.push(5));
    let mut stream = PingStream::new(PingFraming);
    let mut words = Vec::new();
    stream.feed(&buf, |frame| {
        words.push(format!(
            "{:?}",
            Message::parse(&Frame::parse(frame.unwrap()).unwrap()).unwrap()
        ));
    });
    assert_eq!(
        words,
        [
            "DeviceInformation(DeviceInformation { device_type: 0, device_revision: 1, firmware: [1, 2, 3] })",
            "ProtocolVersion(ProtocolVersion { version: [1, 0, 0] })",
            "Nack { refused_id: 2197, text: \"length_mm is out of range\" }",
            "Ack(AckMessage { acked_id: 116 })",
            "UtcRequest",
            "Other { message_id: 4321, payload: [5] }",
        ]
    );
}

#[test]
fn a_shortened_payload_is_reported_as_truncated() {
    for (id, bytes) in [
        (message_id::ACK, 2),
        (message_id::NACK, 2),
        (message_id::DEVICE_INFORMATION, 6),
        (message_id::PROTOCOL_VERSION, 4),
        (message_id::GENERAL_REQUEST, 2),
        (message_id::SET_DEVICE_ID, 1),
        (message_id::SET_SPEED_OF_SOUND, 4),
        (message_id::SYNC_CHANNEL, 2),
        (message_id::OS_PING_PARAMS, 36),
        (message_id::OS_MONO_PROFILE, 52),
        (message_id::UTC_RESPONSE, 12),
        (message_id::SET_NET_INFO, 12),
        (message_id::SET_PING_PARAMETERS, 36),
        (message_id::ATTITUDE_REPORT, 36),
        (message_id::WATER_STATS, 8),
        (message_id::ATOF_POINT_DATA, 40),
        (message_id::YZ_POINT_DATA, 100),
    ] {
        let payload = vec![0; bytes];
        let of = |payload| {
            Message::parse(&Frame {
                message_id: id,
                source: 0,
                destination: 0,
                payload,
            })
        };
        assert!(of(&payload).is_ok(), "{id}");
        assert!(
            matches!(of(&payload[1..]), Err(WireError::Truncated { .. })),
            "{id}"
        );
    }
}

proptest! {
    #[test]
    fn no_bytes_make_a_parser_panic_and_no_byte_is_lost(
        bytes in proptest::collection::vec(any::<u8>(), 0..300),
        frames in proptest::collection::vec((0..22_usize, proptest::collection::vec(any::<u8>(), 0..120)), 0..4),
        spoil in any::<(prop::sample::Index, u8)>(),
        cut in 1..40_usize,
    ) {
        let ids = [1, 2, 3, 4, 5, 6, 10, 14, 15, 17, 100, 116, 118, 169, 170, 504, 2197, 2198, 3011, 3012, 3023, 7];
        let mut good = Vec::new();
        for (id, payload) in &frames {
            emit_frame(&mut good, ids[*id], 1, 2, |buf| buf.extend(payload));
        }
        let whole = good.clone();
        if !good.is_empty() {
            let at = spoil.0.index(good.len());
            good[at] ^= spoil.1;
        }
        for (bytes, is_whole) in [(&bytes, false), (&good, false), (&whole, true)] {
            let mut count = 0;
            feed_to_end(PingFraming, bytes, cut, |frame| if let Ok(frame) = frame {
                count += 1;
                if let Ok(message) = Message::parse(&Frame::parse(frame).unwrap()) { let _ = format!("{message:?}"); }
            });
            prop_assert!(!is_whole || count == frames.len());
        }
    }

    #[test]
    fn lines_round_trip(results in proptest::collection::vec(any::<u16>(), 0..1200)) {
        let mut buf = Vec::new();
        let range = emit_2198(&mut buf, 3, 4, &OsMonoProfileHead::default(), &results);
        prop_assert!(range.len() < MAX_FRAME_BYTES);
        let frame = Frame::parse(&buf[range]).unwrap();
        prop_assert_eq!(OsMonoProfile::parse(frame.payload).unwrap().results().collect::<Vec<_>>(), results);
    }
}
