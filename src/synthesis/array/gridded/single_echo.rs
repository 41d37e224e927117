//! Single-echo error in every window of a pulse length, with a noise floor, as the accuracy
//! requirement defines it.
//! The error of an echo extends beyond the echo. A truncated band rings, and a kernel over delay
//! has errors some grid values to either side. The error of a fit over Dopplers is not a pulse
//! matched to the receiver filter. A window with only the end of an echo, or of the filter's tail,
//! needs a small error relative to that part. The check therefore synthesises an echo and its
//! error, and compares both window by window.

use num_complex::Complex64;

use crate::array::echo_profile::EchoProfile;
use crate::array::phasor::cis;
use echotank_core::pulse::MIN_WINDOW;
use echotank_fft::Planned;

use super::band::Band;
use super::doppler::{DopplerGrid, DopplerSpan, Received, templates};
use super::kernel::Kernel;
use super::one_dimensional::Spec;
use super::pulse_spectrum::{PulseSpectrum, energies};
use super::shared_out;
use super::transform::grid_size;

/// Maximum level difference to the strongest window at which a window counts by its own level, dB.
/// Sharp pulses fill every band down to that level.
const DEEPEST_DB: f64 = 60.0;

/// Tested positions across a cell of the kernel. The kernel is symmetric, with the largest error at
/// the ends or in the middle.
const PLACES: [f64; 3] = [0.0, 0.5, 0.95];

/// Positions across a cell of the kernel, -1..1, of an echo's profile.
const PROFILE_PLACES: [f64; 11] = [-1.0, -0.8, -0.6, -0.4, -0.2, 0.0, 0.2, 0.4, 0.6, 0.8, 1.0];

/// Tested positions across a cell of the Doppler grid.
const ACROSS: [f64; 6] = [0.0, 0.2, 0.45, 0.7, 0.95, 1.0];

/// Number of tested cells at an end of a Doppler grid. Further cells have little effect.
const END_CELLS: usize = 12;

/// Instants per sample at which windows are looked at: for a design, at least those of the frequencies that are looked at; for its prediction. Behind a
/// filter a window with the first samples of an echo may be weak at one place between two samples, and twice as strong an eighth of a sample beside it.
const INSTANTS_OF_PREDICTIONS: usize = 16;

/// Levels of windows below the strongest one, in steps of 5 dB. The last has all weaker ones. They go on below the noise floor: of several echoes, what none
/// of them has above it may be.
pub const LEVELS: usize = 20;
const ROOT_OF_TEN: f64 = 3.162_277_660_168_379_5;
/// The shares of the energy where they begin.
const BELOW: [f64; LEVELS - 1] = {
    let mut below = [1.0 / ROOT_OF_TEN; LEVELS - 1];
    let mut step = 1;
    while step < LEVELS - 1 {
        below[step] = below[step - 1] / ROOT_OF_TEN;
        step += 1;
    }
    below
};

/// The step of [`LEVELS`] of a window with this share of the energy of the strongest one.
pub fn level_of(share: f64) -> usize {
    BELOW.iter().map(|below| usize::from(share <= *below)).sum()
}

/// Errors of a single echo.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct EchoErrors {
    /// In the worst window, at the worst place; and in the worst one of each level.
    pub worst: f64,
    pub by_level: [f64; LEVELS],
    /// rms over the echo and over the tested places.
    pub mean: f64,
}

impl EchoErrors {
    fn new(mean: f64, by_level: [f64; LEVELS]) -> Self {
        let worst = by_level.into_iter().fold(0.0, f64::max);
        Self {
            worst,
            by_level,
            mean,
        }
    }

    /// At least this error in every window.
    pub(super) fn at_least(self, error: f64) -> Self {
        Self::new(self.mean.max(error), self.by_level.map(|of| of.max(error)))
    }

    /// Of all places.
    fn of(places: impl Iterator<Item = Self>) -> Self {
        let (mut all, mut count) = (Self::default(), 0.0f64);
        for place in places {
            all.worst = all.worst.max(place.worst);
            for (all, error) in all.by_level.iter_mut().zip(place.by_level) {
                *all = all.max(error);
            }
            all.mean += place.mean * place.mean;
            count += 1.0;
        }
        all.mean = (all.mean / count.max(1.0)).sqrt();
        all
    }
}

/// Test echoes at both ends of the span of Dopplers and at rest: where the span is wide, the receiver filter passes what is beside the carrier otherwise in
/// the middle of it.
pub(super) struct SingleEcho {
    /// Frequency of every bin in transform order: lowest first, then the negative ones.
    frequency_hz: Vec<f64>,
    /// Gain of the receiver filter.
    gain: Vec<f64>,
    spectra: Vec<Vec<Complex64>>,
    /// Energies of the echoes in all windows. The energy of the noise is the minimum.
    levels: Vec<Levels>,
    windows: Windows,
    /// Instants per sample of these spectra.
    density: usize,
}

/// The windows that a spectrum's signal is looked at in.
#[derive(Clone, Copy)]
pub(crate) struct Windows {
    /// Samples of a window, and instants per sample at which one may begin.
    pub samples: usize,
    pub instants: usize,
    /// Instants for each of the spectrum's own.
    pub finer: usize,
    /// Energy of the noise in a window relative to the strongest window.
    pub noise: f64,
}

impl Windows {
    fn energies(&self, mut spectrum: Vec<Complex64>) -> Vec<f64> {
        let count = spectrum.len();
        let more = (self.finer - 1) * count;
        spectrum.splice(
            count / 2..count / 2,
            std::iter::repeat_n(Complex64::ZERO, more),
        );
        energies(spectrum, self.samples, self.instants)
    }

    pub(crate) fn levels(&self, spectrum: &[Complex64]) -> Levels {
        let mut energies = self.energies(spectrum.to_vec());
        let strongest = energies.iter().copied().fold(0.0, f64::max);
        let steps = energies.iter_mut().map(|energy| {
            let step = level_of(*energy / strongest) as u8;
            *energy = energy.max(self.noise * strongest);
            step
        });
        let steps = steps.collect();
        Levels { energies, steps }
    }

    /// Errors of an echo, the spectrum `rest`, with these levels.
    pub(crate) fn errors(&self, rest: Vec<Complex64>, levels: &Levels) -> [f64; LEVELS] {
        levels.errors(&self.energies(rest))
    }
}

/// Energies of an echo in all windows. The energy of the noise is the minimum.
pub(crate) struct Levels {
    energies: Vec<f64>,
    /// As in [`level_of`].
    steps: Vec<u8>,
}

impl Levels {
    /// Largest ratios of these energies to those of the echo.
    fn errors(&self, off: &[f64]) -> [f64; LEVELS] {
        let mut worst = [0.0f64; LEVELS];
        for ((off, level), step) in off.iter().zip(&self.energies).zip(&self.steps) {
            let of_step = &mut worst[usize::from(*step)];
            *of_step = of_step.max(off / level);
        }
        worst.map(f64::sqrt)
    }
}

impl SingleEcho {
    /// For the choice of a design. `widest`: the frequencies looked at, to either side of the carrier, in sample rates.
    pub(super) fn for_design(
        spec: &Spec,
        span: DopplerSpan,
        spectrum: &PulseSpectrum,
        widest: f64,
    ) -> Self {
        Self::new(spec, span, spectrum, widest, 1)
    }

    /// For the prediction of its error.
    pub(super) fn for_prediction(
        spec: &Spec,
        span: DopplerSpan,
        spectrum: &PulseSpectrum,
        widest: f64,
    ) -> Self {
        Self::new(spec, span, spectrum, widest, INSTANTS_OF_PREDICTIONS)
    }

    fn new(
        spec: &Spec,
        span: DopplerSpan,
        spectrum: &PulseSpectrum,
        widest: f64,
        instants: usize,
    ) -> Self {
        let (pulse, rate_hz) = (spec.pulse, spec.sample_rate_hz);
        let filter_s = spec.filter.map_or(0.0, |f| -f.dense_first_s(0.0));
        let window_s = pulse.duration_s.max(MIN_WINDOW / rate_hz);
        let echo_s = pulse.duration_s / (1.0 + span.least.min(0.0)) + 2.0 * filter_s;
        let min_s = 2.0 * (echo_s + window_s);
        let dense_hz = 2.0 * widest * rate_hz;
        let count = grid_size((min_s * dense_hz).ceil() as usize);
        let step_hz = dense_hz / count as f64;
        let frequency_hz: Vec<f64> = (0..count)
            .map(|k| match k < count / 2 {
                true => k as f64 * step_hz,
                false => (k as f64 - count as f64) * step_hz,
            })
            .collect();
        let gain: Vec<f64> = frequency_hz
            .iter()
            .map(|&f_hz| spec.filter.map_or(1.0, |filter| filter.gain(f_hz)))
            .collect();
        let mut dopplers = vec![
            span.least,
            0f64.clamp(span.least, span.greatest),
            span.greatest,
        ];
        dopplers.dedup();
        let spectra: Vec<Vec<Complex64>> = dopplers
            .iter()
            .map(|d| {
                let shift_hz = pulse.center_frequency_hz * d;
                let all = frequency_hz.iter().zip(&gain);
                all.map(|(f_hz, gain)| spectrum.at((f_hz - shift_hz) / (1.0 + d)) * gain)
                    .collect()
            })
            .collect();
        let density = (2.0 * widest) as usize;
        let finer = instants.div_ceil(density);
        let windows = Windows {
            samples: (window_s * rate_hz).ceil() as usize,
            instants: finer * density,
            finer,
            noise: 10f64.powf(-spec.level_range_db.min(DEEPEST_DB) / 10.0),
        };
        let levels = spectra.iter().map(|spectrum| windows.levels(spectrum));
        Self {
            frequency_hz,
            gain,
            levels: levels.collect(),
            spectra,
            windows,
            density,
        }
    }

    /// Truncation error of `band`.
    pub(super) fn left_out(&self, band: &Band) -> EchoErrors {
        self.errors(|f_hz| Complex64::from(1.0 - band.gain(f_hz)))
    }

    /// Errors of `kernel` within `band`, on a grid of `grid_hz` values per second.
    pub(super) fn kernel(&self, kernel: &Kernel, band: &Band, grid_hz: f64) -> EchoErrors {
        let middle = 0.5 * (kernel.width - 1) as f64;
        let at = |x: f64| {
            let weight = |i: usize| {
                (0..kernel.moments)
                    .rev()
                    .fold(0.0, |sum, k| sum * x + kernel.weight(k, i))
            };
            let weights: Vec<f64> = (0..kernel.width).map(weight).collect();
            self.errors(|f_hz| {
                let kept = band.gain(f_hz);
                if kept == 0.0 {
                    return Complex64::ZERO;
                }
                let nu = f_hz / grid_hz;
                let taps = weights.iter().enumerate();
                let sum: Complex64 = taps.map(|(i, &w)| wave(nu * (i as f64 - middle)) * w).sum();
                (sum / kernel.window_gain(nu) - wave(0.5 * nu * x)) * kept
            })
        };
        EchoErrors::of(PLACES.into_iter().map(at))
    }

    /// Rounding errors of the grid values of an echo, which are echoes at these values. `rounding`: rms rounding error of a number, relative to it.
    pub(super) fn rounding(
        &self,
        kernel: &Kernel,
        band: &Band,
        grid_hz: f64,
        rounding: f64,
    ) -> EchoErrors {
        let echoes = self.spectra.iter().zip(&self.levels);
        EchoErrors::of(echoes.map(|(spectrum, levels)| {
            let mut off = vec![0.0; levels.energies.len()];
            let mut rest = 0.0;
            for i in 0..kernel.width {
                let value = self.rounded_value(spectrum, (kernel, i), band, grid_hz, rounding);
                rest += value.iter().map(|x| x.norm_sqr()).sum::<f64>();
                for (off, energy) in off.iter_mut().zip(self.windows.energies(value)) {
                    *off += energy;
                }
            }
            let all: f64 = spectrum.iter().map(|x| x.norm_sqr()).sum();
            let mean = (rest / all.max(f64::MIN_POSITIVE)).sqrt();
            EchoErrors::new(mean, levels.errors(&off))
        }))
    }

    /// Spectrum of the rounding error of grid value `i` of an echo. A value is a sum of powers, whose terms each round.
    fn rounded_value(
        &self,
        echo: &[Complex64],
        (kernel, i): (&Kernel, usize),
        band: &Band,
        grid_hz: f64,
        rounding: f64,
    ) -> Vec<Complex64> {
        let middle = 0.5 * (kernel.width - 1) as f64;
        let terms = PROFILE_PLACES
            .iter()
            .flat_map(|x| (0..kernel.moments).map(move |k| kernel.weight(k, i) * x.powi(k as i32)));
        let term2 = terms.map(|term| term * term).sum::<f64>() / PROFILE_PLACES.len() as f64;
        let size = rounding * term2.sqrt();
        let bins = self.frequency_hz.iter().zip(echo);
        let error = bins.map(|(&f_hz, echo)| {
            let nu = f_hz / grid_hz;
            match band.gain(f_hz) {
                0.0 => Complex64::ZERO,
                kept => {
                    let turned = wave(nu * (i as f64 - middle));
                    echo * turned * (kept * size / kernel.window_gain(nu))
                }
            }
        });
        error.collect()
    }

    /// Errors of a fit over the Dopplers of `grid`, within `band`. They are largest at the ends of the
    /// grid. For a long grid, each end is tested separately.
    pub(super) fn dopplers(
        &self,
        grid: &DopplerGrid,
        received: Received,
        band: &Band,
    ) -> EchoErrors {
        if grid.cells <= 2 * END_CELLS {
            return self.on_grid(grid, received, band);
        }
        let ends = [0, grid.cells - END_CELLS]
            .map(|first| self.on_grid(&grid.part(first, END_CELLS), received, band));
        EchoErrors::of(ends.into_iter())
    }

    fn on_grid(&self, grid: &DopplerGrid, received: Received, band: &Band) -> EchoErrors {
        let kept = self.frequency_hz.iter().zip(&self.gain);
        let kept: Vec<f64> = kept.map(|(&f_hz, gain)| band.gain(f_hz) * gain).collect();
        let bins = kept.len();
        let cells = [0, grid.cells / 2, grid.cells - 1];
        let mut used: Vec<usize> = cells.iter().flat_map(|&c| c..c + grid.taps).collect();
        used.sort_unstable();
        used.dedup();
        let columns = templates(grid, received, &used, &self.frequency_hz, &kept);
        let at = |share: f64| {
            let (doppler, first, weights) = grid.at(share);
            let echo = self.frequency_hz.iter();
            let echo: Vec<Complex64> = echo.map(|&f_hz| received.at(f_hz, doppler)).collect();
            let from = used.partition_point(|&column| column < first);
            let fitted = |bin: usize| -> Complex64 {
                let taps = weights[..grid.taps].iter().enumerate();
                taps.map(|(tap, weight)| columns[(from + tap) * bins + bin] * weight)
                    .sum()
            };
            let rest: Vec<Complex64> = (0..bins)
                .map(|bin| fitted(bin) - echo[bin] * kept[bin])
                .collect();
            let heard: Vec<Complex64> = echo.iter().zip(&self.gain).map(|(s, g)| s * g).collect();
            let mean = rms_ratio(&rest, &heard);
            EchoErrors::new(
                mean,
                self.windows.errors(rest, &self.windows.levels(&heard)),
            )
        };
        let shares: Vec<f64> = cells
            .into_iter()
            .flat_map(|cell| ACROSS.map(|across| (cell as f64 + across) / grid.cells as f64))
            .collect();
        EchoErrors::of(shared_out(shares.len(), |k| at(shares[k])).into_iter())
    }

    /// The echo at rest with the errors of `kernel` within `band`, on a grid of `grid_hz` values per second. `rounding`: rms rounding error of a number,
    /// relative to it. `everywhere`: energy of the errors that spread over the record, relative to that of the strongest window.
    pub(super) fn profile(
        &self,
        kernel: &Kernel,
        band: &Band,
        grid_hz: f64,
        [rounding, everywhere]: [f64; 2],
    ) -> EchoProfile {
        let at_rest = &self.spectra[0];
        let middle = 0.5 * (kernel.width - 1) as f64;
        let weights_at = |x: f64| -> Vec<f64> {
            let powers = |i: usize| (0..kernel.moments).rev().map(move |k| kernel.weight(k, i));
            (0..kernel.width)
                .map(|i| powers(i).fold(0.0, |sum, weight| sum * x + weight))
                .collect()
        };
        let instants = |values: Vec<Complex64>| {
            let mut values = values;
            f64::plan_inverse(values.len()).process(&mut values);
            values
        };
        let error_at = |x: f64| {
            let weights = weights_at(x);
            let bins = self.frequency_hz.iter().zip(at_rest);
            let error = bins.map(|(&f_hz, echo)| {
                let kept = band.gain(f_hz);
                if kept == 0.0 {
                    return -*echo;
                }
                let nu = f_hz / grid_hz;
                let taps = weights.iter().enumerate();
                let sum: Complex64 = taps.map(|(i, &w)| wave(nu * (i as f64 - middle)) * w).sum();
                // 1 but for the error of the kernel.
                let spread = sum / kernel.window_gain(nu) * wave(-0.5 * nu * x);
                echo * (kept * spread) - echo
            });
            instants(error.collect())
        };
        let mut squares = vec![0.0; at_rest.len()];
        for i in 0..kernel.width {
            let value = self.rounded_value(at_rest, (kernel, i), band, grid_hz, rounding);
            for (square, value) in squares.iter_mut().zip(instants(value)) {
                *square += value.norm_sqr();
            }
        }
        let errors: Vec<Vec<Complex64>> = PROFILE_PLACES.map(error_at).into();
        EchoProfile::new(
            self.density,
            instants(at_rest.clone()),
            &errors,
            &squares,
            everywhere,
        )
    }

    /// Errors if the spectrum has the relative error `amiss` at each frequency.
    fn errors(&self, amiss: impl Fn(f64) -> Complex64) -> EchoErrors {
        let amiss: Vec<Complex64> = self.frequency_hz.iter().map(|&f_hz| amiss(f_hz)).collect();
        let echoes = self.spectra.iter().zip(&self.levels);
        EchoErrors::of(echoes.map(|(spectrum, levels)| {
            let rest: Vec<Complex64> = spectrum
                .iter()
                .zip(&amiss)
                .map(|(s, off)| s * off)
                .collect();
            let mean = rms_ratio(&rest, spectrum);
            EchoErrors::new(mean, self.windows.errors(rest, levels))
        }))
    }
}

/// rms of one spectrum over that of another.
fn rms_ratio(rest: &[Complex64], of: &[Complex64]) -> f64 {
    let energy = |all: &[Complex64]| all.iter().map(|x| x.norm_sqr()).sum::<f64>();
    (energy(rest) / energy(of).max(f64::MIN_POSITIVE)).sqrt()
}

/// exp(-j 2pi turns).
fn wave(turns: f64) -> Complex64 {
    let (cos, sin) = cis(-turns);
    Complex64::new(cos, sin)
}
