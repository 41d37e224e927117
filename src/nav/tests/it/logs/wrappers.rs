//! Tests of one log in the formats of other recorders and with common file damage. Samples and times must be the same.

use chrono::{DateTime, TimeDelta, Utc};
use echotank_config::spec::{ChecksumPolicy, TimePolicy};
use echotank_core::navigation::NavSample;
use echotank_core::time::UtcNs;
use echotank_nav::log::read_log;
use echotank_nav::stamp::split_line;

use super::{bytes, spec};

/// Sentences of the log with their arrival times.
fn rows() -> Vec<(DateTime<Utc>, String)> {
    let text = String::from_utf8(bytes("nav/seapath330_90s.rvdas")).expect("ASCII");
    let row = |line: &str| {
        let (stamp, sentence) = line.split_once([' ', '\t']).expect("stamp and sentence");
        let at = DateTime::parse_from_rfc3339(stamp).expect("a stamp");
        let (_, same) = split_line(line.as_bytes());
        assert_eq!(same, sentence.as_bytes());
        (at.to_utc(), sentence.trim_end().to_owned())
    };
    text.lines().map(row).collect()
}

fn samples(log: &[u8]) -> Vec<NavSample> {
    let spec = spec(ChecksumPolicy::Require, TimePolicy::Burst);
    read_log(log, 0, &spec, 10.0).0
}

fn written(end: &str, line: impl Fn(&DateTime<Utc>, &str) -> String) -> Vec<u8> {
    let lines: String = rows()
        .iter()
        .map(|(at, sentence)| line(at, sentence) + end)
        .collect();
    lines.into_bytes()
}

/// Log in which each sentence follows a stamp in the given `chrono` format and the text `between`.
fn stamped(format: &str, between: &str) -> Vec<u8> {
    written("\n", |at, sentence| {
        format!("{}{between}{sentence}", at.format(format))
    })
}

#[test]
fn every_recorder_s_way_of_stamping_gives_the_same_samples_at_the_same_moments() {
    let want = samples(&bytes("nav/seapath330_90s.rvdas"));
    assert!(want.len() > 400, "{}", want.len());
    let later = |at: &DateTime<Utc>| *at + TimeDelta::hours(2);
    let cases: [(&str, Vec<u8>, f64); 16] = [
        (
            "DSLog",
            stamped("NMEA %Y/%m/%d %H:%M:%S%.3f GPS", " "),
            1e-3,
        ),
        ("SCS", stamped("%m/%d/%Y,%H:%M:%S%.3f", ","), 1e-3),
        ("RVDAS", stamped("%y+%j:%H:%M:%S%.3f", " "), 1e-3),
        ("LDS", stamped("%Y:%j:%H:%M:%S%.3f", " "), 1e-3),
        ("day first", stamped("%d.%m.%Y %H:%M:%S%.3f", ";"), 1e-3),
        ("brackets", stamped("[%Y-%m-%d %H:%M:%S%.3f]", " "), 1e-3),
        ("compact", stamped("%Y%m%dT%H%M%S%.6fZ", " "), 1e-6),
        (
            "Python's logging",
            stamped("%Y-%m-%d %H:%M:%S,%3f INFO nmea:", " "),
            1e-3,
        ),
        (
            "syslog",
            stamped("%b %d %H:%M:%S bridge gpsd[411]:", " "),
            1.0,
        ),
        ("tab", stamped("%Y-%m-%dT%H:%M:%S%.3f", "\t"), 1e-3),
        (
            "a name before",
            stamped("s330 %Y-%m-%dT%H:%M:%S%.6fZ", " "),
            1e-6,
        ),
        ("seconds", stamped("%s%.3f", " "), 1e-3),
        (
            "quotes",
            written("\n", |at, s| {
                format!("\"{}\",\"{s}\"", at.format("%Y-%m-%d %H:%M:%S%.3f"))
            }),
            1e-3,
        ),
        (
            "an offset",
            written("\n", |at, s| {
                format!("{}+02:00 {s}", later(at).format("%Y-%m-%dT%H:%M:%S%.6f"))
            }),
            1e-6,
        ),
        (
            "milliseconds",
            written("\n", |at, s| format!("{},{s}", at.timestamp_millis())),
            1e-3,
        ),
        (
            "a mark of the byte order, and CR LF",
            [
                b"\xEF\xBB\xBF".to_vec(),
                written("\r\n", |at, s| {
                    format!("{} {s}", at.format("%Y-%m-%dT%H:%M:%S%.6fZ"))
                }),
            ]
            .concat(),
            1e-6,
        ),
    ];
    for (name, log, step_s) in cases {
        let got = samples(&log);
        assert_eq!(got.len(), want.len(), "{name}");
        for (g, w) in got.iter().zip(&want) {
            assert_eq!(
                (g.quantity, g.valid_utc),
                (w.quantity, w.valid_utc),
                "{name}"
            );
            let off_s = g.arrival_utc.seconds_since(w.arrival_utc);
            assert!(off_s.abs() <= step_s, "{name}: {off_s} s");
        }
    }
}

#[test]
fn without_stamps_the_samples_are_the_same_whatever_ends_the_lines() {
    let want = samples(&bytes("nav/seapath330_90s.rvdas"));
    for end in ["\n", "\r\n", "\r"] {
        let got = samples(&written(end, |_, s| s.to_owned()));
        assert_eq!(got.len(), want.len(), "{end:?}");
        for (g, w) in got.iter().zip(&want) {
            assert_eq!(
                (g.quantity, g.valid_utc),
                (w.quantity, w.valid_utc),
                "{end:?}"
            );
        }
    }
    // Stamps in TAG blocks.
    let tagged = written("\r\n", |at, s| {
        let tag = format!("s:IN0001,c:{}", at.timestamp());
        let sum = tag.bytes().fold(0, |a, b| a ^ b);
        format!("\\{tag}*{sum:02X}\\{s}")
    });
    assert_eq!(samples(&tagged).len(), want.len());
}

#[test]
fn truncation_of_a_log_loses_only_the_truncated_sentences() {
    let whole = written("\n", |at, s| {
        format!("{} {s}", at.format("%Y-%m-%dT%H:%M:%S%.6fZ"))
    });
    let want = samples(&whole);
    let torn = samples(&whole[37..whole.len() - 21]);
    // The first sentence is the only ZDA of its burst. The last sentence is an attitude and gives roll, pitch and heave.
    assert!(
        (want.len() - 5..want.len()).contains(&torn.len()),
        "{} of {}",
        torn.len(),
        want.len()
    );
    for sample in &torn {
        assert!(
            want.iter()
                .any(|w| (w.quantity, w.valid_utc) == (sample.quantity, sample.valid_utc))
        );
    }
    assert!(torn.iter().all(|s| s.valid_utc > UtcNs(0)));
}
