//! Recorders: pings in, files out.
//!
//! - [`faults`]: what was injected, one JSON line per fault.
//! - [`npz`]: every sample of every ping as NumPy arrays, with the geometry an outside calculation needs.
//! - [`png`]: the waterfall picture.
//! - [`recover`]: mends records that were cut off.
//! - [`masks`]: what each sample of each line shows.
//! - [`png`]: the waterfall picture. [`picture`]: other pictures, mosaics, and the masks beside them.
//! - [`lines`]: a recording's lines, read again.
//! - [`s7k`]: protocol records as a `.s7k` file.
//! - [`synthetic_aperture`]: a back-projected image.
//! - [`stream`]: protocol records one behind the other, as `.jsf` and `.xtf` files are.
//! - [`sigmf`]: I and Q of the elements, with words for every ping.
//! - [`wav`]: what the elements hear, for benches that play it out.
//! - [`svlog`]: frames of the Ping protocol.
//! - [`truth`]: what the emulator knows and a sonar does not, one JSON line per ping.
//!
//! Recorders run beside the pings, never on the ping path. None panics and none prints: a missing folder or a full disk is a
//! [`RecordError`] that names the file. Pictures and `.npz` files appear whole under their names or not at all; `.s7k`, `.jsf`, `.xtf` and `truth.jsonl`
//! grow in place and are readable up to the last whole record or line whenever they are cut off; so do `.svlog`, SigMF and WAV once they are
//! mended ([`recover`]).
pub mod faults;
pub mod lines;
pub mod masks;
pub mod npz;
pub mod picture;
mod plan_text;
pub mod png;
pub mod recover;
mod repair;
pub mod s7k;
pub mod sigmf;
pub mod stream;
pub mod svlog;
pub mod synthetic_aperture;
pub mod truth;
pub mod wav;

use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

use echotank_protocols::sevenk::file::FileError;

/// Makes a folder and those above it, where absent.
pub(crate) fn make_folder(path: &Path) -> Result<(), RecordError> {
    std::fs::create_dir_all(path).map_err(RecordError::io(path, "create"))
}

/// Why something was not recorded.
#[derive(Debug, thiserror::Error)]
pub enum RecordError {
    #[error("{}: cannot {action}: {source}", path.display())]
    Io {
        path: PathBuf,
        action: &'static str,
        source: io::Error,
    },
    /// The ping is left out; the file stays good.
    #[error(
        "{}: ping {ping_number} has {got} {what}, the first had {want}: an .npz file holds pings of one shape, so keep range and pulse fixed",
        path.display()
    )]
    ShapeChanged {
        path: PathBuf,
        ping_number: u32,
        what: &'static str,
        got: usize,
        want: usize,
    },
    /// The record is left out; the file stays good.
    #[error("{}: record left out: {source}", path.display())]
    Refused { path: PathBuf, source: FileError },
    #[error("{}: not recording since an earlier error", path.display())]
    Stopped { path: PathBuf },
}

impl RecordError {
    fn io(path: &Path, action: &'static str) -> impl FnOnce(io::Error) -> Self {
        move |source| Self::Io {
            path: path.to_owned(),
            action,
            source,
        }
    }
}

/// A file under a temporary name, `NAME.partial`, that is removed unless it is kept.
struct PartialFile {
    partial: PathBuf,
    file: BufWriter<File>,
    kept: bool,
}

impl PartialFile {
    /// `path` is the name it may get in the end.
    fn create(path: &Path) -> Result<Self, RecordError> {
        let mut partial = path.as_os_str().to_owned();
        partial.push(".partial");
        let partial = PathBuf::from(partial);
        // Readable too: what was streamed is read back when a file is put together.
        let file = File::options()
            .read(true)
            .write(true)
            .create(true)
            .truncate(true)
            .open(&partial)
            .map_err(RecordError::io(&partial, "create"))?;
        Ok(Self {
            file: BufWriter::with_capacity(1 << 18, file),
            partial,
            kept: false,
        })
    }

    fn write(&mut self, bytes: &[u8]) -> Result<(), RecordError> {
        self.file
            .write_all(bytes)
            .map_err(RecordError::io(&self.partial, "write"))
    }

    /// Gives the file its name, replacing what had it.
    fn keep(mut self, path: &Path) -> Result<(), RecordError> {
        self.file
            .flush()
            .map_err(RecordError::io(&self.partial, "write"))?;
        std::fs::rename(&self.partial, path).map_err(RecordError::io(path, "rename to"))?;
        self.kept = true;
        Ok(())
    }
}

impl Drop for PartialFile {
    fn drop(&mut self) {
        if !self.kept {
            // Best effort: what is left over bears a name that says so.
            let _ = std::fs::remove_file(&self.partial);
        }
    }
}

#[cfg(test)]
pub mod testing;
