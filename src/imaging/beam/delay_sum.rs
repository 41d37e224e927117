//! Delay-and-sum beams in the time domain: far field with phases or true time delays, or focused along range while the platform moves.
//!
//! The echo of a point S at element e is env(t - u_e) exp(-j 2pi f_c u_e). With delta_e = u_e - u_c, where c is the array's centre, a beam
//! is
//!
//! ```text
//! y(t) = sum_e w_e x_e(t + delta_e) exp(+j 2pi f_c delta_e),    sum_e w_e = 1
//! ```
//!
//! Sample k of a beam is a leading edge at the *array's centre*, and a unit point in focus peaks at 1.
//!
//! - `time-delay`: delta_e = -x_e sin(theta)/c. `phase`: the same without the shift of the envelope.
//! - `dynamic-focus`: S = R (sin theta, cos theta) in the plane of the array's line and boresight, about the array's centre at the start of
//!   the pulse. R solves |S - p_T| + |S - v t| = c t. This includes both legs: the transmitter at its position, and a receiver that moves
//!   at constant velocity (the ping's first segment). Element e receives S at c delta_e = Q - D - (q.v/Q) delta_e, with q = S - v t - x_e,
//!   Q = |q|, D = |S - v t|. Q - D is computed as x_e (x_e - 2 d_x)/(Q + D), which is well conditioned in f32.
//!   A focus applies to a zone of ranges r in which its carrier-phase error is at most `focus_error_rad` at the outermost element. The
//!   error is (pi/lambda) a^2 |1/r - 1/r_zone|, where a is half the aperture in use. With `f_number` = F the aperture in use is r/F, limited
//!   to the whole line. The focus stays at 1.5 a, or farther at `focus_from_m`, for nearer samples. Sums by groups follow the focus
//!   from sample to sample, in spans instead of zones, see [`groups`].
//!
//! Rows are matched-filtered and summed in f32. Delays use rows at a few fractions of a sample, see [`interpolation`]. Their error affects the
//! envelope only, because carrier phases use the exact delay. A line of many elements with many beams is summed by [`groups`] of elements,
//! with a few of the products; other lines and apertures element by element. Work proceeds in tiles of at most
//! [`MAX_SAMPLES`] samples, so that rows and sums stay in the second-level cache, and is split by tile.
//!
//! On an arc each beam has elements of its own, see [`arc`]; places along the boresight enter the delays.
//!
//! For bottom detection the line has two sections, its halves. Their sums refer to the whole line's centre, so that they agree in phase on the
//! axis of every beam. The fan of the whole line is their sum; a detection needs only their product besides.
//!
//! Not modelled in the steering: motion out of the plane of line and boresight, rotation during the echo, and the Doppler stretch (a common
//! range shift through range-Doppler coupling).

mod arc;
mod arc_groups;
mod groups;
mod interpolation;
mod second_sum;
mod steering;

use std::f64::consts::PI;
use std::ops::Range;

use num_complex::Complex32;
use rayon::prelude::*;

pub(super) use arc::ArcApertures;
use arc_groups::ArcGroups;

use super::RowLimits;
use super::kernel::{BLOCK, MAX_SAMPLES, STEP, Sums, Taps, add_rows};
use super::steered::SteeredArray;
use super::weights::Taper;
use echotank_config::spec::{FanSpec, Former, Shading};
use echotank_core::arrays::{ArrayGeometry, TransmitArray};
use echotank_core::ping::{BeamFrame, ElementFrame, PingPlan};
use echotank_core::pulse::Pulse;
use echotank_core::simd::SimdLevel;
use groups::{BEAMS, Directions, Grid, Grouping, Groups, Mix, Seen, Sweep};
use interpolation::{Interpolation, MAX_FRACTIONS, TAPS, band_hz, convolve};
use second_sum::{CHUNK, sum_directions};
use steering::{Foci, Focus, GridLayout, MIN_DISTANCE_M, Steering};

/// Minimum range of a focus in units of half the aperture.
const MIN_FOCUS: f64 = 1.5;
/// Directions of a group that are steered together.
const FOCI: usize = 8;
/// Maximum number of sections: two halves, and the middle element of an odd number.
const MAX_SECTIONS: usize = 3;

/// Beams of one receive array.
pub(crate) struct DelaySumFormer {
    steered: SteeredArray<f32>,
    former: Former,
    /// Element positions along the array's axis from its centre, and on an arc along the boresight, metres.
    x_m: Vec<f32>,
    z_m: Vec<f32>,
    /// Position of the transmitter relative to the array's centre, along the line and the boresight, metres.
    transmit_m: [f64; 2],
    array_from_body: glam::DQuat,
    taper: Taper,
    f_number: Option<f64>,
    focus_error_rad: f64,
    focus_from_m: f64,
    /// Elements of a line that are summed apart: all, or two halves and between them what is left. The beams of an arc have their own.
    sections: Vec<Range<usize>>,
    has_halves: bool,
    /// Zeros before and after each row, for the reach of delays and filters.
    margin: usize,
    /// Samples before and after a tile that the delays of each element reach.
    reach: Vec<usize>,
    /// Element-major compressed rows with their margins: real parts, imaginary parts.
    rows: Vec<f32>,
    row_length: usize,
    zones: Vec<Zone>,
    /// Element weights of each zone.
    zone_weights: Vec<f32>,
    tiles: Vec<Tile>,
    interpolation: Interpolation,
    groups: Option<Groups>,
    arc_groups: Option<ArcGroups>,
    /// Of this ping, where the groups serve.
    directions: Option<Directions>,
    simd_level: SimdLevel,
    workers: Vec<Worker>,
}

/// Samples that share a focus.
#[derive(Clone, Copy, Debug)]
struct Zone {
    first: usize,
    end: usize,
    /// Two-way time of the focus.
    time_s: f64,
}

/// Samples that are summed together.
#[derive(Clone, Copy, Debug)]
struct Tile {
    first: usize,
    end: usize,
    /// Two-way time of the focus of groups; element by element where there is none.
    time_s: Option<f64>,
}

/// Samples of a tile of groups that share a focus, or through which it moves evenly. Counted from the first of the tile.
#[derive(Clone, Copy, Debug)]
struct Span {
    first: usize,
    end: usize,
    /// Two-way time of the focus.
    time_s: f64,
    /// Of the first and the last sample, if the focus moves from one to the other; `time_s` then is their middle.
    ends_s: Option<[f64; 2]>,
}

struct Worker {
    /// Rows of [`BLOCK`] elements at all fractions: real parts, imaginary parts.
    grid: Vec<f32>,
    /// Sums of each group in each direction: real parts, imaginary parts of a tile.
    directions: Vec<f32>,
    spans: Vec<Span>,
    /// Sums of a tile element by element, for each section of each beam.
    tile: Vec<[Sums; MAX_SECTIONS]>,
    /// Focus of each direction of a group, or of each beam.
    focus: Vec<Focus>,
    beams: Box<BeamBatch>,
    buffer: Vec<Complex32>,
    scratch: Vec<Complex32>,
}

/// [`BEAMS`] beams of a tile.
struct BeamBatch {
    foci: Foci,
    seen: Seen,
    mix: Mix,
}

impl DelaySumFormer {
    /// `array` is the receive array that `fan` names, `transmit` its transmitter. Work is shared among the threads of the current pool. A fan with
    /// bottom detection has halves, for [`DelaySumFormer::form_with_halves`]: those of an even number of elements; the middle element of an odd
    /// number is in neither.
    ///
    /// Panics on a fan without beams, an array without elements or a pulse beyond `limits`; a checked configuration prevents these.
    pub(crate) fn new(
        array: &ArrayGeometry,
        transmit: &TransmitArray,
        fan: &FanSpec,
        limits: RowLimits,
        pulse: &Pulse,
        weighting: Shading,
        sound_speed_m_per_s: f64,
    ) -> Self {
        let c = sound_speed_m_per_s;
        let has_halves = fan.form.bottom_detection;
        let sections = match array.radius_m {
            None => sections(array.elements, has_halves),
            Some(_) => sections(2, has_halves),
        };
        let steered = SteeredArray::new(array, fan, (limits, 0), pulse, weighting, c);
        let elements = array.elements;
        let half_m = 0.5 * array.spacing_m * (elements - 1) as f64;
        // A platform speed of a tenth of the sound speed lengthens delays by that fraction, and groups reach beyond the outermost beams.
        let reach = |x_m: f64| (1.4 * x_m.abs() / c * limits.sample_rate_hz).ceil() as usize + 3;
        let margin = reach(half_m);
        let array_from_body = array.mounting.body_from_array.inverse();
        let transmit_m =
            array_from_body * (transmit.mounting.position_m - array.mounting.position_m);
        let row_length = limits.samples + 2 * (margin + TAPS) + 2 * MAX_SAMPLES;
        let former = fan.form.former;
        let interpolation = Interpolation::new(former, pulse, limits.sample_rate_hz);
        let rows = if interpolation.is_linear { 2 } else { 1 };
        // Roll may turn the fan to any direction.
        let sector = match fan.form.roll_stabilised {
            true => [-1.0, 1.0],
            false => ends(&steered.directions.sine),
        };
        let groups = Groups::new(
            array,
            &sections,
            (sector, fan.beams),
            (pulse, limits.sample_rate_hz, c),
            rows,
        );
        let arc_groups = steered.arc.as_ref().and_then(|arc| {
            let pulse = (pulse, limits.sample_rate_hz, c);
            ArcGroups::new(array, (arc, has_halves), sector, pulse, rows)
        });
        let capacity = either(&groups, &arc_groups).map_or(0, Grouping::capacity);
        let room = capacity * 2 * MAX_SAMPLES + STEP;
        let grid_room = BLOCK.min(elements) * MAX_FRACTIONS * 2 * grid_row(margin) + STEP;
        let mut former = Self {
            former,
            x_m: (0..elements).map(|e| array.element_m(e).x as f32).collect(),
            z_m: (0..elements).map(|e| array.element_m(e).z as f32).collect(),
            transmit_m: [transmit_m.x, transmit_m.z],
            array_from_body,
            taper: Taper::new(fan.shading),
            f_number: fan.form.f_number,
            focus_error_rad: fan.form.focus_error_rad,
            focus_from_m: fan.form.focus_from_m,
            sections,
            has_halves,
            margin,
            reach: (0..elements).map(|e| reach(array.along_m(e))).collect(),
            rows: vec![0.0; elements * 2 * row_length],
            row_length,
            zones: Vec::with_capacity(limits.samples),
            zone_weights: Vec::new(),
            tiles: Vec::with_capacity(limits.samples),
            interpolation,
            groups,
            arc_groups,
            directions: None,
            simd_level: SimdLevel::best(),
            workers: (0..rayon::current_num_threads().max(1))
                .map(|_| Worker {
                    grid: vec![0.0; grid_room],
                    directions: vec![0.0; room],
                    spans: Vec::with_capacity(MAX_SAMPLES),
                    tile: (0..fan.beams).map(|_| [Sums::ZERO; MAX_SECTIONS]).collect(),
                    focus: vec![Focus::default(); fan.beams.max(capacity)],
                    beams: Box::new(BeamBatch {
                        foci: Foci::NONE,
                        seen: Seen::NONE,
                        mix: Mix::NONE,
                    }),
                    buffer: vec![Complex32::ZERO; steered.correlator.length()],
                    scratch: steered.correlator.make_scratch(),
                })
                .collect(),
            steered,
        };
        // Sizes the buffers for the zones of the longest ping, or one zone.
        former.make_zones(limits.samples, 0.0);
        former
            .zone_weights
            .reserve_exact(elements * former.zones.len());
        former
    }

    /// Products of complex numbers of a ping with so many samples, and groups of all beams for each span (or elements for each focal zone).
    pub(super) fn work(
        array: &ArrayGeometry,
        fan: &FanSpec,
        pulse: &Pulse,
        (rate_hz, samples): (f64, usize),
        c: f64,
    ) -> (f64, f64) {
        let interpolation = Interpolation::new(fan.form.former, pulse, rate_hz);
        let rows = if interpolation.is_linear { 2 } else { 1 };
        let sector = ends(&super::directions::Directions::new(array, fan).sine);
        let groups = Groups::new(
            array,
            &sections(array.elements, fan.form.bottom_detection),
            (sector, fan.beams),
            (pulse, rate_hz, c),
            rows,
        );
        let arc = ArcApertures::new(array, fan).map(|mut arc| {
            arc.aim(&super::directions::Directions::new(array, fan).sine);
            arc
        });
        let arc_groups = arc.as_ref().and_then(|arc| {
            let of = (arc, fan.form.bottom_detection);
            ArcGroups::new(array, of, sector, (pulse, rate_hz, c), rows)
        });
        // With groups, spans have the coefficients that zones have without.
        let (sums, parts, span) = match (either(&groups, &arc_groups), &arc) {
            (Some(groups), _) => {
                let directions = groups.directions(sector, pulse, band_hz(pulse), c);
                (
                    groups.products((sector, fan.beams), (pulse, c), rows),
                    groups.parts().len(),
                    Some(groups.span_curvature_per_m(&directions)),
                )
            }
            (None, Some(arc)) => {
                let of_beam = arc.terms() / fan.beams.max(1);
                ((arc.terms() * rows) as f64, of_beam, None)
            }
            (None, None) => {
                let products = array.elements * fan.beams * rows;
                (products as f64, array.elements, None)
            }
        };
        // A real coefficient has half of the products of a complex one.
        let between =
            0.5 * (array.elements * interpolation.fractions() * interpolation.taps) as f64;
        let zones = match fan.form.former {
            Former::DynamicFocus => {
                let half_m = match &arc {
                    Some(arc) => arc.half_m,
                    None => 0.5 * array.spacing_m * array.elements as f64,
                };
                let wavelength_m = c / pulse.center_frequency_hz;
                let of_zone = curvature_of(fan.form.focus_error_rad, wavelength_m, half_m);
                let curvature = span.map_or(of_zone, |of_span| of_span.max(of_zone));
                let near_m = fan.form.focus_from_m.max(MIN_FOCUS * half_m);
                zones(curvature, near_m, samples, 0.5 * c / rate_hz)
                    + span.map_or(0.0, |_| (samples / MAX_SAMPLES) as f64)
            }
            _ => 1.0,
        };
        let products = samples as f64 * (between + sums);
        (products, zones * (fan.beams * parts) as f64)
    }

    /// Index of the fan's receive array.
    pub(crate) fn array(&self) -> usize {
        self.steered.array()
    }

    /// Forms the beams of one ping. `frame` holds the samples of the fan's array; `out` grows once to its maximum size and is reused.
    pub(crate) fn form(&mut self, plan: &PingPlan, frame: &ElementFrame, out: &mut BeamFrame) {
        self.form_with_halves(plan, frame, Some(out), None);
    }

    /// Forms the beams of the whole line in `whole`, and in `products`, beam-major, the products of the beams of the half at the array's -x end and
    /// the conjugates of those at its +x end.
    pub(crate) fn form_with_halves(
        &mut self,
        plan: &PingPlan,
        frame: &ElementFrame,
        mut whole: Option<&mut BeamFrame>,
        mut products: Option<&mut Vec<Complex32>>,
    ) {
        self.steered.begin(plan, frame);
        if let Some(whole) = &mut whole {
            self.steered.size(frame.samples, whole);
        }
        if let Some(products) = &mut products {
            self.steered.size_samples(frame.samples, products);
        }
        if frame.samples == 0 {
            return;
        }
        let limits = self.steered.correlator.limits();
        self.interpolation
            .set_pulse(&plan.pulse, limits.sample_rate_hz);
        self.make_zones(frame.samples, plan.first_sample_s);
        self.weigh_zones();
        self.aim_groups();
        self.make_tiles(frame.samples, plan.first_sample_s);
        self.compress(frame);
        let out = Outputs {
            whole: whole.map(|whole| Columns::new(&mut whole.iq, frame.samples)),
            products: products.map(|products| Columns::new(products, frame.samples)),
        };
        self.sum(plan, out);
    }

    /// Half the aperture in use at a range, metres; of an arc, that of a line with the same error of focus.
    fn half_aperture_m(&self, range_m: f64) -> f64 {
        if let Some(arc) = &self.steered.arc {
            return arc.half_m;
        }
        let whole = 0.5 * self.steered.spacing_m() * self.x_m.len() as f64;
        match self.f_number {
            Some(f) => whole.min(0.5 * range_m / f),
            None => whole,
        }
    }

    /// Nearest range of the focus, metres.
    fn min_focus_m(&self) -> f64 {
        let half_m = self.half_aperture_m(f64::INFINITY);
        self.focus_from_m.max(MIN_FOCUS * half_m)
    }

    fn uses_whole_line(&self, range_m: f64) -> bool {
        self.half_aperture_m(range_m) >= self.half_aperture_m(f64::INFINITY)
    }

    fn range_m(&self, sample: usize, first_sample_s: f64) -> f64 {
        let rate_hz = self.steered.correlator.limits().sample_rate_hz;
        let time_s = first_sample_s + sample as f64 / rate_hz;
        (0.5 * self.steered.sound_speed_m_per_s * time_s).max(MIN_DISTANCE_M)
    }

    /// The sample after the last one whose range is at most `range_m`.
    fn end_of_range(&self, range_m: f64, first_sample_s: f64) -> f64 {
        let rate_hz = self.steered.correlator.limits().sample_rate_hz;
        (2.0 * range_m / self.steered.sound_speed_m_per_s - first_sample_s) * rate_hz + 1.0
    }

    fn make_zones(&mut self, samples: usize, first_sample_s: f64) {
        self.zones.clear();
        let zone = |first: usize, end: usize, time_s: f64| Zone { first, end, time_s };
        if self.former != Former::DynamicFocus {
            let rate_hz = self.steered.correlator.limits().sample_rate_hz;
            let time_s = first_sample_s + samples as f64 / rate_hz;
            self.zones.push(zone(0, samples, time_s));
            return;
        }
        let c = self.steered.sound_speed_m_per_s;
        let mut first = 0;
        while first < samples {
            let near_m = self.range_m(first, first_sample_s);
            let half_m = self.half_aperture_m(near_m);
            let min_m = self.focus_from_m.max(MIN_FOCUS * half_m);
            if near_m < min_m {
                let end = self.end_of_range(min_m, first_sample_s);
                let end = end.clamp((first + 1) as f64, samples as f64) as usize;
                self.zones.push(zone(first, end, 2.0 * min_m / c));
                first = end;
                continue;
            }
            // Permitted change of 1/r from a zone's middle to its ends.
            let curvature = curvature_of(self.focus_error_rad, self.steered.wavelength_m(), half_m);
            let far = 1.0 / near_m - 2.0 * curvature;
            // An aperture that grows with range is adapted in steps of 5 %.
            let max_m = match self.uses_whole_line(near_m) {
                false => 1.05 * near_m,
                true => f64::INFINITY,
            };
            let far_m = if far > 0.0 {
                (1.0 / far).min(max_m)
            } else {
                max_m
            };
            let end = self
                .end_of_range(far_m, first_sample_s)
                .clamp((first + 1) as f64, samples as f64) as usize;
            let middle = 0.5 * (1.0 / near_m + 1.0 / self.range_m(end - 1, first_sample_s));
            self.zones.push(zone(first, end, 2.0 / (c * middle)));
            first = end;
        }
    }

    fn weigh_zones(&mut self) {
        let elements = self.x_m.len();
        self.zone_weights.clear();
        if self.steered.arc.is_some() {
            return;
        }
        for z in 0..self.zones.len() {
            let range_m = 0.5 * self.steered.sound_speed_m_per_s * self.zones[z].time_s;
            let start = self.zone_weights.len();
            if self.uses_whole_line(range_m) {
                self.zone_weights
                    .extend(self.steered.weights.iter().map(|w| *w as f32));
            } else {
                // At least the middle of the line is in use.
                let half_m = self.half_aperture_m(range_m);
                let half_m = half_m.max(0.5 * self.steered.spacing_m()) as f32;
                let taper = &self.taper;
                self.zone_weights
                    .extend(self.x_m.iter().map(|x| match x.abs() <= half_m {
                        true => taper.at(f64::from(0.5 * x / half_m)) as f32,
                        false => 0.0,
                    }));
                let sum: f32 = self.zone_weights[start..start + elements].iter().sum();
                for w in &mut self.zone_weights[start..start + elements] {
                    *w /= sum;
                }
            }
        }
    }

    /// Directions of the groups for the fan of this ping, if there is room for them.
    fn aim_groups(&mut self) {
        if let (Some(groups), Some(arc)) = (&mut self.arc_groups, &self.steered.arc) {
            groups.aim(arc);
        }
        self.directions = either(&self.groups, &self.arc_groups).and_then(|groups| {
            let pulse = self.steered.correlator.pulse();
            let sector = ends(&self.steered.directions.sine);
            let c = self.steered.sound_speed_m_per_s;
            let directions = groups.directions(sector, pulse, band_hz(pulse), c);
            (directions.count <= groups.capacity()).then_some(directions)
        });
    }

    fn make_tiles(&mut self, samples: usize, first_sample_s: f64) {
        self.tiles.clear();
        let c = self.steered.sound_speed_m_per_s;
        let is_focused = self.former == Former::DynamicFocus;
        let min_focus_m = self.min_focus_m();
        let pulse = self.steered.correlator.pulse();
        let groups = self
            .directions
            .as_ref()
            .and(either(&self.groups, &self.arc_groups));
        let curvature = groups.map(|groups| groups.max_curvature_per_m(pulse, c));
        let mut first = 0;
        while first < samples {
            let mut tile = Tile {
                first,
                end: (first + MAX_SAMPLES).min(samples),
                time_s: None,
            };
            if let Some(curvature) = curvature {
                let near_m = self.range_m(first, first_sample_s);
                let (far_m, serve) = if !is_focused {
                    (f64::INFINITY, true)
                } else if !self.uses_whole_line(near_m) {
                    (min_focus_m.max(1.05 * near_m), false)
                } else if near_m < min_focus_m {
                    (min_focus_m, true)
                } else {
                    let far = 1.0 / near_m - 2.0 * curvature;
                    (if far > 0.0 { 1.0 / far } else { f64::INFINITY }, true)
                };
                tile.end = self
                    .end_of_range(far_m, first_sample_s)
                    .clamp((first + 1) as f64, tile.end as f64) as usize;
                let far_m = self.range_m(tile.end - 1, first_sample_s);
                let [near_m, far_m] = [near_m, far_m].map(|r| r.max(min_focus_m));
                let middle = 0.5 * (1.0 / near_m + 1.0 / far_m);
                tile.time_s = serve.then_some(2.0 / (c * middle));
            }
            first = tile.end;
            self.tiles.push(tile);
        }
    }

    /// Divides a tile of groups into spans.
    fn make_spans(&self, tile: &Tile, first_sample_s: f64, spans: &mut Vec<Span>) {
        spans.clear();
        let samples = tile.end - tile.first;
        let min_focus_m = self.min_focus_m();
        let focus_m = |k: usize| {
            let range_m = self.range_m(tile.first + k, first_sample_s);
            range_m.max(min_focus_m)
        };
        let groups = self
            .directions
            .as_ref()
            .zip(either(&self.groups, &self.arc_groups));
        let curvature = groups.map_or(f64::INFINITY, |(of, groups)| {
            groups.span_curvature_per_m(of)
        });
        let half_m = self.half_aperture_m(f64::INFINITY);
        // Change of 1/r with the permitted error of the focus.
        let still_per_m = curvature_of(self.focus_error_rad, self.steered.wavelength_m(), half_m);
        let mut first = 0;
        while first < samples {
            let near_m = focus_m(first);
            let far = match self.former {
                Former::DynamicFocus => 1.0 / near_m - 2.0 * curvature.max(still_per_m),
                _ => 0.0,
            };
            let end = match far > 0.0 {
                true => self.end_of_range(1.0 / far, first_sample_s) as usize,
                false => tile.end,
            };
            let mut end = end.clamp(tile.first + first + 1, tile.end) - tile.first;
            // Whole vectors, except for the last.
            let whole = end / STEP * STEP;
            if end < samples && whole > first {
                end = whole;
            }
            let far_m = focus_m(end - 1);
            let ends_s = [near_m, far_m].map(|r| 2.0 * r / self.steered.sound_speed_m_per_s);
            let change = 0.5 * (1.0 / near_m - 1.0 / far_m);
            let moves = self.former == Former::DynamicFocus && change > still_per_m;
            spans.push(Span {
                first,
                end,
                time_s: match moves {
                    true => 0.5 * (ends_s[0] + ends_s[1]),
                    false => 2.0 / (1.0 / ends_s[0] + 1.0 / ends_s[1]),
                },
                ends_s: moves.then_some(ends_s),
            });
            first = end;
        }
    }

    /// Matched-filters every element into its row.
    fn compress(&mut self, frame: &ElementFrame) {
        let (correlator, row_length) = (&self.steered.correlator, self.row_length);
        let simd_level = self.simd_level;
        let before = self.margin + TAPS;
        let share = self.x_m.len().div_ceil(self.workers.len());
        self.rows
            .par_chunks_mut(share * 2 * row_length)
            .zip(&mut self.workers)
            .enumerate()
            .for_each(|(w, (rows, worker))| {
                for (i, row) in rows.chunks_exact_mut(2 * row_length).enumerate() {
                    let (head, tail) = worker.buffer.split_at_mut(frame.samples);
                    simd_level.run(
                        #[inline(always)]
                        || {
                            for (to, x) in head.iter_mut().zip(frame.element(w * share + i)) {
                                *to = Complex32::new(x.re as f32, x.im as f32);
                            }
                        },
                    );
                    tail.fill(Complex32::ZERO);
                    correlator.forward(&mut worker.buffer, &mut worker.scratch);
                    correlator.inverse(&mut worker.buffer, &mut worker.scratch);
                    let (re, im) = row.split_at_mut(row_length);
                    let (re, re_tail) = re[before..].split_at_mut(frame.samples);
                    let (im, im_tail) = im[before..].split_at_mut(frame.samples);
                    simd_level.run(
                        #[inline(always)]
                        || {
                            for ((re, im), y) in re.iter_mut().zip(im).zip(&worker.buffer) {
                                (*re, *im) = (y.re, y.im);
                            }
                        },
                    );
                    re_tail.fill(0.0);
                    im_tail.fill(0.0);
                }
            });
    }

    fn sum(&mut self, plan: &PingPlan, out: Outputs) {
        let velocity = plan.segments.first().map_or(glam::DVec3::ZERO, |s| {
            self.array_from_body * (s.world_from_body.inverse() * s.velocity_m_per_s)
        });
        let steering = Steering {
            former: self.former,
            transmit_m: self.transmit_m,
            velocity_m_per_s: [velocity.x, velocity.z],
            c: self.steered.sound_speed_m_per_s,
            carrier_hz: self.steered.correlator.pulse().center_frequency_hz,
            rate_hz: self.steered.correlator.limits().sample_rate_hz,
        };
        let mut workers = std::mem::take(&mut self.workers);
        let this = &*self;
        let stride = workers.len();
        workers.par_iter_mut().enumerate().for_each(|(w, worker)| {
            for tile in this.tiles.iter().skip(w).step_by(stride) {
                // SAFETY: each tile has samples of its own, and one worker.
                unsafe {
                    match (
                        tile.time_s,
                        &this.groups,
                        &this.arc_groups,
                        &this.steered.arc,
                    ) {
                        (Some(time_s), Some(groups), ..) => {
                            this.make_spans(tile, plan.first_sample_s, &mut worker.spans);
                            this.sum_groups(groups, &steering, (tile, time_s), worker, &out);
                        }
                        (Some(time_s), None, Some(groups), _) => {
                            this.make_spans(tile, plan.first_sample_s, &mut worker.spans);
                            this.sum_arc_groups(groups, &steering, (tile, time_s), worker, &out);
                        }
                        (.., Some(arc)) => this.sum_arc(arc, &steering, tile, worker, &out),
                        (.., None) => this.sum_elements(&steering, tile, worker, &out),
                    }
                }
            }
        });
        self.workers = workers;
    }

    /// Zones with samples in the tile, from their first index on.
    fn zones_of(&self, tile: &Tile) -> impl Iterator<Item = (usize, &Zone)> {
        let first = self.zones.partition_point(|zone| zone.end <= tile.first);
        let zones = self.zones[first..].iter();
        let end = tile.end;
        zones
            .take_while(move |zone| zone.first < end)
            .enumerate()
            .map(move |(z, zone)| (first + z, zone))
    }

    /// Sums a tile element by element and writes it.
    ///
    /// # Safety
    /// No other thread writes the samples of this tile.
    unsafe fn sum_elements(
        &self,
        steering: &Steering,
        tile: &Tile,
        worker: &mut Worker,
        out: &Outputs,
    ) {
        let elements = self.x_m.len();
        let row = grid_row(self.margin);
        worker.tile.fill([Sums::ZERO; MAX_SECTIONS]);
        let mut taps = Taps::NONE;
        for (s, section) in self.sections.iter().enumerate() {
            for block in section.clone().step_by(BLOCK) {
                let block = block..(block + BLOCK).min(section.end);
                self.interpolate(tile, block.clone(), &mut worker.grid);
                let x_m = &self.x_m[block.clone()];
                for (z, zone) in self.zones_of(tile) {
                    let (from, to) = (zone.first.max(tile.first), zone.end.min(tile.end));
                    let weights = &self.zone_weights[z * elements..][block.clone()];
                    let layout = GridLayout {
                        row,
                        origin: self.margin + from - tile.first,
                    };
                    self.focus_beams(steering, zone, &mut worker.focus);
                    for (focus, total) in worker.focus.iter().zip(&mut worker.tile) {
                        let (interpolation, to_sum) = (&self.interpolation, (x_m, weights));
                        self.simd_level.run(
                            #[inline(always)]
                            || steering.steer(focus, to_sum, 0.0, interpolation, layout, &mut taps),
                        );
                        let total = total[s].part(from - tile.first..to - tile.first);
                        add_rows(self.simd_level, &worker.grid, row, &taps, total);
                    }
                }
            }
        }
        // SAFETY: the caller guarantees that the samples are this tile's alone.
        unsafe { self.finish_tile(tile, worker, out) };
    }

    /// Sums a tile of the beams of an arc, each over its own elements, and writes it.
    ///
    /// # Safety
    /// As of [`DelaySumFormer::sum_elements`].
    unsafe fn sum_arc(
        &self,
        arc: &ArcApertures,
        steering: &Steering,
        tile: &Tile,
        worker: &mut Worker,
        out: &Outputs,
    ) {
        let elements = self.x_m.len();
        let row = grid_row(self.margin);
        let element_rows = 2 * self.interpolation.fractions() * row;
        worker.tile.fill([Sums::ZERO; MAX_SECTIONS]);
        let mut taps = Taps::NONE;
        for first in (0..elements).step_by(BLOCK) {
            let block = first..(first + BLOCK).min(elements);
            self.interpolate(tile, block.clone(), &mut worker.grid);
            for (_, zone) in self.zones_of(tile) {
                let (from, to) = (zone.first.max(tile.first), zone.end.min(tile.end));
                self.focus_beams(steering, zone, &mut worker.focus);
                let of_beams = worker.focus.iter().zip(&mut worker.tile).zip(&arc.beams);
                for ((focus, total), beam) in of_beams {
                    for (s, section) in beam.sections(self.has_halves).enumerate() {
                        let part = section.start.max(block.start)..section.end.min(block.end);
                        if part.is_empty() {
                            continue;
                        }
                        let weights = arc.weights(beam, part.clone());
                        let places = [&self.x_m[part.clone()], &self.z_m[part.clone()]];
                        let layout = GridLayout {
                            row,
                            origin: self.margin + from - tile.first
                                + (part.start - block.start) * element_rows,
                        };
                        let (interpolation, to_sum) = (&self.interpolation, (places, weights));
                        self.simd_level.run(
                            #[inline(always)]
                            || {
                                steering.steer_arc(
                                    focus,
                                    to_sum,
                                    0.0,
                                    interpolation,
                                    layout,
                                    &mut taps,
                                )
                            },
                        );
                        let total = total[s].part(from - tile.first..to - tile.first);
                        add_rows(self.simd_level, &worker.grid, row, &taps, total);
                    }
                }
            }
        }
        // SAFETY: the caller guarantees that the samples are this tile's alone.
        unsafe { self.finish_tile(tile, worker, out) };
    }

    /// The points in focus of all beams in a zone.
    fn focus_beams(&self, steering: &Steering, zone: &Zone, foci: &mut [Focus]) {
        let sines = &self.steered.directions.sine;
        self.simd_level.run(
            #[inline(always)]
            || {
                for (focus, sine) in foci.iter_mut().zip(sines) {
                    *focus = steering.focus(*sine, zone.time_s);
                }
            },
        );
    }

    /// Writes the sums of a tile.
    ///
    /// # Safety
    /// As of [`DelaySumFormer::sum_elements`].
    unsafe fn finish_tile(&self, tile: &Tile, worker: &Worker, out: &Outputs) {
        let samples = tile.end - tile.first;
        for (beam, sums) in worker.tile.iter().enumerate() {
            let sums = sums
                .each_ref()
                .map(|sums| [&sums.re[..samples], &sums.im[..samples]]);
            let sums = &sums[..self.sections.len()];
            self.simd_level.run(
                #[inline(always)]
                // SAFETY: the caller guarantees that the samples are this tile's alone.
                || unsafe { finish(beam, tile.first, sums, out) },
            );
        }
    }

    /// Sums a tile of a line group by group and writes it.
    ///
    /// # Safety
    /// As of [`DelaySumFormer::sum_elements`].
    unsafe fn sum_groups(
        &self,
        groups: &Groups,
        steering: &Steering,
        (tile, time_s): (&Tile, f64),
        worker: &mut Worker,
        out: &Outputs,
    ) {
        // The weights of the whole line in f32, as of every zone of such a tile.
        let z = self.zones.partition_point(|zone| zone.end <= tile.first);
        let weights = &self.zone_weights[z * self.x_m.len()..];
        let layout = self.tile_layout();
        self.sum_directions_of(
            (&groups.parts, tile),
            worker,
            #[inline(always)]
            |g, grid, j, taps| {
                let part = groups.parts[g].clone();
                let focus = &steering.focus(grid.sine(j), time_s);
                let late_m = steering.late_m(focus, groups.x_m[g]);
                let to_sum = (&self.x_m[part.clone()], &weights[part]);
                steering.steer(focus, to_sum, late_m, &self.interpolation, layout, taps);
            },
            #[inline(always)]
            |g, grid, j, time_s| {
                let focus = &steering.focus(grid.sine(j), time_s);
                steering.late_m(focus, groups.x_m[g]) * steering.cycles_per_m()
            },
        );
        // SAFETY: the caller guarantees that the samples are this tile's alone.
        unsafe { self.mix_tile(groups, steering, (tile, time_s), worker, out) };
    }

    /// Sums a tile of the beams of an arc group by group and writes it.
    ///
    /// # Safety
    /// As of [`DelaySumFormer::sum_elements`].
    unsafe fn sum_arc_groups(
        &self,
        groups: &ArcGroups,
        steering: &Steering,
        (tile, time_s): (&Tile, f64),
        worker: &mut Worker,
        out: &Outputs,
    ) {
        let even = [1.0f32; BLOCK];
        let layout = self.tile_layout();
        self.sum_directions_of(
            (&groups.parts, tile),
            worker,
            #[inline(always)]
            |g, grid, j, taps| {
                let part = groups.parts[g].clone();
                let focus = &steering.focus_towards(groups.toward(g, grid, j), time_s);
                let late_m = steering.late_m_of(focus, groups.place_m[g]);
                let places = [&self.x_m[part.clone()], &self.z_m[part.clone()]];
                let to_sum = (places, &even[..part.len()]);
                steering.steer_arc(focus, to_sum, late_m, &self.interpolation, layout, taps);
            },
            #[inline(always)]
            |g, grid, j, time_s| {
                let focus = &steering.focus_towards(groups.toward(g, grid, j), time_s);
                steering.late_m_of(focus, groups.place_m[g]) * steering.cycles_per_m()
            },
        );
        // SAFETY: the caller guarantees that the samples are this tile's alone.
        unsafe { self.mix_tile(groups, steering, (tile, time_s), worker, out) };
    }

    /// The grid from the first sample of a tile on.
    fn tile_layout(&self) -> GridLayout {
        GridLayout {
            row: grid_row(self.margin),
            origin: self.margin,
        }
    }

    /// The first sums of a tile: each group in its directions. `steer` gives the rows and weights of a group in one of them, `turns` the phase of its
    /// centre with the focus of a two-way time, in cycles.
    fn sum_directions_of(
        &self,
        (parts, tile): (&[Range<usize>], &Tile),
        worker: &mut Worker,
        steer: impl Fn(usize, &Grid, usize, &mut Taps),
        turns: impl Fn(usize, &Grid, usize, f64) -> f32,
    ) {
        let Some(directions) = &self.directions else {
            unreachable!("tiles without groups have no focus of groups");
        };
        let samples = tile.end - tile.first;
        let row = grid_row(self.margin);
        let chunk_rows = 2 * CHUNK * directions.count;
        let mut taps = [Taps::NONE; FOCI];
        let mut sweeps = [Sweep::default(); FOCI];
        for ((g, part), grid) in parts.iter().enumerate().zip(&directions.of_group) {
            self.interpolate(tile, part.clone(), &mut worker.grid);
            for first in (0..grid.count).step_by(FOCI) {
                let count = FOCI.min(grid.count - first);
                let taps = &mut taps[..count];
                self.simd_level.run(
                    #[inline(always)]
                    || {
                        for (j, taps) in taps.iter_mut().enumerate() {
                            steer(g, grid, first + j, taps);
                        }
                    },
                );
                let rows = &mut worker.directions[2 * CHUNK * (grid.before + first)..];
                for (from, rows) in (0..samples).step_by(CHUNK).zip(rows.chunks_mut(chunk_rows)) {
                    for (taps, row_of) in taps.iter().zip(rows.chunks_exact_mut(2 * CHUNK)) {
                        row_of.fill(0.0);
                        let (re, im) = row_of.split_at_mut(CHUNK);
                        let samples = CHUNK.min(samples - from);
                        let sums = [&mut re[..samples], &mut im[..samples]];
                        add_rows(self.simd_level, &worker.grid[from..], row, taps, sums);
                    }
                }
                for span in &worker.spans {
                    let Some([first_s, last_s]) = span.ends_s else {
                        continue;
                    };
                    self.simd_level.run(
                        #[inline(always)]
                        || {
                            for (j, sweep) in sweeps[..count].iter_mut().enumerate() {
                                let of = [first_s, span.time_s, last_s]
                                    .map(|time_s| turns(g, grid, first + j, time_s));
                                *sweep = Sweep::through(of);
                            }
                        },
                    );
                    for part in span.parts() {
                        let rows = &mut rows[part.chunk * chunk_rows..];
                        let of_each = sweeps[..count].iter().zip(rows.chunks_exact_mut(2 * CHUNK));
                        self.simd_level.run(
                            #[inline(always)]
                            || {
                                let mut places = [0.0; CHUNK];
                                let places = span.places(&part, &mut places);
                                for (sweep, row_of) in of_each {
                                    let (re, im) = row_of.split_at_mut(CHUNK);
                                    sweep.turn(places, [re, im].map(|x| &mut x[part.origin..]));
                                }
                            },
                        );
                    }
                }
            }
        }
    }

    /// The second sums of a tile: the directions of all groups in each beam, which are written.
    ///
    /// # Safety
    /// As of [`DelaySumFormer::sum_elements`].
    unsafe fn mix_tile(
        &self,
        groups: &impl Grouping,
        steering: &Steering,
        (tile, time_s): (&Tile, f64),
        worker: &mut Worker,
        out: &Outputs,
    ) {
        let Some(directions) = &self.directions else {
            unreachable!("tiles without groups have no focus of groups");
        };
        let chunk_rows = 2 * CHUNK * directions.count;
        let BeamBatch { foci, seen, mix } = &mut *worker.beams;
        for (batch, sines) in self.steered.directions.sine.chunks(BEAMS).enumerate() {
            let beams = sines.len();
            let sines = &std::array::from_fn(|i| sines[i.min(beams - 1)]);
            let sections = groups.sections(batch);
            self.simd_level.run(
                #[inline(always)]
                || {
                    steering.focus_all(sines, time_s, foci);
                    groups.see(batch, directions, foci, seen);
                },
            );
            for span in &worker.spans {
                // The radius grows by about half of the path.
                let farther_m = span
                    .ends_s
                    .map(|ends_s| (0.25 * steering.c * (ends_s[1] - ends_s[0])) as f32);
                self.simd_level.run(
                    #[inline(always)]
                    || {
                        steering.focus_all(sines, span.time_s, foci);
                        let of = (&*foci, farther_m);
                        groups.mix(steering, (batch, directions), seen, of, mix);
                    },
                );
                for part in span.parts() {
                    let rows = &worker.directions[part.chunk * chunk_rows..];
                    let mut places = [0.0; CHUNK];
                    span.places(&part, &mut places);
                    let places = span.ends_s.map(|_| &places);
                    let samples = part.samples;
                    sum_directions(
                        self.simd_level,
                        rows,
                        (&*mix, beams),
                        sections,
                        (part.origin, samples, places),
                        #[inline(always)]
                        |i, totals| {
                            let sums = totals
                                .each_ref()
                                .map(|parts| parts.each_ref().map(|part| &part[..samples]));
                            let sums = &sums[..sections.len()];
                            let first = tile.first + part.chunk * CHUNK + part.origin;
                            // SAFETY: the caller guarantees that the samples are this tile's alone.
                            unsafe { finish(batch * BEAMS + i, first, sums, out) };
                        },
                    );
                }
            }
        }
    }

    /// Interpolates a tile for some elements at all fractions: `grid[element][fraction][part][margin + k]` is the row at sample k of the tile
    /// plus the fraction.
    fn interpolate(&self, tile: &Tile, elements: Range<usize>, grid: &mut [f32]) {
        let row = grid_row(self.margin);
        let fractions = self.interpolation.fractions();
        for (i, e) in elements.enumerate() {
            let skipped = self.margin - self.reach[e];
            let used = 2 * self.reach[e] + (tile.end - tile.first).next_multiple_of(STEP);
            let used = used.next_multiple_of(STEP);
            // Rows begin `margin` + TAPS before sample 0.
            let first = tile.first + skipped + TAPS + 1 - self.interpolation.taps / 2;
            let parts = &self.rows[e * 2 * self.row_length..][..2 * self.row_length];
            for (part, from) in parts.chunks_exact(self.row_length).enumerate() {
                let to = &mut grid[(i * fractions * 2 + part) * row + skipped..];
                let interpolation = &self.interpolation;
                convolve(
                    self.simd_level,
                    interpolation,
                    &from[first..],
                    (row, used),
                    to,
                );
            }
        }
    }
}

/// Samples of a span in one chunk of its tile.
struct SpanPart {
    chunk: usize,
    /// First sample in the chunk.
    origin: usize,
    samples: usize,
}

impl Span {
    fn parts(&self) -> impl Iterator<Item = SpanPart> + use<> {
        let Self { mut first, end, .. } = *self;
        std::iter::from_fn(move || {
            let origin = first % CHUNK;
            let part = SpanPart {
                chunk: first / CHUNK,
                origin,
                samples: (CHUNK - origin).min(end.saturating_sub(first)),
            };
            first += part.samples;
            (part.samples > 0).then_some(part)
        })
    }

    /// Places of the samples of a part: -1 for the first of the span, 1 for the last.
    #[inline(always)]
    fn places<'a>(&self, part: &SpanPart, to: &'a mut [f32; CHUNK]) -> &'a [f32] {
        let half = 0.5 * (self.end - self.first - 1).max(1) as f32;
        let before = part.chunk * CHUNK + part.origin - self.first;
        for (k, place) in to.iter_mut().enumerate() {
            *place = (before + k) as f32 / half - 1.0;
        }
        &to[..part.samples]
    }
}

/// The groups that there are: an array is a line or an arc.
fn either<'a>(line: &'a Option<Groups>, arc: &'a Option<ArcGroups>) -> Option<&'a dyn Grouping> {
    let line = line.as_ref().map(|groups| groups as &dyn Grouping);
    line.or(arc.as_ref().map(|groups| groups as &dyn Grouping))
}

/// Change of 1/r that makes an error of the phase at the ends of an aperture of half a length.
fn curvature_of(focus_error_rad: f64, wavelength_m: f64, half_m: f64) -> f64 {
    focus_error_rad * wavelength_m / (PI * half_m * half_m)
}

/// About how many focal zones there are from `near_m` on over `samples` of `step_m`, of which a zone has one at least. Within a zone 1/r changes by
/// `curvature` either way.
fn zones(curvature: f64, near_m: f64, samples: usize, step_m: f64) -> f64 {
    let far_m = samples as f64 * step_m;
    // Nearer than this a zone is shorter than a sample.
    let short_m = (step_m / (2.0 * curvature))
        .sqrt()
        .clamp(near_m, far_m.max(near_m));
    let short = (short_m - near_m) / step_m;
    1.0 + short + (1.0 / short_m - 1.0 / far_m.max(short_m)) / (2.0 * curvature)
}

/// The line as one, or both halves and between them the middle element of an odd number.
fn sections(elements: usize, has_halves: bool) -> Vec<Range<usize>> {
    let half = if has_halves { elements / 2 } else { 0 };
    let parts = [0..half, half..elements - half, elements - half..elements];
    parts.into_iter().filter(|part| !part.is_empty()).collect()
}

/// The smallest and the largest.
fn ends(sines: &[f64]) -> [f64; 2] {
    sines
        .iter()
        .fold([1.0, -1.0], |[a, b], s| [s.min(a), s.max(b)])
}

/// Writes samples of a beam from `first` on: the sum of all sections, and the product of the first with the conjugate of the last.
///
/// # Safety
/// No other thread writes these samples.
#[inline(always)]
unsafe fn finish(beam: usize, first: usize, sums: &[[&[f32]; 2]], out: &Outputs) {
    let samples = first..first + sums[0][0].len();
    if let Some(to) = &out.whole {
        // SAFETY: the caller guarantees that the samples are this thread's alone.
        add_sections(sums, unsafe { to.row(beam, samples.clone()) });
    }
    if let (Some(to), [a, .., b]) = (&out.products, sums) {
        // SAFETY: as above.
        let to = unsafe { to.row(beam, samples) };
        let (a, b) = (a[0].iter().zip(a[1]), b[0].iter().zip(b[1]));
        for ((to, a), b) in to.iter_mut().zip(a).zip(b) {
            *to = Complex32::new(a.0 * b.0 + a.1 * b.1, a.1 * b.0 - a.0 * b.1);
        }
    }
}

#[inline(always)]
fn add_sections(sections: &[[&[f32]; 2]], to: &mut [Complex32]) {
    let number = Complex32::new;
    match sections {
        [[re, im]] => {
            for ((to, re), im) in to.iter_mut().zip(*re).zip(*im) {
                *to = number(*re, *im);
            }
        }
        [[re, im], [more_re, more_im]] => {
            let (re, im) = (re.iter().zip(*more_re), im.iter().zip(*more_im));
            for ((to, re), im) in to.iter_mut().zip(re).zip(im) {
                *to = number(re.0 + re.1, im.0 + im.1);
            }
        }
        _ => {
            for (k, to) in to.iter_mut().enumerate() {
                let sum = |part: usize| sections.iter().map(|section| section[part][k]).sum();
                *to = number(sum(0), sum(1));
            }
        }
    }
}

/// What a former writes.
struct Outputs {
    whole: Option<Columns<Complex32>>,
    products: Option<Columns<Complex32>>,
}

/// The samples of a fan, of which several threads write different ones.
struct Columns<T> {
    start: *mut T,
    beams: usize,
    samples: usize,
}

// SAFETY: threads only reach samples through `row`, whose callers share no sample.
unsafe impl<T: Send> Send for Columns<T> {}
// SAFETY: as above.
unsafe impl<T: Send> Sync for Columns<T> {}

impl<T> Columns<T> {
    /// `rows` holds a row of `samples` for each beam.
    fn new(rows: &mut [T], samples: usize) -> Self {
        Self {
            start: rows.as_mut_ptr(),
            beams: rows.len() / samples,
            samples,
        }
    }

    /// # Safety
    /// The rows outlive the result, and nothing else refers to these samples.
    #[expect(clippy::mut_from_ref, reason = "see the caller's duty")]
    unsafe fn row(&self, beam: usize, samples: Range<usize>) -> &mut [T] {
        assert!(beam < self.beams && samples.start <= samples.end && samples.end <= self.samples);
        // SAFETY: within the rows; the caller guarantees the rest.
        unsafe {
            let start = self.start.add(beam * self.samples + samples.start);
            std::slice::from_raw_parts_mut(start, samples.len())
        }
    }
}

/// Row length of a grid: a tile, margins, and the samples that the kernel may read beyond.
fn grid_row(margin: usize) -> usize {
    (2 * margin + MAX_SAMPLES + 2 * STEP).next_multiple_of(STEP)
}

#[cfg(test)]
mod tests;
