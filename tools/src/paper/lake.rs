//! Figs. 17 and 18: bridge piers in a lake, on a straight track and with a deviation of the motion.

use std::path::Path;

use echotank_config::spec::ColourMap;
use echotank_core::scene::Target;
use echotank_imaging::image::line::{RangeAxis, mean_intensity};
use serde_json::{Value, json};

use super::pings::{self, RecordedPing};
use crate::picture::{self, ColourScale, Grid};

const CELL_M: f64 = 0.1;
const RANGE_M: f64 = 85.0;
/// Number of pixel rows per ping.
const ROWS: usize = 2;

pub(crate) fn figure_17(out: &Path) -> Result<Value, String> {
    let spec = pings::load("fig17.toml")?;
    let (pings, targets) = pings::run(&spec)?;
    let axis = RangeAxis::new(
        spec.medium.sound_speed_m_per_s,
        spec.sonars[0].receiver.sample_rate_hz,
    );
    let grid = waterfall(&pings, axis);
    let look = ColourScale::of_shares(&[&grid], ColourMap::Copper, 0.05, 0.998);
    picture::write(&out.join("fig17.png"), &[vec![(&grid, look)]])?;
    Ok(json!({
        "figure": "17", "picture": "slant range to the right, north up", "pings": pings.len(),
        "piers": piers(&pings, axis, &targets).iter().map(|p| json!({
            "name": p.name, "true_east_m": p.true_east_m, "slant_range_m": p.slant_range_m, "near_wall_shown_at_m": p.shown_range_m,
        })).collect::<Vec<_>>(),
    }))
}

pub(crate) fn figure_18(out: &Path) -> Result<Value, String> {
    let (straight, _) = pings::run(&pings::load("fig17.toml")?)?;
    let spec = pings::load("fig18.toml")?;
    let (pings, targets) = pings::run(&spec)?;
    let axis = RangeAxis::new(
        spec.medium.sound_speed_m_per_s,
        spec.sonars[0].receiver.sample_rate_hz,
    );
    let grid = waterfall(&pings, axis);
    // The curve beside the image has a row per ping, with sway from -15 to 15 m.
    let mut curve = Grid::new(150, grid.height);
    for (k, ping) in pings.iter().rev().enumerate() {
        let x = (ping.plan.nav.pose.position_m.y * 5.0 + 75.0).clamp(0.0, 149.0) as usize;
        for row in 0..ROWS {
            for i in 0..150 {
                curve.set(i, k * ROWS + row, 0.0);
            }
            curve.set(75, k * ROWS + row, 0.4);
            curve.set(x, k * ROWS + row, 1.0);
        }
    }
    let look = ColourScale::of_shares(&[&grid], ColourMap::Copper, 0.05, 0.998);
    let black_and_white = ColourScale {
        map: ColourMap::Grey,
        low: 0.0,
        high: 1.0,
    };
    picture::write(
        &out.join("fig18.png"),
        &[vec![(&curve, black_and_white), (&grid, look)]],
    )?;
    // Displacement of each pier, if the image is interpreted as from a straight track.
    let before = piers(&straight, axis, &targets);
    let shifts: Vec<Value> = piers(&pings, axis, &targets)
        .iter()
        .filter_map(|p| {
            let was = before.iter().find(|b| b.name == p.name)?;
            let moved_m = p.shown_east_m - was.shown_east_m;
            Some(json!({ "name": p.name, "sway_m": p.sway_m, "predicted_displacement_m": -p.sway_m, "displacement_m": moved_m }))
        })
        .collect();
    let greatest = pings
        .iter()
        .map(|h| h.plan.nav.pose.position_m.y.abs())
        .fold(0.0, f64::max);
    Ok(json!({
        "figure": "18", "picture": "sway, -15 to 15 m to starboard; slant range to the right, north up", "greatest_sway_m": greatest,
        "piers": shifts,
    }))
}

fn waterfall(pings: &[RecordedPing], axis: RangeAxis) -> Grid {
    let width = (RANGE_M / CELL_M) as usize;
    let mut grid = Grid::new(width, pings.len() * ROWS);
    let mut cells = vec![0.0; width];
    for (k, ping) in pings.iter().rev().enumerate() {
        mean_intensity(&ping.output.lines[0].amplitude, axis, CELL_M, &mut cells);
        for row in 0..ROWS {
            for (x, cell) in cells.iter().enumerate() {
                grid.set(x, k * ROWS + row, 10.0 * cell.log10());
            }
        }
    }
    grid
}

/// One pier in the ping abeam of it.
struct Pier {
    name: String,
    sway_m: f64,
    true_east_m: f64,
    slant_range_m: f64,
    shown_range_m: f64,
    /// Range of the upper edge (first echo), shown as an easting for a straight track at east 0.
    shown_east_m: f64,
}

/// Height of the upper edge of the piers above their centre, metres (`data/lake_piers.toml`).
const HALF_LENGTH_M: f64 = 9.0;
/// Radius of the piers, metres.
const RADIUS_M: f64 = 1.0;
/// Half length of the searched interval around the expected position of an echo, metres.
const SEARCH_M: f64 = 3.0;
/// Length of the interval that is averaged, metres. The first echo ends when the average falls below a
/// fraction of the maximum.
const STRETCH_M: f64 = 0.15;
const FIRST_SHARE: f32 = 0.2;

/// Piers without occlusion, by the first echo of the upper edge of their near wall.
fn piers(pings: &[RecordedPing], axis: RangeAxis, targets: &[Target]) -> Vec<Pier> {
    let hidden = |t: &Target| {
        targets.iter().any(|o| {
            let (to, from) = (o.position_m, t.position_m);
            (to.x - from.x).abs() < 0.5 && to.y < from.y && from.y - to.y < 8.0
        })
    };
    let mut rows = Vec::new();
    for target in targets.iter().filter(|t| !hidden(t)) {
        let off = |h: &RecordedPing| (h.plan.nav.pose.position_m.x - target.position_m.x).abs();
        let Some(ping) = pings.iter().min_by(|a, b| off(a).total_cmp(&off(b))) else {
            continue;
        };
        let pose = &ping.plan.nav.pose;
        let east_m = target.position_m.y - pose.position_m.y - RADIUS_M;
        let down_m = target.position_m.z - HALF_LENGTH_M - pose.position_m.z;
        let slant_range_m = east_m.hypot(down_m);
        let line = &ping.output.lines[0].amplitude;
        let near = axis.sample(slant_range_m - SEARCH_M)..axis.sample(slant_range_m + SEARCH_M);
        let Some(inside) = line.get(near.clone()) else {
            continue;
        };
        let stretch = axis.sample(STRETCH_M).max(1);
        let power: Vec<f32> = inside
            .windows(stretch)
            .map(|w| w.iter().map(|a| a * a).sum())
            .collect();
        let strongest = power.iter().copied().fold(0.0, f32::max);
        let Some(first) = power.iter().position(|p| *p > FIRST_SHARE * strongest) else {
            continue;
        };
        // The interval with the rise has the echo in its last part.
        let shown_range_m = axis.slant_range_m(near.start + first + stretch - 1);
        rows.push(Pier {
            name: target.name.clone(),
            sway_m: pose.position_m.y,
            true_east_m: target.position_m.y,
            slant_range_m,
            shown_range_m,
            shown_east_m: (shown_range_m * shown_range_m - down_m * down_m)
                .max(0.0)
                .sqrt(),
        });
    }
    rows
}
