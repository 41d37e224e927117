//! The slant-range axis of a side-scan line: sample k is an echo of two-way time k / f_s, hence of slant range c k / (2 f_s).

/// Slant range (one way, metres) of the samples of a line.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RangeAxis {
    pub metres_per_sample: f64,
}

impl RangeAxis {
    pub fn new(sound_speed_m_per_s: f64, sample_rate_hz: f64) -> Self {
        Self {
            metres_per_sample: 0.5 * sound_speed_m_per_s / sample_rate_hz,
        }
    }
    pub fn slant_range_m(&self, sample: usize) -> f64 {
        sample as f64 * self.metres_per_sample
    }
    /// The nearest sample.
    pub fn sample(&self, slant_range_m: f64) -> usize {
        (slant_range_m / self.metres_per_sample).round().max(0.0) as usize
    }
}

/// Mean intensity (amplitude squared) of a line in cells of `metres_per_cell`, cell i over [i, i+1) cells of slant range.
///
/// The mean, not the maximum: it keeps the mean level whatever the cell size, where a maximum brightens speckle by its logarithm.
/// A cell that falls between two samples takes the nearest; a cell beyond the line is NaN.
pub fn mean_intensity(amplitude: &[f32], axis: RangeAxis, metres_per_cell: f64, cells: &mut [f32]) {
    let samples_per_cell = metres_per_cell / axis.metres_per_sample;
    // A whisker below the sample: ranges are products and quotients, and cell edges often lie on samples.
    let edge = |cell: usize| (cell as f64 * samples_per_cell - 1e-6).ceil().max(0.0) as usize;
    for (i, cell) in cells.iter_mut().enumerate() {
        let (first, end) = (edge(i), edge(i + 1));
        let inside = if first < end {
            amplitude.get(first..end.min(amplitude.len()))
        } else {
            let nearest = ((i as f64 + 0.5) * samples_per_cell).round() as usize;
            amplitude.get(nearest..nearest + 1)
        };
        *cell = match inside {
            Some(inside) if !inside.is_empty() => {
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
    fn a_sample_and_its_range_are_each_other_s_inverse() {
        let axis = RangeAxis::new(1500.0, 40e3);
        assert_eq!(axis.metres_per_sample, 0.01875);
        for k in [0, 1, 17, 10_000] {
            assert_eq!(axis.sample(axis.slant_range_m(k)), k);
        }
        assert_eq!(axis.sample(-3.0), 0);
    }

    #[test]
    fn cells_keep_the_mean_intensity_and_every_sample_counts_once() {
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
    fn an_echo_lights_the_cell_of_its_slant_range_for_any_cell_size() {
        let axis = RangeAxis::new(1480.0, 37e3);
        let mut amplitude = vec![0.0_f32; 4000];
        amplitude[2345] = 1.0;
        let range_m = axis.slant_range_m(2345);
        for metres_per_cell in [0.003, 0.02, 0.05, 0.33, 2.0] {
            let mut cells = vec![0.0; (80.0 / metres_per_cell) as usize];
            mean_intensity(&amplitude, axis, metres_per_cell, &mut cells);
            let lit: Vec<_> = (0..cells.len()).filter(|&i| cells[i] > 0.0).collect();
            let want = (range_m / metres_per_cell + 1e-9) as usize;
            assert!(
                lit.contains(&want),
                "{metres_per_cell} m: {lit:?} want {want}"
            );
            assert!(lit.len() <= 1 + (axis.metres_per_sample / metres_per_cell).ceil() as usize);
        }
    }

    #[test]
    fn cells_beyond_the_line_hold_nothing() {
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
