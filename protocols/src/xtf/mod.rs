//! Triton XTF files: structure, and the common part of all packets.
//!
//! Source: "eXtended Triton Format (XTF)" Rev. X41 (2016), public. Numbers are little endian, and angles are in degrees. Positive
//! directions are nose up, roll to starboard (port up) and sensor up. Times have a resolution of 0.01 s.
//!
//! A file is a header of 1024 bytes ([`FileHeader`], with up to six channels) and packets. Each packet has the mark [`MARK`], its type and
//! its length, which is a multiple of 64.
//!
//! - [`file_header`]: the header and its channels
//! - [`ping`]: one ping of side-scan, all channels
//! - [`attitude`]: one reading of a motion sensor

pub mod attitude;
pub mod file_header;
pub mod ping;

use binrw::{BinRead, BinWrite};

use crate::WireError;
use crate::framing::{Framing, Scan, Splitter};
use crate::layout::{data_at, layout};

pub use attitude::Attitude;
pub use file_header::{ChannelInfo, ChannelKind, FileHeader, NavUnits, SampleFormat};
pub use ping::{ChannelHeader, ChannelSamples, Ping, PingHeader, Samples, emit_ping};

/// The first two bytes of every packet, CE FA.
pub const MARK: u16 = 0xFACE;
/// Length step of packets, bytes. Packets are padded with zeros to a multiple of this step.
pub const PACKET_STEP_BYTES: usize = 64;
/// Default maximum packet size of the parser.
pub const MAX_PACKET_BYTES: u32 = 1 << 26;

/// Packet types.
pub mod packet_type {
    /// Side-scan ping.
    pub const SONAR: u8 = 0;
    /// Annotation text.
    pub const NOTES: u8 = 1;
    /// Attitude.
    pub const ATTITUDE: u8 = 3;
}

/// The first 14 bytes of every packet.
#[derive(Debug, Clone, Copy, PartialEq, Eq, BinRead, BinWrite)]
pub struct PacketStart {
    /// Mark, [`MARK`].
    pub mark: u16,
    /// Packet type, one of [`packet_type`].
    pub packet_type: u8,
    /// Sub-channel of the packet.
    pub sub_channel: u8,
    #[brw(pad_after = 4)]
    /// Number of channels that follow.
    pub channels_to_follow: u16,
    /// Size of the whole packet including padding.
    pub packet_bytes: u32,
}

layout!(PacketStart, 14, "XTF packet start", Little);

impl PacketStart {
    fn check(&self, max_packet_bytes: u32) -> Result<(), WireError> {
        if self.mark != MARK {
            return Err(WireError::mark("XTF mark", MARK, self.mark));
        }
        if self.packet_bytes < Self::SIZE_BYTES as u32 {
            return Err(WireError::truncated(
                "XTF packet",
                Self::SIZE_BYTES as u64,
                self.packet_bytes as usize,
            ));
        }
        if self.packet_bytes > max_packet_bytes {
            return Err(WireError::oversized(
                "XTF packet",
                self.packet_bytes,
                max_packet_bytes,
            ));
        }
        Ok(())
    }
}

/// The complete packet at the front of `bytes`, which must have the given type.
fn packet_of(bytes: &[u8], packet_type: u8) -> Result<(PacketStart, &[u8]), WireError> {
    let start = PacketStart::parse(bytes)?;
    start.check(MAX_PACKET_BYTES)?;
    if start.packet_type != packet_type {
        return Err(WireError::unsupported("XTF packet type", start.packet_type));
    }
    data_at(bytes, 0, start.packet_bytes.into(), "XTF packet").map(|packet| (start, packet))
}

/// Framing of the packets after the file header.
#[derive(Debug, Clone, Copy)]
pub struct XtfFraming {
    /// Maximum packet size accepted.
    pub max_packet_bytes: u32,
}

impl Default for XtfFraming {
    fn default() -> Self {
        Self {
            max_packet_bytes: MAX_PACKET_BYTES,
        }
    }
}

impl Framing for XtfFraming {
    fn max_message_bytes(&self) -> usize {
        (self.max_packet_bytes as usize).max(PacketStart::SIZE_BYTES)
    }

    fn scan(&self, bytes: &[u8]) -> Scan {
        let mark = MARK.to_le_bytes();
        let Ok(start) = PacketStart::parse(bytes) else {
            return if bytes.iter().zip(mark).all(|(&byte, mark)| byte == mark) {
                Scan::More
            } else {
                Scan::Wrong(WireError::mark("XTF mark", MARK, bytes[0]))
            };
        };
        match start.check(self.max_packet_bytes) {
            Err(error) => Scan::Wrong(error),
            Ok(()) if bytes.len() < start.packet_bytes as usize => Scan::More,
            Ok(()) => Scan::Whole(start.packet_bytes as usize),
        }
    }
}

/// Splitter of a file, in pieces after its header, into packets.
pub type XtfStream = Splitter<XtfFraming>;
