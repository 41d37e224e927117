//! Doppler on a fixed grid: each echo is interpolated between the templates of a few Doppler
//! columns.
//!
//! An echo stretched by eta = 1 + d is a(eta (t - u)) exp(j 2pi f_c d (t - u)). Relative to its
//! middle at `u + T/(2 eta)`, its spectrum is
//!
//! ```text
//! S_d(f) = S((f - f_c d)/(1 + d)) / (1 + d) H(f)
//! ```
//!
//! with S the spectrum of the pulse and H that of the receiver. With w the time into the pulse, S_d
//! is an integral over -T/2..T/2 of waves exp(j 2pi w (f_c d - f)/(1 + d)). It can therefore be
//! spread over d as a point is spread over time.
//!
//! Each echo is added with `taps` weights to as many columns of a grid of Dopplers. Column j has the template
//! G_j for which sum_j weight_j(d) G_j(f) is the best least-squares fit to S_d(f). There is no expansion in d,
//! so second-order terms and the shift of the pulse's ends are included. The columns have fixed Dopplers: a
//! change of platform speed selects other columns and keeps the templates.
//!
//! The fit of each column is one real combination of received pulses, with the same factors at every
//! frequency. A column is therefore as short as these pulses. At instant w of the pulse, the fit error is the
//! signal of that instant times the error of the weights for a wave at the rate of w ([`Trial`]). Windows that
//! hold only the end of an echo therefore keep the accuracy. (Range-Doppler coupling would allow a sweep to be
//! shifted in delay instead. It would save a third of the columns but misplace the ends of pulses.)
//!
//! Changing stretch: let d be the stretch at the middle and q its rate, with emission time d s + q s^2 about
//! the middle. With p = q/eta^3 and alpha = 2pi (f + f_c), the spectrum is the integral of
//!
//! ```text
//! a(w) exp(j 2pi w (f_c d - f)/eta) exp(j alpha p w^2 - 2j alpha p^2 eta w^3) (1/eta - 2 p w + 6 p^2 eta w^2)
//! ```
//!
//! alpha p w^2 is small (7e-3 rad at 5 m/s, 36 m, 400 kHz and 5 ms), so few terms of the series in
//! p suffice. There are two ways to add them.
//!
//! The first way is by the weights ([`DopplerGrid::curvature_weights`]). d^2/dd^2 of the integrand is -(alpha w/eta^2)^2
//! times the integrand. The columns that fit S_d therefore also fit j alpha p w^2 S_d, with -j p eta^4/alpha
//! times the second derivative of the weights. The weights do not depend on f in alpha. A sweep of K Hz/s has
//! f near K w, and each factor w is one more derivative. At the ends of a pulse all frequencies occur, and the
//! weights are wrong by 2 pi p (T/2)^2 (f - K w). This equals a delay of p (T/2)^2 and a Doppler of K p
//! (T/2)^2/f_c, which are applied to the echo.
//!
//! The second way is by separate columns, for smaller tolerances. The k-th term is an echo of amplitude
//! (p/p_max)^k. Its grid and templates need an accuracy relative to the size of the term only
//! ([`Received::order`]).
//!
//! The inputs are spectra, span of d and tolerance. The results are the weights of an echo, templates per
//! column and bin, and the measured error of the fit.

use num_complex::Complex64;

use super::batched_fft::lanes_for;
use super::kernel::Kernel;
use super::least_squares::Matrix;
use super::moments::MAX_TAPS;
use super::pulse_spectrum::PulseSpectrum;
use super::shared_out;
use echotank_core::simd::{Kind, SimdLevel};

/// Minimum number of fitted Dopplers per cell of the grid.
const SAMPLES_PER_CELL: usize = 6;
/// Minimum number of fitted Dopplers per cycle of the phase at the pulse's ends over the span.
const SAMPLES_PER_CYCLE: f64 = 4.0;

/// Maximum number of powers in the polynomials of the weights.
pub(crate) const POWERS: usize = 12;

/// Range of the relative stretch d = eta - 1.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DopplerSpan {
    /// Smallest d.
    pub least: f64,
    /// Largest d.
    pub greatest: f64,
}

/// Received spectrum S_d(f) of one echo about its middle, or the curvature term of `order` for the
/// largest p.
#[derive(Clone, Copy)]
pub struct Received<'a> {
    /// Spectrum of the transmitted pulse.
    pub spectrum: &'a PulseSpectrum,
    /// Carrier frequency, Hz.
    pub carrier_hz: f64,
    /// Length of the pulse, seconds.
    pub duration_s: f64,
    /// Order of the curvature term; 0 is the echo itself.
    pub order: usize,
    /// Largest p, per second.
    pub(crate) greatest_p: f64,
}

/// Maximum number of terms of the series in p.
pub(crate) const MAX_ORDER: usize = 5;

impl Received<'_> {
    /// Spectrum at `f_hz` from the carrier for stretch `d`, without the gain of the receiver.
    #[inline(always)]
    pub fn at(&self, f_hz: f64, d: f64) -> Complex64 {
        let doppler_hz = self.carrier_hz * d;
        let g_hz = (f_hz - doppler_hz) / (1.0 + d);
        match self.order {
            0 => self.spectrum.at(g_hz) / (1.0 + d),
            _ => self.term(f_hz, g_hz, 1.0 + d),
        }
    }

    #[inline(always)]
    fn term(&self, f_hz: f64, g_hz: f64, eta: f64) -> Complex64 {
        let mut powers = [Complex64::ZERO; 2 * MAX_ORDER + 1];
        let k = self.order;
        self.spectrum.powers_at(g_hz, &mut powers[..=2 * k]);
        let (p, half_s) = (self.greatest_p, 0.5 * self.duration_s);
        let alpha = std::f64::consts::TAU * (f_hz + self.carrier_hz);
        // Phase of the quadratic term at the ends of the pulse.
        let curvature = Complex64::new(0.0, alpha * p * half_s * half_s);
        // curvature^(k-1) / (k-1)!
        let before = (1..k).fold(Complex64::ONE, |term, i| term * curvature / i as f64);
        let mut sum = powers[2 * k] * before * curvature / (k as f64 * eta)
            - powers[2 * k - 1] * before * (2.0 * p * half_s);
        if k == 2 {
            sum += powers[2] * (6.0 * eta * (p * half_s).powi(2))
                - powers[3] * curvature * (2.0 * p * half_s);
        }
        sum
    }
}

/// Coefficients of the weights: `[k][i]` is power x^k of tap i.
pub(crate) type Polynomials = [[f64; MAX_TAPS]; POWERS];

pub(crate) fn value_of(polynomials: &Polynomials, tap: usize, x: f64) -> f64 {
    polynomials
        .iter()
        .rev()
        .fold(0.0, |sum, powers| sum * x + powers[tap])
}

/// The derivative of order `order` in x.
pub fn derivative(polynomials: &Polynomials, order: usize) -> Polynomials {
    let mut out = [[0.0; MAX_TAPS]; POWERS];
    for k in order..POWERS {
        let falling: f64 = (k + 1 - order..=k).map(|i| i as f64).product();
        for (out, power) in out[k - order].iter_mut().zip(&polynomials[k]) {
            *out = falling * power;
        }
    }
    out
}

fn times(factor: f64, polynomials: Polynomials) -> Polynomials {
    polynomials.map(|row| row.map(|power| factor * power))
}

/// Derivative combinations of the weights; see [`DopplerGrid::curvature_weights`].
pub(crate) struct CurvatureWeights {
    pub imaginary: Polynomials,
    pub real: Polynomials,
    pub(crate) real_2: Polynomials,
}

/// Grid of Doppler columns with interpolation weights.
#[derive(Clone, Debug)]
pub struct DopplerGrid {
    /// Number of columns to which each echo is added.
    pub taps: usize,
    /// Number of columns of the grid.
    pub columns: usize,
    /// Conversion of d to cells: `d * per_doppler + offset`.
    pub(crate) per_doppler: f64,
    /// Offset of that conversion, cells.
    pub offset: f64,
    /// Number of cells of the grid. There are `taps - 1` more columns than cells.
    pub cells: usize,
    span: DopplerSpan,
    /// Polynomials of the weights across a cell. Unused taps are 0, and a single column has weight
    /// 1.
    pub weights: Polynomials,
}

impl DopplerGrid {
    /// A grid of one column for all Dopplers of `span`.
    pub fn common(span: DopplerSpan) -> Self {
        let mut weights = [[0.0; MAX_TAPS]; POWERS];
        weights[0][0] = 1.0;
        Self::with_weights(span, 1, 1, weights)
    }

    /// A grid of `cells` cells over `span`. The width of `kernel` is the number of taps, and its
    /// moments are the powers of x in their weights, at most [`POWERS`].
    pub fn new(span: DopplerSpan, cells: usize, kernel: &Kernel) -> Self {
        let mut weights = [[0.0; MAX_TAPS]; POWERS];
        for (k, weights) in weights[..kernel.moments].iter_mut().enumerate() {
            for (i, weight) in weights[..kernel.width].iter_mut().enumerate() {
                *weight = kernel.weight(k, i);
            }
        }
        Self::with_weights(span, cells, kernel.width, weights)
    }

    fn with_weights(span: DopplerSpan, cells: usize, taps: usize, weights: Polynomials) -> Self {
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
        }
    }

    /// The same weights on a grid with another number of cells.
    fn with_cells(&self, cells: usize) -> Self {
        let mut other = self.clone();
        other.cells = cells;
        other.columns = cells + self.taps - 1;
        other
    }

    /// The `cells` cells from `first` on as a separate grid.
    pub fn part(&self, first: usize, cells: usize) -> Self {
        let at = |cell: usize| self.span.least + cell as f64 / self.per_doppler;
        let span = DopplerSpan {
            least: at(first),
            greatest: at(first + cells),
        };
        Self::with_weights(span, cells, self.taps, self.weights)
    }

    /// Largest |d| of the span.
    pub fn fastest(&self) -> f64 {
        self.span.least.abs().max(self.span.greatest.abs())
    }

    /// Number of columns for echoes whose Dopplers cover this fraction of the span.
    pub(crate) fn columns_of(&self, share: f64) -> usize {
        let cells = (share * self.cells as f64).ceil() as usize + 1;
        cells.min(self.cells) + self.taps - 1
    }

    /// Number of lanes for echoes whose Dopplers cover this fraction of the span, averaged over its position.
    pub(crate) fn typical_lanes(&self, share: f64) -> f64 {
        let touched = share * self.cells as f64;
        let lanes_of = |cells: usize| lanes_for(cells.min(self.cells) + self.taps - 1) as f64;
        let least = touched as usize + 1;
        lanes_of(least) + touched.fract() * (lanes_of(least + 1) - lanes_of(least))
    }

    /// Index of the first column of an echo, and its position across the cell. Dopplers outside the
    /// span are clamped.
    #[inline(always)]
    pub fn place(&self, doppler: f64) -> (usize, f64) {
        let position = (doppler * self.per_doppler + self.offset).clamp(0.0, self.cells as f64);
        let cell = (position as usize).min(self.cells - 1);
        (cell, 2.0 * (position - cell as f64) - 1.0)
    }

    /// Cell, and position across the cell, at `share` of the span.
    fn cell_of(&self, share: f64) -> (usize, f64) {
        let position = share * self.cells as f64;
        let cell = (position as usize).min(self.cells - 1);
        (cell, 2.0 * (position - cell as f64) - 1.0)
    }

    /// Doppler at `share` of the span, the first column of such an echo, and its weights.
    pub fn at(&self, share: f64) -> (f64, usize, [f64; MAX_TAPS]) {
        let (cell, x) = self.cell_of(share);
        let DopplerSpan { least, greatest } = self.span;
        (
            least + share * (greatest - least),
            cell,
            std::array::from_fn(|tap| value_of(&self.weights, tap, x)),
        )
    }

    /// Weights of the columns at Dopplers at `shares` of the span.
    fn weights_at(&self, shares: &[f64]) -> Matrix {
        self.matrix(shares, &self.weights)
    }

    /// As [`Self::weights_at`], for weights with the coefficients `polynomials`.
    fn matrix(&self, shares: &[f64], polynomials: &Polynomials) -> Matrix {
        Matrix::from_fn(shares.len(), self.columns, |s, column| {
            let (cell, x) = self.cell_of(shares[s]);
            match column.checked_sub(cell) {
                Some(tap) if tap < self.taps => value_of(polynomials, tap, x),
                _ => 0.0,
            }
        })
    }

    /// Weights for echoes with the curvature factor exp(j b (2w/T)^2). They are the weights of S_d plus b
    /// `real` + b^2 `real_2` + j b `imaginary`, in powers of x.
    ///
    /// `theta` is the phase change of a pulse's end over half a cell. `sweep` is half the swept band over the
    /// carrier, with its sign.
    pub(crate) fn curvature_weights(&self, theta: f64, sweep: f64) -> CurvatureWeights {
        CurvatureWeights {
            imaginary: times(-theta.powi(-2), derivative(&self.weights, 2)),
            real: times(sweep * theta.powi(-3), derivative(&self.weights, 3)),
            real_2: times(-0.5 * theta.powi(-4), derivative(&self.weights, 4)),
        }
    }

    /// Approximate phase change of a pulse's end over half a cell, radians.
    pub fn theta(&self, carrier_hz: f64, duration_s: f64) -> f64 {
        match self.per_doppler > 0.0 {
            true => 0.5 * std::f64::consts::PI * carrier_hz * duration_s / self.per_doppler,
            false => 0.0,
        }
    }

    /// Number of Dopplers in the fit of a pulse. It exceeds the number of columns, which can exceed the
    /// samples per cell for a single wide cell.
    fn sample_count(&self, carrier_hz: f64, duration_s: f64) -> usize {
        let cycles = (self.span.greatest - self.span.least) * carrier_hz * duration_s;
        (SAMPLES_PER_CELL * self.cells)
            .max((SAMPLES_PER_CYCLE * cycles).ceil() as usize)
            .max(2 * self.columns)
    }
}

/// `count` positions over a span, both ends included. They are densest at the ends, where the fit error is
/// largest.
fn fitted_shares(count: usize) -> Vec<f64> {
    let step_rad = std::f64::consts::PI / (count - 1) as f64;
    (0..count)
        .map(|s| 0.5 - 0.5 * libm::cos(s as f64 * step_rad))
        .collect()
}

/// `count` uniform positions, both ends included, at which the fit is checked.
fn even_shares(count: usize) -> Vec<f64> {
    (0..count).map(|s| s as f64 / (count - 1) as f64).collect()
}

/// Dopplers at the given fractions of the span.
fn dopplers(span: DopplerSpan, shares: &[f64]) -> Vec<f64> {
    shares
        .iter()
        .map(|share| span.least + share * (span.greatest - span.least))
        .collect()
}

/// Test of a grid. Waves over the span of Dopplers have the rates of instants of the pulse, from its middle to
/// its end.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Trial {
    /// Phase change of the pulse's end relative to its middle over the whole span, in turns.
    pub turns: f64,
    /// Maximum curvature phase at the ends of the pulse, if the weights carry the curvature.
    pub(crate) curvature_rad: f64,
    /// Half the swept band over the carrier, with its sign.
    pub sweep: f64,
}

/// Tested instants of the pulse as fractions of half its length. They are denser at the end, where the fit
/// error is largest.
const INSTANTS: [f64; 8] = [0.0, 0.3, 0.55, 0.75, 0.85, 0.92, 0.97, 1.0];

/// Maximum number of cells of a test. A finer grid has the error of its first cells.
const MAX_TRIAL_CELLS: usize = 20;

impl Trial {
    /// Largest relative error of `grid` over all instants and Dopplers.
    pub(crate) fn worst(&self, grid: &DopplerGrid) -> f64 {
        if grid.cells > MAX_TRIAL_CELLS {
            let fewer = Self {
                turns: self.turns * MAX_TRIAL_CELLS as f64 / grid.cells as f64,
                ..*self
            };
            return fewer.worst(&grid.with_cells(MAX_TRIAL_CELLS));
        }
        // The fit has this number of Dopplers; the check has twice as many.
        let count = (SAMPLES_PER_CELL * grid.cells).max(3 * grid.columns);
        let fitted = fitted_shares(count);
        let fit = grid.weights_at(&fitted).pseudo_inverse();
        let shares = even_shares(2 * count);
        let weights = grid.weights_at(&shares);
        let theta = std::f64::consts::PI * self.turns / grid.cells as f64;
        let curvature = (self.curvature_rad > 0.0 && theta > 0.0)
            .then(|| grid.curvature_weights(theta, self.sweep));
        let parts: Vec<(Matrix, f64)> = match &curvature {
            None => Vec::new(),
            Some(curvature) => vec![
                (
                    grid.matrix(&shares, &curvature.imaginary),
                    self.curvature_rad,
                ),
                (grid.matrix(&shares, &curvature.real), self.curvature_rad),
                (
                    grid.matrix(&shares, &curvature.real_2),
                    self.curvature_rad.powi(2),
                ),
            ],
        };
        let mut worst: f64 = 0.0;
        for u in INSTANTS {
            let wave = |share: &f64| {
                Complex64::cis(std::f64::consts::TAU * self.turns * u * (share - 0.5))
            };
            let wanted: Vec<Complex64> = fitted.iter().map(wave).collect();
            let columns: Vec<Complex64> = (0..grid.columns)
                .map(|column| {
                    let pairs = fit.row(column).iter().zip(&wanted);
                    pairs.fold(Complex64::ZERO, |sum, (p, s)| sum + s * p)
                })
                .collect();
            for (s, share) in shares.iter().enumerate() {
                let (want, cell) = (wave(share), grid.cell_of(*share).0);
                let through = |weights: &Matrix| -> Complex64 {
                    (cell..cell + grid.taps)
                        .map(|column| columns[column] * weights.at(s, column))
                        .sum()
                };
                let mut off = (through(&weights) - want).norm();
                // Target factors of the wave: (2w/T)^2, sweep (2w/T)^3 and -(2w/T)^4/2.
                let should = [
                    Complex64::new(u.powi(2), 0.0),
                    Complex64::new(0.0, self.sweep * u.powi(3)) * -1.0,
                    Complex64::new(-0.5 * u.powi(4), 0.0),
                ];
                for ((weights, size), should) in parts.iter().zip(should) {
                    off += size * (through(weights) - want * should).norm();
                }
                worst = worst.max(off);
            }
        }
        worst
    }
}

/// Bins whose templates are computed together.
const BINS: usize = 64;

/// Number of columns and of bins whose sums stay in registers.
const COLUMNS: usize = 4;
const LANES: usize = 16;

/// Fit applied to many bins.
struct Fitting<'a> {
    received: Received<'a>,
    dopplers: Vec<f64>,
    /// For each requested column, the factors on the pulse at each Doppler.
    rows: Vec<&'a [f64]>,
}

/// Values of the bins of a block.
type Lane = [f64; BINS];

/// Templates of `columns` of the grid: `[k * bins + bin]`, with k counting the columns.
/// `frequency_hz` and `gain` give the frequency and H of each bin.
pub fn templates(
    grid: &DopplerGrid,
    received: Received,
    columns: &[usize],
    frequency_hz: &[f64],
    gain: &[f64],
) -> Vec<Complex64> {
    let bins = frequency_hz.len();
    let count = grid.sample_count(received.carrier_hz, received.duration_s);
    let shares = fitted_shares(count);
    let fit = grid.weights_at(&shares).pseudo_inverse();
    let fitting = Fitting {
        dopplers: dopplers(grid.span, &shares),
        rows: columns.iter().map(|&column| fit.row(column)).collect(),
        received,
    };
    let blocks = shared_out(bins.div_ceil(BINS), |block| {
        let of_block = block * BINS..bins.min((block + 1) * BINS);
        let (frequency_hz, gain) = (&frequency_hz[of_block.clone()], &gain[of_block]);
        let mut values = vec![Complex64::ZERO; columns.len() * gain.len()];
        if gain.iter().any(|&g| g != 0.0) {
            let mut wanted = vec![([0.0; BINS], [0.0; BINS]); count];
            fitting.block(frequency_hz, gain, &mut wanted, &mut values);
        }
        values
    });
    let mut values = Vec::with_capacity(columns.len() * bins);
    for column in 0..columns.len() {
        for block in &blocks {
            let of_column = block.len() / columns.len();
            values.extend_from_slice(&block[column * of_column..][..of_column]);
        }
    }
    values
}

impl Fitting<'_> {
    /// Computes the bins of a block: `[column][bin]`. `wanted` is a buffer with one entry per Doppler.
    fn block(
        &self,
        frequency_hz: &[f64],
        gain: &[f64],
        wanted: &mut [(Lane, Lane)],
        out: &mut [Complex64],
    ) {
        match SimdLevel::best().kind() {
            // SAFETY (both calls): a `SimdLevel` of this kind exists only on processors with the features.
            #[cfg(target_arch = "x86_64")]
            Kind::Avx512 => unsafe { self.block_avx512(frequency_hz, gain, wanted, out) },
            #[cfg(target_arch = "x86_64")]
            Kind::Avx2 => unsafe { self.block_avx2(frequency_hz, gain, wanted, out) },
            _ => self.block_plain(frequency_hz, gain, wanted, out),
        }
    }

    /// AVX-512 and AVX2 builds of [`Self::block_plain`], with the same arithmetic, so the same bits.
    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx512f,avx512dq,avx512vl")]
    fn block_avx512(
        &self,
        frequency_hz: &[f64],
        gain: &[f64],
        wanted: &mut [(Lane, Lane)],
        out: &mut [Complex64],
    ) {
        self.block_plain(frequency_hz, gain, wanted, out);
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2")]
    fn block_avx2(
        &self,
        frequency_hz: &[f64],
        gain: &[f64],
        wanted: &mut [(Lane, Lane)],
        out: &mut [Complex64],
    ) {
        self.block_plain(frequency_hz, gain, wanted, out);
    }

    #[inline(always)]
    fn block_plain(
        &self,
        frequency_hz: &[f64],
        gain: &[f64],
        wanted: &mut [(Lane, Lane)],
        out: &mut [Complex64],
    ) {
        let bins = frequency_hz.len();
        for (want, &d) in wanted.iter_mut().zip(&self.dopplers) {
            for (b, (&f_hz, gain)) in frequency_hz.iter().zip(gain).enumerate() {
                let value = self.received.at(f_hz, d) * gain;
                (want.0[b], want.1[b]) = (value.re, value.im);
            }
        }
        for (group, rows) in self.rows.chunks(COLUMNS).enumerate() {
            // Missing columns of a group repeat the last column.
            let last = rows.len() - 1;
            let of: [&[f64]; COLUMNS] = std::array::from_fn(|k| rows[k.min(last)]);
            for lane in (0..frequency_hz.len()).step_by(LANES) {
                let mut sums = [[[0.0; LANES]; 2]; COLUMNS];
                for (s, want) in wanted.iter().enumerate() {
                    let (re, im) = (&want.0[lane..lane + LANES], &want.1[lane..lane + LANES]);
                    for (sums, row) in sums.iter_mut().zip(of) {
                        let p = row[s];
                        for b in 0..LANES {
                            sums[0][b] += p * re[b];
                            sums[1][b] += p * im[b];
                        }
                    }
                }
                let heard = (frequency_hz.len() - lane).min(LANES);
                for (k, sums) in sums[..=last].iter().enumerate() {
                    let values = (group * COLUMNS + k) * bins + lane;
                    for (b, value) in out[values..values + heard].iter_mut().enumerate() {
                        *value = Complex64::new(sums[0][b], sums[1][b]);
                    }
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use echotank_core::pulse::{Pulse, PulseKind};

    /// Seven columns over a single cell need more than six fitted Dopplers.
    #[test]
    fn wide_kernels_over_few_cells_are_fitted_to_more_dopplers_than_they_have_columns() {
        let pulse = Pulse {
            kind: PulseKind::LfmUp,
            center_frequency_hz: 20e3,
            bandwidth_hz: 2e3,
            duration_s: 0.3e-3,
            taper: 0.2,
        };
        let spectrum = PulseSpectrum::new(&pulse, 4e3);
        let span = DopplerSpan {
            least: -1e-3,
            greatest: 1e-3,
        };
        let frequency_hz: Vec<f64> = (-8..8).map(|k| 200.0 * f64::from(k)).collect();
        let received = Received {
            spectrum: &spectrum,
            carrier_hz: pulse.center_frequency_hz,
            duration_s: pulse.duration_s,
            order: 0,
            greatest_p: 0.0,
        };
        for cells in 1..=3 {
            for width in 2..=MAX_TAPS {
                let grid = DopplerGrid::new(span, cells, &Kernel::new(width, 2.0, POWERS));
                let columns: Vec<usize> = (0..grid.columns).collect();
                let values = templates(&grid, received, &columns, &frequency_hz, &[1.0; 16]);
                assert_eq!(values.len(), 16 * grid.columns);
                assert!(
                    values.iter().all(|value| value.is_finite()),
                    "{cells}, {width}"
                );
            }
        }
    }
}
