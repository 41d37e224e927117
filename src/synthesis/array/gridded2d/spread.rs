//! Surveys the echoes, and spreads every echo onto all channels of the grid.

use std::time::Duration;

use num_complex::Complex64;

use crate::array::gridded::kernel::MAX_WIDTH;
use crate::array::phasor::cis;
use crate::arrivals::{CHUNK, LineChunk, LineSink};
use echotank_core::simd::Kind as Processor;

use super::engine::{Orders, Ping, PulseMotion, Work};
use super::merge::Merge;
use super::panel::{PANEL, Row};
use super::sample::Sample;
use super::series::chebyshev_terms as chebyshev;
use super::smooth::{EchoStrength, Echoes, GAIN_TERMS, Smooth};
use super::stages::now;
use super::task::{
    ChannelProduct, KINDS, Kind, MAX_CHANNELS, MAX_CURVATURE_TERMS, MAX_DILATION,
    MAX_RATE_GRADIENT_TERMS, Task,
};
use super::weights::{Taps, taps};

/// Closer to endfire the range cannot be computed from the curvature over 1 - s^2, and it does not
/// matter.
const MIN_BROADSIDE: f64 = 1e-3;

/// Beyond this number a survey stores only every second chunk, then every third, and so on.
const SURVEYED: usize = 16_384;

/// Adding this to an integer (|n| < 2^31) leaves that integer in the low bits.
const WHOLE: f64 = 6_755_399_441_055_744.0; // 1.5 * 2^52

/// Maximum number of values of one echo in one row of the grid, with a panel before and after.
const MAX_LINE: usize = MAX_WIDTH * MAX_CHANNELS + 2 * PANEL;

/// Conversion from leading edges to mid-pulse, for one task.
#[derive(Clone, Copy)]
pub(crate) struct Centring {
    half_s: f64,
    /// 1/c if the change of the stretch is modelled, else 0.
    bent: f64,
    /// 1 if it is modelled, else 0.
    follows: f64,
    carrier_hz: f64,
    nepers_per_m: f64,
    /// First sample of the slab.
    first_s: f64,
}

/// One echo about mid-pulse, without its amplitude.
struct Centred {
    /// From the first sample of the slab.
    middle_s: f64,
    slope: f64,
    dilation: f64,
    per_range_per_m: f64,
    rate_gradient_per_s: f64,
    /// Phase of the amplitude, turns.
    turns: f64,
    stretched: f64,
}

impl Centring {
    pub(super) fn new(ping: &Ping, motion: PulseMotion, first_s: f64) -> Self {
        Self {
            half_s: 0.5 * ping.duration_s,
            bent: match motion {
                PulseMotion::Stretch => 0.0,
                PulseMotion::Quadratic => 1.0 / ping.sound_speed_m_per_s,
            },
            follows: f64::from(u8::from(motion == PulseMotion::Quadratic)),
            carrier_hz: ping.carrier_hz,
            nepers_per_m: ping.nepers_per_m,
            first_s,
        }
    }

    #[inline(always)]
    fn echo(&self, chunk: &LineChunk, i: usize) -> Centred {
        let half_s = self.half_s;
        let stretched = 1.0 / (1.0 + chunk.doppler[i]);
        let at_edge = -chunk.doppler[i] * stretched;
        let rate = self.bent * chunk.acceleration_m_per_s2[i];
        let delay_s = chunk.delay_s[i] + half_s * (at_edge + 0.5 * rate * half_s);
        let slope = chunk.slope[i];
        // Third order of the motion during the pulse, which follows from the second: the range
        // changes along the line.
        let per_range_there = chunk.curvature_per_m[i] / (1.0 - slope * slope).max(MIN_BROADSIDE);
        let third = 3.0 * slope * per_range_there * self.follows * chunk.acceleration_m_per_s2[i];
        let rate_gradient = chunk.rate_gradient_per_s[i] + 0.5 * third * half_s;
        let middle = slope - rate_gradient * half_s;
        let rate_gradient_per_s = chunk.rate_gradient_per_s[i] + third * half_s;
        // The curvature also changes during the pulse. This is third order, so plain 1/R suffices.
        let curvature =
            chunk.curvature_per_m[i] + 3.0 * slope * per_range_there * rate_gradient * half_s;
        Centred {
            middle_s: delay_s + half_s - self.first_s,
            slope: middle,
            dilation: at_edge + rate * half_s,
            per_range_per_m: curvature / (1.0 - middle * middle).max(MIN_BROADSIDE),
            rate_gradient_per_s,
            turns: -self.carrier_hz * delay_s,
            stretched,
        }
    }

    /// Gain slope beyond the effect of range and absorption.
    #[inline(always)]
    fn gain_slope_per_m(&self, chunk: &LineChunk, i: usize, echo: &Centred) -> f64 {
        chunk.gain_slope_per_m[i] - echo.slope * (echo.per_range_per_m + self.nepers_per_m)
    }
}

/// Collects the parameters of echoes.
pub(super) struct Survey<'a> {
    pub echoes: &'a mut Echoes,
    pub(crate) centring: Centring,
    pub chunks: usize,
}

impl LineSink for Survey<'_> {
    fn accept(&mut self, chunk: &LineChunk) {
        self.chunks += 1;
        let every = 1 + self.echoes.len() / SURVEYED;
        for i in 0..chunk.len {
            let echo = self.centring.echo(chunk, i);
            let e = &mut *self.echoes;
            if chunk.amplitude[i] != Complex64::ZERO {
                e.strengths.push(EchoStrength {
                    middle_s: echo.middle_s,
                    slope: echo.slope,
                    per_range_per_m: echo.per_range_per_m,
                    energy: chunk.amplitude[i].norm_sqr(),
                    gain_slope_per_m: self.centring.gain_slope_per_m(chunk, i, &echo),
                    gain_curvature_per_m2: chunk.gain_curvature_per_m2[i],
                });
            }
            if !self.chunks.is_multiple_of(every) {
                continue;
            }
            e.slope.push(echo.slope);
            e.dilation.push(echo.dilation);
            e.per_range_per_m.push(echo.per_range_per_m);
            e.rate_gradient_per_s.push(echo.rate_gradient_per_s);
            e.acceleration_m_per_s2.push(chunk.acceleration_m_per_s2[i]);
        }
    }
}

/// A chunk between the two loops, as a structure of arrays.
pub(super) struct Prepared<T> {
    pub(super) re: [T; CHUNK],
    pub(super) im: [T; CHUNK],
    /// Residuals of dilation, curvature and rate gradient, each relative to its span.
    pub(super) dilation: [T; CHUNK],
    pub(super) curvature: [T; CHUNK],
    pub(super) rate_gradient: [T; CHUNK],
    /// Values of all kinds except the echo itself: gain slope and gain curvature at the end of the
    /// section, and residual acceleration at the end of the pulse.
    pub(super) kinds: [[T; CHUNK]; KINDS - 1],
    /// Largest of the three.
    farthest: [f64; CHUNK],
    pub(super) row: [i32; CHUNK],
    pub(super) column: [i32; CHUNK],
    /// Position across the cell, -1..1.
    pub(super) in_row: [T; CHUNK],
    pub(super) in_column: [T; CHUNK],
}

/// Conversion of products to channels, and the layout of an echo's columns in the vectors of a
/// panel.
#[derive(Default)]
pub(crate) struct Mixing<T> {
    /// `[product][channel]`, whole vectors.
    pub(super) into: Vec<[T; PANEL]>,
    /// Vectors of one product.
    vectors: usize,
    /// By the position of an echo's first value in its panel, vector by vector: channel and tap of
    /// each lane.
    pub(super) lanes: Vec<[[i32; PANEL]; 2]>,
    /// Vectors of one position.
    pub(super) reach: usize,
}

/// A tap that every kernel has with weight 0.
const NO_TAP: i32 = MAX_WIDTH as i32 - 1;

impl<T: Sample> Mixing<T> {
    fn set(&mut self, merge: &Merge, products: usize, slope_width: usize) {
        let channels = merge.count;
        self.vectors = channels.div_ceil(PANEL);
        self.into.clear();
        for product in 0..products {
            for vector in 0..self.vectors {
                self.into.push(std::array::from_fn(|lane| {
                    let channel = vector * PANEL + lane;
                    let known = channel < channels;
                    T::narrow(if known {
                        merge.share_of_channel(product, channel)
                    } else {
                        0.0
                    })
                }));
            }
        }
        let values = slope_width * channels;
        self.reach = (PANEL - 1 + values).div_ceil(PANEL);
        self.lanes.clear();
        for before in 0..PANEL {
            for vector in 0..self.reach {
                let value = |lane: usize| (vector * PANEL + lane).checked_sub(before);
                let within = |lane: usize| value(lane).filter(|&value| value < values);
                self.lanes.push([
                    std::array::from_fn(|lane| within(lane).map_or(0, |v| (v % channels) as i32)),
                    std::array::from_fn(|lane| {
                        within(lane).map_or(NO_TAP, |v| (v / channels) as i32)
                    }),
                ]);
            }
        }
    }
}

impl<T: Sample> Mixing<T> {
    /// Channels of one echo without its amplitude, padded with zeros to a whole vector.
    #[inline(always)]
    fn one<const FUSED: bool>(
        &self,
        task: &Task<T>,
        p: &Prepared<T>,
        i: usize,
        mixed: &mut [T; MAX_CHANNELS + PANEL],
    ) {
        let (orders, kinds) = (task.orders, task.kinds());
        let dilation = chebyshev::<T, MAX_DILATION>(p.dilation[i], orders.dilation);
        let curvature = chebyshev::<T, MAX_CURVATURE_TERMS>(p.curvature[i], orders.curvature);
        let rate_gradient =
            chebyshev::<T, MAX_RATE_GRADIENT_TERMS>(p.rate_gradient[i], orders.rate_gradient);
        mixed[..self.vectors * PANEL].fill(T::ZERO);
        let mut rows = self.into.chunks_exact(self.vectors.max(1));
        for kept in task.kept() {
            let of_kind = match kinds[kept.kind] {
                Kind::Whole => T::one(),
                Kind::Gain(order) => p.kinds[order][i],
                Kind::Acceleration => p.kinds[GAIN_TERMS][i],
            };
            let share = of_kind * curvature[kept.curvature] * rate_gradient[kept.rate_gradient];
            for (&r, into) in dilation[..kept.dilation].iter().zip(&mut rows) {
                for (v, into) in into.iter().enumerate() {
                    let sum = vector_mut(mixed, v * PANEL);
                    *sum = scaled_plus::<T, FUSED>(*into, share * r, *sum);
                }
            }
        }
    }
}

/// One chunk of echoes, a vector for each; the input of [`Sample::spread_wide`].
pub struct Wide<'a, T> {
    pub(super) prepared: &'a Prepared<T>,
    pub(super) len: usize,
    pub(super) grid: &'a mut [Row<T>],
    pub(super) panel_rows: usize,
    pub(super) channels: usize,
    pub(super) orders: Orders,
    pub(super) kinds: &'a [Kind],
    pub(super) kept: &'a [ChannelProduct],
    pub(super) mixing: &'a Mixing<T>,
    pub(super) time_taps: &'a [Taps<T>],
    pub(super) slope_taps: &'a [Taps<T>],
    pub(super) time_width: usize,
    pub(super) slope_width: usize,
    pub(super) last_row: usize,
    pub(super) last_column: usize,
}

impl<T: Sample> Default for Prepared<T> {
    fn default() -> Self {
        Self {
            re: [T::ZERO; CHUNK],
            im: [T::ZERO; CHUNK],
            dilation: [T::ZERO; CHUNK],
            curvature: [T::ZERO; CHUNK],
            rate_gradient: [T::ZERO; CHUNK],
            kinds: [[T::ZERO; CHUNK]; KINDS - 1],
            farthest: [0.0; CHUNK],
            row: [0; CHUNK],
            column: [0; CHUNK],
            in_row: [T::ZERO; CHUNK],
            in_column: [T::ZERO; CHUNK],
        }
    }
}

/// Scale factors from echoes to grid positions.
#[derive(Clone, Copy)]
struct Scales {
    smooth: Smooth,
    per_dilation: f64,
    per_curvature: f64,
    per_rate_gradient: f64,
    half_m: f64,
    /// Phase per acceleration at the ends of the pulse.
    per_acceleration: f64,
    /// Columns per unit of slope, offset of the cells, and the first column.
    per_step: f64,
    slope_shift: f64,
    first_column: f64,
    /// Rows per second, and so on.
    rows_per_s: f64,
    time_shift: f64,
    first_row: f64,
}

impl Scales {
    fn new<T: Sample>(task: &Task<T>) -> Self {
        let smooth = task.smooth;
        let over = |half: f64| if half > 0.0 { 1.0 / half } else { 0.0 };
        let (time, slope) = (&task.engine.time_kernel, &task.engine.slope_kernel);
        Self {
            smooth,
            per_dilation: over(smooth.dilation_rest),
            per_curvature: over(smooth.per_range_per_m.half),
            per_rate_gradient: over(smooth.rate_gradient_rest),
            half_m: task.half_m(),
            per_acceleration: task.rad_per_acceleration(),
            per_step: 1.0 / task.step,
            slope_shift: slope.shift(),
            first_column: (slope.first() - task.first) as f64,
            rows_per_s: task.engine.rows_per_s(),
            time_shift: time.shift(),
            first_row: time.first() as f64,
        }
    }
}

/// Computes the vectorised part of a chunk. The chunk and its results are separate parameters, so
/// that the compiler knows that they do not overlap.
#[inline(always)]
fn prepare<T: Sample>(k: Scales, centring: Centring, chunk: &LineChunk, p: &mut Prepared<T>) {
    for i in 0..chunk.len.min(CHUNK) {
        let echo = centring.echo(chunk, i);
        let (cos, sin) = cis(echo.turns);
        let a = chunk.amplitude[i];
        let (re, im) = (a.re * echo.stretched, a.im * echo.stretched);
        p.re[i] = T::narrow(re * cos - im * sin);
        p.im[i] = T::narrow(re * sin + im * cos);
    }
    for i in 0..chunk.len.min(CHUNK) {
        let echo = centring.echo(chunk, i);
        let s = echo.slope;
        let shared = k.smooth.dilation(s) + k.smooth.bow(s);
        let dilation = (echo.dilation - shared) * k.per_dilation;
        let curvature = (echo.per_range_per_m - k.smooth.per_range_per_m.middle) * k.per_curvature;
        let shared = echo.per_range_per_m * k.smooth.rate_gradient.at(s);
        let rate_gradient = (echo.rate_gradient_per_s - shared) * k.per_rate_gradient;
        p.farthest[i] = dilation.abs().max(curvature.abs()).max(rate_gradient.abs());
        p.dilation[i] = T::narrow(dilation);
        p.curvature[i] = T::narrow(curvature);
        p.rate_gradient[i] = T::narrow(rate_gradient);
    }
    for i in 0..chunk.len.min(CHUNK) {
        let echo = centring.echo(chunk, i);
        let (cell, within) = cell(echo.slope * k.per_step + k.slope_shift);
        p.in_column[i] = T::narrow(within);
        p.column[i] = (cell + k.first_column + WHOLE).to_bits() as i32;
        let (cell, within) = self::cell(echo.middle_s * k.rows_per_s + k.time_shift);
        p.in_row[i] = T::narrow(within);
        p.row[i] = (cell + k.first_row + WHOLE).to_bits() as i32;
    }
}

/// Computes the residuals of gain slope, gain curvature and acceleration.
#[inline(always)]
fn prepare_kinds<T: Sample>(k: Scales, centring: Centring, chunk: &LineChunk, p: &mut Prepared<T>) {
    for i in 0..chunk.len.min(CHUNK) {
        let echo = centring.echo(chunk, i);
        let shared = k.smooth.shared_gain_slope(echo.slope, echo.per_range_per_m);
        let gain_slope = centring.gain_slope_per_m(chunk, i, &echo) - shared;
        let acceleration = chunk.acceleration_m_per_s2[i]
            - echo.per_range_per_m * k.smooth.acceleration.at(echo.slope);
        p.kinds[0][i] = T::narrow(gain_slope * k.half_m);
        p.kinds[1][i] = T::narrow(chunk.gain_curvature_per_m2[i] * k.half_m * k.half_m);
        p.kinds[2][i] = T::narrow(acceleration * k.per_acceleration);
    }
}

/// Cell index of a position, and the position within it, -1..1. Rounds half a step lower by
/// addition, since `floor` may be a function call.
#[inline(always)]
fn cell(place: f64) -> (f64, f64) {
    let cell = (place - 0.5 + WHOLE) - WHOLE;
    (cell, 2.0 * (place - cell) - 1.0)
}

/// Spreads echoes onto the grid of a task.
pub(super) struct Spread<'a, T: Sample> {
    task: &'a Task<'a, T>,
    scales: Scales,
    centring: Centring,
    grid: &'a mut [Row<T>],
    prepared: &'a mut Prepared<T>,
    mixing: &'a Mixing<T>,
    pub echoes: usize,
    /// Number of echoes outside the spans of the task; those outside the grid are omitted.
    pub beyond: usize,
    /// Time spent here, without the source of the echoes.
    pub spent: Duration,
}

impl<'a, T: Sample> Spread<'a, T> {
    pub(super) fn new(task: &'a Task<'a, T>, centring: Centring, work: &'a mut Work<T>) -> Self {
        let start = now();
        if !work.cleared {
            work.grid.fill(Row::ZERO);
        }
        let rows = task.panels() * task.engine.panel_rows();
        if work.grid.len() < rows {
            work.grid.resize(rows, Row::ZERO);
        }
        work.cleared = false;
        let slope_width = task.engine.slope_kernel.width;
        work.mixing
            .set(&work.merge, task.products().count(), slope_width);
        Self {
            task,
            scales: Scales::new(task),
            centring,
            grid: &mut work.grid[..rows],
            prepared: &mut work.prepared,
            mixing: &work.mixing,
            echoes: 0,
            beyond: 0,
            spent: now().saturating_sub(start),
        }
    }

    fn accept_as_can_be(&mut self, chunk: &LineChunk) {
        #[cfg(target_arch = "x86_64")]
        match self.task.engine.simd_level.kind() {
            // SAFETY: such a `SimdLevel` proves that the processor has these features.
            Processor::Avx512 => return unsafe { self.accept_avx512(chunk) },
            // SAFETY: as above.
            Processor::Avx2 => return unsafe { self.accept_avx2(chunk) },
            Processor::Portable => {}
        }
        self.accept_plain::<false>(chunk);
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx512f,avx512dq,avx512vl,avx2,fma")]
    fn accept_avx512(&mut self, chunk: &LineChunk) {
        if !T::WIDE || self.task.channels() > PANEL {
            return self.accept_plain::<true>(chunk);
        }
        self.prepare_all(chunk);
        let (engine, task) = (self.task.engine, self.task);
        let len = chunk.len.min(CHUNK);
        self.echoes += len;
        let farthest = self.prepared.farthest[..len].iter();
        self.beyond += farthest.filter(|&&farthest| farthest > 1.0).count();
        self.beyond += T::spread_wide(
            Wide {
                prepared: self.prepared,
                len,
                grid: self.grid,
                panel_rows: engine.panel_rows(),
                channels: task.channels(),
                orders: task.orders,
                kinds: task.kinds(),
                kept: task.kept(),
                mixing: self.mixing,
                time_taps: &engine.time_taps,
                slope_taps: &engine.slope_taps,
                time_width: engine.time_kernel.width,
                slope_width: engine.slope_kernel.width,
                last_row: engine.rows - engine.time_kernel.width,
                last_column: task.columns - engine.slope_kernel.width,
            },
            engine.simd_level,
        );
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2,fma")]
    fn accept_avx2(&mut self, chunk: &LineChunk) {
        self.accept_plain::<true>(chunk);
    }

    #[inline(always)]
    fn accept_plain<const FUSED: bool>(&mut self, chunk: &LineChunk) {
        self.prepare_all(chunk);
        self.add::<FUSED>(chunk.len);
    }

    #[inline(always)]
    fn prepare_all(&mut self, chunk: &LineChunk) {
        prepare(self.scales, self.centring, chunk, self.prepared);
        if self.task.kinds().len() > 1 {
            prepare_kinds(self.scales, self.centring, chunk, self.prepared);
        }
    }

    /// Adds echo by echo to the grid.
    #[inline(always)]
    fn add<const FUSED: bool>(&mut self, len: usize) {
        let task = self.task;
        let engine = task.engine;
        let (time_width, slope_width) = (engine.time_kernel.width, engine.slope_kernel.width);
        let (last_row, last_column) = (engine.rows - time_width, task.columns - slope_width);
        let channels = task.channels();
        let panel_rows = engine.panel_rows();
        let mut each = [[T::ZERO; MAX_CHANNELS + PANEL]; 2];
        let mut mixed = [T::ZERO; MAX_CHANNELS + PANEL];
        let mut line = [[T::ZERO; MAX_LINE]; 2];
        let p = &*self.prepared;
        self.echoes += len;
        for i in 0..len.min(CHUNK) {
            let (row, column) = (p.row[i] as usize, p.column[i] as usize);
            self.beyond += usize::from(p.farthest[i] > 1.0);
            if row > last_row || column > last_column {
                self.beyond += 1;
                continue;
            }
            self.mixing.one::<FUSED>(task, p, i, &mut mixed);
            for v in (0..channels).step_by(PANEL) {
                let mixed = *vector(&mixed, v);
                *vector_mut(&mut each[0], v) = scaled(mixed, p.re[i]);
                *vector_mut(&mut each[1], v) = scaled(mixed, p.im[i]);
            }
            // Whole vectors: each tap overwrites the zero padding of the one before, with zeros
            // before the first and after the last.
            let weights = taps::<T, FUSED>(&engine.slope_taps, p.in_column[i]);
            let place = column * channels;
            let (first, before) = (place / PANEL, place % PANEL);
            let end = before + slope_width * channels;
            for part in 0..2 {
                let (line, each) = (&mut line[part], &each[part]);
                *vector_mut(line, 0) = [T::ZERO; PANEL];
                for (tap, &weight) in weights[..slope_width].iter().enumerate() {
                    let at = before + tap * channels;
                    for v in (0..channels).step_by(PANEL) {
                        *vector_mut(line, at + v) = scaled(*vector(each, v), weight);
                    }
                }
                *vector_mut(line, end) = [T::ZERO; PANEL];
            }
            let weights = taps::<T, FUSED>(&engine.time_taps, p.in_row[i]);
            for (panel, at) in (0..end).step_by(PANEL).enumerate() {
                let (re, im) = (vector(&line[0], at), vector(&line[1], at));
                let rows = &mut self.grid[(first + panel) * panel_rows + row..][..time_width];
                for (sum, &weight) in rows.iter_mut().zip(&weights) {
                    sum.re = scaled_plus::<T, FUSED>(*re, weight, sum.re);
                    sum.im = scaled_plus::<T, FUSED>(*im, weight, sum.im);
                }
            }
        }
    }
}

impl<T: Sample> LineSink for Spread<'_, T> {
    fn accept(&mut self, chunk: &LineChunk) {
        let start = now();
        self.accept_as_can_be(chunk);
        self.spent += now().saturating_sub(start);
    }
}

#[inline(always)]
fn vector<T>(values: &[T], at: usize) -> &[T; PANEL] {
    values[at..][..PANEL].try_into().expect("a vector")
}

#[inline(always)]
fn vector_mut<T>(values: &mut [T], at: usize) -> &mut [T; PANEL] {
    (&mut values[at..][..PANEL]).try_into().expect("a vector")
}

/// By value, here and below, so that the compiler knows that nothing overlaps and vectorises.
#[inline(always)]
fn scaled<T: Sample>(mut a: [T; PANEL], by: T) -> [T; PANEL] {
    for a in &mut a {
        *a = *a * by;
    }
    a
}

/// a by + plus
#[inline(always)]
fn scaled_plus<T: Sample, const FUSED: bool>(
    a: [T; PANEL],
    by: T,
    mut plus: [T; PANEL],
) -> [T; PANEL] {
    for j in 0..PANEL {
        plus[j] = a[j].times_plus::<FUSED>(by, plus[j]);
    }
    plus
}
