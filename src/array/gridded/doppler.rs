//! Doppler on a fixed grid: a few received pulses between which every echo's own is interpolated.
//!
//! An echo stretched by eta = 1 + d sounds as a(eta (t - u)) exp(j 2pi f_c d (t - u)). About its middle, u + T/(2 eta), its spectrum is
//!
//! S_d(f) = S((f - f_c d)/(1 + d)) / (1 + d) H(f),  S the pulse's own, H the receiver's.
//!
//! With w the time into the pulse, S_d is an integral over -T/2..T/2 of waves exp(j 2pi w (f_c d - f)/(1 + d)): smooth in d, its highest
//! "frequency" in d is (f_c + f) T/2. So it is spread over d like a point over time: each echo goes with `taps` weights to as many columns
//! of a grid of step h, and column j is given the template G_j that makes sum_j weight_j(d) G_j(f) meet S_d(f) best in the least-squares
//! sense. Nothing is expanded in d: the second order is in it, and edges move. The columns lie at fixed Dopplers, so a platform that changes
//! its speed uses other columns, not other templates.
//!
//! In: spectra, span of d, tolerance. Out: weights of an echo, templates per column and bin, the error of the fit as measured.

use num_complex::Complex64;

use super::kernel::Kernel;
use super::least_squares::Matrix;
use super::moments::MAX_TAPS;
use super::pulse_spectrum::PulseSpectrum;

/// Dopplers at which a cell of the grid is fitted.
const SAMPLES_PER_CELL: usize = 6;

/// Powers of the weights' polynomials, at most.
pub const POWERS: usize = 12;

/// d = eta - 1, least and greatest.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DopplerSpan {
    pub least: f64,
    pub greatest: f64,
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
    /// `[k][i]`: of power x^k for tap i; unused taps are 0. A single column has the weight 1.
    pub weights: [[f64; MAX_TAPS]; POWERS],
    /// Of the kernel.
    pub error: f64,
}

impl DopplerGrid {
    /// One column for all.
    pub fn common() -> Self {
        let mut weights = [[0.0; MAX_TAPS]; POWERS];
        weights[0][0] = 1.0;
        Self {
            taps: 1,
            columns: 1,
            per_doppler: 0.0,
            offset: 0.5,
            cells: 1,
            weights,
            error: 0.0,
        }
    }

    /// `reach`: greatest |cycles of phase per unit of d| from the middle of the pulse.
    /// `powers` of x in the weights, [`POWERS`] at most.
    pub fn new(
        span: DopplerSpan,
        reach: f64,
        taps: usize,
        oversampling: f64,
        powers: usize,
    ) -> Self {
        let kernel = Kernel::new(taps, oversampling, powers);
        let per_doppler = 2.0 * oversampling * reach;
        let mut weights = [[0.0; MAX_TAPS]; POWERS];
        for (k, weights) in weights[..powers].iter_mut().enumerate() {
            for (i, weight) in weights[..taps].iter_mut().enumerate() {
                *weight = kernel.weight(k, i);
            }
        }
        let cells = ((span.greatest - span.least) * per_doppler).ceil().max(1.0) as usize;
        let middle = 0.5 * (span.least + span.greatest);
        Self {
            taps,
            columns: cells + taps - 1,
            per_doppler,
            offset: 0.5 * cells as f64 - middle * per_doppler,
            cells,
            weights,
            error: kernel.error,
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

    /// The Dopplers of the fit, and the columns' weights there.
    fn samples(&self) -> (Vec<f64>, Matrix) {
        let count = self.cells * SAMPLES_PER_CELL;
        let position = |s: usize| (s as f64 + 0.5) / SAMPLES_PER_CELL as f64;
        let dopplers = (0..count)
            .map(|s| (position(s) - self.offset) / self.per_doppler)
            .collect();
        let matrix = Matrix::from_fn(count, self.columns, |s, column| {
            let cell = s / SAMPLES_PER_CELL;
            let x = 2.0 * (position(s) - cell as f64) - 1.0;
            match column.checked_sub(cell) {
                Some(tap) if tap < self.taps => self.weight(tap, x),
                _ => 0.0,
            }
        });
        (dopplers, matrix)
    }
}

/// What each column sounds like: `templates[column * bins + bin]`, and the relative error of the fit over all bins and Dopplers.
pub struct Templates {
    pub values: Vec<Complex64>,
    pub error: f64,
}

impl Templates {
    /// `frequency_hz` and `gain` give each bin's place and H there. `common`: the Doppler of a single column.
    pub fn new(
        grid: &DopplerGrid,
        span: DopplerSpan,
        spectrum: &PulseSpectrum,
        carrier_hz: f64,
        frequency_hz: &[f64],
        gain: &[f64],
    ) -> Self {
        let at = |f_hz: f64, d: f64| spectrum.at((f_hz - carrier_hz * d) / (1.0 + d)) / (1.0 + d);
        let bins = frequency_hz.len();
        let mut values = vec![Complex64::ZERO; grid.columns * bins];
        if grid.columns == 1 && grid.per_doppler == 0.0 {
            let middle = 0.5 * (span.least + span.greatest);
            for ((value, f_hz), gain) in values.iter_mut().zip(frequency_hz).zip(gain) {
                *value = at(*f_hz, middle) * gain;
            }
            return Self { values, error: 0.0 };
        }
        let (dopplers, weights) = grid.samples();
        let fit = weights.pseudo_inverse();
        let (mut off, mut all) = (0.0, 0.0);
        let mut wanted = vec![Complex64::ZERO; dopplers.len()];
        for bin in 0..bins {
            for (want, &d) in wanted.iter_mut().zip(&dopplers) {
                *want = at(frequency_hz[bin], d) * gain[bin];
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
                let cell = s / SAMPLES_PER_CELL;
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
