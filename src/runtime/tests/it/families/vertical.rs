//! Heave, depth and altitude in the records of a ping, compared with the track and the seabed of the scene.

use std::fmt::Write;

use echotank_config::spec::NavMode;
use echotank_core::ping::PingPlan;
use echotank_ping::make_ping::motion;
use echotank_runtime::recorded::RecordedRig;

/// Arrays at 0.4 and 0.6 m forward, 0.8 m below the reference point; the bottom is flat, 12 m deep.
const RIG: &str = r#"
[medium]
sound_speed_m_per_s = 1500.0
absorption = "none"
[nav]
origin = { latitude_deg = 54.3, longitude_deg = 10.2 }
mode = "settle"
VERTICAL
[[nav.source]]
name = "track"
kind = "csv"
path = "track.csv"
provides = ["position", "heading", "roll-pitch"]
[scene]
extend = "none"
[scene.seabed]
shape = "plane"
depth_m = 42.0
bottom = "sand"
density_per_m2 = 0.1
[[sonar]]
name = "side"
[sonar.pulse]
kind = "cw"
center_frequency_khz = 200.0
duration_ms = 0.2
taper = 0.1
[[sonar.transmit]]
name = "tx"
pattern = "omnidirectional"
[[sonar.receive]]
name = "port"
transmit = "tx"
elements = 1
spacing_m = 0.00375
position_m = [0.4, -0.1, 0.8]
[[sonar.receive]]
name = "starboard"
transmit = "tx"
elements = 1
spacing_m = 0.00375
position_m = [0.6, 0.1, 0.8]
[sonar.receiver]
sample_rate_khz = 40.0
rx_filter = "none"
noise_db = "none"
[sonar.ping]
range_m = 60.0
rate_hz = 4.0
source_level_db = 200.0
gain_db = 0.0
[sonar.model]
path = "polyline"
doppler = "stretch"
synthesis = "direct"
error_check = false
[sonar.beams]
port = "port"
starboard = "starboard"
[sonar.output.sevenk]
id = 7125
listen = "127.0.0.1:0"
"#;

/// Depth of the track at a time, metres: around 30 m.
fn down_m(time_s: f64) -> f64 {
    30.0 + 0.12 * (std::f64::consts::TAU * time_s / 7.0).sin()
}

/// Plans of 20 pings on a track that heads north, pitched by 10 degrees.
fn plans(vertical: &str) -> Vec<PingPlan> {
    let folder = tempfile::tempdir().expect("a folder");
    let mut track = "time_s,north_m,east_m,down_m,roll_deg,pitch_deg,heading_deg\n".to_owned();
    for k in 0..80 {
        let time_s = 0.1 * f64::from(k);
        let (whole, tenths) = (1_793_611_200 + k / 10, k % 10);
        let _ = writeln!(
            track,
            "{whole}.{tenths},{time_s},0,{},0,10,0",
            down_m(time_s)
        );
    }
    std::fs::write(folder.path().join("track.csv"), track).expect("written");
    let rig = RIG.replace("VERTICAL", vertical);
    let spec = echotank_runtime::config_files::parse(&rig, folder.path());
    let spec = spec.unwrap_or_else(|e| panic!("{e}"));
    let mut recorded = RecordedRig::open(&spec).unwrap_or_else(|e| panic!("{e}"));
    let mut plans = Vec::new();
    for ping in 1..=20 {
        let (sonar, order) = recorded.next_order(ping).expect("a ping");
        assert!(recorded.settle(sonar, &order));
        let mut slot = recorded.rig.slot(sonar);
        let (mode, at) = (NavMode::Settle, order.transmit_utc);
        motion(&mut recorded.rig, sonar, &order, mode, at, &mut slot).expect("covered");
        plans.push(slot.plan);
    }
    plans
}

#[test]
fn a_tracks_depth_is_told_as_heave_from_the_reference_depth() {
    for (vertical, still_m) in [
        ("vertical = \"depth\"", 0.0),
        ("vertical = \"depth\"\nreference_depth_m = 30.0", 30.0),
    ] {
        let plans = plans(vertical);
        let heaves = plans.iter().map(|plan| plan.nav.heave_down_m);
        let (least, largest) = heaves.fold((f64::MAX, f64::MIN), |(a, b), h| (a.min(h), b.max(h)));
        assert!(largest - least > 0.2, "the track heaves by 0.24 m");
        for plan in &plans {
            let nav = &plan.nav;
            let start = plans[0].transmit_utc;
            let time_s =
                plan.transmit_utc.seconds_since(start) + (start.0 % 1_000_000_000) as f64 * 1e-9;
            assert!((nav.heave_down_m - (down_m(time_s) - still_m)).abs() < 2e-3);
            // A client that adds heave to the reported depth obtains the depth of the platform.
            let told_m = plan.sensor.still_depth_m.unwrap_or(0.0) + nav.heave_down_m;
            assert!((told_m + nav.height_m).abs() < 1e-9, "{told_m}");
            assert_eq!(plan.sensor.still_depth_m.is_some(), still_m != 0.0);
        }
    }
}

#[test]
fn depth_and_altitude_lie_at_the_arrays_and_add_up_to_the_bottom() {
    for plan in plans("vertical = \"depth\"\nreference_depth_m = 30.0") {
        let (sine, cosine) = 10_f64.to_radians().sin_cos();
        // Pitched bow up: a point 0.5 m forward is higher.
        let want_m = -plan.nav.height_m + 0.8 * cosine - 0.5 * sine;
        let sensor = plan.sensor;
        assert!((sensor.depth_m - want_m).abs() < 1e-9, "{}", sensor.depth_m);
        let altitude_m = sensor.altitude_m.expect("a bottom");
        assert!((sensor.depth_m + altitude_m - 42.0).abs() < 1e-9);
        // The arrays are north of the reference point. A distance of 6,367 km to the centre of curvature is at most 0.6 % off.
        let north_m = (sensor.latitude_rad - plan.nav.latitude_rad) * 6_367e3;
        let want_m = 0.5 * cosine + 0.8 * sine;
        assert!((north_m / want_m - 1.0).abs() < 1e-2, "{north_m}");
    }
}
