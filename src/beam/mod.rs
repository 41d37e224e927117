//! Element samples to beams: [`ElementFrame`](crate::flow::ElementFrame) in, [`BeamFrame`](crate::flow::BeamFrame) or
//! [`Line`](crate::flow::Line) out.
//!
//! - [`matched`]: correlation of a row of samples with the transmitted pulse.
//! - [`conventional`]: a far-field fan of delay-and-sum beams, exact over the pulse's whole band.
//! - [`sidescan`]: the whole aperture as one beam, one line per side.
//!
//! Every former belongs to one array, is sized once from [`RowLimits`], and allocates nothing afterwards. Work is split by element and
//! by beam, so that the samples are the same bits for any number of threads.
//!
//! Not modelled: focusing in the near field, motion during reception in the steering delays, synthetic aperture.
pub mod block;
pub mod conventional;
pub mod matched;
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
