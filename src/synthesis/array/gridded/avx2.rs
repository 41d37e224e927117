//! AVX2 and FMA versions of the loops of [`super::moments`]. The portable versions there define the results.

use std::arch::x86_64::*;

use num_complex::{Complex32, Complex64};

use super::moments::{BLOCK, FlushWeights, MAX_TAPS, Points, Row32, Row64, Shared};
use super::prepare::Sharing;

/// SAFETY: the processor must have the features, and `points` must be as `Real::accumulate` checks them. Panics if a row is
/// missing.
#[target_feature(enable = "avx2,fma")]
pub(crate) unsafe fn accumulate_32(points: Points<f32>, rows: &mut [Row32]) {
    // SAFETY: the caller guarantees features and shapes: at most BLOCK points, all slices as long
    // as `cell`. Every row is inside the table, as `last` shows; rows are 64 bytes long and
    // therefore aligned.
    unsafe {
        let n = points.cell.len();
        let table = rows.as_mut_ptr().cast::<f32>();
        let (x, row) = (points.x.as_ptr(), points.cell.as_ptr());
        // x^2 and x^4 of all points are computed first, eight at once. They are broadcast when read.
        let (mut x2, mut x4) = ([0f32; BLOCK], [0f32; BLOCK]);
        let mut last = 0;
        for j in 0..n {
            x2[j] = *x.add(j) * *x.add(j);
            x4[j] = x2[j] * x2[j];
            last = last.max(*row.add(j));
        }
        assert!((last as usize) < rows.len(), "row {last}");
        let (x2, x4) = (x2.as_ptr(), x4.as_ptr());
        let one = _mm256_set1_ps(1.0);
        for j in 0..n {
            // 1, x, x^2, x^3, each twice; then times x^4.
            let p = _mm256_mul_ps(
                _mm256_blend_ps::<0b1100_1100>(one, _mm256_set1_ps(*x.add(j))),
                _mm256_blend_ps::<0b1111_0000>(one, _mm256_set1_ps(*x2.add(j))),
            );
            let x4 = _mm256_set1_ps(*x4.add(j));
            let c = points.amplitude.as_ptr().add(j).cast::<f64>();
            let c = _mm256_castpd_ps(_mm256_set1_pd(c.read_unaligned()));
            let low = _mm256_mul_ps(p, c);
            let at = table.add(16 * *row.add(j) as usize);
            _mm256_store_ps(at, _mm256_add_ps(low, _mm256_load_ps(at)));
            let at = at.add(8);
            _mm256_store_ps(at, _mm256_fmadd_ps(low, x4, _mm256_load_ps(at)));
        }
    }
}

/// SAFETY: the processor must have the features, and `points` must be as `Real::accumulate` checks them. Panics if a row is
/// missing.
#[target_feature(enable = "avx2,fma")]
pub(crate) unsafe fn accumulate_64(points: Points<f64>, rows: &mut [Row64]) {
    // SAFETY: as for `accumulate_32`; rows are 192 bytes long and aligned to 64.
    unsafe {
        let n = points.cell.len();
        let table = rows.as_mut_ptr().cast::<f64>();
        let (x, row) = (points.x.as_ptr(), points.cell.as_ptr());
        let last = points.cell.iter().fold(0, |a, &b| a.max(b));
        assert!((last as usize) < rows.len(), "row {last}");
        let one = _mm256_set1_pd(1.0);
        for j in 0..n {
            let x = _mm256_set1_pd(*x.add(j));
            let x2 = _mm256_mul_pd(x, x);
            let c = _mm_loadu_pd(points.amplitude.as_ptr().add(j).cast());
            let c = _mm256_set_m128d(c, c);
            let mut moments = _mm256_mul_pd(c, _mm256_blend_pd::<0b1100>(one, x));
            let at = table.add(24 * *row.add(j) as usize);
            for v in 0..6 {
                let at = at.add(4 * v);
                _mm256_store_pd(at, _mm256_add_pd(moments, _mm256_load_pd(at)));
                moments = _mm256_mul_pd(moments, x2);
            }
        }
    }
}

/// A window of grid values moves over the cells in registers. Each cell adds its taps to the window. Then the first value is
/// complete and is written.
///
/// SAFETY: the processor must have the features; shapes as `Real::flush` checks them.
#[target_feature(enable = "avx2,fma")]
pub(crate) unsafe fn flush_32(rows: &[Row32], weights: &FlushWeights<f32>, out: &mut [Complex32]) {
    // SAFETY: the caller guarantees features and shapes.
    unsafe {
        match weights.width {
            0..=4 => flush_32_of::<1>(rows, weights, out),
            5..=8 => flush_32_of::<2>(rows, weights, out),
            9..=12 => flush_32_of::<3>(rows, weights, out),
            _ => flush_32_of::<4>(rows, weights, out),
        }
    }
}

/// V registers of four complex values hold the window.
#[target_feature(enable = "avx2,fma")]
unsafe fn flush_32_of<const V: usize>(
    rows: &[Row32],
    weights: &FlushWeights<f32>,
    out: &mut [Complex32],
) {
    // SAFETY: cells = rows - 1, the last row being the drain; `out` has a value for every cell and width - 1 more.
    // `doubled` has 8 entries of 32 weights.
    unsafe {
        let cells = rows.len() - 1;
        let zero = _mm256_setzero_ps();
        let mut window = [zero; V];
        let w = weights.doubled.as_ptr().cast::<f32>();
        let out_at = out.as_mut_ptr().cast::<f64>();
        let mut row = rows.as_ptr().cast::<f64>();
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
#[target_feature(enable = "avx2,fma")]
unsafe fn shift_32<const V: usize>(window: &mut [__m256; V], out: *mut f64) {
    // SAFETY: the caller guarantees `out`.
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
pub(crate) unsafe fn flush_64(rows: &[Row64], weights: &FlushWeights<f64>, out: &mut [Complex64]) {
    // SAFETY: cells = rows - 1, the last row being the drain; `out` has a value for every cell and width - 1 more:
    // cell + i < cells + width - 1. `doubled` has 12 entries of 32 weights. Two complex values per register; taps come in groups of two,
    // the odd last one alone.
    unsafe {
        let cells = rows.len() - 1;
        let width = weights.width;
        let w = weights.doubled.as_ptr().cast::<f64>();
        out.fill(Complex64::ZERO);
        let mut row = rows.as_ptr().cast::<f64>();
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
            row = row.add(24);
        }
    }
}

/// [`super::prepare::share_plain`], one point at a time: 256 bits hold a weight for every tap.
///
/// SAFETY: the processor must have the features; shapes as `Real::share` checks them.
#[target_feature(enable = "avx2,fma")]
pub(crate) unsafe fn share_32<const BENT: bool>(points: Sharing<f32>, values: &mut [Shared<f32>]) {
    // SAFETY: all slices have a number for every value, every entry is in the table, and each field
    // of an entry has eight numbers, as each half of a value.
    unsafe {
        for (j, value) in values.iter_mut().enumerate() {
            let weights = points
                .table
                .get_unchecked(*points.entry.get_unchecked(j) as usize);
            let of = |taps: &[f32; MAX_TAPS]| _mm256_loadu_ps(taps.as_ptr());
            let x = _mm256_set1_ps(*points.beyond.get_unchecked(j));
            let c = points.amplitude.get_unchecked(j);
            let (re, im) = (_mm256_set1_ps(c.re), _mm256_set1_ps(c.im));
            let [plain, slope, bow] = [0, 1, 2].map(|k| of(&weights.plain[k]));
            let mut real = _mm256_fmadd_ps(_mm256_fmadd_ps(bow, x, slope), x, plain);
            let out = value.as_mut_ptr();
            if BENT {
                let curvature = _mm256_set1_ps(*points.curvature.get_unchecked(j));
                let more = _mm256_fmadd_ps(of(&weights.real_2), curvature, of(&weights.real));
                real = _mm256_fmadd_ps(more, curvature, real);
                let [plain, slope] = [0, 1].map(|k| of(&weights.imaginary[k]));
                let imaginary = _mm256_mul_ps(_mm256_fmadd_ps(slope, x, plain), curvature);
                let across = _mm256_mul_ps(im, imaginary);
                _mm256_storeu_ps(out, _mm256_fmsub_ps(re, real, across));
                let across = _mm256_mul_ps(re, imaginary);
                _mm256_storeu_ps(out.add(MAX_TAPS), _mm256_fmadd_ps(im, real, across));
            } else {
                _mm256_storeu_ps(out, _mm256_mul_ps(re, real));
                _mm256_storeu_ps(out.add(MAX_TAPS), _mm256_mul_ps(im, real));
            }
        }
    }
}
