//! When all sonars of a rig ping, in order of time: on their own beats, on triggers from outside, and after one another.
//!
//! In: the time, triggers, and what is in force for a sonar at an instant. Out: [`Event`]s, earliest first. A sonar that follows another is
//! triggered by its pulse, so long after it: at the same instant (synchronised) or in between (interleaved).

use std::collections::VecDeque;

use super::{Early, PingOrder, Refusal, Schedule, Triggered};
use echotank_config::spec::{TriggerFrom, TriggerSpec};
use echotank_core::settings::SonarSettings;
use echotank_core::time::UtcNs;

/// Triggers of a followed sonar that may lie ahead: more than its pulses in the longest delay there is.
const MAX_AHEAD: usize = 4096;

/// What holds for a sonar at an instant.
#[derive(Clone, Copy, Debug)]
pub struct InForce {
    /// `pinging`: it pings on its own beat.
    pub settings: SonarSettings,
    /// It obeys triggers.
    pub armed: bool,
}

impl InForce {
    /// The settings of a triggered ping.
    fn triggered(&self) -> Option<SonarSettings> {
        self.armed.then_some(SonarSettings {
            pinging: true,
            ..self.settings
        })
    }
}

/// Something that happened to a sonar.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Event {
    /// A pulse on the beat.
    Beat(PingOrder),
    /// A trigger, whatever came of it.
    Trigger(Triggered),
}

impl Event {
    /// The ping that the event begins, if it begins one.
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
    /// Index of the sonar whose pulses trigger this one, and how long after.
    follows: Option<(usize, f64)>,
    /// Triggers that the followed sonar has made, earliest first.
    ahead: VecDeque<UtcNs>,
    /// Triggered a second time, then.
    again: Option<UtcNs>,
    /// What happened last was that second time.
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

/// The beats and triggers of all sonars of a rig, in the order of their instants.
#[derive(Clone, Debug)]
pub struct Beats {
    lanes: Vec<Lane>,
}

impl Beats {
    /// Schedules whose beats start at `first_utc`, one for each item of `triggers`.
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

    /// The schedule of a sonar by its index.
    ///
    /// # Panics
    /// If there is no such sonar.
    pub fn schedule(&self, sonar: usize) -> &Schedule {
        &self.lanes[sonar].schedule
    }

    /// The sonar's next pulse on the beat comes not before `utc`.
    pub fn put_off(&mut self, sonar: usize, utc: UtcNs) {
        self.lanes[sonar].schedule.put_off(utc);
    }

    /// When something is next due of the sonars that `beat` names by themselves, and of any by a trigger.
    pub fn next_utc(&self, beats: impl Fn(usize) -> bool) -> Option<UtcNs> {
        let lanes = self.lanes.iter().enumerate();
        let own = |(sonar, lane): (usize, &Lane)| {
            let beat = beats(sonar).then(|| lane.schedule.next_utc());
            [beat, lane.next_trigger()].into_iter().flatten().min()
        };
        lanes.filter_map(own).min()
    }

    /// The next thing that has happened by `now`; the caller says [`Beats::pulsed`] of every order that becomes a pulse.
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

    /// Instant and sonar of what comes next, of equals the first sonar's.
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
            // A second trigger of a sonar with a beat of its own waits too.
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

    /// A trigger for `sonar` came at `at`. What was due before has been taken with [`Beats::due`].
    pub fn trigger(&mut self, sonar: usize, at: UtcNs, in_force: InForce) -> Triggered {
        let lane = &mut self.lanes[sonar];
        match in_force.triggered() {
            Some(settings) => lane.schedule.trigger(at, settings, lane.early),
            None => Triggered::Refused(Refusal::Held),
        }
    }

    /// The sonar is triggered at `at` besides, whatever triggers it.
    pub fn again(&mut self, sonar: usize, at: UtcNs) {
        self.lanes[sonar].again = Some(at);
    }

    /// Whether what happened last with this sonar was [`Beats::again`].
    pub fn is_second(&self, sonar: usize) -> bool {
        self.lanes[sonar].is_second
    }

    /// The sonar's pulse went out at `at`: who follows it is triggered.
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

    /// Milliseconds and sonar of every ping in a second; the first sonar pings five times a second, the others follow.
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
        // 300 m: 403 ms from pulse to pulse.
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
