//! Several real numbers that are processed together: vectors if the processor supports them, otherwise
//! arrays.

use num_complex::Complex;

/// Vector of real numbers. Every function is unsafe because the processor must support the vector type.
pub(crate) trait Lanes: Copy {
    type Number: Copy;
    const COUNT: usize;

    /// SAFETY: [`Self::COUNT`] numbers from `from` on must be readable.
    unsafe fn load(from: *const Self::Number) -> Self;
    /// SAFETY: [`Self::COUNT`] numbers from `to` on must be writable.
    unsafe fn store(self, to: *mut Self::Number);
    unsafe fn splat(number: Self::Number) -> Self;
    unsafe fn add(self, other: Self) -> Self;
    unsafe fn sub(self, other: Self) -> Self;
    unsafe fn mul(self, other: Self) -> Self;
    /// self times `factor`, plus `more`.
    unsafe fn mul_add(self, factor: Self, more: Self) -> Self;
    /// `more` minus self times `factor`.
    unsafe fn neg_mul_add(self, factor: Self, more: Self) -> Self;
    /// The larger of the two.
    unsafe fn max(self, other: Self) -> Self;
    /// self times `factor`, minus `less`.
    unsafe fn mul_sub(self, factor: Self, less: Self) -> Self;
    /// Sum over all lanes of `re` and of `im`.
    unsafe fn sums(re: Self, im: Self) -> Complex<Self::Number>;
}

/// Complex numbers with separate real and imaginary parts.
#[derive(Clone, Copy)]
pub(super) struct Pair<V> {
    pub re: V,
    pub im: V,
}

impl<V: Lanes> Pair<V> {
    /// SAFETY: as [`Lanes::load`], twice.
    #[inline(always)]
    pub(super) unsafe fn load(re: *const V::Number, im: *const V::Number) -> Self {
        // SAFETY: the caller guarantees it.
        unsafe {
            Self {
                re: V::load(re),
                im: V::load(im),
            }
        }
    }

    /// SAFETY: as [`Lanes::store`], twice.
    #[inline(always)]
    pub(super) unsafe fn store(self, re: *mut V::Number, im: *mut V::Number) {
        // SAFETY: the caller guarantees it.
        unsafe {
            self.re.store(re);
            self.im.store(im);
        }
    }

    /// SAFETY (to the end of this block): the processor must have `V`.
    #[inline(always)]
    pub(super) unsafe fn add(self, other: Self) -> Self {
        // SAFETY: the caller guarantees it.
        unsafe {
            Self {
                re: self.re.add(other.re),
                im: self.im.add(other.im),
            }
        }
    }

    #[inline(always)]
    pub(crate) unsafe fn sub(self, other: Self) -> Self {
        // SAFETY: the caller guarantees it.
        unsafe {
            Self {
                re: self.re.sub(other.re),
                im: self.im.sub(other.im),
            }
        }
    }

    /// self + j other
    #[inline(always)]
    pub(crate) unsafe fn add_turned(self, other: Self) -> Self {
        // SAFETY: the caller guarantees it.
        unsafe {
            Self {
                re: self.re.sub(other.im),
                im: self.im.add(other.re),
            }
        }
    }

    /// self - j other
    #[inline(always)]
    pub(crate) unsafe fn sub_turned(self, other: Self) -> Self {
        // SAFETY: the caller guarantees it.
        unsafe {
            Self {
                re: self.re.add(other.im),
                im: self.im.sub(other.re),
            }
        }
    }

    #[inline(always)]
    pub(super) unsafe fn scale(self, factor: V) -> Self {
        // SAFETY: the caller guarantees it.
        unsafe {
            Self {
                re: self.re.mul(factor),
                im: self.im.mul(factor),
            }
        }
    }

    /// self times the real `factor`, plus `more`.
    #[inline(always)]
    pub(crate) unsafe fn scale_add(self, factor: V, more: Self) -> Self {
        // SAFETY: the caller guarantees it.
        unsafe {
            Self {
                re: self.re.mul_add(factor, more.re),
                im: self.im.mul_add(factor, more.im),
            }
        }
    }

    #[inline(always)]
    pub(super) unsafe fn times(self, other: Self) -> Self {
        // SAFETY: the caller guarantees it.
        unsafe {
            Self {
                re: self.re.mul_sub(other.re, self.im.mul(other.im)),
                im: self.re.mul_add(other.im, self.im.mul(other.re)),
            }
        }
    }

    #[inline(always)]
    pub(super) unsafe fn splat(number: Complex<V::Number>) -> Self {
        // SAFETY: the caller guarantees it.
        unsafe {
            Self {
                re: V::splat(number.re),
                im: V::splat(number.im),
            }
        }
    }
}

macro_rules! plain {
    ($number:ty, $count:literal) => {
        impl Lanes for [$number; $count] {
            type Number = $number;
            const COUNT: usize = $count;

            #[inline(always)]
            unsafe fn load(from: *const $number) -> Self {
                // SAFETY: the caller guarantees the numbers.
                unsafe { from.cast::<Self>().read_unaligned() }
            }
            #[inline(always)]
            unsafe fn store(self, to: *mut $number) {
                // SAFETY: the caller guarantees the numbers.
                unsafe { to.cast::<Self>().write_unaligned(self) }
            }
            #[inline(always)]
            unsafe fn splat(number: $number) -> Self {
                [number; $count]
            }
            #[inline(always)]
            unsafe fn add(self, other: Self) -> Self {
                std::array::from_fn(|i| self[i] + other[i])
            }
            #[inline(always)]
            unsafe fn sub(self, other: Self) -> Self {
                std::array::from_fn(|i| self[i] - other[i])
            }
            #[inline(always)]
            unsafe fn mul(self, other: Self) -> Self {
                std::array::from_fn(|i| self[i] * other[i])
            }
            #[inline(always)]
            unsafe fn mul_add(self, factor: Self, more: Self) -> Self {
                std::array::from_fn(|i| self[i] * factor[i] + more[i])
            }
            #[inline(always)]
            unsafe fn neg_mul_add(self, factor: Self, more: Self) -> Self {
                std::array::from_fn(|i| more[i] - self[i] * factor[i])
            }
            #[inline(always)]
            unsafe fn max(self, other: Self) -> Self {
                std::array::from_fn(|i| self[i].max(other[i]))
            }
            #[inline(always)]
            unsafe fn mul_sub(self, factor: Self, less: Self) -> Self {
                std::array::from_fn(|i| self[i] * factor[i] - less[i])
            }
            #[inline(always)]
            unsafe fn sums(re: Self, im: Self) -> Complex<$number> {
                Complex::new(re.iter().sum(), im.iter().sum())
            }
        }
    };
}

plain!(f32, 8);
plain!(f64, 8);

#[cfg(target_arch = "x86_64")]
mod x86 {
    use super::Lanes;
    use num_complex::{Complex, Complex32, Complex64};
    use std::arch::x86_64::*;

    macro_rules! vector {
        ($vector:ty, $number:ty, $count:literal, $load:ident, $store:ident, $splat:ident, $add:ident, $sub:ident, $mul:ident, $mul_add:ident, $mul_sub:ident, $neg_mul_add:ident, $max:ident, $sums:ident) => {
            impl Lanes for $vector {
                type Number = $number;
                const COUNT: usize = $count;

                // SAFETY (of all): the caller guarantees the processor, and for the numbers behind pointers.
                #[inline(always)]
                unsafe fn load(from: *const $number) -> Self {
                    unsafe { $load(from) }
                }
                #[inline(always)]
                unsafe fn store(self, to: *mut $number) {
                    unsafe { $store(to, self) }
                }
                #[inline(always)]
                unsafe fn splat(number: $number) -> Self {
                    unsafe { $splat(number) }
                }
                #[inline(always)]
                unsafe fn add(self, other: Self) -> Self {
                    unsafe { $add(self, other) }
                }
                #[inline(always)]
                unsafe fn sub(self, other: Self) -> Self {
                    unsafe { $sub(self, other) }
                }
                #[inline(always)]
                unsafe fn mul(self, other: Self) -> Self {
                    unsafe { $mul(self, other) }
                }
                #[inline(always)]
                unsafe fn mul_add(self, factor: Self, more: Self) -> Self {
                    unsafe { $mul_add(self, factor, more) }
                }
                #[inline(always)]
                unsafe fn mul_sub(self, factor: Self, less: Self) -> Self {
                    unsafe { $mul_sub(self, factor, less) }
                }
                #[inline(always)]
                unsafe fn neg_mul_add(self, factor: Self, more: Self) -> Self {
                    unsafe { $neg_mul_add(self, factor, more) }
                }
                #[inline(always)]
                unsafe fn max(self, other: Self) -> Self {
                    unsafe { $max(self, other) }
                }
                #[inline(always)]
                unsafe fn sums(re: Self, im: Self) -> Complex<$number> {
                    unsafe { $sums(re, im) }
                }
            }
        };
    }

    // SAFETY (of the four): the processor must have the vectors.
    #[inline(always)]
    unsafe fn sums_512(re: __m512, im: __m512) -> Complex32 {
        unsafe {
            let half = |v: __m512| {
                let upper = _mm512_extractf32x8_ps::<1>(v);
                _mm256_add_ps(_mm512_castps512_ps256(v), upper)
            };
            sums_256(half(re), half(im))
        }
    }

    #[inline(always)]
    unsafe fn sums_256(re: __m256, im: __m256) -> Complex32 {
        unsafe {
            // Adds pairs of both inputs twice, then the halves.
            let pairs = _mm256_hadd_ps(re, im);
            let fours = _mm256_hadd_ps(pairs, pairs);
            let upper = _mm256_extractf128_ps::<1>(fours);
            let sum = _mm_add_ps(_mm256_castps256_ps128(fours), upper);
            Complex::new(_mm_cvtss_f32(sum), _mm_cvtss_f32(_mm_movehdup_ps(sum)))
        }
    }

    #[inline(always)]
    unsafe fn sums_512d(re: __m512d, im: __m512d) -> Complex64 {
        unsafe {
            let half = |v: __m512d| {
                let upper = _mm512_extractf64x4_pd::<1>(v);
                _mm256_add_pd(_mm512_castpd512_pd256(v), upper)
            };
            sums_256d(half(re), half(im))
        }
    }

    #[inline(always)]
    unsafe fn sums_256d(re: __m256d, im: __m256d) -> Complex64 {
        unsafe {
            let pairs = _mm256_hadd_pd(re, im);
            let upper = _mm256_extractf128_pd::<1>(pairs);
            let sum = _mm_add_pd(_mm256_castpd256_pd128(pairs), upper);
            Complex::new(_mm_cvtsd_f64(sum), _mm_cvtsd_f64(_mm_unpackhi_pd(sum, sum)))
        }
    }

    vector!(
        __m512,
        f32,
        16,
        _mm512_loadu_ps,
        _mm512_storeu_ps,
        _mm512_set1_ps,
        _mm512_add_ps,
        _mm512_sub_ps,
        _mm512_mul_ps,
        _mm512_fmadd_ps,
        _mm512_fmsub_ps,
        _mm512_fnmadd_ps,
        _mm512_max_ps,
        sums_512
    );
    vector!(
        __m256,
        f32,
        8,
        _mm256_loadu_ps,
        _mm256_storeu_ps,
        _mm256_set1_ps,
        _mm256_add_ps,
        _mm256_sub_ps,
        _mm256_mul_ps,
        _mm256_fmadd_ps,
        _mm256_fmsub_ps,
        _mm256_fnmadd_ps,
        _mm256_max_ps,
        sums_256
    );
    vector!(
        __m512d,
        f64,
        8,
        _mm512_loadu_pd,
        _mm512_storeu_pd,
        _mm512_set1_pd,
        _mm512_add_pd,
        _mm512_sub_pd,
        _mm512_mul_pd,
        _mm512_fmadd_pd,
        _mm512_fmsub_pd,
        _mm512_fnmadd_pd,
        _mm512_max_pd,
        sums_512d
    );
    vector!(
        __m256d,
        f64,
        4,
        _mm256_loadu_pd,
        _mm256_storeu_pd,
        _mm256_set1_pd,
        _mm256_add_pd,
        _mm256_sub_pd,
        _mm256_mul_pd,
        _mm256_fmadd_pd,
        _mm256_fmsub_pd,
        _mm256_fnmadd_pd,
        _mm256_max_pd,
        sums_256d
    );
}
