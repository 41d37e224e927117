//! Figs. 17 and 18: bridge piers in a lake, on a straight track and under a deviation of the motion.

use std::path::Path;

use echotank::flow::Target;
use echotank::image::colour::ColourMap;
use echotank::image::line::{RangeAxis, mean_intensity};
use serde_json::{Value, json};

use super::picture::{self, Grid, Look};
use super::pings::{self, Heard};

const CELL_M: f64 = 0.1;
const RANGE_M: f64 = 85.0;
/// Rows of one ping.
const ROWS: usize = 2;

pub fn figure_17(out: &Path) -> Result<Value, String> {
    let spec = pings::load("fig17.toml")?;
    let (heard, targets) = pings::run(&spec)?;
    let axis = RangeAxis::new(
        spec.medium.sound_speed_m_per_s,
        spec.sonars[0].receiver.sample_rate_hz,
    );
    let grid = waterfall(&heard, axis);
    let look = Look::of_shares(&[&grid], ColourMap::Copper, 0.05, 0.998);
    picture::write(&out.join("fig17.png"), &[(&grid, look)])?;
    Ok(json!({
        "figure": "17", "picture": "slant range to the right, north up", "pings": heard.len(),
        "piers": piers(&heard, axis, &targets, 0.0),
    }))
}

pub fn figure_18(out: &Path) -> Result<Value, String> {
    let spec = pings::load("fig18.toml")?;
    let (heard, targets) = pings::run(&spec)?;
    let axis = RangeAxis::new(
        spec.medium.sound_speed_m_per_s,
        spec.sonars[0].receiver.sample_rate_hz,
    );
    let grid = waterfall(&heard, axis);
    // The curve beside the picture: a row per ping, sway from -15 to 15 m.
    let mut curve = Grid::new(150, grid.height);
    for (k, ping) in heard.iter().rev().enumerate() {
        let x = (ping.plan.nav.pose.position_m.y * 5.0 + 75.0).clamp(0.0, 149.0) as usize;
        for row in 0..ROWS {
            for i in 0..150 {
                curve.set(i, k * ROWS + row, 0.0);
            }
            curve.set(75, k * ROWS + row, 0.4);
            curve.set(x, k * ROWS + row, 1.0);
        }
    }
    let look = Look::of_shares(&[&grid], ColourMap::Copper, 0.05, 0.998);
    let black_and_white = Look {
        map: ColourMap::Grey,
        low: 0.0,
        high: 1.0,
    };
    picture::write(
        &out.join("fig18.png"),
        &[(&curve, black_and_white), (&grid, look)],
    )?;
    let greatest = heard
        .iter()
        .map(|h| h.plan.nav.pose.position_m.y.abs())
        .fold(0.0, f64::max);
    Ok(json!({
        "figure": "18", "picture": "sway, -15 to 15 m to starboard; slant range to the right, north up", "greatest_sway_m": greatest,
        "piers": piers(&heard, axis, &targets, 0.0),
    }))
}

fn waterfall(heard: &[Heard], axis: RangeAxis) -> Grid {
    let width = (RANGE_M / CELL_M) as usize;
    let mut grid = Grid::new(width, heard.len() * ROWS);
    let mut cells = vec![0.0; width];
    for (k, ping) in heard.iter().rev().enumerate() {
        mean_intensity(&ping.output.lines[0].amplitude, axis, CELL_M, &mut cells);
        for row in 0..ROWS {
            for (x, cell) in cells.iter().enumerate() {
                grid.set(x, k * ROWS + row, 10.0 * cell.log10());
            }
        }
    }
    grid
}

/// For each pier: the slant range at which its ping shows it, against the truth, and where a straight track at `track_east_m` would put it.
fn piers(heard: &[Heard], axis: RangeAxis, targets: &[Target], track_east_m: f64) -> Vec<Value> {
    let mut rows = Vec::new();
    for target in targets {
        let abeam = heard.iter().min_by(|a, b| {
            let off = |h: &Heard| (h.plan.nav.pose.position_m.x - target.position_m.x).abs();
            off(a).total_cmp(&off(b))
        });
        let Some(ping) = abeam else { continue };
        let pose = &ping.plan.nav.pose;
        if (pose.position_m.x - target.position_m.x).abs() > 1.0 {
            continue;
        }
        let east_m = target.position_m.y - pose.position_m.y;
        let down_m = target.position_m.z - pose.position_m.z;
        let slant_m = east_m.hypot(down_m);
        // The wall that faces the sonar stands a radius nearer; at its top it is nearer still: the first strong echo within 8 m.
        let line = &ping.output.lines[0].amplitude;
        let near = axis.sample(slant_m - 8.0)..axis.sample(slant_m + 2.0).min(line.len());
        let first = near.start;
        let brightest = line[near]
            .iter()
            .enumerate()
            .fold((0, 0.0_f32), |b, (k, a)| if *a > b.1 { (k, *a) } else { b });
        let shown_m = axis.slant_range_m(first + brightest.0);
        let shown_east_m = (shown_m * shown_m - down_m * down_m).max(0.0).sqrt() + track_east_m;
        rows.push(json!({
            "name": target.name, "sway_m": pose.position_m.y, "slant_range_m": slant_m, "brightest_at_m": shown_m,
            "true_east_m": target.position_m.y, "east_if_the_track_were_straight_m": shown_east_m,
            "displacement_m": shown_east_m - target.position_m.y, "predicted_displacement_m": -pose.position_m.y,
        }));
    }
    rows
}
