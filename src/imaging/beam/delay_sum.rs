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
//!   to the whole line.
//!
//! Rows are matched-filtered in f64, then summed in f32. Delays use the nearest of [`FRACTIONS`] interpolated rows. The remaining delay, at
//! most 1/32 of a sample, affects the envelope only, because carrier phases use the exact delay. Work proceeds in tiles of [`MAX_SAMPLES`]
//! samples, so that rows and sums stay in the second-level cache, and is split by beam.
//!
//! Not modelled in the steering: motion out of the plane of line and boresight, rotation during the echo, and the Doppler stretch (a common
//! range shift through range-Doppler coupling).

use std::f64::consts::PI;

use num_complex::Complex64;
use rayon::prelude::*;

use super::RowLimits;
use super::kernel::{BLOCK, MAX_SAMPLES, STEP, Sums, Taps, add_rows};
use super::steered::SteeredArray;
use super::weights::Taper;
use echotank_config::spec::{FanSpec, Former, Shading};
use echotank_core::arrays::{ArrayGeometry, TransmitArray};
use echotank_core::ping::{BeamFrame, ElementFrame, PingPlan};
use echotank_core::pulse::Pulse;
use echotank_core::simd::{Kind, SimdLevel};

/// Number of interpolated rows per sample.
pub(crate) const FRACTIONS: usize = 16;
/// Length of the interpolation filters. They reject 50 dB from 0.4 to 0.6 of the sample rate, the margin that the checked sample rate
/// leaves.
const TAPS: usize = 16;
const INTERPOLATION: Shading = Shading::Kaiser { beta: 4.6 };
/// Minimum distance of a focal point, metres: keeps delays finite on the line itself.
const MIN_DISTANCE_M: f64 = 1e-3;

/// Beams of one receive array.
pub struct DelaySumFormer {
    steered: SteeredArray,
    former: Former,
    /// Element positions along the line from its centre, metres.
    x_m: Vec<f32>,
    /// Position of the transmitter relative to the array's centre, along the line and the boresight, metres.
    transmit_m: [f64; 2],
    array_from_body: glam::DQuat,
    taper: Taper,
    f_number: Option<f64>,
    focus_error_rad: f64,
    /// Elements in use.
    part: std::ops::Range<usize>,
    /// Zeros before and after each row, for the reach of delays and filters.
    margin: usize,
    /// Element-major compressed rows with their margins: real parts, imaginary parts.
    rows: Vec<f32>,
    row_length: usize,
    zones: Vec<Zone>,
    /// Element weights of each zone.
    zone_weights: Vec<f32>,
    filters: [[f32; TAPS]; FRACTIONS],
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

struct Worker {
    /// Rows of [`BLOCK`] elements with [`FRACTIONS`] each: real parts, imaginary parts.
    grid: Vec<f32>,
    /// Real and imaginary sums of a tile, for each beam.
    tile: Vec<Sums>,
    /// Focus of each of the tile's zones, for each beam.
    focus: Vec<Focus>,
    buffer: Vec<Complex64>,
    scratch: Vec<Complex64>,
}

impl DelaySumFormer {
    /// `array` is the receive array that `fan` names, `transmit` its transmitter. Work is shared among the threads of the current pool.
    ///
    /// Panics on a fan without beams, an array without elements or a pulse beyond `limits`; a checked configuration prevents these.
    pub fn new(
        array: &ArrayGeometry,
        transmit: &TransmitArray,
        fan: &FanSpec,
        limits: RowLimits,
        pulse: &Pulse,
        weighting: Shading,
        sound_speed_m_per_s: f64,
    ) -> Self {
        let steered = SteeredArray::new(
            array,
            fan,
            (limits, 0),
            pulse,
            weighting,
            sound_speed_m_per_s,
        );
        let elements = array.elements;
        let half_m = 0.5 * array.spacing_m * (elements - 1) as f64;
        // A platform speed of a tenth of the sound speed lengthens delays by that fraction.
        let reach = 1.2 * half_m / sound_speed_m_per_s * limits.sample_rate_hz;
        let margin = reach.ceil() as usize + 2;
        let array_from_body = array.mounting.body_from_array.inverse();
        let transmit_m =
            array_from_body * (transmit.mounting.position_m - array.mounting.position_m);
        let row_length = limits.samples + 2 * (margin + TAPS) + 2 * MAX_SAMPLES;
        let workers = rayon::current_num_threads().clamp(1, fan.beams);
        let share = fan.beams.div_ceil(workers);
        let grid_row = grid_row(margin);
        let mut former = Self {
            former: fan.form.former,
            x_m: (0..elements).map(|e| array.element_x_m(e) as f32).collect(),
            transmit_m: [transmit_m.x, transmit_m.z],
            array_from_body,
            taper: Taper::new(fan.shading),
            f_number: fan.form.f_number,
            focus_error_rad: fan.form.focus_error_rad,
            part: 0..elements,
            margin,
            rows: vec![0.0; elements * 2 * row_length],
            row_length,
            zones: Vec::with_capacity(limits.samples),
            zone_weights: Vec::new(),
            filters: interpolating_filters(),
            simd_level: SimdLevel::best(),
            workers: (0..workers)
                .map(|_| Worker {
                    grid: vec![0.0; BLOCK.min(elements) * FRACTIONS * 2 * grid_row],
                    tile: (0..share).map(|_| Sums::ZERO).collect(),
                    focus: vec![Focus::default(); share * MAX_SAMPLES],
                    buffer: vec![Complex64::ZERO; steered.correlator.length()],
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

    /// Uses these elements only. Delays still refer to the whole line's centre.
    pub(crate) fn with_part(mut self, part: std::ops::Range<usize>) -> Self {
        self.steered.select_elements(&part);
        self.part = part;
        self
    }

    /// Index of the fan's receive array.
    pub fn array(&self) -> usize {
        self.steered.array()
    }

    /// Forms the beams of one ping. `frame` holds the samples of the fan's array; `out` grows once to its maximum size and is reused.
    pub fn form(&mut self, plan: &PingPlan, frame: &ElementFrame, out: &mut BeamFrame) {
        self.steered.begin(plan, frame, out);
        if frame.samples == 0 {
            return;
        }
        self.make_zones(frame.samples, plan.first_sample_s);
        self.weigh_zones();
        self.compress(frame);
        self.sum(plan, frame.samples, &mut out.iq);
    }

    /// Half the aperture in use at a range, metres.
    fn half_aperture_m(&self, range_m: f64) -> f64 {
        let whole = 0.5 * self.steered.spacing_m() * self.x_m.len() as f64;
        match self.f_number {
            Some(f) => whole.min(0.5 * range_m / f),
            None => whole,
        }
    }

    fn make_zones(&mut self, samples: usize, first_sample_s: f64) {
        self.zones.clear();
        let rate_hz = self.steered.correlator.limits().sample_rate_hz;
        let time_s = |k: usize| first_sample_s + k as f64 / rate_hz;
        let range_m = |k: usize, c: f64| (0.5 * c * time_s(k)).max(MIN_DISTANCE_M);
        if self.former != Former::DynamicFocus {
            self.zones.push(Zone {
                first: 0,
                end: samples,
                time_s: time_s(samples),
            });
            return;
        }
        let c = self.steered.sound_speed_m_per_s;
        let mut first = 0;
        while first < samples {
            let near_m = range_m(first, c);
            let half_m = self.half_aperture_m(near_m);
            // Permitted change of 1/r from a zone's middle to its ends.
            let bend = self.focus_error_rad * self.steered.wavelength_m() / (PI * half_m * half_m);
            let far = 1.0 / near_m - 2.0 * bend;
            // An aperture that grows with range is adapted in steps of 5 %.
            let max_m = match half_m < self.half_aperture_m(f64::INFINITY) {
                true => 1.05 * near_m,
                false => f64::INFINITY,
            };
            let far_m = if far > 0.0 {
                (1.0 / far).min(max_m)
            } else {
                max_m
            };
            let last = (2.0 * far_m / c - first_sample_s) * rate_hz;
            let end = (last.min(samples as f64) as usize + 1).clamp(first + 1, samples);
            let middle = 0.5 * (1.0 / near_m + 1.0 / range_m(end - 1, c));
            self.zones.push(Zone {
                first,
                end,
                time_s: 2.0 / (c * middle),
            });
            first = end;
        }
    }

    fn weigh_zones(&mut self) {
        let elements = self.x_m.len();
        self.zone_weights.clear();
        for z in 0..self.zones.len() {
            let range_m = 0.5 * self.steered.sound_speed_m_per_s * self.zones[z].time_s;
            let half_m = self.half_aperture_m(range_m);
            let start = self.zone_weights.len();
            if half_m >= self.half_aperture_m(f64::INFINITY) {
                self.zone_weights
                    .extend(self.steered.weights.iter().map(|w| *w as f32));
                continue;
            }
            // At least the middle of the line is in use.
            let half_m = half_m.max(0.5 * self.steered.spacing_m()) as f32;
            let taper = &self.taper;
            let part = &self.part;
            self.zone_weights
                .extend(self.x_m.iter().enumerate().map(|(e, x)| {
                    match part.contains(&e) && x.abs() <= half_m {
                        true => taper.at(f64::from(0.5 * x / half_m)) as f32,
                        false => 0.0,
                    }
                }));
            let sum: f32 = self.zone_weights[start..start + elements].iter().sum();
            for w in &mut self.zone_weights[start..start + elements] {
                *w /= sum;
            }
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
                    head.copy_from_slice(frame.element(w * share + i));
                    tail.fill(Complex64::ZERO);
                    correlator.forward(&mut worker.buffer, &mut worker.scratch);
                    correlator.inverse(&mut worker.buffer, &mut worker.scratch);
                    let (re, im) = row.split_at_mut(row_length);
                    re[before + frame.samples..].fill(0.0);
                    im[before + frame.samples..].fill(0.0);
                    for (k, y) in worker.buffer[..frame.samples].iter().enumerate() {
                        re[before + k] = y.re as f32;
                        im[before + k] = y.im as f32;
                    }
                }
            });
    }

    fn sum(&mut self, plan: &PingPlan, samples: usize, out: &mut [Complex64]) {
        let share = self
            .steered
            .directions
            .sine
            .len()
            .div_ceil(self.workers.len());
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
        out.par_chunks_mut(share * samples)
            .zip(this.steered.directions.sine.par_chunks(share))
            .zip(&mut workers)
            .for_each(|((rows, sines), worker)| {
                this.sum_beams(&steering, sines, samples, worker, rows);
            });
        self.workers = workers;
    }

    /// Sums some of the beams, tile by tile.
    fn sum_beams(
        &self,
        steering: &Steering,
        sines: &[f64],
        samples: usize,
        worker: &mut Worker,
        out: &mut [Complex64],
    ) {
        let elements = self.x_m.len();
        let mut first_zone = 0;
        for tile in (0..samples).step_by(MAX_SAMPLES) {
            let tile_end = (tile + MAX_SAMPLES).min(samples);
            while self.zones[first_zone].end <= tile {
                first_zone += 1;
            }
            let last_zone = first_zone
                + self.zones[first_zone..]
                    .iter()
                    .take_while(|z| z.first < tile_end)
                    .count();
            for sums in &mut worker.tile[..sines.len()] {
                *sums = Sums::ZERO;
            }
            let zones = &self.zones[first_zone..last_zone];
            for (zone, focus) in zones.iter().zip(worker.focus.chunks_mut(sines.len())) {
                for (focus, sine) in focus.iter_mut().zip(sines) {
                    *focus = steering.focus(*sine, zone.time_s);
                }
            }
            for block in self.part.clone().step_by(BLOCK) {
                let block_end = (block + BLOCK).min(self.part.end);
                self.interpolate(tile, block..block_end, &mut worker.grid);
                for (z, zone) in zones.iter().enumerate() {
                    let (from, to) = (zone.first.max(tile), zone.end.min(tile_end));
                    let weights =
                        &self.zone_weights[(first_zone + z) * elements..][block..block_end];
                    let row = grid_row(self.margin);
                    let origin = self.margin + from - tile;
                    let layout = GridLayout { row, origin };
                    let x_m = &self.x_m[block..block_end];
                    let focus = &worker.focus[z * sines.len()..];
                    let mut taps = Taps::NONE;
                    for (focus, total) in focus.iter().zip(&mut worker.tile[..sines.len()]) {
                        self.simd_level.run(
                            #[inline(always)]
                            || steering.steer(focus, x_m, weights, layout, &mut taps),
                        );
                        let (grid, count) = (&worker.grid, to - from);
                        add_rows(self.simd_level, grid, row, &taps, from - tile, count, total);
                    }
                }
            }
            for (row, sums) in out.chunks_exact_mut(samples).zip(&worker.tile) {
                for (k, y) in row[tile..tile_end].iter_mut().enumerate() {
                    *y = Complex64::new(f64::from(sums.re[k]), f64::from(sums.im[k]));
                }
            }
        }
    }

    /// Interpolates the tile at sample `tile` for some elements and all fractions: `grid[element][fraction][part][margin + k]` is the row
    /// at tile + k + fraction / [`FRACTIONS`].
    fn interpolate(&self, tile: usize, elements: std::ops::Range<usize>, grid: &mut [f32]) {
        let row = grid_row(self.margin);
        // Row index of the grid's first sample: `margin` before the tile, in rows that begin `margin` + TAPS before sample 0.
        let first = tile + TAPS;
        for (i, e) in elements.enumerate() {
            let parts = &self.rows[e * 2 * self.row_length..][..2 * self.row_length];
            for (part, from) in parts.chunks_exact(self.row_length).enumerate() {
                let to = &mut grid[(i * FRACTIONS * 2 + part) * row..];
                let from = &from[first + 1 - TAPS / 2..];
                convolve(self.simd_level, &self.filters, from, row, to);
            }
        }
    }
}

/// Row length of a grid: a tile, margins, and the samples that the kernel may read beyond.
fn grid_row(margin: usize) -> usize {
    (2 * margin + MAX_SAMPLES + STEP).next_multiple_of(STEP)
}

/// Windowed sincs for 0, 1/16, ..., 15/16 of a sample, each with unit response at the middle of the band.
fn interpolating_filters() -> [[f32; TAPS]; FRACTIONS] {
    let taper = Taper::new(INTERPOLATION);
    std::array::from_fn(|q| {
        let fraction = q as f64 / FRACTIONS as f64;
        let raw: [f64; TAPS] = std::array::from_fn(|i| {
            let x = i as f64 - (TAPS / 2 - 1) as f64 - fraction;
            let sinc = if x.abs() < 1e-12 {
                1.0
            } else {
                (PI * x).sin() / (PI * x)
            };
            sinc * taper.at(x / TAPS as f64)
        });
        let sum: f64 = raw.iter().sum();
        raw.map(|w| (w / sum) as f32)
    })
}

/// Computes one row per fraction q: `to[2 q row + k] = sum_i filters[q][i] from[k + i]` for k below `row`; zero beyond the end of `from`.
fn convolve(
    simd_level: SimdLevel,
    filters: &[[f32; TAPS]; FRACTIONS],
    from: &[f32],
    row: usize,
    to: &mut [f32],
) {
    assert!(to.len() >= (2 * FRACTIONS - 1) * row);
    // Beyond its margin a row is zero.
    let filled = row.min((from.len() + 1).saturating_sub(TAPS));
    match simd_level.kind() {
        #[cfg(target_arch = "x86_64")]
        // SAFETY: a `SimdLevel` proves that the processor has the features. `filled` samples plus the filters' length lie in `from`, and
        // every fraction's row lies in `to`.
        Kind::Avx512 => unsafe { convolve_avx512(filters, from, row, filled, to) },
        _ => simd_level.run(
            #[inline(always)]
            || convolve_plain(filters, from, row, filled, to),
        ),
    }
}

/// Processes sixteen samples of all fractions at once; the inputs stay in registers.
///
/// # Safety
/// The processor has AVX-512F. `from` holds `filled` + TAPS - 1 samples, `filled` is at most `row`, and `to` holds every fraction's row.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512vl")]
unsafe fn convolve_avx512(
    filters: &[[f32; TAPS]; FRACTIONS],
    from: &[f32],
    row: usize,
    filled: usize,
    to: &mut [f32],
) {
    use std::arch::x86_64::*;
    const LANES: usize = 16;
    let whole = filled / LANES * LANES;
    for first in (0..whole).step_by(LANES) {
        let mut x = [_mm512_setzero_ps(); TAPS];
        for (i, x) in x.iter_mut().enumerate() {
            // SAFETY: first + LANES + TAPS - 1 samples lie in `from`.
            *x = unsafe { _mm512_loadu_ps(from.as_ptr().add(first + i)) };
        }
        for (q, filter) in filters.iter().enumerate() {
            // Two accumulator chains, so that neither waits for the other's last product.
            let (mut even, mut odd) = (_mm512_setzero_ps(), _mm512_setzero_ps());
            for i in (0..TAPS).step_by(2) {
                even = _mm512_fmadd_ps(_mm512_set1_ps(filter[i]), x[i], even);
                odd = _mm512_fmadd_ps(_mm512_set1_ps(filter[i + 1]), x[i + 1], odd);
            }
            // SAFETY: the fraction's row lies in `to`.
            unsafe {
                _mm512_storeu_ps(
                    to.as_mut_ptr().add(2 * q * row + first),
                    _mm512_add_ps(even, odd),
                );
            }
        }
    }
    finish_rows(filters, from, row, whole..filled, to);
}

#[inline(always)]
fn convolve_plain(
    filters: &[[f32; TAPS]; FRACTIONS],
    from: &[f32],
    row: usize,
    filled: usize,
    to: &mut [f32],
) {
    const LANES: usize = 32;
    let whole = filled / LANES * LANES;
    for (q, filter) in filters.iter().enumerate() {
        for first in (0..whole).step_by(LANES) {
            let from = &from[first..first + LANES + TAPS - 1];
            let mut sum = [0.0f32; LANES];
            for (i, w) in filter.iter().enumerate() {
                let from: &[f32; LANES] = from[i..i + LANES].try_into().expect("as long");
                for k in 0..LANES {
                    sum[k] += w * from[k];
                }
            }
            to[2 * q * row + first..][..LANES].copy_from_slice(&sum);
        }
    }
    finish_rows(filters, from, row, whole..filled, to);
}

/// Computes the samples that do not fill a vector, and the zeros after them.
fn finish_rows(
    filters: &[[f32; TAPS]; FRACTIONS],
    from: &[f32],
    row: usize,
    rest: std::ops::Range<usize>,
    to: &mut [f32],
) {
    for (q, filter) in filters.iter().enumerate() {
        let to = &mut to[2 * q * row..][..row];
        for k in rest.clone() {
            to[k] = filter.iter().zip(&from[k..]).map(|(w, x)| w * x).sum();
        }
        to[rest.end..].fill(0.0);
    }
}

/// Layout of a tap's rows in the grid.
#[derive(Clone, Copy)]
struct GridLayout {
    row: usize,
    /// Offset of the first sample to sum.
    origin: usize,
}

/// Steering of the beams of one ping; pairs are components along the line and along the boresight.
struct Steering {
    former: Former,
    transmit_m: [f64; 2],
    velocity_m_per_s: [f64; 2],
    c: f64,
    carrier_hz: f64,
    rate_hz: f64,
}

/// Focus of one beam: d = S - v t from the array's centre at reception.
#[derive(Clone, Copy, Debug, Default)]
struct Focus {
    d_m: [f32; 2],
    /// |d|.
    range_m: f32,
    sine: f32,
}

impl Steering {
    /// The point in focus of a beam at `time_s`.
    fn focus(&self, sine: f64, time_s: f64) -> Focus {
        if self.former != Former::DynamicFocus {
            return Focus {
                d_m: [0.0; 2],
                range_m: 0.0,
                sine: sine as f32,
            };
        }
        let toward = [sine, (1.0 - sine * sine).max(0.0).sqrt()];
        let [vx, vz] = self.velocity_m_per_s;
        let (moved_x, moved_z) = (vx * time_s, vz * time_s);
        let path_m = self.c * time_s;
        // Newton's method on |S - p_T| + |S - v t| = c t, which is nearly linear in R.
        let mut range_m = 0.5 * path_m;
        for _ in 0..3 {
            let leg = |x: f64, z: f64| {
                let (x, z) = (range_m * toward[0] - x, range_m * toward[1] - z);
                let length = (x * x + z * z).sqrt().max(MIN_DISTANCE_M);
                (length, (x * toward[0] + z * toward[1]) / length)
            };
            let (out_m, out_slope) = leg(self.transmit_m[0], self.transmit_m[1]);
            let (back_m, back_slope) = leg(moved_x, moved_z);
            let slope = (out_slope + back_slope).max(0.5);
            range_m = (range_m - (out_m + back_m - path_m) / slope).max(MIN_DISTANCE_M);
        }
        let d = [range_m * toward[0] - moved_x, range_m * toward[1] - moved_z];
        Focus {
            d_m: d.map(|x| x as f32),
            range_m: d[0].hypot(d[1]) as f32,
            sine: sine as f32,
        }
    }

    /// Rows and weights of some elements.
    #[inline(always)]
    fn steer(&self, f: &Focus, x_m: &[f32], w: &[f32], layout: GridLayout, taps: &mut Taps) {
        let cycles_per_m = (self.carrier_hz / self.c) as f32;
        let steps_per_m = match self.former {
            Former::Phase => 0.0,
            _ => (self.rate_hz * FRACTIONS as f64 / self.c) as f32,
        };
        let focused = self.former == Former::DynamicFocus;
        let [vx, vz] = self.velocity_m_per_s.map(|v| (v / self.c) as f32);
        let n = x_m.len().min(w.len()).min(BLOCK);
        taps.len = n;
        let mut late_m = [0.0f32; BLOCK];
        for (late_m, x) in late_m[..n].iter_mut().zip(x_m) {
            *late_m = if focused {
                let qx = f.d_m[0] - x;
                let q = (qx * qx + f.d_m[1] * f.d_m[1]).sqrt().max(1e-6);
                let difference = x * (x - 2.0 * f.d_m[0]) / (q + f.range_m);
                difference / (1.0 + (qx * vx + f.d_m[1] * vz) / q)
            } else {
                -x * f.sine
            };
        }
        let element_rows = (FRACTIONS * 2 * layout.row) as i32;
        let (row, origin) = (2 * layout.row as i32, layout.origin as i32);
        for i in 0..n {
            let (sin, cos) = turn(late_m[i] * cycles_per_m);
            let step = whole_number(late_m[i] * steps_per_m);
            let fraction = step & (FRACTIONS as i32 - 1);
            let whole = step >> FRACTIONS.trailing_zeros();
            let start = i as i32 * element_rows + fraction * row + origin + whole;
            taps.start[i] = start as u32;
            taps.re[i] = w[i] * cos;
            taps.im[i] = w[i] * sin;
        }
    }
}

/// 1.5 * 2^23: adding it removes the fractional part of an f32.
const SHIFT: f32 = 12_582_912.0;

/// The nearest integer, from the last bits of the shifted value.
#[inline(always)]
fn whole_number(x: f32) -> i32 {
    (x + SHIFT).to_bits() as i32 - SHIFT.to_bits() as i32
}

/// Rounds a value within 2^22 to the nearest integer (halves to even) without a function call, so that loops vectorise.
#[inline(always)]
fn round(x: f32) -> f32 {
    (x + SHIFT) - SHIFT
}

/// Sine and cosine of a number of cycles, with an error of 3e-7.
#[inline(always)]
fn turn(cycles: f32) -> (f32, f32) {
    // Reduces to a quarter turn, then uses a Taylor series over an eighth of a turn to either side.
    let quarter = round(4.0 * cycles);
    let a = (cycles - 0.25 * quarter) * std::f32::consts::TAU;
    let a2 = a * a;
    let sin = a * (1.0 + a2 * (-1.0 / 6.0 + a2 * (1.0 / 120.0 - a2 / 5040.0)));
    let cos = 1.0 + a2 * (-0.5 + a2 * (1.0 / 24.0 + a2 * (-1.0 / 720.0 + a2 / 40320.0)));
    let k = whole_number(4.0 * cycles) & 3;
    let (s, c) = if k & 1 == 0 { (sin, cos) } else { (cos, sin) };
    let s = if k & 2 == 0 { s } else { -s };
    let c = if (k + 1) & 2 == 0 { c } else { -c };
    (s, c)
}

#[cfg(test)]
mod tests;
