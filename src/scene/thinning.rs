//! Leaves out seabed scatterers that the arrays neither resolve nor receive well.
//!
//! A scatterer is kept with probability p, and its pressure is divided by sqrt(p), so that the mean intensity of every direction is unchanged (Horvitz
//! and Thompson 1952). For an array with the resolution cell dr x b r at a range r,
//!
//! ```text
//! p = (density of five scatterers a cell / density of level 0) min(1, k E / E_max)
//! ```
//!
//! E is the upper envelope of the two-way pressure pattern ([`Footprint::below_maximum`]), which has no nulls. E_max is its maximum over all horizontal
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

use super::tiles::{NEAREST_M, TileBox};
use echotank_core::scene::{Footprint, ResolutionCell};

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
    /// Maximum of the envelope over the horizontal directions, at even steps of the cosine from the downward vertical, -1 to 1.
    ceiling: [f64; COSINES + 1],
}

impl KeepProbability {
    pub(crate) fn new(thinning: &Thinning, footprint: &Footprint) -> Self {
        let Thinning { finest, lobes } = *thinning;
        let share = |finest: f64, own: f64| finest / own.max(finest);
        Self {
            main_lobe: share(finest.range_m, footprint.cell.range_m)
                * share(finest.beam_rad, footprint.cell.beam_rad),
            lobes,
            ceiling: std::array::from_fn(|k| {
                ceiling(footprint, 2.0 * k as f64 / COSINES as f64 - 1.0)
            }),
        }
    }

    /// Probability, relative to level 0, of a scatterer at an offset from the apex; none out of range or behind the footprint's faces.
    #[inline(always)]
    pub(crate) fn probability(&self, footprint: &Footprint, offset_m: DVec3) -> Option<f64> {
        let range_m = footprint.may_face(offset_m)?;
        let place = (0.5 * COSINES as f64) * (offset_m.z / range_m + 1.0);
        let k = (place as usize).min(COSINES - 1);
        let step = self.ceiling[k + 1] - self.ceiling[k];
        let ceiling = self.ceiling[k] + (place - k as f64) * step;
        let below = footprint.below_maximum(offset_m, range_m);
        Some(self.at(range_m, below * ceiling))
    }

    /// An upper bound of the probability in a box for which [`TileBox::below`] is `below`.
    pub(crate) fn max_probability(&self, tile_box: &TileBox, apex_m: DVec3, below: f64) -> f64 {
        let (least, greatest) = tile_box.down_cosines(apex_m);
        let place = |cosine: f64| (0.5 * COSINES as f64) * (cosine + 1.0);
        let nodes = place(least).floor() as usize..=place(greatest).ceil() as usize;
        let ceiling = self.ceiling[nodes].iter().copied();
        let ceiling = ceiling.fold(f64::INFINITY, f64::min);
        self.at(tile_box.distance_m(apex_m), below * ceiling)
    }

    /// `relative` is the envelope's maximum over the envelope.
    #[inline(always)]
    fn at(&self, range_m: f64, relative: f64) -> f64 {
        self.main_lobe * NEAREST_M / range_m.max(NEAREST_M) * (self.lobes / relative).min(1.0)
    }
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
#[inline(always)]
pub(crate) fn gain(rank: f64, probability: f64, level: u32) -> f64 {
    let scaled = probability * (1_u64 << level.min(63)) as f64;
    let part = ((1.0 + FADE - rank / scaled) / (2.0 * FADE)).clamp(0.0, 1.0);
    (part / (scaled * integral(1.0 / probability))).sqrt()
}

/// Integral of g from 0 to t.
#[inline(always)]
fn integral(t: f64) -> f64 {
    let over = t.clamp(1.0 - FADE, 1.0 + FADE) - (1.0 - FADE);
    t.min(1.0 - FADE) + over - over * over / (4.0 * FADE)
}
