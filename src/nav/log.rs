//! Decodes recorded logs to samples, with the recorder's stamps as arrivals.
//!
//! A file holds lines of text, a packet capture, a MAVLink telemetry log, or consecutive proprietary records ([`LogKind`]). Loggers
//! write a time stamp before the sentence in different formats. The stamp is the text before the first `$` or `!` of a line. It
//! holds a date and `HH:MM:SS[.fraction]`, a time of day alone, or seconds since 1970. A line without a stamp has the arrival of
//! the line before it.
//!
//! - If the recorder's clock differs from the message times by more than `RECORDER_TOLERANCE_NS`, all stamps are shifted. The shift
//!   is a multiple of a quarter of an hour (time zone or missing date). Otherwise the shift aligns the stamps with the first dated
//!   message. For a source timed by arrival, only a missing date is corrected.
//! - A file whose clock steps back holds several passes ([`super::passes`]).
//! - In a plain log (no stamps), arrivals advance with the message times. Without message times, lines arrive at a given rate, from
//!   1970 on. Untimed sentences that repeat between two message times are spread evenly over the interval.

use std::ops::Range;

use super::capture;
use super::decoder::{ClockEvent, NavCounters, NavDecoder, SentenceEvent, ignore_events};
use super::mavlink;
use super::message_time::{JUMP_NS, nearest_day};
use super::passes::{Cut, Pass, place};
use super::stamp::{LineStamp, split_line};
use echotank_config::spec::{NavFormat, NavSourceSpec, TimePolicy};
use echotank_core::navigation::NavSample;
use echotank_core::time::{NS_PER_S, UtcNs};

const DAY_NS: i64 = 86_400 * NS_PER_S;
/// Time zones differ by multiples of a quarter of an hour.
const QUARTER_HOUR_NS: i64 = 900 * NS_PER_S;
/// Length of the shortest record (EM3000), bytes.
const MIN_RECORD_BYTES: usize = 10;
/// Maximum difference between the recorder's clock and the message times. Serial latency stays below this limit.
pub(crate) const RECORDER_TOLERANCE_NS: i64 = 2 * NS_PER_S;

/// Format of a log file, detected from its first bytes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum LogKind {
    /// Lines of text, with or without a stamp before the sentence.
    #[default]
    Text,
    /// Consecutive proprietary records.
    Binary,
    /// UDP datagrams in a packet capture.
    Capture,
    /// MAVLink telemetry.
    Tlog,
}

/// Counts of the lines, datagrams or messages of a log, and the origin of its times.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct LogCounts {
    /// Format of the file.
    pub kind: LogKind,
    /// Lines, datagrams or messages.
    pub lines: u64,
    /// Lines with a stamp.
    pub stamped: u64,
    /// Lines with a stamp earlier than the stamp before.
    pub backward: u64,
    /// Lines that do not contain the start of a sentence.
    pub no_sentence: u64,
    /// Lines of JSON (gpsd, SignalK, OpenRVDAS), which is not decoded.
    pub json: u64,
    /// Packets of a capture that are not complete UDP datagrams: TCP, fragments and truncated packets.
    pub passed_over: u64,
    /// Passes in playing order; empty if the clock does not step back.
    pub passes: Vec<Pass>,
    /// Changes of the clock of the source, by arrival.
    pub clock_events: Vec<ClockEvent>,
}

/// Format of a file from its first bytes. `format` decides for a file without a signature.
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

/// Reason why the first bytes show a file that cannot be decoded, or `None`.
pub fn refusal(bytes: &[u8]) -> Option<&'static str> {
    let compressed = "is compressed; decompress it first";
    match bytes {
        [0x1F, 0x8B, ..] => Some(compressed),
        [b'P', b'K', 3, 4, ..] | [b'B', b'Z', b'h', ..] | [0xFD, b'7', b'z', ..] => {
            Some(compressed)
        }
        [0x28, 0xB5, 0x2F, 0xFD, ..] => Some(compressed),
        [0xFF, 0xFE, ..] | [0xFE, 0xFF, ..] => Some("is UTF-16 text; convert it to UTF-8"),
        [a, 0, b, 0, ..] | [0, a, 0, b, ..] if a.is_ascii_graphic() && b.is_ascii_graphic() => {
            Some("is UTF-16 text; convert it to UTF-8")
        }
        _ => None,
    }
}

/// Unsupported binary formats: position and value of the first bytes, and name.
const UNREAD: [(usize, &[u8], &str); 14] = [
    (0, b"\x7f\x7f", "Teledyne PD0"),
    (0, b"\xff\x5a", "SBG ecom"),
    (0, b"$GRP", "Applanix"),
    (0, b"IX\x02", "iXblue STDBIN"),
    (0, b"IX\x03", "iXblue STDBIN"),
    (0, b"IX\x04", "iXblue STDBIN"),
    (0, b"IX\x05", "iXblue STDBIN"),
    (0, b"\xb5\x62", "u-blox UBX"),
    (0, b"\xaa\x44\x12", "NovAtel"),
    (0, b"#ROSBAG", "a ROS bag"),
    (0, b"\x89MCAP", "MCAP"),
    (0, b"SQLite format 3", "an SQLite database"),
    (0, b"\x89HDF", "HDF5"),
    (4, b"#", "Kongsberg KMALL"),
];
/// Number of bytes at the beginning of a file that are tested for text.
const HEAD_BYTES: usize = 4096;

/// Reason why a file without any usable sentence is not text; `None` if it may be text.
pub fn unknown_binary(bytes: &[u8], kind: LogKind) -> Option<String> {
    let head = &bytes[..bytes.len().min(HEAD_BYTES)];
    let is_control = |b: &u8| *b < 0x20 && !matches!(b, b'\t' | b'\n' | b'\r' | 0x1B);
    if kind != LogKind::Text || !head.iter().any(is_control) {
        return None;
    }
    let name = UNREAD
        .iter()
        .find(|(at, magic, _)| head.get(*at..).is_some_and(|rest| rest.starts_with(magic)));
    let what = name.map_or("of an unknown format", |(_, _, name)| name);
    Some(format!(
        "is a binary file ({what}) without sentences: only pcap, pcapng, MAVLink tlog and the records that `format` names are read"
    ))
}

/// Removes the byte order mark of UTF-8.
fn without_mark(bytes: &[u8]) -> &[u8] {
    bytes.strip_prefix(b"\xEF\xBB\xBF").unwrap_or(bytes)
}

/// Iterator over lines including their line ends: LF, CR LF, or CR alone.
struct Lines<'a>(&'a [u8]);

impl<'a> Iterator for Lines<'a> {
    type Item = &'a [u8];

    fn next(&mut self) -> Option<&'a [u8]> {
        if self.0.is_empty() {
            return None;
        }
        let end = self.0.iter().position(|b| matches!(b, b'\n' | b'\r'));
        let mut len = end.map_or(self.0.len(), |at| at + 1);
        // CR LF and CR CR LF are single line ends.
        while self.0[len - 1] == b'\r' && matches!(self.0.get(len), Some(b'\r' | b'\n')) {
            len += 1;
        }
        let (line, rest) = self.0.split_at(len);
        self.0 = rest;
        Some(line)
    }
}

/// Whether a line holds a JSON object, as gpsd, SignalK and OpenRVDAS write.
fn is_json(line: &[u8]) -> bool {
    let text = line.trim_ascii();
    text.starts_with(b"{") && text.ends_with(b"}")
}

/// Stamp, and bytes that arrived together.
type Piece<'a> = (Option<LineStamp>, &'a [u8]);

/// Splits a log into lines, datagrams, or runs of bytes short enough to hold at most one record.
fn pieces(bytes: &[u8], kind: LogKind) -> Box<dyn Iterator<Item = Piece<'_>> + '_> {
    match kind {
        LogKind::Text => Box::new(Lines(without_mark(bytes)).map(split_line)),
        LogKind::Binary => Box::new(bytes.chunks(MIN_RECORD_BYTES).map(|piece| (None, piece))),
        LogKind::Capture => Box::new(capture::packets(bytes).filter_map(|packet| {
            let stamp = Some(LineStamp::Utc(packet.arrival));
            packet.payload.map(|payload| (stamp, payload))
        })),
        LogKind::Tlog => Box::new(std::iter::empty()),
    }
}

/// Decodes a whole log to samples in file order. `source` is the index of `spec` among the navigation sources. `plain_rate_hz` is
/// the sentence rate, hertz, of a log without any times.
pub fn read_log(
    bytes: &[u8],
    source: u16,
    spec: &NavSourceSpec,
    plain_rate_hz: f64,
) -> (Vec<NavSample>, NavCounters, LogCounts) {
    read_log_watched(bytes, source, spec, plain_rate_hz, &mut ignore_events)
}

/// Like [`read_log`]. Calls `watch` for every sentence in file order, with the arrival of its line.
pub(crate) fn read_log_watched(
    bytes: &[u8],
    source: u16,
    spec: &NavSourceSpec,
    plain_rate_hz: f64,
    watch: &mut impl FnMut(&SentenceEvent),
) -> (Vec<NavSample>, NavCounters, LogCounts) {
    let kind = kind_of(bytes, spec.dialect.format);
    if kind == LogKind::Tlog {
        return read_tlog(bytes, source, spec, watch);
    }
    let start = survey(bytes, kind, source, spec);
    let mut decoder = NavDecoder::new(source, spec);
    if !start.dated_stamps {
        decoder.ignore_arrival_dates();
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
        counts.json = Lines(without_mark(bytes)).filter(|l| is_json(l)).count() as u64;
    }
    let mut samples = Vec::new();
    let mut raw = None;
    let mut plain_now = start.first_message.unwrap_or_default();
    let step_ns = NS_PER_S as f64 / plain_rate_hz;
    let mut untimed = Untimed::default();
    let spreads = !start.stamped && start.first_message.is_some();
    let mut cuts = vec![Cut { sample: 0, line: 1 }];
    let mut last_message: Option<UtcNs> = None;
    for (stamp, sentence) in pieces(bytes, kind) {
        counts.lines += 1;
        counts.no_sentence += u64::from(kind == LogKind::Text && sentence.is_empty());
        if let Some(stamp) = stamp {
            let now = advance(raw, stamp);
            counts.stamped += 1;
            counts.backward += u64::from(raw.is_some_and(|before| now < before));
            let step_ns = raw.map_or(0, |before| now.0.saturating_sub(before.0));
            if step_ns.saturating_abs() > JUMP_NS {
                cuts.push(Cut {
                    sample: samples.len(),
                    line: counts.lines,
                });
            }
            raw = Some(now);
        }
        let arrival = match raw {
            Some(now) => now.plus_ns(start.shift_ns),
            None => plain_now,
        };
        let first_new = samples.len();
        let mut watch = |event: &SentenceEvent| {
            watch(event);
            if spreads {
                untimed.record(event);
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
            let step_ns = message.0.saturating_sub(last_message.unwrap_or(message).0);
            let forward_ns = if step_ns.saturating_abs() > JUMP_NS {
                cuts.push(Cut {
                    sample: first_new,
                    line: counts.lines,
                });
                untimed.spread(first_new, untimed.last_step_ns, &mut samples);
                let moved_ns = message.0.saturating_sub(plain_now.0);
                decoder.arrivals_moved(moved_ns);
                moved_ns
            } else {
                message.0.saturating_sub(plain_now.0).max(0)
            };
            last_message = Some(message);
            if forward_ns > 0 && step_ns <= JUMP_NS {
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
    // The length of the last interval is unknown; the length of the previous interval is used.
    untimed.spread(samples.len(), untimed.last_step_ns, &mut samples);
    counts.clock_events = decoder.take_clock_events();
    if cuts.len() > 1 {
        // In a stamped log only the order of the lines may be wrong; the stamps are right.
        counts.passes = place(&mut samples, &cuts, start.stamped, &mut counts.clock_events);
    }
    (samples, *decoder.counters(), counts)
}

/// Untimed samples of a plain log since the last message time.
#[derive(Default)]
struct Untimed {
    /// Sample ranges by sentence name, one range per sentence.
    given: Vec<(String, Vec<Range<usize>>)>,
    /// Number of samples so far.
    samples: usize,
    last_step_ns: i64,
}

impl Untimed {
    fn record(&mut self, event: &SentenceEvent) {
        let count = event.taken.count_ones() as usize;
        let new = self.samples..self.samples + count;
        self.samples = new.end;
        if count == 0 || event.message_utc.is_some() {
            return;
        }
        match self.given.iter_mut().find(|(name, _)| name == event.name) {
            Some((_, ranges)) => ranges.push(new),
            None => self.given.push((event.name.to_owned(), vec![new])),
        }
    }

    /// Spreads the untimed sentences before the sample `first_new` evenly over `step_ns`. The first sentence of each name is not
    /// delayed.
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

/// Decodes a MAVLink telemetry log. Its stamps are UTC of the ground station. Its message times count from the start of the
/// vehicle; `SYSTEM_TIME` relates them to UTC.
fn read_tlog(
    bytes: &[u8],
    source: u16,
    spec: &NavSourceSpec,
    watch: &mut impl FnMut(&SentenceEvent),
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
    counts.clock_events = decoder.take_clock_events();
    (samples, *decoder.counters(), counts)
}

struct Survey {
    /// True if at least one line has a stamp.
    stamped: bool,
    /// True if the stamps have a date.
    dated_stamps: bool,
    /// Correction to add to the stamps, nanoseconds.
    shift_ns: i64,
    /// First dated message time, or else the first message time.
    first_message: Option<UtcNs>,
}

/// Reads up to the first dated message, to find the error of the recorder's clock and the start time of a plain log.
fn survey(bytes: &[u8], kind: LogKind, source: u16, spec: &NavSourceSpec) -> Survey {
    let first_stamp = pieces(bytes, kind).find_map(|(stamp, _)| stamp);
    let dated_stamps = matches!(first_stamp, Some(LineStamp::Utc(_)));
    let mut decoder = NavDecoder::new(source, spec);
    if !dated_stamps {
        decoder.ignore_arrival_dates();
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

/// Recorder time after a stamp. A stamp without a date is on the day nearest to the time before, or on 1970-01-01 if it is the first.
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
    fn lines_end_at_lf_cr_lf_or_cr() {
        let lines: Vec<&[u8]> = Lines(b"a\nb\r\nc\rd\r\r\n\n\re").collect();
        let want: [&[u8]; 7] = [b"a\n", b"b\r\n", b"c\r", b"d\r\r\n", b"\n", b"\r", b"e"];
        assert_eq!(lines, want);
    }

    #[test]
    fn binary_files_without_sentences_are_named() {
        let of = |bytes: &[u8]| unknown_binary(bytes, LogKind::Text);
        let pd0 = of(b"\x7f\x7f\x00\x01\x02").expect("binary");
        assert!(pd0.contains("Teledyne PD0"), "{pd0}");
        assert!(of(b"\x01\x02").is_some_and(|why| why.contains("unknown format")));
        assert_eq!(of(b"$GPGGA,1*00\r\n\x1b[0m"), None);
        assert_eq!(of("# Überschrift\n".as_bytes()), None);
        assert_eq!(unknown_binary(b"\x01", LogKind::Binary), None);
    }

    #[test]
    fn refuses_compressed_files_and_utf_16() {
        assert!(refusal(&[0x1F, 0x8B, 8, 0]).is_some_and(|why| why.contains("compressed")));
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
