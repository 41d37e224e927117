//! Messages that describe a file: 182 and 426. Source: Rev. 1.20, tables 2-13 and 2-14.

use std::ops::Range;

use binrw::{BinRead, BinWrite};

use super::sensors::SensorTime;
use super::{MessageHeader, emit_message, message_type};
use crate::WireError;
use crate::layout::layout;

/// Message 182: recording system. Longer messages contain parts that the manual calls reserved; their first 24 bytes are parsed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, BinRead, BinWrite)]
pub struct SystemInformation182 {
    /// Sonar type, one of [`super::control::system_type`].
    pub system_type: i32,
    /// Low-rate input and output; 0 is disabled.
    pub low_rate_io: i32,
    /// Version of the sonar's software.
    pub software_version: i32,
    /// Number of subsystems.
    pub subsystems: i32,
    /// Number of serial ports.
    pub serial_ports: i32,
    /// Serial number of the sonar.
    pub serial_number: i32,
}

layout!(SystemInformation182, 24, "JSF 182", Little);

impl SystemInformation182 {
    /// Appends the whole message and returns its byte range.
    pub fn emit_message(&self, buf: &mut Vec<u8>) -> Range<usize> {
        let header = MessageHeader::data(message_type::SYSTEM_INFORMATION, 0, 0);
        emit_message(buf, &header, |buf| self.emit(buf))
    }
}

/// Message 426: start or end time of a file.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct FileTime426 {
    /// Start or end time.
    pub time: SensorTime,
}

impl FileTime426 {
    /// Parses the body of the message. Returns an error if the body is too short.
    pub fn parse(body: &[u8]) -> Result<Self, WireError> {
        SensorTime::parse(body).map(|time| Self { time })
    }

    /// Appends the whole message and returns its byte range.
    pub fn emit_message(&self, buf: &mut Vec<u8>) -> Range<usize> {
        let header = MessageHeader::data(message_type::FILE_TIMESTAMP, 0, 0);
        emit_message(buf, &header, |buf| self.time.emit(buf))
    }
}
