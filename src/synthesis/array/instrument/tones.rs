//! Tones of power supplies in the samples.

use num_complex::Complex64;

use super::super::filter::Decimator;
use super::waveform::{OVERSAMPLE, SampleClock, turn};
use echotank_core::instrument::{Tone, ToneEntry, gain};
use echotank_core::time::{NS_PER_S, UtcNs};

/// Phase of a frequency at an instant since UTC 0, cycles below 1. The error is that of 2e-7 cycles, as whole seconds of whole hertz are left out.
pub(super) fn cycles_at(frequency_hz: f64, utc: UtcNs) -> f64 {
    let seconds = utc.0.div_euclid(NS_PER_S) as f64;
    let rest_s = utc.0.rem_euclid(NS_PER_S) as f64 / NS_PER_S as f64;
    let whole_hz = frequency_hz.floor();
    let of_seconds = (frequency_hz - whole_hz) * seconds;
    let of_rest = frequency_hz * rest_s;
    let cycles = (of_seconds - of_seconds.floor()) + (of_rest - of_rest.floor());
    cycles - cycles.floor()
}

/// Adds a tone to the samples of a ping that begins at `utc`.
pub(super) fn add_tone(
    tone: &Tone,
    utc: UtcNs,
    clock: SampleClock,
    filter: Option<&Decimator>,
    samples: &mut [Complex64],
) {
    let start = cycles_at(tone.frequency_hz, utc) + tone.phase_rad / std::f64::consts::TAU;
    let volts = gain(tone.level_db, 0.0).re;
    let time_s = |k: usize| clock.first_s + k as f64 / clock.rate_hz;
    match tone.entry {
        ToneEntry::Input => {
            let offset_hz = tone.frequency_hz - clock.carrier_hz;
            let amplitude = volts * filter_gain(filter, offset_hz, clock.rate_hz);
            for (k, sample) in samples.iter_mut().enumerate() {
                *sample += amplitude * turn(start + offset_hz * time_s(k));
            }
        }
        ToneEntry::Baseband => {
            let peak = std::f64::consts::SQRT_2 * volts;
            for (k, sample) in samples.iter_mut().enumerate() {
                let value = peak * turn(start + tone.frequency_hz * time_s(k)).re;
                *sample += Complex64::new(value, value);
            }
        }
    }
}

/// Gain of the receiver filter; 1 without a filter.
fn filter_gain(filter: Option<&Decimator>, offset_hz: f64, rate_hz: f64) -> f64 {
    match filter {
        None => 1.0,
        // The dense rate of the filter repeats beyond here, but the filter itself does not.
        Some(_) if offset_hz.abs() > 0.5 * OVERSAMPLE as f64 * rate_hz => 0.0,
        Some(filter) => filter.gain(offset_hz),
    }
}
