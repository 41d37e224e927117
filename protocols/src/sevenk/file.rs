//! `.s7k` files: header 7200, catalogue 7300, and iteration over the records between them. Source: DFD 3.12.
//!
//! ```text
//! 7200 header, its optional data point to the 7300 | records without network frames | 7300 catalogue, one row per record before it
//!
//! 7200 RTH   0 u64 x 2 file_id   16 u16 version   20 u64 x 2 session_id   36 u32 record_data_size   40 u32 devices
//!            44 char[64] recording_name   108 char[16] program_version   124 char[64] user_defined_name   188 char[128] notes   316 bytes
//! 7200 RD    per device: u32 device_id, u16 enumerator
//! 7200 OD    (7300) u32 size, u64 offset of the catalogue
//! 7300 RTH   0 u32 size of RTH   4 u16 version   6 u32 records   10 u32 reserved                                                 14 bytes
//! 7300 RD    per record 48 bytes, see CatalogueRow
//! ```
//!
//! A file is written from front to back. At the end, the header is overwritten with the pointer to the catalogue. An interrupted
//! file has no catalogue and no pointer, but can be read.

use std::fmt;
use std::iter::FusedIterator;
use std::ops::Range;

use binrw::{BinRead, BinWrite};

use super::frame::{
    DataRecordFrame, Layout, MIN_RECORD_BYTES, OpenRecord, Record, RecordStamp, SYNC_PATTERN,
    read_fixed, write_layout,
};
use super::records::{data_at, rth, text_field, text_of};
use super::{SevenKTime, WireError, record_id};

#[derive(Debug, Clone, Copy, BinRead, BinWrite)]
struct Rth7200 {
    file_id: [u64; 2],
    #[brw(pad_after = 2)]
    version: u16,
    session_id: [u64; 2],
    record_data_size_bytes: u32,
    devices: u32,
    recording_name: [u8; 64],
    program_version: [u8; 16],
    user_defined_name: [u8; 64],
    notes: [u8; 128],
}

rth!(Rth7200, 316, "7200 file header");

/// Record 7200 (file header): description of a file. Texts end in a NUL on the wire and are truncated to fit.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct FileHeader7200 {
    /// Identifier of the file.
    pub file_id: [u64; 2],
    /// Identifier of the session.
    pub session_id: [u64; 2],
    /// Name of the recording, at most 63 bytes.
    pub recording_name: String,
    /// Version of the program, at most 15 bytes.
    pub program_version: String,
    /// Name that the user chooses, at most 63 bytes.
    pub user_defined_name: String,
    /// Notes, at most 127 bytes.
    pub notes: String,
    /// Devices whose records the file contains.
    pub devices: Vec<FileDevice>,
}

/// A device with records in the file.
#[derive(Debug, Clone, Copy, PartialEq, Eq, BinRead, BinWrite)]
pub struct FileDevice {
    /// Device identifier.
    pub device_id: u32,
    /// Enumerator of the system.
    pub system_enumerator: u16,
}

rth!(FileDevice, 6, "7200 device");

/// Optional data of 7200: position of the catalogue. All 0 while the file is being written.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, BinRead, BinWrite)]
pub struct CataloguePointer {
    /// Size of the whole 7300 record.
    pub size_bytes: u32,
    /// Offset from the start of the file.
    pub offset_bytes: u64,
}

rth!(CataloguePointer, 12, "7200 catalogue pointer");

impl CataloguePointer {
    /// Catalogue pointer of a 7200 record; `None` if it has none or the file was not closed.
    pub fn of_record(record: &Record<'_>) -> Option<Self> {
        let (id, data) = record.optional_data()?;
        let pointer: Self = read_fixed(data).ok()?;
        (record.frame.record_type_id == record_id::FILE_HEADER
            && id == record_id::FILE_CATALOGUE
            && pointer.offset_bytes != 0)
            .then_some(pointer)
    }
}

impl FileHeader7200 {
    /// Size of the record type header, bytes.
    pub const RTH_BYTES: usize = Rth7200::RTH_BYTES;

    /// Parses the body of the record. Returns an error if the body is too short.
    pub fn parse(body: &[u8]) -> Result<Self, WireError> {
        let rth: Rth7200 = read_fixed(body)?;
        let devices_len = u64::from(rth.devices) * FileDevice::SIZE_BYTES as u64;
        let devices = data_at(body, Rth7200::RTH_BYTES, devices_len, "7200 devices")?;
        Ok(Self {
            file_id: rth.file_id,
            session_id: rth.session_id,
            recording_name: text_of(&rth.recording_name),
            program_version: text_of(&rth.program_version),
            user_defined_name: text_of(&rth.user_defined_name),
            notes: text_of(&rth.notes),
            devices: devices
                .chunks_exact(FileDevice::SIZE_BYTES)
                .map(read_fixed)
                .collect::<Result<_, _>>()?,
        })
    }

    /// Appends the 7200 record. Its length depends only on the number of devices.
    pub fn emit(
        &self,
        buf: &mut Vec<u8>,
        stamp: &RecordStamp,
        catalogue: CataloguePointer,
    ) -> Range<usize> {
        let open = OpenRecord::begin(buf, record_id::FILE_HEADER, stamp);
        let rth = Rth7200 {
            file_id: self.file_id,
            version: 1,
            session_id: self.session_id,
            record_data_size_bytes: (self.devices.len() * FileDevice::SIZE_BYTES) as u32,
            devices: self.devices.len() as u32,
            recording_name: text_field(&self.recording_name),
            program_version: text_field(&self.program_version),
            user_defined_name: text_field(&self.user_defined_name),
            notes: text_field(&self.notes),
        };
        write_layout(&rth, buf);
        self.devices
            .iter()
            .for_each(|device| write_layout(device, buf));
        open.optional_data(buf, record_id::FILE_CATALOGUE);
        write_layout(&catalogue, buf);
        open.finish(buf)
    }
}

// --------------------------------------------------------------------------------------------------------------------------- catalogue

#[derive(Debug, Clone, Copy, BinRead, BinWrite)]
struct Rth7300 {
    size_bytes: u32,
    version: u16,
    #[brw(pad_after = 4)]
    records: u32,
}

rth!(Rth7300, 14, "7300 file catalogue");

/// Catalogue entry of one record.
#[derive(Debug, Clone, Copy, PartialEq, BinRead, BinWrite)]
pub struct CatalogueRow {
    /// Size of the record.
    pub size_bytes: u32,
    /// Offset from the start of the file.
    pub offset_bytes: u64,
    /// Record type.
    pub record_type_id: u16,
    /// Device identifier.
    pub device_id: u16,
    /// Enumerator of the system.
    pub system_enumerator: u16,
    /// Timestamp of the record.
    pub time: SevenKTime,
    /// Number of records; always 0.
    #[brw(pad_after = 16)]
    pub record_count: u32,
}

rth!(CatalogueRow, 48, "7300 row");

/// Parsed record 7300 (file catalogue) that borrows its rows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Catalogue7300<'a> {
    /// Number of records in the file, without the catalogue.
    pub records: u32,
    rows: &'a [u8],
}

impl<'a> Catalogue7300<'a> {
    /// Size of the record type header, bytes.
    pub const RTH_BYTES: usize = Rth7300::RTH_BYTES;

    /// Parses the body of the record. Returns an error if the body is too short or has an unsupported value.
    pub fn parse(body: &'a [u8]) -> Result<Self, WireError> {
        let rth: Rth7300 = read_fixed(body)?;
        // The header states its size, so that a longer header of a later version can be skipped.
        if (rth.size_bytes as usize) < Rth7300::RTH_BYTES {
            return Err(WireError::unsupported("7300 header size", rth.size_bytes));
        }
        let len = u64::from(rth.records) * CatalogueRow::SIZE_BYTES as u64;
        Ok(Self {
            records: rth.records,
            rows: data_at(body, rth.size_bytes as usize, len, "7300 rows")?,
        })
    }

    /// Iterates over the entries.
    pub fn rows(&self) -> impl Iterator<Item = CatalogueRow> + 'a {
        self.rows
            .chunks_exact(CatalogueRow::SIZE_BYTES)
            .filter_map(|row| read_fixed(row).ok())
    }
}

/// Appends a record 7300 (file catalogue).
pub fn emit_7300(buf: &mut Vec<u8>, stamp: &RecordStamp, rows: &[CatalogueRow]) -> Range<usize> {
    let open = OpenRecord::begin(buf, record_id::FILE_CATALOGUE, stamp);
    buf.reserve(Rth7300::SIZE_BYTES + rows.len() * CatalogueRow::SIZE_BYTES + 4);
    write_layout(
        &Rth7300 {
            size_bytes: Rth7300::SIZE_BYTES as u32,
            version: 1,
            records: rows.len() as u32,
        },
        buf,
    );
    rows.iter().for_each(|row| write_layout(row, buf));
    open.finish(buf)
}

// ------------------------------------------------------------------------------------------------------------------------------- write

/// Maximum number of rows in a catalogue. Its size is a u32.
pub const MAX_CATALOGUE_ROWS: usize =
    (u32::MAX as usize - MIN_RECORD_BYTES - Rth7300::RTH_BYTES) / CatalogueRow::RTH_BYTES;

/// Error of adding a record to a file.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum FileError {
    #[error("not a record: {0}")]
    /// The bytes are not a valid record.
    Record(#[from] WireError),
    #[error("the file already has a 7001 record; readers require exactly one")]
    /// The file already has a 7001.
    SecondConfiguration,
    #[error("record {record_type_id} is reserved for the structure of the file")]
    /// The record type is reserved for the file's structure.
    Reserved {
        /// Record type.
        record_type_id: u32,
    },
    #[error("the catalogue is full")]
    /// The catalogue has its maximum size.
    CatalogueFull,
}

/// Builder of the catalogue of a file that the caller writes.
///
/// The caller writes the bytes of [`FileBuilder::begin`]. For every record it calls [`FileBuilder::append`] and writes the record.
/// At the end it writes [`FileEnd::catalogue`] after the last record and [`FileEnd::header`] over the start of the file.
#[derive(Debug)]
pub struct FileBuilder {
    header: FileHeader7200,
    stamp: RecordStamp,
    rows: Vec<CatalogueRow>,
    position_bytes: u64,
    has_configuration: bool,
}

/// Bytes that complete a file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FileEnd {
    /// Catalogue record, to be written after the last record.
    pub catalogue: Vec<u8>,
    /// Header record, to be written over the start of the file. It is as long as the original header.
    pub header: Vec<u8>,
}

impl FileBuilder {
    /// Appends the header to `out`, without a pointer.
    pub fn begin(header: FileHeader7200, stamp: RecordStamp, out: &mut Vec<u8>) -> Self {
        let range = header.emit(out, &stamp, CataloguePointer::default());
        let row = CatalogueRow {
            size_bytes: range.len() as u32,
            offset_bytes: 0,
            record_type_id: record_id::FILE_HEADER as u16,
            device_id: row_u16(stamp.device_id),
            system_enumerator: stamp.system_enumerator,
            time: stamp.time,
            record_count: 0,
        };
        Self {
            header,
            stamp,
            rows: vec![row],
            position_bytes: range.len() as u64,
            has_configuration: false,
        }
    }

    /// Registers a complete record and returns its offset. The caller then writes the record, or omits it after an error.
    pub fn append(&mut self, record: &[u8]) -> Result<u64, FileError> {
        let frame = DataRecordFrame::parse(record)?;
        frame.check()?;
        if frame.size_bytes as usize != record.len() {
            return Err(WireError::RecordSize {
                stated_bytes: frame.size_bytes,
                got_bytes: record.len() as u64,
            }
            .into());
        }
        match frame.record_type_id {
            record_id::FILE_HEADER | record_id::FILE_CATALOGUE => {
                return Err(FileError::Reserved {
                    record_type_id: frame.record_type_id,
                });
            }
            record_id::CONFIGURATION if self.has_configuration => {
                return Err(FileError::SecondConfiguration);
            }
            _ if self.rows.len() == MAX_CATALOGUE_ROWS => return Err(FileError::CatalogueFull),
            record_id::CONFIGURATION => self.has_configuration = true,
            _ => {}
        }
        let offset_bytes = self.position_bytes;
        self.rows.push(CatalogueRow {
            size_bytes: frame.size_bytes,
            offset_bytes,
            record_type_id: row_u16(frame.record_type_id),
            device_id: row_u16(frame.device_id),
            system_enumerator: frame.system_enumerator,
            time: frame.time,
            record_count: 0,
        });
        self.position_bytes += u64::from(frame.size_bytes);
        Ok(offset_bytes)
    }

    /// Length of the file so far.
    pub fn position_bytes(&self) -> u64 {
        self.position_bytes
    }

    /// Number of records so far, including the header.
    pub fn records(&self) -> usize {
        self.rows.len()
    }

    /// Completes the file: catalogue, and header with the pointer to the catalogue.
    pub fn close(self) -> FileEnd {
        let (mut catalogue, mut header) = (Vec::new(), Vec::new());
        emit_7300(&mut catalogue, &self.stamp, &self.rows);
        let pointer = CataloguePointer {
            size_bytes: catalogue.len() as u32,
            offset_bytes: self.position_bytes,
        };
        self.header.emit(&mut header, &self.stamp, pointer);
        FileEnd { catalogue, header }
    }
}

/// Clamps a number to 16 bits, because catalogue rows have narrower fields than frames.
fn row_u16(value: u32) -> u16 {
    u16::try_from(value).unwrap_or(u16::MAX)
}

// -------------------------------------------------------------------------------------------------------------------------------- read

/// A record and its position in the file.
#[derive(Debug, Clone, Copy)]
pub struct FileRecord<'a> {
    /// Offset from the start of the file.
    pub offset_bytes: u64,
    /// The record.
    pub record: Record<'a>,
}

/// Bytes of a file that are not a record.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("at byte {offset_bytes}: {error}")]
pub struct FileReadError {
    /// Offset from the start of the file.
    pub offset_bytes: u64,
    /// Reason for the refusal.
    pub error: WireError,
}

/// Offset of the sync pattern from the front of a record.
const SYNC_AT_BYTES: usize = 4;

/// Iterator over the records of a file, complete or interrupted. After an error it continues at the next possible record and counts
/// the skipped bytes.
#[derive(Debug, Clone)]
pub struct FileReader<'a> {
    bytes: &'a [u8],
    at: usize,
    searching: bool,
    skipped_bytes: u64,
}

impl<'a> FileReader<'a> {
    /// Reader of a file; `bytes` is the whole file.
    pub fn new(bytes: &'a [u8]) -> Self {
        Self {
            bytes,
            at: 0,
            searching: false,
            skipped_bytes: 0,
        }
    }

    /// Number of bytes so far that are not part of a record.
    pub fn skipped_bytes(&self) -> u64 {
        self.skipped_bytes
    }

    /// Skips bytes without a sync pattern, which cannot start a record.
    fn skip_to_sync(&mut self) {
        let rest = &self.bytes[self.at..];
        let pattern = SYNC_PATTERN.to_le_bytes();
        let behind_front = rest.get(SYNC_AT_BYTES..).unwrap_or_default();
        let next = behind_front
            .windows(pattern.len())
            .position(|window| window == pattern);
        // If there are fewer bytes than the pattern has, they are skipped one by one.
        let skipped = next.unwrap_or(behind_front.len().saturating_sub(pattern.len() - 1));
        self.at += skipped;
        self.skipped_bytes += skipped as u64;
    }
}

impl<'a> Iterator for FileReader<'a> {
    type Item = Result<FileRecord<'a>, FileReadError>;

    fn next(&mut self) -> Option<Self::Item> {
        while self.at < self.bytes.len() {
            if self.searching {
                self.skip_to_sync();
            }
            let (offset_bytes, rest) = (self.at as u64, &self.bytes[self.at..]);
            let frame =
                DataRecordFrame::parse(rest).and_then(|frame| frame.check().map(|()| frame));
            let outcome = frame.and_then(|frame| {
                let truncated =
                    WireError::truncated("record in the file", frame.size_bytes, rest.len());
                Record::parse(rest.get(..frame.size_bytes as usize).ok_or(truncated)?)
            });
            let error = match outcome {
                Ok(record) => {
                    self.at += record.bytes().len();
                    self.searching = false;
                    return Some(Ok(FileRecord {
                        offset_bytes,
                        record,
                    }));
                }
                Err(error) => error,
            };
            self.at += 1;
            self.skipped_bytes += 1;
            let is_news = frame.is_ok() || !self.searching;
            self.searching = true;
            if is_news {
                return Some(Err(FileReadError {
                    offset_bytes,
                    error,
                }));
            }
        }
        None
    }
}

impl FusedIterator for FileReader<'_> {}

// ------------------------------------------------------------------------------------------------------------------------------- print

impl fmt::Display for FileHeader7200 {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "file header: {:?} by {:?}, {:?}, {:?}",
            self.recording_name, self.program_version, self.user_defined_name, self.notes
        )?;
        self.devices.iter().try_for_each(|device| {
            write!(
                f,
                ", device {}:{}",
                device.device_id, device.system_enumerator
            )
        })
    }
}

impl fmt::Display for Catalogue7300<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "file catalogue: {} records", self.records)
    }
}
