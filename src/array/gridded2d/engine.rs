//! One task: the echoes of one slab of delays at one stretch of the line, to samples of its elements.

use std::f64::consts::{PI, TAU};
use std::sync::Arc;

use num_complex::{Complex, Complex64};
use rustfft::{Fft, FftNum, FftPlanner};

use crate::array::gridded::dialect::{Dialect, Kind};
use crate::array::gridded::kernel::{Kernel, MAX_WIDTH};
use crate::array::gridded::transform::grid_size;
use crate::array::phasor::{LANES, cis, cis_lanes};
use crate::flow::{ArrayGeometry, LineChunk, LineSink, LineStretch, Pattern, PingPlan};

use super::pulse::{Instants, MOST_INSTANTS, PulseSpectra, Reading, chebyshev_nodes};
use super::series::{powers_from_nodes, series_from_nodes, sizes, terms_needed};
use super::smooth::{Echoes, Smooth};

/// Bins worked on together: over so few the rotor from a column to an element hardly turns beyond its middle's.
const BLOCK: usize = 32;
/// Most terms of each series; what does not converge with them is reported as error.
const MOST_ALONG: usize = 16;
const MOST_BAND: usize = 6;
const MOST_DILATION: usize = MOST_INSTANTS;
const MOST_BEND: usize = 8;
const MOST_TURN: usize = 12;
const MOST_TWIST: usize = 4;
/// Most channels of the grid.
const MOST_CHANNELS: usize = 64;
/// Columns per cycle of the aperture, over the least that sampling asks for.
const SLOPE_OVERSAMPLING: f64 = 2.0;
const TIME_OVERSAMPLING: f64 = 2.0;
/// Closer to endfire the range is not to be had from the bend over 1 - s^2; nor does it matter.
const LEAST_BROADSIDE: f64 = 1e-3;

/// Step of the differences that stand for the derivatives of 1/D, cycles per column: of fourth order in what they are for.
const STEP_NU: f64 = 1e-3;

/// The real numbers that grids and transforms are made of.
pub trait Sample: FftNum + Default + Reading {
    const ZERO: Self;
    fn narrow(value: f64) -> Self;
    fn widen(self) -> f64;
    /// self a + b, in one rounding where the processor has been asked for it.
    fn times_plus<const FUSED: bool>(self, a: Self, b: Self) -> Self;
}

impl Sample for f32 {
    const ZERO: Self = 0.0;
    fn narrow(value: f64) -> Self {
        value as f32
    }
    fn widen(self) -> f64 {
        self.into()
    }
    #[inline(always)]
    fn times_plus<const FUSED: bool>(self, a: Self, b: Self) -> Self {
        if FUSED {
            self.mul_add(a, b)
        } else {
            self * a + b
        }
    }
}

impl Sample for f64 {
    const ZERO: Self = 0.0;
    fn narrow(value: f64) -> Self {
        value
    }
    fn widen(self) -> f64 {
        self
    }
    #[inline(always)]
    fn times_plus<const FUSED: bool>(self, a: Self, b: Self) -> Self {
        if FUSED {
            self.mul_add(a, b)
        } else {
            self * a + b
        }
    }
}

/// What a pulse is during an echo.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PulseMotion {
    /// Stretched evenly about the leading edge, as `direct` does under `DopplerModel::Stretch`.
    Stretch,
    /// Its stretch changes at an even rate: as the reference to third order.
    Quadratic,
}

/// How finely to compute; [`super::plan`] chooses.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Fineness {
    /// Elements of one stretch of the line.
    pub stretch: usize,
    /// Output samples of one slab, a multiple of 32.
    pub slab_samples: usize,
    pub time_width: usize,
    pub slope_width: usize,
    /// Of the kernels.
    pub moments: usize,
    /// What each series may leave out, relative to an echo.
    pub series: f64,
    pub motion: PulseMotion,
}

/// The receiver filter as the transform needs it.
pub struct Filter<'a> {
    /// Gain at an offset from the centre frequency, Hz.
    pub gain: &'a dyn Fn(f64) -> f64,
    /// How far it reaches to either side in time, seconds.
    pub half_s: f64,
}

/// Lengths of the series of one task.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Orders {
    /// Instants of the emission.
    pub instants: usize,
    /// Powers of the place along the stretch, without and with the turn inside a block.
    pub along: usize,
    pub turn: usize,
    /// Powers of the frequency.
    pub band: usize,
    /// Terms for what is left of the dilation, for the bend, and for what is left of the twist; a channel is a product of three.
    pub dilation: usize,
    pub bend: usize,
    pub twist: usize,
}

/// What a task met.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct TaskReport {
    pub echoes: usize,
    pub columns: usize,
    pub channels: usize,
    pub orders: Orders,
    /// Bound on what the series leave out, relative to an echo.
    pub left_out: f64,
}

/// One stretch of the line.
#[derive(Clone, Debug)]
struct Stretch {
    first: usize,
    middle_m: f64,
    /// Of each element from the middle.
    along_m: Vec<f64>,
    half_m: f64,
}

/// The engine of one receive array.
pub struct LineEngine<T: Sample> {
    fineness: Fineness,
    rate_hz: f64,
    filter_half_s: f64,
    /// Room in the tables of the pulse.
    fastest_m_per_s: f64,
    dialect: Dialect,
    stretches: Vec<Stretch>,
    /// Length and shape of the element pattern along the line, metres; 0 is none.
    element_m: f64,
    time_kernel: Kernel,
    slope_kernel: Kernel,
    time_taps: Vec<Taps<T>>,
    slope_taps: Vec<Taps<T>>,
    slope_inverse: InverseGain,
    rows: usize,
    forward: Arc<dyn Fft<T>>,
    inverse: Arc<dyn Fft<T>>,
    /// Per bin, from -rate/2: filter, time kernel, bin width.
    band: Vec<f64>,
    instants: Vec<Instants>,
    powers: Vec<Vec<f64>>,
    series: Vec<Vec<f64>>,
    pulse: Option<PulseSpectra<T>>,
    ping: Ping,
}

/// What a ping sets.
#[derive(Clone, Copy, Debug, Default)]
struct Ping {
    sound_speed_m_per_s: f64,
    carrier_hz: f64,
    duration_s: f64,
    nepers_per_m: f64,
    first_sample_s: f64,
    slabs: usize,
    /// Leading edges of the first slab begin here, and of each next one so much later.
    first_edge_s: f64,
    slab_s: f64,
}

/// Buffers of one thread.
pub struct Work<T: Sample> {
    echoes: Echoes,
    /// `[row][column][channel][re, im]`.
    grid: Vec<T>,
    column: Vec<Complex<T>>,
    scratch: Vec<Complex<T>>,
    /// `[channel][bin]`, split.
    spectrum: Split<T>,
    /// `[block][column][power][lane]`.
    moments: Split<T>,
    /// `[instant][bend][twist][power along][power of frequency]`.
    template: Vec<Complex64>,
    values: Vec<Complex64>,
    values_next: Vec<Complex64>,
    /// `[instant][dilation][power of frequency]`.
    dilation: Vec<Complex64>,
    /// Of one element and block, per column: cosine and sine.
    rotors: Vec<[T; 2]>,
    /// `[element][bin]`.
    elements: Split<T>,
}
#[derive(Default)]
struct Split<T> {
    re: Vec<T>,
    im: Vec<T>,
}

impl<T: Sample> Split<T> {
    fn clear_to(&mut self, len: usize) {
        self.re.clear();
        self.re.resize(len, T::ZERO);
        self.im.clear();
        self.im.resize(len, T::ZERO);
    }
}

/// Takes the echoes of one task.
pub struct Gather<'a> {
    echoes: &'a mut Echoes,
    motion: PulseMotion,
    carrier_hz: f64,
    duration_s: f64,
    sound_speed_m_per_s: f64,
    first_s: f64,
}

impl LineSink for Gather<'_> {
    fn accept(&mut self, chunk: &LineChunk) {
        let half_s = 0.5 * self.duration_s;
        let bent = match self.motion {
            PulseMotion::Stretch => 0.0,
            PulseMotion::Quadratic => 1.0 / self.sound_speed_m_per_s,
        };
        for i in 0..chunk.len {
            // From the leading edge to mid-pulse.
            let stretched = 1.0 / (1.0 + chunk.doppler[i]);
            let at_edge = -chunk.doppler[i] * stretched;
            let rate = bent * chunk.swing_m_per_s2[i];
            let delay_s = chunk.delay_s[i] + half_s * (at_edge + 0.5 * rate * half_s);
            let (cos, sin) = cis(-self.carrier_hz * delay_s);
            let a = chunk.amplitude[i] * stretched;
            let e = &mut *self.echoes;
            e.middle_s.push(delay_s + half_s - self.first_s);
            let (slope, twist) = (chunk.slope[i], chunk.twist_per_s[i]);
            let middle = slope - twist * half_s;
            e.slope.push(middle);
            e.dilation.push(at_edge + rate * half_s);
            // The bend changes during the pulse too: third order, so plain 1/R will do.
            let per_range = chunk.bend_per_m[i] / (1.0 - slope * slope).max(LEAST_BROADSIDE);
            let bend = chunk.bend_per_m[i] + 3.0 * slope * per_range * twist * half_s;
            e.per_range_per_m
                .push(bend / (1.0 - middle * middle).max(LEAST_BROADSIDE));
            e.twist_per_s.push(chunk.twist_per_s[i]);
            e.swing_m_per_s2.push(chunk.swing_m_per_s2[i]);
            e.re.push(a.re * cos - a.im * sin);
            e.im.push(a.re * sin + a.im * cos);
        }
    }
}

impl<T: Sample> LineEngine<T> {
    pub fn new(
        array: &ArrayGeometry,
        rate_hz: f64,
        filter: Filter,
        fineness: Fineness,
        dialect: Dialect,
    ) -> Self {
        let bins = fineness.slab_samples;
        assert!(bins.is_multiple_of(BLOCK) && bins > 0, "{bins} samples");
        assert!(fineness.stretch > 0, "a stretch without elements");
        let rows = grid_size((bins as f64 * TIME_OVERSAMPLING).ceil() as usize);
        let time_kernel = Kernel::new(
            fineness.time_width,
            rows as f64 / bins as f64,
            fineness.moments,
        );
        let slope_kernel = Kernel::new(fineness.slope_width, SLOPE_OVERSAMPLING, fineness.moments);
        let step_hz = rate_hz / bins as f64;
        let band = (0..bins)
            .map(|q| {
                let bin = q as f64 - (bins / 2) as f64;
                (filter.gain)(bin * step_hz) * step_hz / time_kernel.window_gain(bin / rows as f64)
            })
            .collect();
        let count = array.elements.div_ceil(fineness.stretch);
        let stretches = (0..count)
            .map(|s| {
                // As even as whole elements allow.
                let (first, end) = (s * array.elements / count, (s + 1) * array.elements / count);
                let middle_m = 0.5 * (array.element_x_m(first) + array.element_x_m(end - 1));
                let along_m: Vec<f64> = (first..end)
                    .map(|e| array.element_x_m(e) - middle_m)
                    .collect();
                Stretch {
                    first,
                    middle_m,
                    half_m: along_m[along_m.len() - 1],
                    along_m,
                }
            })
            .collect();
        let element_m = match array.element_pattern {
            Pattern::Omnidirectional => 0.0,
            Pattern::Rectangle { length_m, .. } => length_m,
        };
        let mut planner = FftPlanner::new();
        let most = MOST_INSTANTS.max(MOST_ALONG);
        Self {
            fineness,
            rate_hz,
            filter_half_s: filter.half_s,
            fastest_m_per_s: 5.0,
            dialect,
            stretches,
            element_m,
            time_taps: tap_tables(&time_kernel),
            slope_taps: tap_tables(&slope_kernel),
            slope_inverse: InverseGain::new(&slope_kernel),
            time_kernel,
            slope_kernel,
            rows,
            forward: planner.plan_fft_forward(rows),
            inverse: planner.plan_fft_inverse(bins),
            band,
            instants: (1..=MOST_INSTANTS).map(Instants::new).collect(),
            powers: (1..=most).map(powers_from_nodes).collect(),
            series: (1..=most).map(series_from_nodes).collect(),
            pulse: None,
            ping: Ping::default(),
        }
    }

    /// Makes tables that do not have to be made again for platforms up to this speed.
    pub fn with_room_for(mut self, fastest_m_per_s: f64) -> Self {
        self.fastest_m_per_s = self.fastest_m_per_s.max(1.1 * fastest_m_per_s);
        self
    }

    fn bins(&self) -> usize {
        self.fineness.slab_samples
    }

    pub fn work(&self) -> Work<T> {
        let zero = Complex::new(T::ZERO, T::ZERO);
        let scratch = self
            .forward
            .get_inplace_scratch_len()
            .max(self.inverse.get_inplace_scratch_len());
        Work {
            echoes: Echoes::default(),
            grid: Vec::new(),
            column: Vec::new(),
            scratch: vec![zero; scratch],
            spectrum: Split::default(),
            moments: Split::default(),
            template: Vec::new(),
            values: Vec::new(),
            values_next: Vec::new(),
            dilation: Vec::new(),
            rotors: Vec::new(),
            elements: Split::default(),
        }
    }

    /// Sets the engine to a ping: slabs, and the pulse's spectra if they are not those at hand.
    pub fn prepare(&mut self, plan: &PingPlan) {
        let c = plan.sound_speed_m_per_s;
        let pulse = &plan.pulse;
        let speed = plan
            .segments
            .iter()
            .map(|s| s.velocity_m_per_s.length())
            .fold(0.0, f64::max);
        let (half_hz, carrier_hz) = (0.5 * self.rate_hz, pulse.center_frequency_hz);
        let shift = |speed: f64| 2.1 * speed / c * (carrier_hz + half_hz);
        if !self
            .pulse
            .as_ref()
            .is_some_and(|p| p.is_of(pulse, half_hz + shift(speed)))
        {
            // Room for a platform that speeds up.
            let reach_hz = half_hz + shift((1.5 * speed).max(self.fastest_m_per_s));
            self.pulse = Some(PulseSpectra::new(
                pulse,
                reach_hz,
                self.rate_hz / self.bins() as f64,
            ));
        }
        // An echo sounds from its leading edge on for T, give or take its stretch; the filter adds to both sides.
        let echo_s = pulse.duration_s * (1.0 + 3.0 * speed / c);
        let slab_s = (self.bins() - 2) as f64 / self.rate_hz - echo_s - 2.0 * self.filter_half_s;
        assert!(slab_s > 0.0, "slabs shorter than a filtered echo");
        let first_edge_s = plan.first_sample_s - echo_s - self.filter_half_s;
        let last_edge_s = plan.window_s(self.rate_hz) + self.filter_half_s;
        self.ping = Ping {
            sound_speed_m_per_s: c,
            carrier_hz,
            duration_s: pulse.duration_s,
            nepers_per_m: plan.absorption_db_per_m * std::f64::consts::LN_10 / 20.0,
            first_sample_s: plan.first_sample_s,
            slabs: ((last_edge_s - first_edge_s) / slab_s).ceil().max(1.0) as usize,
            first_edge_s,
            slab_s,
        };
    }

    /// Tasks of this ping: slabs times stretches, stretch by stretch.
    pub fn tasks(&self) -> usize {
        self.ping.slabs * self.stretches.len()
    }

    pub fn slabs(&self) -> usize {
        self.ping.slabs
    }

    fn stretch(&self, task: usize) -> &Stretch {
        &self.stretches[task / self.ping.slabs]
    }

    fn slab(&self, task: usize) -> usize {
        task % self.ping.slabs
    }

    /// Elements a task computes, and how many values it writes for each.
    pub fn task_elements(&self, task: usize) -> std::ops::Range<usize> {
        let stretch = self.stretch(task);
        stretch.first..stretch.first + stretch.along_m.len()
    }

    /// Values of the largest task's output.
    pub fn output_len(&self) -> usize {
        self.bins()
            * self
                .stretches
                .iter()
                .map(|s| s.along_m.len())
                .max()
                .unwrap_or(0)
    }

    /// Which echoes a task wants.
    pub fn wanted(&self, task: usize) -> LineStretch {
        let stretch = self.stretch(task);
        let ping = &self.ping;
        let edge_s = |slab: usize| ping.first_edge_s + slab as f64 * ping.slab_s;
        LineStretch {
            middle_m: stretch.middle_m,
            elements: stretch.along_m.len() as u64,
            earliest_s: edge_s(self.slab(task)),
            latest_s: edge_s(self.slab(task) + 1),
        }
    }

    /// First sample of a slab's output, counted from the record's.
    fn slab_start(&self, slab: usize) -> isize {
        let ping = &self.ping;
        let from_s = ping.first_edge_s + slab as f64 * ping.slab_s - self.filter_half_s;
        ((from_s - ping.first_sample_s) * self.rate_hz).floor() as isize
    }

    /// Where a task's echoes go.
    pub fn gather<'a>(&self, task: usize, work: &'a mut Work<T>) -> Gather<'a> {
        work.echoes.clear();
        let ping = &self.ping;
        Gather {
            echoes: &mut work.echoes,
            motion: self.fineness.motion,
            carrier_hz: ping.carrier_hz,
            duration_s: ping.duration_s,
            sound_speed_m_per_s: ping.sound_speed_m_per_s,
            first_s: ping.first_sample_s + self.slab_start(self.slab(task)) as f64 / self.rate_hz,
        }
    }

    /// Adds an element's slabs up, in order. `outputs(task)` is what [`Self::synthesise`] made.
    pub fn assemble<'a>(
        &self,
        outputs: impl Fn(usize) -> &'a [Complex<T>],
        element: usize,
        record: &mut [Complex64],
    ) {
        record.fill(Complex64::ZERO);
        let Some(s) = self
            .stretches
            .iter()
            .rposition(|stretch| stretch.first <= element)
        else {
            return;
        };
        let bins = self.bins();
        for slab in 0..self.ping.slabs {
            let output = outputs(s * self.ping.slabs + slab);
            if output.is_empty() {
                continue;
            }
            let row = &output[(element - self.stretches[s].first) * bins..][..bins];
            let start = self.slab_start(slab);
            let skip = (-start).max(0) as usize;
            let to = start.max(0) as usize;
            if skip >= bins || to >= record.len() {
                continue;
            }
            for (sum, value) in record[to..].iter_mut().zip(&row[skip..]) {
                sum.re += value.re.widen();
                sum.im += value.im.widen();
            }
        }
    }

    /// Greatest frequency of the band, Hz.
    fn top_hz(&self) -> f64 {
        self.ping.carrier_hz + 0.5 * self.rate_hz
    }

    /// The gathered echoes of a task to samples, element by element, slab-long. `output` is resized; empty where there are no echoes.
    pub fn synthesise(
        &self,
        task: usize,
        work: &mut Work<T>,
        output: &mut Vec<Complex<T>>,
    ) -> TaskReport {
        output.clear();
        if work.echoes.is_empty() {
            return TaskReport::default();
        }
        let smooth = Smooth::of(&work.echoes);
        let task = Task::new(self, self.stretch(task), smooth);
        task.run(work, output);
        TaskReport {
            echoes: work.echoes.len(),
            columns: task.columns,
            channels: task.channels(),
            orders: task.orders,
            left_out: task.left_out,
        }
    }
}

/// What an echo has of its own beyond its slope: inverse range, and what is left of the twist over the most that is.
#[derive(Clone, Copy)]
struct Ray {
    per_range_per_m: f64,
    twist: f64,
}

/// Channels of one term of the bend times one of the twist.
#[derive(Clone, Copy, Default)]
struct Kept {
    bend: usize,
    twist: usize,
    /// First terms of the dilation.
    dilation: usize,
}

/// The numbers of one task.
struct Task<'a, T: Sample> {
    engine: &'a LineEngine<T>,
    pulse: &'a PulseSpectra<T>,
    stretch: &'a Stretch,
    smooth: Smooth,
    orders: Orders,
    /// Which products of terms of bend and twist have channels, and for how many terms of the dilation.
    kept: [Kept; MOST_BEND * MOST_TWIST],
    kept_len: usize,
    left_out: f64,
    /// Slope per column, index of the first column, number.
    step: f64,
    first: isize,
    columns: usize,
}

impl<'a, T: Sample> Task<'a, T> {
    fn new(engine: &'a LineEngine<T>, stretch: &'a Stretch, smooth: Smooth) -> Self {
        let ping = &engine.ping;
        let c = ping.sound_speed_m_per_s;
        // The aperture, and how much farther the motion along the line carries it while the pulse is emitted.
        let drift_m = 0.5 * ping.duration_s * c * smooth.dilation1.abs();
        let reach_m = (stretch.half_m + drift_m).max(0.25 * c / ping.carrier_hz);
        let step = c / (engine.top_hz() * 2.0 * SLOPE_OVERSAMPLING * reach_m);
        let kernel = &engine.slope_kernel;
        let cell = |slope: f64| (slope / step + kernel.shift()).floor() as isize;
        let first = cell(smooth.slope.at(-1.0)) + kernel.first();
        let last = cell(smooth.slope.at(1.0)) + kernel.first() + kernel.width as isize - 1;
        let mut task = Self {
            engine,
            pulse: engine.pulse.as_ref().expect("prepared"),
            stretch,
            smooth,
            orders: Orders::default(),
            kept: [Kept::default(); MOST_BEND * MOST_TWIST],
            kept_len: 0,
            left_out: 0.0,
            step,
            first,
            columns: (last - first + 1) as usize,
        };
        task.choose_orders();
        task
    }

    fn half_m(&self) -> f64 {
        // A single element has no length to scale by.
        self.stretch.half_m.max(1e-6)
    }

    fn absolute_hz(&self, band: f64) -> f64 {
        self.engine.ping.carrier_hz + 0.5 * self.engine.rate_hz * band
    }

    /// What an echo becomes beyond the plane wave, at `x` (of the half stretch), `w` (of the half pulse) and `band` (of the half band).
    fn beyond_plane(&self, s: f64, ray: Ray, x: f64, w: f64, band: f64) -> Complex64 {
        let ping = &self.engine.ping;
        let c = ping.sound_speed_m_per_s;
        let (y, t) = (x * self.stretch.half_m, w * 0.5 * ping.duration_s);
        let per_range = ray.per_range_per_m;
        // Polynomials in the slope, so that columns beside the echoes' own slopes, beyond endfire even, go on smoothly.
        let bend = per_range * (1.0 - s * s);
        let (twist, swing) = (self.smooth.twist.at(s), self.smooth.swing.at(s));
        let twist_rest = ray.twist * self.smooth.twist_rest;
        let quadratic = match self.engine.fineness.motion {
            PulseMotion::Stretch => 0.0,
            PulseMotion::Quadratic => 1.0,
        };
        // Second order of the delay, and the third that follows from it: the range itself changes along the line.
        let path_m = per_range * t * (twist * y + 0.5 * quadratic * swing * t)
            + twist_rest * y * t
            + bend * y * y * 0.5 * (1.0 + s * y * per_range)
            + 1.5 * s * per_range * per_range * y * t * (twist * y + quadratic * swing * t);
        let (cos, sin) = cis(-self.absolute_hz(band) / c * path_m);
        let mut level = 1.0 + s * y * (per_range + ping.nepers_per_m);
        if self.engine.element_m > 0.0 {
            let lengths = self.engine.element_m * ping.carrier_hz / c;
            let (here, there) = (sinc(lengths * s), sinc(lengths * (s - y * bend)));
            // Near a null there is nothing to scale.
            if here.abs() > 0.1 {
                level *= there / here;
            }
        }
        Complex64::new(level * cos, level * sin)
    }

    /// The weight of the column at slope `s`, over the kernel's own spectrum at `x` at rest.
    ///
    /// A column stands for echoes beside it too. With Y the place along the aperture in cycles per unit of slope and D the kernel's
    /// spectrum, exp(j 2pi Y s) has the weights exp(j 2pi Y s_k) / D(Y); differentiating by Y gives those of s exp(j 2pi Y s), so a factor
    /// g(s) needs g/D + g' (1/D)'/(j 2pi) + g''/2 (1/D)''/(j 2pi)^2 + ...
    fn shape(&self, s: f64, ray: Ray, x: f64, w: f64, band: f64) -> Complex64 {
        let ping = &self.engine.ping;
        let c = ping.sound_speed_m_per_s;
        let per_column = self.absolute_hz(band) / c * self.step;
        let y = x * self.stretch.half_m;
        let moved_m = y - c * self.smooth.dilation1 * w * 0.5 * ping.duration_s;
        let nu = moved_m * per_column;
        let inverse = |nu: f64| self.engine.slope_inverse.at(nu);
        let at = inverse(nu);
        let (before, after) = (inverse(nu - STEP_NU), inverse(nu + STEP_NU));
        let first = (after - before) / (2.0 * STEP_NU);
        let second = (after + before - 2.0 * at) / (STEP_NU * STEP_NU);

        let g = |columns: f64| self.beyond_plane(s + columns * self.step, ray, x, w, band);
        let (here, left, right) = (g(0.0), g(-0.5), g(0.5));
        let slope = right - left;
        let curve = (left + right - here * 2.0) * 4.0;
        let turn = Complex64::new(0.0, -1.0 / TAU);
        (here * at + slope * turn * first + curve * (turn * turn * (0.5 * second)))
            * (1.0 / inverse(y * per_column))
    }

    /// Phase of what is left of the dilation at the pulse's ends, radians.
    fn rest_rad(&self, band: f64) -> f64 {
        PI * self.absolute_hz(band) * self.smooth.dilation_rest * self.engine.ping.duration_s
    }

    fn choose_orders(&mut self) {
        let ping = &self.engine.ping;
        let kernel = &self.engine.slope_kernel;
        let half_m = self.stretch.half_m;
        // What is left out grows by 1/D at the ends of the stretch.
        let end = self.engine.top_hz() / ping.sound_speed_m_per_s * half_m * self.step;
        let tolerance = (self.engine.fineness.series * kernel.window_gain(end)).max(1e-13);
        let slopes = [-1.0, 0.0, 1.0].map(|x| self.smooth.slope.at(x));
        let bends = [-1.0, 1.0].map(|x| self.smooth.per_range_per_m.at(x));
        let mut left_out: f64 = 0.0;
        // f of the coordinate, slope, ray and the sign of the others.
        let mut most = |f: &dyn Fn(f64, f64, Ray, f64) -> Complex64, limit: usize| {
            let (mut terms, mut rest) = (1, 0.0f64);
            for s in slopes {
                for per_range_per_m in bends {
                    for sign in [-1.0, 1.0] {
                        let ray = Ray {
                            per_range_per_m,
                            twist: sign,
                        };
                        let got = terms_needed(|x| f(x, s, ray, sign), limit, tolerance);
                        terms = terms.max(got.0);
                        rest = rest.max(got.1);
                    }
                }
            }
            left_out += rest;
            terms
        };
        let rest_rad = self.rest_rad(1.0);
        let beyond = |angle: f64| Complex64::from_polar(1.0, -angle);
        let bent = |ray: Ray, b: f64| Ray {
            per_range_per_m: self.smooth.per_range_per_m.at(b),
            ..ray
        };
        let twisted = |ray: Ray, twist: f64| Ray { twist, ..ray };
        let instants = most(
            &|w, s, ray, x| self.shape(s, ray, x, w, 1.0) * beyond(rest_rad * w),
            MOST_INSTANTS,
        );
        let along = most(&|x, s, ray, w| self.shape(s, ray, x, w, 1.0), MOST_ALONG);
        let bend = most(
            &|b, s, ray, x| self.shape(s, bent(ray, b), x, x, 1.0),
            MOST_BEND,
        );
        let twist = most(
            &|z, s, ray, x| self.shape(s, twisted(ray, z), x, x, 1.0),
            MOST_TWIST,
        );
        let dilation = most(&|d, _, _, _| beyond(rest_rad * d), MOST_DILATION);
        let band = most(
            &|b, s, ray, x| self.shape(s, ray, x, x, b) * beyond(self.rest_rad(b)),
            MOST_BAND,
        );
        let turn_rad = self.turn_rad(0, slopes[0].abs().max(slopes[2].abs()) + self.step);
        let turn = most(&|x, _, _, _| beyond(turn_rad * x), MOST_TURN);
        self.orders = Orders {
            instants,
            along,
            turn,
            band,
            dilation,
            bend,
            twist,
        };
        left_out += self.choose_channels(slopes, tolerance);
        // Swing that no curve over the slope describes.
        let per_m = TAU * self.engine.top_hz() / ping.sound_speed_m_per_s;
        let half_s = 0.5 * ping.duration_s;
        if self.engine.fineness.motion == PulseMotion::Quadratic {
            left_out += 0.5 * per_m * self.smooth.swing_rest * half_s * half_s;
        }
        // Fourth order of the delay along the stretch.
        left_out +=
            per_m * half_m.powi(4) / 8.0 * self.smooth.per_range_per_m.at(1.0).max(0.0).powi(3);
        self.left_out = left_out / kernel.window_gain(end);
    }

    /// Channels whose terms together are too small to count are left out too. Returns their sum.
    fn choose_channels(&mut self, slopes: [f64; 3], tolerance: f64) -> f64 {
        let Orders {
            dilation,
            bend,
            twist,
            ..
        } = self.orders;
        let rest_rad = self.rest_rad(1.0);
        let dilation_sizes = sizes(|d| Complex64::from_polar(1.0, -rest_rad * d), dilation + 4);
        let (mut bend_sizes, mut twist_sizes) = ([0.0f64; MOST_BEND], [0.0f64; MOST_TWIST]);
        let widen = |most: &mut [f64], found: &[f64]| {
            for (most, size) in most.iter_mut().zip(found) {
                *most = most.max(*size);
            }
        };
        for s in slopes {
            for x in [-1.0, 1.0] {
                let at = |b: f64, twist: f64| {
                    let per_range_per_m = self.smooth.per_range_per_m.at(b);
                    self.shape(
                        s,
                        Ray {
                            per_range_per_m,
                            twist,
                        },
                        x,
                        x,
                        1.0,
                    )
                };
                widen(&mut bend_sizes, &sizes(|b| at(b, 0.0), bend + 4));
                widen(&mut twist_sizes, &sizes(|z| at(0.0, z), twist + 4));
            }
        }
        let share = tolerance / (bend * twist) as f64;
        let (mut left_out, mut channels, mut len) = (0.0, 0, 0);
        for (p, z) in (0..bend).flat_map(|p| (0..twist).map(move |z| (p, z))) {
            let size = bend_sizes[p] * twist_sizes[z];
            let (mut rest, mut terms) = (0.0, dilation);
            // The first of all carries the echo itself.
            while p + z > 0 && terms > 0 && rest + dilation_sizes[terms - 1] * size <= share
                || channels + terms > MOST_CHANNELS
            {
                rest += dilation_sizes[terms - 1] * size;
                terms -= 1;
            }
            left_out += rest;
            if terms > 0 {
                self.kept[len] = Kept {
                    bend: p,
                    twist: z,
                    dilation: terms,
                };
                len += 1;
                channels += terms;
            }
        }
        self.kept_len = len;
        left_out
    }

    fn kept(&self) -> &[Kept] {
        &self.kept[..self.kept_len]
    }

    /// How far the rotor of slope `s` to the stretch's end turns from the middle of a block to its lane, radians.
    fn turn_rad(&self, lane: usize, s: f64) -> f64 {
        let step_hz = self.engine.rate_hz / self.engine.bins() as f64;
        let from_middle = lane as f64 - 0.5 * (BLOCK - 1) as f64;
        TAU * from_middle * step_hz * s * self.stretch.half_m / self.engine.ping.sound_speed_m_per_s
    }

    fn channels(&self) -> usize {
        self.kept().iter().map(|kept| kept.dilation).sum()
    }

    fn powers(&self) -> usize {
        self.orders.along + self.orders.turn - 1
    }

    fn slope(&self, column: usize) -> f64 {
        (self.first + column as isize) as f64 * self.step
    }

    fn run(&self, work: &mut Work<T>, output: &mut Vec<Complex<T>>) {
        #[cfg(target_arch = "x86_64")]
        match self.engine.dialect.kind() {
            // SAFETY: a `Dialect` of that kind is proof that the processor has these.
            Kind::Avx512 => return unsafe { self.run_avx512(work, output) },
            // SAFETY: as above.
            Kind::Avx2 => return unsafe { self.run_avx2(work, output) },
            Kind::Portable => {}
        }
        self.run_plain::<false>(work, output);
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx512f,avx512dq,avx512vl,avx2,fma")]
    fn run_avx512(&self, work: &mut Work<T>, output: &mut Vec<Complex<T>>) {
        self.run_plain::<true>(work, output);
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2,fma")]
    fn run_avx2(&self, work: &mut Work<T>, output: &mut Vec<Complex<T>>) {
        self.run_plain::<true>(work, output);
    }

    #[inline(always)]
    fn run_plain<const FUSED: bool>(&self, work: &mut Work<T>, output: &mut Vec<Complex<T>>) {
        self.spread::<FUSED>(work);
        self.columns::<FUSED>(work);
        self.to_elements::<FUSED>(work);
        self.to_time::<FUSED>(work, output);
    }

    /// Echoes onto the grid, each in all channels.
    #[inline(always)]
    fn spread<const FUSED: bool>(&self, work: &mut Work<T>) {
        let Orders {
            dilation,
            bend,
            twist,
            ..
        } = self.orders;
        let channels = self.channels();
        // Numbers per row and per echo and row: re and im beside one another.
        let width = 2 * self.columns * channels;
        work.grid.clear();
        work.grid.resize(self.engine.rows * width, T::ZERO);
        let (time, slope) = (&self.engine.time_kernel, &self.engine.slope_kernel);
        let rows_per_s = self.engine.rows as f64 * self.engine.rate_hz / self.engine.bins() as f64;
        let mut shares = [[0.0; MOST_DILATION]; 3];
        let mut each = [T::ZERO; 2 * MOST_CHANNELS];
        let each = &mut each[..2 * channels];
        let mut line = [T::ZERO; MOST_LINE];
        let line = &mut line[..2 * slope.width * channels];
        let echoes = &work.echoes;
        for i in 0..echoes.len() {
            let s = echoes.slope[i];
            let rest = self.smooth.rest(echoes, i);
            let unit = if self.smooth.dilation_rest > 0.0 {
                rest / self.smooth.dilation_rest
            } else {
                0.0
            };
            chebyshev_values(unit, &mut shares[0][..dilation]);
            let unit = self.smooth.per_range_per_m.unit(echoes.per_range_per_m[i]);
            chebyshev_values(unit, &mut shares[1][..bend]);
            let unit = if self.smooth.twist_rest > 0.0 {
                self.smooth.twist_left(echoes, i) / self.smooth.twist_rest
            } else {
                0.0
            };
            chebyshev_values(unit, &mut shares[2][..twist]);
            let mut at = 0;
            for kept in self.kept() {
                let share = shares[1][kept.bend] * shares[2][kept.twist];
                for r in &shares[0][..kept.dilation] {
                    each[at] = T::narrow(echoes.re[i] * r * share);
                    each[at + 1] = T::narrow(echoes.im[i] * r * share);
                    at += 2;
                }
            }

            let place = s / self.step + slope.shift();
            let cell = place.floor();
            let weights = taps::<T, FUSED>(&self.engine.slope_taps, 2.0 * (place - cell) - 1.0);
            let column = (cell as isize + slope.first() - self.first) as usize;
            for (values, weight) in line.chunks_exact_mut(2 * channels).zip(weights) {
                for (value, share) in values.iter_mut().zip(&*each) {
                    *value = *share * weight;
                }
            }
            let place = echoes.middle_s[i] * rows_per_s + time.shift();
            let cell = place.floor();
            let weights = taps::<T, FUSED>(&self.engine.time_taps, 2.0 * (place - cell) - 1.0);
            let row = (cell as isize + time.first()) as usize;
            for (tap, &weight) in weights[..time.width].iter().enumerate() {
                let at = (row + tap) * width + 2 * column * channels;
                for (sum, value) in work.grid[at..][..line.len()].iter_mut().zip(&*line) {
                    *sum = value.times_plus::<FUSED>(weight, *sum);
                }
            }
        }
    }

    /// Each column to frequency, and there into the powers along the stretch.
    #[inline(always)]
    fn columns<const FUSED: bool>(&self, work: &mut Work<T>) {
        let bins = self.engine.bins();
        let channels = self.channels();
        let instants = &self.engine.instants[self.orders.instants - 1];
        work.spectrum.clear_to(channels * bins);
        work.moments.clear_to(bins * self.columns * self.powers());
        self.dilation_series(work);
        for column in 0..self.columns {
            self.column_spectra(work, column);
            self.template(work, column, instants);
            for block in 0..bins / BLOCK {
                self.block::<FUSED>(work, column, block, instants);
            }
        }
    }

    /// All channels of a column to frequency.
    #[inline(always)]
    fn column_spectra(&self, work: &mut Work<T>, column: usize) {
        let (bins, rows) = (self.engine.bins(), self.engine.rows);
        let channels = self.channels();
        let width = 2 * self.columns * channels;
        let zero = Complex::new(T::ZERO, T::ZERO);
        work.column.resize(channels * rows, zero);
        for row in 0..rows {
            let at = row * width + 2 * column * channels;
            let (pairs, _) = work.grid[at..][..2 * channels].as_chunks::<2>();
            for (channel, &[re, im]) in pairs.iter().enumerate() {
                work.column[channel * rows + row] = Complex::new(re, im);
            }
        }
        self.engine
            .forward
            .process_with_scratch(&mut work.column[..channels * rows], &mut work.scratch);
        for channel in 0..channels {
            let buffer = &work.column[channel * rows..][..rows];
            // Frequencies below the centre lie at the buffer's end.
            let (below, above) = (&buffer[rows - bins / 2..], &buffer[..bins - bins / 2]);
            for (q, value) in below.iter().chain(above).enumerate() {
                work.spectrum.re[channel * bins + q] = value.re;
                work.spectrum.im[channel * bins + q] = value.im;
            }
        }
    }

    /// exp(-j psi w d) at each instant w as a series of T_r(d), its terms as powers of the frequency.
    fn dilation_series(&self, work: &mut Work<T>) {
        let Orders {
            instants,
            dilation,
            band,
            ..
        } = self.orders;
        let powers = &self.engine.powers[band - 1];
        let series = &self.engine.series[dilation - 1];
        work.dilation.clear();
        work.dilation
            .resize(instants * dilation * band, Complex64::ZERO);
        for (n, w) in chebyshev_nodes(instants).enumerate() {
            for (b, f) in chebyshev_nodes(band).enumerate() {
                let angle = self.rest_rad(f) * w;
                for (d, unit) in chebyshev_nodes(dilation).enumerate() {
                    let value = Complex64::from_polar(1.0, -angle * unit);
                    for r in 0..dilation {
                        let term = value * series[r * dilation + d];
                        for power in 0..band {
                            work.dilation[(n * dilation + r) * band + power] +=
                                term * powers[power * band + b];
                        }
                    }
                }
            }
        }
    }

    /// The column's shape as series of bend, powers along the stretch and powers of the frequency.
    fn template(&self, work: &mut Work<T>, column: usize, instants: &Instants) {
        let Orders {
            along,
            band,
            bend,
            twist,
            ..
        } = self.orders;
        let s = self.slope(column);
        work.values.clear();
        for &w in &instants.x {
            for b in chebyshev_nodes(bend) {
                for twist in chebyshev_nodes(twist) {
                    let ray = Ray {
                        per_range_per_m: self.smooth.per_range_per_m.at(b),
                        twist,
                    };
                    for x in chebyshev_nodes(along) {
                        for f in chebyshev_nodes(band) {
                            work.values.push(self.shape(s, ray, x, w, f));
                        }
                    }
                }
            }
        }
        // One dimension after the other, from the outside in.
        let engine = self.engine;
        let (values, next) = (&mut work.values, &mut work.values_next);
        along_dimension(&engine.series[bend - 1], values, next, twist * along * band);
        along_dimension(&engine.series[twist - 1], next, values, along * band);
        along_dimension(&engine.powers[along - 1], values, next, band);
        along_dimension(&engine.powers[band - 1], next, &mut work.template, 1);
    }

    /// The pulse's spectra as a column at slope `s` hears them, shifted by its Doppler: of Lagrange's polynomials of the instants.
    #[inline(always)]
    fn pulses<const FUSED: bool>(
        &self,
        s: f64,
        block: usize,
        nodes: &Instants,
    ) -> [Lanes<T>; MOST_INSTANTS] {
        let mut pulses = [Lanes::ZERO; MOST_INSTANTS];
        let bins = self.engine.bins();
        let step_hz = self.engine.rate_hz / bins as f64;
        let middle = (block * BLOCK) as f64 + 0.5 * (BLOCK - 1) as f64 - (bins / 2) as f64;
        let f_hz = middle * step_hz;
        let dilation = self.smooth.dilation(s);
        let g_hz = f_hz + (self.engine.ping.carrier_hz + f_hz) * dilation;
        let Some(place) = self.pulse.place::<BLOCK>(g_hz, 1.0 + dilation) else {
            return pulses;
        };
        let count = nodes.len();
        for j in 0..count {
            let mut term = Lanes::<T>::ZERO;
            self.pulse
                .read::<BLOCK, FUSED>(j, &place, &mut term.re, &mut term.im);
            for (n, pulse) in pulses[..count].iter_mut().enumerate() {
                let share = T::narrow(nodes.share[n * count + j]);
                for lane in 0..BLOCK {
                    pulse.re[lane] = term.re[lane].times_plus::<FUSED>(share, pulse.re[lane]);
                    pulse.im[lane] = term.im[lane].times_plus::<FUSED>(share, pulse.im[lane]);
                }
            }
        }
        pulses
    }

    /// One block of one column: channels, pulse and shape into powers along the stretch.
    #[inline(always)]
    fn block<const FUSED: bool>(
        &self,
        work: &mut Work<T>,
        column: usize,
        block: usize,
        nodes: &Instants,
    ) {
        let Orders {
            instants,
            along,
            turn,
            band,
            dilation,
            bend,
            twist,
        } = self.orders;
        let bins = self.engine.bins();
        let powers = self.powers();
        let from = block * BLOCK;
        let mut f = [T::ZERO; BLOCK];
        for (lane, f) in f.iter_mut().enumerate() {
            *f = T::narrow(((from + lane) as f64 - (bins / 2) as f64) / (bins / 2) as f64);
        }
        let s = self.slope(column);
        let pulses = self.pulses::<FUSED>(s, block, nodes);
        let mut sums = [Lanes::<T>::ZERO; MOST_ALONG + MOST_TURN];
        for (n, pulse) in pulses[..instants].iter().enumerate() {
            let mut at = from;
            for kept in self.kept() {
                let mut heard = Lanes::ZERO;
                for r in 0..kept.dilation {
                    let channel = Lanes::load(&work.spectrum, at);
                    at += bins;
                    let series = &work.dilation[(n * dilation + r) * band..][..band];
                    heard.add_product::<FUSED>(&channel, &Lanes::polynomial::<FUSED>(series, &f));
                }
                let heard = heard.times::<FUSED>(pulse);
                for (q, sum) in sums[..along].iter_mut().enumerate() {
                    let at = (((n * bend + kept.bend) * twist + kept.twist) * along + q) * band;
                    let series = &work.template[at..][..band];
                    sum.add_product::<FUSED>(&heard, &Lanes::polynomial::<FUSED>(series, &f));
                }
            }
        }
        // exp(j theta x), theta the turn within the block, times the powers so far.
        let mut theta = [T::ZERO; BLOCK];
        for (lane, theta) in theta.iter_mut().enumerate() {
            *theta = T::narrow(self.turn_rad(lane, s));
        }
        let mut total = [Lanes::<T>::ZERO; MOST_ALONG + MOST_TURN];
        for m in 0..turn {
            for q in 0..along {
                total[q + m].add(&sums[q]);
            }
            for sum in &mut sums[..along] {
                sum.turn(&theta, T::narrow(1.0 / (m + 1) as f64));
            }
        }
        for (q, lanes) in total[..powers].iter().enumerate() {
            let at = ((block * self.columns + column) * powers + q) * BLOCK;
            work.moments.re[at..][..BLOCK].copy_from_slice(&lanes.re);
            work.moments.im[at..][..BLOCK].copy_from_slice(&lanes.im);
        }
    }

    /// All columns to all elements, block by block. Elements at y and -y have conjugate rotors, and the same even and odd powers.
    #[inline(always)]
    fn to_elements<const FUSED: bool>(&self, work: &mut Work<T>) {
        let bins = self.engine.bins();
        let powers = self.powers();
        let elements = self.stretch.along_m.len();
        let c = self.engine.ping.sound_speed_m_per_s;
        let step_hz = self.engine.rate_hz / bins as f64;
        work.elements.clear_to(elements * bins);
        work.rotors.clear();
        work.rotors
            .resize(self.columns.next_multiple_of(LANES), [T::ZERO; 2]);
        for block in 0..bins / BLOCK {
            let middle = (block * BLOCK) as f64 + 0.5 * (BLOCK - 1) as f64 - (bins / 2) as f64;
            let per_m = (self.engine.ping.carrier_hz + middle * step_hz) / c;
            for e in 0..elements.div_ceil(2) {
                let y = self.stretch.along_m[e];
                let (turn, first) = (per_m * self.step * y, per_m * self.slope(0) * y);
                for (eight, rotors) in work.rotors.chunks_exact_mut(LANES).enumerate() {
                    let turns = std::array::from_fn(|k| first + turn * (eight * LANES + k) as f64);
                    let (cos, sin) = cis_lanes(turns);
                    for (k, rotor) in rotors.iter_mut().enumerate() {
                        *rotor = [T::narrow(cos[k]), T::narrow(sin[k])];
                    }
                }
                let x = T::narrow(y / self.half_m());
                let square = x * x;
                let (mut common, mut opposite) = (Lanes::ZERO, Lanes::ZERO);
                for (column, &[cos, sin]) in work.rotors[..self.columns].iter().enumerate() {
                    let at = (block * self.columns + column) * powers * BLOCK;
                    let even = every_second::<T, FUSED>(&work.moments, at, powers, 0, square);
                    common.add_real::<FUSED>(&even, cos);
                    opposite.add_imaginary::<FUSED>(&even, sin);
                    if powers > 1 {
                        let odd = every_second::<T, FUSED>(&work.moments, at, powers, 1, square);
                        common.add_imaginary::<FUSED>(&odd, sin * x);
                        opposite.add_real::<FUSED>(&odd, cos * x);
                    }
                }
                for (e, sign) in [(elements - 1 - e, -T::one()), (e, T::one())] {
                    let at = e * bins + block * BLOCK;
                    for lane in 0..BLOCK {
                        work.elements.re[at + lane] = common.re[lane] + sign * opposite.re[lane];
                        work.elements.im[at + lane] = common.im[lane] + sign * opposite.im[lane];
                    }
                }
            }
        }
    }

    /// Elements back to time.
    #[inline(always)]
    fn to_time<const FUSED: bool>(&self, work: &mut Work<T>, output: &mut Vec<Complex<T>>) {
        let bins = self.engine.bins();
        let c = self.engine.ping.sound_speed_m_per_s;
        let step_hz = self.engine.rate_hz / bins as f64;
        output.resize(
            self.stretch.along_m.len() * bins,
            Complex::new(T::ZERO, T::ZERO),
        );
        for (e, row) in output.chunks_exact_mut(bins).enumerate() {
            let y = self.stretch.along_m[e];
            for block in 0..bins / BLOCK {
                let inverse: [T; BLOCK] = self.engine.slope_inverse.block::<T, FUSED>(|lane| {
                    let offset_hz = ((block * BLOCK + lane) as f64 - (bins / 2) as f64) * step_hz;
                    y * (self.engine.ping.carrier_hz + offset_hz) / c * self.step
                });
                for (lane, inverse) in inverse.into_iter().enumerate() {
                    let q = block * BLOCK + lane;
                    let factor = inverse * T::narrow(self.engine.band[q]);
                    row[(q + bins - bins / 2) % bins] = Complex::new(
                        work.elements.re[e * bins + q] * factor,
                        work.elements.im[e * bins + q] * factor,
                    );
                }
            }
            self.engine
                .inverse
                .process_with_scratch(row, &mut work.scratch);
        }
    }
}

/// The polynomial of every second of `powers` powers from the `parity`th on, in the square of the place.
#[inline(always)]
fn every_second<T: Sample, const FUSED: bool>(
    moments: &Split<T>,
    at: usize,
    powers: usize,
    parity: usize,
    square: T,
) -> Lanes<T> {
    let last = powers - 1 - (powers - 1 - parity) % 2;
    let mut value = Lanes::load(moments, at + last * BLOCK);
    let mut q = last;
    while q > parity {
        q -= 2;
        value.horner::<FUSED>(square, &Lanes::load(moments, at + q * BLOCK));
    }
    value
}

/// Most values of one echo on one row of the grid.
const MOST_LINE: usize = 2 * MAX_WIDTH * MOST_CHANNELS;

/// T_0(x) ... into `out`.
fn chebyshev_values(x: f64, out: &mut [f64]) {
    let (mut before, mut now) = (1.0, x);
    for value in out {
        *value = before;
        (before, now) = (now, 2.0 * x * now - before);
    }
}

/// 1/D of a kernel as a polynomial in the square of the frequency.
struct InverseGain {
    /// Of 2 (nu/greatest)^2 - 1.
    powers: [f64; INVERSE_TERMS],
    scale: f64,
}

/// Terms of [`InverseGain`]: 1e-11 for the widest kernel.
const INVERSE_TERMS: usize = 16;

impl InverseGain {
    fn new(kernel: &Kernel) -> Self {
        // A little beyond the band, for differences at its end.
        let greatest = 0.5 / kernel.oversampling + 0.01;
        let matrix = powers_from_nodes(INVERSE_TERMS);
        let values: Vec<f64> = chebyshev_nodes(INVERSE_TERMS)
            .map(|x| 1.0 / kernel.window_gain((0.5 * (x + 1.0)).sqrt() * greatest))
            .collect();
        let mut powers = [0.0; INVERSE_TERMS];
        for (power, row) in powers.iter_mut().zip(matrix.chunks(INVERSE_TERMS)) {
            *power = row.iter().zip(&values).map(|(a, b)| a * b).sum();
        }
        Self {
            powers,
            scale: 2.0 / (greatest * greatest),
        }
    }

    #[inline(always)]
    fn at(&self, nu: f64) -> f64 {
        let x = nu * nu * self.scale - 1.0;
        self.powers.iter().rev().fold(0.0, |sum, c| sum * x + c)
    }

    #[inline(always)]
    fn block<T: Sample, const FUSED: bool>(&self, nu: impl Fn(usize) -> f64) -> [T; BLOCK] {
        let mut x = [T::ZERO; BLOCK];
        for (lane, x) in x.iter_mut().enumerate() {
            *x = T::narrow(nu(lane) * nu(lane) * self.scale - 1.0);
        }
        let mut sum = [T::ZERO; BLOCK];
        for c in self.powers.iter().rev() {
            let c = T::narrow(*c);
            for lane in 0..BLOCK {
                sum[lane] = sum[lane].times_plus::<FUSED>(x[lane], c);
            }
        }
        sum
    }
}

/// Weights of all taps for one power of x.
type Taps<T> = [T; MAX_WIDTH];

fn tap_tables<T: Sample>(kernel: &Kernel) -> Vec<Taps<T>> {
    (0..kernel.moments)
        .map(|k| {
            let mut taps = [T::ZERO; MAX_WIDTH];
            for (i, tap) in taps[..kernel.width].iter_mut().enumerate() {
                *tap = T::narrow(kernel.weight(k, i));
            }
            taps
        })
        .collect()
}

/// Weights of all taps at `x`, -1..1 across the cell.
#[inline(always)]
fn taps<T: Sample, const FUSED: bool>(tables: &[Taps<T>], x: f64) -> Taps<T> {
    let x = T::narrow(x);
    let mut sum = [T::ZERO; MAX_WIDTH];
    for table in tables.iter().rev() {
        for (sum, weight) in sum.iter_mut().zip(table) {
            *sum = sum.times_plus::<FUSED>(x, *weight);
        }
    }
    sum
}

fn sinc(x: f64) -> f64 {
    if x == 0.0 {
        1.0
    } else {
        libm::sin(PI * x) / (PI * x)
    }
}

/// Applies a square matrix along one dimension of `from`: that with `inner` values between neighbours.
fn along_dimension(matrix: &[f64], from: &[Complex64], to: &mut Vec<Complex64>, inner: usize) {
    let count = matrix.len().isqrt();
    to.clear();
    to.resize(from.len(), Complex64::ZERO);
    for (from, to) in from
        .chunks_exact(count * inner)
        .zip(to.chunks_exact_mut(count * inner))
    {
        for i in 0..count {
            for j in 0..count {
                let share = matrix[i * count + j];
                for k in 0..inner {
                    to[i * inner + k] += from[j * inner + k] * share;
                }
            }
        }
    }
}

/// A block of complex numbers, split.
#[derive(Clone, Copy)]
struct Lanes<T> {
    re: [T; BLOCK],
    im: [T; BLOCK],
}

impl<T: Sample> Lanes<T> {
    const ZERO: Self = Self {
        re: [T::ZERO; BLOCK],
        im: [T::ZERO; BLOCK],
    };

    #[inline(always)]
    fn load(from: &Split<T>, at: usize) -> Self {
        let mut lanes = Self::ZERO;
        lanes.re.copy_from_slice(&from.re[at..][..BLOCK]);
        lanes.im.copy_from_slice(&from.im[at..][..BLOCK]);
        lanes
    }

    /// A polynomial with complex coefficients at real `x`.
    #[inline(always)]
    fn polynomial<const FUSED: bool>(series: &[Complex64], x: &[T; BLOCK]) -> Self {
        let mut lanes = Self::ZERO;
        for c in series.iter().rev() {
            let (re, im) = (T::narrow(c.re), T::narrow(c.im));
            for (j, &x) in x.iter().enumerate() {
                lanes.re[j] = lanes.re[j].times_plus::<FUSED>(x, re);
                lanes.im[j] = lanes.im[j].times_plus::<FUSED>(x, im);
            }
        }
        lanes
    }

    #[inline(always)]
    fn add(&mut self, a: &Self) {
        for j in 0..BLOCK {
            self.re[j] = self.re[j] + a.re[j];
            self.im[j] = self.im[j] + a.im[j];
        }
    }

    #[inline(always)]
    fn add_product<const FUSED: bool>(&mut self, a: &Self, b: &Self) {
        for j in 0..BLOCK {
            let re = a.re[j].times_plus::<FUSED>(b.re[j], self.re[j]);
            let im = a.re[j].times_plus::<FUSED>(b.im[j], self.im[j]);
            self.re[j] = (-a.im[j]).times_plus::<FUSED>(b.im[j], re);
            self.im[j] = a.im[j].times_plus::<FUSED>(b.re[j], im);
        }
    }

    #[inline(always)]
    fn times<const FUSED: bool>(&self, b: &Self) -> Self {
        let mut product = Self::ZERO;
        product.add_product::<FUSED>(self, b);
        product
    }

    /// Times j theta scale.
    #[inline(always)]
    fn turn(&mut self, theta: &[T; BLOCK], scale: T) {
        for (j, &theta) in theta.iter().enumerate() {
            let angle = theta * scale;
            (self.re[j], self.im[j]) = (T::ZERO - self.im[j] * angle, self.re[j] * angle);
        }
    }

    #[inline(always)]
    fn horner<const FUSED: bool>(&mut self, x: T, next: &Self) {
        for j in 0..BLOCK {
            self.re[j] = self.re[j].times_plus::<FUSED>(x, next.re[j]);
            self.im[j] = self.im[j].times_plus::<FUSED>(x, next.im[j]);
        }
    }

    /// Adds `a` times a real number.
    #[inline(always)]
    fn add_real<const FUSED: bool>(&mut self, a: &Self, by: T) {
        for j in 0..BLOCK {
            self.re[j] = a.re[j].times_plus::<FUSED>(by, self.re[j]);
            self.im[j] = a.im[j].times_plus::<FUSED>(by, self.im[j]);
        }
    }

    /// Adds `a` times an imaginary number.
    #[inline(always)]
    fn add_imaginary<const FUSED: bool>(&mut self, a: &Self, by: T) {
        for j in 0..BLOCK {
            self.re[j] = (-a.im[j]).times_plus::<FUSED>(by, self.re[j]);
            self.im[j] = a.re[j].times_plus::<FUSED>(by, self.im[j]);
        }
    }
}
