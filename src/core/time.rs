//! Instants on the two time axes, and the conversion between them.
//!
//! Mono time is the monotonic clock of the machine; pacing uses it. Rig time is UTC on the timeline of the navigation: with a log
//! of 2014, pings are in 2014. Every [`UtcNs`] is rig time. [`Timeline`] converts between the axes.

/// Nanoseconds per second.
pub const NS_PER_S: i64 = 1_000_000_000;

/// UTC, nanoseconds since 1970-01-01T00:00:00Z without leap seconds.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct UtcNs(pub i64);

/// Monotonic time, nanoseconds since an arbitrary start of this process.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct MonoNs(pub i64);

macro_rules! instant {
    ($name:ident) => {
        impl $name {
            /// Adds `ns` nanoseconds (saturating).
            pub fn plus_ns(self, ns: i64) -> Self {
                Self(self.0.saturating_add(ns))
            }
            /// Adds `s` seconds, rounded to the nearest nanosecond.
            pub fn plus_s(self, s: f64) -> Self {
                self.plus_ns((s * NS_PER_S as f64).round() as i64)
            }
            /// `self - earlier` in seconds; exact in f64 for spans up to 104 days.
            pub fn seconds_since(self, earlier: Self) -> f64 {
                self.0.saturating_sub(earlier.0) as f64 / NS_PER_S as f64
            }
        }
    };
}
instant!(UtcNs);
instant!(MonoNs);

/// Conversion from mono to rig time: `utc = mono + offset`. The offset is fixed, so that a date jump in the navigation does not
/// move the pings.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Timeline {
    /// Rig time minus mono time, nanoseconds.
    pub utc_minus_mono_ns: i64,
}

impl Timeline {
    /// Timeline on which `mono` and `utc` are the same instant.
    pub fn through(mono: MonoNs, utc: UtcNs) -> Self {
        Self {
            utc_minus_mono_ns: utc.0.saturating_sub(mono.0),
        }
    }
    /// Rig time of a mono time.
    pub fn utc(&self, mono: MonoNs) -> UtcNs {
        UtcNs(mono.0.saturating_add(self.utc_minus_mono_ns))
    }
    /// Mono time of a rig time.
    pub fn mono(&self, utc: UtcNs) -> MonoNs {
        MonoNs(utc.0.saturating_sub(self.utc_minus_mono_ns))
    }
}
