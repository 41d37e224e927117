//! Navigation inputs: recorded logs, CSV tracks, UDP, TCP and serial ports, decoded into a [`NavHistory`].
//!
//! Recorded sources are read completely when opened and merged by arrival time. Each live source has a blocking thread; [`NavInputs::pull`]
//! decodes its bytes. A rig can have both kinds. A recording of live sources takes their place in a replay. [`output`] sends navigation.
mod live;
pub mod output;
mod played;
mod recorded;
mod recorder;
mod source_decoder;

use std::net::SocketAddr;
use std::path::Path;
use std::sync::Arc;

use thiserror::Error;
use tracing::{info, warn};

use crate::clock::Clock;
use crate::io::record::RecordError;
use crate::outputs::recording::Recordings;
use echotank_config::spec::NavSpec;
use echotank_core::navigation::NavSample;
use echotank_core::time::{Timeline, UtcNs};
use echotank_nav::decoder::ClockState;
use echotank_nav::detection::MissingQuantity;
use echotank_nav::fault::NavFaultFilter;
use echotank_nav::health::State;
use echotank_nav::log::LogCounts;
use echotank_nav::recording::{Entry, RecordedPing, RecordedStart};
use echotank_nav::{NavCounters, NavHistory};
use echotank_ping::PingOrder;

use live::Live;
pub(crate) use played::Mark;
use played::Played;
pub use recorded::MAX_LOG_BYTES;
use recorded::Recorded;
use recorder::NavRecorder;

/// Errors of opening the navigation.
#[derive(Debug, Error)]
pub enum NavOpenError {
    /// The file, socket, port or thread of a source is not available, or its file cannot be used.
    #[error("nav source `{name}`: {problem}")]
    Source {
        /// The source's configured name.
        name: String,
        /// Missing resource and the reason.
        problem: String,
    },
    /// The format of a file is not supported.
    #[error("nav source `{name}`: {problem}")]
    Unreadable {
        /// The source's configured name.
        name: String,
        /// The file and its format.
        problem: String,
    },
    /// The recording of live sources cannot take their place.
    #[error("--nav {0}")]
    Recording(String),
    /// A file contains nothing that the source provides.
    #[error("nav source `{name}`: nothing usable in {path}: {}", unusable(.counters, *.json))]
    NothingUsable {
        /// The source's configured name.
        name: String,
        /// The file.
        path: String,
        /// Counters of the decoder.
        counters: Box<NavCounters>,
        /// Lines of JSON.
        json: u64,
    },
    /// The logs lack a quantity that every ping needs.
    #[error(transparent)]
    Missing(#[from] MissingQuantity),
    /// `loop` is set, but no period is covered by all channels.
    #[error(
        "nav: the recorded sources have no time in common to repeat (`loop`): the last channel starts when the first has ended"
    )]
    NothingToLoop,
}

/// Why a file contains nothing usable, with the remedy where there is one.
fn unusable(counters: &NavCounters, json: u64) -> String {
    let is_refused = counters.refused_checksum > 0;
    let refused = |count| if is_refused { count } else { 0 };
    let counts = [
        (refused(counters.bad_checksum), "with a wrong checksum"),
        (refused(counters.missing_checksum), "without a checksum"),
        (counters.unsupported, "of unknown types"),
        (counters.malformed, "malformed"),
        (counters.empty_fields, "empty"),
        (
            counters.not_taken,
            "without a quantity that the source provides",
        ),
        (counters.time_jumps, "with a jump of their time"),
    ];
    let counts = counts.iter().filter(|(count, _)| *count > 0);
    let counts: Vec<_> = counts
        .map(|(count, what)| format!("{count} {what}"))
        .collect();
    let mut text = match counters.sentences {
        0 => "it holds no sentence".to_owned(),
        sentences => format!("{sentences} sentences: {}", counts.join(", ")),
    };
    if json > 0 {
        text += &format!("; {json} lines of JSON, which is not read");
    }
    let remedy = if is_refused {
        "checksum = \"ignore\" in its [[nav.source]] accepts them"
    } else if counters.not_taken > 0 {
        "leave out `provides` to use what the log holds"
    } else {
        "`echotank nav FILE` shows what a file holds"
    };
    format!("{text}; {remedy}")
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
    /// Datagrams dropped because their source sent too much.
    pub dropped_flood: u64,
    /// Failed reads.
    pub read_errors: u64,
    /// Serial ports reopened or TCP connections made.
    pub reopened: u64,
}

/// The recorded sources of a rig, read and decoded.
pub struct ReadNav {
    /// The navigation as configured. A `provides` that the configuration leaves open is filled with the quantities found in the logs.
    pub spec: NavSpec,
    /// Missing, ignored or replaced parts of the navigation, one line each.
    pub warnings: Vec<String>,
    recorded: Option<Recorded>,
    played: Option<Played>,
    counters: Vec<SourceCounters>,
}

impl ReadNav {
    /// Reads and decodes all recorded files.
    ///
    /// # Errors
    /// A file cannot be read or used, or the files lack a quantity that every ping needs.
    pub fn read(spec: &NavSpec) -> Result<Self, NavOpenError> {
        let mut counters: Vec<SourceCounters> = spec
            .sources
            .iter()
            .map(|s| SourceCounters {
                name: s.name.clone(),
                ..Default::default()
            })
            .collect();
        let mut spec = spec.clone();
        let (recorded, mut warnings) = Recorded::open(&mut spec, &mut counters)?;
        let played = match &spec.recording {
            Some(path) => {
                let (played, unused) = Played::open(path, &spec)?;
                warnings.extend(unused);
                Some(played)
            }
            None => None,
        };
        Ok(Self {
            spec,
            warnings,
            recorded,
            played,
            counters,
        })
    }

    /// Whether a recording takes the place of the live sources.
    pub(crate) fn is_played(&self) -> bool {
        self.played.is_some()
    }

    /// Whether any source is a file.
    pub fn has_recorded(&self) -> bool {
        self.recorded.is_some()
    }
}

/// The navigation inputs of a rig.
pub struct NavInputs {
    recorded: Option<Recorded>,
    live: Option<Live>,
    /// Recording in place of `live`.
    played: Option<Played>,
    recorder: Option<NavRecorder>,
    /// Argument of the last pull.
    known_utc: UtcNs,
    /// One entry per configured source, in the configuration's order.
    counters: Vec<SourceCounters>,
    /// State of each source at the last pull, in the configuration's order.
    states: Vec<State>,
    fault_filter: Option<Box<dyn NavFaultFilter>>,
    clock_log: ClockLog,
}

/// Inserts samples into a history and applies navigation faults.
pub struct Feed<'a> {
    history: &'a mut NavHistory,
    /// Names of the sources, by source index.
    names: &'a [SourceCounters],
    clock_log: &'a mut ClockLog,
    fault_filter: Option<&'a mut (dyn NavFaultFilter + 'static)>,
}

/// Logs changes of the clocks of sources.
#[derive(Default)]
struct ClockLog {
    /// Time of the last entry, and changes since that had none.
    last: Option<(UtcNs, u64)>,
}

impl ClockLog {
    /// Minimum interval between entries, s: a clock that changes with every sentence must not fill the log.
    const MIN_INTERVAL_S: f64 = 0.5;

    fn note(&mut self, source: &str, at: UtcNs, state: ClockState) {
        let unlogged = match &mut self.last {
            Some((last, unlogged))
                if at.seconds_since(*last).abs() < Self::MIN_INTERVAL_S
                    && !matches!(state, ClockState::Corrected { .. }) =>
            {
                *unlogged += 1;
                return;
            }
            last => last.map_or(0, |(_, unlogged)| unlogged),
        };
        self.last = Some((at, 0));
        match state {
            ClockState::Jumping => {
                warn!(
                    source,
                    unlogged, "time jumped: the sentences are set aside until they agree"
                )
            }
            ClockState::Corrected { by_s } => {
                warn!(
                    source,
                    by_s, unlogged, "time jumped: the times are corrected"
                )
            }
            ClockState::Right => info!(source, unlogged, "time jumped back and is right again"),
        }
    }
}

impl Feed<'_> {
    fn insert(&mut self, sample: &NavSample) {
        match &mut self.fault_filter {
            None => self.history.insert(sample),
            Some(fault_filter) => {
                // Delayed samples are inserted in order.
                while let Some(late) = fault_filter.take_delayed(sample.arrival_utc) {
                    self.history.insert(&late);
                }
                if let Some(sample) = fault_filter.modify_sample(*sample) {
                    self.history.insert(&sample);
                }
            }
        }
    }

    fn seam(&mut self, at: UtcNs) {
        self.history.seam(at);
    }

    fn clock_changed(&mut self, source: u16, at: UtcNs, state: ClockState) {
        self.history
            .clock_changed(source, at, state == ClockState::Right);
        let name = self
            .names
            .get(usize::from(source))
            .map_or("", |s| s.name.as_str());
        self.clock_log.note(name, at, state);
    }

    /// Inserts delayed samples that are due by `until`.
    fn release(&mut self, until: UtcNs) {
        while let Some(late) = self
            .fault_filter
            .as_mut()
            .and_then(|s| s.take_delayed(until))
        {
            self.history.insert(&late);
        }
    }
}

impl NavInputs {
    /// Applies the fault filter `fault_filter` to all further samples.
    pub fn set_fault_filter(&mut self, fault_filter: Box<dyn NavFaultFilter>) {
        self.fault_filter = Some(fault_filter);
    }

    /// Opens every source: [`ReadNav::read`] followed by [`NavInputs::start`].
    ///
    /// # Errors
    /// A file, socket, port or thread is not available, or the recorded files cannot be used.
    pub fn open(spec: &NavSpec, clock: Arc<dyn Clock>) -> Result<Self, NavOpenError> {
        Self::start(ReadNav::read(spec)?, clock)
    }

    /// Starts the threads of the live sources, which run until the value is dropped.
    ///
    /// # Errors
    /// A socket, port or thread of a live source is not available.
    pub fn start(read: ReadNav, clock: Arc<dyn Clock>) -> Result<Self, NavOpenError> {
        let ReadNav {
            spec,
            recorded,
            played,
            counters,
            ..
        } = read;
        let live = match spec.is_recorded() || played.is_some() {
            true => None,
            false => Some(Live::open(&spec, clock, recorded.is_some())?),
        };
        Ok(Self {
            recorded,
            live,
            played,
            recorder: None,
            known_utc: UtcNs(i64::MIN),
            states: vec![State::Silent; counters.len()],
            fault_filter: None,
            clock_log: ClockLog::default(),
            counters,
        })
    }

    /// Writes everything that the live sources receive from now on to a new file.
    ///
    /// # Errors
    /// The file exists or cannot be created.
    pub(crate) fn record(
        &mut self,
        path: &Path,
        spec: &NavSpec,
        recordings: Arc<Recordings>,
    ) -> Result<(), RecordError> {
        self.recorder = Some(NavRecorder::create(path, spec, recordings)?);
        Ok(())
    }

    /// Records the instant of the first ping.
    pub(crate) fn note_start(&mut self, first_utc: UtcNs) {
        let known_utc = self.known_utc;
        if let Some(recorder) = &mut self.recorder {
            recorder.note(Entry::Start(RecordedStart {
                first_utc,
                known_utc,
            }));
        }
    }

    /// Records a ping that is about to be computed, at this degradation level.
    pub(crate) fn note_ping(&mut self, sonar: usize, order: &PingOrder, level: usize) {
        self.note_order(sonar, order, level, Entry::Ping);
    }

    /// Records a skipped ping whose motion the method selection is about to see.
    pub(crate) fn note_skipped(&mut self, sonar: usize, order: &PingOrder) {
        self.note_order(sonar, order, 0, Entry::Skipped);
    }

    fn note_order(
        &mut self,
        sonar: usize,
        order: &PingOrder,
        level: usize,
        entry: fn(RecordedPing) -> Entry,
    ) {
        let known_utc = self.known_utc;
        if let Some(recorder) = &mut self.recorder {
            recorder.note(entry(RecordedPing {
                sonar,
                number: order.ping_number,
                transmit_utc: order.transmit_utc,
                period_s: order.period_s,
                settings: order.settings,
                known_utc,
                level,
            }));
        }
    }

    /// The pings of the recording that takes the place of the live sources.
    pub(crate) fn played_pings(&self) -> Option<impl Iterator<Item = &RecordedPing>> {
        self.played.as_ref().map(Played::pings)
    }

    /// Inserts the samples that the recorded run had at its next ping, and returns the ping. `None` after the last.
    pub(crate) fn play(&mut self, history: &mut NavHistory) -> Option<Mark> {
        let played = self.played.as_mut()?;
        let mark = played.next_mark()?;
        let mut feed = Feed {
            history,
            names: &self.counters,
            clock_log: &mut self.clock_log,
            fault_filter: self.fault_filter.as_deref_mut(),
        };
        let known = mark.known_utc();
        if let Some(recorded) = &mut self.recorded {
            recorded.take_until(known, &mut feed);
        }
        played.pass_mark(&mut feed);
        feed.release(known);
        Some(mark)
    }

    /// Arrival of the first recorded sample.
    pub fn recorded_start(&self) -> Option<UtcNs> {
        self.recorded.as_ref().map(Recorded::start)
    }

    /// Arrival of the last recorded sample, in the first loop of a repeated log.
    pub(crate) fn recorded_end(&self) -> Option<UtcNs> {
        self.recorded.as_ref().map(Recorded::end)
    }

    /// Inserts the recorded samples that arrived by `until`, and the received live samples within the time limit of one call.
    pub fn pull(&mut self, until: UtcNs, history: &mut NavHistory) {
        let mut feed = Feed {
            history,
            names: &self.counters,
            clock_log: &mut self.clock_log,
            fault_filter: self.fault_filter.as_deref_mut(),
        };
        self.known_utc = until;
        if let Some(recorded) = &mut self.recorded {
            recorded.take_until(until, &mut feed);
        }
        if let Some(live) = &mut self.live {
            live.pull(&mut feed, self.recorder.as_mut());
        }
        feed.release(until);
        // Before rig time is known, no age is defined.
        if until != UtcNs(i64::MAX) {
            for (i, state) in self.states.iter_mut().enumerate() {
                *state = history.source_state(i, until);
            }
        }
    }

    /// Whether received live samples wait for another [`NavInputs::pull`], which is limited in time.
    pub(crate) fn is_behind(&self) -> bool {
        self.live.as_ref().is_some_and(Live::is_behind)
    }

    /// State of each source at the last pull, in the configuration's order.
    pub fn states(&self) -> &[State] {
        &self.states
    }

    /// Inserts the next recorded sample. Returns false if none is left.
    pub fn pull_next(&mut self, history: &mut NavHistory) -> bool {
        match &mut self.recorded {
            Some(recorded) if recorded.next_arrival().is_some() => {
                recorded.take(&mut Feed {
                    history,
                    names: &self.counters,
                    clock_log: &mut self.clock_log,
                    fault_filter: self.fault_filter.as_deref_mut(),
                });
                true
            }
            _ => false,
        }
    }

    /// End of the long gap in the recorded sources that contains `utc`, with `margin_s` (s) on both sides.
    pub(crate) fn gap_end(&self, utc: UtcNs, margin_s: f64) -> Option<UtcNs> {
        self.recorded
            .as_ref()
            .and_then(|r| r.gap_end(utc, margin_s))
    }

    /// Number of recorded samples, in one loop.
    pub(crate) fn recorded_samples(&self) -> usize {
        self.recorded.as_ref().map_or(0, Recorded::count)
    }

    /// Whether every recorded sample has been inserted at least once.
    pub(crate) fn is_all_known(&self) -> bool {
        self.recorded
            .as_ref()
            .is_none_or(|r| r.next_arrival().is_none_or(|next| next > r.end()))
    }

    /// Whether the sources can give no further sample.
    pub fn finished(&self) -> bool {
        let recorded_ended = self
            .recorded
            .as_ref()
            .is_none_or(|r| r.next_arrival().is_none());
        self.live.is_none() && recorded_ended
    }

    /// Rig time of the live sources, once known. A first dated message that differs from the host's clock by more than 2 s defines rig time;
    /// otherwise the host's clock does. With recorded sources, [`NavInputs::set_timeline`] sets it. `None` without live sources.
    pub fn timeline(&self) -> Option<Timeline> {
        self.live.as_ref().and_then(Live::timeline)
    }

    /// Sets the rig time of live sources that have none. Bytes received earlier are decoded with this rig time.
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

    /// Status text, one line per source.
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
            if d.clock_changes > 0 {
                text += &format!(", time jumped {} times", d.clock_changes);
            }
            if d.corrected_by_s != 0 {
                text += &format!(", times corrected by {:+} s", d.corrected_by_s);
            }
            if s.log.passes.len() > 1 {
                text += &format!(", {} passes", s.log.passes.len());
            }
            let l = &s.live;
            if *l != LiveCounters::default() {
                text += &format!(
                    ", {} received, {} dropped, {} over the limit, {} read errors, {} reopened",
                    l.received, l.dropped_full, l.dropped_flood, l.read_errors, l.reopened
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
        if let Some(played) = &self.played {
            played.count(&mut self.counters);
        }
        &self.counters
    }
}
