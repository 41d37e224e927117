//! Method selection while the sonar runs, for blocks of pings of about [`BLOCK_S`].
//!
//! ```text
//! first ping of block b: a thread ranks for block b + 1, and makes a pipeline if the choice is another
//! first ping of block b + 1: the new pipeline is taken, and waited for if it must be
//! ```
//!
//! A ranking sees the settings, the first ping of its block and the largest motion in the two blocks before, rounded up, and nothing of earlier
//! selections: the methods of a ping depend on configuration, navigation and ping number alone, in every clock mode, and in a replay that begins
//! anywhere ([`is_examined_before`]). The first block has the selection made ahead of the first ping, at which navigation may not know the motion yet;
//! the second has one from the middle of the first. Changed settings are examined at once. A skipped ping is not examined.
//!
//! Every ping has its own promise ([`Promise`]): the error models of path and Doppler with its own motion. A ping that moves more than the selection
//! expected is computed with the elements' own chords, with shorter ones, or on the exact trajectory. If that exceeds the tolerance, its promise
//! says so.

use std::sync::Arc;
use std::thread::{self, JoinHandle};

use crate::element_synthesis::FASTEST_PLATFORM_M_PER_S;
use crate::engines::HARDEST_M_PER_S2;
use crate::method_selection::costs::Costs;
use crate::method_selection::echo_statistics::echo_peaks;
use crate::method_selection::promise::{PingPromise, Promise};
use crate::method_selection::sample_fades::WindowStatistics;
use crate::method_selection::{
    Memo, MotionScale, Scene, goal, rank_with_conditions, sample, with_choice,
};
use crate::methods::{Choice, Ranking};
use crate::pipeline::{PipelineError, SonarPipeline};
use crate::plan::polyline;
use crate::schedule::PingOrder;
use crate::threads::{pool, run_in_background};
use echotank_config::spec::{MediumSpec, SonarSpec};
use echotank_core::model::{ModelChoice, Synthesis};
use echotank_core::ping::{ElementFrame, ErrorCheck, MethodMark, PingPlan};
use echotank_core::scene::Scatterers;
use echotank_core::settings::SonarSettings;
use echotank_synthesis::error_model::Conditions;

/// Length of a block, rounded up to whole pings: time to rank, and to make an engine with the finest tolerance.
const BLOCK_S: f64 = 4.0;
const MIN_BLOCK_PINGS: u32 = 2;
/// Blocks whose motion counts: at least 8 s, the period of a swell.
const BLOCKS_SEEN: usize = 3;
/// Motion is rounded up to powers of the root of two: similar blocks then get the same methods.
const STEPS_PER_DOUBLING: f64 = 2.0;
/// Smaller motion counts as none: m/s, m/s^2, m/s.
const MIN_MOTION: [f64; 3] = [1e-6, 1e-6, 1e-6];
/// What engines are designed for: m/s, m/s^2; the attitude may turn as it likes.
const DESIGNED_FOR: [f64; 3] = [FASTEST_PLATFORM_M_PER_S, HARDEST_M_PER_S2, f64::INFINITY];
/// Instants of a ping at which its motion is examined.
const INSTANTS: usize = 8;

/// Maximum speed, acceleration and rotational speed over all lever arms, m/s, m/s^2 and m/s.
type MotionPeaks = [f64; 3];

/// Selects the methods of one sonar while it runs.
pub struct MethodSelector {
    /// As configured.
    spec: SonarSpec,
    medium: MediumSpec,
    costs: Arc<Costs>,
    memo: Arc<Memo>,
    choice: Choice,
    mark: MethodMark,
    /// What the current selection promises of a ping; `None` before the first.
    promise: Option<Promise>,
    /// Of the ping that is being made.
    ping_error: f64,
    ping_promise: Option<PingPromise>,
    windows: WindowStatistics,
    /// Settings of the current selection; `None` before the first.
    selected_for: Option<SonarSettings>,
    /// Block of the newest ping, and the largest motion of the two blocks before and of this one so far.
    block: Option<u32>,
    motion: [MotionPeaks; BLOCKS_SEEN],
    /// What an error check has refuted.
    excluded: Vec<Choice>,
    /// Whether a failed error check changes the methods.
    corrects: bool,
    pending: Option<Pending>,
    /// The choice before, whose pipeline is kept: two that cost about the same may alternate.
    spare: Option<(Choice, Box<SonarPipeline>)>,
    /// Counts since the sonar was opened.
    pub counts: SelectionCounts,
}

/// Of a sonar, since it was opened.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SelectionCounts {
    /// New rankings of the candidates.
    pub(crate) ranked: u64,
    /// Rankings after which the selected methods changed.
    pub changed: u64,
    /// Selections given up because an error check was above their tolerance.
    pub given_up: u64,
    /// Selections that could not be made; the one before stays.
    pub failed: u64,
}

struct Pending {
    from_ping: u32,
    settings: SonarSettings,
    thread: JoinHandle<Option<Selection>>,
}

/// What was chosen, and where its pipeline is.
struct Selection {
    choice: Choice,
    mark: MethodMark,
    promise: Promise,
    pipeline: Made,
    /// Better choices whose pipeline was refused.
    refused: u64,
}

enum Made {
    /// It is in use.
    Current,
    /// It is the spare one.
    Spare,
    New(Box<SonarPipeline>),
}

impl MethodSelector {
    /// `None` if the configuration fixes all methods.
    pub fn new(spec: &SonarSpec, medium: &MediumSpec, costs: Arc<Costs>) -> Option<Self> {
        spec.synthesis.selects_methods().then(|| Self {
            choice: Choice {
                model: Self::start_model(spec),
                engine_tolerance: spec.synthesis.engine_tolerance,
                nearest_m: spec.synthesis.nearest_m,
                part_elements: 1,
            },
            mark: MethodMark {
                plan: 0,
                predicted_error: f64::NAN,
                predicted_ms: f64::NAN,
                tolerance: spec.synthesis.tolerance,
                part_elements: 1,
            },
            promise: None,
            ping_error: f64::NAN,
            ping_promise: None,
            windows: WindowStatistics::default(),
            spec: spec.clone(),
            medium: medium.clone(),
            costs,
            memo: Arc::default(),
            selected_for: None,
            block: None,
            motion: [MIN_MOTION; BLOCKS_SEEN],
            excluded: Vec::new(),
            corrects: true,
            pending: None,
            spare: None,
            counts: SelectionCounts::default(),
        })
    }

    /// Methods before the first selection: where the synthesis is selected, the direct sum, which needs no engine and suits every pulse.
    pub(crate) fn start_model(spec: &SonarSpec) -> ModelChoice {
        ModelChoice {
            synthesis: match spec.synthesis.auto.synthesis {
                true => Synthesis::Direct,
                false => spec.model.synthesis,
            },
            ..spec.model
        }
    }

    /// Takes the configured starting methods in place of the direct sum, if nothing has been selected and their engine can be made.
    pub(crate) fn start(&mut self, medium: &MediumSpec, pipeline: &mut SonarPipeline) {
        if self.selected_for.is_some() || self.choice.model == self.spec.model {
            return;
        }
        if let Ok(made) = SonarPipeline::new(&self.spec, medium) {
            *pipeline = made;
            self.choice.model = self.spec.model;
        }
    }

    /// Selection that the pings record.
    pub fn mark(&self) -> Option<MethodMark> {
        self.promise.is_some().then_some(MethodMark {
            predicted_error: self.ping_error,
            ..self.mark
        })
    }

    /// Predicts the error of a ping that is about to be made, and replaces its path model by a more exact one if the ping needs that.
    pub fn at_ping(&mut self, plan: &mut PingPlan, scatterers: &Scatterers) {
        self.ping_promise = None;
        let Some(promise) = &self.promise else {
            return;
        };
        let goal = goal(&self.spec);
        // Of pictures the goal is no error of samples.
        if goal.image_cells.is_some() || scatterers.is_empty() {
            self.ping_error = self.mark.predicted_error;
            return;
        }
        // A selection that misses the tolerance is no reason to call every ping an exception.
        let expected = self.mark.predicted_error.max(goal.tolerance);
        let ping = promise.of_ping(&self.spec, plan, scatterers, expected);
        plan.model.path = ping.path;
        if ping.segment_s != plan.model.segment_s {
            plan.model.segment_s = ping.segment_s;
            let window_s = plan.window_s(self.spec.receiver.sample_rate_hz);
            polyline(
                &plan.trajectory,
                window_s,
                ping.segment_s,
                &mut plan.segments,
            );
        }
        self.ping_error = ping.error;
        self.ping_promise = Some(ping);
    }

    /// Predicts the error of a ping again, now that its samples are made: they tell how far its windows fade. `is_direct`: the direct sum made them all in
    /// place of the engine.
    pub fn after_synthesis(
        &mut self,
        plan: &PingPlan,
        scatterers: &Scatterers,
        frames: &[ElementFrame],
        is_direct: bool,
    ) {
        // Where parts of lines or other pulses sound, the samples are not those of the echoes of this pulse at these elements.
        let is_plain = self.choice.part_elements == 1 && self.spec.more_pulses.is_empty();
        if let (Some(promise), Some(mut ping)) = (&self.promise, self.ping_promise.take())
            && is_plain
        {
            let of = (&mut ping, &mut self.windows);
            let made = (frames, is_direct);
            promise.of_samples(&self.spec, plan, scatterers, made, of);
            self.ping_error = ping.error;
        }
    }

    /// Whether a failed error check changes the methods (at first it does). Otherwise no ping depends on the checks of those before it.
    pub fn correct(&mut self, corrects: bool) {
        self.corrects = corrects;
    }

    /// Makes the first selection at once and replaces a pipeline that has not computed a ping. Call inside the pool that runs the pipeline.
    pub fn select_first(
        &mut self,
        plan: &PingPlan,
        scatterers: &Scatterers,
        pipeline: &mut SonarPipeline,
    ) {
        let selection = self.job(plan, scatterers).run();
        self.adopt(plan.settings, selection, pipeline);
    }

    /// Adopts the selection that is due.
    pub fn before_ping(&mut self, ping_number: u32, pipeline: &mut SonarPipeline) {
        let due = |p: &Pending| ping_number >= p.from_ping;
        if let Some(pending) = self.pending.take_if(|p| due(p)) {
            let selection = pending.thread.join().ok().flatten();
            self.adopt(pending.settings, selection, pipeline);
        }
    }

    fn adopt(
        &mut self,
        settings: SonarSettings,
        selection: Option<Selection>,
        pipeline: &mut SonarPipeline,
    ) {
        self.counts.ranked += 1;
        self.selected_for = Some(settings);
        let Some(selection) = selection else {
            self.counts.failed += 1;
            return;
        };
        self.counts.failed += selection.refused;
        let made = match selection.pipeline {
            Made::Current => None,
            Made::Spare => self.spare.take().map(|(_, spare)| spare),
            Made::New(made) => Some(made),
        };
        if made.is_some() || selection.choice != self.choice {
            self.counts.changed += 1;
        }
        if let Some(mut made) = made {
            // What refuted the methods before says nothing of these.
            if !self.excluded.contains(&self.choice) {
                made.carry_on_checks(pipeline);
            }
            std::mem::swap(pipeline, &mut made);
            self.spare = Some((self.choice, made));
        }
        pipeline.set_model(selection.choice.model);
        self.choice = selection.choice;
        self.promise = Some(selection.promise);
        self.mark = selection.mark;
    }

    /// Examines a computed ping.
    pub fn after_ping(
        &mut self,
        plan: &PingPlan,
        scatterers: &Scatterers,
        error_check: Option<&ErrorCheck>,
    ) {
        let begins = self.begins_block(plan);
        let is_changed = self.is_changed(plan);
        self.remember(plan);
        if is_changed {
            // Another pulse or range is another problem: what failed there may do here.
            self.excluded.clear();
        }
        let fault = self.corrects && error_check.is_some_and(|c| c.fault);
        let is_refuted = fault && self.promise.is_some() && !self.excluded.contains(&self.choice);
        if self.pending.is_some() {
            return;
        }
        let pings = block_pings(&plan.settings, self.medium.sound_speed_m_per_s);
        let block = block(plan, &self.medium);
        let from_ping = match is_changed || is_refuted {
            true => plan.ping_number.saturating_add(pings),
            false if begins && block > 0 || is_middle_of_first(plan.ping_number, pings) => {
                (block + 1) * pings + 1
            }
            false => return,
        };
        if is_refuted {
            self.counts.given_up += 1;
            self.excluded.push(self.choice);
        }
        self.start_selection(plan, scatterers, from_ping);
    }

    /// Whether a selection may begin with this ping, which needs its scatterers.
    pub(crate) fn examines(&self, plan: &PingPlan) -> bool {
        let pings = block_pings(&plan.settings, self.medium.sound_speed_m_per_s);
        self.begins_block(plan)
            || self.is_changed(plan)
            || is_middle_of_first(plan.ping_number, pings)
    }

    fn begins_block(&self, plan: &PingPlan) -> bool {
        self.block != Some(block(plan, &self.medium))
    }

    /// Whether the current selection is for other settings.
    fn is_changed(&self, plan: &PingPlan) -> bool {
        self.selected_for.is_none_or(|settings| {
            settings.range_m != plan.settings.range_m
                || settings.pulse_duration_s != plan.settings.pulse_duration_s
        })
    }

    /// Notes the motion of a ping.
    fn remember(&mut self, plan: &PingPlan) {
        let block = block(plan, &self.medium);
        let passed = self.block.map_or(0, |before| block.abs_diff(before));
        for _ in 0..passed.min(BLOCKS_SEEN as u32) {
            self.motion.rotate_left(1);
            self.motion[BLOCKS_SEEN - 1] = MIN_MOTION;
        }
        self.block = Some(block);
        let now = motion_peaks(&self.spec, plan);
        self.motion[BLOCKS_SEEN - 1] = larger(self.motion[BLOCKS_SEEN - 1], now);
    }

    /// The motion to select for over that of this ping.
    fn motion_scale(&self, plan: &PingPlan) -> MotionScale {
        let now = motion_peaks(&self.spec, plan);
        let all = self.motion.iter().copied().fold(now, larger);
        let times = |k: usize| {
            let now = now[k].max(MIN_MOTION[k]);
            // A ping that happens to stand still says nothing of the directions: as far as ten times it is believed.
            (rounded_up(all[k].max(now), DESIGNED_FOR[k]) / now).clamp(1.0, 10.0)
        };
        MotionScale {
            speed: times(0),
            acceleration: times(1),
            turning: times(2),
        }
    }

    /// Starts a selection in another thread.
    fn start_selection(&mut self, plan: &PingPlan, scatterers: &Scatterers, from_ping: u32) {
        let job = self.job(plan, scatterers);
        let spawned = thread::Builder::new().name("plan".into()).spawn(move || {
            run_in_background();
            job.run()
        });
        match spawned {
            Ok(thread) => {
                self.pending = Some(Pending {
                    from_ping,
                    settings: plan.settings,
                    thread,
                });
            }
            Err(_) => self.counts.failed += 1,
        }
    }

    fn job(&self, plan: &PingPlan, scatterers: &Scatterers) -> Job {
        let mut spec = self.spec.clone();
        // Engines are made for the settings in force.
        spec.settings = plan.settings;
        Job {
            spec,
            medium: self.medium.clone(),
            costs: self.costs.clone(),
            memo: self.memo.clone(),
            plan: plan.clone(),
            scatterers: sample(scatterers),
            count: scatterers.len(),
            motion_scale: self.motion_scale(plan),
            excluded: self.excluded.clone(),
            // Before the first selection the pipeline may be the configured one or the direct sum.
            current: self.promise.is_some().then_some(self.choice),
            spare: self.spare.as_ref().map(|(choice, _)| *choice),
            threads: rayon::current_num_threads(),
        }
    }
}

/// A selection to be made, with its input.
struct Job {
    spec: SonarSpec,
    medium: MediumSpec,
    costs: Arc<Costs>,
    memo: Arc<Memo>,
    plan: PingPlan,
    scatterers: Scatterers,
    count: usize,
    motion_scale: MotionScale,
    excluded: Vec<Choice>,
    current: Option<Choice>,
    spare: Option<Choice>,
    threads: usize,
}

impl Job {
    fn run(mut self) -> Option<Selection> {
        let peaks = echo_peaks(&self.spec, &self.plan, &self.scatterers);
        let mut refused = 0;
        loop {
            let (ranking, conditions) = self.rank()?;
            let candidate = ranking.chosen();
            let choice = candidate.choice;
            let has_engines = |made: &Choice| made.has_engines_of(&choice);
            let pipeline = if self.current.as_ref().is_some_and(has_engines) {
                Made::Current
            } else if self.spare.as_ref().is_some_and(has_engines) {
                Made::Spare
            } else {
                match self.make(&choice) {
                    Ok(made) => Made::New(made),
                    // The next best.
                    Err(_) if !self.excluded.contains(&choice) => {
                        self.excluded.push(choice);
                        refused += 1;
                        continue;
                    }
                    Err(_) => return None,
                }
            };
            return Some(Selection {
                choice,
                mark: MethodMark {
                    plan: block(&self.plan, &self.medium) + 1,
                    predicted_error: candidate.error(),
                    predicted_ms: candidate.cost_ms(),
                    tolerance: self.spec.synthesis.tolerance,
                    part_elements: choice.part_elements,
                },
                promise: Promise::new(candidate, conditions, peaks.times(&self.motion_scale)),
                pipeline,
                refused,
            });
        }
    }

    fn rank(&self) -> Option<(Ranking, Conditions)> {
        let scene = Scene {
            spec: &self.spec,
            medium: &self.medium,
            plan: &self.plan,
            scatterers: &self.scatterers,
            count: self.count,
            costs: &self.costs,
            motion_scale: self.motion_scale,
        };
        rank_with_conditions(&scene, &self.excluded, &self.memo)
    }

    /// With as many threads as the pool that will run it, and none of its own.
    fn make(&self, choice: &Choice) -> Result<Box<SonarPipeline>, PipelineError> {
        let spec = with_choice(&self.spec, choice);
        let make = || SonarPipeline::new(&spec, &self.medium).map(Box::new);
        match pool(self.threads) {
            Ok(pool) => pool.install(make),
            Err(_) => make(),
        }
    }
}

/// Pings of a block.
fn block_pings(settings: &SonarSettings, sound_speed_m_per_s: f64) -> u32 {
    let period_s = 1e-9 * crate::period_ns(settings, sound_speed_m_per_s) as f64;
    ((BLOCK_S / period_s).ceil() as u32).max(MIN_BLOCK_PINGS)
}

/// Whether the selection for the second block examines this ping. `pings`: of a block.
fn is_middle_of_first(ping_number: u32, pings: u32) -> bool {
    ping_number == 1 + pings / 2
}

/// Block of a ping; pings are numbered from 1. The sound speed is that of the schedule, which refraction does not change.
fn block(plan: &PingPlan, medium: &MediumSpec) -> u32 {
    (plan.ping_number.max(1) - 1) / block_pings(&plan.settings, medium.sound_speed_m_per_s)
}

/// Whether the selection for ping `first` has seen the motion of the ping of `order`, which comes before it.
pub fn is_examined_before(first: u32, order: &PingOrder, sound_speed_m_per_s: f64) -> bool {
    let pings = block_pings(&order.settings, sound_speed_m_per_s);
    let block = |number: u32| (number.max(1) - 1) / pings;
    block(order.ping_number) + BLOCKS_SEEN as u32 >= block(first)
}

/// The next step up of a motion. Engines are designed for motion up to `limit`: what is within is rounded up to it at most.
fn rounded_up(motion: f64, limit: f64) -> f64 {
    let steps = (STEPS_PER_DOUBLING * libm::log2(motion)).ceil();
    let up = libm::exp2(steps / STEPS_PER_DOUBLING);
    if motion <= limit { up.min(limit) } else { up }
}

fn larger(a: MotionPeaks, b: MotionPeaks) -> MotionPeaks {
    [0, 1, 2].map(|k| a[k].max(b[k]))
}

/// Motion of a ping at all transmitters, both ends of every line and the middle of an arc.
fn motion_peaks(spec: &SonarSpec, plan: &PingPlan) -> MotionPeaks {
    let step_s = plan.window_s(spec.receiver.sample_rate_hz) / INSTANTS as f64;
    let mut worst = [0.0f64; 3];
    let transmit = spec.transmit.iter().map(|t| t.mounting.position_m);
    let ends = spec
        .receive
        .iter()
        .flat_map(|array| array.outermost().map(|e| array.element_body_m(e)));
    for arm_m in transmit.chain(ends) {
        let mut before = None;
        for k in 0..=INSTANTS {
            let pose = plan.trajectory.pose_at(k as f64 * step_s);
            let velocity = pose.point_velocity_m_per_s(arm_m);
            worst[0] = worst[0].max(velocity.length());
            worst[2] = worst[2].max((velocity - pose.velocity_m_per_s).length());
            if let Some(before) = before.replace(velocity) {
                worst[1] = worst[1].max((velocity - before).length() / step_s);
            }
        }
    }
    worst
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn motion_within_the_design_is_not_rounded_up_beyond_it() {
        let near = |a: f64, b: f64| assert!((a / b - 1.0).abs() < 1e-12, "{a} {b}");
        near(rounded_up(5.0, 10.0), 32f64.sqrt());
        near(rounded_up(8.3, 10.0), 10.0);
        near(rounded_up(10.0, 10.0), 10.0);
        near(rounded_up(10.1, 10.0), 128f64.sqrt());
        near(rounded_up(8.3, f64::INFINITY), 128f64.sqrt());
    }
}
