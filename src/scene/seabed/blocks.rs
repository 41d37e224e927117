//! Bounds of depth and slope over blocks of grid squares. The bounds of a rectangle then take a few look-ups.

use crate::read::HeightField;

pub(super) const NOTHING: (f64, f64) = (f64::INFINITY, f64::NEG_INFINITY);

pub(crate) fn united(a: (f64, f64), b: (f64, f64)) -> (f64, f64) {
    (a.0.min(b.0), a.1.max(b.1))
}

/// Least and greatest values over a block; (inf, -inf) where all of it is a hole.
#[derive(Clone, Copy, Debug)]
pub(super) struct Block {
    pub down_m: (f64, f64),
    pub slope_north: (f64, f64),
    pub slope_east: (f64, f64),
    /// At least one of its cell centres is a hole.
    pub holes: bool,
}

#[derive(Clone, Debug)]
pub(crate) struct Blocks {
    /// Intervals between cell centres along a side of a block.
    pub(crate) intervals_north: usize,
    pub(crate) intervals_east: usize,
    pub rows: usize,
    pub cols: usize,
    /// South-western block first.
    blocks: Vec<Block>,
}

impl Blocks {
    pub(super) fn new(grid: &HeightField, block_m: f64) -> Self {
        let intervals = |cell_m: f64| ((block_m / cell_m).ceil() as usize).max(1);
        let (intervals_north, intervals_east) =
            (intervals(grid.cell_north_m), intervals(grid.cell_east_m));
        let rows = (grid.rows - 1).div_ceil(intervals_north);
        let cols = (grid.cols - 1).div_ceil(intervals_east);
        let mut blocks = Vec::with_capacity(rows * cols);
        for row in 0..rows {
            for col in 0..cols {
                let first = (row * intervals_north, col * intervals_east);
                // Centres on the edge belong to both neighbouring blocks: a bilinear surface has its extremes at centres.
                let last = (
                    (first.0 + intervals_north).min(grid.rows - 1),
                    (first.1 + intervals_east).min(grid.cols - 1),
                );
                blocks.push(Block::of(grid, first, last));
            }
        }
        Self {
            intervals_north,
            intervals_east,
            rows,
            cols,
            blocks,
        }
    }

    pub(super) fn at(&self, row: usize, col: usize) -> &Block {
        &self.blocks[row * self.cols + col]
    }

    /// Blocks along one side that an interval (metres from the first centre) touches.
    pub(super) fn reach(
        &self,
        ends_m: (f64, f64),
        (intervals, cell_m): (usize, f64),
        count: usize,
    ) -> std::ops::RangeInclusive<usize> {
        let side_m = intervals as f64 * cell_m;
        // The cast maps negative numbers to 0.
        let block = |m: f64| ((m / side_m) as usize).min(count - 1);
        block(ends_m.0)..=block(ends_m.1)
    }
}

impl Block {
    /// Bounds over the centres from `first` to `last`, both included. A bilinear surface is steepest along the sides of its squares.
    fn of(grid: &HeightField, first: (usize, usize), last: (usize, usize)) -> Self {
        let mut block = Self {
            down_m: NOTHING,
            slope_north: NOTHING,
            slope_east: NOTHING,
            holes: false,
        };
        for r in first.0..=last.0 {
            for c in first.1..=last.1 {
                let h = grid.cell_down_m(r, c);
                if h.is_nan() {
                    block.holes = true;
                    continue;
                }
                block.down_m = united(block.down_m, (h, h));
                // A neighbour that is a hole yields NaN, which no bound takes.
                if r < last.0 {
                    let slope = (grid.cell_down_m(r + 1, c) - h) / grid.cell_north_m;
                    block.slope_north = united(block.slope_north, (slope, slope));
                }
                if c < last.1 {
                    let slope = (grid.cell_down_m(r, c + 1) - h) / grid.cell_east_m;
                    block.slope_east = united(block.slope_east, (slope, slope));
                }
            }
        }
        block
    }
}
