//! Fast synthesis on a grid.
#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;
pub mod dialect;
pub mod kernel;
mod least_squares;
pub mod moments;
pub mod transform;
