//! Record 7038 (raw I and Q, draft) of the receive elements. Source: `_DataRecord7038` of the MIT licensed pyread7k. DFD 3.12 lists
//! only the number.
//!
//! ```text
//! RTH   60 bytes, see Rth7038
//! RD    u16 element_number[E], then sample-major: for each sample start..=stop, for each listed element, i16 I, i16 Q
//! ```
//!
//! Teledyne's reader uses an element number as a column of an array with E columns. The elements of a record must therefore be
//! numbered 0..E.

use std::fmt;
use std::ops::Range;

use binrw::{BinRead, BinWrite};

use super::{data_at, rth};
use crate::sevenk::frame::{
    Layout, OpenRecord, RecordStamp, extend_encoded, extend_transposed, read_fixed, u16_at,
    write_layout,
};
use crate::sevenk::{WireError, record_id};

/// `sample_type` of i16 I and Q, the only supported type.
pub const SAMPLE_TYPE_I16: u16 = 16;

const SAMPLE_BYTES: usize = 4;

/// Record type header of record 7038 (raw I and Q).
#[derive(Debug, Clone, Copy, PartialEq, Eq, BinRead, BinWrite)]
pub struct Rth7038 {
    /// Serial number of the sonar.
    pub sonar_serial: u64,
    /// Ping number, sequential from 1.
    #[brw(pad_after = 2)]
    pub ping_number: u32,
    /// Number of receive elements of the system.
    pub channel_count: u16,
    /// Number of samples in the ping.
    pub samples: u32,
    /// Number of elements in this record.
    pub elements: u16,
    /// First sample in the record.
    pub start_sample: u32,
    /// Last sample in the record, inclusive.
    pub stop_sample: u32,
    /// Number type of the samples: [`SAMPLE_TYPE_I16`].
    #[brw(pad_after = 28)]
    pub sample_type: u16,
}

rth!(Rth7038, 60, "7038 raw I/Q");

impl Rth7038 {
    /// Number of samples per element in this record; 0 if stop is before start.
    pub fn samples_present(&self) -> u64 {
        (u64::from(self.stop_sample) + 1).saturating_sub(u64::from(self.start_sample))
    }
}

/// Parsed record 7038 (raw I and Q) that borrows its samples.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RawIq7038<'a> {
    /// Record type header.
    pub rth: Rth7038,
    element_numbers: &'a [u8],
    iq: &'a [u8],
}

impl<'a> RawIq7038<'a> {
    /// Parses the body of the record. Returns an error if the body is too short or has an unsupported value.
    pub fn parse(body: &'a [u8]) -> Result<Self, WireError> {
        let rth: Rth7038 = read_fixed(body)?;
        if rth.sample_type != SAMPLE_TYPE_I16 {
            return Err(WireError::unsupported("7038 sample type", rth.sample_type));
        }
        let element_numbers = data_at(
            body,
            Rth7038::RTH_BYTES,
            2 * u64::from(rth.elements),
            "7038 element numbers",
        )?;
        let iq_len = rth.samples_present() * u64::from(rth.elements) * SAMPLE_BYTES as u64;
        let iq = data_at(
            body,
            Rth7038::RTH_BYTES + element_numbers.len(),
            iq_len,
            "7038 samples",
        )?;
        Ok(Self {
            rth,
            element_numbers,
            iq,
        })
    }

    /// Iterates over the element numbers of the columns.
    pub fn element_numbers(&self) -> impl ExactSizeIterator<Item = u16> + 'a {
        self.element_numbers
            .chunks_exact(2)
            .map(|bytes| u16::from_le_bytes([bytes[0], bytes[1]]))
    }

    /// I and Q of a sample, counted from `start_sample`, in a column of the record; `None` outside the record.
    pub fn iq(&self, sample_from_start: u32, column: u16) -> Option<[i16; 2]> {
        if u64::from(sample_from_start) >= self.rth.samples_present() || column >= self.rth.elements
        {
            return None;
        }
        let at = (sample_from_start as usize * usize::from(self.rth.elements)
            + usize::from(column))
            * SAMPLE_BYTES;
        Some([u16_at(self.iq, at)? as i16, u16_at(self.iq, at + 2)? as i16])
    }

    /// All I and Q in record order: by sample, then by element.
    pub fn iq_sample_major(&self) -> impl ExactSizeIterator<Item = [i16; 2]> + 'a {
        self.iq.chunks_exact(SAMPLE_BYTES).map(|bytes| {
            [
                i16::from_le_bytes([bytes[0], bytes[1]]),
                i16::from_le_bytes([bytes[2], bytes[3]]),
            ]
        })
    }
}

fn iq_bytes([i, q]: [i16; 2]) -> [u8; SAMPLE_BYTES] {
    let ([i0, i1], [q0, q1]) = (i.to_le_bytes(), q.to_le_bytes());
    [i0, i1, q0, q1]
}

/// Appends a record 7038 (raw I and Q) from I/Q ordered by sample, then by element: the fast path.
///
/// # Panics
/// If `rth.elements` differs from the number of element numbers, the sample type is not [`SAMPLE_TYPE_I16`], `stop_sample` is before
/// `start_sample`, or the number of I/Q pairs is not samples x elements.
pub fn emit_7038(
    buf: &mut Vec<u8>,
    stamp: &RecordStamp,
    rth: &Rth7038,
    element_numbers: &[u16],
    iq_sample_major: &[[i16; 2]],
) -> Range<usize> {
    let open = begin_7038(buf, stamp, rth, element_numbers, iq_sample_major.len());
    extend_encoded(buf, iq_sample_major, iq_bytes);
    open.finish(buf)
}

/// Appends a record 7038 (raw I and Q) from I/Q ordered by element, then by sample, and transposes them.
///
/// # Panics
/// As [`emit_7038`].
pub fn emit_7038_element_major(
    buf: &mut Vec<u8>,
    stamp: &RecordStamp,
    rth: &Rth7038,
    element_numbers: &[u16],
    iq_element_major: &[[i16; 2]],
) -> Range<usize> {
    let open = begin_7038(buf, stamp, rth, element_numbers, iq_element_major.len());
    extend_transposed(buf, iq_element_major, element_numbers.len(), iq_bytes);
    open.finish(buf)
}

fn begin_7038(
    buf: &mut Vec<u8>,
    stamp: &RecordStamp,
    rth: &Rth7038,
    element_numbers: &[u16],
    pairs: usize,
) -> OpenRecord {
    assert_eq!(
        rth.sample_type, SAMPLE_TYPE_I16,
        "7038 is written with sample type {SAMPLE_TYPE_I16} only"
    );
    assert_eq!(
        usize::from(rth.elements),
        element_numbers.len(),
        "7038 needs a number for every element"
    );
    assert!(
        rth.start_sample <= rth.stop_sample,
        "7038 of samples {}..={}",
        rth.start_sample,
        rth.stop_sample
    );
    let expected = rth.samples_present() as usize * element_numbers.len();
    assert_eq!(
        pairs,
        expected,
        "7038 of {} samples x {} elements",
        rth.samples_present(),
        rth.elements
    );
    let open = OpenRecord::begin(buf, record_id::RAW_IQ, stamp);
    buf.reserve(Rth7038::SIZE_BYTES + 2 * element_numbers.len() + pairs * SAMPLE_BYTES + 4);
    write_layout(rth, buf);
    extend_encoded(buf, element_numbers, u16::to_le_bytes);
    open
}

impl fmt::Display for RawIq7038<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "raw I/Q (draft): ping {} of sonar {}, {} of {} elements, samples {}..={} of {}, i16",
            self.rth.ping_number,
            self.rth.sonar_serial,
            self.rth.elements,
            self.rth.channel_count,
            self.rth.start_sample,
            self.rth.stop_sample,
            self.rth.samples
        )
    }
}
