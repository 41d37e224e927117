//! What a tolerance needs, at the least cost: the band, the kernel over delay, the grid of Dopplers.

use crate::flow::DopplerModel;

use super::doppler::{DopplerGrid, DopplerSpan};
use super::kernel::{Kernel, MIN_WIDTH};
use super::moments::{MAX_TAPS, Real};
use super::one_dimensional::{GriddedError, Spec};
use super::pulse_spectrum::PulseSpectrum;
use super::transform::grid_size;

/// Each of three errors may take this share of the tolerance: kernel over delay, kernel over Doppler, band left out.
pub const SHARE: f64 = 1.0 / 3.0;

/// Multiples of the sample rate that the band may have.
pub const MOST_BANDS: usize = 8;

/// Band, in multiples of the sample rate, outside of which the received pulse has no more than the share at any Doppler; and what it has
/// there.
pub fn band(
    spec: &Spec,
    span: DopplerSpan,
    spectrum: &PulseSpectrum,
) -> Result<(usize, f64), GriddedError> {
    let ends: Vec<Vec<f64>> = [span.least, span.greatest]
        .iter()
        .map(|&d| shares(spec, d, spectrum))
        .collect();
    let share = |bands: usize| ends.iter().map(|s| s[bands]).fold(0.0, f64::max);
    // With a filter the widest band is what the others are measured by.
    let most = match spec.filter {
        None => MOST_BANDS,
        Some(_) => MOST_BANDS / 2,
    };
    (1..=most)
        .find(|&bands| share(bands) <= SHARE * spec.tolerance)
        .map(|bands| (bands, share(bands)))
        .ok_or(GriddedError::OutOfBand {
            tolerance: spec.tolerance,
            share: share(most),
        })
}

/// Amplitude share of an echo of Doppler `d` outside of 0, 1, ... [`MOST_BANDS`] multiples of the sample rate.
fn shares(spec: &Spec, d: f64, spectrum: &PulseSpectrum) -> Vec<f64> {
    let shift_hz = spec.pulse.center_frequency_hz * d;
    let step_hz = 0.25 / spec.pulse.duration_s;
    let edge_hz = |bands: usize| 0.5 * bands as f64 * spec.sample_rate_hz;
    let mut outside = [0.0; MOST_BANDS + 1];
    let steps = (edge_hz(MOST_BANDS) / step_hz) as i64;
    for k in -steps..=steps {
        let f_hz = k as f64 * step_hz;
        let gain = spec.filter.map_or(1.0, |filter| filter.gain(f_hz));
        let energy = (spectrum.at(f_hz - shift_hz) * gain).norm_sqr() * step_hz;
        for (bands, outside) in outside.iter_mut().enumerate() {
            if f_hz.abs() > edge_hz(bands) || bands == 0 {
                *outside += energy;
            }
        }
    }
    let within = outside[0];
    // Parseval tells what lies beyond the widest band, down to rounding; a filter leaves nothing there.
    let beyond = match spec.filter {
        None => (spectrum.energy() - within).max(0.0),
        Some(_) => 0.0,
    };
    let share = |outside: &f64| ((outside + beyond) / (within + beyond)).sqrt();
    outside.iter().map(share).collect()
}

/// The kernel over delay: the smallest grid on which `widest` reaches the share.
pub fn delay_kernel<M: Real>(
    tolerance: f64,
    bins: usize,
    widest: usize,
) -> Option<(usize, Kernel)> {
    [1.25, 1.5, 2.0].into_iter().find_map(|oversampling| {
        let grid = grid_size((bins as f64 * oversampling) as usize);
        (MIN_WIDTH..=widest)
            .map(|width| Kernel::new(width, grid as f64 / bins as f64, M::MOMENTS))
            .find(|kernel| kernel.error <= SHARE * tolerance)
            .map(|kernel| (grid, kernel))
    })
}

// Nanoseconds of one core, rough: measured on two processors, within a factor of two.
pub const NS_PER_ARRIVAL: f64 = 8.0;
pub const NS_PER_TAP: f64 = 1.5;
pub const NS_PER_GRID_VALUE: f64 = 8.0;

/// The grid of Dopplers that costs least.
pub fn doppler_grid<M: Real>(spec: &Spec, bins_hz: f64, grid: usize) -> Option<DopplerGrid> {
    let span_width = spec.span.greatest - spec.span.least;
    let phase = std::f64::consts::TAU * spec.pulse.center_frequency_hz * spec.pulse.duration_s;
    // One scatterer at the end of the span, its phase running linearly away from the template's: model.md 11.
    let common_error = phase * 0.5 * span_width / 12f64.sqrt();
    if spec.doppler == DopplerModel::None || common_error <= SHARE * spec.tolerance {
        return Some(DopplerGrid::common());
    }
    let reach = 0.5 * spec.pulse.duration_s * (spec.pulse.center_frequency_hz + 0.5 * bins_hz)
        / (1.0 - spec.span.least.abs().max(spec.span.greatest)).powi(2);
    let cost = |g: &DopplerGrid| {
        g.taps as f64 * NS_PER_TAP * spec.arrivals as f64
            + g.columns as f64 * NS_PER_GRID_VALUE * grid as f64
    };
    [1.5, 2.0, 3.0, 4.0]
        .into_iter()
        .filter_map(|oversampling| {
            (MIN_WIDTH..=MAX_TAPS)
                .map(|taps| DopplerGrid::new(spec.span, reach, taps, oversampling, M::MOMENTS))
                .find(|grid| grid.error <= SHARE * spec.tolerance)
        })
        .min_by(|a, b| cost(a).total_cmp(&cost(b)))
}
