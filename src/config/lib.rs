//! Conversion of TOML text to checked specifications.
//!
//! The input is the text of a configuration. The result is a [`spec::RigSpec`], or the list of all problems of the text
//! ([`ConfigErrors`]). `keys` declares each key once. `raw` reads the text into the structs of `keys`. `check` tests the rules
//! between keys and builds the specification. The template and the JSON Schema are written from `keys`. The crate opens no file; it
//! uses the [`Files`] of the caller.

#![warn(missing_docs)]
#![cfg_attr(not(test), deny(clippy::disallowed_methods))]

mod check;
mod declaration;
mod describe;
mod files;
mod keys;
mod problem;
mod profile;
mod raw;
pub mod spec;
mod summary;

pub use check::{load, parse};
pub use describe::{schema, template};
pub use files::{AnyFiles, Files};
pub use problem::{ConfigErrors, Problem};
pub use profile::read_profile;
pub use raw::did_you_mean;
pub use summary::{Finding, FindingKind, findings, summary};
