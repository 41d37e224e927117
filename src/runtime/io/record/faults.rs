//! `faults-*.jsonl`: every injected fault, one JSON object per line, so that what a device reports can be scored.
//!
//! | key | |
//! |---|---|
//! | `fault`, `kind` | its number in this run and its kind |
//! | `sonar`, `ping_number`, `utc_ns` | the ping it injected, and the start of its pulse in rig time |
//! | `line` | of faults of the line: the family, `7k`, `jsf`, `wbms`, `ping`, `ping-serial`, `imagenex872`, `vita49` or `elements` |
//! | `record_type` | and the record: its number; of JSF type + 65536 subsystem + 2^24 channel; of packets which one of its ping, from 1 |
//! | `frame_number` | of an element stream |
//! | `stream`, `context`, `packet_utc_ns` | of VITA 49: the stream, whether it is a context packet, the time it says |
//! | `source`, `quantity` | of faults of navigation |
//! | `array`, `element` | of faults of elements: where; absent: all |
//! | `strength` | how far it had grown, 0 to 1 |

use std::fs::File;
use std::io::Write;
use std::path::{Path, PathBuf};

use serde::Serialize;

use super::RecordError;

/// Grows line by line; readable up to the last whole line whenever it is cut off.
pub(crate) struct FaultLog {
    path: PathBuf,
    file: File,
    length_bytes: u64,
    lines: String,
}

impl FaultLog {
    /// Replaces what has this name.
    pub(crate) fn create(path: &Path) -> Result<Self, RecordError> {
        let file = File::create(path).map_err(RecordError::io(path, "create"))?;
        // Keeps `recover` away.
        let _ = file.try_lock();
        Ok(Self {
            path: path.to_owned(),
            file,
            length_bytes: 0,
            lines: String::new(),
        })
    }

    /// Appends a line for each.
    pub(crate) fn write<T: Serialize>(&mut self, injections: &[T]) -> Result<(), RecordError> {
        self.lines.clear();
        for injection in injections {
            // Plain data: it can always be written.
            if let Ok(line) = serde_json::to_string(injection) {
                self.lines += &line;
                self.lines.push('\n');
            }
        }
        self.file
            .write_all(self.lines.as_bytes())
            .map_err(|source| {
                // Whole lines only; if even this fails, the last is truncated.
                let _ = self.file.set_len(self.length_bytes);
                RecordError::io(&self.path, "write")(source)
            })?;
        self.length_bytes += self.lines.len() as u64;
        Ok(())
    }
}
