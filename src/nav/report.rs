//! What a recorded log holds, and what would come of it. Comes in: a whole log and how a source would read it. Goes out: per sentence its
//! count, rate, gaps, latency and fate; per quantity who spoke for it, gaps, jumps and range.

use std::collections::BTreeMap;

use super::decoder::{Heard, NavCounters, Outcome};
use super::framing::Checksum;
use super::log::{LogCounts, read_log_watched};
use super::reading::Kind;
use echotank_config::spec::{NavChannel, NavSourceSpec};
use echotank_core::flow::{NavQuantity, NavSample};
use echotank_core::geodesy::LocalTangentPlane;
use echotank_core::time::{NS_PER_S, UtcNs};

/// Quantities told apart.
pub const CHANNEL_COUNT: usize = 6;
pub const CHANNELS: [NavChannel; CHANNEL_COUNT] = [
    NavChannel::Position,
    NavChannel::CourseSpeed,
    NavChannel::Heading,
    NavChannel::RollPitch,
    NavChannel::Heave,
    NavChannel::Depth,
];
const DAY_NS: i64 = 86_400 * NS_PER_S;
/// Different sentences told apart; noise that looks like sentences beyond them is put together.
const MAX_NAMES: usize = 200;
const OTHERS: &str = "(others)";
/// A silence counts as a gap when it is longer than this many usual intervals, and than [`SHORTEST_GAP_S`].
const GAP_INTERVALS: f64 = 3.0;
const SHORTEST_GAP_S: f64 = 0.5;

/// Steps beyond `0 + 1 * dt` are jumps: metres and metres per second, or degrees and degrees per second. No survey platform moves faster;
/// the first number forgives samples whose times lie close together.
const POSITION_GATE: (f64, f64) = (5.0, 50.0);
const ANGLE_GATE: (f64, f64) = (2.0, 60.0);
const HEAVE_GATE: (f64, f64) = (0.5, 10.0);

/// Least, median and most.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Spread {
    pub least: f64,
    pub median: f64,
    pub most: f64,
}

/// Of one kind of sentence.
#[derive(Clone, Debug, Default)]
pub struct SentenceReport {
    pub name: String,
    pub count: u64,
    pub bad_checksum: u64,
    pub missing_checksum: u64,
    /// How many met which end.
    pub outcomes: BTreeMap<Outcome, u64>,
    /// Between arrivals, seconds; none below two.
    pub interval_s: Option<Spread>,
    /// Arrival minus the message's own time, seconds; none where it has none.
    pub latency_s: Option<Spread>,
    /// Samples given, by channel.
    pub gave: [u64; CHANNEL_COUNT],
    /// Quantities left to a better sentence, by channel.
    pub outspoken: [u64; CHANNEL_COUNT],
    /// Quantities that the source is not to provide, by channel.
    pub(crate) unwanted: [u64; CHANNEL_COUNT],
    /// Magnetic headings without a variation.
    pub magnetic: u64,
    /// Depths of water.
    pub depths: u64,
    arrivals: Vec<i64>,
    latencies: Vec<f64>,
}

/// Of one quantity.
#[derive(Clone, Debug, Default)]
pub struct ChannelReport {
    pub samples: u64,
    /// Between validities, seconds.
    pub interval_s: Option<Spread>,
    /// Silences (start, seconds).
    pub gaps: Vec<(UtcNs, f64)>,
    /// Steps that no platform makes.
    pub jumps: Vec<UtcNs>,
    /// Valid at or before the sample before.
    pub backward: u64,
}

#[derive(Clone, Debug, Default)]
pub struct LogReport {
    pub log: LogCounts,
    pub counters: NavCounters,
    /// By name.
    pub sentences: Vec<SentenceReport>,
    /// In the order of [`CHANNELS`].
    pub channels: [ChannelReport; CHANNEL_COUNT],
    /// In the file's order.
    pub samples: Vec<NavSample>,
    /// Arrival of the first and last sentence.
    pub span: Option<(UtcNs, UtcNs)>,
    /// Message times that passed midnight.
    pub midnights: u64,
}

/// Reads a log as `spec` would have it read.
pub fn report(bytes: &[u8], spec: &NavSourceSpec, plain_rate_hz: f64) -> LogReport {
    let mut sentences: BTreeMap<String, SentenceReport> = BTreeMap::new();
    let mut span: Option<(UtcNs, UtcNs)> = None;
    let (mut midnights, mut day) = (0, None);
    let mut watch = |heard: &Heard| {
        let name = match sentences.len() < MAX_NAMES || sentences.contains_key(heard.name) {
            true => heard.name,
            false => OTHERS,
        };
        if !sentences.contains_key(name) {
            sentences.insert(name.to_owned(), SentenceReport::default());
        }
        if let Some(sentence) = sentences.get_mut(name) {
            sentence.hear(heard);
        }
        let (first, last) = span.unwrap_or((heard.arrival, heard.arrival));
        span = Some((first.min(heard.arrival), last.max(heard.arrival)));
        if let Some(utc) = heard.message_utc {
            let today = utc.0.div_euclid(DAY_NS);
            midnights += u64::from(day.is_some_and(|before| today == before + 1));
            day = Some(today);
        }
    };
    let (samples, counters, log) = read_log_watched(bytes, 0, spec, plain_rate_hz, &mut watch);
    let sentences = sentences
        .into_iter()
        .map(|(name, sentence)| sentence.finish(name))
        .collect();
    LogReport {
        log,
        counters,
        sentences,
        channels: CHANNELS.map(|channel| channel_report(channel, &samples)),
        samples,
        span,
        midnights,
    }
}

impl SentenceReport {
    fn hear(&mut self, heard: &Heard) {
        self.count += 1;
        self.bad_checksum += u64::from(heard.checksum == Checksum::Wrong);
        self.missing_checksum += u64::from(heard.checksum == Checksum::Missing);
        *self.outcomes.entry(heard.outcome).or_default() += 1;
        self.arrivals.push(heard.arrival.0);
        if let Some(utc) = heard.message_utc {
            self.latencies.push(heard.arrival.seconds_since(utc));
        }
        for i in 0..CHANNELS.len() {
            let set = |mask: u8| u64::from(mask >> i & 1);
            self.gave[i] += set(heard.taken);
            self.outspoken[i] += set(heard.outspoken);
            self.unwanted[i] += set(heard.unwanted);
        }
        if let Some(reading) = heard.reading {
            self.magnetic += u64::from(reading.magnetic_rad.is_some());
            self.depths += u64::from(reading.kind == Kind::Depth);
        }
    }

    fn finish(mut self, name: String) -> Self {
        self.name = name;
        let steps = self.arrivals.windows(2);
        let steps: Vec<f64> = steps
            .map(|w| w[1].saturating_sub(w[0]) as f64 / NS_PER_S as f64)
            .collect();
        self.interval_s = spread(steps);
        self.latency_s = spread(std::mem::take(&mut self.latencies));
        self.arrivals = Vec::new();
        self
    }
}

fn spread(mut values: Vec<f64>) -> Option<Spread> {
    values.sort_by(f64::total_cmp);
    Some(Spread {
        least: *values.first()?,
        median: values[values.len() / 2],
        most: *values.last()?,
    })
}

fn channel_of(q: &NavQuantity) -> NavChannel {
    match q {
        NavQuantity::Position { .. } | NavQuantity::LocalPosition { .. } => NavChannel::Position,
        NavQuantity::CourseSpeed { .. } => NavChannel::CourseSpeed,
        NavQuantity::Heading { .. } => NavChannel::Heading,
        NavQuantity::RollPitch { .. } => NavChannel::RollPitch,
        NavQuantity::Heave { .. } => NavChannel::Heave,
        NavQuantity::Depth { .. } => NavChannel::Depth,
    }
}

fn channel_report(channel: NavChannel, samples: &[NavSample]) -> ChannelReport {
    let of = |s: &&NavSample| channel_of(&s.quantity) == channel;
    let mut sorted: Vec<&NavSample> = samples.iter().filter(of).collect();
    let backward = sorted
        .windows(2)
        .filter(|w| w[1].valid_utc <= w[0].valid_utc)
        .count() as u64;
    // As the history has them: in order, the first of each time.
    sorted.sort_by_key(|s| s.valid_utc);
    sorted.dedup_by_key(|s| s.valid_utc);
    let step_s = |w: &[&NavSample]| w[1].valid_utc.seconds_since(w[0].valid_utc);
    let interval_s = spread(sorted.windows(2).map(step_s).collect());
    let longest_s = interval_s.map_or(f64::INFINITY, |i| {
        (GAP_INTERVALS * i.median).max(SHORTEST_GAP_S)
    });
    let plane = sorted.iter().find_map(|s| match s.quantity {
        NavQuantity::Position {
            latitude_rad,
            longitude_rad,
            ..
        } => Some(LocalTangentPlane::new(latitude_rad, longitude_rad)),
        _ => None,
    });
    let mut report = ChannelReport {
        samples: samples.iter().filter(of).count() as u64,
        interval_s,
        backward,
        ..ChannelReport::default()
    };
    for w in sorted.windows(2) {
        let dt_s = step_s(w);
        if dt_s > longest_s {
            report.gaps.push((w[0].valid_utc, dt_s));
        }
        if is_jump(&w[0].quantity, &w[1].quantity, dt_s, plane) {
            report.jumps.push(w[1].valid_utc);
        }
    }
    report
}

fn is_jump(a: &NavQuantity, b: &NavQuantity, dt_s: f64, plane: Option<LocalTangentPlane>) -> bool {
    let beyond = |step: f64, gate: (f64, f64)| step > gate.0 + gate.1 * dt_s;
    let turn = |a: f64, b: f64| {
        let degrees = (b - a).to_degrees();
        ((degrees + 180.0).rem_euclid(360.0) - 180.0).abs()
    };
    match (a, b) {
        (
            NavQuantity::Position {
                latitude_rad: la,
                longitude_rad: oa,
                ..
            },
            NavQuantity::Position {
                latitude_rad: lb,
                longitude_rad: ob,
                ..
            },
        ) => plane.is_some_and(|plane| {
            let ((na, ea), (nb, eb)) = (plane.local_m(*la, *oa), plane.local_m(*lb, *ob));
            beyond((nb - na).hypot(eb - ea), POSITION_GATE)
        }),
        (NavQuantity::Heading { heading_rad: a }, NavQuantity::Heading { heading_rad: b }) => {
            beyond(turn(*a, *b), ANGLE_GATE)
        }
        (
            NavQuantity::RollPitch {
                roll_rad: ra,
                pitch_rad: pa,
            },
            NavQuantity::RollPitch {
                roll_rad: rb,
                pitch_rad: pb,
            },
        ) => beyond(turn(*ra, *rb).max(turn(*pa, *pb)), ANGLE_GATE),
        (NavQuantity::Heave { heave_down_m: a }, NavQuantity::Heave { heave_down_m: b }) => {
            beyond((b - a).abs(), HEAVE_GATE)
        }
        _ => false,
    }
}
