//! Interleaves element samples by sample time, as acquisition boards and recordings store them.

use num_complex::Complex64;

use super::sevenk::quantise::{IQ_FULL_SCALE, signed};
use echotank_core::ping::{ElementFrame, PingOutput};
use echotank_core::simd::widest;

/// Samples of an element that are converted together.
const BLOCK: usize = 256;

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
    signed(value * IQ_FULL_SCALE)
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
    let mut block = [[0; 2]; BLOCK];
    for (e, iq) in elements_of(output, arrays).enumerate() {
        let mut column = into.iter_mut().skip(e).step_by(elements);
        for volts in iq[..samples.min(iq.len())].chunks(BLOCK) {
            let out_block = &mut block;
            saturated += widest(
                #[inline(always)]
                move || {
                    let mut saturated = 0;
                    for (out, v) in out_block.iter_mut().zip(volts) {
                        let (i, i_held) = counts(v.re / full_scale_v);
                        let (q, q_held) = counts(v.im / full_scale_v);
                        saturated += u64::from(i_held) + u64::from(q_held);
                        *out = [i, q];
                    }
                    saturated
                },
            );
            for (counts, out) in block[..volts.len()].iter().zip(&mut column) {
                *out = *counts;
            }
        }
    }
    saturated
}
