//! Pulses that are in the water together with the sonar's own: the echoes of each are summed into the same element samples, and a matched
//! filter of its own finds them again.
//!
//! Pulse p leaves `delay_s` after the sonar's own as sqrt(2) Re{ a_p(t) exp(j 2pi f_p t) }, t from its own start. About the sonar's carrier f_c
//! its echoes, synthesised about f_p on a clock that starts with it, appear times
//!
//! ```text
//! exp(j 2pi (f_p - f_c) t) exp(-j 2pi f_c delay)
//! ```
//!
//! and for its own formers the element samples are turned back by the same. What tells pulses apart is their sweeps (up against down: about
//! 1/sqrt(B T) of the level leaks through) or their bands.
//!
//! Not modelled: absorption and source level at the other frequency, echoes of the ping before.

use num_complex::Complex64;
use std::f64::consts::TAU;
use std::sync::PoisonError;

use crate::array::direct::Direct;
use crate::array::filter::Decimator;
use crate::array::gridded::DopplerSpan;
use crate::beam::RowLimits;
use crate::beam::sidescan::LineFormer;
use crate::config::spec::{MediumSpec, MorePulseSpec, SonarSpec};
use crate::echo::reference::reference_with;
use crate::echo::span::doppler_span;
use crate::echo::walk::{Illuminated, Window, Workspace, arrivals, illuminate};
use crate::flow::{
    EchoCounts, Edges, ElementFrame, Line, PingPlan, PulseLines, Scatterers, SonarSettings,
    Synthesis,
};
use crate::ping;
use crate::run::engines::Engines;
use crate::run::pipeline::{PipelineError, engines, line_former};

/// One pulse with everything it needs.
pub struct MorePulse {
    /// The sonar as this pulse sees it: its pulse, and who listens to whom.
    spec: SonarSpec,
    delay_s: f64,
    plan: PingPlan,
    lit: Vec<Illuminated>,
    engines: Option<Engines>,
    engine_ready: bool,
    /// One per receive array.
    spans: Vec<DopplerSpan>,
    /// What turns its samples into the sonar's, one per sample of this ping.
    turn: Vec<Complex64>,
    lines: Vec<LineFormer>,
    /// The elements of one array, turned back.
    frame: ElementFrame,
}

/// What one element's sum is written with.
pub struct Desk<'a> {
    pub walk: &'a mut Workspace,
    pub dense: &'a mut Vec<Complex64>,
    /// The pulse's own samples.
    pub own: &'a mut Vec<Complex64>,
    pub thread: usize,
    pub decimator: Option<&'a Decimator>,
}

impl MorePulse {
    /// `more` is one of `sonar`'s. To be made inside the pool that will run it.
    pub fn new(
        sonar: &SonarSpec,
        more: &MorePulseSpec,
        medium: &MediumSpec,
        limits: RowLimits,
        filter: Option<&Decimator>,
    ) -> Result<Self, PipelineError> {
        let mut spec = sonar.clone();
        spec.pulse = more.pulse;
        if let Some(transmit) = more.transmit {
            for array in &mut spec.receive {
                array.transmit = transmit;
            }
        }
        let engines = match spec.model.synthesis {
            Synthesis::Gridded1d => Some(engines(&spec, medium, filter)?),
            _ => None,
        };
        let still = DopplerSpan {
            least: 0.0,
            greatest: 0.0,
        };
        Ok(Self {
            delay_s: more.delay_s,
            plan: ping::blank(0, &spec, medium, 0.0),
            lit: spec
                .transmit
                .iter()
                .map(|_| Illuminated::default())
                .collect(),
            engines,
            engine_ready: false,
            spans: vec![still; spec.receive.len()],
            turn: Vec::with_capacity(limits.samples),
            lines: spec
                .beams
                .lines
                .iter()
                .map(|line| line_former(&spec, medium, line, limits))
                .collect(),
            frame: ElementFrame::default(),
            spec,
        })
    }

    pub fn blank_output(&self) -> PulseLines {
        let blank = |line: &LineFormer| Line {
            side: line.side(),
            amplitude: Vec::new(),
        };
        PulseLines {
            delay_s: self.delay_s,
            lines: self.lines.iter().map(blank).collect(),
        }
    }

    /// As [`Engines::expect`].
    pub fn expect(&mut self, settings: &SonarSettings) {
        if let Some(engines) = &mut self.engines {
            engines.expect(settings);
        }
    }

    /// The transmit leg, and all else that its elements have in common.
    pub fn light(
        &mut self,
        ping: &PingPlan,
        scatterers: &Scatterers,
        decimator: Option<&Decimator>,
        walk: &mut Workspace,
    ) -> EchoCounts {
        self.follow(ping);
        let mut counts = EchoCounts::default();
        if self.plan.model.synthesis == Synthesis::Reference {
            return counts;
        }
        let (plan, rate_hz) = (&self.plan, self.spec.receiver.sample_rate_hz);
        let (first_s, rate_hz, len) = grid(plan, rate_hz, decimator);
        let window = Window::of_samples(first_s, rate_hz, len);
        for (transmit, lit) in self.spec.transmit.iter().zip(&mut self.lit) {
            counts += illuminate(plan, transmit, window, scatterers, lit);
        }
        if let Some(engines) = &mut self.engines {
            self.engine_ready = engines.ready(plan);
            let widest = engines.span();
            for (span, array) in self.spans.iter_mut().zip(&self.spec.receive) {
                let (least, greatest) = doppler_span(plan, array, &self.lit[array.transmit], walk);
                *span = DopplerSpan {
                    least: least.clamp(widest.least, widest.greatest),
                    greatest: greatest.clamp(widest.least, widest.greatest),
                };
            }
        }
        counts
    }

    /// The ping on this pulse's clock, which starts `delay_s` later.
    fn follow(&mut self, ping: &PingPlan) {
        let (plan, delay_s) = (&mut self.plan, self.delay_s);
        plan.ping_number = ping.ping_number;
        plan.transmit_utc = ping.transmit_utc.plus_s(delay_s);
        plan.stamp_utc = ping.stamp_utc;
        plan.ping_period_s = ping.ping_period_s;
        plan.settings = ping.settings;
        plan.ping_rate_hz = ping.ping_rate_hz;
        plan.pulse = ping::pulse(&self.spec, &ping.settings);
        plan.sound_speed_m_per_s = ping.sound_speed_m_per_s;
        plan.absorption_db_per_m = ping.absorption_db_per_m;
        plan.sample_count = ping.sample_count;
        plan.first_sample_s = ping.first_sample_s - delay_s;
        plan.model = ping.model;
        plan.nav = ping.nav;
        let (own, given) = (&mut plan.trajectory, &ping.trajectory);
        own.position.clone_from(&given.position);
        own.heave.clone_from(&given.heave);
        own.attitude.clone_from(&given.attitude);
        own.lever_arm_m = given.lever_arm_m;
        for knot in own.position.iter_mut().chain(&mut own.heave) {
            knot.time_s -= delay_s;
        }
        for knot in &mut own.attitude {
            knot.time_s -= delay_s;
        }
        let rate_hz = self.spec.receiver.sample_rate_hz;
        let (window_s, segment_s) = (plan.window_s(rate_hz), plan.model.segment_s);
        ping::polyline(&plan.trajectory, window_s, segment_s, &mut plan.segments);
        let apart_hz = plan.pulse.center_frequency_hz - ping.pulse.center_frequency_hz;
        let late = ping.pulse.center_frequency_hz * delay_s;
        self.turn.clear();
        self.turn.extend((0..plan.sample_count).map(|k| {
            let cycles = apart_hz * (plan.first_sample_s + k as f64 / rate_hz) - late;
            Complex64::from_polar(1.0, TAU * (cycles - cycles.round()))
        }));
    }

    /// Adds this pulse's echoes at one element to `iq`.
    pub fn add(
        &self,
        scatterers: &Scatterers,
        index: usize,
        element: usize,
        desk: Desk<'_>,
        iq: &mut [Complex64],
    ) -> EchoCounts {
        let Desk {
            walk,
            dense,
            own,
            thread,
            decimator,
        } = desk;
        let (plan, array) = (&self.plan, &self.spec.receive[index]);
        let lit = &self.lit[array.transmit];
        own.resize(plan.sample_count, Complex64::ZERO);
        let engine = self.engines.as_ref().filter(|_| self.engine_ready);
        let counts = match (plan.model.synthesis, engine) {
            (Synthesis::Gridded1d, Some(engines)) => {
                let mut work = engines.current().work[thread]
                    .lock()
                    .unwrap_or_else(PoisonError::into_inner);
                work.start(plan.first_sample_s, self.spans[index]);
                let mut counts = arrivals(plan, array, element, lit, walk, &mut *work);
                counts.beyond_engine = work.finish(own).outside_span;
                counts
            }
            (synthesis, _) => {
                let rate_hz = self.spec.receiver.sample_rate_hz;
                let (first_s, rate_hz, len) = grid(plan, rate_hz, decimator);
                let (edges, out) = match decimator {
                    Some(_) => {
                        dense.resize(len, Complex64::ZERO);
                        (Edges::Weighted, &mut dense[..len])
                    }
                    None => (Edges::Sampled, &mut own[..]),
                };
                let counts = match synthesis {
                    Synthesis::Reference => reference_with(
                        edges,
                        plan,
                        &self.spec.transmit[array.transmit],
                        array,
                        element,
                        scatterers,
                        rate_hz,
                        first_s,
                        out,
                    ),
                    _ => {
                        out.fill(Complex64::ZERO);
                        let mut sink = Direct::new(plan, rate_hz, first_s, out).with_edges(edges);
                        arrivals(plan, array, element, lit, walk, &mut sink)
                    }
                };
                if let Some(decimator) = decimator {
                    decimator.apply(dense, own);
                }
                counts
            }
        };
        for ((x, y), turn) in iq.iter_mut().zip(own).zip(&self.turn) {
            *x += *y * turn;
        }
        counts
    }

    /// This pulse's lines from the samples of all pulses.
    pub fn form(&mut self, elements: &[ElementFrame], out: &mut PulseLines) {
        for (former, line) in self.lines.iter_mut().zip(&mut out.lines) {
            let (own, given) = (&mut self.frame, &elements[former.array()]);
            own.array = given.array;
            own.elements = given.elements;
            own.samples = given.samples;
            own.iq.clear();
            let back = self.turn.iter().map(|turn| turn.conj());
            for e in 0..given.elements {
                let row = given.element(e).iter().zip(back.clone());
                own.iq.extend(row.map(|(x, back)| x * back));
            }
            former.form(&self.plan, own, line);
        }
    }
}

/// As the pipeline's own: first instant, rate and number of samples, ahead of the receiver filter.
fn grid(plan: &PingPlan, rate_hz: f64, decimator: Option<&Decimator>) -> (f64, f64, usize) {
    match decimator {
        None => (plan.first_sample_s, rate_hz, plan.sample_count),
        Some(d) => (
            d.dense_first_s(plan.first_sample_s),
            d.dense_rate_hz(),
            d.dense_len(plan.sample_count),
        ),
    }
}
