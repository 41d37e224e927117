//! Recorded live sources: the bytes of a recording in place of sockets and ports, up to each ping of the recorded run.

use std::path::Path;

use super::source_decoder::SourceDecoder;
use super::{Feed, MAX_LOG_BYTES, NavOpenError, SourceCounters};
use crate::config_files::read_bounded;
use echotank_config::spec::NavSpec;
use echotank_nav::recording::{Entry, NavRecording, RecordedPing, RecordedStart};

/// Entry at which a replay stops to act.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Mark {
    Start(RecordedStart),
    Ping(RecordedPing),
    Skipped(RecordedPing),
}

impl Mark {
    fn of(entry: &Entry) -> Option<Self> {
        match entry {
            Entry::Bytes { .. } => None,
            Entry::Start(start) => Some(Self::Start(*start)),
            Entry::Ping(ping) => Some(Self::Ping(*ping)),
            Entry::Skipped(ping) => Some(Self::Skipped(*ping)),
        }
    }

    pub(super) fn known_utc(&self) -> echotank_core::time::UtcNs {
        match self {
            Self::Start(start) => start.known_utc,
            Self::Ping(ping) | Self::Skipped(ping) => ping.known_utc,
        }
    }
}

pub(super) struct Played {
    /// By source of the recording; `None` for a source that the rig lacks.
    decoders: Vec<Option<SourceDecoder>>,
    entries: Vec<Entry>,
    next: usize,
}

impl Played {
    /// Reads a recording. Each live source of `spec` must be one of its sources. Returns a warning for each source that the rig lacks.
    pub(super) fn open(path: &Path, spec: &NavSpec) -> Result<(Self, Vec<String>), NavOpenError> {
        let problem = |why: String| NavOpenError::Recording(format!("{}: {why}", path.display()));
        let bytes = read_bounded(path, MAX_LOG_BYTES).map_err(problem)?;
        let recording = NavRecording::read(&bytes).map_err(|error| problem(error.to_string()))?;
        let mut decoders: Vec<_> = recording.sources.iter().map(|_| None).collect();
        for (index, source) in spec.sources.iter().enumerate() {
            if source.is_recorded() {
                continue;
            }
            let mut names = recording.sources.iter();
            let Some(at) = names.position(|name| *name == source.name) else {
                return Err(problem(format!(
                    "holds no source named `{}`; it was recorded with {}: replay it with the rig that recorded it",
                    source.name,
                    recording.sources.join(", ")
                )));
            };
            decoders[at] = Some(SourceDecoder::new(index, source));
        }
        let unused = recording.sources.iter().zip(&decoders);
        let warnings = unused
            .filter(|(_, decoder)| decoder.is_none())
            .map(|(name, _)| {
                format!("the recorded source {name} is not used: the rig has no live source of this name")
            })
            .collect();
        let played = Self {
            decoders,
            entries: recording.entries,
            next: 0,
        };
        Ok((played, warnings))
    }

    /// The pings of the recorded run.
    pub(super) fn pings(&self) -> impl Iterator<Item = &RecordedPing> {
        self.entries.iter().filter_map(|entry| match entry {
            Entry::Ping(ping) => Some(ping),
            _ => None,
        })
    }

    /// The next mark; `None` after the last.
    pub(super) fn next_mark(&self) -> Option<Mark> {
        self.entries[self.next..].iter().find_map(Mark::of)
    }

    /// Decodes the bytes before the next mark, and passes the mark.
    pub(super) fn pass_mark(&mut self, feed: &mut Feed) {
        while let Some(entry) = self.entries.get_mut(self.next) {
            self.next += 1;
            let Entry::Bytes {
                source,
                arrival,
                bytes,
            } = entry
            else {
                return;
            };
            if let Some(Some(decoder)) = self.decoders.get_mut(*source) {
                // Entries are used once.
                decoder.feed(&mut std::mem::take(bytes), *arrival, feed);
            }
        }
    }

    pub(super) fn count(&self, counters: &mut [SourceCounters]) {
        for decoder in self.decoders.iter().flatten() {
            counters[decoder.index].decoder = *decoder.decoder.counters();
        }
    }
}
