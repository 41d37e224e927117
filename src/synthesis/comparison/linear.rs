//! Synthesis by linear interpolation, `linear`: the replica of each echo is interpolated between its samples, with the exact
//! carrier phase.
//!
//! Other simulators use this method; it is for comparison. Interpolation attenuates the upper band of the pulse. The pulse is not
//! stretched, so Doppler models with stretch are not supported.

use super::replica::ReplicaSink;

/// Sink that adds echoes to the samples of one element, interpolated between samples.
pub type Linear<'a> = ReplicaSink<'a, true>;
