//! Who knows the order: one ping through the house, the rig around it, and the two ways to run it.
pub mod certificate;
pub mod control;
pub mod counters;
pub mod daemon;
pub mod engines;
mod footprints;
pub mod gate;
pub mod histograms;
pub mod line_engines;
pub mod outputs;
pub mod pipeline;
pub mod recorders;
pub mod replay;
pub mod rig;
pub mod settings;
mod view;
