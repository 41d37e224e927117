//! Fades and peaks of windows of Gaussian samples: how far the mean squares of a few independent samples stray from their means in the worst of
//! many windows.
//!
//! `looks` is the logarithm of the number of windows, `n` the number of independent samples of each.

use echotank_core::pulse::Pulse;

/// The greatest of mean squares of `n` samples, over their mean: Laurent and Massart 2000, Lemma 1, in its sharper form for complex samples.
pub(crate) fn worst_peak(looks: f64, n: f64) -> f64 {
    let l = looks / n;
    1.0 + (2.0 * l).sqrt() + l
}

/// The greatest ratio of mean squares of `n` samples to those of `n` others, each over its mean. For two gamma variables of shape n,
/// P(ratio > R) <= (4 R/(1 + R)^2)^n by Chernoff's bound.
pub(crate) fn worst_ratio(looks: f64, n: f64) -> f64 {
    let half = 2.0 * (looks / n).exp() - 1.0;
    half + (half * half - 1.0).max(0.0).sqrt()
}

/// [`worst_ratio`] of windows of many echoes of one pulse, `n` the inverse of the sum of the squared eigenvalues of their autocorrelation over a window
/// ([`independent_of_pulse`]).
///
/// The energy of a window is a sum of squares of Gaussian samples, the eigenvalues l(k) their shares. In deep fades small eigenvalues count too, so `n`
/// equal ones fade deeper. By Chernoff's bound,
///
/// ```text
/// P(ratio > R) <= min over t of the product of 1/((1 - t l(k)) (1 + t R l(k))) = exp(-E(R))
/// ```
///
/// [`EXPONENTS`] has E of a pulse of constant frequency under a raised cosine, with n = [`FREEDOM`]: the smoothest pulse, whose eigenvalues fall fastest.
/// n of others have n/[`FREEDOM`] times that exponent or more, to 5 % at B T = 30: computed for B T of 0 to 30 with tapers of 0, 0.5 and 1.
pub(crate) fn worst_ratio_of_pulses(looks: f64, n: f64) -> f64 {
    let wanted = looks * FREEDOM / n;
    let last = EXPONENTS.len() - 1;
    // E grows faster than linearly with ln R, and its root more slowly.
    let steps = match EXPONENTS.iter().position(|e| *e >= wanted) {
        Some(0) => 0.0,
        Some(above) => {
            let [low, high] = [EXPONENTS[above - 1], EXPONENTS[above]].map(f64::sqrt);
            (above - 1) as f64 + (wanted.sqrt() - low) / (high - low)
        }
        None => {
            let slope = EXPONENTS[last] - EXPONENTS[last - 1];
            last as f64 + (wanted - EXPONENTS[last]) / slope
        }
    };
    libm::exp2(0.5 * steps)
}

/// E of ratios that grow by the root of two, from 1 on.
const EXPONENTS: [f64; 21] = [
    0.0, 0.0734, 0.2923, 0.6526, 1.1483, 1.7719, 2.5154, 3.3705, 4.3297, 5.3859, 6.533, 7.7656,
    9.0793, 10.4709, 11.9378, 13.4786, 15.0925, 16.7796, 18.5409, 20.3784, 22.2953,
];
const FREEDOM: f64 = 2.449;

/// Degrees of freedom of the energy of a window of many echoes: 2 of a tone, whose autocorrelation is a triangle. Of chirps 1/2 more than the bandwidth
/// times the window, less what the taper takes of the pulse: the square of its mean power over the mean of its square.
///
/// To 3 % those of the computed autocorrelations of chirps with B T of 3 to 30 and tapers of 0, 0.5 and 1, except 2.0 for 2.8 (B T = 3, taper 1).
pub(crate) fn independent_of_pulse(pulse: &Pulse, window_s: f64) -> f64 {
    let flat = 1.0 - pulse.taper;
    // Of a squared raised cosine, and of its square.
    let (mean, square) = (
        flat + 3.0 / 8.0 * pulse.taper,
        flat + 35.0 / 128.0 * pulse.taper,
    );
    (mean * mean / square * pulse.bandwidth_hz * window_s + 0.5).max(2.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use echotank_core::pulse::PulseKind;
    use num_complex::Complex64;
    use rand_chacha::ChaCha8Rng;
    use rand_chacha::rand_core::{Rng, SeedableRng};

    /// Eigenvalues of a symmetric matrix by rotations (Jacobi 1846).
    fn eigenvalues(mut a: Vec<Vec<f64>>) -> Vec<f64> {
        let n = a.len();
        for _ in 0..12 {
            for p in 0..n {
                for q in p + 1..n {
                    if a[p][q].abs() < 1e-14 {
                        continue;
                    }
                    let angle = 0.5 * libm::atan2(2.0 * a[p][q], a[q][q] - a[p][p]);
                    let (sine, cosine) = (libm::sin(angle), libm::cos(angle));
                    for row in &mut a {
                        let (x, y) = (row[p], row[q]);
                        (row[p], row[q]) = (cosine * x - sine * y, sine * x + cosine * y);
                    }
                    let [low, high] = a.get_disjoint_mut([p, q]).expect("two rows");
                    for (x, y) in low.iter_mut().zip(high) {
                        (*x, *y) = (cosine * *x - sine * *y, sine * *x + cosine * *y);
                    }
                }
            }
        }
        (0..n).map(|k| a[k][k]).collect()
    }

    /// The table, from the autocorrelation of a raised cosine over a window of its length.
    #[test]
    fn exponents_are_those_of_the_eigenvalues_of_a_raised_cosine() {
        const SAMPLES: usize = 64;
        let pulse = Pulse {
            kind: PulseKind::Cw,
            center_frequency_hz: 100e3,
            bandwidth_hz: 0.0,
            duration_s: 1e-3,
            taper: 1.0,
        };
        let shape: Vec<f64> = (0..SAMPLES)
            .map(|k| pulse.envelope((k as f64 + 0.5) / SAMPLES as f64 * 1e-3).re)
            .collect();
        let lag = |lag: usize| -> f64 { shape[lag..].iter().zip(&shape).map(|(a, b)| a * b).sum() };
        let matrix = (0..SAMPLES)
            .map(|i| (0..SAMPLES).map(|k| lag(i.abs_diff(k))).collect())
            .collect();
        let all = eigenvalues(matrix);
        let total: f64 = all.iter().sum();
        let shares: Vec<f64> = all.iter().map(|l| l.max(0.0) / total).collect();
        let freedom = 1.0 / shares.iter().map(|l| l * l).sum::<f64>();
        println!("freedom {freedom:.4}");
        assert!((freedom / FREEDOM - 1.0).abs() < 0.005, "{freedom}");
        let largest = shares.iter().copied().fold(0.0, f64::max);
        for (step, exponent) in EXPONENTS.iter().enumerate() {
            let ratio = libm::exp2(0.5 * step as f64);
            let at = |t: f64| -> f64 {
                let one = |l: &f64| libm::log1p(-t * l) + libm::log1p(t * ratio * l);
                shares.iter().map(one).sum()
            };
            let best = (1..4000).map(|k| at(f64::from(k) / 4000.0 / largest));
            let best = best.fold(0.0, f64::max);
            println!("{ratio:.2}: {best:.4}, {exponent}");
            assert!(
                (best - exponent).abs() < 0.01 * exponent + 1e-3,
                "{ratio}: {best}"
            );
        }
    }

    /// Windows of noise behind a pulse, drawn: the greatest of many ratios of their energies is below the bound, and not far below.
    #[test]
    fn the_worst_ratio_of_drawn_windows_is_bounded() {
        const SAMPLES: usize = 96;
        let trials = 20_000;
        let mut chance = ChaCha8Rng::seed_from_u64(11);
        for (bandwidth_hz, taper) in [(0.0, 0.0), (0.0, 1.0), (8e3, 0.0), (8e3, 1.0), (20e3, 0.5)] {
            let pulse = Pulse {
                kind: match bandwidth_hz {
                    0.0 => PulseKind::Cw,
                    _ => PulseKind::LfmUp,
                },
                center_frequency_hz: 100e3,
                bandwidth_hz,
                duration_s: 1e-3,
                taper,
            };
            let shape: Vec<Complex64> = (0..SAMPLES)
                .map(|k| pulse.envelope((k as f64 + 0.5) / SAMPLES as f64 * 1e-3))
                .collect();
            let mut energy = || {
                let mut sample = || {
                    let mut one = || (f64::from(chance.next_u32()) + 0.5) / 2f64.powi(32);
                    Complex64::from_polar((-one().ln()).sqrt(), std::f64::consts::TAU * one())
                };
                let noise: Vec<Complex64> = (0..2 * SAMPLES).map(|_| sample()).collect();
                (0..SAMPLES)
                    .map(|k| {
                        let heard = noise[k..k + SAMPLES].iter().zip(&shape);
                        heard.map(|(a, b)| a * b).sum::<Complex64>().norm_sqr()
                    })
                    .sum::<f64>()
            };
            let energies: Vec<f64> = (0..2 * trials).map(|_| energy()).collect();
            let ratios = energies.chunks_exact(2).map(|pair| pair[0] / pair[1]);
            let got = ratios.fold(0.0, f64::max);
            let n = independent_of_pulse(&pulse, 1e-3);
            let bound = worst_ratio_of_pulses(f64::from(trials).ln(), n);
            println!("{bandwidth_hz} Hz, taper {taper}: {got:.2}, at most {bound:.2}");
            assert!(
                got <= bound,
                "{bandwidth_hz} Hz, taper {taper}: {got} > {bound}"
            );
            assert!(
                bound <= 6.0 * got,
                "{bandwidth_hz} Hz, taper {taper}: {bound} of {got}"
            );
        }
    }
}
