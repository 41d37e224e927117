//! Packet types 2 (water column), 4 (snippets) and 5 (side-scan): samples with a common header. Source: TN-180196, water column,
//! snippet and side-scan data. Offsets count from the start of the packet.
//!
//! ```text
//! type 2   samples[M][N], f32 angle[N]
//! type 4   samples[M][N], f32 angle[N], u16 start sample[N], u16 detection sample[N]
//! type 5   samples[M][2], port then starboard
//! ```

use std::ops::Range;

use binrw::{BinRead, BinWrite};

use super::{Packet, emit_packet, packet_type};
use crate::WireError;
use crate::layout::{data_at, layout};
use crate::sevenk::frame::{extend_encoded, extend_transposed};

/// Number type of the samples. Emitted packets have i16, because a widely used display requires this type. All real types are
/// parsed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DataKind {
    /// 8-bit unsigned.
    U8,
    /// 8-bit signed.
    I8,
    /// 16-bit unsigned.
    U16,
    /// 16-bit signed.
    I16,
    /// 32-bit unsigned.
    U32,
    /// 32-bit signed.
    I32,
    /// 64-bit unsigned.
    U64,
    /// 64-bit signed.
    I64,
    /// 32-bit float.
    F32,
    /// 64-bit float.
    F64,
}

impl DataKind {
    const CODES: [(u32, Self); 10] = [
        (0, Self::U8),
        (1, Self::I8),
        (2, Self::U16),
        (3, Self::I16),
        (4, Self::U32),
        (5, Self::I32),
        (6, Self::U64),
        (7, Self::I64),
        (0x15, Self::F32),
        (0x17, Self::F64),
    ];

    /// Type of a code in a packet.
    pub fn from_code(code: u32) -> Result<Self, WireError> {
        Self::CODES
            .iter()
            .find(|&&(known, _)| known == code)
            .map(|&(_, kind)| kind)
            .ok_or(WireError::unsupported("WBMS data type", code))
    }

    /// Size of a sample.
    pub fn bytes(self) -> usize {
        match self {
            Self::U8 | Self::I8 => 1,
            Self::U16 | Self::I16 => 2,
            Self::U32 | Self::I32 | Self::F32 => 4,
            Self::U64 | Self::I64 | Self::F64 => 8,
        }
    }

    fn value(self, bytes: &[u8]) -> f64 {
        let mut wide = [0; 8];
        wide[..bytes.len()].copy_from_slice(bytes);
        let bits = u64::from_le_bytes(wide);
        match self {
            Self::U8 | Self::U16 | Self::U32 | Self::U64 => bits as f64,
            Self::I8 => f64::from(bits as i8),
            Self::I16 => f64::from(bits as i16),
            Self::I32 => f64::from(bits as i32),
            Self::I64 => bits as i64 as f64,
            Self::F32 => f64::from(f32::from_bits(bits as u32)),
            Self::F64 => f64::from_bits(bits),
        }
    }
}

/// Code of [`DataKind::I16`] in a packet.
const I16_CODE: u32 = 3;

/// Fields common to all samples. The numbers of beams and samples and their type are set when the packet is emitted.
#[derive(Debug, Clone, Copy, PartialEq, Default, BinRead, BinWrite)]
pub struct BackscatterHead {
    /// Offset 24: sound velocity.
    pub sound_velocity_m_per_s: f32,
    /// Offset 28: sample rate.
    pub sample_rate_hz: f32,
    /// Offset 32: number of beams N; 2 for side-scan.
    pub beams: u32,
    /// Offset 36: Number of samples M of each beam.
    pub samples: u32,
    /// Offset 40: Time of the ping, seconds since 1970.
    pub time_s: f64,
    /// Offset 48: code of [`DataKind`].
    pub data_type: u32,
    /// Offset 52: number of the first sample.
    pub t0_samples: i32,
    /// Offset 56: gain; a display divides by it.
    #[brw(pad_after = 4)]
    pub gain: f32,
    /// Offset 64: direction of the swath's centre, positive to starboard.
    pub swath_direction_rad: f32,
    /// Offset 68: width of the swath.
    pub swath_opening_rad: f32,
    /// Offset 72: centre frequency.
    pub tx_frequency_hz: f32,
    /// Offset 76: bandwidth of the pulse.
    pub tx_bandwidth_hz: f32,
    /// Offset 80: pulse length.
    pub tx_length_s: f32,
    /// Offset 84: amplitude of the transmitter, 0 to 15.
    #[brw(pad_after = 12)]
    pub tx_amplitude: u32,
    /// Offset 100: ping rate.
    #[brw(pad_after = 4)]
    pub ping_rate_hz: f32,
    /// Offset 108: counter of pings.
    pub ping_number: u32,
    /// Offset 112: time of sending, seconds since 1970.
    pub time_net_s: f64,
    /// Offset 120: number of beams of the beamformer.
    pub beams_of_former: u32,
    /// Offset 124: gain over time: `vga_g0_db` up to sample `vga_t0`, `vga_g1_db` from `vga_t1`, linear between.
    pub vga_t0: i32,
    /// Offset 128: gain before `vga_t0`.
    pub vga_g0_db: f32,
    /// Offset 132: end of the gain ramp, samples.
    pub vga_t1: i32,
    #[brw(pad_after = 4)]
    /// Gain after `vga_t1`.
    pub vga_g1_db: f32,
    /// Offset 144: direction of the transmit sector.
    pub tx_angle_rad: f32,
    /// Offset 148: voltage of the transmitter.
    pub tx_voltage: f32,
    /// Offset 152: rule for the beam directions.
    pub beam_distribution: u8,
    #[brw(pad_after = 2)]
    /// Offset 153: sonar mode; 1 is bathymetry.
    pub sonar_mode: u8,
    /// Offset 156: tilt of the gates.
    pub gate_tilt_rad: f32,
    #[brw(pad_after = 28)]
    /// Uncertainty of the time.
    pub time_uncertainty_s: f32,
}

layout!(BackscatterHead, 168, "WBMS backscatter", Little);

/// Data after the samples.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Tail<'a> {
    /// Angles of the beams of the water column.
    WaterColumn {
        /// Angles of the beams, positive to starboard.
        angles_rad: &'a [f32],
    },
    /// Positions of the snippets.
    Snippets {
        /// Beam angles, positive to starboard.
        angles_rad: &'a [f32],
        /// Number of the first sample of each snippet.
        start_samples: &'a [u16],
        /// Number of the detection's sample of each snippet.
        detection_samples: &'a [u16],
    },
    /// Two columns, port and starboard, without further data.
    SideScan,
}

/// Appends a packet of i16 samples in sample order and returns its byte range.
///
/// # Panics
/// If the numbers of angles, snippets and samples are inconsistent; side-scan has two columns.
pub fn emit_backscatter(
    buf: &mut Vec<u8>,
    head: &BackscatterHead,
    samples_by_beams: &[i16],
    tail: Tail<'_>,
) -> Range<usize> {
    emit_samples(buf, head, samples_by_beams.len(), tail, |buf, _| {
        extend_encoded(buf, samples_by_beams, i16::to_le_bytes);
    })
}

/// Like [`emit_backscatter`], from samples ordered by beam, then by sample, which it transposes.
///
/// # Panics
/// As [`emit_backscatter`].
pub fn emit_backscatter_beam_major(
    buf: &mut Vec<u8>,
    head: &BackscatterHead,
    samples_beam_major: &[i16],
    tail: Tail<'_>,
) -> Range<usize> {
    emit_samples(buf, head, samples_beam_major.len(), tail, |buf, beams| {
        extend_transposed(buf, samples_beam_major, beams, i16::to_le_bytes);
    })
}

fn emit_samples(
    buf: &mut Vec<u8>,
    head: &BackscatterHead,
    samples: usize,
    tail: Tail<'_>,
    write_samples: impl FnOnce(&mut Vec<u8>, usize),
) -> Range<usize> {
    let (kind, beams) = match tail {
        Tail::WaterColumn { angles_rad } => (packet_type::WATER_COLUMN, angles_rad.len()),
        Tail::Snippets {
            angles_rad,
            start_samples,
            detection_samples,
        } => {
            assert_eq!(angles_rad.len(), start_samples.len(), "WBMS snippets");
            assert_eq!(angles_rad.len(), detection_samples.len(), "WBMS snippets");
            (packet_type::SNIPPETS, angles_rad.len())
        }
        Tail::SideScan => (packet_type::SIDE_SCAN, 2),
    };
    assert!(
        beams > 0 && samples.is_multiple_of(beams),
        "{samples} samples of {beams} beams"
    );
    let head = BackscatterHead {
        beams: beams as u32,
        samples: (samples / beams) as u32,
        data_type: I16_CODE,
        ..*head
    };
    emit_packet(buf, kind, |buf| {
        head.emit(buf);
        write_samples(buf, beams);
        match tail {
            Tail::WaterColumn { angles_rad } => extend_encoded(buf, angles_rad, f32::to_le_bytes),
            Tail::Snippets {
                angles_rad,
                start_samples,
                detection_samples,
            } => {
                extend_encoded(buf, angles_rad, f32::to_le_bytes);
                extend_encoded(buf, start_samples, u16::to_le_bytes);
                extend_encoded(buf, detection_samples, u16::to_le_bytes);
            }
            Tail::SideScan => {}
        }
    })
}

/// Parsed types 2, 4 and 5.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Backscatter<'a> {
    /// Packet type, one of [`packet_type`].
    pub packet_type: u32,
    /// Head of the packet.
    pub head: BackscatterHead,
    /// Type of the samples.
    pub kind: DataKind,
    samples: &'a [u8],
    angles: &'a [u8],
    starts: &'a [u8],
    detections: &'a [u8],
}

impl<'a> Backscatter<'a> {
    /// Parses the payload of a packet.
    pub fn parse(packet: &Packet<'a>) -> Result<Self, WireError> {
        const WHAT: &str = "WBMS samples";
        let packet_type = packet.header.packet_type;
        let (has_angles, has_snippets) = match packet_type {
            packet_type::WATER_COLUMN => (true, false),
            packet_type::SNIPPETS => (true, true),
            packet_type::SIDE_SCAN => (false, false),
            other => return Err(WireError::unsupported("WBMS packet type", other)),
        };
        let head = BackscatterHead::parse(packet.payload)?;
        let kind = DataKind::from_code(head.data_type)?;
        let beams = u64::from(head.beams);
        let mut at = BackscatterHead::SIZE_BYTES;
        let mut take = |len: u64| {
            let data = data_at(packet.payload, at, len, WHAT)?;
            at += data.len();
            Ok::<_, WireError>(data)
        };
        // The product of two 32-bit numbers is below 2^64. The product with the size, at most 8, saturates.
        let samples = take(
            beams
                .saturating_mul(head.samples.into())
                .saturating_mul(kind.bytes() as u64),
        )?;
        let angles = take(if has_angles { 4 * beams } else { 0 })?;
        let starts = take(if has_snippets { 2 * beams } else { 0 })?;
        let detections = take(if has_snippets { 2 * beams } else { 0 })?;
        Ok(Self {
            packet_type,
            head,
            kind,
            samples,
            angles,
            starts,
            detections,
        })
    }

    /// All samples in packet order: by sample, then by beam.
    pub fn values(&self) -> impl ExactSizeIterator<Item = f64> + 'a {
        let kind = self.kind;
        self.samples
            .chunks_exact(kind.bytes())
            .map(move |bytes| kind.value(bytes))
    }

    /// Iterates over the beam angles, positive to starboard; empty for side-scan.
    pub fn angles_rad(&self) -> impl ExactSizeIterator<Item = f32> + 'a {
        self.angles
            .chunks_exact(4)
            .map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]]))
    }

    /// Iterates over the snippets: first sample and detection sample.
    pub fn snippets(&self) -> impl Iterator<Item = (u16, u16)> + 'a {
        let u16s = |bytes: &'a [u8]| {
            bytes
                .chunks_exact(2)
                .map(|b| u16::from_le_bytes([b[0], b[1]]))
        };
        u16s(self.starts).zip(u16s(self.detections))
    }
}
