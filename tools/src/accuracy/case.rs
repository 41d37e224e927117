//! Knots of exactly known motions for all cases.

use echotank_core::frames::AttitudeKnot;
use glam::DQuat;

/// Half the step of central differences, seconds.
pub(crate) const STEP_S: f64 = 1e-4;

/// Knots of a known attitude, every `every_s` seconds, from two knots before the pulse to two after
/// `until_s`.
pub(crate) fn attitude_knots(
    every_s: f64,
    until_s: f64,
    attitude: impl Fn(f64) -> DQuat,
) -> Vec<AttitudeKnot> {
    let knot = |time_s: f64| {
        let turn = attitude(time_s - STEP_S).inverse() * attitude(time_s + STEP_S);
        AttitudeKnot {
            time_s,
            world_from_body: attitude(time_s),
            body_rate_rad_per_s: turn.to_scaled_axis() / (2.0 * STEP_S),
        }
    };
    knot_times_s(every_s, until_s).map(knot).collect()
}

pub(crate) fn knot_times_s(every_s: f64, until_s: f64) -> impl Iterator<Item = f64> {
    (-2..=(until_s / every_s).ceil() as i64 + 2).map(move |k| k as f64 * every_s)
}
