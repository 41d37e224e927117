//! Test of method selection in the daemon. Echoes that begin to move under a selection for echoes at rest are predicted ping by ping, and a costlier
//! selection replaces it before an error check fails.

use std::fmt::Write;
use std::net::SocketAddr;

use echotank_runtime::io::control::client;

use super::Daemon;
use super::modes::{status, step};
use echotank_testing::track::{ALONG_TRACK, COLUMNS};

/// Number of points abeam. While they are abeam, the range rate is zero, and methods that ignore motion suffice. The motion of the
/// sonar does not show the end of this phase; only the prediction for each ping does.
const POINTS: usize = 300;
const SPEED_M_PER_S: f64 = 0.05;
/// Number of pings within which the first selection stops fitting.
const PATIENCE_PINGS: u64 = 80;
/// Number of pings within which another takes effect, two blocks, and until an error check has enough windows.
const LEAD_PINGS: u64 = 16;
const CHECKED_PINGS: u64 = 300;

const RIG: &str = r#"
[medium]
sound_speed_m_per_s = 1500.0
absorption = "none"
[scene]
anchor = "origin"
points = "points.csv"
[run]
clock = "lockstep"
latency_ms = 600.0
[control]
listen = "127.0.0.1:0"
[[sonar]]
name = "drifting"
[sonar.pulse]
kind = "lfm"
center_frequency_khz = 400.0
bandwidth_khz = 20.0
duration_ms = 0.5
taper = 0.2
[[sonar.transmit]]
name = "tx"
[[sonar.receive]]
name = "rx"
elements = 64
spacing_m = 0.001875
element_pattern = "omnidirectional"
[sonar.receiver]
sample_rate_khz = 60.0
rx_filter = "none"
noise_db = "none"
tvg = "none"
[sonar.ping]
range_m = 10.0
rate_hz = 2.0
source_level_db = 180.0
[sonar.limits]
range_m = [1.0, 10.0]
pulse_duration_ms = [0.5, 0.5]
[sonar.model]
path = "auto"
doppler = "auto"
synthesis = "direct"
tolerance = 2e-2
error_check = true
"#;

/// Value of one metric of /metrics.
fn metric(control: SocketAddr, name: &str) -> Option<f64> {
    let (code, text) = client::get(control, "/metrics", None).expect("answers");
    assert_eq!(code, 200, "{text}");
    let begins = format!("echotank_{name}{{");
    let line = text.lines().find(|line| line.starts_with(&begins))?;
    line.split_whitespace().nth(1)?.parse().ok()
}

#[test]
fn a_selection_that_stops_fitting_is_replaced_before_an_error_check_fails() {
    let folder = tempfile::tempdir().expect("folder");
    let mut points = String::from("north_m,east_m,down_m,amplitude\n");
    for k in 0..POINTS {
        // Ranges of 3 to 9 m, one centimetre to either side.
        let part = |step: f64| (k as f64 * step).fract();
        let _ = writeln!(
            points,
            "{:.4},{:.4},5.0,1.0",
            0.02 * (part(0.618_034) - 0.5),
            3.0 + 6.0 * part(0.754_878)
        );
    }
    std::fs::write(folder.path().join("points.csv"), points).expect("written");
    let mut track = String::from(COLUMNS);
    for k in 0..4000 {
        let t_s = 0.1 * f64::from(k);
        let _ = writeln!(
            track,
            "{:.1},{:.6},0,5,0,0,0",
            1_793_611_200.0 + t_s,
            SPEED_M_PER_S * t_s
        );
    }
    std::fs::write(folder.path().join("track.csv"), track).expect("written");
    let path = folder.path().join("drift.toml");
    std::fs::write(&path, format!("{ALONG_TRACK}{RIG}")).expect("written");
    let mut daemon = Daemon::start(path, [""; 0]);
    let control = daemon.announced("control", "http");
    let mut delivered = 0;
    step(control, &mut delivered, 1);
    let said = status(control);
    let plan = said["sonars"][0]["methods"]["plan"].clone();
    assert_eq!(plan, 1, "made ahead of the first ping: {said}");
    assert_eq!(metric(control, "plan_tolerance"), Some(2e-2));
    let first_promise = metric(control, "plan_predicted_error").expect("a promise");
    assert!(first_promise <= 2e-2, "{first_promise}");

    let above = || metric(control, "pings_above_tolerance").expect("counted");
    let mut greatest = first_promise;
    while above() == 0.0 && delivered < PATIENCE_PINGS {
        step(control, &mut delivered, 1);
        greatest = greatest.max(metric(control, "plan_predicted_error").expect("a promise"));
    }
    // Said of each ping, until the new selection takes effect.
    assert!(greatest > 2e-2, "{greatest}");
    step(control, &mut delivered, LEAD_PINGS);
    let exceeded = above();
    println!(
        "another selection before ping {delivered}: at most {greatest:.1e} predicted, {exceeded} pings above the tolerance"
    );
    assert!((1.0..=LEAD_PINGS as f64).contains(&exceeded), "{exceeded}");
    assert!(metric(control, "plan_predicted_error") <= Some(2e-2));

    for _ in 0..CHECKED_PINGS / 50 {
        step(control, &mut delivered, 50);
    }
    let checked = metric(control, "checked_error").expect("enough windows");
    assert!(checked < 2e-2, "{checked}");
    assert!(metric(control, "plan_predicted_error") <= Some(2e-2));
    assert_eq!(metric(control, "error_check_faults"), Some(0.0));
    assert_eq!(metric(control, "plans_given_up"), Some(0.0));
    let said = status(control)["sonars"][0]["methods"].clone();
    assert_eq!(
        said["above_tolerance"].as_f64(),
        metric(control, "pings_above_tolerance")
    );
    let printed = daemon.terminate();
    assert!(
        printed.contains("predicted or measured above the tolerance"),
        "{printed}"
    );
}
