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
        Ok(Box::new(File::open(path)?))
    }
}
