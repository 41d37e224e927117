//! When one sonar pings, and what every ping is ordered to be.
//!
//! [`Schedule`] decides `t_tx` and freezes the settings at that instant ([`PingOrder`]), on a beat of its own or when it is triggered;
//! [`crate::beats`] has those of all sonars.

use echotank_core::settings::SonarSettings;
use echotank_core::time::{NS_PER_S, UtcNs};

/// Quiet time between the end of one listening window and the next pulse, seconds: a receiver needs some to turn around.
pub const TURNAROUND_S: f64 = 1e-3;

/// Time from one pulse to the next, at least, seconds.
pub(crate) fn shortest_s(settings: &SonarSettings, sound_speed_m_per_s: f64) -> f64 {
    window_s(settings, sound_speed_m_per_s) + TURNAROUND_S
}

/// Time from one pulse to the next, nanoseconds: the rate asked for, or as fast as the range allows.
pub fn period_ns(settings: &SonarSettings, sound_speed_m_per_s: f64) -> i64 {
    let shortest_s = shortest_s(settings, sound_speed_m_per_s);
    let asked_s = if settings.max_ping_rate_hz > 0.0 {
        1.0 / settings.max_ping_rate_hz
    } else {
        f64::INFINITY
    };
    let period_s = if asked_s.is_finite() {
        asked_s.max(shortest_s)
    } else {
        shortest_s
    };
    (period_s * NS_PER_S as f64).round() as i64
}

/// Listening window for these settings: two-way time to the range plus the pulse, so that an echo at full range is whole. Seconds.
pub fn window_s(settings: &SonarSettings, sound_speed_m_per_s: f64) -> f64 {
    2.0 * settings.range_m / sound_speed_m_per_s + settings.pulse_duration_s
}

/// A ping that will be made: its number, its instant and the settings in force at that instant.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PingOrder {
    /// From 1.
    pub ping_number: u32,
    /// Start of the pulse.
    pub transmit_utc: UtcNs,
    /// Settings in force at that instant.
    pub settings: SonarSettings,
    /// Since the previous order; 0 for the first.
    pub period_s: f64,
}

/// When one sonar pings: on its own beat, and when it is triggered.
#[derive(Clone, Debug)]
pub struct Schedule {
    /// Of the beat, which goes on while the sonar does not ping.
    pub(crate) next_utc: UtcNs,
    pub(crate) next_number: u32,
    pub(crate) last_utc: Option<UtcNs>,
    /// The last ping's window is over.
    pub(crate) free_utc: UtcNs,
    /// A trigger that came too early, and is obeyed then.
    pub(crate) queued_utc: Option<UtcNs>,
    pub(crate) sound_speed_m_per_s: f64,
}

impl Schedule {
    /// First beat at `first_utc`, first ping number 1.
    pub fn starting_at(first_utc: UtcNs, sound_speed_m_per_s: f64) -> Self {
        Self {
            next_utc: first_utc,
            next_number: 1,
            last_utc: None,
            free_utc: first_utc,
            queued_utc: None,
            sound_speed_m_per_s,
        }
    }

    /// When the next ping may go out on the beat.
    pub fn next_utc(&self) -> UtcNs {
        self.next_utc
    }

    /// The number it will have.
    pub fn next_number(&self) -> u32 {
        self.next_number
    }

    /// The next ping of the beat if its instant has come. `settings_at` tells the settings that were in force at an instant: asking late
    /// changes nothing. While pinging is off the schedule keeps its beat and gives nothing.
    pub fn due(
        &mut self,
        now: UtcNs,
        settings_at: impl Fn(UtcNs) -> SonarSettings,
    ) -> Option<PingOrder> {
        while self.next_utc <= now {
            let transmit_utc = self.next_utc;
            let settings = settings_at(transmit_utc);
            self.next_utc = transmit_utc.plus_ns(period_ns(&settings, self.sound_speed_m_per_s));
            if settings.pinging && settings.max_ping_rate_hz > 0.0 {
                return Some(self.pulse(transmit_utc, settings));
            }
        }
        None
    }

    /// The beat's next pulse comes not before `utc`.
    pub fn put_off(&mut self, utc: UtcNs) {
        self.next_utc = self.next_utc.max(utc);
    }

    pub(crate) fn pulse(&mut self, transmit_utc: UtcNs, settings: SonarSettings) -> PingOrder {
        let period_s = self
            .last_utc
            .map_or(0.0, |last| transmit_utc.seconds_since(last));
        let order = PingOrder {
            ping_number: self.next_number,
            transmit_utc,
            settings,
            period_s,
        };
        self.last_utc = Some(transmit_utc);
        self.free_utc = transmit_utc.plus_s(shortest_s(&settings, self.sound_speed_m_per_s));
        // After a triggered ping the beat waits for its window; its own pings are that far apart anyway.
        self.next_utc = self.next_utc.max(self.free_utc);
        self.next_number = self.next_number.wrapping_add(1);
        order
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// A window of 102 ms: 75 m and a pulse of 2 ms.
    pub(crate) fn settings() -> SonarSettings {
        SonarSettings {
            pinging: true,
            range_m: 75.0,
            max_ping_rate_hz: 5.0,
            source_level_db: 0.0,
            gain_db: 0.0,
            pulse_duration_s: 2e-3,
        }
    }

    #[test]
    fn a_range_too_long_for_the_rate_lowers_the_rate() {
        let mut s = settings();
        assert_eq!(period_ns(&s, 1500.0), 200_000_000);
        s.range_m = 300.0;
        assert_eq!(
            period_ns(&s, 1500.0),
            403_000_000,
            "0.4 s + 2 ms pulse + 1 ms"
        );
    }

    #[test]
    fn settings_bind_at_the_instant_of_the_pulse_and_numbers_have_no_gap() {
        let mut schedule = Schedule::starting_at(UtcNs(0), 1500.0);
        let mut s = settings();
        let first = schedule.due(UtcNs(0), |_| s).expect("due at once");
        assert_eq!((first.ping_number, first.period_s), (1, 0.0));
        assert!(schedule.due(UtcNs(199_999_999), |_| s).is_none());
        s.range_m = 300.0; // acknowledged before the second pulse: obeyed by it
        let second = schedule.due(UtcNs(200_000_000), |_| s).expect("due");
        assert_eq!(
            (second.ping_number, second.settings.range_m, second.period_s),
            (2, 300.0, 0.2)
        );
        assert_eq!(schedule.next_utc(), UtcNs(603_000_000));
        s.pinging = false;
        assert!(schedule.due(UtcNs(2_000_000_000), |_| s).is_none());
        s.pinging = true;
        let third = schedule.due(UtcNs(5_000_000_000), |_| s).expect("due");
        assert_eq!(third.ping_number, 3);
    }
}
