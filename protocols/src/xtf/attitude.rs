//! Attitude packet: one reading of a motion sensor. Source: Rev. X41, table E (XTFATTITUDEDATA).

use std::ops::Range;

use binrw::{BinRead, BinWrite};

use super::{MARK, PacketStart, packet_of, packet_type};
use crate::WireError;
use crate::calendar::DateTime;
use crate::layout::layout;

#[derive(Debug, Clone, Copy, PartialEq, BinRead, BinWrite)]
struct RawAttitude {
    #[brw(pad_after = 8)]
    start: PacketStart,
    epoch_us: u32,
    epoch_s: u32,
    pitch_deg: f32,
    roll_deg: f32,
    heave_up_m: f32,
    yaw_deg: f32,
    time_tag_ms: u32,
    heading_deg: f32,
    year: u16,
    month: u8,
    day: u8,
    hour: u8,
    minute: u8,
    second: u8,
    #[brw(pad_after = 1)]
    millisecond: u16,
}

layout!(RawAttitude, 64, "XTF attitude", Little);

/// Attitude at one time, with microsecond resolution.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Attitude {
    /// Time, nanoseconds since 1970.
    pub utc_ns: i64,
    /// Pitch, positive nose up.
    pub pitch_deg: f32,
    /// Roll, positive to starboard (port up).
    pub roll_deg: f32,
    /// Heave, positive up.
    pub heave_up_m: f32,
    /// Heading, clockwise from north.
    pub heading_deg: f32,
}

impl Attitude {
    /// Parses the packet at the front of `bytes`, with its time in seconds since 1970.
    pub fn parse(bytes: &[u8]) -> Result<Self, WireError> {
        let (_, packet) = packet_of(bytes, packet_type::ATTITUDE)?;
        let raw = RawAttitude::parse(packet)?;
        Ok(Self {
            utc_ns: i64::from(raw.epoch_s) * 1_000_000_000 + i64::from(raw.epoch_us) * 1000,
            pitch_deg: raw.pitch_deg,
            roll_deg: raw.roll_deg,
            heave_up_m: raw.heave_up_m,
            heading_deg: raw.heading_deg,
        })
    }

    /// Appends the packet and returns its byte range.
    pub fn emit(&self, buf: &mut Vec<u8>) -> Range<usize> {
        let at = buf.len();
        let date_time = DateTime::from_utc_ns(self.utc_ns);
        RawAttitude {
            start: PacketStart {
                mark: MARK,
                packet_type: packet_type::ATTITUDE,
                sub_channel: 0,
                channels_to_follow: 0,
                packet_bytes: RawAttitude::SIZE_BYTES as u32,
            },
            epoch_us: date_time.nanosecond / 1000,
            epoch_s: self
                .utc_ns
                .div_euclid(1_000_000_000)
                .clamp(0, u32::MAX.into()) as u32,
            pitch_deg: self.pitch_deg,
            roll_deg: self.roll_deg,
            heave_up_m: self.heave_up_m,
            yaw_deg: 0.0,
            time_tag_ms: date_time.milliseconds_of_day(),
            heading_deg: self.heading_deg,
            year: date_time.year as u16,
            month: date_time.month,
            day: date_time.day,
            hour: date_time.hour,
            minute: date_time.minute,
            second: date_time.second,
            millisecond: (date_time.nanosecond / 1_000_000) as u16,
        }
        .emit(buf);
        at..buf.len()
    }
}
