//! What an engine foresees of its own cost, apart: machines differ in how fast they do either.

/// Nanoseconds of one core, rough.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct CostEstimate {
    /// What grows with the echoes.
    pub echoes_ns: f64,
    /// What grows with the record: grids, transforms, templates.
    pub grids_ns: f64,
}

impl CostEstimate {
    pub fn ms(&self) -> f64 {
        1e-6 * (self.echoes_ns + self.grids_ns)
    }
}
