//! Short Chebyshev series: number of terms for a smooth function, and conversion to powers.

use num_complex::Complex64;

use super::pulse::{chebyshev, chebyshev_nodes};
use super::sample::Sample;

/// Test points beyond the maximum number of terms.
const EXTRA: usize = 4;

/// Maximum number of terms that is examined.
pub(crate) const MAX_SIZES: usize = 32;

/// |coefficients| of the first `count` terms.
pub(super) fn sizes(f: impl Fn(f64) -> Complex64, count: usize) -> [f64; MAX_SIZES] {
    let mut sums = [Complex64::ZERO; MAX_SIZES];
    for x in chebyshev_nodes(count) {
        let value = f(x) / count as f64;
        let (mut before, mut now) = (1.0, x);
        sums[0] += value;
        for sum in &mut sums[1..count] {
            *sum += value * (2.0 * now);
            (before, now) = (now, 2.0 * x * now - before);
        }
    }
    sums.map(Complex64::norm)
}

/// T_0(x) ... T_(terms-1)(x).
#[inline(always)]
pub(crate) fn chebyshev_terms<T: Sample, const MOST: usize>(x: T, terms: usize) -> [T; MOST] {
    let mut values = [T::one(); MOST];
    let twice = x + x;
    let (mut before, mut now) = (T::one(), x);
    for value in &mut values[1..terms.max(1)] {
        *value = now;
        (before, now) = (now, twice * now - before);
    }
    values
}

/// Smallest number of terms whose remainder is at most `tolerance` over -1..1, up to `most`; and
/// that remainder.
pub(crate) fn terms_needed(
    f: impl Fn(f64) -> Complex64,
    most: usize,
    tolerance: f64,
) -> (usize, f64) {
    let count = most + EXTRA;
    let sizes = sizes(f, count);
    let mut rest = 0.0;
    for n in (1..count).rev() {
        if rest + sizes[n] > tolerance {
            return if n < most {
                (n + 1, rest)
            } else {
                (most, sizes[most..count].iter().sum())
            };
        }
        rest += sizes[n];
    }
    (1, rest)
}

/// Matrix from values at the Chebyshev points to coefficients of powers, `[power * count + point]`.
pub(crate) fn powers_from_nodes(count: usize) -> Vec<f64> {
    let mut powers = vec![vec![1.0], vec![0.0, 1.0]];
    for k in 2..count {
        let mut next = vec![0.0; k + 1];
        for (i, c) in powers[k - 1].iter().enumerate() {
            next[i + 1] += 2.0 * c;
        }
        for (i, c) in powers[k - 2].iter().enumerate() {
            next[i] -= c;
        }
        powers.push(next);
    }
    let mut matrix = vec![0.0; count * count];
    for (point, x) in chebyshev_nodes(count).enumerate() {
        for (n, row) in powers.iter().take(count).enumerate() {
            let scale = if n == 0 { 1.0 } else { 2.0 } / count as f64;
            for (power, c) in row.iter().enumerate() {
                matrix[power * count + point] += scale * chebyshev(n, x) * c;
            }
        }
    }
    matrix
}

/// Matrix from values at the Chebyshev points to coefficients of T_n, `[n * count + point]`.
pub(crate) fn series_from_nodes(count: usize) -> Vec<f64> {
    let mut matrix = vec![0.0; count * count];
    for (point, x) in chebyshev_nodes(count).enumerate() {
        for n in 0..count {
            let scale = if n == 0 { 1.0 } else { 2.0 } / count as f64;
            matrix[n * count + point] = scale * chebyshev(n, x);
        }
    }
    matrix
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_number_of_terms_follows_the_bessel_functions() {
        // exp(-j z x): 2 J_n(z). J_4(0.5) = 1.6e-4, J_5(0.5) = 8.1e-6.
        let wave = |x: f64| Complex64::from_polar(1.0, -0.5 * x);
        assert_eq!(terms_needed(wave, 12, 1e-3).0, 4);
        assert_eq!(terms_needed(wave, 12, 1e-4).0, 5);
        let (terms, tail) = terms_needed(|_| Complex64::ONE, 12, 1e-9);
        assert!(terms == 1 && tail < 1e-9, "{terms} {tail}");
        let (terms, tail) = terms_needed(|x| Complex64::from_polar(1.0, 30.0 * x), 8, 1e-3);
        assert!(terms == 8 && tail > 0.1, "{terms} {tail}");
    }

    #[test]
    fn powers_reproduce_a_polynomial() {
        let matrix = powers_from_nodes(5);
        let law = |x: f64| 1.0 - 3.0 * x + 0.5 * x.powi(4);
        let values: Vec<f64> = chebyshev_nodes(5).map(law).collect();
        let got: Vec<f64> = matrix
            .chunks(5)
            .map(|row| row.iter().zip(&values).map(|(a, b)| a * b).sum())
            .collect();
        for (got, want) in got.iter().zip([1.0, -3.0, 0.0, 0.0, 0.5]) {
            assert!((got - want).abs() < 1e-14, "{got} {want}");
        }
    }
}
