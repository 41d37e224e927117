//! A rig on recorded navigation, taken ping by ping as fast as whoever asks goes.

use std::sync::Arc;

use thiserror::Error;

use crate::clock::VirtualClock;
use crate::faults::nav::NavSpoiler;
use crate::io::nav::NavInputs;
use crate::rig::OpenError;
use crate::waiting::lacking;
use echotank_config::spec::{RigSpec, TriggerFrom, TriggerSpec};
use echotank_core::flow::SonarSettings;
use echotank_core::time::UtcNs;
use echotank_ping::PingOrder;
use echotank_ping::beats::{Beats, InForce};
use echotank_ping::faults::PingMark;
use echotank_ping::rig::Rig;

#[derive(Debug, Error)]
pub enum RecordedError {
    #[error(transparent)]
    Rig(#[from] OpenError),
    #[error(
        "there is nothing to replay: the configuration has no recorded navigation (a source of kind \"log\" or \"csv\")"
    )]
    NoLog,
    #[error(
        "the recorded navigation does not hold what every ping needs: {0}; what a source never sends must not stand in its `provides`"
    )]
    NoNav(String),
}

pub struct RecordedRig {
    pub rig: Rig,
    pub inputs: NavInputs,
    beats: Beats,
    /// Of the first ping.
    pub first: UtcNs,
    /// Of each sonar: it follows another; whoever waits for a trigger from outside pings on its own beat.
    follows: Vec<bool>,
}

impl RecordedRig {
    /// Reads on until the first ping's navigation is there. To be called inside the pool that will run it.
    pub fn open(spec: &RigSpec) -> Result<Self, RecordedError> {
        let mut rig = crate::rig::open(spec)?;
        let mut inputs = NavInputs::open(&spec.nav, Arc::new(VirtualClock::default()))
            .map_err(OpenError::Nav)?;
        let spoiler = NavSpoiler::new(rig.faults.clone(), &spec.nav.sources);
        inputs.spoil_with(Box::new(spoiler));
        if inputs.recorded_start().is_none() {
            return Err(RecordedError::NoLog);
        }
        let first = loop {
            if let Some(first) = rig.history.first_usable_utc() {
                break first;
            }
            if inputs.is_all_known() {
                return Err(RecordedError::NoNav(lacking(&spec.nav, &rig.history)));
            }
            inputs.pull_next(&mut rig.history);
        };
        // Known for long enough to foresee it.
        let first = first.plus_ns(spec.run.ahead_ns());
        // Plans read ahead: a scenario strikes what they read as it does in a daemon.
        rig.faults.begin(first);
        crate::rig::plan_all(&mut rig, &mut inputs, first);
        let sound_speed_m_per_s = rig.medium().sound_speed_m_per_s;
        let triggers = spec.sonars.iter().map(|sonar| &sonar.trigger);
        let follows = |trigger: &TriggerSpec| matches!(trigger.from, TriggerFrom::Sonar { .. });
        Ok(Self {
            beats: Beats::starting_at(first, sound_speed_m_per_s, triggers.clone()),
            first,
            follows: triggers.map(follows).collect(),
            rig,
            inputs,
        })
    }

    /// The next ping in time over all sonars, or none when every one has made the ping number `last`.
    pub fn next_order(&mut self, last: u32) -> Option<(usize, PingOrder)> {
        loop {
            let (beats, follows) = (&self.beats, &self.follows);
            let wanted = |sonar: usize| beats.schedule(sonar).next_number() <= last;
            let leads = |sonar: usize| wanted(sonar) && !follows[sonar];
            let now = beats.next_utc(leads)?;
            let sonars = &self.rig.sonars;
            let done: Vec<_> = (0..follows.len()).map(|sonar| !wanted(sonar)).collect();
            let in_force = |sonar: usize, _| InForce {
                settings: SonarSettings {
                    // Nobody is there to send "start".
                    pinging: !follows[sonar] && !done[sonar],
                    ..sonars[sonar].spec.settings
                },
                armed: follows[sonar] && !done[sonar],
            };
            let happened = self.beats.due(now, in_force);
            if let Some((sonar, event)) = happened
                && let Some(order) = event.order()
            {
                return Some((sonar, order));
            }
        }
    }

    /// The order's pulse went out: no fault kept it from that. One that has the sonar triggered twice does so.
    pub fn pulsed(&mut self, sonar: usize, order: &PingOrder) {
        if !self.beats.is_second(sonar)
            && let Some(after_s) = self.rig.faults.trigger_double_s(PingMark::of(sonar, order))
        {
            self.beats.again(sonar, order.transmit_utc.plus_s(after_s));
        }
        self.beats.pulsed(sonar, order.transmit_utc);
    }

    /// Reads on until the navigation covers the ping; false when the log has ended before.
    pub fn settle(&mut self, sonar: usize, order: &PingOrder) -> bool {
        crate::rig::read_on(&mut self.rig, &mut self.inputs, sonar, order)
    }
}
