//! Outcome of triggers.
//!
//! Input: the instant of a trigger, and the settings at that instant. Output: a ping at the same instant, a later ping, or a refusal. A sonar starts
//! no ping during the receive window of the previous ping. `max_ping_rate_hz` limits only the internal schedule, not triggers. The trigger latency of
//! a device is not modelled.

use super::{PingOrder, Schedule};
use echotank_config::spec::EarlyTrigger;
use echotank_core::settings::SonarSettings;
use echotank_core::time::UtcNs;

/// Treatment of triggers during the receive window of the previous ping.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct EarlyPolicy {
    /// Whether such triggers are queued or refused.
    pub rule: EarlyTrigger,
    /// Minimum time between pulses, s. The receive window limits this time as well.
    pub min_interval_s: f64,
}

/// Effect of a trigger.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Triggered {
    /// The ping begins with the trigger.
    Pulse(PingOrder),
    /// The ping begins as soon as possible.
    Queued,
    /// The trigger starts no ping.
    Refused(Refusal),
}

/// Reason why a trigger starts no ping.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Refusal {
    /// The receive window of the previous ping has not ended.
    Early,
    /// The trigger is older than the last pulse.
    Stale,
    /// The number of the trigger was received before.
    Duplicate,
    /// The sonar does not accept triggers: it is stopped, paused, or on its internal schedule.
    Held,
}

impl Schedule {
    /// Applies a trigger at `at` and returns its outcome.
    pub fn trigger(&mut self, at: UtcNs, settings: SonarSettings, early: EarlyPolicy) -> Triggered {
        let Some(last) = self.last_utc else {
            return Triggered::Pulse(self.pulse(at, settings));
        };
        if at < last {
            return Triggered::Refused(Refusal::Stale);
        }
        let earliest = self.free_utc.max(last.plus_s(early.min_interval_s));
        if at >= earliest && self.queued_utc.is_none() {
            return Triggered::Pulse(self.pulse(at, settings));
        }
        match early.rule {
            EarlyTrigger::Queue if self.queued_utc.is_none() => {
                self.queued_utc = Some(earliest);
                Triggered::Queued
            }
            _ => Triggered::Refused(Refusal::Early),
        }
    }

    /// Instant at which the queued trigger starts its ping.
    pub(crate) fn queued_utc(&self) -> Option<UtcNs> {
        self.queued_utc
    }

    /// Outcome of the queued trigger, once its instant has come.
    pub(crate) fn queued_due(
        &mut self,
        now: UtcNs,
        settings_at: impl Fn(UtcNs) -> Option<SonarSettings>,
    ) -> Option<Triggered> {
        let at = self.queued_utc.filter(|at| *at <= now)?;
        self.queued_utc = None;
        Some(match settings_at(at) {
            Some(settings) => Triggered::Pulse(self.pulse(at, settings)),
            None => Triggered::Refused(Refusal::Held),
        })
    }
}

/// Filter for trigger numbers: a repeated or late number starts no second ping. A number far below the last means that the sender has restarted.
#[derive(Clone, Debug, Default)]
pub struct Numbers {
    highest: Option<u32>,
    /// Bit k is set if `highest - k` was received.
    seen: u64,
}

impl Numbers {
    /// Number of steps below the highest within which a number counts as late.
    pub const REACH: u32 = u64::BITS;

    /// Registers the number of a trigger.
    ///
    /// # Errors
    /// [`Refusal::Duplicate`] if the number was received before, [`Refusal::Stale`] if a higher number was received before.
    pub fn check(&mut self, number: u32) -> Result<(), Refusal> {
        let Some(highest) = self.highest else {
            (self.highest, self.seen) = (Some(number), 1);
            return Ok(());
        };
        let ahead = number.wrapping_sub(highest);
        let behind = highest.wrapping_sub(number);
        if behind == 0 || (behind < Self::REACH && self.seen >> behind & 1 == 1) {
            return Err(Refusal::Duplicate);
        }
        if behind < Self::REACH {
            self.seen |= 1 << behind;
            return Err(Refusal::Stale);
        }
        self.seen = match ahead < Self::REACH {
            true => self.seen << ahead | 1,
            false => 1,
        };
        self.highest = Some(number);
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::schedule::tests::settings;
    use echotank_core::time::NS_PER_S;
    use proptest::prelude::*;

    const MS: i64 = NS_PER_S / 1000;

    const REFUSE: EarlyPolicy = EarlyPolicy {
        rule: EarlyTrigger::Refuse,
        min_interval_s: 0.0,
    };
    const QUEUE: EarlyPolicy = EarlyPolicy {
        rule: EarlyTrigger::Queue,
        min_interval_s: 0.0,
    };

    /// Instants of pings, milliseconds, and number of refused triggers.
    fn pings(triggers_ms: &[i64], early: EarlyPolicy) -> (Vec<i64>, usize) {
        let mut schedule = Schedule::starting_at(UtcNs(0), 1500.0);
        let (mut pings, mut refused) = (Vec::new(), 0);
        let mut note = |done: Triggered| match done {
            Triggered::Pulse(order) => {
                assert_eq!(order.ping_number as usize, pings.len() + 1);
                pings.push(order.transmit_utc.0 / MS);
            }
            Triggered::Queued => {}
            Triggered::Refused(_) => refused += 1,
        };
        let all = |_| Some(settings());
        for at in triggers_ms.iter().map(|ms| UtcNs(ms * MS)) {
            if let Some(done) = schedule.queued_due(at, all) {
                note(done);
            }
            note(schedule.trigger(at, settings(), early));
        }
        if let Some(done) = schedule.queued_due(UtcNs(i64::MAX), all) {
            note(done);
        }
        (pings, refused)
    }

    #[test]
    fn a_trigger_is_the_pings_time_zero_whatever_the_rate_of_the_beat() {
        // Faster than `max_ping_rate_hz` and off the internal schedule. The window requires at least 103 ms between pings.
        let at = [7, 110, 300, 403, 517];
        assert_eq!(pings(&at, REFUSE), (at.to_vec(), 0));
        assert_eq!(pings(&at, QUEUE), (at.to_vec(), 0));
    }

    #[test]
    fn triggers_while_a_ping_is_listened_to_are_refused_or_the_first_of_them_waits() {
        let at = [0, 10, 50, 102, 400];
        assert_eq!(pings(&at, REFUSE), (vec![0, 400], 3));
        assert_eq!(pings(&at, QUEUE), (vec![0, 103, 400], 2));
        let slow = EarlyPolicy {
            min_interval_s: 0.35,
            ..QUEUE
        };
        assert_eq!(pings(&at, slow), (vec![0, 350, 700], 2));
    }

    #[test]
    fn at_twice_the_rate_every_other_trigger_is_refused_or_pings_follow_as_fast_as_they_may() {
        let at: Vec<i64> = (0..40).map(|k| k * 60).collect();
        let (refusing, refused) = pings(&at, REFUSE);
        assert_eq!(refusing, (0..20).map(|k| k * 120).collect::<Vec<_>>());
        assert_eq!(refused, 20);
        let (queueing, refused) = pings(&at, QUEUE);
        let apart: Vec<_> = queueing.windows(2).map(|w| w[1] - w[0]).collect();
        assert!(apart.iter().all(|ms| *ms == 103), "{apart:?}");
        assert_eq!(queueing.len() + refused, 40);
    }

    #[test]
    fn a_trigger_older_than_the_last_pulse_makes_none() {
        assert_eq!(pings(&[500, 200, 499, 700], QUEUE), (vec![500, 700], 2));
    }

    #[test]
    fn a_number_counts_once_unless_its_sender_begins_again() {
        let mut numbers = Numbers::default();
        let mut check = |n| numbers.check(n);
        for number in [10, 11, 13] {
            assert_eq!(check(number), Ok(()));
        }
        assert_eq!(check(13), Err(Refusal::Duplicate));
        assert_eq!(check(11), Err(Refusal::Duplicate));
        assert_eq!(check(12), Err(Refusal::Stale), "overtaken");
        assert_eq!(check(12), Err(Refusal::Duplicate));
        assert_eq!(check(1000), Ok(()));
        assert_eq!(check(1), Ok(()), "begun again");
        assert_eq!(check(u32::MAX), Err(Refusal::Stale));
        assert_eq!(check(2), Ok(()));
    }

    proptest! {
        #[test]
        fn no_two_pings_are_nearer_than_the_window_and_every_trigger_is_accounted_for(
            steps in proptest::collection::vec(-50_i64..300, 1..60),
            queue in any::<bool>(),
        ) {
            let mut now = 0;
            let at: Vec<i64> = steps.iter().map(|step| { now += step; now }).collect();
            let (pings, refused) = pings(&at, if queue { QUEUE } else { REFUSE });
            prop_assert!(pings.windows(2).all(|w| w[1] - w[0] >= 103), "{:?}", pings);
            prop_assert_eq!(pings.len() + refused, at.len());
        }
    }
}
