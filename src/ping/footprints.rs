//! Region of the scene from which a ping receives echoes: one footprint for every receive array with its transmitter. It always includes
//! the scatterers that `ModelChoice::cull_db` keeps.

use std::f64::consts::PI;

use glam::{DQuat, DVec3};

use echotank_config::spec::SonarSpec;
use echotank_core::arrays::{ArrayGeometry, Mounting, Pattern, TransmitArray};
use echotank_core::frames::Pose;
use echotank_core::ping::PingPlan;
use echotank_core::scene::{BaffledFace, Footprint, PatternSide, ResolutionCell};

use crate::element_synthesis::response_half_s;
use crate::range_floors::GATHERED_BELOW_DB;

/// Number of times in the reception window at which the platform's motion is sampled.
const MOTION_SAMPLES: usize = 16;
/// Margin for motion between the samples, as a fraction of the largest rotation and displacement found.
const MARGIN: f64 = 0.25;

/// Writes the footprints of a ping to `out`: those of the receive arrays in their order, then those of further pulses from other transmitters.
pub fn footprints(spec: &SonarSpec, plan: &PingPlan, out: &mut Vec<Footprint>) {
    let window_s = plan.window_s(spec.receiver.sample_rate_hz);
    let heard_s = window_s + response_half_s(spec, plan.sound_speed_m_per_s);
    let wavelength_m = plan.sound_speed_m_per_s / plan.pulse.center_frequency_hz;
    let start = plan.trajectory.pose_at(0.0);
    let (turn, moved_m) = motion(plan, &start, heard_s);
    let durations =
        std::iter::once(plan.pulse).chain(spec.more_pulses.iter().map(|more| more.pulse));
    let bend = Bend::of(plan);
    let resolution_m = durations.map(|mut pulse| {
        pulse.duration_s = plan.pulse.duration_s;
        pulse.range_resolution_m(plan.sound_speed_m_per_s)
    });
    let resolution_m = resolution_m.fold(f64::INFINITY, f64::min);
    let footprint = |array: &ArrayGeometry, transmit: &TransmitArray| {
        let apex_m = start.point_m(transmit.mounting.position_m);
        let receiver_m = start.point_m(array.mounting.position_m);
        let at_reception = MotionMargin::at_reception(array, transmit, (turn, moved_m));
        let at_start = Radiator {
            pattern: &transmit.pattern,
            mounting: &transmit.mounting,
            margin: MotionMargin::default(),
            bend,
        };
        let element_pattern = array.envelope_pattern();
        let of_element = Radiator {
            pattern: &element_pattern,
            mounting: &array.mounting,
            margin: at_reception,
            bend,
        };
        let [beam_rad, across_rad] = array.beam_widths_rad(transmit, wavelength_m);
        let [a, b] = at_start.sides(start.world_from_body, wavelength_m);
        let [c, d] = of_element.sides(start.world_from_body, wavelength_m);
        Footprint {
            apex_m,
            receiver_m,
            // The way back is shorter by as much.
            max_range_m: 0.5 * (heard_s * bend.fastest_m_per_s + at_reception.shift_m),
            sides: [a, b, c, d],
            depth: plan.model.cull_db.map_or(f64::INFINITY, |db| {
                let below_db = match spec.synthesis.culls_by_window {
                    true => GATHERED_BELOW_DB,
                    false => 0.0,
                };
                10f64.powf((below_db - db) / 20.0)
            }),
            faces: [at_start, of_element].map(|r| r.face(start.world_from_body)),
            cell: ResolutionCell {
                range_m: resolution_m,
                beam_rad,
                across_rad,
            },
        }
    };
    out.clear();
    let own = |array: &ArrayGeometry| footprint(array, &spec.transmit[array.transmit]);
    out.extend(spec.receive.iter().map(own));
    for transmit in spec.more_pulses.iter().filter_map(|more| more.transmit) {
        let others = spec
            .receive
            .iter()
            .filter(|array| array.transmit != transmit);
        out.extend(others.map(|array| footprint(array, &spec.transmit[transmit])));
    }
}

/// Largest range from a transmitter's position at the start of the pulse whose echo any element receives within `after_s` seconds. Elements
/// may have moved by at_reception.
pub(crate) fn max_echo_range_m(spec: &SonarSpec, plan: &PingPlan, after_s: f64) -> f64 {
    let window_s = plan.window_s(spec.receiver.sample_rate_hz);
    let start = plan.trajectory.pose_at(0.0);
    let (turn, moved_m) = motion(plan, &start, window_s);
    let apart = spec.receive.iter().map(|array| {
        let transmit = &spec.transmit[array.transmit];
        MotionMargin::at_reception(array, transmit, (turn, moved_m)).shift_m
    });
    // Two-way path; the return leg is shorter by the distance of the element from the transmitter.
    0.5 * (plan.sound_speed_m_per_s * after_s + apart.fold(0.0, f64::max))
}

/// Largest rotation (radians) and displacement (metres) of the platform from its pose at the start of the pulse.
fn motion(plan: &PingPlan, start: &Pose, window_s: f64) -> (f64, f64) {
    let (mut turn, mut moved_m) = (0.0_f64, 0.0_f64);
    for k in 1..=MOTION_SAMPLES {
        let pose = plan
            .trajectory
            .pose_at(window_s * k as f64 / MOTION_SAMPLES as f64);
        turn = turn.max(start.world_from_body.angle_between(pose.world_from_body));
        moved_m = moved_m.max(start.position_m.distance(pose.position_m));
    }
    (turn * (1.0 + MARGIN), moved_m * (1.0 + MARGIN))
}

#[derive(Clone, Copy, Default)]
struct MotionMargin {
    turn: f64,
    shift_m: f64,
}

impl MotionMargin {
    /// Of the elements, which receive at their later position and attitude, from the transmitter. `turn`, radians, and `moved_m` as of [`motion`].
    fn at_reception(
        array: &ArrayGeometry,
        transmit: &TransmitArray,
        (turn, moved_m): (f64, f64),
    ) -> Self {
        let [sent_m, received_m] = [&transmit.mounting, &array.mounting].map(|m| m.position_m);
        let half_length_m = 0.5 * array.elements as f64 * array.spacing_m;
        let arm_m = received_m.length() + half_length_m;
        Self {
            turn,
            shift_m: sent_m.distance(received_m) + half_length_m + moved_m + turn * arm_m,
        }
    }
}

/// Bounds of refraction. Along a ray, the cosine of its elevation is proportional to the sound speed (Snell), and the straight line to a scatterer lies
/// between the directions of its ray.
#[derive(Clone, Copy)]
struct Bend {
    fastest_m_per_s: f64,
    /// Of the elevation, radians.
    elevation_rad: f64,
    /// Of the cosine of the elevation.
    level: f64,
}

impl Bend {
    fn of(plan: &PingPlan) -> Self {
        match &plan.refraction {
            None => Self {
                fastest_m_per_s: plan.sound_speed_m_per_s,
                elevation_rad: 0.0,
                level: 0.0,
            },
            Some(water) => {
                let (slowest, fastest_m_per_s) = water.profile.range_m_per_s();
                Self {
                    fastest_m_per_s,
                    elevation_rad: libm::acos(slowest / fastest_m_per_s),
                    level: fastest_m_per_s / slowest - 1.0,
                }
            }
        }
    }

    /// Error of the sine from a plane, by its unit normal.
    fn sine(&self, normal: DVec3) -> f64 {
        self.level + normal.z.abs() * self.elevation_rad
    }
}

#[derive(Clone, Copy)]
struct Radiator<'a> {
    pattern: &'a Pattern,
    mounting: &'a Mounting,
    margin: MotionMargin,
    bend: Bend,
}

impl Radiator<'_> {
    /// |sinc x| is below 1/(pi x), x = L u / lambda.
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
        [(DVec3::X, length_m), (DVec3::Y, width_m)].map(|(axis, side_m)| {
            let axis = world_from_body * (self.mounting.body_from_array * axis);
            PatternSide {
                axis,
                // A side of length 0 divides to infinity.
                knee: wavelength_m / (PI * side_m),
                reach: 1.0,
                turn: self.margin.turn + self.bend.sine(axis),
                shift_m: self.margin.shift_m,
            }
        })
    }

    fn face(&self, world_from_body: DQuat) -> BaffledFace {
        match *self.pattern {
            Pattern::Rectangle { baffled: true, .. } | Pattern::Part { baffled: true, .. } => {
                let normal = world_from_body * (self.mounting.body_from_array * DVec3::Z);
                BaffledFace {
                    normal,
                    turn: self.margin.turn + self.bend.sine(normal),
                    shift_m: self.margin.shift_m,
                }
            }
            _ => BaffledFace::OPEN,
        }
    }
}
