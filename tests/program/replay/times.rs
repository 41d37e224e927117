//! Tests of replays of logs with gaps, several passes, and clocks that are wrong for a time.

use std::path::Path;
use std::process::Stdio;
use std::time::{Duration, Instant};

use chrono::{DateTime, TimeDelta, Utc};
use serde_json::Value;

use crate::{Ended, command};

/// 2014-08-01T10:00:00Z.
const START_S: i64 = 1_406_887_200;
/// Time limit of a replay of some hundred pings of two elements, far above the actual time.
const LIMIT: Duration = Duration::from_secs(120);

const RIG: &str = r#"
[nav]
[[nav.source]]
name = "ins"
kind = "log"
path = "nav.log"
[scene.seabed]
shape = "plane"
depth_m = 20.0
density_per_m2 = 0.1
[[sonar]]
name = "s"
[sonar.pulse]
kind = "cw"
center_frequency_khz = 100.0
duration_ms = 1.0
[[sonar.transmit]]
name = "tx"
[[sonar.receive]]
name = "rx"
elements = 2
spacing_m = 0.0075
[sonar.receiver]
sample_rate_khz = 10.0
rx_filter = "none"
[sonar.ping]
range_m = 40.0
rate_hz = 2.0
source_level_db = 210.0
"#;

/// RMC, GGA and PASHR at 10 Hz, at these seconds of the source's clock and `north_m` north of the origin.
fn sentences(shown_s: f64, north_m: f64) -> Vec<u8> {
    let utc = DateTime::<Utc>::from_timestamp(START_S, 0).expect("a time")
        + TimeDelta::milliseconds((shown_s * 1e3).round() as i64);
    let (time, date) = (utc.format("%H%M%S%.3f"), utc.format("%d%m%y"));
    let latitude = format!("54{:09.6},N", 18.0 + north_m / 1852.0);
    [
        format!("GPRMC,{time},A,{latitude},01006.000,E,4.0,000.0,{date},,,A"),
        format!("GPGGA,{time},{latitude},01006.000,E,4,12,0.7,1.0,M,40.0,M,,"),
        format!("PASHR,{time},000.00,T,+1.00,+2.00,+0.10,0.1,0.1,0.1,2,1"),
    ]
    .iter()
    .flat_map(|body| echotank_testing::nav::sentence(body))
    .collect()
}

/// Sentences of `seconds` with a clock that is `off_s` ahead.
fn run_of(seconds: std::ops::Range<u32>, off_s: f64) -> Vec<u8> {
    (seconds.start * 10..seconds.end * 10)
        .flat_map(|k| sentences(f64::from(k) / 10.0 + off_s, f64::from(k) * 0.2))
        .collect()
}

/// Replays a log within a time limit. Returns the result and the lines of `truth.jsonl`.
fn replay(log: &[u8], arguments: &[&str]) -> (Ended, Vec<Value>) {
    let folder = tempfile::tempdir().expect("a folder");
    std::fs::write(folder.path().join("nav.log"), log).expect("log");
    std::fs::write(folder.path().join("rig.toml"), RIG).expect("rig");
    let out = folder.path().join("out");
    let ended = in_time(
        command("replay")
            .arg(folder.path().join("rig.toml"))
            .args(["--quiet", "--formats", "npz", "--out"])
            .arg(&out)
            .args(arguments),
    );
    (ended, truth(&out))
}

fn truth(out: &Path) -> Vec<Value> {
    let text = std::fs::read_to_string(out.join("truth.jsonl")).unwrap_or_default();
    let lines = text.lines();
    lines
        .map(|line| serde_json::from_str(line).expect("JSON"))
        .collect()
}

/// A replay that hangs fails the test.
fn in_time(command: &mut std::process::Command) -> Ended {
    let mut child = command
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .expect("echotank starts");
    let began = Instant::now();
    while child.try_wait().expect("a child").is_none() {
        if began.elapsed() > LIMIT {
            child.kill().expect("ends");
            panic!("the replay stands still");
        }
        std::thread::sleep(Duration::from_millis(20));
    }
    let done = child.wait_with_output().expect("output");
    let text = |bytes| String::from_utf8(bytes).expect("UTF-8");
    Ended {
        code: done.status.code(),
        out: text(done.stdout),
        err: text(done.stderr),
    }
}

fn skipped(ended: &Ended) -> u64 {
    let (before, _) = ended.out.split_once(" skipped").expect("a count");
    let words = before.rsplit(' ').next();
    words.and_then(|n| n.parse().ok()).expect("a number")
}

fn north_m(ping: &Value) -> f64 {
    ping["pose"]["position_m"][0].as_f64().expect("north")
}

fn flags(ping: &Value) -> bool {
    let flags = ping["nav_flags"].as_array().into_iter().flatten();
    flags.into_iter().any(|flag| flag == "time-jumped")
}

#[test]
fn a_gap_longer_than_the_history_is_counted_and_passed_over() {
    for (gap_s, skipped_in_gap) in [(60.0, 110..=125), (40_000.0, 79_990..=80_005)] {
        let log = [run_of(0..20, 0.0), run_of(20..40, gap_s)].concat();
        let (ended, pings) = replay(&log, &[]);
        assert_eq!(ended.code, Some(0), "{}", ended.err);
        assert!((70..=80).contains(&pings.len()), "{} pings", pings.len());
        let last = pings.last().expect("a ping");
        assert!(north_m(last) > 70.0, "{}", north_m(last));
        assert!(skipped_in_gap.contains(&skipped(&ended)), "{}", ended.out);
        // A repeated log also continues.
        let repeated = ["--pings", "1..400", "--set", "nav.loop=true"];
        let (ended, pings) = replay(&log, &repeated);
        assert_eq!(ended.code, Some(0), "{}", ended.err);
        // Of a long gap, 60 s at both ends have ping numbers.
        let numbered = if gap_s > 100.0 { 110..=125 } else { 140..=162 };
        assert!(numbered.contains(&pings.len()), "{} pings", pings.len());
    }
}

#[test]
fn a_replay_without_a_ping_is_an_error() {
    let (ended, _) = replay(&run_of(0..20, 0.0), &["--pings", "9000..9001"]);
    assert_eq!(ended.code, Some(2), "{}", ended.out);
    let words = "--pings 9000..9001: the navigation holds only about ";
    assert!(ended.err.contains(words), "{}", ended.err);
}

#[test]
fn passes_are_played_one_after_the_other_and_nav_tells_them() {
    // The third pass has the times of the first on another track.
    let log = [
        run_of(0..20, 1000.0),
        run_of(20..40, 0.0),
        run_of(40..60, 960.0),
    ]
    .concat();
    let (ended, pings) = replay(&log, &[]);
    assert_eq!(ended.code, Some(0), "{}", ended.err);
    assert!((108..=121).contains(&pings.len()), "{} pings", pings.len());
    let track: Vec<_> = pings.iter().map(north_m).collect();
    assert!(track.windows(2).all(|w| w[1] > w[0]), "{track:?}");
    assert!(track.last().is_some_and(|north_m| *north_m > 110.0));
    assert!(!pings.iter().any(flags));

    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("nav.log");
    std::fs::write(&path, &log).expect("log");
    let text = crate::run_well("nav", [&path]);
    for (pass, line) in [(1, 1), (2, 603), (3, 1203)] {
        let start = format!("pass {pass}    from line {line},");
        let near =
            (line - 2..=line + 6).any(|l| text.contains(&format!("pass {pass}    from line {l},")));
        assert!(near, "{start}\n{text}");
    }
}

#[test]
fn passes_do_not_mix_in_a_loop() {
    let log = [run_of(0..20, 0.0), run_of(20..40, -20.0)].concat();
    let arguments = ["--pings", "1..240", "--set", "nav.loop=true"];
    let (ended, pings) = replay(&log, &arguments);
    assert_eq!(ended.code, Some(0), "{}", ended.err);
    assert!(pings.len() > 200, "{} pings", pings.len());
    // The only step back is from the end of the log to its start.
    let track: Vec<_> = pings.iter().map(north_m).collect();
    let back: Vec<_> = track.windows(2).filter(|w| w[1] < w[0]).collect();
    assert!((2..=3).contains(&back.len()), "{back:?}");
    assert!(back.iter().all(|w| w[0] > 75.0 && w[1] < 5.0), "{back:?}");
}

#[test]
fn a_clock_that_is_wrong_for_three_seconds_is_marked_and_followed_again() {
    let days = |n: f64| n * 86_400.0;
    for off_s in [
        days(-12_600.0),
        days(12_000.0),
        -51.0 * 3600.0,
        20.0 * 3600.0,
    ] {
        let log = [
            run_of(0..10, 0.0),
            run_of(10..13, off_s),
            run_of(13..25, 0.0),
        ]
        .concat();
        let (ended, pings) = replay(&log, &[]);
        assert_eq!(ended.code, Some(0), "{}", ended.err);
        assert!(
            (44..=50).contains(&pings.len()),
            "{off_s} s: {} pings",
            pings.len()
        );
        let first_s = pings[0]["utc_ns"].as_i64().expect("a time") as f64 / 1e9;
        for ping in &pings {
            let at_s = ping["utc_ns"].as_i64().expect("a time") as f64 / 1e9 - first_s;
            let error_m = north_m(ping) - north_m(&pings[0]) - 2.0 * at_s;
            assert!(error_m.abs() < 1.0, "{off_s} s: {error_m} m at {at_s} s");
            match at_s {
                10.5..13.0 => assert!(flags(ping), "{off_s} s: no mark at {at_s} s"),
                0.0..9.0 | 15.0.. => assert!(!flags(ping), "{off_s} s: marked at {at_s} s"),
                _ => {}
            }
        }
        let count = pings.iter().filter(|p| flags(p)).count();
        let said = format!("{count} with a time jump of the navigation");
        assert!(ended.out.contains(&said), "{}", ended.out);
    }
}
