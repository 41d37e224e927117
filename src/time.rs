//! The only clock reads. Everything else is told the time.
//!
//! Two time axes exist. **Mono** is the machine's monotonic clock; pacing happens on it. **Rig time** is UTC on the timeline of the
//! navigation (a log recorded in 2014 pings in 2014); every [`UtcNs`] inside the house is rig time. [`Timeline`] maps one onto the other.

use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

pub const NS_PER_S: i64 = 1_000_000_000;

/// UTC, nanoseconds since 1970-01-01T00:00:00Z, leap seconds not counted.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct UtcNs(pub i64);

/// Monotonic time, nanoseconds since an arbitrary start of this process.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct MonoNs(pub i64);

macro_rules! instant {
    ($name:ident) => {
        impl $name {
            /// This instant moved by `ns` nanoseconds (saturating).
            pub fn plus_ns(self, ns: i64) -> Self {
                Self(self.0.saturating_add(ns))
            }
            /// This instant moved by `s` seconds, rounded to the nearest nanosecond.
            pub fn plus_s(self, s: f64) -> Self {
                self.plus_ns((s * NS_PER_S as f64).round() as i64)
            }
            /// `self - earlier`, in seconds. Exact to f64 for spans up to 104 days.
            pub fn seconds_since(self, earlier: Self) -> f64 {
                self.0.saturating_sub(earlier.0) as f64 / NS_PER_S as f64
            }
        }
    };
}
instant!(UtcNs);
instant!(MonoNs);

/// Where the house reads time and waits. `run` holds the system clock, `replay` and the tests a virtual one.
pub trait Clock: Send + Sync {
    fn mono(&self) -> MonoNs;
    /// The host's own idea of UTC.
    fn host_utc(&self) -> UtcNs;
    /// Returns at or after `deadline`, an absolute instant: waiting never drifts.
    fn sleep_until(&self, deadline: MonoNs);
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

/// Maps the monotonic clock onto rig time: `utc = mono + offset`. Fixed once set, so that no date jump in the navigation moves the pings.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Timeline {
    pub utc_minus_mono_ns: i64,
}

impl Timeline {
    pub fn through(mono: MonoNs, utc: UtcNs) -> Self {
        Self {
            utc_minus_mono_ns: utc.0.saturating_sub(mono.0),
        }
    }
    pub fn utc(&self, mono: MonoNs) -> UtcNs {
        UtcNs(mono.0.saturating_add(self.utc_minus_mono_ns))
    }
    pub fn mono(&self, utc: UtcNs) -> MonoNs {
        MonoNs(utc.0.saturating_sub(self.utc_minus_mono_ns))
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
