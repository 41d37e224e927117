//! Access to files, which the caller of this crate provides.

use std::io::{self, Read};
use std::path::Path;

/// Opens the files that a scene refers to.
///
/// This crate opens no file itself. The runtime passes the file system; a test may pass bytes in memory.
pub trait Files {
    /// Opens a file for reading from its first byte.
    ///
    /// Returns the operating system's error if the file does not exist or cannot be read. The caller adds the path to it.
    fn open(&self, path: &Path) -> io::Result<Box<dyn Read>>;
}
