//! Measures selected and other methods for one ping, against the continuous trajectory with second-order Doppler.

use std::time::Instant;

use serde::{Deserialize, Serialize};

use echotank_config::spec::{RigSpec, SonarSpec};
use echotank_core::arrays::TimeVaryingGain;
use echotank_core::ping::{PingOutput, PingPlan};
use echotank_core::scene::Scatterers;
use echotank_ping::method_selection::costs::Costs;
use echotank_ping::method_selection::with_choice;
use echotank_ping::methods::{Candidate, Choice, Family, Ranking};
use echotank_ping::pipeline::{PipelineError, SonarPipeline};
use echotank_ping::polyline;
use echotank_runtime::chart::bare;
use echotank_runtime::first_pings::{FirstPingError, first, pings};

use super::reference::{Ping, ReferenceSolution};

/// Number of timed runs of every candidate, in turn. The minimum counts.
const REPEATS: usize = 5;
/// Ratio of a candidate's predicted cost to that of the selection above which the candidate is not timed. No such candidate was
/// ever the cheapest.
const WORTH_TIMING: f64 = 4.0;
/// Maximum error of the reference solution for a valid result, as a fraction of the tolerance.
const FINE_REFERENCE: f64 = 0.1;
/// Maximum number of other candidates.
const OTHERS: usize = 12;
/// Times the cheapest choice, up to which a cost counts as near it.
pub(crate) const NEAR_COST: f64 = 1.3;
/// Numbers of passed pings after which a candidate that undercuts the selection is measured again: a fixed choice keeps the tolerance in a run, not in one ping.
const LATER: [u32; 9] = [4, 8, 12, 16, 20, 24, 28, 32, 36];

/// Result of one candidate on one ping.
#[derive(Clone, Serialize, Deserialize)]
pub(crate) struct CandidateResult {
    pub(crate) text: String,
    /// Predicted errors by method family.
    pub(crate) parts: [f64; Family::ALL.len()],
    pub(crate) predicted_error: f64,
    pub(crate) predicted_ms: f64,
    /// Largest error of any window of any element, over the level of the window or 55 dB below the strongest window of the ping, whichever is
    /// higher. The worst windows of the selection are computed again by the equation of the reference. If the
    /// reference solution is too coarse, this is an error check over 128 random samples.
    pub(crate) error: f64,
    pub(crate) by_error_check: bool,
    pub(crate) ms: f64,
    /// True if the candidate is predicted to meet the goal.
    pub(crate) promised: bool,
    /// Largest error on later pings, of candidates that are cheaper than the selection by more than [`NEAR_COST`] without being predicted to meet the
    /// goal.
    #[serde(default)]
    pub(crate) later_error: Option<f64>,
}

impl CandidateResult {
    /// True if no measured ping exceeds the tolerance.
    pub(crate) fn keeps(&self, tolerance: f64) -> bool {
        self.error <= tolerance && self.later_error.is_none_or(|error| error <= tolerance)
    }
}

#[derive(Clone, Serialize, Deserialize)]
pub(crate) struct Measured {
    pub(crate) sonar: String,
    pub(crate) tolerance: f64,
    pub(crate) scatterers: usize,
    pub(crate) elements: usize,
    /// Error of the reference solution at random samples, by the reference's equation.
    pub(crate) reference: Option<f64>,
    pub(crate) plan: CandidateResult,
    pub(crate) others: Vec<CandidateResult>,
    /// True if the selection itself predicts that it misses the goal.
    pub(crate) out_of_reach: bool,
}

impl Measured {
    /// The full result: a line for the selection and one for each other candidate.
    pub(crate) fn said(&self) -> String {
        let did = |did: &CandidateResult| {
            format!(
                "{:.1e} measured{}{}, {:.1e} predicted ({}), {:.2} ms, {:.2} predicted{}: {}",
                did.error,
                if did.by_error_check {
                    " by error check"
                } else {
                    ""
                },
                did.later_error.map_or_else(String::new, |error| format!(
                    " ({error:.1e} on later pings)"
                )),
                did.predicted_error,
                did.parts.map(|part| format!("{part:.1e}")).join(" + "),
                did.ms,
                did.predicted_ms,
                if did.promised {
                    ""
                } else {
                    ", above the tolerance"
                },
                did.text
            )
        };
        let mut lines = vec![format!(
            "{}: tolerance {:.1e}, reference solution {:?}, {} scatterers, {} elements: {}",
            self.sonar,
            self.tolerance,
            self.reference,
            self.scatterers,
            self.elements,
            did(&self.plan)
        )];
        lines.extend(self.others.iter().map(did));
        lines.join("\n    ")
    }
}

#[derive(Debug, thiserror::Error)]
pub(crate) enum MeasureError {
    #[error(transparent)]
    First(#[from] FirstPingError),
    #[error("{0}")]
    Pipeline(#[from] PipelineError),
}

/// Measures the first ping of every sonar that receives an echo. Call inside the pool. If `time` is true, other candidates are also
/// measured.
pub(crate) fn measure(
    rig: &RigSpec,
    costs: &Costs,
    time: bool,
) -> Result<Vec<Measured>, MeasureError> {
    let mut all = Vec::new();
    // The reference includes scatterers that culling removes.
    let mut uncut = rig.clone();
    for sonar in &mut uncut.sonars {
        sonar.model.cull_db = None;
    }
    let whole = pings(&uncut, 0)?;
    let firsts = rig.sonars.iter().zip(first(rig, costs)?);
    for (sonar, ((spec, first), (_, everything))) in firsts.zip(&whole).enumerate() {
        let Some(ranking) = &first.ranking else {
            continue;
        };
        if first.scatterers.is_empty() {
            continue;
        }
        let spec = elements_alone(spec);
        let ping = Ping {
            spec: &spec,
            medium: &rig.medium,
            plan: &first.plan,
            everything,
        };
        let mut gathered = Gathered {
            rig,
            sonar,
            by_floor: vec![(rig.sonars[sonar].model.cull_db, first.scatterers)],
        };
        let Some((mut measured, choices)) = one(&ping, &mut gathered, ranking, time)? else {
            continue;
        };
        let (tolerance, enough_ms) = (measured.tolerance, measured.plan.ms / NEAR_COST);
        for (other, choice) in measured.others.iter_mut().zip(choices) {
            let undercuts = other.ms < enough_ms && other.error <= tolerance;
            if undercuts && !other.promised && !other.by_error_check {
                let error = later_error(&uncut, rig, sonar, &choice, tolerance)?;
                other.later_error = Some(error);
            }
        }
        all.push(measured);
    }
    Ok(all)
}

/// The sonar as its element samples are compared: without beams, further pulses and receiver chain.
fn elements_alone(spec: &SonarSpec) -> SonarSpec {
    let mut spec = bare(spec);
    spec.beams = Default::default();
    spec.more_pulses.clear();
    spec.receiver.tvg = TimeVaryingGain::None;
    spec
}

/// Largest error of a choice on the pings after [`LATER`] ones, or the first one above the tolerance. `uncut` is the rig without culling.
fn later_error(
    uncut: &RigSpec,
    rig: &RigSpec,
    sonar: usize,
    choice: &Choice,
    tolerance: f64,
) -> Result<f64, MeasureError> {
    let spec = elements_alone(&rig.sonars[sonar]);
    let mut culled = rig.clone();
    culled.sonars[sonar].model.cull_db = choice.model.cull_db;
    let mut worst: f64 = 0.0;
    for passed in LATER {
        let (plan, everything) = match pings(uncut, passed) {
            // The log ends.
            Err(FirstPingError::Gaps(_)) => break,
            planned => planned?.swap_remove(sonar),
        };
        let (_, scatterers) = pings(&culled, passed)?.swap_remove(sonar);
        let ping = Ping {
            spec: &spec,
            medium: &rig.medium,
            plan: &plan,
            everything: &everything,
        };
        let reference = ReferenceSolution::new(&ping)?;
        if reference.is_silent() {
            continue;
        }
        let mut runner = Runner::new(&ping, &with_choice(&spec, choice))?;
        runner.run(&scatterers);
        worst = worst.max(reference.worst(&runner.output));
        if worst > tolerance {
            break;
        }
    }
    Ok(worst)
}

/// Scatterers of the ping of one sonar, down to the floor of each candidate. A pipeline gathers no more.
struct Gathered<'a> {
    rig: &'a RigSpec,
    sonar: usize,
    by_floor: Vec<(Option<f64>, Scatterers)>,
}

impl Gathered<'_> {
    /// Index of the scatterers down to this floor.
    fn down_to(&mut self, cull_db: Option<f64>) -> Result<usize, FirstPingError> {
        if let Some(k) = self.by_floor.iter().position(|(db, _)| *db == cull_db) {
            return Ok(k);
        }
        let mut rig = self.rig.clone();
        rig.sonars[self.sonar].model.cull_db = cull_db;
        let (_, scatterers) = pings(&rig, 0)?.swap_remove(self.sonar);
        self.by_floor.push((cull_db, scatterers));
        Ok(self.by_floor.len() - 1)
    }
}

/// One candidate's pipeline with its plan and output.
struct Runner {
    pipeline: SonarPipeline,
    plan: PingPlan,
    output: PingOutput,
    min_ms: f64,
}

impl Runner {
    fn new(ping: &Ping, spec: &SonarSpec) -> Result<Self, PipelineError> {
        let mut plan = ping.plan.clone();
        plan.model = spec.model;
        let window_s = plan.window_s(spec.receiver.sample_rate_hz);
        polyline(
            &plan.trajectory,
            window_s,
            plan.model.segment_s,
            &mut plan.segments,
        );
        let pipeline = SonarPipeline::new(spec, ping.medium)?;
        let output = pipeline.blank_output();
        Ok(Self {
            pipeline,
            plan,
            output,
            min_ms: f64::INFINITY,
        })
    }

    fn run(&mut self, scatterers: &Scatterers) {
        let began = Instant::now();
        self.pipeline
            .compute_ping(&self.plan, scatterers, &mut self.output);
        self.min_ms = self.min_ms.min(began.elapsed().as_secs_f64() * 1e3);
    }
}

/// Measures the selection and other candidates, whose choices are returned beside.
fn one(
    ping: &Ping,
    gathered: &mut Gathered,
    ranking: &Ranking,
    time: bool,
) -> Result<Option<(Measured, Vec<Choice>)>, MeasureError> {
    let reference = ReferenceSolution::new(ping)?;
    if reference.is_silent() {
        return Ok(None);
    }
    let own_error = time.then(|| reference.own_error());
    let mut looked_at: Vec<&Candidate> = vec![ranking.chosen()];
    if time {
        looked_at.extend(others(ranking));
    }
    let mut runners = Vec::new();
    for (k, candidate) in looked_at.into_iter().enumerate() {
        match Runner::new(ping, &with_choice(ping.spec, &candidate.choice)) {
            Ok(runner) => {
                let heard = gathered.down_to(candidate.choice.model.cull_db)?;
                runners.push((candidate, heard, runner));
            }
            Err(why) if k == 0 => return Err(why.into()),
            Err(_) => {}
        }
    }
    for _ in 0..=REPEATS {
        for (_, heard, runner) in &mut runners {
            runner.run(&gathered.by_floor[*heard].1);
        }
        if !time {
            break;
        }
    }
    let coarse = own_error.is_some_and(|error| error > FINE_REFERENCE * ranking.goal.tolerance);
    let chosen = ranking.chosen();
    let mut did = runners
        .iter()
        .map(|(candidate, _, runner)| CandidateResult {
            by_error_check: coarse,
            text: candidate.text(),
            parts: Family::ALL.map(|family| candidate.part(family).error),
            predicted_error: candidate.error(),
            predicted_ms: candidate.cost_ms(),
            error: match (coarse, candidate.choice == chosen.choice) {
                (true, _) => reference.error_check(&runner.output),
                (false, true) => reference.worst_by_reference(&runner.output),
                (false, false) => reference.worst(&runner.output),
            },
            ms: runner.min_ms,
            promised: ranking.goal.meets(candidate),
            later_error: None,
        });
    let Some(plan) = did.next() else {
        return Ok(None);
    };
    let measured = Measured {
        sonar: ping.spec.name.clone(),
        tolerance: ranking.goal.tolerance,
        scatterers: gathered.by_floor[runners[0].1].1.len(),
        elements: ping.spec.receive.iter().map(|a| a.elements).sum(),
        reference: own_error,
        plan,
        others: did.collect(),
        out_of_reach: !ranking.is_within(),
    };
    let choices = runners[1..].iter().map(|(other, ..)| other.choice);
    Ok(Some((measured, choices.collect())))
}

/// One candidate of every kind, cheapest first: those predicted to meet the goal and, if there is room, some that are not.
fn others(ranking: &Ranking) -> Vec<&Candidate> {
    let kind = |c: &Candidate| {
        let Choice { model, .. } = c.choice;
        (
            model.path,
            model.doppler,
            model.synthesis,
            ranking.goal.meets(c),
        )
    };
    let limit_ms = WORTH_TIMING * ranking.chosen().cost_ms();
    let mut found: Vec<&Candidate> = Vec::new();
    for keeps in [true, false] {
        for candidate in &ranking.candidates {
            let worth = ranking.goal.meets(candidate) == keeps
                && candidate.cost_ms() <= limit_ms
                && candidate.choice != ranking.chosen().choice
                && ranking.goal.share(candidate) < 100.0;
            if worth && found.len() < OTHERS && !found.iter().any(|c| kind(c) == kind(candidate)) {
                found.push(candidate);
            }
        }
    }
    found
}
