//! State of a source: OK, HOLD, STALE or LOST, from the arrival times of its samples.
//!
//! A source is on HOLD when it misses a few of its usual intervals. It becomes STALE and LOST after configured times. It recovers
//! from STALE and LOST only after several consecutive samples, so one stray sentence is not a recovery.

use echotank_core::time::UtcNs;

/// Number of usual intervals without a sample after which a source is on hold.
const HOLD_INTERVALS: f64 = 3.0;
/// Minimum age of a source on hold, seconds. The jitter of a sensor at 100 Hz exceeds three intervals.
const MIN_HOLD_S: f64 = 0.2;
/// Number of consecutive samples that end STALE and LOST.
const RECOVERY_SAMPLES: u32 = 3;
/// Weight of the newest interval in the smoothed interval.
const NEWEST_WEIGHT: f64 = 0.1;

/// Health of a source. After `Silent`, the variants go from best to worst.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum State {
    /// No sample has arrived yet.
    #[default]
    Silent,
    /// Samples arrive at the usual interval.
    Ok,
    /// Several usual intervals have passed without a sample.
    Hold,
    /// The newest sample is older than [`Limits::stale_s`].
    Stale,
    /// The newest sample is older than [`Limits::lost_s`].
    Lost,
}

impl State {
    /// Lower-case name for status reports.
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

/// Ages of the newest sample at which the state changes; `lost_s` is at least `stale_s`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Limits {
    /// Maximum age before a source is stale, seconds.
    pub stale_s: f64,
    /// Maximum age before a source is lost, seconds.
    pub lost_s: f64,
}

#[derive(Clone, Copy, Debug)]
pub(crate) struct Health {
    limits: Limits,
    last: Option<UtcNs>,
    /// Smoothed interval between samples, seconds.
    interval_s: Option<f64>,
    state: State,
    /// Consecutive samples since the source was stale or lost; `None` if it is not recovering.
    recovering: Option<u32>,
}

impl Health {
    pub(crate) fn new(limits: Limits) -> Self {
        Self {
            limits,
            last: None,
            interval_s: None,
            state: State::Silent,
            recovering: None,
        }
    }

    /// Updates the state with a sample. Samples with the same arrival come from one sentence and count once.
    pub(crate) fn sample_arrived(&mut self, arrival: UtcNs) {
        self.at(arrival);
        let Some(last) = self.last else {
            self.last = Some(arrival);
            self.state = State::Ok;
            return;
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
            if again < RECOVERY_SAMPLES {
                self.recovering = Some(again);
                return;
            }
            self.recovering = None;
        } else if step_s <= self.limits.stale_s {
            let usual = self.interval_s.unwrap_or(step_s);
            self.interval_s = Some(usual + (step_s - usual) * NEWEST_WEIGHT);
        }
        self.state = State::Ok;
    }

    /// Updates and returns the state at `now`. A time before the last sample leaves the state unchanged.
    pub(crate) fn at(&mut self, now: UtcNs) -> State {
        let Some(last) = self.last else {
            return self.state;
        };
        let age_s = now.seconds_since(last);
        let usual_s = self.interval_s.unwrap_or(self.limits.stale_s);
        let hold_s = (usual_s * HOLD_INTERVALS)
            .max(MIN_HOLD_S)
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
        // During recovery the state can only get worse.
        if self.recovering.is_none() || by_age == State::Lost || self.state != State::Lost {
            let held = self.recovering.is_some() && matches!(by_age, State::Ok | State::Hold);
            if !held {
                self.state = by_age;
            }
        }
        self.state
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
            health.sample_arrived(at(f64::from(i) * 0.1));
            assert_eq!(health.at(at(f64::from(i) * 0.1 + 0.05)), State::Ok);
        }
        // The last sample arrived at 4.9 s; three intervals are 0.3 s.
        assert_eq!(health.at(at(5.19)), State::Ok);
        assert_eq!(health.at(at(5.25)), State::Hold);
        health.sample_arrived(at(5.3));
        assert_eq!(health.at(at(5.31)), State::Ok, "recovers from hold at once");
        assert_eq!(health.at(at(7.4)), State::Stale);
        health.sample_arrived(at(7.5));
        assert_eq!(
            health.at(at(7.51)),
            State::Stale,
            "one sample is not enough"
        );
        assert_eq!(health.at(at(20.0)), State::Lost);
        for (i, want) in [
            (0, State::Lost),
            (1, State::Lost),
            (2, State::Ok),
            (3, State::Ok),
        ] {
            health.sample_arrived(at(20.0 + f64::from(i) * 0.1));
            assert_eq!(health.at(at(20.01 + f64::from(i) * 0.1)), want, "{i}");
        }
    }
}
