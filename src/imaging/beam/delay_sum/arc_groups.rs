//! Beams of an arc from groups of neighbouring elements, in two sums as in [`groups`](super::groups).
//!
//! A group about p, whose normal has the angle phi, serves the beams that use its elements. Its directions lie in equal steps of
//! v = sin(theta - phi). In the second sum it has the mean weight of its elements, so that the shading of a beam has steps of a group.

use std::f64::consts::{FRAC_PI_2, TAU};
use std::ops::Range;

use super::arc::ArcApertures;
use super::groups::{
    ADVANTAGE, BEAMS, Directions, Grid, Grouping, Kernel, MAX_GROUPS, Mix, Seen, TAPS, kernel,
    max_curvature_per_m,
};
use super::interpolation::band_hz;
use super::steering::{Foci, Steering, turn};
use echotank_core::arrays::ArrayGeometry;
use echotank_core::pulse::Pulse;

/// Groups of an aperture, at least: the steps of the shading are the smaller, the more there are.
const GROUPS_OF_APERTURE: f64 = 16.0;
/// Side lobes begin this many widths beside the axis, and are looked at in so many directions.
const MAIN_LOBE: f64 = 1.5;
const LOBE_ANGLES: usize = 1500;

/// Division of an arc into groups.
pub(super) struct ArcGroups {
    /// Elements of each group.
    pub(super) parts: Vec<Range<usize>>,
    /// Centres, along the array's axis and along the boresight, metres.
    pub(super) place_m: [[f32; 2]; MAX_GROUPS],
    normal_rad: [f64; MAX_GROUPS],
    /// Sine and cosine of these angles.
    normal: [[f64; 2]; MAX_GROUPS],
    /// Half the length of the longest group.
    half_m: f64,
    /// Half the angle between the normals of the outermost elements that a beam uses, with a group.
    half_aperture_rad: f64,
    /// Largest distance of an element in use from the axis of its beam, metres.
    reach_m: f64,
    /// Room for directions.
    pub(super) capacity: usize,
    kernel: Kernel,
    /// Of each group in every beam.
    weights: Vec<[f32; MAX_GROUPS]>,
    /// Groups of each section of [`BEAMS`] beams; the second is not used without halves.
    sections: Vec<[Range<usize>; 2]>,
    has_halves: bool,
}

impl ArcGroups {
    /// None if the dense sum has fewer products, or if the steps of the shading would be large or raise side lobes. `rows` is the number of rows for each delay.
    pub(super) fn new(
        array: &ArrayGeometry,
        (arc, has_halves): (&ArcApertures, bool),
        sector: [f64; 2],
        (pulse, rate_hz, c): (&Pulse, f64, f64),
        rows: usize,
    ) -> Option<Self> {
        let radius_m = array.radius_m?;
        let size = array.elements.div_ceil(MAX_GROUPS).max(4);
        let count = array.elements.div_ceil(size);
        let at = |g: usize| g * array.elements / count;
        let parts: Vec<Range<usize>> = (0..count).map(|g| at(g)..at(g + 1)).collect();
        let longest = parts.iter().map(Range::len).max()?;
        if arc.aperture_rad() * radius_m < GROUPS_OF_APERTURE * longest as f64 * array.spacing_m {
            return None;
        }
        let mut place_m = [[0.0; 2]; MAX_GROUPS];
        let (mut normal_rad, mut normal) = ([0.0; MAX_GROUPS], [[0.0; 2]; MAX_GROUPS]);
        for (g, part) in parts.iter().enumerate() {
            let middle = 0.5 * (part.start + part.end - 1) as f64;
            let along_m = array.spacing_m * (middle - 0.5 * (array.elements - 1) as f64);
            let (at_m, _) = array.place(along_m);
            place_m[g] = [at_m.x as f32, at_m.z as f32];
            normal_rad[g] = along_m / radius_m;
            normal[g] = normal_rad[g].sin_cos().into();
        }
        let half_m = 0.5 * array.spacing_m * (longest - 1).max(1) as f64;
        let mut groups = Self {
            parts,
            place_m,
            normal_rad,
            normal,
            half_m,
            half_aperture_rad: 0.5 * arc.aperture_rad() + half_m / radius_m,
            reach_m: 0.0,
            capacity: 0,
            kernel: kernel(),
            weights: Vec::with_capacity(arc.beams.len()),
            sections: Vec::with_capacity(arc.beams.len().div_ceil(BEAMS)),
            has_halves,
        };
        groups.aim(arc);
        groups.capacity = groups.directions(sector, pulse, rate_hz, c).count;
        let products = groups.products((sector, arc.beams.len()), (pulse, c), rows);
        let is_faster = ADVANTAGE * products < (arc.terms() * rows) as f64;
        let wavelength_m = c / pulse.center_frequency_hz;
        (is_faster && groups.steps_are_low(array, arc, wavelength_m)).then_some(groups)
    }

    /// Whether the steps of the shading raise no lobe above the side lobes of the shading itself, in the far field of the beam with the most elements.
    fn steps_are_low(&self, array: &ArrayGeometry, arc: &ArcApertures, wavelength_m: f64) -> bool {
        let most = (0..arc.beams.len()).max_by_key(|b| arc.beams[*b].elements.len());
        let (Some(most), Some(radius_m)) = (most, array.radius_m) else {
            return false;
        };
        let beam = &arc.beams[most];
        let of_group = self.parts.iter().zip(&self.weights[most]);
        let steps: Vec<f32> = of_group
            .flat_map(|(part, weight)| part.clone().map(move |_| *weight))
            .collect();
        let middle = 0.5 * (beam.elements.start + beam.elements.end - 1) as f64;
        let elements = beam.elements.clone().map(|e| {
            let normal_rad = (e as f64 - middle) * array.spacing_m / radius_m;
            let weight = arc.weights(beam, e..e + 1)[0];
            (normal_rad, f64::from(weight), f64::from(steps[e] - weight))
        });
        let elements: Vec<(f64, f64, f64)> = elements.collect();
        let from_rad = MAIN_LOBE * arc.width_rad(beam, wavelength_m);
        let per_rad_m = TAU * radius_m / wavelength_m;
        let (mut of_shading, mut of_steps) = (0.0f64, 0.0f64);
        for k in 0..LOBE_ANGLES {
            let off_rad = from_rad + (FRAC_PI_2 - from_rad) * k as f64 / LOBE_ANGLES as f64;
            let (mut shading, mut steps) = ([0.0; 2], [0.0; 2]);
            for (normal_rad, weight, step) in &elements {
                let late = (normal_rad - off_rad).cos() - normal_rad.cos();
                let (sin, cos) = (per_rad_m * late).sin_cos();
                shading = [shading[0] + weight * cos, shading[1] + weight * sin];
                steps = [steps[0] + step * cos, steps[1] + step * sin];
            }
            of_shading = of_shading.max(shading[0].hypot(shading[1]));
            of_steps = of_steps.max(steps[0].hypot(steps[1]));
        }
        of_steps <= of_shading
    }

    /// Takes the elements and the weights of the beams.
    pub(super) fn aim(&mut self, arc: &ArcApertures) {
        self.reach_m = arc.reach_m;
        self.weights.clear();
        for beam in &arc.beams {
            let mut weights = [0.0f32; MAX_GROUPS];
            for (weight, part) in weights.iter_mut().zip(&self.parts) {
                let used = part.start.max(beam.elements.start)..part.end.min(beam.elements.end);
                if !used.is_empty() {
                    let sum: f32 = arc.weights(beam, used).iter().sum();
                    *weight = sum / part.len() as f32;
                }
            }
            self.weights.push(weights);
        }
        self.sections.clear();
        for beams in arc.beams.chunks(BEAMS) {
            let of = |element: usize| self.parts.partition_point(|part| part.end <= element);
            let first = beams.iter().map(|beam| of(beam.elements.start)).min();
            let last = beams.iter().map(|beam| of(beam.elements.end - 1)).max();
            let (first, end) = (first.unwrap_or(0), last.map_or(0, |last| last + 1));
            // The boundary nearest to the middle of these beams.
            let middle = beams.iter().map(|beam| beam.middle).sum::<usize>() / beams.len().max(1);
            let group = of(middle.min(self.parts.last().map_or(0, |part| part.end - 1)));
            let part = &self.parts[group];
            let split = group + usize::from(2 * middle > part.start + part.end);
            let split = if self.has_halves {
                split.clamp(first, end)
            } else {
                end
            };
            self.sections.push([first..split, split..end]);
        }
    }

    /// Unit vector of direction `j` of group `g`, along the array's axis and along the boresight.
    pub(super) fn toward(&self, g: usize, grid: &Grid, j: usize) -> [f64; 2] {
        let [sin, cos] = self.normal[g];
        let v = grid.sine(j).clamp(-1.0, 1.0);
        let w = (1.0 - v * v).max(0.0).sqrt();
        [sin * w + cos * v, cos * w - sin * v]
    }

    fn groups(&self, batch: usize) -> Range<usize> {
        let [a, b] = &self.sections[batch];
        a.start..b.end
    }
}

impl Grouping for ArcGroups {
    fn parts(&self) -> &[Range<usize>] {
        &self.parts
    }

    fn capacity(&self) -> usize {
        self.capacity
    }

    fn directions(&self, sector: [f64; 2], pulse: &Pulse, band_hz: f64, c: f64) -> Directions {
        let [from_rad, to_rad] = sector.map(|sine| sine.clamp(-1.0, 1.0).asin());
        let half_rad = self.half_aperture_rad;
        let places = self.place_m[..self.parts.len()].iter();
        let groups = places.zip(self.normal_rad).map(|([x_m, z_m], normal_rad)| {
            let sine = |rad: f64| (rad - normal_rad).clamp(-half_rad, half_rad).sin();
            // The delay of the centre changes by its distance from the array's for each radian, and v by the cosine.
            let end_m = f64::from(x_m.hypot(*z_m)) / half_rad.min(1.2).cos() + self.half_m;
            ([sine(from_rad), sine(to_rad)], end_m)
        });
        Directions::new(groups, self.half_m, (pulse, band_hz, c))
    }

    fn products(
        &self,
        (sector, _): ([f64; 2], usize),
        (pulse, c): (&Pulse, f64),
        rows: usize,
    ) -> f64 {
        let directions = self.directions(sector, pulse, band_hz(pulse), c);
        let longest = self.parts.iter().map(Range::len).max().unwrap_or(0);
        let mixed: usize = self.sections.iter().flatten().map(Range::len).sum();
        // A real coefficient has half of the products of a complex one.
        (directions.count * longest * rows + mixed * BEAMS * (TAPS / 2 + 1)) as f64
    }

    fn max_curvature_per_m(&self, pulse: &Pulse, c: f64) -> f64 {
        // The outer beams of a line have this error in its outermost group only, those of an arc in most: squares of even places have an rms of 1/sqrt(5).
        max_curvature_per_m(self.half_m, 5f64.powf(0.25) * self.reach_m, pulse, c)
    }

    fn span_curvature_per_m(&self, directions: &Directions) -> f64 {
        directions.max_shift() / self.reach_m
    }

    fn sections(&self, batch: usize) -> &[Range<usize>] {
        &self.sections[batch][..if self.has_halves { 2 } else { 1 }]
    }

    #[inline(always)]
    fn see(&self, batch: usize, directions: &Directions, foci: &Foci, seen: &mut Seen) {
        for g in self.groups(batch) {
            let grid = &directions.of_group[g];
            let (first, per_step) = (grid.first as f32, (1.0 / grid.step) as f32);
            let [x, z] = self.place_m[g];
            let [sin, cos] = self.normal[g].map(|part| part as f32);
            for i in 0..BEAMS {
                let focus = foci.at(i);
                // Cosine of the angle between the normal and the direction: also the tangent times the direction's own.
                let facing = focus.cosine * cos + focus.sine * sin;
                let v = focus.sine * cos - focus.cosine * sin;
                let (q, slope, w) = focus.leg_of([x, z], [cos, -sin]);
                let beside = w[0] * focus.cosine - w[1] * focus.sine;
                seen.at[g][i] = (v - first) * per_step;
                seen.slope[g][i] = slope;
                // d slope / d theta = -(R/q) (t.e - slope w.e/q), with t along the group and e across the direction.
                let over = focus.radius_m * (facing * q - slope * beside);
                seen.per_slope[g][i] = per_step * facing * q * q / over.max(1e-6);
            }
        }
    }

    #[inline(always)]
    fn mix(
        &self,
        steering: &Steering,
        (batch, directions): (usize, &Directions),
        seen: &Seen,
        (foci, farther_m): (&Foci, Option<f32>),
        mix: &mut Mix,
    ) {
        let mach = steering.mach();
        let beams = &self.weights[batch * BEAMS..];
        for g in self.groups(batch) {
            let grid = &directions.of_group[g];
            let place = self.place_m[g];
            let [sin, cos] = self.normal[g].map(|part| part as f32);
            let tangent = [cos, -sin];
            let mut at = seen.at[g];
            let mut late_m = [0.0f32; BEAMS];
            let mut shift = [0.0f32; BEAMS];
            let by_m = farther_m.unwrap_or(0.0);
            match steering.is_focused() {
                true => {
                    for i in 0..BEAMS {
                        let focus = foci.at(i);
                        let (late, slope, per_q) = focus.late_m_of(mach, place, tangent);
                        late_m[i] = late;
                        at[i] += (seen.slope[g][i] - slope) * seen.per_slope[g][i];
                        let per_radius = focus.slope_per_radius(place, tangent, (slope, per_q));
                        shift[i] = -by_m * per_radius * seen.per_slope[g][i];
                    }
                }
                false => {
                    for (i, late_m) in late_m.iter_mut().enumerate() {
                        *late_m = foci.at(i).far_late_m_of(place);
                    }
                }
            }
            let shift = farther_m.map(|_| &shift);
            mix.set(g, grid, (&self.kernel, at, shift), |i| {
                let weight = beams.get(i).map_or(0.0, |weights| weights[g]);
                let (sin, cos) = turn(late_m[i] * steering.cycles_per_m());
                (weight * sin, weight * cos)
            });
        }
    }
}
