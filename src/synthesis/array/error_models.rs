//! What the ways to sum echoes promise, by themselves: path and Doppler models have error models of their own.
//!
//! Errors are relative l2 against the same sum made without approximation, behind the same receiver filter. Costs are of one 3.7 GHz core.

use std::f64::consts::{FRAC_PI_2, PI, TAU};

use echotank_core::flow::{Conditions, ErrorModel, Pulse, ReceiverFilter, Synthesis};

use super::filter::{occupied_hz, oversample};
use super::gridded::pulse_spectrum::PulseSpectrum;

/// ns per echo and sample of the recurrence.
const SAMPLE_NS: f64 = 0.4;
/// ns per echo of `gridded-2d`: each is spread once for a whole stretch of elements.
const LINE_NS: f64 = 1.0;
/// ns per echo of `gridded-1d`, Doppler columns and transforms included: `tools/bench echo` has the figures of each.
const GRIDDED_NS: f64 = 30.0;
/// ns per echo and sample of the reference.
const REFERENCE_NS: f64 = 900.0;

/// The error model of one synthesis.
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
            format!("{dense} points a sample behind the filter"),
        ),
        Synthesis::Reference => (1e-10, sampled * REFERENCE_NS, "exact".to_owned()),
        Synthesis::Direct if filtered => (
            edge_error(pulse, rate_hz, dense),
            sampled * dense * SAMPLE_NS,
            format!("{dense} points a sample behind the filter"),
        ),
        Synthesis::Direct => (RECURRENCE, sampled * SAMPLE_NS, "exact".to_owned()),
        Synthesis::Spectral if filtered => {
            // Where a sharp pulse's spectrum is cut the filter's stop band still passes 1e-4 of it: it rings on, into weaker windows.
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
            "echoes lie on samples".to_owned(),
        ),
        Synthesis::Linear => (
            over_spectrum(conditions, linear_error),
            sampled * 3.0 * SAMPLE_NS,
            "interpolation between samples".to_owned(),
        ),
        Synthesis::Gridded1d => (
            conditions.tolerance,
            GRIDDED_NS,
            "made for the tolerance".to_owned(),
        ),
        Synthesis::Gridded2d => (
            conditions.tolerance,
            LINE_NS,
            "made for the tolerance, stretches of elements at a time".to_owned(),
        ),
    };
    ErrorModel {
        name: synthesis.name(),
        error,
        cost_ms: conditions.scatterers as f64 * conditions.elements as f64 * terms_ns * 1e-6,
        why,
    }
}

/// Rounding of a run of 512 points made from one start.
const RECURRENCE: f64 = 512.0 * f64::EPSILON;
/// A window may hold no more of an echo than one of its ends, where most is left: so much more than of the whole echo, counted as error checks
/// do (which takes the mean of a ping for a weaker window's level).
const ONE_END: f64 = 3.0;
const ONE_SHARP_END: f64 = 1.5;

/// What `dense` points a sample leave of a pulse's ends behind the filter, over windows of its length.
///
/// Sharp ends: the points next to an end are weighted so that cubics are integrated exactly; what that leaves depends on the points to a
/// width of the band alone, which are always as many. So either end leaves the same, whatever lies between them: of an echo of n samples
/// 1/sqrt(n), and of a window longer than the echo no more. At 200 samples 3e-4, as `filter`'s tests measure it.
///
/// A taper: its second derivative steps where flank and flat meet, by Euler and Maclaurin a step's third part of it at four places: of an echo of n
/// samples with m points on a flank 0.09/(`dense` m^2 sqrt(n)), by 40 pulses of 0.3 to 6 ms, and 1e-5 of the filter's own stop band.
fn edge_error(pulse: &Pulse, rate_hz: f64, dense: f64) -> f64 {
    if pulse.taper == 0.0 {
        // Two ends, the same whatever lies between them; 3e-4 at 200 samples.
        return ONE_SHARP_END * 3e-4 * (200.0 / (pulse.duration_s * rate_hz)).sqrt().max(1.0);
    }
    let samples = pulse.duration_s * rate_hz;
    let flank_points = 0.5 * pulse.taper * samples * dense;
    ONE_END * (0.09 / (dense * flank_points.powi(2) * samples.sqrt())).clamp(1e-5, 1.0)
}

/// Share of the energy of a pulse with sharp ends outside +-f_s/2. Beyond its sweep the spectrum is that of its two jumps, each
/// |S|^2 = 1/(2 pi (f - f_end))^2; for a taper this is far above the truth.
fn out_of_band_share(conditions: &Conditions) -> f64 {
    let pulse = &conditions.pulse;
    let (half_rate, half_band) = (0.5 * conditions.sample_rate_hz, 0.5 * pulse.bandwidth_hz);
    let tails =
        1.0 / (half_rate - half_band).max(f64::MIN_POSITIVE) + 1.0 / (half_rate + half_band);
    (2.0 * tails / (4.0 * PI * PI * pulse.duration_s)).min(1.0)
}

/// What a band leaves out of a jump, by the place of the jump between two samples: on a sample half the jump is missed, and nothing but that
/// (1/4 of its square); over all places the mean is the spectrum beyond +-f_s/2, 2 times the integral of f_s/(2 pi f)^2, which is 1/pi^2.
const WORST_JUMP: f64 = FRAC_PI_2;

/// Bands to either side over which a spectrum is looked at: the sum of samples folds what lies beyond; of 1/f^2 a hundredth is beyond these.
const FOLDS: f64 = 32.0;

/// Root mean square of `error(w)`, w radians per sample, over the pulse's spectrum: behind the receiver filter as far as that lets it pass.
fn over_spectrum(conditions: &Conditions, error: fn(f64) -> f64) -> f64 {
    let (pulse, rate_hz) = (&conditions.pulse, conditions.sample_rate_hz);
    let filtered = conditions.filter == ReceiverFilter::Fir;
    let farthest_hz = match filtered {
        true => 0.5 * rate_hz,
        false => FOLDS * rate_hz,
    };
    // The transition of the filter, about its middle: from the occupied band to half the rate.
    let pass_hz = (0.5 * occupied_hz(pulse)).min(farthest_hz);
    let spectrum = PulseSpectrum::new(pulse, farthest_hz);
    // Four to every lobe of the spectrum.
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

/// A filter's transition, near enough: from 1 at 0 to 0 at 1, half in the middle.
fn fade(x: f64) -> f64 {
    0.5 + 0.5 * (PI * x.clamp(0.0, 1.0)).cos()
}

/// Of an echo at its unluckiest, half a sample from its place: |1 - exp(-j w/2)|^2. (Over all places even, sqrt(3) less: a window may hold
/// one echo only.)
fn nearest_error(w: f64) -> f64 {
    2.0 - 2.0 * (0.5 * w).cos()
}

/// Of (x[n] + x[n-1])/2 for x(n - 1/2), the unluckiest place: |(1 + exp(-j w))/2 - exp(-j w/2)|^2 = (1 - cos(w/2))^2.
fn linear_error(w: f64) -> f64 {
    (1.0 - (0.5 * w).cos()).powi(2)
}
