//! exp(j 2 pi x) in plain arithmetic. Loops over the function vectorise and give the same bits on every
//! machine.

use std::f64::consts::PI;

/// Number of samples processed together: two AVX-512 or four SSE2 registers of f64.
pub(crate) const LANES: usize = 8;

/// Addition and subtraction of this number round to the nearest integer (|x| < 2^51). The low bits of the
/// sum hold that integer.
const ROUND: f64 = 6_755_399_441_055_744.0; // 1.5 * 2^52

/// Taylor coefficients of sin(pi x)/x and cos(pi x) in powers of x^2. The remainders at |x| = 1/2 are
/// below 2e-17.
const SIN_PI: [f64; 11] = taylor(PI, 1);
const COS_PI: [f64; 11] = taylor(1.0, 0);

const fn taylor(first: f64, odd: usize) -> [f64; 11] {
    let mut c = [first; 11];
    let mut k = 1;
    while k < c.len() {
        let n = 2 * k + odd;
        c[k] = -c[k - 1] * (PI * PI / (n * (n - 1)) as f64);
        k += 1;
    }
    c
}

/// (cos, sin) of 2 pi `turns`. The absolute error is 5e-16 for |turns| < 2^50, if `turns` is exact.
#[inline(always)]
pub(crate) fn cis(turns: f64) -> (f64, f64) {
    let half_turns = 2.0 * turns;
    let shifted = half_turns + ROUND;
    let f = half_turns - (shifted - ROUND);
    let y = f * f;
    let (mut sin, mut cos) = (SIN_PI[10], COS_PI[10]);
    for k in (0..10).rev() {
        sin = sin * y + SIN_PI[k];
        cos = cos * y + COS_PI[k];
    }
    // Half a turn changes both signs. The parity of the number of half turns becomes the sign bit.
    let flip = shifted.to_bits() << 63;
    (
        f64::from_bits(cos.to_bits() ^ flip),
        f64::from_bits((sin * f).to_bits() ^ flip),
    )
}

/// [`cis`] of several values: (cosines, sines).
#[inline(always)]
pub(crate) fn cis_lanes<const N: usize>(turns: [f64; N]) -> ([f64; N], [f64; N]) {
    let (mut re, mut im) = ([0.0; N], [0.0; N]);
    for j in 0..N {
        (re[j], im[j]) = cis(turns[j]);
    }
    (re, im)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cis_meets_libm_to_1e_15() {
        let mut worst: f64 = 0.0;
        for i in -200_000..200_000 {
            let turns = 1e5 * (i as f64 / 200_000.0).powi(5);
            let (sin, cos) = libm::sincos(2.0 * PI * (turns - turns.round()));
            let (re, im) = cis(turns);
            worst = worst.max((re - cos).abs()).max((im - sin).abs());
        }
        assert!(worst < 1e-15, "worst {worst:e}");
        assert_eq!(cis(0.0), (1.0, 0.0));
        assert_eq!(cis(0.5).0, -1.0);
        assert_eq!(cis(-3.0).0, 1.0);
    }
}
