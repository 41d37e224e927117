//! Ping times of all sonars of a rig, in order of time: from internal schedules, external triggers and other sonars.
//!
//! Input: the time, triggers, and the settings of a sonar at an instant. Output: [`Event`]s, earliest first. A sonar that follows another sonar is
//! triggered by the pulses of that sonar after a fixed delay. The delay is 0 for synchronised pings and longer for interleaved pings.

use std::collections::VecDeque;

use super::{EarlyPolicy, PingOrder, Refusal, Schedule, Triggered};
use echotank_config::spec::{TriggerFrom, TriggerSpec};
use echotank_core::settings::SonarSettings;
use echotank_core::time::UtcNs;

/// Maximum number of pending triggers from a followed sonar: more than its pulses within the longest possible delay.
const MAX_PENDING: usize = 4096;

/// Settings that apply to a sonar at an instant.
#[derive(Clone, Copy, Debug)]
pub struct SettingsInForce {
    /// Settings; `pinging` states whether the internal schedule is active.
    pub settings: SonarSettings,
    /// Whether the sonar accepts triggers.
    pub armed: bool,
}

impl SettingsInForce {
    /// Settings of a triggered ping; `None` if the sonar accepts no triggers.
    fn triggered(&self) -> Option<SonarSettings> {
        self.armed.then_some(SonarSettings {
            pinging: true,
            ..self.settings
        })
    }
}

/// An event of a sonar.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Event {
    /// A pulse of the internal schedule.
    Scheduled(PingOrder),
    /// A trigger with its outcome.
    Trigger(Triggered),
}

impl Event {
    /// Order of the ping that the event starts, if any.
    pub fn order(&self) -> Option<PingOrder> {
        match self {
            Self::Scheduled(order) | Self::Trigger(Triggered::Pulse(order)) => Some(*order),
            Self::Trigger(_) => None,
        }
    }
}

/// Schedule and pending triggers of one sonar.
#[derive(Clone, Debug)]
struct Entry {
    schedule: Schedule,
    early: EarlyPolicy,
    /// Index of the followed sonar, and delay after its pulses, s.
    follows: Option<(usize, f64)>,
    /// Pending triggers from the followed sonar, earliest first.
    pending: VecDeque<UtcNs>,
    /// Instant of a pending second trigger.
    second: Option<UtcNs>,
    /// Whether the last event was the second trigger.
    is_second: bool,
}

impl Entry {
    fn next_trigger(&self) -> Option<UtcNs> {
        let pending = self.pending.front().copied();
        [self.schedule.queued_utc(), pending, self.second]
            .into_iter()
            .flatten()
            .min()
    }
}

/// Internal schedules and triggers of all sonars of a rig.
#[derive(Clone, Debug)]
pub struct RigSchedule {
    entries: Vec<Entry>,
}

impl RigSchedule {
    /// Creates one schedule for each item of `triggers`; all schedules start at `first_utc`.
    pub fn starting_at<'a>(
        first_utc: UtcNs,
        sound_speed_m_per_s: f64,
        triggers: impl Iterator<Item = &'a TriggerSpec>,
    ) -> Self {
        let entry = |spec: &TriggerSpec| Entry {
            schedule: Schedule::starting_at(first_utc, sound_speed_m_per_s),
            early: EarlyPolicy {
                rule: spec.early,
                min_interval_s: spec.min_interval_s,
            },
            follows: match spec.from {
                TriggerFrom::Sonar { sonar, delay_s } => Some((sonar, delay_s)),
                _ => None,
            },
            pending: VecDeque::new(),
            second: None,
            is_second: false,
        };
        Self {
            entries: triggers.map(entry).collect(),
        }
    }

    /// Schedule of the sonar with this index.
    ///
    /// # Panics
    /// The index is out of range.
    pub fn of_sonar(&self, sonar: usize) -> &Schedule {
        &self.entries[sonar].schedule
    }

    /// Delays the sonar's next scheduled pulse until `utc` at the earliest.
    pub fn put_off(&mut self, sonar: usize, utc: UtcNs) {
        self.entries[sonar].schedule.put_off(utc);
    }

    /// Instant of the next event: scheduled pulses of the sonars that `selects` accepts, and triggers of all sonars. `None` if there is no event.
    pub fn next_utc(&self, selects: impl Fn(usize) -> bool) -> Option<UtcNs> {
        let entries = self.entries.iter().enumerate();
        let own = |(sonar, entry): (usize, &Entry)| {
            let scheduled = selects(sonar).then(|| entry.schedule.next_utc());
            [scheduled, entry.next_trigger()]
                .into_iter()
                .flatten()
                .min()
        };
        entries.filter_map(own).min()
    }

    /// Next event at or before `now`. The caller reports every order that becomes a pulse with [`RigSchedule::note_pulse`].
    pub fn due(
        &mut self,
        now: UtcNs,
        in_force: impl Fn(usize, UtcNs) -> SettingsInForce,
    ) -> Option<(usize, Event)> {
        while let Some((at, sonar)) = self.earliest().filter(|(at, _)| *at <= now) {
            if let Some(event) = self.event_at(sonar, at, |at| in_force(sonar, at)) {
                return Some((sonar, event));
            }
        }
        None
    }

    /// Instant and sonar of the next event. For equal instants the sonar with the lower index comes first.
    fn earliest(&self) -> Option<(UtcNs, usize)> {
        let entries = self.entries.iter().enumerate();
        let next = |(sonar, entry): (usize, &Entry)| {
            let scheduled = entry.schedule.next_utc();
            (
                entry
                    .next_trigger()
                    .map_or(scheduled, |at| at.min(scheduled)),
                sonar,
            )
        };
        entries.map(next).min()
    }

    fn event_at(
        &mut self,
        sonar: usize,
        at: UtcNs,
        in_force: impl Fn(UtcNs) -> SettingsInForce,
    ) -> Option<Event> {
        let entry = &mut self.entries[sonar];
        entry.is_second = false;
        let queued = entry.schedule.queued_due(at, |at| {
            // A sonar with an internal schedule also accepts the queued second trigger.
            let SettingsInForce { settings, armed } = in_force(at);
            let armed = armed || settings.pinging;
            SettingsInForce { settings, armed }.triggered()
        });
        if let Some(triggered) = queued {
            return Some(Event::Trigger(triggered));
        }
        if let Some(second) = entry.second.filter(|second| *second <= at) {
            (entry.second, entry.is_second) = (None, true);
            let SettingsInForce { settings, armed } = in_force(second);
            let armed = armed || settings.pinging;
            let triggered = self.trigger(sonar, second, SettingsInForce { settings, armed });
            return Some(Event::Trigger(triggered));
        }
        if entry.pending.front().is_some_and(|pending| *pending <= at) {
            let at = entry.pending.pop_front()?;
            return Some(Event::Trigger(self.trigger(sonar, at, in_force(at))));
        }
        let scheduled = entry.schedule.due(at, |at| in_force(at).settings);
        scheduled.map(Event::Scheduled)
    }

    /// Applies an external trigger for `sonar` at `at`. The caller first takes all earlier events with [`RigSchedule::due`].
    pub fn trigger(&mut self, sonar: usize, at: UtcNs, in_force: SettingsInForce) -> Triggered {
        let entry = &mut self.entries[sonar];
        match in_force.triggered() {
            Some(settings) => entry.schedule.trigger(at, settings, entry.early),
            None => Triggered::Refused(Refusal::Held),
        }
    }

    /// Triggers the sonar once more at `at`, independent of its trigger source.
    pub fn trigger_again(&mut self, sonar: usize, at: UtcNs) {
        self.entries[sonar].second = Some(at);
    }

    /// Whether the last event of this sonar was due to [`RigSchedule::trigger_again`].
    pub fn is_second(&self, sonar: usize) -> bool {
        self.entries[sonar].is_second
    }

    /// Reports that the sonar transmitted a pulse at `at`, which triggers the sonars that follow it.
    pub fn note_pulse(&mut self, sonar: usize, at: UtcNs) {
        let follows = |entry: &&mut Entry| entry.follows.is_some_and(|(whom, _)| whom == sonar);
        for entry in self.entries.iter_mut().filter(follows) {
            let delay_s = entry.follows.map_or(0.0, |(_, delay_s)| delay_s);
            if entry.pending.len() < MAX_PENDING {
                entry.pending.push_back(at.plus_s(delay_s));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use echotank_config::spec::EarlyTrigger;
    use echotank_core::time::NS_PER_S;

    const MS: i64 = NS_PER_S / 1000;

    fn settings(range_m: f64) -> SonarSettings {
        SonarSettings {
            pinging: true,
            range_m,
            max_ping_rate_hz: 5.0,
            source_level_db: 0.0,
            gain_db: 0.0,
            pulse_duration_s: 2e-3,
        }
    }

    fn following(delay_s: f64, early: EarlyTrigger) -> TriggerSpec {
        TriggerSpec {
            from: TriggerFrom::Sonar { sonar: 0, delay_s },
            early,
            ..TriggerSpec::default()
        }
    }

    /// Milliseconds and sonar of every ping in one second. The first sonar pings five times per second; the others follow.
    fn second(others: &[TriggerSpec], ranges_m: &[f64]) -> Vec<(i64, usize)> {
        let first = TriggerSpec::default();
        let specs = std::iter::once(&first).chain(others);
        let mut schedule = RigSchedule::starting_at(UtcNs(0), 1500.0, specs);
        let in_force = |sonar: usize, _| SettingsInForce {
            settings: SonarSettings {
                pinging: sonar == 0,
                ..settings(ranges_m[sonar])
            },
            armed: sonar > 0,
        };
        let mut pings = Vec::new();
        while let Some((sonar, event)) = schedule.due(UtcNs(999 * MS), in_force) {
            if let Some(order) = event.order() {
                schedule.note_pulse(sonar, order.transmit_utc);
                pings.push((order.transmit_utc.0 / MS, sonar));
            }
        }
        pings
    }

    #[test]
    fn synchronised_sonars_ping_together_and_interleaved_ones_in_turn() {
        let others = [
            following(0.0, EarlyTrigger::Refuse),
            following(0.1, EarlyTrigger::Refuse),
        ];
        let want: Vec<_> = (0..5)
            .flat_map(|k| [(200 * k, 0), (200 * k, 1), (200 * k + 100, 2)])
            .collect();
        assert_eq!(second(&others, &[75.0; 3]), want);
    }

    #[test]
    fn a_follower_with_a_longer_window_keeps_its_minimum_interval() {
        // A range of 300 m needs 403 ms between pulses.
        let of = |early| second(&[following(0.0, early)], &[75.0, 300.0]);
        let its = |pings: Vec<(i64, usize)>| -> Vec<_> {
            let follower = pings.into_iter().filter(|(_, sonar)| *sonar == 1);
            follower.map(|(ms, _)| ms).collect()
        };
        assert_eq!(its(of(EarlyTrigger::Refuse)), [0, 600]);
        assert_eq!(its(of(EarlyTrigger::Queue)), [0, 403, 806]);
    }

    #[test]
    fn a_second_trigger_is_early_and_refused_or_makes_a_ping_as_soon_as_it_may() {
        for (early, want) in [
            (EarlyTrigger::Refuse, vec![0, 200, 400]),
            (EarlyTrigger::Queue, vec![0, 103, 206, 406]),
        ] {
            let spec = TriggerSpec {
                early,
                ..TriggerSpec::default()
            };
            let mut schedule = RigSchedule::starting_at(UtcNs(0), 1500.0, std::iter::once(&spec));
            let in_force = |_, _| SettingsInForce {
                settings: settings(75.0),
                armed: false,
            };
            let mut pings = Vec::new();
            while let Some((_, event)) = schedule.due(UtcNs(450 * MS), in_force) {
                let Some(order) = event.order() else { continue };
                if order.ping_number == 1 {
                    schedule.trigger_again(0, order.transmit_utc.plus_ns(20 * MS));
                }
                pings.push(order.transmit_utc.0 / MS);
            }
            assert_eq!(pings, want, "{early:?}");
        }
    }

    #[test]
    fn a_sonar_that_is_not_armed_refuses_and_a_stopped_one_keeps_its_schedule() {
        let mut schedule =
            RigSchedule::starting_at(UtcNs(0), 1500.0, std::iter::once(&TriggerSpec::default()));
        let held = SettingsInForce {
            settings: SonarSettings {
                pinging: false,
                ..settings(75.0)
            },
            armed: false,
        };
        assert_eq!(
            schedule.trigger(0, UtcNs(MS), held),
            Triggered::Refused(Refusal::Held)
        );
        assert_eq!(schedule.due(UtcNs(999 * MS), |_, _| held), None);
        assert_eq!(schedule.of_sonar(0).next_utc(), UtcNs(1000 * MS));
        assert_eq!(schedule.next_utc(|_| false), None);
        assert_eq!(schedule.next_utc(|_| true), Some(UtcNs(1000 * MS)));
    }
}
