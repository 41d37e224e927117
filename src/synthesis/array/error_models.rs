//! Error models of the synthesis methods. Path and Doppler models have their own in
//! [`echo::error_models`](crate::echo::error_models).
//!
//! Errors are relative l2 against the same sum without approximation, after the same receiver
//! filter. Costs are for one 3.7 GHz core.

use std::f64::consts::{FRAC_PI_2, PI, TAU};

use crate::error_model::{Conditions, ErrorModel};
use echotank_core::arrays::ReceiverFilter;
use echotank_core::model::Synthesis;
use echotank_core::pulse::Pulse;

use super::filter::{occupied_hz, oversample};
use super::gridded::pulse_spectrum::PulseSpectrum;

/// Cost of the recurrence, ns per echo and sample.
const SAMPLE_NS: f64 = 0.4;
/// Cost of `gridded-2d`, ns per echo. An echo is spread once for several elements.
const LINE_NS: f64 = 1.0;
/// Cost of `gridded-lines`, ns per echo, with transforms; measured by `tools/bench echo`.
const LANES_NS: f64 = 2.0;
/// Cost of `gridded-1d`, ns per echo, with Doppler columns and transforms; measured by `tools/bench
/// echo`.
const GRIDDED_NS: f64 = 30.0;
/// Cost of the reference, ns per echo and sample.
const REFERENCE_NS: f64 = 900.0;

/// Predicted error and cost of one synthesis method.
pub fn synthesis_error_model(synthesis: Synthesis, conditions: &Conditions) -> ErrorModel {
    let pulse = &conditions.pulse;
    let rate_hz = conditions.sample_rate_hz;
    let filtered = conditions.filter == ReceiverFilter::Fir;
    let dense = oversample(pulse, rate_hz, synthesis) as f64;
    let sampled = pulse.duration_s * rate_hz;
    let window_s = 2.0 * conditions.range_m.1 / conditions.sound_speed_m_per_s + pulse.duration_s;
    let (error, terms_ns, why) = match synthesis {
        Synthesis::Reference if filtered => (
            1e-6,
            sampled * dense * REFERENCE_NS,
            format!("filtered from {dense} points per sample"),
        ),
        Synthesis::Reference => (1e-10, sampled * REFERENCE_NS, "exact".to_owned()),
        Synthesis::Direct if filtered => (
            edge_error(pulse, rate_hz, dense),
            sampled * dense * SAMPLE_NS,
            format!("filtered from {dense} points per sample"),
        ),
        Synthesis::Direct => (RECURRENCE, sampled * SAMPLE_NS, "exact".to_owned()),
        Synthesis::Spectral if filtered => {
            // A truncated spectrum of a sharp pulse leaves 1e-4 in the stop band of the filter.
            // This part rings into weaker windows.
            let cut = match pulse.taper > 0.0 {
                true => 0.0,
                false => 1.5e-3 * out_of_band_share(conditions).sqrt(),
            };
            (
                cut.max(2e-6),
                window_s * rate_hz * SAMPLE_NS,
                "its pulse's spectrum".to_owned(),
            )
        }
        Synthesis::Spectral => {
            let share = out_of_band_share(conditions);
            (
                WORST_JUMP * share.sqrt(),
                window_s * rate_hz * SAMPLE_NS,
                format!("{share:.1e} of the pulse lies outside the sampled band"),
            )
        }
        Synthesis::Nearest => (
            over_spectrum(conditions, nearest_error),
            sampled * 1.5 * SAMPLE_NS,
            "echoes are moved to the nearest sample".to_owned(),
        ),
        Synthesis::Linear => (
            over_spectrum(conditions, linear_error),
            sampled * 3.0 * SAMPLE_NS,
            "interpolation between samples".to_owned(),
        ),
        Synthesis::Gridded1d => (
            conditions.tolerance,
            GRIDDED_NS,
            "designed for the tolerance".to_owned(),
        ),
        Synthesis::Gridded2d => (
            conditions.tolerance,
            LINE_NS,
            "designed for the tolerance, sections of elements at a time".to_owned(),
        ),
        Synthesis::GriddedLines => (
            conditions.tolerance,
            LANES_NS,
            "designed for the tolerance, 16 elements at a time".to_owned(),
        ),
    };
    ErrorModel {
        name: synthesis.name(),
        error,
        cost_ms: conditions.scatterers as f64 * conditions.elements as f64 * terms_ns * 1e-6,
        why,
    }
}

/// Rounding error of a recurrence over 512 points.
const RECURRENCE: f64 = 512.0 * f64::EPSILON;
/// Ratio of the error in a window that holds one end of an echo to the error of the whole echo. It
/// follows the rule of the error checks, which take the mean of a ping as the level of a weaker
/// window.
const ONE_END: f64 = 3.0;
const ONE_SHARP_END: f64 = 1.5;

/// Error at the ends of a pulse from `dense` points per sample, after the filter, over windows of
/// one pulse length.
///
/// Sharp ends: the weights of the points next to an end integrate cubics exactly. The remainder
/// depends only on a fixed number of points within the filter width, so each end leaves the same
/// error. It is 1/sqrt(n) of an echo of n samples, and no more in a longer window. The tests of
/// `filter` measure 3e-4 at 200 samples.
///
/// A taper: its second derivative has a step between flank and flat top. By the Euler-Maclaurin
/// formula the error is a third of that step at four places: 0.09/(`dense` m^2 sqrt(n)) for an echo
/// of n samples with m points on a flank, fitted to 40 pulses of 0.3 to 6 ms. The stop band of the
/// filter adds 1e-5.
fn edge_error(pulse: &Pulse, rate_hz: f64, dense: f64) -> f64 {
    if pulse.taper == 0.0 {
        // The two ends contribute independently of the pulse length: 3e-4 at 200 samples.
        return ONE_SHARP_END * 3e-4 * (200.0 / (pulse.duration_s * rate_hz)).sqrt().max(1.0);
    }
    let samples = pulse.duration_s * rate_hz;
    let flank_points = 0.5 * pulse.taper * samples * dense;
    ONE_END * (0.09 / (dense * flank_points.powi(2) * samples.sqrt())).clamp(1e-5, 1.0)
}

/// Share of the energy of a pulse with sharp ends outside +-f_s/2. Beyond its sweep the spectrum is
/// that of its two jumps, each |S|^2 = 1/(2 pi (f - f_end))^2. For a tapered pulse this is far
/// above the true share.
fn out_of_band_share(conditions: &Conditions) -> f64 {
    let pulse = &conditions.pulse;
    let (half_rate, half_band) = (0.5 * conditions.sample_rate_hz, 0.5 * pulse.bandwidth_hz);
    let tails =
        1.0 / (half_rate - half_band).max(f64::MIN_POSITIVE) + 1.0 / (half_rate + half_band);
    (2.0 * tails / (4.0 * PI * PI * pulse.duration_s)).min(1.0)
}

/// Ratio of the worst to the rms error of a band-limited step, over its position between two
/// samples. On a sample, half the step is lost (1/4 of its square). The mean over all positions is
/// the spectrum beyond +-f_s/2: twice the integral of f_s/(2 pi f)^2, which is 1/pi^2.
const WORST_JUMP: f64 = FRAC_PI_2;

/// Number of bands on either side whose aliases are summed. For a 1/f^2 spectrum, one hundredth of
/// the energy lies beyond them.
const FOLDS: f64 = 32.0;

/// Rms of `error(w)`, w in radians per sample, over the spectrum of the pulse, limited to the pass
/// band of the receiver filter if there is one.
fn over_spectrum(conditions: &Conditions, error: fn(f64) -> f64) -> f64 {
    let (pulse, rate_hz) = (&conditions.pulse, conditions.sample_rate_hz);
    let filtered = conditions.filter == ReceiverFilter::Fir;
    let farthest_hz = match filtered {
        true => 0.5 * rate_hz,
        false => FOLDS * rate_hz,
    };
    // Transition of the filter from the occupied band to half the rate, with the passband edge in
    // its middle.
    let pass_hz = (0.5 * occupied_hz(pulse)).min(farthest_hz);
    let spectrum = PulseSpectrum::new(pulse, farthest_hz);
    // Four points per lobe of the spectrum.
    let step_hz = 0.25 / pulse.duration_s;
    let (mut off, mut all) = (0.0, 0.0);
    for k in 0..(farthest_hz / step_hz) as usize {
        let f_hz = (k as f64 + 0.5) * step_hz;
        let pass = match filtered && f_hz > pass_hz {
            true => fade((f_hz - pass_hz) / (farthest_hz - pass_hz)),
            false => 1.0,
        };
        for f_hz in [-f_hz, f_hz] {
            let energy = (spectrum.at(f_hz) * pass).norm_sqr();
            off += energy * error(TAU * f_hz / rate_hz);
            all += energy;
        }
    }
    (off / all).sqrt()
}

/// Approximate transition of a filter: 1 at 0, one half in the middle, 0 at 1.
fn fade(x: f64) -> f64 {
    0.5 + 0.5 * (PI * x.clamp(0.0, 1.0)).cos()
}

/// Worst case of an echo half a sample from its position: |1 - exp(-j w/2)|^2. The mean over all
/// positions is smaller by sqrt(3), but a window may have a single echo.
fn nearest_error(w: f64) -> f64 {
    2.0 - 2.0 * (0.5 * w).cos()
}

/// Worst case of (x[n] + x[n-1])/2 for x(n - 1/2): |(1 + exp(-j w))/2 - exp(-j w/2)|^2 = (1 -
/// cos(w/2))^2.
fn linear_error(w: f64) -> f64 {
    (1.0 - (0.5 * w).cos()).powi(2)
}
