//! TOML to checked specifications.
//!
//! In: the text of a configuration. Out: a [`spec::RigSpec`], or every problem of the text at once ([`ConfigErrors`]). `keys` declares
//! each key once; `raw` reads the text into the structs of `keys`; `check` tests the rules between keys and makes the specification. The
//! template and the JSON Schema are written from `keys`. The crate opens no file: it asks [`Files`].

#![warn(missing_docs)]
#![cfg_attr(not(test), deny(clippy::disallowed_methods))]

mod check;
mod declaration;
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
