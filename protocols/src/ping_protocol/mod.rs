//! The Ping protocol of Blue Robotics and Cerulean: overview, frame, and messages.
//!
//! Source: `src/definitions/*.json` of bluerobotics/ping-protocol (MIT, public), from which the manufacturers generate their
//! clients. Messages 169 and 170 follow the client brping 0.2.5. Numbers are little endian. Transports are TCP, UDP (port [`PORT`]
//! in the manufacturers' examples) and serial links.
//!
//! ```text
//! 'B' 'R' | u16 payload length | u16 message | u8 source | u8 destination | payload | u16 sum of all bytes before
//! ```
//!
//! - [`common`]: messages that every device supports
//! - [`omniscan450`]: side-scan, one line of dB per ping
//! - [`surveyor240`]: multibeam, detected points
//!
//! This protocol has no public layout for element data.

pub mod common;
pub mod omniscan450;
pub mod surveyor240;

use std::ops::Range;

use crate::WireError;
use crate::framing::{Framing, Scan, Splitter};
use crate::layout::{data_at, text_of};

use common::{AckMessage, DeviceInformation, GeneralRequest, ProtocolVersion, SetDeviceId};
use omniscan450::{OsMonoProfile, OsPingParams, SetSpeedOfSound, SyncChannel};
use surveyor240::{
    AtofPointData, AttitudeReport, SetNetInfo, SetPingParameters, UtcResponse, WaterStats,
    YzPointData,
};

/// TCP and UDP port of Cerulean's devices in their examples.
pub const PORT: u16 = 51_200;
/// Size of the frame header.
pub const HEADER_BYTES: usize = 8;
/// Size of the checksum.
pub const CHECKSUM_BYTES: usize = 2;
/// Maximum size of a frame: the payload length has 16 bits.
pub const MAX_FRAME_BYTES: usize = HEADER_BYTES + u16::MAX as usize + CHECKSUM_BYTES;
const MARK: [u8; 2] = *b"BR";

/// Message numbers.
pub mod message_id {
    /// A message was accepted.
    pub const ACK: u16 = 1;
    /// A message was refused.
    pub const NACK: u16 = 2;
    /// Text for display.
    pub const ASCII_TEXT: u16 = 3;
    /// Identity of a device.
    pub const DEVICE_INFORMATION: u16 = 4;
    /// Version of the protocol.
    pub const PROTOCOL_VERSION: u16 = 5;
    /// Requests a message.
    pub const GENERAL_REQUEST: u16 = 6;
    /// JSON text.
    pub const JSON_WRAPPER: u16 = 10;
    /// The device requests the time.
    pub const UTC_REQUEST: u16 = 14;
    /// Time from the client.
    pub const UTC_RESPONSE: u16 = 15;
    /// Network settings.
    pub const SET_NET_INFO: u16 = 17;
    /// Sets the identifier of the device.
    pub const SET_DEVICE_ID: u16 = 100;
    /// Sets the speed of sound.
    pub const SET_SPEED_OF_SOUND: u16 = 116;
    /// Earlier number of SET_SPEED_OF_SOUND, in the definitions of some clients (crate `bluerobotics-ping` 0.3.6).
    pub const SET_SPEED_OF_SOUND_EARLIER: u16 = 1002;
    /// Water temperature and pressure.
    pub const WATER_STATS: u16 = 118;
    /// Synchronisation channel.
    pub const SYNC_CHANNEL: u16 = 169;
    /// Sets the synchronisation channel.
    pub const SET_SYNC_CHANNEL: u16 = 170;
    /// Direction of the vertical.
    pub const ATTITUDE_REPORT: u16 = 504;
    /// Omniscan: ping settings.
    pub const OS_PING_PARAMS: u16 = 2197;
    /// Omniscan: one line.
    pub const OS_MONO_PROFILE: u16 = 2198;
    /// Surveyor: points in the vertical plane.
    pub const YZ_POINT_DATA: u16 = 3011;
    /// Surveyor: angles and times of flight.
    pub const ATOF_POINT_DATA: u16 = 3012;
    /// Surveyor: ping settings.
    pub const SET_PING_PARAMETERS: u16 = 3023;
}

/// Sum of bytes, modulo 65536.
pub fn checksum(bytes: &[u8]) -> u16 {
    bytes
        .iter()
        .fold(0, |sum: u16, &byte| sum.wrapping_add(byte.into()))
}

/// A parsed frame that borrows its payload.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Frame<'a> {
    /// One of [`message_id`], or another number.
    pub message_id: u16,
    /// Identifier of the sender.
    pub source: u8,
    /// Identifier of the receiver.
    pub destination: u8,
    /// Bytes of the message.
    pub payload: &'a [u8],
}

impl<'a> Frame<'a> {
    /// Parses the frame at the front of `bytes` and verifies its checksum.
    pub fn parse(bytes: &'a [u8]) -> Result<Self, WireError> {
        const WHAT: &str = "Ping frame";
        let head = data_at(bytes, 0, HEADER_BYTES as u64, WHAT)?;
        if head[..2] != MARK {
            let got = u16::from_be_bytes([head[0], head[1]]);
            return Err(WireError::mark("Ping mark", u16::from_be_bytes(MARK), got));
        }
        let payload_bytes = u16::from_le_bytes([head[2], head[3]]);
        let payload = data_at(bytes, HEADER_BYTES, payload_bytes.into(), WHAT)?;
        let end = HEADER_BYTES + payload.len();
        let stored = data_at(bytes, end, CHECKSUM_BYTES as u64, WHAT)?;
        let (stored, computed) = (
            u16::from_le_bytes([stored[0], stored[1]]),
            checksum(&bytes[..end]),
        );
        if stored != computed {
            return Err(WireError::checksum(WHAT, stored, computed));
        }
        Ok(Self {
            message_id: u16::from_le_bytes([head[4], head[5]]),
            source: head[6],
            destination: head[7],
            payload,
        })
    }
}

/// Appends a frame with the payload that `write_payload` appends, and returns its byte range.
///
/// # Panics
/// If the payload is longer than 65535 bytes.
pub fn emit_frame(
    buf: &mut Vec<u8>,
    message_id: u16,
    source: u8,
    destination: u8,
    write_payload: impl FnOnce(&mut Vec<u8>),
) -> Range<usize> {
    let start = buf.len();
    buf.extend(MARK);
    buf.extend([0; 2]);
    buf.extend(message_id.to_le_bytes());
    buf.extend([source, destination]);
    write_payload(buf);
    let payload_bytes = u16::try_from(buf.len() - start - HEADER_BYTES)
        .expect("a Ping payload of at most 65535 bytes");
    buf[start + 2..start + 4].copy_from_slice(&payload_bytes.to_le_bytes());
    let sum = checksum(&buf[start..]);
    buf.extend(sum.to_le_bytes());
    start..buf.len()
}

/// Framing of frames in a connection. A frame with a wrong checksum is skipped.
#[derive(Debug, Clone, Copy, Default)]
pub struct PingFraming;

impl Framing for PingFraming {
    fn max_message_bytes(&self) -> usize {
        MAX_FRAME_BYTES
    }

    fn scan(&self, bytes: &[u8]) -> Scan {
        if bytes.iter().zip(MARK).any(|(&byte, mark)| byte != mark) {
            return Scan::Wrong(WireError::mark(
                "Ping mark",
                u16::from_be_bytes(MARK),
                bytes[0],
            ));
        }
        match Frame::parse(bytes) {
            Ok(frame) => Scan::Whole(HEADER_BYTES + frame.payload.len() + CHECKSUM_BYTES),
            Err(WireError::Truncated { .. }) => Scan::More,
            Err(error) => Scan::Wrong(error),
        }
    }
}

/// Splitter of a connection into frames.
pub type PingStream = Splitter<PingFraming>;

/// Parsed message of either direction.
#[derive(Debug, Clone, PartialEq)]
pub enum Message<'a> {
    /// Message 1 (acknowledge): a message is accepted.
    Ack(AckMessage),
    /// Message 2 (not acknowledge): a message is refused.
    Nack {
        /// Number of the refused message.
        refused_id: u16,
        /// Reason.
        text: String,
    },
    /// Message 3: text for display.
    AsciiText(String),
    /// Message 4: identity of a device.
    DeviceInformation(DeviceInformation),
    /// Message 5: version of the protocol.
    ProtocolVersion(ProtocolVersion),
    /// Message 6: requests a message.
    GeneralRequest(GeneralRequest),
    /// Message 100: sets the identifier of the device.
    SetDeviceId(SetDeviceId),
    /// Message 10: JSON text.
    Json(&'a [u8]),
    /// Message 116: sets the speed of sound.
    SetSpeedOfSound(SetSpeedOfSound),
    /// Message 169: synchronisation channel.
    SyncChannel(SyncChannel),
    /// Message 170: sets the synchronisation channel.
    SetSyncChannel(SyncChannel),
    /// Message 2197: ping settings.
    OsPingParams(OsPingParams),
    /// Message 2198: one line.
    OsMonoProfile(OsMonoProfile<'a>),
    /// Message 14 (UTC request): the device requests the time.
    UtcRequest,
    /// Message 15: time from the client.
    UtcResponse(UtcResponse),
    /// Message 17: network settings.
    SetNetInfo(SetNetInfo),
    /// Message 3023: ping settings.
    SetPingParameters(SetPingParameters),
    /// Message 504: direction of the vertical.
    AttitudeReport(AttitudeReport),
    /// Message 118: water temperature and pressure.
    WaterStats(WaterStats),
    /// Message 3012: angles and times of flight.
    AtofPointData(AtofPointData<'a>),
    /// Message 3011: points in the vertical plane.
    YzPointData(YzPointData<'a>),
    /// Any other message.
    Other {
        /// Number of the message.
        message_id: u16,
        /// Bytes of the message.
        payload: &'a [u8],
    },
}

impl<'a> Message<'a> {
    /// Parses the payload of a frame.
    pub fn parse(frame: &Frame<'a>) -> Result<Self, WireError> {
        let payload = frame.payload;
        Ok(match frame.message_id {
            message_id::ACK => Self::Ack(AckMessage::parse(payload)?),
            message_id::NACK => Self::Nack {
                refused_id: AckMessage::parse(payload)?.acked_id,
                text: text_of(&payload[2..]),
            },
            message_id::ASCII_TEXT => Self::AsciiText(text_of(payload)),
            message_id::DEVICE_INFORMATION => {
                Self::DeviceInformation(DeviceInformation::parse(payload)?)
            }
            message_id::PROTOCOL_VERSION => Self::ProtocolVersion(ProtocolVersion::parse(payload)?),
            message_id::GENERAL_REQUEST => Self::GeneralRequest(GeneralRequest::parse(payload)?),
            message_id::SET_DEVICE_ID => Self::SetDeviceId(SetDeviceId::parse(payload)?),
            message_id::JSON_WRAPPER => Self::Json(payload),
            message_id::SET_SPEED_OF_SOUND | message_id::SET_SPEED_OF_SOUND_EARLIER => {
                Self::SetSpeedOfSound(SetSpeedOfSound::parse(payload)?)
            }
            message_id::SYNC_CHANNEL => Self::SyncChannel(SyncChannel::parse(payload)?),
            message_id::SET_SYNC_CHANNEL => Self::SetSyncChannel(SyncChannel::parse(payload)?),
            message_id::OS_PING_PARAMS => Self::OsPingParams(OsPingParams::parse(payload)?),
            message_id::OS_MONO_PROFILE => Self::OsMonoProfile(OsMonoProfile::parse(payload)?),
            message_id::UTC_REQUEST => Self::UtcRequest,
            message_id::UTC_RESPONSE => Self::UtcResponse(UtcResponse::parse(payload)?),
            message_id::SET_NET_INFO => Self::SetNetInfo(SetNetInfo::parse(payload)?),
            message_id::SET_PING_PARAMETERS => {
                Self::SetPingParameters(SetPingParameters::parse(payload)?)
            }
            message_id::ATTITUDE_REPORT => Self::AttitudeReport(AttitudeReport::parse(payload)?),
            message_id::WATER_STATS => Self::WaterStats(WaterStats::parse(payload)?),
            message_id::ATOF_POINT_DATA => Self::AtofPointData(AtofPointData::parse(payload)?),
            message_id::YZ_POINT_DATA => Self::YzPointData(YzPointData::parse(payload)?),
            message_id => Self::Other {
                message_id,
                payload,
            },
        })
    }
}

/// Implements [`crate::layout::Layout`], the message number and emission as a whole frame, for messages of fixed length.
macro_rules! ping_message {
    ($type:ty, $size:expr, $name:literal, $id:expr) => {
        crate::layout::layout!($type, $size, $name, Little);

        impl $type {
            /// Appends the whole frame and returns its byte range.
            pub fn emit_frame(
                &self,
                buf: &mut Vec<u8>,
                source: u8,
                destination: u8,
            ) -> std::ops::Range<usize> {
                crate::ping_protocol::emit_frame(buf, $id, source, destination, |buf| {
                    self.emit(buf);
                })
            }
        }
    };
}
pub(crate) use ping_message;
