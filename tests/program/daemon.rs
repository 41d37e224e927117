//! Tests of the daemon as its user runs it: a process, its ports and its signals.

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
mod record_nav;
mod scored;
mod streaming;
mod triggers;
mod waiting;

use std::ffi::OsStr;
use std::fmt::Display;
use std::io::{BufRead, BufReader, Read};
use std::net::{SocketAddr, UdpSocket};
use std::path::Path;
use std::process::{Child, ChildStdout, Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use echotank_protocols::sevenk::file::FileReader;
use echotank_protocols::sevenk::{Command as Request, RecordBody};
use echotank_runtime::io::sonar::client::SevenKClient;
use echotank_runtime::io::sonar::verify::{Verifier, ping_number};

use crate::{command, ended, files_in, sets};

/// Time limit of a test, far beyond the need of a loaded machine.
const PATIENCE: Duration = Duration::from_secs(60);

/// Repeats `look` until it succeeds. After the time limit, the test fails with the last error of `look`.
fn eventually<T, E: Display>(mut look: impl FnMut() -> Result<T, E>) -> T {
    let until = Instant::now() + PATIENCE;
    loop {
        match look() {
            Ok(found) => return found,
            Err(why) => assert!(Instant::now() < until, "{why}"),
        }
        thread::sleep(Duration::from_millis(5));
    }
}

/// Running daemon, killed when dropped.
struct Daemon {
    child: Child,
    stdout: BufReader<ChildStdout>,
    printed: String,
}

impl Daemon {
    /// Runs a configuration with the given settings.
    fn start<S: AsRef<str>>(
        config: impl AsRef<OsStr>,
        settings: impl IntoIterator<Item = S>,
    ) -> Self {
        Self::spawn(command("run").arg(config).args(sets(settings)))
    }

    fn spawn(command: &mut Command) -> Self {
        let mut child = command
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

    /// Sends a signal to the process.
    fn signal(&self, name: &str) {
        let told = Command::new("kill")
            .args([name, &self.child.id().to_string()])
            .status();
        assert!(told.expect("kill").success());
    }

    /// Waits for the first line that begins with `line`, and returns the address after the word `before`.
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
                return address(&text, before).expect("an address");
            }
        }
    }

    /// As [`Self::announced`], from the start of the output.
    fn address_of(&mut self, line: &str, before: &str) -> SocketAddr {
        let mut said = self.printed.lines();
        let found = said.find(|text| text.starts_with(line));
        let found = found.and_then(|text| address(text, before));
        found.unwrap_or_else(|| self.announced(line, before))
    }

    /// Stops the daemon and returns everything it printed.
    fn terminate(self) -> String {
        self.signal("-TERM");
        self.ended()
    }

    /// Waits for the end of the daemon and returns everything it printed.
    fn ended(mut self) -> String {
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

/// The address after the word `before` in a text.
fn address(text: &str, before: &str) -> Option<SocketAddr> {
    let mut words = text.split_whitespace().skip_while(|word| *word != before);
    words.nth(1).and_then(|word| word.parse().ok())
}

/// Ping number and range of the settings record of the next ping.
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

/// As after `cargo install`: no repository in the working folder.
#[test]
fn without_a_repository_the_built_in_quickstart_runs_and_leaves_no_file() {
    let folder = tempfile::tempdir().expect("folder");
    let mut daemon = Daemon::spawn(
        command("run")
            .current_dir(folder.path())
            .env("TMPDIR", folder.path())
            .args(sets([
                "sonar.output.sevenk.listen=127.0.0.1:0",
                "control.listen=127.0.0.1:0",
                "scene.seabed.density_per_m2=0.2",
            ])),
    );
    let address = daemon.announced("7k hull", "tcp");
    let mut client = SevenKClient::connect(address).expect("listening");
    client.subscribe(&[7000]).expect("subscribed");
    next_settings(&mut client, &mut Verifier::default());
    daemon.terminate();
    assert_eq!(crate::files_in(folder.path()).count(), 0);
}

#[test]
fn quickstart_pings_obeys_and_ends_with_its_record_closed() {
    let folder = tempfile::tempdir().expect("folder");
    let record = format!("record.directory={:?}", folder.path());
    // A seabed of low density suffices; benchmarks measure the real-time capacity.
    let mut daemon = Daemon::spawn(command("run").args(sets([
        "sonar.output.sevenk.listen=127.0.0.1:0",
        "scene.seabed.density_per_m2=0.2",
        &record,
    ])));
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
    // Pings in progress keep the old range. The new range follows without a gap.
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

    let files: Vec<_> = files_in(folder.path()).collect();
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

/// Small sonar of the test rigs with live navigation.
const LIVE_SONAR: &str = include_str!("../data/live_sonar.toml");

/// Rig with UDP navigation and prediction, without its sonar.
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
"#;

fn sentence(body: &str) -> String {
    let sum = body.bytes().fold(0, |a, b| a ^ b);
    format!("${body}*{sum:02X}\r\n")
}

/// Path of the live rig in a folder.
fn live(folder: &Path) -> std::path::PathBuf {
    let path = folder.join("live.toml");
    std::fs::write(&path, format!("{LIVE}{LIVE_SONAR}")).expect("written");
    path
}

/// ZDA, GGA and HDT of the current time. The date is `ahead_s` seconds ahead, and the latitude `minutes` north
/// of 54 degrees.
fn gnss(minutes: f64, ahead_s: u64) -> String {
    let now = SystemTime::now()
        .duration_since(UNIX_EPOCH)
        .expect("after 1970");
    let date =
        chrono::DateTime::from_timestamp((now.as_secs() + ahead_s) as i64, 0).expect("a date");
    let time = format!("{}.{:03}", date.format("%H%M%S"), now.subsec_millis());
    sentence(&format!("GPZDA,{time},{},00,00", date.format("%d,%m,%Y")))
        + &sentence(&format!(
            "GPGGA,{time},54{minutes:08.5},N,01000.00000,E,1,9,0.9,1.0,M,0.0,M,,"
        ))
        + &sentence("GPHDT,123.45,T")
}

/// Attitude of a platform at rest.
const MRU: &str = "PSXN,23,1.50,-2.50,123.45,0.20";

/// Sends GNSS and attitude sentences twenty times a second until stopped.
fn bridge(to: SocketAddr, stop: Arc<AtomicBool>) -> thread::JoinHandle<()> {
    thread::spawn(move || {
        let socket = UdpSocket::bind("127.0.0.1:0").expect("socket");
        while !stop.load(Ordering::Acquire) {
            let text = gnss(0.0, 0) + &sentence(MRU);
            let _ = socket.send_to(text.as_bytes(), to);
            thread::sleep(Duration::from_millis(50));
        }
    })
}

#[test]
fn live_udp_navigation_reaches_the_records() {
    let folder = tempfile::tempdir().expect("folder");
    let mut daemon = Daemon::start(live(folder.path()), [""; 0]);
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
    for (what, got, want) in [
        ("roll", f64::from(attitude.roll_rad).to_degrees(), 1.5),
        ("pitch", f64::from(attitude.pitch_rad).to_degrees(), -2.5),
        // Heave is positive up in the record and positive down in the sentence.
        ("heave", attitude.heave_up_m.into(), -0.2),
        (
            "heading",
            f64::from(heading.heading_rad).to_degrees(),
            123.45,
        ),
        (
            "latitude",
            position.latitude_rad_or_northing_m.to_degrees(),
            54.0,
        ),
        (
            "longitude",
            position.longitude_rad_or_easting_m.to_degrees(),
            10.0,
        ),
    ] {
        assert!((got - want).abs() < 1e-4, "{what}: got {got} want {want}");
    }
    assert!(printed.contains("nav bridge"), "{printed}");
}

#[test]
fn a_log_that_is_not_looped_ends_the_daemon() {
    let printed = Daemon::start(
        "hil-configs/points.toml",
        [
            "sonar.output.sevenk.listen=127.0.0.1:0",
            "sonar.model.synthesis=direct",
            "run.clock=fast",
        ],
    )
    .ended();
    // The window of the last ping ends beyond the track.
    assert!(
        printed.contains("pings 10 made") || printed.contains("pings 9 made"),
        "{printed}"
    );
}

#[test]
fn a_bad_configuration_does_not_start_and_reports_every_problem() {
    let settings = sets([
        "sonar.ping.range_m=-5",
        "sonar.pulse.durration_ms=3",
        "medium.sound_speed_m_per_s=9",
    ]);
    let done = ended(command("run").arg("hil-configs/points.toml").args(settings));
    assert_eq!(done.code, Some(2));
    for word in [
        "range_m",
        "durration_ms",
        "duration_ms",
        "sound_speed_m_per_s",
    ] {
        assert!(done.err.contains(word), "{word}:\n{}", done.err);
    }
}
