//! Computes real passband samples, as a converter at the element takes them, from the complex envelope at the receiver's rate.
//!
//! For the envelope x (volts rms) at carrier frequency f_c, the voltage is sqrt(2) Re{ x(t) exp(j 2 pi f_c t) }, with t from the
//! start of the pulse. x is interpolated with a sinc under a Kaiser window (Kaiser 1974) of [`TAPS`] samples. The interpolation
//! reproduces the samples of the envelope. Between the samples, the error of a tone within 0.8 of the band is below 2e-5 of its
//! amplitude. The signal and its Doppler shift must be within that part of the band (`receiver.sample_rate_khz`). The envelope is
//! zero outside its record.

use std::f64::consts::{PI, TAU};
use std::ops::Range;

use echotank_core::simd::SimdLevel;
use num_complex::Complex64;

/// Number of input samples that contribute to one interpolated sample.
pub const TAPS: usize = 40;
/// Number of elements that are interpolated together: two AVX-512 registers of I and Q.
pub const LANES: usize = 8;
/// Maximum number of output samples passed on together.
pub const BLOCK: usize = 64;
/// Number of tabulated kernel positions between two samples. Linear interpolation between positions adds an error of pi^2 0.8^2 / 8
/// / PHASES^2 = 5e-8.
const PHASES: usize = 4096;
/// Shape parameter of the Kaiser window for 100 dB: 0.1102 (100 - 8.7).
const BETA: f64 = 10.06;

/// Interpolator and mixer. One instance serves all elements of a sonar and one thread.
pub struct Passband {
    in_rate_hz: f64,
    out_rate_hz: f64,
    center_hz: f64,
    /// Kernel taps in `PHASES + 1` rows, one per position.
    kernel: Vec<[f64; TAPS]>,
    /// cos and sin of the carrier phase at the output samples of the current ping.
    carrier: Vec<[f64; 2]>,
    /// I of each current element, then Q, by sample; padded with zeros for the kernel at both ends.
    rows: Vec<[f64; 2 * LANES]>,
    /// Times of the first output sample and of the first input sample, seconds from the start of the pulse.
    start_s: f64,
    first_in_s: f64,
}

impl Passband {
    /// `in_rate_hz` is the sample rate of the envelope. `out_rate_hz` is the sample rate of the output. `center_hz` is the carrier
    /// frequency.
    pub fn new(in_rate_hz: f64, out_rate_hz: f64, center_hz: f64) -> Self {
        let kernel = (0..=PHASES)
            .map(|phase| {
                let fraction = phase as f64 / PHASES as f64;
                std::array::from_fn(|tap| weight(tap as f64 - (TAPS / 2 - 1) as f64 - fraction))
            })
            .collect();
        Self {
            in_rate_hz,
            out_rate_hz,
            center_hz,
            kernel,
            carrier: Vec::new(),
            rows: Vec::new(),
            start_s: 0.0,
            first_in_s: 0.0,
        }
    }

    /// Number of output samples for `in_samples` input samples.
    pub fn samples_of(&self, in_samples: usize) -> usize {
        (in_samples as f64 * self.out_rate_hz / self.in_rate_hz).floor() as usize
    }

    /// Number of output samples per element of the current ping.
    pub fn samples(&self) -> usize {
        self.carrier.len()
    }

    /// Starts a ping of `samples` output samples from `start_s` on. The first envelope sample is at `first_in_s`. Both times are
    /// seconds from the start of the pulse.
    pub fn begin(&mut self, start_s: f64, samples: usize, first_in_s: f64) {
        let is_same = start_s == self.start_s && samples == self.carrier.len();
        self.start_s = start_s;
        self.first_in_s = first_in_s;
        if is_same {
            return;
        }
        self.carrier.clear();
        let (center_hz, rate_hz) = (self.center_hz, self.out_rate_hz);
        self.carrier.extend((0..samples).map(|n| {
            let turns = center_hz * (start_s + n as f64 / rate_hz);
            let (sin, cos) = (TAU * turns.fract()).sin_cos();
            [cos, sin]
        }));
    }

    /// Passes the output samples of all elements to `each`, in blocks: the indices of at most [`LANES`] elements, the number of the first
    /// sample, and at most [`BLOCK`] rows with one sample of each element. Further values of a row have no meaning. The scale is
    /// 1/sqrt(2): an envelope of 1 V rms gives values between -1 and 1.
    pub fn elements<'a>(
        &mut self,
        mut envelopes: impl Iterator<Item = &'a [Complex64]>,
        mut each: impl FnMut(Range<usize>, usize, &[[f64; LANES]]),
    ) {
        let mut first_element = 0;
        loop {
            let mut block: [&[Complex64]; LANES] = [&[]; LANES];
            let mut count = 0;
            for (row, envelope) in block.iter_mut().zip(&mut envelopes) {
                *row = envelope;
                count += 1;
            }
            if count == 0 {
                return;
            }
            let elements = first_element..first_element + count;
            self.block(&block, |first, rows| each(elements.clone(), first, rows));
            first_element += count;
        }
    }

    fn block(
        &mut self,
        envelopes: &[&[Complex64]; LANES],
        mut each: impl FnMut(usize, &[[f64; LANES]]),
    ) {
        let len = envelopes.iter().map(|row| row.len()).max().unwrap_or(0);
        self.rows.clear();
        self.rows.resize(len + 2 * TAPS, [0.0; 2 * LANES]);
        for (lane, envelope) in envelopes.iter().enumerate() {
            for (row, v) in self.rows[TAPS..].iter_mut().zip(*envelope) {
                row[lane] = v.re;
                row[LANES + lane] = v.im;
            }
        }
        let level = SimdLevel::best();
        let mut out = [[0.0; LANES]; BLOCK];
        for first in (0..self.carrier.len()).step_by(BLOCK) {
            let count = BLOCK.min(self.carrier.len() - first);
            let out = &mut out[..count];
            level.run(
                #[inline(always)]
                || {
                    for (k, out) in out.iter_mut().enumerate() {
                        *out = self.sample(len, first + k);
                    }
                },
            );
            each(first, out);
        }
    }

    /// Output sample `n` of all elements, from envelopes of `len` samples.
    #[inline(always)]
    fn sample(&self, len: usize, n: usize) -> [f64; LANES] {
        let step = self.in_rate_hz / self.out_rate_hz;
        let place = (self.start_s - self.first_in_s) * self.in_rate_hz + n as f64 * step;
        let whole = place.floor();
        // Index of the first tap in the rows, which begin with TAPS zeros.
        let tap = whole + (TAPS - (TAPS / 2 - 1)) as f64;
        if tap < 0.0 || tap as usize + TAPS > len + 2 * TAPS {
            return [0.0; LANES];
        }
        let at_phase = (place - whole) * PHASES as f64;
        let phase = at_phase as usize;
        let between = at_phase - phase as f64;
        let (near, far) = (&self.kernel[phase], &self.kernel[phase + 1]);
        let rows = &self.rows[tap as usize..][..TAPS];
        let mut weights = [0.0; TAPS];
        for k in 0..TAPS {
            weights[k] = near[k] + between * (far[k] - near[k]);
        }
        // Two sums: that of the even taps does not wait for that of the odd ones.
        let (mut even, mut odd) = ([0.0; 2 * LANES], [0.0; 2 * LANES]);
        for k in (0..TAPS).step_by(2) {
            for lane in 0..2 * LANES {
                even[lane] += weights[k] * rows[k][lane];
                odd[lane] += weights[k + 1] * rows[k + 1][lane];
            }
        }
        let [cos, sin] = self.carrier[n];
        std::array::from_fn(|e| {
            let (re, im) = (even[e] + odd[e], even[LANES + e] + odd[LANES + e]);
            re * cos - im * sin
        })
    }
}

/// Kernel value `x` samples from its centre.
fn weight(x: f64) -> f64 {
    let across = x / (TAPS / 2) as f64;
    if across.abs() >= 1.0 {
        return 0.0;
    }
    let sinc = if x == 0.0 {
        1.0
    } else {
        (PI * x).sin() / (PI * x)
    };
    sinc * bessel_i0(BETA * (1.0 - across * across).sqrt()) / bessel_i0(BETA)
}

/// Modified Bessel function of order 0, by its power series.
fn bessel_i0(x: f64) -> f64 {
    let quarter = 0.25 * x * x;
    let (mut term, mut sum) = (1.0, 1.0);
    for k in 1..60 {
        term *= quarter / f64::from(k * k);
        sum += term;
    }
    sum
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Bound on the interpolation error relative to a tone's amplitude, within 0.8 of the band.
    const INTERPOLATION_ERROR: f64 = 2e-5;

    /// Largest difference from Re{ x exp(j 2 pi f_c t) } away from the ends of the record, for a tone at `tone_hz` from the carrier.
    fn error_of_tone(in_hz: f64, out_hz: f64, tone_hz: f64, start_s: f64) -> f64 {
        let (center_hz, first_s) = (400e3, 1.7e-3);
        let samples = 1000;
        let at = |t: f64| Complex64::cis(TAU * tone_hz * t);
        let envelope: Vec<_> = (0..samples)
            .map(|k| at(first_s + k as f64 / in_hz))
            .collect();
        let mut passband = Passband::new(in_hz, out_hz, center_hz);
        let n_out = passband.samples_of(samples);
        passband.begin(start_s, n_out, first_s);
        let (mut n, mut worst) = (0, 0.0_f64);
        let margin_s = TAPS as f64 / in_hz;
        passband.elements([&envelope[..]].into_iter(), |_, _, rows| {
            for &[got, ..] in rows {
                let t = start_s + n as f64 / out_hz;
                n += 1;
                let inside =
                    t > first_s + margin_s && t < first_s + samples as f64 / in_hz - margin_s;
                if inside {
                    let want = (TAU * (center_hz + tone_hz) * t).cos();
                    worst = worst.max((got - want).abs());
                }
            }
        });
        assert_eq!(n, n_out);
        worst
    }

    #[test]
    fn a_tone_within_0p8_of_the_band_is_itself_at_any_ratio_of_rates() {
        for (in_hz, out_hz) in [(40e3, 1e6), (34_483.0, 1_250_000.0), (50e3, 2_000_001.0)] {
            for part in [-0.4, -0.27, 0.0, 0.13, 0.4] {
                for start_s in [1.7e-3, 1.7e-3 + 0.377 / in_hz] {
                    let worst = error_of_tone(in_hz, out_hz, part * in_hz, start_s);
                    assert!(
                        worst < INTERPOLATION_ERROR,
                        "{in_hz} to {out_hz} Hz, tone at {part}: off by {worst:.1e}, allowed {INTERPOLATION_ERROR:.0e}"
                    );
                }
            }
        }
    }

    #[test]
    fn interpolation_reproduces_the_envelopes_own_samples() {
        let envelope: Vec<_> = (0..100)
            .map(|k| Complex64::new((k as f64 * 1.7).sin(), (k as f64 * 0.3).cos()))
            .collect();
        // There are 25 output samples per input sample. The carrier makes a whole number of cycles per input sample.
        let mut passband = Passband::new(40e3, 1e6, 400e3);
        passband.begin(0.0, 2500, 0.0);
        let mut out = Vec::new();
        passband.elements([&envelope[..]].into_iter(), |_, _, rows| {
            out.extend(rows.iter().map(|row| row[0]))
        });
        for (k, v) in envelope.iter().enumerate() {
            let got = out[25 * k];
            assert!((got - v.re).abs() < 1e-9, "sample {k}: {got}, {}", v.re);
        }
    }

    #[test]
    fn samples_outside_the_record_are_zero() {
        let mut passband = Passband::new(40e3, 1e6, 400e3);
        passband.begin(-1.0, 1000, 0.0);
        let ones = || [&[Complex64::ONE; 10][..]].into_iter();
        let zeros = |_: Range<usize>, _: usize, rows: &[[f64; LANES]]| {
            assert_eq!(rows.as_flattened(), vec![0.0; rows.len() * LANES])
        };
        passband.elements(ones(), zeros);
        passband.begin(1.0, 1000, 0.0);
        passband.elements(ones(), zeros);
    }

    /// Every element gets its own samples: those of the plain sum over its envelope.
    #[test]
    fn elements_side_by_side_are_the_plain_sums_of_each() {
        let (in_hz, out_hz, center_hz) = (34_483.0, 1_250_000.0, 400e3);
        const ELEMENTS: usize = LANES + 3;
        let envelopes: Vec<Vec<_>> = (0..ELEMENTS)
            .map(|e| {
                let phase = |k: usize| (k * (e + 3)) as f64;
                (0..90 + e)
                    .map(|k| Complex64::cis(phase(k)) * (1.0 + e as f64))
                    .collect()
            })
            .collect();
        let mut passband = Passband::new(in_hz, out_hz, center_hz);
        let (start_s, first_s, samples) = (1.2e-4, 1e-4, 3000);
        passband.begin(start_s, samples, first_s);
        let mut got = vec![Vec::new(); ELEMENTS];
        passband.elements(
            envelopes.iter().map(Vec::as_slice),
            |elements, first, rows| {
                for (lane, got) in got[elements].iter_mut().enumerate() {
                    assert_eq!(first, got.len());
                    got.extend(rows.iter().map(|row| row[lane]));
                }
            },
        );
        for n in 0..samples {
            let t = start_s + n as f64 / out_hz;
            let place = (t - first_s) * in_hz;
            for (envelope, got) in envelopes.iter().zip(&got) {
                let got = got[n];
                let sum: Complex64 = envelope
                    .iter()
                    .enumerate()
                    .map(|(k, v)| v * weight(k as f64 - place))
                    .sum();
                let want = (sum * Complex64::cis(TAU * (center_hz * t).fract())).re;
                assert!(
                    (got - want).abs() < 1e-6 * ELEMENTS as f64,
                    "{n}: {got}, {want}"
                );
            }
        }
    }
}
