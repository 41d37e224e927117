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
//!   to the whole line. The focus stays at 1.5 a for nearer samples, most of which are received during the pulse.
//!
//! Rows are matched-filtered and summed in f32. Delays use rows at a few fractions of a sample, see [`interpolation`]. Their error affects the
//! envelope only, because carrier phases use the exact delay. A line of many elements with many beams is summed by [`groups`] of elements,
//! with a fourth of the products; other lines and apertures element by element. Work proceeds in tiles of at most
//! [`MAX_SAMPLES`] samples, so that rows and sums stay in the second-level cache, and is split by tile.
//!
//! For bottom detection the line has two sections, its halves. Their sums are two further fans that refer to the whole line's centre, so that
//! they agree in phase on the axis of every beam; the fan of the whole line is their sum.
//!
//! Not modelled in the steering: motion out of the plane of line and boresight, rotation during the echo, and the Doppler stretch (a common
//! range shift through range-Doppler coupling).

mod groups;
mod interpolation;
mod steering;

use std::f64::consts::PI;
use std::ops::Range;

use num_complex::{Complex32, Complex64};
use rayon::prelude::*;

use super::RowLimits;
use super::kernel::{BLOCK, MAX_SAMPLES, STEP, Sums, Taps, add_rows};
use super::steered::SteeredArray;
use super::weights::Taper;
use echotank_config::spec::{FanSpec, Former, Shading};
use echotank_core::arrays::{ArrayGeometry, TransmitArray};
use echotank_core::ping::{BeamFrame, ElementFrame, PingPlan};
use echotank_core::pulse::Pulse;
use echotank_core::simd::SimdLevel;
use groups::{Directions, Groups, band_hz};
use interpolation::{Interpolation, TAPS, convolve};
use steering::{Focus, GridLayout, MIN_DISTANCE_M, Steering};

/// Minimum range of a focus in units of half the aperture in use.
const MIN_FOCUS: f64 = 1.5;
/// Maximum number of sections: two halves, and the middle element of an odd number.
const MAX_SECTIONS: usize = 3;

/// Beams of one receive array.
pub(crate) struct DelaySumFormer {
    steered: SteeredArray<f32>,
    former: Former,
    /// Element positions along the line from its centre, metres.
    x_m: Vec<f32>,
    /// Position of the transmitter relative to the array's centre, along the line and the boresight, metres.
    transmit_m: [f64; 2],
    array_from_body: glam::DQuat,
    taper: Taper,
    f_number: Option<f64>,
    focus_error_rad: f64,
    /// Elements that are summed apart: all, or two halves and between them what is left.
    sections: Vec<Range<usize>>,
    /// Zeros before and after each row, for the reach of delays and filters.
    margin: usize,
    /// Element-major compressed rows with their margins: real parts, imaginary parts.
    rows: Vec<f32>,
    row_length: usize,
    zones: Vec<Zone>,
    /// Element weights of each zone.
    zone_weights: Vec<f32>,
    tiles: Vec<Tile>,
    interpolation: Interpolation,
    groups: Option<Groups>,
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
    /// Inverse sums of the weights of the first and the last section.
    half_scale: [f32; 2],
}

/// Samples that are summed together.
#[derive(Clone, Copy, Debug)]
struct Tile {
    first: usize,
    end: usize,
    /// Two-way time of the focus of groups; element by element where there is none.
    time_s: Option<f64>,
}

struct Worker {
    /// Rows of [`BLOCK`] elements at all fractions: real parts, imaginary parts.
    grid: Vec<f32>,
    /// Sums of each group in each direction: real parts, imaginary parts of a tile.
    directions: Vec<f32>,
    /// Sums of a tile element by element, for each section of each beam.
    tile: Vec<[Sums; MAX_SECTIONS]>,
    /// Focus of each direction of the groups, or of each beam.
    focus: Vec<Focus>,
    /// Focus of each beam in each zone of a tile.
    zone_focus: Vec<Focus>,
    buffer: Vec<Complex32>,
    scratch: Vec<Complex32>,
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
        let end = array.elements;
        // One section without halves, else both halves and a middle element.
        let half = if fan.form.bottom_detection {
            end / 2
        } else {
            0
        };
        let parts = [0..half, half..end - half, end - half..end];
        let sections: Vec<_> = parts.into_iter().filter(|part| !part.is_empty()).collect();
        let steered = SteeredArray::new(array, fan, (limits, 0), pulse, weighting, c);
        let elements = array.elements;
        let half_m = 0.5 * array.spacing_m * (elements - 1) as f64;
        // A platform speed of a tenth of the sound speed lengthens delays by that fraction, and groups reach beyond the outermost beams.
        let reach = 1.4 * half_m / c * limits.sample_rate_hz;
        let margin = reach.ceil() as usize + 3;
        let array_from_body = array.mounting.body_from_array.inverse();
        let transmit_m =
            array_from_body * (transmit.mounting.position_m - array.mounting.position_m);
        let row_length = limits.samples + 2 * (margin + TAPS) + 2 * MAX_SAMPLES;
        let former = fan.form.former;
        let band = match former {
            Former::Phase => 0.0,
            _ => band_hz(pulse) / limits.sample_rate_hz,
        };
        let interpolation = Interpolation::new(former, band);
        let rows = if interpolation.is_linear { 2 } else { 1 };
        // Roll may turn the fan to any direction.
        let sector = match fan.form.roll_stabilised {
            true => [-1.0, 1.0],
            false => ends(&steered.directions.sine),
        };
        let groups = Groups::new(
            &sections,
            array.spacing_m,
            (sector, fan.beams),
            (pulse, limits.sample_rate_hz, c),
            rows,
        );
        let (parts, capacity) = groups
            .as_ref()
            .map_or((0, 0), |groups| (groups.parts.len(), groups.capacity));
        let room = parts * capacity * 2 * MAX_SAMPLES + STEP;
        let zone_room = if parts > 0 {
            fan.beams * MAX_SAMPLES
        } else {
            0
        };
        let grid_room =
            BLOCK.min(elements) * interpolation.fractions() * 2 * grid_row(margin) + STEP;
        let mut former = Self {
            former,
            x_m: (0..elements).map(|e| array.element_x_m(e) as f32).collect(),
            transmit_m: [transmit_m.x, transmit_m.z],
            array_from_body,
            taper: Taper::new(fan.shading),
            f_number: fan.form.f_number,
            focus_error_rad: fan.form.focus_error_rad,
            sections,
            margin,
            rows: vec![0.0; elements * 2 * row_length],
            row_length,
            zones: Vec::with_capacity(limits.samples),
            zone_weights: Vec::new(),
            tiles: Vec::with_capacity(limits.samples),
            interpolation,
            groups,
            directions: None,
            simd_level: SimdLevel::best(),
            workers: (0..rayon::current_num_threads().max(1))
                .map(|_| Worker {
                    grid: vec![0.0; grid_room],
                    directions: vec![0.0; room],
                    tile: (0..fan.beams).map(|_| [Sums::ZERO; MAX_SECTIONS]).collect(),
                    focus: vec![Focus::default(); fan.beams.max(capacity)],
                    zone_focus: Vec::with_capacity(zone_room),
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

    /// Index of the fan's receive array.
    pub(crate) fn array(&self) -> usize {
        self.steered.array()
    }

    /// Forms the beams of one ping. `frame` holds the samples of the fan's array; `out` grows once to its maximum size and is reused.
    pub(crate) fn form(&mut self, plan: &PingPlan, frame: &ElementFrame, out: &mut BeamFrame) {
        self.steered.begin(plan, frame, out);
        self.form_into(plan, frame, [Some(out), None, None]);
    }

    /// Forms the beams of the half at the array's -x end and of that at its +x end, and those of the whole line in `whole`.
    pub(crate) fn form_with_halves(
        &mut self,
        plan: &PingPlan,
        frame: &ElementFrame,
        whole: Option<&mut BeamFrame>,
        halves: &mut [BeamFrame; 2],
    ) {
        let [first, second] = halves;
        self.steered.begin(plan, frame, first);
        self.steered.size(frame.samples, second);
        let mut whole = whole;
        if let Some(whole) = &mut whole {
            self.steered.size(frame.samples, whole);
        }
        self.form_into(plan, frame, [whole, Some(first), Some(second)]);
    }

    fn form_into(
        &mut self,
        plan: &PingPlan,
        frame: &ElementFrame,
        out: [Option<&mut BeamFrame>; 3],
    ) {
        if frame.samples == 0 {
            return;
        }
        self.make_zones(frame.samples, plan.first_sample_s);
        self.weigh_zones();
        self.aim_groups();
        self.make_tiles(frame.samples, plan.first_sample_s);
        self.compress(frame);
        self.sum(plan, out);
    }

    /// Half the aperture in use at a range, metres.
    fn half_aperture_m(&self, range_m: f64) -> f64 {
        let whole = 0.5 * self.steered.spacing_m() * self.x_m.len() as f64;
        match self.f_number {
            Some(f) => whole.min(0.5 * range_m / f),
            None => whole,
        }
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
        let zone = |first: usize, end: usize, time_s: f64| Zone {
            first,
            end,
            time_s,
            half_scale: [1.0; 2],
        };
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
            if near_m < MIN_FOCUS * half_m {
                let min_m = MIN_FOCUS * self.half_aperture_m(f64::INFINITY);
                let end = self.end_of_range(min_m, first_sample_s);
                let end = end.clamp((first + 1) as f64, samples as f64) as usize;
                self.zones.push(zone(first, end, 2.0 * min_m / c));
                first = end;
                continue;
            }
            // Permitted change of 1/r from a zone's middle to its ends.
            let curvature =
                self.focus_error_rad * self.steered.wavelength_m() / (PI * half_m * half_m);
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
            let weights = &self.zone_weights[start..start + elements];
            let halves = [self.sections.first(), self.sections.last()];
            self.zones[z].half_scale = halves.map(|section| {
                let sum: f32 = section.map_or(0.0, |part| weights[part.clone()].iter().sum());
                if sum > 0.0 { 1.0 / sum } else { 0.0 }
            });
        }
    }

    /// Directions of the groups for the fan of this ping, if there is room for them.
    fn aim_groups(&mut self) {
        self.directions = self.groups.as_ref().and_then(|groups| {
            let pulse = self.steered.correlator.pulse();
            let sector = ends(&self.steered.directions.sine);
            let c = self.steered.sound_speed_m_per_s;
            let directions = groups.directions(sector, pulse, band_hz(pulse), c);
            (directions.count <= groups.capacity).then_some(directions)
        });
    }

    fn make_tiles(&mut self, samples: usize, first_sample_s: f64) {
        self.tiles.clear();
        let c = self.steered.sound_speed_m_per_s;
        let is_focused = self.former == Former::DynamicFocus;
        let min_focus_m = MIN_FOCUS * self.half_aperture_m(f64::INFINITY);
        let mut first = 0;
        while first < samples {
            let mut tile = Tile {
                first,
                end: (first + MAX_SAMPLES).min(samples),
                time_s: None,
            };
            let groups = self.groups.as_ref().filter(|_| self.directions.is_some());
            if let Some(groups) = groups {
                let near_m = self.range_m(first, first_sample_s);
                let (far_m, serve) = if !is_focused {
                    (f64::INFINITY, true)
                } else if near_m < min_focus_m || !self.uses_whole_line(near_m) {
                    (min_focus_m.max(1.05 * near_m), false)
                } else {
                    let curvature = groups.max_curvature_per_m(self.steered.correlator.pulse(), c);
                    let far = 1.0 / near_m - 2.0 * curvature;
                    (if far > 0.0 { 1.0 / far } else { f64::INFINITY }, true)
                };
                tile.end = self
                    .end_of_range(far_m, first_sample_s)
                    .clamp((first + 1) as f64, tile.end as f64) as usize;
                let far_m = self.range_m(tile.end - 1, first_sample_s);
                let middle = 0.5 * (1.0 / near_m + 1.0 / far_m);
                tile.time_s = serve.then_some(2.0 / (c * middle));
            }
            first = tile.end;
            self.tiles.push(tile);
        }
    }

    /// Matched-filters every element into its row.
    fn compress(&mut self, frame: &ElementFrame) {
        let (correlator, row_length) = (&self.steered.correlator, self.row_length);
        let before = self.margin + TAPS;
        let share = self.x_m.len().div_ceil(self.workers.len());
        self.rows
            .par_chunks_mut(share * 2 * row_length)
            .zip(&mut self.workers)
            .enumerate()
            .for_each(|(w, (rows, worker))| {
                for (i, row) in rows.chunks_exact_mut(2 * row_length).enumerate() {
                    let (head, tail) = worker.buffer.split_at_mut(frame.samples);
                    for (to, x) in head.iter_mut().zip(frame.element(w * share + i)) {
                        *to = Complex32::new(x.re as f32, x.im as f32);
                    }
                    tail.fill(Complex32::ZERO);
                    correlator.forward(&mut worker.buffer, &mut worker.scratch);
                    correlator.inverse(&mut worker.buffer, &mut worker.scratch);
                    let (re, im) = row.split_at_mut(row_length);
                    re[before + frame.samples..].fill(0.0);
                    im[before + frame.samples..].fill(0.0);
                    for (k, y) in worker.buffer[..frame.samples].iter().enumerate() {
                        re[before + k] = y.re;
                        im[before + k] = y.im;
                    }
                }
            });
    }

    fn sum(&mut self, plan: &PingPlan, out: [Option<&mut BeamFrame>; 3]) {
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
        let out = out.map(|frame| frame.map(Columns::new));
        let mut workers = std::mem::take(&mut self.workers);
        let this = &*self;
        let stride = workers.len();
        workers.par_iter_mut().enumerate().for_each(|(w, worker)| {
            for tile in this.tiles.iter().skip(w).step_by(stride) {
                // SAFETY: each tile has samples of its own, and one worker.
                unsafe {
                    match tile.time_s {
                        Some(time_s) => this.sum_groups(&steering, tile, time_s, worker, &out),
                        None => this.sum_elements(&steering, tile, worker, &out),
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
        out: &[Option<Columns>; 3],
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
                    let sines = &self.steered.directions.sine;
                    self.simd_level.run(
                        #[inline(always)]
                        || {
                            for (focus, sine) in worker.focus.iter_mut().zip(sines) {
                                *focus = steering.focus(*sine, zone.time_s);
                            }
                        },
                    );
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
        let scale = self.half_scales(tile);
        for (beam, sums) in worker.tile.iter().enumerate() {
            // SAFETY: the caller guarantees that the samples are this tile's alone.
            unsafe { self.finish(beam, tile, sums, &scale, out) };
        }
    }

    /// Sums a tile group by group and writes it.
    ///
    /// # Safety
    /// As of [`DelaySumFormer::sum_elements`].
    unsafe fn sum_groups(
        &self,
        steering: &Steering,
        tile: &Tile,
        time_s: f64,
        worker: &mut Worker,
        out: &[Option<Columns>; 3],
    ) {
        let (Some(groups), Some(directions)) = (&self.groups, &self.directions) else {
            unreachable!("tiles without groups have no focus of groups");
        };
        let samples = tile.end - tile.first;
        let row = grid_row(self.margin);
        let layout = GridLayout {
            row,
            origin: self.margin,
        };
        self.simd_level.run(
            #[inline(always)]
            || {
                for (j, focus) in worker.focus[..directions.count].iter_mut().enumerate() {
                    *focus = steering.focus(directions.sine(j), time_s);
                }
            },
        );
        let mut taps = Taps::NONE;
        let mut to = worker.directions.chunks_exact_mut(2 * MAX_SAMPLES);
        for (part, x_group) in groups.parts.iter().zip(&groups.x_m) {
            self.interpolate(tile, part.clone(), &mut worker.grid);
            let x_m = &self.x_m[part.clone()];
            // The weights of the whole line in f32, as of every zone of such a tile.
            let z = self.zones.partition_point(|zone| zone.end <= tile.first);
            let weights = &self.zone_weights[z * self.x_m.len()..][part.clone()];
            for (focus, sums) in worker.focus[..directions.count].iter().zip(&mut to) {
                let (interpolation, to_sum) = (&self.interpolation, (x_m, weights));
                self.simd_level.run(
                    #[inline(always)]
                    || {
                        let reference_m = steering.late_m(focus, *x_group);
                        steering.steer(
                            focus,
                            to_sum,
                            reference_m,
                            interpolation,
                            layout,
                            &mut taps,
                        );
                    },
                );
                let (re, im) = sums.split_at_mut(MAX_SAMPLES);
                let mut sums = [&mut re[..samples], &mut im[..samples]];
                for part in &mut sums {
                    part.fill(0.0);
                }
                add_rows(self.simd_level, &worker.grid, row, &taps, sums);
            }
        }
        // The focus of each beam at the range of the tile, then in each zone.
        let sines = &self.steered.directions.sine;
        let beams = sines.len();
        self.simd_level.run(
            #[inline(always)]
            || {
                for (focus, sine) in worker.focus.iter_mut().zip(sines) {
                    *focus = steering.focus(*sine, time_s);
                }
            },
        );
        worker.zone_focus.clear();
        for (z, (_, zone)) in self.zones_of(tile).enumerate() {
            worker.zone_focus.resize((z + 1) * beams, Focus::default());
            self.simd_level.run(
                #[inline(always)]
                || {
                    for (focus, sine) in worker.zone_focus[z * beams..].iter_mut().zip(sines) {
                        *focus = steering.focus(*sine, zone.time_s);
                    }
                },
            );
        }
        let scale = self.half_scales(tile);
        let mut taps = [Taps::NONE; MAX_SECTIONS];
        let mut totals = [Sums::ZERO; MAX_SECTIONS];
        for (beam, sine) in sines.iter().enumerate() {
            let seen = self.simd_level.run(
                #[inline(always)]
                || groups.seen(directions, *sine, &worker.focus[beam]),
            );
            for total in totals[..self.sections.len()].iter_mut() {
                for part in total.part(0..samples) {
                    part.fill(0.0);
                }
            }
            for (z, (_, zone)) in self.zones_of(tile).enumerate() {
                let from = zone.first.max(tile.first) - tile.first;
                let range = from..zone.end.min(tile.end) - tile.first;
                let focus = &worker.zone_focus[z * beams + beam];
                self.simd_level.run(
                    #[inline(always)]
                    || groups.mix(steering, directions, &seen, focus, from, &mut taps),
                );
                for (taps, total) in taps[..self.sections.len()].iter().zip(&mut totals) {
                    let (rows, total) = (&worker.directions, total.part(range.clone()));
                    add_rows(self.simd_level, rows, MAX_SAMPLES, taps, total);
                }
            }
            // SAFETY: the caller guarantees that the samples are this tile's alone.
            unsafe { self.finish(beam, tile, &totals, &scale, out) };
        }
    }

    /// Inverse sums of the weights of the halves, for each sample of a tile.
    fn half_scales(&self, tile: &Tile) -> [[f32; MAX_SAMPLES]; 2] {
        let mut scale = [[0.0f32; MAX_SAMPLES]; 2];
        for (_, zone) in self.zones_of(tile) {
            let range =
                zone.first.max(tile.first) - tile.first..zone.end.min(tile.end) - tile.first;
            for (scale, of_zone) in scale.iter_mut().zip(zone.half_scale) {
                scale[range.clone()].fill(of_zone);
            }
        }
        scale
    }

    /// Writes a beam of a tile: of the whole line, of its first and of its last section.
    ///
    /// # Safety
    /// As of [`DelaySumFormer::sum_elements`].
    unsafe fn finish(
        &self,
        beam: usize,
        tile: &Tile,
        sums: &[Sums; MAX_SECTIONS],
        scale: &[[f32; MAX_SAMPLES]; 2],
        out: &[Option<Columns>; 3],
    ) {
        let last = self.sections.len() - 1;
        let [whole, halves @ ..] = out;
        if let Some(to) = whole {
            // SAFETY: the caller guarantees that the samples are this tile's alone.
            let to = unsafe { to.row(beam, tile) };
            self.simd_level.run(
                #[inline(always)]
                || add_sections(&sums[..=last], to),
            );
        }
        for ((to, sums), scale) in halves.iter().zip([&sums[0], &sums[last]]).zip(scale) {
            let Some(to) = to else {
                continue;
            };
            // SAFETY: as above.
            let to = unsafe { to.row(beam, tile) };
            self.simd_level.run(
                #[inline(always)]
                || {
                    for (k, to) in to.iter_mut().enumerate() {
                        let (re, im) = (sums.re[k] * scale[k], sums.im[k] * scale[k]);
                        *to = Complex64::new(f64::from(re), f64::from(im));
                    }
                },
            );
        }
    }

    /// Interpolates a tile for some elements at all fractions: `grid[element][fraction][part][margin + k]` is the row at sample k of the tile
    /// plus the fraction.
    fn interpolate(&self, tile: &Tile, elements: Range<usize>, grid: &mut [f32]) {
        let row = grid_row(self.margin);
        let used = 2 * self.margin + (tile.end - tile.first).next_multiple_of(STEP);
        let used = used.next_multiple_of(STEP);
        // Row index of the grid's first sample: `margin` before the tile, in rows that begin `margin` + TAPS before sample 0.
        let first = tile.first + TAPS;
        let fractions = self.interpolation.fractions();
        for (i, e) in elements.enumerate() {
            let parts = &self.rows[e * 2 * self.row_length..][..2 * self.row_length];
            for (part, from) in parts.chunks_exact(self.row_length).enumerate() {
                let to = &mut grid[(i * fractions * 2 + part) * row..];
                let from = &from[first + 1 - TAPS / 2..];
                let filters = &self.interpolation.filters;
                convolve(self.simd_level, filters, from, (row, used), to);
            }
        }
    }
}

/// The smallest and the largest.
fn ends(sines: &[f64]) -> [f64; 2] {
    sines
        .iter()
        .fold([1.0, -1.0], |[a, b], s| [s.min(a), s.max(b)])
}

#[inline(always)]
fn add_sections(sections: &[Sums], to: &mut [Complex64]) {
    match sections {
        [all] => {
            for (k, to) in to.iter_mut().enumerate() {
                *to = Complex64::new(f64::from(all.re[k]), f64::from(all.im[k]));
            }
        }
        [first, rest @ ..] => {
            for (k, to) in to.iter_mut().enumerate() {
                let (mut re, mut im) = (first.re[k], first.im[k]);
                for more in rest {
                    re += more.re[k];
                    im += more.im[k];
                }
                *to = Complex64::new(f64::from(re), f64::from(im));
            }
        }
        [] => {}
    }
}

/// The samples of a fan, of which several threads write different ones.
struct Columns {
    start: *mut Complex64,
    beams: usize,
    samples: usize,
}

// SAFETY: threads only reach samples through `row`, whose callers share no sample.
unsafe impl Send for Columns {}
// SAFETY: as above.
unsafe impl Sync for Columns {}

impl Columns {
    fn new(frame: &mut BeamFrame) -> Self {
        assert_eq!(frame.iq.len(), frame.beams * frame.samples);
        Self {
            start: frame.iq.as_mut_ptr(),
            beams: frame.beams,
            samples: frame.samples,
        }
    }

    /// # Safety
    /// The frame outlives the result, and nothing else refers to these samples.
    #[expect(clippy::mut_from_ref, reason = "see the caller's duty")]
    unsafe fn row(&self, beam: usize, tile: &Tile) -> &mut [Complex64] {
        assert!(beam < self.beams && tile.first <= tile.end && tile.end <= self.samples);
        // SAFETY: within the frame; the caller guarantees the rest.
        unsafe {
            let start = self.start.add(beam * self.samples + tile.first);
            std::slice::from_raw_parts_mut(start, tile.end - tile.first)
        }
    }
}

/// Row length of a grid: a tile, margins, and the samples that the kernel may read beyond.
fn grid_row(margin: usize) -> usize {
    (2 * margin + MAX_SAMPLES + STEP).next_multiple_of(STEP)
}

#[cfg(test)]
mod tests;
