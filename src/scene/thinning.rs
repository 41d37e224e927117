//! Leaves out seabed scatterers that the arrays neither resolve nor receive well.
//!
//! A scatterer is kept with probability p, and its pressure is divided by sqrt(p), so that the mean intensity of every direction is unchanged (Horvitz
//! and Thompson 1952). For an array with the resolution cell dr x b r at a range r,
//!
//! ```text
//! p = (density of five scatterers a cell / density of level 0) share(k, E / E_max)
//! ```
//!
//! The cell lies on the ground: it is dr / s long, s the slope of the range along the ground, which is the sine of the incidence on flat ground. Near the
//! vertical, s has a least value ([`ResolutionCell::min_slant`]).
//!
//! The share is min(1, k E / E_max), k at least 1, or slightly more for a k below 1 ([`kept_share`]). E is the upper envelope of the two-way pressure pattern ([`Footprint::below_maximum`]), which has no nulls. E_max is its maximum over all horizontal
//! directions at the scatterer's angle from the vertical. A ping keeps the largest p of its arrays.
//!
//! Probabilities in proportion to pressure give the least variance of the intensity for a number of scatterers (Neyman 1934). The intensity of a
//! window then has a kurtosis (mean fourth over squared second moment of the pressure) of 2 + (4/3) sum(I^2 / p) / (sum I)^2.
//!
//! Every scatterer has a permanent random number u, its rank. Instead of u < p, its weight falls linearly from u = (1 - s) p to u = (1 + s) p:
//!
//! ```text
//! w^2 = g(u / p) / (p G(1 / p)),  g(t) = 1 below 1 - s, 0 above 1 + s,  G(t) = integral of g from 0 to t
//! ```
//!
//! The mean of w^2 is 1 for every p. Scatterers fade in and out as the sonar moves; nothing is remembered from ping to ping.
//!
//! The rank of a scatterer decides in which levels of tiles it is (`tiles`): level k holds the ranks up to 2^-k. A tile of level k serves where
//! (1 + s) p is below 2^-k all over it, and finer tiles are not made.

use glam::DVec3;

use super::tiles::{CELLS_PER_BLOCK, NEAREST_M, TileBox};
use echotank_core::scene::{Footprint, ResolutionCell, kept_share};

/// Scatterers that are made together. A block of a side lobe has few that may be kept: with twice as many, half of all would be made in vain.
pub(crate) const LANES: usize = 8;

/// Half of the interval of u / p in which a scatterer fades.
const FADE: f64 = 0.25;
/// Intervals of the cosine from the vertical in which [`KeepProbability::ceiling`] is linear.
const COSINES: usize = 64;
/// Horizontal directions that are tried for the maximum besides those across each side.
const AZIMUTHS: usize = 16;

/// Parameters of the automatic density.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Thinning {
    /// Cell for which level 0 is made, at [`NEAREST_M`].
    pub finest: ResolutionCell,
    /// k: probability of a scatterer in a side lobe, over the pressure relative to the main lobe's.
    pub lobes: f64,
}

/// Probabilities of one footprint of a ping.
#[derive(Clone, Debug)]
pub(crate) struct KeepProbability {
    /// Probability in the main lobe at the nearest range.
    main_lobe: f64,
    lobes: f64,
    cell: ResolutionCell,
    /// Maximum of the envelope over the horizontal directions, at even steps of the cosine from the downward vertical, -1 to 1.
    ceiling: [f64; COSINES + 1],
    /// The same and its steps.
    ceiling_f32: [[f32; COSINES]; 2],
}

impl KeepProbability {
    pub(crate) fn new(thinning: &Thinning, footprint: &Footprint) -> Self {
        let Thinning { finest, lobes } = *thinning;
        let share = |finest: f64, own: f64| finest / own.max(finest);
        let at = |k: usize| ceiling(footprint, 2.0 * k as f64 / COSINES as f64 - 1.0);
        let ceiling: [f64; COSINES + 1] = std::array::from_fn(at);
        Self {
            main_lobe: share(finest.range_m, footprint.cell.range_m)
                * share(finest.beam_rad, footprint.cell.beam_rad),
            lobes,
            cell: footprint.cell,
            ceiling_f32: [
                std::array::from_fn(|k| ceiling[k] as f32),
                std::array::from_fn(|k| (ceiling[k + 1] - ceiling[k]) as f32),
            ],
            ceiling,
        }
    }

    /// Probability, relative to level 0, of a scatterer at an offset from the apex, on ground of a slope northward and eastward; none out of range or
    /// behind the footprint's faces. The reference of [`Lanes::test`].
    #[cfg(test)]
    pub(crate) fn probability(
        &self,
        footprint: &Footprint,
        offset_m: DVec3,
        slope: glam::DVec2,
    ) -> Option<f64> {
        let range_m = footprint.may_face(offset_m)?;
        let place = (0.5 * COSINES as f64) * (offset_m.z / range_m + 1.0);
        let k = (place as usize).min(COSINES - 1);
        let step = self.ceiling[k + 1] - self.ceiling[k];
        let ceiling = self.ceiling[k] + (place - k as f64) * step;
        let below = footprint.below_maximum(offset_m, range_m);
        let slant = (offset_m.truncate() + offset_m.z * slope).length() / range_m;
        Some(self.at(range_m, below * ceiling, slant))
    }

    /// An upper bound of the probability in a box for which [`TileBox::below`] is `below`.
    pub(crate) fn max_probability(&self, tile_box: &TileBox, apex_m: DVec3, below: f64) -> f64 {
        let (least, greatest) = tile_box.down_cosines(apex_m);
        let place = |cosine: f64| (0.5 * COSINES as f64) * (cosine + 1.0);
        let nodes = place(least).floor() as usize..=place(greatest).ceil() as usize;
        let ceiling = self.ceiling[nodes].iter().copied();
        let ceiling = ceiling.fold(f64::INFINITY, f64::min);
        let min_cosine = least.max(-greatest).max(0.0);
        let slant = (1.0 - min_cosine * min_cosine).sqrt() + tile_box.max_slope;
        self.at(tile_box.distance_m(apex_m), below * ceiling, slant)
    }

    /// `relative` is the envelope's maximum over the envelope, `slant` the slope of the range along the ground. Grows with `slant` and falls with the
    /// other two.
    #[inline(always)]
    fn at(&self, range_m: f64, relative: f64, slant: f64) -> f64 {
        let range_m = range_m.max(NEAREST_M);
        let slant = slant.clamp(self.cell.min_slant(range_m), 1.0);
        self.main_lobe * NEAREST_M / range_m * slant * kept_share(self.lobes, 1.0 / relative)
    }
}

/// Positions and slopes of scatterers of a block, relative to the origin of their tile: lists of the same length.
#[derive(Clone, Copy)]
pub(crate) struct Grounds<'a> {
    pub north_m: &'a [f32],
    pub east_m: &'a [f32],
    pub down_m: &'a [f32],
    pub slope_north: &'a [f32],
    pub slope_east: &'a [f32],
}

impl Grounds<'_> {
    /// Scatterer `i`, if the tile's origin is at `offset_m`.
    #[inline(always)]
    fn relative_m(&self, offset_m: [f32; 3], i: usize) -> [f32; 3] {
        [
            offset_m[0] + self.north_m[i],
            offset_m[1] + self.east_m[i],
            offset_m[2] + self.down_m[i],
        ]
    }
}

/// What the test of the scatterers of a block against all footprints finds.
#[derive(Clone, Copy)]
pub(crate) struct Found {
    /// Greatest probability of any footprint; 0 where none has the scatterer in range and before its faces.
    pub probability: [f32; CELLS_PER_BLOCK],
    /// 1 where any footprint contains the scatterer, else 0. As wide as a probability, so that the loops over both are vectors.
    pub contained: [u32; CELLS_PER_BLOCK],
}

impl Found {
    pub(crate) const NOTHING: Self = Self {
        probability: [0.0; CELLS_PER_BLOCK],
        contained: [0; CELLS_PER_BLOCK],
    };
}

/// A footprint in single precision. Positions are relative to a tile, so that their rounding is below a part in 10^6.
#[derive(Clone, Debug)]
pub(crate) struct Lanes {
    max_range_squared_m2: f32,
    /// Axis, the inverses of the knee and of the knee times the reach, rotation and displacement of each side.
    axes: [[f32; 3]; 4],
    per_knee: [f32; 4],
    per_reach: [f32; 4],
    turn: [f32; 4],
    shift_m: [f32; 4],
    depth: f32,
    normals: [[f32; 3]; 2],
    face_turn: [f32; 2],
    face_shift_m: [f32; 2],
    main_lobe: f32,
    lobes: f32,
    range_m: f32,
    per_across: f32,
}

impl Lanes {
    pub(crate) fn new(footprint: &Footprint, own: Option<&KeepProbability>) -> Self {
        let Footprint { sides, faces, .. } = footprint;
        let vector = |v: DVec3| v.as_vec3().to_array();
        let cell = footprint.cell;
        Self {
            max_range_squared_m2: (footprint.max_range_m * footprint.max_range_m) as f32,
            axes: sides.map(|s| vector(s.axis)),
            per_knee: sides.map(|s| (1.0 / s.knee) as f32),
            per_reach: sides.map(|s| (1.0 / (s.knee * s.reach)) as f32),
            turn: sides.map(|s| s.turn as f32),
            shift_m: sides.map(|s| s.shift_m as f32),
            depth: footprint.depth as f32,
            normals: faces.map(|f| vector(f.normal)),
            face_turn: faces.map(|f| f.turn as f32),
            face_shift_m: faces.map(|f| f.shift_m as f32),
            main_lobe: own.map_or(0.0, |own| own.main_lobe * NEAREST_M) as f32,
            lobes: own.map_or(0.0, |own| own.lobes) as f32,
            range_m: cell.range_m as f32,
            // Zeros resolve everything.
            per_across: match cell.across_rad == 0.0 {
                true => f32::INFINITY,
                false => (cell.range_m / cell.across_rad) as f32,
            },
        }
    }

    /// Adds this footprint's probabilities to those found. `offset_m` is the tile's origin less the apex. Holes, whose depth is not a number, are in
    /// no footprint.
    #[inline(always)]
    pub(crate) fn test(
        &self,
        own: Option<&KeepProbability>,
        offset_m: [f32; 3],
        of: Grounds,
        found: &mut Found,
    ) {
        let n = of.north_m.len().min(CELLS_PER_BLOCK);
        let of = Grounds {
            north_m: &of.north_m[..n],
            east_m: &of.east_m[..n],
            down_m: &of.down_m[..n],
            slope_north: &of.slope_north[..n],
            slope_east: &of.slope_east[..n],
        };
        let (probability, contained) = (&mut found.probability[..n], &mut found.contained[..n]);
        let Some(own) = own else {
            for (i, contained) in contained.iter_mut().enumerate() {
                *contained |= u32::from(self.direction(of.relative_m(offset_m, i)).contained);
            }
            return;
        };
        let [ceilings, steps] = &own.ceiling_f32;
        for i in 0..n {
            let d = of.relative_m(offset_m, i);
            let Direction {
                range_m,
                per_range,
                envelope,
                inside,
                contained: is_contained,
            } = self.direction(d);
            contained[i] |= u32::from(is_contained);
            let place = (0.5 * COSINES as f32) * (d[2] * per_range + 1.0);
            let k = (place as i32).clamp(0, COSINES as i32 - 1);
            let ceiling = ceilings[k as usize] + (place - k as f32) * steps[k as usize];
            let share = {
                let envelope = 1.0 / (envelope * ceiling);
                let of_main = envelope * least(std::f32::consts::PI * envelope, 1.0);
                least(greatest(self.lobes * envelope, of_main), 1.0)
            };
            let north = (d[0] + d[2] * of.slope_north[i]) * per_range;
            let east = (d[1] + d[2] * of.slope_east[i]) * per_range;
            let far = 1.0 / greatest(range_m, NEAREST_M as f32);
            let min_slant = greatest(self.per_across * far, (2.0 * self.range_m * far).sqrt());
            let slant = greatest((north * north + east * east).sqrt(), min_slant);
            let own = self.main_lobe * far * least(slant, 1.0) * share;
            let own = if inside { own } else { 0.0 };
            probability[i] = greatest(probability[i], own);
        }
    }

    /// Of a scatterer at `d` from the apex.
    #[inline(always)]
    fn direction(&self, d: [f32; 3]) -> Direction {
        let range_squared_m2 = dot(d, &d);
        let range_m = range_squared_m2.sqrt();
        let per_range = 1.0 / range_m;
        let mut inside = range_squared_m2 <= self.max_range_squared_m2;
        for k in 0..2 {
            let least_m = -(self.face_turn[k] * range_m + self.face_shift_m[k]);
            inside &= dot(d, &self.normals[k]) >= least_m;
        }
        let (mut envelope, mut below) = (1.0_f32, 1.0_f32);
        for k in 0..4 {
            let along_m = dot(d, &self.axes[k]).abs();
            envelope *= at_least_1(along_m * per_range * self.per_knee[k]);
            let sine = (along_m - self.shift_m[k]) * per_range - self.turn[k];
            below *= at_least_1(sine * self.per_reach[k]);
        }
        Direction {
            range_m,
            per_range,
            envelope,
            inside,
            contained: inside & (below <= self.depth),
        }
    }
}

#[inline(always)]
fn dot(a: [f32; 3], b: &[f32; 3]) -> f32 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

/// Where a footprint has a scatterer.
struct Direction {
    range_m: f32,
    per_range: f32,
    /// Maximum of the envelope over it.
    envelope: f32,
    /// In range and before the faces.
    inside: bool,
    contained: bool,
}

/// The smaller and the larger of two numbers, the second where one is not a number; a single instruction, unlike `min` and `max`.
#[inline(always)]
fn least(a: f32, b: f32) -> f32 {
    if a < b { a } else { b }
}

#[inline(always)]
fn greatest(a: f32, b: f32) -> f32 {
    if a > b { a } else { b }
}

/// Also for a side of length 0 and no width, whose product is not a number.
#[inline(always)]
fn at_least_1(x: f32) -> f32 {
    if x > 1.0 { x } else { 1.0 }
}

/// Maximum of the envelope over all horizontal directions at a cosine from the downward vertical.
fn ceiling(footprint: &Footprint, cosine: f64) -> f64 {
    let sine = (1.0 - cosine * cosine).max(0.0).sqrt();
    let envelope = |azimuth: f64| {
        let (sin, cos) = libm::sincos(azimuth);
        let ray = DVec3::new(sine * cos, sine * sin, cosine);
        let faced = footprint
            .faces
            .iter()
            .all(|f| f.may_face(ray.dot(f.normal), 1.0));
        match faced {
            true => 1.0 / footprint.below_maximum(ray, 1.0),
            false => 0.0,
        }
    };
    // Directions at right angles to a side, or as near to it as there are.
    let across = footprint.sides.iter().flat_map(|side| {
        let level = side.axis.truncate().length() * sine;
        let off = (-side.axis.z * cosine / level).clamp(-1.0, 1.0);
        let off = if off.is_nan() { 0.0 } else { libm::acos(off) };
        let middle = libm::atan2(side.axis.y, side.axis.x);
        [middle + off, middle - off]
    });
    let even = (0..AZIMUTHS).map(|k| std::f64::consts::TAU * k as f64 / AZIMUTHS as f64);
    let best = across.chain(even).map(envelope).fold(0.0, f64::max);
    // Where no direction faces the array, nothing is left out.
    if best > 0.0 { best } else { f64::MIN_POSITIVE }
}

/// Coarsest level of which no scatterer is missed where probabilities reach `max_probability`.
pub(crate) fn level(max_probability: f64) -> u32 {
    (-((1.0 + FADE) * max_probability).log2()).floor().max(0.0) as u32
}

/// Rank in a level from which no scatterer is kept where probabilities reach `max_probability`.
pub(crate) fn max_rank(max_probability: f64, level: u32) -> f64 {
    (1.0 + FADE) * max_probability * (1_u64 << level.min(63)) as f64
}

/// Factor w on the strength of a scatterer of a level, whose strength there is 2^(level/2) times that of level 0. `rank` is u times 2^level, and
/// `probability` is p.
#[cfg(test)]
pub(crate) fn gain(rank: f64, probability: f64, level: u32) -> f64 {
    /// Integral of g from 0 to t.
    fn integral(t: f64) -> f64 {
        let over = t.clamp(1.0 - FADE, 1.0 + FADE) - (1.0 - FADE);
        t.min(1.0 - FADE) + over - over * over / (4.0 * FADE)
    }
    let scaled = probability * (1_u64 << level.min(63)) as f64;
    let part = ((1.0 + FADE - rank / scaled) / (2.0 * FADE)).clamp(0.0, 1.0);
    (part / (scaled * integral(1.0 / probability))).sqrt()
}

/// The factors w on the strengths of scatterers of a level: with p the probability, u / p and G(1 / p) as above. A rank here is u times 2^level, and a
/// strength is 2^(level/2) times that of level 0. 0 for scatterers beyond the end of `ranks`.
#[inline(always)]
pub(crate) fn gains(ranks: &[f32], found: &Found, level: u32) -> [f32; CELLS_PER_BLOCK] {
    const LOW: f32 = 1.0 - FADE as f32;
    const HIGH: f32 = 1.0 + FADE as f32;
    let scale = (1_u64 << level.min(63)) as f32;
    let mut gains = [0.0; CELLS_PER_BLOCK];
    let of_each = found.probability.iter().zip(&found.contained);
    for ((gain, rank), (p, contained)) in gains.iter_mut().zip(ranks).zip(of_each) {
        let p = *p;
        let scaled = p * scale;
        let part = least((HIGH - rank / scaled) / (HIGH - LOW), 1.0);
        let t = 1.0 / p;
        let over = least(greatest(t, LOW), HIGH) - LOW;
        let integral = least(t, LOW) + over - over * over / (2.0 * (HIGH - LOW));
        let kept = (part > 0.0) & (p > 0.0) & (*contained != 0);
        let square = part / (scaled * integral);
        *gain = if kept { square } else { 0.0 }.sqrt();
    }
    gains
}
