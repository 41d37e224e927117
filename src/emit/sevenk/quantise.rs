//! Converts volts to integers and counts clipped values.
//!
//! `full_scale_v` of the receiver corresponds to the integer's maximum: 32767 for I and Q (7038), 65535 for magnitudes (7018, 7007). Counts
//! are volts / full_scale_v x maximum, rounded. Values beyond the range, and NaN, are clipped and counted.

use std::f32::consts::{FRAC_PI_2, PI};

use echotank_core::simd::widest;
use num_complex::{Complex32, Complex64};

use echotank_protocols::sevenk::records::{BeamSample, PHASE_COUNTS_PER_RAD};

/// Counts of I or Q at full scale.
pub(crate) const IQ_FULL_SCALE: f64 = i16::MAX as f64;
/// Counts of a magnitude at full scale.
pub(crate) const MAGNITUDE_FULL_SCALE: f64 = u16::MAX as f64;

/// Rounds `value` counts to the symmetric range of i16. The flag is true if the value was clipped. NaN gives 0.
#[inline(always)]
pub(crate) fn signed(value: f64) -> (i16, bool) {
    let rounded = value.round();
    let fits = rounded.abs() <= IQ_FULL_SCALE;
    (
        low_bits(rounded.clamp(-IQ_FULL_SCALE, IQ_FULL_SCALE)) as i16,
        !fits,
    )
}

/// 1.5 x 2^23: a sum with it has the nearest integer in its last places.
const LAST_PLACES: f32 = 12_582_912.0;

/// Rounds a magnitude to an integer of at most `largest`, halves to even numbers. The flag is true if it was clipped. NaN gives 0.
#[inline(always)]
pub(crate) fn magnitude(counts: f32, largest: f64) -> (u16, bool) {
    let fits = (0.0..largest as f32 + 0.5).contains(&counts);
    let held = counts.max(0.0).min(largest as f32);
    ((held + LAST_PLACES).to_bits() as u16, !fits)
}

/// The low 16 bits of an integer; 0 for NaN. A sum with 1.5 x 2^52 has them in its last place. Unlike casts, this vectorises well.
#[inline(always)]
fn low_bits(integer: f64) -> u16 {
    const LAST_PLACE: f64 = 6_755_399_441_055_744.0;
    let number = if integer.is_nan() { 0.0 } else { integer };
    (number + LAST_PLACE).to_bits() as u16
}

/// Appends I and Q of one element. Returns the number of clipped values.
pub fn iq(volts: &[Complex64], full_scale_v: f64, into: &mut Vec<[i16; 2]>) -> u64 {
    let scale = IQ_FULL_SCALE / full_scale_v;
    let start = into.len();
    into.resize(start + volts.len(), [0; 2]);
    let into = &mut into[start..];
    widest(
        #[inline(always)]
        move || {
            let mut saturated = 0;
            for (out, v) in into.iter_mut().zip(volts) {
                let (i, i_held) = signed(v.re * scale);
                let (q, q_held) = signed(v.im * scale);
                saturated += u64::from(i_held) + u64::from(q_held);
                *out = [i, q];
            }
            saturated
        },
    )
}

/// Magnitudes and phases of complex volts, in the same order. Returns the number of clipped magnitudes.
pub(crate) fn beams(volts: &[Complex32], full_scale_v: f64, into: &mut Vec<BeamSample>) -> u64 {
    let scale = (MAGNITUDE_FULL_SCALE / full_scale_v) as f32;
    into.resize(volts.len(), BeamSample::default());
    widest(
        #[inline(always)]
        move || {
            let mut saturated = 0;
            for (out, v) in into.iter_mut().zip(volts) {
                // Scaled first: squares of weak volts are too small for single precision.
                let (re, im) = (v.re * scale, v.im * scale);
                let (amplitude, held) = magnitude((re * re + im * im).sqrt(), MAGNITUDE_FULL_SCALE);
                // Between -pi and pi, within i16.
                let phase = phase_rad(*v) * PHASE_COUNTS_PER_RAD;
                let phase = if phase.is_nan() { 0.0 } else { phase };
                let phase = (phase + LAST_PLACES).to_bits() as i16;
                saturated += u32::from(held);
                *out = BeamSample { amplitude, phase };
            }
            u64::from(saturated)
        },
    )
}

/// The argument with an error of 3e-7, 1/300 of a count, without a function call, so that loops vectorise. The series is Eq. 4.4.49 of
/// Abramowitz and Stegun 1964.
#[inline(always)]
pub(super) fn phase_rad(v: Complex32) -> f32 {
    const TERMS: [f32; 9] = [
        1.0,
        -0.333_331_45,
        0.199_935_51,
        -0.142_089,
        0.106_562_64,
        -0.075_289_64,
        0.042_909_614,
        -0.016_165_737,
        0.002_866_225_7,
    ];
    let (re, im) = (v.re.abs(), v.im.abs());
    let (low, high) = if im > re { (re, im) } else { (im, re) };
    let x = low / high.max(f32::MIN_POSITIVE);
    let x2 = x * x;
    let mut sum = 0.0;
    for term in TERMS.iter().rev() {
        sum = sum * x2 + term;
    }
    let acute = x * sum;
    let upper = if im > re { FRAC_PI_2 - acute } else { acute };
    let positive = if v.re < 0.0 { PI - upper } else { upper };
    if v.im.is_sign_negative() {
        -positive
    } else {
        positive
    }
}

/// Appends one side-scan line. Returns the number of clipped values.
pub fn line(volts: &[f32], full_scale_v: f64, into: &mut Vec<u16>) -> u64 {
    // In double precision, as readers compute it: single precision moves values near a half count to the other integer.
    let scale = MAGNITUDE_FULL_SCALE / full_scale_v;
    let mut saturated = 0;
    into.extend(volts.iter().map(|&v| {
        let counts = f64::from(v) * scale;
        saturated += u64::from(!(0.0..MAGNITUDE_FULL_SCALE + 0.5).contains(&counts));
        low_bits((counts + 0.5).floor().clamp(0.0, MAGNITUDE_FULL_SCALE))
    }));
    saturated
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::PI;

    #[test]
    fn values_beyond_full_scale_are_clipped_and_counted() {
        let c = Complex64::new;
        let volts = [
            c(2.0, -2.0),
            c(1.0, -1.0),
            c(2.1, 0.0),
            c(-9.0, 9.0),
            c(f64::NAN, 0.0),
            c(f64::INFINITY, 0.0),
        ];
        let mut counts = Vec::new();
        let saturated = iq(&volts, 2.0, &mut counts);
        let want = [
            [32767, -32767],
            [16384, -16384],
            [32767, 0],
            [-32767, 32767],
            [0, 0],
            [32767, 0],
        ];
        assert_eq!((counts.as_slice(), saturated), (&want[..], 5));
    }

    #[test]
    fn magnitudes_and_phases_are_those_of_the_plain_functions() {
        let extremes = [
            Complex32::ZERO,
            Complex32::new(f32::NAN, 0.0),
            Complex32::new(f32::INFINITY, 0.0),
            Complex32::new(-1e30, 1e30),
            Complex32::new(-1.0, -1e-7),
        ];
        let turns = (0..40_000).map(|k| {
            let k = f64::from(k);
            let z = Complex64::from_polar(3.0 * (0.7 * k).fract(), 0.37 * k);
            Complex32::new(z.re as f32, z.im as f32)
        });
        let volts: Vec<_> = extremes.into_iter().chain(turns).collect();
        let mut out = Vec::new();
        let saturated = beams(&volts, 2.0, &mut out);
        let mut beyond = 0;
        for (v, got) in volts.iter().zip(&out) {
            let v = Complex64::new(v.re.into(), v.im.into());
            let counts = v.norm() / 2.0 * 65535.0;
            beyond += u64::from(!(0.0..65535.5).contains(&counts));
            // Values within single precision of a half count may be rounded either way.
            let held = if counts.is_nan() {
                0.0
            } else {
                counts.min(65535.0)
            };
            assert!((f64::from(got.amplitude) - held).abs() < 0.51, "{v}");
            let phase = v.arg() * 10430.0;
            let has_phase = v.norm() > 0.0; // false for NaN
            assert!(
                !has_phase || (f64::from(got.phase) - phase).abs() < 0.51,
                "{v}"
            );
        }
        assert_eq!((saturated, out.len()), (beyond, volts.len()));
        assert_eq!(out[1], BeamSample::default());
        assert_eq!(out[4].phase, -32767, "-pi is -32766.8 counts");
    }

    #[test]
    fn lines_are_unsigned_and_a_negative_envelope_counts_as_clipped() {
        let mut out = Vec::new();
        let saturated = line(&[0.0, 0.25, 1.0, 1.5, -0.1], 1.0, &mut out);
        assert_eq!(
            (out.as_slice(), saturated),
            (&[0, 16384, 65535, 65535, 0][..], 2)
        );
    }

    #[test]
    fn lines_round_as_double_precision_does_around_every_half_count() {
        let scale_v = 1.3;
        let volts: Vec<f32> = (0..65535)
            .map(|k| ((f64::from(k) + 0.5) / 65535.0 * scale_v) as f32)
            .flat_map(|v| [v.next_down(), v, v.next_up()])
            .collect();
        let mut out = Vec::new();
        assert_eq!(line(&volts, scale_v, &mut out), 0);
        for (&v, &got) in volts.iter().zip(&out) {
            let want = (f64::from(v) / scale_v * 65535.0).round();
            assert_eq!(f64::from(got), want, "{v}");
        }
    }

    #[test]
    fn phases_are_those_of_the_function_in_every_octant() {
        for step in -4000..=4000 {
            let want = f64::from(step) / 4000.0 * PI;
            for level in [1e-9, 1.0, 3e4] {
                let v = Complex64::from_polar(level, want);
                let v = Complex32::new(v.re as f32, v.im as f32);
                let arg = f64::from(v.im).atan2(f64::from(v.re));
                let off = (f64::from(phase_rad(v)) - arg).abs();
                assert!(off < 3.5e-7, "{want}: {off:e}");
            }
        }
        assert_eq!(phase_rad(Complex32::ZERO), 0.0);
    }
}
