//! Trajectory and state of the platform at one ping, computed from the rings.

use glam::{DQuat, DVec2, DVec3};

use super::{HeadingFrom, MIN_COURSE_SPEED_M_PER_S, NavGap, NavHistory, index};
use crate::ring::{Knot, Stretch, set_body_rates, set_rates};
use echotank_config::spec::{NavChannel, NavMode, OnLost, TowSpec, VerticalSpec};
use echotank_core::frames::{
    AttitudeKnot, Trajectory, VectorKnot, angles_from_rotation, attitude_at, hermite,
    rotation_from_angles,
};
use echotank_core::navigation::{FixQuality, NavInvalid, NavState};
use echotank_core::time::UtcNs;

/// Lead of a trajectory before the pulse, seconds. With this lead the rates at the start of the pulse come from measured knots.
const LOOKBACK_S: f64 = 1.0;
/// Maximum distance in time of sensor samples for interpolation, seconds. Swell can reverse within a longer time. Track files may
/// be sparser.
pub(crate) const MAX_GAP_S: f64 = 5.0;
/// Bounds of an interval without a seam.
const NO_SEAM_BEFORE: UtcNs = UtcNs(i64::MIN);
const NO_SEAM_AFTER: UtcNs = UtcNs(i64::MAX);
/// Minimum time to come to rest, seconds. It keeps knot times distinct.
const MIN_REST_S: f64 = 1e-3;
/// Maximum accepted platform speed, metres per second: a tenth of the speed of sound in water. The echo model is invalid above it.
const MAX_SPEED_M_PER_S: f64 = 150.0;

impl NavHistory {
    /// State at `transmit_utc`, and the motion from a second before it to `window_s` after it. Times in `trajectory` are relative
    /// to `transmit_utc`; its buffers are reused. Mode `settle` does not extrapolate. Mode `predict` extrapolates by at most
    /// `max_extrapolation_s` at the end of the window. With `on_lost = "hold"`, older motion comes to rest and is flagged invalid.
    pub fn motion(
        &mut self,
        transmit_utc: UtcNs,
        window_s: f64,
        mode: NavMode,
        trajectory: &mut Trajectory,
    ) -> Result<NavState, NavGap> {
        self.last_ping = self.last_ping.max(transmit_utc);
        let beyond = match (mode, self.on_lost) {
            (NavMode::Settle, _) => ExtrapolationPolicy::Refused { after_s: 0.0 },
            (NavMode::Predict, OnLost::Skip) => ExtrapolationPolicy::Refused {
                after_s: self.max_extrapolation_s,
            },
            (NavMode::Predict, OnLost::Hold) => ExtrapolationPolicy::Held {
                after_s: self.max_extrapolation_s,
            },
        };
        let result = self.fill_trajectory(transmit_utc, window_s, beyond, trajectory);
        let counts = &mut self.counts;
        match result {
            Ok(invalid) => Ok(self.state(transmit_utc, window_s, invalid, trajectory)),
            Err(gap) => {
                match gap {
                    NavGap::NoData(_) => counts.no_data += 1,
                    NavGap::Stale { .. } => counts.stale += 1,
                    NavGap::Hole { .. } => counts.holes += 1,
                    NavGap::Seam => counts.seams += 1,
                    NavGap::TooFast { .. } => counts.too_fast += 1,
                }
                Err(gap)
            }
        }
    }

    /// Predicted state and motion at `utc` from the samples so far. The motion is extrapolated for `max_extrapolation_s`, then held
    /// and flagged invalid. Refusals are not counted.
    pub fn predict(&mut self, utc: UtcNs, trajectory: &mut Trajectory) -> Result<NavState, NavGap> {
        let beyond = ExtrapolationPolicy::Held {
            after_s: self.max_extrapolation_s,
        };
        let invalid = self.fill_trajectory(utc, 0.0, beyond, trajectory)?;
        Ok(self.state(utc, 0.0, invalid, trajectory))
    }

    /// Age at `utc` of the newest sample that gives the heading, seconds; infinite without such a sample.
    pub fn heading_age_s(&self, utc: UtcNs) -> f64 {
        let newest = self.ring(self.heading_channel().0).newest();
        newest.map_or(f64::INFINITY, |newest| utc.seconds_since(newest))
    }

    /// Maximum extrapolation beyond the newest sample, seconds.
    pub fn max_extrapolation_s(&self) -> f64 {
        self.max_extrapolation_s
    }

    /// Age beyond which a source is stale, seconds.
    pub fn stale_s(&self) -> f64 {
        self.stale_s
    }

    fn fill_trajectory(
        &mut self,
        zero: UtcNs,
        window_s: f64,
        beyond: ExtrapolationPolicy,
        trajectory: &mut Trajectory,
    ) -> Result<NavInvalid, NavGap> {
        let window = Window {
            zero,
            from: zero.plus_s(-LOOKBACK_S),
            end: zero.plus_s(window_s),
            beyond,
        };
        let position = &mut trajectory.position;
        self.check(NavChannel::Position, &window)?;
        self.vector_knots(NavChannel::Position, &window, position)?;
        check_speed(position)?;

        let mut towed = window;
        if self.tow.is_some() {
            towed.widen(position);
        }
        let vertical = self.vertical_channel();
        trajectory.heave.clear();
        if let Some(channel) = vertical {
            self.check(channel, &window)?;
            let stretch = self.stretch(channel, &window)?;
            let ring = self.ring(channel);
            let range = ring.around(towed.from, towed.end, 2, stretch);
            ring.fill(range, zero, &mut trajectory.heave);
        }

        let mut wide = window;
        if self.has_arm() {
            wide.widen(position);
        }
        if self.vertical_has_arm() {
            wide.widen(&trajectory.heave);
        }
        self.attitude_knots(&window, &wide, &mut trajectory.attitude)?;

        // All knots between two seams come from one source.
        let end_of = |knots: &[VectorKnot]| knots.last().map_or(zero, |k| zero.plus_s(k.time_s));
        if let Some(channel) = vertical.filter(|_| self.vertical_has_arm()) {
            let sensor = self.sensor_at(channel, end_of(&trajectory.heave));
            let arm_m = sensor.map_or(DVec3::ZERO, |p| p.vertical_arm_m(channel));
            // At rest, a heave sensor measures zero and a depth sensor measures its own depth.
            let at_rest_m = if channel == NavChannel::Heave {
                arm_m.z
            } else {
                0.0
            };
            for knot in &mut trajectory.heave {
                let arm = rotation_at(&trajectory.attitude, knot.time_s) * arm_m;
                knot.value.z -= arm.z - at_rest_m;
            }
        }
        set_rates(&mut trajectory.heave);

        if self.has_arm() {
            let sensor = self.sensor_at(NavChannel::Position, end_of(&trajectory.position));
            let arm_m = sensor.map_or(DVec3::ZERO, |p| p.arm_m);
            let level = match self.vertical {
                VerticalSpec::Waterline { .. } => true,
                VerticalSpec::Gnss { .. } => false,
                VerticalSpec::Depth => self.uses_depth(),
            };
            for knot in &mut trajectory.position {
                let rotation = rotation_at(&trajectory.attitude, knot.time_s);
                let arm = match &self.tow {
                    None => rotation * arm_m,
                    Some(tow) => {
                        let (heave, _) = hermite(&trajectory.heave, knot.time_s);
                        ship_offset_m(tow, arm_m, rotation, knot.value.z + heave.z)
                    }
                };
                knot.value -= DVec3::new(arm.x, arm.y, if level { 0.0 } else { arm.z });
            }
        }
        set_rates(&mut trajectory.position);
        trajectory.lever_arm_m = DVec3::ZERO;
        Ok(self.bring_to_rest(&window, trajectory))
    }

    /// Time for which a channel is extrapolated before it comes to rest, seconds. `None` if the channel does not come to rest in
    /// this window.
    fn resting(&self, channel: NavChannel, w: &Window) -> Option<f64> {
        let ExtrapolationPolicy::Held { after_s } = w.beyond else {
            return None;
        };
        let newest = self.newest_of(channel, self.stretch(channel, w).ok()?)?;
        let old = w.end.seconds_since(newest.utc) > after_s;
        old.then_some(after_s.max(MIN_REST_S))
    }

    /// Brings outdated positions and heaves to rest and flags them invalid. The attitude is already at rest.
    fn bring_to_rest(&self, w: &Window, trajectory: &mut Trajectory) -> NavInvalid {
        let position = self.resting(NavChannel::Position, w);
        let vertical = self.vertical_channel().and_then(|c| self.resting(c, w));
        if let Some(after_s) = position {
            rest(&mut trajectory.position, after_s);
        }
        if let Some(after_s) = vertical {
            rest(&mut trajectory.heave, after_s);
        }
        NavInvalid {
            position: position.is_some(),
            heading: self.resting(self.heading_channel().0, w).is_some(),
            roll_pitch: self.owns(NavChannel::RollPitch)
                && self.resting(NavChannel::RollPitch, w).is_some(),
            vertical: vertical.is_some(),
        }
    }

    /// The interval between seams that contains the window. If samples may be absent, it is the last interval that has a sample.
    fn stretch(&self, channel: NavChannel, w: &Window) -> Result<Stretch, NavGap> {
        let own = |(at, of): &(UtcNs, Option<usize>)| {
            of.is_none_or(|of| of == index(channel)).then_some(*at)
        };
        let seams = || self.seams.iter().filter_map(own);
        let mut end = seams()
            .filter(|s| *s > w.zero)
            .min()
            .unwrap_or(NO_SEAM_AFTER);
        let mut start = seams()
            .filter(|s| *s <= w.zero)
            .max()
            .unwrap_or(NO_SEAM_BEFORE);
        if matches!(w.beyond, ExtrapolationPolicy::Refused { .. }) {
            return match end <= w.end {
                true => Err(NavGap::Seam),
                false => Ok(Stretch { start, end }),
            };
        }
        let begun = |start: UtcNs| {
            let newest = self.ring(channel).last_at_or_before(w.zero);
            newest.is_some_and(|k| k.utc >= start)
        };
        while start != NO_SEAM_BEFORE && !begun(start) {
            end = start;
            start = seams()
                .filter(|s| *s < start)
                .max()
                .unwrap_or(NO_SEAM_BEFORE);
        }
        Ok(Stretch { start, end })
    }

    /// Newest knot of an interval.
    fn newest_of(&self, channel: NavChannel, stretch: Stretch) -> Option<&Knot> {
        let ring = self.ring(channel);
        ring.iter(ring.within(stretch)).next_back()
    }

    /// Verifies that a channel covers the window.
    fn check(&self, channel: NavChannel, w: &Window) -> Result<(), NavGap> {
        let stretch = self.stretch(channel, w)?;
        let ring = self.ring(channel);
        let range = ring.within(stretch);
        let nothing = if stretch.start == NO_SEAM_BEFORE {
            NavGap::NoData(channel)
        } else {
            NavGap::Seam
        };
        let mut ends = ring.iter(range);
        let Some(first) = ends.next().filter(|k| k.utc <= w.zero) else {
            return Err(nothing);
        };
        let last = ends.next_back().unwrap_or(first);
        let age_s = w.end.seconds_since(last.utc);
        match w.beyond {
            ExtrapolationPolicy::Refused { .. } if age_s > 0.0 && stretch.end != NO_SEAM_AFTER => {
                return Err(NavGap::Seam);
            }
            ExtrapolationPolicy::Refused { after_s } if age_s > after_s => {
                return Err(NavGap::Stale { channel, age_s });
            }
            _ => {}
        }
        if self.is_sparse(channel) {
            return Ok(());
        }
        let mut before = None;
        for knot in ring.iter(ring.around(w.zero, w.end, 1, stretch)) {
            let gap_s = before.map_or(0.0, |b| knot.utc.seconds_since(b));
            if gap_s > MAX_GAP_S && knot.utc > w.zero {
                return Err(NavGap::Hole { channel, gap_s });
            }
            before = Some(knot.utc);
        }
        Ok(())
    }

    /// Writes the knots of a channel around the window, with zero rates.
    fn vector_knots(
        &self,
        channel: NavChannel,
        w: &Window,
        out: &mut Vec<VectorKnot>,
    ) -> Result<(), NavGap> {
        let ring = self.ring(channel);
        let stretch = self.stretch(channel, w)?;
        ring.fill(ring.around(w.from, w.end, 2, stretch), w.zero, out);
        Ok(())
    }

    fn attitude_knots(
        &mut self,
        needed: &Window,
        wide: &Window,
        out: &mut Vec<AttitudeKnot>,
    ) -> Result<(), NavGap> {
        let mut heading = std::mem::take(&mut self.heading);
        let result = self.attitude_knots_with(needed, wide, &mut heading, out);
        self.heading = heading;
        result
    }

    /// Attitude knots over `wide`. The samples must cover only `needed`.
    fn attitude_knots_with(
        &self,
        needed: &Window,
        wide: &Window,
        heading: &mut Vec<VectorKnot>,
        out: &mut Vec<AttitudeKnot>,
    ) -> Result<(), NavGap> {
        out.clear();
        let mounting = self.mounting(wide.zero);
        let knot = |time_s: f64, roll: f64, pitch: f64, heading: f64| AttitudeKnot {
            time_s,
            world_from_body: mounting.body(roll, pitch, heading),
            body_rate_rad_per_s: DVec3::ZERO,
        };
        if self.owns(NavChannel::RollPitch) {
            self.check(NavChannel::RollPitch, needed)?;
            let ring = self.ring(NavChannel::RollPitch);
            let stretch = self.stretch(NavChannel::RollPitch, needed)?;
            let range = ring.around(wide.from, wide.end, 2, stretch);
            let mut heading_wide = *wide;
            for k in ring.iter(range.clone()) {
                heading_wide.include(k.utc);
            }
            self.heading_knots(needed, &heading_wide, heading)?;
            out.extend(ring.iter(range).map(|k| {
                let time_s = k.utc.seconds_since(wide.zero);
                let (angle, _) = hermite(heading, time_s);
                knot(time_s, k.value.x, k.value.y, angle.x)
            }));
            if let (Some(after_s), Some(last)) = (
                self.resting(NavChannel::RollPitch, needed),
                self.newest_of(NavChannel::RollPitch, stretch),
            ) {
                // Roll and pitch keep their last values, and the heading continues at its rate.
                let last_s = last.utc.seconds_since(wide.zero);
                let mut rested_s = last_s + 2.0 * after_s;
                let mut hold = |time_s: f64| {
                    let (angle, _) = hermite(heading, time_s);
                    out.push(knot(time_s, last.value.x, last.value.y, angle.x));
                };
                hold(last_s + after_s);
                hold(rested_s);
                for k in heading.iter() {
                    if k.time_s > rested_s {
                        hold(k.time_s);
                        rested_s = k.time_s;
                    }
                }
            }
        } else {
            self.heading_knots(needed, wide, heading)?;
            out.extend(heading.iter().map(|k| knot(k.time_s, 0.0, 0.0, k.value.x)));
        }
        set_body_rates(out);
        Ok(())
    }

    /// Unwrapped heading knots with rates over `wide`. The samples must cover only `needed`.
    fn heading_knots(
        &self,
        needed: &Window,
        wide: &Window,
        out: &mut Vec<VectorKnot>,
    ) -> Result<(), NavGap> {
        let (channel, ahead) = self.heading_channel();
        if self.heading_from() == HeadingFrom::None {
            return Err(NavGap::NoData(channel));
        }
        self.check(channel, needed)?;
        let ring = self.ring(channel);
        let stretch = self.stretch(channel, needed)?;
        let range = ring.around(wide.from, wide.end, ahead, stretch);
        ring.fill(range, wide.zero, out);
        if self.heading_from() == HeadingFrom::Track {
            set_rates(out);
            courses_from_rates(out);
        }
        unwrap(out);
        set_rates(out);
        if let Some(after_s) = self.resting(channel, needed) {
            rest(out, after_s);
        }
        Ok(())
    }

    /// Mounting of the sensors that are active at this time.
    fn mounting(&self, utc: UtcNs) -> Mounting {
        let angles = |channel| {
            let sensor = self.sensor_at(channel, utc);
            sensor.map_or(DVec3::ZERO, |p| p.mounting.angles_rad)
        };
        let (heading, _) = self.heading_channel();
        let compass_rad = match self.heading_from() {
            HeadingFrom::Sensor => angles(heading).z,
            // The course does not depend on a mounting.
            _ => 0.0,
        };
        let motion = match self.owns(NavChannel::RollPitch) {
            true => angles(NavChannel::RollPitch),
            false => DVec3::ZERO,
        };
        Mounting {
            aligned: motion == DVec3::ZERO && compass_rad == 0.0,
            same_sensor: self.heading_from() == HeadingFrom::Sensor
                && self.owns(NavChannel::RollPitch)
                && self.active_source_at(heading, utc)
                    == self.active_source_at(NavChannel::RollPitch, utc),
            sensor_from_body: rotation_from_angles(motion.x, motion.y, motion.z).inverse(),
            compass_rad,
        }
    }

    fn state(
        &self,
        utc: UtcNs,
        window_s: f64,
        invalid: NavInvalid,
        trajectory: &Trajectory,
    ) -> NavState {
        let pose = trajectory.pose_at(0.0);
        let (roll_rad, pitch_rad, heading_rad) = angles_from_rotation(pose.world_from_body);
        let (heave, _) = hermite(&trajectory.heave, 0.0);
        let (latitude_rad, longitude_rad) = self.plane.map_or((0.0, 0.0), |plane| {
            plane.geodetic_rad(pose.position_m.x, pose.position_m.y)
        });
        // Knots that bring a channel to rest are not measurements.
        let newest = |channel: NavChannel, old: bool, knots: f64| match self.ring(channel).newest()
        {
            Some(newest) if old => newest.seconds_since(utc),
            _ => knots,
        };
        let behind = |knots: &[VectorKnot]| newest_used(knots.iter().map(|k| k.time_s), window_s);
        let heading_channel = self.heading_channel().0;
        let position_s = newest(
            NavChannel::Position,
            invalid.position,
            behind(&trajectory.position),
        );
        let heading_s = newest(heading_channel, invalid.heading, behind(&self.heading));
        let attitude_s = match self.owns(NavChannel::RollPitch) {
            true => newest(
                NavChannel::RollPitch,
                invalid.roll_pitch,
                newest_used(trajectory.attitude.iter().map(|k| k.time_s), window_s),
            ),
            false => heading_s,
        };
        let heave_s = newest(
            self.vertical_channel().unwrap_or(NavChannel::Heave),
            invalid.vertical,
            behind(&trajectory.heave),
        );
        NavState {
            utc,
            pose,
            roll_rad,
            pitch_rad,
            heading_rad,
            heave_down_m: if self.uses_heave() { heave.z } else { 0.0 },
            latitude_rad,
            longitude_rad,
            height_m: -pose.position_m.z,
            fix: self
                .ring(NavChannel::Position)
                .last_at_or_before(utc)
                .map_or(FixQuality::None, |k| k.fix),
            position_age_s: -position_s,
            attitude_age_s: -attitude_s,
            invalid,
            time_jumped: self.time_jumped(utc, utc.plus_s(-LOOKBACK_S), utc.plus_s(window_s)),
            extrapolated: position_s.min(attitude_s).min(heading_s).min(heave_s) < window_s,
        }
    }
}

/// Rotation at a time. If a knot has this time, the result is exactly its rotation, independent of later knots. Otherwise the
/// rotation is interpolated.
fn rotation_at(knots: &[AttitudeKnot], time_s: f64) -> DQuat {
    let at = knots.partition_point(|knot| knot.time_s < time_s);
    match knots.get(at).filter(|knot| knot.time_s == time_s) {
        Some(knot) => knot.world_from_body,
        None => attitude_at(knots, time_s).0,
    }
}

/// Time of the newest knot that affects the motion up to `window_s`, seconds: the second knot at or after it, or the last knot.
/// Infinite without knots.
fn newest_used(times_s: impl Iterator<Item = f64>, window_s: f64) -> f64 {
    let mut newest_s = f64::INFINITY;
    let mut behind = 0;
    for time_s in times_s {
        newest_s = time_s;
        behind += usize::from(time_s >= window_s);
        if behind == 2 {
            break;
        }
    }
    newest_s
}

/// Policy for a window that extends beyond the last measurement.
#[derive(Clone, Copy)]
enum ExtrapolationPolicy {
    /// The window is refused if it ends more than `after_s` seconds after the last measurement.
    Refused { after_s: f64 },
    /// Motion is extrapolated for `after_s` seconds and then comes to rest.
    Held { after_s: f64 },
}

/// Orientation of motion sensor and compass in the body.
struct Mounting {
    /// True if both sensors are aligned with the body.
    aligned: bool,
    /// True if one sensor gives roll, pitch and heading.
    same_sensor: bool,
    sensor_from_body: DQuat,
    compass_rad: f64,
}

impl Mounting {
    /// Attitude of the body from the angles of the sensors.
    fn body(&self, roll_rad: f64, pitch_rad: f64, heading_rad: f64) -> DQuat {
        if self.aligned {
            return rotation_from_angles(roll_rad, pitch_rad, heading_rad);
        }
        if self.same_sensor {
            return rotation_from_angles(roll_rad, pitch_rad, heading_rad) * self.sensor_from_body;
        }
        let tilt = rotation_from_angles(roll_rad, pitch_rad, 0.0) * self.sensor_from_body;
        let (roll_rad, pitch_rad, _) = angles_from_rotation(tilt);
        rotation_from_angles(roll_rad, pitch_rad, heading_rad - self.compass_rad)
    }
}

/// Horizontal offset from a towed body to the antenna of the ship, north and east, metres. Body and ship have the same heading.
fn ship_offset_m(tow: &TowSpec, antenna_m: DVec3, world_from_body: DQuat, down_m: f64) -> DVec3 {
    let (_, _, heading_rad) = angles_from_rotation(world_from_body);
    let cable_m = tow.cable_out_m * tow.cable_scope;
    let depth_m = down_m - tow.point_m.z;
    let layback_m = (cable_m * cable_m - depth_m * depth_m).max(0.0).sqrt();
    let ahead_m = antenna_m.x - tow.point_m.x + layback_m;
    let starboard_m = antenna_m.y - tow.point_m.y;
    DQuat::from_rotation_z(heading_rad) * DVec3::new(ahead_m, starboard_m, 0.0)
}

/// Appends two knots: uniform motion for `after_s` seconds, then uniform deceleration to rest over the same time.
fn rest(knots: &mut Vec<VectorKnot>, after_s: f64) {
    let Some(last) = knots.last().copied() else {
        return;
    };
    let way = last.rate_per_s * after_s;
    knots.push(VectorKnot {
        time_s: last.time_s + after_s,
        value: last.value + way,
        rate_per_s: last.rate_per_s,
    });
    knots.push(VectorKnot {
        time_s: last.time_s + 2.0 * after_s,
        value: last.value + way * 1.5,
        rate_per_s: DVec3::ZERO,
    });
}

/// Time window of one ping.
#[derive(Clone, Copy)]
struct Window {
    /// Start of the transmitted pulse.
    zero: UtcNs,
    from: UtcNs,
    end: UtcNs,
    beyond: ExtrapolationPolicy,
}

impl Window {
    fn include(&mut self, utc: UtcNs) {
        self.from = self.from.min(utc);
        self.end = self.end.max(utc);
    }
    fn widen(&mut self, knots: &[VectorKnot]) {
        for knot in [knots.first(), knots.last()].into_iter().flatten() {
            self.include(self.zero.plus_s(knot.time_s));
        }
    }
}

fn check_speed(position: &[VectorKnot]) -> Result<(), NavGap> {
    for pair in position.windows(2) {
        let step_m = DVec2::new(
            pair[1].value.x - pair[0].value.x,
            pair[1].value.y - pair[0].value.y,
        );
        let speed_m_per_s = step_m.length() / (pair[1].time_s - pair[0].time_s);
        if speed_m_per_s > MAX_SPEED_M_PER_S {
            return Err(NavGap::TooFast { speed_m_per_s });
        }
    }
    Ok(())
}

/// Replaces each value by the direction of its rate in `value.x`, radians. A knot at rest keeps the direction of the previous knot.
fn courses_from_rates(knots: &mut [VectorKnot]) {
    let moving = |k: &VectorKnot| {
        let v = k.rate_per_s;
        (v.x.hypot(v.y) >= MIN_COURSE_SPEED_M_PER_S).then(|| v.y.atan2(v.x))
    };
    let mut course = knots.iter().find_map(moving).unwrap_or(0.0);
    for knot in knots {
        course = moving(knot).unwrap_or(course);
        knot.value = DVec3::new(course, 0.0, 0.0);
    }
}

/// Adds whole turns so that consecutive angles in `value.x` differ by at most half a turn.
fn unwrap(knots: &mut [VectorKnot]) {
    use std::f64::consts::TAU;
    for i in 1..knots.len() {
        let step = knots[i].value.x - knots[i - 1].value.x;
        knots[i].value.x -= TAU * (step / TAU).round();
    }
}
