//! Ground truth of the beams of a fan against the beams themselves, for a line and for an arc.

use echotank_core::ping::LineTruth;
use echotank_ping::fan_truth::fan_truth;
use echotank_ping::make_ping;
use echotank_ping::threads::pool;
use echotank_runtime::config_files::parse;
use echotank_runtime::recorded::RecordedRig;

const C: f64 = 1500.0;
const RATE_HZ: f64 = 40e3;
const BEAMS: usize = 121;
const SECTOR_DEG: f64 = 120.0;
/// Of the targets: metres from the array, degrees to starboard. Beams there use whole apertures of the arc, as the truth has them.
const TARGETS: [(f64, f64); 3] = [(15.0, -24.0), (20.0, 6.0), (26.0, 27.0)];
/// The truth is that of one frequency and of the far field.
const MOST_DB: f64 = 0.5;

/// A fan across the track of a platform at rest, 1 m below the water.
fn config(array: &str) -> String {
    format!(
        r#"
[medium]
sound_speed_m_per_s = {C}
absorption = "none"
[nav]
origin = {{ latitude_deg = 54.3, longitude_deg = 10.2 }}
mode = "settle"
vertical = "depth"
[[nav.source]]
name = "track"
kind = "csv"
path = "nav.csv"
[scene]
targets = "targets.toml"
[[sonar]]
name = "one"
[sonar.pulse]
kind = "lfm"
duration_ms = 1.0
bandwidth_khz = 8.0
center_frequency_khz = 100.0
[[sonar.transmit]]
name = "tx"
position_m = [0.0, 0.0, 1.0]
pattern = "omnidirectional"
[[sonar.receive]]
name = "rx"
{array}
position_m = [0.0, 0.0, 1.0]
yaw_deg = 90.0
element_pattern = "omnidirectional"
sensitivity_db = 0.0
[sonar.receiver]
sample_rate_khz = 40.0
rx_filter = "none"
noise_db = "none"
full_scale_v = 1e12
[sonar.ping]
range_m = 40.0
rate_hz = 1.0
source_level_db = 200.0
[sonar.model]
synthesis = "direct"
[sonar.beams.fan]
array = "rx"
beams = {BEAMS}
sector_deg = {SECTOR_DEG}
former = "dynamic-focus"
"#
    )
}

#[test]
fn a_target_has_its_label_and_its_level_in_the_beams_that_hear_it() {
    let folder = tempfile::tempdir().expect("a folder");
    let rows: String = (0..20)
        .map(|t| format!("{},0,0,0,0,0,0\n", 1_700_000_000 + t))
        .collect();
    let header = "time_s,north_m,east_m,down_m,roll_deg,pitch_deg,heading_deg\n";
    std::fs::write(folder.path().join("nav.csv"), format!("{header}{rows}")).expect("a track");
    let targets = TARGETS.iter().enumerate().map(|(k, (range_m, angle_deg))| {
        let (sin, cos) = angle_deg.to_radians().sin_cos();
        format!(
            "[[target]]\nname = \"t{k}\"\nnorth_m = 0.0\neast_m = {}\ndown_m = {}\ntarget_strength_db = -20.0\n",
            range_m * sin,
            1.0 + range_m * cos
        )
    });
    let targets: String = targets.collect();
    std::fs::write(folder.path().join("targets.toml"), targets).expect("targets");
    for array in [
        "elements = 48\nspacing_m = 0.0075",
        "elements = 96\nspacing_m = 0.0075\nradius_m = 0.3",
    ] {
        let spec = parse(&config(array), folder.path()).unwrap_or_else(|why| panic!("{why}"));
        pool(2).expect("threads").install(|| {
            let mut recorded = RecordedRig::open(&spec).expect("opens");
            let mut slot = recorded.rig.slot(0);
            let (sonar, order) = recorded.next_order(1).expect("an order");
            assert!(recorded.settle(sonar, &order));
            let (mode, utc) = (spec.nav.mode, order.transmit_utc);
            make_ping(&mut recorded.rig, sonar, &order, mode, utc, &mut slot).expect("a ping");
            let truths = fan_truth(&recorded.rig, &slot);
            let beams = &slot.output.beams[0];
            assert_eq!((truths.len(), beams.beams), (BEAMS, BEAMS));
            for (label, (range_m, angle_deg)) in (1..).zip(TARGETS) {
                let at =
                    ((2.0 * range_m / C - slot.plan.first_sample_s) * RATE_HZ).round() as usize;
                let heard = |b: usize| f64::from(beams.iq[b * beams.samples + at].norm_sqr());
                let told = |truth: &LineTruth| match truth.target[at] == label {
                    true => f64::from(truth.target_energy[at]),
                    false => 0.0,
                };
                let told: Vec<f64> = truths.iter().map(told).collect();
                let strongest = |of: &dyn Fn(usize) -> f64| {
                    (0..BEAMS)
                        .max_by(|a, b| of(*a).total_cmp(&of(*b)))
                        .expect("beams")
                };
                let (by_beams, by_truth) = (strongest(&heard), strongest(&|b| told[b]));
                let step_deg = SECTOR_DEG / (BEAMS - 1) as f64;
                let right = ((angle_deg + 0.5 * SECTOR_DEG) / step_deg).round() as usize;
                assert_eq!(
                    (by_beams, by_truth),
                    (right, right),
                    "{array}, {angle_deg} degrees"
                );
                let shown: Vec<usize> = (0..BEAMS).filter(|b| told[*b] > 0.0).collect();
                let off_db = shown.iter().map(|b| {
                    let ratio = told[*b] / told[right] / (heard(*b) / heard(right));
                    (10.0 * ratio.log10()).abs()
                });
                let off_db = off_db.fold(0.0, f64::max);
                println!("{array}, {angle_deg} degrees: {shown:?}, within {off_db:.2} dB");
                assert!(shown.len() >= 3 && off_db < MOST_DB, "{off_db} dB");
            }
        });
    }
}
