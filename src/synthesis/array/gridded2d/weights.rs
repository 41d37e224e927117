//! Tables of kernel weights.

use crate::array::gridded::kernel::{Kernel, MAX_WIDTH};

use super::lanes::BLOCK;
use super::pulse::chebyshev_nodes;
use super::sample::Sample;
use super::series::powers_from_nodes;

/// 1/D of a kernel as a polynomial in the square of the frequency.
pub(crate) struct InverseGain {
    /// Coefficients in powers of 2 (nu/greatest)^2 - 1.
    powers: [f64; INVERSE_TERMS],
    scale: f64,
}

/// Terms of [`InverseGain`]: error 1e-11 for the widest kernel.
const INVERSE_TERMS: usize = 16;

impl InverseGain {
    pub(super) fn new(kernel: &Kernel) -> Self {
        // Slightly beyond the band, for differences at its end.
        let greatest = 0.5 / kernel.oversampling + 0.01;
        let matrix = powers_from_nodes(INVERSE_TERMS);
        let values: Vec<f64> = chebyshev_nodes(INVERSE_TERMS)
            .map(|x| 1.0 / kernel.window_gain((0.5 * (x + 1.0)).sqrt() * greatest))
            .collect();
        let mut powers = [0.0; INVERSE_TERMS];
        for (power, row) in powers.iter_mut().zip(matrix.chunks(INVERSE_TERMS)) {
            *power = row.iter().zip(&values).map(|(a, b)| a * b).sum();
        }
        Self {
            powers,
            scale: 2.0 / (greatest * greatest),
        }
    }

    #[inline(always)]
    pub(super) fn at(&self, nu: f64) -> f64 {
        let x = nu * nu * self.scale - 1.0;
        self.powers.iter().rev().fold(0.0, |sum, c| sum * x + c)
    }

    #[inline(always)]
    pub(super) fn block<T: Sample, const FUSED: bool>(
        &self,
        nu: impl Fn(usize) -> f64,
    ) -> [T; BLOCK] {
        let mut x = [T::ZERO; BLOCK];
        for (lane, x) in x.iter_mut().enumerate() {
            *x = T::narrow(nu(lane) * nu(lane) * self.scale - 1.0);
        }
        let mut sum = [T::ZERO; BLOCK];
        for c in self.powers.iter().rev() {
            let c = T::narrow(*c);
            for lane in 0..BLOCK {
                sum[lane] = sum[lane].times_plus::<FUSED>(x[lane], c);
            }
        }
        sum
    }
}

/// Weights of all taps for one power of x.
pub(super) type Taps<T> = [T; MAX_WIDTH];

pub(crate) fn tap_tables<T: Sample>(kernel: &Kernel) -> Vec<Taps<T>> {
    (0..kernel.moments)
        .map(|k| {
            let mut taps = [T::ZERO; MAX_WIDTH];
            for (i, tap) in taps[..kernel.width].iter_mut().enumerate() {
                *tap = T::narrow(kernel.weight(k, i));
            }
            taps
        })
        .collect()
}

/// Weights of all taps at `x`, -1..1 across the cell.
#[inline(always)]
pub(super) fn taps<T: Sample, const FUSED: bool>(tables: &[Taps<T>], x: T) -> Taps<T> {
    let mut sum = [T::ZERO; MAX_WIDTH];
    for k in (0..tables.len()).rev() {
        let table = tables[k];
        for i in 0..MAX_WIDTH {
            sum[i] = sum[i].times_plus::<FUSED>(x, table[i]);
        }
    }
    sum
}
