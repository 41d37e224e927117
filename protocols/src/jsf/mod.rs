//! EdgeTech JSF: overview, message header, and common numbers.
//!
//! Sources: "JSF Data File Description" 0004824 Rev. 1.20 (March 2016), public, for the header and all data messages. Command
//! messages follow a public client of the live protocol (LSTS DUNE, `Sensors.Edgetech2205`). Numbers are little endian.
//!
//! A message is a header of 16 bytes and a body. The same messages use two TCP connections, commands on [`COMMAND_PORT`] and data on
//! [`DATA_PORT`]. A `.jsf` file is a sequence of messages without a file header.
//!
//! - [`sonar_data`]: message 80, one channel of one ping
//! - [`block_float`]: its samples, i16 with a common exponent
//! - [`sensors`]: messages 2002, 2020, 2060, 2080, 2091
//! - [`system`]: messages 182, 426
//! - [`control`]: commands, replies and errors
//! - [`describe`](fn@describe): any message as text

pub mod block_float;
pub mod control;
mod describe;
pub mod sensors;
pub mod sonar_data;
pub mod system;

use std::ops::Range;

use binrw::{BinRead, BinWrite};

use crate::WireError;
use crate::framing::{Framing, Scan, Splitter};
use crate::layout::{data_at, layout};

pub use control::{Control, Value};
pub use describe::describe;
pub use sensors::{Dvl2080, Nmea2002, PitchRoll2020, Pressure2060, Situation2091};
pub use sonar_data::{DataFormat, SonarData80, SonarDataHeader, emit_80};
pub use system::{FileTime426, SystemInformation182};

/// TCP port of commands.
pub const COMMAND_PORT: u16 = 1700;
/// TCP port of data.
pub const DATA_PORT: u16 = 1701;
/// The first two bytes of every message, 01 16.
pub const MARK: u16 = 0x1601;
/// Revision of the layouts used in messages.
pub const PROTOCOL_VERSION: u8 = 0x0D;
/// Default maximum body size of the parser: 2^20 pairs of i16 and a header, rounded up.
pub const MAX_BODY_BYTES: u32 = 1 << 23;

/// Subsystem numbers.
pub mod subsystem {
    /// Sub-bottom profiler.
    pub const SUB_BOTTOM: u8 = 0;
    /// Side-scan, low frequency.
    pub const SIDE_SCAN_LOW: u8 = 20;
    /// Side-scan, high frequency.
    pub const SIDE_SCAN_HIGH: u8 = 21;
    /// Side-scan, very high frequency.
    pub const SIDE_SCAN_VERY_HIGH: u8 = 22;
    /// Bathymetry, low frequency.
    pub const BATHYMETRY_LOW: u8 = 40;
    /// Bathymetry, high frequency.
    pub const BATHYMETRY_HIGH: u8 = 41;
    /// Bathymetry, very high frequency.
    pub const BATHYMETRY_VERY_HIGH: u8 = 42;
    /// Unprocessed data of serial ports.
    pub const RAW_SERIAL: u8 = 100;
    /// Decoded data of serial ports.
    pub const PARSED_SERIAL: u8 = 101;
}

/// Message types.
pub mod message_type {
    /// Time of the sonar's clock.
    pub const SYSTEM_TIME: u16 = 22;
    /// Stop of the sonar.
    pub const SHUTDOWN: u16 = 25;
    /// Connection check.
    pub const ALIVE: u16 = 41;
    /// Kind of sonar.
    pub const SYSTEM_TYPE: u16 = 44;
    /// State of operation.
    pub const OPERATIONAL: u16 = 45;
    /// Samples of one channel.
    pub const SONAR_DATA: u16 = 80;
    /// Selects whether a channel sends data.
    pub const DATA_ACTIVE: u16 = 83;
    /// Switches pinging on and off.
    pub const PING: u16 = 120;
    /// Transmit amplitude, times 1000.
    pub const PING_GAIN: u16 = 121;
    /// Name unknown; the value is not interpreted.
    pub const PING_122: u16 = 122;
    /// Selects the pulse file.
    pub const PING_SELECT: u16 = 123;
    /// Ping rate, times 1000.
    pub const PING_RATE: u16 = 124;
    /// Trigger source.
    pub const PING_TRIGGER: u16 = 125;
    /// Range, millimetres.
    pub const PING_RANGE: u16 = 128;
    /// Coupling to another subsystem.
    pub const PING_COUPLING: u16 = 129;
    /// Automatic selection of the pulse.
    pub const PING_AUTO_SELECT: u16 = 133;
    /// Receiver gain, times 1000.
    pub const ADC_GAIN: u16 = 140;
    /// Automatic receiver gain.
    pub const ADC_AGC: u16 = 141;
    /// Sample rate of the converter.
    pub const ADC_RATE: u16 = 142;
    /// Description of the system.
    pub const SYSTEM_INFORMATION: u16 = 182;
    /// Start or end of a file.
    pub const FILE_TIMESTAMP: u16 = 426;
    /// Padding of a file.
    pub const FILE_PADDING: u16 = 428;
    /// NMEA sentence.
    pub const NMEA: u16 = 2002;
    /// Motion sensor.
    pub const PITCH_ROLL: u16 = 2020;
    /// Pressure sensor.
    pub const PRESSURE: u16 = 2060;
    /// Doppler velocity log.
    pub const DVL: u16 = 2080;
    /// Combined navigation.
    pub const SITUATION: u16 = 2091;
}

/// Purpose of a message.
pub mod command_type {
    /// Sets a value.
    pub const SET: u8 = 0;
    /// Requests a value.
    pub const GET: u8 = 1;
    /// Answer to GET, and every data message.
    pub const REPLY: u8 = 2;
    /// Answer to a refused command; the body is an error code.
    pub const ERROR: u8 = 3;
}

/// The header of every message.
#[derive(Debug, Clone, Copy, PartialEq, Eq, BinRead, BinWrite)]
pub struct MessageHeader {
    /// Mark, [`MARK`].
    pub mark: u16,
    /// Revision of the layouts.
    pub protocol_version: u8,
    /// Session number.
    pub session: u8,
    /// Message type, one of [`message_type`].
    pub message_type: u16,
    /// Purpose of the message, one of [`command_type`].
    pub command_type: u8,
    /// Subsystem number, one of [`subsystem`].
    pub subsystem: u8,
    /// Channel: a side (0 port, 1 starboard), an element, or a serial port.
    pub channel: u8,
    /// Sequence number; a reply repeats that of its command.
    #[brw(pad_after = 2)]
    pub sequence: u8,
    /// Size of the body.
    pub body_bytes: u32,
}

layout!(MessageHeader, 16, "JSF header", Little);

impl MessageHeader {
    /// Header of a data message; the body size is set when the message is emitted.
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

    /// Checks the mark and the body size.
    pub fn check(&self, max_body_bytes: u32) -> Result<(), WireError> {
        if self.mark != MARK {
            return Err(WireError::mark("JSF mark", MARK, self.mark));
        }
        if self.body_bytes > max_body_bytes {
            return Err(WireError::oversized(
                "JSF body",
                self.body_bytes,
                max_body_bytes,
            ));
        }
        Ok(())
    }
}

/// A parsed message that borrows its body.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Message<'a> {
    /// Message header.
    pub header: MessageHeader,
    /// Bytes of the body.
    pub body: &'a [u8],
}

impl<'a> Message<'a> {
    /// Parses the message at the front of `bytes`.
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

    /// Size of header and body.
    pub fn size_bytes(&self) -> usize {
        MessageHeader::SIZE_BYTES + self.body.len()
    }
}

/// Appends a message with the body that `write_body` appends, and returns its byte range.
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

/// Framing of messages in a stream.
#[derive(Debug, Clone, Copy)]
pub struct JsfFraming {
    /// Maximum body size accepted.
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

    fn scan(&self, bytes: &[u8]) -> Scan {
        let mark = MARK.to_le_bytes();
        if bytes.iter().zip(mark).any(|(&byte, mark)| byte != mark) {
            return Scan::Wrong(WireError::Mark {
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
            return Scan::More;
        };
        if let Err(error) = header.check(self.max_body_bytes) {
            return Scan::Wrong(error);
        }
        let whole = MessageHeader::SIZE_BYTES + header.body_bytes as usize;
        if bytes.len() < whole {
            Scan::More
        } else {
            Scan::Whole(whole)
        }
    }
}

/// Splitter of a connection, or of a `.jsf` file in pieces, into messages.
pub type JsfStream = Splitter<JsfFraming>;
