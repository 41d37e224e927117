//! Fig. 10: a single beam at 3 and at 10 knots. If the footprint of a ping is narrower than the advance to the next ping, the image
//! has gaps: r theta < v T, with T the time between pings (Eq. 2 with T = 2 R/c).

use std::path::Path;

use echotank_config::spec::ColourMap;
use echotank_imaging::image::line::RangeAxis;
use echotank_ping::pipeline::SonarPipeline;
use glam::DVec3;
use serde_json::{Value, json};

use super::pings::{self, RecordedPing};
use super::strip::{CELL_M, RANGE_M, Strip};
use crate::picture::{self, ColourScale, Grid};

/// Number of ranges at which the echo between pings is computed.
const STEPS: usize = 92;

pub(crate) fn figure_10(out: &Path) -> Result<Value, String> {
    let mut grids = Vec::new();
    let mut numbers = Vec::new();
    for (name, knots) in [("fig10_3kn.toml", 3.0), ("fig10_10kn.toml", 10.0)] {
        let spec = pings::load(name)?;
        let sonar = &spec.sonars[0];
        let c = spec.medium.sound_speed_m_per_s;
        let length_m = sonar.receive[0].spacing_m;
        let theta_rad = 0.886 * c / sonar.pulse.center_frequency_hz / length_m;
        let (pings, _) = pings::run(&spec)?;
        let axis = RangeAxis::new(c, sonar.receiver.sample_rate_hz);
        let grid = lay(&pings, axis, theta_rad, c);
        let speed = pings[0].plan.nav.pose.velocity_m_per_s.x;
        let period_s = pings[1].plan.ping_period_s;
        let predicted_m = speed * period_s / theta_rad;
        let measured_m = fractured_to_m(&grid);
        let echo_m = half_way_echo_m(&spec, &pings[pings.len() / 2])?;
        numbers.push(json!({
            "config": name, "knots": knots, "speed_m_per_s": speed, "ping_period_s": period_s, "beam_deg": theta_rad.to_degrees(),
            "gaps_nearer_than_m": { "predicted_r_eq_vT_over_theta": predicted_m, "measured_in_picture": measured_m, "measured_by_echo_between_pings": echo_m },
            "eq2_fastest_m_per_s_at_75_m": theta_rad * c / 2.0,
            "gaps_nearer_than_m_if_a_ping_followed_the_other_at_once_2Rv_over_c_theta": 2.0 * sonar.settings.range_m * speed / (c * theta_rad),
        }));
        grids.push(grid);
    }
    let look = ColourScale::of_shares(&[&grids[0]], ColourMap::Copper, 0.05, 0.995);
    picture::write(
        &out.join("fig10.png"),
        &[vec![(&grids[0], look), (&grids[1], look)]],
    )?;
    Ok(
        json!({ "figure": "10", "panels": "3 knots, 10 knots; slant range to the right, north up", "rows": numbers }),
    )
}

/// Image of the strip. Each ping fills its own -3 dB footprint, centred between its transmit and receive positions.
fn lay(pings: &[RecordedPing], axis: RangeAxis, theta_rad: f64, c: f64) -> Grid {
    let mut strip = Strip::new();
    for ping in pings {
        let pose = &ping.plan.nav.pose;
        let line = &ping.output.lines[0].amplitude;
        for x in 0..strip.grid.width {
            let range_m = Strip::range_m(x);
            let samples = axis.sample(range_m - 0.5 * CELL_M)..axis.sample(range_m + 0.5 * CELL_M);
            let Some(inside) = line.get(samples).filter(|s| !s.is_empty()) else {
                continue;
            };
            let power = inside.iter().map(|a| a * a).sum::<f32>() / inside.len() as f32;
            let middle_m = pose.position_m.x + pose.velocity_m_per_s.x * range_m / c;
            strip.lay(x, middle_m, 0.5 * theta_rad * range_m, 10.0 * power.log10());
        }
    }
    strip.grid
}

/// Range up to which the image has gaps: the farthest column with more than one empty cell in a hundred (rows at the ends excluded).
fn fractured_to_m(grid: &Grid) -> Option<f64> {
    let rows = grid.height / 8..grid.height * 7 / 8;
    (0..grid.width)
        .rev()
        .find(|&x| {
            let empty = rows
                .clone()
                .filter(|y| grid.level[y * grid.width + x].is_nan())
                .count();
            empty * 100 > rows.len()
        })
        .map(|x| RANGE_M.0 + x as f64 * CELL_M)
}

/// Range at which the echo of a point half way between two pings is 6 dB (3 dB each way) below that of a point on the beam axis.
fn half_way_echo_m(
    spec: &echotank_config::spec::RigSpec,
    ping: &RecordedPing,
) -> Result<Option<f64>, String> {
    let sonar = &spec.sonars[0];
    let mut pipeline = SonarPipeline::new(sonar, &spec.medium).map_err(|e| e.to_string())?;
    let mut output = pipeline.blank_output();
    let plan = &ping.plan;
    let (pose, c) = (&plan.nav.pose, plan.sound_speed_m_per_s);
    let period_s = ping.plan.ping_period_s;
    let mut level = |north_m: f64, range_m: f64| {
        // The point is along the boresight, 30 degrees down to starboard.
        let down = 30f64.to_radians();
        let at = pose.position_m + DVec3::new(north_m, range_m * down.cos(), range_m * down.sin());
        pipeline.compute_ping(plan, &pings::point(at), &mut output);
        f64::from(
            output.lines[0]
                .amplitude
                .iter()
                .copied()
                .fold(0.0, f32::max),
        )
    };
    let speed = pose.velocity_m_per_s.x;
    let mut last: Option<(f64, f64)> = None;
    for bin in 0..STEPS {
        let range_m = 8.0 + bin as f64 * 0.75;
        let middle_m = speed * range_m / c;
        let loss_db = 20.0
            * (level(middle_m + 0.5 * speed * period_s, range_m) / level(middle_m, range_m))
                .log10();
        if let Some((near_m, near_db)) = last
            && near_db < -6.02
            && loss_db >= -6.02
        {
            let share = (-6.02 - near_db) / (loss_db - near_db);
            return Ok(Some(near_m + share * (range_m - near_m)));
        }
        last = Some((range_m, loss_db));
    }
    Ok(None)
}
