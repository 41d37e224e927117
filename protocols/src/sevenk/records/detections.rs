//! 7027: raw detections, what the bottom detector found. Source: DFD 3.12, tables 72 to 74.
//!
//! ```text
//! RTH   99 bytes, see Rth7027
//! RD    detections x data_field_size bytes; the first 34 of each are Detection7027, later versions append
//! ```

use std::fmt;
use std::ops::Range;

use binrw::{BinRead, BinWrite};

use super::{data_at, rth};
use crate::sevenk::frame::{Fixed, OpenRecord, RecordStamp, read_fixed, write_fixed};
use crate::sevenk::{WireError, record_id};

/// The RTH of 7027.
#[derive(Debug, Clone, Copy, PartialEq, Default, BinRead, BinWrite)]
pub struct Rth7027 {
    /// Serial number.
    pub sonar_id: u64,
    pub ping_number: u32,
    /// 0 when not in multi-ping mode.
    pub multi_ping_sequence: u16,
    /// Written from the slice.
    pub detections: u32,
    /// Bytes of each detection; written 34.
    pub data_field_size: u32,
    /// 0 G1 simple, 1 G1 blended, 2 G2, 3 G3, ...
    pub detection_algorithm: u8,
    /// Bits 0-3 method of the uncertainty, 4 multi-detection, 6 detections have the snippet flag.
    pub flags: u32,
    pub sampling_rate_hz: f32,
    pub tx_angle_rad: f32,
    /// Put to the gates; 0 where roll is stabilised.
    #[brw(pad_after = 60)]
    pub applied_roll_rad: f32,
}

rth!(Rth7027, 99, "7027 raw detections");

/// One detection.
#[derive(Debug, Clone, Copy, PartialEq, Default, BinRead, BinWrite)]
pub struct Detection7027 {
    pub beam: u16,
    /// Sample of the two-way time, fractional; sample 0 is the transmission.
    pub detection_sample: f32,
    /// In the sonar's frame, starboard positive.
    pub rx_angle_rad: f32,
    /// Bit 0 by magnitude, 1 by phase, 2-8 type of the quality, 9-12 priority within the beam, 14 not used in a snippet.
    pub flags: u32,
    /// Type 1: bit 0 brightness, bit 1 colinearity passed.
    pub quality: u32,
    /// Of the detection sample, relative.
    pub uncertainty: f32,
    pub intensity: f32,
    /// Of the gate, in samples.
    pub min_limit_sample: f32,
    pub max_limit_sample: f32,
}

rth!(Detection7027, 34, "7027 detection");

/// 7027, read: the detections stay in the body.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RawDetections7027<'a> {
    pub rth: Rth7027,
    data: &'a [u8],
}

impl<'a> RawDetections7027<'a> {
    pub const RECORD_TYPE_ID: u32 = record_id::RAW_DETECTIONS;
    pub const RTH_BYTES: usize = Rth7027::RTH_BYTES;

    /// Reads detections of 34 bytes or more; fields beyond those known are passed over.
    pub fn parse(body: &'a [u8]) -> Result<Self, WireError> {
        let rth: Rth7027 = read_fixed(body)?;
        if rth.data_field_size < Detection7027::SIZE_BYTES as u32 {
            return Err(WireError::Unsupported {
                what: "7027 data field size",
                got: u64::from(rth.data_field_size),
            });
        }
        // Below 2^64: a product of two 32-bit numbers.
        let len = u64::from(rth.detections) * u64::from(rth.data_field_size);
        let data = data_at(body, Rth7027::RTH_BYTES, len, "7027 detections")?;
        Ok(Self { rth, data })
    }

    pub fn detections(&self) -> impl Iterator<Item = Detection7027> + 'a {
        self.data
            .chunks_exact(self.rth.data_field_size as usize)
            .filter_map(|bytes| read_fixed(bytes).ok())
    }
}

/// Appends a 7027 record. `detections` and `data_field_size` of `rth` are not used.
pub fn emit_7027(
    buf: &mut Vec<u8>,
    stamp: &RecordStamp,
    rth: &Rth7027,
    detections: &[Detection7027],
) -> Range<usize> {
    let open = OpenRecord::begin(buf, record_id::RAW_DETECTIONS, stamp);
    buf.reserve(Rth7027::SIZE_BYTES + detections.len() * Detection7027::SIZE_BYTES + 4);
    write_fixed(
        &Rth7027 {
            detections: detections.len() as u32,
            data_field_size: Detection7027::SIZE_BYTES as u32,
            ..*rth
        },
        buf,
    );
    detections
        .iter()
        .for_each(|detection| write_fixed(detection, buf));
    open.finish(buf)
}

impl fmt::Display for RawDetections7027<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "raw detections: ping {} of sonar {}, {} detections at {} Hz",
            self.rth.ping_number, self.rth.sonar_id, self.rth.detections, self.rth.sampling_rate_hz
        )
    }
}
