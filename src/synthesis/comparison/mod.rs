//! Synthesis methods of other simulators, for comparison: the sum over frequencies of Meng et al. 2023 ([`spectral`]), and sampled
//! replicas at the nearest sample ([`nearest`]) or interpolated ([`linear`]).
//!
//! The pipeline uses them through [`Comparison`].

pub mod linear;
pub mod nearest;
pub mod replica;
pub mod spectral;

use num_complex::Complex64;

use echotank_core::arrays::ArrayGeometry;
use echotank_core::model::Synthesis;
use echotank_core::ping::{EchoCounts, PingPlan};

use crate::array::filter::Decimator;
use crate::arrivals::ArrivalSink;
use crate::echo::walk::{TransmitLeg, Workspace, arrivals};
use linear::Linear;
use nearest::Nearest;
use replica::Replica;
use spectral::{Bins, Spectral, Spectrum};

/// Synthesis method for comparison, with the tables that all elements share.
pub enum Comparison {
    /// Sum over frequencies of Meng et al. 2023.
    Spectral(Spectrum),
    /// Replicas at the nearest sample.
    Nearest(Replica),
    /// Replicas interpolated between samples.
    Linear(Replica),
}

impl Comparison {
    /// The method that `synthesis` names; `None` if it is not one of these methods. Records last up to `record_s` seconds,
    /// including pulse and filter tails. `step_hz` is the step of the frequency grid, see [`Spectrum::new`].
    pub fn new(
        synthesis: Synthesis,
        rate_hz: f64,
        record_s: f64,
        step_hz: Option<f64>,
        filter: Option<&Decimator>,
    ) -> Option<Self> {
        match synthesis {
            Synthesis::Spectral => Some(Self::Spectral(Spectrum::new(
                rate_hz, record_s, step_hz, filter,
            ))),
            Synthesis::Nearest => Some(Self::Nearest(Replica::default())),
            Synthesis::Linear => Some(Self::Linear(Replica::default())),
            Synthesis::Reference
            | Synthesis::Direct
            | Synthesis::Gridded1d
            | Synthesis::Gridded2d
            | Synthesis::GriddedLines => None,
        }
    }

    /// Computes the tables of the plan's pulse unless they exist.
    pub fn prepare(&mut self, plan: &PingPlan, rate_hz: f64, filter: Option<&Decimator>) {
        match self {
            Self::Spectral(spectrum) => spectrum.prepare(plan),
            Self::Nearest(replica) | Self::Linear(replica) => {
                replica.prepare(plan, rate_hz, filter)
            }
        }
    }

    /// Overwrites `iq` with the samples of one element, after the receiver filter.
    #[expect(
        clippy::too_many_arguments,
        reason = "one element of one ping, with the scratch of one thread"
    )]
    pub fn element(
        &self,
        plan: &PingPlan,
        rate_hz: f64,
        array: &ArrayGeometry,
        element: usize,
        transmit_leg: &TransmitLeg,
        walk: &mut Workspace,
        bins: &mut Bins,
        iq: &mut [Complex64],
    ) -> EchoCounts {
        self.sum(plan, rate_hz, plan.first_sample_s, bins, iq, |sink| {
            arrivals(plan, array, element, transmit_leg, walk, sink)
        })
    }

    /// Overwrites `iq` with the sum of the echoes that `pass` emits to the sink, after the receiver filter.
    pub(crate) fn sum<R>(
        &self,
        plan: &PingPlan,
        rate_hz: f64,
        first_s: f64,
        bins: &mut Bins,
        iq: &mut [Complex64],
        pass: impl FnOnce(&mut dyn ArrivalSink) -> R,
    ) -> R {
        match self {
            Self::Spectral(spectrum) => {
                let mut sink = Spectral::new(plan, spectrum, first_s, bins);
                let passed = pass(&mut sink);
                sink.finish(iq);
                passed
            }
            Self::Nearest(replica) => {
                iq.fill(Complex64::ZERO);
                pass(&mut Nearest::new(plan, replica, rate_hz, first_s, iq))
            }
            Self::Linear(replica) => {
                iq.fill(Complex64::ZERO);
                pass(&mut Linear::new(plan, replica, rate_hz, first_s, iq))
            }
        }
    }
}
