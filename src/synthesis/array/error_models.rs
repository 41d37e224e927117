//! Error models of the synthesis methods. Path and Doppler models have their own in
//! [`echo::error_models`](crate::echo::error_models).
//!
//! Errors are those of the worst window of one pulse length, against the same sum without
//! approximation, after the same receiver filter. They are relative to the window or to the noise
//! floor. Costs are for one 3.7 GHz core.

use crate::error_model::{Conditions, ErrorModel};
use echotank_core::arrays::ReceiverFilter;
use echotank_core::model::Synthesis;
use echotank_core::ping::PingPlan;
use echotank_core::pulse::Pulse;

use super::filter::{FilterDesign, oversample};
use super::windows::window_error;

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

/// Predicted error and cost of one synthesis method. `filter` is its receiver filter. Only the pulse of `plan` matters.
pub fn synthesis_error_model(
    synthesis: Synthesis,
    conditions: &Conditions,
    plan: &PingPlan,
    filter: Option<FilterDesign>,
) -> ErrorModel {
    let (fading, tails) = conditions.echo_statistics.map_or_else(
        || {
            let weakest = conditions.pulse.weakest_window(conditions.sample_rate_hz);
            (1.0 / weakest, f64::INFINITY)
        },
        |echoes| (echoes.fading, echoes.tails),
    );
    let alone = || {
        window_error(synthesis, plan, conditions.sample_rate_hz, filter)
            .map(|errors| errors.of_ping(fading, tails))
    };
    let (error, why) = match (synthesis, filter) {
        (Synthesis::Reference, Some(_)) => (QUADRATURE, "filtered by quadrature".to_owned()),
        (Synthesis::Reference, None) => (1e-10, "exact".to_owned()),
        (Synthesis::Direct, None) => (RECURRENCE, "exact".to_owned()),
        (Synthesis::Direct, Some(filter)) => (
            alone().unwrap_or(WRONG),
            format!("filtered from {} points per sample", filter.oversample),
        ),
        (Synthesis::Spectral, _) => (alone().unwrap_or(WRONG), "its pulse's spectrum".to_owned()),
        (Synthesis::Nearest, _) => (
            alone().unwrap_or(WRONG),
            "echoes are moved to the nearest sample".to_owned(),
        ),
        (Synthesis::Linear, _) => (
            alone().unwrap_or(WRONG),
            "interpolation between samples".to_owned(),
        ),
        (Synthesis::Gridded1d, _) => (
            conditions.tolerance,
            "designed for the tolerance".to_owned(),
        ),
        (Synthesis::Gridded2d, _) => (
            conditions.tolerance,
            "designed for the tolerance, sections of elements at a time".to_owned(),
        ),
        (Synthesis::GriddedLines, _) => (
            conditions.tolerance,
            "designed for the tolerance, 16 elements at a time".to_owned(),
        ),
    };
    ErrorModel {
        name: synthesis.name(),
        error,
        cost_ms: synthesis_cost_ms(synthesis, conditions),
        why,
    }
}

/// Predicted core time of one synthesis method per ping, milliseconds.
pub fn synthesis_cost_ms(synthesis: Synthesis, conditions: &Conditions) -> f64 {
    let pulse = &conditions.pulse;
    let rate_hz = conditions.sample_rate_hz;
    let filtered = conditions.filter == ReceiverFilter::Fir;
    let sampled = pulse.duration_s * rate_hz;
    let window_s = 2.0 * conditions.range_m.1 / conditions.sound_speed_m_per_s + pulse.duration_s;
    let terms_ns = match synthesis {
        Synthesis::Reference => reference_points(pulse, rate_hz, filtered) * REFERENCE_NS,
        Synthesis::Direct if filtered => {
            sampled * oversample(pulse, rate_hz, synthesis) as f64 * SAMPLE_NS
        }
        Synthesis::Direct => sampled * SAMPLE_NS,
        Synthesis::Spectral => window_s * rate_hz * SAMPLE_NS,
        Synthesis::Nearest => sampled * 1.5 * SAMPLE_NS,
        Synthesis::Linear => sampled * 3.0 * SAMPLE_NS,
        Synthesis::Gridded1d => GRIDDED_NS,
        Synthesis::Gridded2d => LINE_NS,
        Synthesis::GriddedLines => LANES_NS,
    };
    conditions.scatterers as f64 * conditions.elements as f64 * terms_ns * 1e-6
}

/// Mean number of nodes per sample of the quadrature of the reference: of two panels, as a corner of
/// the filter lies anywhere between two samples.
pub const NODES_PER_SAMPLE: f64 = 16.0;

/// Number of instants at which the reference evaluates one echo.
pub fn reference_points(pulse: &Pulse, rate_hz: f64, filtered: bool) -> f64 {
    let sampled = pulse.duration_s * rate_hz;
    if !filtered {
        return sampled;
    }
    let pieces = if pulse.taper > 0.0 { 3.0 } else { 1.0 };
    // Parts of panels at both ends of a piece have the nodes of a whole one.
    (sampled + pieces) * NODES_PER_SAMPLE
}

/// Rounding error of a recurrence over 512 points.
const RECURRENCE: f64 = 512.0 * f64::EPSILON;

/// Error of the quadrature of the reference in the worst window.
const QUADRATURE: f64 = 1e-7;

/// Error of a method whose filter cannot be designed.
const WRONG: f64 = 2.0;
