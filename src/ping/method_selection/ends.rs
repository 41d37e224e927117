//! How far windows with no more than the ends of echoes fade.
//!
//! A window that ends with the first samples of several echoes, or begins with their last ones, may hold much less than these by themselves, and an
//! engine errs most there. What an echo has in a window follows from its table of energies ([`EchoOnset`]); what the window holds, from the samples.
//!
//! ```text
//! window        |--------------------|
//! an echo                          begins ------ ends     up_to(last sample - begins)
//! another   begins ------ ends                            up_to(ends - first sample)
//! ```

use echotank_core::pulse::noise_share;
use echotank_synthesis::array::EchoOnset;
use echotank_synthesis::array::gridded::{LEVELS, level_of};
use num_complex::Complex64;

/// An echo of an element.
#[derive(Clone, Copy, Debug)]
pub(super) struct Echo {
    /// Samples after the first one of the record.
    pub begins: f64,
    /// Of a whole echo of unit strength, 1.
    pub energy: f64,
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

/// Sums over the echoes of a window. Buffers.
#[derive(Default)]
pub(super) struct Ends {
    pub(super) echoes: Vec<Echo>,
    /// By the table of [`EchoOnset`], the share of its energy that an echo counts with; at most this, and from this place on.
    counted: Vec<f64>,
    most: f64,
    beyond: f64,
    /// Energies and their squares, by window.
    sums: Vec<[f64; 2]>,
    /// What the sums of the windows from one on have more.
    more: Vec<[f64; 2]>,
}

impl Ends {
    /// Sets what echoes count with. `most`: the share of its energy at most, since as a whole an echo has a smaller error. `by_level`: errors of an echo in
    /// windows of these levels, over that in the worst window.
    pub(super) fn count(&mut self, onset: &EchoOnset, most: f64, by_level: &[f64; LEVELS]) {
        let counts = |energy: &f64| {
            let step = level_of(*energy);
            // The next deeper one too: an instant and a Doppler make a difference.
            let error = by_level[step].max(by_level[(step + 1).min(LEVELS - 1)]);
            (energy.max(noise_share()) * error * error).min(most)
        };
        self.counted.clear();
        self.counted.extend(onset.energies().iter().map(counts));
        (self.most, self.beyond) = (most, onset.samples_of(most));
    }

    /// The largest rms of what the echoes count with in a window, over its level. Of two that are as strong, the errors may add.
    pub(super) fn worst(&mut self, record: &Record, onset: &EchoOnset) -> f64 {
        let &Record { signal, window, .. } = record;
        let windows = signal.len() - window + 1;
        for sums in [&mut self.sums, &mut self.more] {
            sums.clear();
            sums.resize(windows + 1, [0.0; 2]);
        }
        for k in 0..self.echoes.len() {
            self.add(self.echoes[k], record, onset);
        }
        let mut level: f64 = signal[..window - 1].iter().map(|x| x.norm_sqr()).sum();
        let mut whole = [0.0; 2];
        let mut worst = 0.0f64;
        for (first, (sums, more)) in self.sums.iter().zip(&self.more).take(windows).enumerate() {
            level += signal[first + window - 1].norm_sqr();
            let [energy, squares] = [0, 1].map(|k| {
                whole[k] += more[k];
                sums[k] + whole[k]
            });
            if energy > 0.0 {
                let echoes = (energy * energy / squares).clamp(1.0, 2.0);
                let against = (level / record.of_unit).max(record.floor);
                worst = worst.max(echoes * energy / against.max(f64::MIN_POSITIVE));
            }
            level -= signal[first].norm_sqr();
        }
        worst.sqrt()
    }

    /// Adds an echo to the windows that hear it.
    fn add(&mut self, echo: Echo, record: &Record, onset: &EchoOnset) {
        let (begins, ends) = (echo.begins, echo.begins + record.pulse);
        let last = (record.window - 1) as f64;
        let before = onset.before() as f64;
        let windows = self.sums.len() - 1;
        let place = |first: f64| (first.ceil().max(0.0) as usize).min(windows);
        let heard = place(begins - before - last)..place(ends + before + 1.0);
        let whole = place(begins + self.beyond - last)..place(ends - self.beyond);
        let (counted, sums) = (&self.counted, &mut self.sums);
        let mut add = |first: usize| {
            let heard = (first as f64 + last - begins).min(ends - first as f64);
            let energy = echo.energy * onset.index(heard).map_or(0.0, |index| counted[index]);
            sums[first][0] += energy;
            sums[first][1] += energy * energy;
        };
        if whole.is_empty() {
            heard.for_each(add);
            return;
        }
        (heard.start..whole.start).for_each(&mut add);
        (whole.end..heard.end).for_each(&mut add);
        let energy = echo.energy * self.most;
        for (k, value) in [energy, energy * energy].into_iter().enumerate() {
            self.more[whole.start][k] += value;
            self.more[whole.end][k] -= value;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use echotank_core::pulse::{Pulse, PulseKind};
    use echotank_core::testing::plan_at_rest;
    use echotank_synthesis::array::echo_onset;

    const RATE_HZ: f64 = 40e3;
    const PULSE: usize = 40;
    const FLOOR: f64 = 3.162_277_66e-6;

    /// Fades of echoes of a rectangular pulse that begin at these samples, in a record of a pulse of `amplitude` from sample 100 on. Without a filter.
    fn worst(begins: &[f64], amplitude: f64, most: f64) -> f64 {
        let pulse = Pulse {
            kind: PulseKind::Cw,
            center_frequency_hz: 200e3,
            bandwidth_hz: 0.0,
            duration_s: PULSE as f64 / RATE_HZ,
            taper: 0.0,
        };
        let onset =
            echo_onset(&plan_at_rest(&pulse, 200, 1500.0), RATE_HZ, None).expect("no filter");
        let sounds = |k: usize| (100..100 + PULSE).contains(&k);
        let signal: Vec<Complex64> = (0..200)
            .map(|k| Complex64::from(if sounds(k) { amplitude } else { 0.0 }))
            .collect();
        let mut ends = Ends::default();
        ends.echoes.extend(begins.iter().map(|&begins| Echo {
            begins,
            energy: 1.0,
        }));
        let record = Record {
            signal: &signal,
            window: PULSE,
            pulse: PULSE as f64,
            of_unit: PULSE as f64,
            floor: FLOOR,
        };
        ends.count(&onset, most, &[1.0; LEVELS]);
        ends.worst(&record, &onset)
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
}
