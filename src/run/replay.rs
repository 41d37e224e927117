//! The same pipeline offline: recorded navigation in, files out, the same bytes every time and for any number of threads.

use std::fmt;
use std::path::PathBuf;
use std::sync::Arc;

use thiserror::Error;

use crate::config::spec::{NavChannel, RigSpec};
use crate::flow::SonarSettings;
use crate::io::nav::NavInputs;
use crate::io::record::RecordError;
use crate::ping::{PingOrder, Schedule};
use crate::run::counters::{PingCounters, add};
use crate::run::recorders::Recorders;
use crate::run::rig::{PingSlot, Rig, RigError, pool};
use crate::time::{NS_PER_S, UtcNs, VirtualClock};

#[derive(Debug, Error)]
pub enum ReplayError {
    #[error(transparent)]
    Rig(#[from] RigError),
    #[error(transparent)]
    Record(#[from] RecordError),
    #[error("threads: {0}")]
    Threads(#[from] rayon::ThreadPoolBuildError),
    #[error(
        "there is nothing to replay: the configuration has no recorded navigation (a source of kind \"log\" or \"csv\")"
    )]
    NoLog,
    #[error("the recorded navigation holds no usable sample of {0:?}, which every ping needs")]
    NoNav(Vec<NavChannel>),
}

#[derive(Clone, Copy, Debug, Default)]
pub struct Formats {
    pub s7k: bool,
    pub npz: bool,
    pub png: bool,
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
    rig: Rig,
    inputs: NavInputs,
    recorders: Recorders,
    schedules: Vec<Schedule>,
    pings: (u32, u32),
    recorded_end: Option<UtcNs>,
    counters: Vec<PingCounters>,
}

/// What a replay did.
pub struct Summary {
    pub pings_made: u64,
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
        let pool = pool(options.threads)?;
        let mut rig = pool.install(|| Rig::open(&spec))?;
        let mut inputs =
            NavInputs::open(&spec.nav, Arc::new(VirtualClock::default())).map_err(RigError::Nav)?;
        if inputs.recorded_start().is_none() {
            return Err(ReplayError::NoLog);
        }
        let first = loop {
            if let Some(first) = rig.history.first_usable_utc() {
                break first;
            }
            if !inputs.pull_next(&mut rig.history) {
                return Err(ReplayError::NoNav(rig.history.silent()));
            }
        };
        let sound_speed_m_per_s = rig.medium().sound_speed_m_per_s;
        let schedules = vec![Schedule::starting_at(first, sound_speed_m_per_s); rig.sonars.len()];
        let recorders = Recorders::create(&spec, &options, &rig)?;
        Ok(Self {
            pool: Arc::new(pool),
            recorded_end: inputs.recorded_end(),
            counters: rig.sonars.iter().map(|_| PingCounters::default()).collect(),
            rig,
            inputs,
            recorders,
            schedules,
            pings: options.pings.unwrap_or((1, u32::MAX)),
        })
    }

    /// How many pings there will be, as far as the length of the log tells.
    pub fn pings_expected(&self) -> Option<u64> {
        let (first, last) = self.pings;
        if last < u32::MAX {
            return Some(u64::from(last - first + 1) * self.schedules.len() as u64);
        }
        let end = self.recorded_end?;
        let c = self.rig.medium().sound_speed_m_per_s;
        Some(
            self.rig
                .sonars
                .iter()
                .zip(&self.schedules)
                .map(|(unit, schedule)| {
                    let period_s =
                        crate::ping::period_ns(&unit.spec.settings, c) as f64 / NS_PER_S as f64;
                    (end.seconds_since(schedule.next_utc()) / period_s).max(0.0) as u64
                })
                .sum(),
        )
    }

    /// Pings to the end; `progress` is told every ping made or skipped.
    pub fn run(mut self, mut progress: impl FnMut(u32) + Send) -> Result<Summary, ReplayError> {
        let pool = self.pool.clone();
        pool.install(move || {
            let mut slots: Vec<PingSlot> = (0..self.rig.sonars.len())
                .map(|sonar| self.rig.slot(sonar))
                .collect();
            while let Some((sonar, order)) = self.next_order() {
                if order.ping_number < self.pings.0 {
                    continue;
                }
                if !self.rig.read_on(&mut self.inputs, sonar, &order) {
                    break;
                }
                self.ping(sonar, &order, &mut slots[sonar])?;
                progress(order.ping_number);
            }
            self.finish()
        })
    }

    /// The next ping in time over all sonars, or none when every one has made its last.
    fn next_order(&mut self) -> Option<(usize, PingOrder)> {
        let last = self.pings.1;
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

    fn ping(
        &mut self,
        sonar: usize,
        order: &PingOrder,
        slot: &mut PingSlot,
    ) -> Result<(), ReplayError> {
        let counters = &self.counters[sonar];
        let mode = self.rig.spec.nav.mode;
        match self.rig.make(sonar, order, mode, order.transmit_utc, slot) {
            Ok(()) => {
                let saturated = slot
                    .output
                    .elements
                    .iter()
                    .map(|frame| frame.saturated)
                    .sum();
                counters.ping(&slot.output.counts, saturated, 0);
                counters.scene(&slot.output.scene);
                counters.certificate(slot.output.certificate.as_ref());
                self.recorders.record(slot, self.rig.targets())?;
            }
            Err(_gap) => add(&counters.skipped_nav, 1),
        }
        Ok(())
    }

    fn finish(self) -> Result<Summary, ReplayError> {
        let files = self.recorders.finish()?;
        let mut text = String::new();
        let mut pings_made = 0;
        for (unit, counters) in self.rig.sonars.iter().zip(&self.counters) {
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
