//! Recorded sources: read completely, decoded once, merged by arrival time, and repeated on request.

use std::path::Path;

use super::{Feed, NavOpenError, SourceCounters};
use crate::config_files::read_bounded;
use echotank_config::spec::{NavChannel, NavInputSpec, NavSourceSpec, NavSpec};
use echotank_core::navigation::NavSample;
use echotank_core::time::UtcNs;
use echotank_nav::NavCounters;
use echotank_nav::decoder::{ClockEvent, ClockState};
use echotank_nav::detection::detect;
use echotank_nav::log::{read_log, refusal, unknown_binary};
use echotank_nav::passes::PassKind;
use echotank_nav::track::read_track;

/// Maximum size of a file, bytes. An hour of 100 Hz attitude is 30 MB; longer logs must be cut.
pub const MAX_LOG_BYTES: u64 = 256 << 20;

/// Refused checksums cause a warning if more than one sentence in this many is refused.
const MAX_REFUSED_ONE_IN: u64 = 20;

/// Silence of all sources beyond which a replay skips the gap, s. The skipped pings are counted without being ordered.
const LONG_GAP_S: f64 = 3600.0;

/// Event between samples.
#[derive(Clone, Copy)]
enum Event {
    /// A pass of a log begins.
    Seam,
    /// The clock of a source changes.
    Clock(u16, ClockState),
}

pub(super) struct Recorded {
    /// Sorted by arrival.
    samples: Vec<NavSample>,
    next: usize,
    /// Sorted by time.
    events: Vec<(UtcNs, Event)>,
    next_event: usize,
    /// Long gaps, from the last arrival before to the first arrival after, in the time of the first loop.
    gaps: Vec<(UtcNs, UtcNs)>,
    /// Offset of all times in the current loop.
    shift_ns: i64,
    repeat: Option<Repeat>,
}

#[derive(Clone, Copy)]
struct Repeat {
    period_ns: i64,
    /// Instant between the last validity time of a loop and the first of the next, in the time of the first loop.
    seam: UtcNs,
}

impl Recorded {
    /// Opens the recorded sources; `None` if there are none. Fills each `provides` that the configuration leaves open with the quantities found in
    /// the log. Returns the warnings about the logs.
    pub(super) fn open(
        spec: &mut NavSpec,
        counters: &mut [SourceCounters],
    ) -> Result<(Option<Self>, Vec<String>), NavOpenError> {
        let mut by_source = Vec::new();
        let mut events = Vec::new();
        let recorded = spec.sources.iter().filter(|s| s.is_recorded()).count();
        for (i, source) in spec.sources.iter().enumerate() {
            // Source indices fit in 16 bits.
            let index = u16::try_from(i).unwrap_or(u16::MAX);
            let shares_log = |other: &NavSourceSpec| {
                other.name != source.name
                    && log_of(other).is_some_and(|path| Some(path) == log_of(source))
            };
            by_source.push(match read_source(index, source, &mut counters[i]) {
                // Another source uses the rest of this log.
                Err(NavOpenError::NothingUsable { .. })
                    if spec.sources.iter().any(shares_log) && source.detect =>
                {
                    Vec::new()
                }
                read => read?,
            });
            let log = &counters[i].log;
            let shifted = log.passes.iter().find(|p| p.kind == PassKind::Shifted);
            if let Some(pass) = shifted.filter(|_| recorded > 1) {
                let problem = format!(
                    "its clock steps back at line {}: the passes would be played one after the other, which does not work with another recorded source; split the passes into separate files",
                    pass.line
                );
                return Err(NavOpenError::source(&source.name, problem));
            }
            events.extend(log.passes.iter().skip(1).map(|p| (p.start(), Event::Seam)));
            let clock = |e: &ClockEvent| (e.arrival, Event::Clock(index, e.state));
            events.extend(log.clock_events.iter().map(clock));
        }
        let mut warnings = detect(spec, &by_source)?;
        for s in counters.iter() {
            let (refused, all) = (s.decoder.refused_checksum, s.decoder.sentences);
            if refused * MAX_REFUSED_ONE_IN > all {
                warnings.push(format!(
                    "{}: {refused} of {all} sentences are rejected by checksum (see the keys checksum, ignore_checksum_for)",
                    s.name
                ));
            }
        }
        for (samples, source) in by_source.iter_mut().zip(&spec.sources) {
            samples.retain(|s| source.provides.contains(&NavChannel::of(&s.quantity)));
        }
        let mut samples: Vec<_> = by_source.into_iter().flatten().collect();
        if samples.is_empty() {
            return Ok((None, warnings));
        }
        let repeat = if spec.loop_log {
            Some(prepare_to_repeat(&mut samples)?)
        } else {
            None
        };
        samples.sort_by_key(|s| s.arrival_utc);
        events.sort_by_key(|(at, _)| *at);
        let long = |w: &[NavSample]| {
            let (from, to) = (w[0].arrival_utc, w[1].arrival_utc);
            (to.seconds_since(from) > LONG_GAP_S).then_some((from, to))
        };
        let recorded = Self {
            gaps: samples.windows(2).filter_map(long).collect(),
            samples,
            next: 0,
            events,
            next_event: 0,
            shift_ns: 0,
            repeat,
        };
        Ok((Some(recorded), warnings))
    }

    pub(super) fn start(&self) -> UtcNs {
        self.samples[0].arrival_utc
    }

    pub(super) fn end(&self) -> UtcNs {
        self.samples[self.samples.len() - 1].arrival_utc
    }

    /// Number of samples in one loop.
    pub(super) fn count(&self) -> usize {
        self.samples.len()
    }

    /// End of the long gap that contains `utc`, reduced by `margin_s` at both ends. `None` outside of gaps.
    pub(super) fn gap_end(&self, utc: UtcNs, margin_s: f64) -> Option<UtcNs> {
        let loops = self.repeat.map_or(0, |repeat| {
            let since_ns = utc.0.saturating_sub(self.start().0);
            since_ns.div_euclid(repeat.period_ns) * repeat.period_ns
        });
        let in_first = utc.plus_ns(-loops);
        let ends = self
            .gaps
            .iter()
            .map(|(from, to)| (from.plus_s(margin_s), to.plus_s(-margin_s)));
        let mut inside = ends.filter(|(from, to)| *from < in_first && in_first < *to);
        inside.next().map(|(_, to)| to.plus_ns(loops))
    }

    pub(crate) fn next_arrival(&self) -> Option<UtcNs> {
        if let Some(sample) = self.samples.get(self.next) {
            return Some(sample.arrival_utc.plus_ns(self.shift_ns));
        }
        let repeat = self.repeat?;
        Some(self.start().plus_ns(self.shift_ns + repeat.period_ns))
    }

    /// Inserts the samples that arrived by `until`.
    pub(super) fn take_until(&mut self, until: UtcNs, feed: &mut Feed) {
        while self.next_arrival().is_some_and(|arrival| arrival <= until) {
            self.take(feed);
        }
    }

    /// Inserts the next sample, if any, into the history.
    pub(super) fn take(&mut self, feed: &mut Feed) {
        if self.next == self.samples.len()
            && let Some(repeat) = self.repeat
        {
            feed.seam(repeat.seam.plus_ns(self.shift_ns));
            self.shift_ns += repeat.period_ns;
            (self.next, self.next_event) = (0, 0);
        }
        let Some(sample) = self.samples.get(self.next) else {
            return;
        };
        self.next += 1;
        while let Some((at, event)) = self.events.get(self.next_event)
            && *at <= sample.arrival_utc
        {
            self.next_event += 1;
            let at = at.plus_ns(self.shift_ns);
            match event {
                Event::Seam => feed.seam(at),
                Event::Clock(source, state) => feed.clock_changed(*source, at, *state),
            }
        }
        feed.insert(&NavSample {
            valid_utc: sample.valid_utc.plus_ns(self.shift_ns),
            arrival_utc: sample.arrival_utc.plus_ns(self.shift_ns),
            ..*sample
        });
    }
}

/// Path of a recorded log.
fn log_of(source: &NavSourceSpec) -> Option<&Path> {
    match &source.input {
        NavInputSpec::Log { path, .. } => Some(path),
        _ => None,
    }
}

fn read_source(
    index: u16,
    source: &NavSourceSpec,
    counters: &mut SourceCounters,
) -> Result<Vec<NavSample>, NavOpenError> {
    let (samples, path) = match &source.input {
        NavInputSpec::Log {
            path,
            plain_rate_hz,
        } => {
            let bytes = read_file(&source.name, path)?;
            let refused = |why: String| NavOpenError::Unreadable {
                name: source.name.clone(),
                problem: format!("{} {why}", path.display()),
            };
            if let Some(why) = refusal(&bytes) {
                return Err(refused(why.to_owned()));
            }
            let (samples, decoder, log) = read_log(&bytes, index, source, *plain_rate_hz);
            if samples.is_empty()
                && let Some(why) = unknown_binary(&bytes, log.kind)
            {
                return Err(refused(why));
            }
            (counters.decoder, counters.log) = (decoder, log);
            (samples, path)
        }
        NavInputSpec::Csv { path } => {
            let bytes = read_file(&source.name, path)?;
            let text = String::from_utf8_lossy(&bytes);
            let file = path.display().to_string();
            let samples = read_track(&text, &file, index, &source.provides)
                .map_err(|error| NavOpenError::source(&source.name, error.to_string()))?;
            counters.decoder = NavCounters {
                bytes: bytes.len() as u64,
                samples: samples.len() as u64,
                ..Default::default()
            };
            (samples, path)
        }
        NavInputSpec::Udp { .. }
        | NavInputSpec::Serial { .. }
        | NavInputSpec::TcpConnect { .. }
        | NavInputSpec::TcpListen { .. } => return Ok(Vec::new()),
    };
    if samples.is_empty() {
        return Err(NavOpenError::NothingUsable {
            name: source.name.clone(),
            path: path.display().to_string(),
            counters: Box::new(counters.decoder),
            json: counters.log.json,
        });
    }
    Ok(samples)
}

fn read_file(name: &str, path: &Path) -> Result<Vec<u8>, NavOpenError> {
    read_bounded(path, MAX_LOG_BYTES)
        .map_err(|why| NavOpenError::source(name, format!("cannot read {}: {why}", path.display())))
}

/// Cuts the samples to the period that all channels cover. A loop repeats after one further median interval of the positions, or of all samples
/// if there are no positions.
fn prepare_to_repeat(samples: &mut Vec<NavSample>) -> Result<Repeat, NavOpenError> {
    let mut spans: Vec<(Channel, UtcNs, UtcNs)> = Vec::new();
    for s in samples.iter() {
        let channel = (s.source, NavChannel::of(&s.quantity));
        match spans.iter_mut().find(|(c, ..)| *c == channel) {
            Some((_, first, last)) => {
                *first = (*first).min(s.valid_utc);
                *last = (*last).max(s.valid_utc);
            }
            None => spans.push((channel, s.valid_utc, s.valid_utc)),
        }
    }
    let first = spans.iter().map(|(_, first, _)| *first).max();
    let last = spans.iter().map(|(.., last)| *last).min();
    let (Some(first), Some(last)) = (first, last) else {
        return Err(NavOpenError::NothingToLoop);
    };
    samples.retain(|s| (first..=last).contains(&s.valid_utc));
    if samples.is_empty() || last <= first {
        return Err(NavOpenError::NothingToLoop);
    }
    let interval_ns = median_interval_ns(samples).max(1);
    Ok(Repeat {
        period_ns: last.0 - first.0 + interval_ns,
        seam: last.plus_ns(interval_ns / 2 + 1),
    })
}

type Channel = (u16, NavChannel);

fn median_interval_ns(samples: &[NavSample]) -> i64 {
    let positions = samples
        .iter()
        .filter(|s| NavChannel::of(&s.quantity) == NavChannel::Position);
    let mut times: Vec<UtcNs> = positions.map(|s| s.valid_utc).collect();
    if times.len() < 2 {
        times = samples.iter().map(|s| s.valid_utc).collect();
    }
    times.sort();
    times.dedup();
    let mut steps: Vec<i64> = times.windows(2).map(|w| w[1].0 - w[0].0).collect();
    steps.sort();
    steps.get(steps.len() / 2).copied().unwrap_or(0)
}
