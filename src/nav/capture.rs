//! UDP datagrams in packet captures. Comes in: a whole pcap or pcapng file. Goes out: each packet's arrival, and its datagram's payload or its
//! TCP segment.
//!
//! Ethernet (with VLAN tags), Linux cooked, loopback and raw IP; IPv4 and IPv6. Not put together: fragments, TCP. A file cut in the middle of a packet ends
//! before it. Sources: tcpdump's `pcap-savefile(5)`, IETF draft-tuexen-opsawg-pcapng.

use echotank_core::time::UtcNs;

/// No packet of a sound file is longer, bytes.
const MAX_PACKET: usize = 256 * 1024;
const ETHERNET: u32 = 1;
const NULL_LOOPBACK: u32 = 0;
const RAW_IP: [u32; 3] = [12, 14, 101];
const LINUX_COOKED: u32 = 113;
const LINUX_COOKED_2: u32 = 276;

/// One packet; without a payload it was no whole UDP datagram.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Packet<'a> {
    pub arrival: UtcNs,
    pub port: u16,
    pub payload: Option<&'a [u8]>,
    pub segment: Option<Segment<'a>>,
}

/// A piece of a TCP connection, one way.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Segment<'a> {
    /// From and to, as they lie in the IP header.
    pub addresses: &'a [u8],
    pub from_port: u16,
    pub to_port: u16,
    /// Number of the payload's first byte.
    pub sequence: u32,
    /// The connection begins: its first byte has the number behind `sequence`.
    pub is_start: bool,
    pub payload: &'a [u8],
}

#[derive(Clone, Copy)]
enum Order {
    Little,
    Big,
}

impl Order {
    fn u16(self, b: &[u8], at: usize) -> Option<u16> {
        let b = b.get(at..at + 2)?.try_into().ok()?;
        Some(match self {
            Order::Little => u16::from_le_bytes(b),
            Order::Big => u16::from_be_bytes(b),
        })
    }
    fn u32(self, b: &[u8], at: usize) -> Option<u32> {
        let b = b.get(at..at + 4)?.try_into().ok()?;
        Some(match self {
            Order::Little => u32::from_le_bytes(b),
            Order::Big => u32::from_be_bytes(b),
        })
    }
}

/// Byte order and ticks per second, from a pcap file's magic number.
fn classic(bytes: &[u8]) -> Option<(Order, u64)> {
    Some(match bytes.get(..4)? {
        [0xD4, 0xC3, 0xB2, 0xA1] => (Order::Little, 1_000_000),
        [0xA1, 0xB2, 0xC3, 0xD4] => (Order::Big, 1_000_000),
        [0x4D, 0x3C, 0xB2, 0xA1] => (Order::Little, 1_000_000_000),
        [0xA1, 0xB2, 0x3C, 0x4D] => (Order::Big, 1_000_000_000),
        _ => return None,
    })
}

fn is_pcapng(bytes: &[u8]) -> bool {
    bytes.starts_with(&[0x0A, 0x0D, 0x0D, 0x0A])
        && matches!(
            bytes.get(8..12),
            Some([0x4D, 0x3C, 0x2B, 0x1A] | [0x1A, 0x2B, 0x3C, 0x4D])
        )
}

pub fn is_capture(bytes: &[u8]) -> bool {
    classic(bytes).is_some() || is_pcapng(bytes)
}

/// All packets, in the file's order.
pub fn packets(bytes: &[u8]) -> Packets<'_> {
    match classic(bytes) {
        Some((order, ticks_per_s)) => Packets {
            rest: bytes.get(24..).unwrap_or(&[]),
            order,
            ng: false,
            interfaces: vec![Interface {
                link: order.u32(bytes, 20).unwrap_or(u32::MAX) & 0xFFFF,
                ticks_per_s,
            }],
        },
        None => Packets {
            rest: if is_pcapng(bytes) { bytes } else { &[] },
            order: Order::Little,
            ng: true,
            interfaces: Vec::new(),
        },
    }
}

#[derive(Clone, Copy)]
struct Interface {
    link: u32,
    ticks_per_s: u64,
}

pub struct Packets<'a> {
    rest: &'a [u8],
    order: Order,
    ng: bool,
    interfaces: Vec<Interface>,
}

impl<'a> Iterator for Packets<'a> {
    type Item = Packet<'a>;

    fn next(&mut self) -> Option<Packet<'a>> {
        if !self.ng {
            return self.next_classic();
        }
        loop {
            if let Some(packet) = self.next_block()? {
                return Some(packet);
            }
        }
    }
}

impl<'a> Packets<'a> {
    fn next_classic(&mut self) -> Option<Packet<'a>> {
        let (order, head) = (self.order, self.rest);
        let seconds = u64::from(order.u32(head, 0)?);
        let fraction = u64::from(order.u32(head, 4)?);
        let len = order.u32(head, 8)? as usize;
        if len > MAX_PACKET {
            return None;
        }
        let data = head.get(16..16 + len)?;
        self.rest = &head[16 + len..];
        let interface = self.interfaces[0];
        let ticks = seconds * interface.ticks_per_s + fraction;
        Some(packet(data, interface, ticks))
    }

    /// `Some(None)`: a block that is no packet.
    fn next_block(&mut self) -> Option<Option<Packet<'a>>> {
        let block = self.rest;
        if block.starts_with(&[0x0A, 0x0D, 0x0D, 0x0A]) {
            self.order = match block.get(8)? {
                0x4D => Order::Little,
                _ => Order::Big,
            };
            self.interfaces.clear();
        }
        let order = self.order;
        let len = order.u32(block, 4)? as usize;
        if !(12..=MAX_PACKET + 64).contains(&len) || !len.is_multiple_of(4) {
            return None;
        }
        let body = block.get(8..len - 4)?;
        self.rest = block.get(len..)?;
        match order.u32(block, 0)? {
            1 => self.interfaces.push(Interface {
                link: u32::from(order.u16(body, 0)?),
                ticks_per_s: ticks_per_s(order, body.get(8..)?),
            }),
            6 => {
                let interface = order.u32(body, 0)? as usize;
                let Some(&interface) = self.interfaces.get(interface) else {
                    return Some(None);
                };
                let high = u64::from(order.u32(body, 4)?);
                let ticks = high << 32 | u64::from(order.u32(body, 8)?);
                let captured = order.u32(body, 12)? as usize;
                let data = body.get(20..20_usize.saturating_add(captured))?;
                return Some(Some(packet(data, interface, ticks)));
            }
            _ => {}
        }
        Some(None)
    }
}

/// Option `if_tsresol` (9) of an interface; microseconds without it.
fn ticks_per_s(order: Order, mut options: &[u8]) -> u64 {
    while let (Some(code), Some(len)) = (order.u16(options, 0), order.u16(options, 2)) {
        let len = usize::from(len);
        if let (9, Some(&resolution)) = (code, options.get(4)) {
            let power = u32::from(resolution & 0x7F);
            let base: u64 = if resolution & 0x80 == 0 { 10 } else { 2 };
            return base.checked_pow(power).unwrap_or(1_000_000);
        }
        let Some(rest) = options.get(4 + len.next_multiple_of(4)..) else {
            break;
        };
        options = rest;
        if code == 0 {
            break;
        }
    }
    1_000_000
}

fn packet(data: &[u8], interface: Interface, ticks: u64) -> Packet<'_> {
    let ns = u128::from(ticks) * 1_000_000_000 / u128::from(interface.ticks_per_s.max(1));
    let ip = ip_packet(data, interface.link);
    let datagram = ip.and_then(udp);
    Packet {
        arrival: UtcNs(i64::try_from(ns).unwrap_or(i64::MAX)),
        port: datagram.map_or(0, |(port, _)| port),
        payload: datagram.map(|(_, payload)| payload),
        segment: ip.and_then(tcp),
    }
}

/// Strips the link layer.
fn ip_packet(data: &[u8], link: u32) -> Option<&[u8]> {
    match link {
        ETHERNET => {
            let mut at = 12;
            // VLAN tags, one inside the other.
            while matches!(Order::Big.u16(data, at)?, 0x8100 | 0x88A8 | 0x9100) {
                at += 4;
            }
            matches!(Order::Big.u16(data, at)?, 0x0800 | 0x86DD).then(|| data.get(at + 2..))?
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
    let len = usize::from(Order::Big.u16(datagram, 4)?);
    Some((Order::Big.u16(datagram, 2)?, datagram.get(8..len)?))
}

fn tcp(ip: &[u8]) -> Option<Segment<'_>> {
    const SYN: u8 = 2;
    let segment = inside(ip, TCP)?;
    let header = usize::from(segment.get(12)? >> 4) * 4;
    Some(Segment {
        addresses: match ip[0] >> 4 {
            4 => ip.get(12..20)?,
            _ => ip.get(8..40)?,
        },
        from_port: Order::Big.u16(segment, 0)?,
        to_port: Order::Big.u16(segment, 2)?,
        sequence: Order::Big.u32(segment, 4)?,
        is_start: segment.get(13)? & SYN != 0,
        payload: segment.get(header..)?,
    })
}

/// What an IP packet that is no fragment carries of a protocol, without the padding of short Ethernet frames.
fn inside(ip: &[u8], wanted: u8) -> Option<&[u8]> {
    let (protocol, header, total) = match ip.first()? >> 4 {
        4 => {
            let fragment = Order::Big.u16(ip, 6)? & 0x3FFF;
            if fragment != 0 {
                return None;
            }
            let total = usize::from(Order::Big.u16(ip, 2)?);
            (*ip.get(9)?, usize::from(ip[0] & 0xF) * 4, total)
        }
        6 => (*ip.get(6)?, 40, 40 + usize::from(Order::Big.u16(ip, 4)?)),
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
    fn the_payload_comes_without_tags_and_padding_from_pcap_and_pcapng() {
        let text: &[u8] = b"$HEHDT,1,T\r\n";
        for vlan in [false, true] {
            let frame = frame(text, vlan);
            let mut file = vec![0xD4, 0xC3, 0xB2, 0xA1, 2, 0, 4, 0, 0, 0, 0, 0, 0, 0, 0, 0];
            file.extend([0, 0, 4, 0, 1, 0, 0, 0]);
            for v in [1_406_851_200, 123_456, frame.len() as u32, 60] {
                file.extend(v.to_le_bytes());
            }
            file.extend(&frame);
            // A cut packet behind it.
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
}
