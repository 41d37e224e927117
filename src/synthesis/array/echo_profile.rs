//! One echo and its error by an engine, instant by instant, and the largest windowed error of a ping whose echoes are known.
//!
//! An engine errs most at the ends of echoes, where a window may hold little else. Whether such a window exists, and how weak it is, depends on the
//! ping: the onset of one echo may lie under others, or below the noise floor of a stronger one. A platform at rest receives the same samples from
//! every ping, so that the level of each window is known: that of the sum of the echoes. The errors of different echoes have random phases; their
//! energies add.
//!
//! In: a profile, the delays and amplitudes of the echoes at one element, and the energies of its windows. Out: the largest error of a window, relative
//! to the window or to the noise floor.

use num_complex::Complex64;

use crate::array::phasor::cis;
use echotank_core::pulse::noise_share;

/// Energies below these shares of the largest ones are left out at the ends of a profile: far below the noise floor, and below the error elsewhere.
const SIGNAL_LEFT_OUT: f64 = 1e-12;
const ERROR_LEFT_OUT: f64 = 1e-6;

/// An echo of unit amplitude and the square of its error, from before its onset to after the tail of the filter.
#[derive(Clone, Debug)]
pub struct EchoProfile {
    /// Values per sample.
    density: usize,
    /// Index of the middle of the pulse.
    middle: usize,
    signal: Vec<Complex64>,
    /// Square of the error: mean over the places of the echo on the grid, and at the worst place.
    mean: Vec<f64>,
    worst: Vec<f64>,
    /// Energy of the errors that spread over the whole record, relative to that of the strongest window.
    everywhere: f64,
}

/// An echo at one element.
#[derive(Clone, Copy, Debug)]
pub struct KnownEcho {
    /// Sample, from the first of the record on, at which the middle of the pulse arrives.
    pub middle: f64,
    /// Amplitude with the carrier phase at that sample.
    pub amplitude: Complex64,
}

/// Energies of a profile in the windows of one pulse length that begin at each of its instants, and before.
struct Windowed {
    signal: Vec<f64>,
    mean: Vec<f64>,
    worst: Vec<f64>,
}

impl EchoProfile {
    /// `signal` and the errors: instants about the middle of the pulse, `density` a sample, in the order of a transform; `errors`: at several places
    /// of the echo on the engine's grid, all as likely. `rounding`: squares of errors at any place.
    pub(crate) fn new(
        density: usize,
        signal: Vec<Complex64>,
        errors: &[Vec<Complex64>],
        rounding: &[f64],
        everywhere: f64,
    ) -> Self {
        let count = signal.len();
        let (mut mean, mut worst) = (vec![0.0; count], vec![0.0f64; count]);
        for error in errors {
            for ((mean, worst), value) in mean.iter_mut().zip(&mut worst).zip(error) {
                let square = value.norm_sqr();
                *mean += square / errors.len() as f64;
                *worst = worst.max(square);
            }
        }
        for ((mean, worst), square) in mean.iter_mut().zip(&mut worst).zip(rounding) {
            *mean += square;
            *worst += square;
        }
        let mut profile = Self {
            density,
            middle: count / 2,
            signal,
            mean,
            worst,
            everywhere,
        };
        profile.signal.rotate_right(count / 2);
        profile.mean.rotate_right(count / 2);
        profile.worst.rotate_right(count / 2);
        profile.trim();
        profile
    }

    fn trim(&mut self) {
        let largest = |all: &[f64]| all.iter().copied().fold(0.0, f64::max);
        let of_signal: Vec<f64> = self.signal.iter().map(|x| x.norm_sqr()).collect();
        let signal = SIGNAL_LEFT_OUT * largest(&of_signal);
        let error = ERROR_LEFT_OUT * largest(&self.worst);
        let counts = |k: &usize| of_signal[*k] > signal || self.worst[*k] > error;
        let all = 0..self.signal.len();
        let first = all.clone().find(counts).unwrap_or(self.middle);
        let last = all.rev().find(counts).unwrap_or(self.middle);
        let (first, last) = (first.min(self.middle), last.max(self.middle));
        self.signal = self.signal[first..=last].to_vec();
        self.mean = self.mean[first..=last].to_vec();
        self.worst = self.worst[first..=last].to_vec();
        self.middle -= first;
    }

    /// Samples that an echo or its error reaches before and after the middle of the pulse.
    pub fn reach(&self) -> usize {
        self.middle.max(self.signal.len() - self.middle) / self.density + 1
    }

    /// Number of operations to sum one echo, about.
    pub fn effort(&self) -> usize {
        self.signal.len() / self.density
    }

    /// First sample within the profile of an echo, not below 0, with its place in the profile.
    fn first(&self, middle: f64, before: usize) -> (usize, f64) {
        let density = self.density as f64;
        // Index of sample 0.
        let zero = (self.middle + before) as f64 - middle * density;
        let sample = (-zero / density).ceil().max(0.0);
        (sample as usize, (zero + sample * density).max(0.0))
    }

    /// Adds echoes to the samples of an element.
    pub fn add(&self, echoes: &[KnownEcho], samples: &mut [Complex64]) {
        for echo in echoes {
            let (sample, place) = self.first(echo.middle, 0);
            let index = place.round() as usize;
            let values = self.signal.iter().skip(index).step_by(self.density);
            for (to, value) in samples.iter_mut().skip(sample).zip(values) {
                *to += echo.amplitude * value;
            }
        }
    }

    fn windowed(&self, window: usize) -> Windowed {
        let length = window * self.density;
        let of = |all: &[f64]| {
            // Window j begins `length - j` instants before the profile.
            let at = |k: usize| match k.checked_sub(length) {
                Some(k) => all.get(k).copied().unwrap_or(0.0),
                None => 0.0,
            };
            let mut sums = vec![0.0f64; all.len() + length];
            for start in 0..self.density.min(sums.len()) {
                let mut sum: f64 = (0..window).map(|m| at(start + m * self.density)).sum();
                for j in (start..sums.len()).step_by(self.density) {
                    sums[j] = sum.max(0.0);
                    sum += at(j + length) - at(j);
                }
            }
            sums
        };
        let signal: Vec<f64> = self.signal.iter().map(|x| x.norm_sqr()).collect();
        Windowed {
            signal: of(&signal),
            mean: of(&self.mean),
            worst: of(&self.worst),
        }
    }

    /// Largest error of the windows of `window` samples of one element. `levels`: the energies of its windows, from the first sample on. `peak`: how much
    /// more than their mean energy the errors of many echoes have in a window. The echo with the largest error is at its worst place on the grid, in
    /// phase with the errors of the others.
    /// `off_rad`: error of the phase of an echo, beside that of the profile.
    pub fn window_error(
        &self,
        echoes: &[KnownEcho],
        levels: &[f64],
        (window, peak): (usize, f64),
        off_rad: impl Fn(&KnownEcho) -> f64,
    ) -> f64 {
        let windowed = self.windowed(window);
        let before = window * self.density;
        // Mean energies of all echoes; of the one with most, at the worst place and at the mean.
        let mut all = vec![[0.0f64; 3]; levels.len()];
        for echo in echoes {
            let energy = echo.amplitude.norm_sqr();
            let off = off_rad(echo).powi(2);
            let (start, place) = self.first(echo.middle, before);
            let Windowed {
                signal,
                mean,
                worst,
            } = &windowed;
            let indices = (place as usize..signal.len()).step_by(self.density);
            for (to, j) in all.iter_mut().skip(start).zip(indices) {
                // At the onset of an echo errors grow much from one instant to the next, and the echo lies between two.
                let either = |of: &[f64]| of[j].max(of.get(j + 1).copied().unwrap_or(0.0));
                let beside = off * either(signal);
                let (mean, worst) = (either(mean) + beside, either(worst) + beside);
                to[0] += energy * mean;
                to[1] = to[1].max(energy * worst);
                to[2] = to[2].max(energy * mean);
            }
        }
        let strongest = levels.iter().copied().fold(0.0, f64::max);
        let floor = (strongest * noise_share()).max(f64::MIN_POSITIVE);
        let everywhere = self.everywhere * strongest;
        let shares = all.iter().zip(levels).map(|([sum, worst, one], level)| {
            let others = (sum - one).max(0.0);
            // No more than all errors in phase.
            let crowd = (others / one.max(f64::MIN_POSITIVE)).max(1.0);
            let off = worst.sqrt() + (others * peak.min(crowd)).sqrt();
            (off * off + everywhere) / level.max(floor)
        });
        shares.fold(0.0, f64::max).sqrt()
    }
}

/// Energies of all windows of a record.
pub fn window_levels(samples: &[Complex64], window: usize) -> Vec<f64> {
    let mut total = 0.0;
    let sums: Vec<f64> = std::iter::once(0.0)
        .chain(samples.iter().map(|x| {
            total += x.norm_sqr();
            total
        }))
        .collect();
    let windows = sums.iter().zip(sums.get(window..).unwrap_or(&[]));
    windows.map(|(before, after)| after - before).collect()
}

/// exp(-j 2pi turns).
pub fn carrier(turns: f64) -> Complex64 {
    let (cos, sin) = cis(-(turns - turns.round_ties_even()));
    Complex64::new(cos, sin)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Echoes of 8 samples of ones, with an error of a hundredth that lasts two samples longer.
    fn profile() -> EchoProfile {
        let density = 2;
        let mut signal = vec![Complex64::ZERO; 64];
        let mut error = vec![Complex64::ZERO; 64];
        for k in -10i32..10 {
            let at = k.rem_euclid(64) as usize;
            if (-8..8).contains(&k) {
                signal[at] = Complex64::ONE;
            }
            error[at] = Complex64::from(0.01);
        }
        EchoProfile::new(
            density,
            signal,
            &[error, vec![Complex64::ZERO; 64]],
            &[],
            0.0,
        )
    }

    fn error_of(echoes: &[KnownEcho]) -> f64 {
        let profile = profile();
        let mut samples = vec![Complex64::ZERO; 100];
        profile.add(echoes, &mut samples);
        profile.window_error(echoes, &window_levels(&samples, 8), (8, 4.0), |_| 0.0)
    }

    #[test]
    fn an_onset_counts_only_where_it_is_heard_alone() {
        let echo = |middle: f64, amplitude: f64| KnownEcho {
            middle,
            amplitude: Complex64::from(amplitude),
        };
        // The window before the echo holds its error and nothing else: two hundredths over the floor 55 dB below 8 samples.
        let floor = 8.0 * noise_share();
        let one = error_of(&[echo(30.0, 1.0)]);
        assert!((one / (1e-4 / floor).sqrt() - 1.0).abs() < 1e-9, "{one}");
        // A weaker one counts against the floor of the stronger one.
        let weak = error_of(&[echo(30.0, 0.1), echo(60.0, 1.0)]);
        assert!((weak / one - 1.0).abs() < 1e-9, "{weak}");
        // One between two instants of the profile has the larger error of both: 30.5 has a sample of error more before it.
        let [before, between, after] =
            [30.0, 30.2, 30.5].map(|middle| error_of(&[echo(middle, 1.0)]));
        println!("{before} {between} {after}");
        assert!(
            between >= before.max(after) && before != after,
            "{before} {between} {after}"
        );
        // Under others there is no window without a level.
        let covered: Vec<KnownEcho> = (0..17)
            .map(|k| echo(2.0 + 6.0 * f64::from(k), 1.0))
            .collect();
        let covered = error_of(&covered);
        println!("{one}, covered {covered}");
        assert!(covered < 0.05, "{covered}");
    }
}
