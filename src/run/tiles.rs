//! A ping made piece by piece, in increasing delay, while what is made leaves already (`run.stream_tiles`).
//!
//! Every tile is a ping cut short: its first samples alone, up to the end of a block, the next twice as long as the one before. What the sum over
//! echoes makes of a sample depends on nothing that is heard later, so the tiles are the whole ping's bits; the last one is the whole ping. All
//! together they cost less than three pings, and a machine that makes a ping in a quarter of its window is ahead of the samples from the first
//! block on: the second tile, twice as long, is made while the first leaves, and so on.
//!
//! Only sums that go echo by echo can be cut short so (`reference`, `direct`, `nearest`, `linear`); where elements have faults in a ping, which may
//! look at all of it, that ping is one tile.

use crate::emit::blocks::end_of_block;

/// Where the tiles of a ping end, in samples; the whole ping, which is the last, is not among them.
pub fn tile_ends(samples: usize, rate_hz: f64, block_s: f64) -> impl Iterator<Item = usize> {
    let doubled = std::iter::successors(Some(1_u32), |blocks| blocks.checked_mul(2));
    let ends = doubled.map(move |blocks| end_of_block(blocks, rate_hz, block_s));
    let mut before = 0;
    ends.take_while(move |&end| end < samples)
        // Blocks shorter than a sample end none.
        .filter(move |&end| end > std::mem::replace(&mut before, end))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::emit::blocks::blocks;

    #[test]
    fn tiles_double_end_with_blocks_and_leave_the_rest_to_the_whole_ping() {
        let ends: Vec<_> = tile_ends(1000, 40e3, 1e-3).collect();
        assert_eq!(ends, [40, 80, 160, 320, 640]);
        assert_eq!(tile_ends(40, 40e3, 1e-3).count(), 0);
        for (samples, rate_hz, block_s) in [(5000, 44_100.0, 0.37e-3), (77, 1e4, 1e-5)] {
            let of_blocks: Vec<_> = blocks(samples, rate_hz, Some(block_s))
                .map(|(rows, _)| rows.end)
                .collect();
            let ends: Vec<_> = tile_ends(samples, rate_hz, block_s).collect();
            assert!(ends.iter().all(|end| of_blocks.contains(end)), "{ends:?}");
            assert!(ends.windows(2).all(|w| w[1] > w[0]), "{ends:?}");
            assert!(ends.iter().sum::<usize>() < 2 * samples, "{ends:?}");
        }
    }
}
