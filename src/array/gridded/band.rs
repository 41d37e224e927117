//! The band of a received pulse that is kept.
//!
//! What is left out of an echo must be little in every window: it lies about the ends of pulses, and what is cut sharply rings on, where there is no
//! echo at all. So an echo is made with and without it, and looked at window by window, as the contract does.

use std::sync::LazyLock;

use num_complex::Complex64;

use crate::array::filter::bessel_i0;
use crate::flow::LEAST_WINDOW;

use super::choose::SHARE;
use super::doppler::DopplerSpan;
use super::one_dimensional::{GriddedError, Spec};
use super::pulse_spectrum::{PulseSpectrum, energies};
use super::transform::grid_size;

/// Multiples of the sample rate that the band may have, without a filter; with one half as many.
pub const MOST_BANDS: usize = 8;

/// Windows that are weaker than the strongest by more than this are counted against it: a sharp pulse fills every band to that depth.
const DEEPEST_DB: f64 = 60.0;

/// Bands are tried in steps of this share of the sample rate.
const STEP: f64 = 0.125;

/// Of the tolerance, what may be left out where no band leaves out less than [`SHARE`].
const LAST_SHARE: f64 = 0.7;

/// The band that is kept of the received pulse.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Band {
    /// Kept whole up to here to either side.
    pub whole_hz: f64,
    /// Beyond that it is let fade over this; 0: cut.
    pub fade_hz: f64,
    /// Of the tolerance's norm: error that leaving out the rest makes in the worst window.
    pub outside: f64,
}

/// Over which a band fades, in sample rates: what it leaves out of an echo then stays within 24 samples of it.
const FADE: f64 = 0.125;

/// The fade is the integral of a Kaiser window: beyond the samples just named 70 dB down.
const FADE_BETA: f64 = 9.0;

impl Band {
    /// Share of frequency `f_hz` that is kept.
    pub fn gain(&self, f_hz: f64) -> f64 {
        let beyond_hz = f_hz.abs() - self.whole_hz;
        if beyond_hz <= 0.0 {
            return 1.0;
        }
        if beyond_hz >= self.fade_hz {
            return 0.0;
        }
        let place = beyond_hz / self.fade_hz * (FADING.len() - 1) as f64;
        let (cell, x) = (place as usize, place.fract());
        FADING[cell] * (1.0 - x) + FADING[cell + 1] * x
    }
}

/// The integral from the outer end of the fade to its inner one.
static FADING: LazyLock<Vec<f64>> = LazyLock::new(|| {
    const STEPS: usize = 1024;
    let bump = |i: usize| {
        let x = 2.0 * (i as f64 + 0.5) / STEPS as f64 - 1.0;
        bessel_i0(FADE_BETA * (1.0 - x * x).sqrt())
    };
    let all: f64 = (0..STEPS).map(bump).sum();
    let mut left = all;
    let mut fading = vec![1.0];
    for i in 0..STEPS {
        left -= bump(i);
        fading.push((left / all).max(0.0));
    }
    fading
});

/// How far to either side of the carrier the band of pulses is looked at, sample rates: twice the widest band, or with a filter the widest, which the
/// others are measured by.
pub fn widest(filtered: bool) -> f64 {
    match filtered {
        true => 0.25 * MOST_BANDS as f64,
        false => MOST_BANDS as f64,
    }
}

/// The narrowest band that leaves out no more than its share in any window, at the ends of the span of Dopplers.
pub fn band(
    spec: &Spec,
    span: DopplerSpan,
    spectrum: &PulseSpectrum,
) -> Result<Band, GriddedError> {
    let echoes = Echoes::new(spec, span, spectrum);
    let most = match spec.filter {
        None => MOST_BANDS,
        Some(_) => MOST_BANDS / 2,
    };
    let steps = (most as f64 / STEP) as usize;
    let mut least: Option<Band> = None;
    for step in (0.5 / STEP) as usize..=steps {
        let half_hz = 0.5 * step as f64 * STEP * spec.sample_rate_hz;
        for fade_hz in [0.0, FADE * spec.sample_rate_hz] {
            let mut band = Band {
                whole_hz: half_hz - fade_hz,
                fade_hz,
                outside: 0.0,
            };
            band.outside = echoes.left_out(&band);
            if band.outside <= SHARE * spec.tolerance {
                return Ok(band);
            }
            if least.is_none_or(|least| band.outside < least.outside) {
                least = Some(band);
            }
        }
    }
    match least {
        Some(band) if band.outside <= LAST_SHARE * spec.tolerance => Ok(band),
        least => Err(GriddedError::OutOfBand {
            tolerance: spec.tolerance,
            share: least.map_or(1.0, |band| band.outside),
        }),
    }
}

/// An echo at either end of the span of Dopplers, by itself.
struct Echoes {
    /// Of every bin, lowest first and then the negative ones, as transforms have them.
    frequency_hz: Vec<f64>,
    spectra: Vec<Vec<Complex64>>,
    /// Energies in all windows, or that of the noise where it is more.
    windows: Vec<Vec<f64>>,
    length: usize,
}

impl Echoes {
    fn new(spec: &Spec, span: DopplerSpan, spectrum: &PulseSpectrum) -> Self {
        let (pulse, rate_hz) = (spec.pulse, spec.sample_rate_hz);
        let filter_s = spec.filter.map_or(0.0, |f| -f.dense_first_s(0.0));
        let window_s = pulse.duration_s.max(LEAST_WINDOW / rate_hz);
        let echo_s = pulse.duration_s / (1.0 + span.least.min(0.0)) + 2.0 * filter_s;
        let least_s = 2.0 * (echo_s + window_s);
        let dense_hz = 2.0 * widest(spec.filter.is_some()) * rate_hz;
        let count = grid_size((least_s * dense_hz).ceil() as usize);
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
        let mut dopplers = vec![span.least, span.greatest];
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
        let length = (window_s * dense_hz).ceil() as usize;
        let noise = 10f64.powf(-spec.level_range_db.min(DEEPEST_DB) / 10.0);
        let windows = spectra
            .iter()
            .map(|spectrum| {
                let mut windows = energies(spectrum.clone(), length);
                let strongest = windows.iter().copied().fold(0.0, f64::max);
                windows
                    .iter_mut()
                    .for_each(|w| *w = w.max(noise * strongest));
                windows
            })
            .collect();
        Self {
            frequency_hz,
            spectra,
            windows,
            length,
        }
    }

    /// Error in the worst window.
    fn left_out(&self, band: &Band) -> f64 {
        let mut worst: f64 = 0.0;
        for (spectrum, windows) in self.spectra.iter().zip(&self.windows) {
            let all = spectrum.iter().zip(&self.frequency_hz);
            let rest = all.map(|(s, &f_hz)| s * (1.0 - band.gain(f_hz))).collect();
            for (off, size) in energies(rest, self.length).iter().zip(windows) {
                worst = worst.max(off / size);
            }
        }
        worst.sqrt()
    }
}
