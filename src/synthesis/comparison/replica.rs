//! Replica of the received pulse, sampled once for all echoes. [`nearest`](super::nearest) and [`linear`](super::linear) add copies
//! of it.

use num_complex::Complex64;

use crate::arrivals::{ArrivalChunk, ArrivalSink};
use echotank_core::ping::PingPlan;
use echotank_core::pulse::Pulse;

use crate::array::direct::Direct;
use crate::array::filter::Decimator;
use crate::array::phasor::cis;

/// Echo of unit amplitude that begins at time zero, without carrier, at the sample rate and after the receiver filter.
#[derive(Clone, Debug, Default)]
pub struct Replica {
    pulse: Option<Pulse>,
    /// Index of the sample at time zero. The response of the filter begins earlier.
    before: usize,
    samples: Vec<Complex64>,
    dense: Vec<Complex64>,
}

impl Replica {
    /// Computes the replica of the plan's pulse unless it exists. Allocates only if a pulse is longer than all before.
    pub fn prepare(&mut self, plan: &PingPlan, rate_hz: f64, filter: Option<&Decimator>) {
        if self.pulse == Some(plan.pulse) {
            return;
        }
        self.pulse = Some(plan.pulse);
        let reach_s = filter.map_or(0.0, |f| -f.dense_first_s(0.0));
        self.before = (reach_s * rate_hz).ceil() as usize;
        let sounding = (plan.pulse.duration_s * rate_hz).floor() as usize + 1;
        self.samples.clear();
        self.samples
            .resize(sounding + 2 * self.before, Complex64::ZERO);
        let first_s = -(self.before as f64) / rate_hz;
        let mut echo = ArrivalChunk::new();
        echo.len = 1;
        echo.amplitude[0] = Complex64::ONE;
        match filter {
            None => Direct::new(plan, rate_hz, first_s, &mut self.samples).accept(&echo),
            Some(filter) => {
                self.dense.clear();
                self.dense
                    .resize(filter.dense_len(self.samples.len()), Complex64::ZERO);
                let dense_first_s = filter.dense_first_s(first_s);
                Direct::new(plan, filter.dense_rate_hz(), dense_first_s, &mut self.dense)
                    .with_ends(Some(filter.ends()))
                    .accept(&echo);
                filter.apply(&self.dense, &mut self.samples);
            }
        }
    }

    /// Adds the replica to `out`, with its sample at time zero on `out[start]`. `start` may be outside `out`.
    fn add(&self, start: i64, factor: Complex64, out: &mut [Complex64]) {
        let from = start.saturating_sub(self.before as i64);
        let skip = usize::try_from(from.saturating_neg()).unwrap_or(0);
        let at = usize::try_from(from).unwrap_or(0);
        let (Some(out), Some(samples)) = (out.get_mut(at..), self.samples.get(skip..)) else {
            return;
        };
        for (sum, sample) in out.iter_mut().zip(samples) {
            *sum += factor * sample;
        }
    }
}

/// Sink that adds replicas to the samples of one element.
pub struct ReplicaSink<'a, const INTERPOLATED: bool> {
    replica: &'a Replica,
    carrier_hz: f64,
    rate_hz: f64,
    first_sample_s: f64,
    out: &'a mut [Complex64],
}

impl<'a, const INTERPOLATED: bool> ReplicaSink<'a, INTERPOLATED> {
    /// Sink for samples at `first_sample_s + k / rate_hz` seconds after the start of the pulse. Echoes are added to the values of
    /// `out`.
    pub fn new(
        plan: &PingPlan,
        replica: &'a Replica,
        rate_hz: f64,
        first_sample_s: f64,
        out: &'a mut [Complex64],
    ) -> Self {
        Self {
            replica,
            carrier_hz: plan.pulse.center_frequency_hz,
            rate_hz,
            first_sample_s,
            out,
        }
    }
}

impl<const INTERPOLATED: bool> ArrivalSink for ReplicaSink<'_, INTERPOLATED> {
    fn accept(&mut self, chunk: &ArrivalChunk) {
        for (delay_s, amplitude) in chunk.delay_s.iter().zip(&chunk.amplitude).take(chunk.len) {
            let at = (delay_s - self.first_sample_s) * self.rate_hz;
            let cycles = self.carrier_hz * delay_s;
            let (cos, sin) = cis(cycles.round_ties_even() - cycles);
            let factor = amplitude * Complex64::new(cos, sin);
            if !INTERPOLATED {
                let start = at.round_ties_even() as i64;
                self.replica.add(start, factor, self.out);
                continue;
            }
            let (start, after) = (at.floor() as i64, at - at.floor());
            self.replica.add(start, factor * (1.0 - after), self.out);
            self.replica
                .add(start.saturating_add(1), factor * after, self.out);
        }
    }
}
