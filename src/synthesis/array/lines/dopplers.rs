//! Columns of the grid: echoes of any Doppler as weighted sums of echoes of a few.
//!
//! About mid-pulse, an echo with a stretch x steps from that of a column is the column's echo times exp(j x turn 2w/T), |w| < T/2. The
//! weights on the nearest columns are the least-squares solution over the pulse.
//!
//! The change of an echo's Doppler during the pulse adds a phase in proportion to (2w/T)^2. A second set of weights, times j and that phase at the ends,
//! is this to first order. It needs three columns.

use super::polynomials::{chebyshev_nodes, lagrange_powers};

/// Maximum number of columns of one echo.
pub(super) const MAX_TAPS: usize = 4;
/// Coefficients of a weight as a polynomial of the place between columns; error 1e-6.
pub(super) const WEIGHT_TERMS: usize = 6;

/// Mean of (2w/T)^2 over the pulse, which the second weights leave out.
pub(super) const MEAN_CURVATURE: f64 = 1.0 / 3.0;

/// Columns a step apart, and the weights of an echo on `taps` of them.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Columns {
    pub taps: usize,
    /// Phase at the ends of the pulse between neighbouring columns, radians.
    pub turn_rad: f64,
    /// rms error of echoes at all places between columns.
    pub error: f64,
    /// `[tap][power]` of the distance from the middle of the taps, -1/2..1/2.
    pub weights: [[f64; WEIGHT_TERMS]; MAX_TAPS],
    /// The same for the echo times (2w/T)^2 less its mean.
    pub curvature_weights: [[f64; WEIGHT_TERMS]; MAX_TAPS],
}

/// Mean of exp(j phase 2w/T) over the pulse.
fn mean(phase_rad: f64) -> f64 {
    if phase_rad.abs() < 1e-6 {
        return 1.0;
    }
    libm::sin(phase_rad) / phase_rad
}

/// Mean of (2w/T)^2 exp(j phase 2w/T) over the pulse.
fn mean_curvature(phase_rad: f64) -> f64 {
    let y = phase_rad;
    if y.abs() < 0.1 {
        // Next term y^4 / 168.
        return 1.0 / 3.0 - y * y / 10.0 + y.powi(4) / 168.0;
    }
    let (sine, cosine) = (libm::sin(y), libm::cos(y));
    sine / y + 2.0 * cosine / (y * y) - 2.0 * sine / (y * y * y)
}

/// Least-squares weights of an echo at `x` from the middle of the taps, and the energy that they leave out.
fn fit(taps: usize, turn_rad: f64, x: f64) -> ([f64; MAX_TAPS], f64) {
    let (weights, wanted) = fit_to(taps, turn_rad, x, mean);
    let kept: f64 = weights.iter().zip(&wanted).map(|(a, b)| a * b).sum();
    (weights, (1.0 - kept).max(0.0))
}

/// Least-squares weights of a signal whose mean product with a column depends on the phase between them as `product` says, and these products.
fn fit_to(
    taps: usize,
    turn_rad: f64,
    x: f64,
    product: impl Fn(f64) -> f64,
) -> ([f64; MAX_TAPS], [f64; MAX_TAPS]) {
    let at = |k: usize| k as f64 - 0.5 * (taps as f64 - 1.0);
    let mut matrix = [[0.0; MAX_TAPS]; MAX_TAPS];
    let mut right = [0.0; MAX_TAPS];
    for i in 0..taps {
        right[i] = product((x - at(i)) * turn_rad);
        for (k, cell) in matrix[i][..taps].iter_mut().enumerate() {
            *cell = mean((at(i) - at(k)) * turn_rad);
        }
        matrix[i][i] += 1e-12;
    }
    let wanted = right;
    for i in 0..taps {
        let pivot = matrix[i];
        for row in i + 1..taps {
            let factor = matrix[row][i] / pivot[i];
            for (cell, p) in matrix[row].iter_mut().zip(pivot) {
                *cell -= factor * p;
            }
            right[row] -= factor * right[i];
        }
    }
    let mut weights = [0.0; MAX_TAPS];
    for i in (0..taps).rev() {
        let known: f64 = (i + 1..taps).map(|k| matrix[i][k] * weights[k]).sum();
        weights[i] = (right[i] - known) / matrix[i][i];
    }
    (weights, wanted)
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
    const PLACES: usize = 16;
    let places = (0..PLACES).map(|k| (k as f64 + 0.5) / PLACES as f64 - 0.5);
    let sum: f64 = places.map(|x| fit(taps, turn_rad, x).1).sum();
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
            error: 0.0,
            weights,
            curvature_weights: [[0.0; WEIGHT_TERMS]; MAX_TAPS],
        }
    }

    /// The widest step with `taps` taps whose rms error is at most `tolerance`.
    pub(super) fn fit(taps: usize, tolerance: f64) -> Self {
        let (mut low, mut high) = (1e-4, 3.0);
        for _ in 0..40 {
            let middle = 0.5 * (low + high);
            if error(taps, middle) <= tolerance {
                low = middle;
            } else {
                high = middle;
            }
        }
        let turn_rad = low;
        Self {
            taps,
            turn_rad,
            error: error(taps, turn_rad),
            weights: polynomials(taps, |x| fit(taps, turn_rad, x).0),
            curvature_weights: polynomials(taps, |x| {
                let product =
                    |phase_rad| mean_curvature(phase_rad) - MEAN_CURVATURE * mean(phase_rad);
                fit_to(taps, turn_rad, x, product).0
            }),
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
                let columns = Columns::fit(taps, tolerance);
                let (mut off, mut count) = (0.0, 0.0);
                for place in 0..40 {
                    let x = f64::from(place) / 39.0 - 0.5;
                    for w in 0..200 {
                        let w = (f64::from(w) + 0.5) / 100.0 - 1.0;
                        let (mut re, mut im) = (0.0, 0.0);
                        for (k, weights) in columns.weights[..taps].iter().enumerate() {
                            let weight = weights.iter().rev().fold(0.0, |sum, c| sum * x + c);
                            let at = k as f64 - 0.5 * (taps as f64 - 1.0);
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
