//! Plans of `rustfft`, in a crate of their own only so that they are compiled once: `rustfft` is generic, so every crate that asks its planner
//! for a plan compiles all of its kernels again (a minute for the library, and again for each test and example).

#![warn(missing_docs)]
#![cfg_attr(not(test), deny(clippy::disallowed_methods))]

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

pub use rustfft::{Fft, FftNum};
use rustfft::{FftDirection, FftPlanner};

/// The numbers that have plans.
pub trait Planned: FftNum {
    /// `out[k] = sum_n in[n] exp(-j 2pi k n / size)`, unscaled.
    fn plan_forward(size: usize) -> Arc<dyn Fft<Self>>;
    /// `out[k] = sum_n in[n] exp(+j 2pi k n / size)`, unscaled.
    fn plan_inverse(size: usize) -> Arc<dyn Fft<Self>>;
}

/// Plans kept for the next who asks. Twiddle factors of a long plan take longer to compute than its transform.
const KEPT: usize = 16;

/// The plans used last, the latest first.
type Plans<T> = Mutex<Vec<Arc<dyn Fft<T>>>>;

static PLANS_F32: Plans<f32> = Mutex::new(Vec::new());
static PLANS_F64: Plans<f64> = Mutex::new(Vec::new());

/// Plans are complete when they are inserted, so a poisoned lock is ignored.
fn lock<T>(plans: &Plans<T>) -> MutexGuard<'_, Vec<Arc<dyn Fft<T>>>> {
    plans.lock().unwrap_or_else(PoisonError::into_inner)
}

fn plan<T: FftNum>(plans: &Plans<T>, size: usize, direction: FftDirection) -> Arc<dyn Fft<T>> {
    let is_it = |plan: &Arc<dyn Fft<T>>| plan.len() == size && plan.fft_direction() == direction;
    {
        let mut kept = lock(plans);
        if let Some(at) = kept.iter().position(is_it) {
            kept[..=at].rotate_right(1);
            return kept[0].clone();
        }
    }
    // Made without the lock: it takes milliseconds, and a second one of the same is no harm.
    let made = FftPlanner::new().plan_fft(size, direction);
    let mut kept = lock(plans);
    kept.insert(0, made.clone());
    kept.truncate(KEPT);
    made
}

impl Planned for f32 {
    fn plan_forward(size: usize) -> Arc<dyn Fft<f32>> {
        plan(&PLANS_F32, size, FftDirection::Forward)
    }
    fn plan_inverse(size: usize) -> Arc<dyn Fft<f32>> {
        plan(&PLANS_F32, size, FftDirection::Inverse)
    }
}

impl Planned for f64 {
    fn plan_forward(size: usize) -> Arc<dyn Fft<f64>> {
        plan(&PLANS_F64, size, FftDirection::Forward)
    }
    fn plan_inverse(size: usize) -> Arc<dyn Fft<f64>> {
        plan(&PLANS_F64, size, FftDirection::Inverse)
    }
}
