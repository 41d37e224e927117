//! Records 7057 (calibrated side-scan) and 10038 (raw I and Q of a single beam). Source: DFD 3.12, tables 99, 100, 131, 132.
//!
//! ```text
//! 7057   RTH 65 bytes; RD port f32[S], starboard f32[S], u16[S] beam numbers of port, u16[S] of starboard
//! 10038  RTH 120 bytes; RD n times f32 I, f32 Q
//! ```

use std::fmt;
use std::ops::Range;

use binrw::{BinRead, BinWrite};

use super::{data_at, rth};
use crate::sevenk::frame::{
    Layout, OpenRecord, RecordStamp, extend_encoded, read_fixed, write_layout,
};
use crate::sevenk::{WireError, record_id};

/// Record type header of record 7057 (calibrated side-scan).
#[derive(Debug, Clone, Copy, PartialEq, Default, BinRead, BinWrite)]
pub struct Rth7057 {
    /// Serial number of the sonar.
    pub sonar_id: u64,
    /// Ping number, sequential from 1.
    pub ping_number: u32,
    /// Sequence number in multi-ping mode; 0 in other modes.
    pub multi_ping_sequence: u16,
    /// Distance forward of beam 0.
    #[brw(pad_after = 4)]
    pub beam_position_m: f32,
    /// Number of samples per side, set from the slices.
    #[brw(pad_after = 32)]
    pub samples_per_side: u32,
    /// Number of beams per side; 1 in emitted records.
    pub beams_per_side: u16,
    /// Index of the beam.
    pub current_beam: u16,
    /// Size of a sample: 4 for f32, 8 for f64. Emitted records have 4.
    pub bytes_per_sample: u8,
    /// Data types; not used.
    pub data_types: u8,
    /// 0 if the samples are valid. Otherwise they are not calibrated.
    pub error_flag: u8,
}

rth!(Rth7057, 65, "7057 calibrated side scan");

/// One side of a calibrated side-scan line.
#[derive(Debug, Clone, Copy)]
pub struct CalibratedSide<'a> {
    /// Sound pressures, uPa.
    pub samples: &'a [f32],
    /// Beam that each sample was taken from.
    pub beams: &'a [u16],
}

/// Parsed record 7057 (calibrated side-scan) that borrows its samples.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CalibratedSideScan7057<'a> {
    /// Record type header.
    pub rth: Rth7057,
    /// Port and starboard.
    samples: [&'a [u8]; 2],
    beams: [&'a [u8]; 2],
}

impl<'a> CalibratedSideScan7057<'a> {
    /// Parses the body of the record. Returns an error if the body is too short or has an unsupported value.
    pub fn parse(body: &'a [u8]) -> Result<Self, WireError> {
        let rth: Rth7057 = read_fixed(body)?;
        if !matches!(rth.bytes_per_sample, 4 | 8) {
            return Err(WireError::unsupported(
                "7057 bytes per sample",
                rth.bytes_per_sample,
            ));
        }
        let count = u64::from(rth.samples_per_side);
        let side = count * u64::from(rth.bytes_per_sample);
        let data = data_at(
            body,
            Rth7057::RTH_BYTES,
            2 * side + 4 * count,
            "7057 samples",
        )?;
        let (samples, beams) = data.split_at(2 * side as usize);
        Ok(Self {
            rth,
            samples: samples.split_at(side as usize).into(),
            beams: beams.split_at(2 * count as usize).into(),
        })
    }

    /// Iterates over the port samples with the beam of each; the first is range 0.
    pub fn port(&self) -> impl Iterator<Item = (f64, u16)> + 'a {
        side(self.samples[0], self.beams[0], self.rth.bytes_per_sample)
    }

    /// Iterates over the starboard samples with the beam of each; the first is range 0.
    pub fn starboard(&self) -> impl Iterator<Item = (f64, u16)> + 'a {
        side(self.samples[1], self.beams[1], self.rth.bytes_per_sample)
    }
}

fn side<'a>(
    samples: &'a [u8],
    beams: &'a [u8],
    width: u8,
) -> impl Iterator<Item = (f64, u16)> + 'a {
    let samples = samples
        .chunks_exact(width.into())
        .map(|bytes| match *bytes {
            [a, b, c, d] => f64::from(f32::from_le_bytes([a, b, c, d])),
            [a, b, c, d, e, f, g, h] => f64::from_le_bytes([a, b, c, d, e, f, g, h]),
            _ => f64::NAN,
        });
    let beams = beams
        .chunks_exact(2)
        .map(|b| u16::from_le_bytes([b[0], b[1]]));
    samples.zip(beams)
}

/// Appends a record 7057 (calibrated side-scan) of f32. `samples_per_side`, `bytes_per_sample` and `beams_per_side` of `rth` are ignored.
///
/// # Panics
/// If the sides differ in length, or samples and beams of a side differ in number.
pub fn emit_7057(
    buf: &mut Vec<u8>,
    stamp: &RecordStamp,
    rth: &Rth7057,
    port: CalibratedSide<'_>,
    starboard: CalibratedSide<'_>,
) -> Range<usize> {
    let count = port.samples.len();
    assert!(
        [
            port.beams.len(),
            starboard.samples.len(),
            starboard.beams.len()
        ] == [count; 3],
        "7057 sides of {count} samples"
    );
    let open = OpenRecord::begin(buf, record_id::CALIBRATED_SIDE_SCAN, stamp);
    buf.reserve(Rth7057::SIZE_BYTES + 12 * count + 4);
    write_layout(
        &Rth7057 {
            samples_per_side: count as u32,
            beams_per_side: 1,
            bytes_per_sample: 4,
            ..*rth
        },
        buf,
    );
    for side in [port, starboard] {
        extend_encoded(buf, side.samples, f32::to_le_bytes);
    }
    for side in [port, starboard] {
        extend_encoded(buf, side.beams, u16::to_le_bytes);
    }
    open.finish(buf)
}

/// Record type header of record 10038 (single-beam I and Q).
#[derive(Debug, Clone, Copy, PartialEq, Default, BinRead, BinWrite)]
pub struct Rth10038 {
    /// Ping number, sequential from 1.
    pub ping_number: u32,
    /// Sequence number in multi-ping mode; 0 in other modes.
    pub multi_ping_sequence: u32,
    /// Mean sound velocity of the water column.
    pub mean_sound_velocity_m_per_s: f32,
    /// Draught of the transducer, not applied to the data.
    pub draft_not_applied_m: f32,
    /// Sample rate.
    pub sample_rate_hz: f32,
    /// Effective length of the pulse.
    pub effective_pulse_length_s: f32,
    /// Two-way time of the first sample.
    pub start_sample_delay_s: f32,
    /// Number of bits of a complex sample; always 64.
    pub bits_per_sample: u32,
    /// Largest possible value.
    pub full_scale: f32,
    /// Number of samples, set from the slice.
    #[brw(pad_after = 80)]
    pub samples: u32,
}

rth!(Rth10038, 120, "10038 single-beam raw I/Q");

/// Parsed record 10038 (single-beam I and Q) that borrows its samples.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SingleBeamIq10038<'a> {
    /// Record type header.
    pub rth: Rth10038,
    data: &'a [u8],
}

impl<'a> SingleBeamIq10038<'a> {
    /// Parses a body with 64 bits per sample, an f32 each for I and Q.
    pub fn parse(body: &'a [u8]) -> Result<Self, WireError> {
        let rth: Rth10038 = read_fixed(body)?;
        if rth.bits_per_sample != 64 {
            return Err(WireError::unsupported(
                "10038 bits per sample",
                rth.bits_per_sample,
            ));
        }
        let len = 8 * u64::from(rth.samples);
        let data = data_at(body, Rth10038::RTH_BYTES, len, "10038 samples")?;
        Ok(Self { rth, data })
    }

    /// Iterates over I and Q.
    pub fn iq(&self) -> impl ExactSizeIterator<Item = [f32; 2]> + 'a {
        self.data.chunks_exact(8).map(|b| {
            [
                f32::from_le_bytes([b[0], b[1], b[2], b[3]]),
                f32::from_le_bytes([b[4], b[5], b[6], b[7]]),
            ]
        })
    }
}

/// Appends a record 10038 (single-beam I and Q). `samples` and `bits_per_sample` of `rth` are ignored.
pub fn emit_10038(
    buf: &mut Vec<u8>,
    stamp: &RecordStamp,
    rth: &Rth10038,
    iq: &[[f32; 2]],
) -> Range<usize> {
    let open = OpenRecord::begin(buf, record_id::SINGLE_BEAM_IQ, stamp);
    write_layout(
        &Rth10038 {
            bits_per_sample: 64,
            samples: iq.len() as u32,
            ..*rth
        },
        buf,
    );
    extend_encoded(buf, iq.as_flattened(), f32::to_le_bytes);
    open.finish(buf)
}

impl fmt::Display for CalibratedSideScan7057<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "calibrated side scan: ping {} of sonar {}, {} samples per side, error flag {}",
            self.rth.ping_number, self.rth.sonar_id, self.rth.samples_per_side, self.rth.error_flag
        )
    }
}

impl fmt::Display for SingleBeamIq10038<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "single-beam raw I/Q: ping {}, {} samples at {} Hz",
            self.rth.ping_number, self.rth.samples, self.rth.sample_rate_hz
        )
    }
}
