//! Measures accuracy and speed of every method and setting on the configured scene, sonar and motion.
//!
//! The configuration needs recorded navigation. For every method, the chart lists the errors of element samples, side-scan lines, picture and mean
//! level, and the compute time of a ping. If a method does not apply, the chart states the reason. Receiver noise and quantisation are off.
//!
//! The reference solution is the direct sum of all scatterers on the continuous trajectory with second-order Doppler. Its own error is
//! measured at random samples with the equation of the `reference` method. Errors close to that value are upper bounds only.

pub mod methods;
pub mod metrics;
pub mod work;

use std::time::Instant;

use thiserror::Error;

use crate::chart::methods::Method;
use crate::chart::metrics::{Errors, errors};
use crate::recorded::{RecordedError, RecordedRig};
use crate::rig::OpenError;
use echotank_config::spec::{AutoModel, MediumSpec, RigSpec, SonarSpec, SynthesisOutput};
use echotank_core::model::Synthesis;
use echotank_core::ping::{PingOutput, PingPlan};
use echotank_core::scene::Scatterers;
use echotank_core::time::UtcNs;
use echotank_ping::conditions::{conditions, sum_error_model};
use echotank_ping::method_selection::costs::Costs;
use echotank_ping::method_selection::{self, MotionScale, rank, sample, with_choice};
use echotank_ping::pipeline::SonarPipeline;
use echotank_ping::threads::pool;
use echotank_synthesis::echo::error_models::{doppler_error_model, path_error_model};

/// Errors of measuring a chart.
#[derive(Debug, Error)]
pub enum ChartError {
    /// The rig or its recorded navigation cannot be opened.
    #[error(transparent)]
    Recorded(#[from] RecordedError),
    /// The threads for computing cannot be started.
    #[error("threads: {0}")]
    Threads(#[from] rayon::ThreadPoolBuildError),
    /// The rig or its cost table cannot be opened.
    #[error(transparent)]
    Rig(#[from] OpenError),
    /// The navigation does not cover a ping.
    #[error("ping {ping} of sonar {sonar}: the recorded navigation has a gap there")]
    Gap {
        /// Number of the ping.
        ping: u32,
        /// The configured name of the sonar.
        sonar: String,
    },
    /// The recorded navigation is too short; holds the number of the missing ping.
    #[error("the recorded navigation ends before ping {0}")]
    Short(u32),
    /// No ping has a scatterer in its footprint; holds the name of the sonar.
    #[error("sonar {0}: no scatterer is in the footprint of any sampled ping")]
    Silent(String),
    /// The reference solution cannot be computed.
    #[error("the reference solution cannot be computed for sonar {sonar}: {why}")]
    ReferenceSolution {
        /// The configured name of the sonar.
        sonar: String,
        /// The cause.
        why: String,
    },
}

/// Options of a chart.
#[derive(Clone, Debug)]
pub struct ChartOptions {
    /// Number of pings, spread evenly over `span_pings`.
    pub pings: u32,
    /// Number of the last ping of the span.
    pub span_pings: u32,
    /// Number of timed runs of each ping and method.
    pub repeats: usize,
    /// Number of compute threads; 0 means one per core.
    pub threads: usize,
    /// Index of the sonar in the configuration.
    pub sonar: usize,
    /// Whether fewer methods are measured.
    pub quick: bool,
}

/// Input of one ping, the same for every method.
pub struct Scene {
    /// Plan of the ping.
    pub plan: PingPlan,
    /// Scatterers in the footprint of the ping.
    pub scatterers: Scatterers,
}

/// Compute times of one method over pings and repeats, milliseconds per ping.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Times {
    /// Median.
    pub median_ms: f64,
    /// Minimum.
    pub min_ms: f64,
    /// Maximum.
    pub max_ms: f64,
}

/// Measured errors and times of one method.
#[derive(Clone, Debug)]
pub struct Measured {
    /// Errors against the reference solution.
    pub errors: Errors,
    /// Compute times per ping.
    pub times: Times,
    /// One-time cost of building the method's tables, milliseconds.
    pub setup_ms: f64,
}

/// Predicted and measured performance of one method.
pub struct Row {
    /// Method and its settings.
    pub method: Method,
    /// Relative error predicted by the error models of path, Doppler and synthesis. Culling has no error model.
    pub predicted_error: f64,
    /// Measurement, or the reason why the method does not apply.
    pub outcome: Result<Measured, String>,
    /// Whether the method is on the Pareto front: no measured method is faster with a smaller element error.
    pub pareto: bool,
    /// Whether the configuration selects this method.
    pub configured: bool,
    /// Predicted cost of the automatically selected method, milliseconds on one core.
    pub planned_ms: Option<f64>,
}

/// Measured methods of one sonar.
pub struct Chart {
    /// The configured name of the sonar.
    pub sonar: String,
    /// Number of scatterers in the first ping.
    pub scatterers: usize,
    /// Number of receive elements of all arrays.
    pub elements: usize,
    /// Number of pings measured.
    pub pings: usize,
    /// Number of compute threads.
    pub threads: usize,
    /// Configured relative tolerance.
    pub tolerance: f64,
    /// Relative l2 error of the reference solution against the `reference` method, and the number of random samples compared.
    pub reference_error: Option<(f64, u32)>,
    /// Mean time to gather the scatterers of a ping, milliseconds; the same for every method.
    pub gather_ms: f64,
    /// One row per method.
    pub rows: Vec<Row>,
}

/// Specification of the sonar without receiver noise, quantisation and error checks, with element outputs.
pub fn bare(spec: &SonarSpec) -> SonarSpec {
    let mut spec = spec.clone();
    spec.receiver.noise_db = None;
    spec.receiver.adc_bits = None;
    spec.synthesis.error_check = false;
    spec.synthesis.output = SynthesisOutput::Elements;
    spec
}

/// Sampled pings, and the mean time to gather their scatterers, milliseconds.
///
/// # Errors
/// The rig cannot be opened, or the navigation does not cover the pings.
pub fn scenes(spec: &RigSpec, options: &ChartOptions) -> Result<(Vec<Scene>, f64), ChartError> {
    // The rig computes no ping here. The direct method builds no tables.
    let mut spec = spec.clone();
    for sonar in &mut spec.sonars {
        *sonar = methods::reference().on(&bare(sonar));
    }
    let mut recorded = RecordedRig::open(&spec)?;
    let name = spec.sonars[options.sonar].name.clone();
    let step = (options.span_pings / options.pings.max(1)).max(1);
    let mut scenes = Vec::new();
    let mut gather_ms = 0.0;
    let mut slot = recorded.rig.slot(options.sonar);
    while scenes.len() < options.pings as usize {
        let Some((sonar, order)) = recorded.next_order(u32::MAX) else {
            return Err(ChartError::Short(options.span_pings));
        };
        recorded.record_pulse(sonar, &order);
        if sonar != options.sonar || !(order.ping_number - 1).is_multiple_of(step) {
            continue;
        }
        if !recorded.settle(sonar, &order) {
            match scenes.is_empty() {
                true => return Err(ChartError::Short(order.ping_number)),
                false => break,
            }
        }
        let began = Instant::now();
        recorded
            .rig
            .prepare(sonar, &order, spec.nav.mode, UtcNs(0), &mut slot)
            .map_err(|_| ChartError::Gap {
                ping: order.ping_number,
                sonar: name.clone(),
            })?;
        gather_ms += began.elapsed().as_secs_f64() * 1e3;
        scenes.push(Scene {
            plan: slot.plan.clone(),
            scatterers: recorded.rig.scatterers().clone(),
        });
    }
    if scenes.iter().all(|scene| scene.scatterers.is_empty()) {
        return Err(ChartError::Silent(name));
    }
    gather_ms /= scenes.len() as f64;
    Ok((scenes, gather_ms))
}

/// Plan of the scene with the methods of `spec`.
fn plan_with(scene: &Scene, spec: &SonarSpec) -> PingPlan {
    let mut plan = scene.plan.clone();
    plan.model = spec.model;
    let window_s = plan.window_s(spec.receiver.sample_rate_hz);
    let segment_s = spec.model.segment_s;
    echotank_ping::polyline(&plan.trajectory, window_s, segment_s, &mut plan.segments);
    plan
}

/// Runs one method over all scenes, with one warm-up and `repeats` timed runs each.
///
/// Returns the outputs, the times per ping and the setup time in milliseconds.
pub(crate) fn run_method(
    spec: &SonarSpec,
    medium: &MediumSpec,
    scenes: &[Scene],
    repeats: usize,
) -> Result<(Vec<PingOutput>, Times, f64), String> {
    let began = Instant::now();
    let mut pipeline = SonarPipeline::new(spec, medium).map_err(|why| why.to_string())?;
    let setup_ms = began.elapsed().as_secs_f64() * 1e3;
    // Only the reference solution has error checks, and their cost does not matter here.
    pipeline.allow_error_checks(f64::INFINITY);
    let mut outputs = Vec::new();
    let mut times_ms = Vec::new();
    for scene in scenes {
        let plan = plan_with(scene, spec);
        let mut output = pipeline.blank_output();
        for run in 0..=repeats {
            let began = Instant::now();
            pipeline.compute_ping(&plan, &scene.scatterers, &mut output);
            if run > 0 {
                times_ms.push(began.elapsed().as_secs_f64() * 1e3);
            }
        }
        outputs.push(output);
    }
    times_ms.sort_by(f64::total_cmp);
    let at = |share: f64| {
        let last = times_ms.len().saturating_sub(1) as f64;
        times_ms.get((share * last).round() as usize).copied()
    };
    let times = Times {
        median_ms: at(0.5).unwrap_or(0.0),
        min_ms: at(0.0).unwrap_or(0.0),
        max_ms: at(1.0).unwrap_or(0.0),
    };
    Ok((outputs, times, setup_ms))
}

/// Measures every method. Calls `progress` with the name of the next step and the total number of steps, or 0 if unchanged.
pub fn measure(
    spec: &RigSpec,
    options: &ChartOptions,
    mut progress: impl FnMut(&str, usize) + Send,
) -> Result<Chart, ChartError> {
    let pool = pool(options.threads)?;
    pool.install(move || {
        let sonar = bare(&spec.sonars[options.sonar]);
        let medium = &spec.medium;
        let methods = methods::all(&sonar, options.quick);
        progress("scene", methods.len() + 2);
        let (scenes, gather_ms) = scenes(spec, options)?;
        progress("reference", methods.len() + 2);
        let (truth, reference_error) = reference(&sonar, medium, &scenes)?;
        let run = |spec: &SonarSpec| -> Result<Measured, String> {
            let (outputs, times, setup_ms) = run_method(spec, medium, &scenes, options.repeats)?;
            Ok(Measured {
                errors: errors(&outputs, &truth),
                times,
                setup_ms,
            })
        };
        // With automatic method selection, the selected method is the configured one.
        let auto = sonar.synthesis.auto.any();
        let configured = (!auto).then(|| Method::of(&sonar));
        let mut rows = Vec::new();
        for method in methods.into_iter().skip(usize::from(auto)) {
            progress(&method.to_string(), 0);
            let with_method = method.on(&sonar);
            let predicted_error = scenes
                .iter()
                .map(|scene| {
                    let plan = plan_with(scene, &with_method);
                    predicted(&with_method, &plan, &scene.scatterers)
                })
                .fold(0.0, f64::max);
            rows.push(Row {
                configured: Some(method) == configured,
                method,
                predicted_error,
                outcome: method.applies(&sonar).and_then(|()| run(&with_method)),
                pareto: false,
                planned_ms: None,
            });
        }
        progress("the plan's choice", 0);
        let costs = crate::rig::costs_of(spec.run.costs.as_deref())?;
        if let Some(selected) = select(&sonar, medium, &scenes[0], &costs) {
            let spec = &selected.spec;
            rows.push(Row {
                configured: auto,
                method: Method::of(spec).with_tolerance(spec.synthesis.design_tolerance()),
                predicted_error: selected.error,
                outcome: run(spec),
                pareto: false,
                planned_ms: Some(selected.cost_ms),
            });
        }
        mark_pareto(&mut rows);
        Ok(Chart {
            sonar: sonar.name.clone(),
            scatterers: scenes[0].scatterers.len(),
            elements: sonar.receive.iter().map(|array| array.elements).sum(),
            pings: scenes.len(),
            threads: rayon::current_num_threads(),
            tolerance: sonar.synthesis.tolerance,
            reference_error,
            gather_ms,
            rows,
        })
    })
}

/// Selected methods of a sonar with their predicted error and cost.
struct Selected {
    spec: SonarSpec,
    error: f64,
    cost_ms: f64,
}

/// Selects the methods as the configuration requests. If the configuration fixes them, all methods are selected automatically.
fn select(
    sonar: &SonarSpec,
    medium: &MediumSpec,
    scene: &Scene,
    costs: &Costs,
) -> Option<Selected> {
    let mut spec = sonar.clone();
    // The chart compares element errors.
    spec.synthesis.output = SynthesisOutput::Elements;
    if !spec.synthesis.auto.any() {
        spec.synthesis.auto = AutoModel {
            path: true,
            segment: true,
            doppler: true,
            synthesis: true,
        };
    }
    let some = sample(&scene.scatterers);
    let ranking = rank(
        &method_selection::Scene {
            spec: &spec,
            medium,
            plan: &scene.plan,
            scatterers: &some,
            count: scene.scatterers.len(),
            costs,
            motion_scale: MotionScale::NONE,
        },
        &[],
    )?;
    let chosen = ranking.chosen();
    Some(Selected {
        spec: with_choice(sonar, &chosen.choice),
        error: chosen.error(),
        cost_ms: chosen.cost_ms(),
    })
}

/// Sum of the predicted errors of path, Doppler and synthesis. Culling has no error model.
fn predicted(spec: &SonarSpec, plan: &PingPlan, scatterers: &Scatterers) -> f64 {
    let conditions = conditions(spec, plan, scatterers);
    let model = &spec.model;
    let synthesis = sum_error_model(model.synthesis, spec, plan, &conditions).error;
    match model.synthesis {
        // The reference uses the trajectory itself and ignores path and Doppler models.
        Synthesis::Reference => synthesis,
        _ => {
            path_error_model(model.path, &conditions).error
                + doppler_error_model(model.doppler, model.path, &conditions).error
                + synthesis
        }
    }
}

/// Outputs of the reference solution, with its error in the worst window and the number of random windows compared.
#[allow(clippy::type_complexity)]
fn reference(
    sonar: &SonarSpec,
    medium: &MediumSpec,
    scenes: &[Scene],
) -> Result<(Vec<PingOutput>, Option<(f64, u32)>), ChartError> {
    let mut spec = methods::reference().on(sonar);
    spec.synthesis.error_check = true;
    let (truth, ..) =
        run_method(&spec, medium, scenes, 1).map_err(|why| ChartError::ReferenceSolution {
            sonar: sonar.name.clone(),
            why,
        })?;
    let error_check = truth
        .iter()
        .rev()
        .find_map(|output| output.error_check)
        .map(|c| (c.worst, c.windows));
    Ok((truth, error_check))
}

fn mark_pareto(rows: &mut [Row]) {
    let points: Vec<Option<(f64, f64)>> = rows
        .iter()
        .map(|row| {
            let measured = row.outcome.as_ref().ok()?;
            Some((measured.times.median_ms, measured.errors.elements))
        })
        .collect();
    for (row, point) in rows.iter_mut().zip(&points) {
        let Some((ms, error)) = *point else { continue };
        row.pareto = !points.iter().flatten().any(|&(other_ms, other_error)| {
            other_ms <= ms && other_error <= error && (other_ms < ms || other_error < error)
        });
    }
}
