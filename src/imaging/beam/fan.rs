//! The fan of one receive array, formed by the method that its configuration selects; for bottom detection also the phase between the beams of
//! the line's halves, which gives the direction within a beam.

use super::RowLimits;
use super::conventional::FanFormer;
use super::delay_sum::DelaySumFormer;
use super::fast::FastFan;
use super::steered::SteeredArray;
use echotank_config::spec::{FanSpec, Former, Shading};
use echotank_core::arrays::{ArrayGeometry, TransmitArray};
use echotank_core::ping::{BeamFrame, ElementFrame, PingPlan};
use echotank_core::pulse::Pulse;
use num_complex::Complex32;

/// Beamformer of a fan.
pub struct Fan {
    method: Method,
    halves: Option<Halves>,
}

struct Halves {
    /// Where the method forms no halves.
    former: Option<Box<DelaySumFormer>>,
    products: Vec<Complex32>,
}

enum Method {
    /// Frequency domain, f64.
    Exact(Box<FanFormer>),
    /// Frequency domain, f32.
    Fast(Box<FastFan>),
    /// Time domain, f32.
    DelaySum(Box<DelaySumFormer>),
}

impl Fan {
    /// `array` is the receive array that `fan` names, `transmit` its transmitter. Work is shared among the threads of the current pool. For bottom detection, a fan configured as `exact` or `fft` has halves with time
    /// delays.
    ///
    /// Panics on a fan without beams, an array without elements or a pulse beyond `limits`; a checked configuration prevents these.
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
        let method = match fan.form.former {
            Former::Exact => Method::Exact(Box::new(FanFormer::new(far_field()))),
            Former::Fft => Method::Fast(Box::new(FastFan::new(far_field()))),
            Former::TimeDelay | Former::Phase | Former::DynamicFocus => {
                let former = DelaySumFormer::new(array, transmit, fan, limits, pulse, weighting, c);
                Method::DelaySum(Box::new(former))
            }
        };
        let halves = fan.form.bottom_detection.then(|| {
            let former = (!matches!(method, Method::DelaySum(_))).then(|| {
                let mut fan = fan.clone();
                fan.form.former = Former::TimeDelay;
                let former =
                    DelaySumFormer::new(array, transmit, &fan, limits, pulse, weighting, c);
                Box::new(former)
            });
            Halves {
                former,
                products: Vec::new(),
            }
        });
        Self { method, halves }
    }

    /// Index of the fan's receive array.
    pub fn array(&self) -> usize {
        match &self.method {
            Method::Exact(former) => former.array(),
            Method::Fast(former) => former.array(),
            Method::DelaySum(former) => former.array(),
        }
    }

    #[cfg(test)]
    pub(crate) fn is_fast(&self) -> bool {
        matches!(self.method, Method::Fast(_))
    }

    /// Forms the beams of one ping. `frame` holds the samples of the fan's array; `out` grows once to its maximum size and is reused.
    /// Returns, for bottom detection, the product of each sample of the half at the array's -x end and the conjugate of that at its +x end, in
    /// the order of `out`. Both refer to the whole line's centre, so that its phase is zero on the axis of every beam.
    pub fn form(
        &mut self,
        plan: &PingPlan,
        frame: &ElementFrame,
        out: &mut BeamFrame,
    ) -> Option<&[Complex32]> {
        match (&mut self.method, &mut self.halves) {
            (Method::DelaySum(former), halves) => {
                let products = halves.as_mut().map(|halves| &mut halves.products);
                former.form_with_halves(plan, frame, Some(out), products);
            }
            (Method::Exact(former), _) => former.form(plan, frame, out),
            (Method::Fast(former), _) => former.form(plan, frame, out),
        }
        let Halves { former, products } = self.halves.as_mut()?;
        if let Some(former) = former {
            former.form_with_halves(plan, frame, None, Some(products));
        }
        Some(products)
    }
}
