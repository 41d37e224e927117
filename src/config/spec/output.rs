//! Result of the synthesis: element samples or side-scan lines.

use super::{OutputSpec, SonarSpec, SynthesisSpec};
use echotank_core::model::{PathModel, Synthesis};

/// Result of a sonar's synthesis.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum SynthesisOutput {
    /// Samples of every element of every array.
    #[default]
    Elements,
    /// Only side-scan lines, from groups of elements that the method selection chooses.
    Beams,
    /// The cheaper result that meets the tolerance.
    Auto,
}

impl SynthesisSpec {
    /// Whether the method selection chooses any method.
    pub fn selects_methods(&self) -> bool {
        self.auto.any() || self.output != SynthesisOutput::Elements
    }
}

impl SonarSpec {
    /// Outputs that have element samples, always or on request.
    pub fn element_readers(&self) -> Vec<&'static str> {
        let of = |output: &OutputSpec| match output {
            OutputSpec::SevenK(sevenk) => (!sevenk.arrays.is_empty()).then_some("7k (7038)"),
            OutputSpec::Jsf(_) => Some("JSF"),
            OutputSpec::Vita49(_) => Some("VITA 49"),
            OutputSpec::Elements(_) => Some("elements"),
            OutputSpec::Sigmf(_) => Some("SigMF"),
            OutputSpec::Mcap(mcap) => mcap.elements.then_some("MCAP"),
            OutputSpec::Wav(_) => Some("WAV"),
            OutputSpec::Xtf(_)
            | OutputSpec::Imagenex872(_)
            | OutputSpec::Ping(_)
            | OutputSpec::Wbms(_) => None,
        };
        self.outputs.iter().filter_map(of).collect()
    }

    /// Reason why the sonar requires elements. `None` if only side-scan lines with fixed weights are used.
    pub(crate) fn needs_elements(&self) -> Option<&'static str> {
        let beams = &self.beams;
        let lines = |array: usize| beams.lines.iter().any(|line| line.array == array);
        let any = |elements: usize| self.receive.iter().any(|a| a.elements % elements != 0);
        let least = self.receive.iter().map(|a| a.elements).min().unwrap_or(0);
        let fixed = !self.synthesis.auto.synthesis;
        let unsuited = matches!(
            self.model.synthesis,
            Synthesis::Reference | Synthesis::Gridded2d | Synthesis::GriddedLines
        );
        Some(if !self.element_readers().is_empty() {
            "an output carries them"
        } else if beams.fan.is_some() {
            "a fan is formed from them"
        } else if beams.synthetic_aperture.is_some() {
            "a synthetic aperture is computed from them"
        } else if !(0..self.receive.len()).all(lines) {
            "an array has no side-scan line"
        } else if beams.focused_lines {
            "focused lines have different weights at every range"
        } else if !self.more_pulses.is_empty() {
            "each of several pulses is filtered separately"
        } else if self.receiver.adc_bits.is_some() {
            "each has its own A/D converter"
        } else if self.instrument.is_some() {
            "sonar.instrument acts on single elements"
        } else if (2..=least).all(any) {
            "the arrays cannot be divided into equal parts"
        } else if fixed && unsuited {
            "the configured synthesis computes whole lines or is the reference"
        } else if !self.synthesis.auto.path && self.model.path == PathModel::Polyline {
            "the attitude steps of a polyline would break up a part"
        } else {
            return None;
        })
    }
}
