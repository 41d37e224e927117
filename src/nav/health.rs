//! How a source does: OK, HOLD, STALE, LOST. Comes in: arrivals of its samples, and the time. Goes out: its state, and how often it changed.
//!
//! A source is on HOLD when it misses a few of its own intervals, STALE and LOST after configured times. From STALE and LOST it comes back only
//! after several samples in a row, so that one stray sentence does not count as recovery.

use echotank_core::time::UtcNs;

/// Usual intervals without a sample before a source is on hold.
const HOLD_INTERVALS: f64 = 3.0;
/// A source on hold is at least this old, seconds: sensors at 100 Hz stutter by more than three intervals.
const HOLD_AT_LEAST_S: f64 = 0.2;
/// Samples in a row that end STALE and LOST.
const RECOVERY: u32 = 3;
/// Weight of the newest interval in the usual one.
const NEWEST_WEIGHT: f64 = 0.1;

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum State {
    /// Nothing has ever come.
    #[default]
    Silent,
    Ok,
    Hold,
    Stale,
    Lost,
}

impl State {
    pub fn name(self) -> &'static str {
        match self {
            State::Silent => "silent",
            State::Ok => "ok",
            State::Hold => "hold",
            State::Stale => "stale",
            State::Lost => "lost",
        }
    }
}

/// Ages at which a source is given up, seconds; `lost_s` not below `stale_s`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Limits {
    pub stale_s: f64,
    pub lost_s: f64,
}

#[derive(Clone, Copy, Debug)]
pub(crate) struct Health {
    limits: Limits,
    last: Option<UtcNs>,
    /// Smoothed, seconds.
    interval_s: Option<f64>,
    state: State,
    /// Samples since it was stale or lost; none while it never was.
    recovering: Option<u32>,
    changes: u64,
}

impl Health {
    pub(crate) fn new(limits: Limits) -> Self {
        Self {
            limits,
            last: None,
            interval_s: None,
            state: State::Silent,
            recovering: None,
            changes: 0,
        }
    }

    /// A sample arrived. Several of one instant (one sentence) count once.
    pub(crate) fn heard(&mut self, arrival: UtcNs) {
        self.at(arrival);
        let Some(last) = self.last else {
            self.last = Some(arrival);
            return self.become_state(State::Ok);
        };
        if arrival <= last {
            return;
        }
        let step_s = arrival.seconds_since(last);
        self.last = Some(arrival);
        if let Some(count) = self.recovering {
            let again = if step_s > self.limits.stale_s {
                1
            } else {
                count + 1
            };
            if again < RECOVERY {
                self.recovering = Some(again);
                return;
            }
            self.recovering = None;
        } else if step_s <= self.limits.stale_s {
            let usual = self.interval_s.unwrap_or(step_s);
            self.interval_s = Some(usual + (step_s - usual) * NEWEST_WEIGHT);
        }
        self.become_state(State::Ok);
    }

    /// Its state at `now`; times before the last sample leave it as it is.
    pub(crate) fn at(&mut self, now: UtcNs) -> State {
        let Some(last) = self.last else {
            return self.state;
        };
        let age_s = now.seconds_since(last);
        let usual_s = self.interval_s.unwrap_or(self.limits.stale_s);
        let hold_s = (usual_s * HOLD_INTERVALS)
            .max(HOLD_AT_LEAST_S)
            .min(self.limits.stale_s);
        let by_age = if age_s > self.limits.lost_s {
            State::Lost
        } else if age_s > self.limits.stale_s {
            State::Stale
        } else if age_s > hold_s {
            State::Hold
        } else {
            State::Ok
        };
        if matches!(by_age, State::Stale | State::Lost) {
            self.recovering = Some(0);
        }
        // While it recovers it stays what it was, or gets worse.
        if self.recovering.is_none() || by_age == State::Lost || self.state != State::Lost {
            let held = self.recovering.is_some() && matches!(by_age, State::Ok | State::Hold);
            if !held {
                self.become_state(by_age);
            }
        }
        self.state
    }

    /// Times that the state changed.
    pub(crate) fn changes(&self) -> u64 {
        self.changes
    }

    /// Seconds between samples as of late.
    pub(crate) fn interval_s(&self) -> Option<f64> {
        self.interval_s
    }

    /// Since the last sample.
    pub(crate) fn age_s(&self, now: UtcNs) -> Option<f64> {
        self.last.map(|last| now.seconds_since(last))
    }

    fn become_state(&mut self, state: State) {
        self.changes += u64::from(state != self.state);
        self.state = state;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_source_goes_ok_hold_stale_lost_and_comes_back_after_three_samples() {
        let mut health = Health::new(Limits {
            stale_s: 2.0,
            lost_s: 10.0,
        });
        let at = |s: f64| UtcNs(0).plus_s(s);
        assert_eq!(health.at(at(0.0)), State::Silent);
        for i in 0..50 {
            health.heard(at(f64::from(i) * 0.1));
            assert_eq!(health.at(at(f64::from(i) * 0.1 + 0.05)), State::Ok);
        }
        // Last at 4.9; three intervals are 0.3 s.
        assert_eq!(health.at(at(5.19)), State::Ok);
        assert_eq!(health.at(at(5.25)), State::Hold);
        health.heard(at(5.3));
        assert_eq!(health.at(at(5.31)), State::Ok, "from hold at once");
        assert_eq!(health.at(at(7.4)), State::Stale);
        health.heard(at(7.5));
        assert_eq!(health.at(at(7.51)), State::Stale, "one is not enough");
        assert_eq!(health.at(at(20.0)), State::Lost);
        for (i, want) in [
            (0, State::Lost),
            (1, State::Lost),
            (2, State::Ok),
            (3, State::Ok),
        ] {
            health.heard(at(20.0 + f64::from(i) * 0.1));
            assert_eq!(health.at(at(20.01 + f64::from(i) * 0.1)), want, "{i}");
        }
        assert_eq!(health.changes(), 6);
    }
}
