//! The two precisions of grids and transforms.

use echotank_fft::Planned;

use echotank_core::simd::{Kind, SimdLevel};

use super::elements::Columns;
use super::pulse::Reading;
use super::spread::Wide;

/// Floating-point precision of grids and transforms.
pub trait Sample: Planned + Default + Reading {
    /// Zero.
    const ZERO: Self;
    /// Rounds to this precision.
    fn narrow(value: f64) -> Self;
    /// Converts to f64.
    fn widen(self) -> f64;
    /// Whether [`Self::spread_wide`] is implemented.
    const WIDE: bool = false;
    /// Spreads echoes of up to sixteen channels onto the grid with AVX-512; `simd_level` proves
    /// that the processor supports it. Returns the number of echoes outside the grid.
    fn spread_wide(_: Wide<Self>, _simd_level: SimdLevel) -> usize {
        unreachable!("no kernel of that kind")
    }
    /// Whether [`Self::elements_wide`] supports this number of powers.
    fn takes_wide(_powers: usize, _simd_level: SimdLevel) -> bool {
        false
    }
    /// Sums the columns' powers into pairs of elements with AVX-512.
    fn elements_wide(_: Columns<Self>, _simd_level: SimdLevel) {
        unreachable!("no kernel of that kind")
    }
    /// self a + b, with one rounding if `FUSED`.
    fn times_plus<const FUSED: bool>(self, a: Self, b: Self) -> Self;
}

impl Sample for f32 {
    const ZERO: Self = 0.0;
    #[cfg(target_arch = "x86_64")]
    const WIDE: bool = true;
    #[cfg(target_arch = "x86_64")]
    fn spread_wide(wide: Wide<Self>, simd_level: SimdLevel) -> usize {
        assert_eq!(simd_level.kind(), Kind::Avx512);
        // SAFETY: such a `SimdLevel` proves that the processor has AVX-512 F, DQ and VL.
        unsafe { super::spread_avx512::add(wide) }
    }
    #[cfg(target_arch = "x86_64")]
    fn takes_wide(powers: usize, simd_level: SimdLevel) -> bool {
        simd_level.kind() == Kind::Avx512 && super::elements_avx512::takes(powers)
    }
    #[cfg(target_arch = "x86_64")]
    fn elements_wide(columns: Columns<Self>, simd_level: SimdLevel) {
        assert_eq!(simd_level.kind(), Kind::Avx512);
        // SAFETY: as above.
        unsafe { super::elements_avx512::add(columns) }
    }
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
