//! History of the navigation samples: rings of knots per channel, and the state and trajectory of the platform at a ping.
//!
//! - The first configured source of a channel is active. With failover, the best source that is not silent is active (`arbiter`).
//!   Samples of other sources are dropped. A change of source is a seam.
//! - A source without configured channels may provide any channel. Such a channel counts, and pings need it, from its first sample
//!   on. `DETECTION_S` after the first sample the set of channels is final. Until then no instant is usable.
//! - With a jump gate, samples that imply impossible motion are rejected (`gate`).
//! - Positions, heaves and depths are reduced from the antenna or sensor to the reference point of the body, each at its own time.
//!   Roll moves the antenna between two fixes, but not the reference point. Therefore
//!   [`echotank_core::frames::Trajectory::lever_arm_m`] is zero in the output. A static list counts as induced heave, although no
//!   heave sensor measures it.
//! - Angles of a motion sensor are converted to the body by its mounting (`motion::Mounting`).
//! - A towed body is behind the ship, opposite to the heading, at the horizontal distance given by cable and depth.
//! - Attitude knots are at the times of the roll-pitch samples; the heading is interpolated along the shorter arc. Without roll and
//!   pitch, attitude knots are at the times of the heading samples.
//! - A seam is a gap without interpolation. A seam in all channels separates the loops of a log. A seam in one channel separates
//!   sources that replace one another, or positions on both sides of a jump.
//! - Smoothing is not modelled.

mod arbiter;
mod gate;
mod motion;

pub(crate) use self::motion::MAX_GAP_S;

use glam::DVec3;
use thiserror::Error;

use self::arbiter::{Arbiter, Verdict};
use self::gate::{Gate, GateResult};
use super::health::{Health, Limits, State};
use super::ring::{Inserted, Knot, Ring};
use echotank_config::spec::{
    FailoverSpec, JumpGateSpec, NavChannel, NavInputSpec, NavSourceSpec, NavSpec, OnLost,
    OriginSpec, SensorMounting, TowSpec, VerticalSpec,
};
use echotank_core::frames::VectorKnot;
use echotank_core::geodesy::LocalTangentPlane;
use echotank_core::navigation::{FixQuality, NavQuantity, NavSample};
use echotank_core::time::{NS_PER_S, UtcNs};

/// Below this speed, metres per second, the course is noise, and the previous course is kept.
const MIN_COURSE_SPEED_M_PER_S: f64 = 0.2;
/// Maximum lead of the time of validity over the arrival, seconds. A sample with a larger lead uses another clock and would remove
/// all older knots. A log replayed faster than recorded stays below the limit.
const FUTURE_S: f64 = 600.0;
/// Time after its first sample in which the channels of a source without configured channels are detected, seconds: two sentences
/// at 1 Hz.
const DETECTION_S: f64 = 2.0;
/// Maximum number of stored seams.
const MAX_SEAMS: usize = 16;
/// Maximum number of stored jumps of clocks.
const MAX_CLOCK_JUMPS: usize = 16;

/// Reason why no state exists at a time.
#[derive(Clone, Copy, Debug, PartialEq, Error)]
pub enum NavGap {
    /// A channel has no sample at or before the ping.
    #[error("no {0:?} at or before the ping")]
    NoData(NavChannel),
    /// The newest sample of a channel is too old.
    #[error("the newest {channel:?} is {age_s:.3} s old")]
    Stale {
        /// Quantity.
        channel: NavChannel,
        /// Age at the end of the window, seconds.
        age_s: f64,
    },
    /// Two samples of a channel are too far apart.
    #[error("{gap_s:.1} s between two samples of {channel:?}")]
    Hole {
        /// Quantity.
        channel: NavChannel,
        /// Time between the samples, seconds.
        gap_s: f64,
    },
    /// The window contains a seam.
    #[error("the window contains a seam (repeated log, change of source or jump)")]
    Seam,
    /// Two positions imply an impossible speed.
    #[error("two positions imply {speed_m_per_s:.0} m/s")]
    TooFast {
        /// Horizontal speed, metres per second.
        speed_m_per_s: f64,
    },
}

/// Whether the samples determine the motion over a window.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Coverage {
    /// More samples will not change the state.
    Ready,
    /// More samples are needed.
    Waiting,
    /// The channel has no sample at or before the start of the window. Later samples cannot change this.
    Missing(NavChannel),
}

/// Counters of inserted and dropped samples and of refused states.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct HistoryCounts {
    /// Samples inserted.
    pub inserted: u64,
    /// Inserted samples that precede an existing sample.
    pub out_of_order: u64,
    /// Inserted samples that precede the last ping.
    pub late: u64,
    /// Samples dropped because the channel already has a sample at this time.
    pub duplicates: u64,
    /// Samples dropped because their validity is later than their arrival: the source uses another clock.
    pub(crate) from_the_future: u64,
    /// Samples dropped because another source is active.
    pub not_owned: u64,
    /// Changes of the active source.
    pub switches: u64,
    /// Samples dropped by the jump gate.
    pub quarantined: u64,
    /// Jumps accepted by the jump gate because several samples agreed.
    pub resets: u64,
    /// Positions dropped because they lack the height that `nav.vertical` needs.
    pub no_vertical: u64,
    /// States refused because a channel has no sample.
    pub no_data: u64,
    /// States refused because the newest sample is too old.
    pub stale: u64,
    /// States refused because of a gap between samples.
    pub holes: u64,
    /// States refused because of a seam.
    pub seams: u64,
    /// States refused because of an impossible speed.
    pub too_fast: u64,
}

/// Origin of the heading.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum HeadingFrom {
    Sensor,
    Course,
    Track,
    None,
}

/// Arrivals of the first and the last sample of sources without configured channels.
#[derive(Clone, Copy, Debug, Default)]
struct Detection {
    first: Option<UtcNs>,
    last: Option<UtcNs>,
}

/// Interval in which the clock of a source is not reliable.
#[derive(Clone, Copy, Debug)]
struct ClockJump {
    source: u16,
    from: UtcNs,
    until: Option<UtcNs>,
}

/// Position and mounting of the sensors of a source in the body.
#[derive(Clone, Copy, Debug)]
struct Sensor {
    /// Position of the antenna or depth sensor in the body, metres.
    arm_m: DVec3,
    mounting: SensorMounting,
    /// True for a track file: its points are joined at any distance.
    sparse: bool,
    /// True if the configuration does not list the channels of the source.
    detect: bool,
}

/// Recent navigation of all sources, and the state and trajectory derived from it.
pub struct NavHistory {
    vertical: VerticalSpec,
    heading_from_course: bool,
    /// Detection of the channels of sources without configured channels; `None` if all sources have configured channels.
    detection: Option<Detection>,
    max_extrapolation_s: f64,
    depth_ns: i64,
    failover: Option<FailoverSpec>,
    jump_gate: Option<JumpGateSpec>,
    on_lost: OnLost,
    stale_s: f64,
    tow: Option<TowSpec>,
    /// Sensors by source index.
    sensors: Vec<Sensor>,
    /// For each channel, the active sources and the times from which each is active, ascending. Not empty if a source provides the
    /// channel.
    source_changes: [Vec<(UtcNs, u16)>; CHANNELS],
    arbiters: [Arbiter; CHANNELS],
    gates: [Gate; CHANNELS],
    /// For each channel, samples before this time are dropped, because another source was active.
    accepted_from: [UtcNs; CHANNELS],
    /// Health by source index.
    health: Vec<Health>,
    rings: [Ring; CHANNELS],
    plane: Option<LocalTangentPlane>,
    first_fix_m: Option<DVec3>,
    first_fix_utc: Option<UtcNs>,
    /// Time and channel of each seam. `None` means all channels.
    seams: Vec<(UtcNs, Option<usize>)>,
    clock_jumps: Vec<ClockJump>,
    last_ping: UtcNs,
    counts: HistoryCounts,
    /// Buffer for unwrapped headings in `value.x`, radians.
    heading: Vec<VectorKnot>,
}

impl NavHistory {
    /// Empty history with the settings of `spec`.
    pub fn new(spec: &NavSpec) -> Self {
        let arbiters = NavChannel::ALL.map(|channel| {
            let provides = |(_, s): &(usize, &NavSourceSpec)| s.provides.contains(&channel);
            let sources = spec.sources.iter().enumerate().filter(provides);
            Arbiter::new(sources.filter_map(|(i, s)| Some((u16::try_from(i).ok()?, s.detect))))
        });
        let sensor = |s: &NavSourceSpec| Sensor {
            arm_m: s.lever_arm_m,
            mounting: s.mounting,
            sparse: matches!(s.input, NavInputSpec::Csv { .. }),
            detect: s.detect,
        };
        let source_changes = NavChannel::ALL.map(|channel| {
            let first = arbiters[index(channel)].source();
            let mut source_changes = Vec::with_capacity(MAX_SEAMS + 2);
            source_changes.extend(first.map(|source| (UtcNs(i64::MIN), source)));
            source_changes
        });
        let limits = Limits {
            stale_s: spec.stale_s,
            lost_s: spec.lost_s,
        };
        Self {
            vertical: spec.vertical,
            heading_from_course: spec.heading_from_course == Some(true),
            detection: spec
                .sources
                .iter()
                .any(|s| s.detect)
                .then(Detection::default),
            max_extrapolation_s: spec.max_extrapolation_s,
            depth_ns: (spec.history_s * NS_PER_S as f64) as i64,
            failover: spec.failover,
            jump_gate: spec.jump_gate,
            on_lost: spec.on_lost,
            stale_s: spec.stale_s,
            tow: spec.tow,
            sensors: spec.sources.iter().map(sensor).collect(),
            source_changes,
            arbiters,
            gates: Default::default(),
            accepted_from: [UtcNs(i64::MIN); CHANNELS],
            health: vec![Health::new(limits); spec.sources.len()],
            rings: Default::default(),
            plane: match spec.origin {
                OriginSpec::Geodetic {
                    latitude_rad,
                    longitude_rad,
                } => Some(LocalTangentPlane::new(latitude_rad, longitude_rad)),
                OriginSpec::FirstFix => None,
            },
            first_fix_m: None,
            first_fix_utc: None,
            seams: Vec::new(),
            clock_jumps: Vec::new(),
            last_ping: UtcNs(i64::MIN),
            counts: HistoryCounts::default(),
            heading: Vec::new(),
        }
    }

    /// Local tangent plane of the world: configured, or set by the first position. A local track without a configured origin is
    /// placed at latitude 0, longitude 0.
    pub fn origin(&self) -> Option<LocalTangentPlane> {
        self.plane
    }

    /// First accepted position of the antenna, world metres.
    pub fn first_fix_local(&self) -> Option<DVec3> {
        self.first_fix_m
    }

    /// Time of the first accepted position.
    pub fn first_fix_utc(&self) -> Option<UtcNs> {
        self.first_fix_utc
    }

    /// First instant at which every channel that a ping needs has a sample. `None` while a channel has no sample or the detection
    /// of channels is not finished.
    pub fn first_usable_utc(&self) -> Option<UtcNs> {
        match self.is_detecting() {
            true => None,
            false => self.first_usable_utc_of(|_| true),
        }
    }

    /// Whether the detection of channels is not finished.
    pub fn is_detecting(&self) -> bool {
        let shown = |d: Detection| {
            d.last?
                .seconds_since(d.first?)
                .ge(&DETECTION_S)
                .then_some(())
        };
        self.detection.is_some_and(|d| shown(d).is_none())
    }

    /// Like [`Self::first_usable_utc`], but only for the needed channels for which `counts` is true. `None` if there is no such
    /// channel.
    pub fn first_usable_utc_of(&self, counts: impl Fn(NavChannel) -> bool) -> Option<UtcNs> {
        let mut first = None;
        for channel in self.needed().filter(|&channel| counts(channel)) {
            first = first.max(Some(self.ring(channel).oldest()?));
        }
        first
    }

    /// Channels that a ping needs and that have no sample so far.
    pub fn silent(&self) -> Vec<NavChannel> {
        self.needed()
            .filter(|&channel| self.ring(channel).oldest().is_none())
            .collect()
    }

    fn needed(&self) -> impl Iterator<Item = NavChannel> {
        let optional = [
            (NavChannel::RollPitch, self.owns(NavChannel::RollPitch)),
            (NavChannel::Heave, self.uses_heave()),
            (NavChannel::Depth, self.uses_depth()),
        ];
        let used = optional.into_iter().filter(|(_, used)| *used);
        [NavChannel::Position, self.heading_channel().0]
            .into_iter()
            .chain(used.map(|(channel, _)| channel))
    }

    /// Counters since the construction of the history.
    pub fn counts(&self) -> &HistoryCounts {
        &self.counts
    }

    /// State of the source with index `source` at `now`, from the arrivals of its samples.
    pub fn source_state(&mut self, source: usize, now: UtcNs) -> State {
        self.health
            .get_mut(source)
            .map_or(State::Silent, |h| h.at(now))
    }

    /// Active source of a channel. Before the first sample: the best source that is configured to provide the channel.
    pub fn active_source(&self, channel: NavChannel) -> Option<u16> {
        self.arbiters[index(channel)].source()
    }

    /// Whether a sample comes from the active source of the channel. A change of source starts a seam.
    fn is_from_active_source(&mut self, channel: usize, sample: &NavSample) -> bool {
        let verdict =
            self.arbiters[channel].receive(sample.source, sample.arrival_utc, self.failover);
        if verdict == Verdict::First {
            self.source_changes[channel].clear();
            self.source_changes[channel].push((UtcNs(i64::MIN), sample.source));
        }
        if verdict == Verdict::TakesOver {
            // The new source starts after the last sample of the previous source.
            let newest = self.rings[channel].newest();
            let from = newest.map_or(sample.valid_utc, |n| sample.valid_utc.max(n.plus_ns(1)));
            self.counts.switches += 1;
            self.accepted_from[channel] = from;
            self.gates[channel].forget();
            self.seam_in(Some(channel), from);
            let source_changes = &mut self.source_changes[channel];
            if source_changes.len() > MAX_SEAMS {
                source_changes.remove(0);
            }
            source_changes.push((from, sample.source));
        }
        verdict != Verdict::Inactive && sample.valid_utc >= self.accepted_from[channel]
    }

    /// Source that is active in a channel at this time.
    fn active_source_at(&self, channel: NavChannel, utc: UtcNs) -> Option<u16> {
        let source_changes = &self.source_changes[index(channel)];
        let since = source_changes.iter().rev().find(|(from, _)| *from <= utc);
        since.or(source_changes.first()).map(|(_, source)| *source)
    }

    /// Sensors of the source that is active in a channel at this time; `None` if no source provides the channel.
    fn sensor_at(&self, channel: NavChannel, utc: UtcNs) -> Option<&Sensor> {
        self.sensors
            .get(usize::from(self.active_source_at(channel, utc)?))
    }

    /// Starts a seam in every channel. Later samples belong to another loop of a repeated log.
    pub fn seam(&mut self, at: UtcNs) {
        self.seam_in(None, at);
    }

    /// Records that the clock of a source is reliable, or not reliable, from `at` on.
    pub fn clock_changed(&mut self, source: u16, at: UtcNs, is_right: bool) {
        let mut jumps = self.clock_jumps.iter_mut();
        let open = jumps.find(|j| j.source == source && j.until.is_none());
        match (open, is_right) {
            (Some(jump), true) => jump.until = Some(at),
            (None, false) => {
                if self.clock_jumps.len() == MAX_CLOCK_JUMPS {
                    self.clock_jumps.remove(0);
                }
                self.clock_jumps.push(ClockJump {
                    source,
                    from: at,
                    until: None,
                });
            }
            _ => {}
        }
    }

    /// Whether a source that is active at `zero` had an unreliable clock in `from..=to`.
    fn time_jumped(&self, zero: UtcNs, from: UtcNs, to: UtcNs) -> bool {
        let is_active = |source: u16| {
            let mut channels = NavChannel::ALL.into_iter();
            channels.any(|channel| self.active_source_at(channel, zero) == Some(source))
        };
        self.clock_jumps.iter().any(|jump| {
            let meets = jump.from <= to && jump.until.is_none_or(|until| until >= from);
            meets && is_active(jump.source)
        })
    }

    /// Starts a seam in one channel, or in all channels.
    fn seam_in(&mut self, channel: Option<usize>, at: UtcNs) {
        if self.seams.len() == MAX_SEAMS {
            self.seams.remove(0);
        }
        self.seams.push((at, channel));
    }

    /// Inserts a sample into the ring of its channel, or drops and counts it.
    pub fn insert(&mut self, sample: &NavSample) {
        let channel = NavChannel::of(&sample.quantity);
        if let Some(health) = self.health.get_mut(usize::from(sample.source)) {
            health.sample_arrived(sample.arrival_utc);
        }
        let sensor = self.sensors.get(usize::from(sample.source));
        if let Some(detection) = &mut self.detection
            && sensor.is_some_and(|s| s.detect)
        {
            detection.first.get_or_insert(sample.arrival_utc);
            detection.last = detection.last.max(Some(sample.arrival_utc));
        }
        if sample.valid_utc > sample.arrival_utc.plus_s(FUTURE_S) {
            self.counts.from_the_future += 1;
            return;
        }
        if !self.is_from_active_source(index(channel), sample) {
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
            NavQuantity::Depth { depth_m } => (DVec3::new(0.0, 0.0, depth_m), FixQuality::None),
        };
        if let Some(rule) = &self.jump_gate {
            match self.gates[index(channel)].judge(channel, sample.valid_utc, value, rule) {
                GateResult::Accepted => {}
                GateResult::Rejected => {
                    self.counts.quarantined += 1;
                    return;
                }
                GateResult::Reset => {
                    self.counts.resets += 1;
                    self.seam_in(Some(index(channel)), sample.valid_utc);
                }
            }
        }
        if channel == NavChannel::Position {
            self.first_fix_m.get_or_insert(value);
            self.first_fix_utc.get_or_insert(sample.valid_utc);
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

    /// Down coordinate of a position sample in the world, metres; `None` if the sample has no height. It refers to the antenna,
    /// except with a waterline.
    fn down_m(&self, height_m: Option<f64>, local_down_m: Option<f64>) -> Option<f64> {
        match self.vertical {
            VerticalSpec::Waterline { reference_down_m } => Some(reference_down_m),
            VerticalSpec::Gnss { datum_offset_m } => height_m
                .map(|h| -h)
                .or(local_down_m)
                .map(|down| down + datum_offset_m),
            // The depth channel is added later.
            VerticalSpec::Depth if self.uses_depth() => Some(0.0),
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
        self.active_source(channel).is_some()
    }

    /// Whether the points of a channel are joined at any distance.
    fn is_sparse(&self, channel: NavChannel) -> bool {
        let source = self.active_source(channel);
        let sensor = source.and_then(|source| self.sensors.get(usize::from(source)));
        sensor.is_some_and(|s| s.sparse)
    }

    fn heading_from(&self) -> HeadingFrom {
        if self.owns(NavChannel::Heading) {
            HeadingFrom::Sensor
        } else if !self.heading_from_course {
            HeadingFrom::None
        } else if self.owns(NavChannel::CourseSpeed) {
            HeadingFrom::Course
        } else {
            HeadingFrom::Track
        }
    }

    fn uses_heave(&self) -> bool {
        self.owns(NavChannel::Heave) && matches!(self.vertical, VerticalSpec::Waterline { .. })
    }

    fn uses_depth(&self) -> bool {
        self.owns(NavChannel::Depth) && self.vertical == VerticalSpec::Depth
    }

    /// Channel that is added to the down component of positions.
    fn vertical_channel(&self) -> Option<NavChannel> {
        if self.uses_heave() {
            Some(NavChannel::Heave)
        } else if self.uses_depth() {
            Some(NavChannel::Depth)
        } else {
            None
        }
    }

    /// Whether positions depend on the attitude.
    fn has_arm(&self) -> bool {
        let on_arm = |(_, source): &(UtcNs, u16)| {
            let sensor = self.sensors.get(usize::from(*source));
            sensor.is_some_and(|p| p.arm_m != DVec3::ZERO)
        };
        self.tow.is_some()
            || self.source_changes[index(NavChannel::Position)]
                .iter()
                .any(on_arm)
    }

    /// Whether heaves or depths depend on the attitude.
    fn vertical_has_arm(&self) -> bool {
        let Some(channel) = self.vertical_channel() else {
            return false;
        };
        let on_arm = |(_, source): &(UtcNs, u16)| {
            let sensor = self.sensors.get(usize::from(*source));
            sensor.is_some_and(|p| p.vertical_arm_m(channel) != DVec3::ZERO)
        };
        self.source_changes[index(channel)].iter().any(on_arm)
    }

    /// Channel that gives the heading, and the number of knots at or after a time that determine the heading there.
    fn heading_channel(&self) -> (NavChannel, usize) {
        match self.heading_from() {
            HeadingFrom::Sensor | HeadingFrom::None => (NavChannel::Heading, 2),
            HeadingFrom::Course => (NavChannel::CourseSpeed, 2),
            // A course is a rate of positions, which needs one knot more.
            HeadingFrom::Track => (NavChannel::Position, 3),
        }
    }

    /// Whether the samples determine the motion over `from..=to`. The rate at a knot needs the next knot, so each channel needs
    /// two knots at or after its end. Channels depend on one another: positions on attitude (lever arm), attitude on heading.
    pub fn coverage(&self, from: UtcNs, to: UtcNs) -> Coverage {
        let mut waiting = false;
        let mut missing = None;
        // Time of the `ahead`-th knot at or after `to`.
        let mut require = |channel: NavChannel, to: UtcNs, ahead: usize| -> UtcNs {
            let ring = self.ring(channel);
            if ring.oldest().is_some_and(|oldest| oldest > from) {
                missing = missing.or(Some(channel));
            }
            let require = ring.nth_at_or_after(to, ahead);
            waiting |= require.is_none();
            require.unwrap_or(to)
        };
        let position_to = require(NavChannel::Position, to, 2);
        // Time that the next channel must reach, and the channel that needs it; `None` means the window.
        let (mut needed_to, mut dependent) = match self.has_arm() {
            true => (position_to, Some(NavChannel::Position)),
            false => (to, None),
        };
        if let Some(vertical) = self.vertical_channel() {
            // The layback of a towed body depends on its depth at every fix.
            let upto = if self.tow.is_some() { position_to } else { to };
            let vertical_to = require(vertical, upto, 2);
            if self.vertical_has_arm() && vertical_to > needed_to {
                (needed_to, dependent) = (vertical_to, Some(vertical));
            }
        }
        if self.owns(NavChannel::RollPitch) {
            let ahead = self.knots_ahead(NavChannel::RollPitch, 2, dependent, needed_to);
            needed_to = require(NavChannel::RollPitch, needed_to, ahead);
            dependent = Some(NavChannel::RollPitch);
        }
        let (heading, ahead) = self.heading_channel();
        let ahead = self.knots_ahead(heading, ahead, dependent, needed_to);
        require(heading, needed_to, ahead);
        match (missing, waiting) {
            (Some(channel), _) => Coverage::Missing(channel),
            (None, true) => Coverage::Waiting,
            (None, false) => Coverage::Ready,
        }
    }

    /// Number of knots that `channel` needs at or after `to`. One fewer is enough if it has a knot at `to` and no knot of
    /// `dependent` lies between its last two knots, because then no rate matters. This holds when one sentence gives both channels.
    fn knots_ahead(
        &self,
        channel: NavChannel,
        ahead: usize,
        dependent: Option<NavChannel>,
        to: UtcNs,
    ) -> usize {
        let Some(dependent) = dependent.map(|a| self.ring(a)) else {
            return ahead;
        };
        let just_before = to.plus_ns(-1);
        let before = |ring: &Ring| ring.last_at_or_before(just_before).map(|k| k.utc);
        let ring = self.ring(channel);
        let meets = ring.nth_at_or_after(to, 1) == Some(to) && before(ring) >= before(dependent);
        if meets { ahead - 1 } else { ahead }
    }
}

const CHANNELS: usize = NavChannel::ALL.len();

impl Sensor {
    /// Position of the sensor of a vertical channel in the body, metres.
    fn vertical_arm_m(&self, channel: NavChannel) -> DVec3 {
        match channel {
            NavChannel::Heave => self.mounting.heave_arm_m,
            _ => self.arm_m,
        }
    }
}

fn index(channel: NavChannel) -> usize {
    channel as usize
}
