//! The comma-separated fields of a sentence, and the numbers, times and angles in them.

use super::reading::Refusal::{self, Malformed};
use echotank_core::time::NS_PER_S;

/// Fields looked at; the sentences decoded here have at most 16.
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

    /// `None` where the field is empty.
    pub(crate) fn number(&self, i: usize) -> Result<Option<f64>, Refusal> {
        if self.text(i).is_empty() {
            return Ok(None);
        }
        match self.text(i).parse::<f64>() {
            Ok(number) if number.is_finite() => Ok(Some(number)),
            _ => Err(Malformed),
        }
    }

    /// An unsigned number and the letter behind it that says its sign.
    pub(crate) fn signed_by(
        &self,
        i: usize,
        plus: &str,
        minus: &str,
    ) -> Result<Option<f64>, Refusal> {
        match (self.number(i)?, self.text(i + 1)) {
            (None, _) => Ok(None),
            (Some(v), letter) if letter == plus => Ok(Some(v)),
            (Some(v), letter) if letter == minus => Ok(Some(-v)),
            _ => Err(Malformed),
        }
    }

    /// hhmmss or hhmmss.sss to nanoseconds since midnight, exactly.
    pub(crate) fn time_of_day(&self, i: usize) -> Result<Option<i64>, Refusal> {
        if self.text(i).is_empty() {
            return Ok(None);
        }
        time_of_day_ns(self.text(i)).map(Some).ok_or(Malformed)
    }

    /// The position in four fields from `i`: ddmm.mmm, N or S, dddmm.mmm, E or W; in degrees.
    pub(crate) fn position(&self, i: usize) -> Result<Option<(f64, f64)>, Refusal> {
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

    /// ddmmyy.
    pub(crate) fn day_month_year(&self, i: usize) -> Result<(u32, u32, i32), Refusal> {
        let text = self.text(i);
        if text.len() != 6 || !text.bytes().all(|b| b.is_ascii_digit()) {
            return Err(Malformed);
        }
        let two = |at: usize| text[at..at + 2].parse::<u32>().map_err(|_| Malformed);
        Ok((two(0)?, two(2)?, two(4)? as i32))
    }
}

/// ddmm.mmm or dddmm.mmm, with or without leading zeros, as degrees.
fn degrees_of_arc(text: &str) -> Option<f64> {
    if !text.bytes().all(|b| b.is_ascii_digit() || b == b'.') {
        return None;
    }
    // Splitting the text keeps every digit of the minutes.
    let point = text.find('.').unwrap_or(text.len());
    let (degrees, minutes) = text.split_at(point.saturating_sub(2));
    let degrees = match degrees {
        "" => 0.0,
        degrees => degrees.parse::<f64>().ok()?,
    };
    let minutes = minutes.parse::<f64>().ok()?;
    (minutes < 60.0).then_some(degrees + minutes / 60.0)
}

/// hhmmss[.fraction] as nanoseconds since midnight, exact to nine decimals; second 60 is accepted.
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

/// Decimal digits after a point, as nanoseconds; digits beyond the ninth are cut.
pub(crate) fn fraction_ns(digits: &str) -> i64 {
    let padded = digits
        .bytes()
        .map(|b| i64::from(b - b'0'))
        .chain(std::iter::repeat(0));
    padded.take(9).fold(0, |ns, digit| ns * 10 + digit)
}
