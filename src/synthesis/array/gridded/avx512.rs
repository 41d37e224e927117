//! AVX-512 versions of the loops of [`super::moments`]. The portable versions there define the results.

use std::arch::x86_64::*;

use num_complex::{Complex32, Complex64};

use super::moments::{BLOCK, FlushWeights, Points, Row32, Row64};

/// Number of points whose factors are computed together.
const GROUP: usize = 16;

/// Permutation: selects which of 1, x^2, x^4, x^6 multiplies each lane of a row.
const SPREAD_FOUR: [i32; 16] = [0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3];
/// Permutation that duplicates each of eight numbers.
const TWICE: [i32; 16] = [0, 0, 1, 1, 2, 2, 3, 3, 4, 4, 5, 5, 6, 6, 7, 7];

/// A row is (c, c x) times (1, x^2, x^4, x^6). The factors are computed for 16 points at once. Each
/// point then costs two loads, one permutation and the addition.
///
/// SAFETY: the processor must have the features; `points` as `Real::accumulate` checks them. Panics
/// where a row is missing.
#[target_feature(enable = "avx512f,avx512dq,avx512vl")]
pub(crate) unsafe fn accumulate_32(points: Points<f32>, rows: &mut [Row32]) {
    // SAFETY: the caller guarantees features and shapes: all slices as long as `cell`. Every row is
    // inside the table, as `last` shows; rows are 64 bytes long and therefore aligned. Masks
    // prevent reads beyond the last point.
    unsafe {
        let n = points.cell.len();
        let table = rows.as_mut_ptr().cast::<f32>();
        let last = points.cell.iter().fold(0, |a, &b| a.max(b));
        assert!((last as usize) < rows.len(), "row {last}");
        let spread_four = _mm512_loadu_si512(SPREAD_FOUR.as_ptr().cast());
        let twice = _mm512_loadu_si512(TWICE.as_ptr().cast());
        let twice_high = _mm512_add_epi32(twice, _mm512_set1_epi32(8));
        let one = _mm512_set1_ps(1.0);
        // Point 4 l + r of a group: lanes 4 l ... of register r. Point 8 h + 2 l + r: register 2 h
        // + r.
        let mut powers = [one; 4];
        let mut pairs = [one; 4];
        for first in (0..n).step_by(GROUP) {
            let count = (n - first).min(GROUP);
            let mask = (0xffff_u32 >> (GROUP - count)) as u16;
            let x = _mm512_maskz_loadu_ps(mask, points.x.as_ptr().wrapping_add(first));
            let x2 = _mm512_mul_ps(x, x);
            let x4 = _mm512_mul_ps(x2, x2);
            let x6 = _mm512_mul_ps(x4, x2);
            let low = [_mm512_unpacklo_ps(one, x2), _mm512_unpackhi_ps(one, x2)]
                .map(|v| _mm512_castps_pd(v));
            let high = [_mm512_unpacklo_ps(x4, x6), _mm512_unpackhi_ps(x4, x6)]
                .map(|v| _mm512_castps_pd(v));
            for h in 0..2 {
                powers[2 * h] = _mm512_castpd_ps(_mm512_unpacklo_pd(low[h], high[h]));
                powers[2 * h + 1] = _mm512_castpd_ps(_mm512_unpackhi_pd(low[h], high[h]));
            }
            for (h, twice) in [twice, twice_high].into_iter().enumerate() {
                let c = points.amplitude.as_ptr().wrapping_add(first + 8 * h);
                let c = _mm512_maskz_loadu_pd((mask >> (8 * h)) as u8, c.cast());
                let x = _mm512_permutexvar_ps(twice, x);
                let cx = _mm512_castps_pd(_mm512_mul_ps(_mm512_castpd_ps(c), x));
                pairs[2 * h] = _mm512_castpd_ps(_mm512_unpacklo_pd(c, cx));
                pairs[2 * h + 1] = _mm512_castpd_ps(_mm512_unpackhi_pd(c, cx));
            }
            let (powers, pairs) = (powers.as_ptr().cast::<f32>(), pairs.as_ptr().cast::<f32>());
            let add = |p: usize| {
                let powers = powers.add(16 * (p % 4) + 4 * (p / 4));
                let pairs = pairs.add(32 * (p / 8) + 16 * (p % 2) + 4 * (p / 2 % 4));
                let powers = _mm512_castps128_ps512(_mm_load_ps(powers));
                let powers = _mm512_permutexvar_ps(spread_four, powers);
                let pairs = _mm512_broadcast_f32x4(_mm_load_ps(pairs));
                let row = *points.cell.get_unchecked(first + p) as usize;
                let at = table.add(16 * row);
                _mm512_store_ps(at, _mm512_fmadd_ps(powers, pairs, _mm512_load_ps(at)));
            };
            if count == GROUP {
                // Unrolled, so that all offsets are constants.
                add(0);
                add(1);
                add(2);
                add(3);
                add(4);
                add(5);
                add(6);
                add(7);
                add(8);
                add(9);
                add(10);
                add(11);
                add(12);
                add(13);
                add(14);
                add(15);
            } else {
                (0..count).for_each(add);
            }
        }
    }
}

/// SAFETY: the processor must have the features, and `points` must be as `Real::accumulate` checks them. Panics if a row is
/// missing.
#[target_feature(enable = "avx512f,avx512dq,avx512vl")]
pub(crate) unsafe fn accumulate_64(points: Points<f64>, rows: &mut [Row64]) {
    // SAFETY: as for `accumulate_32`; rows are 192 bytes long and aligned to 64.
    unsafe {
        let n = points.cell.len();
        let table = rows.as_mut_ptr().cast::<f64>();
        let (x, row) = (points.x.as_ptr(), points.cell.as_ptr());
        let (mut x2, mut x4) = ([0f64; BLOCK], [0f64; BLOCK]);
        let mut last = 0;
        for j in 0..n {
            x2[j] = *x.add(j) * *x.add(j);
            x4[j] = x2[j] * x2[j];
            last = last.max(*row.add(j));
        }
        assert!((last as usize) < rows.len(), "row {last}");
        let (x2, x4) = (x2.as_ptr(), x4.as_ptr());
        let one = _mm512_set1_pd(1.0);
        for j in 0..n {
            // 1, x, x^2, x^3, each twice; then times x^4 and x^8.
            let p = _mm512_mask_blend_pd(0b1100_1100, one, _mm512_set1_pd(*x.add(j)));
            let p = _mm512_mask_mul_pd(p, 0b1111_0000, p, _mm512_set1_pd(*x2.add(j)));
            let x4 = _mm512_set1_pd(*x4.add(j));
            let c = _mm_loadu_pd(points.amplitude.as_ptr().add(j).cast());
            let low = _mm512_mul_pd(p, _mm512_broadcast_f64x2(c));
            let middle = _mm512_mul_pd(low, x4);
            let at = table.add(24 * *row.add(j) as usize);
            _mm512_store_pd(at, _mm512_add_pd(low, _mm512_load_pd(at)));
            let at = at.add(8);
            _mm512_store_pd(at, _mm512_add_pd(middle, _mm512_load_pd(at)));
            let at = at.add(8);
            _mm512_store_pd(at, _mm512_fmadd_pd(middle, x4, _mm512_load_pd(at)));
        }
    }
}

/// A window of grid values moves over the cells in registers. Each cell adds its taps to the window. Then the first value
/// is complete and is written.
///
/// SAFETY: the processor must have the features; shapes as `Real::flush` checks them.
#[target_feature(enable = "avx512f,avx512dq,avx512vl")]
pub(crate) unsafe fn flush_32(rows: &[Row32], weights: &FlushWeights<f32>, out: &mut [Complex32]) {
    // SAFETY: the caller guarantees features and shapes.
    unsafe {
        match weights.width {
            0..=8 => flush_32_of::<1>(rows, weights, out),
            _ => flush_32_of::<2>(rows, weights, out),
        }
    }
}

/// V registers of eight complex values hold the window.
#[target_feature(enable = "avx512f,avx512dq,avx512vl")]
unsafe fn flush_32_of<const V: usize>(
    rows: &[Row32],
    weights: &FlushWeights<f32>,
    out: &mut [Complex32],
) {
    // SAFETY: cells = rows - 1, the last row being the drain; `out` has a value for every cell and width - 1 more,
    // of which the last loop writes min(8 V, width) - 1. `doubled` has 8 entries of 32 weights.
    unsafe {
        let cells = rows.len() - 1;
        let mut w = [[_mm512_setzero_ps(); V]; 8];
        for (k, w) in w.iter_mut().enumerate() {
            for (v, w) in w.iter_mut().enumerate() {
                *w = _mm512_loadu_ps(weights.doubled.get_unchecked(k).as_ptr().add(16 * v));
            }
        }
        let zero = _mm512_setzero_ps();
        let mut window = [zero; V];
        let out_at = out.as_mut_ptr().cast::<f64>();
        let mut row = rows.as_ptr().cast::<f64>();
        for cell in 0..cells {
            // Two chains of products per register, apart from the window: only the final addition
            // depends on the previous cell.
            let (mut even, mut odd) = ([zero; V], [zero; V]);
            for k in 0..4 {
                let a = _mm512_castpd_ps(_mm512_set1_pd(*row.add(2 * k)));
                let b = _mm512_castpd_ps(_mm512_set1_pd(*row.add(2 * k + 1)));
                for v in 0..V {
                    even[v] = _mm512_fmadd_ps(a, w[2 * k][v], even[v]);
                    odd[v] = _mm512_fmadd_ps(b, w[2 * k + 1][v], odd[v]);
                }
            }
            for v in 0..V {
                window[v] = _mm512_add_ps(window[v], _mm512_add_ps(even[v], odd[v]));
            }
            shift_32(&mut window, out_at.add(cell));
            row = row.add(8);
        }
        for value in cells..out.len() {
            shift_32(&mut window, out_at.add(value));
        }
    }
}

/// Writes the first complex value of the window and shifts the others by one.
///
/// SAFETY: `out` must be writable.
#[inline]
#[target_feature(enable = "avx512f,avx512dq,avx512vl")]
unsafe fn shift_32<const V: usize>(window: &mut [__m512; V], out: *mut f64) {
    // SAFETY: the caller guarantees `out`.
    unsafe {
        _mm_storel_pd(out, _mm_castps_pd(_mm512_castps512_ps128(window[0])));
        for v in 0..V {
            let next = if v + 1 < V {
                _mm512_castps_si512(window[v + 1])
            } else {
                _mm512_setzero_si512()
            };
            window[v] = _mm512_castsi512_ps(_mm512_alignr_epi64::<1>(
                next,
                _mm512_castps_si512(window[v]),
            ));
        }
    }
}

/// As [`flush_32`].
///
/// SAFETY: the processor must have the features; shapes as `Real::flush` checks them.
#[target_feature(enable = "avx512f,avx512dq,avx512vl")]
pub(crate) unsafe fn flush_64(rows: &[Row64], weights: &FlushWeights<f64>, out: &mut [Complex64]) {
    // SAFETY: the caller guarantees features and shapes.
    unsafe {
        match weights.width {
            0..=4 => flush_64_of::<1>(rows, weights, out),
            5..=8 => flush_64_of::<2>(rows, weights, out),
            9..=12 => flush_64_of::<3>(rows, weights, out),
            _ => flush_64_of::<4>(rows, weights, out),
        }
    }
}

/// V registers of four complex values hold the window.
#[target_feature(enable = "avx512f,avx512dq,avx512vl")]
unsafe fn flush_64_of<const V: usize>(
    rows: &[Row64],
    weights: &FlushWeights<f64>,
    out: &mut [Complex64],
) {
    // SAFETY: cells = rows - 1, the last row being the drain; `out` has a value for every cell and width - 1 more.
    // `doubled` has 12 entries of 32 weights.
    unsafe {
        let cells = rows.len() - 1;
        let zero = _mm512_setzero_pd();
        let mut window = [zero; V];
        let w = weights.doubled.as_ptr().cast::<f64>();
        let mut row = rows.as_ptr().cast::<f64>();
        for cell in 0..cells {
            let (mut even, mut odd) = ([zero; V], [zero; V]);
            for k in 0..6 {
                let a = _mm512_broadcast_f64x2(_mm_load_pd(row.add(4 * k)));
                let b = _mm512_broadcast_f64x2(_mm_load_pd(row.add(4 * k + 2)));
                for v in 0..V {
                    let wa = _mm512_loadu_pd(w.add(64 * k + 8 * v));
                    let wb = _mm512_loadu_pd(w.add(64 * k + 32 + 8 * v));
                    even[v] = _mm512_fmadd_pd(a, wa, even[v]);
                    odd[v] = _mm512_fmadd_pd(b, wb, odd[v]);
                }
            }
            for v in 0..V {
                window[v] = _mm512_add_pd(window[v], _mm512_add_pd(even[v], odd[v]));
            }
            shift_64(&mut window, out.as_mut_ptr().add(cell).cast());
            row = row.add(24);
        }
        for value in cells..out.len() {
            shift_64(&mut window, out.as_mut_ptr().add(value).cast());
        }
    }
}

/// Writes the first complex value of the window and shifts the others by one.
///
/// SAFETY: `out` must be writable, 16 bytes.
#[inline]
#[target_feature(enable = "avx512f,avx512dq,avx512vl")]
unsafe fn shift_64<const V: usize>(window: &mut [__m512d; V], out: *mut f64) {
    // SAFETY: the caller guarantees `out`.
    unsafe {
        _mm_storeu_pd(out, _mm512_castpd512_pd128(window[0]));
        for v in 0..V {
            let next = if v + 1 < V {
                _mm512_castpd_si512(window[v + 1])
            } else {
                _mm512_setzero_si512()
            };
            window[v] = _mm512_castsi512_pd(_mm512_alignr_epi64::<2>(
                next,
                _mm512_castpd_si512(window[v]),
            ));
        }
    }
}
