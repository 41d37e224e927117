//! Directions of the beams of a fan: their angles, and their sines towards the array's +x, which steer them.

use std::f64::consts::{FRAC_PI_2, TAU};

use glam::DVec3;

use echotank_config::spec::{BeamSpacing, FanSpec};
use echotank_core::arrays::ArrayGeometry;
use echotank_core::ping::PingPlan;

/// Limit on the angle of equi-distant beams, because the distance on the bottom is unbounded towards the horizontal.
const MAX_ANGLE_RAD: f64 = 1.55;

/// Directions of one fan.
pub(super) struct Directions {
    /// Configured angles; relative to the vertical if the fan is roll-stabilised.
    set_rad: Vec<f64>,
    roll_stabilised: bool,
    towards_x: f64,
    roll_rad: f64,
    /// Angle of each beam from the boresight, positive to starboard (on a fore-and-aft array: towards its +x).
    pub(super) angle_rad: Vec<f64>,
    /// Sine of each beam's angle towards the array's +x.
    pub(super) sine: Vec<f64>,
}

impl Directions {
    pub(super) fn new(array: &ArrayGeometry, fan: &FanSpec) -> Self {
        let x_in_body = array.mounting.body_from_array * DVec3::X;
        let mut directions = Self {
            set_rad: (0..fan.beams).map(|b| beam_angle_rad(fan, b)).collect(),
            roll_stabilised: fan.form.roll_stabilised,
            towards_x: if x_in_body.y < -1e-9 { -1.0 } else { 1.0 },
            roll_rad: 0.0,
            angle_rad: vec![0.0; fan.beams],
            sine: vec![0.0; fan.beams],
        };
        directions.turn(0.0);
        directions
    }

    /// Updates the directions for this ping. Returns true if they changed. With starboard roll the boresight turns to port, so that
    /// stabilised beams are steered back by the roll.
    pub(super) fn aim(&mut self, plan: &PingPlan) -> bool {
        if !self.roll_stabilised || plan.nav.roll_rad == self.roll_rad {
            return false;
        }
        self.turn(plan.nav.roll_rad);
        true
    }

    fn turn(&mut self, roll_rad: f64) {
        self.roll_rad = roll_rad;
        for ((set, angle), sine) in self
            .set_rad
            .iter()
            .zip(&mut self.angle_rad)
            .zip(&mut self.sine)
        {
            *angle = (set + roll_rad).clamp(-FRAC_PI_2, FRAC_PI_2);
            *sine = self.towards_x * angle.sin();
        }
    }
}

/// Beam 0 is at the sector's port end; a single beam is at its centre.
fn beam_angle_rad(fan: &FanSpec, beam: usize) -> f64 {
    let middle = fan.form.center_rad;
    if fan.beams == 1 {
        return middle;
    }
    let share = beam as f64 / (fan.beams - 1) as f64;
    let ends = [middle - 0.5 * fan.sector_rad, middle + 0.5 * fan.sector_rad];
    let between = |a: f64, b: f64| a + (b - a) * share;
    match fan.form.spacing {
        BeamSpacing::EquiAngle => middle + fan.sector_rad * (share - 0.5),
        BeamSpacing::EquiDistant => {
            let [a, b] = ends.map(|end| end.clamp(-MAX_ANGLE_RAD, MAX_ANGLE_RAD).tan());
            between(a, b).atan()
        }
        BeamSpacing::EquiSine => {
            let [a, b] = ends.map(|end| end.clamp(-FRAC_PI_2, FRAC_PI_2).sin());
            between(a, b).clamp(-1.0, 1.0).asin()
        }
    }
}

/// -3 dB width of every beam, radians. The response of a line array has the same width in sine for every steering angle.
pub(super) fn widths_rad(
    weights: &[f64],
    spacing_wavelengths: f64,
    sines: &[f64],
    widths: &mut [f64],
) {
    let middle = (weights.len() as f64 - 1.0) / 2.0;
    let half = half_power_sine(weights, |e| (e as f64 - middle) * spacing_wavelengths);
    for (width, sine) in widths.iter_mut().zip(sines) {
        let edge = |s: f64| match s.abs() < 1.0 {
            true => s.asin(),
            false => FRAC_PI_2.copysign(s),
        };
        *width = edge(sine + half) - edge(sine - half);
    }
}

/// Offset in sine at which the response of elements at these places, in wavelengths, falls to half its power; infinite if it never does (one element).
pub(super) fn half_power_sine(weights: &[f64], place_wavelengths: impl Fn(usize) -> f64) -> f64 {
    // The weights are symmetrical, so that the response is real.
    let response = |sine: f64| -> f64 {
        let elements = weights.iter().enumerate();
        elements
            .map(|(e, w)| w * (TAU * place_wavelengths(e) * sine).cos())
            .sum()
    };
    let threshold = 0.5_f64.sqrt();
    let reach = place_wavelengths(weights.len() - 1).abs();
    if reach == 0.0 {
        return f64::INFINITY;
    }
    let step = 1.0 / (128.0 * reach);
    let mut inside = 0.0;
    while response(inside + step) > threshold {
        inside += step;
        // Two is the largest offset between real directions.
        if inside > 2.0 {
            return f64::INFINITY;
        }
    }
    let mut outside = inside + step;
    for _ in 0..60 {
        let middle = 0.5 * (inside + outside);
        if response(middle) > threshold {
            inside = middle;
        } else {
            outside = middle;
        }
    }
    inside
}
