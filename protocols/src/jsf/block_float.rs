//! Block floating point. The samples of one message are i16 with a common exponent: value = sample x 2^-N.
//!
//! Source: Rev. 1.20, table 2-5 and equation 2-1. N is the largest value that the largest sample permits. The error of every sample
//! is then at most half a step, 2^-(N+1). This is at most 2^-15 of the largest sample, which uses more than 14 of the 15 bits.

/// Result of quantisation: the exponent, and the number of values that are not finite.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Scaled {
    /// Exponent N of value = sample x 2^-N.
    pub weighting: i16,
    /// Number of samples that are not finite: infinities become the largest number, NaN becomes 0.
    pub not_finite: usize,
    /// Largest magnitude written.
    pub largest: u16,
}

/// Largest magnitude of a written sample. The range is symmetric, so a phase rotation never overflows.
const FULL_SCALE: f64 = 32_767.0;
/// Range of N for finite non-zero f32.
const WEIGHTING_LIMITS: (i32, i32) = (-113, 163);

/// Largest N for which the largest magnitude fits 15 bits; 0 if all samples are zero.
pub fn weighting_for(largest: f32) -> i16 {
    if !(largest > 0.0 && largest.is_finite()) {
        return 0;
    }
    let mut n = (FULL_SCALE / f64::from(largest)).log2().floor() as i32 + 1;
    // The error of the logarithm is at most one ulp, so two steps down suffice.
    while n > WEIGHTING_LIMITS.0 && (f64::from(largest) * power_of_two(n)).round() > FULL_SCALE {
        n -= 1;
    }
    n.clamp(WEIGHTING_LIMITS.0, WEIGHTING_LIMITS.1) as i16
}

/// Appends the samples as i16 to `out`, with the finest scale that holds all of them.
pub fn quantise(samples: &[f32], out: &mut Vec<i16>) -> Scaled {
    let largest = samples
        .iter()
        .filter(|sample| sample.is_finite())
        .fold(0.0_f32, |largest, sample| largest.max(sample.abs()));
    quantise_with(samples, weighting_for(largest), out)
}

/// Appends the samples as i16 with a given scale; values beyond it are clipped.
pub fn quantise_with(samples: &[f32], weighting: i16, out: &mut Vec<i16>) -> Scaled {
    let scale = power_of_two(weighting.into());
    let (mut not_finite, mut largest) = (0, 0);
    out.extend(samples.iter().map(|&sample| {
        not_finite += usize::from(!sample.is_finite());
        let scaled = f64::from(sample) * scale;
        let count = if scaled.is_nan() {
            0
        } else {
            scaled.round().clamp(-FULL_SCALE, FULL_SCALE) as i16
        };
        largest = largest.max(count.unsigned_abs());
        count
    }));
    Scaled {
        weighting,
        not_finite,
        largest,
    }
}

/// Value of a sample.
pub fn value(sample: i16, weighting: i16) -> f64 {
    f64::from(sample) * power_of_two(-i32::from(weighting))
}

/// 2^n, exact within the range of f64, otherwise 0 or infinity.
fn power_of_two(n: i32) -> f64 {
    2.0_f64.powi(n)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn the_largest_sample_fills_the_range() {
        let mut out = Vec::new();
        let scaled = quantise(&[1.0, -0.5, 0.25, 0.0], &mut out);
        assert_eq!(scaled.weighting, 14);
        assert_eq!(out, [16_384, -8_192, 4_096, 0]);
        out.clear();
        assert_eq!(quantise(&[32_767.0], &mut out).weighting, 0);
        assert_eq!(quantise(&[32_768.0], &mut out).weighting, -1);
        assert_eq!(out, [32_767, 16_384]);
    }

    #[test]
    fn zeros_and_non_finite_numbers_do_not_set_the_scale() {
        let mut out = Vec::new();
        let scaled = quantise(&[0.0, f32::NAN, f32::INFINITY, f32::NEG_INFINITY], &mut out);
        assert_eq!((scaled.weighting, scaled.not_finite), (0, 3));
        assert_eq!(out, [0, 0, 32_767, -32_767]);
    }

    proptest! {
        #[test]
        fn every_sample_is_within_half_a_step_and_the_step_within_two_to_the_minus_14_of_the_largest(
            samples in proptest::collection::vec(proptest::num::f32::NORMAL | proptest::num::f32::ZERO, 1..64)
        ) {
            let mut out = Vec::new();
            let scaled = quantise(&samples, &mut out);
            let step = power_of_two(-i32::from(scaled.weighting));
            let largest = samples.iter().fold(0.0_f64, |m, s| m.max(f64::from(s.abs())));
            prop_assert_eq!(scaled.not_finite, 0);
            for (&sample, &count) in samples.iter().zip(&out) {
                let error = (value(count, scaled.weighting) - f64::from(sample)).abs();
                prop_assert!(error <= 0.5 * step, "{sample} became {count} x 2^-{}", scaled.weighting);
            }
            prop_assert!(largest == 0.0 || step <= largest / 16_383.0, "step {step}, largest {largest}");
        }
    }
}
