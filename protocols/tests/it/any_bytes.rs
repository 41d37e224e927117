//! Parsers never panic on any bytes, and emitting what was parsed restores the bytes.

use std::ops::Range;

use crate::support::{STAMP, emitted_body, record_of};
use echotank_protocols::sevenk::control::{Ack7501, ControlHeader, Nack7502};
use echotank_protocols::sevenk::file::{Catalogue7300, FileHeader7200, FileReader};
use echotank_protocols::sevenk::frame::{DATA_RECORD_FRAME_BYTES, MIN_RECORD_BYTES};
use echotank_protocols::sevenk::records::*;
use echotank_protocols::sevenk::{
    BodyError, Command, CommandErrorKind, ControlRequest, ErrorCode, Record, RecordBody, WireError,
    describe,
};
use proptest::collection::vec;
use proptest::prelude::*;

const OUR_TYPES: [u32; 19] = [
    1003, 1008, 1009, 7030, 1012, 1013, 7000, 7001, 7004, 7007, 7018, 7038, 7200, 7300, 7500, 7501,
    7502, 7503, 7610,
];

fn with_zeros(bytes: &[u8], reserved: &[Range<usize>]) -> Vec<u8> {
    let mut bytes = bytes.to_vec();
    reserved
        .iter()
        .for_each(|range| bytes[range.clone()].fill(0));
    bytes
}

#[test]
fn a_record_one_byte_short_is_reported_as_truncated() {
    for (record_type_id, rth_bytes) in [
        (1003, 37),
        (1008, 8),
        (1009, 24),
        (7030, 616),
        (1012, 12),
        (1013, 4),
        (7000, 156),
        (7001, 12),
        (7004, 12),
        (7007, 64),
        (7018, 52),
        (7038, 60),
        (7200, 316),
        (7300, 14),
        (7501, 20),
        (7502, 24),
        (7503, 260),
        (7610, 12),
    ]
    .into_iter()
    .chain(crate::bottom_records::TYPES)
    {
        let record = record_of(record_type_id, &vec![0; rth_bytes - 1]);
        let error = RecordBody::parse(&Record::parse(&record).unwrap()).unwrap_err();
        let (need, got) = (rth_bytes as u64, rth_bytes as u64 - 1);
        assert!(
            matches!(error, BodyError::Wire(WireError::Truncated { need_bytes, got_bytes, .. }) if (need_bytes, got_bytes) == (need, got)),
            "{record_type_id}: {error}"
        );
    }
}

#[test]
fn counts_beyond_the_data_are_refused_before_memory_is_reserved() {
    let huge = |rth_bytes: usize, at: usize, len: usize| {
        let mut body = vec![0; rth_bytes + 100];
        body[at..at + len].fill(0xff);
        body
    };
    let truncated = |error| matches!(error, Err(WireError::Truncated { .. }));
    assert!(truncated(
        BeamGeometry7004::parse(&huge(12, 8, 4)).map(|_| ())
    ));
    assert!(truncated(
        Beamformed7018::parse(&huge(52, 14, 6)).map(|_| ())
    ));
    assert!(truncated(
        Configuration7001::parse(&huge(12, 8, 4)).map(|_| ())
    ));
    assert!(truncated(
        FileHeader7200::parse(&huge(316, 40, 4)).map(|_| ())
    ));
    let mut body = huge(14, 6, 4);
    body[0] = 14;
    assert!(truncated(Catalogue7300::parse(&body).map(|_| ())));
    let mut body = huge(64, 22, 4);
    body[62] = 4;
    assert!(truncated(SideScan7007::parse(&body).map(|_| ())));
    let mut body = huge(60, 26, 4);
    (body[20], body[30]) = (1, 16);
    assert!(truncated(RawIq7038::parse(&body).map(|_| ())));
    let subscribe = Command::parse(1051, &[0xff, 0xff, 0xff, 0xff, 1, 2]);
    assert!(matches!(
        subscribe,
        Err(CommandErrorKind::ArgumentsTruncated {
            need_bytes: 17_179_869_184,
            got_bytes: 6,
            ..
        })
    ));
}

#[test]
fn unsupported_sample_widths_are_named() {
    let mut body = vec![0; 64];
    body[62] = 3;
    assert_eq!(
        SideScan7007::parse(&body),
        Err(WireError::Unsupported {
            what: "7007 bytes per sample",
            got: 3
        })
    );
    let mut body = vec![0; 70];
    body[30] = 8;
    assert_eq!(
        RawIq7038::parse(&body),
        Err(WireError::Unsupported {
            what: "7038 sample type",
            got: 8
        })
    );
}

#[test]
fn bad_arguments_are_refused_with_the_code_of_their_kind() {
    let refusal = |remote_control_id: u32, arguments: &[u8]| {
        let header = ControlHeader {
            remote_control_id,
            ticket: 9,
            tracking_number: [1, 2],
        };
        let mut body = Vec::new();
        body.extend(remote_control_id.to_le_bytes());
        body.extend(9_u32.to_le_bytes());
        body.extend(1_u64.to_le_bytes());
        body.extend(2_u64.to_le_bytes());
        body.extend_from_slice(arguments);
        let error = ControlRequest::parse(&body).unwrap_err();
        assert_eq!(error.header, Some(header));
        assert_eq!(
            error.nack(),
            Nack7502 {
                ticket: 9,
                tracking_number: [1, 2],
                error: error.nack_code()
            }
        );
        error.nack_code()
    };
    assert_eq!(refusal(1003, &[0, 0, 0]), ErrorCode::InvalidParameter);
    assert_eq!(
        refusal(1003, &f32::NAN.to_le_bytes()),
        ErrorCode::InvalidParameter
    );
    assert_eq!(
        refusal(1003, &f32::INFINITY.to_le_bytes()),
        ErrorCode::InvalidParameter
    );
    assert_eq!(refusal(1007, &[2, 0, 0, 0]), ErrorCode::ParameterOutOfRange);
    assert_eq!(refusal(1017, &[1, 0, 0, 0]), ErrorCode::ParameterOutOfRange);
    let error = ControlRequest::parse(&[0; 23]).unwrap_err();
    assert_eq!(
        (error.header, error.nack_code()),
        (None, ErrorCode::InvalidParameter)
    );
}

#[test]
fn commands_without_arguments_need_no_empty_byte() {
    for trailing in 0..4 {
        assert_eq!(
            Command::parse(1100, &vec![0; trailing]),
            Ok(Command::StartPinging)
        );
    }
}

fn finite() -> impl Strategy<Value = f32> {
    any::<f32>().prop_filter("finite", |value| value.is_finite())
}

fn commands() -> impl Strategy<Value = Command> {
    prop_oneof![
        finite().prop_map(|range_m| Command::Range { range_m }),
        (finite(), finite())
            .prop_map(|(start_hz, stop_hz)| Command::ChirpBand { start_hz, stop_hz }),
        (
            [finite(), finite(), finite(), finite()],
            proptest::option::of(finite())
        )
            .prop_map(|([a, b, c, d], gate_tilt_rad)| {
                Command::BottomDetectionFilter {
                    min_range_m: a,
                    max_range_m: b,
                    min_depth_m: c,
                    max_depth_m: d,
                    gate_tilt_rad,
                }
            }),
        vec(any::<u32>(), 0..50).prop_map(|record_type_ids| Command::Subscribe { record_type_ids }),
        vec(any::<u32>(), 0..50)
            .prop_map(|record_type_ids| Command::Unsubscribe { record_type_ids }),
        (any::<u16>(), finite(), any::<u8>()).prop_map(
            |(flags, sound_velocity_m_per_s, filter)| Command::SoundVelocity {
                flags,
                sound_velocity_m_per_s,
                filter
            }
        ),
        any::<u32>().prop_map(|count| Command::PingTimes { count }),
        Just(Command::StopPinging),
    ]
}

proptest! {
    #[test]
    fn commands_survive_the_wire(command in commands(), ticket in any::<u32>(), tracking_number in any::<[u64; 2]>()) {
        let request = ControlRequest { ticket, tracking_number, command };
        let body = emitted_body(|buf| request.emit(buf, &STAMP));
        prop_assert_eq!(ControlRequest::parse(&body), Ok(request));
    }

    #[test]
    fn every_byte_of_a_fixed_record_survives_but_the_reserved(bytes in vec(any::<u8>(), 260)) {
        // NaNs are compared as bytes on the wire, not as numbers.
        let b = |len: usize| &bytes[..len];
        prop_assert_eq!(emitted_body(|buf| Position1003::parse(b(37)).unwrap().emit(buf, &STAMP)), b(37));
        prop_assert_eq!(emitted_body(|buf| RollPitchHeave1012::parse(b(12)).unwrap().emit(buf, &STAMP)), b(12));
        prop_assert_eq!(emitted_body(|buf| Heading1013::parse(b(4)).unwrap().emit(buf, &STAMP)), b(4));
        prop_assert_eq!(emitted_body(|buf| SoundVelocity7610::parse(b(12)).unwrap().emit(buf, &STAMP)), b(12));
        prop_assert_eq!(emitted_body(|buf| Ack7501::parse(b(20)).unwrap().emit(buf, &STAMP)), b(20));
        prop_assert_eq!(emitted_body(|buf| Nack7502::parse(b(24)).unwrap().emit(buf, &STAMP)), b(24));
        let expected = with_zeros(b(156), &[44..46, 154..156]);
        prop_assert_eq!(emitted_body(|buf| SonarSettings7000::parse(b(156)).unwrap().emit(buf, &STAMP)), expected);
        let expected = with_zeros(b(260), &[42..44, 208..216, 221..222]);
        prop_assert_eq!(emitted_body(|buf| RemoteSettings7503::parse(b(260)).unwrap().emit(buf, &STAMP)), expected);
    }

    #[test]
    fn raw_iq_survives_in_either_order(
        elements in 1_usize..70,
        samples in 1_usize..70,
        start_sample in 0_u32..1000,
        seed in any::<u32>(),
    ) {
        let value = |sample: usize, element: usize| {
            let mixed = seed.wrapping_add((sample * 1000 + element) as u32).wrapping_mul(2_654_435_761);
            [mixed as i16, (mixed >> 16) as i16]
        };
        let sample_major: Vec<_> = (0..samples).flat_map(|s| (0..elements).map(move |e| value(s, e))).collect();
        let element_major: Vec<_> = (0..elements).flat_map(|e| (0..samples).map(move |s| value(s, e))).collect();
        let numbers: Vec<u16> = (0..elements as u16).rev().collect();
        let rth = Rth7038 {
            sonar_serial: 1,
            ping_number: 2,
            channel_count: 256,
            samples: 5000,
            elements: elements as u16,
            start_sample,
            stop_sample: start_sample + samples as u32 - 1,
            sample_type: SAMPLE_TYPE_I16,
        };
        let body = emitted_body(|buf| emit_7038(buf, &STAMP, &rth, &numbers, &sample_major));
        prop_assert_eq!(&body, &emitted_body(|buf| emit_7038_element_major(buf, &STAMP, &rth, &numbers, &element_major)));
        let record = RawIq7038::parse(&body).unwrap();
        prop_assert_eq!(record.rth, rth);
        prop_assert_eq!(record.element_numbers().collect::<Vec<_>>(), numbers);
        prop_assert_eq!(record.iq((samples - 1) as u32, (elements - 1) as u16), Some(value(samples - 1, elements - 1)));
        prop_assert_eq!(record.iq_sample_major().collect::<Vec<_>>(), sample_major);
    }

    #[test]
    fn beams_and_sides_survive(values in vec((any::<u16>(), any::<i16>()), 1..600), beams in 1_u16..20, sonar_id in any::<u64>()) {
        let samples = values.len() / usize::from(beams);
        let beam_samples: Vec<_> =
            values[..samples * usize::from(beams)].iter().map(|&(amplitude, phase)| BeamSample { amplitude, phase }).collect();
        let rth = Rth7018 { sonar_id, ping_number: 1, multi_ping_sequence: 0, beams, samples: samples as u32 };
        let body = emitted_body(|buf| emit_7018(buf, &STAMP, &rth, &beam_samples));
        let record = Beamformed7018::parse(&body).unwrap();
        prop_assert_eq!(record.rth, rth);
        prop_assert_eq!(record.samples().collect::<Vec<_>>(), beam_samples);

        let port: Vec<u16> = values.iter().map(|value| value.0).collect();
        let starboard: Vec<u16> = values.iter().map(|value| value.1 as u16).collect();
        let sides = SideSamples::U16 { port: &port, starboard: &starboard };
        let body = emitted_body(|buf| emit_7007(buf, &STAMP, &Rth7007 { sonar_id, ..Rth7007::default() }, &sides));
        let record = SideScan7007::parse(&body).unwrap();
        prop_assert!(record.port().eq(port.iter().map(|&value| u32::from(value))));
        prop_assert!(record.starboard().eq(starboard.iter().map(|&value| u32::from(value))));
    }

    #[test]
    fn angles_survive(angles in vec(finite(), 1..400), sonar_id in any::<u64>()) {
        let negated: Vec<f32> = angles.iter().map(|angle| -angle).collect();
        let all = BeamAngles { along_track_rad: &angles, across_track_rad: &negated, width_y_rad: &negated, width_x_rad: &angles };
        let body = emitted_body(|buf| emit_7004(buf, &STAMP, sonar_id, &all));
        let record = BeamGeometry7004::parse(&body).unwrap();
        prop_assert_eq!(record.beams as usize, angles.len());
        for (beam, &angle) in (0..).zip(&angles) {
            prop_assert_eq!((record.along_track_rad(beam), record.across_track_rad(beam)), (Some(angle), Some(-angle)));
            prop_assert_eq!((record.width_y_rad(beam), record.width_x_rad(beam)), (Some(-angle), Some(angle)));
        }
    }

    #[test]
    fn modules_survive(modules in vec((any::<u32>(), "[^\0]{0,14}", any::<u32>(), any::<u64>(), "[^\0]{0,200}"), 0..4)) {
        let modules = modules
            .into_iter()
            .map(|(identifier, description, alphadata_card, serial_number, info_xml)| Module {
                identifier, description, alphadata_card, serial_number, info_xml,
            })
            .collect();
        let configuration = Configuration7001 { sonar_id: 3, modules };
        let body = emitted_body(|buf| configuration.emit(buf, &STAMP));
        prop_assert_eq!(Configuration7001::parse(&body), Ok(configuration));
    }

    #[test]
    fn any_body_of_any_type_is_read_and_described_without_panic(
        record_type_id in proptest::sample::select(OUR_TYPES.to_vec()),
        body in vec(prop_oneof![any::<u8>(), Just(0), Just(1), Just(16)], 0..500),
    ) {
        let record = record_of(record_type_id, &body);
        let parsed = Record::parse(&record).unwrap();
        if let Ok(RecordBody::RawIq(raw)) = RecordBody::parse(&parsed) {
            prop_assert!(raw.iq(u32::MAX, u16::MAX).is_none());
            prop_assert_eq!(raw.iq_sample_major().len() as u64, raw.rth.samples_present() * u64::from(raw.rth.elements));
        }
        if let Ok(RecordBody::FileCatalogue(catalogue)) = RecordBody::parse(&parsed) {
            prop_assert_eq!(catalogue.rows().count() as u32, catalogue.records);
        }
        let words = describe(&record).to_string();
        let beginning = format!("record {record_type_id} device 7125:1 at 2025-166");
        prop_assert!(words.starts_with(&beginning), "{}", words);
    }

    #[test]
    fn any_arguments_of_any_command_are_read_without_panic(
        id in prop_oneof![1000_u32..1130, Just(7042), Just(7610), any::<u32>()],
        arguments in vec(prop_oneof![any::<u8>(), Just(0)], 0..60),
    ) {
        if let Ok(command) = Command::parse(id, &arguments) {
            prop_assert_eq!(command.remote_control_id(), id);
            let mut out = Vec::new();
            command.emit_arguments(&mut out);
            prop_assert_eq!(Command::parse(id, &out), Ok(command));
        }
    }

    #[test]
    fn any_bytes_are_described_and_read_as_a_file_without_panic(
        bytes in vec(prop_oneof![any::<u8>(), Just(0), Just(5), Just(255)], 0..600),
        damage in vec((0_usize..300, any::<u8>()), 0..4),
    ) {
        let _ = describe(&bytes).to_string();
        let mut file = record_of(1013, &[0; 4]);
        file.extend_from_slice(&bytes);
        let end = record_of(7610, &[0; 12]);
        file.extend_from_slice(&end);
        for (at, value) in damage {
            // The last record is intact and must be found.
            let at = at % (file.len() - end.len());
            file[at] = value;
        }
        let mut reader = FileReader::new(&file);
        let records: Vec<_> = reader.by_ref().flatten().collect();
        let in_records: usize = records.iter().map(|found| found.record.bytes().len()).sum();
        prop_assert_eq!(reader.skipped_bytes() as usize + in_records, file.len());
        prop_assert_eq!(records.last().unwrap().record.bytes(), &end[..]);
        prop_assert!(in_records >= MIN_RECORD_BYTES && MIN_RECORD_BYTES == DATA_RECORD_FRAME_BYTES + 4);
    }
}
