//! Anti-alias filter of the receiver: a linear-phase low-pass applied to a densely sampled sum,
//! then decimation by L.
//!
//! The impulse response h(t) is a fixed function of time, a Kaiser-windowed sinc (Kaiser 1974). The
//! dense rate is only the step of the convolution sum, so a denser evaluation converges to one
//! result. The filter delay is removed.
//!
//! The step at the ends of the Kaiser window is subtracted, which leaves corners there. The taps
//! next to the corners are weighted, as are the points next to the breaks of a pulse (see
//! [`EndWeights`]). The sum then has the error of its aliases: the response beyond L times the
//! sample rate, far in the stop band. The reference solution computes the
//! same integral without dense points.

use num_complex::Complex64;

use crate::edges::{END_POINTS, EndWeights, FIRST_POINT};
use echotank_core::model::Synthesis;
use echotank_core::pulse::Pulse;

/// Rejection beyond the stop edge, dB, and ripple of the pass band (1e-4). Kaiser's formulas fall
/// up to 4 dB short for a window that ends in zero, so the filter achieves 80 dB.
const STOP_BAND_DB: f64 = 84.5;

/// Ratio of the dense rate to the band, where the band is max(B, 4/T) and at least [`MIN_BAND`] of
/// the sample rate.
const REFERENCE_DENSITY: f64 = 32.0;
const MIN_BAND: f64 = 0.7;
/// Share of the sample rate that `direct` adds to the band for Doppler.
const DOPPLER_SHARE: f64 = 0.05;
/// Largest share of the sample rate that `direct` adds for the flanks of a taper, which modulate
/// the pulse. Flanks of less than a sample have more, and a larger error.
const MAX_FLANK_SHARE: f64 = 0.6;
/// Band for which `direct` takes its points, radians per point: the weights of ends err by 2e-6.
const DIRECT_BAND: f64 = 1.5;
/// Minimum number of points per sample of `direct`. Two leave aliases of the stop band of 1e-3
/// beside echoes, three leave 5e-5.
const MIN_DIRECT: usize = 3;

/// Error of the filter design.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum FilterError {
    #[error(
        "sample rate {sample_rate_hz} Hz is too low for the receiver filter: the pulse needs a pass band of +-{pass_hz} Hz, which must \
         stay below 0.45 of the sample rate; at least {min_hz} Hz"
    )]
    /// The pass band does not fit the sample rate.
    RateTooLow {
        /// Requested sample rate, Hz.
        sample_rate_hz: f64,
        /// Edge of the pass band from the centre frequency, Hz.
        pass_hz: f64,
        /// Smallest sufficient sample rate, Hz.
        min_hz: f64,
    },
}

/// Bandwidth of a pulse, Hz: the width of its sweep, or 4/T for a short pulse.
pub fn occupied_hz(pulse: &Pulse) -> f64 {
    pulse.bandwidth_hz.max(4.0 / pulse.duration_s)
}

/// Time grid on which a sum of `count` samples from `first_sample_s` is evaluated, before the
/// filter if there is one. Returns the first instant (seconds), the rate (Hz) and the number of
/// samples.
pub fn grid_ahead(
    filter: Option<&Decimator>,
    first_sample_s: f64,
    sample_rate_hz: f64,
    count: usize,
) -> (f64, f64, usize) {
    match filter {
        None => (first_sample_s, sample_rate_hz, count),
        Some(filter) => (
            filter.dense_first_s(first_sample_s),
            filter.dense_rate_hz(),
            filter.dense_len(count),
        ),
    }
}

/// Number of dense samples per output sample at the input of the receiver filter.
///
/// `direct` takes as many as [`EndWeights`] need for its pulse behind the filter. The other methods
/// compute one replica or spectrum per plan, so a high density costs little.
pub fn oversample(pulse: &Pulse, sample_rate_hz: f64, synthesis: Synthesis) -> usize {
    let occupied = occupied_hz(pulse) / sample_rate_hz;
    match synthesis {
        Synthesis::Direct => {
            let flank = flank_share(pulse, sample_rate_hz).min(MAX_FLANK_SHARE);
            let band = 0.5 * (1.0 + occupied) + DOPPLER_SHARE + flank;
            ((std::f64::consts::TAU * band / DIRECT_BAND).ceil() as usize).max(MIN_DIRECT)
        }
        _ => (REFERENCE_DENSITY * occupied.max(MIN_BAND)).ceil() as usize,
    }
}

/// Frequency with which the flanks of a taper modulate the pulse, as a share of the sample rate.
fn flank_share(pulse: &Pulse, sample_rate_hz: f64) -> f64 {
    if pulse.taper <= 0.0 {
        return 0.0;
    }
    1.0 / (pulse.taper * pulse.duration_s * sample_rate_hz)
}

/// Edges of the pass band and of the stop band, Hz.
fn band_hz(pulse: &Pulse, sample_rate_hz: f64, doppler_hz: f64) -> (f64, f64) {
    let pass_hz = 0.5 * occupied_hz(pulse) + doppler_hz;
    (pass_hz, 0.5 * sample_rate_hz)
}

/// Length of the impulse response from rejection and transition width, seconds (Kaiser 1974).
fn length_s(pulse: &Pulse, sample_rate_hz: f64, doppler_hz: f64) -> f64 {
    let (pass_hz, stop_hz) = band_hz(pulse, sample_rate_hz, doppler_hz);
    (STOP_BAND_DB - 7.95) / (2.285 * std::f64::consts::TAU * (stop_hz - pass_hz))
}

/// Impulse response of the filter as a function of time, without its scale.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Response {
    cut_hz: f64,
    /// Half the length of the response, seconds.
    half_s: f64,
    beta: f64,
}

impl Response {
    /// Value at `t_s` from the middle. Beyond the ends it is the continuation of the inner part.
    fn at(&self, t_s: f64) -> f64 {
        let edge = t_s / self.half_s;
        let inside = self.beta * self.beta * (1.0 - edge * edge);
        let window = (i0_of_square(inside) - 1.0) / (bessel_i0(self.beta) - 1.0);
        let pi_x = std::f64::consts::TAU * self.cut_hz * t_s;
        let sinc = if pi_x == 0.0 {
            1.0
        } else {
            libm::sin(pi_x) / pi_x
        };
        2.0 * self.cut_hz * sinc * window
    }
}

/// Inputs of [`Decimator::new`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FilterDesign {
    /// Pulse whose band the filter passes.
    pub pulse: Pulse,
    /// Sample rate after the filter, Hz.
    pub sample_rate_hz: f64,
    /// Pass band beside the band of the pulse, Hz.
    pub doppler_hz: f64,
    /// Number of dense samples per output sample.
    pub oversample: usize,
}

impl FilterDesign {
    /// Half the length of the impulse response, seconds.
    pub fn response_half_s(&self) -> f64 {
        0.5 * length_s(&self.pulse, self.sample_rate_hz, self.doppler_hz)
    }

    /// Number of taps of the filter.
    pub fn taps(&self) -> usize {
        let half = (self.response_half_s() * self.sample_rate_hz * self.oversample as f64).floor()
            as usize;
        2 * (half + END_POINTS / 2) + 1
    }

    /// Designs the filter.
    pub fn decimator(&self) -> Result<Decimator, FilterError> {
        let Self {
            pulse,
            sample_rate_hz,
            doppler_hz,
            oversample,
        } = self;
        Decimator::new(pulse, *sample_rate_hz, *doppler_hz, *oversample)
    }
}

/// Filter for one sample rate and density. It is designed once per plan.
#[derive(Clone, Debug, PartialEq)]
pub struct Decimator {
    oversample: usize,
    sample_rate_hz: f64,
    response: Response,
    /// Integral of the response.
    scale: f64,
    /// Taps of the filter: symmetric, odd number, sum 1.
    taps: Vec<f64>,
    /// Weights of the points next to the breaks of an echo.
    ends: EndWeights,
}

impl Decimator {
    /// Designs the filter. The pass band ends at max(B, 4/T)/2 + `doppler_hz`, and the stop band
    /// begins at half the sample rate. `oversample` is the number of dense samples per output
    /// sample.
    ///
    /// Returns [`FilterError::RateTooLow`] if the pass band exceeds 0.45 of the sample rate.
    pub fn new(
        pulse: &Pulse,
        sample_rate_hz: f64,
        doppler_hz: f64,
        oversample: usize,
    ) -> Result<Self, FilterError> {
        let (pass_hz, stop_hz) = band_hz(pulse, sample_rate_hz, doppler_hz);
        if pass_hz > 0.9 * stop_hz {
            return Err(FilterError::RateTooLow {
                sample_rate_hz,
                pass_hz,
                min_hz: pass_hz / 0.45,
            });
        }
        // Kaiser (1974): shape from rejection.
        let beta = 0.1102 * (STOP_BAND_DB - 8.7);
        let response = Response {
            cut_hz: 0.5 * (pass_hz + stop_hz),
            half_s: 0.5 * length_s(pulse, sample_rate_hz, doppler_hz),
            beta,
        };
        let dense_s = 1.0 / (sample_rate_hz * oversample as f64);
        // Of the pulse behind the filter.
        let flank_hz = flank_share(pulse, sample_rate_hz) * sample_rate_hz;
        let ends =
            EndWeights::new(std::f64::consts::TAU * (stop_hz + pass_hz + flank_hz) * dense_s);
        let inside = response.half_s / dense_s;
        let last = inside.floor();
        let corrections = ends.at(inside - last);
        let half = last as usize + END_POINTS / 2;
        let mut taps = vec![0.0; 2 * half + 1];
        for k in 0..=half {
            let from_last = last - k as f64;
            let inner = if from_last >= 0.0 { 1.0 } else { 0.0 };
            let place = from_last - FIRST_POINT;
            let corrected = corrections.get(place as usize).copied().unwrap_or(0.0);
            let tap = (inner + corrected) * response.at(k as f64 * dense_s);
            (taps[half - k], taps[half + k]) = (tap, tap);
        }
        // Unit gain at the centre frequency.
        let sum: f64 = taps.iter().sum();
        taps.iter_mut().for_each(|tap| *tap /= sum);
        Ok(Self {
            oversample,
            sample_rate_hz,
            response,
            scale: sum * dense_s,
            taps,
            ends,
        })
    }

    /// Weights of the points next to the breaks of an echo, in a sum that this filter follows.
    pub fn ends(&self) -> &EndWeights {
        &self.ends
    }

    /// Sample rate after the filter, Hz.
    pub(super) fn sample_rate_hz(&self) -> f64 {
        self.sample_rate_hz
    }

    /// Half the length of the impulse response as a function of time, seconds; beyond it, the
    /// response is zero.
    pub fn response_half_s(&self) -> f64 {
        self.response.half_s
    }

    /// Impulse response at `t_s`, per second.
    pub(super) fn response(&self, t_s: f64) -> f64 {
        if t_s.abs() >= self.response.half_s {
            return 0.0;
        }
        self.response.at(t_s) / self.scale
    }

    fn half(&self) -> usize {
        self.taps.len() / 2
    }

    /// Half the length of the impulse response, seconds.
    pub fn half_s(&self) -> f64 {
        self.half() as f64 / self.dense_rate_hz()
    }

    /// Rate of the dense samples, Hz.
    pub fn dense_rate_hz(&self) -> f64 {
        self.sample_rate_hz * self.oversample as f64
    }

    /// Time of the first dense sample for output that begins at `first_sample_s`: half a filter
    /// earlier.
    pub fn dense_first_s(&self, first_sample_s: f64) -> f64 {
        first_sample_s - self.half() as f64 / self.dense_rate_hz()
    }

    /// Number of dense samples for `count` output samples.
    pub fn dense_len(&self, count: usize) -> usize {
        match count {
            0 => 0,
            _ => (count - 1) * self.oversample + self.taps.len(),
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
        for (n, sample) in out.iter_mut().enumerate() {
            *sample = dot(&self.taps, &dense[n * self.oversample..]);
        }
    }

    /// Taps at the dense rate.
    pub(super) fn taps(&self) -> &[f64] {
        &self.taps
    }

    /// Filters at the dense rate without decimation. `dense` has one sample less than the filter has taps more than `out`; `out[0]` is the
    /// sample at the middle of the first taps.
    pub(super) fn apply_dense(&self, dense: &[Complex64], out: &mut [Complex64]) {
        assert_eq!(dense.len() + 1, out.len() + self.taps.len());
        for (n, sample) in out.iter_mut().enumerate() {
            *sample = dot(&self.taps, &dense[n..]);
        }
    }

    /// Gain at `offset_hz` from the centre frequency; real, since the delay is removed.
    pub fn gain(&self, offset_hz: f64) -> f64 {
        let half = self.half();
        let turn = std::f64::consts::TAU * offset_hz / self.dense_rate_hz();
        // Taps on either side of the middle one, by repeated rotation.
        let step = Complex64::cis(turn);
        let mut rotation = Complex64::ONE;
        let mut sum = self.taps[half];
        for k in 1..=half {
            rotation *= step;
            let before = self.taps[half - k];
            let after = self.taps.get(half + k).copied().unwrap_or(0.0);
            sum += (before + after) * rotation.re;
        }
        sum
    }
}

/// Sum of `taps[k] * x[k]` in four interleaved sums, which the compiler can vectorise.
fn dot(taps: &[f64], x: &[Complex64]) -> Complex64 {
    const WIDE: usize = 4;
    let x = &x[..taps.len()];
    let (mut re, mut im) = ([0.0; WIDE], [0.0; WIDE]);
    let (blocks, rest) = taps.as_chunks::<WIDE>();
    let (x_blocks, x_rest) = x.as_chunks::<WIDE>();
    for (tap, x) in blocks.iter().zip(x_blocks) {
        for j in 0..WIDE {
            re[j] += tap[j] * x[j].re;
            im[j] += tap[j] * x[j].im;
        }
    }
    let mut sum = Complex64::new(re.iter().sum(), im.iter().sum());
    for (tap, x) in rest.iter().zip(x_rest) {
        sum += x * tap;
    }
    sum
}

/// Modified Bessel function of the first kind, order 0. The power series ends within 40 terms for
/// the arguments here (below 12).
pub(super) fn bessel_i0(x: f64) -> f64 {
    i0_of_square(x * x)
}

/// [`bessel_i0`] of the square root of `square`, which may be negative.
fn i0_of_square(square: f64) -> f64 {
    let quarter = 0.25 * square;
    let (mut term, mut sum) = (1.0, 1.0);
    for k in 1..60 {
        term *= quarter / (k * k) as f64;
        sum += term;
    }
    sum
}

#[cfg(test)]
mod tests {
    use super::*;
    use echotank_core::pulse::PulseKind;

    const PULSE: Pulse = Pulse {
        kind: PulseKind::LfmUp,
        center_frequency_hz: 400e3,
        bandwidth_hz: 30e3,
        duration_s: 5e-3,
        taper: 0.0,
    };

    #[test]
    fn the_pass_band_is_flat_to_2e_4_and_the_stop_band_is_80_db_down() {
        for oversample in [2, 6, 24] {
            let filter = Decimator::new(&PULSE, 40e3, 500.0, oversample).expect("fits");
            for k in 0..=1000 {
                let pass = filter.gain(15.5e3 * k as f64 / 1000.0);
                assert!((pass - 1.0).abs() < 2e-4, "{oversample}: {pass}");
                // The range ends at half the dense rate, where the dense samples themselves alias.
                let stop_hz = 20e3 + (0.5 * filter.dense_rate_hz() - 20e3) * k as f64 / 1000.0;
                let stop_db = 20.0 * filter.gain(stop_hz).abs().log10();
                assert!(stop_db < -80.0, "{oversample}, {stop_hz} Hz: {stop_db} dB");
            }
        }
    }

    /// A pulse of 0.8 samples. With the step of the plain Kaiser window, the difference at the end
    /// of the filter would be 6e-7, for 6 and 64 points per sample.
    #[test]
    fn filters_of_two_densities_end_at_the_same_time() {
        let heard = |oversample: usize| {
            let filter = Decimator::new(&PULSE, 40e3, 500.0, oversample).expect("fits");
            let count = 81;
            let first_s = filter.dense_first_s(-40.3 / 40e3);
            let dense: Vec<_> = (0..filter.dense_len(count))
                .map(|k| first_s + k as f64 / filter.dense_rate_hz())
                .map(|t_s| Complex64::from(libm::exp(-0.5 * (t_s * 40e3 / 0.8).powi(2))))
                .collect();
            let mut out = vec![Complex64::ZERO; count];
            filter.apply(&dense, &mut out);
            out
        };
        let (coarse, fine) = (heard(6), heard(64));
        let off = coarse.iter().zip(&fine).map(|(c, f)| (c - f).norm());
        let off = off.fold(0.0, f64::max);
        assert!(off < 1e-7 * fine[40].norm(), "{off:e} of {}", fine[40]);
    }

    #[test]
    fn a_tone_passes_without_delay_and_with_the_filters_gain() {
        let filter = Decimator::new(&PULSE, 40e3, 500.0, 6).expect("fits");
        let (first_s, count) = (0.0123, 50);
        for offset_hz in [0.0, -7.3e3, 15e3, 17.7e3] {
            let tone =
                |t_s: f64| Complex64::from_polar(1.0, std::f64::consts::TAU * offset_hz * t_s);
            let dense: Vec<_> = (0..filter.dense_len(count))
                .map(|k| tone(filter.dense_first_s(first_s) + k as f64 / filter.dense_rate_hz()))
                .collect();
            let mut out = vec![Complex64::ZERO; count];
            filter.apply(&dense, &mut out);
            for (n, got) in out.iter().enumerate() {
                let want = tone(first_s + n as f64 / 40e3) * filter.gain(offset_hz);
                assert!((got - want).norm() < 1e-11, "{offset_hz} Hz: {got} {want}");
            }
        }
    }

    #[test]
    fn a_rate_too_low_for_the_pulse_is_refused_with_the_smallest_sufficient_rate() {
        let error = Decimator::new(&PULSE, 32e3, 500.0, 6).expect_err("too low");
        let FilterError::RateTooLow { min_hz, .. } = error;
        assert!(Decimator::new(&PULSE, min_hz * 1.001, 500.0, 6).is_ok());
        assert!((min_hz - 15.5e3 / 0.45).abs() < 1e-6);
    }

    #[test]
    fn a_short_pulse_occupies_four_over_its_length() {
        let ping = Pulse {
            duration_s: 1e-4,
            bandwidth_hz: 0.0,
            kind: PulseKind::Cw,
            ..PULSE
        };
        assert_eq!(occupied_hz(&ping), 40e3);
        assert_eq!(occupied_hz(&PULSE), 30e3);
        assert_eq!(oversample(&PULSE, 40e3, Synthesis::Reference), 24);
        // A narrow pulse in a wide receiver needs the same density as a wide pulse.
        assert_eq!(oversample(&PULSE, 40e3, Synthesis::Direct), 4);
        assert_eq!(oversample(&ping, 1e6, Synthesis::Direct), 3);
    }
}
