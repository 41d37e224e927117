//! Inner loops of `delay_sum`: weighted sums of rows that begin at different samples, in f32.
//!
//! A grid holds one row of real and one of imaginary parts for every element and every fraction of a sample. [`add_rows`] adds up to
//! [`MAX_SAMPLES`] samples of one such row per element, each multiplied by its complex weight. The sums stay in registers over a block of
//! elements. AVX-512 and AVX2 are detected at run time; the scalar version is the fall-back and the reference of the tests.

use echotank_core::simd::{Kind, SimdLevel};

/// Maximum number of samples per call.
pub(super) const MAX_SAMPLES: usize = 128;
/// Maximum number of elements per call; their interpolated tile fits the second-level cache.
pub(super) const BLOCK: usize = 32;
/// Maximum number of rows per call.
pub(super) const MAX_TAPS: usize = 3 * BLOCK;
/// Samples per step of the widest kernel; rows must be readable to the end of a step.
pub(super) const STEP: usize = 16;

/// Rows of the grid and their weights; structure of arrays.
#[derive(Clone, Copy, Debug)]
pub(super) struct Taps {
    pub(super) len: usize,
    /// Start of the real parts; the imaginary parts follow one row length later.
    pub(super) start: [u32; MAX_TAPS],
    pub(super) re: [f32; MAX_TAPS],
    pub(super) im: [f32; MAX_TAPS],
}

impl Taps {
    pub(super) const NONE: Self = Self {
        len: 0,
        start: [0; MAX_TAPS],
        re: [0.0; MAX_TAPS],
        im: [0.0; MAX_TAPS],
    };

    fn iter(&self) -> impl Iterator<Item = (usize, f32, f32)> + '_ {
        (0..self.len).map(|i| (self.start[i] as usize, self.re[i], self.im[i]))
    }
}

/// Sums of real and imaginary parts.
#[derive(Clone, Copy)]
pub(super) struct Sums {
    pub(super) re: [f32; MAX_SAMPLES],
    pub(super) im: [f32; MAX_SAMPLES],
}

impl Sums {
    pub(super) const ZERO: Self = Self {
        re: [0.0; MAX_SAMPLES],
        im: [0.0; MAX_SAMPLES],
    };

    /// Real and imaginary parts of some samples.
    pub(super) fn part(&mut self, samples: std::ops::Range<usize>) -> [&mut [f32]; 2] {
        [&mut self.re[samples.clone()], &mut self.im[samples]]
    }
}

/// Adds the sum of all taps' rows to the real and imaginary parts of as many samples. `imaginary` is the length of a row.
///
/// Panics if a tap's row, rounded up to whole steps, lies outside the grid.
pub(super) fn add_rows(
    simd_level: SimdLevel,
    grid: &[f32],
    imaginary: usize,
    taps: &Taps,
    [re, im]: [&mut [f32]; 2],
) {
    let samples = re.len();
    assert!(samples <= MAX_SAMPLES && im.len() == samples && taps.len <= MAX_TAPS);
    let steps = samples.div_ceil(STEP);
    let reach = taps.start[..taps.len].iter().max().copied().unwrap_or(0) as usize;
    assert!(
        taps.len == 0 || reach + imaginary + STEP * steps <= grid.len(),
        "row outside the grid"
    );
    match simd_level.kind() {
        Kind::Portable => add_plain(grid, imaginary, taps, re, im),
        #[cfg(target_arch = "x86_64")]
        // SAFETY: a `SimdLevel` proves that the processor has the features; the rows are checked above.
        Kind::Avx2 => unsafe { add_avx2(grid, imaginary, taps, re, im) },
        #[cfg(target_arch = "x86_64")]
        Kind::Avx512 => {
            let parts = re.chunks_mut(4 * STEP).zip(im.chunks_mut(4 * STEP));
            for (first, (re, im)) in (0..).step_by(4 * STEP).zip(parts) {
                let grid = &grid[first..];
                // SAFETY: as above.
                unsafe {
                    match re.len().div_ceil(STEP) {
                        1 => add_avx512::<1>(grid, imaginary, taps, re, im),
                        2 => add_avx512::<2>(grid, imaginary, taps, re, im),
                        3 => add_avx512::<3>(grid, imaginary, taps, re, im),
                        _ => add_avx512::<4>(grid, imaginary, taps, re, im),
                    }
                }
            }
        }
        #[cfg(not(target_arch = "x86_64"))]
        _ => add_plain(grid, imaginary, taps, re, im),
    }
}

/// The same sums in the same order. Without fused multiply-add, the last bits differ.
fn add_plain(grid: &[f32], imaginary: usize, taps: &Taps, to_re: &mut [f32], to_im: &mut [f32]) {
    let samples = to_re.len();
    let (mut sum_re, mut sum_im) = ([0.0f32; MAX_SAMPLES], [0.0f32; MAX_SAMPLES]);
    for (start, w_re, w_im) in taps.iter() {
        let re = &grid[start..][..samples];
        let im = &grid[start + imaginary..][..samples];
        for k in 0..samples {
            sum_re[k] += w_re * re[k] - w_im * im[k];
            sum_im[k] += w_re * im[k] + w_im * re[k];
        }
    }
    for k in 0..samples {
        to_re[k] += sum_re[k];
        to_im[k] += sum_im[k];
    }
}

/// # Safety
/// The processor has AVX-512F. Every tap's rows of 16 `V` samples lie in the grid. `to_re` and `to_im` have equal lengths, more than 16 (V
/// - 1) and at most 16 V.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f")]
unsafe fn add_avx512<const V: usize>(
    grid: &[f32],
    imaginary: usize,
    taps: &Taps,
    to_re: &mut [f32],
    to_im: &mut [f32],
) {
    use std::arch::x86_64::*;
    let mut re = [_mm512_setzero_ps(); V];
    let mut im = [_mm512_setzero_ps(); V];
    // The products with imaginary weights are summed apart, so that no product waits for another of the same tap.
    let mut more_re = [_mm512_setzero_ps(); V];
    let mut more_im = [_mm512_setzero_ps(); V];
    for (start, w_re, w_im) in taps.iter() {
        let (w_re, w_im) = (_mm512_set1_ps(w_re), _mm512_set1_ps(w_im));
        // SAFETY: the caller guarantees the rows.
        unsafe {
            let row = grid.as_ptr().add(start);
            for v in 0..V {
                let x_re = _mm512_loadu_ps(row.add(16 * v));
                let x_im = _mm512_loadu_ps(row.add(imaginary + 16 * v));
                re[v] = _mm512_fmadd_ps(w_re, x_re, re[v]);
                im[v] = _mm512_fmadd_ps(w_re, x_im, im[v]);
                more_re[v] = _mm512_fnmadd_ps(w_im, x_im, more_re[v]);
                more_im[v] = _mm512_fmadd_ps(w_im, x_re, more_im[v]);
            }
        }
    }
    for v in 0..V {
        re[v] = _mm512_add_ps(re[v], more_re[v]);
        im[v] = _mm512_add_ps(im[v], more_im[v]);
    }
    for v in 0..V {
        let left = to_re.len() - 16 * v;
        let mask = if left >= 16 {
            u16::MAX
        } else {
            (1 << left) - 1
        };
        // SAFETY: the mask excludes samples beyond the slices.
        unsafe {
            for (to, sum) in [
                (to_re.as_mut_ptr().add(16 * v), re[v]),
                (to_im.as_mut_ptr().add(16 * v), im[v]),
            ] {
                let total = _mm512_add_ps(_mm512_maskz_loadu_ps(mask, to), sum);
                _mm512_mask_storeu_ps(to, mask, total);
            }
        }
    }
}

/// # Safety
/// The processor has AVX2 and FMA. Every tap's rows, rounded up to 16 samples, lie in the grid. `to_re` and `to_im` have equal lengths.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
unsafe fn add_avx2(
    grid: &[f32],
    imaginary: usize,
    taps: &Taps,
    to_re: &mut [f32],
    to_im: &mut [f32],
) {
    use std::arch::x86_64::*;
    /// Number of vectors of 8 whose four sums fit the 16 registers.
    const V: usize = 2;
    for (first, (to_re, to_im)) in (0..)
        .step_by(8 * V)
        .zip(to_re.chunks_mut(8 * V).zip(to_im.chunks_mut(8 * V)))
    {
        let mut re = [_mm256_setzero_ps(); V];
        let mut im = [_mm256_setzero_ps(); V];
        // As with AVX-512, no product waits for another of the same tap.
        let mut more_re = [_mm256_setzero_ps(); V];
        let mut more_im = [_mm256_setzero_ps(); V];
        for (start, w_re, w_im) in taps.iter() {
            let (w_re, w_im) = (_mm256_set1_ps(w_re), _mm256_set1_ps(w_im));
            // SAFETY: the caller guarantees the rows.
            unsafe {
                let row = grid.as_ptr().add(start + first);
                for v in 0..V {
                    let x_re = _mm256_loadu_ps(row.add(8 * v));
                    let x_im = _mm256_loadu_ps(row.add(imaginary + 8 * v));
                    re[v] = _mm256_fmadd_ps(w_re, x_re, re[v]);
                    im[v] = _mm256_fmadd_ps(w_re, x_im, im[v]);
                    more_re[v] = _mm256_fnmadd_ps(w_im, x_im, more_re[v]);
                    more_im[v] = _mm256_fmadd_ps(w_im, x_re, more_im[v]);
                }
            }
        }
        for v in 0..V {
            re[v] = _mm256_add_ps(re[v], more_re[v]);
            im[v] = _mm256_add_ps(im[v], more_im[v]);
        }
        let (mut sum_re, mut sum_im) = ([0.0f32; 8 * V], [0.0f32; 8 * V]);
        for v in 0..V {
            // SAFETY: 8 V floats each.
            unsafe {
                _mm256_storeu_ps(sum_re.as_mut_ptr().add(8 * v), re[v]);
                _mm256_storeu_ps(sum_im.as_mut_ptr().add(8 * v), im[v]);
            }
        }
        for (to, sum) in to_re.iter_mut().zip(sum_re) {
            *to += sum;
        }
        for (to, sum) in to_im.iter_mut().zip(sum_im) {
            *to += sum;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_simd_level_equals_the_scalar_sum_and_writes_nothing_outside() {
        let row = 200;
        let mut state = 1u32;
        let mut draw = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            state as f32 / u32::MAX as f32 - 0.5
        };
        let grid: Vec<f32> = (0..2 * row * 40).map(|_| draw()).collect();
        let mut taps = Taps::NONE;
        taps.len = 29;
        for e in 0..taps.len {
            taps.start[e] = (2 * row * e + 3 * (e % 20)) as u32;
            taps.re[e] = draw();
            taps.im[e] = draw();
        }
        for simd_level in SimdLevel::available() {
            for (at, samples) in [
                (0, 0),
                (3, 1),
                (0, 16),
                (9, 17),
                (5, 40),
                (60, 64),
                (1, 100),
                (0, 128),
            ] {
                let (mut want, mut got) = (Sums::ZERO, Sums::ZERO);
                got.re.fill(0.25);
                want.re.fill(0.25);
                let range = at..at + samples;
                let to = want.part(range.clone());
                add_rows(SimdLevel::PORTABLE, &grid, row, &taps, to);
                add_rows(simd_level, &grid, row, &taps, got.part(range));
                for k in 0..MAX_SAMPLES {
                    let off = (got.re[k] - want.re[k])
                        .abs()
                        .max((got.im[k] - want.im[k]).abs());
                    assert!(
                        off < 2e-6,
                        "{simd_level:?}, sample {k} of {at} + {samples}: {off:e}"
                    );
                    let beside = !(at..at + samples).contains(&k);
                    assert!(!beside || (got.re[k], got.im[k]) == (0.25, 0.0));
                }
            }
        }
    }

    #[test]
    #[should_panic(expected = "outside the grid")]
    fn a_row_outside_the_grid_panics() {
        let mut taps = Taps::NONE;
        taps.len = 1;
        taps.start[0] = 90;
        let mut sums = Sums::ZERO;
        add_rows(SimdLevel::best(), &[0.0; 200], 100, &taps, sums.part(0..16));
    }
}
