//! The file system, as far as a configuration needs it. This crate opens no file itself.

use std::path::Path;

/// Answers what a configuration asks of the file system.
///
/// Errors are words that fit after "cannot be read:", the same on every system, such as "not found".
pub trait Files {
    /// The whole content of a file.
    fn read(&self, path: &Path) -> Result<Vec<u8>, String>;

    /// Whether `path` is a file that can be opened for reading.
    fn check_readable(&self, path: &Path) -> Result<(), String>;

    /// Whether `path` is a folder, or free for a folder to be made there.
    fn is_folder_or_free(&self, path: &Path) -> bool;
}

/// Accepts every path and reads nothing, to check a text where its files are not at hand.
#[derive(Clone, Copy, Debug)]
pub struct AnyFiles;

impl Files for AnyFiles {
    fn read(&self, _: &Path) -> Result<Vec<u8>, String> {
        Err("no file is read here".to_owned())
    }

    fn check_readable(&self, _: &Path) -> Result<(), String> {
        Ok(())
    }

    fn is_folder_or_free(&self, _: &Path) -> bool {
        true
    }
}
