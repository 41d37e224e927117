//! Tests of the benchmark of whole pings: its command, its errors and its JSON. Other tests distort its times.

use clap::Parser;

use crate::Tool;

#[test]
fn a_moving_ping_is_measured_and_the_engine_keeps_its_tolerance() {
    let folder = tempfile::tempdir().expect("folder");
    let json = folder.path().join("echo.json");
    let words = [
        "tools",
        "bench",
        "echo",
        "--quick",
        "--only",
        "paper 5 42936 15 5",
        "--json",
    ];
    let words = words.map(std::ffi::OsStr::new);
    let Tool::Bench(given) = Tool::parse_from(words.into_iter().chain([json.as_os_str()])) else {
        panic!("`bench` is a benchmark");
    };
    crate::bench::run(given).expect("measured");
    let text = std::fs::read_to_string(&json).expect("JSON");
    let kept: serde_json::Value = serde_json::from_str(&text).expect("JSON");
    let rows = kept["rows"].as_array().expect("rows");
    let of_engine: Vec<_> = rows
        .iter()
        .filter(|row| row["method"] == "gridded-1d")
        .collect();
    assert!(!of_engine.is_empty(), "{text}");
    for row in of_engine {
        let error = row["error_worst_window"].as_f64().expect("an error");
        assert!(
            error < row["tolerance"].as_f64().expect("a tolerance"),
            "{row}"
        );
        assert!(row["ms_best"].as_f64().expect("a time") > 0.0, "{row}");
    }
}
