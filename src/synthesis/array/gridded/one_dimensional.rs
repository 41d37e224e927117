//! Engine `gridded-1d`: synthesis of one element by a one-dimensional nonuniform Fourier transform,
//! for any array.
//!
//! The middle of every echo is spread with its carrier phase over a grid of delays
//! ([`super::moments`]). If echoes differ in Doppler, each is also spread over a few Doppler
//! columns ([`super::doppler`]). An FFT transforms each column, and the spectrum is multiplied by
//! the template of the column. The template is the pulse stretched by the column's Doppler, with
//! the receiver filter and the correction of the kernels. The sum is folded onto the sample rate
//! and transformed back.
//!
//! With `stretch-quadratic` the stretch changes during the pulse, and the weights on the columns
//! carry this curvature. Smaller tolerances need one more set of columns per term of the series in
//! curvature. The same points are added to these columns with the factor (p/p_max)^k. The sets are
//! few and coarse, because the terms are small, and chunks with little curvature skip them.
//!
//! The tolerance sets the widths and oversamplings of both kernels, the band in multiples of the
//! sample rate, and the precision of moments and transforms. f32 rounding in a transform spreads
//! 1e-7 of the strongest echo over the whole record. f32 rounding in moments stays near its echo. A
//! variant with f32 moments and f64 transforms serves the tolerances between.
//!
//! The input is the arrivals of one element ([`ArrivalSink`]). The result is its samples. They
//! equal, within the tolerance, those of [`super::super::direct`] with the receiver filter in the
//! limit of dense sampling.

use std::any::TypeId;
use std::sync::{Arc, OnceLock};

use echotank_fft::Fft;
use num_complex::{Complex, Complex64};

use crate::array::echo_profile::EchoProfile;
use crate::array::filter::Decimator;
use crate::arrivals::{ArrivalChunk, ArrivalSink};
use crate::error_model::ErrorModel;
use echotank_core::model::DopplerModel;
use echotank_core::pulse::{FLOOR_BELOW_STRONGEST_DB, Pulse};

use super::batched_fft::{BatchedFft, Job, LANES, MAX_TOGETHER, Place, lanes_for};
use super::choose::{SHARE, weakening};
use super::cost_estimate::CostEstimate;
use super::design::{Design, designed};
use super::doppler::DopplerSpan;
use super::kernel::MAX_WIDTH;
use super::moments::{Across, Axis, FlushWeights, Located, Points, Real, locate};
use super::prepare::{Columns, Frame, Prepared};
use super::single_echo::{EchoErrors, LEVELS};
use echotank_core::simd::{Kind, SimdLevel};

/// Tolerance below which moments are f64. f32 rounds amplitudes, positions and sums to about 1e-7
/// of an echo.
pub(crate) const MIN_F32_MOMENTS: f64 = 1e-6;

/// Rounding error of f32 transforms, relative to the strongest echo, over the whole record.
const F32_TRANSFORM: f64 = 1e-7;

/// Smallest tolerance that f64 delays and kernels support here.
const MIN_TOLERANCE: f64 = 1e-10;

/// Requirements on the engine.
#[derive(Clone, Copy)]
pub struct Spec<'a> {
    /// Transmitted pulse.
    pub pulse: &'a Pulse,
    /// Sample rate of the output, Hz.
    pub sample_rate_hz: f64,
    /// Maximum number of samples of one element.
    pub samples: usize,
    /// Receiver filter; `None` samples the sum directly.
    pub filter: Option<&'a Decimator>,
    /// Doppler model; `paper-eq21` is not supported.
    pub doppler: DopplerModel,
    /// Widest range of Dopplers at leading edges. Ignored with `DopplerModel::None`.
    pub span: DopplerSpan,
    /// Largest |curvature|, per second; used only with `DopplerModel::StretchQuadratic`.
    pub curvature_per_s: f64,
    /// Largest relative error in any window of one pulse length.
    pub tolerance: f64,
    /// Level difference between the strongest and the weakest window, dB.
    pub level_range_db: f64,
    /// Approximate number of arrivals per element. It determines the fastest design, and whether
    /// the error of a single echo matters.
    pub arrivals: usize,
    /// Instruction set of the inner loops.
    pub simd_level: SimdLevel,
}

/// Requirement that `gridded-1d` cannot meet.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum GriddedError {
    /// Too much energy of the pulse lies outside every available band.
    #[error(
        "gridded-1d: tolerance {tolerance:e} cannot be met: energy of the pulse outside the widest band causes an error of \
         {share:.1e} in some window; use the receiver filter, a longer taper or `direct`"
    )]
    OutOfBand {
        /// Requested tolerance.
        tolerance: f64,
        /// Relative error in the worst window.
        share: f64,
    },
    /// The tolerance is below the smallest supported one.
    #[error("gridded-1d: tolerance {tolerance:e} is below the minimum of {least:e}")]
    Tolerance {
        /// Requested tolerance.
        tolerance: f64,
        /// Smallest supported tolerance.
        least: f64,
    },
    /// No design keeps the tolerance in every window.
    #[error(
        "gridded-1d: no {missing} keeps tolerance {tolerance:e} in every window with this pulse and sample rate; use a larger tolerance, \
         a higher sample rate or `direct`"
    )]
    Unreachable {
        /// Requested tolerance.
        tolerance: f64,
        /// Part of the design that is missing.
        missing: &'static str,
    },
    /// The Doppler model is `paper-eq21`.
    #[error("gridded-1d: Doppler model `paper-eq21` is not supported")]
    DopplerModel,
    /// The curvature is too large for the tolerance.
    #[error(
        "gridded-1d: a curvature of {curvature_per_s} per second turns the ends of the pulse by {turned_rad:.1} rad, too much for a tolerance \
         of {tolerance:e}"
    )]
    Curvature {
        /// Largest curvature, per second.
        curvature_per_s: f64,
        /// Phase at the ends of the pulse, radians.
        turned_rad: f64,
        /// Requested tolerance.
        tolerance: f64,
    },
    /// The Doppler span is invalid.
    #[error(
        "gridded-1d: Doppler span from {least} to {greatest}: expected -0.1 <= least <= greatest <= 0.1"
    )]
    Doppler {
        /// Smallest eta - 1.
        least: f64,
        /// Largest eta - 1.
        greatest: f64,
    },
}

/// Designed engine. The first call of [`Self::work`] computes its tables, which all threads share.
pub struct Gridded1d {
    make: Box<dyn Fn() -> Box<dyn Element> + Send + Sync>,
    cost_estimate: Box<dyn Fn(usize, f64, f64) -> CostEstimate + Send + Sync>,
    echo_at_rest: Option<Box<dyn Fn() -> EchoProfile + Send + Sync>>,
    profile: OnceLock<EchoProfile>,
    error_model: ErrorModel,
    single_echo: EchoErrors,
    /// At the greatest curvature, and that, 1/s.
    curved: [f64; 2],
    spread_error: f64,
}

/// Buffers of one thread, and the current element. Call [`Self::start`], pass the arrivals as to
/// any [`ArrivalSink`], then call [`Self::finish`].
pub struct Gridded1dWork(Box<dyn Element>);

/// Echoes of one element outside the design range of the engine.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct OutOfRangeEchoes {
    /// Echoes outside the record. They are omitted.
    pub outside_window: u64,
    /// Echoes with a Doppler outside the span given to `start`, or a curvature beyond the design.
    /// They are clamped.
    pub outside_span: u64,
}

impl Gridded1d {
    /// Designs an engine for `spec`.
    ///
    /// Returns an error if the Doppler span, the Doppler model, the curvature or the spectrum of
    /// the pulse does not allow the tolerance.
    pub fn new(spec: &Spec) -> Result<Self, GriddedError> {
        let DopplerSpan { least, greatest } = spec.span;
        if !(-0.1 <= least && least <= greatest && greatest <= 0.1) {
            return Err(GriddedError::Doppler { least, greatest });
        }
        if !(MIN_TOLERANCE..).contains(&spec.tolerance) {
            return Err(GriddedError::Tolerance {
                tolerance: spec.tolerance,
                least: MIN_TOLERANCE,
            });
        }
        // Weaker windows are compared with the noise floor.
        let weakest_db = spec.level_range_db.min(FLOOR_BELOW_STRONGEST_DB);
        let spread_error = F32_TRANSFORM * 10f64.powf(weakest_db / 20.0);
        let weakening = weakening(spec);
        let needed = spec.tolerance / weakening;
        if needed < MIN_F32_MOMENTS {
            Self::of::<f64, f64>(spec, weakening, 0.0, "f64")
        } else if spread_error > SHARE * needed {
            Self::of::<f32, f64>(spec, weakening, 0.0, "f32 moments, f64 transforms")
        } else {
            Self::of::<f32, f32>(spec, weakening, spread_error, "f32")
        }
    }

    fn of<M: Real + Into<f64>, G: Real + Into<f64>>(
        spec: &Spec,
        weakening: f64,
        spread_error: f64,
        precision: &str,
    ) -> Result<Self, GriddedError> {
        let design = designed::<M>(spec, weakening)?;
        // f64 doubles the memory traffic.
        let words = (size_of::<G>() / size_of::<f32>()) as f64;
        let error = weakening * (design.error.powi(2) + spread_error.powi(2)).sqrt();
        let single_echo = design.single_echo;
        let curved = [design.curved, design.frame.greatest_q];
        let doppler = &design.terms[0].grid;
        let curvature = match &design.terms[1..] {
            [] if design.frame.curved => ", which carry curvature".into(),
            [] => String::new(),
            more => {
                let columns: Vec<String> = more
                    .iter()
                    .map(|term| term.grid.columns.to_string())
                    .collect();
                format!(", for curvature {}", columns.join(" + "))
            }
        };
        let error_model = ErrorModel {
            name: "gridded-1d",
            error,
            cost_ms: design
                .cost_estimate(words, spec.arrivals, 1.0, f64::INFINITY)
                .ms(),
            why: format!(
                "{precision}; {} bins, grid {}, width {}; {} Doppler columns, {} taps{curvature}",
                design.bins, design.grid, design.kernel.width, doppler.columns, doppler.taps
            ),
        };
        let (costing, (simd_level, samples)) = (design.clone(), (spec.simd_level, spec.samples));
        let (profiled, is_still) = (design.clone(), design.frame.still);
        let everywhere = match spread_error > 0.0 {
            true => F32_TRANSFORM * F32_TRANSFORM,
            false => 0.0,
        };
        let echo_at_rest = move || profiled.echo_at_rest(everywhere);
        let echo_at_rest: Option<Box<dyn Fn() -> EchoProfile + Send + Sync>> =
            is_still.then(|| Box::new(echo_at_rest) as _);
        let plan = OnceLock::new();
        Ok(Self {
            make: Box::new(move || {
                let made = || Arc::new(Plan::<M, G>::new(&design, simd_level, samples));
                Box::new(Work::new(plan.get_or_init(made).clone()))
            }),
            cost_estimate: Box::new(move |arrivals, share, curvature| {
                costing.cost_estimate(words, arrivals, share, curvature)
            }),
            echo_at_rest,
            profile: OnceLock::new(),
            error_model,
            single_echo,
            curved,
            spread_error,
        })
    }

    /// Predicted error of a single echo, over its level in the window or the noise floor, in the worst window.
    pub fn single_echo_error(&self) -> f64 {
        self.single_echo.worst
    }

    /// The same of windows whose levels below the strongest are those of [`level_of`](super::level_of).
    pub fn single_echo_errors(&self) -> [f64; LEVELS] {
        self.single_echo.by_level
    }

    /// Predicted rms error over the echoes of a ping and their places on the grids.
    pub fn mean_error(&self) -> f64 {
        self.single_echo.mean
    }

    /// Predicted error of echoes with the greatest curvature, and that curvature, 1/s. Echoes with less have as much less. The others leave it out.
    pub fn curvature_error(&self) -> [f64; 2] {
        self.curved
    }

    /// Predicted error of transforms in f32, which spreads over the record, relative to the noise floor; 0 of those in f64. The others leave it out.
    pub fn spread_error(&self) -> f64 {
        self.spread_error
    }

    /// An echo with its error, of an engine without Doppler; none of others. The first call computes it.
    pub fn echo_at_rest(&self) -> Option<&EchoProfile> {
        let make = self.echo_at_rest.as_ref()?;
        Some(self.profile.get_or_init(make))
    }

    /// Predicted error, and cost in milliseconds of one core per element.
    pub fn error_model(&self) -> &ErrorModel {
        &self.error_model
    }

    /// Cost of one element with `arrivals` echoes. Their Dopplers cover `share` of the span, and
    /// their curvatures reach `curvature_per_s`.
    pub fn cost_estimate(&self, arrivals: usize, share: f64, curvature_per_s: f64) -> CostEstimate {
        (self.cost_estimate)(arrivals, share, curvature_per_s)
    }

    /// Allocates buffers for one thread. The first call computes the tables, which takes
    /// milliseconds to seconds.
    pub fn work(&self) -> Gridded1dWork {
        Gridded1dWork((self.make)())
    }
}

impl Gridded1dWork {
    /// Begins an element. Sample k is `first_sample_s + k / sample_rate_hz` seconds after the start
    /// of the pulse. Echo Dopplers are in `span`, a part of the designed span; a narrower span
    /// costs less.
    pub fn start(&mut self, first_sample_s: f64, span: DopplerSpan) {
        self.0.start(first_sample_s, span);
    }

    /// Ends the element and overwrites `out` with its samples. The length of `out` is at most the
    /// `samples` of the design.
    pub fn finish(&mut self, out: &mut [Complex64]) -> OutOfRangeEchoes {
        self.0.finish(out)
    }
}

impl ArrivalSink for Gridded1dWork {
    fn accept(&mut self, chunk: &ArrivalChunk) {
        self.0.accept(chunk);
    }
}

/// [`Gridded1dWork`] of any precision.
trait Element: Send {
    fn start(&mut self, first_sample_s: f64, span: DopplerSpan);
    fn accept(&mut self, chunk: &ArrivalChunk);
    fn finish(&mut self, out: &mut [Complex64]) -> OutOfRangeEchoes;
}

/// Tables of the engine. M is the precision of moments, G that of grids and transforms.
struct Plan<M: Real, G: Real> {
    simd_level: SimdLevel,
    samples: usize,
    /// Length of the record, and of its spectrum, in samples.
    period: usize,
    grid: usize,
    /// Number of grid steps per second.
    scale: f64,
    shift: f64,
    /// Time from the start of the record to the first sample, seconds.
    lead_s: f64,
    flush: FlushWeights<M>,
    frame: Frame,
    /// Terms of the series in curvature. The first term is the echo without curvature.
    terms: Vec<Term<M, G>>,
    /// `None` if every term has one column.
    columnwise: Option<Columnwise<G>>,
    /// Maximum distance of Dopplers at the middle of an echo from the span of Dopplers at leading
    /// edges.
    beside: f64,
    forward: Arc<dyn Fft<G>>,
    inverse: Arc<dyn Fft<G>>,
}

struct Term<M: Real, G: Real> {
    columns: Columns<M>,
    templates: Templates<G>,
    /// Chunks whose largest |p|, relative to that of the design, is below this value skip the term.
    min_curvature: f64,
}

/// Templates of the columns, with the correction of the kernel.
enum Templates<G> {
    /// One column: `[bin]`, lowest frequency first.
    One(Vec<Complex<G>>),
    /// Several columns: `[place][2 * lanes]`, real parts, then imaginary parts. There are [`LANES`]
    /// more lanes than columns.
    BatchedFft { lanes: usize, numbers: Vec<G> },
}

/// Tables that the terms of several columns share.
struct Columnwise<G> {
    transform: BatchedFft<G>,
    places: Vec<Place>,
    /// Bin of each place.
    bins: Vec<u32>,
}

impl<G: Real> Columnwise<G> {
    fn new(grid: usize, bins: usize, period: usize) -> Self {
        let transform = BatchedFft::new(grid);
        let (mut places, mut of_place) = (Vec::with_capacity(bins), Vec::with_capacity(bins));
        for (row, frequency) in transform.frequencies().enumerate() {
            let bin = (frequency + bins / 2) % grid;
            if bin < bins {
                // The addition of `bins` periods keeps the difference non-negative.
                let to = (bin + bins * period - bins / 2) % period;
                places.push(Place {
                    row: row as u32,
                    to: to as u32,
                });
                of_place.push(bin as u32);
            }
        }
        Self {
            transform,
            places,
            bins: of_place,
        }
    }

    /// `fitted`: `[bin * columns + column]`, `undo`: `[bin]`.
    fn templates(&self, fitted: &[Complex64], undo: &[Complex64]) -> Templates<G> {
        let columns = fitted.len() / undo.len();
        let lanes = columns + LANES;
        let mut numbers = vec![G::zero(); self.places.len() * 2 * lanes];
        for (row, &bin) in numbers.chunks_exact_mut(2 * lanes).zip(&self.bins) {
            let (re, im) = row.split_at_mut(lanes);
            let (bin, undo) = (bin as usize, undo[bin as usize]);
            let fitted = &fitted[bin * columns..][..columns];
            for ((re, im), value) in re.iter_mut().zip(im).zip(fitted) {
                let value = value * undo;
                (*re, *im) = (G::narrow(value.re), G::narrow(value.im));
            }
        }
        Templates::BatchedFft { lanes, numbers }
    }
}

impl<M: Real, G: Real> Plan<M, G> {
    fn new(design: &Design, simd_level: SimdLevel, samples: usize) -> Self {
        let Design {
            period, bins, grid, ..
        } = *design;
        let undo = design.undo();
        let columnwise = (!design.has_one_column).then(|| Columnwise::new(grid, bins, period));
        let terms = design
            .terms
            .iter()
            .zip(design.templates())
            .map(|(term, fitted)| {
                let templates = match &columnwise {
                    Some(columnwise) if term.grid.columns > 1 => {
                        columnwise.templates(&fitted, &undo)
                    }
                    _ => {
                        let values = fitted.iter().zip(&undo).map(|(value, undo)| value * undo);
                        let narrow = |v: Complex64| Complex::new(G::narrow(v.re), G::narrow(v.im));
                        Templates::One(values.map(narrow).collect())
                    }
                };
                Term {
                    templates,
                    columns: Columns::new(term.grid.clone(), design.curvature_weights(&term.grid)),
                    min_curvature: term.min_curvature,
                }
            });
        Self {
            terms: terms.collect(),
            simd_level,
            samples,
            period,
            grid,
            scale: design.grid_hz(),
            shift: design.kernel.shift(),
            lead_s: design.lead_s,
            flush: FlushWeights::new(&design.kernel),
            frame: design.frame,
            columnwise,
            beside: design.beside,
            forward: G::plan_forward(grid),
            inverse: G::plan_inverse(period),
        }
    }

    /// Cell of points outside the record. It is far past the values that are used.
    fn drain(&self) -> usize {
        self.grid + MAX_WIDTH
    }

    /// Number of rows of a table of several columns, including those that the drain reaches.
    fn rows(&self) -> usize {
        self.grid + 2 * MAX_WIDTH + 2
    }
}

struct Work<M: Real, G: Real> {
    plan: Arc<Plan<M, G>>,
    /// Accumulators, one for each term of the tables.
    terms: Vec<TermWork<M, G>>,
    prepared: Box<Prepared<M>>,
    located: Box<Located<M>>,
    /// One column after the flush.
    values: Vec<Complex<M>>,
    column: Vec<Complex<G>>,
    spectrum: Vec<Complex<G>>,
    scratch: Vec<Complex<G>>,
    /// Several columns in transform precision. Used if the moments differ in precision or the
    /// columns are many.
    wide: Vec<G::Row>,
    wide_scratch: Vec<G::Row>,
    /// Start of this element's record.
    origin_s: f64,
    /// Doppler span at the middles of the echoes.
    span: DopplerSpan,
    misfits: OutOfRangeEchoes,
}

/// Accumulator of one term of an element.
struct TermWork<M: Real, G: Real> {
    /// Moments of one column, or the interleaved grids of several.
    table: Vec<M::Row>,
    first_column: usize,
    columns: usize,
    lanes: usize,
    /// Templates of the columns in use, `[place][2 * lanes]`.
    templates: Vec<G::Row>,
    /// First column and lanes of `templates`.
    kept: (usize, usize),
    /// True if a point was added since the start of the element.
    used: bool,
}

impl<M: Real, G: Real> Work<M, G> {
    fn new(plan: Arc<Plan<M, G>>) -> Self {
        let places = plan.columnwise.as_ref().map_or(0, |c| c.places.len());
        let terms: Vec<_> = plan
            .terms
            .iter()
            .map(|term| {
                let columns = term.columns.grid.columns;
                let (rows, template_rows) = match columns {
                    1 => (plan.grid + 2 * MAX_WIDTH + 1, 0),
                    _ => {
                        let numbers = 2 * lanes_for(columns);
                        (
                            rows_of::<M>(numbers * plan.rows()),
                            rows_of::<G>(numbers * places),
                        )
                    }
                };
                TermWork {
                    table: vec![M::EMPTY; rows],
                    first_column: 0,
                    columns,
                    lanes: lanes_for(columns),
                    templates: vec![G::EMPTY; template_rows],
                    kept: (0, 0),
                    used: false,
                }
            })
            .collect();
        let scratch = plan
            .forward
            .get_inplace_scratch_len()
            .max(plan.inverse.get_inplace_scratch_len());
        let one = plan.terms.iter().any(|t| t.columns.grid.columns == 1);
        let widest = terms.iter().map(|term| term.lanes).fold(0, usize::max);
        let apart = TypeId::of::<M>() != TypeId::of::<G>() || widest > together::<G>();
        let (wide, wide_scratch) = match &plan.columnwise {
            None => (0, 0),
            Some(columnwise) => (
                match apart {
                    true => 2 * together::<G>() * plan.grid,
                    false => 0,
                },
                columnwise.transform.scratch_len(),
            ),
        };
        Self {
            terms,
            prepared: Box::new(Prepared::new()),
            located: Box::default(),
            values: vec![zero::<M>(); if one { plan.grid + plan.flush.width } else { 0 }],
            column: vec![zero::<G>(); if one { plan.grid } else { 0 }],
            spectrum: vec![zero::<G>(); plan.period],
            scratch: vec![zero::<G>(); scratch],
            wide: vec![G::EMPTY; rows_of::<G>(wide)],
            wide_scratch: vec![G::EMPTY; rows_of::<G>(wide_scratch)],
            origin_s: 0.0,
            span: DopplerSpan {
                least: 0.0,
                greatest: 0.0,
            },
            misfits: OutOfRangeEchoes::default(),
            plan,
        }
    }
}

/// Maximum number of lanes that one transform takes.
fn together<G: Real>() -> usize {
    MAX_TOGETHER * size_of::<f32>() / size_of::<G>()
}

/// Number of rows that hold `numbers` numbers.
fn rows_of<T: Real>(numbers: usize) -> usize {
    numbers.div_ceil(2 * T::MOMENTS)
}

impl<M: Real, G: Real> TermWork<M, G> {
    /// Copies the templates of the columns in use by the element's echoes.
    fn keep(&mut self, planned: &Templates<G>) {
        let Templates::BatchedFft { lanes, numbers } = planned else {
            return;
        };
        let wanted = (self.first_column, self.lanes);
        if self.kept == wanted {
            return;
        }
        let kept = G::numbers(&mut self.templates).chunks_exact_mut(2 * self.lanes);
        for (kept, row) in kept.zip(numbers.chunks_exact(2 * lanes)) {
            let (re, im) = kept.split_at_mut(self.lanes);
            re.copy_from_slice(&row[self.first_column..][..self.lanes]);
            im.copy_from_slice(&row[lanes + self.first_column..][..self.lanes]);
        }
        self.kept = wanted;
    }
}

/// Returns the same numbers as type G if M is G.
fn same<M: Real, G: Real>(numbers: &mut [M]) -> Option<&mut [G]> {
    if TypeId::of::<M>() != TypeId::of::<G>() {
        return None;
    }
    // SAFETY: M is G.
    Some(unsafe { std::slice::from_raw_parts_mut(numbers.as_mut_ptr().cast(), numbers.len()) })
}

fn zero<T: Real>() -> Complex<T> {
    Complex::new(T::zero(), T::zero())
}

impl<M: Real + Into<f64>, G: Real + Into<f64>> Element for Work<M, G> {
    fn start(&mut self, first_sample_s: f64, span: DopplerSpan) {
        let plan = &*self.plan;
        self.origin_s = first_sample_s - plan.lead_s;
        self.misfits = OutOfRangeEchoes::default();
        self.span = DopplerSpan {
            least: span.least - plan.beside,
            greatest: span.greatest + plan.beside,
        };
        for (term, planned) in self.terms.iter_mut().zip(&plan.terms) {
            let grid = &planned.columns.grid;
            if term.used {
                term.table.fill(M::EMPTY);
                term.used = false;
            }
            term.first_column = grid.place(self.span.least).0;
            let last = grid.place(self.span.greatest).0;
            term.columns = last - term.first_column + grid.taps;
            term.lanes = lanes_for(term.columns);
            term.keep(&planned.templates);
        }
    }

    fn accept(&mut self, chunk: &ArrivalChunk) {
        let plan = &*self.plan;
        let prepared = &mut *self.prepared;
        let outside = plan
            .frame
            .prepare(plan.simd_level, chunk, self.span, prepared);
        self.misfits.outside_span += outside;
        let n = chunk.len;
        let axis = Axis {
            per_s: plan.scale,
            offset: plan.shift - self.origin_s * plan.scale,
            cells: plan.grid + 1,
            drain: plan.drain(),
        };
        let located = &mut *self.located;
        self.misfits.outside_window +=
            locate(plan.simd_level, axis, &prepared.delay_s[..n], located);
        for (order, (term, planned)) in self.terms.iter_mut().zip(&plan.terms).enumerate() {
            if order > 0 {
                if prepared.max_curvature < planned.min_curvature {
                    break;
                }
                for (amplitude, curvature) in
                    prepared.amplitude[..n].iter_mut().zip(&prepared.curvature)
                {
                    *amplitude = *amplitude * *curvature;
                }
            }
            term.used = true;
            let columns = &planned.columns;
            if columns.grid.columns > 1 {
                let used = term.first_column..term.first_column + term.columns;
                columns.place(plan.simd_level, n, used, prepared);
            }
            let points = Points {
                cell: &located.cell[..n],
                x: &located.x[..n],
                amplitude: &prepared.amplitude[..n],
            };
            if columns.grid.columns == 1 {
                M::accumulate(plan.simd_level, points, &mut term.table);
                continue;
            }
            let across = Across {
                column: &prepared.column[..n],
                value: &prepared.value[..n],
                taps: columns.grid.taps,
                lanes: term.lanes,
            };
            let table = &mut M::numbers(&mut term.table)[..2 * term.lanes * plan.rows()];
            M::spread(plan.simd_level, points, across, &plan.flush, table);
        }
    }

    fn finish(&mut self, out: &mut [Complex64]) -> OutOfRangeEchoes {
        let plan = &*self.plan;
        assert!(
            out.len() <= plan.samples,
            "{} samples of {}",
            out.len(),
            plan.samples
        );
        self.spectrum.fill(zero());
        for (term, planned) in self.terms.iter_mut().zip(&plan.terms) {
            if !term.used {
                continue;
            }
            if let Templates::One(templates) = &planned.templates {
                // Cells 0..=grid. `flush` omits the last row, which is empty here.
                let cells = &term.table[..plan.grid + 2];
                M::flush(plan.simd_level, cells, &plan.flush, &mut self.values);
                // The record is periodic: values past its end wrap to its beginning, which has no
                // samples.
                let (period, beyond) = self.values.split_at(plan.grid);
                for (value, v) in self.column.iter_mut().zip(period) {
                    *value = widen(*v);
                }
                for (value, v) in self.column.iter_mut().zip(beyond) {
                    *value = *value + widen(*v);
                }
                plan.forward
                    .process_with_scratch(&mut self.column, &mut self.scratch);
                add_folded(plan.simd_level, &mut self.spectrum, &self.column, templates);
                continue;
            }
            let Some(columnwise) = &plan.columnwise else {
                continue;
            };
            let width = 2 * term.lanes;
            let (table, rest) =
                M::numbers(&mut term.table)[..width * plan.rows()].split_at_mut(width * plan.grid);
            // The record is periodic, as above.
            for (value, beyond) in table.iter_mut().zip(&rest[..width * plan.flush.width]) {
                *value = *value + *beyond;
            }
            rest.fill(M::zero());
            let templates = &G::numbers(&mut term.templates)[..width * columnwise.places.len()];
            let mut transform = |table: &mut [G], lanes: usize, first_template: usize| {
                let job = Job {
                    table,
                    lanes,
                    places: &columnwise.places,
                    templates,
                    template_lanes: term.lanes,
                    first_template,
                    spectrum: &mut self.spectrum,
                    scratch: G::numbers(&mut self.wide_scratch),
                };
                G::transform(plan.simd_level, &columnwise.transform, job);
            };
            let most = together::<G>();
            let direct = TypeId::of::<M>() == TypeId::of::<G>() && term.lanes <= most;
            if direct && let Some(table) = same::<M, G>(table) {
                transform(table, term.lanes, 0);
            } else {
                // Several packed lanes are transformed at a time.
                for first in (0..term.lanes).step_by(most) {
                    let lanes = most.min(term.lanes - first);
                    let wide = &mut G::numbers(&mut self.wide)[..2 * lanes * plan.grid];
                    let rows = wide.chunks_exact_mut(2 * lanes);
                    for (wide, row) in rows.zip(table.chunks_exact(width)) {
                        let (re, im) = wide.split_at_mut(lanes);
                        for (wide, value) in re.iter_mut().zip(&row[first..]) {
                            *wide = G::narrow((*value).into());
                        }
                        for (wide, value) in im.iter_mut().zip(&row[term.lanes + first..]) {
                            *wide = G::narrow((*value).into());
                        }
                    }
                    transform(wide, lanes, first);
                }
                table.fill(M::zero());
            }
            // The transform has cleared the table.
            term.used = false;
        }
        plan.inverse
            .process_with_scratch(&mut self.spectrum, &mut self.scratch);
        for (out, value) in out.iter_mut().zip(&self.spectrum) {
            *out = Complex64::new(value.re.into(), value.im.into());
        }
        self.misfits
    }
}

fn widen<M: Real + Into<f64>, G: Real>(v: Complex<M>) -> Complex<G> {
    Complex::new(G::narrow(v.re.into()), G::narrow(v.im.into()))
}

/// Adds transform times template, bin by bin, to the spectrum with the period of the sample rate.
fn add_folded<G: Real>(
    simd_level: SimdLevel,
    spectrum: &mut [Complex<G>],
    column: &[Complex<G>],
    template: &[Complex<G>],
) {
    match simd_level.kind() {
        // SAFETY (both calls): a `SimdLevel` of this kind exists only on processors with the
        // features.
        #[cfg(target_arch = "x86_64")]
        Kind::Avx512 => unsafe { add_folded_avx512(spectrum, column, template) },
        #[cfg(target_arch = "x86_64")]
        Kind::Avx2 => unsafe { add_folded_avx2(spectrum, column, template) },
        _ => add_folded_plain(spectrum, column, template),
    }
}

/// AVX-512 and AVX2 builds of [`add_folded_plain`], with the same arithmetic, so the same bits.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512dq,avx512vl")]
fn add_folded_avx512<G: Real>(
    spectrum: &mut [Complex<G>],
    column: &[Complex<G>],
    template: &[Complex<G>],
) {
    add_folded_plain(spectrum, column, template);
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn add_folded_avx2<G: Real>(
    spectrum: &mut [Complex<G>],
    column: &[Complex<G>],
    template: &[Complex<G>],
) {
    add_folded_plain(spectrum, column, template);
}

#[inline(always)]
fn add_folded_plain<G: Real>(
    spectrum: &mut [Complex<G>],
    column: &[Complex<G>],
    template: &[Complex<G>],
) {
    let (period, bins) = (spectrum.len(), template.len());
    let mut bin = 0;
    while bin < bins {
        // Bin b is frequency b - bins/2. Its index in the transform of the column and in the
        // spectrum follows.
        let at = (bin + column.len() - bins / 2) % column.len();
        // The addition of `bins` periods keeps the difference non-negative.
        let to = (bin + bins * period - bins / 2) % period;
        let run = (bins - bin).min(column.len() - at).min(period - to);
        for ((sum, value), factor) in spectrum[to..to + run]
            .iter_mut()
            .zip(&column[at..at + run])
            .zip(&template[bin..bin + run])
        {
            *sum = *sum + *value * *factor;
        }
        bin += run;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::array::Direct;
    use crate::array::windows::exact_echo;
    use crate::arrivals::CHUNK;
    use echotank_core::pulse::{MIN_WINDOW, PulseKind, noise_share};
    use echotank_core::testing::plan_at_rest;

    const RATE_HZ: f64 = 40e3;
    const SAMPLES: usize = 2400;
    const FIRST_S: f64 = 0.0123;

    fn pulse(kind: PulseKind, taper: f64) -> Pulse {
        Pulse {
            kind,
            center_frequency_hz: 400e3,
            bandwidth_hz: if kind == PulseKind::Cw { 0.0 } else { 24e3 },
            duration_s: 2e-3,
            taper,
        }
    }

    /// Echoes over the whole window and past both ends, with levels falling by 50 dB and Dopplers
    /// over all of `span`.
    fn arrivals(count: usize, span: DopplerSpan) -> Vec<ArrivalChunk> {
        let fraction = |m: usize, step: f64| (0.5 + step * m as f64).fract();
        let length_s = SAMPLES as f64 / RATE_HZ;
        let mut chunks = Vec::new();
        for first in (0..count).step_by(CHUNK) {
            let mut chunk = ArrivalChunk::new();
            chunk.len = CHUNK.min(count - first);
            for i in 0..chunk.len {
                let m = first + i;
                let place = 1.2 * fraction(m, 0.754_877_666_246_693) - 0.1;
                chunk.delay_s[i] = FIRST_S + place * length_s;
                chunk.doppler[i] =
                    span.least + fraction(m, 0.569_840_290_998_053) * (span.greatest - span.least);
                let level = 10f64.powf(-2.5 * place);
                chunk.amplitude[i] = Complex64::from_polar(level, 2.4 * (m * m % 1009) as f64);
            }
            chunks.push(chunk);
        }
        chunks
    }

    /// Direct sum, with the filter if there is one.
    fn direct(
        pulse: &Pulse,
        filter: Option<&Decimator>,
        chunks: &[ArrivalChunk],
    ) -> Vec<Complex64> {
        let plan = plan_at_rest(pulse, SAMPLES, 1500.0);
        let mut out = vec![Complex64::ZERO; SAMPLES];
        let ends = filter.map(Decimator::ends);
        let sum = |rate_hz: f64, first_s: f64, out: &mut [Complex64]| {
            let mut sink = Direct::new(&plan, rate_hz, first_s, out).with_ends(ends);
            chunks.iter().for_each(|chunk| sink.accept(chunk));
        };
        match filter {
            None => sum(RATE_HZ, FIRST_S, &mut out),
            Some(filter) => {
                let mut dense = vec![Complex64::ZERO; filter.dense_len(SAMPLES)];
                sum(
                    filter.dense_rate_hz(),
                    filter.dense_first_s(FIRST_S),
                    &mut dense,
                );
                filter.apply(&dense, &mut out);
            }
        }
        out
    }

    fn gridded(spec: &Spec, span: DopplerSpan, chunks: &[ArrivalChunk]) -> (Vec<Complex64>, f64) {
        let engine = Gridded1d::new(spec).expect("within reach");
        println!("    {:?}", engine.error_model());
        let out = synthesised(&engine, span, chunks);
        (out, engine.error_model().error)
    }

    fn synthesised(
        engine: &Gridded1d,
        span: DopplerSpan,
        chunks: &[ArrivalChunk],
    ) -> Vec<Complex64> {
        let mut work = engine.work();
        let mut out = vec![Complex64::ONE; SAMPLES];
        // The element is synthesised twice, because the first must not affect the second.
        for _ in 0..2 {
            work.start(FIRST_S, span);
            chunks.iter().for_each(|chunk| work.accept(chunk));
            assert_eq!(work.finish(&mut out).outside_span, 0);
        }
        out
    }

    /// Largest relative error over windows of one pulse length, with half overlap.
    fn windowed(got: &[Complex64], want: &[Complex64], pulse: &Pulse) -> f64 {
        let length = ((pulse.duration_s * RATE_HZ) as usize).max(32);
        (0..=(want.len() - length) / (length / 2))
            .map(|w| w * length / 2..w * length / 2 + length)
            .map(|w| {
                let off: f64 = got[w.clone()]
                    .iter()
                    .zip(&want[w.clone()])
                    .map(|(g, w)| (g - w).norm_sqr())
                    .sum();
                (off / want[w].iter().map(|w| w.norm_sqr()).sum::<f64>()).sqrt()
            })
            .fold(0.0, f64::max)
    }

    fn spec<'a>(pulse: &'a Pulse, filter: Option<&'a Decimator>, span: DopplerSpan) -> Spec<'a> {
        Spec {
            pulse,
            sample_rate_hz: RATE_HZ,
            samples: SAMPLES,
            filter,
            doppler: DopplerModel::Stretch,
            span,
            curvature_per_s: 0.0,
            tolerance: 1e-3,
            level_range_db: 55.0,
            arrivals: 3000,
            simd_level: SimdLevel::best(),
        }
    }

    const SIDESCAN: DopplerSpan = DopplerSpan {
        least: -1.8e-3,
        greatest: 2.1e-3,
    };

    #[test]
    fn error_stays_below_every_tolerance_in_every_window() {
        for kind in [PulseKind::LfmUp, PulseKind::LfmDown, PulseKind::Cw] {
            // The taper is long enough for the dense sum itself to converge.
            let pulse = pulse(kind, 1.0);
            let filter = Decimator::new(&pulse, RATE_HZ, 900.0, 48).expect("fits");
            let chunks = arrivals(700, SIDESCAN);
            let want = direct(&pulse, Some(&filter), &chunks);
            // Every decade for one sweep. The designs of the other pulses differ only in their
            // bands.
            let tolerances: &[f64] = match kind {
                PulseKind::LfmUp => &[1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8],
                _ => &[1e-1, 1e-3, 1e-5, 1e-8],
            };
            for &tolerance in tolerances {
                let spec = Spec {
                    tolerance,
                    ..spec(&pulse, Some(&filter), SIDESCAN)
                };
                let (got, predicted) = gridded(&spec, SIDESCAN, &chunks);
                let error = windowed(&got, &want, &pulse);
                println!("{kind:?} {tolerance:e}: {error:.2e}, predicted {predicted:.2e}");
                assert!(error <= tolerance, "{kind:?}: {error:e} > {tolerance:e}");
            }
        }
    }

    /// Single-echo error at the ends of the Doppler range and between: worst window, every sample,
    /// with noise 55 dB below the strongest window.
    fn alone(doppler: DopplerModel, curvature_per_s: f64, tolerance: f64) -> (f64, Gridded1d) {
        let pulse = pulse(PulseKind::LfmUp, 1.0);
        let filter = Decimator::new(&pulse, RATE_HZ, 900.0, 48).expect("fits");
        let spec = Spec {
            doppler,
            curvature_per_s,
            tolerance,
            ..spec(&pulse, Some(&filter), SIDESCAN)
        };
        let engine = Gridded1d::new(&spec).expect("within reach");
        let mut worst: f64 = 0.0;
        for d in [SIDESCAN.least, 0.3e-3, 1.37e-3, SIDESCAN.greatest] {
            let mut chunk = ArrivalChunk::new();
            chunk.len = 1;
            (chunk.delay_s[0], chunk.doppler[0]) = (FIRST_S + 0.020_003_1, d);
            chunk.curvature_per_s[0] = curvature_per_s;
            chunk.amplitude[0] = Complex64::ONE;
            let chunks = [chunk];
            let want = direct(&pulse, Some(&filter), &chunks);
            let got = synthesised(&engine, SIDESCAN, &chunks);
            let length = (pulse.duration_s * RATE_HZ) as usize;
            let energy =
                |at: usize| -> f64 { want[at..at + length].iter().map(|w| w.norm_sqr()).sum() };
            let off = |at: usize| -> f64 {
                let pairs = got[at..at + length].iter().zip(&want[at..at + length]);
                pairs.map(|(g, w)| (g - w).norm_sqr()).sum()
            };
            let windows = 0..=want.len() - length;
            let noise = windows.clone().map(energy).fold(0.0, f64::max) * 10f64.powf(-5.5);
            worst = windows
                .map(|at| (off(at) / energy(at).max(noise)).sqrt())
                .fold(worst, f64::max);
        }
        (worst, engine)
    }

    #[test]
    fn windows_with_only_the_end_of_an_echo_keep_the_tolerance() {
        for (doppler, curvature_per_s) in [
            (DopplerModel::Stretch, 0.0),
            (DopplerModel::StretchQuadratic, 5e-4),
        ] {
            for tolerance in [1e-1, 1e-2, 1e-3, 1e-4] {
                let (error, engine) = alone(doppler, curvature_per_s, tolerance);
                let why = &engine.error_model().why;
                let [curved, _] = engine.curvature_error();
                let predicted = engine.single_echo_error().hypot(curved);
                let predicted = predicted.hypot(engine.spread_error());
                println!("{doppler:?} {tolerance:e}: {error:.2e} of {predicted:.2e}; {why}");
                assert!(error <= tolerance, "{error:e} > {tolerance:e}: {why}");
                assert!(error <= predicted, "{error:e} > {predicted:e}: {why}");
                assert!(predicted <= 10.0 * error, "{predicted:e}, {error:e}: {why}");
                assert!(engine.mean_error() <= predicted, "{why}");
            }
        }
    }

    /// Echoes behind the receiver filter that begin anywhere between two samples: the last samples of a window may be all that it holds of an echo. Sharp
    /// pulses are refused at the finest tolerances, and so may others be. Dopplers within 2e-3, and within 1.4e-2, which the filter widens its band for.
    #[test]
    fn the_worst_window_of_an_echo_is_predicted_from_its_samples() {
        const PLACES: usize = 8;
        const FIRST: f64 = 300.0;
        const LAST: usize = 500;
        for (kind, taper, sounding, fastest) in [
            (PulseKind::Cw, 0.5, 11.3, 2e-3),
            (PulseKind::Cw, 0.5, 11.3, 1.4e-2),
            (PulseKind::Cw, 0.0, 18.8, 2e-3),
            (PulseKind::Cw, 0.0, 60.0, 1.4e-2),
            (PulseKind::Cw, 1.0, 5.0, 2e-3),
            (PulseKind::Cw, 1.0, 20.0, 1.4e-2),
            (PulseKind::Cw, 0.25, 40.0, 2e-3),
            (PulseKind::LfmUp, 0.0, 30.0, 2e-3),
            (PulseKind::LfmUp, 0.25, 60.0, 1.4e-2),
            (PulseKind::LfmDown, 1.0, 100.0, 2e-3),
        ] {
            let span = DopplerSpan {
                least: -fastest,
                greatest: fastest,
            };
            let pulse = Pulse {
                duration_s: sounding / RATE_HZ,
                ..pulse(kind, taper)
            };
            let filter = Decimator::new(&pulse, RATE_HZ, fastest * pulse.center_frequency_hz, 48)
                .expect("fits");
            let window = sounding.ceil().max(MIN_WINDOW) as usize;
            let energies = |samples: &[Complex64]| -> Vec<f64> {
                let windows = samples[..LAST + window].windows(window);
                let energy = |w: &[Complex64]| w.iter().map(|x| x.norm_sqr()).sum();
                windows.map(energy).collect()
            };
            for tolerance in [1e-2, 1e-3, 1e-4, 1e-5, 1e-7] {
                let engine = match Gridded1d::new(&Spec {
                    tolerance,
                    ..spec(&pulse, Some(&filter), span)
                }) {
                    Ok(engine) => engine,
                    Err(_) if tolerance < 1e-6 || taper == 0.0 && tolerance < 1e-4 => continue,
                    Err(error) => {
                        panic!("{kind:?} {taper} {sounding} {fastest} {tolerance:e}: {error}")
                    }
                };
                let mut worst: f64 = 0.0;
                for doppler in [-fastest, -0.15 * fastest, 0.02 * fastest, fastest] {
                    for place in (0..PLACES).map(|k| k as f64 / PLACES as f64) {
                        let mut chunk = ArrivalChunk::new();
                        chunk.len = 1;
                        chunk.delay_s[0] = FIRST_S + (FIRST + place) / RATE_HZ;
                        chunk.doppler[0] = doppler;
                        chunk.amplitude[0] = Complex64::ONE;
                        let mut want = vec![Complex64::ZERO; SAMPLES];
                        exact_echo(&pulse, &filter, &chunk, FIRST_S, &mut want);
                        let got = synthesised(&engine, span, &[chunk]);
                        let off: Vec<_> = got.iter().zip(&want).map(|(g, w)| g - w).collect();
                        let levels = energies(&want);
                        let noise = levels.iter().copied().fold(0.0, f64::max) * noise_share();
                        let shares = energies(&off).into_iter().zip(levels);
                        worst = shares.fold(worst, |worst, (off, level)| {
                            worst.max((off / level.max(noise)).sqrt())
                        });
                    }
                }
                let predicted = engine.single_echo_error().hypot(engine.spread_error());
                let of = format!("{kind:?} {taper} {sounding} {fastest} {tolerance:e}");
                println!("{of}: {worst:.2e}, predicted {predicted:.2e}");
                assert!(worst <= tolerance, "{of}: {worst:e}");
                assert!(worst <= 1.4 * predicted, "{of}: {worst:e} {predicted:e}");
                assert!(predicted <= 2.5 * worst, "{of}: {worst:e} {predicted:e}");
            }
        }
    }

    /// The curvature phase of a 2 ms pulse is 0.013 rad at its ends. Weights suffice for a
    /// tolerance of a hundredth, separate columns for 1e-5.
    #[test]
    fn weights_carry_a_curvature_as_well_as_separate_columns() {
        let carried = |tolerance| {
            let (error, engine) = alone(DopplerModel::StretchQuadratic, 5e-3, tolerance);
            let why = &engine.error_model().why;
            assert!(error <= tolerance, "{error:e} > {tolerance:e}: {why}");
            why.contains("which carry curvature")
        };
        assert!(carried(1e-2) && !carried(1e-5));
    }

    /// The pulse of the paper has sharp edges. The direct sum at 48 dense samples per output sample
    /// converges because its edge points are weighted.
    #[test]
    fn a_rectangular_pulse_meets_the_filtered_direct_sum_to_1e_3() {
        let pulse = pulse(PulseKind::LfmUp, 0.0);
        let filter = Decimator::new(&pulse, RATE_HZ, 900.0, 48).expect("fits");
        let chunks = arrivals(700, SIDESCAN);
        let want = direct(&pulse, Some(&filter), &chunks);
        let (got, _) = gridded(&spec(&pulse, Some(&filter), SIDESCAN), SIDESCAN, &chunks);
        let error = windowed(&got, &want, &pulse);
        assert!(error < 1e-3, "{error:e}");
    }

    /// No band contains the spectrum of a sharp CW pulse, and a truncated spectrum rings. The
    /// ringing must not reach an echo 55 dB weaker and 8 ms later.
    #[test]
    fn truncation_errors_of_the_band_stay_near_the_echo() {
        let pulse = Pulse {
            duration_s: 0.6e-3,
            ..pulse(PulseKind::Cw, 0.0)
        };
        let filter = Decimator::new(&pulse, RATE_HZ, 900.0, 48).expect("fits");
        let still = DopplerSpan {
            least: 0.0,
            greatest: 0.0,
        };
        let mut chunk = ArrivalChunk::new();
        chunk.len = 2;
        chunk.delay_s[..2].copy_from_slice(&[FIRST_S + 0.020_003, FIRST_S + 0.028_017]);
        let weak = 10f64.powf(-55.0 / 20.0);
        chunk.amplitude[..2].copy_from_slice(&[Complex64::ONE, Complex64::new(0.0, weak)]);
        let chunks = [chunk];
        let want = direct(&pulse, Some(&filter), &chunks);
        let heard = (0.028_017 * RATE_HZ) as usize..(0.0286 * RATE_HZ) as usize;
        for tolerance in [1e-3, 1e-4, 1e-5] {
            let spec = Spec {
                doppler: DopplerModel::None,
                tolerance,
                ..spec(&pulse, Some(&filter), still)
            };
            let (got, _) = gridded(&spec, still, &chunks);
            let off: f64 = heard.clone().map(|k| (got[k] - want[k]).norm_sqr()).sum();
            let all: f64 = heard.clone().map(|k| want[k].norm_sqr()).sum();
            let error = (off / all).sqrt();
            println!("{tolerance:e}: {error:.1e}");
            assert!(error < tolerance, "{error:e} > {tolerance:e}");
        }
    }

    #[test]
    fn without_a_filter_sharp_pulses_are_refused_and_tapered_ones_keep_the_tolerance() {
        let sharp = pulse(PulseKind::LfmUp, 0.0);
        let refusal = Gridded1d::new(&spec(&sharp, None, SIDESCAN)).err();
        let Some(GriddedError::OutOfBand { tolerance, share }) = refusal else {
            panic!("{refusal:?}");
        };
        assert_eq!(tolerance, 1e-3);
        assert!(share > SHARE * 1e-3, "{share:e}");

        let soft = pulse(PulseKind::LfmUp, 1.0);
        let chunks = arrivals(700, SIDESCAN);
        let want = direct(&soft, None, &chunks);
        let (got, _) = gridded(&spec(&soft, None, SIDESCAN), SIDESCAN, &chunks);
        let error = windowed(&got, &want, &soft);
        assert!(error < 1e-3, "{error:e}");
    }

    #[test]
    fn zero_and_nearly_equal_dopplers_take_one_column() {
        let pulse = pulse(PulseKind::LfmUp, 1.0);
        let filter = Decimator::new(&pulse, RATE_HZ, 900.0, 48).expect("fits");
        let narrow = DopplerSpan {
            least: 1.0e-3,
            greatest: 1.0e-3 + 1e-7,
        };
        let still = DopplerSpan {
            least: 0.0,
            greatest: 0.0,
        };
        for (doppler, span) in [(DopplerModel::None, still), (DopplerModel::Stretch, narrow)] {
            let chunks = arrivals(700, span);
            let want = direct(&pulse, Some(&filter), &chunks);
            let spec = Spec {
                doppler,
                ..spec(&pulse, Some(&filter), span)
            };
            let (got, _) = gridded(&spec, span, &chunks);
            let error = windowed(&got, &want, &pulse);
            assert!(error < 1e-3, "{doppler:?}: {error:e}");
            let why = &Gridded1d::new(&spec)
                .expect("within reach")
                .error_model()
                .why
                .clone();
            assert!(why.contains("1 Doppler columns, 1 taps"), "{why}");
        }
    }

    /// Curvatures of a platform at 5 m/s and 36 m range, of swell, and of a scatterer close to a
    /// fast platform.
    #[test]
    fn curvature_keeps_every_tolerance_in_every_window() {
        for (kind, greatest) in [
            (PulseKind::LfmUp, 5e-4),
            (PulseKind::LfmDown, 0.02),
            (PulseKind::Cw, 4e-3),
        ] {
            let pulse = pulse(kind, 1.0);
            let filter = Decimator::new(&pulse, RATE_HZ, 900.0, 48).expect("fits");
            let mut chunks = arrivals(700, SIDESCAN);
            for (j, chunk) in chunks.iter_mut().enumerate() {
                for i in 0..chunk.len {
                    let m = j * CHUNK + i;
                    let part = (0.5 + 0.819_172_513_396_164 * m as f64).fract();
                    chunk.curvature_per_s[i] = greatest * (2.0 * part - 1.0);
                }
            }
            let want = direct(&pulse, Some(&filter), &chunks);
            // The parabolas of the direct sum have an error of about 1e-8 for distorted sweeps.
            let tolerances: &[f64] = match kind {
                PulseKind::LfmUp => &[1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6],
                _ => &[1e-1, 1e-3, 1e-6],
            };
            for &tolerance in tolerances {
                let spec = Spec {
                    doppler: DopplerModel::StretchQuadratic,
                    curvature_per_s: greatest,
                    tolerance,
                    ..spec(&pulse, Some(&filter), SIDESCAN)
                };
                let (got, predicted) = gridded(&spec, SIDESCAN, &chunks);
                let error = windowed(&got, &want, &pulse);
                println!("{kind:?} {greatest} {tolerance:e}: {error:.2e}, {predicted:.2e}");
                assert!(error <= tolerance, "{kind:?}: {error:e} > {tolerance:e}");
            }
        }
    }

    #[test]
    fn a_curvature_above_the_limit_is_refused() {
        let pulse = pulse(PulseKind::LfmUp, 1.0);
        let filter = Decimator::new(&pulse, RATE_HZ, 900.0, 12).expect("fits");
        let spec = Spec {
            doppler: DopplerModel::StretchQuadratic,
            curvature_per_s: 1.0,
            ..spec(&pulse, Some(&filter), SIDESCAN)
        };
        let refusal = Gridded1d::new(&spec).err();
        assert!(
            matches!(refusal, Some(GriddedError::Curvature { .. })),
            "{refusal:?}"
        );
    }

    #[test]
    fn without_a_doppler_model_the_stretch_of_arrivals_is_ignored() {
        let pulse = pulse(PulseKind::LfmUp, 1.0);
        let filter = Decimator::new(&pulse, RATE_HZ, 900.0, 12).expect("fits");
        let spec = Spec {
            doppler: DopplerModel::None,
            ..spec(&pulse, Some(&filter), SIDESCAN)
        };
        let moving = arrivals(300, SIDESCAN);
        let mut still = arrivals(300, SIDESCAN);
        still.iter_mut().for_each(|chunk| chunk.doppler.fill(0.0));
        let (got, _) = gridded(&spec, SIDESCAN, &moving);
        let (want, _) = gridded(&spec, SIDESCAN, &still);
        assert_eq!(got, want);
    }

    #[test]
    fn a_ping_with_a_narrower_span_uses_the_same_design() {
        let pulse = pulse(PulseKind::LfmUp, 1.0);
        let filter = Decimator::new(&pulse, RATE_HZ, 2000.0, 48).expect("fits");
        let wide = DopplerSpan {
            least: -4e-3,
            greatest: 4e-3,
        };
        for span in [
            SIDESCAN,
            DopplerSpan {
                least: 1e-3,
                greatest: 1.3e-3,
            },
        ] {
            let chunks = arrivals(700, span);
            let want = direct(&pulse, Some(&filter), &chunks);
            let (got, _) = gridded(&spec(&pulse, Some(&filter), wide), span, &chunks);
            let error = windowed(&got, &want, &pulse);
            assert!(error < 1e-3, "{span:?}: {error:e}");
        }
    }

    #[test]
    fn echoes_outside_the_design_range_are_counted() {
        let pulse = pulse(PulseKind::LfmUp, 1.0);
        let filter = Decimator::new(&pulse, RATE_HZ, 900.0, 12).expect("fits");
        let engine = Gridded1d::new(&spec(&pulse, Some(&filter), SIDESCAN)).expect("within reach");
        let mut work = engine.work();
        let mut chunk = ArrivalChunk::new();
        chunk.len = 4;
        chunk.delay_s[..4].copy_from_slice(&[FIRST_S, -1.0, f64::NAN, FIRST_S + 0.01]);
        chunk.doppler[3] = 0.05;
        chunk.amplitude[..4].fill(Complex64::ONE);
        work.start(FIRST_S, SIDESCAN);
        work.accept(&chunk);
        let mut out = vec![Complex64::ZERO; SAMPLES];
        let want = OutOfRangeEchoes {
            outside_window: 2,
            outside_span: 1,
        };
        assert_eq!(work.finish(&mut out), want);
        assert!(out.iter().all(|x| x.is_finite()));
    }

    #[test]
    fn unsupported_specs_are_refused_with_their_values() {
        let pulse = pulse(PulseKind::LfmUp, 1.0);
        let filter = Decimator::new(&pulse, RATE_HZ, 900.0, 12).expect("fits");
        for tolerance in [0.0, -1.0, 1e-12, f64::NAN] {
            let spec = Spec {
                tolerance,
                ..spec(&pulse, Some(&filter), SIDESCAN)
            };
            let refusal = Gridded1d::new(&spec).err().map(|e| e.to_string());
            let said = refusal.expect("out of reach");
            assert!(said.contains("below the minimum of 1e-10"), "{said}");
        }
        let backwards = DopplerSpan {
            least: 1e-3,
            greatest: -1e-3,
        };
        let refusal = Gridded1d::new(&spec(&pulse, Some(&filter), backwards)).err();
        assert!(
            matches!(refusal, Some(GriddedError::Doppler { .. })),
            "{refusal:?}"
        );
    }
}
