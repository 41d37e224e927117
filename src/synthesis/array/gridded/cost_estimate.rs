//! Cost estimate of an engine in two parts. The speeds of the parts vary independently between
//! machines.

/// Approximate cost in nanoseconds of one core.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct CostEstimate {
    /// Part that grows with the number of echoes.
    pub echoes_ns: f64,
    /// Part that grows with the record: grids, transforms and templates.
    pub grids_ns: f64,
}

impl CostEstimate {
    /// Total cost, milliseconds of one core.
    pub fn ms(&self) -> f64 {
        1e-6 * (self.echoes_ns + self.grids_ns)
    }
}
