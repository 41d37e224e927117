//! Determines the UTC of a reading from its time fields and its arrival, and the time of a burst for untimed sentences.
//!
//! Only ZDA and RMC carry a date. Other messages carry a time of day that wraps at midnight. The day is the one nearest to the
//! expected message time. Before any date, it is the one nearest to the arrival.
//!
//! If the clock of a source is set during operation, its times continue without a step. They are corrected by whole seconds until
//! the source's own times agree with the arrivals again. A log without stamps cannot distinguish a step from a pause, and both
//! count as a pause.

use super::reading::{Reading, StatedTime};
use echotank_core::time::{NS_PER_S, UtcNs};

const DAY_NS: i64 = 86_400 * NS_PER_S;
/// Pause between arrivals that ends a burst. A Seapath at 1 Hz pauses up to 0.13 s inside a burst and 0.76 s between bursts. Logs
/// replayed at four lines a second pause 0.26 s.
const BURST_GAP_NS: i64 = NS_PER_S * 2 / 5;
/// Difference from the expected message time above which a message time is doubtful.
pub(crate) const JUMP_NS: i64 = 10 * NS_PER_S;
/// Number of consistent doubtful messages after which the new time is accepted. Dated messages that agree with the arrival need one
/// message fewer.
const JUMP_CONFIRMATIONS: u32 = 3;

/// Period of the GPS week number: 1024 weeks. A receiver with a wrong epoch is wrong by a multiple of the period.
const ROLLOVER_NS: i64 = 1024 * 7 * DAY_NS;
/// Maximum distance of a date error from a multiple of the rollover for which it counts as a rollover.
const ROLLOVER_TOLERANCE_NS: i64 = 2 * DAY_NS;
const WEEK_NS: i64 = 7 * DAY_NS;
/// 1980-01-06T00:00:00Z.
const GPS_EPOCH_NS: i64 = 315_964_800 * NS_PER_S;
/// GPS minus UTC, seconds, from these UTC instants (seconds since 1970) on: the leap seconds since 1999 (IERS Bulletin C).
/// Earlier times use 13.
const LEAP_S: [(i64, i64); 5] = [
    (1_136_073_600, 14),
    (1_230_768_000, 15),
    (1_341_100_800, 16),
    (1_435_708_800, 17),
    (1_483_228_800, 18),
];

/// UTC of a GPS time; both in nanoseconds since 1970, the GPS time without leap seconds.
pub(crate) fn utc_of_gps(gps_ns: i64) -> i64 {
    let leap_s = LEAP_S
        .iter()
        .rev()
        .find(|(from_s, leap_s)| gps_ns >= (from_s + leap_s) * NS_PER_S)
        .map_or(13, |(_, leap_s)| *leap_s);
    gps_ns.saturating_sub(leap_s * NS_PER_S)
}

/// Reliability of the times of a source.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ClockState {
    /// The times continue, or agree with the arrivals.
    #[default]
    Right,
    /// The times jump, and the sentences are rejected.
    Jumping,
    /// The times have jumped and are corrected.
    Corrected {
        /// Correction added to the times, whole seconds.
        by_s: i64,
    },
}

/// Result for the time of a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Stamp {
    /// The message has no time.
    None,
    At(UtcNs),
    /// The time jumps. The message must not be used.
    Jumped,
}

#[derive(Debug, Default)]
pub(crate) struct MessageClock {
    dated: bool,
    last: Option<(UtcNs, UtcNs)>,
    last_sentence: Option<UtcNs>,
    burst: Option<UtcNs>,
    /// Offset from the arrival and number of consistent doubtful messages, first for messages without a date, then with a date. A
    /// wrong date does not change the time of day, so only dated messages can confirm a date.
    doubts: [Option<(i64, u32)>; 2],
    /// Correction of message times since the clock of the source was set, nanoseconds. A multiple of one second.
    shift_ns: i64,
    ignores_arrival_dates: bool,
    week_rollovers: u64,
}

impl MessageClock {
    /// Records the arrival of a sentence, decoded or not. A pause before the sentence ends the burst.
    pub(crate) fn arrived(&mut self, arrival: UtcNs) {
        if let Some(before) = self.last_sentence
            && arrival.0.saturating_sub(before.0) > BURST_GAP_NS
        {
            self.burst = None;
        }
        self.last_sentence = Some(arrival);
    }

    /// Message time of the last timed sentence of the current burst.
    pub(crate) fn burst(&self) -> Option<UtcNs> {
        self.burst
    }

    /// The last accepted message time and its arrival.
    pub(crate) fn last(&self) -> Option<(UtcNs, UtcNs)> {
        self.last
    }

    /// Whether a full date has been received.
    pub(crate) fn is_dated(&self) -> bool {
        self.dated
    }

    /// Number of dates corrected by week rollovers.
    pub(crate) fn week_rollovers(&self) -> u64 {
        self.week_rollovers
    }

    /// Shifts the stored arrivals by `by_ns`, because later arrivals have moved by as much.
    pub(crate) fn arrivals_moved(&mut self, by_ns: i64) {
        if let Some((_, arrival)) = &mut self.last {
            *arrival = arrival.plus_ns(by_ns);
        }
        self.last_sentence = self.last_sentence.map(|utc| utc.plus_ns(by_ns));
    }

    pub(crate) fn state(&self) -> ClockState {
        if self.shift_ns != 0 {
            let by_s = self.shift_ns / NS_PER_S;
            ClockState::Corrected { by_s }
        } else if self.doubts.iter().any(Option::is_some) {
            ClockState::Jumping
        } else {
            ClockState::Right
        }
    }

    pub(crate) fn ignore_arrival_dates(&mut self) {
        self.ignores_arrival_dates = true;
    }

    pub(crate) fn stamp(&mut self, reading: &Reading, arrival: UtcNs) -> Stamp {
        let Some(when) = reading.when else {
            return Stamp::None;
        };
        let expected = match self.last {
            Some((message, at)) => message.plus_ns(arrival.0.saturating_sub(at.0).max(0)),
            None => arrival,
        };
        let unshifted = expected.plus_ns(-self.shift_ns);
        let (message, dated) = match when {
            StatedTime::TimeOfDay(ns) => (nearest_day(ns, unshifted), false),
            StatedTime::GpsOfWeek(ns) => (nearest_week(ns, unshifted), false),
            StatedTime::Dated {
                day_ns,
                time_of_day_ns,
            } => (UtcNs(day_ns.saturating_add(time_of_day_ns)), true),
            StatedTime::Instant(utc) => (utc, true),
        };
        let message = if dated {
            self.without_rollover(message, arrival)
        } else {
            message
        };
        // Without a date, times that differ by whole periods are equal. Otherwise a clock that is 12 hours wrong would alternate
        // between too early and too late.
        let period_ns = match when {
            StatedTime::TimeOfDay(_) => Some(DAY_NS),
            StatedTime::GpsOfWeek(_) => Some(WEEK_NS),
            StatedTime::Dated { .. } | StatedTime::Instant(_) => None,
        };
        let first_date = dated && !self.dated;
        if first_date {
            self.shift_ns = 0;
        }
        // Time by the uncorrected clock of the source.
        let own = match when {
            StatedTime::TimeOfDay(ns) => nearest_day(ns, expected),
            StatedTime::GpsOfWeek(ns) => nearest_week(ns, expected),
            StatedTime::Dated { .. } | StatedTime::Instant(_) => message,
        };
        let own_by_arrival = match when {
            StatedTime::TimeOfDay(ns) => nearest_day(ns, arrival),
            StatedTime::GpsOfWeek(ns) => nearest_week(ns, arrival),
            StatedTime::Dated { .. } | StatedTime::Instant(_) => message,
        };
        let mut message = message.plus_ns(self.shift_ns);
        if self.last.is_some() && !first_date {
            let is_likely =
                dated && !self.ignores_arrival_dates && distance(own, arrival) <= JUMP_NS;
            let confirmations = JUMP_CONFIRMATIONS - u32::from(is_likely);
            if self.is_doubtful(message, expected, arrival, period_ns, confirmations) {
                return Stamp::Jumped;
            }
        }
        let off_ns = expected.0.saturating_sub(message.0);
        let is_step = self.last.is_some() && !first_date && off_ns.saturating_abs() > JUMP_NS;
        if is_step && !self.ignores_arrival_dates {
            let right = if dated {
                (distance(own, arrival) <= distance(expected, arrival)).then_some(own)
            } else if distance(own, expected) <= JUMP_NS {
                Some(own)
            } else {
                // The clock was wrong from the first message on.
                (distance(own_by_arrival, arrival) <= JUMP_NS).then_some(own_by_arrival)
            };
            // The correction is in whole seconds. A fraction would only add the latencies.
            let step_ns = (off_ns as f64 / NS_PER_S as f64).round() as i64 * NS_PER_S;
            (self.shift_ns, message) = match right {
                Some(right) => (0, right),
                None => (
                    self.shift_ns.saturating_add(step_ns),
                    message.plus_ns(step_ns),
                ),
            };
        }
        self.dated |= dated;
        self.last = Some((message, arrival));
        self.burst = Some(message);
        Stamp::At(message)
    }

    /// Removes GPS week rollovers if they alone explain the difference from the arrival.
    fn without_rollover(&mut self, message: UtcNs, arrival: UtcNs) -> UtcNs {
        let off_ns = message.0.saturating_sub(arrival.0);
        let rolls = (off_ns as f64 / ROLLOVER_NS as f64).round() as i64;
        let rest_ns = off_ns.saturating_sub(rolls * ROLLOVER_NS).saturating_abs();
        if self.ignores_arrival_dates || rolls == 0 || rest_ns > ROLLOVER_TOLERANCE_NS {
            return message;
        }
        self.week_rollovers += 1;
        message.plus_ns(-rolls * ROLLOVER_NS)
    }

    fn is_doubtful(
        &mut self,
        message: UtcNs,
        expected: UtcNs,
        arrival: UtcNs,
        period_ns: Option<i64>,
        confirmations: u32,
    ) -> bool {
        let dated = period_ns.is_none();
        if distance(message, expected) <= JUMP_NS {
            self.doubts[0] = None;
            if dated {
                self.doubts[1] = None;
            }
            return false;
        }
        let offset = message.0.saturating_sub(arrival.0);
        let doubt = &mut self.doubts[usize::from(dated)];
        let seen = match *doubt {
            Some((before, seen)) if is_near(offset.saturating_sub(before), period_ns) => seen + 1,
            _ => 1,
        };
        *doubt = Some((offset, seen));
        if seen >= confirmations {
            self.doubts = [None; 2];
        }
        seen < confirmations
    }
}

/// Whether a difference of two offsets, modulo `period_ns`, is within the limit.
fn is_near(difference_ns: i64, period_ns: Option<i64>) -> bool {
    let rest_ns = match period_ns {
        Some(period_ns) => {
            (difference_ns.saturating_add(period_ns / 2)).rem_euclid(period_ns) - period_ns / 2
        }
        None => difference_ns,
    };
    rest_ns.saturating_abs() <= JUMP_NS
}

fn distance(a: UtcNs, b: UtcNs) -> i64 {
    a.0.saturating_sub(b.0).saturating_abs()
}

/// The instant with this time of day that is nearest to `reference`.
pub(crate) fn nearest_day(time_of_day_ns: i64, reference: UtcNs) -> UtcNs {
    let midnight = reference.0.saturating_sub(reference.0.rem_euclid(DAY_NS));
    let same_day = midnight.saturating_add(time_of_day_ns);
    let away = same_day.saturating_sub(reference.0);
    let days = if away > DAY_NS / 2 {
        -1
    } else if away < -DAY_NS / 2 {
        1
    } else {
        0
    };
    UtcNs(same_day.saturating_add(days * DAY_NS))
}

/// The instant with this GPS time of week that is nearest to `reference`.
fn nearest_week(of_week_ns: i64, reference: UtcNs) -> UtcNs {
    let weeks = |ns: i64| ns.saturating_sub(GPS_EPOCH_NS).div_euclid(WEEK_NS);
    let at = |week: i64| utc_of_gps(GPS_EPOCH_NS + week * WEEK_NS + of_week_ns);
    let week = weeks(reference.0);
    let nearest = [week - 1, week, week + 1]
        .into_iter()
        .map(at)
        .min_by_key(|utc| utc.saturating_sub(reference.0).saturating_abs());
    UtcNs(nearest.unwrap_or(reference.0))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sentence::decode;
    use echotank_config::spec::NavDialect;

    fn reading(body: &str) -> Reading {
        decode(body, &NavDialect::default(), &mut String::new()).expect("decodes")
    }

    #[test]
    fn week_rollover_is_corrected_to_the_arrival_date() {
        let at = |s: f64| UtcNs(D).plus_s(s);
        // 1024 weeks before 2014-08-01 was 1994-12-16.
        let zda = reading("GPZDA,000001.00,16,12,1994,,");
        let mut clock = MessageClock::default();
        assert_eq!(clock.stamp(&zda, at(1.1)), Stamp::At(at(1.0)));
        assert_eq!(clock.week_rollovers(), 1);
        let mut untimed = MessageClock::default();
        untimed.ignore_arrival_dates();
        let rollover_s = 1024.0 * 7.0 * 86400.0;
        assert_eq!(
            untimed.stamp(&zda, at(1.1)),
            Stamp::At(at(1.0 - rollover_s))
        );
        // An error of a month is not a rollover.
        let other = reading("GPZDA,000001.00,16,01,1995,,");
        let mut clock = MessageClock::default();
        assert!(matches!(clock.stamp(&other, at(1.1)), Stamp::At(t) if t < at(-1e8)));
    }

    #[test]
    fn gps_time_of_week_becomes_utc_with_its_leap_seconds() {
        // 2014-08-01T00:00:00Z was GPS week 1803, 432016 s (16 leap seconds).
        let att = reading("PASHR,ATT,432017.0,218.0,1.0,2.0,0.001,0.001,0");
        let mut clock = MessageClock::default();
        let at = |s: f64| UtcNs(D).plus_s(s);
        assert_eq!(clock.stamp(&att, at(1.3)), Stamp::At(at(1.0)));
        assert_eq!(
            utc_of_gps(1_483_228_817 * NS_PER_S),
            1_483_228_800 * NS_PER_S
        );
        assert_eq!(
            utc_of_gps(1_483_228_818 * NS_PER_S),
            1_483_228_800 * NS_PER_S
        );
    }
    const D: i64 = 1_406_851_200 * NS_PER_S; // 2014-08-01

    #[test]
    fn time_of_day_wraps_at_midnight_in_both_directions() {
        let mut clock = MessageClock::default();
        let at = |s: f64| UtcNs(D).plus_s(s);
        let rmc = reading("INRMC,235959.50,A,2200.1,S,01756.3,W,9.1,215.11,310714,24.7,W,A");
        assert_eq!(clock.stamp(&rmc, at(0.2)), Stamp::At(at(-0.5)));
        let late = reading("INGGA,000000.50,2200.1,S,01756.3,W,1,12,0.7,-2.76,M,4.67,M,,");
        assert_eq!(clock.stamp(&late, at(0.7)), Stamp::At(at(0.5)));
        let early = reading("INGGA,235959.90,2200.1,S,01756.3,W,1,12,0.7,-2.76,M,4.67,M,,");
        assert_eq!(clock.stamp(&early, at(0.9)), Stamp::At(at(-0.1)));
    }

    #[test]
    fn a_single_wrong_date_is_rejected_and_three_in_a_row_are_corrected() {
        let mut clock = MessageClock::default();
        let at = |s: f64| UtcNs(D).plus_s(s);
        let zda = |year: i32, s: i32| reading(&format!("INZDA,0000{s:02}.00,01,08,{year},,"));
        assert_eq!(clock.stamp(&zda(2014, 1), at(1.1)), Stamp::At(at(1.0)));
        assert_eq!(clock.stamp(&zda(2080, 2), at(2.1)), Stamp::Jumped);
        assert_eq!(clock.stamp(&zda(2014, 3), at(3.1)), Stamp::At(at(3.0)));
        assert_eq!(clock.stamp(&zda(2015, 4), at(4.1)), Stamp::Jumped);
        assert_eq!(clock.stamp(&zda(2015, 5), at(5.1)), Stamp::Jumped);
        assert_eq!(clock.stamp(&zda(2015, 6), at(6.2)), Stamp::At(at(6.0)));
        let gga = reading("INGGA,000007.25,2200.1,S,01756.3,W,1,12,0.7,-2.76,M,4.67,M,,");
        assert_eq!(clock.stamp(&gga, at(7.3)), Stamp::At(at(7.25)));
        // The clock returns to the time of the arrivals.
        assert_eq!(clock.stamp(&zda(2014, 8), at(8.1)), Stamp::Jumped);
        assert_eq!(clock.stamp(&zda(2014, 9), at(9.1)), Stamp::At(at(9.0)));
        assert_eq!(clock.stamp(&zda(2014, 10), at(10.1)), Stamp::At(at(10.0)));
        // Without stamps, the step is a pause, and the next day is accepted.
        let mut plain = MessageClock::default();
        plain.ignore_arrival_dates();
        let day = 86_400.0;
        let next = |s: i32| reading(&format!("INZDA,0000{s:02}.00,02,08,2014,,"));
        assert_eq!(plain.stamp(&zda(2014, 1), at(0.0)), Stamp::At(at(1.0)));
        assert_eq!(plain.stamp(&next(2), at(0.0)), Stamp::Jumped);
        assert_eq!(plain.stamp(&next(3), at(0.0)), Stamp::Jumped);
        assert_eq!(plain.stamp(&next(4), at(0.0)), Stamp::At(at(4.0 + day)));
    }

    /// Dated and undated sentences alternate at 10 Hz. The source's clock is wrong for 3 s, from its first sentence or later.
    #[test]
    fn a_clock_that_was_wrong_for_seconds_is_followed_again_within_a_second() {
        let days = |n: f64| (n * 86_400.0) as i64;
        let wrong_s = [
            -days(12_600.0),
            days(24_000.0),
            -51 * 3600,
            20 * 3600,
            12 * 3600,
            -12 * 3600,
        ];
        let cases = wrong_s.into_iter().flat_map(|off| {
            let starts = [0.0, 30.0];
            starts.map(|start| [true, false].map(|has_dates| (off, start, has_dates)))
        });
        for (off_s, began_s, has_dates) in cases.flatten() {
            let mut clock = MessageClock::default();
            for step in 0..600 {
                let truth_s = f64::from(step) / 10.0;
                let is_wrong = (began_s..began_s + 3.0).contains(&truth_s);
                let shown = UtcNs(D).plus_s(truth_s + if is_wrong { off_s as f64 } else { 0.0 });
                let utc = chrono::DateTime::from_timestamp_nanos(shown.0);
                let (time, date) = (utc.format("%H%M%S%.3f"), utc.format("%d%m%y"));
                let jitter_s = f64::from(step % 7) * 1e-3;
                for text in [
                    format!("INRMC,{time},A,2200.1,S,01756.3,W,9.1,215.11,{date},24.7,W,A"),
                    format!("INGGA,{time},2200.1,S,01756.3,W,1,12,0.7,-2.76,M,4.67,M,,"),
                    format!("PASHR,{time},218.0,T,1.0,2.0,0.1,0.1,0.1,0.1,1,0"),
                ] {
                    if text.starts_with("INRMC") && !has_dates {
                        continue;
                    }
                    let arrival = UtcNs(D).plus_s(truth_s + 0.04 + jitter_s);
                    let stamp = clock.stamp(&reading(&text), arrival);
                    if !is_wrong && !(began_s..began_s + 4.0).contains(&truth_s) {
                        let Stamp::At(found) = stamp else {
                            panic!("{off_s} s from {began_s} s: {stamp:?} at {truth_s} s");
                        };
                        let error_ns = distance(found, UtcNs(D).plus_s(truth_s));
                        assert!(
                            error_ns < 2_000_000,
                            "{off_s} s from {began_s} s: {error_ns} ns"
                        );
                        assert_eq!(clock.state(), ClockState::Right);
                    }
                }
            }
        }
    }

    #[test]
    fn clock_steps_are_corrected_and_leap_seconds_do_not_jump() {
        let at = |s: f64| UtcNs(D).plus_s(s);
        let gga = |h: i32, s: i32| {
            reading(&format!(
                "INGGA,{h:02}00{s:02}.00,2200.1,S,01756.3,W,1,12,0.7,-2.76,M,4.67,M,,"
            ))
        };
        let mut clock = MessageClock::default();
        assert_eq!(clock.stamp(&gga(0, 1), at(1.1)), Stamp::At(at(1.0)));
        assert_eq!(clock.stamp(&gga(1, 2), at(2.1)), Stamp::Jumped);
        assert_eq!(clock.stamp(&gga(1, 3), at(3.1)), Stamp::Jumped);
        assert_eq!(clock.stamp(&gga(1, 4), at(4.1)), Stamp::At(at(4.0)));
        assert_eq!(clock.stamp(&gga(1, 5), at(5.1)), Stamp::At(at(5.0)));
        // 2016-12-31T23:59:60Z counts as the first second of the next day, as in POSIX; nothing jumps.
        let mut clock = MessageClock::default();
        let eve = |s: f64| UtcNs(1_483_228_799 * NS_PER_S).plus_s(s);
        let zda = |text: &str, day: &str| reading(&format!("GPZDA,{text},{day},00,00"));
        let stamps = [
            (zda("235959.00", "31,12,2016"), 0.1, 0.0),
            (zda("235960.00", "31,12,2016"), 1.1, 1.0),
            (zda("000000.00", "01,01,2017"), 2.1, 1.0),
            (zda("000001.00", "01,01,2017"), 3.1, 2.0),
        ];
        for (zda, arrival, want) in stamps {
            assert_eq!(clock.stamp(&zda, eve(arrival)), Stamp::At(eve(want)));
        }
    }

    #[test]
    fn a_pause_ends_the_burst() {
        let mut clock = MessageClock::default();
        let at = |s: f64| UtcNs(D).plus_s(s);
        clock.arrived(at(0.28));
        let zda = reading("INZDA,000000.17,01,08,2014,,");
        clock.stamp(&zda, at(0.28));
        clock.arrived(at(0.52));
        assert_eq!(clock.burst(), Some(at(0.17)));
        clock.arrived(at(1.28));
        assert_eq!(clock.burst(), None);
    }
}
