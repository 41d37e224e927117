//! The error in the worst window of a ping, of spreading kernels and of anything that adds like noise.
//!
//! Two kinds of window are worst. In one, many echoes nearly cancel: its level is a low quantile of the sum of a few squares of normal numbers.
//! The other holds only the beginning or the end of the first or the last echo, where the frequencies beside the band matter, which kernels
//! treat worst. There the noise floor counts, which lies below the strongest window and so below many echoes where a window holds many. Errors of many
//! echoes reach into windows before the first and after the last of them.
//!
//! The second kind is simulated: an echo alone and the beginning and the end of a dense succession of echoes, at several places between two rows,
//! spread and corrected as the engine does it.

use std::f64::consts::TAU;
use std::sync::Arc;

use echotank_core::pulse::MIN_WINDOW;
use echotank_fft::{Fft, Planned};
use num_complex::Complex64;

use crate::array::echo_profile::EchoProfile;
use crate::array::filter::Decimator;
use crate::array::gridded::pulse_spectrum::PulseSpectrum;
use crate::array::gridded::{LEVELS, Windows};

use super::design::Spec;
use super::dopplers::{Columns, MAX_TAPS};
use super::kernel::{BAND, Kernel};

/// The noise lies this far below the strongest window, as energy.
const NOISE: f64 = 3.162e-6;
/// Echoes of a window that the floor relies on, relative to the mean number.
const SURE: f64 = 0.125;
/// Places of an echo between two rows.
const PLACES: usize = 12;
/// Several echoes in one window, and echoes that change (motion, patterns).
pub(super) const MORE: f64 = 1.3;
/// Instants of a sample at which windows of an echo alone may begin, over the two of its spectrum: behind the receiver filter, a window with the first
/// samples of an echo may be weak at one place between two samples, and twice as strong beside it.
const FINER: usize = 4;
/// Places between two columns that are looked at. The pulse is symmetric, or its mirror image is its conjugate.
const BETWEEN_COLUMNS: [f64; 3] = [0.0, 0.25, 0.5];
/// Powers of the distance from the middle of the pulse.
const POWERS: usize = MAX_TAPS;
/// Rounding errors of the transforms over a slab, relative to the strongest echo.
const ROUNDING: f64 = 1e-7;

/// ... and to the noise below it.
pub(super) fn rounding_over_noise() -> f64 {
    ROUNDING / NOISE.sqrt()
}

/// Errors of a kernel.
#[derive(Clone, Copy, Debug)]
pub(super) struct KernelErrors {
    /// rms over the echo and over its places.
    pub rms: f64,
    /// In the worst window of an echo alone, or at the beginning or the end of many.
    pub edges: f64,
}

/// Errors of an echo alone in the ping, in windows whose levels below the strongest are those of [`level_of`](crate::array::gridded::level_of).
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct ErrorsByLevel {
    pub kernel: [f64; LEVELS],
    pub columns: [f64; LEVELS],
    /// Of errors that are the pulse times the Legendre polynomial of as many columns, the fourth power of the distance from its middle, and its square:
    /// 1 at the ends of the pulse.
    pub legendre: [f64; LEVELS],
    pub fourth: [f64; LEVELS],
    pub square: [f64; LEVELS],
}

/// An echo alone behind the receiver filter.
pub(super) struct SingleEcho {
    /// Frequencies -1..1, cycles per sample, with the spectrum there; entry k folds to bin k of `size`.
    spectrum: Vec<(f64, Complex64)>,
    /// Gains of the filter at these, with the sign that delays the echo by half a period.
    gains: Vec<f64>,
    size: usize,
    /// Without the filter, at frequencies that Dopplers shift.
    pulse: PulseSpectrum,
    rate_hz: f64,
    inverse: Arc<dyn Fft<f64>>,
    /// Length of a window, samples.
    window: usize,
    /// Energy by window, of which the noise is the least that counts.
    level: Vec<f64>,
    noise: f64,
    /// Noise below a dense succession of echoes, one per sample.
    noise_of_many: f64,
    energy: f64,
    /// Half a pulse, samples.
    half: f64,
    /// Independent values of a window.
    free: usize,
}

/// Energies of the windows that begin at each sample, around the end.
fn windowed(samples: &[Complex64], window: usize) -> Vec<f64> {
    let mut total = 0.0;
    let sums: Vec<f64> = std::iter::once(0.0)
        .chain(
            samples
                .iter()
                .cycle()
                .take(samples.len() + window)
                .map(|x| {
                    total += x.norm_sqr();
                    total
                }),
        )
        .collect();
    sums.iter()
        .zip(&sums[window..])
        .take(samples.len())
        .map(|(before, after)| (after - before).max(0.0))
        .collect()
}

/// y such that the sum of the squares of `count` complex normal numbers of unit power is below y with `probability`.
fn quantile(count: usize, probability: f64) -> f64 {
    let below = |y: f64| {
        // exp(-y) times the sum of y^k / k! for k >= count.
        let mut term = (1..=count).fold(libm::exp(-y), |term, k| term * y / k as f64);
        let mut sum = 0.0;
        for k in count + 1..count + 200 {
            sum += term;
            term *= y / k as f64;
        }
        sum
    };
    let (mut low, mut high) = (0.0, count as f64);
    for _ in 0..60 {
        let middle = 0.5 * (low + high);
        match below(middle) < probability {
            true => low = middle,
            false => high = middle,
        }
    }
    high
}

/// Samples of a pulse, and of a window of the contract.
fn lengths(spec: &Spec) -> (usize, usize) {
    let sounding = (spec.pulse.duration_s * spec.sample_rate_hz).ceil();
    (sounding as usize, sounding.max(MIN_WINDOW) as usize)
}

/// Number of windows of a ping.
fn windows(spec: &Spec) -> f64 {
    (spec.samples as f64 / lengths(spec).1 as f64).max(1.0)
}

/// Noise relative to that below a single echo, as energy: more where every window holds many echoes.
pub(super) fn noise_factor(spec: &Spec) -> f64 {
    let held = spec.min_scatterers as f64 / windows(spec);
    (SURE * held).max(1.0)
}

impl SingleEcho {
    pub(super) fn new(spec: &Spec, filter: &Decimator) -> Self {
        let rate_hz = spec.sample_rate_hz;
        let (sounding, window) = lengths(spec);
        let reach = (filter.half_s() * rate_hz).ceil() as usize;
        let size = (sounding + 2 * (reach + window + 16)).next_power_of_two();
        let shift_hz = MAX_TAPS as f64 / spec.pulse.duration_s;
        let pulse = PulseSpectrum::with_powers(spec.pulse, rate_hz + shift_hz, POWERS);
        let frequency = |k: usize| k as f64 / size as f64 - if k >= size { 2.0 } else { 0.0 };
        let gain = |k: usize| {
            // From the beginning of the pulse to its middle half a period later.
            let sign = if k.is_multiple_of(2) { 1.0 } else { -1.0 };
            sign * filter.gain(frequency(k) * rate_hz)
        };
        let gains: Vec<f64> = (0..2 * size).map(gain).collect();
        let spectrum: Vec<(f64, Complex64)> = gains
            .iter()
            .enumerate()
            .map(|(k, gain)| (frequency(k), pulse.at(frequency(k) * rate_hz) * gain))
            .collect();
        let inverse = f64::plan_inverse(size);
        let mut samples = vec![Complex64::ZERO; size];
        for (k, (_, value)) in spectrum.iter().enumerate() {
            samples[k % size] += value;
        }
        inverse.process(&mut samples);
        let level = windowed(&samples, window);
        let greatest = level.iter().copied().fold(0.0, f64::max);
        let energy = samples.iter().map(|x| x.norm_sqr()).sum::<f64>();
        let free =
            window as f64 / rate_hz * spec.pulse.bandwidth_hz.max(1.0 / spec.pulse.duration_s);
        Self {
            energy,
            half: 0.5 * spec.pulse.duration_s * rate_hz,
            spectrum,
            gains,
            size,
            pulse,
            rate_hz,
            inverse,
            window,
            noise: greatest * NOISE * noise_factor(spec),
            noise_of_many: NOISE * level.iter().sum::<f64>(),
            level,
            free: free.round() as usize + 1,
        }
    }

    /// Largest ratio of the mean level of a ping's windows to that of the weakest, as amplitude.
    pub(super) fn fading(&self, spec: &Spec) -> f64 {
        let independent = windows(spec) * (spec.array.elements as f64 / 4.0).max(1.0);
        let weakest = quantile(self.free, 1.0 / independent.max(2.0));
        (self.free as f64 / weakest).sqrt()
    }

    /// Errors of echoes spread with `kernel` on a grid of `per_sample` rows a sample, by frequency and place.
    fn off_at(&self, kernel: &Kernel, per_sample: f64) -> Vec<[Complex64; PLACES]> {
        let half = 0.5 * kernel.width as f64;
        // Samples of the kernel for echoes at each place after a row.
        let samples: [_; PLACES] = std::array::from_fn(|place| {
            let x = (place as f64 + 0.5) / PLACES as f64;
            let first = (x - half).ceil() as isize;
            let values = (first..=(x + half).floor() as isize)
                .map(|row| kernel.value((row as f64 - x) / half))
                .collect::<Vec<_>>();
            (first, values)
        });
        // Their transforms, turned back to the echo's place; the mean over places is the kernel's own transform.
        let transforms = |nu: f64| -> [Complex64; PLACES] {
            let step = Complex64::cis(-TAU * nu);
            let mut back = Complex64::cis(TAU * nu * 0.5 / PLACES as f64);
            let between = Complex64::cis(TAU * nu / PLACES as f64);
            let lead = |first: isize| Complex64::cis(-TAU * nu * first as f64);
            let mut turn_of = (samples[0].0, lead(samples[0].0));
            std::array::from_fn(|place| {
                let (first, values) = &samples[place];
                if turn_of.0 != *first {
                    turn_of = (*first, lead(*first));
                }
                let mut turn = turn_of.1 * back;
                back *= between;
                let mut sum = Complex64::ZERO;
                for value in values {
                    sum += turn * value;
                    turn *= step;
                }
                sum
            })
        };
        // What the engine leaves out is wrong as a whole.
        let band = f64::max(0.5, BAND * per_sample);
        self.spectrum
            .iter()
            .map(|(nu, value)| {
                if nu.abs() > band {
                    return [-*value; PLACES];
                }
                let all = transforms(nu / per_sample);
                let mean = all.iter().map(|x| x.re).sum::<f64>() / PLACES as f64;
                all.map(|at| value * (at / mean - 1.0))
            })
            .collect()
    }

    /// An echo at rest with its errors, instant by instant.
    pub(super) fn profile(&self, kernel: &Kernel, per_sample: f64) -> EchoProfile {
        let inverse = f64::plan_inverse(2 * self.size);
        // The middle of the pulse is half a period after the beginning.
        let instants = |mut values: Vec<Complex64>| {
            inverse.process(&mut values);
            values.rotate_left(self.size);
            values
        };
        let off_at = self.off_at(kernel, per_sample);
        let errors: Vec<Vec<Complex64>> = (0..PLACES)
            .map(|place| instants(off_at.iter().map(|values| values[place]).collect()))
            .collect();
        let signal = self.spectrum.iter().map(|(_, value)| *value).collect();
        EchoProfile::new(2, instants(signal), &errors, &[], ROUNDING * ROUNDING)
    }

    /// Errors of echoes spread with `kernel` on a grid of `per_sample` rows a sample.
    pub(super) fn errors(&self, kernel: &Kernel, per_sample: f64) -> KernelErrors {
        let off_at = self.off_at(kernel, per_sample);
        let (mut energy, mut worst) = (0.0, 0.0f64);
        for place in 0..PLACES {
            let mut off = vec![Complex64::ZERO; self.size];
            for (k, values) in off_at.iter().enumerate() {
                off[k % self.size] += values[place];
            }
            self.inverse.process(&mut off);
            energy += off.iter().map(|x| x.norm_sqr()).sum::<f64>() / PLACES as f64;
            let off = windowed(&off, self.window);
            let both = || off.iter().zip(&self.level);
            for (off, level) in both() {
                worst = worst.max(off / level.max(self.noise));
            }
            // Windows that the first or the last of many echoes reach: those from any place on, before or after.
            let mut of_many = |pair: &mut dyn Iterator<Item = (&f64, &f64)>| {
                let (mut off, mut level) = (0.0, 0.0);
                for (more_off, more) in pair {
                    off += more_off;
                    level += more;
                    worst = worst.max(off / f64::max(level, self.noise_of_many));
                }
            };
            of_many(&mut both());
            of_many(&mut both().rev());
        }
        KernelErrors {
            rms: (energy / self.energy).sqrt(),
            edges: worst.sqrt(),
        }
    }

    /// Errors of an echo alone that is spread with `kernel` on a grid of `per_sample` rows a sample, to `columns`.
    pub(super) fn by_level(
        &self,
        kernel: &Kernel,
        per_sample: f64,
        columns: &Columns,
    ) -> ErrorsByLevel {
        let windows = Windows {
            samples: self.window,
            instants: 2 * FINER,
            finer: FINER,
            noise: NOISE,
        };
        let signal = self.spectrum.iter().map(|(_, value)| *value);
        let levels = windows.levels(&signal.collect::<Vec<_>>());
        let worst = |errors: &mut dyn Iterator<Item = [f64; LEVELS]>| {
            errors.fold([0.0f64; LEVELS], |worst, errors| {
                std::array::from_fn(|level| worst[level].max(errors[level]))
            })
        };
        let off_at = self.off_at(kernel, per_sample);
        let of_kernel = worst(&mut (0..PLACES).map(|place| {
            let off = off_at.iter().map(|values| values[place]).collect();
            windows.errors(off, &levels)
        }));
        if columns.taps == 1 {
            return ErrorsByLevel {
                kernel: of_kernel,
                ..Default::default()
            };
        }
        // Of the pulse times something, behind the filter.
        let filtered = |of: &dyn Fn(f64) -> Complex64| {
            let bins = self.spectrum.iter().zip(&self.gains);
            let off = bins.map(|((nu, _), gain)| of(nu * self.rate_hz) * gain);
            windows.errors(off.collect(), &levels)
        };
        let of_columns = |x: f64| {
            let taps = columns.weights_at(x);
            // A Doppler is as a shift of the pulse's narrow band.
            let shift_hz = columns.end_rad * self.rate_hz / (TAU * self.half);
            filtered(&|f_hz| {
                let fitted = taps
                    .iter()
                    .map(|(place, weight)| self.pulse.at(f_hz - place * shift_hz) * *weight);
                fitted.sum::<Complex64>() - self.pulse.at(f_hz - x * shift_hz)
            })
        };
        let power = |f_hz: f64, factors: [f64; POWERS + 1]| {
            let mut of_powers = [Complex64::ZERO; POWERS + 1];
            self.pulse.powers_at(f_hz, &mut of_powers);
            of_powers.iter().zip(factors).map(|(a, b)| a * b).sum()
        };
        let legendre = match columns.taps {
            2 => [-0.5, 0.0, 1.5, 0.0, 0.0],
            3 => [0.0, -1.5, 0.0, 2.5, 0.0],
            _ => [0.375, 0.0, -3.75, 0.0, 4.375],
        };
        ErrorsByLevel {
            kernel: of_kernel,
            columns: worst(&mut BETWEEN_COLUMNS.into_iter().map(of_columns)),
            legendre: filtered(&|f_hz| power(f_hz, legendre)),
            fourth: filtered(&|f_hz| power(f_hz, [0.0, 0.0, 0.0, 0.0, 1.0])),
            square: filtered(&|f_hz| power(f_hz, [0.0, 0.0, 1.0, 0.0, 0.0])),
        }
    }
}

/// The largest error in any window of a ping whose windows fade so much.
pub(super) fn worst(fading: f64, errors: KernelErrors) -> f64 {
    MORE * (fading * errors.rms).max(errors.edges)
}

/// The same for errors that are alike all over the echo, `end` times as large as their rms at its ends.
pub(super) fn worst_of_even(fading: f64, rms: f64, end: f64) -> f64 {
    MORE * fading.max(end) * rms
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_are_those_of_sums_of_exponential_numbers() {
        // 1 - exp(-y), and 1 - (1 + y) exp(-y).
        assert!((quantile(1, 0.3) + libm::log(0.7)).abs() < 1e-9);
        let y = quantile(2, 0.01);
        assert!((1.0 - (1.0 + y) * libm::exp(-y) - 0.01).abs() < 1e-9);
    }
}
