//! The automatic density: the resolution cell that it serves, and how far side lobes are thinned.
//!
//! In a side lobe a ping keeps scatterers with a probability p = min(1, k E) (`kept_share`), E the envelope of the two-way pressure pattern relative to the main
//! lobe's (`scene::thinning`). k follows from the kurtosis of a window (mean fourth over squared second moment of the pressure),
//!
//! ```text
//! 2 + (4/3) sum(I^2 / p) / (sum I)^2
//! ```
//!
//! summed over the scatterers of a range cell, with I the two-way intensity pattern. It is the least k, from [`DEFAULT_LOBES`] on, with which a
//! shadow has at most [`MAX_KURTOSIS`]; shadows that are below open ground by more than the tolerance do not count. The number of scatterers of one ping of
//! all sonars limits it, down to 1. Below 1, with p = `kept_share`, it goes down only as far as shadows have at most [`MAX_KURTOSIS`]. The rig is level over
//! flat ground.

use std::f64::consts::{PI, TAU};

use glam::DVec3;

use super::culling::response;
use super::scene::Rig;
use crate::spec::{Density, SonarSpec};
use echotank_core::arrays::{ArrayGeometry, Mounting, Pattern, TransmitArray};
use echotank_core::scene::{ResolutionCell, kept_share};

/// Scatterers in a resolution cell: enough for a Rayleigh envelope (docs/concepts/model.md).
pub(crate) const SCATTERERS_PER_CELL: f64 = 5.0;
/// k where nothing else decides.
const DEFAULT_LOBES: f64 = 2.0;
/// Least k whatever the shadows: with less, side lobes are left out more than in proportion to their pressure.
const PROPORTIONAL_LOBES: f64 = 1.0;
/// Least k.
const MIN_LOBES: f64 = 0.2;
/// Greatest k that a shadow may ask for.
const MAX_LOBES: f64 = 8.0;
/// k that leaves out nothing.
const ALL_LOBES: f64 = 1e9;
/// Factor between the k that are tried.
const LOBES_STEP: f64 = 1.05;
/// Kurtosis of a shadow; 2 is that of a Rayleigh envelope.
const MAX_KURTOSIS: f64 = 2.5;
/// Half width of the shadow, metres.
const SHADOW_M: f64 = 1.5;
/// Most scatterers a ping.
const MAX_SCATTERERS: f64 = 1e5;
/// Most scatterers a ping of a side-scan with more than [`MANY_CELLS`] range cells a side.
const MAX_SCATTERERS_OF_LINES: f64 = 3e5;
const MANY_CELLS: f64 = 3000.0;
/// Fading scatterers, and those that a rolling platform adds, increase their number by this factor.
const FADING: f64 = 1.2;
/// Directions on a ring, and rings between the bottom and the longest range.
const AZIMUTHS: usize = 21_600;
const RINGS: usize = 4;
/// Angle of incidence where the depth is not known: 70 degrees.
const USUAL_COSINE: f64 = 0.342;

/// The density of a rig; none where its parts are not valid. `depth_m` is that of flat ground. Without `speckle` echoes add up in phase, and side
/// lobes are not thinned.
pub(super) fn auto(rig: &Rig, depth_m: Option<f64>, speckle: bool) -> Option<Density> {
    let c = rig.sound_speed_m_per_s?;
    let cells = rig.sonars.iter().flat_map(|sonar| {
        let shortest_s = sonar.limits.pulse_duration_s.0;
        pairs(sonar).map(move |(array, transmit)| cell(sonar, shortest_s, array, transmit, c))
    });
    let cell =
        cells.min_by(|a, b| (a.range_m * a.beam_rad).total_cmp(&(b.range_m * b.beam_rad)))?;
    let of_sonars = rig.sonars.iter();
    let rings: Vec<_> = of_sonars
        .map(|sonar| rings(sonar, c, depth_m, sonar.settings.range_m))
        .collect();
    let mut lobes = DEFAULT_LOBES;
    let shadows = |lobes: f64| {
        let all = rings.iter().flatten();
        all.map(|ring| ring.kurtosis(lobes)[1]).fold(0.0, f64::max)
    };
    while lobes < MAX_LOBES && shadows(lobes) > MAX_KURTOSIS {
        lobes *= LOBES_STEP;
    }
    let limits = rig.sonars.iter().map(|sonar| max_scatterers(sonar, c));
    let max_scatterers = limits.fold(0.0, f64::max);
    let too_many = |lobes: f64| {
        let each = rings.iter().map(|rings| scatterers(rings, lobes));
        each.sum::<f64>() > max_scatterers
    };
    while lobes > PROPORTIONAL_LOBES && too_many(lobes) {
        lobes = (lobes / LOBES_STEP).max(PROPORTIONAL_LOBES);
    }
    while lobes > MIN_LOBES && too_many(lobes) && shadows(lobes / LOBES_STEP) <= MAX_KURTOSIS {
        lobes /= LOBES_STEP;
    }
    let lobes = match speckle {
        // Rounded down, as `check` prints it, so that the number of scatterers stays within its limit.
        true => (100.0 * lobes).floor() / 100.0,
        false => ALL_LOBES,
    };
    Some(Density::Auto {
        per_cell: SCATTERERS_PER_CELL,
        cell,
        longest_range_m: rig.longest_range_m,
        lobes,
    })
}

/// About how many seabed scatterers a ping keeps. Without a depth, the bottom is taken to reach up to the sonar.
pub(super) fn scatterers_a_ping(
    sonar: &SonarSpec,
    c: f64,
    depth_m: Option<f64>,
    range_m: f64,
    lobes: f64,
) -> f64 {
    scatterers(&rings(sonar, c, depth_m, range_m), lobes)
}

fn max_scatterers(sonar: &SonarSpec, c: f64) -> f64 {
    let range_cells = sonar.settings.range_m / sonar.pulse.range_resolution_m(c);
    match !sonar.beams.lines.is_empty() && range_cells > MANY_CELLS {
        true => MAX_SCATTERERS_OF_LINES,
        false => MAX_SCATTERERS,
    }
}

/// Fewest seabed scatterers in a resolution cell of a sonar's main lobes with a constant density, in the middle of the range.
pub(crate) fn in_cell(sonar: &SonarSpec, c: f64, depth_m: Option<f64>, per_m2: f64) -> f64 {
    let middle_m = 0.5 * sonar.settings.range_m;
    let r = depth_m.map_or(middle_m, |depth_m| middle_m.max(1.5 * depth_m));
    let cosine = depth_m.map_or(USUAL_COSINE, |depth_m| (depth_m / r).clamp(0.0, 1.0));
    let sine = (1.0 - cosine * cosine).sqrt();
    let duration_s = sonar.settings.pulse_duration_s;
    let cells = pairs(sonar).map(|(array, transmit)| cell(sonar, duration_s, array, transmit, c));
    let areas_m2 = cells.map(|cell| cell.range_m / sine * cell.beam_rad * r);
    per_m2 * areas_m2.fold(f64::INFINITY, f64::min)
}

/// Receive arrays with the transmitters whose echoes they receive.
fn pairs(sonar: &SonarSpec) -> impl Iterator<Item = (&ArrayGeometry, &TransmitArray)> {
    sonar.receive.iter().flat_map(move |array| {
        let further = sonar.more_pulses.iter().filter_map(|more| more.transmit);
        let transmit = std::iter::once(array.transmit).chain(further);
        transmit.map(move |index| (array, &sonar.transmit[index]))
    })
}

fn cell(
    sonar: &SonarSpec,
    duration_s: f64,
    array: &ArrayGeometry,
    transmit: &TransmitArray,
    c: f64,
) -> ResolutionCell {
    let pulses = std::iter::once(sonar.pulse).chain(sonar.more_pulses.iter().map(|m| m.pulse));
    let range_m = pulses.map(|mut pulse| {
        pulse.duration_s = duration_s;
        pulse.range_resolution_m(c)
    });
    let [beam_rad, across_rad] =
        array.beam_widths_rad(transmit, c / sonar.pulse.center_frequency_hz);
    ResolutionCell {
        range_m: range_m.fold(f64::INFINITY, f64::min),
        beam_rad,
        across_rad,
    }
}

/// What one pair of transmitter and element receives from a ring of ground.
struct PairRing {
    /// Scatterers of the main lobe's density on the ring, in a range cell and in all range cells that the ring stands for.
    in_cell: f64,
    in_all: f64,
    /// By direction: envelope of the pressure pattern relative to the ring's maximum, 0 where it is culled; and intensity.
    envelope: Vec<f64>,
    intensity: Vec<f64>,
}

/// Rings of one range, one for each pair.
struct Ring {
    pairs: Vec<PairRing>,
    /// Sines off broadside below which a shadow hides the ground, and the sine of each direction off the transmitter's broadside.
    shadow_sine: f64,
    sines: Vec<f64>,
    /// Share of the intensity of open ground from which a shadow counts.
    min_share: f64,
}

fn rings(sonar: &SonarSpec, c: f64, depth_m: Option<f64>, range_m: f64) -> Vec<Ring> {
    let nearest_m = depth_m.unwrap_or(0.0).clamp(0.0, range_m);
    let step_m = (range_m - nearest_m) / RINGS as f64;
    (0..RINGS)
        .map(|k| {
            let r = nearest_m + (k as f64 + 0.5) * step_m;
            let cosine = depth_m.map_or(USUAL_COSINE, |depth| (depth / r).clamp(0.0, 1.0));
            ring(sonar, c, cosine, r, step_m)
        })
        .collect()
}

fn ring(sonar: &SonarSpec, c: f64, cosine: f64, r: f64, step_m: f64) -> Ring {
    let wavelength_m = c / sonar.pulse.center_frequency_hz;
    let sine = (1.0 - cosine * cosine).sqrt();
    let rays: Vec<DVec3> = (0..AZIMUTHS)
        .map(|k| {
            let (east, north) = libm::sincos(TAU * (k as f64 + 0.5) / AZIMUTHS as f64);
            DVec3::new(sine * north, sine * east, cosine)
        })
        .collect();
    let floor = sonar.model.cull_db.map_or(0.0, |db| 10f64.powf(db / 20.0));
    let pairs: Vec<PairRing> = pairs(sonar)
        .map(|(array, transmit)| {
            let cell = cell(sonar, sonar.pulse.duration_s, array, transmit, c);
            let on_ring = SCATTERERS_PER_CELL * TAU / cell.beam_rad;
            let element_pattern = array.envelope_pattern();
            let legs = [
                (&transmit.mounting, &transmit.pattern),
                (&array.mounting, &element_pattern),
            ];
            let two_way = |ray: DVec3, of: fn(&Pattern, f64, DVec3) -> f64| {
                let leg = |(mounting, pattern): (&Mounting, &Pattern)| {
                    of(
                        pattern,
                        wavelength_m,
                        mounting.body_from_array.inverse() * ray,
                    )
                };
                leg(legs[0]) * leg(legs[1])
            };
            let mut envelope: Vec<f64> = rays.iter().map(|ray| two_way(*ray, below)).collect();
            let ceiling = envelope.iter().copied().fold(0.0, f64::max);
            for e in &mut envelope {
                *e = if *e > floor { *e / ceiling } else { 0.0 };
            }
            PairRing {
                in_cell: on_ring,
                in_all: on_ring * step_m / cell.range_m,
                envelope,
                intensity: rays
                    .iter()
                    .map(|ray| two_way(*ray, response).powi(2))
                    .collect(),
            }
        })
        .collect();
    let along = sonar
        .transmit
        .first()
        .map_or(DVec3::X, |t| t.mounting.body_from_array * DVec3::X);
    Ring {
        pairs,
        shadow_sine: SHADOW_M / r,
        min_share: sonar.synthesis.tolerance.powi(2),
        sines: rays.iter().map(|ray| ray.dot(along).abs()).collect(),
    }
}

fn scatterers(rings: &[Ring], lobes: f64) -> f64 {
    let of_ring = |ring: &Ring| {
        let at = |k: usize| {
            let pairs = ring.pairs.iter();
            let kept = pairs.map(|pair| pair.in_all * kept_share(lobes, pair.envelope[k]));
            kept.fold(0.0, f64::max)
        };
        (0..AZIMUTHS).map(at).sum::<f64>() / AZIMUTHS as f64
    };
    FADING * rings.iter().map(of_ring).sum::<f64>()
}

impl Ring {
    /// Greatest kurtosis of an element's window on open ground and in a shadow.
    fn kurtosis(&self, lobes: f64) -> [f64; 2] {
        let of = |pair: &PairRing, from_sine: f64| {
            let (mut squares, mut sum, mut open) = (0.0, 0.0, 0.0);
            for (k, intensity) in pair.intensity.iter().enumerate() {
                let p = kept_share(lobes, pair.envelope[k]);
                open += intensity;
                if p > 0.0 && self.sines[k] >= from_sine {
                    squares += intensity * intensity / p;
                    sum += intensity;
                }
            }
            match sum > self.min_share * open {
                true => 2.0 + 4.0 / 3.0 * squares / (sum * sum) * AZIMUTHS as f64 / pair.in_cell,
                false => 2.0,
            }
        };
        [0.0, self.shadow_sine].map(|from_sine| {
            let pairs = self.pairs.iter().map(|pair| of(pair, from_sine));
            pairs.fold(2.0, f64::max)
        })
    }
}

/// What `check` prints of the density.
pub(crate) struct Estimate {
    /// Scatterers a ping at the range of the settings.
    pub scatterers: f64,
    /// Greatest kurtosis on open ground and in a shadow.
    pub kurtosis: [f64; 2],
}

impl Estimate {
    /// The largest values of all sonars; none without a sonar.
    pub(crate) fn new(sonars: &[SonarSpec], c: f64, depth_m: Option<f64>, lobes: f64) -> Self {
        let mut most = Self {
            scatterers: 0.0,
            kurtosis: [2.0; 2],
        };
        for sonar in sonars {
            let rings = rings(sonar, c, depth_m, sonar.settings.range_m);
            most.scatterers = most.scatterers.max(scatterers(&rings, lobes));
            for ring in &rings {
                for (most, kurtosis) in most.kurtosis.iter_mut().zip(ring.kurtosis(lobes)) {
                    *most = most.max(kurtosis);
                }
            }
        }
        most
    }
}

/// Upper envelope of the pressure pattern towards a unit vector in array axes, without nulls.
fn below(pattern: &Pattern, wavelength_m: f64, u: DVec3) -> f64 {
    let side = |side_m: f64, u: f64| (wavelength_m / (PI * side_m * u.abs())).min(1.0);
    match *pattern {
        Pattern::Rectangle { baffled: true, .. } | Pattern::Part { baffled: true, .. }
            if u.z < 0.0 =>
        {
            0.0
        }
        _ => {
            let [length_m, width_m] = pattern.sides_m();
            side(length_m, u.x) * side(width_m, u.y)
        }
    }
}
