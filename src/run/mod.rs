//! Who knows the order: one ping through the house, the rig around it, and the two ways to run it.
pub mod certificate;
pub mod chart;
pub mod conditions;
pub mod counters;
pub mod daemon;
pub mod engines;
mod footprints;
pub mod line_engines;
pub mod outputs;
pub mod pipeline;
pub mod recorded;
pub mod recorders;
pub mod replay;
pub mod rig;
pub mod settings;
mod view;
