//! Support code of the tests of several crates and of the developers' tools.

pub mod allocations;
#[cfg(feature = "echo")]
pub mod echo;
#[cfg(feature = "echo")]
pub mod line_scene;
pub mod nav;
#[cfg(feature = "pings")]
pub mod pings;
#[cfg(feature = "scene")]
pub mod seeds;
pub mod track;
#[cfg(feature = "wire")]
pub mod wire;

use std::path::PathBuf;

/// Root folder of the repository.
pub fn repository() -> PathBuf {
    PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../.."))
}
