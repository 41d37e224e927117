//! The two kinds of numbers that grids and transforms are made of.

use echotank_fft::Planned;

use super::pulse::Reading;

/// The real numbers that grids and transforms are made of.
pub trait Sample: Planned + Default + Reading {
    const ZERO: Self;
    fn narrow(value: f64) -> Self;
    fn widen(self) -> f64;
    /// self a + b, in one rounding where the processor has been asked for it.
    fn times_plus<const FUSED: bool>(self, a: Self, b: Self) -> Self;
}

impl Sample for f32 {
    const ZERO: Self = 0.0;
    fn narrow(value: f64) -> Self {
        value as f32
    }
    fn widen(self) -> f64 {
        self.into()
    }
    #[inline(always)]
    fn times_plus<const FUSED: bool>(self, a: Self, b: Self) -> Self {
        if FUSED {
            self.mul_add(a, b)
        } else {
            self * a + b
        }
    }
}

impl Sample for f64 {
    const ZERO: Self = 0.0;
    fn narrow(value: f64) -> Self {
        value
    }
    fn widen(self) -> f64 {
        self
    }
    #[inline(always)]
    fn times_plus<const FUSED: bool>(self, a: Self, b: Self) -> Self {
        if FUSED {
            self.mul_add(a, b)
        } else {
            self * a + b
        }
    }
}
