//! Templates at many uniform frequencies. They are fitted at a few frequencies and interpolated.
//!
//! A column is no longer than the longest pulse that it combines, so its spectrum is band-limited
//! over frequency. Samples at a spacing of 1/(8 half a pulse) determine it. The bins of a record
//! are hundreds of times closer. The interpolation kernel is a sinc tapered by exp(beta (sqrt(1 -
//! x^2) - 1)) (Barnett, Magland and af Klinteberg 2019), with an error of about exp(-beta).
//!
//! The inputs are a grid of Dopplers and the received pulse. The result is that of [`templates`],
//! with adjacent columns. The error is 2e-11 of the largest value, as for the table of the pulse.

use std::f64::consts::PI;

use num_complex::Complex64;

use super::doppler::{DopplerGrid, Received, templates};

/// Density of the fitted frequencies relative to the sampling limit of the pulse length.
const OVERSAMPLING: f64 = 4.0;

/// Number of fitted frequencies per interpolated value.
const TAPS: usize = 24;

/// Taper parameter. The spectrum of the taper must fit between the end of the pulse and its next
/// image.
const BETA: f64 = PI * TAPS as f64 * 0.5 * (1.0 - 1.0 / OVERSAMPLING);

/// Half the length of the longest pulse of the family, seconds.
fn reach_s(duration_s: f64, fastest: f64) -> f64 {
    0.5 * duration_s / (1.0 - fastest)
}

/// Spacing of the fitted frequencies for Dopplers up to `fastest`.
fn step_hz(duration_s: f64, fastest: f64) -> f64 {
    0.5 / (OVERSAMPLING * reach_s(duration_s, fastest))
}

/// Margin beyond the bins in which the received spectrum must be known, Hz.
pub(crate) fn beyond_hz(duration_s: f64, fastest: f64) -> f64 {
    (0.5 * TAPS as f64 + 1.0) * step_hz(duration_s, fastest)
}

/// Templates of every column in the layout `[bin * columns + column]`. Bin 0 is at `first_hz`, the
/// spacing is `bin_hz`, and `gain` is H at each bin.
pub(super) fn evenly(
    grid: &DopplerGrid,
    received: Received,
    (first_hz, bin_hz): (f64, f64),
    gain: &[f64],
) -> Vec<Complex64> {
    let (bins, columns) = (gain.len(), grid.columns);
    let all: Vec<usize> = (0..columns).collect();
    let fitted = |frequency_hz: &[f64], gain: &[f64]| {
        let fitted = templates(grid, received, &all, frequency_hz, gain);
        batched_fft(&fitted, frequency_hz.len())
    };
    let step_hz = step_hz(received.duration_s, grid.fastest());
    let lowest = (first_hz / step_hz).floor() as isize - (TAPS / 2 - 1) as isize;
    let highest_hz = first_hz + (bins - 1) as f64 * bin_hz;
    let count = ((highest_hz / step_hz).floor() as isize - lowest) as usize + TAPS / 2 + 1;
    if count >= bins {
        let frequency_hz: Vec<f64> = (0..bins).map(|q| first_hz + q as f64 * bin_hz).collect();
        return fitted(&frequency_hz, gain);
    }
    let few_hz: Vec<f64> = (0..count)
        .map(|k| (lowest + k as isize) as f64 * step_hz)
        .collect();
    let rows = fitted(&few_hz, &vec![1.0; count]);
    let mut values = vec![Complex64::ZERO; bins * columns];
    for (q, sums) in values.chunks_exact_mut(columns).enumerate() {
        let position = (first_hz + q as f64 * bin_hz) / step_hz - lowest as f64;
        // TAPS/2 frequencies at or below the bin, and as many above.
        let first = position as usize + 1 - TAPS / 2;
        let weights = weights(position - (position as usize) as f64);
        for (weight, row) in weights.iter().zip(rows[first * columns..].chunks(columns)) {
            let weight = weight * gain[q];
            for (sum, value) in sums.iter_mut().zip(row) {
                *sum += value * weight;
            }
        }
    }
    values
}

/// Transposes `[column * bins + bin]` to `[bin * columns + column]`.
fn batched_fft(fitted: &[Complex64], bins: usize) -> Vec<Complex64> {
    let columns = fitted.len() / bins;
    let mut rows = vec![Complex64::ZERO; fitted.len()];
    for (column, values) in fitted.chunks_exact(bins).enumerate() {
        for (row, value) in rows.chunks_exact_mut(columns).zip(values) {
            row[column] = *value;
        }
    }
    rows
}

/// Weights of the fitted frequencies for a position `x`, 0..1, between the two in the middle.
fn weights(x: f64) -> [f64; TAPS] {
    // Near the ends of 0..1, sin(pi x) and `away` are computed from the smaller distance, which
    // limits the rounding error.
    let sine = libm::sin(PI * x.min(1.0 - x)) / PI;
    std::array::from_fn(|i| {
        let away = x - (i as f64 - (TAPS / 2 - 1) as f64);
        let share = away / (0.5 * TAPS as f64);
        let taper = libm::exp(BETA * ((1.0 - share * share).max(0.0).sqrt() - 1.0));
        let sinc = match away == 0.0 {
            true => 1.0,
            // sin(pi (x + n)) is sin(pi x) with a sign; tap TAPS/2 - 1 has n = 0.
            false if (i + TAPS / 2 - 1).is_multiple_of(2) => sine / away,
            false => -sine / away,
        };
        sinc * taper
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::array::gridded::doppler::{DopplerSpan, POWERS};
    use crate::array::gridded::kernel::Kernel;
    use crate::array::gridded::pulse_spectrum::PulseSpectrum;
    use echotank_core::pulse::{Pulse, PulseKind};

    /// Bins are around 0 Hz, which is a fitted frequency. A bin that equals a fitted frequency up
    /// to rounding has its value.
    #[test]
    fn bins_at_a_fitted_frequency_up_to_rounding_take_its_value() {
        for k in 0..60 {
            let off = 0.5 * f64::from(k) * f64::EPSILON;
            for (x, on) in [(off, TAPS / 2 - 1), (1.0 - off, TAPS / 2)] {
                for (i, weight) in weights(x).into_iter().enumerate() {
                    let want = f64::from(u8::from(i == on));
                    assert!((weight - want).abs() < 1e-14, "{x}, tap {i}: {weight}");
                }
            }
        }
    }

    /// Sharp and tapered pulses, with and without curvature, against the fit at every bin.
    #[test]
    fn interpolated_templates_equal_those_fitted_at_every_bin() {
        for (taper, order) in [(0.0, 0), (0.2, 0), (0.0, 1), (0.0, 3)] {
            let pulse = Pulse {
                kind: PulseKind::LfmUp,
                center_frequency_hz: 100e3,
                bandwidth_hz: 10e3,
                duration_s: 2e-3,
                taper,
            };
            let span = DopplerSpan {
                least: -2e-3,
                greatest: 3e-3,
            };
            let beyond_hz = beyond_hz(pulse.duration_s, 3e-3);
            let spectrum = PulseSpectrum::with_powers(&pulse, 20e3 + beyond_hz, 2 * order);
            let received = Received {
                spectrum: &spectrum,
                carrier_hz: pulse.center_frequency_hz,
                duration_s: pulse.duration_s,
                order,
                greatest_p: 0.3,
            };
            let grid = DopplerGrid::new(span, 4, &Kernel::new(5, 2.0, POWERS));
            let (first_hz, bin_hz) = (-17e3 + 0.3, 7.7);
            let gain: Vec<f64> = (0..4400).map(|q| libm::cos(2e-4 * f64::from(q))).collect();
            let got = evenly(&grid, received, (first_hz, bin_hz), &gain);
            let columns: Vec<usize> = (0..grid.columns).collect();
            let all_hz: Vec<f64> = (0..4400)
                .map(|q| first_hz + f64::from(q) * bin_hz)
                .collect();
            let want = batched_fft(&templates(&grid, received, &columns, &all_hz, &gain), 4400);
            let most = want.iter().map(|v| v.norm()).fold(0.0, f64::max);
            let off = got.iter().zip(&want).map(|(g, w)| (g - w).norm());
            let off = off.fold(0.0, f64::max) / most;
            println!("taper {taper}, term {order}: {off:.1e}");
            assert!(off < 5e-11, "taper {taper}, term {order}: {off:e}");
        }
    }
}
