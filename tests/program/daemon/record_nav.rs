//! Tests of `run --record-nav` and `replay --nav`: a run with live navigation is repeated bit for bit.

use std::collections::BTreeMap;
use std::io::Write;
use std::net::{SocketAddr, TcpListener, TcpStream, UdpSocket};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};
use std::{fs, thread};

use echotank_protocols::sevenk::file::FileReader;
use echotank_runtime::io::sonar::verify::ping_number;

use serialport::{SerialPort, TTYPort};

use super::{Daemon, LIVE_SONAR, gnss, sentence};
use crate::{command, file_of, replay_into, run};

/// Keys of a source that receives datagrams.
const UDP: &str = "kind = \"udp\"\nlisten = \"127.0.0.1:0\"";

/// A rig with three live sources in this mode, of which the second replaces the first. `links`: their keys.
fn rig(folder: &Path, mode: &str, links: [&str; 3]) -> PathBuf {
    let source = |name: &str, link: &str, time: &str, provides: &str| {
        format!(
            "[[nav.source]]\nname = \"{name}\"\n{link}\ntime = \"{time}\"\nprovides = {provides}\n"
        )
    };
    let fixes = "[\"position\", \"heading\"]";
    let [first, second, mru] = links;
    let sources = [
        source("first", first, "message", fixes),
        source("second", second, "message", fixes),
        source("mru", mru, "arrival", "[\"roll-pitch\", \"heave\"]"),
    ];
    let text = format!(
        r#"
[medium]
sound_speed_m_per_s = 1500.0
absorption = "none"
[nav]
origin = {{ latitude_deg = 54.0, longitude_deg = 10.0 }}
mode = "{mode}"
failover_s = 0.4
hold_off_s = 0.4
{}
{}
[scene]
seed = 1
[scene.seabed]
shape = "plane"
depth_m = 12.0
density_per_m2 = 0.5
[run]
latency_ms = 900.0
queue_pings = 24
[control]
listen = "127.0.0.1:0"
[record]
directory = {:?}
{LIVE_SONAR}
[sonar.limits]
range_m = [10.0, 20.0]
"#,
        if mode == "predict" {
            "max_extrapolation_ms = 1000.0"
        } else {
            ""
        },
        sources.concat(),
        folder.join("run")
    );
    let path = folder.join("rig.toml");
    fs::write(&path, text).expect("written");
    path
}

/// Element samples of each ping of a 7k file.
fn samples(path: &Path) -> BTreeMap<u32, Vec<u8>> {
    let bytes = fs::read(path).expect("readable");
    let records = FileReader::new(&bytes).map(|found| found.expect("whole").record);
    let of_samples = records.filter(|record| record.frame.record_type_id == 7038);
    of_samples
        .map(|record| {
            let number = ping_number(7038, record.body()).expect("a number");
            (number, record.body().to_vec())
        })
        .collect()
}

/// The other end of a source's link.
enum Instrument {
    Udp(UdpSocket, SocketAddr),
    Tcp(TcpStream),
    Serial(TTYPort),
}

impl Instrument {
    fn udp(to: SocketAddr) -> Self {
        Self::Udp(UdpSocket::bind("127.0.0.1:0").expect("socket"), to)
    }

    fn send(&mut self, text: &str) {
        let text = text.as_bytes();
        match self {
            Self::Udp(socket, to) => socket.send_to(text, *to).map(|_| ()),
            Self::Tcp(stream) => stream.write_all(text),
            Self::Serial(port) => port.write_all(text),
        }
        .expect("sent");
    }
}

/// Sends 25 rounds of sentences a second. The first source ends after 2 s of 4 s.
fn sail([mut first, mut second, mut mru]: [Instrument; 3], range: impl Fn()) {
    let begun = Instant::now();
    for round in 0..100 {
        let minutes = 1e-4 * f64::from(round);
        if round < 50 {
            first.send(&gnss(minutes, 0));
        }
        second.send(&gnss(minutes + 1e-3, 0));
        let roll = 3.0 * (0.2 * f64::from(round)).sin();
        mru.send(&sentence(&format!("PSXN,23,{roll:.3},-1.5,123.45,0.2")));
        if round == 70 {
            range();
        }
        let next = begun + Duration::from_millis(40 * (round as u64 + 1));
        thread::sleep(next.saturating_duration_since(Instant::now()));
    }
}

/// Runs a rig with these links, repeats it from its recording, and compares the samples. `instruments`: the other ends of the links.
fn repeated(
    mode: &str,
    links: [&str; 3],
    instruments: impl FnOnce(&mut Daemon) -> [Instrument; 3],
) {
    let folder = tempfile::tempdir().expect("folder");
    let at = |name: &str| folder.path().join(name);
    let (rig, nav) = (rig(folder.path(), mode, links), at("nav.pcapng"));
    let mut daemon = Daemon::spawn(command("run").arg(&rig).arg("--record-nav").arg(&nav));
    let instruments = instruments(&mut daemon);
    let control = daemon.address_of("control http", "http").to_string();
    sail(instruments, || {
        let done = run("ctl", ["--address", &control, "set", "range_m=15"]);
        assert_eq!(done.code, Some(0), "{}", done.err);
    });
    let printed = daemon.terminate();
    let live = samples(&file_of(&at("run"), "live-", ".s7k"));
    assert!(live.len() > 15, "{}\n{printed}", live.len());
    assert!(printed.contains("position from second"), "{printed}");

    replay_into(
        &at("again"),
        &rig,
        &[
            "--nav".as_ref(),
            nav.as_os_str(),
            "--formats".as_ref(),
            "s7k".as_ref(),
        ],
    );
    let again = samples(&at("again").join("live.s7k"));
    // A ping that the end of the run found under way is not in its file.
    let last = live.keys().next_back().expect("pings");
    let more = again.keys().filter(|number| !live.contains_key(number));
    assert!(more.clone().all(|number| number > last), "{:?}", more);
    for (number, samples) in &live {
        assert!(*samples == again[number], "ping {number} of {}", live.len());
    }
    let lengths: Vec<_> = live.values().map(Vec::len).collect();
    assert!(lengths.iter().any(|n| n < &lengths[0]), "the range changed");

    // Another rig is refused.
    let minimal = "tests/data/config/minimal.toml";
    let other = [
        minimal.as_ref(),
        "--nav".as_ref(),
        nav.as_os_str(),
        "--out".as_ref(),
        folder.path().as_os_str(),
    ];
    let done = run("replay", other);
    assert_eq!(done.code, Some(2), "{}", done.err);
    let words = "holds no source named `gnss`; it was recorded with first, second, mru";
    assert!(done.err.contains(words), "{}", done.err);

    // A second recording does not replace the first.
    let before = fs::read(&nav).expect("readable");
    let done = run(
        "run",
        [rig.as_os_str(), "--record-nav".as_ref(), nav.as_os_str()],
    );
    assert_eq!(done.code, Some(2), "{}", done.err);
    assert!(done.err.contains("exists"), "{}", done.err);
    assert!(fs::read(&nav).expect("readable") == before);
}

fn over_udp(daemon: &mut Daemon) -> [Instrument; 3] {
    ["first", "second", "mru"]
        .map(|name| Instrument::udp(daemon.address_of(&format!("nav {name}"), "udp")))
}

#[test]
fn a_predicted_run_with_live_sources_is_repeated_bit_for_bit() {
    repeated("predict", [UDP; 3], over_udp);
}

#[test]
fn a_settled_run_with_live_sources_is_repeated_bit_for_bit() {
    repeated("settle", [UDP; 3], over_udp);
}

/// The daemon calls one source over TCP, another calls the daemon, and the third is on a serial line.
#[test]
fn a_run_with_sources_on_tcp_and_on_a_serial_line_is_repeated_bit_for_bit() {
    let server = TcpListener::bind("127.0.0.1:0").expect("a listener");
    let address = server.local_addr().expect("an address");
    let connect = format!("kind = \"tcp\"\nconnect = \"{address}\"");
    let listen = "kind = \"tcp\"\nlisten = \"127.0.0.1:0\"";
    let (instrument, port) = TTYPort::pair().expect("a pseudo-terminal");
    let name = port.name().expect("a name");
    let serial = format!("kind = \"serial\"\nport = \"{name}\"\nbaud = 115200");
    repeated("settle", [&connect, listen, &serial], |daemon| {
        let (called, _) = server.accept().expect("the daemon calls");
        let second = daemon.address_of("nav second", "tcp");
        let calling = TcpStream::connect(second).expect("the daemon listens");
        [
            Instrument::Tcp(called),
            Instrument::Tcp(calling),
            Instrument::Serial(instrument),
        ]
    });
    drop(port);
}

#[test]
fn a_log_takes_the_place_of_live_sources() {
    let folder = tempfile::tempdir().expect("folder");
    let data = echotank_testing::repository().join("tests/data");
    let (rig, out) = (
        rig(folder.path(), "settle", [UDP; 3]),
        folder.path().join("out"),
    );
    let log = data.join("nav/seapath330_90s.rvdas");
    let arguments = [
        "--nav".as_ref(),
        log.as_os_str(),
        "--pings".as_ref(),
        "1..3".as_ref(),
        "--formats".as_ref(),
        "npz".as_ref(),
        "--set".as_ref(),
        "nav.origin=first-fix".as_ref(),
    ];
    replay_into(&out, &rig, &arguments);
    let truth = fs::read_to_string(out.join("truth.jsonl")).expect("truth");
    assert_eq!(truth.lines().count(), 3, "{truth}");
    assert!(
        !truth.contains("\"roll_deg\":0.0"),
        "the log's roll: {truth}"
    );
}
