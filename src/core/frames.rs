//! Frames of reference, rotations, and the motion of the platform during one ping.
//!
//! - World: north-east-down metres on a local tangent plane.
//! - Body: x forward, y starboard, z down. `world_from_body = Rz(heading) Ry(pitch) Rx(roll)`.
//! - Array: x along the line of elements, y across it, z the boresight. `body_from_array = Rz(yaw) Ry(pitch) Rx(roll)`. With zero
//!   angles the line lies fore-and-aft and looks straight down. Roll -60 deg looks to starboard, 30 deg below the horizontal; +60
//!   deg looks to port. Yaw 90 deg gives an across-track line whose +x end is to starboard.

use glam::{DMat3, DQuat, DVec3};

/// Rotation from a body (or array) frame to its parent frame: Rz(heading) Ry(pitch) Rx(roll), angles in radians.
pub fn rotation_from_angles(roll_rad: f64, pitch_rad: f64, heading_rad: f64) -> DQuat {
    DQuat::from_rotation_z(heading_rad)
        * DQuat::from_rotation_y(pitch_rad)
        * DQuat::from_rotation_x(roll_rad)
}

/// Roll, pitch and heading (radians, heading in 0..2pi) of a rotation; inverse of [`rotation_from_angles`]. At pitch +-90 deg,
/// roll and heading are not separable and roll is zero.
pub fn angles_from_rotation(world_from_body: DQuat) -> (f64, f64, f64) {
    let m = DMat3::from_quat(world_from_body);
    // `m.x_axis` is the forward axis of the body in world axes; the other columns likewise.
    let sin_pitch = (-m.x_axis.z).clamp(-1.0, 1.0);
    let pitch = sin_pitch.asin();
    let (roll, heading) = if sin_pitch.abs() > 1.0 - 1e-12 {
        (0.0, (-m.y_axis.x).atan2(m.y_axis.y))
    } else {
        (m.y_axis.z.atan2(m.z_axis.z), m.x_axis.y.atan2(m.x_axis.x))
    };
    (roll, pitch, heading.rem_euclid(std::f64::consts::TAU))
}

/// Position, velocity and attitude of the platform's reference point at one instant.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Pose {
    /// Position in world axes, metres.
    pub position_m: DVec3,
    /// Velocity in world axes, metres per second.
    pub velocity_m_per_s: DVec3,
    /// Rotation from body to world axes.
    pub world_from_body: DQuat,
    /// Angular velocity in world axes, radians per second.
    pub angular_velocity_rad_per_s: DVec3,
}

impl Pose {
    /// World position of a point fixed in the body.
    pub fn point_m(&self, body_m: DVec3) -> DVec3 {
        self.position_m + self.world_from_body * body_m
    }
    /// World velocity of a point fixed in the body.
    pub fn point_velocity_m_per_s(&self, body_m: DVec3) -> DVec3 {
        self.velocity_m_per_s
            + self
                .angular_velocity_rad_per_s
                .cross(self.world_from_body * body_m)
    }
}

/// Value and first derivative of a vector channel at one time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct VectorKnot {
    /// Seconds from the start of the transmitted pulse.
    pub time_s: f64,
    /// Value; the channel defines the unit.
    pub value: DVec3,
    /// First derivative of the value, per second.
    pub rate_per_s: DVec3,
}

/// Rotation and body rates at one time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AttitudeKnot {
    /// Seconds from the start of the transmitted pulse.
    pub time_s: f64,
    /// Rotation from body to world axes.
    pub world_from_body: DQuat,
    /// Angular velocity, body axes, radians per second.
    pub body_rate_rad_per_s: DVec3,
}

/// Motion of the platform around one ping. All models interpolate the motion by the rule of this type.
///
/// Position and heave are C1 cubic Hermite interpolants between knots. Attitude is a C1 cumulative cubic Bezier curve on rotations
/// through the rotations and rates of the knots (Kim, Kim and Shin 1995, Eq. 11). Outside the knots the motion continues at the
/// rate of the end knot. `position` is the track of the navigation reference (an antenna at `lever_arm_m`). `heave` adds to the
/// down component of `position`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Trajectory {
    /// Position of the navigation reference in world axes, metres: north, east, down without heave. At least one knot; times
    /// increase strictly.
    pub position: Vec<VectorKnot>,
    /// Heave in `value.z`, positive down, metres. Empty without heave.
    pub heave: Vec<VectorKnot>,
    /// Rotations and body rates. At least one knot; times increase strictly.
    pub attitude: Vec<AttitudeKnot>,
    /// Position of the navigation reference in the body, metres.
    pub lever_arm_m: DVec3,
}

/// Index of the interval `[knots[i], knots[i+1]]` that holds `time_s`, or the nearest one. Of two knots or more.
fn interval<K>(knots: &[K], time_of: impl Fn(&K) -> f64, time_s: f64) -> usize {
    let begun = knots.partition_point(|knot| time_of(knot) <= time_s);
    begun.saturating_sub(1).min(knots.len() - 2)
}

/// Value and rate of a vector channel at `time_s`: cubic Hermite between the knots, linear outside them.
pub fn hermite(knots: &[VectorKnot], time_s: f64) -> (DVec3, DVec3) {
    hermite_from(knots, DVec3::ZERO, time_s)
}

/// [`hermite`] relative to `origin`, without loss of precision far from zero.
fn hermite_from(knots: &[VectorKnot], origin: DVec3, time_s: f64) -> (DVec3, DVec3) {
    let (Some(first), Some(last)) = (knots.first(), knots.last()) else {
        return (DVec3::ZERO - origin, DVec3::ZERO);
    };
    if time_s <= first.time_s {
        return (
            (first.value - origin) + first.rate_per_s * (time_s - first.time_s),
            first.rate_per_s,
        );
    }
    if time_s >= last.time_s {
        return (
            (last.value - origin) + last.rate_per_s * (time_s - last.time_s),
            last.rate_per_s,
        );
    }
    let i = interval(knots, |k| k.time_s, time_s);
    let (a, b) = (&knots[i], &knots[i + 1]);
    let h = b.time_s - a.time_s;
    let s = (time_s - a.time_s) / h;
    let (s2, s3) = (s * s, s * s * s);
    // A step from the first knot keeps the precision far from the origin.
    let step = b.value - a.value;
    let value = (a.value - origin)
        + step * (3.0 * s2 - 2.0 * s3)
        + a.rate_per_s * (h * (s - 2.0 * s2 + s3))
        + b.rate_per_s * (h * (s3 - s2));
    let rate = step * (6.0 * (s - s2) / h)
        + a.rate_per_s * (1.0 - 4.0 * s + 3.0 * s2)
        + b.rate_per_s * (3.0 * s2 - 2.0 * s);
    (value, rate)
}

/// Rotation and angular velocity (world axes) of the attitude channel at `time_s`.
pub fn attitude_at(knots: &[AttitudeKnot], time_s: f64) -> (DQuat, DVec3) {
    let (Some(first), Some(last)) = (knots.first(), knots.last()) else {
        return (DQuat::IDENTITY, DVec3::ZERO);
    };
    for (end, outside) in [
        (first, time_s <= first.time_s),
        (last, time_s >= last.time_s),
    ] {
        if outside {
            let rate = end.body_rate_rad_per_s;
            let rotation =
                end.world_from_body * DQuat::from_scaled_axis(rate * (time_s - end.time_s));
            return (rotation, rotation * rate);
        }
    }
    let i = interval(knots, |k| k.time_s, time_s);
    let (a, b) = (&knots[i], &knots[i + 1]);
    let h = b.time_s - a.time_s;
    let s = ((time_s - a.time_s) / h).clamp(0.0, 1.0);
    let first_step = a.body_rate_rad_per_s * (h / 3.0);
    let last_step = b.body_rate_rad_per_s * (h / 3.0);
    let inner_a = a.world_from_body * DQuat::from_scaled_axis(first_step);
    let inner_b = b.world_from_body * DQuat::from_scaled_axis(-last_step);
    let mut between = inner_a.inverse() * inner_b;
    if between.w < 0.0 {
        between = -between; // along the shorter arc
    }
    let middle_step = between.to_scaled_axis();
    // Cumulative Bernstein weights of degree 3 and their derivatives.
    let r = 1.0 - s;
    let weight = [1.0 - r * r * r, s * s * (3.0 - 2.0 * s), s * s * s];
    let slope = [3.0 * r * r / h, 6.0 * s * r / h, 3.0 * s * s / h];
    let steps = [first_step, middle_step, last_step];
    let mut rotation = a.world_from_body;
    let mut body_rate = DVec3::ZERO;
    for k in 0..3 {
        let turn = DQuat::from_scaled_axis(steps[k] * weight[k]);
        body_rate = turn.inverse() * body_rate + steps[k] * slope[k];
        rotation *= turn;
    }
    let rotation = rotation.normalize();
    (rotation, rotation * body_rate)
}

impl Trajectory {
    /// Pose of the body's reference point `time_s` seconds after the start of the pulse.
    pub fn pose_at(&self, time_s: f64) -> Pose {
        self.pose_from(DVec3::ZERO, time_s)
    }

    /// [`Self::pose_at`] with the position relative to `origin_m`, without loss of precision far from zero.
    pub fn pose_from(&self, origin_m: DVec3, time_s: f64) -> Pose {
        let (antenna, antenna_velocity) = hermite_from(&self.position, origin_m, time_s);
        let (heave, heave_rate) = hermite(&self.heave, time_s);
        let (world_from_body, angular_velocity) = attitude_at(&self.attitude, time_s);
        let arm = world_from_body * self.lever_arm_m;
        Pose {
            position_m: antenna + DVec3::new(0.0, 0.0, heave.z) - arm,
            velocity_m_per_s: antenna_velocity + DVec3::new(0.0, 0.0, heave_rate.z)
                - angular_velocity.cross(arm),
            world_from_body,
            angular_velocity_rad_per_s: angular_velocity,
        }
    }

    /// Uniform straight motion without rotation. `position_m` and `velocity_m_per_s` hold at time zero, in world axes.
    pub fn uniform(position_m: DVec3, velocity_m_per_s: DVec3, world_from_body: DQuat) -> Self {
        Self {
            position: vec![VectorKnot {
                time_s: 0.0,
                value: position_m,
                rate_per_s: velocity_m_per_s,
            }],
            heave: Vec::new(),
            attitude: vec![AttitudeKnot {
                time_s: 0.0,
                world_from_body,
                body_rate_rad_per_s: DVec3::ZERO,
            }],
            lever_arm_m: DVec3::ZERO,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn roll_positive_puts_starboard_down_and_pitch_positive_puts_the_bow_up() {
        let roll = rotation_from_angles(0.1, 0.0, 0.0);
        assert!((roll * DVec3::Y).z > 0.0, "starboard goes down (z grows)");
        let pitch = rotation_from_angles(0.0, 0.1, 0.0);
        assert!((pitch * DVec3::X).z < 0.0, "bow goes up (z falls)");
        let heading = rotation_from_angles(0.0, 0.0, std::f64::consts::FRAC_PI_2);
        assert!(
            (heading * DVec3::X - DVec3::Y).length() < 1e-15,
            "heading 90 deg looks east"
        );
    }

    #[test]
    fn angles_survive_the_rotation() {
        for &(r, p, h) in &[
            (0.1, -0.2, 6.2),
            (-1.2, 0.7, 3.3),
            (0.0, 0.0, 0.0),
            (2.9, -1.4, 1.0),
        ] {
            let (r2, p2, h2) = angles_from_rotation(rotation_from_angles(r, p, h));
            assert!(
                (r - r2).abs() < 1e-12 && (p - p2).abs() < 1e-12 && (h - h2).abs() < 1e-12,
                "{r} {p} {h}: {r2} {p2} {h2}"
            );
        }
        let steep = rotation_from_angles(0.3, std::f64::consts::FRAC_PI_2, 0.5);
        let (r, p, h) = angles_from_rotation(steep);
        assert!(r.is_finite() && p.is_finite() && h.is_finite());
        assert!(rotation_from_angles(r, p, h).angle_between(steep) < 1e-6);
    }

    /// Eq. 4 of Meng et al. 2023 is Rx(eta) Ry(beta) Rz(alpha) only if the third column has cos beta instead of the printed cos
    /// alpha.
    #[test]
    fn equation_4_is_a_rotation_only_as_corrected() {
        let (alpha, beta, eta) = (0.3_f64, -0.4_f64, 0.7_f64);
        let matrix = |third: f64| {
            let (sa, ca, sb, cb, se, ce) = (
                alpha.sin(),
                alpha.cos(),
                beta.sin(),
                beta.cos(),
                eta.sin(),
                eta.cos(),
            );
            DMat3::from_cols(
                DVec3::new(ca * cb, sa * ce + ca * sb * se, sa * se - ca * sb * ce),
                DVec3::new(-sa * cb, ca * ce - sa * sb * se, ca * se + sa * sb * ce),
                DVec3::new(sb, -third * se, third * ce),
            )
        };
        let corrected = matrix(beta.cos());
        let product = DMat3::from_rotation_x(eta)
            * DMat3::from_rotation_y(beta)
            * DMat3::from_rotation_z(alpha);
        assert!(
            (corrected - product)
                .to_cols_array()
                .iter()
                .all(|d| d.abs() < 1e-15)
        );
        let gram = |m: DMat3| {
            (m.transpose() * m - DMat3::IDENTITY)
                .to_cols_array()
                .iter()
                .fold(0.0_f64, |a, d| a.max(d.abs()))
        };
        assert!(gram(corrected) < 1e-15 && gram(matrix(alpha.cos())) > 0.01);
    }

    #[test]
    fn hermite_reproduces_a_cubic_and_its_rate() {
        let f = |t: f64| DVec3::new(t * t * t - 2.0 * t, 0.5 * t * t, 7.0);
        let d = |t: f64| DVec3::new(3.0 * t * t - 2.0, t, 0.0);
        let knots: Vec<_> = [-1.0, 0.5, 2.0]
            .iter()
            .map(|&t| VectorKnot {
                time_s: t,
                value: f(t),
                rate_per_s: d(t),
            })
            .collect();
        for t in [-1.0, -0.3, 0.5, 1.7, 2.0] {
            let (value, rate) = hermite(&knots, t);
            assert!(
                (value - f(t)).length() < 1e-13 && (rate - d(t)).length() < 1e-13,
                "t = {t}"
            );
        }
        let (value, rate) = hermite(&knots, 3.0);
        assert!(
            (value - (f(2.0) + d(2.0))).length() < 1e-13 && rate == d(2.0),
            "straight on outside"
        );
    }

    #[test]
    fn attitude_meets_knots_and_its_rate_is_the_derivative_of_its_rotation() {
        let knot = |t: f64, r: f64, p: f64, h: f64, w: DVec3| AttitudeKnot {
            time_s: t,
            world_from_body: rotation_from_angles(r, p, h),
            body_rate_rad_per_s: w,
        };
        // Across north: 359 deg to 1 deg.
        let knots = [
            knot(0.0, 0.02, -0.05, 6.26, DVec3::new(0.03, -0.02, 0.01)),
            knot(1.0, 0.05, 0.03, 0.02, DVec3::new(-0.01, 0.05, 0.03)),
        ];
        for k in &knots {
            let (rotation, rate) = attitude_at(&knots, k.time_s);
            assert!(rotation.angle_between(k.world_from_body) < 1e-7);
            assert!((rate - k.world_from_body * k.body_rate_rad_per_s).length() < 1e-12);
        }
        for t in [0.1, 0.35, 0.5, 0.8] {
            let step = 1e-5;
            let (before, _) = attitude_at(&knots, t - step);
            let (after, _) = attitude_at(&knots, t + step);
            let measured = (after * before.inverse()).to_scaled_axis() / (2.0 * step);
            let (_, rate) = attitude_at(&knots, t);
            assert!(
                (measured - rate).length() < 1e-7,
                "t = {t}: {measured} against {rate}"
            );
        }
    }

    #[test]
    fn an_antenna_on_an_arm_moves_the_reference_point_the_other_way() {
        let mut track = Trajectory::uniform(
            DVec3::new(10.0, 20.0, -5.0),
            DVec3::X,
            rotation_from_angles(0.0, 0.0, std::f64::consts::FRAC_PI_2),
        );
        track.lever_arm_m = DVec3::new(3.0, 0.0, -5.0);
        let pose = track.pose_at(2.0);
        assert!((pose.position_m - DVec3::new(12.0, 17.0, 0.0)).length() < 1e-12);
    }
}
