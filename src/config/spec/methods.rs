//! Methods of a sonar's model that are selected automatically.

/// Flags of the methods that the method selection chooses. The values of these methods in
/// [`ModelChoice`](echotank_core::model::ModelChoice) apply until the motion of the sonar is known.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct AutoModel {
    /// The path model.
    pub path: bool,
    /// The segment length of the path; selected if `path` is.
    pub segment: bool,
    /// The Doppler model.
    pub doppler: bool,
    /// The synthesis method.
    pub synthesis: bool,
}

impl AutoModel {
    /// Whether any method is chosen automatically.
    pub fn any(&self) -> bool {
        self.path || self.doppler || self.synthesis
    }
}
