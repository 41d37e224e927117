//! Recorded logs to samples. Comes in: a whole file. Goes out: its samples with the recorder's stamps as arrivals.
//!
//! A file is lines of text, a packet capture, a MAVLink telemetry log, or records of one maker back to back ([`LogKind`]). Loggers put a
//! time before the sentence, each in its own way: whatever precedes the first `$` or `!` of a line is searched for a date and
//! `HH:MM:SS[.fraction]`, for the clock alone, or for seconds since 1970. A line without any arrives with the line before it.
//!
//! - A recorder whose clock is more than [`RECORDER_TOLERANCE_NS`] off the messages is shifted as a whole: by the quarters of an hour of a
//!   time zone or a missing date, else onto the first dated message. A source taken by arrival has only a missing date mended.
//! - A plain log (no stamps) arrives as its message times advance; one without message times at a given rate, from 1970 on. Sentences without
//!   a time that come several times between two such advances are spread evenly over the time between.

use std::ops::Range;

use super::capture;
use super::decoder::{Heard, NavCounters, NavDecoder, unwatched};
use super::mavlink;
use super::message_time::nearest_day;
use super::stamp::{LineStamp, split_line};
use echotank_config::spec::{NavFormat, NavSourceSpec, TimePolicy};
use echotank_core::flow::NavSample;
use echotank_core::time::{NS_PER_S, UtcNs};

const DAY_NS: i64 = 86_400 * NS_PER_S;
/// Time zones differ by multiples of this.
const QUARTER_HOUR_NS: i64 = 900 * NS_PER_S;
/// Bytes; of EM3000.
const SHORTEST_RECORD: usize = 10;
/// Above this the recorder's clock and the messages do not share a time; serial latency stays below it.
pub(crate) const RECORDER_TOLERANCE_NS: i64 = 2 * NS_PER_S;

/// What kind of file a log is; told from its first bytes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum LogKind {
    /// Lines, with a recorder's stamp before the sentence or without.
    #[default]
    Text,
    /// Records of one maker back to back.
    Binary,
    /// A packet capture: UDP datagrams.
    Capture,
    /// A MAVLink telemetry log.
    Tlog,
}

/// What a log's lines (datagrams, messages) were.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LogCounts {
    pub kind: LogKind,
    pub lines: u64,
    /// Lines with a recorder's stamp.
    pub stamped: u64,
    /// Lines stamped before their predecessor.
    pub backward: u64,
    /// Lines in which no sentence begins.
    pub no_sentence: u64,
    /// Of those: JSON (gpsd, SignalK, OpenRVDAS), which is not read.
    pub json: u64,
    /// Packets of a capture that are no whole UDP datagram: TCP, fragments, cut ones.
    pub passed_over: u64,
}

/// Told from the first bytes; `format` says what a log without such a mark holds.
pub fn kind_of(bytes: &[u8], format: NavFormat) -> LogKind {
    if capture::is_capture(bytes) {
        LogKind::Capture
    } else if mavlink::is_tlog(bytes) {
        LogKind::Tlog
    } else if format == NavFormat::Nmea {
        LogKind::Text
    } else {
        LogKind::Binary
    }
}

/// Why a file is no log that can be read, where its first bytes tell.
pub fn refusal(bytes: &[u8]) -> Option<&'static str> {
    let packed = "is packed; unpack it first";
    match bytes {
        [0x1F, 0x8B, ..] => Some(packed),
        [b'P', b'K', 3, 4, ..] | [b'B', b'Z', b'h', ..] | [0xFD, b'7', b'z', ..] => Some(packed),
        [0x28, 0xB5, 0x2F, 0xFD, ..] => Some(packed),
        [0xFF, 0xFE, ..] | [0xFE, 0xFF, ..] => Some("is UTF-16 text; convert it to UTF-8"),
        [a, 0, b, 0, ..] | [0, a, 0, b, ..] if a.is_ascii_graphic() && b.is_ascii_graphic() => {
            Some("is UTF-16 text; convert it to UTF-8")
        }
        _ => None,
    }
}

/// Without UTF-8's byte order mark.
fn unmarked(bytes: &[u8]) -> &[u8] {
    bytes.strip_prefix(b"\xEF\xBB\xBF").unwrap_or(bytes)
}

/// Lines with their ends: LF, CR LF, or CR alone.
struct Lines<'a>(&'a [u8]);

impl<'a> Iterator for Lines<'a> {
    type Item = &'a [u8];

    fn next(&mut self) -> Option<&'a [u8]> {
        if self.0.is_empty() {
            return None;
        }
        let end = self.0.iter().position(|b| matches!(b, b'\n' | b'\r'));
        let mut len = end.map_or(self.0.len(), |at| at + 1);
        // CR LF is one end, and so is CR CR LF.
        while self.0[len - 1] == b'\r' && matches!(self.0.get(len), Some(b'\r' | b'\n')) {
            len += 1;
        }
        let (line, rest) = self.0.split_at(len);
        self.0 = rest;
        Some(line)
    }
}

/// A line of JSON: gpsd, SignalK, OpenRVDAS records.
fn is_json(line: &[u8]) -> bool {
    let text = line.trim_ascii();
    text.starts_with(b"{") && text.ends_with(b"}")
}

/// Bytes that came together.
type Piece<'a> = (Option<LineStamp>, &'a [u8]);

/// A log's pieces: lines, datagrams, or runs of records short enough to hold at most one.
fn pieces(bytes: &[u8], kind: LogKind) -> Box<dyn Iterator<Item = Piece<'_>> + '_> {
    match kind {
        LogKind::Text => Box::new(Lines(unmarked(bytes)).map(split_line)),
        LogKind::Binary => Box::new(bytes.chunks(SHORTEST_RECORD).map(|piece| (None, piece))),
        LogKind::Capture => Box::new(capture::packets(bytes).filter_map(|packet| {
            let stamp = Some(LineStamp::Utc(packet.arrival));
            packet.payload.map(|payload| (stamp, payload))
        })),
        LogKind::Tlog => Box::new(std::iter::empty()),
    }
}

/// Decodes a whole log. Returned samples are in the file's order.
pub fn read_log(
    bytes: &[u8],
    source: u16,
    spec: &NavSourceSpec,
    plain_rate_hz: f64,
) -> (Vec<NavSample>, NavCounters, LogCounts) {
    read_log_watched(bytes, source, spec, plain_rate_hz, &mut unwatched)
}

/// The same; `watch` is told of every sentence, in the file's order, with the arrival that its line says.
pub(crate) fn read_log_watched(
    bytes: &[u8],
    source: u16,
    spec: &NavSourceSpec,
    plain_rate_hz: f64,
    watch: &mut impl FnMut(&Heard),
) -> (Vec<NavSample>, NavCounters, LogCounts) {
    let kind = kind_of(bytes, spec.dialect.format);
    if kind == LogKind::Tlog {
        return read_tlog(bytes, source, spec, watch);
    }
    let start = survey(bytes, kind, source, spec);
    let mut decoder = NavDecoder::new(source, spec);
    if !start.dated_stamps {
        decoder.distrust_arrivals();
    }
    let mut counts = LogCounts {
        kind,
        ..LogCounts::default()
    };
    if kind == LogKind::Capture {
        let passed_over = capture::packets(bytes).filter(|p| p.payload.is_none());
        counts.passed_over = passed_over.count() as u64;
    }
    if kind == LogKind::Text {
        counts.json = Lines(unmarked(bytes)).filter(|l| is_json(l)).count() as u64;
    }
    let mut samples = Vec::new();
    let mut raw = None;
    let mut plain_now = start.first_message.unwrap_or_default();
    let step_ns = NS_PER_S as f64 / plain_rate_hz;
    let mut untimed = Untimed::default();
    let spreads = !start.stamped && start.first_message.is_some();
    for (stamp, sentence) in pieces(bytes, kind) {
        counts.lines += 1;
        counts.no_sentence += u64::from(kind == LogKind::Text && sentence.is_empty());
        if let Some(stamp) = stamp {
            let now = advance(raw, stamp);
            counts.stamped += 1;
            counts.backward += u64::from(raw.is_some_and(|before| now < before));
            raw = Some(now);
        }
        let arrival = match raw {
            Some(now) => now.plus_ns(start.shift_ns),
            None => plain_now,
        };
        let first_new = samples.len();
        let mut watch = |heard: &Heard| {
            watch(heard);
            if spreads {
                untimed.hear(heard);
            }
        };
        decoder.push_paced(sentence, arrival, 0, &mut samples, &mut watch);
        if kind != LogKind::Binary {
            decoder.flush_watched(&mut samples, &mut watch);
        }
        if start.stamped {
            continue;
        }
        if let (Some(_), Some((message, _))) = (start.first_message, decoder.last_message_time()) {
            let forward_ns = message.0.saturating_sub(plain_now.0).max(0);
            if forward_ns > 0 {
                untimed.spread(first_new, forward_ns, &mut samples);
            }
            plain_now = plain_now.plus_ns(forward_ns);
            for sample in &mut samples[first_new..] {
                sample.arrival_utc = plain_now;
                if matches!(spec.time, TimePolicy::Arrival { .. }) {
                    sample.valid_utc = sample.valid_utc.plus_ns(forward_ns);
                }
            }
        } else if start.first_message.is_none() && !sentence.is_empty() {
            let lines = decoder.counters().sentences as f64;
            plain_now = UtcNs((lines * step_ns).round() as i64);
        }
    }
    decoder.flush_watched(&mut samples, watch);
    // Nothing says how long the last stretch was: as long as the one before.
    untimed.spread(samples.len(), untimed.last_step_ns, &mut samples);
    (samples, *decoder.counters(), counts)
}

/// Samples of a plain log without a time of their own, since the last message with one.
#[derive(Default)]
struct Untimed {
    /// By sentence: where the samples lie that each of its kind gave.
    given: Vec<(String, Vec<Range<usize>>)>,
    /// Samples given so far.
    samples: usize,
    last_step_ns: i64,
}

impl Untimed {
    fn hear(&mut self, heard: &Heard) {
        let count = heard.taken.count_ones() as usize;
        let new = self.samples..self.samples + count;
        self.samples = new.end;
        if count == 0 || heard.message_utc.is_some() {
            return;
        }
        match self.given.iter_mut().find(|(name, _)| name == heard.name) {
            Some((_, ranges)) => ranges.push(new),
            None => self.given.push((heard.name.to_owned(), vec![new])),
        }
    }

    /// The message time advances by `step_ns` at the sample `first_new`: the sentences before it came evenly, the first of each kind at once.
    fn spread(&mut self, first_new: usize, step_ns: i64, samples: &mut [NavSample]) {
        self.last_step_ns = step_ns;
        for (_, ranges) in &mut self.given {
            let before = ranges.partition_point(|r| r.end <= first_new);
            for (k, range) in ranges.drain(..before).enumerate() {
                let late_ns = (i128::from(step_ns) * k as i128 / before as i128) as i64;
                for sample in &mut samples[range] {
                    sample.arrival_utc = sample.arrival_utc.plus_ns(late_ns);
                    sample.valid_utc = sample.valid_utc.plus_ns(late_ns);
                }
            }
        }
    }
}

/// A tlog's stamps are the ground station's UTC; its messages count from the vehicle's start, which `SYSTEM_TIME` ties to UTC.
fn read_tlog(
    bytes: &[u8],
    source: u16,
    spec: &NavSourceSpec,
    watch: &mut impl FnMut(&Heard),
) -> (Vec<NavSample>, NavCounters, LogCounts) {
    let mut decoder = NavDecoder::new(source, spec);
    let mut samples = Vec::new();
    let mut counts = LogCounts {
        kind: LogKind::Tlog,
        ..LogCounts::default()
    };
    let mut messages = mavlink::Messages::new(bytes);
    let mut before = None;
    for message in &mut messages {
        counts.lines += 1;
        counts.stamped += 1;
        let arrival = message.record.arrival;
        counts.backward += u64::from(before.is_some_and(|before| arrival < before));
        before = Some(arrival);
        decoder.push_record(&message.name, &message.record, &mut samples, watch);
    }
    decoder.count_bytes(bytes.len() as u64, messages.resync_bytes());
    (samples, *decoder.counters(), counts)
}

struct Survey {
    /// Some line has a recorder's stamp.
    stamped: bool,
    /// The stamps carry a date.
    dated_stamps: bool,
    /// Added to the recorder's stamps.
    shift_ns: i64,
    /// The first dated message time, else the first one.
    first_message: Option<UtcNs>,
}

/// Reads on until the first dated message: how far the recorder's clock is off, and where a plain log starts.
fn survey(bytes: &[u8], kind: LogKind, source: u16, spec: &NavSourceSpec) -> Survey {
    let first_stamp = pieces(bytes, kind).find_map(|(stamp, _)| stamp);
    let dated_stamps = matches!(first_stamp, Some(LineStamp::Utc(_)));
    let mut decoder = NavDecoder::new(source, spec);
    if !dated_stamps {
        decoder.distrust_arrivals();
    }
    let mut ignored = Vec::new();
    let mut raw = None;
    let mut date_missing = false;
    let mut first = None;
    for (stamp, sentence) in pieces(bytes, kind) {
        if let Some(stamp) = stamp {
            date_missing |= matches!(stamp, LineStamp::TimeOfDay(_));
            raw = Some(advance(raw, stamp));
        }
        decoder.push(sentence, raw.unwrap_or_default(), &mut ignored);
        if kind != LogKind::Binary {
            decoder.flush(&mut ignored);
        }
        ignored.clear();
        first = first.or(decoder.last_message_time());
        if decoder.is_dated() {
            first = decoder.last_message_time();
            break;
        }
    }
    let offset_ns = first.map_or(0, |(message, arrival)| message.0.saturating_sub(arrival.0));
    let whole = |unit_ns: i64| (offset_ns as f64 / unit_ns as f64).round() as i64 * unit_ns;
    let shift_ns = if matches!(spec.time, TimePolicy::Arrival { .. }) {
        if date_missing { whole(DAY_NS) } else { 0 }
    } else {
        let zone_ns = whole(QUARTER_HOUR_NS);
        let rest_ns = offset_ns.saturating_sub(zone_ns).saturating_abs();
        if rest_ns <= RECORDER_TOLERANCE_NS {
            zone_ns
        } else {
            offset_ns
        }
    };
    Survey {
        stamped: raw.is_some(),
        dated_stamps,
        shift_ns,
        first_message: first.map(|(message, _)| message),
    }
}

/// The recorder's clock after this stamp; without a date it starts on 1970-01-01 and wraps at midnight.
fn advance(before: Option<UtcNs>, stamp: LineStamp) -> UtcNs {
    match stamp {
        LineStamp::Utc(utc) => utc,
        LineStamp::TimeOfDay(ns) => match before {
            Some(before) => nearest_day(ns, before),
            None => UtcNs(ns),
        },
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_end_in_any_of_the_three_ways() {
        let lines: Vec<&[u8]> = Lines(b"a\nb\r\nc\rd\r\r\n\n\re").collect();
        let want: [&[u8]; 7] = [b"a\n", b"b\r\n", b"c\r", b"d\r\r\n", b"\n", b"\r", b"e"];
        assert_eq!(lines, want);
    }

    #[test]
    fn packed_files_and_utf_16_are_told_from_logs() {
        assert!(refusal(&[0x1F, 0x8B, 8, 0]).is_some_and(|why| why.contains("packed")));
        assert!(refusal(b"\xFF\xFE$\0G\0").is_some_and(|why| why.contains("UTF-16")));
        assert!(refusal(b"$\0G\0P\0").is_some_and(|why| why.contains("UTF-16")));
        for log in [
            &b"$GPGGA"[..],
            b"",
            b"\xEF\xBB\xBF$GPGGA",
            b"# Title",
            &[0xFE],
        ] {
            assert_eq!(refusal(log), None);
        }
    }
}
