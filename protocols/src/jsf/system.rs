//! What a file says of itself: 182 and 426. Source: Rev. 1.20, tables 2-13 and 2-14.

use std::ops::Range;

use binrw::{BinRead, BinWrite};

use super::sensors::SensorTime;
use super::{MessageHeader, emit_message, message_type};
use crate::WireError;
use crate::layout::layout;

/// 182: the system that recorded. Longer ones, with parts that the manual calls reserved, are read by their first 24 bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, BinRead, BinWrite)]
pub struct SystemInformation182 {
    /// See [`super::control::system_type`].
    pub system_type: i32,
    /// 0 disabled.
    pub low_rate_io: i32,
    pub software_version: i32,
    pub subsystems: i32,
    pub serial_ports: i32,
    pub serial_number: i32,
}

layout!(SystemInformation182, 24, "JSF 182", Little);

impl SystemInformation182 {
    pub fn emit_message(&self, buf: &mut Vec<u8>) -> Range<usize> {
        let header = MessageHeader::data(message_type::SYSTEM_INFORMATION, 0, 0);
        emit_message(buf, &header, |buf| self.emit(buf))
    }
}

/// 426: when a file was begun and ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct FileTime426 {
    pub time: SensorTime,
}

impl FileTime426 {
    pub fn parse(body: &[u8]) -> Result<Self, WireError> {
        SensorTime::parse(body).map(|time| Self { time })
    }

    pub fn emit_message(&self, buf: &mut Vec<u8>) -> Range<usize> {
        let header = MessageHeader::data(message_type::FILE_TIMESTAMP, 0, 0);
        emit_message(buf, &header, |buf| self.time.emit(buf))
    }
}
