//! When a reading holds. Comes in: time fields and arrivals. Goes out: full UTC instants, and the time of a burst for sentences without one.
//!
//! Only ZDA and RMC carry a date; the others carry a time of day that wraps at midnight. A day is chosen as the one nearest to where the
//! message clock should be by now (before any date: nearest to the arrival).
//!
//! A source whose clock is set while it runs goes on where it was: by whole seconds its times are moved back onto those before, so that
//! nobody downstream sees the step. In a log without stamps a step cannot be told from a pause, and is one.

use super::reading::{Reading, When};
use echotank_core::time::{NS_PER_S, UtcNs};

const DAY_NS: i64 = 86_400 * NS_PER_S;
/// A pause in the arrivals longer than this ends a burst: a Seapath at 1 Hz pauses up to 0.13 s inside one and 0.76 s between two; logs that
/// were played again at four lines a second pause 0.26 s.
const BURST_GAP_NS: i64 = NS_PER_S * 2 / 5;
/// A message time farther than this from where it should be is doubted.
const JUMP_NS: i64 = 10 * NS_PER_S;
/// So many doubted messages that agree with one another are believed.
const JUMP_CONFIRMATIONS: u32 = 3;

/// A receiver that does not know its epoch is off by a multiple of this.
const ROLLOVER_NS: i64 = 1024 * 7 * DAY_NS;
/// A date this near to a multiple of the rollover off the clock is taken for one.
const ROLLOVER_TOLERANCE_NS: i64 = 2 * DAY_NS;
const WEEK_NS: i64 = 7 * DAY_NS;
/// 1980-01-06T00:00:00Z.
const GPS_EPOCH_NS: i64 = 315_964_800 * NS_PER_S;
/// GPS minus UTC, seconds, from these UTC instants (seconds since 1970) on: the leap seconds since 1999 (IERS Bulletin C). Before: 13.
const LEAP_S: [(i64, i64); 5] = [
    (1_136_073_600, 14),
    (1_230_768_000, 15),
    (1_341_100_800, 16),
    (1_435_708_800, 17),
    (1_483_228_800, 18),
];

/// UTC of a GPS time counted as though GPS had no offset: nanoseconds since 1970.
pub(crate) fn utc_of_gps(gps_ns: i64) -> i64 {
    let leap_s = LEAP_S
        .iter()
        .rev()
        .find(|(from_s, leap_s)| gps_ns >= (from_s + leap_s) * NS_PER_S)
        .map_or(13, |(_, leap_s)| *leap_s);
    gps_ns.saturating_sub(leap_s * NS_PER_S)
}

/// What a message's time came to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Stamp {
    /// The message has no time.
    None,
    At(UtcNs),
    /// The time jumped; do not use the message.
    Jumped,
}

#[derive(Debug, Default)]
pub(crate) struct MessageClock {
    dated: bool,
    last: Option<(UtcNs, UtcNs)>,
    last_sentence: Option<UtcNs>,
    burst: Option<UtcNs>,
    doubt: Option<(i64, u32)>,
    /// Added to message times since the source's clock was set, whole seconds.
    shift_ns: i64,
    arrivals_distrusted: bool,
    week_rollovers: u64,
}

impl MessageClock {
    /// Every sentence of the source passes here first, understood or not: pauses between them part the bursts.
    pub(crate) fn arrived(&mut self, arrival: UtcNs) {
        if let Some(before) = self.last_sentence
            && arrival.0.saturating_sub(before.0) > BURST_GAP_NS
        {
            self.burst = None;
        }
        self.last_sentence = Some(arrival);
    }

    /// Time of the last sentence with a time in the current burst.
    pub(crate) fn burst(&self) -> Option<UtcNs> {
        self.burst
    }

    /// The last believed message time and its arrival.
    pub(crate) fn last(&self) -> Option<(UtcNs, UtcNs)> {
        self.last
    }

    /// A full date has been seen.
    pub(crate) fn is_dated(&self) -> bool {
        self.dated
    }

    /// Dates that were moved by whole rollovers.
    pub(crate) fn week_rollovers(&self) -> u64 {
        self.week_rollovers
    }

    pub(crate) fn distrust_arrivals(&mut self) {
        self.arrivals_distrusted = true;
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
            When::TimeOfDay(ns) => (nearest_day(ns, unshifted), false),
            When::GpsOfWeek(ns) => (nearest_week(ns, unshifted), false),
            When::Dated {
                day_ns,
                time_of_day_ns,
            } => (UtcNs(day_ns.saturating_add(time_of_day_ns)), true),
            When::Instant(utc) => (utc, true),
        };
        let message = if dated {
            self.unrolled(message, arrival)
        } else {
            message
        };
        let first_date = dated && !self.dated;
        if first_date {
            self.shift_ns = 0;
        }
        let mut message = message.plus_ns(self.shift_ns);
        if self.last.is_some() && !first_date && self.doubts(message, expected, arrival) {
            return Stamp::Jumped;
        }
        let off_ns = expected.0.saturating_sub(message.0);
        let set_anew = self.last.is_some() && !first_date && off_ns.saturating_abs() > JUMP_NS;
        if set_anew && !self.arrivals_distrusted {
            // The fraction is the source's own: only the latencies would be mixed into it.
            let step_ns = (off_ns as f64 / NS_PER_S as f64).round() as i64 * NS_PER_S;
            self.shift_ns = self.shift_ns.saturating_add(step_ns);
            message = message.plus_ns(step_ns);
        }
        self.dated |= dated;
        self.last = Some((message, arrival));
        self.burst = Some(message);
        Stamp::At(message)
    }

    /// Moved by the rollovers that part it from the arrival, if nothing else does.
    fn unrolled(&mut self, message: UtcNs, arrival: UtcNs) -> UtcNs {
        let off_ns = message.0.saturating_sub(arrival.0);
        let rolls = (off_ns as f64 / ROLLOVER_NS as f64).round() as i64;
        let rest_ns = off_ns.saturating_sub(rolls * ROLLOVER_NS).saturating_abs();
        if self.arrivals_distrusted || rolls == 0 || rest_ns > ROLLOVER_TOLERANCE_NS {
            return message;
        }
        self.week_rollovers += 1;
        message.plus_ns(-rolls * ROLLOVER_NS)
    }

    fn doubts(&mut self, message: UtcNs, expected: UtcNs, arrival: UtcNs) -> bool {
        if message.0.saturating_sub(expected.0).saturating_abs() <= JUMP_NS {
            self.doubt = None;
            return false;
        }
        let offset = message.0.saturating_sub(arrival.0);
        let seen = match self.doubt {
            Some((before, seen)) if offset.saturating_sub(before).saturating_abs() <= JUMP_NS => {
                seen + 1
            }
            _ => 1,
        };
        self.doubt = (seen < JUMP_CONFIRMATIONS).then_some((offset, seen));
        seen < JUMP_CONFIRMATIONS
    }
}

/// The instant with this time of day that lies nearest to `reference`.
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

/// The instant of this GPS time of week that lies nearest to `reference`.
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
    fn a_receiver_1024_weeks_behind_is_moved_to_the_clock_s_date() {
        let at = |s: f64| UtcNs(D).plus_s(s);
        // 1024 weeks before 2014-08-01 was 1994-12-16.
        let zda = reading("GPZDA,000001.00,16,12,1994,,");
        let mut clock = MessageClock::default();
        assert_eq!(clock.stamp(&zda, at(1.1)), Stamp::At(at(1.0)));
        assert_eq!(clock.week_rollovers(), 1);
        let mut untimed = MessageClock::default();
        untimed.distrust_arrivals();
        let rollover_s = 1024.0 * 7.0 * 86400.0;
        assert_eq!(
            untimed.stamp(&zda, at(1.1)),
            Stamp::At(at(1.0 - rollover_s))
        );
        // A month off is no rollover.
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
    fn midnight_passes_in_either_direction() {
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
    fn a_single_wild_date_is_doubted_and_three_in_a_row_move_nothing() {
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
        // And back again.
        for s in [8, 9] {
            let back = clock.stamp(&zda(2014, s), at(f64::from(s) + 0.1));
            assert_eq!(back, Stamp::Jumped);
        }
        assert_eq!(clock.stamp(&zda(2014, 10), at(10.1)), Stamp::At(at(10.0)));
        // Without stamps it is a pause, and the day after is the day after.
        let mut plain = MessageClock::default();
        plain.distrust_arrivals();
        let day = 86_400.0;
        let next = |s: i32| reading(&format!("INZDA,0000{s:02}.00,02,08,2014,,"));
        assert_eq!(plain.stamp(&zda(2014, 1), at(0.0)), Stamp::At(at(1.0)));
        assert_eq!(plain.stamp(&next(2), at(0.0)), Stamp::Jumped);
        assert_eq!(plain.stamp(&next(3), at(0.0)), Stamp::Jumped);
        assert_eq!(plain.stamp(&next(4), at(0.0)), Stamp::At(at(4.0 + day)));
    }

    #[test]
    fn an_hour_s_step_moves_no_time_of_day_and_a_leap_second_none() {
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
        // 2016-12-31T23:59:60Z: counted as the first second of the next day, as POSIX has it; nothing jumps.
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
