//! The side-scan families and 7k together: controls, navigation, geometry, load.

mod controls;
mod flat_bottom;
mod load;
mod navigation;
mod pipeline;
mod pulses;
mod rig;
mod spread;
mod together;
mod vertical;
