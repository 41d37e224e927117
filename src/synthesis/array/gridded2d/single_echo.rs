//! Single-echo error of the kernel over time and of the truncated band, window by window.
//!
//! Both errors are proportional to an echo but extend beside it: that of the kernel by some rows,
//! that of the band for longer. Overlapping echoes hide them. A window that holds only the last
//! samples of an echo, or the filter's response to its end, requires a small error relative to that
//! part. The check therefore synthesises an echo with and without the error, and compares the two
//! in windows down to the noise.

use num_complex::Complex64;

use crate::array::filter::Decimator;
use crate::array::gridded::kernel::Kernel;
use crate::array::gridded::pulse_spectrum::{PulseSpectrum, energies};
use crate::array::gridded::transform::grid_size;
use crate::array::phasor::cis;
use echotank_core::pulse::{FLOOR_BELOW_STRONGEST_DB, Pulse};

/// Smallest window, samples.
const MIN_WINDOW: f64 = 32.0;
/// Width of the check in sample rates. Half of it lies beyond the sampled band, where the receiver
/// filter stops.
const DENSE: f64 = 2.0;
/// Share of an echo's energy allowed beyond the part of the band that kernels are designed for; and
/// the smallest such part.
const CORE_REST: f64 = 1e-5;
const MIN_CORE: f64 = 0.3;
/// Level of the noise below the strongest window, dB, for a given level range.
pub fn noise_db(level_range_db: f64) -> f64 {
    level_range_db.clamp(0.0, FLOOR_BELOW_STRONGEST_DB)
}

/// Positions across a cell at which a kernel is tested.
const PLACES: [f64; 3] = [0.0, 0.5, 0.95];

/// Echoes at the smallest and at the largest Doppler.
pub struct SingleEcho {
    sample_rate_hz: f64,
    /// Frequency of every bin, in transform order.
    frequency_hz: Vec<f64>,
    spectra: Vec<Vec<Complex64>>,
    /// Energies in all windows, and in the strongest.
    windows: Vec<(Vec<f64>, f64)>,
    length: usize,
    level_range_db: f64,
}

impl SingleEcho {
    /// Prepares the echoes. `greatest_doppler` is the largest relative frequency shift to either
    /// side.
    pub fn new(
        pulse: &Pulse,
        sample_rate_hz: f64,
        filter: &Decimator,
        greatest_doppler: f64,
        level_range_db: f64,
    ) -> Self {
        let window_s = pulse.duration_s.max(MIN_WINDOW / sample_rate_hz);
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
                let windows = energies(spectrum.clone(), length, 1);
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

    /// Error in the worst window from energy beyond the sampled band.
    pub fn beyond_band(&self) -> f64 {
        let off = |&f_hz: &f64| match self.sampled(f_hz) {
            true => Complex64::ZERO,
            false => Complex64::ONE,
        };
        let off: Vec<Complex64> = self.frequency_hz.iter().map(off).collect();
        self.worst(&off)
    }

    /// Error of the whole echo and in the worst window for a kernel designed for the share `core`
    /// of the band, at the worst position.
    pub fn kernel(&self, kernel: &Kernel, core: f64) -> [f64; 2] {
        let mut most = [0.0f64; 2];
        for x in PLACES {
            let weight = |i: usize| {
                (0..kernel.moments)
                    .rev()
                    .fold(0.0, |sum, k| sum * x + kernel.weight(k, i))
            };
            let weights: Vec<f64> = (0..kernel.width).map(weight).collect();
            let middle = 0.5 * (kernel.width - 1) as f64;
            // Frequencies in cycles per row of the grid.
            let per_hz = 1.0 / (kernel.oversampling * core * self.sample_rate_hz);
            let off = |&f_hz: &f64| {
                if !self.sampled(f_hz) {
                    return Complex64::ZERO;
                }
                let nu = f_hz * per_hz;
                let taps = weights.iter().enumerate();
                let sum: Complex64 = taps.map(|(i, &w)| wave(nu * (i as f64 - middle)) * w).sum();
                sum / kernel.window_gain(nu) - wave(0.5 * nu * x)
            };
            let off: Vec<Complex64> = self.frequency_hz.iter().map(off).collect();
            most[0] = most[0].max(self.whole(&off));
            most[1] = most[1].max(self.worst(&off));
        }
        most
    }

    /// Central share of the band beyond which an echo has almost no energy.
    pub fn core(&self) -> f64 {
        let reach = |spectrum: &Vec<Complex64>| {
            let all: f64 = spectrum.iter().map(|s| s.norm_sqr()).sum();
            // From the edges inwards: bins of both signs lie symmetrically about the middle of the
            // list.
            let (half, mut beyond) = (spectrum.len() / 2, 0.0);
            for k in 0..half {
                beyond += spectrum[half - k].norm_sqr()
                    + spectrum[(half + k) % spectrum.len()].norm_sqr();
                if beyond > CORE_REST * all {
                    return (half - k) as f64 * DENSE / half as f64;
                }
            }
            0.0
        };
        let most = self.spectra.iter().map(reach).fold(0.0, f64::max);
        most.clamp(MIN_CORE, 1.0)
    }

    fn sampled(&self, f_hz: f64) -> bool {
        f_hz.abs() <= 0.5 * self.sample_rate_hz
    }

    /// Error of the whole echo if each frequency has the error `off`.
    fn whole(&self, off: &[Complex64]) -> f64 {
        let energy = |s: Complex64| s.norm_sqr();
        let error = |spectrum: &Vec<Complex64>| {
            let all: f64 = spectrum.iter().map(|s| energy(*s)).sum();
            let rest: f64 = spectrum
                .iter()
                .zip(off)
                .map(|(s, off)| energy(s * off))
                .sum();
            rest / all.max(f64::MIN_POSITIVE)
        };
        let errors = self.spectra.iter().map(error);
        errors.fold(0.0, f64::max).sqrt()
    }

    /// Error in the worst window, with noise, if each frequency has the error `off`.
    fn worst(&self, off: &[Complex64]) -> f64 {
        let noise = 10f64.powf(-noise_db(self.level_range_db) / 10.0);
        let mut worst: f64 = 0.0;
        for (spectrum, (windows, strongest)) in self.spectra.iter().zip(&self.windows) {
            let rest = spectrum.iter().zip(off).map(|(s, off)| s * off).collect();
            for (off, size) in energies(rest, self.length, 1).iter().zip(windows) {
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
