//! Fits to the echoes of one task: the functions of slope that the templates use, and the spans of
//! the residuals that each echo carries.

/// Echoes of one task about mid-pulse, as a structure of arrays.
#[derive(Clone, Debug, Default)]
pub(super) struct Echoes {
    pub slope: Vec<f64>,
    /// du/dw: change of the delay per second of emission.
    pub dilation: Vec<f64>,
    /// c d2u/dy2 over 1 - slope^2: 1/R up to terms of v/c.
    pub(crate) per_range_per_m: Vec<f64>,
    pub rate_gradient_per_s: Vec<f64>,
    pub acceleration_m_per_s2: Vec<f64>,
    /// Echoes with an amplitude, without the survey points.
    pub strengths: Vec<EchoStrength>,
}

/// Strength of an echo along the section.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct EchoStrength {
    /// From the first sample of the slab.
    pub middle_s: f64,
    pub slope: f64,
    pub(crate) per_range_per_m: f64,
    pub energy: f64,
    /// Beyond the effect of range and absorption.
    pub gain_slope_per_m: f64,
    pub gain_curvature_per_m2: f64,
}

impl Echoes {
    pub(super) fn clear(&mut self) {
        for column in [
            &mut self.slope,
            &mut self.dilation,
            &mut self.per_range_per_m,
            &mut self.rate_gradient_per_s,
            &mut self.acceleration_m_per_s2,
        ] {
            column.clear();
        }
        self.strengths.clear();
    }

    pub(super) fn len(&self) -> usize {
        self.slope.len()
    }

    pub(super) fn is_empty(&self) -> bool {
        self.slope.is_empty()
    }
}

/// Middle and half width of a span.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Span {
    pub middle: f64,
    pub half: f64,
}

impl Span {
    pub(super) fn of(values: impl Iterator<Item = f64>) -> Self {
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

    /// Position within the span, -1..1; 0 for a span without width.
    #[inline]
    pub(super) fn unit(&self, value: f64) -> f64 {
        if self.half > 0.0 {
            ((value - self.middle) / self.half).clamp(-1.0, 1.0)
        } else {
            0.0
        }
    }

    pub(super) fn at(&self, unit: f64) -> f64 {
        self.middle + self.half * unit
    }
}

/// Curve a (1 - s^2) + p + q s over the slope s. This is the form that steady motion gives to rate
/// gradient and acceleration: motion along the line gives the first term, and the mean of motion
/// across the line gives the others.
///
/// Columns beside the slopes of the echoes use the values of the curve there. A free polynomial
/// would follow the scatter of the echoes and diverge between and beyond them.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Curve {
    along: f64,
    constant: f64,
    linear: f64,
}

impl Curve {
    #[inline(always)]
    pub(super) fn at(&self, slope: f64) -> f64 {
        self.along * (1.0 - slope * slope) + self.constant + self.linear * slope
    }

    /// Least-squares fit. `odd`: without a constant.
    fn fit(odd: bool, points: impl Iterator<Item = (f64, f64)> + Clone) -> Self {
        if odd {
            let [along, linear] = least_squares(points.map(|(s, v)| ([1.0 - s * s, s], v)));
            return Self {
                along,
                linear,
                constant: 0.0,
            };
        }
        let columns = |s: f64| [1.0 - s * s, 1.0, s];
        let [along, constant, linear] = least_squares(points.map(|(s, v)| (columns(s), v)));
        Self {
            along,
            constant,
            linear,
        }
    }
}

/// Ridge for columns that hardly differ over the echoes' slopes, relative to their mean square.
const RIDGE: f64 = 1e-5;

/// Least-squares coefficients of given values in given columns.
fn least_squares<const N: usize>(rows: impl Iterator<Item = ([f64; N], f64)>) -> [f64; N] {
    let (mut a, mut b) = ([[0.0; N]; N], [0.0; N]);
    for (columns, value) in rows {
        for i in 0..N {
            b[i] += columns[i] * value;
            for j in 0..N {
                a[i][j] += columns[i] * columns[j];
            }
        }
    }
    // For one echo, or all from one direction: the minimum-norm solution.
    let size = (0..N).map(|i| a[i][i]).sum::<f64>();
    for (i, row) in a.iter_mut().enumerate() {
        row[i] += RIDGE * size + f64::MIN_POSITIVE;
    }
    // Gaussian elimination; the matrix is positive definite, so there is no pivoting.
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

/// Inputs to the templates.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Smooth {
    pub slope: Span,
    /// Common dilation of echoes of one slope: `dilation0 + dilation1 * slope`. A line only
    /// lengthens the aperture.
    pub(crate) dilation0: f64,
    pub(crate) dilation1: f64,
    /// Coefficient of the squared distance of the slope from its middle. It exceeds the plane wave,
    /// so the templates carry it.
    pub(crate) dilation2: f64,
    /// Largest residual of the dilation.
    pub(crate) dilation_rest: f64,
    pub(crate) per_range_per_m: Span,
    /// Rate gradient and acceleration times range, m/s and (m/s)^2. For motion along the line they
    /// are v (1 - s^2) and 2 v^2 (1 - s^2).
    pub rate_gradient: Curve,
    pub acceleration: Curve,
    /// Largest residuals of rate gradient and acceleration themselves, 1/s and m/s^2.
    pub(crate) rate_gradient_rest: f64,
    pub(crate) acceleration_rest: f64,
    /// Gain slope times range: linear in the slope, with a part symmetric about broadside and an
    /// antisymmetric part.
    pub(crate) gain_slope: Curve,
    /// Largest square root of the share of a window's energy in gain slope and gain curvature, at
    /// the ends of the section.
    pub(crate) gain_variation: [f64; GAIN_TERMS],
}

/// Over narrower spans of slopes the dilation is linear; a quadratic would diverge beside them.
const MIN_BOW: f64 = 0.05;

/// Orders of the change of strength along a section.
pub(crate) const GAIN_TERMS: usize = 2;
/// Windows of half a pulse over which energies are summed; later ones join the last.
const WINDOWS: usize = 256;

impl Smooth {
    /// Fits the echoes. `window_s` is the length of the energy windows and `half_m` half the
    /// section. `min_bow` is the smallest half span of slopes for a curved dilation, and `steepest`
    /// its largest curvature.
    pub(super) fn of(
        echoes: &Echoes,
        window_s: f64,
        half_m: f64,
        min_bow: f64,
        steepest: f64,
    ) -> Self {
        let slope = Span::of(echoes.slope.iter().copied());
        let points = (0..echoes.len()).map(|i| (slope.unit(echoes.slope[i]), echoes.dilation[i]));
        let [a, b, bow] = least_squares(points.clone().map(|(x, d)| ([1.0, x, x * x], d)));
        let bowed = slope.half > min_bow.max(MIN_BOW) && 2.0 * bow.abs() <= steepest * slope.half;
        let (fit, dilation2) = match bowed {
            true => ([a, b], bow / (slope.half * slope.half)),
            false => (least_squares(points.map(|(x, d)| ([1.0, x], d))), 0.0),
        };
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
            dilation2,
            ..Self::default()
        };
        let rest = Span::of((0..echoes.len()).map(|i| smooth.rest(echoes, i)));
        smooth.dilation0 += rest.middle;
        smooth.dilation_rest = rest.half;
        let times_range = |odd: bool, values: &[f64]| {
            Curve::fit(
                odd,
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
        smooth.rate_gradient = times_range(true, &echoes.rate_gradient_per_s);
        smooth.acceleration = times_range(false, &echoes.acceleration_m_per_s2);
        smooth.rate_gradient_rest = left_over(&smooth.rate_gradient, &echoes.rate_gradient_per_s);
        smooth.acceleration_rest = left_over(&smooth.acceleration, &echoes.acceleration_m_per_s2);
        smooth.measure_gain_terms(&echoes.strengths, window_s, half_m);
        smooth
    }

    fn measure_gain_terms(&mut self, strengths: &[EchoStrength], window_s: f64, half_m: f64) {
        let window =
            |echo: &EchoStrength| ((echo.middle_s / window_s).max(0.0) as usize).min(WINDOWS - 1);
        let mut energies = [0.0; WINDOWS];
        for echo in strengths {
            energies[window(echo)] += echo.energy;
        }
        let share =
            |echo: &EchoStrength| echo.energy / energies[window(echo)].max(f64::MIN_POSITIVE);
        // Every window has the same weight, and every echo its share of energy in the window.
        let [linear, constant] = least_squares(strengths.iter().map(|echo| {
            let weight = (share(echo) * echo.per_range_per_m.powi(2)).sqrt();
            let over_range = echo.gain_slope_per_m / echo.per_range_per_m.max(1e-12);
            ([weight * echo.slope, weight], weight * over_range)
        }));
        self.gain_slope = Curve {
            along: 0.0,
            constant,
            linear,
        };
        let mut gain_variation = [[0.0; WINDOWS]; GAIN_TERMS];
        for echo in strengths {
            let rest =
                echo.gain_slope_per_m - self.shared_gain_slope(echo.slope, echo.per_range_per_m);
            let at = window(echo);
            gain_variation[0][at] += share(echo) * (rest * half_m).powi(2);
            gain_variation[1][at] +=
                share(echo) * (echo.gain_curvature_per_m2 * half_m * half_m).powi(2);
        }
        self.gain_variation =
            gain_variation.map(|windows| windows.into_iter().fold(0.0, f64::max).sqrt());
    }

    /// The part of the gain slope that the templates carry.
    #[inline(always)]
    pub(crate) fn shared_gain_slope(&self, slope: f64, per_range_per_m: f64) -> f64 {
        per_range_per_m * self.gain_slope.at(slope)
    }

    /// The same with spans widened by a share, and slightly for rounding.
    pub(crate) fn widened(&self, share: f64) -> Self {
        let mut wider = *self;
        wider.slope.half = (1.0 + share) * self.slope.half + 1e-9;
        wider.per_range_per_m.half = (1.0 + share) * self.per_range_per_m.half + 1e-9;
        wider.dilation_rest = (1.0 + share) * self.dilation_rest + 1e-13;
        wider.rate_gradient_rest = (1.0 + share) * self.rate_gradient_rest + 1e-9;
        wider
    }

    /// Residual of an echo's dilation.
    #[inline]
    pub(super) fn rest(&self, echoes: &Echoes, i: usize) -> f64 {
        echoes.dilation[i] - self.dilation(echoes.slope[i]) - self.bow(echoes.slope[i])
    }

    /// Addition of the templates to [`Self::dilation`] at a slope.
    #[inline(always)]
    pub(super) fn bow(&self, slope: f64) -> f64 {
        let beside = slope - self.slope.middle;
        self.dilation2 * beside * beside
    }

    /// Common dilation at a slope.
    #[inline(always)]
    pub(super) fn dilation(&self, slope: f64) -> f64 {
        self.dilation0 + self.dilation1 * slope
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_curve_follows_motion_along_the_line_and_stays_bounded() {
        let slopes = || (0..50).map(|k| 0.6 + 0.1 * f64::from(k) / 49.0);
        let law = |s: f64| 5.0 * (1.0 - s * s);
        let fit = Curve::fit(true, slopes().map(|s| (s, law(s))));
        for s in [0.0, 0.5, 0.7, 1.1] {
            let error = (fit.at(s) - law(s)).abs();
            // Half of 1 % of the largest value: the effect of [`RIDGE`] for slopes this similar.
            assert!(error < 2.5e-2, "at {s}: {error:e}");
        }
        // Motion across the line, which is no function of the slope.
        let scatter = |s: f64| (1e4 * s).sin();
        for odd in [false, true] {
            let fit = Curve::fit(odd, slopes().map(|s| (s, scatter(s))));
            for s in [0.3, 0.65, 1.0] {
                assert!(fit.at(s).abs() < 2.0, "at {s}: {}", fit.at(s));
            }
        }
        let one = Curve::fit(false, [(0.25, 7.0)].into_iter());
        assert!((one.at(0.25) - 7.0).abs() < 1e-3, "{one:?}");
        assert_eq!(Curve::fit(true, std::iter::empty()).at(0.3), 0.0);
    }
}
