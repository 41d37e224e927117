//! What a ping can hear of the scene: one footprint for every receive array with its transmitter, never smaller than what the walk over the
//! scatterers keeps (`ModelChoice::cull_db`).

use std::f64::consts::PI;

use glam::{DQuat, DVec3};

use echotank_config::spec::SonarSpec;
use echotank_core::flow::{BaffledFace, Footprint, Mounting, Pattern, PatternSide, PingPlan};
use echotank_core::frames::Pose;

/// Instants of the listening window at which the platform's motion is looked at.
const INSTANTS: usize = 16;
/// The platform may go beyond what those instants show: added to the greatest turn and shift found, as a share of it.
const SPARE: f64 = 0.25;

/// Footprints of a ping, in the order of the receive arrays, into `out`.
pub fn footprints(spec: &SonarSpec, plan: &PingPlan, out: &mut Vec<Footprint>) {
    let window_s = plan.window_s(spec.receiver.sample_rate_hz);
    let wavelength_m = plan.sound_speed_m_per_s / plan.pulse.center_frequency_hz;
    let start = plan.trajectory.pose_at(0.0);
    let (turn, moved_m) = motion(plan, &start, window_s);
    out.clear();
    out.extend(spec.receive.iter().map(|array| {
        let transmit = &spec.transmit[array.transmit];
        let apex_m = start.point_m(transmit.mounting.position_m);
        let receiver_m = start.point_m(array.mounting.position_m);
        let half_length_m = 0.5 * array.elements as f64 * array.spacing_m;
        let arm_m = array.mounting.position_m.length() + half_length_m;
        // The element is heard through from where it is then, in the attitude it has then.
        let then = Slack {
            turn,
            shift_m: apex_m.distance(receiver_m) + half_length_m + moved_m + turn * arm_m,
        };
        let at_start = Radiator {
            pattern: &transmit.pattern,
            mounting: &transmit.mounting,
            slack: Slack::default(),
        };
        let of_element = Radiator {
            pattern: &array.element_pattern,
            mounting: &array.mounting,
            slack: then,
        };
        let [a, b] = at_start.sides(start.world_from_body, wavelength_m);
        let [c, d] = of_element.sides(start.world_from_body, wavelength_m);
        Footprint {
            apex_m,
            receiver_m,
            max_range_m: 0.5 * window_s * plan.sound_speed_m_per_s,
            sides: [a, b, c, d],
            depth: plan
                .model
                .cull_db
                .map_or(f64::INFINITY, |db| 10f64.powf(-db / 20.0)),
            faces: [at_start, of_element].map(|r| r.face(start.world_from_body)),
        }
    }));
}

/// What lies farther than this from every transmitter, where it is when the pulse begins, is heard by nobody so many seconds after that. The elements
/// may be elsewhere by then.
pub(crate) fn max_audible_range_m(spec: &SonarSpec, plan: &PingPlan, after_s: f64) -> f64 {
    let window_s = plan.window_s(spec.receiver.sample_rate_hz);
    let start = plan.trajectory.pose_at(0.0);
    let (turn, moved_m) = motion(plan, &start, window_s);
    let apart = spec.receive.iter().map(|array| {
        let transmit = &spec.transmit[array.transmit];
        let half_length_m = 0.5 * array.elements as f64 * array.spacing_m;
        let arm_m = array.mounting.position_m.length() + half_length_m;
        let apart_m = transmit
            .mounting
            .position_m
            .distance(array.mounting.position_m);
        apart_m + half_length_m + moved_m + turn * arm_m
    });
    // There and back, the way back shorter by as much as the element is nearer.
    0.5 * (plan.sound_speed_m_per_s * after_s + apart.fold(0.0, f64::max))
}

/// How far the platform turns (radians) and moves (metres) from where it is at the start of the pulse.
fn motion(plan: &PingPlan, start: &Pose, window_s: f64) -> (f64, f64) {
    let (mut turn, mut moved_m) = (0.0_f64, 0.0_f64);
    for k in 1..=INSTANTS {
        let pose = plan
            .trajectory
            .pose_at(window_s * k as f64 / INSTANTS as f64);
        turn = turn.max(start.world_from_body.angle_between(pose.world_from_body));
        moved_m = moved_m.max(start.position_m.distance(pose.position_m));
    }
    (turn * (1.0 + SPARE), moved_m * (1.0 + SPARE))
}

#[derive(Clone, Copy, Default)]
struct Slack {
    turn: f64,
    shift_m: f64,
}

#[derive(Clone, Copy)]
struct Radiator<'a> {
    pattern: &'a Pattern,
    mounting: &'a Mounting,
    slack: Slack,
}

impl Radiator<'_> {
    /// |sinc x| stays below 1/(pi x), x = L u / lambda.
    fn sides(&self, world_from_body: DQuat, wavelength_m: f64) -> [PatternSide; 2] {
        let (Pattern::Rectangle {
            length_m, width_m, ..
        }
        | Pattern::Part {
            length_m, width_m, ..
        }) = *self.pattern
        else {
            return [PatternSide::OPEN; 2];
        };
        [(DVec3::X, length_m), (DVec3::Y, width_m)].map(|(axis, side_m)| PatternSide {
            axis: world_from_body * (self.mounting.body_from_array * axis),
            // A side without length divides to infinity.
            knee: wavelength_m / (PI * side_m),
            turn: self.slack.turn,
            shift_m: self.slack.shift_m,
        })
    }

    fn face(&self, world_from_body: DQuat) -> BaffledFace {
        match *self.pattern {
            Pattern::Rectangle { baffled: true, .. } | Pattern::Part { baffled: true, .. } => {
                BaffledFace {
                    normal: world_from_body * (self.mounting.body_from_array * DVec3::Z),
                    turn: self.slack.turn,
                    shift_m: self.slack.shift_m,
                }
            }
            _ => BaffledFace::OPEN,
        }
    }
}
