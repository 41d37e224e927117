//! What the ways to sum echoes promise, by themselves: path and Doppler models have cards of their own.
//!
//! Errors are relative l2 against the same sum made without approximation, behind the same receiver filter. Costs are of one 3.7 GHz core.

use std::f64::consts::{PI, TAU};

use crate::flow::{Conditions, MethodCard, Pulse, ReceiverFilter, Synthesis};

use super::filter::{occupied_hz, oversample};

/// ns per echo and sample of the recurrence.
const SAMPLE_NS: f64 = 0.4;
/// ns per echo of `gridded-2d`: each is spread once for a whole stretch of elements.
const LINE_NS: f64 = 1.0;
/// ns per echo of `gridded-1d`, Doppler columns and transforms included: `tools/bench echo` has the figures of each.
const GRIDDED_NS: f64 = 30.0;
/// ns per echo and sample of the reference.
const REFERENCE_NS: f64 = 900.0;

/// The card of one synthesis.
pub fn synthesis_card(synthesis: Synthesis, conditions: &Conditions) -> MethodCard {
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
        Synthesis::Direct => (1e-9, sampled * SAMPLE_NS, "exact".to_owned()),
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
                share.sqrt(),
                window_s * rate_hz * SAMPLE_NS,
                format!("{share:.1e} of the pulse lies outside the sampled band"),
            )
        }
        Synthesis::Nearest => (
            nearest_error(occupied_hz(pulse) / rate_hz),
            sampled * 1.5 * SAMPLE_NS,
            "echoes lie on samples".to_owned(),
        ),
        Synthesis::Linear => (
            linear_error(occupied_hz(pulse) / rate_hz),
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
    MethodCard {
        name: synthesis.name(),
        error,
        cost_ms: conditions.scatterers as f64 * conditions.elements as f64 * terms_ns * 1e-6,
        why,
    }
}

/// What `dense` points a sample leave of a pulse's ends behind the filter, over windows of its length or 32 samples: measured, on the sweep
/// of random scenes, and over that by a third.
fn edge_error(pulse: &Pulse, rate_hz: f64, dense: f64) -> f64 {
    if pulse.taper == 0.0 {
        // Two ends, the same whatever lies between them; 3e-4 at 200 samples.
        return 3e-4 * (200.0 / (pulse.duration_s * rate_hz)).sqrt().max(1.0);
    }
    let flank_points = 0.5 * pulse.taper * pulse.duration_s * rate_hz * dense;
    2e-5 * (18.0 / flank_points).powi(2).max(1.0)
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

/// A window may hold a few echoes only, none of them on a sample: measured over 100 random scenes, by window over the mean.
pub const FEW_ECHOES: f64 = 1.4;

/// Steps per variable at which the two means below are taken.
const MEAN_STEPS: usize = 32;

/// Mean square of `f(x, y)`, x even over the band (radians per sample) and y over 0..1, rooted; with [`FEW_ECHOES`]. `band`: over the sample rate.
fn rms_over_band(band: f64, f: impl Fn(f64, f64) -> f64) -> f64 {
    let place = |i: usize| (i as f64 + 0.5) / MEAN_STEPS as f64;
    let mut sum = 0.0;
    for i in 0..MEAN_STEPS {
        for j in 0..MEAN_STEPS {
            sum += f(TAU * band * (place(i) - 0.5), place(j));
        }
    }
    FEW_ECHOES * (sum / (MEAN_STEPS * MEAN_STEPS) as f64).sqrt()
}

/// Of an echo up to half a sample from its place: |1 - exp(j w (y - 1/2))|^2.
fn nearest_error(band: f64) -> f64 {
    rms_over_band(band, |w, y| 2.0 - 2.0 * (w * (y - 0.5)).cos())
}

/// Of (1 - y) x[n] + y x[n-1] for x(n - y): |1 - y + y exp(-j w) - exp(-j w y)|^2.
fn linear_error(band: f64) -> f64 {
    rms_over_band(band, |w, y| {
        let re = 1.0 - y + y * w.cos() - (w * y).cos();
        let im = -y * w.sin() + (w * y).sin();
        re * re + im * im
    })
}
