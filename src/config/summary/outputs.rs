//! Summary of the outputs and their data rates.

use std::fmt;

use super::super::spec::*;
use super::rates::bytes_per_s;
use super::{Derived, line, mbit_per_s};

/// Writes the line of an output of these kinds. Other functions write the other outputs.
pub(super) fn write(
    out: &mut String,
    sonar: &SonarSpec,
    d: &Derived,
    output: &OutputSpec,
) -> fmt::Result {
    let elements =
        |arrays: &[usize]| -> usize { arrays.iter().map(|&a| sonar.receive[a].elements).sum() };
    let rate_hz = sonar.receiver.sample_rate_hz;
    let rates = bytes_per_s(sonar, d, output);
    let [mbit_per_s, of_beams] = rates.map(mbit_per_s);
    match output {
        OutputSpec::SevenK(_)
        | OutputSpec::Jsf(_)
        | OutputSpec::Xtf(_)
        | OutputSpec::Imagenex872(_) => Ok(()),
        OutputSpec::Vita49(vita) => {
            let n = elements(&vita.arrays);
            let what = match vita.passband_rate_hz {
                Some(hz) => format!("passband at {} kHz", hz / 1e3),
                None => format!("I and Q at {} kHz", rate_hz / 1e3),
            };
            let to: Vec<_> = vita.send_to.iter().map(ToString::to_string).collect();
            let streams = if vita.is_vector {
                "one stream"
            } else {
                "a stream each"
            };
            let text = format!(
                "UDP to {}: {n} elements, {streams}, {what}, {mbit_per_s:.2} Mbit/s, at most {} Mbit/s",
                to.join(", "),
                vita.pace_bytes_per_s * 8.0 / 1e6,
            );
            line(out, "  vita49", &text)
        }
        OutputSpec::Elements(stream) => {
            let n = elements(&stream.arrays);
            let udp: String = stream
                .send_to
                .iter()
                .map(|to| format!(", UDP {to}"))
                .collect();
            let text = format!(
                "TCP {}{udp}: {n} elements, {mbit_per_s:.2} Mbit/s to each",
                stream.listen,
            );
            line(out, "  elements", &text)
        }
        OutputSpec::Ping(ping) => {
            let serial = match &ping.serial {
                Some((path, baud)) => format!(", {path} at {baud} Bd"),
                None => String::new(),
            };
            let text = format!(
                "{}, TCP and UDP {}{serial}",
                ping.device.name(),
                ping.listen
            );
            line(out, "  ping", &text)
        }
        OutputSpec::Wbms(wbms) => {
            let text = format!(
                "TCP {} control, then bathymetry {mbit_per_s:.2} Mbit/s, water column {of_beams:.2} Mbit/s, side-scan or snippets to each client",
                wbms.listen,
            );
            line(out, "  wbms", &text)
        }
        OutputSpec::Sigmf(sigmf) => {
            let n = elements(&sigmf.arrays);
            let text = format!("{n} elements, {:.2} MB/s", rates[0] / 1e6);
            line(out, "  sigmf", &text)
        }
        OutputSpec::Mcap(_) => {
            let text = format!("ROS 2 messages, {:.2} MB/s", rates[0] / 1e6);
            line(out, "  mcap", &text)
        }
        OutputSpec::Wav(wav) => {
            let n = elements(&wav.arrays);
            let text = format!(
                "{n} channels at {} Hz, {:.2} MB/s",
                wav.rate_hz,
                rates[0] / 1e6
            );
            line(out, "  wav", &text)
        }
    }
}
