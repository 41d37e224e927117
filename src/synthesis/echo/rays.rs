//! Sound rays through a [`SoundSpeedProfile`], and the virtual points that stand for scatterers seen along them.
//!
//! Between two points of a profile the gradient g is constant and a ray is the arc of a circle. With the ray parameter p = cos(elevation) / c and
//! s = sin(elevation), a layer from (z1, c1) to (z2, c2) adds
//!
//! ```text
//! range   p (c1 + c2) |z2 - z1| / (s1 + s2)
//! time    2 / |g| asinh(|g| d / (2 sqrt(c1 c2)))        d: straight distance between the ends
//! length  2 / (p |g|) asin(p |g| d / 2)
//! ```
//!
//! which hold for g = 0 too (Brekhovskikh and Lysanov 2003, Fundamentals of Ocean Acoustics, section 2.4; the forms in differences of speeds lose digits
//! where the gradient is small).
//!
//! A [`Ray`] joins two points without touching the surface or the seabed: directly, or by one turn above or below both. [`VirtualPoints`] tabulates the
//! rays of one array depth and interpolates between them.

use std::sync::Arc;

use glam::DVec3;
use num_complex::Complex64;
use rayon::prelude::*;

use super::reflected_rays::reflected_point_error_s;
use echotank_core::ping::Refraction;
use echotank_core::scene::Scatterers;
use echotank_core::sound_speed::SoundSpeedProfile;

/// Steps of Newton's method, at most. It converges quadratically, and by doubling first where the ray is almost level.
pub(super) const MAX_STEPS: usize = 100;
/// Bisections of the depth of a turn.
const BISECTIONS: usize = 200;
/// Relative error of the range at which a ray counts as found.
pub(super) const CLOSED: f64 = 1e-15;
/// Depths closer together than this are equal, metres.
pub(super) const SAME_DEPTH_M: f64 = 1e-9;
/// Smallest sine of the elevation in the divisions of spreading, which is finite where a ray is level.
const MIN_SINE: f64 = 1e-8;
/// Largest gain by focusing, as a factor on the pressure of both legs: rays cross at a caustic, where ray theory has no finite level.
pub(super) const MAX_FOCUS: f64 = 10.0;

/// Direction of a ray in the vertical plane that holds it, unit vector.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Elevation {
    /// Component away from the start of the ray.
    pub outward: f64,
    /// Component downwards.
    pub down: f64,
}

/// A ray between two points.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ray {
    /// Travel time, seconds.
    pub time_s: f64,
    /// Length of the arc, metres.
    pub length_m: f64,
    /// Direction at its start.
    pub start: Elevation,
    /// Direction at its end.
    pub end: Elevation,
    /// Pressure at the end relative to the pressure 1 m from the start, by the area of the ray tube alone; the same in both directions (reciprocity).
    /// 1 / distance in water of one sound speed.
    pub spreading_per_m: f64,
}

/// Sums over the layers of a ray of parameter p.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Sums {
    /// Range divided by p, which is finite for a vertical ray.
    pub(super) range_per_p: f64,
    /// Derivative of the range with respect to p.
    pub(super) range_by_p: f64,
    pub(super) time_s: f64,
    pub(super) length_m: f64,
}

/// asinh(x) / x.
#[inline(always)]
fn asinh_share(x: f64) -> f64 {
    let y = x * x;
    if y < 4e-4 {
        1.0 - y * (1.0 / 6.0 - y * (3.0 / 40.0 - y * (15.0 / 336.0 - y * (105.0 / 3456.0))))
    } else {
        libm::asinh(x) / x
    }
}

/// asin(x) / x.
#[inline(always)]
fn asin_share(x: f64) -> f64 {
    let y = x * x;
    if y < 4e-4 {
        1.0 + y * (1.0 / 6.0 + y * (3.0 / 40.0 + y * (15.0 / 336.0 + y * (105.0 / 3456.0))))
    } else {
        libm::asin(x.min(1.0)) / x
    }
}

impl Sums {
    /// Adds a layer `thick_m` thick with speeds and sines `(c, s)` at its ends.
    #[inline(always)]
    pub(super) fn add(
        &mut self,
        p: f64,
        (thick_m, gradient_per_s): (f64, f64),
        (c1, s1): (f64, f64),
        (c2, s2): (f64, f64),
    ) {
        let per_sines = 1.0 / (s1 + s2);
        let range_per_p = (c1 + c2) * thick_m * per_sines;
        let (t1, t2) = (s1.max(MIN_SINE), s2.max(MIN_SINE));
        let bend = p * p * (c1 * c1 * t2 + c2 * c2 * t1) * per_sines / (t1 * t2);
        self.range_per_p += range_per_p;
        self.range_by_p += range_per_p * (1.0 + bend);
        let range_m = p * range_per_p;
        let chord_m = (range_m * range_m + thick_m * thick_m).sqrt();
        let mean = (c1 * c2).sqrt();
        let straight_s = chord_m / mean;
        self.time_s += straight_s * asinh_share(0.5 * gradient_per_s * straight_s);
        self.length_m += chord_m * asin_share(0.5 * p * gradient_per_s * chord_m);
    }

    /// Adds the arc from a point with `(c, s)` to the turn of the ray and back to the same depth.
    fn add_turn(&mut self, p: f64, g: f64, (c, s): (f64, f64)) {
        let s = s.max(MIN_SINE * MIN_SINE);
        self.range_per_p += 2.0 * s / (p * p * g);
        self.range_by_p -= 2.0 / (g * p * p * s.max(MIN_SINE));
        // The elevation is that of atanh(s) = ln((1 + s) / (p c)).
        self.time_s += 2.0 / g * libm::atanh(s.min(1.0 - f64::EPSILON));
        self.length_m += 2.0 / (p * g) * libm::atan2(s, p * c);
    }
}

/// The ray from `from_m` to `to_m` (depths in metres) whose ends are `range_m` apart horizontally; the earliest of several. None where there is no ray:
/// in the shadow of the water above or below. A ray may turn no higher than the surface and no lower than `floor_m`.
pub fn ray(
    profile: &SoundSpeedProfile,
    from_m: f64,
    to_m: f64,
    range_m: f64,
    floor_m: f64,
) -> Option<Ray> {
    let path = Path::between_depths(profile, from_m, to_m, range_m);
    Some(path.earliest(floor_m)?.ray(from_m, to_m))
}

/// Largest phase error of an element by the virtual point of one place, as [`virtual_point_error`] has it, by the ray of that place: directly or by a turn,
/// down or up. Zero without a ray, and for a level one, which is straight.
pub fn place_error(
    water: &Refraction,
    frequency_hz: f64,
    offsets_m: (f64, f64),
    at_m: DVec3,
) -> f64 {
    let range_m = (at_m - water.array_m).truncate().length();
    let path = Path::between_depths(&water.profile, water.array_m.z, at_m.z, range_m);
    let Some(found) = path.earliest(water.floor_m) else {
        return 0.0;
    };
    if path.is_level() && found.turn == Turn::None {
        return 0.0;
    }
    let at = (water.sound_speed_m_per_s(), found.p);
    let gradient_per_s = water.profile.max_gradient_per_s();
    let error_s = curvature_error_s(at, &found.sums, gradient_per_s, offsets_m);
    std::f64::consts::PI * frequency_hz * error_s
}

/// How a ray leaves the depths between its ends.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Turn {
    None,
    Above,
    Below,
}

/// The ends of a ray that is sought.
struct Path<'a> {
    profile: &'a SoundSpeedProfile,
    upper_m: f64,
    lower_m: f64,
    range_m: f64,
}

/// A ray with its sums and with speed and sine at the upper and at the lower end.
struct Found {
    p: f64,
    sums: Sums,
    turn: Turn,
    upper: (f64, f64),
    lower: (f64, f64),
}

impl Found {
    fn ray(&self, from_m: f64, to_m: f64) -> Ray {
        let (start, end) = match from_m <= to_m {
            true => (self.upper, self.lower),
            false => (self.lower, self.upper),
        };
        let down = match self.turn {
            Turn::None if from_m <= to_m => [1.0, 1.0],
            Turn::None => [-1.0, -1.0],
            Turn::Above => [-1.0, 1.0],
            Turn::Below => [1.0, -1.0],
        };
        let towards = |(c, s): (f64, f64), sign: f64| Elevation {
            outward: self.p * c,
            down: sign * s,
        };
        Ray {
            time_s: self.sums.time_s,
            length_m: self.sums.length_m,
            start: towards(start, down[0]),
            end: towards(end, down[1]),
            spreading_per_m: spreading_per_m(&self.sums, start, end),
        }
    }
}

/// Pressure of a ray tube: p c1 c2 / (r |dr/dp| s1 s2), the root of it (Jensen et al. 2011, Computational Ocean Acoustics, eq. 3.65, in terms of p).
pub(super) fn spreading_per_m(sums: &Sums, (c1, s1): (f64, f64), (c2, s2): (f64, f64)) -> f64 {
    let tube = sums.range_per_p * sums.range_by_p.abs() * s1.max(MIN_SINE) * s2.max(MIN_SINE);
    (c1 * c2 / tube.max(f64::MIN_POSITIVE)).sqrt()
}

impl<'a> Path<'a> {
    fn between_depths(
        profile: &'a SoundSpeedProfile,
        from_m: f64,
        to_m: f64,
        range_m: f64,
    ) -> Self {
        Self {
            profile,
            upper_m: from_m.min(to_m),
            lower_m: from_m.max(to_m),
            range_m,
        }
    }

    /// The ray that turns nowhere, else the earlier of those that turn above and below.
    fn earliest(&self, floor_m: f64) -> Option<Found> {
        self.direct().or_else(|| {
            let above = self.turning(Turn::Above, 0.0);
            let below = self.turning(Turn::Below, floor_m);
            match (above, below) {
                (Some(a), Some(b)) if b.sums.time_s < a.sums.time_s => Some(b),
                (above, below) => above.or(below),
            }
        })
    }

    fn is_level(&self) -> bool {
        self.lower_m - self.upper_m < SAME_DEPTH_M
    }

    /// Sums from the upper to the lower end; `sine` is that of a speed.
    fn between(&self, p: f64, sine: impl Fn(f64) -> f64) -> Sums {
        let mut sums = Sums::default();
        if !self.is_level() {
            self.profile
                .layers(self.upper_m, self.lower_m, |(z1, c1), (z2, c2)| {
                    let layer = (z2 - z1, (c2 - c1) / (z2 - z1));
                    sums.add(p, layer, (c1, sine(c1)), (c2, sine(c2)));
                });
        }
        sums
    }

    fn ends(&self) -> (f64, f64) {
        let speed = |depth_m| self.profile.at_m_per_s(depth_m);
        (speed(self.upper_m), speed(self.lower_m))
    }

    /// Highest speed between the ends, and whether a layer has it throughout.
    fn fastest(&self) -> (f64, bool) {
        let (upper, lower) = self.ends();
        let (mut fastest, mut throughout) = (upper.max(lower), false);
        self.profile
            .layers(self.upper_m, self.lower_m, |(_, c1), (_, c2)| {
                let c = c1.max(c2);
                throughout = (throughout && c <= fastest) || (c1 == c2 && c >= fastest);
                fastest = fastest.max(c);
            });
        (fastest, throughout)
    }

    /// The ray that turns nowhere. With m = p / sqrt(1 - p^2 c^2), c the highest speed between the ends, the range is an increasing and concave function
    /// of m, so Newton's method converges from a range that is too short, such as that of the straight line.
    fn direct(&self) -> Option<Found> {
        let (fastest, throughout) = self.fastest();
        let (c_upper, c_lower) = self.ends();
        if self.is_level() {
            return self.level();
        }
        if !throughout {
            let level_sine = |c: f64| ((fastest - c) * (fastest + c)).sqrt() / fastest;
            let p = 1.0 / fastest;
            let farthest_m = p * self.between(p, level_sine).range_per_p;
            if self.range_m >= farthest_m {
                return None;
            }
        }
        let mut m = self.range_m / ((self.lower_m - self.upper_m) * fastest);
        let mut steps = 0;
        loop {
            let s_fastest = 1.0 / (1.0 + m * m * fastest * fastest).sqrt();
            let p = m * s_fastest;
            let sine = |c: f64| s_fastest * (1.0 + m * m * (fastest - c) * (fastest + c)).sqrt();
            let sums = self.between(p, sine);
            let short_m = self.range_m - p * sums.range_per_p;
            steps += 1;
            if short_m.abs() <= CLOSED * self.range_m || steps == MAX_STEPS {
                return Some(Found {
                    p,
                    sums,
                    turn: Turn::None,
                    upper: (c_upper, sine(c_upper)),
                    lower: (c_lower, sine(c_lower)),
                });
            }
            let next = m + short_m / (sums.range_by_p * s_fastest.powi(3));
            // Rounding decides the last digits.
            if next == m {
                steps = MAX_STEPS - 1;
            }
            m = next.max(0.0);
        }
    }

    /// The level ray of two points at one depth, where the speed does not change there.
    fn level(&self) -> Option<Found> {
        let depth_m = self.upper_m;
        let c = self.profile.at_m_per_s(depth_m);
        let near = |dz: f64| self.profile.at_m_per_s(depth_m + dz) == c;
        if self.range_m > SAME_DEPTH_M && !(near(SAME_DEPTH_M) && near(-SAME_DEPTH_M)) {
            return None;
        }
        let range_m = self.range_m.max(SAME_DEPTH_M);
        // Spreading is 1 / distance: see `spreading_per_m`.
        let tube = range_m * c / MIN_SINE;
        Some(Found {
            p: 1.0 / c,
            sums: Sums {
                range_per_p: tube,
                range_by_p: tube,
                time_s: range_m / c,
                length_m: range_m,
            },
            turn: Turn::None,
            upper: (c, 0.0),
            lower: (c, 0.0),
        })
    }

    /// The ray that turns above or below both ends, no farther than `limit_m`. Of several, the one with the turn nearest to the ends.
    fn turning(&self, turn: Turn, limit_m: f64) -> Option<Found> {
        let (end_m, is_within) = match turn {
            Turn::None => return None,
            Turn::Above => (self.upper_m, limit_m < self.upper_m),
            Turn::Below => (self.lower_m, limit_m > self.lower_m),
        };
        if !is_within {
            return None;
        }
        let (mut fastest, _) = self.fastest();
        let mut found = None;
        self.profile.layers(end_m, limit_m, |near, far| {
            if found.is_some() || far.1 <= near.1 || far.1 <= fastest {
                fastest = fastest.max(far.1);
                return;
            }
            found = self.turn_within(turn, end_m, near, far, fastest.max(near.1));
            fastest = far.1;
        });
        found
    }

    /// The ray that turns in a layer between `near` and `far`, (depth, speed), at a speed above `slowest`.
    fn turn_within(
        &self,
        turn: Turn,
        end_m: f64,
        near: (f64, f64),
        far: (f64, f64),
        slowest: f64,
    ) -> Option<Found> {
        let gradient = (far.1 - near.1) / (far.0 - near.0).abs();
        let (c_upper, c_lower) = self.ends();
        // By the excess of the speed at the turn over `slowest`.
        let at = |excess: f64| {
            let fastest = slowest + excess;
            let p = 1.0 / fastest;
            let sine =
                |c: f64| (((slowest - c) + excess).max(0.0) * (fastest + c)).sqrt() / fastest;
            let mut sums = self.between(p, sine);
            self.profile.layers(end_m, near.0, |(z1, c1), (z2, c2)| {
                let thick_m = (z2 - z1).abs();
                let layer = (thick_m, (c2 - c1) / thick_m);
                // Outwards and back.
                for _ in 0..2 {
                    sums.add(p, layer, (c1, sine(c1)), (c2, sine(c2)));
                }
            });
            sums.add_turn(p, gradient, (near.1, sine(near.1)));
            Found {
                p,
                sums,
                turn,
                upper: (c_upper, sine(c_upper)),
                lower: (c_lower, sine(c_lower)),
            }
        };
        let beyond_m = |found: &Found| found.p * found.sums.range_per_p - self.range_m;
        let (mut low, mut high) = (0.0, far.1 - slowest);
        // A turn at the very end of a layer of one speed lies infinitely far away.
        let first = beyond_m(&at(high * f64::EPSILON));
        let last = beyond_m(&at(high));
        if first.is_nan() || last.is_nan() || (first > 0.0) == (last > 0.0) {
            return None;
        }
        for _ in 0..BISECTIONS {
            let middle = 0.5 * (low + high);
            if middle == low || middle == high {
                break;
            }
            match (beyond_m(&at(middle)) > 0.0) == (last > 0.0) {
                true => high = middle,
                false => low = middle,
            }
        }
        Some(at(0.5 * (low + high)))
    }
}

/// A scatterer as seen along its ray, in water of the array's own sound speed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Seen {
    /// Place from which sound would arrive with the time and the direction of the ray, world, metres.
    pub position_m: DVec3,
    /// Factor on the pressure of an echo over both legs: spreading and absorption of the ray relative to those of the virtual point.
    pub gain: f64,
    /// Cosine and sine of the rotation from the ray at the scatterer to the ray at the array, in the vertical plane of the ray. The sine is positive from
    /// outward to down.
    turn: (f64, f64),
    /// Horizontal unit vector from the array to the scatterer.
    outward: (f64, f64),
}

/// The scatterer at `at_m` (world, metres) as the array of `water` sees it, by a ray of its own. `nepers_per_m`: absorption, one way. None in a shadow of
/// the water.
pub fn seen(water: &Refraction, nepers_per_m: f64, at_m: DVec3) -> Option<Seen> {
    let range_m = (at_m - water.array_m).truncate().length();
    let ray = ray(
        &water.profile,
        water.array_m.z,
        at_m.z,
        range_m,
        water.floor_m,
    )?;
    let c0 = water.sound_speed_m_per_s();
    Some(Seen::new((water.array_m, c0), nepers_per_m, at_m, &ray))
}

impl Seen {
    #[inline]
    fn new((array_m, c0): (DVec3, f64), nepers_per_m: f64, at_m: DVec3, ray: &Ray) -> Self {
        let offset_m = at_m - array_m;
        let range_m = offset_m.truncate().length();
        let outward = match range_m > 0.0 {
            true => (offset_m.x / range_m, offset_m.y / range_m),
            false => (1.0, 0.0),
        };
        let (a, s) = (ray.start, ray.end);
        let way = DVec3::new(a.outward * outward.0, a.outward * outward.1, a.down);
        let distance_m = c0 * ray.time_s;
        let spread = (distance_m * ray.spreading_per_m).powi(2);
        let excess_m = ray.length_m - distance_m;
        Self {
            position_m: array_m + distance_m * way,
            gain: spread.min(MAX_FOCUS) * libm::exp(-2.0 * nepers_per_m * excess_m),
            turn: (
                s.outward * a.outward + s.down * a.down,
                s.outward * a.down - s.down * a.outward,
            ),
            outward,
        }
    }

    /// A normal at the scatterer, rotated so that its angles with the rays are the same at the virtual point.
    #[inline]
    pub fn normal(&self, normal: [f32; 3]) -> [f32; 3] {
        let [x, y, z] = normal.map(f64::from);
        let ((e_x, e_y), (cos, sin)) = (self.outward, self.turn);
        let along = x * e_x + y * e_y;
        let shift = along * cos - z * sin - along;
        [
            (x + shift * e_x) as f32,
            (y + shift * e_y) as f32,
            (along * sin + z * cos) as f32,
        ]
    }
}

/// Number of tabulated rays. With this number the interpolation is off by less than 1e-11 s at 100 m.
pub(super) const RAYS: usize = 96;
/// Sine of the elevation below which a ray is not tabulated, at any depth. A scatterer there gets a ray of its own.
pub(super) const MIN_TABLE_SINE: f64 = 0.02;
/// Rows of scatterers of one task.
const ROWS: usize = 1024;

/// A tabulated ray at a knot.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Node {
    pub(super) sums: Sums,
    /// Sine of the elevation.
    pub(super) sine: f64,
}

/// Depth of the array, or of a point of the profile below it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Knot {
    pub(super) depth_m: f64,
    pub(super) c: f64,
    /// Of the layer below.
    pub(super) gradient_per_s: f64,
    /// Number of the rays, the steepest first, that reach this depth at an elevation that is tabulated.
    pub(super) rays: usize,
}

/// Tangents of the tabulated rays at the array, from straight down.
pub(super) fn table_tangents() -> [f64; RAYS] {
    let last = libm::acosh(1.0 / MIN_TABLE_SINE);
    std::array::from_fn(|j| libm::sinh(last * j as f64 / (RAYS - 1) as f64))
}

/// The rays of one array, and the virtual points of scatterers along them.
///
/// Time, tube and length of [`RAYS`] rays are tabulated at the points of the profile below the array. At the depth of a scatterer, the two rays beside it
/// give the time over range by its value, its first derivative (p) and its second (dp/dr) at two ranges. These make a polynomial of degree five, whose
/// derivative is the ray parameter of the scatterer. Scatterers above the array, and those beyond the table, get a ray of their own ([`ray`]).
#[derive(Clone, Debug)]
pub struct VirtualPoints {
    water: Refraction,
    c0: f64,
    nepers_per_m: f64,
    /// The table ends here.
    deepest_m: f64,
    /// Tangents of the tabulated rays at the array, from straight down.
    tangents: [f64; RAYS],
    /// Their parameters.
    p: [f64; RAYS],
    knots: Vec<Knot>,
    /// [`RAYS`] for each knot.
    nodes: Vec<Node>,
}

impl VirtualPoints {
    /// Allocates the table for `profile`.
    pub fn new(profile: Arc<SoundSpeedProfile>) -> Self {
        let knots = profile.points().len() + 1;
        Self {
            water: Refraction {
                profile,
                array_m: DVec3::ZERO,
                floor_m: 0.0,
                reflections: None,
                places: Default::default(),
            },
            c0: f64::NAN,
            nepers_per_m: 0.0,
            deepest_m: f64::NEG_INFINITY,
            tangents: table_tangents(),
            p: [0.0; RAYS],
            knots: Vec::with_capacity(knots),
            nodes: Vec::with_capacity(knots * RAYS),
        }
    }

    /// The profile of the rays.
    pub fn profile(&self) -> &Arc<SoundSpeedProfile> {
        &self.water.profile
    }

    /// Tabulates the rays of `water` down to `deepest_m`. `absorption_db_per_m`: one way.
    pub fn aim(&mut self, water: &Refraction, absorption_db_per_m: f64, deepest_m: f64) {
        self.water.clone_from(water);
        let array_m = water.array_m;
        let c0 = water.sound_speed_m_per_s();
        (self.c0, self.deepest_m) = (c0, deepest_m);
        self.nepers_per_m = absorption_db_per_m * std::f64::consts::LN_10 / 20.0;
        self.knots.clear();
        self.nodes.clear();
        let first = |tangent: f64| Node {
            sums: Sums::default(),
            sine: 1.0 / (1.0 + tangent * tangent).sqrt(),
        };
        for (p, tangent) in self.p.iter_mut().zip(self.tangents) {
            *p = tangent * first(tangent).sine / c0;
        }
        let (knots, nodes, p) = (&mut self.knots, &mut self.nodes, &self.p);
        nodes.extend(self.tangents.iter().map(|tangent| first(*tangent)));
        let mut rays = RAYS;
        water
            .profile
            .layers(array_m.z, deepest_m.max(array_m.z), |(z1, c1), (z2, c2)| {
                let layer = (z2 - z1, (c2 - c1) / (z2 - z1));
                knots.push(Knot {
                    depth_m: z1,
                    c: c1,
                    gradient_per_s: layer.1,
                    rays,
                });
                let sine = |p: f64| (1.0 - p * p * c2 * c2).max(0.0).sqrt();
                rays = p[..rays].partition_point(|p| sine(*p) >= MIN_TABLE_SINE);
                let begin = nodes.len() - RAYS;
                for j in 0..RAYS {
                    let mut node = nodes[begin + j];
                    if j < rays {
                        let s2 = sine(p[j]);
                        node.sums.add(p[j], layer, (c1, node.sine), (c2, s2));
                        node.sine = s2;
                    }
                    nodes.push(node);
                }
            });
    }

    /// The scatterer at `at_m` (world, metres) as the array sees it. None in a shadow of the water.
    pub fn seen(&self, at_m: DVec3) -> Option<Seen> {
        let range_m = (at_m - self.water.array_m).truncate().length();
        match self.tabulated(range_m, at_m.z) {
            Some(ray) => {
                let from = (self.water.array_m, self.c0);
                Some(Seen::new(from, self.nepers_per_m, at_m, &ray))
            }
            None => seen(&self.water, self.nepers_per_m, at_m),
        }
    }

    /// The ray by the table.
    #[inline]
    fn tabulated(&self, range_m: f64, depth_m: f64) -> Option<Ray> {
        if depth_m > self.deepest_m {
            return None;
        }
        let below = self.knots.partition_point(|knot| knot.depth_m <= depth_m);
        let k = below.checked_sub(1)?;
        let knot = &self.knots[k];
        let thick_m = depth_m - knot.depth_m;
        let c = knot.c + knot.gradient_per_s * thick_m;
        let nodes = &self.nodes[k * RAYS..][..RAYS];
        let sine = |j: usize| (1.0 - (self.p[j] * c) * (self.p[j] * c)).max(0.0).sqrt();
        let range_of = |j: usize| {
            let (p, node) = (self.p[j], &nodes[j]);
            p * (node.sums.range_per_p + (knot.c + c) * thick_m / (node.sine + sine(j)))
        };
        let rays = knot.rays;
        let straight = range_m / (depth_m - self.water.array_m.z);
        let mut j = self.tangents.partition_point(|t| *t <= straight);
        j = j.saturating_sub(1).min(rays.checked_sub(2)?);
        while j > 0 && range_of(j) > range_m {
            j -= 1;
        }
        while j + 2 < rays && range_of(j + 1) <= range_m {
            j += 1;
        }
        if sine(j + 1) < MIN_TABLE_SINE {
            return None;
        }
        let at = |j: usize| {
            let (p, node) = (self.p[j], &nodes[j]);
            let (mut sums, s) = (node.sums, sine(j));
            let layer = (thick_m, knot.gradient_per_s);
            sums.add(p, layer, (knot.c, node.sine), (c, s));
            let tube = sums.range_per_p * sums.range_by_p * self.nodes[j].sine * s;
            let spread = (self.c0 * sums.time_s).powi(2) * self.c0 * c / tube;
            (p, sums, spread)
        };
        let ((p0, a, spread0), (p1, b, spread1)) = (at(j), at(j + 1));
        let (x, time_s, p) = between_rays((p0, &a), (p1, &b), range_m)?;
        let between = |a: f64, b: f64| a + (b - a) * x;
        let excess = |sums: &Sums| sums.length_m - self.c0 * sums.time_s;
        let towards = |c: f64| Elevation {
            outward: p * c,
            down: (1.0 - (p * c) * (p * c)).sqrt(),
        };
        let distance_m = self.c0 * time_s;
        Some(Ray {
            time_s,
            length_m: distance_m + between(excess(&a), excess(&b)),
            start: towards(self.c0),
            end: towards(c),
            spreading_per_m: between(spread0, spread1).sqrt() / distance_m,
        })
    }

    /// Replaces every scatterer by its virtual point. One without a ray keeps its place and loses its strength. Returns the number of these.
    pub fn replace(&self, scatterers: &mut Scatterers) -> u64 {
        let rows = scatterers
            .north_m
            .par_chunks_mut(ROWS)
            .zip(scatterers.east_m.par_chunks_mut(ROWS))
            .zip(scatterers.down_m.par_chunks_mut(ROWS))
            .zip(scatterers.normal.par_chunks_mut(ROWS))
            .zip(scatterers.strength.par_chunks_mut(ROWS));
        rows.map(|((((north, east), down), normal), strength)| {
            let mut unseen = 0;
            for i in 0..north.len() {
                let at_m = DVec3::new(north[i], east[i], down[i]);
                match self.seen(at_m) {
                    Some(seen) => {
                        [north[i], east[i], down[i]] = seen.position_m.to_array();
                        normal[i] = seen.normal(normal[i]);
                        strength[i] *= seen.gain;
                    }
                    None => {
                        strength[i] = Complex64::ZERO;
                        unseen += 1;
                    }
                }
            }
            unseen
        })
        .sum()
    }
}

/// Largest phase error of an element that lies at most `level_m` level and `vertical_m` vertical metres from the place of the array, radians: bound of the
/// relative error of its samples. For scatterers at `depth_m` that a ray of the table reaches, at rest, to second order in the offset. [`place_error`] is that
/// of one place.
///
/// The delay at an element is the delay at the array, its gradient, which is that of the virtual point, and a curvature, which differs: over range it is
/// dp/dr instead of s^2 / (c0 R), across it p / r instead of 1 / (c0 R), with R = c0 T. The rest follows from the eikonal equation T_r^2 + T_z^2 = 1 / c^2.
/// The same holds for the displacement of the platform between pulse and echo.
pub fn virtual_point_error(
    water: &Refraction,
    frequency_hz: f64,
    (level_m, vertical_m): (f64, f64),
    depth_m: f64,
) -> f64 {
    let mut table = VirtualPoints::new(water.profile.clone());
    table.aim(water, 0.0, depth_m);
    let c0 = table.c0;
    let gradient_per_s = water.profile.max_gradient_per_s();
    let errors_s = (1..RAYS).filter_map(|j| {
        let p = table.p[j];
        let path = Path {
            profile: &water.profile,
            upper_m: water.array_m.z,
            lower_m: depth_m,
            range_m: 0.0,
        };
        let sine = |c: f64| (1.0 - (p * c) * (p * c)).max(0.0).sqrt();
        if depth_m <= path.upper_m || sine(path.fastest().0) < MIN_TABLE_SINE {
            return None;
        }
        let sums = path.between(p, sine);
        let offsets_m = (level_m, vertical_m);
        Some(curvature_error_s((c0, p), &sums, gradient_per_s, offsets_m))
    });
    let direct_s = errors_s.fold(0.0, f64::max);
    let reflected_s = reflected_point_error_s(water, (level_m, vertical_m), depth_m);
    std::f64::consts::PI * frequency_hz * direct_s.max(reflected_s)
}

/// Sine of the elevation at the array below which a ray counts as so steep: the curvature upright grows without bound there.
const LEVEL_SINE: f64 = 1e-3;

/// Twice the error of the delay of one ray at an offset from the array, seconds.
pub(super) fn curvature_error_s(
    (c0, p): (f64, f64),
    sums: &Sums,
    gradient_per_s: f64,
    (level_m, vertical_m): (f64, f64),
) -> f64 {
    let s = (1.0 - (p * c0) * (p * c0)).max(0.0).sqrt().max(LEVEL_SINE);
    let virtual_s = 1.0 / (c0 * c0 * sums.time_s);
    let along = (1.0 / sums.range_by_p - s * s * virtual_s).abs();
    let across = (1.0 / sums.range_per_p - virtual_s).abs();
    // Tangent of the ray, from the vertical.
    let slope = p * c0 / s;
    let vertical = slope * slope * along + gradient_per_s / (c0 * c0 * s);
    level_m * level_m * along.max(across)
        + 2.0 * level_m * vertical_m * slope * along
        + vertical_m * vertical_m * vertical
}

/// The ray of a range between two tabulated ones: its share of the way from the first to the second, travel time and parameter.
#[inline(always)]
pub(super) fn between_rays(
    (p0, a): (f64, &Sums),
    (p1, b): (f64, &Sums),
    range_m: f64,
) -> Option<(f64, f64, f64)> {
    let (r0, r1) = (p0 * a.range_per_p, p1 * b.range_per_p);
    let h = r1 - r0;
    let x = (range_m - r0) / h;
    if !(0.0..=1.0).contains(&x) {
        return None;
    }
    let ends = [
        (a.time_s, b.time_s),
        (h * p0, h * p1),
        (h * h / a.range_by_p, h * h / b.range_by_p),
    ];
    let (time_s, slope) = quintic(ends, x);
    Some((x, time_s, slope / h))
}

/// The polynomial of degree five with value, slope and curvature `(at 0, at 1)`: its value and slope at `x`.
#[inline(always)]
fn quintic([(v0, v1), (d0, d1), (e0, e1)]: [(f64, f64); 3], x: f64) -> (f64, f64) {
    let (a, b, c) = (v1 - v0 - d0 - 0.5 * e0, d1 - d0 - e0, e1 - e0);
    let c3 = 10.0 * a - 4.0 * b + 0.5 * c;
    let c4 = -15.0 * a + 7.0 * b - c;
    let c5 = 6.0 * a - 3.0 * b + 0.5 * c;
    let value = v0 + x * (d0 + x * (0.5 * e0 + x * (c3 + x * (c4 + x * c5))));
    let slope = d0 + x * (e0 + x * (3.0 * c3 + x * (4.0 * c4 + x * 5.0 * c5)));
    (value, slope)
}
