//! Points on the surfaces of solids.

use glam::DVec3;

/// Least distance of an intersection from the start of a ray, metres. It prevents a scatterer from shadowing itself by rounding.
pub(crate) const SKIN_M: f64 = 1e-6;

/// A point on a surface with its normal.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct SurfacePoint {
    pub position_m: DVec3,
    /// Unit vector, outward.
    pub normal: DVec3,
}
