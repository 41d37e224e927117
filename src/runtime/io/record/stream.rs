//! Files that are records one behind the other: `.jsf`, `.xtf`.
//!
//! The file has its final name from the start and grows record by record: cut off, it is readable up to the last whole record.

use std::fs::File;
use std::io::Write;
use std::path::{Path, PathBuf};

use super::RecordError;

/// Writes one such file.
#[derive(Debug)]
pub(crate) struct StreamRecorder {
    path: PathBuf,
    file: File,
    length_bytes: u64,
    /// An error of the file system: nothing more is written.
    stopped: bool,
}

impl StreamRecorder {
    /// Replaces what has this name. `head`: what the file begins with.
    pub(crate) fn create(path: &Path, head: &[u8]) -> Result<Self, RecordError> {
        let file = File::create(path).map_err(RecordError::io(path, "create"))?;
        // Keeps `recover` away.
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

    /// Appends whole records. After an error of the file system the file is cut back to its last whole record and takes no more.
    pub(crate) fn write(&mut self, records: &[u8]) -> Result<(), RecordError> {
        if self.stopped {
            return Err(RecordError::Stopped {
                path: self.path.clone(),
            });
        }
        self.file.write_all(records).map_err(|source| {
            self.stopped = true;
            // If even this fails, readers skip the truncated record.
            let _ = self.file.set_len(self.length_bytes);
            RecordError::io(&self.path, "write")(source)
        })?;
        self.length_bytes += records.len() as u64;
        Ok(())
    }

    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    /// Appends what the file ends with, and sees it to the disk.
    pub(crate) fn close(mut self, tail: &[u8]) -> Result<(), RecordError> {
        self.write(tail)?;
        self.file
            .sync_data()
            .map_err(RecordError::io(&self.path, "close"))
    }
}
