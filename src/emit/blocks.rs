//! The moments of a ping in blocks of one length in time, as they are heard one after the other.

use std::ops::Range;

/// How many moments have been heard when so many blocks have.
pub fn end_of_block(blocks: u32, moments_per_s: f64, block_s: f64) -> usize {
    (f64::from(blocks) * block_s * moments_per_s).ceil() as usize
}

/// The moments of each block, and its end, seconds after moment 0. Where no length is given all are one block without an end.
pub fn blocks(
    moments: usize,
    moments_per_s: f64,
    block_s: Option<f64>,
) -> impl Iterator<Item = (Range<usize>, Option<f64>)> {
    let mut first = 0;
    // From the ping's start every time, so that rounding does not add up.
    let ends = (1..).map(move |k| match block_s {
        None => (moments, None),
        Some(block_s) => {
            let end = end_of_block(k, moments_per_s, block_s);
            (end.min(moments), Some(f64::from(k) * block_s))
        }
    });
    ends.map_while(move |(end, end_s)| {
        let range = first..end;
        let is_over = first >= moments;
        first = end;
        (!is_over).then_some((range, end_s))
    })
    // Blocks shorter than a moment hold none.
    .filter(|(range, _)| !range.is_empty())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_moment_is_in_one_block_that_ends_no_earlier_than_it_is_heard() {
        for (moments, rate, block_s) in [
            (1000, 40e3, 1e-3),
            (7, 10.0, 0.25),
            (5, 10.0, 0.01),
            (1, 1e6, 1.0),
        ] {
            let all: Vec<_> = blocks(moments, rate, Some(block_s)).collect();
            let mut next = 0;
            for (range, end_s) in &all {
                assert_eq!(range.start, next);
                next = range.end;
                let last_s = (range.end - 1) as f64 / rate;
                let end_s = end_s.expect("an end");
                assert!(
                    last_s < end_s && last_s > end_s - block_s - 1.0 / rate,
                    "{last_s} {end_s}"
                );
            }
            assert_eq!(next, moments);
        }
        assert_eq!(blocks(9, 1.0, None).collect::<Vec<_>>(), [(0..9, None)]);
        assert_eq!(blocks(0, 1.0, None).count(), 0);
    }
}
