//! What path and Doppler models promise: errors of element samples against the reference, worst direction, as closed forms.
//!
//! Phases are rms over the pulse. Costs are of the model alone, per scatterer and element, on one 3.7 GHz core.

use std::f64::consts::TAU;

use echotank_core::flow::{
    Conditions, DopplerModel, ErrorModel, MethodRefused, PathModel, ReceiverFilter,
};

/// f64 delays of 0.3 s at 400 kHz and what follows from them, under way.
const F64_FLOOR: f64 = 1e-9;
/// Of the closed forms, ns per scatterer-element and leg visited.
const LEG_NS: f64 = 8.0;
/// Of a Newton solution on the trajectory.
const TRAJECTORY_NS: f64 = 600.0;
/// Of the second-order expansion.
const QUADRATIC_NS: f64 = 60.0;

/// Crossings expected in a whole ping below which none is: one ping in so many has one.
const RARE: f64 = 0.02;

/// Where the sum is sampled at its points a sharp pulse begins and ends between two samples: an echo that is late by `shift_s` has an edge cross
/// a sample now and then, and that sample has the whole echo or nothing of it. The loudest echo of a window, once, and on the mean the energy
/// of all that cross.
fn edge_error(conditions: &Conditions, shift_s: f64) -> f64 {
    let pulse = &conditions.pulse;
    if conditions.filter == ReceiverFilter::Fir || pulse.taper > 0.0 {
        return 0.0;
    }
    let echo_samples = (pulse.duration_s * conditions.sample_rate_hz).max(1.0);
    let (loudest, echoes, spread) = match conditions.heard {
        Some(heard) => (heard.loudest, heard.echoes, heard.spread),
        None => (
            1.0,
            (conditions.scatterers * conditions.elements) as f64,
            1.0,
        ),
    };
    let crossed = (2.0 * shift_s * conditions.sample_rate_hz).min(echo_samples);
    if crossed * echoes < RARE {
        return 0.0;
    }
    (loudest / echo_samples).sqrt() + (crossed / echo_samples).sqrt() * spread
}

/// What no model is better than. At rest all models are the same sum of two lengths, and a delay is rounded twice: measured 0.2 to 1 of one.
fn floor(conditions: &Conditions) -> f64 {
    if conditions.speed_m_per_s > 0.0 || conditions.acceleration_m_per_s2 > 0.0 {
        return F64_FLOOR;
    }
    2.0 * 0.5 * f64::EPSILON * conditions.wavenumber_per_m() * 2.0 * conditions.range_m.1
}

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
pub fn path_error_model(path: PathModel, conditions: &Conditions) -> ErrorModel {
    let window_s = 2.0 * conditions.range_m.1 / conditions.sound_speed_m_per_s;
    let h = conditions.segment_s;
    let Moving {
        hop_m,
        acceleration: a,
        turning,
        spread,
        ..
    } = moving(conditions);
    // Of a chord at its middle, or as far as anything is heard on it.
    let until_s = window_s.min(0.5 * h);
    let sag_m = 0.5 * a * until_s * (h - until_s);
    let turned_m = turning * h.min(window_s);
    let (off_m, ns, why) = match path {
        PathModel::StopAndHop => (
            hop_m,
            LEG_NS,
            format!("the platform moves {hop_m:.1e} m while sound is under way"),
        ),
        PathModel::Polyline => (
            sag_m + turned_m,
            2.0 * LEG_NS,
            format!("{sag_m:.1e} m from chords, {turned_m:.1e} m from attitude held on each"),
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
    let phase_rad = conditions.wavenumber_per_m() * off_m * spread;
    let edges = edge_error(conditions, off_m / conditions.sound_speed_m_per_s);
    ErrorModel {
        name: path.name(),
        error: Conditions::error_of_phase(phase_rad + edges).max(floor(conditions)),
        cost_ms: cost_ms(conditions, ns),
        why,
    }
}

/// The phase that a Doppler model leaves within the pulse, on this path model's idea of the velocity.
pub fn doppler_error_model(
    doppler: DopplerModel,
    path: PathModel,
    conditions: &Conditions,
) -> ErrorModel {
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
    // At the end of the pulse phases are at their greatest, and the edge is off by as much of a carrier's period.
    let edges = edge_error(conditions, 5f64.sqrt() * phase_rad / (k * c));
    ErrorModel {
        name: doppler.name(),
        error: Conditions::error_of_phase(phase_rad * spread + edges).max(floor(conditions)),
        cost_ms: cost_ms(conditions, ns),
        why,
    }
}

/// The two error models as of the worst window of a pulse's length and not of whole echoes: one that holds no more than the ends of pulses, where phases are at
/// their greatest, or echoes that weaken one another.
pub fn window_error_models(
    path: PathModel,
    doppler: DopplerModel,
    conditions: &Conditions,
) -> [ErrorModel; 2] {
    let weakening = 1.0 / conditions.pulse.weakest_window(conditions.sample_rate_hz);
    // Of what grows with time, its square, its cube: at the end over the root mean square.
    let end = match doppler {
        DopplerModel::None | DopplerModel::PaperEq21 => 3f64.sqrt(),
        DopplerModel::Stretch => 5f64.sqrt(),
        DopplerModel::StretchQuadratic => 7f64.sqrt(),
    };
    let mut error_models = [
        path_error_model(path, conditions),
        doppler_error_model(doppler, path, conditions),
    ];
    for (error_model, more) in error_models.iter_mut().zip([weakening, weakening.max(end)]) {
        error_model.error = Conditions::error_of_phase(error_model.error * more);
    }
    error_models
}

/// The cheapest Doppler model that reaches `tolerance` on this path model, or why the best does not. Eq. 21 is never it.
pub fn doppler_within(
    tolerance: f64,
    path: PathModel,
    conditions: &Conditions,
) -> Result<(DopplerModel, ErrorModel), MethodRefused> {
    let error_model = |doppler| doppler_error_model(doppler, path, conditions).within(tolerance);
    for doppler in [DopplerModel::None, DopplerModel::Stretch] {
        if let Ok(error_model) = error_model(doppler) {
            return Ok((doppler, error_model));
        }
    }
    let doppler = DopplerModel::StretchQuadratic;
    error_model(doppler).map(|error_model| (doppler, error_model))
}

/// Phase of a closing speed off by `speed_m_per_s` at either end, rms over the pulse.
fn first_of(k: f64, speed_m_per_s: f64, duration_s: f64) -> f64 {
    k * 2.0 * speed_m_per_s * duration_s / 3f64.sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;
    use echotank_core::flow::{Pulse, PulseKind};

    /// 500 samples of a sharp pulse.
    fn sharp() -> Conditions {
        Conditions {
            pulse: Pulse {
                kind: PulseKind::Cw,
                center_frequency_hz: 100e3,
                bandwidth_hz: 0.0,
                duration_s: 5e-3,
                taper: 0.0,
            },
            sound_speed_m_per_s: 1500.0,
            sample_rate_hz: 100e3,
            filter: ReceiverFilter::None,
            speed_m_per_s: 1.0,
            acceleration_m_per_s2: 0.0,
            turning_m_per_s: 0.0,
            range_m: (10.0, 50.0),
            segment_s: 0.01,
            scatterers: 1000,
            elements: 10,
            tolerance: 1e-3,
            heard: None,
        }
    }

    /// Echoes of unit amplitude at even places between two samples, each late by so many samples: what the samples gain and lose.
    #[test]
    fn sharp_edges_that_cross_samples_cost_what_counting_them_says() {
        let conditions = sharp();
        let (n, echoes) = (500.0f64, 100_000);
        for late in [0.003, 0.1, 0.4] {
            let (mut differ, mut all) = (0.0, 0.0);
            for k in 0..echoes {
                let at = (f64::from(k) * 0.618_033_988_75).fract();
                let heard = |from: f64, i: f64| (from..=from + n).contains(&i);
                for i in (0..3).chain(498..504).map(f64::from) {
                    differ += f64::from(u8::from(heard(at, i) != heard(at + late, i)));
                }
                all += n;
            }
            let counted = (differ / all).sqrt();
            let alone = (1.0 / n).sqrt();
            let got = edge_error(&conditions, late / conditions.sample_rate_hz) - alone;
            println!("late by {late}: {got:.3e}, counted {counted:.3e}");
            assert!((got / counted - 1.0).abs() < 0.02, "{got} {counted}");
        }
    }

    /// A thousand echoes at ten elements, of which hardly one in a million crosses; a taper; a filter.
    #[test]
    fn edges_count_only_where_there_are_edges_and_they_cross_samples() {
        let at = |conditions: &Conditions, late: f64| {
            edge_error(conditions, late / conditions.sample_rate_hz)
        };
        assert_eq!(at(&sharp(), 0.9 * RARE / 2e4), 0.0);
        let one = (1.0f64 / 500.0).sqrt();
        assert!(at(&sharp(), 1.1 * RARE / 2e4) >= one);
        let mut tapered = sharp();
        tapered.pulse.taper = 0.1;
        let filtered = Conditions {
            filter: ReceiverFilter::Fir,
            ..sharp()
        };
        assert_eq!((at(&tapered, 0.3), at(&filtered, 0.3)), (0.0, 0.0));
    }
}
