//! Tests of external pulses: trigger inputs over UDP and TCP, trigger outputs, steps of `lockstep`, and sonars that follow one
//! another.

use std::collections::BTreeMap;
use std::io::Write;
use std::net::{SocketAddr, TcpStream, UdpSocket};
use std::path::Path;
use std::thread;
use std::time::Duration;

use echotank_core::time::UtcNs;
use echotank_runtime::io::sonar::verify::ping_number;
use echotank_runtime::io::trigger::sentence;
use serde_json::{Value, json};

use super::modes::{records_of, rig, status, tell, wait_delivered};
use super::{Daemon, PATIENCE, eventually};
use crate::replay_into;

/// Socket that receives trigger outputs, and the setting that sends them there.
fn ear() -> (UdpSocket, String) {
    let socket = UdpSocket::bind("127.0.0.1:0").expect("socket");
    socket.set_read_timeout(Some(PATIENCE)).expect("set");
    let to = socket.local_addr().expect("bound");
    (socket, format!("sonar.trigger_out.to={to}"))
}

/// Number and time (nanoseconds) of the next received pulse.
fn heard(ear: &UdpSocket) -> (u32, i64) {
    let mut buffer = [0; 256];
    let len = ear.recv(&mut buffer).expect("a pulse");
    let text = std::str::from_utf8(&buffer[..len]).expect("text");
    let words: Vec<_> = text.trim_end().split([',', '*']).collect();
    assert_eq!((words[0], words[3]), ("$PETKT", "points"), "{text}");
    let (seconds, ns) = words[2].split_once('.').expect("decimals");
    let ns: i64 = ns.parse().expect("nine of them");
    let seconds: i64 = seconds.parse().expect("seconds");
    (
        words[1].parse().expect("a number"),
        seconds * 1_000_000_000 + ns,
    )
}

fn counters(control: SocketAddr) -> Value {
    status(control)["sonars"][0]["counters"].clone()
}

/// Waits until a counter has reached a value.
fn wait_counted(control: SocketAddr, name: &str, least: u64) {
    eventually(|| {
        let counters = counters(control);
        let now = counters[name].as_u64().expect("a count");
        let enough = (now >= least).then_some(());
        enough.ok_or(format!("{name} {now}: {counters}"))
    });
}

#[test]
fn a_ping_begins_with_its_trigger_and_early_repeated_or_paused_triggers_are_ignored() {
    let folder = tempfile::tempdir().expect("folder");
    let (ear, to) = ear();
    let mut daemon = rig(
        folder.path(),
        &[
            "nav.loop=true",
            "sonar.trigger.source=udp",
            "sonar.trigger.listen=127.0.0.1:0",
            "sonar.trigger.watchdog_ms=100",
            &to,
        ],
    );
    let listener = daemon.announced("trigger points", "udp");
    let control = daemon.announced("control http", "http");
    let sender = UdpSocket::bind("127.0.0.1:0").expect("socket");
    let send = |text: &str| assert!(sender.send_to(text.as_bytes(), listener).is_ok());
    // Without triggers there are no pings, and the watchdog counts.
    wait_counted(control, "triggers_absent", 3);
    assert_eq!(counters(control)["triggers_obeyed"], 0);
    let mut utc = Vec::new();
    for number in 1..=3 {
        send(&sentence::write(number + 40, UtcNs(0), "master"));
        let (got, ns) = heard(&ear);
        assert_eq!(got, number);
        utc.push(ns);
        // The pause is much longer than the listening window of 69 ms.
        thread::sleep(Duration::from_millis(400));
    }
    // The internal period would be 100 ms. Half of the pause is a margin for a late machine.
    assert!(utc.windows(2).all(|w| w[1] - w[0] > 200_000_000), "{utc:?}");
    // A repeated number, an old number, and malformed text give no ping.
    send(&sentence::write(43, UtcNs(0), "master"));
    wait_counted(control, "triggers_duplicate", 1);
    send(&sentence::write(40, UtcNs(0), "master"));
    wait_counted(control, "triggers_stale", 1);
    send("$PETKT,44,1.0,master*00");
    wait_counted(control, "triggers_spoiled", 1);
    // Plain text also triggers. Of two in a row, one is too many.
    send("ping!");
    send("ping!");
    assert_eq!(heard(&ear).0, 4);
    wait_counted(control, "triggers_early", 1);
    // While rig time is paused, triggers are ignored. A sonar with its own period ignores them too.
    tell(control, &json!({ "do": "pause" }));
    thread::sleep(Duration::from_millis(100));
    send("ping!");
    wait_counted(control, "triggers_held", 1);
    tell(control, &json!({ "do": "resume" }));
    tell(control, &json!({ "do": "set", "pinging": false }));
    send("ping!");
    wait_counted(control, "triggers_held", 2);
    tell(control, &json!({ "do": "set", "pinging": true }));
    thread::sleep(Duration::from_millis(100));
    send("ping!");
    assert_eq!(heard(&ear).0, 5);
    let counters = counters(control);
    assert_eq!(counters["triggers_obeyed"], 5, "{counters}");
    let printed = daemon.terminate();
    assert!(printed.contains("5 triggers obeyed"), "{printed}");
}

#[test]
fn queued_triggers_ping_as_fast_as_the_window_allows() {
    let folder = tempfile::tempdir().expect("folder");
    let (ear, to) = ear();
    let mut daemon = rig(
        folder.path(),
        &[
            "nav.loop=true",
            "sonar.trigger.source=tcp",
            "sonar.trigger.listen=127.0.0.1:0",
            "sonar.trigger.early=queue",
            &to,
        ],
    );
    let listener = daemon.announced("trigger points", "tcp");
    let control = daemon.announced("control http", "http");
    let mut client = TcpStream::connect(listener).expect("accepted");
    client.write_all(b"go\ngo\ngo\n").expect("written");
    let (first, second) = (heard(&ear), heard(&ear));
    assert_eq!((first.0, second.0), (1, 2));
    // 2 x 50 m at 1500 m/s, a pulse of 2 ms, and 1 ms of turnaround.
    assert_eq!(second.1 - first.1, 69_666_667);
    wait_counted(control, "triggers_early", 1);
    assert_eq!(counters(control)["triggers_queued"], 1);
    daemon.terminate();
}

#[test]
fn in_lockstep_a_trigger_is_a_step_and_a_number_counts_once() {
    let folder = tempfile::tempdir().expect("folder");
    let mut daemon = rig(
        folder.path(),
        &[
            "run.clock=lockstep",
            "sonar.trigger.source=udp",
            "sonar.trigger.listen=127.0.0.1:0",
        ],
    );
    let listener = daemon.announced("trigger points", "udp");
    let control = daemon.announced("control http", "http");
    let sender = UdpSocket::bind("127.0.0.1:0").expect("socket");
    for (number, delivered) in [(1, 1), (1, 1), (2, 2), (3, 3)] {
        let text = sentence::write(number, UtcNs(0), "board");
        sender.send_to(text.as_bytes(), listener).expect("sent");
        wait_delivered(control, delivered);
    }
    wait_counted(control, "triggers_duplicate", 1);
    assert_eq!(status(control)["pings_delivered"], 3);
    daemon.terminate();
}

/// Record bodies by type and ping number.
pub(crate) type Bodies = BTreeMap<(u32, u32), Vec<u8>>;

/// Ping number and timestamp (of the record's frame) of every 7000 of a sonar, and all its ping records.
pub(crate) fn records(folder: &Path, sonar: &str) -> (Vec<(u32, f64)>, Bodies) {
    let (mut pings, mut all) = (Vec::new(), BTreeMap::new());
    records_of(folder, sonar, |record| {
        let kind = record.frame.record_type_id;
        let Some(number) = ping_number(kind, record.body()) else {
            return;
        };
        let time = record.frame.time;
        let seconds = f64::from(time.seconds)
            + 60.0 * f64::from(time.minutes)
            + 3600.0 * f64::from(time.hours);
        if kind == 7000 {
            pings.push((number, seconds));
        }
        all.insert((kind, number), record.body().to_vec());
    });
    (pings, all)
}

#[test]
fn every_pulse_is_announced_with_the_number_and_the_time_of_its_records() {
    let folder = tempfile::tempdir().expect("folder");
    let (ear, to) = ear();
    rig(folder.path(), &["run.clock=fast", &to]).ended();
    let (pings, _) = records(folder.path(), "points");
    assert!(pings.len() > 20, "{}", pings.len());
    const DAY_NS: i64 = 86_400_000_000_000;
    const PULSE_S: f64 = 2e-3;
    for (number, seconds) in pings {
        let (told, ns) = heard(&ear);
        assert_eq!(told, number);
        // The 7k time stamp is the end of the pulse in single precision. Within a minute the resolution is 4 microseconds.
        let off_s = (ns % DAY_NS) as f64 / 1e9 + PULSE_S - seconds;
        assert!(off_s.abs() < 1e-5, "{number}: {off_s}");
    }
}

/// Rig of the points with a second and a third sonar. They follow the first at once and after 40 ms. `model` has lines of
/// [sonar.model]; `more` has tables.
pub(crate) fn three(folder: &Path, model: &str, more: &str) -> std::path::PathBuf {
    let root = echotank_testing::repository().join("hil-configs");
    let text = std::fs::read_to_string(root.join("points.toml")).expect("readable");
    // Beside the reference, what the text pins would be named twice.
    let pinned = "path = \"polyline\"\ndoppler = \"stretch\"\nsynthesis = \"reference\"";
    assert!(text.contains(pinned));
    let text = text
        .replace("data/", &format!("{}/data/", root.display()))
        .replace(pinned, model)
        .replace("range_m = 75.0", "range_m = 25.0")
        .replace("rate_hz = 2.0", "rate_hz = 10.0")
        .replace("127.0.0.1:7000", "127.0.0.1:0");
    let (rest, sonar) = text.split_once("[[sonar]]").expect("one");
    let mut all = format!("{rest}[[sonar]]{sonar}");
    for (name, delay_ms) in [("bow", 0.0), ("stern", 40.0)] {
        let other = sonar.replacen("\"points\"", &format!("\"{name}\""), 1);
        all += &format!(
            "\n[[sonar]]{other}\n[sonar.trigger]\nsource = \"sonar\"\nfollow = \"points\"\ndelay_ms = {delay_ms:?}\n"
        );
    }
    all += more;
    let path = folder.join("three.toml");
    std::fs::write(&path, all).expect("written");
    path
}

#[test]
fn sonars_of_one_daemon_ping_together_or_in_turn_each_on_its_own_port() {
    let folder = tempfile::tempdir().expect("folder");
    let [live, stepped, offline] = ["live", "stepped", "offline"].map(|n| folder.path().join(n));
    let config = three(
        folder.path(),
        "path = \"polyline\"\ndoppler = \"stretch\"\nsynthesis = \"direct\"",
        "",
    );
    let [live_at, stepped_at] =
        [&live, &stepped].map(|folder| format!("record.directory={folder:?}"));
    let control = "control.listen=127.0.0.1:0";
    let started = |clock, at| Daemon::start(&config, [clock, at, control]);
    let mut realtime = started("run.clock=realtime", live_at.as_str());
    let fast = started("run.clock=fast", stepped_at.as_str());
    let ports = ["points", "bow", "stern"]
        .map(|name| realtime.announced(&format!("7k {name}"), "tcp").port());
    assert!(ports[0] != ports[1] && ports[1] != ports[2] && ports[0] != ports[2]);
    let at = realtime.announced("control http", "http");
    fast.ended();
    wait_delivered(at, 9);
    let sonars = status(at)["sonars"].clone();
    let names: Vec<_> = (0..3).map(|k| sonars[k]["name"].clone()).collect();
    assert_eq!(names, ["points", "bow", "stern"]);
    realtime.terminate();
    replay_into(&offline, &config, &["--formats", "s7k"]);
    let (leader, _) = records(&stepped, "points");
    assert!(leader.len() > 20, "{}", leader.len());
    for (name, delay_s) in [("points", 0.0), ("bow", 0.0), ("stern", 0.04)] {
        let (pings, all) = records(&stepped, name);
        let (_, replayed) = records(&offline.join(name), name);
        assert!(all == replayed, "{name}: fast and replay differ");
        for ((number, at_s), (_, leader_s)) in pings.iter().zip(&leader) {
            let after_s = at_s - leader_s;
            assert!(
                (after_s - delay_s).abs() < 1e-5,
                "{name} {number}: {after_s}"
            );
        }
        assert!(pings.len() + 2 > leader.len());
        let (some, live) = records(&live, name);
        assert!(some.len() >= 2, "{name}: {}", some.len());
        for (key, body) in live {
            assert!(all[&key] == body, "{name}: {key:?} differs");
        }
    }
}
