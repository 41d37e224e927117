//! Doppler on a fixed grid: a few received pulses between which every echo's own is interpolated.
//!
//! An echo stretched by eta = 1 + d sounds as a(eta (t - u)) exp(j 2pi f_c d (t - u)). About its middle, u + T/(2 eta), its spectrum is
//!
//! S_d(f) = S((f - f_c d)/(1 + d)) / (1 + d) H(f),  S the pulse's own, H the receiver's.
//!
//! With w the time into the pulse, S_d is an integral over -T/2..T/2 of waves exp(j 2pi w (f_c d - f)/(1 + d)). So it is spread over d like a
//! point over time: each echo goes with `taps` weights to as many columns of a grid of Dopplers, and column j is given the template G_j that
//! makes sum_j weight_j(d) G_j(f) meet S_d(f) best in the least-squares sense. Nothing is expanded in d: the second order is in it, and edges
//! move. The columns lie at fixed Dopplers, so a platform that changes its speed uses other columns, not other templates.
//!
//! How many columns that takes is how fast S_d turns with d. Of a sweep at K Hz/s the part near f left at w = f/K, so that
//!
//! S_d(f) = exp(-j 2pi (f - f_c d/2) tau) R_d(f),  tau = -f_c d/((1 + d)^2 K)
//!
//! leaves in R_d little more than the sweep's own width about that line and its two ends ([`Coupling`]; range-Doppler coupling: Skolnik,
//! Introduction to Radar Systems, "ambiguity of the linear FM pulse"). Shift and phase go with the echo, exactly; the grid carries R_d. A
//! pulse of 30 kHz and 5 ms with a tenth of taper needs 7 columns in place of 17 to 1e-3.
//!
//! In: spectra, span of d, tolerance. Out: weights of an echo, templates per column and bin, the error of the fit as measured.

use num_complex::Complex64;

use crate::flow::Pulse;

use super::kernel::Kernel;
use super::least_squares::Matrix;
use super::moments::MAX_TAPS;
use super::pulse_spectrum::PulseSpectrum;

/// Dopplers at which a cell of the grid is fitted, at least, and for each cycle by which the pulse's ends turn over the whole span.
const SAMPLES_PER_CELL: usize = 6;
const SAMPLES_PER_CYCLE: f64 = 4.0;

/// Powers of the weights' polynomials, at most.
pub const POWERS: usize = 12;

/// d = eta - 1, least and greatest.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DopplerSpan {
    pub least: f64,
    pub greatest: f64,
}

/// Where a sweep's Doppler shift goes: into the echo's place.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Coupling {
    /// tau/d at small d: -f_c/K, or 0 where it is left in the template.
    pub per_doppler_s: f64,
}

impl Coupling {
    pub const NONE: Self = Self { per_doppler_s: 0.0 };

    /// That of a sweep; a pulse without one has none.
    pub fn of(pulse: &Pulse) -> Option<Self> {
        let sweep_hz_per_s = pulse.sweep_hz_per_s();
        (sweep_hz_per_s != 0.0).then(|| Self {
            per_doppler_s: -pulse.center_frequency_hz / sweep_hz_per_s,
        })
    }

    /// tau, seconds.
    #[inline(always)]
    pub fn shift_s(&self, doppler: f64) -> f64 {
        let per_eta = 1.0 / (1.0 + doppler);
        self.per_doppler_s * doppler * per_eta * per_eta
    }
}

/// The received spectrum R_d(f) of one echo, seen from its middle and [`Coupling::shift_s`].
#[derive(Clone, Copy)]
pub struct Received<'a> {
    pub spectrum: &'a PulseSpectrum,
    pub carrier_hz: f64,
    pub coupling: Coupling,
}

impl Received<'_> {
    /// Without the receiver's gain.
    pub fn at(&self, f_hz: f64, d: f64) -> Complex64 {
        let doppler_hz = self.carrier_hz * d;
        let turns = (f_hz - 0.5 * doppler_hz) * self.coupling.shift_s(d);
        let sound = self.spectrum.at((f_hz - doppler_hz) / (1.0 + d)) / (1.0 + d);
        match self.coupling {
            Coupling::NONE => sound,
            _ => sound * Complex64::from_polar(1.0, std::f64::consts::TAU * turns),
        }
    }
}

/// The grid of Dopplers and the weights on it.
#[derive(Clone, Debug)]
pub struct DopplerGrid {
    pub taps: usize,
    pub columns: usize,
    /// d to cells: `d * per_doppler + offset`.
    pub per_doppler: f64,
    pub offset: f64,
    pub cells: usize,
    span: DopplerSpan,
    /// `[k][i]`: of power x^k for tap i; unused taps are 0. A single column has the weight 1.
    pub weights: [[f64; MAX_TAPS]; POWERS],
    /// Of x that the weights have.
    pub powers: usize,
}

impl DopplerGrid {
    /// One column for all.
    pub fn common(span: DopplerSpan) -> Self {
        let mut weights = [[0.0; MAX_TAPS]; POWERS];
        weights[0][0] = 1.0;
        Self::with_weights(span, 1, 1, weights, 1)
    }

    /// `kernel`: its width is the number of taps, its moments the powers of x in their weights, [`POWERS`] at most.
    pub fn new(span: DopplerSpan, cells: usize, kernel: &Kernel) -> Self {
        let mut weights = [[0.0; MAX_TAPS]; POWERS];
        for (k, weights) in weights[..kernel.moments].iter_mut().enumerate() {
            for (i, weight) in weights[..kernel.width].iter_mut().enumerate() {
                *weight = kernel.weight(k, i);
            }
        }
        Self::with_weights(span, cells, kernel.width, weights, kernel.moments)
    }

    fn with_weights(
        span: DopplerSpan,
        cells: usize,
        taps: usize,
        weights: [[f64; MAX_TAPS]; POWERS],
        powers: usize,
    ) -> Self {
        let width = span.greatest - span.least;
        let per_doppler = if width > 0.0 {
            cells as f64 / width
        } else {
            0.0
        };
        let middle = 0.5 * (span.least + span.greatest);
        Self {
            taps,
            columns: cells + taps - 1,
            per_doppler,
            offset: 0.5 * cells as f64 - middle * per_doppler,
            cells,
            span,
            weights,
            powers,
        }
    }

    /// The first column an echo goes to, and its weights. Dopplers outside the span go to the nearest end of it.
    #[inline(always)]
    pub fn place(&self, doppler: f64) -> (usize, f64) {
        let position = (doppler * self.per_doppler + self.offset).clamp(0.0, self.cells as f64);
        let cell = (position as usize).min(self.cells - 1);
        (cell, 2.0 * (position - cell as f64) - 1.0)
    }

    /// Tap `i`'s weight at place `x` of a cell.
    pub fn weight(&self, i: usize, x: f64) -> f64 {
        (0..POWERS)
            .rev()
            .fold(0.0, |sum, k| sum * x + self.weights[k][i])
    }

    /// The columns' weights at the Dopplers of the fit.
    fn weights_at(&self, count: usize) -> Matrix {
        Matrix::from_fn(count, self.columns, |s, column| {
            let position = (s as f64 + 0.5) / count as f64 * self.cells as f64;
            let cell = position as usize;
            match column.checked_sub(cell) {
                Some(tap) if tap < self.taps => {
                    self.weight(tap, 2.0 * (position - cell as f64) - 1.0)
                }
                _ => 0.0,
            }
        })
    }

    /// How many Dopplers a fit of such a pulse needs.
    fn sample_count(&self, carrier_hz: f64, duration_s: f64) -> usize {
        let cycles = (self.span.greatest - self.span.least) * carrier_hz * duration_s;
        (SAMPLES_PER_CELL * self.cells).max((SAMPLES_PER_CYCLE * cycles).ceil() as usize)
    }
}

/// `count` Dopplers evenly over a span, half a step from its ends.
fn dopplers(span: DopplerSpan, count: usize) -> impl Iterator<Item = f64> {
    let step = (span.greatest - span.least) / count as f64;
    (0..count).map(move |s| span.least + (s as f64 + 0.5) * step)
}

/// What a fit is tried on: R_d(f) H(f) at some frequencies and Dopplers.
pub struct Trial {
    count: usize,
    /// `[frequency][doppler]`
    wanted: Vec<Vec<Complex64>>,
    /// Mean over the Dopplers of the sum over frequencies of |R_d H|^2.
    power: f64,
}

impl Trial {
    /// For grids of `most_cells` at most.
    pub fn new(
        received: Received,
        span: DopplerSpan,
        most_cells: usize,
        frequency_hz: &[f64],
        gain: &[f64],
    ) -> Self {
        let count = SAMPLES_PER_CELL * most_cells;
        let wanted: Vec<Vec<Complex64>> = frequency_hz
            .iter()
            .zip(gain)
            .map(|(&f_hz, gain)| {
                dopplers(span, count)
                    .map(|d| received.at(f_hz, d) * gain)
                    .collect()
            })
            .collect();
        let power = wanted
            .iter()
            .flatten()
            .map(Complex64::norm_sqr)
            .sum::<f64>()
            / count as f64;
        Self {
            count,
            wanted,
            power,
        }
    }

    /// Relative error of the echo that `grid` serves worst.
    pub fn worst(&self, grid: &DopplerGrid) -> f64 {
        let weights = grid.weights_at(self.count);
        let fit = weights.pseudo_inverse();
        let mut off = vec![0.0; self.count];
        let mut columns = vec![Complex64::ZERO; grid.columns];
        for wanted in &self.wanted {
            for (column, value) in columns.iter_mut().enumerate() {
                *value = fit.row(column).iter().zip(wanted).map(|(p, s)| s * p).sum();
            }
            for (s, (off, want)) in off.iter_mut().zip(wanted).enumerate() {
                let cell = ((s as f64 + 0.5) / self.count as f64 * grid.cells as f64) as usize;
                let got: Complex64 = (cell..cell + grid.taps)
                    .map(|column| columns[column] * weights.at(s, column))
                    .sum();
                *off += (got - want).norm_sqr();
            }
        }
        (off.iter().copied().fold(0.0, f64::max) / self.power).sqrt()
    }
}

/// What each column sounds like: `templates[column * bins + bin]`, and the relative error of the fit over all bins and Dopplers.
pub struct Templates {
    pub values: Vec<Complex64>,
    pub error: f64,
}

impl Templates {
    /// `frequency_hz` and `gain` give each bin's place and H there.
    pub fn new(
        grid: &DopplerGrid,
        received: Received,
        duration_s: f64,
        frequency_hz: &[f64],
        gain: &[f64],
    ) -> Self {
        let bins = frequency_hz.len();
        let mut values = vec![Complex64::ZERO; grid.columns * bins];
        let count = grid.sample_count(received.carrier_hz, duration_s);
        let weights = grid.weights_at(count);
        let fit = weights.pseudo_inverse();
        let (mut off, mut all) = (0.0, 0.0);
        let mut wanted = vec![Complex64::ZERO; count];
        for bin in 0..bins {
            if gain[bin] == 0.0 {
                continue;
            }
            for (want, d) in wanted.iter_mut().zip(dopplers(grid.span, count)) {
                *want = received.at(frequency_hz[bin], d) * gain[bin];
            }
            for column in 0..grid.columns {
                values[column * bins + bin] = fit
                    .row(column)
                    .iter()
                    .zip(&wanted)
                    .map(|(p, s)| s * p)
                    .sum();
            }
            for (s, want) in wanted.iter().enumerate() {
                let cell = ((s as f64 + 0.5) / count as f64 * grid.cells as f64) as usize;
                let got: Complex64 = (cell..cell + grid.taps)
                    .map(|column| values[column * bins + bin] * weights.at(s, column))
                    .sum();
                off += (got - want).norm_sqr();
                all += want.norm_sqr();
            }
        }
        Self {
            values,
            error: (off / all).sqrt(),
        }
    }
}
