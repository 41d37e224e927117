//! Fast synthesis on a grid: a nonuniform Fourier transform per element.
//!
//! Read [`kernel`] (the idea), [`moments`] (the loops), [`transform`] (both joined), then [`one_dimensional`], the engine itself, with
//! [`doppler`], `evenly`, `batched_fft` and [`pulse_spectrum`] beside it; `design`, `choose`, `band` and `alone` turn a tolerance into sizes.
mod alone;
#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;
mod band;
mod batched_fft;
mod choose;
pub mod cost_estimate;
mod design;
pub mod doppler;
mod evenly;
pub mod kernel;
mod lanes;
mod least_squares;
pub mod moments;
pub mod one_dimensional;
mod prepare;
pub mod pulse_spectrum;
pub mod simd_level;
pub mod transform;

pub use cost_estimate::CostEstimate;
pub use doppler::DopplerSpan;
pub use one_dimensional::{Gridded1d, Gridded1dWork, GriddedError};
pub use simd_level::SimdLevel;
