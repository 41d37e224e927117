//! Columns of the grid: echoes of any Doppler as weighted sums of echoes of a few.
//!
//! With u = 2w/T, |w| < T/2, an echo with a stretch x steps from that of a column is the column's echo times exp(j x turn g), g = u + wide u^2. A sweep
//! makes the difference `wide`: half its bandwidth over the carrier. The weights on the nearest columns are the least-squares solution over g.
//!
//! The change of an echo's Doppler during the pulse (t' = s + q s^2) adds a phase in proportion to u^2 (1 + v), where v is any frequency that sounds
//! at u over the carrier. Weights on columns make u^2 (1 + v)^2 of it to first order, which is too much by v at the ends of the pulse, where all
//! frequencies sound. The engine delays the whole echo by q T^2/4, which takes that away. A second set of weights, times the phase at the ends, is
//! the rest, u^2 + wide (u^3 + u). It needs three columns, and complex weights with a sweep.

use std::iter::Sum;
use std::ops::{AddAssign, Div, Mul, Sub, SubAssign};

use num_complex::Complex64;

use super::polynomials::{chebyshev_nodes, lagrange_powers};

/// Maximum number of columns of one echo.
pub(super) const MAX_TAPS: usize = 4;
/// Coefficients of a weight as a polynomial of the place between columns; error 1e-6.
pub(super) const WEIGHT_TERMS: usize = 6;

/// Mean of u^2 over the pulse, which the second weights leave out.
pub(super) const MEAN_CURVATURE: f64 = 1.0 / 3.0;
/// Frequencies over the carrier, up to which columns have the places of those of the carrier: margins include what these add at the ends of the pulse.
const NARROW: f64 = 0.1;
/// Instants of the pulse at which the change of the Doppler is fitted, and places between columns at which the error is taken.
const INSTANTS: usize = 64;
const PLACES: usize = 16;

/// Columns a step apart, and the weights of an echo on `taps` of them.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Columns {
    pub taps: usize,
    /// Phase at the ends of the pulse between neighbouring columns, radians.
    pub turn_rad: f64,
    /// The same of the highest frequency, which the weights are fitted to.
    pub end_rad: f64,
    /// rms error of echoes at all places between columns.
    pub error: f64,
    /// `[tap][power]` of the distance from the middle of the taps, -1/2..1/2.
    pub weights: [[f64; WEIGHT_TERMS]; MAX_TAPS],
    /// The change of the Doppler during the pulse.
    pub curvature: CurvatureFit,
}

/// What columns depend on besides the error.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Band {
    /// Half the bandwidth of a sweep over the carrier, negative if it falls.
    pub wide: f64,
    /// Highest frequency that the ends of the pulse have, over the carrier.
    pub highest: f64,
    /// With weights of the change of the Doppler during the pulse.
    pub models_curvature: bool,
}

/// Weights of the change of the Doppler during the pulse, for a phase of 1 rad at the ends.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct CurvatureFit {
    /// Imaginary and real parts, as [`Columns::weights`].
    pub imaginary: [[f64; WEIGHT_TERMS]; MAX_TAPS],
    pub real: [[f64; WEIGHT_TERMS]; MAX_TAPS],
    /// What they leave out to first order: rms over the pulse and over all places between columns, and the largest of any instant over that.
    pub rms: f64,
    pub end: f64,
}

/// Mean of exp(j phase 2w/T) over the pulse.
fn mean(phase_rad: f64) -> f64 {
    if phase_rad.abs() < 1e-6 {
        return 1.0;
    }
    libm::sin(phase_rad) / phase_rad
}

/// Place of column `k` of `taps` from their middle, steps.
fn place(taps: usize, k: usize) -> f64 {
    k as f64 - 0.5 * (taps as f64 - 1.0)
}

/// Least-squares weights of an echo at `x` from the middle of the taps, and the energy that they leave out.
fn fit(taps: usize, turn_rad: f64, x: f64) -> ([f64; MAX_TAPS], f64) {
    let mut matrix = [[0.0; MAX_TAPS]; MAX_TAPS];
    let mut right = [0.0; MAX_TAPS];
    for i in 0..taps {
        right[i] = mean((x - place(taps, i)) * turn_rad);
        for (k, cell) in matrix[i][..taps].iter_mut().enumerate() {
            *cell = mean((place(taps, i) - place(taps, k)) * turn_rad);
        }
    }
    let weights = solve(taps, matrix, right);
    let kept: f64 = weights.iter().zip(&right).map(|(a, b)| a * b).sum();
    (weights, (1.0 - kept).max(0.0))
}

/// Solution of the normal equations of `taps` columns.
fn solve<T>(
    taps: usize,
    mut matrix: [[T; MAX_TAPS]; MAX_TAPS],
    mut right: [T; MAX_TAPS],
) -> [T; MAX_TAPS]
where
    T: Copy
        + From<f64>
        + AddAssign
        + SubAssign
        + Sum
        + Mul<Output = T>
        + Sub<Output = T>
        + Div<Output = T>,
{
    for (i, row) in matrix.iter_mut().enumerate() {
        row[i] += T::from(1e-12);
    }
    for i in 0..taps {
        let pivot = matrix[i];
        for row in i + 1..taps {
            let factor = matrix[row][i] / pivot[i];
            for (cell, p) in matrix[row].iter_mut().zip(pivot) {
                *cell -= factor * p;
            }
            let known = factor * right[i];
            right[row] -= known;
        }
    }
    let mut weights = [T::from(0.0); MAX_TAPS];
    for i in (0..taps).rev() {
        let known: T = (i + 1..taps).map(|k| matrix[i][k] * weights[k]).sum();
        weights[i] = (right[i] - known) / matrix[i][i];
    }
    weights
}

/// Least-squares weights of the change of the Doppler of an echo at `x` from the middle of the taps, with the energy that they leave out and the largest
/// error of an instant.
fn fit_curvature(
    taps: usize,
    turn_rad: f64,
    wide: f64,
    x: f64,
) -> ([Complex64; MAX_TAPS], f64, f64) {
    let mut matrix = [[Complex64::ZERO; MAX_TAPS]; MAX_TAPS];
    let mut right = [Complex64::ZERO; MAX_TAPS];
    let instants: [_; INSTANTS] = std::array::from_fn(|k| {
        let u = (2.0 * k as f64 + 1.0) / INSTANTS as f64 - 1.0;
        let rad = turn_rad * u * (1.0 + wide * u);
        let columns: [Complex64; MAX_TAPS] =
            std::array::from_fn(|k| Complex64::cis(rad * place(taps, k)));
        let left = u * u - MEAN_CURVATURE + wide * u * (u * u + 1.0);
        (columns, Complex64::cis(rad * x) * Complex64::new(0.0, left))
    });
    for (columns, wanted) in &instants {
        for i in 0..taps {
            right[i] += columns[i].conj() * wanted;
            for k in 0..taps {
                matrix[i][k] += columns[i].conj() * columns[k];
            }
        }
    }
    let weights = solve(taps, matrix, right);
    let errors = instants.iter().map(|(columns, wanted)| {
        let sum: Complex64 = columns
            .iter()
            .zip(&weights[..taps])
            .map(|(a, b)| a * b)
            .sum();
        (sum - wanted).norm_sqr()
    });
    let (sum, most) = errors.fold((0.0, 0.0), |(sum, most): (f64, f64), error| {
        (sum + error, most.max(error))
    });
    (weights, sum / INSTANTS as f64, most)
}

/// Places evenly between two columns.
fn places() -> impl Iterator<Item = f64> {
    (0..PLACES).map(|k| (k as f64 + 0.5) / PLACES as f64 - 0.5)
}

/// Polynomials through the weights at Chebyshev nodes.
fn polynomials(
    taps: usize,
    weights_at: impl Fn(f64) -> [f64; MAX_TAPS],
) -> [[f64; WEIGHT_TERMS]; MAX_TAPS] {
    let nodes = chebyshev_nodes::<WEIGHT_TERMS>().map(|z| 0.5 * z);
    let mut weights = [[0.0; WEIGHT_TERMS]; MAX_TAPS];
    for (node, powers) in nodes.iter().zip(lagrange_powers(&nodes)) {
        for (weight, value) in weights[..taps].iter_mut().zip(weights_at(*node)) {
            for (weight, power) in weight.iter_mut().zip(powers) {
                *weight += value * power;
            }
        }
    }
    weights
}

/// rms error over all places.
fn error(taps: usize, turn_rad: f64) -> f64 {
    let sum: f64 = places().map(|x| fit(taps, turn_rad, x).1).sum();
    (sum / PLACES as f64).sqrt()
}

impl Columns {
    /// A single column, for echoes without Doppler.
    pub(super) fn one() -> Self {
        let mut weights = [[0.0; WEIGHT_TERMS]; MAX_TAPS];
        weights[0][0] = 1.0;
        Self {
            taps: 1,
            turn_rad: 0.0,
            end_rad: 0.0,
            error: 0.0,
            weights,
            curvature: CurvatureFit::NONE,
        }
    }

    /// The widest step with `taps` taps whose rms error is at most `tolerance`.
    pub(super) fn fit(taps: usize, tolerance: f64, band: Band) -> Self {
        let (mut low, mut high) = (1e-4, 3.0);
        for _ in 0..40 {
            let middle = 0.5 * (low + high);
            if error(taps, middle) <= tolerance {
                low = middle;
            } else {
                high = middle;
            }
        }
        // Of the highest frequency.
        let end_rad = low;
        let turn_rad = match band.highest <= NARROW {
            true => end_rad,
            false => end_rad / (1.0 + band.highest),
        };
        Self {
            taps,
            turn_rad,
            end_rad,
            error: error(taps, end_rad),
            weights: polynomials(taps, |x| fit(taps, end_rad, x).0),
            curvature: match taps > 2 && band.models_curvature {
                true => CurvatureFit::new(taps, turn_rad, band.wide),
                false => CurvatureFit::NONE,
            },
        }
    }

    /// Places of the columns, steps from the middle of the taps, with their weights for an echo at `x` from there.
    pub(super) fn weights_at(&self, x: f64) -> Vec<(f64, f64)> {
        let weight =
            |terms: &[f64; WEIGHT_TERMS]| terms.iter().rev().fold(0.0, |sum, c| sum * x + c);
        let taps = self.weights[..self.taps].iter().enumerate();
        taps.map(|(k, terms)| (place(self.taps, k), weight(terms)))
            .collect()
    }
}

impl CurvatureFit {
    const NONE: Self = Self {
        imaginary: [[0.0; WEIGHT_TERMS]; MAX_TAPS],
        real: [[0.0; WEIGHT_TERMS]; MAX_TAPS],
        rms: 0.0,
        end: 1.0,
    };

    fn new(taps: usize, turn_rad: f64, wide: f64) -> Self {
        let (mut energy, mut ends) = (0.0, 0.0);
        for x in places() {
            let (_, mean, end) = fit_curvature(taps, turn_rad, wide, x);
            energy += mean;
            ends += end;
        }
        let weights = |part: fn(Complex64) -> f64| {
            polynomials(taps, |x| fit_curvature(taps, turn_rad, wide, x).0.map(part))
        };
        Self {
            imaginary: weights(|weight| weight.im),
            real: match wide == 0.0 {
                // By symmetry.
                true => [[0.0; WEIGHT_TERMS]; MAX_TAPS],
                false => weights(|weight| weight.re),
            },
            rms: (energy / PLACES as f64).sqrt(),
            end: (ends / energy).sqrt(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn weighted_columns_are_the_echo_within_the_tolerance() {
        for taps in 1..=MAX_TAPS {
            for tolerance in [1e-2, 1e-3, 1e-4] {
                let columns = Columns::fit(taps, tolerance, Band::default());
                let (mut off, mut count) = (0.0, 0.0);
                for place in 0..40 {
                    let x = f64::from(place) / 39.0 - 0.5;
                    let weights = columns.weights_at(x);
                    for w in 0..200 {
                        let w = (f64::from(w) + 0.5) / 100.0 - 1.0;
                        let (mut re, mut im) = (0.0, 0.0);
                        for (at, weight) in &weights {
                            let phase = at * columns.turn_rad * w;
                            re += weight * phase.cos();
                            im += weight * phase.sin();
                        }
                        let phase = x * columns.turn_rad * w;
                        off += (re - phase.cos()).powi(2) + (im - phase.sin()).powi(2);
                        count += 1.0;
                    }
                }
                let measured = f64::sqrt(off / count);
                println!(
                    "{taps} taps, {tolerance:e}: {:.3} rad, {measured:.2e}",
                    columns.turn_rad
                );
                assert!(measured < 1.15 * tolerance, "{taps}: {measured:e}");
                assert!(measured > 0.5 * tolerance, "{taps}: {measured:e}");
            }
        }
    }
}
