//! Samples by the equation of the reference, through the receiver filter.

use echotank_config::spec::{MediumSpec, SonarSpec};
use echotank_core::arrays::{ArrayGeometry, ReceiverFilter, TransmitArray};
use echotank_core::model::{DopplerModel, PathModel, Synthesis};
use echotank_core::ping::PingPlan;
use echotank_core::pulse::{MIN_WINDOW, Pulse};
use echotank_core::scene::Scatterers;
use echotank_ping::element_synthesis::FASTEST_PLATFORM_M_PER_S;
use echotank_synthesis::array::filter::{self, FilterError};
use echotank_synthesis::array::{Decimator, Direct};
use echotank_synthesis::echo::probe::{Instant, echoes_at, receivable, receivable_ranges_m};
use echotank_synthesis::edges::EndWeights;
use num_complex::Complex64;
use rayon::prelude::*;

/// Number of instants per search for scatterers, one bit each.
const AT_ONCE: usize = 64;

/// Samples of `sum` from `first_s`, after the filter. With a filter, `sum` is sampled at the density of the filter, with weighted
/// ends. `sum` gets the weights, rate, first instant and the output.
pub(crate) fn received(
    filter: Option<&Decimator>,
    (rate_hz, first_s): (f64, f64),
    out: &mut [Complex64],
    sum: impl FnOnce(Option<&EndWeights>, f64, f64, &mut [Complex64]),
) {
    let Some(filter) = filter else {
        return sum(None, rate_hz, first_s, out);
    };
    let mut dense = vec![Complex64::ZERO; filter.dense_len(out.len())];
    let first_s = filter.dense_first_s(first_s);
    let ends = Some(filter.ends());
    sum(ends, filter.dense_rate_hz(), first_s, &mut dense);
    filter.apply(&dense, out);
}

/// Number of samples of a window of the accuracy requirement.
pub(crate) fn window_samples(pulse_s: f64, rate_hz: f64) -> usize {
    (pulse_s * rate_hz).ceil().max(MIN_WINDOW) as usize
}

/// Receiver filter of the sonar with the density of the reference; `None` if the sonar has no filter.
pub(crate) fn reference_filter(
    spec: &SonarSpec,
    medium: &MediumSpec,
) -> Result<Option<Decimator>, FilterError> {
    let shortest = Pulse {
        duration_s: spec.limits.pulse_duration_s.0,
        ..spec.pulse
    };
    let rate_hz = spec.receiver.sample_rate_hz;
    let c = medium.sound_speed_m_per_s;
    let doppler_hz = 2.0 * FASTEST_PLATFORM_M_PER_S / c * spec.pulse.center_frequency_hz;
    match spec.receiver.filter {
        ReceiverFilter::None => Ok(None),
        ReceiverFilter::Fir => {
            let dense = filter::oversample(&shortest, rate_hz, Synthesis::Reference);
            Decimator::new(&shortest, rate_hz, doppler_hz, dense).map(Some)
        }
    }
}

/// Plan of a ping with the exact motion, second-order Doppler and every scatterer.
pub(crate) fn reference_plan(plan: &PingPlan) -> PingPlan {
    let mut plan = plan.clone();
    plan.model.path = PathModel::Continuous;
    plan.model.doppler = DopplerModel::StretchQuadratic;
    plan.model.synthesis = Synthesis::Direct;
    plan.model.cull_db = None;
    plan
}

/// Sample of an element.
pub(crate) struct Probe<'a> {
    pub(crate) transmit: &'a TransmitArray,
    pub(crate) array: &'a ArrayGeometry,
    pub(crate) element: usize,
    pub(crate) sample: usize,
}

/// Values of the given samples, before the gain of the receiver.
pub(crate) fn values(
    plan: &PingPlan,
    scatterers: &Scatterers,
    filter: Option<&Decimator>,
    rate_hz: f64,
    probes: &[Probe],
) -> Vec<Complex64> {
    let instant = |probe: &Probe| Instant {
        element: probe.element,
        time_s: plan.first_sample_s + probe.sample as f64 / rate_hz,
        half_span_s: filter.map_or(0.5 / rate_hz, Decimator::half_s),
    };
    let mut found = Vec::new();
    let mut values = Vec::new();
    for probes in probes.chunks(AT_ONCE) {
        let range = |p: &Probe| receivable_ranges_m(plan, p.transmit, p.array, instant(p));
        let ranges: Vec<_> = probes.iter().map(range).collect();
        receivable(plan, scatterers, &ranges, &mut found);
        values.par_extend(probes.par_iter().enumerate().map(|(k, probe)| {
            let at = instant(probe);
            let of_this = found.iter().filter(|(_, mask)| mask >> k & 1 == 1);
            let indices = of_this.map(|(i, _)| *i as usize);
            let mut value = [Complex64::ZERO];
            received(
                filter,
                (rate_hz, at.time_s),
                &mut value,
                |ends, rate_hz, first_s, out| {
                    let mut sink = Direct::new(plan, rate_hz, first_s, out).with_ends(ends);
                    let Probe {
                        transmit, array, ..
                    } = probe;
                    echoes_at(plan, transmit, array, at, scatterers, indices, &mut sink);
                },
            );
            value[0]
        }));
    }
    values
}
