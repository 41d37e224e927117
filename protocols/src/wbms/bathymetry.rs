//! Type 1: detections. Source: TN-180196, bathymetric data; offsets count from the start of the packet.

use std::ops::Range;

use binrw::{BinRead, BinWrite};

use super::{Packet, emit_packet, packet_type};
use crate::WireError;
use crate::layout::{data_at, layout};

/// What is true of all detections; their number is filled in when it is written.
#[derive(Debug, Clone, Copy, PartialEq, Default, BinRead, BinWrite)]
pub struct BathymetryHead {
    /// 24
    pub sound_velocity_m_per_s: f32,
    /// 28: of the sample numbers.
    pub sample_rate_hz: f32,
    /// 32
    pub detections: u32,
    /// 36
    pub ping_number: u32,
    /// 40: seconds since 1970, of the transmission.
    pub time_s: f64,
    /// 48: likewise, when it was sent.
    pub time_net_s: f64,
    /// 56
    pub ping_rate_hz: f32,
    /// 60: 0 automatic gate.
    pub sub_type: u16,
    /// 62: 1 512 equal angles, 2 256 equal angles, 3 256 equal distances.
    pub beam_distribution: u8,
    pub sonar_mode: u8,
    /// 64
    pub time_uncertainty_s: f32,
    /// 68
    pub multiping: u16,
    pub multiping_sequence: u16,
    /// 72
    pub tx_angle_rad: f32,
    /// 76: of the intensities; a display divides by it.
    pub gain: f32,
    pub tx_frequency_hz: f32,
    pub tx_bandwidth_hz: f32,
    pub tx_length_s: f32,
    /// 92
    pub sound_velocity_raw_m_per_s: f32,
    /// 96: NaN where it is not measured.
    pub tx_voltage: f32,
    pub swath_direction_rad: f32,
    pub swath_opening_rad: f32,
    /// 108
    pub gate_tilt_rad: f32,
}

layout!(BathymetryHead, 88, "WBMS bathymetry", Little);

/// One detection, of 20 bytes.
#[derive(Debug, Clone, Copy, PartialEq, Default, BinRead, BinWrite)]
pub struct Detection {
    /// Range = sample_number x c / (2 x rate).
    pub sample_number: u32,
    pub angle_rad: f32,
    pub upper_gate: u16,
    pub lower_gate: u16,
    pub intensity: f32,
    /// Bit 0 by magnitude, 1 by phase, 2-8 kind of quality, 9-12 priority.
    pub flags: u16,
    /// Bit 0 signal to noise, 1 colinearity; 3 is good.
    pub quality_flags: u8,
    pub quality: u8,
}

layout!(Detection, 20, "WBMS detection", Little);

/// Type 1, read.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Bathymetry<'a> {
    pub head: BathymetryHead,
    detections: &'a [u8],
}

impl<'a> Bathymetry<'a> {
    pub fn parse(packet: &Packet<'a>) -> Result<Self, WireError> {
        if packet.header.packet_type != packet_type::BATHYMETRY {
            return Err(WireError::Unsupported {
                what: "WBMS packet type",
                got: packet.header.packet_type.into(),
            });
        }
        let head = BathymetryHead::parse(packet.payload)?;
        let len = Detection::SIZE_BYTES as u64 * u64::from(head.detections);
        let at = BathymetryHead::SIZE_BYTES;
        let detections = data_at(packet.payload, at, len, "WBMS detections")?;
        Ok(Self { head, detections })
    }

    pub fn detections(&self) -> impl Iterator<Item = Detection> + 'a {
        self.detections
            .chunks_exact(Detection::SIZE_BYTES)
            .filter_map(|bytes| Detection::parse(bytes).ok())
    }
}

/// Appends a packet of detections, port-most first, and says where it lies.
pub fn emit_bathymetry(
    buf: &mut Vec<u8>,
    head: &BathymetryHead,
    detections: &[Detection],
) -> Range<usize> {
    let head = BathymetryHead {
        detections: detections.len() as u32,
        ..*head
    };
    emit_packet(buf, packet_type::BATHYMETRY, |buf| {
        head.emit(buf);
        detections.iter().for_each(|detection| detection.emit(buf));
    })
}
