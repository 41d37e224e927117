//! Delays of the four path models: the position of the receiver when an echo arrives.
//!
//! `stop-and-hop`, `polyline` and `k-segment` use legs of constant velocity, solved in closed form.
//! `stop-and-hop` has one leg without velocity. `polyline` uses the segments of the plan, and
//! `k-segment` the chords of the element's own track between the same vertices. `continuous` starts
//! from the chords and converges to the trajectory by Newton's iteration.
//!
//! The transmitter, at the origin, transmits at t = 0, and the sound reaches the scatterer S at
//! `t1 = r_T/c`. The receiver is at `R + v (t - t_k)` on segment k. Relative to it, the scatterer is
//! then at `D = S - R - v (t1 - t_k)`. The second leg tau solves `|D - v tau| = c tau`, so
//! `(c^2 - v^2) tau^2 + 2 (D.v) tau - D.D = 0`. The only positive root, written without
//! cancellation, is
//!
//! ```text
//! q   = sqrt((D.v)^2 + (c^2 - v^2) D.D)
//! tau = D.D / (q + D.v)            D.v >= 0
//!     = (q - D.v) / (c^2 - v^2)    D.v <  0
//! ```
//!
//! Where an echo is reflected on one leg, S is the mirror image that the receiver sees, and r_T leads to the one that the
//! transmitter sees.
//!
//! This is the root of Meng et al. 2023, Eqs. 5-7 (there with v in the denominator). It is valid
//! for every |v| < c, including v = 0 and D = 0.

use glam::{DMat3, DQuat, DVec3};

use crate::arrivals::CHUNK;
use echotank_core::arrays::{ArrayGeometry, TransmitArray};
use echotank_core::frames::Pose;
use echotank_core::model::{DopplerModel, PathModel};
use echotank_core::ping::PingPlan;
use echotank_core::simd::widest;

/// Margin of the bounds that skip whole segments, metres. It is far above the rounding of ranges
/// and far below any range.
const BOUND_GUARD_M: f64 = 1e-6;

/// Newton step that ends the iteration, seconds. The next step would be its square times v^2/(r c):
/// below 1e-20 s at a range of 1 mm.
const SETTLED_S: f64 = 1e-11;

/// Position and motion of the transmitter at the start of the pulse. The position is the origin of
/// the coordinates of this module.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Transmit {
    /// Reference point of the platform at the start of the pulse, world, metres, and the lever arm
    /// of the transmitter. They are separate because their sum would round the arm to the precision
    /// of world coordinates.
    reference_m: DVec3,
    arm_m: DVec3,
    pub array_from_world: DMat3,
    /// Motion for the Doppler term.
    pub motion: Motion,
}

/// Motion of a point about one instant; zero under [`DopplerModel::None`].
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Motion {
    /// Velocity in world axes, m/s.
    pub velocity_m_per_s: DVec3,
    /// Acceleration in world axes, m/s^2.
    pub acceleration_m_per_s2: DVec3,
}

impl Transmit {
    /// From the transmitter to a point with this lever arm, both at the start of the pulse.
    pub(crate) fn offset_m(&self, arm_m: DVec3) -> DVec3 {
        arm_m - self.arm_m
    }

    /// Motion from the plan's first segment, or from the trajectory if the path model follows it.
    pub(crate) fn new(plan: &PingPlan, tx: &TransmitArray) -> Self {
        let first = &plan.segments[0];
        let mounting = &tx.mounting;
        let (arm_m, world_from_body, motion) = match plan.model.path {
            PathModel::StopAndHop | PathModel::Polyline => {
                let arm_m = first.world_from_body * mounting.position_m;
                (arm_m, first.world_from_body, segment_motion(plan, 0, arm_m))
            }
            PathModel::KSegment | PathModel::Continuous => {
                let pose = plan.trajectory.pose_from(first.position_m, 0.0);
                let motion = trajectory_motion(plan, mounting.position_m, &pose, 0.0);
                let arm_m = pose.point_m(mounting.position_m);
                (arm_m, pose.world_from_body, motion)
            }
        };
        Self {
            reference_m: first.position_m,
            arm_m,
            array_from_world: array_from_world(world_from_body, mounting.body_from_array),
            motion: doppler_motion(plan, motion),
        }
    }

    /// Converts a world position to metres from the transmit position.
    #[inline(always)]
    pub(crate) fn relative_m(&self, world_m: DVec3) -> DVec3 {
        (world_m - self.reference_m) - self.arm_m
    }
}

/// Poses of the platform on one chord, the same for all elements: at both ends and in the middle, and a pulse after the middle.
#[derive(Clone, Copy, Debug)]
pub struct Chord {
    /// Seconds from the start of the pulse.
    pub start_s: f64,
    /// Infinite for the last chord, which has the length of the one before it.
    end_s: f64,
    /// Length, seconds.
    pub step_s: f64,
    /// Positions are relative to that of the first segment.
    pub begin: Pose,
    /// Half the length later.
    pub middle: Pose,
    /// The whole length later.
    pub end: Pose,
    /// A pulse after the middle with [`DopplerModel::StretchQuadratic`] alone; else that of the middle.
    pub later: Pose,
}

impl Chord {
    /// Replaces `chords` by those of the plan's path model; none if it has no chords.
    pub fn all(plan: &PingPlan, chords: &mut Vec<Self>) {
        chords.clear();
        if matches!(plan.model.path, PathModel::StopAndHop | PathModel::Polyline) {
            return;
        }
        let segments = &plan.segments;
        let origin_m = segments[0].position_m;
        let pose_at = |time_s: f64| plan.trajectory.pose_from(origin_m, time_s);
        let mut begin = pose_at(segments[0].start_s);
        let mut step_s = plan.model.segment_s;
        for (k, segment) in segments.iter().enumerate() {
            let start_s = segment.start_s;
            let end_s = segments.get(k + 1).map_or(f64::INFINITY, |s| s.start_s);
            if end_s.is_finite() {
                step_s = end_s - start_s;
            }
            let middle_s = start_s + 0.5 * step_s;
            let (middle, end) = (pose_at(middle_s), pose_at(start_s + step_s));
            let later = match plan.model.doppler {
                DopplerModel::StretchQuadratic => pose_at(middle_s + plan.pulse.duration_s),
                _ => middle,
            };
            chords.push(Self {
                start_s,
                end_s,
                step_s,
                begin,
                middle,
                end,
                later,
            });
            begin = end;
        }
    }

    /// Motion of a point fixed in the body for the Doppler term, at the start of the chord: its acceleration is the mean over a pulse that begins in
    /// the middle of the chord. And the rate of its velocity along the chord, m/s^2.
    pub fn motion(&self, body_m: DVec3, pulse_s: f64) -> (Motion, DVec3) {
        let velocity = |pose: &Pose| pose.point_velocity_m_per_s(body_m);
        let begins = velocity(&self.begin);
        let motion = Motion {
            velocity_m_per_s: begins,
            acceleration_m_per_s2: (velocity(&self.later) - velocity(&self.middle)) / pulse_s,
        };
        (motion, (velocity(&self.end) - begins) / self.step_s)
    }
}

fn array_from_world(world_from_body: DQuat, body_from_array: DQuat) -> DMat3 {
    DMat3::from_quat((world_from_body * body_from_array).inverse())
}

/// Motion of a point on a lever arm (world axes) during segment `k` of the platform: the segment's
/// velocity plus the effect of rotation. The segment has a constant attitude, so the rate of
/// rotation comes from the trajectory.
pub fn segment_motion(plan: &PingPlan, k: usize, arm_m: DVec3) -> Motion {
    let segment = &plan.segments[k];
    let turning = plan
        .trajectory
        .pose_at(segment.start_s)
        .angular_velocity_rad_per_s;
    Motion {
        velocity_m_per_s: segment.velocity_m_per_s + turning.cross(arm_m),
        acceleration_m_per_s2: DVec3::ZERO,
    }
}

/// Motion of a body-fixed point on the trajectory. `pose` is the pose at `time_s`. The acceleration
/// is the mean over a pulse that begins there; it is computed only if used.
fn trajectory_motion(plan: &PingPlan, body_m: DVec3, pose: &Pose, time_s: f64) -> Motion {
    let velocity_m_per_s = pose.point_velocity_m_per_s(body_m);
    let acceleration_m_per_s2 = match plan.model.doppler {
        DopplerModel::StretchQuadratic => {
            let duration_s = plan.pulse.duration_s;
            let later = plan.trajectory.pose_at(time_s + duration_s);
            (later.point_velocity_m_per_s(body_m) - velocity_m_per_s) / duration_s
        }
        _ => DVec3::ZERO,
    };
    Motion {
        velocity_m_per_s,
        acceleration_m_per_s2,
    }
}

fn doppler_motion(plan: &PingPlan, motion: Motion) -> Motion {
    match plan.model.doppler {
        DopplerModel::None => Motion::default(),
        _ => motion,
    }
}

/// Track of one element over one segment of the polyline.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Leg {
    pub start_s: f64,
    /// End time, seconds; infinite for the last leg.
    pub end_s: f64,
    /// Element at `start_s`, metres from the transmit position.
    pub origin_m: DVec3,
    /// Velocity in the path equation; zero for stop-and-hop.
    pub velocity_m_per_s: DVec3,
    /// Motion in the Doppler term: velocity at `start_s`, and mean acceleration over a pulse.
    pub doppler: Motion,
    /// Rate of the velocity in the Doppler term along the leg, m/s^2.
    doppler_rate: DVec3,
    array_from_world: DMat3,
    /// Rate of turn of the array axes, rad/s in these axes.
    turning_rad_per_s: DVec3,
    /// Time after `start_s` at which the axes have the stated attitude, seconds.
    facing_s: f64,
    /// Two-way path above which scatterers arrive on a later leg, metres.
    passed_m: f64,
    /// Two-way path below which scatterers arrive on an earlier leg, metres.
    begun_m: f64,
}

impl Leg {
    fn at_m(&self, time_s: f64) -> DVec3 {
        self.origin_m + self.velocity_m_per_s * (time_s - self.start_s)
    }

    /// Motion of the element for the Doppler term at `time_s`.
    fn motion_at(&self, time_s: f64) -> Motion {
        let moved = self.doppler_rate * (time_s - self.start_s);
        Motion {
            velocity_m_per_s: self.doppler.velocity_m_per_s + moved,
            ..self.doppler
        }
    }

    /// Sets the velocities and accelerations for the Doppler at `times_s`, of those that are not before `from_s`.
    #[inline(always)]
    fn move_from(&self, from_s: f64, times_s: &[f64], moving: &mut [[f64; CHUNK]; 6]) {
        let (v, rate, a) = (
            self.doppler.velocity_m_per_s.to_array(),
            self.doppler_rate.to_array(),
            self.doppler.acceleration_m_per_s2.to_array(),
        );
        let n = times_s.len().min(CHUNK);
        for axis in 0..3 {
            for i in 0..n {
                let value = v[axis] + rate[axis] * (times_s[i] - self.start_s);
                let is_here = times_s[i] >= from_s;
                moving[axis][i] = if is_here { value } else { moving[axis][i] };
                moving[3 + axis][i] = if is_here {
                    a[axis]
                } else {
                    moving[3 + axis][i]
                };
            }
        }
    }

    /// Velocity of the path in array axes.
    pub(crate) fn velocity_in_array_m_per_s(&self) -> DVec3 {
        self.array_from_world * self.velocity_m_per_s
    }
}

/// Track of one element through one ping. The buffer is reused.
#[derive(Debug, Default)]
pub(crate) struct ElementTrack {
    legs: Vec<Leg>,
    /// Intended end of the polyline. Echoes that arrive later are counted.
    end_s: f64,
    /// True if consecutive legs meet, so that every scatterer has exactly one root.
    seamless: bool,
    /// Largest distance of the element from its legs, metres.
    sag_m: f64,
    /// Element in body axes; `body_from_array` has the array axes there.
    element_m: DVec3,
    body_from_array: DQuat,
}

impl ElementTrack {
    /// A track with room for a polyline of `segments` segments.
    pub(crate) fn with_room_for(segments: usize) -> Self {
        Self {
            legs: Vec::with_capacity(segments),
            ..Self::default()
        }
    }

    /// Computes the legs of `element` under the plan's path and Doppler models. `chords`: of the plan.
    pub(crate) fn compute(
        &mut self,
        plan: &PingPlan,
        sent: (&Transmit, &[Chord]),
        array: &ArrayGeometry,
        element: usize,
    ) {
        self.compute_at(plan, sent, array, array.along_m(element));
    }

    /// As [`Self::compute`], for a point `along_m` from the centre along the array.
    pub(crate) fn compute_at(
        &mut self,
        plan: &PingPlan,
        (transmit, chords): (&Transmit, &[Chord]),
        array: &ArrayGeometry,
        along_m: f64,
    ) {
        let mounting = array.mounting_at(along_m);
        self.element_m = mounting.position_m;
        self.body_from_array = mounting.body_from_array;
        self.sag_m = 0.0;
        self.legs.clear();
        match plan.model.path {
            PathModel::StopAndHop | PathModel::Polyline => self.compute_segments(plan, transmit),
            PathModel::KSegment | PathModel::Continuous => {
                self.compute_chords(plan, transmit, chords);
            }
        }
        self.seamless = plan.model.path != PathModel::Polyline;
        self.end_s = match (plan.model.path, self.legs.last()) {
            (PathModel::Polyline | PathModel::KSegment, Some(last)) => {
                last.start_s + plan.model.segment_s
            }
            _ => f64::INFINITY,
        };
        self.bound_legs(plan.sound_speed_m_per_s);
    }

    /// c (t - t1) - |S - r(t)| increases along a leg, so its signs at the two ends show whether the
    /// root is between. Two triangle inequalities decide this for all scatterers together. The
    /// bounds increase from leg to leg.
    fn bound_legs(&mut self, c: f64) {
        let mut passed_m = f64::INFINITY;
        for leg in self.legs.iter_mut().rev() {
            if leg.end_s.is_finite() {
                let end_m = leg.at_m(leg.end_s).length();
                passed_m = passed_m.min(c * leg.end_s + end_m + BOUND_GUARD_M);
            }
            leg.passed_m = passed_m;
            leg.begun_m = c * leg.start_s - leg.origin_m.length() - BOUND_GUARD_M;
        }
    }

    /// Legs from the plan's segments. `stop-and-hop` uses only the first segment, at rest.
    fn compute_segments(&mut self, plan: &PingPlan, transmit: &Transmit) {
        let (segments, moving) = match plan.model.path {
            PathModel::StopAndHop => (&plan.segments[..1], 0.0),
            _ => (&plan.segments[..], 1.0),
        };
        for (k, segment) in segments.iter().enumerate() {
            let arm_m = segment.world_from_body * self.element_m;
            self.legs.push(Leg {
                start_s: segment.start_s,
                end_s: segments.get(k + 1).map_or(f64::INFINITY, |s| s.start_s),
                origin_m: transmit.relative_m(segment.position_m) + arm_m,
                velocity_m_per_s: segment.velocity_m_per_s * moving,
                doppler: doppler_motion(plan, segment_motion(plan, k, arm_m)),
                doppler_rate: DVec3::ZERO,
                array_from_world: array_from_world(segment.world_from_body, self.body_from_array),
                turning_rad_per_s: DVec3::ZERO,
                facing_s: 0.0,
                passed_m: f64::INFINITY,
                begun_m: 0.0,
            });
        }
    }

    /// Legs from chords between the element's positions at the vertices of the segments. The array
    /// axes are those of each chord's middle and turn uniformly from there. The Doppler velocity is
    /// linear between vertices; the acceleration is the mean over a pulse that begins at the middle of
    /// the chord, which may be shorter than the pulse.
    fn compute_chords(&mut self, plan: &PingPlan, transmit: &Transmit, chords: &[Chord]) {
        let place_m = |pose: &Pose| pose.point_m(self.element_m) - transmit.arm_m;
        for chord in chords {
            let middle = &chord.middle;
            let origin_m = place_m(&chord.begin);
            let chord_m = place_m(&chord.end) - origin_m;
            let (motion, rate) = chord.motion(self.element_m, plan.pulse.duration_s);
            // Twice the distance of the middle from the chord bounds the distance of any smooth
            // arc.
            let off_m = (place_m(middle) - origin_m - 0.5 * chord_m).length();
            let array_from_world = array_from_world(middle.world_from_body, self.body_from_array);
            self.sag_m = self.sag_m.max(2.0 * off_m);
            self.legs.push(Leg {
                start_s: chord.start_s,
                end_s: chord.end_s,
                origin_m,
                velocity_m_per_s: chord_m / chord.step_s,
                doppler: doppler_motion(plan, motion),
                doppler_rate: match plan.model.doppler {
                    DopplerModel::None => DVec3::ZERO,
                    _ => rate,
                },
                array_from_world,
                turning_rad_per_s: array_from_world * middle.angular_velocity_rad_per_s,
                facing_s: 0.5 * chord.step_s,
                passed_m: f64::INFINITY,
                begun_m: 0.0,
            });
        }
    }

    pub(crate) fn end_s(&self) -> f64 {
        self.end_s
    }

    /// Legs from the first one that does not end before every root of the batch.
    fn not_passed(&self, batch: Batch) -> &[Leg] {
        let passed = |leg: &Leg| 2.0 * batch.min_range_m > leg.passed_m;
        &self.legs[self.legs.partition_point(passed)..]
    }

    /// The leg on which an echo arrives at `time_s`, and its index.
    pub(crate) fn leg_at(&self, time_s: f64) -> (usize, &Leg) {
        let at = self.legs.partition_point(|leg| leg.start_s <= time_s);
        let at = at.saturating_sub(1);
        (at, &self.legs[at])
    }

    /// The leg with this index.
    pub(crate) fn leg(&self, number: usize) -> &Leg {
        &self.legs[number]
    }

    /// Largest distance of this element from the transmit position up to `time_s`, metres.
    pub(crate) fn reach_m(&self, time_s: f64) -> f64 {
        let mut reach_m: f64 = 0.0;
        for leg in self.legs.iter().filter(|leg| leg.start_s <= time_s) {
            reach_m = reach_m
                .max(leg.origin_m.length())
                .max(leg.at_m(leg.end_s.min(time_s)).length());
        }
        reach_m + self.sag_m
    }

    /// Passes bounds on the Doppler velocities along this track to `visit`: a velocity and the
    /// maximum deviation from it, m/s.
    pub(crate) fn bound_velocities(&self, plan: &PingPlan, mut visit: impl FnMut(DVec3, f64)) {
        let last_s = self.legs.last().map_or(0.0, |leg| leg.start_s) + plan.model.segment_s;
        for leg in &self.legs {
            let end_s = leg.end_s.min(last_s).max(leg.start_s);
            let first = leg.doppler.velocity_m_per_s;
            let last = leg.motion_at(end_s).velocity_m_per_s;
            let beside = match plan.model.path {
                PathModel::Continuous => {
                    // Twice the distance of the middle from the chord bounds the distance of any
                    // smooth arc.
                    let middle_s = 0.5 * (leg.start_s + end_s);
                    let middle = self.motion_at(plan, middle_s).velocity_m_per_s;
                    2.0 * (middle - 0.5 * (first + last)).length()
                }
                _ => 0.0,
            };
            visit(first, beside);
            visit(last, beside);
        }
    }

    /// Motion of the element for the Doppler term at the arrival of up to [`CHUNK`] echoes:
    /// velocity and acceleration, axis by axis.
    pub(crate) fn motions_at(
        &self,
        plan: &PingPlan,
        times_s: &[f64],
        moving: &mut [[f64; CHUNK]; 6],
    ) {
        let n = times_s.len().min(CHUNK);
        let (min_s, greatest_s) = min_max(&times_s[..n]);
        let (first, _) = self.leg_at(min_s);
        let (last, _) = self.leg_at(greatest_s);
        if plan.model.path != PathModel::Continuous && last - first < MAX_LEGS_OF_MOTION {
            motions_on(&self.legs[first..=last], &times_s[..n], moving);
            return;
        }
        for (i, &time_s) in times_s[..n].iter().enumerate() {
            let motion = self.motion_at(plan, time_s);
            let (v, a) = (motion.velocity_m_per_s, motion.acceleration_m_per_s2);
            for (axis, value) in [v.x, v.y, v.z, a.x, a.y, a.z].into_iter().enumerate() {
                moving[axis][i] = value;
            }
        }
    }

    /// Velocity of the element on the trajectory, for any path model, and the rotation from array
    /// axes to world axes.
    pub(crate) fn velocity_at(&self, plan: &PingPlan, time_s: f64) -> (DVec3, DQuat) {
        let pose = plan.trajectory.pose_at(time_s);
        let velocity = pose.point_velocity_m_per_s(self.element_m);
        (velocity, pose.world_from_body * self.body_from_array)
    }

    /// Motion of the element for the Doppler term at the arrival of an echo.
    pub(crate) fn motion_at(&self, plan: &PingPlan, time_s: f64) -> Motion {
        if plan.model.path == PathModel::Continuous {
            let pose = plan.trajectory.pose_at(time_s);
            return doppler_motion(plan, trajectory_motion(plan, self.element_m, &pose, time_s));
        }
        self.leg_at(time_s).1.motion_at(time_s)
    }
}

/// Motions for the Doppler at `times_s` on legs that follow each other, the first of which has begun.
fn motions_on(legs: &[Leg], times_s: &[f64], moving: &mut [[f64; CHUNK]; 6]) {
    widest(
        #[inline(always)]
        || {
            let mut from_s = f64::NEG_INFINITY;
            for (leg, next) in legs.iter().zip(1..) {
                leg.move_from(from_s, times_s, moving);
                from_s = legs.get(next).map_or(f64::INFINITY, |leg| leg.start_s);
            }
        },
    );
}

/// Smallest and largest value, vectorised. NaN is ignored.
fn min_max(values: &[f64]) -> (f64, f64) {
    const SIDE_BY_SIDE: usize = 8;
    let mut least = [f64::INFINITY; SIDE_BY_SIDE];
    let mut greatest = [f64::NEG_INFINITY; SIDE_BY_SIDE];
    let mut look = |values: &[f64]| {
        for ((least, greatest), &value) in least.iter_mut().zip(&mut greatest).zip(values) {
            *least = if value < *least { value } else { *least };
            *greatest = if value > *greatest { value } else { *greatest };
        }
    };
    let (eights, rest) = values.as_chunks::<SIDE_BY_SIDE>();
    eights.iter().for_each(|eight| look(eight));
    look(rest);
    (
        least.into_iter().fold(f64::INFINITY, f64::min),
        greatest.into_iter().fold(f64::NEG_INFINITY, f64::max),
    )
}

/// Up to [`CHUNK`] scatterers, metres from the transmit position.
#[derive(Clone, Copy)]
pub(crate) struct Batch<'a> {
    pub x_m: &'a [f64],
    pub y_m: &'a [f64],
    pub z_m: &'a [f64],
    /// Length of the transmit leg.
    pub range_m: &'a [f64],
    /// Point to which the transmit leg leads, axis by axis: the scatterer itself, unless the echo is reflected on one leg.
    pub transmit_m: [&'a [f64]; 3],
    /// Half the path by way of the transmit point and back to the transmit position: `range_m`, unless the legs differ.
    pub half_path_m: &'a [f64],
    /// Smallest and largest half path.
    pub min_range_m: f64,
    pub(crate) max_range_m: f64,
}

impl<'a> Batch<'a> {
    /// The scatterers from `first` on, [`PART`] at most.
    fn part(self, first: usize) -> Self {
        let span = first..(first + PART).min(self.range_m.len());
        let half_path_m = &self.half_path_m[span.clone()];
        let (min_range_m, max_range_m) = min_max(half_path_m);
        Self {
            x_m: &self.x_m[span.clone()],
            y_m: &self.y_m[span.clone()],
            z_m: &self.z_m[span.clone()],
            range_m: &self.range_m[span.clone()],
            transmit_m: self.transmit_m.map(|axis| &axis[span.clone()]),
            half_path_m,
            min_range_m,
            max_range_m,
        }
    }
}

/// Solved geometry of a batch at one element: the delay, and the receive ray at reception.
pub struct Rays {
    /// Leading edge, seconds after the start of the pulse.
    pub delay_s: [f64; CHUNK],
    /// North component of the ray from the element to the scatterer, metres.
    pub x_m: [f64; CHUNK],
    /// East component of the ray, metres.
    pub y_m: [f64; CHUNK],
    /// Down component of the ray, metres.
    pub z_m: [f64; CHUNK],
    /// The ray in array axes, metres.
    pub(crate) array_x_m: [f64; CHUNK],
    pub(crate) array_y_m: [f64; CHUNK],
    pub(crate) array_z_m: [f64; CHUNK],
    /// Dot product of the receiver's velocity and the ray, m^2/s: closing speed times range.
    pub(crate) closing_m2_per_s: [f64; CHUNK],
}

impl Default for Rays {
    fn default() -> Self {
        let zero = [0.0; CHUNK];
        Self {
            delay_s: zero,
            x_m: zero,
            y_m: zero,
            z_m: zero,
            array_x_m: zero,
            array_y_m: zero,
            array_z_m: zero,
            closing_m2_per_s: zero,
        }
    }
}

impl Rays {
    /// Marks every scatterer as unsolved.
    fn begin(&mut self) {
        *self = Self {
            delay_s: [f64::INFINITY; CHUNK],
            ..Self::default()
        };
    }
}

/// Scatterers of a batch with no root or with more than one.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct RootCounts {
    pub no_root: u64,
    pub two_roots: u64,
}

/// Travel time of the second leg, seconds. `(x, y, z)` is the scatterer relative to the
/// receiver when the sound reaches the scatterer. See the module documentation for the equation.
#[inline(always)]
fn second_leg_s(x: f64, y: f64, z: f64, v: DVec3, c2_minus_v2: f64) -> f64 {
    let along = x * v.x + y * v.y + z * v.z;
    let square = x * x + y * y + z * z;
    let root = (along * along + c2_minus_v2 * square).sqrt();
    let sum = along.abs() + root;
    let ahead = along >= 0.0;
    let over = if ahead { square } else { sum };
    // Prevents 0/0 for a receiver at the scatterer.
    let under = if ahead {
        sum.max(f64::MIN_POSITIVE)
    } else {
        c2_minus_v2
    };
    over / under
}

/// Solves one leg for a batch with rays that begin at index `at`, and stores the roots on this leg.
/// Returns the number of stored roots.
///
/// `ALONE`: the leg has neither start nor end, so every root is on it and `rays` needs no reset.
#[inline(always)]
fn solve_leg<const ALONE: bool>(
    leg: &Leg,
    c: f64,
    batch: Batch,
    rays: &mut Rays,
    at: usize,
    odd: &mut RootCounts,
) -> u64 {
    let n = batch.range_m.len().min(CHUNK - at);
    let (x_m, y_m, z_m) = (&batch.x_m[..n], &batch.y_m[..n], &batch.z_m[..n]);
    let range_m = &batch.range_m[..n];
    let (o, v) = (leg.origin_m, leg.velocity_m_per_s);
    let (w, dw) = (leg.doppler.velocity_m_per_s, leg.doppler_rate);
    let (m, turning) = (leg.array_from_world, leg.turning_rad_per_s);
    // The ray in array axes at `after_s` after the start of the leg.
    let in_array = |x: f64, y: f64, z: f64, after_s: f64| {
        let u = m.x_axis.x * x + m.y_axis.x * y + m.z_axis.x * z;
        let v = m.x_axis.y * x + m.y_axis.y * y + m.z_axis.y * z;
        let w = m.x_axis.z * x + m.y_axis.z * y + m.z_axis.z * z;
        // The ray rotates in the opposite sense to the axes.
        let turned_s = after_s - leg.facing_s;
        [
            u + turned_s * (v * turning.z - w * turning.y),
            v + turned_s * (w * turning.x - u * turning.z),
            w + turned_s * (u * turning.y - v * turning.x),
        ]
    };
    let c2_minus_v2 = c * c - v.length_squared();
    let to_delay_s = &mut rays.delay_s[at..][..n];
    let to_x_m = &mut rays.x_m[at..][..n];
    let to_y_m = &mut rays.y_m[at..][..n];
    let to_z_m = &mut rays.z_m[at..][..n];
    let to_array_x_m = &mut rays.array_x_m[at..][..n];
    let to_array_y_m = &mut rays.array_y_m[at..][..n];
    let to_array_z_m = &mut rays.array_z_m[at..][..n];
    let to_closing_m2_per_s = &mut rays.closing_m2_per_s[at..][..n];
    let (mut placed, mut none, mut two) = (0, 0, 0);
    for i in 0..n {
        let (x, y, z) = (x_m[i] - o.x, y_m[i] - o.y, z_m[i] - o.z);
        let first_leg_s = range_m[i] / c;
        let waited_s = first_leg_s - leg.start_s;
        let second_s = second_leg_s(
            x - v.x * waited_s,
            y - v.y * waited_s,
            z - v.z * waited_s,
            v,
            c2_minus_v2,
        );
        let root_s = first_leg_s + second_s;
        if ALONE {
            let after_s = root_s - leg.start_s;
            let (x, y, z) = (x - v.x * after_s, y - v.y * after_s, z - v.z * after_s);
            to_delay_s[i] = root_s;
            (to_x_m[i], to_y_m[i], to_z_m[i]) = (x, y, z);
            [to_array_x_m[i], to_array_y_m[i], to_array_z_m[i]] = in_array(x, y, z, after_s);
            let (wx, wy, wz) = (
                w.x + dw.x * after_s,
                w.y + dw.y * after_s,
                w.z + dw.z * after_s,
            );
            to_closing_m2_per_s[i] = wx * x + wy * y + wz * z;
            continue;
        }

        let open = to_delay_s[i] == f64::INFINITY;
        let early = root_s < leg.start_s;
        let on_time = root_s < leg.end_s;
        let take = open & on_time;
        // Wrapping addition avoids a branch for the overflow check. The count is at most 256.
        placed = u64::wrapping_add(placed, take as u64);
        none = u64::wrapping_add(none, (open & early) as u64);
        two = u64::wrapping_add(two, (!open & !early & on_time) as u64);

        // An early root means that every earlier leg found its root late. The element steps at the
        // vertex, so the vertex time is used.
        let delay_s = root_s.max(leg.start_s);
        let after_s = delay_s - leg.start_s;
        let (x, y, z) = (x - v.x * after_s, y - v.y * after_s, z - v.z * after_s);
        // Each scatterer is stored once, in arrays that start as zeros. The addition of 0 or 1
        // times the value vectorises; an `if` would put a branch around the stores.
        let chosen = if take { 1.0 } else { 0.0 };
        to_delay_s[i] = to_delay_s[i].min(if take { delay_s } else { f64::INFINITY });
        to_x_m[i] += chosen * x;
        to_y_m[i] += chosen * y;
        to_z_m[i] += chosen * z;
        let [array_x, array_y, array_z] = in_array(x, y, z, after_s);
        to_array_x_m[i] += chosen * array_x;
        to_array_y_m[i] += chosen * array_y;
        to_array_z_m[i] += chosen * array_z;
        let (wx, wy, wz) = (
            w.x + dw.x * after_s,
            w.y + dw.y * after_s,
            w.z + dw.z * after_s,
        );
        to_closing_m2_per_s[i] += chosen * (wx * x + wy * y + wz * z);
    }
    if ALONE {
        return n as u64;
    }
    odd.no_root += none;
    odd.two_roots += two;
    placed
}

/// Number of scatterers that select their legs together if a batch spans many legs. Consecutive
/// scatterers span few legs.
pub const PART: usize = 32;
/// Maximum number of legs that are solved by the whole batch.
const FEW_LEGS: usize = 2;
/// Motions of a batch that spans at most so many legs are computed leg by leg, all scatterers at once.
const MAX_LEGS_OF_MOTION: usize = 8;

/// Computes delays and receive rays of a batch. Each scatterer uses the first leg k with t_k <= u <
/// t_{k+1}.
pub(crate) fn solve(track: &ElementTrack, c: f64, batch: Batch, rays: &mut Rays) -> RootCounts {
    let n = batch.range_m.len();
    let mut odd = RootCounts::default();
    if let [leg] = &track.legs[..]
        && leg.start_s == 0.0
    {
        widest(
            #[inline(always)]
            || solve_leg::<true>(leg, c, batch, rays, 0, &mut odd),
        );
        return odd;
    }
    rays.begin();
    let legs = track.not_passed(batch);
    let begun = legs.partition_point(|leg| leg.begun_m <= 2.0 * batch.max_range_m);
    if begun <= FEW_LEGS {
        solve_legs(legs, c, batch, rays, 0, &mut odd);
    } else {
        for first in (0..n).step_by(PART) {
            let part = batch.part(first);
            solve_legs(track.not_passed(part), c, part, rays, first, &mut odd);
        }
    }
    // Legs that meet leave no gap, so a root between them is due to rounding.
    if track.seamless {
        return RootCounts::default();
    }
    odd
}

/// Solves leg after leg until every scatterer is solved and no later leg can hold a second root.
fn solve_legs(
    legs: &[Leg],
    c: f64,
    batch: Batch,
    rays: &mut Rays,
    at: usize,
    odd: &mut RootCounts,
) {
    let n = batch.range_m.len() as u64;
    let mut placed = 0;
    for leg in legs {
        if placed == n && leg.begun_m > 2.0 * batch.max_range_m {
            break;
        }
        placed += widest(
            #[inline(always)]
            || solve_leg::<false>(leg, c, batch, rays, at, odd),
        );
    }
    debug_assert_eq!(placed, n, "the last leg has no end");
}

/// Maximum number of Newton steps. The error of the chords is microseconds, and each step squares
/// it.
const MAX_STEPS: usize = 12;

/// Refines the delays and rays of [`solve`] from the element's chords to its trajectory:
/// `c u = r_T + |S - r(u)|`.
///
/// The residual grows at a rate of at least 0.9 c. It therefore brackets the root and bounds the
/// step.
pub(crate) fn refine(
    plan: &PingPlan,
    transmit: &Transmit,
    track: &ElementTrack,
    batch: Batch,
    rays: &mut Rays,
) {
    let c = plan.sound_speed_m_per_s;
    for i in 0..batch.range_m.len().min(CHUNK) {
        let at_m = DVec3::new(batch.x_m[i], batch.y_m[i], batch.z_m[i]) + transmit.arm_m;
        let mut delay_s = rays.delay_s[i];
        let mut pose = Pose::default();
        let mut ray_m = DVec3::ZERO;
        for _ in 0..MAX_STEPS {
            pose = plan.trajectory.pose_from(transmit.reference_m, delay_s);
            ray_m = at_m - pose.point_m(track.element_m);
            let leg_m = ray_m.length();
            let residual_m = c * delay_s - batch.range_m[i] - leg_m;
            let velocity_m_per_s = pose.point_velocity_m_per_s(track.element_m);
            let closing = velocity_m_per_s.dot(ray_m) / leg_m.max(f64::MIN_POSITIVE);
            let step_s = -residual_m / (c + closing).max(0.9 * c);
            delay_s += step_s;
            // The delay no longer changes, and the element goes the rest of the way.
            ray_m -= velocity_m_per_s * step_s;
            if step_s.abs() <= SETTLED_S {
                break;
            }
        }
        let in_array = array_from_world(pose.world_from_body, track.body_from_array) * ray_m;
        let doppler_velocity = match plan.model.doppler {
            DopplerModel::None => DVec3::ZERO,
            _ => pose.point_velocity_m_per_s(track.element_m),
        };
        rays.delay_s[i] = delay_s;
        (rays.x_m[i], rays.y_m[i], rays.z_m[i]) = ray_m.into();
        (rays.array_x_m[i], rays.array_y_m[i], rays.array_z_m[i]) = in_array.into();
        rays.closing_m2_per_s[i] = doppler_velocity.dot(ray_m);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use echotank_core::simd::SimdLevel;

    fn leg() -> Leg {
        let turn = DQuat::from_rotation_x(0.3) * DQuat::from_rotation_z(1.1);
        Leg {
            start_s: 0.04,
            end_s: 0.08,
            origin_m: DVec3::new(0.4, -0.2, 0.1),
            velocity_m_per_s: DVec3::new(5.0, -1.0, 0.3),
            doppler: Motion {
                velocity_m_per_s: DVec3::new(5.0, -1.0, 0.3),
                acceleration_m_per_s2: DVec3::new(0.2, 0.1, -0.4),
            },
            doppler_rate: DVec3::new(0.1, 0.2, -0.5),
            array_from_world: DMat3::from_quat(turn),
            turning_rad_per_s: DVec3::new(0.1, -0.3, 0.2),
            facing_s: 0.02,
            passed_m: f64::INFINITY,
            begun_m: 0.0,
        }
    }

    #[test]
    fn every_time_has_the_motion_of_the_last_leg_that_has_begun() {
        let leg = leg();
        let legs = [0.0, 0.04, 0.08].map(|start_s| {
            let more = DVec3::splat(start_s);
            let doppler = Motion {
                velocity_m_per_s: leg.doppler.velocity_m_per_s + more,
                acceleration_m_per_s2: leg.doppler.acceleration_m_per_s2 - more,
            };
            Leg {
                start_s,
                doppler,
                doppler_rate: leg.doppler_rate + more,
                ..leg
            }
        });
        let mut times_s: Vec<f64> = (0..CHUNK)
            .map(|k| (0.618 * k as f64).fract() * 0.12)
            .collect();
        times_s[..3].copy_from_slice(&[0.04, 0.08, 0.08f64.next_down()]);
        let mut moving = [[f64::NAN; CHUNK]; 6];
        motions_on(&legs, &times_s, &mut moving);
        for (i, &time_s) in times_s.iter().enumerate() {
            let leg = legs.iter().rev().find(|leg| leg.start_s <= time_s);
            let leg = leg.expect("the first begins at 0");
            let Motion {
                velocity_m_per_s: v,
                acceleration_m_per_s2: a,
            } = leg.doppler;
            let v = v + leg.doppler_rate * (time_s - leg.start_s);
            assert_eq!(moving.map(|m| m[i]), [v.x, v.y, v.z, a.x, a.y, a.z]);
        }
    }

    #[test]
    fn every_build_gives_the_same_bits() {
        let leg = leg();
        let place = |step: f64| -> Vec<f64> {
            (0..CHUNK)
                .map(|k| 150.0 * ((k as f64 * step).fract() - 0.5))
                .collect()
        };
        let (x, y, z) = (place(0.618), place(0.755), place(0.57));
        let range: Vec<f64> = (0..CHUNK)
            .map(|i| DVec3::new(x[i], y[i], z[i]).length())
            .collect();
        let batch = Batch {
            x_m: &x,
            y_m: &y,
            z_m: &z,
            range_m: &range,
            transmit_m: [&x, &y, &z],
            half_path_m: &range,
            min_range_m: 0.0,
            max_range_m: 300.0,
        };
        fn run<const ALONE: bool>(
            level: SimdLevel,
            leg: &Leg,
            batch: Batch,
        ) -> (u64, RootCounts, [[u64; CHUNK]; 4]) {
            let mut rays = Rays::default();
            rays.begin();
            let mut odd = RootCounts::default();
            let placed = level.run(
                #[inline(always)]
                || solve_leg::<ALONE>(leg, 1500.0, batch, &mut rays, 0, &mut odd),
            );
            assert!(placed > 20, "{placed}");
            let solved = [
                rays.delay_s,
                rays.z_m,
                rays.array_x_m,
                rays.closing_m2_per_s,
            ];
            (placed, odd, solved.map(|a| a.map(f64::to_bits)))
        }
        // A single leg gives the same result as the same leg among others, except for the sign of
        // zero.
        let alone = Leg {
            start_s: 0.0,
            end_s: f64::INFINITY,
            ..leg
        };
        let want = run::<false>(SimdLevel::PORTABLE, &leg, batch);
        let want_alone = run::<false>(SimdLevel::PORTABLE, &alone, batch);
        for level in SimdLevel::available() {
            assert!(run::<false>(level, &leg, batch) == want);
            assert!(run::<true>(level, &alone, batch) == want_alone);
        }
    }
}
