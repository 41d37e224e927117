//! Decodes the bytes of each live family into records and reads their order: a ping number, a packet count or a frame number.

use std::collections::HashMap;

use echotank_protocols::elements::{ElementFraming, ElementStream, Frame as ElementFrame};
use echotank_protocols::imagenex872::{AnswerFraming, AnswerStream};
use echotank_protocols::jsf::{JsfFraming, JsfStream, Message as JsfMessage, message_type};
use echotank_protocols::ping_protocol::{Frame, Message, PingFraming, PingStream};
use echotank_protocols::sevenk::frame::{DATA_RECORD_FRAME_BYTES, NETWORK_FRAME_BYTES};
use echotank_protocols::sevenk::{DataRecordFrame, StreamDecoder};
use echotank_protocols::vita49::Packet;
use echotank_protocols::wbms::{self, PacketHeader, WbmsFraming, WbmsStream, packet_type};

use super::super::verify::ping_number;

/// Longest 7k record accepted, bytes.
const MAX_RECORD_BYTES: u32 = 256 << 20;

/// A protocol family with live output.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Family {
    /// Teledyne RESON 7k.
    SevenK,
    /// EdgeTech JSF.
    Jsf,
    /// Norbit WBMS.
    Wbms,
    /// Blue Robotics and Cerulean Ping protocol.
    Ping,
    /// Imagenex 872.
    Imagenex872,
    /// VITA 49 signal data.
    Vita49,
    /// Raw element samples.
    Elements,
}

impl Family {
    /// Every family.
    pub const ALL: [Self; 7] = [
        Self::SevenK,
        Self::Jsf,
        Self::Wbms,
        Self::Ping,
        Self::Imagenex872,
        Self::Vita49,
        Self::Elements,
    ];

    /// The family's name in the fault log.
    pub fn name(self) -> &'static str {
        match self {
            Self::SevenK => "7k",
            Self::Jsf => "jsf",
            Self::Wbms => "wbms",
            Self::Ping => "ping",
            Self::Imagenex872 => "imagenex872",
            Self::Vita49 => "vita49",
            Self::Elements => "elements",
        }
    }

    /// Link faults that the records reveal. `compared` states whether their content is compared with a run without faults.
    pub fn detectable_faults(self, compared: bool) -> Vec<&'static str> {
        // A lost answer is sent again at the next ping, and answers have no numbers.
        let mut kinds = match self {
            Self::Imagenex872 => vec!["duplicate", "truncate"],
            _ => vec![
                "drop",
                "link-down",
                "duplicate",
                "reorder",
                "delay",
                "jitter",
            ],
        };
        match self {
            // A checksum or a network frame reveals an incomplete record.
            Self::SevenK | Self::Wbms | Self::Ping => kinds.extend(["corrupt", "truncate"]),
            // A datagram carries its length.
            Self::Vita49 => kinds.push("truncate"),
            _ => {}
        }
        if compared && self != Self::Imagenex872 {
            kinds.extend(["corrupt", "corrupt-mended", "truncate"]);
        }
        match self {
            Self::Vita49 => {}
            Self::Imagenex872 => kinds.push("reset"),
            _ => kinds.extend(["reset", "half-open"]),
        }
        kinds.sort_unstable();
        kinds.dedup();
        kinds
    }
}

/// A numbered sequence of records.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Sequence {
    /// Ping numbers of one record type, as in the fault log: a 7k record, a JSF message with subsystem and channel, a WBMS packet, a Ping message.
    Records(u32),
    /// Packets of a VITA 49 stream, with data and context separate. The 4-bit counts are extended.
    Packets {
        /// The stream identifier.
        stream: u32,
        /// Whether these are context packets; otherwise data packets.
        context: bool,
    },
    /// Frame numbers of an element stream.
    Frames,
    /// Answers of an Imagenex 872, which have no numbers.
    Answers,
}

/// One received record.
#[derive(Clone, Copy, Debug)]
pub struct ReceivedRecord<'a> {
    /// Sequence that numbers the record.
    pub sequence: Sequence,
    /// Number within the sequence.
    pub number: Option<u32>,
    /// Ping number, if the record has one.
    pub ping_number: Option<u32>,
    /// VITA 49: time of the first sample, ns since 1970 UTC.
    pub utc_ns: Option<i64>,
    /// Whether a checksum or a length shows that the record was altered.
    pub(crate) is_damaged: bool,
    /// Identifies the record in every run of the same rig, independent of the records before it.
    pub key: u64,
    /// Bytes that are equal in every run, without running numbers.
    pub content: &'a [u8],
}

impl<'a> ReceivedRecord<'a> {
    fn ping(record_type: u32, number: u32, bytes: &'a [u8]) -> Self {
        Self {
            sequence: Sequence::Records(record_type),
            number: Some(number),
            ping_number: Some(number),
            utc_ns: None,
            is_damaged: false,
            key: number.into(),
            content: bytes,
        }
    }
}

/// Decodes the records of one connection.
pub struct RecordDecoder {
    inner: FamilyDecoder,
    errors: u64,
    unnumbered: u64,
}

enum FamilyDecoder {
    SevenK(Box<StreamDecoder>),
    Jsf(JsfStream),
    Wbms(WbmsStream),
    Ping(PingStream),
    Imagenex872(AnswerStream),
    Vita49(HashMap<(u32, bool), LastPacket>),
    Elements(ElementStream),
}

/// Newest packet of a stream.
#[derive(Clone, Copy)]
struct LastPacket {
    number: u32,
    utc_ns: i64,
}

impl RecordDecoder {
    /// A decoder for a new connection.
    pub fn new(family: Family) -> Self {
        let inner = match family {
            Family::SevenK => FamilyDecoder::SevenK(Box::new(StreamDecoder::new(MAX_RECORD_BYTES))),
            Family::Jsf => FamilyDecoder::Jsf(JsfStream::new(JsfFraming::default())),
            Family::Wbms => FamilyDecoder::Wbms(WbmsStream::new(WbmsFraming)),
            Family::Ping => FamilyDecoder::Ping(PingStream::new(PingFraming)),
            Family::Imagenex872 => FamilyDecoder::Imagenex872(AnswerStream::new(AnswerFraming)),
            Family::Vita49 => FamilyDecoder::Vita49(HashMap::new()),
            Family::Elements => FamilyDecoder::Elements(ElementStream::new(ElementFraming)),
        };
        Self {
            inner,
            errors: 0,
            unnumbered: 0,
        }
    }

    /// Number of undecodable byte ranges and damaged records.
    pub fn errors(&self) -> u64 {
        self.errors
    }

    /// Number of undamaged records without a number.
    pub fn unnumbered(&self) -> u64 {
        self.unnumbered
    }

    /// Discards an incomplete Imagenex 872 answer after a timeout. Other families resynchronise by themselves.
    pub fn give_up(&mut self) {
        if let FamilyDecoder::Imagenex872(stream) = &mut self.inner {
            stream.finish();
            stream.feed(&[], |item| self.errors += u64::from(item.is_err()));
            // A new decoder avoids counting the same truncated answer twice.
            *stream = AnswerStream::new(AnswerFraming);
        }
    }

    /// Decodes a part of a connection, split anywhere, or one whole datagram. Calls `each` for every record.
    pub fn decode(&mut self, bytes: &[u8], each: &mut dyn FnMut(&ReceivedRecord)) {
        let (errors, unnumbered) = (&mut self.errors, &mut self.unnumbered);
        let mut found = |record: Option<ReceivedRecord>| match record {
            Some(record) => each(&record),
            None => *unnumbered += 1,
        };
        match &mut self.inner {
            FamilyDecoder::SevenK(decoder) => decode_sevenk(decoder, bytes, errors, &mut found),
            FamilyDecoder::Jsf(stream) => stream.feed(bytes, |item| match item {
                Ok(bytes) => found(of_jsf(bytes)),
                Err(_) => *errors += 1,
            }),
            FamilyDecoder::Wbms(stream) => stream.feed(bytes, |item| match item {
                Ok(bytes) => {
                    let is_damaged = wbms::Packet::parse(bytes).is_err();
                    *errors += u64::from(is_damaged);
                    found(of_wbms(bytes).map(|s| ReceivedRecord { is_damaged, ..s }));
                }
                Err(_) => *errors += 1,
            }),
            FamilyDecoder::Ping(stream) => stream.feed(bytes, |item| match item {
                Ok(bytes) => found(of_ping(bytes)),
                Err(_) => *errors += 1,
            }),
            FamilyDecoder::Imagenex872(stream) => stream.feed(bytes, |item| match item {
                Ok(bytes) => found(Some(ReceivedRecord {
                    sequence: Sequence::Answers,
                    number: None,
                    ping_number: None,
                    utc_ns: None,
                    is_damaged: false,
                    key: 0,
                    content: bytes,
                })),
                Err(_) => *errors += 1,
            }),
            FamilyDecoder::Vita49(counted) => match of_vita49(bytes, counted) {
                Some(record) => {
                    *errors += u64::from(record.is_damaged);
                    found(Some(record));
                }
                None => *errors += 1,
            },
            FamilyDecoder::Elements(stream) => stream.feed(bytes, |item| match item {
                Ok(bytes) => found(of_elements(bytes)),
                Err(_) => *errors += 1,
            }),
        }
    }
}

fn u32_at(bytes: &[u8], at: usize) -> Option<u32> {
    let four = bytes.get(at..)?.first_chunk::<4>()?;
    Some(u32::from_le_bytes(*four))
}

fn decode_sevenk(
    decoder: &mut StreamDecoder,
    mut bytes: &[u8],
    errors: &mut u64,
    found: &mut dyn FnMut(Option<ReceivedRecord>),
) {
    loop {
        loop {
            match decoder.next_record() {
                None => break,
                Some(Ok(record)) => {
                    let record_type = record.frame.record_type_id;
                    let number = ping_number(record_type, record.body());
                    found(number.map(|n| ReceivedRecord::ping(record_type, n, record.bytes())));
                }
                Some(Err(_)) => {
                    *errors += 1;
                    if let Some(damaged) = damaged_sevenk(decoder.refused_bytes()) {
                        found(Some(damaged));
                    }
                }
            }
        }
        if bytes.is_empty() {
            return;
        }
        let taken = decoder.push(bytes);
        bytes = &bytes[taken..];
    }
}

/// Decodes a refused 7k record whose frames are valid and that has a ping number.
fn damaged_sevenk(bytes: &[u8]) -> Option<ReceivedRecord<'_>> {
    let record = bytes.get(NETWORK_FRAME_BYTES..)?;
    let frame = DataRecordFrame::parse(record).ok()?;
    frame.check().ok()?;
    let record_type = frame.record_type_id;
    let number = ping_number(record_type, record.get(DATA_RECORD_FRAME_BYTES..)?)?;
    Some(ReceivedRecord {
        is_damaged: true,
        ..ReceivedRecord::ping(record_type, number, record)
    })
}

fn of_jsf(bytes: &[u8]) -> Option<ReceivedRecord<'_>> {
    let message = JsfMessage::parse(bytes).ok()?;
    let header = &message.header;
    if header.message_type != message_type::SONAR_DATA {
        return None;
    }
    let record_type = u32::from(header.message_type)
        | u32::from(header.subsystem) << 16
        | u32::from(header.channel) << 24;
    Some(ReceivedRecord::ping(
        record_type,
        u32_at(message.body, 8)?,
        bytes,
    ))
}

fn of_wbms(bytes: &[u8]) -> Option<ReceivedRecord<'_>> {
    let header = PacketHeader::parse(bytes).ok()?;
    // Snippets and side-scan share a port; the fault log labels both as side-scan.
    let (record_type, at) = match header.packet_type {
        packet_type::BATHYMETRY => (packet_type::BATHYMETRY, 36),
        packet_type::WATER_COLUMN => (packet_type::WATER_COLUMN, 108),
        packet_type::SNIPPETS | packet_type::SIDE_SCAN => (packet_type::SIDE_SCAN, 108),
        _ => return None,
    };
    Some(ReceivedRecord::ping(record_type, u32_at(bytes, at)?, bytes))
}

/// The content omits times since power-on, which differ between runs.
fn of_ping(bytes: &[u8]) -> Option<ReceivedRecord<'_>> {
    let frame = Frame::parse(bytes).ok()?;
    let (number, content_at) = match Message::parse(&frame).ok()? {
        // This device counts pings from 0.
        Message::OsMonoProfile(profile) => (profile.head.ping_number.wrapping_add(1), 16),
        Message::YzPointData(data) => (data.head.ping_number, 4),
        Message::AtofPointData(data) => (data.head.ping_number, 4),
        _ => return None,
    };
    Some(ReceivedRecord {
        content: frame.payload.get(content_at..)?,
        ..ReceivedRecord::ping(frame.message_id.into(), number, bytes)
    })
}

fn of_elements(bytes: &[u8]) -> Option<ReceivedRecord<'_>> {
    let frame = ElementFrame::parse(bytes).ok()?;
    Some(ReceivedRecord {
        sequence: Sequence::Frames,
        number: Some(frame.head.frame_number),
        ping_number: Some(frame.head.ping_number),
        utc_ns: None,
        is_damaged: false,
        key: u64::from(frame.head.ping_number) << 32 | u64::from(frame.head.first_sample),
        // The content begins after the frame number.
        content: &bytes[16..],
    })
}

/// Stream and time of a VITA 49 packet.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct PacketPosition {
    /// Stream identifier.
    pub stream: u32,
    /// Whether it is a context packet.
    pub context: bool,
    /// Packet time, ns since 1970 UTC.
    pub utc_ns: i64,
    count: u8,
}

/// Stream and time of a VITA 49 packet, from its first 28 bytes; `None` without UTC time.
pub(crate) fn position_of(bytes: &[u8]) -> Option<PacketPosition> {
    let word = |n: usize| {
        let four = bytes.get(4 * n..)?.first_chunk::<4>()?;
        Some(u32::from_be_bytes(*four))
    };
    let head = word(0)?;
    let context = match head >> 28 {
        1 => false,
        4 => true,
        _ => return None,
    };
    // UTC seconds and picoseconds.
    if (head >> 22 & 3, head >> 20 & 3) != (1, 2) {
        return None;
    }
    let at = if head >> 27 & 1 == 1 { 4 } else { 2 };
    let picoseconds = u64::from(word(at + 1)?) << 32 | u64::from(word(at + 2)?);
    Some(PacketPosition {
        stream: word(1)?,
        context,
        utc_ns: i64::from(word(at)?) * 1_000_000_000 + (picoseconds / 1000) as i64,
        count: (head >> 16 & 0xF) as u8,
    })
}

/// Extends the 4-bit counts. The packet times distinguish newer from late packets, so up to 15 consecutive losses are found.
fn of_vita49<'a>(
    bytes: &'a [u8],
    counted: &mut HashMap<(u32, bool), LastPacket>,
) -> Option<ReceivedRecord<'a>> {
    let place = position_of(bytes)?;
    let is_whole = Packet::parse(bytes).is_ok_and(|packet| packet.size_bytes == bytes.len());
    let (count, utc_ns) = (u32::from(place.count), place.utc_ns);
    let newest = counted
        .entry((place.stream, place.context))
        // Leaves room for late packets.
        .or_insert(LastPacket {
            number: 16 + count,
            utc_ns,
        });
    let number = match utc_ns.cmp(&newest.utc_ns) {
        std::cmp::Ordering::Equal => newest.number,
        std::cmp::Ordering::Greater => {
            let ahead = count.wrapping_sub(newest.number) & 0xF;
            let ahead = if ahead == 0 { 16 } else { ahead };
            let number = newest.number.wrapping_add(ahead);
            *newest = LastPacket { number, utc_ns };
            number
        }
        std::cmp::Ordering::Less => {
            let behind = newest.number.wrapping_sub(count) & 0xF;
            let behind = if behind == 0 { 16 } else { behind };
            newest.number.saturating_sub(behind)
        }
    };
    Some(ReceivedRecord {
        sequence: Sequence::Packets {
            stream: place.stream,
            context: place.context,
        },
        number: Some(number),
        ping_number: None,
        utc_ns: Some(utc_ns),
        is_damaged: !is_whole,
        key: utc_ns as u64,
        // The first word holds the count.
        content: bytes.get(4..).unwrap_or_default(),
    })
}
