//! Polynomials through values at a few points, by powers.

use std::f64::consts::PI;

/// Chebyshev nodes on -1..1, in descending order.
pub(super) fn chebyshev_nodes<const N: usize>() -> [f64; N] {
    std::array::from_fn(|k| libm::cos(PI * (k as f64 + 0.5) / N as f64))
}

/// Coefficients of the Lagrange polynomial of each of the `nodes`, by powers: `[node][power]`.
pub(super) fn lagrange_powers<const N: usize>(nodes: &[f64; N]) -> [[f64; N]; N] {
    std::array::from_fn(|k| {
        let mut powers = [0.0; N];
        powers[0] = 1.0;
        for other in (0..N).filter(|&other| other != k) {
            let per = 1.0 / (nodes[k] - nodes[other]);
            for power in (0..N).rev() {
                let below = if power > 0 { powers[power - 1] } else { 0.0 };
                powers[power] = (below - nodes[other] * powers[power]) * per;
            }
        }
        powers
    })
}
