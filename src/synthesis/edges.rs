//! Weights of the samples next to the ends of a piece of an echo, for sums that a filter follows.
//!
//! A pulse is analytic but for a few breaks: its ends, and the ends of a taper's flanks. A sum over equally spaced points misses the integral over a
//! piece between two breaks, because the breaks lie between points. The corrections here make up for it. They apply to the analytic continuation of
//! the piece at the [`END_POINTS`] points on both sides of its end. Pieces are therefore independent of each other, however short they are.
//!
//! The weights are those of collocation: for a piece that begins at a break, a distance `inside` before point 0, they satisfy
//!
//! ```text
//! sum_j c_j e^(i w j) = int_(-inside)^inf e^(i w t) dt - sum_(j>=0) e^(i w j) = i e^(-i w inside)/w - 1/(1 - e^(i w))
//! ```
//!
//! at the Chebyshev nodes of |w| <= W. Gregory's formula does so in the limit W = 0 and for points on one side. The error is even over the band: it is
//! below 1e-5 for W = 1.6, 5e-7 for 1.3 and 1e-10 for 0.7 radians per point.

/// Number of points that [`EndWeights`] weights at each end of a piece, one half on either side of it.
pub const END_POINTS: usize = 12;

const HALF: usize = END_POINTS / 2;

/// Number of powers of the distance from an end. For W = 1.6 the first one left out counts 3e-8.
const POWERS: usize = 10;

/// Bounds of the band for which weights can be computed, radians per point. Below the lower one, rounding would exceed what a smaller band gains.
const MIN_BAND: f64 = 0.4;
const MAX_BAND: f64 = 1.6;

/// Weights for one band, as polynomials in the distance of an end from a point.
#[derive(Clone, Debug, PartialEq)]
pub struct EndWeights {
    /// Coefficients of each power of `inside` - 1/2, highest first.
    coefficients: [[f64; END_POINTS]; POWERS],
}

impl EndWeights {
    /// Weights for sums of functions with up to `band` radians per point. The band is limited to a range in which weights exist.
    pub fn new(band: f64) -> Self {
        let band = band.clamp(MIN_BAND, MAX_BAND);
        let node = |k: usize| {
            let angle = std::f64::consts::PI * (2 * k + 1) as f64 / (2 * END_POINTS) as f64;
            band * libm::cos(angle)
        };
        let nodes: [f64; HALF] = std::array::from_fn(node);
        // About the middle between points -1 and 0, the weights' sums over pairs of points have cosines, their differences sines. With
        // phi = inside - 1/2, the sums meet sin(w phi)/w, the differences cos(w phi)/w - 1/(2 sin(w/2)).
        let table = |of: fn(f64) -> f64| -> [[f64; HALF]; HALF] {
            nodes.map(|w| std::array::from_fn(|m| of(w * (m as f64 + 0.5))))
        };
        let (cosines, sines) = (table(libm::cos), table(libm::sin));
        let mut coefficients = [[0.0; END_POINTS]; POWERS];
        let mut factorial = 1.0;
        for power in 0..POWERS {
            factorial *= power.max(1) as f64;
            let sign = if (power / 2) % 2 == 0 { 1.0 } else { -1.0 };
            let wanted = nodes.map(|w| {
                let term = sign * w.powi(power as i32 - 1) / factorial;
                let of_points = if power == 0 {
                    0.5 / libm::sin(0.5 * w)
                } else {
                    0.0
                };
                term - of_points
            });
            let odd = power % 2 == 1;
            let half = solve(if odd { cosines } else { sines }, wanted);
            for (m, value) in half.into_iter().enumerate() {
                let of_power = &mut coefficients[POWERS - 1 - power];
                of_power[HALF + m] = 0.5 * value;
                of_power[HALF - 1 - m] = if odd { 0.5 * value } else { -0.5 * value };
            }
        }
        Self { coefficients }
    }

    /// Corrections to the weights of points -6 to 5 from the first point inside an end, which is `inside` steps from the end, 0..1. Point -1 is the
    /// next one beyond the end.
    #[inline(always)]
    pub fn at(&self, inside: f64) -> [f64; END_POINTS] {
        let x = inside - 0.5;
        let mut weights = self.coefficients[0];
        for of_power in &self.coefficients[1..] {
            for (weight, coefficient) in weights.iter_mut().zip(of_power) {
                *weight = *weight * x + coefficient;
            }
        }
        weights
    }
}

/// Number of the first point of [`EndWeights::at`], from the first point inside the end.
pub(crate) const FIRST_POINT: f64 = -(HALF as f64);

/// Solution of a system of linear equations, by elimination with pivots.
fn solve<const N: usize>(mut a: [[f64; N]; N], mut b: [f64; N]) -> [f64; N] {
    for k in 0..N {
        let pivot = (k..N).max_by(|&i, &j| a[i][k].abs().total_cmp(&a[j][k].abs()));
        let pivot = pivot.unwrap_or(k);
        a.swap(k, pivot);
        b.swap(k, pivot);
        for i in k + 1..N {
            let factor = a[i][k] / a[k][k];
            let row = a[k];
            for (value, of_pivot) in a[i].iter_mut().zip(row) {
                *value -= factor * of_pivot;
            }
            b[i] -= factor * b[k];
        }
    }
    for k in (0..N).rev() {
        let known: f64 = (k + 1..N).map(|j| a[k][j] * b[j]).sum();
        b[k] = (b[k] - known) / a[k][k];
    }
    b
}

#[cfg(test)]
mod tests {
    use super::*;
    use num_complex::Complex64;

    #[test]
    fn weights_meet_the_integral_over_their_band() {
        for (band, most) in [(1.6, 1e-5), (1.3, 5e-7), (0.7, 3e-10), (0.1, 1e-11)] {
            let weights = EndWeights::new(band);
            let mut worst = 0.0f64;
            for k in 0..=20 {
                let inside = f64::from(k) / 20.0;
                let c = weights.at(inside);
                for w in (1..=40).map(|k| band * f64::from(k) / 40.0) {
                    let got: Complex64 = (0..END_POINTS)
                        .map(|j| c[j] * Complex64::cis(w * (FIRST_POINT + j as f64)))
                        .sum();
                    let sum = 1.0 / (1.0 - Complex64::cis(w));
                    let want = Complex64::I * Complex64::cis(-w * inside) / w - sum;
                    worst = worst.max((got - want).norm());
                }
            }
            println!("{band} radians per point: {worst:.1e}");
            assert!(worst < most, "{band}: {worst:e}");
        }
    }
}
