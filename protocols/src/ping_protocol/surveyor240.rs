//! Messages of the Surveyor 240 multibeam echo sounder, with detected points. Source: `surveyor240.json` of
//! bluerobotics/ping-protocol.
//!
//! Device axes: x forward, y port, z up.

use std::ops::Range;

use binrw::{BinRead, BinWrite};

use super::{emit_frame, message_id, ping_message};
use crate::WireError;
use crate::layout::{data_at, layout};

/// Appends message 14 (UTC request): requests the time from the client.
pub fn emit_utc_request(buf: &mut Vec<u8>, source: u8, destination: u8) -> Range<usize> {
    emit_frame(buf, message_id::UTC_REQUEST, source, destination, |_| {})
}

/// Message 15: time from the client.
#[derive(Debug, Clone, Copy, PartialEq, Eq, BinRead, BinWrite)]
pub struct UtcResponse {
    /// Time, milliseconds since 1970.
    pub utc_msec: u64,
    /// Accuracy of the time.
    pub accuracy_msec: u32,
}

ping_message!(UtcResponse, 12, "Ping 15", message_id::UTC_RESPONSE);

/// Message 17: network settings.
#[derive(Debug, Clone, Copy, PartialEq, Eq, BinRead, BinWrite)]
pub struct SetNetInfo {
    /// Address of the time server.
    pub ntp_ip_address: u32,
    /// Mask of the network.
    pub subnet_mask: u32,
    /// Address of the gateway.
    pub gateway_ip: u32,
}

ping_message!(SetNetInfo, 12, "Ping 17", message_id::SET_NET_INFO);

/// Message 3023: ping settings.
#[derive(Debug, Clone, Copy, PartialEq, BinRead, BinWrite)]
pub struct SetPingParameters {
    /// Start of the range.
    pub start_mm: i32,
    /// End of the range; 0 means automatic (bottom tracking).
    pub end_mm: i32,
    /// Speed of sound, m/s.
    pub sos_mps: f32,
    /// Gain index, 0 to 100; -1 is automatic.
    pub gain_index: i16,
    #[brw(pad_after = 2)]
    /// Time between pings; 0 means as fast as possible.
    pub msec_per_ping: i16,
    /// Diagnostic signal; must be 0.
    pub diagnostic_injected_signal: u8,
    /// 1 starts pinging, 0 stops it.
    pub ping_enable: u8,
    /// 1 enables channel data.
    pub enable_channel_data: u8,
    /// Reserved for raw data; must be 0.
    pub reserved_for_raw_data: u8,
    /// 1 enables message 3011.
    pub enable_yz_point_data: u8,
    /// 1 enables message 3012.
    pub enable_atof_data: u8,
    /// Centre frequency; always 240000.
    pub target_ping_hz: i32,
    /// Number of range steps, 200 to 800.
    #[brw(pad_after = 2)]
    pub n_range_steps: u16,
    /// Pulse length in range steps.
    pub pulse_len_steps: f32,
}

ping_message!(
    SetPingParameters,
    36,
    "Ping 3023",
    message_id::SET_PING_PARAMETERS
);

/// Message 504: direction of the vertical in the device's axes.
#[derive(Debug, Clone, Copy, PartialEq, BinRead, BinWrite)]
pub struct AttitudeReport {
    #[brw(pad_after = 12)]
    /// Unit vector upwards.
    pub up: [f32; 3],
    /// Time, milliseconds since 1970.
    pub utc_msec: u64,
    /// Time since power-up.
    pub pwr_up_msec: u32,
}

ping_message!(AttitudeReport, 36, "Ping 504", message_id::ATTITUDE_REPORT);

impl AttitudeReport {
    /// Upward unit vector of a device with this roll (positive port up) and pitch (positive bow up). Axes are x forward, y port, z
    /// up.
    pub fn up_from(roll_port_up_rad: f64, pitch_bow_up_rad: f64) -> [f32; 3] {
        let (sin_roll, cos_roll) = roll_port_up_rad.sin_cos();
        let (sin_pitch, cos_pitch) = pitch_bow_up_rad.sin_cos();
        // The bow is above the horizon by the pitch. The rest of the vector is between port and the z axis of the device.
        [sin_pitch, cos_pitch * sin_roll, cos_pitch * cos_roll].map(|value| value as f32)
    }
}

/// Message 118: water temperature and pressure.
#[derive(Debug, Clone, Copy, PartialEq, BinRead, BinWrite)]
pub struct WaterStats {
    /// Water temperature, degrees Celsius.
    pub temperature_c: f32,
    /// Absolute pressure.
    pub pressure_bar: f32,
}

ping_message!(WaterStats, 8, "Ping 118", message_id::WATER_STATS);

/// One point: an angle and a two-way time.
#[derive(Debug, Clone, Copy, PartialEq, BinRead, BinWrite)]
pub struct AtofPoint {
    /// Angle of the point, positive to port.
    pub angle_rad: f32,
    #[brw(pad_after = 8)]
    /// Two-way travel time.
    pub two_way_time_s: f32,
}

layout!(AtofPoint, 16, "Ping 3012 point", Little);

/// Head of message 3012 (angle and time-of-flight data) before its points. Their number is set when the message is emitted.
#[derive(Debug, Clone, Copy, PartialEq, Default, BinRead, BinWrite)]
pub struct AtofHead {
    /// Time since power-up.
    pub pwr_up_msec: u32,
    /// Time of the ping, milliseconds since 1970; 0 means unknown.
    pub utc_msec: u64,
    /// Reception time of the ping.
    pub listening_s: f32,
    /// Speed of sound, m/s.
    pub sos_mps: f32,
    /// Counter of pings.
    pub ping_number: u32,
    /// Centre frequency.
    pub ping_hz: u32,
    /// Pulse length.
    pub pulse_s: f32,
    /// Reserved flags.
    pub flags: u32,
    #[brw(pad_after = 2)]
    /// Number of points.
    pub num_points: u16,
}

layout!(AtofHead, 40, "Ping 3012", Little);

/// Parsed message 3012 (angle and time-of-flight data).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AtofPointData<'a> {
    /// Head of the message.
    pub head: AtofHead,
    points: &'a [u8],
}

impl<'a> AtofPointData<'a> {
    /// Parses the payload of the message. Returns an error if the payload is too short.
    pub fn parse(payload: &'a [u8]) -> Result<Self, WireError> {
        let head = AtofHead::parse(payload)?;
        let len = AtofPoint::SIZE_BYTES as u64 * u64::from(head.num_points);
        let points = data_at(payload, AtofHead::SIZE_BYTES, len, "Ping 3012 points")?;
        Ok(Self { head, points })
    }

    /// Iterates over the points.
    pub fn points(&self) -> impl Iterator<Item = AtofPoint> + 'a {
        self.points
            .chunks_exact(AtofPoint::SIZE_BYTES)
            .filter_map(|bytes| AtofPoint::parse(bytes).ok())
    }
}

/// Appends message 3012 (angle and time-of-flight data) and returns its byte range.
///
/// # Panics
/// If the points do not fit a frame (more than 4093).
pub fn emit_3012(
    buf: &mut Vec<u8>,
    source: u8,
    destination: u8,
    head: &AtofHead,
    points: &[AtofPoint],
) -> Range<usize> {
    let head = AtofHead {
        num_points: points.len() as u16,
        ..*head
    };
    emit_frame(
        buf,
        message_id::ATOF_POINT_DATA,
        source,
        destination,
        |buf| {
            head.emit(buf);
            points.iter().for_each(|point| point.emit(buf));
        },
    )
}

/// Head of message 3011 (YZ point data) before its points. Their number is set when the message is emitted.
#[derive(Debug, Clone, Copy, PartialEq, Default, BinRead, BinWrite)]
pub struct YzHead {
    /// Time since power-up.
    pub timestamp_msec: u32,
    /// Counter of pings.
    pub ping_number: u32,
    /// Speed of sound, m/s.
    pub sos_mps: f32,
    /// Unit vector upwards in the device's axes.
    #[brw(pad_after = 52)]
    pub up: [f32; 3],
    /// Water temperature; -1000 without a sensor.
    pub water_c: f32,
    /// Water pressure; -1000 without a sensor.
    pub water_bar: f32,
    /// Heave, positive up.
    pub heave_m: f32,
    /// Start of the range.
    pub start_m: f32,
    #[brw(pad_after = 2)]
    /// End of the range.
    pub end_m: f32,
    /// Number of points.
    pub num_points: u16,
}

layout!(YzHead, 100, "Ping 3011", Little);

/// Parsed message 3011 (YZ point data).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct YzPointData<'a> {
    /// Head of the message.
    pub head: YzHead,
    points: &'a [u8],
}

impl<'a> YzPointData<'a> {
    /// Parses the payload of the message. Returns an error if the payload is too short.
    pub fn parse(payload: &'a [u8]) -> Result<Self, WireError> {
        let head = YzHead::parse(payload)?;
        let len = 8 * u64::from(head.num_points);
        let points = data_at(payload, YzHead::SIZE_BYTES, len, "Ping 3011 points")?;
        Ok(Self { head, points })
    }

    /// Iterates over the points: port and up, metres.
    pub fn points(&self) -> impl ExactSizeIterator<Item = [f32; 2]> + 'a {
        self.points.chunks_exact(8).map(|b| {
            [
                f32::from_le_bytes([b[0], b[1], b[2], b[3]]),
                f32::from_le_bytes([b[4], b[5], b[6], b[7]]),
            ]
        })
    }
}

/// Appends message 3011 (YZ point data) with points (port and up, metres) and returns its byte range.
///
/// # Panics
/// If the points do not fit a frame (more than 8179).
pub fn emit_3011(
    buf: &mut Vec<u8>,
    source: u8,
    destination: u8,
    head: &YzHead,
    points: &[[f32; 2]],
) -> Range<usize> {
    let head = YzHead {
        num_points: points.len() as u16,
        ..*head
    };
    emit_frame(buf, message_id::YZ_POINT_DATA, source, destination, |buf| {
        head.emit(buf);
        let numbers = points.as_flattened().iter();
        buf.extend(numbers.flat_map(|number| number.to_le_bytes()));
    })
}
