//! The fan of one receive array, by whichever former its configuration names.

use super::RowLimits;
use super::conventional::FanFormer;
use super::delay_sum::DelaySumFormer;
use super::fast::FastFan;
use echotank_config::spec::{FanSpec, Former, Shading};
use echotank_core::flow::{ArrayGeometry, BeamFrame, ElementFrame, PingPlan, Pulse, TransmitArray};

/// A fan's former.
pub enum Fan {
    /// In the frequency domain, f64.
    Exact(Box<FanFormer>),
    /// In the frequency domain, f32.
    Fast(Box<FastFan>),
    /// In the time domain, f32.
    DelaySum(Box<DelaySumFormer>),
}

impl Fan {
    /// As [`DelaySumFormer::new`].
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
        match fan.form.former {
            Former::Exact => {
                let former = FanFormer::new(array, fan, limits, pulse, weighting, c);
                Self::Exact(Box::new(former))
            }
            Former::Fft => {
                let former = FastFan::new(array, fan, limits, pulse, weighting, c);
                Self::Fast(Box::new(former))
            }
            Former::TimeDelay | Former::Phase | Former::DynamicFocus => {
                let former = DelaySumFormer::new(array, transmit, fan, limits, pulse, weighting, c);
                Self::DelaySum(Box::new(former))
            }
        }
    }

    /// Index of the receive array it belongs to.
    pub fn array(&self) -> usize {
        match self {
            Self::Exact(former) => former.array(),
            Self::Fast(former) => former.array(),
            Self::DelaySum(former) => former.array(),
        }
    }

    /// Beams of one ping. `frame` is the frame of the fan's array; `out` grows once to the largest size and is reused.
    pub fn form(&mut self, plan: &PingPlan, frame: &ElementFrame, out: &mut BeamFrame) {
        match self {
            Self::Exact(former) => former.form(plan, frame, out),
            Self::Fast(former) => former.form(plan, frame, out),
            Self::DelaySum(former) => former.form(plan, frame, out),
        }
    }
}
