//! Record 7004 (beam geometry): directions and widths of the beams. Source: DFD 3.12.
//!
//! ```text
//! RTH   0 u64 sonar_id   8 u32 beams N                                          12 bytes
//! RD    N f32 each: along-track angle, across-track angle, -3 dB width along track (Y), -3 dB width across track (X)
//! ```

use std::fmt;
use std::ops::Range;

use binrw::{BinRead, BinWrite};

use super::{data_at, rth};
use crate::sevenk::frame::{
    OpenRecord, RecordStamp, extend_encoded, read_fixed, u32_at, write_layout,
};
use crate::sevenk::{WireError, record_id};

#[derive(Debug, Clone, Copy, BinRead, BinWrite)]
struct Rth7004 {
    sonar_id: u64,
    beams: u32,
}

rth!(Rth7004, 12, "7004 beam geometry");

/// Angles of all beams, from port; four slices of equal length.
#[derive(Debug, Clone, Copy)]
pub struct BeamAngles<'a> {
    /// Direction along track, positive forward.
    pub along_track_rad: &'a [f32],
    /// Direction across track, positive to starboard.
    pub across_track_rad: &'a [f32],
    /// Along-track width, -3 dB.
    pub width_y_rad: &'a [f32],
    /// Across-track width, -3 dB.
    pub width_x_rad: &'a [f32],
}

/// Parsed record 7004 (beam geometry) that borrows its angles.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BeamGeometry7004<'a> {
    /// Serial number of the sonar.
    pub sonar_id: u64,
    /// Number of beams.
    pub beams: u32,
    data: &'a [u8],
}

impl<'a> BeamGeometry7004<'a> {
    /// Size of the record type header, bytes.
    pub const RTH_BYTES: usize = Rth7004::RTH_BYTES;

    /// Parses the body of the record. Returns an error if the body is too short.
    pub fn parse(body: &'a [u8]) -> Result<Self, WireError> {
        let rth: Rth7004 = read_fixed(body)?;
        let data = data_at(
            body,
            Rth7004::RTH_BYTES,
            16 * u64::from(rth.beams),
            "7004 beam angles",
        )?;
        Ok(Self {
            sonar_id: rth.sonar_id,
            beams: rth.beams,
            data,
        })
    }

    /// Direction along track, positive forward.
    pub fn along_track_rad(&self, beam: u32) -> Option<f32> {
        self.value(0, beam)
    }

    /// Direction across track, positive to starboard.
    pub fn across_track_rad(&self, beam: u32) -> Option<f32> {
        self.value(1, beam)
    }

    /// Along-track width, -3 dB.
    pub fn width_y_rad(&self, beam: u32) -> Option<f32> {
        self.value(2, beam)
    }

    /// Across-track width, -3 dB.
    pub fn width_x_rad(&self, beam: u32) -> Option<f32> {
        self.value(3, beam)
    }

    fn value(&self, block: usize, beam: u32) -> Option<f32> {
        if beam >= self.beams {
            return None;
        }
        u32_at(self.data, (block * self.beams as usize + beam as usize) * 4).map(f32::from_bits)
    }
}

/// Appends a record 7004 (beam geometry).
///
/// # Panics
/// If the slices differ in length.
pub fn emit_7004(
    buf: &mut Vec<u8>,
    stamp: &RecordStamp,
    sonar_id: u64,
    angles: &BeamAngles<'_>,
) -> Range<usize> {
    let blocks = [
        angles.along_track_rad,
        angles.across_track_rad,
        angles.width_y_rad,
        angles.width_x_rad,
    ];
    let beams = blocks[0].len();
    let open = OpenRecord::begin(buf, record_id::BEAM_GEOMETRY, stamp);
    write_layout(
        &Rth7004 {
            sonar_id,
            beams: beams as u32,
        },
        buf,
    );
    for block in blocks {
        assert_eq!(block.len(), beams, "7004 needs every angle of every beam");
        extend_encoded(buf, block, f32::to_le_bytes);
    }
    open.finish(buf)
}

impl fmt::Display for BeamGeometry7004<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "beam geometry: {} beams of sonar {}",
            self.beams, self.sonar_id
        )?;
        let ends = (
            self.across_track_rad(0),
            self.across_track_rad(self.beams.saturating_sub(1)),
        );
        if let (Some(first), Some(last)) = ends {
            write!(
                f,
                ", across track {:.2} to {:.2} deg",
                first.to_degrees(),
                last.to_degrees()
            )?;
        }
        Ok(())
    }
}
