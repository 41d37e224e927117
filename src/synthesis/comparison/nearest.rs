//! Synthesis at the nearest sample, `nearest`: the replica of each echo is placed on the nearest sample, with the exact carrier
//! phase.
//!
//! Simple simulators use this method; it is for comparison. An echo is displaced by up to half a sample. The pulse is not
//! stretched, so Doppler models with stretch are not supported.

use super::replica::ReplicaSink;

/// Sink that adds echoes to the samples of one element, each at the nearest sample.
pub type Nearest<'a> = ReplicaSink<'a, false>;
