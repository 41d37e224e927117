//! The daemon as its user runs it: a process, its ports, its signals.

mod control;
mod diagnostics;
mod families;
mod faults;
mod killed;
mod load;
mod makers_client;
mod modes;
mod nav_while_pinging;
mod overload;
mod plans;
mod scored;
mod streaming;
mod triggers;
mod waiting;

use std::io::{BufRead, BufReader, Read};
use std::net::{SocketAddr, UdpSocket};
use std::process::{Child, ChildStdout, Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use echotank_protocols::sevenk::file::FileReader;
use echotank_protocols::sevenk::{Command as Request, RecordBody};
use echotank_runtime::io::sonar::client::SevenKClient;
use echotank_runtime::io::sonar::verify::{Verifier, ping_number};

/// Time limit of a test, far beyond what a loaded machine needs.
const PATIENCE: Duration = Duration::from_secs(60);

/// A running daemon, killed when dropped.
struct Daemon {
    child: Child,
    stdout: BufReader<ChildStdout>,
    printed: String,
}

impl Daemon {
    fn start(arguments: &[&str]) -> Self {
        let mut child = Command::new(env!("CARGO_BIN_EXE_echotank"))
            .arg("run")
            .args(arguments)
            .current_dir(echotank_testing::repository())
            .stdout(Stdio::piped())
            .spawn()
            .expect("echotank runs");
        let stdout = BufReader::new(child.stdout.take().expect("piped"));
        Self {
            child,
            stdout,
            printed: String::new(),
        }
    }

    /// The word after `before` in the first line that begins with `line`.
    fn announced(&mut self, line: &str, before: &str) -> SocketAddr {
        loop {
            let mut text = String::new();
            let read = self.stdout.read_line(&mut text).expect("readable");
            assert!(
                read > 0,
                "the daemon ended before it said `{line}`:\n{}",
                self.printed
            );
            self.printed += &text;
            if text.starts_with(line) {
                let mut words = text.split_whitespace().skip_while(|word| *word != before);
                return words
                    .nth(1)
                    .and_then(|word| word.parse().ok())
                    .expect("an address");
            }
        }
    }

    /// The same from the start of the output.
    fn address_of(&mut self, line: &str, before: &str) -> SocketAddr {
        let address = |text: &str| {
            let mut words = text.split_whitespace().skip_while(|word| *word != before);
            words.nth(1).and_then(|word| word.parse().ok())
        };
        let mut said = self.printed.lines();
        let found = said.find(|text| text.starts_with(line)).and_then(address);
        found.unwrap_or_else(|| self.announced(line, before))
    }

    /// Stops the daemon and returns everything it printed.
    fn terminate(mut self) -> String {
        let told = Command::new("kill")
            .args(["-TERM", &self.child.id().to_string()])
            .status()
            .expect("kill");
        assert!(told.success());
        let mut printed = std::mem::take(&mut self.printed);
        self.stdout.read_to_string(&mut printed).expect("readable");
        let status = self.child.wait().expect("ended");
        assert!(status.success(), "{status}\n{printed}");
        printed
    }
}

impl Drop for Daemon {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// The settings record of the next ping.
fn next_settings(client: &mut SevenKClient, verifier: &mut Verifier) -> (u32, f32) {
    let until = Instant::now() + PATIENCE;
    while Instant::now() < until {
        let Some(record) = client
            .next_record(Duration::from_millis(500))
            .expect("connected")
        else {
            continue;
        };
        verifier.note(record.record_type(), record.body());
        let parsed = record.record().expect("whole");
        if let Ok(RecordBody::SonarSettings(settings)) = RecordBody::parse(&parsed) {
            return (settings.ping_number, settings.range_m);
        }
    }
    panic!("no ping came");
}

#[test]
fn quickstart_pings_obeys_and_ends_with_its_record_closed() {
    let folder = tempfile::tempdir().expect("folder");
    let record = format!("record.directory={:?}", folder.path());
    // A seabed of low density: real-time capacity is measured by benchmarks.
    let mut daemon = Daemon::start(&[
        "--set",
        "sonar.output.sevenk.listen=127.0.0.1:0",
        "--set",
        "scene.seabed.density_per_m2=0.2",
        "--set",
        &record,
    ]);
    let address = daemon.announced("7k hull", "tcp");
    let mut client = SevenKClient::connect(address).expect("listening");
    let mut verifier = Verifier::default();
    client.subscribe(&[7000, 7007, 7038]).expect("subscribed");
    let (first, range_m) = next_settings(&mut client, &mut verifier);
    assert_eq!(range_m, 150.0);
    client
        .command(Request::Range { range_m: 90.0 })
        .expect("acknowledged");
    assert!(
        client.command(Request::Range { range_m: 1e6 }).is_err(),
        "refused"
    );
    // Pings under way keep the old range; the new range follows without a gap.
    let mut last = first;
    loop {
        let (number, range_m) = next_settings(&mut client, &mut verifier);
        assert_eq!(number, last + 1);
        last = number;
        if range_m == 90.0 {
            break;
        }
        assert_eq!(range_m, 150.0);
        assert!(last - first < 200, "the range was never obeyed");
    }
    let tally = verifier.tally(7038);
    assert_eq!((tally.lost, tally.duplicate), (0, 0), "{tally:?}");
    let printed = daemon.terminate();
    assert!(
        printed.contains("0 dropped") || printed.contains("1 ever"),
        "{printed}"
    );
    assert!(printed.contains("1 refused commands"), "{printed}");

    let files: Vec<_> = std::fs::read_dir(folder.path())
        .expect("folder")
        .map(|e| e.expect("entry").path())
        .collect();
    assert_eq!(files.len(), 1, "{files:?}");
    let bytes = std::fs::read(&files[0]).expect("record");
    let records: Vec<_> = FileReader::new(&bytes)
        .map(|r| r.expect("sound").record)
        .collect();
    let types: Vec<u32> = records.iter().map(|r| r.frame.record_type_id).collect();
    assert_eq!(
        (types[0], types[types.len() - 1]),
        (7200, 7300),
        "header and catalogue"
    );
    let numbers: Vec<u32> = records
        .iter()
        .filter(|r| r.frame.record_type_id == 7000)
        .filter_map(|r| ping_number(7000, r.body()))
        .collect();
    assert!(
        numbers.len() as u32 >= last && numbers.windows(2).all(|w| w[1] == w[0] + 1),
        "{numbers:?}"
    );
}

/// A small rig with UDP navigation and prediction.
const LIVE: &str = r#"
[medium]
sound_speed_m_per_s = 1500.0
absorption = "none"
[nav]
origin = { latitude_deg = 54.0, longitude_deg = 10.0 }
mode = "predict"
vertical = "waterline"
max_extrapolation_ms = 2000.0
[[nav.source]]
name = "bridge"
kind = "udp"
listen = "127.0.0.1:0"
time = "message"
[scene]
seed = 1
[scene.seabed]
shape = "plane"
depth_m = 20.0
density_per_m2 = 0.05
[run]
latency_ms = 50.0
[[sonar]]
name = "live"
[sonar.pulse]
kind = "cw"
center_frequency_khz = 100.0
duration_ms = 1.0
[[sonar.transmit]]
name = "tx"
pattern = "omnidirectional"
[[sonar.receive]]
name = "rx"
transmit = "tx"
elements = 4
spacing_m = 0.0075
[sonar.receiver]
sample_rate_khz = 20.0
rx_filter = "none"
full_scale_v = 1.0
[sonar.ping]
range_m = 50.0
rate_hz = 5.0
source_level_db = 200.0
gain_db = 0.0
[sonar.output.sevenk]
id = 103
arrays = ["rx"]
listen = "127.0.0.1:0"
"#;

fn sentence(body: &str) -> String {
    let sum = body.bytes().fold(0, |a, b| a ^ b);
    format!("${body}*{sum:02X}\r\n")
}

/// GGA, HDT and PSXN,23 of a turning platform, twenty times a second, until stopped.
fn bridge(to: SocketAddr, stop: Arc<AtomicBool>) -> thread::JoinHandle<()> {
    thread::spawn(move || {
        let socket = UdpSocket::bind("127.0.0.1:0").expect("socket");
        while !stop.load(Ordering::Acquire) {
            let now = SystemTime::now()
                .duration_since(UNIX_EPOCH)
                .expect("after 1970");
            let of_day = now.as_secs() % 86_400;
            let (h, m, s) = (of_day / 3600, of_day / 60 % 60, of_day % 60);
            let date = chrono::DateTime::from_timestamp(now.as_secs() as i64, 0)
                .expect("date")
                .format("%d,%m,%Y");
            let time = format!("{h:02}{m:02}{s:02}.{:02}", now.subsec_millis() / 10);
            let text = sentence(&format!("GPZDA,{time},{date},00,00"))
                + &sentence(&format!(
                    "GPGGA,{time},5400.000000,N,01000.000000,E,1,9,0.9,1.0,M,0.0,M,,"
                ))
                + &sentence("GPHDT,123.45,T")
                + &sentence("PSXN,23,1.50,-2.50,123.45,0.20");
            let _ = socket.send_to(text.as_bytes(), to);
            thread::sleep(Duration::from_millis(50));
        }
    })
}

#[test]
fn live_udp_navigation_reaches_the_records() {
    let folder = tempfile::tempdir().expect("folder");
    let path = folder.path().join("live.toml");
    std::fs::write(&path, LIVE).expect("written");
    let mut daemon = Daemon::start(&[path.to_str().expect("text")]);
    let nav = daemon.announced("nav bridge", "udp");
    let address = daemon.announced("7k live", "tcp");
    let stop = Arc::new(AtomicBool::new(false));
    let bridge = bridge(nav, stop.clone());
    let mut client = SevenKClient::connect(address).expect("listening");
    client.subscribe(&[1012, 1013, 1003]).expect("subscribed");
    let (mut attitude, mut heading, mut position) = (None, None, None);
    let until = Instant::now() + PATIENCE;
    while Instant::now() < until && (attitude.is_none() || heading.is_none() || position.is_none())
    {
        let Some(record) = client
            .next_record(Duration::from_millis(500))
            .expect("connected")
        else {
            continue;
        };
        match RecordBody::parse(&record.record().expect("whole")).expect("known") {
            RecordBody::RollPitchHeave(r) => attitude = Some(r),
            RecordBody::Heading(r) => heading = Some(r),
            RecordBody::Position(r) => position = Some(r),
            _ => {}
        }
    }
    stop.store(true, Ordering::Release);
    bridge.join().expect("bridge");
    let printed = daemon.terminate();
    let (attitude, heading, position) = (
        attitude.expect(&printed),
        heading.expect("1013"),
        position.expect("1003"),
    );
    let near = |got: f64, want: f64, what: &str| {
        assert!((got - want).abs() < 1e-4, "{what}: got {got} want {want}")
    };
    near(f64::from(attitude.roll_rad).to_degrees(), 1.5, "roll");
    near(f64::from(attitude.pitch_rad).to_degrees(), -2.5, "pitch");
    near(
        f64::from(attitude.heave_up_m),
        -0.2,
        "heave, up on the wire and down on the bridge",
    );
    near(
        f64::from(heading.heading_rad).to_degrees(),
        123.45,
        "heading",
    );
    near(
        position.latitude_rad_or_northing_m.to_degrees(),
        54.0,
        "latitude",
    );
    near(
        position.longitude_rad_or_easting_m.to_degrees(),
        10.0,
        "longitude",
    );
    assert!(printed.contains("nav bridge"), "{printed}");
}

#[test]
fn a_log_that_is_not_looped_ends_the_daemon() {
    let mut daemon = Daemon::start(&[
        "hil-configs/points.toml",
        "--set",
        "sonar.output.sevenk.listen=127.0.0.1:0",
        "--set",
        "sonar.model.synthesis=direct",
    ]);
    let mut printed = String::new();
    daemon
        .stdout
        .read_to_string(&mut printed)
        .expect("readable");
    let status = daemon.child.wait().expect("ended");
    assert!(status.success(), "{status}\n{printed}");
    // The last ping's window ends beyond the track.
    assert!(
        printed.contains("pings 10 made") || printed.contains("pings 9 made"),
        "{printed}"
    );
}

#[test]
fn a_bad_configuration_does_not_start_and_reports_every_problem() {
    let path = echotank_testing::repository().join("hil-configs/points.toml");
    let done = Command::new(env!("CARGO_BIN_EXE_echotank"))
        .arg("run")
        .arg(path)
        .args([
            "--set",
            "sonar.ping.range_m=-5",
            "--set",
            "sonar.pulse.durration_ms=3",
            "--set",
            "medium.sound_speed_m_per_s=9",
        ])
        .output()
        .expect("echotank runs");
    assert_eq!(done.status.code(), Some(2));
    let said = String::from_utf8_lossy(&done.stderr);
    for word in [
        "range_m",
        "durration_ms",
        "duration_ms",
        "sound_speed_m_per_s",
    ] {
        assert!(said.contains(word), "{word}:\n{said}");
    }
}
