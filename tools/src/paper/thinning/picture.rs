//! Images of one scene side by side, as in Fig. 16.

use std::path::Path;

use echotank_config::spec::ColourMap;

use super::measure::{POINT_COUNTS, Pass, SelectionTime, Simplifier, Thinning};
use crate::picture::{self, ColourScale, Grid};

/// Number of range samples per pixel.
const SAMPLES_PER_PIXEL: usize = 6;
/// Number of pixel rows per ping.
const ROWS_PER_PING: usize = 3;
/// Dynamic range of the image, dB.
const RANGE_DB: f32 = 40.0;

/// Draws the original on top, and below it a row per level with the columns conventional, acoustic and
/// acoustic-unbiased.
pub(crate) fn draw(thinning: &Thinning, file: &Path) -> Result<(), String> {
    let columns = [
        (SelectionTime::Pass, Simplifier::Conventional),
        (SelectionTime::EachPing, Simplifier::Acoustic),
        (SelectionTime::EachPing, Simplifier::Unbiased),
    ];
    let original = panel(&thinning.original());
    let passes = columns.map(|(once, simplifier)| thinning.passes(once, simplifier));
    let panels: Vec<Vec<Grid>> = (0..POINT_COUNTS.len())
        .map(|size| passes.iter().map(|pass| panel(&pass[size].0)).collect())
        .collect();
    // 1 % of the pixels of the original exceed white. The scale is the same for all panels.
    let white = ColourScale::of_shares(&[&original], ColourMap::Grey, 0.0, 0.99);
    let look = ColourScale {
        low: white.high - RANGE_DB,
        ..white
    };
    let mut rows = vec![vec![(&original, look)]];
    rows.extend(
        panels
            .iter()
            .map(|row| row.iter().map(|p| (p, look)).collect()),
    );
    picture::write(file, &rows)
}

/// Mean energy of each pixel, dB. Range increases to the right and pings downwards.
fn panel(pass: &Pass) -> Grid {
    let (width, height) = (
        pass.energy[0].len() / SAMPLES_PER_PIXEL,
        pass.energy.len() * ROWS_PER_PING,
    );
    let mut grid = Grid::new(width, height);
    for y in 0..height {
        let line = pass.energy[y / ROWS_PER_PING].chunks_exact(SAMPLES_PER_PIXEL);
        for (x, cells) in line.enumerate() {
            let mean = cells.iter().sum::<f64>() / cells.len() as f64;
            grid.set(x, y, 10.0 * mean.max(1e-30).log10() as f32);
        }
    }
    grid
}
