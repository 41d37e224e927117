//! Selects models and a synthesis method for a tolerance by their error models, or refuses.

use std::sync::Mutex;

use echotank_core::model::{DopplerModel, PathModel, Synthesis};
use echotank_core::ping::PingPlan;
use echotank_core::pulse::FLOOR_BELOW_STRONGEST_DB;
use echotank_core::simd::SimdLevel;
use echotank_synthesis::array::gridded::{DopplerSpan, Gridded1d, one_dimensional};
use echotank_synthesis::array::gridded2d::{self, Gridded2d};
use echotank_synthesis::array::{Decimator, Direct};
use echotank_synthesis::arrivals::{ArrivalChunk, ArrivalSink};
use echotank_synthesis::comparison::linear::Linear;
use echotank_synthesis::comparison::nearest::Nearest;
use echotank_synthesis::comparison::replica::Replica;
use echotank_synthesis::comparison::spectral::Bins;
use echotank_synthesis::comparison::spectral::Spectral;
use echotank_synthesis::comparison::spectral::Spectrum;
use echotank_synthesis::echo::error_models::window_error_models;
use echotank_synthesis::echo::{LineEchoes, LineWorkspace, TransmitLeg, Window, insonify};
use echotank_synthesis::error_model::ErrorModel;
use echotank_testing::echo as rig;
use num_complex::Complex64;

use super::case::Case;
use super::measure::{Truth, filter};
use crate::bench::scene::ArrivalCollector;
use crate::reference::received;

/// Minimum number of elements for which a line engine is designed.
const MIN_LINE: usize = 8;

/// Synthesis method with the models that it supports.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Method(pub(crate) Synthesis);

/// Selected models and synthesis.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Chosen {
    pub(crate) path: PathModel,
    pub(crate) doppler: DopplerModel,
    /// Tolerance of the synthesis; infinite if it has none.
    pub(crate) tolerance: f64,
    /// Sum of the error models.
    pub(crate) predicted: f64,
    pub(crate) why: String,
}

/// Engine of a case, for methods with an engine.
pub(crate) enum Ready {
    Sum,
    Elements(Box<Gridded>),
    Line(Box<Gridded2d>),
}

impl Chosen {
    pub(crate) fn text(&self) -> String {
        format!(
            "{}, {}; {}",
            self.path.name(),
            self.doppler.name(),
            self.why
        )
    }
}

/// Reason why a method cannot meet a tolerance, with its own message.
#[derive(Clone, Debug)]
pub(crate) struct Refused {
    pub(crate) by: Reason,
    pub(crate) message: String,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Reason {
    /// No supported path and Doppler model is accurate enough.
    Model,
    /// The synthesis is not accurate enough.
    Sum,
}

impl Method {
    pub(crate) const ALL: [Self; 6] = [
        Self(Synthesis::Direct),
        Self(Synthesis::Spectral),
        Self(Synthesis::Nearest),
        Self(Synthesis::Linear),
        Self(Synthesis::Gridded1d),
        Self(Synthesis::Gridded2d),
    ];

    /// Methods applicable to this many elements.
    pub(crate) fn of(case: &Case) -> impl Iterator<Item = Self> {
        let line = case.rx.elements >= MIN_LINE;
        Self::ALL
            .into_iter()
            .filter(move |&m| line || m.0 != Synthesis::Gridded2d)
    }

    pub(crate) fn name(self) -> &'static str {
        self.0.name()
    }

    /// Supported Doppler models, from cheap to expensive.
    fn dopplers(self) -> Vec<DopplerModel> {
        [
            DopplerModel::None,
            DopplerModel::Stretch,
            DopplerModel::StretchQuadratic,
        ]
        .into_iter()
        .filter(|&d| self.0.takes(d))
        .collect()
    }

    /// The cheapest models whose remaining error lets the synthesis meet `tolerance`.
    pub(crate) fn within(
        self,
        tolerance: f64,
        case: &Case,
        truth: &Truth,
    ) -> Result<(Chosen, Ready), Refused> {
        let mut refused = None;
        for path in [
            PathModel::Polyline,
            PathModel::KSegment,
            PathModel::Continuous,
        ] {
            for doppler in self.dopplers() {
                let model_error = case.model_error(path, doppler);
                let rest = tolerance - model_error;
                if rest <= 0.0 {
                    refused = Some(model_refusal(tolerance, case, path, doppler));
                    continue;
                }
                match self.ready(rest, case, truth, path, doppler) {
                    Ok((error_model, ready)) => {
                        let chosen = Chosen {
                            path,
                            doppler,
                            tolerance: if self.0.keeps_tolerance() {
                                rest
                            } else {
                                f64::INFINITY
                            },
                            predicted: model_error + error_model.error,
                            why: error_model.why,
                        };
                        return Ok((chosen, ready));
                    }
                    Err(message) => {
                        refused = Some(Refused {
                            by: Reason::Sum,
                            message,
                        });
                    }
                }
            }
        }
        Err(refused.expect("every method has a model"))
    }

    /// The most accurate supported models without a tolerance. A synthesis with a tolerance is designed for 1e-3. `None` if the
    /// synthesis refuses even 1e-3.
    pub(crate) fn as_it_is(self, case: &Case, truth: &Truth) -> Option<(Chosen, Ready)> {
        let path = PathModel::Continuous;
        let doppler = self.dopplers().last().copied()?;
        let tolerance = if self.0.keeps_tolerance() {
            1e-3
        } else {
            f64::INFINITY
        };
        let (error_model, ready) = self.ready(tolerance, case, truth, path, doppler).ok()?;
        let chosen = Chosen {
            path,
            doppler,
            tolerance,
            predicted: f64::INFINITY,
            why: error_model.why,
        };
        Some((chosen, ready))
    }

    /// The synthesis with its error model, if within `tolerance`.
    fn ready(
        self,
        tolerance: f64,
        case: &Case,
        truth: &Truth,
        path: PathModel,
        doppler: DopplerModel,
    ) -> Result<(ErrorModel, Ready), String> {
        let plan = case.with_models(path, doppler);
        match self.0 {
            Synthesis::Gridded1d => {
                let gridded = gridded_1d(tolerance, case, &plan, truth)?;
                return Ok((
                    gridded.engine.error_model().clone(),
                    Ready::Elements(Box::new(gridded)),
                ));
            }
            Synthesis::Gridded2d => {
                let engine = gridded_2d(tolerance, case, &plan, truth)?;
                return Ok((engine.error_model().clone(), Ready::Line(Box::new(engine))));
            }
            _ => {}
        }
        let error_model = truth.error_model(self.0, case);
        let error_model = error_model.within(tolerance).map_err(|e| e.to_string())?;
        Ok((error_model, Ready::Sum))
    }

    /// Samples of the compared elements.
    pub(crate) fn records(self, case: &Case, chosen: &Chosen, ready: Ready) -> Vec<Vec<Complex64>> {
        let plan = case.with_models(chosen.path, chosen.doppler);
        match (self.0, ready) {
            (_, Ready::Elements(gridded)) => gridded.records(case, &plan),
            (_, Ready::Line(engine)) => line_records(*engine, case, &plan),
            (Synthesis::Spectral, _) => spectral(case, &plan),
            (Synthesis::Nearest, _) => replicas(case, &plan, false),
            (Synthesis::Linear, _) => replicas(case, &plan, true),
            (_, Ready::Sum) => direct(case, &plan),
        }
    }
}

fn model_refusal(tolerance: f64, case: &Case, path: PathModel, doppler: DopplerModel) -> Refused {
    let [path_error_model, doppler_error_model] =
        window_error_models(path, doppler, &case.conditions);
    let worse = if path_error_model.error > doppler_error_model.error {
        path_error_model
    } else {
        doppler_error_model
    };
    // Each has half of the tolerance if neither needs more.
    let refusal = worse.clone().within(tolerance).err();
    let refusal = refusal.or_else(|| worse.within(0.5 * tolerance).err());
    Refused {
        by: Reason::Model,
        message: refusal.map_or_else(String::new, |r| r.to_string()),
    }
}

/// Grid on which a sum through `filter` is evaluated: rate, first instant, number of samples.
fn grid(case: &Case, filter: Option<&Decimator>) -> (f64, f64, usize) {
    let plan = &case.plan;
    match filter {
        None => (case.rate_hz, plan.first_sample_s, plan.sample_count),
        Some(filter) => (
            filter.dense_rate_hz(),
            filter.dense_first_s(plan.first_sample_s),
            filter.dense_len(plan.sample_count),
        ),
    }
}

/// Passes the arrivals of one element in the window of `grid` to `sink`.
fn walk(
    case: &Case,
    plan: &PingPlan,
    element: usize,
    (rate_hz, first_s, count): (f64, f64, usize),
    sink: &mut impl ArrivalSink,
) {
    let window = Window::of_samples(first_s, rate_hz, count);
    rig::walk(
        plan,
        &case.tx,
        &case.rx,
        element,
        window,
        &case.scatterers,
        sink,
    );
}

fn each(case: &Case, mut record: impl FnMut(usize, &mut [Complex64])) -> Vec<Vec<Complex64>> {
    let all = case.looked_at.iter().map(|&element| {
        let mut out = vec![Complex64::ZERO; case.plan.sample_count];
        record(element, &mut out);
        out
    });
    all.collect()
}

fn direct(case: &Case, plan: &PingPlan) -> Vec<Vec<Complex64>> {
    direct_with(case, plan, filter(case, Synthesis::Direct).as_ref())
}

pub(crate) fn direct_with(
    case: &Case,
    plan: &PingPlan,
    filter: Option<&Decimator>,
) -> Vec<Vec<Complex64>> {
    let of_window = (case.rate_hz, plan.first_sample_s);
    each(case, |element, out| {
        received(filter, of_window, out, |ends, rate_hz, first_s, out| {
            let grid = (rate_hz, first_s, out.len());
            let mut sink = Direct::new(plan, rate_hz, first_s, out).with_ends(ends);
            walk(case, plan, element, grid, &mut sink);
        });
    })
}

fn spectral(case: &Case, plan: &PingPlan) -> Vec<Vec<Complex64>> {
    let filter = filter(case, Synthesis::Spectral);
    let tails_s = filter.as_ref().map_or(0.0, |f| -2.0 * f.dense_first_s(0.0));
    let record_s = plan.sample_count as f64 / case.rate_hz + plan.pulse.duration_s + tails_s;
    let mut spectrum = Spectrum::new(case.rate_hz, record_s, None, filter.as_ref());
    spectrum.prepare(plan);
    let mut bins = Bins::default();
    each(case, |element, out| {
        let mut sink = Spectral::new(plan, &spectrum, plan.first_sample_s, &mut bins);
        walk(case, plan, element, grid(case, filter.as_ref()), &mut sink);
        sink.finish(out);
    })
}

fn replicas(case: &Case, plan: &PingPlan, linear: bool) -> Vec<Vec<Complex64>> {
    let filter = filter(case, Synthesis::Nearest);
    let mut replica = Replica::default();
    replica.prepare(plan, case.rate_hz, filter.as_ref());
    let (rate_hz, first_s) = (case.rate_hz, plan.first_sample_s);
    each(case, |element, out| {
        let grid = grid(case, filter.as_ref());
        if linear {
            let mut sink = Linear::new(plan, &replica, rate_hz, first_s, out);
            walk(case, plan, element, grid, &mut sink);
        } else {
            let mut sink = Nearest::new(plan, &replica, rate_hz, first_s, out);
            walk(case, plan, element, grid, &mut sink);
        }
    })
}

pub(crate) struct Gridded {
    engine: Gridded1d,
    heard: Vec<Vec<ArrivalChunk>>,
    span: DopplerSpan,
}

fn gridded_1d(
    tolerance: f64,
    case: &Case,
    plan: &PingPlan,
    truth: &Truth,
) -> Result<Gridded, String> {
    let filter = truth.filter.as_ref();
    let heard: Vec<Vec<ArrivalChunk>> = case
        .looked_at
        .iter()
        .map(|&element| {
            let mut kept = ArrivalCollector::default();
            walk(case, plan, element, grid(case, filter), &mut kept);
            kept.0
        })
        .collect();
    let all = heard.iter().flatten().flat_map(|c| &c.doppler[..c.len]);
    let (least, greatest) = all.fold((0.0f64, 0.0f64), |(a, b), &d| (a.min(d), b.max(d)));
    let span = DopplerSpan { least, greatest };
    let bends = heard
        .iter()
        .flatten()
        .flat_map(|c| &c.curvature_per_s[..c.len]);
    let curvature_per_s = bends.fold(0.0f64, |most, q| most.max(q.abs()));
    let engine = Gridded1d::new(&one_dimensional::Spec {
        pulse: &plan.pulse,
        sample_rate_hz: case.rate_hz,
        samples: plan.sample_count,
        filter,
        doppler: plan.model.doppler,
        span,
        curvature_per_s,
        tolerance,
        level_range_db: FLOOR_BELOW_STRONGEST_DB,
        arrivals: case.scatterers.len(),
        simd_level: SimdLevel::best(),
    })
    .map_err(|e| e.to_string())?;
    Ok(Gridded {
        engine,
        heard,
        span,
    })
}

impl Gridded {
    fn records(&self, case: &Case, plan: &PingPlan) -> Vec<Vec<Complex64>> {
        let mut work = self.engine.work();
        let mut heard = self.heard.iter();
        each(case, |_, out| {
            let chunks = heard.next().expect("one per element looked at");
            work.start(plan.first_sample_s, self.span);
            chunks.iter().for_each(|chunk| work.accept(chunk));
            let misfits = work.finish(out);
            assert_eq!(misfits.outside_span, 0, "{}", case.scene);
        })
    }
}

/// Line engine. Create and use it inside the same thread pool.
fn gridded_2d(
    tolerance: f64,
    case: &Case,
    plan: &PingPlan,
    truth: &Truth,
) -> Result<Gridded2d, String> {
    Gridded2d::new(&gridded2d::Spec {
        array: &case.rx,
        pulse: &plan.pulse,
        sound_speed_m_per_s: plan.sound_speed_m_per_s,
        sample_rate_hz: case.rate_hz,
        filter: truth.filter.as_ref(),
        model: &plan.model,
        bounds: case.bounds(),
        tolerance,
        level_range_db: FLOOR_BELOW_STRONGEST_DB,
        samples: plan.sample_count,
        scatterers: case.scatterers.len(),
        simd_level: SimdLevel::best(),
    })
    .map_err(|e| e.to_string())
}

fn line_records(mut engine: Gridded2d, case: &Case, plan: &PingPlan) -> Vec<Vec<Complex64>> {
    let mut transmit_leg = TransmitLeg::new();
    let window = Window::of_samples(0.0, case.rate_hz, usize::MAX);
    insonify(plan, &case.tx, window, &case.scatterers, &mut transmit_leg);
    let work: Vec<_> = (0..rayon::current_num_threads())
        .map(|_| Mutex::new(LineWorkspace::default()))
        .collect();
    let echoes = LineEchoes {
        plan,
        array: &case.rx,
        transmit_leg: &transmit_leg,
        work: &work,
    };
    let mut iq = vec![Complex64::ZERO; case.rx.elements * plan.sample_count];
    engine.synthesise(plan, &echoes, &mut iq);
    case.looked_at
        .iter()
        .map(|&e| iq[e * plan.sample_count..][..plan.sample_count].to_vec())
        .collect()
}
