//! The side-scan families and 7k together: controls, navigation, geometry, load.

#[path = "../wire_rig/mod.rs"]
mod wire_rig;

mod controls;
mod flat_bottom;
mod load;
mod navigation;
mod pipeline;
mod pulses;
mod rig;
mod spread;
mod together;
