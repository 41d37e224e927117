//! Record 1016 (attitude): several readings of a motion sensor. Source: DFD 3.12, tables 33 and 34.
//!
//! ```text
//! RTH   0 u8 data sets N                                                                1 byte
//! RD    N times: u16 milliseconds after the record's time, f32 roll, pitch, heave, heading   18 bytes each
//! ```

use std::fmt;
use std::ops::Range;

use binrw::{BinRead, BinWrite};

use super::{data_at, rth};
use crate::sevenk::frame::{Layout, OpenRecord, RecordStamp, read_fixed, write_layout};
use crate::sevenk::{WireError, record_id};

/// Reading of a record 1016 (attitude).
#[derive(Debug, Clone, Copy, PartialEq, Default, BinRead, BinWrite)]
pub struct AttitudeSet {
    /// Time after the record's timestamp.
    pub after_ms: u16,
    /// Roll, positive port up.
    pub roll_rad: f32,
    /// Pitch, positive bow up.
    pub pitch_rad: f32,
    /// Heave, positive up.
    pub heave_up_m: f32,
    /// Heading, clockwise from true north.
    pub heading_rad: f32,
}

rth!(AttitudeSet, 18, "1016 attitude");

/// Parsed record 1016 (attitude) that borrows its readings.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Attitude1016<'a> {
    sets: &'a [u8],
}

impl<'a> Attitude1016<'a> {
    /// Size of the record type header, bytes.
    pub const RTH_BYTES: usize = 1;

    /// Parses the body of the record. Returns an error if the body is too short.
    pub fn parse(body: &'a [u8]) -> Result<Self, WireError> {
        let count = data_at(body, 0, 1, "1016 attitude")?[0];
        let len = u64::from(count) * AttitudeSet::SIZE_BYTES as u64;
        Ok(Self {
            sets: data_at(body, Self::RTH_BYTES, len, "1016 attitude")?,
        })
    }

    /// Iterates over the readings.
    pub fn sets(&self) -> impl Iterator<Item = AttitudeSet> + 'a {
        self.sets
            .chunks_exact(AttitudeSet::SIZE_BYTES)
            .filter_map(|bytes| read_fixed(bytes).ok())
    }
}

/// Appends a record 1016 (attitude).
///
/// # Panics
/// If there are more than 255 readings.
pub fn emit_1016(buf: &mut Vec<u8>, stamp: &RecordStamp, sets: &[AttitudeSet]) -> Range<usize> {
    let count = u8::try_from(sets.len()).expect("1016 holds at most 255 readings");
    let open = OpenRecord::begin(buf, record_id::ATTITUDE, stamp);
    buf.push(count);
    sets.iter().for_each(|set| write_layout(set, buf));
    open.finish(buf)
}

impl fmt::Display for Attitude1016<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let count = self.sets.len() / AttitudeSet::SIZE_BYTES;
        write!(f, "attitude: {count} readings")?;
        match self.sets().next() {
            Some(first) => write!(f, ", the first {first:?}"),
            None => Ok(()),
        }
    }
}
