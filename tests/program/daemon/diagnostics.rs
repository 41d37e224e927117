//! Tests of the output of the daemon to standard error: `--log` and `RUST_LOG`.

use serde_json::Value;

use crate::{Ended, command, ended, sets};

/// Standard output and standard error of a short run.
fn printed(log: &str, rust_log: Option<&str>) -> (String, String) {
    printed_at("127.0.0.1:0", log, rust_log)
}

fn printed_at(listen: &str, log: &str, rust_log: Option<&str>) -> (String, String) {
    let listen = format!("sonar.output.sevenk.listen={listen}");
    let settings = [
        listen.as_str(),
        "sonar.model.synthesis=direct",
        "run.clock=fast",
    ];
    let Ended { code, out, err } = ended(
        command("run")
            .args(["hil-configs/points.toml", "--log", log])
            .args(sets(settings))
            .env_remove("RUST_LOG")
            .env_remove("JOURNAL_STREAM")
            .envs(rust_log.map(|filter| ("RUST_LOG", filter))),
    );
    assert_eq!(code, Some(0), "{out}\n{err}");
    assert!(out.lines().any(|line| line.starts_with("7k ")), "{out}");
    assert!(!out.contains("INFO"), "{out}");
    (out, err)
}

#[test]
fn json_diagnostics_are_one_object_per_line() {
    let (_, err) = printed("json", Some("debug"));
    let events: Vec<Value> = err
        .lines()
        .map(|line| serde_json::from_str(line).unwrap_or_else(|why| panic!("{why}: {line}")))
        .collect();
    assert!(!events.is_empty());
    for event in &events {
        for key in ["timestamp", "level", "target"] {
            assert!(event[key].is_string(), "{key}: {event}");
        }
    }
    assert!(
        events.iter().any(|event| event["message"] == "pinging"),
        "{err}"
    );
}

#[test]
fn text_diagnostics_name_their_level_and_have_no_colours_in_a_file() {
    let (_, err) = printed("text", None);
    assert!(
        err.lines()
            .any(|line| line.contains("INFO") && line.contains("pinging")),
        "{err}"
    );
    assert!(!err.contains('\u{1b}'), "{err}");
}

#[test]
fn a_port_that_other_computers_can_reach_is_named_by_a_warning() {
    let warnings = |listen| {
        let (_, err) = printed_at(listen, "text", None);
        let lines = err.lines();
        lines
            .filter(|line| line.contains("WARN") && line.contains("other computers can connect"))
            .count()
    };
    assert_eq!(warnings("127.0.0.1:0"), 0);
    assert_eq!(warnings("0.0.0.0:0"), 1);
}

#[test]
fn rust_log_off_silences_diagnostics() {
    for log in ["text", "json"] {
        let (_, err) = printed(log, Some("off"));
        assert_eq!(err, "", "{log}");
    }
}
