//! NORBIT WBMS: overview, packet header, and the common part of packets.
//!
//! Sources: TN-180196 "WBMS DFD External" (2018) and TN-180197 (control without a GUI), public in uri-ocean-robotics/norbit. Fields
//! that the document calls reserved follow the MIT licensed header of magnuan/wbms_georef. Numbers are little endian, and angles
//! are in rad.
//!
//! There are four TCP servers: text control, bathymetry, water column, and side-scan or snippets. A connection is a subscription. Each
//! packet is
//!
//! ```text
//! u32 mark DEADBEEF | type | size in bytes, whole packet | version | reserved | CRC-32 of the bytes after these 24
//! ```
//!
//! - [`bathymetry`]: type 1, detections
//! - [`backscatter`]: types 2 water column, 4 snippets, 5 side-scan
//! - [`control`]: text commands
//!
//! The public documents contain no element data.

pub mod backscatter;
pub mod bathymetry;
pub mod control;

use std::ops::Range;

use binrw::{BinRead, BinWrite};

use crate::WireError;
use crate::framing::{Framing, Scan, Splitter};
use crate::layout::{data_at, layout};

pub use backscatter::{
    Backscatter, BackscatterHead, DataKind, Tail, emit_backscatter, emit_backscatter_beam_major,
};
pub use bathymetry::{Bathymetry, BathymetryHead, Detection, emit_bathymetry};
pub use control::{Command, CommandError, answer, commands_in};

/// TCP port of the text control.
pub const CONTROL_PORT: u16 = 2209;
/// TCP port of bathymetry.
pub const BATHYMETRY_PORT: u16 = 2210;
/// TCP port of the water column.
pub const WATER_COLUMN_PORT: u16 = 2211;
/// TCP port of side-scan or snippets.
pub const SIDE_SCAN_PORT: u16 = 2212;
const MARK: u32 = 0xDEAD_BEEF;
/// Version of all packets.
pub const VERSION: u32 = 4;
/// Maximum packet size of the parser: 1024 beams x 4096 samples of f64 and their head.
pub const MAX_PACKET_BYTES: u32 = 1 << 26;

/// Packet types.
pub mod packet_type {
    /// Detections.
    pub const BATHYMETRY: u32 = 1;
    /// Samples of all beams.
    pub const WATER_COLUMN: u32 = 2;
    /// Samples around detections.
    pub const SNIPPETS: u32 = 4;
    /// Side-scan lines.
    pub const SIDE_SCAN: u32 = 5;
    /// Connection check without data.
    pub const HEARTBEAT: u32 = 7;
}

/// Header of a packet: the first 24 bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, BinRead, BinWrite)]
pub struct PacketHeader {
    /// Mark, DEADBEEF.
    pub mark: u32,
    /// Packet type, one of [`packet_type`].
    pub packet_type: u32,
    /// Size of the whole packet.
    pub size_bytes: u32,
    #[brw(pad_after = 4)]
    /// Version of the layout.
    pub version: u32,
    /// CRC-32 of the bytes after this header.
    pub crc: u32,
}

layout!(PacketHeader, 24, "WBMS header", Little);

impl PacketHeader {
    fn check(&self) -> Result<(), WireError> {
        if self.mark != MARK {
            return Err(WireError::mark("WBMS mark", MARK, self.mark));
        }
        if self.size_bytes < Self::SIZE_BYTES as u32 {
            return Err(WireError::truncated(
                "WBMS packet",
                Self::SIZE_BYTES as u64,
                self.size_bytes as usize,
            ));
        }
        if self.size_bytes > MAX_PACKET_BYTES {
            return Err(WireError::oversized(
                "WBMS packet",
                self.size_bytes,
                MAX_PACKET_BYTES,
            ));
        }
        Ok(())
    }
}

/// A parsed packet that borrows its payload.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Packet<'a> {
    /// Packet header.
    pub header: PacketHeader,
    /// Bytes after the header.
    pub payload: &'a [u8],
}

impl<'a> Packet<'a> {
    /// Parses the packet at the front of `bytes` and verifies its CRC.
    pub fn parse(bytes: &'a [u8]) -> Result<Self, WireError> {
        let header = PacketHeader::parse(bytes)?;
        header.check()?;
        let packet = data_at(bytes, 0, header.size_bytes.into(), "WBMS packet")?;
        let payload = &packet[PacketHeader::SIZE_BYTES..];
        let computed = crc32(payload);
        if header.crc != computed {
            return Err(WireError::checksum("WBMS packet", header.crc, computed));
        }
        if header.version != VERSION {
            return Err(WireError::unsupported("WBMS version", header.version));
        }
        Ok(Self { header, payload })
    }
}

/// Appends a packet with the payload that `write_payload` appends, and returns its byte range.
fn emit_packet(
    buf: &mut Vec<u8>,
    packet_type: u32,
    write_payload: impl FnOnce(&mut Vec<u8>),
) -> Range<usize> {
    let start = buf.len();
    buf.resize(start + PacketHeader::SIZE_BYTES, 0);
    write_payload(buf);
    let payload = start + PacketHeader::SIZE_BYTES;
    let header = PacketHeader {
        mark: MARK,
        packet_type,
        size_bytes: (buf.len() - start) as u32,
        version: VERSION,
        crc: crc32(&buf[payload..]),
    };
    let mut head = Vec::with_capacity(PacketHeader::SIZE_BYTES);
    header.emit(&mut head);
    buf[start..payload].copy_from_slice(&head);
    start..buf.len()
}

/// CRC-32 as in zlib: polynomial 0xEDB88320.
pub fn crc32(bytes: &[u8]) -> u32 {
    crc32fast::hash(bytes)
}

/// Framing of packets in a connection.
#[derive(Debug, Clone, Copy, Default)]
pub struct WbmsFraming;

impl Framing for WbmsFraming {
    fn max_message_bytes(&self) -> usize {
        MAX_PACKET_BYTES as usize
    }

    fn scan(&self, bytes: &[u8]) -> Scan {
        let mark = MARK.to_le_bytes();
        if bytes.iter().zip(mark).any(|(&byte, mark)| byte != mark) {
            return Scan::Wrong(WireError::mark("WBMS mark", MARK, bytes[0]));
        }
        match PacketHeader::parse(bytes).map(|header| (header, header.check())) {
            Err(_) => Scan::More,
            Ok((_, Err(error))) => Scan::Wrong(error),
            Ok((header, Ok(()))) if bytes.len() < header.size_bytes as usize => Scan::More,
            Ok((header, Ok(()))) => Scan::Whole(header.size_bytes as usize),
        }
    }
}

/// Splitter of a connection into packets.
pub type WbmsStream = Splitter<WbmsFraming>;
