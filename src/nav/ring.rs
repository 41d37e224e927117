//! Recent knots of one channel, sorted by time of validity, and the rates between them.

use std::collections::VecDeque;
use std::ops::Range;

use glam::{DQuat, DVec3};

use echotank_core::frames::{AttitudeKnot, VectorKnot};
use echotank_core::navigation::FixQuality;
use echotank_core::time::UtcNs;

/// Maximum number of knots of a ring at any configured depth: 160 s at 100 Hz, 1 MiB.
pub(crate) const MAX_KNOTS: usize = 16_384;
/// Minimum distance in time of the knots that give the rate at the newest knot, seconds. Extrapolation uses this rate. Between
/// neighbouring knots at 100 Hz, one resolution step of 0.01 deg would give a rate of 1 deg/s.
const END_BASELINE_S: f64 = 0.05;

/// Value of a channel at one time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Knot {
    /// Time of validity.
    pub utc: UtcNs,
    /// Value of the channel; the channel defines the axes and the unit.
    pub value: DVec3,
    /// Fix quality of a position; `None` for other channels.
    pub fix: FixQuality,
}

/// Result of [`Ring::insert`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Inserted {
    /// The knot is the newest.
    AtTheEnd,
    /// The knot precedes an existing one.
    OutOfOrder,
    /// A knot with this time exists; the new one is dropped.
    Duplicate,
}

/// Time interval without a seam: `start <= t < end`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Stretch {
    /// First instant.
    pub start: UtcNs,
    /// First instant after the interval.
    pub end: UtcNs,
}

/// Bounded buffer of knots with distinct, increasing times.
#[derive(Clone, Debug, Default)]
pub struct Ring {
    knots: VecDeque<Knot>,
}

impl Ring {
    /// Inserts a knot and drops knots more than `depth_ns` older than the newest knot.
    pub fn insert(&mut self, knot: Knot, depth_ns: i64) -> Inserted {
        let at = self.first_at_or_after(knot.utc);
        if self.knots.get(at).is_some_and(|k| k.utc == knot.utc) {
            return Inserted::Duplicate;
        }
        let inserted = if at == self.knots.len() {
            Inserted::AtTheEnd
        } else {
            Inserted::OutOfOrder
        };
        self.knots.insert(at, knot);
        let oldest = self.newest().map_or(knot.utc, |n| n.plus_ns(-depth_ns));
        while self.knots.len() > MAX_KNOTS || self.knots.front().is_some_and(|k| k.utc < oldest) {
            self.knots.pop_front();
        }
        inserted
    }

    /// Time of the newest knot.
    pub fn newest(&self) -> Option<UtcNs> {
        self.knots.back().map(|k| k.utc)
    }

    /// The newest knot.
    pub fn last(&self) -> Option<&Knot> {
        self.knots.back()
    }

    /// Time of the oldest knot.
    pub fn oldest(&self) -> Option<UtcNs> {
        self.knots.front().map(|k| k.utc)
    }

    /// The newest knot not after `utc`.
    pub(crate) fn last_at_or_before(&self, utc: UtcNs) -> Option<&Knot> {
        let after = self.knots.partition_point(|k| k.utc <= utc);
        after.checked_sub(1).and_then(|i| self.knots.get(i))
    }

    /// Time of the `count`-th knot at or after `utc`.
    pub(crate) fn nth_at_or_after(&self, utc: UtcNs, count: usize) -> Option<UtcNs> {
        let first = self.first_at_or_after(utc);
        self.knots.get(first + count - 1).map(|k| k.utc)
    }

    fn first_at_or_after(&self, utc: UtcNs) -> usize {
        // Most knots are newer than all others.
        if self.knots.back().is_none_or(|k| k.utc < utc) {
            return self.knots.len();
        }
        self.knots.partition_point(|k| k.utc < utc)
    }

    /// Index range of the knots in `stretch`.
    pub fn within(&self, stretch: Stretch) -> Range<usize> {
        self.first_at_or_after(stretch.start)..self.first_at_or_after(stretch.end)
    }

    /// Index range of the knots of `stretch` around `from..=to`. It has up to two knots at or before `from` and up to `ahead` knots
    /// at or after `to`.
    pub fn around(&self, from: UtcNs, to: UtcNs, ahead: usize, stretch: Stretch) -> Range<usize> {
        let all = self.within(stretch);
        let after_from = self.knots.partition_point(|k| k.utc <= from);
        let start = after_from.saturating_sub(2).clamp(all.start, all.end);
        let end = (self.first_at_or_after(to) + ahead).clamp(start, all.end);
        start..end
    }

    /// Knots of an index range.
    pub fn iter(&self, range: Range<usize>) -> impl DoubleEndedIterator<Item = &Knot> {
        self.knots.range(range)
    }

    /// Writes the knots of `range` to `out`, with times relative to `zero` in seconds and zero rates.
    pub fn fill(&self, range: Range<usize>, zero: UtcNs, out: &mut Vec<VectorKnot>) {
        out.clear();
        out.extend(self.iter(range).map(|k| VectorKnot {
            time_s: k.utc.seconds_since(zero),
            value: k.value,
            rate_per_s: DVec3::ZERO,
        }));
    }
}

/// Sets the rates of vector knots from their values and times.
pub(crate) fn set_rates(knots: &mut [VectorKnot]) {
    for i in 0..knots.len() {
        let rate = three_point_rate(
            i,
            knots.len(),
            |k| knots[k].time_s,
            |a, b| (knots[b].value - knots[a].value) / (knots[b].time_s - knots[a].time_s),
        );
        knots[i].rate_per_s = rate;
    }
}

/// Sets the body rates of attitude knots from the rotation vectors between knots.
pub(crate) fn set_body_rates(knots: &mut [AttitudeKnot]) {
    for i in 0..knots.len() {
        let rate = three_point_rate(
            i,
            knots.len(),
            |k| knots[k].time_s,
            |a, b| {
                turn(knots[a].world_from_body, knots[b].world_from_body)
                    / (knots[b].time_s - knots[a].time_s)
            },
        );
        knots[i].body_rate_rad_per_s = rate;
    }
}

/// Rotation vector from `a` to `b` along the shorter arc, body axes.
fn turn(a: DQuat, b: DQuat) -> DVec3 {
    let between = a.inverse() * b;
    let short = if between.w < 0.0 { -between } else { between };
    short.to_scaled_axis()
}

/// Derivative at knot `i` of the parabola through three knots with unequal steps. With two knots, the slope of the line; with one
/// knot, zero. `slope(a, b)` is the mean rate from knot a to knot b > a.
fn three_point_rate(
    i: usize,
    len: usize,
    time_s: impl Fn(usize) -> f64,
    slope: impl Fn(usize, usize) -> DVec3,
) -> DVec3 {
    if len < 2 {
        return DVec3::ZERO;
    }
    // The last knot that is at least the baseline before `k`, or the first knot.
    let back = |k: usize| {
        let neighbour = k.checked_sub(1)?;
        let far = (0..=neighbour)
            .rev()
            .find(|&j| time_s(k) - time_s(j) >= END_BASELINE_S);
        Some(far.unwrap_or(0))
    };
    if i == 0 {
        let near = slope(0, 1);
        if len == 2 {
            return near;
        }
        let (h1, h2) = (time_s(1) - time_s(0), time_s(2) - time_s(1));
        return near - (slope(1, 2) - near) * (h1 / (h1 + h2));
    }
    if i + 1 == len {
        let middle = back(i).unwrap_or(0);
        let near = slope(middle, i);
        let Some(far) = back(middle) else {
            return near;
        };
        let (h1, h2) = (time_s(middle) - time_s(far), time_s(i) - time_s(middle));
        return near + (near - slope(far, middle)) * (h2 / (h1 + h2));
    }
    let (h1, h2) = (time_s(i) - time_s(i - 1), time_s(i + 1) - time_s(i));
    (slope(i - 1, i) * h2 + slope(i, i + 1) * h1) / (h1 + h2)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn knot(t: i64) -> Knot {
        Knot {
            utc: UtcNs(t),
            value: DVec3::splat(t as f64),
            fix: FixQuality::None,
        }
    }
    const ALL: Stretch = Stretch {
        start: UtcNs(i64::MIN),
        end: UtcNs(i64::MAX),
    };

    #[test]
    fn knots_stay_sorted_unique_and_bounded() {
        let mut ring = Ring::default();
        for t in [10, 30, 20, 20, 40, 5] {
            ring.insert(knot(t), 25);
        }
        let times: Vec<i64> = ring.iter(ring.within(ALL)).map(|k| k.utc.0).collect();
        assert_eq!(times, [20, 30, 40], "10 and 5 are deeper than 25");
        assert_eq!(ring.insert(knot(30), 25), Inserted::Duplicate);
        assert_eq!(ring.insert(knot(25), 25), Inserted::OutOfOrder);
        for t in 0..2 * MAX_KNOTS as i64 {
            ring.insert(knot(100 + t), i64::MAX);
        }
        assert_eq!(ring.within(ALL).len(), MAX_KNOTS);
    }

    #[test]
    fn around_takes_two_knots_before_and_the_given_number_after() {
        let mut ring = Ring::default();
        for t in 0..10 {
            ring.insert(knot(t * 10), 1000);
        }
        assert_eq!(ring.around(UtcNs(35), UtcNs(52), 2, ALL), 2..8);
        assert_eq!(ring.around(UtcNs(-5), UtcNs(2), 2, ALL), 0..3);
        assert_eq!(ring.around(UtcNs(200), UtcNs(300), 2, ALL), 8..10);
        let cut = Stretch {
            start: UtcNs(25),
            end: UtcNs(65),
        };
        assert_eq!(ring.around(UtcNs(35), UtcNs(52), 2, cut), 3..7);
    }

    #[test]
    fn rates_are_exact_on_a_parabola_with_unequal_steps() {
        let f = |t: f64| DVec3::new(3.0 * t * t - t, -t * t, 2.0 * t);
        let d = |t: f64| DVec3::new(6.0 * t - 1.0, -2.0 * t, 2.0);
        let mut knots: Vec<_> = [0.0, 0.3, 0.4, 1.1, 1.12, 1.13]
            .iter()
            .map(|&t| VectorKnot {
                time_s: t,
                value: f(t),
                rate_per_s: DVec3::ZERO,
            })
            .collect();
        set_rates(&mut knots);
        for k in &knots {
            let error = (k.rate_per_s - d(k.time_s)).length();
            assert!(error < 1e-10, "t = {}: {error}", k.time_s);
        }
    }
}
