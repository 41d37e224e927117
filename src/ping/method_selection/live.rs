//! Method selection while the sonar runs. Methods are selected anew when motion or settings have changed enough, or when an error check exceeds
//! the tolerance. A selection takes effect a fixed number of pings later.
//!
//! ```text
//! ping n: the motion has grown -> a thread ranks, and makes a pipeline if the choice is another
//! ping n + lead: the new pipeline is taken, and waited for if it must be
//! ```
//!
//! When a selection starts, its input and when it takes effect depend only on ping numbers, navigation and settings, never on computing time. The
//! same pings therefore use the same methods in every clock mode. A skipped ping is not examined.
//!
//! Every ping has its own promise ([`Promise`]): the error models of path and Doppler with its own motion. A ping that moves more than the selection
//! expected is made on the exact trajectory. Where even that leaves more than the tolerance, its promise says so, and a selection begins.

use std::collections::VecDeque;
use std::sync::Arc;
use std::thread::{self, JoinHandle};

use crate::method_selection::costs::Costs;
use crate::method_selection::echo_statistics::echo_peaks;
use crate::method_selection::promise::Promise;
use crate::method_selection::{
    MotionScale, Scene, goal, rank_with_conditions, sample, with_choice,
};
use crate::methods::{Choice, Ranking};
use crate::pipeline::{PipelineError, SonarPipeline};
use crate::threads::pool;
use echotank_config::spec::{MediumSpec, SonarSpec};
use echotank_core::model::{ModelChoice, Synthesis};
use echotank_core::ping::{ErrorCheck, MethodMark, PingPlan};
use echotank_core::scene::Scatterers;
use echotank_core::settings::SonarSettings;

/// Interval between examinations of the motion, in pings.
const MOTION_CHECK_PINGS: u32 = 4;
/// Number of examinations that are remembered: at 10 pings a second 13 s, longer than the period of a swell.
const MOTION_HISTORY: usize = 32;
/// Delay until a selection takes effect, rounded up to whole pings: time to make an engine with the finest tolerance.
const LEAD_S: f64 = 4.0;
/// Minimum delay until a selection takes effect, in pings.
const MIN_LEAD: u32 = 2;
/// Methods are selected anew if the motion grows by the first factor, or if all remembered motion falls below the second share.
const MAX_GROWTH: f64 = 1.2;
const MIN_REMAINDER: f64 = 0.4;
/// Smaller motion counts as none: m/s, m/s^2, m/s.
const MIN_MOTION: [f64; 3] = [1e-6, 1e-6, 1e-6];
/// A selection must cost less than this share of the current one to replace it.
const WORTHWHILE_COST: f64 = 0.85;
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
    choice: Choice,
    mark: MethodMark,
    /// What the current selection promises of a ping; `None` before the first.
    promise: Option<Promise>,
    /// Of the ping that is being made.
    ping_error: f64,
    /// Motion and settings on which the current selection is based; `None` before the first selection.
    basis: Option<(MotionPeaks, SonarSettings)>,
    recent: VecDeque<MotionPeaks>,
    excluded: Vec<Choice>,
    pending: Option<Pending>,
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
    basis: (MotionPeaks, SonarSettings),
    thread: JoinHandle<Outcome>,
}

/// The rank's, and a pipeline where another choice is worth it.
type Outcome = Option<(
    Choice,
    MethodMark,
    Promise,
    Result<Option<Box<SonarPipeline>>, PipelineError>,
)>;

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
            spec: spec.clone(),
            medium: medium.clone(),
            costs,
            basis: None,
            recent: VecDeque::with_capacity(MOTION_HISTORY + 1),
            excluded: Vec::new(),
            pending: None,
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
        if self.basis.is_some() || self.choice.model == self.spec.model {
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

    /// Predicts the error of a ping that is about to be made, and replaces its path model by the exact one if the ping needs that.
    pub fn at_ping(&mut self, plan: &mut PingPlan, scatterers: &Scatterers) {
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
        let (path, error) = promise.of_ping(&self.spec, plan, scatterers, expected);
        plan.model.path = path;
        self.ping_error = error;
    }

    /// Makes the first selection at once and replaces a pipeline that has not computed a ping. Call inside the pool that runs the pipeline.
    pub fn select_first(
        &mut self,
        plan: &PingPlan,
        scatterers: &Scatterers,
        pipeline: &mut SonarPipeline,
    ) {
        let peaks = motion_peaks(&self.spec, plan);
        let basis = (peaks, plan.settings);
        loop {
            let job = self.job(
                plan,
                sample(scatterers),
                scatterers.len(),
                MotionScale::NONE,
            );
            let outcome = job.run();
            let is_refused = matches!(outcome, Some((.., Err(_))));
            self.adopt(basis, outcome, pipeline);
            if !is_refused {
                return;
            }
            // What was refused is excluded; the next best is as good as a first selection.
            self.basis = None;
        }
    }

    /// Adopts the selection that is due.
    pub fn before_ping(&mut self, ping_number: u32, pipeline: &mut SonarPipeline) {
        let due = |p: &Pending| ping_number >= p.from_ping;
        if let Some(pending) = self.pending.take_if(|p| due(p)) {
            let outcome = pending.thread.join().ok().flatten();
            self.adopt(pending.basis, outcome, pipeline);
        }
    }

    fn adopt(
        &mut self,
        basis: (MotionPeaks, SonarSettings),
        outcome: Outcome,
        pipeline: &mut SonarPipeline,
    ) {
        self.counts.ranked += 1;
        self.basis = Some(basis);
        match outcome {
            Some((choice, mark, promise, Ok(made))) => {
                self.promise = Some(promise);
                if let Some(made) = made {
                    *pipeline = *made;
                    self.choice = choice;
                    self.counts.changed += 1;
                }
                self.mark = mark;
            }
            Some((choice, _, _, Err(_))) => {
                self.excluded.push(choice);
                self.counts.failed += 1;
            }
            None => self.counts.failed += 1,
        }
    }

    /// Examines a computed ping.
    pub fn after_ping(
        &mut self,
        plan: &PingPlan,
        scatterers: &Scatterers,
        error_check: Option<&ErrorCheck>,
    ) {
        let fault = error_check.is_some_and(|c| c.fault);
        if self.pending.is_some() {
            return;
        }
        if fault && self.basis.is_some() && !self.excluded.contains(&self.choice) {
            self.counts.given_up += 1;
            self.excluded.push(self.choice);
            self.start_selection(plan, scatterers);
            return;
        }
        let changed = match &self.basis {
            None => true,
            Some((_, settings)) => {
                settings.range_m != plan.settings.range_m
                    || settings.pulse_duration_s != plan.settings.pulse_duration_s
            }
        };
        if changed {
            // Another pulse or range is another problem: what failed there may do here.
            self.excluded.clear();
        }
        let beyond = self.promise.is_some()
            && self.ping_error > self.mark.predicted_error.max(self.spec.synthesis.tolerance);
        if !changed && !beyond && !plan.ping_number.is_multiple_of(MOTION_CHECK_PINGS) {
            return;
        }
        self.recent.push_back(motion_peaks(&self.spec, plan));
        if self.recent.len() > MOTION_HISTORY {
            self.recent.pop_front();
        }
        if changed || beyond || self.has_motion_changed() {
            self.start_selection(plan, scatterers);
        }
    }

    /// Maximum of all remembered motion.
    fn envelope(&self) -> MotionPeaks {
        self.recent.iter().fold(MIN_MOTION, |mut worst, peaks| {
            for (worst, value) in worst.iter_mut().zip(peaks) {
                *worst = worst.max(*value);
            }
            worst
        })
    }

    fn has_motion_changed(&self) -> bool {
        let Some((basis, _)) = &self.basis else {
            return true;
        };
        let full = self.recent.len() == MOTION_HISTORY;
        self.envelope().iter().zip(basis).any(|(now, then)| {
            let then = then.max(MIN_MOTION[0]);
            *now > MAX_GROWTH * then || full && *now < MIN_REMAINDER * then
        })
    }

    /// Starts a selection in another thread.
    fn start_selection(&mut self, plan: &PingPlan, scatterers: &Scatterers) {
        let now = motion_peaks(&self.spec, plan);
        let worst = self.envelope();
        let times = |k: usize| (worst[k] / now[k].max(MIN_MOTION[k])).max(1.0);
        // A ping that happens to stand still says nothing of the directions: as far as ten times it is believed.
        let motion_scale = MotionScale {
            speed: times(0).min(10.0),
            acceleration: times(1).min(10.0),
            turning: times(2).min(10.0),
        };
        let job = self.job(plan, sample(scatterers), scatterers.len(), motion_scale);
        let c = plan.sound_speed_m_per_s;
        let period_s = 1e-9 * crate::period_ns(&plan.settings, c) as f64;
        let lead = ((LEAD_S / period_s).ceil() as u32).max(MIN_LEAD);
        let basis = ([0, 1, 2].map(|k| worst[k].max(now[k])), plan.settings);
        let spawned = thread::Builder::new()
            .name("plan".into())
            .spawn(move || job.run());
        match spawned {
            Ok(thread) => {
                self.pending = Some(Pending {
                    from_ping: plan.ping_number.saturating_add(lead),
                    basis,
                    thread,
                });
            }
            Err(_) => self.counts.failed += 1,
        }
    }

    fn job(
        &self,
        plan: &PingPlan,
        scatterers: Scatterers,
        count: usize,
        motion_scale: MotionScale,
    ) -> Job {
        let mut spec = self.spec.clone();
        // Engines are made for the settings in force.
        spec.settings = plan.settings;
        Job {
            spec,
            medium: self.medium.clone(),
            costs: self.costs.clone(),
            plan: plan.clone(),
            scatterers,
            count,
            motion_scale,
            excluded: self.excluded.clone(),
            current: self.choice,
            is_first: self.basis.is_none(),
            number: self.mark.plan,
            threads: rayon::current_num_threads(),
        }
    }
}

/// A selection to be made, with its input.
struct Job {
    spec: SonarSpec,
    medium: MediumSpec,
    costs: Arc<Costs>,
    plan: PingPlan,
    scatterers: Scatterers,
    count: usize,
    motion_scale: MotionScale,
    excluded: Vec<Choice>,
    current: Choice,
    is_first: bool,
    number: u32,
    threads: usize,
}

impl Job {
    fn run(&self) -> Outcome {
        let scene = Scene {
            spec: &self.spec,
            medium: &self.medium,
            plan: &self.plan,
            scatterers: &self.scatterers,
            count: self.count,
            costs: &self.costs,
            motion_scale: self.motion_scale,
        };
        let (ranking, conditions) = rank_with_conditions(&scene, &self.excluded)?;
        let peaks = echo_peaks(&self.spec, &self.plan, &self.scatterers);
        let kept = self.current_candidate(&ranking);
        let (choice, candidate) = match kept {
            Some(k) => (self.current, &ranking.candidates[k]),
            None => (ranking.chosen().choice, ranking.chosen()),
        };
        let is_new = choice != self.current;
        let mark = MethodMark {
            plan: self.number + u32::from(is_new || self.is_first),
            predicted_error: candidate.error(),
            predicted_ms: candidate.cost_ms(),
            tolerance: self.spec.synthesis.tolerance,
            part_elements: choice.part_elements,
        };
        let promise = Promise::new(candidate, conditions, peaks.times(&self.motion_scale));
        if !is_new {
            return Some((choice, mark, promise, Ok(None)));
        }
        let spec = with_choice(&self.spec, &choice);
        // With as many threads as the pool that will run it, and none of its own.
        let made = pool(self.threads).map(|pool| {
            pool.install(|| SonarPipeline::new(&spec, &self.medium))
                .map(|pipeline| Some(Box::new(pipeline)))
        });
        Some((choice, mark, promise, made.ok()?))
    }

    /// The current choice, if it still meets the goal and its replacement is hardly cheaper.
    fn current_candidate(&self, ranking: &Ranking) -> Option<usize> {
        if self.is_first || self.excluded.contains(&self.current) {
            return None;
        }
        let same = |choice: &Choice| {
            Choice {
                nearest_m: self.current.nearest_m,
                ..*choice
            } == self.current
        };
        let at = ranking.candidates.iter().position(|c| same(&c.choice))?;
        let candidate = &ranking.candidates[at];
        let is_expensive = ranking.chosen().cost_ms() < WORTHWHILE_COST * candidate.cost_ms();
        let nearer = ranking.chosen().choice.nearest_m < 0.9 * self.current.nearest_m;
        (goal(&self.spec).meets(candidate) && !is_expensive && !nearer).then_some(at)
    }
}

/// Motion of a ping at all transmitters and both ends of every line.
fn motion_peaks(spec: &SonarSpec, plan: &PingPlan) -> MotionPeaks {
    let step_s = plan.window_s(spec.receiver.sample_rate_hz) / INSTANTS as f64;
    let mut worst = [0.0f64; 3];
    let transmit = spec.transmit.iter().map(|t| t.mounting.position_m);
    let ends = spec
        .receive
        .iter()
        .flat_map(|array| [0, array.elements - 1].map(|e| array.element_body_m(e)));
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
