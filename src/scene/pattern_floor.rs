//! Level of points and targets relative to the seabed, which lowers the pattern floor for them by the same ratio.
//!
//! The floor (`ModelChoice::cull_db`) is chosen for the seabed, whose scatterers are alike in all directions. The energy below the floor is then a
//! known share of the total. A target may be culled only if its echo is weaker than that of one seabed scatterer at the same range and at the floor.
//! A resolution cell holds at least five such scatterers. Each culled target therefore costs less than a fifth of the squared floor, as a share of
//! the energy of its cell. The reference is the strength of the bottom itself at a low grazing angle, where most bottoms are weakest. A mosaic does
//! not enter.

use super::Scatterers;
use super::tiles::Recipe;

/// Incidence that corresponds to 5 degrees of grazing.
const LOW_INCIDENCE_DEG: f64 = 85.0;
/// Largest factor, 180 dB; above it nothing is culled.
const LOUDEST: f64 = 1e9;

/// Pressure at 1 m of the scatterers for which the floor is chosen.
#[derive(Clone, Copy, Debug)]
pub(crate) enum FloorReference {
    /// Seabed: pressure of one square metre; a scatterer stands for the square of the local spacing.
    Ground { per_root_m2: f64 },
    /// No seabed: root-mean-square pressure of the explicit points.
    Points { strength: f64 },
    /// Neither seabed nor points: no target is culled.
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

    /// Factor for a scatterer of `strength` (pressure at 1 m) at a distance.
    pub(crate) fn factor(&self, strength: f64, recipe: Option<&Recipe>, distance_m: f64) -> f32 {
        let own = match *self {
            Self::Ground { per_root_m2 } => {
                per_root_m2 * recipe.map_or(0.0, |r| r.levels().spacing_m(distance_m))
            }
            Self::Points { strength } => strength,
            Self::Nothing => 0.0,
        };
        // Avoids a division by zero strength of the seabed.
        if strength >= own * LOUDEST {
            return LOUDEST as f32;
        }
        (strength / own).max(1.0) as f32
    }
}
