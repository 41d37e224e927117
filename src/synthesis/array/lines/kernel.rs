//! Spreading kernels k(z) = t (a + b t + ... + f t^5) with t = 1 - z^2, |z| < 1: a few multiplications for any number of rows, without tables.

use std::f64::consts::TAU;

/// Number of coefficients.
pub(super) const TERMS: usize = 6;
/// Highest frequency of a grid that is used beyond half the sample rate, cycles per row: kernels are poor above it. The receiver filter leaves little
/// there, but it folds into windows with the onset of an echo alone.
pub(super) const BAND: f64 = 0.36;
/// Below this argument, spherical Bessel functions are summed by their power series, of so many terms.
const SERIES_BELOW: f64 = 4.0;
const SERIES_TERMS: usize = 24;
/// Images of the band on either side that are summed.
const IMAGES: i32 = 6;
/// Steps of the fit, each with the weights of the kernel before.
const STEPS: usize = 8;

/// Smallest gain in the band relative to that in its middle.
const MIN_GAIN: f64 = 0.02;

/// A kernel of `width` rows.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Kernel {
    pub width: usize,
    pub terms: [f64; TERMS],
}

/// A frequency that echoes contain, cycles per row, with its energy.
#[derive(Clone, Copy, Debug)]
pub(super) struct Content {
    pub nu: f64,
    pub energy: f64,
}

/// Fourier transform of t^(1 + i) at `nu` cycles per row, rows: 2^(n+1) n! j_n(x)/x^n half widths with n = i + 1 and x = 2 pi nu half widths, where
/// j_n is the spherical Bessel function (Abramowitz and Stegun 1964, 9.1.20 and 10.1.1).
fn basis(width: usize, nu: f64) -> [f64; TERMS] {
    let half = 0.5 * width as f64;
    let per = bessel_ratios(TAU * nu * half);
    let mut factor = 2.0 * half;
    std::array::from_fn(|i| {
        factor *= 2.0 * (i + 1) as f64;
        factor * per[i]
    })
}

/// j_n(x)/x^n for n = 1, 2 and so on.
fn bessel_ratios(x: f64) -> [f64; TERMS] {
    let x2 = x * x;
    if x2 < SERIES_BELOW * SERIES_BELOW {
        // Sum of (-x^2/2)^k / (k! (2n + 2k + 1)!!).
        let mut first = 1.0;
        return std::array::from_fn(|i| {
            let n = (i + 1) as f64;
            first /= 2.0 * n + 1.0;
            let (mut term, mut sum) = (first, first);
            for k in 1..SERIES_TERMS {
                let k = k as f64;
                term *= -0.5 * x2 / (k * (2.0 * (n + k) + 1.0));
                sum += term;
            }
            sum
        });
    }
    // j_(n+1) = (2n + 1) j_n / x - j_(n-1), with j_n = r_n x^n.
    let mut before = libm::sin(x) / x;
    let mut ratio = (before - libm::cos(x)) / x2;
    std::array::from_fn(|i| {
        let now = ratio;
        ratio = ((2 * i + 3) as f64 * now - before) / x2;
        before = now;
        now
    })
}

fn dot(a: &[f64; TERMS], b: &[f64; TERMS]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

impl Kernel {
    /// The kernel with the least energy in images of `content`, relative to the echo's own, and the root of that ratio: the relative error of an
    /// echo after the correction by 1/gain, rms over its duration.
    pub(super) fn fit(width: usize, content: &[Content]) -> (Self, f64) {
        let own: Vec<_> = content.iter().map(|c| basis(width, c.nu)).collect();
        let images: Vec<Vec<_>> = content
            .iter()
            .map(|c| {
                let shifts = (-IMAGES..=IMAGES).filter(|shift| *shift != 0);
                shifts
                    .map(|shift| basis(width, c.nu + f64::from(shift)))
                    .collect()
            })
            .collect();
        let centre = basis(width, 0.0);
        let total: f64 = content.iter().map(|c| c.energy).sum();
        let ratio = |terms: &[f64; TERMS]| {
            let least = own.iter().map(|own| dot(terms, own)).fold(1.0, f64::min);
            // The correction would amplify rounding.
            if least < MIN_GAIN {
                return f64::INFINITY;
            }
            let parts = content.iter().zip(&own).zip(&images);
            let sum: f64 = parts
                .map(|((c, own), images)| {
                    let beside: f64 = images.iter().map(|image| dot(terms, image).powi(2)).sum();
                    c.energy * beside / dot(terms, own).powi(2).max(f64::MIN_POSITIVE)
                })
                .sum();
            (sum / total.max(f64::MIN_POSITIVE)).sqrt()
        };
        let mut terms = [0.0; TERMS];
        terms[0] = 1.0 / centre[0];
        let mut best = (terms, ratio(&terms));
        for _ in 0..STEPS {
            let mut matrix = [[0.0; TERMS]; TERMS];
            for ((c, own), images) in content.iter().zip(&own).zip(&images) {
                let weight = c.energy / dot(&terms, own).powi(2).max(f64::MIN_POSITIVE);
                for image in images {
                    for (row, a) in matrix.iter_mut().zip(image) {
                        for (cell, b) in row.iter_mut().zip(image) {
                            *cell += weight * a * b;
                        }
                    }
                }
            }
            let trace: f64 = (0..TERMS).map(|i| matrix[i][i]).sum();
            for (i, row) in matrix.iter_mut().enumerate() {
                row[i] += 1e-13 * trace;
            }
            let solved = solve(matrix, centre);
            let gain = dot(&solved, &centre);
            if !gain.is_normal() {
                break;
            }
            terms = solved.map(|x| x / gain);
            let error = ratio(&terms);
            if error < best.1 {
                best = (terms, error);
            }
        }
        let (terms, error) = best;
        (Self { width, terms }, error)
    }

    /// Value at `z` half widths from the middle.
    pub(super) fn value(&self, z: f64) -> f64 {
        let t = (1.0 - z * z).max(0.0);
        t * self
            .terms
            .iter()
            .rev()
            .fold(0.0, |sum, term| sum * t + term)
    }

    /// Fourier transform at `nu` cycles per row, rows.
    pub(super) fn gain(&self, nu: f64) -> f64 {
        dot(&self.terms, &basis(self.width, nu))
    }
}

/// Solves a symmetric positive system by elimination.
fn solve(mut matrix: [[f64; TERMS]; TERMS], mut right: [f64; TERMS]) -> [f64; TERMS] {
    for i in 0..TERMS {
        let pivot = matrix[i];
        for row in i + 1..TERMS {
            let factor = matrix[row][i] / pivot[i];
            for (cell, p) in matrix[row].iter_mut().zip(pivot) {
                *cell -= factor * p;
            }
            right[row] -= factor * right[i];
        }
    }
    let mut out = [0.0; TERMS];
    for i in (0..TERMS).rev() {
        let known: f64 = (i + 1..TERMS).map(|k| matrix[i][k] * out[k]).sum();
        out[i] = (right[i] - known) / matrix[i][i];
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    fn flat(edge: f64) -> Vec<Content> {
        let at = |k: i32| Content {
            nu: edge * f64::from(k) / 16.0,
            energy: 1.0,
        };
        (-16..=16).map(at).collect()
    }

    #[test]
    fn the_transforms_of_the_basis_are_those_of_its_sums() {
        for width in [2, 5, 8] {
            for nu in [0.0, 0.01, 0.3, -0.3, 0.7, 2.4, 6.3] {
                let half = 0.5 * width as f64;
                let points = 20_000;
                let mut sums = [0.0; TERMS];
                for k in 0..points {
                    let z = (f64::from(k) + 0.5) / f64::from(points);
                    let t = 1.0 - z * z;
                    let mut value = 2.0 * half * t * (TAU * nu * half * z).cos();
                    for sum in &mut sums {
                        *sum += value / f64::from(points);
                        value *= t;
                    }
                }
                for (value, sum) in basis(width, nu).iter().zip(sums) {
                    assert!(
                        (value - sum).abs() < 1e-8 * half,
                        "{width}, {nu}: {value} {sum}"
                    );
                }
            }
        }
    }

    /// Optima of this family of kernels by an independent minimiser (Nelder and Mead 1965, in SciPy, from five starts).
    #[test]
    fn a_fit_is_the_best_kernel_of_its_family() {
        for (width, edge, optimum) in [
            (2, 0.3, 5.032e-2),
            (3, 0.3, 6.822e-3),
            (3, 0.2, 1.951e-3),
            (4, 0.3, 9.212e-4),
            (4, 0.2, 2.280e-4),
            (5, 0.3, 1.357e-4),
            (5, 0.2, 8.081e-5),
            (6, 0.2, 2.036e-5),
            (7, 0.2, 6.537e-6),
        ] {
            let (_, error) = Kernel::fit(width, &flat(edge));
            println!("{width} rows, {edge}: {error:.3e}, optimum {optimum:.3e}");
            assert!(
                (0.99..1.05).contains(&(error / optimum)),
                "{width}, {edge}: {error:e}"
            );
        }
    }

    /// A sum of the kernel's samples against its images: the error that `fit` promises, by definition.
    #[test]
    fn the_error_is_that_of_tones_between_rows() {
        for (width, edge) in [(3, 0.3), (4, 0.2), (5, 0.3)] {
            let content = flat(edge);
            let (kernel, promised) = Kernel::fit(width, &content);
            let half = 0.5 * width as f64;
            let mut sum = 0.0;
            for Content { nu, .. } in &content {
                for k in 0..64 {
                    let x = f64::from(k) / 64.0;
                    let (mut re, mut im) = (0.0, 0.0);
                    for row in -3..=4 {
                        let off = f64::from(row) - x;
                        let value = kernel.value(off / half);
                        re += value * (TAU * nu * off).cos();
                        im -= value * (TAU * nu * off).sin();
                    }
                    sum += (re / kernel.gain(*nu) - 1.0).powi(2) + (im / kernel.gain(*nu)).powi(2);
                }
            }
            let measured = (sum / (64.0 * content.len() as f64)).sqrt();
            println!("{width}, {edge}: {promised:.2e}, measured {measured:.2e}");
            // Images beyond the sixth are not in the promise.
            assert!((measured / promised - 1.0).abs() < 0.05);
        }
    }
}
