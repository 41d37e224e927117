//! The fan of one receive array, formed by the method that its configuration selects.

use super::RowLimits;
use super::conventional::FanFormer;
use super::delay_sum::DelaySumFormer;
use super::fast::FastFan;
use super::steered::SteeredArray;
use echotank_config::spec::{FanSpec, Former, Shading};
use echotank_core::arrays::{ArrayGeometry, TransmitArray};
use echotank_core::ping::{BeamFrame, ElementFrame, PingPlan};
use echotank_core::pulse::Pulse;

/// Beamformer of a fan.
pub enum Fan {
    /// Frequency domain, f64.
    Exact(Box<FanFormer>),
    /// Frequency domain, f32.
    Fast(Box<FastFan>),
    /// Time domain, f32.
    DelaySum(Box<DelaySumFormer>),
}

impl Fan {
    /// Parameters and panics as [`DelaySumFormer::new`].
    pub fn new(
        array: &ArrayGeometry,
        transmit: &TransmitArray,
        fan: &FanSpec,
        limits: RowLimits,
        pulse: &Pulse,
        weighting: Shading,
        sound_speed_m_per_s: f64,
    ) -> Self {
        let c = sound_speed_m_per_s;
        let far_field = || SteeredArray::far_field(array, fan, limits, pulse, weighting, c);
        match fan.form.former {
            Former::Exact => Self::Exact(Box::new(FanFormer::new(far_field()))),
            Former::Fft => Self::Fast(Box::new(FastFan::new(far_field()))),
            Former::TimeDelay | Former::Phase | Former::DynamicFocus => {
                let former = DelaySumFormer::new(array, transmit, fan, limits, pulse, weighting, c);
                Self::DelaySum(Box::new(former))
            }
        }
    }

    /// Index of the fan's receive array.
    pub fn array(&self) -> usize {
        match self {
            Self::Exact(former) => former.array(),
            Self::Fast(former) => former.array(),
            Self::DelaySum(former) => former.array(),
        }
    }

    /// Forms the beams of one ping. `frame` holds the samples of the fan's array; `out` grows once to its maximum size and is reused.
    pub fn form(&mut self, plan: &PingPlan, frame: &ElementFrame, out: &mut BeamFrame) {
        match self {
            Self::Exact(former) => former.form(plan, frame, out),
            Self::Fast(former) => former.form(plan, frame, out),
            Self::DelaySum(former) => former.form(plan, frame, out),
        }
    }
}
