//! One ping through the house: the function to read first is [`SonarPipeline::compute_ping`].
//!
//! In: a [`PingPlan`] and the scatterers around it. Out: [`PingOutput`]. Infallible, no allocation after the first ping at the largest
//! settings, no log: it counts. Work is split by element and by beam, and no floating-point sum crosses threads, so the samples are the
//! same bits for any number of threads.

use std::sync::{Mutex, PoisonError};

use num_complex::Complex64;
use rayon::prelude::*;
use thiserror::Error;

use crate::engines::{Engines, engine_filter};
use crate::error_check::ErrorChecker;
use crate::footprints::{footprints, max_audible_range_m};
use crate::line_engines::LineEngines;
use crate::more_pulses::{Desk, MorePulse};
use crate::plan;
use echotank_config::spec::{LineSpec, MediumSpec, SonarSpec};
use echotank_core::flow::{
    BeamFrame, EchoCounts, Edges, ElementFrame, ErrorModel, Footprint, Line, ModelChoice,
    OverloadState, PingOutput, PingPlan, Pulse, ReceiverFilter, Scatterers, SceneCounts,
    SonarSettings, Synthesis,
};
use echotank_imaging::beam::RowLimits;
use echotank_imaging::beam::fan::Fan;
use echotank_imaging::beam::halves::HalvesFormer;
use echotank_imaging::beam::sidescan::LineFormer;
use echotank_imaging::image::bottom::BottomDetector;
use echotank_synthesis::array::direct::Direct;
use echotank_synthesis::array::faults::{ActiveFault, spoil};
use echotank_synthesis::array::filter::{self, Decimator, FilterError, grid_ahead};
use echotank_synthesis::array::gridded::{DopplerSpan, GriddedError};
use echotank_synthesis::array::gridded2d::Refusal;
use echotank_synthesis::array::linear::Linear;
use echotank_synthesis::array::nearest::Nearest;
use echotank_synthesis::array::receiver::receive;
use echotank_synthesis::array::replica::Replica;
use echotank_synthesis::array::spectral::{Bins, Spectral, Spectrum};
use echotank_synthesis::echo::reference::reference_with;
use echotank_synthesis::echo::span::doppler_span;
use echotank_synthesis::echo::walk::{TransmitLeg, Window, Workspace, arrivals, insonify};
use echotank_synthesis::slabs::{Listener, Made};

/// Fastest platform the receiver filter leaves room for, m/s.
pub const FASTEST_PLATFORM_M_PER_S: f64 = 10.0;

/// No bottom is looked for nearer than this beyond the pulse, metres.
const NEAREST_BOTTOM_M: f64 = 1.0;

/// A sonar that cannot be computed as it is configured.
#[derive(Debug, Error)]
pub enum PipelineError {
    #[error("receiver filter: {0}")]
    Filter(#[from] FilterError),
    #[error("sonar.model.tolerance = {tolerance:e}: {why}")]
    Engine { tolerance: f64, why: GriddedError },
    #[error("sonar.model.synthesis = \"gridded-2d\": {0}")]
    LineEngine(#[from] Refusal),
}

/// What one thread needs while it computes one element.
#[derive(Default)]
struct Scratch {
    walk: Workspace,
    /// The element's signal ahead of the receiver filter's sampling.
    dense: Vec<Complex64>,
    /// The element's spectrum, for `spectral`.
    bins: Bins,
    /// One of several pulses.
    own: Vec<Complex64>,
}

/// What one element met, kept apart until all are done: sums of integers only.
#[derive(Clone, Copy, Default)]
struct ElementResult {
    counts: EchoCounts,
    saturated: u64,
}

/// Everything that turns plans of one sonar into samples, beams and lines, with every buffer it needs.
pub struct SonarPipeline {
    spec: SonarSpec,
    /// One per transmit array.
    transmit_leg: Vec<TransmitLeg>,
    /// One per thread of the pool: no lock ever waits.
    scratch: Vec<Mutex<Scratch>>,
    /// One per element of the largest array.
    results: Vec<ElementResult>,
    footprints: Vec<Footprint>,
    /// The receiver filter; none samples the sum at its points.
    decimator: Option<Decimator>,
    /// The pulse's spectrum, for `spectral`.
    spectrum: Option<Spectrum>,
    /// For `gridded-1d`.
    engines: Option<Engines>,
    /// For `gridded-2d`.
    line_engines: Option<LineEngines>,
    /// This ping's engine is at hand.
    engine_ready: bool,
    /// A tile without an echo is under way. It is soon made: another thread would have to be woken, and waited for.
    is_quiet: bool,
    /// One per receive array, for `gridded-1d`: the Dopplers of this ping.
    spans: Vec<DopplerSpan>,
    /// The sampled pulse, for `nearest` and `linear`.
    replica: Replica,
    /// Where error checks are asked for.
    error_checker: Option<ErrorChecker>,
    lines: Vec<LineFormer>,
    /// Those in the water together with the sonar's own.
    more_pulses: Vec<MorePulse>,
    fan: Option<Fan>,
    bottom: Option<Bottom>,
    /// Of the next ping.
    faults: Vec<ActiveFault>,
    spoiling: Vec<Complex64>,
}

/// What finds the bottom in the fan's beams.
struct Bottom {
    array: usize,
    halves: HalvesFormer,
    detector: BottomDetector,
}

impl SonarPipeline {
    /// Sizes every buffer for the largest ping within the sonar's limits. To be made inside the pool that will run it.
    pub fn new(spec: &SonarSpec, medium: &MediumSpec) -> Result<Self, PipelineError> {
        let limits = RowLimits {
            sample_rate_hz: spec.receiver.sample_rate_hz,
            samples: plan::max_samples(spec, medium.sound_speed_m_per_s),
            pulse_s: spec.limits.pulse_duration_s.1,
        };
        let decimator = match spec.receiver.filter {
            ReceiverFilter::None => None,
            ReceiverFilter::Fir => Some(receiver_filter(spec, medium)?),
        };
        let engines = match spec.model.synthesis {
            Synthesis::Gridded1d => Some(engines(spec, medium, decimator.as_ref())?),
            _ => None,
        };
        let segments = plan::max_segments(spec, medium.sound_speed_m_per_s);
        let line_engines = match spec.model.synthesis {
            Synthesis::Gridded2d => Some(line_engines(spec, medium, decimator.as_ref())?),
            _ => None,
        };
        let dense = match (&decimator, spec.model.synthesis) {
            (Some(d), Synthesis::Reference | Synthesis::Direct) => d.dense_len(limits.samples),
            _ => 0,
        };
        let scratch = || Scratch {
            walk: Workspace::with_room_for(segments),
            dense: Vec::with_capacity(dense),
            bins: Bins::default(),
            own: Vec::new(),
        };
        let spectrum = match spec.model.synthesis {
            Synthesis::Spectral => {
                let rate_hz = spec.receiver.sample_rate_hz;
                let tails_s = decimator
                    .as_ref()
                    .map_or(0.0, |d| -2.0 * d.dense_first_s(0.0));
                let record_s = limits.samples as f64 / rate_hz + limits.pulse_s + tails_s;
                let step_hz = spec.synthesis.frequency_step_hz;
                Some(Spectrum::new(
                    rate_hz,
                    record_s,
                    step_hz,
                    decimator.as_ref(),
                ))
            }
            _ => None,
        };
        let elements = spec
            .receive
            .iter()
            .map(|array| array.elements)
            .max()
            .unwrap_or(0);
        let fan = spec.beams.fan.as_ref().map(|fan| {
            let array = &spec.receive[fan.array];
            let transmit = &spec.transmit[array.transmit];
            let (weighting, c) = (spec.beams.weighting, medium.sound_speed_m_per_s);
            Fan::new(array, transmit, fan, limits, &spec.pulse, weighting, c)
        });
        let more_pulses = spec
            .more_pulses
            .iter()
            .map(|more| MorePulse::new(spec, more, medium, limits, decimator.as_ref()))
            .collect::<Result<_, _>>()?;
        Ok(Self {
            transmit_leg: spec
                .transmit
                .iter()
                .map(|_| TransmitLeg::default())
                .collect(),
            scratch: (0..rayon::current_num_threads())
                .map(|_| Mutex::new(scratch()))
                .collect(),
            results: vec![ElementResult::default(); elements],
            footprints: Vec::with_capacity(spec.receive.len()),
            decimator,
            spectrum,
            spans: vec![
                DopplerSpan {
                    least: 0.0,
                    greatest: 0.0
                };
                spec.receive.len()
            ],
            engine_ready: false,
            is_quiet: false,
            engines,
            line_engines,
            error_checker: match spec.synthesis.error_check {
                true => {
                    let doppler_hz = doppler_hz(spec, medium);
                    Some(ErrorChecker::new(spec, &shortest_pulse(spec), doppler_hz)?)
                }
                false => None,
            },
            replica: Replica::default(),
            lines: spec
                .beams
                .lines
                .iter()
                .map(|line| line_former(spec, medium, line, limits))
                .collect(),
            bottom: bottom(spec, medium, limits),
            faults: Vec::new(),
            spoiling: Vec::new(),
            more_pulses,
            fan,
            spec: spec.clone(),
        })
    }

    /// Output buffers of the right number; they grow once to the largest ping.
    pub fn blank_output(&self) -> PingOutput {
        PingOutput {
            elements: self
                .spec
                .receive
                .iter()
                .map(|_| ElementFrame::default())
                .collect(),
            beams: self.fan.iter().map(|_| BeamFrame::default()).collect(),
            soundings: Vec::new(),
            lines: self
                .spec
                .beams
                .lines
                .iter()
                .map(|line| Line {
                    side: line.side,
                    amplitude: Vec::new(),
                })
                .collect(),
            more_lines: self
                .more_pulses
                .iter()
                .map(MorePulse::blank_output)
                .collect(),
            counts: EchoCounts::default(),
            scene: SceneCounts::default(),
            error_check: None,
            methods: None,
            overload_state: OverloadState::NONE,
        }
    }

    /// Pings with these settings are about to come: what they need is made beside the ping path. Returns at once.
    pub fn expect(&mut self, settings: &SonarSettings) {
        if let Some(engines) = &mut self.engines {
            engines.expect(settings);
        }
        for more in &mut self.more_pulses {
            more.expect(settings);
        }
    }

    /// How much error checks may cost from now on, as a share of a ping's predicted cost; see [`ErrorChecker::allow`]. Nothing without error checks.
    pub fn allow_error_checks(&mut self, share: f64) {
        if let Some(error_checker) = &mut self.error_checker {
            error_checker.allow(share);
        }
    }

    /// What it is made for.
    pub fn model(&self) -> ModelChoice {
        self.spec.model
    }

    /// What is wrong with the elements in the next ping.
    pub(crate) fn faults_mut(&mut self) -> &mut Vec<ActiveFault> {
        &mut self.faults
    }

    /// What this ping's arrays can hear of the scene: what lies outside is not asked for.
    pub fn footprints(&mut self, plan: &PingPlan) -> &[Footprint] {
        footprints(&self.spec, plan, &mut self.footprints);
        &self.footprints
    }

    /// One ping: scatterers to element samples, beams and lines, into the caller's buffers.
    pub fn compute_ping(
        &mut self,
        plan: &PingPlan,
        scatterers: &Scatterers,
        output: &mut PingOutput,
    ) {
        output.counts = EchoCounts::default();
        self.light(plan, scatterers, &mut output.counts);
        for more in &mut self.more_pulses {
            let mut scratch = self.scratch[0]
                .lock()
                .unwrap_or_else(PoisonError::into_inner);
            let decimator = self.decimator.as_ref();
            output.counts += more.light(plan, scatterers, decimator, &mut scratch.walk);
        }
        if let Some(error_checker) = &mut self.error_checker {
            error_checker.choose(plan, &self.spec, scatterers.len());
        }
        for (index, frame) in output.elements.iter_mut().enumerate() {
            self.synthesise(plan, scatterers, index, frame, &mut output.counts);
        }
        if let Some(error_checker) = &mut self.error_checker {
            output.error_check = error_checker.check_error(plan, &self.spec, scatterers);
        }
        for fault in &self.faults {
            for frame in &mut output.elements {
                spoil(fault, plan, &self.spec.receiver, frame, &mut self.spoiling);
            }
        }
        for (former, line) in self.lines.iter_mut().zip(&mut output.lines) {
            let array = former.array();
            former.form(plan, &output.elements[array], line);
        }
        for (more, lines) in self.more_pulses.iter_mut().zip(&mut output.more_lines) {
            more.form(&output.elements, lines);
        }
        if let (Some(former), Some(beams)) = (&mut self.fan, output.beams.first_mut()) {
            let array = former.array();
            former.form(plan, &output.elements[array], beams);
        }
        if let Some(bottom) = &mut self.bottom {
            let halves = bottom.halves.form(plan, &output.elements[bottom.array]);
            let min_s = plan.pulse.duration_s + NEAREST_BOTTOM_M * 2.0 / plan.sound_speed_m_per_s;
            let soundings = &mut output.soundings;
            bottom
                .detector
                .detect(halves, plan.first_sample_s, min_s, soundings);
        }
    }

    /// Whatever lies farther than this from every transmitter has no part in the first `end` samples of a ping, metres.
    pub(crate) fn max_audible_range_m(&self, plan: &mut PingPlan, end: usize) -> f64 {
        let samples = std::mem::replace(&mut plan.sample_count, end);
        // As far as the receiver filter looks ahead.
        let (first_s, rate_hz, len) = self.grid(plan);
        plan.sample_count = samples;
        max_audible_range_m(&self.spec, plan, first_s + len as f64 / rate_hz)
    }

    /// The first `end` samples of a ping: the same bits as the whole ping's, where sums go echo by echo and no element has a fault. `is_first`: nothing
    /// of this ping has been made before.
    pub fn begin_ping(
        &mut self,
        plan: &mut PingPlan,
        end: usize,
        is_first: bool,
        scatterers: &Scatterers,
        elements: &mut [ElementFrame],
    ) {
        // Counted with the whole ping.
        let mut counts = EchoCounts::default();
        if is_first {
            // All that the ping hears, so that what is cut short goes through the same batches.
            self.light(plan, scatterers, &mut counts);
        }
        let samples = std::mem::replace(&mut plan.sample_count, end);
        let (first_s, rate_hz, len) = self.grid(plan);
        for transmit_leg in &mut self.transmit_leg {
            transmit_leg.hear(Window::of_samples(first_s, rate_hz, len));
        }
        self.is_quiet = scatterers.is_empty();
        for (index, frame) in elements.iter_mut().enumerate() {
            self.synthesise(plan, scatterers, index, frame, &mut counts);
        }
        self.is_quiet = false;
        plan.sample_count = samples;
    }

    /// The transmit leg, once per transmit array. The reference walks the scatterers itself.
    fn light(&mut self, plan: &PingPlan, scatterers: &Scatterers, counts: &mut EchoCounts) {
        if plan.model.synthesis == Synthesis::Reference {
            return;
        }
        let rate_hz = self.spec.receiver.sample_rate_hz;
        match plan.model.synthesis {
            Synthesis::Reference
            | Synthesis::Direct
            | Synthesis::Gridded1d
            | Synthesis::Gridded2d => {}
            Synthesis::Spectral => {
                if let Some(spectrum) = &mut self.spectrum {
                    spectrum.prepare(plan);
                }
            }
            Synthesis::Nearest | Synthesis::Linear => {
                self.replica.prepare(plan, rate_hz, self.decimator.as_ref());
            }
        }
        let (first_s, rate_hz, len) = self.grid(plan);
        let window = Window::of_samples(first_s, rate_hz, len);
        for (transmit, transmit_leg) in self.spec.transmit.iter().zip(&mut self.transmit_leg) {
            *counts += insonify(plan, transmit, window, scatterers, transmit_leg);
        }
        if let Some(engines) = &mut self.engines {
            self.engine_ready = engines.ready(plan);
            let widest = engines.span();
            let mut scratch = self.scratch[0]
                .lock()
                .unwrap_or_else(PoisonError::into_inner);
            for (span, array) in self.spans.iter_mut().zip(&self.spec.receive) {
                let transmit_leg = &self.transmit_leg[array.transmit];
                let (least, greatest) = doppler_span(plan, array, transmit_leg, &mut scratch.walk);
                *span = DopplerSpan {
                    least: least.clamp(widest.least, widest.greatest),
                    greatest: greatest.clamp(widest.least, widest.greatest),
                };
            }
        }
    }

    /// Where the sum is evaluated: first instant, rate and number of samples, ahead of the receiver filter.
    fn grid(&self, plan: &PingPlan) -> (f64, f64, usize) {
        let rate_hz = self.spec.receiver.sample_rate_hz;
        let (first_s, count) = (plan.first_sample_s, plan.sample_count);
        grid_ahead(self.decimator.as_ref(), first_s, rate_hz, count)
    }

    /// Element samples of one receive array, through the receiver chain.
    fn synthesise(
        &mut self,
        plan: &PingPlan,
        scatterers: &Scatterers,
        index: usize,
        frame: &mut ElementFrame,
        counts: &mut EchoCounts,
    ) {
        let elements = self.spec.receive[index].elements;
        frame.array = index;
        frame.elements = elements;
        frame.samples = plan.sample_count;
        frame
            .iq
            .resize(elements * plan.sample_count, Complex64::ZERO);
        if let Some(engines) = &mut self.line_engines {
            let transmit_leg = &self.transmit_leg[self.spec.receive[index].transmit];
            *counts += engines.synthesise(plan, &self.spec, index, transmit_leg, &mut frame.iq);
        }
        if plan.model.synthesis == Synthesis::Gridded1d
            && let Some(made) = self.engine()
        {
            *counts += self.make_slabs(made, plan, index, &mut frame.iq);
        }
        let mut results = std::mem::take(&mut self.results);
        let this = &*self;
        let together = if self.is_quiet { elements } else { 1 };
        frame
            .iq
            .par_chunks_mut(plan.sample_count)
            .with_min_len(together)
            .zip(&mut results[..elements])
            .enumerate()
            .for_each(|(element, (iq, result))| {
                *result = this.element(plan, scatterers, index, element, iq)
            });
        for result in &results[..elements] {
            *counts += result.counts;
        }
        frame.saturated = results[..elements]
            .iter()
            .map(|result| result.saturated)
            .sum();
        self.results = results;
    }

    /// This ping's engine, for `gridded-1d`.
    fn engine(&self) -> Option<&Made> {
        let engines = self.engines.as_ref()?;
        self.engine_ready.then(|| engines.current())
    }

    /// All elements of one array by `gridded-1d`, slab by slab.
    fn make_slabs(
        &self,
        made: &Made,
        plan: &PingPlan,
        index: usize,
        iq: &mut [Complex64],
    ) -> EchoCounts {
        let together = if self.is_quiet { usize::MAX } else { 1 };
        let array = &self.spec.receive[index];
        let sum = |mut all: EchoCounts, more: EchoCounts| {
            all += more;
            all
        };
        let elements = iq.par_chunks_mut(plan.sample_count);
        let of_each = elements
            .with_min_len(together)
            .enumerate()
            .map(|(element, iq)| {
                let listener = Listener {
                    plan,
                    array,
                    element,
                    transmit_leg: &self.transmit_leg[array.transmit],
                    span: self.spans[index],
                };
                let slabs = iq.par_chunks_mut(made.slab_samples());
                let of_each = slabs.with_min_len(together).enumerate().map(|(slab, out)| {
                    let thread = rayon::current_thread_index().unwrap_or(0);
                    let mut scratch = self.scratch[thread]
                        .lock()
                        .unwrap_or_else(PoisonError::into_inner);
                    made.make_slab(listener, slab, &mut scratch.walk, out)
                });
                of_each.reduce(EchoCounts::default, sum)
            });
        of_each.reduce(EchoCounts::default, sum)
    }

    /// A sum over echoes through the receiver filter, if there is one: `sum` gets what happens at edges, rate, first instant and samples.
    fn filtered(
        &self,
        plan: &PingPlan,
        dense: &mut Vec<Complex64>,
        iq: &mut [Complex64],
        sum: impl FnOnce(Edges, f64, f64, &mut [Complex64]) -> EchoCounts,
    ) -> EchoCounts {
        let (first_s, rate_hz, len) = self.grid(plan);
        let Some(decimator) = &self.decimator else {
            return sum(Edges::Sampled, rate_hz, first_s, iq);
        };
        dense.resize(len, Complex64::ZERO);
        let counts = sum(Edges::Weighted, rate_hz, first_s, dense);
        decimator.apply(dense, iq);
        counts
    }

    /// One element: its echoes, the receiver filter, the receiver.
    fn element(
        &self,
        plan: &PingPlan,
        scatterers: &Scatterers,
        index: usize,
        element: usize,
        iq: &mut [Complex64],
    ) -> ElementResult {
        let array = &self.spec.receive[index];
        let thread = rayon::current_thread_index().unwrap_or(0);
        // A panic in another ping leaves the scratch as good as any: every use overwrites it.
        let mut scratch = self.scratch[thread]
            .lock()
            .unwrap_or_else(PoisonError::into_inner);
        let Scratch {
            walk,
            dense,
            bins,
            own,
        } = &mut *scratch;
        let transmit_leg = &self.transmit_leg[array.transmit];
        let (first_s, rate_hz) = (plan.first_sample_s, self.spec.receiver.sample_rate_hz);
        let mut counts = match (plan.model.synthesis, self.engine()) {
            (Synthesis::Reference, _) => {
                let transmit = &self.spec.transmit[array.transmit];
                self.filtered(plan, dense, iq, |edges, rate_hz, first_s, out| {
                    reference_with(
                        edges, plan, transmit, array, element, scatterers, rate_hz, first_s, out,
                    )
                })
            }
            // The whole array has been made already.
            (Synthesis::Gridded2d, _) | (Synthesis::Gridded1d, Some(_)) => EchoCounts::default(),
            (Synthesis::Direct | Synthesis::Gridded1d, _) => {
                self.filtered(plan, dense, iq, |edges, rate_hz, first_s, out| {
                    out.fill(Complex64::ZERO);
                    let mut sink = Direct::new(plan, rate_hz, first_s, out).with_edges(edges);
                    arrivals(plan, array, element, transmit_leg, walk, &mut sink)
                })
            }
            (Synthesis::Spectral, _) => {
                let spectrum = self.spectrum.as_ref().expect("made with the pipeline");
                let mut sink = Spectral::new(plan, spectrum, first_s, bins);
                let counts = arrivals(plan, array, element, transmit_leg, walk, &mut sink);
                sink.finish(iq);
                counts
            }
            (Synthesis::Nearest, _) => {
                iq.fill(Complex64::ZERO);
                let mut sink = Nearest::new(plan, &self.replica, rate_hz, first_s, iq);
                arrivals(plan, array, element, transmit_leg, walk, &mut sink)
            }
            (Synthesis::Linear, _) => {
                iq.fill(Complex64::ZERO);
                let mut sink = Linear::new(plan, &self.replica, rate_hz, first_s, iq);
                arrivals(plan, array, element, transmit_leg, walk, &mut sink)
            }
        };
        if let Some(error_checker) = &self.error_checker {
            error_checker.take(plan, rate_hz, index, element, iq);
        }
        for more in &self.more_pulses {
            let desk = Desk {
                walk: &mut *walk,
                dense: &mut *dense,
                own: &mut *own,
                decimator: self.decimator.as_ref(),
            };
            counts += more.add(scatterers, index, element, desk, iq);
        }
        ElementResult {
            counts,
            saturated: receive(plan, &self.spec.receiver, array, index, element, iq),
        }
    }
}

pub(super) fn engines(
    spec: &SonarSpec,
    medium: &MediumSpec,
    filter: Option<&Decimator>,
) -> Result<Engines, PipelineError> {
    let c = medium.sound_speed_m_per_s;
    Engines::new(spec, c, FASTEST_PLATFORM_M_PER_S, filter).map_err(|why| PipelineError::Engine {
        tolerance: spec.synthesis.tolerance,
        why,
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

/// What the engines that a sonar asks for promise, one for all its elements or one for each receive array; none where it asks for none.
/// Costs are milliseconds of one core per element, 0 where they are not known.
pub fn engine_error_models(
    spec: &SonarSpec,
    medium: &MediumSpec,
) -> Result<Vec<ErrorModel>, PipelineError> {
    if !spec.model.synthesis.keeps_tolerance() {
        return Ok(Vec::new());
    }
    let filter = match spec.receiver.filter {
        ReceiverFilter::None => None,
        ReceiverFilter::Fir => Some(receiver_filter(spec, medium)?),
    };
    if spec.model.synthesis == Synthesis::Gridded2d {
        let engines = line_engines(spec, medium, filter.as_ref())?;
        return Ok(engines.error_models().cloned().collect());
    }
    let engines = engines(spec, medium, filter.as_ref())?;
    Ok(vec![engines.error_model().clone()])
}

/// The receiver filter for every pulse within the limits: its pass band is that of the shortest.
pub(super) fn receiver_filter(
    spec: &SonarSpec,
    medium: &MediumSpec,
) -> Result<Decimator, FilterError> {
    let shortest = shortest_pulse(spec);
    let rate_hz = spec.receiver.sample_rate_hz;
    if spec.model.synthesis.keeps_tolerance() {
        return engine_filter(&shortest, rate_hz, doppler_hz(spec, medium));
    }
    Decimator::new(
        &shortest,
        rate_hz,
        doppler_hz(spec, medium),
        filter::oversample(&shortest, rate_hz, spec.model.synthesis),
    )
}

fn bottom(spec: &SonarSpec, medium: &MediumSpec, limits: RowLimits) -> Option<Bottom> {
    let fan = spec
        .beams
        .fan
        .as_ref()
        .filter(|f| f.form.bottom_detection)?;
    let array = &spec.receive[fan.array];
    let transmit = &spec.transmit[array.transmit];
    let (weighting, c) = (spec.beams.weighting, medium.sound_speed_m_per_s);
    let bandwidth_hz = spec
        .pulse
        .bandwidth_hz
        .max(1.0 / spec.limits.pulse_duration_s.0);
    Some(Bottom {
        array: fan.array,
        halves: HalvesFormer::new(array, transmit, fan, limits, &spec.pulse, weighting, c),
        detector: BottomDetector::new(limits.sample_rate_hz, bandwidth_hz, limits.samples),
    })
}

pub(super) fn line_former(
    spec: &SonarSpec,
    medium: &MediumSpec,
    line: &LineSpec,
    limits: RowLimits,
) -> LineFormer {
    let weighting = spec.beams.weighting;
    if !spec.beams.focused_lines {
        return LineFormer::weighted(line, limits, &spec.pulse, weighting);
    }
    let array = &spec.receive[line.array];
    let transmit = &spec.transmit[array.transmit];
    let c = medium.sound_speed_m_per_s;
    LineFormer::focused(line, array, transmit, limits, &spec.pulse, &spec.beams, c)
}

fn shortest_pulse(spec: &SonarSpec) -> Pulse {
    Pulse {
        duration_s: spec.limits.pulse_duration_s.0,
        ..spec.pulse
    }
}

fn doppler_hz(spec: &SonarSpec, medium: &MediumSpec) -> f64 {
    2.0 * FASTEST_PLATFORM_M_PER_S / medium.sound_speed_m_per_s * spec.pulse.center_frequency_hz
}
