//! What is left to the plan of methods.

/// Which parts of a sonar's model the plan chooses; the rest is the operator's. What stands in their place in
/// [`ModelChoice`](echotank_core::flow::ModelChoice) is where a sonar starts whose motion is not known yet.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct AutoModel {
    /// The path model.
    pub path: bool,
    /// Of paths with segments, their length; goes with `path`.
    pub segment: bool,
    /// The Doppler model.
    pub doppler: bool,
    /// The synthesis method.
    pub synthesis: bool,
    /// The floor of the patterns, from the configuration's own downwards; goes with `synthesis`.
    pub cull: bool,
}

impl AutoModel {
    /// Whether any method is chosen automatically.
    pub fn any(&self) -> bool {
        self.path || self.doppler || self.synthesis
    }
}
