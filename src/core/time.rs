//! Instants on the two time axes, and the map from one to the other.
//!
//! Two time axes exist. **Mono** is the machine's monotonic clock; pacing happens on it. **Rig time** is UTC on the timeline of the
//! navigation (a log recorded in 2014 pings in 2014); every [`UtcNs`] inside the house is rig time. [`Timeline`] maps one onto the other.

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
