//! Compares 7k records of navigation, detections, snippets, water column and calibrated side-scan with the tables of DFD 3.12, and parses
//! random bytes.

use std::ops::Range;

use crate::support::{STAMP, assert_same, le, record_of, table};
use echotank_protocols::sevenk::records::*;
use echotank_protocols::sevenk::{Record, RecordBody, WireError, describe};
use proptest::prelude::*;

/// The body of an emitted record, parsed as its type.
fn check(id: u32, golden: &[u8], emit: impl FnOnce(&mut Vec<u8>) -> Range<usize>) {
    let mut buf = vec![1, 2, 3];
    let range = emit(&mut buf);
    let record = Record::parse(&buf[range]).unwrap();
    assert_eq!(record.frame.record_type_id, id);
    assert_same(record.body(), golden, &id.to_string());
    assert!(!matches!(
        RecordBody::parse(&record).unwrap(),
        RecordBody::Other(_)
    ));
    assert!(!describe(record.bytes()).to_string().contains("wrong"));
}

fn le_f32(values: &[f32]) -> Vec<u8> {
    le(values)
}

/// Sonar 77, ping 7, no multi-ping: the common start of these records.
fn head() -> Vec<u8> {
    [&77_u64.to_le_bytes()[..], &7_u32.to_le_bytes(), &[0, 0]].concat()
}

#[test]
fn beams_ordered_by_beam_give_the_same_bytes() {
    let (beams, samples, silent) = (19, 70, 3);
    let sample = |beam: usize, k: usize| BeamSample {
        amplitude: (beam * 1000 + k) as u16,
        phase: (k * 31) as i16 - (beam * 77) as i16,
    };
    let by_beam: Vec<_> = (0..beams * samples)
        .map(|n| sample(n / samples, n % samples))
        .collect();
    let silence = std::iter::repeat_n(BeamSample::default(), silent * beams);
    let by_sample: Vec<_> = silence
        .chain((0..beams * samples).map(|n| sample(n % beams, n / beams)))
        .collect();
    let rth = Rth7018 {
        beams: beams as u16,
        samples: (silent + samples) as u32,
        ..Rth7018::default()
    };
    let (mut got, mut want) = (Vec::new(), Vec::new());
    emit_7018_beam_major(&mut got, &STAMP, &rth, silent, &by_beam);
    emit_7018(&mut want, &STAMP, &rth, &by_sample);
    assert_same(&got, &want, "7018");

    // Beam b of 7042 has 70 - b samples.
    let rows: Vec<_> = by_beam
        .chunks(samples)
        .enumerate()
        .map(|(beam, row)| &row[..samples - beam])
        .collect();
    let numbers: Vec<(Vec<u32>, Vec<i16>)> = rows
        .iter()
        .map(|row| {
            row.iter()
                .map(|s| (u32::from(s.amplitude), s.phase))
                .unzip()
        })
        .collect();
    let all: Vec<_> = numbers
        .iter()
        .enumerate()
        .map(|(beam, (magnitudes, phases))| BeamSamples {
            beam: beam as u16,
            segment: 0,
            magnitudes,
            phases,
        })
        .collect();
    let rth = Rth7042 {
        flags: flags_7042::LIMITED_BY_DETECTION,
        ..Rth7042::default()
    };
    let (mut got, mut want) = (Vec::new(), Vec::new());
    emit_7042_of_16_bits(&mut got, &STAMP, &rth, rows.into_iter());
    emit_7042(&mut want, &STAMP, &rth, &all);
    assert_same(&got, &want, "7042");
}

#[test]
fn navigation_1015_and_attitude_1016_match_tables_32_to_34() {
    let golden = table(
        41,
        &[
            (0, &[1]),
            (1, &(-0.64_f64).to_le_bytes()),
            (9, &(-2.1_f64).to_le_bytes()),
            (17, &le_f32(&[0.5, 12.5, 0.75, 1.5, 3.0, 6.25])),
        ],
    );
    let navigation = Navigation1015 {
        vertical_reference: 1,
        latitude_rad: -0.64,
        longitude_rad: -2.1,
        horizontal_accuracy_m: 0.5,
        height_m: 12.5,
        height_accuracy_m: 0.75,
        speed_over_ground_m_per_s: 1.5,
        course_over_ground_rad: 3.0,
        heading_rad: 6.25,
    };
    check(1015, &golden, |buf| navigation.emit(buf, &STAMP));
    assert_eq!(Navigation1015::parse(&golden), Ok(navigation));

    let sets = [0_u16, 10].map(|after_ms| AttitudeSet {
        after_ms,
        roll_rad: 0.1,
        pitch_rad: 0.05,
        heave_up_m: -0.25,
        heading_rad: 6.25,
    });
    let set = le_f32(&[0.1, 0.05, -0.25, 6.25]);
    let golden = table(37, &[(0, &[2]), (3, &set), (19, &[10, 0]), (21, &set)]);
    check(1016, &golden, |buf| emit_1016(buf, &STAMP, &sets));
    assert_eq!(
        Attitude1016::parse(&golden)
            .unwrap()
            .sets()
            .collect::<Vec<_>>(),
        sets
    );
}

#[test]
fn detections_7027_match_tables_72_and_73_and_longer_ones_parse() {
    let detection = Detection7027 {
        beam: 3,
        detection_sample: 1234.5,
        rx_angle_rad: -0.5,
        flags: 5,
        quality: 3,
        uncertainty: 0.001,
        intensity: 99.0,
        min_limit_sample: 1000.0,
        max_limit_sample: 1500.0,
    };
    let rth = Rth7027 {
        sonar_id: 77,
        ping_number: 7,
        detection_algorithm: 2,
        flags: 1 << 6,
        sampling_rate_hz: 34_483.0,
        tx_angle_rad: 0.1,
        applied_roll_rad: 0.2,
        ..Rth7027::default()
    };
    let of_size = |size: usize| {
        let at = 99 + size;
        table(
            99 + 2 * size,
            &[
                (0, &head()),
                (14, &le(&[2, size as u32])),
                (22, &[2]),
                (23, &le(&[64])),
                (27, &le_f32(&[34_483.0, 0.1, 0.2])),
                (99, &[3, 0]),
                (101, &le_f32(&[1234.5, -0.5])),
                (109, &le(&[5, 3])),
                (117, &le_f32(&[0.001, 99.0, 1000.0, 1500.0])),
                (at, &[4, 0]),
                (at + 2, &le_f32(&[1234.5, -0.5])),
                (at + 10, &le(&[5, 3])),
                (at + 18, &le_f32(&[0.001, 99.0, 1000.0, 1500.0])),
            ],
        )
    };
    let detections = [
        detection,
        Detection7027 {
            beam: 4,
            ..detection
        },
    ];
    check(7027, &of_size(34), |buf| {
        emit_7027(buf, &STAMP, &rth, &detections)
    });
    for size in [34, 38] {
        let golden = of_size(size);
        let read = RawDetections7027::parse(&golden).unwrap();
        assert_eq!(
            read.detections().collect::<Vec<_>>(),
            detections,
            "of {size} bytes"
        );
    }
    let mut short = of_size(34);
    short[18] = 33;
    assert!(matches!(
        RawDetections7027::parse(&short),
        Err(WireError::Unsupported { got: 33, .. })
    ));
}

const DESCRIPTORS: [SnippetDescriptor; 3] = [
    SnippetDescriptor {
        beam: 1,
        start_sample: 100,
        detection_sample: 101,
        end_sample: 102,
    },
    // No samples: the start is after the end.
    SnippetDescriptor {
        beam: 2,
        start_sample: 1257,
        detection_sample: 0,
        end_sample: 1256,
    },
    SnippetDescriptor {
        beam: 3,
        start_sample: 200,
        detection_sample: 201,
        end_sample: 201,
    },
];

fn descriptor_bytes() -> Vec<u8> {
    table(
        42,
        &[
            (0, &[1, 0]),
            (2, &le(&[100, 101, 102])),
            (14, &[2, 0]),
            (16, &le(&[1257, 0, 1256])),
            (28, &[3, 0]),
            (30, &le(&[200, 201, 201])),
        ],
    )
}

#[test]
fn snippets_7028_match_tables_75_and_76_in_both_widths() {
    let rth = Rth7028 {
        sonar_id: 77,
        ping_number: 7,
        control_flags: 5,
        ..Rth7028::default()
    };
    let head = |flags: u32| {
        table(
            46,
            &[(0, &head()), (14, &[3, 0, 0, 5]), (18, &le(&[flags]))],
        )
    };
    let samples = [1_u16, 2, 3, 4, 60_000];
    let bytes: Vec<u8> = samples.iter().flat_map(|s| s.to_le_bytes()).collect();
    let narrow = [head(0), descriptor_bytes(), bytes].concat();
    check(7028, &narrow, |buf| {
        emit_7028(
            buf,
            &STAMP,
            &rth,
            &DESCRIPTORS,
            SnippetSamples::U16(&samples),
        )
    });
    let wide_samples = samples.map(u32::from);
    let wide = [head(1), descriptor_bytes(), le(&wide_samples)].concat();
    check(7028, &wide, |buf| {
        emit_7028(
            buf,
            &STAMP,
            &rth,
            &DESCRIPTORS,
            SnippetSamples::U32(&wide_samples),
        )
    });
    for golden in [&narrow, &wide] {
        let read = Snippets7028::parse(golden).unwrap();
        let got: Vec<_> = read
            .snippets()
            .map(|(d, samples)| (d, samples.collect::<Vec<_>>()))
            .collect();
        assert_eq!(
            got,
            [
                (DESCRIPTORS[0], vec![1, 2, 3]),
                (DESCRIPTORS[1], vec![]),
                (DESCRIPTORS[2], vec![4, 60_000])
            ]
        );
    }
}

#[test]
fn strengths_7058_match_tables_101_and_102_with_and_without_footprints() {
    let rth = Rth7058 {
        sonar_id: 77,
        ping_number: 7,
        control_flags: 1 << 8,
        absorption_db_per_km: 90.0,
        ..Rth7058::default()
    };
    let head = |flags: u32| {
        table(
            49,
            &[
                (0, &head()),
                (14, &[3, 0, 0]),
                (17, &le(&[flags])),
                (21, &le_f32(&[90.0])),
            ],
        )
    };
    let strengths = [-20.0, -21.0, -22.0, -30.0, -31.0];
    let areas = [0.1, 0.2, 0.3, 0.4, 0.5];
    let without = [head(0x100), descriptor_bytes(), le_f32(&strengths)].concat();
    check(7058, &without, |buf| {
        emit_7058(buf, &STAMP, &rth, &DESCRIPTORS, &strengths, None)
    });
    let with = [
        head(0x140),
        descriptor_bytes(),
        le_f32(&strengths),
        le_f32(&areas),
    ]
    .concat();
    check(7058, &with, |buf| {
        emit_7058(buf, &STAMP, &rth, &DESCRIPTORS, &strengths, Some(&areas))
    });
    for (golden, has_areas) in [(&without, false), (&with, true)] {
        let read = SnippetStrengths7058::parse(golden).unwrap();
        let got: Vec<Vec<f32>> = read
            .strengths_db()
            .map(|(_, values)| values.collect())
            .collect();
        assert_eq!(got, [&strengths[..3], &[], &strengths[3..]]);
        let got: Vec<Vec<f32>> = read
            .footprints_m2()
            .map(|(_, values)| values.collect())
            .collect();
        let expected: Vec<Vec<f32>> = match has_areas {
            true => vec![areas[..3].to_vec(), vec![], areas[3..].to_vec()],
            false => vec![],
        };
        assert_eq!(got, expected);
    }
}

#[test]
fn water_column_7042_matches_tables_83_and_84_in_all_six_widths() {
    use flags_7042::*;
    let beams = [
        BeamSamples {
            beam: 0,
            segment: 9,
            magnitudes: &[0x11, 0x1234_5678],
            phases: &[0x0102, -0x0100],
        },
        BeamSamples {
            beam: 1,
            segment: 8,
            magnitudes: &[0x22],
            phases: &[0x7FFF],
        },
    ];
    // Magnitude and phase of the three samples. Values beyond a width are clipped; an 8-bit phase is the upper half.
    let cases: [(u32, [&[u8]; 3]); 6] = [
        (
            0,
            [
                &[0x11, 0, 2, 1],
                &[0xFF, 0xFF, 0x00, 0xFF],
                &[0x22, 0, 0xFF, 0x7F],
            ],
        ),
        (MAGNITUDE_ONLY, [&[0x11, 0], &[0xFF, 0xFF], &[0x22, 0]]),
        (DB_IN_8_BITS, [&[0x11, 1], &[0xFF, 0xFF], &[0x22, 0x7F]]),
        (DB_IN_8_BITS | MAGNITUDE_ONLY, [&[0x11], &[0xFF], &[0x22]]),
        (
            MAGNITUDE_IN_32_BITS,
            [
                &[0x11, 0, 0, 0, 1],
                &[0x78, 0x56, 0x34, 0x12, 0xFF],
                &[0x22, 0, 0, 0, 0x7F],
            ],
        ),
        (
            MAGNITUDE_IN_32_BITS | MAGNITUDE_ONLY,
            [
                &[0x11, 0, 0, 0],
                &[0x78, 0x56, 0x34, 0x12],
                &[0x22, 0, 0, 0],
            ],
        ),
    ];
    for (width_flags, samples) in cases {
        for segments in [0, SEGMENTS] {
            let flags = width_flags | segments | 4 << DIVISOR_SHIFT;
            let rth = Rth7042 {
                sonar_id: 77,
                ping_number: 7,
                samples: 1000,
                flags,
                first_sample: 5,
                sample_rate_hz: 8620.75,
                compression_factor: 2.0,
                ..Rth7042::default()
            };
            let head = table(
                44,
                &[
                    (0, &head()),
                    (14, &[2, 0]),
                    (16, &le(&[1000, 2, flags, 5])),
                    (32, &le_f32(&[8620.75, 2.0])),
                ],
            );
            let segment = |number: u8| if segments == 0 { vec![] } else { vec![number] };
            let golden = [
                head,
                vec![0, 0],
                segment(9),
                le(&[2]),
                samples[0].to_vec(),
                samples[1].to_vec(),
                vec![1, 0],
                segment(8),
                le(&[1]),
                samples[2].to_vec(),
            ]
            .concat();
            check(7042, &golden, |buf| emit_7042(buf, &STAMP, &rth, &beams));
            let read = WaterColumn7042::parse(&golden).unwrap();
            let got: Vec<_> = read
                .beams()
                .map(|b| (b.beam, b.segment, b.samples().len()))
                .collect();
            let number = |n: u8| if segments == 0 { 0 } else { n };
            assert_eq!(got, [(0, number(9), 2), (1, number(8), 1)]);
            let (magnitude, phase) = read.beams().next().unwrap().samples().next().unwrap();
            let expected =
                match width_flags & (MAGNITUDE_ONLY | DB_IN_8_BITS | MAGNITUDE_IN_32_BITS) {
                    0 => 0x0102,
                    flags if flags & MAGNITUDE_ONLY != 0 => 0,
                    _ => 0x0100,
                };
            assert_eq!((magnitude, phase), (0x11, expected));
        }
    }
    let mut contradiction = vec![0; 44];
    contradiction[24..28].copy_from_slice(&(DB_IN_8_BITS | MAGNITUDE_IN_32_BITS).to_le_bytes());
    assert!(matches!(
        WaterColumn7042::parse(&contradiction),
        Err(WireError::Unsupported { .. })
    ));
}

#[test]
fn calibrated_side_scan_7057_and_raw_iq_10038_match_their_tables() {
    let rth = Rth7057 {
        sonar_id: 77,
        ping_number: 7,
        beam_position_m: 0.5,
        error_flag: 1,
        ..Rth7057::default()
    };
    let golden = [
        table(
            65,
            &[
                (0, &head()),
                (14, &le_f32(&[0.5])),
                (22, &le(&[2])),
                (58, &[1, 0]),
                (62, &[4, 0, 1]),
            ],
        ),
        le_f32(&[1.0, 2.0, 3.0, 4.0]),
        vec![10, 0, 11, 0, 12, 0, 13, 0],
    ]
    .concat();
    let port = CalibratedSide {
        samples: &[1.0, 2.0],
        beams: &[10, 11],
    };
    let starboard = CalibratedSide {
        samples: &[3.0, 4.0],
        beams: &[12, 13],
    };
    check(7057, &golden, |buf| {
        emit_7057(buf, &STAMP, &rth, port, starboard)
    });
    let read = CalibratedSideScan7057::parse(&golden).unwrap();
    assert_eq!(read.port().collect::<Vec<_>>(), [(1.0, 10), (2.0, 11)]);
    assert_eq!(read.starboard().collect::<Vec<_>>(), [(3.0, 12), (4.0, 13)]);
    // Double precision is parsed but not emitted.
    let mut wide = golden[..65].to_vec();
    (wide[22], wide[62]) = (1, 8);
    wide.extend([5_f64, 6.0].iter().flat_map(|v| v.to_le_bytes()));
    wide.extend([1, 0, 2, 0]);
    let read = CalibratedSideScan7057::parse(&wide).unwrap();
    assert_eq!(
        (read.port().next(), read.starboard().next()),
        (Some((5.0, 1)), Some((6.0, 2)))
    );

    let rth = Rth10038 {
        ping_number: 7,
        mean_sound_velocity_m_per_s: 1500.0,
        draft_not_applied_m: 1.0,
        sample_rate_hz: 34_483.0,
        effective_pulse_length_s: 5e-4,
        start_sample_delay_s: 1e-3,
        full_scale: 2.0,
        ..Rth10038::default()
    };
    let golden = [
        table(
            120,
            &[
                (0, &le(&[7, 0])),
                (8, &le_f32(&[1500.0, 1.0, 34_483.0, 5e-4, 1e-3])),
                (28, &le(&[64])),
                (32, &le_f32(&[2.0])),
                (36, &le(&[2])),
            ],
        ),
        le_f32(&[0.5, -0.5, 1.5, -1.5]),
    ]
    .concat();
    let iq = [[0.5, -0.5], [1.5, -1.5]];
    check(10_038, &golden, |buf| emit_10038(buf, &STAMP, &rth, &iq));
    assert_eq!(
        SingleBeamIq10038::parse(&golden)
            .unwrap()
            .iq()
            .collect::<Vec<_>>(),
        iq
    );
}

pub(crate) const TYPES: [(u32, usize); 8] = [
    (1015, 41),
    (1016, 1),
    (7027, 99),
    (7028, 46),
    (7042, 44),
    (7057, 65),
    (7058, 49),
    (10_038, 120),
];

#[test]
fn wild_counts_are_refused() {
    let truncated = |result: Result<(), WireError>| {
        assert!(
            matches!(result, Err(WireError::Truncated { .. })),
            "{result:?}"
        );
    };
    let mut body = vec![0xFF; 200];
    truncated(Attitude1016::parse(&body).map(|_| ()));
    truncated(RawDetections7027::parse(&body).map(|_| ()));
    truncated(Snippets7028::parse(&body).map(|_| ()));
    truncated(SnippetStrengths7058::parse(&body).map(|_| ()));
    body[24..28].fill(0);
    truncated(WaterColumn7042::parse(&body).map(|_| ()));
    body[62] = 8;
    truncated(CalibratedSideScan7057::parse(&body).map(|_| ()));
    body[28..32].copy_from_slice(&64_u32.to_le_bytes());
    truncated(SingleBeamIq10038::parse(&body).map(|_| ()));
}

proptest! {
    #[test]
    fn no_bytes_make_a_parser_panic(which in 0..8_usize, mut body in proptest::collection::vec(any::<u8>(), 0..400), is_small: bool) {
        let (id, rth_bytes) = TYPES[which];
        if is_small && body.len() >= rth_bytes && id != 1015 {
            // Counts that the bytes may contain.
            let at = match id { 1016 => 0..1, 7027 => 15..22, 7028 | 7058 => 15..16, 7042 => 15..16, 7057 => 23..26, _ => 37..40 };
            body[at].fill(0);
            match id { 7027 => body[18] = 34, 7057 => body[62] = 4, 10_038 => body[28..32].copy_from_slice(&[64, 0, 0, 0]), _ => {} }
        }
        let record = record_of(id, &body);
        let words = describe(&record).to_string();
        prop_assert!(!words.is_empty());
        match RecordBody::parse(&Record::parse(&record).unwrap()) {
            Ok(RecordBody::Attitude(read)) => prop_assert!(read.sets().count() * 18 < body.len()),
            Ok(RecordBody::RawDetections(read)) => prop_assert!(read.detections().count() * 34 <= body.len()),
            Ok(RecordBody::Snippets(read)) => {
                prop_assert!(read.snippets().map(|(_, s)| s.count()).sum::<usize>() * 2 <= body.len());
            }
            Ok(RecordBody::SnippetStrengths(read)) => {
                prop_assert!(read.strengths_db().map(|(_, s)| s.count()).sum::<usize>() * 4 <= body.len());
                let _ = read.footprints_m2().map(|(_, s)| s.count()).sum::<usize>();
            }
            Ok(RecordBody::WaterColumn(read)) => {
                prop_assert_eq!(read.beams().count(), usize::from(read.rth.beams));
                prop_assert!(read.beams().map(|b| b.samples().len()).sum::<usize>() <= body.len());
            }
            Ok(RecordBody::CalibratedSideScan(read)) => prop_assert!((read.port().count() + read.starboard().count()) * 6 <= body.len()),
            Ok(RecordBody::SingleBeamIq(read)) => prop_assert!(read.iq().len() * 8 <= body.len()),
            _ => {}
        }
    }

    #[test]
    fn snippets_of_any_lengths_round_trip(lengths in proptest::collection::vec(0..20_u32, 0..12)) {
        let descriptors: Vec<SnippetDescriptor> = lengths.iter().enumerate().map(|(i, &len)| SnippetDescriptor {
            beam: i as u16, start_sample: 100, detection_sample: 100, end_sample: 99 + len,
        }).collect();
        let samples: Vec<u16> = (0..lengths.iter().sum::<u32>()).map(|n| n as u16).collect();
        let mut buf = Vec::new();
        let range = emit_7028(&mut buf, &STAMP, &Rth7028::default(), &descriptors, SnippetSamples::U16(&samples));
        let record = Record::parse(&buf[range]).unwrap();
        let read = Snippets7028::parse(record.body()).unwrap();
        let got: Vec<u32> = read.snippets().flat_map(|(_, s)| s).collect();
        prop_assert_eq!(got, samples.iter().map(|&s| u32::from(s)).collect::<Vec<_>>());
        prop_assert_eq!(read.snippets().map(|(d, _)| d).collect::<Vec<_>>(), descriptors);
    }
}
