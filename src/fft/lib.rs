//! Plans of `rustfft`, in a crate of their own only so that they are compiled once: `rustfft` is generic, so every crate that asks its planner
//! for a plan compiles all of its kernels again (a minute for the library, and again for each test and example).

#![warn(missing_docs)]
#![cfg_attr(not(test), deny(clippy::disallowed_methods))]

use std::sync::Arc;

use rustfft::FftPlanner;
pub use rustfft::{Fft, FftNum};

/// The numbers that have plans.
pub trait Planned: FftNum {
    /// `out[k] = sum_n in[n] exp(-j 2pi k n / size)`, unscaled.
    fn plan_forward(size: usize) -> Arc<dyn Fft<Self>>;
    /// `out[k] = sum_n in[n] exp(+j 2pi k n / size)`, unscaled.
    fn plan_inverse(size: usize) -> Arc<dyn Fft<Self>>;
}

impl Planned for f32 {
    fn plan_forward(size: usize) -> Arc<dyn Fft<f32>> {
        FftPlanner::new().plan_fft_forward(size)
    }
    fn plan_inverse(size: usize) -> Arc<dyn Fft<f32>> {
        FftPlanner::new().plan_fft_inverse(size)
    }
}

impl Planned for f64 {
    fn plan_forward(size: usize) -> Arc<dyn Fft<f64>> {
        FftPlanner::new().plan_fft_forward(size)
    }
    fn plan_inverse(size: usize) -> Arc<dyn Fft<f64>> {
        FftPlanner::new().plan_fft_inverse(size)
    }
}
