//! Converts volts to integers and counts clipped values.
//!
//! `full_scale_v` of the receiver corresponds to the integer's maximum: 32767 for I and Q (7038), 65535 for magnitudes (7018, 7007). Counts
//! are volts / full_scale_v x maximum, rounded. Values beyond the range, and NaN, are clipped and counted.

use num_complex::Complex64;

use echotank_protocols::sevenk::records::{BeamSample, PHASE_COUNTS_PER_RAD};

/// Counts of I or Q at full scale.
pub(crate) const IQ_FULL_SCALE: f64 = i16::MAX as f64;
/// Counts of a magnitude at full scale.
pub(crate) const MAGNITUDE_FULL_SCALE: f64 = u16::MAX as f64;

/// Rounds `value` counts to the symmetric range of i16. The flag is true if the value was clipped.
fn signed(value: f64) -> (i16, bool) {
    let rounded = value.round();
    let fits = rounded.abs() <= IQ_FULL_SCALE;
    let held = rounded.clamp(-IQ_FULL_SCALE, IQ_FULL_SCALE); // NaN stays NaN, and the cast makes it 0
    (held as i16, !fits)
}

fn unsigned(value: f64) -> (u16, bool) {
    let rounded = value.round();
    let fits = (0.0..=MAGNITUDE_FULL_SCALE).contains(&rounded);
    (rounded.clamp(0.0, MAGNITUDE_FULL_SCALE) as u16, !fits)
}

/// Appends I and Q of one element. Returns the number of clipped values.
pub fn iq(volts: &[Complex64], full_scale_v: f64, into: &mut Vec<[i16; 2]>) -> u64 {
    let scale = IQ_FULL_SCALE / full_scale_v;
    let mut saturated = 0;
    into.extend(volts.iter().map(|v| {
        let (i, i_held) = signed(v.re * scale);
        let (q, q_held) = signed(v.im * scale);
        saturated += u64::from(i_held) + u64::from(q_held);
        [i, q]
    }));
    saturated
}

/// Writes the samples of one beam into its column of `into` (by sample, then beam), starting at sample `first`. Returns the number of
/// clipped magnitudes.
pub(crate) fn beam_column(
    volts: &[Complex64],
    full_scale_v: f64,
    (beam, beams): (usize, usize),
    first: usize,
    into: &mut [BeamSample],
) -> u64 {
    let scale = MAGNITUDE_FULL_SCALE / full_scale_v;
    let mut saturated = 0;
    let column = into.iter_mut().skip(first * beams + beam).step_by(beams);
    for (out, v) in column.zip(volts) {
        let (amplitude, held) = unsigned((v.re * v.re + v.im * v.im).sqrt() * scale);
        let (phase, _) = signed(v.im.atan2(v.re) * f64::from(PHASE_COUNTS_PER_RAD));
        saturated += u64::from(held);
        *out = BeamSample { amplitude, phase };
    }
    saturated
}

/// Appends one side-scan line. Returns the number of clipped values.
pub fn line(volts: &[f32], full_scale_v: f64, into: &mut Vec<u16>) -> u64 {
    let scale = MAGNITUDE_FULL_SCALE / full_scale_v;
    let mut saturated = 0;
    into.extend(volts.iter().map(|&v| {
        let (counts, held) = unsigned(f64::from(v) * scale);
        saturated += u64::from(held);
        counts
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
    fn beams_are_interleaved_by_sample_with_magnitude_and_phase() {
        let mut out = vec![BeamSample::default(); 3 * 2];
        let volts = [
            Complex64::from_polar(0.5, 1.0),
            Complex64::from_polar(1.0, -PI),
        ];
        let saturated = beam_column(&volts, 1.0, (1, 2), 1, &mut out);
        assert_eq!(saturated, 0);
        assert_eq!(
            out[3],
            BeamSample {
                amplitude: 32768,
                phase: 10430
            }
        );
        assert_eq!(out[5].amplitude, 65535);
        assert_eq!(
            out[5].phase.abs(),
            32767,
            "pi is 32766.8 counts: got {}",
            out[5].phase
        );
        for untouched in [0, 1, 2, 4] {
            assert_eq!(out[untouched], BeamSample::default());
        }
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
}
