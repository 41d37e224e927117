//! Parses the time stamp that a logger wrote before a sentence.

use super::fields::{fraction_ns, time_of_day_ns};
use echotank_core::time::{NS_PER_S, UtcNs};

/// Time stamp of a line.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LineStamp {
    /// Date and time.
    Utc(UtcNs),
    /// Time of day without a date, nanoseconds since midnight.
    TimeOfDay(i64),
}

/// Splits a line into its stamp, if any, and the rest from the start of the sentence. The rest is empty if the line has no
/// sentence.
pub fn split_line(line: &[u8]) -> (Option<LineStamp>, &[u8]) {
    let start = line
        .iter()
        .position(|b| matches!(b, b'$' | b'!'))
        .unwrap_or(line.len());
    let (before, sentence) = line.split_at(start);
    let stamp = (!sentence.is_empty()).then(|| find_stamp(before)).flatten();
    (stamp, sentence)
}

fn find_stamp(prefix: &[u8]) -> Option<LineStamp> {
    // Stamps are ASCII text near the start of the line.
    let text = std::str::from_utf8(prefix).ok()?;
    if !text.is_ascii() {
        return None;
    }
    let Some((clock_at, time_ns)) = find_clock(text) else {
        return seconds_stamp(text).or_else(|| compact(text).map(|ns| LineStamp::Utc(UtcNs(ns))));
    };
    let date = date_before(&text[..clock_at]);
    let Some(date) = date else {
        return Some(LineStamp::TimeOfDay(time_ns));
    };
    let midnight = date
        .and_time(chrono::NaiveTime::MIN)
        .and_utc()
        .timestamp_nanos_opt()?;
    let utc_ns = midnight.saturating_add(time_ns - zone_ns(&text[clock_at + 8..]));
    Some(LineStamp::Utc(UtcNs(utc_ns)))
}

/// Position and value of the first HH:MM:SS that is not the end of a longer number. A time of day after a date is preferred
/// (`2014-08-01:00:00:01`).
fn find_clock(text: &str) -> Option<(usize, i64)> {
    let clocks = || {
        text.match_indices(':').filter_map(|(at, _)| {
            let start = at.checked_sub(2)?;
            let before = start.checked_sub(1).map(|b| text.as_bytes()[b]);
            let whole = !before.is_some_and(|b| b.is_ascii_digit());
            clock(&text[start..])
                .filter(|_| whole)
                .map(|ns| (start, ns))
        })
    };
    let dated = clocks().find(|(at, _)| date_before(&text[..*at]).is_some());
    dated.or_else(|| clocks().next())
}

/// UTC nanoseconds since 1970 of `YYYYMMDDTHHMMSS[.fraction]`; the separator may also be `_`, `-` or a space.
fn compact(text: &str) -> Option<i64> {
    let word = |at: usize| text.get(at..at + 15);
    let starts = (0..text.len().saturating_sub(14)).filter(|at| {
        let before = at.checked_sub(1).map(|b| text.as_bytes()[b]);
        !before.is_some_and(|b| b.is_ascii_digit())
    });
    starts.into_iter().find_map(|at| {
        let word = word(at)?;
        let date = chrono::NaiveDate::parse_from_str(&word[..8], "%Y%m%d").ok()?;
        let separated = matches!(word.as_bytes()[8], b'T' | b't' | b'_' | b'-' | b' ');
        let digits = word[..8].bytes().all(|b| b.is_ascii_digit());
        let time_ns = time_of_day_ns(&word[9..]).filter(|_| separated && digits)?;
        let midnight = date
            .and_time(chrono::NaiveTime::MIN)
            .and_utc()
            .timestamp_nanos_opt()?;
        let rest = text[at + 15..].strip_prefix(['.', ',']).unwrap_or("");
        let end = rest
            .find(|c: char| !c.is_ascii_digit())
            .unwrap_or(rest.len());
        Some(midnight.saturating_add(time_ns + fraction_ns(&rest[..end])))
    })
}

/// Offset of a time zone after the time of day, such as `+02:00` or `-0730`, nanoseconds. Zero without a zone.
fn zone_ns(after_clock: &str) -> i64 {
    let fraction = after_clock.strip_prefix(['.', ',']).unwrap_or(after_clock);
    let zone = fraction.trim_start_matches(|c: char| c.is_ascii_digit());
    let sign = match zone.bytes().next() {
        Some(b'+') => 1,
        Some(b'-') => -1,
        _ => return 0,
    };
    let digits: Vec<u8> = zone[1..]
        .bytes()
        .take(5)
        .filter(|b| *b != b':')
        .take_while(u8::is_ascii_digit)
        .collect();
    let &[h1, h2, m1, m2] = &digits[..] else {
        return 0;
    };
    let two = |a: u8, b: u8| i64::from(a - b'0') * 10 + i64::from(b - b'0');
    let (hours, minutes) = (two(h1, h2), two(m1, m2));
    match hours <= 14 && minutes < 60 {
        true => sign * (hours * 60 + minutes) * 60 * NS_PER_S,
        false => 0,
    }
}

/// The date that ends one character before the time of day: `YYYY-MM-DD`, `YYYY/MM/DD`, `MM/DD/YYYY` (SCS), `DD.MM.YYYY` or
/// `YYYY:DDD` (RVDAS).
fn date_before(text: &str) -> Option<chrono::NaiveDate> {
    let tail = |len: usize| {
        text.len()
            .checked_sub(len + 1)
            .map(|at| &text[at..at + len])
    };
    if let Some(ten) = tail(10) {
        for form in ["%Y-%m-%d", "%Y/%m/%d", "%m/%d/%Y", "%d.%m.%Y"] {
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

/// Seconds since 1970, alone or in a TAG block (`c:`). The number of digits distinguishes seconds, milliseconds,
/// microseconds and nanoseconds.
fn seconds_stamp(text: &str) -> Option<LineStamp> {
    let tag = text.split_once("c:").map(|(_, rest)| rest);
    let number = match tag {
        Some(rest) => rest.split(|c: char| !c.is_ascii_digit()).next()?,
        None => text
            .trim_start_matches(|c: char| c.is_ascii_whitespace() || matches!(c, '[' | '(' | '"'))
            .split([' ', '\t', ',', ';', ']', ')', '"'])
            .next()?,
    };
    let (whole, fraction) = number.split_once('.').unwrap_or((number, ""));
    let digits = |t: &str| t.bytes().all(|b| b.is_ascii_digit());
    if !digits(whole) || !digits(fraction) {
        return None;
    }
    let unit_ns = match whole.len() {
        10 => NS_PER_S,
        13 => NS_PER_S / 1000,
        16 => NS_PER_S / 1_000_000,
        19 => 1,
        _ => return None,
    };
    let ns = whole.parse::<i64>().ok()?.checked_mul(unit_ns)?;
    // Only a stamp in seconds can have a fraction.
    let fraction = if unit_ns == NS_PER_S { fraction } else { "" };
    Some(LineStamp::Utc(UtcNs(ns + fraction_ns(fraction))))
}

/// Nanoseconds since midnight of HH:MM:SS[.fraction] at the start of `text`.
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
        assert_eq!(stamp("1406851200250 $A,1"), utc(250_000_000), "ms");
        assert_eq!(stamp("[1406851200250123] $A,1"), utc(250_123_000), "us");
        assert_eq!(stamp("1406851200250123456,$A,1"), utc(250_123_456), "ns");
        for text in [
            "gyr1 2014-08-01:00:00:00.250000 $A,1",
            "2014-08-01T02:00:00,250+02:00 $A,1",
            "[2014-07-31 16:30:00.250-0730] $A,1",
            "01.08.2014 00:00:00.250;$A,1",
            "20140801T000000.250Z $A,1",
            "nav 20140801-000000.250: $A,1",
            "\"2014-08-01 00:00:00.250\",\"$A,1",
        ] {
            assert_eq!(stamp(text), utc(250_000_000), "{text}");
        }
        assert_eq!(stamp("201408010000001 $A,1"), None);
        assert_eq!(stamp("12 $A,1"), None);
        assert_eq!(stamp("99:99:99 $HEHDT,218.53,T*12"), None);
        assert_eq!(stamp("# Title: 12:00:00"), None, "a stamp needs a sentence");
    }

    #[test]
    fn the_sentence_is_the_rest_of_the_line() {
        let (_, rest) = split_line(b"18:58:39.006 $A,1*00$B,2\r\n");
        assert_eq!(rest, b"$A,1*00$B,2\r\n");
    }
}
