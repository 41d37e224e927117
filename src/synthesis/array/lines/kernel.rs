//! Spreading kernels k(z) = t^2 (a + b t + c t^2 + d t^3) with t = 1 - z^2, |z| < 1: a few multiplications for any number of rows, without tables.

use std::f64::consts::TAU;

/// Number of coefficients.
pub(super) const TERMS: usize = 4;
/// Points of the quadrature over half the support; error 1e-8.
const POINTS: usize = 96;
/// Images of the band on either side that are summed.
const IMAGES: i32 = 3;
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

/// Fourier transform of t^(2 + i) at `nu` cycles per row, rows.
fn basis(width: usize, nu: f64) -> [f64; TERMS] {
    let half = 0.5 * width as f64;
    let step = 1.0 / POINTS as f64;
    let mut sums = [0.0; TERMS];
    for k in 0..POINTS {
        let z = (k as f64 + 0.5) * step;
        let t = 1.0 - z * z;
        let mut value = 2.0 * half * step * t * t * libm::cos(TAU * nu * half * z);
        for sum in &mut sums {
            *sum += value;
            value *= t;
        }
    }
    sums
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

    /// Optima of this family of kernels by an independent minimiser (Nelder and Mead 1965, in SciPy, from five starts).
    #[test]
    fn a_fit_is_the_best_kernel_of_its_family() {
        for (width, edge, optimum) in [
            (3, 0.3, 8.598e-3),
            (3, 0.2, 2.850e-3),
            (4, 0.3, 1.232e-3),
            (4, 0.2, 8.539e-4),
            (5, 0.3, 7.221e-4),
            (5, 0.2, 1.725e-4),
            (6, 0.3, 2.153e-4),
            (6, 0.2, 7.884e-5),
            (7, 0.3, 1.393e-4),
            (7, 0.2, 4.366e-5),
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
    fn the_error_is_that_of_a_tone_between_rows() {
        for nu in [0.05, 0.2, 0.3] {
            let content = [Content { nu, energy: 1.0 }];
            let (kernel, promised) = Kernel::fit(4, &content);
            let mut worst: f64 = 0.0;
            let mut mean = 0.0;
            for k in 0..64 {
                let x = f64::from(k) / 64.0;
                let (mut re, mut im) = (0.0, 0.0);
                for row in -3..=4 {
                    let z = (f64::from(row) - x) / 2.0;
                    let t = (1.0 - z * z).max(0.0);
                    let [a, b, c, d] = kernel.terms;
                    let value = t * t * (a + t * (b + t * (c + t * d)));
                    let turn = TAU * nu * (f64::from(row) - x);
                    re += value * turn.cos();
                    im -= value * turn.sin();
                }
                let off = (re / kernel.gain(nu) - 1.0).hypot(im / kernel.gain(nu));
                worst = worst.max(off);
                mean += off * off / 64.0;
            }
            println!("{nu}: {promised:.2e}, measured {:.2e}", mean.sqrt());
            assert!((mean.sqrt() / promised - 1.0).abs() < 0.05 || promised < 1e-9);
            assert!(worst < 3.0 * promised + 1e-9);
        }
    }
}
