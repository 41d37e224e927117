//! Samples to motion: per-channel rings, and the platform's state and trajectory at a ping.
//!
//! - The first source of the file that provides a channel owns it, or, with fail-over, the best one that is not silent (`arbiter`); nobody
//!   else's samples are taken. A change of source is a seam.
//! - With a jump gate, samples that no platform can have made are set aside (`gate`).
//! - Positions, heaves and depths are reduced from antenna and sensor to the body's reference point each at its own time: between two fixes
//!   the antenna sways with the roll, the reference point does not. So [`echotank_core::frames::Trajectory::lever_arm_m`] leaves here as zero. A
//!   static list counts as induced heave too, though no heave sensor shows it.
//! - What a motion sensor says is turned by its mounting into what the body does (`mounted`).
//! - A towed body lies behind the ship on the heading, as far as cable and depth say.
//! - Attitude knots lie at the roll-pitch samples; heading is interpolated there the short way round. Without roll and pitch they lie at the
//!   heading samples.
//! - A seam is a gap: nothing is interpolated across it. Seams part loops of a log, in every channel, and in one channel sources that relieve
//!   one another and places joined by no motion.
//! - Not modelled: smoothing.

mod arbiter;
mod gate;
mod motion;

use glam::DVec3;
use thiserror::Error;

use self::arbiter::{Arbiter, Word};
use self::gate::{Gate, Passage};
use super::health::{Health, Limits, State};
use super::ring::{Inserted, Knot, Ring};
use echotank_config::spec::{
    FailoverSpec, JumpGateSpec, NavChannel, NavInputSpec, NavSourceSpec, NavSpec, OnLost,
    OriginSpec, SensorMounting, TowSpec, VerticalSpec,
};
use echotank_core::flow::{FixQuality, NavQuantity, NavSample};
use echotank_core::frames::VectorKnot;
use echotank_core::geodesy::LocalTangentPlane;
use echotank_core::time::{NS_PER_S, UtcNs};

/// Below this speed, metres per second, course is noise: the last one is kept.
const MIN_COURSE_SPEED_M_PER_S: f64 = 0.2;
/// A sample that holds so much later than it came, seconds, is of another clock; it would push the whole past out of the rings. Less may be a
/// log that somebody feeds in faster than it was recorded.
const FUTURE_S: f64 = 600.0;
/// Seams remembered; a loop shorter than a sixteenth of the history forgets its oldest.
const MAX_SEAMS: usize = 16;

/// Why there is no state at a time.
#[derive(Clone, Copy, Debug, PartialEq, Error)]
pub enum NavGap {
    #[error("no {0:?} at or before the ping")]
    NoData(NavChannel),
    /// Measured from the window's end.
    #[error("the newest {channel:?} is {age_s:.3} s old")]
    Stale { channel: NavChannel, age_s: f64 },
    #[error("{gap_s:.1} s between two samples of {channel:?}")]
    Hole { channel: NavChannel, gap_s: f64 },
    #[error("the window lies across the seam of the repeated log")]
    Seam,
    #[error("two positions imply {speed_m_per_s:.0} m/s")]
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
    /// Dropped: said to hold later than it came; the source's clock is not this rig's.
    pub(crate) from_the_future: u64,
    /// Dropped: another source owns the channel.
    pub not_owned: u64,
    /// Times that another source took a channel over.
    pub switches: u64,
    /// Dropped: farther from the sample before than the platform can have moved.
    pub quarantined: u64,
    /// Times that such samples were believed, since they agreed.
    pub resets: u64,
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
    /// A track in a file: its points are joined however far apart.
    sparse: bool,
}

/// Where a source's sensors sit in the body.
#[derive(Clone, Copy, Debug)]
struct Place {
    /// Antenna or depth sensor, metres.
    arm_m: DVec3,
    sensor: SensorMounting,
}

pub struct NavHistory {
    vertical: VerticalSpec,
    heading_from: HeadingFrom,
    max_extrapolation_s: f64,
    depth_ns: i64,
    failover: Option<FailoverSpec>,
    jump_gate: Option<JumpGateSpec>,
    on_lost: OnLost,
    stale_s: f64,
    tow: Option<TowSpec>,
    /// By source.
    places: Vec<Place>,
    /// By channel: who speaks, from when on; ascending, never empty once somebody can.
    spoke: [Vec<(UtcNs, u16)>; CHANNELS],
    owners: [Option<Owner>; CHANNELS],
    arbiters: [Arbiter; CHANNELS],
    gates: [Gate; CHANNELS],
    /// Nothing valid before is taken: another source spoke then.
    taken_from: [UtcNs; CHANNELS],
    /// By source.
    health: Vec<Health>,
    rings: [Ring; CHANNELS],
    plane: Option<LocalTangentPlane>,
    first_fix_m: Option<DVec3>,
    /// When, and in which channel (none: in every one).
    seams: Vec<(UtcNs, Option<usize>)>,
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
        let arbiters = ALL_CHANNELS.map(|channel| {
            let provides = |(_, s): &(usize, &NavSourceSpec)| s.provides.contains(&channel);
            let sources = spec.sources.iter().enumerate().filter(provides);
            Arbiter::new(sources.filter_map(|(i, _)| u16::try_from(i).ok()))
        });
        let place = |s: &NavSourceSpec| Place {
            arm_m: s.lever_arm_m,
            sensor: s.mounting,
        };
        let spoke = ALL_CHANNELS.map(|channel| {
            let first = arbiters[index(channel)].source();
            let mut spoke = Vec::with_capacity(MAX_SEAMS + 2);
            spoke.extend(first.map(|source| (UtcNs(i64::MIN), source)));
            spoke
        });
        let limits = Limits {
            stale_s: spec.stale_s,
            lost_s: spec.lost_s,
        };
        Self {
            vertical: spec.vertical,
            heading_from,
            max_extrapolation_s: spec.max_extrapolation_s,
            depth_ns: (spec.history_s * NS_PER_S as f64) as i64,
            failover: spec.failover,
            jump_gate: spec.jump_gate,
            on_lost: spec.on_lost,
            stale_s: spec.stale_s,
            tow: spec.tow,
            places: spec.sources.iter().map(place).collect(),
            spoke,
            owners,
            arbiters,
            gates: Default::default(),
            taken_from: [UtcNs(i64::MIN); CHANNELS],
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

    /// The first instant at which every channel that a ping needs has a sample; none while one of them is silent.
    pub fn first_usable_utc(&self) -> Option<UtcNs> {
        self.first_usable_utc_of(|_| true)
    }

    /// The same, of what `counts` among the channels a ping needs; none too where it needs none of them.
    pub fn first_usable_utc_of(&self, counts: impl Fn(NavChannel) -> bool) -> Option<UtcNs> {
        let mut first = None;
        for channel in self.needed().filter(|&channel| counts(channel)) {
            first = first.max(Some(self.ring(channel).oldest()?));
        }
        first
    }

    /// Channels that a ping needs and that have been silent so far.
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

    pub fn counts(&self) -> &HistoryCounts {
        &self.counts
    }

    /// How the source with this index does at `now`, by the arrivals of its samples.
    pub fn source_state(&mut self, source: usize, now: UtcNs) -> State {
        self.health
            .get_mut(source)
            .map_or(State::Silent, |h| h.at(now))
    }

    /// The source whose samples of a channel count at present; before any came, the best.
    pub fn speaking(&self, channel: NavChannel) -> Option<u16> {
        self.arbiters[index(channel)].source()
    }

    /// Whether a sample counts, by who said it.
    fn has_the_word(&mut self, channel: usize, sample: &NavSample) -> bool {
        let word = self.arbiters[channel].hear(sample.source, sample.arrival_utc, self.failover);
        if word == Word::Takes {
            // Behind everything that the other source said.
            let newest = self.rings[channel].newest();
            let from = newest.map_or(sample.valid_utc, |n| sample.valid_utc.max(n.plus_ns(1)));
            self.counts.switches += 1;
            self.taken_from[channel] = from;
            self.gates[channel].forget();
            self.seam_in(Some(channel), from);
            let spoke = &mut self.spoke[channel];
            if spoke.len() > MAX_SEAMS {
                spoke.remove(0);
            }
            spoke.push((from, sample.source));
        }
        word != Word::HasNot && sample.valid_utc >= self.taken_from[channel]
    }

    /// Whose samples of a channel hold at this time.
    fn spoke_at(&self, channel: NavChannel, utc: UtcNs) -> Option<u16> {
        let spoke = &self.spoke[index(channel)];
        let since = spoke.iter().rev().find(|(from, _)| *from <= utc);
        since.or(spoke.first()).map(|(_, source)| *source)
    }

    /// Where the sensors of that source sit; none where nobody gives the channel.
    fn place_at(&self, channel: NavChannel, utc: UtcNs) -> Option<&Place> {
        self.places.get(usize::from(self.spoke_at(channel, utc)?))
    }

    /// From here on samples belong to another run of a repeated log.
    pub fn seam(&mut self, at: UtcNs) {
        self.seam_in(None, at);
    }

    /// Nothing joins what this channel (or every one) says from here on to what it said before.
    fn seam_in(&mut self, channel: Option<usize>, at: UtcNs) {
        if self.seams.len() == MAX_SEAMS {
            self.seams.remove(0);
        }
        self.seams.push((at, channel));
    }

    pub fn insert(&mut self, sample: &NavSample) {
        let channel = channel_of(&sample.quantity);
        if let Some(health) = self.health.get_mut(usize::from(sample.source)) {
            health.heard(sample.arrival_utc);
        }
        if sample.valid_utc > sample.arrival_utc.plus_s(FUTURE_S) {
            self.counts.from_the_future += 1;
            return;
        }
        if !self.has_the_word(index(channel), sample) {
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
                Passage::Open => {}
                Passage::Shut => {
                    self.counts.quarantined += 1;
                    return;
                }
                Passage::Reset => {
                    self.counts.resets += 1;
                    self.seam_in(Some(index(channel)), sample.valid_utc);
                }
            }
        }
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
            // The depth sensor's channel brings it.
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
        self.owners[index(channel)].is_some()
    }

    fn uses_heave(&self) -> bool {
        self.owns(NavChannel::Heave) && matches!(self.vertical, VerticalSpec::Waterline { .. })
    }

    fn uses_depth(&self) -> bool {
        self.owns(NavChannel::Depth) && self.vertical == VerticalSpec::Depth
    }

    /// What is added to the positions' down, if anything is.
    fn vertical_channel(&self) -> Option<NavChannel> {
        if self.uses_heave() {
            Some(NavChannel::Heave)
        } else if self.uses_depth() {
            Some(NavChannel::Depth)
        } else {
            None
        }
    }

    /// Positions lean on the attitude.
    fn has_arm(&self) -> bool {
        let on_arm = |(_, source): &(UtcNs, u16)| {
            let place = self.places.get(usize::from(*source));
            place.is_some_and(|p| p.arm_m != DVec3::ZERO)
        };
        self.tow.is_some() || self.spoke[index(NavChannel::Position)].iter().any(on_arm)
    }

    /// So do heaves or depths.
    fn vertical_has_arm(&self) -> bool {
        let Some(channel) = self.vertical_channel() else {
            return false;
        };
        let on_arm = |(_, source): &(UtcNs, u16)| {
            let place = self.places.get(usize::from(*source));
            place.is_some_and(|p| p.vertical_arm_m(channel) != DVec3::ZERO)
        };
        self.spoke[index(channel)].iter().any(on_arm)
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
        // What the next channel must reach, and whose knots ask for it; none: the window itself.
        let (mut needed_to, mut asking) = match self.has_arm() {
            true => (position_to, Some(NavChannel::Position)),
            false => (to, None),
        };
        if let Some(vertical) = self.vertical_channel() {
            // How far behind a towed body lies depends on its depth, at every fix.
            let upto = if self.tow.is_some() { position_to } else { to };
            let vertical_to = reach(vertical, upto, 2);
            if self.vertical_has_arm() && vertical_to > needed_to {
                (needed_to, asking) = (vertical_to, Some(vertical));
            }
        }
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
}

const CHANNELS: usize = 6;
const ALL_CHANNELS: [NavChannel; CHANNELS] = [
    NavChannel::Position,
    NavChannel::CourseSpeed,
    NavChannel::Heading,
    NavChannel::RollPitch,
    NavChannel::Heave,
    NavChannel::Depth,
];

impl Place {
    /// Where the sensor of this vertical channel sits.
    fn vertical_arm_m(&self, channel: NavChannel) -> DVec3 {
        match channel {
            NavChannel::Heave => self.sensor.heave_arm_m,
            _ => self.arm_m,
        }
    }
}

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
        NavQuantity::Depth { .. } => NavChannel::Depth,
    }
}
