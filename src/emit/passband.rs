//! Computes real passband samples, as a converter at the element takes them, from the complex envelope at the receiver's rate.
//!
//! For the envelope x (volts rms) at carrier frequency f_c, the voltage is sqrt(2) Re{ x(t) exp(j 2 pi f_c t) }, with t from the
//! start of the pulse. x is interpolated with a sinc under a Kaiser window (Kaiser 1974) of [`TAPS`] samples. The interpolation
//! reproduces the samples of the envelope. Between the samples, the error of a tone within 0.8 of the band is below 2e-5 of its
//! amplitude. The signal and its Doppler shift must be within that part of the band (`receiver.sample_rate_khz`). The envelope is
//! zero outside its record.

use std::f64::consts::{PI, TAU};

use num_complex::Complex64;

/// Number of input samples that contribute to one interpolated sample.
pub const TAPS: usize = 40;
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
    /// I and Q of the current element, padded with zeros for the kernel at both ends.
    i: Vec<f64>,
    q: Vec<f64>,
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
            i: Vec::new(),
            q: Vec::new(),
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
        self.start_s = start_s;
        self.first_in_s = first_in_s;
        self.carrier.clear();
        let (center_hz, rate_hz) = (self.center_hz, self.out_rate_hz);
        self.carrier.extend((0..samples).map(|n| {
            let turns = center_hz * (start_s + n as f64 / rate_hz);
            let (sin, cos) = (TAU * turns.fract()).sin_cos();
            [cos, sin]
        }));
    }

    /// Passes the output samples of one element to `each`, in order. The scale is 1/sqrt(2): an envelope of 1 V rms gives values
    /// between -1 and 1.
    pub fn element(&mut self, envelope: &[Complex64], mut each: impl FnMut(f64)) {
        for (row, part) in [(&mut self.i, 0), (&mut self.q, 1)] {
            row.clear();
            row.resize(TAPS, 0.0);
            row.extend(envelope.iter().map(|v| if part == 0 { v.re } else { v.im }));
            row.resize(envelope.len() + 2 * TAPS, 0.0);
        }
        let step = self.in_rate_hz / self.out_rate_hz;
        let first = (self.start_s - self.first_in_s) * self.in_rate_hz;
        for (n, &[cos, sin]) in self.carrier.iter().enumerate() {
            let place = first + n as f64 * step;
            let whole = place.floor();
            let at_phase = (place - whole) * PHASES as f64;
            let phase = at_phase as usize;
            let between = at_phase - phase as f64;
            // Index of the first tap in the rows, which begin with TAPS zeros.
            let tap = whole + (TAPS - (TAPS / 2 - 1)) as f64;
            if tap < 0.0 || tap as usize + TAPS > self.i.len() {
                each(0.0);
                continue;
            }
            let window = tap as usize..tap as usize + TAPS;
            let (i, q) = (&self.i[window.clone()], &self.q[window]);
            let near = &self.kernel[phase];
            let (mut re, mut im) = (dot(near, i), dot(near, q));
            if between > 0.0 {
                let far = &self.kernel[phase + 1];
                re += between * (dot(far, i) - re);
                im += between * (dot(far, q) - im);
            }
            each(re * cos - im * sin);
        }
    }
}

/// Dot product in four partial sums, which the compiler can vectorise.
fn dot(weights: &[f64; TAPS], samples: &[f64]) -> f64 {
    let mut sums = [0.0; 4];
    for (w, x) in weights.chunks_exact(4).zip(samples.chunks_exact(4)) {
        for k in 0..4 {
            sums[k] += w[k] * x[k];
        }
    }
    (sums[0] + sums[1]) + (sums[2] + sums[3])
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
        passband.element(&envelope, |got| {
            let t = start_s + n as f64 / out_hz;
            n += 1;
            let inside = t > first_s + margin_s && t < first_s + samples as f64 / in_hz - margin_s;
            if inside {
                let want = (TAU * (center_hz + tone_hz) * t).cos();
                worst = worst.max((got - want).abs());
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
        passband.element(&envelope, |v| out.push(v));
        for (k, v) in envelope.iter().enumerate() {
            let got = out[25 * k];
            assert!((got - v.re).abs() < 1e-9, "sample {k}: {got}, {}", v.re);
        }
    }

    #[test]
    fn samples_outside_the_record_are_zero() {
        let mut passband = Passband::new(40e3, 1e6, 400e3);
        passband.begin(-1.0, 1000, 0.0);
        passband.element(&[Complex64::ONE; 10], |v| assert_eq!(v, 0.0));
        passband.begin(1.0, 1000, 0.0);
        passband.element(&[Complex64::ONE; 10], |v| assert_eq!(v, 0.0));
    }
}
