//! Compares soundings of the whole pipeline with their seabed; see `tools/accuracy soundings --help`.

pub(crate) mod measure;

use std::path::PathBuf;

use clap::Args;
use echotank_config::spec::ColourMap;
use serde_json::json;

use crate::picture::{self, ColourScale, Grid};
use crate::report::{Common, Report};
use measure::{Case, Soundings, agreement};

#[derive(Args)]
#[command(
    about = "Depth errors by angle of hil-configs/multibeam.toml with bottom detection: over a flat bottom, over a slope, and over the JD211 survey on \
a straight track and with the quickstart's swell"
)]
pub(crate) struct Arguments {
    #[command(flatten)]
    common: Common,
    /// Pings of each case, 4 s apart
    #[arg(long, default_value_t = 60, default_value_if("quick", "true", "4"))]
    pings: usize,
    /// The survey's soundings and truth as PNG, in cells of 10 m
    #[arg(long, value_name = "FILE.png")]
    picture: Option<PathBuf>,
}

/// Size of the cells in which relief is compared.
const CELL_M: f64 = 10.0;
const LEAST: usize = 5;

pub(crate) fn run(given: Arguments) -> Result<(), Box<dyn std::error::Error>> {
    let folder = tempfile::tempdir()?;
    let mut report = Report::new();
    for case in Case::ALL {
        let spec = measure::spec(case, folder.path(), 128, 121)?;
        let begun = std::time::Instant::now();
        let soundings = measure::measure(case, &spec, given.pings, 4.0)?;
        report.print(&format!(
            "{}({:.1} s)\n\n",
            soundings.table(10.0),
            begun.elapsed().as_secs_f64()
        ));
        report.keep(
            json!({ "case": case.name(), "pings": given.pings, "rows": soundings.rows(10.0) }),
        );
        if case == Case::Survey {
            let (correlation, relief_m, apart_m) = agreement(&soundings.relief(CELL_M, LEAST));
            report.print(&format!(
                "relief in cells of {CELL_M} m: standard deviation of the truth {relief_m:.3} m, of the sounding error {apart_m:.3} m, correlation {correlation:.3}\n\n"
            ));
            report.keep(json!({ "relief_m": relief_m, "relief_error_m": apart_m, "correlation": correlation }));
            if let Some(file) = &given.picture {
                draw(&soundings, file)?;
            }
        }
    }
    Ok(report.finish(given.common.json.as_deref())?)
}

/// Draws the soundings above the true depths, with north up and 4 pixels per cell.
fn draw(soundings: &Soundings, file: &std::path::Path) -> Result<(), String> {
    const PIXELS: i64 = 4;
    let cells = soundings.cells(CELL_M, LEAST);
    let span = |of: fn(&(i64, i64)) -> i64| {
        let all = || cells.keys().map(of);
        Some((all().min()?, all().max()?))
    };
    let (Some((south, north)), Some((west, east))) = (span(|k| k.0), span(|k| k.1)) else {
        return Err("no soundings to draw".into());
    };
    let size = |low: i64, high: i64| ((high - low + 1) * PIXELS) as usize;
    let grid = |depth_m: fn(&(f64, f64)) -> f64| {
        let mut grid = Grid::new(size(west, east), size(south, north));
        for y in 0..grid.height {
            for x in 0..grid.width {
                let key = (north - y as i64 / PIXELS, west + x as i64 / PIXELS);
                if let Some(cell) = cells.get(&key) {
                    grid.set(x, y, -depth_m(cell) as f32);
                }
            }
        }
        grid
    };
    let (found, truth) = (grid(|c| c.0), grid(|c| c.1));
    let look = ColourScale::of_shares(&[&truth], ColourMap::Rainbow, 0.0, 1.0);
    picture::write(file, &[vec![(&found, look)], vec![(&truth, look)]])?;
    println!(
        "from {:.2} m (red) to {:.2} m (blue)\n",
        -look.high, -look.low
    );
    Ok(())
}
