//! Image of a strip of the bottom along the track. Each cell shows the level that was received nearest to it.

use crate::picture::Grid;

/// Cell size along the track and in slant range, metres.
pub(super) const CELL_M: f64 = 0.06;
pub(super) const RANGE_M: (f64, f64) = (29.0, 75.0);
const TRACK_M: (f64, f64) = (0.0, 36.0);

pub(super) struct Strip {
    pub(super) grid: Grid,
    /// Along-track distance between each cell and the position of its level, metres.
    nearest_m: Vec<f64>,
}

impl Strip {
    pub(super) fn new() -> Self {
        let width = ((RANGE_M.1 - RANGE_M.0) / CELL_M) as usize;
        let height = ((TRACK_M.1 - TRACK_M.0) / CELL_M) as usize;
        Self {
            grid: Grid::new(width, height),
            nearest_m: vec![f64::INFINITY; width * height],
        }
    }

    /// Slant range of the middle of a column.
    pub(super) fn range_m(x: usize) -> f64 {
        RANGE_M.0 + (x as f64 + 0.5) * CELL_M
    }

    /// Sets a level in a column, up to `half_m` on both sides of `middle_m` along the track, unless a nearer level is
    /// present.
    pub(super) fn lay(&mut self, x: usize, middle_m: f64, half_m: f64, level: f32) {
        let first = ((TRACK_M.1 - middle_m - half_m) / CELL_M).max(0.0) as usize;
        for y in first..self.grid.height {
            let north_m = TRACK_M.1 - (y as f64 + 0.5) * CELL_M;
            if north_m < middle_m - half_m {
                break;
            }
            let off_m = (north_m - middle_m).abs();
            let nearest_m = &mut self.nearest_m[y * self.grid.width + x];
            if off_m <= half_m && off_m < *nearest_m {
                *nearest_m = off_m;
                self.grid.set(x, y, level);
            }
        }
    }
}
