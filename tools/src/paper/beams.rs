//! Fig. 11: five subarrays at 10 knots. Far-field beams of `conventional` are unfocused at short range and show each curve several
//! times. Beams of `dynamic-focus` do not.

use std::path::Path;

use echotank_config::spec::ColourMap;
use echotank_config::spec::{Former, RigSpec};
use echotank_core::ping::BeamFrame;
use echotank_ping::pipeline::SonarPipeline;
use glam::DVec3;
use serde_json::{Value, json};

use super::pings::{self, RecordedPing};
use super::strip::{CELL_M, Strip};
use crate::picture::{self, ColourScale, Grid};

/// Ranges of the points whose images are measured, metres.
const POINTS_M: [f64; 6] = [5.0, 10.0, 20.0, 35.0, 50.0, 75.0];

pub(crate) fn figure_11(out: &Path) -> Result<Value, String> {
    let mut grids = Vec::new();
    let mut rows = Vec::new();
    for name in ["fig11_conventional.toml", "fig11_focused.toml"] {
        let spec = pings::load(name)?;
        let (pings, _) = pings::run(&spec)?;
        grids.push(lay(&spec, &pings));
        rows.push(json!({ "config": name, "points": points(&spec, &pings[pings.len() / 2])? }));
    }
    let look = ColourScale::of_shares(&[&grids[1]], ColourMap::Copper, 0.05, 0.995);
    let panels: Vec<_> = grids.iter().map(|g| (g, look)).collect();
    picture::write(&out.join("fig11.png"), &[panels])?;
    Ok(json!({
        "figure": "11", "panels": "conventional, dynamic focus; slant range to the right, north up",
        "loss_db": "peak of the beams against the same point's under perfect focus (all subarrays in phase)",
        "false_alarm_db": "greatest level beyond one beam width (and half of it) of the point, against the peak",
        "rows": rows,
    }))
}

/// Along-track position of a sample of a beam. Focused beams refer to the position of the array at the start of the pulse.
/// Far-field beams refer to its position at reception.
fn along_m(spec: &RigSpec, ping: &RecordedPing, sine: f64, range_m: f64) -> f64 {
    let pose = &ping.plan.nav.pose;
    let c = ping.plan.sound_speed_m_per_s;
    let moved = match spec.sonars[0].beams.fan.as_ref().map(|f| f.form.former) {
        Some(Former::DynamicFocus) => 0.0,
        _ => pose.velocity_m_per_s.x * 2.0 * range_m / c,
    };
    pose.position_m.x + moved + range_m * sine
}

/// Image of the strip. Each cell has the level of the beam that passes nearest.
fn lay(spec: &RigSpec, pings: &[RecordedPing]) -> Grid {
    let mut strip = Strip::new();
    let rate_hz = spec.sonars[0].receiver.sample_rate_hz;
    for ping in pings {
        let fan = &ping.output.beams[0];
        let c = ping.plan.sound_speed_m_per_s;
        let step = fan.angle_rad[1] - fan.angle_rad[0];
        let sample = |range_m: f64| {
            ((2.0 * range_m / c - ping.plan.first_sample_s) * rate_hz).max(0.0) as usize
        };
        for x in 0..strip.grid.width {
            let range_m = Strip::range_m(x);
            let samples = sample(range_m - 0.5 * CELL_M)..sample(range_m + 0.5 * CELL_M);
            for (b, angle) in fan.angle_rad.iter().enumerate() {
                let Some(inside) = fan.beam(b).get(samples.clone()).filter(|s| !s.is_empty())
                else {
                    continue;
                };
                let square = |x: f32| f64::from(x) * f64::from(x);
                let powers = inside.iter().map(|y| square(y.re) + square(y.im));
                let power = powers.sum::<f64>() / inside.len() as f64;
                let at_m = along_m(spec, ping, angle.sin(), range_m);
                let reach_m = (0.75 * step * range_m).max(CELL_M);
                strip.lay(x, at_m, reach_m, 10.0 * power.log10() as f32);
            }
        }
    }
    strip.grid
}

/// Images of single points on the boresight plane: peak loss, width, and the strongest false echo.
fn points(spec: &RigSpec, ping: &RecordedPing) -> Result<Vec<Value>, String> {
    let mut wide = spec.clone();
    let sonar = &mut wide.sonars[0];
    let Some(fan) = &mut sonar.beams.fan else {
        return Err("the configuration has no fan".into());
    };
    // The fan is finer and wider than in the figure, and within the first null of the transmitter.
    fan.beams = 401;
    fan.sector_rad = 2.0_f64.to_radians();
    let (focused, array) = (fan.form.former == Former::DynamicFocus, fan.array);
    let array = sonar.receive[array].clone();
    let c = wide.medium.sound_speed_m_per_s;
    let wavelength_m = c / sonar.pulse.center_frequency_hz;
    let lobe = 0.886 * wavelength_m / (array.spacing_m * array.elements as f64);
    let mut pipeline =
        SonarPipeline::new(&wide.sonars[0], &wide.medium).map_err(|e| e.to_string())?;
    let mut output = pipeline.blank_output();
    let (plan, pose) = (&ping.plan, &ping.plan.nav.pose);
    let down = 30f64.to_radians();
    let mut rows = Vec::new();
    for range_m in POINTS_M {
        let north_m = pose.velocity_m_per_s.x * range_m / c;
        let at = pose.position_m + DVec3::new(north_m, range_m * down.cos(), range_m * down.sin());
        pipeline.compute_ping(plan, &pings::point(at), &mut output);
        let fan = &output.beams[0];
        let levels = greatest_of_each(fan);
        let peak = (0..fan.beams).fold(0, |b, k| if levels[k] > levels[b] { k } else { b });
        let single = single_element_level(&output.elements[0]);
        let half = levels[peak] * 0.5_f64.sqrt();
        let side = |step: isize| {
            let mut k = peak;
            while k > 0 && k + 1 < fan.beams && levels[k] > half {
                k = k.saturating_add_signed(step);
            }
            fan.angle_rad[k].sin()
        };
        let width_m = range_m * (side(1) - side(-1));
        // The point is relative to the array at transmission or reception, as the beamformer requires.
        let sine = if focused { north_m } else { -north_m } / range_m;
        let outside = (0..fan.beams)
            .filter(|&k| (fan.angle_rad[k].sin() - sine).abs() > 1.5 * lobe)
            // The search extends half way to the grating lobes, which the transmitter and the subarrays suppress.
            .filter(|&k| {
                (fan.angle_rad[k].sin() - sine).abs() < 0.5 * wavelength_m / array.spacing_m
            })
            .map(|k| levels[k])
            .fold(0.0, f64::max);
        rows.push(json!({
            "range_m": range_m,
            "loss_db": 20.0 * (levels[peak] / single).log10(),
            "width_m": width_m, "width_far_field_m": lobe * range_m,
            "off_m": range_m * (fan.angle_rad[peak].sin() - sine),
            "false_alarm_db": 20.0 * (outside / levels[peak]).log10(),
        }));
    }
    Ok(rows)
}

fn greatest_of_each(fan: &BeamFrame) -> Vec<f64> {
    (0..fan.beams)
        .map(|b| f64::from(fan.beam(b).iter().map(|y| y.norm()).fold(0.0, f32::max)))
        .collect()
}

/// Mean level of the elements during the echo: the peak of a matched filter with full coherence.
fn single_element_level(frame: &echotank_core::ping::ElementFrame) -> f64 {
    let each = (0..frame.elements).map(|e| {
        let mut levels: Vec<f64> = frame.element(e).iter().map(|y| y.norm()).collect();
        levels.sort_by(f64::total_cmp);
        // The echo is flat over its pulse. The level is that which a hundred samples exceed.
        levels[levels.len() - 100]
    });
    each.sum::<f64>() / frame.elements as f64
}
