//! Reference element samples and error norms. Errors are computed by element and window against the reference after the receiver
//! filter.

use std::sync::Mutex;

use echotank_core::arrays::ReceiverFilter;
use echotank_core::model::Synthesis;
use echotank_synthesis::array::Decimator;
use echotank_synthesis::array::filter::occupied_hz;
use echotank_synthesis::array::windows::window_error_model;
use echotank_synthesis::echo::reference::reference_with;
use echotank_synthesis::error_model::ErrorModel;
use num_complex::Complex64;

use super::case::Case;
use crate::reference::received;

/// Number of points of the reference over max(B, 4/T): twice the usual density of the reference. The remaining error is 4e-8 for
/// sharp edges and 1e-9 for long tapers.
const TRUTH_DENSITY: f64 = 64.0;

/// Maximum density. Without weights for edges, points converge slowly on tapers of a few points.
const DENSEST: f64 = 512.0;

/// Minimum number of points per sample for narrow pulses. The bandwidth of the receiver limits the sharpness of their edges.
const MIN_OVERSAMPLE: f64 = 64.0;

/// Dynamic range for which engines are designed, and level of the noise floor for weak windows.
pub(crate) const LEVEL_RANGE_DB: f64 = 55.0;

/// Minimum length of a window in samples; a window is otherwise a pulse long.
const MIN_WINDOW: usize = 32;

pub(crate) struct Truth {
    /// Receiver filter with the density of the reference.
    pub(crate) filter: Option<Decimator>,
    /// Reference samples of the compared elements.
    pub(crate) records: Vec<Vec<Complex64>>,
    /// Results of methods without a tolerance. They do not depend on the requested tolerance.
    error_models: Mutex<Vec<(Synthesis, ErrorModel)>>,
}

impl Truth {
    /// Applies the error model of `synthesis` to every window, with noise floor.
    pub(crate) fn error_model(&self, synthesis: Synthesis, case: &Case) -> ErrorModel {
        let mut error_models = self.error_models.lock().expect("not poisoned");
        if let Some((_, error_model)) = error_models.iter().find(|(of, _)| *of == synthesis) {
            return error_model.clone();
        }
        let error_model = window_error_model(
            synthesis,
            &case.conditions,
            &case.plan,
            case.doppler_hz,
            LEVEL_RANGE_DB,
        )
        .expect("the case's sample rate holds its pulse");
        error_models.push((synthesis, error_model.clone()));
        error_model
    }
}

/// Receiver filter of a case with `density` points over the occupied band.
pub(crate) fn filter(case: &Case, density: f64) -> Option<Decimator> {
    if case.filter == ReceiverFilter::None {
        return None;
    }
    let pulse = &case.plan.pulse;
    let least = MIN_OVERSAMPLE * density / TRUTH_DENSITY;
    let oversample = (density * occupied_hz(pulse) / case.rate_hz).max(least);
    let filter = Decimator::new(
        pulse,
        case.rate_hz,
        case.doppler_hz,
        oversample.ceil() as usize,
    );
    Some(filter.expect("the case's sample rate holds its pulse"))
}

pub(crate) fn truth(case: &Case) -> Truth {
    truth_of(case, TRUTH_DENSITY)
}

fn truth_of(case: &Case, density: f64) -> Truth {
    let filter = filter(case, density);
    let all = case.looked_at.iter();
    Truth {
        records: all
            .map(|&element| reference_record(case, filter.as_ref(), element))
            .collect(),
        filter,
        error_models: Mutex::default(),
    }
}

/// A reference whose half-dense version differs by at most `most` with noise floor, and that difference.
pub(crate) fn truth_within(case: &Case, most: f64) -> (Truth, WorstWindow) {
    let mut density = TRUTH_DENSITY;
    let mut truth = truth(case);
    let mut doubt = doubt(case, &truth);
    while doubt.in_noise > most && density < DENSEST {
        density *= 2.0;
        let denser = truth_of(case, density);
        doubt = error(case, &denser, &truth.records);
        truth = denser;
    }
    (truth, doubt)
}

/// Uncertainty of the reference: error of the half-dense reference and filter against it, by each measure. Without a filter, no
/// density is involved.
pub(crate) fn doubt(case: &Case, truth: &Truth) -> WorstWindow {
    match truth.filter {
        None => WorstWindow::default(),
        Some(_) => error(case, truth, &truth_of(case, 0.5 * TRUTH_DENSITY).records),
    }
}

fn reference_record(case: &Case, filter: Option<&Decimator>, element: usize) -> Vec<Complex64> {
    let plan = &case.plan;
    let mut record = vec![Complex64::ZERO; plan.sample_count];
    let of_window = (case.rate_hz, plan.first_sample_s);
    received(
        filter,
        of_window,
        &mut record,
        |edges, rate_hz, first_s, out| {
            let Case {
                tx, rx, scatterers, ..
            } = case;
            reference_with(
                edges, plan, tx, rx, element, scatterers, rate_hz, first_s, out,
            );
        },
    );
    record
}

/// Minimum energy that the error of a window refers to, as a fraction of that of the middle element.
const FLOOR_OF_MEDIAN: f64 = 1e-6;

/// Largest |got - want| by window and element, by three measures.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct WorstWindow {
    /// Measure without noise: over |want| in the same window, or over 1e-6 of the median of that window over the elements. Infinite
    /// if no element receives an echo and the method synthesises one. In a window with only the end of a taper or of the filter's
    /// tail, that end is the reference level. Even the half-dense reference misses the tolerance there.
    pub(crate) without_noise: f64,
    /// Measure that tolerances apply to: over |want| in the same window, or over its noise, 55 dB below the strongest window.
    pub(crate) in_noise: f64,
    /// Looser measure without guarantee: over the strongest window that shares samples with the window. If that is below the noise
    /// of `in_noise`, over the strongest window of all. This measure separates errors of an echo from residuals beside echoes.
    pub(crate) beside: f64,
}

/// The larger of two errors. NaN ranks as the worst error.
fn worse(a: f64, b: f64) -> f64 {
    if b.is_nan() { f64::INFINITY } else { a.max(b) }
}

/// Relative error; 0 if both values are zero.
fn relative(off: f64, size: f64) -> f64 {
    if off == 0.0 { 0.0 } else { (off / size).sqrt() }
}

/// Energy of every window, sample by sample. Each window is summed anew, because differences of running sums would lose weak
/// windows.
fn energies(record: impl Iterator<Item = f64>, length: usize) -> Vec<f64> {
    let squares: Vec<f64> = record.collect();
    squares.windows(length).map(|w| w.iter().sum()).collect()
}

fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.collect();
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

/// Worst window over all windows of `length` samples of all elements. `got` and `want` are by element.
pub(crate) fn worst_window(
    got: &[Vec<Complex64>],
    want: &[Vec<Complex64>],
    length: usize,
) -> WorstWindow {
    let length = length.max(MIN_WINDOW).min(want[0].len());
    let size: Vec<Vec<f64>> = want
        .iter()
        .map(|record| energies(record.iter().map(|w| w.norm_sqr()), length))
        .collect();
    let mut worst = WorstWindow::default();
    let floor: Vec<f64> = (0..size[0].len())
        .map(|at| FLOOR_OF_MEDIAN.powi(2) * median(size.iter().map(|s| s[at])))
        .collect();
    let strongest = size.iter().flatten().copied().fold(0.0, f64::max);
    let noise = strongest * 10f64.powf(-LEVEL_RANGE_DB / 10.0);
    for ((got, want), size) in got.iter().zip(want).zip(&size) {
        let off = got.iter().zip(want).map(|(g, w)| (g - w).norm_sqr());
        let off = energies(off, length);
        for (at, (&off, &here)) in off.iter().zip(size).enumerate() {
            worst.without_noise = worse(worst.without_noise, relative(off, here.max(floor[at])));
            worst.in_noise = worse(worst.in_noise, relative(off, here.max(noise)));
            // Windows that begin up to a window length away, in steps of a quarter.
            let last = size.len() - 1;
            let around = (0..=8).map(|k| (at + k * length / 4).saturating_sub(length).min(last));
            let loudest = around.map(|k| size[k]).fold(here, f64::max);
            let against = if loudest > noise { loudest } else { strongest };
            worst.beside = worse(worst.beside, relative(off, against));
        }
    }
    worst
}

/// Worst window over all compared elements.
pub(crate) fn error(case: &Case, truth: &Truth, records: &[Vec<Complex64>]) -> WorstWindow {
    let length = (case.plan.pulse.duration_s * case.rate_hz).ceil() as usize;
    worst_window(records, &truth.records, length)
}
