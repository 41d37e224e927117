//! SHA-256 of files and of configurations with the files that they name.

use std::collections::BTreeSet;
use std::fs::File;
use std::io::{self, Read};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

use sha2::{Digest, Sha256};

use crate::config_files::{FileSystem, LoadError, load_from};
use echotank_config::Files;
use echotank_config::spec::RigSpec;

/// Bytes read at a time.
const BLOCK: usize = 1 << 16;

fn feed(digest: &mut Sha256, path: &Path) -> io::Result<u64> {
    let mut file = File::open(path)?;
    let mut block = vec![0; BLOCK];
    let mut bytes = 0;
    loop {
        match file.read(&mut block)? {
            0 => return Ok(bytes),
            n => {
                digest.update(&block[..n]);
                bytes += n as u64;
            }
        }
    }
}

fn text_of(digest: Sha256) -> String {
    let bytes = digest.finalize();
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// Length and SHA-256 of a file.
pub(super) fn of_file(path: &Path) -> io::Result<(u64, String)> {
    let mut digest = Sha256::new();
    let bytes = feed(&mut digest, path)?;
    Ok((bytes, text_of(digest)))
}

/// A file system that notes which files a configuration names.
#[derive(Default)]
struct Witness(Mutex<BTreeSet<PathBuf>>);

impl Witness {
    fn note(&self, path: &Path) {
        let mut seen = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        seen.insert(path.to_owned());
    }
}

impl Files for Witness {
    fn read(&self, path: &Path) -> Result<Vec<u8>, String> {
        self.note(path);
        FileSystem.read(path)
    }

    fn check_readable(&self, path: &Path) -> Result<(), String> {
        self.note(path);
        FileSystem.check_readable(path)
    }

    fn is_folder_or_free(&self, path: &Path) -> bool {
        FileSystem.is_folder_or_free(path)
    }
}

/// The configuration with its overrides, and the SHA-256 of its text, of the overrides, of `nav`, and of every file that it names. Files that those
/// files name in turn, such as the meshes of a list of targets, are not included.
pub(super) fn of_configuration(
    rig: &Path,
    set: &[String],
    nav: Option<&Path>,
) -> Result<(RigSpec, String), LoadError> {
    let witness = Witness::default();
    let spec = load_from(rig, set, &witness)?;
    let mut digest = Sha256::new();
    let unreadable = |path: &Path, why: io::Error| {
        LoadError::Override(format!("{}: cannot be read: {why}", path.display()))
    };
    for change in set {
        digest.update(change.as_bytes());
        digest.update([0]);
    }
    let seen = witness
        .0
        .into_inner()
        .unwrap_or_else(PoisonError::into_inner);
    let named = seen
        .iter()
        .map(PathBuf::as_path)
        .filter(|path| *path != rig);
    for path in std::iter::once(rig).chain(named).chain(nav) {
        feed(&mut digest, path).map_err(|why| unreadable(path, why))?;
    }
    Ok((spec, text_of(digest)))
}
