//! Which vector instructions the hot loops are written in: asked of the processor once per plan.

/// Proof that the processor has what [`Kind`] says; made only by the functions here.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SimdLevel(Kind);

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// No more than the compiler's own target.
    Portable,
    /// AVX2 and FMA.
    Avx2,
    /// AVX-512 F, DQ and VL.
    Avx512,
}

impl SimdLevel {
    pub const PORTABLE: Self = Self(Kind::Portable);

    /// The widest that this processor has.
    pub fn best() -> Self {
        Self::available().next_back().unwrap_or(Self::PORTABLE)
    }

    /// All that this processor has, from narrow to wide.
    pub fn available() -> impl DoubleEndedIterator<Item = Self> {
        [Kind::Portable, Kind::Avx2, Kind::Avx512]
            .into_iter()
            .filter(|kind| kind.present())
            .map(Self)
    }

    pub fn kind(self) -> Kind {
        self.0
    }
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
