//! Rigs on a recorded track, for tests and tools.

/// Navigation from `track.csv` in the folder of the configuration. Every ping waits for samples before
/// and after its window.
pub const ALONG_TRACK: &str = r#"[nav]
origin = { latitude_deg = 59.0, longitude_deg = 18.0 }
mode = "settle"
vertical = "depth"
[[nav.source]]
name = "track"
kind = "csv"
path = "track.csv"
provides = ["position", "heading", "roll-pitch"]
"#;

/// Header line of `track.csv`.
pub const COLUMNS: &str = "time_s,north_m,east_m,down_m,roll_deg,pitch_deg,heading_deg\n";

/// Text of `track.csv`: `steps` rows from 1 November 2026, one every `step_s` seconds. `at` gives the
/// values at a time in seconds.
pub fn rows(steps: usize, step_s: f64, at: impl Fn(f64) -> [f64; 6]) -> String {
    let mut text = COLUMNS.to_owned();
    for k in 0..steps {
        let t_s = k as f64 * step_s;
        text += &format!("{:.2}", 1_793_611_200.0 + t_s);
        text.extend(at(t_s).map(|value| format!(",{value:.9}")));
        text.push('\n');
    }
    text
}
