//! From the rings to one ping's trajectory and state.

use glam::{DQuat, DVec2, DVec3};

use super::{HeadingFrom, MIN_COURSE_SPEED_M_PER_S, NavGap, NavHistory, index};
use crate::config::spec::{NavChannel, NavMode, VerticalSpec};
use crate::flow::{FixQuality, NavState};
use crate::frames::{
    AttitudeKnot, Trajectory, VectorKnot, angles_from_rotation, attitude_at, hermite,
    rotation_from_angles,
};
use crate::nav::ring::{Stretch, set_body_rates, set_rates};
use crate::time::UtcNs;

/// Knots are handed over from this long before the pulse, seconds, so that slopes at its start are those of a known track.
const LOOKBACK_S: f64 = 1.0;
/// Two samples of a sensor farther apart than this are not joined by a curve, seconds: swell turns round within it. Tracks in a file may be
/// as sparse as their author likes.
const LONGEST_HOLE_S: f64 = 5.0;
/// A tenth of the speed of sound in water, metres per second: beyond it the echo model does not hold, and no platform goes there.
const MAX_SPEED_M_PER_S: f64 = 150.0;

impl NavHistory {
    /// State at `transmit_utc` and the motion from a second before it to `window_s` after it, times counted from it. `trajectory`'s buffers
    /// are reused. In `settle` nothing is extrapolated; in `predict` at most `max_extrapolation_s` up to the window's end.
    pub fn motion(
        &mut self,
        transmit_utc: UtcNs,
        window_s: f64,
        mode: NavMode,
        trajectory: &mut Trajectory,
    ) -> Result<NavState, NavGap> {
        self.last_ping = self.last_ping.max(transmit_utc);
        let result = self.fill_trajectory(transmit_utc, window_s, mode, trajectory);
        let counts = &mut self.counts;
        match result {
            Ok(()) => Ok(self.state(transmit_utc, window_s, trajectory)),
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

    fn fill_trajectory(
        &mut self,
        zero: UtcNs,
        window_s: f64,
        mode: NavMode,
        trajectory: &mut Trajectory,
    ) -> Result<(), NavGap> {
        let window = Window {
            zero,
            from: zero.plus_s(-LOOKBACK_S),
            end: zero.plus_s(window_s),
            stretch: self.stretch(zero, zero.plus_s(window_s))?,
            extrapolation_s: match mode {
                NavMode::Predict => self.max_extrapolation_s,
                NavMode::Settle => 0.0,
            },
        };
        let position = &mut trajectory.position;
        self.vector_knots(NavChannel::Position, &window, position)?;
        check_speed(position)?;

        let mut wide = window;
        if self.has_arm() {
            wide.widen(position);
        }
        self.attitude_knots(&window, &wide, &mut trajectory.attitude)?;

        let arm_m = self.arm_at(zero);
        for knot in position.iter_mut().filter(|_| self.has_arm()) {
            let arm = rotation_at(&trajectory.attitude, knot.time_s) * arm_m;
            let level = matches!(self.vertical, VerticalSpec::Waterline { .. });
            knot.value -= DVec3::new(arm.x, arm.y, if level { 0.0 } else { arm.z });
        }
        set_rates(position);
        trajectory.lever_arm_m = DVec3::ZERO;

        trajectory.heave.clear();
        if self.uses_heave() {
            self.vector_knots(NavChannel::Heave, &window, &mut trajectory.heave)?;
            set_rates(&mut trajectory.heave);
        }
        Ok(())
    }

    /// The stretch between seams that holds the ping's window.
    fn stretch(&self, transmit: UtcNs, end: UtcNs) -> Result<Stretch, NavGap> {
        let before = self.seams.iter().filter(|s| **s <= transmit).max();
        let after = self.seams.iter().filter(|s| **s > transmit).min();
        if after.is_some_and(|seam| *seam <= end) {
            return Err(NavGap::Seam);
        }
        Ok(Stretch {
            start: before.copied().unwrap_or(UtcNs(i64::MIN)),
            end: after.copied().unwrap_or(UtcNs(i64::MAX)),
        })
    }

    /// Refuses a channel that does not carry the window.
    fn check(&self, channel: NavChannel, w: &Window) -> Result<(), NavGap> {
        let ring = self.ring(channel);
        let range = ring.within(w.stretch);
        let nothing = if w.stretch.start == UtcNs(i64::MIN) {
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
        if age_s > 0.0 && w.stretch.end != UtcNs(i64::MAX) {
            return Err(NavGap::Seam);
        }
        if age_s > w.extrapolation_s {
            return Err(NavGap::Stale { channel, age_s });
        }
        if self.owners[index(channel)].is_some_and(|o| o.sparse) {
            return Ok(());
        }
        let mut before = None;
        for knot in ring.iter(ring.around(w.zero, w.end, 1, w.stretch)) {
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
        self.check(channel, w)?;
        let ring = self.ring(channel);
        ring.fill(ring.around(w.from, w.end, 2, w.stretch), w.zero, out);
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
        let knot = |time_s: f64, roll: f64, pitch: f64, heading: f64| AttitudeKnot {
            time_s,
            world_from_body: rotation_from_angles(roll, pitch, heading),
            body_rate_rad_per_s: DVec3::ZERO,
        };
        if self.owns(NavChannel::RollPitch) {
            self.check(NavChannel::RollPitch, needed)?;
            let ring = self.ring(NavChannel::RollPitch);
            let range = ring.around(wide.from, wide.end, 2, wide.stretch);
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
        let range = ring.around(wide.from, wide.end, ahead, wide.stretch);
        ring.fill(range, wide.zero, out);
        if self.heading_from == HeadingFrom::Track {
            set_rates(out);
            courses_from_rates(out);
        }
        unwrap(out);
        set_rates(out);
        Ok(())
    }

    fn state(&self, utc: UtcNs, window_s: f64, trajectory: &Trajectory) -> NavState {
        let pose = trajectory.pose_at(0.0);
        let (roll_rad, pitch_rad, heading_rad) = angles_from_rotation(pose.world_from_body);
        let (heave, _) = hermite(&trajectory.heave, 0.0);
        let (latitude_rad, longitude_rad) = self.plane.map_or((0.0, 0.0), |plane| {
            plane.geodetic_rad(pose.position_m.x, pose.position_m.y)
        });
        let position_s = newest_behind(trajectory.position.iter().map(|k| k.time_s), window_s);
        let attitude_s = newest_behind(trajectory.attitude.iter().map(|k| k.time_s), window_s);
        let heading_s = newest_behind(self.heading.iter().map(|k| k.time_s), window_s);
        let heave_s = newest_behind(trajectory.heave.iter().map(|k| k.time_s), window_s);
        NavState {
            utc,
            pose,
            roll_rad,
            pitch_rad,
            heading_rad,
            heave_down_m: heave.z,
            latitude_rad,
            longitude_rad,
            height_m: -pose.position_m.z,
            fix: self
                .ring(NavChannel::Position)
                .last_at_or_before(utc)
                .map_or(FixQuality::None, |k| k.fix),
            position_age_s: -position_s,
            attitude_age_s: -attitude_s,
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

/// What one ping asks of the rings.
#[derive(Clone, Copy)]
struct Window {
    /// Start of the pulse.
    zero: UtcNs,
    from: UtcNs,
    end: UtcNs,
    stretch: Stretch,
    /// How far past the newest knot `end` may lie, seconds.
    extrapolation_s: f64,
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
