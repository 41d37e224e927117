//! Tests that all clock modes send the same pings: `realtime`, `scaled`, `fast`, `lockstep`, `replay`, and after a
//! pause.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::path::Path;
use std::process::Command;
use std::thread;
use std::time::Duration;

use echotank_protocols::sevenk::Record;
use echotank_protocols::sevenk::file::FileReader;
use echotank_runtime::io::control::client;
use serde_json::{Value, json};

use super::triggers::{records, three};
use super::{Daemon, eventually};
use crate::{file_of, replay_into, sets};

/// Ping records by type and timestamp. Records with the start time of a file are excluded.
pub(crate) type Pings = BTreeMap<(u32, Vec<u8>), Vec<u8>>;

/// Offset of year, day, seconds, hours and minutes in a record's frame.
pub(crate) const TIME: std::ops::Range<usize> = 20..30;

/// Passes the records of the first 7k file of a folder to `each`.
pub(crate) fn records_of(folder: &Path, start: &str, mut each: impl FnMut(&Record<'_>)) {
    let bytes = std::fs::read(file_of(folder, start, ".s7k")).expect("readable");
    FileReader::new(&bytes).for_each(|read| each(&read.expect("sound").record));
}

pub(crate) fn pings_of(folder: &Path) -> Pings {
    let mut pings = Pings::new();
    records_of(folder, "", |record| {
        let kind = record.frame.record_type_id;
        // Records with the time of the file opening describe the rig, not a ping.
        if !matches!(kind, 7200 | 7300 | 7001 | 7030 | 1009) {
            let whole = record.bytes().to_vec();
            let other = pings.insert((kind, whole[TIME].to_vec()), whole);
            assert!(other.is_none(), "two records {kind} of one instant");
        }
    });
    pings
}

pub(crate) fn pings_in(pings: &Pings) -> usize {
    pings.keys().filter(|(kind, _)| *kind == 7000).count()
}

/// Compares the records that are in both; returns their number.
fn assert_same(got: &Pings, want: &Pings, what: &str) -> usize {
    let mut compared = 0;
    for (key, bytes) in got {
        let Some(other) = want.get(key) else {
            panic!("{what}: replay has no record {} of that instant", key.0);
        };
        let differing = bytes.iter().zip(other).position(|(a, b)| a != b);
        assert!(
            bytes.len() == other.len() && differing.is_none(),
            "{what}: record {} of {} bytes differs at {differing:?}",
            key.0,
            bytes.len()
        );
        compared += 1;
    }
    compared
}

/// Settings for points in still water, with ten pings per second.
const QUICK: [&str; 3] = [
    "sonar.model.synthesis=direct",
    "sonar.ping.range_m=50",
    "sonar.ping.rate_hz=10",
];

/// Small, fast rig that records into a folder.
pub(crate) fn rig(folder: &Path, more: &[&str]) -> Daemon {
    let record = format!("record.directory={folder:?}");
    let common = [
        record.as_str(),
        "sonar.output.sevenk.listen=127.0.0.1:0",
        "control.listen=127.0.0.1:0",
    ];
    let settings = [&common, &QUICK, more].concat();
    Daemon::start("hil-configs/points.toml", settings)
}

/// Records of the same rig, replayed into a folder.
pub(crate) fn replayed(folder: &Path, more: &[&str]) -> Pings {
    let settings = sets([&QUICK, more].concat());
    let arguments = [vec!["--formats".to_owned(), "s7k".to_owned()], settings];
    replay_into(folder, "hil-configs/points.toml", &arguments.concat());
    pings_of(folder)
}

pub(crate) fn status(control: SocketAddr) -> Value {
    let (code, body) = client::get(control, "/status", None).expect("answers");
    assert_eq!(code, 200, "{body}");
    serde_json::from_str(&body).expect("JSON")
}

pub(crate) fn tell(control: SocketAddr, command: &Value) -> (u16, Value) {
    let (code, body) = client::command(control, command, None).expect("answers");
    (code, serde_json::from_str(&body).expect("JSON"))
}

/// Sends a command that the daemon accepts. Returns the answer.
pub(crate) fn told(control: SocketAddr, command: &Value) -> Value {
    let (code, answer) = tell(control, command);
    let accepted = (code, &answer["accepted"]);
    assert_eq!(accepted, (200, &json!(true)), "{command}: {answer}");
    answer
}

/// Waits until this many pings have been sent.
pub(crate) fn wait_delivered(control: SocketAddr, pings: u64) -> u64 {
    eventually(|| {
        let now = status(control)["pings_delivered"]
            .as_u64()
            .expect("a count");
        let enough = (now >= pings).then_some(now);
        enough.ok_or(format!("{now} of {pings} pings"))
    })
}

/// Requests steps of pings and waits for the pings.
pub(crate) fn step(control: SocketAddr, delivered: &mut u64, pings: u64) {
    told(control, &json!({ "do": "step", "pings": pings }));
    *delivered = wait_delivered(control, *delivered + pings);
}

#[test]
fn the_same_pings_are_sent_in_every_clock_mode_and_after_a_pause() {
    let folders: Vec<_> = (0..6)
        .map(|_| tempfile::tempdir().expect("folder"))
        .collect();
    let want = replayed(folders[5].path(), &[]);
    assert!(pings_in(&want) > 20, "{} pings", pings_in(&want));

    // The daemons run together, because they wait most of the time.
    let mut realtime = rig(folders[0].path(), &["run.clock=realtime"]);
    let mut stopped = rig(folders[1].path(), &["run.clock=realtime"]);
    let scaled = rig(
        folders[2].path(),
        &["run.clock=scaled", "run.clock_rate=10"],
    );
    let fast = rig(folders[3].path(), &["run.clock=fast"]);
    let mut lockstep = rig(folders[4].path(), &["run.clock=lockstep"]);

    let at = stopped.announced("control http", "http");
    wait_delivered(at, 3);
    stopped.signal("-STOP");
    let at = lockstep.announced("control http", "http");
    step(at, &mut 0, 4);
    // Without a step request, rig time does not advance.
    let before = status(at)["rig_utc_ns"].clone();
    thread::sleep(Duration::from_millis(300));
    assert_eq!(status(at)["pings_delivered"], 4);
    assert_eq!(status(at)["rig_utc_ns"], before);
    tell(at, &json!({ "do": "step" }));
    assert_eq!(wait_delivered(at, 5), 5);
    stopped.signal("-CONT");

    // Two of the daemons run to the end of the log on their own.
    for daemon in [scaled, fast] {
        daemon.ended();
    }
    let at = realtime.announced("control http", "http");
    wait_delivered(at, 8);
    realtime.terminate();
    stopped.terminate();
    lockstep.terminate();

    for (k, what, least) in [
        (0, "realtime", 8),
        (1, "stopped", 3),
        (2, "scaled", 3),
        (3, "fast", pings_in(&want)),
        (4, "lockstep", 5),
    ] {
        let got = pings_of(folders[k].path());
        let records = assert_same(&got, &want, what);
        let pings = pings_in(&got);
        assert!(pings >= least, "{what}: {pings} pings, {records} records");
    }
}

/// Faults of elements, navigation and pulses; pulse faults propagate to the sonars that follow.
const SCENARIO: &str = r#"
[[fault]]
kind = "inverted"
sonar = "bow"
array = 2
element = 3
at_s = 0.2
for_s = 0.8
[[fault]]
kind = "noise-burst"
value = 1e-5
at_s = 0.5
probability = 0.4
burst = 2
seed = 3
[[fault]]
kind = "nav-wrong"
quantity = "roll-pitch"
value = 4.0
at_s = 0.4
ramp_s = 0.5
[[fault]]
kind = "nav-slow"
quantity = "heading"
value = 2.0
[[fault]]
kind = "trigger-missed"
sonar = "points"
at_s = 1.0
for_s = 0.15
[[fault]]
kind = "trigger-double"
sonar = "points"
value = 45.0
at_s = 1.4
for_s = 0.25
"#;

/// Three sonars, two of which follow the first, with automatic method selection, including an engine with a tolerance.
#[test]
fn selected_methods_faults_and_triggers_are_the_same_in_every_clock_mode() {
    let folder = tempfile::tempdir().expect("folder");
    let model = "path = \"auto\"\ndoppler = \"auto\"\nsynthesis = \"auto\"\ntolerance = 1e-2";
    let config = three(folder.path(), model, SCENARIO);
    let text = std::fs::read_to_string(&config).expect("readable");
    // An engine with a tolerance needs the receiver filter, and pulses without sharp edges.
    let text = text
        .replace("rx_filter = \"none\"", "rx_filter = \"fir\"")
        .replace("taper = 0.0", "taper = 0.2")
        // Headings at 2 Hz are interpolated later than those of the track.
        .replace("latency_ms = 600.0", "latency_ms = 1500.0");
    let (first, others) = text.split_once("name = \"bow\"").expect("three sonars");
    let engine = others.replacen("synthesis = \"auto\"", "synthesis = \"gridded-1d\"", 1);
    std::fs::write(&config, format!("{first}name = \"bow\"{engine}")).expect("written");
    let at = |name: &str| folder.path().join(name);
    let start = |name: &str, clock: &[&str]| {
        let record = format!("record.directory={:?}", at(name));
        let common = [record.as_str(), "control.listen=127.0.0.1:0"];
        Daemon::start(&config, [clock, &common].concat())
    };
    // Modes without a deadline are first. The design of engines takes seconds, and a running clock skips late pings.
    let fast = start("fast", &["run.clock=fast"]);
    let mut lockstep = start("lockstep", &["run.clock=lockstep"]);
    let control = lockstep.announced("control http", "http");
    told(control, &json!({ "do": "step", "pings": 70 }));
    // A missed pulse has no ping.
    wait_delivered(control, 60);
    lockstep.terminate();
    fast.ended();
    replay_into(&at("replay"), &config, &["--formats", "s7k"]);
    let mut stopped = start("stopped", &["run.clock=realtime"]);
    let control = stopped.announced("control http", "http");
    wait_delivered(control, 3);
    stopped.signal("-STOP");
    thread::sleep(Duration::from_millis(700));
    stopped.signal("-CONT");
    // The daemons run to the end of the log.
    for daemon in [
        stopped,
        start("scaled", &["run.clock=scaled", "run.clock_rate=2"]),
        start("realtime", &["run.clock=realtime"]),
    ] {
        daemon.ended();
    }
    for sonar in ["points", "bow", "stern"] {
        let (pulses, want) = records(&at("fast"), sonar);
        assert!(pulses.len() > 20, "{sonar}: {} pings", pulses.len());
        for (name, least) in [
            ("replay", pulses.len()),
            ("lockstep", 20),
            ("realtime", 10),
            ("stopped", 5),
            ("scaled", 5),
        ] {
            let folder = match name {
                // Each sonar has its own folder.
                "replay" => at(name).join(sonar),
                _ => at(name),
            };
            let (pings, got) = records(&folder, sonar);
            for (key, body) in &got {
                let other = want.get(key);
                assert!(
                    other == Some(body),
                    "{name} {sonar}: record {} of ping {} differs",
                    key.0,
                    key.1
                );
            }
            assert!(pings.len() >= least, "{name} {sonar}: {}", pings.len());
        }
    }
}

/// Stops every thread with a debugger for a time. Without a debugger or permission, this does nothing.
fn debug(daemon: &Daemon) -> bool {
    let done = Command::new("gdb")
        .args(["--batch", "--nx", "--readnever"])
        .args(["-ex", "shell sleep 0.3", "-ex", "detach"])
        .args(["--pid", &daemon.child.id().to_string()])
        .output();
    done.is_ok_and(|done| String::from_utf8_lossy(&done.stdout).contains("detached"))
}

#[test]
fn a_stop_in_a_debugger_changes_no_ping() {
    let folders = [0, 1].map(|_| tempfile::tempdir().expect("folder"));
    let fast = rig(folders[0].path(), &["run.clock=fast"]);
    let mut stopped = rig(folders[1].path(), &["run.clock=realtime"]);
    let at = stopped.announced("control http", "http");
    wait_delivered(at, 3);
    println!("stopped in a debugger: {}", debug(&stopped));
    fast.ended();
    // The daemon runs to the end of the log.
    stopped.ended();
    let want = pings_of(folders[0].path());
    let got = pings_of(folders[1].path());
    assert_same(&got, &want, "in a debugger");
    assert!(pings_in(&got) >= 3, "{} pings", pings_in(&got));
}

#[test]
fn a_pause_stops_time_and_a_step_sends_one_ping() {
    let folder = tempfile::tempdir().expect("folder");
    let mut daemon = rig(folder.path(), &["nav.loop=true"]);
    let at = daemon.announced("control http", "http");
    wait_delivered(at, 2);
    told(at, &json!({ "do": "pause" }));
    let paused = status(at);
    thread::sleep(Duration::from_millis(300));
    let later = status(at);
    assert_eq!(later["rig_utc_ns"], paused["rig_utc_ns"], "time stands");
    // A ping in delivery may have been sent since.
    let before = later["pings_delivered"].as_u64().expect("a count");
    tell(at, &json!({ "do": "step", "pings": 2 }));
    assert_eq!(wait_delivered(at, before + 2), before + 2);
    thread::sleep(Duration::from_millis(300));
    assert_eq!(status(at)["pings_delivered"], before + 2);
    tell(at, &json!({ "do": "resume" }));
    wait_delivered(at, before + 4);
    // A daemon that is terminated while its clock is paused exits.
    tell(at, &json!({ "do": "pause" }));
    daemon.terminate();
}
