//! What somewhat better simulators do: every echo's replica interpolated linearly between its samples, its carrier phase exact.
//!
//! For comparison. Interpolation rounds off the pulse's upper band; the pulse is not stretched, so Doppler models that stretch it do not go
//! with it.

use super::replica::Laid;

/// Adds echoes to the samples of one element, interpolated between samples.
pub type Linear<'a> = Laid<'a, true>;
