//! What simple simulators do: every echo's replica on the nearest sample, its carrier phase exact.
//!
//! For comparison. An echo is up to half a sample out of place; the pulse is not stretched, so Doppler models that stretch it do not go with it.

use super::replica::Laid;

/// Adds echoes to the samples of one element, each at the nearest sample.
pub type Nearest<'a> = Laid<'a, false>;
