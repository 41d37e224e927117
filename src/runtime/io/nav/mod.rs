//! Navigation inputs: recorded logs, CSV tracks, UDP, TCP and serial ports, decoded into a [`NavHistory`].
//!
//! Recorded sources are read completely when opened and merged by arrival time. Each live source has a blocking thread; [`NavInputs::pull`] decodes
//! its bytes. A rig may have both. [`output`] sends navigation.
mod live;
pub mod output;
mod recorded;

use std::net::SocketAddr;
use std::sync::Arc;

use thiserror::Error;

use crate::clock::Clock;
use echotank_config::spec::NavSpec;
use echotank_core::navigation::NavSample;
use echotank_core::time::{Timeline, UtcNs};
use echotank_nav::fault::NavFaultFilter;
use echotank_nav::health::State;
use echotank_nav::log::LogCounts;
use echotank_nav::{NavCounters, NavHistory};

use live::Live;
use recorded::Recorded;

/// Why the navigation cannot start.
#[derive(Debug, Error)]
pub enum NavOpenError {
    /// The file, socket, port or thread of a source is not available, or its file cannot be used.
    #[error("nav source `{name}`: {problem}")]
    Source {
        /// The source's configured name.
        name: String,
        /// What is not available, and why.
        problem: String,
    },
    /// A file was read and holds nothing that the source provides.
    #[error(
        "nav source `{name}`: nothing usable in {path}: {} sentences, of which {} with a wrong checksum, {} without one, {} refused for it, \
         {} of unknown kinds, {} malformed, {} empty, {} that give nothing of what the source provides; {json} lines of JSON, which is not read",
        .counters.sentences, .counters.bad_checksum, .counters.missing_checksum, .counters.refused_checksum,
        .counters.unsupported, .counters.malformed, .counters.empty_fields, .counters.not_taken
    )]
    NothingUsable {
        /// The source's configured name.
        name: String,
        /// The file.
        path: String,
        /// What its decoder counted.
        counters: Box<NavCounters>,
        /// Lines of JSON.
        json: u64,
    },
    /// `loop` is set and no period is covered by every channel.
    #[error(
        "nav: the recorded sources have no time in common to repeat (`loop`): the last channel starts when the first has ended"
    )]
    NothingToLoop,
}

impl NavOpenError {
    fn source(name: &str, problem: String) -> Self {
        Self::Source {
            name: name.to_owned(),
            problem,
        }
    }
}

/// Counters of one source.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct SourceCounters {
    /// Name of the source.
    pub name: String,
    /// Counters of its decoder.
    pub decoder: NavCounters,
    /// Counts of a recorded log.
    pub log: LogCounts,
    /// Counters of a live source.
    pub live: LiveCounters,
}

/// Counters of a live source's thread.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LiveCounters {
    /// Datagrams or reads.
    pub received: u64,
    /// Datagrams or reads dropped because the queue was full.
    pub dropped_full: u64,
    /// Failed reads.
    pub read_errors: u64,
    /// Serial ports reopened or TCP connections made.
    pub reopened: u64,
}

/// The navigation inputs of a rig.
pub struct NavInputs {
    recorded: Option<Recorded>,
    live: Option<Live>,
    /// One per configured source, in the configuration's order.
    counters: Vec<SourceCounters>,
    /// State of each source at the last pull, in the configuration's order.
    states: Vec<State>,
    spoiler: Option<Box<dyn NavFaultFilter>>,
}

/// Inserts samples into a history and applies navigation faults.
pub struct Feed<'a> {
    history: &'a mut NavHistory,
    spoiler: Option<&'a mut (dyn NavFaultFilter + 'static)>,
}

impl Feed<'_> {
    fn insert(&mut self, sample: &NavSample) {
        match &mut self.spoiler {
            None => self.history.insert(sample),
            Some(spoiler) => {
                // Delayed samples are inserted in order.
                while let Some(late) = spoiler.take_delayed(sample.arrival_utc) {
                    self.history.insert(&late);
                }
                if let Some(sample) = spoiler.modify_sample(*sample) {
                    self.history.insert(&sample);
                }
            }
        }
    }

    fn seam(&mut self, at: UtcNs) {
        self.history.seam(at);
    }

    /// Inserts delayed samples that are due by `until`.
    fn release(&mut self, until: UtcNs) {
        while let Some(late) = self.spoiler.as_mut().and_then(|s| s.take_delayed(until)) {
            self.history.insert(&late);
        }
    }
}

impl NavInputs {
    /// Applies `spoiler` to all further samples.
    pub fn spoil_with(&mut self, spoiler: Box<dyn NavFaultFilter>) {
        self.spoiler = Some(spoiler);
    }

    /// Opens every source: reads and decodes recorded files, and starts the threads of live sources, which run until the value is dropped.
    pub fn open(spec: &NavSpec, clock: Arc<dyn Clock>) -> Result<Self, NavOpenError> {
        let mut counters: Vec<SourceCounters> = spec
            .sources
            .iter()
            .map(|s| SourceCounters {
                name: s.name.clone(),
                ..Default::default()
            })
            .collect();
        let recorded = Recorded::open(spec, &mut counters)?;
        let has_live = !spec.is_recorded();
        let live = if has_live {
            Some(Live::open(spec, clock, recorded.is_some())?)
        } else {
            None
        };
        Ok(Self {
            recorded,
            live,
            states: vec![State::Silent; counters.len()],
            spoiler: None,
            counters,
        })
    }

    /// Arrival of the first recorded sample.
    pub fn recorded_start(&self) -> Option<UtcNs> {
        self.recorded.as_ref().map(Recorded::start)
    }

    /// Arrival of the last recorded sample, in the first loop of a repeated log.
    pub(crate) fn recorded_end(&self) -> Option<UtcNs> {
        self.recorded.as_ref().map(Recorded::end)
    }

    /// Inserts recorded samples that arrived by `until`, and all live ones received.
    pub fn pull(&mut self, until: UtcNs, history: &mut NavHistory) {
        let mut feed = Feed {
            history,
            spoiler: self.spoiler.as_deref_mut(),
        };
        if let Some(recorded) = &mut self.recorded {
            while recorded
                .next_arrival()
                .is_some_and(|arrival| arrival <= until)
            {
                recorded.take(&mut feed);
            }
        }
        if let Some(live) = &mut self.live {
            live.pull(&mut feed);
        }
        feed.release(until);
        // Before rig time is known, no age is defined.
        if until != UtcNs(i64::MAX) {
            for (i, state) in self.states.iter_mut().enumerate() {
                *state = history.source_state(i, until);
            }
        }
    }

    /// State of each source at the last pull, in the configuration's order.
    pub fn states(&self) -> &[State] {
        &self.states
    }

    /// Inserts one more recorded sample; false when none is left.
    pub fn pull_next(&mut self, history: &mut NavHistory) -> bool {
        match &mut self.recorded {
            Some(recorded) if recorded.next_arrival().is_some() => {
                recorded.take(&mut Feed {
                    history,
                    spoiler: self.spoiler.as_deref_mut(),
                });
                true
            }
            _ => false,
        }
    }

    /// Whether every recorded sample has been inserted at least once.
    pub(crate) fn is_all_known(&self) -> bool {
        self.recorded
            .as_ref()
            .is_none_or(|r| r.next_arrival().is_none_or(|next| next > r.end()))
    }

    /// Whether no further sample will come.
    pub fn finished(&self) -> bool {
        let recorded_ended = self
            .recorded
            .as_ref()
            .is_none_or(|r| r.next_arrival().is_none());
        self.live.is_none() && recorded_ended
    }

    /// Rig time of live sources, once known: that of the first dated message if it differs from the host's clock by more than 2 s, otherwise the host's.
    /// With recorded sources, [`NavInputs::set_timeline`] sets it. `None` without live sources.
    pub fn timeline(&self) -> Option<Timeline> {
        self.live.as_ref().and_then(Live::timeline)
    }

    /// Sets the rig time of live sources that have none; bytes received before are decoded with it.
    pub fn set_timeline(&mut self, timeline: Timeline) {
        if let Some(live) = &mut self.live {
            live.set_timeline(timeline);
        }
    }

    /// Bound addresses of UDP sources and TCP servers, by source name.
    pub fn listening(&self) -> Vec<(String, SocketAddr)> {
        self.live.as_ref().map_or(Vec::new(), Live::listening)
    }

    /// State and counters of every source.
    pub fn sources(&mut self) -> Vec<(State, SourceCounters)> {
        let states = self.states.clone();
        states
            .into_iter()
            .zip(self.counters().iter().cloned())
            .collect()
    }

    /// A status line per source.
    pub fn lines(&mut self) -> Vec<String> {
        let states = self.states.clone();
        let line = |(s, state): (&SourceCounters, &State)| {
            let d = &s.decoder;
            let mut text = format!(
                "nav {}: {}, {} sentences, {} used, {} bad checksums, {} malformed, {} unsupported, {} time jumps, {} samples",
                s.name,
                state.name(),
                d.sentences,
                d.used,
                d.bad_checksum,
                d.malformed,
                d.unsupported,
                d.time_jumps,
                d.samples
            );
            let l = &s.live;
            if *l != LiveCounters::default() {
                text += &format!(
                    ", {} received, {} dropped, {} read errors, {} reopened",
                    l.received, l.dropped_full, l.read_errors, l.reopened
                );
            }
            text
        };
        self.counters().iter().zip(&states).map(line).collect()
    }

    /// One entry per configured source, in the configuration's order.
    pub fn counters(&mut self) -> &[SourceCounters] {
        if let Some(live) = &self.live {
            live.count(&mut self.counters);
        }
        &self.counters
    }
}
