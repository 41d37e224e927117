//! Tests of decoding: recorded logs, epochs, signs, policies, and random bytes.

use echotank_config::spec::{ChecksumPolicy, NavChannel, NavSourceSpec, TimePolicy};
use echotank_core::navigation::{NavQuantity, NavSample};
use echotank_core::time::{NS_PER_S, UtcNs};
use echotank_nav::log::read_log;
use echotank_nav::stamp::split_line;
use echotank_nav::{NavCounters, NavDecoder};
use proptest::prelude::*;

use crate::{ALL, log_source, sum_of_classes};

const SEAPATH: &[u8] = include_bytes!("../../../../tests/data/nav/seapath330_90s.rvdas");
const GYRO: &[u8] = include_bytes!("../../../../tests/data/nav/gyro_90s.rvdas");
const HYDROBALL: &[u8] = include_bytes!("../../../../tests/data/nav/hydroball_22s.txt");

/// 2014-08-01.
const DAY: UtcNs = UtcNs(1_406_851_200 * NS_PER_S);

fn source(time: TimePolicy, checksum: ChecksumPolicy, provides: &[NavChannel]) -> NavSourceSpec {
    NavSourceSpec {
        time,
        checksum,
        ..log_source(provides)
    }
}

fn check_sum(c: &NavCounters) {
    let classes = sum_of_classes(c);
    assert_eq!(
        classes, c.sentences,
        "every sentence is in one class: {c:?}"
    );
}

#[test]
fn seapath_counts_equal_an_independent_count() {
    let spec = source(TimePolicy::Burst, ChecksumPolicy::Require, &ALL);
    let (samples, counters, log) = read_log(SEAPATH, 0, &spec, 0.0);
    let lines = String::from_utf8_lossy(SEAPATH);
    let count = |word: &str| lines.lines().filter(|l| l.contains(word)).count() as u64;
    assert_eq!(log.lines, 720);
    assert_eq!((log.stamped, log.backward), (720, 0));
    assert_eq!(counters.sentences, count("$"));
    assert_eq!(counters.unsupported, 0);
    // VTG and HDT are active until RMC and PSXN arrive. PSXN,22 has no used value; PSXN,20 has quality flags.
    assert_eq!(
        counters.not_taken,
        count("HDT") - 1 + count("VTG") - 1 + count("PSXN,22")
    );
    assert_eq!(
        counters.used,
        count("ZDA") + count("GGA") + count("RMC") + count("PSXN,23") + count("PSXN,20") + 2
    );
    assert_eq!(
        (
            counters.bad_checksum,
            counters.malformed,
            counters.resync_bytes
        ),
        (0, 0, 0)
    );
    let of = |channel: fn(&NavQuantity) -> bool| {
        samples.iter().filter(|s| channel(&s.quantity)).count() as u64
    };
    assert_eq!(
        of(|q| matches!(q, NavQuantity::Position { .. })),
        count("GGA")
    );
    assert_eq!(
        of(|q| matches!(q, NavQuantity::RollPitch { .. })),
        count("PSXN,23")
    );
    check_sum(&counters);
}

/// PSXN,23 has no time and is logged 0.36 s after the GGA of its epoch.
#[test]
fn psxn_23_gets_the_epoch_of_the_gga_of_its_burst() {
    let spec = source(TimePolicy::Burst, ChecksumPolicy::Require, &ALL);
    let (samples, counters, _) = read_log(SEAPATH, 0, &spec, 0.0);
    let mut gga = None;
    let mut seen = 0;
    for sample in &samples {
        match sample.quantity {
            NavQuantity::Position { .. } => gga = Some(sample.valid_utc),
            NavQuantity::RollPitch { .. } => {
                assert_eq!(Some(sample.valid_utc), gga);
                let lag_s = sample.arrival_utc.seconds_since(sample.valid_utc);
                assert!((0.355..0.370).contains(&lag_s), "lag {lag_s}");
                seen += 1;
            }
            _ => {}
        }
    }
    assert_eq!((seen, counters.undated), (90, 0));
    assert_eq!(samples[0].valid_utc, DAY.plus_ns(160_000_000));

    let spec = source(
        TimePolicy::Arrival { latency_s: 0.25 },
        ChecksumPolicy::Require,
        &ALL,
    );
    let (samples, ..) = read_log(SEAPATH, 0, &spec, 0.0);
    assert!(
        samples
            .iter()
            .all(|s| s.valid_utc == s.arrival_utc.plus_ns(-250_000_000))
    );
}

/// Independent decoder of the fields of the log: it splits at commas, parses and converts.
fn split_by_hand(sentence: &str) -> Vec<(&'static str, Vec<f64>)> {
    let body = sentence.trim().split('*').next().unwrap_or("");
    let f: Vec<&str> = body.split(',').collect();
    let n = |i: usize| f[i].parse::<f64>().expect("a number in the log");
    let angle = |i: usize| {
        let dot = f[i].find('.').expect("decimals");
        let degrees: f64 = f[i][..dot - 2].parse().expect("degrees");
        let minutes: f64 = f[i][dot - 2..].parse().expect("minutes");
        let sign = if matches!(f[i + 1], "S" | "W") {
            -1.0
        } else {
            1.0
        };
        sign * (degrees + minutes / 60.0)
    };
    match f[0] {
        "$INGGA" => vec![
            ("position", vec![angle(2), angle(4)]),
            ("height", vec![n(9)]),
        ],
        "$INRMC" => vec![("course", vec![n(8), n(7) * 1852.0 / 3600.0])],
        "$INVTG" => vec![("course", vec![n(1), n(5) * 1852.0 / 3600.0])],
        "$INHDT" | "$HEHDT" => vec![("heading", vec![n(1)])],
        "$PSXN" if f[1] == "23" => vec![
            ("heading", vec![n(4)]),
            ("roll_pitch", vec![n(2), n(3)]),
            ("heave", vec![n(5)]),
        ],
        _ => vec![],
    }
}

fn as_degrees(sample: &NavSample) -> Vec<(&'static str, Vec<f64>)> {
    match sample.quantity {
        NavQuantity::Position {
            latitude_rad,
            longitude_rad,
            height_m,
            ..
        } => vec![
            (
                "position",
                vec![latitude_rad.to_degrees(), longitude_rad.to_degrees()],
            ),
            ("height", height_m.into_iter().collect()),
        ],
        NavQuantity::CourseSpeed {
            course_rad,
            speed_m_per_s,
        } => vec![("course", vec![course_rad.to_degrees(), speed_m_per_s])],
        NavQuantity::Heading { heading_rad } => vec![("heading", vec![heading_rad.to_degrees()])],
        NavQuantity::RollPitch {
            roll_rad,
            pitch_rad,
        } => vec![(
            "roll_pitch",
            vec![roll_rad.to_degrees(), pitch_rad.to_degrees()],
        )],
        NavQuantity::Heave { heave_down_m } => vec![("heave", vec![heave_down_m])],
        NavQuantity::Depth { depth_m } => vec![("depth", vec![depth_m])],
        NavQuantity::LocalPosition { .. } => vec![],
    }
}

#[test]
fn samples_agree_with_an_independent_field_split() {
    // Course, speed, heading and height of the crate are f32: 2e-5 degrees at 360 degrees.
    let tolerance = |what: &str| match what {
        "position" => 1e-12,
        "course" | "heading" => 3e-5,
        "height" => 1e-6,
        _ => 1e-12,
    };
    let mut compared = 0;
    for log in [SEAPATH, GYRO] {
        for line in String::from_utf8_lossy(log).lines() {
            // Each sentence has its own decoder, so each sentence is active.
            let spec = source(TimePolicy::Message, ChecksumPolicy::Require, &ALL);
            let mut decoder = NavDecoder::new(0, &spec);
            let mut out = Vec::new();
            let (_, sentence) = split_line(line.as_bytes());
            decoder.push(sentence, DAY, &mut out);
            let mut got: Vec<_> = out.iter().flat_map(as_degrees).collect();
            got.retain(|(what, _)| {
                // RMC repeats the position without a height.
                !line.contains("RMC") || *what == "course"
            });
            let want = split_by_hand(std::str::from_utf8(sentence).expect("ASCII"));
            assert_eq!(got.len(), want.len(), "{line}: {got:?} against {want:?}");
            for ((what, got), (what2, want)) in got.iter().zip(&want) {
                assert_eq!(what, what2, "{line}");
                for (g, w) in got.iter().zip(want) {
                    assert!(
                        (g - w).abs() <= tolerance(what),
                        "{line}: {what} got {g} want {w}"
                    );
                    compared += 1;
                }
            }
        }
    }
    assert_eq!(compared, 90 * (3 + 2 + 2 + 1 + 4) + 450);
}

#[test]
fn lower_case_checksums_of_the_gyro_are_good() {
    let spec = source(TimePolicy::Message, ChecksumPolicy::Require, &ALL);
    let (samples, counters, _) = read_log(GYRO, 0, &spec, 0.0);
    assert_eq!(
        (samples.len(), counters.used, counters.bad_checksum),
        (450, 450, 0)
    );
    assert_eq!(samples[0].valid_utc, DAY.plus_ns(183_000_000));
}

#[test]
fn hydroball_wrong_checksums_follow_the_policy_and_its_date_is_found() {
    let lines = String::from_utf8_lossy(HYDROBALL);
    // Every checksum is 00; a few are correct by chance.
    let sum = |line: &str| {
        let body = line.split(['$', '*']).nth(1).unwrap_or("");
        body.bytes().fold(0, |sum, byte| sum ^ byte)
    };
    let wrong = lines
        .lines()
        .filter(|l| l.ends_with("*00") && sum(l) != 0)
        .count() as u64;
    assert!(wrong > 150);
    for (policy, refused) in [
        (ChecksumPolicy::AcceptMissing, wrong),
        (ChecksumPolicy::Ignore, 0),
    ] {
        let spec = source(TimePolicy::Burst, policy, &ALL);
        let (samples, counters, log) = read_log(HYDROBALL, 0, &spec, 0.0);
        assert_eq!(counters.refused_checksum, refused);
        assert_eq!(counters.bad_checksum, wrong);
        assert!(counters.missing_checksum > 20, "{counters:?}");
        assert!(log.backward > 10, "{log:?}");
        check_sum(&counters);
        // 2017-12-11 18:58:40; no line before the first RMC has this date.
        let is_fix = |s: &&NavSample| matches!(s.quantity, NavQuantity::Position { .. });
        let first = samples.iter().find(is_fix).expect("a fix");
        assert_eq!(first.valid_utc, UtcNs(1_513_018_720 * NS_PER_S));
        let lag_s = first.arrival_utc.seconds_since(first.valid_utc);
        assert!(
            lag_s.abs() < 0.1,
            "arrival stamps lie on the messages' day: {lag_s}"
        );
    }
}

#[test]
fn a_recorder_in_another_time_zone_is_shifted_onto_its_messages() {
    let log = "2023-09-01 15:56:44.626 | DEBUG | - $GPRMC,225644.620,A,4736.4517860,N,12220.4723668,W,0.1,194.8,010923,15.2,E,A*2C\n\
               2023-09-01 15:56:44.627 | DEBUG | - $GPHDT,,*4F\n\
               2023-09-01 15:56:44.751 | DEBUG | - $GPRMC,225644.760,A,4736.4517831,N,12220.4723680,W,0.1,200.6,010923,15.2,E,A*2B\n";
    let spec = source(TimePolicy::Message, ChecksumPolicy::Require, &ALL);
    let (samples, counters, _) = read_log(log.as_bytes(), 0, &spec, 0.0);
    assert_eq!((counters.used, counters.empty_fields), (2, 1));
    for sample in &samples {
        let lag_s = sample.arrival_utc.seconds_since(sample.valid_utc);
        assert!(
            (-0.01..0.01).contains(&lag_s),
            "seven hours less: lag {lag_s}"
        );
    }
}

#[test]
fn a_plain_log_arrives_as_its_messages_advance() {
    let plain: String = String::from_utf8_lossy(SEAPATH)
        .lines()
        .map(|l| format!("{}\r\n", l.split_once(' ').expect("stamped").1))
        .collect();
    let spec = source(TimePolicy::Burst, ChecksumPolicy::Require, &ALL);
    let (stamped, ..) = read_log(SEAPATH, 0, &spec, 0.0);
    let (plain, counters, log) = read_log(plain.as_bytes(), 0, &spec, 0.0);
    assert_eq!((log.stamped, counters.undated), (0, 0));
    assert_eq!(plain.len(), stamped.len());
    for (a, b) in plain.iter().zip(&stamped) {
        assert_eq!((a.valid_utc, a.quantity), (b.valid_utc, b.quantity));
        // ZDA is rounded up by 10 ms.
        let late_s = a.arrival_utc.seconds_since(a.valid_utc);
        assert!((0.0..0.011).contains(&late_s), "{late_s}");
    }
    assert!(plain.is_sorted_by_key(|s| s.arrival_utc));
}

#[test]
fn a_plain_log_without_any_time_arrives_at_its_rate() {
    let log = b"$HEHDT,218.53,T*12\n$HEHDT,218.53,T*12\n$HEHDT,218.53,T*12\n";
    let spec = source(TimePolicy::Message, ChecksumPolicy::Require, &ALL);
    let (samples, ..) = read_log(log, 0, &spec, 5.0);
    let times: Vec<i64> = samples.iter().map(|s| s.valid_utc.0).collect();
    assert_eq!(times, [0, 200_000_000, 400_000_000]);
}

#[test]
fn only_what_the_source_provides_is_emitted() {
    let provides = [NavChannel::Heave];
    let spec = source(TimePolicy::Burst, ChecksumPolicy::Require, &provides);
    let (samples, counters, _) = read_log(SEAPATH, 7, &spec, 0.0);
    assert_eq!(samples.len(), 90);
    assert!(
        samples
            .iter()
            .all(|s| s.source == 7 && matches!(s.quantity, NavQuantity::Heave { .. }))
    );
    check_sum(&counters);
}

#[test]
fn messages_report_their_arrival_and_whether_they_are_dated() {
    let spec = source(TimePolicy::Burst, ChecksumPolicy::Require, &ALL);
    let mut decoder = NavDecoder::new(0, &spec);
    let mut out = Vec::new();
    let arrival = DAY.plus_ns(5_000_000_000);
    assert_eq!(decoder.last_message_time(), None);
    decoder.push(
        b"$INGGA,000001.16,2200.113054,S,01756.360985,W,1,12,0.7,-3.05,M,4.67,M,,*69\r\n",
        arrival,
        &mut out,
    );
    assert_eq!(
        decoder.last_message_time(),
        Some((DAY.plus_ns(1_160_000_000), arrival))
    );
    assert!(!decoder.is_dated());
    decoder.push(b"$INZDA,000001.17,01,08,2014,,*7F\r\n", arrival, &mut out);
    assert!(decoder.is_dated());
}

fn mutated() -> impl Strategy<Value = Vec<u8>> {
    let lines: Vec<Vec<u8>> = SEAPATH
        .split_inclusive(|&b| b == b'\n')
        .take(16)
        .map(|l| split_line(l).1.to_vec())
        .chain([
            b"$PASHR,204132.040,010.99,T,+00.41,-00.75,-00.84,0.151,0.088,0.569,1,0*0D\r\n".to_vec(),
            b"UdPbC\0\\s:GN9999,n:216*0D\\$PASHR,114835.60,027.23,T,-75.83,,,3.158,,4.831,1,*22\r\n"
                .to_vec(),
        ])
        .collect();
    let line = proptest::sample::select(lines);
    let change = (any::<prop::sample::Index>(), any::<u8>(), 0..4u8);
    (line, prop::collection::vec(change, 0..4)).prop_map(|(mut line, changes)| {
        for (at, byte, how) in changes {
            if line.is_empty() {
                break;
            }
            let at = at.index(line.len());
            match how {
                0 => line[at] = byte,
                1 => line.truncate(at),
                2 => line.insert(at, byte),
                _ => {
                    line.remove(at);
                }
            }
        }
        line
    })
}

fn digest(bytes: &[u8], cut: usize, policy: ChecksumPolicy) -> (Vec<NavSample>, NavCounters) {
    let spec = source(TimePolicy::Burst, policy, &ALL);
    let mut decoder = NavDecoder::new(0, &spec);
    let mut out = Vec::new();
    for piece in bytes.chunks(cut) {
        decoder.push(piece, DAY, &mut out);
    }
    decoder.flush(&mut out);
    (out, *decoder.counters())
}

proptest! {
    #[test]
    fn random_bytes_never_panic(bytes in prop::collection::vec(any::<u8>(), 0..2000), cut in 1usize..300) {
        let (_, c) = digest(&bytes, cut, ChecksumPolicy::Ignore);
        check_sum(&c);
        prop_assert_eq!(c.bytes, bytes.len() as u64);
        prop_assert!(c.resync_bytes <= c.bytes);
        read_log(&bytes, 0, &source(TimePolicy::Burst, ChecksumPolicy::Ignore, &ALL), 1.0);
    }

    #[test]
    fn sentences_from_a_restricted_alphabet_never_panic(text in "([$!\\\\*,.0-9A-Z\r\n-]|GGA|RMC|ZDA|HDT|VTG|PSXN,23|PASHR|\\$GP){0,200}", cut in 1usize..50) {
        let (_, c) = digest(text.as_bytes(), cut, ChecksumPolicy::Ignore);
        check_sum(&c);
    }

    #[test]
    fn corrupted_sentences_never_panic_and_splits_do_not_matter(lines in prop::collection::vec(mutated(), 1..12), cut in 1usize..100) {
        let bytes = lines.concat();
        let whole = digest(&bytes, bytes.len().max(1), ChecksumPolicy::Ignore);
        check_sum(&whole.1);
        prop_assert_eq!(&digest(&bytes, cut, ChecksumPolicy::Ignore), &whole);
        for sample in &whole.0 {
            for (what, values) in as_degrees(sample) {
                prop_assert!(values.iter().all(|v| v.is_finite()), "{} {:?}", what, values);
            }
        }
        read_log(&bytes, 0, &source(TimePolicy::Message, ChecksumPolicy::Ignore, &ALL), 1.0);
    }
}
