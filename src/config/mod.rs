//! TOML to checked specifications.
pub mod spec;
