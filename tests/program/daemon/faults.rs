//! Test of injected faults. A topside client finds exactly the faults that the log lists, record by record.

use std::collections::{BTreeMap, BTreeSet};
use std::net::SocketAddr;
use std::path::Path;
use std::time::{Duration, Instant};

use echotank_runtime::io::sonar::client::SevenKClient;
use echotank_runtime::io::sonar::verify::{PingTally, Verifier, ping_number};
use serde_json::{Value, json};

use super::PATIENCE;
use super::modes::{pings_of, replayed, rig, step, tell, told};
use super::scored::track;
use super::triggers::records;
use crate::{Ended, files_in, run};

const RECORDS: [u32; 3] = [7000, 7007, 7038];
/// Number of pings. Each fault has probability one half, so three records per ping give about a hundred
/// faults.
const PINGS: u64 = 70;

fn log_of(folder: &Path) -> Vec<Value> {
    let texts = files_in(folder).map(|file| std::fs::read_to_string(file).expect("readable"));
    let text: String = texts.collect();
    let lines = text.lines();
    lines
        .map(|line| serde_json::from_str(line).expect("JSON"))
        .collect()
}

struct Bench {
    control: SocketAddr,
    client: SevenKClient,
    delivered: u64,
    /// Number of the last ping sent.
    last: u32,
}

impl Bench {
    fn step(&mut self, pings: u64) {
        step(self.control, &mut self.delivered, pings);
    }

    /// Reads until the last record of ping `until` is received.
    fn read(&mut self, until: u32, verifier: &mut Verifier) {
        let patience = Instant::now() + PATIENCE;
        while Instant::now() < patience {
            let timeout = Duration::from_millis(500);
            let Some(record) = self.client.next_record(timeout).expect("connected") else {
                continue;
            };
            verifier.note(record.record_type(), record.body());
            let number = ping_number(record.record_type(), record.body());
            if record.record_type() == 7038 && number == Some(until) {
                self.last = until;
                return;
            }
        }
        panic!("ping {until} never came");
    }
}

/// Expected counts of one record type for known injected pings, computed independently, ping by ping.
fn expected(kind: &str, struck: &BTreeSet<u32>, first: u32, last: u32) -> PingTally {
    let mut arrivals = Vec::new();
    let mut held: Vec<(u32, u32)> = Vec::new();
    for ping in first..=last {
        match (kind, struck.contains(&ping)) {
            ("drop" | "link-down" | "corrupt" | "truncate", true) => {}
            ("duplicate", true) => arrivals.extend([ping, ping]),
            ("reorder", true) => held.push((ping + 1, ping)),
            // A delay of 250 ms at ten pings per second: the record arrives with the third ping after.
            ("delay", true) => held.push((ping + 3, ping)),
            _ => arrivals.push(ping),
        }
        held.retain(|&(due, number)| {
            if due <= ping {
                arrivals.push(number);
            }
            due > ping
        });
    }
    let mut tally = PingTally {
        sent: u64::from(last - first + 1),
        received: arrivals.len() as u64,
        ..PingTally::default()
    };
    let mut seen = BTreeSet::new();
    for number in arrivals {
        if !seen.insert(number) {
            tally.duplicate += 1;
        } else if seen.last().is_some_and(|&highest| highest > number) {
            tally.late += 1;
        }
    }
    tally.lost = tally.sent - seen.len() as u64;
    tally
}

#[test]
fn a_topside_finds_exactly_the_link_faults_in_the_log() {
    let folder = tempfile::tempdir().expect("folder");
    let record = tempfile::tempdir().expect("folder");
    let log = format!("run.fault_directory={:?}", folder.path());
    let track = track(record.path());
    let mut daemon = rig(
        record.path(),
        &["run.clock=lockstep", "sonar.ping.range_m=15", &track, &log],
    );
    let sevenk = daemon.announced("7k points", "tcp");
    let control = daemon.announced("control http", "http");
    let mut client = SevenKClient::connect(sevenk).expect("listening");
    client.subscribe(&RECORDS).expect("subscribed");
    let mut bench = Bench {
        control,
        client,
        delivered: 0,
        last: 0,
    };
    let kinds = [
        "drop",
        "duplicate",
        "reorder",
        "corrupt",
        "corrupt-mended",
        "truncate",
        "delay",
        "link-down",
    ];
    let mut found = Vec::new();
    for (seed, kind) in kinds.into_iter().enumerate() {
        let mut verifier = Verifier::default();
        let errors_before = bench.client.counters().errors();
        // A clean ping precedes the faults, so that no loss is missed. Five clean pings follow, so that
        // delayed records arrive.
        bench.step(1);
        let first = bench.last + 1;
        bench.read(first, &mut verifier);
        let mut fault = json!({ "do": "fault", "kind": kind, "probability": 0.5, "seed": seed });
        if kind == "delay" {
            fault["value"] = json!(250.0);
        }
        told(control, &fault);
        bench.step(PINGS);
        let answer = told(control, &json!({ "do": "clear-faults" }));
        assert_eq!(answer["now"]["cleared"], 1, "{answer}");
        bench.step(5);
        let last = first + PINGS as u32 + 5;
        bench.read(last, &mut verifier);
        let errors = bench.client.counters().errors() - errors_before;
        found.push((kind, first, last, verifier, errors));
    }
    daemon.terminate();

    let log = log_of(folder.path());
    for (kind, first, last, verifier, errors) in found {
        let mut struck: BTreeMap<u32, BTreeSet<u32>> = BTreeMap::new();
        let mut faults = 0;
        for line in log.iter().filter(|line| line["kind"] == kind) {
            let number = |key: &str| line[key].as_u64().expect("a number") as u32;
            // Faults are also injected into records that no client receives.
            if RECORDS.contains(&number("record_type")) {
                struck
                    .entry(number("record_type"))
                    .or_default()
                    .insert(number("ping_number"));
                faults += 1;
            }
        }
        assert!(faults > 70, "{kind}: {faults} faults");
        for record_type in RECORDS {
            let got = verifier.tally(record_type);
            let want = expected(kind, &struck[&record_type], first, last);
            assert_eq!(got, want, "{kind} {record_type}");
        }
        match kind {
            "corrupt" => assert_eq!(errors, faults, "{kind}"),
            // After a truncated record, the search for the next record may skip it. Several truncated
            // records in a row are one error.
            "truncate" => assert!((1..=faults).contains(&errors), "{errors} {faults}"),
            _ => assert_eq!(errors, 0, "{kind}"),
        }
    }
}

#[test]
fn a_scenario_changes_the_same_samples_live_and_in_replay() {
    let scenario = r#"fault=[{kind="inverted", array=2, element=3, at_s=0.5, for_s=2.0}, {kind="noise-burst", value=1e-5, at_s=1.0, probability=0.4, burst=2, seed=3}, {kind="trigger-missed", at_s=2.0, for_s=0.25}]"#;
    let live = tempfile::tempdir().expect("folder");
    let plain = tempfile::tempdir().expect("folder");
    let offline = tempfile::tempdir().expect("folder");
    rig(live.path(), &["run.clock=fast", scenario]).ended();
    rig(plain.path(), &["run.clock=fast"]).ended();
    let offline = replayed(offline.path(), &[scenario]);
    let (live, plain) = (pings_of(live.path()), pings_of(plain.path()));
    assert!(live == offline, "live and replay differ");
    let of = |pings: &super::modes::Pings, kind| pings.keys().filter(|k| k.0 == kind).count();
    // A quarter of a second at ten pings a second: the pulses at 2.0, 2.1 and 2.2 s.
    assert_eq!(of(&plain, 7038) - of(&live, 7038), 3);
    let changed = live.iter().filter(|(key, bytes)| plain[*key] != **bytes);
    let changed = changed.filter(|(key, _)| key.0 == 7038).count();
    assert!(changed >= 20, "{changed} pings differ from the plain ones");
}

#[test]
fn impossible_faults_are_refused_live_and_before_the_start() {
    let folder = tempfile::tempdir().expect("folder");
    let mut daemon = rig(folder.path(), &["run.clock=lockstep"]);
    let control = daemon.announced("control http", "http");
    for (fault, word) in [
        (json!({ "do": "fault", "kind": "gremlin" }), "kind"),
        (json!({ "do": "fault", "kind": "gain" }), "value"),
        (
            json!({ "do": "fault", "kind": "dead", "element": 99 }),
            "element",
        ),
        (
            json!({ "do": "fault", "kind": "drop", "sonar": "x" }),
            "sonar",
        ),
    ] {
        let (code, answer) = tell(control, &fault);
        let why = answer["why"].as_str().expect("a reason");
        assert!(
            code == 409 && why.starts_with(word),
            "{fault}: {code} {why}"
        );
    }
    daemon.terminate();
    let faults = r#"fault=[{kind="gain"}, {kind="drop", element=3}]"#;
    let Ended { code, err, .. } = run("run", ["hil-configs/points.toml", "--set", faults]);
    assert_eq!(code, Some(2));
    assert!(err.contains("value") && err.contains("element"), "{err}");
}

#[test]
fn a_wrong_second_moves_the_stamps_and_a_double_trigger_makes_a_second_pulse() {
    let folders = [(); 2].map(|()| tempfile::tempdir().expect("folder"));
    let scenario = r#"fault=[{kind="wrong-second", value=3600, at_s=1.0, for_s=0.45}, {kind="trigger-double", value=40, at_s=2.0, for_s=0.25}]"#;
    let log = format!("run.fault_directory={:?}", folders[0].path().join("log"));
    // The echo of a pulse 40 ms later is received after the window of the previous ping.
    let common = ["run.clock=fast", "sonar.ping.range_m=15"];
    let faulty = rig(
        folders[0].path(),
        &[common[0], common[1], scenario, log.as_str()],
    );
    rig(folders[1].path(), &common).ended();
    faulty.ended();
    let [(got, _), (plain, _)] = [0, 1].map(|k| records(folders[k].path(), "points"));
    let (mut want, mut wrong, mut double) = (Vec::new(), Vec::new(), Vec::new());
    for (_, at_s) in &plain {
        let since_s = at_s - plain[0].1;
        let number = want.len() as u64 + 1;
        let is_wrong = (0.999..1.44).contains(&since_s);
        want.push(at_s + if is_wrong { 3600.0 } else { 0.0 });
        if is_wrong {
            wrong.push(number);
        }
        if (1.999..2.24).contains(&since_s) {
            want.push(at_s + 0.04);
            double.push(number);
        }
    }
    assert_eq!((wrong.len(), double.len()), (5, 3));
    let off = got.iter().zip(&want).map(|((_, got), want)| got - want);
    let off: Vec<f64> = off.collect();
    assert_eq!(got.len(), want.len());
    assert!(off.iter().all(|off_s| off_s.abs() < 1e-5), "{off:?}");
    let log = log_of(&folders[0].path().join("log"));
    for (kind, pings) in [("wrong-second", wrong), ("trigger-double", double)] {
        let struck: Vec<_> = log.iter().filter(|l| l["kind"] == kind).collect();
        let struck: Vec<_> = struck
            .iter()
            .filter_map(|l| l["ping_number"].as_u64())
            .collect();
        assert_eq!(struck, pings, "{kind}");
    }
}
