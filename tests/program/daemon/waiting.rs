//! A daemon that cannot ping reports what it waits for.

use std::net::UdpSocket;
use std::process::Command;
use std::time::{Duration, Instant};

use echotank_runtime::io::control::client;

use super::modes::status;
use super::{Daemon, LIVE, PATIENCE, sentence};

#[test]
fn the_status_names_what_the_first_ping_waits_for() {
    let folder = tempfile::tempdir().expect("folder");
    let path = folder.path().join("live.toml");
    std::fs::write(&path, LIVE).expect("written");
    let mut daemon = Daemon::start(&[
        path.to_str().expect("text"),
        "--set",
        "control.listen=127.0.0.1:0",
        "--set",
        "nav.source.0.provides=[\"position\", \"heading\", \"roll-pitch\"]",
    ]);
    let nav = daemon.announced("nav bridge", "udp");
    let at = daemon.announced("control http", "http");
    let first_line = || status(at)["nav"][0].as_str().unwrap_or("").to_owned();
    let until = |what: &str, says: &mut dyn FnMut(&str)| {
        let begun = Instant::now();
        loop {
            let line = first_line();
            if line.contains(what) {
                return line;
            }
            assert!(begun.elapsed() < PATIENCE, "no `{what}`: {line}");
            says(&line);
            std::thread::sleep(Duration::from_millis(50));
        }
    };
    until(
        "waiting for navigation: no source has sent anything",
        &mut |_| {},
    );
    let socket = UdpSocket::bind("127.0.0.1:0").expect("socket");
    let say = |bodies: &[&str]| {
        let text: String = bodies.iter().map(|b| sentence(b)).collect();
        let _ = socket.send_to(text.as_bytes(), nav);
    };
    // A receiver without a date; then a date long past; then attitude.
    let fix = [
        "GPGGA,120000.00,5400.000000,N,01000.000000,E,1,9,0.9,1.0,M,0.0,M,,",
        "GPHDT,123.45,T",
    ];
    say(&fix);
    until("have no date", &mut |_| {});
    say(&["GPZDA,120000.10,17,03,2012,00,00"]);
    let line = until("no roll-pitch from bridge yet", &mut |_| say(&fix));
    assert!(!line.contains("no position"), "{line}");
    // Waiting is not an error state.
    assert_eq!(client::get(at, "/healthz", None).expect("answers").0, 200);
    until("nav bridge", &mut |_| {
        say(&["PSXN,23,1.50,-2.50,123.45,0.20"])
    });
    daemon.terminate();
}

#[test]
fn a_log_without_required_navigation_ends_the_daemon_with_a_message() {
    // Also with `loop`.
    let log = echotank_testing::repository().join("tests/data/nav/gyro_90s.rvdas");
    for clock in ["realtime", "fast"] {
        let done = Command::new(env!("CARGO_BIN_EXE_echotank"))
            .arg("run")
            .current_dir(echotank_testing::repository())
            .args([
                "--set",
                &format!("nav.source.0.path=\"{}\"", log.display()),
                "--set",
                "sonar.output.sevenk.listen=127.0.0.1:0",
                "--set",
                &format!("run.clock=\"{clock}\""),
            ])
            .output()
            .expect("echotank runs");
        let said = String::from_utf8_lossy(&done.stderr);
        assert!(!done.status.success(), "{clock}: {said}");
        assert!(said.contains("no position from"), "{clock}: {said}");
        assert!(said.contains("`provides`"), "{clock}: {said}");
    }
}
