//! Tests of `/control`, `/status`, `/metrics`, `/healthz` and `echotank ctl`.

use std::collections::BTreeMap;
use std::io::Write;
use std::path::Path;

use echotank_protocols::sevenk::RecordBody;
use echotank_runtime::io::control::client;
use echotank_runtime::io::sonar::client::SevenKClient;
use echotank_testing::repository;
use serde_json::json;

use super::modes::{rig, status, tell, wait_delivered};
use super::{Daemon, PATIENCE, eventually};
use crate::{ends_quietly, run};

fn quick(folder: &Path, more: &[&str]) -> Daemon {
    let limits = [
        "nav.loop=true",
        "sonar.limits.range_m=[10.0, 60.0]",
        "sonar.limits.gain_db=[0.0, 10.0]",
        "sonar.limits.source_level_db=[0.0, 10.0]",
    ];
    rig(folder, &[&limits, more].concat())
}

fn ctl(arguments: &[&str]) -> (bool, String) {
    let done = run("ctl", arguments);
    (done.code == Some(0), done.out + &done.err)
}

/// Number and sound speed of the next ping, and the number of points of every profile (1009) before it.
fn next_speed(client: &mut SevenKClient) -> (u32, f32, Vec<u32>) {
    let mut profiles = Vec::new();
    loop {
        let record = client.next_record(PATIENCE).expect("connected");
        let record = record.expect("a ping in time");
        let parsed = record.record().expect("whole");
        match RecordBody::parse(&parsed) {
            Ok(RecordBody::SoundVelocityProfile(profile)) => profiles.push(profile.rth.samples),
            Ok(RecordBody::SonarSettings(s)) => {
                return (s.ping_number, s.sound_velocity_m_per_s, profiles);
            }
            _ => {}
        }
    }
}

#[test]
fn a_profile_changed_while_pinging_takes_effect_at_one_ping() {
    let folder = tempfile::tempdir().expect("folder");
    let text = std::fs::read_to_string(repository().join("hil-configs/points.toml"));
    let text = text.expect("readable").replace(
        "sound_speed_m_per_s = 1500.0",
        "profile = { points = [[0.0, 1500.0], [20.0, 1480.0]] }",
    );
    let data = repository().join("hil-configs/data");
    let text = text.replace("\"data/", &format!("\"{}/", data.display()));
    let config = folder.path().join("bent.toml");
    std::fs::write(&config, text).expect("written");
    let more = [
        "nav.loop=true",
        "sonar.model.synthesis=direct",
        "sonar.output.sevenk.listen=127.0.0.1:0",
        "control.listen=127.0.0.1:0",
    ];
    let mut daemon = Daemon::start(config.to_str().expect("UTF-8"), more);
    let sevenk = daemon.announced("7k", "tcp");
    let at = daemon.announced("control http", "http").to_string();
    let mut client = SevenKClient::connect(sevenk).expect("listening");
    client.subscribe(&[7000, 1009]).expect("subscribed");
    let (mut last, speed, profiles) = next_speed(&mut client);
    assert!((1490.0..1500.0).contains(&speed), "{speed} m/s");
    assert_eq!(profiles, [2], "on subscription");

    let cast = folder.path().join("cast.vel");
    let points = "FTP NEW 3 54.4 10.3 08:13 11/26/2026\n0 1460\n10 1461\n30 1470\n";
    std::fs::write(&cast, points).expect("written");
    let cast = cast.to_str().expect("UTF-8");
    let (well, said) = ctl(&["--address", &at, "profile", cast]);
    assert!(well, "{said}");
    let refused = json!({ "do": "profile", "points": [[0.0, 1500.0]] });
    let (code, answer) = tell(at.parse().expect("an address"), &refused);
    assert_eq!(code, 409, "{answer}");
    assert_eq!(answer["why"], "1 points: must be 2 to 1000");

    let mut new = 0;
    while new < 3 {
        let (number, speed, profiles) = next_speed(&mut client);
        // A busy machine skips pings.
        assert!(number > last, "{number} after {last}");
        last = number;
        let is_new = speed < 1465.0;
        assert!(is_new || new == 0 && speed > 1490.0, "{speed} m/s");
        let first = is_new && new == 0;
        assert_eq!(profiles, if first { vec![3] } else { vec![] });
        new += u32::from(is_new);
    }
}

/// `echotank listen ADDRESS | head` and the like.
#[test]
fn clients_end_quietly_when_their_output_is_closed() {
    let folder = tempfile::tempdir().expect("folder");
    let mut daemon = quick(folder.path(), &[]);
    let sevenk = daemon.announced("7k", "tcp").to_string();
    let at = daemon.announced("control http", "http").to_string();
    for (name, arguments) in [
        ("listen", vec![sevenk.as_str()]),
        ("ctl", vec!["--address", &at, "status"]),
        ("ctl", vec!["--address", &at, "metrics"]),
    ] {
        ends_quietly(name, arguments);
    }
}

#[test]
fn settings_are_applied_refused_and_reported_over_http_and_ctl() {
    let folder = tempfile::tempdir().expect("folder");
    let mut daemon = quick(folder.path(), &[]);
    let at = daemon.announced("control http", "http");
    let (code, answer) = tell(at, &json!({ "do": "set", "range_m": 40.0, "gain_db": 3.0 }));
    assert_eq!(code, 200, "{answer}");
    assert_eq!(answer["asked"]["range_m"], 40.0);
    assert_eq!(answer["now"]["settings"]["gain_db"], 3.0);
    let (code, answer) = tell(at, &json!({ "do": "set", "range_m": 1e6 }));
    assert_eq!((code, &answer["accepted"]), (409, &json!(false)));
    let why = answer["why"].as_str().expect("a reason");
    assert!(why.starts_with("range_m = 1000000: must be from"), "{why}");
    for bad in [
        json!({ "do": "explode" }),
        json!({ "do": "set", "rang_m": 40.0 }),
        json!({ "do": "set", "sonar": "other", "range_m": 40.0 }),
        json!({ "do": "set" }),
        json!({ "do": "step", "pings": 0 }),
        json!([1, 2]),
    ] {
        let (code, answer) = tell(at, &bad);
        assert!((400..500).contains(&code), "{bad}: {code} {answer}");
        assert_eq!(answer["accepted"], false, "{bad}");
        assert!(answer["why"].is_string(), "{bad}: {answer}");
    }
    let long = json!({ "do": "set", "sonar": "x".repeat(70_000) });
    assert_eq!(tell(at, &long).0, 413);

    let address = at.to_string();
    let (well, said) = ctl(&["--address", &address, "set", "source_level_db=3"]);
    let shown = status(at);
    assert!(well, "{said}");
    assert_eq!(shown["sonars"][0]["settings"]["source_level_db"], 3.0);
    let (well, said) = ctl(&["--address", &address, "set", "range_m=1e6"]);
    assert!(!well && said.contains("range_m"), "{said}");
    wait_delivered(at, 2);
    let (well, said) = ctl(&["--address", &address, "status"]);
    assert!(well && said.contains("\"compute_margin\""), "{said}");
    assert!(shown["sonars"][0]["changes"]["refused"].as_u64() >= Some(1));

    let (code, text) = client::get(at, "/metrics", None).expect("answers");
    assert_eq!(code, 200);
    let made = text
        .lines()
        .find_map(|line| line.strip_prefix("echotank_pings_made{sonar=\"points\"} "))
        .expect("the counter");
    assert!(made.parse::<u64>().expect("a count") >= 2, "{made}");
    // Every sample line belongs to a metric with a declared type.
    for line in text.lines().filter(|line| !line.starts_with('#')) {
        let name = line.split(['{', ' ']).next().expect("a name");
        let name = name.trim_end_matches("_count").trim_end_matches("_sum");
        assert!(text.contains(&format!("# TYPE {name} ")), "{line}");
    }
    assert_eq!(client::get(at, "/healthz", None).expect("answers").0, 200);
    assert_eq!(client::get(at, "/nothing", None).expect("answers").0, 404);
    daemon.terminate();
}

/// Lengths of the `.s7k` files in a folder, by name.
fn recorded(folder: &Path) -> BTreeMap<String, u64> {
    let files = std::fs::read_dir(folder).expect("the folder");
    let files = files.map(|file| file.expect("an entry"));
    let length = |file: std::fs::DirEntry| {
        let name = file.file_name().into_string().expect("a name");
        (name, file.metadata().expect("a length").len())
    };
    files
        .map(length)
        .filter(|(name, _)| name.ends_with(".s7k"))
        .collect()
}

#[test]
fn recordings_stop_and_start_in_a_new_file_at_run_time() {
    let folder = tempfile::tempdir().expect("folder");
    let mut daemon = quick(folder.path(), &["record.at_start=false"]);
    let at = daemon.announced("control http", "http");
    let address = at.to_string();
    let after = |pings| wait_delivered(at, wait_delivered(at, 0) + pings);
    after(2);
    assert!(recorded(folder.path()).is_empty(), "off at the start");
    assert_eq!(status(at)["sonars"][0]["recording"]["on"], false);
    let (well, said) = ctl(&["--address", &address, "record", "on"]);
    assert!(well, "{said}");
    after(4);
    let file = &status(at)["sonars"][0]["recording"]["files"]["points.s7k"];
    assert_eq!(
        (&file["is_open"], &file["stopped"]),
        (&json!(true), &json!(null))
    );
    let command = json!({ "do": "record", "sonar": "points", "on": false });
    let (code, answer) = tell(at, &command);
    assert_eq!(code, 200, "{answer}");
    assert_eq!(
        answer["now"],
        json!({ "recording": false, "sonars": ["points"] })
    );
    // The ping on its way may still be recorded, and its file is flushed beside the pings.
    after(3);
    let first = recorded(folder.path());
    assert_eq!(first.len(), 1);
    after(4);
    assert_eq!(recorded(folder.path()), first, "the file is closed");
    let (code, answer) = tell(at, &json!({ "do": "record", "on": true }));
    assert_eq!(code, 200, "{answer}");
    after(3);
    assert_eq!(recorded(folder.path()).len(), 2, "a new file");
    for (bad, code, why) in [
        (
            json!({ "do": "record" }),
            422,
            "on is missing: must be true or false",
        ),
        (
            json!({ "do": "record", "on": "yes" }),
            422,
            "on = \"yes\": must be true or false",
        ),
        (
            json!({ "do": "record", "on": true, "sonar": "other" }),
            409,
            "no sonar is named other",
        ),
        (
            json!({ "do": "record", "on": true, "to": "/etc" }),
            422,
            "\"record\" has no such key",
        ),
    ] {
        let (got, answer) = tell(at, &bad);
        assert_eq!((got, &answer["accepted"]), (code, &json!(false)), "{bad}");
        let said = answer["why"].as_str().expect("a reason");
        assert!(said.contains(why), "{bad}: {said}");
    }
    let (well, said) = ctl(&["--address", &address, "record", "maybe"]);
    assert!(!well && said.contains("possible values: on, off"), "{said}");
    daemon.terminate();
    // Both files are complete: a reader finds whole pings.
    for name in recorded(folder.path()).keys() {
        let path = folder.path().join(name);
        let mended = run("recover", [path.to_str().expect("UTF-8")]);
        assert!(
            mended.out.contains("complete"),
            "{}{}",
            mended.out,
            mended.err
        );
    }
}

#[test]
fn a_recording_without_a_folder_is_refused_with_the_key_that_is_missing() {
    let settings = [
        "sonar.output.vita49.send_to=127.0.0.1:14998",
        "control.listen=127.0.0.1:0",
    ];
    let mut daemon = Daemon::start("hil-configs/board.toml", settings);
    let at = daemon.announced("control http", "http");
    let (code, answer) = tell(at, &json!({ "do": "record", "on": true }));
    assert_eq!(code, 409, "{answer}");
    let why = answer["why"].as_str().expect("a reason");
    assert!(why.contains("set record.directory"), "{why}");
    daemon.terminate();
}

#[test]
fn requests_without_the_token_are_refused() {
    let folder = tempfile::tempdir().expect("folder");
    let mut daemon = quick(folder.path(), &["control.token=open-sesame"]);
    let at = daemon.announced("control http", "http");
    for path in ["/status", "/metrics"] {
        let code = |token| client::get(at, path, token).expect("answers").0;
        assert_eq!(
            (code(None), code(Some("open")), code(Some("open-sesame"))),
            (401, 401, 200)
        );
    }
    let pause = json!({ "do": "pause" });
    assert_eq!(client::command(at, &pause, None).expect("answers").0, 401);
    assert_eq!(client::get(at, "/healthz", None).expect("answers").0, 200);
    assert_eq!(status_paused(at), json!(false));
    daemon.terminate();
}

/// After too many wrong guesses, no token is checked for a time.
#[test]
fn guesses_of_the_token_are_limited() {
    let folder = tempfile::tempdir().expect("folder");
    let mut daemon = quick(folder.path(), &["control.token=open-sesame"]);
    let at = daemon.announced("control http", "http");
    let code = |token| client::get(at, "/status", token).expect("answers").0;
    assert_eq!(code(Some("open-sesame")), 200);
    let begun = std::time::Instant::now();
    let answers: Vec<_> = (0..40).map(|_| code(Some("open"))).collect();
    let read = answers.iter().filter(|&&code| code == 401).count();
    // The limit is ten guesses at once, and one more every six seconds.
    let most = 11 + begun.elapsed().as_secs() / 6;
    assert!(read >= 10 && read as u64 <= most, "{answers:?}");
    assert_eq!(
        answers.iter().filter(|&&code| code == 429).count(),
        40 - read
    );
    assert_eq!(code(None), 401, "gives no token");
    eventually(|| match code(Some("open-sesame")) {
        200 => Ok(()),
        code => Err(code),
    });
    assert_eq!(client::get(at, "/healthz", None).expect("answers").0, 200);
    daemon.terminate();
}

/// Connections that send half a header cannot use all descriptors, or block other clients for long.
#[test]
fn slow_connections_are_few_and_end() {
    let folder = tempfile::tempdir().expect("folder");
    let mut daemon = quick(folder.path(), &[]);
    let at = daemon.announced("control http", "http");
    let descriptors = format!("/proc/{}/fd", daemon.child.id());
    let open = || std::fs::read_dir(&descriptors).expect("Linux").count();
    let before = open();
    let slow: Vec<_> = (0..200)
        .map(|_| {
            let mut stream = std::net::TcpStream::connect(at).expect("the kernel accepts");
            // The server may already have closed the connection.
            let _ = stream.write_all(b"GET /status HTTP/1.1\r\nHost: 127.0");
            stream
        })
        .collect();
    std::thread::sleep(std::time::Duration::from_millis(500));
    let during = open();
    assert!(
        during <= before + 120,
        "{before} descriptors, then {during}"
    );
    let code = eventually(|| match client::get(at, "/healthz", None) {
        Ok((code, _)) => Ok(code),
        Err(why) => Err(why.to_string()),
    });
    assert_eq!(code, 200);
    drop(slow);
    daemon.terminate();
}

fn status_paused(at: std::net::SocketAddr) -> serde_json::Value {
    let (_, body) = client::get(at, "/status", Some("open-sesame")).expect("answers");
    let status: serde_json::Value = serde_json::from_str(&body).expect("JSON");
    status["paused"].clone()
}
