//! What becomes of pings that are too much for the machine.

use super::SonarSpec;

/// Each looser tolerance lies so many times above the one before, ...
const COARSER: f64 = 10.0;
/// ... up to the loosest that a configuration may ask for.
const LOOSEST: f64 = 0.1;

/// What becomes of pings that cannot be ready in time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum OverloadSpec {
    /// They are not made.
    Skip,
    /// They are made with a looser tolerance.
    Degrade,
    /// Pulses come later.
    Stretch,
}

impl OverloadSpec {
    /// Value of the key `run.overload`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Skip => "skip",
            Self::Degrade => "degrade",
            Self::Stretch => "stretch",
        }
    }
}

impl SonarSpec {
    /// Tolerances looser than its own, the next first; none where its synthesis keeps none, or the loosest already.
    pub fn looser_tolerances(&self) -> Vec<f64> {
        let keeps = self.model.synthesis.keeps_tolerance() || self.synthesis.auto.synthesis;
        let next =
            |tolerance: &f64| (*tolerance < LOOSEST).then(|| (COARSER * tolerance).min(LOOSEST));
        let first = Some(self.synthesis.tolerance).filter(|_| keeps);
        std::iter::successors(first, next).skip(1).collect()
    }
}
