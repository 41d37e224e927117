//! Files of concatenated records: `.jsf`, `.xtf` and `.svlog`.
//!
//! The file has its final name from the start and grows by whole records. An interrupted file stays readable.

use std::fs::File;
use std::io::Write;
use std::path::{Path, PathBuf};

use super::RecordError;

/// Recorder of one file of concatenated records.
#[derive(Debug)]
pub(crate) struct StreamRecorder {
    path: PathBuf,
    file: File,
    length_bytes: u64,
    /// Whether a file system error has stopped the recorder.
    stopped: bool,
}

impl StreamRecorder {
    /// Creates the file, replacing an existing one. `head` holds the bytes before the records.
    pub(crate) fn create(path: &Path, head: &[u8]) -> Result<Self, RecordError> {
        let file = File::create(path).map_err(RecordError::io(path, "create"))?;
        // The lock prevents `recover` from changing the file.
        let _ = file.try_lock();
        let mut recorder = Self {
            path: path.to_owned(),
            file,
            length_bytes: 0,
            stopped: false,
        };
        recorder.write(head)?;
        Ok(recorder)
    }

    /// Appends whole records. A file system error truncates the file to its last whole record and stops the recorder.
    pub(crate) fn write(&mut self, records: &[u8]) -> Result<(), RecordError> {
        if self.stopped {
            return Err(RecordError::Stopped {
                path: self.path.clone(),
            });
        }
        self.file.write_all(records).map_err(|source| {
            self.stopped = true;
            // If this fails too, readers skip the truncated record.
            let _ = self.file.set_len(self.length_bytes);
            RecordError::io(&self.path, "write")(source)
        })?;
        self.length_bytes += records.len() as u64;
        Ok(())
    }

    /// Appends `tail` and flushes the file to disk.
    pub(crate) fn close(mut self, tail: &[u8]) -> Result<(), RecordError> {
        self.write(tail)?;
        self.file
            .sync_data()
            .map_err(RecordError::io(&self.path, "close"))
    }
}
