//! What is left to the plan of methods.

/// Which parts of a sonar's model the plan chooses; the rest is the operator's. What stands in their place in
/// [`ModelChoice`](echotank_core::flow::ModelChoice) is where a sonar starts whose motion is not known yet.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct AutoModel {
    pub path: bool,
    /// Of paths with segments, their length; goes with `path`.
    pub segment: bool,
    pub doppler: bool,
    pub synthesis: bool,
    /// The floor of the patterns, from the configuration's own downwards; goes with `synthesis`.
    pub cull: bool,
}

impl AutoModel {
    pub fn any(&self) -> bool {
        self.path || self.doppler || self.synthesis
    }
}
