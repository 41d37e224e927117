//! Action for pings that cannot be ready in time.

use super::SonarSpec;
use super::words::Words;

/// Factor between successive tolerances.
const COARSER: f64 = 10.0;
/// The loosest tolerance.
const LOOSEST: f64 = 0.1;

/// Action for pings that cannot be ready in time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum OverloadSpec {
    /// They are left out.
    Skip,
    /// They are computed with a looser tolerance.
    Degrade,
    /// Pulses are delayed.
    Stretch,
}

impl OverloadSpec {
    /// Value of the key `run.overload`.
    pub fn name(self) -> &'static str {
        self.word()
    }
}

impl SonarSpec {
    /// Tolerances looser than the sonar's own, in rising order; empty if its synthesis has no tolerance or the loosest.
    pub fn looser_tolerances(&self) -> Vec<f64> {
        let keeps = self.model.synthesis.keeps_tolerance() || self.synthesis.auto.synthesis;
        let next =
            |tolerance: &f64| (*tolerance < LOOSEST).then(|| (COARSER * tolerance).min(LOOSEST));
        let first = Some(self.synthesis.tolerance).filter(|_| keeps);
        std::iter::successors(first, next).skip(1).collect()
    }
}
