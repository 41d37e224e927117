//! Messages that every device supports. Source: `common.json` of bluerobotics/ping-protocol.

use std::ops::Range;

use binrw::{BinRead, BinWrite};

use super::{emit_frame, message_id, ping_message};

/// Message 1 (acknowledge): a message is accepted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, BinRead, BinWrite)]
pub struct AckMessage {
    /// Number of the accepted message.
    pub acked_id: u16,
}

ping_message!(AckMessage, 2, "Ping 1", message_id::ACK);

/// Appends message 2 (not acknowledge): a message is refused, with the reason.
pub fn emit_nack(
    buf: &mut Vec<u8>,
    source: u8,
    destination: u8,
    refused_id: u16,
    text: &str,
) -> Range<usize> {
    emit_frame(buf, message_id::NACK, source, destination, |buf| {
        buf.extend(refused_id.to_le_bytes());
        buf.extend(text.bytes().filter(u8::is_ascii));
    })
}

/// Message 4: identity of a device.
#[derive(Debug, Clone, Copy, PartialEq, Eq, BinRead, BinWrite)]
pub struct DeviceInformation {
    /// Type of the device; 0 means unknown.
    pub device_type: u8,
    /// Hardware revision.
    pub device_revision: u8,
    /// Firmware version: major, minor, patch.
    #[brw(pad_after = 1)]
    pub firmware: [u8; 3],
}

ping_message!(
    DeviceInformation,
    6,
    "Ping 4",
    message_id::DEVICE_INFORMATION
);

/// Message 5: version of the protocol.
#[derive(Debug, Clone, Copy, PartialEq, Eq, BinRead, BinWrite)]
pub struct ProtocolVersion {
    #[brw(pad_after = 1)]
    /// Version of the protocol: major, minor, patch.
    pub version: [u8; 3],
}

ping_message!(ProtocolVersion, 4, "Ping 5", message_id::PROTOCOL_VERSION);

/// Message 6: requests a message.
#[derive(Debug, Clone, Copy, PartialEq, Eq, BinRead, BinWrite)]
pub struct GeneralRequest {
    /// Number of the requested message.
    pub requested_id: u16,
}

ping_message!(GeneralRequest, 2, "Ping 6", message_id::GENERAL_REQUEST);

/// Message 100: sets the identifier of the device.
#[derive(Debug, Clone, Copy, PartialEq, Eq, BinRead, BinWrite)]
pub struct SetDeviceId {
    /// Identifier of the device, 1 to 254.
    pub device_id: u8,
}

ping_message!(SetDeviceId, 1, "Ping 100", message_id::SET_DEVICE_ID);
