//! The comma-separated fields of a sentence, and the numbers, times and angles in them.

use super::reading::DecodeError::{self, Malformed};
use echotank_core::time::NS_PER_S;

/// Maximum number of fields read. The supported sentences have at most 16.
const MAX_FIELDS: usize = 32;

/// The comma-separated fields of a sentence; field 0 is the address. Absent fields read as empty.
pub(crate) struct Fields<'a> {
    text: [&'a str; MAX_FIELDS],
    pub count: usize,
}

impl<'a> Fields<'a> {
    pub(crate) fn split(body: &'a str) -> Self {
        let mut fields = Self {
            text: [""; MAX_FIELDS],
            count: 0,
        };
        for (slot, text) in fields.text.iter_mut().zip(body.split(',')) {
            *slot = text.trim();
            fields.count += 1;
        }
        fields
    }

    pub(crate) fn text(&self, i: usize) -> &'a str {
        self.text[i]
    }

    /// The field as a finite number; `None` if it is empty.
    pub(crate) fn number(&self, i: usize) -> Result<Option<f64>, DecodeError> {
        if self.text(i).is_empty() {
            return Ok(None);
        }
        match self.text(i).parse::<f64>() {
            Ok(number) if number.is_finite() => Ok(Some(number)),
            _ => Err(Malformed),
        }
    }

    /// An unsigned number in field `i` with its sign given by the letter in the next field.
    pub(crate) fn signed_by(
        &self,
        i: usize,
        plus: &str,
        minus: &str,
    ) -> Result<Option<f64>, DecodeError> {
        match (self.number(i)?, self.text(i + 1)) {
            (None, _) => Ok(None),
            (Some(v), letter) if letter == plus => Ok(Some(v)),
            (Some(v), letter) if letter == minus => Ok(Some(-v)),
            _ => Err(Malformed),
        }
    }

    /// Nanoseconds since midnight of hhmmss or hhmmss.sss, exact.
    pub(crate) fn time_of_day(&self, i: usize) -> Result<Option<i64>, DecodeError> {
        if self.text(i).is_empty() {
            return Ok(None);
        }
        time_of_day_ns(self.text(i)).map(Some).ok_or(Malformed)
    }

    /// Position in degrees from four fields starting at `i`: ddmm.mmm, N or S, dddmm.mmm, E or W.
    pub(crate) fn position(&self, i: usize) -> Result<Option<(f64, f64)>, DecodeError> {
        if self.text(i).is_empty() || self.text(i + 2).is_empty() {
            return Ok(None);
        }
        let angle = |at: usize, plus: &str, minus: &str| {
            let degrees = degrees_of_arc(self.text(at)).ok_or(Malformed)?;
            match self.text(at + 1) {
                letter if letter == plus => Ok(degrees),
                letter if letter == minus => Ok(-degrees),
                _ => Err(Malformed),
            }
        };
        Ok(Some((angle(i, "N", "S")?, angle(i + 2, "E", "W")?)))
    }

    /// Two-digit day, month and year of ddmmyy.
    pub(crate) fn day_month_year(&self, i: usize) -> Result<(u32, u32, i32), DecodeError> {
        let text = self.text(i);
        if text.len() != 6 || !text.bytes().all(|b| b.is_ascii_digit()) {
            return Err(Malformed);
        }
        let two = |at: usize| text[at..at + 2].parse::<u32>().map_err(|_| Malformed);
        Ok((two(0)?, two(2)?, two(4)? as i32))
    }
}

/// Degrees of ddmm.mmm or dddmm.mmm, with or without leading zeros.
fn degrees_of_arc(text: &str) -> Option<f64> {
    if !text.bytes().all(|b| b.is_ascii_digit() || b == b'.') {
        return None;
    }
    // Degrees and minutes are split as text, so no digit of the minutes is lost.
    let point = text.find('.').unwrap_or(text.len());
    let (degrees, minutes) = text.split_at(point.saturating_sub(2));
    let degrees = match degrees {
        "" => 0.0,
        degrees => degrees.parse::<f64>().ok()?,
    };
    let minutes = minutes.parse::<f64>().ok()?;
    (minutes < 60.0).then_some(degrees + minutes / 60.0)
}

/// Nanoseconds since midnight of hhmmss[.fraction], exact to nine decimals. Second 60 (a leap second) is accepted.
pub(crate) fn time_of_day_ns(text: &str) -> Option<i64> {
    let (whole, fraction) = text.split_once('.').unwrap_or((text, ""));
    let digits = |t: &str| t.bytes().all(|b| b.is_ascii_digit());
    if whole.len() != 6 || !digits(whole) || !digits(fraction) {
        return None;
    }
    let two = |at: usize| whole[at..at + 2].parse::<i64>().ok();
    let (hour, minute, second) = (two(0)?, two(2)?, two(4)?);
    if hour > 23 || minute > 59 || second > 60 {
        return None;
    }
    let nanos = fraction_ns(fraction);
    Some(((hour * 60 + minute) * 60 + second) * NS_PER_S + nanos)
}

/// Nanoseconds of the decimal digits after a point. Digits beyond the ninth are ignored.
pub(crate) fn fraction_ns(digits: &str) -> i64 {
    let padded = digits
        .bytes()
        .map(|b| i64::from(b - b'0'))
        .chain(std::iter::repeat(0));
    padded.take(9).fold(0, |ns, digit| ns * 10 + digit)
}
