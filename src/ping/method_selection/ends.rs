//! Errors of windows with no more than the ends of echoes.
//!
//! A window that ends with the first samples of several echoes, or begins with their last ones, may hold much less than these by themselves, and an
//! engine errs most there, and so may path and Doppler. What an echo and its phase errors have in a window follows from tables ([`EchoEnds`]); what the
//! window holds, from the samples.
//!
//! ```text
//! window        |--------------------|
//! an echo                          begins ------ ends     up_to(last sample - begins)
//! another   begins ------ ends                            up_to(ends - first sample)
//! ```

use std::ops::Range;

use echotank_core::pulse::noise_share;
use echotank_synthesis::array::gridded::{LEVELS, level_of};
use echotank_synthesis::array::{DisplacedSums, EchoEnd, EchoEnds};
use num_complex::Complex64;

use crate::method_selection::echo_statistics::{ALONE, GROWTHS, SAMPLED};
use crate::method_selection::fades;

/// Windows below this share of the strongest are quiet: where echoes cancel, or hardly sound.
const QUIET: f64 = 0.1;
/// Windows with less than this share of the energy of their echoes hold no more than ends of them. Of others, steps of a window tell enough.
const ENDS: f64 = 0.05;

/// An echo of an element.
#[derive(Clone, Copy, Debug)]
pub(super) struct Echo {
    /// Samples after the first one of the record.
    pub begins: f64,
    /// Of a whole echo of unit strength, 1.
    pub energy: f64,
    /// Phase errors by how they grow within the echo, radians: their sums, and the sums of their magnitudes.
    pub phases: [f64; GROWTHS],
    pub magnitudes: [f64; GROWTHS],
}

impl Echo {
    /// Sums of energy times phase, and times its square, of a share of the energy with these errors.
    fn phase_sums(&self, errors: &[DisplacedSums]) -> [f64; 2] {
        let (mut phase, mut rms) = (0.0, 0.0);
        for (g, error) in errors.iter().enumerate() {
            phase += error.phase * self.phases[g];
            rms += error.square.sqrt() * self.magnitudes[g];
        }
        [self.energy * phase, self.energy * rms * rms]
    }
}

/// The record of an element.
pub(super) struct Record<'a> {
    /// At least a window.
    pub signal: &'a [Complex64],
    /// Samples of a window and of a pulse.
    pub window: usize,
    pub pulse: f64,
    /// The sum of the squares of an echo of unit strength.
    pub of_unit: f64,
    /// The least that a window counts as.
    pub floor: f64,
}

/// Where an echo is heard, by the first samples of windows.
struct Places {
    heard: Range<usize>,
    /// As a whole.
    whole: Range<usize>,
}

impl Record<'_> {
    fn windows(&self) -> usize {
        self.signal.len() + 1 - self.window
    }

    /// `beyond`: so many samples from an end, an echo is whole; `before`: from so many samples before it, it is heard.
    fn places(&self, echo: &Echo, before: f64, beyond: f64) -> Places {
        let last = (self.window - 1) as f64;
        let (begins, ends) = (echo.begins, echo.begins + self.pulse);
        let place = |first: f64| (first.ceil().max(0.0) as usize).min(self.windows());
        Places {
            heard: place(begins - before - last)..place(ends + before + 1.0),
            whole: place(begins + beyond - last)..place(ends - beyond),
        }
    }

    /// What a window has of an echo: up to or from the end that it has least behind of, samples.
    fn has(&self, echo: &Echo, first: usize) -> (EchoEnd, f64) {
        let up_to = (first + self.window - 1) as f64 - echo.begins;
        let from = echo.begins + self.pulse - first as f64;
        if up_to < from {
            (EchoEnd::Begin, up_to)
        } else {
            (EchoEnd::End, from)
        }
    }
}

impl Places {
    /// Windows that hear no more than an end of the echo.
    fn ends(&self) -> impl Iterator<Item = usize> {
        let Range { start, end } = self.heard;
        let whole = match self.whole.is_empty() {
            true => end..end,
            false => self.whole.clone(),
        };
        (start..whole.start).chain(whole.end..end)
    }
}

/// Energies of what a window has of its echoes, and their squares; the energies times phase errors, and times the squares of these; and the energies of the
/// whole echoes.
type Sums = [f64; 5];

/// Sums over the echoes of each window. Buffers.
#[derive(Default)]
struct Windows {
    sums: Vec<Sums>,
    /// What the sums of the windows from one on have more.
    more: Vec<Sums>,
}

impl Windows {
    fn clear(&mut self, windows: usize) {
        for sums in [&mut self.sums, &mut self.more] {
            sums.clear();
            sums.resize(windows + 1, Sums::default());
        }
    }

    fn add(&mut self, first: usize, energy: f64, [phase, square]: [f64; 2]) {
        let of = [energy, energy * energy, phase, square];
        for (sum, value) in self.sums[first].iter_mut().zip(of) {
            *sum += value;
        }
    }

    /// Adds an echo to the windows that hear it as a whole; all that hear it know of it.
    fn add_whole(&mut self, places: &Places, echo: &Echo, energy: f64, [phase, square]: [f64; 2]) {
        let whole = [energy, energy * energy, phase, square, 0.0];
        let heard = [0.0, 0.0, 0.0, 0.0, echo.energy];
        for (range, of) in [(&places.whole, whole), (&places.heard, heard)] {
            if range.is_empty() {
                continue;
            }
            for (k, value) in of.into_iter().enumerate() {
                self.more[range.start][k] += value;
                self.more[range.end][k] -= value;
            }
        }
    }

    /// The sums of all windows.
    fn all(&self) -> impl Iterator<Item = Sums> {
        let mut whole = Sums::default();
        self.sums.iter().zip(&self.more).map(move |(sums, more)| {
            std::array::from_fn(|k| {
                whole[k] += more[k];
                // Rounding of what has ended may be negative.
                sums[k] + whole[k]
            })
        })
    }
}

/// Buffers.
#[derive(Default)]
pub(super) struct Ends {
    pub(super) echoes: Vec<Echo>,
    /// By the table of [`EchoEnds`], the share of its energy that an echo counts with; at most this, and from this place on.
    counted: Vec<f64>,
    most: f64,
    beyond: f64,
    windows: Windows,
    /// Of each window. How many quiet ones are before it.
    levels: Vec<f64>,
    quiet: Vec<u32>,
}

impl Ends {
    /// Sets what echoes count with. `most`: the share of its energy at most, since as a whole an echo has a smaller error. `by_level`: errors of an echo in
    /// windows of these levels, over that in the worst window.
    pub(super) fn count(&mut self, ends: &EchoEnds, most: f64, by_level: &[f64; LEVELS]) {
        let counts = |energy: &f64| {
            let step = level_of(*energy);
            // The next deeper one too: an instant and a Doppler make a difference.
            let error = by_level[step].max(by_level[(step + 1).min(LEVELS - 1)]);
            (energy.max(noise_share()) * error * error).min(most)
        };
        self.counted.clear();
        self.counted.extend(ends.energies().iter().map(counts));
        (self.most, self.beyond) = (most, ends.samples_of(most));
    }

    /// Finds the levels of the windows, and which are quiet: before [`Self::worst`] and [`Self::worst_phase`] of the record.
    pub(super) fn hear(&mut self, record: &Record) {
        let &Record { signal, window, .. } = record;
        let mut level: f64 = signal[..window - 1].iter().map(|x| x.norm_sqr()).sum();
        self.levels.clear();
        self.levels.extend((0..record.windows()).map(|first| {
            level += signal[first + window - 1].norm_sqr();
            let here = level.max(0.0) / record.of_unit;
            level -= signal[first].norm_sqr();
            here
        }));
        let quiet = QUIET * record.floor / noise_share();
        let mut before = 0;
        self.quiet.clear();
        self.quiet.push(0);
        self.quiet.extend(self.levels.iter().map(|level| {
            before += u32::from(*level < quiet);
            before
        }));
    }

    /// The largest rms of what the echoes count with in a window, over its level. Of two that are as strong, the errors may add.
    pub(super) fn worst(&mut self, record: &Record, ends: &EchoEnds) -> f64 {
        let Self {
            echoes,
            counted,
            windows,
            levels,
            ..
        } = self;
        windows.clear(record.windows());
        for echo in &*echoes {
            let places = record.places(echo, ends.before() as f64, self.beyond);
            for first in places.ends() {
                let (_, heard) = record.has(echo, first);
                let share = ends.index(heard).map_or(0.0, |index| counted[index]);
                windows.add(first, echo.energy * share, [0.0; 2]);
            }
            windows.add_whole(&places, echo, echo.energy * self.most, [0.0; 2]);
        }
        let mut worst = 0.0f64;
        for ([energy, squares, ..], level) in windows.all().zip(levels) {
            if energy > 0.0 {
                let echoes = (energy * energy / squares).clamp(1.0, 2.0);
                let against = level.max(record.floor).max(f64::MIN_POSITIVE);
                worst = worst.max(echoes * energy / against);
            }
        }
        worst.sqrt()
    }

    /// The largest error from the phases of the echoes in a quiet window with no more than their ends. `peaks`: as those of [`peak_of`].
    pub(super) fn worst_phase(&mut self, record: &Record, ends: &EchoEnds, peaks: [f64; 2]) -> f64 {
        let Self {
            echoes,
            windows,
            levels,
            quiet,
            ..
        } = self;
        if quiet.last() == Some(&0) || echoes.iter().all(|echo| echo.magnitudes == [0.0; GROWTHS]) {
            return 0.0;
        }
        windows.clear(record.windows());
        for echo in &*echoes {
            let places = record.places(echo, ends.before() as f64, ends.covered());
            if quiet[places.heard.end] == quiet[places.heard.start] {
                continue;
            }
            for first in places.ends() {
                if quiet[first + 1] == quiet[first] {
                    continue;
                }
                let (end, heard) = record.has(echo, first);
                let Some(index) = ends.index(heard) else {
                    continue;
                };
                let of_phases = echo.phase_sums(ends.errors(end, index));
                windows.add(first, echo.energy * ends.energies()[index], of_phases);
            }
            let of_phases = echo.phase_sums(ends.whole());
            windows.add_whole(&places, echo, echo.energy, of_phases);
        }
        let mut worst = 0.0f64;
        for (first, ([energy, squares, phases, phases2, whole], level)) in
            windows.all().zip(&*levels).enumerate()
        {
            let is_quiet = quiet[first + 1] > quiet[first];
            if !is_quiet || energy <= 0.0 || energy > ENDS * whole {
                continue;
            }
            let crowd = (energy * energy / squares).max(1.0);
            // A lone echo does not fade.
            let level = if crowd < ALONE {
                level.max(energy)
            } else {
                *level
            };
            let against = level.max(record.floor).max(f64::MIN_POSITIVE);
            let (mean, square) = (phases.abs() / energy, phases2.max(0.0) / energy);
            let ratio = peak_of(crowd, peaks) * energy / against;
            worst = worst.max(error_of_phases(mean, square, ratio, level / against));
        }
        SAMPLED * worst
    }
}

/// With fewer echoes than this in a window, some pair of them may keep its phase difference in all of it.
pub(super) const FEW: f64 = 8.0;
/// Degrees of freedom of the energy of echoes that keep their phase differences.
const OF_FEW: f64 = 1.0;
/// Logarithm of the number of windows that fade about as deep as the deepest: so many chances the errors in them have to add up.
const LOOKS: f64 = 3.0;

/// What errors of few echoes and of many amount to where they add up, over the sum of their energies. `independent`: the degrees of freedom of a window.
pub(super) fn peaks(independent: f64) -> [f64; 2] {
    [OF_FEW, independent].map(|n| fades::worst_peak(LOOKS, n))
}

/// Errors may add up where the echoes cancel: the amplitude of the loudest and that of all others as one.
pub(super) fn peak_of(crowd: f64, [of_few, of_many]: [f64; 2]) -> f64 {
    match crowd {
        ..ALONE => 1.0,
        ..FEW => of_few.min((1.0 + (crowd - 1.0).sqrt()).powi(2)),
        _ => of_many,
    }
}

/// What phase errors of this mean and mean square amount to over the level of a window: the mean is an error in proportion to the samples, what the
/// phases differ by is not. `ratio`: the energy of the errors of unit phases, over the level; `heard`: the energy of the samples, over the level.
pub(super) fn error_of_phases(mean: f64, square: f64, ratio: f64, heard: f64) -> f64 {
    let variance = (square - mean * mean).max(0.0);
    let all = (square * ratio).sqrt();
    all.min(mean * heard.sqrt() + (variance * ratio).sqrt())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::method_selection::echo_statistics::Growth;
    use echotank_core::pulse::{Pulse, PulseKind};
    use echotank_core::testing::plan_at_rest;
    use echotank_synthesis::array::echo_ends;

    const RATE_HZ: f64 = 40e3;
    const PULSE: usize = 40;
    const FLOOR: f64 = 3.162_277_66e-6;

    fn pulse(taper: f64) -> Pulse {
        Pulse {
            kind: PulseKind::Cw,
            center_frequency_hz: 200e3,
            bandwidth_hz: 0.0,
            duration_s: PULSE as f64 / RATE_HZ,
            taper,
        }
    }

    /// Without a filter.
    fn table(pulse: &Pulse) -> std::sync::Arc<EchoEnds> {
        let plan = plan_at_rest(pulse, 200, 1500.0);
        echo_ends(&plan, RATE_HZ, None, Growth::SHAPES).expect("no filter")
    }

    fn record(signal: &[Complex64], of_unit: f64, floor: f64) -> Record<'_> {
        Record {
            signal,
            window: PULSE,
            pulse: PULSE as f64,
            of_unit,
            floor,
        }
    }

    /// Fades of echoes of a rectangular pulse that begin at these samples, in a record of a pulse of `amplitude` from sample 100 on. Without a filter.
    fn worst(begins: &[f64], amplitude: f64, most: f64) -> f64 {
        let table = table(&pulse(0.0));
        let sounds = |k: usize| (100..100 + PULSE).contains(&k);
        let signal: Vec<Complex64> = (0..200)
            .map(|k| Complex64::from(if sounds(k) { amplitude } else { 0.0 }))
            .collect();
        let mut ends = Ends::default();
        ends.echoes.extend(begins.iter().map(|&begins| Echo {
            begins,
            energy: 1.0,
            phases: [0.0; GROWTHS],
            magnitudes: [0.0; GROWTHS],
        }));
        ends.count(&table, most, &[1.0; LEVELS]);
        let record = record(&signal, PULSE as f64, FLOOR);
        ends.hear(&record);
        ends.worst(&record, &table)
    }

    #[test]
    fn one_echo_does_not_fade_and_two_may() {
        let near = |a: f64, b: f64| assert!((a / b - 1.0).abs() < 0.02, "{a} {b}");
        near(worst(&[99.9], 1.0, 1.0), 1.0);
        // Both are ten times as strong as what is left of them, and their errors may add.
        near(worst(&[99.9, 99.9], 0.1, 1.0), 20.0);
        // One window holds 4 samples of them; as a whole they count with the errors of these.
        near(worst(&[99.9, 99.9], 0.1, 0.1), 20.0);
        // Before the record's only sound there is none but the floor.
        near(worst(&[20.0], 1.0, 0.1), (0.1 / FLOOR).sqrt());
        assert_eq!(worst(&[], 1.0, 1.0), 0.0);
        assert_eq!(worst(&[300.0], 1.0, 1.0), 0.0);
    }

    /// Echoes with phase errors, of which the first few samples cancel, ahead of a strong one: the worst of the windows that hold no more than their ends.
    /// A mean phase error counts as one of the samples; errors that differ, or grow, count more where the samples cancel.
    #[test]
    fn phase_errors_of_ends_that_cancel_are_bounded() {
        const SAMPLES: usize = 200;
        let cases: [&[(f64, f64, Growth, f64)]; 5] = [
            // Begins, phase, growth and error.
            &[(60.2, 0.0, Growth::Constant, 1e-4)],
            &[
                (60.2, 0.0, Growth::Constant, 1e-4),
                (60.4, 3.0, Growth::Constant, 1e-4),
            ],
            &[
                (60.2, 0.0, Growth::Constant, 1e-4),
                (60.4, 3.0, Growth::Constant, -1e-4),
            ],
            &[
                (60.2, 0.0, Growth::Cubic, 1e-4),
                (61.7, 3.1, Growth::Cubic, -2e-4),
                (60.9, 1.5, Growth::Linear, 1e-4),
            ],
            &[
                (59.2, 0.0, Growth::Square, 1e-4),
                (59.3, 2.9, Growth::Constant, 2e-5),
            ],
        ];
        // Windows that end before the strong echo begins, and hold little of the others.
        let tapers = [(0.0, 20..24), (1.0, 20..31)].into_iter();
        for ((taper, windows), case) in tapers.flat_map(|of| cases.map(|case| (of.clone(), case))) {
            let pulse = pulse(taper);
            let sound = |k: usize, begins: f64| {
                let share = (k as f64 - begins) / PULSE as f64;
                let sounds = (0.0..=1.0).contains(&share);
                let level = pulse.envelope(share * pulse.duration_s);
                (share, if sounds { level } else { Complex64::ZERO })
            };
            let of_unit: f64 = (0..SAMPLES).map(|k| sound(k, 60.0).1.norm_sqr()).sum();
            let (want, got): (Vec<Complex64>, Vec<Complex64>) = (0..SAMPLES)
                .map(|k| {
                    let strong = 3.0 * sound(k, 70.0).1;
                    let mut samples = (strong, strong);
                    for &(begins, phase, growth, error) in case {
                        let (share, level) = sound(k, begins);
                        let off = error * Growth::SHAPES[growth as usize](share);
                        samples.0 += level * Complex64::cis(phase);
                        samples.1 += level * Complex64::cis(phase + off);
                    }
                    samples
                })
                .unzip();
            let energies = |first: usize| {
                let window = want[first..first + PULSE].iter().zip(&got[first..]);
                let of = window.map(|(want, got)| [want.norm_sqr(), (got - want).norm_sqr()]);
                of.fold([0.0; 2], |a, b| [a[0] + b[0], a[1] + b[1]])
            };
            let all = 0..=SAMPLES - PULSE;
            let strongest = all.map(|first| energies(first)[0]).fold(0.0, f64::max);
            let floor = strongest * noise_share();
            let measured = windows.map(|first| {
                let [level, off] = energies(first);
                (off / level.max(floor)).sqrt()
            });
            let measured = measured.fold(0.0, f64::max);
            let strong = Echo {
                begins: 70.0,
                energy: 9.0,
                phases: [0.0; GROWTHS],
                magnitudes: [0.0; GROWTHS],
            };
            let echoes = case.iter().map(|&(begins, _, growth, error)| {
                let mut phases = [0.0; GROWTHS];
                phases[growth as usize] = error;
                Echo {
                    begins,
                    energy: 1.0,
                    phases,
                    magnitudes: phases.map(f64::abs),
                }
            });
            let mut ends = Ends::default();
            ends.echoes.extend(echoes.chain([strong]));
            let record = record(&want, of_unit, floor / of_unit);
            ends.hear(&record);
            let got = ends.worst_phase(&record, &table(&pulse), peaks(2.0));
            println!("taper {taper}, {case:?}: {measured:.2e}, at most {got:.2e}");
            assert!(got >= measured, "{taper} {case:?}: {got:e} {measured:e}");
            assert!(
                got <= 4.0 * measured,
                "{taper} {case:?}: {got:e} {measured:e}"
            );
        }
    }
}
