//! Record 1009 (sound velocity profile): sound velocity over depth. Source: DFD 3.12, tables 23 and 24.
//!
//! ```text
//! RTH   0 u8 position valid   1 u8, u16 reserved   4 f64 latitude   12 f64 longitude   20 u32 samples N   24 bytes
//! RD    N times: f32 depth, f32 sound velocity                                                             8 bytes each
//! ```

use std::fmt;
use std::ops::Range;

use binrw::{BinRead, BinWrite};

use super::{data_at, rth};
use crate::sevenk::frame::{Layout, OpenRecord, RecordStamp, read_fixed, write_layout};
use crate::sevenk::{WireError, record_id};

/// Record type header of record 1009 (sound velocity profile).
#[derive(Debug, Clone, Copy, PartialEq, Default, BinRead, BinWrite)]
pub struct Rth1009 {
    /// 1 if the position is valid.
    #[brw(pad_after = 3)]
    pub position_flag: u8,
    /// WGS84 latitude, positive north.
    pub latitude_rad: f64,
    /// WGS84 longitude, positive east.
    pub longitude_rad: f64,
    /// Number of samples, set when the record is emitted.
    pub samples: u32,
}

/// Sample of a record 1009 (sound velocity profile).
#[derive(Debug, Clone, Copy, PartialEq, Default, BinRead, BinWrite)]
pub struct VelocityAtDepth {
    /// Depth, positive down.
    pub depth_m: f32,
    /// Sound velocity.
    pub sound_velocity_m_per_s: f32,
}

rth!(Rth1009, 24, "1009 sound velocity profile");

rth!(VelocityAtDepth, 8, "1009 sound velocity profile");

/// Parsed record 1009 (sound velocity profile) that borrows its samples.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SoundVelocityProfile1009<'a> {
    /// Position of the profile.
    pub rth: Rth1009,
    samples: &'a [u8],
}

impl<'a> SoundVelocityProfile1009<'a> {
    /// Parses the body of the record. Returns an error if the body is too short.
    pub fn parse(body: &'a [u8]) -> Result<Self, WireError> {
        let rth: Rth1009 = read_fixed(body)?;
        let len = u64::from(rth.samples) * VelocityAtDepth::SIZE_BYTES as u64;
        Ok(Self {
            rth,
            samples: data_at(body, Rth1009::RTH_BYTES, len, Rth1009::NAME)?,
        })
    }

    /// Iterates over the samples.
    pub fn samples(&self) -> impl Iterator<Item = VelocityAtDepth> + 'a {
        self.samples
            .chunks_exact(VelocityAtDepth::SIZE_BYTES)
            .filter_map(|bytes| read_fixed(bytes).ok())
    }
}

/// Appends a record 1009 (sound velocity profile) and returns its byte range.
pub fn emit_1009(
    buf: &mut Vec<u8>,
    stamp: &RecordStamp,
    rth: &Rth1009,
    samples: &[VelocityAtDepth],
) -> Range<usize> {
    let open = OpenRecord::begin(buf, record_id::SOUND_VELOCITY_PROFILE, stamp);
    let rth = Rth1009 {
        samples: samples.len() as u32,
        ..*rth
    };
    write_layout(&rth, buf);
    samples.iter().for_each(|sample| write_layout(sample, buf));
    open.finish(buf)
}

impl fmt::Display for SoundVelocityProfile1009<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "sound velocity profile: {} samples", self.rth.samples)?;
        match self.samples().next() {
            Some(first) => write!(
                f,
                ", the first {:.2} m/s at {:.2} m",
                first.sound_velocity_m_per_s, first.depth_m
            ),
            None => Ok(()),
        }
    }
}
