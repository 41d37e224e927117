//! Figs. 6 and 7: direction of the receive beam. The direction is fixed with `stop-and-hop`. With `polyline`, it moves with the
//! array until reception.

use std::path::Path;

use echotank_config::spec::ColourMap;
use echotank_config::spec::{PaperShape, RigSpec};
use echotank_scene::paper;
use glam::DVec3;
use serde_json::{Value, json};

use super::pings;
use crate::picture::{self, ColourScale, Grid};

const CELL_M: f64 = 0.05;
const NORTH_M: (f64, f64) = (-6.0, 6.0);
const EAST_M: (f64, f64) = (10.0, 75.0);

/// Values at a bottom position for one ping.
struct Seen {
    /// Receive pattern, dB, with either path model.
    stop_db: f64,
    moving_db: f64,
    path_m: f64,
    incidence_rad: f64,
    arrival_rad: f64,
}

struct Rig {
    speed_m_per_s: f64,
    c: f64,
    length_wavelengths: f64,
}

impl Rig {
    fn of(spec: &RigSpec) -> Result<Self, String> {
        let (pings, _) = pings::run(spec)?;
        let sonar = &spec.sonars[0];
        let c = spec.medium.sound_speed_m_per_s;
        Ok(Self {
            speed_m_per_s: pings[0].plan.nav.pose.velocity_m_per_s.x,
            c,
            length_wavelengths: sonar.receive[0].spacing_m * sonar.pulse.center_frequency_hz / c,
        })
    }

    fn seen(&self, north_m: f64, east_m: f64) -> Option<Seen> {
        let down_m = paper::sample(PaperShape::Curves, north_m, east_m)?.down_m;
        let at = DVec3::new(north_m, east_m, down_m);
        let v = DVec3::X * self.speed_m_per_s;
        let out_m = at.length();
        // Eq. 5 by iteration. Each step reduces the error by v/c.
        let mut delay_s = 2.0 * out_m / self.c;
        for _ in 0..20 {
            delay_s = (out_m + at.distance(v * delay_s)) / self.c;
        }
        let back = at - v * delay_s;
        let pattern_db = |sine: f64| {
            let x = std::f64::consts::PI * self.length_wavelengths * sine;
            let level = if x.abs() < 1e-9 {
                1.0
            } else {
                (x.sin() / x).abs()
            };
            20.0 * level.max(1e-3).log10()
        };
        Some(Seen {
            stop_db: pattern_db(at.x / out_m),
            moving_db: pattern_db(back.x / back.length()),
            path_m: self.c * delay_s,
            // Eqs. 9 and 10.
            incidence_rad: (down_m / back.length()).acos(),
            arrival_rad: (back.x / back.length()).acos(),
        })
    }

    /// Panel of the bottom, with east to the right and north up. It shows `value` within 3 dB of the beam axis, or everywhere.
    fn panel(&self, value: impl Fn(&Seen) -> Option<f64>) -> Grid {
        let width = ((EAST_M.1 - EAST_M.0) / CELL_M / 2.0) as usize;
        let height = ((NORTH_M.1 - NORTH_M.0) / CELL_M) as usize;
        let mut grid = Grid::new(width, height);
        for y in 0..height {
            for x in 0..width {
                let north_m = NORTH_M.1 - (y as f64 + 0.5) * CELL_M;
                let east_m = EAST_M.0 + (x as f64 + 0.5) * 2.0 * CELL_M;
                if let Some(level) = self.seen(north_m, east_m).as_ref().and_then(&value) {
                    grid.set(x, y, level as f32);
                }
            }
        }
        grid
    }

    /// Along-track position of the beam axis at an easting, by bisection.
    fn axis_m(&self, east_m: f64) -> Option<f64> {
        let (mut low, mut high) = (-5.0, 5.0);
        for _ in 0..60 {
            let middle = 0.5 * (low + high);
            let seen = self.seen(middle, east_m)?;
            if seen.arrival_rad < std::f64::consts::FRAC_PI_2 {
                high = middle;
            } else {
                low = middle;
            }
        }
        Some(0.5 * (low + high))
    }
}

pub(crate) fn figure_6(out: &Path) -> Result<Value, String> {
    let spec = pings::load("fig6.toml")?;
    let rig = Rig::of(&spec)?;
    let stop = rig.panel(|s| Some(s.stop_db));
    let moving = rig.panel(|s| Some(s.moving_db));
    let path = rig.panel(|s| (s.moving_db > -12.0).then_some(s.path_m));
    let mut bottom = Grid::new(stop.width, stop.height);
    for y in 0..bottom.height {
        for x in 0..bottom.width {
            let north_m = NORTH_M.1 - (y as f64 + 0.5) * CELL_M;
            let east_m = EAST_M.0 + (x as f64 + 0.5) * 2.0 * CELL_M;
            if let Some(depth) = paper::sample(PaperShape::Curves, north_m, east_m) {
                bottom.set(x, y, -depth.down_m as f32);
            }
        }
    }
    let level = ColourScale {
        map: ColourMap::Copper,
        low: -30.0,
        high: 0.0,
    };
    picture::write(
        &out.join("fig6.png"),
        &[vec![
            (
                &bottom,
                ColourScale::of_shares(&[&bottom], ColourMap::Rainbow, 0.0, 1.0),
            ),
            (&stop, level),
            (&moving, level),
            (
                &path,
                ColourScale::of_shares(&[&path], ColourMap::Rainbow, 0.0, 1.0),
            ),
        ]],
    )?;
    let rows: Vec<Value> = [20.0, 30.0, 45.0, 60.0, 74.0]
        .into_iter()
        .filter_map(|east_m| {
            let north_m = rig.axis_m(east_m)?;
            let seen = rig.seen(north_m, east_m)?;
            let range_m = 0.5 * seen.path_m;
            Some(json!({
                "east_m": east_m, "slant_range_m": range_m, "axis_ahead_m": north_m,
                "predicted_2_r_v_over_c_m": 2.0 * range_m * rig.speed_m_per_s / rig.c,
                "footprint_width_m": 0.886 / rig.length_wavelengths * range_m,
            }))
        })
        .collect();
    Ok(json!({
        "figure": "6", "panels": "bottom; receive pattern of stop-and-hop; of polyline, 30 dB; propagation distance within it. East to the right from 10 to 75 m, north up from -6 to 6 m",
        "speed_m_per_s": rig.speed_m_per_s, "rows": rows,
    }))
}

pub(crate) fn figure_7(out: &Path) -> Result<Value, String> {
    let spec = pings::load("fig6.toml")?;
    let rig = Rig::of(&spec)?;
    let within = |s: &Seen| s.moving_db > -12.0;
    let incidence = rig.panel(|s| within(s).then_some(s.incidence_rad.to_degrees()));
    let arrival = rig.panel(|s| within(s).then_some(s.arrival_rad.to_degrees()));
    picture::write(
        &out.join("fig7.png"),
        &[vec![
            (
                &incidence,
                ColourScale::of_shares(&[&incidence], ColourMap::Rainbow, 0.0, 1.0),
            ),
            (
                &arrival,
                ColourScale::of_shares(&[&arrival], ColourMap::Rainbow, 0.0, 1.0),
            ),
        ]],
    )?;
    let span = |grid: &Grid| {
        grid.level
            .iter()
            .filter(|x| x.is_finite())
            .fold((f32::INFINITY, f32::NEG_INFINITY), |(a, b), x| {
                (a.min(*x), b.max(*x))
            })
    };
    Ok(json!({
        "figure": "7", "panels": "incidence from the vertical (Eq. 9); direction of arrival from the track (Eq. 10); within 12 dB of the beam's axis",
        "incidence_deg": span(&incidence), "arrival_deg": span(&arrival),
    }))
}
