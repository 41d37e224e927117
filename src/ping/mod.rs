//! The plan of one ping: when it goes out, what it may be obeyed to do, and everything the model needs to know of it.
//!
//! In: settings, specifications, the platform's motion. Out: [`PingPlan`].
//!
//! [`Schedule`] decides `t_tx` and freezes the settings at that instant ([`PingOrder`]), on a beat of its own or when it is triggered;
//! [`beats`] has those of all sonars. The plan is filled later, when the navigation around `t_tx` is known.

pub mod beats;
pub mod trigger;

pub mod methods;
pub mod work;

use crate::config::spec::{MediumSpec, SonarSpec};
use crate::flow::{NavState, PingPlan, Pulse, Segment, SonarSettings};
use crate::frames::Trajectory;
use crate::time::{NS_PER_S, UtcNs};

pub use trigger::{Early, Refusal, Triggered};

/// Quiet time between the end of one listening window and the next pulse, seconds: a receiver needs some to turn around.
pub const TURNAROUND_S: f64 = 1e-3;

/// Listening window for these settings: two-way time to the range plus the pulse, so that an echo at full range is whole. Seconds.
pub fn window_s(settings: &SonarSettings, sound_speed_m_per_s: f64) -> f64 {
    2.0 * settings.range_m / sound_speed_m_per_s + settings.pulse_duration_s
}

/// Samples that cover [`window_s`].
pub fn sample_count(
    settings: &SonarSettings,
    sound_speed_m_per_s: f64,
    sample_rate_hz: f64,
) -> usize {
    // The subtraction keeps a window of a whole number of samples from gaining one by rounding.
    (window_s(settings, sound_speed_m_per_s) * sample_rate_hz - 1e-6)
        .ceil()
        .max(1.0) as usize
}

/// Time from one pulse to the next, at least, seconds.
fn shortest_s(settings: &SonarSettings, sound_speed_m_per_s: f64) -> f64 {
    window_s(settings, sound_speed_m_per_s) + TURNAROUND_S
}

/// Time from one pulse to the next, nanoseconds: the rate asked for, or as fast as the range allows.
pub fn period_ns(settings: &SonarSettings, sound_speed_m_per_s: f64) -> i64 {
    let shortest_s = shortest_s(settings, sound_speed_m_per_s);
    let asked_s = if settings.max_ping_rate_hz > 0.0 {
        1.0 / settings.max_ping_rate_hz
    } else {
        f64::INFINITY
    };
    let period_s = if asked_s.is_finite() {
        asked_s.max(shortest_s)
    } else {
        shortest_s
    };
    (period_s * NS_PER_S as f64).round() as i64
}

/// A ping that will be made: its number, its instant and the settings in force at that instant.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PingOrder {
    pub ping_number: u32,
    pub transmit_utc: UtcNs,
    pub settings: SonarSettings,
    /// Since the previous order; 0 for the first.
    pub period_s: f64,
}

/// When one sonar pings: on its own beat, and when it is triggered.
#[derive(Clone, Debug)]
pub struct Schedule {
    /// Of the beat, which goes on while the sonar does not ping.
    next_utc: UtcNs,
    next_number: u32,
    last_utc: Option<UtcNs>,
    /// The last ping's window is over.
    free_utc: UtcNs,
    /// A trigger that came too early, and is obeyed then.
    queued_utc: Option<UtcNs>,
    sound_speed_m_per_s: f64,
}

impl Schedule {
    pub fn starting_at(first_utc: UtcNs, sound_speed_m_per_s: f64) -> Self {
        Self {
            next_utc: first_utc,
            next_number: 1,
            last_utc: None,
            free_utc: first_utc,
            queued_utc: None,
            sound_speed_m_per_s,
        }
    }

    /// When the next ping may go out on the beat.
    pub fn next_utc(&self) -> UtcNs {
        self.next_utc
    }

    /// The number it will have.
    pub fn next_number(&self) -> u32 {
        self.next_number
    }

    /// The next ping of the beat if its instant has come. `settings_at` tells the settings that were in force at an instant: asking late
    /// changes nothing. While pinging is off the schedule keeps its beat and gives nothing.
    pub fn due(
        &mut self,
        now: UtcNs,
        settings_at: impl Fn(UtcNs) -> SonarSettings,
    ) -> Option<PingOrder> {
        while self.next_utc <= now {
            let transmit_utc = self.next_utc;
            let settings = settings_at(transmit_utc);
            self.next_utc = transmit_utc.plus_ns(period_ns(&settings, self.sound_speed_m_per_s));
            if settings.pinging && settings.max_ping_rate_hz > 0.0 {
                return Some(self.pulse(transmit_utc, settings));
            }
        }
        None
    }

    /// The beat's next pulse comes not before `utc`.
    pub fn put_off(&mut self, utc: UtcNs) {
        self.next_utc = self.next_utc.max(utc);
    }

    fn pulse(&mut self, transmit_utc: UtcNs, settings: SonarSettings) -> PingOrder {
        let period_s = self
            .last_utc
            .map_or(0.0, |last| transmit_utc.seconds_since(last));
        let order = PingOrder {
            ping_number: self.next_number,
            transmit_utc,
            settings,
            period_s,
        };
        self.last_utc = Some(transmit_utc);
        self.free_utc = transmit_utc.plus_s(shortest_s(&settings, self.sound_speed_m_per_s));
        // After a triggered ping the beat waits for its window; its own pings are that far apart anyway.
        self.next_utc = self.next_utc.max(self.free_utc);
        self.next_number = self.next_number.wrapping_add(1);
        order
    }
}

/// The pulse under these settings.
pub fn pulse(spec: &SonarSpec, settings: &SonarSettings) -> Pulse {
    Pulse {
        duration_s: settings.pulse_duration_s,
        ..spec.pulse
    }
}

/// Vertices of the polyline over `window_s`: at most `segment_s` apart, velocities along the chords, attitude of each segment's start
/// (Meng et al. 2023, section 3.1: "the attitude change only occurs at the polyline intersection"). Reuses `segments`.
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

/// The longest window within the sonar's limits.
fn longest(spec: &SonarSpec) -> SonarSettings {
    SonarSettings {
        range_m: spec.limits.range_m.1,
        pulse_duration_s: spec.limits.pulse_duration_s.1,
        ..spec.settings
    }
}

/// Samples of the longest window within the limits, for sizing buffers.
pub fn max_samples(spec: &SonarSpec, sound_speed_m_per_s: f64) -> usize {
    sample_count(
        &longest(spec),
        sound_speed_m_per_s,
        spec.receiver.sample_rate_hz,
    )
}

/// Longest polyline within the limits, for sizing buffers.
pub fn max_segments(spec: &SonarSpec, sound_speed_m_per_s: f64) -> usize {
    (window_s(&longest(spec), sound_speed_m_per_s) / spec.model.segment_s).ceil() as usize + 1
}

/// A plan with room for every setting within the limits; [`fill`] makes it a particular ping.
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
        absorption_db_per_m,
        sample_count: 0,
        first_sample_s: 0.0,
        model: spec.model,
        nav: NavState::default(),
        trajectory: Trajectory::default(),
        segments: Vec::with_capacity(max_segments(spec, medium.sound_speed_m_per_s)),
    }
}

/// Makes `plan` the plan of `order`. The caller has put the ping's motion into `plan.trajectory`.
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
    use crate::frames::rotation_from_angles;
    use glam::DVec3;

    fn settings() -> SonarSettings {
        SonarSettings {
            pinging: true,
            range_m: 75.0,
            max_ping_rate_hz: 5.0,
            source_level_db: 0.0,
            gain_db: 0.0,
            pulse_duration_s: 2e-3,
        }
    }

    #[test]
    fn a_range_too_long_for_the_rate_lowers_the_rate() {
        let mut s = settings();
        assert_eq!(period_ns(&s, 1500.0), 200_000_000);
        s.range_m = 300.0;
        assert_eq!(
            period_ns(&s, 1500.0),
            403_000_000,
            "0.4 s + 2 ms pulse + 1 ms"
        );
    }

    #[test]
    fn a_window_of_a_whole_number_of_samples_gains_none() {
        assert_eq!(sample_count(&settings(), 1500.0, 10_000.0), 1020);
        let mut s = settings();
        s.range_m += 1e-2;
        assert_eq!(sample_count(&s, 1500.0, 10_000.0), 1021);
    }

    #[test]
    fn settings_bind_at_the_instant_of_the_pulse_and_numbers_have_no_gap() {
        let mut schedule = Schedule::starting_at(UtcNs(0), 1500.0);
        let mut s = settings();
        let first = schedule.due(UtcNs(0), |_| s).expect("due at once");
        assert_eq!((first.ping_number, first.period_s), (1, 0.0));
        assert!(schedule.due(UtcNs(199_999_999), |_| s).is_none());
        s.range_m = 300.0; // acknowledged before the second pulse: obeyed by it
        let second = schedule.due(UtcNs(200_000_000), |_| s).expect("due");
        assert_eq!(
            (second.ping_number, second.settings.range_m, second.period_s),
            (2, 300.0, 0.2)
        );
        assert_eq!(schedule.next_utc(), UtcNs(603_000_000));
        s.pinging = false;
        assert!(schedule.due(UtcNs(2_000_000_000), |_| s).is_none());
        s.pinging = true;
        let third = schedule.due(UtcNs(5_000_000_000), |_| s).expect("due");
        assert_eq!(third.ping_number, 3);
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
