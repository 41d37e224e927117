//! Tests of link faults in every live protocol. A receiver finds exactly the faults in the log.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::Duration;

use echotank_runtime::io::control::client;
use echotank_runtime::io::sonar::elements::ElementClient;
use echotank_runtime::io::sonar::verification::accounting::Checksums;
use echotank_runtime::io::sonar::verification::decode::Family;
use echotank_runtime::io::sonar::verification::listener::{Listener, ListenerSpec};
use echotank_runtime::io::sonar::verification::report::Report;
use echotank_runtime::score::{LoggedFault, Score, log_of, score};
use echotank_testing::track::COLUMNS;
use serde_json::{Value, json};

use super::eventually;
use super::modes::{rig, tell, told};
use crate::files_in;

const RECORDS: [u32; 3] = [7000, 7007, 7038];
/// Probability of each fault.
const PROBABILITY: f64 = 0.6;
const KINDS: [&str; 9] = [
    "drop",
    "duplicate",
    "reorder",
    "corrupt",
    "corrupt-mended",
    "truncate",
    "delay",
    "jitter",
    "link-down",
];
/// Number of pings with a kind of fault.
const STRUCK: u64 = 6;
/// Number of pings after which records delayed by a quarter of a second have arrived.
const CLEAN: u64 = 3;

/// Result of one receiver.
struct Heard {
    report: Report,
    sums: Checksums,
    errors: u64,
}

type AllHeard = BTreeMap<&'static str, Heard>;

struct Listeners {
    stop: Arc<AtomicBool>,
    threads: Vec<thread::JoinHandle<(&'static str, Heard)>>,
}

impl Listeners {
    fn new() -> Self {
        Self {
            stop: Arc::default(),
            threads: Vec::new(),
        }
    }

    /// Starts a receiver. Returns its address.
    fn listen(
        &mut self,
        family: Family,
        name: &'static str,
        address: SocketAddr,
        clean: Option<&AllHeard>,
        silence: Option<Duration>,
    ) -> SocketAddr {
        let what = ListenerSpec {
            family,
            address,
            record_types: RECORDS.to_vec(),
            range_m: 10,
            silence,
        };
        let against = clean.map(|clean| clean[name].sums.clone());
        let mut listener = Listener::open(what, against, clean.is_none()).expect("listening");
        let local = listener.local_addr().expect("bound");
        let stop = self.stop.clone();
        self.threads.push(thread::spawn(move || {
            let mut stopped = || stop.load(Ordering::Acquire);
            listener.run(&mut stopped).expect("listens to the end");
            let heard = Heard {
                report: listener.accounting.report(),
                sums: listener.accounting.checksums().clone(),
                errors: listener.errors(),
            };
            (name, heard)
        }));
        local
    }

    fn end(self) -> AllHeard {
        // Datagrams have no end of stream. All sent datagrams are already on this machine.
        thread::sleep(Duration::from_millis(200));
        self.stop.store(true, Ordering::Release);
        let threads = self.threads.into_iter();
        threads.map(|t| t.join().expect("ends")).collect()
    }
}

/// Writes a track that is long enough not to loop, because a loop would skip pings. Returns the setting that selects the track.
pub(crate) fn track(folder: &Path) -> String {
    let track = folder.join("track.csv");
    let mut text = COLUMNS.to_owned();
    for quarter in 0..300 {
        let time_s = 1_793_611_200.0 + 0.25 * f64::from(quarter);
        text += &format!("{time_s:.2},0,0,5,3,-2,35\n");
    }
    std::fs::write(&track, text).expect("written");
    format!("nav.source.path={track:?}")
}

/// Requests steps of one ping at a time, so that a socket buffer of default size holds all datagrams.
fn step(control: SocketAddr, delivered: &mut u64, pings: u64) {
    (0..pings).for_each(|_| super::modes::step(control, delivered, 1));
}

/// Waits until each of these outputs has a client that sent a request: `OUTPUT: N clients now, M ever`.
fn wait_clients(control: SocketAddr, wanted: &[(&str, &str)]) {
    eventually(|| {
        let (_, status) = client::get(control, "/status", None).expect("answers");
        let said = |(output, count): &(&str, &str)| status.contains(&format!("{output}: {count}"));
        let all = wanted.iter().all(said).then_some(());
        all.ok_or(format!("{wanted:?}: {status}"))
    });
    // A client is listed shortly before its first request.
    thread::sleep(Duration::from_millis(100));
}

/// Number of records that were written to the clients of each output.
fn records_sent(control: SocketAddr) -> BTreeMap<&'static str, u64> {
    let (_, metrics) = client::get(control, "/metrics", None).expect("answers");
    let counts = ["7k", "elements"].map(|family| {
        let lines = metrics.lines().filter(|line| {
            line.starts_with("echotank_client_records_sent{")
                && line.contains(&format!("family=\"{family}\""))
        });
        let values = lines.map(|line| line.rsplit(' ').next().expect("a value"));
        (family, values.map(|v| v.parse::<u64>().expect(v)).sum())
    });
    counts.into()
}

/// Requests one ping and waits until every client was sent a record of it. A fault would discard what still waits in a queue.
fn step_sent(control: SocketAddr, delivered: &mut u64) {
    let before = records_sent(control);
    step(control, delivered, 1);
    eventually(|| {
        let now = records_sent(control);
        let all = now.iter().all(|(family, sent)| *sent > before[family]);
        all.then_some(()).ok_or(format!("{before:?} {now:?}"))
    });
}

fn logged(folder: &Path) -> Vec<LoggedFault> {
    let texts = files_in(folder).map(|file| std::fs::read_to_string(file).expect("text"));
    log_of(&texts.collect::<String>()).expect("a log")
}

/// One run of all protocols together. `clean` is the result of a run without faults; if given, faults are injected.
fn run(clean: Option<&AllHeard>) -> (AllHeard, Vec<LoggedFault>) {
    let folders = [(); 2].map(|()| tempfile::tempdir().expect("folder"));
    let mut listeners = Listeners::new();
    let any = "127.0.0.1:0".parse().expect("an address");
    let board = listeners.listen(Family::Vita49, "vita49", any, clean, None);
    let mut daemon = rig(
        folders[0].path(),
        &[
            "run.clock=lockstep",
            "sonar.ping.range_m=5",
            "sonar.output.jsf.listen=127.0.0.1:0",
            "sonar.output.jsf.listen_data=127.0.0.1:0",
            "sonar.output.jsf.subsystem=20",
            "sonar.output.jsf.format=envelope",
            "sonar.output.jsf.channels=sides",
            "sonar.output.wbms.listen=127.0.0.1:0",
            "sonar.output.ping.listen=127.0.0.1:0",
            "sonar.output.ping.device=omniscan450",
            "sonar.output.ping.side=port",
            "sonar.output.elements.listen=127.0.0.1:0",
            "sonar.output.vita49.arrays=[\"port\"]",
            &format!("sonar.output.vita49.send_to=\"{board}\""),
            &track(folders[0].path()),
            &format!("run.fault_directory={:?}", folders[1].path()),
        ],
    );
    let servers = [
        ("7k", Family::SevenK, "7k points"),
        ("jsf", Family::Jsf, "jsf-data points"),
        ("elements", Family::Elements, "elements points"),
        ("ping", Family::Ping, "ping points"),
        ("wbms", Family::Wbms, "wbms points bathymetry"),
        ("wbms fan", Family::Wbms, "wbms points water column"),
        ("wbms sides", Family::Wbms, "wbms points side-scan"),
    ];
    for (name, family, line) in servers {
        let address = daemon.address_of(line, "tcp");
        listeners.listen(family, name, address, clean, None);
    }
    let control = daemon.address_of("control http", "http");
    wait_clients(control, &servers.map(|(.., line)| (line, "1 clients")));
    let mut delivered = 0;
    step(control, &mut delivered, CLEAN);
    for (seed, kind) in KINDS.into_iter().enumerate() {
        if clean.is_some() {
            let mut fault =
                json!({ "do": "fault", "kind": kind, "probability": PROBABILITY, "seed": seed });
            if matches!(kind, "delay" | "jitter") {
                // The delay is three pings.
                fault["value"] = json!(250.0);
            }
            told(control, &fault);
        }
        step(control, &mut delivered, STRUCK);
        tell(control, &json!({ "do": "clear-faults" }));
        step(control, &mut delivered, CLEAN);
    }
    daemon.terminate();
    (listeners.end(), logged(folders[1].path()))
}

#[test]
fn every_live_family_finds_exactly_the_logged_faults() {
    let (clean, log) = run(None);
    assert!(log.is_empty());
    for (name, heard) in &clean {
        assert_eq!(heard.report.findings, [], "{name}");
        assert_eq!(heard.errors, 0, "{name}");
        assert!(heard.sums.len() > 80, "{name}: {}", heard.sums.len());
    }
    let (faulty, log) = run(Some(&clean));
    for (name, heard) in &faulty {
        let score = score(&log, &heard.report);
        assert!(
            score.is_clean(),
            "{name}: missed {:#?}, false alarms {:#?}",
            score.missed,
            score.false_alarms
        );
        for kind in KINDS {
            let tally = score.kinds[kind];
            // There is at least one record per ping: six draws.
            assert!(tally.injected > 0, "{name} {kind}: {tally:?}");
            assert_eq!(tally.undetectable, 0, "{name} {kind}");
            let held = matches!(kind, "reorder" | "delay" | "jitter");
            assert!(
                tally.found > 0 && (held || tally.masked == 0),
                "{name} {kind}: {tally:?}"
            );
        }
    }
}

const ROUNDS: u64 = 2;

/// Scores of the protocols for which only the connection is tested, in slow steps.
fn connections(kind: &str, value: &Value, pings: u64) -> (Score, Score) {
    let folders = [(); 2].map(|()| tempfile::tempdir().expect("folder"));
    let mut daemon = rig(
        folders[0].path(),
        &[
            "run.clock=lockstep",
            "sonar.ping.range_m=5",
            "sonar.output.elements.listen=127.0.0.1:0",
            &track(folders[0].path()),
            &format!("run.fault_directory={:?}", folders[1].path()),
        ],
    );
    let sevenk = daemon.address_of("7k points", "tcp");
    let elements = daemon.address_of("elements points", "tcp");
    let control = daemon.address_of("control http", "http");
    let mut listeners = Listeners::new();
    // Steps follow each other much faster here, so the silence is longer.
    let silence = Some(Duration::from_millis(300));
    listeners.listen(Family::SevenK, "7k", sevenk, None, silence);
    listeners.listen(Family::Elements, "elements", elements, None, silence);
    let now = |ever: u64| format!("1 clients now, {ever} ever");
    let both = |ever: u64| {
        let count = now(ever);
        wait_clients(
            control,
            &[("7k points", count.as_str()), ("elements points", &count)],
        );
    };
    both(1);
    let mut delivered = 0;
    for round in 1..=ROUNDS {
        (0..2).for_each(|_| step_sent(control, &mut delivered));
        let mut fault = json!({ "do": "fault", "kind": kind });
        fault["for_s"] = value.clone();
        tell(control, &fault);
        step(control, &mut delivered, pings);
        match kind {
            "reset" => both(1 + round),
            // No records arrive during this time.
            _ => thread::sleep(Duration::from_millis(500)),
        }
        step(control, &mut delivered, 2);
        tell(control, &json!({ "do": "clear-faults" }));
    }
    step(control, &mut delivered, 2);
    daemon.terminate();
    let heard = listeners.end();
    let log = logged(folders[1].path());
    let of = |name| score(&log, &heard[name].report);
    (of("7k"), of("elements"))
}

#[test]
fn resets_and_silences_are_found_at_their_logged_times() {
    let both = thread::scope(|scope| {
        let kinds = [("reset", json!(0.05), 1), ("half-open", json!(0.25), 3)];
        let running = kinds.map(|(kind, value, pings)| {
            (kind, scope.spawn(move || connections(kind, &value, pings)))
        });
        running.map(|(kind, thread)| (kind, thread.join().expect("ends")))
    });
    for (kind, (sevenk, elements)) in both {
        for (name, score) in [("7k", sevenk), ("elements", elements)] {
            let tally = score.kinds[kind];
            let found = (tally.injected, tally.found);
            assert_eq!(found, (ROUNDS, ROUNDS), "{name} {kind}: {score:?}");
            // A machine that stalls for a third of a second also causes a silence.
            let false_alarms = score.false_alarms.iter().filter(|f| f.kind != "silent");
            assert_eq!(
                false_alarms.count(),
                0,
                "{name} {kind}: {:?}",
                score.false_alarms
            );
        }
    }
}

#[test]
fn a_dead_element_injected_live_is_dead_only_in_the_logged_pings() {
    const ELEMENTS: usize = 32;
    let folders = [(); 2].map(|()| tempfile::tempdir().expect("folder"));
    let mut daemon = rig(
        folders[0].path(),
        &[
            "run.clock=lockstep",
            // The range is long enough for echoes.
            "sonar.ping.range_m=50",
            "sonar.output.elements.listen=127.0.0.1:0",
            &track(folders[0].path()),
            &format!("run.fault_directory={:?}", folders[1].path()),
        ],
    );
    let elements = daemon.address_of("elements points", "tcp");
    let control = daemon.address_of("control http", "http");
    let mut client = ElementClient::connect(elements).expect("listening");
    wait_clients(control, &[("elements points", "1 clients")]);
    // Array 1 follows the eight elements of array 0.
    let (dead_one, its_neighbour) = (8 + 3, 8 + 4);
    // The client reads during the pings. Data that a client has not read when the daemon ends are lost.
    let reader = std::thread::spawn(move || {
        // Whether the frames of a ping contain any signal of the dead element.
        let mut pings: BTreeMap<u32, bool> = BTreeMap::new();
        let mut neighbours: BTreeMap<u32, bool> = BTreeMap::new();
        loop {
            let open = client.read(Duration::from_secs(5), |frame, _| {
                assert_eq!(usize::from(frame.head.elements), ELEMENTS);
                let heard = |element: usize| {
                    let mut sample_times = frame.samples.chunks_exact(4 * ELEMENTS);
                    sample_times.any(|m| m[4 * element..4 * element + 4] != [0; 4])
                };
                let number = frame.head.ping_number;
                *pings.entry(number).or_default() |= heard(dead_one);
                *neighbours.entry(number).or_default() |= heard(its_neighbour);
            });
            if !open.expect("to the end") {
                break;
            }
        }
        (pings, neighbours)
    });
    let mut delivered = 0;
    step(control, &mut delivered, 2);
    told(
        control,
        &json!({ "do": "fault", "kind": "dead", "array": 1, "element": 3, "for_s": 0.25 }),
    );
    step(control, &mut delivered, 6);
    daemon.terminate();
    let (pings, neighbours) = reader.join().expect("every frame was read");
    assert_eq!(pings.len(), 8);
    assert!(neighbours.values().all(|heard| *heard), "{neighbours:?}");
    let dead: Vec<u32> = pings
        .into_iter()
        .filter_map(|(number, heard)| (!heard).then_some(number))
        .collect();
    let log = logged(folders[1].path());
    let struck: Vec<_> = log.iter().map(|l| l.ping_number).collect();
    assert_eq!((struck.len(), &struck), (3, &dead));
    assert!(
        log.iter()
            .all(|l| (l.array, l.element) == (Some(1), Some(3)))
    );
}
