//! Sensor messages: 2002, 2020, 2060, 2080, 2091. Source: Rev. 1.20, tables 2-15 to 2-18 and 2-20.
//!
//! Fields have the units of the format. Reserved bytes are written as 0 and ignored when read. Every field except the time has a
//! bit in `validity`.

use std::ops::Range;

use binrw::{BinRead, BinWrite};

use super::{MessageHeader, emit_message, message_type, subsystem};
use crate::WireError;
use crate::layout::layout;

/// Time at the start of sensor messages.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, BinRead, BinWrite)]
pub struct SensorTime {
    /// Seconds since 1970.
    pub seconds: i32,
    /// Milliseconds within the second.
    pub milliseconds: i32,
}

layout!(SensorTime, 8, "JSF sensor time", Little);

impl SensorTime {
    /// Time from nanoseconds since 1970, truncated to a millisecond; valid until 2038.
    pub fn from_utc_ns(utc_ns: i64) -> Self {
        Self {
            seconds: utc_ns.div_euclid(1_000_000_000).clamp(0, i32::MAX.into()) as i32,
            milliseconds: (utc_ns.rem_euclid(1_000_000_000) / 1_000_000) as i32,
        }
    }

    /// Nanoseconds since 1970.
    pub fn to_utc_ns(self) -> i64 {
        i64::from(self.seconds) * 1_000_000_000 + i64::from(self.milliseconds) * 1_000_000
    }
}

/// Implements message type, name, and emission as a whole message, for messages of fixed length.
macro_rules! sensor_message {
    ($type:ty, $size:expr, $name:literal, $message_type:expr) => {
        layout!($type, $size, $name, Little);

        impl $type {
            /// Appends the whole message of a serial port and returns its byte range.
            pub fn emit_message(&self, buf: &mut Vec<u8>, port: u8) -> Range<usize> {
                let header = MessageHeader::data($message_type, subsystem::PARSED_SERIAL, port);
                emit_message(buf, &header, |buf| self.emit(buf))
            }
        }
    };
}

/// Message 2002: one NMEA sentence, without its line end.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Nmea2002<'a> {
    /// Time of reception.
    pub time: SensorTime,
    /// Source of the sentence: 1 sonar, 2 topside unit.
    pub source: u8,
    /// The sentence without line end.
    pub sentence: &'a [u8],
}

impl<'a> Nmea2002<'a> {
    const HEAD_BYTES: usize = 12;

    /// Parses the body of the message. Returns an error if the body is too short.
    pub fn parse(body: &'a [u8]) -> Result<Self, WireError> {
        let truncated = WireError::truncated("JSF 2002", Self::HEAD_BYTES as u64, body.len());
        let (head, sentence) = body.split_at_checked(Self::HEAD_BYTES).ok_or(truncated)?;
        Ok(Self {
            time: SensorTime::parse(head)?,
            source: head[8],
            sentence,
        })
    }

    /// Appends the whole message of a serial port and returns its byte range. A line end in the sentence is removed.
    pub fn emit_message(&self, buf: &mut Vec<u8>, port: u8) -> Range<usize> {
        let header = MessageHeader::data(message_type::NMEA, subsystem::RAW_SERIAL, port);
        emit_message(buf, &header, |buf| {
            self.time.emit(buf);
            buf.extend_from_slice(&[self.source, 0, 0, 0]);
            buf.extend_from_slice(self.sentence.trim_ascii_end());
        })
    }
}

/// Message 2020: reading of a motion sensor.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, BinRead, BinWrite)]
pub struct PitchRoll2020 {
    #[brw(pad_after = 4)]
    /// Time of the reading.
    pub time: SensorTime,
    /// Offset 12: accelerations x, y, z, steps of 20 x 1.5 / 32768 g.
    pub acceleration: [i16; 3],
    /// Offset 18: angular rates x, y, z, steps of 500 x 1.5 / 32768 deg/s.
    pub rate: [i16; 3],
    /// Offset 24: pitch, positive bow up, 180 degrees = 32768.
    pub pitch: i16,
    /// Offset 26: roll, positive port up, 180 degrees = 32768.
    pub roll: i16,
    /// Offset 28: temperature, 0.1 degrees Celsius.
    pub temperature_dc: i16,
    /// Offset 30: information of the device, not interpreted.
    pub device_info: u16,
    /// Offset 32: heave, positive down.
    pub heave_down_mm: i16,
    /// Offset 34: heading, 0.01 degrees.
    pub heading_cdeg: u16,
    /// Offset 36: bits 0-2 acceleration, 3-5 rates, 6 pitch, 7 roll, 8 heave, 9 heading, 10 temperature, 11 device info, 12 yaw.
    pub validity: u32,
    /// Offset 40: yaw, 0.01 degrees.
    #[brw(pad_after = 2)]
    pub yaw_cdeg: i16,
}

sensor_message!(PitchRoll2020, 44, "JSF 2020", message_type::PITCH_ROLL);

/// Message 2060: reading of a pressure sensor.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, BinRead, BinWrite)]
pub struct Pressure2060 {
    #[brw(pad_after = 4)]
    /// Time of the reading.
    pub time: SensorTime,
    /// Offset 12: absolute pressure, thousandths of a pound per square inch.
    pub pressure_mpsi: i32,
    /// Offset 16: water temperature, 0.001 degrees Celsius.
    pub temperature_mc: i32,
    /// Offset 20: salinity.
    pub salinity_ppm: i32,
    /// Offset 24: bits 0 pressure, 1 temperature, 2 salinity, 3 conductivity, 4 sound velocity, 5 depth.
    pub validity: u32,
    /// Offset 28: conductivity.
    pub conductivity_us_per_cm: i32,
    /// Offset 32: sound velocity.
    pub sound_velocity_mm_per_s: i32,
    /// Offset 36: depth below the surface.
    #[brw(pad_after = 36)]
    pub depth_m: i32,
}

sensor_message!(Pressure2060, 76, "JSF 2060", message_type::PRESSURE);

/// Message 2080: reading of a Doppler velocity log.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, BinRead, BinWrite)]
pub struct Dvl2080 {
    #[brw(pad_after = 4)]
    /// Time of the reading.
    pub time: SensorTime,
    /// Offset 12: bits 0 x and y velocity, 1 ship's axes (0: the earth's), 2 z velocity, 3 x and y through water, 4 z through water, 5 distance,
    /// 6 heading, 7 pitch, 8 roll, 9 temperature, 10 depth, 11 salinity, 12 sound velocity, 31 error.
    pub validity: u32,
    /// Offset 16: distance to the bottom per beam; 0 is none.
    pub distance_cm: [i32; 4],
    /// Offset 32: velocity over ground: starboard or east, forward or north, up.
    pub velocity_mm_per_s: [i16; 3],
    /// Offset 38: velocity through the water, in the same axes.
    pub water_velocity_mm_per_s: [i16; 3],
    /// Offset 44: depth, 0.1 m.
    pub depth_dm: u16,
    /// Offset 46: pitch, 0.01 degrees, positive bow up.
    pub pitch_cdeg: i16,
    /// Offset 48: roll, 0.01 degrees, positive port up.
    pub roll_cdeg: i16,
    /// Offset 50: heading, 0.01 degrees.
    pub heading_cdeg: u16,
    /// Offset 52: salinity, parts per thousand.
    pub salinity_ppt: u16,
    /// Offset 54: water temperature, 0.01 degrees Celsius.
    pub temperature_cc: i16,
    /// Offset 56: sound velocity.
    #[brw(pad_after = 14)]
    pub sound_velocity_m_per_s: i16,
}

sensor_message!(Dvl2080, 72, "JSF 2080", message_type::DVL);

/// Message 2091: combined navigation of all sensors.
#[derive(Debug, Clone, Copy, PartialEq, Default, BinRead, BinWrite)]
pub struct Situation2091 {
    #[brw(pad_after = 4)]
    /// Time of the message.
    pub time: SensorTime,
    /// Offset 12: bits 0 source's time, 1 longitude, 2 latitude, 3 depth, 4 altitude, 5 heave, 6 velocity 1 and 2, 7 velocity down, 8 pitch, 9 roll,
    /// 10 heading, 11 sound speed, 12 water temperature.
    pub validity: u32,
    /// Offset 16: axes of the velocities: 0 north and east, 1 forward and starboard, 2 rotated by 45 degrees.
    #[brw(pad_after = 3)]
    pub velocity_axes: u8,
    /// Offset 20: time of the source, units of 1e-7 s since 1970.
    pub source_time_100ns: u64,
    /// Offset 28: latitude, positive north.
    pub latitude_deg: f64,
    /// Offset 36: longitude, positive east.
    pub longitude_deg: f64,
    /// Offset 44: depth below the surface.
    pub depth_m: f32,
    /// Offset 48: height above the bottom.
    pub altitude_m: f32,
    /// Offset 52: heave, positive down.
    pub heave_down_m: f32,
    /// Offset 56: first horizontal velocity in the axes of `velocity_type`.
    pub velocity_1_m_per_s: f32,
    /// Offset 60: second horizontal velocity.
    pub velocity_2_m_per_s: f32,
    /// Offset 64: vertical velocity, positive down.
    pub velocity_down_m_per_s: f32,
    /// Offset 68: pitch, positive bow up.
    pub pitch_deg: f32,
    /// Offset 72: roll, positive port up.
    pub roll_deg: f32,
    /// Offset 76: heading, clockwise from north.
    pub heading_deg: f32,
    /// Offset 80: sound speed.
    pub sound_speed_m_per_s: f32,
    /// Offset 84: water temperature.
    #[brw(pad_after = 12)]
    pub water_temperature_c: f32,
}

sensor_message!(Situation2091, 100, "JSF 2091", message_type::SITUATION);
