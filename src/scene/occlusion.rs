//! Shadows: which scatterers transmitter and receiver can see over the seabed and past the solids in the water.
//!
//! `horizon`: around every eye (each array's place) rays run out over the height field, and along each the greatest tangent of elevation so
//! far is kept over the distance; a point is hidden where it lies below that. The surface is bilinear, so its profile along a ray is a parabola
//! in every cell, whose highest tangent is known in closed form: nothing between samples is missed. Rays lie a scatterer's spacing apart or
//! closer and the horizon between two of them is theirs in proportion; distances are kept in steps of half a spacing, and the horizon of a point
//! ends one step before it: against a ray cast for each scatterer, shadows end within one spacing of the right place, or within a
//! 1024th of the longest range where the spacing is finer.
//!
//! Where a point lies closer to its horizon than the ground may do between two rays, a ray is cast for it alone.
//!
//! `paper`: Meng et al. 2023, Eq. 27 as printed, on the same rays: hidden is what lies below the first step or below the step before it. It
//! forgets an obstacle as soon as the ground behind it rises again.
//!
//! Solids hide by ray casting, under either rule. Straight rays: refraction is not modelled.

use std::f64::consts::SQRT_2;

use glam::{DVec2, DVec3};
use rayon::prelude::*;

use super::seabed::Surface;
use super::targets::Targets;
use super::tiles::TileBox;
use crate::config::spec::OcclusionSpec;
use crate::flow::Footprint;

/// At the longest range, where the rays are widest and the steps longest.
const RAYS_TO_A_SPACING: usize = 1;
const STEPS_TO_A_SPACING: usize = 2;
/// Rays that are run together, because something may be looked at along any of them.
const SECTOR: usize = 16;
/// Spacings in the longest range at most: half a circle of rays then takes some 70 MB an eye.
const MOST_SPACINGS: f64 = 1024.0;
/// Below the horizon of nothing at all.
const OPEN: f32 = -1e9;
/// Nearer than this there is nothing that could hide anything, metres.
const FIRST_M: f64 = 1e-3;
/// Eyes closer together than this are one, metres.
const SAME_EYE_M: f64 = 1e-3;

const UNUSED: u32 = u32::MAX;

/// Where the horizontal direction (north, east) lies on the way round: 0 to 4, growing with the azimuth, without a trigonometric function.
#[inline(always)]
fn turn(d: DVec2) -> f64 {
    let sum = d.x.abs() + d.y.abs();
    let share = d.y / sum.max(f64::MIN_POSITIVE);
    match (d.x >= 0.0, d.y >= 0.0) {
        (true, true) => share,
        (false, _) => 2.0 - share,
        (true, false) => 4.0 + share,
    }
}

/// The direction that lies there.
fn direction(turn: f64) -> DVec2 {
    let quarter = turn.rem_euclid(4.0);
    let d = match quarter {
        q if q < 1.0 => DVec2::new(1.0 - q, q),
        q if q < 2.0 => DVec2::new(1.0 - q, 2.0 - q),
        q if q < 3.0 => DVec2::new(q - 3.0, 2.0 - q),
        q => DVec2::new(q - 3.0, q - 4.0),
    };
    d.normalize()
}

/// What one eye sees over the seabed. Coordinates are the scene's own.
#[derive(Debug, Default)]
struct Horizon {
    eye_m: DVec3,
    /// Rays in the full circle, a multiple of 4.
    rays: usize,
    /// Steps of a ray, and steps per root of a metre: step k lies at (k / per_root)^2 metres, as densely as the scatterers of an
    /// automatic density.
    steps: usize,
    per_root: f64,
    /// How far the rays of each sector are needed, metres; 0 where they are not.
    reach_m: Vec<f32>,
    /// Which rows of `tangents` are the sector's, in sectors.
    place: Vec<u32>,
    used: Vec<u32>,
    /// Row after row: the horizon at the steps of a ray.
    tangents: Vec<f32>,
}

impl Horizon {
    fn start(&mut self, eye_m: DVec3, longest_m: f64, spacing_m: f64) {
        self.eye_m = eye_m;
        let fine = (longest_m / spacing_m).clamp(64.0, MOST_SPACINGS).ceil() as usize;
        // A unit of `turn` holds up to 2 radians, and steps even in the root are twice as wide at the end as on average.
        self.rays = (RAYS_TO_A_SPACING * 8 * fine).next_multiple_of(SECTOR);
        self.steps = STEPS_TO_A_SPACING * 2 * fine + 1;
        self.per_root = (self.steps - 1) as f64 / longest_m.sqrt();
        self.reach_m.clear();
        self.reach_m.resize(self.rays / SECTOR, 0.0);
        self.place.clear();
        self.place.resize(self.rays / SECTOR, UNUSED);
        self.used.clear();
    }

    /// Something in this box will be looked at.
    fn mark(&mut self, low_m: DVec2, high_m: DVec2) {
        let eye_m = self.eye_m.truncate();
        let (low, high) = (low_m - eye_m, high_m - eye_m);
        let farthest_m = low.abs().max(high.abs()).length() as f32;
        let sectors = self.place.len() as i64;
        let around = low.max_element() <= 0.0 && high.min_element() >= 0.0;
        let (first, last) = if around {
            (0, sectors - 1)
        } else {
            let middle = turn((low + high) / 2.0);
            let corners = [
                low,
                high,
                DVec2::new(low.x, high.y),
                DVec2::new(high.x, low.y),
            ];
            // Less than half the circle: the box lies on one side of the eye.
            let from_middle = corners.map(|c| (turn(c) - middle + 6.0).rem_euclid(4.0) - 2.0);
            let least = from_middle.into_iter().fold(0.0, f64::min);
            let most = from_middle.into_iter().fold(0.0, f64::max);
            let ray = |t: f64| ((middle + t) * (self.rays as f64 / 4.0)).floor() as i64;
            let sector = |ray: i64| ray.div_euclid(SECTOR as i64);
            (sector(ray(least)), sector(ray(most) + 1))
        };
        for sector in first..=last {
            let sector = sector.rem_euclid(sectors) as usize;
            if self.place[sector] == UNUSED {
                self.place[sector] = self.used.len() as u32;
                self.used.push(sector as u32);
            }
            self.reach_m[sector] = self.reach_m[sector].max(farthest_m);
        }
    }

    fn scan(&mut self, surface: &Surface, rule: OcclusionSpec) {
        // What is behind a ray's reach keeps old values; nobody asks for them.
        self.tangents
            .resize(self.used.len() * SECTOR * self.steps, OPEN);
        let (eye_m, rays, per_root) = (self.eye_m, self.rays, self.per_root);
        let (used, reach_m) = (&self.used, &self.reach_m);
        self.tangents
            .par_chunks_mut(self.steps)
            .enumerate()
            .for_each(|(row, tangents)| {
                let sector = used[row / SECTOR] as usize;
                let ray = sector * SECTOR + row % SECTOR;
                let along = direction(ray as f64 * 4.0 / rays as f64);
                let mut scan = RayScan {
                    tangents,
                    per_root,
                    next: 0,
                    highest: f64::from(OPEN),
                    first: None,
                    rule,
                };
                let reach_m = f64::from(reach_m[sector]);
                surface.profile(eye_m.truncate(), along, reach_m, |piece| {
                    scan.piece(eye_m.z, piece);
                });
                scan.finish(reach_m);
            });
    }

    /// How far a point lies above the horizon, metres (negative: hidden), and by how much the horizon between the rays may be wrong. None where
    /// nothing could hide it. `roughness`: how much the ground's slope changes around the point.
    #[inline(always)]
    fn clearance_m(&self, at_m: DVec3, roughness: f64) -> Option<(f64, f64)> {
        let d = (at_m - self.eye_m).truncate();
        let distance_m = d.length();
        let step = (distance_m.sqrt() * self.per_root) as usize;
        if step == 0 || step > self.steps {
            return None;
        }
        let x = turn(d) * (self.rays as f64 / 4.0);
        let ray = (x as usize).min(self.rays - 1);
        let next = if ray + 1 == self.rays { 0 } else { ray + 1 };
        let (a, b) = (self.horizon(ray, step - 1)?, self.horizon(next, step - 1)?);
        let rise = (self.eye_m.z - at_m.z) - (a + (x - ray as f64) * (b - a)) * distance_m;
        // A unit of `turn` holds up to 2 radians.
        let between_m = distance_m * 8.0 / self.rays as f64;
        let doubt = 0.5 * ((b - a).abs() * distance_m + roughness * between_m);
        Some((rise, doubt))
    }

    #[inline(always)]
    fn horizon(&self, ray: usize, step: usize) -> Option<f64> {
        let place = self.place[ray / SECTOR];
        let row = place as usize * SECTOR + ray % SECTOR;
        (place != UNUSED).then(|| f64::from(self.tangents[row * self.steps + step]))
    }
}

/// A stretch of the ground along a ray, between two distances from the eye. About its middle, so that the shortest stretch loses no digits.
#[derive(Clone, Copy, Debug)]
pub struct Piece {
    pub from_m: f64,
    pub to_m: f64,
    middle_m: f64,
    /// Depth, slope and half the second derivative in the middle.
    depth: [f64; 3],
}

impl Piece {
    /// Where the ground must be known: as shares of the way from one end to the other. Inside, since on the edge of a cell its neighbour could
    /// answer, or be a hole.
    pub const AT: [f64; 3] = [0.1, 0.5, 0.9];

    /// Through the depths at [`Self::AT`].
    pub fn through(from_m: f64, to_m: f64, [y0, y1, y2]: [f64; 3]) -> Self {
        let step_m = (Self::AT[1] - Self::AT[0]) * (to_m - from_m);
        Self {
            from_m,
            to_m,
            middle_m: 0.5 * (from_m + to_m),
            depth: [
                y1,
                (y2 - y0) / (2.0 * step_m),
                (y2 - 2.0 * y1 + y0) / (2.0 * step_m * step_m),
            ],
        }
    }

    fn tangent(&self, eye_down_m: f64, s: f64) -> f64 {
        let [a, b, c] = self.depth;
        let x = s - self.middle_m;
        (eye_down_m - (a + x * (b + x * c))) / s
    }

    /// The highest tangent, over the ground no nearer than [`FIRST_M`].
    pub fn highest(&self, eye_down_m: f64) -> f64 {
        let ends = [self.from_m.max(FIRST_M), self.to_m].map(|s| self.tangent(eye_down_m, s));
        let summit = self.summit_m(eye_down_m);
        let summit = summit.map_or(f64::NEG_INFINITY, |s| self.tangent(eye_down_m, s));
        ends[0].max(ends[1]).max(summit)
    }

    /// Where inside the tangent is highest, if not at an end.
    fn summit_m(&self, eye_down_m: f64) -> Option<f64> {
        // depth - eye = slope s there: s^2 = m^2 + (a - eye - b m)/c.
        let [a, b, c] = self.depth;
        let m = self.middle_m;
        let squared = m * m + (a - eye_down_m - b * m) / c;
        (c > 0.0 && squared > self.from_m * self.from_m && squared < self.to_m * self.to_m)
            .then(|| squared.sqrt())
    }
}

struct RayScan<'a> {
    tangents: &'a mut [f32],
    per_root: f64,
    /// The first step not yet passed.
    next: usize,
    highest: f64,
    /// For the paper's rule: the tangent of the first step over ground.
    first: Option<f64>,
    rule: OcclusionSpec,
}

impl RayScan<'_> {
    fn next_m(&self) -> f64 {
        (self.next as f64 / self.per_root).powi(2)
    }

    fn piece(&mut self, eye_down_m: f64, piece: Piece) {
        let from_m = piece.from_m.max(FIRST_M);
        if piece.to_m <= from_m {
            return;
        }
        // Over a gap in the ground, the horizon stays.
        self.keep_until(from_m);
        self.rise(piece.tangent(eye_down_m, from_m));
        let summit_m = piece.summit_m(eye_down_m);
        let mut summit = summit_m.map(|s| (s, piece.tangent(eye_down_m, s)));
        while self.next < self.tangents.len() && self.next_m() < piece.to_m {
            let here_m = self.next_m();
            if let Some((at_m, tangent)) = summit
                && at_m <= here_m
            {
                self.rise(tangent);
                summit = None;
            }
            let here = piece.tangent(eye_down_m, here_m);
            self.rise(here);
            let first = *self.first.get_or_insert(here);
            self.tangents[self.next] = match self.rule {
                OcclusionSpec::Paper => first.max(here) as f32,
                _ => self.highest as f32,
            };
            self.next += 1;
        }
        if let Some((_, tangent)) = summit {
            self.rise(tangent);
        }
        self.rise(piece.tangent(eye_down_m, piece.to_m));
    }

    fn rise(&mut self, tangent: f64) {
        self.highest = self.highest.max(tangent);
    }

    fn keep_until(&mut self, to_m: f64) {
        let kept = match self.rule {
            OcclusionSpec::Paper => f64::from(OPEN),
            _ => self.highest,
        };
        while self.next < self.tangents.len() && self.next_m() < to_m {
            self.tangents[self.next] = kept as f32;
            self.next += 1;
        }
    }

    fn finish(mut self, reach_m: f64) {
        let step_m = 2.0 * (reach_m + 1.0).sqrt() / self.per_root;
        self.keep_until(reach_m + 2.0 * step_m);
    }
}

/// A single ray: whether the ground hides a point from an eye.
fn cast_hides(ground: &Surface, eye_m: DVec3, at_m: DVec3) -> bool {
    let way_m = (at_m - eye_m).truncate();
    let distance_m = way_m.length();
    // The place of a scatterer is known to some micrometres.
    let line = (eye_m.z - at_m.z + 1e-5) / distance_m;
    let mut hidden = false;
    ground.profile(eye_m.truncate(), way_m / distance_m, distance_m, |piece| {
        hidden |= piece.highest(eye_m.z) > line;
    });
    hidden
}

/// What may hide a point, and what the ground around it is like.
#[derive(Clone, Copy, Debug, Default)]
pub struct Around<'a> {
    pub ground: Option<&'a Surface>,
    /// How much its slope changes nearby.
    pub roughness: f64,
    pub solids: Option<&'a Targets>,
}

/// The shadows of one ping. Coordinates are the scene's own.
#[derive(Debug)]
pub struct Occlusion {
    rule: OcclusionSpec,
    eyes_m: Vec<DVec3>,
    /// One per eye, over a seabed that can hide something.
    horizons: Vec<Horizon>,
    /// Of each footprint: the transmitter's eye and the receiver's.
    pairs: Vec<(usize, usize)>,
    hilly: bool,
}

impl Occlusion {
    pub fn new(rule: OcclusionSpec) -> Self {
        Self {
            rule,
            eyes_m: Vec::new(),
            horizons: Vec::new(),
            pairs: Vec::new(),
            hilly: false,
        }
    }

    /// A new ping. `spacing_m`: between scatterers at the longest range; none where there is no seabed that could hide anything.
    pub fn start(&mut self, heard: &[Footprint], anchor_m: DVec3, spacing_m: Option<f64>) {
        self.eyes_m.clear();
        self.pairs.clear();
        if self.rule == OcclusionSpec::None {
            return;
        }
        for f in heard {
            let pair = [f.apex_m, f.receiver_m].map(|eye_m| self.eye(eye_m - anchor_m));
            self.pairs.push((pair[0], pair[1]));
        }
        self.hilly = spacing_m.is_some();
        let longest_m = heard.iter().map(|f| f.max_range_m).fold(1.0, f64::max);
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
    pub fn mark(&mut self, low_m: DVec3, high_m: DVec3) {
        if self.rule == OcclusionSpec::None || !self.hilly {
            return;
        }
        for horizon in &mut self.horizons[..self.eyes_m.len()] {
            horizon.mark(low_m.truncate(), high_m.truncate());
        }
    }

    /// Runs the rays that were marked.
    pub fn scan(&mut self, surface: &Surface) {
        if self.rule == OcclusionSpec::None || !self.hilly {
            return;
        }
        for horizon in &mut self.horizons[..self.eyes_m.len()] {
            horizon.scan(surface, self.rule);
        }
    }

    /// Whether nothing hides a point from transmitter and receiver of a footprint.
    #[inline(always)]
    pub fn sees(&self, footprint: usize, at_m: DVec3, around: Around) -> bool {
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
    fn ground_hides(&self, eye: usize, at_m: DVec3, around: Around) -> bool {
        let Some(ground) = around.ground.filter(|_| self.hilly) else {
            return false;
        };
        match self.horizons[eye].clearance_m(at_m, around.roughness) {
            None => false,
            Some((rise_m, doubt_m))
                if rise_m.abs() < doubt_m && self.rule == OcclusionSpec::Horizon =>
            {
                cast_hides(ground, self.eyes_m[eye], at_m)
            }
            Some((rise_m, _)) => rise_m < 0.0,
        }
    }

    fn solid_hides(&self, eye: usize, at_m: DVec3, around: Around) -> bool {
        around.solids.is_some_and(|solids| {
            let ray_m = self.eyes_m[eye] - at_m;
            let distance_m = ray_m.length();
            solids.hits(at_m, ray_m / distance_m, distance_m)
        })
    }

    /// The solids, where any of them may stand between an eye and a tile.
    pub fn solids_before<'a>(&self, tile: &TileBox, solids: &'a Targets) -> Option<&'a Targets> {
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
        let any = (0..solids.len())
            .filter(|&k| solids.solid(k).is_some())
            .any(|k| self.eyes_m.iter().any(|eye_m| near(eye_m, k)));
        any.then_some(solids)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn turns_and_directions_are_each_others_inverse_and_grow_with_the_azimuth() {
        let mut last = -1.0;
        for k in 0..10_000 {
            let azimuth = f64::from(k) * std::f64::consts::TAU / 10_000.0;
            let d = DVec2::new(azimuth.cos(), azimuth.sin());
            let t = turn(d * 37.0);
            assert!(t > last && t < 4.0, "{azimuth}: {t} after {last}");
            assert!(direction(t).distance(d) < 1e-12, "{azimuth}");
            last = t;
        }
    }

    #[test]
    fn a_piece_goes_through_its_points_and_knows_its_summit() {
        let depth = |s: f64| 20.0 - 0.8 * s + 0.03 * s * s;
        let piece = Piece::through(8.0, 18.0, [9.0, 13.0, 17.0].map(depth));
        let eye_down_m = 12.0;
        let tangent = |s: f64| (eye_down_m - depth(s)) / s;
        let mut best = (0.0, f64::NEG_INFINITY);
        for k in 0..=10_000 {
            let s = 8.0 + 1e-3 * f64::from(k);
            assert!(
                (piece.tangent(eye_down_m, s) - tangent(s)).abs() < 1e-12,
                "{s}"
            );
            if tangent(s) > best.1 {
                best = (s, tangent(s));
            }
        }
        let summit_m = piece.summit_m(eye_down_m).expect("inside");
        assert!((summit_m - best.0).abs() < 1.1e-3, "{summit_m}, {best:?}");
    }
}
