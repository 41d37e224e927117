//! What path and Doppler models promise: errors of element samples against the reference, worst direction, as closed forms.
//!
//! Phases are rms over the pulse. Costs are of the model alone, per scatterer and element, on one 3.7 GHz core.

use std::f64::consts::TAU;

use crate::flow::{Conditions, DopplerModel, MethodCard, MethodRefused, PathModel};

/// f64 delays of 0.3 s at 400 kHz and what follows from them.
const F64_FLOOR: f64 = 1e-9;
/// Of the closed forms, ns per scatterer-element and leg visited.
const LEG_NS: f64 = 8.0;
/// Of a Newton solution on the trajectory.
const TRAJECTORY_NS: f64 = 600.0;
/// Of the second-order expansion.
const QUADRATIC_NS: f64 = 60.0;

fn cost_ms(conditions: &Conditions, ns: f64) -> f64 {
    conditions.scatterers as f64 * conditions.elements as f64 * ns * 1e-6
}

/// What the closed forms want of the motion, per leg: as it is heard, or in the worst direction.
struct Moving {
    hop_m: f64,
    closing: f64,
    bend: f64,
    acceleration: f64,
    turning: f64,
    spread: f64,
}

fn moving(conditions: &Conditions) -> Moving {
    let v = conditions.speed_m_per_s;
    let a = conditions.acceleration_m_per_s2;
    match conditions.heard {
        Some(heard) => Moving {
            hop_m: heard.hop_m,
            closing: heard.closing_m_per_s,
            bend: heard.bend_m_per_s2,
            acceleration: heard.acceleration_m_per_s2,
            turning: heard.turning_m_per_s,
            spread: heard.spread,
        },
        None => Moving {
            hop_m: v * 2.0 * conditions.range_m.1 / conditions.sound_speed_m_per_s,
            closing: v,
            bend: v * v / conditions.range_m.0 + a,
            acceleration: a,
            turning: conditions.turning_m_per_s,
            spread: 1.0,
        },
    }
}

/// The phase by which a path model misplaces an echo.
pub fn path_card(path: PathModel, conditions: &Conditions) -> MethodCard {
    let window_s = 2.0 * conditions.range_m.1 / conditions.sound_speed_m_per_s;
    let h = conditions.segment_s.min(window_s);
    let Moving {
        hop_m,
        acceleration: a,
        turning,
        spread,
        ..
    } = moving(conditions);
    // Of a chord, at its middle.
    let sag_m = a * h * h / 8.0;
    let (off_m, ns, why) = match path {
        PathModel::StopAndHop => (
            hop_m,
            LEG_NS,
            format!("the platform moves {hop_m:.1e} m while sound is under way"),
        ),
        PathModel::Polyline => (
            sag_m + turning * h,
            2.0 * LEG_NS,
            format!(
                "{sag_m:.1e} m from chords, {:.1e} m from attitude held on each",
                turning * h
            ),
        ),
        PathModel::KSegment => (
            sag_m,
            2.0 * LEG_NS,
            format!("{sag_m:.1e} m from elements' chords"),
        ),
        PathModel::Continuous => (
            0.0,
            2.0 * LEG_NS + TRAJECTORY_NS,
            "on the trajectory itself".to_owned(),
        ),
    };
    MethodCard {
        name: path.name(),
        error: Conditions::error_of_phase(conditions.wavenumber_per_m() * off_m * spread)
            .max(F64_FLOOR),
        cost_ms: cost_ms(conditions, ns),
        why,
    }
}

/// The phase that a Doppler model leaves within the pulse, on this path model's idea of the velocity.
pub fn doppler_card(doppler: DopplerModel, path: PathModel, conditions: &Conditions) -> MethodCard {
    let Conditions {
        speed_m_per_s: v,
        range_m: (nearest_m, farthest_m),
        segment_s,
        sound_speed_m_per_s: c,
        pulse,
        ..
    } = *conditions;
    let Moving {
        closing,
        bend,
        acceleration: a,
        spread,
        ..
    } = moving(conditions);
    let t = pulse.duration_s;
    let k = conditions.wavenumber_per_m();
    // Phases of both ways: closing speed d s, its change q s^2, and the change of that.
    let first = k * 2.0 * closing * t / 3f64.sqrt();
    let second = k * bend * t * t / 5f64.sqrt();
    // About mid-pulse; half a pulse cubed. The acceleration may change within it, by a hundredth at a time as tracks go.
    let third = k * 3.0 * v * (v * closing / nearest_m + a) / nearest_m * (t / 2.0).powi(3)
        + 1e-2 * k * a * t * t / 5f64.sqrt();
    // The cubic that a bent chirp has and the synthesis' parabolas have not: over the whole pulse, or as much of it as they bear.
    let bend_per_s = bend / c;
    let cubic_turns = pulse.sweep_hz_per_s().abs() * bend_per_s * t.powi(3) / 32.0;
    let cubic = TAU * cubic_turns.min(1e-7) / 2f64.sqrt();
    // A segment's velocity in place of the moment's.
    let stale = match path {
        PathModel::StopAndHop => first_of(k, a * 2.0 * farthest_m / c, t),
        PathModel::Polyline => first_of(k, a * segment_s, t),
        PathModel::KSegment => first_of(k, 0.05 * a * segment_s, t),
        PathModel::Continuous => 0.0,
    };
    let (phase_rad, ns, why) = match doppler {
        DopplerModel::None => (
            first,
            0.0,
            format!(
                "a pulse at {closing:.2e} m/s along the ray turns by {:.1e} rad",
                first * 3f64.sqrt()
            ),
        ),
        DopplerModel::Stretch => (
            second + stale,
            0.0,
            format!("{second:.1e} rad of the second derivative, {stale:.1e} of held velocities"),
        ),
        DopplerModel::StretchQuadratic => (
            third + cubic + stale,
            QUADRATIC_NS,
            format!("{third:.1e} rad of the third derivative, {stale:.1e} of held velocities"),
        ),
        DopplerModel::PaperEq21 => (
            k * 2.0 * closing / c * 2.0 * farthest_m + first,
            0.0,
            format!(
                "moves echoes by up to {:.1e} m and stretches none",
                2.0 * closing / c * farthest_m
            ),
        ),
    };
    MethodCard {
        name: doppler.name(),
        error: Conditions::error_of_phase(phase_rad * spread).max(F64_FLOOR),
        cost_ms: cost_ms(conditions, ns),
        why,
    }
}

/// The cheapest Doppler model that reaches `tolerance` on this path model, or why the best does not. Eq. 21 is never it.
pub fn doppler_within(
    tolerance: f64,
    path: PathModel,
    conditions: &Conditions,
) -> Result<(DopplerModel, MethodCard), MethodRefused> {
    let card = |doppler| doppler_card(doppler, path, conditions).within(tolerance);
    for doppler in [DopplerModel::None, DopplerModel::Stretch] {
        if let Ok(card) = card(doppler) {
            return Ok((doppler, card));
        }
    }
    let doppler = DopplerModel::StretchQuadratic;
    card(doppler).map(|card| (doppler, card))
}

/// Phase of a closing speed off by `speed_m_per_s` at either end, rms over the pulse.
fn first_of(k: f64, speed_m_per_s: f64, duration_s: f64) -> f64 {
    k * 2.0 * speed_m_per_s * duration_s / 3f64.sqrt()
}
