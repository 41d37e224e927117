//! Shadows of the legs by the sea surface, and by bottom and surface.
//!
//! A leg by the surface is straight from the mirror image of the sonar to the scatterer. Below the surface it is steeper than the direct line, so ground that
//! does not hide a scatterer from the sonar does not hide it from the image either. A scatterer that the sonar does not see is looked up in the horizon of the
//! image. Between the sonar and the surface a leg crosses ground only where that is shallower than the sonar.
//!
//! A leg by bottom and surface has three spans. Rays are cast along them, but for the last one where the sonar sees the scatterer: it is steeper than the direct
//! line. Ground within the patch whose mean plane reflects hides nothing.
//!
//! Solids hide along all spans.

use glam::DVec3;

use super::horizon::FIRST_M;
use super::{Occluders, Occlusion, SAME_EYE_M};
use crate::seabed::Surface;
use crate::targets::Targets;
use echotank_config::spec::OcclusionSpec;

/// Scatterers of the ground are rounded to some micrometres.
const ROUNDED_M: f64 = 1e-5;

/// What is known of a scatterer by the direct line.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DirectSight {
    /// The sonar sees it.
    Seen,
    /// The sonar does not see it, and it lies on the ground.
    HiddenGround,
    /// The sonar does not see it, and it stands above the ground or in it.
    HiddenObject,
}

/// Straight spans of a leg by bottom and surface: the sonar, the reflections at the bottom and at the surface, the scatterer; world, metres.
#[derive(Clone, Copy, Debug)]
pub struct BottomWay {
    /// The four places.
    pub places_m: [DVec3; 4],
    /// Half length of the patch of bottom that reflects, metres.
    pub patch_m: f64,
}

/// Shadows of reflected legs in the last ping that was gathered.
#[derive(Clone, Copy, Debug)]
pub struct LegShadows<'a> {
    pub(crate) occlusion: &'a Occlusion,
    pub(crate) ground: Option<&'a Surface>,
    pub(crate) targets: &'a Targets,
    pub(crate) anchor_m: DVec3,
    pub(crate) surface_m: f64,
}

impl Occlusion {
    /// Tests legs by a surface at this depth too, from the next ping on.
    pub(crate) fn reflect(&mut self, surface_m: f64) {
        self.surface_m = Some(surface_m);
    }

    /// Depth of the surface, if its legs are tested and something in this ping may hide a scatterer.
    pub(crate) fn reflecting_m(&self) -> Option<f64> {
        let hides = self.hilly || !self.solids.is_empty();
        self.surface_m
            .filter(|_| self.rule != OcclusionSpec::None && hides)
    }

    /// Whether any ground in the marked boxes is shallower than an eye.
    pub(super) fn has_shallow(&self, surface: &Surface) -> bool {
        let mut eyes = self.eyes_m.iter().zip(&self.horizons);
        eyes.any(|(eye_m, horizon)| {
            let (low_m, high_m) = horizon.marked_m();
            let bounds = surface.bounds_m((low_m.x, high_m.x), (low_m.y, high_m.y));
            bounds.is_some_and(|((shallowest_m, _), _)| shallowest_m < eye_m.z)
        })
    }
}

impl LegShadows<'_> {
    /// Whether the arrays of any footprint see a scatterer by the surface.
    pub fn by_surface(&self, at_m: DVec3, sight: DirectSight) -> bool {
        let at_m = at_m - self.anchor_m;
        let occlusion = self.occlusion;
        let around = Occluders {
            ground: self.ground,
            solids: None,
            on_ground: sight == DirectSight::HiddenGround,
        };
        let sees = |eye: usize| {
            let eye_m = occlusion.eyes_m[eye];
            let (up_m, down_m) = (eye_m.z - self.surface_m, at_m.z - self.surface_m);
            if up_m <= 0.0 || down_m <= 0.0 {
                return true;
            }
            let horizon = occlusion.horizons.get(occlusion.eyes_m.len() + eye);
            if sight != DirectSight::Seen && occlusion.ground_hides(horizon, at_m, around) {
                return false;
            }
            let mut bounce_m = eye_m.lerp(at_m, up_m / (up_m + down_m));
            bounce_m.z = self.surface_m;
            let behind_shallow = occlusion.shallow && self.ground_crosses([eye_m, bounce_m], 0.0);
            !behind_shallow && !self.solid_crosses([at_m, bounce_m, eye_m])
        };
        let mut pairs = occlusion.pairs.iter();
        pairs.any(|&(transmitter, receiver)| sees(transmitter) && sees(receiver))
    }

    /// Whether the sonar sees a scatterer by bottom and surface.
    pub fn by_bottom(&self, way: &BottomWay, sight: DirectSight) -> bool {
        let [sonar_m, bottom_m, surface_m, at_m] = way.places_m.map(|m| m - self.anchor_m);
        let patch_m = way.patch_m;
        let last = sight != DirectSight::Seen && self.ground_crosses([surface_m, at_m], 0.0);
        !last
            && !self.ground_crosses([sonar_m, bottom_m], patch_m)
            && !self.ground_crosses([surface_m, bottom_m], patch_m)
            && !self.solid_crosses([at_m, surface_m, bottom_m])
            && !self.solid_crosses([sonar_m, bottom_m, bottom_m])
    }

    /// Whether ground rises above a straight line, up to `short_m` before its end.
    fn ground_crosses(&self, [from_m, to_m]: [DVec3; 2], short_m: f64) -> bool {
        let Some(ground) = self.ground else {
            return false;
        };
        let offset_m = (to_m - from_m).truncate();
        let distance_m = offset_m.length();
        if distance_m < SAME_EYE_M {
            return false;
        }
        let line = (from_m.z - to_m.z + ROUNDED_M) / distance_m;
        let stretch_m = 0.0..distance_m - short_m;
        let mut crosses = false;
        let along = offset_m / distance_m;
        ground.profile(from_m.truncate(), along, stretch_m, |piece| {
            let first_m = piece.from_m.max(FIRST_M);
            crosses |= piece.to_m > first_m && piece.highest(from_m.z, first_m) > line;
        });
        crosses
    }

    /// Whether a solid stands in either of two spans.
    fn solid_crosses(&self, places_m: [DVec3; 3]) -> bool {
        let solids = &self.occlusion.solids;
        !solids.is_empty()
            && places_m.windows(2).any(|span| {
                let ray_m = span[1] - span[0];
                let length_m = ray_m.length();
                length_m > 0.0
                    && self
                        .targets
                        .hits(solids, span[0], ray_m / length_m, length_m)
            })
    }
}
