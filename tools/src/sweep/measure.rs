//! Truth and the norm of the contract: error by element and window against the reference through the receiver filter.

use std::sync::Mutex;

use echotank_core::flow::*;
use echotank_synthesis::array::Decimator;
use echotank_synthesis::array::filter::occupied_hz;
use echotank_synthesis::array::windows::window_error_model;
use echotank_synthesis::echo::reference::reference_with;
use num_complex::Complex64;

use super::case::Case;

/// Points of the truth over max(B, 4/T): twice the reference's own density, which leaves 4e-8 of sharp edges and 1e-9 of long flanks.
const TRUTH_DENSITY: f64 = 64.0;

/// A truth that must be known better is made denser, up to here: points alone, without weights for edges, converge slowly on flanks of a few points.
const DENSEST: f64 = 512.0;

/// ... and at least so many per sample, where a pulse is narrow: its edges are as sharp as the receiver's band lets them be.
const MIN_OVERSAMPLE: f64 = 64.0;

/// What the engines are told of the range of levels, and where the noise is put that the contract may count a weak window against.
pub(crate) const LEVEL_RANGE_DB: f64 = 55.0;

/// A window is a pulse long, or this many samples.
const MIN_WINDOW: usize = 32;

pub(crate) struct Truth {
    /// The receiver filter, as dense as the truth.
    pub(crate) filter: Option<Decimator>,
    /// Of the elements looked at.
    pub(crate) records: Vec<Vec<Complex64>>,
    /// Of the sums without a tolerance of their own, as they were asked for: none depends on what is asked.
    error_models: Mutex<Vec<(Synthesis, ErrorModel)>>,
}

impl Truth {
    /// The error model of `synthesis` in every window in noise.
    pub(crate) fn error_model(&self, synthesis: Synthesis, case: &Case) -> ErrorModel {
        let mut error_models = self.error_models.lock().expect("nobody panics with it");
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

/// The receiver filter of a case with `density` points over the occupied band.
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

/// One of which the next sparser, half as dense, is off by `most` in noise at most; and by what that is off.
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

/// The reference and its filter half as dense, against the truth: what by each measure is not known. Without a filter nothing is summed
/// densely.
pub(crate) fn doubt(case: &Case, truth: &Truth) -> WorstWindow {
    match truth.filter {
        None => WorstWindow::default(),
        Some(_) => error(case, truth, &truth_of(case, 0.5 * TRUTH_DENSITY).records),
    }
}

fn reference_record(case: &Case, filter: Option<&Decimator>, element: usize) -> Vec<Complex64> {
    let plan = &case.plan;
    let mut out = vec![Complex64::ZERO; plan.sample_count];
    let sum = |edges, rate_hz, first_s, out: &mut [Complex64]| {
        reference_with(
            edges,
            plan,
            &case.tx,
            &case.rx,
            element,
            &case.scatterers,
            rate_hz,
            first_s,
            out,
        );
    };
    match filter {
        None => sum(Edges::Sampled, case.rate_hz, plan.first_sample_s, &mut out),
        Some(filter) => {
            let mut dense = vec![Complex64::ZERO; filter.dense_len(out.len())];
            let first_s = filter.dense_first_s(plan.first_sample_s);
            sum(Edges::Weighted, filter.dense_rate_hz(), first_s, &mut dense);
            filter.apply(&dense, &mut out);
        }
    }
    out
}

/// The contract counts a window against itself, or against this share of the middlemost element's where it is weaker still.
const FLOOR_OF_MEDIAN: f64 = 1e-6;

/// Worst of |got - want| by window and element, three ways.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct WorstWindow {
    /// The contract's where there is no noise: over |want| in the same window, or over 1e-6 of that window's median over the elements. Infinite
    /// where no element hears anything and something was made. Where a window holds the end of a flank or of the filter's tail alone, this
    /// asks for that end to within its tolerance of itself: the reference half as dense does not keep that either.
    pub(crate) without_noise: f64,
    /// The contract's: over |want| in the same window, or over the noise in it, 55 dB below the strongest.
    pub(crate) in_noise: f64,
    /// Looser, and no promise: over the loudest window that shares samples with it; where even that is below the noise of `in_noise`, over
    /// the strongest. It tells what is wrong with an echo from what is left beside echoes.
    pub(crate) beside: f64,
}

/// What is no number is worse than any.
fn worse(a: f64, b: f64) -> f64 {
    if b.is_nan() { f64::INFINITY } else { a.max(b) }
}

/// Nothing where nothing is: no error.
fn relative(off: f64, size: f64) -> f64 {
    if off == 0.0 { 0.0 } else { (off / size).sqrt() }
}

/// Energy of every window, sample by sample; each summed afresh, since differences of running sums would lose the weak ones.
fn energies(record: impl Iterator<Item = f64>, length: usize) -> Vec<f64> {
    let squares: Vec<f64> = record.collect();
    squares.windows(length).map(|w| w.iter().sum()).collect()
}

fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.collect();
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

/// Over all windows of `length` samples of all elements' records; `got` and `want` by element.
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
            // Those that begin anywhere up to a window away; every quarter of one will do.
            let last = size.len() - 1;
            let around = (0..=8).map(|k| (at + k * length / 4).saturating_sub(length).min(last));
            let loudest = around.map(|k| size[k]).fold(here, f64::max);
            let against = if loudest > noise { loudest } else { strongest };
            worst.beside = worse(worst.beside, relative(off, against));
        }
    }
    worst
}

/// Over all elements looked at.
pub(crate) fn error(case: &Case, truth: &Truth, records: &[Vec<Complex64>]) -> WorstWindow {
    let length = (case.plan.pulse.duration_s * case.rate_hz).ceil() as usize;
    worst_window(records, &truth.records, length)
}
