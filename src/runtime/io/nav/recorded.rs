//! Recorded sources: read completely, decoded once, merged by arrival time, and repeated on request.

use std::fs::File;
use std::io::Read;
use std::path::Path;

use super::{Feed, NavOpenError, SourceCounters};
use echotank_config::spec::{NavChannel, NavInputSpec, NavSourceSpec, NavSpec};
use echotank_core::navigation::{NavQuantity, NavSample};
use echotank_core::time::UtcNs;
use echotank_nav::NavCounters;
use echotank_nav::log::{read_log, refusal};
use echotank_nav::track::read_track;

/// Largest file read, bytes. An hour of 100 Hz attitude is 30 MB; a day, 700 MB, should be cut.
const MAX_FILE_BYTES: u64 = 256 << 20;

pub(super) struct Recorded {
    /// Sorted by arrival.
    samples: Vec<NavSample>,
    next: usize,
    /// Offset of all times in the current loop.
    shift_ns: i64,
    repeat: Option<Repeat>,
}

#[derive(Clone, Copy)]
struct Repeat {
    period_ns: i64,
    /// From the last validity time of a loop to the first of the next, in the first loop's time.
    seam: UtcNs,
}

impl Recorded {
    /// `None` without recorded sources.
    pub(super) fn open(
        spec: &NavSpec,
        counters: &mut [SourceCounters],
    ) -> Result<Option<Self>, NavOpenError> {
        let mut samples = Vec::new();
        for (i, source) in spec.sources.iter().enumerate() {
            // Source indices fit in 16 bits.
            let index = u16::try_from(i).unwrap_or(u16::MAX);
            samples.append(&mut read_source(index, source, &mut counters[i])?);
        }
        if samples.is_empty() {
            return Ok(None);
        }
        let repeat = if spec.loop_log {
            Some(prepare_to_repeat(&mut samples)?)
        } else {
            None
        };
        samples.sort_by_key(|s| s.arrival_utc);
        Ok(Some(Self {
            samples,
            next: 0,
            shift_ns: 0,
            repeat,
        }))
    }

    pub(super) fn start(&self) -> UtcNs {
        self.samples[0].arrival_utc
    }

    pub(super) fn end(&self) -> UtcNs {
        self.samples[self.samples.len() - 1].arrival_utc
    }

    pub(crate) fn next_arrival(&self) -> Option<UtcNs> {
        if let Some(sample) = self.samples.get(self.next) {
            return Some(sample.arrival_utc.plus_ns(self.shift_ns));
        }
        let repeat = self.repeat?;
        Some(self.start().plus_ns(self.shift_ns + repeat.period_ns))
    }

    /// Inserts the next sample into the history, if there is one.
    pub(super) fn take(&mut self, feed: &mut Feed) {
        if self.next == self.samples.len()
            && let Some(repeat) = self.repeat
        {
            feed.seam(repeat.seam.plus_ns(self.shift_ns));
            self.shift_ns += repeat.period_ns;
            self.next = 0;
        }
        let Some(sample) = self.samples.get(self.next) else {
            return;
        };
        self.next += 1;
        feed.insert(&NavSample {
            valid_utc: sample.valid_utc.plus_ns(self.shift_ns),
            arrival_utc: sample.arrival_utc.plus_ns(self.shift_ns),
            ..*sample
        });
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
            if let Some(why) = refusal(&bytes) {
                let problem = format!("{} {why}", path.display());
                return Err(NavOpenError::source(&source.name, problem));
            }
            let (samples, decoder, log) = read_log(&bytes, index, source, *plain_rate_hz);
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
    let file = path.display();
    let refused = |reason: std::io::Error| {
        NavOpenError::source(name, format!("cannot read {file}: {reason}"))
    };
    let mut bytes = Vec::new();
    // Reading one byte more than the limit bounds pipes and growing files too.
    File::open(path)
        .and_then(|file| file.take(MAX_FILE_BYTES + 1).read_to_end(&mut bytes))
        .map_err(refused)?;
    if bytes.len() as u64 > MAX_FILE_BYTES {
        let len = std::fs::metadata(path).map_or(bytes.len() as u64, |m| m.len());
        let problem = format!("{file} has {len} bytes; at most {MAX_FILE_BYTES} are read");
        return Err(NavOpenError::source(name, problem));
    }
    Ok(bytes)
}

/// Cuts the samples to the period that all channels cover. A loop repeats after one further median interval of the positions (of all samples without
/// positions).
fn prepare_to_repeat(samples: &mut Vec<NavSample>) -> Result<Repeat, NavOpenError> {
    let mut spans: Vec<(Channel, UtcNs, UtcNs)> = Vec::new();
    for s in samples.iter() {
        let channel = (s.source, channel(s));
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

fn channel(sample: &NavSample) -> NavChannel {
    match sample.quantity {
        NavQuantity::Position { .. } | NavQuantity::LocalPosition { .. } => NavChannel::Position,
        NavQuantity::CourseSpeed { .. } => NavChannel::CourseSpeed,
        NavQuantity::Heading { .. } => NavChannel::Heading,
        NavQuantity::RollPitch { .. } => NavChannel::RollPitch,
        NavQuantity::Heave { .. } => NavChannel::Heave,
        NavQuantity::Depth { .. } => NavChannel::Depth,
    }
}

fn median_interval_ns(samples: &[NavSample]) -> i64 {
    let positions = samples
        .iter()
        .filter(|s| channel(s) == NavChannel::Position);
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
