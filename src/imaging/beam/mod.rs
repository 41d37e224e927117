//! Element samples to beams: [`ElementFrame`](echotank_core::flow::ElementFrame) in, [`BeamFrame`](echotank_core::flow::BeamFrame) or
//! [`Line`](echotank_core::flow::Line) out.
//!
//! - [`matched`]: correlation of a row of samples with the transmitted pulse.
//! - [`block`]: the same on a stream of blocks. [`weights`]: weightings along pulses and apertures.
//! - [`conventional`]: a far-field fan of delay-and-sum beams, exact over the pulse's whole band, f64.
//! - [`fast`]: the same fan by fast transforms over time and line, f32.
//! - [`delay_sum`]: far-field and dynamically focused beams in the time domain, f32, with the widest instructions at hand.
//! - [`fan`]: whichever of these a configuration names.
//! - [`halves`]: two fans of the halves of a line, for bottom detection. [`backproject`]: synthetic aperture over many pings.
//! - [`sidescan`]: the whole aperture as one beam, one line per side, focused or not.
//!
//! Every former belongs to one array, is sized once from [`RowLimits`], and allocates nothing afterwards. Work is split by element and
//! by beam, so that the samples are the same bits for any number of threads.
//!
//! Not modelled: turning of the platform during the echo in the steering delays.
mod aimed;
pub mod backproject;
pub mod block;
pub mod conventional;
pub(crate) mod delay_sum;
mod directions;
pub mod fan;
pub mod fast;
pub mod halves;
mod kernel;
pub mod matched;
#[cfg(test)]
mod point_images;
pub mod sidescan;
#[cfg(test)]
mod test_rig;
pub mod weights;

/// The largest row a former will meet; its buffers and transforms are sized from it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RowLimits {
    pub sample_rate_hz: f64,
    /// Samples of the longest listening window.
    pub samples: usize,
    /// Duration of the longest pulse, seconds.
    pub pulse_s: f64,
}
