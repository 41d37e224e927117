//! What the error models want to know of a ping, measured on its own motion and scatterers.

use glam::DVec3;

use crate::element_synthesis::filter_design;
use crate::method_selection::echo_statistics::echo_statistics;
use echotank_config::spec::SonarSpec;
use echotank_core::arrays::ArrayLine;
use echotank_core::model::Synthesis;
use echotank_core::ping::PingPlan;
use echotank_core::scene::Scatterers;
use echotank_synthesis::array::error_models::synthesis_error_model;
use echotank_synthesis::error_model::{Conditions, ErrorModel};

/// Instants of a ping at which its motion is looked at: a window of 0.2 s every 3 ms, far below any platform's periods.
const INSTANTS: usize = 64;
/// Rounding of finite differences, m/s^2 and m/s.
const STILL_M_PER_S2: f64 = 1e-9;
const STILL_M_PER_S: f64 = 1e-12;

/// Segments are as many as a window takes, all alike: so long is one where they are to be no longer than `segment_s`. An element's chord that is
/// alone in its window reaches as far as it is told to, beyond the window's end.
pub(crate) fn segment_step_s(window_s: f64, segment_s: f64) -> f64 {
    match (window_s / segment_s).ceil() {
        count if count > 1.0 => window_s / count,
        _ => segment_s,
    }
}

/// The worst of every transmitter and of both ends of every line, and of the middle of an arc.
pub fn conditions(spec: &SonarSpec, plan: &PingPlan, scatterers: &Scatterers) -> Conditions {
    let rate_hz = spec.receiver.sample_rate_hz;
    let step_s = plan.window_s(rate_hz) / INSTANTS as f64;
    let ends = spec
        .receive
        .iter()
        .flat_map(|array| array.outermost().map(|e| array.element_body_m(e)));
    let arms: Vec<DVec3> = spec
        .transmit
        .iter()
        .map(|transmit| transmit.mounting.position_m)
        .chain(ends)
        .collect();
    let (mut speed, mut acceleration, mut turning) = (0.0f64, 0.0f64, 0.0f64);
    let mut before: Vec<DVec3> = Vec::new();
    for k in 0..=INSTANTS {
        let pose = plan.trajectory.pose_at(k as f64 * step_s);
        for (i, &arm_m) in arms.iter().enumerate() {
            let velocity = pose.point_velocity_m_per_s(arm_m);
            speed = speed.max(velocity.length());
            turning = turning.max((velocity - pose.velocity_m_per_s).length());
            match before.get_mut(i) {
                Some(last) => {
                    acceleration = acceleration.max((velocity - *last).length() / step_s);
                    *last = velocity;
                }
                None => before.push(velocity),
            }
        }
    }
    let above = |value: f64, floor: f64| if value < floor { 0.0 } else { value };
    let pose = plan.trajectory.pose_at(0.0);
    let (mut nearest_m, mut farthest_m) = (f64::INFINITY, 0.0f64);
    let places = scatterers
        .north_m
        .iter()
        .zip(&scatterers.east_m)
        .zip(&scatterers.down_m);
    let place_m = |((&north_m, &east_m), &down_m)| DVec3::new(north_m, east_m, down_m);
    for &arm_m in &arms[..spec.transmit.len()] {
        let from = pose.point_m(arm_m);
        for range_m in places.clone().map(|place| from.distance(place_m(place))) {
            nearest_m = nearest_m.min(range_m);
            farthest_m = farthest_m.max(range_m);
        }
    }
    for array in &spec.receive {
        let line = ArrayLine::new(array, |body_m| pose.point_m(body_m));
        for place in places.clone() {
            nearest_m = nearest_m.min(line.distance_m(place_m(place)));
        }
    }
    // What lies beyond the window is not heard; what is nearer than a wavelength is no far field of anything.
    let farthest_m = farthest_m.clamp(1.0, 0.5 * plan.window_s(rate_hz) * plan.sound_speed_m_per_s);
    let wavelength_m = plan.sound_speed_m_per_s / plan.pulse.center_frequency_hz;
    Conditions {
        pulse: plan.pulse,
        sound_speed_m_per_s: plan.sound_speed_m_per_s,
        sample_rate_hz: rate_hz,
        filter: spec.receiver.filter,
        speed_m_per_s: speed,
        acceleration_m_per_s2: above(acceleration, STILL_M_PER_S2),
        turning_m_per_s: above(turning, STILL_M_PER_S),
        range_m: (nearest_m.clamp(wavelength_m, farthest_m), farthest_m),
        segment_s: segment_step_s(plan.window_s(rate_hz), plan.model.segment_s),
        scatterers: scatterers.len(),
        elements: spec.receive.iter().map(|array| array.elements).sum(),
        tolerance: spec.synthesis.tolerance,
        echo_statistics: echo_statistics(spec, plan, scatterers),
    }
}

/// The error model of a sum, with what the sonar's own settings do to it: a frequency step of one's own that is too coarse for the record lays late
/// echoes over early ones.
pub fn sum_error_model(
    synthesis: Synthesis,
    spec: &SonarSpec,
    plan: &PingPlan,
    conditions: &Conditions,
) -> ErrorModel {
    let filter = filter_design(spec, synthesis, sound_speed_of_design(conditions));
    let mut error_model = synthesis_error_model(synthesis, conditions, plan, filter);
    if synthesis == Synthesis::Spectral
        && let Some(step_hz) = spec.synthesis.frequency_step_hz
    {
        // An echo may have begun a pulse before the window.
        let heard_s = plan.sample_count as f64 / conditions.sample_rate_hz + plan.pulse.duration_s;
        if step_hz * heard_s > 1.0 {
            error_model.error = WRAPPED;
            error_model.why = format!(
                "steps of {step_hz:.2} Hz repeat every {:.4} s, but {heard_s:.4} s are received: late echoes overlap early ones",
                1.0 / step_hz
            );
        }
    }
    error_model
}

/// Errors of single echoes are kept, so the sound speed may not change them from ping to ping. A higher one gives a narrower filter, which fits.
pub(crate) fn sound_speed_of_design(conditions: &Conditions) -> f64 {
    sound_speed_step_up(conditions.sound_speed_m_per_s)
}

/// The next step up of a sound speed.
pub(crate) fn sound_speed_step_up(sound_speed_m_per_s: f64) -> f64 {
    (sound_speed_m_per_s / SOUND_SPEED_STEP_M_PER_S).ceil() * SOUND_SPEED_STEP_M_PER_S
}

/// Step of the sound speeds for which the filter of an error model is designed.
const SOUND_SPEED_STEP_M_PER_S: f64 = 10.0;

/// Of samples over which others of their kind are laid: as an echo turned upside down.
const WRAPPED: f64 = 2.0;
