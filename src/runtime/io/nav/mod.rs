//! Navigation inputs: recorded logs, CSV tracks, UDP, TCP and serial ports, into a [`NavHistory`].
//!
//! Recorded sources are read whole when opened and merged by arrival; live ones are read by one blocking thread each, and decoded by whoever
//! pulls. A rig may have both. [`output`] sends navigation out.
mod live;
pub mod output;
mod recorded;

use std::net::SocketAddr;
use std::sync::Arc;

use thiserror::Error;

use crate::clock::Clock;
use echotank_config::spec::NavSpec;
use echotank_core::flow::NavSample;
use echotank_core::time::{Timeline, UtcNs};
use echotank_nav::health::State;
use echotank_nav::log::LogCounts;
use echotank_nav::spoil::Spoil;
use echotank_nav::track::TrackError;
use echotank_nav::{NavCounters, NavHistory};

use live::Live;
use recorded::Recorded;

/// Why the navigation cannot start.
#[derive(Debug, Error)]
pub enum NavOpenError {
    #[error("nav source `{name}`: cannot read {path}: {reason}")]
    Read {
        name: String,
        path: String,
        reason: String,
    },
    #[error("nav source `{name}`: {path} has {bytes} bytes; at most {limit} are read")]
    TooLarge {
        name: String,
        path: String,
        bytes: u64,
        limit: u64,
    },
    #[error("nav source `{name}`: {reason}")]
    Track { name: String, reason: TrackError },
    #[error(
        "nav source `{name}`: nothing usable in {path}: {} sentences, of which {} with a wrong checksum, {} without one, {} refused for it, \
         {} of unknown kinds, {} malformed, {} empty, {} that give nothing of what the source provides; {json} lines of JSON, which is not read",
        .counters.sentences, .counters.bad_checksum, .counters.missing_checksum, .counters.refused_checksum,
        .counters.unsupported, .counters.malformed, .counters.empty_fields, .counters.not_taken
    )]
    NothingUsable {
        name: String,
        path: String,
        counters: Box<NavCounters>,
        json: u64,
    },
    #[error("nav source `{name}`: {path} {why}")]
    NoLog {
        name: String,
        path: String,
        why: &'static str,
    },
    #[error(
        "nav: the recorded sources have no time in common to repeat (`loop`): the last channel starts when the first has ended"
    )]
    NothingToLoop,
    #[error("nav source `{name}`: cannot listen on udp {listen}: {reason}")]
    Udp {
        name: String,
        listen: SocketAddr,
        reason: String,
    },
    #[error("nav source `{name}`: cannot listen on tcp {listen}: {reason}")]
    Tcp {
        name: String,
        listen: SocketAddr,
        reason: String,
    },
    #[error("nav source `{name}`: cannot open serial port {port} at {baud} baud: {reason}")]
    Serial {
        name: String,
        port: String,
        baud: u32,
        reason: String,
    },
    #[error("nav source `{name}`: cannot start its thread: {reason}")]
    Thread { name: String, reason: String },
}

/// Everything counted about one source.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct SourceCounters {
    pub name: String,
    pub decoder: NavCounters,
    pub log: LogCounts,
    pub live: LiveCounters,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LiveCounters {
    /// Datagrams, or reads of a serial port.
    pub received: u64,
    /// Of those: dropped, the queue to the decoder was full.
    pub dropped_full: u64,
    pub read_errors: u64,
    /// A serial port that had vanished was found again, or a TCP connection made.
    pub reopened: u64,
}

pub struct NavInputs {
    recorded: Option<Recorded>,
    live: Option<Live>,
    /// One per configured source, in the file's order.
    counters: Vec<SourceCounters>,
    /// How each source did when it was last pulled, in the file's order.
    states: Vec<State>,
    spoiler: Option<Box<dyn Spoil>>,
}

/// The way into a history, on which samples may go wrong.
pub struct Feed<'a> {
    history: &'a mut NavHistory,
    spoiler: Option<&'a mut (dyn Spoil + 'static)>,
}

impl Feed<'_> {
    fn insert(&mut self, sample: &NavSample) {
        match &mut self.spoiler {
            None => self.history.insert(sample),
            Some(spoiler) => {
                // What was held back comes in its turn.
                while let Some(late) = spoiler.held_back(sample.arrival_utc) {
                    self.history.insert(&late);
                }
                if let Some(sample) = spoiler.sample(*sample) {
                    self.history.insert(&sample);
                }
            }
        }
    }

    fn seam(&mut self, at: UtcNs) {
        self.history.seam(at);
    }

    /// What was held back has come by `until`.
    fn release(&mut self, until: UtcNs) {
        while let Some(late) = self.spoiler.as_mut().and_then(|s| s.held_back(until)) {
            self.history.insert(&late);
        }
    }
}

impl NavInputs {
    /// Every sample passes `spoiler` from now on.
    pub fn spoil_with(&mut self, spoiler: Box<dyn Spoil>) {
        self.spoiler = Some(spoiler);
    }

    /// Opens every source. Recorded files are read and decoded here; the threads of live sources run from here on until the value is dropped.
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

    /// Arrival of the last recorded sample, of the first loop where they are repeated.
    pub(crate) fn recorded_end(&self) -> Option<UtcNs> {
        self.recorded.as_ref().map(Recorded::end)
    }

    /// Inserts everything recorded that had arrived by `until`, and everything received live.
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
        // Before rig time is known nobody can say how old anything is.
        if until != UtcNs(i64::MAX) {
            for (i, state) in self.states.iter_mut().enumerate() {
                *state = history.source_state(i, until);
            }
        }
    }

    /// How each source did when it was last pulled, in the file's order.
    pub fn states(&self) -> &[State] {
        &self.states
    }

    /// Inserts one more recorded sample; false when there is none.
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

    /// Every recorded sample has come, at least once.
    pub(crate) fn is_all_known(&self) -> bool {
        self.recorded
            .as_ref()
            .is_none_or(|r| r.next_arrival().is_none_or(|next| next > r.end()))
    }

    /// No sample will come any more.
    pub fn finished(&self) -> bool {
        let recorded_ended = self
            .recorded
            .as_ref()
            .is_none_or(|r| r.next_arrival().is_none());
        self.live.is_none() && recorded_ended
    }

    /// Rig time of live sources, once known: that of the first dated message where it is more than two seconds off the host's clock, else
    /// the host's. With recorded sources beside them it is whatever [`NavInputs::set_timeline`] says. None without live sources.
    pub fn timeline(&self) -> Option<Timeline> {
        self.live.as_ref().and_then(Live::timeline)
    }

    /// Gives live sources their rig time, if they have none yet; what they received before is kept and decoded with it.
    pub fn set_timeline(&mut self, timeline: Timeline) {
        if let Some(live) = &mut self.live {
            live.set_timeline(timeline);
        }
    }

    /// Bound addresses of the UDP sources and TCP servers, by name (a configured port of 0 is any free one).
    pub fn listening(&self) -> Vec<(String, SocketAddr)> {
        self.live.as_ref().map_or(Vec::new(), Live::listening)
    }

    /// Name, state and counters of every source.
    pub fn sources(&mut self) -> Vec<(State, SourceCounters)> {
        let states = self.states.clone();
        states
            .into_iter()
            .zip(self.counters().iter().cloned())
            .collect()
    }

    /// A line per source.
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

    /// One entry per configured source, in the file's order.
    pub fn counters(&mut self) -> &[SourceCounters] {
        if let Some(live) = &self.live {
            live.count(&mut self.counters);
        }
        &self.counters
    }
}
