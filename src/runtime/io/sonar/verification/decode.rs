//! The bytes of any live family to records, and what each says of its place among the unnumbered: a ping number, a count, or nothing.

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

/// The longest 7k record believed: some minutes of the largest sonar we emulate.
const MAX_RECORD_BYTES: u32 = 256 << 20;

/// The families that are sent live.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Family {
    SevenK,
    Jsf,
    Wbms,
    Ping,
    Imagenex872,
    Vita49,
    Elements,
}

impl Family {
    pub const ALL: [Self; 7] = [
        Self::SevenK,
        Self::Jsf,
        Self::Wbms,
        Self::Ping,
        Self::Imagenex872,
        Self::Vita49,
        Self::Elements,
    ];

    /// As the log of faults has it.
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

    /// Kinds of faults of the line of which its records tell; `compared`: with what they hold in a run without faults.
    pub fn tells(self, compared: bool) -> Vec<&'static str> {
        // An answer that is lost is made again at the next ping, and none has a number.
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
            // A checksum, or a network frame, says that a record is not whole.
            Self::SevenK | Self::Wbms | Self::Ping => kinds.extend(["corrupt", "truncate"]),
            // A datagram says how long it is.
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

/// In which numbers run by themselves.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Sequence {
    /// Ping numbers of one type, named as in the log of faults: a 7k record, a JSF message with subsystem and channel, a WBMS packet, a Ping message.
    Records(u32),
    /// Packets of a VITA 49 stream, data and contexts apart: their counts of 4 bits, continued.
    Packets { stream: u32, context: bool },
    /// Frame numbers of an element stream.
    Frames,
    /// Answers of an Imagenex 872, which have no numbers.
    Answers,
}

/// A record as it came.
#[derive(Clone, Copy, Debug)]
pub struct ReceivedRecord<'a> {
    pub sequence: Sequence,
    /// Within the sequence.
    pub number: Option<u32>,
    pub ping_number: Option<u32>,
    /// Of its first sample, of VITA 49.
    pub utc_ns: Option<i64>,
    /// A checksum or a length says that it is not what was sent.
    pub(crate) is_damaged: bool,
    /// Which record it is in any run of the same rig, however much was heard before.
    pub key: u64,
    /// What it says, but for such numbers.
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

/// Cuts what comes into records. One connection's.
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

/// The newest packet of a stream.
#[derive(Clone, Copy)]
struct LastPacket {
    number: u32,
    utc_ns: i64,
}

impl RecordDecoder {
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

    /// Times that bytes were no record, or a record was wrong.
    pub fn errors(&self) -> u64 {
        self.errors
    }

    /// Sound records that carry no number.
    pub fn unnumbered(&self) -> u64 {
        self.unnumbered
    }

    /// What has begun will not be continued: its rest was given up, and the next question has been asked. Of an Imagenex 872; the unnumbered go on by
    /// themselves.
    pub fn give_up(&mut self) {
        if let FamilyDecoder::Imagenex872(stream) = &mut self.inner {
            stream.finish();
            stream.feed(&[], |item| self.errors += u64::from(item.is_err()));
            // Anew: one that searches counts no second truncated answer before it has found a whole one.
            *stream = AnswerStream::new(AnswerFraming);
        }
    }

    /// Takes bytes of a connection, cut anywhere, or one whole datagram.
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

/// A record that was refused, where its frames are sound and it has a ping number.
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
    // Snippets and side-scan share a port, and the log of faults calls both side-scan.
    let (record_type, at) = match header.packet_type {
        packet_type::BATHYMETRY => (packet_type::BATHYMETRY, 36),
        packet_type::WATER_COLUMN => (packet_type::WATER_COLUMN, 108),
        packet_type::SNIPPETS | packet_type::SIDE_SCAN => (packet_type::SIDE_SCAN, 108),
        _ => return None,
    };
    Some(ReceivedRecord::ping(record_type, u32_at(bytes, at)?, bytes))
}

/// Times since the device was switched on are left out of what is compared.
fn of_ping(bytes: &[u8]) -> Option<ReceivedRecord<'_>> {
    let frame = Frame::parse(bytes).ok()?;
    let (number, content_at) = match Message::parse(&frame).ok()? {
        // Its pings count from 0.
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
        key: u64::from(frame.head.ping_number) << 32 | u64::from(frame.head.first_moment),
        // From behind the frame number.
        content: &bytes[16..],
    })
}

/// A packet's place: of a stream, at a time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct PacketPosition {
    pub stream: u32,
    pub context: bool,
    pub utc_ns: i64,
    count: u8,
}

/// Where a VITA 49 packet belongs, whole or cut: its first 28 bytes are enough. None where its time is not UTC.
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

/// Counts go on from 0 to 15 and around; times say whether a packet is newer than the newest, so that up to 15 lost in a row are told.
fn of_vita49<'a>(
    bytes: &'a [u8],
    counted: &mut HashMap<(u32, bool), LastPacket>,
) -> Option<ReceivedRecord<'a>> {
    let place = position_of(bytes)?;
    let is_whole = Packet::parse(bytes).is_ok_and(|packet| packet.size_bytes == bytes.len());
    let (count, utc_ns) = (u32::from(place.count), place.utc_ns);
    let newest = counted
        .entry((place.stream, place.context))
        // Room for those that come late.
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
        // The first word has the count.
        content: bytes.get(4..).unwrap_or_default(),
    })
}
