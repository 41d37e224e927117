//! What the echoes of one task have in common, fitted to them: everything that the templates take as a function of slope alone, and the
//! spans of what is left over for each echo to carry itself.

/// Echoes of one task about mid-pulse, structure of arrays.
#[derive(Clone, Debug, Default)]
pub struct Echoes {
    pub slope: Vec<f64>,
    /// du/dw: what the delay gains per second of emission.
    pub dilation: Vec<f64>,
    /// c d2u/dy2 over 1 - slope^2: 1/R but for terms of v/c.
    pub per_range_per_m: Vec<f64>,
    pub twist_per_s: Vec<f64>,
    pub swing_m_per_s2: Vec<f64>,
}

impl Echoes {
    pub fn clear(&mut self) {
        for column in [
            &mut self.slope,
            &mut self.dilation,
            &mut self.per_range_per_m,
            &mut self.twist_per_s,
            &mut self.swing_m_per_s2,
        ] {
            column.clear();
        }
    }

    pub fn len(&self) -> usize {
        self.slope.len()
    }

    pub fn is_empty(&self) -> bool {
        self.slope.is_empty()
    }
}

/// Middle and half width of a span.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Span {
    pub middle: f64,
    pub half: f64,
}

impl Span {
    pub fn of(values: impl Iterator<Item = f64>) -> Self {
        let (least, most) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), v| {
            (a.min(v), b.max(v))
        });
        if least > most {
            return Self::default();
        }
        Self {
            middle: 0.5 * (least + most),
            half: 0.5 * (most - least),
        }
    }

    /// -1..1 within the span; 0 where it has no width.
    #[inline]
    pub fn unit(&self, value: f64) -> f64 {
        if self.half > 0.0 {
            ((value - self.middle) / self.half).clamp(-1.0, 1.0)
        } else {
            0.0
        }
    }

    pub fn at(&self, unit: f64) -> f64 {
        self.middle + self.half * unit
    }
}

/// A polynomial of fourth order in the slope.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Curve {
    about: Span,
    /// 1 / about.half; 0 where that is 0.
    per_half: f64,
    coefficients: [f64; 5],
}

impl Curve {
    #[inline(always)]
    pub fn at(&self, slope: f64) -> f64 {
        let x = self.x(slope);
        let [c0, c1, c2, c3, c4] = self.coefficients;
        (((c4 * x + c3) * x + c2) * x + c1) * x + c0
    }

    #[inline(always)]
    fn x(&self, slope: f64) -> f64 {
        (slope - self.about.middle) * self.per_half
    }

    /// By least squares.
    fn fit(about: Span, points: impl Iterator<Item = (f64, f64)>) -> Self {
        let mut curve = Self {
            about,
            per_half: if about.half > 0.0 {
                1.0 / about.half
            } else {
                0.0
            },
            coefficients: [0.0; 5],
        };
        curve.coefficients = least_squares(points.map(|(slope, value)| {
            let x = curve.x(slope);
            ([1.0, x, x.powi(2), x.powi(3), x.powi(4)], value)
        }));
        curve
    }
}

/// The coefficients of least squares of given values in given columns.
fn least_squares<const N: usize>(rows: impl Iterator<Item = ([f64; N], f64)>) -> [f64; N] {
    let (mut a, mut b) = ([[0.0; N]; N], [0.0; N]);
    let mut count = 0.0f64;
    for (columns, value) in rows {
        count += 1.0;
        for i in 0..N {
            b[i] += columns[i] * value;
            for j in 0..N {
                a[i][j] += columns[i] * columns[j];
            }
        }
    }
    // One echo, or all from one direction: the least of the solutions.
    for (i, row) in a.iter_mut().enumerate() {
        row[i] += 1e-12 * count.max(1.0);
    }
    // Gauss's elimination; positive definite, so no pivots are sought.
    for i in 0..N {
        let pivot = a[i];
        for j in i + 1..N {
            let share = a[j][i] / pivot[i];
            for (to, from) in a[j].iter_mut().zip(pivot) {
                *to -= share * from;
            }
            b[j] -= share * b[i];
        }
    }
    for i in (0..N).rev() {
        let known: f64 = (i + 1..N).map(|j| a[i][j] * b[j]).sum();
        b[i] = (b[i] - known) / a[i][i];
    }
    b
}

/// What the templates are made from.
#[derive(Clone, Copy, Debug, Default)]
pub struct Smooth {
    pub slope: Span,
    /// The dilation every echo of a slope shares: `dilation0 + dilation1 * slope`, a line because a line only lengthens the aperture.
    /// (Taking out a function of range too was tried: the tensor of its terms with those of the rest came out larger.)
    pub dilation0: f64,
    pub dilation1: f64,
    /// Of what is left of it.
    pub dilation_rest: f64,
    pub per_range_per_m: Span,
    /// Twist and swing times range, m/s and (m/s)^2: for motion along the line v (1 - s^2) and 2 v^2 (1 - s^2).
    pub twist: Curve,
    pub swing: Curve,
    /// Greatest of what the curves leave of twist and swing themselves, 1/s and m/s^2.
    pub twist_rest: f64,
    pub swing_rest: f64,
}

impl Smooth {
    pub fn of(echoes: &Echoes) -> Self {
        let slope = Span::of(echoes.slope.iter().copied());
        let fit = least_squares((0..echoes.len()).map(|i| {
            let x = slope.unit(echoes.slope[i]);
            ([1.0, x], echoes.dilation[i])
        }));
        let dilation1 = if slope.half > 0.0 {
            fit[1] / slope.half
        } else {
            0.0
        };
        let mut smooth = Self {
            slope,
            per_range_per_m: Span::of(echoes.per_range_per_m.iter().copied()),
            dilation0: fit[0] - dilation1 * slope.middle,
            dilation1,
            ..Self::default()
        };
        let rest = Span::of((0..echoes.len()).map(|i| smooth.rest(echoes, i)));
        smooth.dilation0 += rest.middle;
        smooth.dilation_rest = rest.half;
        let times_range = |values: &[f64]| {
            Curve::fit(
                slope,
                (0..echoes.len()).map(|i| {
                    (
                        echoes.slope[i],
                        values[i] / echoes.per_range_per_m[i].max(1e-12),
                    )
                }),
            )
        };
        let left_over = |curve: &Curve, values: &[f64]| {
            (0..echoes.len())
                .map(|i| (values[i] - echoes.per_range_per_m[i] * curve.at(echoes.slope[i])).abs())
                .fold(0.0, f64::max)
        };
        smooth.twist = times_range(&echoes.twist_per_s);
        smooth.swing = times_range(&echoes.swing_m_per_s2);
        smooth.twist_rest = left_over(&smooth.twist, &echoes.twist_per_s);
        smooth.swing_rest = left_over(&smooth.swing, &echoes.swing_m_per_s2);
        smooth
    }

    /// The same with wider spans: by a share of them, and a little for rounding.
    pub fn widened(&self, share: f64) -> Self {
        let mut wider = *self;
        wider.slope.half = (1.0 + share) * self.slope.half + 1e-9;
        wider.per_range_per_m.half = (1.0 + share) * self.per_range_per_m.half + 1e-9;
        wider.dilation_rest = (1.0 + share) * self.dilation_rest + 1e-13;
        wider.twist_rest = (1.0 + share) * self.twist_rest + 1e-9;
        wider
    }

    /// What the fits leave of an echo's dilation.
    #[inline]
    pub fn rest(&self, echoes: &Echoes, i: usize) -> f64 {
        echoes.dilation[i] - self.dilation(echoes.slope[i])
    }

    /// The dilation shared at a slope.
    #[inline(always)]
    pub fn dilation(&self, slope: f64) -> f64 {
        self.dilation0 + self.dilation1 * slope
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_curve_is_fitted_exactly_and_one_echo_suffices() {
        let about = Span {
            middle: 0.1,
            half: 0.2,
        };
        let law = |s: f64| 3.0 - 2.0 * s + 5.0 * s * s;
        let points = (0..50).map(|k| -0.1 + 0.4 * f64::from(k) / 49.0);
        let fit = Curve::fit(about, points.map(|s| (s, law(s))));
        for s in [-0.1, 0.0, 0.17, 0.3] {
            let error = (fit.at(s) - law(s)).abs();
            assert!(error < 1e-9, "at {s}: {error:e}");
        }
        let one = Span::of([0.25].into_iter());
        let fit = Curve::fit(one, [(0.25, 7.0)].into_iter());
        assert!((fit.at(0.25) - 7.0).abs() < 1e-9, "{fit:?}");
        assert_eq!(Curve::fit(one, std::iter::empty()).at(0.3), 0.0);
    }
}
