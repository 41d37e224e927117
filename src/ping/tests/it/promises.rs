//! Predicted errors of whole pings over a few points, against the reference: rigs of `tools/points_random.py` whose errors were once larger than
//! predicted, with no more points than that takes.

use std::path::Path;

use echotank_config::spec::RigSpec;
use echotank_core::ping::PingOutput;
use echotank_ping::make_ping;
use echotank_ping::method_selection::costs::Costs;
use echotank_ping::method_selection::{MotionScale, Scene, rank};
use echotank_ping::threads::pool;
use echotank_runtime::config_files::parse;
use echotank_runtime::recorded::RecordedRig;
use echotank_testing::track::{ALONG_TRACK, rows};
use num_complex::Complex64;

/// A rig over points, with fixed methods, and the platform's motion about its first ping.
struct Case {
    name: &'static str,
    c: f64,
    pulse: &'static str,
    transmit: &'static str,
    receive: &'static [&'static str],
    rate_khz: f64,
    filter: &'static str,
    range_m: f64,
    tolerance: f64,
    model: &'static str,
    velocity: [f64; 3],
    acceleration: [f64; 3],
    /// Pitch and heading in degrees, and their rates.
    pitch: [f64; 2],
    heading: [f64; 2],
    /// North, east and down in metres, amplitude, its imaginary part.
    points: &'static [[f64; 5]],
}

const FLANK: Case = Case {
    name: "flank of a taper",
    c: 1505.7,
    pulse: "kind = \"cw\"\n\
             center_frequency_khz = 35.92\n\
             duration_ms = 0.211\n\
             taper = 0.5",
    transmit: "position_m = [-0.074, 1.247, -1.145]\n\
             pattern = \"rectangle\"\n\
             length_m = 0.052151\n\
             width_m = 0.040334\n\
             baffled = false",
    receive: &["elements = 1\n\
             position_m = [0.2, 1.336, -0.992]\n\
             roll_deg = -60.0\n\
             element_pattern = \"rectangle\"\n\
             element_length_m = 0.074941\n\
             element_width_m = 0.024715\n\
             baffled = true"],
    rate_khz: 34.097,
    filter: "none",
    range_m: 15.93,
    tolerance: 0.011,
    model: "path = \"polyline\"\n\
             segment_ms = 50.0\n\
             doppler = \"stretch\"\n\
             synthesis = \"direct\"",
    velocity: [-3.9029, 5.7671, 0.0],
    acceleration: [0.0, 0.0, 0.0],
    pitch: [0.0, 0.0],
    heading: [124.088, 0.0],
    points: &[
        [1.5543, -0.0847, 8.4920, -1.233, -0.3407],
        [0.9657, 13.3741, 26.9061, -0.2922, 0.1109],
        [0.3454, -8.2352, 15.6347, -0.6012, -0.5987],
        [1.1032, 2.5861, 14.3694, 0.01111, 0.1502],
        [-0.3807, 0.5581, 20.1831, -0.03719, 0.01094],
        [-3.3163, 5.8086, 20.3797, 0.05064, 0.06138],
    ],
};

const TAIL: Case = Case {
    name: "tail of a filter",
    c: 1496.7,
    pulse: "kind = \"lfm\"\n\
             center_frequency_khz = 42.9\n\
             bandwidth_khz = 15.7\n\
             duration_ms = 0.42\n\
             taper = 0.0",
    transmit: "position_m = [-1.574, -0.734, -0.72]\n\
             pattern = \"rectangle\"\n\
             length_m = 0.294942\n\
             width_m = 0.050205\n\
             baffled = false",
    receive: &["elements = 16\n\
             spacing_m = 0.018719\n\
             position_m = [-1.537, -0.826, -0.465]\n\
             element_pattern = \"rectangle\"\n\
             element_length_m = 0.018719\n\
             element_width_m = 0.036659\n\
             baffled = false"],
    rate_khz: 40.969,
    filter: "fir",
    range_m: 39.3,
    tolerance: 0.0031,
    model: "path = \"k-segment\"\n\
             segment_ms = 10.0\n\
             doppler = \"stretch\"\n\
             synthesis = \"direct\"",
    velocity: [-4.9427, -4.5787, -0.4014],
    acceleration: [-0.0272, -0.0252, 0.7164],
    pitch: [3.405, -6.086],
    heading: [222.811, 0.0],
    points: &[[1.5257, -0.2256, 29.4007, -0.0123, -0.01323]],
};

const BLOCKS: Case = Case {
    name: "blocks of a short chirp",
    c: 1507.1,
    pulse: "kind = \"lfm\"\n\
             center_frequency_khz = 118.71\n\
             bandwidth_khz = 12.31\n\
             duration_ms = 0.452\n\
             taper = 0.05",
    transmit: "position_m = [-1.45, -1.724, 0.481]\n\
             pattern = \"omnidirectional\"",
    receive: &["elements = 21\n\
             spacing_m = 0.005439\n\
             position_m = [-1.581, -2.017, 0.619]\n\
             roll_deg = -60.0\n\
             yaw_deg = 90.0\n\
             element_pattern = \"omnidirectional\""],
    rate_khz: 23.054,
    filter: "none",
    range_m: 20.69,
    tolerance: 8.9e-05,
    model: "path = \"continuous\"\n\
             doppler = \"stretch-quadratic\"\n\
             synthesis = \"direct\"",
    velocity: [3.4869, -11.2129, 0.0],
    acceleration: [-3.347, -0.9434, 0.0],
    pitch: [0.0, 0.0],
    heading: [287.275, -16.973],
    points: &[[-0.9762, -1.1598, 19.0237, 0.05258, -0.04035]],
};

impl Case {
    fn spec(&self, folder: &Path, model: &str) -> RigSpec {
        let track = rows(126, 0.02, |t| {
            let at = |k: usize| self.velocity[k] * t + 0.5 * self.acceleration[k] * t * t;
            let turned = |[now, rate]: [f64; 2]| now + rate * t;
            let heading = turned(self.heading).rem_euclid(360.0);
            [at(0), at(1), 20.0 + at(2), 0.0, turned(self.pitch), heading]
        });
        std::fs::write(folder.join("track.csv"), track).expect("a track");
        let mut points = "north_m,east_m,down_m,amplitude,amplitude_imag\n".to_owned();
        for [north, east, down, re, im] in self.points {
            points += &format!("{north},{east},{down},{re},{im}\n");
        }
        std::fs::write(folder.join("points.csv"), points).expect("points");
        let mut arrays = String::new();
        for (k, array) in self.receive.iter().enumerate() {
            arrays +=
                &format!("[[sonar.receive]]\nname = \"a{k}\"\nsensitivity_db = 0.0\n{array}\n");
        }
        let text = format!(
            r#"[medium]
sound_speed_m_per_s = {}
absorption = "none"
{ALONG_TRACK}[scene]
points = "points.csv"
[run]
latency_ms = 600.0
[[sonar]]
name = "one"
[sonar.pulse]
{}
[[sonar.transmit]]
name = "tx"
{}
{arrays}[sonar.receiver]
sample_rate_khz = {}
rx_filter = "{}"
noise_db = "none"
full_scale_v = 1000.0
[sonar.ping]
range_m = {}
rate_hz = 5.0
source_level_db = 0.0
gain_db = 0.0
[sonar.model]
tolerance = {}
error_check = false
{model}
"#,
            self.c,
            self.pulse,
            self.transmit,
            self.rate_khz,
            self.filter,
            self.range_m,
            self.tolerance,
        );
        parse(&text, folder).unwrap_or_else(|why| panic!("{}: {why}\n{text}", self.name))
    }

    /// Largest error of all windows and elements of the first ping, as the accuracy contract has it, and the predicted one.
    fn errors(&self) -> [f64; 2] {
        let folder = tempfile::tempdir().expect("a folder");
        let spec = self.spec(folder.path(), self.model);
        let exact = self.spec(folder.path(), "synthesis = \"reference\"");
        let (got, predicted) = first_ping(&spec, true);
        let (want, _) = first_ping(&exact, false);
        let sonar = &spec.sonars[0];
        let window = (sonar.pulse.duration_s * sonar.receiver.sample_rate_hz).ceil();
        (0..got.len())
            .map(|e| window_error(&got[e], &want[e], window.max(32.0) as usize))
            .fold([0.0, predicted], |[worst, predicted], error| {
                [f64::max(worst, error), predicted]
            })
    }
}

/// Samples of all elements of the first ping, and the predicted error of its methods.
fn first_ping(spec: &RigSpec, predict: bool) -> (Vec<Vec<Complex64>>, f64) {
    pool(1).expect("a thread").install(|| {
        let mut recorded = RecordedRig::open(spec).expect("opens");
        let mut slot = recorded.rig.slot(0);
        let (sonar, order) = recorded.next_order(1).expect("an order");
        assert!(recorded.settle(sonar, &order));
        let (mode, utc) = (spec.nav.mode, order.transmit_utc);
        make_ping(&mut recorded.rig, sonar, &order, mode, utc, &mut slot).expect("a ping");
        let scatterers = recorded.rig.scatterers();
        let predicted = predict.then(|| {
            let ranking = rank(
                &Scene {
                    spec: &spec.sonars[0],
                    medium: &spec.medium,
                    plan: &slot.plan,
                    scatterers,
                    count: scatterers.len(),
                    costs: &Costs::committed(),
                    motion_scale: MotionScale::NONE,
                },
                &[],
            );
            ranking.expect("methods").chosen().error()
        });
        let PingOutput { elements, .. } = &slot.output;
        let samples = elements.iter().zip(&spec.sonars[0].receive);
        let samples = samples.flat_map(|(array, receive)| {
            (0..receive.elements)
                .map(|e| array.element(e).to_vec())
                .collect::<Vec<_>>()
        });
        (samples.collect(), predicted.unwrap_or(0.0))
    })
}

/// Largest error of all windows, over their own levels or a floor 55 dB below the strongest one.
fn window_error(got: &[Complex64], want: &[Complex64], window: usize) -> f64 {
    let energy = |all: &[Complex64]| all.iter().map(|x| x.norm_sqr()).sum::<f64>();
    let off: Vec<Complex64> = got.iter().zip(want).map(|(a, b)| a - b).collect();
    let starts = 0..=want.len() - window;
    let strongest = starts.clone().map(|k| energy(&want[k..k + window]));
    let floor = strongest.fold(0.0, f64::max) * 10f64.powf(-5.5);
    starts
        .map(|k| energy(&off[k..k + window]) / energy(&want[k..k + window]).max(floor))
        .fold(0.0, f64::max)
        .sqrt()
}

fn keeps(case: &Case) {
    let [error, predicted] = case.errors();
    println!("{}: {error:.2e}, predicted {predicted:.2e}", case.name);
    assert!(
        error <= predicted,
        "{}: {error:e} > {predicted:e}",
        case.name
    );
    assert!(
        predicted <= 12.0 * error,
        "{}: {predicted:e} of {error:e}",
        case.name
    );
}

/// A delay that is off displaces the flanks of a pulse too: at 36 kHz, the last sample on a flank is off by more than its phase.
#[test]
fn a_displaced_flank_counts() {
    keeps(&FLANK);
}

/// ... and behind a filter of half the carrier's bandwidth the tail of an echo.
#[test]
fn a_displaced_tail_of_the_filter_counts() {
    keeps(&TAIL);
}

/// Eight points of a bent chirp that is 10 samples long have a cubic phase above the limit of longer runs.
#[test]
fn the_cubic_phase_of_the_shortest_run_counts() {
    keeps(&BLOCKS);
}
