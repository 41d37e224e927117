//! Measures all methods and the automatic method selection for one case, against the retarded-time sum.

use std::collections::HashMap;
use std::panic::{AssertUnwindSafe, catch_unwind};

use echotank_config::spec::{AutoModel, SonarSpec};
use echotank_core::model::{DopplerModel, PathModel, Synthesis};
use echotank_core::ping::{PingOutput, PingPlan};
use echotank_core::scene::Scatterers;
use echotank_ping::conditions::{conditions, sum_error_model};
use echotank_ping::error_check::worst_window;
use echotank_ping::method_selection::costs::Costs;
use echotank_ping::method_selection::{MotionScale, Scene, rank, with_choice};
use echotank_ping::pipeline::SonarPipeline;
use echotank_runtime::chart::methods::Method;
use echotank_synthesis::echo::error_models::{doppler_error_model, path_error_model};
use echotank_synthesis::error_model::Conditions;

use serde::Serialize;

use super::spot::Spot;

/// Synthesis methods, in the order of the panels of the figures.
pub(crate) const SUMS: [Synthesis; 7] = [
    Synthesis::Direct,
    Synthesis::Gridded1d,
    Synthesis::GriddedLines,
    Synthesis::Gridded2d,
    Synthesis::Spectral,
    Synthesis::Nearest,
    Synthesis::Linear,
];
/// Doppler models, in the order of the rows of a panel. Models that every synthesis supports are first.
pub(crate) const DOPPLERS: [DopplerModel; 4] = [
    DopplerModel::None,
    DopplerModel::PaperEq21,
    DopplerModel::Stretch,
    DopplerModel::StretchQuadratic,
];

/// Result of one method for a case.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(crate) enum Outcome {
    /// The synthesis does not support this Doppler model.
    NotTaken,
    /// The method was refused, with the reason.
    Refused(String),
    /// No echo is expected and none was synthesised.
    Silence,
    Answer {
        /// Largest windowed error of any element, relative to the level of the window or of the element's whole ping, whichever
        /// is higher.
        error: f64,
        /// Upper bound predicted by the error models.
        said: f64,
        /// True if the error models predict that the tolerance is met. For an engine with a tolerance: that they leave a share
        /// for the engine.
        claims: bool,
        /// Number of echoes that the ping counted as outside the limits of its method.
        counted: u64,
    },
    /// A sample is NaN or infinite.
    NoNumber,
    Panic(String),
}

impl Outcome {
    /// Whether the error exceeds `tolerance` although the models predict otherwise and no echo was counted.
    pub(crate) fn is_silently_wrong(&self, tolerance: f64) -> bool {
        match *self {
            Self::Answer {
                error,
                said,
                claims,
                counted,
            } => claims && error > tolerance.max(said) && counted == 0,
            Self::NoNumber | Self::Panic(_) => true,
            _ => false,
        }
    }

    pub(crate) fn is_within(&self, tolerance: f64) -> bool {
        match *self {
            Self::Answer { error, .. } => error <= tolerance,
            Self::Silence => true,
            _ => false,
        }
    }
}

/// Automatic selection and its result.
#[derive(Clone, Debug)]
pub(crate) struct Planned {
    pub(crate) path: PathModel,
    pub(crate) doppler: DopplerModel,
    pub(crate) synthesis: Synthesis,
    pub(crate) text: String,
    /// True if the selection reports that no method meets the tolerance.
    pub(crate) out_of_reach: bool,
    pub(crate) outcome: Outcome,
}

/// One column of a map.
pub(crate) struct Column {
    /// Ordered by [`SUMS`], [`DOPPLERS`] and [`PathModel::ALL`].
    pub(crate) cells: Vec<Outcome>,
    /// `None` if no ping was computed or no method could be selected.
    pub(crate) plan: Option<Planned>,
    pub(crate) tolerance: f64,
}

impl Column {
    pub(crate) fn cell(&self, sum: usize, doppler: usize, path: usize) -> &Outcome {
        &self.cells[(sum * DOPPLERS.len() + doppler) * PathModel::ALL.len() + path]
    }

    /// Every cell with the name of its method.
    pub(crate) fn named(&self) -> impl Iterator<Item = (String, &Outcome)> {
        let mut names = Vec::new();
        for sum in SUMS {
            for doppler in DOPPLERS {
                for path in PathModel::ALL {
                    names.push(format!(
                        "{}, {}, {}",
                        sum.name(),
                        path.name(),
                        doppler.name()
                    ));
                }
            }
        }
        names.into_iter().zip(&self.cells)
    }
}

/// Pipelines of one sonar, reused for cases with the same sonar.
pub(crate) struct Bench {
    /// True if the selection also chooses the synthesis. The prediction of engines takes most of the time of a column.
    whole_plans: bool,
    made: HashMap<(&'static str, &'static str), (String, SonarPipeline)>,
    costs: Option<Costs>,
}

impl Bench {
    pub(crate) fn new(whole_plans: bool) -> Self {
        Self {
            whole_plans,
            made: HashMap::new(),
            costs: None,
        }
    }

    /// Measures one column. Call inside one thread pool.
    pub(crate) fn column(&mut self, spot: &Spot) -> Column {
        let tolerance = spot.spec.synthesis.tolerance;
        if let Some(why) = &spot.refused {
            return Column {
                cells: all(&Outcome::Refused(why.clone())),
                plan: None,
                tolerance,
            };
        }
        let mut truth_spec = spot.spec.clone();
        truth_spec.model.synthesis = Synthesis::Reference;
        truth_spec.model.cull_db = None;
        let (plan, scatterers) = spot.truth();
        let truth = match self.run(&truth_spec, spot, &plan, &scatterers) {
            Ok((truth, _)) => truth,
            Err(outcome) => {
                return Column {
                    cells: all(&outcome),
                    plan: None,
                    tolerance,
                };
            }
        };
        let (plan, scatterers) = spot.asked();
        let mut cells = Vec::new();
        let error_models = ErrorModels::of(spot, &plan, &scatterers);
        for synthesis in SUMS {
            for doppler in DOPPLERS {
                for path in PathModel::ALL {
                    cells.push(self.cell(
                        (synthesis, doppler, path),
                        spot,
                        (&plan, &scatterers),
                        &error_models,
                        &truth,
                    ));
                }
            }
        }
        Column {
            cells,
            plan: self.planned(spot, (&plan, &scatterers), &truth),
            tolerance,
        }
    }

    fn cell(
        &mut self,
        (synthesis, doppler, path): (Synthesis, DopplerModel, PathModel),
        spot: &Spot,
        (plan, scatterers): (&PingPlan, &Scatterers),
        error_models: &ErrorModels,
        truth: &PingOutput,
    ) -> Outcome {
        if !synthesis.takes(doppler) {
            return Outcome::NotTaken;
        }
        let mut spec = spot.spec.clone();
        spec.model.synthesis = synthesis;
        spec.model.doppler = doppler;
        spec.model.path = path;
        if let Err(why) = Method::of(&spec).applies(&spec) {
            return Outcome::Refused(why);
        }
        let said = error_models.said(spot, plan, (synthesis, doppler, path));
        match self.run(&spec, spot, plan, scatterers) {
            Err(outcome) => outcome,
            Ok((got, counted)) => {
                let claims = match synthesis.keeps_tolerance() {
                    true => said <= 2.0 * spec.synthesis.tolerance,
                    false => said <= spec.synthesis.tolerance,
                };
                held_against(&spec, &got, truth, (said, claims), counted)
            }
        }
    }

    fn planned(
        &mut self,
        spot: &Spot,
        (plan, scatterers): (&PingPlan, &Scatterers),
        truth: &PingOutput,
    ) -> Option<Planned> {
        let mut spec = spot.spec.clone();
        spec.synthesis.auto = AutoModel {
            path: true,
            segment: true,
            doppler: true,
            synthesis: self.whole_plans,
        };
        spec.synthesis.culls_by_window &= self.whole_plans;
        let scene = Scene {
            spec: &spec,
            medium: &spot.rig().medium,
            plan,
            scatterers,
            count: scatterers.len(),
            costs: self.costs.get_or_insert_with(Costs::committed),
            motion_scale: MotionScale::NONE,
        };
        let ranking = catch_unwind(AssertUnwindSafe(|| rank(&scene, &[])));
        let ranking = match ranking {
            Ok(ranking) => ranking?,
            Err(panic) => {
                return Some(Planned {
                    path: PathModel::StopAndHop,
                    doppler: DopplerModel::None,
                    synthesis: Synthesis::Direct,
                    text: "the plan itself panicked".into(),
                    out_of_reach: false,
                    outcome: Outcome::Panic(words(panic)),
                });
            }
        };
        let chosen = ranking.chosen();
        let fixed = with_choice(&spot.spec, &chosen.choice);
        let mut under = plan.clone();
        under.model = fixed.model;
        let window_s = plan.window_s(spot.rate_hz());
        echotank_ping::polyline(
            &plan.trajectory,
            window_s,
            fixed.model.segment_s,
            &mut under.segments,
        );
        let outcome = match self.run(&fixed, spot, &under, scatterers) {
            Err(outcome) => outcome,
            Ok((got, counted)) => {
                let claims = ranking.is_within();
                held_against(&fixed, &got, truth, (chosen.error(), claims), counted)
            }
        };
        let model = chosen.choice.model;
        Some(Planned {
            path: model.path,
            doppler: model.doppler,
            synthesis: model.synthesis,
            text: chosen.text(),
            out_of_reach: !ranking.is_within(),
            outcome,
        })
    }

    /// The ping and the number of echoes outside the limits of its method, or the reason why no ping was computed.
    fn run(
        &mut self,
        spec: &SonarSpec,
        spot: &Spot,
        plan: &PingPlan,
        scatterers: &Scatterers,
    ) -> Result<(PingOutput, u64), Outcome> {
        let mut plan = plan.clone();
        plan.model = spec.model;
        let key = (spec.model.synthesis.name(), spec.model.doppler.name());
        // Path, segments and floor are parameters of the ping. The other parameters belong to the pipeline.
        let mut common = spec.clone();
        common.model.path = PathModel::KSegment;
        common.model.cull_db = None;
        common.model.segment_s = 0.01;
        if spec.model.synthesis != Synthesis::Spectral {
            common.synthesis.frequency_step_hz = None;
        }
        let about = format!("{common:?}");
        let fresh = self.made.get(&key).is_none_or(|(made, _)| *made != about);
        let medium = &spot.rig().medium;
        let done = catch_unwind(AssertUnwindSafe(|| {
            if fresh {
                let pipeline =
                    SonarPipeline::new(&common, medium).map_err(|why| why.to_string())?;
                self.made.insert(key, (about, pipeline));
            }
            let (_, pipeline) = self.made.get_mut(&key).expect("made above");
            let mut output = pipeline.blank_output();
            pipeline.compute_ping(&plan, scatterers, &mut output);
            Ok(output)
        }));
        match done {
            Ok(Ok(output)) => {
                let counts = output.counts;
                Ok((
                    output,
                    counts.beyond_engine + counts.too_close + counts.no_root + counts.two_roots,
                ))
            }
            Ok(Err(why)) => Err(Outcome::Refused(why)),
            Err(panic) => {
                self.made.remove(&key);
                Err(Outcome::Panic(words(panic)))
            }
        }
    }
}

/// Measures every method.
fn all(outcome: &Outcome) -> Vec<Outcome> {
    let mut cells = Vec::new();
    for sum in SUMS {
        for doppler in DOPPLERS {
            let of = match sum.takes(doppler) {
                true => outcome,
                false => &Outcome::NotTaken,
            };
            cells.extend(PathModel::ALL.map(|_| of.clone()));
        }
    }
    cells
}

fn words(panic: Box<dyn std::any::Any + Send>) -> String {
    let text = panic.downcast_ref::<String>().cloned();
    text.or_else(|| panic.downcast_ref::<&str>().map(|s| (*s).to_owned()))
        .unwrap_or_else(|| "no words".into())
}

/// Error models of the stages for a case.
struct ErrorModels {
    conditions: Conditions,
    culling: f64,
}

impl ErrorModels {
    fn of(spot: &Spot, plan: &PingPlan, scatterers: &Scatterers) -> Self {
        let conditions = conditions(&spot.spec, plan, scatterers);
        // Error of pattern culling, as the selection predicts it for a sonar with fixed methods.
        let culling = match spot.spec.model.cull_db {
            None => 0.0,
            Some(_) => {
                let costs = Costs::committed();
                let scene = Scene {
                    spec: &spot.spec,
                    medium: &spot.rig().medium,
                    plan,
                    scatterers,
                    count: scatterers.len(),
                    costs: &costs,
                    motion_scale: MotionScale::NONE,
                };
                rank(&scene, &[]).map_or(0.0, |ranking| {
                    ranking
                        .chosen()
                        .part(echotank_ping::methods::Family::Culling)
                        .error
                })
            }
        };
        Self {
            conditions,
            culling,
        }
    }

    fn said(
        &self,
        spot: &Spot,
        plan: &PingPlan,
        (synthesis, doppler, path): (Synthesis, DopplerModel, PathModel),
    ) -> f64 {
        let mut conditions = self.conditions;
        conditions.tolerance = spot.spec.synthesis.tolerance;
        path_error_model(path, &conditions).error
            + doppler_error_model(doppler, path, &conditions).error
            + self.culling
            + match synthesis.keeps_tolerance() {
                // The engine is designed for the tolerance and does not exceed it on its own.
                true => conditions.tolerance,
                false => sum_error_model(synthesis, &spot.spec, plan, &conditions).error,
            }
    }
}

fn held_against(
    spec: &SonarSpec,
    got: &PingOutput,
    truth: &PingOutput,
    (said, claims): (f64, bool),
    counted: u64,
) -> Outcome {
    let mut silent = true;
    for frame in got.elements.iter().chain(&truth.elements) {
        if !frame.iq.iter().all(|x| x.is_finite()) {
            return Outcome::NoNumber;
        }
        silent &= frame.iq.iter().all(|x| x.norm_sqr() == 0.0);
    }
    if silent {
        return Outcome::Silence;
    }
    Outcome::Answer {
        error: worst_window(
            got,
            truth,
            spec.pulse.duration_s,
            spec.receiver.sample_rate_hz,
        ),
        said,
        claims,
        counted,
    }
}
