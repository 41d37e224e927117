//! Plans while the sonar runs: made anew when motion or settings have changed enough, when an error check says that a plan does not hold, and in
//! effect a fixed number of pings later.
//!
//! ```text
//! ping n: the motion has grown -> a thread ranks, and makes a pipeline if the choice is another
//! ping n + lead: the new pipeline is taken, and waited for if it must be
//! ```
//!
//! Which ping looks, what it sees and when its plan is in effect depend on ping numbers, navigation and settings alone, never on how fast anything
//! was: the same pings are made with the same plans in every clock mode. A ping that is skipped looks at nothing.

use std::collections::VecDeque;
use std::sync::Arc;
use std::thread::{self, JoinHandle};

use crate::method_selection::costs::Costs;
use crate::method_selection::{Scene, Swell, goal, rank, sample, with_choice};
use crate::methods::{Choice, Ranking};
use crate::pipeline::{PipelineError, SonarPipeline};
use crate::threads::pool;
use echotank_config::spec::{MediumSpec, SonarSpec};
use echotank_core::ping::{ErrorCheck, MethodMark, PingPlan};
use echotank_core::scene::Scatterers;
use echotank_core::settings::SonarSettings;

/// Every so many pings the motion is looked at.
const LOOK_EVERY: u32 = 4;
/// What was seen in so many looks counts: at 10 pings a second 13 s, longer than a swell's period.
const REMEMBERED: usize = 32;
/// A plan made now is in effect after this long, in whole pings: time to make an engine with the finest tolerance.
const LEAD_S: f64 = 4.0;
/// In pings, at least.
const MIN_LEAD: u32 = 2;
/// Motion that has grown by this factor, or fallen to this share in all that is remembered, asks for a new plan.
const GROWN: f64 = 1.2;
const FALLEN: f64 = 0.4;
/// Below this nothing is motion: m/s, m/s^2, m/s.
const STILL: [f64; 3] = [1e-6, 1e-6, 1e-6];
/// A plan that costs less than this share of the one in effect is worth the change.
const WORTH: f64 = 0.85;
/// Instants of a ping at which its motion is looked at.
const INSTANTS: usize = 8;

/// Speed, acceleration and turning of the worst arm.
type Seen = [f64; 3];

/// The plans of one sonar.
pub struct Planner {
    /// As configured.
    spec: SonarSpec,
    medium: MediumSpec,
    costs: Arc<Costs>,
    choice: Choice,
    mark: MethodMark,
    /// What the plan in effect was made for; none before the first.
    made_for: Option<(Seen, SonarSettings)>,
    seen: VecDeque<Seen>,
    barred: Vec<Choice>,
    pending: Option<Pending>,
    /// Counts since the sonar was opened.
    pub counts: PlanCounts,
}

/// Of a sonar, since it was opened.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct PlanCounts {
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
    made_for: (Seen, SonarSettings),
    thread: JoinHandle<Outcome>,
}

/// The rank's, and a pipeline where another choice is worth it.
type Outcome = Option<(
    Choice,
    MethodMark,
    Result<Option<Box<SonarPipeline>>, PipelineError>,
)>;

impl Planner {
    /// None where nothing is left to the plan.
    pub fn new(spec: &SonarSpec, medium: &MediumSpec, costs: Arc<Costs>) -> Option<Self> {
        spec.synthesis.is_planned().then(|| Self {
            choice: Choice {
                model: spec.model,
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
            spec: spec.clone(),
            medium: medium.clone(),
            costs,
            made_for: None,
            seen: VecDeque::with_capacity(REMEMBERED + 1),
            barred: Vec::new(),
            pending: None,
            counts: PlanCounts::default(),
        })
    }

    /// What the pings of the plan in effect carry.
    pub fn mark(&self) -> Option<MethodMark> {
        self.made_for.is_some().then_some(self.mark)
    }

    /// The first plan, at once, in place of a pipeline that has made nothing yet. To be called inside the pool that runs it.
    pub fn begin(
        &mut self,
        plan: &PingPlan,
        scatterers: &Scatterers,
        pipeline: &mut SonarPipeline,
    ) {
        let seen = look(&self.spec, plan);
        let made_for = (seen, plan.settings);
        let job = self.job(plan, sample(scatterers), scatterers.len(), Swell::NONE);
        self.take(made_for, job.run(), pipeline);
    }

    /// Takes the plan that is due.
    pub fn before(&mut self, ping_number: u32, pipeline: &mut SonarPipeline) {
        let due = |p: &Pending| ping_number >= p.from_ping;
        if let Some(pending) = self.pending.take_if(|p| due(p)) {
            let outcome = pending.thread.join().ok().flatten();
            self.take(pending.made_for, outcome, pipeline);
        }
    }

    fn take(
        &mut self,
        made_for: (Seen, SonarSettings),
        outcome: Outcome,
        pipeline: &mut SonarPipeline,
    ) {
        self.counts.ranked += 1;
        self.made_for = Some(made_for);
        match outcome {
            Some((choice, mark, Ok(made))) => {
                if let Some(made) = made {
                    *pipeline = *made;
                    self.choice = choice;
                    self.counts.changed += 1;
                }
                self.mark = mark;
            }
            Some((choice, _, Err(_))) => {
                self.barred.push(choice);
                self.counts.failed += 1;
            }
            None => self.counts.failed += 1,
        }
    }

    /// Looks at a ping that has been made.
    pub fn after(
        &mut self,
        plan: &PingPlan,
        scatterers: &Scatterers,
        error_check: Option<&ErrorCheck>,
    ) {
        let fault = error_check.is_some_and(|c| c.fault);
        if self.pending.is_some() {
            return;
        }
        if fault && self.made_for.is_some() && !self.barred.contains(&self.choice) {
            self.counts.given_up += 1;
            self.barred.push(self.choice);
            self.order(plan, scatterers);
            return;
        }
        let changed = match &self.made_for {
            None => true,
            Some((_, settings)) => {
                settings.range_m != plan.settings.range_m
                    || settings.pulse_duration_s != plan.settings.pulse_duration_s
            }
        };
        if changed {
            // Another pulse or range is another problem: what failed there may do here.
            self.barred.clear();
        }
        if !changed && !plan.ping_number.is_multiple_of(LOOK_EVERY) {
            return;
        }
        self.seen.push_back(look(&self.spec, plan));
        if self.seen.len() > REMEMBERED {
            self.seen.pop_front();
        }
        if changed || self.has_moved_on() {
            self.order(plan, scatterers);
        }
    }

    /// The worst of all that is remembered.
    fn envelope(&self) -> Seen {
        self.seen.iter().fold(STILL, |mut worst, seen| {
            for (worst, value) in worst.iter_mut().zip(seen) {
                *worst = worst.max(*value);
            }
            worst
        })
    }

    fn has_moved_on(&self) -> bool {
        let Some((made_for, _)) = &self.made_for else {
            return true;
        };
        let full = self.seen.len() == REMEMBERED;
        self.envelope().iter().zip(made_for).any(|(now, then)| {
            let then = then.max(STILL[0]);
            *now > GROWN * then || full && *now < FALLEN * then
        })
    }

    /// Begins a plan beside the ping path.
    fn order(&mut self, plan: &PingPlan, scatterers: &Scatterers) {
        let now = look(&self.spec, plan);
        let worst = self.envelope();
        let times = |k: usize| (worst[k] / now[k].max(STILL[k])).max(1.0);
        // A ping that happens to stand still says nothing of the directions: as far as ten times it is believed.
        let swell = Swell {
            speed: times(0).min(10.0),
            acceleration: times(1).min(10.0),
            turning: times(2).min(10.0),
        };
        let job = self.job(plan, sample(scatterers), scatterers.len(), swell);
        let c = plan.sound_speed_m_per_s;
        let period_s = 1e-9 * crate::period_ns(&plan.settings, c) as f64;
        let lead = ((LEAD_S / period_s).ceil() as u32).max(MIN_LEAD);
        let made_for = ([0, 1, 2].map(|k| worst[k].max(now[k])), plan.settings);
        let spawned = thread::Builder::new()
            .name("plan".into())
            .spawn(move || job.run());
        match spawned {
            Ok(thread) => {
                self.pending = Some(Pending {
                    from_ping: plan.ping_number.saturating_add(lead),
                    made_for,
                    thread,
                });
            }
            Err(_) => self.counts.failed += 1,
        }
    }

    fn job(&self, plan: &PingPlan, scatterers: Scatterers, count: usize, swell: Swell) -> Job {
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
            swell,
            barred: self.barred.clone(),
            current: self.choice,
            is_first: self.made_for.is_none(),
            number: self.mark.plan,
            threads: rayon::current_num_threads(),
        }
    }
}

/// A plan to be made, with all it needs.
struct Job {
    spec: SonarSpec,
    medium: MediumSpec,
    costs: Arc<Costs>,
    plan: PingPlan,
    scatterers: Scatterers,
    count: usize,
    swell: Swell,
    barred: Vec<Choice>,
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
            swell: self.swell,
        };
        let ranking = rank(&scene, &self.barred)?;
        let kept = self.kept(&ranking);
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
        if !is_new {
            return Some((choice, mark, Ok(None)));
        }
        let spec = with_choice(&self.spec, &choice);
        // With as many threads as the pool that will run it, and none of its own.
        let made = pool(self.threads).map(|pool| {
            pool.install(|| SonarPipeline::new(&spec, &self.medium))
                .map(|pipeline| Some(Box::new(pipeline)))
        });
        Some((choice, mark, made.ok()?))
    }

    /// The choice in effect, where it still does and what would take its place is hardly cheaper.
    fn kept(&self, ranking: &Ranking) -> Option<usize> {
        if self.is_first || self.barred.contains(&self.current) {
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
        let dear = ranking.chosen().cost_ms() < WORTH * candidate.cost_ms();
        let nearer = ranking.chosen().choice.nearest_m < 0.9 * self.current.nearest_m;
        (goal(&self.spec).meets(candidate) && !dear && !nearer).then_some(at)
    }
}

/// The motion of a ping, quickly: of all transmitters and both ends of every line.
fn look(spec: &SonarSpec, plan: &PingPlan) -> Seen {
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
