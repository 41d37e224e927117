//! The engine of one line array: tables made once, settings of a ping, and the buffers of a thread.

use std::sync::Arc;

use echotank_fft::Fft;
use num_complex::{Complex, Complex64};

use crate::array::gridded::kernel::Kernel;
use crate::array::gridded::transform::grid_size;
use crate::arrivals::{LineSection, LineSource};
use echotank_core::arrays::ArrayGeometry;
use echotank_core::ping::{EchoCounts, PingPlan};
use echotank_core::simd::SimdLevel;

use super::columns::Entry;
use super::elements::PairSums;
use super::lanes::{BLOCK, Lanes, Split};
use super::merge::Merge;
use super::panel::{PanelFft, Row};
use super::pulse::{MAX_INSTANTS, PulseSpectra};
use super::sample::Sample;
use super::series::{powers_from_nodes, series_from_nodes};
use super::smooth::{Echoes, Smooth};
use super::spread::{Centring, Mixing, Prepared, Spread, Survey};
use super::stages::{self, Stage, Stages};
use super::task::{MAX_ALONG, Task};
use super::weights::{InverseGain, Taps, tap_tables};

/// Blocks of bins where the filter gain is below this multiple of the error allowed per series are
/// set to zero.
const FILTERED: f64 = 0.1;
/// Share of the error allowed per series that is given to following the bow to second order.
const BOW_SHARE: f64 = 0.1;
/// Margins on the surveyed spans of a task, tried in turn until all echoes lie within.
const MARGINS: [f64; 3] = [0.03, 0.3, 3.0];

/// Model of the pulse during an echo.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PulseMotion {
    /// Uniformly stretched about the leading edge, as `direct` computes it under
    /// `DopplerModel::Stretch`.
    Stretch,
    /// Stretch with a constant rate of change; equals the reference to third order.
    Quadratic,
}

/// Resolution of the computation, chosen by [`super::plan`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Resolution {
    /// Elements of one section of the line.
    pub section_elements: usize,
    /// Output samples of one slab, a multiple of 32.
    pub slab_samples: usize,
    /// Width of the kernel over time, grid rows.
    pub time_width: usize,
    /// Width of the kernel over slope, grid columns.
    pub slope_width: usize,
    /// Smallest number of rows per bin that is used.
    pub time_oversampling: f64,
    /// Central share of the band that the kernel over time is designed for; beyond it the pulse has
    /// almost no energy.
    pub time_core: f64,
    /// Columns per cycle of the aperture, relative to the sampling limit.
    pub slope_oversampling: f64,
    /// Moments of the kernels.
    pub moments: usize,
    /// Truncation error allowed per series, relative to an echo.
    pub series: f64,
    /// Error allowed over a whole slab, relative to its echoes.
    pub far: f64,
    /// Model of the pulse during an echo.
    pub motion: PulseMotion,
}

/// The receiver filter as a transfer function.
pub struct Filter<'a> {
    /// Gain at an offset from the centre frequency, Hz.
    pub gain: &'a dyn Fn(f64) -> f64,
    /// Half the length of the impulse response, seconds.
    pub half_s: f64,
}

/// Lengths of the series of one task.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Orders {
    /// Instants of the emission.
    pub instants: usize,
    /// Kinds of values in the channels: the echoes, and separate terms that vary along the section
    /// or during the pulse.
    pub kinds: usize,
    /// Powers of the position along the section, without the rotation inside a block.
    pub along: usize,
    /// Powers of the position along the section, with the rotation inside a block.
    pub turn: usize,
    /// Powers of the frequency.
    pub band: usize,
    /// Terms for the residual of the dilation. A channel is a product of dilation, curvature and rate
    /// gradient.
    pub dilation: usize,
    /// Terms for the curvature.
    pub curvature: usize,
    /// Terms for the residual of the rate gradient.
    pub rate_gradient: usize,
}

/// Statistics of one task.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct TaskReport {
    /// Elements of the section.
    pub elements: usize,
    /// Echoes of the slab.
    pub echoes: usize,
    /// Rows of the grid, which is the length of its transforms.
    pub rows: usize,
    /// Bins in the pass band of the receiver filter.
    pub passed_bins: usize,
    /// Columns of the grid.
    pub columns: usize,
    /// Channels of the grid.
    pub channels: usize,
    /// Products of kind, dilation, curvature and rate gradient, of which the channels are sums.
    pub products: usize,
    /// Coefficients of a template.
    pub entries: usize,
    /// Powers of the position along the section.
    pub powers: usize,
    /// Lengths of the series.
    pub orders: Orders,
    /// Bound on the truncation error of the series, relative to an echo.
    pub left_out: f64,
    /// Time spent in each stage.
    pub stages: Stages,
}

/// One section of the line.
#[derive(Clone, Debug)]
pub(super) struct Section {
    pub first: usize,
    pub middle_m: f64,
    /// Position of each element relative to the middle.
    pub along_m: Vec<f64>,
    pub half_m: f64,
}

/// The engine of one receive array.
pub struct LineEngine<T: Sample> {
    pub(super) resolution: Resolution,
    pub(super) rate_hz: f64,
    pub(super) filter_half_s: f64,
    /// Platform speed that the tables of the pulse allow for.
    pub(super) fastest_m_per_s: f64,
    pub(super) simd_level: SimdLevel,
    pub(super) sections: Vec<Section>,
    pub(super) time_kernel: Kernel,
    pub(super) slope_kernel: Kernel,
    pub(super) time_taps: Vec<Taps<T>>,
    pub(super) slope_taps: Vec<Taps<T>>,
    pub(super) slope_inverse: InverseGain,
    pub(super) rows: usize,
    pub(super) forward: PanelFft<T>,
    pub(super) inverse: Arc<dyn Fft<T>>,
    /// Blocks of bins in the pass band.
    pub(super) blocks: std::ops::Range<usize>,
    /// Per bin, from -rate/2: filter, time kernel, bin width.
    pub(super) band: Vec<f64>,
    pub(super) powers: Vec<Vec<f64>>,
    pub(super) series: Vec<Vec<f64>>,
    pub(super) pulse: Option<PulseSpectra<T>>,
    pub(super) ping: Ping,
}

/// Settings of one ping.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Ping {
    pub sound_speed_m_per_s: f64,
    pub carrier_hz: f64,
    pub duration_s: f64,
    pub(crate) nepers_per_m: f64,
    pub first_sample_s: f64,
    pub slabs: usize,
    /// Leading edges of the first slab begin here. Each further slab begins `slab_s` later.
    pub(crate) first_edge_s: f64,
    pub(crate) slab_s: f64,
}

/// Buffers of one thread.
pub struct Work<T: Sample> {
    pub(super) stages: Stages,
    echoes: Echoes,
    pub(super) merge: Merge,
    pub(super) prepared: Box<Prepared<T>>,
    pub(super) mixing: Mixing<T>,
    /// `[panel][row]`; the lanes of a panel are consecutive elements of `[column][channel]`.
    pub(super) grid: Vec<Row<T>>,
    /// Whether the whole grid is zero.
    pub(super) cleared: bool,
    /// Two buffers of one panel.
    pub(super) panel: [Vec<Row<T>>; 2],
    pub(super) scratch: Vec<Complex<T>>,
    /// `[block][column][channel][lane]`.
    pub(super) spectrum: Split<T>,
    /// Of one block and the current columns: `[column][power][lane]`.
    pub(super) moments: Split<T>,
    /// `[instant][kind][curvature][rate_gradient]`, then `[instant][channel]`; `[power along][power of
    /// frequency]`.
    pub(super) values: Vec<Complex64>,
    pub(super) values_next: Vec<Complex64>,
    /// `[slope][power of frequency][instant][channel][power along]`; then with terms of the
    /// emission in place of instants, in `values`.
    pub(super) all_shapes: Vec<Complex64>,
    /// Largest value of each channel and power along the section.
    pub(super) most: Vec<f64>,
    /// Largest value of each coefficient, and its index.
    pub(super) sizes: Vec<(f64, usize)>,
    /// Sources in use: term of the emission times channels, plus channel.
    pub(super) sources: Vec<usize>,
    /// Entries of the shapes that matter, power by power.
    pub(super) entries: Vec<Entry>,
    /// Powers along the section that have entries, without and with those that the rotation inside
    /// a block adds.
    pub(super) along: usize,
    pub(super) powers: usize,
    /// `[slope][power of frequency][entry]`.
    pub(super) shapes: Split<T>,
    /// `[column][slope]`
    pub(super) shares: Vec<T>,
    /// Of one block, at each slope: value at its middle, and slope over frequency.
    pub(super) chords: [Split<T>; 2],
    /// The same for one column.
    pub(super) here: [Split<T>; 2],
    /// Residual of the dilation: `[instant][dilation][frequency]`.
    pub(super) dilation: Vec<Complex64>,
    /// The pulse received by a column in one block, by terms of the emission; and its powers along
    /// the section, without and with the rotation.
    pub(super) pulses: Vec<Lanes<T>>,
    pub(super) of_powers: [Vec<Lanes<T>>; 2],
    /// Spectra of the sources in one block of one column.
    pub(super) sounds: Vec<Lanes<T>>,
    /// Of one block, by pair of elements and column: cosine and sine.
    pub(super) rotors: Vec<[T; 2]>,
    /// Of one block, pair by pair; and the positions of the pairs, relative to half the section.
    pub(super) sums: Vec<PairSums<T>>,
    pub(super) places: Vec<T>,
    /// `[element][bin]`.
    pub(super) elements: Split<T>,
}
impl<T: Sample> LineEngine<T> {
    /// Prepares the engine of `array` at a sample rate of `rate_hz` (Hz).
    pub fn new(
        array: &ArrayGeometry,
        rate_hz: f64,
        filter: Filter,
        resolution: Resolution,
        simd_level: SimdLevel,
    ) -> Self {
        let bins = resolution.slab_samples;
        assert!(bins.is_multiple_of(BLOCK) && bins > 0, "{bins} samples");
        assert!(
            resolution.section_elements > 0,
            "a section without elements"
        );
        let step_hz = rate_hz / bins as f64;
        let gain: Vec<f64> = (0..bins)
            .map(|q| (filter.gain)((q as f64 - (bins / 2) as f64) * step_hz))
            .collect();
        let blocks = passed_blocks(&gain, FILTERED * resolution.series);
        // Accuracy matters only in the pass band.
        let passed_bins = 2 * (bins / 2 - BLOCK * blocks.start).max(BLOCK * blocks.end - bins / 2);
        let rows = grid_size((passed_bins as f64 * resolution.time_oversampling).ceil() as usize)
            .max(bins);
        let time_kernel = Kernel::new(
            resolution.time_width,
            rows as f64 / passed_bins as f64 / resolution.time_core,
            resolution.moments,
        );
        let slope_kernel = Kernel::new(
            resolution.slope_width,
            resolution.slope_oversampling,
            resolution.moments,
        );
        let passed_range = BLOCK * blocks.start..BLOCK * blocks.end;
        let band = (0..bins)
            .map(|q| {
                if !passed_range.contains(&q) {
                    return 0.0;
                }
                let bin = q as f64 - (bins / 2) as f64;
                gain[q] * step_hz / time_kernel.window_gain(bin / rows as f64)
            })
            .collect();
        let count = array.elements.div_ceil(resolution.section_elements);
        let sections = (0..count)
            .map(|s| {
                // Sections as equal as whole elements allow.
                let (first, end) = (s * array.elements / count, (s + 1) * array.elements / count);
                let middle_m = 0.5 * (array.along_m(first) + array.along_m(end - 1));
                let along_m: Vec<f64> = (first..end).map(|e| array.along_m(e) - middle_m).collect();
                Section {
                    first,
                    middle_m,
                    half_m: along_m[along_m.len() - 1],
                    along_m,
                }
            })
            .collect();
        let most = MAX_INSTANTS.max(MAX_ALONG);
        Self {
            resolution,
            rate_hz,
            filter_half_s: filter.half_s,
            fastest_m_per_s: 5.0,
            simd_level,
            sections,
            time_taps: tap_tables(&time_kernel),
            slope_taps: tap_tables(&slope_kernel),
            slope_inverse: InverseGain::new(&slope_kernel),
            time_kernel,
            slope_kernel,
            rows,
            forward: PanelFft::new(rows),
            blocks,
            inverse: T::plan_inverse(bins),
            band,
            powers: (1..=most).map(powers_from_nodes).collect(),
            series: (1..=most).map(series_from_nodes).collect(),
            pulse: None,
            ping: Ping::default(),
        }
    }

    /// Sizes the tables for platforms up to this speed, m/s, so that they need no rebuild.
    pub fn with_room_for(mut self, fastest_m_per_s: f64) -> Self {
        self.fastest_m_per_s = self.fastest_m_per_s.max(1.1 * fastest_m_per_s);
        self
    }

    /// Distance in rows between panels of the grid. One spare row avoids mapping all panels to the
    /// same cache sets.
    pub(super) fn panel_rows(&self) -> usize {
        self.rows + 1
    }

    /// Largest time difference between the middle and the ends of a section, filter included,
    /// seconds.
    fn beside_s(&self, sound_speed_m_per_s: f64) -> f64 {
        let halves_m = self.sections.iter().map(|section| section.half_m);
        self.filter_half_s + halves_m.fold(0.0, f64::max) / sound_speed_m_per_s
    }

    pub(super) fn bins(&self) -> usize {
        self.resolution.slab_samples
    }

    /// Allocates buffers for one thread.
    pub fn work(&self) -> Work<T> {
        let zero = Complex::new(T::ZERO, T::ZERO);
        Work {
            stages: Stages::default(),
            echoes: Echoes::default(),
            merge: Merge::default(),
            prepared: Box::default(),
            mixing: Mixing::default(),
            grid: Vec::new(),
            cleared: true,
            panel: std::array::from_fn(|_| vec![Row::ZERO; self.forward.room()]),
            scratch: vec![zero; self.inverse.get_inplace_scratch_len()],
            spectrum: Split::default(),
            moments: Split::default(),
            values: Vec::new(),
            values_next: Vec::new(),
            all_shapes: Vec::new(),
            most: Vec::new(),
            sizes: Vec::new(),
            sources: Vec::new(),
            entries: Vec::new(),
            along: 0,
            powers: 0,
            shapes: Split::default(),
            shares: Vec::new(),
            chords: Default::default(),
            here: Default::default(),
            dilation: Vec::new(),
            pulses: Vec::new(),
            of_powers: Default::default(),
            sounds: Vec::new(),
            rotors: Vec::new(),
            sums: Vec::new(),
            places: Vec::new(),
            elements: Split::default(),
        }
    }

    /// Calls [`Self::prepare_from`] with the first instant of the record.
    pub fn prepare(&mut self, plan: &PingPlan) {
        self.prepare_from(plan, f64::NEG_INFINITY);
    }

    /// Sets the engine to a ping none of whose echoes begin before `earliest_s`: the slabs, and the
    /// spectra of the pulse if they changed.
    pub fn prepare_from(&mut self, plan: &PingPlan, earliest_s: f64) {
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
            // Margin for a platform that accelerates.
            let reach_hz = half_hz + shift((1.5 * speed).max(self.fastest_m_per_s));
            self.pulse = Some(PulseSpectra::new(
                pulse,
                reach_hz,
                self.rate_hz / self.bins() as f64,
            ));
        }
        // An echo lasts T, give or take its stretch; the filter adds to both sides.
        let echo_s = pulse.duration_s * (1.0 + 3.0 * speed / c);
        let beside_s = self.beside_s(c);
        let max_s = (self.bins() - 2) as f64 / self.rate_hz - echo_s - 2.0 * beside_s;
        assert!(max_s > 0.0, "slabs shorter than a filtered echo");
        let last_edge_s = plan.window_s(self.rate_hz) + beside_s;
        let first_edge_s = (plan.first_sample_s - echo_s - beside_s)
            .max(earliest_s)
            .min(last_edge_s);
        // Equal slabs balance the load of the threads. Rounding must not add a slab.
        let all_s = (last_edge_s - first_edge_s).max(1e-3 * max_s);
        let slabs = (all_s / max_s - 1e-9).ceil().max(1.0);
        self.ping = Ping {
            sound_speed_m_per_s: c,
            carrier_hz,
            duration_s: pulse.duration_s,
            nepers_per_m: plan.absorption_db_per_m * std::f64::consts::LN_10 / 20.0,
            first_sample_s: plan.first_sample_s,
            slabs: slabs as usize,
            first_edge_s,
            slab_s: all_s / slabs,
        };
    }

    /// Number of tasks of this ping: slabs times sections, section by section.
    pub fn tasks(&self) -> usize {
        self.ping.slabs * self.sections.len()
    }

    /// Number of slabs of this ping.
    pub fn slabs(&self) -> usize {
        self.ping.slabs
    }

    fn section(&self, task: usize) -> &Section {
        &self.sections[task / self.ping.slabs]
    }

    fn slab(&self, task: usize) -> usize {
        task % self.ping.slabs
    }

    /// The echoes that a task needs.
    pub fn wanted(&self, task: usize) -> LineSection {
        let section = self.section(task);
        let ping = &self.ping;
        let edge_s = |slab: usize| ping.first_edge_s + slab as f64 * ping.slab_s;
        LineSection {
            middle_m: section.middle_m,
            half_m: section.half_m,
            gain_terms: false,
            elements: section.along_m.len() as u64,
            earliest_s: edge_s(self.slab(task)),
            latest_s: edge_s(self.slab(task) + 1),
        }
    }

    /// First sample of a slab's output, relative to the record.
    fn slab_start(&self, slab: usize) -> isize {
        let ping = &self.ping;
        let beside_s = self.beside_s(ping.sound_speed_m_per_s);
        let from_s = ping.first_edge_s + slab as f64 * ping.slab_s - beside_s;
        ((from_s - ping.first_sample_s) * self.rate_hz).floor() as isize
    }

    /// Adds the slabs of an element in order. `outputs(task)` is the output of [`Self::run`].
    pub fn assemble<'a>(
        &self,
        outputs: impl Fn(usize) -> &'a [Complex<T>],
        element: usize,
        record: &mut [Complex64],
    ) {
        record.fill(Complex64::ZERO);
        let Some(s) = self
            .sections
            .iter()
            .rposition(|section| section.first <= element)
        else {
            return;
        };
        let bins = self.bins();
        for slab in 0..self.ping.slabs {
            let output = outputs(s * self.ping.slabs + slab);
            if output.is_empty() {
                continue;
            }
            let row = &output[(element - self.sections[s].first) * bins..][..bins];
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

    /// Largest frequency of the band, Hz.
    pub(super) fn top_hz(&self) -> f64 {
        self.ping.carrier_hz + 0.5 * self.rate_hz
    }

    pub(super) fn rows_per_s(&self) -> f64 {
        self.rows as f64 * self.rate_hz / self.bins() as f64
    }

    /// Columns per unit of slope for a section at rest; motion needs more.
    fn columns_per_slope(&self, half_m: f64) -> f64 {
        let ping = &self.ping;
        let reach_m = half_m.max(0.25 * ping.sound_speed_m_per_s / ping.carrier_hz);
        2.0 * self.resolution.slope_oversampling * reach_m * self.top_hz()
            / ping.sound_speed_m_per_s
    }

    /// Smallest half span of slopes for which the dilation may be curved over slope. Columns reach
    /// half a kernel beyond the span. Over a narrower span a quadratic would grow there and turn
    /// templates by many radians across a block of frequencies.
    fn min_bow(&self, half_m: f64) -> f64 {
        0.5 * self.slope_kernel.width as f64 / self.columns_per_slope(half_m)
    }

    /// Largest curvature of the dilation over slope. Templates follow the change from column to
    /// column to second order, so the error is the cube of the phase between columns.
    fn steepest_bow(&self, half_m: f64) -> f64 {
        let turn_rad = (BOW_SHARE * self.resolution.series).cbrt();
        turn_rad * self.columns_per_slope(half_m)
            / (std::f64::consts::PI * self.top_hz() * self.ping.duration_s)
    }

    /// Computes one task: echoes from `source` to samples, element by element, each of slab length.
    /// Resizes `output`, which stays empty without echoes.
    pub fn run(
        &self,
        task: usize,
        source: &impl LineSource,
        work: &mut Work<T>,
        output: &mut Vec<Complex<T>>,
    ) -> (EchoCounts, TaskReport) {
        output.clear();
        let wanted = self.wanted(task);
        let slab_s = self.slab_start(self.slab(task)) as f64 / self.rate_hz;
        let first_s = self.ping.first_sample_s + slab_s;
        let centring = Centring::new(&self.ping, self.resolution.motion, first_s);
        let mut since = stages::now();
        work.stages = Stages::default();
        work.echoes.clear();
        let mut survey = Survey {
            echoes: &mut work.echoes,
            centring,
            chunks: 0,
        };
        source.survey(wanted, &mut survey);
        let (mut counts, mut report) = (EchoCounts::default(), TaskReport::default());
        if work.echoes.is_empty() {
            return (counts, report);
        }
        let window_s = 0.5 * self.ping.duration_s;
        let half_m = self.section(task).half_m;
        let surveyed = Smooth::of(
            &work.echoes,
            window_s,
            half_m,
            self.min_bow(half_m),
            self.steepest_bow(half_m),
        );
        work.stages.lap(Stage::Survey, &mut since);
        for margin in MARGINS {
            let numbers = Task::new(
                self,
                self.section(task),
                surveyed.widened(margin),
                &work.echoes,
                &mut work.merge,
            );
            work.stages.lap(Stage::Orders, &mut since);
            let gain_terms = numbers.gain_terms();
            let mut spread = Spread::new(&numbers, centring, work);
            counts = source.walk(
                LineSection {
                    gain_terms,
                    ..wanted
                },
                &mut spread,
            );
            let (echoes, beyond, spent) = (spread.echoes, spread.beyond, spread.spent);
            work.stages.lap(Stage::Walk, &mut since);
            work.stages.transfer(Stage::Walk, Stage::Spread, spent);
            if beyond > 0 && margin != MARGINS[MARGINS.len() - 1] {
                continue;
            }
            if echoes > 0 {
                numbers.run(work, output);
            }
            report = TaskReport {
                elements: self.section(task).along_m.len(),
                echoes,
                rows: self.rows,
                passed_bins: numbers.passed_bins(),
                columns: numbers.columns,
                channels: numbers.channels(),
                products: numbers.products().count(),
                entries: work.entries.len(),
                powers: work.powers,
                orders: numbers.orders,
                left_out: numbers.left_out + if beyond > 0 { 1.0 } else { 0.0 },
                stages: work.stages,
            };
            break;
        }
        (counts, report)
    }
}

/// Range of blocks where the filter gain exceeds `least` of its maximum.
fn passed_blocks(gain: &[f64], least: f64) -> std::ops::Range<usize> {
    let most = gain.iter().fold(0.0, |most: f64, g| most.max(g.abs()));
    let passes = |block: &[f64]| block.iter().any(|g| g.abs() > least * most);
    let first = gain.chunks(BLOCK).position(passes).unwrap_or(0);
    let last = gain.chunks(BLOCK).rposition(passes).unwrap_or(0);
    first..last + 1
}
