//! Whole pings: engines against each other, error checks, culling, reverberation.

mod culling;
mod density;
mod engines;
mod error_check;
mod fan_truth;
mod instrument;
mod moving;
mod multipath;
mod promises;
mod reflected_shadows;
mod refraction;
mod reverberation;
mod volume;
