//! Interpolation along the line: where delays are solved, and their value, slope and bend in the middle of a block of elements.

use std::f64::consts::PI;

use crate::echo::walk::{GAIN_NODES, MAX_NODES};

/// Weights of the nodes for one block.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct BlockWeights {
    pub value: [f64; MAX_NODES],
    /// Per element.
    pub slope: [f64; MAX_NODES],
    /// Half the second derivative, per element squared.
    pub bend: [f64; MAX_NODES],
    /// Weights of the gain nodes, and their change per element.
    pub gain: [f32; GAIN_NODES],
    pub gain_slope: [f32; GAIN_NODES],
}

/// Chebyshev nodes on -1..1, in ascending order.
pub(super) fn places(nodes: usize) -> Vec<f64> {
    (0..nodes)
        .map(|k| -libm::cos(PI * (2 * k + 1) as f64 / (2 * nodes) as f64))
        .collect()
}

/// Values of the Lagrange polynomials of `nodes` at `x`, with their first and second derivatives.
fn lagrange(nodes: &[f64], x: f64) -> [Vec<f64>; 3] {
    let mut out = [const { Vec::new() }; 3];
    for (k, node) in nodes.iter().enumerate() {
        // Product of (x - other)/(node - other), with its derivatives.
        let (mut value, mut first, mut second) = (1.0, 0.0, 0.0);
        for (_, other) in nodes.iter().enumerate().filter(|(other, _)| *other != k) {
            let per = 1.0 / (node - other);
            let factor = (x - other) * per;
            second = second * factor + 2.0 * first * per;
            first = first * factor + value * per;
            value *= factor;
        }
        out[0].push(value);
        out[1].push(first);
        out[2].push(second);
    }
    out
}

/// Weights at `x` half lines from the centre; an element is `per_element` half lines long.
pub(super) fn block_weights(nodes: &[f64], x: f64, per_element: f64) -> BlockWeights {
    let [value, first, second] = lagrange(nodes, x);
    let gains: Vec<f64> = (0..GAIN_NODES)
        .map(|k| nodes[k * (nodes.len() - 1) / 2])
        .collect();
    let [gain, gain_slope, _] = lagrange(&gains, x);
    let fill = |from: &[f64], scale: f64| {
        let mut to = [0.0; MAX_NODES];
        for (to, from) in to.iter_mut().zip(from) {
            *to = scale * from;
        }
        to
    };
    BlockWeights {
        value: fill(&value, 1.0),
        slope: fill(&first, per_element),
        bend: fill(&second, 0.5 * per_element * per_element),
        gain: std::array::from_fn(|k| gain[k] as f32),
        gain_slope: std::array::from_fn(|k| (gain_slope[k] * per_element) as f32),
    }
}

/// Largest error of a path length interpolated from `nodes` nodes over a line of `half_m` to either side, and quadratic over blocks of `block_m`,
/// for points at `range_m` in all directions, metres.
pub(super) fn interpolation_error_m(nodes: usize, half_m: f64, block_m: f64, range_m: f64) -> f64 {
    let places = places(nodes);
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
            let [value, _, _] = lagrange(&places, x);
            let sum: f64 = value.iter().zip(&at).map(|(a, b)| a * b).sum();
            worst = worst.max((sum - path(x * half_m)).abs());
        }
    }
    // Third order over half a block; sin cos^2 is at most 0.385.
    let half_block_m = 0.5 * block_m;
    worst + 0.385 * half_block_m.powi(3) / (2.0 * range_m * range_m)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn weights_reproduce_value_slope_and_bend_of_a_polynomial() {
        for nodes in [3, 5, 9] {
            let places = places(nodes);
            let f = |x: f64| 0.3 - 1.2 * x + 0.7 * x * x;
            for x in [-1.0, -0.2, 0.0, 0.9] {
                let weights = block_weights(&places, x, 0.01);
                let sum = |w: &[f64; MAX_NODES]| -> f64 {
                    w.iter().zip(&places).map(|(w, p)| w * f(*p)).sum()
                };
                assert!((sum(&weights.value) - f(x)).abs() < 1e-12);
                assert!((sum(&weights.slope) - 0.01 * (-1.2 + 1.4 * x)).abs() < 1e-12);
                assert!((sum(&weights.bend) - 1e-4 * 0.7).abs() < 1e-12);
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
