//! Checks `run.overload`.

use super::super::spec::*;
use crate::keys;
use crate::raw::Problems;

/// Refuses `degrade` without a tolerance that can be increased, and `stretch` without an internal trigger.
pub(crate) fn refuse_overload_conflicts(
    run: &keys::Run,
    sonars: &[&SonarSpec],
    problems: &mut Problems,
) {
    let entry = &run.overload;
    for sonar in sonars {
        let name = &sonar.name;
        match run.overload.text() {
            Some("degrade") if sonar.looser_tolerances().is_empty() => {
                let rule = format!(
                    "sonar {name} has no looser tolerance: model.synthesis must be \"gridded-1d\", \"gridded-lines\", \"gridded-2d\" or \"auto\", and model.tolerance below 0.1"
                );
                problems.refuse(entry, rule);
            }
            Some("stretch") if sonar.trigger.from.is_wired() => {
                let rule = format!(
                    "an external trigger starts the pulses of sonar {name}, so they cannot be delayed"
                );
                problems.refuse(entry, rule);
            }
            _ => {}
        }
    }
}
