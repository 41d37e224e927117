//! Records 7028 (snippets, as intensities) and 7058 (snippet scattering strengths): samples around each detection. Source: DFD
//! 3.12, tables 75, 76, 101, 102.
//!
//! ```text
//! RTH   46 bytes, see Rth7028; 49 bytes, see Rth7058
//! RD    N descriptors of 14 bytes, then N series of end - start + 1 samples: u16 or u32 (7028), f32 (7058);
//!       7058 with bit 6 of its control flags: N series of footprints, f32, as long
//! ```
//!
//! A descriptor with its start after its end has no samples.

use std::fmt;
use std::ops::Range;

use binrw::{BinRead, BinWrite};

use super::{data_at, rth};
use crate::sevenk::frame::{
    Layout, OpenRecord, RecordStamp, extend_encoded, read_fixed, write_layout,
};
use crate::sevenk::{WireError, record_id};

/// Position of one snippet.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, BinRead, BinWrite)]
pub struct SnippetDescriptor {
    /// Index of the beam.
    pub beam: u16,
    /// First sample.
    pub start_sample: u32,
    /// Sample of the detection.
    pub detection_sample: u32,
    /// Last sample, inclusive.
    pub end_sample: u32,
}

rth!(SnippetDescriptor, 14, "snippet descriptor");

impl SnippetDescriptor {
    /// Number of samples of the snippet; 0 if its start is after its end.
    pub fn samples(&self) -> u64 {
        (u64::from(self.end_sample) + 1).saturating_sub(self.start_sample.into())
    }
}

/// Record type header of record 7028 (snippets).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, BinRead, BinWrite)]
pub struct Rth7028 {
    /// Serial number of the sonar.
    pub sonar_id: u64,
    /// Ping number, sequential from 1.
    pub ping_number: u32,
    /// Sequence number in multi-ping mode; 0 in other modes.
    pub multi_ping_sequence: u16,
    /// Number of detections, set from the slice.
    pub detections: u16,
    /// 0 if the record is valid, 6 if the bottom detection failed.
    pub error_flag: u8,
    /// Bit 0 automatic window, 1 quality filter, 2 minimum window, 3 maximum window.
    pub control_flags: u8,
    /// Bit 0: samples of 32 bits; set from the samples.
    #[brw(pad_after = 24)]
    pub flags: u32,
}

rth!(Rth7028, 46, "7028 snippets");

/// Record type header of record 7058 (snippet scattering strengths).
#[derive(Debug, Clone, Copy, PartialEq, Default, BinRead, BinWrite)]
pub struct Rth7058 {
    /// Serial number of the sonar.
    pub sonar_id: u64,
    /// Ping number, sequential from 1.
    pub ping_number: u32,
    /// Sequence number in multi-ping mode; 0 in other modes.
    pub multi_ping_sequence: u16,
    /// Number of detections, set from the slice.
    pub detections: u16,
    /// 0 if the record is valid. Otherwise its contents are not calibrated.
    pub error_flag: u8,
    /// Bits 0 brightness and 1 colinearity required, 6 footprints (set from the slices), 7 generic compensation, 8 one absorption.
    pub control_flags: u32,
    #[brw(pad_after = 24)]
    /// Absorption, one way.
    pub absorption_db_per_km: f32,
}

rth!(Rth7058, 49, "7058 snippet scattering strength");

const SAMPLES_OF_32_BITS: u32 = 1;
const HAS_FOOTPRINTS: u32 = 1 << 6;

/// Descriptors, validated against the samples that follow.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Snippets<'a> {
    descriptors: &'a [u8],
    data: &'a [u8],
}

impl<'a> Snippets<'a> {
    fn parse(
        body: &'a [u8],
        rth_bytes: usize,
        count: u16,
        sample_bytes: u64,
        what: &'static str,
    ) -> Result<Self, WireError> {
        let len = u64::from(count) * SnippetDescriptor::SIZE_BYTES as u64;
        let descriptors = data_at(body, rth_bytes, len, what)?;
        let snippets = Self {
            descriptors,
            data: &[],
        };
        // At most 2^16 snippets of 2^32 samples of 8 bytes are below 2^64.
        let samples: u64 = snippets.descriptors().map(|d| d.samples()).sum();
        let data = data_at(
            body,
            rth_bytes + descriptors.len(),
            samples * sample_bytes,
            what,
        )?;
        Ok(Self { descriptors, data })
    }

    fn descriptors(&self) -> impl Iterator<Item = SnippetDescriptor> + 'a {
        self.descriptors
            .chunks_exact(SnippetDescriptor::SIZE_BYTES)
            .filter_map(|bytes| read_fixed(bytes).ok())
    }

    /// Iterates over the descriptors with the bytes of their samples, in series from byte `from` on.
    fn series(
        &self,
        from: usize,
        sample_bytes: usize,
    ) -> impl Iterator<Item = (SnippetDescriptor, &'a [u8])> + 'a {
        let (data, mut at) = (self.data, from);
        self.descriptors().map(move |descriptor| {
            let start = at;
            at += descriptor.samples() as usize * sample_bytes;
            (descriptor, data.get(start..at).unwrap_or_default())
        })
    }
}

/// Parsed record 7028 (snippets) that borrows its samples.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Snippets7028<'a> {
    /// Record type header.
    pub rth: Rth7028,
    snippets: Snippets<'a>,
}

impl<'a> Snippets7028<'a> {
    /// Parses the body of the record. Returns an error if the body is too short.
    pub fn parse(body: &'a [u8]) -> Result<Self, WireError> {
        let rth: Rth7028 = read_fixed(body)?;
        let width = sample_bytes_7028(&rth) as u64;
        let snippets = Snippets::parse(
            body,
            Rth7028::RTH_BYTES,
            rth.detections,
            width,
            "7028 snippets",
        )?;
        Ok(Self { rth, snippets })
    }

    /// Iterates over the snippets with their intensities as u32.
    pub fn snippets(
        &self,
    ) -> impl Iterator<Item = (SnippetDescriptor, impl Iterator<Item = u32> + 'a)> + 'a {
        let width = sample_bytes_7028(&self.rth);
        self.snippets
            .series(0, width)
            .map(move |(descriptor, data)| {
                let samples = data.chunks_exact(width).map(|sample| {
                    let mut wide = [0; 4];
                    wide[..sample.len()].copy_from_slice(sample);
                    u32::from_le_bytes(wide)
                });
                (descriptor, samples)
            })
    }
}

fn sample_bytes_7028(rth: &Rth7028) -> usize {
    if rth.flags & SAMPLES_OF_32_BITS == 0 {
        2
    } else {
        4
    }
}

/// Intensities of all snippets in sequence, with the sample width of the record.
#[derive(Debug, Clone, Copy)]
pub enum SnippetSamples<'a> {
    /// 16 bits per sample.
    U16(&'a [u16]),
    /// 32 bits per sample.
    U32(&'a [u32]),
}

/// Appends a record 7028 (snippets).
///
/// # Panics
/// If the number of samples differs from the descriptors, or there are more than 65535 snippets.
pub fn emit_7028(
    buf: &mut Vec<u8>,
    stamp: &RecordStamp,
    rth: &Rth7028,
    descriptors: &[SnippetDescriptor],
    samples: SnippetSamples<'_>,
) -> Range<usize> {
    let (count, width_flag) = match samples {
        SnippetSamples::U16(samples) => (samples.len(), 0),
        SnippetSamples::U32(samples) => (samples.len(), SAMPLES_OF_32_BITS),
    };
    let open = OpenRecord::begin(buf, record_id::SNIPPETS, stamp);
    write_layout(
        &Rth7028 {
            detections: count_of(descriptors, count, "7028"),
            flags: rth.flags & !SAMPLES_OF_32_BITS | width_flag,
            ..*rth
        },
        buf,
    );
    descriptors.iter().for_each(|d| write_layout(d, buf));
    match samples {
        SnippetSamples::U16(samples) => extend_encoded(buf, samples, u16::to_le_bytes),
        SnippetSamples::U32(samples) => extend_encoded(buf, samples, u32::to_le_bytes),
    }
    open.finish(buf)
}

fn count_of(descriptors: &[SnippetDescriptor], samples: usize, what: &str) -> u16 {
    let expected: u64 = descriptors.iter().map(SnippetDescriptor::samples).sum();
    assert_eq!(samples as u64, expected, "{what} samples of its snippets");
    u16::try_from(descriptors.len()).expect("at most 65535 snippets")
}

/// Parsed record 7058 (snippet scattering strengths) that borrows its samples.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SnippetStrengths7058<'a> {
    /// Record type header.
    pub rth: Rth7058,
    snippets: Snippets<'a>,
}

impl<'a> SnippetStrengths7058<'a> {
    /// Parses the body of the record. Returns an error if the body is too short.
    pub fn parse(body: &'a [u8]) -> Result<Self, WireError> {
        let rth: Rth7058 = read_fixed(body)?;
        let per_sample = if rth.control_flags & HAS_FOOTPRINTS == 0 {
            4
        } else {
            8
        };
        let snippets = Snippets::parse(
            body,
            Rth7058::RTH_BYTES,
            rth.detections,
            per_sample,
            "7058 snippets",
        )?;
        Ok(Self { rth, snippets })
    }

    /// Iterates over the snippets with their scattering strengths, 10 log10 of the cross section per area.
    pub fn strengths_db(
        &self,
    ) -> impl Iterator<Item = (SnippetDescriptor, impl Iterator<Item = f32> + 'a)> + 'a {
        self.snippets
            .series(0, 4)
            .map(|(descriptor, data)| (descriptor, f32s(data)))
    }

    /// Iterates over the snippets with the footprints of their samples; empty if the record has none.
    pub fn footprints_m2(
        &self,
    ) -> impl Iterator<Item = (SnippetDescriptor, impl Iterator<Item = f32> + 'a)> + 'a {
        let half = self.snippets.data.len() / 2;
        let is_there = self.rth.control_flags & HAS_FOOTPRINTS != 0;
        self.snippets
            .series(half, 4)
            .filter(move |_| is_there)
            .map(|(descriptor, data)| (descriptor, f32s(data)))
    }
}

fn f32s(data: &[u8]) -> impl Iterator<Item = f32> + '_ {
    data.chunks_exact(4)
        .map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]]))
}

/// Appends a record 7058 (snippet scattering strengths). Footprints are optional, as many as strengths.
///
/// # Panics
/// If the numbers of strengths or footprints differ from the descriptors, or there are more than 65535 snippets.
pub fn emit_7058(
    buf: &mut Vec<u8>,
    stamp: &RecordStamp,
    rth: &Rth7058,
    descriptors: &[SnippetDescriptor],
    strengths_db: &[f32],
    footprints_m2: Option<&[f32]>,
) -> Range<usize> {
    let detections = count_of(descriptors, strengths_db.len(), "7058");
    let footprint_flag = match footprints_m2 {
        None => 0,
        Some(footprints) => {
            count_of(descriptors, footprints.len(), "7058 footprints");
            HAS_FOOTPRINTS
        }
    };
    let open = OpenRecord::begin(buf, record_id::SNIPPET_STRENGTHS, stamp);
    write_layout(
        &Rth7058 {
            detections,
            control_flags: rth.control_flags & !HAS_FOOTPRINTS | footprint_flag,
            ..*rth
        },
        buf,
    );
    descriptors.iter().for_each(|d| write_layout(d, buf));
    extend_encoded(buf, strengths_db, f32::to_le_bytes);
    if let Some(footprints) = footprints_m2 {
        extend_encoded(buf, footprints, f32::to_le_bytes);
    }
    open.finish(buf)
}

impl fmt::Display for Snippets7028<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "snippets: ping {} of sonar {}, {} snippets, {} B of samples",
            self.rth.ping_number,
            self.rth.sonar_id,
            self.rth.detections,
            self.snippets.data.len()
        )
    }
}

impl fmt::Display for SnippetStrengths7058<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "snippet strengths: ping {} of sonar {}, {} snippets, {} B of samples",
            self.rth.ping_number,
            self.rth.sonar_id,
            self.rth.detections,
            self.snippets.data.len()
        )
    }
}
