//! The images of one scene side by side, as in Fig. 16.

use std::io;
use std::path::Path;

use super::measure::{Ladder, Once, POINT_COUNTS, Pass, Simplifier};

/// Range samples per pixel, and pixel rows per ping.
const SAMPLES_PER_PIXEL: usize = 6;
const ROWS_PER_PING: usize = 3;
const GAP: usize = 6;
/// Dynamic range of the image, dB.
const RANGE_DB: f64 = 40.0;

struct Panel {
    width: usize,
    height: usize,
    pixels: Vec<u8>,
}

/// Original on top; below it a row per level with columns conventional, acoustic and acoustic-unbiased.
pub(crate) fn draw(ladder: &Ladder, file: &Path) -> io::Result<()> {
    let original = ladder.original();
    // White is exceeded by 1 % of the original's pixels; the same for all panels.
    let mut sorted: Vec<f64> = pixels(&original).into_iter().flatten().collect();
    sorted.sort_by(f64::total_cmp);
    let white = sorted[sorted.len() * 99 / 100];
    let columns = [
        (Once::Pass, Simplifier::Conventional),
        (Once::EachPing, Simplifier::Acoustic),
        (Once::EachPing, Simplifier::Unbiased),
    ];
    let mut rows = vec![vec![panel(&original, white)]];
    let passes: Vec<_> = columns
        .iter()
        .map(|(once, s)| ladder.passes(*once, *s))
        .collect();
    for size in 0..POINT_COUNTS.len() {
        rows.push(passes.iter().map(|p| panel(&p[size].0, white)).collect());
    }
    let (width, height) = (rows[0][0].width, rows[0][0].height);
    let all_width = columns.len() * width + (columns.len() - 1) * GAP;
    let all_height = rows.len() * height + (rows.len() - 1) * GAP;
    let mut image = vec![255u8; all_width * all_height];
    for (r, row) in rows.iter().enumerate() {
        for (c, panel) in row.iter().enumerate() {
            // The original is centred.
            let c = if row.len() == 1 { columns.len() / 2 } else { c };
            let (left, top) = (c * (width + GAP), r * (height + GAP));
            for (y, line) in panel.pixels.chunks(width).enumerate() {
                let at = (top + y) * all_width + left;
                image[at..at + width].copy_from_slice(line);
            }
        }
    }
    let out = io::BufWriter::new(std::fs::File::create(file)?);
    let mut encoder = png::Encoder::new(out, all_width as u32, all_height as u32);
    encoder.set_color(png::ColorType::Grayscale);
    encoder.set_depth(png::BitDepth::Eight);
    encoder.set_compression(png::Compression::High);
    let mut writer = encoder.write_header().map_err(io::Error::other)?;
    writer.write_image_data(&image).map_err(io::Error::other)?;
    writer.finish().map_err(io::Error::other)
}

/// Mean energy of each pixel, by ping; range increases to the right.
fn pixels(pass: &Pass) -> Vec<Vec<f64>> {
    let mean = |cells: &[f64]| cells.iter().sum::<f64>() / cells.len() as f64;
    pass.energy
        .iter()
        .map(|line| line.chunks_exact(SAMPLES_PER_PIXEL).map(mean).collect())
        .collect()
}

fn panel(pass: &Pass, white: f64) -> Panel {
    let lines = pixels(pass);
    let mut drawn = Vec::new();
    for line in &lines {
        for _ in 0..ROWS_PER_PING {
            drawn.extend(line.iter().map(|energy| {
                let below_db = 10.0 * (energy / white).log10();
                ((1.0 + below_db / RANGE_DB).clamp(0.0, 1.0) * 255.0) as u8
            }));
        }
    }
    Panel {
        width: lines[0].len(),
        height: lines.len() * ROWS_PER_PING,
        pixels: drawn,
    }
}
