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

use crate::array::filter::Decimator;
use crate::array::gridded::pulse_spectrum::PulseSpectrum;

use super::design::Spec;
use super::kernel::{BAND, Kernel};

/// The noise lies this far below the strongest window, as energy.
const NOISE: f64 = 3.162e-6;
/// Echoes of a window that the floor relies on, relative to the mean number.
const SURE: f64 = 0.125;
/// Places of an echo between two rows.
const PLACES: usize = 12;
/// Several echoes in one window, and echoes that change (motion, patterns).
const MORE: f64 = 1.3;

/// Errors of a kernel.
#[derive(Clone, Copy, Debug)]
pub(super) struct KernelErrors {
    /// rms over the echo and over its places.
    pub rms: f64,
    /// In the worst window of an echo alone, or at the beginning or the end of many.
    pub edges: f64,
}

/// An echo alone behind the receiver filter.
pub(super) struct SingleEcho {
    /// Frequencies -1..1, cycles per sample, with the spectrum there; entry k folds to bin k of `size`.
    spectrum: Vec<(f64, Complex64)>,
    size: usize,
    inverse: Arc<dyn Fft<f64>>,
    /// Length of a window, samples.
    window: usize,
    /// Energy by window, of which the noise is the least that counts.
    level: Vec<f64>,
    noise: f64,
    /// Noise below a dense succession of echoes, one per sample.
    noise_of_many: f64,
    energy: f64,
    /// Largest ratio of the mean level of windows to that of the weakest, as amplitude.
    pub(super) fading: f64,
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

impl SingleEcho {
    pub(super) fn new(spec: &Spec, filter: &Decimator) -> Self {
        let rate_hz = spec.sample_rate_hz;
        let sounding = (spec.pulse.duration_s * rate_hz).ceil();
        let window = sounding.max(MIN_WINDOW) as usize;
        let reach = (filter.half_s() * rate_hz).ceil() as usize;
        let size = (sounding as usize + 2 * (reach + window + 16)).next_power_of_two();
        let pulse = PulseSpectrum::new(spec.pulse, rate_hz + 1.0);
        let spectrum: Vec<(f64, Complex64)> = (0..2 * size)
            .map(|k| {
                let nu = k as f64 / size as f64 - if k >= size { 2.0 } else { 0.0 };
                let gain = filter.gain(nu * rate_hz);
                // From the beginning of the pulse to its middle half a period later.
                let sign = if k % 2 == 0 { 1.0 } else { -1.0 };
                (nu, pulse.at(nu * rate_hz) * (sign * gain))
            })
            .collect();
        let inverse = f64::plan_inverse(size);
        let mut samples = vec![Complex64::ZERO; size];
        for (k, (_, value)) in spectrum.iter().enumerate() {
            samples[k % size] += value;
        }
        inverse.process(&mut samples);
        let level = windowed(&samples, window);
        let greatest = level.iter().copied().fold(0.0, f64::max);
        let windows = (spec.samples as f64 / window as f64).max(1.0);
        let held = spec.min_scatterers as f64 / windows;
        let noise = greatest * NOISE * (SURE * held).max(1.0);
        let free =
            window as f64 / rate_hz * spec.pulse.bandwidth_hz.max(1.0 / spec.pulse.duration_s);
        let free = free.round() as usize + 1;
        let independent = windows * (spec.array.elements as f64 / 4.0).max(1.0);
        let fading = (free as f64 / quantile(free, 1.0 / independent.max(2.0))).sqrt();
        Self {
            energy: samples.iter().map(|x| x.norm_sqr()).sum(),
            spectrum,
            size,
            inverse,
            window,
            noise,
            noise_of_many: NOISE * level.iter().sum::<f64>(),
            level,
            fading,
        }
    }

    /// Errors of echoes spread with `kernel` on a grid of `per_sample` rows a sample.
    pub(super) fn errors(&self, kernel: &Kernel, per_sample: f64) -> KernelErrors {
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
        // Error by frequency and place; what the engine leaves out is wrong as a whole.
        let band = f64::max(0.5, BAND * per_sample);
        let off_at: Vec<[Complex64; PLACES]> = self
            .spectrum
            .iter()
            .map(|(nu, value)| {
                if nu.abs() > band {
                    return [-*value; PLACES];
                }
                let all = transforms(nu / per_sample);
                let mean = all.iter().map(|x| x.re).sum::<f64>() / PLACES as f64;
                all.map(|at| value * (at / mean - 1.0))
            })
            .collect();
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

    /// The largest error in any window of a ping.
    pub(super) fn worst(&self, errors: KernelErrors) -> f64 {
        MORE * (self.fading * errors.rms).max(errors.edges)
    }

    /// The same for errors that are alike all over the echo, `end` times as large as their rms at its ends.
    pub(super) fn worst_of_even(&self, rms: f64, end: f64) -> f64 {
        MORE * self.fading.max(end) * rms
    }
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
