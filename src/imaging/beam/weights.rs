//! Weightings along an aperture (shading) or along a pulse (side lobes of the compressed pulse).
//!
//! A weighting is an even function of the position x along the aperture, from -1/2 to 1/2. [`fill`] samples it at the centres of equal
//! intervals, so that every element has a non-zero weight. The Dolph-Chebyshev weighting is defined for a number of elements and is not a
//! function of x. Along a pulse, the Taylor weighting with equal side lobes, its continuous counterpart, replaces it.
//!
//! Sources: Taylor 1955 (n-bar from his condition of a continuous main lobe), Dolph 1946, Kaiser 1974.

use std::f64::consts::{PI, TAU};

use echotank_config::spec::Shading;

/// Maximum number of terms of a Taylor weighting; side lobes of 80 dB need 20.
const MAX_TERMS: usize = 32;
/// Minimum number of near-in side lobes that a Taylor weighting levels.
const MIN_NBAR: usize = 4;

/// A weighting as a function of position.
#[derive(Clone, Copy, Debug)]
#[expect(
    clippy::large_enum_variant,
    reason = "short-lived on the stack, and the ping path must not allocate"
)]
pub(super) enum Taper {
    Uniform,
    /// a + (1 - a) cos(2 pi x).
    RaisedCosine(f64),
    /// 1 + 2 sum F_m cos(2 pi m x), m from 1.
    Taylor([f64; MAX_TERMS]),
    Kaiser(f64),
}

impl Taper {
    pub(super) fn new(shading: Shading) -> Self {
        match shading {
            Shading::Uniform => Self::Uniform,
            Shading::Hann => Self::RaisedCosine(0.5),
            Shading::Hamming => Self::RaisedCosine(0.54),
            Shading::Taylor { side_lobe_db } | Shading::Chebyshev { side_lobe_db } => {
                Self::Taylor(taylor_terms(side_lobe_db))
            }
            Shading::Kaiser { beta } => Self::Kaiser(beta),
        }
    }

    /// Weight at `x` from -1/2 to 1/2; outside, the weight at the nearer end.
    pub(super) fn at(&self, x: f64) -> f64 {
        let x = x.clamp(-0.5, 0.5);
        match self {
            Self::Uniform => 1.0,
            Self::RaisedCosine(a) => a + (1.0 - a) * (TAU * x).cos(),
            Self::Taylor(terms) => {
                // Clenshaw's recurrence: one cosine for all terms, of which the last are zero.
                let twice = 2.0 * (TAU * x).cos();
                let (mut next, mut after) = (0.0, 0.0);
                for f in terms.iter().rev().skip_while(|f| **f == 0.0) {
                    (next, after) = (f + twice * next - after, next);
                }
                1.0 + twice * next - 2.0 * after
            }
            Self::Kaiser(beta) => {
                bessel_i0(beta * (1.0 - 4.0 * x * x).max(0.0).sqrt()) / bessel_i0(*beta)
            }
        }
    }
}

/// Fills `weights` for equally spaced elements, without normalisation.
pub fn fill(shading: Shading, weights: &mut [f64]) {
    if let Shading::Chebyshev { side_lobe_db } = shading {
        return chebyshev(side_lobe_db, weights);
    }
    let taper = Taper::new(shading);
    let count = weights.len() as f64;
    for (n, w) in weights.iter_mut().enumerate() {
        *w = taper.at((n as f64 + 0.5) / count - 0.5);
    }
}

/// Equal side lobes `side_lobe_db` (positive) below the main lobe: inverse transform of a Chebyshev polynomial.
fn chebyshev(side_lobe_db: f64, weights: &mut [f64]) {
    let n = weights.len();
    if n < 2 {
        return weights.fill(1.0);
    }
    let order = (n - 1) as f64;
    let ratio = 10f64.powf(side_lobe_db / 20.0);
    let stretch = (ratio.acosh() / order).cosh();
    let polynomial = |x: f64| match x.abs() <= 1.0 {
        true => (order * x.acos()).cos(),
        false => (order * x.abs().acosh()).cosh(),
    };
    for (i, w) in weights.iter_mut().enumerate() {
        let place = i as f64 - 0.5 * order;
        let term = |k: usize| {
            let angle = PI * k as f64 / n as f64;
            polynomial(stretch * angle.cos()) * (2.0 * angle * place).cos()
        };
        *w = ratio + 2.0 * (1..=(n - 1) / 2).map(term).sum::<f64>();
    }
}

fn taylor_terms(side_lobe_db: f64) -> [f64; MAX_TERMS] {
    let a = 10f64.powf(side_lobe_db / 20.0).acosh() / PI;
    let nbar = ((2.0 * a * a + 0.5).ceil() as usize).clamp(MIN_NBAR, MAX_TERMS);
    let zero = |n: usize| a * a + (n as f64 - 0.5).powi(2);
    let dilation = (nbar * nbar) as f64 / zero(nbar);
    let mut terms = [0.0; MAX_TERMS];
    for (m, term) in (1..nbar).zip(&mut terms) {
        let m2 = (m * m) as f64;
        let above: f64 = (1..nbar).map(|n| 1.0 - m2 / (dilation * zero(n))).product();
        let below: f64 = (1..nbar)
            .filter(|&n| n != m)
            .map(|n| 1.0 - m2 / (n * n) as f64)
            .product();
        let sign = if m % 2 == 1 { 1.0 } else { -1.0 };
        *term = sign * above / (2.0 * below);
    }
    terms
}

/// Modified Bessel function of the first kind, order 0, by its power series (all terms are positive, so that no digits are lost).
pub(super) fn bessel_i0(x: f64) -> f64 {
    let quarter = 0.25 * x * x;
    let (mut sum, mut term, mut k) = (1.0, 1.0, 1.0);
    while term > 1e-17 * sum {
        term *= quarter / (k * k);
        sum += term;
        k += 1.0;
    }
    sum
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Response of elements half a wavelength apart at `sine`, in dB relative to its maximum.
    fn pattern_db(weights: &[f64], sine: f64) -> f64 {
        let middle = (weights.len() as f64 - 1.0) / 2.0;
        let sum: f64 = weights
            .iter()
            .enumerate()
            .map(|(e, w)| w * (PI * (e as f64 - middle) * sine).cos())
            .sum();
        20.0 * (sum.abs() / weights.iter().sum::<f64>()).log10()
    }

    /// Levels of the local maxima outside the main lobe, from the main lobe outwards.
    fn side_lobes_db(weights: &[f64]) -> Vec<f64> {
        let steps = 400 * weights.len();
        let level: Vec<_> = (0..=steps)
            .map(|i| pattern_db(weights, i as f64 / steps as f64))
            .collect();
        level
            .windows(3)
            .filter(|w| w[1] > w[0] && w[1] >= w[2])
            .map(|w| w[1])
            .collect()
    }

    fn weights(shading: Shading, n: usize) -> Vec<f64> {
        let mut w = vec![0.0; n];
        fill(shading, &mut w);
        w
    }

    #[test]
    fn chebyshev_side_lobes_all_have_the_specified_level() {
        for (n, side_lobe_db) in [(8, 20.0), (16, 30.0), (33, 35.0), (128, 40.0)] {
            let lobes = side_lobes_db(&weights(Shading::Chebyshev { side_lobe_db }, n));
            assert!(lobes.len() + 2 >= n / 2, "{n}: {} lobes", lobes.len());
            let worst = lobes
                .iter()
                .fold(0.0_f64, |w, l| w.max((l + side_lobe_db).abs()));
            assert!(worst < 0.02, "{n} elements: {worst:.3} dB off");
        }
    }

    #[test]
    fn taylor_side_lobes_begin_at_the_specified_level_and_fall() {
        for side_lobe_db in [25.0, 30.0, 35.0, 40.0] {
            let lobes = side_lobes_db(&weights(Shading::Taylor { side_lobe_db }, 256));
            // Taylor's method moves zeros, not lobe levels: the first lobe lies within 0.5 dB.
            assert!(
                (lobes[0] + side_lobe_db).abs() < 0.6,
                "{side_lobe_db}: {lobes:?}"
            );
            assert!(lobes[60] < lobes[0] - 12.0);
        }
    }

    /// Transform of the Kaiser window: sinh(s)/s, s = sqrt(beta^2 - (pi u)^2), with u in side-lobe widths of a line of that length.
    #[test]
    fn kaiser_pattern_is_its_closed_form() {
        for beta in [3.0, 6.0, 9.0_f64] {
            let w = weights(Shading::Kaiser { beta }, 512);
            for step in 0..60 {
                let u = step as f64 * 0.1;
                let s2 = beta * beta - (PI * u).powi(2);
                let closed = match s2 > 0.0 {
                    true => s2.sqrt().sinh() / s2.sqrt(),
                    false => (-s2).sqrt().sin() / (-s2).sqrt().max(1e-12),
                };
                let want = closed * beta / beta.sinh();
                let got = 10f64.powf(pattern_db(&w, 2.0 * u / 512.0) / 20.0);
                assert!(
                    (got - want.abs()).abs() < 2e-4,
                    "beta {beta}, u {u}: {got} want {want}"
                );
            }
        }
    }

    #[test]
    fn the_largest_hamming_side_lobe_is_42p7_db_down() {
        let greatest = side_lobes_db(&weights(Shading::Hamming, 256))
            .into_iter()
            .fold(f64::NEG_INFINITY, f64::max);
        assert!((greatest + 42.7).abs() < 0.4, "{greatest:.2}");
    }

    #[test]
    fn every_weighting_is_even_positive_and_finite_for_any_number_of_elements() {
        for shading in [
            Shading::Uniform,
            Shading::Hann,
            Shading::Hamming,
            Shading::Taylor { side_lobe_db: 35.0 },
            Shading::Chebyshev { side_lobe_db: 35.0 },
            Shading::Kaiser { beta: 6.0 },
        ] {
            for n in [1, 2, 3, 7, 64, 129] {
                let w = weights(shading, n);
                let most = w.iter().copied().fold(0.0, f64::max);
                for k in 0..n {
                    assert!(w[k] > 0.0 && w[k].is_finite(), "{shading:?} {n}: {w:?}");
                    assert!((w[k] - w[n - 1 - k]).abs() < 1e-9 * most, "{shading:?} {n}");
                }
            }
        }
    }
}
