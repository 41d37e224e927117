//! Recorders: they write pings to files.
//!
//! - [`faults`]: injected faults, one JSON line each.
//! - [`npz`]: samples of every ping as NumPy arrays, with geometry and ground truth.
//! - `npz_join`: joins the arrays of successive pings.
//! - [`recover`]: repairs records that were cut off.
//! - `mcap`: ROS 2 messages of every ping.
//! - [`masks`]: target and shadow labels of the samples of each line.
//! - [`png`]: the waterfall picture. [`picture`]: other pictures, mosaics and their masks.
//! - [`lines`]: reads the side-scan lines of a recording.
//! - [`s7k`]: 7k records as a `.s7k` file.
//! - [`synthetic_aperture`]: a back-projected image.
//! - [`stream`]: concatenated protocol records, as in `.jsf`, `.xtf` and `.svlog` files.
//! - [`sigmf`]: I and Q samples of the elements, with annotations for every ping.
//! - [`wav`]: signals at the elements, for playback on a bench.
//! - [`svlog`]: frames of the Ping protocol.
//! - [`truth`]: ground truth, one JSON line per ping.
//! - `zarr`: the arrays of `npz` as a folder of chunks.
//!
//! Recorders run outside the ping path. They neither panic nor print. A missing folder or a full disk gives a [`RecordError`] that names the file.
//!
//! Pictures, `.npz` files and Zarr stores appear complete or not at all. `.s7k`, `.jsf`, `.xtf` and `truth.jsonl` grow in place. If interrupted, they are readable
//! up to the last whole record or line. Interrupted `.svlog`, SigMF, WAV and MCAP files are readable after a repair ([`recover`]).
pub mod faults;
pub mod lines;
pub mod masks;
pub(crate) mod mcap;
pub mod npz;
pub(crate) mod npz_join;
pub mod picture;
pub(crate) mod plan_text;
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
pub(crate) mod zarr;

use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

use echotank_protocols::sevenk::file::FileError;

/// Creates a folder and its missing parents.
pub(crate) fn make_folder(path: &Path) -> Result<(), RecordError> {
    std::fs::create_dir_all(path).map_err(RecordError::io(path, "create"))
}

/// Creates an empty file `STEM.EXTENSION` for a recording and returns its path. If the name exists, a suffix is added, as in `STEM-2.EXTENSION`,
/// because two programs can record into one folder in the same second.
pub(crate) fn claim_name(
    folder: &Path,
    stem: &str,
    extension: &str,
) -> Result<PathBuf, RecordError> {
    let mut path = folder.join(format!("{stem}.{extension}"));
    for number in 2.. {
        match File::create_new(&path) {
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {
                path = folder.join(format!("{stem}-{number}.{extension}"));
            }
            Err(error) => return Err(RecordError::io(&path, "create")(error)),
            Ok(_) => break,
        }
    }
    Ok(path)
}

/// Errors of recording a ping or record.
#[derive(Debug, thiserror::Error)]
pub enum RecordError {
    /// A file system operation failed; the recorder has stopped.
    #[error("{}: cannot {action}: {source}", path.display())]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// The refused action, a verb.
        action: &'static str,
        /// The cause.
        source: io::Error,
    },
    /// The ping has another shape than the first ping and is omitted; the file stays valid.
    #[error(
        "{}: ping {ping_number} has {got} {what}, the first had {want}: arrays hold pings of one shape; keep range and pulse fixed",
        path.display()
    )]
    ShapeChanged {
        /// The file.
        path: PathBuf,
        /// Number of the omitted ping.
        ping_number: u32,
        /// The counted items that differ, a plural noun.
        what: &'static str,
        /// Their count in this ping.
        got: usize,
        /// Their count in the first ping.
        want: usize,
    },
    /// The format cannot hold the record, which is omitted; the file stays valid.
    #[error("{}: record left out: {source}", path.display())]
    Refused {
        /// The file.
        path: PathBuf,
        /// The rule of the format.
        source: FileError,
    },
    /// An earlier error stopped the recorder.
    #[error("{}: recording stopped after an earlier error", path.display())]
    Stopped {
        /// The file.
        path: PathBuf,
    },
}

impl RecordError {
    /// Error for a file that is no longer in its folder.
    pub(crate) fn missing(path: &Path, source: io::Error) -> Self {
        Self::io(path, "find")(source)
    }

    pub(crate) fn io(path: &Path, action: &'static str) -> impl FnOnce(io::Error) -> Self {
        move |source| Self::Io {
            path: path.to_owned(),
            action,
            source,
        }
    }
}

/// A file named `NAME.partial` that is removed on drop unless [`PartialFile::keep`] was called.
struct PartialFile {
    partial: PathBuf,
    file: BufWriter<File>,
    kept: bool,
}

impl PartialFile {
    /// `path` is the final name.
    fn create(path: &Path) -> Result<Self, RecordError> {
        let mut partial = path.as_os_str().to_owned();
        partial.push(".partial");
        let partial = PathBuf::from(partial);
        // Read access is needed, because streamed data is read back when an archive is assembled.
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

    /// Renames the file to its final name, replacing an existing file.
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
            // Errors are ignored: the suffix marks a file that remains.
            let _ = std::fs::remove_file(&self.partial);
        }
    }
}

#[cfg(test)]
pub mod testing;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn recordings_of_one_second_have_names_of_their_own() {
        let folder = tempfile::tempdir().expect("a folder");
        let names: Vec<_> = (0..3)
            .map(|_| claim_name(folder.path(), "hull-20140801T000010", "s7k").expect("claimed"))
            .map(|path| path.display().to_string())
            .collect();
        let wanted = ["", "-2", "-3"].map(|suffix| {
            let name = format!("hull-20140801T000010{suffix}.s7k");
            folder.path().join(name).display().to_string()
        });
        assert_eq!(names, wanted);
    }
}
