//! `faults-*.jsonl`: every injected fault, one JSON object per line, for comparison with the report of a device.
//!
//! | key | content |
//! |---|---|
//! | `fault`, `kind` | number of the fault in this run, and its kind |
//! | `sonar`, `ping_number`, `utc_ns` | the affected ping, and the start of its pulse in rig time |
//! | `line` | link faults: the family, `7k`, `jsf`, `wbms`, `ping`, `ping-serial`, `imagenex872`, `vita49` or `elements` |
//! | `record_type` | link faults: record type; for JSF type + 65536 subsystem + 2^24 channel; for packets the index within the ping, from 1 |
//! | `frame_number` | element streams: frame number |
//! | `stream`, `context`, `packet_utc_ns` | VITA 49: stream, whether it is a context packet, packet time |
//! | `source`, `quantity` | navigation faults: source and quantity |
//! | `array`, `element` | element faults: location; if absent, all |
//! | `strength` | growth of the fault, 0 to 1 |

use std::fs::File;
use std::io::Write;
use std::path::{Path, PathBuf};

use serde::Serialize;

use super::RecordError;

/// A log in JSON lines. An interrupted log stays readable up to its last whole line.
pub(crate) struct FaultLog {
    path: PathBuf,
    file: File,
    length_bytes: u64,
    lines: String,
}

impl FaultLog {
    /// Creates the file, replacing an existing one.
    pub(crate) fn create(path: &Path) -> Result<Self, RecordError> {
        let file = File::create(path).map_err(RecordError::io(path, "create"))?;
        // The lock prevents `recover` from changing the file.
        let _ = file.try_lock();
        Ok(Self {
            path: path.to_owned(),
            file,
            length_bytes: 0,
            lines: String::new(),
        })
    }

    /// Appends a line for each event.
    pub(crate) fn write<T: Serialize>(&mut self, injections: &[T]) -> Result<(), RecordError> {
        self.lines.clear();
        for injection in injections {
            // Plain data, so serialisation succeeds.
            if let Ok(line) = serde_json::to_string(injection) {
                self.lines += &line;
                self.lines.push('\n');
            }
        }
        self.file
            .write_all(self.lines.as_bytes())
            .map_err(|source| {
                // Restores whole lines; if this fails too, the last line is truncated.
                let _ = self.file.set_len(self.length_bytes);
                RecordError::io(&self.path, "write")(source)
            })?;
        self.length_bytes += self.lines.len() as u64;
        Ok(())
    }
}
