//! Records per second: encoding rate of each protocol family. `tools/soak --load` delivers records to several clients.
//!
//! Timed: from frames to complete records in their buffers, on one thread. Error: the worst of the samples read back, over full
//! scale (7k, XTF) or over the largest sample of the message (JSF).

use std::net::Ipv4Addr;
use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

use echotank_config::spec::{
    JsfChannels, JsfFormat, JsfSpec, PingDevice, PingProtocolSpec, SonarSpec, Vita49Spec, XtfSpec,
};
use echotank_core::ping::{Line, PingOutput, PingPlan, Side};
use echotank_emit::imagenex872::{Head, emit_ping as emit_imagenex};
use echotank_emit::jsf::{JsfEmitter, JsfSheet};
use echotank_emit::packets::Packets;
use echotank_emit::ping_protocol::{Device as PingDeviceState, PingEmitter};
use echotank_emit::session::Wants;
use echotank_emit::sevenk::records::DeviceSheet;
use echotank_emit::sevenk::{RecordSet, SevenKEmitter};
use echotank_emit::vita49::Vita49Emitter;
use echotank_emit::wbms::{Device as WbmsDevice, SubscribedPackets, WbmsEmitter};
use echotank_emit::xtf::XtfEmitter;
use echotank_protocols::jsf::{Message, SonarData80, message_type};
use echotank_protocols::sevenk::Record;
use echotank_protocols::sevenk::records::RawIq7038;
use echotank_protocols::vita49::{Packet, PacketType, complex_samples};

use crate::report::Report;
use echotank_testing::wire::{
    ABSORPTION_DB_PER_M, FULL_SCALE_V, SOUND_M_PER_S, TRANSMIT_UTC, large_output, large_sonar,
    output_spec, plan,
};

const ELEMENTS: usize = 256;
const SAMPLES: usize = 2000;

fn large() -> SonarSpec {
    large_sonar(ELEMENTS)
}

fn frames() -> PingOutput {
    let line = |side| Line {
        side,
        amplitude: (0..SAMPLES).map(|k| 0.001 * (k % 1009) as f32).collect(),
    };
    PingOutput {
        lines: vec![line(Side::Port), line(Side::Starboard)],
        ..large_output(ELEMENTS, SAMPLES)
    }
}

fn sevenk_sheet() -> Arc<DeviceSheet> {
    let mut spec = output_spec();
    spec.arrays = vec![0];
    Arc::new(DeviceSheet::new(
        &spec,
        &large(),
        SOUND_M_PER_S,
        ABSORPTION_DB_PER_M,
    ))
}

/// Runs `encode`, which returns the number of bytes, for a fixed time. Returns GB/s of the best of three, and the number of bytes.
fn rate(while_s: f64, mut encode: impl FnMut() -> usize) -> (f64, usize) {
    let once = encode();
    let mut best = 0.0_f64;
    for _ in 0..3 {
        let began = Instant::now();
        let mut bytes = 0;
        while began.elapsed().as_secs_f64() < while_s {
            bytes += encode();
        }
        best = best.max(bytes as f64 / began.elapsed().as_secs_f64() / 1e9);
    }
    (best, once)
}

/// Prints and records a line per family.
pub(crate) fn run(quick: bool, json: Option<&Path>) -> Result<(), String> {
    let mut report = Report::new();
    let while_s = if quick { 0.3 } else { 2.0 };
    let (plan, output) = (plan(1, SAMPLES), frames());
    let mut tell = |name: &str, error: f64, (speed, bytes): (f64, usize)| {
        report.row(
            &format!("{name}: error {error:.1e}, {speed:.2} GB/s, {bytes} B"),
            serde_json::json!({ "family": name, "error": error, "gb_per_s": speed, "bytes": bytes }),
        );
    };

    let mut emitter = SevenKEmitter::new(sevenk_sheet(), 1);
    for id in [7038, 7018, 7042, 7007] {
        let mut records = Vec::new();
        let measured = rate(while_s, || {
            records.clear();
            emitter.emit_ping(&plan, &output, RecordSet::of(&[id]), &mut records);
            records[0].bytes.len()
        });
        let error = match id {
            7038 => error_7038(&records[0].bytes, &output)?,
            // Half a count of 65535, from rounding to nearest.
            _ => 0.5 / 65_535.0,
        };
        tell(&format!("7k {id}"), error, measured);
    }

    for (name, channels, format) in [
        (
            "jsf 80 format 0, sides",
            JsfChannels::Sides,
            JsfFormat::Envelope,
        ),
        (
            "jsf 80 format 9, staves",
            JsfChannels::Staves,
            JsfFormat::Unfiltered,
        ),
    ] {
        let sheet = JsfSheet {
            output: jsf(channels, format),
            sonar: large(),
        };
        let mut emitter = JsfEmitter::new(Arc::new(sheet), Box::new(|_, _| {}));
        let mut messages = Vec::new();
        let measured = rate(while_s, || {
            messages.clear();
            emitter.emit_ping(&plan, &output, |_, _| true, &mut messages);
            messages.iter().map(|m| m.bytes.len()).sum()
        });
        let error = error_80(&messages.last().ok_or("no message")?.bytes, &output, format)?;
        tell(name, error, measured);
    }

    let mut emitter = XtfEmitter::new(&XtfSpec { is_float: false }, &large(), SOUND_M_PER_S);
    let mut packets = Vec::new();
    let measured = rate(while_s, || {
        packets.clear();
        emitter.emit_ping(&plan, &output, &mut packets);
        packets.len()
    });
    tell("xtf u16", 0.5 / 65_535.0, measured);
    devices(while_s, &plan, &output, &mut tell)?;

    report.finish(json)
}

/// Lines of VITA 49, WBMS, the Ping protocol and Imagenex 872.
fn devices(
    while_s: f64,
    plan: &PingPlan,
    output: &PingOutput,
    tell: &mut impl FnMut(&str, f64, (f64, usize)),
) -> Result<(), String> {
    let sonar = large();
    let boards = Vita49Spec {
        send_to: Vec::new(),
        arrays: vec![0],
        passband_rate_hz: None,
        is_vector: false,
        first_stream: 1,
        max_packet: 1472,
        pace_bytes_per_s: 1e9,
        multicast_interface: Ipv4Addr::LOCALHOST,
        multicast_ttl: 1,
    };
    let mut emitter = Vita49Emitter::new(&boards, &sonar);
    let mut packets = Packets::default();
    let measured = rate(while_s, || {
        emitter.emit_ping(plan, output, false, &mut packets);
        packets.len_bytes()
    });
    let error = error_vita49(&packets, output)?;
    tell("vita49, a stream an element", error, measured);

    let mut emitter = WbmsEmitter::new(Arc::new(WbmsDevice::new(&sonar, SOUND_M_PER_S)), 1);
    let wanted = SubscribedPackets {
        bathymetry: false,
        water_column: true,
        side_scan: false,
    };
    let mut sent = Vec::new();
    let measured = rate(while_s, || {
        sent.clear();
        emitter.emit_ping(plan, output, wanted, &mut sent);
        sent[0].bytes.len()
    });
    // Half a count of 32767.
    tell("wbms water column", 0.5 / 32_767.0, measured);

    let spec = PingProtocolSpec {
        device: PingDevice::Omniscan450 { side: Side::Port },
        listen: ([127, 0, 0, 1], 0).into(),
        serial: None,
        channel: (0, 1),
        client_queue_bytes: 0,
        max_clients: 0,
    };
    let device = PingDeviceState::new(&spec, &sonar, SOUND_M_PER_S, TRANSMIT_UTC);
    let mut emitter = PingEmitter::new(Arc::new(device), 1);
    let mut sent = Vec::new();
    let measured = rate(while_s, || {
        sent.clear();
        emitter.emit_ping(plan, output, &mut sent);
        sent[0].bytes.len()
    });
    // Relative to the span in dB.
    tell("ping 2198", 0.5 / 65_535.0, measured);

    let head = Head::default();
    let (mut sent, scale) = (Vec::new(), (sonar.receiver.sample_rate_hz, FULL_SCALE_V));
    let measured = rate(while_s, || {
        sent.clear();
        emit_imagenex(&head, plan, output, scale, Wants::ALL, &mut sent);
        sent.iter().map(|answer| answer.bytes.len()).sum()
    });
    tell("imagenex 872, two sides", 0.5 / 255.0, measured);
    Ok(())
}

/// Worst error of samples read back, over full scale.
fn error_vita49(packets: &Packets, output: &PingOutput) -> Result<f64, String> {
    let mut next = vec![0; ELEMENTS];
    let mut worst = 0.0_f64;
    for bytes in packets.iter() {
        let packet = Packet::parse(bytes).map_err(|e| e.to_string())?;
        if packet.packet_type == PacketType::Context {
            continue;
        }
        let element = packet.stream_id as usize - 1;
        for [i, q] in complex_samples(packet.payload) {
            let want = output.elements[0].element(element)[next[element]];
            let volt = |count: i16| f64::from(count) / 32_767.0 * FULL_SCALE_V;
            let off = (volt(i) - want.re).abs().max((volt(q) - want.im).abs());
            worst = worst.max(off / FULL_SCALE_V);
            next[element] += 1;
        }
    }
    match next.iter().all(|&count| count == SAMPLES) {
        true => Ok(worst),
        false => Err("samples are missing".into()),
    }
}

fn jsf(channels: JsfChannels, format: JsfFormat) -> JsfSpec {
    JsfSpec {
        listen: ([127, 0, 0, 1], 0).into(),
        listen_data: ([127, 0, 0, 1], 0).into(),
        subsystem: 40,
        silent_subsystems: Vec::new(),
        channels,
        arrays: vec![0],
        format,
        record: false,
        client_queue_bytes: 0,
        max_clients: 0,
    }
}

fn error_7038(bytes: &[u8], output: &PingOutput) -> Result<f64, String> {
    let record = Record::parse(bytes).map_err(|e| e.to_string())?;
    let raw = RawIq7038::parse(record.body()).map_err(|e| e.to_string())?;
    let mut worst = 0.0_f64;
    for e in 0..ELEMENTS {
        for (k, v) in output.elements[0].element(e).iter().enumerate() {
            let [i, q] = raw.iq(k as u32, e as u16).ok_or("a sample is missing")?;
            let volt = |count: i16| f64::from(count) / 32_767.0 * FULL_SCALE_V;
            let off = (volt(i) - v.re).abs().max((volt(q) - v.im).abs());
            worst = worst.max(off / FULL_SCALE_V);
        }
    }
    Ok(worst)
}

/// Values of the last channel.
fn error_80(bytes: &[u8], output: &PingOutput, format: JsfFormat) -> Result<f64, String> {
    let message = Message::parse(bytes).map_err(|e| e.to_string())?;
    if message.header.message_type != message_type::SONAR_DATA {
        return Err("the last message is not sonar data".into());
    }
    let data = SonarData80::parse(message.body).map_err(|e| e.to_string())?;
    let want: Vec<f64> = match format {
        JsfFormat::Envelope => output.lines[1]
            .amplitude
            .iter()
            .map(|&v| f64::from(v))
            .collect(),
        _ => output.elements[0]
            .element(ELEMENTS - 1)
            .iter()
            .flat_map(|v| [v.re, v.im])
            .collect(),
    };
    let largest = want.iter().fold(0.0_f64, |m, v| m.max(v.abs()));
    let off = data
        .values()
        .zip(&want)
        .map(|(got, want)| (got - want).abs());
    Ok(off.fold(0.0, f64::max) / largest)
}
