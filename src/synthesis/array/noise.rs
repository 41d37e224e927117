//! Circular Gaussian noise from a stream of random bits, in single precision and in vectors.

use std::f32::consts::{LN_2, SQRT_2, TAU};

use num_complex::Complex64;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::Rng;

use echotank_core::simd::SimdLevel;

/// Samples drawn together. Their bits fit the first-level cache.
const BLOCK: usize = 256;

/// Adds circular Gaussian noise: E|n|^2 = rms^2. Sample k depends on bytes 8 k to 8 k + 7 of the stream only. A shorter
/// record therefore receives the first samples of the noise of a longer one.
pub(super) fn add_noise(rms: f64, mut rng: ChaCha8Rng, samples: &mut [Complex64]) {
    let level = SimdLevel::best();
    let mut bytes = [[0; 8]; BLOCK];
    for samples in samples.chunks_mut(BLOCK) {
        rng.fill_bytes(bytes.as_flattened_mut());
        let bytes = &bytes;
        level.run(
            #[inline(always)]
            move || {
                for (sample, bits) in samples.iter_mut().zip(bytes) {
                    let (i, q) = gaussian_pair(u64::from_le_bytes(*bits));
                    sample.re += rms * f64::from(i);
                    sample.im += rms * f64::from(q);
                }
            },
        );
    }
}

/// Two independent Gaussian numbers of variance 1/2 from 64 random bits (Box and Muller 1958). The radius uses 31 bits, so it
/// ends at 4.7, which is 6.7 standard deviations of one number. The probability of a larger radius is 2^-32.
#[inline(always)]
fn gaussian_pair(bits: u64) -> (f32, f32) {
    const UNIT: f32 = 1.0 / (1u32 << 31) as f32;
    let chance = (((bits as u32) >> 1) as i32 as f32 + 0.5) * UNIT; // (0, 1]
    let radius = (-ln(chance)).max(0.0).sqrt();
    let (cos, sin) = cis((bits >> 32) as i32);
    (radius * cos, radius * sin)
}

/// Natural logarithm of a positive normal number, with an error of 1e-7 of the larger of 1 and the result. The mantissa m in
/// [1/sqrt(2), sqrt(2)) follows the series 2 artanh(s), s = (m - 1)/(m + 1), whose remainder is below 1e-9.
#[inline(always)]
fn ln(x: f32) -> f32 {
    const LOWEST: u32 = (0.5 * SQRT_2).to_bits();
    let bits = x.to_bits();
    let exponent = (bits.wrapping_sub(LOWEST) as i32) >> 23;
    let mantissa = f32::from_bits(bits.wrapping_sub((exponent << 23) as u32));
    let s = (mantissa - 1.0) / (mantissa + 1.0);
    let s2 = s * s;
    let series = 1.0 / 3.0 + s2 * (1.0 / 5.0 + s2 * (1.0 / 7.0 + s2 * (1.0 / 9.0)));
    exponent as f32 * LN_2 + 2.0 * (s + s * s2 * series)
}

/// (cos, sin) of `turn` / 2^32 turns, with an error of 2e-7: Taylor series within an eighth of a turn of the nearest quarter.
#[inline(always)]
fn cis(turn: i32) -> (f32, f32) {
    const UNIT: f32 = TAU / (1u64 << 32) as f32;
    let quarter = turn.wrapping_add(1 << 29) >> 30;
    let x = turn.wrapping_sub(quarter << 30) as f32 * UNIT;
    let x2 = x * x;
    let sin = 1.0 / 120.0 + x2 * (-1.0 / 5040.0 + x2 * (1.0 / 362_880.0));
    let sin = x + x * x2 * (-1.0 / 6.0 + x2 * sin);
    let cos = 1.0 + x2 * (-0.5 + x2 * (1.0 / 24.0 + x2 * (-1.0 / 720.0 + x2 * (1.0 / 40_320.0))));
    let (cos, sin) = if quarter & 1 == 0 {
        (cos, sin)
    } else {
        (sin, cos)
    };
    let negated = |value: f32, is_negative: i32| {
        f32::from_bits(value.to_bits() ^ ((is_negative & 2) as u32) << 30)
    };
    (negated(cos, quarter + 1), negated(sin, quarter))
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand_chacha::rand_core::SeedableRng;

    /// The same numbers in double precision with the functions of the library.
    fn reference(bits: u64) -> (f64, f64) {
        let chance = (f64::from((bits as u32) >> 1) + 0.5) / 2f64.powi(31);
        let angle = f64::from((bits >> 32) as i32) / 2f64.powi(32) * std::f64::consts::TAU;
        let radius = (-chance.ln()).sqrt();
        (radius * angle.cos(), radius * angle.sin())
    }

    #[test]
    fn a_pair_is_that_of_box_and_muller_in_double_precision() {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let edges = [
            0,
            1,
            1 << 29,
            (1 << 29) - 1,
            1 << 30,
            1 << 31,
            u32::MAX,
            3 << 29,
        ];
        let edges = edges
            .iter()
            .flat_map(|&a| edges.map(|b| u64::from(a) << 32 | u64::from(b)));
        let random: Vec<u64> = (0..200_000).map(|_| rng.next_u64()).collect();
        for bits in edges.chain(random) {
            let (i, q) = gaussian_pair(bits);
            let (want_i, want_q) = reference(bits);
            // Chances are rounded to 2^-25. Near 1 this moves the square of the radius by as much.
            let (got2, want2) = (
                f64::from(i).hypot(f64::from(q)).powi(2),
                want_i.hypot(want_q).powi(2),
            );
            assert!(
                (got2 - want2).abs() < 1e-6 * want2.max(0.1),
                "{bits:#x}: {got2}, {want2}"
            );
            let off = (f64::from(i) - want_i).hypot(f64::from(q) - want_q);
            assert!(
                off < 1e-6 || want2 < 0.1 && off < 2e-4,
                "{bits:#x}: {off:e}"
            );
        }
    }

    #[test]
    fn every_simd_level_and_every_length_give_the_same_bits() {
        let noise = |count: usize| {
            let mut samples = vec![Complex64::ZERO; count];
            add_noise(1.5, ChaCha8Rng::seed_from_u64(4), &mut samples);
            samples
        };
        let long = noise(3 * BLOCK + 17);
        for count in [0, 1, BLOCK - 1, BLOCK, BLOCK + 1, 3 * BLOCK] {
            assert_eq!(noise(count), long[..count]);
        }
        let mut rng = ChaCha8Rng::seed_from_u64(4);
        for sample in &long {
            let (i, q) = gaussian_pair(rng.next_u64());
            let want = Complex64::new(1.5 * f64::from(i), 1.5 * f64::from(q));
            assert_eq!(*sample, want);
        }
    }

    /// Four million numbers: moments, tails and spectrum within five standard deviations of the estimate.
    #[test]
    fn noise_is_gaussian_to_the_sixth_moment_and_four_deviations_and_white() {
        const COUNT: usize = 2_000_000;
        let mut noise = vec![Complex64::ZERO; COUNT];
        add_noise(2f64.sqrt(), ChaCha8Rng::seed_from_u64(5), &mut noise);
        let values = || noise.iter().flat_map(|n| [n.re, n.im]);
        let count = 2.0 * COUNT as f64;
        // Gaussian moments and the variance of each power: E x^2n - (E x^n)^2.
        for (power, want, variance) in [
            (1, 0.0, 1.0),
            (2, 1.0, 2.0),
            (3, 0.0, 15.0),
            (4, 3.0, 96.0),
            (6, 15.0, 10_395.0 - 225.0),
        ] {
            let mean = values().map(|x| x.powi(power)).sum::<f64>() / count;
            let slack = 5.0 * f64::sqrt(variance / count);
            assert!(
                (mean - want).abs() < slack,
                "power {power}: {mean}, {want} +- {slack}"
            );
        }
        // Two-sided tails of the normal distribution.
        for (beyond, share) in [
            (1.0, 0.317_310_507_9),
            (2.0, 0.045_500_263_9),
            (3.0, 0.002_699_796_1),
            (4.0, 6.334_248_4e-5),
        ] {
            let got = values().filter(|x| x.abs() > beyond).count() as f64 / count;
            let slack = 5.0 * f64::sqrt(share / count);
            assert!(
                (got - share).abs() < slack,
                "{beyond}: {got}, {share} +- {slack}"
            );
        }
        // Uncorrelated at every lag to a block and beyond, as are the powers.
        for lag in (1..20).chain([BLOCK - 1, BLOCK, BLOCK + 1]) {
            let pairs = || noise.iter().zip(&noise[lag..]);
            let slack = 5.0 / (COUNT as f64).sqrt();
            let shared: Complex64 = pairs().map(|(a, b)| a.conj() * b).sum();
            let power = |n: &Complex64| 0.5 * n.norm_sqr() - 1.0;
            let powers: f64 = pairs().map(|(a, b)| power(a) * power(b)).sum();
            let (shared, powers) = (shared.norm() / (2 * COUNT) as f64, powers / COUNT as f64);
            assert!(
                shared < slack && powers.abs() < slack,
                "{lag}: {shared}, {powers}"
            );
        }
    }
}
