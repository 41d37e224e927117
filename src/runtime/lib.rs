//! A rig in real time or in replay: files, clocks, sockets, pacing, servers, outputs, the operator's page and the recorders.
//!
//! No other crate opens files or sockets or reads clocks. Tests, tools and the program depend on this crate.

#![warn(missing_docs)]

pub mod calibrate;
pub mod campaign;
pub mod chart;
pub mod check;
pub mod clock;
pub mod config_files;
pub mod control;
pub mod counters;
pub mod daemon;
pub mod faults;
pub mod first_pings;
mod formats;
pub mod gate;
pub mod histograms;
pub mod io;
pub(crate) mod metrics;
pub mod outputs;
pub mod overload;
pub mod page;
pub mod pictures;
pub mod recorded;
pub(crate) mod recorders;
pub mod replay;
pub mod rig;
pub mod score;
pub mod settings;
pub mod synthetic_aperture;
pub mod tiles;
pub mod triggers;
pub mod waiting;
