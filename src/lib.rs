//! Echotank: a hardware-in-the-loop sonar emulator.
//!
//! Data flows one way; read [`flow`] (the nouns), then `run::pipeline::compute_ping` (the order), then any one stage.
pub mod config;
pub mod flow;
pub mod frames;
pub mod time;
