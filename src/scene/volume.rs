//! Volume reverberation: scatterers of the water, drawn anew at every ping.
//!
//! The sphere around the transmitter is divided into shells, one range cell thick, and each shell into parts of its directions. A part holds one scatterer: at a
//! random place, with a circular Gaussian strength of variance Sv dV. Given the places, an echo is exactly Gaussian; the mean level and the covariance of any
//! elements are exact for any number of parts. More parts steady the variance from ping to ping.
//!
//! Directions have two coordinates: the sine u along the receive array, in which all its beams are equally wide, and the angle phi around it. Bins of u are one
//! beam wide in the main lobe and wider in side lobes. In each bin, phi follows the two-way pattern (importance sampling: nine tenths of the scatterers in
//! proportion to its power without nulls, one tenth evenly), in equally likely strata, with dV = r^2 dr du / density(phi). The scatterers of a bin also divide its u and
//! its range into strata, in a cyclic order with a random start (a Latin hypercube), so that each is uniform by itself.
//!
//! Numbers come from a counter: seed, sonar, ping, shell and part (`draws`).

use std::f64::consts::TAU;

use glam::{DMat3, DQuat, DVec2, DVec3};
use num_complex::Complex64;
use rayon::prelude::*;

use super::draws::{circular_gaussian, fraction, philox, sin_cos_turn};
use super::seabed::Surface;
use echotank_config::spec::VolumeSpec;
use echotank_core::scene::{Footprint, ScatterLaw, Scatterers};

/// Separates these numbers from other uses of the same seed. A change of the algorithm needs a new value.
const VOLUME: u32 = 0x70E5_0101;
const SHIFTS: u32 = 0x70E5_0102;
/// Equally likely intervals of phi in a bin.
const QUANTILES: usize = 64;
/// Angles at which a pattern is evaluated.
const ANGLES: usize = 4096;
/// Share of the scatterers of a bin that lie evenly around the array.
const EVEN: f64 = 0.1;
/// A bin has its full number of scatterers where the two-way power is at most 15 dB below its maximum.
const FULL_ABOVE: f64 = 1.0 / 32.0;
/// Directions with less two-way power than this are left out.
const NOTHING: f64 = 1e-8;
/// Least effective number of scatterers in a shell.
const MIN_IN_SHELL: f64 = 12.0;
/// Limits of the number of beam-wide bins.
const BINS: (f64, f64) = (16.0, 8192.0);
/// Greatest change of the power within a bin of a side lobe.
const MAX_CHANGE: f64 = 4.0;

/// Extent of the receive arrays of a sonar, and the direction of its longest.
#[derive(Clone, Copy, Debug)]
pub struct VolumeAperture {
    /// Unit vector along the longest array, body axes.
    pub axis: DVec3,
    /// Length along the axis, wavelengths.
    pub length: f64,
    /// Length across the axis of arrays that look the same way, wavelengths.
    pub across: f64,
}

/// Directions in which the pings of one sonar draw scatterers.
#[derive(Clone, Debug, Default)]
pub struct VolumeDirections {
    /// Columns: two directions across the array and that along it, body axes.
    body_from_polar: DMat3,
    bins: Vec<Bin>,
    parts: Vec<Part>,
    /// Least solid angle of a part.
    min_sr: f64,
}

/// Interval of the sine along the array.
#[derive(Clone, Debug)]
struct Bin {
    low: f64,
    width: f64,
    /// Angles around the array, turns, that divide its scatterers evenly.
    turns: [f64; QUANTILES + 1],
}

/// One scatterer of a shell: the stratum `index` of `of` in its bin.
#[derive(Clone, Copy, Debug)]
struct Part {
    bin: u32,
    index: f64,
    of: f64,
}

impl VolumeDirections {
    /// Divides all directions. `footprints` are those of a platform at rest with level attitude and no heading.
    pub fn new(
        footprints: &[Footprint],
        aperture: VolumeAperture,
        scatterers_per_cell: f64,
    ) -> Self {
        let along = aperture.axis.normalize_or(DVec3::X);
        let (x, y) = along.any_orthonormal_pair();
        let body_from_polar = DMat3::from_cols(x, y, along);
        let beams = (2.0 * aperture.length).ceil().clamp(BINS.0, BINS.1);
        let width = 2.0 / beams;
        let rows: Vec<Row> = (0..beams as usize)
            .into_par_iter()
            .map(|k| {
                let u = -1.0 + (k as f64 + 0.5) * width;
                Row::new(footprints, body_from_polar, u, aperture.across)
            })
            .collect();
        let in_shell: f64 = rows.iter().map(|row| row.cells * row.most).sum();
        let of_cells = scatterers_per_cell.max(MIN_IN_SHELL / in_shell.max(f64::MIN_POSITIVE));
        let mut directions = Self {
            body_from_polar,
            bins: Vec::new(),
            parts: Vec::new(),
            min_sr: f64::INFINITY,
        };
        let mut first = 0;
        let mut pending = 0.0;
        for (k, row) in rows.iter().enumerate() {
            pending += of_cells * row.cells * (row.most / FULL_ABOVE).min(1.0);
            let next = rows.get(k + 1).map_or(0.0, |next| next.most);
            let group = &rows[first..=k];
            let (least, most) = group
                .iter()
                .map(|row| row.most)
                .chain([next])
                .fold((f64::INFINITY, 0.0_f64), |(a, b), x| (a.min(x), b.max(x)));
            let steep = most > NOTHING && most > MAX_CHANGE * least;
            if pending < of_cells.max(1.0) * 0.999 && !steep && k + 1 < rows.len() {
                continue;
            }
            let low = -1.0 + first as f64 * width;
            directions.push(low, (k + 1 - first) as f64 * width, group, pending);
            (first, pending) = (k + 1, 0.0);
        }
        directions
    }

    fn push(&mut self, low: f64, width: f64, group: &[Row], scatterers: f64) {
        if group.iter().all(|row| row.most < NOTHING) {
            return;
        }
        let mut power = vec![0.0; ANGLES];
        for row in group {
            for (sum, p) in power.iter_mut().zip(&row.power) {
                *sum += f64::from(*p);
            }
        }
        let all: f64 = power.iter().sum();
        let mut turns = [1.0; QUANTILES + 1];
        let (mut below, mut k) = (0.0, 0);
        for (m, power) in power.iter().enumerate() {
            let own = (1.0 - EVEN) * power / all + EVEN / ANGLES as f64;
            while k <= QUANTILES && k as f64 / QUANTILES as f64 <= below + own {
                let inside = (k as f64 / QUANTILES as f64 - below) / own;
                turns[k] = (m as f64 + inside) / ANGLES as f64;
                k += 1;
            }
            below += own;
        }
        (turns[0], turns[QUANTILES]) = (0.0, 1.0);
        let of = scatterers.ceil().max(1.0);
        let bin = self.bins.len() as u32;
        let narrowest = turns.windows(2).map(|t| t[1] - t[0]);
        let narrowest = narrowest.fold(f64::INFINITY, f64::min);
        self.min_sr = self.min_sr.min(solid_angle_sr(width, narrowest, of));
        self.bins.push(Bin { low, width, turns });
        self.parts.extend((0..of as usize).map(|index| Part {
            bin,
            index: index as f64,
            of,
        }));
    }

    /// Number of scatterers in every shell.
    pub fn per_shell(&self) -> usize {
        self.parts.len()
    }
}

/// Solid angle that a scatterer represents, from the width of its bin, the width of its interval of phi in turns, and the number of scatterers of the bin.
fn solid_angle_sr(width: f64, turns: f64, of: f64) -> f64 {
    width * TAU * turns * QUANTILES as f64 / of
}

/// Two-way power around the array at one sine.
struct Row {
    power: Vec<f32>,
    /// Greatest value.
    most: f64,
    /// Resolution cells around the array.
    cells: f64,
}

impl Row {
    fn new(footprints: &[Footprint], body_from_polar: DMat3, u: f64, across: f64) -> Self {
        let beside = (1.0 - u * u).max(0.0).sqrt();
        let mut power = vec![0.0_f32; ANGLES];
        for (m, power) in power.iter_mut().enumerate() {
            let (sin, cos) = libm::sincos(TAU * (m as f64 + 0.5) / ANGLES as f64);
            let ray = body_from_polar * DVec3::new(beside * cos, beside * sin, u);
            let of = footprints.iter().map(|f| two_way_power(f, ray));
            *power = of.fold(0.0, f64::max) as f32;
        }
        let most = power.iter().copied().fold(0.0, f32::max);
        let sum: f64 = power.iter().copied().map(f64::from).sum();
        let most = f64::from(most);
        let lobe_rad = TAU / ANGLES as f64 * sum / most.max(f64::MIN_POSITIVE);
        Self {
            power,
            most,
            cells: (lobe_rad * beside * across).max(1.0),
        }
    }
}

/// Two-way power over its maximum: of the main lobes, and half the envelope of side lobes, so that it has no nulls; 0 well behind a baffle.
fn two_way_power(footprint: &Footprint, ray: DVec3) -> f64 {
    const BEHIND: f64 = -0.1;
    if footprint.faces.iter().any(|f| ray.dot(f.normal) < BEHIND) {
        return 0.0;
    }
    let sides = footprint.sides.iter().map(|side| {
        // pi L u / lambda; 0 for a side without length.
        let x = ray.dot(side.axis) / side.knee;
        let lobe = if x == 0.0 { 1.0 } else { libm::sin(x) / x };
        (lobe * lobe).max(0.5 * (x * x).max(1.0).recip())
    });
    sides.product()
}

/// The layers and the seed of a rig's water.
#[derive(Clone, Debug)]
pub struct VolumeField {
    /// Upper and lower edge, metres, and the scattered power per cubic metre.
    layers: Vec<(f64, f64, f64)>,
    nearest_m: f64,
    seed: u64,
}

/// What distinguishes the scatterers of one ping from all others.
#[derive(Clone, Copy, Debug)]
pub struct VolumePing {
    /// Index of the sonar.
    pub sonar: u32,
    /// Number of the ping.
    pub ping_number: u32,
    /// Attitude at the start of the pulse.
    pub world_from_body: DQuat,
}

impl VolumeField {
    /// Water of a scene with this seed.
    pub fn new(spec: &VolumeSpec, seed: u64) -> Self {
        let linear = |db: f64| libm::pow(10.0, db / 10.0);
        let layers = spec.layers.iter();
        Self {
            layers: layers
                .map(|l| (l.top_m, l.bottom_m, linear(l.sv_db)))
                .collect(),
            nearest_m: spec.nearest_m,
            seed,
        }
    }

    /// Scattered power per cubic metre at a depth.
    fn at(&self, down_m: f64) -> f64 {
        let layers = self.layers.iter();
        let inside = layers.filter(|(top_m, bottom_m, _)| (*top_m..*bottom_m).contains(&down_m));
        inside.map(|(_, _, power)| power).sum()
    }

    /// Appends the scatterers of a ping around the transmitter of the first footprint, out to the longest range of all. `ground` cuts the water off below.
    /// Returns their number.
    pub(crate) fn append(
        &self,
        directions: &VolumeDirections,
        ping: VolumePing,
        footprints: &[Footprint],
        ground: Option<(&Surface, DVec2)>,
        out: &mut Scatterers,
    ) -> usize {
        let (Some(around), per_shell) = (footprints.first(), directions.parts.len()) else {
            return 0;
        };
        let cell_m = footprints.iter().map(|f| f.cell.range_m);
        let cell_m = cell_m.fold(f64::INFINITY, f64::min);
        let range_m = footprints.iter().map(|f| f.max_range_m).fold(0.0, f64::max);
        if per_shell == 0 || !(cell_m > 0.0 && cell_m.is_finite()) {
            return 0;
        }
        let apex_m = around.apex_m;
        // Nothing lies in shells above and below all layers.
        let edges_m = self.layers.iter().fold(
            (f64::INFINITY, f64::NEG_INFINITY),
            |(top_m, bottom_m), l| (top_m.min(l.0), bottom_m.max(l.1)),
        );
        let nearest_m = (edges_m.0 - apex_m.z).max(apex_m.z - edges_m.1);
        // The first shell is the transmitter's own near field.
        let least = (self.nearest_m / cell_m).ceil().max(1.0);
        let first = (nearest_m / cell_m).floor().max(least) as u32;
        let end = (range_m / cell_m).ceil() as u32;
        let shells = end.saturating_sub(first) as usize;
        let from = out.len();
        out.resize(from + shells * per_shell);
        out.law[from..].fill(ScatterLaw::Water);
        let world_from_polar = DMat3::from_quat(ping.world_from_body) * directions.body_from_polar;
        let key = [
            self.seed as u32 ^ ping.sonar.wrapping_mul(0x9E37_79B9),
            (self.seed >> 32) as u32,
        ];
        let rows = out.north_m[from..]
            .par_chunks_mut(per_shell)
            .zip(out.east_m[from..].par_chunks_mut(per_shell))
            .zip(out.down_m[from..].par_chunks_mut(per_shell))
            .zip(out.strength[from..].par_chunks_mut(per_shell))
            .zip(out.loud[from..].par_chunks_mut(per_shell));
        rows.enumerate()
            .for_each(|(k, ((((north_m, east_m), down_m), strength), loud))| {
                let shell = first + k as u32;
                let mut shifts = [0.0; 2];
                for (j, part) in directions.parts.iter().enumerate() {
                    if part.index == 0.0 {
                        let words = philox([shell, j as u32, ping.ping_number, SHIFTS], key);
                        shifts =
                            [words[0], words[1]].map(|word| (fraction(word) * part.of).floor());
                    }
                    let words = philox([shell, j as u32, ping.ping_number, VOLUME], key);
                    let bin = &directions.bins[part.bin as usize];
                    let [sixteen, more] = [words[0] & 0xFFFF, words[0] >> 16]
                        .map(|bits| (f64::from(bits) + 0.5) / 65_536.0);
                    // A Latin hypercube: the scatterers of a bin divide its u, phi and range in as many strata.
                    let stratum = |index: f64| index - (index / part.of).floor() * part.of;
                    let along = stratum(part.index + shifts[0]);
                    let deep = stratum(part.of - 1.0 - part.index + shifts[1]);
                    let u = bin.low + bin.width * (along + sixteen) / part.of;
                    let at = (part.index + more) / part.of * QUANTILES as f64;
                    let k = (at as usize).min(QUANTILES - 1);
                    let wide = bin.turns[k + 1] - bin.turns[k];
                    let turn = bin.turns[k] + (at - k as f64) * wide;
                    let (sin, cos) = sin_cos_turn((turn * 4_294_967_296.0) as u32);
                    let beside = (1.0 - u * u).max(0.0).sqrt();
                    let polar = DVec3::new(beside * f64::from(cos), beside * f64::from(sin), u);
                    let inside = (deep + fraction(words[1])) / part.of;
                    let range_m = cell_m * (f64::from(shell) + inside);
                    let at_m = apex_m + world_from_polar * polar * range_m;
                    let own_sr = solid_angle_sr(bin.width, wide, part.of);
                    let scattered = self.at(at_m.z) * own_sr * range_m * range_m * cell_m;
                    let in_water = scattered > 0.0
                        && ground.is_none_or(|(surface, anchor_m)| {
                            let own_m = at_m.truncate() - anchor_m;
                            let below = surface.sample(own_m.x, own_m.y);
                            below.is_none_or(|below| at_m.z < below.down_m)
                        });
                    if in_water {
                        let unit = circular_gaussian(words[2], words[3]);
                        let unit = Complex64::new(unit.re.into(), unit.im.into());
                        strength[j] = unit * scattered.sqrt();
                        (north_m[j], east_m[j], down_m[j]) = at_m.into();
                        loud[j] = (own_sr / directions.min_sr).sqrt().max(1.0) as f32;
                    }
                }
            });
        let mut end = from;
        for i in from..out.len() {
            if out.strength[i] != Complex64::ZERO {
                out.copy_within(i, end);
                end += 1;
            }
        }
        out.truncate(end);
        end - from
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use echotank_config::spec::VolumeLayer;
    use echotank_core::scene::{PatternSide, ResolutionCell};

    /// A Mills cross: a transmitter along the track, an array across it.
    fn cross(range_m: f64) -> Footprint {
        let mut footprint = Footprint::all_round(DVec3::new(3.0, -2.0, 10.0), range_m);
        footprint.sides[0] = PatternSide {
            axis: DVec3::X,
            knee: 1.0 / (std::f64::consts::PI * 40.0),
            ..PatternSide::OPEN
        };
        footprint.cell = ResolutionCell {
            range_m: 0.1,
            beam_rad: 0.02,
            across_rad: 0.02,
        };
        footprint
    }

    fn field(layers: &[(f64, f64, f64)]) -> VolumeField {
        let layer = |&(top_m, bottom_m, sv_db)| VolumeLayer {
            top_m,
            bottom_m,
            sv_db,
        };
        let spec = VolumeSpec {
            layers: layers.iter().map(layer).collect(),
            scatterers_per_cell: 3.0,
            nearest_m: 0.0,
        };
        VolumeField::new(&spec, 7)
    }

    fn directions(footprint: &Footprint) -> VolumeDirections {
        let aperture = VolumeAperture {
            axis: DVec3::Y,
            length: 48.0,
            across: 0.0,
        };
        VolumeDirections::new(std::slice::from_ref(footprint), aperture, 3.0)
    }

    fn ping(number: u32) -> VolumePing {
        VolumePing {
            sonar: 0,
            ping_number: number,
            world_from_body: DQuat::from_rotation_z(0.4),
        }
    }

    /// The parts fill the sphere, so that sums over them are integrals: of 1, of the two-way pattern, and of its product with a steep function.
    #[test]
    fn parts_fill_all_directions() {
        let footprint = cross(20.0);
        let directions = directions(&footprint);
        let sum = |f: &dyn Fn(DVec3) -> f64| {
            let mut sum = 0.0;
            for part in &directions.parts {
                let bin = &directions.bins[part.bin as usize];
                // Around and along; the pattern is steep near the poles.
                const FINE: [usize; 2] = [128, 64];
                for (i, j) in (0..FINE[0]).flat_map(|i| (0..FINE[1]).map(move |j| (i, j))) {
                    let at = (part.index + (i as f64 + 0.5) / FINE[0] as f64) / part.of;
                    let k = ((at * QUANTILES as f64) as usize).min(QUANTILES - 1);
                    let wide = bin.turns[k + 1] - bin.turns[k];
                    let turn = bin.turns[k] + (at * QUANTILES as f64 - k as f64) * wide;
                    let u = bin.low + (j as f64 + 0.5) / FINE[1] as f64 * bin.width;
                    let (sin, cos) = (TAU * turn).sin_cos();
                    let beside = (1.0 - u * u).sqrt();
                    let polar = DVec3::new(beside * cos, beside * sin, u);
                    sum += solid_angle_sr(bin.width, wide, part.of) / (FINE[0] * FINE[1]) as f64
                        * f(directions.body_from_polar * polar);
                }
            }
            sum
        };
        assert!((sum(&|_| 1.0) / (2.0 * TAU) - 1.0).abs() < 1e-9);
        assert!((sum(&|ray| ray.z * ray.z) / (2.0 * TAU / 3.0) - 1.0).abs() < 1e-3);
        // Integral of min(1, (knee / x)^2) over the sphere: 4 pi (2 knee - knee^2).
        let knee = footprint.sides[0].knee;
        let want = 2.0 * TAU * (2.0 * knee - knee * knee);
        let got = sum(&|ray| footprint.below_maximum(ray, 1.0).powi(-2));
        assert!((got / want - 1.0).abs() < 0.02, "{got} {want}");
    }

    /// Mean scattered power of a slab: Sv times the volume of the ball between two depths, and nothing outside.
    #[test]
    fn scatterers_lie_in_their_layers_with_the_power_of_the_volume() {
        let footprint = cross(8.0);
        let (directions, field) = (directions(&footprint), field(&[(9.0, 12.0, -60.0)]));
        let mut out = Scatterers::default();
        let mut power = 0.0;
        const PINGS: u32 = 20;
        for number in 0..PINGS {
            out.clear();
            let footprints = std::slice::from_ref(&footprint);
            let n = field.append(&directions, ping(number), footprints, None, &mut out);
            assert_eq!(n, out.len());
            assert!(out.down_m.iter().all(|down| (9.0..12.0).contains(down)));
            power += out.strength.iter().map(|s| s.norm_sqr()).sum::<f64>();
        }
        // A ball of radius r cut by planes at -1 and +2 m from its middle: pi (r^2 (b - a) - (b^3 - a^3)/3).
        let volume = std::f64::consts::PI * (64.0 * 3.0 - (8.0 + 1.0) / 3.0);
        let (got, want) = (power / f64::from(PINGS), 1e-6 * volume);
        assert!((got / want - 1.0).abs() < 0.03, "{got} {want}");
    }

    #[test]
    fn a_ping_has_its_own_numbers_for_any_number_of_threads() {
        let footprint = cross(6.0);
        let (directions, field) = (directions(&footprint), field(&[(0.0, 50.0, -60.0)]));
        let draw = |number, threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads);
            let mut out = Scatterers::default();
            pool.build().expect("threads").install(|| {
                let footprints = std::slice::from_ref(&footprint);
                field.append(&directions, ping(number), footprints, None, &mut out)
            });
            (out.north_m, out.strength)
        };
        assert_eq!(draw(1, 1), draw(1, 3));
        assert_ne!(draw(1, 1).1[..9], draw(2, 1).1[..9]);
    }

    #[test]
    fn the_seabed_cuts_the_water_off() {
        let footprint = cross(9.0);
        let (directions, field) = (directions(&footprint), field(&[(0.0, 50.0, -60.0)]));
        let plane = Surface::Plane {
            depth_m: 12.0,
            slope_north: 0.0,
            slope_east: 0.0,
        };
        let mut out = Scatterers::default();
        let ground = Some((&plane, DVec2::new(5.0, 5.0)));
        let footprints = std::slice::from_ref(&footprint);
        field.append(&directions, ping(1), footprints, ground, &mut out);
        assert!(out.down_m.iter().all(|down| *down < 12.0));
        assert!(out.down_m.iter().any(|down| *down > 11.5));
    }
}
