//! Checks outputs of samples.

use super::super::spec::*;
use super::arrays::Arrays;
use super::{Listener, listen};
use crate::keys;
use crate::raw::{Field, Problems};
use echotank_core::pulse::Pulse;
use echotank_protocols::elements::{HEADER_BYTES, SampleType};

/// Length of header and trailer of a VITA 49 packet, bytes.
const VRT_AROUND_BYTES: usize = 24;
/// Maximum number of WAV channels: WAV has 16-bit fields for the number of channels and for the bytes of a frame.
const MAX_WAV_CHANNELS: usize = 16_383;
/// Maximum number of elements of a VITA 49 vector: the field has 16 bits.
const MAX_VECTOR: usize = 65_536;

/// Arrays and pulse of the samples.
#[derive(Clone, Copy)]
pub(super) struct Source<'a> {
    pub arrays: &'a Arrays<'a>,
    pub pulse: Option<&'a Pulse>,
}

impl Source<'_> {
    fn elements(&self, chosen: &[usize]) -> usize {
        chosen
            .iter()
            .filter_map(|&array| self.arrays.specs.get(array)?.as_ref())
            .map(|array| array.elements)
            .sum()
    }

    fn highest_hz(&self) -> Option<f64> {
        self.pulse
            .map(|pulse| pulse.center_frequency_hz + 0.5 * pulse.bandwidth_hz)
    }

    /// The passband sample rate, Hz. A rate at or below twice the highest frequency is refused.
    fn passband_rate_hz(&self, key: &Field<f64>, problems: &mut Problems) -> Option<f64> {
        let rate_hz = key.get()?;
        if let Some(highest_hz) = self.highest_hz()
            && rate_hz <= 2.0 * highest_hz
        {
            let rule = format!(
                "must be above twice the highest frequency, {} kHz",
                highest_hz / 1e3
            );
            problems.refuse(key, rule);
            return None;
        }
        Some(rate_hz)
    }
}

pub(super) fn vita49(
    table: &keys::samples::Vita49,
    source: Source<'_>,
    problems: &mut Problems,
) -> Option<Vita49Spec> {
    let arrays = source.arrays.chosen(&table.arrays, problems);
    let is_vector = table.streams.is("vector");
    let passband_rate_hz = match table.samples.is("passband")? {
        true => Some(source.passband_rate_hz(&table.passband_rate_khz, problems)?),
        false => None,
    };
    let max_packet = table.max_packet_bytes.to::<usize>()? / 4 * 4;
    if let Some(arrays) = &arrays {
        let side_by_side = match is_vector? {
            true => source.elements(arrays),
            false => 1,
        };
        // Two frames of 2-byte samples take as many words as one frame of I and Q.
        let needed = VRT_AROUND_BYTES + 4 * side_by_side;
        if max_packet < needed || side_by_side > MAX_VECTOR {
            let rule =
                format!("must hold one sample of {side_by_side} elements: at least {needed}");
            problems.refuse(&table.max_packet_bytes, rule);
        }
        let last = table.first_stream.get()? + source.elements(arrays) as i64;
        if last > i64::from(u32::MAX) {
            problems.refuse(
                &table.first_stream,
                "must be low enough that every element has a stream number below 2^32",
            );
        }
    }
    let send_to = destinations(&table.send_to, problems);
    let interface = table.multicast_interface.text()?.parse();
    if interface.is_err() {
        let rule = "must be an address, such as \"192.168.1.10\"";
        problems.refuse(&table.multicast_interface, rule);
    }
    Some(Vita49Spec {
        send_to: send_to?,
        arrays: arrays?,
        passband_rate_hz,
        is_vector: is_vector?,
        first_stream: table.first_stream.to()?,
        max_packet,
        pace_bytes_per_s: table.pace_mbit_per_s.get()? * 1e6 / 8.0,
        multicast_interface: interface.ok()?,
        multicast_ttl: table.multicast_ttl.to()?,
    })
}

fn destinations(
    send_to: &Field<String>,
    problems: &mut Problems,
) -> Option<Vec<std::net::SocketAddr>> {
    let parsed: Result<Vec<_>, _> = send_to
        .text()?
        .split(',')
        .map(|word| word.trim().parse())
        .collect();
    if parsed.is_err() {
        let rule = "must be addresses and ports with commas between them, such as \"127.0.0.1:4991, 239.1.2.3:4991\"";
        problems.refuse(send_to, rule);
    }
    parsed.ok()
}

pub(super) fn elements<'t>(
    table: &'t keys::samples::Elements,
    source: Source<'_>,
    listeners: &mut Vec<Listener<'t>>,
    problems: &mut Problems,
) -> Option<ElementStreamSpec> {
    let listen = listen(&table.listen, "TCP", listeners, problems);
    let arrays = source.arrays.chosen(&table.arrays, problems);
    let is_float = table.sample.text()? == "f32";
    let max_packet = table.max_packet_bytes.to()?;
    let send_to = match table.send_to.given {
        true => destinations(&table.send_to, problems),
        false => Some(Vec::new()),
    };
    if let Some(arrays) = &arrays {
        let elements = source.elements(arrays);
        let sample = if is_float {
            SampleType::F32
        } else {
            SampleType::I16
        };
        let needed = HEADER_BYTES + sample.bytes() * elements;
        if elements > usize::from(u16::MAX) {
            let rule = format!("{elements} elements; a frame holds at most {}", u16::MAX);
            problems.refuse(&table.arrays, rule);
        } else if table.send_to.given && max_packet < needed {
            let rule = format!("must hold one sample of {elements} elements: at least {needed}");
            problems.refuse(&table.max_packet_bytes, rule);
        }
    }
    Some(ElementStreamSpec {
        listen: listen?,
        send_to: send_to?,
        arrays: arrays?,
        is_float,
        max_packet,
        pace_bytes_per_s: table.pace_mbit_per_s.get()? * 1e6 / 8.0,
        client_queue_bytes: table.client_queue_mib.to()?,
        max_clients: table.max_clients.to()?,
    })
}

pub(super) fn sigmf(
    table: &keys::samples::Sigmf,
    source: Source<'_>,
    problems: &mut Problems,
) -> Option<SigmfSpec> {
    Some(SigmfSpec {
        arrays: source.arrays.chosen(&table.arrays, problems)?,
    })
}

pub(super) fn mcap(table: &keys::samples::Mcap) -> Option<McapSpec> {
    let chosen = table.messages.as_ref()?;
    let has = |name: &str| chosen.iter().any(|of| of == name);
    Some(McapSpec {
        elements: has("elements"),
        beams: has("beams"),
        image: has("image"),
        lines: has("lines"),
        soundings: has("soundings"),
    })
}

pub(super) fn wav(
    table: &keys::samples::Wav,
    source: Source<'_>,
    problems: &mut Problems,
) -> Option<WavSpec> {
    let arrays = source.arrays.chosen(&table.arrays, problems);
    if let Some(arrays) = &arrays {
        let channels = source.elements(arrays);
        if channels > MAX_WAV_CHANNELS {
            let rule = format!(
                "{channels} elements; a WAV file holds at most {MAX_WAV_CHANNELS} channels"
            );
            problems.refuse(&table.arrays, rule);
        }
    }
    let rate_hz = match table.rate_khz.given {
        true => source.passband_rate_hz(&table.rate_khz, problems)?.round() as u32,
        false => WavSpec::usual_rate_hz(source.highest_hz()?),
    };
    Some(WavSpec {
        arrays: arrays?,
        rate_hz,
        is_float: table.sample.text()? == "f32",
    })
}
