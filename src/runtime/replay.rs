//! Offline replay: recorded navigation in, files out.
//!
//! The output bytes are the same for every run and every number of threads.

use std::fmt;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::sync::atomic::Ordering::{Acquire, Relaxed};

use thiserror::Error;

use crate::counters::{PingCounters, add};
pub use crate::formats::{Formats, ReplayOptions};
use crate::io::record::RecordError;
use crate::recorded::{RecordedError, RecordedRig};
use crate::recorders::Recorders;
use echotank_config::spec::{RigSpec, SynthesisOutput, TriggerFrom};
use echotank_core::time::NS_PER_S;
use echotank_ping::PingOrder;
use echotank_ping::faults::PingMark;
use echotank_ping::rig::PingSlot;
use echotank_ping::threads::pool;

/// Errors of a replay.
#[derive(Debug, Error)]
pub enum ReplayError {
    /// The rig or its recorded navigation cannot be opened.
    #[error(transparent)]
    Recorded(#[from] RecordedError),
    /// An output file cannot be written.
    #[error(transparent)]
    Record(#[from] RecordError),
    /// A requested format needs element samples, but the sonar synthesises beams directly.
    #[error(
        "sonar {sonar}: sonar.model.output = \"beams\" computes no element samples, which {format} needs"
    )]
    Beams {
        /// The configured name of the sonar.
        sonar: String,
        /// The file format, by its extension.
        format: &'static str,
    },
    /// The navigation ends before the first ping of `--pings`.
    #[error(
        "--pings {first}..{last}: the navigation holds only about {held} pings; choose from 1..{held}"
    )]
    PastEnd {
        /// First requested ping.
        first: u32,
        /// Last requested ping.
        last: u32,
        /// Number of pings within the navigation.
        held: u64,
    },
    /// No ping lies within the navigation and the range of `--pings`. No file remains.
    #[error("no ping was computed and no file written: {0}")]
    NoPing(String),
    /// The threads for computing cannot be started.
    #[error("threads: {0}")]
    Threads(#[from] rayon::ThreadPoolBuildError),
}

/// Makes every sonar keep its element samples if a requested format needs them.
fn keep_elements(spec: &mut RigSpec, formats: &Formats) -> Result<(), ReplayError> {
    let Some(format) = formats.of_elements() else {
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
            .get_or_insert("a file of this replay holds element samples");
    }
    Ok(())
}

/// An open replay that has not run yet.
pub struct Replay {
    pool: Arc<rayon::ThreadPool>,
    recorded: RecordedRig,
    recorders: Recorders,
    pings: (u32, u32),
    counters: Vec<PingCounters>,
}

/// Result of a replay. Displays one line of counters per sonar and one line per file.
pub struct Summary {
    text: String,
    /// Number of pings in the files.
    pub pings: u64,
    /// Number of those that are predicted or measured above the tolerance.
    pub above_tolerance: u64,
}

impl fmt::Display for Summary {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.text)
    }
}

impl Replay {
    /// Opens the rig, its recorded navigation and the output files.
    ///
    /// # Errors
    /// See [`ReplayError`].
    pub fn open(mut spec: RigSpec, options: ReplayOptions) -> Result<Self, ReplayError> {
        // A looped log never ends, so it needs an explicit last ping.
        spec.nav.loop_log &= options.pings.is_some();
        keep_elements(&mut spec, &options.formats)?;
        let pool = pool(options.threads)?;
        let recorded = pool.install(|| RecordedRig::open(&spec))?;
        for warning in &recorded.nav_warnings {
            tracing::warn!("navigation: {warning}");
        }
        let pings = options.pings.unwrap_or((1, u32::MAX));
        if let Some(held) = held_pings(&recorded).and_then(|held| held.into_iter().max())
            && !spec.nav.loop_log
            && u64::from(pings.0) > held
        {
            let (first, last) = pings;
            return Err(ReplayError::PastEnd { first, last, held });
        }
        let recorders = Recorders::create(&spec, &options, &recorded.rig)?;
        Ok(Self {
            pool: Arc::new(pool),
            counters: recorded
                .rig
                .sonars
                .iter()
                .map(|_| PingCounters::default())
                .collect(),
            recorded,
            recorders,
            pings,
        })
    }

    /// Expected number of pings over all sonars. `None` if the end of the log is unknown.
    pub fn pings_expected(&self) -> Option<u64> {
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

    /// Computes and writes all pings. Calls `progress` with the number of every ping made or skipped.
    ///
    /// # Errors
    /// A file cannot be written, or no ping was made.
    pub fn run(self, progress: impl FnMut(u32) + Send) -> Result<Summary, ReplayError> {
        self.run_until(&AtomicBool::new(false), progress)
    }

    /// As [`Replay::run`]. If `stop` becomes true, the ping in progress is the last, and all files are completed.
    ///
    /// # Errors
    /// See [`Replay::run`].
    pub fn run_until(
        mut self,
        stop: &AtomicBool,
        mut progress: impl FnMut(u32) + Send,
    ) -> Result<Summary, ReplayError> {
        let pool = self.pool.clone();
        pool.install(move || {
            let mut slots: Vec<PingSlot> = (0..self.recorded.rig.sonars.len())
                .map(|sonar| self.recorded.rig.slot(sonar))
                .collect();
            let last = self.pings.1;
            while !stop.load(Acquire)
                && let Some((sonar, order)) = self.recorded.next_order(last)
            {
                let mark = PingMark::of(sonar, &order);
                let missed = self.recorded.rig.faults.trigger_missed(mark);
                if !missed {
                    self.recorded.record_pulse(sonar, &order);
                }
                let first = self.pings.0;
                let is_wanted = order.ping_number >= first;
                if missed {
                    add(&self.counters[sonar].triggers_missed, u64::from(is_wanted));
                    continue;
                }
                let slot = &mut slots[sonar];
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
                self.ping(sonar, &order, &mut slots[sonar])?;
                progress(order.ping_number);
            }
            self.finish()
        })
    }

    fn ping(
        &mut self,
        sonar: usize,
        order: &PingOrder,
        slot: &mut PingSlot,
    ) -> Result<(), ReplayError> {
        let counters = &self.counters[sonar];
        let mode = self.recorded.rig.spec.nav.mode;
        match echotank_ping::make_ping(
            &mut self.recorded.rig,
            sonar,
            order,
            mode,
            order.transmit_utc,
            slot,
        ) {
            Ok(()) => {
                let saturated = slot
                    .output
                    .elements
                    .iter()
                    .map(|frame| frame.saturated)
                    .sum();
                counters.ping(&slot.output.counts, saturated, 0);
                counters.scene(&slot.output.scene);
                counters.nav(&slot.plan.nav);
                counters.errors_of(&slot.output, &self.recorded.rig.sonars[sonar]);
                self.recorders.record(slot, &self.recorded.rig)?;
            }
            Err(_gap) => add(&counters.skipped_nav, 1),
        }
        Ok(())
    }

    fn finish(self) -> Result<Summary, ReplayError> {
        let files = self.recorders.finish(self.recorded.rig.targets())?;
        for (counters, passed_over) in self.counters.iter().zip(&self.recorded.passed_over) {
            add(&counters.skipped_nav, *passed_over);
        }
        let made = |c: &PingCounters| c.made.load(Relaxed);
        let missed = |c: &PingCounters| c.triggers_missed.load(Relaxed);
        if self.counters.iter().all(|c| made(c) + missed(c) == 0) {
            for file in &files {
                // A file that cannot be removed remains without a ping.
                let _ = std::fs::remove_file(file);
            }
            let lines = self.counters.iter().map(PingCounters::replay_line);
            let counts = lines.collect::<Vec<_>>().join("; ");
            return Err(ReplayError::NoPing(counts));
        }
        let mut text = String::new();
        for (unit, counters) in self.recorded.rig.sonars.iter().zip(&self.counters) {
            text += &format!("{}: {}\n", unit.spec.name, counters.replay_line());
        }
        for file in files {
            text += &format!("wrote {}\n", file.display());
        }
        text.truncate(text.trim_end().len());
        Ok(Summary {
            text,
            pings: self.counters.iter().map(made).sum(),
            above_tolerance: self
                .counters
                .iter()
                .map(|c| c.above_tolerance.load(Relaxed))
                .sum(),
        })
    }
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
