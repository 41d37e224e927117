//! Error model of moving scatterers, whose echoes are solved at three instants of the pulse and summed by `direct`, whatever the methods of the ping.
//!
//! In: a ping's plan and its moving scatterers. Out: the largest error of a window of one pulse length, relative to the window or to the noise floor, and the
//! work of these echoes.
//!
//! Sound between the three instants is solved on the whole trajectory at both ends of every array ([`MovingEchoes::checked`]). The phase of the largest
//! deviation is the error of one echo in its worst window. Where echoes overlap, errors have random phases and the window fades
//! (`method_selection::fades`). Levels are those of the moving scatterers alone: other echoes only lower the relative error of their sum, except where both
//! cancel, which is fading too.

use crate::conditions::sound_speed_of_design;
use crate::element_synthesis::receiver_filter_design;
use crate::method_selection::fades;
use crate::method_selection::walked::{direct_runs, flank_points};
use crate::work::{Figure, Work};
use echotank_config::spec::SonarSpec;
use echotank_core::model::{DopplerModel, Synthesis};
use echotank_core::ping::PingPlan;
use echotank_core::pulse::{MIN_WINDOW, noise_share};
use echotank_core::scene::Scatterers;
use echotank_synthesis::array::error_models::synthesis_error_model;
use echotank_synthesis::echo::error_models::edge_error;
use echotank_synthesis::echo::moving::MovingEchoes;
use echotank_synthesis::error_model::Conditions;
use echotank_synthesis::error_model::OVERLAPPING;

/// Moving scatterers that a selection looks at, and a ping.
pub(crate) const IN_SELECTION: usize = 1000;
pub(crate) const IN_PING: usize = 64;
/// Windows that are told apart, at most.
const BINS: usize = 256;
/// A window may begin anywhere.
const OFFSETS: f64 = 4.0;
/// Share of the energy of a window from which its strongest echo counts as alone.
const ALONE: f64 = 0.999;
/// Cost of the three instants at an element, and of the transmit leg with the poses around the echo, in solutions on the exact trajectory: measured.
const SOLUTIONS_OF_PAIR: f64 = 2.5;
const SOLUTIONS_OF_HIT: f64 = 6.0;

/// A window of one pulse length.
#[derive(Clone, Copy, Default)]
struct Window {
    energy: f64,
    loudest: f64,
    /// Energy times the square of the phase error.
    error: f64,
    worst_rad: f64,
}

/// Largest error of a window by the three instants; 0 where nothing moves. `among`: scatterers that are looked at.
pub(crate) fn moving_error(
    spec: &SonarSpec,
    plan: &PingPlan,
    scatterers: &Scatterers,
    among: usize,
) -> f64 {
    if scatterers.moving.is_empty() {
        return 0.0;
    }
    let rate_hz = spec.receiver.sample_rate_hz;
    let window_s = plan.pulse.duration_s.max(MIN_WINDOW / rate_hz);
    let record_s = plan.window_s(rate_hz);
    let count = (record_s / window_s).ceil().max(1.0) as usize;
    // Longer ones in long records.
    let window_s = window_s.max(record_s / BINS as f64);
    let elements: usize = spec.receive.iter().map(|array| array.elements).sum();
    let looks = (count as f64 * OFFSETS * elements.max(1) as f64)
        .max(2.0)
        .ln();
    let independent = fades::independent_of_pulse(&plan.pulse, window_s);
    let highest_hz = plan.pulse.center_frequency_hz + 0.5 * plan.pulse.bandwidth_hz;
    let stride = scatterers.moving.len().div_ceil(among.max(1));
    let is_alone = scatterers.north_m.is_empty() && stride == 1;
    let mut windows = [Window::default(); BINS];
    let (mut worst, mut latest_s) = (0.0f64, 0.0f64);
    for array in &spec.receive {
        let transmit = &spec.transmit[array.transmit];
        for element in array.outermost().take(array.elements) {
            windows.fill(Window::default());
            let at = (array, element);
            let echoes = MovingEchoes::checked(plan, transmit, at, &scatterers.moving, stride, 0.0);
            for echo in echoes {
                let since_s = echo.delay_s - plan.first_sample_s;
                if !(0.0..record_s).contains(&since_s) {
                    continue;
                }
                latest_s = latest_s.max(echo.off_s);
                let phase_rad = std::f64::consts::TAU * highest_hz * echo.off_s;
                let first = (since_s / window_s) as usize;
                // It sounds in the window in which it begins and in the next.
                for window in windows.iter_mut().skip(first).take(2) {
                    window.energy += echo.energy;
                    window.loudest = window.loudest.max(echo.energy);
                    window.error += echo.energy * phase_rad * phase_rad;
                    window.worst_rad = window.worst_rad.max(phase_rad);
                }
            }
            let strongest = windows.iter().map(|w| w.energy).fold(0.0, f64::max);
            let floor = strongest * noise_share();
            for w in windows.iter().filter(|w| w.energy > 0.0) {
                worst = worst.max(match is_alone && w.loudest >= ALONE * w.energy {
                    true => w.worst_rad,
                    false => {
                        let single = (w.loudest / w.energy).min(0.9);
                        let n = independent / (1.0 - single * single);
                        let n = if stride > 1 { independent } else { n };
                        let ratio = fades::worst_ratio_of_pulses(looks, n);
                        let peak = fades::worst_peak(looks, n) * w.energy / floor;
                        OVERLAPPING * (w.error / w.energy * ratio.min(peak)).sqrt()
                    }
                });
            }
        }
    }
    let sharp = Conditions {
        pulse: plan.pulse,
        sound_speed_m_per_s: plan.sound_speed_m_per_s,
        sample_rate_hz: rate_hz,
        filter: spec.receiver.filter,
        speed_m_per_s: 0.0,
        acceleration_m_per_s2: 0.0,
        turning_m_per_s: 0.0,
        range_m: (1.0, 1.0),
        segment_s: 1.0,
        scatterers: scatterers.moving.len(),
        elements,
        tolerance: spec.synthesis.tolerance,
        echo_statistics: None,
    };
    Conditions::error_of_phase(worst + edge_error(&sharp, latest_s))
}

/// Error of their sum by `direct`, behind the receiver filter of `synthesis`.
pub(crate) fn sum_error(
    synthesis: Synthesis,
    spec: &SonarSpec,
    plan: &PingPlan,
    conditions: &Conditions,
) -> f64 {
    let c = sound_speed_of_design(conditions);
    let filter = receiver_filter_design(spec, synthesis, c);
    synthesis_error_model(Synthesis::Direct, conditions, plan, filter).error
}

/// Work of the echoes of `count` moving scatterers. `part_elements`: elements that are made as one.
pub(crate) fn moving_work(
    synthesis: Synthesis,
    spec: &SonarSpec,
    plan: &PingPlan,
    conditions: &Conditions,
    (count, part_elements): (usize, usize),
) -> Work {
    if count == 0 {
        return Work::NONE;
    }
    let rate_hz = spec.receiver.sample_rate_hz;
    let filter = receiver_filter_design(spec, synthesis, sound_speed_of_design(conditions));
    let dense = filter.map_or(1.0, |filter| filter.oversample as f64);
    let taps = filter.map_or(0.0, |filter| filter.taps() as f64);
    let pairs = (count * conditions.elements) as f64;
    let points = plan.pulse.duration_s * rate_hz * dense;
    let ends = match (filter, plan.pulse.taper > 0.0) {
        (None, _) => 0.0,
        (Some(_), false) => 2.0,
        (Some(_), true) => 4.0,
    };
    let of_part = match part_elements {
        1 => 0.0,
        of => of as f64,
    };
    let runs = direct_runs(conditions, DopplerModel::StretchQuadratic, rate_hz * dense);
    let solutions = pairs * (SOLUTIONS_OF_PAIR + of_part / 3.0 * SOLUTIONS_OF_PAIR)
        + (count * spec.receive.len()) as f64 * SOLUTIONS_OF_HIT;
    let samples = (conditions.elements * plan.sample_count) as f64;
    Work::of(Figure::Newton, solutions)
        .and(Figure::DirectRun, pairs * runs)
        .and(Figure::DirectPoint, pairs * points)
        .and(
            Figure::DirectFlank,
            pairs * flank_points(&plan.pulse, points),
        )
        .and(Figure::DirectEdge, ends * pairs)
        .and(Figure::FilterTap, samples * taps)
}
