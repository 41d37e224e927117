//! Record 7030 (sonar installation parameters): mounting of arrays and sensors. Source: DFD 3.12, table 79. Recording
//! programs send it; sonars do not.
//!
//! Axes: X starboard, Y forward, Z up, from the vessel's reference point.

use std::fmt;

use binrw::{BinRead, BinWrite};

use super::{rth_record, text_field, text_of};
use crate::sevenk::record_id;

/// Text of at most 127 bytes, with its length.
#[derive(Debug, Clone, Copy, PartialEq, Eq, BinRead, BinWrite)]
pub struct Version {
    bytes: u16,
    text: [u8; 128],
}

impl Version {
    /// Version from a text up to its first NUL. Longer texts are truncated between characters.
    pub fn new(text: &str) -> Self {
        let text: [u8; 128] = text_field(text);
        Self {
            bytes: text.iter().take_while(|&&byte| byte != 0).count() as u16,
            text,
        }
    }

    /// The text.
    pub fn text(&self) -> String {
        let field = self.text.get(..usize::from(self.bytes));
        text_of(field.unwrap_or(&self.text))
    }
}

impl Default for Version {
    fn default() -> Self {
        Self::new("")
    }
}

/// Offset of an array or sensor.
#[derive(Debug, Clone, Copy, PartialEq, Default, BinRead, BinWrite)]
pub struct MountingOffset {
    /// Offset, positive to starboard.
    pub x_m: f32,
    /// Offset, positive forward.
    pub y_m: f32,
    /// Offset, positive up.
    pub z_m: f32,
    /// Roll, positive port up.
    pub roll_rad: f32,
    /// Pitch, positive bow up.
    pub pitch_rad: f32,
    /// Heading of the device in the vessel, positive clockwise.
    pub heading_rad: f32,
}

/// Record 7030 (sonar installation parameters): mounting of arrays and sensors.
#[derive(Debug, Clone, Copy, PartialEq, Default, BinRead, BinWrite)]
pub struct Installation7030 {
    /// Centre frequency.
    pub frequency_hz: f32,
    /// Version of the sonar's firmware.
    pub firmware: Version,
    /// Version of the sonar's software.
    pub software: Version,
    /// Version of the 7k software.
    pub sevenk_software: Version,
    /// Version of the record protocol.
    pub record_protocol: Version,
    /// Transmit array.
    pub transmit: MountingOffset,
    /// Receive array.
    pub receive: MountingOffset,
    /// Motion sensor.
    pub motion_sensor: MountingOffset,
    /// Delay of the motion sensor.
    pub motion_delay_ms: u16,
    /// Position sensor: starboard, forward, up.
    pub position_sensor_m: [f32; 3],
    /// Delay of the position sensor.
    pub position_delay_ms: u16,
    /// Vertical offset from the reference point to the waterline, positive up.
    pub waterline_m: f32,
}

rth_record!(
    Installation7030,
    record_id::INSTALLATION,
    616,
    "7030 installation"
);

impl fmt::Display for Installation7030 {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let at = |m: &MountingOffset| [m.x_m, m.y_m, m.z_m];
        write!(
            f,
            "installation: {:.0} Hz, transmit array at {:?} m, receive array at {:?} m (starboard, forward, up), waterline {} m above the reference point, software {:?}",
            self.frequency_hz,
            at(&self.transmit),
            at(&self.receive),
            self.waterline_m,
            self.software.text()
        )
    }
}
