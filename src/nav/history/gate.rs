//! Keeps out what no platform does. Comes in: a channel's samples. Goes out: whether each may be taken.
//!
//! A sample too far from the last one taken is set aside. When several in a row agree with one another, they are believed: the platform, or
//! the receiver's idea of it, really is elsewhere, and nothing joins the two places.

use std::f64::consts::TAU;

use glam::DVec3;

use echotank_config::spec::{JumpGateSpec, NavChannel};
use echotank_core::time::UtcNs;

/// Samples in a row that agree away from the old place before they are believed.
const CONFIRMATIONS: u32 = 5;
/// Steps below these are never doubted, however close the samples lie in time: metres, radians (2 degrees), metres of heave.
const POSITION_SLACK_M: f64 = 5.0;
const ANGLE_SLACK_RAD: f64 = 0.035;
const HEAVE_SLACK_M: f64 = 0.5;
/// Heave and depth change no faster, metres per second.
const HEAVE_RATE_M_PER_S: f64 = 10.0;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Passage {
    Open,
    /// Set aside.
    Shut,
    /// Believed after several that agreed: from here on it is another place.
    Reset,
}

#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Gate {
    taken: Option<(UtcNs, DVec3)>,
    doubted: Option<(UtcNs, DVec3)>,
    agreeing: u32,
}

impl Gate {
    /// Another source speaks from here on: whatever it says is no jump.
    pub(super) fn forget(&mut self) {
        *self = Self::default();
    }

    pub(crate) fn judge(
        &mut self,
        channel: NavChannel,
        utc: UtcNs,
        value: DVec3,
        rule: &JumpGateSpec,
    ) -> Passage {
        let near = |(before_utc, before): (UtcNs, DVec3)| {
            let dt_s = utc.seconds_since(before_utc).abs();
            let (step, slack, rate) = match channel {
                // Height may be anything a receiver makes of it; the plane is what the track is drawn in.
                NavChannel::Position => (
                    (value.x - before.x).hypot(value.y - before.y),
                    POSITION_SLACK_M,
                    rule.max_speed_m_per_s,
                ),
                NavChannel::Heading => (
                    turn(value.x - before.x),
                    ANGLE_SLACK_RAD,
                    rule.max_rate_rad_per_s,
                ),
                NavChannel::RollPitch => (
                    turn(value.x - before.x).max(turn(value.y - before.y)),
                    ANGLE_SLACK_RAD,
                    rule.max_rate_rad_per_s,
                ),
                NavChannel::Heave | NavChannel::Depth => (
                    (value.z - before.z).abs(),
                    HEAVE_SLACK_M,
                    HEAVE_RATE_M_PER_S,
                ),
                // Courses turn round within a sample at low speed.
                NavChannel::CourseSpeed => (0.0, 0.0, 0.0),
            };
            step <= slack + rate * dt_s
        };
        if self.taken.is_none_or(near) {
            self.taken = Some((utc, value));
            self.doubted = None;
            self.agreeing = 0;
            return Passage::Open;
        }
        self.agreeing = match self.doubted {
            Some(doubted) if near(doubted) => self.agreeing + 1,
            _ => 1,
        };
        self.doubted = Some((utc, value));
        if self.agreeing < CONFIRMATIONS {
            return Passage::Shut;
        }
        self.taken = self.doubted.take();
        self.agreeing = 0;
        Passage::Reset
    }
}

/// The short way round.
fn turn(angle_rad: f64) -> f64 {
    (angle_rad - TAU * (angle_rad / TAU).round()).abs()
}

#[cfg(test)]
mod tests {
    use super::*;

    const RULE: JumpGateSpec = JumpGateSpec {
        max_speed_m_per_s: 20.0,
        max_rate_rad_per_s: 1.0,
    };

    fn passages(channel: NavChannel, values: &[f64]) -> Vec<Passage> {
        let mut gate = Gate::default();
        let judge = |(i, v): (usize, &f64)| {
            let value = match channel {
                NavChannel::Heave => DVec3::new(0.0, 0.0, *v),
                _ => DVec3::new(*v, 0.0, 0.0),
            };
            gate.judge(channel, UtcNs(0).plus_s(i as f64 * 0.1), value, &RULE)
        };
        values.iter().enumerate().map(judge).collect()
    }

    #[test]
    fn a_stray_fix_is_set_aside_and_a_new_place_believed_after_five() {
        use Passage::{Open, Reset, Shut};
        let fixes = [
            0.0, 1.0, 500.0, 2.0, 3.0, 900.0, 901.0, 902.0, 903.0, 904.0, 905.0,
        ];
        let want = [
            Open, Open, Shut, Open, Open, Shut, Shut, Shut, Shut, Reset, Open,
        ];
        assert_eq!(passages(NavChannel::Position, &fixes), want);
        // Strays that do not agree are never believed.
        let strays: Vec<f64> = (0..20)
            .map(|i| if i == 0 { 0.0 } else { 1e4 * f64::from(i) })
            .collect();
        let shut = passages(NavChannel::Position, &strays);
        assert!(shut[1..].iter().all(|p| *p == Shut), "{shut:?}");
    }

    #[test]
    fn a_heading_through_north_is_no_jump_and_a_heave_of_metres_in_a_tenth_is() {
        use Passage::{Open, Shut};
        assert_eq!(
            passages(NavChannel::Heading, &[6.27, 0.02, 0.05]),
            [Open; 3]
        );
        assert_eq!(passages(NavChannel::Heading, &[0.0, 1.0]), [Open, Shut]);
        assert_eq!(
            passages(NavChannel::Heave, &[0.0, 1.0, 4.0]),
            [Open, Open, Shut]
        );
    }
}
