//! What a tolerance needs, at the least cost: the kernel over delay, the grid of Dopplers. ([`super::band`]: the band.)

use std::sync::LazyLock;

use super::doppler::{DopplerGrid, DopplerSpan, MAX_ORDER, Trial};
use super::kernel::{Kernel, MIN_WIDTH};
use super::moments::{MAX_TAPS, Real};
use super::one_dimensional::Spec;
use super::transform::grid_size;

/// Part of [`Pulse::weakest_window`](echotank_core::flow::Pulse::weakest_window) which the shares below leave room for.
const ROOM: f64 = 0.6;

/// By how much echoes that sound together may weaken one another in a window, and with it what errors are measured by: 1 or more.
pub(crate) fn weakening(spec: &Spec) -> f64 {
    (ROOM / spec.pulse.weakest_window(spec.sample_rate_hz)).max(1.0)
}

/// What the band leaves out may take this share of the tolerance in the worst window.
pub(super) const SHARE: f64 = 0.25;

/// Root mean square error of the kernel over delay, as a share of the tolerance; single echoes do three times as ill at a band's ends, where a sweep ends.
const KERNEL_SHARE: f64 = 0.1;

/// The kernel over delay: the smallest grid on which `widest` reaches the shares. `alone`: what a kernel on a grid of so many values leaves of an echo
/// alone in its worst window, by the same tolerance.
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
        // A search for the best window makes a kernel no more than so much better.
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

// Nanoseconds of one core, rough: measured on two processors, within a factor of two.
pub(crate) const NS_PER_ARRIVAL: f64 = 6.0;
/// Of an arrival that goes to several columns, more.
pub(crate) const NS_PER_SPREAD: f64 = 14.0;
/// One column.
pub(crate) const NS_PER_GRID_VALUE: f64 = 3.0;
/// Several, each of the lanes that they take.
pub(crate) const NS_PER_LANE_VALUE: f64 = 2.0;

/// Error that the grid of Dopplers may leave at any instant of the echo that it serves worst, as a share of the tolerance.
const WORST_SHARE: f64 = 0.5;

/// Share of the plan's Dopplers that a ping has: a beam that looks to the side, 16 degrees to either hand, from a platform at full speed.
const TYPICAL_SPAN: f64 = 0.275;

/// What it may leave of an echo alone in its worst window, likewise; and the kernel over delay. Two echoes that begin or end within a sample of each other
/// sound there as two tones do, however wide their band, and may all but cancel, while what is left of them does not: so there is room for
/// 10 to 14 dB where echoes are few.
const ALONE_SHARE: f64 = 0.2;
const KERNEL_ALONE_SHARE: f64 = 0.3;

/// Likewise where they are many: what is left of those that end together adds up to less than the worst of them alone.
const ALONE_AMONG_MANY_SHARE: f64 = 0.5;
const KERNEL_ALONE_AMONG_MANY_SHARE: f64 = 0.6;

/// Whether fewer than one echo begins in a sample.
fn few(spec: &Spec) -> bool {
    spec.arrivals < spec.samples
}

/// How often the former share is halved where a grid leaves more than the latter.
const TRIES: usize = 6;

/// Of the tolerance, what each term of the series in the curvature may leave.
const TERM_SHARE: f64 = 0.1;

/// Of the tolerance: what the terms of that series that are left out may amount to at the ends of a pulse.
pub(crate) const SERIES_SHARE: f64 = 0.1;

/// Terms that the phase `bend_rad` at the ends of a pulse needs; none where [`MAX_ORDER`] are too few.
pub(crate) fn series_terms(bend_rad: f64, tolerance: f64) -> Option<usize> {
    let mut rest = bend_rad;
    for terms in 0..=MAX_ORDER {
        if rest <= SERIES_SHARE * tolerance {
            return Some(terms);
        }
        rest *= bend_rad / (terms + 2) as f64;
    }
    None
}

/// Of the tolerance: what of an echo's curvature may be lost where weights carry it.
const BENT_SHARE: f64 = 0.2;

/// Whether weights may carry a curvature that turns the ends of a pulse by `bend_rad`, and at most p per second.
pub(crate) fn weights_bend(spec: &Spec, bend_rad: f64, greatest_p: f64) -> bool {
    let pulse = spec.pulse;
    let wide = 0.5 * (spec.sample_rate_hz + pulse.bandwidth_hz) / pulse.center_frequency_hz;
    // Weights know no frequency: what is not made good for the ends of pulses (`doppler`) is of second order in the relative band.
    let unknown = wide * wide * bend_rad;
    let strength = greatest_p * pulse.duration_s;
    let third = bend_rad.powi(3) / 6.0;
    unknown + strength + third <= BENT_SHARE * spec.tolerance
}

/// Cells of the grids that are tried.
const TRIAL_CELLS: [usize; 52] = [
    1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16, 17, 18, 20, 22, 24, 26, 28, 30, 32, 34,
    35, 36, 37, 38, 39, 40, 42, 44, 46, 48, 52, 56, 60, 64, 72, 80, 88, 96, 112, 128, 144, 160,
    184, 208, 232, 256,
];

/// Breadths of the weights that are tried: oversamplings that a kernel of so many taps would be made for.
const TRIAL_SHAPES: [f64; 5] = [1.15, 1.3, 1.5, 2.0, 4.0];

/// Powers that weights have beyond their taps: they are read from a table, and derivatives of them are wanted.
const MORE_POWERS: usize = 4;

/// The kernels that are tried, most taps first: they need the fewest cells, and what costs more than they do need not be looked at.
static TRIAL_KERNELS: LazyLock<Vec<Kernel>> = LazyLock::new(|| {
    (MIN_WIDTH..=MAX_TAPS)
        .rev()
        .flat_map(|taps| TRIAL_SHAPES.map(|shape| Kernel::rough(taps, shape, taps + MORE_POWERS)))
        .collect()
});

/// What grids of Dopplers are tried with.
pub(crate) struct Trials<'a> {
    pub spec: &'a Spec<'a>,
    pub span: DopplerSpan,
    /// Values of a column, roughly.
    pub grid: usize,
}

impl Trials<'_> {
    /// The grid for echoes without curvature, or with as much as turns the ends of pulses by `bend_rad`; and its error. `alone`: what a grid
    /// leaves of an echo without curvature, alone in its worst window.
    pub(super) fn doppler(
        &self,
        bend_rad: f64,
        alone: impl Fn(&DopplerGrid) -> f64,
    ) -> Option<(DopplerGrid, f64)> {
        if self.span.greatest == self.span.least && bend_rad == 0.0 {
            return Some((DopplerGrid::common(self.span), 0.0));
        }
        let trial = self.trial(bend_rad);
        let alone_share = match few(self.spec) {
            true => ALONE_SHARE,
            false => ALONE_AMONG_MANY_SHARE,
        };
        let mut share = WORST_SHARE * self.spec.tolerance;
        for _ in 0..TRIES {
            let (grid, error) = self.cheapest(&trial, share)?;
            if alone(&grid) <= alone_share * self.spec.tolerance {
                return Some((grid, error));
            }
            share *= 0.5;
        }
        None
    }

    /// The grid for a term of the series in the curvature that amounts to `size` at the ends of pulses.
    pub(super) fn term(&self, size: f64) -> Option<(DopplerGrid, f64)> {
        let (grid, error) =
            self.cheapest(&self.trial(0.0), TERM_SHARE * self.spec.tolerance / size)?;
        Some((grid, error * size))
    }

    fn trial(&self, bend_rad: f64) -> Trial {
        let pulse = self.spec.pulse;
        let DopplerSpan { least, greatest } = self.span;
        // The upper end of the band turns fastest.
        let highest_hz = pulse.center_frequency_hz + 0.5 * pulse.bandwidth_hz;
        let eta = 1.0 + least.min(0.0);
        Trial {
            turns: highest_hz * 0.5 * pulse.duration_s * (greatest - least) / (eta * eta),
            bend_rad,
            sweep: sweep(self.spec),
        }
    }

    fn cost(&self, grid: &DopplerGrid) -> f64 {
        // What is saved where a ping's Dopplers take up less counts a little.
        let lanes = grid.typical_lanes(TYPICAL_SPAN) + 0.1 * grid.columns_of(TYPICAL_SPAN) as f64;
        lanes * NS_PER_LANE_VALUE * self.grid as f64
    }

    /// The cheapest grid that leaves no instant of an echo more than `share`, and what it leaves.
    fn cheapest(&self, trial: &Trial, share: f64) -> Option<(DopplerGrid, f64)> {
        let common = DopplerGrid::common(self.span);
        let alone = trial.worst(&common);
        if alone <= share {
            return Some((common, alone));
        }
        let mut best = None;
        let mut held = f64::INFINITY;
        let enough = |g: &DopplerGrid| trial.worst(g) <= share;
        for kernel in &*TRIAL_KERNELS {
            // The finer the better, give or take: the coarsest that is enough is found by halving.
            let grids = TRIAL_CELLS.map(|cells| DopplerGrid::new(self.span, cells, kernel));
            let affordable = grids.partition_point(|g| self.cost(g) < held);
            let first = grids[..affordable].partition_point(|g| !enough(g));
            if first < affordable {
                held = self.cost(&grids[first]);
                best = Some((grids[first].clone(), trial.worst(&grids[first])));
            }
        }
        best
    }
}

/// Half the swept band over the carrier, with the sweep's sign.
pub(super) fn sweep(spec: &Spec) -> f64 {
    let pulse = spec.pulse;
    0.5 * pulse.sweep_hz_per_s() * pulse.duration_s / pulse.center_frequency_hz
}
