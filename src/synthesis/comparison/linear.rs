//! What somewhat better simulators do: every echo's replica interpolated linearly between its samples, its carrier phase exact.
//!
//! For comparison. Interpolation rounds off the pulse's upper band; the pulse is not stretched, so Doppler models that stretch it do not go
//! with it.

use num_complex::Complex64;

use crate::arrivals::{ArrivalChunk, ArrivalSink};
use echotank_core::ping::PingPlan;

use super::replica::{Replica, with_carrier};

/// Adds echoes to the samples of one element.
pub struct Linear<'a> {
    replica: &'a Replica,
    carrier_hz: f64,
    rate_hz: f64,
    first_sample_s: f64,
    out: &'a mut [Complex64],
}

impl<'a> Linear<'a> {
    /// Sample k of `out` lies `first_sample_s + k / rate_hz` after the start of the pulse. Echoes are added to what `out` holds.
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

impl ArrivalSink for Linear<'_> {
    fn accept(&mut self, chunk: &ArrivalChunk) {
        for i in 0..chunk.len {
            let delay_s = chunk.delay_s[i];
            let at = (delay_s - self.first_sample_s) * self.rate_hz;
            let factor = with_carrier(chunk.amplitude[i], self.carrier_hz, delay_s);
            let before = at.floor();
            let after = at - before;
            self.replica
                .add(before as i64, factor * (1.0 - after), self.out);
            self.replica
                .add((before as i64).saturating_add(1), factor * after, self.out);
        }
    }
}
