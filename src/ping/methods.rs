//! Choice among candidate methods: path model, Doppler model, synthesis and culling of a sonar's pings.
//!
//! In: candidates, each with the errors that the stages' error models predict for its parts and its cost; the goal. Out: the cheapest candidate
//! within the goal, all others in the order of their cost, and why. Knows no stage: `crate::method_selection` asks the error models.
//!
//! How errors add: a candidate differs from the reference by one step after another (path, then Doppler, then the sum, then what is left out), and
//! the norm of a sum of differences is at most the sum of their norms (the triangle inequality). So parts are added as they are; parts of random
//! phase would add as squares, and the bound is then up to twice too high with four parts alike.

use crate::work::Work;
use echotank_core::model::{ModelChoice, Synthesis};
use echotank_synthesis::array::cut_echoes;
use echotank_synthesis::array::gridded::LEVELS;
use echotank_synthesis::error_model::EchoStatistics;

/// One of the choices that make up a candidate.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Family {
    /// Path model.
    Path,
    /// Doppler model.
    Doppler,
    /// Synthesis method, with its array form, kernel and precision.
    Sum,
    /// Pattern floor below which scatterers are left out.
    Culling,
    /// Whether lines are made from elements or from parts of them.
    Output,
    /// Moving scatterers, which have a pass of their own.
    Moving,
}

impl Family {
    /// All families, in the order of the parts of a candidate.
    pub const ALL: [Self; 6] = [
        Self::Path,
        Self::Doppler,
        Self::Sum,
        Self::Culling,
        Self::Output,
        Self::Moving,
    ];
    /// As `echotank check` names it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Path => "path",
            Self::Doppler => "doppler",
            Self::Sum => "synthesis",
            Self::Culling => "culling",
            Self::Output => "output",
            Self::Moving => "moving",
        }
    }
}

/// One member of a family under the ping's conditions.
#[derive(Clone, Debug, PartialEq)]
pub struct Part {
    /// The family.
    pub family: Family,
    /// The member, as `echotank check` prints it.
    pub choice: String,
    /// Predicted relative error of element samples; where no elements are made, of a line's samples before pulse compression.
    pub error: f64,
    /// Cost estimate, milliseconds of one core.
    pub cost_ms: f64,
    /// The work behind that cost.
    pub work: Work,
    /// Reason for the predicted error.
    pub why: String,
}

/// Displacement of targets in an image by a candidate's path and Doppler models.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Displaced {
    /// Along the track, resolution cells.
    pub along_cells: f64,
    /// In range, resolution cells.
    pub range_cells: f64,
}

/// The methods that a pipeline is made with, beside the configuration.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Choice {
    /// Path, Doppler, synthesis and culling.
    pub model: ModelChoice,
    /// Tolerance of the engine; none is the whole tolerance.
    pub engine_tolerance: Option<f64>,
    /// Smallest range of a scatterer that the engines allow, metres.
    pub nearest_m: f64,
    /// Elements of a line that are made as one; 1 where elements are made.
    pub part_elements: usize,
}

impl Choice {
    /// Whether both choices have the same engines. Path, segments and culling belong to the plan of each ping; only the tables of `gridded-2d` depend
    /// on them.
    pub(crate) fn has_engines_of(&self, other: &Self) -> bool {
        let with_own_plan = Self {
            model: ModelChoice {
                path: self.model.path,
                segment_s: self.model.segment_s,
                cull_db: self.model.cull_db,
                ..other.model
            },
            ..*other
        };
        match self.model.synthesis {
            Synthesis::Gridded2d => self == other,
            _ => *self == with_own_plan,
        }
    }
}

/// A combination of methods with its predicted errors and costs.
#[derive(Clone, Debug, PartialEq)]
pub struct Candidate {
    /// The methods.
    pub choice: Choice,
    /// In the order of [`Family::ALL`].
    pub parts: [Part; 6],
    /// Displacement in images.
    pub displaced: Displaced,
    /// Errors of an echo by an engine that makes all elements one by one.
    pub echo_error: Option<EchoError>,
}

/// Errors of one echo by an engine.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct EchoError {
    /// rms over all places on its grid.
    pub mean: f64,
    /// In the worst window.
    pub window: f64,
    /// In windows whose levels below the strongest are those of [`level_of`](echotank_synthesis::array::gridded::level_of).
    pub by_level: [f64; LEVELS],
    /// In any window of a ping that is not made yet, at most, and of one that is.
    pub most: [f64; 2],
    /// What second derivatives of the range add: for each metre per second squared, and at most.
    pub accelerated: [f64; 2],
    /// Rounding errors that spread over the record, relative to the noise floor.
    pub spread: f64,
}

/// Motions of all but the rarest echoes lie within so many times their rms.
pub(crate) const EXTREMES: f64 = 3.0;

impl EchoError {
    /// The larger errors of two engines.
    pub(crate) fn or_more(self, other: Option<Self>) -> Self {
        other.map_or(self, |other| Self {
            mean: self.mean.max(other.mean),
            window: self.window.max(other.window),
            by_level: std::array::from_fn(|step| self.by_level[step].max(other.by_level[step])),
            most: [0, 1].map(|k| self.most[k].max(other.most[k])),
            accelerated: [0, 1].map(|k| self.accelerated[k].max(other.accelerated[k])),
            spread: self.spread.max(other.spread),
        })
    }

    /// Of a whole echo, and by the levels of windows, over that in the worst window.
    pub(crate) fn over_window(self) -> (f64, [f64; LEVELS]) {
        let window = self.window.max(f64::MIN_POSITIVE);
        let over = |error: f64| (error / window).min(1.0);
        (over(self.mean), self.by_level.map(over))
    }

    /// With the range accelerations that echoes have, m/s^2.
    fn with_acceleration(self, rms_m_per_s2: f64) -> Self {
        let [of_each, most] = self.accelerated;
        let error = (EXTREMES * rms_m_per_s2 * of_each).min(most);
        Self {
            mean: self.mean.hypot(error),
            window: self.window.hypot(error),
            ..self
        }
    }

    /// In the worst window of a ping that is not made, with its `fading` and acceleration as in [`EchoStatistics`].
    pub(crate) fn before_ping(self, fading: f64, rms_m_per_s2: f64) -> f64 {
        let of = self.with_acceleration(rms_m_per_s2);
        let of_echoes = of.window.max(fading * of.mean).min(of.most[0]);
        of_echoes.hypot(of.spread)
    }

    /// ... and of one that is: the ends of echoes have no more than these as a whole. `between`: how much further windows may fade between those that
    /// were looked at.
    pub(crate) fn of_ping(self, heard: &EchoStatistics, between: f64) -> f64 {
        let of = self.with_acceleration(heard.range_acceleration_m_per_s2);
        let ends = match cut_echoes(heard.tails) {
            cut if cut > 1.0 => heard.ends.max(cut),
            _ => heard.ends,
        };
        let of_ends = (ends * of.window).min(heard.tails * of.mean);
        let of_windows = between * heard.fading * of.mean;
        let of_echoes = of_ends.max(of_windows).min(of.most[1]);
        of_echoes.hypot(of.spread)
    }
}

impl Candidate {
    /// Upper bound of the relative error of element samples. The errors of path and Doppler are phases of the same echo, and add. The others are
    /// independent of them and of each other: their energies add.
    pub fn error(&self) -> f64 {
        let of = |family: Family| self.part(family).error;
        let phase = of(Family::Path) + of(Family::Doppler);
        phase.hypot(self.error_of_others())
    }
    /// Of all but path and Doppler.
    fn error_of_others(&self) -> f64 {
        let others = self
            .parts
            .iter()
            .filter(|part| !matches!(part.family, Family::Path | Family::Doppler));
        others.fold(0.0, |sum, part| sum.hypot(part.error))
    }
    /// Cost estimate, milliseconds of one core.
    pub fn cost_ms(&self) -> f64 {
        self.parts.iter().map(|part| part.cost_ms).sum()
    }
    /// The part of one family.
    pub fn part(&self, family: Family) -> &Part {
        &self.parts[family as usize]
    }
    /// How much of the motion is modelled, by its place among path and Doppler models.
    fn modelled(&self) -> (u8, u8) {
        let model = self.choice.model;
        (model.path as u8, model.doppler as u8)
    }
    /// `k-segment 10 ms, stretch, gridded-1d 5e-4, culled at -40 dB`.
    pub fn text(&self) -> String {
        // Elements go without saying, and of moving scatterers there is no choice.
        let said = |part: &&Part| match part.family {
            Family::Output => self.choice.part_elements > 1,
            family => family != Family::Moving,
        };
        let said = self.parts.iter().filter(said);
        let choices: Vec<&str> = said.map(|part| part.choice.as_str()).collect();
        choices.join(", ")
    }
}

/// Accuracy that a ping must reach.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Goal {
    /// Relative error of element samples.
    pub tolerance: f64,
    /// Where pictures are all that is looked at: path and Doppler may displace things by so many range cells, and by [`ALONG_PER_RANGE`] times as
    /// many cells along the track, whatever samples are off by; sum and culling keep the tolerance.
    pub image_cells: Option<f64>,
}

/// A quarter of a cell along the track is as little as a tenth of one in range.
pub const ALONG_PER_RANGE: f64 = 2.5;

impl Goal {
    /// Predicted error over the allowed error: up to 1, the candidate is within the goal.
    pub fn share(&self, candidate: &Candidate) -> f64 {
        let Some(cells) = self.image_cells else {
            return candidate.error() / self.tolerance;
        };
        let samples = [Family::Sum, Family::Culling, Family::Output, Family::Moving];
        let samples: f64 = samples.iter().map(|f| candidate.part(*f).error).sum();
        let Displaced {
            along_cells,
            range_cells,
        } = candidate.displaced;
        (samples / self.tolerance)
            .max(range_cells / cells)
            .max(along_cells / (ALONG_PER_RANGE * cells))
    }

    /// Whether the predicted error is within the goal.
    pub fn meets(&self, candidate: &Candidate) -> bool {
        self.share(candidate) <= 1.0
    }
}

/// The selected candidate and all others.
#[derive(Clone, Debug)]
pub struct Ranking {
    /// The goal.
    pub goal: Goal,
    /// Cheapest first.
    pub candidates: Vec<Candidate>,
    /// Those that cannot be made, and why.
    pub refused: Vec<(String, String)>,
    /// Index of the selected candidate.
    pub chosen: usize,
}

/// Where nothing is within the goal, what errs by no more than this times the least is as good.
const NEAR: f64 = 1.25;
/// An echo with this error or more is wrong as a whole.
const WHOLE: f64 = 1.0;

/// The cheapest candidate within the goal that is not barred; where there is none, the cheapest of those that miss it by the least. Where these have some
/// echo wrong as a whole, cheaper models would be no worse for it and much worse for all others: of those that model the motion best, the cheapest
/// that keeps the tolerance in all else. None where all are barred.
pub fn choose(
    goal: Goal,
    mut candidates: Vec<Candidate>,
    refused: Vec<(String, String)>,
    barred: &[Choice],
) -> Option<Ranking> {
    candidates.sort_by(|a, b| {
        let by_cost = a.cost_ms().total_cmp(&b.cost_ms());
        // What costs the same models no more than it must.
        let simpler = a.modelled().cmp(&b.modelled());
        by_cost.then(simpler).then(a.error().total_cmp(&b.error()))
    });
    let may = |c: &Candidate| !barred.contains(&c.choice);
    let first = candidates.iter().position(|c| may(c) && goal.meets(c));
    let chosen = match first {
        Some(first) => first,
        None => {
            let shares = candidates.iter().filter(|c| may(c)).map(|c| goal.share(c));
            let least = shares.min_by(f64::total_cmp)?;
            let near = |c: &Candidate| may(c) && goal.share(c) <= NEAR * least;
            let all_near = || candidates.iter().filter(|c| near(c));
            let first = candidates.iter().position(near)?;
            match goal.image_cells.is_none() && all_near().all(|c| c.error() >= WHOLE) {
                false => first,
                true => {
                    let fullest = all_near().map(Candidate::modelled).max();
                    let full = |c: &Candidate| near(c) && Some(c.modelled()) == fullest;
                    let good = |c: &Candidate| full(c) && c.error_of_others() <= goal.tolerance;
                    let good = candidates.iter().position(good);
                    good.or_else(|| candidates.iter().position(full))?
                }
            }
        }
    };
    Some(Ranking {
        goal,
        candidates,
        refused,
        chosen,
    })
}

impl Ranking {
    /// The selected candidate.
    pub fn chosen(&self) -> &Candidate {
        &self.candidates[self.chosen]
    }

    /// Whether the selected candidate meets the goal.
    pub fn is_within(&self) -> bool {
        self.goal.meets(self.chosen())
    }

    /// Of all that are cheaper, the one that misses the goal by the least.
    pub fn next_cheaper(&self) -> Option<&Candidate> {
        self.candidates[..self.chosen]
            .iter()
            .min_by(|a, b| self.goal.share(a).total_cmp(&self.goal.share(b)))
    }

    /// The cheapest that errs by half as much or less.
    pub fn next_costlier(&self) -> Option<&Candidate> {
        let share = 0.5 * self.goal.share(self.chosen());
        self.candidates
            .iter()
            .skip(self.chosen)
            .find(|c| self.goal.share(c) <= share)
    }

    /// Of those that make elements where the chosen one does not, or the other way round: the cheapest that keeps the goal, or else misses it by the
    /// least.
    pub fn other_output(&self) -> Option<&Candidate> {
        let elements = self.chosen().choice.part_elements == 1;
        let others = || {
            let all = self.candidates.iter();
            all.filter(move |c| (c.choice.part_elements == 1) != elements)
        };
        let within = others().find(|c| self.goal.meets(c));
        within.or_else(|| others().min_by(|a, b| self.goal.share(a).total_cmp(&self.goal.share(b))))
    }

    /// Why this member of a family, in one sentence.
    pub fn reason(&self, family: Family) -> String {
        let part = self.chosen().part(family);
        // Everything else as it is, this one cheaper.
        let others = |c: &&Candidate| {
            Family::ALL
                .into_iter()
                .filter(|f| *f != family)
                .all(|f| c.part(f).choice == self.chosen().part(f).choice)
        };
        let cheaper = self.candidates[..self.chosen]
            .iter()
            .filter(others)
            .filter(|c| c.part(family).choice != part.choice && !self.goal.meets(c))
            .min_by(|a, b| a.part(family).error.total_cmp(&b.part(family).error));
        let why = match part.why.is_empty() {
            true => String::new(),
            false => format!("{}; ", part.why),
        };
        match cheaper {
            Some(c) => format!(
                "{why}{} would leave an error of {:.1e}, which is too large",
                c.part(family).choice,
                c.part(family).error
            ),
            None => format!("{why}no cheaper choice fits the other methods"),
        }
    }

    /// What another candidate would change, in words.
    pub fn change(&self, other: &Candidate) -> String {
        let differs: Vec<String> = Family::ALL
            .into_iter()
            .filter(|f| self.chosen().part(*f).choice != other.part(*f).choice)
            .map(|f| format!("{} {}", f.name(), other.part(f).choice))
            .collect();
        format!(
            "{}: error {:.1e}, {:.2} ms ({:+.0} %)",
            differs.join(", "),
            other.error(),
            other.cost_ms(),
            100.0 * (other.cost_ms() / self.chosen().cost_ms() - 1.0)
        )
    }
}

/// Steps of a fitted tolerance for each doubling: plans on similar pings then find their engines designed.
const STEPS_PER_DOUBLING: f64 = 4.0;

/// Costs of engines are assumed to grow with this power of the inverse of their tolerance, where one tolerance alone was tried.
const TYPICAL_POWER: f64 = 0.25;
/// An engine is made for a fitted tolerance if it seems to cost at most so much of the cheapest that keeps the goal.
const WORTH_FITTING: f64 = 0.97;

/// Of candidates that differ in the tolerance of one engine and in their motion: the tolerance at which one of them would just keep the goal, if the sum's
/// error grew in proportion, and would be the cheapest, if the cost is a power of the tolerance. None if it is not between the coarsest and the finest of
/// `tolerances`, if a candidate has it, or if one that keeps the goal costs about as little.
pub(crate) fn fitted(
    goal: Goal,
    tolerances: &[Option<f64>],
    candidates: &[Candidate],
) -> Option<f64> {
    let [coarsest, finest] = [*tolerances.first()?, *tolerances.last()?];
    let (coarsest, finest) = (coarsest?, finest?);
    let kept = candidates.iter().filter(|c| goal.meets(c));
    let kept_ms = kept.map(Candidate::cost_ms).fold(f64::INFINITY, f64::min);
    let fits = candidates.iter().filter_map(|c| {
        let own = c.choice.engine_tolerance?;
        let others = c.error().powi(2) - c.part(Family::Sum).error.powi(2);
        let left = (goal.tolerance.powi(2) - others).max(0.0).sqrt();
        let step = (STEPS_PER_DOUBLING * libm::log2(left / c.part(Family::Sum).error)).floor();
        let tolerance = own * libm::exp2(step / STEPS_PER_DOUBLING);
        if step == 0.0 || !(tolerance > finest && tolerance < coarsest) {
            return None;
        }
        // The same on other engines, of which a nearer one tells more.
        let off = |its: f64| (its / tolerance).ln().abs();
        let same = candidates
            .iter()
            .filter(|other| other.choice.model == c.choice.model);
        let others = same.filter_map(|other| Some((other, other.choice.engine_tolerance?)));
        let others = others.filter(|(_, its)| *its != own);
        let nearest = others.min_by(|a, b| off(a.1).total_cmp(&off(b.1)));
        let power = match nearest {
            Some((_, its)) if off(its) < off(own) => return None,
            Some((other, its)) => {
                let power = (other.cost_ms() / c.cost_ms()).ln() / (own / its).ln();
                power.max(0.0)
            }
            None => TYPICAL_POWER,
        };
        Some((tolerance, c.cost_ms() * (own / tolerance).powf(power)))
    });
    let (tolerance, ms) = fits.min_by(|a, b| a.1.total_cmp(&b.1))?;
    (ms <= WORTH_FITTING * kept_ms).then_some(tolerance)
}

#[cfg(test)]
mod tests {
    use super::*;
    use echotank_core::model::{DopplerModel, PathModel, Synthesis};

    fn candidate(error: f64, cost_ms: f64) -> Candidate {
        let part = |family: Family| Part {
            family,
            choice: format!("{} {error:e}", family.name()),
            error: match family {
                Family::Path => error,
                _ => 0.0,
            },
            cost_ms: cost_ms / Family::ALL.len() as f64,
            work: Work::NONE,
            why: "so it is".into(),
        };
        Candidate {
            echo_error: None,
            choice: Choice {
                model: ModelChoice {
                    path: PathModel::KSegment,
                    doppler: DopplerModel::Stretch,
                    synthesis: Synthesis::Direct,
                    segment_s: error,
                    cull_db: None,
                },
                engine_tolerance: None,
                nearest_m: 1.0,
                part_elements: 1,
            },
            parts: Family::ALL.map(part),
            displaced: Displaced {
                along_cells: 2.0 * error,
                range_cells: error,
            },
        }
    }

    fn candidates() -> Vec<Candidate> {
        vec![
            candidate(1e-5, 40.0),
            candidate(1e-2, 1.0),
            candidate(1e-3, 4.0),
            candidate(5e-4, 4.01),
        ]
    }

    fn goal(tolerance: f64) -> Goal {
        Goal {
            tolerance,
            image_cells: None,
        }
    }

    /// An engine that errs by 0.6 of its tolerance, beside models that err by 6e-3.
    #[test]
    fn an_engine_is_fitted_to_what_the_models_leave() {
        const TOLERANCE: f64 = 1e-2;
        let with_path = |path: f64, tolerance: f64, cost_ms: f64| {
            let mut candidate = candidate(path, cost_ms);
            candidate.parts[Family::Sum as usize].error = 0.6 * tolerance;
            candidate.choice.engine_tolerance = Some(tolerance);
            candidate
        };
        let on_engine = |tolerance: f64, cost_ms: f64| with_path(6e-3, tolerance, cost_ms);
        let tolerances = [Some(2e-2), Some(2e-3)];
        let fit = |candidates: &[Candidate]| fitted(goal(TOLERANCE), &tolerances, candidates);
        let (coarse, fine) = (on_engine(2e-2, 1.0), on_engine(2e-3, 2.0));
        let goal = goal(TOLERANCE);
        assert!(!goal.meets(&coarse) && goal.meets(&fine));
        for candidates in [
            vec![coarse.clone(), fine.clone()],
            // The fine engine cannot be made.
            vec![coarse.clone()],
        ] {
            let tolerance = fit(&candidates).expect("between the two");
            assert!(goal.meets(&on_engine(tolerance, 1.5)), "{tolerance}");
            let coarser = tolerance * 2f64.powf(1.0 / STEPS_PER_DOUBLING);
            assert!(!goal.meets(&on_engine(coarser, 1.5)), "{tolerance}");
        }
        // A path that costs more and errs less leaves room for a coarser and cheaper engine.
        let fine_path = [with_path(2e-3, 2e-2, 1.05), with_path(2e-3, 2e-3, 2.05)];
        let both = [vec![coarse.clone(), fine.clone()], fine_path.to_vec()].concat();
        let tolerance = fit(&both).expect("between the two");
        assert!(goal.meets(&with_path(2e-3, tolerance, 1.5)), "{tolerance}");
        assert!(!goal.meets(&on_engine(tolerance, 1.5)), "{tolerance}");
        // An engine that errs by more than in proportion: a finer one.
        let mut short = on_engine(1.2e-2, 1.1);
        short.parts[Family::Sum as usize].error = 8.5e-3;
        let tolerance = fit(&[coarse.clone(), fine.clone(), short]).expect("finer");
        assert!((9e-3..1.1e-2).contains(&tolerance), "{tolerance}");
        // The coarse one is good enough, or the fine one is about what is left, or no engine is.
        assert_eq!(fit(&[on_engine(1.2e-2, 1.0), fine.clone()]), None);
        assert_eq!(fit(&[on_engine(1.3e-2, 1.0)]), None);
        let hopeless = |candidate: &Candidate| {
            let mut candidate = candidate.clone();
            candidate.parts[Family::Path as usize].error = 2.0 * TOLERANCE;
            candidate
        };
        assert_eq!(fit(&[hopeless(&coarse), hopeless(&fine)]), None);
        assert_eq!(fitted(goal, &[None], &[coarse]), None);
    }

    #[test]
    fn the_cheapest_within_is_chosen_and_its_neighbours_are_named() {
        let at = |tolerance: f64| choose(goal(tolerance), candidates(), Vec::new(), &[]).unwrap();
        assert_eq!(at(1e-2).chosen().error(), 1e-2);
        assert_eq!(at(1e-3).chosen().error(), 1e-3);
        assert_eq!(at(1e-4).chosen().error(), 1e-5);
        let none = at(1e-6);
        assert!(!none.is_within());
        assert_eq!(none.chosen().error(), 1e-5, "the nearest to it");
        let middle = at(1e-3);
        assert_eq!(middle.next_cheaper().unwrap().error(), 1e-2);
        assert_eq!(middle.next_costlier().unwrap().error(), 5e-4);
    }

    /// Of three that have an echo of the opposite sign, the one with the fullest models and a good sum.
    #[test]
    fn an_echo_that_is_wrong_as_a_whole_spoils_no_other() {
        let with = |path: PathModel, of_sum: f64, cost_ms: f64| {
            let mut candidate = candidate(2.0, cost_ms);
            candidate.choice.model.path = path;
            candidate.parts[Family::Sum as usize].error = of_sum;
            candidate
        };
        let all = [
            with(PathModel::StopAndHop, 1e-3, 1.0),
            with(PathModel::Continuous, 0.5, 2.0),
            with(PathModel::Continuous, 1e-3, 3.0),
            with(PathModel::Continuous, 1e-4, 4.0),
        ];
        let chosen = |candidates: &[Candidate]| {
            let ranking = choose(goal(1e-2), candidates.to_vec(), Vec::new(), &[]).unwrap();
            ranking.chosen().cost_ms()
        };
        assert!((chosen(&all) - 3.0).abs() < 1e-12);
        assert!((chosen(&all[..2]) - 2.0).abs() < 1e-12);
        // What errs by a tenth is not spoilt, and the cheapest is as good.
        let right = [candidate(0.1, 1.0), candidate(0.09, 2.0)];
        assert!((chosen(&right) - 1.0).abs() < 1e-12);
    }

    #[test]
    fn what_is_barred_is_passed_over() {
        let barred = [candidate(1e-3, 0.0).choice];
        let ranking = choose(goal(1e-3), candidates(), Vec::new(), &barred).unwrap();
        assert_eq!(ranking.chosen().error(), 5e-4);
        let barred: Vec<Choice> = candidates().iter().map(|c| c.choice).collect();
        assert!(choose(goal(1e-3), candidates(), Vec::new(), &barred).is_none());
        assert!(choose(goal(1e-3), Vec::new(), Vec::new(), &[]).is_none());
    }

    #[test]
    fn pictures_look_at_cells_and_not_at_samples() {
        let pictures = Goal {
            tolerance: 1e-6,
            image_cells: Some(1e-2),
        };
        let ranking = choose(pictures, candidates(), Vec::new(), &[]).unwrap();
        assert!(ranking.is_within());
        assert!((ranking.chosen().cost_ms() - 1.0).abs() < 1e-12);
    }
}
