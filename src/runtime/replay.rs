//! Offline replay: recorded navigation in, files out.
//!
//! The output bytes are the same for every run and every number of threads.

mod pings;

use std::fmt;
use std::sync::atomic::AtomicBool;
use std::sync::atomic::Ordering::{Acquire, Relaxed};

use thiserror::Error;

use crate::counters::{PingCounters, add};
pub use crate::formats::{Formats, ReplayOptions};
use crate::io::record::RecordError;
use crate::recorded::RecordedError;
use crate::recorders::Recorders;
use echotank_config::spec::RigSpec;
pub use pings::{PingOptions, ReplayPings, Step, use_navigation};

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

/// An open replay that has not run yet.
pub struct Replay {
    pings: ReplayPings,
    recorders: Recorders,
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
    pub fn open(spec: RigSpec, options: ReplayOptions) -> Result<Self, ReplayError> {
        let pings = ReplayPings::open(
            spec.clone(),
            PingOptions {
                pings: options.pings,
                threads: options.threads,
                elements_for: options.formats.of_elements(),
            },
        )?;
        for warning in pings.nav_warnings() {
            tracing::warn!("navigation: {warning}");
        }
        let recorders = Recorders::create(&spec, &options, pings.rig())?;
        Ok(Self { pings, recorders })
    }

    /// Expected number of pings over all sonars. `None` if the end of the log is unknown.
    pub fn pings_expected(&self) -> Option<u64> {
        self.pings.expected()
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
        // The recorders compute on the same threads.
        let pool = self.pings.pool();
        pool.install(move || {
            while !stop.load(Acquire)
                && let Some(step) = self.pings.step()
            {
                match step {
                    Step::Ping { sonar, number } => {
                        let slot = self.pings.slot(sonar);
                        self.recorders.record(slot, self.pings.rig())?;
                        progress(number);
                    }
                    Step::Skipped { number } => progress(number),
                }
            }
            self.finish()
        })
    }

    fn finish(self) -> Result<Summary, ReplayError> {
        let Self { pings, recorders } = self;
        let files = recorders.finish(pings.rig().targets())?;
        let counters = pings.counters();
        for (counters, passed_over) in &counters {
            add(&counters.skipped_nav, *passed_over);
        }
        let made = |c: &PingCounters| c.made.load(Relaxed);
        let missed = |c: &PingCounters| c.triggers_missed.load(Relaxed);
        if counters.iter().all(|(c, _)| made(c) + missed(c) == 0) {
            for file in &files {
                // A file that cannot be removed remains without a ping.
                let _ = std::fs::remove_file(file);
            }
            let lines = counters.iter().map(|(c, _)| c.replay_line());
            let counts = lines.collect::<Vec<_>>().join("; ");
            return Err(ReplayError::NoPing(counts));
        }
        let mut text = String::new();
        for (unit, (counters, _)) in pings.rig().sonars.iter().zip(&counters) {
            text += &format!("{}: {}\n", unit.spec.name, counters.replay_line());
        }
        for file in files {
            text += &format!("wrote {}\n", file.display());
        }
        text.truncate(text.trim_end().len());
        Ok(Summary {
            text,
            pings: counters.iter().map(|(c, _)| made(c)).sum(),
            above_tolerance: counters
                .iter()
                .map(|(c, _)| c.above_tolerance.load(Relaxed))
                .sum(),
        })
    }
}
