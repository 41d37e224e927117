//! From the rings to one ping's trajectory and state.

use glam::{DQuat, DVec2, DVec3};

use super::{HeadingFrom, MIN_COURSE_SPEED_M_PER_S, NavGap, NavHistory, index};
use crate::ring::{Knot, Stretch, set_body_rates, set_rates};
use echotank_config::spec::{NavChannel, NavMode, OnLost, TowSpec, VerticalSpec};
use echotank_core::flow::{FixQuality, NavInvalid, NavState};
use echotank_core::frames::{
    AttitudeKnot, Trajectory, VectorKnot, angles_from_rotation, attitude_at, hermite,
    rotation_from_angles,
};
use echotank_core::time::UtcNs;

/// Knots are handed over from this long before the pulse, seconds, so that slopes at its start are those of a known track.
const LOOKBACK_S: f64 = 1.0;
/// Two samples of a sensor farther apart than this are not joined by a curve, seconds: swell turns round within it. Tracks in a file may be
/// as sparse as their author likes.
const LONGEST_HOLE_S: f64 = 5.0;
/// No seam before, and none after.
const EVER: UtcNs = UtcNs(i64::MIN);
const NEVER: UtcNs = UtcNs(i64::MAX);
/// What is held comes to rest in no less than this, seconds, so that knots have different times.
const SHORTEST_REST_S: f64 = 1e-3;
/// A tenth of the speed of sound in water, metres per second: beyond it the echo model does not hold, and no platform goes there.
const MAX_SPEED_M_PER_S: f64 = 150.0;

impl NavHistory {
    /// State at `transmit_utc` and the motion from a second before it to `window_s` after it, times counted from it. `trajectory`'s buffers
    /// are reused. In `settle` nothing is extrapolated; in `predict` at most `max_extrapolation_s` up to the window's end, and with
    /// `on_lost = "hold"` what is older than that comes to rest, invalid.
    pub fn motion(
        &mut self,
        transmit_utc: UtcNs,
        window_s: f64,
        mode: NavMode,
        trajectory: &mut Trajectory,
    ) -> Result<NavState, NavGap> {
        self.last_ping = self.last_ping.max(transmit_utc);
        let beyond = match (mode, self.on_lost) {
            (NavMode::Settle, _) => Beyond::Refused { after_s: 0.0 },
            (NavMode::Predict, OnLost::Skip) => Beyond::Refused {
                after_s: self.max_extrapolation_s,
            },
            (NavMode::Predict, OnLost::Hold) => Beyond::Held {
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

    /// What is known now of the motion around `utc`, for whoever wants to be told between pings: carried on for `max_extrapolation_s`, then
    /// held and invalid. Counts nothing.
    pub fn outlook(&mut self, utc: UtcNs, trajectory: &mut Trajectory) -> Result<NavState, NavGap> {
        let beyond = Beyond::Held {
            after_s: self.max_extrapolation_s,
        };
        let invalid = self.fill_trajectory(utc, 0.0, beyond, trajectory)?;
        Ok(self.state(utc, 0.0, invalid, trajectory))
    }

    /// How old the newest heading (or what it is made of) is at `utc`, seconds; infinite where there is none.
    pub fn heading_age_s(&self, utc: UtcNs) -> f64 {
        let newest = self.ring(self.heading_channel().0).newest();
        newest.map_or(f64::INFINITY, |newest| utc.seconds_since(newest))
    }

    /// How long a value may be carried on beyond its last measurement, seconds.
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
        beyond: Beyond,
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

        // Knots lie in one stretch: one source said them all.
        let said = |knots: &[VectorKnot]| knots.last().map_or(zero, |k| zero.plus_s(k.time_s));
        if let Some(channel) = vertical.filter(|_| self.vertical_has_arm()) {
            let place = self.place_at(channel, said(&trajectory.heave));
            let arm_m = place.map_or(DVec3::ZERO, |p| p.vertical_arm_m(channel));
            // A heave sensor shows nothing at rest, a depth sensor its own depth.
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
            let place = self.place_at(NavChannel::Position, said(&trajectory.position));
            let arm_m = place.map_or(DVec3::ZERO, |p| p.arm_m);
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
                        behind(tow, arm_m, rotation, knot.value.z + heave.z)
                    }
                };
                knot.value -= DVec3::new(arm.x, arm.y, if level { 0.0 } else { arm.z });
            }
        }
        set_rates(&mut trajectory.position);
        trajectory.lever_arm_m = DVec3::ZERO;
        Ok(self.come_to_rest(&window, trajectory))
    }

    /// How long a channel is carried on before it rests, if it does so in this window: seconds.
    fn resting(&self, channel: NavChannel, w: &Window) -> Option<f64> {
        let Beyond::Held { after_s } = w.beyond else {
            return None;
        };
        let newest = self.newest_of(channel, self.stretch(channel, w).ok()?)?;
        let old = w.end.seconds_since(newest.utc) > after_s;
        old.then_some(after_s.max(SHORTEST_REST_S))
    }

    /// What is too old at the window's end stops there, and is invalid. The attitude has been seen to.
    fn come_to_rest(&self, w: &Window, trajectory: &mut Trajectory) -> NavInvalid {
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

    /// The stretch of a channel between seams that holds the ping's window. Where pings go on in silence: the last one that has begun.
    fn stretch(&self, channel: NavChannel, w: &Window) -> Result<Stretch, NavGap> {
        let own = |(at, of): &(UtcNs, Option<usize>)| {
            of.is_none_or(|of| of == index(channel)).then_some(*at)
        };
        let seams = || self.seams.iter().filter_map(own);
        let mut end = seams().filter(|s| *s > w.zero).min().unwrap_or(NEVER);
        let mut start = seams().filter(|s| *s <= w.zero).max().unwrap_or(EVER);
        if matches!(w.beyond, Beyond::Refused { .. }) {
            return match end <= w.end {
                true => Err(NavGap::Seam),
                false => Ok(Stretch { start, end }),
            };
        }
        let begun = |start: UtcNs| {
            let newest = self.ring(channel).last_at_or_before(w.zero);
            newest.is_some_and(|k| k.utc >= start)
        };
        while start != EVER && !begun(start) {
            end = start;
            start = seams().filter(|s| *s < start).max().unwrap_or(EVER);
        }
        Ok(Stretch { start, end })
    }

    /// The newest knot of a stretch.
    fn newest_of(&self, channel: NavChannel, stretch: Stretch) -> Option<&Knot> {
        let ring = self.ring(channel);
        ring.iter(ring.within(stretch)).next_back()
    }

    /// Refuses a channel that does not carry the window.
    fn check(&self, channel: NavChannel, w: &Window) -> Result<(), NavGap> {
        let stretch = self.stretch(channel, w)?;
        let ring = self.ring(channel);
        let range = ring.within(stretch);
        let nothing = if stretch.start == EVER {
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
            Beyond::Refused { .. } if age_s > 0.0 && stretch.end != NEVER => {
                return Err(NavGap::Seam);
            }
            Beyond::Refused { after_s } if age_s > after_s => {
                return Err(NavGap::Stale { channel, age_s });
            }
            _ => {}
        }
        if self.owners[index(channel)].is_some_and(|o| o.sparse) {
            return Ok(());
        }
        let mut before = None;
        for knot in ring.iter(ring.around(w.zero, w.end, 1, stretch)) {
            let gap_s = before.map_or(0.0, |b| knot.utc.seconds_since(b));
            if gap_s > LONGEST_HOLE_S && knot.utc > w.zero {
                return Err(NavGap::Hole { channel, gap_s });
            }
            before = Some(knot.utc);
        }
        Ok(())
    }

    /// Values of a channel around the window, rates not yet set.
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

    /// Attitude over `wide`; only `needed` must be carried.
    fn attitude_knots_with(
        &self,
        needed: &Window,
        wide: &Window,
        heading: &mut Vec<VectorKnot>,
        out: &mut Vec<AttitudeKnot>,
    ) -> Result<(), NavGap> {
        out.clear();
        let mounted = self.mounted(wide.zero);
        let knot = |time_s: f64, roll: f64, pitch: f64, heading: f64| AttitudeKnot {
            time_s,
            world_from_body: mounted.body(roll, pitch, heading),
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
                // Roll and pitch stay as they were last known; the heading goes on.
                let last_s = last.utc.seconds_since(wide.zero);
                let mut rested_s = last_s + 2.0 * after_s;
                let mut stay = |time_s: f64| {
                    let (angle, _) = hermite(heading, time_s);
                    out.push(knot(time_s, last.value.x, last.value.y, angle.x));
                };
                stay(last_s + after_s);
                stay(rested_s);
                for k in heading.iter() {
                    if k.time_s > rested_s {
                        stay(k.time_s);
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

    /// Heading over `wide`, unwrapped, with rates. Only `needed` must be carried.
    fn heading_knots(
        &self,
        needed: &Window,
        wide: &Window,
        out: &mut Vec<VectorKnot>,
    ) -> Result<(), NavGap> {
        let (channel, ahead) = self.heading_channel();
        if self.heading_from == HeadingFrom::Nowhere {
            return Err(NavGap::NoData(channel));
        }
        self.check(channel, needed)?;
        let ring = self.ring(channel);
        let stretch = self.stretch(channel, needed)?;
        let range = ring.around(wide.from, wide.end, ahead, stretch);
        ring.fill(range, wide.zero, out);
        if self.heading_from == HeadingFrom::Track {
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

    /// How the sensors of this time are mounted.
    fn mounted(&self, utc: UtcNs) -> Mounted {
        let angles = |channel| {
            let place = self.place_at(channel, utc);
            place.map_or(DVec3::ZERO, |p| p.sensor.angles_rad)
        };
        let (heading, _) = self.heading_channel();
        let compass_rad = match self.heading_from {
            HeadingFrom::Sensor => angles(heading).z,
            // A course has no mounting.
            _ => 0.0,
        };
        let motion = match self.owns(NavChannel::RollPitch) {
            true => angles(NavChannel::RollPitch),
            false => DVec3::ZERO,
        };
        Mounted {
            plain: motion == DVec3::ZERO && compass_rad == 0.0,
            one: self.heading_from == HeadingFrom::Sensor
                && self.owns(NavChannel::RollPitch)
                && self.spoke_at(heading, utc) == self.spoke_at(NavChannel::RollPitch, utc),
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
        // Knots that bring something to rest are no measurements.
        let newest = |channel: NavChannel, old: bool, knots: f64| match self.ring(channel).newest()
        {
            Some(newest) if old => newest.seconds_since(utc),
            _ => knots,
        };
        let behind = |knots: &[VectorKnot]| newest_behind(knots.iter().map(|k| k.time_s), window_s);
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
                newest_behind(trajectory.attitude.iter().map(|k| k.time_s), window_s),
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
            extrapolated: position_s.min(attitude_s).min(heading_s).min(heave_s) < window_s,
        }
    }
}

/// A knot's own rotation at its time, to the bit, whether or not more knots follow; the curve between.
fn rotation_at(knots: &[AttitudeKnot], time_s: f64) -> DQuat {
    match knots.iter().find(|k| k.time_s == time_s) {
        Some(knot) => knot.world_from_body,
        None => attitude_at(knots, time_s).0,
    }
}

/// Time of the newest knot that shapes the motion up to `window_s`: the second at or after it, or the last. Infinite without knots.
fn newest_behind(times_s: impl Iterator<Item = f64>, window_s: f64) -> f64 {
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

/// What becomes of a window that begins or ends beyond the last measurement.
#[derive(Clone, Copy)]
enum Beyond {
    /// It is refused when it ends later than this.
    Refused { after_s: f64 },
    /// Motion is carried on for so long, and then comes to rest.
    Held { after_s: f64 },
}

/// How motion sensor and compass sit in the body.
struct Mounted {
    /// Along its axes.
    plain: bool,
    /// One instrument gives roll, pitch and heading.
    one: bool,
    sensor_from_body: DQuat,
    compass_rad: f64,
}

impl Mounted {
    /// The body's attitude from what the instruments say.
    fn body(&self, roll_rad: f64, pitch_rad: f64, heading_rad: f64) -> DQuat {
        if self.plain {
            return rotation_from_angles(roll_rad, pitch_rad, heading_rad);
        }
        if self.one {
            return rotation_from_angles(roll_rad, pitch_rad, heading_rad) * self.sensor_from_body;
        }
        let tilt = rotation_from_angles(roll_rad, pitch_rad, 0.0) * self.sensor_from_body;
        let (roll_rad, pitch_rad, _) = angles_from_rotation(tilt);
        rotation_from_angles(roll_rad, pitch_rad, heading_rad - self.compass_rad)
    }
}

/// From a towed body to the ship's antenna, north and east: both on the body's heading.
fn behind(tow: &TowSpec, antenna_m: DVec3, world_from_body: DQuat, down_m: f64) -> DVec3 {
    let (_, _, heading_rad) = angles_from_rotation(world_from_body);
    let straight_m = tow.cable_out_m * tow.cable_scope;
    let under_m = down_m - tow.point_m.z;
    let layback_m = (straight_m * straight_m - under_m * under_m)
        .max(0.0)
        .sqrt();
    let ahead_m = antenna_m.x - tow.point_m.x + layback_m;
    let starboard_m = antenna_m.y - tow.point_m.y;
    DQuat::from_rotation_z(heading_rad) * DVec3::new(ahead_m, starboard_m, 0.0)
}

/// Two knots more: on with the last rate for `after_s`, then to rest in as long again.
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

/// What one ping asks of the rings.
#[derive(Clone, Copy)]
struct Window {
    /// Start of the pulse.
    zero: UtcNs,
    from: UtcNs,
    end: UtcNs,
    beyond: Beyond,
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

/// Replaces the values by the direction of the rates in `value.x`; a knot at rest keeps the direction of the one before it.
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

/// Adds whole turns so that neighbouring angles in `value.x` differ by less than half a turn.
fn unwrap(knots: &mut [VectorKnot]) {
    use std::f64::consts::TAU;
    for i in 1..knots.len() {
        let step = knots[i].value.x - knots[i - 1].value.x;
        knots[i].value.x -= TAU * (step / TAU).round();
    }
}
