//! Scatterers, the footprints that select them, and targets.

use std::sync::Arc;

use glam::DVec3;
use num_complex::Complex64;

use crate::frames::{VectorKnot, hermite};
use crate::time::UtcNs;

// ---------------------------------------------------------------- the scene

/// Dependence of a scatterer's pressure on the angles i (incident) and s (scattered) between its normal and the two rays. A
/// scatterer does not radiate behind its normal.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ScatterLaw {
    /// Independent of direction.
    Point,
    /// As `Point`, one of many that stand for the water and are drawn for a single ping.
    Water,
    /// Factor sqrt(cos i cos s) (bistatic Lambert).
    Lambert,
    /// Factor cos i of the incident ray, independent of the receiver (Meng et al. 2023, Eq. 13).
    LambertOneWay,
    /// Product of [`LawCurve::half`] for both rays, with the curve of the scatterers.
    Curve,
}

/// Backscattering strength over the angle of incidence, tabulated as the pressure factor of one leg. The factors of both legs
/// multiply.
#[derive(Clone, Debug, PartialEq)]
pub struct LawCurve {
    /// Fourth roots of the strength at even steps of the square root of the cosine, from grazing to normal incidence.
    half: Box<[f64; Self::STEPS + 1]>,
}

impl LawCurve {
    /// Number of steps: a Gaussian lobe 3 degrees wide is accurate to 0.01 dB, and the table of 32 KiB fits the L1 cache.
    const STEPS: usize = 4096;

    /// Curve of `strength`: backscattered power per square metre of seabed, as a function of the cosine of incidence (0 to 1).
    pub fn new(strength: impl Fn(f64) -> f64) -> Self {
        let mut half = Box::new([0.0; Self::STEPS + 1]);
        for (k, half) in half.iter_mut().enumerate() {
            let root = k as f64 / Self::STEPS as f64;
            *half = strength(root * root).max(0.0).sqrt().sqrt();
        }
        Self { half }
    }

    /// Pressure factor of one leg, interpolated linearly. `root` is the square root of the cosine of incidence, 0 to 1.
    #[inline(always)]
    pub fn half(&self, root: f64) -> f64 {
        let x = root * Self::STEPS as f64;
        let k = (x as usize).min(Self::STEPS - 1);
        self.half[k] + (x - k as f64) * (self.half[k + 1] - self.half[k])
    }
}

/// Point scatterers as a structure of arrays of equal length.
#[derive(Clone, Debug, Default)]
pub struct Scatterers {
    /// World north, metres.
    pub north_m: Vec<f64>,
    /// World east, metres.
    pub east_m: Vec<f64>,
    /// World down, metres.
    pub down_m: Vec<f64>,
    /// Outward unit normal, world axes; unused for points.
    pub normal: Vec<[f32; 3]>,
    /// Echo pressure at 1 m for unit incident pressure. For a seabed patch it is sqrt(mu area) times a fixed complex
    /// reflectivity.
    pub strength: Vec<Complex64>,
    /// Directional law.
    pub law: Vec<ScatterLaw>,
    /// Factor that lowers the pattern floor ([`ModelChoice::cull_db`](crate::model::ModelChoice::cull_db)) for a scatterer
    /// stronger than the seabed, and raises it for a reflected echo.
    pub loud: Vec<f32>,
    /// Curve of scatterers with [`ScatterLaw::Curve`]. Without a curve their pressure is zero.
    pub curve: Option<Arc<LawCurve>>,
    /// Transmit points; empty where every scatterer is its own.
    pub transmit: TransmitPoints,
    /// Number of the last scatterers that are not of the scene: the sea surface and reflected echoes.
    pub appended: usize,
    /// The few that move; in none of the other lists.
    pub moving: Vec<MovingScatterer>,
}

/// Points to which the transmit legs lead, for echoes whose two legs differ: the positions of the scatterers are then those of the
/// receive legs. As many as there are scatterers, or none.
#[derive(Clone, Debug, Default)]
pub struct TransmitPoints {
    /// World north, metres.
    pub north_m: Vec<f64>,
    /// World east, metres.
    pub east_m: Vec<f64>,
    /// World down, metres.
    pub down_m: Vec<f64>,
    /// Outward unit normal as the transmit leg sees it, world axes.
    pub normal: Vec<[f32; 3]>,
}

impl TransmitPoints {
    /// Whether every scatterer is its own transmit point.
    pub fn is_empty(&self) -> bool {
        self.north_m.is_empty()
    }

    fn truncate(&mut self, len: usize) {
        self.north_m.truncate(len);
        self.east_m.truncate(len);
        self.down_m.truncate(len);
        self.normal.truncate(len);
    }
}

/// A point scatterer in motion during a ping: at `position_m + velocity_m_per_s t + acceleration_m_per_s2 (t - hit_s)^2 / 2`, t seconds after the start of
/// the pulse.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MovingScatterer {
    /// World, metres: the place where the sound finds it, moved back at its velocity to the start of the pulse.
    pub position_m: DVec3,
    /// World, metres per second, when the sound finds it.
    pub velocity_m_per_s: DVec3,
    /// World, metres per second squared.
    pub acceleration_m_per_s2: DVec3,
    /// When the sound finds it, seconds after the start of the pulse.
    pub hit_s: f64,
    /// As in [`Scatterers`].
    pub normal: [f32; 3],
    /// As in [`Scatterers`].
    pub strength: Complex64,
    /// Directional law; not [`ScatterLaw::Curve`].
    pub law: ScatterLaw,
    /// Index of its target; [`Self::OF_SURFACE`] for one of the sea surface, and for an echo that the surface reflects.
    pub target: u32,
    /// Where the transmit leg leads, for a reflected echo whose two legs differ; its position is then that of the receive leg.
    pub transmit: Option<MovingPoint>,
}

/// A point in motion, as that of a [`MovingScatterer`], with the same `hit_s`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MovingPoint {
    /// World, metres.
    pub position_m: DVec3,
    /// World, metres per second.
    pub velocity_m_per_s: DVec3,
    /// World, metres per second squared.
    pub acceleration_m_per_s2: DVec3,
}

impl MovingScatterer {
    /// In place of the index of a target.
    pub const OF_SURFACE: u32 = u32::MAX;
}

impl Scatterers {
    /// Number of scatterers that do not move.
    pub fn len(&self) -> usize {
        self.north_m.len()
    }
    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.north_m.is_empty() && self.moving.is_empty()
    }
    /// Removes all scatterers.
    pub fn clear(&mut self) {
        self.truncate(0);
        self.moving.clear();
    }
    /// Removes all but the first `len` scatterers, and none that move.
    pub fn truncate(&mut self, len: usize) {
        self.north_m.truncate(len);
        self.east_m.truncate(len);
        self.down_m.truncate(len);
        self.normal.truncate(len);
        self.strength.truncate(len);
        self.law.truncate(len);
        self.loud.truncate(len);
        self.transmit.truncate(len);
    }
    /// Number of scatterers of the scene, the first ones.
    pub fn of_scene(&self) -> usize {
        self.len().saturating_sub(self.appended)
    }
    /// Removes what was appended to the scatterers of the scene.
    pub fn truncate_to_scene(&mut self) {
        self.truncate(self.of_scene());
        self.transmit.truncate(0);
        self.appended = 0;
    }
    /// Appends scatterers that are not of the scene. Where they have transmit points, the others become their own.
    pub fn append(&mut self, more: &Self) {
        if !more.transmit.is_empty() && self.transmit.is_empty() {
            self.transmit.north_m.extend_from_slice(&self.north_m);
            self.transmit.east_m.extend_from_slice(&self.east_m);
            self.transmit.down_m.extend_from_slice(&self.down_m);
            self.transmit.normal.extend_from_slice(&self.normal);
        }
        if !self.transmit.is_empty() {
            let own = more.transmit.is_empty();
            let [north_m, east_m, down_m] = match own {
                true => [&more.north_m, &more.east_m, &more.down_m],
                false => [
                    &more.transmit.north_m,
                    &more.transmit.east_m,
                    &more.transmit.down_m,
                ],
            };
            let normal = if own {
                &more.normal
            } else {
                &more.transmit.normal
            };
            self.transmit.north_m.extend_from_slice(north_m);
            self.transmit.east_m.extend_from_slice(east_m);
            self.transmit.down_m.extend_from_slice(down_m);
            self.transmit.normal.extend_from_slice(normal);
        }
        self.north_m.extend_from_slice(&more.north_m);
        self.east_m.extend_from_slice(&more.east_m);
        self.down_m.extend_from_slice(&more.down_m);
        self.normal.extend_from_slice(&more.normal);
        self.strength.extend_from_slice(&more.strength);
        self.law.extend_from_slice(&more.law);
        self.loud.extend_from_slice(&more.loud);
        self.appended += more.len();
    }
    /// Appends a copy of scatterer `i` of others, with `factor` on its strength. Those before it must have transmit points where it has one.
    pub fn push_copy(&mut self, others: &Self, i: usize, factor: f64) {
        let strength = others.strength[i] * factor;
        self.push(
            others.position_m(i),
            others.normal[i],
            strength,
            others.law[i],
        );
        if let Some(loud) = self.loud.last_mut() {
            *loud = others.loud[i];
        }
        if !others.transmit.is_empty() {
            self.push_transmit(others.transmit_m(i), others.transmit_normal(i));
        }
    }
    /// Appends the transmit point of the last scatterer.
    pub fn push_transmit(&mut self, position_m: DVec3, normal: [f32; 3]) {
        self.transmit.north_m.push(position_m.x);
        self.transmit.east_m.push(position_m.y);
        self.transmit.down_m.push(position_m.z);
        self.transmit.normal.push(normal);
    }
    /// Transmit point of scatterer `i`, world, metres.
    pub fn transmit_m(&self, i: usize) -> DVec3 {
        let TransmitPoints {
            north_m,
            east_m,
            down_m,
            ..
        } = &self.transmit;
        match north_m.is_empty() {
            true => self.position_m(i),
            false => DVec3::new(north_m[i], east_m[i], down_m[i]),
        }
    }
    /// Normal of scatterer `i` as its transmit leg sees it.
    pub fn transmit_normal(&self, i: usize) -> [f32; 3] {
        let normals = match self.transmit.is_empty() {
            true => &self.normal,
            false => &self.transmit.normal,
        };
        normals[i]
    }
    /// Copies scatterer `from` over scatterer `to`.
    pub fn copy_within(&mut self, from: usize, to: usize) {
        self.north_m[to] = self.north_m[from];
        self.east_m[to] = self.east_m[from];
        self.down_m[to] = self.down_m[from];
        self.normal[to] = self.normal[from];
        self.strength[to] = self.strength[from];
        self.law[to] = self.law[from];
        self.loud[to] = self.loud[from];
        if !self.transmit.is_empty() {
            self.transmit.north_m[to] = self.transmit.north_m[from];
            self.transmit.east_m[to] = self.transmit.east_m[from];
            self.transmit.down_m[to] = self.transmit.down_m[from];
            self.transmit.normal[to] = self.transmit.normal[from];
        }
    }
    /// Changes the number of scatterers; new ones have zero strength. Not for scatterers with transmit points.
    pub fn resize(&mut self, len: usize) {
        self.north_m.resize(len, 0.0);
        self.east_m.resize(len, 0.0);
        self.down_m.resize(len, 0.0);
        self.normal.resize(len, [0.0; 3]);
        self.strength.resize(len, Complex64::ZERO);
        self.law.resize(len, ScatterLaw::Point);
        self.loud.resize(len, 1.0);
    }
    /// Appends a scatterer: position in world metres, outward unit normal, strength and law.
    pub fn push(
        &mut self,
        position_m: DVec3,
        normal: [f32; 3],
        strength: Complex64,
        law: ScatterLaw,
    ) {
        self.north_m.push(position_m.x);
        self.east_m.push(position_m.y);
        self.down_m.push(position_m.z);
        self.normal.push(normal);
        self.strength.push(strength);
        self.law.push(law);
        self.loud.push(1.0);
    }
    /// Position of scatterer `i`, world, metres.
    pub fn position_m(&self, i: usize) -> DVec3 {
        DVec3::new(self.north_m[i], self.east_m[i], self.down_m[i])
    }
}

/// Region of the scene from which a pair of transmitter and receive array can receive echoes. The region is a sphere without the
/// directions in which the two-way pattern is below the floor, and without the region behind a baffle. A footprint with a
/// non-finite value is empty.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Footprint {
    /// Transmitter, world, metres.
    pub apex_m: DVec3,
    /// Centre of the receive array, world, metres.
    pub receiver_m: DVec3,
    /// Radius of the sphere around the apex, metres.
    pub max_range_m: f64,
    /// Bounds of the pattern: length and width of transmitter and element.
    pub sides: [PatternSide; Self::SIDES],
    /// Ratio of the maximum of the product of the sides to its floor; infinity keeps all directions, 1 those within a fan.
    pub depth: f64,
    /// Faces of transmitter and element.
    pub faces: [BaffledFace; 2],
    /// What the array resolves; the automatic density of the seabed follows it.
    pub cell: ResolutionCell,
}

/// Smallest region that an array resolves: `range_m` along the ray, `beam_rad` times the range across it. Zeros resolve everything.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ResolutionCell {
    /// Range resolution, metres.
    pub range_m: f64,
    /// Beam width, radians.
    pub beam_rad: f64,
    /// Width of the beams that divide a range cell of steeply insonified ground, radians; 1 where no beams do.
    pub across_rad: f64,
}

impl ResolutionCell {
    /// Least ratio of the range cell to its length on the ground at a range. That length has two limits: the width of a beam across the track, and the
    /// radius of the first range cell, a disc below the sonar.
    #[inline(always)]
    pub fn min_slant(&self, range_m: f64) -> f64 {
        if self.across_rad == 0.0 {
            return 1.0;
        }
        let of_beam = self.range_m / (self.across_rad * range_m);
        of_beam.max((2.0 * self.range_m / range_m).sqrt()).min(1.0)
    }
}

/// Share of the scatterers of the main lobe's density that a ping keeps where the envelope of the two-way pressure pattern is `envelope` of its maximum:
/// `lobes` times the envelope, at most 1. With `lobes` below 1, the main lobe is as with 1, up to the first null of a line (envelope 1 / pi).
#[inline(always)]
pub fn kept_share(lobes: f64, envelope: f64) -> f64 {
    let of_main = envelope * (std::f64::consts::PI * envelope).min(1.0);
    (lobes * envelope).max(of_main).min(1.0)
}

/// Bound on the pattern along one side of a rectangular radiator. The pattern stays below 1 / (u / knee), with u the sine of the
/// angle from broadside.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PatternSide {
    /// Direction of the side, world, unit vector.
    pub axis: DVec3,
    /// Sine above which the bound is less than 1: lambda / (pi L); infinite for a side of length zero.
    pub knee: f64,
    /// Factor of the knee up to which scatterers are kept, 1 or more: reflected echoes arrive with a smaller sine. It does not change
    /// [`Footprint::below_maximum`].
    pub reach: f64,
    /// Error of the sine from the rotation of the platform.
    pub turn: f64,
    /// Error of the product of sine and range from the distance between the radiator and the apex, metres.
    pub shift_m: f64,
}

/// A face without response behind it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BaffledFace {
    /// Outward unit normal, world axes; zero for an open face.
    pub normal: DVec3,
    /// Error of the sine from the rotation of the platform, as in [`PatternSide`].
    pub turn: f64,
    /// Error from the distance between the face and the apex, metres, as in [`PatternSide`].
    pub shift_m: f64,
}

impl PatternSide {
    /// Side without a bound.
    pub const OPEN: Self = Self {
        axis: DVec3::X,
        knee: f64::INFINITY,
        reach: 1.0,
        turn: 0.0,
        shift_m: 0.0,
    };

    /// Factor by which the pattern is at least below 1, for a point at `range_m` with the component `along_m` along the axis.
    #[inline(always)]
    pub fn below(&self, along_m: f64, range_m: f64) -> f64 {
        let sine = (along_m.abs() - self.shift_m) / range_m - self.turn;
        (sine / (self.knee * self.reach)).max(1.0)
    }
}

impl BaffledFace {
    /// Face without a baffle.
    pub const OPEN: Self = Self {
        normal: DVec3::ZERO,
        turn: 0.0,
        shift_m: 0.0,
    };

    /// Whether a point at `range_m` with the component `ahead_m` along the normal can be in front of the face.
    #[inline(always)]
    pub fn may_face(&self, ahead_m: f64, range_m: f64) -> bool {
        ahead_m >= -(self.turn * range_m + self.shift_m)
    }
}

impl Footprint {
    /// Length and width of transmitter and element.
    pub(crate) const SIDES: usize = 4;

    /// All directions within range of a point (world, metres).
    pub fn all_round(apex_m: DVec3, max_range_m: f64) -> Self {
        Self {
            apex_m,
            receiver_m: apex_m,
            max_range_m,
            sides: [PatternSide::OPEN; Self::SIDES],
            depth: f64::INFINITY,
            faces: [BaffledFace::OPEN; 2],
            cell: ResolutionCell::default(),
        }
    }

    /// Directions u within range with |u . axis| at most `max_sine`.
    pub fn fan(apex_m: DVec3, max_range_m: f64, axis: DVec3, max_sine: f64) -> Self {
        let mut footprint = Self::all_round(apex_m, max_range_m);
        footprint.sides[0] = PatternSide {
            axis,
            knee: max_sine,
            ..PatternSide::OPEN
        };
        footprint.depth = 1.0;
        footprint
    }

    /// Whether a position (world, metres) is inside the footprint.
    pub fn contains(&self, position_m: DVec3) -> bool {
        let d = position_m - self.apex_m;
        self.may_face(d).is_some_and(|range_m| {
            self.depth == f64::INFINITY || self.below(d, range_m) <= self.depth
        })
    }

    /// Length of an offset from the apex, if the point is within range and in front of the faces.
    #[inline(always)]
    pub fn may_face(&self, offset_m: DVec3) -> Option<f64> {
        let range_squared = offset_m.length_squared();
        if range_squared > self.max_range_m * self.max_range_m {
            return None;
        }
        let range_m = range_squared.sqrt();
        let mut faces = self.faces.iter();
        faces
            .all(|face| face.may_face(offset_m.dot(face.normal), range_m))
            .then_some(range_m)
    }

    /// Maximum of the two-way pattern over its envelope, which has no nulls, towards a point at `offset_m` from the apex, `range_m` long. Motion does
    /// not enter.
    #[inline(always)]
    pub fn below_maximum(&self, offset_m: DVec3, range_m: f64) -> f64 {
        let sides = self.sides.iter();
        let side = |side: &PatternSide| offset_m.dot(side.axis).abs() / (range_m * side.knee);
        sides.map(|s| side(s).max(1.0)).product()
    }

    /// A lower bound of [`Self::below_maximum`] whatever the motion.
    #[inline(always)]
    fn below(&self, offset_m: DVec3, range_m: f64) -> f64 {
        let sides = self.sides.iter();
        sides
            .map(|side| side.below(offset_m.dot(side.axis), range_m))
            .product()
    }

    /// Whether all values are finite and valid.
    pub fn is_finite(&self) -> bool {
        self.apex_m.is_finite()
            && self.receiver_m.is_finite()
            && self.max_range_m >= 0.0
            && self.max_range_m.is_finite()
            && self.depth >= 0.0
            && self.sides.iter().all(|s| {
                s.axis.is_finite()
                    && s.knee >= 0.0
                    && s.reach >= 1.0
                    && s.turn >= 0.0
                    && s.shift_m >= 0.0
            })
            && self
                .faces
                .iter()
                .all(|f| f.normal.is_finite() && f.turn >= 0.0 && f.shift_m >= 0.0)
            && self.cell.range_m >= 0.0
            && self.cell.beam_rad >= 0.0
            && self.cell.across_rad >= 0.0
    }
}

/// A named strong target, for the truth file.
#[derive(Clone, Debug, PartialEq)]
pub struct Target {
    /// Name in the scene.
    pub name: String,
    /// World, metres.
    pub position_m: DVec3,
    /// Target strength, dB.
    pub target_strength_db: f64,
    /// Motion, if it moves. `position_m` is then its place at the first fix.
    pub course: Option<Course>,
}

impl Target {
    /// Position, metres, and velocity, metres per second, `after_s` seconds after an instant.
    pub fn at(&self, utc: UtcNs, after_s: f64) -> (DVec3, DVec3) {
        let still = (self.position_m, DVec3::ZERO);
        self.course.as_ref().map_or(still, |c| c.at(utc, after_s))
    }
}

/// Motion of a target over time: cubic between its knots, uniform outside them.
#[derive(Clone, Debug, PartialEq)]
pub struct Course {
    /// Positions and velocities over seconds after `origin`; at least one, times increase strictly.
    pub knots: Arc<[VectorKnot]>,
    /// Instant from which the knots count.
    pub origin: UtcNs,
    /// Added to the positions, metres.
    pub offset_m: DVec3,
}

impl Course {
    /// Position, metres, and velocity, metres per second, `after_s` seconds after an instant.
    pub fn at(&self, utc: UtcNs, after_s: f64) -> (DVec3, DVec3) {
        let time_s = (utc.0 - self.origin.0) as f64 * 1e-9 + after_s;
        let next = self.knots.partition_point(|knot| knot.time_s <= time_s);
        let around = next.saturating_sub(1)..(next + 1).min(self.knots.len());
        let (position_m, velocity) = hermite(&self.knots[around], time_s);
        (position_m + self.offset_m, velocity)
    }
}
