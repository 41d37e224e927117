//! A transducer response as a filter of element samples.
//!
//! The response over the pass band is continued smoothly beyond it, and its impulse response is cut where the error in the pass band falls below
//! [`ERROR`].

use num_complex::Complex64;

use super::waveform::turn;
use echotank_core::instrument::TransducerResponse;
use echotank_core::simd::widest;

/// Largest error in the pass band, relative to the largest response there: 0.02 dB.
pub(super) const ERROR: f64 = 2e-3;
/// Largest number of taps.
const MAX_TAPS: usize = 512;
/// Number of frequencies of the design.
const FREQUENCIES: usize = 4096;
/// Number of frequencies at which the error is measured.
const MEASURED: usize = 129;
/// Samples computed together. They fit the first-level cache.
const BLOCK: usize = 512;

/// Filter whose output sample k is the sum of `taps[i] * x[k - first - i]`.
pub(super) struct ResponseFilter {
    first: isize,
    taps: Vec<Complex64>,
}

impl ResponseFilter {
    /// Designs the filter for complex envelopes about `carrier_hz`. `pass_hz`: edge of the pass band from the carrier. `None` if the response rings for
    /// more than [`MAX_TAPS`] samples.
    pub(super) fn design(
        response: &TransducerResponse,
        carrier_hz: f64,
        pass_hz: f64,
        rate_hz: f64,
    ) -> Option<Self> {
        let pass_hz = pass_hz.min(0.45 * rate_hz);
        let lowest_hz = 1e-3 * carrier_hz;
        let at = |offset_hz: f64| response.at((carrier_hz + offset_hz).max(lowest_hz));
        // Periodic with the sample rate: between the edges of the pass band one end changes into the other.
        let periodic = (0..FREQUENCIES).map(|k| {
            let offset_hz = k as f64 * rate_hz / FREQUENCIES as f64;
            let beyond = (offset_hz - pass_hz) / (rate_hz - 2.0 * pass_hz);
            let share = 0.5 * (1.0 - libm::cos(std::f64::consts::PI * beyond.clamp(0.0, 1.0)));
            at(offset_hz) * (1.0 - share) + at(offset_hz - rate_hz) * share
        });
        let periodic: Vec<Complex64> = periodic.collect();
        let turns: Vec<Complex64> = (0..FREQUENCIES)
            .map(|k| turn(k as f64 / FREQUENCIES as f64))
            .collect();
        let tap = |n: isize| {
            let step = n.rem_euclid(FREQUENCIES as isize) as usize;
            let terms = periodic.iter().enumerate();
            let sum: Complex64 = terms.map(|(k, h)| h * turns[k * step % FREQUENCIES]).sum();
            sum / FREQUENCIES as f64
        };
        let offsets_hz: Vec<f64> = (0..MEASURED)
            .map(|k| pass_hz * (2.0 * k as f64 / (MEASURED - 1) as f64 - 1.0))
            .collect();
        let mut errors: Vec<Complex64> =
            offsets_hz.iter().map(|&offset_hz| at(offset_hz)).collect();
        let largest = |values: &[Complex64]| values.iter().map(|v| v.norm()).fold(0.0, f64::max);
        let allowed = ERROR * largest(&errors);
        let mut remove = |n: isize, tap: Complex64| {
            for (error, offset_hz) in errors.iter_mut().zip(&offsets_hz) {
                *error -= tap * turn(-offset_hz / rate_hz * n as f64);
            }
            largest(&errors)
        };
        let mut taps = std::collections::VecDeque::from([tap(0)]);
        let mut first = 0;
        let mut left = remove(0, taps[0]);
        let (mut before, mut after) = (tap(-1), tap(1));
        while left > allowed {
            if taps.len() == MAX_TAPS {
                return None;
            }
            if before.norm_sqr() > after.norm_sqr() {
                first -= 1;
                taps.push_front(before);
                left = remove(first, before);
                before = tap(first - 1);
            } else {
                let last = first + taps.len() as isize;
                taps.push_back(after);
                left = remove(last, after);
                after = tap(last + 1);
            }
        }
        Some(Self {
            first,
            taps: taps.into(),
        })
    }

    /// Number of later samples on which a sample depends.
    pub(super) fn lookahead(&self) -> usize {
        usize::try_from(-self.first).unwrap_or(0)
    }

    /// Number of taps.
    pub(super) fn taps(&self) -> usize {
        self.taps.len()
    }

    /// Filters `before` into `out`, which has the same length. Samples beyond the ends are zero.
    pub(super) fn apply(&self, before: &[Complex64], out: &mut [Complex64]) {
        let count = before.len() as isize;
        for (block, out) in out.chunks_mut(BLOCK).enumerate() {
            out.fill(Complex64::ZERO);
            let start = (block * BLOCK) as isize;
            for (delay, &tap) in (self.first..).zip(&self.taps) {
                // Outputs whose input exists.
                let from = (delay - start).clamp(0, out.len() as isize);
                let to = (count + delay - start).clamp(from, out.len() as isize);
                let input = (start + from - delay).clamp(0, count) as usize;
                let (from, to) = (from as usize, to as usize);
                let input = &before[input..input + to - from];
                let out = &mut out[from..to];
                widest(
                    #[inline(always)]
                    move || {
                        for (y, x) in out.iter_mut().zip(input) {
                            y.re += tap.re * x.re - tap.im * x.im;
                            y.im += tap.re * x.im + tap.im * x.re;
                        }
                    },
                );
            }
        }
    }

    /// Response at an offset from the carrier, hertz.
    #[cfg(test)]
    pub(super) fn gain(&self, offset_hz: f64, rate_hz: f64) -> Complex64 {
        let taps = (self.first..).zip(&self.taps);
        taps.map(|(n, tap)| tap * turn(-offset_hz / rate_hz * n as f64))
            .sum()
    }
}
