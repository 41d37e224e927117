//! The first ping of a rig whose methods are all selected, where the engine that most sonars start with is impossible.

use std::path::Path;

use serde_json::Value;

use super::replay_file;
use crate::{command, ended};

const TOLERANCE: f64 = 1e-3;

/// Pulses of 10 ms at 300 kHz: the curvature that engines leave room for turns their ends too far.
fn rig(folder: &Path) -> std::path::PathBuf {
    let file = folder.join("long.toml");
    let text = format!(
        r#"
[nav]
origin = {{ latitude_deg = 54.0, longitude_deg = 10.0 }}
vertical = "depth"
[[nav.source]]
name = "ins"
kind = "csv"
path = "track.csv"
provides = ["position", "heading", "roll-pitch"]
[scene.seabed]
shape = "plane"
depth_m = 15.0
density_per_m2 = 0.1
[[sonar]]
name = "s"
[sonar.pulse]
kind = "lfm"
center_frequency_khz = 300.0
bandwidth_khz = 20.0
duration_ms = 10.0
[[sonar.transmit]]
name = "tx"
[[sonar.receive]]
name = "rx"
elements = 2
spacing_m = 0.0025
[sonar.receiver]
sample_rate_khz = 40.0
rx_filter = "fir"
noise_db = 40.0
[sonar.ping]
range_m = 20.0
rate_hz = 4.0
source_level_db = 200.0
[sonar.model]
path = "auto"
doppler = "auto"
synthesis = "auto"
tolerance = {TOLERANCE}
[sonar.output.sevenk]
id = 103
arrays = ["rx"]
"#
    );
    let rows = (0..60).map(|k| {
        let t = 0.05 * f64::from(k);
        format!("{:.2},{:.3},0,0,0,0,0\n", 1_750_000_000.0 + t, 2.0 * t)
    });
    let head = "time_s,north_m,east_m,down_m,roll_deg,pitch_deg,heading_deg\n".to_owned();
    std::fs::write(folder.join("track.csv"), head + &rows.collect::<String>()).expect("written");
    std::fs::write(&file, text).expect("written");
    file
}

#[test]
fn a_sonar_whose_starting_engine_is_impossible_starts_with_the_selected_methods() {
    let folder = tempfile::tempdir().expect("a folder");
    let file = rig(folder.path());
    let checked = ended(command("check").arg(&file).arg("--verbose"));
    assert!(
        checked.err.is_empty() && checked.out.contains("tolerance 1.0e-3 allows: met"),
        "{}{}",
        checked.out,
        checked.err
    );
    let out = replay_file(&["--pings", "1..2"], &file);
    let truth = std::fs::read_to_string(out.path().join("truth.jsonl")).expect("truth");
    let errors = truth.lines().map(|line| {
        let line: Value = serde_json::from_str(line).expect("JSON");
        line["methods"]["predicted_error"].as_f64()
    });
    let errors: Vec<f64> = errors.flatten().collect();
    println!("{errors:?}");
    assert_eq!(errors.len(), 2, "{truth}");
    assert!(errors.iter().all(|&e| e <= TOLERANCE), "{errors:?}");
}
