//! The logs of single events: injected faults and signs of overload, JSON lines.

use std::path::PathBuf;

use chrono::DateTime;
use serde::Serialize;

use super::DaemonError;
use crate::clock::{Clock, SystemClock};
use crate::control::SonarControl;
use crate::counters::add;
use crate::io::record::faults::FaultLog;
use crate::io::record::{claim_name, make_folder};

/// A log of what befell single pings, JSON lines; begun with the first of them.
pub(super) struct EventLog {
    stem: &'static str,
    directory: Option<PathBuf>,
    log: Option<FaultLog>,
}

impl EventLog {
    pub(super) fn new(stem: &'static str, directory: Option<PathBuf>) -> Self {
        Self {
            stem,
            directory,
            log: None,
        }
    }

    /// Writes what happened since the last time. An error is told once, ends the log, and counts as a recording that stopped.
    pub(super) fn write<T: Serialize>(&mut self, events: &[T], sonars: &[SonarControl]) {
        for event in events {
            tracing::debug!(log = self.stem, event = %AsJson(event), "ping event");
        }
        if events.is_empty() || self.directory.is_none() {
            return;
        }
        if let Err(error) = self.append(events) {
            tracing::error!(log = self.stem, %error, "event log stopped");
            if let Some(first) = sonars.first() {
                add(&first.counters.recordings_stopped, 1);
            }
            (self.directory, self.log) = (None, None);
        }
    }

    fn append<T: Serialize>(&mut self, events: &[T]) -> Result<(), DaemonError> {
        let Some(directory) = &self.directory else {
            return Ok(());
        };
        let log = match &mut self.log {
            Some(log) => log,
            none => {
                make_folder(directory)?;
                let now = DateTime::from_timestamp_nanos(SystemClock::new().host_utc().0);
                let stem = format!("{}-{}", self.stem, now.format("%Y%m%dT%H%M%S"));
                none.insert(FaultLog::create(&claim_name(directory, &stem, "jsonl")?)?)
            }
        };
        Ok(log.write(events)?)
    }
}

/// Writes a value as JSON.
struct AsJson<'a, T>(&'a T);

impl<T: Serialize> std::fmt::Display for AsJson<'_, T> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let text = serde_json::to_string(self.0).map_err(|_| std::fmt::Error)?;
        f.write_str(&text)
    }
}
