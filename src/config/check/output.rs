//! Checks whether pings of a sonar can be computed without element samples.

use super::Problems;
use crate::keys;
use crate::spec::{ControlSpec, FaultKind, FaultRequest, SonarSpec, SynthesisOutput};

/// Records why elements are required, and refuses model.output = "beams" in that case.
pub(super) fn note_element_needs(
    sonar: &mut SonarSpec,
    table: &keys::Sonar,
    control: Option<&ControlSpec>,
    faults: &[FaultRequest],
    problems: &mut Problems,
) {
    let of_elements = |request: &FaultRequest| {
        let here = request
            .sonar
            .as_ref()
            .is_none_or(|name| *name == sonar.name);
        let kind = request.checked().map(|fault| fault.kind);
        here && matches!(kind, Ok(FaultKind::Element { .. }))
    };
    let of_rig = if faults.iter().any(of_elements) {
        Some("the configuration contains an element fault")
    } else if control.is_some_and(|control| control.listen.is_some()) {
        Some("[control] shows elements and can inject faults into them")
    } else {
        None
    };
    sonar.synthesis.elements_for = sonar.needs_elements().or(of_rig);
    if let (SynthesisOutput::Beams, Some(why)) =
        (sonar.synthesis.output, sonar.synthesis.elements_for)
        && let Some(model) = table.model.as_ref()
    {
        let rule = format!("must be \"elements\" or \"auto\": {why}");
        problems.refuse(&model.output, rule);
    }
}
