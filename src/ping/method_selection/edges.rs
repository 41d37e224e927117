//! Edges of sharp pulses beside samples. Without a receiver filter an echo begins and ends between two samples; a delay that is off may move an edge
//! across one of them, which then gains or loses the whole echo. Before a ping this is a matter of chance; its own delays tell.
//!
//! In: the plan of a ping and its scatterers. Out: whether any edge is near enough to a sample to cross it.

use echotank_config::spec::SonarSpec;
use echotank_core::ping::PingPlan;
use echotank_core::scene::Scatterers;
use echotank_synthesis::arrivals::{ArrivalChunk, ArrivalSink};
use echotank_synthesis::echo::{TransmitLeg, Window, Workspace, arrivals, insonify};

/// Whether the beginning or the end of an echo is within `shifts_s` seconds of a sample, at any element.
pub(super) fn are_near_samples(
    spec: &SonarSpec,
    plan: &PingPlan,
    scatterers: &Scatterers,
    shifts_s: [f64; 2],
) -> bool {
    let rate_hz = spec.receiver.sample_rate_hz;
    let heard = Window::of_samples(plan.first_sample_s, rate_hz, plan.sample_count);
    let (mut leg, mut work) = (TransmitLeg::new(), Workspace::default());
    let mut edges = Edges {
        pulse_s: plan.pulse.duration_s,
        first_sample_s: plan.first_sample_s,
        rate_hz,
        shifts: shifts_s.map(|shift_s| shift_s * rate_hz),
        near: false,
    };
    for array in &spec.receive {
        let transmit = &spec.transmit[array.transmit];
        insonify(plan, transmit, heard, scatterers, &mut leg);
        for element in 0..array.elements {
            arrivals(plan, array, element, &leg, &mut work, &mut edges);
            if edges.near {
                return true;
            }
        }
    }
    false
}

/// Looks for edges beside samples.
struct Edges {
    pulse_s: f64,
    first_sample_s: f64,
    rate_hz: f64,
    /// Of beginning and end, samples.
    shifts: [f64; 2],
    near: bool,
}

impl ArrivalSink for Edges {
    fn accept(&mut self, chunk: &ArrivalChunk) {
        for i in 0..chunk.len {
            let (eta, curvature) = (1.0 + chunk.doppler[i], chunk.curvature_per_s[i]);
            // (1 + doppler) s + curvature s^2 = T.
            let root = (eta * eta + 4.0 * curvature * self.pulse_s).sqrt();
            let lasts_s = 2.0 * self.pulse_s / (eta + root);
            let begins_s = chunk.delay_s[i] - self.first_sample_s;
            let edges_s = [begins_s, begins_s + lasts_s];
            for (edge_s, shift) in edges_s.into_iter().zip(self.shifts) {
                let at = edge_s * self.rate_hz;
                self.near |= (at - at.round()).abs() <= shift;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Both edges of a stretched echo, a hundredth of a sample beside one.
    #[test]
    fn edges_are_near_as_far_as_they_may_move() {
        const RATE_HZ: f64 = 40e3;
        let (doppler, curvature_per_s, pulse_s) = (0.01, 0.5, 1e-3);
        let lasts_s = {
            // By iteration.
            let mut s = pulse_s;
            for _ in 0..20 {
                s = (pulse_s - curvature_per_s * s * s) / (1.0 + doppler);
            }
            s
        };
        let near = |delay_s: f64, shifts: [f64; 2]| {
            let mut chunk = ArrivalChunk::new();
            chunk.len = 1;
            (chunk.delay_s[0], chunk.doppler[0]) = (delay_s, doppler);
            chunk.curvature_per_s[0] = curvature_per_s;
            let mut edges = Edges {
                pulse_s,
                first_sample_s: 2e-3,
                rate_hz: RATE_HZ,
                shifts,
                near: false,
            };
            edges.accept(&chunk);
            edges.near
        };
        for sample in [100.0, 101.0] {
            let leading_s = 2e-3 + (sample + 0.01) / RATE_HZ;
            assert!(near(leading_s, [0.0101, 0.0]));
            assert!(!near(leading_s, [0.0099, 0.0]));
            let trailing_s = 2e-3 + (sample - 0.01) / RATE_HZ - lasts_s;
            assert!(near(trailing_s, [0.0, 0.0101]));
            assert!(!near(trailing_s, [0.0, 0.0099]));
        }
    }
}
