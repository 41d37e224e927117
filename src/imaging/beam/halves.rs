//! Forms the same fan from each half of a line; the phase between them gives the direction within a beam.

use super::RowLimits;
use super::delay_sum::DelaySumFormer;
use echotank_config::spec::{FanSpec, Former, Shading};
use echotank_core::arrays::{ArrayGeometry, TransmitArray};
use echotank_core::ping::{BeamFrame, ElementFrame, PingPlan};
use echotank_core::pulse::Pulse;

/// Two fans that both refer to the whole line's centre, so that they agree in phase on the axis of every beam.
pub struct HalvesFormer {
    formers: [DelaySumFormer; 2],
    frames: [BeamFrame; 2],
}

impl HalvesFormer {
    /// Parameters and panics as [`DelaySumFormer::new`]. A fan configured as `exact` or `fft` is formed with time delays.
    pub fn new(
        array: &ArrayGeometry,
        transmit: &TransmitArray,
        fan: &FanSpec,
        limits: RowLimits,
        pulse: &Pulse,
        weighting: Shading,
        sound_speed_m_per_s: f64,
    ) -> Self {
        let mut fan = fan.clone();
        if matches!(fan.form.former, Former::Exact | Former::Fft) {
            fan.form.former = Former::TimeDelay;
        }
        let half = array.elements / 2;
        let c = sound_speed_m_per_s;
        Self {
            formers: [0..half, array.elements - half..array.elements].map(|part| {
                DelaySumFormer::new(array, transmit, &fan, limits, pulse, weighting, c)
                    .with_part(part)
            }),
            frames: [BeamFrame::default(), BeamFrame::default()],
        }
    }

    /// Returns the beams of the half at the array's -x end, then those of the half at its +x end.
    pub fn form(&mut self, plan: &PingPlan, frame: &ElementFrame) -> [&BeamFrame; 2] {
        for (former, out) in self.formers.iter_mut().zip(&mut self.frames) {
            former.form(plan, frame, out);
        }
        [&self.frames[0], &self.frames[1]]
    }
}
