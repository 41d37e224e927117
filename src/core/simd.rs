//! Vector instruction sets of the inner loops.

/// Proof that the processor supports a [`Kind`]. Only the functions of this module create one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SimdLevel(Kind);

/// Instruction set of the inner loops.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// The instruction set of the compiler's target.
    Portable,
    /// AVX2 and FMA.
    Avx2,
    /// AVX-512 F, DQ and VL.
    Avx512,
}

impl SimdLevel {
    /// The level that every processor supports.
    pub const PORTABLE: Self = Self(Kind::Portable);

    /// The widest level of this processor.
    pub fn best() -> Self {
        Self::available().next_back().unwrap_or(Self::PORTABLE)
    }

    /// All levels of this processor, from narrow to wide.
    pub fn available() -> impl DoubleEndedIterator<Item = Self> {
        [Kind::Portable, Kind::Avx2, Kind::Avx512]
            .into_iter()
            .filter(|kind| kind.present())
            .map(Self)
    }

    /// The instruction set that this level proves.
    pub fn kind(self) -> Kind {
        self.0
    }

    /// Runs `work` compiled for this level. The arithmetic and its order are the same at every level, so the results are the same
    /// bits.
    ///
    /// A wider build requires that `work` is inlined: a closure marked `#[inline(always)]` that calls only functions with the same
    /// mark.
    #[inline]
    pub fn run<R>(self, work: impl FnOnce() -> R) -> R {
        #[cfg(target_arch = "x86_64")]
        match self.0 {
            Kind::Portable => {}
            // SAFETY: a `SimdLevel` proves that the processor has the features.
            Kind::Avx2 => return unsafe { avx2(work) },
            // SAFETY: as above.
            Kind::Avx512 => return unsafe { avx512(work) },
        }
        work()
    }
}

/// Runs `work` compiled for the widest level of this processor; see [`SimdLevel::run`].
#[inline]
pub fn widest<R>(work: impl FnOnce() -> R) -> R {
    SimdLevel::best().run(work)
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
fn avx2<R>(work: impl FnOnce() -> R) -> R {
    work()
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512dq,avx512vl")]
fn avx512<R>(work: impl FnOnce() -> R) -> R {
    work()
}

impl Kind {
    #[cfg(target_arch = "x86_64")]
    fn present(self) -> bool {
        match self {
            Self::Portable => true,
            Self::Avx2 => is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma"),
            Self::Avx512 => {
                is_x86_feature_detected!("avx512f")
                    && is_x86_feature_detected!("avx512dq")
                    && is_x86_feature_detected!("avx512vl")
            }
        }
    }

    #[cfg(not(target_arch = "x86_64"))]
    fn present(self) -> bool {
        self == Self::Portable
    }
}
