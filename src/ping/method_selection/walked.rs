//! How much of the walk over the scatterers a ping asks for: what the closed forms of its costs want to know of scene and sonar.

use echotank_config::spec::SonarSpec;
use echotank_core::arrays::Pattern;
use echotank_core::model::DopplerModel;
use echotank_core::ping::PingPlan;
use echotank_core::pulse::Pulse;
use echotank_core::scene::Scatterers;
use echotank_synthesis::echo::paths::PART;
use echotank_synthesis::error_model::Conditions;

/// Points of an echo that `direct` makes from one start, at most, and at a time.
const LONGEST_RUN: f64 = 512.0;
const LANES: f64 = 8.0;
/// What a run may leave out of a bent chirp's phase, turns over 32.
const CUBIC_TURNS: f64 = 32.0 * 1e-7;

pub(crate) struct WalkLengths {
    /// Two-way time from the nearest to the farthest of the scatterers that look for their legs together, mean, and by how much bounds on where an element is stretch it.
    spread_s: f64,
    window_s: f64,
    /// Share of the elements that have a pattern.
    pub patterned: f64,
}

impl WalkLengths {
    /// `scatterers`: all `count` of them, or a sample in their order.
    pub(super) fn of(
        spec: &SonarSpec,
        plan: &PingPlan,
        scatterers: &Scatterers,
        count: usize,
    ) -> Self {
        let stride = count.div_ceil(scatterers.len().max(1)).max(1);
        let batch = (PART / stride).max(2);
        let here = plan.trajectory.pose_at(0.0);
        let from_m = here.point_m(spec.transmit[0].mounting.position_m);
        let (mut sum_m, mut batches) = (0.0, 0.0f64);
        let mut first = 0;
        while first < scatterers.len() {
            let end = (first + batch).min(scatterers.len());
            let (mut min_m, mut max_m) = (f64::INFINITY, 0.0f64);
            for i in first..end {
                let range_m = from_m.distance(scatterers.position_m(i));
                min_m = min_m.min(range_m);
                max_m = max_m.max(range_m);
            }
            sum_m += max_m - min_m;
            batches += 1.0;
            first = end;
        }
        let arms = spec.receive.iter().map(|array| {
            let transmit = &spec.transmit[array.transmit].mounting;
            array.mounting.position_m.distance(transmit.position_m)
        });
        let reach_m = arms.fold(0.0, f64::max);
        let elements = |with: &dyn Fn(&Pattern) -> bool| {
            let arrays = spec.receive.iter().filter(|a| with(&a.element_pattern));
            arrays.map(|array| array.elements).sum::<usize>() as f64
        };
        let round = elements(&|pattern| *pattern == Pattern::Omnidirectional);
        let c = plan.sound_speed_m_per_s;
        Self {
            spread_s: (2.0 * sum_m / batches.max(1.0) + 2.0 * reach_m) / c,
            window_s: plan.window_s(spec.receiver.sample_rate_hz),
            patterned: 1.0 - round / elements(&|_| true).max(1.0),
        }
    }

    /// Chords of this length that are looked at for one pair, mean.
    pub(super) fn chords(&self, segment_s: f64) -> f64 {
        let all = (self.window_s / segment_s).ceil().max(1.0);
        (1.0 + self.spread_s / segment_s).min(all)
    }
}

/// Runs of an echo in `direct`, each with sines and cosines of its own: the more bent, the shorter.
pub(crate) fn direct_runs(
    conditions: &Conditions,
    doppler: DopplerModel,
    dense_rate_hz: f64,
) -> f64 {
    let points = conditions.pulse.duration_s * dense_rate_hz;
    let range_acceleration = conditions
        .echo_statistics
        .map_or(0.0, |echoes| echoes.range_acceleration_m_per_s2);
    let longest = match doppler {
        DopplerModel::StretchQuadratic => {
            let curvature_per_s = range_acceleration / conditions.sound_speed_m_per_s;
            let step_s = 1.0 / dense_rate_hz;
            let cubic = conditions.pulse.sweep_hz_per_s().abs() * curvature_per_s * step_s.powi(3);
            let count = (CUBIC_TURNS / cubic.max(f64::MIN_POSITIVE)).cbrt();
            ((count / LANES).floor() * LANES).clamp(LANES, LONGEST_RUN)
        }
        _ => LONGEST_RUN,
    };
    (points / longest).ceil().max(1.0)
}

/// Of an echo's points those that are weighted one by one: on its flanks, in whole blocks, and what is left over at its end.
pub(super) fn flank_points(pulse: &Pulse, points: f64) -> f64 {
    let ends = match pulse.taper > 0.0 {
        true => 1.5 * LANES,
        false => 0.5 * LANES,
    };
    pulse.taper * points + ends
}
