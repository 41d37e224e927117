//! Record 7027 (raw detections) of the bottom detector. Source: DFD 3.12, tables 72 to 74.
//!
//! ```text
//! RTH   99 bytes, see Rth7027
//! RD    detections x data_field_size bytes; the first 34 of each are Detection7027, later versions append
//! ```

use std::fmt;
use std::ops::Range;

use binrw::{BinRead, BinWrite};

use super::{data_at, rth};
use crate::sevenk::frame::{Layout, OpenRecord, RecordStamp, read_fixed, write_layout};
use crate::sevenk::{WireError, record_id};

/// Record type header of record 7027 (raw detections).
#[derive(Debug, Clone, Copy, PartialEq, Default, BinRead, BinWrite)]
pub struct Rth7027 {
    /// Serial number of the sonar.
    pub sonar_id: u64,
    /// Ping number, sequential from 1.
    pub ping_number: u32,
    /// Sequence number in multi-ping mode; 0 in other modes.
    pub multi_ping_sequence: u16,
    /// Number of detections, set from the slice.
    pub detections: u32,
    /// Size of each detection, bytes; 34 in emitted records.
    pub data_field_size: u32,
    /// Detection algorithm: 0 G1 simple, 1 G1 blended, 2 G2, 3 G3, ...
    pub detection_algorithm: u8,
    /// Bits 0-3 method of the uncertainty, 4 multi-detection, 6 detections have the snippet flag.
    pub flags: u32,
    /// Sample rate of the sample numbers.
    pub sampling_rate_hz: f32,
    /// Along-track angle of the transmit beam.
    pub tx_angle_rad: f32,
    /// Roll applied to the gates; 0 with roll stabilisation.
    #[brw(pad_after = 60)]
    pub applied_roll_rad: f32,
}

rth!(Rth7027, 99, "7027 raw detections");

/// Detection in a record 7027 (raw detections).
#[derive(Debug, Clone, Copy, PartialEq, Default, BinRead, BinWrite)]
pub struct Detection7027 {
    /// Index of the beam.
    pub beam: u16,
    /// Two-way time as a fractional sample number; sample 0 is the transmission.
    pub detection_sample: f32,
    /// Angle in the sonar's frame, positive to starboard.
    pub rx_angle_rad: f32,
    /// Bit 0 by magnitude, 1 by phase, 2-8 type of the quality, 9-12 priority within the beam, 14 not used in a snippet.
    pub flags: u32,
    /// Type 1: bit 0 brightness, bit 1 colinearity passed.
    pub quality: u32,
    /// Relative uncertainty of the detection sample.
    pub uncertainty: f32,
    /// Level of the echo.
    pub intensity: f32,
    /// Start of the gate, samples.
    pub min_limit_sample: f32,
    /// End of the gate, samples.
    pub max_limit_sample: f32,
}

rth!(Detection7027, 34, "7027 detection");

/// Parsed record 7027 (raw detections) that borrows its detections.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RawDetections7027<'a> {
    /// Record type header.
    pub rth: Rth7027,
    data: &'a [u8],
}

impl<'a> RawDetections7027<'a> {
    /// Parses a body with detections of 34 bytes or more; unknown fields are skipped.
    pub fn parse(body: &'a [u8]) -> Result<Self, WireError> {
        let rth: Rth7027 = read_fixed(body)?;
        if rth.data_field_size < Detection7027::SIZE_BYTES as u32 {
            return Err(WireError::unsupported(
                "7027 data field size",
                rth.data_field_size,
            ));
        }
        // The product of two 32-bit numbers is below 2^64.
        let len = u64::from(rth.detections) * u64::from(rth.data_field_size);
        let data = data_at(body, Rth7027::RTH_BYTES, len, "7027 detections")?;
        Ok(Self { rth, data })
    }

    /// Iterates over the detections.
    pub fn detections(&self) -> impl Iterator<Item = Detection7027> + 'a {
        self.data
            .chunks_exact(self.rth.data_field_size as usize)
            .filter_map(|bytes| read_fixed(bytes).ok())
    }
}

/// Appends a record 7027 (raw detections). `detections` and `data_field_size` of `rth` are ignored.
pub fn emit_7027(
    buf: &mut Vec<u8>,
    stamp: &RecordStamp,
    rth: &Rth7027,
    detections: &[Detection7027],
) -> Range<usize> {
    let open = OpenRecord::begin(buf, record_id::RAW_DETECTIONS, stamp);
    buf.reserve(Rth7027::SIZE_BYTES + detections.len() * Detection7027::SIZE_BYTES + 4);
    write_layout(
        &Rth7027 {
            detections: detections.len() as u32,
            data_field_size: Detection7027::SIZE_BYTES as u32,
            ..*rth
        },
        buf,
    );
    detections
        .iter()
        .for_each(|detection| write_layout(detection, buf));
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
