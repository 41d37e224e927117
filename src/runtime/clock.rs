//! All clock reads of the program: the system clock, a scaled clock that can be paused, and a virtual clock for replays and tests.

use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use echotank_core::time::{MonoNs, UtcNs};

/// A source of time on which threads wait. `run` uses a [`PacedClock`]; `replay` and the tests use a [`VirtualClock`].
pub trait Clock: Send + Sync {
    /// Monotonic time since the clock's start.
    fn mono(&self) -> MonoNs;
    /// UTC as the host's clock shows it.
    fn host_utc(&self) -> UtcNs;
    /// Sleeps until `deadline`. The deadline is an absolute instant, so repeated waits do not drift.
    fn sleep_until(&self, deadline: MonoNs);
    /// Waits as [`Clock::sleep_until`] does, but returns early once `wake_up` is notified.
    fn wait_until(&self, deadline: MonoNs, _wake_up: &WakeUp) {
        self.sleep_until(deadline);
    }
    /// Makes every thread in [`Clock::wait_until`] check its wake-up.
    fn wake(&self) {}
}

/// Wakes one thread that waits on a clock. A notification is kept until the thread takes it.
#[derive(Debug, Default)]
pub struct WakeUp(std::sync::atomic::AtomicBool);

impl WakeUp {
    /// Wakes the thread that waits on `clock` with this wake-up, or makes its next wait return at once.
    pub fn notify(&self, clock: &dyn Clock) {
        self.0.store(true, std::sync::atomic::Ordering::Release);
        clock.wake();
    }

    /// Takes the pending notification, if there is one.
    fn take(&self) -> bool {
        self.0.swap(false, std::sync::atomic::Ordering::AcqRel)
    }
}

/// The operating system's monotonic and UTC clocks.
pub struct SystemClock {
    start: Instant,
}

impl SystemClock {
    /// A clock whose monotonic time starts at zero now.
    pub fn new() -> Self {
        Self {
            start: Instant::now(),
        }
    }
}

impl Default for SystemClock {
    fn default() -> Self {
        Self::new()
    }
}

impl Clock for SystemClock {
    fn mono(&self) -> MonoNs {
        MonoNs(self.start.elapsed().as_nanos() as i64)
    }
    fn host_utc(&self) -> UtcNs {
        let since_epoch = SystemTime::now()
            .duration_since(UNIX_EPOCH)
            .unwrap_or(Duration::ZERO);
        UtcNs(since_epoch.as_nanos() as i64)
    }
    fn sleep_until(&self, deadline: MonoNs) {
        loop {
            let left_ns = deadline.0 - self.mono().0;
            if left_ns <= 0 {
                return;
            }
            std::thread::sleep(Duration::from_nanos(left_ns as u64));
        }
    }
}

/// A clock for `replay` and tests that advances only when a thread sleeps on it.
#[derive(Default)]
pub struct VirtualClock {
    mono_ns: std::sync::atomic::AtomicI64,
    host_minus_mono_ns: i64,
}

impl VirtualClock {
    /// A clock whose monotonic time is zero when the host's clock shows `host_utc`.
    pub fn starting_at(host_utc: UtcNs) -> Self {
        Self {
            mono_ns: 0.into(),
            host_minus_mono_ns: host_utc.0,
        }
    }
}

impl Clock for VirtualClock {
    fn mono(&self) -> MonoNs {
        MonoNs(self.mono_ns.load(std::sync::atomic::Ordering::Acquire))
    }
    fn host_utc(&self) -> UtcNs {
        UtcNs(self.mono().0.saturating_add(self.host_minus_mono_ns))
    }
    /// Advances the clock to `deadline` and returns at once.
    fn sleep_until(&self, deadline: MonoNs) {
        self.mono_ns
            .fetch_max(deadline.0, std::sync::atomic::Ordering::AcqRel);
    }
}

/// The system clock scaled by a rate, which can be paused. The `realtime` and `scaled` modes use it.
pub struct PacedClock {
    machine: SystemClock,
    pace: std::sync::Mutex<Pace>,
    changed: std::sync::Condvar,
}

/// The linear map from system time to this clock's time, valid since `machine_ns`.
///
/// The clock shows `mono_ns` at the system's `machine_ns` and then runs at `rate`, unless it is stopped.
#[derive(Clone, Copy)]
struct Pace {
    machine_ns: i64,
    mono_ns: i64,
    rate: f64,
    stopped: bool,
}

impl Pace {
    fn at(&self, machine: MonoNs) -> MonoNs {
        if self.stopped {
            return MonoNs(self.mono_ns);
        }
        let gone_ns = machine.0 - self.machine_ns;
        // An f64 holds whole nanoseconds for 104 days only, so rate 1 stays in integers.
        let shown_ns = if self.rate == 1.0 {
            gone_ns
        } else {
            (gone_ns as f64 * self.rate) as i64
        };
        MonoNs(self.mono_ns.saturating_add(shown_ns))
    }
}

impl PacedClock {
    /// A clock that runs `rate` times as fast as the system's; 1 is real time.
    pub(crate) fn at_rate(rate: f64) -> Self {
        Self {
            machine: SystemClock::new(),
            pace: std::sync::Mutex::new(Pace {
                machine_ns: 0,
                mono_ns: 0,
                rate,
                stopped: false,
            }),
            changed: std::sync::Condvar::new(),
        }
    }

    /// Stops the clock. Sleeping threads continue to sleep.
    pub fn stop(&self) {
        self.set(true);
    }

    /// Restarts the clock from the time at which it stopped.
    pub fn restart(&self) {
        self.set(false);
    }

    #[cfg(test)]
    pub(crate) fn is_stopped(&self) -> bool {
        self.lock().stopped
    }

    /// Clock seconds per system second.
    pub fn rate(&self) -> f64 {
        self.lock().rate
    }

    /// Changes the rate without a jump in time. Panics unless `rate` is positive and finite.
    pub fn set_rate(&self, rate: f64) {
        assert!(
            rate > 0.0 && rate.is_finite(),
            "clock rate {rate}: must be positive and finite"
        );
        self.change(|pace| pace.rate = rate);
    }

    fn set(&self, stopped: bool) {
        self.change(|pace| pace.stopped = stopped);
    }

    fn change(&self, change: impl FnOnce(&mut Pace)) {
        let mut pace = self.lock();
        let machine = self.machine.mono();
        pace.mono_ns = pace.at(machine).0;
        pace.machine_ns = machine.0;
        change(&mut pace);
        self.changed.notify_all();
    }

    /// Ignores poisoning: no code panics while a [`Pace`] is partly written.
    fn lock(&self) -> std::sync::MutexGuard<'_, Pace> {
        self.pace
            .lock()
            .unwrap_or_else(std::sync::PoisonError::into_inner)
    }
}

impl Clock for PacedClock {
    fn mono(&self) -> MonoNs {
        self.lock().at(self.machine.mono())
    }
    /// The host's UTC plus this clock's offset from the system's monotonic clock.
    fn host_utc(&self) -> UtcNs {
        let off_ns = self.mono().0 - self.machine.mono().0;
        self.machine.host_utc().plus_ns(off_ns)
    }
    fn sleep_until(&self, deadline: MonoNs) {
        self.sleep(deadline, None);
    }
    fn wait_until(&self, deadline: MonoNs, wake_up: &WakeUp) {
        self.sleep(deadline, Some(wake_up));
    }
    fn wake(&self) {
        // The lock ensures that a thread which has just checked its wake-up is asleep before the notification.
        let _pace = self.lock();
        self.changed.notify_all();
    }
}

impl PacedClock {
    fn sleep(&self, deadline: MonoNs, wake_up: Option<&WakeUp>) {
        let mut pace = self.lock();
        loop {
            let left_ns = deadline.0 - pace.at(self.machine.mono()).0;
            if left_ns <= 0 || wake_up.is_some_and(WakeUp::take) {
                return;
            }
            // The remaining time is computed from absolute instants after every wake-up, so waiting does not drift.
            pace = if pace.stopped {
                self.changed
                    .wait(pace)
                    .unwrap_or_else(std::sync::PoisonError::into_inner)
            } else {
                let left = Duration::from_nanos((left_ns as f64 / pace.rate).ceil() as u64);
                self.changed
                    .wait_timeout(pace, left)
                    .unwrap_or_else(std::sync::PoisonError::into_inner)
                    .0
            };
        }
    }
}

#[cfg(test)]
mod tests {
    use echotank_core::time::NS_PER_S;

    use super::*;

    #[test]
    fn a_scaled_clock_multiplies_elapsed_system_time_by_its_rate() {
        let pace = Pace {
            machine_ns: 5,
            mono_ns: 100,
            rate: 10.0,
            stopped: false,
        };
        assert_eq!(pace.at(MonoNs(8)), MonoNs(130));
        let stopped = Pace {
            stopped: true,
            ..pace
        };
        assert_eq!(stopped.at(MonoNs(1_000)), MonoNs(100));
    }

    #[test]
    fn a_stopped_clock_resumes_from_the_time_at_which_it_stopped() {
        let clock = PacedClock::at_rate(1000.0);
        clock.stop();
        let stopped_at = clock.mono();
        std::thread::sleep(Duration::from_millis(3));
        assert_eq!(clock.mono(), stopped_at);
        std::thread::scope(|scope| {
            let sleeper = scope.spawn(|| clock.sleep_until(stopped_at.plus_ns(NS_PER_S)));
            std::thread::sleep(Duration::from_millis(3));
            assert!(!sleeper.is_finished(), "the clock is stopped");
            clock.restart();
            sleeper.join().expect("woken");
        });
        assert!(clock.mono() >= stopped_at.plus_ns(NS_PER_S));
    }

    #[test]
    fn a_wake_up_ends_a_wait_on_a_stopped_clock_and_is_kept_until_taken() {
        let clock = PacedClock::at_rate(1.0);
        clock.stop();
        let wake_up = WakeUp::default();
        let far = clock.mono().plus_ns(3600 * NS_PER_S);
        wake_up.notify(&clock);
        clock.wait_until(far, &wake_up);
        std::thread::scope(|scope| {
            let sleeper = scope.spawn(|| clock.wait_until(far, &wake_up));
            wake_up.notify(&clock);
            sleeper.join().expect("woken");
        });
        assert!(clock.mono() < far);
    }

    #[test]
    fn a_new_rate_applies_at_once_and_shortens_running_sleeps() {
        let clock = PacedClock::at_rate(1e-3);
        let before = clock.mono();
        std::thread::scope(|scope| {
            let sleeper = scope.spawn(|| clock.sleep_until(before.plus_ns(NS_PER_S)));
            clock.set_rate(1e6);
            sleeper.join().expect("woken");
        });
        assert!(clock.mono() >= before.plus_ns(NS_PER_S));
        clock.stop();
        let stopped_at = clock.mono();
        clock.set_rate(2.0);
        assert!(clock.is_stopped() && clock.rate() == 2.0);
        assert_eq!(clock.mono(), stopped_at);
    }

    #[test]
    fn a_clock_at_rate_one_is_exact_to_the_nanosecond() {
        let pace = Pace {
            machine_ns: 0,
            mono_ns: 0,
            rate: 1.0,
            stopped: false,
        };
        // A year in nanoseconds exceeds 2^53.
        let late = MonoNs(31_536_000 * NS_PER_S + 1);
        assert_eq!(pace.at(late), late);
    }
}
