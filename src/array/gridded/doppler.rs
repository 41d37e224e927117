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
//! An echo whose stretch changes (d at its middle, q the change: emission time d s + q s^2 about it) sounds, with p = q/eta^3 and
//! alpha = 2pi (f + f_c), as the integral of a(w) exp(j 2pi w (f_c d - f)/eta) exp(j alpha p w^2 - 2j alpha p^2 eta w^3) (1/eta - 2 p w + 6 p^2 eta w^2).
//! alpha p w^2 is small (7e-3 rad at 5 m/s, 36 m, 400 kHz and 5 ms), so the series in p ends soon. Its k-th term is an echo of its own, of
//! amplitude (p/p_max)^k, with a grid and templates that need be no finer than the term is large ([`Received::order`]).
//!
//! In: spectra, span of d, tolerance. Out: weights of an echo, templates per column and bin, the error of the fit as measured.

use num_complex::Complex64;

use crate::array::phasor::cis;
use crate::flow::Pulse;

use super::dialect::{Dialect, Kind};
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

/// The received spectrum R_d(f) of one echo, seen from its middle and [`Coupling::shift_s`]; or the term of `order` in what its curvature
/// adds, for the greatest p.
#[derive(Clone, Copy)]
pub struct Received<'a> {
    pub spectrum: &'a PulseSpectrum,
    pub carrier_hz: f64,
    pub coupling: Coupling,
    pub duration_s: f64,
    pub order: usize,
    /// p, per second.
    pub greatest_p: f64,
}

/// Terms of the series in p, at most.
pub const MAX_ORDER: usize = 5;

impl Received<'_> {
    /// Without the receiver's gain.
    #[inline(always)]
    pub fn at(&self, f_hz: f64, d: f64) -> Complex64 {
        let doppler_hz = self.carrier_hz * d;
        let g_hz = (f_hz - doppler_hz) / (1.0 + d);
        let sound = match self.order {
            0 => self.spectrum.at(g_hz) / (1.0 + d),
            _ => self.term(f_hz, g_hz, 1.0 + d),
        };
        if self.coupling == Coupling::NONE {
            return sound;
        }
        let turns = (f_hz - 0.5 * doppler_hz) * self.coupling.shift_s(d);
        let (cos, sin) = cis(turns);
        sound * Complex64::new(cos, sin)
    }

    #[inline(always)]
    fn term(&self, f_hz: f64, g_hz: f64, eta: f64) -> Complex64 {
        let mut powers = [Complex64::ZERO; 2 * MAX_ORDER + 1];
        let k = self.order;
        self.spectrum.powers_at(g_hz, &mut powers[..=2 * k]);
        let (p, half_s) = (self.greatest_p, 0.5 * self.duration_s);
        let alpha = std::f64::consts::TAU * (f_hz + self.carrier_hz);
        // Phase of the quadratic at the pulse's ends.
        let bend = Complex64::new(0.0, alpha * p * half_s * half_s);
        // bend^(k-1) / (k-1)!
        let before = (1..k).fold(Complex64::ONE, |term, i| term * bend / i as f64);
        let mut sum = powers[2 * k] * before * bend / (k as f64 * eta)
            - powers[2 * k - 1] * before * (2.0 * p * half_s);
        if k == 2 {
            sum += powers[2] * (6.0 * eta * (p * half_s).powi(2))
                - powers[3] * bend * (2.0 * p * half_s);
        }
        sum
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

    /// Columns that echoes go to whose Dopplers take up this share of the span.
    pub fn columns_of(&self, share: f64) -> usize {
        let cells = (share * self.cells as f64).ceil() as usize + 1;
        cells.min(self.cells) + self.taps - 1
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

    /// The columns' weights at Dopplers that lie at `shares` of the span.
    fn weights_at(&self, shares: &[f64]) -> Matrix {
        Matrix::from_fn(shares.len(), self.columns, |s, column| {
            let position = shares[s] * self.cells as f64;
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

/// Where `count` Dopplers evenly over a span lie, half a step from its ends.
fn even_shares(count: usize) -> Vec<f64> {
    (0..count)
        .map(|s| (s as f64 + 0.5) / count as f64)
        .collect()
}

/// The Dopplers there.
fn dopplers(span: DopplerSpan, shares: &[f64]) -> Vec<f64> {
    shares
        .iter()
        .map(|share| span.least + share * (span.greatest - span.least))
        .collect()
}

/// What a fit is tried on: R_d(f) H(f) at some frequencies and Dopplers.
pub struct Trial {
    count: usize,
    /// `[frequency][doppler]`
    wanted: Vec<Vec<Complex64>>,
    /// Mean over the Dopplers of the sum over frequencies of |R_d H|^2.
    pub power: f64,
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
        let dopplers = dopplers(span, &even_shares(count));
        let wanted: Vec<Vec<Complex64>> = frequency_hz
            .iter()
            .zip(gain)
            .map(|(&f_hz, gain)| {
                dopplers
                    .iter()
                    .map(|&d| received.at(f_hz, d) * gain)
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

    /// Error of the echo that `grid` serves worst, over the root of `power`.
    pub fn worst(&self, grid: &DopplerGrid, power: f64) -> f64 {
        // As many of the Dopplers as this grid needs.
        let least = (SAMPLES_PER_CELL * grid.cells).max(3 * grid.columns);
        let step = (self.count / least).max(1);
        let used: Vec<usize> = (step / 2..self.count).step_by(step).collect();
        let shares: Vec<f64> = used
            .iter()
            .map(|&s| (s as f64 + 0.5) / self.count as f64)
            .collect();
        let weights = grid.weights_at(&shares);
        let fit = weights.pseudo_inverse();
        let mut off = vec![0.0; used.len()];
        let mut columns = vec![Complex64::ZERO; grid.columns];
        let mut wanted = vec![Complex64::ZERO; used.len()];
        for all in &self.wanted {
            for (want, &s) in wanted.iter_mut().zip(&used) {
                *want = all[s];
            }
            for (column, value) in columns.iter_mut().enumerate() {
                let pairs = fit.row(column).iter().zip(&wanted);
                *value = pairs.fold(Complex64::ZERO, |sum, (p, s)| sum + s * p);
            }
            for (s, (off, want)) in off.iter_mut().zip(&wanted).enumerate() {
                let cell = (shares[s] * grid.cells as f64) as usize;
                let got: Complex64 = (cell..cell + grid.taps)
                    .map(|column| columns[column] * weights.at(s, column))
                    .sum();
                *off += (got - want).norm_sqr();
            }
        }
        (off.iter().copied().fold(0.0, f64::max) / power).sqrt()
    }
}

/// Bins whose templates are worked out together.
const BINS: usize = 64;

/// Of a block of bins, how many apart those lie on which the fit's error is measured.
const MEASURED: usize = 8;

/// What each column sounds like: `templates[column * bins + bin]`.
pub struct Templates {
    pub values: Vec<Complex64>,
    /// Mean over the Dopplers of what the fit leaves, and of what was to be fitted: sums of squares over every eighth bin.
    pub off: f64,
    pub power: f64,
}

/// A fit to be made for many bins.
struct Fitting<'a> {
    grid: &'a DopplerGrid,
    received: Received<'a>,
    shares: Vec<f64>,
    dopplers: Vec<f64>,
    weights: Matrix,
    fit: Matrix,
}

/// Numbers of the bins of a block.
type Lane = [f64; BINS];

impl Templates {
    /// `frequency_hz` and `gain` give each bin's place and H there.
    pub fn new(grid: &DopplerGrid, received: Received, frequency_hz: &[f64], gain: &[f64]) -> Self {
        let bins = frequency_hz.len();
        let count = grid.sample_count(received.carrier_hz, received.duration_s);
        let shares = even_shares(count);
        let weights = grid.weights_at(&shares);
        let fitting = Fitting {
            dopplers: dopplers(grid.span, &shares),
            fit: weights.pseudo_inverse(),
            grid,
            received,
            shares,
            weights,
        };
        let mut templates = Self {
            values: vec![Complex64::ZERO; grid.columns * bins],
            off: 0.0,
            power: 0.0,
        };
        let mut wanted = vec![([0.0; BINS], [0.0; BINS]); count];
        for first in (0..bins).step_by(BINS) {
            let end = bins.min(first + BINS);
            if gain[first..end].iter().all(|&g| g == 0.0) {
                continue;
            }
            fitting.block(
                (first, bins),
                &frequency_hz[first..end],
                &gain[first..end],
                &mut wanted,
                &mut templates,
            );
        }
        templates.off /= count as f64;
        templates.power /= count as f64;
        templates
    }
}

impl Fitting<'_> {
    /// The bins from the first of `at` on; its second is how many there are in all. `wanted` is scratch, one for each Doppler.
    fn block(
        &self,
        at: (usize, usize),
        frequency_hz: &[f64],
        gain: &[f64],
        wanted: &mut [(Lane, Lane)],
        out: &mut Templates,
    ) {
        match Dialect::best().kind() {
            // SAFETY (twice): a `Dialect` of this kind exists only where the processor has the features.
            #[cfg(target_arch = "x86_64")]
            Kind::Avx512 => unsafe { self.block_avx512(at, frequency_hz, gain, wanted, out) },
            #[cfg(target_arch = "x86_64")]
            Kind::Avx2 => unsafe { self.block_avx2(at, frequency_hz, gain, wanted, out) },
            _ => self.block_plain(at, frequency_hz, gain, wanted, out),
        }
    }

    /// The AVX-512 and AVX2 builds of [`Self::block_plain`]: the same arithmetic, so the same bits.
    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx512f,avx512dq,avx512vl")]
    fn block_avx512(
        &self,
        at: (usize, usize),
        frequency_hz: &[f64],
        gain: &[f64],
        wanted: &mut [(Lane, Lane)],
        out: &mut Templates,
    ) {
        self.block_plain(at, frequency_hz, gain, wanted, out);
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2")]
    fn block_avx2(
        &self,
        at: (usize, usize),
        frequency_hz: &[f64],
        gain: &[f64],
        wanted: &mut [(Lane, Lane)],
        out: &mut Templates,
    ) {
        self.block_plain(at, frequency_hz, gain, wanted, out);
    }

    #[inline(always)]
    fn block_plain(
        &self,
        at: (usize, usize),
        frequency_hz: &[f64],
        gain: &[f64],
        wanted: &mut [(Lane, Lane)],
        out: &mut Templates,
    ) {
        let (first, bins) = at;
        for (want, &d) in wanted.iter_mut().zip(&self.dopplers) {
            for (b, (&f_hz, gain)) in frequency_hz.iter().zip(gain).enumerate() {
                let value = self.received.at(f_hz, d) * gain;
                (want.0[b], want.1[b]) = (value.re, value.im);
            }
        }
        for column in 0..self.grid.columns {
            let (mut re, mut im) = ([0.0; BINS], [0.0; BINS]);
            for (p, want) in self.fit.row(column).iter().zip(&*wanted) {
                for b in 0..BINS {
                    re[b] += p * want.0[b];
                    im[b] += p * want.1[b];
                }
            }
            let values = &mut out.values[column * bins + first..][..frequency_hz.len()];
            for (value, (re, im)) in values.iter_mut().zip(re.iter().zip(&im)) {
                *value = Complex64::new(*re, *im);
            }
        }
        for b in (0..frequency_hz.len()).step_by(MEASURED) {
            for (s, want) in wanted.iter().enumerate() {
                let want = Complex64::new(want.0[b], want.1[b]);
                let cell = (self.shares[s] * self.grid.cells as f64) as usize;
                let got = (cell..cell + self.grid.taps).fold(Complex64::ZERO, |sum, column| {
                    sum + out.values[column * bins + first + b] * self.weights.at(s, column)
                });
                out.off += (got - want).norm_sqr();
                out.power += want.norm_sqr();
            }
        }
    }
}
