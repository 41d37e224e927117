//! Data rates of the outputs.

use super::super::spec::*;
use super::Derived;
use crate::check::sonar::BYTES_PER_7038_SAMPLE;

/// Bytes of one 16-bit complex sample (I and Q), and of one 16-bit real sample.
const IQ_BYTES: f64 = 4.0;
const REAL_BYTES: f64 = 2.0;
/// Bytes of one value of an MCAP message.
const FLOAT_BYTES: f64 = 4.0;
/// Bytes per detection of WBMS, per point of a Surveyor 240, and the most results of an Omniscan 450.
const BYTES_PER_DETECTION: f64 = 20.0;
const BYTES_PER_POINT: f64 = 16.0;
const PING_RESULTS: f64 = 1200.0;

/// Bytes per second of an output to one client, or to its file: of elements, lines or detections, and of the samples of beams. The answers of an Imagenex 872
/// depend on its client: 0.
pub(super) fn bytes_per_s(sonar: &SonarSpec, d: &Derived, output: &OutputSpec) -> [f64; 2] {
    let elements =
        |arrays: &[usize]| -> usize { arrays.iter().map(|&a| sonar.receive[a].elements).sum() };
    let beams = sonar.beams.fan.as_ref().map_or(0, |fan| fan.beams);
    let sides = sonar.beams.lines.len();
    let per_s = |channels: usize, bytes: f64| channels as f64 * d.samples * bytes * d.ping_rate_hz;
    let window_s = d.samples / sonar.receiver.sample_rate_hz;
    let of_samples = match output {
        OutputSpec::SevenK(output) => {
            let bytes = BYTES_PER_7038_SAMPLE;
            return [per_s(elements(&output.arrays), bytes), per_s(beams, bytes)];
        }
        OutputSpec::Jsf(output) => {
            let channels = match output.channels {
                JsfChannels::Sides => sides,
                JsfChannels::Staves => elements(&output.arrays),
            };
            match output.format {
                JsfFormat::Envelope => per_s(channels, REAL_BYTES),
                JsfFormat::Analytic | JsfFormat::Unfiltered => per_s(channels, IQ_BYTES),
            }
        }
        OutputSpec::Xtf(output) => per_s(sides, if output.is_float { 4.0 } else { REAL_BYTES }),
        OutputSpec::Imagenex872(_) => 0.0,
        OutputSpec::Vita49(output) => {
            let elements = elements(&output.arrays);
            match output.passband_rate_hz {
                Some(hz) => elements as f64 * REAL_BYTES * hz * window_s * d.ping_rate_hz,
                None => per_s(elements, IQ_BYTES),
            }
        }
        OutputSpec::Elements(output) => {
            let bytes = if output.is_float { 2.0 } else { 1.0 } * IQ_BYTES;
            per_s(elements(&output.arrays), bytes)
        }
        OutputSpec::Mcap(output) => {
            let elements: usize = sonar.receive.iter().map(|array| array.elements).sum();
            let complex = if output.elements { elements } else { 0 };
            let complex = complex + if output.beams { beams } else { 0 };
            let real = if output.image { beams } else { 0 };
            let real = real + if output.lines { sides } else { 0 };
            per_s(2 * complex + real, FLOAT_BYTES)
        }
        OutputSpec::Sigmf(output) => per_s(elements(&output.arrays), IQ_BYTES),
        OutputSpec::Wav(output) => {
            let bytes = if output.is_float { 4.0 } else { REAL_BYTES };
            elements(&output.arrays) as f64 * bytes * f64::from(output.rate_hz)
        }
        OutputSpec::Ping(output) => match output.device {
            PingDevice::Omniscan450 { .. } => PING_RESULTS * REAL_BYTES * d.ping_rate_hz,
            PingDevice::Surveyor240 => beams as f64 * BYTES_PER_POINT * d.ping_rate_hz,
        },
        OutputSpec::Wbms(_) => {
            let detections = beams as f64 * BYTES_PER_DETECTION * d.ping_rate_hz;
            return [detections, per_s(beams, REAL_BYTES)];
        }
    };
    [of_samples, 0.0]
}
