//! Repairs interrupted recordings. For `.s7k` files, data after the last whole record is removed, the catalogue is written, and the header points to
//! it. [`repair`] handles the other kinds.
//!
//! A recorder locks its file. A locked file is not changed.

use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use echotank_protocols::jsf::JsfFraming;
use echotank_protocols::ping_protocol::PingFraming;
use echotank_protocols::sevenk::file::{CataloguePointer, FileBuilder, FileHeader7200};
use echotank_protocols::sevenk::{DataRecordFrame, Record, RecordStamp, WireError, record_id};
use echotank_protocols::xtf::{FileHeader, XtfFraming};

use super::repair::{KINDS, open_for_repair};
pub use super::repair::{RecoverError, Recovered};
use super::{RecordError, repair};

/// Number of leading bytes that contain the length of a record.
const FRAME_BYTES: usize = 64;
/// Maximum length of a record that this program writes, bytes.
const MAX_RECORD_BYTES: u32 = 1 << 30;

/// Repairs one file in place and returns the outcome.
///
/// # Errors
/// See [`RecoverError`].
pub fn recover(path: &Path) -> Result<Recovered, RecoverError> {
    let name = path.file_name().and_then(|name| name.to_str());
    let extension = name.and_then(|name| name.rsplit_once('.'));
    match extension.map(|(_, extension)| extension) {
        Some("s7k") => recover_s7k(path),
        Some("jsf") => repair::frames(path, 0, &JsfFraming::default()),
        Some("xtf") => repair::frames(path, FileHeader::SIZE_BYTES, &XtfFraming::default()),
        Some("svlog") => repair::frames(path, 0, &PingFraming),
        Some("jsonl") => repair::lines(path),
        Some("wav") => repair::wav(path),
        Some("mcap") => repair::mcap(path),
        Some("sigmf-meta" | "sigmf-data" | "sigmf-journal") => repair::sigmf(path),
        _ => Err(RecoverError::Unknown {
            path: path.to_owned(),
        }),
    }
}

fn recover_s7k(path: &Path) -> Result<Recovered, RecoverError> {
    let io = |action| RecordError::io(path, action);
    let Some(mut file) = open_for_repair(path)? else {
        return Ok(Recovered::InUse);
    };
    let length = file.metadata().map_err(io("read"))?.len();
    let no_header = |why| RecoverError::NoHeader {
        path: path.to_owned(),
        why,
    };
    let mut bytes = Vec::new();
    next_record(&mut file, &mut bytes).map_err(io("read"))?;
    let first = Record::parse(&bytes).map_err(no_header)?;
    if first.frame.record_type_id != record_id::FILE_HEADER {
        return Err(no_header(WireError::Unsupported {
            what: "first record",
            got: u64::from(first.frame.record_type_id),
        }));
    }
    let points_at_end =
        |pointer: CataloguePointer| pointer.offset_bytes + u64::from(pointer.size_bytes) == length;
    if CataloguePointer::of_record(&first).is_some_and(points_at_end) {
        return Ok(Recovered::Whole);
    }
    let header = FileHeader7200::parse(first.body()).map_err(no_header)?;
    let stamp = RecordStamp {
        time: first.frame.time,
        device_id: first.frame.device_id,
        system_enumerator: first.frame.system_enumerator,
    };
    let mut again = Vec::new();
    let mut builder = FileBuilder::begin(header, stamp, &mut again);
    debug_assert_eq!(again.len(), bytes.len());
    // The first incomplete or misplaced record marks the interruption. This includes a catalogue without a pointer.
    loop {
        next_record(&mut file, &mut bytes).map_err(io("read"))?;
        if Record::parse(&bytes).is_err() || builder.append(&bytes).is_err() {
            break;
        }
    }
    let end_of_records = builder.position_bytes();
    let records = builder.records() as u64;
    let end = builder.close();
    file.set_len(end_of_records)
        .and_then(|()| file.seek(SeekFrom::Start(end_of_records)))
        .and_then(|_| file.write_all(&end.catalogue))
        // The pointer is written after the catalogue exists.
        .and_then(|()| file.sync_data())
        .and_then(|()| file.seek(SeekFrom::Start(0)))
        .and_then(|_| file.write_all(&end.header))
        .and_then(|()| file.sync_data())
        .map_err(io("mend"))?;
    Ok(Recovered::Repaired {
        records,
        what: "records",
        cut_bytes: length - end_of_records,
    })
}

/// Repairs the records of a folder. Returns one line for each repair or failure; none if the folder does not exist.
pub(crate) fn recover_folder(folder: &Path) -> Vec<String> {
    let Ok(entries) = std::fs::read_dir(folder) else {
        return Vec::new();
    };
    let paths = entries.flatten().map(|entry| entry.path());
    let is_kind = |path: &PathBuf| {
        let name = path.file_name().and_then(|name| name.to_str());
        let is_log = |name: &str| name.starts_with("faults-") || name.starts_with("overload-");
        let is_ours = |name: &str| !name.ends_with(".jsonl") || is_log(name);
        name.is_some_and(|name| is_ours(name) && KINDS.iter().any(|kind| name.ends_with(kind)))
    };
    let mut paths: Vec<_> = paths.filter(is_kind).collect();
    paths.sort();
    let mend = |path: &PathBuf| match recover(path) {
        Ok(Recovered::Whole | Recovered::InUse) => None,
        Ok(repaired) => Some(format!("{} {repaired}", path.display())),
        Err(error) => Some(format!("warning: {error}")),
    };
    paths.iter().filter_map(mend).collect()
}

/// Reads the next record, which is shorter than its stated length at an interruption.
fn next_record(file: &mut File, bytes: &mut Vec<u8>) -> io::Result<()> {
    bytes.clear();
    file.take(FRAME_BYTES as u64).read_to_end(bytes)?;
    let size = DataRecordFrame::parse(bytes).map_or(0, |frame| frame.size_bytes);
    if (FRAME_BYTES as u32..=MAX_RECORD_BYTES).contains(&size) {
        let rest = u64::from(size) - FRAME_BYTES as u64;
        file.take(rest).read_to_end(bytes)?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::io::record::s7k::S7kRecorder;
    use crate::io::record::testing::{
        s7k_header as header, s7k_record as record, s7k_stamp as stamp,
    };
    use echotank_protocols::sevenk::file::{Catalogue7300, FileReader};
    use proptest::prelude::*;

    /// A closed file with the records of five pings, and the end of each record.
    fn closed(path: &Path) -> (Vec<u8>, Vec<usize>) {
        let mut s7k = S7kRecorder::create(path, header(), stamp()).expect("create");
        let mut ends = vec![s7k.length_bytes() as usize];
        for k in 0..5_u8 {
            for (kind, bytes) in [(7000, 40), (7038, 300 + 100 * usize::from(k))] {
                s7k.write(&record(kind, &vec![k; bytes])).expect("write");
                ends.push(s7k.length_bytes() as usize);
            }
        }
        s7k.close().expect("close");
        (std::fs::read(path).expect("read"), ends)
    }

    fn types(bytes: &[u8]) -> Vec<u32> {
        FileReader::new(bytes)
            .map(|r| r.expect("whole records").record.frame.record_type_id)
            .collect()
    }

    /// Asserts that the header points to the catalogue, which has a row for every other record.
    fn assert_closed(bytes: &[u8], records: usize) {
        let first = FileReader::new(bytes).next().expect("one").expect("whole");
        let pointer = CataloguePointer::of_record(&first.record).expect("closed");
        let at = pointer.offset_bytes as usize;
        assert_eq!(at + pointer.size_bytes as usize, bytes.len());
        let catalogue = Record::parse(&bytes[at..]).expect("a record");
        let catalogue = Catalogue7300::parse(catalogue.body()).expect("a catalogue");
        assert_eq!(catalogue.rows().count(), records);
    }

    #[test]
    fn cut_off_at_any_byte_a_file_keeps_every_whole_record() {
        let dir = tempfile::tempdir().expect("dir");
        let path = dir.path().join("cut.s7k");
        let (whole, ends) = closed(&path);
        assert_eq!(recover(&path).expect("fine"), Recovered::Whole);
        // State after a kill: no catalogue and no pointer.
        let mut open = Vec::new();
        FileBuilder::begin(header(), stamp(), &mut open);
        let last = *ends.last().expect("records");
        open.extend_from_slice(&whole[ends[0]..last]);
        for length in (ends[0]..=last).step_by(37).chain([last]) {
            std::fs::write(&path, &open[..length]).expect("written");
            let kept = ends.iter().filter(|&&end| end <= length).count();
            let cut_bytes = (length - ends[kept - 1]) as u64;
            let got = recover(&path).expect("repaired");
            let want = Recovered::Repaired {
                records: kept as u64,
                what: "records",
                cut_bytes,
            };
            assert_eq!(got, want, "cut at {length}");
            let bytes = std::fs::read(&path).expect("read");
            assert_eq!(types(&bytes).len(), kept + 1, "and a catalogue");
            assert_closed(&bytes, kept);
            assert_eq!(recover(&path).expect("again"), Recovered::Whole);
        }
        std::fs::write(&path, &open).expect("written");
        recover(&path).expect("repaired");
        assert!(std::fs::read(&path).expect("read") == whole, "as if closed");
    }

    #[test]
    fn killed_between_catalogue_and_pointer_it_is_repaired_too() {
        let dir = tempfile::tempdir().expect("dir");
        let path = dir.path().join("cut.s7k");
        let (whole, ends) = closed(&path);
        let mut open = Vec::new();
        FileBuilder::begin(header(), stamp(), &mut open);
        open.extend_from_slice(&whole[ends[0]..]);
        std::fs::write(&path, &open).expect("written");
        assert!(matches!(recover(&path), Ok(Recovered::Repaired { .. })));
        assert!(std::fs::read(&path).expect("read") == whole);
    }

    #[test]
    fn a_file_that_is_being_recorded_is_left_alone() {
        let dir = tempfile::tempdir().expect("dir");
        let path = dir.path().join("live.s7k");
        let mut s7k = S7kRecorder::create(&path, header(), stamp()).expect("create");
        s7k.write(&record(7000, &[1; 40])).expect("write");
        assert_eq!(recover(&path).expect("looked at"), Recovered::InUse);
        s7k.write(&record(7000, &[2; 40])).expect("goes on");
        s7k.close().expect("close");
        assert_eq!(recover(&path).expect("looked at"), Recovered::Whole);
        assert_eq!(recover_folder(dir.path()), Vec::<String>::new());
    }

    proptest! {
        #[test]
        fn what_is_no_record_of_ours_is_refused_and_left_as_it_was(bytes in proptest::collection::vec(any::<u8>(), 0..300)) {
            let dir = tempfile::tempdir().expect("dir");
            let path = dir.path().join("noise.s7k");
            std::fs::write(&path, &bytes).expect("written");
            prop_assert!(recover(&path).is_err());
            prop_assert_eq!(std::fs::read(&path).expect("read"), bytes);
        }
    }
}
