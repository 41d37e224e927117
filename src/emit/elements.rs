//! Interleaves element samples by sample time, as acquisition boards and recordings store them.

use num_complex::Complex64;

use super::sevenk::quantise::IQ_FULL_SCALE;
use echotank_core::ping::{ElementFrame, PingOutput};

/// Iterates over the elements of `arrays` in order; each item is the sample row of one element.
pub fn elements_of<'a>(
    output: &'a PingOutput,
    arrays: &'a [usize],
) -> impl Iterator<Item = &'a [Complex64]> {
    arrays
        .iter()
        .filter_map(|&array| output.elements.iter().find(|frame| frame.array == array))
        .flat_map(|frame: &ElementFrame| (0..frame.elements).map(|e| frame.element(e)))
}

/// Quantises a value relative to full scale (real, I or Q) to counts. The flag is true if the value was clipped.
#[inline(always)]
pub fn counts(value: f64) -> (i16, bool) {
    let rounded = (value * IQ_FULL_SCALE).round();
    let held = rounded.clamp(-IQ_FULL_SCALE, IQ_FULL_SCALE); // NaN stays NaN, and the cast makes it 0
    let fits = rounded.abs() <= IQ_FULL_SCALE; // false for NaN
    (held as i16, !fits)
}

/// Fills `into` with the I and Q counts of all elements, interleaved by sample. Returns the number of clipped values.
pub fn interleave_iq(
    output: &PingOutput,
    arrays: &[usize],
    samples: usize,
    full_scale_v: f64,
    into: &mut Vec<[i16; 2]>,
) -> u64 {
    let elements = elements_of(output, arrays).count();
    into.clear();
    into.resize(elements * samples, [0; 2]);
    let mut saturated = 0;
    for (e, iq) in elements_of(output, arrays).enumerate() {
        let column = into.iter_mut().skip(e).step_by(elements);
        for (out, v) in column.zip(iq) {
            let ((i, i_held), (q, q_held)) =
                (counts(v.re / full_scale_v), counts(v.im / full_scale_v));
            saturated += u64::from(i_held) + u64::from(q_held);
            *out = [i, q];
        }
    }
    saturated
}
