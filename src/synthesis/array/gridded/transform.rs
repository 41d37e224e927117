//! Nonuniform Fourier transform of type 1: from points at arbitrary delays, in any order, to
//! uniform bins.
//!
//! ```text
//! out[k + F/2] = sum_m c_m exp(-j 2pi k u_m / T),  k = -F/2 ... F/2 - 1,  0 <= u_m < T
//! ```
//!
//! The inputs are delays in f64 seconds and complex amplitudes. The result is `bins` values. The
//! steps are moments per cell ([`super::moments`]), the flush onto a grid ([`super::kernel`]), an
//! FFT, and division by the spectrum of the kernel. [`Transform1d::execute`] allocates nothing.
//!
//! f32 has an accuracy of about 2e-7, f64 of 1e-12. The rest of the f64 error is the rounding of
//! delays times bins.

use std::sync::Arc;

use echotank_fft::Fft;
use num_complex::{Complex, Complex64};

use super::kernel::Kernel;
use super::moments::{Axis, BLOCK, FlushWeights, Located, Points, Real, locate};
use echotank_core::simd::SimdLevel;

/// Smallest grid size of at least `least` points with a fast Fourier transform: 2^a, 3 2^a, 5 2^a,
/// 9 2^a or 15 2^a.
pub fn grid_size(least: usize) -> usize {
    [1, 3, 5, 9, 15]
        .into_iter()
        .map(|odd: usize| odd * least.div_ceil(odd).next_power_of_two())
        .min()
        .unwrap_or(least)
}

/// Tables of the transform for one number of bins and one period.
pub struct Transform1d<T: Real> {
    bins: usize,
    grid: usize,
    period_s: f64,
    kernel: Kernel,
    simd_level: SimdLevel,
    weights: FlushWeights<T>,
    /// Factor per bin. It corrects the spectrum of the kernel and the offset `kernel.first()` of
    /// the first grid value.
    factors: Vec<Complex<T>>,
    fft: Arc<dyn Fft<T>>,
}

/// Buffers of one thread for one transform.
pub struct Workspace<T: Real> {
    located: Located<T>,
    rows: Vec<T::Row>,
    grid: Vec<Complex<T>>,
    scratch: Vec<Complex<T>>,
}

impl<T: Real> Transform1d<T> {
    /// Prepares a transform to `bins` (even) bins over `period_s` seconds. `width` and
    /// `oversampling` are those of [`Kernel`]; the oversampling increases to the next fast grid
    /// size.
    pub fn new(
        bins: usize,
        period_s: f64,
        width: usize,
        oversampling: f64,
        simd_level: SimdLevel,
    ) -> Self {
        assert!(bins >= 2 && bins.is_multiple_of(2), "{bins} bins");
        assert!(
            period_s > 0.0 && period_s.is_finite(),
            "period {period_s} s"
        );
        let grid = grid_size(((bins as f64 * oversampling).ceil() as usize).max(4 * width));
        let kernel = Kernel::new(width, grid as f64 / bins as f64, T::MOMENTS);
        let factors = (0..bins)
            .map(|q| {
                let nu = (q as f64 - (bins / 2) as f64) / grid as f64;
                let turns = -nu * kernel.first() as f64;
                let factor = Complex64::from_polar(
                    1.0 / kernel.window_gain(nu),
                    std::f64::consts::TAU * turns,
                );
                Complex::new(T::narrow(factor.re), T::narrow(factor.im))
            })
            .collect();
        Self {
            bins,
            grid,
            period_s,
            weights: FlushWeights::new(&kernel),
            kernel,
            simd_level,
            factors,
            fft: T::plan_forward(grid),
        }
    }

    /// The spreading kernel.
    pub fn kernel(&self) -> &Kernel {
        &self.kernel
    }

    /// Number of output bins.
    pub fn bins(&self) -> usize {
        self.bins
    }

    /// Allocates buffers for one thread.
    pub fn workspace(&self) -> Workspace<T> {
        let zero = Complex::new(T::zero(), T::zero());
        Workspace {
            located: Located::new(),
            // The table has cells 0..=grid and the drain. Odd kernels map the last half step to a
            // separate cell.
            rows: vec![T::EMPTY; self.grid + 2],
            grid: vec![zero; self.grid + self.kernel.width],
            scratch: vec![zero; self.fft.get_inplace_scratch_len()],
        }
    }

    /// Overwrites `out` with the spectrum. Points outside 0..period are omitted. Returns their
    /// number.
    pub fn execute(
        &self,
        work: &mut Workspace<T>,
        delay_s: &[f64],
        amplitude: &[Complex<T>],
        out: &mut [Complex<T>],
    ) -> u64 {
        assert_eq!(delay_s.len(), amplitude.len(), "delays and amplitudes");
        assert_eq!(out.len(), self.bins, "bins");
        work.rows.fill(T::EMPTY);
        let axis = Axis {
            per_s: self.grid as f64 / self.period_s,
            offset: self.kernel.shift(),
            cells: self.grid + 1,
            drain: self.grid + 1,
        };
        let mut outside = 0;
        for (delay_s, amplitude) in delay_s.chunks(BLOCK).zip(amplitude.chunks(BLOCK)) {
            outside += locate(self.simd_level, axis, delay_s, &mut work.located);
            let Located { cell, x } = &work.located;
            let points = Points {
                cell: &cell[..delay_s.len()],
                x: &x[..delay_s.len()],
                amplitude,
            };
            T::accumulate(self.simd_level, points, &mut work.rows);
        }
        self.finish(work, out);
        outside
    }

    fn finish(&self, work: &mut Workspace<T>, out: &mut [Complex<T>]) {
        T::flush(self.simd_level, &work.rows, &self.weights, &mut work.grid);
        let (grid, beyond) = work.grid.split_at_mut(self.grid);
        // The grid is periodic: values past the end wrap to the beginning.
        for (value, past) in grid.iter_mut().zip(beyond) {
            *value = *value + *past;
        }
        self.fft.process_with_scratch(grid, &mut work.scratch);
        let (negative, positive) = out.split_at_mut(self.bins / 2);
        let (factor_negative, factor_positive) = self.factors.split_at(self.bins / 2);
        let lowest = self.grid - self.bins / 2;
        for ((out, value), factor) in negative
            .iter_mut()
            .zip(&grid[lowest..])
            .zip(factor_negative)
        {
            *out = *value * *factor;
        }
        for ((out, value), factor) in positive.iter_mut().zip(&*grid).zip(factor_positive) {
            *out = *value * *factor;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::TAU;

    const BINS: usize = 192;
    const PERIOD_S: f64 = 6.4e-3;

    /// Unsorted points, including both ends of the period.
    fn points(count: usize) -> (Vec<f64>, Vec<Complex64>) {
        let delay_s = (0..count)
            .map(|m| match m {
                0 => 0.0,
                1 => PERIOD_S * (1.0 - 1e-9),
                _ => PERIOD_S * (0.618_033_988_749_895 * m as f64).fract(),
            })
            .collect();
        let amplitude = (0..count)
            .map(|m| Complex64::from_polar(1.0 + (m % 7) as f64, 2.4 * (m * m % 1009) as f64))
            .collect();
        (delay_s, amplitude)
    }

    fn direct(delay_s: &[f64], amplitude: &[Complex64]) -> Vec<Complex64> {
        (0..BINS)
            .map(|q| {
                let k = q as f64 - (BINS / 2) as f64;
                delay_s
                    .iter()
                    .zip(amplitude)
                    .map(|(u, c)| {
                        let turns = k * u / PERIOD_S;
                        c * Complex64::from_polar(1.0, -TAU * (turns - turns.round()))
                    })
                    .sum()
            })
            .collect()
    }

    /// Returns the measured error, the kernel's own error, and the amplification of rounding.
    fn error<T: Real + Into<f64>>(
        width: usize,
        oversampling: f64,
        simd_level: SimdLevel,
    ) -> (f64, f64, f64) {
        let (delay_s, amplitude) = points(2000);
        let narrow: Vec<Complex<T>> = amplitude
            .iter()
            .map(|c| Complex::new(T::narrow(c.re), T::narrow(c.im)))
            .collect();
        let plan = Transform1d::<T>::new(BINS, PERIOD_S, width, oversampling, simd_level);
        let mut work = plan.workspace();
        let mut got = vec![Complex::new(T::zero(), T::zero()); BINS];
        assert_eq!(plan.execute(&mut work, &delay_s, &narrow, &mut got), 0);
        let want = direct(&delay_s, &amplitude);
        let (mut off, mut all) = (0.0, 0.0);
        for (g, w) in got.iter().zip(&want) {
            off += (Complex64::new(g.re.into(), g.im.into()) - w).norm_sqr();
            all += w.norm_sqr();
        }
        let kernel = plan.kernel();
        ((off / all).sqrt(), kernel.error, kernel.amplification())
    }

    /// Checks that the error over 2000 points is within a third of the kernel's prediction, plus
    /// rounding: `unit` times the amplification.
    fn meets_prediction<T: Real + Into<f64>>(unit: f64) {
        for oversampling in [1.25, 1.5, 2.0] {
            for width in crate::array::gridded::kernel::MIN_WIDTH..=14 {
                let (got, predicted, growth) = error::<T>(width, oversampling, SimdLevel::best());
                let floor = unit * growth;
                println!(
                    "sigma {oversampling} width {width}: {got:.2e}, predicted {predicted:.2e}"
                );
                assert!(
                    got < 1.3 * predicted + floor && got > 0.5 * predicted - floor,
                    "sigma {oversampling} width {width}: {got:e}, predicted {predicted:e}"
                );
            }
        }
    }

    // Amplitudes, positions and sums each round at 6e-8.
    #[test]
    fn f32_errors_are_the_kernels_and_rounding() {
        meets_prediction::<f32>(1.5e-7);
    }

    // 192 bins: delays round at 1e-14 of a turn.
    #[test]
    fn f64_errors_are_the_kernels_and_rounding() {
        meets_prediction::<f64>(1e-14);
    }

    #[test]
    fn every_simd_level_meets_5e_7_and_1e_12() {
        for simd_level in SimdLevel::available() {
            let (single, ..) = error::<f32>(7, 2.0, simd_level);
            let (double, ..) = error::<f64>(14, 2.0, simd_level);
            assert!(
                single < 5e-7 && double < 1e-12,
                "{simd_level:?}: {single:e}, {double:e}"
            );
        }
    }

    #[test]
    fn points_outside_the_period_are_counted_and_omitted() {
        let plan = Transform1d::<f64>::new(BINS, PERIOD_S, 8, 2.0, SimdLevel::best());
        let mut work = plan.workspace();
        let mut out = vec![Complex64::ZERO; BINS];
        let delay_s = [-1e-9, PERIOD_S * 1.01, f64::NAN, f64::INFINITY, -1e300];
        let amplitude = [Complex64::ONE; 5];
        assert_eq!(plan.execute(&mut work, &delay_s, &amplitude, &mut out), 5);
        assert!(out.iter().all(|x| *x == Complex64::ZERO));
    }

    #[test]
    fn grid_sizes_are_close_to_the_requested_size() {
        for least in 4..20_000 {
            let got = grid_size(least);
            assert!(
                got >= least && got as f64 <= 1.34 * least as f64,
                "{least}: {got}"
            );
        }
        assert_eq!(grid_size(12_288), 12_288);
        assert_eq!(grid_size(7_680), 7_680);
    }
}
