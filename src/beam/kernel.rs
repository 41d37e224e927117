//! The inner loops of [`delay_sum`](super::delay_sum): weighted sums of rows that begin at different samples, in f32.
//!
//! A grid holds for every element and every fraction of a sample one row of real and one of imaginary parts. [`sum_rows`] adds up to
//! [`WIDEST`] samples of one such row per element, each times its complex weight; the sums stay in registers over all elements. AVX-512 and
//! AVX2 are asked for at run time; the plain twin is the fall-back, and the tests compare them.

/// Samples that one call sums at most.
pub(super) const WIDEST: usize = 128;

/// Which row of the grid an element gives, and its weight.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Tap {
    /// Where its real parts begin; the imaginary parts lie one row's length behind.
    pub(super) start: u32,
    pub(super) re: f32,
    pub(super) im: f32,
}

/// Sums of real and imaginary parts.
pub(super) struct Sums {
    pub(super) re: [f32; WIDEST],
    pub(super) im: [f32; WIDEST],
}

impl Sums {
    pub(super) const ZERO: Self = Self {
        re: [0.0; WIDEST],
        im: [0.0; WIDEST],
    };
}

/// The widest instructions of this processor that there is a kernel for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Dialect {
    Plain,
    #[cfg(target_arch = "x86_64")]
    Avx2,
    #[cfg(target_arch = "x86_64")]
    Avx512,
}

impl Dialect {
    pub(super) fn best() -> Self {
        #[cfg(target_arch = "x86_64")]
        {
            if is_x86_feature_detected!("avx512f") && is_x86_feature_detected!("avx512vl") {
                return Self::Avx512;
            }
            if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") {
                return Self::Avx2;
            }
        }
        Self::Plain
    }
}

/// The first `samples` (rounded up to 16) of the sum of all taps' rows; what lies behind is undefined. `imaginary`: length of a row.
///
/// Panics if a tap's row, rounded up, lies outside the grid.
pub(super) fn sum_rows(
    dialect: Dialect,
    grid: &[f32],
    imaginary: usize,
    taps: &[Tap],
    samples: usize,
    sums: &mut Sums,
) {
    assert!(samples <= WIDEST);
    let vectors = samples.div_ceil(16).next_power_of_two();
    let reach = taps.iter().map(|t| t.start).max().unwrap_or(0) as usize;
    assert!(
        taps.is_empty() || reach + imaginary + 16 * vectors <= grid.len(),
        "a row outside the grid"
    );
    match dialect {
        Dialect::Plain => sum_plain(grid, imaginary, taps, 16 * vectors, sums),
        #[cfg(target_arch = "x86_64")]
        // SAFETY: the dialect was made by `Dialect::best` or a test that asked for the features; the rows were checked above.
        Dialect::Avx2 => unsafe { sum_avx2(grid, imaginary, taps, 16 * vectors, sums) },
        #[cfg(target_arch = "x86_64")]
        // SAFETY: as above.
        Dialect::Avx512 => unsafe {
            match vectors {
                1 => sum_avx512::<1>(grid, imaginary, taps, sums),
                2 => sum_avx512::<2>(grid, imaginary, taps, sums),
                4 => sum_avx512::<4>(grid, imaginary, taps, sums),
                _ => sum_avx512::<8>(grid, imaginary, taps, sums),
            }
        },
    }
}

/// The same sums in the same order; without fused multiply-adds its last bits differ.
fn sum_plain(grid: &[f32], imaginary: usize, taps: &[Tap], samples: usize, sums: &mut Sums) {
    sums.re[..samples].fill(0.0);
    sums.im[..samples].fill(0.0);
    for tap in taps {
        let start = tap.start as usize;
        let re = &grid[start..][..samples];
        let im = &grid[start + imaginary..][..samples];
        for k in 0..samples {
            sums.re[k] += tap.re * re[k] - tap.im * im[k];
            sums.im[k] += tap.re * im[k] + tap.im * re[k];
        }
    }
}

/// # Safety
/// The processor has AVX-512F; every tap's rows of 16 `V` samples lie in the grid.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f")]
unsafe fn sum_avx512<const V: usize>(
    grid: &[f32],
    imaginary: usize,
    taps: &[Tap],
    sums: &mut Sums,
) {
    use std::arch::x86_64::*;
    let mut re = [_mm512_setzero_ps(); V];
    let mut im = [_mm512_setzero_ps(); V];
    for tap in taps {
        let (w_re, w_im) = (_mm512_set1_ps(tap.re), _mm512_set1_ps(tap.im));
        // SAFETY: the caller vouches for the rows.
        unsafe {
            let row = grid.as_ptr().add(tap.start as usize);
            for v in 0..V {
                let x_re = _mm512_loadu_ps(row.add(16 * v));
                let x_im = _mm512_loadu_ps(row.add(imaginary + 16 * v));
                re[v] = _mm512_fmadd_ps(w_re, x_re, re[v]);
                im[v] = _mm512_fmadd_ps(w_re, x_im, im[v]);
                re[v] = _mm512_fnmadd_ps(w_im, x_im, re[v]);
                im[v] = _mm512_fmadd_ps(w_im, x_re, im[v]);
            }
        }
    }
    for v in 0..V {
        // SAFETY: 16 V is at most `WIDEST`.
        unsafe {
            _mm512_storeu_ps(sums.re.as_mut_ptr().add(16 * v), re[v]);
            _mm512_storeu_ps(sums.im.as_mut_ptr().add(16 * v), im[v]);
        }
    }
}

/// # Safety
/// The processor has AVX2 and FMA; every tap's rows of `samples` (a multiple of 16, at most `WIDEST`) lie in the grid.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
unsafe fn sum_avx2(grid: &[f32], imaginary: usize, taps: &[Tap], samples: usize, sums: &mut Sums) {
    use std::arch::x86_64::*;
    /// Vectors of 8 that stay in the 16 registers.
    const V: usize = 2;
    for first in (0..samples).step_by(8 * V) {
        let mut re = [_mm256_setzero_ps(); V];
        let mut im = [_mm256_setzero_ps(); V];
        for tap in taps {
            let (w_re, w_im) = (_mm256_set1_ps(tap.re), _mm256_set1_ps(tap.im));
            // SAFETY: the caller vouches for the rows.
            unsafe {
                let row = grid.as_ptr().add(tap.start as usize + first);
                for v in 0..V {
                    let x_re = _mm256_loadu_ps(row.add(8 * v));
                    let x_im = _mm256_loadu_ps(row.add(imaginary + 8 * v));
                    re[v] = _mm256_fmadd_ps(w_re, x_re, re[v]);
                    im[v] = _mm256_fmadd_ps(w_re, x_im, im[v]);
                    re[v] = _mm256_fnmadd_ps(w_im, x_im, re[v]);
                    im[v] = _mm256_fmadd_ps(w_im, x_re, im[v]);
                }
            }
        }
        for v in 0..V {
            // SAFETY: `first` + 16 is at most `samples`, and that at most `WIDEST`.
            unsafe {
                _mm256_storeu_ps(sums.re.as_mut_ptr().add(first + 8 * v), re[v]);
                _mm256_storeu_ps(sums.im.as_mut_ptr().add(first + 8 * v), im[v]);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_dialect_sums_what_the_plain_twin_sums() {
        let row = 200;
        let mut state = 1u32;
        let mut draw = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            state as f32 / u32::MAX as f32 - 0.5
        };
        let grid: Vec<f32> = (0..2 * row * 40).map(|_| draw()).collect();
        let taps: Vec<Tap> = (0..37)
            .map(|e| Tap {
                start: (2 * row * e + 3 * (e % 20)) as u32,
                re: draw(),
                im: draw(),
            })
            .collect();
        let mut dialects = vec![Dialect::best()];
        #[cfg(target_arch = "x86_64")]
        if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") {
            dialects.push(Dialect::Avx2);
        }
        for dialect in dialects {
            for samples in [1, 16, 17, 40, 64, 100, 128] {
                let (mut want, mut got) = (Sums::ZERO, Sums::ZERO);
                sum_rows(Dialect::Plain, &grid, row, &taps, samples, &mut want);
                sum_rows(dialect, &grid, row, &taps, samples, &mut got);
                for k in 0..samples {
                    let off = (got.re[k] - want.re[k])
                        .abs()
                        .max((got.im[k] - want.im[k]).abs());
                    assert!(off < 2e-6, "{dialect:?}, sample {k} of {samples}: {off:e}");
                }
            }
        }
    }

    #[test]
    #[should_panic(expected = "outside the grid")]
    fn a_row_outside_the_grid_is_refused() {
        let tap = Tap {
            start: 90,
            re: 1.0,
            im: 0.0,
        };
        let mut sums = Sums::ZERO;
        sum_rows(Dialect::best(), &[0.0; 200], 100, &[tap], 16, &mut sums);
    }
}
