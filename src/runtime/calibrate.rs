//! Measures what methods cost on this machine: ways to sum and move are timed on a configuration's own sonars and scene and on sonars of its own
//! ([`benches`]), one thread, and the table of costs is fitted to the times.
//!
//! The fit is in logarithms, since a factor is what matters, and holds on to the table it starts from where the times say nothing.

use std::time::{Duration, Instant};

use thiserror::Error;

mod benches;

use self::benches::benches;
use crate::chart::bare;
use crate::first_pings::{FirstError, first};
use echotank_config::spec::{AutoModel, MediumSpec, RigSpec, SonarSpec};
use echotank_core::flow::{DopplerModel, PathModel, PingPlan, Scatterers};
use echotank_ping::method_selection::costs::Costs;
use echotank_ping::method_selection::{Scene, Swell, rank, with_choice};
use echotank_ping::methods::{Candidate, Ranking};
use echotank_ping::pipeline::SonarPipeline;
use echotank_ping::polyline;
use echotank_ping::rig::pool;
use echotank_ping::work::{FIGURES, Figure, Work};

/// All of it takes no longer than this, and the configuration's own sonars no longer than that.
const LONGEST: Duration = Duration::from_secs(130);
const OWN: Duration = Duration::from_secs(50);
/// One method is run for so long, and so often at most; the least time counts, since all that disturbs a run makes it longer.
const EACH: Duration = Duration::from_millis(150);
const MAX_RUNS: usize = 30;
/// Methods that would take longer are left out, ms.
const LONGEST_MS: f64 = 800.0;
/// A ping shorter than this is not the plan's concern, ms.
const SHORTEST_MS: f64 = 0.03;
/// Weight of staying where the table was, against one method's.
const HOLD: f64 = 1e-3;
/// Rounds of the search.
const ROUNDS: usize = 400;

#[derive(Debug, Error)]
pub enum CalibrateError {
    #[error(transparent)]
    First(#[from] FirstError),
    #[error("threads: {0}")]
    Threads(#[from] rayon::ThreadPoolBuildError),
}

pub struct Calibration {
    pub costs: Costs,
    /// Every method: what it is, what the new table predicts, what it took, ms.
    pub methods: Vec<(String, f64, f64)>,
    /// exp of the rms of log(predicted / measured), by the table before and by this one.
    pub before: f64,
    pub after: f64,
}

/// One method: what it is made of, and what it took.
struct Timed {
    name: String,
    work: Work,
    took_ms: f64,
}

/// `machine`: whose figures they will be.
pub fn calibrate(
    spec: &RigSpec,
    before: &Costs,
    machine: &str,
) -> Result<Calibration, CalibrateError> {
    let pool = pool(1)?;
    pool.install(|| {
        let began = Instant::now();
        let mut timed = own(spec, before, began + OWN)?;
        let mut all = true;
        for bench in benches() {
            let scene = Scene {
                spec: &bench.spec,
                medium: &bench.medium,
                plan: &bench.plan,
                scatterers: &bench.scatterers,
                count: bench.scatterers.len(),
                costs: before,
                swell: Swell::NONE,
            };
            if let Some(ranking) = rank(&scene, &[]) {
                let place = Place {
                    name: "bench",
                    spec: &bench.spec,
                    medium: &bench.medium,
                    plan: &bench.plan,
                    scatterers: &bench.scatterers,
                };
                all &= place.time(&ranking, began + LONGEST, &mut timed);
            }
        }
        let factors = fit(&timed, &before.ns);
        let spread = |ns: &Work| {
            let squares = timed.iter().map(|t| residual(t, ns).powi(2));
            (squares.sum::<f64>() / timed.len().max(1) as f64)
                .sqrt()
                .exp()
        };
        let mut ns = Work::NONE;
        for (k, &figure) in Figure::ALL.iter().enumerate() {
            // Three digits are more than a machine keeps.
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

/// The configuration's own sonars.
fn own(spec: &RigSpec, costs: &Costs, until: Instant) -> Result<Vec<Timed>, CalibrateError> {
    let mut open = spec.clone();
    // Everything is tried, whatever the configuration says.
    for sonar in &mut open.sonars {
        sonar.synthesis.auto = AutoModel {
            path: true,
            segment: true,
            doppler: true,
            synthesis: true,
            cull: false,
        };
    }
    let mut timed = Vec::new();
    for (sonar, one) in spec.sonars.iter().zip(first(&open, costs)?) {
        let Some(ranking) = one.ranking else {
            continue;
        };
        let place = Place {
            name: &sonar.name,
            spec: sonar,
            medium: &spec.medium,
            plan: &one.plan,
            scatterers: &one.scatterers,
        };
        place.time(&ranking, until, &mut timed);
    }
    Ok(timed)
}

struct Place<'a> {
    name: &'a str,
    spec: &'a SonarSpec,
    medium: &'a MediumSpec,
    plan: &'a PingPlan,
    scatterers: &'a Scatterers,
}

impl Place<'_> {
    /// Times one candidate of every kind; false where there was no time for all.
    fn time(&self, ranking: &Ranking, until: Instant, timed: &mut Vec<Timed>) -> bool {
        let mut spec = bare(self.spec);
        spec.beams = Default::default();
        spec.more_pulses.clear();
        let mut seen: Vec<String> = Vec::new();
        for candidate in ranking.candidates.iter().filter(|c| says_much(c)) {
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
            if seen.contains(&name) || candidate.cost_ms() > LONGEST_MS {
                continue;
            }
            if Instant::now() > until {
                return false;
            }
            let took_ms = self.min_ms(&with_choice(&spec, &candidate.choice));
            if let Some(took_ms) = took_ms.filter(|ms| *ms > SHORTEST_MS) {
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
        for run in 0..MAX_RUNS {
            let run_began = Instant::now();
            pipeline.compute_ping(&plan, self.scatterers, &mut output);
            // The first warms up.
            if run > 0 {
                min_ms = min_ms.min(1e3 * run_began.elapsed().as_secs_f64());
                if began.elapsed() > EACH {
                    break;
                }
            }
        }
        Some(min_ms)
    }
}

/// Enough of the kinds that all figures show, and no more.
fn says_much(candidate: &Candidate) -> bool {
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

/// Factors on the table: least squares of logarithms, one figure after another by halving steps.
fn fit(timed: &[Timed], before: &Work) -> [f64; FIGURES] {
    let loss = |logs: &[f64; FIGURES]| {
        let mut ns = Work::NONE;
        for (&figure, log) in Figure::ALL.iter().zip(logs) {
            ns[figure] = before[figure] * log.exp();
        }
        let misses: f64 = timed.iter().map(|t| residual(t, &ns).powi(2)).sum();
        misses + HOLD * logs.iter().map(|l| l * l).sum::<f64>()
    };
    let mut logs = [0.0; FIGURES];
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
    fn a_fit_finds_the_factors_that_made_the_times() {
        let before = Costs::committed().ns;
        let (far, near) = (Figure::Pair, Figure::DirectPoint);
        let mut true_ns = before;
        true_ns[far] *= 3.0;
        true_ns[near] *= 0.4;
        true_ns[Figure::Gridded1dEcho] *= 1.7;
        let timed: Vec<Timed> = (0..40)
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
        let got = fit(&timed, &before);
        for (figure, want) in [(far, 3.0), (near, 0.4), (Figure::Gridded1dEcho, 1.7)] {
            let got = got[figure as usize];
            assert!(
                (got / want - 1.0).abs() < 0.02,
                "{}: {got}, {want}",
                figure.name()
            );
        }
        let untold = got[Figure::SpectralBin as usize];
        assert!((untold - 1.0).abs() < 1e-9, "no method has it: {untold}");
    }
}
