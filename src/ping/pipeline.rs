//! Everything that turns the plans of one sonar into samples, beams and lines: [`SonarPipeline`], in four steps.
//!
//! In: a [`PingPlan`] and the scatterers around it. Out: [`PingOutput`]. Infallible, no allocation after the first ping at the largest
//! settings, no log: it counts. Work is split by element and by beam, and no floating-point sum crosses threads, so the samples are the
//! same bits for any number of threads.

use std::sync::Mutex;

use num_complex::Complex64;
use rayon::prelude::*;

pub use crate::element_synthesis::PipelineError;
use crate::element_synthesis::{
    ElementScratch, ElementSynthesis, doppler_hz, filter_design, of_this_thread, receiver_filter,
    shortest_pulse,
};
use crate::error_check::ErrorChecker;
use crate::footprints::{footprints, max_echo_range_m};
use crate::more_pulses::MorePulse;
use crate::plan;
use echotank_config::spec::{MediumSpec, SonarSpec};
use echotank_core::model::ModelChoice;
use echotank_core::ping::{
    BeamFrame, EchoCounts, ElementFrame, Line, OverloadState, PingOutput, PingPlan, SceneCounts,
};
use echotank_core::scene::{Footprint, Scatterers};
use echotank_core::settings::SonarSettings;
use echotank_imaging::beam::RowLimits;
use echotank_imaging::beam::fan::Fan;
use echotank_imaging::beam::sidescan::LineFormer;
use echotank_imaging::image::bottom::BottomDetector;
use echotank_synthesis::array::faults::{ActiveFault, apply_fault};
use echotank_synthesis::array::instrument::{ElementInstrument, InstrumentSizes};
use echotank_synthesis::array::{fill_gains, receive};

/// No bottom is looked for nearer than this beyond the pulse, metres.
const NEAREST_BOTTOM_M: f64 = 1.0;

/// Counts of one element, added up when all are done: integers only.
#[derive(Clone, Copy, Default)]
struct ElementResult {
    counts: EchoCounts,
    saturated: u64,
}

/// Everything that turns plans of one sonar into samples, beams and lines, with every buffer it needs.
pub struct SonarPipeline {
    spec: SonarSpec,
    /// The echoes of the sonar's own pulse.
    synthesis: ElementSynthesis,
    /// One per thread of the pool.
    scratch: Vec<Mutex<ElementScratch>>,
    /// One per element of the largest array.
    results: Vec<ElementResult>,
    footprints: Vec<Footprint>,
    /// A tile without an echo is under way. One thread makes it: to wake another would take longer.
    is_quiet: bool,
    /// See [`Self::is_direct_instead`].
    is_direct_instead: bool,
    /// Where error checks are asked for.
    error_checker: Option<ErrorChecker>,
    lines: Vec<LineFormer>,
    /// Those in the water together with the sonar's own.
    more_pulses: Vec<MorePulse>,
    fan: Option<Fan>,
    bottom: Option<BottomDetector>,
    /// Imperfections of transducers and receiver.
    instrument: Option<ElementInstrument>,
    /// Of the next ping.
    faults: Vec<ActiveFault>,
    spoiling: Vec<Complex64>,
    /// Linear receiver gain of each sample of the ping.
    gains: Vec<f64>,
}

impl SonarPipeline {
    /// Sizes every buffer for the largest ping within the sonar's limits. To be made inside the pool that will run it.
    pub fn new(spec: &SonarSpec, medium: &MediumSpec) -> Result<Self, PipelineError> {
        let limits = RowLimits {
            sample_rate_hz: spec.receiver.sample_rate_hz,
            samples: plan::max_samples(spec, medium.sound_speed_m_per_s),
            pulse_s: spec.limits.pulse_duration_s.1,
        };
        let decimator = receiver_filter(spec, medium)?;
        let decimator = decimator.as_ref();
        let record_s = limits.samples as f64 / limits.sample_rate_hz + limits.pulse_s;
        let synthesis = ElementSynthesis::new(spec, medium, decimator, record_s)?;
        let segments = plan::max_segments(spec, medium.sound_speed_m_per_s);
        let dense = synthesis.dense_len(limits.samples);
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
        let more_pulses: Vec<MorePulse> = spec
            .more_pulses
            .iter()
            .map(|more| MorePulse::new(spec, more, medium, limits, decimator))
            .collect::<Result<_, _>>()?;
        let instrument = instrument(spec, medium, limits)?;
        // A thread may get its first element in any ping.
        let acts = |instrument: &ElementInstrument| instrument.acts_on_elements();
        let own = match instrument.as_ref().is_some_and(acts) || !more_pulses.is_empty() {
            true => limits.samples,
            false => 0,
        };
        Ok(Self {
            synthesis,
            scratch: (0..rayon::current_num_threads())
                .map(|_| Mutex::new(ElementScratch::with_room_for(segments, dense, own)))
                .collect(),
            results: vec![ElementResult::default(); elements],
            footprints: Vec::with_capacity(spec.receive.len() * (1 + spec.more_pulses.len())),
            is_quiet: false,
            is_direct_instead: false,
            error_checker: match spec.synthesis.error_check {
                true => {
                    let doppler_hz = doppler_hz(spec, medium.sound_speed_m_per_s);
                    Some(ErrorChecker::new(spec, &shortest_pulse(spec), doppler_hz)?)
                }
                false => None,
            },
            lines: spec
                .beams
                .lines
                .iter()
                .map(|line| LineFormer::of_sonar(spec, line, limits, medium.sound_speed_m_per_s))
                .collect(),
            bottom: bottom(spec, limits),
            instrument,
            faults: Vec::new(),
            spoiling: Vec::new(),
            gains: Vec::with_capacity(limits.samples),
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
        self.synthesis.expect(settings);
        for more in &mut self.more_pulses {
            more.expect(settings);
        }
    }

    /// Goes on with the error checks of the pipeline that it replaces.
    pub(crate) fn carry_on_checks(&mut self, from: &Self) {
        if let (Some(to), Some(from)) = (&mut self.error_checker, &from.error_checker) {
            to.carry_on(from);
        }
    }

    /// How much error checks may cost from now on, as a share of a ping's predicted cost; see [`ErrorChecker::allow`]. Nothing without error checks.
    pub fn allow_error_checks(&mut self, share: f64) {
        if let Some(error_checker) = &mut self.error_checker {
            error_checker.allow(share);
        }
    }

    /// Path, Doppler and synthesis methods of its pings.
    pub fn model(&self) -> ModelChoice {
        self.spec.model
    }

    /// Sets path model, segments and culling of the next pings. The engines stay, so `model` must need the same ones.
    pub(crate) fn set_model(&mut self, model: ModelChoice) {
        self.spec.model = model;
        if let Some(error_checker) = &mut self.error_checker {
            error_checker.set_model(&self.spec);
        }
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
        self.insonify(plan, scatterers, output);
        self.synthesise(plan, scatterers, output);
        self.receive(plan, output);
        self.form(plan, output);
    }

    /// The transmit leg of every scatterer, for every pulse.
    pub(crate) fn insonify(
        &mut self,
        plan: &PingPlan,
        scatterers: &Scatterers,
        output: &mut PingOutput,
    ) {
        let walk = &mut of_this_thread(&self.scratch).walk;
        output.counts = self.synthesis.insonify(plan, scatterers, walk);
        self.synthesis.insonify_moving(plan, scatterers, 0.0);
        for more in &mut self.more_pulses {
            output.counts += more.insonify(plan, scatterers, walk);
        }
    }

    /// The sum of the echoes at every element, ahead of the receiver, and the error check of it where one is asked for.
    pub(crate) fn synthesise(
        &mut self,
        plan: &PingPlan,
        scatterers: &Scatterers,
        output: &mut PingOutput,
    ) {
        if let Some(error_checker) = &mut self.error_checker {
            error_checker.choose(plan, &self.spec, scatterers.len());
        }
        self.is_direct_instead = true;
        for (index, frame) in output.elements.iter_mut().enumerate() {
            self.synthesise_array(plan, scatterers, index, frame, &mut output.counts);
        }
        if let Some(error_checker) = &mut self.error_checker {
            output.error_check = error_checker.check_error(plan, &self.spec, scatterers);
        }
    }

    /// Whether the direct sum made every element of the last ping, because all arrays had echoes beyond the design of the engine.
    pub(crate) fn is_direct_instead(&self) -> bool {
        self.is_direct_instead
    }

    /// The receiver of every element: imperfections, noise, gain and converter, then the elements' faults.
    pub(crate) fn receive(&mut self, plan: &PingPlan, output: &mut PingOutput) {
        self.pass_instrument(plan, &mut output.elements);
        self.fill_gains(plan);
        for (index, frame) in output.elements.iter_mut().enumerate() {
            self.receive_array(plan, index, frame);
        }
        for fault in &self.faults {
            for frame in &mut output.elements {
                apply_fault(fault, plan, &self.spec.receiver, frame, &mut self.spoiling);
            }
        }
    }

    /// Side-scan lines, beams and soundings from the element samples.
    pub(crate) fn form(&mut self, plan: &PingPlan, output: &mut PingOutput) {
        for (former, line) in self.lines.iter_mut().zip(&mut output.lines) {
            let array = former.array();
            former.form(plan, &output.elements[array], line);
        }
        for (more, lines) in self.more_pulses.iter_mut().zip(&mut output.more_lines) {
            more.form(&output.elements, lines);
        }
        if let (Some(former), Some(beams)) = (&mut self.fan, output.beams.first_mut()) {
            let array = former.array();
            let products = former.form(plan, &output.elements[array], beams);
            if let (Some(products), Some(bottom)) = (products, &mut self.bottom) {
                let min_s =
                    plan.pulse.duration_s + NEAREST_BOTTOM_M * 2.0 / plan.sound_speed_m_per_s;
                let soundings = &mut output.soundings;
                bottom.detect(beams, products, plan.first_sample_s, min_s, soundings);
            }
        }
    }

    /// Whatever lies farther than this from every transmitter has no part in the first `end` samples of a ping, metres.
    pub(crate) fn max_echo_range_m(&self, plan: &mut PingPlan, end: usize) -> f64 {
        let end = self.synthesised_end(plan, end);
        let samples = std::mem::replace(&mut plan.sample_count, end);
        // As far as the receiver filter looks ahead.
        let (first_s, rate_hz, len) = self.synthesis.grid(plan);
        plan.sample_count = samples;
        max_echo_range_m(&self.spec, plan, first_s + len as f64 / rate_hz)
    }

    /// Number of samples to synthesise for the first `end` of a ping: the response of the transducers looks ahead.
    fn synthesised_end(&self, plan: &PingPlan, end: usize) -> usize {
        let ahead = self
            .instrument
            .as_ref()
            .map_or(0, ElementInstrument::lookahead);
        (end + ahead).min(plan.sample_count.max(end))
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
            // Everything within the range of the whole ping, so that the tile's echoes go through the same batches.
            let walk = &mut of_this_thread(&self.scratch).walk;
            self.synthesis.insonify(plan, scatterers, walk);
            self.synthesis.insonify_moving(plan, scatterers, 0.0);
        }
        let synthesised = self.synthesised_end(plan, end);
        let samples = std::mem::replace(&mut plan.sample_count, synthesised);
        self.synthesis.limit_to_window(plan);
        self.is_quiet = scatterers.is_empty();
        for (index, frame) in elements.iter_mut().enumerate() {
            self.synthesise_array(plan, scatterers, index, frame, &mut counts);
        }
        self.pass_instrument(plan, elements);
        plan.sample_count = end;
        self.fill_gains(plan);
        for (index, frame) in elements.iter_mut().enumerate() {
            cut(frame, end);
            self.receive_array(plan, index, frame);
        }
        self.is_quiet = false;
        plan.sample_count = samples;
    }

    /// The sum of the echoes at the elements of one receive array.
    fn synthesise_array(
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
        let together = if self.is_quiet { elements.max(1) } else { 1 };
        let made = self
            .synthesis
            .array(plan, index, together, &self.scratch, &mut frame.iq);
        let is_whole = made.is_some();
        self.is_direct_instead &= made.is_none_or(|counts| counts.beyond_engine > 0);
        *counts += made.unwrap_or_default();
        let is_more = self.synthesis.has_moving() || !self.more_pulses.is_empty();
        if is_whole && self.error_checker.is_none() && !is_more {
            return;
        }
        let mut results = std::mem::take(&mut self.results);
        let this = &*self;
        frame
            .iq
            .par_chunks_mut(plan.sample_count)
            .with_min_len(together)
            .zip(&mut results[..elements])
            .enumerate()
            .for_each(|(element, (iq, result))| {
                result.counts = this.element(plan, scatterers, index, element, is_whole, iq);
            });
        for result in &results[..elements] {
            self.is_direct_instead &= is_whole || result.counts.beyond_engine > 0;
            *counts += result.counts;
        }
        self.results = results;
    }

    /// One element: its echoes of every pulse. `is_made`: those of the sonar's own are in `iq`.
    fn element(
        &self,
        plan: &PingPlan,
        scatterers: &Scatterers,
        index: usize,
        element: usize,
        is_made: bool,
        iq: &mut [Complex64],
    ) -> EchoCounts {
        let scratch = &mut *of_this_thread(&self.scratch);
        let mut counts = match is_made {
            true => EchoCounts::default(),
            false => self
                .synthesis
                .element(plan, scatterers, index, element, scratch, iq),
        };
        if let Some(error_checker) = &self.error_checker {
            let rate_hz = self.spec.receiver.sample_rate_hz;
            error_checker.take(plan, rate_hz, index, element, iq);
        }
        if self.synthesis.has_moving() {
            counts += self.synthesis.add_moving(plan, index, element, scratch, iq);
        }
        for more in &self.more_pulses {
            counts += more.add(scatterers, index, element, scratch, iq);
        }
        counts
    }

    /// Imperfections of transducers and receiver ahead of noise and gain.
    fn pass_instrument(&mut self, plan: &PingPlan, frames: &mut [ElementFrame]) {
        let Some(instrument) = &mut self.instrument else {
            return;
        };
        instrument.prepare(plan);
        if instrument.acts_on_elements() {
            for (index, frame) in frames.iter_mut().enumerate() {
                let (instrument, scratch) = (&*instrument, &self.scratch);
                let elements = frame.iq.par_chunks_mut(plan.sample_count).enumerate();
                elements.for_each(|(element, iq)| {
                    let before = &mut of_this_thread(scratch).own;
                    instrument.add_to_element(plan, index, element, iq, before);
                });
            }
        }
        instrument.couple(frames);
    }

    fn fill_gains(&mut self, plan: &PingPlan) {
        let receiver = &self.spec.receiver;
        fill_gains(plan, receiver, plan.sample_count, &mut self.gains);
    }

    /// The receiver of the elements of one receive array.
    fn receive_array(&mut self, plan: &PingPlan, index: usize, frame: &mut ElementFrame) {
        let array = &self.spec.receive[index];
        let (receiver, gains) = (&self.spec.receiver, &self.gains);
        let instrument = self.instrument.as_ref();
        let together = if self.is_quiet {
            array.elements.max(1)
        } else {
            1
        };
        let results = &mut self.results[..array.elements];
        frame
            .iq
            .par_chunks_mut(plan.sample_count)
            .with_min_len(together)
            .zip(&mut *results)
            .enumerate()
            .for_each(|(element, (iq, result))| {
                if let Some(instrument) = instrument {
                    instrument.add_tones(iq);
                }
                result.saturated = receive(plan, receiver, gains, array, index, element, iq);
            });
        frame.saturated = results.iter().map(|result| result.saturated).sum();
    }
}

fn instrument(
    spec: &SonarSpec,
    medium: &MediumSpec,
    limits: RowLimits,
) -> Result<Option<ElementInstrument>, PipelineError> {
    let c = medium.sound_speed_m_per_s;
    let sizes = InstrumentSizes {
        filter: filter_design(spec, spec.model.synthesis, c),
        doppler_hz: doppler_hz(spec, c),
        max_samples: limits.samples,
    };
    Ok(ElementInstrument::new(spec, sizes)?)
}

/// Keeps the first `end` samples of every element.
fn cut(frame: &mut ElementFrame, end: usize) {
    if frame.samples == end {
        return;
    }
    for element in 1..frame.elements {
        let from = element * frame.samples;
        frame.iq.copy_within(from..from + end, element * end);
    }
    frame.samples = end;
    frame.iq.truncate(frame.elements * end);
}

fn bottom(spec: &SonarSpec, limits: RowLimits) -> Option<BottomDetector> {
    let fan = spec.beams.fan.as_ref();
    fan.filter(|fan| fan.form.bottom_detection)?;
    let bandwidth_hz = spec
        .pulse
        .bandwidth_hz
        .max(1.0 / spec.limits.pulse_duration_s.0);
    let (rate_hz, samples) = (limits.sample_rate_hz, limits.samples);
    Some(BottomDetector::new(rate_hz, bandwidth_hz, samples))
}
