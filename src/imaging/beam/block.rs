//! The matched filter on a stream of blocks: the same samples as [`MatchedFilter`](super::matched::MatchedFilter) gives for the whole record.
//!
//! A compressed sample needs a pulse's length of what follows it, so that the output runs a pulse behind the input and [`BlockFilter::finish`]
//! gives the rest. Overlap-save: each block is transformed together with the last pulse's length of the blocks before it.

use num_complex::Complex64;

use super::RowLimits;
use super::matched::{Correlator, pulse_samples};
use echotank_config::spec::Shading;
use echotank_core::flow::Pulse;

/// One row's filter; holds what the next block needs of those before.
pub(crate) struct BlockFilter {
    correlator: Correlator,
    /// Samples that wait for what follows them, at most one less than the pulse's.
    waiting: Vec<Complex64>,
    overlap: usize,
    block: usize,
    buffer: Vec<Complex64>,
    scratch: Vec<Complex64>,
}

impl BlockFilter {
    /// For blocks of at most `block` samples. `weighting` as in [`MatchedFilter::new`](super::matched::MatchedFilter::new).
    pub(crate) fn new(
        pulse: &Pulse,
        sample_rate_hz: f64,
        block: usize,
        weighting: Shading,
    ) -> Self {
        let overlap = pulse_samples(pulse.duration_s, sample_rate_hz) - 1;
        let limits = RowLimits {
            sample_rate_hz,
            samples: overlap + block,
            pulse_s: pulse.duration_s,
        };
        let correlator = Correlator::new(pulse, limits, 0, weighting);
        Self {
            waiting: Vec::with_capacity(overlap + block),
            overlap,
            block,
            buffer: vec![Complex64::ZERO; correlator.length()],
            scratch: correlator.make_scratch(),
            correlator,
        }
    }

    /// Samples by which the output runs behind the input until [`BlockFilter::finish`].
    pub(crate) fn behind(&self) -> usize {
        self.overlap
    }

    /// Takes the next samples of the row; appends the compressed samples that are now complete to `out`. Panics on more than `block` samples.
    pub(crate) fn push(&mut self, samples: &[Complex64], out: &mut Vec<Complex64>) {
        assert!(
            samples.len() <= self.block,
            "block of {} samples, sized for {}",
            samples.len(),
            self.block
        );
        self.waiting.extend_from_slice(samples);
        let complete = self.waiting.len().saturating_sub(self.overlap);
        self.compress(complete, out);
    }

    /// The row is over: appends its last samples, and is ready for another row.
    pub(crate) fn finish(&mut self, out: &mut Vec<Complex64>) {
        let rest = self.waiting.len();
        self.compress(rest, out);
    }

    fn compress(&mut self, complete: usize, out: &mut Vec<Complex64>) {
        if complete == 0 {
            return;
        }
        let (head, tail) = self.buffer.split_at_mut(self.waiting.len());
        head.copy_from_slice(&self.waiting);
        tail.fill(Complex64::ZERO);
        self.correlator.forward(&mut self.buffer, &mut self.scratch);
        self.correlator.inverse(&mut self.buffer, &mut self.scratch);
        out.extend_from_slice(&self.buffer[..complete]);
        self.waiting.drain(..complete);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::beam::matched::MatchedFilter;
    use echotank_core::flow::PulseKind;

    #[test]
    fn blocks_of_any_size_give_the_whole_record_s_samples() {
        let pulse = Pulse {
            kind: PulseKind::LfmUp,
            center_frequency_hz: 400e3,
            bandwidth_hz: 30e3,
            duration_s: 5e-3,
            taper: 0.1,
        };
        let (rate_hz, samples) = (40e3, 3000);
        let row: Vec<_> = (0..samples)
            .map(|k| {
                let t = k as f64 / rate_hz;
                pulse.envelope(t - 0.011) + pulse.envelope(t - 0.0713) * 0.4
            })
            .collect();
        let limits = RowLimits {
            sample_rate_hz: rate_hz,
            samples,
            pulse_s: pulse.duration_s,
        };
        let mut want = row.clone();
        MatchedFilter::new(&pulse, limits, Shading::Hamming).apply(&mut want);
        for block in [1, 37, 500, 3000] {
            let mut filter = BlockFilter::new(&pulse, rate_hz, block, Shading::Hamming);
            for _row in 0..2 {
                let mut got = Vec::new();
                for part in row.chunks(block) {
                    filter.push(part, &mut got);
                }
                assert_eq!(got.len(), samples - filter.behind());
                filter.finish(&mut got);
                let worst = got
                    .iter()
                    .zip(&want)
                    .fold(0.0_f64, |w, (g, x)| w.max((g - x).norm()));
                assert_eq!(got.len(), samples);
                assert!(worst < 1e-13, "blocks of {block}: off by {worst:.1e}");
            }
        }
    }
}
