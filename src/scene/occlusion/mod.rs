//! Shadows: which scatterers transmitter and receiver can see over the seabed and past the solids in the water.
//!
//! `horizon`, for every eye (each array's place):
//! 1. As far out as all ground faces the eye nothing of it is hidden, and the bilinear surface says exactly which of its squares do
//!    ([`Surface::turned_away`](super::seabed::Surface::turned_away)). On most seabeds that is all there is to do.
//! 2. Towards ground that is turned away, rays run out over the height field. The profile along a ray is a parabola in every square, so that
//!    its shadows' beginnings and ends are known in closed form. Rays lie a scatterer's spacing apart or closer at the longest range (or a
//!    1024th of it where the spacing is finer).
//! 3. Ground is seen or hidden where the rays on both sides say so. Where they differ, a ray is cast for the scatterer alone.
//!
//! Against a ray cast for each scatterer, shadows so end within one spacing of the right place.
//!
//! `paper`: Meng et al. 2023, Eq. 27 as printed, on the same rays: hidden is what lies below the first ground in the view, or below that just
//! before it. It forgets an obstacle as soon as the ground behind it rises again.
//!
//! What is not ground (points, targets) is seen where the ground below it is, and otherwise has a ray cast. Solids hide by ray casting,
//! under either rule. Straight rays: refraction is not modelled.
//!
//! Not for points without a height field, as the simplifiers have them: see `simplify::shadow`.

mod horizon;
mod piece;

#[cfg(test)]
mod tests;

use std::f64::consts::SQRT_2;

use glam::DVec3;
use rayon::prelude::*;

use super::seabed::Surface;
use super::targets::Targets;
use super::tiles::TileBox;
use echotank_config::spec::OcclusionSpec;
use echotank_core::flow::Footprint;
use horizon::{Horizon, Visibility};
pub(crate) use piece::Piece;

/// Eyes closer together than this are one, metres.
const SAME_EYE_M: f64 = 1e-3;

/// What lies no deeper below the ground than this lies on it, metres.
const ON_GROUND_M: f64 = 1e-4;

/// What may hide a point.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Occluders<'a> {
    pub ground: Option<&'a Surface>,
    pub solids: Option<&'a Targets>,
    /// The point is one of the ground's own.
    pub(crate) on_ground: bool,
}

/// The shadows of one ping. Coordinates are the scene's own.
#[derive(Debug)]
pub(crate) struct Occlusion {
    rule: OcclusionSpec,
    eyes_m: Vec<DVec3>,
    /// One per eye, over a seabed that can hide something.
    horizons: Vec<Horizon>,
    /// Of each footprint: the transmitter's eye and the receiver's.
    pairs: Vec<(usize, usize)>,
    /// Targets that are solid and near enough to hide something that is heard.
    solids: Vec<usize>,
    hilly: bool,
}

impl Occlusion {
    pub(crate) fn new(rule: OcclusionSpec) -> Self {
        Self {
            rule,
            eyes_m: Vec::new(),
            horizons: Vec::new(),
            pairs: Vec::new(),
            solids: Vec::new(),
            hilly: false,
        }
    }

    /// A new ping. `spacing_m`: between scatterers at the longest range; none where there is no seabed that could hide anything.
    pub(crate) fn start(
        &mut self,
        footprints: &[Footprint],
        anchor_m: DVec3,
        spacing_m: Option<f64>,
        targets: &Targets,
    ) {
        self.eyes_m.clear();
        self.pairs.clear();
        self.solids.clear();
        if self.rule == OcclusionSpec::None {
            return;
        }
        for f in footprints {
            let pair = [f.apex_m, f.receiver_m].map(|eye_m| self.eye(eye_m - anchor_m));
            self.pairs.push((pair[0], pair[1]));
        }
        self.hilly = spacing_m.is_some();
        let longest_m = footprints.iter().map(|f| f.max_range_m).fold(1.0, f64::max);
        let eyes_m = &self.eyes_m;
        // For all, so that no later ping allocates.
        self.solids.reserve(targets.len());
        self.solids.extend((0..targets.len()).filter(|&target| {
            let (center_m, radius_m) = targets.ball_m(target);
            // Twice: what a transmitter lights may lie beyond a receiver's range, never that far.
            let near = |eye_m: &DVec3| eye_m.distance(center_m) <= 2.0 * longest_m + radius_m;
            targets.solid(target).is_some() && eyes_m.iter().any(near)
        }));
        if let Some(spacing_m) = spacing_m {
            if self.horizons.len() < self.eyes_m.len() {
                self.horizons
                    .resize_with(self.eyes_m.len(), Horizon::default);
            }
            for (horizon, eye_m) in self.horizons.iter_mut().zip(&self.eyes_m) {
                horizon.start(*eye_m, longest_m, spacing_m);
            }
        }
    }

    fn eye(&mut self, eye_m: DVec3) -> usize {
        let known = self
            .eyes_m
            .iter()
            .position(|e| e.distance(eye_m) < SAME_EYE_M);
        known.unwrap_or_else(|| {
            self.eyes_m.push(eye_m);
            self.eyes_m.len() - 1
        })
    }

    /// Something in this box will be looked at.
    pub(crate) fn mark(&mut self, low_m: DVec3, high_m: DVec3) {
        if self.rule == OcclusionSpec::None || !self.hilly {
            return;
        }
        for horizon in &mut self.horizons[..self.eyes_m.len()] {
            horizon.mark(low_m.truncate(), high_m.truncate());
        }
    }

    /// Looks over the ground before everything that was marked.
    pub(crate) fn scan(&mut self, surface: &Surface) {
        if self.rule == OcclusionSpec::None || !self.hilly {
            return;
        }
        let horizons = &mut self.horizons[..self.eyes_m.len()];
        horizons.par_iter_mut().for_each(|h| h.clear(surface));
        for horizon in horizons {
            horizon.scan(surface, self.rule);
        }
    }

    /// The ground, where it may hide some of the ground in a box that was marked.
    pub(crate) fn ground_before<'a>(
        &self,
        tile: &TileBox,
        ground: &'a Surface,
    ) -> Option<&'a Surface> {
        if self.pairs.is_empty() || !self.hilly {
            return None;
        }
        let (low_m, high_m) = (tile.low_m.truncate(), tile.high_m.truncate());
        let mut horizons = self.horizons[..self.eyes_m.len()].iter();
        (!horizons.all(|h| h.is_clear(low_m, high_m))).then_some(ground)
    }

    /// Whether nothing hides a point from transmitter and receiver of a footprint.
    #[inline(always)]
    pub(crate) fn sees(&self, footprint: usize, at_m: DVec3, around: Occluders) -> bool {
        let Some(&(transmitter, receiver)) = self.pairs.get(footprint) else {
            return true;
        };
        let both = [transmitter, receiver];
        let eyes = if transmitter == receiver {
            &both[..1]
        } else {
            &both[..]
        };
        eyes.iter().all(|&eye| {
            !self.ground_hides(eye, at_m, around) && !self.solid_hides(eye, at_m, around)
        })
    }

    #[inline(always)]
    fn ground_hides(&self, eye: usize, at_m: DVec3, around: Occluders) -> bool {
        let Some(ground) = around.ground.filter(|_| self.hilly) else {
            return false;
        };
        let horizon = &self.horizons[eye];
        let (visibility, nearer) = horizon.visibility(at_m.truncate());
        if self.rule == OcclusionSpec::Paper {
            return nearer == Visibility::Hidden;
        }
        match visibility {
            Visibility::Seen if around.on_ground => false,
            Visibility::Hidden if around.on_ground => true,
            // What stands over ground that is seen is seen.
            Visibility::Seen if is_above(ground, at_m) => false,
            _ => horizon.cast_hides(ground, at_m),
        }
    }

    fn solid_hides(&self, eye: usize, at_m: DVec3, around: Occluders) -> bool {
        around.solids.is_some_and(|solids| {
            let ray_m = self.eyes_m[eye] - at_m;
            let distance_m = ray_m.length();
            solids.hits(&self.solids, at_m, ray_m / distance_m, distance_m)
        })
    }

    /// The solids, where any of them may stand between an eye and a tile.
    pub(crate) fn solids_before<'a>(
        &self,
        tile: &TileBox,
        solids: &'a Targets,
    ) -> Option<&'a Targets> {
        if self.pairs.is_empty() {
            return None;
        }
        let middle_m = (tile.low_m + tile.high_m) / 2.0;
        let radius_m = tile.low_m.distance(tile.high_m) / 2.0;
        let near = |eye_m: &DVec3, solid: usize| {
            let (center_m, solid_m) = solids.ball_m(solid);
            let way_m = middle_m - *eye_m;
            let share = (center_m - *eye_m).dot(way_m) / way_m.length_squared().max(1e-12);
            let nearest_m = *eye_m + way_m * share.clamp(0.0, 1.0);
            // The cone from the eye to the tile is nowhere wider than the tile.
            nearest_m.distance(center_m) <= solid_m + radius_m * SQRT_2
        };
        let any = self
            .solids
            .iter()
            .any(|&k| self.eyes_m.iter().any(|eye_m| near(eye_m, k)));
        any.then_some(solids)
    }
}

fn is_above(ground: &Surface, at_m: DVec3) -> bool {
    let below = ground.sample(at_m.x, at_m.y);
    below.is_some_and(|g| at_m.z <= g.down_m + ON_GROUND_M)
}
