//! Tests of live navigation faults while pinging: disconnection, invalid bytes, silence, contradiction and date jumps. At the same
//! time, navigation output is received and decoded.

use std::io::Write;
use std::net::{SocketAddr, UdpSocket};
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering::SeqCst};
use std::sync::{Arc, Mutex};
use std::thread;
use std::time::Duration;

use echotank_config as config;
use echotank_config::spec::NavDialect;
use echotank_core::navigation::FixQuality;
use echotank_core::time::UtcNs;
use echotank_nav::framing::{Checksum, Framing};
use echotank_nav::reading::{Kind, Reading};
use echotank_nav::sentence::decode;
use echotank_protocols::sevenk::RecordBody;
use echotank_runtime::daemon::Daemon;
use echotank_runtime::io::sonar::client::SevenKClient;
use serialport::{SerialPort, TTYPort};

use super::{LIVE_SONAR, MRU, eventually, gnss, sentence};

/// Ping period of the live sonar, seconds.
const PING_S: f64 = 0.1;
const YEAR_S: u64 = 365 * 86_400;

/// Faults of the current instrument data.
#[derive(Default)]
struct Faults {
    stop: AtomicBool,
    mru_silent: AtomicBool,
    mru_garbage: AtomicBool,
    first_silent: AtomicBool,
    /// True if ZDA and RMC are a year ahead.
    date_jumps: AtomicBool,
}

fn rig(folder: &Path, mru: &Path, out: SocketAddr) -> config::spec::RigSpec {
    let text = format!(
        r#"
[medium]
sound_speed_m_per_s = 1500.0
absorption = "none"
[nav]
origin = {{ latitude_deg = 54.0, longitude_deg = 10.0 }}
mode = "predict"
failover_s = 0.4
hold_off_s = 0.4
stale_s = 0.6
lost_s = 1.5
max_extrapolation_ms = 300.0
[[nav.source]]
name = "first"
kind = "udp"
listen = "127.0.0.1:0"
provides = ["position", "heading"]
[[nav.source]]
name = "mru"
kind = "serial"
port = "{mru}"
baud = 115200
time = "arrival"
provides = ["roll-pitch", "heave"]
[[nav.source]]
name = "second"
kind = "udp"
listen = "127.0.0.1:0"
provides = ["position", "heading"]
[[nav.output]]
name = "board"
kind = "udp"
to = "{out}"
rate_hz = 5.0
pulse = "byte"
[run]
latency_ms = 500.0
queue_pings = 24
status_interval_s = 0.1
{LIVE_SONAR}"#,
        mru = mru.display(),
    );
    echotank_runtime::config_files::parse(&text, folder).unwrap_or_else(|errors| panic!("{errors}"))
}

/// Pseudo-terminal with a stable name. Dropping it disconnects the serial link.
fn plug_in(name: &Path) -> (TTYPort, TTYPort) {
    let (instrument, port) = TTYPort::pair().expect("a pseudo-terminal");
    let _ = std::fs::remove_file(name);
    std::os::unix::fs::symlink(port.name().expect("a name"), name).expect("a link");
    (instrument, port)
}

/// Sends instrument data fifty times a second.
fn instruments(
    faults: Arc<Faults>,
    mru: Arc<Mutex<Option<(TTYPort, TTYPort)>>>,
    [first, second]: [SocketAddr; 2],
) -> thread::JoinHandle<()> {
    thread::spawn(move || {
        let socket = UdpSocket::bind("127.0.0.1:0").expect("a socket");
        let mut k = 0_u64;
        while !faults.stop.load(SeqCst) {
            if k.is_multiple_of(5) {
                if !faults.first_silent.load(SeqCst) {
                    let jumps = faults.date_jumps.load(SeqCst);
                    let text = gnss(0.0, if jumps { YEAR_S } else { 0 });
                    let _ = socket.send_to(text.as_bytes(), first);
                }
                // The second source contradicts the first by one minute, 1.85 km.
                let _ = socket.send_to(gnss(1.0, 0).as_bytes(), second);
            }
            if let Some((line, _)) = &mut *mru.lock().expect("unspoiled") {
                let _ = if faults.mru_garbage.load(SeqCst) {
                    let noise: Vec<u8> = (0..40)
                        .map(|i| (i * 37 + k * 101 + (k >> 3)) as u8)
                        .collect();
                    line.write(&[&noise[..], b"$PSXN,23,1.50,-2"].concat())
                } else if faults.mru_silent.load(SeqCst) {
                    Ok(0)
                } else {
                    line.write(sentence(MRU).as_bytes())
                };
            }
            k += 1;
            thread::sleep(Duration::from_millis(20));
        }
    })
}

/// Records of one ping that a topside client received.
#[derive(Clone, Copy, Debug, Default)]
struct Got {
    number: u32,
    utc_ns: i64,
    latitude_deg: Option<f64>,
    dead_reckoning: bool,
    attitude: bool,
    heading: bool,
}

fn listen(
    address: SocketAddr,
    pings: Arc<Mutex<Vec<Got>>>,
    faults: Arc<Faults>,
) -> thread::JoinHandle<()> {
    thread::spawn(move || {
        let mut client = SevenKClient::connect(address).expect("listening");
        client
            .subscribe(&[7000, 1003, 1012, 1013])
            .expect("subscribed");
        while !faults.stop.load(SeqCst) {
            let record = match client.next_record(Duration::from_millis(200)) {
                Ok(Some(record)) => record,
                Ok(None) => continue,
                // The daemon has ended.
                Err(_) => return,
            };
            let mut pings = pings.lock().expect("unspoiled");
            match RecordBody::parse(&record.record().expect("whole")).expect("known") {
                RecordBody::SonarSettings(settings) => pings.push(Got {
                    number: settings.ping_number,
                    utc_ns: record.frame.time.to_utc_ns().expect("a time"),
                    ..Got::default()
                }),
                body => {
                    // Navigation takes effect with the settings of its ping.
                    let Some(ping) = pings.last_mut() else {
                        continue;
                    };
                    match body {
                        RecordBody::Position(p) => {
                            ping.latitude_deg = Some(p.latitude_rad_or_northing_m.to_degrees());
                            ping.dead_reckoning = p.quality_flag == 1;
                        }
                        RecordBody::RollPitchHeave(_) => ping.attitude = true,
                        RecordBody::Heading(_) => ping.heading = true,
                        _ => {}
                    }
                }
            }
        }
    })
}

/// Datagrams and pulses that the receiving device gets.
fn hear(socket: UdpSocket, faults: Arc<Faults>) -> thread::JoinHandle<Vec<Vec<u8>>> {
    thread::spawn(move || {
        socket
            .set_read_timeout(Some(Duration::from_millis(100)))
            .expect("a timeout");
        let (mut heard, mut buffer) = (Vec::new(), [0; 2000]);
        while !faults.stop.load(SeqCst) {
            if let Ok(len) = socket.recv(&mut buffer) {
                heard.push(buffer[..len].to_vec());
            }
        }
        heard
    })
}

#[test]
fn pings_keep_their_rate_under_navigation_faults_and_flag_invalid_channels() {
    let folder = tempfile::tempdir().expect("a folder");
    let name = folder.path().join("mru");
    let mru = Arc::new(Mutex::new(Some(plug_in(&name))));
    let board = UdpSocket::bind("127.0.0.1:0").expect("a socket");
    let spec = rig(folder.path(), &name, board.local_addr().expect("bound"));
    let faults = Arc::new(Faults::default());
    let daemon_stop = Arc::new(AtomicBool::new(false));
    let daemon = Daemon::open(&spec, 1, daemon_stop.clone()).unwrap_or_else(|e| panic!("{e}"));
    let address = |start: &str| -> SocketAddr {
        let lines = daemon.describe();
        let line = lines.iter().find(|l| l.starts_with(start));
        let line = line.unwrap_or_else(|| panic!("no {start}: {lines:?}"));
        line.rsplit(' ')
            .next()
            .and_then(|a| a.parse().ok())
            .expect("an address")
    };
    let sinks = [address("nav first"), address("nav second")];
    let sonar = address("7k live tcp");
    let status = Arc::new(Mutex::new(String::new()));
    let pings = Arc::new(Mutex::new(Vec::new()));
    let device = hear(board, faults.clone());
    let written = status.clone();
    let running = thread::spawn(move || {
        daemon.run(|text| text.clone_into(&mut written.lock().expect("unspoiled")))
    });
    let senders = instruments(faults.clone(), mru.clone(), sinks);
    let topside = listen(sonar, pings.clone(), faults.clone());

    let until = |what: &str, holds: &dyn Fn(&str, &Got) -> bool| {
        eventually(|| {
            let text = status.lock().expect("unspoiled").clone();
            let all = pings.lock().expect("unspoiled").clone();
            // The last but one sentence is complete.
            let last = all.len().checked_sub(2).map(|i| all[i]);
            let is_so = last.is_some_and(|ping| holds(&text, &ping));
            is_so
                .then_some(())
                .ok_or(format!("{what}: {last:?}\n{text}"))
        });
    };
    let well = |text: &str, p: &Got| {
        text.contains("nav mru: ok")
            && text.contains("nav first: ok")
            && p.attitude
            && p.heading
            && !p.dead_reckoning
            && p.latitude_deg.is_some_and(|l| (l - 54.0).abs() < 1e-6)
    };
    until("all is well", &well);

    faults.mru_garbage.store(true, SeqCst);
    until("garbage", &|text, p| {
        text.contains("nav mru: stale") && !p.attitude && p.heading
    });
    faults.mru_garbage.store(false, SeqCst);
    until("garbage has ended", &well);

    *mru.lock().expect("unspoiled") = None;
    until("unplugged", &|text, p| {
        text.contains("nav mru: lost") && !p.attitude && p.heading
    });
    *mru.lock().expect("unspoiled") = Some(plug_in(&name));
    until("plugged in again", &|text, p| {
        well(text, p) && text.contains("1 reopened")
    });

    faults.first_silent.store(true, SeqCst);
    until("the second speaks", &|text, p| {
        text.contains("nav first: stale")
            && p.latitude_deg
                .is_some_and(|l| (l - 54.0 - 1.0 / 60.0).abs() < 1e-6)
            && !p.dead_reckoning
    });
    faults.mru_silent.store(true, SeqCst);
    until("silence beside it", &|text, p| {
        text.contains("nav mru: stale") && !p.attitude
    });
    faults.mru_silent.store(false, SeqCst);
    faults.first_silent.store(false, SeqCst);
    until("both are back", &well);

    // A few wrong dates are ignored. Persistent wrong dates are accepted, and the navigation is then outside the time of the pings.
    faults.date_jumps.store(true, SeqCst);
    let jumps = |text: &str| {
        let line = text.lines().find(|l| l.starts_with("nav first:"));
        line.is_some_and(|l| !l.contains(", 0 time jumps"))
    };
    until("dates jump", &|text, _| jumps(text));
    faults.date_jumps.store(false, SeqCst);
    until("dates are right again", &well);

    daemon_stop.store(true, SeqCst);
    running
        .join()
        .expect("no panic")
        .unwrap_or_else(|e| panic!("{e}"));
    faults.stop.store(true, SeqCst);
    senders.join().expect("sent");
    topside.join().expect("listened");
    let printed = status.lock().expect("unspoiled").clone();
    let pings = pings.lock().expect("unspoiled").clone();
    let invalid = pings.iter().filter(|p| !p.attitude).count();
    println!(
        "{} pings, {invalid} without a valid attitude\n{printed}",
        pings.len()
    );
    // Navigation causes no skipped ping. On a loaded machine late pings may be skipped; they keep their numbers.
    let count = |before: &str| -> u32 {
        let (_, rest) = printed
            .split_once(before)
            .unwrap_or_else(|| panic!("no `{before}` in {printed}"));
        rest.split(|c: char| !c.is_ascii_digit())
            .next()
            .and_then(|n| n.parse().ok())
            .expect("a number")
    };
    assert_eq!(count("skipped (nav "), 0, "{printed}");
    let mut missing = 0;
    for pair in pings.windows(2) {
        let steps = pair[1].number - pair[0].number;
        let step_s = (pair[1].utc_ns - pair[0].utc_ns) as f64 / 1e9;
        // 7k writes seconds as f32, in steps of 4 us.
        let off_s = step_s - PING_S * f64::from(steps);
        assert!(off_s.abs() < 1e-5, "{step_s} s at ping {}", pair[1].number);
        missing += steps - 1;
    }
    assert!(missing <= count(" made, "), "{missing} missing:\n{printed}");
    what_went_out(&device.join().expect("heard"), pings[0].utc_ns);
}

/// Checks the output: the device shares the clock of the pings. It receives a pulse, then the ZDA of that second, then GGA and HDT
/// of the same times.
fn what_went_out(datagrams: &[Vec<u8>], first_ping_ns: i64) {
    let mut last_second = None;
    let (mut pulses, mut fixes, mut headings) = (0, 0, 0);
    for (i, bytes) in datagrams.iter().enumerate() {
        if bytes[..] == [7] {
            pulses += 1;
            continue;
        }
        let mut framing = Framing::new();
        let mut left = &bytes[..];
        let mut readings: Vec<Reading> = Vec::new();
        while let Some(s) = framing.next(&mut left, UtcNs(0), 0) {
            assert_eq!(s.checksum, Checksum::Right, "{}", s.body);
            readings
                .push(decode(s.body, &NavDialect::default(), &mut String::new()).expect(s.body));
        }
        assert_eq!(framing.resync_bytes(), 0);
        if readings[0].kind == Kind::Zda {
            let utc = readings[0].instant().expect("dated");
            assert_eq!(utc.0 % 1_000_000_000, 0, "whole seconds only");
            assert!(
                (utc.0 - first_ping_ns).abs() < 3_600_000_000_000,
                "the pings' clock"
            );
            if let Some(before) = last_second {
                assert!(utc.0 > before, "{} after {before}", utc.0);
            }
            last_second = Some(utc.0);
            assert_eq!(
                datagrams[i - 1][..],
                [7],
                "the pulse comes before the ZDA that names it"
            );
        }
        for r in &readings {
            if r.kind == Kind::Gga && r.fix != FixQuality::None {
                let (latitude, longitude) = r.position_rad.expect("a position");
                let north = latitude.to_degrees() - 54.0;
                let (south, beside) = (north.abs(), (north - 1.0 / 60.0).abs());
                assert!(south.min(beside) < 1e-6 && (longitude.to_degrees() - 10.0).abs() < 1e-6);
                fixes += 1;
            }
            if r.kind == Kind::Hdt
                && let Some(heading) = r.heading_rad
            {
                assert!((heading.to_degrees() - 123.45).abs() < 1e-3);
                headings += 1;
            }
        }
    }
    println!("{pulses} pulses, {fixes} fixes, {headings} headings went out");
    assert!(
        pulses >= 3 && fixes >= 10 && headings >= 10,
        "{pulses} {fixes} {headings}"
    );
}
