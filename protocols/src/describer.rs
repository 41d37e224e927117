//! Description of messages of any format as text, one line per message. The text is for people and is the oracle of the fuzzers. A
//! description never fails or panics: errors in the bytes are part of the text.

use std::fmt;

use crate::WireError;
use crate::framing::{Framing, Splitter};
use crate::imagenex872::{EitherFraming, SwitchCommand, parse_answer};
use crate::jsf::{self, JsfFraming};
use crate::ping_protocol::{Frame, Message, PingFraming};
use crate::sevenk::{self, Reassembler, StreamDecoder, file::FileReader};
use crate::sigmf::Recording;
use crate::vita49::{self, Context, PacketType, complex_samples, real_samples};
use crate::wav::WavHeader;
use crate::wbms::{self, Backscatter, Bathymetry, WbmsFraming, packet_type};
use crate::xtf::{self, FileHeader, Ping, XtfFraming};

/// Header size for up to six channels; files with more channels have a longer header.
const XTF_HEADER_BYTES: usize = 1024;
/// Maximum size of a 7k record.
const MAX_7K_RECORD_BYTES: u32 = 1 << 26;

/// Format of the bytes to describe.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Format {
    /// 7k connection: records in network frames.
    SevenK,
    /// 7k file.
    S7k,
    /// EdgeTech JSF.
    Jsf,
    /// ANSI/VITA 49.2.
    Vita49,
    /// Blue Robotics and Cerulean Ping protocol.
    PingProtocol,
    /// NORBIT WBMS packets.
    Wbms,
    /// NORBIT WBMS text control.
    WbmsText,
    /// Triton XTF file.
    Xtf,
    /// Imagenex 872.
    Imagenex872,
    /// SigMF metadata.
    Sigmf,
    /// WAV or RF64 file.
    Wav,
}

impl Format {
    /// All formats.
    pub const ALL: [Self; 11] = [
        Self::SevenK,
        Self::S7k,
        Self::Jsf,
        Self::Vita49,
        Self::PingProtocol,
        Self::Wbms,
        Self::WbmsText,
        Self::Xtf,
        Self::Imagenex872,
        Self::Sigmf,
        Self::Wav,
    ];

    /// Name of the format in commands.
    pub fn name(self) -> &'static str {
        match self {
            Self::SevenK => "sevenk",
            Self::S7k => "s7k",
            Self::Jsf => "jsf",
            Self::Vita49 => "vita49",
            Self::PingProtocol => "ping",
            Self::Wbms => "wbms",
            Self::WbmsText => "wbms-text",
            Self::Xtf => "xtf",
            Self::Imagenex872 => "imagenex872",
            Self::Sigmf => "sigmf",
            Self::Wav => "wav",
        }
    }

    /// The format with this name.
    pub fn of_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|format| format.name() == name)
    }

    /// The format commonly used on a port.
    pub fn of_port(port: u16) -> Option<Self> {
        Some(match port {
            7000 => Self::SevenK,
            1700 | 1701 => Self::Jsf,
            vita49::PORT => Self::Vita49,
            crate::ping_protocol::PORT => Self::PingProtocol,
            wbms::CONTROL_PORT => Self::WbmsText,
            wbms::BATHYMETRY_PORT..=wbms::SIDE_SCAN_PORT => Self::Wbms,
            4040 => Self::Imagenex872,
            _ => return None,
        })
    }

    /// The format of a file or connection, from the marks at its front.
    pub fn of_bytes(bytes: &[u8]) -> Option<Self> {
        let starts = |mark: &[u8]| bytes.starts_with(mark);
        if starts(b"BR") {
            Some(Self::PingProtocol)
        } else if starts(&[0x01, 0x16]) {
            Some(Self::Jsf)
        } else if starts(&0xDEAD_BEEF_u32.to_le_bytes()) {
            Some(Self::Wbms)
        } else if starts(b"RIFF") || starts(b"RF64") {
            Some(Self::Wav)
        } else if bytes.first() == Some(&0x7B) && bytes.get(1).is_some_and(|&b| b != b'\n') {
            Some(Self::Xtf)
        } else if bytes.first() == Some(&b'{') {
            Some(Self::Sigmf)
        } else if starts(&[0xFE, 0x44]) || starts(b"IMX") {
            Some(Self::Imagenex872)
        } else if bytes.get(4..8) == Some(&0xFFFF_u32.to_le_bytes()) {
            Some(Self::S7k)
        } else if bytes.get(..4) == Some(&[5, 0, 36, 0]) {
            Some(Self::SevenK)
        } else if vita49::Packet::parse(bytes).is_ok() {
            Some(Self::Vita49)
        } else {
            None
        }
    }
}

impl fmt::Display for Format {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// Incremental description of a connection or file, message by message.
pub struct MessageDescriber {
    state: State,
}

enum State {
    SevenK(Box<StreamDecoder>),
    Jsf(Splitter<JsfFraming>),
    Ping(Splitter<PingFraming>),
    Wbms(Splitter<WbmsFraming>),
    Imagenex(Splitter<EitherFraming>),
    /// Bytes of the file until its header is complete, then the header.
    Xtf(Vec<u8>, Option<FileHeader>, Splitter<XtfFraming>),
    /// Start of a line whose end has not arrived.
    WbmsText(Vec<u8>),
    /// Formats that are parsed as a whole.
    Whole(Format, Vec<u8>),
}

impl MessageDescriber {
    /// An empty input in this format.
    pub fn new(format: Format) -> Self {
        let state = match format {
            Format::SevenK => State::SevenK(Box::new(StreamDecoder::new(MAX_7K_RECORD_BYTES))),
            Format::Jsf => State::Jsf(Splitter::new(JsfFraming::default())),
            Format::PingProtocol => State::Ping(Splitter::new(PingFraming)),
            Format::Wbms => State::Wbms(Splitter::new(WbmsFraming)),
            Format::Imagenex872 => State::Imagenex(Splitter::new(EitherFraming)),
            Format::Xtf => State::Xtf(Vec::new(), None, Splitter::new(XtfFraming::default())),
            Format::WbmsText => State::WbmsText(Vec::new()),
            Format::S7k | Format::Vita49 | Format::Sigmf | Format::Wav => {
                State::Whole(format, Vec::new())
            }
        };
        Self { state }
    }

    /// Adds bytes and passes a line for every message and every gap to `each`.
    pub fn push(&mut self, bytes: &[u8], each: &mut dyn FnMut(String)) {
        match &mut self.state {
            State::SevenK(decoder) => decoder.feed(bytes, |item| {
                each(match item {
                    Ok(record) => sevenk::describe(record.bytes()).to_string(),
                    Err(error) => format!("not a record: {error}"),
                });
            }),
            State::Jsf(stream) => feed(stream, bytes, jsf::describe, each),
            State::Ping(stream) => feed(stream, bytes, ping_frame, each),
            State::Wbms(stream) => feed(stream, bytes, wbms_packet, each),
            State::Imagenex(stream) => feed(stream, bytes, imagenex, each),
            State::Xtf(front, header, stream) => xtf(front, header, stream, bytes, each),
            State::WbmsText(held) => {
                held.extend_from_slice(bytes);
                let ended = held.iter().rposition(|b| matches!(b, b'\r' | b'\n'));
                if let Some(end) = ended {
                    wbms_text(&held[..end], each);
                    held.drain(..=end);
                } else if held.len() > wbms::control::MAX_LINE_BYTES {
                    wbms_text(held, each);
                    held.clear();
                }
            }
            State::Whole(_, all) => all.extend_from_slice(bytes),
        }
    }

    /// Marks the end of the input.
    pub fn finish(mut self, each: &mut dyn FnMut(String)) {
        match &mut self.state {
            State::SevenK(decoder) => decoder.finish(),
            State::Jsf(stream) => stream.finish(),
            State::Ping(stream) => stream.finish(),
            State::Wbms(stream) => stream.finish(),
            State::Imagenex(stream) => stream.finish(),
            State::Xtf(front, header, stream) => {
                if header.is_none() && !front.is_empty() {
                    each(format!("{} B, not an XTF header", front.len()));
                }
                stream.finish();
            }
            State::WbmsText(held) => {
                wbms_text(held, each);
                held.clear();
            }
            State::Whole(format, bytes) => {
                let (format, bytes) = (*format, std::mem::take(bytes));
                return whole(format, &bytes, each);
            }
        }
        self.push(&[], each);
    }
}

/// Description of datagrams. 7k records in several datagrams are reassembled.
pub struct Datagrams {
    sevenk: Reassembler,
}

impl Default for Datagrams {
    fn default() -> Self {
        Self {
            sevenk: Reassembler::new(MAX_7K_RECORD_BYTES),
        }
    }
}

impl Datagrams {
    /// Passes a line for each message of a datagram to `each`.
    pub fn push(&mut self, format: Format, bytes: &[u8], each: &mut dyn FnMut(String)) {
        match format {
            Format::SevenK => match self.sevenk.push_datagram(bytes) {
                Ok(Some(record)) => each(sevenk::describe(record.bytes()).to_string()),
                Ok(None) => each(format!("part of a 7k record, {} B", bytes.len())),
                Err(error) => each(format!("not a 7k packet: {error}")),
            },
            Format::Vita49 => each(vita49_packet(bytes)),
            other => {
                let mut describer = MessageDescriber::new(other);
                describer.push(bytes, each);
                describer.finish(each);
            }
        }
    }
}

/// Passes a line for each message of one datagram to `each`.
pub fn datagram(format: Format, bytes: &[u8], each: &mut dyn FnMut(String)) {
    Datagrams::default().push(format, bytes, each);
}

fn feed<F: Framing>(
    stream: &mut Splitter<F>,
    bytes: &[u8],
    describe: fn(&[u8]) -> String,
    each: &mut dyn FnMut(String),
) {
    stream.feed(bytes, |item| {
        each(match item {
            Ok(message) => describe(message),
            Err(error) => format!("not a message: {error}"),
        });
    });
}

fn or_wrong<T>(read: Result<T, WireError>, words: impl FnOnce(T) -> String) -> String {
    match read {
        Ok(value) => words(value),
        Err(error) => format!("invalid body: {error}"),
    }
}

// ---------------------------------------------------------------- formats that are read as a whole

fn whole(format: Format, bytes: &[u8], each: &mut dyn FnMut(String)) {
    match format {
        Format::S7k => {
            for item in FileReader::new(bytes) {
                each(match item {
                    Ok(found) => format!(
                        "{:>10} {}",
                        found.offset_bytes,
                        sevenk::describe(found.record.bytes())
                    ),
                    Err(error) => error.to_string(),
                });
            }
        }
        Format::Vita49 => {
            let mut rest = bytes;
            while !rest.is_empty() {
                each(vita49_packet(rest));
                let taken = vita49::Packet::parse(rest).map_or(rest.len(), |p| p.size_bytes);
                rest = &rest[taken.clamp(1, rest.len())..];
            }
        }
        Format::Sigmf => match Recording::parse(&String::from_utf8_lossy(bytes)) {
            Ok(recording) => sigmf(&recording, each),
            Err(error) => each(format!("not a SigMF file: {error}")),
        },
        Format::Wav => each(match WavHeader::parse(bytes) {
            Ok(header) => format!(
                "WAV{} {} channels, {} Hz, {:?}, {} sample times from byte {}",
                if header.is_rf64 { " (RF64)" } else { "" },
                header.format.channels,
                header.format.sample_rate_hz,
                header.format.sample,
                header.sample_times(),
                header.data_at
            ),
            Err(error) => format!("not a WAV file: {error}"),
        }),
        // The other formats are parsed as they arrive.
        _ => {}
    }
}

fn wbms_text(bytes: &[u8], each: &mut dyn FnMut(String)) {
    let text = String::from_utf8_lossy(bytes);
    for line in text.split(['\r', '\n']).map(str::trim) {
        // Refusals and the greeting follow the comment mark.
        let (line, comment) = line.split_once('#').unwrap_or((line, ""));
        let (line, comment) = (line.trim(), comment.trim());
        if line.is_empty() && comment.is_empty() {
            continue;
        }
        let comment = match comment {
            "" => String::new(),
            said => format!(": {said}"),
        };
        each(match wbms::Command::parse(line) {
            _ if line.is_empty() => format!("WBMS{comment}"),
            Ok(command) => format!("WBMS {command:?}{comment}"),
            Err(error) => format!("WBMS text {line:?}{comment} ({error})"),
        });
    }
}

fn sigmf(recording: &Recording, each: &mut dyn FnMut(String)) {
    each(format!(
        "SigMF {} channels of {} at {} Hz: {}; {}",
        recording.channels,
        recording.data_type.name(),
        recording.sample_rate_hz,
        recording.hardware,
        recording.description
    ));
    for capture in &recording.captures {
        each(format!(
            "capture from {} at {} ns UTC, {:?} Hz",
            capture.sample_start, capture.utc_ns, capture.frequency_hz
        ));
    }
    for note in &recording.annotations {
        each(format!(
            "annotation from {}, {} samples: {}: {}",
            note.sample_start, note.sample_count, note.label, note.comment
        ));
    }
}

fn vita49_packet(bytes: &[u8]) -> String {
    let packet = match vita49::Packet::parse(bytes) {
        Ok(packet) => packet,
        Err(error) => return format!("{} B, not a VITA 49 packet: {error}", bytes.len()),
    };
    let time = match packet.time {
        Some(time) => format!("{}.{:012} UTC", time.seconds, time.picoseconds),
        None => "no UTC".into(),
    };
    let body = match packet.packet_type {
        PacketType::Context => or_wrong(Context::parse(packet.payload), |c| format!("{c:?}")),
        PacketType::SignalData => {
            // The context states whether the samples are complex. Here the largest value of either interpretation is printed.
            let iq = complex_samples(packet.payload).flatten();
            let real = real_samples(packet.payload);
            let largest = iq.chain(real).map(i16::unsigned_abs).max();
            format!(
                "{} B of samples, largest {}, {:?}",
                packet.payload.len(),
                largest.unwrap_or(0),
                packet.trailer
            )
        }
    };
    format!(
        "VITA 49 {:?} stream {:#x} count {} {time}: {body}",
        packet.packet_type, packet.stream_id, packet.count
    )
}

// ---------------------------------------------------------------- messages

fn ping_frame(bytes: &[u8]) -> String {
    let frame = match Frame::parse(bytes) {
        Ok(frame) => frame,
        Err(error) => return format!("{} B, not a Ping frame: {error}", bytes.len()),
    };
    let body = or_wrong(Message::parse(&frame), |message| match message {
        Message::OsMonoProfile(profile) => {
            let loudest = profile.results_db().fold(f64::NEG_INFINITY, f64::max);
            format!("{:?}, loudest {loudest:.1} dB", profile.head)
        }
        Message::AtofPointData(data) => {
            let times = data.points().map(|point| point.two_way_time_s);
            let longest = times.fold(0.0, f32::max);
            format!("{:?}, longest {longest} s", data.head)
        }
        Message::YzPointData(data) => {
            let deepest = data.points().map(|[_, z]| z).fold(0.0, f32::min);
            format!("{:?}, deepest {deepest} m", data.head)
        }
        Message::Json(text) => String::from_utf8_lossy(text).into_owned(),
        Message::Other {
            message_id,
            payload,
        } => format!("message {message_id} of {} B", payload.len()),
        other => format!("{other:?}"),
    });
    format!(
        "Ping {} from {} to {}: {body}",
        frame.message_id, frame.source, frame.destination
    )
}

fn wbms_packet(bytes: &[u8]) -> String {
    let packet = match wbms::Packet::parse(bytes) {
        Ok(packet) => packet,
        Err(error) => return format!("{} B, not a WBMS packet: {error}", bytes.len()),
    };
    let body = match packet.header.packet_type {
        packet_type::BATHYMETRY => or_wrong(Bathymetry::parse(&packet), |bathymetry| {
            let samples = bathymetry.detections().map(|d| d.sample_number);
            let span = samples.fold((u32::MAX, 0), |(low, high), n| (low.min(n), high.max(n)));
            format!("{:?}, samples {span:?}", bathymetry.head)
        }),
        packet_type::WATER_COLUMN | packet_type::SNIPPETS | packet_type::SIDE_SCAN => {
            or_wrong(Backscatter::parse(&packet), |data| {
                let largest = data.values().fold(f64::NEG_INFINITY, f64::max);
                let angles = data.angles_rad().fold(0.0, |a: f32, b| a.max(b));
                let snippets = data.snippets().count();
                format!(
                    "{:?}, largest {largest}, angles to {angles}, {snippets} snippets",
                    data.head
                )
            })
        }
        other => format!("type {other}, {} B", packet.payload.len()),
    };
    format!("WBMS {}: {body}", packet.header.packet_type)
}

fn imagenex(bytes: &[u8]) -> String {
    match (SwitchCommand::parse(bytes), parse_answer(bytes)) {
        (Ok(command), _) => format!("Imagenex {command:?}"),
        (_, Ok(echo)) => format!(
            "Imagenex answer, loudest {}",
            echo.iter().max().unwrap_or(&0)
        ),
        (Err(error), Err(_)) => format!("not an Imagenex message: {error}"),
    }
}

fn xtf(
    front: &mut Vec<u8>,
    header: &mut Option<FileHeader>,
    stream: &mut Splitter<XtfFraming>,
    bytes: &[u8],
    each: &mut dyn FnMut(String),
) {
    let mut bytes = bytes.to_vec();
    if header.is_none() {
        front.extend_from_slice(&bytes);
        if front.len() < XTF_HEADER_BYTES {
            return;
        }
        match FileHeader::parse(front) {
            Ok(read) => {
                each(format!("XTF {read:?}"));
                *header = Some(read);
            }
            Err(error) => {
                each(format!("not an XTF header: {error}"));
                front.clear();
                return;
            }
        }
        bytes = front.split_off(XTF_HEADER_BYTES);
        front.clear();
    }
    let Some(header) = header else { return };
    stream.feed(&bytes, |item| {
        each(match item {
            Err(error) => format!("not a packet: {error}"),
            Ok(packet) => xtf_packet(packet, header),
        });
    });
}

fn xtf_packet(bytes: &[u8], header: &FileHeader) -> String {
    match bytes.get(2) {
        Some(&xtf::packet_type::SONAR) => or_wrong(Ping::parse(bytes, header), |ping| {
            let channels: Vec<_> = ping
                .channels
                .iter()
                .map(|channel| {
                    let largest = channel.values().fold(f64::NEG_INFINITY, f64::max);
                    format!(
                        "channel {} of {} samples, largest {largest}",
                        channel.header.channel, channel.header.samples
                    )
                })
                .collect();
            format!("XTF {:?}; {}", ping.header, channels.join("; "))
        }),
        Some(&xtf::packet_type::ATTITUDE) => {
            or_wrong(xtf::Attitude::parse(bytes), |a| format!("XTF {a:?}"))
        }
        kind => format!("XTF packet of type {kind:?}, {} B", bytes.len()),
    }
}
