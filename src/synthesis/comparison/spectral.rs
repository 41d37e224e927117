//! Synthesis method `spectral` of Meng et al. 2023 (Eqs. 18 and 21): a sum over scatterers at every frequency of a grid, and one
//! inverse FFT.
//!
//! ```text
//! Y(f) = sum_m A_m exp(-j 2pi f tau_m) S(f) H(f),   f = f_c + k Df,   |k Df| < f_s/2
//! ```
//!
//! tau is the delay of the plan's path model (Eq. 18), or that delay with the frequency ratios of both legs (Eq. 21, `doppler =
//! "paper-eq21"`). S is the spectrum of the pulse and H the gain of the receiver filter. The series repeats every 1/Df, so a step
//! above 1/(record length) adds late echoes to early ones. All arithmetic is in f64. Not modelled: a stretch of the pulse, because
//! all echoes share S. Without a receiver filter the pulse is limited to the sampled band.

use std::sync::Arc;

use echotank_fft::{Fft, Planned};
use num_complex::Complex64;

use crate::array::quadrature::rule;
use crate::arrivals::{ArrivalChunk, ArrivalSink};
use echotank_core::ping::PingPlan;
use echotank_core::pulse::Pulse;

use crate::array::direct::add_tone;
use crate::array::filter::{Decimator, occupied_hz};

/// Frequency grid of one sonar, with the values of S H.
pub struct Spectrum {
    rate_hz: f64,
    step_hz: f64,
    pulse: Option<Pulse>,
    /// H, or 1 without a filter. Bin k is (k - bins/2) steps from the centre frequency.
    gain: Vec<f64>,
    /// S H at each bin.
    shaped: Vec<Complex64>,
    inverse: Arc<dyn Fft<f64>>,
}

/// Bins of one thread.
#[derive(Clone, Debug, Default)]
pub struct Bins {
    sum: Vec<Complex64>,
    turned: Vec<Complex64>,
    scratch: Vec<Complex64>,
}

impl Spectrum {
    /// Grid for records of up to `record_s` seconds, including pulse and filter tails. `step_hz` sets the step of the grid; a step
    /// above 1/`record_s` wraps late echoes. `None` selects the largest step of at most 1/`record_s` with a fast transform. The
    /// step is rounded, so that the sampled band has a whole number of steps.
    pub fn new(
        rate_hz: f64,
        record_s: f64,
        step_hz: Option<f64>,
        filter: Option<&Decimator>,
    ) -> Self {
        let bins = match step_hz {
            Some(step_hz) => (rate_hz / step_hz).round().max(1.0) as usize,
            None => quick_len((rate_hz * record_s).ceil().max(1.0) as usize),
        };
        let step_hz = rate_hz / bins as f64;
        let gain = (0..bins)
            .map(|k| filter.map_or(1.0, |f| f.gain(offset(k, bins) * step_hz)))
            .collect();
        Self {
            rate_hz,
            step_hz,
            pulse: None,
            gain,
            shaped: vec![Complex64::ZERO; bins],
            inverse: f64::plan_inverse(bins),
        }
    }

    /// Number of bins of the frequency grid.
    pub fn bins(&self) -> usize {
        self.gain.len()
    }

    /// Step of the frequency grid, hertz.
    pub fn step_hz(&self) -> f64 {
        self.step_hz
    }

    /// Computes S H of the plan's pulse unless it exists.
    pub fn prepare(&mut self, plan: &PingPlan) {
        if self.pulse == Some(plan.pulse) {
            return;
        }
        self.pulse = Some(plan.pulse);
        let pulse = &plan.pulse;
        let flank_s = 0.5 * pulse.taper * pulse.duration_s;
        let breaks_s = [0.0, flank_s, pulse.duration_s - flank_s, pulse.duration_s];
        // Panels have one oscillation of the pulse and of the highest bin.
        let panel_s = 1.0 / occupied_hz(pulse).max(self.rate_hz);
        self.shaped.fill(Complex64::ZERO);
        let lowest_hz = offset(0, self.bins()) * self.step_hz;
        for ends_s in breaks_s.windows(2) {
            let panels = ((ends_s[1] - ends_s[0]) / panel_s).ceil() as usize;
            let length_s = (ends_s[1] - ends_s[0]) / panels as f64;
            for panel in 0..panels {
                for node in rule(panel as f64, panel as f64 + 1.0) {
                    let t_s = ends_s[0] + node.at * length_s;
                    add_tone(
                        -lowest_hz * t_s,
                        -self.step_hz * t_s,
                        pulse.envelope(t_s) * (node.weight * length_s),
                        &mut self.shaped,
                    );
                }
            }
        }
        for (shaped, gain) in self.shaped.iter_mut().zip(&self.gain) {
            *shaped *= gain;
        }
    }
}

/// Number of steps of bin `k` from the centre frequency.
fn offset(k: usize, bins: usize) -> f64 {
    k as f64 - (bins / 2) as f64
}

/// Smallest length of at least `least` without a prime factor above 5.
fn quick_len(least: usize) -> usize {
    (least..)
        .find(|&n| {
            let mut rest = n;
            for prime in [2, 3, 5] {
                while rest % prime == 0 {
                    rest /= prime;
                }
            }
            rest == 1
        })
        .unwrap_or(least)
}

/// Sink that sums the echoes of one element on the grid.
pub struct Spectral<'a> {
    spectrum: &'a Spectrum,
    bins: &'a mut Bins,
    carrier_hz: f64,
    first_sample_s: f64,
}

impl<'a> Spectral<'a> {
    /// `first_sample_s` is the time of the first sample of [`Self::finish`]. [`Spectrum::prepare`] must have been called for this
    /// plan's pulse.
    pub fn new(
        plan: &PingPlan,
        spectrum: &'a Spectrum,
        first_sample_s: f64,
        bins: &'a mut Bins,
    ) -> Self {
        bins.sum.clear();
        bins.sum.resize(spectrum.bins(), Complex64::ZERO);
        Self {
            spectrum,
            bins,
            carrier_hz: plan.pulse.center_frequency_hz,
            first_sample_s,
        }
    }

    /// Multiplies by S H and transforms to time. Overwrites `out`. Samples beyond 1/Df repeat the previous period.
    pub fn finish(self, out: &mut [Complex64]) {
        let Self { spectrum, bins, .. } = self;
        let count = spectrum.bins();
        let Bins {
            sum,
            turned,
            scratch,
        } = bins;
        turned.resize(count, Complex64::ZERO);
        scratch.resize(spectrum.inverse.get_inplace_scratch_len(), Complex64::ZERO);
        // The transform requires the centre frequency first.
        for (k, (y, shaped)) in sum.iter().zip(&spectrum.shaped).enumerate() {
            turned[(k + count - count / 2) % count] = y * shaped * spectrum.step_hz;
        }
        spectrum.inverse.process_with_scratch(turned, scratch);
        for (k, sample) in out.iter_mut().enumerate() {
            *sample = turned[k % count];
        }
    }
}

impl ArrivalSink for Spectral<'_> {
    fn accept(&mut self, chunk: &ArrivalChunk) {
        let step_hz = self.spectrum.step_hz;
        let lowest_hz = offset(0, self.spectrum.bins()) * step_hz;
        for i in 0..chunk.len {
            let delay_s = chunk.delay_s[i];
            let carrier = self.carrier_hz * delay_s;
            let since_s = delay_s - self.first_sample_s;
            add_tone(
                -(carrier - carrier.round_ties_even()) - lowest_hz * since_s,
                -step_hz * since_s,
                chunk.amplitude[i],
                &mut self.bins.sum,
            );
        }
    }
}
