//! The engine as the pipeline uses it: built once for the limits of a run, then called once per
//! ping.

use std::sync::{Mutex, PoisonError};

use num_complex::{Complex, Complex64};
use rayon::prelude::*;

use crate::arrivals::LineSource;
use crate::error_model::ErrorModel;
use echotank_core::ping::{EchoCounts, PingPlan};

use super::engine::{Filter, LineEngine, TaskReport, Work};
use super::plan::{Precision, Refusal, Spec, choose};
use super::sample::Sample;

/// `gridded-2d` for one line array: one call per ping yields the samples of every element.
///
/// Build it inside the thread pool that runs it. The samples are bit-identical for any number of
/// threads. After the largest ping it allocates nothing. A pulse of another length rebuilds the
/// tables, which takes some tens of milliseconds.
///
/// ```
/// use echotank_synthesis::array::Decimator;
/// use echotank_core::simd::SimdLevel;
/// use echotank_synthesis::array::gridded2d::{Bounds, Gridded2d, Spec};
/// # use echotank_core::arrays::{ArrayGeometry, Mounting, Pattern};
/// # use echotank_core::model::{DopplerModel, ModelChoice, PathModel, Synthesis};
/// # use echotank_core::pulse::{Pulse, PulseKind};
/// # use glam::{DQuat, DVec3};
/// # let array = ArrayGeometry {
/// #     mounting: Mounting { position_m: DVec3::ZERO, body_from_array: DQuat::IDENTITY },
/// #     elements: 64, spacing_m: 1.875e-3, radius_m: None, element_pattern: Pattern::Omnidirectional, sensitivity_db: 0.0, transmit: 0,
/// # };
/// # let pulse = Pulse { kind: PulseKind::LfmUp, center_frequency_hz: 400e3, bandwidth_hz: 30e3, duration_s: 5e-3, taper: 0.1 };
/// # let model = ModelChoice {
/// #     path: PathModel::KSegment, doppler: DopplerModel::Stretch, synthesis: Synthesis::Direct, segment_s: 0.05, cull_db: None,
/// # };
/// let filter = Decimator::new(&pulse, 52e3, 2700.0, 8).expect("the band fits");
/// let spec = Spec {
///     array: &array,
///     pulse: &pulse,
///     sound_speed_m_per_s: 1500.0,
///     sample_rate_hz: 52e3,
///     filter: Some(&filter),
///     model: &model,
///     bounds: Bounds {
///         nearest_m: 30.0,
///         greatest_slope: 0.5,
///         along_m_per_s: 5.0,
///         across_m_per_s: 0.5,
///         turning_rad_per_s: 0.1,
///     },
///     tolerance: 1e-3,
///     level_range_db: 60.0,
///     samples: 10_000,
///     scatterers: 1_000_000,
///     simd_level: SimdLevel::best(),
/// };
/// let engine = Gridded2d::new(&spec).expect("the tolerance can be met");
/// assert!(engine.error_model().error <= 1e-3);
/// // Then, for every ping, after `echo::insonify`:
/// //     let echoes = LineEchoes { plan, array: &array, transmit_leg: &transmit_leg, work: &line_workspaces };
/// //     counts += engine.synthesise(plan, &echoes, &mut frame.iq);
/// ```
pub struct Gridded2d {
    error_model: ErrorModel,
    elements: usize,
    member: Member,
    /// Truncation error of the last ping.
    left_out: f64,
}

/// The engine in one of two precisions.
enum Member {
    Single(Tasks<f32>),
    Double(Tasks<f64>),
}

impl Gridded2d {
    /// Selects the cheapest resolution for `spec` and builds the engine.
    ///
    /// Returns a [`Refusal`] if no resolution reaches the tolerance.
    pub fn new(spec: &Spec) -> Result<Self, Refusal> {
        let choice = choose(spec)?;
        let Some(decimator) = spec.filter else {
            return Err(Refusal::NoFilter);
        };
        let filter = Filter {
            gain: &|f_hz| decimator.gain(f_hz),
            half_s: decimator.half_s(),
        };
        let fastest_m_per_s = spec.bounds.along_m_per_s.hypot(spec.bounds.across_m_per_s);
        let member = match choice.precision {
            Precision::Single => Member::Single(Tasks::new(
                LineEngine::new(
                    spec.array,
                    spec.sample_rate_hz,
                    filter,
                    choice.resolution,
                    spec.simd_level,
                )
                .with_room_for(fastest_m_per_s),
            )),
            Precision::Double => Member::Double(Tasks::new(
                LineEngine::new(
                    spec.array,
                    spec.sample_rate_hz,
                    filter,
                    choice.resolution,
                    spec.simd_level,
                )
                .with_room_for(fastest_m_per_s),
            )),
        };
        Ok(Self {
            error_model: choice.error_model,
            elements: spec.array.elements,
            member,
            left_out: 0.0,
        })
    }

    /// Predicted windowed error, and cost in milliseconds of one core per ping.
    pub fn error_model(&self) -> &ErrorModel {
        &self.error_model
    }

    /// Synthesises one ping. Overwrites `iq`, element-major as in
    /// [`echotank_core::ping::ElementFrame`].
    ///
    /// In the counts, `outside_window` holds the pairs outside the delays of every section.
    pub fn synthesise(
        &mut self,
        plan: &PingPlan,
        source: &impl LineSource,
        iq: &mut [Complex64],
    ) -> EchoCounts {
        assert_eq!(
            iq.len(),
            self.elements * plan.sample_count,
            "element-major samples"
        );
        let (mut counts, left_out) = match &mut self.member {
            Member::Single(tasks) => tasks.run(plan, source, iq),
            Member::Double(tasks) => tasks.run(plan, source, iq),
        };
        self.left_out = left_out;
        let all = source.scatterers() * self.elements as u64;
        counts.outside_window += all.saturating_sub(counts.used + counts.culled);
        counts
    }

    /// Statistics of the tasks of the last ping.
    pub fn reports(&self) -> impl Iterator<Item = &TaskReport> {
        let (single, double) = match &self.member {
            Member::Single(tasks) => (Some(tasks.reports()), None),
            Member::Double(tasks) => (None, Some(tasks.reports())),
        };
        single
            .into_iter()
            .flatten()
            .chain(double.into_iter().flatten())
    }

    /// Bound on the truncation error of the last ping's series, relative to an echo. It exceeds the
    /// tolerance if the ping was outside the bounds of the engine.
    pub fn left_out(&self) -> f64 {
        self.left_out
    }
}

/// Result of one task.
#[derive(Clone, Default)]
struct Output<T> {
    values: Vec<Complex<T>>,
    counts: EchoCounts,
    report: TaskReport,
}

struct Tasks<T: Sample> {
    engine: LineEngine<T>,
    /// One per thread of the pool.
    work: Vec<Mutex<Work<T>>>,
    /// One per task.
    outputs: Vec<Output<T>>,
}

impl<T: Sample> Tasks<T> {
    fn new(engine: LineEngine<T>) -> Self {
        Self {
            work: (0..rayon::current_num_threads())
                .map(|_| Mutex::new(engine.work()))
                .collect(),
            engine,
            outputs: Vec::new(),
        }
    }

    /// Statistics of the last ping's tasks.
    fn reports(&self) -> impl Iterator<Item = &TaskReport> {
        let tasks = self.engine.tasks().min(self.outputs.len());
        self.outputs[..tasks].iter().map(|output| &output.report)
    }

    fn run(
        &mut self,
        plan: &PingPlan,
        source: &impl LineSource,
        iq: &mut [Complex64],
    ) -> (EchoCounts, f64) {
        self.engine.prepare_from(plan, source.earliest_s());
        let tasks = self.engine.tasks();
        if self.outputs.len() < tasks {
            self.outputs.resize_with(tasks, Output::default);
        }
        let Self {
            engine,
            work,
            outputs,
        } = self;
        let engine = &*engine;
        outputs[..tasks]
            .par_iter_mut()
            .with_max_len(1)
            .enumerate()
            .for_each(|(task, output)| {
                let thread = rayon::current_thread_index().unwrap_or(0);
                // The lock may be poisoned by a panic in another ping. The buffers remain valid:
                // every task overwrites them.
                let mut work = work[thread].lock().unwrap_or_else(PoisonError::into_inner);
                let (counts, report) = engine.run(task, source, &mut work, &mut output.values);
                (output.counts, output.report) = (counts, report);
            });
        let outputs = &outputs[..tasks];
        iq.par_chunks_mut(plan.sample_count.max(1))
            .enumerate()
            .for_each(|(element, record)| {
                engine.assemble(|task| &outputs[task].values, element, record);
            });
        let mut counts = EchoCounts::default();
        let mut left_out: f64 = 0.0;
        for output in outputs {
            counts += output.counts;
            left_out = left_out.max(output.report.left_out);
        }
        (counts, left_out)
    }
}
