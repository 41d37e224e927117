//! Amounts of work to form the beams of one ping, for estimates of its cost.

use super::RowLimits;
use super::delay_sum::DelaySumFormer;
use echotank_config::spec::{FanForm, FanSpec, Former, LineSpec, SonarSpec};

/// Samples of a direction grid for each element, and taps of its interpolation, of the `fft` former.
const GRID_PER_ELEMENT: f64 = 2.0;
const GRID_TAPS: f64 = 8.0;
/// An f64 costs as much as so many f32.
const DOUBLE: f64 = 2.0;

/// Work of forming beams or lines. Numbers are f32; an f64 counts as two.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct BeamWork {
    /// Points of all transforms, times the binary logarithm of their lengths.
    pub transforms: f64,
    /// Products of a complex sample and a complex weight.
    pub products: f64,
    /// Groups of elements of all beams, for each focal zone or span: each has its own coefficients.
    pub zones: f64,
    /// Samples of beams written.
    pub samples: f64,
}

impl BeamWork {
    /// Of the fan of a sonar, or of the halves for bottom detection where its method forms none.
    pub fn of_fan(
        sonar: &SonarSpec,
        fan: &FanSpec,
        limits: RowLimits,
        samples: usize,
        c: f64,
    ) -> Self {
        let (elements, beams) = (sonar.receive[fan.array].elements as f64, fan.beams as f64);
        let length = length(limits);
        let transform = |points: f64| points * points.log2();
        let all = Self {
            samples: beams * samples as f64,
            ..Self::default()
        };
        let halves = |fan: &FanSpec| match fan.form.bottom_detection {
            true => {
                let mut fan = fan.clone();
                fan.form.former = Former::TimeDelay;
                Self::of_fan(sonar, &fan, limits, samples, c)
            }
            false => Self::default(),
        };
        match fan.form.former {
            Former::Exact => Self {
                transforms: DOUBLE * (elements + beams) * transform(length),
                products: DOUBLE * elements * beams * length,
                ..all
            }
            .plus(halves(fan)),
            Former::Fft => {
                let grid = GRID_PER_ELEMENT * elements;
                Self {
                    transforms: (DOUBLE * elements + beams) * transform(length)
                        + length * transform(grid.max(2.0)),
                    // Of real coefficients, and as much to compute these.
                    products: GRID_TAPS * beams * length,
                    ..all
                }
                .plus(halves(fan))
            }
            Former::TimeDelay | Former::Phase | Former::DynamicFocus => {
                let array = &sonar.receive[fan.array];
                let rate_hz = limits.sample_rate_hz;
                let (products, zones) =
                    DelaySumFormer::work(array, fan, &sonar.pulse, (rate_hz, samples), c);
                Self {
                    transforms: 2.0 * elements * transform(length),
                    products,
                    zones,
                    ..all
                }
            }
        }
    }

    /// Of one side-scan line.
    pub fn of_line(
        sonar: &SonarSpec,
        line: &LineSpec,
        limits: RowLimits,
        samples: usize,
        c: f64,
    ) -> Self {
        if sonar.beams.focused_lines {
            return Self::of_fan(sonar, &broadside(sonar, line), limits, samples, c);
        }
        let length = length(limits);
        Self {
            transforms: 2.0 * DOUBLE * length * length.log2(),
            // The mean of the elements has no weights.
            products: 0.5 * (sonar.receive[line.array].elements * samples) as f64,
            samples: samples as f64,
            ..Self::default()
        }
    }

    /// Both.
    pub fn plus(self, other: Self) -> Self {
        Self {
            transforms: self.transforms + other.transforms,
            products: self.products + other.products,
            zones: self.zones + other.zones,
            samples: self.samples + other.samples,
        }
    }
}

/// Points of the transform of a row.
fn length(limits: RowLimits) -> f64 {
    limits.samples as f64 + limits.pulse_s * limits.sample_rate_hz
}

/// A focused side-scan line as a fan of one beam.
pub(super) fn broadside(sonar: &SonarSpec, line: &LineSpec) -> FanSpec {
    FanSpec {
        array: line.array,
        beams: 1,
        sector_rad: 0.0,
        shading: sonar.beams.line_shading,
        form: FanForm {
            former: Former::DynamicFocus,
            f_number: sonar.beams.line_f_number,
            ..FanForm::default()
        },
    }
}
