//! ANSI/VITA 49.2 (VITA Radio Transport) over UDP: element samples and their properties, for acquisition and DSP boards.
//!
//! Source: ANSI/VITA 49.2-2017, sections 5.1 (header), 6.3 (signal data), 7.1 and 9 (context), as interpreted by two public
//! decoders: the `vrt` dissector of Wireshark and the MIT/Apache crate `vita49`. Numbers are big endian, in 32-bit words.
//!
//! ```text
//! word 0   packet type (31-28) | class id (27) | specific (26-24) | TSI (23-22) | TSF (21-20) | count (19-16) | size in words (15-0)
//! word 1   stream identifier, then the class identifier (2 words) if bit 27
//! then     seconds (TSI, 1 word), fraction (TSF, 2 words), payload or context fields, trailer if bit 26 of a data packet
//! ```
//!
//! Each element has a stream, or one stream carries vectors of all elements. The timestamp is that of a packet's first sample, in UTC
//! seconds and picoseconds. Data and context packets of a stream have separate counters, modulo 16.
//!
//! - [`signal`]: samples, divided into packets
//! - [`context`]: rate, frequency, bandwidth, payload format

pub mod context;
pub mod signal;

use crate::WireError;
use crate::layout::data_at;

pub use context::{Context, PayloadFormat, SampleKind};
pub use signal::{SignalStream, complex_samples, real_samples};

/// Registered UDP port.
pub const PORT: u16 = 4991;
/// Maximum packet for an Ethernet frame over UDP and IPv4, in whole words.
pub const ETHERNET_PACKET_BYTES: usize = 1472;
/// Maximum UDP datagram over IPv4, in whole words.
pub const MAX_DATAGRAM_BYTES: usize = 65_504;

const PS_PER_S: u64 = 1_000_000_000_000;

/// UTC timestamp of packets.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default)]
pub struct VrtTime {
    /// Seconds since 1970.
    pub seconds: u32,
    /// Picoseconds within the second, 0 to 10^12 - 1.
    pub picoseconds: u64,
}

impl VrtTime {
    /// Exact conversion from nanoseconds since 1970, for 1970 to 2106.
    pub fn from_utc_ns(utc_ns: i64) -> Self {
        Self {
            seconds: utc_ns.div_euclid(1_000_000_000).clamp(0, u32::MAX.into()) as u32,
            picoseconds: utc_ns.rem_euclid(1_000_000_000) as u64 * 1000,
        }
    }

    /// Nanoseconds since 1970, rounded down.
    pub fn to_utc_ns(self) -> i64 {
        i64::from(self.seconds) * 1_000_000_000 + (self.picoseconds / 1000) as i64
    }

    /// The time `picoseconds` later.
    pub fn plus_ps(self, picoseconds: u128) -> Self {
        let total = u128::from(self.seconds) * u128::from(PS_PER_S)
            + u128::from(self.picoseconds)
            + picoseconds;
        Self {
            seconds: (total / u128::from(PS_PER_S)).min(u32::MAX.into()) as u32,
            picoseconds: (total % u128::from(PS_PER_S)) as u64,
        }
    }
}

/// Supported packet types.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PacketType {
    /// 1: samples of a stream.
    SignalData,
    /// 4: properties of a stream's samples.
    Context,
}

/// State of the samples of a data packet: a 32-bit trailer with enable bits 31-20 and indicators 19-8. `None` means that the packet
/// does not state the indicator.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Trailer {
    /// True if the timestamp is synchronised to UTC.
    pub calibrated_time: Option<bool>,
    /// True if the samples are valid.
    pub valid_data: Option<bool>,
    /// True if a sample is clipped.
    pub over_range: Option<bool>,
    /// True if samples before this packet are lost.
    pub sample_loss: Option<bool>,
    /// True if the samples have reduced accuracy (lower user-defined indicator).
    pub degraded: Option<bool>,
}

/// Enable bits of the trailer's indicators; each indicator is 12 bits lower.
const TRAILER_ENABLES: [u32; 5] = [31, 30, 25, 24, 20];

impl Trailer {
    fn to_word(self) -> u32 {
        let states = [
            self.calibrated_time,
            self.valid_data,
            self.over_range,
            self.sample_loss,
            self.degraded,
        ];
        TRAILER_ENABLES
            .iter()
            .zip(states)
            .fold(0, |word, (&bit, state)| match state {
                None => word,
                Some(state) => word | 1 << bit | u32::from(state) << (bit - 12),
            })
    }

    fn from_word(word: u32) -> Self {
        let [
            calibrated_time,
            valid_data,
            over_range,
            sample_loss,
            degraded,
        ] = TRAILER_ENABLES
            .map(|bit| (word >> bit & 1 == 1).then_some(word >> (bit - 12) & 1 == 1));
        Self {
            calibrated_time,
            valid_data,
            over_range,
            sample_loss,
            degraded,
        }
    }
}

/// A parsed packet that borrows its payload.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Packet<'a> {
    /// Type of the packet.
    pub packet_type: PacketType,
    /// Stream identifier.
    pub stream_id: u32,
    /// Class identifier: organisation, information class and packet class, not interpreted.
    pub class_id: Option<u64>,
    /// Time of the first sample; `None` if the times of the packet are not UTC and picoseconds.
    pub time: Option<VrtTime>,
    /// Packet counter, 0 to 15.
    pub count: u8,
    /// Samples, or the fields of a context.
    pub payload: &'a [u8],
    /// State of the samples; data packets only.
    pub trailer: Option<Trailer>,
    /// Size of the whole packet.
    pub size_bytes: usize,
}

pub(crate) fn word_at(bytes: &[u8], word: usize, what: &'static str) -> Result<u32, WireError> {
    let bytes = data_at(bytes, 4 * word, 4, what)?;
    Ok(u32::from_be_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]))
}

pub(crate) fn two_words_at(
    bytes: &[u8],
    word: usize,
    what: &'static str,
) -> Result<u64, WireError> {
    let high = word_at(bytes, word, what)?;
    Ok(u64::from(high) << 32 | u64::from(word_at(bytes, word + 1, what)?))
}

/// TSI code of UTC.
const TSI_UTC: u32 = 1;
/// TSF code of picoseconds.
const TSF_PICOSECONDS: u32 = 2;

impl<'a> Packet<'a> {
    /// Parses the packet at the front of `bytes`.
    pub fn parse(bytes: &'a [u8]) -> Result<Self, WireError> {
        const WHAT: &str = "VRT packet";
        let head = word_at(bytes, 0, WHAT)?;
        let packet_type = match head >> 28 {
            1 => PacketType::SignalData,
            4 => PacketType::Context,
            other => return Err(WireError::unsupported("VRT packet type", other)),
        };
        let size_bytes = 4 * (head & 0xFFFF) as usize;
        let packet = data_at(bytes, 0, size_bytes as u64, WHAT)?;
        let (tsi, tsf) = (head >> 22 & 3, head >> 20 & 3);
        let stream_id = word_at(packet, 1, WHAT)?;
        let mut word = 2;
        let class_id = if head >> 27 & 1 == 1 {
            word += 2;
            Some(two_words_at(packet, 2, WHAT)?)
        } else {
            None
        };
        let seconds = if tsi != 0 {
            word += 1;
            word_at(packet, word - 1, WHAT)?
        } else {
            0
        };
        let picoseconds = if tsf != 0 {
            word += 2;
            two_words_at(packet, word - 2, WHAT)?
        } else {
            0
        };
        let is_ours = tsi == TSI_UTC && tsf == TSF_PICOSECONDS && picoseconds < PS_PER_S;
        let has_trailer = packet_type == PacketType::SignalData && head >> 26 & 1 == 1;
        let end = (packet.len() / 4)
            .checked_sub(usize::from(has_trailer))
            .filter(|&end| end >= word)
            .ok_or(WireError::truncated(
                WHAT,
                4 * (word + usize::from(has_trailer)) as u64,
                packet.len(),
            ))?;
        let trailer = if has_trailer {
            Some(Trailer::from_word(word_at(packet, end, WHAT)?))
        } else {
            None
        };
        Ok(Self {
            packet_type,
            stream_id,
            class_id,
            time: is_ours.then_some(VrtTime {
                seconds,
                picoseconds,
            }),
            count: (head >> 16 & 0xF) as u8,
            payload: &packet[4 * word..4 * end],
            trailer,
            size_bytes,
        })
    }
}

/// Appends a packet with stream identifier and time. `write_payload` must append whole words.
pub(crate) fn emit_packet(
    buf: &mut Vec<u8>,
    packet_type: PacketType,
    stream_id: u32,
    count: u8,
    time: VrtTime,
    trailer: Option<Trailer>,
    write_payload: impl FnOnce(&mut Vec<u8>),
) -> std::ops::Range<usize> {
    let start = buf.len();
    let type_bits = match packet_type {
        PacketType::SignalData => 1 << 28 | u32::from(trailer.is_some()) << 26,
        PacketType::Context => 4 << 28,
    };
    buf.extend([0; 4]);
    buf.extend(stream_id.to_be_bytes());
    buf.extend(time.seconds.to_be_bytes());
    buf.extend(time.picoseconds.to_be_bytes());
    write_payload(buf);
    if let Some(trailer) = trailer {
        buf.extend(trailer.to_word().to_be_bytes());
    }
    let bytes = buf.len() - start;
    assert!(
        bytes.is_multiple_of(4) && bytes / 4 <= usize::from(u16::MAX),
        "VRT packet of {bytes} bytes"
    );
    let head = type_bits
        | TSI_UTC << 22
        | TSF_PICOSECONDS << 20
        | u32::from(count & 0xF) << 16
        | (bytes / 4) as u32;
    buf[start..start + 4].copy_from_slice(&head.to_be_bytes());
    start..buf.len()
}
