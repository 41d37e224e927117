//! Report on a recorded log. For each sentence: count, rate, gaps, latency and result. For each quantity: interval, gaps and jumps.

use std::collections::BTreeMap;

use super::decoder::{NavCounters, Outcome, SentenceEvent};
use super::framing::Checksum;
use super::log::{LogCounts, read_log_watched};
use super::reading::Kind;
use echotank_config::spec::{NavChannel, NavSourceSpec};
use echotank_core::geodesy::LocalTangentPlane;
use echotank_core::navigation::{NavQuantity, NavSample};
use echotank_core::time::{NS_PER_S, UtcNs};

/// Number of quantities; arrays by channel have the order of [`NavChannel::ALL`].
pub const CHANNEL_COUNT: usize = NavChannel::ALL.len();
const DAY_NS: i64 = 86_400 * NS_PER_S;
/// Maximum number of sentence names. Further names are mostly noise and are combined.
const MAX_NAMES: usize = 200;
const OTHERS: &str = "(others)";
/// Number of median intervals above which a pause is a gap; a gap is also longer than `MIN_GAP_S`.
const GAP_INTERVALS: f64 = 3.0;
const MIN_GAP_S: f64 = 0.5;

/// Limits of a step, `offset + rate * dt`, in metres and metres per second, or degrees and degrees per second. Survey platforms
/// stay below these limits. The offset allows for samples that are close in time.
const POSITION_GATE: (f64, f64) = (5.0, 50.0);
const ANGLE_GATE: (f64, f64) = (2.0, 60.0);
const HEAVE_GATE: (f64, f64) = (0.5, 10.0);

/// Minimum, median and maximum of a set of values.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Spread {
    /// Minimum.
    pub min: f64,
    /// Median.
    pub median: f64,
    /// Maximum.
    pub max: f64,
}

/// Statistics of one sentence name.
#[derive(Clone, Debug, Default)]
pub struct SentenceReport {
    /// Sentence name as in [`SentenceEvent`].
    pub name: String,
    /// Number of sentences.
    pub count: u64,
    /// Sentences with a wrong checksum.
    pub bad_checksum: u64,
    /// Sentences without a checksum.
    pub missing_checksum: u64,
    /// Sentences by result.
    pub outcomes: BTreeMap<Outcome, u64>,
    /// Time between arrivals, seconds; `None` with fewer than two sentences.
    pub interval_s: Option<Spread>,
    /// Arrival minus message time, seconds; `None` without message times.
    pub latency_s: Option<Spread>,
    /// Samples by channel.
    pub gave: [u64; CHANNEL_COUNT],
    /// Quantities that a higher-ranked sentence provides, by channel.
    pub outranked: [u64; CHANNEL_COUNT],
    /// Quantities that the configuration does not select from this source, by channel.
    pub(crate) unwanted: [u64; CHANNEL_COUNT],
    /// Magnetic headings without a variation.
    pub magnetic: u64,
    /// Water depths.
    pub depths: u64,
    arrivals: Vec<i64>,
    latencies: Vec<f64>,
}

/// Statistics of one quantity over a log: intervals, gaps and jumps.
#[derive(Clone, Debug, Default)]
pub struct ChannelReport {
    /// Number of samples.
    pub samples: u64,
    /// Time between times of validity, seconds.
    pub interval_s: Option<Spread>,
    /// Gaps: start and length in seconds.
    pub gaps: Vec<(UtcNs, f64)>,
    /// Times of steps beyond the limits.
    pub jumps: Vec<UtcNs>,
    /// Samples with a validity at or before that of the previous sample.
    pub backward: u64,
}

/// Content of a recorded log: counts, and statistics by sentence and by quantity.
#[derive(Clone, Debug, Default)]
pub struct LogReport {
    /// Counts of lines.
    pub log: LogCounts,
    /// Counters of the decoder.
    pub counters: NavCounters,
    /// Statistics by sentence, sorted by name.
    pub sentences: Vec<SentenceReport>,
    /// Statistics by quantity, in the order of [`NavChannel::ALL`].
    pub channels: [ChannelReport; CHANNEL_COUNT],
    /// Samples in file order.
    pub samples: Vec<NavSample>,
    /// Arrivals of the first and the last sentence.
    pub span: Option<(UtcNs, UtcNs)>,
    /// Number of midnights in the message times.
    pub midnights: u64,
}

/// Decodes a log with the settings of `spec` and reports its content. `plain_rate_hz` is the sentence rate, hertz, of a log without
/// any times.
pub fn report(bytes: &[u8], spec: &NavSourceSpec, plain_rate_hz: f64) -> LogReport {
    let mut sentences: BTreeMap<String, SentenceReport> = BTreeMap::new();
    let mut span: Option<(UtcNs, UtcNs)> = None;
    let (mut midnights, mut day) = (0, None);
    let mut watch = |event: &SentenceEvent| {
        let name = match sentences.len() < MAX_NAMES || sentences.contains_key(event.name) {
            true => event.name,
            false => OTHERS,
        };
        if !sentences.contains_key(name) {
            sentences.insert(name.to_owned(), SentenceReport::default());
        }
        if let Some(sentence) = sentences.get_mut(name) {
            sentence.record(event);
        }
        let (first, last) = span.unwrap_or((event.arrival, event.arrival));
        span = Some((first.min(event.arrival), last.max(event.arrival)));
        if let Some(utc) = event.message_utc {
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
        channels: NavChannel::ALL.map(|channel| channel_report(channel, &samples)),
        samples,
        span,
        midnights,
    }
}

impl SentenceReport {
    fn record(&mut self, event: &SentenceEvent) {
        self.count += 1;
        self.bad_checksum += u64::from(event.checksum == Checksum::Wrong);
        self.missing_checksum += u64::from(event.checksum == Checksum::Missing);
        *self.outcomes.entry(event.outcome).or_default() += 1;
        self.arrivals.push(event.arrival.0);
        if let Some(utc) = event.message_utc {
            self.latencies.push(event.arrival.seconds_since(utc));
        }
        for i in 0..CHANNEL_COUNT {
            let set = |mask: u8| u64::from(mask >> i & 1);
            self.gave[i] += set(event.taken);
            self.outranked[i] += set(event.outranked);
            self.unwanted[i] += set(event.unwanted);
        }
        if let Some(reading) = event.reading {
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
        min: *values.first()?,
        median: values[values.len() / 2],
        max: *values.last()?,
    })
}

fn channel_report(channel: NavChannel, samples: &[NavSample]) -> ChannelReport {
    let of = |s: &&NavSample| NavChannel::of(&s.quantity) == channel;
    let mut sorted: Vec<&NavSample> = samples.iter().filter(of).collect();
    let backward = sorted
        .windows(2)
        .filter(|w| w[1].valid_utc <= w[0].valid_utc)
        .count() as u64;
    // As in the history, samples are sorted, and the first sample of each time is kept.
    sorted.sort_by_key(|s| s.valid_utc);
    sorted.dedup_by_key(|s| s.valid_utc);
    let step_s = |w: &[&NavSample]| w[1].valid_utc.seconds_since(w[0].valid_utc);
    let interval_s = spread(sorted.windows(2).map(step_s).collect());
    let longest_s = interval_s.map_or(f64::INFINITY, |i| (GAP_INTERVALS * i.median).max(MIN_GAP_S));
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
