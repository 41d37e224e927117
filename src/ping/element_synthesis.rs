//! Element samples of one pulse: the transmit leg of every scatterer, then the sum of the echoes at every element, by one engine.
//!
//! The sonar's own pulse and every further pulse of a ping have one [`ElementSynthesis`] each.

use std::sync::{Mutex, MutexGuard, PoisonError};

use echotank_config::spec::{MediumSpec, SonarSpec};
use echotank_core::arrays::ReceiverFilter;
use echotank_core::model::Synthesis;
use echotank_core::ping::{EchoCounts, PingPlan};
use echotank_core::pulse::Pulse;
use echotank_core::scene::Scatterers;
use echotank_core::settings::SonarSettings;
use echotank_synthesis::array::direct::Direct;
use echotank_synthesis::array::filter::{self, Decimator, FilterDesign, FilterError, grid_ahead};
use echotank_synthesis::array::gridded::DopplerSpan;
use echotank_synthesis::array::gridded2d::Refusal;
use echotank_synthesis::array::instrument::InstrumentError;
use echotank_synthesis::comparison::Comparison;
use echotank_synthesis::comparison::spectral::Bins;
use echotank_synthesis::echo::moving::MovingEchoes;
use echotank_synthesis::echo::reference;
use echotank_synthesis::echo::span::doppler_span;
use echotank_synthesis::echo::walk::{TransmitLeg, Window, Workspace, arrivals, insonify};
use echotank_synthesis::error_model::ErrorModel;
use echotank_synthesis::slabs::{PingElement, SlabEngine};
use num_complex::Complex64;
use rayon::prelude::*;
use thiserror::Error;

use crate::engines::{EngineRefusal, Engines, MIN_DENSITY};
use crate::line_engines::LineEngines;
use crate::plan;

/// A sonar that cannot be computed as it is configured.
#[derive(Debug, Error)]
pub enum PipelineError {
    /// The receiver filter cannot be designed.
    #[error("receiver filter: {0}")]
    Filter(#[from] FilterError),
    /// A gridded engine cannot reach its tolerance.
    #[error("sonar.model.tolerance = {tolerance:e}: {why}")]
    Engine {
        /// Relative error.
        tolerance: f64,
        /// The limit in the way.
        why: EngineRefusal,
    },
    /// `gridded-2d` cannot be used for this sonar.
    #[error("sonar.model.synthesis = \"gridded-2d\": {0}")]
    LineEngine(#[from] Refusal),
    /// `gridded-lines` cannot be used for this sonar.
    #[error("sonar.model.synthesis = \"gridded-lines\": {0}")]
    Lines(EngineRefusal),
    /// The imperfections of the sonar cannot be computed.
    #[error("{0}")]
    Instrument(#[from] InstrumentError),
}

/// The receiver filter leaves room for the Doppler of a platform as fast as this, m/s.
pub const FASTEST_PLATFORM_M_PER_S: f64 = 10.0;

/// The buffers of one thread while it computes one element.
#[derive(Default)]
pub(crate) struct ElementScratch {
    pub(crate) walk: Workspace,
    /// The element's signal ahead of the receiver filter's decimation.
    dense: Vec<Complex64>,
    /// The element's spectrum, for the sum over frequencies.
    bins: Bins,
    /// The samples of a further pulse, or of an element ahead of its imperfections.
    pub(crate) own: Vec<Complex64>,
    /// Those of moving scatterers.
    moving: Vec<Complex64>,
}

impl ElementScratch {
    /// `segments`: of the longest polyline. `dense`: samples ahead of the filter of the longest record. `own`: those of a further pulse, or of an
    /// element ahead of its imperfections.
    pub(crate) fn with_room_for(segments: usize, dense: usize, own: usize) -> Self {
        Self {
            walk: Workspace::with_room_for(segments),
            dense: Vec::with_capacity(dense),
            bins: Bins::default(),
            own: Vec::with_capacity(own),
            moving: Vec::new(),
        }
    }
}

/// Locks the scratch of the current thread. One per thread of the pool: no lock ever waits.
pub(crate) fn of_this_thread(scratch: &[Mutex<ElementScratch>]) -> MutexGuard<'_, ElementScratch> {
    let thread = rayon::current_thread_index().unwrap_or(0);
    // A panic in another ping leaves the scratch as good as any: every use overwrites it.
    scratch[thread]
        .lock()
        .unwrap_or_else(PoisonError::into_inner)
}

/// How the echoes are summed.
enum Engine {
    /// Every sample's travel time solved on the continuous motion, f64.
    Reference,
    /// Linearised echoes, sample by sample.
    Direct,
    /// Within a tolerance. `gridded-1d`: each element on a grid, slab by slab. `gridded-lines`: 16 elements of a line array at a time.
    Gridded {
        engines: Engines,
        /// Dopplers of this ping, one span per receive array.
        spans: Vec<DopplerSpan>,
        /// The engine of this ping could be made; if not, the direct sum takes its place.
        ready: bool,
    },
    /// `gridded-2d`: all elements of a line array at once, within a tolerance.
    WholeLines(LineEngines),
    /// A method that is kept to be compared with.
    Comparison(Comparison),
}

/// Everything that sums the echoes of one pulse at the elements of one sonar.
pub(crate) struct ElementSynthesis {
    /// The sonar with this pulse, and the transmit array that sends it.
    pub(crate) spec: SonarSpec,
    engine: Engine,
    /// One per transmit array.
    transmit_legs: Vec<TransmitLeg>,
    /// The receiver filter; without one the sum is sampled at the sample instants.
    decimator: Option<Decimator>,
    /// Echoes of what moves, whatever the engine.
    moving: MovingEchoes,
}

impl ElementSynthesis {
    /// Sizes every buffer for the largest ping within the sonar's limits. To be made inside the pool that will run it. `record_s`: longest record
    /// with the pulse, seconds.
    pub(crate) fn new(
        spec: &SonarSpec,
        medium: &MediumSpec,
        decimator: Option<&Decimator>,
        record_s: f64,
    ) -> Result<Self, PipelineError> {
        let engine = match spec.model.synthesis {
            Synthesis::Reference => Engine::Reference,
            Synthesis::Direct => Engine::Direct,
            Synthesis::Gridded1d | Synthesis::GriddedLines => {
                Engine::gridded(spec, medium, decimator)?
            }
            Synthesis::Gridded2d => Engine::WholeLines(line_engines(spec, medium, decimator)?),
            Synthesis::Spectral | Synthesis::Nearest | Synthesis::Linear => {
                Engine::comparison(spec, decimator, record_s)
            }
        };
        Ok(Self::with_engine(spec, decimator, engine))
    }

    /// The same for a pulse that is in the water together with the sonar's own: by the engine for single elements where the sonar uses that,
    /// by the reference where it uses that, by the direct sum elsewhere.
    pub(crate) fn of_further_pulse(
        spec: &SonarSpec,
        medium: &MediumSpec,
        decimator: Option<&Decimator>,
    ) -> Result<Self, PipelineError> {
        let engine = match spec.model.synthesis {
            Synthesis::Reference => Engine::Reference,
            Synthesis::Gridded1d => Engine::gridded(spec, medium, decimator)?,
            _ => Engine::Direct,
        };
        Ok(Self::with_engine(spec, decimator, engine))
    }

    fn with_engine(spec: &SonarSpec, decimator: Option<&Decimator>, engine: Engine) -> Self {
        let legs = spec.transmit.iter().map(|_| TransmitLeg::default());
        Self {
            engine,
            transmit_legs: legs.collect(),
            decimator: decimator.cloned(),
            spec: spec.clone(),
            moving: MovingEchoes::default(),
        }
    }

    /// Room that the direct sums need ahead of the receiver filter for a record of `samples`, samples.
    pub(crate) fn dense_len(&self, samples: usize) -> usize {
        match (&self.decimator, &self.engine) {
            (Some(d), Engine::Reference | Engine::Direct) => d.dense_len(samples),
            _ => 0,
        }
    }

    /// Begins to make the engine for settings that are about to be used. Returns at once.
    pub(crate) fn expect(&mut self, settings: &SonarSettings) {
        if let Engine::Gridded { engines, .. } = &mut self.engine {
            engines.expect(settings);
        }
    }

    /// The transmit leg of every scatterer, once per transmit array, and the tables that all elements share. The reference walks the
    /// scatterers itself.
    pub(crate) fn insonify(
        &mut self,
        plan: &PingPlan,
        scatterers: &Scatterers,
        walk: &mut Workspace,
    ) -> EchoCounts {
        let mut counts = EchoCounts::default();
        match &mut self.engine {
            Engine::Reference => return counts,
            Engine::Comparison(method) => {
                let rate_hz = self.spec.receiver.sample_rate_hz;
                method.prepare(plan, rate_hz, self.decimator.as_ref());
            }
            Engine::Direct | Engine::Gridded { .. } | Engine::WholeLines(_) => {}
        }
        let window = self.window(plan);
        for (transmit, leg) in self.spec.transmit.iter().zip(&mut self.transmit_legs) {
            counts += insonify(plan, transmit, window, scatterers, leg);
        }
        if let Engine::Gridded {
            engines,
            spans,
            ready,
        } = &mut self.engine
        {
            *ready = engines.ready(plan);
            let widest = engines.span();
            for (index, (span, array)) in spans.iter_mut().zip(&self.spec.receive).enumerate() {
                if engines.makes_line(index) {
                    continue;
                }
                let leg = &self.transmit_legs[array.transmit];
                let (least, greatest) = doppler_span(plan, array, leg, walk);
                *span = DopplerSpan {
                    least: least.clamp(widest.least, widest.greatest),
                    greatest: greatest.clamp(widest.least, widest.greatest),
                };
            }
        }
        counts
    }

    /// Solves the echoes of moving scatterers. The pulse starts `late_s` after the ping.
    pub(crate) fn insonify_moving(
        &mut self,
        plan: &PingPlan,
        scatterers: &Scatterers,
        late_s: f64,
    ) {
        let SonarSpec {
            transmit, receive, ..
        } = &self.spec;
        let moving = &scatterers.moving;
        self.moving.prepare(plan, transmit, receive, moving, late_s);
    }

    /// Whether this ping has echoes of moving scatterers.
    pub(crate) fn has_moving(&self) -> bool {
        !self.moving.is_empty()
    }

    /// Adds the echoes of moving scatterers at one element to `iq`, behind the receiver filter.
    pub(crate) fn add_moving(
        &self,
        plan: &PingPlan,
        index: usize,
        element: usize,
        scratch: &mut ElementScratch,
        iq: &mut [Complex64],
    ) -> EchoCounts {
        let Some((from_s, to_s)) = self.moving.span_s(index) else {
            return EchoCounts::default();
        };
        let rate_hz = self.spec.receiver.sample_rate_hz;
        let filter = self.decimator.as_ref();
        let tail_s = filter.map_or(0.0, Decimator::response_half_s);
        let at = |time_s: f64| (time_s - plan.first_sample_s) * rate_hz;
        // Conversions saturate: what lies before the record is 0.
        let first = at(from_s - tail_s).floor() as usize;
        let end = (at(to_s + tail_s).ceil() as usize)
            .saturating_add(1)
            .min(iq.len());
        if first >= end {
            return EchoCounts::default();
        }
        let iq = &mut iq[first..end];
        let first_s = plan.first_sample_s + first as f64 / rate_hz;
        let (ahead_s, dense_hz, len) = grid_ahead(filter, first_s, rate_hz, iq.len());
        let ElementScratch { dense, moving, .. } = scratch;
        dense.clear();
        dense.resize(len, Complex64::ZERO);
        let ends = filter.map(Decimator::ends);
        let mut sink = Direct::new(plan, dense_hz, ahead_s, dense).with_ends(ends);
        let array = &self.spec.receive[index];
        let counts = self
            .moving
            .arrivals(plan, (index, array), element, &mut sink);
        let made = match filter {
            Some(filter) => {
                moving.resize(iq.len(), Complex64::ZERO);
                filter.apply(dense, moving);
                &*moving
            }
            None => &*dense,
        };
        for (sum, echo) in iq.iter_mut().zip(made) {
            *sum += echo;
        }
        counts
    }

    /// Keeps only what arrives within the plan's window: for a ping cut short.
    pub(crate) fn limit_to_window(&mut self, plan: &PingPlan) {
        let window = self.window(plan);
        for leg in &mut self.transmit_legs {
            leg.set_window(window);
        }
    }

    fn window(&self, plan: &PingPlan) -> Window {
        let (first_s, rate_hz, len) = self.grid(plan);
        Window::of_samples(first_s, rate_hz, len)
    }

    /// Where the sum is evaluated, ahead of the receiver filter: first instant, seconds; rate, hertz; samples.
    pub(crate) fn grid(&self, plan: &PingPlan) -> (f64, f64, usize) {
        let rate_hz = self.spec.receiver.sample_rate_hz;
        let (first_s, count) = (plan.first_sample_s, plan.sample_count);
        grid_ahead(self.decimator.as_ref(), first_s, rate_hz, count)
    }

    /// Overwrites `iq` with the samples of all elements of receive array `index`, element-major, where the engine makes a whole array at a time;
    /// none where it makes single elements, see [`Self::element`]. `together`: elements that one thread makes, at least.
    ///
    /// Where an echo is beyond what the engine is designed for, the direct sum makes the array again.
    pub(crate) fn array(
        &mut self,
        plan: &PingPlan,
        index: usize,
        together: usize,
        scratch: &[Mutex<ElementScratch>],
        iq: &mut [Complex64],
    ) -> Option<EchoCounts> {
        let counts = self.whole_array(plan, index, together, scratch, iq)?;
        if counts.beyond_engine == 0 {
            return Some(counts);
        }
        let elements = iq.par_chunks_mut(plan.sample_count).with_min_len(together);
        let made = elements.enumerate().map(|(element, iq)| {
            let ElementScratch { walk, dense, .. } = &mut *of_this_thread(scratch);
            self.direct(plan, index, element, walk, dense, iq)
        });
        Some(EchoCounts {
            beyond_engine: counts.beyond_engine,
            ..made.reduce(EchoCounts::default, sum)
        })
    }

    fn whole_array(
        &mut self,
        plan: &PingPlan,
        index: usize,
        together: usize,
        scratch: &[Mutex<ElementScratch>],
        iq: &mut [Complex64],
    ) -> Option<EchoCounts> {
        let array = &self.spec.receive[index];
        let leg = &self.transmit_legs[array.transmit];
        match &mut self.engine {
            Engine::WholeLines(engines) => {
                Some(engines.synthesise(plan, &self.spec, index, leg, iq))
            }
            Engine::Gridded {
                engines,
                spans,
                ready: true,
            } => {
                let made = engines.current_mut();
                if let Some(line) = made.line(index) {
                    return Some(line.synthesise(plan, leg, iq));
                }
                let (made, span) = (made.elements()?, spans[index]);
                let elements = iq.par_chunks_mut(plan.sample_count);
                let of_each = elements
                    .with_min_len(together)
                    .enumerate()
                    .map(|(element, iq)| {
                        let target = PingElement {
                            plan,
                            array,
                            element,
                            transmit_leg: leg,
                            span,
                        };
                        let slabs = iq.par_chunks_mut(made.slab_samples());
                        let of_each = slabs.with_min_len(together).enumerate();
                        let of_each = of_each.map(|(slab, out)| {
                            let walk = &mut of_this_thread(scratch).walk;
                            made.synthesise_slab(target, slab, walk, out)
                        });
                        of_each.reduce(EchoCounts::default, sum)
                    });
                Some(of_each.reduce(EchoCounts::default, sum))
            }
            _ => None,
        }
    }

    /// Overwrites `iq` with the samples of one element, behind the receiver filter.
    pub(crate) fn element(
        &self,
        plan: &PingPlan,
        scatterers: &Scatterers,
        index: usize,
        element: usize,
        scratch: &mut ElementScratch,
        iq: &mut [Complex64],
    ) -> EchoCounts {
        let array = &self.spec.receive[index];
        let leg = &self.transmit_legs[array.transmit];
        let ElementScratch {
            walk, dense, bins, ..
        } = scratch;
        if let Engine::Gridded {
            engines,
            spans,
            ready: true,
        } = &self.engine
            && let Some(made) = engines.current().elements()
        {
            let target = PingElement {
                plan,
                array,
                element,
                transmit_leg: leg,
                span: spans[index],
            };
            let counts = slab_by_slab(made, target, walk, iq);
            if counts.beyond_engine == 0 {
                return counts;
            }
            return EchoCounts {
                beyond_engine: counts.beyond_engine,
                ..self.direct(plan, index, element, walk, dense, iq)
            };
        }
        match &self.engine {
            Engine::Reference => {
                let transmit = &self.spec.transmit[array.transmit];
                let filter = self.decimator.as_ref();
                let rate_hz = self.spec.receiver.sample_rate_hz;
                let first_s = plan.first_sample_s;
                reference(
                    plan, transmit, array, element, scatterers, filter, rate_hz, first_s, iq,
                )
            }
            Engine::Comparison(method) => {
                let rate_hz = self.spec.receiver.sample_rate_hz;
                method.element(plan, rate_hz, array, element, leg, walk, bins, iq)
            }
            Engine::Direct | Engine::Gridded { .. } | Engine::WholeLines(_) => {
                self.direct(plan, index, element, walk, dense, iq)
            }
        }
    }

    /// One element by the direct sum, through the receiver filter if there is one.
    fn direct(
        &self,
        plan: &PingPlan,
        index: usize,
        element: usize,
        walk: &mut Workspace,
        dense: &mut Vec<Complex64>,
        iq: &mut [Complex64],
    ) -> EchoCounts {
        let array = &self.spec.receive[index];
        let leg = &self.transmit_legs[array.transmit];
        let (first_s, rate_hz, len) = self.grid(plan);
        let filter = self.decimator.as_ref();
        let out = match filter {
            Some(_) => {
                dense.resize(len, Complex64::ZERO);
                &mut **dense
            }
            None => &mut *iq,
        };
        out.fill(Complex64::ZERO);
        let ends = filter.map(Decimator::ends);
        let mut sink = Direct::new(plan, rate_hz, first_s, out).with_ends(ends);
        let counts = arrivals(plan, array, element, leg, walk, &mut sink);
        if let Some(filter) = filter {
            filter.apply(dense, iq);
        }
        counts
    }
}

fn sum(mut all: EchoCounts, more: EchoCounts) -> EchoCounts {
    all += more;
    all
}

/// One element by one thread.
fn slab_by_slab(
    made: &SlabEngine,
    target: PingElement<'_>,
    walk: &mut Workspace,
    iq: &mut [Complex64],
) -> EchoCounts {
    let mut counts = EchoCounts::default();
    for (slab, out) in iq.chunks_mut(made.slab_samples()).enumerate() {
        counts += made.synthesise_slab(target, slab, walk, out);
    }
    counts
}

impl Engine {
    fn gridded(
        spec: &SonarSpec,
        medium: &MediumSpec,
        decimator: Option<&Decimator>,
    ) -> Result<Self, PipelineError> {
        let still = DopplerSpan {
            least: 0.0,
            greatest: 0.0,
        };
        Ok(Self::Gridded {
            engines: engines(spec, medium, decimator)?,
            spans: vec![still; spec.receive.len()],
            ready: false,
        })
    }

    fn comparison(spec: &SonarSpec, decimator: Option<&Decimator>, record_s: f64) -> Self {
        let tails_s = decimator.map_or(0.0, |d| -2.0 * d.dense_first_s(0.0));
        let method = Comparison::new(
            spec.model.synthesis,
            spec.receiver.sample_rate_hz,
            record_s + tails_s,
            spec.synthesis.frequency_step_hz,
            decimator,
        );
        method.map_or(Self::Direct, Self::Comparison)
    }
}

fn engines(
    spec: &SonarSpec,
    medium: &MediumSpec,
    filter: Option<&Decimator>,
) -> Result<Engines, PipelineError> {
    let c = medium.sound_speed_m_per_s;
    Engines::new(spec, c, FASTEST_PLATFORM_M_PER_S, filter).map_err(|why| match why {
        EngineRefusal::Lines(_) => PipelineError::Lines(why),
        EngineRefusal::Elements(_) => PipelineError::Engine {
            tolerance: spec.synthesis.tolerance,
            why,
        },
    })
}

fn line_engines(
    spec: &SonarSpec,
    medium: &MediumSpec,
    filter: Option<&Decimator>,
) -> Result<LineEngines, PipelineError> {
    let c = medium.sound_speed_m_per_s;
    let segments = plan::max_segments(spec, c);
    let fastest = FASTEST_PLATFORM_M_PER_S;
    Ok(LineEngines::new(spec, c, fastest, filter, segments)?)
}

/// Error models of the engines that a sonar asks for: one for all its elements, and one for each line array made as a whole; empty for methods
/// without a tolerance. Costs are milliseconds of one core, per element of `gridded-1d` and per ping of whole lines, 0
/// where they are not known.
pub fn engine_error_models(
    spec: &SonarSpec,
    medium: &MediumSpec,
) -> Result<Vec<ErrorModel>, PipelineError> {
    if !spec.model.synthesis.keeps_tolerance() {
        return Ok(Vec::new());
    }
    let filter = receiver_filter(spec, medium)?;
    if spec.model.synthesis == Synthesis::Gridded2d {
        let engines = line_engines(spec, medium, filter.as_ref())?;
        return Ok(engines.error_models().cloned().collect());
    }
    Ok(engines(spec, medium, filter.as_ref())?
        .error_models()
        .collect())
}

/// The receiver filter for every pulse within the limits, none where none is configured: its pass band is that of the shortest pulse.
pub(crate) fn receiver_filter(
    spec: &SonarSpec,
    medium: &MediumSpec,
) -> Result<Option<Decimator>, FilterError> {
    let c = medium.sound_speed_m_per_s;
    let design = receiver_filter_design(spec, spec.model.synthesis, c);
    design.map(|design| design.decimator()).transpose()
}

/// What the receiver filter of a method is designed for, none where no filter is configured.
pub(crate) fn receiver_filter_design(
    spec: &SonarSpec,
    synthesis: Synthesis,
    sound_speed_m_per_s: f64,
) -> Option<FilterDesign> {
    let design = filter_design(spec, synthesis, sound_speed_m_per_s)?;
    Some(match synthesis.keeps_tolerance() {
        true => FilterDesign {
            oversample: design.oversample.max(MIN_DENSITY),
            ..design
        },
        false => design,
    })
}

/// What the receiver filter is designed for ahead of a method without a tolerance, none where no filter is configured.
pub(crate) fn filter_design(
    spec: &SonarSpec,
    synthesis: Synthesis,
    sound_speed_m_per_s: f64,
) -> Option<FilterDesign> {
    if spec.receiver.filter == ReceiverFilter::None {
        return None;
    }
    let pulse = shortest_pulse(spec);
    let sample_rate_hz = spec.receiver.sample_rate_hz;
    Some(FilterDesign {
        pulse,
        sample_rate_hz,
        doppler_hz: doppler_hz(spec, sound_speed_m_per_s),
        oversample: filter::oversample(&pulse, sample_rate_hz, synthesis),
    })
}

/// How long before and after an echo the receiver filter answers, seconds.
pub(crate) fn response_half_s(spec: &SonarSpec, sound_speed_m_per_s: f64) -> f64 {
    filter_design(spec, Synthesis::Direct, sound_speed_m_per_s)
        .map_or(0.0, |design| design.response_half_s())
}

/// The shortest pulse within the limits.
pub(crate) fn shortest_pulse(spec: &SonarSpec) -> Pulse {
    Pulse {
        duration_s: spec.limits.pulse_duration_s.0,
        ..spec.pulse
    }
}

/// Doppler shift of the fastest platform, hertz.
pub(crate) fn doppler_hz(spec: &SonarSpec, sound_speed_m_per_s: f64) -> f64 {
    2.0 * FASTEST_PLATFORM_M_PER_S / sound_speed_m_per_s * spec.pulse.center_frequency_hz
}
