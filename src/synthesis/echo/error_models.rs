//! Error models of the path and Doppler models: predicted errors of element samples against the
//! reference, in closed form.
//!
//! Each model expands the neglected motion to its leading order and takes the worst direction.
//! Phases are rms over the pulse. Costs cover the model only, per scatterer and element, on one 3.7
//! GHz core.

use std::f64::consts::TAU;

use crate::array::direct::CUBIC_TURNS;
use crate::array::filter::oversample;
use crate::array::phasor::LANES;
use crate::error_model::{Conditions, ErrorModel, MethodRefused, PROMINENCES};
use echotank_core::arrays::ReceiverFilter;
use echotank_core::model::{DopplerModel, PathModel, Synthesis};

/// Error from rounding of f64 delays of 0.3 s at 400 kHz on a moving platform.
const F64_FLOOR: f64 = 1e-9;
/// Cost of the closed forms, ns per scatterer-element pair and per leg of the path.
const LEG_NS: f64 = 8.0;
/// Cost of a Newton solution on the trajectory, ns.
const TRAJECTORY_NS: f64 = 600.0;
/// Cost of the second-order expansion, ns.
const QUADRATIC_NS: f64 = 60.0;

/// Minimum number of expected edge crossings in a ping. A smaller number counts as none.
const RARE: f64 = 0.02;

/// Error from echo edges that cross a sample. A sharp pulse begins and ends between two samples. A
/// delay error of `shift_s` can move an edge across a sample, which then gains or loses the whole
/// echo. The estimate has the most prominent echo of which some are expected to cross once, plus the
/// mean energy of all crossings. Without statistics any echo may have a window with no other sample.
pub fn edge_error(conditions: &Conditions, shift_s: f64) -> f64 {
    let pulse = &conditions.pulse;
    if conditions.filter == ReceiverFilter::Fir || pulse.taper > 0.0 {
        return 0.0;
    }
    let echo_samples = (pulse.duration_s * conditions.sample_rate_hz).max(1.0);
    let all = (conditions.scatterers * conditions.elements) as f64;
    let (prominent, spread) = match &conditions.echo_statistics {
        Some(echoes) => (echoes.prominent, echoes.spread),
        None => ([all; PROMINENCES], 1.0),
    };
    let crossed = (2.0 * shift_s * conditions.sample_rate_hz).min(echo_samples);
    let Some(halvings) = prominent.iter().position(|n| crossed * n >= RARE) else {
        return 0.0;
    };
    let once = libm::exp2(-(halvings as f64));
    once + (crossed / echo_samples).sqrt() * spread
}

fn is_at_rest(conditions: &Conditions) -> bool {
    conditions.speed_m_per_s == 0.0 && conditions.acceleration_m_per_s2 == 0.0
}

/// Minimum error of all path models. On a platform at rest every model is the same sum of two lengths,
/// and a delay is rounded twice. The measured error is 0.2 to 1 of one rounding.
fn floor(conditions: &Conditions) -> f64 {
    if !is_at_rest(conditions) {
        return F64_FLOOR;
    }
    2.0 * 0.5 * f64::EPSILON * conditions.wavenumber_per_m() * 2.0 * conditions.range_m.1
}

fn cost_ms(conditions: &Conditions, ns: f64) -> f64 {
    conditions.scatterers as f64 * conditions.elements as f64 * ns * 1e-6
}

/// Motion terms of the closed forms, per leg, for the actual geometry or for the worst direction.
struct MotionTerms {
    displacement_m: f64,
    closing: f64,
    range_acceleration: f64,
    /// ... with equal weight all through an echo.
    throughout: f64,
    acceleration: f64,
    /// Rest of the range at an end of the pulse beyond the second order about mid-pulse, of both legs together.
    third_m: f64,
    /// Change of the acceleration within a pulse (as a step at mid-pulse), and within a chord and a pulse.
    pulse_change: f64,
    chord_change: f64,
    turning: f64,
    spread: f64,
    /// Of errors of random phase.
    fading: f64,
}

/// Changes of the acceleration where the motion is unknown, over the acceleration.
const UNKNOWN_CHANGES: [f64; 2] = [0.02, 0.25];

fn motion_terms(conditions: &Conditions) -> MotionTerms {
    let v = conditions.speed_m_per_s;
    let a = conditions.acceleration_m_per_s2;
    let t = conditions.pulse.duration_s;
    let cubic_m = |range_jerk: f64| range_jerk / 3.0 * (t / 2.0).powi(3);
    match conditions.echo_statistics {
        Some(echoes) => MotionTerms {
            displacement_m: echoes.displacement_m,
            closing: echoes.closing_m_per_s,
            range_acceleration: echoes.range_acceleration_m_per_s2,
            throughout: echoes.range_acceleration_throughout_m_per_s2,
            third_m: cubic_m(echoes.range_jerk_m_per_s3),
            acceleration: echoes.acceleration_m_per_s2,
            pulse_change: match echoes.off_velocity_m_per_s {
                Some(_) => 0.0,
                None => echoes.unsteady_m_per_s2,
            },
            // Of a chord and a pulse there are so many pulses, each with no more change than that.
            chord_change: (echoes.acceleration_change_m_per_s2 * (1.0 + conditions.segment_s / t))
                .min(UNKNOWN_CHANGES[1] * echoes.acceleration_m_per_s2)
                .max(echoes.acceleration_change_m_per_s2),
            turning: echoes.turning_m_per_s,
            // Of their own interference the statistics know.
            spread: 1.0,
            fading: echoes.fading,
        },
        None => MotionTerms {
            displacement_m: v * 2.0 * conditions.range_m.1 / conditions.sound_speed_m_per_s,
            closing: v,
            range_acceleration: v * v / conditions.range_m.0 + a,
            throughout: v * v / conditions.range_m.0 + a,
            third_m: cubic_m(4.5 * v * (v * v / conditions.range_m.0 + a) / conditions.range_m.0)
                * all_terms(0.5 * v * t / conditions.range_m.0),
            acceleration: a,
            pulse_change: UNKNOWN_CHANGES[0] * a,
            chord_change: UNKNOWN_CHANGES[1] * a,
            turning: conditions.turning_m_per_s,
            spread: 1.0,
            // Of one window in ten thousand.
            fading: 1.0 / conditions.pulse.weakest_window(conditions.sample_rate_hz),
        },
    }
}

/// Points of an echo per second in `direct`.
fn dense_rate_hz(conditions: &Conditions) -> f64 {
    let rate_hz = conditions.sample_rate_hz;
    match conditions.filter {
        ReceiverFilter::None => rate_hz,
        ReceiverFilter::Fir => {
            rate_hz * oversample(&conditions.pulse, rate_hz, Synthesis::Direct) as f64
        }
    }
}

/// Where a path model has the platform, against where it is.
struct PathError {
    off_m: f64,
    sag_m: f64,
    turned_m: f64,
    error: f64,
}

impl PathError {
    fn new(path: PathModel, conditions: &Conditions) -> Self {
        let window_s = 2.0 * conditions.range_m.1 / conditions.sound_speed_m_per_s;
        let h = conditions.segment_s;
        let motion = motion_terms(conditions);
        // Time to the middle of a chord, or to the last reception on it.
        let until_s = window_s.min(0.5 * h);
        let sag_m = 0.5 * motion.acceleration * until_s * (h - until_s);
        let turned_m = motion.turning * h.min(window_s);
        let off_m = match path {
            PathModel::StopAndHop => motion.displacement_m,
            PathModel::Polyline => sag_m + turned_m,
            PathModel::KSegment => sag_m,
            PathModel::Continuous => 0.0,
        };
        let known_m = conditions.echo_statistics.and_then(|e| e.off_path_m);
        let off_m = known_m.unwrap_or(off_m);
        let phase_rad = conditions.wavenumber_per_m() * off_m * motion.spread;
        let edges = edge_error(conditions, off_m / conditions.sound_speed_m_per_s);
        Self {
            off_m,
            sag_m,
            turned_m,
            error: Conditions::error_of_phase(phase_rad + edges).max(floor(conditions)),
        }
    }
}

/// Predicted relative error of a path model, as [`path_error_model`] has it.
pub fn path_error(path: PathModel, conditions: &Conditions) -> f64 {
    PathError::new(path, conditions).error
}

/// Predicted phase error of a path model.
pub fn path_error_model(path: PathModel, conditions: &Conditions) -> ErrorModel {
    let PathError {
        off_m,
        sag_m,
        turned_m,
        error,
    } = PathError::new(path, conditions);
    let (ns, why) = match path {
        PathModel::StopAndHop => (
            LEG_NS,
            format!("the platform moves {off_m:.1e} m during the travel time"),
        ),
        PathModel::Polyline => (
            2.0 * LEG_NS,
            format!("{sag_m:.1e} m from chords, {turned_m:.1e} m from constant attitude on each"),
        ),
        PathModel::KSegment => (2.0 * LEG_NS, format!("{sag_m:.1e} m from elements' chords")),
        PathModel::Continuous => (2.0 * LEG_NS + TRAJECTORY_NS, "exact trajectory".to_owned()),
    };
    ErrorModel {
        name: path.name(),
        error,
        cost_ms: cost_ms(conditions, ns),
        why,
    }
}

/// Ratio of the rest of a Taylor series of a range, from its first neglected term on, to that term. `moved` is the way that the
/// platform makes in the time of the expansion, relative to the range. Terms fall by this factor; from 1 on the series diverges.
fn all_terms(moved: f64) -> f64 {
    match moved < 1.0 {
        true => (1.0 - moved).powi(-2).min(DIVERGED),
        false => DIVERGED,
    }
}

const DIVERGED: f64 = 1e12;

/// Phases that a Doppler model leaves within a pulse.
struct DopplerError {
    closing_m_per_s: f64,
    first: f64,
    second: f64,
    third: f64,
    /// Of the velocity of a segment, against that of the instant.
    stale: f64,
    error: f64,
}

impl DopplerError {
    fn new(doppler: DopplerModel, path: PathModel, conditions: &Conditions) -> Self {
        let Conditions {
            range_m: (_, farthest_m),
            segment_s,
            sound_speed_m_per_s: c,
            pulse,
            ..
        } = *conditions;
        let MotionTerms {
            closing,
            range_acceleration,
            throughout,
            third_m,
            acceleration: a,
            pulse_change,
            chord_change,
            fading,
            spread,
            ..
        } = motion_terms(conditions);
        let t = pulse.duration_s;
        let k = conditions.wavenumber_per_m();
        // Two-way phases of three terms: the closing speed d s, its change q s^2, and the change of q.
        let first = k * 2.0 * closing * t / 3f64.sqrt();
        let second = k * range_acceleration * t * t / 5f64.sqrt();
        // Each leg has the mean acceleration of the pulse. If it changes by A, the end of the pulse is off by A T^2/12 (evenly)
        // or A T^2/8 (in one step at mid-pulse).
        let third = k * (third_m + 2.0 * pulse_change * t * t / 8.0);
        // The parabolas of the synthesis lack the cubic phase of a Doppler-distorted chirp, over the
        // part of the pulse that they cover, at the onset as elsewhere.
        let curvature_per_s = throughout / c;
        let cubic_per_s3 = pulse.sweep_hz_per_s().abs() * curvature_per_s / 32.0;
        let turns = (cubic_per_s3 * t.powi(3)).min(CUBIC_TURNS);
        // A lone echo is off by that much at most. What is left over a run is the Chebyshev polynomial of third order, of
        // mean square 17/35; the errors of many echoes have random phases, whose sum fades otherwise than the echoes'.
        let rms = (17f64 / 35.0).sqrt();
        let of_runs = turns * (fading * rms).max(1.0);
        // Runs are no shorter than a block, whatever that leaves: all of it at the end of a lone echo. The statistics of the curvature know its
        // interference.
        let block_s = t.min(LANES as f64 / dense_rate_hz(conditions));
        let of_block = cubic_per_s3 * block_s.powi(3);
        let cubic = TAU * of_runs.max(of_block);
        let off_velocity = conditions
            .echo_statistics
            .and_then(|echoes| echoes.off_velocity_m_per_s);
        let stale = match (off_velocity, path) {
            // Of both legs together.
            (Some(speed), _) => 0.5 * first_of(k, speed, t),
            (None, PathModel::StopAndHop) => first_of(k, a * 2.0 * farthest_m / c, t),
            (None, PathModel::Polyline) => first_of(k, a * segment_s, t),
            // Of the reception only. The velocity is linear along a chord of duration h, and off by A h/4 at most. The acceleration is the mean of a
            // pulse of T that begins at mid-chord, of which other pulses lack up to h/2: it is off by A h/(2 T) at most, or A. Or an empirical bound,
            // if that is smaller: a twentieth of what the acceleration makes of the velocity on a chord; `tools/points_random.py` checks it.
            (None, PathModel::KSegment) => {
                let of_chord_s = 0.25 * segment_s;
                let of_change = k * chord_change * t * (of_chord_s + of_chord_s.min(0.5 * t));
                of_change.min(first_of(k, 0.05 * a * segment_s, t))
            }
            (None, PathModel::Continuous) => 0.0,
        };
        // The derivatives of the time of emission have factors of (c + v)/(c - v) that those of the ranges lack; see `echo::stretch`.
        let emitted = 1.0 + 3.0 * conditions.speed_m_per_s / c;
        let phase_rad = match doppler {
            DopplerModel::None => first,
            DopplerModel::Stretch => emitted * second + stale,
            DopplerModel::StretchQuadratic => emitted * third + cubic + stale,
            DopplerModel::PaperEq21 => k * 2.0 * closing / c * 2.0 * farthest_m + first,
        };
        // Phase errors are largest at the end of the pulse. The edge moves by the same fraction of a
        // carrier period.
        let edges = edge_error(conditions, 5f64.sqrt() * phase_rad / (k * c));
        Self {
            closing_m_per_s: closing,
            first,
            second,
            third,
            stale,
            error: match is_at_rest(conditions) {
                // No echo is stretched.
                true => 0.0,
                false => Conditions::error_of_phase(phase_rad * spread + edges).max(F64_FLOOR),
            },
        }
    }
}

/// Predicted relative error of a Doppler model, as [`doppler_error_model`] has it.
pub fn doppler_error(doppler: DopplerModel, path: PathModel, conditions: &Conditions) -> f64 {
    DopplerError::new(doppler, path, conditions).error
}

/// Predicted phase error of a Doppler model within the pulse, with the velocity of this path model.
pub fn doppler_error_model(
    doppler: DopplerModel,
    path: PathModel,
    conditions: &Conditions,
) -> ErrorModel {
    let DopplerError {
        closing_m_per_s: closing,
        first,
        second,
        third,
        stale,
        error,
    } = DopplerError::new(doppler, path, conditions);
    let (ns, why) = match doppler {
        DopplerModel::None => (
            0.0,
            format!(
                "phase error of {:.1e} rad in the pulse at a closing speed of {closing:.2e} m/s",
                first * 3f64.sqrt()
            ),
        ),
        DopplerModel::Stretch => (
            0.0,
            format!(
                "{second:.1e} rad from the second derivative, {stale:.1e} from constant velocities"
            ),
        ),
        DopplerModel::StretchQuadratic => (
            QUADRATIC_NS,
            format!(
                "{third:.1e} rad from the third derivative, {stale:.1e} from constant velocities"
            ),
        ),
        DopplerModel::PaperEq21 => (
            0.0,
            format!(
                "displaces echoes by up to {:.1e} m and does not stretch them",
                2.0 * closing / conditions.sound_speed_m_per_s * conditions.range_m.1
            ),
        ),
    };
    ErrorModel {
        name: doppler.name(),
        error,
        cost_ms: cost_ms(conditions, ns),
        why,
    }
}

/// Both error models for the worst window of one pulse length instead of whole echoes. Such a
/// window may hold only the ends of pulses, where phase errors are largest, or echoes that cancel.
pub fn window_error_models(
    path: PathModel,
    doppler: DopplerModel,
    conditions: &Conditions,
) -> [ErrorModel; 2] {
    let weakening = 1.0 / conditions.pulse.weakest_window(conditions.sample_rate_hz);
    // Ratio of the value at the end to the rms value, for terms that grow linearly, quadratically
    // and cubically.
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

/// Selects the cheapest Doppler model that meets `tolerance` with this path model. Returns the
/// reason if the most accurate model does not meet it. Eq. 21 is never selected.
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

/// Rms phase over the pulse of a closing-speed error of `speed_m_per_s`.
fn first_of(k: f64, speed_m_per_s: f64, duration_s: f64) -> f64 {
    k * 2.0 * speed_m_per_s * duration_s / 3f64.sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::error_model::EchoStatistics;
    use echotank_core::pulse::{Pulse, PulseKind};

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
            echo_statistics: None,
        }
    }

    /// Counts the echoes that samples gain and lose. Unit echoes begin at evenly spaced positions
    /// between two samples, each late by the same number of samples.
    #[test]
    fn the_error_of_crossing_edges_matches_a_count() {
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
            let alone = 1.0;
            let got = edge_error(&conditions, late / conditions.sample_rate_hz) - alone;
            println!("late by {late}: {got:.3e}, counted {counted:.3e}");
            assert!((got / counted - 1.0).abs() < 0.02, "{got} {counted}");
        }
    }

    /// A thousand echoes at ten elements, of which about one in a million crosses a sample. The
    /// next cases have a taper and a filter.
    #[test]
    fn edges_count_only_if_they_are_sharp_and_cross_samples() {
        let at = |conditions: &Conditions, late: f64| {
            edge_error(conditions, late / conditions.sample_rate_hz)
        };
        assert_eq!(at(&sharp(), 0.9 * RARE / 2e4), 0.0);
        assert!(at(&sharp(), 1.1 * RARE / 2e4) >= 1.0);
        let mut tapered = sharp();
        tapered.pulse.taper = 0.1;
        let filtered = Conditions {
            filter: ReceiverFilter::Fir,
            ..sharp()
        };
        assert_eq!((at(&tapered, 0.3), at(&filtered, 0.3)), (0.0, 0.0));
    }

    /// Echoes of a chirp whose stretch changes, with curvature at the onset alone: what a block of samples leaves is there too.
    #[test]
    fn the_cubic_phase_of_a_block_counts_at_the_onset() {
        let at = |throughout: f64| {
            let mut conditions = sharp();
            conditions.pulse.kind = PulseKind::LfmUp;
            conditions.pulse.bandwidth_hz = 40e3;
            conditions.pulse.taper = 0.1;
            conditions.echo_statistics = Some(EchoStatistics {
                displacement_m: 0.0,
                closing_m_per_s: 0.0,
                closing_of_echoes_m_per_s: 0.0,
                closing_apart_m_per_s: 0.0,
                range_acceleration_m_per_s2: 0.0,
                range_acceleration_throughout_m_per_s2: throughout,
                range_jerk_m_per_s3: 0.0,
                acceleration_m_per_s2: 0.0,
                turning_m_per_s: 0.0,
                acceleration_change_m_per_s2: 0.0,
                unsteady_m_per_s2: 0.0,
                across_m_per_s: 0.0,
                spread: 1.0,
                fading: 1.0,
                tails: 1.0,
                ends: 1.0,
                off_path_m: Some(0.0),
                off_velocity_m_per_s: Some(0.0),
                echoes: 1.0,
                prominent: [1.0; PROMINENCES],
            });
            doppler_error(
                DopplerModel::StretchQuadratic,
                PathModel::Continuous,
                &conditions,
            )
        };
        // Of a block of eight samples the best parabola leaves 1/32 of the cube.
        let (curvature, block_s) = (3000.0, 8.0f64 / 100e3);
        let cubic: f64 = 40e3 / 5e-3 * curvature / 1500.0 / 32.0;
        let want = TAU * cubic * block_s.powi(3);
        assert!(want > TAU * CUBIC_TURNS);
        assert!(
            (at(curvature) / want - 1.0).abs() < 1e-9,
            "{} {want}",
            at(curvature)
        );
        assert!(at(0.0) <= F64_FLOOR);
    }
}
