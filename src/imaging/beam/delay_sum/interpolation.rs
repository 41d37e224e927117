//! Rows between samples: each row of an element at a few fractions of a sample, by short filters.

use std::f64::consts::PI;

use crate::beam::weights::Taper;
use echotank_config::spec::{Former, Shading};
use echotank_core::simd::{Kind, SimdLevel};

/// Length of the filters. They reject 50 dB from 0.4 to 0.6 of the sample rate, the margin that the checked sample rate leaves.
pub(super) const TAPS: usize = 16;
const INTERPOLATION: Shading = Shading::Kaiser { beta: 4.6 };
/// Maximum number of fractions of a sample.
pub(super) const MAX_FRACTIONS: usize = 16;
/// Largest bandwidth, as a share of the sample rate, for which the nearest of [`MAX_FRACTIONS`] rows serves: the remaining delay is at most
/// 1/32 of a sample, an rms phase of 0.4 % over that band. Wider pulses use the two nearest of half as many rows, linearly.
const MAX_NEAREST_BAND: f64 = 0.12;

/// How rows between samples are made.
pub(super) struct Interpolation {
    pub(super) filters: Vec<[f32; TAPS]>,
    /// Two rows for each delay.
    pub(super) is_linear: bool,
}

impl Interpolation {
    /// `band` is the bandwidth of the pulse as a share of the sample rate.
    pub(super) fn new(former: Former, band: f64) -> Self {
        let (fractions, is_linear) = match former {
            Former::Phase => (1, false),
            _ if band <= MAX_NEAREST_BAND => (MAX_FRACTIONS, false),
            _ => (MAX_FRACTIONS / 2, true),
        };
        Self {
            filters: interpolating_filters(fractions),
            is_linear,
        }
    }

    /// Number of rows for each sample.
    pub(super) fn fractions(&self) -> usize {
        self.filters.len()
    }
}

/// Windowed sincs for each fraction of a sample from 0, with unit response at the middle of the band.
fn interpolating_filters(fractions: usize) -> Vec<[f32; TAPS]> {
    let taper = Taper::new(INTERPOLATION);
    let filter = |q: usize| {
        let fraction = q as f64 / fractions as f64;
        let raw: [f64; TAPS] = std::array::from_fn(|i| {
            let x = i as f64 - (TAPS / 2 - 1) as f64 - fraction;
            let sinc = if x.abs() < 1e-12 {
                1.0
            } else {
                (PI * x).sin() / (PI * x)
            };
            sinc * taper.at(x / TAPS as f64)
        });
        let sum: f64 = raw.iter().sum();
        raw.map(|w| (w / sum) as f32)
    };
    (0..fractions).map(filter).collect()
}

/// Computes one row per fraction q: `to[2 q row + k] = sum_i filters[q][i] from[k + i]` for k below `used`; zero beyond.
pub(super) fn convolve(
    simd_level: SimdLevel,
    filters: &[[f32; TAPS]],
    from: &[f32],
    (row, used): (usize, usize),
    to: &mut [f32],
) {
    assert!(used <= row && to.len() >= (2 * filters.len() - 1) * row);
    // Beyond its margin a row is zero.
    let filled = used.min((from.len() + 1).saturating_sub(TAPS));
    match simd_level.kind() {
        #[cfg(target_arch = "x86_64")]
        // SAFETY: a `SimdLevel` proves that the processor has the features. `filled` samples plus the filters' length lie in `from`, and
        // every fraction's row lies in `to`.
        Kind::Avx512 => unsafe { convolve_avx512(filters, from, row, filled, to) },
        _ => simd_level.run(
            #[inline(always)]
            || convolve_plain(filters, from, row, filled, to),
        ),
    }
}

/// Processes sixteen samples of all fractions at once; the inputs stay in registers.
///
/// # Safety
/// The processor has AVX-512F. `from` holds `filled` + TAPS - 1 samples, `filled` is at most `row`, and `to` holds every fraction's row.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512vl")]
unsafe fn convolve_avx512(
    filters: &[[f32; TAPS]],
    from: &[f32],
    row: usize,
    filled: usize,
    to: &mut [f32],
) {
    use std::arch::x86_64::*;
    const LANES: usize = 16;
    let whole = filled / LANES * LANES;
    for first in (0..whole).step_by(LANES) {
        let mut x = [_mm512_setzero_ps(); TAPS];
        for (i, x) in x.iter_mut().enumerate() {
            // SAFETY: first + LANES + TAPS - 1 samples lie in `from`.
            *x = unsafe { _mm512_loadu_ps(from.as_ptr().add(first + i)) };
        }
        for (q, filter) in filters.iter().enumerate() {
            // Two accumulator chains, so that neither waits for the other's last product.
            let (mut even, mut odd) = (_mm512_setzero_ps(), _mm512_setzero_ps());
            for i in (0..TAPS).step_by(2) {
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
    finish_rows(filters, from, row, whole..filled, to);
}

#[inline(always)]
fn convolve_plain(
    filters: &[[f32; TAPS]],
    from: &[f32],
    row: usize,
    filled: usize,
    to: &mut [f32],
) {
    const LANES: usize = 32;
    let whole = filled / LANES * LANES;
    for (q, filter) in filters.iter().enumerate() {
        for first in (0..whole).step_by(LANES) {
            let from = &from[first..first + LANES + TAPS - 1];
            let mut sum = [0.0f32; LANES];
            for (i, w) in filter.iter().enumerate() {
                let from: &[f32; LANES] = from[i..i + LANES].try_into().expect("as long");
                for k in 0..LANES {
                    sum[k] += w * from[k];
                }
            }
            to[2 * q * row + first..][..LANES].copy_from_slice(&sum);
        }
    }
    finish_rows(filters, from, row, whole..filled, to);
}

/// Computes the samples that do not fill a vector, and the zeros after them.
fn finish_rows(
    filters: &[[f32; TAPS]],
    from: &[f32],
    row: usize,
    rest: std::ops::Range<usize>,
    to: &mut [f32],
) {
    for (q, filter) in filters.iter().enumerate() {
        let to = &mut to[2 * q * row..][..row];
        for k in rest.clone() {
            to[k] = filter.iter().zip(&from[k..]).map(|(w, x)| w * x).sum();
        }
        to[rest.end..].fill(0.0);
    }
}
