//! Selection of the cheapest kernel over delay and of the cheapest Doppler grid for a tolerance.
//! [`super::band`] selects the band.

use std::collections::HashMap;
use std::sync::{LazyLock, Mutex, PoisonError};

use super::doppler::{DopplerGrid, DopplerSpan, MAX_ORDER, Trial};
use super::kernel::{Kernel, MIN_WIDTH};
use super::moments::{MAX_TAPS, Real};
use super::one_dimensional::Spec;
use super::transform::grid_size;

/// Factor on [`Pulse::weakest_window`](echotank_core::pulse::Pulse::weakest_window) for which the
/// shares below allow.
const ROOM: f64 = 0.6;

/// Factor by which overlapping echoes may cancel in a window; at least 1. Errors are relative to
/// the level that remains.
pub(crate) fn weakening(spec: &Spec) -> f64 {
    (ROOM / spec.pulse.weakest_window(spec.sample_rate_hz)).max(1.0)
}

/// Fraction of the tolerance, in the worst window, for the truncation of the band.
pub(super) const SHARE: f64 = 0.25;

/// Rms error of the kernel over delay, as a fraction of the tolerance. Single echoes have three
/// times this error at the ends of a band, where a sweep ends.
const KERNEL_SHARE: f64 = 0.1;

/// Selects the kernel over delay: the smallest grid on which a kernel of at most
/// `widest` values meets the shares. `alone` returns the single-echo error in the worst window, of
/// a kernel on a grid of the given size.
pub(crate) fn delay_kernel<M: Real>(
    spec: &Spec,
    bins: usize,
    widest: usize,
    alone: impl Fn(usize, &Kernel) -> f64,
) -> Option<(usize, Kernel)> {
    let tolerance = spec.tolerance;
    let alone_share = match few(spec) {
        true => KERNEL_ALONE_SHARE,
        false => KERNEL_ALONE_AMONG_MANY_SHARE,
    };
    [1.25, 1.5, 2.0].into_iter().find_map(|oversampling| {
        let grid = grid_size((bins as f64 * oversampling) as usize);
        let oversampling = grid as f64 / bins as f64;
        // The search for the best window parameter improves a kernel by at most this factor.
        let hopeful = |width: &usize| {
            let rough = Kernel::rough(*width, oversampling, M::MOMENTS);
            rough.error <= 3.0 * KERNEL_SHARE * tolerance
        };
        (MIN_WIDTH..=widest)
            .filter(hopeful)
            .map(|width| Kernel::new(width, oversampling, M::MOMENTS))
            .find(|kernel| {
                kernel.error <= KERNEL_SHARE * tolerance
                    && alone(grid, kernel) <= alone_share * tolerance
            })
            .map(|kernel| (grid, kernel))
    })
}

// Approximate costs in nanoseconds of one core, within a factor of two on two processors.
pub(crate) const NS_PER_ARRIVAL: f64 = 6.0;
/// Additional cost of an arrival that is spread over several columns.
pub(crate) const NS_PER_SPREAD: f64 = 14.0;
/// Cost of a grid value of one column.
pub(crate) const NS_PER_GRID_VALUE: f64 = 3.0;
/// Cost of a grid value of several columns, per lane.
pub(crate) const NS_PER_LANE_VALUE: f64 = 2.0;

/// Maximum error of the Doppler grid at any instant of an echo, as a fraction of the tolerance.
const WORST_SHARE: f64 = 0.5;

/// Typical fraction of the designed Doppler span in one ping: a side-looking beam, 16 degrees to
/// either side, from a platform at full speed.
const TYPICAL_SPAN: f64 = 0.275;

/// Single-echo error allowed in the worst window, as a fraction of the tolerance, for the Doppler
/// grid and for the kernel over delay.
///
/// Two echoes that begin or end within one sample interfere there like two tones, whatever their
/// bandwidth. They may almost cancel while their errors do not. The shares therefore leave a margin
/// of 10 to 14 dB for pings with few echoes.
const ALONE_SHARE: f64 = 0.2;
const KERNEL_ALONE_SHARE: f64 = 0.3;

/// As [`ALONE_SHARE`], for pings with many echoes. The errors of echoes that end together add up to
/// less than the worst single error.
const ALONE_AMONG_MANY_SHARE: f64 = 0.5;
const KERNEL_ALONE_AMONG_MANY_SHARE: f64 = 0.6;

/// Whether fewer than one echo begins per sample.
pub(super) fn few(spec: &Spec) -> bool {
    spec.arrivals < spec.samples
}

/// Maximum number of times that [`WORST_SHARE`] is halved until a grid meets the single-echo share.
const TRIES: usize = 6;

/// Error allowed for each term of the series in curvature, as a fraction of the tolerance.
const TERM_SHARE: f64 = 0.1;

/// Truncation error of that series allowed at the ends of a pulse, as a fraction of the tolerance.
pub(crate) const SERIES_SHARE: f64 = 0.1;

/// Number of terms for the phase `curvature_rad` at the ends of a pulse; `None` if [`MAX_ORDER`] is too
/// few.
pub(crate) fn series_terms(curvature_rad: f64, tolerance: f64) -> Option<usize> {
    let mut rest = curvature_rad;
    for terms in 0..=MAX_ORDER {
        if rest <= SERIES_SHARE * tolerance {
            return Some(terms);
        }
        rest *= curvature_rad / (terms + 2) as f64;
    }
    None
}

/// Error allowed for a curvature carried by weights, as a fraction of the tolerance.
const BENT_SHARE: f64 = 0.2;

/// Whether weights may carry a curvature with the phase `curvature_rad` at the ends of a pulse. p is at
/// most `greatest_p` per second.
pub(crate) fn weights_carry_curvature(spec: &Spec, curvature_rad: f64, greatest_p: f64) -> bool {
    let pulse = spec.pulse;
    let wide = 0.5 * (spec.sample_rate_hz + pulse.bandwidth_hz) / pulse.center_frequency_hz;
    // Weights do not depend on frequency. After the correction at the ends of pulses (`doppler`),
    // the remaining error is of second order in the relative band.
    let unknown = wide * wide * curvature_rad;
    let strength = greatest_p * pulse.duration_s;
    let third = curvature_rad.powi(3) / 6.0;
    unknown + strength + third <= BENT_SHARE * spec.tolerance
}

/// Candidate numbers of cells.
const TRIAL_CELLS: [usize; 52] = [
    1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16, 17, 18, 20, 22, 24, 26, 28, 30, 32, 34,
    35, 36, 37, 38, 39, 40, 42, 44, 46, 48, 52, 56, 60, 64, 72, 80, 88, 96, 112, 128, 144, 160,
    184, 208, 232, 256,
];

/// Candidate shapes of weights. A shape is the oversampling for which a kernel with these taps is
/// designed.
const TRIAL_SHAPES: [f64; 5] = [1.15, 1.3, 1.5, 2.0, 4.0];

/// Powers of the weights beyond the number of taps, for the table and the derivatives.
const MORE_POWERS: usize = 4;

/// Candidate kernels, most taps first. These need the fewest cells, so later candidates that cost
/// more are skipped.
static TRIAL_KERNELS: LazyLock<Vec<Kernel>> = LazyLock::new(|| {
    (MIN_WIDTH..=MAX_TAPS)
        .rev()
        .flat_map(|taps| TRIAL_SHAPES.map(|shape| Kernel::rough(taps, shape, taps + MORE_POWERS)))
        .collect()
});

/// Errors of trials, by the bits of the trial, the index of its kernel and its number of cells. A selection asks for the same grids at several
/// tolerances and with several Doppler models, and so does the next one.
static TRIED: LazyLock<Mutex<HashMap<TrialKey, f64>>> = LazyLock::new(Mutex::default);

type TrialKey = ([u64; 3], usize, usize);

/// Maximum number of [`TRIED`] errors; a topside that tries many pulses does not grow the table without end.
const MAX_TRIED: usize = 1 << 16;

/// [`Trial::worst`], computed once.
fn worst(trial: &Trial, kernel: usize, grid: &DopplerGrid) -> f64 {
    let bits = [trial.turns, trial.curvature_rad, trial.sweep].map(f64::to_bits);
    let key = (bits, kernel, grid.cells);
    let tried = || TRIED.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(&error) = tried().get(&key) {
        return error;
    }
    let error = trial.worst(grid);
    let mut tried = tried();
    if tried.len() >= MAX_TRIED {
        tried.clear();
    }
    tried.insert(key, error);
    error
}

/// A Doppler grid with its error.
pub(super) struct FittedGrid {
    pub grid: DopplerGrid,
    /// At the worst instant of an echo.
    pub error: f64,
}

/// Inputs to the selection of Doppler grids.
pub(crate) struct Trials<'a> {
    pub spec: &'a Spec<'a>,
    pub span: DopplerSpan,
    /// Approximate number of values of a column.
    pub grid: usize,
}

impl Trials<'_> {
    /// Selects the grid for echoes without curvature, or with a curvature of phase `curvature_rad` at
    /// the ends of pulses. `alone` returns the single-echo error
    /// of a grid in the worst window, without curvature.
    pub(super) fn doppler(
        &self,
        curvature_rad: f64,
        alone: impl Fn(&DopplerGrid) -> f64,
    ) -> Option<FittedGrid> {
        if self.span.greatest == self.span.least && curvature_rad == 0.0 {
            return Some(FittedGrid {
                grid: DopplerGrid::common(self.span),
                error: 0.0,
            });
        }
        let trial = self.trial(curvature_rad);
        let alone_share = match few(self.spec) {
            true => ALONE_SHARE,
            false => ALONE_AMONG_MANY_SHARE,
        };
        let mut share = WORST_SHARE * self.spec.tolerance;
        for _ in 0..TRIES {
            let (grid, error) = self.cheapest(&trial, share)?;
            if alone(&grid) <= alone_share * self.spec.tolerance {
                return Some(FittedGrid { grid, error });
            }
            share *= 0.5;
        }
        None
    }

    /// Selects the grid for a curvature term whose value at the ends of pulses is `size`.
    pub(super) fn term(&self, size: f64) -> Option<(DopplerGrid, f64)> {
        let (grid, error) =
            self.cheapest(&self.trial(0.0), TERM_SHARE * self.spec.tolerance / size)?;
        Some((grid, error * size))
    }

    fn trial(&self, curvature_rad: f64) -> Trial {
        let pulse = self.spec.pulse;
        let DopplerSpan { least, greatest } = self.span;
        // The phase at the upper end of the band changes fastest with Doppler.
        let highest_hz = pulse.center_frequency_hz + 0.5 * pulse.bandwidth_hz;
        let eta = 1.0 + least.min(0.0);
        Trial {
            turns: highest_hz * 0.5 * pulse.duration_s * (greatest - least) / (eta * eta),
            curvature_rad,
            sweep: sweep(self.spec),
        }
    }

    fn cost(&self, grid: &DopplerGrid) -> f64 {
        // The saving for pings with a narrower span has a small weight.
        let lanes = grid.typical_lanes(TYPICAL_SPAN) + 0.1 * grid.columns_of(TYPICAL_SPAN) as f64;
        lanes * NS_PER_LANE_VALUE * self.grid as f64
    }

    /// The cheapest grid with an error of at most `share` at any instant, with its error.
    fn cheapest(&self, trial: &Trial, share: f64) -> Option<(DopplerGrid, f64)> {
        let common = DopplerGrid::common(self.span);
        let alone = trial.worst(&common);
        if alone <= share {
            return Some((common, alone));
        }
        let mut best = None;
        let mut held = f64::INFINITY;
        for (index, kernel) in TRIAL_KERNELS.iter().enumerate() {
            let error = |g: &DopplerGrid| worst(trial, index, g);
            // The error decreases with the number of cells, so bisection finds the coarsest
            // sufficient grid.
            let grids = TRIAL_CELLS.map(|cells| DopplerGrid::new(self.span, cells, kernel));
            let affordable = grids.partition_point(|g| self.cost(g) < held);
            let first = grids[..affordable].partition_point(|g| error(g) > share);
            if first < affordable {
                held = self.cost(&grids[first]);
                best = Some((grids[first].clone(), error(&grids[first])));
            }
        }
        best
    }
}

/// Half the swept band over the carrier, with the sign of the sweep.
pub(super) fn sweep(spec: &Spec) -> f64 {
    let pulse = spec.pulse;
    0.5 * pulse.sweep_hz_per_s() * pulse.duration_s / pulse.center_frequency_hz
}
