//! Samples to motion: per-channel rings, and the platform's state and trajectory at a ping.
//!
//! - The first source of the file that provides a channel owns it; nobody else's samples are taken.
//! - Positions are reduced from the antenna to the body's reference point each at its own time: between two fixes the antenna sways with the
//!   roll, the reference point does not. So [`Trajectory::lever_arm_m`] leaves here as zero.
//! - Attitude knots lie at the roll-pitch samples; heading is interpolated there the short way round. Without roll and pitch they lie at the
//!   heading samples.
//! - A loop seam is a gap: nothing is interpolated across it.
//! - Not modelled: smoothing, fail-over, outliers other than speed.

use glam::{DQuat, DVec2, DVec3};

use super::geodesy::LocalTangentPlane;
use super::ring::{Inserted, Knot, Ring, Stretch, set_body_rates, set_rates};
use crate::config::spec::{NavChannel, NavInputSpec, NavMode, NavSpec, OriginSpec, VerticalSpec};
use crate::flow::{FixQuality, NavQuantity, NavSample, NavState};
use crate::frames::{
    AttitudeKnot, Trajectory, VectorKnot, angles_from_rotation, attitude_at, hermite,
    rotation_from_angles,
};
use crate::time::{NS_PER_S, UtcNs};

/// Knots are handed over from this long before the pulse, seconds, so that slopes at its start are those of a known track.
const LOOKBACK_S: f64 = 1.0;
/// Two samples of a sensor farther apart than this are not joined by a curve, seconds: swell turns round within it. Tracks in a file may be
/// as sparse as their author likes.
const LONGEST_HOLE_S: f64 = 5.0;
/// A tenth of the speed of sound in water, metres per second: beyond it the echo model does not hold, and no platform goes there.
const MAX_SPEED_M_PER_S: f64 = 150.0;
/// Below this speed, metres per second, course is noise: the last one is kept.
const MIN_COURSE_SPEED_M_PER_S: f64 = 0.2;
/// Seams remembered; a loop shorter than a sixteenth of the history forgets its oldest.
const MAX_SEAMS: usize = 16;

/// Why there is no state at a time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum NavGap {
    /// Nothing of this channel at or before the ping.
    NoData(NavChannel),
    /// The newest sample is older than may be extrapolated, measured from the window's end.
    Stale { channel: NavChannel, age_s: f64 },
    /// Two neighbouring samples are too far apart.
    Hole { channel: NavChannel, gap_s: f64 },
    /// The ping's window lies across the seam of a repeated log.
    Seam,
    /// Two positions imply this speed.
    TooFast { speed_m_per_s: f64 },
}

/// Whether a window can be settled.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Coverage {
    /// More samples will not change the state.
    Ready,
    Waiting,
    /// This channel has nothing at or before the window's start, and waiting will not bring it.
    Missing(NavChannel),
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct HistoryCounts {
    pub inserted: u64,
    /// Of those: valid before a sample already there.
    pub out_of_order: u64,
    /// Of those: valid before the last ping asked for.
    pub late: u64,
    /// Dropped: the channel has a sample of this time.
    pub duplicates: u64,
    /// Dropped: another source owns the channel.
    pub not_owned: u64,
    /// Dropped: a position without the height that `nav.vertical` needs.
    pub no_vertical: u64,
    /// States refused.
    pub no_data: u64,
    pub stale: u64,
    pub holes: u64,
    pub seams: u64,
    pub too_fast: u64,
}

/// Where heading comes from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum HeadingFrom {
    Sensor,
    Course,
    Track,
    Nowhere,
}

#[derive(Clone, Copy, Debug)]
struct Owner {
    source: u16,
    /// A track in a file: its points are joined however far apart.
    sparse: bool,
}

pub struct NavHistory {
    vertical: VerticalSpec,
    heading_from: HeadingFrom,
    max_extrapolation_s: f64,
    depth_ns: i64,
    lever_arm_m: DVec3,
    owners: [Option<Owner>; 5],
    rings: [Ring; 5],
    plane: Option<LocalTangentPlane>,
    first_fix_m: Option<DVec3>,
    seams: Vec<UtcNs>,
    last_ping: UtcNs,
    counts: HistoryCounts,
    /// Scratch: heading in `value.x`, unwrapped.
    heading: Vec<VectorKnot>,
}

impl NavHistory {
    pub fn new(spec: &NavSpec) -> Self {
        let owners = ALL_CHANNELS.map(|channel| {
            let i = spec
                .sources
                .iter()
                .position(|s| s.provides.contains(&channel))?;
            Some(Owner {
                source: u16::try_from(i).ok()?,
                sparse: matches!(spec.sources[i].input, NavInputSpec::Csv { .. }),
            })
        });
        let owns = |channel: NavChannel| owners[index(channel)].is_some();
        let heading_from = if owns(NavChannel::Heading) {
            HeadingFrom::Sensor
        } else if !spec.fallback_heading_from_course {
            HeadingFrom::Nowhere
        } else if owns(NavChannel::CourseSpeed) {
            HeadingFrom::Course
        } else {
            HeadingFrom::Track
        };
        let antenna = owners[index(NavChannel::Position)].map(|o| usize::from(o.source));
        Self {
            vertical: spec.vertical,
            heading_from,
            max_extrapolation_s: spec.max_extrapolation_s,
            depth_ns: (spec.history_s * NS_PER_S as f64) as i64,
            lever_arm_m: antenna.map_or(DVec3::ZERO, |i| spec.sources[i].lever_arm_m),
            owners,
            rings: Default::default(),
            plane: match spec.origin {
                OriginSpec::Geodetic {
                    latitude_rad,
                    longitude_rad,
                } => Some(LocalTangentPlane::new(latitude_rad, longitude_rad)),
                OriginSpec::FirstFix => None,
            },
            first_fix_m: None,
            seams: Vec::new(),
            last_ping: UtcNs(i64::MIN),
            counts: HistoryCounts::default(),
            heading: Vec::new(),
        }
    }

    /// The world's plane: configured, or set by the first position (a local track alone lies at latitude 0, longitude 0).
    pub fn origin(&self) -> Option<LocalTangentPlane> {
        self.plane
    }

    /// The first position taken, antenna, world metres.
    pub fn first_fix_local(&self) -> Option<DVec3> {
        self.first_fix_m
    }

    pub fn counts(&self) -> &HistoryCounts {
        &self.counts
    }

    /// From here on samples belong to another run of a repeated log.
    pub fn seam(&mut self, at: UtcNs) {
        if self.seams.len() == MAX_SEAMS {
            self.seams.remove(0);
        }
        self.seams.push(at);
    }

    pub fn insert(&mut self, sample: &NavSample) {
        let channel = channel_of(&sample.quantity);
        if self.owners[index(channel)].is_none_or(|o| o.source != sample.source) {
            self.counts.not_owned += 1;
            return;
        }
        let (value, fix) = match sample.quantity {
            NavQuantity::Position {
                latitude_rad,
                longitude_rad,
                height_m,
                fix,
            } => {
                let Some(down_m) = self.down_m(height_m, None) else {
                    self.counts.no_vertical += 1;
                    return;
                };
                let plane = self
                    .plane
                    .get_or_insert_with(|| LocalTangentPlane::new(latitude_rad, longitude_rad));
                let (north_m, east_m) = plane.local_m(latitude_rad, longitude_rad);
                (DVec3::new(north_m, east_m, down_m), fix)
            }
            NavQuantity::LocalPosition {
                north_m,
                east_m,
                down_m,
            } => {
                let Some(down_m) = self.down_m(None, Some(down_m)) else {
                    self.counts.no_vertical += 1;
                    return;
                };
                self.plane
                    .get_or_insert_with(|| LocalTangentPlane::new(0.0, 0.0));
                (DVec3::new(north_m, east_m, down_m), FixQuality::Autonomous)
            }
            NavQuantity::CourseSpeed {
                course_rad,
                speed_m_per_s,
            } => (
                DVec3::new(self.steady_course(course_rad, speed_m_per_s), 0.0, 0.0),
                FixQuality::None,
            ),
            NavQuantity::Heading { heading_rad } => {
                (DVec3::new(heading_rad, 0.0, 0.0), FixQuality::None)
            }
            NavQuantity::RollPitch {
                roll_rad,
                pitch_rad,
            } => (DVec3::new(roll_rad, pitch_rad, 0.0), FixQuality::None),
            NavQuantity::Heave { heave_down_m } => {
                (DVec3::new(0.0, 0.0, heave_down_m), FixQuality::None)
            }
        };
        if channel == NavChannel::Position {
            self.first_fix_m.get_or_insert(value);
        }
        let knot = Knot {
            utc: sample.valid_utc,
            value,
            fix,
        };
        match self.rings[index(channel)].insert(knot, self.depth_ns) {
            Inserted::Duplicate => {
                self.counts.duplicates += 1;
                return;
            }
            Inserted::OutOfOrder => self.counts.out_of_order += 1,
            Inserted::AtTheEnd => {}
        }
        self.counts.inserted += 1;
        self.counts.late += u64::from(sample.valid_utc < self.last_ping);
    }

    /// World down of a position sample (of the antenna, unless the waterline rules); none if the sample does not say.
    fn down_m(&self, height_m: Option<f64>, local_down_m: Option<f64>) -> Option<f64> {
        match self.vertical {
            VerticalSpec::Waterline { reference_down_m } => Some(reference_down_m),
            VerticalSpec::Gnss { datum_offset_m } => height_m
                .map(|h| -h)
                .or(local_down_m)
                .map(|down| down + datum_offset_m),
            VerticalSpec::Depth => local_down_m,
        }
    }

    fn steady_course(&self, course_rad: f64, speed_m_per_s: f64) -> f64 {
        match self.rings[index(NavChannel::CourseSpeed)].last() {
            Some(before) if speed_m_per_s < MIN_COURSE_SPEED_M_PER_S => before.value.x,
            _ => course_rad,
        }
    }

    fn ring(&self, channel: NavChannel) -> &Ring {
        &self.rings[index(channel)]
    }

    fn owns(&self, channel: NavChannel) -> bool {
        self.owners[index(channel)].is_some()
    }

    fn uses_heave(&self) -> bool {
        self.owns(NavChannel::Heave) && matches!(self.vertical, VerticalSpec::Waterline { .. })
    }

    fn has_arm(&self) -> bool {
        self.lever_arm_m != DVec3::ZERO
    }

    /// The channel heading is made of, and how many knots past a time it takes to settle it there.
    fn heading_channel(&self) -> (NavChannel, usize) {
        match self.heading_from {
            HeadingFrom::Sensor | HeadingFrom::Nowhere => (NavChannel::Heading, 2),
            HeadingFrom::Course => (NavChannel::CourseSpeed, 2),
            // A course knot is a slope, which takes one neighbour more.
            HeadingFrom::Track => (NavChannel::Position, 3),
        }
    }

    /// Whether everything that shapes the motion over `from..=to` is there. A knot's slope needs the knot after it, so each channel needs two
    /// knots at or after its end; and the channels lean on one another: positions on attitude (lever arm), attitude on heading.
    pub fn coverage(&self, from: UtcNs, to: UtcNs) -> Coverage {
        let mut waiting = false;
        let mut missing = None;
        // Time of the `ahead`-th knot at or after `to`.
        let mut reach = |channel: NavChannel, to: UtcNs, ahead: usize| -> UtcNs {
            let ring = self.ring(channel);
            if ring.oldest().is_some_and(|oldest| oldest > from) {
                missing = missing.or(Some(channel));
            }
            let reach = ring.nth_at_or_after(to, ahead);
            waiting |= reach.is_none();
            reach.unwrap_or(to)
        };
        let position_to = reach(NavChannel::Position, to, 2);
        if self.uses_heave() {
            reach(NavChannel::Heave, to, 2);
        }
        // What the next channel must reach, and whose knots ask for it; none: the window itself.
        let (mut needed_to, mut asking) = match self.has_arm() {
            true => (position_to, Some(NavChannel::Position)),
            false => (to, None),
        };
        if self.owns(NavChannel::RollPitch) {
            let ahead = self.knots_ahead(NavChannel::RollPitch, 2, asking, needed_to);
            needed_to = reach(NavChannel::RollPitch, needed_to, ahead);
            asking = Some(NavChannel::RollPitch);
        }
        let (heading, ahead) = self.heading_channel();
        let ahead = self.knots_ahead(heading, ahead, asking, needed_to);
        reach(heading, needed_to, ahead);
        match (missing, waiting) {
            (Some(channel), _) => Coverage::Missing(channel),
            (None, true) => Coverage::Waiting,
            (None, false) => Coverage::Ready,
        }
    }

    /// One knot less is enough where `channel` has a knot at the very time it is asked for and is asked for nothing between its last two
    /// knots: there no slope matters. So it is when one sentence gives both.
    fn knots_ahead(
        &self,
        channel: NavChannel,
        ahead: usize,
        asking: Option<NavChannel>,
        to: UtcNs,
    ) -> usize {
        let Some(asking) = asking.map(|a| self.ring(a)) else {
            return ahead;
        };
        let just_before = to.plus_ns(-1);
        let before = |ring: &Ring| ring.last_at_or_before(just_before).map(|k| k.utc);
        let ring = self.ring(channel);
        let meets = ring.nth_at_or_after(to, 1) == Some(to) && before(ring) >= before(asking);
        if meets { ahead - 1 } else { ahead }
    }

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

        for knot in position.iter_mut().filter(|_| self.has_arm()) {
            let arm = rotation_at(&trajectory.attitude, knot.time_s) * self.lever_arm_m;
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

const ALL_CHANNELS: [NavChannel; 5] = [
    NavChannel::Position,
    NavChannel::CourseSpeed,
    NavChannel::Heading,
    NavChannel::RollPitch,
    NavChannel::Heave,
];

fn index(channel: NavChannel) -> usize {
    channel as usize
}

fn channel_of(quantity: &NavQuantity) -> NavChannel {
    match quantity {
        NavQuantity::Position { .. } | NavQuantity::LocalPosition { .. } => NavChannel::Position,
        NavQuantity::CourseSpeed { .. } => NavChannel::CourseSpeed,
        NavQuantity::Heading { .. } => NavChannel::Heading,
        NavQuantity::RollPitch { .. } => NavChannel::RollPitch,
        NavQuantity::Heave { .. } => NavChannel::Heave,
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
