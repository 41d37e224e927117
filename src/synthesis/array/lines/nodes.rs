//! Interpolation along the line: where delays are solved, and their derivatives in the middle of a block of elements.

use std::f64::consts::PI;

use crate::echo::walk::{GAIN_NODES, MAX_NODES};

/// Weights of the Chebyshev coefficients of delays, and of the gain nodes, for one block.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct BlockWeights {
    pub value: [f32; MAX_NODES],
    /// Per element.
    pub slope: [f32; MAX_NODES],
    /// Half the second derivative, per element squared.
    pub curvature: [f32; MAX_NODES],
    /// A sixth of the third derivative, per element cubed.
    pub cubic: [f32; MAX_NODES],
    /// Weights of the gain nodes, and their change per element.
    pub gain: [f32; GAIN_NODES],
    pub gain_slope: [f32; GAIN_NODES],
}

/// Numbers of nodes to select from.
pub(super) const NODES: [usize; 4] = [3, 5, 7, MAX_NODES];

/// Chebyshev nodes on -1..1, in ascending order.
pub(super) fn places(nodes: usize) -> impl Iterator<Item = f64> {
    (0..nodes).map(move |k| -libm::cos(PI * (2 * k + 1) as f64 / (2 * nodes) as f64))
}

/// Values of the Lagrange polynomials of `nodes` at `x`, and their derivatives; 0 beyond the last.
fn lagrange(nodes: &[f64], x: f64) -> [[f64; MAX_NODES]; 2] {
    let mut out = [[0.0; MAX_NODES]; 2];
    for (k, node) in nodes.iter().enumerate() {
        // Product of (x - other)/(node - other), with its derivative.
        let (mut value, mut first) = (1.0, 0.0);
        for (_, other) in nodes.iter().enumerate().filter(|(other, _)| *other != k) {
            let per = 1.0 / (node - other);
            let factor = (x - other) * per;
            first = first * factor + value * per;
            value *= factor;
        }
        (out[0][k], out[1][k]) = (value, first);
    }
    out
}

/// Matrix `[order][node]` from values at the nodes to the coefficients of Chebyshev polynomials, which fall with the order: in f32 they keep slopes
/// and curvatures, which values would not.
pub(super) fn coefficients(nodes: &[f64]) -> [[f64; MAX_NODES]; MAX_NODES] {
    let mut matrix = [[0.0; MAX_NODES]; MAX_NODES];
    for (order, row) in matrix[..nodes.len()].iter_mut().enumerate() {
        let scale = if order == 0 { 1.0 } else { 2.0 } / nodes.len() as f64;
        for (cell, node) in row.iter_mut().zip(nodes) {
            *cell = scale * chebyshev(*node)[order][0];
        }
    }
    matrix
}

/// Chebyshev polynomials at `x`, with their first three derivatives: `[order][derivative]`.
fn chebyshev(x: f64) -> [[f64; 4]; MAX_NODES] {
    let mut all = [[0.0; 4]; MAX_NODES];
    all[0] = [1.0, 0.0, 0.0, 0.0];
    all[1] = [x, 1.0, 0.0, 0.0];
    for k in 2..MAX_NODES {
        let (one, two) = (all[k - 1], all[k - 2]);
        all[k] = [
            2.0 * x * one[0] - two[0],
            2.0 * (one[0] + x * one[1]) - two[1],
            2.0 * (2.0 * one[1] + x * one[2]) - two[2],
            2.0 * (3.0 * one[2] + x * one[3]) - two[3],
        ];
    }
    all
}

/// Weights at `x` half lines from the centre; an element is `per_element` half lines long.
pub(super) fn block_weights(nodes: &[f64], x: f64, per_element: f64) -> BlockWeights {
    let all = chebyshev(x);
    let gains: [f64; GAIN_NODES] = std::array::from_fn(|k| nodes[k * (nodes.len() - 1) / 2]);
    let [gain, gain_slope] = lagrange(&gains, x);
    let fill = |derivative: usize, scale: f64| all.map(|at| (scale * at[derivative]) as f32);
    BlockWeights {
        value: fill(0, 1.0),
        slope: fill(1, per_element),
        curvature: fill(2, 0.5 * per_element * per_element),
        cubic: fill(3, per_element.powi(3) / 6.0),
        gain: std::array::from_fn(|k| gain[k] as f32),
        gain_slope: std::array::from_fn(|k| (gain_slope[k] * per_element) as f32),
    }
}

/// Largest error of a path length interpolated from `nodes` nodes over a line of `half_m` to either side, and cubic over blocks of `block_m`, for
/// points at `range_m` in all directions, metres.
pub(super) fn interpolation_error_m(nodes: usize, half_m: f64, block_m: f64, range_m: f64) -> f64 {
    let places: Vec<f64> = places(nodes).collect();
    let mut worst: f64 = 0.0;
    for angle in 0..=6 {
        let sine = libm::sin(f64::from(angle) * PI / 12.0);
        let path = |y: f64| {
            (range_m * range_m - 2.0 * range_m * y * sine + y * y)
                .max(0.0)
                .sqrt()
        };
        let at: Vec<f64> = places.iter().map(|place| path(place * half_m)).collect();
        for k in 0..=16 {
            let x = f64::from(k) / 8.0 - 1.0;
            let [value, _] = lagrange(&places, x);
            let sum: f64 = value.iter().zip(&at).map(|(a, b)| a * b).sum();
            worst = worst.max((sum - path(x * half_m)).abs());
        }
    }
    // Fourth order over half a block: cos^2 (5 sin^2 - 1) is at most 1.
    let half_block_m = 0.5 * block_m;
    worst + half_block_m.powi(4) / (8.0 * range_m.powi(3))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn weights_reproduce_value_and_derivatives_of_a_polynomial() {
        for nodes in [3, 5, 9] {
            let places: Vec<f64> = places(nodes).collect();
            let cubic = if nodes > 3 { 0.4 } else { 0.0 };
            let f = |x: f64| 0.3 - 1.2 * x + 0.7 * x * x + cubic * x.powi(3);
            let terms = coefficients(&places).map(|row| -> f64 {
                let parts = row.iter().zip(&places);
                parts.map(|(weight, place)| weight * f(*place)).sum()
            });
            for x in [-1.0, -0.2, 0.0, 0.9] {
                let weights = block_weights(&places, x, 0.01);
                let sum = |w: &[f32; MAX_NODES]| -> f64 {
                    w.iter().zip(&terms).map(|(w, t)| f64::from(*w) * t).sum()
                };
                // Rounded to f32.
                assert!((sum(&weights.value) - f(x)).abs() < 2e-7);
                let slope = -1.2 + 1.4 * x + 3.0 * cubic * x * x;
                assert!((sum(&weights.slope) - 0.01 * slope).abs() < 4e-9);
                let curvature = 0.7 + 3.0 * cubic * x;
                assert!((sum(&weights.curvature) - 1e-4 * curvature).abs() < 3e-11);
                assert!((sum(&weights.cubic) - 1e-6 * cubic).abs() < 1e-12);
            }
        }
    }

    #[test]
    fn more_nodes_and_longer_ranges_interpolate_better() {
        let error = |nodes, range_m| interpolation_error_m(nodes, 0.2, 0.026, range_m);
        assert!(error(5, 2.0) < 0.1 * error(3, 2.0));
        assert!(error(3, 20.0) < 0.1 * error(3, 2.0));
        assert!(error(5, 2.0) < 3e-6, "{:e}", error(5, 2.0));
    }
}
