//! Echotank: a hardware-in-the-loop sonar emulator.
//!
//! Data flows one way; read [`flow`] (the nouns), then `run::pipeline::compute_ping` (the order), then any one stage.
pub mod array;
pub mod beam;
pub mod cli;
pub mod config;
pub mod echo;
pub mod emit;
pub mod flow;
pub mod frames;
pub mod geodesy;
pub mod image;
pub mod io;
pub mod nav;
pub mod ping;
pub mod run;
pub mod scene;
pub mod time;
pub mod utm;
