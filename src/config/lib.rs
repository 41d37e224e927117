//! TOML to checked specifications.
//!
//! In: a file. Out: a [`spec::RigSpec`], or everything that is wrong with the file at once ([`ConfigErrors`]). A bad configuration never
//! starts. `keys` declares every key; `raw` reads a text against it; `check` holds the rules between keys and changes to SI; the template
//! and the JSON Schema are written from `keys`, so that they say what is accepted.

mod check;
mod describe;
mod files;
mod keys;
mod problem;
mod raw;
pub mod spec;
mod summary;

pub use check::{load, parse};
pub use describe::{schema, template};
pub use files::{AnyFiles, Files};
pub use problem::{ConfigErrors, Problem};
pub use summary::summary;
