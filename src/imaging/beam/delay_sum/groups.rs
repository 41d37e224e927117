//! Beams from groups of neighbouring elements, in two sums.
//!
//! A group is too short to resolve neighbouring beams. Its sum therefore varies slowly with the direction, and few directions determine all:
//! the first sum forms each group's beams in equal steps of the sine, focused on one range of a tile with the exact delays of its elements;
//! the second sums, for each beam of the fan, [`TAPS`] directions of every group.
//!
//! As a function of the sine u, the sum of a group about x_g is exp(j 2pi f_c x_g u/c) times a function with frequencies up to
//! nu = (f_c h + X B/2)/c cycles, where h is the group's half-length, X the distance of its far end, and B the bandwidth. Directions lie
//! 1/(3.6 nu) apart, so that the function is oversampled by 1.8. Least-squares coefficients for that band interpolate it with an rms error of
//! 4e-3 at most, a sixth of the power that an error of 1e-2 has. The exact phase of the group's centre belongs to the second sum.
//!
//! Between the range of the tile and that of a sample, the direction in which a group sees the point in focus changes; the second sum takes the
//! direction of equal slope. What remains is the change of the curvature within a group and of the envelope's delay, which the length of a tile
//! limits. The focus follows the range in spans of a tile. The delay of a group's centre changes in a span: every direction's samples are turned by that
//! phase ([`Sweep`]), which varies slowly with the direction. The direction of equal slope changes too, and with it the coefficients, linearly in
//! time. A span within which phases change by less than the permitted error of the focus keeps the focus of its middle.

use std::ops::Range;

use super::interpolation::{band_hz, least_squares, solve};
use super::steering::{Foci, Steering, turn, whole_number};
use crate::beam::kernel::BLOCK;
use echotank_core::arrays::ArrayGeometry;
use echotank_core::pulse::{Pulse, PulseKind};

/// Maximum number of groups; of a line, [`GROUPS_OF_LINE`].
pub(super) const MAX_GROUPS: usize = 32;
const GROUPS_OF_LINE: usize = 16;
/// Directions of each group that a beam sums.
pub(super) const TAPS: usize = 6;
/// Beams whose coefficients are computed together.
pub(super) const BEAMS: usize = 16;
/// Directions for each half cycle of the fastest variation of a group.
const OVERSAMPLING: f64 = 1.8;
/// Number of coefficients of the polynomials of the interpolation kernel: even.
const TERMS: usize = 6;
/// Directions beyond those of the outermost beams, for the change of direction within a tile.
const REACH: usize = 1;
/// Phase error at the ends of a group by the change of its curvature within a tile.
const MAX_CURVATURE_RAD: f64 = 0.05;
/// Phase error of the outermost group at the rms frequency of the envelope within a tile.
const MAX_ENVELOPE_RAD: f64 = 0.08;
/// Change of the index of a direction from the middle of a span to its ends: the coefficients are linear in it.
const MAX_SHIFT: f64 = 0.2;
/// The dense sum has fewer steps for each product.
pub(super) const ADVANTAGE: f64 = 1.3;

/// Groups of elements, of a line or an arc.
pub(super) trait Grouping {
    /// Elements of each group.
    fn parts(&self) -> &[Range<usize>];

    /// Room for directions.
    fn capacity(&self) -> usize;

    /// Directions that serve the beams with sines in `sector`.
    fn directions(&self, sector: [f64; 2], pulse: &Pulse, band_hz: f64, c: f64) -> Directions;

    /// Products for each sample of all beams. `rows` is the number of rows for each delay.
    fn products(&self, of: ([f64; 2], usize), pulse: (&Pulse, f64), rows: usize) -> f64;

    /// Largest change of 1/r from the range of a tile to its ends.
    fn max_curvature_per_m(&self, pulse: &Pulse, c: f64) -> f64;

    /// The same of a span.
    fn span_curvature_per_m(&self, directions: &Directions) -> f64;

    /// Groups of each section of a batch of [`BEAMS`] beams.
    fn sections(&self, batch: usize) -> &[Range<usize>];

    /// Beams of a batch, focused on the range of the tile.
    fn see(&self, batch: usize, directions: &Directions, foci: &Foci, seen: &mut Seen);

    /// Coefficients of the beams of a batch with the focus of a span, whose radius changes by so much from the middle to the last sample if it moves.
    fn mix(
        &self,
        steering: &Steering,
        of: (usize, &Directions),
        seen: &Seen,
        foci: (&Foci, Option<f32>),
        mix: &mut Mix,
    );
}

/// Division of a line into groups.
pub(super) struct Groups {
    /// Elements of each group; none crosses a section.
    pub(super) parts: Vec<Range<usize>>,
    /// Groups of each section.
    sections: Vec<Range<usize>>,
    /// Centres along the line, metres.
    pub(super) x_m: [f32; MAX_GROUPS],
    /// Half the length of the longest group.
    half_m: f64,
    line_half_m: f64,
    /// Room for directions.
    pub(super) capacity: usize,
    kernel: Kernel,
}

/// Coefficients of the first half of the taps: polynomials of the position between the two middle directions, from -1/2 to 1/2. The others mirror them.
pub(super) type Kernel = [[f32; TERMS]; TAPS / 2];

/// Directions of every group in one ping.
#[derive(Clone, Copy, Debug)]
pub(super) struct Directions {
    pub(super) of_group: [Grid; MAX_GROUPS],
    /// Of all groups.
    pub(super) count: usize,
}

impl Directions {
    /// Of groups with these sectors, of sines, and these distances of their far ends, metres; `half_m` is half the length of the longest.
    pub(super) fn new(
        groups: impl Iterator<Item = ([f64; 2], f64)>,
        half_m: f64,
        (pulse, band_hz, c): (&Pulse, f64, f64),
    ) -> Self {
        // The compressed echo of a CW pulse has its first zeros at twice this bandwidth.
        let edge_hz = match pulse.kind {
            PulseKind::Cw => band_hz,
            _ => 0.5 * band_hz,
        };
        let mut directions = Self {
            of_group: [Grid::default(); MAX_GROUPS],
            count: 0,
        };
        let margin = TAPS / 2 + REACH;
        for (grid, ([from, to], end_m)) in directions.of_group.iter_mut().zip(groups) {
            let cycles = (pulse.center_frequency_hz * half_m + edge_hz * end_m) / c;
            let step = 0.5 / (OVERSAMPLING * cycles);
            *grid = Grid {
                first: from - margin as f64 * step,
                step,
                count: ((to - from) / step).ceil() as usize + 2 * margin,
                before: directions.count,
            };
            directions.count += grid.count;
        }
        directions
    }

    /// Largest change of a slope from the middle of a span to its ends.
    pub(super) fn max_shift(&self) -> f64 {
        let grids = self.of_group.iter().filter(|grid| grid.count > 0);
        MAX_SHIFT * grids.map(|grid| grid.step).fold(f64::INFINITY, f64::min)
    }
}

/// Directions of one group, in equal steps of the sine.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Grid {
    pub(super) first: f64,
    pub(super) step: f64,
    pub(super) count: usize,
    /// Directions of the groups before.
    pub(super) before: usize,
}

impl Grid {
    pub(super) fn sine(&self, j: usize) -> f64 {
        self.first + self.step * j as f64
    }
}

/// [`BEAMS`] beams of the fan at the range of a tile, as each group sees them.
pub(super) struct Seen {
    /// Index of the direction, counted from the group's first.
    pub(super) at: [[f32; BEAMS]; MAX_GROUPS],
    pub(super) slope: [[f32; BEAMS]; MAX_GROUPS],
    /// Change of the index for each change of the slope.
    pub(super) per_slope: [[f32; BEAMS]; MAX_GROUPS],
}

impl Seen {
    pub(super) const NONE: Self = Self {
        at: [[0.0; BEAMS]; MAX_GROUPS],
        slope: [[0.0; BEAMS]; MAX_GROUPS],
        per_slope: [[0.0; BEAMS]; MAX_GROUPS],
    };
}

/// Phase of the centre of a group in one of its directions beyond that of the focus of a span, in cycles: a parabola of the place in the span, from
/// -1 at the first sample to 1 at the last.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Sweep {
    linear: f32,
    square: f32,
}

impl Sweep {
    /// Through the phases at the first, the middle and the last sample, cycles.
    #[inline(always)]
    pub(super) fn through([first, middle, last]: [f32; 3]) -> Self {
        Self {
            linear: 0.5 * (last - first),
            square: 0.5 * (last + first) - middle,
        }
    }

    /// Turns samples at these places.
    #[inline(always)]
    pub(super) fn turn(&self, places: &[f32], [re, im]: [&mut [f32]; 2]) {
        for ((place, re), im) in places.iter().zip(re).zip(im) {
            let (sin, cos) = turn(place * (self.linear + place * self.square));
            (*re, *im) = (cos * *re - sin * *im, sin * *re + cos * *im);
        }
    }
}

/// Coefficients of the second sums of [`BEAMS`] beams in one span. A group contributes the sum of [`TAPS`] directions times `w`, turned by
/// the phase of its centre.
pub(super) struct Mix {
    /// First direction.
    pub(super) first: [[u32; BEAMS]; MAX_GROUPS],
    pub(super) w: [[[f32; BEAMS]; TAPS]; MAX_GROUPS],
    /// What is added to `w` at the last sample and taken from it at the first. Not set where the focus does not move.
    pub(super) change: [[[f32; BEAMS]; TAPS]; MAX_GROUPS],
    pub(super) cos: [[f32; BEAMS]; MAX_GROUPS],
    pub(super) sin: [[f32; BEAMS]; MAX_GROUPS],
}

impl Mix {
    pub(super) const NONE: Self = Self {
        first: [[0; BEAMS]; MAX_GROUPS],
        w: [[[0.0; BEAMS]; TAPS]; MAX_GROUPS],
        change: [[[0.0; BEAMS]; TAPS]; MAX_GROUPS],
        cos: [[0.0; BEAMS]; MAX_GROUPS],
        sin: [[0.0; BEAMS]; MAX_GROUPS],
    };
}

impl Groups {
    /// The division of a line with the fewest products, if the dense sum has more. `rows` is the number of rows for each delay.
    pub(super) fn new(
        array: &ArrayGeometry,
        sections: &[Range<usize>],
        (sector, beams): ([f64; 2], usize),
        (pulse, rate_hz, c): (&Pulse, f64, f64),
        rows: usize,
    ) -> Option<Self> {
        if array.radius_m.is_some() {
            return None;
        }
        let elements = array.elements;
        let mut best: Option<(f64, Self)> = None;
        for size in [8, 16, BLOCK] {
            let groups = Self::of_size(size, sections, array.spacing_m)?;
            if groups.parts.len() > GROUPS_OF_LINE {
                continue;
            }
            let products = groups.products((sector, beams), (pulse, c), rows);
            if best.as_ref().is_none_or(|(least, _)| products < *least) {
                let capacity = groups.directions(sector, pulse, rate_hz, c).count;
                best = Some((products, Self { capacity, ..groups }));
            }
        }
        let dense = (elements * beams * rows) as f64;
        best.filter(|(products, _)| ADVANTAGE * products < dense)
            .map(|(_, groups)| groups)
    }

    fn of_size(size: usize, sections: &[Range<usize>], spacing_m: f64) -> Option<Self> {
        let elements = sections.last()?.end;
        let (mut parts, mut of_section) = (Vec::new(), Vec::new());
        for section in sections {
            let first = parts.len();
            let count = section.len().div_ceil(size);
            parts.extend((0..count).map(|g| {
                let at = |g: usize| section.start + g * section.len() / count;
                at(g)..at(g + 1)
            }));
            of_section.push(first..parts.len());
        }
        let longest = parts.iter().map(Range::len).max()?;
        let mut x_m = [0.0; MAX_GROUPS];
        for (x, part) in x_m.iter_mut().zip(&parts) {
            let middle = 0.5 * (part.start + part.end - 1) as f64;
            *x = (spacing_m * (middle - 0.5 * (elements - 1) as f64)) as f32;
        }
        Some(Self {
            parts,
            sections: of_section,
            x_m,
            half_m: 0.5 * spacing_m * (longest - 1).max(1) as f64,
            line_half_m: 0.5 * spacing_m * elements as f64,
            capacity: 0,
            kernel: kernel(),
        })
    }
}

impl Grouping for Groups {
    fn parts(&self) -> &[Range<usize>] {
        &self.parts
    }

    fn capacity(&self) -> usize {
        self.capacity
    }

    fn directions(&self, sector: [f64; 2], pulse: &Pulse, band_hz: f64, c: f64) -> Directions {
        let groups = self.x_m[..self.parts.len()].iter();
        let of_group = groups.map(|x_m| (sector, f64::from(x_m.abs()) + self.half_m));
        Directions::new(of_group, self.half_m, (pulse, band_hz, c))
    }

    fn max_curvature_per_m(&self, pulse: &Pulse, c: f64) -> f64 {
        max_curvature_per_m(self.half_m, self.line_half_m, pulse, c)
    }

    fn span_curvature_per_m(&self, directions: &Directions) -> f64 {
        directions.max_shift() / self.line_half_m
    }

    fn products(
        &self,
        (sector, beams): ([f64; 2], usize),
        (pulse, c): (&Pulse, f64),
        rows: usize,
    ) -> f64 {
        let directions = self.directions(sector, pulse, band_hz(pulse), c);
        let elements = self.parts.last().map_or(0, |part| part.end);
        let first = directions.count * elements / self.parts.len() * rows;
        // A real coefficient has half of the products of a complex one.
        (first + beams * self.parts.len() * (TAPS / 2 + 1)) as f64
    }

    fn sections(&self, _: usize) -> &[Range<usize>] {
        &self.sections
    }

    #[inline(always)]
    fn see(&self, _: usize, directions: &Directions, foci: &Foci, seen: &mut Seen) {
        for (g, grid) in directions.of_group[..self.parts.len()].iter().enumerate() {
            let (first, per_step) = (grid.first, 1.0 / grid.step);
            let x = self.x_m[g];
            for i in 0..BEAMS {
                let focus = foci.at(i);
                let (q, slope) = focus.leg(x);
                seen.at[g][i] = ((f64::from(focus.sine) - first) * per_step) as f32;
                seen.slope[g][i] = slope;
                // d slope / d sine = -(R/q) (1 - slope x/q).
                let over = focus.radius_m * (q - slope * x);
                seen.per_slope[g][i] = per_step as f32 * q * q / over.max(1e-6);
            }
        }
    }

    #[inline(always)]
    fn mix(
        &self,
        steering: &Steering,
        (_, directions): (usize, &Directions),
        seen: &Seen,
        (foci, farther_m): (&Foci, Option<f32>),
        mix: &mut Mix,
    ) {
        let mach = steering.mach();
        for (g, grid) in directions.of_group[..self.parts.len()].iter().enumerate() {
            let x = self.x_m[g];
            let mut at = seen.at[g];
            let mut late_m = [0.0f32; BEAMS];
            let mut shift = [0.0f32; BEAMS];
            let by_m = farther_m.unwrap_or(0.0);
            // Loops without branches or divisions of f64, so that they vectorise.
            match steering.is_focused() {
                true => {
                    for i in 0..BEAMS {
                        let focus = foci.at(i);
                        let (late, slope, per_q) = focus.late_m(mach, x);
                        late_m[i] = late;
                        at[i] += (seen.slope[g][i] - slope) * seen.per_slope[g][i];
                        let per_radius =
                            focus.slope_per_radius([x, 0.0], [1.0, 0.0], (slope, per_q));
                        shift[i] = -by_m * per_radius * seen.per_slope[g][i];
                    }
                }
                false => {
                    for (i, late_m) in late_m.iter_mut().enumerate() {
                        *late_m = foci.at(i).far_late_m(x);
                    }
                }
            }
            let shift = farther_m.map(|_| &shift);
            mix.set(g, grid, (&self.kernel, at, shift), |i| {
                turn(late_m[i] * steering.cycles_per_m())
            });
        }
    }
}

impl Mix {
    /// Sets the coefficients of group `g`, for indices of directions counted from its first, and their change to the end of the span. `turn`: sine
    /// and cosine of the phase of its centre, times its weight, of each beam.
    #[inline(always)]
    pub(super) fn set(
        &mut self,
        g: usize,
        grid: &Grid,
        (kernel, mut at, shift): (&Kernel, [f32; BEAMS], Option<&[f32; BEAMS]>),
        turn: impl Fn(usize) -> (f32, f32),
    ) {
        let (last, before) = ((grid.count - TAPS) as i32, grid.before as i32);
        for (at, to) in at.iter_mut().zip(&mut self.first[g]) {
            let first = (whole_number(*at - 0.5) - (TAPS / 2 - 1) as i32).clamp(0, last);
            *at = *at - first as f32 - (TAPS / 2) as f32 + 0.5;
            *to = (before + first) as u32;
        }
        for i in 0..BEAMS {
            (self.sin[g][i], self.cos[g][i]) = turn(i);
        }
        let [w, change] = [&mut self.w[g], &mut self.change[g]];
        interpolate(kernel, &at, w);
        if let Some(shift) = shift {
            // The chord between the ends, moved to halve its largest distance from the coefficients.
            let mut ends = [[[0.0f32; BEAMS]; TAPS]; 2];
            for (sign, end) in [-1.0, 1.0].into_iter().zip(&mut ends) {
                let mut at = at;
                for (at, shift) in at.iter_mut().zip(shift) {
                    *at += sign * shift;
                }
                interpolate(kernel, &at, end);
            }
            for t in 0..TAPS {
                for i in 0..BEAMS {
                    let [a, b] = [ends[0][t][i], ends[1][t][i]];
                    w[t][i] = 0.5 * w[t][i] + 0.25 * (a + b);
                    change[t][i] = 0.5 * (b - a);
                }
            }
        }
    }
}

/// Coefficients at positions between the two middle directions.
#[inline(always)]
fn interpolate(kernel: &Kernel, at: &[f32; BEAMS], w: &mut [[f32; BEAMS]; TAPS]) {
    for (t, terms) in kernel.iter().enumerate() {
        for (i, at) in at.iter().enumerate() {
            let square = at * at;
            let (mut even, mut odd) = (0.0, 0.0);
            for pair in terms.chunks_exact(2).rev() {
                even = even * square + pair[0];
                odd = odd * square + pair[1];
            }
            odd *= at;
            w[t][i] = even + odd;
            w[TAPS - 1 - t][i] = even - odd;
        }
    }
}

/// Largest change of 1/r from the range of a tile to its ends, for groups of half a length, of which the farthest lies `reach_m` from the axis of a beam.
pub(super) fn max_curvature_per_m(half_m: f64, reach_m: f64, pulse: &Pulse, c: f64) -> f64 {
    let wavelength_m = c / pulse.center_frequency_hz;
    let curvature = std::f64::consts::PI * half_m * half_m / wavelength_m;
    let rms_rad_per_s = std::f64::consts::PI / 3f64.sqrt() * band_hz(pulse);
    let envelope = 0.5 * reach_m * reach_m / c * rms_rad_per_s;
    (MAX_CURVATURE_RAD / curvature).min(MAX_ENVELOPE_RAD / envelope)
}

/// Coefficients that interpolate functions of the band with least squares, as polynomials through Chebyshev nodes.
pub(super) fn kernel() -> Kernel {
    let node = |n: usize| 0.5 * (std::f64::consts::PI * (n as f64 + 0.5) / TERMS as f64).cos();
    let mut at_node = [[0.0; TERMS]; TAPS / 2];
    for n in 0..TERMS {
        let (w, _) = least_squares::<TAPS>(TAPS, 0.5 / OVERSAMPLING, node(n));
        for (values, w) in at_node.iter_mut().zip(w) {
            values[n] = w;
        }
    }
    at_node.map(|values| {
        let powers: [[f64; TERMS]; TERMS] =
            std::array::from_fn(|n| std::array::from_fn(|k| node(n).powi(k as i32)));
        solve(powers, values).map(|term| term as f32)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use num_complex::Complex64;
    use std::f64::consts::TAU;

    #[test]
    fn the_kernel_interpolates_its_band_with_an_rms_error_of_4e_3() {
        let kernel = kernel();
        let mut worst = 0.0_f64;
        for step in 0..=40 {
            let at = f64::from(step) / 40.0 - 0.5;
            let w: [f64; TAPS] = std::array::from_fn(|t| {
                let (terms, at) = match kernel.get(t) {
                    Some(terms) => (terms, at),
                    None => (&kernel[TAPS - 1 - t], -at),
                };
                let terms = terms.iter().rev();
                terms.fold(0.0, |sum, term| sum * at + f64::from(*term))
            });
            let mut sum = 0.0;
            for n in -50..=50 {
                let cycles = f64::from(n) / 50.0 / (2.0 * OVERSAMPLING);
                let wave = |x: f64| Complex64::from_polar(1.0, TAU * cycles * x);
                let got: Complex64 = (0..TAPS)
                    .map(|t| w[t] * wave(t as f64 - 0.5 * (TAPS - 1) as f64))
                    .sum();
                sum += (got - wave(at)).norm_sqr();
            }
            worst = worst.max((sum / 101.0).sqrt());
        }
        println!("rms error at the worst position: {worst:.2e}");
        assert!(worst < 4e-3, "{worst:.2e}");
    }
}
