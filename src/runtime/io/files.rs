//! The file system, for the crates that open no files themselves.

use std::fs::File;
use std::io::{self, Read};
use std::path::Path;

use echotank_scene::Files;

/// Files of the operating system.
#[derive(Clone, Copy, Debug, Default)]
pub struct FileSystem;

impl Files for FileSystem {
    fn open(&self, path: &Path) -> io::Result<Box<dyn Read>> {
        // A pipe or a device can be endless, and a pipe without a writer is never opened.
        if !std::fs::metadata(path)?.is_file() {
            return Err(io::Error::other("not a regular file"));
        }
        Ok(Box::new(File::open(path)?))
    }
}
