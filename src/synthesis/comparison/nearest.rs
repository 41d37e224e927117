//! What simple simulators do: every echo's replica on the nearest sample, its carrier phase exact.
//!
//! For comparison. An echo is up to half a sample out of place; the pulse is not stretched, so Doppler models that stretch it do not go with it.

use num_complex::Complex64;

use crate::arrivals::{ArrivalChunk, ArrivalSink};
use echotank_core::ping::PingPlan;

use super::replica::{Replica, with_carrier};

/// Adds echoes to the samples of one element.
pub struct Nearest<'a> {
    replica: &'a Replica,
    carrier_hz: f64,
    rate_hz: f64,
    first_sample_s: f64,
    out: &'a mut [Complex64],
}

impl<'a> Nearest<'a> {
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

impl ArrivalSink for Nearest<'_> {
    fn accept(&mut self, chunk: &ArrivalChunk) {
        for i in 0..chunk.len {
            let delay_s = chunk.delay_s[i];
            let at = (delay_s - self.first_sample_s) * self.rate_hz;
            let factor = with_carrier(chunk.amplitude[i], self.carrier_hz, delay_s);
            self.replica
                .add(at.round_ties_even() as i64, factor, self.out);
        }
    }
}
