//! Soundings of a flat bottom through a sound-speed profile, corrected by a ray tracer of its own.

use std::path::Path;
use std::sync::Arc;

use echotank_core::ping::{PingPlan, Sounding};
use echotank_core::sound_speed::SoundSpeedProfile;
use echotank_ping::make_ping;
use echotank_ping::threads::pool;
use echotank_runtime::config_files::parse;
use echotank_runtime::recorded::RecordedRig;

/// Depths of the bottom and of the array, metres.
const BOTTOM_M: f64 = 22.0;
const ARRAY_M: f64 = 2.0;
/// A warm layer above a thermocline: depth in metres, sound speed in metres per second.
const CAST: [(f64, f64); 4] = [(0.0, 1510.0), (4.0, 1509.0), (9.0, 1478.0), (30.0, 1475.0)];
/// Beams around these angles to either side, degrees, are averaged. Near 45 degrees the bend changes its sign.
const ANGLES_DEG: [f64; 5] = [10.0, 20.0, 30.0, 52.0, 58.0];
const HALF_WIDTH_DEG: f64 = 3.0;
const PINGS: u32 = 24;

fn config(folder: &Path) -> String {
    let track = folder.join("track.csv");
    let mut rows = "time_s,north_m,east_m,down_m,roll_deg,pitch_deg,heading_deg\n".to_owned();
    for k in 0..200 {
        let t = f64::from(k) * 0.5;
        rows += &format!("{t},{},0,0,0,0,0\n", 2.0 * t);
    }
    std::fs::write(&track, rows).expect("a track");
    let points = CAST
        .map(|(depth_m, c)| format!("[{depth_m}, {c}]"))
        .join(", ");
    format!(
        r#"
[medium]
profile = {{ points = [{points}] }}
[nav]
origin = {{ latitude_deg = 54.3, longitude_deg = 10.2 }}
mode = "settle"
vertical = "depth"
[[nav.source]]
name = "track"
kind = "csv"
path = "{}"
[scene]
occlusion = "none"
[scene.seabed]
shape = "plane"
depth_m = {BOTTOM_M}
bottom = "sand"
[[sonar]]
name = "mb"
[sonar.pulse]
kind = "cw"
center_frequency_khz = 400.0
duration_ms = 0.2
taper = 0.1
[[sonar.transmit]]
name = "tx"
position_m = [0.0, 0.0, {ARRAY_M}]
pattern = "rectangle"
length_m = 0.19
width_m = 0.0018
[[sonar.receive]]
name = "rx"
elements = 96
spacing_m = 0.00185
position_m = [0.0, 0.0, {ARRAY_M}]
yaw_deg = 90.0
element_pattern = "rectangle"
element_length_m = 0.00185
element_width_m = 0.1
[sonar.receiver]
sample_rate_khz = 40.0
rx_filter = "fir"
noise_db = "none"
[sonar.ping]
range_m = 50.0
rate_hz = 4.0
source_level_db = 215.0
[sonar.model]
path = "auto"
doppler = "auto"
synthesis = "auto"
tolerance = 2e-2
[sonar.beams.fan]
array = "rx"
beams = 128
sector_deg = 130.0
spacing = "equi-angle"
shading = "hann"
bottom_detection = true
"#,
        track.display()
    )
}

fn speed(depth_m: f64) -> f64 {
    let mut layers = CAST.windows(2).map(|pair| (pair[0], pair[1]));
    let layer = layers.find(|(_, below)| depth_m <= below.0);
    layer.map_or(CAST[CAST.len() - 1].1, |((z0, c0), (z1, c1))| {
        c0 + (c1 - c0) * (depth_m - z0) / (z1 - z0)
    })
}

/// Depth and range after `time_s` of a ray that leaves the array at an angle from straight down, by small steps of Snell's law: the ray tracer of a topside.
fn trace(angle_rad: f64, time_s: f64) -> (f64, f64) {
    const STEPS: usize = 2000;
    let p = angle_rad.sin() / speed(ARRAY_M);
    let step_s = time_s / STEPS as f64;
    let (mut depth_m, mut range_m) = (ARRAY_M, 0.0);
    for _ in 0..STEPS {
        let down = |c: f64| c * (1.0 - (p * c) * (p * c)).sqrt();
        let middle_m = depth_m + 0.5 * step_s * down(speed(depth_m));
        let c = speed(middle_m);
        depth_m += step_s * down(c);
        range_m += step_s * p * c * c;
    }
    (depth_m, range_m)
}

/// The time in which [`trace`] reaches the bottom, by bisection.
fn time_to_bottom_s(angle_rad: f64) -> f64 {
    let (mut low, mut high) = (0.0, 0.05);
    for _ in 0..40 {
        let middle = 0.5 * (low + high);
        match trace(angle_rad, middle).0 < BOTTOM_M {
            true => low = middle,
            false => high = middle,
        }
    }
    0.5 * (low + high)
}

/// Depth of a sounding along a straight line with the sound speed of the ping.
fn straight_m(plan: &PingPlan, sounding: &Sounding) -> f64 {
    ARRAY_M + 0.5 * plan.sound_speed_m_per_s * sounding.twtt_s * sounding.angle_rad.cos()
}

/// Mean depths by angle: along straight lines, and by the ray tracer.
#[derive(Default)]
struct Depths {
    straight_m: [f64; ANGLES_DEG.len()],
    traced_m: [f64; ANGLES_DEG.len()],
    predicted_m: [f64; ANGLES_DEG.len()],
    count: [f64; ANGLES_DEG.len()],
}

impl Depths {
    fn add(&mut self, plan: &PingPlan, soundings: &[Sounding]) {
        for sounding in soundings {
            let deg = sounding.angle_rad.abs().to_degrees();
            let near = |at: &f64| (deg - at).abs() < HALF_WIDTH_DEG;
            let Some(k) = ANGLES_DEG.iter().position(near) else {
                continue;
            };
            let angle_rad = sounding.angle_rad.abs();
            self.count[k] += 1.0;
            self.straight_m[k] += straight_m(plan, sounding);
            self.traced_m[k] += trace(angle_rad, 0.5 * sounding.twtt_s).0;
            let path_m = plan.sound_speed_m_per_s * time_to_bottom_s(angle_rad);
            self.predicted_m[k] += ARRAY_M + path_m * angle_rad.cos();
        }
    }

    fn means(&self) -> [[f64; ANGLES_DEG.len()]; 3] {
        [self.straight_m, self.traced_m, self.predicted_m]
            .map(|sums| std::array::from_fn(|k| sums[k] / self.count[k]))
    }
}

#[test]
fn a_flat_bottom_bends_by_the_predicted_amount_and_a_ray_tracer_flattens_it() {
    let folder = tempfile::tempdir().expect("a folder");
    let spec = parse(&config(folder.path()), folder.path()).unwrap_or_else(|why| panic!("{why}"));
    pool(2).expect("threads").install(|| {
        let mut recorded = RecordedRig::open(&spec).expect("opens");
        let mut slot = recorded.rig.slot(0);
        let mut bent = Depths::default();
        let mut flat = Depths::default();
        for ping in 1..=2 * PINGS {
            let (sonar, order) = recorded.next_order(2 * PINGS).expect("an order");
            assert!(recorded.settle(sonar, &order));
            if ping == PINGS + 1 {
                // The water changes between two pings.
                let even = vec![(0.0, 1490.0), (30.0, 1490.0)];
                let even = SoundSpeedProfile::new(even).expect("sound");
                recorded.rig.set_profile(Arc::new(even));
            }
            let mode = spec.nav.mode;
            let utc = order.transmit_utc;
            make_ping(&mut recorded.rig, sonar, &order, mode, utc, &mut slot).expect("a ping");
            let soundings = &slot.output.soundings;
            assert!(soundings.len() > 100, "{} soundings", soundings.len());
            assert_eq!(slot.output.scene.unreached, 0);
            match ping <= PINGS {
                true => {
                    assert_eq!(slot.plan.sound_speed_m_per_s, 1509.5);
                    bent.add(&slot.plan, soundings);
                }
                false => {
                    assert_eq!(slot.plan.sound_speed_m_per_s, 1490.0);
                    flat.add(&slot.plan, soundings);
                }
            }
        }
        let [straight, traced, predicted] = bent.means();
        let [even, ..] = flat.means();
        for (k, deg) in ANGLES_DEG.iter().enumerate() {
            // Less what bottom detection itself is off in even water.
            let (bend, want) = (straight[k] - even[k], predicted[k] - BOTTOM_M);
            println!(
                "{deg} deg: bent by {bend:.3} m, predicted {want:.3} m; traced {:.3} m, in even water {:.3} m",
                traced[k], even[k]
            );
            assert!(want.abs() > 0.15, "{deg} deg: {want} m");
            assert!((bend - want).abs() < 0.05 * want.abs(), "{deg} deg: {bend} {want}");
            assert!((traced[k] - BOTTOM_M).abs() < 0.02, "{deg} deg: {} m", traced[k]);
            assert!((even[k] - BOTTOM_M).abs() < 0.04, "{deg} deg: {} m", even[k]);
        }
    });
}
