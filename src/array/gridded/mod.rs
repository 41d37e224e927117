//! Fast synthesis on a grid: a nonuniform Fourier transform per element.
//!
//! Read [`kernel`] (the idea), [`moments`] (the loops), [`transform`] (both joined), then [`one_dimensional`], the engine itself, with
//! [`doppler`], `evenly`, `abreast` and [`pulse_spectrum`] beside it; `design`, `choose`, `band` and `alone` turn a tolerance into sizes.
mod abreast;
mod alone;
#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;
mod band;
mod choose;
mod design;
pub mod dialect;
pub mod doppler;
mod evenly;
pub mod foreseen;
pub mod kernel;
mod lanes;
mod least_squares;
pub mod moments;
pub mod one_dimensional;
mod prepare;
pub mod pulse_spectrum;
pub mod transform;

pub use dialect::Dialect;
pub use doppler::DopplerSpan;
pub use foreseen::Foreseen;
pub use one_dimensional::{Gridded1d, Gridded1dWork, GriddedError};
