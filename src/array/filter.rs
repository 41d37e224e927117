//! The receiver's anti-alias filter: a linear-phase low-pass on a densely evaluated sum, its delay removed, then one sample in L.
//!
//! h(t) is one fixed function of time, a Kaiser-windowed sinc; the dense rate only says how finely the convolution with it is summed. So
//! a denser evaluation converges to one answer. A pulse with sharp edges makes that convergence first order in the dense step.

use num_complex::Complex64;

use crate::flow::{Pulse, Synthesis};

/// Rejection beyond the stop edge, and (as 1e-4) the ripple of the pass band, dB.
const STOP_BAND_DB: f64 = 80.0;

/// Dense rate over max(B, 4/T).
const REFERENCE_DENSITY: f64 = 32.0;
const DIRECT_DENSITY: f64 = 8.0;

#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum FilterError {
    #[error(
        "sample rate {sample_rate_hz} Hz is too low for the receiver filter: the pulse needs a pass band of +-{pass_hz} Hz, which must \
         stay below 0.45 of the sample rate; at least {least_hz} Hz"
    )]
    RateTooLow {
        sample_rate_hz: f64,
        pass_hz: f64,
        least_hz: f64,
    },
}

/// The band a pulse occupies about its centre, Hz: its sweep or, where it is short, its own width.
pub fn occupied_hz(pulse: &Pulse) -> f64 {
    pulse.bandwidth_hz.max(4.0 / pulse.duration_s)
}

/// How many dense samples per output sample the receiver filter should be fed with.
///
/// The reference takes 32 max(B, 4/T) at least, `direct` 8. The tests say what is left against twice that density.
pub fn oversample(pulse: &Pulse, sample_rate_hz: f64, synthesis: Synthesis) -> usize {
    let density = match synthesis {
        Synthesis::Reference => REFERENCE_DENSITY,
        Synthesis::Direct => DIRECT_DENSITY,
    };
    ((density * occupied_hz(pulse) / sample_rate_hz).ceil() as usize).max(1)
}

/// The filter at one sample rate and density, made once per plan.
#[derive(Clone, Debug)]
pub struct Decimator {
    oversample: usize,
    sample_rate_hz: f64,
    /// Symmetric about the last one here: the taps from the outermost to the middle.
    taps: Vec<f64>,
}

impl Decimator {
    /// Pass band max(B, 4/T)/2 + `doppler_hz`, stop band from half the sample rate on. `oversample`: dense samples per output sample.
    pub fn new(
        pulse: &Pulse,
        sample_rate_hz: f64,
        doppler_hz: f64,
        oversample: usize,
    ) -> Result<Self, FilterError> {
        let pass_hz = 0.5 * occupied_hz(pulse) + doppler_hz;
        let stop_hz = 0.5 * sample_rate_hz;
        if pass_hz > 0.9 * stop_hz {
            return Err(FilterError::RateTooLow {
                sample_rate_hz,
                pass_hz,
                least_hz: pass_hz / 0.45,
            });
        }
        // Kaiser (1974): length and shape from rejection and transition width.
        let beta = 0.1102 * (STOP_BAND_DB - 8.7);
        let length_s =
            (STOP_BAND_DB - 7.95) / (2.285 * std::f64::consts::TAU * (stop_hz - pass_hz));
        let cut_hz = 0.5 * (pass_hz + stop_hz);
        let dense_s = 1.0 / (sample_rate_hz * oversample as f64);
        let half = (0.5 * length_s / dense_s).floor() as usize;
        let mut taps: Vec<f64> = (0..=half)
            .map(|k| {
                let t_s = (half - k) as f64 * dense_s;
                let edge = (2.0 * t_s / length_s).min(1.0);
                let window = bessel_i0(beta * (1.0 - edge * edge).sqrt()) / bessel_i0(beta);
                let x = 2.0 * cut_hz * t_s;
                let pi_x = std::f64::consts::PI * x;
                let sinc = if x == 0.0 { 1.0 } else { libm::sin(pi_x) / pi_x };
                2.0 * cut_hz * sinc * window
            })
            .collect();
        // Unit gain at the centre frequency.
        let sum = 2.0 * taps[..half].iter().sum::<f64>() + taps[half];
        taps.iter_mut().for_each(|tap| *tap /= sum);
        Ok(Self {
            oversample,
            sample_rate_hz,
            taps,
        })
    }

    fn half(&self) -> usize {
        self.taps.len() - 1
    }

    /// Rate of the dense samples.
    pub fn dense_rate_hz(&self) -> f64 {
        self.sample_rate_hz * self.oversample as f64
    }

    /// Where the dense samples begin for output that begins at `first_sample_s`: half a filter earlier.
    pub fn dense_first_s(&self, first_sample_s: f64) -> f64 {
        first_sample_s - self.half() as f64 / self.dense_rate_hz()
    }

    /// Dense samples that `count` output samples need.
    pub fn dense_len(&self, count: usize) -> usize {
        match count {
            0 => 0,
            _ => (count - 1) * self.oversample + 2 * self.half() + 1,
        }
    }

    /// Filters and decimates. `dense` holds [`Self::dense_len`] of `out.len()` samples.
    pub fn apply(&self, dense: &[Complex64], out: &mut [Complex64]) {
        assert_eq!(
            dense.len(),
            self.dense_len(out.len()),
            "dense samples for {} of output",
            out.len()
        );
        let half = self.half();
        let (sides, middle) = (&self.taps[..half], self.taps[half]);
        for (n, sample) in out.iter_mut().enumerate() {
            let window = &dense[n * self.oversample..][..2 * half + 1];
            let (left, right) = (&window[..half], &window[half + 1..]);
            let mut sum = window[half] * middle;
            for ((&tap, a), b) in sides.iter().zip(left).zip(right.iter().rev()) {
                sum.re += tap * (a.re + b.re);
                sum.im += tap * (a.im + b.im);
            }
            *sample = sum;
        }
    }

    /// Gain at `offset_hz` from the centre frequency (real: the filter has no delay).
    pub fn gain(&self, offset_hz: f64) -> f64 {
        let half = self.half();
        let turn = std::f64::consts::TAU * offset_hz / self.dense_rate_hz();
        self.taps[half]
            + 2.0
                * (0..half)
                    .map(|k| self.taps[k] * libm::cos(turn * (half - k) as f64))
                    .sum::<f64>()
    }
}

/// Modified Bessel function of the first kind, order 0: its power series, which for the arguments here (below 12) ends within 40 terms.
fn bessel_i0(x: f64) -> f64 {
    let quarter = 0.25 * x * x;
    let (mut term, mut sum) = (1.0, 1.0);
    for k in 1..60 {
        term *= quarter / (k * k) as f64;
        sum += term;
    }
    sum
}
