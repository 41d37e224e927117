//! Reference element samples and error norms. Errors are computed by element and window against the reference after the receiver
//! filter.

use std::sync::Mutex;

use echotank_core::arrays::ReceiverFilter;
use echotank_core::model::Synthesis;
use echotank_core::pulse::{FLOOR_BELOW_STRONGEST_DB, MIN_WINDOW};
use echotank_synthesis::array::error_models::synthesis_error_model;
use echotank_synthesis::array::{Decimator, FilterDesign, oversample};
use echotank_synthesis::echo::reference;
use echotank_synthesis::error_model::ErrorModel;
use num_complex::Complex64;

use super::case::Case;

pub(crate) struct Truth {
    /// Receiver filter.
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
        let filter = filter_design(case, synthesis);
        let error_model = synthesis_error_model(synthesis, &case.conditions, &case.plan, filter);
        error_models.push((synthesis, error_model.clone()));
        error_model
    }
}

/// Receiver filter of a case for a method.
pub(crate) fn filter_design(case: &Case, synthesis: Synthesis) -> Option<FilterDesign> {
    let pulse = case.plan.pulse;
    let design = FilterDesign {
        pulse,
        sample_rate_hz: case.rate_hz,
        doppler_hz: case.doppler_hz,
        oversample: oversample(&pulse, case.rate_hz, synthesis),
    };
    (case.filter == ReceiverFilter::Fir).then_some(design)
}

/// As [`filter_design`].
pub(crate) fn filter(case: &Case, synthesis: Synthesis) -> Option<Decimator> {
    let design = filter_design(case, synthesis)?;
    Some(
        design
            .decimator()
            .expect("the case's sample rate holds its pulse"),
    )
}

pub(crate) fn truth(case: &Case) -> Truth {
    let filter = filter(case, Synthesis::Reference);
    let all = case.looked_at.iter();
    Truth {
        records: all
            .map(|&element| reference_record(case, filter.as_ref(), element))
            .collect(),
        filter,
        error_models: Mutex::default(),
    }
}

fn reference_record(case: &Case, filter: Option<&Decimator>, element: usize) -> Vec<Complex64> {
    let plan = &case.plan;
    let mut record = vec![Complex64::ZERO; plan.sample_count];
    let Case {
        tx, rx, scatterers, ..
    } = case;
    let (rate_hz, first_s) = (case.rate_hz, plan.first_sample_s);
    reference(
        plan,
        tx,
        rx,
        element,
        scatterers,
        filter,
        rate_hz,
        first_s,
        &mut record,
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
    /// tail, that end is the reference level.
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
    let length = length.max(MIN_WINDOW as usize).min(want[0].len());
    let size: Vec<Vec<f64>> = want
        .iter()
        .map(|record| energies(record.iter().map(|w| w.norm_sqr()), length))
        .collect();
    let mut worst = WorstWindow::default();
    let floor: Vec<f64> = (0..size[0].len())
        .map(|at| FLOOR_OF_MEDIAN.powi(2) * median(size.iter().map(|s| s[at])))
        .collect();
    let strongest = size.iter().flatten().copied().fold(0.0, f64::max);
    let noise = strongest * 10f64.powf(-FLOOR_BELOW_STRONGEST_DB / 10.0);
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
