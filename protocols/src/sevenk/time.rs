//! 7KTIME: the ten-byte UTC timestamp of all 7k records. Source: DFD 3.12, data record frame.
//!
//! | off | type | field |
//! |---:|---|---|
//! | 0 | u16 | year |
//! | 2 | u16 | day of the year, 1..=366 |
//! | 4 | f32 | seconds, 0..60 |
//! | 8 | u8 | hours |
//! | 9 | u8 | minutes |
//!
//! The seconds are an f32 with steps of 3.8 us near 60 s, so a timestamp is accurate to 1.9 us.

use std::fmt;

use binrw::{BinRead, BinWrite};

use super::frame::{Layout, read_fixed, write_layout};
use super::{ErrorCode, WireError};
use crate::layout::layout_of;

/// Maximum difference between a UTC time and its timestamp: the whole last f32 step below 60 s. Other values round to half a step.
pub const TIME_RESOLUTION_NS: i64 = 3_815;

/// The largest f32 below 60. It replaces seconds that would round up to 60.0, which is not within the minute.
const LAST_SECOND: f32 = f32::from_bits(60.0_f32.to_bits() - 1);

const NS_PER_S: i64 = 1_000_000_000;
const NS_PER_MINUTE: i64 = 60 * NS_PER_S;
const NS_PER_DAY: i64 = 86_400 * NS_PER_S;

/// UTC time in the fields of 7KTIME. Fields may be invalid after parsing; [`SevenKTime::to_utc_ns`] validates them.
#[derive(Debug, Clone, Copy, PartialEq, Default, BinRead, BinWrite)]
pub struct SevenKTime {
    /// Year.
    pub year: u16,
    /// Day of the year; 1 is the first of January.
    pub day_of_year: u16,
    /// Seconds within the minute.
    pub seconds: f32,
    /// Hour, 0 to 23.
    pub hours: u8,
    /// Minute, 0 to 59.
    pub minutes: u8,
}

layout_of!(SevenKTime, 10, "7KTIME", Little);

/// Error of the conversion between a time and 7KTIME.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum TimeError {
    #[error("{utc_ns} ns is before 1970, the first year of 7k timestamps")]
    /// Times before 1970 are not supported.
    BeforeEpoch {
        /// Time, nanoseconds since 1970.
        utc_ns: i64,
    },
    #[error("7KTIME field {field} is out of range: {value}")]
    /// A field is out of range.
    Field {
        /// Name of the field.
        field: &'static str,
        /// Value found.
        value: f64,
    },
}

impl TimeError {
    /// Error code of the answer to a command with such a time.
    pub fn nack_code(&self) -> ErrorCode {
        ErrorCode::InvalidParameter
    }
}

impl SevenKTime {
    /// Size of a timestamp.
    pub const SIZE_BYTES: usize = <Self as Layout>::SIZE_BYTES;

    /// Timestamp of a UTC time in nanoseconds since 1970-01-01, rounded to the nearest f32 seconds, but never up to 60.0.
    pub fn from_utc_ns(utc_ns: i64) -> Result<Self, TimeError> {
        if utc_ns < 0 {
            return Err(TimeError::BeforeEpoch { utc_ns });
        }
        let day = utc_ns / NS_PER_DAY;
        let in_day_ns = utc_ns % NS_PER_DAY;
        // The estimate is at most one year too late within the range of an i64 (year 2262), because 365-day years exceed the
        // calendar by 73 days then.
        let mut year = 1970 + day / 365;
        while days_before_year(year) > day {
            year -= 1;
        }
        let minute = in_day_ns / NS_PER_MINUTE;
        let seconds = ((in_day_ns % NS_PER_MINUTE) as f64 / NS_PER_S as f64) as f32;
        Ok(Self {
            year: year as u16,
            day_of_year: (day - days_before_year(year) + 1) as u16,
            seconds: seconds.min(LAST_SECOND),
            hours: (minute / 60) as u8,
            minutes: (minute % 60) as u8,
        })
    }

    /// Timestamp of a UTC time. Times before 1970 become 1970-01-01 00:00, for callers that must not fail.
    pub fn from_utc_ns_clamped(utc_ns: i64) -> Self {
        Self::from_utc_ns(utc_ns.max(0)).expect("a time from 1970 on has a stamp")
    }

    /// UTC nanoseconds since 1970-01-01, to the precision of the f32 seconds. Seconds of exactly 60.0 mean the start of the next
    /// minute; some writers produce this value by rounding.
    pub fn to_utc_ns(&self) -> Result<i64, TimeError> {
        let field = |field, value: f64| Err(TimeError::Field { field, value });
        let year = i64::from(self.year);
        // 2261 is the last whole year within the range of i64 nanoseconds.
        if !(1970..=2261).contains(&year) {
            return field("year", f64::from(self.year));
        }
        let days_in_year = days_before_year(year + 1) - days_before_year(year);
        let day_of_year = i64::from(self.day_of_year);
        if !(1..=days_in_year).contains(&day_of_year) {
            return field("day_of_year", f64::from(self.day_of_year));
        }
        if self.hours > 23 {
            return field("hours", f64::from(self.hours));
        }
        if self.minutes > 59 {
            return field("minutes", f64::from(self.minutes));
        }
        if !(0.0..=60.0).contains(&self.seconds) {
            return field("seconds", f64::from(self.seconds));
        }
        let minute = i64::from(self.hours) * 60 + i64::from(self.minutes);
        let seconds_ns = (f64::from(self.seconds) * NS_PER_S as f64).round() as i64;
        Ok((days_before_year(year) + day_of_year - 1) * NS_PER_DAY
            + minute * NS_PER_MINUTE
            + seconds_ns)
    }

    /// Parses the fields at the front of `bytes`.
    pub fn parse(bytes: &[u8]) -> Result<Self, WireError> {
        read_fixed(bytes)
    }

    /// Appends the timestamp.
    pub fn emit(&self, buf: &mut Vec<u8>) {
        write_layout(self, buf);
    }
}

/// Days from 1970-01-01 to the first of January of `year` (Gregorian).
fn days_before_year(year: i64) -> i64 {
    let leap_years_through = |y: i64| y / 4 - y / 100 + y / 400;
    365 * (year - 1970) + leap_years_through(year - 1) - leap_years_through(1969)
}

impl fmt::Display for SevenKTime {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "{:04}-{:03} {:02}:{:02}:{:09.6}",
            self.year, self.day_of_year, self.hours, self.minutes, self.seconds
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn stamp(year: u16, day_of_year: u16, hours: u8, minutes: u8, seconds: f32) -> SevenKTime {
        SevenKTime {
            year,
            day_of_year,
            seconds,
            hours,
            minutes,
        }
    }

    #[test]
    fn epoch_leap_days_and_year_ends_fall_on_their_calendar_days() {
        // Unix seconds as `date -u -d ... +%s` gives them.
        let cases = [
            (0, stamp(1970, 1, 0, 0, 0.0)),
            (68_169_600, stamp(1972, 60, 0, 0, 0.0)), // 1972-02-29
            (951_782_400, stamp(2000, 60, 0, 0, 0.0)), // 2000-02-29: divisible by 400
            (978_307_199, stamp(2000, 366, 23, 59, 59.0)), // 2000-12-31 23:59:59
            (978_307_200, stamp(2001, 1, 0, 0, 0.0)), // 2001-01-01
            (1_750_000_000, stamp(2025, 166, 15, 6, 40.0)), // 2025-06-15 15:06:40
            (4_107_542_400, stamp(2100, 60, 0, 0, 0.0)), // 2100-03-01: no leap year
        ];
        for (unix_s, expected) in cases {
            assert_eq!(
                SevenKTime::from_utc_ns(unix_s * NS_PER_S),
                Ok(expected),
                "unix {unix_s} s"
            );
            assert_eq!(expected.to_utc_ns(), Ok(unix_s * NS_PER_S), "{expected}");
        }
    }

    #[test]
    fn seconds_never_round_up_to_sixty() {
        for before_ns in [1, 100, 1_000, 1_900, 2_000, 4_000] {
            let time = SevenKTime::from_utc_ns(NS_PER_MINUTE - before_ns).unwrap();
            assert!(
                time.seconds < 60.0,
                "{before_ns} ns before the minute gave {}",
                time.seconds
            );
            assert_eq!(time.minutes, 0);
        }
    }

    #[test]
    fn times_before_1970_are_refused_or_clamped() {
        assert_eq!(
            SevenKTime::from_utc_ns(-1),
            Err(TimeError::BeforeEpoch { utc_ns: -1 })
        );
        assert_eq!(
            SevenKTime::from_utc_ns_clamped(i64::MIN),
            stamp(1970, 1, 0, 0, 0.0)
        );
    }

    #[test]
    fn invalid_fields_are_named() {
        let good = stamp(2023, 365, 23, 59, 59.0);
        assert!(good.to_utc_ns().is_ok());
        for (bad, name) in [
            (SevenKTime { year: 0, ..good }, "year"),
            (SevenKTime { year: 2262, ..good }, "year"),
            (
                SevenKTime {
                    day_of_year: 366,
                    ..good
                },
                "day_of_year",
            ),
            (
                SevenKTime {
                    day_of_year: 0,
                    ..good
                },
                "day_of_year",
            ),
            (SevenKTime { hours: 24, ..good }, "hours"),
            (
                SevenKTime {
                    minutes: 60,
                    ..good
                },
                "minutes",
            ),
            (
                SevenKTime {
                    seconds: f32::NAN,
                    ..good
                },
                "seconds",
            ),
            (
                SevenKTime {
                    seconds: -0.5,
                    ..good
                },
                "seconds",
            ),
            (
                SevenKTime {
                    seconds: 60.5,
                    ..good
                },
                "seconds",
            ),
        ] {
            assert!(
                matches!(bad.to_utc_ns(), Err(TimeError::Field { field, .. }) if field == name),
                "{bad}"
            );
        }
        assert_eq!(
            stamp(2023, 365, 23, 59, 60.0).to_utc_ns(),
            stamp(2024, 1, 0, 0, 0.0).to_utc_ns()
        );
    }

    proptest! {
        #[test]
        fn utc_survives_to_f32_precision(utc_ns in 0..=i64::MAX) {
            let time = SevenKTime::from_utc_ns(utc_ns).unwrap();
            prop_assert!((1..=366).contains(&time.day_of_year) && time.hours < 24 && time.minutes < 60);
            prop_assert!((0.0..60.0).contains(&time.seconds));
            if time.year <= 2261 {
                let error_ns = time.to_utc_ns().unwrap() - utc_ns;
                prop_assert!(error_ns.abs() <= TIME_RESOLUTION_NS, "error {error_ns} ns");
            }
        }

        #[test]
        fn any_stamp_reads_without_panic(bytes in proptest::collection::vec(any::<u8>(), 0..12)) {
            if let Ok(time) = SevenKTime::parse(&bytes) {
                let _ = time.to_utc_ns();
                let _ = time.to_string();
            }
        }
    }
}
