//! Rows between samples: each row of an element at a few fractions of a sample, by short filters.

use std::f64::consts::PI;

use echotank_config::spec::Former;
use echotank_core::pulse::{Pulse, PulseKind};
use echotank_core::simd::{Kind, SimdLevel};

/// Maximum length of the filters.
pub(super) const TAPS: usize = 16;
/// The filters are the shortest with this rms error at the most over the pulse's band, if any is.
const MAX_FILTER_ERROR: f64 = 3e-3;
/// Largest share of the sample rate from the middle to the edge of the band: the margin that the checked sample rate leaves.
const MAX_EDGE: f64 = 0.4;
/// Maximum number of fractions of a sample.
pub(super) const MAX_FRACTIONS: usize = 8;
/// There are the fewest rows between samples that keep the rms error of linear interpolation between them below this over the pulse's band.
const MAX_LINEAR_ERROR: f64 = 3.5e-3;

/// How rows between samples are made.
pub(super) struct Interpolation {
    pub(super) filters: Vec<[f32; TAPS]>,
    /// Length of the filters: even.
    pub(super) taps: usize,
    /// Two rows for each delay.
    pub(super) is_linear: bool,
    edge: f64,
}

impl Interpolation {
    /// For this pulse until [`Interpolation::set_pulse`].
    pub(super) fn new(former: Former, pulse: &Pulse, rate_hz: f64) -> Self {
        let mut interpolation = Self {
            filters: Vec::with_capacity(MAX_FRACTIONS),
            taps: TAPS,
            is_linear: former != Former::Phase,
            edge: 0.0,
        };
        interpolation.set_pulse(pulse, rate_hz);
        interpolation
    }

    /// Makes the filters for the band of a pulse.
    pub(super) fn set_pulse(&mut self, pulse: &Pulse, rate_hz: f64) {
        // To the second zeros of the spectrum of a CW pulse; beyond the sweep of another by the width of its edges.
        let edge_hz = match pulse.kind {
            PulseKind::Cw => 2.0 / pulse.duration_s,
            _ => 0.5 * pulse.bandwidth_hz + 1.0 / pulse.duration_s,
        };
        let edge = (edge_hz / rate_hz).min(MAX_EDGE);
        let fractions = match self.is_linear {
            true => fractions(band_hz(pulse) / rate_hz),
            false => 1,
        };
        if edge == self.edge && fractions == self.filters.len() {
            return;
        }
        self.edge = edge;
        self.filters.resize(fractions, [0.0; TAPS]);
        for taps in (4..=TAPS).step_by(2) {
            let mut worst = 0.0_f64;
            for (q, filter) in self.filters.iter_mut().enumerate() {
                let at = q as f64 / fractions as f64 - 0.5;
                let (w, error) = least_squares::<TAPS>(taps, edge, at);
                *filter = w.map(|w| w as f32);
                worst = worst.max(error);
            }
            self.taps = taps;
            if worst <= MAX_FILTER_ERROR {
                break;
            }
        }
    }

    /// Number of rows for each sample.
    pub(super) fn fractions(&self) -> usize {
        self.filters.len()
    }
}

/// Number of rows for each sample for a bandwidth as a share of the sample rate.
fn fractions(band: f64) -> usize {
    // At most (w step)^2 / 8 at the frequency w; 0.73 times that at random positions, and 1/sqrt(5) times over all w of the band.
    let error = |n: usize| (PI * band / n as f64).powi(2) / 8.0 * 0.73 / 5f64.sqrt();
    let mut n = 1;
    while n < MAX_FRACTIONS && error(n) > MAX_LINEAR_ERROR {
        n *= 2;
    }
    n
}

/// Bandwidth of the pulse's compressed echo.
pub(super) fn band_hz(pulse: &Pulse) -> f64 {
    match pulse.kind {
        PulseKind::Cw => 1.0 / pulse.duration_s,
        _ => pulse.bandwidth_hz + 1.0 / pulse.duration_s,
    }
}

/// Coefficients of `taps` samples that interpolate functions with frequencies up to `edge` cycles per sample, and their rms error over that
/// band. The position `at` counts from the middle of the samples.
pub(super) fn least_squares<const N: usize>(taps: usize, edge: f64, at: f64) -> ([f64; N], f64) {
    // Mean of exp(j 2pi f x) over the band.
    let mean = |x: f64| match 2.0 * PI * edge * x {
        0.0 => 1.0,
        a => a.sin() / a,
    };
    let place = |t: usize| t as f64 - 0.5 * (taps - 1) as f64;
    let inside = |t: usize| t < taps;
    let products = std::array::from_fn(|s| {
        std::array::from_fn(|t| match inside(s) && inside(t) {
            true => mean(place(s) - place(t)),
            false => f64::from(u8::from(s == t)),
        })
    });
    let wanted: [f64; N] = std::array::from_fn(|t| match inside(t) {
        true => mean(at - place(t)),
        false => 0.0,
    });
    let w = solve(products, wanted);
    let met: f64 = w.iter().zip(wanted).map(|(w, wanted)| w * wanted).sum();
    (w, (1.0 - met).max(0.0).sqrt())
}

/// Solves a linear system by elimination with row pivots.
pub(super) fn solve<const N: usize>(mut a: [[f64; N]; N], mut b: [f64; N]) -> [f64; N] {
    for i in 0..N {
        let pivot = (i..N)
            .max_by(|&p, &q| a[p][i].abs().total_cmp(&a[q][i].abs()))
            .unwrap_or(i);
        a.swap(i, pivot);
        b.swap(i, pivot);
        for row in i + 1..N {
            let (pivot, factor) = (a[i], a[row][i] / a[i][i]);
            for (to, from) in a[row].iter_mut().zip(pivot) {
                *to -= factor * from;
            }
            b[row] -= factor * b[i];
        }
    }
    for i in (0..N).rev() {
        let known: f64 = (i + 1..N).map(|k| a[i][k] * b[k]).sum();
        b[i] = (b[i] - known) / a[i][i];
    }
    b
}

/// Computes one row per fraction q: `to[2 q row + k] = sum_i filters[q][i] from[k + i]` for k below `used`, a multiple of [`LANES`].
pub(super) fn convolve(
    simd_level: SimdLevel,
    interpolation: &Interpolation,
    from: &[f32],
    (row, used): (usize, usize),
    to: &mut [f32],
) {
    let filters = &interpolation.filters;
    assert!(used <= row && used.is_multiple_of(LANES));
    assert!(to.len() >= 2 * (filters.len() - 1) * row + used);
    assert!(from.len() + 1 >= used + interpolation.taps);
    match (simd_level.kind(), interpolation.taps) {
        #[cfg(target_arch = "x86_64")]
        // SAFETY: a `SimdLevel` proves that the processor has the features; the lengths are checked above.
        (Kind::Avx512, taps) => unsafe {
            match taps {
                4 => convolve_avx512::<4>(filters, from, row, used, to),
                6 => convolve_avx512::<6>(filters, from, row, used, to),
                8 => convolve_avx512::<8>(filters, from, row, used, to),
                10 => convolve_avx512::<10>(filters, from, row, used, to),
                12 => convolve_avx512::<12>(filters, from, row, used, to),
                14 => convolve_avx512::<14>(filters, from, row, used, to),
                _ => convolve_avx512::<TAPS>(filters, from, row, used, to),
            }
        },
        (_, taps) => simd_level.run(
            #[inline(always)]
            || convolve_plain(filters, taps, from, (row, used), to),
        ),
    }
}

/// Samples per step.
const LANES: usize = 16;

/// Processes sixteen samples of all fractions at once; the inputs stay in registers.
///
/// # Safety
/// The processor has AVX-512F. `from` holds `used` + N - 1 samples, `used` is a multiple of [`LANES`], and `to` holds every fraction's row.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512vl")]
unsafe fn convolve_avx512<const N: usize>(
    filters: &[[f32; TAPS]],
    from: &[f32],
    row: usize,
    used: usize,
    to: &mut [f32],
) {
    use std::arch::x86_64::*;
    for first in (0..used).step_by(LANES) {
        let mut x = [_mm512_setzero_ps(); N];
        for (i, x) in x.iter_mut().enumerate() {
            // SAFETY: first + LANES + N - 1 samples lie in `from`.
            *x = unsafe { _mm512_loadu_ps(from.as_ptr().add(first + i)) };
        }
        for (q, filter) in filters.iter().enumerate() {
            // Two accumulator chains, so that neither waits for the other's last product.
            let (mut even, mut odd) = (_mm512_setzero_ps(), _mm512_setzero_ps());
            for i in (0..N).step_by(2) {
                even = _mm512_fmadd_ps(_mm512_set1_ps(filter[i]), x[i], even);
                odd = _mm512_fmadd_ps(_mm512_set1_ps(filter[i + 1]), x[i + 1], odd);
            }
            // SAFETY: the fraction's row lies in `to`.
            unsafe {
                _mm512_storeu_ps(
                    to.as_mut_ptr().add(2 * q * row + first),
                    _mm512_add_ps(even, odd),
                );
            }
        }
    }
}

#[inline(always)]
fn convolve_plain(
    filters: &[[f32; TAPS]],
    taps: usize,
    from: &[f32],
    (row, used): (usize, usize),
    to: &mut [f32],
) {
    for (q, filter) in filters.iter().enumerate() {
        for first in (0..used).step_by(LANES) {
            let from = &from[first..first + LANES + taps - 1];
            let mut sum = [0.0f32; LANES];
            for (i, w) in filter[..taps].iter().enumerate() {
                let from: &[f32; LANES] = from[i..i + LANES].try_into().expect("as long");
                for k in 0..LANES {
                    sum[k] += w * from[k];
                }
            }
            to[2 * q * row + first..][..LANES].copy_from_slice(&sum);
        }
    }
}
