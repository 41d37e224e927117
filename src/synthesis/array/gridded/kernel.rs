//! Spreading kernel: maps the moments of the points in one cell to a few grid values around it.
//!
//! A point at x (-1..1 across its cell) on a grid of unit step contributes exp(-j theta x) to the
//! spectrum at nu cycles per step, theta = pi nu, relative to the centre of its cell. The
//! Jacobi-Anger expansion gives
//!
//! ```text
//! exp(-j theta x) = sum_k e_k (-j)^k J_k(theta) T_k(x),  e_0 = 1, e_k = 2
//! ```
//!
//! The moments sum c T_k(x) of a cell therefore determine its spectrum, and a few of them suffice
//! over the band |nu| <= 1/(2 sigma). The flush spreads moment k onto `width` grid values. The
//! spectrum of its weights is D(nu) e_k (-j)^k J_k(theta), fitted by least squares over the band; D
//! is divided out afterwards. D is the transform of the Kaiser-Bessel window, and a search finds
//! the window parameter with the smallest error. Each point costs one aligned addition to the
//! moments of its cell, whatever the width.
//!
//! The inputs are the width, the oversampling sigma and the number of moments. The results are the
//! weights of the powers x^k, D, and the computed error. Sources: Fessler and Sutton 2003
//! (least-squares interpolation with scaling factors); Beatty, Nishimura and Pauly 2005 (the
//! window).

use std::f64::consts::PI;

use super::least_squares::Matrix;

pub(crate) const MIN_WIDTH: usize = 2;
pub(crate) const MAX_WIDTH: usize = 16;

/// Spreading kernel. Its design takes milliseconds.
#[derive(Clone, Debug)]
pub struct Kernel {
    /// Number of grid values that a cell is spread onto.
    pub width: usize,
    /// Grid points per bin of the band.
    pub oversampling: f64,
    /// Number of moments per cell.
    pub moments: usize,
    /// Rms over band and cell of the error of a unit point, in exact arithmetic.
    pub error: f64,
    beta: f64,
    /// Weight of power x^k for grid value i: `[k * width + i]`.
    weights: Vec<f64>,
}

impl Kernel {
    /// Designs a kernel. `width` is 2 to 16 grid values, `oversampling` exceeds 1, and `moments` is
    /// 1 to 16; other values panic.
    pub fn new(width: usize, oversampling: f64, moments: usize) -> Self {
        assert!((MIN_WIDTH..=MAX_WIDTH).contains(&width), "width {width}");
        assert!(
            oversampling > 1.0 && oversampling.is_finite(),
            "oversampling {oversampling}"
        );
        assert!((1..=16).contains(&moments), "{moments} moments");
        // The main lobe of the window ends near the first alias of the band.
        let middle = PI * width as f64 * (1.0 - 0.5 / oversampling);
        (80..=104)
            .step_by(2)
            .map(|percent| {
                Self::with_beta(
                    width,
                    oversampling,
                    moments,
                    middle * f64::from(percent) / 100.0,
                )
            })
            .min_by(|a, b| a.error.total_cmp(&b.error))
            .expect("a dozen candidates")
    }

    /// As [`Self::new`], with the usual window parameter instead of a search for the best one.
    pub fn rough(width: usize, oversampling: f64, moments: usize) -> Self {
        let middle = PI * width as f64 * (1.0 - 0.5 / oversampling);
        Self::with_beta(width, oversampling, moments, 0.96 * middle)
    }

    fn with_beta(width: usize, oversampling: f64, moments: usize, beta: f64) -> Self {
        let mut kernel = Self {
            width,
            oversampling,
            moments,
            error: 0.0,
            beta,
            weights: vec![0.0; moments * width],
        };
        let powers = chebyshev_powers(moments);
        for odd in [false, true] {
            let fit = kernel.fit(odd);
            for k in (usize::from(odd)..moments).step_by(2) {
                let weights = kernel.column(&fit, odd, k);
                for (power, &share) in powers[k].iter().enumerate() {
                    for (i, &weight) in weights.iter().enumerate() {
                        kernel.weights[power * width + i] += share * weight;
                    }
                }
            }
        }
        kernel.error = kernel.rms_error();
        kernel
    }

    /// Frequencies of the fit in the upper half of the band, cycles per step. They are denser
    /// towards the edge, where the error grows.
    fn nodes(&self) -> Vec<f64> {
        let count = 6 * self.width;
        (0..count)
            .map(|i| {
                libm::sin(0.5 * PI * (i as f64 + 0.5) / count as f64) * 0.5 / self.oversampling
            })
            .collect()
    }

    /// Grid positions at the centre of the cell or to the right of it, in steps.
    fn right_half(&self) -> impl Iterator<Item = f64> + use<> {
        let width = self.width;
        (width / 2..width).map(move |i| i as f64 - 0.5 * (width - 1) as f64)
    }

    /// Pseudo-inverse of the spectra of all even (or odd) weights, divided by D.
    fn fit(&self, odd: bool) -> Matrix {
        let (nodes, places): (Vec<_>, Vec<_>) = (self.nodes(), self.right_half().collect());
        let skip = usize::from(odd && self.width % 2 == 1);
        Matrix::from_fn(nodes.len(), places.len() - skip, |n, i| {
            let place = places[i + skip];
            let turn = 2.0 * PI * nodes[n] * place;
            let pair = if place == 0.0 { 1.0 } else { 2.0 };
            let wave = if odd {
                libm::sin(turn)
            } else {
                libm::cos(turn)
            };
            pair * wave / self.window_gain(nodes[n])
        })
        .pseudo_inverse()
    }

    /// The `width` weights of Chebyshev moment k.
    fn column(&self, fit: &Matrix, odd: bool, k: usize) -> Vec<f64> {
        let sign = if (k / 2).is_multiple_of(2) { 1.0 } else { -1.0 };
        let scale = if k == 0 { 1.0 } else { 2.0 };
        let want: Vec<f64> = self
            .nodes()
            .iter()
            .map(|&nu| sign * scale * bessel_j(k, PI * nu))
            .collect();
        let mut weights = vec![0.0; self.width];
        for u in 0..fit.rows {
            let weight: f64 = fit.row(u).iter().zip(&want).map(|(p, b)| p * b).sum();
            let right = self.width - fit.rows + u;
            let left = self.width - 1 - right;
            weights[left] = if odd { -weight } else { weight };
            weights[right] = weight;
        }
        weights
    }

    /// Weight of power `k` of x for grid value `i`.
    pub fn weight(&self, k: usize, i: usize) -> f64 {
        self.weights[k * self.width + i]
    }

    /// D at `nu` cycles per grid step; 1 at 0.
    pub(crate) fn window_gain(&self, nu: f64) -> f64 {
        sinh_ratio(self.beta * self.beta - (PI * self.width as f64 * nu).powi(2))
            / sinh_ratio(self.beta * self.beta)
    }

    /// Amplification of rounding errors from grid to spectrum: rms of 1/D over the band.
    pub(crate) fn amplification(&self) -> f64 {
        const NODES: usize = 32;
        let sum: f64 = (0..NODES)
            .map(|n| (n as f64 + 0.5) / NODES as f64 * 0.5 / self.oversampling)
            .map(|nu| self.window_gain(nu).powi(-2))
            .sum();
        (sum / NODES as f64).sqrt()
    }

    /// First grid value of a cell relative to the index of the cell. The other grid values follow.
    pub fn first(&self) -> isize {
        -((self.width as isize - 1) / 2)
    }

    /// Offset of a position in grid steps; the integer part of the sum is the cell. Cells of even
    /// kernels lie between grid values, and cells of odd kernels around them.
    pub fn shift(&self) -> f64 {
        0.5 * (self.width % 2) as f64
    }

    fn rms_error(&self) -> f64 {
        const NODES: usize = 64;
        const PLACES: usize = 12;
        // Weight of tap i at each position across the cell.
        let places: Vec<(f64, Vec<f64>)> = (0..PLACES)
            .map(|p| {
                let x = (p as f64 + 0.5) / PLACES as f64 * 2.0 - 1.0;
                let weight = |i: usize| {
                    (0..self.moments)
                        .rev()
                        .fold(0.0, |sum, k| sum * x + self.weight(k, i))
                };
                (x, (0..self.width).map(weight).collect())
            })
            .collect();
        let mut sum = 0.0;
        for n in 0..NODES {
            let nu = (n as f64 + 0.5) / NODES as f64 * 0.5 / self.oversampling;
            let gain = self.window_gain(nu);
            let waves: Vec<(f64, f64)> = (0..self.width)
                .map(|i| {
                    let turn = 2.0 * PI * nu * (i as f64 - 0.5 * (self.width - 1) as f64);
                    (libm::cos(turn) / gain, -libm::sin(turn) / gain)
                })
                .collect();
            for (x, weights) in &places {
                let (mut re, mut im) = (0.0, 0.0);
                for (weight, wave) in weights.iter().zip(&waves) {
                    re += weight * wave.0;
                    im += weight * wave.1;
                }
                sum +=
                    (re - libm::cos(PI * nu * x)).powi(2) + (im + libm::sin(PI * nu * x)).powi(2);
            }
        }
        (sum / (NODES * PLACES) as f64).sqrt()
    }
}

/// sinh(sqrt(y))/sqrt(y), which equals sin(sqrt(-y))/sqrt(-y) for negative y.
fn sinh_ratio(y: f64) -> f64 {
    let root = y.abs().sqrt();
    if root < 1e-4 {
        1.0 + y / 6.0
    } else if y > 0.0 {
        libm::sinh(root) / root
    } else {
        libm::sin(root) / root
    }
}

/// Bessel function of the first kind. The power series ends within 30 terms for the arguments here
/// (below pi).
fn bessel_j(order: usize, x: f64) -> f64 {
    let half = 0.5 * x;
    let mut term = (1..=order).fold(1.0, |t, k| t * half / k as f64);
    let mut sum = term;
    for k in 1..30 {
        term *= -half * half / (k * (k + order)) as f64;
        sum += term;
    }
    sum
}

/// Coefficients of T_0 ... T_(count-1) in powers of x.
fn chebyshev_powers(count: usize) -> Vec<Vec<f64>> {
    let mut all: Vec<Vec<f64>> = vec![vec![1.0], vec![0.0, 1.0]];
    for k in 2..count {
        let mut next = vec![0.0; k + 1];
        for (i, c) in all[k - 1].iter().enumerate() {
            next[i + 1] += 2.0 * c;
        }
        for (i, c) in all[k - 2].iter().enumerate() {
            next[i] -= c;
        }
        all.push(next);
    }
    all.truncate(count);
    all
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Computed errors, rounded up, by (moments, oversampling): one per width from 2. At large
    /// widths the number of moments limits the error.
    const ERRORS: [(usize, f64, &[f64]); 4] = [
        (
            8,
            1.25,
            &[
                1.2e-1, 2.1e-2, 4.1e-3, 8.1e-4, 1.8e-4, 4.0e-5, 1.1e-5, 2.4e-6, 5.7e-7, 2.7e-7,
            ],
        ),
        (
            8,
            2.0,
            &[
                3.5e-2, 2.8e-3, 2.4e-4, 2.5e-5, 2.8e-6, 3.8e-7, 3.7e-8, 6.8e-9, 5.3e-9,
            ],
        ),
        (
            12,
            1.5,
            &[
                6.8e-2, 8.6e-3, 1.2e-3, 1.8e-4, 2.5e-5, 4.4e-6, 6.2e-7, 9.3e-8, 1.6e-8, 3.2e-9,
                5.5e-10, 8.0e-11, 1.3e-11, 2.8e-12, 5.0e-13,
            ],
        ),
        (
            12,
            2.0,
            &[
                3.5e-2, 2.8e-3, 2.4e-4, 2.5e-5, 2.8e-6, 3.8e-7, 3.7e-8, 4.4e-9, 4.9e-10, 6.3e-11,
                6.8e-12, 7.5e-13, 1.4e-13,
            ],
        ),
    ];

    #[test]
    fn errors_match_the_table_to_a_tenth() {
        for (moments, sigma, limits) in ERRORS {
            for (width, &limit) in (MIN_WIDTH..).zip(limits) {
                let got = Kernel::new(width, sigma, moments).error;
                println!("{moments} moments, sigma {sigma}, width {width}: {got:.2e}");
                assert!(
                    got < limit && got > 0.8 * limit,
                    "{moments} moments, sigma {sigma}, width {width}: {got:e}, table {limit:e}"
                );
            }
        }
    }

    #[test]
    fn special_functions_have_their_known_values() {
        for (got, want) in [
            (bessel_j(0, 1.0), 0.765_197_686_557_966_6),
            (bessel_j(1, 2.0), 0.576_724_807_756_873_4),
            (bessel_j(5, 1.5), 1.799_421_767_360_610_8e-3),
            (sinh_ratio(4.0), 1.813_430_203_923_509_2),
            (sinh_ratio(-4.0), 0.454_648_713_412_840_85),
            (sinh_ratio(0.0), 1.0),
        ] {
            assert!((got - want).abs() < 1e-15, "{got} {want}");
        }
        assert_eq!(chebyshev_powers(5)[4], [1.0, 0.0, -8.0, 0.0, 8.0]);
    }
}
