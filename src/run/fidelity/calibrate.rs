//! Measures what methods cost on this machine: every way to sum and move is timed on a configuration's own sonars and scene, and the table of costs
//! is fitted to the times.
//!
//! The fit is in logarithms, since a factor is what matters, and holds on to the table it starts from where the times say nothing.

use thiserror::Error;

use crate::config::spec::{AutoModel, RigSpec};
use crate::ping::fidelity::{Candidate, FIGURES};
use crate::run::chart::{self, ChartError, bare, run_method};
use crate::run::fidelity::costs::Costs;
use crate::run::fidelity::first::{FirstError, first};
use crate::run::fidelity::with_choice;
use crate::run::rig::pool;

/// Timed runs of each method; the least counts, since all that disturbs a run makes it longer.
const REPEATS: usize = 3;
/// Methods that would take longer are left out, ms.
const LONGEST_MS: f64 = 3000.0;
/// Weight of staying where the table was, against one method's.
const HOLD: f64 = 1e-3;
/// Rounds of the search.
const ROUNDS: usize = 400;

#[derive(Debug, Error)]
pub enum CalibrateError {
    #[error(transparent)]
    First(#[from] FirstError),
    #[error(transparent)]
    Chart(#[from] ChartError),
    #[error("threads: {0}")]
    Threads(#[from] rayon::ThreadPoolBuildError),
}

pub struct Calibration {
    pub costs: Costs,
    pub methods: usize,
    /// exp of the rms of log(predicted / measured), by the table before and by this one.
    pub before: f64,
    pub after: f64,
}

/// One method: what it is predicted to cost per figure of the table, and what it took.
struct Timed {
    /// ms, in the order of [`Costs::values`], under the table before.
    parts_ms: [f64; FIGURES],
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
        let mut timed = Vec::new();
        for sonar in 0..spec.sonars.len() {
            timed.extend(time(spec, sonar, before)?);
        }
        let values = fit(&timed);
        let spread = |factors: &[f64; FIGURES]| {
            let squares = timed.iter().map(|t| residual(t, factors).powi(2));
            (squares.sum::<f64>() / timed.len().max(1) as f64)
                .sqrt()
                .exp()
        };
        let mut new = before.values();
        for (value, factor) in new.iter_mut().zip(values) {
            // Three digits are more than a machine keeps.
            let exact = *value * factor;
            let digits = 10f64.powf(2.0 - exact.log10().floor());
            *value = (exact * digits).round() / digits;
        }
        let mut costs = before.with_values(new);
        costs.machine = format!(
            "{machine}; one thread, {} methods on sonar {} and those beside it",
            timed.len(),
            spec.sonars[0].name
        );
        Ok(Calibration {
            costs,
            methods: timed.len(),
            before: spread(&[1.0; FIGURES]),
            after: spread(&values),
        })
    })
}

/// Times one candidate of every kind.
fn time(spec: &RigSpec, sonar: usize, costs: &Costs) -> Result<Vec<Timed>, CalibrateError> {
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
    let mut firsts = first(&open, costs)?;
    let one = firsts.swap_remove(sonar);
    let Some(ranking) = one.ranking else {
        return Ok(Vec::new());
    };
    let scenes = [chart::Scene {
        plan: one.plan,
        scatterers: one.scatterers,
    }];
    let plain = bare(&spec.sonars[sonar]);
    let mut seen: Vec<String> = Vec::new();
    let mut timed = Vec::new();
    for candidate in &ranking.candidates {
        let kind = format!(
            "{} {} {} {:?}",
            candidate.choice.model.path.name(),
            candidate.choice.model.doppler.name(),
            candidate.choice.model.synthesis.name(),
            candidate.choice.engine_tolerance
        );
        if seen.contains(&kind) || candidate.cost_ms() > LONGEST_MS {
            continue;
        }
        seen.push(kind);
        let mut under = with_choice(&plain, &candidate.choice);
        under.beams = Default::default();
        under.more_pulses.clear();
        if let Ok((_, times, _)) = run_method(&under, &spec.medium, &scenes, REPEATS) {
            timed.push(Timed {
                parts_ms: parts_ms(candidate, costs),
                took_ms: times.least_ms,
            });
        }
    }
    Ok(timed)
}

/// A candidate's cost, figure by figure.
fn parts_ms(candidate: &Candidate, costs: &Costs) -> [f64; FIGURES] {
    let mut all = [0.0; FIGURES];
    for part in &candidate.parts {
        for ((all, work), ns) in all.iter_mut().zip(part.work).zip(costs.values()) {
            *all += 1e-6 * work * ns;
        }
    }
    all
}

fn residual(timed: &Timed, factors: &[f64; FIGURES]) -> f64 {
    let parts = timed.parts_ms.iter().zip(factors);
    let predicted_ms: f64 = parts.map(|(ms, factor)| ms * factor).sum();
    (predicted_ms / timed.took_ms.max(1e-6)).max(1e-9).ln()
}

/// Factors on the table: least squares of logarithms, one figure after another by halving steps.
fn fit(timed: &[Timed]) -> [f64; FIGURES] {
    let loss = |logs: &[f64; FIGURES]| {
        let factors = logs.map(f64::exp);
        let misses: f64 = timed.iter().map(|t| residual(t, &factors).powi(2)).sum();
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
        let mut factors = [1.0; FIGURES];
        (factors[0], factors[4], factors[11]) = (3.0, 0.4, 1.7);
        let timed: Vec<Timed> = (0..40)
            .map(|k| {
                let mut parts_ms = [0.0; FIGURES];
                parts_ms[0] = 1.0 + (k % 3) as f64;
                parts_ms[4] = (k % 5) as f64;
                parts_ms[11] = (k % 7) as f64;
                let parts = parts_ms.iter().zip(factors);
                Timed {
                    took_ms: parts.map(|(ms, f)| ms * f).sum(),
                    parts_ms,
                }
            })
            .collect();
        let got = fit(&timed);
        for k in [0, 4, 11] {
            assert!((got[k] / factors[k] - 1.0).abs() < 0.02, "{k}: {got:?}");
        }
        assert!((got[2] - 1.0).abs() < 1e-9, "no method has it: {got:?}");
    }
}
