//! Pieces of the ground profile along a ray, and the elevation at which the eye sees them.

/// Quadratic ground profile between two distances from the eye. It is expanded about its middle, so that short pieces keep their precision.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Piece {
    pub from_m: f64,
    pub to_m: f64,
    middle_m: f64,
    /// Depth, slope and half the second derivative at the middle.
    depth: [f64; 3],
}

impl Piece {
    /// Sampling points of [`Piece::through`], as fractions of the piece.
    pub(crate) const AT: [f64; 3] = [0.1, 0.5, 0.9];

    /// A piece from the depth at its middle, the first derivative and half the second.
    pub(crate) fn new(from_m: f64, to_m: f64, depth: [f64; 3]) -> Self {
        Self {
            from_m,
            to_m,
            middle_m: 0.5 * (from_m + to_m),
            depth,
        }
    }

    /// A piece through three depths at [`Self::AT`].
    pub(crate) fn through(from_m: f64, to_m: f64, [y0, y1, y2]: [f64; 3]) -> Self {
        let step_m = (Self::AT[1] - Self::AT[0]) * (to_m - from_m);
        let depth = [
            y1,
            (y2 - y0) / (2.0 * step_m),
            (y2 - 2.0 * y1 + y0) / (2.0 * step_m * step_m),
        ];
        Self::new(from_m, to_m, depth)
    }

    /// Tangent of the elevation at which the eye sees the ground at distance `s`.
    pub(crate) fn tangent(&self, eye_down_m: f64, s: f64) -> f64 {
        let [a, b, c] = self.depth;
        let x = s - self.middle_m;
        (eye_down_m - (a + x * (b + x * c))) / s
    }

    /// s^2 times the derivative of the tangent: positive where the ground faces the eye. It is monotonic over the piece.
    pub(crate) fn rise(&self, eye_down_m: f64, s: f64) -> f64 {
        let [a, b, c] = self.depth;
        let x = s - self.middle_m;
        a + x * (b + x * c) - eye_down_m - (b + 2.0 * x * c) * s
    }

    /// Highest tangent from `from_m` (above 0) on.
    pub(crate) fn highest(&self, eye_down_m: f64, from_m: f64) -> f64 {
        let ends = [from_m, self.to_m].map(|s| self.tangent(eye_down_m, s));
        let summit = self.turns_m(eye_down_m, from_m);
        let summit = summit.map_or(f64::NEG_INFINITY, |s| self.tangent(eye_down_m, s));
        ends[0].max(ends[1]).max(summit)
    }

    /// Distance beyond `from_m` at which the tangent has an extremum, if any.
    pub(crate) fn turns_m(&self, eye_down_m: f64, from_m: f64) -> Option<f64> {
        // At an extremum, depth - eye = slope s, hence s^2 = m^2 + (a - eye - b m)/c.
        let [a, b, c] = self.depth;
        let m = self.middle_m;
        let squared = m * m + (a - eye_down_m - b * m) / c;
        (c != 0.0 && squared > from_m * from_m && squared < self.to_m * self.to_m)
            .then(|| squared.sqrt())
    }

    /// Distance beyond `from_m` from which the tangent falls; none if it rises to the end.
    pub(crate) fn falls_m(&self, eye_down_m: f64, from_m: f64) -> Option<f64> {
        if self.rise(eye_down_m, from_m) < 0.0 {
            return Some(from_m);
        }
        self.turns_m(eye_down_m, from_m)
    }

    /// Distance beyond `from_m` at which the tangent rises through a value, given that it lies below or falls from that value at `from_m`.
    pub(crate) fn rises_through_m(
        &self,
        eye_down_m: f64,
        from_m: f64,
        tangent: f64,
    ) -> Option<f64> {
        // s (value - tangent) = depth + value s - eye. In x = s - m this is c x^2 + b x + a, which changes from positive to negative there.
        let [depth_m, slope, c] = self.depth;
        let a = depth_m - eye_down_m + tangent * self.middle_m;
        let b = slope + tangent;
        let discriminant = b * b - 4.0 * a * c;
        if discriminant < 0.0 {
            return None;
        }
        // Form without cancellation (Press et al. 2007, Numerical Recipes, 5.6), for the root with a falling slope. c may be 0.
        let root = discriminant.sqrt();
        let x = match b >= 0.0 {
            true => -0.5 * (b + root) / c,
            false => a / (-0.5 * (b - root)),
        };
        (x > from_m - self.middle_m && x <= self.to_m - self.middle_m).then_some(x + self.middle_m)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const EYE: f64 = 12.0;

    fn pieces() -> Vec<(Piece, impl Fn(f64) -> f64)> {
        [
            (-0.8, 0.03),
            (-0.8, 0.0),
            (0.5, -0.02),
            (0.1, 0.0),
            (-0.2, -0.03),
        ]
        .into_iter()
        .map(|(slope, bend)| {
            let depth = move |s: f64| 20.0 + slope * (s - 8.0) + bend * s * s;
            let at = Piece::AT.map(|share| depth(8.0 + 10.0 * share));
            (Piece::through(8.0, 18.0, at), depth)
        })
        .collect()
    }

    #[test]
    fn a_piece_passes_through_its_points_and_finds_where_its_tangent_turns_and_falls() {
        for (piece, depth) in pieces() {
            let tangent = |s: f64| (EYE - depth(s)) / s;
            let places: Vec<f64> = (0..=10_000).map(|k| 8.0 + 1e-3 * f64::from(k)).collect();
            for &s in &places {
                assert!((piece.tangent(EYE, s) - tangent(s)).abs() < 1e-12, "{s}");
            }
            let most = places.iter().map(|s| tangent(*s)).fold(-1e9, f64::max);
            let got = piece.highest(EYE, 8.0);
            assert!((got - most).abs() < 1e-6, "{got}, {most}");
            let falls = places.windows(2).find(|w| tangent(w[1]) < tangent(w[0]));
            match (piece.falls_m(EYE, 8.0), falls) {
                (Some(got), Some(want)) => {
                    assert!((got - want[0]).abs() < 2e-3, "{got} {want:?}");
                }
                (got, want) => assert!(got.is_none() && want.is_none(), "{got:?} {want:?}"),
            }
        }
    }

    #[test]
    fn a_tangent_rises_through_a_value_where_a_search_finds_it() {
        let mut found = 0;
        for (piece, depth) in pieces() {
            let tangent = |s: f64| (EYE - depth(s)) / s;
            let places: Vec<f64> = (0..10_000).map(|k| 8.0 + 1e-3 * f64::from(k)).collect();
            for k in 0..200 {
                let value = -1.2 + 0.01 * f64::from(k) + 1e-6;
                let search = places
                    .windows(2)
                    .find(|w| tangent(w[0]) < value && tangent(w[1]) >= value);
                match (piece.rises_through_m(EYE, 8.0, value), search) {
                    (Some(got), Some(want)) => {
                        found += 1;
                        assert!((got - want[0]).abs() < 1.1e-3, "{value}: {got} {want:?}");
                    }
                    // Between the last two places, or up and down again between two.
                    (Some(got), None) => {
                        let short = value - piece.highest(EYE, 8.0);
                        assert!(got > 17.998 || short.abs() < 1e-6, "{value}: {got}");
                    }
                    (None, Some(want)) => panic!("{value}: {want:?} was not found"),
                    (None, None) => {}
                }
            }
        }
        assert!(found > 100, "only {found} were reached");
    }
}
