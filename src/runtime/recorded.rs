//! A rig on recorded navigation, advanced ping by ping at the caller's speed.

use std::sync::Arc;

use thiserror::Error;

use crate::clock::VirtualClock;
use crate::faults::nav::NavFaults;
use crate::io::nav::{NavInputs, ReadNav};
use crate::rig::OpenError;
use crate::waiting::missing_quantities;
use echotank_config::spec::{RigSpec, TriggerFrom, TriggerSpec};
use echotank_core::settings::SonarSettings;
use echotank_core::time::UtcNs;
use echotank_ping::PingOrder;
use echotank_ping::faults::PingMark;
use echotank_ping::rig::Rig;
use echotank_ping::rig_schedule::{RigSchedule, SettingsInForce};

/// Distance from the ends of a long gap within which pings are ordered one by one, seconds.
const GAP_MARGIN_S: f64 = 60.0;

/// Errors of opening a recorded rig.
#[derive(Debug, Error)]
pub enum RecordedError {
    /// The rig or a navigation file cannot be opened.
    #[error(transparent)]
    Rig(#[from] OpenError),
    /// The configuration has no source of kind `log` or `csv`.
    #[error(
        "there is nothing to replay: the configuration has no recorded navigation (a source of kind \"log\" or \"csv\")"
    )]
    NoLog,
    /// The recording lacks a quantity that every ping needs; the text names it.
    #[error(
        "the recorded navigation lacks a quantity that every ping needs: {0}; list in `provides` only what a source sends"
    )]
    NoNav(String),
}

/// A rig, its recorded navigation and its ping schedule.
pub struct RecordedRig {
    /// Rig under replay.
    pub rig: Rig,
    /// Recorded sources, read as far as the pings so far need.
    pub inputs: NavInputs,
    schedule: RigSchedule,
    /// UTC of the first ping.
    pub first: UtcNs,
    /// Per sonar: whether another sonar triggers it. A sonar with an external trigger uses its own schedule.
    follows: Vec<bool>,
    /// Per sonar: pings in long gaps of the navigation, which have no number.
    pub(crate) passed_over: Vec<u64>,
    /// Missing, ignored or replaced parts of the navigation, one line each.
    pub nav_warnings: Vec<String>,
}

impl RecordedRig {
    /// Opens the rig and reads navigation up to the first usable ping. Call inside the thread pool that computes the pings of the rig.
    ///
    /// # Errors
    /// See [`RecordedError`].
    pub fn open(spec: &RigSpec) -> Result<Self, RecordedError> {
        let nav = ReadNav::read(&spec.nav).map_err(OpenError::Nav)?;
        if !nav.has_recorded() {
            return Err(RecordedError::NoLog);
        }
        let spec = &RigSpec {
            nav: nav.spec.clone(),
            ..spec.clone()
        };
        let nav_warnings = nav.warnings.clone();
        let mut rig = crate::rig::open(spec)?;
        let mut inputs =
            NavInputs::start(nav, Arc::new(VirtualClock::default())).map_err(OpenError::Nav)?;
        let nav_faults = NavFaults::new(rig.faults.clone(), &spec.nav.sources);
        inputs.set_fault_filter(Box::new(nav_faults));
        let first = loop {
            if let Some(first) = rig.history.first_usable_utc() {
                break first;
            }
            if inputs.is_all_known() {
                return Err(RecordedError::NoNav(missing_quantities(
                    &spec.nav,
                    &rig.history,
                )));
            }
            inputs.pull_next(&mut rig.history);
        };
        // Prediction needs navigation from before the ping.
        let first = first.plus_ns(spec.run.ahead_ns());
        // Planning reads navigation ahead; injected faults must already apply to it, as in the daemon.
        rig.faults.begin(first);
        crate::rig::plan_all(&mut rig, &mut inputs, first);
        let sound_speed_m_per_s = rig.medium().sound_speed_m_per_s;
        let triggers = spec.sonars.iter().map(|sonar| &sonar.trigger);
        let follows = |trigger: &TriggerSpec| matches!(trigger.from, TriggerFrom::Sonar { .. });
        Ok(Self {
            schedule: RigSchedule::starting_at(first, sound_speed_m_per_s, triggers.clone()),
            first,
            follows: triggers.map(follows).collect(),
            passed_over: vec![0; spec.sonars.len()],
            nav_warnings,
            rig,
            inputs,
        })
    }

    /// Sonar index and order of the next ping in time. `None` once every sonar has reached ping number `last`.
    pub fn next_order(&mut self, last: u32) -> Option<(usize, PingOrder)> {
        loop {
            let (schedule, follows) = (&self.schedule, &self.follows);
            let wanted = |sonar: usize| schedule.of_sonar(sonar).next_number() <= last;
            let leads = |sonar: usize| wanted(sonar) && !follows[sonar];
            let now = schedule.next_utc(leads)?;
            if self.pass_over_gap(now) {
                continue;
            }
            let (schedule, follows) = (&self.schedule, &self.follows);
            let wanted = |sonar: usize| schedule.of_sonar(sonar).next_number() <= last;
            let sonars = &self.rig.sonars;
            let done: Vec<_> = (0..follows.len()).map(|sonar| !wanted(sonar)).collect();
            let in_force = |sonar: usize, _| SettingsInForce {
                settings: SonarSettings {
                    // A replay has no client that starts the sonar.
                    pinging: !follows[sonar] && !done[sonar],
                    ..sonars[sonar].spec.settings
                },
                armed: follows[sonar] && !done[sonar],
            };
            let next = self.schedule.due(now, in_force);
            if let Some((sonar, event)) = next
                && let Some(order) = event.order()
            {
                return Some((sonar, order));
            }
        }
    }

    /// Skips a long gap of the navigation that contains the next ping. Counts the pings of each sonar in the gap. Returns whether a gap was skipped.
    fn pass_over_gap(&mut self, now: UtcNs) -> bool {
        let Some(end) = self.inputs.gap_end(now, GAP_MARGIN_S) else {
            return false;
        };
        let sonars = 0..self.rig.sonars.len();
        if sonars
            .into_iter()
            .all(|s| self.schedule.of_sonar(s).next_utc() >= end)
        {
            // Every schedule already continues after the gap. Only pings triggered before the gap remain.
            return false;
        }
        let sound_speed_m_per_s = self.rig.medium().sound_speed_m_per_s;
        for (sonar, unit) in self.rig.sonars.iter().enumerate() {
            let from = self.schedule.of_sonar(sonar).next_utc();
            let leader = match unit.spec.trigger.from {
                TriggerFrom::Sonar { sonar, .. } => &self.rig.sonars[sonar],
                _ => unit,
            };
            let period_ns = echotank_ping::period_ns(&leader.spec.settings, sound_speed_m_per_s);
            let missed = end.0.saturating_sub(from.0).max(0) / period_ns.max(1);
            self.passed_over[sonar] += missed as u64;
            self.schedule.put_off(sonar, end);
        }
        true
    }

    /// Records that the order's pulse was transmitted. An injected double-trigger fault schedules a second pulse.
    pub fn record_pulse(&mut self, sonar: usize, order: &PingOrder) {
        if !self.schedule.is_second(sonar)
            && let Some(after_s) = self.rig.faults.trigger_double_s(PingMark::of(sonar, order))
        {
            self.schedule
                .trigger_again(sonar, order.transmit_utc.plus_s(after_s));
        }
        self.schedule.note_pulse(sonar, order.transmit_utc);
    }

    /// Reads navigation until it covers the ping. Returns false if the log ends first.
    pub fn settle(&mut self, sonar: usize, order: &PingOrder) -> bool {
        crate::rig::read_navigation_for(&mut self.rig, &mut self.inputs, sonar, order)
    }
}
