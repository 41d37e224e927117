//! What one echo by itself loses to the kernel over time and to the end of the sampled band, window by window.
//!
//! Both err in proportion to an echo, but a little beside it too: the kernel by some rows, what is cut off a band for longer. Where echoes
//! overlap that is lost among them. A window that holds no more than an echo's last samples, or what the receiver filter makes of its end, is held
//! to a share of that little. So an echo is made with and without, and looked at as the contract does, down to the noise.

use num_complex::Complex64;

use crate::array::filter::Decimator;
use crate::array::gridded::kernel::Kernel;
use crate::array::gridded::pulse_spectrum::{PulseSpectrum, energies};
use crate::array::gridded::transform::grid_size;
use crate::array::phasor::cis;
use crate::flow::Pulse;

/// Least samples of a window.
const LEAST_WINDOW: f64 = 32.0;
/// Noise is this far below the strongest window, dB, where the kernel is looked at; and where what lies beyond the band is, of which no choice
/// makes less: windows weaker than that, of an echo's last ring alone, are given up.
const KERNEL_NOISE_DB: f64 = 55.0;
const BAND_NOISE_DB: f64 = 40.0;
/// Of the sample rate, what is looked at: as much again lies beyond the sampled band, where the receiver filter stops.
const DENSE: f64 = 2.0;
/// Places across a cell at which a kernel is tried.
const PLACES: [f64; 3] = [0.0, 0.5, 0.95];

/// An echo at the least and at the greatest Doppler.
pub struct Alone {
    sample_rate_hz: f64,
    /// Of every bin, as transforms have them.
    frequency_hz: Vec<f64>,
    spectra: Vec<Vec<Complex64>>,
    /// Energies in all windows, and in the strongest.
    windows: Vec<(Vec<f64>, f64)>,
    length: usize,
    level_range_db: f64,
}

impl Alone {
    /// `greatest_doppler`: share of the frequency by which echoes are shifted to either side at most.
    pub fn new(
        pulse: &Pulse,
        sample_rate_hz: f64,
        filter: &Decimator,
        greatest_doppler: f64,
        level_range_db: f64,
    ) -> Self {
        let window_s = pulse.duration_s.max(LEAST_WINDOW / sample_rate_hz);
        let echo_s = pulse.duration_s * (1.0 + greatest_doppler) + 2.0 * filter.half_s();
        let dense_hz = DENSE * sample_rate_hz;
        let count = grid_size((2.0 * (echo_s + window_s) * dense_hz).ceil() as usize);
        let frequency_hz: Vec<f64> = (0..count)
            .map(|k| {
                let bin = if k < count / 2 {
                    k as f64
                } else {
                    k as f64 - count as f64
                };
                bin * dense_hz / count as f64
            })
            .collect();
        let shift_hz = greatest_doppler * pulse.center_frequency_hz;
        let spectrum = PulseSpectrum::new(pulse, dense_hz + shift_hz);
        let mut dopplers = vec![-greatest_doppler, greatest_doppler];
        dopplers.dedup();
        let spectra: Vec<Vec<Complex64>> = dopplers
            .iter()
            .map(|d| {
                let shift_hz = d * pulse.center_frequency_hz;
                let at = |&f_hz: &f64| spectrum.at(f_hz - shift_hz) * filter.gain(f_hz);
                frequency_hz.iter().map(at).collect()
            })
            .collect();
        let length = (window_s * dense_hz).ceil() as usize;
        let windows = spectra
            .iter()
            .map(|spectrum| {
                let windows = energies(spectrum.clone(), length);
                let strongest = windows.iter().copied().fold(0.0, f64::max);
                (windows, strongest)
            })
            .collect();
        Self {
            sample_rate_hz,
            frequency_hz,
            spectra,
            windows,
            length,
            level_range_db,
        }
    }

    /// Error in the worst window of what lies beyond the sampled band.
    pub fn beyond_band(&self) -> f64 {
        self.worst(BAND_NOISE_DB, |f_hz| match self.sampled(f_hz) {
            true => Complex64::ZERO,
            false => Complex64::ONE,
        })
    }

    /// Error in the worst window that a kernel makes at the places that suit it least.
    pub fn kernel(&self, kernel: &Kernel) -> f64 {
        PLACES
            .iter()
            .map(|&x| {
                let weight = |i: usize| {
                    (0..kernel.moments)
                        .rev()
                        .fold(0.0, |sum, k| sum * x + kernel.weight(k, i))
                };
                let weights: Vec<f64> = (0..kernel.width).map(weight).collect();
                let middle = 0.5 * (kernel.width - 1) as f64;
                // Frequencies in cycles per row of the grid.
                let per_hz = 1.0 / (kernel.oversampling * self.sample_rate_hz);
                self.worst(KERNEL_NOISE_DB, |f_hz| {
                    if !self.sampled(f_hz) {
                        return Complex64::ZERO;
                    }
                    let nu = f_hz * per_hz;
                    let taps = weights.iter().enumerate();
                    let sum: Complex64 =
                        taps.map(|(i, &w)| wave(nu * (i as f64 - middle)) * w).sum();
                    sum / kernel.window_gain(nu) - wave(0.5 * nu * x)
                })
            })
            .fold(0.0, f64::max)
    }

    fn sampled(&self, f_hz: f64) -> bool {
        f_hz.abs() <= 0.5 * self.sample_rate_hz
    }

    /// Error in the worst window where `off` of each frequency is amiss, in noise.
    fn worst(&self, noise_db: f64, off: impl Fn(f64) -> Complex64) -> f64 {
        let noise = 10f64.powf(-noise_db.min(self.level_range_db) / 10.0);
        let off: Vec<Complex64> = self.frequency_hz.iter().map(|&f_hz| off(f_hz)).collect();
        let mut worst: f64 = 0.0;
        for (spectrum, (windows, strongest)) in self.spectra.iter().zip(&self.windows) {
            let rest = spectrum.iter().zip(&off).map(|(s, off)| s * off).collect();
            for (off, size) in energies(rest, self.length).iter().zip(windows) {
                worst = worst.max(off / size.max(noise * strongest));
            }
        }
        worst.sqrt()
    }
}

/// exp(-j 2pi turns).
fn wave(turns: f64) -> Complex64 {
    let (cos, sin) = cis(-turns);
    Complex64::new(cos, sin)
}
