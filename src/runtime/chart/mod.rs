//! Accuracy against speed: every method and setting on the operator's own scene, sonar and motion.
//!
//! In: a configuration with recorded navigation. Out: for every method the error of element samples, lines and picture, the error of the
//! mean level and the milliseconds of a ping; or why it does not apply. Noise and converter are left out: they are the same for all.
//!
//! The reference solution is the direct sum of all scatterers on the continuous trajectory with second-order Doppler; what it is off by itself is measured at random
//! samples by the reference's equation and stands in the results: an error near it is only a bound.

pub mod methods;
pub mod metrics;
pub mod work;

use std::time::Instant;

use thiserror::Error;

use crate::chart::methods::Method;
use crate::chart::metrics::{Errors, errors};
use crate::recorded::{RecordedError, RecordedRig};
use crate::rig::OpenError;
use echotank_config::spec::{AutoModel, MadeOutput, MediumSpec, RigSpec, SonarSpec};
use echotank_core::flow::{PingOutput, PingPlan, Scatterers, Synthesis};
use echotank_core::time::UtcNs;
use echotank_ping::conditions::{conditions, sum_error_model};
use echotank_ping::method_selection::costs::Costs;
use echotank_ping::method_selection::{self, Swell, rank, sample, with_choice};
use echotank_ping::pipeline::SonarPipeline;
use echotank_ping::rig::pool;
use echotank_synthesis::echo::error_models::{doppler_error_model, path_error_model};

#[derive(Debug, Error)]
pub enum ChartError {
    #[error(transparent)]
    Recorded(#[from] RecordedError),
    #[error("threads: {0}")]
    Threads(#[from] rayon::ThreadPoolBuildError),
    #[error(transparent)]
    Rig(#[from] OpenError),
    #[error("ping {ping} of sonar {sonar}: the recorded navigation has a gap there")]
    Gap { ping: u32, sonar: String },
    #[error("the recorded navigation ends before ping {0}")]
    Short(u32),
    #[error("sonar {0} hears nothing in the pings looked at: there is nothing to compare")]
    Silent(String),
    #[error("the reference solution cannot be made for sonar {sonar}: {why}")]
    ReferenceSolution { sonar: String, why: String },
}

#[derive(Clone, Debug)]
pub struct ChartOptions {
    /// Pings looked at, evenly over `span_pings`.
    pub pings: u32,
    /// The last of them.
    pub span_pings: u32,
    /// Timed runs of each ping and method.
    pub repeats: usize,
    pub threads: usize,
    /// Which sonar.
    pub sonar: usize,
    /// Fewer methods.
    pub quick: bool,
}

/// One ping as every method gets it.
pub struct Scene {
    pub plan: PingPlan,
    pub scatterers: Scatterers,
}

/// Times of one method over pings and repeats, milliseconds.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Times {
    pub median_ms: f64,
    pub min_ms: f64,
    pub greatest_ms: f64,
}

#[derive(Clone, Debug)]
pub struct Measured {
    pub errors: Errors,
    pub times: Times,
    /// Making the method's tables, once.
    pub making_ms: f64,
}

/// One method with what it promised and what it did.
pub struct Row {
    pub method: Method,
    /// Path, Doppler and synthesis, as their error models have it; culling has none.
    pub predicted_error: f64,
    pub outcome: Result<Measured, String>,
    /// Nothing measured is both faster and better, by element samples.
    pub pareto: bool,
    /// What the configuration itself asks for.
    pub configured: bool,
    /// What the plan of methods chooses here, and what it predicts that to cost, milliseconds of one core.
    pub planned_ms: Option<f64>,
}

pub struct Chart {
    pub sonar: String,
    pub scatterers: usize,
    pub elements: usize,
    pub pings: usize,
    pub threads: usize,
    pub tolerance: f64,
    /// Of the reference solution against the reference: relative l2 over `samples` random samples.
    pub reference_error: Option<(f64, u32)>,
    /// Gathering the scatterers, the same for every method.
    pub gather_ms: f64,
    pub rows: Vec<Row>,
}

/// Noise, converter and error checks are no part of what is compared.
pub fn bare(spec: &SonarSpec) -> SonarSpec {
    let mut spec = spec.clone();
    spec.receiver.noise_db = None;
    spec.receiver.adc_bits = None;
    spec.synthesis.error_check = false;
    spec.synthesis.output = MadeOutput::Elements;
    spec
}

/// The pings that are looked at, as [`Scene`]s, and the mean milliseconds that gathering them took.
pub fn scenes(spec: &RigSpec, options: &ChartOptions) -> Result<(Vec<Scene>, f64), ChartError> {
    // The rig itself computes nothing here: the cheapest pipeline will do, and it makes no tables.
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
        recorded.pulsed(sonar, &order);
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

/// The scene's ping under another choice of methods.
fn plan_under(scene: &Scene, spec: &SonarSpec) -> PingPlan {
    let mut plan = scene.plan.clone();
    plan.model = spec.model;
    let window_s = plan.window_s(spec.receiver.sample_rate_hz);
    let segment_s = spec.model.segment_s;
    echotank_ping::polyline(&plan.trajectory, window_s, segment_s, &mut plan.segments);
    plan
}

/// Runs one method over all scenes: its outputs and times. `repeats` timed runs after one that warms up.
pub(crate) fn run_method(
    spec: &SonarSpec,
    medium: &MediumSpec,
    scenes: &[Scene],
    repeats: usize,
) -> Result<(Vec<PingOutput>, Times, f64), String> {
    let began = Instant::now();
    let mut pipeline = SonarPipeline::new(spec, medium).map_err(|why| why.to_string())?;
    let making_ms = began.elapsed().as_secs_f64() * 1e3;
    // Only the reference solution has any, and here they need not be cheap.
    pipeline.allow_error_checks(f64::INFINITY);
    let mut outputs = Vec::new();
    let mut times_ms = Vec::new();
    for scene in scenes {
        let plan = plan_under(scene, spec);
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
        greatest_ms: at(1.0).unwrap_or(0.0),
    };
    Ok((outputs, times, making_ms))
}

/// Measures every method; `progress` is told what comes next and how many there are.
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
        let run = |under: &SonarSpec| -> Result<Measured, String> {
            let (outputs, times, making_ms) = run_method(under, medium, &scenes, options.repeats)?;
            Ok(Measured {
                errors: errors(&outputs, &truth),
                times,
                making_ms,
            })
        };
        // Where the plan is asked, it is what is configured.
        let auto = sonar.synthesis.auto.any();
        let configured = (!auto).then(|| Method::of(&sonar));
        let mut rows = Vec::new();
        for method in methods.into_iter().skip(usize::from(auto)) {
            progress(&method.to_string(), 0);
            let under = method.on(&sonar);
            let predicted_error = scenes
                .iter()
                .map(|scene| predicted(&under, &plan_under(scene, &under), &scene.scatterers))
                .fold(0.0, f64::max);
            rows.push(Row {
                configured: Some(method) == configured,
                method,
                predicted_error,
                outcome: method.applies(&sonar).and_then(|()| run(&under)),
                pareto: false,
                planned_ms: None,
            });
        }
        progress("the plan's choice", 0);
        let costs = crate::rig::costs_of(spec.run.costs.as_deref())?;
        if let Some(plan) = plan(&sonar, medium, &scenes[0], &costs) {
            rows.push(Row {
                configured: auto,
                method: Method::of(&plan.spec).made_for(plan.spec.synthesis.made_for()),
                predicted_error: plan.error,
                outcome: run(&plan.spec),
                pareto: false,
                planned_ms: Some(plan.cost_ms),
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

/// The plan of methods for this sonar, and what it predicts.
struct Planned {
    spec: SonarSpec,
    error: f64,
    cost_ms: f64,
}

/// As the configuration asks for it; where that fixes its methods, as if it left everything to the plan.
fn plan(sonar: &SonarSpec, medium: &MediumSpec, scene: &Scene, costs: &Costs) -> Option<Planned> {
    let mut spec = sonar.clone();
    // What is charted are errors of elements.
    spec.synthesis.output = MadeOutput::Elements;
    if !spec.synthesis.auto.any() {
        spec.synthesis.auto = AutoModel {
            path: true,
            segment: true,
            doppler: true,
            synthesis: true,
            cull: true,
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
            swell: Swell::NONE,
        },
        &[],
    )?;
    let chosen = ranking.chosen();
    Some(Planned {
        spec: with_choice(sonar, &chosen.choice),
        error: chosen.error(),
        cost_ms: chosen.cost_ms(),
    })
}

/// Path, Doppler and synthesis together; what culling leaves out has no error model.
fn predicted(spec: &SonarSpec, plan: &PingPlan, scatterers: &Scatterers) -> f64 {
    let conditions = conditions(spec, plan, scatterers);
    let model = &spec.model;
    let synthesis = sum_error_model(model.synthesis, spec, plan, &conditions).error;
    match model.synthesis {
        // On the trajectory itself, whatever path and Doppler say.
        Synthesis::Reference => synthesis,
        _ => {
            path_error_model(model.path, &conditions).error
                + doppler_error_model(model.doppler, model.path, &conditions).error
                + synthesis
        }
    }
}

/// The outputs that all others are held against, and how far they are from the reference at random samples.
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
        .map(|c| (c.error, c.samples));
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
