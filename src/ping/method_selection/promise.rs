//! What a selection promises of each ping: the error models of path and Doppler with the ping's own motion.
//!
//! In: the selected candidate with the conditions that it was selected for, and the peaks of a ping's motion. Out: the ping's path model and its
//! predicted error.

use crate::conditions::{conditions, segment_step_s};
use crate::method_selection::SEGMENTS_S;
use crate::method_selection::echo_statistics::{EchoPeaks, echo_peaks};
use crate::method_selection::moving::{IN_PING, moving_error, sum_error};
use crate::methods::{Candidate, Family};
use crate::refraction::refraction_error;
use echotank_config::spec::SonarSpec;
use echotank_core::model::{DopplerModel, PathModel, Synthesis};
use echotank_core::ping::PingPlan;
use echotank_core::scene::Scatterers;
use echotank_synthesis::echo::error_models::{doppler_error, path_error};
use echotank_synthesis::error_model::Conditions;

/// Of so few scatterers the statistics are made anew for each ping: which of them is heard alone changes from ping to ping. Of more, the peaks of
/// their motion tell how much greater the statistics are than those of the selection.
const ALL: usize = 1000;

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
    others: f64,
    culling: f64,
}

impl Promise {
    pub(super) fn new(candidate: &Candidate, conditions: Conditions, peaks: EchoPeaks) -> Self {
        let model = candidate.choice.model;
        let others = [Family::Sum, Family::Output];
        let errors = others.map(|family| candidate.part(family).error);
        Self {
            conditions,
            peaks,
            path: model.path,
            segment_s: model.segment_s,
            doppler: model.doppler,
            synthesis: model.synthesis,
            others: errors.into_iter().fold(0.0, f64::hypot),
            culling: candidate.part(Family::Culling).error,
        }
    }

    /// Path model of a ping, length of its segments in seconds, and its predicted error. A configured path stays, and so does a selected one that
    /// keeps the tolerance.
    pub(super) fn of_ping(
        &self,
        spec: &SonarSpec,
        plan: &PingPlan,
        scatterers: &Scatterers,
        tolerance: f64,
    ) -> (PathModel, f64, f64) {
        let bent = refraction_error(spec, plan, scatterers);
        let moving = match scatterers.moving.is_empty() {
            true => 0.0,
            false => {
                let by_sum = sum_error(self.synthesis, spec, plan, &self.conditions);
                by_sum.hypot(moving_error(spec, plan, scatterers, IN_PING))
            }
        };
        let others = self.others.hypot(moving);
        // The reference uses neither path nor Doppler model.
        if self.synthesis == Synthesis::Reference {
            return (self.path, self.segment_s, others.hypot(bent));
        }
        let culling = match plan.range_floors.levels.is_empty() {
            true => self.culling,
            false => plan.range_floors.left_out,
        };
        let others = others.hypot(culling);
        let conditions = match scatterers.len() <= ALL {
            true => conditions(spec, plan, scatterers),
            false => echo_peaks(spec, plan, scatterers).scale(&self.peaks, self.conditions),
        };
        let conditions = Conditions {
            pulse: plan.pulse,
            ..conditions
        };
        let window_s = plan.window_s(conditions.sample_rate_hz);
        let error = |path: PathModel, segment_s: f64| {
            let conditions = Conditions {
                segment_s: segment_step_s(window_s, segment_s),
                ..conditions
            };
            let doppler = doppler_error(self.doppler, path, &conditions);
            (path_error(path, &conditions) + bent + doppler).hypot(others)
        };
        let selected = (self.path, self.segment_s, error(self.path, self.segment_s));
        if selected.2 <= tolerance || !spec.synthesis.auto.path {
            return selected;
        }
        // From cheap to costly.
        let shorter = SEGMENTS_S
            .into_iter()
            .filter(|&segment_s| spec.synthesis.auto.segment && segment_s < self.segment_s);
        let chords = std::iter::once(self.segment_s).chain(shorter);
        let costlier = chords
            .map(|segment_s| (PathModel::KSegment, segment_s))
            .chain([(PathModel::Continuous, self.segment_s)])
            .map(|(path, segment_s)| (path, segment_s, error(path, segment_s)));
        let errors = costlier.clone().map(|(_, _, error)| error);
        let least = errors.fold(selected.2, f64::min);
        // Where none keeps the tolerance, the cheapest that is about as good as any.
        let enough = tolerance.max(ABOUT * least);
        std::iter::once(selected)
            .chain(costlier)
            .find(|(_, _, error)| *error <= enough)
            .unwrap_or(selected)
    }
}
