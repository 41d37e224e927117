//! Divides the samples of a ping into blocks of equal duration, for output while the ping is still being received.

use std::ops::Range;

/// Number of samples received by the end of block number `blocks`, at `samples_per_s` samples per second. A block lasts `block_s`
/// seconds.
pub fn end_of_block(blocks: u32, samples_per_s: f64, block_s: f64) -> usize {
    (f64::from(blocks) * block_s * samples_per_s).ceil() as usize
}

/// Iterates over the sample range of each block and its end time in seconds after sample 0. Without `block_s`, one block holds all samples
/// and has no end time.
pub fn blocks(
    samples: usize,
    samples_per_s: f64,
    block_s: Option<f64>,
) -> impl Iterator<Item = (Range<usize>, Option<f64>)> {
    let mut first = 0;
    // Each end is computed from the start of the ping, so rounding errors do not accumulate.
    let ends = (1..).map(move |k| match block_s {
        None => (samples, None),
        Some(block_s) => {
            let end = end_of_block(k, samples_per_s, block_s);
            (end.min(samples), Some(f64::from(k) * block_s))
        }
    });
    ends.map_while(move |(end, end_s)| {
        let range = first..end;
        let is_over = first >= samples;
        first = end;
        (!is_over).then_some((range, end_s))
    })
    // Blocks shorter than a sample interval contain no sample.
    .filter(|(range, _)| !range.is_empty())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_sample_is_in_one_block_that_ends_after_the_sample() {
        for (samples, rate, block_s) in [
            (1000, 40e3, 1e-3),
            (7, 10.0, 0.25),
            (5, 10.0, 0.01),
            (1, 1e6, 1.0),
        ] {
            let all: Vec<_> = blocks(samples, rate, Some(block_s)).collect();
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
            assert_eq!(next, samples);
        }
        assert_eq!(blocks(9, 1.0, None).collect::<Vec<_>>(), [(0..9, None)]);
        assert_eq!(blocks(0, 1.0, None).count(), 0);
    }
}
