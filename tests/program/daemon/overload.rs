//! Tests of pings that take longer than the available time. They are skipped, degraded or delayed, counted and logged, and
//! otherwise unchanged.

use std::collections::BTreeMap;
use std::path::Path;

use echotank_protocols::sevenk::RecordBody;
use echotank_runtime::io::control::client;
use serde_json::Value;

use super::modes::{Pings, TIME, pings_in, pings_of, records_of, rig, status};
use crate::file_of;

/// Year, day, seconds, hours and minutes in a record's frame.
type Instant = Vec<u8>;

/// Five seconds of 20 pings per second. A ping takes 75 ms, and 50 ms are available.
fn overloaded(folder: &Path, overload: &str, more: &[&str]) -> (String, Value) {
    let overload = format!("run.overload={overload}");
    let log = format!("run.fault_directory={folder:?}");
    let mut sets = vec![
        overload.as_str(),
        log.as_str(),
        "run.simulated_compute_ms=75",
    ];
    sets.extend(QUICK.iter().chain(more));
    let mut daemon = rig(folder, &sets);
    let control = daemon.announced("control http", "http");
    let mut last = Value::Null;
    // The daemon runs to the end of the log.
    while daemon.child.try_wait().expect("a child").is_none() {
        if let Ok((200, body)) = client::get(control, "/status", None) {
            last = serde_json::from_str(&body).expect("JSON");
        }
        std::thread::sleep(std::time::Duration::from_millis(20));
    }
    (daemon.ended(), last)
}

const QUICK: [&str; 3] = [
    "sonar.ping.range_m=15",
    "sonar.ping.rate_hz=20",
    "run.status_interval_s=1000",
];

/// The same rig without a deadline.
fn at_leisure(folder: &Path, more: &[&str]) -> Pings {
    let mut sets = vec!["run.clock=fast"];
    sets.extend(QUICK.iter().chain(more));
    rig(folder, &sets).ended();
    pings_of(folder)
}

/// Entries of the overload log by ping.
fn log_of(folder: &Path) -> Vec<Value> {
    let text = std::fs::read_to_string(file_of(folder, "overload-", "")).expect("readable");
    let lines = text.lines();
    lines
        .map(|line| serde_json::from_str(line).expect("JSON"))
        .collect()
}

fn numbers(log: &[Value], what: &str) -> Vec<u64> {
    let lines = log.iter().filter(|line| line["what"] == what);
    lines
        .map(|line| line["ping_number"].as_u64().expect("a number"))
        .collect()
}

/// Ping numbers and periods by the timestamps of records.
fn settings_of(folder: &Path) -> BTreeMap<Instant, (u64, f32)> {
    let mut all = BTreeMap::new();
    records_of(folder, "", |record| {
        if let Ok(RecordBody::SonarSettings(settings)) = RecordBody::parse(record) {
            let number = u64::from(settings.ping_number);
            let stamp = record.bytes()[TIME].to_vec();
            all.insert(stamp, (number, settings.ping_period_s));
        }
    });
    all
}

fn counter(status: &Value, name: &str) -> u64 {
    let value = &status["sonars"][0]["counters"][name];
    value.as_u64().unwrap_or_else(|| panic!("{name}: {status}"))
}

#[test]
fn skipped_pings_are_counted_and_logged_and_the_others_are_unchanged() {
    let folders = [0, 1].map(|_| tempfile::tempdir().expect("folder"));
    let want = at_leisure(folders[0].path(), &[]);
    let (said, last) = overloaded(folders[1].path(), "skip", &[]);
    let got = pings_of(folders[1].path());
    let log = log_of(folders[1].path());
    let skipped = numbers(&log, "skipped");
    assert_eq!(last["sonars"][0]["overload"], "skip");
    // In five seconds there is time for 67 of 100 pings, and for the queued pings.
    assert!(skipped.len() >= 10, "{} skipped: {log:?}", skipped.len());
    assert!(
        pings_in(&got) >= 20 && pings_in(&got) < pings_in(&want),
        "{} of {}",
        pings_in(&got),
        pings_in(&want)
    );
    for (key, bytes) in &got {
        assert!(want.get(key) == Some(bytes), "record {} differs", key.0);
    }
    let made: Vec<_> = settings_of(folders[1].path()).into_values().collect();
    assert!(made.iter().all(|(number, _)| !skipped.contains(number)));
    assert_eq!(
        (
            counter(&last, "pings_degraded"),
            counter(&last, "pings_stretched")
        ),
        (0, 0)
    );
    assert!(said.contains(&format!("late {}", skipped.len())), "{said}");
}

#[test]
fn degraded_pings_are_flagged_meet_the_looser_tolerance_and_recover() {
    let sets = [
        "sonar.model.synthesis=gridded-1d",
        "sonar.receiver.rx_filter=fir",
        "sonar.model.tolerance=1e-2",
    ];
    let looser = [sets[0], sets[1], "sonar.model.tolerance=0.1"];
    let folders = [0, 1, 2].map(|_| tempfile::tempdir().expect("folder"));
    let fine = at_leisure(folders[0].path(), &sets);
    let coarse = at_leisure(folders[1].path(), &looser);
    let (said, last) = overloaded(folders[2].path(), "degrade", &sets);
    let got = pings_of(folders[2].path());
    let log = log_of(folders[2].path());
    let of_tolerance = |tolerance: f64| -> Vec<u64> {
        let lines = log.iter().filter(|line| line["tolerance"] == tolerance);
        numbers(&lines.cloned().collect::<Vec<_>>(), "degraded")
    };
    let (first, all) = (of_tolerance(0.1), numbers(&log, "degraded"));
    assert!(first.len() >= 10, "{log:?}");
    let numbers_of: BTreeMap<_, _> = settings_of(folders[2].path());
    let mut compared = [0; 2];
    for ((kind, stamp), bytes) in &got {
        let Some((number, _)) = numbers_of.get(stamp) else {
            continue;
        };
        let (want, which) = match (first.contains(number), all.contains(number)) {
            (true, _) => (&coarse, 1),
            (false, true) => continue,
            (false, false) => (&fine, 0),
        };
        let other = want.get(&(*kind, stamp.clone()));
        assert!(other == Some(bytes), "record {kind} of ping {number}");
        compared[which] += 1;
    }
    assert!(compared.iter().all(|&n| n >= 20), "{compared:?}");
    // The tolerance is restored when there is time again.
    let after = numbers_of.values().map(|(number, _)| *number);
    let fine_again = after.filter(|n| *n > first[0] && !all.contains(n)).count();
    assert!(fine_again > 0, "{all:?}");
    assert_eq!(last["sonars"][0]["overload"], "degrade");
    assert!(counter(&last, "pings_degraded") > 0);
    assert!(
        said.contains(&format!(
            "OVERLOAD: {} computed with a larger tolerance",
            all.len()
        )),
        "{said}"
    );
}

#[test]
fn stretched_periods_match_the_compute_time_and_are_reported() {
    let folder = tempfile::tempdir().expect("folder");
    let (said, last) = overloaded(folder.path(), "stretch", &[]);
    let log = log_of(folder.path());
    let (stretched, skipped) = (numbers(&log, "stretched"), numbers(&log, "skipped"));
    let mut made: Vec<_> = settings_of(folder.path()).into_values().collect();
    made.sort_by_key(|(number, _)| *number);
    assert!(stretched.len() >= 10, "{log:?}");
    assert!(4 * skipped.len() <= made.len(), "{log:?}");
    // The record has the actual period.
    for (number, period_s) in &made[1..] {
        match stretched.contains(number) {
            true => assert!(*period_s > 0.05, "ping {number}: {period_s} s"),
            false => assert!(
                (period_s - 0.05).abs() < 1e-6,
                "ping {number}: {period_s} s"
            ),
        }
    }
    // From the first delayed ping on, the period is 75 ms, except for queued pings.
    let last_ones = &made[made.len() / 2..];
    let mean_s = last_ones.iter().map(|(_, s)| f64::from(*s)).sum::<f64>() / last_ones.len() as f64;
    assert!(mean_s > 0.065, "{mean_s} s: {made:?}");
    assert_eq!(last["sonars"][0]["overload"], "stretch");
    assert!(
        said.contains(&format!("OVERLOAD: {} pulses delayed", stretched.len())),
        "{said}"
    );
    // A machine without overload has none of these effects.
    let folder = tempfile::tempdir().expect("folder");
    let mut daemon = rig(folder.path(), &["run.overload=stretch", "nav.loop=true"]);
    let control = daemon.announced("control http", "http");
    super::modes::wait_delivered(control, 5);
    let now = status(control);
    assert_eq!(counter(&now, "pings_stretched"), 0, "{now}");
    daemon.terminate();
}
