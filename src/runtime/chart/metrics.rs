//! Error measures of the pings of a method against the reference solution.

use num_complex::{Complex32, Complex64};

use echotank_core::ping::PingOutput;

/// Number of samples per picture pixel; a pixel sums their energies.
const PIXEL_SAMPLES: usize = 16;
/// Level at which pixel differences are clipped, because larger differences look the same, dB.
const MAX_DB: f64 = 20.0;
/// Level below a line's maximum at which pixels count as dark, dB.
const DARK_DB: f64 = -60.0;

/// Errors against the reference solution.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Errors {
    /// Relative l2 error of all element samples.
    pub elements: f64,
    /// Largest relative l2 error of one element in one ping.
    pub worst_element: f64,
    /// Relative l2 error of the compressed envelopes of side-scan lines, or of beams without lines; `None` without both.
    pub lines: Option<f64>,
    /// rms difference of the picture's pixels, dB, clipped at 20 dB; `None` without lines and beams.
    pub image_db: Option<f64>,
    /// Energy of all samples relative to the reference solution, dB.
    pub level_db: f64,
}

/// Sums of squared differences (`off`) and of squared reference values (`all`).
#[derive(Clone, Copy, Default)]
struct Sums {
    off: f64,
    all: f64,
}

impl Sums {
    fn relative(self) -> f64 {
        match self.all > 0.0 {
            true => (self.off / self.all).sqrt(),
            // With a zero reference, any difference counts as an error of 1.
            false => f64::from(u8::from(self.off > 0.0)),
        }
    }
    fn add(&mut self, other: Self) {
        self.off += other.off;
        self.all += other.all;
    }
}

/// Errors over all pings together. Both slices must hold the same pings in the same order.
pub fn errors(got: &[PingOutput], want: &[PingOutput]) -> Errors {
    let (mut elements, mut lines) = (Sums::default(), Sums::default());
    let (mut energy, mut reference_energy) = (0.0, 0.0);
    let mut worst_element = 0.0f64;
    let (mut pixels, mut off_db2) = (0usize, 0.0);
    for (got, want) in got.iter().zip(want) {
        for (got, want) in got.elements.iter().zip(&want.elements) {
            let rows = got.iq.chunks(got.samples.max(1));
            for (got, want) in rows.zip(want.iq.chunks(want.samples.max(1))) {
                let this = complex_sums(got, want);
                worst_element = worst_element.max(this.relative());
                elements.add(this);
                energy += got.iter().map(|x| x.norm_sqr()).sum::<f64>();
                reference_energy += this.all;
            }
        }
        let mut compare = |got: &[f32], want: &[f32]| {
            lines.add(real_sums(got, want));
            let (count, sum) = pixels_off_db2(got, want);
            pixels += count;
            off_db2 += sum;
        };
        for (got, want) in got.lines.iter().zip(&want.lines) {
            compare(&got.amplitude, &want.amplitude);
        }
        if got.lines.is_empty() {
            for (got, want) in got.beams.iter().zip(&want.beams) {
                let rows = got.iq.chunks(got.samples.max(1));
                for (got, want) in rows.zip(want.iq.chunks(want.samples.max(1))) {
                    compare(&envelope(got), &envelope(want));
                }
            }
        }
    }
    Errors {
        elements: elements.relative(),
        worst_element,
        lines: (lines.all > 0.0).then(|| lines.relative()),
        image_db: (pixels > 0).then(|| (off_db2 / pixels as f64).sqrt()),
        level_db: 10.0 * (energy / reference_energy).log10(),
    }
}

fn envelope(row: &[Complex32]) -> Vec<f32> {
    row.iter().map(|x| x.norm()).collect()
}

fn complex_sums(got: &[Complex64], want: &[Complex64]) -> Sums {
    let mut sums = Sums::default();
    for (got, want) in got.iter().zip(want) {
        sums.off += (got - want).norm_sqr();
        sums.all += want.norm_sqr();
    }
    sums
}

fn real_sums(got: &[f32], want: &[f32]) -> Sums {
    let mut sums = Sums::default();
    for (&got, &want) in got.iter().zip(want) {
        let (got, want) = (f64::from(got), f64::from(want));
        sums.off += (got - want) * (got - want);
        sums.all += want * want;
    }
    sums
}

/// Number of pixels of a row, and sum of their squared differences, dB squared.
fn pixels_off_db2(got: &[f32], want: &[f32]) -> (usize, f64) {
    let energies = |row: &[f32]| -> Vec<f64> {
        row.chunks(PIXEL_SAMPLES)
            .map(|pixel| pixel.iter().map(|&a| f64::from(a) * f64::from(a)).sum())
            .collect()
    };
    let (got, want) = (energies(got), energies(want));
    let dark = want.iter().copied().fold(0.0, f64::max) * 10f64.powf(DARK_DB / 10.0);
    if dark == 0.0 {
        return (0, 0.0);
    }
    let squares = got.iter().zip(&want).map(|(&got, &want)| {
        let off_db = 10.0 * (got.max(dark) / want.max(dark)).log10();
        off_db.clamp(-MAX_DB, MAX_DB).powi(2)
    });
    (want.len(), squares.sum())
}

#[cfg(test)]
mod tests {
    use super::*;
    use echotank_core::ping::{ElementFrame, Line, Side};

    fn output(scale: f64) -> PingOutput {
        let iq: Vec<Complex64> = (0..64)
            .map(|k| Complex64::from_polar(scale * (1.0 + k as f64), 0.1 * k as f64))
            .collect();
        PingOutput {
            elements: vec![ElementFrame {
                elements: 2,
                samples: 32,
                iq: iq.clone(),
                ..ElementFrame::default()
            }],
            lines: vec![Line {
                side: Side::Port,
                amplitude: iq.iter().map(|x| x.norm() as f32).collect(),
            }],
            ..PingOutput::default()
        }
    }

    #[test]
    fn a_gain_of_one_percent_is_one_percent_in_all_measures() {
        let got = errors(&[output(1.01)], &[output(1.0)]);
        let db = 20.0 * 1.01f64.log10();
        assert!((got.elements - 0.01).abs() < 1e-12, "{got:?}");
        assert!((got.worst_element - 0.01).abs() < 1e-12, "{got:?}");
        assert!((got.lines.unwrap() - 0.01).abs() < 1e-6, "{got:?}");
        assert!((got.image_db.unwrap() - db).abs() < 1e-5, "{got:?} {db}");
        assert!((got.level_db - db).abs() < 1e-12, "{got:?} {db}");
    }

    #[test]
    fn against_a_zero_reference_zero_has_no_error_and_any_signal_has_error_one() {
        let silent = output(0.0);
        let silent = std::slice::from_ref(&silent);
        assert_eq!(errors(silent, silent).elements, 0.0);
        assert_eq!(errors(&[output(1.0)], silent).elements, 1.0);
    }
}
