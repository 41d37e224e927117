//! Elementary functions in plain arithmetic.
//!
//! They use no branches and no library calls, so loops over them vectorise and give the same bits
//! on every machine. Each function reduces its argument exactly and evaluates a Taylor polynomial.

use std::f64::consts::{LOG2_E, PI};

/// Addition and subtraction of this number round to the nearest integer (|x| < 2^51). The low bits
/// of the sum hold that integer.
const ROUND: f64 = 6_755_399_441_055_744.0; // 1.5 * 2^52

/// ln 2 in two parts. The first has 33 bits, so its products with small integers are exact.
const LN_2_HIGH: f64 = 6.931_471_803_691_238e-1;
const LN_2_LOW: f64 = 1.908_214_929_270_587_7e-10;

/// Minimum exponent. exp(-700) is 1e-304 and close to subnormal numbers.
const MIN_EXPONENT: f64 = -700.0;

/// e^x for x <= 0, relative error 4e-16. Values below -700 are clamped to -700.
#[inline(always)]
pub(crate) fn exp_decay(x: f64) -> f64 {
    let x = x.max(MIN_EXPONENT);
    let shifted = x * LOG2_E + ROUND;
    let n = shifted - ROUND;
    let f = (x - n * LN_2_HIGH) - n * LN_2_LOW;
    // Taylor polynomial of degree 13: |f| <= ln(2)/2, remainder 4e-18.
    let mut sum = 1.0 / 6_227_020_800.0;
    for factorial in [
        479_001_600.0,
        39_916_800.0,
        3_628_800.0,
        362_880.0,
        40_320.0,
        5_040.0,
        720.0,
        120.0,
        24.0,
        6.0,
        2.0,
        1.0,
        1.0,
    ] {
        sum = sum * f + 1.0 / factorial;
    }
    // The exponent bits become 2^n.
    sum * f64::from_bits(shifted.to_bits().wrapping_add(1023) << 52)
}

/// Taylor coefficients of sin(pi x) / x in powers of x^2; the remainder at |x| = 1/2 is 1e-18.
const SIN_PI: [f64; 11] = {
    let mut c = [PI; 11];
    let mut k = 1;
    while k < c.len() {
        let n = 2 * k;
        c[k] = -c[k - 1] * (PI * PI / (n * (n + 1)) as f64);
        k += 1;
    }
    c
};

/// sin(pi x) / (pi x), absolute error 4e-16 (relative error near 0); 1 at 0.
#[inline(always)]
pub(super) fn sinc(x: f64) -> f64 {
    let shifted = x + ROUND;
    let f = x - (shifted - ROUND);
    let y = f * f;
    let mut sum = SIN_PI[10];
    for k in (0..10).rev() {
        sum = sum * y + SIN_PI[k];
    }
    // sin(pi x) = (-1)^n sin(pi f), and the parity of n becomes the sign bit.
    let sine = f64::from_bits((sum * f).to_bits() ^ (shifted.to_bits() << 63));
    if x == 0.0 { 1.0 } else { sine / (PI * x) }
}

/// Taylor coefficients of cos(pi x) in powers of x^2; the remainder at |x| = 1/2 is 1e-19.
const COS_PI: [f64; 12] = {
    let mut c = [1.0; 12];
    let mut k = 1;
    while k < c.len() {
        let n = 2 * k;
        c[k] = -c[k - 1] * (PI * PI / ((n - 1) * n) as f64);
        k += 1;
    }
    c
};

/// Cosine and sine of an angle in turns, absolute error 4e-16 plus the rounding of `turns`.
#[inline(always)]
pub(super) fn cis(turns: f64) -> (f64, f64) {
    let x = 2.0 * turns;
    let shifted = x + ROUND;
    let f = x - (shifted - ROUND);
    let y = f * f;
    let mut cosine = COS_PI[11];
    for k in (0..11).rev() {
        cosine = cosine * y + COS_PI[k];
    }
    let mut sine = SIN_PI[10];
    for k in (0..10).rev() {
        sine = sine * y + SIN_PI[k];
    }
    // The parity of the number of half turns becomes the sign bits.
    let odd = shifted.to_bits() << 63;
    (
        f64::from_bits(cosine.to_bits() ^ odd),
        f64::from_bits((sine * f).to_bits() ^ odd),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cis_meets_libm_to_1e_15_between_minus_and_plus_1000_turns() {
        let mut worst: f64 = 0.0;
        for i in -100_000..100_000 {
            let turns = 1000.0 * (i as f64 / 100_000.0).powi(3);
            let (sin, cos) = libm::sincos(2.0 * PI * (turns - turns.round()));
            let got = cis(turns);
            worst = worst.max((got.0 - cos).abs()).max((got.1 - sin).abs());
        }
        assert!(worst < 1e-15, "worst {worst:e}");
        assert_eq!((cis(0.0), cis(-1.0).0, cis(0.5).0), ((1.0, 0.0), 1.0, -1.0));
    }

    #[test]
    fn exp_decay_matches_libm_to_1e_15_and_stays_normal() {
        let mut worst: f64 = 0.0;
        for i in 0..100_000 {
            let x = -690.0 * (i as f64 / 100_000.0).powi(3);
            worst = worst.max((exp_decay(x) / libm::exp(x) - 1.0).abs());
        }
        assert!(worst < 1e-15, "worst {worst:e}");
        assert_eq!(exp_decay(0.0), 1.0);
        assert!(exp_decay(-1e300).is_normal() && exp_decay(f64::NEG_INFINITY) < 1e-300);
    }

    #[test]
    fn sinc_meets_libm_to_1e_15_between_minus_and_plus_1000() {
        let mut worst: f64 = 0.0;
        for i in -100_000..100_000 {
            let x = 1000.0 * (i as f64 / 100_000.0).powi(3);
            // sin(pi x) with exact argument reduction.
            let r = x - 2.0 * (x / 2.0).round();
            let want = if x == 0.0 {
                1.0
            } else {
                libm::sin(PI * r) / (PI * x)
            };
            worst = worst.max((sinc(x) - want).abs());
        }
        assert!(worst < 1e-15, "worst {worst:e}");
        assert_eq!((sinc(0.0), sinc(1e-300), sinc(3.0)), (1.0, 1.0, 0.0));
    }
}
