//! Access of the configuration to the file system. This crate opens no file itself.

use std::path::Path;

/// File system queries of a configuration.
///
/// An error is a text that follows "cannot be read:", such as "not found", and is the same on every system.
pub trait Files {
    /// The content of a file.
    fn read(&self, path: &Path) -> Result<Vec<u8>, String>;

    /// Checks that `path` is a file that can be opened for reading.
    fn check_readable(&self, path: &Path) -> Result<(), String>;

    /// Whether `path` is a folder, or does not exist and can be created as a folder.
    fn is_folder_or_free(&self, path: &Path) -> bool;
}

/// A file system that accepts every path and has no content. It is used to check a text without its files.
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
