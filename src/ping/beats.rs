//! Ping times of all sonars of a rig, in order of time: from internal schedules, external triggers and other sonars.
//!
//! Input: the time, triggers, and the settings of a sonar at an instant. Output: [`Event`]s, earliest first. A sonar that follows another sonar is
//! triggered by the pulses of that sonar after a fixed delay. The delay is 0 for synchronised pings and longer for interleaved pings.

use std::collections::VecDeque;

use super::{Early, PingOrder, Refusal, Schedule, Triggered};
use echotank_config::spec::{TriggerFrom, TriggerSpec};
use echotank_core::settings::SonarSettings;
use echotank_core::time::UtcNs;

/// Maximum number of pending triggers from a followed sonar: more than its pulses within the longest possible delay.
const MAX_AHEAD: usize = 4096;

/// Settings that apply to a sonar at an instant.
#[derive(Clone, Copy, Debug)]
pub struct InForce {
    /// Settings; `pinging` states whether the internal schedule is active.
    pub settings: SonarSettings,
    /// Whether the sonar accepts triggers.
    pub armed: bool,
}

impl InForce {
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
    Beat(PingOrder),
    /// A trigger with its outcome.
    Trigger(Triggered),
}

impl Event {
    /// Order of the ping that the event starts, if any.
    pub fn order(&self) -> Option<PingOrder> {
        match self {
            Self::Beat(order) | Self::Trigger(Triggered::Pulse(order)) => Some(*order),
            Self::Trigger(_) => None,
        }
    }
}

#[derive(Clone, Debug)]
struct Lane {
    schedule: Schedule,
    early: Early,
    /// Index of the followed sonar, and delay after its pulses, s.
    follows: Option<(usize, f64)>,
    /// Pending triggers from the followed sonar, earliest first.
    ahead: VecDeque<UtcNs>,
    /// Instant of a pending second trigger.
    again: Option<UtcNs>,
    /// Whether the last event was the second trigger.
    is_second: bool,
}

impl Lane {
    fn next_trigger(&self) -> Option<UtcNs> {
        let ahead = self.ahead.front().copied();
        [self.schedule.queued_utc(), ahead, self.again]
            .into_iter()
            .flatten()
            .min()
    }
}

/// Internal schedules and triggers of all sonars of a rig.
#[derive(Clone, Debug)]
pub struct Beats {
    lanes: Vec<Lane>,
}

impl Beats {
    /// Creates one schedule for each item of `triggers`; all schedules start at `first_utc`.
    pub fn starting_at<'a>(
        first_utc: UtcNs,
        sound_speed_m_per_s: f64,
        triggers: impl Iterator<Item = &'a TriggerSpec>,
    ) -> Self {
        let lane = |spec: &TriggerSpec| Lane {
            schedule: Schedule::starting_at(first_utc, sound_speed_m_per_s),
            early: Early {
                rule: spec.early,
                min_interval_s: spec.min_interval_s,
            },
            follows: match spec.from {
                TriggerFrom::Sonar { sonar, delay_s } => Some((sonar, delay_s)),
                _ => None,
            },
            ahead: VecDeque::new(),
            again: None,
            is_second: false,
        };
        Self {
            lanes: triggers.map(lane).collect(),
        }
    }

    /// Schedule of the sonar with this index.
    ///
    /// # Panics
    /// The index is out of range.
    pub fn schedule(&self, sonar: usize) -> &Schedule {
        &self.lanes[sonar].schedule
    }

    /// Delays the sonar's next scheduled pulse until `utc` at the earliest.
    pub fn put_off(&mut self, sonar: usize, utc: UtcNs) {
        self.lanes[sonar].schedule.put_off(utc);
    }

    /// Instant of the next event: scheduled pulses of the sonars that `beats` selects, and triggers of all sonars. `None` if there is no event.
    pub fn next_utc(&self, beats: impl Fn(usize) -> bool) -> Option<UtcNs> {
        let lanes = self.lanes.iter().enumerate();
        let own = |(sonar, lane): (usize, &Lane)| {
            let beat = beats(sonar).then(|| lane.schedule.next_utc());
            [beat, lane.next_trigger()].into_iter().flatten().min()
        };
        lanes.filter_map(own).min()
    }

    /// Next event at or before `now`. The caller reports every order that becomes a pulse with [`Beats::pulsed`].
    pub fn due(
        &mut self,
        now: UtcNs,
        in_force: impl Fn(usize, UtcNs) -> InForce,
    ) -> Option<(usize, Event)> {
        while let Some((at, sonar)) = self.earliest().filter(|(at, _)| *at <= now) {
            if let Some(event) = self.happens(sonar, at, |at| in_force(sonar, at)) {
                return Some((sonar, event));
            }
        }
        None
    }

    /// Instant and sonar of the next event. For equal instants the sonar with the lower index comes first.
    fn earliest(&self) -> Option<(UtcNs, usize)> {
        let lanes = self.lanes.iter().enumerate();
        let next = |(sonar, lane): (usize, &Lane)| {
            let beat = lane.schedule.next_utc();
            (lane.next_trigger().map_or(beat, |at| at.min(beat)), sonar)
        };
        lanes.map(next).min()
    }

    fn happens(
        &mut self,
        sonar: usize,
        at: UtcNs,
        in_force: impl Fn(UtcNs) -> InForce,
    ) -> Option<Event> {
        let lane = &mut self.lanes[sonar];
        lane.is_second = false;
        let queued = lane.schedule.queued_due(at, |at| {
            // A sonar with an internal schedule also accepts the queued second trigger.
            let InForce { settings, armed } = in_force(at);
            let armed = armed || settings.pinging;
            InForce { settings, armed }.triggered()
        });
        if let Some(triggered) = queued {
            return Some(Event::Trigger(triggered));
        }
        if let Some(again) = lane.again.filter(|again| *again <= at) {
            (lane.again, lane.is_second) = (None, true);
            let InForce { settings, armed } = in_force(again);
            let armed = armed || settings.pinging;
            let triggered = self.trigger(sonar, again, InForce { settings, armed });
            return Some(Event::Trigger(triggered));
        }
        if lane.ahead.front().is_some_and(|ahead| *ahead <= at) {
            let at = lane.ahead.pop_front()?;
            return Some(Event::Trigger(self.trigger(sonar, at, in_force(at))));
        }
        let beat = lane.schedule.due(at, |at| in_force(at).settings);
        beat.map(Event::Beat)
    }

    /// Applies an external trigger for `sonar` at `at`. The caller first takes all earlier events with [`Beats::due`].
    pub fn trigger(&mut self, sonar: usize, at: UtcNs, in_force: InForce) -> Triggered {
        let lane = &mut self.lanes[sonar];
        match in_force.triggered() {
            Some(settings) => lane.schedule.trigger(at, settings, lane.early),
            None => Triggered::Refused(Refusal::Held),
        }
    }

    /// Triggers the sonar once more at `at`, independent of its trigger source.
    pub fn again(&mut self, sonar: usize, at: UtcNs) {
        self.lanes[sonar].again = Some(at);
    }

    /// Whether the last event of this sonar was due to [`Beats::again`].
    pub fn is_second(&self, sonar: usize) -> bool {
        self.lanes[sonar].is_second
    }

    /// Reports that the sonar transmitted a pulse at `at`, which triggers the sonars that follow it.
    pub fn pulsed(&mut self, sonar: usize, at: UtcNs) {
        let follows = |lane: &&mut Lane| lane.follows.is_some_and(|(whom, _)| whom == sonar);
        for lane in self.lanes.iter_mut().filter(follows) {
            let delay_s = lane.follows.map_or(0.0, |(_, delay_s)| delay_s);
            if lane.ahead.len() < MAX_AHEAD {
                lane.ahead.push_back(at.plus_s(delay_s));
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
        let mut beats = Beats::starting_at(UtcNs(0), 1500.0, specs);
        let in_force = |sonar: usize, _| InForce {
            settings: SonarSettings {
                pinging: sonar == 0,
                ..settings(ranges_m[sonar])
            },
            armed: sonar > 0,
        };
        let mut pings = Vec::new();
        while let Some((sonar, event)) = beats.due(UtcNs(999 * MS), in_force) {
            if let Some(order) = event.order() {
                beats.pulsed(sonar, order.transmit_utc);
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
            let mut beats = Beats::starting_at(UtcNs(0), 1500.0, std::iter::once(&spec));
            let in_force = |_, _| InForce {
                settings: settings(75.0),
                armed: false,
            };
            let mut pings = Vec::new();
            while let Some((_, event)) = beats.due(UtcNs(450 * MS), in_force) {
                let Some(order) = event.order() else { continue };
                if order.ping_number == 1 {
                    beats.again(0, order.transmit_utc.plus_ns(20 * MS));
                }
                pings.push(order.transmit_utc.0 / MS);
            }
            assert_eq!(pings, want, "{early:?}");
        }
    }

    #[test]
    fn who_is_not_armed_refuses_and_who_is_stopped_keeps_its_beat() {
        let mut beats =
            Beats::starting_at(UtcNs(0), 1500.0, std::iter::once(&TriggerSpec::default()));
        let held = InForce {
            settings: SonarSettings {
                pinging: false,
                ..settings(75.0)
            },
            armed: false,
        };
        assert_eq!(
            beats.trigger(0, UtcNs(MS), held),
            Triggered::Refused(Refusal::Held)
        );
        assert_eq!(beats.due(UtcNs(999 * MS), |_, _| held), None);
        assert_eq!(beats.schedule(0).next_utc(), UtcNs(1000 * MS));
        assert_eq!(beats.next_utc(|_| false), None);
        assert_eq!(beats.next_utc(|_| true), Some(UtcNs(1000 * MS)));
    }
}
