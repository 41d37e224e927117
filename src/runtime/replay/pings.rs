//! The pings of a rig on recorded navigation, computed one after another. The files of a replay and the Python package take them from here.

use std::path::Path;
use std::sync::Arc;

use super::ReplayError;
use crate::config_files::read_bounded;
use crate::counters::{PingCounters, add};
use crate::io::nav::MAX_LOG_BYTES;
use crate::io::record::masks::SampleLabels;
use crate::io::record::plan_text::sonar_and_plan;
use crate::io::record::truth::write_truth;
use crate::recorded::RecordedRig;
use echotank_config::spec::{RigSpec, SynthesisOutput, TriggerFrom};
use echotank_core::settings::{SettingChange, SettingRefused, SonarSettings};
use echotank_core::time::NS_PER_S;
use echotank_nav::recording::is_recording;
use echotank_nav::replacement::replace_sources;
use echotank_ping::PingOrder;
use echotank_ping::fan_truth::fan_truth;
use echotank_ping::faults::PingMark;
use echotank_ping::line_truth::line_truths;
use echotank_ping::rig::{PingSlot, Rig};
use echotank_ping::threads::pool;

/// Selection of the pings of a replay.
#[derive(Clone, Copy, Debug)]
pub struct PingOptions {
    /// First and last ping number, both included. `None` takes the whole log once, even if the configuration loops it.
    pub pings: Option<(u32, u32)>,
    /// Number of compute threads; 0 means one per core.
    pub threads: usize,
    /// Name of the reader of element samples in error messages, such as `npz`. `None`: the method selection may synthesise beams only.
    pub elements_for: Option<&'static str>,
}

/// Outcome of one ordered ping.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Step {
    /// The ping lies in the slot of its sonar.
    Ping {
        /// Index of the sonar.
        sonar: usize,
        /// Number of the ping.
        number: u32,
    },
    /// The navigation has a gap at this ping.
    Skipped {
        /// Number of the ping.
        number: u32,
    },
}

/// The pings of a rig on recorded navigation, in the order of time.
pub struct ReplayPings {
    pool: Arc<rayon::ThreadPool>,
    recorded: RecordedRig,
    slots: Vec<PingSlot>,
    pings: (u32, u32),
    counters: Vec<PingCounters>,
}

impl ReplayPings {
    /// Opens the rig and its recorded navigation. No ping is computed yet.
    ///
    /// # Errors
    /// See [`ReplayError`]; no file is written.
    pub fn open(mut spec: RigSpec, options: PingOptions) -> Result<Self, ReplayError> {
        // A looped log never ends, so it needs an explicit last ping.
        spec.nav.loop_log &= options.pings.is_some();
        keep_elements(&mut spec, options.elements_for)?;
        let pool = pool(options.threads)?;
        let recorded = pool.install(|| RecordedRig::open(&spec))?;
        let pings = options.pings.unwrap_or((1, u32::MAX));
        if let Some(held) = held_pings(&recorded).and_then(|held| held.into_iter().max())
            && !spec.nav.loop_log
            && u64::from(pings.0) > held
        {
            let (first, last) = pings;
            return Err(ReplayError::PastEnd { first, last, held });
        }
        let sonars = 0..recorded.rig.sonars.len();
        Ok(Self {
            slots: pool.install(|| sonars.clone().map(|k| recorded.rig.slot(k)).collect()),
            counters: sonars.map(|_| PingCounters::default()).collect(),
            pool: Arc::new(pool),
            recorded,
            pings,
        })
    }

    /// The rig, with its navigation as far as it has been read.
    pub fn rig(&self) -> &Rig {
        &self.recorded.rig
    }

    /// The threads that compute the pings.
    pub fn pool(&self) -> Arc<rayon::ThreadPool> {
        self.pool.clone()
    }

    /// Missing, ignored or replaced parts of the navigation, one line each.
    pub fn nav_warnings(&self) -> &[String] {
        &self.recorded.nav_warnings
    }

    /// The last ping of a sonar.
    ///
    /// # Panics
    /// The index is out of range.
    pub fn slot(&self, sonar: usize) -> &PingSlot {
        &self.slots[sonar]
    }

    /// Ground truth of the last ping of a sonar: the line of `truth.jsonl` without its end.
    ///
    /// # Panics
    /// The index is out of range.
    pub fn truth_json(&self, sonar: usize) -> String {
        let PingSlot { plan, output } = &self.slots[sonar];
        let rig = &self.recorded.rig;
        let mut line = Vec::new();
        // Numbers and text only, and a vector takes every byte.
        write_truth(
            &mut line,
            &rig.sonars[sonar].spec,
            plan,
            output,
            rig.targets(),
        )
        .map(|()| String::from_utf8(line).unwrap_or_default())
        .unwrap_or_default()
    }

    /// The sonar and the plan of its last ping as JSON: the member `plan` of `pings.npz`.
    ///
    /// # Panics
    /// The index is out of range.
    pub fn plan_json(&self, sonar: usize) -> String {
        let spec = &self.recorded.rig.sonars[sonar].spec;
        sonar_and_plan(spec, &self.slots[sonar].plan).to_string()
    }

    /// Labels of every side-scan line of the last computed ping. It must be a ping of this sonar.
    ///
    /// # Panics
    /// The index is out of range.
    pub fn line_labels(&self, sonar: usize) -> Vec<SampleLabels> {
        let truths = line_truths(&self.recorded.rig, &self.slots[sonar]);
        truths.iter().map(SampleLabels::of).collect()
    }

    /// Labels of every beam of the fan of the last computed ping; none without a fan. It must be a ping of this sonar.
    ///
    /// # Panics
    /// The index is out of range.
    pub fn beam_labels(&self, sonar: usize) -> Vec<SampleLabels> {
        let truths = fan_truth(&self.recorded.rig, &self.slots[sonar]);
        truths.iter().map(SampleLabels::of).collect()
    }

    /// Settings of the next ping of a sonar. A recorded run has settings of its own.
    ///
    /// # Panics
    /// The index is out of range.
    pub fn settings(&self, sonar: usize) -> SonarSettings {
        self.recorded.settings[sonar]
    }

    /// Whether the pings repeat a run with the settings of that run.
    pub fn is_recorded_run(&self) -> bool {
        self.recorded.inputs.played_pings().is_some()
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
        self.recorded.change(sonar, changes)
    }

    /// Expected number of pings over all sonars. `None` if the end of the log is unknown.
    pub fn expected(&self) -> Option<u64> {
        let (first, last) = self.pings;
        if let Some(pings) = self.recorded.inputs.played_pings() {
            let wanted = pings.filter(|ping| (first..=last).contains(&ping.number));
            return Some(wanted.count() as u64);
        }
        if last < u32::MAX {
            return Some(u64::from(last - first + 1) * self.recorded.rig.sonars.len() as u64);
        }
        held_pings(&self.recorded).map(|held| held.into_iter().sum())
    }

    /// Computes the next ping. `None` after the last one.
    pub fn step(&mut self) -> Option<Step> {
        self.pool.clone().install(|| self.step_here())
    }

    fn step_here(&mut self) -> Option<Step> {
        let (first, last) = self.pings;
        while let Some((sonar, order)) = self.recorded.next_order(last) {
            let mark = PingMark::of(sonar, &order);
            let missed = self.recorded.rig.faults.trigger_missed(mark);
            if !missed {
                self.recorded.record_pulse(sonar, &order);
            }
            let is_wanted = order.ping_number >= first;
            if missed {
                add(&self.counters[sonar].triggers_missed, u64::from(is_wanted));
                continue;
            }
            let slot = &mut self.slots[sonar];
            let is_covered = match is_wanted {
                true => self.recorded.settle(sonar, &order),
                false => self.recorded.pass_over(first, sonar, &order, slot),
            };
            if !is_covered {
                break;
            }
            if !is_wanted {
                continue;
            }
            let number = order.ping_number;
            return Some(match self.make(sonar, &order) {
                true => Step::Ping { sonar, number },
                false => Step::Skipped { number },
            });
        }
        None
    }

    fn make(&mut self, sonar: usize, order: &PingOrder) -> bool {
        let (rig, slot) = (&mut self.recorded.rig, &mut self.slots[sonar]);
        let mode = rig.spec.nav.mode;
        let counters = &self.counters[sonar];
        if echotank_ping::make_ping(rig, sonar, order, mode, order.transmit_utc, slot).is_err() {
            add(&counters.skipped_nav, 1);
            return false;
        }
        let frames = slot.output.elements.iter();
        let saturated = frames.map(|frame| frame.saturated).sum();
        counters.ping(&slot.output.counts, saturated, 0);
        counters.scene(&slot.output.scene);
        counters.nav(&slot.plan.nav);
        counters.errors_of(&slot.output, &rig.sonars[sonar]);
        true
    }

    /// Counts of each sonar, with the pings in long gaps of the navigation.
    pub fn counters(&self) -> Vec<(&PingCounters, u64)> {
        let passed_over = self.recorded.passed_over.iter().copied();
        self.counters.iter().zip(passed_over).collect()
    }
}

/// Uses a log, or a recording of live sources, in place of the configured sources.
///
/// # Errors
/// The file cannot be read; the reason, without the path.
pub fn use_navigation(spec: &mut RigSpec, log: &Path) -> Result<(), String> {
    let bytes = read_bounded(log, MAX_LOG_BYTES)?;
    if is_recording(&bytes) {
        spec.nav.recording = Some(log.to_path_buf());
    } else {
        replace_sources(&mut spec.nav, log);
    }
    Ok(())
}

/// Makes every sonar keep its element samples if something reads them.
fn keep_elements(spec: &mut RigSpec, reader: Option<&'static str>) -> Result<(), ReplayError> {
    let Some(format) = reader else {
        return Ok(());
    };
    for sonar in &mut spec.sonars {
        if sonar.synthesis.output == SynthesisOutput::Beams {
            let sonar = sonar.name.clone();
            return Err(ReplayError::Beams { sonar, format });
        }
        sonar
            .synthesis
            .elements_for
            .get_or_insert("the reader of this replay takes element samples");
    }
    Ok(())
}

/// About how many pings of each sonar the navigation holds. `None` if the end of the log is unknown.
fn held_pings(recorded: &RecordedRig) -> Option<Vec<u64>> {
    let sonars = &recorded.rig.sonars;
    if let Some(pings) = recorded.inputs.played_pings() {
        let mut last = vec![0; sonars.len()];
        for ping in pings {
            last[ping.sonar] = last[ping.sonar].max(u64::from(ping.number));
        }
        return Some(last);
    }
    let end = recorded.inputs.recorded_end()?;
    let c = recorded.rig.medium().sound_speed_m_per_s;
    let held = sonars.iter().map(|unit| {
        // A sonar triggered by another pings at that sonar's rate.
        let leader = match unit.spec.trigger.from {
            TriggerFrom::Sonar { sonar, .. } => &sonars[sonar],
            _ => unit,
        };
        let period_s = echotank_ping::period_ns(&leader.spec.settings, c) as f64 / NS_PER_S as f64;
        (end.seconds_since(recorded.first) / period_s).max(0.0) as u64 + 1
    });
    Some(held.collect())
}
