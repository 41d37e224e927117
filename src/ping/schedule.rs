//! Ping times of one sonar, and the orders of its pings.
//!
//! [`Schedule`] determines the transmit instant and the settings at that instant ([`PingOrder`]), from the internal schedule or from triggers.
//! [`crate::rig_schedule`] combines the schedules of all sonars.

use echotank_core::settings::SonarSettings;
use echotank_core::time::{NS_PER_S, UtcNs};

/// Minimum time between the end of a receive window and the next pulse, s, as a receiver needs to turn around.
pub const TURNAROUND_S: f64 = 1e-3;

/// Minimum time from one pulse to the next, s.
pub(crate) fn shortest_s(settings: &SonarSettings, sound_speed_m_per_s: f64) -> f64 {
    window_s(settings, sound_speed_m_per_s) + TURNAROUND_S
}

/// Time from one pulse to the next, ns: the period of the requested rate, or the minimum time that the range allows.
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

/// Receive window for these settings, s: the two-way time to the range plus the pulse, so that an echo at full range is complete.
pub fn window_s(settings: &SonarSettings, sound_speed_m_per_s: f64) -> f64 {
    2.0 * settings.range_m / sound_speed_m_per_s + settings.pulse_duration_s
}

/// Order of a ping: its number, its transmit instant and the settings at that instant.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PingOrder {
    /// Number of the ping, from 1.
    pub ping_number: u32,
    /// Start of the pulse.
    pub transmit_utc: UtcNs,
    /// Settings at that instant.
    pub settings: SonarSettings,
    /// Time since the previous order, s; 0 for the first.
    pub period_s: f64,
}

/// Internal schedule and trigger state of one sonar.
#[derive(Clone, Debug)]
pub struct Schedule {
    /// Next instant of the internal schedule, which continues while the sonar does not ping.
    pub(crate) next_utc: UtcNs,
    pub(crate) next_number: u32,
    pub(crate) last_utc: Option<UtcNs>,
    /// End of the receive window of the last ping.
    pub(crate) free_utc: UtcNs,
    /// Instant at which a queued early trigger starts its ping.
    pub(crate) queued_utc: Option<UtcNs>,
    pub(crate) sound_speed_m_per_s: f64,
}

impl Schedule {
    /// Creates a schedule with the first ping at `first_utc` and the first ping number 1.
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

    /// Instant of the next possible ping of the internal schedule.
    pub fn next_utc(&self) -> UtcNs {
        self.next_utc
    }

    /// Number of the next ping.
    pub fn next_number(&self) -> u32 {
        self.next_number
    }

    /// Next ping of the internal schedule at or before `now`. `settings_at` returns the settings at an instant, so a late call gives the same result.
    /// While pinging is off, the schedule advances without orders.
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

    /// Delays the next scheduled pulse until `utc` at the earliest.
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
        // After a triggered ping the internal schedule waits for the end of the receive window. Scheduled pings always have this distance.
        self.next_utc = self.next_utc.max(self.free_utc);
        self.next_number = self.next_number.wrapping_add(1);
        order
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// Settings with a window of 102 ms: 75 m and a pulse of 2 ms.
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
        s.range_m = 300.0; // acknowledged before the second pulse, which uses it
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
