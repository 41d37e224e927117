//! A token bucket on absolute time: a burst limit and a rate.
//!
//! Tokens accrue with the clock. A late wake-up therefore catches up, by at most the size of the bucket. A group larger than the bucket, such as one
//! long datagram, waits for a full bucket and leaves a negative balance.

use echotank_core::time::{MonoNs, NS_PER_S};

/// Size of the bucket, bytes: an eighth of a default socket buffer, which also holds the kernel's overhead per datagram.
pub(crate) const DEPTH_BYTES: usize = 32 * 1024;
/// Duration of a group of datagrams, ns: the thread wakes 1000 times a second, not for each datagram.
const GROUP_NS: f64 = 1e6;

/// The bucket of one stream.
#[derive(Clone, Debug)]
pub(crate) struct Bucket {
    bytes_per_s: f64,
    /// Balance at `at`, bytes; negative after a long datagram.
    level: f64,
    at: MonoNs,
}

impl Bucket {
    /// Creates a full bucket. An infinite rate never waits.
    pub(crate) fn new(bytes_per_s: f64, now: MonoNs) -> Self {
        Self {
            bytes_per_s,
            level: DEPTH_BYTES as f64,
            at: now,
        }
    }

    /// Changes the rate from `now` on.
    pub(crate) fn set_rate(&mut self, bytes_per_s: f64, now: MonoNs) {
        self.fill(now);
        self.bytes_per_s = bytes_per_s;
    }

    fn fill(&mut self, now: MonoNs) {
        let since_s = (now.0 - self.at.0).max(0) as f64 / NS_PER_S as f64;
        let come = if since_s > 0.0 {
            self.bytes_per_s * since_s
        } else {
            0.0
        };
        self.level = (self.level + come).min(DEPTH_BYTES as f64);
        self.at = self.at.max(now);
    }

    /// Number and total bytes of the next datagrams that form a group, from the lengths of the datagrams.
    pub(crate) fn group(&self, lengths: impl Iterator<Item = usize>) -> (usize, usize) {
        let full = (self.bytes_per_s * GROUP_NS / NS_PER_S as f64).clamp(1.0, DEPTH_BYTES as f64);
        let (mut count, mut bytes) = (0, 0);
        for length in lengths {
            if count > 0 && (bytes + length) as f64 > full {
                break;
            }
            count += 1;
            bytes += length;
        }
        (count, bytes)
    }

    /// Earliest send time of a group of this many bytes.
    pub(crate) fn due(&mut self, bytes: usize, now: MonoNs) -> MonoNs {
        self.fill(now);
        let short = bytes.min(DEPTH_BYTES) as f64 - self.level;
        match short > 0.0 && self.bytes_per_s.is_finite() {
            true => self.at.plus_s(short / self.bytes_per_s),
            false => now,
        }
    }

    /// Removes the bytes of a sent group from the balance.
    pub(crate) fn take(&mut self, bytes: usize, now: MonoNs) {
        self.fill(now);
        self.level -= bytes as f64;
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const MS: i64 = 1_000_000;

    /// Send time, ms, and bytes of each group if wake-ups are never late.
    fn departures(rate: f64, lengths: &[usize]) -> Vec<(f64, usize)> {
        let mut now = MonoNs(5);
        let mut bucket = Bucket::new(rate, now);
        let mut gone = Vec::new();
        let mut rest = lengths;
        while !rest.is_empty() {
            let (count, bytes) = bucket.group(rest.iter().copied());
            now = now.max(bucket.due(bytes, now));
            bucket.take(bytes, now);
            gone.push(((now.0 - 5) as f64 / MS as f64, bytes));
            rest = &rest[count..];
        }
        gone
    }

    #[test]
    fn a_bucketful_leaves_at_once_and_the_rest_at_the_rate() {
        // At 41 MB/s a ping of 2 MB takes 50 ms.
        let packets = vec![1472; 2_050_000 / 1472];
        let gone = departures(41e6, &packets);
        let bytes: usize = packets.iter().sum();
        let at_once: usize = gone.iter().filter(|g| g.0 == 0.0).map(|g| g.1).sum();
        assert!(
            at_once <= DEPTH_BYTES && at_once + 1472 > DEPTH_BYTES,
            "{at_once}"
        );
        let lasts_ms = gone.last().expect("groups").0;
        let want_ms = (bytes - DEPTH_BYTES) as f64 / 41e6 * 1e3;
        assert!((lasts_ms - want_ms).abs() < 1.0, "{lasts_ms} {want_ms}");
        assert!(gone.iter().all(|g| g.1 <= DEPTH_BYTES));
    }

    #[test]
    fn a_datagram_longer_than_the_bucket_leaves_a_debt_that_is_waited_for() {
        let gone = departures(1e6, &[60_000, 60_000, 60_000]);
        let at: Vec<_> = gone.iter().map(|g| g.0.round()).collect();
        assert_eq!(at, [0.0, 60.0, 120.0], "{gone:?}");
    }

    #[test]
    fn who_wakes_late_catches_up_and_by_no_more_than_a_bucket() {
        let mut bucket = Bucket::new(1e6, MonoNs(0));
        bucket.take(DEPTH_BYTES, MonoNs(0));
        let late = MonoNs(10 * MS);
        assert_eq!(bucket.due(10_000, late), late, "10 ms are 10 kB");
        bucket.take(10_000, late);
        assert_eq!(bucket.due(1000, late), late.plus_ns(MS));
        let much_later = MonoNs(10_000 * MS);
        bucket.take(DEPTH_BYTES, much_later);
        assert_eq!(bucket.due(1000, much_later), much_later.plus_ns(MS));
    }

    #[test]
    fn an_infinite_rate_never_waits() {
        let gone = departures(f64::INFINITY, &[60_000; 50]);
        assert!(gone.iter().all(|g| g.0 == 0.0));
    }

    proptest! {
        /// In any interval the bytes are at most a full bucket, the debt of one datagram and the rate times the interval.
        #[test]
        fn never_more_than_the_rate_and_a_bucketful(rate in 1e4..1e8_f64, lengths in proptest::collection::vec(1..65_000_usize, 1..200)) {
            let gone = departures(rate, &lengths);
            for first in 0..gone.len() {
                let mut bytes = 0;
                for group in &gone[first..] {
                    bytes += group.1;
                    let most = 2.0 * DEPTH_BYTES as f64 + 65_000.0 + rate * (group.0 - gone[first].0) / 1e3;
                    prop_assert!(bytes as f64 <= most, "{bytes} {most}");
                }
            }
        }
    }
}
