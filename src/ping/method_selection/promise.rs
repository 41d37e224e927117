//! What a selection promises of each ping: the error models of path and Doppler with the ping's own motion.
//!
//! In: the selected candidate with the conditions that it was selected for, and the peaks of a ping's motion. Out: the ping's path model and its
//! predicted error.

use crate::conditions::{conditions, segment_step_s};
use crate::method_selection::echo_statistics::{EchoPeaks, echo_peaks};
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

/// What a selection promises of pings that move otherwise than the one that it was made on.
#[derive(Clone, Copy)]
pub(super) struct Promise {
    conditions: Conditions,
    peaks: EchoPeaks,
    path: PathModel,
    segment_s: f64,
    doppler: DopplerModel,
    /// Of the reference, which uses neither.
    is_exact: bool,
    /// Of what does not move: sum, culling, output.
    others: f64,
}

impl Promise {
    pub(super) fn new(candidate: &Candidate, conditions: Conditions, peaks: EchoPeaks) -> Self {
        let model = candidate.choice.model;
        let others = [Family::Sum, Family::Culling, Family::Output];
        let errors = others.map(|family| candidate.part(family).error);
        Self {
            conditions,
            peaks,
            path: model.path,
            segment_s: model.segment_s,
            doppler: model.doppler,
            is_exact: model.synthesis == Synthesis::Reference,
            others: errors.into_iter().fold(0.0, f64::hypot),
        }
    }

    /// Of a ping: its path model, and its predicted error. A path that is the operator's stays, and so does a selected one that keeps the
    /// tolerance.
    pub(super) fn of_ping(
        &self,
        spec: &SonarSpec,
        plan: &PingPlan,
        scatterers: &Scatterers,
        tolerance: f64,
    ) -> (PathModel, f64) {
        let bent = refraction_error(spec, plan, scatterers);
        if self.is_exact {
            return (self.path, self.others.hypot(bent));
        }
        let conditions = match scatterers.len() <= ALL {
            true => conditions(spec, plan, scatterers),
            false => echo_peaks(spec, plan, scatterers).scale(&self.peaks, self.conditions),
        };
        let conditions = Conditions {
            pulse: plan.pulse,
            segment_s: segment_step_s(plan.window_s(conditions.sample_rate_hz), self.segment_s),
            ..conditions
        };
        let error = |path: PathModel| {
            let doppler = doppler_error(self.doppler, path, &conditions);
            (path_error(path, &conditions) + bent + doppler).hypot(self.others)
        };
        let selected = error(self.path);
        if selected <= tolerance || !spec.synthesis.auto.path {
            return (self.path, selected);
        }
        // The chords of the elements cost a little more than those of the platform, the exact trajectory several times as much.
        let costlier = [PathModel::KSegment, PathModel::Continuous];
        let mut best = (self.path, selected);
        for path in costlier {
            if best.1 > tolerance && path != self.path {
                let other = error(path);
                if other < best.1 {
                    best = (path, other);
                }
            }
        }
        best
    }
}
