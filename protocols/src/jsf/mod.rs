//! EdgeTech JSF: what it is, its header, and the words and numbers that all its files share.
//!
//! Sources: "JSF Data File Description" 0004824 Rev. 1.20 (March 2016), public, for the header and all data messages; the command messages
//! from what a public client of the live protocol sends and reads (LSTS DUNE, `Sensors.Edgetech2205`). Little endian throughout.
//!
//! A message is a header of 16 bytes and a body. The same messages go over two TCP connections, commands over [`COMMAND_PORT`] and data over
//! [`DATA_PORT`], and stand one behind the other in a `.jsf` file, which has no header of its own.
//!
//! - [`sonar_data`]: message 80, one channel of one ping
//! - [`block_float`]: its samples, i16 with one exponent for all
//! - [`sensors`]: messages 2002, 2020, 2060, 2080, 2091
//! - [`system`]: messages 182, 426
//! - [`control`]: commands, replies and errors
//! - [`describe`](fn@describe): any message in words

pub mod block_float;
pub mod control;
mod describe;
pub mod sensors;
pub mod sonar_data;
pub mod system;

use std::ops::Range;

use binrw::{BinRead, BinWrite};

use crate::WireError;
use crate::framing::{Framing, Look, Splitter};
use crate::layout::{data_at, layout};

pub use control::{Control, Value};
pub use describe::describe;
pub use sensors::{Dvl2080, Nmea2002, PitchRoll2020, Pressure2060, Situation2091};
pub use sonar_data::{DataFormat, SonarData80, SonarDataHeader, emit_80};
pub use system::{FileTime426, SystemInformation182};

pub const COMMAND_PORT: u16 = 1700;
pub const DATA_PORT: u16 = 1701;
/// The first two bytes of every message, 01 16.
pub const MARK: u16 = 0x1601;
/// Revision of the layout that messages are written in.
pub const PROTOCOL_VERSION: u8 = 0x0D;
/// Longest body read from a connection unless told otherwise: 2^20 pairs of i16 behind a header, and then some.
pub const MAX_BODY_BYTES: u32 = 1 << 23;
/// A client in wide use passes over longer bodies.
pub const BODY_BYTES_THAT_EVERYBODY_READS: usize = 256 * 1024;

/// Subsystem numbers.
pub mod subsystem {
    pub const SUB_BOTTOM: u8 = 0;
    pub const SIDE_SCAN_LOW: u8 = 20;
    pub const SIDE_SCAN_HIGH: u8 = 21;
    pub const SIDE_SCAN_VERY_HIGH: u8 = 22;
    pub const BATHYMETRY_LOW: u8 = 40;
    pub const BATHYMETRY_HIGH: u8 = 41;
    pub const BATHYMETRY_VERY_HIGH: u8 = 42;
    pub const RAW_SERIAL: u8 = 100;
    pub const PARSED_SERIAL: u8 = 101;
}

/// Message types.
pub mod message_type {
    pub const SYSTEM_TIME: u16 = 22;
    pub const SHUTDOWN: u16 = 25;
    pub const ALIVE: u16 = 41;
    pub const SYSTEM_TYPE: u16 = 44;
    pub const OPERATIONAL: u16 = 45;
    pub const SONAR_DATA: u16 = 80;
    pub const DATA_ACTIVE: u16 = 83;
    pub const PING: u16 = 120;
    pub const PING_GAIN: u16 = 121;
    /// Known by its number only: its value is carried as it is.
    pub const PING_122: u16 = 122;
    pub const PING_SELECT: u16 = 123;
    pub const PING_RATE: u16 = 124;
    pub const PING_TRIGGER: u16 = 125;
    pub const PING_RANGE: u16 = 128;
    pub const PING_COUPLING: u16 = 129;
    pub const PING_AUTO_SELECT: u16 = 133;
    pub const ADC_GAIN: u16 = 140;
    pub const ADC_AGC: u16 = 141;
    pub const ADC_RATE: u16 = 142;
    pub const SYSTEM_INFORMATION: u16 = 182;
    pub const FILE_TIMESTAMP: u16 = 426;
    pub const FILE_PADDING: u16 = 428;
    pub const NMEA: u16 = 2002;
    pub const PITCH_ROLL: u16 = 2020;
    pub const PRESSURE: u16 = 2060;
    pub const DVL: u16 = 2080;
    pub const SITUATION: u16 = 2091;
}

/// What a message wants.
pub mod command_type {
    pub const SET: u8 = 0;
    pub const GET: u8 = 1;
    /// The answer to GET, and every data message.
    pub const REPLY: u8 = 2;
    /// The answer to a command that was refused; the body is an error code.
    pub const ERROR: u8 = 3;
}

/// The header of every message.
#[derive(Debug, Clone, Copy, PartialEq, Eq, BinRead, BinWrite)]
pub struct MessageHeader {
    /// [`MARK`].
    pub mark: u16,
    pub protocol_version: u8,
    pub session: u8,
    pub message_type: u16,
    /// See [`command_type`].
    pub command_type: u8,
    /// See [`subsystem`].
    pub subsystem: u8,
    /// 0 port, 1 starboard; a stave; a serial port.
    pub channel: u8,
    /// A reply carries that of its command.
    #[brw(pad_after = 2)]
    pub sequence: u8,
    /// Bytes behind this header.
    pub body_bytes: u32,
}

layout!(MessageHeader, 16, "JSF header", Little);

impl MessageHeader {
    /// The header of a data message; its body's length is filled in when it is written.
    pub fn data(message_type: u16, subsystem: u8, channel: u8) -> Self {
        Self {
            mark: MARK,
            protocol_version: PROTOCOL_VERSION,
            session: 0,
            message_type,
            command_type: command_type::REPLY,
            subsystem,
            channel,
            sequence: 0,
            body_bytes: 0,
        }
    }

    pub fn check(&self, max_body_bytes: u32) -> Result<(), WireError> {
        if self.mark != MARK {
            return Err(WireError::Mark {
                what: "JSF mark",
                expected: MARK.into(),
                got: self.mark.into(),
            });
        }
        if self.body_bytes > max_body_bytes {
            return Err(WireError::Oversized {
                what: "JSF body",
                got_bytes: self.body_bytes.into(),
                limit_bytes: max_body_bytes.into(),
            });
        }
        Ok(())
    }
}

/// A message, read: its body stays where it was.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Message<'a> {
    pub header: MessageHeader,
    pub body: &'a [u8],
}

impl<'a> Message<'a> {
    /// Reads the message at the front of `bytes`.
    pub fn parse(bytes: &'a [u8]) -> Result<Self, WireError> {
        let header = MessageHeader::parse(bytes)?;
        header.check(MAX_BODY_BYTES)?;
        let body = data_at(
            bytes,
            MessageHeader::SIZE_BYTES,
            header.body_bytes.into(),
            "JSF body",
        )?;
        Ok(Self { header, body })
    }

    /// Header and body.
    pub fn size_bytes(&self) -> usize {
        MessageHeader::SIZE_BYTES + self.body.len()
    }
}

/// Appends a message whose body `write_body` appends, and says where it lies in `buf`.
pub fn emit_message(
    buf: &mut Vec<u8>,
    header: &MessageHeader,
    write_body: impl FnOnce(&mut Vec<u8>),
) -> Range<usize> {
    let start = buf.len();
    header.emit(buf);
    let body = buf.len();
    write_body(buf);
    let body_bytes = (buf.len() - body) as u32;
    buf[body - 4..body].copy_from_slice(&body_bytes.to_le_bytes());
    start..buf.len()
}

/// How a stream of messages shows its lengths.
#[derive(Debug, Clone, Copy)]
pub struct JsfFraming {
    pub max_body_bytes: u32,
}

impl Default for JsfFraming {
    fn default() -> Self {
        Self {
            max_body_bytes: MAX_BODY_BYTES,
        }
    }
}

impl Framing for JsfFraming {
    fn max_message_bytes(&self) -> usize {
        MessageHeader::SIZE_BYTES + self.max_body_bytes as usize
    }

    fn look(&self, bytes: &[u8]) -> Look {
        let mark = MARK.to_le_bytes();
        if bytes.iter().zip(mark).any(|(&byte, mark)| byte != mark) {
            return Look::Wrong(WireError::Mark {
                what: "JSF mark",
                expected: MARK.into(),
                got: bytes
                    .iter()
                    .take(2)
                    .rev()
                    .fold(0, |sum, &byte| sum << 8 | u64::from(byte)),
            });
        }
        let Ok(header) = MessageHeader::parse(bytes) else {
            return Look::More;
        };
        if let Err(error) = header.check(self.max_body_bytes) {
            return Look::Wrong(error);
        }
        let whole = MessageHeader::SIZE_BYTES + header.body_bytes as usize;
        if bytes.len() < whole {
            Look::More
        } else {
            Look::Whole(whole)
        }
    }
}

/// Messages from a connection or from a `.jsf` file read in pieces.
pub type JsfStream = Splitter<JsfFraming>;
