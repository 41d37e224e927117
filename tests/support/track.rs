//! Rigs on a recorded track, for tests and tools.

/// Navigation from `track.csv` beside the configuration, awaited before and after every ping.
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

/// Header of that file.
pub const COLUMNS: &str = "time_s,north_m,east_m,down_m,roll_deg,pitch_deg,heading_deg\n";
