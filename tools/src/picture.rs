//! Writer of grids of levels to PNG, side by side.

use std::io::BufWriter;
use std::path::Path;

use echotank_config::spec::ColourMap;
use echotank_imaging::image::colour::rgb;

/// Grid of levels in row-major order; NaN means no data.
pub(crate) struct Grid {
    pub(crate) width: usize,
    pub(crate) height: usize,
    pub(crate) level: Vec<f32>,
}

impl Grid {
    pub(crate) fn new(width: usize, height: usize) -> Self {
        Self {
            width,
            height,
            level: vec![f32::NAN; width * height],
        }
    }
    pub(crate) fn set(&mut self, x: usize, y: usize, level: f32) {
        self.level[y * self.width + x] = level;
    }
}

/// Colour scale of a panel: levels of the darkest and brightest colour.
#[derive(Clone, Copy, PartialEq)]
pub(crate) struct ColourScale {
    pub(crate) map: ColourMap,
    pub(crate) low: f32,
    pub(crate) high: f32,
}

impl ColourScale {
    /// Scale from the quantiles `low` and `high` of the levels, 0 to 1.
    pub(crate) fn of_shares(grids: &[&Grid], map: ColourMap, low: f64, high: f64) -> Self {
        let mut levels: Vec<f32> = grids
            .iter()
            .flat_map(|g| g.level.iter().copied())
            .filter(|x| x.is_finite())
            .collect();
        levels.sort_by(f32::total_cmp);
        let last = levels.len().saturating_sub(1);
        let at = |share: f64| {
            levels
                .get((last as f64 * share) as usize)
                .copied()
                .unwrap_or(0.0)
        };
        Self {
            map,
            low: at(low),
            high: at(high),
        }
    }
}

const GAP: usize = 8;
const PAPER: [u8; 3] = [255, 255, 255];
const NOTHING: [u8; 3] = [30, 34, 60];
/// Number of colours per panel. It suffices for speckle, at a third of the file size.
const SHADES: usize = 32;

/// Writes rows of panels side by side, each row centred, with at most seven different scales.
pub(crate) fn write(file: &Path, rows: &[Vec<(&Grid, ColourScale)>]) -> Result<(), String> {
    let wide =
        |row: &Vec<(&Grid, ColourScale)>| row.iter().map(|p| p.0.width + GAP).sum::<usize>() - GAP;
    let high = |row: &Vec<(&Grid, ColourScale)>| row.iter().map(|p| p.0.height).max().unwrap_or(1);
    let width = rows.iter().map(wide).max().unwrap_or(1);
    let height = rows.iter().map(|row| high(row) + GAP).sum::<usize>() - GAP;
    let mut palette = [PAPER, NOTHING].concat();
    let mut looks: Vec<ColourScale> = Vec::new();
    let mut pixels = vec![0u8; width * height];
    let mut top = 0;
    for row in rows {
        let mut left = (width - wide(row)) / 2;
        for (grid, look) in row {
            let known = looks.iter().position(|known| known == look);
            let index = known.unwrap_or_else(|| {
                for shade in 0..SHADES {
                    palette.extend(rgb(look.map, shade as f32 / (SHADES - 1) as f32));
                }
                looks.push(*look);
                looks.len() - 1
            });
            for y in 0..grid.height {
                for x in 0..grid.width {
                    let level = grid.level[y * grid.width + x];
                    let share = (level - look.low) / (look.high - look.low).max(1e-9);
                    let shade = (share.clamp(0.0, 1.0) * (SHADES - 1) as f32).round() as usize;
                    pixels[(top + y) * width + left + x] = match level.is_nan() {
                        true => 1,
                        false => u8::try_from(2 + index * SHADES + shade)
                            .map_err(|e| format!("too many looks: {e}"))?,
                    };
                }
            }
            left += grid.width + GAP;
        }
        top += high(row) + GAP;
    }
    let written = || -> Result<(), Box<dyn std::error::Error>> {
        let out = BufWriter::new(std::fs::File::create(file)?);
        let mut encoder = png::Encoder::new(out, width as u32, height as u32);
        encoder.set_color(png::ColorType::Indexed);
        encoder.set_depth(png::BitDepth::Eight);
        encoder.set_palette(palette);
        encoder.set_compression(png::Compression::High);
        let mut writer = encoder.write_header()?;
        writer.write_image_data(&pixels)?;
        Ok(writer.finish()?)
    };
    written().map_err(|e| format!("{}: {e}", file.display()))?;
    println!("{}", file.display());
    Ok(())
}
