//! Summary of the side-scan formats JSF, XTF and Imagenex 872.

use std::fmt;

use super::super::spec::*;
use super::rates::bytes_per_s;
use super::{Derived, line};

pub(super) fn write(
    out: &mut String,
    sonar: &SonarSpec,
    d: &Derived,
    output: &OutputSpec,
) -> fmt::Result {
    let mbit_per_s = bytes_per_s(sonar, d, output)[0] * 8.0 / 1e6;
    let sides = sonar.beams.lines.len();
    match output {
        OutputSpec::Jsf(output) => {
            let (channels, what) = match output.channels {
                JsfChannels::Sides => (sides, "side"),
                JsfChannels::Staves => (
                    output
                        .arrays
                        .iter()
                        .map(|&a| sonar.receive[a].elements)
                        .sum(),
                    "element",
                ),
            };
            let format = match output.format {
                JsfFormat::Envelope => "envelope",
                JsfFormat::Analytic => "analytic",
                JsfFormat::Unfiltered => "unfiltered analytic",
            };
            let text = format!(
                "commands TCP {}, data TCP {}; subsystem {}, {channels} channels, a {what} each, {format}: {mbit_per_s:.2} Mbit/s to each client{}",
                output.listen,
                output.listen_data,
                output.subsystem,
                if output.record { "; recorded" } else { "" },
            );
            line(out, "  jsf", &text)
        }
        OutputSpec::Xtf(_) => line(
            out,
            "  xtf",
            &format!("a file of {sides} channels, {mbit_per_s:.2} Mbit/s"),
        ),
        OutputSpec::Imagenex872(output) => line(
            out,
            "  imagenex",
            &format!("TCP {}, 1000 points per side and command", output.listen),
        ),
        // Other functions write the other outputs.
        _ => Ok(()),
    }
}
