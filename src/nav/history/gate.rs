//! Rejects samples that imply impossible motion.
//!
//! A sample too far from the last accepted sample is rejected. Several consecutive rejected samples that agree with one another are
//! accepted as a new position. The new position does not continue the old track.

use std::f64::consts::TAU;

use glam::DVec3;

use echotank_config::spec::{JumpGateSpec, NavChannel};
use echotank_core::time::UtcNs;

/// Number of consecutive agreeing samples after which a new position is accepted.
const CONFIRMATIONS: u32 = 5;
/// Steps below these limits are accepted at any time difference: metres, radians (2 degrees), and metres of heave.
const POSITION_SLACK_M: f64 = 5.0;
const ANGLE_SLACK_RAD: f64 = 0.035;
const HEAVE_SLACK_M: f64 = 0.5;
/// Maximum rate of heave and depth, metres per second.
const HEAVE_RATE_M_PER_S: f64 = 10.0;

/// Result of the gate for one sample.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum GateResult {
    /// The sample continues the track.
    Accepted,
    /// The sample is rejected.
    Rejected,
    /// The sample is accepted after several samples that agree. It starts a new track.
    Reset,
}

#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Gate {
    accepted: Option<(UtcNs, DVec3)>,
    set_aside: Option<(UtcNs, DVec3)>,
    agreeing: u32,
}

impl Gate {
    /// Clears the state, so that the first sample of a new source is not a jump.
    pub(super) fn forget(&mut self) {
        *self = Self::default();
    }

    pub(crate) fn judge(
        &mut self,
        channel: NavChannel,
        utc: UtcNs,
        value: DVec3,
        rule: &JumpGateSpec,
    ) -> GateResult {
        let near = |(before_utc, before): (UtcNs, DVec3)| {
            let dt_s = utc.seconds_since(before_utc).abs();
            let (step, slack, rate) = match channel {
                // Only the horizontal step counts, because the heights of receivers differ too much.
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
                // The course is undefined at low speed.
                NavChannel::CourseSpeed => (0.0, 0.0, 0.0),
            };
            step <= slack + rate * dt_s
        };
        if self.accepted.is_none_or(near) {
            self.accepted = Some((utc, value));
            self.set_aside = None;
            self.agreeing = 0;
            return GateResult::Accepted;
        }
        self.agreeing = match self.set_aside {
            Some(set_aside) if near(set_aside) => self.agreeing + 1,
            _ => 1,
        };
        self.set_aside = Some((utc, value));
        if self.agreeing < CONFIRMATIONS {
            return GateResult::Rejected;
        }
        self.accepted = self.set_aside.take();
        self.agreeing = 0;
        GateResult::Reset
    }
}

/// Magnitude of an angle along the shorter arc.
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

    fn gate_results(channel: NavChannel, values: &[f64]) -> Vec<GateResult> {
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
    fn rejects_an_outlier_and_accepts_a_new_position_after_five_samples() {
        use GateResult::{Accepted, Rejected, Reset};
        let fixes = [
            0.0, 1.0, 500.0, 2.0, 3.0, 900.0, 901.0, 902.0, 903.0, 904.0, 905.0,
        ];
        let want = [
            Accepted, Accepted, Rejected, Accepted, Accepted, Rejected, Rejected, Rejected,
            Rejected, Reset, Accepted,
        ];
        assert_eq!(gate_results(NavChannel::Position, &fixes), want);
        // Outliers that disagree with one another are never accepted.
        let strays: Vec<f64> = (0..20)
            .map(|i| if i == 0 { 0.0 } else { 1e4 * f64::from(i) })
            .collect();
        let results = gate_results(NavChannel::Position, &strays);
        assert!(results[1..].iter().all(|p| *p == Rejected), "{results:?}");
    }

    #[test]
    fn accepts_a_heading_through_north_and_rejects_a_fast_heave() {
        use GateResult::{Accepted, Rejected};
        assert_eq!(
            gate_results(NavChannel::Heading, &[6.27, 0.02, 0.05]),
            [Accepted; 3]
        );
        assert_eq!(
            gate_results(NavChannel::Heading, &[0.0, 1.0]),
            [Accepted, Rejected]
        );
        assert_eq!(
            gate_results(NavChannel::Heave, &[0.0, 1.0, 4.0]),
            [Accepted, Accepted, Rejected]
        );
    }
}
