//! Truth and the norm of the contract: error by element and window against the reference through the receiver filter.

use echotank::array::Decimator;
use echotank::array::filter::occupied_hz;
use echotank::echo::reference::reference_with;
use echotank::flow::*;
use num_complex::Complex64;

use super::case::Case;

/// Points of the truth over max(B, 4/T): twice the reference's own density, which leaves 4e-8 of sharp edges and 1e-9 of long flanks.
const TRUTH_DENSITY: f64 = 64.0;

/// ... and at least so many per sample, where a pulse is narrow.
const LEAST_OVERSAMPLE: usize = 16;

/// A window this far below the strongest is held against this level; where those beside it are no stronger nothing sounds, and what is
/// heard there is measured against the strongest.
pub const LEVEL_RANGE_DB: f64 = 55.0;

/// A window is a pulse long, or this many samples.
const LEAST_WINDOW: usize = 32;

pub struct Truth {
    /// The receiver filter, as dense as the truth.
    pub filter: Option<Decimator>,
    /// Of the elements looked at.
    pub records: Vec<Vec<Complex64>>,
}

/// The receiver filter of a case with `density` points over the occupied band.
pub fn filter(case: &Case, density: f64) -> Option<Decimator> {
    if case.filter == ReceiverFilter::None {
        return None;
    }
    let pulse = &case.plan.pulse;
    let oversample = (density * occupied_hz(pulse) / case.rate_hz).ceil() as usize;
    let oversample = oversample.max(LEAST_OVERSAMPLE);
    let filter = Decimator::new(pulse, case.rate_hz, case.doppler_hz, oversample);
    Some(filter.expect("the case's sample rate holds its pulse"))
}

pub fn truth(case: &Case) -> Truth {
    let filter = filter(case, TRUTH_DENSITY);
    let records = case
        .looked_at
        .iter()
        .map(|&element| reference_record(case, filter.as_ref(), element))
        .collect();
    Truth { filter, records }
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

/// Worst of |got - want| over |want| by window, over all elements looked at.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct WorstWindow {
    /// Each window against itself.
    pub itself: f64,
    /// Each against the strongest of those that share samples with it: a window may hold nothing but the last of a flank or the filter's
    /// tail, and no sum on a grid is as good there as it is in the echo's middle.
    pub beside: f64,
    /// What is heard in windows beside which nothing sounds, against the strongest window.
    pub silence: f64,
}

impl WorstWindow {
    fn with(self, other: Self) -> Self {
        // What is no number is worse than any.
        let worse = |a: f64, b: f64| if b > a || b.is_nan() { b } else { a };
        Self {
            itself: worse(self.itself, other.itself),
            beside: worse(self.beside, other.beside),
            silence: worse(self.silence, other.silence),
        }
    }
}

/// Over windows half a window apart.
fn worst_window(case: &Case, got: &[Complex64], want: &[Complex64]) -> WorstWindow {
    let length = (case.plan.pulse.duration_s * case.rate_hz) as usize;
    let length = length.max(LEAST_WINDOW).min(want.len());
    let starts = (0..=want.len() - length).step_by((length / 2).max(1));
    let windows: Vec<(f64, f64)> = starts
        .map(|at| {
            let span = at..at + length;
            let pairs = got[span.clone()].iter().zip(&want[span.clone()]);
            (
                pairs.map(|(g, w)| (g - w).norm_sqr()).sum(),
                want[span].iter().map(|w| w.norm_sqr()).sum(),
            )
        })
        .collect();
    let strongest = windows.iter().map(|w| w.1).fold(0.0, f64::max);
    let floor = strongest * 10f64.powf(-LEVEL_RANGE_DB / 10.0);
    // Nothing where nothing is: no error.
    let relative = |off: f64, size: f64| if off > 0.0 { (off / size).sqrt() } else { 0.0 };
    let mut worst = WorstWindow::default();
    for (k, &(off, size)) in windows.iter().enumerate() {
        let near = &windows[k.saturating_sub(1)..(k + 2).min(windows.len())];
        let beside = near.iter().map(|w| w.1).fold(0.0, f64::max);
        let mut here = WorstWindow::default();
        if beside > floor {
            here.itself = relative(off, size.max(floor));
            here.beside = relative(off, beside);
        } else {
            here.silence = relative(off, strongest);
        }
        worst = worst.with(here);
    }
    worst
}

/// Over all elements looked at.
pub fn error(case: &Case, truth: &Truth, records: &[Vec<Complex64>]) -> WorstWindow {
    let all = records.iter().zip(&truth.records);
    all.map(|(got, want)| worst_window(case, got, want))
        .fold(WorstWindow::default(), WorstWindow::with)
}
