//! How far the windows of a ping fade, from its own samples.
//!
//! Before a ping, the energies of its echoes are known and their interference is not: the selection bounds by chance how much weaker than these
//! energies some window is ([`fades`]). After the ping the energy of every window is known, and with it what the phase errors of its echoes are
//! relative to.
//!
//! In: a ping of few scatterers with its samples, ahead of the receiver. Out: its [`EchoStatistics`]. Looked at are the ends of every array and the
//! elements with the largest errors as far as those of the ends tell.

use echotank_config::spec::SonarSpec;
use echotank_core::arrays::{ArrayGeometry, ReceiverFilter};
use echotank_core::ping::{ElementFrame, PingPlan};
use echotank_core::pulse::{MIN_WINDOW, noise_share};
use echotank_core::scene::Scatterers;
use echotank_synthesis::echo::levels::amplitude_from_db;
use echotank_synthesis::error_model::EchoStatistics;
use num_complex::Complex64;

use crate::error_check::window_samples;
use crate::method_selection::echo_statistics::{
    ALONE, Energies, GROWTH, OVERLAPPING, Part, QUANTITIES, ReceivingElement, SAMPLED, SINGLE,
    TRACKED, quantities,
};
use crate::method_selection::fades;

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
/// Elements of an array that are looked at: both ends, and those with the largest errors as far as the ends tell. Of many scatterers only as many
/// elements as have so many pairs.
const ELEMENTS: usize = 4;
const MIN_ELEMENTS: usize = 3;
const PAIRS: usize = 3000;
/// Logarithm of the number of windows that fade about as deep as the deepest: so many chances the errors in them have to add up.
const LOOKS: f64 = 3.0;
/// With fewer echoes than this in a window, some pair of them may keep its phase difference in all of it.
const FEW: f64 = 8.0;
/// Degrees of freedom of the energy of echoes that keep their phase differences.
const OF_FEW: f64 = 1.0;

/// Sums up to a sample: level, energy of the echoes, and the weighted sums and squares of their quantities.
#[derive(Clone, Copy, Default)]
struct Upto {
    /// Samples.
    end: usize,
    level: f64,
    energy: f64,
    sums: [f64; TRACKED],
    squares: [f64; TRACKED],
}

/// Of the worst windows of a ping, each of these by itself, as in [`EchoStatistics`].
#[derive(Default)]
struct Worst {
    amounts: [f64; TRACKED],
    fading: f64,
    tails: f64,
}

/// Buffers for one element.
#[derive(Default)]
pub(super) struct WindowStatistics {
    parts: Vec<Part>,
    upto: Vec<Upto>,
    levels: Vec<f64>,
    /// Expected energies of errors, by window.
    profile: Vec<f64>,
    /// Of all windows.
    amounts: Vec<[f64; TRACKED]>,
}

impl WindowStatistics {
    /// The statistics of a ping with the fades that its windows have, and `predicted` for the rest. `weights`: error for each unit of a quantity.
    pub(super) fn of_samples(
        &mut self,
        spec: &SonarSpec,
        plan: &PingPlan,
        scatterers: &Scatterers,
        frames: &[ElementFrame],
        (predicted, weights): (EchoStatistics, &[f64; TRACKED]),
    ) -> EchoStatistics {
        let energies = Energies::new(&plan.pulse).with_displaced_ends(spec, plan);
        let rate_hz = spec.receiver.sample_rate_hz;
        let echo = energies.mean * plan.pulse.duration_s * rate_hz;
        let count = (PAIRS / scatterers.len().max(1)).clamp(MIN_ELEMENTS, ELEMENTS);
        let mut before = predicted;
        let mut bounds = [f64::INFINITY; TRACKED];
        for (bound, value) in bounds.iter_mut().zip(quantities(&mut before)) {
            *bound = *value;
        }
        let mut worst = Worst {
            fading: OVERLAPPING,
            ..Worst::default()
        };
        self.amounts.clear();
        for (array, frame) in spec.receive.iter().zip(frames) {
            if frame.samples == 0 {
                continue;
            }
            let window = window_samples(plan.pulse.duration_s, rate_hz).min(frame.samples);
            let transmit = &spec.transmit[array.transmit];
            let level_db = plan.settings.source_level_db + transmit.level_offset_db;
            let pulse = amplitude_from_db(level_db + array.sensitivity_db).powi(2) * echo;
            self.profile.clear();
            let mut elements = [0, array.elements - 1, usize::MAX, usize::MAX];
            for k in 0..count {
                if k == 2 {
                    let [first, second] = self.largest_errors(frame, window, pulse, &elements[..2]);
                    (elements[2], elements[3]) = (first, second);
                }
                let element = elements[k];
                if element == usize::MAX || elements[..k].contains(&element) {
                    continue;
                }
                self.accumulate(spec, plan, scatterers, (array, element), &energies, window);
                if k < 2 {
                    let first = plan.first_sample_s * rate_hz;
                    self.add_to_profile(window, frame.samples, first, weights);
                }
                let of = (&energies, &bounds);
                let signal = frame.element(element);
                self.find_worst((spec, plan), signal, window, pulse, of, &mut worst);
            }
        }
        let mut statistics = EchoStatistics {
            fading: worst.fading,
            tails: worst.tails,
            off_path_m: Some(worst.amounts[QUANTITIES]),
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

    /// The two elements of an array in which some window has the largest error, besides `others`.
    fn largest_errors(
        &mut self,
        frame: &ElementFrame,
        window: usize,
        pulse: f64,
        others: &[usize],
    ) -> [usize; 2] {
        let block = (window / BLOCKS).max(1);
        let Self {
            levels, profile, ..
        } = self;
        let mut largest = [(0.0, usize::MAX); 2];
        for e in (0..frame.elements).filter(|e| !others.contains(e)) {
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
            let error = errors.fold(0.0, f64::max);
            if error > largest[0].0 {
                largest = [(error, e), largest[0]];
            } else if error > largest[1].0 {
                largest[1] = (error, e);
            }
        }
        largest.map(|(_, element)| element)
    }

    /// Sums the echoes of an element in [`Self::parts`], step by step.
    fn accumulate(
        &mut self,
        spec: &SonarSpec,
        plan: &PingPlan,
        scatterers: &Scatterers,
        (array, element): (&ArrayGeometry, usize),
        energies: &Energies,
        window: usize,
    ) {
        let rate_hz = spec.receiver.sample_rate_hz;
        let step_s = window as f64 / rate_hz / STEPS as f64;
        let steps = (plan.window_s(rate_hz) / step_s).ceil() as usize + 1;
        self.parts.clear();
        self.parts.resize(steps, Part::default());
        let transmit = &spec.transmit[array.transmit];
        let receiver =
            ReceivingElement::new(spec, plan, transmit, (array, element), INSTANTS).alone();
        receiver.accumulate(plan, scatterers, energies, step_s, &mut self.parts);
    }

    /// Raises `worst` to the worst windows of an element. `pulse`: the sum of the squares of an echo of unit strength, volts squared. Of many echoes,
    /// `bounds` hold too.
    fn find_worst(
        &mut self,
        (spec, plan): (&SonarSpec, &PingPlan),
        signal: &[Complex64],
        window: usize,
        pulse: f64,
        (energies, bounds): (&Energies, &[f64; TRACKED]),
        worst: &mut Worst,
    ) {
        let rate_hz = spec.receiver.sample_rate_hz;
        let step = window as f64 / STEPS as f64;
        let first = plan.first_sample_s * rate_hz;
        let step_of = |k: usize| (((first + k as f64) / step) as usize).min(self.parts.len() - 1);
        let stride = (window / (STEPS * OFFSETS)).max(1);
        let mut upto = std::mem::take(&mut self.upto);
        upto.clear();
        upto.push(Upto::default());
        let mut begin = 0;
        while begin < signal.len() {
            let s = step_of(begin);
            let mut end = begin + 1;
            while end < signal.len() && step_of(end) == s {
                end += 1;
            }
            let part = &self.parts[s];
            let samples = &signal[begin..end];
            let level = samples.iter().map(|x| x.norm_sqr()).sum::<f64>() / pulse;
            // A lone echo does not fade: where it has less energy than it should, its onset lies elsewhere within the step.
            let is_alone = part.energy < SINGLE * part.loudest_here;
            let scale = match is_alone && level < part.energy {
                true => level / part.energy,
                false => 1.0,
            };
            for samples in samples.chunks(stride) {
                let mut next = upto.last().copied().unwrap_or_default();
                let here = samples.iter().map(|x| x.norm_sqr()).sum::<f64>() / pulse;
                let share = match level > 0.0 {
                    true => here / level,
                    false => samples.len() as f64 / (end - begin) as f64,
                };
                next.end += samples.len();
                next.level += here;
                next.energy += scale * share * part.energy;
                for q in 0..TRACKED {
                    next.sums[q] += scale * share * part.sums[q];
                    next.squares[q] += scale * share * part.squares[q];
                }
                upto.push(next);
            }
            begin = end;
        }
        // Windows of the length of a pulse or a little more, from the end of one piece to that of another.
        let pieces = upto.as_slice();
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
        let floor = strongest.fold(0.0, f64::max) * noise_share();
        let independent = fades::independent_of_pulse(&plan.pulse, window as f64 / rate_hz);
        // Echoes that began so many steps ago may still sound, or their tail in the receiver filter.
        let tail = match spec.receiver.filter {
            ReceiverFilter::Fir => MIN_WINDOW,
            ReceiverFilter::None => 0.0,
        };
        let ago = ((plan.pulse.duration_s * rate_hz + tail) / step).ceil() as usize;
        for (from, to) in windows() {
            let (one, last) = (step_of(from.end), step_of(to.end - 1));
            let level = to.level - from.level;
            let against = level.max(floor).max(f64::MIN_POSITIVE);
            let begun = self.parts[one.saturating_sub(ago)..=last].iter();
            let begun: f64 = begun.map(|part| part.begun).sum();
            worst.tails = worst.tails.max(OVERLAPPING * (begun / against).sqrt());
            let energy = to.energy - from.energy;
            if energy <= 0.0 {
                continue;
            }
            let loudest = self.parts[one..=last]
                .iter()
                .map(|part| part.loudest)
                .fold(f64::MIN_POSITIVE, f64::max);
            let crowd = (energy / loudest).max(1.0);
            // Errors may add up where the echoes cancel: to no more than their number, which is about twice their energy over the loudest's.
            let peak = match crowd {
                ..ALONE => 1.0,
                ..FEW => fades::worst_peak(LOOKS, OF_FEW).min(2.0 * crowd),
                _ => fades::worst_peak(LOOKS, independent),
            };
            let ratio = peak * energy / against;
            worst.fading = worst.fading.max(OVERLAPPING * ratio.sqrt());
            let heard = (level / against).sqrt();
            let margin = if crowd < SINGLE { SAMPLED } else { OVERLAPPING };
            let mut amounts = [0.0; TRACKED];
            for q in 0..TRACKED {
                let square = (to.squares[q] - from.squares[q]).max(0.0) / energy;
                let mean = (to.sums[q] - from.sums[q]).abs() / energy;
                let variance = (square - mean * mean).max(0.0);
                let all = (square * ratio).sqrt();
                let amount = all.min(mean * heard + (variance * ratio).sqrt());
                let bound = if crowd < FEW {
                    f64::INFINITY
                } else {
                    bounds[q]
                };
                amounts[q] = (margin * amount).min(bound);
                worst.amounts[q] = worst.amounts[q].max(amounts[q]);
            }
            self.amounts.push(amounts);
        }
        self.upto = upto;
        self.find_ends(floor, energies, worst);
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
            let share = match window.energy < ALONE * window.loudest {
                true => 1.0,
                false => window.ends / window.energy,
            };
            let mut amounts = [0.0; TRACKED];
            for q in 0..TRACKED {
                let rms = (window.squares[q] / window.energy).sqrt();
                let amount = rms * energies.last[GROWTH[q] as usize] * share * heard;
                amounts[q] = amount;
                worst.amounts[q] = worst.amounts[q].max(amount);
            }
            self.amounts.push(amounts);
        }
    }
}
