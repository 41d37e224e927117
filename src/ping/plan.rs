//! The plan of one ping: all data of the ping that the model needs.
//!
//! Input: settings, specifications and the motion of the platform. Output: [`PingPlan`]. The plan is filled when the navigation around the pulse is
//! known.

use echotank_config::spec::{MediumSpec, SonarSpec};
use echotank_core::frames::Trajectory;
use echotank_core::navigation::NavState;
use echotank_core::ping::{PingPlan, Segment, SensorState};
use echotank_core::pulse::Pulse;
use echotank_core::settings::SonarSettings;
use echotank_core::time::{NS_PER_S, UtcNs};

use crate::range_floors;
use crate::schedule::{PingOrder, period_ns, window_s};

/// Number of samples that cover [`window_s`], at least 1.
pub fn sample_count(
    settings: &SonarSettings,
    sound_speed_m_per_s: f64,
    sample_rate_hz: f64,
) -> usize {
    // The subtraction prevents rounding from adding a sample to a window of a whole number of samples.
    (window_s(settings, sound_speed_m_per_s) * sample_rate_hz - 1e-6)
        .ceil()
        .max(1.0) as usize
}

/// Pulse of the sonar with these settings.
pub fn pulse(spec: &SonarSpec, settings: &SonarSettings) -> Pulse {
    Pulse {
        duration_s: settings.pulse_duration_s,
        ..spec.pulse
    }
}

/// Computes the vertices of the polyline over `window_s`. Vertices are at most `segment_s` apart. Velocities are along the chords; each segment has
/// the attitude at its start (Meng et al. 2023, section 3.1: "the attitude change only occurs at the polyline intersection"). Reuses `segments`.
pub fn polyline(
    trajectory: &Trajectory,
    window_s: f64,
    segment_s: f64,
    segments: &mut Vec<Segment>,
) {
    segments.clear();
    let count = (window_s / segment_s).ceil().max(1.0) as usize;
    let step_s = window_s / count as f64;
    let mut here = trajectory.pose_at(0.0);
    for k in 0..count {
        let start_s = k as f64 * step_s;
        let next = trajectory.pose_at(start_s + step_s);
        segments.push(Segment {
            start_s,
            position_m: here.position_m,
            velocity_m_per_s: (next.position_m - here.position_m) / step_s,
            world_from_body: here.world_from_body,
        });
        here = next;
    }
}

/// Settings of the longest window within the sonar's limits.
fn longest(spec: &SonarSpec) -> SonarSettings {
    SonarSettings {
        range_m: spec.limits.range_m.1,
        pulse_duration_s: spec.limits.pulse_duration_s.1,
        ..spec.settings
    }
}

/// Number of samples of the longest window within the limits, for sizing buffers.
pub fn max_samples(spec: &SonarSpec, sound_speed_m_per_s: f64) -> usize {
    sample_count(
        &longest(spec),
        sound_speed_m_per_s,
        spec.receiver.sample_rate_hz,
    )
}

/// Maximum number of segments of a polyline within the limits, for sizing buffers.
pub fn max_segments(spec: &SonarSpec, sound_speed_m_per_s: f64) -> usize {
    (window_s(&longest(spec), sound_speed_m_per_s) / spec.model.segment_s).ceil() as usize + 1
}

/// Creates a plan with capacity for all settings within the limits. [`fill`] sets the data of a ping.
pub fn blank(
    sonar: usize,
    spec: &SonarSpec,
    medium: &MediumSpec,
    absorption_db_per_m: f64,
) -> PingPlan {
    PingPlan {
        sonar,
        ping_number: 0,
        transmit_utc: UtcNs(0),
        stamp_utc: UtcNs(0),
        ping_period_s: 0.0,
        settings: spec.settings,
        ping_rate_hz: 0.0,
        pulse: spec.pulse,
        sound_speed_m_per_s: medium.sound_speed_m_per_s,
        refraction: None,
        absorption_db_per_m,
        sample_count: 0,
        first_sample_s: 0.0,
        model: spec.model,
        range_floors: range_floors::with_room(),
        nav: NavState::default(),
        sensor: SensorState::default(),
        trajectory: Trajectory::default(),
        segments: Vec::with_capacity(max_segments(spec, medium.sound_speed_m_per_s)),
    }
}

/// Sets `plan` to the plan of `order`. The caller has stored the motion of the ping in `plan.trajectory`.
pub fn fill(
    plan: &mut PingPlan,
    spec: &SonarSpec,
    order: &PingOrder,
    nav: NavState,
    stamp_utc: UtcNs,
) {
    let c = plan.sound_speed_m_per_s;
    plan.ping_number = order.ping_number;
    plan.transmit_utc = order.transmit_utc;
    plan.stamp_utc = stamp_utc;
    plan.ping_period_s = order.period_s;
    plan.settings = order.settings;
    plan.ping_rate_hz = NS_PER_S as f64 / period_ns(&order.settings, c) as f64;
    plan.pulse = pulse(spec, &order.settings);
    plan.sample_count = sample_count(&order.settings, c, spec.receiver.sample_rate_hz);
    plan.nav = nav;
    let window_s = plan.window_s(spec.receiver.sample_rate_hz);
    polyline(
        &plan.trajectory,
        window_s,
        plan.model.segment_s,
        &mut plan.segments,
    );
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::schedule::tests::settings;
    use echotank_core::frames::rotation_from_angles;
    use glam::DVec3;

    #[test]
    fn a_window_of_a_whole_number_of_samples_gains_none() {
        assert_eq!(sample_count(&settings(), 1500.0, 10_000.0), 1020);
        let mut s = settings();
        s.range_m += 1e-2;
        assert_eq!(sample_count(&s, 1500.0, 10_000.0), 1021);
    }

    #[test]
    fn polyline_of_a_straight_track_has_its_velocity_and_covers_the_window() {
        let v = DVec3::new(4.0, 2.0, 0.3);
        let trajectory = Trajectory::uniform(
            DVec3::new(10.0, 0.0, 3.0),
            v,
            rotation_from_angles(0.1, 0.0, 1.0),
        );
        let mut segments = Vec::new();
        polyline(&trajectory, 0.21, 0.05, &mut segments);
        assert_eq!(segments.len(), 5);
        for segment in &segments {
            assert!((segment.velocity_m_per_s - v).length() < 1e-12);
            assert!(
                (segment.position_m - (DVec3::new(10.0, 0.0, 3.0) + v * segment.start_s)).length()
                    < 1e-12
            );
        }
    }
}
