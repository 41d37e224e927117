//! Calibrates the cost table of method selection on this machine.
//!
//! Methods are timed on one thread, on the configured sonars and scene and on synthetic benchmarks (`benches`). The cost table is fitted
//! to the times. The fit is in logarithms, because relative errors matter. A weak penalty keeps entries without data at their previous
//! values times the speed of the machine.

use std::time::{Duration, Instant};

use thiserror::Error;

mod benches;

use self::benches::benches;
use crate::chart::bare;
use crate::first_pings::{FirstPingError, first};
use echotank_config::spec::{AutoModel, MediumSpec, RigSpec, SonarSpec};
use echotank_core::model::{DopplerModel, PathModel};
use echotank_core::ping::PingPlan;
use echotank_core::scene::Scatterers;
use echotank_ping::method_selection::costs::Costs;
use echotank_ping::method_selection::{MotionScale, Scene, rank, with_choice};
use echotank_ping::methods::{Candidate, Ranking};
use echotank_ping::pipeline::SonarPipeline;
use echotank_ping::polyline;
use echotank_ping::threads::pool;
use echotank_ping::work::{FIGURES, Figure, Work};

/// Time limit of the whole calibration.
const MAX_TOTAL: Duration = Duration::from_secs(130);
/// Time limit of the configured sonars.
const MAX_CONFIGURED: Duration = Duration::from_secs(50);
/// Time spent on one method. The minimum counts, because disturbances only lengthen a run.
const PER_METHOD: Duration = Duration::from_millis(150);
/// Bytes that are written before each run, more than a core's own caches hold: between two pings, the other stages and sonars have used them. In
/// `tools/accuracy rigs`, which takes turns with many methods, small pings took up to 1.9 times as long as right after a run of the same method.
const EVICTED_BYTES: usize = 8 << 20;
/// Bytes that a cache keeps together.
const CACHE_LINE: usize = 64;
/// Maximum number of runs of one method.
const MAX_RUNS: usize = 30;
/// Estimated cost above which a method is skipped, ms.
const MAX_COST_MS: f64 = 800.0;
/// Minimum measured time for use in the fit, ms.
const MIN_TIME_MS: f64 = 0.03;
/// Weight of the penalty on changes of the table other than of all its figures, relative to one method. Figures that few methods tell apart stay near the
/// table: with 1e-3, an element of a ping took 300 times as long as in it, and 200 random rigs were predicted less well (`tools/accuracy rigs`).
const PRIOR_WEIGHT: f64 = 0.1;
/// Rounds of the search.
const ROUNDS: usize = 400;

/// Errors of a calibration.
#[derive(Debug, Error)]
pub enum CalibrateError {
    /// A first ping cannot be planned.
    #[error(transparent)]
    First(#[from] FirstPingError),
    /// The threads for computing cannot be started.
    #[error("threads: {0}")]
    Threads(#[from] rayon::ThreadPoolBuildError),
}

/// A fitted cost table with the measurements behind it.
pub struct Calibration {
    /// Fitted cost table.
    pub costs: Costs,
    /// Per method: description, time predicted by the new table, measured time, both ms.
    pub methods: Vec<(String, f64, f64)>,
    /// Root-mean-square of log(predicted / measured) with the previous table, as exp of that value.
    pub before: f64,
    /// The same measure with the fitted table.
    pub after: f64,
}

/// Work and measured time of one method.
struct Timed {
    name: String,
    work: Work,
    took_ms: f64,
}

/// Times methods on this machine and fits the cost table, starting from `before`. `machine` describes the machine in the table.
///
/// # Errors
/// A first ping cannot be planned, or the threads cannot be started.
pub fn calibrate(
    spec: &RigSpec,
    before: &Costs,
    machine: &str,
) -> Result<Calibration, CalibrateError> {
    let pool = pool(1)?;
    pool.install(|| {
        let began = Instant::now();
        let mut timed = configured(spec, before, began + MAX_CONFIGURED)?;
        let mut all = true;
        for bench in benches() {
            let scene = Scene {
                spec: &bench.spec,
                medium: &bench.medium,
                plan: &bench.plan,
                scatterers: &bench.scatterers,
                count: bench.scatterers.len(),
                costs: before,
                motion_scale: MotionScale::NONE,
            };
            if let Some(ranking) = rank(&scene, &[]) {
                let case = TimingCase {
                    name: "bench",
                    spec: &bench.spec,
                    medium: &bench.medium,
                    plan: &bench.plan,
                    scatterers: &bench.scatterers,
                };
                all &= case.time(&ranking, began + MAX_TOTAL, &mut timed);
            }
        }
        let speed = speed(&timed, &before.ns);
        let mut factors = fit(&timed, &before.ns, speed);
        // The stages that no method changes are not timed: they follow the machine's speed.
        for (factor, figure) in factors.iter_mut().zip(Figure::ALL) {
            if !figure.is_of_methods() {
                *factor = speed;
            }
        }
        let spread = |ns: &Work| {
            let squares = timed.iter().map(|t| residual(t, ns).powi(2));
            (squares.sum::<f64>() / timed.len().max(1) as f64)
                .sqrt()
                .exp()
        };
        let mut ns = Work::NONE;
        for (k, &figure) in Figure::ALL.iter().enumerate() {
            // Three significant digits exceed the repeatability.
            let exact = before.ns[figure] * factors[k];
            let digits = 10f64.powf(2.0 - exact.log10().floor());
            ns[figure] = (exact * digits).round() / digits;
        }
        let costs = Costs {
            machine: format!(
                "{machine}; one thread, {} methods on {} and sonars to measure by{}",
                timed.len(),
                spec.sonars[0].name,
                if all { "" } else { ", cut short" }
            ),
            ns,
        };
        Ok(Calibration {
            before: spread(&before.ns),
            after: spread(&ns),
            methods: timed
                .into_iter()
                .map(|t| (t.name, costs.ms(&t.work), t.took_ms))
                .collect(),
            costs,
        })
    })
}

/// Times the methods on the configured sonars.
fn configured(spec: &RigSpec, costs: &Costs, until: Instant) -> Result<Vec<Timed>, CalibrateError> {
    let mut open = spec.clone();
    // Ranks all methods, even if the configuration fixes some.
    for sonar in &mut open.sonars {
        sonar.synthesis.auto = AutoModel {
            path: true,
            segment: true,
            doppler: true,
            synthesis: true,
        };
    }
    let mut timed = Vec::new();
    for (sonar, one) in spec.sonars.iter().zip(first(&open, costs)?) {
        let Some(ranking) = one.ranking else {
            continue;
        };
        let case = TimingCase {
            name: &sonar.name,
            spec: sonar,
            medium: &spec.medium,
            plan: &one.plan,
            scatterers: &one.scatterers,
        };
        case.time(&ranking, until, &mut timed);
    }
    Ok(timed)
}

/// A ping on which methods are timed.
struct TimingCase<'a> {
    name: &'a str,
    spec: &'a SonarSpec,
    medium: &'a MediumSpec,
    plan: &'a PingPlan,
    scatterers: &'a Scatterers,
}

impl TimingCase<'_> {
    /// Times one candidate of every kind. Returns false if the time limit ended it early.
    fn time(&self, ranking: &Ranking, until: Instant, timed: &mut Vec<Timed>) -> bool {
        let mut spec = bare(self.spec);
        spec.beams = Default::default();
        spec.more_pulses.clear();
        let mut seen: Vec<String> = Vec::new();
        for candidate in ranking.candidates.iter().filter(|c| is_representative(c)) {
            let model = &candidate.choice.model;
            let name = format!(
                "{}: {} {} ms, {}, {} {:.1e}",
                self.name,
                model.path.name(),
                1e3 * model.segment_s,
                model.doppler.name(),
                model.synthesis.name(),
                candidate.choice.engine_tolerance.unwrap_or(0.0)
            );
            if seen.contains(&name) || candidate.cost_ms() > MAX_COST_MS {
                continue;
            }
            if Instant::now() > until {
                return false;
            }
            let took_ms = self.min_ms(&with_choice(&spec, &candidate.choice));
            if let Some(took_ms) = took_ms.filter(|ms| *ms > MIN_TIME_MS) {
                let parts = candidate.parts.iter();
                timed.push(Timed {
                    name: name.clone(),
                    work: parts.fold(Work::NONE, |sum, part| sum.plus(&part.work)),
                    took_ms,
                });
            }
            seen.push(name);
        }
        true
    }

    fn min_ms(&self, spec: &SonarSpec) -> Option<f64> {
        let mut pipeline = SonarPipeline::new(spec, self.medium).ok()?;
        let mut plan = self.plan.clone();
        plan.model = spec.model;
        let window_s = plan.window_s(spec.receiver.sample_rate_hz);
        let segment_s = spec.model.segment_s;
        polyline(&plan.trajectory, window_s, segment_s, &mut plan.segments);
        let mut output = pipeline.blank_output();
        let began = Instant::now();
        let mut min_ms = f64::INFINITY;
        let mut others = vec![0u8; EVICTED_BYTES];
        for run in 0..MAX_RUNS {
            for byte in others.iter_mut().step_by(CACHE_LINE) {
                *byte = std::hint::black_box(byte.wrapping_add(1));
            }
            let run_began = Instant::now();
            pipeline.compute_ping(&plan, self.scatterers, &mut output);
            // The first run is a warm-up.
            if run > 0 {
                min_ms = min_ms.min(1e3 * run_began.elapsed().as_secs_f64());
                if began.elapsed() > PER_METHOD {
                    break;
                }
            }
        }
        Some(min_ms)
    }
}

/// Selects enough path and Doppler models to exercise every cost figure.
fn is_representative(candidate: &Candidate) -> bool {
    let model = &candidate.choice.model;
    let segment_ms = (1e3 * model.segment_s).round() as u32;
    match (model.path, model.doppler) {
        (PathModel::StopAndHop, DopplerModel::None) => true,
        (PathModel::KSegment, DopplerModel::Stretch) => segment_ms == 10 || segment_ms == 1,
        (PathModel::KSegment, DopplerModel::StretchQuadratic) => segment_ms == 10,
        (PathModel::Continuous, DopplerModel::StretchQuadratic) => true,
        _ => false,
    }
}

fn residual(timed: &Timed, ns: &Work) -> f64 {
    let parts = Figure::ALL.iter().map(|&f| 1e-6 * ns[f] * timed.work[f]);
    let predicted_ms: f64 = parts.sum();
    (predicted_ms / timed.took_ms.max(1e-6)).max(1e-9).ln()
}

/// Median of the methods' measured times over those that the table predicts; 1 without methods.
fn speed(timed: &[Timed], before: &Work) -> f64 {
    let mut all: Vec<f64> = timed.iter().map(|t| residual(t, before)).collect();
    all.sort_by(f64::total_cmp);
    all.get(all.len() / 2).map_or(1.0, |middle| (-middle).exp())
}

/// Fits factors on the table `before`: least squares of logarithms by coordinate search with halving steps. Figures without data have the factor `speed`.
fn fit(timed: &[Timed], before: &Work, speed: f64) -> [f64; FIGURES] {
    let middle = speed.ln();
    let loss = |logs: &[f64; FIGURES]| {
        let mut ns = Work::NONE;
        for (&figure, log) in Figure::ALL.iter().zip(logs) {
            ns[figure] = before[figure] * log.exp();
        }
        let misses: f64 = timed.iter().map(|t| residual(t, &ns).powi(2)).sum();
        misses + PRIOR_WEIGHT * logs.iter().map(|l| (l - middle).powi(2)).sum::<f64>()
    };
    let mut logs = [middle; FIGURES];
    let mut step = 1.0;
    let mut least = loss(&logs);
    for _ in 0..ROUNDS {
        let mut better = false;
        for k in 0..FIGURES {
            for sign in [-1.0, 1.0] {
                let mut tried = logs;
                tried[k] += sign * step;
                let this = loss(&tried);
                if this < least {
                    (least, logs, better) = (this, tried, true);
                }
            }
        }
        if !better {
            step *= 0.5;
        }
    }
    logs.map(f64::exp)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_fit_recovers_known_factors() {
        let before = Costs::committed().ns;
        let (far, near) = (Figure::Pair, Figure::DirectPoint);
        let mut true_ns = before;
        true_ns[far] *= 3.0;
        true_ns[near] *= 0.4;
        true_ns[Figure::Gridded1dEcho] *= 1.7;
        // About as many as a calibration times: the penalty counts the less, the more there are.
        let timed: Vec<Timed> = (0..220)
            .map(|k| {
                let work = Work::of(far, 1e6 * (1.0 + (k % 3) as f64))
                    .and(near, 1e8 * (k % 5) as f64)
                    .and(Figure::Gridded1dEcho, 1e7 * (k % 7) as f64);
                let parts = Figure::ALL.iter().map(|&f| 1e-6 * true_ns[f] * work[f]);
                Timed {
                    name: String::new(),
                    took_ms: parts.sum(),
                    work,
                }
            })
            .collect();
        let got = fit(&timed, &before, 1.0);
        for (figure, want) in [(far, 3.0), (near, 0.4), (Figure::Gridded1dEcho, 1.7)] {
            let got = got[figure as usize];
            assert!(
                (got / want - 1.0).abs() < 0.02,
                "{}: {got}, {want}",
                figure.name()
            );
        }
        let unused = got[Figure::SpectralBin as usize];
        assert!((unused - 1.0).abs() < 1e-9, "no method uses it: {unused}");
        // On a slower machine, figures without data are slower too.
        let unused = fit(&timed, &before, 2.0)[Figure::SpectralBin as usize];
        assert!((unused - 2.0).abs() < 1e-9, "no method uses it: {unused}");
    }
}
