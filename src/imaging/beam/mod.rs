//! Beamforming: [`ElementFrame`](echotank_core::ping::ElementFrame) in, [`BeamFrame`](echotank_core::ping::BeamFrame) or
//! [`Line`](echotank_core::ping::Line) out.
//!
//! - [`matched`]: correlation of a row of samples with the transmitted pulse.
//! - [`weights`]: weightings along pulses and apertures.
//! - [`conventional`]: a far-field fan of delay-and-sum beams, exact over the pulse's bandwidth, f64.
//! - [`fast`]: the same fan by FFTs over time and line, f32.
//! - [`delay_sum`]: far-field and dynamically focused beams in the time domain, f32, with SIMD.
//! - [`fan`]: the former that a configuration selects, also of the halves of a line for bottom detection.
//! - [`backproject`]: synthetic aperture over many pings.
//! - [`sidescan`]: the whole aperture as one beam, one line per side, with or without focus.
//! - [`work`]: how much work these are.
//!
//! Every former belongs to one array, is sized once from [`RowLimits`], and does not allocate afterwards. Work is split by element,
//! by beam and by tile of samples, so that the samples are bit-identical for any number of threads.
//!
//! Not modelled: rotation of the platform during the echo in the steering delays.
pub mod backproject;
pub mod conventional;
pub(crate) mod delay_sum;
mod directions;
pub mod fan;
pub mod fast;
mod kernel;
pub mod matched;
#[cfg(test)]
mod point_images;
pub mod sidescan;
mod steered;
#[cfg(test)]
mod test_rig;
pub mod weights;
pub mod work;

/// Largest row of samples that a former must process; it determines buffer and transform sizes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RowLimits {
    /// Sample rate of the rows.
    pub sample_rate_hz: f64,
    /// Number of samples of the longest reception window.
    pub samples: usize,
    /// Duration of the longest pulse, seconds.
    pub pulse_s: f64,
}
