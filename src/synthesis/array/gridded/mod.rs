//! Fast synthesis on a grid: a nonuniform Fourier transform per element.
//!
//! Each echo is a point of the transform. Its complex amplitude is spread onto a few cells of a time
//! grid. An FFT transforms the grid into a spectrum, which is multiplied by the spectrum of the pulse.
//! Points with different Doppler are split over a few columns with interpolation weights, with one
//! transform each. Sources: Fessler and Sutton 2003; Beatty, Nishimura and Pauly 2005.
//!
//! Reading order: [`kernel`] (the interpolation), [`moments`] (the inner loops), [`transform`] (both
//! combined), then [`one_dimensional`], the engine. [`doppler`], `evenly`, `batched_fft` and
//! [`pulse_spectrum`] support the engine. `design`, `choose`, `band` and `single_echo` derive its sizes
//! from a tolerance.
#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;
mod band;
pub(crate) mod batched_fft;
mod choose;
pub mod cost_estimate;
mod design;
pub mod doppler;
mod evenly;
pub mod kernel;
pub(crate) mod lanes;
mod least_squares;
pub mod moments;
pub mod one_dimensional;
mod prepare;
pub mod pulse_spectrum;
mod single_echo;
pub mod transform;

pub use cost_estimate::CostEstimate;
pub use doppler::DopplerSpan;
pub use one_dimensional::{Gridded1d, Gridded1dWork, GriddedError};
pub(crate) use single_echo::Windows;
pub use single_echo::{LEVELS, level_of};

use rayon::prelude::*;

/// `count` values in order, by the threads of the current pool. Outside of a pool, as in a thread of low priority, the calling thread computes all.
pub fn shared_out<T: Send>(count: usize, of: impl Fn(usize) -> T + Sync) -> Vec<T> {
    match rayon::current_thread_index() {
        Some(_) => (0..count).into_par_iter().map(&of).collect(),
        None => (0..count).map(of).collect(),
    }
}
