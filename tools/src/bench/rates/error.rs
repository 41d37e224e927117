//! Errors of sampled windows, by the equation of the reference.
//!
//! The norm is W of docs/accuracy.md, that of the contract: the error of a window over its own level or the noise floor, whichever is higher. A few
//! windows of a few elements are sampled, including the strongest of each and the weakest above the floor.

use echotank_config::spec::{RigSpec, SonarSpec};
use echotank_core::arrays::TimeVaryingGain;
use echotank_core::model::Synthesis;
use echotank_core::ping::PingOutput;
use echotank_core::pulse::noise_share;
use echotank_core::scene::Scatterers;
use echotank_ping::make_ping;
use echotank_runtime::chart::bare;
use echotank_runtime::recorded::RecordedRig;
use echotank_synthesis::array::{fill_gains, receive};
use num_complex::Complex64;

use crate::draw::SplitMix;
use crate::reference::{Probe, reference_filter, reference_plan, values, window_samples};

/// Number of sampled elements of each array.
const ELEMENTS: usize = 4;
/// Number of sampled windows of each element, besides the strongest and the weakest.
const WINDOWS: usize = 4;
/// Number of samples of each window.
const SAMPLES: usize = 16;

/// The rig with its selected methods, without noise, gain and converter.
fn without_receiver(spec: &RigSpec) -> RigSpec {
    let mut spec = spec.clone();
    for sonar in &mut spec.sonars {
        *sonar = bare(sonar);
        sonar.receiver.tvg = TimeVaryingGain::None;
        sonar.beams = Default::default();
        sonar.more_pulses.clear();
    }
    spec
}

/// The same rig, which gathers every scatterer and computes no ping.
fn uncut(spec: &RigSpec) -> RigSpec {
    let mut spec = spec.clone();
    for sonar in &mut spec.sonars {
        sonar.model.synthesis = Synthesis::Direct;
        sonar.model.cull_db = None;
        sonar.synthesis.auto = Default::default();
    }
    spec
}

/// Largest error of the sampled windows in the first pings of every sonar. `None` if no ping has an echo. Call inside the pool.
pub(super) fn largest(spec: &RigSpec, pings: u32) -> Result<Option<f64>, String> {
    let made_of = without_receiver(spec);
    let mut made = RecordedRig::open(&made_of).map_err(|e| e.to_string())?;
    let mut truth = RecordedRig::open(&uncut(&made_of)).map_err(|e| e.to_string())?;
    let slots = |rig: &RecordedRig| -> Vec<_> {
        (0..made_of.sonars.len()).map(|s| rig.rig.slot(s)).collect()
    };
    let (mut made_slots, mut truth_slots) = (slots(&made), slots(&truth));
    let mode = made_of.nav.mode;
    let mut worst = None;
    while let Some((sonar, order)) = made.next_order(pings) {
        made.record_pulse(sonar, &order);
        let (same_sonar, same) = truth.next_order(pings).ok_or("the rigs part")?;
        truth.record_pulse(same_sonar, &same);
        if (same_sonar, &same) != (sonar, &order) {
            return Err("the rigs part".into());
        }
        if !made.settle(sonar, &order) || !truth.settle(sonar, &order) {
            break;
        }
        let (slot, whole) = (&mut made_slots[sonar], &mut truth_slots[sonar]);
        let utc = order.transmit_utc;
        let rig = &mut made.rig;
        let gap = make_ping(rig, sonar, &order, mode, utc, slot).is_err()
            || truth.rig.prepare(sonar, &order, mode, utc, whole).is_err();
        if gap {
            continue;
        }
        let of_ping = SampledPing {
            spec: &made.rig.sonars[sonar].spec,
            output: &slot.output,
            scatterers: truth.rig.scatterers(),
        };
        if let Some(error) = of_ping.largest(&whole.plan, &made_of)? {
            worst = Some(f64::max(worst.unwrap_or(0.0), error));
        }
    }
    Ok(worst)
}

/// Ping whose windows are sampled.
struct SampledPing<'a> {
    spec: &'a SonarSpec,
    output: &'a PingOutput,
    /// All scatterers, without culling.
    scatterers: &'a Scatterers,
}

/// Window of an element, and the mean square that its error refers to.
struct Window {
    element: usize,
    first: usize,
    len: usize,
    level: f64,
}

fn mean_square(samples: &[Complex64]) -> f64 {
    samples.iter().map(Complex64::norm_sqr).sum::<f64>() / samples.len() as f64
}

impl SampledPing<'_> {
    fn largest(
        &self,
        plan: &echotank_core::ping::PingPlan,
        rig: &RigSpec,
    ) -> Result<Option<f64>, String> {
        let spec = self.spec;
        let plan = reference_plan(plan);
        let filter = reference_filter(spec, &rig.medium).map_err(|e| e.to_string())?;
        let rate_hz = spec.receiver.sample_rate_hz;
        let (mut worst, mut gains): (Option<f64>, _) = (None, Vec::new());
        for (index, array) in spec.receive.iter().enumerate() {
            let windows = self.windows(
                index,
                window_samples(plan.pulse.duration_s, rate_hz),
                plan.ping_number,
            );
            let samples = |window: &Window| {
                let stride = window.len.div_ceil(SAMPLES);
                (window.first..window.first + window.len).step_by(stride)
            };
            let probes: Vec<Probe> = windows
                .iter()
                .flat_map(|window| samples(window).map(|sample| (window.element, sample)))
                .map(|(element, sample)| Probe {
                    transmit: &spec.transmit[array.transmit],
                    array,
                    element,
                    sample,
                })
                .collect();
            let mut want = values(&plan, self.scatterers, filter.as_ref(), rate_hz, &probes);
            fill_gains(&plan, &spec.receiver, 1, &mut gains);
            for (probe, value) in probes.iter().zip(&mut want) {
                let value = std::slice::from_mut(value);
                let (receiver, element) = (&spec.receiver, probe.element);
                receive(&plan, receiver, &gains, array, index, element, value);
            }
            let mut want = want.into_iter();
            for window in &windows {
                let got = self.output.elements[index].element(window.element);
                let off: Vec<Complex64> = samples(window)
                    .zip(&mut want)
                    .map(|(sample, want)| got[sample] - want)
                    .collect();
                let error = (mean_square(&off) / window.level).sqrt();
                worst = Some(worst.map_or(error, |worst| worst.max(error)));
            }
        }
        Ok(worst)
    }

    /// Windows to sample; empty for an element without echoes.
    fn windows(&self, array: usize, window: usize, seed: u32) -> Vec<Window> {
        let frame = &self.output.elements[array];
        let mut chance = SplitMix::new(u64::from(seed) ^ (array as u64) << 32);
        let mut found = Vec::new();
        for nth in 0..ELEMENTS.min(frame.elements) {
            // One element of each part of the line.
            let part = frame.elements / ELEMENTS.min(frame.elements);
            let element = nth * part + chance.of(part);
            let record = frame.element(element);
            let levels: Vec<f64> = record.chunks(window).map(mean_square).collect();
            let by_level = |a: &usize, b: &usize| levels[*a].total_cmp(&levels[*b]);
            let strongest = (0..levels.len()).max_by(by_level);
            let Some(strongest) = strongest.filter(|k| levels[*k] > 0.0) else {
                continue;
            };
            let floor = levels[strongest] * noise_share();
            let weakest = (0..levels.len())
                .filter(|k| levels[*k] > floor)
                .min_by(by_level);
            let chosen = [strongest].into_iter().chain(weakest);
            let random = (0..WINDOWS).map(|_| chance.of(levels.len()));
            found.extend(chosen.chain(random).map(|k| Window {
                element,
                first: k * window,
                len: window.min(record.len() - k * window),
                level: levels[k].max(floor),
            }));
        }
        found
    }
}
