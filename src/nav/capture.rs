//! Reads packet captures (pcap, pcapng): the arrival time of each packet, and its UDP payload or TCP segment.
//!
//! The crate `pcap-parser` reads the files. This module reads the link, IP, UDP and TCP headers. Link layers: Ethernet (with VLAN
//! tags), Linux cooked, loopback and raw IP. Network layers: IPv4 and IPv6. IP fragments are not reassembled. A truncated last
//! packet is ignored. A damaged pcapng block is skipped by its length. Sources: tcpdump's `pcap-savefile(5)`, IETF
//! draft-tuexen-opsawg-pcapng.

use echotank_core::time::UtcNs;
use pcap_parser::nom::{Err as ParseError, IResult};
use pcap_parser::pcapng::{Block, OptionCode, parse_block_be, parse_block_le};
use pcap_parser::{
    LegacyPcapBlock, PcapError, parse_pcap_frame, parse_pcap_frame_be, parse_pcap_frame_modified,
    parse_pcap_header,
};

/// Maximum length of a packet, bytes. A longer packet indicates a damaged file.
const MAX_PACKET: usize = 256 * 1024;
const ETHERNET: u32 = 1;
const NULL_LOOPBACK: u32 = 0;
const RAW_IP: [u32; 3] = [12, 14, RAW_IP_LINK];
/// Link type of IP packets without a link header.
pub(crate) const RAW_IP_LINK: u32 = 101;
/// First link type for private use.
pub(crate) const USER_LINK: u32 = 147;
const LINUX_COOKED: u32 = 113;
const LINUX_COOKED_2: u32 = 276;
/// Block type of a pcapng section header. The value is the same in both byte orders.
const SECTION_HEADER: [u8; 4] = [0x0A, 0x0D, 0x0D, 0x0A];

/// Packet of a capture file, with its UDP payload or TCP segment.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Packet<'a> {
    /// Capture time.
    pub arrival: UtcNs,
    /// UDP destination port; 0 if the packet holds no UDP datagram.
    pub port: u16,
    /// Payload of a complete UDP datagram.
    pub payload: Option<&'a [u8]>,
    /// TCP segment.
    pub segment: Option<Segment<'a>>,
}

/// TCP segment of one direction of a connection.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Segment<'a> {
    /// Source and destination IP address, concatenated as in the IP header.
    pub addresses: &'a [u8],
    /// Source port.
    pub from_port: u16,
    /// Destination port.
    pub to_port: u16,
    /// Sequence number of the payload's first byte.
    pub sequence: u32,
    /// True if the SYN flag is set: the first byte of the connection then has the number after `sequence`.
    pub is_start: bool,
    /// Bytes after the TCP header.
    pub payload: &'a [u8],
}

/// Whether a file begins with a pcap or pcapng header.
pub fn is_capture(bytes: &[u8]) -> bool {
    parse_pcap_header(bytes).is_ok() || is_pcapng(bytes)
}

fn is_pcapng(bytes: &[u8]) -> bool {
    bytes.starts_with(&SECTION_HEADER)
        && matches!(
            bytes.get(8..12),
            Some([0x4D, 0x3C, 0x2B, 0x1A] | [0x1A, 0x2B, 0x3C, 0x4D])
        )
}

/// The packets of a whole capture file, in file order. Empty if `bytes` is not a capture.
pub fn packets(bytes: &[u8]) -> impl Iterator<Item = Packet<'_>> {
    let mut packets = Packets::of(bytes);
    std::iter::from_fn(move || packets.next_frame().map(|frame| frame.packet))
}

impl<'a> Packets<'a> {
    pub(crate) fn of(bytes: &'a [u8]) -> Self {
        if let Ok((rest, header)) = parse_pcap_header(bytes) {
            let interface = Interface {
                // The upper half holds flags.
                link: header.network.0 as u32 & 0xFFFF,
                name: String::new(),
                ticks_per_s: match header.is_nanosecond_precision() {
                    true => 1_000_000_000,
                    false => 1_000_000,
                },
            };
            let parse = match (header.is_bigendian(), header.is_modified_format()) {
                (true, _) => parse_pcap_frame_be,
                (false, true) => parse_pcap_frame_modified,
                (false, false) => parse_pcap_frame,
            };
            return Packets {
                rest,
                format: Format::Pcap { parse },
                interfaces: vec![interface],
            };
        }
        Packets {
            rest: if is_pcapng(bytes) { bytes } else { &[] },
            format: Format::PcapNg {
                is_big_endian: false,
            },
            interfaces: Vec::new(),
        }
    }

    /// Name of an interface; empty without one.
    pub(crate) fn interface_name(&self, index: usize) -> Option<&str> {
        Some(&self.interfaces.get(index)?.name)
    }

    /// Names of the interfaces of the current section.
    pub(crate) fn interface_names(&self) -> impl Iterator<Item = &str> {
        self.interfaces
            .iter()
            .map(|interface| interface.name.as_str())
    }

    /// The next frame of the file.
    pub(crate) fn next_frame(&mut self) -> Option<Frame<'a>> {
        match &mut self.format {
            Format::Pcap { parse } => {
                let interface = self.interfaces.first()?;
                let (rest, frame) = parse(self.rest).ok()?;
                if frame.data.len() > MAX_PACKET {
                    return None;
                }
                self.rest = rest;
                let seconds = u64::from(frame.ts_sec) * interface.ticks_per_s;
                let ticks = seconds + u64::from(frame.ts_usec);
                Some(Frame {
                    interface: 0,
                    data: frame.data,
                    packet: packet(frame.data, interface, ticks),
                })
            }
            Format::PcapNg { is_big_endian } => loop {
                let block = next_block(&mut self.rest, is_big_endian)?;
                if let Some(frame) = block.and_then(|block| frame_of(block, &mut self.interfaces)) {
                    return Some(frame);
                }
            },
        }
    }
}

/// A packet and the interface that captured it.
pub(crate) struct Frame<'a> {
    /// Index of the interface in the section.
    pub(crate) interface: usize,
    /// The captured bytes, from the link header on.
    pub(crate) data: &'a [u8],
    pub(crate) packet: Packet<'a>,
}

#[derive(Clone)]
struct Interface {
    link: u32,
    name: String,
    ticks_per_s: u64,
}

type ParseFrame =
    for<'a> fn(&'a [u8]) -> IResult<&'a [u8], LegacyPcapBlock<'a>, PcapError<&'a [u8]>>;

enum Format {
    Pcap { parse: ParseFrame },
    PcapNg { is_big_endian: bool },
}

/// Reader of the packets of a capture file.
pub(crate) struct Packets<'a> {
    rest: &'a [u8],
    format: Format,
    /// Interfaces of the current section.
    interfaces: Vec<Interface>,
}

/// Removes the next pcapng block from `rest`. `Some(None)` for a damaged block of known length.
fn next_block<'a>(rest: &mut &'a [u8], is_big_endian: &mut bool) -> Option<Option<Block<'a>>> {
    let bytes = *rest;
    if bytes.starts_with(&SECTION_HEADER) {
        *is_big_endian = *bytes.get(8)? != 0x4D;
    }
    let parsed = match *is_big_endian {
        true => parse_block_be(bytes),
        false => parse_block_le(bytes),
    };
    match parsed {
        Ok((after, block)) => {
            *rest = after;
            Some(Some(block))
        }
        Err(ParseError::Incomplete(_)) => None,
        Err(_) => {
            let len: [u8; 4] = bytes.get(4..8)?.try_into().ok()?;
            let len = match *is_big_endian {
                true => u32::from_be_bytes(len),
                false => u32::from_le_bytes(len),
            } as usize;
            if !(12..=MAX_PACKET + 64).contains(&len) || !len.is_multiple_of(4) {
                return None;
            }
            *rest = bytes.get(len..)?;
            Some(None)
        }
    }
}

/// The packet of an Enhanced Packet Block. Interface and section blocks update `interfaces`; other blocks are ignored.
fn frame_of<'a>(block: Block<'a>, interfaces: &mut Vec<Interface>) -> Option<Frame<'a>> {
    match block {
        Block::SectionHeader(_) => interfaces.clear(),
        Block::InterfaceDescription(block) => interfaces.push(Interface {
            link: block.linktype.0 as u32,
            name: (block.options.iter())
                .find(|option| option.code == OptionCode::IfName)
                .and_then(|option| option.as_str().ok())
                .unwrap_or_default()
                .to_owned(),
            ticks_per_s: ticks_per_s(block.if_tsresol),
        }),
        Block::EnhancedPacket(block) => {
            let interface = interfaces.get(block.if_id as usize)?;
            let ticks = u64::from(block.ts_high) << 32 | u64::from(block.ts_low);
            let data = block.data.get(..block.caplen as usize)?;
            return Some(Frame {
                interface: block.if_id as usize,
                data,
                packet: packet(data, interface, ticks),
            });
        }
        _ => {}
    }
    None
}

/// Ticks per second of option `if_tsresol`: a power of 10, or a power of 2 if the upper bit is set. `pcap-parser` refuses powers of
/// 2.
fn ticks_per_s(resolution: u8) -> u64 {
    let base: u64 = if resolution & 0x80 == 0 { 10 } else { 2 };
    let power = u32::from(resolution & 0x7F);
    base.checked_pow(power).unwrap_or(1_000_000)
}

fn packet<'a>(data: &'a [u8], interface: &Interface, ticks: u64) -> Packet<'a> {
    let ns = u128::from(ticks) * 1_000_000_000 / u128::from(interface.ticks_per_s);
    let ip = ip_packet(data, interface.link);
    let datagram = ip.and_then(udp);
    Packet {
        arrival: UtcNs(i64::try_from(ns).unwrap_or(i64::MAX)),
        port: datagram.map_or(0, |(port, _)| port),
        payload: datagram.map(|(_, payload)| payload),
        segment: ip.and_then(tcp),
    }
}

fn u16_at(bytes: &[u8], at: usize) -> Option<u16> {
    let bytes = bytes.get(at..at + 2)?.try_into().ok()?;
    Some(u16::from_be_bytes(bytes))
}

fn u32_at(bytes: &[u8], at: usize) -> Option<u32> {
    let bytes = bytes.get(at..at + 4)?.try_into().ok()?;
    Some(u32::from_be_bytes(bytes))
}

/// The IP packet in a frame of link type `link` (tcpdump's LINKTYPE_ numbers).
fn ip_packet(data: &[u8], link: u32) -> Option<&[u8]> {
    match link {
        ETHERNET => {
            let mut at = 12;
            // VLAN tags may be nested.
            while matches!(u16_at(data, at)?, 0x8100 | 0x88A8 | 0x9100) {
                at += 4;
            }
            matches!(u16_at(data, at)?, 0x0800 | 0x86DD).then(|| data.get(at + 2..))?
        }
        LINUX_COOKED => data.get(16..),
        LINUX_COOKED_2 => data.get(20..),
        NULL_LOOPBACK => data.get(4..),
        link if RAW_IP.contains(&link) => Some(data),
        _ => None,
    }
}

const UDP: u8 = 17;
const TCP: u8 = 6;

/// Destination port and payload of a whole UDP datagram.
fn udp(ip: &[u8]) -> Option<(u16, &[u8])> {
    let datagram = inside(ip, UDP)?;
    let len = usize::from(u16_at(datagram, 4)?);
    Some((u16_at(datagram, 2)?, datagram.get(8..len)?))
}

/// The TCP segment in an IP packet.
fn tcp(ip: &[u8]) -> Option<Segment<'_>> {
    const SYN: u8 = 2;
    let segment = inside(ip, TCP)?;
    let header = usize::from(segment.get(12)? >> 4) * 4;
    Some(Segment {
        addresses: match ip[0] >> 4 {
            4 => ip.get(12..20)?,
            _ => ip.get(8..40)?,
        },
        from_port: u16_at(segment, 0)?,
        to_port: u16_at(segment, 2)?,
        sequence: u32_at(segment, 4)?,
        is_start: segment.get(13)? & SYN != 0,
        payload: segment.get(header..)?,
    })
}

/// Payload of an unfragmented IP packet of protocol `wanted`, without the padding of short Ethernet frames.
fn inside(ip: &[u8], wanted: u8) -> Option<&[u8]> {
    let (protocol, header, total) = match ip.first()? >> 4 {
        4 => {
            let fragment = u16_at(ip, 6)? & 0x3FFF;
            if fragment != 0 {
                return None;
            }
            let total = usize::from(u16_at(ip, 2)?);
            (*ip.get(9)?, usize::from(ip[0] & 0xF) * 4, total)
        }
        6 => (*ip.get(6)?, 40, 40 + usize::from(u16_at(ip, 4)?)),
        _ => return None,
    };
    (protocol == wanted).then(|| ip.get(header..total))?
}

#[cfg(test)]
mod tests {
    use super::*;

    /// An Ethernet frame around a UDP datagram to port 10110, padded to 60 bytes.
    fn frame(payload: &[u8], vlan: bool) -> Vec<u8> {
        let mut b = vec![0; 12];
        if vlan {
            b.extend([0x81, 0x00, 0, 5]);
        }
        b.extend([0x08, 0x00, 0x45, 0]);
        b.extend((28 + payload.len() as u16).to_be_bytes());
        b.extend([0, 0, 0, 0, 64, 17, 0, 0, 127, 0, 0, 1, 127, 0, 0, 1]);
        b.extend([0x12, 0x34, 0x27, 0x7E]);
        b.extend((8 + payload.len() as u16).to_be_bytes());
        b.extend([0, 0]);
        b.extend(payload);
        b.resize(b.len().max(60), 0);
        b
    }

    fn pcapng(frame: &[u8]) -> Vec<u8> {
        let block = |kind: u32, body: &[u8]| {
            let mut body = body.to_vec();
            body.resize(body.len().next_multiple_of(4), 0);
            let len = (body.len() as u32 + 12).to_be_bytes();
            [&kind.to_be_bytes()[..], &len, &body, &len].concat()
        };
        let section = [0x1A, 0x2B, 0x3C, 0x4D, 0, 1, 0, 0]
            .into_iter()
            .chain([0xFF; 8])
            .collect::<Vec<u8>>();
        // Link type 1; option 9 (resolution), one byte: 10^-9 s.
        let interface = [0, 1, 0, 0, 0, 0, 0, 0, 0, 9, 0, 1, 9, 0, 0, 0, 0, 0, 0, 0];
        let ticks: u64 = 1_406_851_200_123_456_789;
        let len = (frame.len() as u32).to_be_bytes();
        let packet = [&[0; 4][..], &ticks.to_be_bytes(), &len, &len, frame].concat();
        [
            block(0x0A0D_0D0A, &section),
            block(1, &interface),
            block(5, &[0; 12]),
            block(6, &packet),
        ]
        .concat()
    }

    #[test]
    fn payloads_are_read_without_tags_and_padding_from_pcap_and_pcapng() {
        let text: &[u8] = b"$HEHDT,1,T\r\n";
        for vlan in [false, true] {
            let frame = frame(text, vlan);
            let mut file = vec![0xD4, 0xC3, 0xB2, 0xA1, 2, 0, 4, 0, 0, 0, 0, 0, 0, 0, 0, 0];
            file.extend([0, 0, 4, 0, 1, 0, 0, 0]);
            for v in [1_406_851_200, 123_456, frame.len() as u32, 60] {
                file.extend(v.to_le_bytes());
            }
            file.extend(&frame);
            // A truncated packet follows.
            file.extend([1; 20]);
            let found: Vec<_> = packets(&file).collect();
            assert_eq!(found.len(), 1);
            assert_eq!(found[0].payload, Some(text), "vlan {vlan}");
            assert_eq!(found[0].port, 10110);
            assert_eq!(found[0].arrival, UtcNs(1_406_851_200_123_456_000));
            let file = pcapng(&frame);
            let found: Vec<_> = packets(&file).map(|p| (p.arrival, p.payload)).collect();
            assert_eq!(found, [(UtcNs(1_406_851_200_123_456_789), Some(text))]);
        }
    }

    #[test]
    fn a_damaged_block_is_skipped_and_powers_of_two_are_resolutions() {
        let frame = frame(b"$HEHDT,1,T\r\n", false);
        let whole = pcapng(&frame);
        // The packet block occurs twice; the trailing length of the first copy is wrong.
        let at = whole.len() - (frame.len().next_multiple_of(4) + 32);
        let mut twice = [&whole[..], &whole[at..]].concat();
        twice[whole.len() - 1] ^= 4;
        assert_eq!(packets(&twice).count(), 1);
        for cut in 0..whole.len() {
            assert_eq!(packets(&whole[..cut]).count(), 0, "{cut}");
        }
        assert_eq!(ticks_per_s(0x80 | 20), 1 << 20);
        assert_eq!(ticks_per_s(9), 1_000_000_000);
    }
}
