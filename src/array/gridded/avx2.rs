//! The loops of [`super::moments`] in AVX2 with FMA. Their twins there say what they compute.

use std::arch::x86_64::*;

use num_complex::{Complex32, Complex64};

use super::moments::{FlushWeights, Located, Row32, Row64};

/// How many points ahead the rows are fetched: far enough for the second-level cache.
const AHEAD: usize = 12;

/// SAFETY: the processor must have the features; every row of `points` (and the `taps` - 1 after it) must lie in `rows`.
#[target_feature(enable = "avx2,fma")]
pub unsafe fn accumulate_32(points: &Located<f32>, taps: usize, rows: &mut [Row32]) {
    // SAFETY: the caller vouches for the features and the rows. Rows are aligned to 64 bytes and 64 bytes long; x, amplitude and weight are
    // read below `points.len`, which their lengths bound. Prefetches may point anywhere.
    unsafe {
        let n = points.len.min(points.row.len());
        let table = rows.as_mut_ptr().cast::<f32>();
        let one = _mm256_set1_ps(1.0);
        for j in 0..n {
            let ahead = points.row[(j + AHEAD).min(n - 1)] as usize;
            let x = _mm256_set1_ps(points.x[j]);
            let x2 = _mm256_mul_ps(x, x);
            // 1, x, x^2, x^3, each twice; then times x^4.
            let p = _mm256_mul_ps(
                _mm256_blend_ps::<0b1100_1100>(one, x),
                _mm256_blend_ps::<0b1111_0000>(one, x2),
            );
            let c = points.amplitude.as_ptr().add(j).cast::<f64>();
            let c = _mm256_castpd_ps(_mm256_set1_pd(c.read_unaligned()));
            let low = _mm256_mul_ps(p, c);
            let high = _mm256_mul_ps(low, _mm256_mul_ps(x2, x2));
            for t in 0..taps {
                _mm_prefetch::<_MM_HINT_T0>(table.wrapping_add(16 * (ahead + t)).cast());
                let row = table.add(16 * (points.row[j] as usize + t));
                let weight = if taps == 1 {
                    one
                } else {
                    _mm256_set1_ps(*points.weight[j].get_unchecked(t))
                };
                _mm256_store_ps(row, _mm256_fmadd_ps(low, weight, _mm256_load_ps(row)));
                let row = row.add(8);
                _mm256_store_ps(row, _mm256_fmadd_ps(high, weight, _mm256_load_ps(row)));
            }
        }
    }
}

/// SAFETY: the processor must have the features; every row of `points` (and the `taps` - 1 after it) must lie in `rows`.
#[target_feature(enable = "avx2,fma")]
pub unsafe fn accumulate_64(points: &Located<f64>, taps: usize, rows: &mut [Row64]) {
    // SAFETY: the caller vouches for the features and the rows. Rows are aligned to 64 bytes and 192 bytes long; x, amplitude and weight are
    // read below `points.len`, which their lengths bound. Prefetches may point anywhere.
    unsafe {
        let n = points.len.min(points.row.len());
        let table = rows.as_mut_ptr().cast::<f64>();
        let one = _mm256_set1_pd(1.0);
        for j in 0..n {
            let ahead = points.row[(j + AHEAD).min(n - 1)] as usize;
            let x = _mm256_set1_pd(points.x[j]);
            let x2 = _mm256_mul_pd(x, x);
            let c = _mm256_broadcast_pd(&*points.amplitude.as_ptr().add(j).cast());
            for t in 0..taps {
                let next = table.wrapping_add(24 * (ahead + t));
                _mm_prefetch::<_MM_HINT_T0>(next.cast());
                _mm_prefetch::<_MM_HINT_T0>(next.wrapping_add(8).cast());
                _mm_prefetch::<_MM_HINT_T0>(next.wrapping_add(16).cast());
                let row = table.add(24 * (points.row[j] as usize + t));
                let c = if taps == 1 {
                    c
                } else {
                    _mm256_mul_pd(c, _mm256_set1_pd(*points.weight[j].get_unchecked(t)))
                };
                let mut moments = _mm256_mul_pd(c, _mm256_blend_pd::<0b1100>(one, x));
                for v in 0..6 {
                    let row = row.add(4 * v);
                    _mm256_store_pd(row, _mm256_add_pd(moments, _mm256_load_pd(row)));
                    moments = _mm256_mul_pd(moments, x2);
                }
            }
        }
    }
}

/// A window of grid values slides over the cells in registers: each cell adds its taps, then the first value is finished and leaves.
///
/// SAFETY: the processor must have the features; shapes as `Real::flush` checks them.
#[target_feature(enable = "avx2,fma")]
pub unsafe fn flush_32(
    rows: &[Row32],
    columns: usize,
    column: usize,
    weights: &FlushWeights<f32>,
    out: &mut [Complex32],
) {
    // SAFETY: the caller vouches for features and shapes.
    unsafe {
        match weights.width {
            0..=4 => flush_32_of::<1>(rows, columns, column, weights, out),
            5..=8 => flush_32_of::<2>(rows, columns, column, weights, out),
            9..=12 => flush_32_of::<3>(rows, columns, column, weights, out),
            _ => flush_32_of::<4>(rows, columns, column, weights, out),
        }
    }
}

/// V registers of four complex values hold the window.
#[target_feature(enable = "avx2,fma")]
unsafe fn flush_32_of<const V: usize>(
    rows: &[Row32],
    columns: usize,
    column: usize,
    weights: &FlushWeights<f32>,
    out: &mut [Complex32],
) {
    // SAFETY: cells = rows / columns - 1, so cell * columns + column is inside `rows`; `out` has a value for every cell and width - 1 more.
    // `doubled` has 8 entries of 32 weights.
    unsafe {
        let cells = rows.len() / columns - 1;
        let zero = _mm256_setzero_ps();
        let mut window = [zero; V];
        let w = weights.doubled.as_ptr().cast::<f32>();
        let out_at = out.as_mut_ptr().cast::<f64>();
        let mut row = rows.as_ptr().add(column).cast::<f64>();
        for cell in 0..cells {
            let (mut even, mut odd) = ([zero; V], [zero; V]);
            for k in 0..4 {
                let a = _mm256_castpd_ps(_mm256_set1_pd(*row.add(2 * k)));
                let b = _mm256_castpd_ps(_mm256_set1_pd(*row.add(2 * k + 1)));
                for v in 0..V {
                    let wa = _mm256_loadu_ps(w.add(64 * k + 8 * v));
                    let wb = _mm256_loadu_ps(w.add(64 * k + 32 + 8 * v));
                    even[v] = _mm256_fmadd_ps(a, wa, even[v]);
                    odd[v] = _mm256_fmadd_ps(b, wb, odd[v]);
                }
            }
            for v in 0..V {
                window[v] = _mm256_add_ps(window[v], _mm256_add_ps(even[v], odd[v]));
            }
            shift_32(&mut window, out_at.add(cell));
            row = row.add(8 * columns);
        }
        for value in cells..out.len() {
            shift_32(&mut window, out_at.add(value));
        }
    }
}

/// Writes the first complex value of the window and moves the others down by one.
///
/// SAFETY: `out` must be writable.
#[inline]
#[target_feature(enable = "avx2,fma")]
unsafe fn shift_32<const V: usize>(window: &mut [__m256; V], out: *mut f64) {
    // SAFETY: the caller vouches for `out`.
    unsafe {
        _mm_storel_pd(out, _mm_castps_pd(_mm256_castps256_ps128(window[0])));
        for v in 0..V {
            let next = if v + 1 < V {
                _mm256_castps_pd(window[v + 1])
            } else {
                _mm256_setzero_pd()
            };
            // Values 1, 2, 3 of this register and 0 of the next.
            let mixed = _mm256_blend_pd::<0b0001>(_mm256_castps_pd(window[v]), next);
            window[v] = _mm256_castpd_ps(_mm256_permute4x64_pd::<0b00_11_10_01>(mixed));
        }
    }
}

/// As [`flush_32`].
///
/// SAFETY: the processor must have the features; shapes as `Real::flush` checks them.
#[target_feature(enable = "avx2,fma")]
pub unsafe fn flush_64(
    rows: &[Row64],
    columns: usize,
    column: usize,
    weights: &FlushWeights<f64>,
    out: &mut [Complex64],
) {
    // SAFETY: cells = rows / columns - 1, so cell * columns + column is inside `rows`; `out` has a value for every cell and width - 1 more:
    // cell + i < cells + width - 1. `doubled` has 12 entries of 32 weights. Two complex values per register; taps come in groups of two,
    // the odd last one alone.
    unsafe {
        let cells = rows.len() / columns - 1;
        let width = weights.width;
        let w = weights.doubled.as_ptr().cast::<f64>();
        out.fill(Complex64::ZERO);
        let mut row = rows.as_ptr().add(column).cast::<f64>();
        for cell in 0..cells {
            let mut moments = [_mm256_setzero_pd(); 12];
            for (k, moment) in moments.iter_mut().enumerate() {
                *moment = _mm256_broadcast_pd(&*row.add(2 * k).cast());
            }
            let at = out.as_mut_ptr().add(cell).cast::<f64>();
            for i in (0..width).step_by(2) {
                let (mut even, mut odd) = (_mm256_setzero_pd(), _mm256_setzero_pd());
                for k in 0..6 {
                    let wa = _mm256_loadu_pd(w.add(64 * k + 2 * i));
                    let wb = _mm256_loadu_pd(w.add(64 * k + 32 + 2 * i));
                    even = _mm256_fmadd_pd(moments[2 * k], wa, even);
                    odd = _mm256_fmadd_pd(moments[2 * k + 1], wb, odd);
                }
                let sum = _mm256_add_pd(even, odd);
                let at = at.add(2 * i);
                if i + 1 < width {
                    _mm256_storeu_pd(at, _mm256_add_pd(sum, _mm256_loadu_pd(at)));
                } else {
                    let sum = _mm256_castpd256_pd128(sum);
                    _mm_storeu_pd(at, _mm_add_pd(sum, _mm_loadu_pd(at)));
                }
            }
            row = row.add(24 * columns);
        }
    }
}
