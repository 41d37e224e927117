//! `.s7k` files: 7k records as sent to clients, between a file header (7200) and a catalogue (7300).
//!
//! The file has its final name from the start and grows by whole records. An interrupted file lacks the catalogue and its pointer but is readable.
//! Closing writes both.

use std::fs::File;
use std::io::{Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use echotank_protocols::sevenk::RecordStamp;
use echotank_protocols::sevenk::file::{FileBuilder, FileHeader7200};

use super::RecordError;

/// Recorder of one `.s7k` file. Drop closes the file if possible.
#[derive(Debug)]
pub(crate) struct S7kRecorder {
    path: PathBuf,
    file: File,
    /// `None` after closing or after a file system error.
    builder: Option<FileBuilder>,
}

impl S7kRecorder {
    /// Creates the file, replacing an existing one. `stamp` is the time and device of the header and the catalogue.
    pub(crate) fn create(
        path: &Path,
        header: FileHeader7200,
        stamp: RecordStamp,
    ) -> Result<Self, RecordError> {
        let mut file = File::create(path).map_err(RecordError::io(path, "create"))?;
        // The lock prevents `recover` from changing the file. On a file system without locks no other program may repair the file.
        let _ = file.try_lock();
        let mut bytes = Vec::new();
        let builder = FileBuilder::begin(header, stamp, &mut bytes);
        file.write_all(&bytes)
            .map_err(RecordError::io(path, "write"))?;
        Ok(Self {
            path: path.to_owned(),
            file,
            builder: Some(builder),
        })
    }

    /// Appends a whole record, from data record frame to checksum. A record that the format cannot hold is omitted with [`RecordError::Refused`]. A
    /// file system error truncates the file to its last whole record and stops the recorder.
    pub(crate) fn write(&mut self, record: &[u8]) -> Result<(), RecordError> {
        let Some(builder) = &mut self.builder else {
            return Err(RecordError::Stopped {
                path: self.path.clone(),
            });
        };
        let offset = builder
            .append(record)
            .map_err(|source| RecordError::Refused {
                path: self.path.clone(),
                source,
            })?;
        self.file.write_all(record).map_err(|source| {
            // The builder has counted a record that is not in the file, so no catalogue can be written.
            self.builder = None;
            // If this fails too, readers skip the truncated record.
            let _ = self.file.set_len(offset);
            RecordError::io(&self.path, "write")(source)
        })
    }

    /// Bytes written so far; 0 once closed or stopped.
    #[cfg(test)]
    pub(crate) fn length_bytes(&self) -> u64 {
        self.builder.as_ref().map_or(0, FileBuilder::position_bytes)
    }

    /// Writes the catalogue and its pointer. After an error the file is in the state of an interrupted file.
    pub(crate) fn close(mut self) -> Result<(), RecordError> {
        if self.builder.is_none() {
            return Err(RecordError::Stopped {
                path: self.path.clone(),
            });
        }
        self.end()
    }

    fn end(&mut self) -> Result<(), RecordError> {
        let Some(builder) = self.builder.take() else {
            return Ok(());
        };
        let end_of_records = builder.position_bytes();
        let end = builder.close();
        let written = self
            .file
            .write_all(&end.catalogue)
            // The pointer is written only after the catalogue is on the disk.
            .and_then(|()| self.file.sync_data())
            .and_then(|()| self.file.seek(SeekFrom::Start(0)))
            .and_then(|_| self.file.write_all(&end.header));
        written.map_err(|source| {
            let _ = self.file.set_len(end_of_records);
            RecordError::io(&self.path, "close")(source)
        })
    }
}

impl Drop for S7kRecorder {
    fn drop(&mut self) {
        // A drop cannot report an error, unlike `close`.
        let _ = self.end();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::io::record::testing::{
        s7k_header as header, s7k_record as record, s7k_stamp as stamp,
    };
    use echotank_protocols::sevenk::Record;
    use echotank_protocols::sevenk::file::{Catalogue7300, CataloguePointer, FileReader};

    fn types(bytes: &[u8]) -> Vec<u32> {
        FileReader::new(bytes)
            .map(|r| r.expect("whole records").record.frame.record_type_id)
            .collect()
    }

    #[test]
    fn closed_file_points_at_a_catalogue_that_finds_every_record() {
        let dir = tempfile::tempdir().expect("dir");
        for by_drop in [false, true] {
            let path = dir.path().join(format!("{by_drop}.s7k"));
            let mut s7k = S7kRecorder::create(&path, header(), stamp()).expect("create");
            let records = [
                record(7000, &[1; 40]),
                record(7038, &[2; 999]),
                record(7000, &[3; 40]),
            ];
            for r in &records {
                s7k.write(r).expect("write");
            }
            if by_drop {
                drop(s7k);
            } else {
                s7k.close().expect("close");
            }
            let bytes = std::fs::read(&path).expect("read");
            assert_eq!(types(&bytes), [7200, 7000, 7038, 7000, 7300]);
            let first = FileReader::new(&bytes)
                .next()
                .expect("header")
                .expect("whole");
            let pointer = CataloguePointer::of_record(&first.record).expect("closed");
            let catalogue = Record::parse(
                &bytes[pointer.offset_bytes as usize..][..pointer.size_bytes as usize],
            )
            .expect("catalogue where the header says");
            let catalogue = Catalogue7300::parse(catalogue.body()).expect("7300");
            let rows: Vec<_> = catalogue.rows().collect();
            assert_eq!(rows.len(), 4);
            for (row, want) in rows[1..].iter().zip(&records) {
                let got = &bytes[row.offset_bytes as usize..][..row.size_bytes as usize];
                assert!(got == want.as_slice());
            }
        }
    }

    #[test]
    fn a_file_cut_off_at_any_moment_is_readable_up_to_there() {
        let dir = tempfile::tempdir().expect("dir");
        let path = dir.path().join("cut.s7k");
        let mut s7k = S7kRecorder::create(&path, header(), stamp()).expect("create");
        s7k.write(&record(7000, &[1; 40])).expect("write");
        s7k.write(&record(7007, &[2; 400])).expect("write");
        // State after a kill, read while the recorder is open.
        let bytes = std::fs::read(&path).expect("read");
        assert_eq!(types(&bytes), [7200, 7000, 7007]);
        assert_eq!(bytes.len() as u64, s7k.length_bytes());
        let header = FileReader::new(&bytes)
            .next()
            .expect("header")
            .expect("whole");
        assert_eq!(CataloguePointer::of_record(&header.record), None);
    }

    #[test]
    fn what_is_no_record_is_refused_and_the_file_goes_on() {
        let dir = tempfile::tempdir().expect("dir");
        let path = dir.path().join("refuse.s7k");
        let mut s7k = S7kRecorder::create(&path, header(), stamp()).expect("create");
        let mut torn = record(7000, &[1; 40]);
        torn.pop();
        for bad in [&b"nonsense"[..], &torn, &record(7300, &[0; 14])] {
            let error = s7k.write(bad).expect_err("no record");
            assert!(matches!(error, RecordError::Refused { .. }), "{error}");
            assert!(error.to_string().contains("refuse.s7k"), "{error}");
        }
        s7k.write(&record(7000, &[1; 40])).expect("goes on");
        s7k.close().expect("close");
        assert_eq!(
            types(&std::fs::read(&path).expect("read")),
            [7200, 7000, 7300]
        );
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn a_disk_that_fills_up_while_recording_stops_the_recorder_with_an_error() {
        let mut s7k = S7kRecorder {
            path: "/dev/full".into(),
            file: File::options()
                .write(true)
                .open("/dev/full")
                .expect("opens"),
            builder: Some(FileBuilder::begin(header(), stamp(), &mut Vec::new())),
        };
        let text = s7k
            .write(&record(7000, &[1; 40]))
            .expect_err("full disk")
            .to_string();
        assert!(text.starts_with("/dev/full: cannot write"), "{text}");
        let error = s7k.write(&record(7000, &[1; 40])).expect_err("stopped");
        assert!(matches!(error, RecordError::Stopped { .. }), "{error}");
        assert!(matches!(s7k.close(), Err(RecordError::Stopped { .. })));
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn a_missing_folder_and_a_full_disk_are_errors_that_name_the_file() {
        for (path, action) in [("/no/such/folder/a.s7k", "create"), ("/dev/full", "write")] {
            let error = S7kRecorder::create(Path::new(path), header(), stamp())
                .expect_err("cannot be written");
            let text = error.to_string();
            assert!(text.contains(path) && text.contains(action), "{text}");
        }
    }
}
