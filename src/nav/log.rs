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
use super::fields::{fraction_ns, time_of_day_ns};
use super::mavlink;
use super::message_time::nearest_day;
use crate::config::spec::{NavFormat, NavSourceSpec, TimePolicy};
use crate::flow::NavSample;
use crate::time::{NS_PER_S, UtcNs};

const DAY_NS: i64 = 86_400 * NS_PER_S;
/// Time zones differ by multiples of this.
const QUARTER_HOUR_NS: i64 = 900 * NS_PER_S;
/// Bytes; of EM3000.
const SHORTEST_RECORD: usize = 10;
/// Above this the recorder's clock and the messages do not share a time; serial latency stays below it.
pub const RECORDER_TOLERANCE_NS: i64 = 2 * NS_PER_S;

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
    /// Packets of a capture that are no whole UDP datagram: TCP, fragments, cut ones.
    pub passed_over: u64,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LineStamp {
    Utc(UtcNs),
    /// Nanoseconds since midnight, no date.
    TimeOfDay(i64),
}

/// A line as recorded: its stamp, if any, and what follows, from the sentence's start on (empty if there is none).
pub fn split_line(line: &[u8]) -> (Option<LineStamp>, &[u8]) {
    let start = line
        .iter()
        .position(|b| matches!(b, b'$' | b'!'))
        .unwrap_or(line.len());
    let (before, sentence) = line.split_at(start);
    let stamp = (!sentence.is_empty()).then(|| find_stamp(before)).flatten();
    (stamp, sentence)
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

/// Bytes that came together.
type Piece<'a> = (Option<LineStamp>, &'a [u8]);

/// A log's pieces: lines, datagrams, or runs of records short enough to hold at most one.
fn pieces(bytes: &[u8], kind: LogKind) -> Box<dyn Iterator<Item = Piece<'_>> + '_> {
    match kind {
        LogKind::Text => Box::new(bytes.split_inclusive(|&b| b == b'\n').map(split_line)),
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
pub fn read_log_watched(
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
    let mut samples = Vec::new();
    let mut raw = None;
    let mut plain_now = start.first_message.unwrap_or_default();
    let step_ns = NS_PER_S as f64 / plain_rate_hz;
    let mut untimed = Untimed::default();
    let spreads = !start.stamped && start.first_message.is_some();
    for (stamp, sentence) in pieces(bytes, kind) {
        counts.lines += 1;
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

fn find_stamp(prefix: &[u8]) -> Option<LineStamp> {
    // Loggers' stamps are ASCII and stand near the front.
    let text = std::str::from_utf8(prefix).ok()?;
    if !text.is_ascii() {
        return None;
    }
    let Some((clock_at, time_ns)) = find_clock(text) else {
        return seconds_stamp(text);
    };
    let date = date_before(&text[..clock_at]);
    let Some(date) = date else {
        return Some(LineStamp::TimeOfDay(time_ns));
    };
    let midnight = date
        .and_time(chrono::NaiveTime::MIN)
        .and_utc()
        .timestamp_nanos_opt()?;
    Some(LineStamp::Utc(UtcNs(midnight.saturating_add(time_ns))))
}

/// The first HH:MM:SS that is not the tail of a longer number.
fn find_clock(text: &str) -> Option<(usize, i64)> {
    let starts = text.match_indices(':').filter_map(|(at, _)| {
        let start = at.checked_sub(2)?;
        let before = start.checked_sub(1).map(|b| text.as_bytes()[b]);
        (!before.is_some_and(|b| b.is_ascii_digit())).then_some(start)
    });
    starts
        .into_iter()
        .find_map(|at| clock(&text[at..]).map(|ns| (at, ns)))
}

/// The date that ends where the clock begins, one character between: `YYYY-MM-DD`, `YYYY/MM/DD`, `MM/DD/YYYY` (SCS), `YYYY:DDD` (RVDAS).
fn date_before(text: &str) -> Option<chrono::NaiveDate> {
    let tail = |len: usize| {
        text.len()
            .checked_sub(len + 1)
            .map(|at| &text[at..at + len])
    };
    if let Some(ten) = tail(10) {
        for form in ["%Y-%m-%d", "%Y/%m/%d", "%m/%d/%Y"] {
            if let Ok(date) = chrono::NaiveDate::parse_from_str(ten, form) {
                return Some(date);
            }
        }
    }
    let eight = tail(8)?;
    if text.ends_with(':') {
        return chrono::NaiveDate::parse_from_str(eight, "%Y:%j").ok();
    }
    None
}

/// Seconds since 1970 before the sentence, alone or in a TAG block (`c:`), there also in milliseconds.
fn seconds_stamp(text: &str) -> Option<LineStamp> {
    let tag = text.split_once("c:").map(|(_, rest)| rest);
    let number = match tag {
        Some(rest) => rest.split(|c: char| !c.is_ascii_digit()).next()?,
        None => text.trim_start().split([' ', '\t', ',']).next()?,
    };
    let (whole, fraction) = number.split_once('.').unwrap_or((number, ""));
    let digits = |t: &str| t.bytes().all(|b| b.is_ascii_digit());
    if !digits(whole) || !digits(fraction) {
        return None;
    }
    let ns = match (whole.len(), tag.is_some()) {
        (10, _) => whole.parse::<i64>().ok()?.checked_mul(NS_PER_S)?,
        (13, true) => whole.parse::<i64>().ok()?.checked_mul(NS_PER_S / 1000)?,
        _ => return None,
    };
    Some(LineStamp::Utc(UtcNs(ns + fraction_ns(fraction))))
}

/// HH:MM:SS[.fraction] at the front of `text`, nanoseconds since midnight.
fn clock(text: &str) -> Option<i64> {
    let bytes = text.as_bytes();
    if bytes.len() < 8 || bytes[2] != b':' || bytes[5] != b':' {
        return None;
    }
    let digits = [bytes[0], bytes[1], bytes[3], bytes[4], bytes[6], bytes[7]];
    let whole_ns = time_of_day_ns(std::str::from_utf8(&digits).ok()?)?;
    let fraction = text.get(8..)?.strip_prefix(['.', ',']).unwrap_or("");
    let end = fraction
        .find(|c: char| !c.is_ascii_digit())
        .unwrap_or(fraction.len());
    Some(whole_ns + fraction_ns(&fraction[..end]))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn stamp(line: &str) -> Option<LineStamp> {
        split_line(line.as_bytes()).0
    }
    const D: i64 = 1_406_851_200 * NS_PER_S; // 2014-08-01

    #[test]
    fn stamps_of_several_loggers_are_found() {
        let utc = |ns: i64| Some(LineStamp::Utc(UtcNs(D + ns)));
        assert_eq!(
            stamp("2014-08-01T00:00:00.183000Z $HEHDT,218.53,T*12\n"),
            utc(183_000_000)
        );
        assert_eq!(
            stamp("2014-08-01 00:00:01,5 | DEBUG | __main__:recv:49 - $GPHDT,,*4F"),
            utc(1_500_000_000)
        );
        let day = |s: i64, ns: i64| Some(LineStamp::TimeOfDay(s * NS_PER_S + ns));
        assert_eq!(stamp("18:58:39.006 $STATUS,0"), day(68_319, 6_000_000));
        assert_eq!(stamp("$HEHDT,218.53,T*12"), None);
        assert_eq!(
            stamp("2014:213:00:00:00.250 $A,1"),
            utc(250_000_000),
            "RVDAS"
        );
        assert_eq!(
            stamp("08/01/2014,00:00:00.250,$A,1"),
            utc(250_000_000),
            "SCS"
        );
        assert_eq!(
            stamp("NAV 2014/08/01 00:00:00.25 NMEA $A,1"),
            utc(250_000_000),
            "DSLog"
        );
        assert_eq!(stamp("1406851200.25 $A,1"), utc(250_000_000));
        assert_eq!(stamp("\\s:GN,c:1406851200*12\\$A,1"), utc(0), "TAG block");
        assert_eq!(
            stamp("\\c:1406851200250*12\\$A,1"),
            utc(250_000_000),
            "TAG block"
        );
        assert_eq!(stamp("12 $A,1"), None);
        assert_eq!(stamp("99:99:99 $HEHDT,218.53,T*12"), None);
        assert_eq!(stamp("# Title: 12:00:00"), None, "no sentence, no stamp");
    }

    #[test]
    fn the_sentence_is_the_rest_of_the_line() {
        let (_, rest) = split_line(b"18:58:39.006 $A,1*00$B,2\r\n");
        assert_eq!(rest, b"$A,1*00$B,2\r\n");
    }
}
