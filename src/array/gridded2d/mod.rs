//! Line arrays, whole stretches of elements at a time: a transform over delay and slope.
mod engine;
pub mod pulse;
mod series;
mod smooth;

pub use engine::{
    Filter, Fineness, Gather, LineEngine, Orders, PulseMotion, Sample, TaskReport, Wanted, Work,
};
