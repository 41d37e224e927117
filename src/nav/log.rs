//! Recorded logs to samples. Comes in: a whole file. Goes out: its samples with the recorder's stamps as arrivals.
//!
//! Loggers put a time before the sentence, each in its own way. Whatever precedes the first `$` or `!` of a line is searched for
//! `YYYY-MM-DD?HH:MM:SS[.fraction]`, else for `HH:MM:SS[.fraction]`. A line without either arrives with the line before it.
//!
//! - A recorder whose clock is more than [`RECORDER_TOLERANCE_NS`] off the messages is shifted as a whole: by the quarters of an hour of a
//!   time zone or a missing date, else onto the first dated message. A source taken by arrival has only a missing date mended.
//! - A plain log (no stamps) arrives as its message times advance; one without message times at a given rate, from 1970 on.

use super::decoder::{NavCounters, NavDecoder};
use super::fields::{fraction_ns, time_of_day_ns};
use super::message_time::nearest_day;
use crate::config::spec::{NavSourceSpec, TimePolicy};
use crate::flow::NavSample;
use crate::time::{NS_PER_S, UtcNs};

const DAY_NS: i64 = 86_400 * NS_PER_S;
/// Time zones differ by multiples of this.
const QUARTER_HOUR_NS: i64 = 900 * NS_PER_S;
/// Above this the recorder's clock and the messages do not share a time; serial latency stays below it.
pub const RECORDER_TOLERANCE_NS: i64 = 2 * NS_PER_S;

/// What a log's lines were.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LogCounts {
    pub lines: u64,
    /// Lines with a recorder's stamp.
    pub stamped: u64,
    /// Lines stamped before their predecessor.
    pub backward: u64,
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

/// Decodes a whole log. Returned samples are in the file's order.
pub fn read_log(
    bytes: &[u8],
    source: u16,
    spec: &NavSourceSpec,
    plain_rate_hz: f64,
) -> (Vec<NavSample>, NavCounters, LogCounts) {
    let start = survey(bytes, source, spec);
    let mut decoder = NavDecoder::new(source, spec);
    let mut counts = LogCounts::default();
    let mut samples = Vec::new();
    let mut raw = None;
    let mut plain_now = start.first_message.unwrap_or_default();
    let step_ns = NS_PER_S as f64 / plain_rate_hz;
    for line in bytes.split_inclusive(|&b| b == b'\n') {
        let (stamp, sentence) = split_line(line);
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
        decoder.push(sentence, arrival, &mut samples);
        decoder.flush(&mut samples);
        if start.stamped {
            continue;
        }
        if let (Some(_), Some((message, _))) = (start.first_message, decoder.last_message_time()) {
            let forward_ns = message.0.saturating_sub(plain_now.0).max(0);
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
    (samples, *decoder.counters(), counts)
}

struct Survey {
    /// Some line has a recorder's stamp.
    stamped: bool,
    /// Added to the recorder's stamps.
    shift_ns: i64,
    /// The first dated message time, else the first one.
    first_message: Option<UtcNs>,
}

/// Reads on until the first dated message: how far the recorder's clock is off, and where a plain log starts.
fn survey(bytes: &[u8], source: u16, spec: &NavSourceSpec) -> Survey {
    let mut decoder = NavDecoder::new(source, spec);
    let mut ignored = Vec::new();
    let mut raw = None;
    let mut date_missing = false;
    let mut first = None;
    for line in bytes.split_inclusive(|&b| b == b'\n') {
        let (stamp, sentence) = split_line(line);
        if let Some(stamp) = stamp {
            date_missing |= matches!(stamp, LineStamp::TimeOfDay(_));
            raw = Some(advance(raw, stamp));
        }
        decoder.push(sentence, raw.unwrap_or_default(), &mut ignored);
        decoder.flush(&mut ignored);
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
    let colon = text.find(':')?;
    let clock_at = colon.checked_sub(2)?;
    let time_ns = clock(text.get(clock_at..)?)?;
    let date = clock_at
        .checked_sub(11)
        .and_then(|at| text.get(at..at + 10))
        .and_then(|t| chrono::NaiveDate::parse_from_str(t, "%Y-%m-%d").ok());
    let Some(date) = date else {
        return Some(LineStamp::TimeOfDay(time_ns));
    };
    let midnight = date
        .and_time(chrono::NaiveTime::MIN)
        .and_utc()
        .timestamp_nanos_opt()?;
    Some(LineStamp::Utc(UtcNs(midnight.saturating_add(time_ns))))
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
        assert_eq!(stamp("99:99:99 $HEHDT,218.53,T*12"), None);
        assert_eq!(stamp("# Title: 12:00:00"), None, "no sentence, no stamp");
    }

    #[test]
    fn the_sentence_is_the_rest_of_the_line() {
        let (_, rest) = split_line(b"18:58:39.006 $A,1*00$B,2\r\n");
        assert_eq!(rest, b"$A,1*00$B,2\r\n");
    }
}
