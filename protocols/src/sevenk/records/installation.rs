//! 7030: where the arrays and sensors are mounted. Source: DFD 3.12, table 79. Sonars do not send it; recording programs do.
//!
//! Axes: X starboard, Y forward, Z up, from the vessel's reference point.

use std::fmt;

use binrw::{BinRead, BinWrite};

use super::{rth_record, text_field, text_of};
use crate::sevenk::record_id;

/// A text of at most 127 bytes with its length.
#[derive(Debug, Clone, Copy, PartialEq, Eq, BinRead, BinWrite)]
pub struct Version {
    bytes: u16,
    text: [u8; 128],
}

impl Version {
    /// Text up to its first NUL; longer texts are truncated between characters.
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
    /// Starboard.
    pub x_m: f32,
    /// Forward.
    pub y_m: f32,
    /// Up.
    pub z_m: f32,
    /// Positive port up.
    pub roll_rad: f32,
    /// Positive bow up.
    pub pitch_rad: f32,
    /// Clockwise.
    pub heading_rad: f32,
}

/// 7030: installation of a sonar.
#[derive(Debug, Clone, Copy, PartialEq, Default, BinRead, BinWrite)]
pub struct Installation7030 {
    /// Centre frequency.
    pub frequency_hz: f32,
    /// Of the sonar's firmware.
    pub firmware: Version,
    /// Of the sonar's software.
    pub software: Version,
    /// Of the 7k software.
    pub sevenk_software: Version,
    /// Of the record protocol.
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
