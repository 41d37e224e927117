//! Slant-range axis of a side-scan line: sample k is an echo of two-way time k / f_s, so its slant range is c k / (2 f_s).

use std::ops::Range;

use echotank_core::ping::Line;

/// Mapping between the samples of a line and slant range (one way, metres).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RangeAxis {
    /// Slant range between samples.
    pub metres_per_sample: f64,
}

impl RangeAxis {
    /// Axis for a sound speed and the receiver's sample rate.
    pub fn new(sound_speed_m_per_s: f64, sample_rate_hz: f64) -> Self {
        Self {
            metres_per_sample: 0.5 * sound_speed_m_per_s / sample_rate_hz,
        }
    }
    /// Slant range of a sample, metres.
    pub fn slant_range_m(&self, sample: usize) -> f64 {
        sample as f64 * self.metres_per_sample
    }
    /// Index of the nearest sample.
    pub fn sample(&self, slant_range_m: f64) -> usize {
        (slant_range_m / self.metres_per_sample).round().max(0.0) as usize
    }
}

/// Projection of slant ranges onto the columns of a picture.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Projection {
    /// Columns are slant range.
    Slant,
    /// Columns are ground range on a flat bottom: sqrt(r^2 - h^2).
    Ground {
        /// Height h of the sonar above the bottom.
        altitude_m: f64,
    },
}

impl Projection {
    /// Slant range of a point `across_m` from the centre of the picture.
    pub fn slant_range_m(self, across_m: f64) -> f64 {
        match self {
            Self::Slant => across_m,
            Self::Ground { altitude_m } => across_m.hypot(altitude_m),
        }
    }

    /// Inverse of [`Projection::slant_range_m`]; none for ranges shorter than the altitude.
    pub fn across_m(self, slant_range_m: f64) -> Option<f64> {
        match self {
            Self::Slant => Some(slant_range_m),
            Self::Ground { altitude_m } => (slant_range_m >= altitude_m)
                .then(|| (slant_range_m * slant_range_m - altitude_m * altitude_m).sqrt()),
        }
    }

    /// Samples of cell number `cell`: those between its edges or, if it lies between two samples, the nearest.
    pub fn samples(self, axis: RangeAxis, metres_per_cell: f64, cell: usize) -> Range<usize> {
        let at = |cell: f64| self.slant_range_m(cell * metres_per_cell) / axis.metres_per_sample;
        // The small offset absorbs rounding, because cell edges often coincide with samples.
        let edge = |cell: usize| (at(cell as f64) - 1e-6).ceil().max(0.0) as usize;
        let (first, end) = (edge(cell), edge(cell + 1));
        if first < end {
            return first..end;
        }
        let nearest = at(cell as f64 + 0.5).round() as usize;
        nearest..nearest + 1
    }
}

/// Slant range of the first bottom return over all lines, metres; none without sufficient contrast.
///
/// The first return is the first interval of 0.25 m whose level is within 12 dB of the line's 90th percentile. This threshold is above the
/// side lobes that precede a compressed pulse. If the 2nd percentile is less than 24 dB lower, the threshold is half way (in dB) between
/// the two percentiles. Through the edge of a pattern the bottom below the sonar rises to the threshold over several intervals: the intervals
/// just before that are within 10 dB of it belong to the return.
pub fn first_return_m(lines: &[Line], axis: RangeAxis) -> Option<f64> {
    const INTERVAL_M: f64 = 0.25;
    const UNDER_LOUD_DB: f64 = 12.0;
    const MIN_CONTRAST_DB: f64 = 10.0;
    const RISE_DB: f64 = 10.0;
    let interval = (INTERVAL_M / axis.metres_per_sample).ceil().max(1.0) as usize;
    let each = lines.iter().filter_map(|line| {
        let levels: Vec<f64> = line
            .amplitude
            .chunks_exact(interval)
            .map(|s| s.iter().map(|&a| f64::from(a) * f64::from(a)).sum::<f64>())
            .map(|sum| 10.0 * (sum / interval as f64 + f64::MIN_POSITIVE).log10())
            .collect();
        let mut sorted: Vec<f64> = levels.iter().copied().filter(|l| *l > -3000.0).collect();
        sorted.sort_by(f64::total_cmp);
        let at = |share: f64| sorted.get((share * sorted.len() as f64) as usize);
        let (quiet, loud) = (*at(0.02)?, *at(0.9)?);
        if loud - quiet < MIN_CONTRAST_DB {
            return None;
        }
        let threshold = (loud - UNDER_LOUD_DB).max(0.5 * (quiet + loud));
        let crossing = levels.iter().position(|l| *l > threshold)?;
        let rise = levels[..crossing].iter().rev();
        let rise = rise.take_while(|l| **l > levels[crossing] - RISE_DB);
        let first = crossing - rise.count();
        Some(axis.slant_range_m(first * interval + interval / 2))
    });
    each.min_by(f64::total_cmp)
}

/// Mean intensity (amplitude squared) of a line in cells of `metres_per_cell`; cell i covers i to i + 1 cells of slant range.
///
/// The mean keeps the mean level for any cell size, whereas a maximum brightens speckle with the logarithm of the cell size. A cell between
/// two samples takes the nearest; a cell beyond the line is NaN.
pub fn mean_intensity(amplitude: &[f32], axis: RangeAxis, metres_per_cell: f64, cells: &mut [f32]) {
    cell_intensity(
        amplitude,
        axis,
        Projection::Slant,
        metres_per_cell,
        0.0,
        cells,
    );
}

/// The same for any projection. Cells nearer than `min_m` of slant range are NaN.
pub(crate) fn cell_intensity(
    amplitude: &[f32],
    axis: RangeAxis,
    projection: Projection,
    metres_per_cell: f64,
    min_m: f64,
    cells: &mut [f32],
) {
    for (i, cell) in cells.iter_mut().enumerate() {
        let samples = projection.samples(axis, metres_per_cell, i);
        let inside = amplitude.get(samples.start..samples.end.min(amplitude.len()));
        let hidden = projection.slant_range_m((i as f64 + 0.5) * metres_per_cell) < min_m;
        *cell = match inside {
            Some(inside) if !inside.is_empty() && !hidden => {
                let sum: f64 = inside.iter().map(|&a| f64::from(a) * f64::from(a)).sum();
                (sum / inside.len() as f64) as f32
            }
            _ => f32::NAN,
        };
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sample_and_slant_range_are_inverse_functions() {
        let axis = RangeAxis::new(1500.0, 40e3);
        assert_eq!(axis.metres_per_sample, 0.01875);
        for k in [0, 1, 17, 10_000] {
            assert_eq!(axis.sample(axis.slant_range_m(k)), k);
        }
        assert_eq!(axis.sample(-3.0), 0);
    }

    #[test]
    fn cells_keep_the_mean_intensity_and_use_every_sample_once() {
        let amplitude: Vec<f32> = (0..1000).map(|k| 1.0 + (k % 7) as f32).collect();
        let mean = |v: &[f32]| v.iter().map(|&x| f64::from(x)).sum::<f64>() / v.len() as f64;
        let want = mean(&amplitude.iter().map(|a| a * a).collect::<Vec<_>>());
        for per_cell in [1, 4, 10, 25] {
            let axis = RangeAxis {
                metres_per_sample: 0.02,
            };
            let mut cells = vec![0.0; 1000 / per_cell];
            mean_intensity(&amplitude, axis, 0.02 * per_cell as f64, &mut cells);
            let got = mean(&cells);
            assert!((got / want - 1.0).abs() < 1e-6, "{per_cell}: {got} {want}");
        }
    }

    #[test]
    fn an_echo_appears_in_the_cell_of_its_slant_range_for_any_cell_size() {
        let axis = RangeAxis::new(1480.0, 37e3);
        let mut amplitude = vec![0.0_f32; 4000];
        amplitude[2345] = 1.0;
        let range_m = axis.slant_range_m(2345);
        for metres_per_cell in [0.003, 0.02, 0.05, 0.33, 2.0] {
            let mut cells = vec![0.0; (80.0 / metres_per_cell) as usize];
            mean_intensity(&amplitude, axis, metres_per_cell, &mut cells);
            let bright: Vec<_> = (0..cells.len()).filter(|&i| cells[i] > 0.0).collect();
            let want = (range_m / metres_per_cell + 1e-9) as usize;
            assert!(
                bright.contains(&want),
                "{metres_per_cell} m: {bright:?} want {want}"
            );
            assert!(bright.len() <= 1 + (axis.metres_per_sample / metres_per_cell).ceil() as usize);
        }
    }

    #[test]
    fn ground_cells_follow_pythagoras_and_use_every_sample_beyond_the_altitude_once() {
        let axis = RangeAxis {
            metres_per_sample: 0.02,
        };
        let ground = Projection::Ground { altitude_m: 12.0 };
        for (slant_m, across_m) in [(12.0, 0.0), (13.0, 5.0), (20.0, 16.0), (37.0, 35.0)] {
            assert!((ground.slant_range_m(across_m) - slant_m).abs() < 1e-12);
            let back = ground.across_m(slant_m).expect("beyond the altitude");
            assert!((back - across_m).abs() < 1e-6, "{back} want {across_m}");
        }
        assert_eq!(ground.across_m(11.9), None);
        // Far out, cells of 0.25 m hold about 12 samples; each sample belongs to one cell.
        let mut next = ground.samples(axis, 0.25, 40).start;
        for cell in 40..200 {
            let samples = ground.samples(axis, 0.25, cell);
            assert_eq!(samples.start, next, "cell {cell}");
            next = samples.end;
        }
    }

    #[test]
    fn the_first_return_is_found_at_any_level_and_none_in_silence() {
        let axis = RangeAxis {
            metres_per_sample: 0.02,
        };
        for (bottom_m, level) in [(8.0, 1.0), (23.4, 1e-4), (51.0, 30.0)] {
            let amplitude = (0..4000)
                .map(|k| {
                    let grain = 1.0 + 0.3 * (k as f32 * 1.7).sin();
                    match axis.slant_range_m(k) >= bottom_m {
                        true => level * grain,
                        false => 0.01 * level * grain,
                    }
                })
                .collect();
            let line = Line {
                side: echotank_core::ping::Side::Port,
                amplitude,
            };
            let found = first_return_m(&[line], axis).expect("a bottom");
            assert!((found - bottom_m).abs() <= 0.5, "{found} want {bottom_m}");
        }
        for amplitude in [
            vec![],
            vec![0.0; 4000],
            vec![1.0; 4000],
            vec![f32::NAN; 400],
        ] {
            let line = Line {
                side: echotank_core::ping::Side::Port,
                amplitude,
            };
            assert_eq!(first_return_m(&[line], axis), None);
        }
    }

    #[test]
    fn cells_beyond_the_line_are_nan() {
        let axis = RangeAxis {
            metres_per_sample: 0.1,
        };
        let mut cells = [0.0; 4];
        mean_intensity(&[2.0; 25], axis, 1.0, &mut cells);
        assert_eq!(cells[..3], [4.0, 4.0, 4.0]);
        assert!(cells[3].is_nan());
        mean_intensity(&[], axis, 1.0, &mut cells);
        assert!(cells.iter().all(|c| c.is_nan()));
    }
}
