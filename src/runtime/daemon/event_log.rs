//! Logs of single events in JSON lines: injected faults and signs of overload.

use std::path::PathBuf;
use std::sync::Arc;

use serde::Serialize;

use crate::clock::{Clock, SystemClock};
use crate::control::SonarControl;
use crate::counters::add;
use crate::io::record::RecordError;
use crate::io::record::faults::FaultLog;
use crate::outputs::recording::{Place, Recording, Recordings};
use crate::overload::OverloadRecord;
use crate::score::SKIPPED;

/// A log of events in JSON lines. The file is created with the first event.
pub(super) struct EventLog {
    stem: &'static str,
    recording: Option<Recording<FaultLog>>,
}

impl EventLog {
    pub(super) fn new(
        stem: &'static str,
        directory: Option<PathBuf>,
        recordings: &Arc<Recordings>,
    ) -> Self {
        let recording = directory.map(|directory| {
            let place = Place {
                directory,
                name: stem.to_owned(),
                extension: "jsonl",
                time: Arc::new(|| SystemClock::new().host_utc()),
            };
            let begin = |path: &std::path::Path, _| FaultLog::create(path);
            Recording::later(place, Box::new(begin), Arc::clone(recordings))
        });
        Self { stem, recording }
    }

    /// Appends new events. A failure is logged once and counted as a stopped recording.
    pub(super) fn write<T: Serialize>(&mut self, events: &[T], sonars: &[SonarControl]) {
        for event in events {
            tracing::debug!(log = self.stem, event = %AsJson(event), "ping event");
        }
        if events.is_empty() {
            return;
        }
        if let Err(error) = self.append(events) {
            tracing::error!(log = self.stem, %error, "event log stopped");
            if let Some(first) = sonars.first() {
                add(&first.counters.recordings_stopped, 1);
            }
        }
    }

    fn append<T: Serialize>(&mut self, events: &[T]) -> Result<(), RecordError> {
        if let Some(recording) = &mut self.recording {
            recording.write(|log| log.write(events))?;
        }
        Ok(())
    }
}

/// Line of the fault log about a ping that was skipped.
#[derive(Serialize)]
pub(super) struct SkippedPing<'a> {
    kind: &'static str,
    sonar: &'a str,
    ping_number: u32,
    utc_ns: i64,
}

impl<'a> SkippedPing<'a> {
    /// None of other signs of overload.
    pub(super) fn of(overloaded: &'a OverloadRecord) -> Option<Self> {
        (overloaded.what == SKIPPED).then_some(Self {
            kind: SKIPPED,
            sonar: &overloaded.sonar,
            ping_number: overloaded.ping_number,
            utc_ns: overloaded.utc_ns,
        })
    }
}

/// Display adapter that prints a value as JSON.
struct AsJson<'a, T>(&'a T);

impl<T: Serialize> std::fmt::Display for AsJson<'_, T> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let text = serde_json::to_string(self.0).map_err(|_| std::fmt::Error)?;
        f.write_str(&text)
    }
}
