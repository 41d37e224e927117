//! Binary frames for the page: a head of 16 bytes, JSON text and arrays, all little-endian.
//!
//! | offset | type | content |
//! |---|---|---|
//! | 0 | u8 | kind, see [`Kind`] |
//! | 1 | u8 | [`VERSION`] |
//! | 2 | u16 | index of the sonar in the configuration |
//! | 4 | u32 | ping number |
//! | 8 | u32 | length of the text, bytes, a multiple of 4 (padded with spaces) |
//! | 12 | u32 | length of the arrays, bytes |
//! | 16 | | text: description of the arrays, and the ping's scalar values |
//! | 16 + length of the text | | arrays |
//!
//! Levels are u8: 0 means no signal; others are `low_db` + value x [`STEP_DB`], dB re 1 V rms. Samples are pairs of f32, I and Q, volts.

use axum::body::Bytes;
use serde_json::Value;

/// Version of this format.
pub const VERSION: u8 = 1;
/// Length of the head, bytes.
pub const HEAD_BYTES: usize = 16;

/// Step of a level, dB: a frame spans 127 dB.
pub(crate) const STEP_DB: f32 = 0.5;
/// Number of level steps above `low_db`.
const STEPS: f32 = 254.0;

/// Content of a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Kind {
    /// A side-scan line, u8 levels, port then starboard, each from nadir outwards; the text holds navigation and ground truth.
    Line = 1,
    /// Levels of a fan, u8, beam by beam.
    Fan = 2,
    /// Root mean square and peak of every element, f32, dB re 1 V, array by array.
    Elements = 3,
    /// Samples of one row, pairs of f32.
    Scope = 4,
    /// Depths of a seabed tile, f32, m, positive down, row by row from the south-western corner; NaN without data.
    Relief = 5,
    /// Bottom detections as triples of f32: north, east and down of the world, m.
    Soundings = 6,
}

/// Encodes a frame. `text` is padded with spaces to a multiple of 4 bytes; `arrays` is appended unchanged.
pub fn frame(kind: Kind, sonar: u16, ping_number: u32, text: &Value, arrays: &[u8]) -> Bytes {
    let mut text = text.to_string().into_bytes();
    text.resize(text.len().next_multiple_of(4), b' ');
    let mut bytes = Vec::with_capacity(HEAD_BYTES + text.len() + arrays.len());
    bytes.extend([kind as u8, VERSION]);
    bytes.extend(sonar.to_le_bytes());
    bytes.extend(ping_number.to_le_bytes());
    bytes.extend((text.len() as u32).to_le_bytes());
    bytes.extend((arrays.len() as u32).to_le_bytes());
    bytes.extend(text);
    bytes.extend(arrays);
    bytes.into()
}

/// Appends `power` (V^2) as levels and returns `low_db`. The maximum lies at most [`STEP_DB`] below the top of the scale.
pub fn levels(power: &[f32], into: &mut Vec<u8>) -> f32 {
    let loudest = power.iter().copied().fold(0.0, f32::max);
    let low_db = decibels(loudest).max(-600.0).ceil() - STEPS * STEP_DB;
    into.extend(power.iter().map(|&p| {
        if p <= 0.0 || p.is_nan() {
            return 0;
        }
        // At least 1, because 0 means no signal.
        ((decibels(p) - low_db) / STEP_DB).round().clamp(1.0, 255.0) as u8
    }));
    low_db
}

/// Decibels of a power.
fn decibels(power: f32) -> f32 {
    10.0 * power.log10()
}

/// Reduces a row to the maxima of `out.len()` equal parts: sample k of N falls in part floor(k n / N). A row no longer than `out` is copied.
/// Returns the number of values written.
pub(crate) fn max_hold(row: impl ExactSizeIterator<Item = f32>, out: &mut [f32]) -> usize {
    let samples = row.len();
    let parts = samples.min(out.len());
    out[..parts].fill(0.0);
    for (k, value) in row.enumerate() {
        let part = &mut out[k * parts / samples];
        *part = part.max(value);
    }
    parts
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn a_frame_is_its_head_its_text_and_its_arrays() {
        let got = frame(Kind::Fan, 3, 70_000, &json!({ "n": 2 }), &[7, 8, 9]);
        let mut want = vec![2, 1, 3, 0, 0x70, 0x11, 1, 0, 8, 0, 0, 0, 3, 0, 0, 0];
        want.extend(b"{\"n\":2} ");
        want.extend([7, 8, 9]);
        assert_eq!(got, want);
    }

    #[test]
    fn levels_are_within_half_a_step_and_nothing_is_zero() {
        let powers = [0.0, 1e-30, 1e-9, 0.02, 1.0, 3.7, f32::NAN];
        let mut got = Vec::new();
        let low_db = levels(&powers, &mut got);
        assert_eq!((got[0], got[1], got[6]), (0, 1, 0));
        for k in 2..6 {
            let back_db = low_db + f32::from(got[k]) * STEP_DB;
            let want_db = 10.0 * powers[k].log10();
            assert!(
                (back_db - want_db).abs() <= 0.51 * STEP_DB,
                "{back_db} {want_db}"
            );
        }
        assert!(got[5] >= 253 - 2, "the loudest is near the top: {}", got[5]);
    }

    #[test]
    fn silence_and_infinity_are_no_surprise() {
        for powers in [
            &[][..],
            &[0.0, 0.0],
            &[f32::INFINITY, 1.0],
            &[f32::MIN_POSITIVE],
        ] {
            let mut got = Vec::new();
            levels(powers, &mut got);
            assert_eq!(got.len(), powers.len(), "{powers:?}");
        }
    }

    #[test]
    fn the_loudest_sample_stays_in_the_part_that_its_place_says() {
        let mut out = [9.0; 10];
        for (samples, at) in [(1000_usize, 777_usize), (1003, 500), (10, 9), (7, 3)] {
            let row: Vec<f32> = (0..samples).map(|k| f32::from(u8::from(k == at))).collect();
            let parts = max_hold(row.into_iter(), &mut out);
            assert_eq!(parts, samples.min(10));
            let loud: Vec<_> = (0..parts).filter(|&p| out[p] > 0.5).collect();
            assert_eq!(loud, [at * parts / samples], "{at} of {samples}");
        }
        assert_eq!(max_hold(std::iter::empty(), &mut out), 0);
    }
}
