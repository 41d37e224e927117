//! Visibility of the seabed from one eye: the distance up to which all ground faces the eye, and shadows along rays beyond it.

use glam::{DVec2, DVec3};
use rayon::prelude::*;

use crate::piece::Piece;
use crate::seabed::Surface;
use echotank_config::spec::OcclusionSpec;

/// Rays per scatterer spacing at the longest range.
const RAYS_TO_A_SPACING: usize = 2;
/// Adjacent rays that are scanned together.
const SECTOR: usize = 16;
/// Least and greatest number of spacings in the longest range. At the greatest, a full circle of rays takes 4 MiB.
const SPACINGS: (f64, f64) = (64.0, 1024.0);
/// Shadows stored for each ray. Beyond them, a ray is cast for every scatterer.
const SHADOWS: usize = 32;
/// Shorter shadows are attributed to rounding, metres.
const SLIVER_M: f64 = 1e-3;
/// Rounding error of a tangent: a tenth of a micrometre at 100 m.
const ROUNDING: f64 = 1e-9;
/// Tangent of an empty horizon.
const OPEN: f64 = -1e9;
/// Ground nearer than this hides nothing, metres.
pub(super) const FIRST_M: f64 = 1e-3;
/// Transitions between insonified and shadowed ground in one piece. A piece enters and leaves shadow at most once, and may begin in one.
const TURNS: usize = 4;

const UNUSED: u32 = u32::MAX;

/// Pseudo-angle of a horizontal direction (north, east): 0 to 4, growing with the azimuth, without a trigonometric function.
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

/// Unit direction of a pseudo-angle.
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

/// Adjacent rays: from about a sixteenth of a degree to some degrees.
#[derive(Clone, Copy, Debug)]
struct Sector {
    /// Distance up to which points will be tested, metres; 0 if none are.
    reach_m: f64,
    /// Distance up to which all ground faces the eye, so that nothing is hidden, metres.
    clear_m: f64,
    /// Index of its rays among those scanned, in sectors.
    place: u32,
}

const UNMARKED: Sector = Sector {
    reach_m: 0.0,
    clear_m: f64::INFINITY,
    place: UNUSED,
};

/// Shadows of the ground along a ray, from near to far.
#[derive(Clone, Copy, Debug)]
struct Shadows {
    count: u32,
    /// Distance beyond which shadows were not stored.
    known_m: f32,
    /// Beginning and end of each shadow, metres.
    edges_m: [[f32; 2]; SHADOWS],
}

const NO_SHADOWS: Shadows = Shadows {
    count: 0,
    known_m: f32::INFINITY,
    edges_m: [[0.0; 2]; SHADOWS],
};

/// Visibility of the ground at a position.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Visibility {
    Seen,
    Hidden,
    Unsure,
}

/// Horizon of one eye. Coordinates are the scene's.
#[derive(Debug, Default)]
pub(super) struct Horizon {
    eye_m: DVec3,
    /// Rays in the full circle, a multiple of 4.
    rays: usize,
    sectors: Vec<Sector>,
    /// Bounding rectangle of the eye and of everything marked.
    low_m: DVec2,
    high_m: DVec2,
    /// Sectors whose rays were scanned.
    used: Vec<u32>,
    shadows: Vec<Shadows>,
}

impl Horizon {
    pub(super) fn start(&mut self, eye_m: DVec3, longest_m: f64, spacing_m: f64) {
        self.eye_m = eye_m;
        let fine = (longest_m / spacing_m).clamp(SPACINGS.0, SPACINGS.1);
        // A unit of `turn` spans up to 2 radians.
        self.rays = (RAYS_TO_A_SPACING * 8 * fine.ceil() as usize).next_multiple_of(SECTOR);
        self.sectors.clear();
        self.sectors.resize(self.rays / SECTOR, UNMARKED);
        (self.low_m, self.high_m) = (eye_m.truncate(), eye_m.truncate());
        self.used.clear();
        self.used.reserve(self.sectors.len());
        self.shadows.clear();
        // Reserved for all rays, though hardly any ping needs them: memory that is not written is not committed.
        self.shadows.reserve(self.rays);
    }

    /// Bounding rectangle of the eye and of everything marked, metres.
    pub(super) fn marked_m(&self) -> (DVec2, DVec2) {
        (self.low_m, self.high_m)
    }

    /// Announces that points in a box will be tested.
    pub(super) fn mark(&mut self, low_m: DVec2, high_m: DVec2) {
        self.low_m = self.low_m.min(low_m);
        self.high_m = self.high_m.max(high_m);
        let farthest_m = self.farthest_m(low_m, high_m);
        for sector in self.sectors_of(low_m, high_m) {
            let reach_m = &mut self.sectors[sector].reach_m;
            *reach_m = reach_m.max(farthest_m);
        }
    }

    fn farthest_m(&self, low_m: DVec2, high_m: DVec2) -> f64 {
        let eye_m = self.eye_m.truncate();
        (low_m - eye_m).abs().max((high_m - eye_m).abs()).length()
    }

    /// Sectors of all rays that bracket a box.
    fn sectors_of(&self, low_m: DVec2, high_m: DVec2) -> impl Iterator<Item = usize> + use<> {
        let eye_m = self.eye_m.truncate();
        let (low, high) = (low_m - eye_m, high_m - eye_m);
        let sectors = self.sectors.len() as i64;
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
            // The box spans less than half the circle: it lies on one side of the eye.
            let from_middle = corners.map(|c| (turn(c) - middle + 6.0).rem_euclid(4.0) - 2.0);
            let least = from_middle.into_iter().fold(0.0, f64::min);
            let most = from_middle.into_iter().fold(0.0, f64::max);
            let ray = |t: f64| ((middle + t) * (self.rays as f64 / 4.0)).floor() as i64;
            let sector = |ray: i64| ray.div_euclid(SECTOR as i64);
            (sector(ray(least)), sector(ray(most) + 1))
        };
        (first..=last).map(move |sector| sector.rem_euclid(sectors) as usize)
    }

    /// Finds the clear distance of each sector. Call it after all boxes are marked.
    pub(super) fn clear(&mut self, surface: &Surface) {
        let (eye_m, low_m, high_m) = (self.eye_m, self.low_m, self.high_m);
        let at_m = eye_m.truncate();
        surface.turned_away(eye_m, low_m, high_m, |low_m, high_m| {
            let nearest_m = at_m.clamp(low_m, high_m).distance(at_m);
            for sector in self.sectors_of(low_m, high_m) {
                let clear_m = &mut self.sectors[sector].clear_m;
                *clear_m = clear_m.min(nearest_m);
            }
        });
    }

    /// Scans the rays of the sectors that are not clear, up to their greatest tested distance.
    pub(super) fn scan(&mut self, surface: &Surface, rule: OcclusionSpec) {
        for (index, sector) in self.sectors.iter_mut().enumerate() {
            if sector.clear_m < sector.reach_m {
                sector.place = self.used.len() as u32;
                self.used.push(index as u32);
            }
        }
        self.shadows.resize(self.used.len() * SECTOR, NO_SHADOWS);
        let (eye_m, rays) = (self.eye_m, self.rays);
        let (used, sectors) = (&self.used, &self.sectors);
        self.shadows
            .par_iter_mut()
            .with_min_len(SECTOR)
            .enumerate()
            .for_each(|(row, shadows)| {
                let index = used[row / SECTOR] as usize;
                let sector = &sectors[index];
                let ray = index * SECTOR + row % SECTOR;
                let along = direction(ray as f64 * 4.0 / rays as f64);
                shadows.count = 0;
                shadows.known_m = f32::INFINITY;
                let mut scan = RayScan {
                    shadows,
                    eye_down_m: eye_m.z,
                    highest: OPEN,
                    hidden_from_m: None,
                };
                let from_m = match rule {
                    // This rule compares with the first ground along the ray.
                    OcclusionSpec::Paper => 0.0,
                    _ => sector.clear_m,
                };
                let stretch_m = from_m..sector.reach_m;
                surface.profile(eye_m.truncate(), along, stretch_m, |piece| match rule {
                    OcclusionSpec::Paper => scan.falling(piece),
                    _ => scan.below_horizon(piece),
                });
                scan.show_from(f64::INFINITY);
            });
    }

    /// Whether all ground in a marked box is seen.
    pub(crate) fn is_clear(&self, low_m: DVec2, high_m: DVec2) -> bool {
        let farthest_m = self.farthest_m(low_m, high_m);
        self.sectors_of(low_m, high_m)
            .all(|sector| farthest_m <= self.sectors[sector].clear_m)
    }

    /// Visibility of the ground at a marked position: the common result of the rays on both sides, and that of the nearer ray.
    #[inline(always)]
    pub(super) fn visibility(&self, at_m: DVec2) -> (Visibility, Visibility) {
        let d = at_m - self.eye_m.truncate();
        let distance_m = d.length();
        let x = turn(d) * (self.rays as f64 / 4.0);
        let ray = (x as usize).min(self.rays - 1);
        let next = if ray + 1 == self.rays { 0 } else { ray + 1 };
        let (a, b) = (self.along(ray, distance_m), self.along(next, distance_m));
        let both = if a == b { a } else { Visibility::Unsure };
        (both, if x - (ray as f64) < 0.5 { a } else { b })
    }

    #[inline(always)]
    fn along(&self, ray: usize, distance_m: f64) -> Visibility {
        let sector = &self.sectors[ray / SECTOR];
        if sector.place == UNUSED || distance_m < sector.clear_m {
            return Visibility::Seen;
        }
        self.shadows[sector.place as usize * SECTOR + ray % SECTOR].at(distance_m as f32)
    }

    /// Casts a single ray. Returns whether the ground hides a position from the eye.
    pub(crate) fn cast_hides(&self, ground: &Surface, at_m: DVec3) -> bool {
        let offset_m = (at_m - self.eye_m).truncate();
        let distance_m = offset_m.length();
        let ray = (turn(offset_m) * (self.rays as f64 / 4.0)) as usize;
        let clear_m = self.sectors[ray.min(self.rays - 1) / SECTOR].clear_m;
        // Positions of scatterers are rounded to some micrometres.
        let line = (self.eye_m.z - at_m.z + 1e-5) / distance_m;
        let mut hidden = false;
        let stretch_m = clear_m.min(distance_m)..distance_m;
        let along = offset_m / distance_m;
        ground.profile(self.eye_m.truncate(), along, stretch_m, |piece| {
            let from_m = piece.from_m.max(FIRST_M);
            hidden |= piece.to_m > from_m && piece.highest(self.eye_m.z, from_m) > line;
        });
        hidden
    }
}

impl Shadows {
    #[inline(always)]
    fn at(&self, distance_m: f32) -> Visibility {
        let kept = &self.edges_m[..self.count as usize];
        for &[from_m, to_m] in kept {
            if distance_m < from_m {
                return Visibility::Seen;
            }
            if distance_m < to_m {
                return Visibility::Hidden;
            }
        }
        match distance_m < self.known_m {
            true => Visibility::Seen,
            false => Visibility::Unsure,
        }
    }
}

/// Scan along one ray, outward.
struct RayScan<'a> {
    shadows: &'a mut Shadows,
    eye_down_m: f64,
    /// Horizon rule: the highest tangent so far. Paper rule: the tangent of the first ground.
    highest: f64,
    hidden_from_m: Option<f64>,
}

impl RayScan<'_> {
    /// Horizon rule: ground below the highest tangent before it is hidden. The horizon persists over a gap in the ground.
    fn below_horizon(&mut self, piece: Piece) {
        let eye_down_m = self.eye_down_m;
        let mut s = piece.from_m.max(FIRST_M);
        if s >= piece.to_m {
            return;
        }
        // Behind a gap the ground may lie higher or lower. Elsewhere pieces meet within rounding.
        let here = piece.tangent(eye_down_m, s);
        if here >= self.highest - ROUNDING {
            self.show_from(s);
        } else {
            self.hidden_from_m.get_or_insert(s);
        }
        for _ in 0..TURNS {
            if self.hidden_from_m.is_some() {
                let Some(out_m) = piece.rises_through_m(eye_down_m, s, self.highest) else {
                    return;
                };
                self.show_from(out_m);
                s = out_m;
            }
            let falls_m = piece.falls_m(eye_down_m, s);
            let insonified_to_m = falls_m.unwrap_or(piece.to_m);
            self.highest = self.highest.max(piece.tangent(eye_down_m, insonified_to_m));
            if falls_m.is_none() {
                return;
            }
            self.hidden_from_m = falls_m;
            s = insonified_to_m;
        }
    }

    /// Eq. 27: ground is hidden if it lies lower in the view than the ground just before it, or than the first ground.
    fn falling(&mut self, piece: Piece) {
        let eye_down_m = self.eye_down_m;
        let from_m = piece.from_m.max(FIRST_M);
        if from_m >= piece.to_m {
            return;
        }
        if self.highest == OPEN {
            self.highest = piece.tangent(eye_down_m, from_m);
        }
        let turns_m = piece.turns_m(eye_down_m, from_m).unwrap_or(piece.to_m);
        for [begin_m, end_m] in [[from_m, turns_m], [turns_m, piece.to_m]] {
            if begin_m >= end_m {
                continue;
            }
            let middle_m = 0.5 * (begin_m + end_m);
            let hidden = piece.rise(eye_down_m, middle_m) < 0.0
                || piece.tangent(eye_down_m, middle_m) < self.highest;
            match (hidden, self.hidden_from_m) {
                (true, None) => self.hidden_from_m = Some(begin_m),
                (false, Some(_)) => self.show_from(begin_m),
                _ => {}
            }
        }
    }

    /// Ends the current shadow, if there is one.
    fn show_from(&mut self, to_m: f64) {
        let Some(from_m) = self.hidden_from_m.take() else {
            return;
        };
        let count = self.shadows.count as usize;
        if to_m - from_m < SLIVER_M || self.shadows.known_m.is_finite() {
            return;
        }
        if count == SHADOWS {
            self.shadows.known_m = from_m as f32;
            return;
        }
        self.shadows.edges_m[count] = [from_m as f32, to_m as f32];
        self.shadows.count += 1;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::read::HeightField;

    #[test]
    fn turns_and_directions_are_inverse_and_grow_with_the_azimuth() {
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

    /// Parallel ridges 2 m apart, seen across, so that a ray meets more shadows than it stores.
    #[test]
    fn beyond_the_stored_shadows_visibility_is_unsure() {
        let (rows, cols) = (21, 201);
        let depth_m = |k: usize| 20.0 - (k % cols % 2) as f32;
        let field = HeightField {
            rows,
            cols,
            cell_north_m: 1.0,
            cell_east_m: 1.0,
            south_m: 0.0,
            west_m: 0.0,
            down_m: (0..rows * cols).map(depth_m).collect(),
        };
        let surface = Surface::from_grid(field, false, -10.0, 0.0, 16.0);
        let mut horizon = Horizon::default();
        let eye_m = DVec3::new(0.0, -1.0, 17.0);
        horizon.start(eye_m, 200.0, 0.5);
        horizon.mark(DVec2::new(-5.0, 0.0), DVec2::new(5.0, 198.0));
        horizon.clear(&surface);
        horizon.scan(&surface, OcclusionSpec::Horizon);
        let (mut sure, mut unsure, mut hidden) = (0, 0, 0);
        for k in 10..1970 {
            let at_m = DVec2::new(0.03, 0.1 * f64::from(k) + 0.013);
            let down_m = surface.sample(at_m.x, at_m.y).unwrap().down_m;
            let cast = horizon.cast_hides(&surface, at_m.extend(down_m));
            hidden += i32::from(cast);
            match horizon.visibility(at_m).0 {
                Visibility::Unsure => unsure += 1,
                visibility => {
                    sure += 1;
                    // Within a centimetre of an edge either answer may be right.
                    let near = [-0.01, 0.01].map(|d| {
                        let p = at_m + DVec2::new(0.0, d);
                        let down_m = surface.sample(p.x, p.y).unwrap().down_m;
                        horizon.cast_hides(&surface, p.extend(down_m))
                    });
                    let edge = near[0] != near[1];
                    assert!(edge || cast == (visibility == Visibility::Hidden), "{at_m}");
                }
            }
        }
        println!("{sure} sure, {unsure} not; {hidden} hidden");
        assert!(sure > 400 && unsure > 400 && hidden > 400);
    }
}
