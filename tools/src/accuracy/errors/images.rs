//! Table of the image errors of path and Doppler models and of their sample errors: one point, side-scan lines, over speed and
//! range.
//!
//! Samples and images have separate tolerances. An image may be displaced by a quarter of its cell along the track and by a tenth
//! of a cell in range. Stop-and-hop displaces the image along the track by v r / c. A model without Doppler displaces it in range
//! by |d| f_c T / B.
//!
//! The measurement forms the lines of a sonar with equal transmit and receive apertures that passes the point. Each line is the sum
//! of its elements, compressed with the echo of a sonar at rest. The strongest line, found with a parabola, gives the position
//! along the track. The peak of the compressed line gives the range.

use echotank_core::arrays::{ArrayGeometry, Pattern, TransmitArray};
use echotank_core::model::{DopplerModel, PathModel};
use echotank_core::ping::PingPlan;
use echotank_synthesis::array::Direct;
use echotank_synthesis::echo::{Window, reference};
use echotank_testing::echo as rig;
use glam::DVec3;
use num_complex::Complex64;
use serde::Serialize;

use super::table::{self, C, Case, METHODS, Method, TOLERANCE};

/// Length of both apertures, metres.
const APERTURE_M: f64 = 0.2;
/// Number of receivers; the transmitter suppresses their grating lobes.
const ELEMENTS: usize = 8;
/// Sample rate of the lines, Hz. With several samples per range cell, a parabola finds the peak to hundredths of a cell.
const RATE_HZ: f64 = 160e3;
/// Searched interval of a compressed line around the range of a sonar at rest, samples.
const REACH: i64 = 260;
const MARGIN_S: f64 = 2e-3;
/// Number of lines to either side of the point.
const LINES: i64 = 6;
/// Number of lines per along-track cell.
const LINES_PER_CELL: f64 = 5.0;
/// Angles from the track at which the range bias is measured, degrees: the half-power edge of the receive beam of a side-scan
/// sonar, and a beam squinted forward.
const EDGE_DEG: f64 = 89.524;
const AHEAD_DEG: f64 = 60.0;
const BANDWIDTH_HZ: f64 = 30e3;
const DURATION_S: f64 = 5e-3;
const CARRIER_HZ: f64 = 400e3;

/// Compared models: those of [`METHODS`] that suit images.
pub(crate) fn methods() -> &'static [Method] {
    &METHODS[1..4]
}

/// Speeds and ranges of the full table.
pub(crate) fn cases() -> Vec<(f64, f64)> {
    let speeds = [0.1, 0.5, 1.0, 2.572, 4.0, 5.144, 10.0];
    let rows = |range_m| speeds.map(|speed_m_per_s| (speed_m_per_s, range_m));
    [36.0, 75.0, 150.0].into_iter().flat_map(rows).collect()
}

/// Along-track resolution with equal apertures (two-way, half power), metres.
pub(crate) fn along_cell_m(range_m: f64) -> f64 {
    0.64 * C / CARRIER_HZ * range_m / APERTURE_M
}

/// Range resolution, metres.
pub(crate) const RANGE_CELL_M: f64 = 0.5 * C / BANDWIDTH_HZ;

/// Displacements as predicted and as measured, metres: along the track, in range at the beam's edge, and in range ahead. The last
/// value is the sample error of an element at the edge.
#[derive(Serialize)]
pub(crate) struct Image {
    pub(crate) along_m: (f64, f64),
    pub(crate) edge_m: (f64, f64),
    pub(crate) ahead_m: (f64, f64),
    pub(crate) element_error: f64,
}

impl Image {
    /// Whether a side-scan image meets the tolerance, as predicted and as measured.
    pub(crate) fn passes(&self, range_m: f64) -> (bool, bool) {
        let pass = |along: f64, bias: f64| {
            along.abs() < 0.25 * along_cell_m(range_m) && bias.abs() < 0.1 * RANGE_CELL_M
        };
        (
            pass(self.along_m.0, self.edge_m.0),
            pass(self.along_m.1, self.edge_m.1),
        )
    }
}

fn sonar() -> (TransmitArray, ArrayGeometry) {
    let (tx, rx) = table::sonar();
    let tx = TransmitArray {
        pattern: Pattern::Rectangle {
            length_m: APERTURE_M,
            width_m: 0.0,
            baffled: false,
        },
        ..tx
    };
    let rx = ArrayGeometry {
        elements: ELEMENTS,
        spacing_m: APERTURE_M / ELEMENTS as f64,
        radius_m: None,
        ..rx
    };
    (tx, rx)
}

/// Samples of one element from `first_s`. Without a `method`, the samples of the reference.
fn record(
    method: Option<&Method>,
    plan: &PingPlan,
    (tx, rx): (&TransmitArray, &ArrayGeometry),
    element: usize,
    at_m: DVec3,
    first_s: f64,
) -> Vec<Complex64> {
    let scatterers = rig::points([at_m]);
    let count = ((DURATION_S + 2.0 * MARGIN_S) * RATE_HZ) as usize;
    let mut out = vec![Complex64::ZERO; count];
    let Some(method) = method else {
        reference(
            plan,
            tx,
            rx,
            element,
            &scatterers,
            None,
            RATE_HZ,
            first_s,
            &mut out,
        );
        return out;
    };
    let mut plan = plan.clone();
    plan.model.path = method.path;
    plan.model.doppler = method.doppler;
    let window = Window::of_samples(first_s, RATE_HZ, count);
    let mut sink = Direct::new(&plan, RATE_HZ, first_s, &mut out);
    rig::walk(&plan, tx, rx, element, window, &scatterers, &mut sink);
    out
}

/// Vertex of the parabola through a value and its neighbours, in steps from the value.
fn summit(values: [f64; 3]) -> f64 {
    let [a, b, c] = values;
    0.5 * (a - c) / (a - 2.0 * b + c)
}

/// Peak energy of the compressed line, and its range minus that of a sonar at rest, metres.
fn compressed(line: &[Complex64], still: &[Complex64]) -> (f64, f64) {
    let at = |lag: i64| {
        let product = |(n, s): (usize, &Complex64)| {
            let k = usize::try_from(n as i64 + lag).ok()?;
            Some(line.get(k)? * s.conj())
        };
        let sum: Complex64 = still.iter().enumerate().filter_map(product).sum();
        sum.norm_sqr()
    };
    let squares: Vec<f64> = (-REACH..=REACH).map(at).collect();
    let peak = (1..squares.len() - 1).max_by(|&i, &j| squares[i].total_cmp(&squares[j]));
    let peak = peak.expect("a line has lags");
    let around = [squares[peak - 1], squares[peak], squares[peak + 1]];
    let lag = peak as f64 - REACH as f64 + summit(around);
    (squares[peak], 0.5 * C * lag / RATE_HZ)
}

/// Along-track position of a point abeam in the image, metres ahead of the sonar at transmission.
fn along_m(method: Option<&Method>, speed_m_per_s: f64, range_m: f64) -> f64 {
    let case = Case {
        speed_m_per_s,
        range_m,
        angle_deg: 90.0,
    };
    let plan = table::plan(case);
    let (tx, rx) = sonar();
    let step_m = along_cell_m(range_m) / LINES_PER_CELL;
    let strengths: Vec<f64> = (-LINES..=LINES)
        .map(|k| {
            let at_m = DVec3::new(k as f64 * step_m, range_m, 0.0);
            let first_s = 2.0 * at_m.length() / C - MARGIN_S;
            let mut line: Vec<Complex64> = Vec::new();
            for element in 0..ELEMENTS {
                let samples = record(method, &plan, (&tx, &rx), element, at_m, first_s);
                line.resize(samples.len(), Complex64::ZERO);
                line.iter_mut().zip(samples).for_each(|(a, b)| *a += b);
            }
            let (tx, rx) = table::sonar();
            let still = table::plan(Case {
                speed_m_per_s: 0.0,
                ..case
            });
            let still = record(None, &still, (&tx, &rx), 0, at_m, first_s);
            compressed(&line, &still).0.ln()
        })
        .collect();
    let peak = (1..strengths.len() - 1).max_by(|&i, &j| strengths[i].total_cmp(&strengths[j]));
    let peak = peak.expect("there are lines");
    let around = [strengths[peak - 1], strengths[peak], strengths[peak + 1]];
    (peak as f64 - LINES as f64 + summit(around)) * step_m
}

/// Range of a point in the compressed line of one element minus that of a sonar at rest, metres.
fn range_m(method: Option<&Method>, case: Case) -> f64 {
    let plan = table::plan(case);
    let (sin, cos) = case.angle_deg.to_radians().sin_cos();
    let at_m = DVec3::new(cos, sin, 0.0) * case.range_m;
    let first_s = 2.0 * case.range_m / C - MARGIN_S;
    let (tx, rx) = table::sonar();
    let still = table::plan(Case {
        speed_m_per_s: 0.0,
        ..case
    });
    let still = record(None, &still, (&tx, &rx), 0, at_m, first_s);
    compressed(&record(method, &plan, (&tx, &rx), 0, at_m, first_s), &still).1
}

/// Range bias of `method` at an angle, metres: predicted and measured.
fn range_bias_m(method: &Method, case: Case) -> (f64, f64) {
    let closing_m_per_s = case.speed_m_per_s * case.angle_deg.to_radians().cos();
    // Stop-and-hop ignores the radial motion during the ping. The Doppler shift of the compressed pulse adds to its error.
    let hops = method.path == PathModel::StopAndHop;
    let hop_m = if hops {
        closing_m_per_s * case.range_m / C
    } else {
        0.0
    };
    let shift_m = match method.doppler {
        DopplerModel::None => closing_m_per_s * CARRIER_HZ * DURATION_S / BANDWIDTH_HZ,
        _ => 0.0,
    };
    (
        hop_m + shift_m,
        range_m(Some(method), case) - range_m(None, case),
    )
}

/// Values of the table at one speed and range, by method.
pub(crate) fn measure(speed_m_per_s: f64, range_m: f64) -> Vec<Image> {
    let at = |angle_deg| Case {
        speed_m_per_s,
        range_m,
        angle_deg,
    };
    let along_of = |method| along_m(method, speed_m_per_s, range_m);
    let true_along_m = along_of(None);
    methods()
        .iter()
        .map(|method| {
            let hops = method.path == PathModel::StopAndHop;
            let along = if hops {
                speed_m_per_s * range_m / C
            } else {
                0.0
            };
            Image {
                along_m: (along, along_of(Some(method)) - true_along_m),
                edge_m: range_bias_m(method, at(EDGE_DEG)),
                ahead_m: range_bias_m(method, at(AHEAD_DEG)),
                element_error: table::measure(method, at(EDGE_DEG)).1,
            }
        })
        .collect()
}

pub(crate) fn heading() -> String {
    let mut text = format!("{:>5} {:>6} {:>6}", "m", "m/s", "cell m");
    for method in methods() {
        text += &format!(" | {:^59}", method.name);
    }
    text += &format!("\n{:>5} {:>6} {:>6}", "", "", "");
    for _ in methods() {
        let columns = ["along m", "edge m", "picture", "samples", "60 deg m"];
        let [along, edge, picture, samples, ahead] = columns;
        text += &format!(" | {along:^13} {edge:^13} {picture:^9} {samples:>7} {ahead:^13}");
    }
    text
}

/// One line of the table: for each method, predicted and measured displacements, whether the image passes by either, and the sample
/// error.
pub(crate) fn row((speed_m_per_s, range_m): (f64, f64), measured: &[Image]) -> String {
    let mut line = format!(
        "{range_m:>5} {speed_m_per_s:>6} {:>6.3}",
        along_cell_m(range_m)
    );
    // Displacements below half a millimetre are shown as 0 without a sign, because the prediction has none.
    let pair = |(a, b): (f64, f64)| format!("{:.3} {:.3}", a.abs(), b.abs());
    for image in measured {
        let verdict = |pass: bool| if pass { "pass" } else { "fail" };
        let (predicted, measured) = image.passes(range_m);
        let picture = format!("{} {}", verdict(predicted), verdict(measured));
        let mark = if image.element_error > TOLERANCE {
            "!"
        } else {
            ""
        };
        let samples = format!("{mark}{:.1e}", image.element_error);
        let [along, edge, ahead] = [image.along_m, image.edge_m, image.ahead_m].map(pair);
        line += &format!(" | {along:^13} {edge:^13} {picture:^9} {samples:>7} {ahead:^13}");
    }
    line.truncate(line.trim_end().len());
    line
}
