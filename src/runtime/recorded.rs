//! A rig on recorded navigation, advanced ping by ping at the caller's speed.

use std::sync::Arc;

use thiserror::Error;

use crate::clock::VirtualClock;
use crate::faults::nav::NavFaults;
use crate::io::nav::{Mark, NavInputs, ReadNav};
use crate::rig::OpenError;
use crate::settings::changed;
use crate::waiting::missing_quantities;
use echotank_config::spec::{RigSpec, TriggerFrom, TriggerSpec};
use echotank_core::settings::{SettingChange, SettingRefused, SettingRule, SonarSettings};
use echotank_core::time::UtcNs;
use echotank_ping::PingOrder;
use echotank_ping::faults::PingMark;
use echotank_ping::method_selection::live;
use echotank_ping::rig::{PingSlot, Rig};
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
        "there is nothing to replay: the configuration has no recorded navigation (a source of kind \"log\" or \"csv\"); give one with --nav LOG"
    )]
    NoLog,
    /// The recording of the live sources does not fit the rig.
    #[error("--nav: {0}")]
    Recording(String),
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
    /// Per sonar: of pings that a recorded run skipped.
    examined: Vec<Option<PingSlot>>,
    /// Per sonar: settings of the next ping. A recorded run has settings of its own.
    pub(crate) settings: Vec<SonarSettings>,
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
        let (is_played, has_recorded) = (nav.is_played(), nav.has_recorded());
        if !is_played && !has_recorded {
            return Err(RecordedError::NoLog);
        }
        let spec = &RigSpec {
            nav: nav.spec.clone(),
            ..spec.clone()
        };
        let mut nav_warnings = nav.warnings.clone();
        let mut rig = crate::rig::open(spec)?;
        let mut inputs =
            NavInputs::start(nav, Arc::new(VirtualClock::default())).map_err(OpenError::Nav)?;
        let nav_faults = NavFaults::new(rig.faults.clone(), &spec.nav.sources);
        inputs.set_fault_filter(Box::new(nav_faults));
        let first = match is_played {
            true => first_played(&mut rig, &mut inputs)?,
            // Prediction needs navigation from before the ping.
            false => first_usable(&mut rig, &mut inputs)?.plus_ns(spec.run.ahead_ns()),
        };
        // Planning reads navigation ahead; injected faults must already apply to it, as in the daemon.
        rig.faults.begin(first);
        let pings = inputs.played_pings().into_iter().flatten();
        let degraded = pings.filter(|ping| ping.level > 0).count();
        if degraded > 0 {
            nav_warnings.push(format!(
                "the run computed {degraded} pings with a larger tolerance; the replay computes them in full, so their samples differ"
            ));
        }
        // With live sources only, the daemon knows no navigation ahead.
        match has_recorded {
            true => crate::rig::plan_all(&mut rig, &mut inputs, first),
            false => rig.make_starting_engines(),
        }
        for unit in &mut rig.sonars {
            if let Some(method_selector) = &mut unit.method_selector {
                method_selector.correct(false);
            }
        }
        let sound_speed_m_per_s = rig.medium().sound_speed_m_per_s;
        let triggers = spec.sonars.iter().map(|sonar| &sonar.trigger);
        let follows = |trigger: &TriggerSpec| matches!(trigger.from, TriggerFrom::Sonar { .. });
        Ok(Self {
            schedule: RigSchedule::starting_at(first, sound_speed_m_per_s, triggers.clone()),
            first,
            follows: triggers.map(follows).collect(),
            passed_over: vec![0; spec.sonars.len()],
            examined: spec.sonars.iter().map(|_| None).collect(),
            settings: spec.sonars.iter().map(|sonar| sonar.settings).collect(),
            nav_warnings,
            rig,
            inputs,
        })
    }

    /// Changes settings of a sonar from its next ping on: all of them, or none. The sonar of a replay always pings, so a rate of 0 is refused.
    ///
    /// # Errors
    /// A value is outside the configured limits; the settings stay unchanged.
    ///
    /// # Panics
    /// The index is out of range.
    pub fn change(
        &mut self,
        sonar: usize,
        changes: &[SettingChange],
    ) -> Result<SonarSettings, SettingRefused> {
        let limits = &self.rig.sonars[sonar].spec.limits;
        let apply = |settings, change: &SettingChange| changed(settings, *change, limits);
        let settings = changes.iter().try_fold(self.settings[sonar], apply)?;
        if settings.max_ping_rate_hz == 0.0 {
            let (min, max) = limits.ping_rate_hz;
            return Err(SettingRefused {
                key: "max_ping_rate_hz",
                value: 0.0,
                rule: SettingRule::Between { min, max },
            });
        }
        self.settings[sonar] = settings;
        Ok(settings)
    }

    /// Sonar index and order of the next ping in time. `None` once every sonar has reached ping number `last`.
    pub fn next_order(&mut self, last: u32) -> Option<(usize, PingOrder)> {
        if self.inputs.played_pings().is_some() {
            return self.next_played(last);
        }
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
            let settings = &self.settings;
            let done: Vec<_> = (0..follows.len()).map(|sonar| !wanted(sonar)).collect();
            let in_force = |sonar: usize, _| SettingsInForce {
                settings: SonarSettings {
                    // A replay has no client that starts the sonar.
                    pinging: !follows[sonar] && !done[sonar],
                    ..settings[sonar]
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

    /// The next ping of the recorded run with a number up to `last`.
    fn next_played(&mut self, last: u32) -> Option<(usize, PingOrder)> {
        loop {
            let mark = self.inputs.play(&mut self.rig.history)?;
            let (Mark::Ping(ping) | Mark::Skipped(ping)) = mark else {
                continue;
            };
            if ping.number > last {
                continue;
            }
            let (sonar, order) = (
                ping.sonar,
                PingOrder {
                    ping_number: ping.number,
                    transmit_utc: ping.transmit_utc,
                    settings: ping.settings,
                    period_s: ping.period_s,
                },
            );
            if let Mark::Ping(_) = mark {
                return Some((sonar, order));
            }
            // The run made no such ping, but its later selections depend on it.
            let mode = self.rig.spec.nav.mode;
            let rig = &mut self.rig;
            if let Some(slot) = self.examined.get_mut(sonar) {
                let slot = slot.get_or_insert_with(|| rig.slot(sonar));
                let _gap = rig.examine(sonar, &order, mode, slot);
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
                TriggerFrom::Sonar { sonar: leader, .. } => leader,
                _ => sonar,
            };
            let period_ns = echotank_ping::period_ns(&self.settings[leader], sound_speed_m_per_s);
            let missed = end.0.saturating_sub(from.0).max(0) / period_ns.max(1);
            self.passed_over[sonar] += missed as u64;
            self.schedule.put_off(sonar, end);
        }
        true
    }

    /// Passes over the ping of `order`, which comes before `first`, the first to be made. The method selection examines those pings on which the methods
    /// of `first` depend. Returns false if the log ends first.
    pub fn pass_over(
        &mut self,
        first: u32,
        sonar: usize,
        order: &PingOrder,
        slot: &mut PingSlot,
    ) -> bool {
        let c = self.rig.medium().sound_speed_m_per_s;
        if !live::is_examined_before(first, order, c) {
            return true;
        }
        let is_covered = self.settle(sonar, order);
        if is_covered {
            let mode = self.rig.spec.nav.mode;
            // In a gap of the navigation there is nothing to examine.
            let _gap = self.rig.examine(sonar, order, mode, slot);
        }
        is_covered
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
        if self.inputs.played_pings().is_some() {
            // `next_order` has inserted the samples that the run had.
            return true;
        }
        crate::rig::read_navigation_for(&mut self.rig, &mut self.inputs, sonar, order)
    }
}

/// First instant at which the recorded sources have every quantity that a ping needs.
fn first_usable(rig: &mut Rig, inputs: &mut NavInputs) -> Result<UtcNs, RecordedError> {
    loop {
        if let Some(first) = rig.history.first_usable_utc() {
            return Ok(first);
        }
        if inputs.is_all_known() {
            let missing = missing_quantities(&rig.spec.nav, &rig.history);
            return Err(RecordedError::NoNav(missing));
        }
        inputs.pull_next(&mut rig.history);
    }
}

/// Instant of the first ping of the recorded run, whose pings must fit the rig.
fn first_played(rig: &mut Rig, inputs: &mut NavInputs) -> Result<UtcNs, RecordedError> {
    let refuse = |why: String| Err(RecordedError::Recording(why));
    for ping in inputs.played_pings().into_iter().flatten() {
        let Some(unit) = rig.sonars.get(ping.sonar) else {
            return refuse(format!(
                "the recorded run has a sonar {} that the rig lacks: replay it with the rig that recorded it",
                ping.sonar + 1
            ));
        };
        let (limits, s) = (&unit.spec.limits, &ping.settings);
        for (key, value, (min, max)) in [
            ("range_m", s.range_m, limits.range_m),
            ("gain_db", s.gain_db, limits.gain_db),
            ("source_level_db", s.source_level_db, limits.source_level_db),
            (
                "pulse_duration_s",
                s.pulse_duration_s,
                limits.pulse_duration_s,
            ),
        ] {
            if !(min..=max).contains(&value) {
                return refuse(format!(
                    "ping {} of {} has {key} = {value}, but the rig allows {min} to {max}: replay it with the limits of the run",
                    ping.number, unit.spec.name
                ));
            }
        }
    }
    match inputs.play(&mut rig.history) {
        Some(Mark::Start(start)) => Ok(start.first_utc),
        _ => refuse("the recorded run ended before its first ping".to_owned()),
    }
}
