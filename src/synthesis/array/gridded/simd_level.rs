//! Vector instruction sets of the inner loops, detected once per plan.

/// Proof that the processor supports a [`Kind`]; only the functions here create it.
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
