//! The matched filter: correlation of complex baseband rows with the transmitted pulse.
//!
//! ```text
//! y[k] = sum_n x[k+n] w[n] conj(a[n]) / sum_n w[n] |a[n]|^2,    n over the pulse's samples
//! ```
//!
//! An echo of unit amplitude whose leading edge lies on sample k has a peak of magnitude 1 there. Sample k of y is a leading edge at the
//! time of sample k of x.
//!
//! The transform length holds the longest row plus the longest pulse, so that nothing wraps around. An echo cut off by the end of the row
//! gives the received part of its peak.

use std::sync::Arc;

use echotank_fft::{Fft, Planned};
use num_complex::{Complex, Complex64};

use super::RowLimits;
use super::weights::Taper;
use echotank_config::spec::Shading;
use echotank_core::pulse::Pulse;
use echotank_core::simd::widest;

/// Transform lengths are multiples of this, so that the fan's tiles divide them.
const LENGTH_STEP: usize = 16;
/// A pulse that ends within this fraction of a sample after a sample includes that sample.
const EDGE_SAMPLES: f64 = 1e-9;

/// Number of samples that a pulse of `duration_s` covers; the first is at time 0 and the end is included.
pub(super) fn pulse_samples(duration_s: f64, sample_rate_hz: f64) -> usize {
    (duration_s * sample_rate_hz + EDGE_SAMPLES).floor() as usize + 1
}

/// Smallest multiple of [`LENGTH_STEP`] at or above `min_length` without a prime factor above 5, for a fast transform.
fn fft_length(min_length: usize) -> usize {
    let smooth = |mut n: usize| {
        for p in [2, 3, 5] {
            while n.is_multiple_of(p) {
                n /= p;
            }
        }
        n == 1
    };
    let mut length = min_length.div_ceil(LENGTH_STEP).max(1) * LENGTH_STEP;
    while !smooth(length) {
        length += LENGTH_STEP;
    }
    length
}

/// Pulse spectrum and transforms that all rows of one array share, in f32 or f64.
pub(super) struct Correlator<T: Planned = f64> {
    limits: RowLimits,
    window: Shading,
    pulse: Pulse,
    forward: Arc<dyn Fft<T>>,
    inverse: Arc<dyn Fft<T>>,
    /// Conjugate transform of the replica, divided by its energy and the transform length.
    spectrum: Vec<Complex<T>>,
    scratch: Vec<Complex<T>>,
}

impl<T: Planned> Correlator<T> {
    /// `guard` zeros follow row and pulse, for formers that shift rows.
    pub(super) fn new(pulse: &Pulse, limits: RowLimits, guard: usize, window: Shading) -> Self {
        assert!(
            limits.samples > 0 && limits.sample_rate_hz > 0.0,
            "a former needs rows to work on: {limits:?}"
        );
        let longest_pulse = pulse_samples(limits.pulse_s, limits.sample_rate_hz);
        let length = fft_length(limits.samples + longest_pulse + guard);
        let forward = T::plan_forward(length);
        let inverse = T::plan_inverse(length);
        let scratch_length = forward
            .get_inplace_scratch_len()
            .max(inverse.get_inplace_scratch_len());
        let mut correlator = Self {
            limits,
            window,
            pulse: *pulse,
            forward,
            inverse,
            spectrum: vec![zero(); length],
            scratch: vec![zero(); scratch_length],
        };
        correlator.make_spectrum();
        correlator
    }

    pub(super) fn set_pulse(&mut self, pulse: &Pulse) {
        if *pulse != self.pulse {
            self.pulse = *pulse;
            self.make_spectrum();
        }
    }

    fn make_spectrum(&mut self) {
        let (rate_hz, pulse) = (self.limits.sample_rate_hz, &self.pulse);
        assert!(
            pulse.duration_s <= self.limits.pulse_s,
            "pulse of {} s, sized for {} s",
            pulse.duration_s,
            self.limits.pulse_s
        );
        let samples = pulse_samples(pulse.duration_s, rate_hz);
        self.spectrum.fill(zero());
        let taper = Taper::new(self.window);
        // Each sample represents an interval, and the weighting is even about the middle of the pulse; this keeps the group delay exact.
        let interval_s = 1.0 / rate_hz;
        let mut energy = 0.0;
        for (n, out) in self.spectrum[..samples].iter_mut().enumerate() {
            // The last sample may lie past the end by the rounding that `pulse_samples` accepts.
            let a = pulse.envelope((n as f64 / rate_hz).min(pulse.duration_s));
            let middle_s = n as f64 * interval_s - 0.5 * pulse.duration_s;
            let weight = taper.at(middle_s / (pulse.duration_s + interval_s));
            *out = rounded(a * weight);
            energy += weight * a.norm_sqr();
        }
        self.forward
            .process_with_scratch(&mut self.spectrum, &mut self.scratch);
        let scale = rounded::<T>(Complex64::from(1.0 / (energy * self.spectrum.len() as f64)));
        for s in &mut self.spectrum {
            *s = s.conj() * scale.re;
        }
    }

    pub(super) fn pulse(&self) -> &Pulse {
        &self.pulse
    }
    pub(super) fn limits(&self) -> &RowLimits {
        &self.limits
    }
    pub(super) fn length(&self) -> usize {
        self.spectrum.len()
    }
    /// Buffer for [`Correlator::forward`] and [`Correlator::inverse`].
    pub(super) fn make_scratch(&self) -> Vec<Complex<T>> {
        self.scratch.clone()
    }

    /// Replaces a row followed by zeros in `buffer` by the spectrum of the correlated row.
    pub(super) fn forward(&self, buffer: &mut [Complex<T>], scratch: &mut [Complex<T>]) {
        self.forward.process_with_scratch(buffer, scratch);
        widest(
            #[inline(always)]
            || {
                for (x, s) in buffer.iter_mut().zip(&self.spectrum) {
                    *x = *x * *s;
                }
            },
        );
    }

    /// Replaces a correlated spectrum by the correlated row, in the first samples of `buffer`.
    pub(super) fn inverse(&self, buffer: &mut [Complex<T>], scratch: &mut [Complex<T>]) {
        self.inverse.process_with_scratch(buffer, scratch);
    }
}

fn zero<T: Planned>() -> Complex<T> {
    Complex::new(T::zero(), T::zero())
}

fn rounded<T: Planned>(x: Complex64) -> Complex<T> {
    let part = |x: f64| T::from_f64(x).expect("f32 and f64 hold any f64");
    Complex::new(part(x.re), part(x.im))
}

/// A matched filter with its own buffers.
pub struct MatchedFilter {
    correlator: Correlator,
    buffer: Vec<Complex64>,
    scratch: Vec<Complex64>,
}

impl MatchedFilter {
    /// `window` weights the replica along the pulse. For an LFM this is a weighting over frequency (lower side lobes, wider peak).
    ///
    /// Panics if `limits` is empty or the pulse is longer than `limits.pulse_s`; a checked configuration prevents both.
    pub fn new(pulse: &Pulse, limits: RowLimits, window: Shading) -> Self {
        let correlator = Correlator::new(pulse, limits, 0, window);
        Self {
            buffer: vec![Complex64::ZERO; correlator.length()],
            scratch: correlator.make_scratch(),
            correlator,
        }
    }

    /// Sets the pulse to correlate with; a new pulse costs one transform. Panics if it exceeds `limits.pulse_s`.
    pub fn set_pulse(&mut self, pulse: &Pulse) {
        self.correlator.set_pulse(pulse);
    }

    /// Correlates a row in place: `row[k]` becomes the echo whose leading edge is at sample k. Panics if the row exceeds `limits.samples`.
    pub fn apply(&mut self, row: &mut [Complex64]) {
        assert!(
            row.len() <= self.correlator.limits().samples,
            "row of {} samples, sized for {}",
            row.len(),
            self.correlator.limits().samples
        );
        let (head, tail) = self.buffer.split_at_mut(row.len());
        head.copy_from_slice(row);
        tail.fill(Complex64::ZERO);
        self.correlator.forward(&mut self.buffer, &mut self.scratch);
        self.correlator.inverse(&mut self.buffer, &mut self.scratch);
        row.copy_from_slice(&self.buffer[..row.len()]);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::beam::test_rig::{half_power, limits, pulse};
    use echotank_core::pulse::PulseKind;
    use rand_chacha::ChaCha12Rng;
    use rand_chacha::rand_core::{Rng, SeedableRng};
    use std::f64::consts::TAU;

    fn filter(pulse: &Pulse, rate_hz: f64, samples: usize, window: Shading) -> MatchedFilter {
        MatchedFilter::new(pulse, limits(rate_hz, samples, pulse.duration_s), window)
    }

    fn echo(pulse: &Pulse, rate_hz: f64, samples: usize, leading_edge_s: f64) -> Vec<Complex64> {
        (0..samples)
            .map(|k| pulse.envelope(k as f64 / rate_hz - leading_edge_s))
            .collect()
    }

    /// Magnitudes around an echo's peak, and the index of the peak.
    fn compressed(pulse: &Pulse, rate_hz: f64, window: Shading) -> (Vec<f64>, usize) {
        let n = pulse_samples(pulse.duration_s, rate_hz);
        let edge = n;
        let mut row = echo(pulse, rate_hz, 3 * n, edge as f64 / rate_hz);
        filter(pulse, rate_hz, 3 * n, window).apply(&mut row);
        (row.iter().map(|y| y.norm()).collect(), edge)
    }

    /// Full -3 dB width in seconds.
    fn width_s(level: &[f64], peak: usize, rate_hz: f64) -> f64 {
        (half_power(level, peak, 1) + half_power(level, peak, -1)) / rate_hz
    }

    /// Level of the first local maximum beyond the first minimum, dB relative to the peak.
    fn first_side_lobe_db(level: &[f64], peak: usize) -> f64 {
        let mut k = peak;
        while level[k + 1] < level[k] {
            k += 1;
        }
        while level[k + 1] > level[k] {
            k += 1;
        }
        20.0 * (level[k] / level[peak]).log10()
    }

    #[test]
    fn equals_the_correlation_sum_and_peaks_at_one_on_the_leading_edge() {
        let rate_hz = 40e3;
        for pulse in [
            pulse(PulseKind::LfmUp, 30e3, 5e-3, 0.0),
            pulse(PulseKind::LfmDown, 30e3, 3.33e-3, 0.0),
            pulse(PulseKind::Cw, 0.0, 1e-3, 0.3),
        ] {
            let samples = 700;
            let edge = 311;
            let phase = Complex64::from_polar(1.0, 1.234);
            let mut row = echo(&pulse, rate_hz, samples, edge as f64 / rate_hz);
            row.iter_mut().for_each(|x| *x *= phase);
            row[5] += 0.3; // an unrelated echo
            let x = row.clone();
            let mut mf = filter(&pulse, rate_hz, samples, Shading::Uniform);
            mf.apply(&mut row);
            let n = pulse_samples(pulse.duration_s, rate_hz);
            let a: Vec<_> = (0..n).map(|i| pulse.envelope(i as f64 / rate_hz)).collect();
            let energy: f64 = a.iter().map(|a| a.norm_sqr()).sum();
            let mut worst = 0.0_f64;
            for k in 0..samples {
                let want: Complex64 = (0..n.min(samples - k))
                    .map(|i| x[k + i] * a[i].conj())
                    .sum::<Complex64>()
                    / energy;
                worst = worst.max((row[k] - want).norm());
            }
            assert!(worst < 1e-13, "{:?}: off by {worst:.2e}", pulse.kind);
            assert!(
                (row[edge] - phase).norm() < 1e-12,
                "{:?}: peak {} want {phase}",
                pulse.kind,
                row[edge]
            );
        }
    }

    #[test]
    fn compressed_lfm_is_0p886_over_b_wide_with_its_first_side_lobe_at_minus_13p3_db() {
        for (kind, bandwidth_hz, duration_s) in [
            (PulseKind::LfmUp, 100e3, 1e-3),
            (PulseKind::LfmDown, 30e3, 5e-3),
            (PulseKind::LfmUp, 60e3, 5e-3),
        ] {
            let rate_hz = 32.0 * bandwidth_hz;
            let (level, peak) = compressed(
                &pulse(kind, bandwidth_hz, duration_s, 0.0),
                rate_hz,
                Shading::Uniform,
            );
            let width = width_s(&level, peak, rate_hz) * bandwidth_hz;
            let lobe_db = first_side_lobe_db(&level, peak);
            println!(
                "{kind:?} BT {}: width {width:.4}/B (0.886), first side lobe {lobe_db:.2} dB (-13.3)",
                bandwidth_hz * duration_s
            );
            assert!((width / 0.886 - 1.0).abs() < 0.01, "width {width:.4} / B");
            assert!((lobe_db + 13.3).abs() < 0.2, "side lobe {lobe_db:.2} dB");
        }
    }

    /// The correlation of a CW pulse is the triangle 1 - |t|/T.
    #[test]
    fn compressed_cw_is_a_triangle_of_twice_its_length() {
        let (rate_hz, duration_s) = (1e6, 1e-3);
        let (level, peak) = compressed(
            &pulse(PulseKind::Cw, 0.0, duration_s, 0.0),
            rate_hz,
            Shading::Uniform,
        );
        let worst = (0..level.len()).fold(0.0_f64, |worst, k| {
            let t = (k as f64 - peak as f64) / rate_hz;
            worst.max((level[k] - (1.0 - t.abs() / duration_s).max(0.0)).abs())
        });
        assert!(
            worst < 1.5e-3,
            "off by {worst:.2e}: one sample in 1001 is 1e-3"
        );
    }

    fn gaussian_pair(rng: &mut ChaCha12Rng) -> Complex64 {
        let uniform = |r: u64| (r as f64 + 0.5) / 2.0_f64.powi(64);
        let radius = (-uniform(rng.next_u64()).ln()).sqrt();
        Complex64::from_polar(radius, TAU * uniform(rng.next_u64()))
    }

    /// Noise of density N_0 has power N_0 B in the band and N_0/T after the filter, while the echo keeps its level.
    #[test]
    fn signal_to_noise_gain_is_bt_for_noise_in_the_band() {
        let mut rng = ChaCha12Rng::seed_from_u64(7);
        for (bandwidth_hz, duration_s) in [(30e3, 5e-3), (100e3, 1e-3)] {
            let rate_hz = 1.25 * bandwidth_hz;
            let samples = 200_000;
            let pulse = pulse(PulseKind::LfmUp, bandwidth_hz, duration_s, 0.0);
            let mut row: Vec<_> = (0..samples).map(|_| gaussian_pair(&mut rng)).collect();
            let power =
                |r: &[Complex64]| r.iter().map(|x| x.norm_sqr()).sum::<f64>() / r.len() as f64;
            let in_band = power(&row) * bandwidth_hz / rate_hz;
            filter(&pulse, rate_hz, samples, Shading::Uniform).apply(&mut row);
            let whole = samples - pulse_samples(duration_s, rate_hz);
            let gain = in_band / power(&row[..whole]);
            let error_db = 10.0 * (gain / (bandwidth_hz * duration_s)).log10();
            println!(
                "BT {}: gain {gain:.1}, off by {error_db:.3} dB",
                bandwidth_hz * duration_s
            );
            // 160 000 independent cells give 0.011 dB standard deviation; the 188th sample of the pulse contributes 0.02 dB.
            assert!(error_db.abs() < 0.1, "off by {error_db:.3} dB");
        }
    }

    /// -3 dB width (in 1/B) and largest side lobe of a compressed LFM, which is the transform of its weighting.
    #[test]
    fn weightings_give_the_widths_and_side_lobes_of_their_transforms() {
        let (bandwidth_hz, duration_s) = (60e3, 20e-3);
        let rate_hz = 16.0 * bandwidth_hz;
        for (window, width_want, lobe_want_db) in [
            (Shading::Uniform, 0.886, -13.26),
            (Shading::Hann, 1.441, -31.5),
            (Shading::Hamming, 1.303, -42.7),
            (Shading::Taylor { side_lobe_db: 35.0 }, 1.19, -35.0),
            // Half power and first side lobe of sinh(s)/s, s^2 = beta^2 - (pi u)^2.
            (Shading::Kaiser { beta: 6.0 }, 1.402, -43.8),
        ] {
            let pulse = pulse(PulseKind::LfmUp, bandwidth_hz, duration_s, 0.0);
            let (level, peak) = compressed(&pulse, rate_hz, window);
            assert!(
                (level[peak] - 1.0).abs() < 1e-9,
                "{window:?}: {}",
                level[peak]
            );
            let width = width_s(&level, peak, rate_hz) * bandwidth_hz;
            let lobe_db = largest_side_lobe_db(&level, peak);
            println!(
                "{window:?}: width {width:.3}/B ({width_want}), {lobe_db:.2} dB ({lobe_want_db})"
            );
            assert!(
                (width / width_want - 1.0).abs() < 0.02,
                "{window:?}: {width:.4}/B"
            );
            // At BT = 1200, Fresnel ripples at the sweep's ends raise the lowest lobes.
            assert!(
                (lobe_db - lobe_want_db).abs() < 1.2,
                "{window:?}: {lobe_db:.2} dB"
            );
        }
    }

    fn largest_side_lobe_db(level: &[f64], peak: usize) -> f64 {
        let mut k = peak;
        while level[k + 1] < level[k] {
            k += 1;
        }
        let most = level[k..].iter().copied().fold(0.0, f64::max);
        20.0 * (most / level[peak]).log10()
    }

    /// Vertex of a parabola through the largest sample and its neighbours, in samples.
    fn top(level: &[f64]) -> f64 {
        let k = (1..level.len() - 1).fold(1, |b, k| if level[k] > level[b] { k } else { b });
        let (a, b, c) = (level[k - 1], level[k], level[k + 1]);
        k as f64 + 0.5 * (a - c) / (a - 2.0 * b + c)
    }

    /// Pulses with a fractional number of samples and echoes between samples: the peak lies on the leading edge.
    #[test]
    fn group_delay_is_exact_for_every_weighting_and_any_length_of_pulse() {
        let rate_hz = 400e3;
        for window in [
            Shading::Uniform,
            Shading::Hann,
            Shading::Taylor { side_lobe_db: 30.0 },
        ] {
            for duration_s in [5e-3, 3.333_21e-3] {
                let pulse = pulse(PulseKind::LfmUp, 30e3, duration_s, 0.2);
                let edge = 2100.37;
                let mut row = echo(&pulse, rate_hz, 6000, edge / rate_hz);
                filter(&pulse, rate_hz, 6000, window).apply(&mut row);
                let level: Vec<_> = row.iter().map(|y| y.norm()).collect();
                let got = top(&level);
                assert!(
                    (got - edge).abs() < 0.02,
                    "{window:?}: {got:.3} want {edge}"
                );
            }
        }
    }

    /// Echo stretched by eta about its leading edge: the peak moves by -(eta - 1) f_end T / (+-B).
    #[test]
    fn range_doppler_coupling_is_its_closed_form_within_1_percent_to_5p2_m_per_s() {
        let (rate_hz, samples) = (2e6, 40_000);
        for kind in [PulseKind::LfmUp, PulseKind::LfmDown] {
            let pulse = pulse(kind, 30e3, 5e-3, 0.0);
            let sweep_hz = pulse.sweep_hz_per_s() * pulse.duration_s;
            let end_hz = pulse.center_frequency_hz + 0.5 * sweep_hz;
            let mut filter = filter(&pulse, rate_hz, samples, Shading::Uniform);
            for speed in [-5.2, -1.0, 2.6, 5.2] {
                let (c, edge_s) = (1500.0, 7e-3);
                let eta = (c + speed) / (c - speed);
                let mut row: Vec<_> = (0..samples)
                    .map(|k| {
                        let t = k as f64 / rate_hz - edge_s;
                        let cycles = pulse.center_frequency_hz * (eta - 1.0) * t;
                        pulse.envelope(eta * t) * Complex64::from_polar(1.0, TAU * cycles.fract())
                    })
                    .collect();
                filter.apply(&mut row);
                let level: Vec<_> = row.iter().map(|y| y.norm()).collect();
                let got_s = top(&level) / rate_hz - edge_s;
                let want_s = -(eta - 1.0) * end_hz * pulse.duration_s / sweep_hz;
                println!(
                    "{kind:?} {speed} m/s: {:.3} us, closed form {:.3}",
                    got_s * 1e6,
                    want_s * 1e6
                );
                assert!(
                    (got_s / want_s - 1.0).abs() < 0.01,
                    "{got_s:e} want {want_s:e}"
                );
            }
        }
    }

    #[test]
    fn a_changed_pulse_gives_bit_identical_results_to_a_new_filter() {
        let rate_hz = 40e3;
        let limits = limits(rate_hz, 500, 6e-3);
        let first = pulse(PulseKind::LfmUp, 30e3, 6e-3, 0.0);
        let second = pulse(PulseKind::LfmDown, 20e3, 2e-3, 0.0);
        let row = echo(&second, rate_hz, 400, 0.0031);
        let mut changed = MatchedFilter::new(&first, limits, Shading::Uniform);
        changed.apply(&mut row.clone());
        changed.set_pulse(&second);
        let (mut a, mut b) = (row.clone(), row);
        changed.apply(&mut a);
        MatchedFilter::new(&second, limits, Shading::Uniform).apply(&mut b);
        assert_eq!(a, b);
    }

    #[test]
    fn nothing_wraps_around_from_either_end_of_the_row() {
        let rate_hz = 40e3;
        let pulse = pulse(PulseKind::LfmUp, 30e3, 5e-3, 0.0);
        let samples = 1000;
        let mut row = vec![Complex64::ZERO; samples];
        row[..150].fill(Complex64::ONE); // the tail of an echo that began before the record
        filter(&pulse, rate_hz, samples, Shading::Uniform).apply(&mut row);
        let far = row[150..].iter().fold(0.0_f64, |m, y| m.max(y.norm()));
        assert!(far < 1e-13, "{far:.2e} without energy");
    }

    #[test]
    fn transform_lengths_have_small_factors_and_little_excess() {
        for min_length in [1, 17, 1000, 12_345, 40_000, 65_537] {
            let length = fft_length(min_length);
            assert!(
                length >= min_length && length as f64 <= 1.1 * min_length as f64 + 16.0,
                "{min_length} -> {length}"
            );
            assert_eq!(length % LENGTH_STEP, 0);
        }
    }
}
