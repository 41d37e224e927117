//! Frames of 7k, the record between them, and the checksum. Source: DFD 3.12.
//!
//! ```text
//! network frame (36)                                only on the network, before every packet
//! data record frame (64) | RTH | RD | OD | checksum (u32)
//! ```
//!
//! `offset` of the data record frame counts from the sync pattern (byte 4) to the record type header (byte 64), so it is 60. A
//! widely used client writes 64. The header is at byte 64 in both cases, and both values are accepted.

use std::fmt;
use std::ops::Range;

use binrw::{BinRead, BinWrite};

pub(crate) use crate::layout::{Layout, write_layout};
use crate::layout::{layout_of, read_layout};

use super::{PROTOCOL_VERSION, SevenKTime, WireError};

/// Size of the network frame.
pub const NETWORK_FRAME_BYTES: usize = 36;
/// Size of the data record frame.
pub const DATA_RECORD_FRAME_BYTES: usize = 64;
/// Size of the checksum.
pub const CHECKSUM_BYTES: usize = 4;
/// Size of a record without RTH and data.
pub const MIN_RECORD_BYTES: usize = DATA_RECORD_FRAME_BYTES + CHECKSUM_BYTES;
/// Value of the sync pattern.
pub const SYNC_PATTERN: u32 = 0x0000_FFFF;
/// Offset from the sync pattern to the RTH.
pub const RECORD_OFFSET: u16 = 60;
/// Offset that a widely used client (MBARI's) writes instead.
pub const RECORD_OFFSET_FROM_START: u16 = 64;

/// Bits of [`DataRecordFrame::flags`].
pub mod frame_flags {
    /// The checksum is valid.
    pub const CHECKSUM_VALID: u16 = 1;
    /// The record comes from a file.
    pub const RECORDED_DATA: u16 = 1 << 15;
}

const SIZE_AT: usize = 8;
const OPTIONAL_DATA_OFFSET_AT: usize = 12;
const OPTIONAL_DATA_ID_AT: usize = 16;

/// Parses a fixed layout at the front of `bytes`.
pub(crate) fn read_fixed<T: Layout>(bytes: &[u8]) -> Result<T, WireError> {
    let truncated = WireError::truncated(T::NAME, T::SIZE_BYTES as u64, bytes.len());
    read_layout(bytes).map_err(|_| truncated)
}

/// Appends numbers as bytes in blocks that stay in the cache. This avoids zeroing `buf` and growing it for each number.
pub fn extend_encoded<T: Copy, const N: usize>(
    buf: &mut Vec<u8>,
    values: &[T],
    encode: impl Fn(T) -> [u8; N],
) {
    const BLOCK: usize = 256;
    buf.reserve(values.len() * N);
    let mut block = [[0_u8; N]; BLOCK];
    for chunk in values.chunks(BLOCK) {
        for (bytes, &value) in block.iter_mut().zip(chunk) {
            *bytes = encode(value);
        }
        buf.extend_from_slice(block[..chunk.len()].as_flattened());
    }
}

/// Appends numbers that are stored row by row as bytes, column by column. Every row has `values.len() / rows` numbers.
pub(crate) fn extend_transposed<T: Copy, const N: usize>(
    buf: &mut Vec<u8>,
    values: &[T],
    rows: usize,
    encode: impl Fn(T) -> [u8; N],
) {
    /// Rows of a tile: a cache line of output at four bytes a number.
    const ROWS: usize = 16;
    /// Columns of a tile: its input and output fit the first-level cache.
    const COLUMNS: usize = 64;
    if rows == 0 {
        return;
    }
    let columns = values.len() / rows;
    let start = buf.len();
    buf.resize(start + columns * rows * N, 0);
    let (out, _) = buf[start..].as_chunks_mut::<N>();
    for first_row in (0..rows).step_by(ROWS) {
        let count = ROWS.min(rows - first_row);
        for first in (0..columns).step_by(COLUMNS) {
            let width = COLUMNS.min(columns - first);
            let tile: [&[T]; ROWS] = std::array::from_fn(|r| match r < count {
                true => &values[(first_row + r) * columns + first..][..width],
                false => &[],
            });
            let lines = out[first * rows + first_row..].chunks_mut(rows);
            for (k, line) in lines.take(width).enumerate() {
                if count == ROWS {
                    for (bytes, row) in line[..ROWS].iter_mut().zip(tile) {
                        *bytes = encode(row[k]);
                    }
                } else {
                    for (bytes, row) in line.iter_mut().zip(&tile[..count]) {
                        *bytes = encode(row[k]);
                    }
                }
            }
        }
    }
}

/// Sum of all bytes, modulo 2^32.
pub fn checksum(bytes: &[u8]) -> u32 {
    /// Every second byte of a word.
    const EVEN: u64 = 0x00FF_00FF_00FF_00FF;
    let (words, rest) = bytes.as_chunks::<8>();
    let mut sum = rest.iter().map(|&b| u32::from(b)).sum::<u32>();
    // Four sums of 16 bits a word, each of at most 128 x 2 x 255, do not overflow.
    for block in words.chunks(128) {
        let mut lanes = 0;
        for word in block {
            let word = u64::from_le_bytes(*word);
            lanes += (word & EVEN) + (word >> 8 & EVEN);
        }
        let sums = [lanes, lanes >> 16, lanes >> 32, lanes >> 48];
        for lane in sums {
            sum = sum.wrapping_add((lane & 0xFFFF) as u32);
        }
    }
    sum
}

pub(crate) fn u16_at(bytes: &[u8], at: usize) -> Option<u16> {
    Some(u16::from_le_bytes(bytes.get(at..)?.first_chunk().copied()?))
}

pub(crate) fn u32_at(bytes: &[u8], at: usize) -> Option<u32> {
    Some(u32::from_le_bytes(bytes.get(at..)?.first_chunk().copied()?))
}

// ---------------------------------------------------------------------------------------------------------------------- network frame

/// Header of every packet on the network.
#[derive(Debug, Clone, Copy, PartialEq, Eq, BinRead, BinWrite)]
pub struct NetworkFrame {
    /// Version of the protocol; always 5.
    pub protocol_version: u16,
    /// Bytes from the start of the packet to its data: 36.
    pub offset_bytes: u16,
    /// Number of packets of this record.
    pub total_packets: u32,
    /// Number of records; always 1.
    pub total_records: u16,
    /// Number of the transmission. It is equal for all packets of a record; consecutive records differ.
    pub transmission_id: u16,
    /// Size of this packet including this header.
    pub packet_size_bytes: u32,
    /// Size of the record without network frames.
    pub total_size_bytes: u32,
    /// Index of this packet, 0 to `total_packets` - 1.
    pub sequence_number: u32,
    /// Device identifier of the destination; 0 means unspecified.
    pub dest_device_id: u32,
    /// Enumerator of the destination.
    pub dest_enumerator: u16,
    /// Enumerator of the source.
    pub source_enumerator: u16,
    /// Device identifier of the source.
    pub source_device_id: u32,
}

layout_of!(NetworkFrame, NETWORK_FRAME_BYTES, "network frame", Little);

impl NetworkFrame {
    /// Parses the fields; [`NetworkFrame::check`] validates them.
    pub fn parse(bytes: &[u8]) -> Result<Self, WireError> {
        read_fixed(bytes)
    }

    /// Appends the frame.
    pub fn emit(&self, buf: &mut Vec<u8>) {
        write_layout(self, buf);
    }

    /// Size of the data after this header; 0 if the packet size is invalid.
    pub fn data_bytes(&self) -> u32 {
        self.packet_size_bytes
            .saturating_sub(NETWORK_FRAME_BYTES as u32)
    }

    /// Validates version, offset, a record size from 68 to `max_record_bytes`, and the consistency of sizes and numbers.
    pub fn check(&self, max_record_bytes: u32) -> Result<(), WireError> {
        if self.protocol_version != PROTOCOL_VERSION {
            return Err(WireError::NetworkVersion {
                got: self.protocol_version,
            });
        }
        if usize::from(self.offset_bytes) != NETWORK_FRAME_BYTES {
            return Err(WireError::NetworkOffset {
                got: self.offset_bytes,
            });
        }
        if self.total_size_bytes > max_record_bytes {
            return Err(WireError::Oversized {
                total_bytes: self.total_size_bytes,
                limit_bytes: max_record_bytes,
            });
        }
        self.fragment_bytes().map(|_| ())
    }

    /// Size of the data in every packet of the record except the last. These sizes are equal, so any packet gives the size and the
    /// position of its data.
    pub fn fragment_bytes(&self) -> Result<u32, WireError> {
        let inconsistent = WireError::PacketSizes {
            packet_bytes: self.packet_size_bytes,
            total_bytes: self.total_size_bytes,
            sequence_number: self.sequence_number,
            total_packets: self.total_packets,
        };
        let (total, data, packets) = (
            u64::from(self.total_size_bytes),
            u64::from(self.data_bytes()),
            u64::from(self.total_packets),
        );
        if self.sequence_number >= self.total_packets
            || data == 0
            || total < MIN_RECORD_BYTES as u64
        {
            return Err(inconsistent);
        }
        if packets == 1 {
            return if data == total {
                Ok(data as u32)
            } else {
                Err(inconsistent)
            };
        }
        let is_last = self.sequence_number + 1 == self.total_packets;
        let before_last = if is_last {
            total.checked_sub(data).ok_or(inconsistent)?
        } else {
            data.saturating_mul(packets - 1)
        };
        let fragment = before_last / (packets - 1);
        // The first packet must contain the whole data record frame, so a fragment has at least 64 bytes.
        let fits = before_last % (packets - 1) == 0
            && fragment >= DATA_RECORD_FRAME_BYTES as u64
            && before_last < total
            && total - before_last <= fragment;
        if fits {
            Ok(fragment as u32)
        } else {
            Err(inconsistent)
        }
    }
}

impl fmt::Display for NetworkFrame {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "transmission {} packet {} of {}, {} B of a record of {} B, from device {}:{} to {}:{}",
            self.transmission_id,
            self.sequence_number,
            self.total_packets,
            self.packet_size_bytes,
            self.total_size_bytes,
            self.source_device_id,
            self.source_enumerator,
            self.dest_device_id,
            self.dest_enumerator
        )
    }
}

// ------------------------------------------------------------------------------------------------------------------- data record frame

/// Header of every record.
#[derive(Debug, Clone, Copy, PartialEq, BinRead, BinWrite)]
pub struct DataRecordFrame {
    /// Version of the protocol; always 5.
    pub protocol_version: u16,
    /// Offset from the sync pattern to the RTH: 60 (some clients write 64 for the same position).
    pub offset_bytes: u16,
    /// Sync pattern, [`SYNC_PATTERN`].
    pub sync_pattern: u32,
    /// Size of the whole record including the checksum.
    pub size_bytes: u32,
    /// Offset of the optional data from the start of the record; 0 if there are none.
    pub optional_data_offset_bytes: u32,
    /// Record type that describes the optional data.
    pub optional_data_id: u32,
    /// Timestamp of the record.
    pub time: SevenKTime,
    /// Version of the record layout.
    pub record_version: u16,
    /// Record type.
    pub record_type_id: u32,
    #[brw(pad_after = 2)]
    /// Device identifier.
    pub device_id: u32,
    #[brw(pad_after = 4)]
    /// Enumerator of the system.
    pub system_enumerator: u16,
    /// Bits of [`frame_flags`].
    #[brw(pad_after = 6)]
    pub flags: u16,
    /// Number of records in a fragmented set; always 0.
    pub total_records_in_fragmented_set: u32,
    /// Index of the fragment; always 0.
    pub fragment_number: u32,
}

layout_of!(
    DataRecordFrame,
    DATA_RECORD_FRAME_BYTES,
    "data record frame",
    Little
);

impl DataRecordFrame {
    /// Parses the fields; [`DataRecordFrame::check`] validates them.
    pub fn parse(bytes: &[u8]) -> Result<Self, WireError> {
        read_fixed(bytes)
    }

    /// Appends the frame.
    pub fn emit(&self, buf: &mut Vec<u8>) {
        write_layout(self, buf);
    }

    /// Validates version, sync pattern, offset, and a size that includes frame and checksum.
    pub fn check(&self) -> Result<(), WireError> {
        if self.protocol_version != PROTOCOL_VERSION {
            return Err(WireError::DataVersion {
                got: self.protocol_version,
            });
        }
        if self.sync_pattern != SYNC_PATTERN {
            return Err(WireError::SyncPattern {
                got: self.sync_pattern,
            });
        }
        if self.offset_bytes != RECORD_OFFSET && self.offset_bytes != RECORD_OFFSET_FROM_START {
            return Err(WireError::RecordOffset {
                got: self.offset_bytes,
            });
        }
        if (self.size_bytes as usize) < MIN_RECORD_BYTES {
            return Err(WireError::RecordSize {
                stated_bytes: self.size_bytes,
                got_bytes: MIN_RECORD_BYTES as u64,
            });
        }
        Ok(())
    }

    /// True if the flags declare the checksum valid.
    pub fn has_checksum(&self) -> bool {
        self.flags & frame_flags::CHECKSUM_VALID != 0
    }
}

impl fmt::Display for DataRecordFrame {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "record {} device {}:{} at {}, {} B",
            self.record_type_id, self.device_id, self.system_enumerator, self.time, self.size_bytes
        )
    }
}

// ------------------------------------------------------------------------------------------------------------------------------ record

/// Complete record with valid frame, size and checksum.
#[derive(Debug, Clone, Copy)]
pub struct Record<'a> {
    /// Frame of the record.
    pub frame: DataRecordFrame,
    bytes: &'a [u8],
    body_end: usize,
}

impl<'a> Record<'a> {
    /// Parses a record that fills `bytes` exactly.
    pub fn parse(bytes: &'a [u8]) -> Result<Self, WireError> {
        Self::dissect(bytes).map(|(frame, body_end)| Self {
            frame,
            bytes,
            body_end,
        })
    }

    /// Validates a complete record. Returns its frame and the end of its body.
    pub(crate) fn dissect(bytes: &[u8]) -> Result<(DataRecordFrame, usize), WireError> {
        let frame = DataRecordFrame::parse(bytes)?;
        frame.check()?;
        if frame.size_bytes as usize != bytes.len() {
            return Err(WireError::RecordSize {
                stated_bytes: frame.size_bytes,
                got_bytes: bytes.len() as u64,
            });
        }
        let checksum_at = bytes.len() - CHECKSUM_BYTES;
        if frame.has_checksum() {
            let (stored, computed) = (
                u32_at(bytes, checksum_at).unwrap_or_default(),
                checksum(&bytes[..checksum_at]),
            );
            if stored != computed {
                return Err(WireError::Checksum { stored, computed });
            }
        }
        let offset = frame.optional_data_offset_bytes as usize;
        if offset == 0 {
            return Ok((frame, checksum_at));
        }
        if !(DATA_RECORD_FRAME_BYTES..=checksum_at).contains(&offset) {
            return Err(WireError::OptionalData {
                offset_bytes: frame.optional_data_offset_bytes,
                size_bytes: frame.size_bytes,
            });
        }
        Ok((frame, offset))
    }

    /// Record from the result of [`Record::dissect`] for the same bytes.
    pub(crate) fn from_checked(frame: DataRecordFrame, bytes: &'a [u8], body_end: usize) -> Self {
        Self {
            frame,
            bytes,
            body_end,
        }
    }

    /// The whole record.
    pub fn bytes(&self) -> &'a [u8] {
        self.bytes
    }

    /// Bytes of the record type header and the record data.
    pub fn body(&self) -> &'a [u8] {
        &self.bytes[DATA_RECORD_FRAME_BYTES..self.body_end]
    }

    /// Type and bytes of the optional data; `None` without optional data.
    pub fn optional_data(&self) -> Option<(u32, &'a [u8])> {
        (self.frame.optional_data_offset_bytes != 0).then(|| {
            (
                self.frame.optional_data_id,
                &self.bytes[self.body_end..self.bytes.len() - CHECKSUM_BYTES],
            )
        })
    }
}

/// Timestamp and origin of a record, for its frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RecordStamp {
    /// Timestamp: the end of the transmission for ping records.
    pub time: SevenKTime,
    /// Device identifier, one of [`device_id`](super::device_id).
    pub device_id: u32,
    /// Enumerator of the system.
    pub system_enumerator: u16,
}

/// Record under construction at the end of a buffer. Call `begin`, append record type header and data, optionally call
/// `optional_data` and append these data, then call `finish`.
#[derive(Debug)]
#[must_use = "a record without `finish` has no size and no checksum"]
pub struct OpenRecord {
    start: usize,
}

impl OpenRecord {
    /// Appends the frame.
    pub fn begin(buf: &mut Vec<u8>, record_type_id: u32, stamp: &RecordStamp) -> Self {
        let start = buf.len();
        let frame = DataRecordFrame {
            protocol_version: PROTOCOL_VERSION,
            offset_bytes: RECORD_OFFSET,
            sync_pattern: SYNC_PATTERN,
            size_bytes: 0,
            optional_data_offset_bytes: 0,
            optional_data_id: 0,
            time: stamp.time,
            record_version: 1,
            record_type_id,
            device_id: stamp.device_id,
            system_enumerator: stamp.system_enumerator,
            flags: frame_flags::CHECKSUM_VALID,
            total_records_in_fragmented_set: 0,
            fragment_number: 0,
        };
        frame.emit(buf);
        Self { start }
    }

    /// Marks the following bytes as optional data, described by record type `optional_data_id`.
    pub fn optional_data(&self, buf: &mut [u8], optional_data_id: u32) {
        let offset = record_bytes(buf.len() - self.start);
        self.patch(buf, OPTIONAL_DATA_OFFSET_AT, offset);
        self.patch(buf, OPTIONAL_DATA_ID_AT, optional_data_id);
    }

    /// Sets the size, appends the checksum, and returns the byte range of the record.
    ///
    /// # Panics
    /// If the record is 4 GiB or longer, which the configuration prevents.
    pub fn finish(self, buf: &mut Vec<u8>) -> Range<usize> {
        let size = record_bytes(buf.len() - self.start + CHECKSUM_BYTES);
        self.patch(buf, SIZE_AT, size);
        let sum = checksum(&buf[self.start..]);
        buf.extend_from_slice(&sum.to_le_bytes());
        self.start..buf.len()
    }

    fn patch(&self, buf: &mut [u8], at: usize, value: u32) {
        buf[self.start + at..][..4].copy_from_slice(&value.to_le_bytes());
    }
}

fn record_bytes(len: usize) -> u32 {
    u32::try_from(len).expect("a 7k record is shorter than 4 GiB")
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn frame(
        total_size_bytes: u32,
        packet_size_bytes: u32,
        sequence_number: u32,
        total_packets: u32,
    ) -> NetworkFrame {
        NetworkFrame {
            protocol_version: 5,
            offset_bytes: 36,
            total_packets,
            total_records: 1,
            transmission_id: 1,
            packet_size_bytes,
            total_size_bytes,
            sequence_number,
            dest_device_id: 0,
            dest_enumerator: 0,
            source_enumerator: 0,
            source_device_id: 0,
        }
    }

    #[test]
    fn any_packet_of_a_record_tells_the_fragment_size() {
        // 250 bytes in packets of 100 data bytes: 100, 100, 50.
        assert_eq!(frame(250, 136, 0, 3).fragment_bytes(), Ok(100));
        assert_eq!(frame(250, 136, 1, 3).fragment_bytes(), Ok(100));
        assert_eq!(frame(250, 86, 2, 3).fragment_bytes(), Ok(100));
        assert_eq!(frame(250, 286, 0, 1).fragment_bytes(), Ok(250));
    }

    #[test]
    fn network_frames_that_contradict_themselves_are_refused() {
        for bad in [
            frame(250, 136, 3, 3),            // sequence beyond the last
            frame(250, 136, 0, 0),            // no packets
            frame(250, 36, 0, 1),             // no data
            frame(250, 20, 0, 1),             // shorter than itself
            frame(250, 287, 0, 1),            // more data than record
            frame(250, 136, 0, 4),            // the first three would hold it all
            frame(250, 136, 2, 3), // last too long: the others would not be equal or not longer
            frame(67, 103, 0, 1),  // shorter than frame and checksum
            frame(100, 86, 0, 2),  // the first fragment would cut the data record frame
            frame(u32::MAX, u32::MAX, 0, 99), // arithmetic must not overflow
        ] {
            assert!(
                matches!(bad.check(u32::MAX), Err(WireError::PacketSizes { .. })),
                "{bad:?}"
            );
        }
        assert!(matches!(
            frame(1001, 1037, 0, 1).check(1000),
            Err(WireError::Oversized { .. })
        ));
    }

    #[test]
    fn checksum_is_the_byte_sum_modulo_2_to_the_32() {
        assert_eq!(checksum(&[]), 0);
        assert_eq!(checksum(&[255, 1, 2]), 258);
        assert_eq!(checksum(&vec![255; 200_000]), 51_000_000);
    }

    #[test]
    fn optional_data_are_parted_from_the_body() {
        let stamp = RecordStamp {
            time: SevenKTime::default(),
            device_id: 1,
            system_enumerator: 2,
        };
        let mut buf = vec![9; 7];
        let open = OpenRecord::begin(&mut buf, 7200, &stamp);
        buf.extend_from_slice(b"body");
        open.optional_data(&mut buf, 7300);
        buf.extend_from_slice(b"optional");
        let range = open.finish(&mut buf);
        assert_eq!(range, 7..buf.len());
        let record = Record::parse(&buf[range]).unwrap();
        assert_eq!(record.body(), b"body");
        assert_eq!(record.optional_data(), Some((7300, b"optional".as_slice())));
    }

    #[test]
    fn a_flipped_bit_is_seen_by_the_checksum_unless_the_flag_waives_it() {
        let stamp = RecordStamp {
            time: SevenKTime::default(),
            device_id: 1,
            system_enumerator: 2,
        };
        let mut buf = Vec::new();
        let open = OpenRecord::begin(&mut buf, 1013, &stamp);
        buf.extend_from_slice(&[0; 4]);
        open.finish(&mut buf);
        buf[66] ^= 1;
        assert!(matches!(
            Record::parse(&buf),
            Err(WireError::Checksum { .. })
        ));
        buf[48] = 0;
        assert!(Record::parse(&buf).is_ok());
    }

    proptest! {
        #[test]
        fn checksum_is_the_plain_sum(bytes in proptest::collection::vec(any::<u8>(), 0..5000)) {
            let plain = bytes.iter().fold(0, |sum, &b| sum + u32::from(b));
            prop_assert_eq!(checksum(&bytes), plain);
        }

        #[test]
        fn rows_are_encoded_column_by_column(rows in 1_usize..40, columns in 0_usize..150) {
            let values: Vec<u16> = (0..rows * columns).map(|n| n as u16).collect();
            let mut buf = vec![1];
            extend_transposed(&mut buf, &values, rows, u16::to_le_bytes);
            let by_column = (0..columns).flat_map(|c| (0..rows).map(move |r| r * columns + c));
            let bytes = by_column.flat_map(|n| values[n].to_le_bytes());
            let expected: Vec<u8> = std::iter::once(1).chain(bytes).collect();
            prop_assert_eq!(buf, expected);
        }

        #[test]
        fn numbers_are_encoded_in_order(values in proptest::collection::vec(any::<u16>(), 0..1000)) {
            let mut buf = vec![1];
            extend_encoded(&mut buf, &values, u16::to_le_bytes);
            let expected: Vec<u8> = std::iter::once(1).chain(values.iter().flat_map(|v| v.to_le_bytes())).collect();
            prop_assert_eq!(buf, expected);
        }

        #[test]
        fn any_bytes_read_as_frames_or_record_without_panic(bytes in proptest::collection::vec(any::<u8>(), 0..200)) {
            if let Ok(frame) = NetworkFrame::parse(&bytes) {
                let _ = frame.check(1 << 20);
                let _ = frame.to_string();
            }
            if let Ok(frame) = DataRecordFrame::parse(&bytes) {
                let _ = frame.check();
                let _ = frame.to_string();
            }
            let _ = Record::parse(&bytes);
        }
    }
}
