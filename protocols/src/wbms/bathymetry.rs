//! Packet type 1: detections. Source: TN-180196, bathymetric data. Offsets count from the start of the
//! packet.

use std::ops::Range;

use binrw::{BinRead, BinWrite};

use super::{Packet, emit_packet, packet_type};
use crate::WireError;
use crate::layout::{data_at, layout};

/// Fields common to all detections; their number is set when the packet is emitted.
#[derive(Debug, Clone, Copy, PartialEq, Default, BinRead, BinWrite)]
pub struct BathymetryHead {
    /// Offset 24: sound velocity.
    pub sound_velocity_m_per_s: f32,
    /// Offset 28: sample rate of the sample numbers.
    pub sample_rate_hz: f32,
    /// Offset 32: number of detections.
    pub detections: u32,
    /// Offset 36: counter of pings.
    pub ping_number: u32,
    /// Offset 40: time of the transmission, seconds since 1970.
    pub time_s: f64,
    /// Offset 48: time of sending, seconds since 1970.
    pub time_net_s: f64,
    /// Offset 56: ping rate.
    pub ping_rate_hz: f32,
    /// Offset 60: Gate mode; 0 is automatic.
    pub sub_type: u16,
    /// Offset 62: beam distribution: 1 is 512 equal angles, 2 is 256 equal angles, 3 is 256 equal distances.
    pub beam_distribution: u8,
    /// Offset 63: sonar mode; 1 is bathymetry.
    pub sonar_mode: u8,
    /// Offset 64: uncertainty of the time.
    pub time_uncertainty_s: f32,
    /// Offset 68: Multi-ping mode; 0 if off.
    pub multiping: u16,
    /// Offset 70: index within a multi-ping sequence.
    pub multiping_sequence: u16,
    /// Offset 72: direction of the transmit sector.
    pub tx_angle_rad: f32,
    /// Offset 76: gain of the intensities; a display divides by it.
    pub gain: f32,
    /// Offset 80: centre frequency.
    pub tx_frequency_hz: f32,
    /// Offset 84: bandwidth of the pulse.
    pub tx_bandwidth_hz: f32,
    /// Offset 88: pulse length.
    pub tx_length_s: f32,
    /// Offset 92: sound velocity before smoothing.
    pub sound_velocity_raw_m_per_s: f32,
    /// Offset 96: voltage of the transmitter; NaN if not measured.
    pub tx_voltage: f32,
    /// Offset 100: direction of the swath's centre, positive to starboard.
    pub swath_direction_rad: f32,
    /// Offset 104: width of the swath.
    pub swath_opening_rad: f32,
    /// Offset 108: tilt of the gates.
    pub gate_tilt_rad: f32,
}

layout!(BathymetryHead, 88, "WBMS bathymetry", Little);

/// Detection of one beam in a packet of type 1 (20 bytes).
#[derive(Debug, Clone, Copy, PartialEq, Default, BinRead, BinWrite)]
pub struct Detection {
    /// Sample number; the range is sample_number x c / (2 x rate).
    pub sample_number: u32,
    /// Angle of the beam, positive to starboard.
    pub angle_rad: f32,
    /// Start of the gate, sample number.
    pub upper_gate: u16,
    /// End of the gate, sample number.
    pub lower_gate: u16,
    /// Level of the echo on the scale of `gain`.
    pub intensity: f32,
    /// Flags: bit 0 by magnitude, 1 by phase, 2-8 type of the quality, 9-12 priority.
    pub flags: u16,
    /// Quality tests passed: bit 0 signal-to-noise ratio, bit 1 colinearity.
    pub quality_flags: u8,
    /// Quality of the detection; 3 is good.
    pub quality: u8,
}

layout!(Detection, 20, "WBMS detection", Little);

/// A parsed packet of type 1.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Bathymetry<'a> {
    /// Head of the packet.
    pub head: BathymetryHead,
    detections: &'a [u8],
}

impl<'a> Bathymetry<'a> {
    /// Parses the payload of a packet.
    pub fn parse(packet: &Packet<'a>) -> Result<Self, WireError> {
        if packet.header.packet_type != packet_type::BATHYMETRY {
            return Err(WireError::unsupported(
                "WBMS packet type",
                packet.header.packet_type,
            ));
        }
        let head = BathymetryHead::parse(packet.payload)?;
        let len = Detection::SIZE_BYTES as u64 * u64::from(head.detections);
        let at = BathymetryHead::SIZE_BYTES;
        let detections = data_at(packet.payload, at, len, "WBMS detections")?;
        Ok(Self { head, detections })
    }

    /// Iterates over the detections.
    pub fn detections(&self) -> impl Iterator<Item = Detection> + 'a {
        self.detections
            .chunks_exact(Detection::SIZE_BYTES)
            .filter_map(|bytes| Detection::parse(bytes).ok())
    }
}

/// Appends a packet of detections, port side first, and returns its byte range.
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
