//! Occlusion: which scatterers the transmitter and the receiver see over the seabed and past solids.
//!
//! Rule `horizon`, for every array position (eye):
//! 1. Up to the distance where all ground faces the eye, nothing is hidden. [`Surface::turned_away`](super::seabed::Surface::turned_away) finds the bilinear squares that face away. Most seabeds need no further step.
//! 2. Rays scan the height field towards ground that faces away. The profile along a ray is a parabola in every square, so the ends of its shadows have a closed form. At the longest range the rays lie at most one scatterer spacing apart, or a 1024th of the range where the spacing is finer.
//! 3. Ground is seen or hidden if the rays on both sides agree. Where they differ, a ray is cast for the single scatterer.
//!
//! Compared with a ray cast for each scatterer, the edges of shadows are accurate to one spacing.
//!
//! Rule `paper`: Meng et al. 2023, Eq. 27 as printed, on the same rays. Ground is hidden if it lies lower in the view than the first ground, or than
//! the ground just before it. An obstacle has no effect once the ground behind it rises again.
//!
//! A point or target is seen if it stands above ground that is seen; otherwise a ray is cast. Solids hide by ray casting under either rule. Rays are
//! straight: refraction is not modelled.
//!
//! Legs by the sea surface have shadows of their own (`legs`): ground is tested from the mirror image of the eye above the surface, in the same way.
//!
//! Point sets without a height field, as in the simplification, use `simplify::shadow`.

mod horizon;
pub(crate) mod legs;

#[cfg(test)]
mod tests;

use std::f64::consts::SQRT_2;

use glam::DVec3;
use rayon::prelude::*;

use super::seabed::Surface;
use super::targets::Targets;
use super::targets::solid::Solid;
use super::tiles::TileBox;
use echotank_config::spec::OcclusionSpec;
use echotank_core::scene::Footprint;
use horizon::{Horizon, Visibility};

/// Eyes closer together than this are treated as one, metres.
const SAME_EYE_M: f64 = 1e-3;

/// A point at most this far below the ground counts as lying on it, metres.
const ON_GROUND_M: f64 = 1e-4;

/// Ropes of up to this many vertices are tested link by link before each tile.
const MAX_VERTICES: usize = 8;

/// Objects that may hide a point.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Occluders<'a> {
    pub ground: Option<&'a Surface>,
    pub solids: Option<&'a Targets>,
    /// The point is a scatterer of the seabed.
    pub(crate) on_ground: bool,
}

/// Shadows of one ping, in scene coordinates.
#[derive(Debug)]
pub(crate) struct Occlusion {
    rule: OcclusionSpec,
    eyes_m: Vec<DVec3>,
    /// One for each eye, over a seabed that can hide something; then one for the mirror image of each, where a surface reflects.
    horizons: Vec<Horizon>,
    /// Depth of the surface that reflects, metres.
    surface_m: Option<f64>,
    /// Some ground in range is shallower than an eye, which it may hide from the surface.
    shallow: bool,
    /// Indices of the transmitter's and the receiver's eye of each footprint.
    pairs: Vec<(usize, usize)>,
    /// Solid targets near enough to hide a scatterer in range.
    solids: Vec<usize>,
    hilly: bool,
}

impl Occlusion {
    pub(crate) fn new(rule: OcclusionSpec) -> Self {
        Self {
            rule,
            eyes_m: Vec::new(),
            horizons: Vec::new(),
            surface_m: None,
            shallow: false,
            pairs: Vec::new(),
            solids: Vec::new(),
            hilly: false,
        }
    }

    /// Starts a ping. `spacing_m` is the spacing of scatterers at the longest range, or none where the seabed cannot hide anything.
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
        // Reserved for all targets, so that no later ping allocates.
        self.solids.reserve(targets.len());
        self.solids.extend((0..targets.len()).filter(|&target| {
            let (center_m, radius_m) = targets.ball_m(target);
            // Twice the range: a scatterer that the transmitter insonifies may lie beyond the receiver's range, but never that far.
            let near = |eye_m: &DVec3| eye_m.distance(center_m) <= 2.0 * longest_m + radius_m;
            targets.solid(target).is_some() && eyes_m.iter().any(near)
        }));
        if let Some(spacing_m) = spacing_m {
            let used = self.used_horizons();
            if self.horizons.len() < used {
                self.horizons.resize_with(used, Horizon::default);
            }
            let images = self.surface_m.into_iter().flat_map(|surface_m| {
                let mirrored = move |eye_m: &DVec3| mirrored(*eye_m, surface_m);
                self.eyes_m.iter().map(mirrored)
            });
            let eyes_m = self.eyes_m.iter().copied().chain(images);
            for (horizon, eye_m) in self.horizons.iter_mut().zip(eyes_m) {
                horizon.start(eye_m, longest_m, spacing_m);
            }
        }
    }

    /// Number of horizons of the ping.
    fn used_horizons(&self) -> usize {
        self.eyes_m.len() * (1 + usize::from(self.surface_m.is_some()))
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

    /// Announces that points in a box will be tested.
    pub(crate) fn mark(&mut self, low_m: DVec3, high_m: DVec3) {
        if self.rule == OcclusionSpec::None || !self.hilly {
            return;
        }
        let used = self.used_horizons();
        for horizon in &mut self.horizons[..used] {
            horizon.mark(low_m.truncate(), high_m.truncate());
        }
    }

    /// Scans the ground in front of all marked boxes.
    pub(crate) fn scan(&mut self, surface: &Surface) {
        if self.rule == OcclusionSpec::None || !self.hilly {
            return;
        }
        let used = self.used_horizons();
        let horizons = &mut self.horizons[..used];
        horizons.par_iter_mut().for_each(|h| h.clear(surface));
        for horizon in horizons {
            horizon.scan(surface, self.rule);
        }
        self.shallow = self.surface_m.is_some() && self.has_shallow(surface);
    }

    /// The ground, if it may hide ground in a marked box.
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

    /// Whether both the transmitter and the receiver of a footprint see a point.
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
            let horizon = self.horizons.get(eye);
            !self.ground_hides(horizon, at_m, around) && !self.solid_hides(eye, at_m, around)
        })
    }

    #[inline(always)]
    fn ground_hides(&self, horizon: Option<&Horizon>, at_m: DVec3, around: Occluders) -> bool {
        let (Some(ground), Some(horizon)) = (around.ground.filter(|_| self.hilly), horizon) else {
            return false;
        };
        let (visibility, nearer) = horizon.visibility(at_m.truncate());
        if self.rule == OcclusionSpec::Paper {
            return nearer == Visibility::Hidden;
        }
        match visibility {
            Visibility::Seen if around.on_ground => false,
            Visibility::Hidden if around.on_ground => true,
            // A point above ground that is seen is seen.
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

    /// The solids, if any of them may stand between an eye and a tile.
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
            // The cone from the eye to the tile is nowhere wider than the tile.
            let axis_m = [*eye_m, middle_m];
            let in_cone = |way_m: [DVec3; 2], wide_m: f64| {
                distance_m(axis_m, way_m) <= wide_m + radius_m * SQRT_2
            };
            in_cone([center_m; 2], solid_m)
                && match solids.solid(solid) {
                    Some(Solid::Rope {
                        vertices_m,
                        radius_m,
                    }) if vertices_m.len() <= MAX_VERTICES => vertices_m
                        .windows(2)
                        .any(|link| in_cone([link[0], link[1]], *radius_m)),
                    _ => true,
                }
        };
        let any = self
            .solids
            .iter()
            .any(|&k| self.eyes_m.iter().any(|eye_m| near(eye_m, k)));
        any.then_some(solids)
    }
}

/// Distance between two line segments, given by their ends (Ericson 2005, Real-Time Collision Detection, 5.1.9).
fn distance_m(a: [DVec3; 2], b: [DVec3; 2]) -> f64 {
    let (along_a, along_b, apart) = (a[1] - a[0], b[1] - b[0], a[0] - b[0]);
    let share = |dot: f64, squared: f64| (dot / squared.max(f64::MIN_POSITIVE)).clamp(0.0, 1.0);
    let (aa, bb) = (along_a.length_squared(), along_b.length_squared());
    let (ab, a_apart, b_apart) = (along_a.dot(along_b), along_a.dot(apart), along_b.dot(apart));
    // Nearest points of the two lines; any point of the first where they are parallel.
    let on_a = share(ab * b_apart - a_apart * bb, aa * bb - ab * ab);
    let on_b = share(ab * on_a + b_apart, bb);
    let on_a = share(ab * on_b - a_apart, aa);
    (a[0] + along_a * on_a).distance(b[0] + along_b * on_b)
}

/// The mirror image of a place at the surface.
fn mirrored(at_m: DVec3, surface_m: f64) -> DVec3 {
    DVec3::new(at_m.x, at_m.y, 2.0 * surface_m - at_m.z)
}

fn is_above(ground: &Surface, at_m: DVec3) -> bool {
    let below = ground.sample(at_m.x, at_m.y);
    below.is_some_and(|g| at_m.z <= g.down_m + ON_GROUND_M)
}
