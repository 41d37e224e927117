//! Configurations from the file system.

use std::io;
use std::path::Path;

use echotank_config::spec::RigSpec;
use echotank_config::{ConfigErrors, Files};

/// This computer's file system.
#[derive(Clone, Copy, Debug)]
pub struct FileSystem;

impl Files for FileSystem {
    fn read(&self, path: &Path) -> Result<Vec<u8>, String> {
        regular(path)?;
        std::fs::read(path).map_err(|error| reason(&error))
    }

    fn check_readable(&self, path: &Path) -> Result<(), String> {
        regular(path)?;
        match std::fs::File::open(path) {
            Ok(_) => Ok(()),
            Err(error) => Err(reason(&error)),
        }
    }

    fn is_folder_or_free(&self, path: &Path) -> bool {
        path.is_dir() || !path.exists()
    }
}

/// Refuses folders, pipes and devices, which can be endless.
fn regular(path: &Path) -> Result<(), String> {
    let metadata = std::fs::metadata(path).map_err(|error| reason(&error))?;
    match metadata.is_file() {
        true => Ok(()),
        false => Err("not a file".to_owned()),
    }
}

/// The error in words that are the same on every system.
fn reason(error: &io::Error) -> String {
    match error.kind() {
        io::ErrorKind::NotFound => "not found".to_owned(),
        io::ErrorKind::PermissionDenied => "no permission".to_owned(),
        _ => error.to_string(),
    }
}

/// Reads the text of a configuration file.
pub fn read_text(path: &Path) -> Result<String, String> {
    String::from_utf8(FileSystem.read(path)?).map_err(|error| error.to_string())
}

/// Reads and checks a configuration file, and checks that the files it names can be read.
pub fn load(path: &Path) -> Result<RigSpec, ConfigErrors> {
    echotank_config::load(path, &FileSystem)
}

/// Checks a configuration's text; relative file names in it count from `folder`.
pub fn parse(text: &str, folder: &Path) -> Result<RigSpec, ConfigErrors> {
    echotank_config::parse(text, folder, &FileSystem)
}
