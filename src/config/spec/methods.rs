//! Value of a method that is chosen automatically.

/// Parts of a sonar's model that the method selection chooses. Their values in
/// [`ModelChoice`](echotank_core::model::ModelChoice) is where a sonar starts whose motion is not known yet.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct AutoModel {
    /// The path model.
    pub path: bool,
    /// Segment length of the path; follows `path`.
    pub segment: bool,
    /// The Doppler model.
    pub doppler: bool,
    /// The synthesis method.
    pub synthesis: bool,
    /// The culling level; follows `synthesis`.
    pub cull: bool,
}

impl AutoModel {
    /// Whether any method is chosen automatically.
    pub fn any(&self) -> bool {
        self.path || self.doppler || self.synthesis
    }
}
