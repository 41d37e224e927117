//! Interpolation along the line: where delays are solved, and their derivatives in the middle of a block of elements.

use std::f64::consts::PI;

use crate::echo::walk::{MAX_GAIN_NODES, MAX_NODES, gain_node};

use super::polynomials::{chebyshev_nodes, lagrange_powers};

/// Coefficients of the gain along a block.
pub(super) const GAIN_TERMS: usize = 4;

/// Weights of the Chebyshev coefficients of delays, and of the gain nodes, for one block.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct BlockWeights {
    /// Elements of the block that the engine computes; the last block of a line may have fewer.
    pub lanes: usize,
    pub value: [f32; MAX_NODES],
    /// Per element.
    pub slope: [f32; MAX_NODES],
    /// Half the second derivative, per element squared.
    pub curvature: [f32; MAX_NODES],
    /// A sixth of the third derivative, per element cubed.
    pub cubic: [f32; MAX_NODES],
    /// Weights of the gain nodes: a polynomial of the distance from the middle of the block in elements, by powers.
    pub gain: [[f32; MAX_GAIN_NODES]; GAIN_TERMS],
}

/// Numbers of nodes along a line.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct NodeCounts {
    /// Nodes at which delays are solved.
    pub delays: usize,
    /// Those of them that have stretch and gain.
    pub gains: usize,
}

/// Numbers of nodes to select from, in the order of their cost.
pub(super) const NODES: [NodeCounts; 7] = [
    NodeCounts {
        delays: 3,
        gains: 3,
    },
    NodeCounts {
        delays: 5,
        gains: 3,
    },
    NodeCounts {
        delays: 5,
        gains: 5,
    },
    NodeCounts {
        delays: 7,
        gains: 3,
    },
    NodeCounts {
        delays: MAX_NODES,
        gains: 3,
    },
    NodeCounts {
        delays: MAX_NODES,
        gains: 5,
    },
    // Of wide arcs.
    NodeCounts {
        delays: MAX_NODES,
        gains: MAX_GAIN_NODES,
    },
];

/// Chebyshev nodes on -1..1, in ascending order.
pub(super) fn places(nodes: usize) -> impl Iterator<Item = f64> {
    (0..nodes).map(move |k| -libm::cos(PI * (2 * k + 1) as f64 / (2 * nodes) as f64))
}

/// Values of the Lagrange polynomials of `nodes` at `x`; 0 beyond the last.
fn lagrange(nodes: &[f64], x: f64) -> [f64; MAX_NODES] {
    let mut out = [0.0; MAX_NODES];
    for (k, node) in nodes.iter().enumerate() {
        let others = nodes.iter().enumerate().filter(|(other, _)| *other != k);
        out[k] = others
            .map(|(_, other)| (x - other) / (node - other))
            .product();
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

/// Weights of a block of so many `lanes` about `x` half lines from the centre for gains at `gain_nodes` of the `nodes`; an element is `per_element` half
/// lines long.
pub(super) fn block_weights(
    nodes: &[f64],
    gain_nodes: usize,
    lanes: usize,
    x: f64,
    per_element: f64,
) -> BlockWeights {
    let all = chebyshev(x);
    let mut gains = [0.0; MAX_GAIN_NODES];
    for (k, at) in gains[..gain_nodes].iter_mut().enumerate() {
        *at = nodes[gain_node(k, gain_nodes, nodes.len())];
    }
    // Cubic through four points of the block.
    let points = chebyshev_nodes::<GAIN_TERMS>().map(|z| z * 0.5 * lanes as f64);
    let mut gain = [[0.0f64; MAX_GAIN_NODES]; GAIN_TERMS];
    for (point, powers) in points.iter().zip(lagrange_powers(&points)) {
        let values = lagrange(&gains[..gain_nodes], x + point * per_element);
        for (terms, power) in gain.iter_mut().zip(powers) {
            for (term, value) in terms.iter_mut().zip(values) {
                *term += power * value;
            }
        }
    }
    let fill = |derivative: usize, scale: f64| all.map(|at| (scale * at[derivative]) as f32);
    BlockWeights {
        lanes,
        value: fill(0, 1.0),
        slope: fill(1, per_element),
        curvature: fill(2, 0.5 * per_element * per_element),
        cubic: fill(3, per_element.powi(3) / 6.0),
        gain: gain.map(|terms| terms.map(|term| term as f32)),
    }
}

/// Relative error of the gains of elements `element_m` long, interpolated from `gain_nodes` nodes over a line of `half_m` to either side, and cubic
/// over blocks of `block_m`, for points at `range_m`: rms over all directions, at the worst element.
///
/// The pattern is a mean of exp(j t x) over |t| < 1, of x = pi u `element_m`/lambda, so that the rms of its derivative of order n is 1/sqrt(2n + 1).
/// Along an arc u changes with the normal too, by at most 1/R per metre.
pub(super) fn gain_error(
    gain_nodes: usize,
    [element_m, wavelength_m]: [f64; 2],
    (half_m, radius_m): (f64, Option<f64>),
    block_m: f64,
    range_m: f64,
) -> f64 {
    let turn_per_m = 1.0 / range_m + radius_m.map_or(0.0, |radius_m| 1.0 / radius_m);
    let per_m = PI * element_m / wavelength_m * turn_per_m;
    let (line, block) = (per_m * half_m, per_m * 0.5 * block_m);
    // Largest product of the distances from the nodes, over the factorial of their number.
    let of_line = match gain_nodes {
        3 => 0.06 * line.powi(3) / 7f64.sqrt(),
        5 => 5.4e-4 * line.powi(5) / 11f64.sqrt(),
        _ => 1.1e-8 * line.powi(9) / 19f64.sqrt(),
    };
    let of_block = match gain_nodes {
        // A quadratic.
        3 => 0.0,
        _ => block.powi(4) / (8.0 * 24.0 * 3.0),
    };
    // What the leading terms leave out.
    1.1 * (of_line + of_block)
}

/// Relative error of the spreading along the receive leg, interpolated and fitted as in [`gain_error`]: largest over all directions and elements.
///
/// With the sine s of the direction and e = y/r, 1/sqrt(1 - 2 e s + e^2) is the sum of e^n P_n(s) with Legendre polynomials (their generating function),
/// which are at most 1.
pub(super) fn spreading_error(gain_nodes: usize, half_m: f64, block_m: f64, range_m: f64) -> f64 {
    let line = half_m / range_m;
    if line >= 1.0 {
        return f64::INFINITY;
    }
    // Largest product of the distances from the nodes.
    let of_line = match gain_nodes {
        3 => 0.385 * line.powi(3),
        5 => 0.09 * line.powi(5),
        _ => line.powi(9) / 256.0,
    };
    // A cubic about the middle of the outermost block, which may be nearer.
    let nearest_m = range_m - f64::max(half_m - 0.5 * block_m, 0.0);
    let block = 0.5 * block_m / nearest_m;
    let of_block = match gain_nodes {
        3 => 0.0,
        _ if block >= 1.0 => f64::INFINITY,
        _ => range_m / nearest_m * block.powi(4) / 8.0 / (1.0 - block),
    };
    of_line / (1.0 - line) + of_block
}

/// The first, the middle and the last of some nodes: enough for echoes from farther away, with squares of receive legs between them.
pub(super) fn coarse(nodes: &[f64]) -> [f64; COARSE] {
    [nodes[0], nodes[nodes.len() / 2], nodes[nodes.len() - 1]]
}

pub(super) const COARSE: usize = 3;

/// Places along the line, in half lines, at which interpolation is examined.
const EXAMINED: usize = 17;

/// Largest errors of a path length for points at `range_m` in all directions, metres: interpolated from nodes at `places` over a line or arc of `half_m`
/// to either side, and cubic over blocks of `block_m`.
pub(super) fn interpolation_errors_m(
    places: &[f64],
    (half_m, radius_m): (f64, Option<f64>),
    block_m: f64,
    range_m: f64,
) -> [f64; 2] {
    let mut worst: f64 = 0.0;
    let examined: [f64; EXAMINED] =
        std::array::from_fn(|k| 2.0 * k as f64 / (EXAMINED - 1) as f64 - 1.0);
    let weights = examined.map(|x| lagrange(places, x));
    // Directions on one side of the boresight: all of a line's; those behind an arc, too.
    let angles = if radius_m.is_some() { 12 } else { 6 };
    for angle in 0..=angles {
        let (sine, cosine) = libm::sincos(f64::from(angle) * PI / 12.0);
        let path = |y: f64| {
            // Along the array's axis, and behind its centre.
            let (x_m, behind_m) = match radius_m {
                None => (y, 0.0),
                Some(radius_m) => {
                    let (sin, cos) = libm::sincos(0.5 * y / radius_m);
                    (2.0 * radius_m * sin * cos, 2.0 * radius_m * sin * sin)
                }
            };
            let square_m2 =
                x_m * x_m + behind_m * behind_m - 2.0 * range_m * (x_m * sine - behind_m * cosine);
            (range_m * range_m + square_m2).max(0.0).sqrt()
        };
        let at: Vec<f64> = places.iter().map(|place| path(place * half_m)).collect();
        for (x, weights) in examined.iter().zip(&weights) {
            let sum: f64 = weights.iter().zip(&at).map(|(a, b)| a * b).sum();
            worst = worst.max((sum - path(x * half_m)).abs());
        }
    }
    // Fourth order over half a block: cos^2 (5 sin^2 - 1) is at most 1. On an arc the point in the far field contributes R cos(y/R).
    let half_block_m = 0.5 * block_m;
    let of_arc = radius_m.map_or(0.0, |radius_m| {
        half_block_m.powi(4) / (24.0 * radius_m.powi(3))
    });
    [
        worst,
        of_arc + half_block_m.powi(4) / (8.0 * range_m.powi(3)),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::array::lines::spread::{LANES, lanes_for};

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
                let weights = block_weights(&places, 3, LANES, x, 0.01);
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
    fn gains_of_long_elements_have_the_errors_that_are_predicted() {
        // 40 elements of 2.5 cm at 455 kHz: sinc(x) at the element's own sine.
        let (half_m, wavelength_m, element_m) = (0.5, 3.25e-3, 0.025);
        for counts in NODES {
            for range_m in [7.0, 14.0, 30.0] {
                let nodes: Vec<f64> = places(counts.delays).collect();
                let gain = |along_m: f64, sine: f64| {
                    let x = PI * element_m / wavelength_m * (sine - along_m / range_m);
                    if x.abs() < 1e-9 { 1.0 } else { x.sin() / x }
                };
                let (mut off, mut all) = ([0.0f64; 40], 0.0);
                for k in 0..4000 {
                    let sine = f64::from(k) / 2000.0 - 1.0;
                    let at: Vec<f64> = (0..counts.gains)
                        .map(|k| gain_node(k, counts.gains, counts.delays))
                        .map(|node| gain(nodes[node] * half_m, sine))
                        .collect();
                    all += gain(0.0, sine).powi(2);
                    for block in 0..3 {
                        let lanes = lanes_for(40 - block * LANES);
                        let half = 0.5 * (lanes as f64 - 1.0);
                        let middle = (block * LANES) as f64 + half - 19.5;
                        let per_element = 0.05;
                        let weights = block_weights(
                            &nodes,
                            counts.gains,
                            lanes,
                            middle * per_element,
                            per_element,
                        );
                        for lane in 0..lanes {
                            let element = block * LANES + lane;
                            let place = lane as f64 - half;
                            let sum = weights.gain.iter().rev().fold(0.0, |sum, terms| {
                                let parts = terms.iter().zip(&at);
                                let term: f64 = parts.map(|(w, g)| f64::from(*w) * g).sum();
                                sum * place + term
                            });
                            let along_m = (element as f64 - 19.5) * 0.025;
                            off[element] += (sum - gain(along_m, sine)).powi(2);
                        }
                    }
                }
                let worst = off.iter().copied().fold(0.0, f64::max);
                let measured = (worst / all).sqrt();
                let block_m = LANES as f64 * 0.025;
                let of = [element_m, wavelength_m];
                let predicted = gain_error(counts.gains, of, (half_m, None), block_m, range_m);
                println!("{counts:?}, {range_m} m: {measured:.2e}, {predicted:.2e} predicted");
                assert!(measured < predicted && measured > 0.3 * predicted);
            }
        }
    }

    #[test]
    fn spreading_has_the_errors_that_are_predicted() {
        let (half_m, block_m) = (0.5, LANES as f64 * 0.025);
        for counts in NODES {
            let nodes: Vec<f64> = places(counts.delays).collect();
            for range_m in [1.2, 2.5, 6.0] {
                let mut measured = 0.0f64;
                for step in 0..=24 {
                    let sine = libm::sin(f64::from(step) / 24.0 * PI - 0.5 * PI);
                    let spread = |y: f64| {
                        let e = y / range_m;
                        1.0 / (1.0 - 2.0 * e * sine + e * e).sqrt()
                    };
                    let gains: Vec<f64> = (0..counts.gains)
                        .map(|k| nodes[gain_node(k, counts.gains, counts.delays)])
                        .collect();
                    for block in 0..2 {
                        let middle = (block * LANES) as f64 + 7.5 - 15.5;
                        let per_element = 0.5 * block_m / half_m / (0.5 * LANES as f64);
                        let x = middle * per_element;
                        let weights = block_weights(&nodes, counts.gains, LANES, x, per_element);
                        for lane in 0..LANES {
                            let place = lane as f64 - 7.5;
                            let sum = weights.gain.iter().rev().fold(0.0, |sum, terms| {
                                let parts = terms.iter().zip(&gains);
                                let term = parts.map(|(w, at)| f64::from(*w) * spread(at * half_m));
                                sum * place + term.sum::<f64>()
                            });
                            let along_m = (x + place * per_element) * half_m;
                            measured = measured.max((sum - spread(along_m)).abs());
                        }
                    }
                }
                let predicted = spreading_error(counts.gains, half_m, block_m, range_m);
                println!("{counts:?}, {range_m} m: {measured:.2e}, {predicted:.2e} predicted");
                // Weights are rounded to f32.
                assert!(measured < predicted + 3e-7, "{measured:e} {predicted:e}");
                assert!(
                    predicted < 10.0 * measured + 3e-7,
                    "{measured:e} {predicted:e}"
                );
            }
        }
    }

    #[test]
    fn more_nodes_and_longer_ranges_interpolate_better() {
        let error = |nodes, range_m| {
            let places: Vec<f64> = places(nodes).collect();
            let [along_m, block_m] = interpolation_errors_m(&places, (0.2, None), 0.026, range_m);
            along_m + block_m
        };
        assert!(error(5, 2.0) < 0.1 * error(3, 2.0));
        assert!(error(3, 20.0) < 0.1 * error(3, 2.0));
        assert!(error(5, 2.0) < 3e-6, "{:e}", error(5, 2.0));
    }
}
