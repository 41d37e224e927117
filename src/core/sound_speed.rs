//! Sound speed over depth.

use std::fmt;

use thiserror::Error;

/// Sound speed over depth, linear between its points. Above the first and below the last point it is constant.
#[derive(Clone, Debug, PartialEq)]
pub struct SoundSpeedProfile {
    /// Depth below the world's vertical origin in metres, and sound speed in metres per second.
    points: Vec<(f64, f64)>,
}

/// A point that breaks a rule of profiles, or a profile with too few or too many points.
#[derive(Clone, Debug, PartialEq, Error)]
pub struct ProfileRefused {
    /// Number of the point, from 1; `None` where the number of points is wrong.
    pub point: Option<usize>,
    /// Value and rule.
    pub why: String,
}

impl fmt::Display for ProfileRefused {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.point {
            Some(point) => write!(f, "point {point}: {}", self.why),
            None => f.write_str(&self.why),
        }
    }
}

impl SoundSpeedProfile {
    /// Sound speeds outside of these are no sound speeds of water: another unit, or columns in another order. Metres per second.
    pub const SPEEDS_M_PER_S: (f64, f64) = (1300.0, 1700.0);
    /// Depth of the first point, at most: a cast begins where its probe is under water. Metres.
    pub const MAX_FIRST_DEPTH_M: f64 = 10.0;
    /// Depth of the last point, at most, metres: the asvp format closes a profile at 12,000 m.
    pub const MAX_DEPTH_M: f64 = 12_000.0;
    /// Number of points, at most: as many as Kongsberg's echo sounders take.
    pub const MAX_POINTS: usize = 1000;

    /// Profile of (depth in metres, sound speed in metres per second), the shallowest point first.
    ///
    /// # Errors
    /// The first point that breaks a rule.
    pub fn new(points: Vec<(f64, f64)>) -> Result<Self, ProfileRefused> {
        if points.len() < 2 || points.len() > Self::MAX_POINTS {
            let (len, most) = (points.len(), Self::MAX_POINTS);
            return Err(ProfileRefused {
                point: None,
                why: format!("{len} points: must be 2 to {most}"),
            });
        }
        for (k, &(depth_m, speed)) in points.iter().enumerate() {
            let before = k.checked_sub(1).map(|b| points[b].0);
            if let Some(why) = Self::refusal(depth_m, speed, before) {
                let point = Some(k + 1);
                return Err(ProfileRefused { point, why });
            }
        }
        Ok(Self { points })
    }

    /// Why a point cannot follow a point at depth `before_m`, or be the first.
    fn refusal(depth_m: f64, speed: f64, before_m: Option<f64>) -> Option<String> {
        let (low, high) = Self::SPEEDS_M_PER_S;
        let (first_m, last_m) = (Self::MAX_FIRST_DEPTH_M, Self::MAX_DEPTH_M);
        if !depth_m.is_finite() || !speed.is_finite() {
            return Some(format!("{depth_m} m, {speed} m/s: must be finite numbers"));
        }
        if depth_m < 0.0 {
            return Some(format!(
                "depth {depth_m} m: must not lie above the surface; depths count downwards from 0"
            ));
        }
        if depth_m > last_m {
            return Some(format!("depth {depth_m} m: must be at most {last_m} m"));
        }
        match before_m {
            Some(before_m) if depth_m <= before_m => {
                return Some(format!(
                    "depth {depth_m} m: must be greater than {before_m} m, the depth of the point before"
                ));
            }
            None if depth_m > first_m => {
                return Some(format!(
                    "depth {depth_m} m: the first point must lie at most {first_m} m below the surface"
                ));
            }
            _ => {}
        }
        (!(low..=high).contains(&speed))
            .then(|| format!("sound speed {speed} m/s: must be from {low} to {high} m/s"))
    }

    /// Depth in metres and sound speed in metres per second of every point, the shallowest first.
    pub fn points(&self) -> &[(f64, f64)] {
        &self.points
    }

    /// Index of the first point deeper than `depth_m`.
    fn below(&self, depth_m: f64) -> usize {
        self.points.partition_point(|point| point.0 <= depth_m)
    }

    /// Sound speed at a depth, metres per second.
    pub fn at_m_per_s(&self, depth_m: f64) -> f64 {
        let below = self.below(depth_m);
        let last = self.points.len() - 1;
        if below == 0 || below > last {
            return self.points[below.min(last)].1;
        }
        let ((z0, c0), (z1, c1)) = (self.points[below - 1], self.points[below]);
        c0 + (c1 - c0) * ((depth_m - z0) / (z1 - z0))
    }

    /// Lowest and highest sound speed, metres per second.
    pub fn range_m_per_s(&self) -> (f64, f64) {
        let speeds = self.points.iter().map(|point| point.1);
        speeds.fold((f64::INFINITY, 0.0), |(low, high), c| {
            (low.min(c), high.max(c))
        })
    }

    /// Largest change of speed over depth, 1/s.
    pub fn max_gradient_per_s(&self) -> f64 {
        let pairs = self.points.windows(2);
        pairs
            .map(|pair| ((pair[1].1 - pair[0].1) / (pair[1].0 - pair[0].0)).abs())
            .fold(0.0, f64::max)
    }

    /// The part between two depths as (depth, speed) of its ends and of the points between them, in the order from `from_m` to `to_m`. Calls `visit` with
    /// each pair of neighbours.
    #[inline]
    pub fn layers(&self, from_m: f64, to_m: f64, mut visit: impl FnMut((f64, f64), (f64, f64))) {
        let mut near = (from_m, self.at_m_per_s(from_m));
        let far = (to_m, self.at_m_per_s(to_m));
        if from_m <= to_m {
            let first = self.below(from_m);
            for &point in self.points[first..].iter().take_while(|p| p.0 < to_m) {
                visit(near, point);
                near = point;
            }
        } else {
            let last = self.points.partition_point(|point| point.0 < from_m);
            let above = self.points[..last].iter().rev();
            for &point in above.take_while(|p| p.0 > to_m) {
                visit(near, point);
                near = point;
            }
        }
        if near.0 != far.0 {
            visit(near, far);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn profile() -> SoundSpeedProfile {
        SoundSpeedProfile::new(vec![(1.0, 1500.0), (11.0, 1490.0), (21.0, 1495.0)]).expect("sound")
    }

    #[test]
    fn speed_is_linear_between_points_and_constant_beyond_them() {
        let profile = profile();
        for (depth_m, want) in [
            (-3.0, 1500.0),
            (1.0, 1500.0),
            (6.0, 1495.0),
            (11.0, 1490.0),
            (13.0, 1491.0),
            (21.0, 1495.0),
            (500.0, 1495.0),
        ] {
            assert_eq!(profile.at_m_per_s(depth_m), want, "{depth_m} m");
        }
        assert_eq!(profile.range_m_per_s(), (1490.0, 1500.0));
        assert_eq!(profile.max_gradient_per_s(), 1.0);
    }

    #[test]
    fn layers_end_at_points_in_either_direction() {
        let between = |from_m, to_m| {
            let mut ends = Vec::new();
            profile().layers(from_m, to_m, |a, b| ends.push((a.0, b.0)));
            ends
        };
        assert_eq!(between(0.0, 11.0), [(0.0, 1.0), (1.0, 11.0)]);
        assert_eq!(
            between(6.0, 30.0),
            [(6.0, 11.0), (11.0, 21.0), (21.0, 30.0)]
        );
        assert_eq!(
            between(30.0, 6.0),
            [(30.0, 21.0), (21.0, 11.0), (11.0, 6.0)]
        );
        assert_eq!(between(11.0, 0.0), [(11.0, 1.0), (1.0, 0.0)]);
        assert_eq!(between(2.0, 2.0), []);
    }

    #[test]
    fn a_refused_profile_names_point_value_and_rule() {
        for (points, words) in [
            (vec![(0.0, 1500.0)], "1 points: must be 2 to 1000"),
            (
                vec![(0.0, 1500.0), (0.0, 1490.0)],
                "point 2: depth 0 m: must be greater than 0 m, the depth of the point before",
            ),
            (
                vec![(0.0, 1500.0), (5.0, f64::NAN)],
                "point 2: 5 m, NaN m/s: must be finite numbers",
            ),
            (
                vec![(-1.0, 1500.0), (5.0, 1490.0)],
                "point 1: depth -1 m: must not lie above the surface; depths count downwards from 0",
            ),
            (
                vec![(12.0, 1500.0), (50.0, 1490.0)],
                "point 1: depth 12 m: the first point must lie at most 10 m below the surface",
            ),
            (
                vec![(0.0, 1500.0), (20_000.0, 1490.0)],
                "point 2: depth 20000 m: must be at most 12000 m",
            ),
            (
                vec![(0.0, 1500.0), (5.0, 4900.0)],
                "point 2: sound speed 4900 m/s: must be from 1300 to 1700 m/s",
            ),
        ] {
            let refused = SoundSpeedProfile::new(points).expect_err("refused");
            assert_eq!(refused.to_string(), words);
        }
    }
}
