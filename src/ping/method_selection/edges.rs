//! Edges of sharp pulses beside samples. Without a receiver filter an echo begins and ends between two samples; a delay that is off may move an edge
//! across one of them, which then gains or loses the whole echo. Before a ping this is a matter of chance; its own delays and samples tell.
//!
//! In: the plan of a ping, its scatterers and its samples ahead of the receiver. Out: the error of the edges that cross a sample.

use echotank_config::spec::SonarSpec;
use echotank_core::ping::{ElementFrame, PingPlan};
use echotank_core::pulse::noise_share;
use echotank_core::scene::Scatterers;
use echotank_synthesis::array::Direct;
use echotank_synthesis::arrivals::{ArrivalChunk, ArrivalSink};
use echotank_synthesis::echo::probe::{Instant, echoes_at};
use echotank_synthesis::echo::{TransmitLeg, Window, Workspace, arrivals, insonify};
use num_complex::Complex64;

use crate::error_check::window_samples;

/// So many samples of a ping are computed by the equation of the reference. At others an edge counts as if it crossed.
const EXACT: usize = 64;

/// The error in the worst window of any element from beginnings and ends of echoes that cross a sample. Looked at are those within `shifts_s` seconds of
/// one.
pub(super) fn error_of_edges(
    spec: &SonarSpec,
    plan: &PingPlan,
    scatterers: &Scatterers,
    frames: &[ElementFrame],
    shifts_s: [f64; 2],
) -> f64 {
    let rate_hz = spec.receiver.sample_rate_hz;
    let heard = Window::of_samples(plan.first_sample_s, rate_hz, plan.sample_count);
    let (mut leg, mut work) = (TransmitLeg::new(), Workspace::default());
    let mut edges = Edges {
        pulse_s: plan.pulse.duration_s,
        first_sample_s: plan.first_sample_s,
        rate_hz,
        shifts: shifts_s.map(|shift_s| shift_s * rate_hz),
        near: Vec::new(),
    };
    let mut left = EXACT;
    let mut worst = 0.0f64;
    for (array, frame) in spec.receive.iter().zip(frames) {
        let transmit = &spec.transmit[array.transmit];
        insonify(plan, transmit, heard, scatterers, &mut leg);
        let window = window_samples(plan.pulse.duration_s, rate_hz).min(frame.samples);
        for element in 0..array.elements {
            edges.near.clear();
            arrivals(plan, array, element, &leg, &mut work, &mut edges);
            if frame.samples == 0 || edges.near.is_empty() {
                continue;
            }
            let signal = frame.element(element);
            let at = |sample: usize| {
                let time_s = plan.first_sample_s + sample as f64 / rate_hz;
                let at = Instant {
                    element,
                    time_s,
                    half_span_s: 0.0,
                };
                let mut value = [Complex64::ZERO];
                let mut sum = Direct::new(plan, rate_hz, time_s, &mut value);
                let all = 0..scatterers.len();
                echoes_at(plan, transmit, array, at, scatterers, all, &mut sum);
                value[0]
            };
            let crossings = edges.near.iter().filter_map(|&(sample, amplitude)| {
                let got = signal.get(sample)?;
                let (off, level) = match left {
                    0 => (amplitude, (got.norm() - amplitude).max(0.0)),
                    _ => {
                        left -= 1;
                        let exact = at(sample);
                        ((got - exact).norm(), exact.norm())
                    }
                };
                Some(Crossing {
                    sample,
                    error: off * off,
                    level: level * level,
                })
            });
            let crossings: Vec<Crossing> = crossings.collect();
            worst = worst.max(worst_window(signal, &crossings, window));
        }
    }
    worst
}

/// A sample that an echo may gain or lose: what it is off by, and what it should be, squared.
struct Crossing {
    sample: usize,
    error: f64,
    level: f64,
}

/// Looks for edges beside samples.
struct Edges {
    pulse_s: f64,
    first_sample_s: f64,
    rate_hz: f64,
    /// Of beginning and end, samples.
    shifts: [f64; 2],
    /// Samples with the amplitudes of the echoes.
    near: Vec<(usize, f64)>,
}

impl ArrivalSink for Edges {
    fn accept(&mut self, chunk: &ArrivalChunk) {
        for i in 0..chunk.len {
            let (eta, curvature) = (1.0 + chunk.doppler[i], chunk.curvature_per_s[i]);
            // (1 + doppler) s + curvature s^2 = T.
            let root = (eta * eta + 4.0 * curvature * self.pulse_s).sqrt();
            let lasts_s = 2.0 * self.pulse_s / (eta + root);
            let begins_s = chunk.delay_s[i] - self.first_sample_s;
            let edges_s = [begins_s, begins_s + lasts_s];
            for (edge_s, shift) in edges_s.into_iter().zip(self.shifts) {
                let at = edge_s * self.rate_hz;
                let sample = at.round();
                if sample >= 0.0 && (at - sample).abs() <= shift {
                    self.near.push((sample as usize, chunk.amplitude[i].norm()));
                }
            }
        }
    }
}

/// The error in the worst window of an element with these samples, all right but for the crossings.
fn worst_window(signal: &[Complex64], crossings: &[Crossing], window: usize) -> f64 {
    let mut errors = vec![0.0; signal.len()];
    let mut levels: Vec<f64> = signal.iter().map(|x| x.norm_sqr()).collect();
    for crossing in crossings {
        errors[crossing.sample] = crossing.error;
        levels[crossing.sample] = crossing.level;
    }
    let (errors, levels) = (upto(&errors), upto(&levels));
    let of = |sums: &[f64], first: usize| (sums[first + window] - sums[first]).max(0.0);
    let windows = || 0..=signal.len() - window;
    let strongest = windows().map(|first| of(&levels, first));
    let floor = strongest.fold(f64::MIN_POSITIVE, f64::max) * noise_share();
    let squares = windows().map(|first| of(&errors, first) / of(&levels, first).max(floor));
    squares.fold(0.0, f64::max).sqrt()
}

/// Sums before each value, and of all.
fn upto(values: &[f64]) -> Vec<f64> {
    let mut sum = 0.0;
    let sums = values.iter().map(|value| {
        sum += value;
        sum
    });
    std::iter::once(0.0).chain(sums).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A weak echo behind a strong one or beside it gains or loses a sample at an end.
    #[test]
    fn the_worst_window_of_a_crossed_edge_is_found() {
        const WINDOW: usize = 40;
        let tone = |k: usize, turns: f64, level: f64| {
            Complex64::from_polar(level, std::f64::consts::TAU * turns * k as f64)
        };
        for (begins, level) in [(60, 1.0), (60, 0.03), (30, 0.2), (45, 1.0), (20, 0.5)] {
            let ends = begins + WINDOW - 1;
            for sample in [begins, begins - 1, ends, ends + 1] {
                let strong = |k: usize| (20..20 + WINDOW).contains(&k);
                let weak = |k: usize| (begins..=ends).contains(&k);
                let value = |k: usize, weak: bool| {
                    let level_of = |sounds: bool, level: f64| if sounds { level } else { 0.0 };
                    tone(k, 0.01, level_of(strong(k), 1.0)) + tone(k, 0.03, level_of(weak, level))
                };
                let signal: Vec<Complex64> = (0..140).map(|k| value(k, weak(k))).collect();
                let truth: Vec<Complex64> = (0..140)
                    .map(|k| value(k, weak(k) != (k == sample)))
                    .collect();
                let energy = |of: &dyn Fn(usize) -> f64, first: usize| -> f64 {
                    (first..first + WINDOW).map(of).sum()
                };
                let level_of = |first: usize| energy(&|k| truth[k].norm_sqr(), first);
                let floor = (0..=100).map(level_of).fold(0.0, f64::max) * noise_share();
                let off = |first: usize| {
                    let off = energy(&|k| (signal[k] - truth[k]).norm_sqr(), first);
                    (off / level_of(first).max(floor)).sqrt()
                };
                let measured = (0..=100).map(off).fold(0.0, f64::max);
                let crossing = Crossing {
                    sample,
                    error: (signal[sample] - truth[sample]).norm_sqr(),
                    level: truth[sample].norm_sqr(),
                };
                let got = worst_window(&signal, &[crossing], WINDOW);
                println!("{begins} {level} {sample}: {measured:.3}, found {got:.3}");
                assert!((got / measured - 1.0).abs() < 1e-6, "{got} {measured}");
            }
        }
    }

    /// Both edges of a stretched echo, a hundredth of a sample beside one.
    #[test]
    fn edges_are_near_as_far_as_they_may_move() {
        const RATE_HZ: f64 = 40e3;
        let (doppler, curvature_per_s, pulse_s) = (0.01, 0.5, 1e-3);
        let lasts_s = {
            // By iteration.
            let mut s = pulse_s;
            for _ in 0..20 {
                s = (pulse_s - curvature_per_s * s * s) / (1.0 + doppler);
            }
            s
        };
        let near = |delay_s: f64, shifts: [f64; 2]| {
            let mut chunk = ArrivalChunk::new();
            chunk.len = 1;
            (chunk.delay_s[0], chunk.doppler[0]) = (delay_s, doppler);
            chunk.curvature_per_s[0] = curvature_per_s;
            let mut edges = Edges {
                pulse_s,
                first_sample_s: 2e-3,
                rate_hz: RATE_HZ,
                shifts,
                near: Vec::new(),
            };
            edges.accept(&chunk);
            !edges.near.is_empty()
        };
        for sample in [100.0, 101.0] {
            let leading_s = 2e-3 + (sample + 0.01) / RATE_HZ;
            assert!(near(leading_s, [0.0101, 0.0]));
            assert!(!near(leading_s, [0.0099, 0.0]));
            let trailing_s = 2e-3 + (sample - 0.01) / RATE_HZ - lasts_s;
            assert!(near(trailing_s, [0.0, 0.0101]));
            assert!(!near(trailing_s, [0.0, 0.0099]));
        }
    }
}
