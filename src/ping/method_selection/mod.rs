//! The plan of methods for one sonar: asks the stages' error models what every choice would err by and cost in a ping's conditions, and has
//! [`crate::methods`] choose.
//!
//! In: a sonar with what of its model is left to the plan, a ping's plan and scatterers, the table of costs. Out: a [`Ranking`].
//! The same ping and table always give the same plan.

pub mod costs;
mod culled;
pub mod echo_statistics;
mod edges;
mod ends;
pub(crate) mod fades;
pub mod live;
mod moving;
pub mod parts;
mod promise;
mod resting;
mod sample_fades;
mod walked;

use std::sync::{Arc, Mutex, OnceLock, PoisonError};

use crate::conditions::{conditions, segment_step_s, sum_error_model};
use crate::element_synthesis::{FASTEST_PLATFORM_M_PER_S, filter_design, receiver_filter};
use crate::engines::{HARDEST_M_PER_S2, Sketch, is_line, sketch};
use crate::line_engines::{NOMINAL_SCATTERERS, SIDEWAYS_M_PER_S, choices};
use crate::method_selection::costs::Costs;
use crate::method_selection::culled::culling;
use crate::method_selection::echo_statistics::{Shares, quantities};
use crate::method_selection::moving::{IN_SELECTION, moving_error, moving_work, sum_error};
use crate::method_selection::parts::{Parting, partings};
use crate::method_selection::resting::{RestingPing, is_at_rest};
use crate::method_selection::walked::{WalkLengths, direct_runs, flank_points};
use crate::methods::{
    Candidate, Choice, Displaced, EXTREMES, EchoError, Family, Goal, Part, Ranking, choose, fitted,
};
use crate::refraction::refraction_error;
use crate::work::{Figure, Work};
use echotank_config::spec::{MediumSpec, SonarSpec, SynthesisOutput};
use echotank_core::arrays::{Pattern, ReceiverFilter};
use echotank_core::model::{DopplerModel, PathModel, Synthesis};
use echotank_core::ping::PingPlan;
use echotank_core::scene::Scatterers;
use echotank_synthesis::array::echo_profile::EchoProfile;
use echotank_synthesis::array::error_models::{NODES_PER_SAMPLE, reference_points};
use echotank_synthesis::array::filter::{Decimator, FilterDesign};
use echotank_synthesis::array::gridded::{CostEstimate, shared_out};
use echotank_synthesis::array::lines;
use echotank_synthesis::echo::error_models::{doppler_error_model, path_error_model};
use echotank_synthesis::error_model::{Conditions, ErrorModel};

/// Lengths of segments, seconds: the longest that is good enough is taken.
const SEGMENTS_S: [f64; 6] = [0.05, 0.02, 0.01, 0.005, 0.002, 0.001];
/// What of the tolerance engines may be made for; models and culling have the rest.
const ENGINE_SHARES: [f64; 2] = [0.8, 0.2];
/// Up to so many more are made for what models and culling leave ([`fitted`]).
const FITS: usize = 2;
/// ... and where the models exceed the tolerance by themselves, to compare.
const SHARE_TO_COMPARE: f64 = 0.5;
/// Engines are made for scatterers somewhat nearer than the nearest of the ping that a plan is made on.
const NEARER: f64 = 0.7;
/// Steps of that distance for each doubling: plans on similar pings then find their engines designed.
const STEPS_PER_DOUBLING: f64 = 4.0;
/// ... and of that of lines, which come close to [`ROOM`].
const STEPS_OF_LINES: f64 = 8.0;
/// `gridded-lines` is selected only where it interpolates scatterers at this share of the nearest one's distance too: later pings have nearer ones, for which
/// the direct sum takes the place of the engine, and is a hundred times as slow.
const ROOM: f64 = 0.9;
/// A line of `gridded-2d` bears the motion across it that the echoes of a window have, and so much more in some.
const ACROSS: f64 = 3.0;
/// What engines predict of themselves is their error over all echoes of a window; of single ones it can be so much greater, and more in the worst of
/// many windows.
const ENGINE_MARGIN: f64 = 3.0;
/// ... but `gridded-1d` leaves no more than this of the tolerance that it is made for, in windows with the end of a single echo too.
const KEPT_BY_ONE: f64 = 1.0;
/// The error of a single echo is that of its worst window and place. Those of an engine's interpolations over delay and Doppler count as of random phase,
/// and are up to 1.4 times as great where they have the same (tests of the engines).
const SINGLE_MARGIN: f64 = 1.4;
/// Before a ping it is not known how far the first echoes of many cancel: with `gridded-lines`, a rig over a seabed had 1.1 times what was predicted without
/// this (5051 of `tools/accuracy rigs`).
const CANCELLING: f64 = 1.4;
/// And `gridded-2d` all of it: it keeps its tolerance in noise, to 0.8 in the worst of 112 answers of `tools/accuracy sweep` but one.
const KEPT_BY_WHOLE_LINES: f64 = 1.0;
/// The error that `gridded-2d` predicts leaves out the series that carry Doppler: 1.4 to 3.9 times as much was measured with it, with lines of 8 and 96
/// elements at tolerances of 8e-3 to 2e-3. Nor does it know how long slabs are and how few elements a section has: pings took 0.1 to 8 times as long as
/// predicted with the former factor on echoes and grids. The latter is no fit: an unreliable prediction is made expensive.
const LINE_DOPPLER: f64 = 2.5;
const LINE_DOPPLER_GRIDS: f64 = 10.0;
/// `gridded-lines` predicts its error in the worst window of many echoes. In windows with the onset of a single echo, 50 dB below the strongest, 2.5
/// times that was measured (a 10 ms pulse at 10 m/s; `tools/points_random.py`), and 2.3 times where the first few of many cancel.
/// Where many echoes sound together, random rigs over seabeds had up to 1.5 times that (`tools/accuracy rigs`).
const ONSETS_OF_LINES: f64 = 2.6;
const MANY_ON_LINES: f64 = 1.6;
/// Many are so many echoes that begin in a window, on the average. With 36, the windows before the bottom held so few that 2.4 times the design's error was
/// measured (rig 11 of seed 512953 of `tools/points_random.py`).
const MANY: f64 = 100.0;
/// With fewer scatterers `gridded-2d` is slower than `gridded-lines`: at 43,000 by 1.4 to 1.7 times, at 300,000 it is as fast (`tools/bench echo --only
/// short`).
const LEAST_FOR_2D: usize = 150_000;
/// Time to solve the delay of an echo at a node of a line, many at once, over that at an element of `gridded-1d`: 40 ns were measured with five nodes
/// (`tools/rates/wbms.toml` at 45 m), where the table of costs has 90. On the exact trajectory both take about the same.
const NODE_PER_ELEMENT: f64 = 0.45;
/// Attitudes that an echo on the exact trajectory asks for: the search for its delay, and the acceleration over a pulse. Both ask for two, but with two for
/// each, medians of 67 pings of `tools/accuracy rigs` were 0.6 to 0.85 times what is predicted without the acceleration, and 0.6 to 1.1 times with it.
const ATTITUDES_OF_ROOT: f64 = 1.0;
const ATTITUDES_OF_MOTION: f64 = 3.0;
/// Mean width of a two-way beam of line arrays, in wavelengths over the root of the sum of their squared lengths: 0.64 for two alike.
const TWO_WAY_WIDTH: f64 = 0.905;

/// Inputs of a method selection.
#[derive(Clone, Copy)]
pub struct Scene<'a> {
    /// The sonar.
    pub spec: &'a SonarSpec,
    /// The water.
    pub medium: &'a MediumSpec,
    /// A ping with the settings and the motion to select for.
    pub plan: &'a PingPlan,
    /// Its scatterers, or a sample of them.
    pub scatterers: &'a Scatterers,
    /// How many there are, where `scatterers` are a sample of them ([`sample`]).
    pub count: usize,
    /// Cost model of the machine.
    pub costs: &'a Costs,
    /// Recent motion of the platform over its motion in this ping.
    pub motion_scale: MotionScale,
}

/// Recent motion over the motion in one ping: factors of 1 and more.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MotionScale {
    /// Of the speed.
    pub speed: f64,
    /// Of the acceleration.
    pub acceleration: f64,
    /// Of the velocity of the arrays by rotation.
    pub turning: f64,
}

impl MotionScale {
    /// The motion of the ping itself.
    pub const NONE: Self = Self {
        speed: 1.0,
        acceleration: 1.0,
        turning: 1.0,
    };

    /// Of an echo's displacement, closing speed, range acceleration, its rate, acceleration, turning, change of acceleration, unsteadiness and range
    /// acceleration throughout.
    pub(crate) fn factors(&self) -> [f64; echo_statistics::QUANTITIES] {
        let range_acceleration = self.acceleration.max(self.speed * self.speed);
        [
            self.speed,
            self.speed,
            range_acceleration,
            self.speed * range_acceleration,
            self.acceleration,
            self.turning,
            self.acceleration,
            self.acceleration,
            range_acceleration,
        ]
    }

    fn apply_to(&self, mut conditions: Conditions) -> Conditions {
        conditions.speed_m_per_s *= self.speed;
        conditions.acceleration_m_per_s2 *= self.acceleration;
        conditions.turning_m_per_s *= self.turning;
        if let Some(echoes) = &mut conditions.echo_statistics {
            for (value, factor) in quantities(echoes).into_iter().zip(self.factors()) {
                *value *= factor;
            }
            echoes.closing_of_echoes_m_per_s *= self.speed;
            echoes.closing_apart_m_per_s *= self.speed;
            echoes.across_m_per_s *= self.speed;
        }
        conditions
    }
}

/// All points and targets, and of the ground as many as the plan looks at, each for all those left out.
pub fn sample(all: &Scatterers) -> Scatterers {
    let mut some = Scatterers {
        curve: all.curve.clone(),
        moving: all.moving.clone(),
        ..Scatterers::default()
    };
    for (i, stands_for) in echo_statistics::sampled(all, echo_statistics::SAMPLE_SIZE) {
        some.push_copy(all, i, stands_for.sqrt());
    }
    some
}

/// The sonar with a plan's choice in it.
pub fn with_choice(spec: &SonarSpec, choice: &Choice) -> SonarSpec {
    let mut spec = spec.clone();
    spec.model = choice.model;
    spec.synthesis.engine_tolerance = choice.engine_tolerance;
    spec.synthesis.nearest_m = choice.nearest_m;
    in_parts(spec, choice.part_elements)
}

/// The sonar with so many elements of every line made as one.
fn in_parts(mut spec: SonarSpec, of: usize) -> SonarSpec {
    for array in &mut spec.receive {
        if let Some(parts) = array.in_parts(of) {
            *array = parts;
        }
    }
    spec
}

/// What is asked of the sonar.
pub fn goal(spec: &SonarSpec) -> Goal {
    Goal {
        tolerance: spec.synthesis.tolerance,
        image_cells: spec.synthesis.image_cells,
    }
}

/// The plan for this ping's conditions; what the configuration fixes has one member.
pub fn rank(scene: &Scene, barred: &[Choice]) -> Option<Ranking> {
    rank_with_conditions(scene, barred, &Memo::default()).map(|(ranking, _)| ranking)
}

/// The plan, and the conditions that it was made for.
fn rank_with_conditions(
    scene: &Scene,
    barred: &[Choice],
    memo: &Memo,
) -> Option<(Ranking, Conditions)> {
    let builder = CandidateBuilder::new(scene, None, memo);
    let (mut candidates, mut refused) = builder.candidates();
    let partings = worth_trying(scene, &builder.conditions);
    for parting in &partings {
        let spec = in_parts(scene.spec.clone(), parting.of);
        let scene = Scene {
            spec: &spec,
            ..*scene
        };
        let (more, why) = CandidateBuilder::new(&scene, Some(*parting), memo).candidates();
        candidates.extend(more);
        refused.extend(why);
    }
    let of_parts = |c: &Candidate| c.choice.part_elements > 1;
    if scene.spec.synthesis.output == SynthesisOutput::Beams && candidates.iter().any(of_parts) {
        candidates.retain(of_parts);
    }
    let goal = goal(scene.spec);
    // The truth is for those who ask for it, and for what nothing else reaches and one core has the time for.
    if scene.spec.synthesis.auto.synthesis && !candidates.iter().any(|c| goal.meets(c)) {
        let c = scene.plan.sound_speed_m_per_s;
        let period_ms = 1e-6 * crate::period_ns(&scene.plan.settings, c) as f64;
        candidates.extend(builder.exact().filter(|c| c.cost_ms() <= period_ms));
    }
    let ranking = choose(goal, candidates, refused, barred)?;
    Some((ranking, builder.conditions))
}

/// What of the tolerance parts of lines may leave; models and the sum have the rest.
const PART_SHARES: [f64; 3] = [0.6, 0.3, 0.1];

/// The ways to part lines that may be chosen: for each share of the tolerance the coarsest within it. Where there is none the finest, to compare.
fn worth_trying(scene: &Scene, conditions: &Conditions) -> Vec<Parting> {
    let spec = scene.spec;
    let synthesis = &spec.synthesis;
    if synthesis.output == SynthesisOutput::Elements || synthesis.elements_for.is_some() {
        return Vec::new();
    }
    let spread = conditions
        .echo_statistics
        .map_or(1.0, |echoes| echoes.spread);
    let turning = scene.motion_scale.turning;
    let all = partings(spec, scene.plan, scene.scatterers, spread, turning);
    let leaves = |parting: &Parting| {
        let path = PathModel::Continuous;
        parting.error(path, 0.0).unwrap_or(f64::INFINITY)
    };
    let mut tried: Vec<Parting> = Vec::new();
    for share in PART_SHARES {
        let within = |p: &&Parting| leaves(p) <= share * synthesis.tolerance;
        if let Some(coarsest) = all.iter().rev().find(within)
            && !tried.contains(coarsest)
        {
            tried.push(*coarsest);
        }
    }
    if tried.is_empty() {
        tried.extend(all.first());
    }
    tried
}

/// A path and a Doppler model, with their error models.
struct Motion {
    path: PathModel,
    segment_s: f64,
    doppler: DopplerModel,
    error_models: [ErrorModel; 2],
}

/// A floor of the patterns, what it leaves out, and the shares of the pairs that are insonified and kept.
#[derive(Clone, Copy)]
struct Culling {
    db: Option<f64>,
    error: f64,
    of: Shares,
}

struct CandidateBuilder<'a> {
    scene: &'a Scene<'a>,
    conditions: Conditions,
    nearest_m: f64,
    culling: Culling,
    /// Of virtual points in water that bends sound, which every path model uses.
    refraction_error: f64,
    /// Of moving scatterers by their three instants.
    moving_error: f64,
    walked: WalkLengths,
    /// How lines are parted; none: elements are made.
    parting: Option<Parting>,
    memo: &'a Memo,
    /// The echoes of a platform at rest; none if it moves, or if they are too many.
    resting: OnceLock<Option<RestingPing>>,
}

/// What an engine promises and costs.
enum Engine {
    /// `gridded-1d` and `gridded-lines`.
    Sketched(Arc<Sketch>),
    /// `gridded-2d`.
    WholeLines {
        error: f64,
        cost: CostEstimate,
        sections: f64,
        why: String,
    },
}

/// Cache of the rankings of one sonar. Every value is a function of its key alone.
#[derive(Default)]
pub(crate) struct Memo {
    /// Engines that have been looked at. An element's engine is a part's too.
    sketches: Mutex<Vec<(SketchKey, SketchResult)>>,
}

/// Synthesis and Doppler model; the bits of tolerance, nearest range and pulse length; samples.
type SketchKey = (Synthesis, DopplerModel, Option<u64>, [u64; 2], usize);
type SketchResult = Result<Arc<Sketch>, String>;

impl Memo {
    const MAX_ENTRIES: usize = 128;

    /// The stored engine of `key`, or a new one from `make`, which is then stored in place of the oldest.
    fn sketch(&self, key: SketchKey, make: impl FnOnce() -> SketchResult) -> SketchResult {
        let entries = || self.sketches.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((_, sketch)) = entries().iter().find(|(known, _)| *known == key) {
            return sketch.clone();
        }
        // Without the lock: threads make different ones at the same time.
        let sketch = make();
        let mut entries = entries();
        if entries.len() == Self::MAX_ENTRIES {
            drop(entries.remove(0));
        }
        entries.push((key, sketch.clone()));
        sketch
    }
}

impl<'a> CandidateBuilder<'a> {
    fn new(scene: &'a Scene<'a>, parting: Option<Parting>, memo: &'a Memo) -> Self {
        let spec = scene.spec;
        let mut conditions =
            scene
                .motion_scale
                .apply_to(conditions(spec, scene.plan, scene.scatterers));
        conditions.scatterers = scene.count;
        Self {
            scene,
            parting,
            memo,
            walked: WalkLengths::of(spec, scene.plan, scene.scatterers, scene.count),
            nearest_m: nearest_m(spec, conditions.range_m.0),
            conditions,
            refraction_error: refraction_error(spec, scene.plan, scene.scatterers),
            moving_error: moving_error(spec, scene.plan, scene.scatterers, IN_SELECTION),
            culling: culling(scene),
            resting: OnceLock::new(),
        }
    }

    /// Whether all pings have the same echoes, which are known. Engines without Doppler are predicted from them: should the platform begin to move, the
    /// Doppler that they leave out exceeds any other error.
    fn is_at_rest(&self) -> bool {
        let Scene {
            spec,
            scatterers,
            count,
            motion_scale,
            ..
        } = self.scene;
        let all_points = *count == scatterers.len() && scatterers.moving.is_empty();
        let plain = self.parting.is_none() && spec.more_pulses.is_empty();
        let straight = self.refraction_error == 0.0;
        all_points && plain && straight && is_at_rest(&self.conditions, motion_scale)
    }

    /// The echoes of a platform at rest, `echo` one by any engine.
    fn resting(&self, echo: &EchoProfile) -> Option<&RestingPing> {
        let Scene {
            spec,
            plan,
            scatterers,
            ..
        } = self.scene;
        let known = || RestingPing::new(spec, plan, scatterers, echo);
        self.resting.get_or_init(known).as_ref()
    }

    fn motions(&self) -> Vec<Motion> {
        let spec = self.scene.spec;
        let auto = spec.synthesis.auto;
        let segments: &[f64] = match auto.segment {
            true => &SEGMENTS_S,
            false => &[spec.model.segment_s],
        };
        let mut paths = Vec::new();
        for path in PathModel::ALL {
            if !auto.path && path != spec.model.path {
                continue;
            }
            if self.parting.is_some() && path == PathModel::Polyline {
                continue;
            }
            match path {
                PathModel::Polyline | PathModel::KSegment => {
                    paths.extend(segments.iter().map(|&h| (path, h)));
                }
                _ => paths.push((path, spec.model.segment_s)),
            }
        }
        let dopplers = DopplerModel::ALL
            .into_iter()
            .filter(|d| match auto.doppler {
                true => *d != DopplerModel::PaperEq21,
                false => *d == spec.model.doppler,
            });
        let dopplers: Vec<_> = dopplers.collect();
        let mut motions = Vec::new();
        for (path, segment_s) in paths {
            let window_s = self.scene.plan.window_s(self.conditions.sample_rate_hz);
            let under = Conditions {
                segment_s: segment_step_s(window_s, segment_s),
                ..self.conditions
            };
            for &doppler in &dopplers {
                motions.push(Motion {
                    path,
                    segment_s,
                    doppler,
                    error_models: [
                        path_error_model(path, &under),
                        doppler_error_model(doppler, path, &under),
                    ],
                });
            }
        }
        motions
    }

    fn sums(&self) -> Vec<Synthesis> {
        let spec = self.scene.spec;
        // Parts are walked one by one.
        let lines = self.parting.is_none() && spec.receiver.filter == ReceiverFilter::Fir;
        let whole = lines && spec.receive.iter().all(|a| a.elements > 1);
        let some = lines && spec.receive.iter().any(is_line);
        let one_by_one = |s: Synthesis| {
            matches!(
                s,
                Synthesis::Direct | Synthesis::Gridded1d | Synthesis::Reference
            )
        };
        Synthesis::ALL
            .into_iter()
            .filter(|&s| match spec.synthesis.auto.synthesis {
                false => s == spec.model.synthesis,
                true => {
                    s != Synthesis::Reference
                        && (s != Synthesis::Gridded2d || whole && self.scene.count >= LEAST_FOR_2D)
                        && (s != Synthesis::GriddedLines || some)
                        && (spec.more_pulses.is_empty() || one_by_one(s))
                }
            })
            .collect()
    }

    fn candidates(&self) -> (Vec<Candidate>, Vec<(String, String)>) {
        let (mut found, mut refused) = (Vec::new(), Vec::new());
        let motions = self.motions();
        for synthesis in self.sums() {
            match synthesis {
                Synthesis::Reference => found.extend(self.exact()),
                Synthesis::Gridded1d | Synthesis::Gridded2d | Synthesis::GriddedLines => {
                    self.engines(synthesis, &motions, &mut found, &mut refused);
                }
                _ => {
                    let error_model = sum_error_model(
                        synthesis,
                        self.scene.spec,
                        self.scene.plan,
                        &self.conditions,
                    );
                    for motion in motions.iter().filter(|m| synthesis.takes(m.doppler)) {
                        found.push(self.plain(synthesis, &error_model, motion));
                    }
                }
            }
        }
        (found, refused)
    }

    /// The reference.
    fn exact(&self) -> Option<Candidate> {
        let motions = self.motions();
        Some(self.reference(motions.last()?))
    }

    /// Candidates of one engine, Doppler by Doppler: an engine knows nothing of paths but whether they step.
    fn engines(
        &self,
        synthesis: Synthesis,
        motions: &[Motion],
        found: &mut Vec<Candidate>,
        refused: &mut Vec<(String, String)>,
    ) {
        let spec = self.scene.spec;
        let goal = goal(spec);
        let mut wanted = Vec::new();
        for doppler in DopplerModel::ALL {
            let of: Vec<&Motion> = motions
                .iter()
                .filter(|m| m.doppler == doppler && synthesis.takes(doppler))
                .filter(|m| !synthesis.makes_lines() || m.path != PathModel::Polyline)
                .collect();
            let Some(least) = of
                .iter()
                .map(|m| m.error_models[0].error + m.error_models[1].error)
                .min_by(f64::total_cmp)
            else {
                continue;
            };
            if let Some(why) = self.beyond_design(synthesis, doppler) {
                match spec.synthesis.auto.synthesis {
                    true => {
                        refused.push((format!("{}, {}", synthesis.name(), doppler.name()), why))
                    }
                    false => {
                        let engine = self.engine(synthesis, doppler, None).ok();
                        found.extend(self.instead(synthesis, &of, &why, engine.as_ref()));
                    }
                }
                continue;
            }
            // Models that are beyond the goal by themselves are listed with one engine, to compare.
            let hopeful = goal.image_cells.is_some() || least < goal.tolerance;
            // Of its tolerance the engine for lines leaves little, so that it may be made for all of it.
            let finest = match synthesis {
                Synthesis::GriddedLines => lines::MIN_TOLERANCE.min(goal.tolerance),
                _ => 0.0,
            };
            let of_share = |share: &f64| Some((share * goal.tolerance).max(finest));
            let mut tolerances: Vec<Option<f64>> = match (spec.synthesis.auto.any(), hopeful) {
                (false, _) => vec![None],
                (true, false) => vec![of_share(&SHARE_TO_COMPARE)],
                (true, true) => ENGINE_SHARES.iter().map(of_share).collect(),
            };
            tolerances.dedup();
            // A sum that is the operator's and cannot be made for a share is what it is for the whole, and said to be.
            let whole = (!spec.synthesis.auto.synthesis && spec.synthesis.auto.any())
                .then_some(Some(goal.tolerance));
            wanted.push((doppler, of, tolerances, whole));
        }
        // Made by all threads; the loop below finds them in the memo.
        let engines: Vec<(DopplerModel, Option<f64>)> = wanted
            .iter()
            .filter(|_| synthesis != Synthesis::Gridded2d)
            .flat_map(|(doppler, _, tolerances, _)| tolerances.iter().map(|t| (*doppler, *t)))
            .collect();
        shared_out(engines.len(), |k| {
            self.engine(synthesis, engines[k].0, engines[k].1).is_ok()
        });
        for (doppler, of, tolerances, whole) in wanted {
            let (mut is_made, first) = (false, found.len());
            for &engine_tolerance in tolerances.iter().chain(&whole) {
                if is_made && engine_tolerance == Some(goal.tolerance) {
                    continue;
                }
                is_made |=
                    self.on_tolerance(synthesis, doppler, &of, engine_tolerance, found, refused);
            }
            for _ in 0..FITS {
                let tolerance = fitted(goal, &tolerances, &found[first..]);
                let is_fitted = tolerance.is_some()
                    && self.on_tolerance(synthesis, doppler, &of, tolerance, found, refused);
                if !is_fitted {
                    break;
                }
            }
        }
    }

    /// Candidates of an engine with this tolerance. Returns whether it can be made.
    fn on_tolerance(
        &self,
        synthesis: Synthesis,
        doppler: DopplerModel,
        motions: &[&Motion],
        engine_tolerance: Option<f64>,
        found: &mut Vec<Candidate>,
        refused: &mut Vec<(String, String)>,
    ) -> bool {
        let engine = self.engine(synthesis, doppler, engine_tolerance);
        match &engine {
            Ok(engine) => found.extend(
                motions
                    .iter()
                    .map(|motion| self.on_engine(synthesis, motion, engine_tolerance, engine)),
            ),
            Err(why) => {
                let tolerance = engine_tolerance.unwrap_or(self.scene.spec.synthesis.tolerance);
                let name = format!("{} {tolerance:.0e}, {}", synthesis.name(), doppler.name());
                refused.push((name, why.clone()));
            }
        }
        engine.is_ok()
    }

    /// Why this ping moves more than an engine is designed for.
    fn beyond_design(&self, synthesis: Synthesis, doppler: DopplerModel) -> Option<String> {
        let Conditions {
            speed_m_per_s,
            acceleration_m_per_s2,
            echo_statistics,
            ..
        } = self.conditions;
        if speed_m_per_s > FASTEST_PLATFORM_M_PER_S {
            return Some(format!(
                "the platform moves at {speed_m_per_s:.1} m/s; the engine is designed for at most {FASTEST_PLATFORM_M_PER_S} m/s"
            ));
        }
        if doppler == DopplerModel::StretchQuadratic && acceleration_m_per_s2 > HARDEST_M_PER_S2 {
            return Some(format!(
                "an array accelerates by {acceleration_m_per_s2:.1} m/s^2; the engine is designed for at most {HARDEST_M_PER_S2} m/s^2"
            ));
        }
        let across = ACROSS * echo_statistics.map_or(speed_m_per_s, |echoes| echoes.across_m_per_s);
        // Of its own bounds a fixed engine knows better, ping by ping.
        if self.scene.spec.synthesis.auto.synthesis
            && synthesis == Synthesis::Gridded2d
            && doppler != DopplerModel::None
            && across > SIDEWAYS_M_PER_S
        {
            return Some(format!(
                "the closing speed across the line is {across:.2} m/s; the engine is designed for at most {SIDEWAYS_M_PER_S} m/s"
            ));
        }
        None
    }

    /// An engine that is the operator's, on a ping beyond its design: the direct sum makes the elements with echoes beyond it, and the engine the others.
    fn instead(
        &self,
        synthesis: Synthesis,
        motions: &[&Motion],
        why: &str,
        engine: Option<&Engine>,
    ) -> Vec<Candidate> {
        let Scene { spec, plan, .. } = self.scene;
        let mut error_model = sum_error_model(Synthesis::Direct, spec, plan, &self.conditions);
        error_model.why = format!("by the direct sum where echoes are beyond the design: {why}");
        let mut found = Vec::new();
        for motion in motions {
            let mut candidate = self.plain(Synthesis::Direct, &error_model, motion);
            candidate.choice.model.synthesis = synthesis;
            let sum = &mut candidate.parts[Family::Sum as usize];
            sum.choice = synthesis.name().to_owned();
            if let Some(engine) = engine {
                let by_engine = self.on_engine(synthesis, motion, None, engine);
                sum.error = sum.error.max(by_engine.part(Family::Sum).error);
            }
            found.push(candidate);
        }
        found
    }

    fn engine(
        &self,
        synthesis: Synthesis,
        doppler: DopplerModel,
        engine_tolerance: Option<f64>,
    ) -> Result<Engine, String> {
        let mut spec = self.scene.spec.clone();
        spec.model.doppler = doppler;
        spec.model.synthesis = synthesis;
        // The steps of a polyline are for the configuration to refuse.
        spec.model.path = PathModel::KSegment;
        spec.synthesis.engine_tolerance = engine_tolerance;
        spec.synthesis.nearest_m = self.nearest_of(synthesis);
        let c = self.scene.medium.sound_speed_m_per_s;
        let filter = || receiver_filter(&spec, self.scene.medium).map_err(|why| why.to_string());
        let fastest = FASTEST_PLATFORM_M_PER_S;
        if synthesis == Synthesis::Gridded2d {
            return self.whole_lines(&spec, filter()?.as_ref());
        }
        let plan = self.scene.plan;
        let key = (
            synthesis,
            doppler,
            engine_tolerance.map(f64::to_bits),
            [spec.synthesis.nearest_m, plan.pulse.duration_s].map(f64::to_bits),
            plan.sample_count,
        );
        let made = self.memo.sketch(key, || {
            let made = sketch(&spec, c, fastest, filter()?.as_ref(), plan);
            made.map(Arc::new).map_err(|why| why.to_string())
        })?;
        let nearest_m = self.conditions.range_m.0;
        let room = if spec.synthesis.auto.synthesis {
            ROOM
        } else {
            1.0
        };
        match made.reaches(&spec, room * nearest_m) {
            true => Ok(Engine::Sketched(made)),
            false => Err(format!(
                "a scatterer {nearest_m:.1} m away is too near for the interpolation along the line"
            )),
        }
    }

    /// Range for which an engine is made, metres. That of `gridded-lines` reaches [`ROOM`], which may cost it accuracy elsewhere.
    fn nearest_of(&self, synthesis: Synthesis) -> f64 {
        match synthesis == Synthesis::GriddedLines && self.scene.spec.synthesis.auto.synthesis {
            true => stepped_m(ROOM * self.conditions.range_m.0, STEPS_OF_LINES),
            false => self.nearest_m,
        }
    }

    /// `gridded-2d` for this sonar.
    fn whole_lines(&self, spec: &SonarSpec, filter: Option<&Decimator>) -> Result<Engine, String> {
        let c = self.scene.medium.sound_speed_m_per_s;
        let fastest = FASTEST_PLATFORM_M_PER_S;
        // As the engines are made; their echoes are then counted in those of this ping.
        let kept = self.culling.of.kept * self.scene.count as f64 / NOMINAL_SCATTERERS as f64;
        let choices =
            choices(spec, c, fastest, filter, NOMINAL_SCATTERERS).map_err(|why| why.to_string())?;
        let sections = choices.iter().zip(&spec.receive);
        let costs = choices.iter().map(|choice| choice.cost);
        let (echoes_times, grids_times) = match spec.model.doppler {
            DopplerModel::None => (1.0, 1.0),
            _ => (LINE_DOPPLER, LINE_DOPPLER_GRIDS),
        };
        Ok(Engine::WholeLines {
            error: choices
                .iter()
                .map(|c| c.error_model.error)
                .fold(0.0, f64::max),
            cost: costs.fold(CostEstimate::default(), |sum, cost| CostEstimate {
                echoes_ns: sum.echoes_ns + echoes_times * kept * cost.echoes_ns,
                grids_ns: sum.grids_ns + grids_times * cost.grids_ns,
            }),
            sections: sections
                .map(|(choice, array)| {
                    array
                        .elements
                        .div_ceil(choice.resolution.section_elements.max(1))
                        as f64
                })
                .sum(),
            why: choices
                .first()
                .map_or(String::new(), |choice| choice.error_model.why.clone()),
        })
    }

    fn on_engine(
        &self,
        synthesis: Synthesis,
        motion: &Motion,
        engine_tolerance: Option<f64>,
        engine: &Engine,
    ) -> Candidate {
        let culling = self.culling;
        let scatterers = self.scene.count as f64;
        let arrivals = culling.of.kept * scatterers;
        let tolerance = engine_tolerance.unwrap_or(self.scene.spec.synthesis.tolerance);
        let spread = self
            .conditions
            .echo_statistics
            .map_or(1.0, |echoes| echoes.spread);
        let kept = |error: f64, most: f64| (ENGINE_MARGIN * spread * error).min(most * tolerance);
        let name = format!("{} {tolerance:.1e}", synthesis.name());
        let engine = match engine {
            Engine::Sketched(sketch) => sketch,
            Engine::WholeLines {
                error,
                cost,
                sections,
                why,
            } => {
                let work = Work::of(Figure::Gridded2dEcho, cost.echoes_ns)
                    .and(Figure::Gridded2dGrid, cost.grids_ns);
                let pairs = culling.of.transmit_leg * scatterers * sections;
                let sum = self.sum(name, kept(*error, KEPT_BY_WHOLE_LINES), work, why.clone());
                return self.candidate(synthesis, motion, culling, engine_tolerance, pairs, sum);
            }
        };
        let (mut error, mut work, mut why) = (0.0f64, Work::NONE, String::new());
        let mut echo_error = None;
        let pulse_s = self.conditions.pulse.duration_s;
        let windows = self.scene.plan.window_s(self.conditions.sample_rate_hz) / pulse_s;
        let single = self
            .conditions
            .echo_statistics
            .is_none_or(|echoes| echoes.echoes < MANY * windows * self.conditions.elements as f64);
        let onsets = if single {
            ONSETS_OF_LINES
        } else {
            MANY_ON_LINES
        };
        let fading = self
            .conditions
            .echo_statistics
            .map_or(f64::INFINITY, |echoes| echoes.fading);
        let accelerated_m_per_s2 = self
            .conditions
            .echo_statistics
            .map_or(f64::INFINITY, |echoes| echoes.range_acceleration_m_per_s2);
        // Elements that are made one by one, and points at which delays are solved.
        let (mut elements, mut solved) = (0.0, 0.0);
        let receive = self.scene.spec.receive.iter();
        let (nearest_m, farthest_m) = self.conditions.range_m;
        let heard = lines::Heard {
            echoes: arrivals,
            differ_m_per_s: self
                .conditions
                .echo_statistics
                .map_or(2.0 * self.conditions.speed_m_per_s, |echoes| {
                    echoes.closing_apart_m_per_s
                }),
            duration_s: 2.0 * (farthest_m - nearest_m) / self.conditions.sound_speed_m_per_s,
        };
        for (index, (array, line)) in receive.zip(&engine.lines).enumerate() {
            let Some(line) = line else {
                elements += array.elements as f64;
                continue;
            };
            let cost = line.cost_estimate(heard);
            work = work
                .and(Figure::GriddedLinesEcho, cost.echoes_ns)
                .and(Figure::GriddedLinesGrid, cost.grids_ns);
            let points = line.solved_points(array, self.conditions.range_m);
            let per_element = match motion.path {
                PathModel::Continuous => 1.0,
                _ => NODE_PER_ELEMENT,
            };
            solved += per_element * points.unwrap_or(0.0);
            let at_rest = || {
                let echo = line.echo_at_rest()?;
                let phase_errors = line.phase_errors(array, self.conditions.range_m);
                let resting = self.resting(echo)?;
                Some(resting.error(index, echo, &phase_errors))
            };
            let known = self.is_at_rest().then(at_rest).flatten();
            let of_design = line.error_of(array, self.line_motion());
            let (mean, by_level) = line.echo_errors(array, self.line_motion());
            let by_level = by_level.map(|error| SINGLE_MARGIN * error);
            let of_line = EchoError {
                mean,
                window: by_level.into_iter().fold(0.0, f64::max),
                by_level,
                most: [onsets * of_design, ONSETS_OF_LINES * of_design],
                accelerated: [0.0; 2],
                spread: line.spread_error(),
            };
            let before = EchoError {
                window: CANCELLING * of_line.window,
                ..of_line
            };
            error = error.max(known.unwrap_or(before.before_ping(fading, accelerated_m_per_s2)));
            echo_error = match known {
                Some(_) => None,
                None => Some(of_line.or_more(echo_error)),
            };
            why.clone_from(&line.error_model().why);
        }
        if let Some(one) = &engine.elements {
            let c = self.conditions.sound_speed_m_per_s;
            let curvature_per_s = EXTREMES * accelerated_m_per_s2 / c;
            let share = self.closing_m_per_s() / FASTEST_PLATFORM_M_PER_S;
            let cost = one.cost_estimate(arrivals as usize, share.min(1.0), curvature_per_s);
            work = work
                .and(Figure::Gridded1dEcho, cost.echoes_ns * elements)
                .and(Figure::Gridded1dGrid, cost.grids_ns * elements);
            solved += elements;
            let error_model = one.error_model();
            let [curved, most_per_s] = one.curvature_error();
            let of_one = EchoError {
                mean: one.mean_error(),
                window: (SINGLE_MARGIN * one.single_echo_error()).min(KEPT_BY_ONE * tolerance),
                by_level: one.single_echo_errors().map(|error| SINGLE_MARGIN * error),
                most: [f64::INFINITY; 2],
                accelerated: [
                    curved / (most_per_s * c).max(f64::MIN_POSITIVE),
                    SINGLE_MARGIN * curved,
                ],
                spread: one.spread_error(),
            };
            let bound = of_one.before_ping(fading, accelerated_m_per_s2);
            let at_rest = || {
                let echo = one.echo_at_rest()?;
                let resting = self.resting(echo)?;
                let arrays = engine.lines.iter().enumerate();
                let by_element = arrays.filter(|(_, line)| line.is_none());
                let errors = by_element.map(|(array, _)| resting.error(array, echo, &[]));
                Some(errors.fold(0.0, f64::max))
            };
            let known = self.is_at_rest().then(at_rest).flatten();
            error = error.max(known.unwrap_or(bound.min(KEPT_BY_ONE * tolerance)));
            let only_elements = engine.lines.iter().all(Option::is_none);
            echo_error = match known {
                None if only_elements || echo_error.is_some() => Some(of_one.or_more(echo_error)),
                _ => None,
            };
            if why.is_empty() {
                why = error_model.why;
            }
        }
        let pairs = culling.of.transmit_leg * scatterers * solved;
        let sum = self.sum(name, error, work, why);
        Candidate {
            echo_error,
            ..self.candidate(synthesis, motion, culling, engine_tolerance, pairs, sum)
        }
    }

    /// Of all but the rarest echoes, the fastest.
    fn closing_m_per_s(&self) -> f64 {
        let speed = self.conditions.speed_m_per_s;
        let echoes = self.conditions.echo_statistics;
        echoes.map_or(speed, |echoes| {
            (EXTREMES * echoes.closing_of_echoes_m_per_s).min(speed)
        })
    }

    /// Of the echoes of this ping, at most.
    fn line_motion(&self) -> lines::LineMotion {
        let c = self.conditions.sound_speed_m_per_s;
        let echoes = self.conditions.echo_statistics;
        lines::LineMotion {
            range_m: self.conditions.range_m,
            closing_m_per_s: self.conditions.speed_m_per_s,
            curvature_per_s: echoes.map_or(f64::INFINITY, |echoes| {
                echoes.range_acceleration_m_per_s2 / c
            }),
        }
    }

    /// The part of the sum, with what every way to sum costs.
    fn sum(&self, choice: String, error: f64, work: Work, why: String) -> Part {
        let work = work
            .and(Figure::Ping, 1.0)
            .and(Figure::Element, self.conditions.elements as f64)
            .and(Figure::Sample, self.samples());
        Part {
            family: Family::Sum,
            choice,
            error,
            cost_ms: self.scene.costs.ms(&work),
            work,
            why,
        }
    }

    /// Of all elements.
    fn samples(&self) -> f64 {
        self.conditions.elements as f64 * self.scene.plan.sample_count as f64
    }

    /// The receiver filter ahead of this way to sum, none where none is configured.
    fn filter(&self, synthesis: Synthesis) -> Option<FilterDesign> {
        let c = self.scene.medium.sound_speed_m_per_s;
        filter_design(self.scene.spec, synthesis, c)
    }

    fn plain(&self, synthesis: Synthesis, error_model: &ErrorModel, motion: &Motion) -> Candidate {
        let culling = self.culling;
        let all = (self.scene.count * self.conditions.elements) as f64;
        let pairs = culling.of.kept * all;
        let pulse = &self.conditions.pulse;
        let rate_hz = self.conditions.sample_rate_hz;
        let filter = self.filter(synthesis);
        let dense = filter.map_or(1.0, |filter| filter.oversample as f64);
        let taps = filter.map_or(0.0, |filter| filter.taps() as f64);
        let echo_samples = pulse.duration_s * rate_hz;
        let points = echo_samples * dense;
        let work = match synthesis {
            Synthesis::Direct => {
                let runs = direct_runs(&self.conditions, motion.doppler, rate_hz * dense);
                let ends = match (filter, pulse.taper > 0.0) {
                    (None, _) => 0.0,
                    (Some(_), false) => 2.0,
                    (Some(_), true) => 4.0,
                };
                Work::of(Figure::DirectRun, pairs * runs)
                    .and(Figure::DirectPoint, pairs * points)
                    .and(Figure::DirectFlank, pairs * flank_points(pulse, points))
                    .and(Figure::DirectEdge, ends * pairs)
                    .and(Figure::FilterTap, self.samples() * taps)
            }
            Synthesis::Spectral => {
                let tails = taps / dense;
                let bins = self.scene.plan.sample_count as f64 + echo_samples + tails;
                Work::of(Figure::SpectralBin, pairs * bins)
            }
            Synthesis::Nearest | Synthesis::Linear => {
                let of_each = match synthesis {
                    Synthesis::Linear => 2.0,
                    _ => 1.0,
                };
                Work::of(Figure::ReplicaSample, of_each * pairs * echo_samples)
                    .and(Figure::ReplicaEcho, pairs)
            }
            _ => Work::NONE,
        };
        let name = synthesis.name().to_owned();
        let sum = self.sum(name, error_model.error, work, error_model.why.clone());
        let transmit_leg = culling.of.transmit_leg * all;
        self.candidate(synthesis, motion, culling, None, transmit_leg, sum)
    }

    fn reference(&self, motion: &Motion) -> Candidate {
        let synthesis = Synthesis::Reference;
        let Scene { spec, plan, .. } = self.scene;
        let error_model = sum_error_model(synthesis, spec, plan, &self.conditions);
        let pulse = &self.conditions.pulse;
        let rate_hz = self.conditions.sample_rate_hz;
        let filter = self.filter(synthesis);
        let pairs = (self.scene.count * self.conditions.elements) as f64;
        let points = pairs * reference_points(pulse, rate_hz, filter.is_some());
        // Each node of a sample has a tap for each sample within the filter.
        let taps = filter.map_or(0.0, |f| {
            NODES_PER_SAMPLE * f.taps() as f64 / f.oversample as f64
        });
        let work =
            Work::of(Figure::ReferencePoint, points).and(Figure::FilterTap, self.samples() * taps);
        let sum = self.sum("reference".into(), error_model.error, work, error_model.why);
        let whole = Culling {
            db: self.culling.db,
            error: 0.0,
            of: Shares::ALL,
        };
        let mut candidate = self.candidate(synthesis, motion, whole, None, 0.0, sum);
        for family in [Family::Path, Family::Doppler] {
            let part = &mut candidate.parts[family as usize];
            (part.cost_ms, part.work) = (0.0, Work::NONE);
            part.error = match family {
                Family::Path => self.refraction_error,
                _ => 0.0,
            };
            part.why = "not used: the exact trajectory is evaluated sample by sample".into();
        }
        candidate.displaced = Displaced::default();
        candidate
    }

    /// The parts that all have. `pairs`: of insonified scatterers and elements (or nodes of a line), which are solved for.
    fn candidate(
        &self,
        synthesis: Synthesis,
        motion: &Motion,
        culling: Culling,
        engine_tolerance: Option<f64>,
        pairs: f64,
        sum: Part,
    ) -> Candidate {
        let spec = self.scene.spec;
        let [path_error_model, doppler_error_model] = &motion.error_models;
        let segmented = matches!(motion.path, PathModel::Polyline | PathModel::KSegment);
        let chords = match motion.path {
            PathModel::StopAndHop => 1.0,
            _ => self.walked.chords(motion.segment_s),
        };
        let continuous = motion.path == PathModel::Continuous;
        let newton = if continuous { pairs } else { 0.0 };
        let attitudes = match self.scene.plan.trajectory.attitude.len() {
            0 | 1 => 0.0,
            _ if motion.doppler == DopplerModel::StretchQuadratic => {
                newton * (ATTITUDES_OF_ROOT + ATTITUDES_OF_MOTION)
            }
            _ => newton * ATTITUDES_OF_ROOT,
        };
        let transmitted = (self.scene.count * spec.transmit.len()) as f64;
        let legs = Work::of(Figure::TransmitLegTerms, transmitted)
            .and(Figure::Pair, pairs)
            .and(Figure::Pattern, pairs * self.walked.patterned)
            .and(Figure::Chord, pairs * chords)
            .and(Figure::Newton, newton)
            .and(Figure::Attitude, attitudes);
        let second = match motion.doppler {
            DopplerModel::StretchQuadratic => Work::of(Figure::Quadratic, pairs),
            _ => Work::NONE,
        };
        // Both are phases of one echo.
        let path_error = match synthesis {
            Synthesis::Reference => 0.0,
            _ => path_error_model.error,
        } + self.refraction_error;
        let path_why = match self.refraction_error {
            0.0 => path_error_model.why.clone(),
            bent => format!("{}; virtual points: {bent:.1e}", path_error_model.why),
        };
        let part = |family, choice: String, error, work: Work, why: &str| Part {
            family,
            choice,
            error,
            cost_ms: self.scene.costs.ms(&work),
            work,
            why: why.to_owned(),
        };
        let path_name = match segmented {
            true => format!("{} {} ms", motion.path.name(), motion.segment_s * 1e3),
            false => motion.path.name().to_owned(),
        };
        let doppler_name = match motion.doppler {
            DopplerModel::None => "no Doppler".to_owned(),
            doppler => doppler.name().to_owned(),
        };
        let cull_name = match culling.db {
            None => "all scatterers".to_owned(),
            Some(_) if spec.synthesis.culls_by_window => "culled by window".to_owned(),
            Some(db) => format!("culled at {db:.0} dB"),
        };
        let cull_why = match culling.db {
            None => String::new(),
            Some(_) => format!(
                "{:.0} % of the gathered scatterers are kept",
                100.0 * culling.of.kept
            ),
        };
        let mut model = spec.model;
        model.path = motion.path;
        model.segment_s = motion.segment_s;
        model.doppler = motion.doppler;
        model.synthesis = synthesis;
        model.cull_db = culling.db;
        Candidate {
            choice: Choice {
                model,
                engine_tolerance,
                nearest_m: self.nearest_of(synthesis),
                part_elements: self.parting.map_or(1, |parting| parting.of),
            },
            parts: [
                part(Family::Path, path_name, path_error, legs, &path_why),
                part(
                    Family::Doppler,
                    doppler_name,
                    doppler_error_model.error,
                    second,
                    &doppler_error_model.why,
                ),
                sum,
                part(
                    Family::Culling,
                    cull_name,
                    culling.error,
                    Work::NONE,
                    &cull_why,
                ),
                self.output(motion, pairs),
                self.moving(synthesis),
            ],
            displaced: self.displaced(motion),
            echo_error: None,
        }
    }

    /// Of elements, or of parts of lines. `pairs`: of insonified scatterers and records.
    fn output(&self, motion: &Motion, pairs: f64) -> Part {
        let (choice, error, work, why) = match self.parting {
            None => {
                let synthesis = &self.scene.spec.synthesis;
                let why = match synthesis.output {
                    SynthesisOutput::Elements => "no other output is configured",
                    _ => synthesis.elements_for.unwrap_or(""),
                };
                ("elements".to_owned(), 0.0, Work::NONE, why.to_owned())
            }
            Some(parting) => {
                let records = self.conditions.elements;
                let error = parting.error(motion.path, motion.segment_s);
                (
                    format!("beams, {} elements as one", parting.of),
                    error.unwrap_or(f64::INFINITY),
                    Work::of(Figure::PartElement, pairs * parting.of as f64),
                    format!(
                        "no output reads elements: {records} records instead of {}",
                        records * parting.of
                    ),
                )
            }
        };
        Part {
            family: Family::Output,
            choice,
            error,
            cost_ms: self.scene.costs.ms(&work),
            work,
            why,
        }
    }

    /// Moving scatterers. Nothing where none moves.
    fn moving(&self, synthesis: Synthesis) -> Part {
        let Scene {
            spec,
            plan,
            scatterers,
            ..
        } = *self.scene;
        let count = scatterers.moving.len();
        let mut part = Part {
            family: Family::Moving,
            choice: "none".to_owned(),
            error: 0.0,
            cost_ms: 0.0,
            work: Work::NONE,
            why: String::new(),
        };
        if count > 0 {
            let of = (count, self.parting.map_or(1, |parting| parting.of));
            let sum = sum_error(synthesis, spec, plan, &self.conditions);
            part.choice = format!("{count} scatterers");
            part.error = self.moving_error.hypot(sum);
            part.work = moving_work(synthesis, spec, plan, &self.conditions, of);
            part.cost_ms = self.scene.costs.ms(&part.work);
            part.why = format!(
                "{:.1e} from three instants of the pulse, {sum:.1e} from their sum",
                self.moving_error
            );
        }
        part
    }

    /// What the models do to a picture: the motion left out displaces along the track by v r/c of the cell at r and in range by what an echo's
    /// path is off; the Doppler left out biases a compressed pulse by |d| f_c T/B, which is |d| f_c T cells.
    fn displaced(&self, motion: &Motion) -> Displaced {
        let c = self.conditions.sound_speed_m_per_s;
        let pulse = &self.conditions.pulse;
        let speed = self.conditions.speed_m_per_s;
        let (displacement_m, closing) = match self.conditions.echo_statistics {
            Some(echoes) => (echoes.displacement_m, echoes.closing_of_echoes_m_per_s),
            None => (speed * 2.0 * self.conditions.range_m.1 / c, speed),
        };
        let mut displaced = Displaced::default();
        if motion.path == PathModel::StopAndHop {
            let wavelength_m = c / pulse.center_frequency_hz;
            displaced.along_cells = speed * self.aperture_m() / (TWO_WAY_WIDTH * wavelength_m * c);
            displaced.range_cells += displacement_m * pulse.bandwidth_hz / c;
        }
        if motion.doppler.keeps_pulse() {
            let d = 2.0 * closing / c;
            displaced.range_cells += d * pulse.center_frequency_hz * pulse.duration_s;
        }
        displaced
    }

    /// The root of the sum of squares of transmitter's and receiver's lengths along the track, of the longest pair.
    fn aperture_m(&self) -> f64 {
        let side_m = |pattern: &Pattern| match *pattern {
            Pattern::Omnidirectional => 0.0,
            Pattern::Rectangle { length_m, .. } | Pattern::Part { length_m, .. } => length_m,
        };
        let spec = self.scene.spec;
        let pairs = spec.receive.iter().map(|array| {
            let transmit = &spec.transmit[array.transmit];
            let along = |q: glam::DQuat| (q * glam::DVec3::X).x.abs();
            let line_m = array.length_m().max(side_m(&array.element_pattern));
            (line_m * along(array.mounting.body_from_array))
                .hypot(side_m(&transmit.pattern) * along(transmit.mounting.body_from_array))
        });
        pairs.fold(0.0, f64::max)
    }
}

/// What engines are made for: the operator's word where they are the operator's; where they are the plan's, what this ping has, and no farther
/// than is said.
fn nearest_m(spec: &SonarSpec, nearest_heard_m: f64) -> f64 {
    let said_m = spec.synthesis.nearest_m;
    let auto = spec.synthesis.auto;
    match spec.synthesis.selects_methods()
        && (auto.synthesis || spec.model.synthesis != Synthesis::Gridded2d)
    {
        true => stepped_m(NEARER * nearest_heard_m, STEPS_PER_DOUBLING).min(said_m.max(5.0)),
        false => said_m,
    }
}

/// The greatest range of so many for each doubling that does not exceed `range_m`.
fn stepped_m(range_m: f64, steps_per_doubling: f64) -> f64 {
    let steps = steps_per_doubling * libm::log2(range_m);
    libm::exp2(steps.floor() / steps_per_doubling)
}
