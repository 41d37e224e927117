//! Record 7007 (side-scan): one line of port and starboard. Source: DFD 3.12.
//!
//! ```text
//! RTH   64 bytes, see Rth7007
//! RD    samples_per_side port samples, then as many starboard; unsigned, 1, 2 or 4 bytes; the first is range 0
//! ```

use std::fmt;
use std::ops::Range;

use binrw::{BinRead, BinWrite};

use super::{data_at, rth};
use crate::sevenk::frame::{
    Layout, OpenRecord, RecordStamp, extend_encoded, read_fixed, write_layout,
};
use crate::sevenk::{WireError, record_id};

/// Record type header of record 7007 (side-scan).
#[derive(Debug, Clone, Copy, PartialEq, Default, BinRead, BinWrite)]
pub struct Rth7007 {
    /// Serial number of the sonar.
    pub sonar_id: u64,
    /// Ping number, sequential from 1.
    pub ping_number: u32,
    /// Sequence number in multi-ping mode; 0 in other modes.
    pub multi_ping_sequence: u16,
    /// Distance forward of beam 0.
    pub beam_position_m: f32,
    /// Bit 0: the nadir depth field is used.
    pub control_flags: u32,
    /// Number of samples per side, set from the slices.
    pub samples_per_side: u32,
    /// Depth below the sonar, one-way samples.
    #[brw(pad_after = 28)]
    pub nadir_depth_samples: u32,
    /// Number of beams per side; 1 in emitted records.
    pub beams_per_side: u16,
    /// Index of the beam.
    pub current_beam: u16,
    /// Size of a sample, 1, 2 or 4 bytes, set from the slices.
    pub bytes_per_sample: u8,
    /// Data types; always 0.
    pub data_types: u8,
}

rth!(Rth7007, 64, "7007 side scan");

/// Both sides of a line, with the sample width of the record.
#[derive(Debug, Clone, Copy)]
pub enum SideSamples<'a> {
    /// 8 bits per sample.
    U8 {
        /// Port samples from range 0.
        port: &'a [u8],
        /// Starboard samples from range 0.
        starboard: &'a [u8],
    },
    /// 16 bits per sample.
    U16 {
        /// Port samples from range 0.
        port: &'a [u16],
        /// Starboard samples from range 0.
        starboard: &'a [u16],
    },
    /// 32 bits per sample.
    U32 {
        /// Port samples from range 0.
        port: &'a [u32],
        /// Starboard samples from range 0.
        starboard: &'a [u32],
    },
}

/// Parsed record 7007 (side-scan) that borrows its samples.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SideScan7007<'a> {
    /// Record type header.
    pub rth: Rth7007,
    port: &'a [u8],
    starboard: &'a [u8],
}

impl<'a> SideScan7007<'a> {
    /// Parses the body of the record. Returns an error if the body is too short or has an unsupported value.
    pub fn parse(body: &'a [u8]) -> Result<Self, WireError> {
        let rth: Rth7007 = read_fixed(body)?;
        if !matches!(rth.bytes_per_sample, 1 | 2 | 4) {
            return Err(WireError::unsupported(
                "7007 bytes per sample",
                rth.bytes_per_sample,
            ));
        }
        let side_bytes = u64::from(rth.samples_per_side) * u64::from(rth.bytes_per_sample);
        let data = data_at(body, Rth7007::RTH_BYTES, 2 * side_bytes, "7007 samples")?;
        let (port, starboard) = data.split_at(side_bytes as usize);
        Ok(Self {
            rth,
            port,
            starboard,
        })
    }

    /// Iterates over the port samples as u32; the first is range 0.
    pub fn port(&self) -> impl ExactSizeIterator<Item = u32> + 'a {
        samples_of(self.port, self.rth.bytes_per_sample)
    }

    /// Iterates over the starboard samples as u32; the first is range 0.
    pub fn starboard(&self) -> impl ExactSizeIterator<Item = u32> + 'a {
        samples_of(self.starboard, self.rth.bytes_per_sample)
    }
}

fn samples_of(bytes: &[u8], bytes_per_sample: u8) -> impl ExactSizeIterator<Item = u32> + '_ {
    bytes
        .chunks_exact(usize::from(bytes_per_sample))
        .map(|sample| {
            let mut wide = [0; 4];
            wide[..sample.len()].copy_from_slice(sample);
            u32::from_le_bytes(wide)
        })
}

/// Appends a record 7007 (side-scan). `samples_per_side` and `bytes_per_sample` of `rth` are ignored and follow from the slices.
/// `beams_per_side` is 1.
///
/// # Panics
/// If the sides differ in length.
pub fn emit_7007(
    buf: &mut Vec<u8>,
    stamp: &RecordStamp,
    rth: &Rth7007,
    samples: &SideSamples<'_>,
) -> Range<usize> {
    let (port_len, starboard_len, bytes_per_sample) = match samples {
        SideSamples::U8 { port, starboard } => (port.len(), starboard.len(), 1),
        SideSamples::U16 { port, starboard } => (port.len(), starboard.len(), 2),
        SideSamples::U32 { port, starboard } => (port.len(), starboard.len(), 4),
    };
    assert_eq!(
        port_len, starboard_len,
        "7007 has as many port samples as starboard"
    );
    let open = OpenRecord::begin(buf, record_id::SIDE_SCAN, stamp);
    buf.reserve(Rth7007::SIZE_BYTES + 2 * port_len * usize::from(bytes_per_sample));
    write_layout(
        &Rth7007 {
            samples_per_side: port_len as u32,
            bytes_per_sample,
            beams_per_side: 1,
            ..*rth
        },
        buf,
    );
    match samples {
        SideSamples::U8 { port, starboard } => {
            buf.extend_from_slice(port);
            buf.extend_from_slice(starboard);
        }
        SideSamples::U16 { port, starboard } => {
            extend_encoded(buf, port, u16::to_le_bytes);
            extend_encoded(buf, starboard, u16::to_le_bytes);
        }
        SideSamples::U32 { port, starboard } => {
            extend_encoded(buf, port, u32::to_le_bytes);
            extend_encoded(buf, starboard, u32::to_le_bytes);
        }
    }
    open.finish(buf)
}

impl fmt::Display for SideScan7007<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "side scan: ping {} of sonar {}, {} samples of {} B per side",
            self.rth.ping_number,
            self.rth.sonar_id,
            self.rth.samples_per_side,
            self.rth.bytes_per_sample
        )
    }
}
