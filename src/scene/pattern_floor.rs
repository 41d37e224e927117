//! How much louder than the ground points and targets are, so that the floor of the patterns is lowered for them by as much.
//!
//! The floor (`ModelChoice::cull_db`) is chosen for ground: scatterers alike all round, of which what lies below it is a known share of the energy. A
//! target may be left out only where its echo is weaker than that of one scatterer of the ground in the same range would be at the floor. A
//! resolution cell holds five of those or more, so that each target left out costs less than a fifth of the square of the floor, as a share of the
//! energy of the cell that it shares. Compared with the bottom's own strength at a low grazing angle, where most bottoms are weakest, not with a mosaic's.

use super::Scatterers;
use super::tiles::Recipe;

/// 5 degrees of grazing.
const LOW_INCIDENCE_DEG: f64 = 85.0;
/// 180 dB: louder than this there is no floor.
const LOUDEST: f64 = 1e9;

/// Pressure at 1 m of what the floor is good for.
#[derive(Clone, Copy, Debug)]
pub(crate) enum FloorReference {
    /// A scatterer of the ground stands for a square metre.
    Ground { per_root_m2: f64 },
    /// Without a ground: the explicit points, root mean square.
    Points { strength: f64 },
    /// With neither, all targets are loud.
    Nothing,
}

impl FloorReference {
    pub(crate) fn new(recipe: Option<&Recipe>, points: &Scatterers) -> Self {
        if let Some(recipe) = recipe {
            let power = recipe.bottom().strength(LOW_INCIDENCE_DEG.to_radians());
            let per_root_m2 = power.sqrt();
            return Self::Ground { per_root_m2 };
        }
        let energy: f64 = points.strength.iter().map(|s| s.norm_sqr()).sum();
        match energy > 0.0 {
            true => Self::Points {
                strength: (energy / points.len() as f64).sqrt(),
            },
            false => Self::Nothing,
        }
    }

    /// The factor for something of `strength` (pressure at 1 m) at a distance.
    pub(crate) fn factor(&self, strength: f64, recipe: Option<&Recipe>, distance_m: f64) -> f32 {
        let own = match *self {
            Self::Ground { per_root_m2 } => {
                per_root_m2 * recipe.map_or(0.0, |r| r.levels().spacing_m(distance_m))
            }
            Self::Points { strength } => strength,
            Self::Nothing => 0.0,
        };
        // No division by a silent ground.
        if strength >= own * LOUDEST {
            return LOUDEST as f32;
        }
        (strength / own).max(1.0) as f32
    }
}
