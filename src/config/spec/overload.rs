//! Action for pings that cannot be ready in time.

use super::SonarSpec;
use super::words::NamedChoice;

/// Factor between successive tolerances.
const COARSER: f64 = 10.0;
/// Maximum tolerance.
const LOOSEST: f64 = 0.1;

/// Action for pings that cannot be ready in time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum OverloadSpec {
    /// The pings are skipped.
    Skip,
    /// The pings are computed with a larger tolerance.
    Degrade,
    /// The pulses are delayed.
    Stretch,
}

impl OverloadSpec {
    /// Name in the configuration (`run.overload`).
    pub fn name(self) -> &'static str {
        self.word()
    }
}

impl SonarSpec {
    /// Tolerances above the sonar's own tolerance, in increasing order. Empty if the synthesis has no tolerance or the maximum
    /// tolerance.
    pub fn looser_tolerances(&self) -> Vec<f64> {
        let keeps = self.model.synthesis.keeps_tolerance() || self.synthesis.auto.synthesis;
        let next =
            |tolerance: &f64| (*tolerance < LOOSEST).then(|| (COARSER * tolerance).min(LOOSEST));
        let first = Some(self.synthesis.tolerance).filter(|_| keeps);
        std::iter::successors(first, next).skip(1).collect()
    }
}
