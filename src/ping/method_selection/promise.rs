//! What a selection promises of each ping: the error models of path and Doppler with the ping's own motion.
//!
//! In: the selected candidate with the conditions that it was selected for, and the peaks of a ping's motion. Out: the ping's path model and its
//! predicted error.

use std::f64::consts::TAU;

use crate::conditions::{conditions, segment_step_s, sum_error_model};
use crate::method_selection::SEGMENTS_S;
use crate::method_selection::echo_statistics::{
    EchoPeaks, OFF_PATH, OFF_VELOCITY, TRACKED, echo_peaks, quantities,
};
use crate::method_selection::edges::error_of_edges;
use crate::method_selection::moving::{IN_PING, moving_error, sum_error};
use crate::method_selection::sample_fades::{Predicted, WindowStatistics, are_few, are_heard};
use crate::methods::{Candidate, EchoError, Family};
use crate::refraction::refraction_error;
use echotank_config::spec::SonarSpec;
use echotank_core::arrays::ReceiverFilter;
use echotank_core::model::{DopplerModel, PathModel, Synthesis};
use echotank_core::ping::{ElementFrame, PingPlan};
use echotank_core::scene::Scatterers;
use echotank_synthesis::echo::error_models::{doppler_error, path_error};
use echotank_synthesis::error_model::{Conditions, EchoStatistics, PROMINENCES};

/// Up to so many, the onset is looked at after the ping: the chance by which windows of many echoes fade says too little of the first few.
const ONSETS: usize = 3000;

/// What windows between those that are looked at may have, over the error of these: of 367 answers of `tools/points_random.py` 5 were up to 9 % above
/// the prediction without it, and with 1.1 one of 560 others was 1 % above.
const BETWEEN: f64 = 1.15;

/// Phase errors at the end of an echo over those of a window, where they grow as its square: the root of 5. And those of echoes beside the loudest.
const ENDS: f64 = 2.24;
const BESIDE: f64 = 1.5;

/// Errors of so small a ratio are about the same.
const ABOUT: f64 = 1.1;

/// What a selection promises of pings that move otherwise than the one that it was made on.
#[derive(Clone, Copy)]
pub(super) struct Promise {
    conditions: Conditions,
    peaks: EchoPeaks,
    path: PathModel,
    segment_s: f64,
    doppler: DopplerModel,
    synthesis: Synthesis,
    /// Of what does not move: sum and output; and of culling, where every ping has floors of its own.
    sum: f64,
    echo_error: Option<EchoError>,
    output: f64,
    culling: f64,
}

/// What is promised of one ping.
#[derive(Clone, Copy)]
pub(super) struct PingPromise {
    pub path: PathModel,
    /// Length of the segments, seconds.
    pub segment_s: f64,
    /// Predicted.
    pub error: f64,
    conditions: Conditions,
    /// Whether its samples tell more.
    is_heard: bool,
    /// Error of path and Doppler in the worst window, over the sum of those in the worst window of each cause.
    jointly: f64,
    /// How much further windows may fade between those that are looked at.
    between: f64,
    /// Error of path and Doppler in windows that hold no more than the ends of echoes, where the samples of the ping tell.
    ends: f64,
    /// Of edges of sharp pulses that cross samples, where the ping's own tell.
    edges: f64,
    /// Of virtual points, of the sum, and of all the rest that is neither path nor Doppler.
    bent: f64,
    sum: f64,
    others: f64,
}

impl Promise {
    pub(super) fn new(candidate: &Candidate, conditions: Conditions, peaks: EchoPeaks) -> Self {
        let model = candidate.choice.model;
        Self {
            conditions,
            peaks,
            path: model.path,
            segment_s: model.segment_s,
            doppler: model.doppler,
            synthesis: model.synthesis,
            sum: candidate.part(Family::Sum).error,
            echo_error: candidate.echo_error,
            output: candidate.part(Family::Output).error,
            culling: candidate.part(Family::Culling).error,
        }
    }

    /// The reference uses neither path nor Doppler model.
    fn is_reference(&self) -> bool {
        self.synthesis == Synthesis::Reference
    }

    /// The promise of a ping, with its path model. A configured path stays, and so does a selected one that keeps the tolerance.
    pub(super) fn of_ping(
        &self,
        spec: &SonarSpec,
        plan: &PingPlan,
        scatterers: &Scatterers,
        tolerance: f64,
    ) -> PingPromise {
        let bent = refraction_error(spec, plan, scatterers);
        let moving = match scatterers.moving.is_empty() {
            true => 0.0,
            false => {
                let by_sum = sum_error(self.synthesis, spec, plan, &self.conditions);
                by_sum.hypot(moving_error(spec, plan, scatterers, IN_PING))
            }
        };
        let others = self.output.hypot(moving);
        let is_reference = self.is_reference();
        let culling = match plan.range_floors.levels.is_empty() {
            _ if is_reference => 0.0,
            true => self.culling,
            false => plan.range_floors.left_out,
        };
        // Of few scatterers the statistics are made anew for each ping, before and after it: which of them is heard alone changes from ping to ping. Of
        // more, the peaks of their motion tell how much greater the statistics are than those of the selection, unless some are very near.
        let few = are_few(spec, scatterers);
        let peaks = (!few && !is_reference).then(|| echo_peaks(spec, plan, scatterers));
        let conditions = match peaks {
            _ if is_reference => self.conditions,
            Some(peaks) if !peaks.has_near => peaks.scale(&self.peaks, self.conditions),
            _ => conditions(spec, plan, scatterers),
        };
        let mut ping = PingPromise {
            path: self.path,
            segment_s: self.segment_s,
            error: 0.0,
            conditions: Conditions {
                pulse: plan.pulse,
                ..conditions
            },
            is_heard: !is_reference && are_heard(spec, scatterers, self.synthesis),
            jointly: 1.0,
            between: 1.0,
            ends: 0.0,
            edges: 0.0,
            bent,
            sum: self.sum,
            others: others.hypot(culling),
        };
        ping.error = self.error(plan, &ping, self.path, self.segment_s);
        if is_reference || ping.error <= tolerance || !spec.synthesis.auto.path {
            return ping;
        }
        // From cheap to costly.
        let shorter = SEGMENTS_S
            .into_iter()
            .filter(|&segment_s| spec.synthesis.auto.segment && segment_s < self.segment_s);
        let chords = std::iter::once(self.segment_s).chain(shorter);
        let costlier = chords
            .map(|segment_s| (PathModel::KSegment, segment_s))
            .chain([(PathModel::Continuous, self.segment_s)])
            .map(|(path, segment_s)| (path, segment_s, self.error(plan, &ping, path, segment_s)));
        let errors = costlier.clone().map(|(_, _, error)| error);
        let least = errors.fold(ping.error, f64::min);
        // Where none keeps the tolerance, the cheapest that is about as good as any.
        let enough = tolerance.max(ABOUT * least);
        let selected = (self.path, self.segment_s, ping.error);
        let (path, segment_s, error) = std::iter::once(selected)
            .chain(costlier)
            .find(|(_, _, error)| *error <= enough)
            .unwrap_or(selected);
        PingPromise {
            path,
            segment_s,
            error,
            ..ping
        }
    }

    /// Predicted error of a ping with a path model.
    fn error(&self, plan: &PingPlan, ping: &PingPromise, path: PathModel, segment_s: f64) -> f64 {
        if self.is_reference() {
            return ping.sum.hypot(ping.others).hypot(ping.bent);
        }
        let window_s = plan.window_s(ping.conditions.sample_rate_hz);
        let conditions = Conditions {
            segment_s: segment_step_s(window_s, segment_s),
            ..ping.conditions
        };
        let of_path = path_error(path, &conditions);
        let of_doppler = doppler_error(self.doppler, path, &conditions);
        // An echo of the opposite sign is off by twice itself, and may be louder than all that is left of a window.
        let is_opposite = of_path.max(of_doppler) >= Conditions::error_of_phase(f64::INFINITY);
        let fading = conditions.echo_statistics.map_or(1.0, |e| e.fading);
        let louder = if is_opposite { fading.max(1.0) } else { 1.0 };
        let of_windows = louder * ping.jointly * (of_path + of_doppler);
        // There are no windows between those of ends.
        let of_phase = (ping.between * of_windows).max(ping.ends) + ping.bent;
        (of_phase + ping.edges).hypot(ping.sum).hypot(ping.others)
    }

    /// Error of path and Doppler for each unit of a quantity of the echoes.
    fn weights(
        &self,
        plan: &PingPlan,
        ping: &PingPromise,
        predicted: EchoStatistics,
    ) -> [f64; TRACKED] {
        let window_s = plan.window_s(ping.conditions.sample_rate_hz);
        std::array::from_fn(|only| {
            let mut statistics = predicted;
            statistics.off_path_m = Some(0.0);
            statistics.off_velocity_m_per_s = Some(0.0);
            let mut unit = 0.0;
            for (q, value) in quantities(&mut statistics).into_iter().enumerate() {
                match q == only {
                    true => unit = *value,
                    false => *value = 0.0,
                }
            }
            let known = match only {
                OFF_PATH => Some(&mut statistics.off_path_m),
                OFF_VELOCITY => Some(&mut statistics.off_velocity_m_per_s),
                _ => None,
            };
            if let Some(known) = known {
                unit = 1e-3 / ping.conditions.wavenumber_per_m();
                *known = Some(unit);
            }
            let conditions = Conditions {
                segment_s: segment_step_s(window_s, ping.segment_s),
                echo_statistics: Some(statistics),
                ..ping.conditions
            };
            let doppler = doppler_error(self.doppler, ping.path, &conditions);
            let error = path_error(ping.path, &conditions) + doppler;
            if unit > 0.0 { error / unit } else { 0.0 }
        })
    }

    /// The error of edges of sharp pulses that cross a sample.
    fn error_of_edges(
        &self,
        (spec, plan): (&SonarSpec, &PingPlan),
        scatterers: &Scatterers,
        frames: &[ElementFrame],
        ping: &PingPromise,
    ) -> f64 {
        if spec.receiver.filter == ReceiverFilter::Fir || plan.pulse.taper > 0.0 {
            return 0.0;
        }
        // The beginning of an echo is off by its path alone, its end by more than the phase of a window.
        let of_window = self.error(plan, ping, ping.path, ping.segment_s);
        let of_path = path_error(ping.path, &ping.conditions);
        let rad_per_s = TAU * plan.pulse.center_frequency_hz;
        let shifts_s = [of_path, ENDS * of_window].map(|rad| BESIDE * rad / rad_per_s);
        error_of_edges(spec, plan, scatterers, frames, shifts_s)
    }

    /// The predicted error of a ping that has been made, with the fades of its own samples. `is_direct`: the direct sum made them all in place of the
    /// engine.
    pub(super) fn of_samples(
        &self,
        spec: &SonarSpec,
        plan: &PingPlan,
        scatterers: &Scatterers,
        (frames, is_direct): (&[ElementFrame], bool),
        (ping, windows): (&mut PingPromise, &mut WindowStatistics),
    ) {
        let sum_of = |synthesis: Synthesis, ping: &PingPromise| {
            ping.between * sum_error_model(synthesis, spec, plan, &ping.conditions).error
        };
        if !ping.is_heard && is_direct {
            ping.sum = sum_of(Synthesis::Direct, ping);
            ping.error = self.error(plan, ping, ping.path, ping.segment_s);
        }
        let looked_at = ping.is_heard || !self.is_reference() && scatterers.len() <= ONSETS;
        let Some(predicted) = ping.conditions.echo_statistics.filter(|_| looked_at) else {
            return;
        };
        // Edges that cross samples are off in proportion to nothing; they are looked at below.
        let predicted = EchoStatistics {
            prominent: [0.0; PROMINENCES],
            ..predicted
        };
        let weights = self.weights(plan, ping, predicted);
        let of = Predicted {
            statistics: predicted,
            weights: &weights,
            over_window: self.echo_error.map(EchoError::over_window),
        };
        let heard = match ping.is_heard {
            true => windows.of_samples(spec, plan, scatterers, frames, of),
            false => windows.of_onset(spec, plan, scatterers, frames, of),
        };
        let before = ping.error;
        ping.conditions.echo_statistics = Some(heard);
        ping.between = BETWEEN;
        if is_direct {
            ping.sum = sum_of(Synthesis::Direct, ping);
        } else if let Some(echo) = self.echo_error {
            ping.sum = echo.of_ping(&heard, BETWEEN);
        } else if !self.synthesis.keeps_tolerance() {
            ping.sum = sum_of(self.synthesis, ping);
        }
        ping.jointly = windows.jointly(&weights);
        if ping.is_heard {
            ping.edges = self.error_of_edges((spec, plan), scatterers, frames, ping);
        }
        ping.ends = windows.error_of_ends();
        let error = self.error(plan, ping, ping.path, ping.segment_s);
        ping.error = match ping.is_heard {
            true => error,
            false => error.max(before),
        };
    }
}
