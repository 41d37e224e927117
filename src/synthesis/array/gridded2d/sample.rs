//! The two kinds of numbers that grids and transforms are made of.

use echotank_fft::Planned;

use crate::array::gridded::simd_level::{Kind, SimdLevel};

use super::elements::Columns;
use super::pulse::Reading;
use super::spread::Wide;

/// The real numbers that grids and transforms are made of.
pub trait Sample: Planned + Default + Reading {
    const ZERO: Self;
    fn narrow(value: f64) -> Self;
    fn widen(self) -> f64;
    /// Whether [`Self::spread_wide`] is there.
    const WIDE: bool = false;
    /// Echoes of up to sixteen channels onto the grid, by a kernel of the processor's own; `simd_level` is proof that it has AVX-512. Returns
    /// how many lie outside.
    fn spread_wide(_: Wide<Self>, _simd_level: SimdLevel) -> usize {
        unreachable!("no kernel of that kind")
    }
    /// Whether [`Self::elements_wide`] takes so many powers.
    fn takes_wide(_powers: usize, _simd_level: SimdLevel) -> bool {
        false
    }
    /// Columns' powers into pairs of elements, likewise.
    fn elements_wide(_: Columns<Self>, _simd_level: SimdLevel) {
        unreachable!("no kernel of that kind")
    }
    /// self a + b, in one rounding where the processor has been asked for it.
    fn times_plus<const FUSED: bool>(self, a: Self, b: Self) -> Self;
}

impl Sample for f32 {
    const ZERO: Self = 0.0;
    #[cfg(target_arch = "x86_64")]
    const WIDE: bool = true;
    #[cfg(target_arch = "x86_64")]
    fn spread_wide(wide: Wide<Self>, simd_level: SimdLevel) -> usize {
        assert_eq!(simd_level.kind(), Kind::Avx512);
        // SAFETY: such a `SimdLevel` is proof that the processor has AVX-512 F, DQ and VL.
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
