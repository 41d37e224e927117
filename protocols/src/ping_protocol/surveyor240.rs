//! Surveyor 240: multibeam, detected points. Source: `surveyor240.json` of bluerobotics/ping-protocol.
//!
//! Device axes: x forward, y port, z up.

use std::ops::Range;

use binrw::{BinRead, BinWrite};

use super::{emit_frame, message_id, ping_message};
use crate::WireError;
use crate::layout::{data_at, layout};

/// Appends 14: asks the client for the time.
pub fn emit_utc_request(buf: &mut Vec<u8>, source: u8, destination: u8) -> Range<usize> {
    emit_frame(buf, message_id::UTC_REQUEST, source, destination, |_| {})
}

/// 15: the client's answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq, BinRead, BinWrite)]
pub struct UtcResponse {
    pub utc_msec: u64,
    pub accuracy_msec: u32,
}

ping_message!(UtcResponse, 12, "Ping 15", message_id::UTC_RESPONSE);

/// 17
#[derive(Debug, Clone, Copy, PartialEq, Eq, BinRead, BinWrite)]
pub struct SetNetInfo {
    pub ntp_ip_address: u32,
    pub subnet_mask: u32,
    pub gateway_ip: u32,
}

ping_message!(SetNetInfo, 12, "Ping 17", message_id::SET_NET_INFO);

/// 3023: how to ping.
#[derive(Debug, Clone, Copy, PartialEq, BinRead, BinWrite)]
pub struct SetPingParameters {
    pub start_mm: i32,
    /// 0 follows the bottom.
    pub end_mm: i32,
    pub sos_mps: f32,
    /// -1 automatic, else 0 to 100.
    pub gain_index: i16,
    #[brw(pad_after = 2)]
    pub msec_per_ping: i16,
    /// 0.
    pub diagnostic_injected_signal: u8,
    pub ping_enable: u8,
    pub enable_channel_data: u8,
    /// 0.
    pub reserved_for_raw_data: u8,
    pub enable_yz_point_data: u8,
    pub enable_atof_data: u8,
    /// 240000.
    pub target_ping_hz: i32,
    /// 200 to 800.
    #[brw(pad_after = 2)]
    pub n_range_steps: u16,
    pub pulse_len_steps: f32,
}

ping_message!(
    SetPingParameters,
    36,
    "Ping 3023",
    message_id::SET_PING_PARAMETERS
);

/// 504: which way is up, in the device's axes.
#[derive(Debug, Clone, Copy, PartialEq, BinRead, BinWrite)]
pub struct AttitudeReport {
    #[brw(pad_after = 12)]
    pub up: [f32; 3],
    pub utc_msec: u64,
    pub pwr_up_msec: u32,
}

ping_message!(AttitudeReport, 36, "Ping 504", message_id::ATTITUDE_REPORT);

impl AttitudeReport {
    /// Up in the axes of a device with this roll (port up) and pitch (bow up): x forward, y port, z up.
    pub fn up_from(roll_port_up_rad: f64, pitch_bow_up_rad: f64) -> [f32; 3] {
        let (sin_roll, cos_roll) = roll_port_up_rad.sin_cos();
        let (sin_pitch, cos_pitch) = pitch_bow_up_rad.sin_cos();
        // The bow is above the horizon by the pitch; the rest of up lies between port and the mast.
        [sin_pitch, cos_pitch * sin_roll, cos_pitch * cos_roll].map(|value| value as f32)
    }
}

/// 118
#[derive(Debug, Clone, Copy, PartialEq, BinRead, BinWrite)]
pub struct WaterStats {
    pub temperature_c: f32,
    pub pressure_bar: f32,
}

ping_message!(WaterStats, 8, "Ping 118", message_id::WATER_STATS);

/// One point: an angle and a two-way time.
#[derive(Debug, Clone, Copy, PartialEq, BinRead, BinWrite)]
pub struct AtofPoint {
    pub angle_rad: f32,
    #[brw(pad_after = 8)]
    pub two_way_time_s: f32,
}

layout!(AtofPoint, 16, "Ping 3012 point", Little);

/// 3012 before its points; their number is filled in when it is written.
#[derive(Debug, Clone, Copy, PartialEq, Default, BinRead, BinWrite)]
pub struct AtofHead {
    pub pwr_up_msec: u32,
    /// Of the ping; 0 not known.
    pub utc_msec: u64,
    pub listening_s: f32,
    pub sos_mps: f32,
    pub ping_number: u32,
    pub ping_hz: u32,
    pub pulse_s: f32,
    pub flags: u32,
    #[brw(pad_after = 2)]
    pub num_points: u16,
}

layout!(AtofHead, 40, "Ping 3012", Little);

/// 3012, read.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AtofPointData<'a> {
    pub head: AtofHead,
    points: &'a [u8],
}

impl<'a> AtofPointData<'a> {
    pub fn parse(payload: &'a [u8]) -> Result<Self, WireError> {
        let head = AtofHead::parse(payload)?;
        let len = AtofPoint::SIZE_BYTES as u64 * u64::from(head.num_points);
        let points = data_at(payload, AtofHead::SIZE_BYTES, len, "Ping 3012 points")?;
        Ok(Self { head, points })
    }

    pub fn points(&self) -> impl Iterator<Item = AtofPoint> + 'a {
        self.points
            .chunks_exact(AtofPoint::SIZE_BYTES)
            .filter_map(|bytes| AtofPoint::parse(bytes).ok())
    }
}

/// Appends 3012 and says where it lies.
///
/// # Panics
/// If the points do not fit a frame: more than 4093.
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

/// 3011 before its points; their number is filled in when it is written.
#[derive(Debug, Clone, Copy, PartialEq, Default, BinRead, BinWrite)]
pub struct YzHead {
    pub timestamp_msec: u32,
    pub ping_number: u32,
    pub sos_mps: f32,
    /// In the device's axes.
    #[brw(pad_after = 52)]
    pub up: [f32; 3],
    /// -1000 without a sensor.
    pub water_c: f32,
    /// -1000 without a sensor.
    pub water_bar: f32,
    pub heave_m: f32,
    pub start_m: f32,
    #[brw(pad_after = 2)]
    pub end_m: f32,
    pub num_points: u16,
}

layout!(YzHead, 100, "Ping 3011", Little);

/// 3011, read.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct YzPointData<'a> {
    pub head: YzHead,
    points: &'a [u8],
}

impl<'a> YzPointData<'a> {
    pub fn parse(payload: &'a [u8]) -> Result<Self, WireError> {
        let head = YzHead::parse(payload)?;
        let len = 8 * u64::from(head.num_points);
        let points = data_at(payload, YzHead::SIZE_BYTES, len, "Ping 3011 points")?;
        Ok(Self { head, points })
    }

    /// Port and up, m.
    pub fn points(&self) -> impl ExactSizeIterator<Item = [f32; 2]> + 'a {
        self.points.chunks_exact(8).map(|b| {
            [
                f32::from_le_bytes([b[0], b[1], b[2], b[3]]),
                f32::from_le_bytes([b[4], b[5], b[6], b[7]]),
            ]
        })
    }
}

/// Appends 3011 with points port and up in m, and says where it lies.
///
/// # Panics
/// If the points do not fit a frame: more than 8179.
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
