//! The same pipeline offline: recorded navigation in, files out, the same bytes every time and for any number of threads.

use std::fmt;
use std::path::PathBuf;
use std::sync::Arc;

use thiserror::Error;

use crate::counters::{PingCounters, add};
use crate::io::record::RecordError;
use crate::recorded::{RecordedError, RecordedRig};
use crate::recorders::Recorders;
use echotank_config::spec::{MadeOutput, RigSpec, TriggerFrom};
use echotank_core::time::{NS_PER_S, UtcNs};
use echotank_ping::PingOrder;
use echotank_ping::faults::PingMark;
use echotank_ping::rig::{PingSlot, pool};

#[derive(Debug, Error)]
pub enum ReplayError {
    #[error(transparent)]
    Recorded(#[from] RecordedError),
    #[error(transparent)]
    Record(#[from] RecordError),
    #[error(
        "sonar {sonar}: sonar.model.output = \"beams\": {format} holds elements, and none are made"
    )]
    Beams { sonar: String, format: &'static str },
    #[error("threads: {0}")]
    Threads(#[from] rayon::ThreadPoolBuildError),
}

#[derive(Clone, Copy, Debug, Default)]
pub struct Formats {
    pub s7k: bool,
    pub jsf: bool,
    pub xtf: bool,
    pub npz: bool,
    pub png: bool,
    /// Synthetic aperture, of the sonars that have one configured.
    pub sas: bool,
    pub fan: bool,
    pub mosaic: bool,
    pub masks: bool,
    pub sigmf: bool,
    pub wav: bool,
}

impl Formats {
    /// The first of those asked for that holds elements, or is made of them.
    fn of_elements(&self) -> Option<&'static str> {
        let all = [
            (self.s7k, "s7k"),
            (self.jsf, "jsf"),
            (self.npz, "npz"),
            (self.sas, "sas"),
            (self.sigmf, "sigmf"),
            (self.wav, "wav"),
        ];
        all.into_iter()
            .find(|(asked, _)| *asked)
            .map(|(_, name)| name)
    }
}

/// Files of elements need elements, whatever the configuration's outputs need.
fn keep_elements(spec: &mut RigSpec, formats: &Formats) -> Result<(), ReplayError> {
    let Some(format) = formats.of_elements() else {
        return Ok(());
    };
    for sonar in &mut spec.sonars {
        if sonar.synthesis.output == MadeOutput::Beams {
            let sonar = sonar.name.clone();
            return Err(ReplayError::Beams { sonar, format });
        }
        sonar
            .synthesis
            .elements_for
            .get_or_insert("a file of this replay holds them");
    }
    Ok(())
}

#[derive(Clone, Debug)]
pub struct ReplayOptions {
    pub out: PathBuf,
    pub formats: Formats,
    /// Samples in `.npz` as complex128.
    pub f64: bool,
    /// First and last ping; the log is then looped if the configuration loops it.
    pub pings: Option<(u32, u32)>,
    pub threads: usize,
}

pub struct Replay {
    pool: Arc<rayon::ThreadPool>,
    recorded: RecordedRig,
    recorders: Recorders,
    pings: (u32, u32),
    recorded_end: Option<UtcNs>,
    counters: Vec<PingCounters>,
}

/// What a replay did.
pub struct Summary {
    pub(crate) pings_made: u64,
    text: String,
}

impl fmt::Display for Summary {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.text)
    }
}

impl Replay {
    pub fn open(mut spec: RigSpec, options: ReplayOptions) -> Result<Self, ReplayError> {
        // A whole replay of a looped log would never end: the loop is for those who name the last ping.
        spec.nav.loop_log &= options.pings.is_some();
        keep_elements(&mut spec, &options.formats)?;
        let pool = pool(options.threads)?;
        let recorded = pool.install(|| RecordedRig::open(&spec))?;
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

    /// How many pings there will be, as far as the length of the log tells.
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
                    // Of a sonar that follows another: as often as that one.
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

    /// Pings to the end; `progress` is told every ping made or skipped.
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
                    self.recorded.pulsed(sonar, &order);
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
                counters.error_check(slot.output.error_check.as_ref());
                if let Some(planner) = &self.recorded.rig.sonars[sonar].planner {
                    counters.plan(slot.output.methods.as_ref(), &planner.counts);
                }
                self.recorders.record(slot, &self.recorded.rig)?;
            }
            Err(_gap) => add(&counters.skipped_nav, 1),
        }
        Ok(())
    }

    fn finish(self) -> Result<Summary, ReplayError> {
        let files = self.recorders.finish(self.recorded.rig.targets())?;
        let mut text = String::new();
        let mut pings_made = 0;
        for (unit, counters) in self.recorded.rig.sonars.iter().zip(&self.counters) {
            pings_made += counters.made.load(std::sync::atomic::Ordering::Relaxed);
            text += &format!("{}: {}\n", unit.spec.name, counters.replay_line());
        }
        for file in files {
            text += &format!("wrote {}\n", file.display());
        }
        text.truncate(text.trim_end().len());
        Ok(Summary { pings_made, text })
    }
}
