//! Summary of the outputs and their data rates.

use std::fmt;

use super::super::spec::*;
use super::{Derived, line};

/// Bytes of one 16-bit complex sample (I and Q), and of one 16-bit real sample.
const IQ_BYTES: f64 = 4.0;
const REAL_BYTES: f64 = 2.0;
/// Bytes per detection of WBMS.
const BYTES_PER_DETECTION: f64 = 20.0;

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
    let on_air = d.samples / rate_hz * d.ping_rate_hz;
    let mbit_per_s = |bytes_per_s: f64| bytes_per_s * 8.0 / 1e6;
    match output {
        OutputSpec::SevenK(_)
        | OutputSpec::Jsf(_)
        | OutputSpec::Xtf(_)
        | OutputSpec::Imagenex872(_) => Ok(()),
        OutputSpec::Vita49(vita) => {
            let n = elements(&vita.arrays);
            let (what, bytes_per_s) = match vita.passband_rate_hz {
                Some(hz) => (
                    format!("passband at {} kHz", hz / 1e3),
                    n as f64 * REAL_BYTES * hz * on_air,
                ),
                None => (
                    format!("I and Q at {} kHz", rate_hz / 1e3),
                    n as f64 * IQ_BYTES * rate_hz * on_air,
                ),
            };
            let to: Vec<_> = vita.send_to.iter().map(ToString::to_string).collect();
            let streams = if vita.is_vector {
                "one stream"
            } else {
                "a stream each"
            };
            let text = format!(
                "UDP to {}: {n} elements, {streams}, {what}, {:.2} Mbit/s, at most {} Mbit/s",
                to.join(", "),
                mbit_per_s(bytes_per_s),
                mbit_per_s(vita.pace_bytes_per_s),
            );
            line(out, "  vita49", &text)
        }
        OutputSpec::Elements(stream) => {
            let n = elements(&stream.arrays);
            let bytes = if stream.is_float { 2.0 } else { 1.0 } * IQ_BYTES;
            let udp: String = stream
                .send_to
                .iter()
                .map(|to| format!(", UDP {to}"))
                .collect();
            let text = format!(
                "TCP {}{udp}: {n} elements, {:.2} Mbit/s to each",
                stream.listen,
                mbit_per_s(n as f64 * bytes * rate_hz * on_air),
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
            let beams = sonar.beams.fan.as_ref().map_or(0, |fan| fan.beams);
            let text = format!(
                "TCP {} control, then bathymetry {:.2} Mbit/s, water column {:.2} Mbit/s, side-scan or snippets to each client",
                wbms.listen,
                mbit_per_s(beams as f64 * BYTES_PER_DETECTION * d.ping_rate_hz),
                mbit_per_s(beams as f64 * REAL_BYTES * rate_hz * on_air),
            );
            line(out, "  wbms", &text)
        }
        OutputSpec::Sigmf(sigmf) => {
            let n = elements(&sigmf.arrays);
            let text = format!(
                "{n} elements, {:.2} MB/s",
                n as f64 * IQ_BYTES * rate_hz * on_air / 1e6
            );
            line(out, "  sigmf", &text)
        }
        OutputSpec::Wav(wav) => {
            let n = elements(&wav.arrays);
            let bytes = if wav.is_float { 4.0 } else { 2.0 };
            let text = format!(
                "{n} channels at {} Hz, {:.2} MB/s",
                wav.rate_hz,
                n as f64 * bytes * f64::from(wav.rate_hz) / 1e6
            );
            line(out, "  wav", &text)
        }
    }
}
