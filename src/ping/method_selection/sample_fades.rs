//! How far the windows of a ping fade, from its own samples.
//!
//! Before a ping, the energies of its echoes are known and their interference is not: the selection bounds by chance how much weaker than these
//! energies some window is ([`fades`]). After the ping the energy of every window is known, and with it what the phase errors of its echoes are
//! relative to.
//!
//! In: a ping of few scatterers with its samples, ahead of the receiver. Out: its [`EchoStatistics`]. Looked at are the ends of every array and the
//! elements with the largest errors as far as those of the ends tell.

use std::sync::Arc;

use echotank_config::spec::SonarSpec;
use echotank_core::arrays::{ArrayGeometry, ReceiverFilter};
use echotank_core::model::{PathModel, Synthesis};
use echotank_core::ping::{ElementFrame, PingPlan};
use echotank_core::pulse::{MIN_WINDOW, Pulse, noise_share};
use echotank_core::scene::Scatterers;
use echotank_synthesis::array::gridded::LEVELS;
use echotank_synthesis::array::{EchoEnds, echo_ends};
use echotank_synthesis::echo::Chord;
use echotank_synthesis::echo::levels::amplitude_from_db;
use echotank_synthesis::error_model::{Conditions, EchoStatistics, OVERLAPPING};
use glam::DVec3;
use num_complex::Complex64;

use crate::conditions::sound_speed_step_up;
use crate::element_synthesis::filter_design;
use crate::error_check::window_samples;
use crate::method_selection::echo_statistics::{
    ALONE, Energies, GROWTH, GROWTHS, Growth, OFF_PATH, OFF_VELOCITY, Part, Poses,
    ReceivingElement, SAMPLED, SINGLE, TRACKED, quantities,
};
use crate::method_selection::ends::{Echo, Ends, FEW, Record, error_of_phases, peak_of, peaks};
use crate::method_selection::fades;

/// So many echoes of a ping, the first ones, are looked at where there are too many to look at all: at the onset few interfere.
const FIRST: usize = 200;
/// Steps of a window in which the energies and errors of echoes are summed.
const STEPS: usize = 8;
/// Windows that begin within a step.
const OFFSETS: usize = 4;
/// Steps from one window to the next where the ends of echoes are looked for.
const STRIDE: usize = 2;
/// Blocks of a window whose energies tell the elements with the deepest fades.
const BLOCKS: usize = 4;
/// Instants of a ping at which an element's motion is tabled.
const INSTANTS: usize = 8;
/// Elements of an array that are looked at: both ends, and those with the largest errors as far as the ends tell; as many as have so many pairs,
/// within limits.
const ELEMENTS: (usize, usize) = (3, 16);
const PAIRS: usize = 3000;
/// ... and in all, after a ping that the direct sum makes: it takes so long for a pair that these count little.
const PAIRS_OF_DIRECT: usize = 3 * PAIRS;

/// Whether a ping has so few scatterers that all of them are looked at, before it: with the fewest elements of an array that this takes, at most [`PAIRS`]
/// pairs.
pub(super) fn are_few(spec: &SonarSpec, scatterers: &Scatterers) -> bool {
    pairs(spec, scatterers) <= PAIRS
}

/// ... and after it.
pub(super) fn are_heard(spec: &SonarSpec, scatterers: &Scatterers, synthesis: Synthesis) -> bool {
    let most = match synthesis {
        Synthesis::Direct => PAIRS_OF_DIRECT,
        _ => PAIRS,
    };
    pairs(spec, scatterers) <= most
}

/// The fewest pairs of scatterers and elements that are looked at.
fn pairs(spec: &SonarSpec, scatterers: &Scatterers) -> usize {
    let elements = spec.receive.iter().map(|array| array.elements);
    let fewest = elements.max().unwrap_or(1).min(ELEMENTS.0);
    scatterers.len() * fewest
}

/// Sums up to a sample.
#[derive(Clone, Copy, Default)]
struct Upto {
    /// Samples.
    end: usize,
    /// Step of the last sample, and what of the step's echoes counts up to it.
    step: usize,
    share: f64,
    /// Step of the next sample.
    next: usize,
    /// Of the samples, and of the echoes that they are made of.
    level: f64,
    energy: f64,
    /// ... of the loudest echo of each step.
    loudest: f64,
}

/// Sums over the steps before one.
#[derive(Clone, Copy, Default)]
struct Before {
    begun: f64,
    sums: [f64; TRACKED],
    squares: [f64; TRACKED],
}

/// Of the worst windows of a ping, each of these by itself, as in [`EchoStatistics`].
#[derive(Default)]
struct Worst {
    amounts: [f64; TRACKED],
    fading: f64,
    tails: f64,
    ends: f64,
}

/// What is predicted of a ping without its samples.
#[derive(Clone, Copy)]
pub(super) struct Predicted<'a> {
    pub statistics: EchoStatistics,
    /// Error for each unit of a quantity.
    pub weights: &'a [f64; TRACKED],
    /// Errors that the engine makes of a whole echo, and by the levels of windows, over that in the worst window; none of other methods.
    pub over_window: Option<(f64, [f64; LEVELS])>,
}

/// What is known of windows with many echoes.
struct Bounds {
    amounts: [f64; TRACKED],
    fading: f64,
    /// The ends of an echo, of filters that can be designed; and whether they count with the errors of an engine.
    ends: Option<Arc<EchoEnds>>,
    looks_at_engine: bool,
}

/// What is known of a single echo.
struct Tables {
    pulse: Pulse,
    sound_speed_m_per_s: f64,
    energies: Energies,
    /// None of filters that cannot be designed, which are refused elsewhere.
    ends: Option<Arc<EchoEnds>>,
}

impl Tables {
    /// Those of the ping before, if they hold for this one. The receiver is the same.
    fn of(spec: &SonarSpec, plan: &PingPlan, before: Option<Box<Self>>) -> Box<Self> {
        let c = sound_speed_step_up(plan.sound_speed_m_per_s);
        if let Some(same) = before.filter(|b| b.pulse == plan.pulse && b.sound_speed_m_per_s == c) {
            return same;
        }
        let filter = filter_design(spec, Synthesis::Direct, c);
        Box::new(Self {
            pulse: plan.pulse,
            sound_speed_m_per_s: c,
            energies: Energies::new(&plan.pulse).with_displaced_ends(spec, plan),
            ends: echo_ends(plan, spec.receiver.sample_rate_hz, filter, Growth::SHAPES).ok(),
        })
    }
}

/// Buffers for one element.
#[derive(Default)]
pub(super) struct WindowStatistics {
    parts: Vec<Part>,
    before: Vec<Before>,
    upto: Vec<Upto>,
    levels: Vec<f64>,
    /// Expected energies of errors, by window.
    profile: Vec<f64>,
    /// Elements that are looked at; and the others with the errors that are expected of them.
    looked_at: Vec<usize>,
    others: Vec<(f64, usize)>,
    /// Of all windows.
    amounts: Vec<[f64; TRACKED]>,
    onset: Onset,
    ends: Ends,
    /// Of the last ping.
    tables: Option<Box<Tables>>,
    /// From the phases of windows that hold no more than the ends of echoes.
    error_of_ends: f64,
    /// Of the platform's track, with `k-segment`.
    chords: Vec<Chord>,
}

/// The scatterers heard first. Buffers.
#[derive(Default)]
struct Onset {
    first: Scatterers,
    delays_s: Vec<(f64, usize)>,
    /// Scatterers that may be, and ways of all.
    near: Vec<usize>,
    ways_m: Vec<f64>,
    /// Transmitter and element, world, metres.
    ends_m: Vec<[DVec3; 2]>,
}

impl Onset {
    /// Finds the first [`FIRST`] scatterers, and the delay of the next in seconds, at least. `ends_m`: transmitters and elements at the transmission,
    /// world, metres; `moving`: the share of the speed of sound at which they move.
    fn find(
        &mut self,
        ends_m: impl Iterator<Item = [DVec3; 2]>,
        c: f64,
        moving: f64,
        scatterers: &Scatterers,
    ) -> f64 {
        self.ends_m.clear();
        self.ends_m.extend(ends_m);
        let mut next_s = f64::INFINITY;
        self.delays_s.clear();
        if scatterers.len() > FIRST {
            self.find_near(scatterers);
            let Self {
                near,
                ends_m,
                delays_s,
                ..
            } = self;
            let closing = 1.0 - 2.0 * moving;
            let delay_s = |i: usize| {
                let ways_m = ends_m.iter().map(|[transmit_m, element_m]| {
                    let out_m = scatterers.transmit_m(i).distance(*transmit_m);
                    out_m + scatterers.position_m(i).distance(*element_m)
                });
                ways_m.fold(f64::INFINITY, f64::min) * closing / c
            };
            delays_s.extend(near.iter().map(|&i| (delay_s(i), i)));
            let earlier = |a: &(f64, usize), b: &(f64, usize)| a.0.total_cmp(&b.0);
            next_s = delays_s.select_nth_unstable_by(FIRST, earlier).1.0;
            delays_s.truncate(FIRST);
        } else {
            self.delays_s
                .extend((0..scatterers.len()).map(|i| (0.0, i)));
        }
        self.first.clear();
        self.first.curve.clone_from(&scatterers.curve);
        for (_, i) in &self.delays_s {
            self.first.push_copy(scatterers, *i, 1.0);
        }
        next_s
    }

    /// Finds some scatterers among which the first [`FIRST`] are, and the next: by their ways from one point amid all ends, which differ from the others by
    /// two distances of an end from there at most.
    fn find_near(&mut self, scatterers: &Scatterers) {
        let all_m = || self.ends_m.iter().flatten();
        let amid_m = all_m().sum::<DVec3>() / all_m().count().max(1) as f64;
        let arms_m = all_m().map(|end_m| end_m.distance(amid_m));
        let arm_m = arms_m.fold(0.0, f64::max);
        let way_m = |i: usize| {
            let back_m = scatterers.position_m(i).distance(amid_m);
            match scatterers.transmit.is_empty() {
                true => 2.0 * back_m,
                false => back_m + scatterers.transmit_m(i).distance(amid_m),
            }
        };
        let Self { near, ways_m, .. } = self;
        ways_m.clear();
        ways_m.extend((0..scatterers.len()).map(way_m));
        // For the selection, which changes their order.
        let len = ways_m.len();
        ways_m.extend_from_within(..);
        let (ways_m, copy_m) = ways_m.split_at_mut(len);
        let next_m = *copy_m.select_nth_unstable_by(FIRST, f64::total_cmp).1;
        near.clear();
        near.extend((0..len).filter(|&i| ways_m[i] <= next_m + 4.0 * arm_m));
    }
}

impl WindowStatistics {
    /// [`Self::of_samples`] of the windows in which no more than the first [`FIRST`] echoes sound.
    pub(super) fn of_onset(
        &mut self,
        spec: &SonarSpec,
        plan: &PingPlan,
        scatterers: &Scatterers,
        frames: &[ElementFrame],
        of: Predicted,
    ) -> EchoStatistics {
        let mut onset = std::mem::take(&mut self.onset);
        let pose = plan.trajectory.pose_at(0.0);
        let ends_m = spec.receive.iter().flat_map(|array| {
            let transmit_m = spec.transmit[array.transmit].mounting.position_m;
            let pose = &pose;
            array.outermost().map(move |e| {
                [transmit_m, array.element_body_m(e)].map(|end_m| pose.point_m(end_m))
            })
        });
        let c = plan.sound_speed_m_per_s;
        let until_s = onset.find(ends_m, c, pose.velocity_m_per_s.length() / c, scatterers);
        let statistics = self.of_samples_until(spec, plan, &onset.first, (frames, until_s), of);
        self.onset = onset;
        statistics
    }

    /// The statistics of a ping with the fades that its windows have, and what is predicted for the rest.
    pub(super) fn of_samples(
        &mut self,
        spec: &SonarSpec,
        plan: &PingPlan,
        scatterers: &Scatterers,
        frames: &[ElementFrame],
        of: Predicted,
    ) -> EchoStatistics {
        self.of_samples_until(spec, plan, scatterers, (frames, f64::INFINITY), of)
    }

    /// The same of the windows before `until_s`, seconds after the transmission.
    fn of_samples_until(
        &mut self,
        spec: &SonarSpec,
        plan: &PingPlan,
        scatterers: &Scatterers,
        (frames, until_s): (&[ElementFrame], f64),
        Predicted {
            statistics: predicted,
            weights,
            over_window,
        }: Predicted,
    ) -> EchoStatistics {
        let tables = Tables::of(spec, plan, self.tables.take());
        let (energies, ends) = (&tables.energies, &tables.ends);
        let rate_hz = spec.receiver.sample_rate_hz;
        let echo = energies.mean * plan.pulse.duration_s * rate_hz;
        let count = match until_s < f64::INFINITY {
            // Of many echoes, only the onset: the ends of an array tell about as much of it as its other elements.
            true => ELEMENTS.0,
            false => (PAIRS / scatterers.len().max(1)).clamp(ELEMENTS.0, ELEMENTS.1),
        };
        if let (Some((whole, by_level)), Some(ends)) = (over_window, ends) {
            let most = (OVERLAPPING * whole).powi(2).min(1.0);
            self.ends.count(ends, most, &by_level);
        }
        let mut before = predicted;
        let mut bounds = Bounds {
            amounts: [f64::INFINITY; TRACKED],
            fading: predicted.fading,
            looks_at_engine: over_window.is_some() && ends.is_some(),
            ends: ends.clone(),
        };
        for (bound, value) in bounds.amounts.iter_mut().zip(quantities(&mut before)) {
            *bound = *value;
        }
        let mut worst = Worst {
            fading: OVERLAPPING,
            ends: match bounds.looks_at_engine {
                true => 0.0,
                false => predicted.ends,
            },
            ..Worst::default()
        };
        self.amounts.clear();
        self.error_of_ends = 0.0;
        self.chords.clear();
        if plan.model.path == PathModel::KSegment {
            Chord::all(plan, &mut self.chords);
        }
        let poses = Poses::of(&plan.trajectory);
        for (array, frame) in spec.receive.iter().zip(frames) {
            if frame.samples == 0 {
                continue;
            }
            let window = window_samples(plan.pulse.duration_s, rate_hz).min(frame.samples);
            let step = window as f64 / STEPS as f64;
            let steps = (until_s * rate_hz - tail_samples(spec)) / step;
            let samples = steps.floor() * step - plan.first_sample_s * rate_hz;
            let samples = (samples.max(0.0) as usize).min(frame.samples);
            if samples < window {
                continue;
            }
            let transmit = &spec.transmit[array.transmit];
            let level_db = plan.settings.source_level_db + transmit.level_offset_db;
            let pulse = amplitude_from_db(level_db + array.sensitivity_db).powi(2) * echo;
            self.profile.clear();
            self.looked_at.clear();
            let outermost = array.outermost().take(array.elements);
            self.looked_at.extend(outermost);
            let outermost = self.looked_at.len();
            let mut k = 0;
            while let Some(&element) = self.looked_at.get(k) {
                let of = (array, element);
                let until = steps.max(1.0) as usize;
                self.accumulate(
                    spec,
                    (plan, &poses),
                    scatterers,
                    of,
                    (energies, window, until),
                    weights,
                );
                if k < outermost {
                    let first = plan.first_sample_s * rate_hz;
                    self.add_to_profile(window, samples, first, weights);
                }
                let of = (energies, &bounds);
                let signal = frame.element(element);
                let strongest = match samples == signal.len() {
                    true => 0.0,
                    false => strongest_window(signal, window) / pulse,
                };
                let signal = (&signal[..samples], strongest);
                self.find_worst((spec, plan), signal, window, pulse, of, &mut worst);
                k += 1;
                if k == outermost {
                    self.find_largest_errors(frame, window, pulse, count);
                }
            }
        }
        self.tables = Some(tables);
        let mut statistics = EchoStatistics {
            fading: worst.fading,
            tails: worst.tails,
            ends: worst.ends,
            off_path_m: Some(worst.amounts[OFF_PATH]),
            off_velocity_m_per_s: Some(worst.amounts[OFF_VELOCITY]),
            ..predicted
        };
        for (value, worst) in quantities(&mut statistics).into_iter().zip(worst.amounts) {
            *value = worst;
        }
        statistics
    }

    /// What errors in proportion to the quantities amount to in the worst window, over the sum of what each of them amounts to in its worst window.
    pub(super) fn jointly(&self, weights: &[f64; TRACKED]) -> f64 {
        let mut largest = [0.0f64; TRACKED];
        for amounts in &self.amounts {
            for (largest, amount) in largest.iter_mut().zip(amounts) {
                *largest = largest.max(*amount);
            }
        }
        let error = |amounts: &[f64; TRACKED]| -> f64 {
            amounts.iter().zip(weights).map(|(a, w)| a * w).sum()
        };
        let worst = self.amounts.iter().map(error).fold(0.0, f64::max);
        let apart = error(&largest);
        if apart > 0.0 { worst / apart } else { 1.0 }
    }

    /// The error of path and Doppler in the worst window of ends of echoes.
    pub(super) fn error_of_ends(&self) -> f64 {
        Conditions::error_of_phase(self.error_of_ends)
    }

    /// Raises the expected energies of errors, window by window, to those of the element that was summed last.
    fn add_to_profile(
        &mut self,
        window: usize,
        samples: usize,
        first: f64,
        weights: &[f64; TRACKED],
    ) {
        let block = (window / BLOCKS).max(1);
        let windows = (samples / block).saturating_sub(BLOCKS) + 1;
        self.profile.resize(windows, 0.0);
        let step = window as f64 / STEPS as f64;
        for (k, energy) in self.profile.iter_mut().enumerate() {
            let begin = ((first + (k * block) as f64) / step) as usize;
            let parts = self.parts.iter().skip(begin).take(STEPS + 1);
            let error = parts.map(|part| {
                let squares = part.squares.iter().zip(weights);
                squares.map(|(square, w)| w * w * square).sum::<f64>()
            });
            *energy = energy.max(error.sum());
        }
    }

    /// Completes the elements that are looked at to `count`, by those in which some window has the largest errors.
    fn find_largest_errors(
        &mut self,
        frame: &ElementFrame,
        window: usize,
        pulse: f64,
        count: usize,
    ) {
        let block = (window / BLOCKS).max(1);
        let Self {
            levels,
            profile,
            looked_at,
            others,
            ..
        } = self;
        others.clear();
        for e in (0..frame.elements).filter(|e| !looked_at.contains(e)) {
            levels.clear();
            levels.resize(profile.len(), 0.0);
            let blocks = profile.len() + BLOCKS - 1;
            for (k, block) in frame.element(e).chunks(block).take(blocks).enumerate() {
                let level = block.iter().map(|x| x.norm_sqr()).sum::<f64>() / pulse;
                let windows = k.saturating_sub(BLOCKS - 1)..=k.min(profile.len() - 1);
                for window in &mut levels[windows] {
                    *window += level;
                }
            }
            let floor = levels.iter().copied().fold(0.0, f64::max) * noise_share();
            let errors = levels.iter().zip(&*profile);
            let errors = errors.map(|(level, error)| error / level.max(floor));
            others.push((errors.fold(0.0, f64::max), e));
        }
        others.sort_by(|a, b| b.0.total_cmp(&a.0));
        let more = count.saturating_sub(looked_at.len());
        looked_at.extend(others.iter().take(more).map(|(_, e)| *e));
    }

    /// Sums the echoes of an element in [`Self::parts`], step by step, of steps before `until`.
    fn accumulate(
        &mut self,
        spec: &SonarSpec,
        (plan, poses): (&PingPlan, &Poses),
        scatterers: &Scatterers,
        (array, element): (&ArrayGeometry, usize),
        (energies, window, until): (&Energies, usize, usize),
        weights: &[f64; TRACKED],
    ) {
        let rate_hz = spec.receiver.sample_rate_hz;
        let step_s = window as f64 / rate_hz / STEPS as f64;
        // Behind the receiver filter, what begins soon after the record is heard at its end.
        let heard_s = plan.window_s(rate_hz) + tail_samples(spec) / rate_hz;
        let steps = ((heard_s / step_s).ceil() as usize + 1).min(until);
        self.parts.clear();
        self.parts.resize(steps, Part::default());
        let transmit = &spec.transmit[array.transmit];
        let receiver = ReceivingElement::alone(
            spec,
            (plan, poses, &self.chords),
            transmit,
            (array, element),
            INSTANTS,
        );
        let Self { parts, ends, .. } = self;
        ends.echoes.clear();
        receiver.accumulate(
            plan,
            scatterers,
            energies,
            step_s,
            parts,
            |begins_s, energy, values| {
                let [mut phases, mut magnitudes] = [[0.0; GROWTHS]; 2];
                for ((value, weight), growth) in values.iter().zip(weights).zip(GROWTH) {
                    phases[growth as usize] += value * weight;
                    magnitudes[growth as usize] += (value * weight).abs();
                }
                ends.echoes.push(Echo {
                    begins: (begins_s - plan.first_sample_s) * rate_hz,
                    energy,
                    phases,
                    magnitudes,
                });
            },
        );
    }

    /// Sums samples and echoes of an element in [`Self::upto`] and [`Self::before`]. `pulse`: the sum of the squares of an echo of unit strength, volts
    /// squared; `first`: the first sample's number since the ping; `step`: samples of a step; `stride`: samples of a piece, at most.
    fn sum_up(&mut self, signal: &[Complex64], pulse: f64, first: f64, step: f64, stride: usize) {
        let Self {
            parts,
            before,
            upto,
            ..
        } = self;
        let last = parts.len() - 1;
        let step_of = |k: usize| (((first + k as f64) / step) as usize).min(last);
        before.clear();
        before.resize(parts.len() + 1, Before::default());
        upto.clear();
        let begins = step_of(0);
        upto.push(Upto {
            step: begins,
            next: begins,
            ..Upto::default()
        });
        let mut sum = Upto::default();
        let mut begin = 0;
        for (s, part) in parts.iter().enumerate() {
            before[s + 1].begun = before[s].begun + part.begun;
            let ends = ((s + 1) as f64 * step - first).ceil().max(0.0) as usize;
            let end = match s == last {
                true => signal.len(),
                false => ends.clamp(begin, signal.len()),
            };
            let samples = &signal[begin..end];
            let level = samples.iter().map(|x| x.norm_sqr()).sum::<f64>() / pulse;
            // A lone echo does not fade: where it has less energy than it should, its onset lies elsewhere within the step.
            let is_alone = part.energy < SINGLE * part.loudest_here;
            let scale = match is_alone && level < part.energy {
                true => level / part.energy,
                false => 1.0,
            };
            sum.share = 0.0;
            for piece in samples.chunks(stride) {
                let here = piece.iter().map(|x| x.norm_sqr()).sum::<f64>() / pulse;
                let share = match level > 0.0 {
                    true => here / level,
                    false => piece.len() as f64 / samples.len() as f64,
                };
                sum.end += piece.len();
                (sum.step, sum.next) = (s, step_of(sum.end));
                sum.share += scale * share;
                sum.level += here;
                sum.energy += scale * share * part.energy;
                sum.loudest += scale * share * part.loudest_here;
                upto.push(sum);
            }
            let heard = if samples.is_empty() { 0.0 } else { scale };
            for q in 0..TRACKED {
                before[s + 1].sums[q] = before[s].sums[q] + heard * part.sums[q];
                before[s + 1].squares[q] = before[s].squares[q] + heard * part.squares[q];
            }
            begin = end;
        }
    }

    /// Raises `worst` to the worst windows of an element. `loudest`: what some window has at least; `pulse`: the sum of the squares of an echo of unit
    /// strength, volts squared. Of many echoes, `bounds` hold too.
    fn find_worst(
        &mut self,
        (spec, plan): (&SonarSpec, &PingPlan),
        (signal, loudest): (&[Complex64], f64),
        window: usize,
        pulse: f64,
        (energies, bounds): (&Energies, &Bounds),
        worst: &mut Worst,
    ) {
        let rate_hz = spec.receiver.sample_rate_hz;
        let step = window as f64 / STEPS as f64;
        let first = plan.first_sample_s * rate_hz;
        let stride = (window / (STEPS * OFFSETS)).max(1);
        self.sum_up(signal, pulse, first, step, stride);
        let pieces = self.upto.as_slice();
        // Windows of the length of a pulse or a little more, from the end of one piece to that of another.
        let windows = || {
            let mut first = 0;
            (1..pieces.len()).filter_map(move |last| {
                while pieces[last].end - pieces[first + 1].end >= window {
                    first += 1;
                }
                let is_whole = pieces[last].end - pieces[first].end >= window;
                is_whole.then_some((&pieces[first], &pieces[last]))
            })
        };
        let strongest = windows().map(|(from, to)| to.level - from.level);
        let floor = strongest.fold(loudest, f64::max) * noise_share();
        let against = |level: f64| level.max(floor).max(f64::MIN_POSITIVE);
        let independent = fades::independent_of_pulse(&plan.pulse, window as f64 / rate_hz);
        let peaks = peaks(independent);
        // The receiver filter answers so long before and after an echo, and echoes that began so many steps ago may still sound.
        let tail = tail_samples(spec);
        let ago = ((plan.pulse.duration_s * rate_hz + tail) / step).ceil() as usize;
        let ahead = (tail / step).ceil() as usize;
        let mut tails2 = 0.0f64;
        // Of the windows that end in one step, the one that fades the most.
        let mut deepest: Option<(f64, (&Upto, &Upto))> = None;
        let mut amounts = std::mem::take(&mut self.amounts);
        for window in windows() {
            let (from, to) = window;
            let against = against(to.level - from.level);
            let until = (to.step + 1 + ahead).min(self.parts.len());
            let since = from.next.saturating_sub(ago);
            let begun = self.before[until].begun - self.before[since].begun;
            tails2 = tails2.max(begun / against);
            let ratio = (to.energy - from.energy) / against;
            if let Some((_, window)) = deepest.take_if(|(_, (_, last))| last.step != to.step) {
                amounts.extend(self.amounts_of(window, (floor, peaks), bounds, worst));
            }
            if deepest.is_none_or(|(most, _)| ratio > most) {
                deepest = Some((ratio, window));
            }
        }
        if let Some((_, window)) = deepest {
            amounts.extend(self.amounts_of(window, (floor, peaks), bounds, worst));
        }
        self.amounts = amounts;
        worst.tails = worst.tails.max(OVERLAPPING * tails2.sqrt());
        if let Some(ends) = &bounds.ends {
            let record = Record {
                signal,
                window,
                pulse: plan.pulse.duration_s * rate_hz,
                of_unit: pulse,
                floor,
            };
            self.ends.hear(&record);
            if bounds.looks_at_engine {
                worst.ends = worst.ends.max(self.ends.worst(&record, ends));
            }
            let of_phases = self.ends.worst_phase(&record, ends, peaks);
            self.error_of_ends = self.error_of_ends.max(of_phases);
        }
        self.find_ends(floor, energies, worst);
    }

    /// What the quantities amount to in a window, to which `worst` is raised; none where nothing sounds. `peaks`: of few echoes and of many.
    fn amounts_of(
        &self,
        (from, to): (&Upto, &Upto),
        (floor, peaks): (f64, [f64; 2]),
        bounds: &Bounds,
        worst: &mut Worst,
    ) -> Option<[f64; TRACKED]> {
        let energy = to.energy - from.energy;
        if energy <= 0.0 {
            return None;
        }
        let level = to.level - from.level;
        let against = level.max(floor).max(f64::MIN_POSITIVE);
        // Of what sounds at the same time: at the onset of several echoes, none of them sounds as a whole.
        let loudest = (to.loudest - from.loudest).max(f64::MIN_POSITIVE);
        let crowd = (energy / loudest).max(1.0);
        let ratio = peak_of(crowd, peaks) * energy / against;
        let faded = OVERLAPPING * ratio.sqrt();
        worst.fading = worst.fading.max(if crowd < FEW {
            faded
        } else {
            faded.min(bounds.fading)
        });
        let margin = if crowd < SINGLE { SAMPLED } else { OVERLAPPING };
        let mut amounts = [0.0; TRACKED];
        for (q, amount) in amounts.iter_mut().enumerate() {
            let [begin, end] = [from, to].map(|upto| {
                let (before, part) = (&self.before[upto.step], &self.parts[upto.step]);
                let sum = before.sums[q] + upto.share * part.sums[q];
                let square = before.squares[q] + upto.share * part.squares[q];
                (sum, square)
            });
            let square = (end.1 - begin.1).max(0.0) / energy;
            let mean = (end.0 - begin.0).abs() / energy;
            let sum = error_of_phases(mean, square, ratio, level / against);
            let bound = match crowd < FEW {
                true => f64::INFINITY,
                false => bounds.amounts[q],
            };
            *amount = (margin * sum).min(bound);
            worst.amounts[q] = worst.amounts[q].max(*amount);
        }
        Some(amounts)
    }

    /// Raises `worst` to the quantities of windows with no more than the ends of echoes, which may be cut anywhere.
    fn find_ends(&mut self, floor: f64, energies: &Energies, worst: &mut Worst) {
        for parts in self.parts.windows(STEPS).step_by(STRIDE) {
            let window = parts.iter().fold(Part::default(), Part::and);
            if window.energy <= 0.0 {
                continue;
            }
            let heard = (window.energy / floor.max(f64::MIN_POSITIVE))
                .sqrt()
                .min(1.0);
            let is_alone = window.energy < ALONE * window.loudest;
            let share = window.ends / window.energy;
            let mut amounts = [0.0; TRACKED];
            for q in 0..TRACKED {
                let rms = (window.squares[q] / window.energy).sqrt();
                // A short pulse may have more than its last quarter in a step.
                let worst_over_rms = match is_alone {
                    true => energies.last_over(GROWTH[q], window.energy / window.loudest),
                    false => energies.last[GROWTH[q] as usize] * share,
                };
                let amount = rms * worst_over_rms * heard;
                amounts[q] = amount;
                worst.amounts[q] = worst.amounts[q].max(amount);
            }
            self.amounts.push(amounts);
        }
    }
}

/// So many samples the receiver filter answers before and after an echo.
fn tail_samples(spec: &SonarSpec) -> f64 {
    match spec.receiver.filter {
        ReceiverFilter::Fir => MIN_WINDOW,
        ReceiverFilter::None => 0.0,
    }
}

/// Energy of the strongest window.
fn strongest_window(signal: &[Complex64], window: usize) -> f64 {
    let mut sum: f64 = signal[..window].iter().map(|x| x.norm_sqr()).sum();
    let mut strongest = sum;
    for (leaving, entering) in signal.iter().zip(&signal[window..]) {
        sum += entering.norm_sqr() - leaving.norm_sqr();
        strongest = strongest.max(sum);
    }
    strongest
}

#[cfg(test)]
mod tests {
    use super::*;
    use echotank_core::scene::ScatterLaw;

    /// Scatterers ahead at growing ranges, in any order: the nearest are found, and the next bounds their windows.
    #[test]
    fn the_first_echoes_of_a_ping_are_found() {
        let mut scatterers = Scatterers::default();
        let count = 3 * FIRST;
        for k in 0..count {
            // 7 has no factor in common with the count.
            let range_m = 5.0 + 0.01 * ((7 * k) % count) as f64;
            let law = ScatterLaw::Point;
            scatterers.push(DVec3::Z * range_m, [0.0; 3], Complex64::ONE, law);
        }
        let mut onset = Onset::default();
        // The second end is 1 m nearer.
        let ends_m = [[DVec3::ZERO; 2], [DVec3::ZERO, DVec3::Z]];
        let next_s = onset.find(ends_m.into_iter(), 1500.0, 0.01, &scatterers);
        let farthest_m = onset.first.down_m.iter().copied().fold(0.0, f64::max);
        assert_eq!(onset.first.len(), FIRST);
        assert!((farthest_m - (5.0 + 0.01 * (FIRST - 1) as f64)).abs() < 1e-9);
        let next_m = 5.0 + 0.01 * FIRST as f64;
        assert!((next_s * 1500.0 / (0.98 * (2.0 * next_m - 1.0)) - 1.0).abs() < 1e-9);
    }

    /// Onsets of one or two echoes in a window, a tenth of each, whose samples are weaker than they are by themselves. Two may cancel, and their errors
    /// add up; one does not.
    #[test]
    fn onsets_of_two_echoes_may_cancel() {
        let fading = |echoes: f64| {
            let part = Part {
                energy: 0.1 * echoes,
                loudest: 1.0,
                loudest_here: 0.1,
                ..Part::default()
            };
            let windows = WindowStatistics {
                parts: vec![part],
                before: vec![Before::default(); 2],
                ..WindowStatistics::default()
            };
            let (from, to) = (
                Upto::default(),
                Upto {
                    share: 1.0,
                    level: 0.01,
                    energy: part.energy,
                    loudest: part.loudest_here,
                    ..Upto::default()
                },
            );
            let bounds = Bounds {
                amounts: [f64::INFINITY; TRACKED],
                fading: f64::INFINITY,
                ends: None,
                looks_at_engine: false,
            };
            let peaks = [peaks(1.0)[0], 1.0];
            let mut worst = Worst::default();
            windows
                .amounts_of((&from, &to), (1e-6, peaks), &bounds, &mut worst)
                .expect("a window that sounds");
            worst.fading
        };
        let of_one = OVERLAPPING * 10f64.sqrt();
        assert!((fading(1.0) / of_one - 1.0).abs() < 1e-9, "{}", fading(1.0));
        let of_two = of_one * (2.0 * 4.0f64).sqrt();
        assert!((fading(2.0) / of_two - 1.0).abs() < 1e-9, "{}", fading(2.0));
    }
}
