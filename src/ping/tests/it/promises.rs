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

const AT_REST: Case = Case {
    name: "onsets under other echoes",
    c: 1460.6,
    pulse: "kind = \"lfm\"\n\
             center_frequency_khz = 69.09\n\
             bandwidth_khz = 10.65\n\
             duration_ms = 3.419\n\
             taper = 0.05",
    transmit: "position_m = [-0.841, -0.283, -0.684]\n\
             pattern = \"omnidirectional\"",
    receive: &["elements = 1\n\
             position_m = [-0.914, -0.397, -0.642]\n\
             roll_deg = 60.0\n\
             element_pattern = \"omnidirectional\""],
    rate_khz: 21.681,
    filter: "fir",
    range_m: 7.47,
    tolerance: 0.00036,
    model: "path = \"stop-and-hop\"\n\
             doppler = \"none\"\n\
             synthesis = \"gridded-1d\"",
    velocity: [0.0, 0.0, 0.0],
    acceleration: [0.0, 0.0, 0.0],
    pitch: [0.0, 0.0],
    heading: [289.978, 0.0],
    points: &[
        [-1.8704, -4.2582, 14.6020, -1.396, 0.754],
        [-4.6791, -1.3930, 15.3602, 0.4575, 1.465],
        [2.3655, -0.8745, 26.0363, -1.111, 0.1794],
        [1.3761, -1.5879, 13.3738, -0.7829, 0.617],
        [1.2766, -2.6565, 23.0813, -0.3555, -0.9268],
        [-1.0763, -2.6445, 14.5401, 0.8274, 0.5091],
        [-2.8410, 5.8536, 23.0373, 0.5666, -0.6713],
        [3.0728, 4.5985, 20.5983, 0.8049, -0.1764],
        [2.8619, -2.1125, 15.2166, -0.709, -0.4179],
        [-2.4227, -4.3567, 15.2389, -0.8043, 0.1647],
        [5.3801, 2.4576, 20.1126, -0.7168, 0.04335],
        [-1.8636, 0.8476, 25.8466, -0.0184, -0.7112],
        [-3.1113, -3.7849, 19.5827, 0.6881, 0.03736],
        [-5.2941, -3.9721, 20.9923, 0.2969, -0.6217],
    ],
};

const LINES_AT_REST: Case = Case {
    name: "a line at rest",
    c: 1468.8,
    pulse: "kind = \"cw\"\n\
             center_frequency_khz = 316.89\n\
             duration_ms = 3.564\n\
             taper = 1.0",
    transmit: "position_m = [1.377, 1.916, 0.284]\n\
             pattern = \"rectangle\"\n\
             length_m = 0.067227\n\
             width_m = 0.007082\n\
             baffled = true",
    receive: &["elements = 10\n\
             spacing_m = 0.002628\n\
             position_m = [1.619, 2.027, -0.006]\n\
             roll_deg = 60.0\n\
             element_pattern = \"rectangle\"\n\
             element_length_m = 0.002628\n\
             element_width_m = 0.004124\n\
             baffled = true"],
    rate_khz: 22.268,
    filter: "fir",
    range_m: 5.75,
    tolerance: 0.0042,
    model: "path = \"stop-and-hop\"\n\
             doppler = \"none\"\n\
             synthesis = \"gridded-lines\"",
    velocity: [0.0, 0.0, 0.0],
    acceleration: [0.0, 0.0, 0.0],
    pitch: [0.0, 0.0],
    heading: [194.567, 0.0],
    points: &[
        [-3.0608, 1.2532, 23.1505, 18.26, -5.382],
        [1.3481, 0.2582, 21.2903, 6.727, -9.889],
        [-2.3245, 3.5927, 17.1374, 0.7629, -8.155],
        [0.1514, 0.9361, 16.7346, 1.279, -4.322],
        [0.1346, -3.1811, 18.4376, -0.815, 1.215],
        [-1.7501, 0.7734, 16.9212, -0.08556, 1.119],
        [-0.1815, 4.9048, 18.1528, 0.005792, 0.6877],
        [0.4207, -1.7384, 15.8534, 0.1716, 0.5979],
    ],
};

const BEYOND_DESIGN: Case = Case {
    name: "an engine within its design on a ping beyond it",
    c: 1467.5,
    pulse: "kind = \"lfm\"\n\
             center_frequency_khz = 70.98\n\
             bandwidth_khz = 10.13\n\
             duration_ms = 3.824\n\
             taper = 0.05",
    transmit: "position_m = [-1.761, 1.249, 0.078]\n\
             pattern = \"omnidirectional\"",
    receive: &["elements = 31\n\
             spacing_m = 0.012143\n\
             position_m = [-1.658, 0.999, 0.329]\n\
             roll_deg = 60.0\n\
             yaw_deg = 90.0\n\
             element_pattern = \"omnidirectional\""],
    rate_khz: 29.846,
    filter: "fir",
    range_m: 5.49,
    tolerance: 0.067,
    model: "path = \"k-segment\"\n\
             segment_ms = 5.0\n\
             doppler = \"stretch-quadratic\"\n\
             synthesis = \"gridded-1d\"",
    velocity: [1.2323, 10.7039, 0.0],
    acceleration: [0.0, 0.0, 0.0],
    pitch: [0.0, 0.0],
    heading: [83.433, 0.0],
    points: &[
        [2.4528, 5.2963, 23.4021, -4.973, -0.3097],
        [-2.8434, 4.3297, 22.0116, -2.46, -3.289],
        [-3.8658, 5.5905, 22.9030, -2.609, -0.5311],
        [2.8093, 4.7534, 24.4196, 1.453, -2.091],
        [1.4896, 3.8377, 18.6772, -0.003316, 1.396],
        [-2.9453, 7.1719, 21.7724, -1.239, -0.02419],
        [-3.0322, 3.2662, 17.6390, -0.271, -1.107],
        [1.9940, 3.2585, 19.0566, -0.2429, 0.9875],
    ],
};

const CHORDS: Case = Case {
    name: "two echoes on chords",
    c: 1504.0,
    pulse: "kind = \"lfm\"\n\
             center_frequency_khz = 38.44\n\
             bandwidth_khz = 4.03\n\
             duration_ms = 3.03\n\
             taper = 0.5",
    transmit: "position_m = [-1.574, -0.909, -0.579]\n\
             pattern = \"rectangle\"\n\
             length_m = 0.094448\n\
             width_m = 0.015802\n\
             baffled = false",
    receive: &[
        "elements = 1\n\
             position_m = [-1.826, -0.939, -0.418]\n\
             roll_deg = 60.0\n\
             yaw_deg = 90.0\n\
             element_pattern = \"rectangle\"\n\
             element_length_m = 0.15502\n\
             element_width_m = 0.063705\n\
             baffled = false",
        "elements = 1\n\
             position_m = [-1.554, -0.903, -0.526]\n\
             roll_deg = 60.0\n\
             yaw_deg = 90.0\n\
             element_pattern = \"rectangle\"\n\
             element_length_m = 0.636402\n\
             element_width_m = 0.074823\n\
             baffled = false",
    ],
    rate_khz: 7.099,
    filter: "none",
    range_m: 13.76,
    tolerance: 8.1e-05,
    model: "path = \"auto\"\n\
             doppler = \"stretch-quadratic\"\n\
             synthesis = \"direct\"",
    velocity: [0.2224, 1.8201, 0.0],
    acceleration: [-0.2609, -2.1349, 0.0],
    pitch: [0.0, 0.0],
    heading: [83.032, 0.0],
    points: &[
        [0.6342, -5.5015, 15.4987, -0.1177, 0.5679],
        [-2.5275, -6.0862, 20.0762, 0.5121, -1.134],
        [-4.8835, 0.4358, 24.0331, -2.195, -1.449],
        [-1.4085, -4.5371, 19.1412, 0.1433, 0.6714],
        [-5.1201, 0.2869, 17.3142, -0.0756, 0.08216],
        [-3.3305, -1.7092, 25.1393, 0.4672, -0.4179],
        [6.0047, -1.5055, 18.4740, -0.5411, -2.927],
    ],
};

const BEFORE: Case = Case {
    name: "a filter rings before an echo",
    c: 1464.3,
    pulse: "kind = \"lfm\"\n\
             center_frequency_khz = 250.5\n\
             bandwidth_khz = 27.5\n\
             duration_ms = 0.243\n\
             taper = 0.0",
    transmit: "position_m = [0.062, 1.934, 0.927]\n\
             pattern = \"rectangle\"\n\
             length_m = 0.007437\n\
             width_m = 0.008724\n\
             baffled = true",
    receive: &["elements = 1\n\
             position_m = [-0.027, 1.731, 0.959]\n\
             roll_deg = -60.0\n\
             element_pattern = \"rectangle\"\n\
             element_length_m = 0.008277\n\
             element_width_m = 0.008865\n\
             baffled = true"],
    rate_khz: 60.507,
    filter: "fir",
    range_m: 9.81,
    tolerance: 6.7e-5,
    model: "path = \"auto\"\n\
             doppler = \"stretch-quadratic\"\n\
             synthesis = \"direct\"",
    velocity: [-4.5536, 0.5727, 0.0],
    acceleration: [0.0, 0.0, 0.0],
    pitch: [0.0, 0.0],
    heading: [172.832, 0.0],
    points: &[
        [-4.1039, 1.1262, 22.8015, -0.09988, 0.02408],
        [-1.9109, 3.4702, 14.1188, 0.4761, -0.067],
        [-6.1963, -5.1349, 16.8006, 0.03509, -0.01986],
        [-6.6145, -6.2576, 18.6994, -0.125, -0.1434],
        [-1.4860, 3.4879, 24.0503, 0.0214, 0.2804],
        [-0.7153, 0.7671, 13.8774, 0.18, -0.1788],
        [-1.9629, -1.9600, 19.8539, 0.06497, 0.03299],
        [-0.9643, 1.5051, 17.8457, 0.1436, 0.08075],
        [1.7135, 2.1247, 19.3472, 0.8402, -1.005],
        [-7.4272, -3.4816, 26.9677, 0.4875, -0.617],
        [-9.4009, 0.8300, 21.5398, 0.09254, 0.004319],
        [-0.4985, -0.4588, 19.8238, -0.01451, -0.03319],
        [-4.6740, -0.0446, 19.6926, -0.007109, -0.008527],
    ],
};

/// The element turns by 0.9 degrees until the echo arrives, a twentieth of a side lobe beside a null of its pattern.
const NULL: Case = Case {
    name: "beside a null",
    c: 1500.0,
    pulse: "kind = \"cw\"\n\
             center_frequency_khz = 200.0\n\
             duration_ms = 1.0\n\
             taper = 0.2",
    transmit: "position_m = [0.0, 0.0, 0.0]\n\
             pattern = \"omnidirectional\"",
    receive: &["elements = 1\n\
             position_m = [0.0, 0.0, 0.0]\n\
             element_pattern = \"rectangle\"\n\
             element_length_m = 0.5\n\
             element_width_m = 0.01"],
    rate_khz: 30.0,
    filter: "fir",
    range_m: 40.0,
    tolerance: 0.1,
    model: "path = \"k-segment\"\n\
             segment_ms = 50.0\n\
             doppler = \"auto\"\n\
             synthesis = \"direct\"",
    velocity: [0.0; 3],
    acceleration: [0.0; 3],
    pitch: [0.0, 20.0],
    heading: [0.0, 0.0],
    points: &[[24.372, 0.0, 43.706, 1.0, 0.0]],
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
                &format!("[[sonar.receive]]\nname = \"a{k}\"\nsensitivity_db = -30.0\n{array}\n");
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
source_level_db = 20.0
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

    /// Largest error of all windows and elements of the first ping, as the accuracy contract has it, and those that are predicted before and after it.
    fn errors(&self) -> [f64; 3] {
        let folder = tempfile::tempdir().expect("a folder");
        let spec = self.spec(folder.path(), self.model);
        let exact = self.spec(folder.path(), "synthesis = \"reference\"");
        let (got, [before, after]) = first_ping(&spec, true);
        let (want, _) = first_ping(&exact, false);
        let sonar = &spec.sonars[0];
        let window = (sonar.pulse.duration_s * sonar.receiver.sample_rate_hz).ceil();
        (0..got.len())
            .map(|e| window_error(&got[e], &want[e], window.max(32.0) as usize))
            .fold([0.0, before, after], |[worst, before, after], error| {
                [f64::max(worst, error), before, after]
            })
    }
}

/// A pulse of 14 samples: a window of 32 may hold any share of its echo, or its last sample.
const SHORT: Case = Case {
    name: "end of a short pulse",
    c: 1470.6,
    pulse: "kind = \"cw\"\n\
             center_frequency_khz = 194.99\n\
             duration_ms = 0.336\n\
             taper = 0.0",
    transmit: "position_m = [0.632, 0.723, 0.764]\n\
             pattern = \"omnidirectional\"",
    receive: &["elements = 20\n\
             spacing_m = 0.004249\n\
             position_m = [0.606, 0.428, 0.901]\n\
             roll_deg = 60.0\n\
             element_pattern = \"omnidirectional\""],
    rate_khz: 40.918,
    filter: "none",
    range_m: 20.0,
    tolerance: 0.028,
    model: "path = \"auto\"\n\
             segment_ms = 50.0\n\
             doppler = \"stretch\"\n\
             synthesis = \"direct\"",
    velocity: [-5.191, -3.381, 0.0],
    acceleration: [0.0, 0.0, 0.0],
    pitch: [0.0, 0.0],
    heading: [213.077, 0.0],
    points: &[[-3.635556, 1.068548, 6.240166, -0.2269, 0.8893]],
};

/// Samples of all elements of the first ping, and the error of its methods that is predicted for its motion, and with its samples where methods are
/// selected.
fn first_ping(spec: &RigSpec, predict: bool) -> (Vec<Vec<Complex64>>, [f64; 2]) {
    pool(1).expect("a thread").install(|| {
        let mut recorded = RecordedRig::open(spec).expect("opens");
        let mut slot = recorded.rig.slot(0);
        let (sonar, order) = recorded.next_order(1).expect("an order");
        assert!(recorded.settle(sonar, &order));
        recorded.rig.select_first_methods(sonar, &order);
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
        let before = predicted.unwrap_or(0.0);
        let after = slot.output.methods.map(|mark| mark.predicted_error);
        (samples.collect(), [before, after.unwrap_or(before)])
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
    keeps_within(case, 12.0);
}

/// `factor`: largest ratio of predicted and measured error.
fn keeps_within(case: &Case, factor: f64) {
    let [error, before, predicted] = case.errors();
    println!(
        "{}: {error:.2e}, predicted {predicted:.2e} ({before:.2e} before the ping)",
        case.name
    );
    assert!(
        error <= predicted,
        "{}: {error:e} > {predicted:e}",
        case.name
    );
    assert!(
        predicted <= factor * error,
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

/// At rest the level of each window is known: an onset under other echoes is no small window, and the strongest echo raises the noise floor of all.
#[test]
fn onsets_count_where_the_ping_has_them_alone() {
    keeps_within(&AT_REST, 4.0);
}

/// ... of a line too, whose delays are interpolated better than the nearest range of its design needs.
#[test]
fn a_line_at_rest_is_predicted_from_its_windows() {
    keeps_within(&LINES_AT_REST, 5.0);
}

/// A platform may be faster than an engine is designed for and its echoes within the design: then the engine makes them.
#[test]
fn the_error_of_an_engine_counts_beyond_its_fastest_platform() {
    keeps_within(&BEYOND_DESIGN, 6.0);
}

/// Two echoes of about the same level cancel for most of a window; their errors do not, which differ from chord to chord. The samples of the ping tell.
#[test]
fn echoes_that_cancel_count_as_far_as_they_do() {
    keeps_within(&CHORDS, 5.0);
}

/// The receiver filter answers before an echo begins: a window with no more than that has the error of the whole echo.
#[test]
fn what_a_filter_answers_before_an_echo_counts() {
    keeps_within(&BEFORE, 6.0);
}

/// The last sample of a lone echo has more than the rms of what of it a window happens to hold.
#[test]
fn the_last_sample_of_a_short_pulse_counts() {
    keeps_within(&SHORT, 3.0);
}

/// Behind the receiver filter the last samples of a record have echoes that arrive after it, by the motion after it.
#[test]
fn the_last_samples_of_a_record_know_what_follows() {
    let record = |range_m: f64| {
        let case = Case {
            pulse: "kind = \"cw\"\n\
                     center_frequency_khz = 41.51\n\
                     duration_ms = 10.0\n\
                     taper = 0.1",
            rate_khz: 2.241,
            filter: "fir",
            range_m,
            acceleration: [1.5, -1.0, 0.5],
            heading: [213.0, 20.0],
            // Every 3 m ahead and abeam.
            points: &[
                [17.0, 0.0, 20.0, 0.5, 0.9],
                [0.0, 20.0, 20.0, -0.3, 1.2],
                [-23.0, 0.0, 20.0, 0.8, -1.2],
                [0.0, -26.0, 20.0, 1.4, 0.7],
                [29.0, 0.0, 20.0, -1.3, 1.2],
                [0.0, 32.0, 20.0, 1.2, 1.2],
                [-35.0, 0.0, 20.0, 0.8, 1.6],
                [0.0, -38.0, 20.0, 1.8, -0.2],
                [41.0, 0.0, 20.0, -0.8, 1.9],
                [0.0, 44.0, 20.0, -2.3, 0.2],
            ],
            ..SHORT
        };
        let folder = tempfile::tempdir().expect("a folder");
        first_ping(
            &case.spec(folder.path(), "synthesis = \"reference\""),
            false,
        )
        .0
    };
    // The track has a knot every 20 ms: in one of the records soon after its end.
    let long = record(45.0);
    for range_m in [16.0, 20.0, 24.0, 28.0] {
        for (short, long) in record(range_m).iter().zip(&long) {
            assert!(long.len() > short.len());
            let off = short.iter().zip(long).map(|(a, b)| (a - b).norm());
            let level = long.iter().map(|x| x.norm()).fold(0.0, f64::max);
            let worst = off.fold(0.0, f64::max) / level;
            assert!(worst < 1e-12, "{range_m} m: {worst:e}");
        }
    }
}

/// The axes of an array turn evenly about the middle of a chord. The little that they are off there counts where the pattern is steep.
#[test]
fn levels_beside_a_null_count() {
    keeps_within(&NULL, 3.0);
}
