//! The only clock reads: the machine's clocks, a clock that runs faster or slower or stands, and one for replays and tests.

use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use echotank_core::time::{MonoNs, UtcNs};

/// Where the house reads time and waits. `run` holds the system clock, `replay` and the tests a virtual one.
pub trait Clock: Send + Sync {
    fn mono(&self) -> MonoNs;
    /// The host's own idea of UTC.
    fn host_utc(&self) -> UtcNs;
    /// Returns at or after `deadline`, an absolute instant: waiting never drifts.
    fn sleep_until(&self, deadline: MonoNs);
    /// As [`Clock::sleep_until`], but returns as soon as `wake_up` has been level, too.
    fn wait_until(&self, deadline: MonoNs, _wake_up: &WakeUp) {
        self.sleep_until(deadline);
    }
    /// Whoever dozes looks at its bell.
    fn wake(&self) {}
}

/// Wakes one who dozes on a clock. A ring is kept until it is heard.
#[derive(Debug, Default)]
pub struct WakeUp(std::sync::atomic::AtomicBool);

impl WakeUp {
    pub fn ring(&self, clock: &dyn Clock) {
        self.0.store(true, std::sync::atomic::Ordering::Release);
        clock.wake();
    }

    /// Whether it was level since this was last asked.
    fn heard(&self) -> bool {
        self.0.swap(false, std::sync::atomic::Ordering::AcqRel)
    }
}

/// The machine's clocks.
pub struct SystemClock {
    start: Instant,
}

impl SystemClock {
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

/// A clock that stands still until it is told: for `replay` and tests.
#[derive(Default)]
pub struct VirtualClock {
    mono_ns: std::sync::atomic::AtomicI64,
    host_minus_mono_ns: i64,
}

impl VirtualClock {
    /// Mono starts at zero, when the host's clock shows `host_utc`.
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
    /// Time passes at once.
    fn sleep_until(&self, deadline: MonoNs) {
        self.mono_ns
            .fetch_max(deadline.0, std::sync::atomic::Ordering::AcqRel);
    }
}

/// The machine's clock made faster, slower, or stopped: `realtime` and `scaled` run on it, and pause stops it.
pub struct PacedClock {
    machine: SystemClock,
    pace: std::sync::Mutex<Pace>,
    changed: std::sync::Condvar,
}

/// This clock showed `mono_ns` when the machine's showed `machine_ns`, and has gone at `rate` since, or stood.
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
        // At rate 1 not through f64: after 104 days it would lose nanoseconds.
        let shown_ns = if self.rate == 1.0 {
            gone_ns
        } else {
            (gone_ns as f64 * self.rate) as i64
        };
        MonoNs(self.mono_ns.saturating_add(shown_ns))
    }
}

impl PacedClock {
    /// Goes `rate` times as fast as the machine's; 1 is real time.
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

    /// Stands still from now on; who sleeps sleeps on.
    pub fn stop(&self) {
        self.set(true);
    }

    /// Goes on from where it stood.
    pub fn go(&self) {
        self.set(false);
    }

    pub(crate) fn is_stopped(&self) -> bool {
        self.lock().stopped
    }

    pub fn rate(&self) -> f64 {
        self.lock().rate
    }

    /// Goes at another rate from now on, without a jump.
    pub fn set_rate(&self, rate: f64) {
        assert!(rate > 0.0 && rate.is_finite(), "a rate of {rate}");
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

    /// A pace is written in one go, with nothing in between that panics.
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
    /// The host's UTC, off by as much as this clock is off the machine's.
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
        // With the lock: a sleeper that has just looked at its bell is asleep before it is woken.
        let _pace = self.lock();
        self.changed.notify_all();
    }
}

impl PacedClock {
    fn sleep(&self, deadline: MonoNs, wake_up: Option<&WakeUp>) {
        let mut pace = self.lock();
        loop {
            let left_ns = deadline.0 - pace.at(self.machine.mono()).0;
            if left_ns <= 0 || wake_up.is_some_and(WakeUp::heard) {
                return;
            }
            // What is left is worked out anew from absolute instants after every waking, so waiting never drifts.
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
    fn a_scaled_clock_shows_so_many_times_what_the_machine_shows() {
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
    fn a_stopped_clock_stands_and_goes_on_from_where_it_stood() {
        let clock = PacedClock::at_rate(1000.0);
        clock.stop();
        let stood = clock.mono();
        std::thread::sleep(Duration::from_millis(3));
        assert_eq!(clock.mono(), stood);
        std::thread::scope(|scope| {
            let sleeper = scope.spawn(|| clock.sleep_until(stood.plus_ns(NS_PER_S)));
            std::thread::sleep(Duration::from_millis(3));
            assert!(!sleeper.is_finished(), "a second of a clock that stands");
            clock.go();
            sleeper.join().expect("woken");
        });
        assert!(clock.mono() >= stood.plus_ns(NS_PER_S));
    }

    #[test]
    fn a_bell_wakes_who_dozes_even_while_time_stands_and_is_kept_until_it_is_heard() {
        let clock = PacedClock::at_rate(1.0);
        clock.stop();
        let wake_up = WakeUp::default();
        let far = clock.mono().plus_ns(3600 * NS_PER_S);
        wake_up.ring(&clock);
        clock.wait_until(far, &wake_up);
        std::thread::scope(|scope| {
            let sleeper = scope.spawn(|| clock.wait_until(far, &wake_up));
            wake_up.ring(&clock);
            sleeper.join().expect("woken");
        });
        assert!(clock.mono() < far);
    }

    #[test]
    fn another_rate_holds_from_now_on_and_wakes_who_sleeps() {
        let clock = PacedClock::at_rate(1e-3);
        let before = clock.mono();
        std::thread::scope(|scope| {
            let sleeper = scope.spawn(|| clock.sleep_until(before.plus_ns(NS_PER_S)));
            clock.set_rate(1e6);
            sleeper.join().expect("woken");
        });
        assert!(clock.mono() >= before.plus_ns(NS_PER_S));
        clock.stop();
        let stood = clock.mono();
        clock.set_rate(2.0);
        assert!(clock.is_stopped() && clock.rate() == 2.0);
        assert_eq!(clock.mono(), stood);
    }

    #[test]
    fn a_clock_at_rate_one_keeps_the_machines_nanoseconds() {
        let pace = Pace {
            machine_ns: 0,
            mono_ns: 0,
            rate: 1.0,
            stopped: false,
        };
        // A year, beyond the whole numbers of f64.
        let late = MonoNs(31_536_000 * NS_PER_S + 1);
        assert_eq!(pace.at(late), late);
    }
}
