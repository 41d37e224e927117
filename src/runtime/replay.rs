//! Offline replay: recorded navigation in, files out.
//!
//! The output bytes are the same for every run and every number of threads.

use std::fmt;
use std::sync::Arc;
use std::sync::atomic::Ordering::Relaxed;

use thiserror::Error;

use crate::counters::{PingCounters, add};
pub use crate::formats::{Formats, ReplayOptions};
use crate::io::record::RecordError;
use crate::recorded::{RecordedError, RecordedRig};
use crate::recorders::Recorders;
use echotank_config::spec::{RigSpec, SynthesisOutput, TriggerFrom};
use echotank_core::time::{NS_PER_S, UtcNs};
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
    /// No ping lies within the navigation and the range of `--pings`.
    #[error("no ping was computed: {0}")]
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
    recorded_end: Option<UtcNs>,
    counters: Vec<PingCounters>,
}

/// Result of a replay. Displays one line of counters per sonar and one line per file.
pub struct Summary {
    text: String,
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
        let recorders = Recorders::create(&spec, &options, &recorded.rig)?;
        Ok(Self {
            pool: Arc::new(pool),
            recorded_end: recorded.inputs.recorded_end(),
            counters: recorded
                .rig
                .sonars
                .iter()
                .map(|_| PingCounters::default())
                .collect(),
            recorded,
            recorders,
            pings: options.pings.unwrap_or((1, u32::MAX)),
        })
    }

    /// Expected number of pings over all sonars. `None` if the end of the log is unknown.
    pub fn pings_expected(&self) -> Option<u64> {
        let (first, last) = self.pings;
        if last < u32::MAX {
            return Some(u64::from(last - first + 1) * self.recorded.rig.sonars.len() as u64);
        }
        let end = self.recorded_end?;
        let c = self.recorded.rig.medium().sound_speed_m_per_s;
        Some(
            self.recorded
                .rig
                .sonars
                .iter()
                .map(|unit| {
                    // A sonar triggered by another pings at that sonar's rate.
                    let leader = match unit.spec.trigger.from {
                        TriggerFrom::Sonar { sonar, .. } => &self.recorded.rig.sonars[sonar],
                        _ => unit,
                    };
                    let period_s =
                        echotank_ping::period_ns(&leader.spec.settings, c) as f64 / NS_PER_S as f64;
                    (end.seconds_since(self.recorded.first) / period_s).max(0.0) as u64
                })
                .sum(),
        )
    }

    /// Computes and writes all pings. Calls `progress` with the number of every ping made or skipped.
    ///
    /// # Errors
    /// A file cannot be written, or no ping was made.
    pub fn run(mut self, mut progress: impl FnMut(u32) + Send) -> Result<Summary, ReplayError> {
        let pool = self.pool.clone();
        pool.install(move || {
            let mut slots: Vec<PingSlot> = (0..self.recorded.rig.sonars.len())
                .map(|sonar| self.recorded.rig.slot(sonar))
                .collect();
            let last = self.pings.1;
            while let Some((sonar, order)) = self.recorded.next_order(last) {
                let mark = PingMark::of(sonar, &order);
                let missed = self.recorded.rig.faults.trigger_missed(mark);
                if !missed {
                    self.recorded.record_pulse(sonar, &order);
                }
                if order.ping_number < self.pings.0 {
                    continue;
                }
                if missed {
                    add(&self.counters[sonar].triggers_missed, 1);
                    continue;
                }
                if !self.recorded.settle(sonar, &order) {
                    break;
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
                counters.error_check(slot.output.error_check.as_ref());
                if let Some(method_selector) = &self.recorded.rig.sonars[sonar].method_selector {
                    counters.plan(slot.output.methods.as_ref(), &method_selector.counts);
                }
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
        let made_none =
            |c: &PingCounters| c.made.load(Relaxed) + c.triggers_missed.load(Relaxed) == 0;
        if self.counters.iter().all(made_none) {
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
        Ok(Summary { text })
    }
}
