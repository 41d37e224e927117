//! Compares soundings of the whole pipeline with their seabed; see `tools/soundings --help`.

pub(crate) mod measure;

use std::path::PathBuf;

use clap::Args;
use echotank_config::spec::ColourMap;
use echotank_imaging::image::colour;
use measure::{Case, Soundings, agreement};

#[derive(Args)]
#[command(
    about = "Depth errors by angle of hil-configs/multibeam.toml with bottom detection: over a flat bottom, over a slope, and over the JD211 survey on \
a straight track and with the quickstart's swell"
)]
pub(crate) struct Arguments {
    /// Pings of each case, 4 s apart
    #[arg(long, default_value_t = 60)]
    pings: usize,
    /// The survey's soundings and truth as PNG, in cells of 10 m
    #[arg(long, value_name = "FILE.png")]
    picture: Option<PathBuf>,
}

/// Cell sizes at which relief is compared.
const CELL_M: f64 = 10.0;
const LEAST: usize = 5;

pub(crate) fn run(given: Arguments) -> Result<(), Box<dyn std::error::Error>> {
    let folder = std::env::temp_dir().join(format!("echotank-soundings-{}", std::process::id()));
    std::fs::create_dir_all(&folder)?;
    for case in Case::ALL {
        let spec = measure::spec(case, &folder, 128, 121)?;
        let begun = std::time::Instant::now();
        let soundings = measure::measure(case, &spec, given.pings, 4.0)?;
        println!(
            "{}({:.1} s)\n",
            soundings.table(10.0),
            begun.elapsed().as_secs_f64()
        );
        if case == Case::Survey {
            let (correlation, relief_m, apart_m) = agreement(&soundings.relief(CELL_M, LEAST));
            println!(
                "relief in cells of {CELL_M} m: standard deviation of the truth {relief_m:.3} m, of the sounding error {apart_m:.3} m, correlation {correlation:.3}\n"
            );
            if let Some(file) = &given.picture {
                draw(&soundings, file)?;
            }
        }
    }
    std::fs::remove_dir_all(&folder)?;
    Ok(())
}

/// Soundings above, truth below; north up, 4 pixels per cell.
fn draw(soundings: &Soundings, file: &std::path::Path) -> Result<(), Box<dyn std::error::Error>> {
    const PIXELS: usize = 4;
    let key = |f: &measure::Found| {
        (
            (f.east_m / CELL_M).floor() as i64,
            (f.north_m / CELL_M).floor() as i64,
        )
    };
    let keys: Vec<_> = soundings.found.iter().map(key).collect();
    let span = |of: fn(&(i64, i64)) -> i64| {
        let all = || keys.iter().map(of);
        (all().min().unwrap_or(0), all().max().unwrap_or(0))
    };
    let ((west, east), (south, north)) = (span(|k| k.0), span(|k| k.1));
    let (width, height) = ((east - west + 1) as usize, (north - south + 1) as usize);
    let mut sums = vec![(0.0, 0.0, 0usize); width * height];
    for (f, (e, n)) in soundings.found.iter().zip(&keys) {
        let cell = &mut sums[(north - n) as usize * width + (e - west) as usize];
        *cell = (cell.0 + f.down_m, cell.1 + f.true_down_m, cell.2 + 1);
    }
    let mut truths: Vec<f64> = (sums.iter().filter(|c| c.2 >= LEAST))
        .map(|c| c.1 / c.2 as f64)
        .collect();
    truths.sort_by(f64::total_cmp);
    let (Some(&low), Some(&high)) = (truths.first(), truths.last()) else {
        return Err("no soundings to draw".into());
    };
    let (wide, tall) = (width * PIXELS, (2 * height + 2) * PIXELS);
    let mut rgb = vec![255u8; 3 * wide * tall];
    for y in 0..tall {
        let (half, row) = (y / PIXELS / (height + 2), y / PIXELS % (height + 2));
        if row >= height || half > 1 {
            continue;
        }
        for x in 0..wide {
            let cell = sums[row * width + x / PIXELS];
            let at = 3 * (y * wide + x);
            let colour = match cell.2 >= LEAST {
                true => {
                    let depth = if half == 0 { cell.0 } else { cell.1 } / cell.2 as f64;
                    colour::rgb(ColourMap::Rainbow, ((high - depth) / (high - low)) as f32)
                }
                false => [30, 34, 60],
            };
            rgb[at..at + 3].copy_from_slice(&colour);
        }
    }
    let out = std::io::BufWriter::new(std::fs::File::create(file)?);
    let mut encoder = png::Encoder::new(out, wide as u32, tall as u32);
    encoder.set_color(png::ColorType::Rgb);
    encoder.set_depth(png::BitDepth::Eight);
    encoder.set_compression(png::Compression::High);
    let mut writer = encoder.write_header()?;
    writer.write_image_data(&rgb)?;
    writer.finish()?;
    println!(
        "{}: from {low:.2} m (red) to {high:.2} m (blue)\n",
        file.display()
    );
    Ok(())
}
