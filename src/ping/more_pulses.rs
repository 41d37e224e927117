//! Further pulses within one ping. The echoes of all pulses are summed into the same element samples. A matched filter per pulse separates them.
//!
//! Pulse p is transmitted `delay_s` after the sonar's own pulse as sqrt(2) Re{ a_p(t) exp(j 2pi f_p t) }. The time t counts from the start of pulse
//! p. Its echoes are synthesised about f_p on a clock that starts with pulse p. About the carrier f_c of the sonar they appear multiplied by
//!
//! ```text
//! exp(j 2pi (f_p - f_c) t) exp(-j 2pi f_c delay)
//! ```
//!
//! For the beamformers of pulse p the element samples are multiplied by the conjugate. Pulses differ in their sweeps or their bands. With opposite
//! sweeps, about 1/sqrt(B T) of the level leaks through.
//!
//! Not modelled: absorption and source level at the other frequency, and echoes of the previous ping.

use num_complex::Complex64;
use std::f64::consts::TAU;

use crate::element_synthesis::{ElementScratch, ElementSynthesis, PipelineError};
use crate::plan;
use echotank_config::spec::{MediumSpec, MorePulseSpec, SonarSpec};
use echotank_core::ping::{EchoCounts, ElementFrame, Line, PingPlan, PulseLines};
use echotank_core::scene::Scatterers;
use echotank_core::settings::SonarSettings;
use echotank_imaging::beam::RowLimits;
use echotank_imaging::beam::sidescan::LineFormer;
use echotank_synthesis::array::filter::Decimator;
use echotank_synthesis::echo::walk::Workspace;

/// Synthesis and line formers of one further pulse.
pub(crate) struct MorePulse {
    delay_s: f64,
    plan: PingPlan,
    synthesis: ElementSynthesis,
    /// Factor from the samples of this pulse to those of the sonar, one per sample of the ping.
    turn: Vec<Complex64>,
    lines: Vec<LineFormer>,
    /// Elements of one array, multiplied by the conjugate of `turn`.
    frame: ElementFrame,
}

impl MorePulse {
    /// Creates the synthesis of `more`, a further pulse of `sonar`. Call inside the pool that runs the pings.
    pub(crate) fn new(
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
        Ok(Self {
            delay_s: more.delay_s,
            plan: plan::blank(0, &spec, medium, 0.0),
            synthesis: ElementSynthesis::of_further_pulse(&spec, medium, filter)?,
            turn: Vec::with_capacity(limits.samples),
            lines: spec
                .beams
                .lines
                .iter()
                .map(|line| LineFormer::of_sonar(&spec, line, limits, medium.sound_speed_m_per_s))
                .collect(),
            frame: ElementFrame::default(),
        })
    }

    pub(crate) fn blank_output(&self) -> PulseLines {
        let blank = |line: &LineFormer| Line {
            side: line.side(),
            amplitude: Vec::new(),
        };
        PulseLines {
            delay_s: self.delay_s,
            lines: self.lines.iter().map(blank).collect(),
        }
    }

    /// See [`ElementSynthesis::expect`].
    pub(crate) fn expect(&mut self, settings: &SonarSettings) {
        self.synthesis.expect(settings);
    }

    /// Computes the transmit leg of every scatterer, and the tables shared by all elements.
    pub(crate) fn insonify(
        &mut self,
        ping: &PingPlan,
        scatterers: &Scatterers,
        walk: &mut Workspace,
    ) -> EchoCounts {
        self.follow(ping);
        self.synthesis
            .insonify_moving(&self.plan, scatterers, self.delay_s);
        self.synthesis.insonify(&self.plan, scatterers, walk)
    }

    /// Sets the plan of this pulse, whose clock starts `delay_s` after the ping.
    fn follow(&mut self, ping: &PingPlan) {
        let (plan, delay_s) = (&mut self.plan, self.delay_s);
        plan.ping_number = ping.ping_number;
        plan.transmit_utc = ping.transmit_utc.plus_s(delay_s);
        plan.stamp_utc = ping.stamp_utc;
        plan.ping_period_s = ping.ping_period_s;
        plan.settings = ping.settings;
        plan.ping_rate_hz = ping.ping_rate_hz;
        plan.pulse = plan::pulse(&self.synthesis.spec, &ping.settings);
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
        let rate_hz = self.synthesis.spec.receiver.sample_rate_hz;
        let (window_s, segment_s) = (plan.window_s(rate_hz), plan.model.segment_s);
        plan::polyline(&plan.trajectory, window_s, segment_s, &mut plan.segments);
        let apart_hz = plan.pulse.center_frequency_hz - ping.pulse.center_frequency_hz;
        let late = ping.pulse.center_frequency_hz * delay_s;
        self.turn.clear();
        self.turn.extend((0..plan.sample_count).map(|k| {
            let cycles = apart_hz * (plan.first_sample_s + k as f64 / rate_hz) - late;
            Complex64::from_polar(1.0, TAU * (cycles - cycles.round()))
        }));
    }

    /// Adds the echoes of this pulse at one element to `iq`. Returns their counts.
    pub(crate) fn add(
        &self,
        scatterers: &Scatterers,
        index: usize,
        element: usize,
        scratch: &mut ElementScratch,
        iq: &mut [Complex64],
    ) -> EchoCounts {
        let mut own = std::mem::take(&mut scratch.own);
        own.resize(self.plan.sample_count, Complex64::ZERO);
        let mut counts = self
            .synthesis
            .element(&self.plan, scatterers, index, element, scratch, &mut own);
        counts += self
            .synthesis
            .add_moving(&self.plan, index, element, scratch, &mut own);
        for ((x, y), turn) in iq.iter_mut().zip(&own).zip(&self.turn) {
            *x += *y * turn;
        }
        scratch.own = own;
        counts
    }

    /// Forms the lines of this pulse from the samples of all pulses.
    pub(crate) fn form(&mut self, elements: &[ElementFrame], out: &mut PulseLines) {
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

#[cfg(test)]
mod tests {
    use std::path::Path;

    use glam::{DQuat, DVec3};

    use super::*;
    use crate::pipeline::SonarPipeline;
    use echotank_config as config;
    use echotank_core::arrays::ReceiverFilter;
    use echotank_core::frames::Trajectory;
    use echotank_core::model::Synthesis;
    use echotank_core::ping::PingOutput;
    use echotank_core::pulse::{Pulse, PulseKind};
    use echotank_core::scene::ScatterLaw;
    use echotank_core::time::UtcNs;

    const VELOCITY: DVec3 = DVec3::new(5.144, 0.0, 0.0);

    /// Sonar of the example with a short window, no noise, no culling, no TVG, exact sums and rectangular weighting.
    fn sonar() -> (SonarSpec, MediumSpec) {
        let text = include_str!("../../hil-configs/multipulse.toml");
        let rig =
            config::parse(text, Path::new("."), &config::AnyFiles).expect("a good configuration");
        let mut spec = rig.sonars[0].clone();
        spec.receiver.noise_db = None;
        spec.receiver.tvg = echotank_core::arrays::TimeVaryingGain::None;
        spec.receiver.filter = ReceiverFilter::None;
        spec.model.synthesis = Synthesis::Direct;
        spec.model.cull_db = None;
        spec.beams.weighting = echotank_config::spec::Shading::Uniform;
        spec.settings.range_m = 40.0;
        spec.limits.range_m = (40.0, 40.0);
        for transmit in &mut spec.transmit {
            transmit.pattern = echotank_core::arrays::Pattern::Omnidirectional;
        }
        spec.receive[0].element_pattern = echotank_core::arrays::Pattern::Omnidirectional;
        (spec, rig.medium.clone())
    }

    /// Plan of a ping that begins `late_s` after the ping at the origin of the world.
    fn plan(spec: &SonarSpec, medium: &MediumSpec, late_s: f64) -> PingPlan {
        let mut plan = plan::blank(0, spec, medium, 0.0);
        plan.trajectory = Trajectory::uniform(VELOCITY * late_s, VELOCITY, DQuat::IDENTITY);
        let order = crate::PingOrder {
            ping_number: 1,
            transmit_utc: UtcNs(0),
            settings: spec.settings,
            period_s: 0.0,
        };
        plan::fill(&mut plan, spec, &order, Default::default(), UtcNs(0));
        plan
    }

    /// One point to starboard, at a two-way distance of 1387 samples of 52 kHz.
    fn point() -> Scatterers {
        let mut points = Scatterers::default();
        let at_m = DVec3::new(0.0, 0.8, 0.6) * (1387.0 / 52e3 * 750.0);
        points.push(at_m, [0.0; 3], Complex64::ONE, ScatterLaw::Point);
        points
    }

    fn once(spec: &SonarSpec, medium: &MediumSpec, plan: &PingPlan) -> PingOutput {
        let pool = crate::threads::pool(1).expect("a pool");
        pool.install(|| {
            let mut pipeline = SonarPipeline::new(spec, medium).expect("a sonar");
            let mut output = pipeline.blank_output();
            pipeline.compute_ping(plan, &point(), &mut output);
            output
        })
    }

    fn more(spec: &SonarSpec, delay_s: f64, apart_hz: f64) -> MorePulseSpec {
        let center_frequency_hz = spec.pulse.center_frequency_hz + apart_hz;
        MorePulseSpec {
            pulse: Pulse {
                kind: PulseKind::LfmDown,
                center_frequency_hz,
                ..spec.pulse
            },
            delay_s,
            transmit: Some(1),
        }
    }

    fn top(level: &[f32]) -> (usize, f64) {
        let k = (0..level.len()).fold(0, |b, k| if level[k] > level[b] { k } else { b });
        (k, f64::from(level[k]))
    }

    /// The samples are the sum of both pulses computed separately. The second pulse is computed as a separate ping at the later position.
    #[test]
    fn elements_hear_the_sum_of_the_pulses_each_sent_where_the_platform_is() {
        for (delay_s, apart_hz) in [(0.0, 0.0), (10e-3, 0.0), (10e-3, 2e3)] {
            let (mut spec, medium) = sonar();
            spec.more_pulses.clear();
            let first = once(&spec, &medium, &plan(&spec, &medium, 0.0));
            let also = more(&spec, delay_s, apart_hz);
            let mut alone = spec.clone();
            alone.pulse = also.pulse;
            alone.receive[0].transmit = 1;
            let second = once(&alone, &medium, &plan(&alone, &medium, delay_s));
            spec.more_pulses = vec![also];
            let both = once(&spec, &medium, &plan(&spec, &medium, 0.0));
            let late = (delay_s * spec.receiver.sample_rate_hz).round() as usize;
            let (mut worst, mut most) = (0.0_f64, 0.0_f64);
            for e in 0..2 {
                for k in 0..first.elements[0].samples {
                    let t = (k as f64 - late as f64) / spec.receiver.sample_rate_hz;
                    let cycles = apart_hz * t - spec.pulse.center_frequency_hz * delay_s;
                    let turn = Complex64::from_polar(1.0, TAU * (cycles - cycles.round()));
                    let earlier = k.checked_sub(late);
                    let second =
                        earlier.map_or(Complex64::ZERO, |k| second.elements[0].element(e)[k]);
                    let want = first.elements[0].element(e)[k] + second * turn;
                    worst = worst.max((both.elements[0].element(e)[k] - want).norm());
                    most = most.max(want.norm());
                }
            }
            println!("{delay_s} s, {apart_hz} Hz apart: {:.1e}", worst / most);
            assert!(
                worst / most < 1e-9,
                "{delay_s} {apart_hz}: {:.1e}",
                worst / most
            );
        }
    }

    /// The lines of each pulse show the point at its range. The leakage from the other pulse is the correlation of an up and a down sweep,
    /// |1/T integral exp(j 2pi (B/T) t^2) dt|, about 1/sqrt(2 B T).
    #[test]
    fn lines_tell_the_pulses_apart_and_leak_what_the_correlation_of_the_sweeps_says() {
        let (mut spec, medium) = sonar();
        spec.pulse.taper = 0.0;
        // A line of two elements would receive the second echo from the point at a lower level.
        spec.receive[0].elements = 1;
        let delay_s = 12e-3;
        spec.more_pulses = vec![more(&spec, delay_s, 0.0)];
        let plan = plan(&spec, &medium, 0.0);
        let output = once(&spec, &medium, &plan);
        let rate_hz = spec.receiver.sample_rate_hz;
        let late = (delay_s * rate_hz) as usize;
        let [first, second] = [&output.lines[0], &output.more_lines[0].lines[0]];
        assert_eq!(output.more_lines[0].delay_s, delay_s);
        assert_eq!(second.amplitude.len() + late, first.amplitude.len());
        let edge = (2.0 * 20.0 / medium.sound_speed_m_per_s * rate_hz).round() as usize;
        let (bandwidth_hz, duration_s) = (spec.pulse.bandwidth_hz, spec.pulse.duration_s);
        let steps = 20_000;
        let leak: Complex64 = (0..steps)
            .map(|i| {
                let x = (i as f64 + 0.5) / f64::from(steps) - 0.5;
                Complex64::from_polar(1.0, TAU * bandwidth_hz * duration_s * x * x)
            })
            .sum::<Complex64>()
            / f64::from(steps);
        let rule = 1.0 / (2.0 * bandwidth_hz * duration_s).sqrt();
        assert!((leak.norm() / rule - 1.0).abs() < 0.1);
        for (line, other) in [(first, edge + late), (second, edge - late)] {
            let (at, level) = top(&line.amplitude);
            assert!(at.abs_diff(edge) <= 1, "{at} want {edge}");
            let got = f64::from(line.amplitude[other]) / level;
            let off_db = 20.0 * (got / leak.norm()).log10();
            println!(
                "leak {:.1} dB, closed form {:.1} dB",
                20.0 * got.log10(),
                20.0 * leak.norm().log10()
            );
            // Samples are off the peak, and the Doppler effect stretches both pulses.
            assert!(off_db.abs() < 1.0, "{off_db:.2} dB");
        }
    }

    /// Bands with a distance of one and a half bandwidths and tapered flanks leak far less than opposite sweeps.
    #[test]
    fn separate_bands_leak_less_than_opposite_sweeps() {
        let (mut spec, medium) = sonar();
        spec.receiver.sample_rate_hz = 160e3;
        spec.pulse.taper = 0.5;
        let delay_s = 12e-3;
        spec.more_pulses = vec![more(&spec, delay_s, 45e3)];
        spec.more_pulses[0].pulse.kind = PulseKind::LfmUp;
        let output = once(&spec, &medium, &plan(&spec, &medium, 0.0));
        let late = (delay_s * 160e3) as usize;
        let line = &output.lines[0].amplitude;
        let (at, level) = top(line);
        let around = &line[at + late - 200..at + late + 200];
        let leak_db = 20.0 * (top(around).1 / level).log10();
        let (second_at, _) = top(&output.more_lines[0].lines[0].amplitude);
        println!("{leak_db:.1} dB");
        assert!(leak_db < -45.0, "{leak_db:.1} dB");
        assert!(second_at.abs_diff(at) <= 1, "{second_at} want {at}");
    }

    /// The gridded engine sums several pulses within its tolerance of the direct sum.
    #[test]
    fn the_gridded_engine_sums_several_pulses_within_its_tolerance() {
        let (mut spec, medium) = sonar();
        spec.receiver.filter = ReceiverFilter::Fir;
        spec.more_pulses = vec![more(&spec, 10e-3, 0.0)];
        let plan_of = |spec: &SonarSpec| plan(spec, &medium, 0.0);
        let want = once(&spec, &medium, &plan_of(&spec));
        spec.model.synthesis = Synthesis::Gridded1d;
        spec.synthesis.tolerance = 1e-3;
        let got = once(&spec, &medium, &plan_of(&spec));
        let (mut off, mut all) = (0.0, 0.0);
        for (g, w) in got.elements[0].iq.iter().zip(&want.elements[0].iq) {
            off += (g - w).norm_sqr();
            all += w.norm_sqr();
        }
        let error = f64::sqrt(off / all);
        println!("{error:.1e}");
        assert!(error < 1.5e-3, "{error:.1e}");
    }
}
