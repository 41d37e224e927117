//! Conversion between UTC nanoseconds since 1970 and date and time fields. Proleptic Gregorian calendar, without leap
//! seconds.
//!
//! Date algorithms: H. Hinnant, "chrono-Compatible Low-Level Date Algorithms" (2013), with years that begin in March.

const NS_PER_S: i64 = 1_000_000_000;
const S_PER_DAY: i64 = 86_400;

/// A UTC time as date and time fields.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct DateTime {
    /// Gregorian year.
    pub year: i32,
    /// Month; 1 is January.
    pub month: u8,
    /// Day of the month, from 1.
    pub day: u8,
    /// Day of the year; 1 is the first of January.
    pub day_of_year: u16,
    /// Hour, 0 to 23.
    pub hour: u8,
    /// Minute, 0 to 59.
    pub minute: u8,
    /// Second, 0 to 59.
    pub second: u8,
    /// Nanosecond, 0 to 999 999 999.
    pub nanosecond: u32,
}

impl DateTime {
    /// The fields of a time in nanoseconds since 1970.
    pub fn from_utc_ns(utc_ns: i64) -> Self {
        let (seconds, nanosecond) = (utc_ns.div_euclid(NS_PER_S), utc_ns.rem_euclid(NS_PER_S));
        let (days, in_day) = (seconds.div_euclid(S_PER_DAY), seconds.rem_euclid(S_PER_DAY));
        let shifted = days + 719_468;
        let era = shifted.div_euclid(146_097);
        let day_of_era = shifted.rem_euclid(146_097);
        let year_of_era =
            (day_of_era - day_of_era / 1460 + day_of_era / 36_524 - day_of_era / 146_096) / 365;
        let day_from_march = day_of_era - (365 * year_of_era + year_of_era / 4 - year_of_era / 100);
        let month_from_march = (5 * day_from_march + 2) / 153;
        let day = day_from_march - (153 * month_from_march + 2) / 5 + 1;
        let month = if month_from_march < 10 {
            month_from_march + 3
        } else {
            month_from_march - 9
        };
        let year = year_of_era + 400 * era + i64::from(month <= 2);
        Self {
            year: year as i32,
            month: month as u8,
            day: day as u8,
            day_of_year: (days - days_from_epoch(year, 1, 1) + 1) as u16,
            hour: (in_day / 3600) as u8,
            minute: (in_day / 60 % 60) as u8,
            second: (in_day % 60) as u8,
            nanosecond: nanosecond as u32,
        }
    }

    /// Milliseconds since midnight, rounded down.
    pub fn milliseconds_of_day(&self) -> u32 {
        ((u32::from(self.hour) * 60 + u32::from(self.minute)) * 60 + u32::from(self.second)) * 1000
            + self.nanosecond / 1_000_000
    }
}

/// Days from 1970-01-01 to a date.
pub fn days_from_epoch(year: i64, month: i64, day: i64) -> i64 {
    let year = year - i64::from(month <= 2);
    let era = year.div_euclid(400);
    let year_of_era = year.rem_euclid(400);
    let month_from_march = if month > 2 { month - 3 } else { month + 9 };
    let day_of_year = (153 * month_from_march + 2) / 5 + day - 1;
    era * 146_097 + year_of_era * 365 + year_of_era / 4 - year_of_era / 100 + day_of_year - 719_468
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn known_moments_have_their_dates() {
        // 1750000000 is 2025-06-15 15:06:40 UTC, the 166th day of its year (`date -u -d @1750000000 +%F_%T_%j`).
        let date_time = DateTime::from_utc_ns(1_750_000_000_123_456_789);
        assert_eq!(
            (
                date_time.year,
                date_time.month,
                date_time.day,
                date_time.day_of_year
            ),
            (2025, 6, 15, 166)
        );
        assert_eq!(
            (date_time.hour, date_time.minute, date_time.second),
            (15, 6, 40)
        );
        assert_eq!(date_time.milliseconds_of_day(), 54_400_123);
        // The last day of a leap year, and a time before 1970.
        let leap = DateTime::from_utc_ns(1_735_603_200 * NS_PER_S - NS_PER_S);
        assert_eq!(
            (leap.year, leap.month, leap.day, leap.day_of_year),
            (2024, 12, 30, 365)
        );
        let before = DateTime::from_utc_ns(-1);
        assert_eq!(
            (before.year, before.month, before.day, before.nanosecond),
            (1969, 12, 31, 999_999_999)
        );
    }

    #[test]
    fn every_day_of_four_centuries_comes_back() {
        let mut previous = (0, 0, 0);
        for day in 0..146_097 {
            let m = DateTime::from_utc_ns((day % 106_751) * S_PER_DAY * NS_PER_S);
            assert_eq!(
                days_from_epoch(m.year.into(), m.month.into(), m.day.into()),
                day % 106_751
            );
            assert_ne!((m.year, m.month, m.day), previous);
            previous = (m.year, m.month, m.day);
        }
    }
}
