//! The echoes of a platform at rest. Every ping receives them at the same places and with the same phases, so that the level of each window is that of
//! their sum, and need not be bounded by chance.
//!
//! In: the plan of a ping at rest and its scatterers. Out: the largest windowed error of an engine, from the profile of its echoes
//! ([`EchoProfile`]). Looked at are the ends of each array and the elements with the deepest fades.

use crate::error_check::window_samples;
use crate::method_selection::{MotionScale, fades};
use echotank_config::spec::SonarSpec;
use echotank_core::model::{DopplerModel, PathModel};
use echotank_core::ping::{PingPlan, RangeFloors};
use echotank_core::pulse::noise_share;
use echotank_core::scene::Scatterers;
use echotank_synthesis::array::echo_profile::{EchoProfile, KnownEcho, carrier, window_levels};
use echotank_synthesis::arrivals::{ArrivalChunk, ArrivalSink};
use echotank_synthesis::echo::{TransmitLeg, Window, Workspace, arrivals, insonify};
use echotank_synthesis::error_model::Conditions;
use num_complex::Complex64;

/// A platform that is slower than this is at rest, m/s: it moves by less than a thousandth of a wavelength of 1 MHz in a block of pings.
const AT_REST_M_PER_S: f64 = 1e-7;
/// Recent motion over that of a ping at rest is rounded up by less than this (`live`): with more, the platform has moved.
const ROUNDED: f64 = 1.5;
/// Sums of an echo at a sample, at most: a tenth of a second. With more, windows are bounded by chance.
const MAX_EFFORT: usize = 50_000_000;
/// Elements of an array with the deepest fades that are looked at, besides its ends, at least.
const DEEPEST: usize = 4;
/// More are looked at while their echoes have no more samples than this, all together.
const LOOKED_AT: usize = 500_000;
/// Logarithm of the number of windows that fade about as deep as the deepest: so many chances the errors in them have to add up.
const LOOKS: f64 = 3.0;
/// For elements that are not looked at, and places on the grid between those that are.
const SAMPLED: f64 = 1.2;

/// Echoes and window levels of the elements that are looked at, array by array.
pub(super) struct RestingPing {
    arrays: Vec<Vec<RestingElement>>,
    /// Largest distance from the transmitter to an element of each array, metres.
    apart_m: Vec<f64>,
    window: usize,
    peak: f64,
    /// Range of an echo for each sample of its delay, and before the first one, metres.
    range_m: (f64, f64),
}

struct RestingElement {
    echoes: Vec<KnownEcho>,
    levels: Vec<f64>,
}

/// Whether the pings of these conditions are all alike.
pub(super) fn is_at_rest(conditions: &Conditions, motion_scale: &MotionScale) -> bool {
    let factors = [
        motion_scale.speed,
        motion_scale.acceleration,
        motion_scale.turning,
    ];
    conditions.speed_m_per_s < AT_REST_M_PER_S
        && conditions.acceleration_m_per_s2 < AT_REST_M_PER_S
        && factors.iter().all(|factor| *factor < ROUNDED)
}

/// Arrivals at one element.
struct Collected<'a> {
    plan: &'a PingPlan,
    rate_hz: f64,
    echoes: Vec<KnownEcho>,
}

impl ArrivalSink for Collected<'_> {
    fn accept(&mut self, chunk: &ArrivalChunk) {
        let pulse = &self.plan.pulse;
        let arrivals = chunk.delay_s.iter().zip(&chunk.amplitude).take(chunk.len);
        self.echoes.extend(arrivals.map(|(&delay_s, amplitude)| {
            let middle_s = delay_s + 0.5 * pulse.duration_s - self.plan.first_sample_s;
            KnownEcho {
                middle: middle_s * self.rate_hz,
                amplitude: amplitude * carrier(pulse.center_frequency_hz * delay_s),
            }
        }));
    }
}

impl RestingPing {
    /// None where there are too many echoes. `profile`: an echo by any engine.
    pub(super) fn new(
        spec: &SonarSpec,
        plan: &PingPlan,
        scatterers: &Scatterers,
        profile: &EchoProfile,
    ) -> Option<Self> {
        let elements: usize = spec.receive.iter().map(|array| array.elements).sum();
        if scatterers.len() * elements * profile.effort() > MAX_EFFORT {
            return None;
        }
        let mut plan = plan.clone();
        plan.model.path = PathModel::StopAndHop;
        plan.model.doppler = DopplerModel::None;
        plan.model.cull_db = None;
        plan.range_floors = RangeFloors::default();
        let rate_hz = spec.receiver.sample_rate_hz;
        let window = window_samples(plan.pulse.duration_s, rate_hz).min(plan.sample_count);
        let reach = profile.reach();
        let first_s = plan.first_sample_s - reach as f64 / rate_hz;
        let heard = Window::of_samples(first_s, rate_hz, plan.sample_count + 2 * reach);
        let (mut leg, mut work) = (TransmitLeg::new(), Workspace::default());
        let (mut arrays, mut apart_m) = (Vec::new(), Vec::new());
        for array in &spec.receive {
            let transmit = &spec.transmit[array.transmit];
            let apart = array.outermost().map(|element| {
                let element_m = array.element_body_m(element);
                element_m.distance(transmit.mounting.position_m)
            });
            apart_m.push(apart.fold(0.0, f64::max));
            insonify(&plan, transmit, heard, scatterers, &mut leg);
            let mut all: Vec<RestingElement> = Vec::new();
            for element in 0..array.elements {
                let mut sink = Collected {
                    plan: &plan,
                    rate_hz,
                    echoes: Vec::new(),
                };
                arrivals(&plan, array, element, &leg, &mut work, &mut sink);
                let echoes = sink.echoes;
                let mut samples = vec![Complex64::ZERO; plan.sample_count];
                profile.add(&echoes, &mut samples);
                let levels = window_levels(&samples, window);
                all.push(RestingElement { echoes, levels });
            }
            let of_element = (scatterers.len() * profile.effort()).max(1);
            arrays.push(looked_at(all, DEEPEST.max(LOOKED_AT / of_element)));
        }
        let independent = fades::independent_of_pulse(&plan.pulse, window as f64 / rate_hz);
        Some(Self {
            arrays,
            apart_m,
            window,
            peak: fades::worst_peak(LOOKS, independent),
            range_m: {
                let c = plan.sound_speed_m_per_s;
                let before_s = plan.first_sample_s - 0.5 * plan.pulse.duration_s;
                (0.5 * c / rate_hz, 0.5 * c * before_s)
            },
        })
    }

    /// Largest error of the windows of one array, by an engine with this profile of an echo. `phase_errors`: ranges in ascending order with errors in
    /// radians, from each to the next, of the phase of an echo beside; those nearer have the first one.
    pub(super) fn error(
        &self,
        array: usize,
        profile: &EchoProfile,
        phase_errors: &[(f64, f64)],
    ) -> f64 {
        let off_rad = |echo: &KnownEcho| {
            // At least, from any element.
            let range_m = self.range_m.1 + echo.middle * self.range_m.0 - 0.5 * self.apart_m[array];
            let nearer = phase_errors.partition_point(|(from_m, _)| *from_m <= range_m);
            let at = phase_errors.get(nearer.saturating_sub(1));
            at.map_or(0.0, |(_, rad)| *rad)
        };
        let of = (self.window, self.peak);
        let elements = self.arrays[array].iter();
        let errors = elements.map(|e| profile.window_error(&e.echoes, &e.levels, of, off_rad));
        SAMPLED * errors.fold(0.0, f64::max)
    }
}

/// The ends of an array, and its elements with the deepest fades below the mean of all.
fn looked_at(mut all: Vec<RestingElement>, deepest: usize) -> Vec<RestingElement> {
    let count = all.len();
    let windows = all.first().map_or(0, |element| element.levels.len());
    let mut mean = vec![0.0; windows];
    for element in &all {
        for (mean, level) in mean.iter_mut().zip(&element.levels) {
            *mean += level / count as f64;
        }
    }
    let mut depths: Vec<(f64, usize)> = all
        .iter()
        .map(|element| {
            let floor = noise_share() * element.levels.iter().copied().fold(0.0, f64::max);
            let heard = element.levels.iter().zip(&mean);
            let depths = heard.map(|(level, mean)| mean / level.max(floor).max(f64::MIN_POSITIVE));
            depths.fold(0.0, f64::max)
        })
        .zip(0..)
        .collect();
    depths.sort_by(|a, b| b.0.total_cmp(&a.0));
    let deepest = depths.iter().take(deepest).map(|(_, element)| *element);
    let mut kept: Vec<usize> = deepest.chain([0, count.saturating_sub(1)]).collect();
    kept.sort_unstable();
    kept.dedup();
    let mut element = 0..;
    all.retain(|_| element.next().is_some_and(|k| kept.contains(&k)));
    all
}
