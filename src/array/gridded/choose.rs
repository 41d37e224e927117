//! What a tolerance needs, at the least cost: the band, the kernel over delay, the grid of Dopplers.

use std::f64::consts::TAU;
use std::sync::LazyLock;

use crate::array::filter::{bessel_i0, occupied_hz};
use crate::flow::Pulse;

use super::doppler::{Coupling, DopplerGrid, DopplerSpan, MAX_ORDER, Received, Trial};
use super::kernel::{Kernel, MIN_WIDTH};
use super::moments::{MAX_TAPS, Real};
use super::one_dimensional::{GriddedError, Spec};
use super::pulse_spectrum::PulseSpectrum;
use super::transform::grid_size;

/// Each of these errors may take this share of the tolerance: kernel over delay, band left out.
pub const SHARE: f64 = 1.0 / 3.0;

/// Multiples of the sample rate that the band may have.
pub const MOST_BANDS: usize = 8;

/// The band that is kept of the received pulse.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Band {
    /// Kept whole up to here to either side.
    pub whole_hz: f64,
    /// Beyond that it is let fade over this; 0: cut.
    pub fade_hz: f64,
    /// Amplitude share of an echo that is left out, at most.
    pub outside: f64,
}

/// Over which a band fades, in sample rates: what it leaves out of an echo then stays within 24 samples of it.
const FADE: f64 = 0.125;

/// The fade is the integral of a Kaiser window: beyond the samples just named 70 dB down.
const FADE_BETA: f64 = 9.0;

impl Band {
    /// Share of frequency `f_hz` that is kept.
    pub fn gain(&self, f_hz: f64) -> f64 {
        let beyond_hz = f_hz.abs() - self.whole_hz;
        if beyond_hz <= 0.0 {
            return 1.0;
        }
        if beyond_hz >= self.fade_hz {
            return 0.0;
        }
        let place = beyond_hz / self.fade_hz * (FADING.len() - 1) as f64;
        let (cell, x) = (place as usize, place.fract());
        FADING[cell] * (1.0 - x) + FADING[cell + 1] * x
    }
}

/// The integral from the outer end of the fade to its inner one.
static FADING: LazyLock<Vec<f64>> = LazyLock::new(|| {
    const STEPS: usize = 1024;
    let bump = |i: usize| {
        let x = 2.0 * (i as f64 + 0.5) / STEPS as f64 - 1.0;
        bessel_i0(FADE_BETA * (1.0 - x * x).sqrt())
    };
    let all: f64 = (0..STEPS).map(bump).sum();
    let mut left = all;
    let mut fading = vec![1.0];
    for i in 0..STEPS {
        left -= bump(i);
        fading.push((left / all).max(0.0));
    }
    fading
});

/// The narrowest band of whole multiples of the sample rate outside of which the received pulse has no more than its share at any Doppler.
///
/// What is cut off sharply at f_e rings for ever: t after the echo with |S H|(f_e) / (2 pi t) per edge, in the window from T to 2 T with
/// |S H| / (2 pi sqrt(T)). In a window that is weaker by the level range that must be within the share too; if it is not, the band fades.
pub fn band(
    spec: &Spec,
    span: DopplerSpan,
    spectrum: &PulseSpectrum,
) -> Result<Band, GriddedError> {
    let ends: Vec<Vec<f64>> = [span.least, span.greatest]
        .iter()
        .map(|&d| shares(spec, d, spectrum))
        .collect();
    let share = |bands: usize| ends.iter().map(|s| s[bands]).fold(0.0, f64::max);
    // With a filter the widest band is what the others are measured by.
    let most = match spec.filter {
        None => MOST_BANDS,
        Some(_) => MOST_BANDS / 2,
    };
    let bands = (1..=most)
        .find(|&bands| share(bands) <= SHARE * spec.tolerance)
        .ok_or(GriddedError::OutOfBand {
            tolerance: spec.tolerance,
            share: share(most),
        })?;
    let whole_hz = 0.5 * bands as f64 * spec.sample_rate_hz;
    let ring = edge_level(spec, span, spectrum, whole_hz)
        / (TAU * (spec.pulse.duration_s * spectrum.energy()).sqrt());
    let heard = ring * 10f64.powf(spec.level_range_db / 20.0);
    Ok(Band {
        whole_hz,
        fade_hz: match heard <= SHARE * spec.tolerance {
            true => 0.0,
            false => FADE * spec.sample_rate_hz,
        },
        outside: share(bands),
    })
}

/// Greatest |S H| about the band's ends: a filter's response has zeros there, next to its ripples.
fn edge_level(spec: &Spec, span: DopplerSpan, spectrum: &PulseSpectrum, edge_hz: f64) -> f64 {
    const LOOKS: i32 = 16;
    let mut most: f64 = 0.0;
    for look in -LOOKS..=LOOKS {
        let from_edge_hz = f64::from(look) / f64::from(LOOKS) * 0.05 * spec.sample_rate_hz;
        for side in [-1.0, 1.0] {
            let f_hz = side * (edge_hz + from_edge_hz);
            let gain = spec.filter.map_or(1.0, |filter| filter.gain(f_hz));
            for d in [span.least, span.greatest] {
                let shift_hz = spec.pulse.center_frequency_hz * d;
                most = most.max((spectrum.at(f_hz - shift_hz) * gain).norm());
            }
        }
    }
    most
}

/// Amplitude share of an echo of Doppler `d` outside of 0, 1, ... [`MOST_BANDS`] multiples of the sample rate.
fn shares(spec: &Spec, d: f64, spectrum: &PulseSpectrum) -> Vec<f64> {
    let shift_hz = spec.pulse.center_frequency_hz * d;
    let step_hz = 0.25 / spec.pulse.duration_s;
    let edge_hz = |bands: usize| 0.5 * bands as f64 * spec.sample_rate_hz;
    let mut outside = [0.0; MOST_BANDS + 1];
    let steps = (edge_hz(MOST_BANDS) / step_hz) as i64;
    for k in -steps..=steps {
        let f_hz = k as f64 * step_hz;
        let gain = spec.filter.map_or(1.0, |filter| filter.gain(f_hz));
        let energy = (spectrum.at(f_hz - shift_hz) * gain).norm_sqr() * step_hz;
        for (bands, outside) in outside.iter_mut().enumerate() {
            if f_hz.abs() > edge_hz(bands) || bands == 0 {
                *outside += energy;
            }
        }
    }
    let within = outside[0];
    // Parseval tells what lies beyond the widest band, down to rounding; a filter leaves nothing there.
    let beyond = match spec.filter {
        None => (spectrum.energy() - within).max(0.0),
        Some(_) => 0.0,
    };
    let share = |outside: &f64| ((outside + beyond) / (within + beyond)).sqrt();
    outside.iter().map(share).collect()
}

/// The kernel over delay: the smallest grid on which `widest` reaches the share.
pub fn delay_kernel<M: Real>(
    tolerance: f64,
    bins: usize,
    widest: usize,
) -> Option<(usize, Kernel)> {
    [1.25, 1.5, 2.0].into_iter().find_map(|oversampling| {
        let grid = grid_size((bins as f64 * oversampling) as usize);
        let oversampling = grid as f64 / bins as f64;
        // A search for the best window makes a kernel no more than so much better.
        let hopeful = |width: &usize| {
            let rough = Kernel::rough(*width, oversampling, M::MOMENTS);
            rough.error <= 3.0 * SHARE * tolerance
        };
        (MIN_WIDTH..=widest)
            .filter(hopeful)
            .map(|width| Kernel::new(width, oversampling, M::MOMENTS))
            .find(|kernel| kernel.error <= SHARE * tolerance)
            .map(|kernel| (grid, kernel))
    })
}

// Nanoseconds of one core, rough: measured on two processors, within a factor of two.
pub const NS_PER_ARRIVAL: f64 = 6.0;
/// Of an arrival on all its values of the grids, per row that a value has.
pub const NS_PER_ROW: f64 = 6.0;
/// Of an arrival, per weight on the columns that it goes to.
const NS_PER_TAP: f64 = 0.2;
pub const NS_PER_GRID_VALUE: f64 = 3.0;

/// Error that the grid of Dopplers may leave to the echo that it serves worst, as a share of the tolerance. A window of a pulse's length holds
/// some 1 + B T independent values: where those are few, echoes cancel each other in some windows, and their errors do not.
fn worst_share(pulse: &Pulse) -> f64 {
    const MANY: f64 = 20.0;
    if pulse.bandwidth_hz * pulse.duration_s < MANY {
        0.3
    } else {
        0.6
    }
}

/// Share of the plan's Dopplers that a ping has: a beam that looks to the side, 17 degrees to either hand, from a platform at full speed.
const TYPICAL_SPAN: f64 = 0.3;

/// Of the worst share, what each term of the series in the curvature may leave.
const TERM_SHARE: f64 = 0.3;

/// Of the tolerance: what the terms of that series that are left out may amount to at the ends of a pulse.
pub const SERIES_SHARE: f64 = 0.1;

/// Terms that the phase `bend_rad` at the ends of a pulse needs; none where [`MAX_ORDER`] are too few.
pub fn series_terms(bend_rad: f64, tolerance: f64) -> Option<usize> {
    let mut rest = bend_rad;
    for terms in 0..=MAX_ORDER {
        if rest <= SERIES_SHARE * tolerance {
            return Some(terms);
        }
        rest *= bend_rad / (terms + 2) as f64;
    }
    None
}

/// Frequencies that a grid of Dopplers is tried on.
const TRIAL_FREQUENCIES: usize = 64;

/// Cells of the grids that are tried.
const TRIAL_CELLS: [usize; 16] = [1, 2, 3, 4, 5, 6, 8, 10, 13, 16, 20, 25, 32, 40, 50, 64];

/// Breadths of the weights that are tried: oversamplings that a kernel of so many taps would be made for.
const TRIAL_SHAPES: [f64; 4] = [1.25, 1.5, 2.0, 4.0];

/// The kernels that are tried, most taps first: they need the fewest cells, and what costs more than they do need not be looked at.
static TRIAL_KERNELS: LazyLock<Vec<Kernel>> = LazyLock::new(|| {
    (MIN_WIDTH..=MAX_TAPS)
        .rev()
        .flat_map(|taps| TRIAL_SHAPES.map(|shape| Kernel::rough(taps, shape, taps)))
        .collect()
});

/// What grids of Dopplers are tried with.
pub struct Trials<'a> {
    spec: &'a Spec<'a>,
    span: DopplerSpan,
    /// Values of a column, roughly.
    grid: usize,
    frequency_hz: Vec<f64>,
    gain: Vec<f64>,
    /// Of an echo without curvature.
    power: f64,
}

impl<'a> Trials<'a> {
    pub fn new(spec: &'a Spec, span: DopplerSpan, band_hz: f64, grid: usize) -> Self {
        // Where the echoes are.
        let fastest = span.least.abs().max(span.greatest);
        let occupied_hz = occupied_hz(spec.pulse) + 2.0 * fastest * spec.pulse.center_frequency_hz;
        let band_hz = band_hz.min(1.25 * occupied_hz);
        let frequency_hz: Vec<f64> = (0..TRIAL_FREQUENCIES)
            .map(|i| ((i as f64 + 0.5) / TRIAL_FREQUENCIES as f64 - 0.5) * band_hz)
            .collect();
        let gain: Vec<f64> = frequency_hz
            .iter()
            .map(|&f_hz| spec.filter.map_or(1.0, |filter| filter.gain(f_hz)))
            .collect();
        Self {
            spec,
            span,
            grid,
            frequency_hz,
            gain,
            power: 0.0,
        }
    }

    /// The grid for echoes without curvature, with or without coupling.
    pub fn doppler<M: Real>(
        &mut self,
        spectrum: &PulseSpectrum,
    ) -> Option<(DopplerGrid, Coupling)> {
        if self.span.greatest == self.span.least {
            self.power = self.trial(self.received(spectrum, Coupling::NONE)).power;
            return Some((DopplerGrid::common(self.span), Coupling::NONE));
        }
        let share = worst_share(self.spec.pulse) * self.spec.tolerance;
        let mut best: Option<(DopplerGrid, Coupling)> = None;
        for coupling in [Coupling::of(self.spec.pulse), Some(Coupling::NONE)]
            .into_iter()
            .flatten()
        {
            let trial = self.trial(self.received(spectrum, coupling));
            self.power = trial.power;
            let held = best.as_ref().map(|(grid, _)| self.cost::<M>(grid));
            if let Some(grid) = self.cheapest::<M>(&trial, share, held) {
                best = Some((grid, coupling));
            }
        }
        best
    }

    /// The grid for one term of the series in the curvature. To be called after [`Self::doppler`].
    pub fn term<M: Real>(&self, received: Received) -> Option<DopplerGrid> {
        let share = TERM_SHARE * worst_share(self.spec.pulse) * self.spec.tolerance;
        self.cheapest::<M>(&self.trial(received), share, None)
    }

    fn received<'b>(&self, spectrum: &'b PulseSpectrum, coupling: Coupling) -> Received<'b> {
        Received {
            spectrum,
            carrier_hz: self.spec.pulse.center_frequency_hz,
            coupling,
            duration_s: self.spec.pulse.duration_s,
            order: 0,
            greatest_p: 0.0,
        }
    }

    fn trial(&self, received: Received) -> Trial {
        let most_cells = TRIAL_CELLS[TRIAL_CELLS.len() - 1];
        Trial::new(
            received,
            self.span,
            most_cells,
            &self.frequency_hz,
            &self.gain,
        )
    }

    fn cost<M: Real>(&self, grid: &DopplerGrid) -> f64 {
        let columns = grid.columns_of(TYPICAL_SPAN);
        let rows = columns.div_ceil(M::MOMENTS);
        (rows as f64 * NS_PER_ROW + grid.taps as f64 * NS_PER_TAP) * self.spec.arrivals as f64
            + columns as f64 * NS_PER_GRID_VALUE * self.grid as f64
    }

    /// The cheapest grid that leaves no echo more than `share`, if it costs less than `held`.
    fn cheapest<M: Real>(
        &self,
        trial: &Trial,
        share: f64,
        held: Option<f64>,
    ) -> Option<DopplerGrid> {
        let mut best = None;
        let mut held = held.unwrap_or(f64::INFINITY);
        let enough = |g: &DopplerGrid| trial.worst(g, self.power) <= share;
        let common = DopplerGrid::common(self.span);
        if self.cost::<M>(&common) < held && enough(&common) {
            return Some(common);
        }
        for kernel in &*TRIAL_KERNELS {
            // The finer the better, give or take: the coarsest that is enough is found by halving.
            let grids = TRIAL_CELLS.map(|cells| DopplerGrid::new(self.span, cells, kernel));
            let affordable = grids.partition_point(|g| self.cost::<M>(g) < held);
            let first = grids[..affordable].partition_point(|g| !enough(g));
            if first < affordable {
                held = self.cost::<M>(&grids[first]);
                best = Some(grids[first].clone());
            }
        }
        best
    }
}
