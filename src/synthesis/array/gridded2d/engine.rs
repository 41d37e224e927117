//! The engine of one line array: what is made once, what a ping sets, and the buffers of a thread.

use std::sync::Arc;
use std::time::Instant;

use echotank_fft::Fft;
use num_complex::{Complex, Complex64};

use crate::array::gridded::kernel::Kernel;
use crate::array::gridded::simd_level::SimdLevel;
use crate::array::gridded::transform::grid_size;
use echotank_core::flow::{ArrayGeometry, EchoCounts, LineSource, LineStretch, PingPlan};

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
use super::stages::{Stage, Stages};
use super::task::{MAX_ALONG, Task};
use super::weights::{InverseGain, Taps, tap_tables};

/// Blocks of bins where the filter leaves less than this much of what each series may leave are zero.
const FILTERED: f64 = 0.1;
/// Of what each series may leave out, what following the bow to second order may.
const BOW_SHARE: f64 = 0.1;
/// By how much more than surveyed the spans of a task are taken, until all echoes lie within.
const MARGINS: [f64; 3] = [0.03, 0.3, 3.0];

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
    /// Rows per bin that is heard, at least; columns per cycle of the aperture, over the least that sampling asks for.
    pub time_oversampling: f64,
    /// Of the band, the part about its middle that the kernel over time is made for: beyond it there is next to nothing of the pulse.
    pub time_core: f64,
    pub slope_oversampling: f64,
    /// Of the kernels.
    pub moments: usize,
    /// What each series may leave out, relative to an echo.
    pub series: f64,
    /// What may be left all over a slab, relative to its echoes.
    pub far: f64,
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
    /// What channels carry: the echoes themselves, and what changes along the stretch or during the pulse in ways of their own.
    pub kinds: usize,
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
    pub elements: usize,
    pub echoes: usize,
    /// Of the grid, and its transforms' length.
    pub rows: usize,
    /// Bins that the receiver filter leaves.
    pub heard: usize,
    pub columns: usize,
    pub channels: usize,
    /// What those are sums of: products of kind, dilation, bend and twist.
    pub products: usize,
    /// Coefficients of a template, and powers along the stretch.
    pub entries: usize,
    pub powers: usize,
    pub orders: Orders,
    /// Bound on what the series leave out, relative to an echo.
    pub left_out: f64,
    pub stages: Stages,
}

/// One stretch of the line.
#[derive(Clone, Debug)]
pub(super) struct Stretch {
    pub first: usize,
    pub middle_m: f64,
    /// Of each element from the middle.
    pub along_m: Vec<f64>,
    pub half_m: f64,
}

/// The engine of one receive array.
pub struct LineEngine<T: Sample> {
    pub(super) fineness: Fineness,
    pub(super) rate_hz: f64,
    pub(super) filter_half_s: f64,
    /// Room in the tables of the pulse.
    pub(super) fastest_m_per_s: f64,
    pub(super) simd_level: SimdLevel,
    pub(super) stretches: Vec<Stretch>,
    pub(super) time_kernel: Kernel,
    pub(super) slope_kernel: Kernel,
    pub(super) time_taps: Vec<Taps<T>>,
    pub(super) slope_taps: Vec<Taps<T>>,
    pub(super) slope_inverse: InverseGain,
    pub(super) rows: usize,
    pub(super) forward: PanelFft<T>,
    pub(super) inverse: Arc<dyn Fft<T>>,
    /// Blocks of bins that the filter leaves.
    pub(super) blocks: std::ops::Range<usize>,
    /// Per bin, from -rate/2: filter, time kernel, bin width.
    pub(super) band: Vec<f64>,
    pub(super) powers: Vec<Vec<f64>>,
    pub(super) series: Vec<Vec<f64>>,
    pub(super) pulse: Option<PulseSpectra<T>>,
    pub(super) ping: Ping,
}

/// What a ping sets.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Ping {
    pub sound_speed_m_per_s: f64,
    pub carrier_hz: f64,
    pub duration_s: f64,
    pub(crate) nepers_per_m: f64,
    pub first_sample_s: f64,
    pub slabs: usize,
    /// Leading edges of the first slab begin here, and of each next one so much later.
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
    /// `[panel][row]`, a panel's lanes from `[column][channel]` as they come.
    pub(super) grid: Vec<Row<T>>,
    /// Whether all of it is zeros.
    pub(super) cleared: bool,
    /// Two buffers of one panel.
    pub(super) panel: [Vec<Row<T>>; 2],
    pub(super) scratch: Vec<Complex<T>>,
    /// `[block][column][channel][lane]`.
    pub(super) spectrum: Split<T>,
    /// Of one block and the columns at hand: `[column][power][lane]`.
    pub(super) moments: Split<T>,
    /// `[instant][kind][bend][twist]`, then `[instant][channel]`; `[power along][power of frequency]`.
    pub(super) values: Vec<Complex64>,
    pub(super) values_next: Vec<Complex64>,
    /// `[slope][power of frequency][instant][channel][power along]`; then with terms of the emission for instants, in `values`.
    pub(super) all_shapes: Vec<Complex64>,
    /// Of each channel and power along the stretch, the most that it is.
    pub(super) most: Vec<f64>,
    /// Of every coefficient the most that it is, and its place.
    pub(super) sizes: Vec<(f64, usize)>,
    /// The sounds that any is of: term of the emission times channels and channel.
    pub(super) sources: Vec<usize>,
    /// Those of the shapes that count, power by power.
    pub(super) entries: Vec<Entry>,
    /// Powers along the stretch that there are entries of, and with those that the turn inside a block adds.
    pub(super) along: usize,
    pub(super) powers: usize,
    /// `[slope][power of frequency][entry]`.
    pub(super) shapes: Split<T>,
    /// `[column][slope]`
    pub(super) shares: Vec<T>,
    /// Of one block, at each slope: value at its middle, and rise.
    pub(super) chords: [Split<T>; 2],
    /// The same of one column.
    pub(super) here: [Split<T>; 2],
    /// What is left of the dilation: `[instant][dilation][frequency]`.
    pub(super) dilation: Vec<Complex64>,
    /// The pulse as a column hears it in one block, by terms of the emission; and its powers along the stretch, without and with the turn.
    pub(super) pulses: Vec<Lanes<T>>,
    pub(super) of_powers: [Vec<Lanes<T>>; 2],
    /// Of one block of one column: each of the sources.
    pub(super) sounds: Vec<Lanes<T>>,
    /// Of one block, by pair of elements and column: cosine and sine.
    pub(super) rotors: Vec<[T; 2]>,
    /// Of one block, pair by pair; and the pairs' places, of the half stretch.
    pub(super) sums: Vec<PairSums<T>>,
    pub(super) places: Vec<T>,
    /// `[element][bin]`.
    pub(super) elements: Split<T>,
}
impl<T: Sample> LineEngine<T> {
    pub fn new(
        array: &ArrayGeometry,
        rate_hz: f64,
        filter: Filter,
        fineness: Fineness,
        simd_level: SimdLevel,
    ) -> Self {
        let bins = fineness.slab_samples;
        assert!(bins.is_multiple_of(BLOCK) && bins > 0, "{bins} samples");
        assert!(fineness.stretch > 0, "a stretch without elements");
        let step_hz = rate_hz / bins as f64;
        let gain: Vec<f64> = (0..bins)
            .map(|q| (filter.gain)((q as f64 - (bins / 2) as f64) * step_hz))
            .collect();
        let blocks = heard_blocks(&gain, FILTERED * fineness.series);
        // Only what the filter leaves has to be right.
        let heard = 2 * (bins / 2 - BLOCK * blocks.start).max(BLOCK * blocks.end - bins / 2);
        let rows = grid_size((heard as f64 * fineness.time_oversampling).ceil() as usize).max(bins);
        let time_kernel = Kernel::new(
            fineness.time_width,
            rows as f64 / heard as f64 / fineness.time_core,
            fineness.moments,
        );
        let slope_kernel = Kernel::new(
            fineness.slope_width,
            fineness.slope_oversampling,
            fineness.moments,
        );
        let heard_bins = BLOCK * blocks.start..BLOCK * blocks.end;
        let band = (0..bins)
            .map(|q| {
                if !heard_bins.contains(&q) {
                    return 0.0;
                }
                let bin = q as f64 - (bins / 2) as f64;
                gain[q] * step_hz / time_kernel.window_gain(bin / rows as f64)
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
        let most = MAX_INSTANTS.max(MAX_ALONG);
        Self {
            fineness,
            rate_hz,
            filter_half_s: filter.half_s,
            fastest_m_per_s: 5.0,
            simd_level,
            stretches,
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

    /// Makes tables that do not have to be made again for platforms up to this speed.
    pub fn with_room_for(mut self, fastest_m_per_s: f64) -> Self {
        self.fastest_m_per_s = self.fastest_m_per_s.max(1.1 * fastest_m_per_s);
        self
    }

    /// Rows from one panel of the grid to the next: one more than there are, or the rows of all panels would share the sets of a cache.
    pub(super) fn panel_rows(&self) -> usize {
        self.rows + 1
    }

    /// How much sooner or later than at its middle something is heard at a stretch's ends, the filter included.
    fn beside_s(&self, sound_speed_m_per_s: f64) -> f64 {
        let halves_m = self.stretches.iter().map(|stretch| stretch.half_m);
        self.filter_half_s + halves_m.fold(0.0, f64::max) / sound_speed_m_per_s
    }

    pub(super) fn bins(&self) -> usize {
        self.fineness.slab_samples
    }

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

    /// [`Self::prepare_from`] the first instant that counts.
    pub fn prepare(&mut self, plan: &PingPlan) {
        self.prepare_from(plan, f64::NEG_INFINITY);
    }

    /// Sets the engine to a ping none of whose echoes begin before `earliest_s`: slabs, and the pulse's spectra if they are not those at hand.
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
        let beside_s = self.beside_s(c);
        let max_s = (self.bins() - 2) as f64 / self.rate_hz - echo_s - 2.0 * beside_s;
        assert!(max_s > 0.0, "slabs shorter than a filtered echo");
        let last_edge_s = plan.window_s(self.rate_hz) + beside_s;
        let first_edge_s = (plan.first_sample_s - echo_s - beside_s)
            .max(earliest_s)
            .min(last_edge_s);
        // As even as can be: threads then have alike to do. No slab for what is rounding.
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
    pub(crate) fn task_elements(&self, task: usize) -> std::ops::Range<usize> {
        let stretch = self.stretch(task);
        stretch.first..stretch.first + stretch.along_m.len()
    }

    /// Values of the largest task's output.
    pub(crate) fn output_len(&self) -> usize {
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
            half_m: stretch.half_m,
            fades: false,
            elements: stretch.along_m.len() as u64,
            earliest_s: edge_s(self.slab(task)),
            latest_s: edge_s(self.slab(task) + 1),
        }
    }

    /// First sample of a slab's output, counted from the record's.
    fn slab_start(&self, slab: usize) -> isize {
        let ping = &self.ping;
        let beside_s = self.beside_s(ping.sound_speed_m_per_s);
        let from_s = ping.first_edge_s + slab as f64 * ping.slab_s - beside_s;
        ((from_s - ping.first_sample_s) * self.rate_hz).floor() as isize
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
    pub(super) fn top_hz(&self) -> f64 {
        self.ping.carrier_hz + 0.5 * self.rate_hz
    }

    pub(super) fn rows_per_s(&self) -> f64 {
        self.rows as f64 * self.rate_hz / self.bins() as f64
    }

    /// Of a stretch at rest: in motion there are more.
    fn columns_per_slope(&self, half_m: f64) -> f64 {
        let ping = &self.ping;
        let reach_m = half_m.max(0.25 * ping.sound_speed_m_per_s / ping.carrier_hz);
        2.0 * self.fineness.slope_oversampling * reach_m * self.top_hz() / ping.sound_speed_m_per_s
    }

    /// Half of the span of slopes from which on dilation may be bowed. Columns reach half a kernel beyond the span: of a narrower one a square
    /// would run away there, and turn templates by many radians from one end of a block of frequencies to the other.
    fn min_bow(&self, half_m: f64) -> f64 {
        0.5 * self.slope_kernel.width as f64 / self.columns_per_slope(half_m)
    }

    /// The steepest that dilation beyond its line may become per slope: templates follow what changes from column to column to second order,
    /// so that the cube of the phase that is met from one to the next is left.
    fn steepest_bow(&self, half_m: f64) -> f64 {
        let turn_rad = (BOW_SHARE * self.fineness.series).cbrt();
        turn_rad * self.columns_per_slope(half_m)
            / (std::f64::consts::PI * self.top_hz() * self.ping.duration_s)
    }

    /// One task: echoes from `source` to samples, element by element, slab-long. `output` is resized; empty where there are no echoes.
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
        let centring = Centring::new(&self.ping, self.fineness.motion, first_s);
        let mut since = Instant::now();
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
        let half_m = self.stretch(task).half_m;
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
                self.stretch(task),
                surveyed.widened(margin),
                &work.echoes,
                &mut work.merge,
            );
            work.stages.lap(Stage::Orders, &mut since);
            let fades = numbers.fades();
            let mut spread = Spread::new(&numbers, centring, work);
            counts = source.walk(LineStretch { fades, ..wanted }, &mut spread);
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
                elements: self.stretch(task).along_m.len(),
                echoes,
                rows: self.rows,
                heard: numbers.heard(),
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

/// From the first to the last block where the filter leaves more than `least` of its most.
fn heard_blocks(gain: &[f64], least: f64) -> std::ops::Range<usize> {
    let most = gain.iter().fold(0.0, |most: f64, g| most.max(g.abs()));
    let heard = |block: &[f64]| block.iter().any(|g| g.abs() > least * most);
    let first = gain.chunks(BLOCK).position(heard).unwrap_or(0);
    let last = gain.chunks(BLOCK).rposition(heard).unwrap_or(0);
    first..last + 1
}
