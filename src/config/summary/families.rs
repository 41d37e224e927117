//! Summary of the side-scan formats JSF, XTF and Imagenex 872.

use std::fmt;

use super::super::spec::*;
use super::{Derived, line};

pub(super) fn write(
    out: &mut String,
    sonar: &SonarSpec,
    d: &Derived,
    output: &OutputSpec,
) -> fmt::Result {
    let mbit_per_s = |channels: usize, sample_bytes: usize| {
        channels as f64 * d.samples * sample_bytes as f64 * d.ping_rate_hz * 8.0 / 1e6
    };
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
            let (format, bytes) = match output.format {
                JsfFormat::Envelope => ("envelope", 2),
                JsfFormat::Analytic => ("analytic", 4),
                JsfFormat::Unfiltered => ("unfiltered analytic", 4),
            };
            let text = format!(
                "commands TCP {}, data TCP {}; subsystem {}, {channels} channels, a {what} each, {format}: {:.2} Mbit/s to each client{}",
                output.listen,
                output.listen_data,
                output.subsystem,
                mbit_per_s(channels, bytes),
                if output.record { "; recorded" } else { "" },
            );
            line(out, "  jsf", &text)
        }
        OutputSpec::Xtf(output) => line(
            out,
            "  xtf",
            &format!(
                "a file of {sides} channels, {:.2} Mbit/s",
                mbit_per_s(sides, if output.is_float { 4 } else { 2 })
            ),
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
