//! Record 7042 (compressed water column), by beam. Source: DFD 3.12, tables 83 and 84.
//!
//! ```text
//! RTH   44 bytes, see Rth7042
//! RD    per beam: u16 beam, [u8 segment, flag bit 14], u32 samples n, n samples
//!       a sample is magnitude and phase of 16 + 16 bits, 8 + 8 (bit 2), 32 + 8 (bit 12), or the magnitude alone (bit 1)
//! ```

use std::fmt;
use std::ops::Range;

use binrw::{BinRead, BinWrite};

use super::{BeamSample, data_at, rth};
use crate::sevenk::frame::{
    OpenRecord, RecordStamp, extend_encoded, read_fixed, u32_at, write_layout,
};
use crate::sevenk::{WireError, record_id};

/// Bits of [`Rth7042::flags`].
pub mod flags_7042 {
    /// Samples are limited by the detection.
    pub const LIMITED_BY_DETECTION: u32 = 1;
    /// No phase.
    pub const MAGNITUDE_ONLY: u32 = 1 << 1;
    /// Magnitudes in dB with 8 bits.
    pub const DB_IN_8_BITS: u32 = 1 << 2;
    /// Position of the divisor of the sample rate.
    pub const DIVISOR_SHIFT: u32 = 4;
    /// Magnitudes with 32 bits.
    pub const MAGNITUDE_IN_32_BITS: u32 = 1 << 12;
    /// The compression factor is valid.
    pub const COMPRESSION_FACTOR: u32 = 1 << 13;
    /// Beams have segments.
    pub const SEGMENTS: u32 = 1 << 14;
    /// The first sample is a delay.
    pub const FIRST_SAMPLE_IS_DELAY: u32 = 1 << 15;
}

/// Record type header of record 7042 (compressed water column).
#[derive(Debug, Clone, Copy, PartialEq, Default, BinRead, BinWrite)]
pub struct Rth7042 {
    /// Serial number of the sonar.
    pub sonar_id: u64,
    /// Ping number, sequential from 1.
    pub ping_number: u32,
    /// Sequence number in multi-ping mode; 0 in other modes.
    pub multi_ping_sequence: u16,
    /// Number of beams, set from the slice.
    pub beams: u16,
    /// Number of samples for the range.
    pub samples: u32,
    /// Number of samples of the longest beam, set from the slices.
    pub compressed_samples: u32,
    /// Bits of [`flags_7042`].
    pub flags: u32,
    /// First sample of the beams.
    pub first_sample: u32,
    /// Sample rate after the divisor.
    pub sample_rate_hz: f32,
    #[brw(pad_after = 4)]
    /// Factor between magnitudes and counts.
    pub compression_factor: f32,
}

rth!(Rth7042, 44, "7042 compressed water column");

/// Sizes of magnitude and phase of a sample, bytes.
fn widths(flags: u32) -> Result<(usize, usize), WireError> {
    use flags_7042::{DB_IN_8_BITS, MAGNITUDE_IN_32_BITS, MAGNITUDE_ONLY};
    let is = |flag| flags & flag != 0;
    let (magnitude, phase) = match (is(MAGNITUDE_IN_32_BITS), is(DB_IN_8_BITS)) {
        (false, false) => (2, 2),
        (false, true) => (1, 1),
        (true, false) => (4, 1),
        (true, true) => {
            let what = "7042 with both 8-bit and 32-bit samples, flags";
            return Err(WireError::unsupported(what, flags));
        }
    };
    Ok((magnitude, if is(MAGNITUDE_ONLY) { 0 } else { phase }))
}

/// A parsed beam that borrows its samples.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct CompressedBeam<'a> {
    /// Index of the beam.
    pub beam: u16,
    /// Index of the segment; 0 if the record has no segments.
    pub segment: u8,
    magnitude_bytes: usize,
    phase_bytes: usize,
    data: &'a [u8],
}

impl<'a> CompressedBeam<'a> {
    /// Iterates over magnitude and phase. A phase of 8 bits is the upper half of 16 bits; a missing phase is 0.
    pub fn samples(&self) -> impl ExactSizeIterator<Item = (u32, i16)> + 'a {
        let (magnitude_bytes, phase_bytes) = (self.magnitude_bytes, self.phase_bytes);
        self.data
            .chunks_exact(magnitude_bytes + phase_bytes)
            .map(move |sample| {
                let (magnitude, phase) = sample.split_at(magnitude_bytes);
                let mut wide = [0; 4];
                wide[..magnitude.len()].copy_from_slice(magnitude);
                let phase = match *phase {
                    [high] => i16::from_le_bytes([0, high]),
                    [low, high] => i16::from_le_bytes([low, high]),
                    _ => 0,
                };
                (u32::from_le_bytes(wide), phase)
            })
    }
}

/// Parsed record 7042 (compressed water column) that borrows its beams.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct WaterColumn7042<'a> {
    /// Record type header.
    pub rth: Rth7042,
    data: &'a [u8],
}

impl<'a> WaterColumn7042<'a> {
    /// Parses all beams, so that [`WaterColumn7042::beams`] cannot fail.
    pub fn parse(body: &'a [u8]) -> Result<Self, WireError> {
        let rth: Rth7042 = read_fixed(body)?;
        widths(rth.flags)?;
        let data = &body[Rth7042::RTH_BYTES..];
        let mut at = 0;
        for _ in 0..rth.beams {
            at += beam_at(&rth, data, at)?.1;
        }
        Ok(Self {
            rth,
            data: &data[..at],
        })
    }

    /// Iterates over the beams.
    pub fn beams(&self) -> impl Iterator<Item = CompressedBeam<'a>> + 'a {
        let (rth, data, mut at) = (self.rth, self.data, 0);
        (0..rth.beams).map_while(move |_| {
            let (beam, len) = beam_at(&rth, data, at).ok()?;
            at += len;
            Some(beam)
        })
    }
}

/// Beam at an offset in the record data, and its length.
fn beam_at<'a>(
    rth: &Rth7042,
    data: &'a [u8],
    at: usize,
) -> Result<(CompressedBeam<'a>, usize), WireError> {
    const WHAT: &str = "7042 beam";
    let (magnitude_bytes, phase_bytes) = widths(rth.flags)?;
    let has_segment = rth.flags & flags_7042::SEGMENTS != 0;
    let head_bytes = 6 + usize::from(has_segment);
    let head = data_at(data, at, head_bytes as u64, WHAT)?;
    let samples = u32_at(head, head_bytes - 4).unwrap_or_default();
    let len = u64::from(samples) * (magnitude_bytes + phase_bytes) as u64;
    let data = data_at(data, at + head_bytes, len, WHAT)?;
    let beam = CompressedBeam {
        beam: u16::from_le_bytes([head[0], head[1]]),
        segment: if has_segment { head[2] } else { 0 },
        magnitude_bytes,
        phase_bytes,
        data,
    };
    Ok((beam, head_bytes + data.len()))
}

/// One beam to emit, in wire numbers.
#[derive(Debug, Clone, Copy)]
pub struct BeamSamples<'a> {
    /// Index of the beam.
    pub beam: u16,
    /// Index of the segment, emitted if the flags require it.
    pub segment: u8,
    /// Magnitudes. Values beyond the width set by the flags are clipped.
    pub magnitudes: &'a [u32],
    /// Phases, as many as magnitudes, or none if the flags exclude phases. With 8 bits the upper half is emitted.
    pub phases: &'a [i16],
}

/// Appends a record 7042 (compressed water column). `beams` and `compressed_samples` of `rth` are ignored.
///
/// # Panics
/// If the flags are contradictory, phases and magnitudes of a beam differ in number, or there are more than 65535 beams.
pub fn emit_7042(
    buf: &mut Vec<u8>,
    stamp: &RecordStamp,
    rth: &Rth7042,
    beams: &[BeamSamples<'_>],
) -> Range<usize> {
    let (magnitude_bytes, phase_bytes) = widths(rth.flags).expect("flags of 7042");
    let longest = beams.iter().map(|beam| beam.magnitudes.len()).max();
    let open = OpenRecord::begin(buf, record_id::COMPRESSED_WATER_COLUMN, stamp);
    write_layout(
        &Rth7042 {
            beams: u16::try_from(beams.len()).expect("at most 65535 beams"),
            compressed_samples: longest.unwrap_or_default() as u32,
            ..*rth
        },
        buf,
    );
    let largest = u32::MAX >> (32 - 8 * magnitude_bytes);
    for beam in beams {
        buf.extend(beam.beam.to_le_bytes());
        if rth.flags & flags_7042::SEGMENTS != 0 {
            buf.push(beam.segment);
        }
        buf.extend((beam.magnitudes.len() as u32).to_le_bytes());
        buf.reserve(beam.magnitudes.len() * (magnitude_bytes + phase_bytes));
        if phase_bytes > 0 {
            assert_eq!(
                beam.phases.len(),
                beam.magnitudes.len(),
                "phases of beam {}",
                beam.beam
            );
        }
        for (index, &magnitude) in beam.magnitudes.iter().enumerate() {
            buf.extend_from_slice(&magnitude.min(largest).to_le_bytes()[..magnitude_bytes]);
            if phase_bytes > 0 {
                buf.extend_from_slice(&beam.phases[index].to_le_bytes()[2 - phase_bytes..]);
            }
        }
    }
    open.finish(buf)
}

/// Appends a record 7042 (compressed water column) with magnitudes and phases of 16 bits, one item of `beams` for each beam in order.
/// `beams` and `compressed_samples` of `rth` are ignored.
///
/// # Panics
/// If `rth.flags` asks for other samples, or there are more than 65535 beams.
pub fn emit_7042_of_16_bits<'a>(
    buf: &mut Vec<u8>,
    stamp: &RecordStamp,
    rth: &Rth7042,
    beams: impl Iterator<Item = &'a [BeamSample]> + Clone,
) -> Range<usize> {
    let has_16_bits = widths(rth.flags) == Ok((2, 2)) && rth.flags & flags_7042::SEGMENTS == 0;
    assert!(has_16_bits, "7042 with flags {:#x}", rth.flags);
    let open = OpenRecord::begin(buf, record_id::COMPRESSED_WATER_COLUMN, stamp);
    let longest = beams.clone().map(<[_]>::len).max();
    write_layout(
        &Rth7042 {
            beams: u16::try_from(beams.clone().count()).expect("at most 65535 beams"),
            compressed_samples: longest.unwrap_or_default() as u32,
            ..*rth
        },
        buf,
    );
    for (beam, samples) in beams.enumerate() {
        buf.extend_from_slice(&(beam as u16).to_le_bytes());
        buf.extend_from_slice(&(samples.len() as u32).to_le_bytes());
        extend_encoded(buf, samples, BeamSample::to_le_bytes);
    }
    open.finish(buf)
}

impl fmt::Display for WaterColumn7042<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "compressed water column: ping {} of sonar {}, {} beams, at most {} samples, flags {:#x}",
            self.rth.ping_number,
            self.rth.sonar_id,
            self.rth.beams,
            self.rth.compressed_samples,
            self.rth.flags
        )
    }
}
