//! Tests that a daemon that cannot ping reports the reason for which it waits.

use std::net::UdpSocket;

use echotank_runtime::io::control::client;

use super::modes::status;
use super::{Daemon, MRU, eventually, gnss, live, sentence};
use crate::{Ended, run, sets};

#[test]
fn the_status_names_what_the_first_ping_waits_for() {
    let folder = tempfile::tempdir().expect("folder");
    let mut daemon = Daemon::start(
        live(folder.path()),
        [
            "control.listen=127.0.0.1:0",
            "nav.source.0.provides=[\"position\", \"heading\", \"roll-pitch\"]",
        ],
    );
    let nav = daemon.announced("nav bridge", "udp");
    let at = daemon.announced("control http", "http");
    let until = |what: &str, says: &mut dyn FnMut()| {
        eventually(|| {
            let status = status(at);
            let lines = status["nav"].as_array().into_iter().flatten();
            let lines: Vec<&str> = lines.filter_map(|line| line.as_str()).collect();
            let line = lines.join("\n");
            if line.contains(what) {
                return Ok(line);
            }
            says();
            Err(format!("no `{what}`: {line}"))
        })
    };
    until(
        "waiting for navigation: no source has sent anything",
        &mut || {},
    );
    let socket = UdpSocket::bind("127.0.0.1:0").expect("socket");
    let say = |bodies: &[&str]| {
        let text: String = bodies.iter().map(|b| sentence(b)).collect();
        let _ = socket.send_to(text.as_bytes(), nav);
    };
    // A receiver without a date, then an old date, then attitude.
    let fix = [
        "GPGGA,120000.00,5400.000000,N,01000.000000,E,1,9,0.9,1.0,M,0.0,M,,",
        "GPHDT,123.45,T",
    ];
    say(&fix);
    until("have no date", &mut || {});
    say(&["GPZDA,120000.10,17,03,2012,00,00"]);
    let line = until("no roll-pitch from bridge yet", &mut || say(&fix));
    assert!(!line.contains("no position"), "{line}");
    // Waiting is not an error state.
    assert_eq!(client::get(at, "/healthz", None).expect("answers").0, 200);
    until("nav bridge", &mut || say(&[MRU]));
    daemon.terminate();
}

#[test]
fn a_live_source_without_provides_owns_what_it_sends() {
    let folder = tempfile::tempdir().expect("folder");
    let mut daemon = Daemon::start(live(folder.path()), ["control.listen=127.0.0.1:0"]);
    let nav = daemon.announced("nav bridge", "udp");
    let at = daemon.announced("control http", "http");
    let socket = UdpSocket::bind("127.0.0.1:0").expect("socket");
    let until = |more: &str, pings: u64, want: serde_json::Value| {
        eventually(|| {
            let text = gnss(0.0, 0) + more;
            let _ = socket.send_to(text.as_bytes(), nav);
            std::thread::sleep(std::time::Duration::from_millis(50));
            let status = status(at);
            let made = status["pings_delivered"].as_u64().unwrap_or(0);
            match made >= pings && status["nav_owners"] == want {
                true => Ok(()),
                false => Err(status.to_string()),
            }
        });
    };
    // The daemon pings without attitude.
    let gnss_alone = serde_json::json!({ "position": "bridge", "heading": "bridge" });
    until("", 3, gnss_alone);
    let whole = serde_json::json!({
        "position": "bridge", "heading": "bridge", "roll-pitch": "bridge", "heave": "bridge",
    });
    until(&sentence(MRU), 6, whole);
    daemon.terminate();
}

#[test]
fn a_log_without_required_navigation_ends_the_daemon_with_a_message() {
    // The same is true with `loop`.
    let log = echotank_testing::repository().join("tests/data/nav/gyro_90s.rvdas");
    for clock in ["realtime", "fast"] {
        let settings = sets([
            &format!("nav.source.0.path=\"{}\"", log.display()),
            "sonar.output.sevenk.listen=127.0.0.1:0",
            &format!("run.clock=\"{clock}\""),
        ]);
        let Ended { code, err, .. } = run("run", settings);
        assert_eq!(code, Some(2), "{clock}: {err}");
        let missing = "no source gives a position: seapath gives heading";
        assert!(err.contains(missing), "{clock}: {err}");
    }
}
