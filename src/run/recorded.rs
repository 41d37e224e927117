//! A rig on recorded navigation, taken ping by ping as fast as whoever asks goes.

use std::sync::Arc;

use thiserror::Error;

use crate::config::spec::RigSpec;
use crate::flow::SonarSettings;
use crate::io::nav::NavInputs;
use crate::ping::{PingOrder, Schedule};
use crate::run::rig::{Rig, RigError};
use crate::run::waiting::lacking;
use crate::time::VirtualClock;

#[derive(Debug, Error)]
pub enum RecordedError {
    #[error(transparent)]
    Rig(#[from] RigError),
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
    /// One per sonar.
    pub schedules: Vec<Schedule>,
}

impl RecordedRig {
    /// Reads on until the first ping's navigation is there. To be called inside the pool that will run it.
    pub fn open(spec: &RigSpec) -> Result<Self, RecordedError> {
        let mut rig = Rig::open(spec)?;
        let mut inputs =
            NavInputs::open(&spec.nav, Arc::new(VirtualClock::default())).map_err(RigError::Nav)?;
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
        rig.plan_all(&mut inputs, first);
        let sound_speed_m_per_s = rig.medium().sound_speed_m_per_s;
        let schedules = vec![Schedule::starting_at(first, sound_speed_m_per_s); rig.sonars.len()];
        Ok(Self {
            rig,
            inputs,
            schedules,
        })
    }

    /// The next ping in time over all sonars, or none when every one has made the ping number `last`.
    pub fn next_order(&mut self, last: u32) -> Option<(usize, PingOrder)> {
        let (sonar, schedule) = self
            .schedules
            .iter_mut()
            .enumerate()
            .filter(|(_, schedule)| schedule.next_number() <= last)
            .min_by_key(|(_, schedule)| schedule.next_utc())?;
        let running = SonarSettings {
            // Nobody is there to send "start".
            pinging: true,
            ..self.rig.sonars[sonar].spec.settings
        };
        let order = schedule.due(schedule.next_utc(), |_| running)?;
        Some((sonar, order))
    }

    /// Reads on until the navigation covers the ping; false when the log has ended before.
    pub fn settle(&mut self, sonar: usize, order: &PingOrder) -> bool {
        self.rig.read_on(&mut self.inputs, sonar, order)
    }
}
