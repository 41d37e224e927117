//! Outcome of a repair, and the repair of framed streams, JSON lines, WAV, MCAP and SigMF. [`recover`](super::recover) repairs `.s7k`.
//!
//! A repair removes only the incomplete end, so no complete ping is lost. A file that the recorders of this program cannot have left is not changed.

use std::fs::File;
use std::io::{Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use mcap::MAGIC;
use mcap::records::op;

use echotank_protocols::framing::{Framing, Scan};
use echotank_protocols::sevenk::WireError;
use echotank_protocols::sigmf::Recording;
use echotank_protocols::wav::{HEADER_BYTES, WavHeader};

use super::RecordError;
use super::sigmf::{Paths, journal_of};

/// Bytes read at a time.
const READ_BYTES: usize = 1 << 20;
/// Type and length in front of a record of an MCAP file, bytes.
const MCAP_HEAD_BYTES: usize = 9;
/// Bytes in which the first record of an MCAP file names its program.
const MCAP_FRONT_BYTES: u64 = 128;

/// Outcome for one file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Recovered {
    /// The file was closed properly.
    Whole,
    /// A recorder has locked the file.
    InUse,
    /// The file was interrupted and is now valid.
    Repaired {
        /// Number of records (the file header included), pings, lines or metadata entries in the file.
        records: u64,
        /// Unit of `records`.
        what: &'static str,
        /// Length of the incomplete record that was removed, bytes.
        cut_bytes: u64,
    },
}

impl std::fmt::Display for Recovered {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Whole => f.write_str("is complete"),
            Self::InUse => f.write_str("is being recorded; left unchanged"),
            Self::Repaired {
                records,
                what,
                cut_bytes,
            } => write!(
                f,
                "had been cut off: recovered {records} {what}, removed {cut_bytes} bytes of an incomplete one"
            ),
        }
    }
}

/// Errors of a repair.
#[derive(Debug, thiserror::Error)]
pub enum RecoverError {
    /// A file system error.
    #[error(transparent)]
    Record(#[from] RecordError),
    /// The file header is missing or malformed.
    #[error("{}: does not begin with a 7k file header: {why}", path.display())]
    NoHeader {
        /// The file.
        path: PathBuf,
        /// Problem of the header.
        why: WireError,
    },
    /// Another program wrote the content; the file is unchanged.
    #[error("{}: at byte {at}: {why}: not written by this program; left unchanged", path.display())]
    Strange {
        /// The file.
        path: PathBuf,
        /// Offset of the problem from the start of the file, bytes.
        at: u64,
        /// Cause.
        why: String,
    },
    /// The kind of file is unknown.
    #[error("{}: unknown kind of record; known are {}", path.display(), KINDS.join(", "))]
    Unknown {
        /// The file.
        path: PathBuf,
    },
}

/// File name endings that a repair supports. The files of a SigMF recording are repaired together.
pub(super) const KINDS: [&str; 8] = [
    ".s7k",
    ".jsf",
    ".xtf",
    ".svlog",
    ".wav",
    ".mcap",
    ".jsonl",
    ".sigmf-meta",
];

/// Opens and locks a file for repair; `None` while a recorder holds the lock.
pub(super) fn open_for_repair(path: &Path) -> Result<Option<File>, RecordError> {
    let io = |action| RecordError::io(path, action);
    let opened = File::options().read(true).write(true).open(path);
    let file = opened.map_err(io("open"))?;
    match file.try_lock() {
        Ok(()) => Ok(Some(file)),
        Err(std::fs::TryLockError::WouldBlock) => Ok(None),
        Err(std::fs::TryLockError::Error(source)) => Err(io("lock")(source)),
    }
}

fn strange(path: &Path, at: u64, why: impl ToString) -> RecoverError {
    RecoverError::Strange {
        path: path.to_owned(),
        at,
        why: why.to_string(),
    }
}

/// Truncates the file to `end`. Reports the file as whole if it already ends there.
fn cut(
    path: &Path,
    file: &File,
    end: u64,
    records: u64,
    what: &'static str,
) -> Result<Recovered, RecoverError> {
    let length = file
        .metadata()
        .map_err(RecordError::io(path, "read"))?
        .len();
    if length == end {
        return Ok(Recovered::Whole);
    }
    let shortened = file.set_len(end).and_then(|()| file.sync_data());
    shortened.map_err(RecordError::io(path, "mend"))?;
    Ok(Recovered::Repaired {
        records,
        what,
        cut_bytes: length.saturating_sub(end),
    })
}

/// Removes an incomplete last frame behind a header of `head_bytes`. An incomplete header is removed as well.
pub(super) fn frames(
    path: &Path,
    head_bytes: usize,
    framing: &impl Framing,
) -> Result<Recovered, RecoverError> {
    let Some(mut file) = open_for_repair(path)? else {
        return Ok(Recovered::InUse);
    };
    let io = |action| RecordError::io(path, action);
    let length = file.metadata().map_err(io("read"))?.len();
    if length < head_bytes as u64 {
        return cut(path, &file, 0, 0, "records");
    }
    file.seek(SeekFrom::Start(head_bytes as u64))
        .map_err(io("read"))?;
    let (mut held, mut end, mut records) = (Vec::new(), head_bytes as u64, 0);
    loop {
        let before = held.len();
        (&mut file)
            .take(READ_BYTES as u64)
            .read_to_end(&mut held)
            .map_err(io("read"))?;
        let is_all = held.len() == before;
        let mut at = 0;
        while at < held.len() {
            match framing.scan(&held[at..]) {
                Scan::Whole(len) => {
                    at += len;
                    records += 1;
                }
                Scan::More => break,
                Scan::Wrong(why) => return Err(strange(path, end + at as u64, why)),
            }
        }
        held.drain(..at);
        end += at as u64;
        if is_all {
            return cut(path, &file, end, records, "records");
        }
    }
}

/// Removes an incomplete last line.
pub(super) fn lines(path: &Path) -> Result<Recovered, RecoverError> {
    let Some(mut file) = open_for_repair(path)? else {
        return Ok(Recovered::InUse);
    };
    let (mut buffer, mut read, mut end, mut lines) = (vec![0; READ_BYTES], 0, 0, 0);
    loop {
        let len = file
            .read(&mut buffer)
            .map_err(RecordError::io(path, "read"))?;
        if len == 0 {
            return cut(path, &file, end, lines, "lines");
        }
        for (at, _) in buffer[..len]
            .iter()
            .enumerate()
            .filter(|(_, b)| **b == b'\n')
        {
            lines += 1;
            end = read + at as u64 + 1;
        }
        read += len as u64;
    }
}

/// Removes data beyond the length in the header, which the recorder updates after every ping.
pub(super) fn wav(path: &Path) -> Result<Recovered, RecoverError> {
    let Some(file) = open_for_repair(path)? else {
        return Ok(Recovered::InUse);
    };
    let mut front = Vec::new();
    (&file)
        .take(HEADER_BYTES as u64)
        .read_to_end(&mut front)
        .map_err(RecordError::io(path, "read"))?;
    if front.len() < HEADER_BYTES {
        return cut(path, &file, 0, 0, "sample times");
    }
    let header = WavHeader::parse(&front).map_err(|why| strange(path, 0, why))?;
    if header.data_at != HEADER_BYTES {
        return Err(strange(path, 0, "a WAV of another program"));
    }
    let end = header.data_at as u64 + header.data_bytes;
    let length = file
        .metadata()
        .map_err(RecordError::io(path, "read"))?
        .len();
    if length < end {
        return Err(strange(path, length, "shorter than its header says"));
    }
    cut(path, &file, end, header.sample_times(), "sample times")
}

/// Removes an incomplete last record, and ends the file without an index, as the format allows: readers then read it from its beginning. An incomplete
/// header is removed as well.
pub(super) fn mcap(path: &Path) -> Result<Recovered, RecoverError> {
    let Some(mut file) = open_for_repair(path)? else {
        return Ok(Recovered::InUse);
    };
    let io = |action| RecordError::io(path, action);
    let length = file.metadata().map_err(io("read"))?.len();
    let mut front = Vec::new();
    (&file)
        .take(MCAP_FRONT_BYTES)
        .read_to_end(&mut front)
        .map_err(io("read"))?;
    let magic = MAGIC.len().min(front.len());
    if front[..magic] != MAGIC[..magic] {
        return Err(strange(path, 0, "no MCAP file"));
    }
    let (mut end, mut data_end) = (MAGIC.len() as u64, None);
    let (mut records, mut chunks) = (0, 0);
    let mut head = [0; MCAP_HEAD_BYTES];
    while length.saturating_sub(end) >= head.len() as u64 {
        file.seek(SeekFrom::Start(end)).map_err(io("read"))?;
        file.read_exact(&mut head).map_err(io("read"))?;
        let [kind, size @ ..] = head;
        let body = end + head.len() as u64;
        let after = body.saturating_add(u64::from_le_bytes(size));
        if after > length {
            break;
        }
        match kind {
            op::FOOTER if after + MAGIC.len() as u64 == length => return Ok(Recovered::Whole),
            op::HEADER if !front.windows(8).any(|part| part == b"echotank") => {
                return Err(strange(path, end, "an MCAP file of another program"));
            }
            op::CHUNK => chunks += 1,
            op::DATA_END => data_end = data_end.or(Some(end)),
            _ => {}
        }
        records += 1;
        end = after;
    }
    if records == 0 {
        return cut(path, &file, 0, 0, "chunks");
    }
    let end = data_end.unwrap_or(end);
    // The end of the data and the footer, without checksums and index.
    let mut tail = vec![op::DATA_END, 4, 0, 0, 0, 0, 0, 0, 0];
    tail.extend([0; 4]);
    tail.extend([op::FOOTER, 20, 0, 0, 0, 0, 0, 0, 0]);
    tail.extend([0; 20]);
    tail.extend(MAGIC);
    file.set_len(end)
        .and_then(|()| file.seek(SeekFrom::Start(end)))
        .and_then(|_| file.write_all(&tail))
        .and_then(|()| file.sync_data())
        .map_err(io("mend"))?;
    Ok(Recovered::Repaired {
        records: chunks,
        what: "chunks",
        cut_bytes: length - end,
    })
}

/// Completes the metadata from the journal, and removes samples that neither of them describes.
pub(super) fn sigmf(path: &Path) -> Result<Recovered, RecoverError> {
    let paths = Paths::of(&path.with_extension(""));
    let Some(data) = open_for_repair(&paths.data)? else {
        return Ok(Recovered::InUse);
    };
    let read =
        |path: &PathBuf| std::fs::read_to_string(path).map_err(RecordError::io(path, "read"));
    let text = read(&paths.meta)?;
    let mut words = Recording::parse(&text).map_err(|why| strange(&paths.meta, 0, why))?;
    let sample_time_bytes = words.data_type.bytes() as u64 * u64::from(words.channels);
    let length = data
        .metadata()
        .map_err(RecordError::io(&paths.data, "read"))?
        .len();
    let end_of = |words: &Recording| {
        let last = words.annotations.last();
        last.map_or(0, |last| {
            (last.sample_start + last.sample_count) * sample_time_bytes
        })
    };
    let has_journal = paths.journal.exists();
    if has_journal {
        for (capture, annotation) in journal_of(&read(&paths.journal)?) {
            // Skips entries that the metadata already contains, and those of a ping whose samples are incomplete.
            let known = words.annotations.last();
            let next = known.map_or(0, |last| last.sample_start + last.sample_count);
            let end = (annotation.sample_start + annotation.sample_count) * sample_time_bytes;
            if annotation.sample_start == next && end <= length {
                words.captures.push(capture);
                words.annotations.push(annotation);
            }
        }
    }
    let end = end_of(&words);
    if length < end {
        return Err(strange(
            &paths.data,
            length,
            "shorter than its metadata says",
        ));
    }
    if !has_journal && length == end {
        return Ok(Recovered::Whole);
    }
    paths.write_words(&words.to_json())?;
    let pings = words.annotations.len() as u64;
    let cut = cut(&paths.data, &data, end, pings, "pings")?;
    if has_journal {
        std::fs::remove_file(&paths.journal).map_err(RecordError::io(&paths.journal, "remove"))?;
    }
    Ok(match cut {
        Recovered::Whole => Recovered::Repaired {
            records: pings,
            what: "pings",
            cut_bytes: 0,
        },
        cut => cut,
    })
}

#[cfg(test)]
mod tests {
    use echotank_protocols::jsf::MessageHeader;
    use echotank_protocols::ping_protocol::{emit_frame, message_id};
    use echotank_protocols::xtf::{FileHeader, MARK, PacketStart};

    use super::super::faults::FaultLog;
    use super::super::mcap::McapRecorder;
    use super::super::recover::{recover, recover_folder};
    use super::super::sigmf::SigmfRecorder;
    use super::super::stream::StreamRecorder;
    use super::super::svlog;
    use super::super::testing;
    use super::super::wav::WavRecorder;
    use super::*;
    use echotank_config::spec::McapSpec;
    use echotank_config::spec::{PingDevice, WavSpec};
    use echotank_core::time::UtcNs;

    fn length(path: &Path) -> u64 {
        std::fs::metadata(path).expect("there").len()
    }

    /// Asserts that the file, cut at many lengths, is repaired to the last of `ends` before the cut, with unchanged content.
    fn assert_repaired_wherever_it_is_cut(path: &Path, ends: &[u64]) {
        let whole = std::fs::read(path).expect("there");
        let copy = path.with_file_name(format!(
            "cut-{}",
            path.file_name().and_then(|n| n.to_str()).expect("a name")
        ));
        let first = ends[0] as usize;
        for cut in (first..=whole.len()).step_by(17).chain([whole.len()]) {
            std::fs::write(&copy, &whole[..cut]).expect("written");
            let outcome = recover(&copy).expect("repaired");
            let want = ends.iter().copied().filter(|&end| end <= cut as u64).max();
            let want = want.expect("the first") as usize;
            assert_eq!(length(&copy), want as u64, "cut at {cut}: {outcome}");
            assert!(std::fs::read(&copy).expect("there") == whole[..want]);
            assert_eq!(outcome == Recovered::Whole, want == cut, "{outcome}");
            assert_eq!(recover(&copy).expect("again"), Recovered::Whole);
        }
    }

    fn jsf_message(bytes: usize) -> Vec<u8> {
        let mut message = Vec::new();
        let header = MessageHeader {
            body_bytes: bytes as u32,
            ..MessageHeader::data(80, 20, 0)
        };
        header.emit(&mut message);
        message.resize(message.len() + bytes, 7);
        message
    }

    #[test]
    fn streams_of_frames_and_lines_keep_every_whole_one_wherever_they_are_cut() {
        let dir = tempfile::tempdir().expect("folder");
        let path = dir.path().join("a.jsf");
        let mut jsf = StreamRecorder::create(&path, &jsf_message(30)).expect("creates");
        let mut ends = vec![length(&path)];
        for k in 0..4 {
            jsf.write(&jsf_message(100 * k)).expect("writes");
            ends.push(length(&path));
        }
        assert_eq!(recover(&path).expect("looked at"), Recovered::InUse);
        jsf.close(&[]).expect("closes");
        assert_repaired_wherever_it_is_cut(&path, &ends);

        let path = dir.path().join("a.xtf");
        let mut xtf = StreamRecorder::create(&path, &[0; FileHeader::SIZE_BYTES]).expect("creates");
        let mut ends = vec![length(&path)];
        for k in 1..4 {
            let mut packet = Vec::new();
            PacketStart {
                mark: MARK,
                packet_type: 0,
                sub_channel: 0,
                channels_to_follow: 1,
                packet_bytes: 64 * k,
            }
            .emit(&mut packet);
            packet.resize(64 * k as usize, 9);
            xtf.write(&packet).expect("writes");
            ends.push(length(&path));
        }
        xtf.close(&[]).expect("closes");
        assert_repaired_wherever_it_is_cut(&path, &ends);

        let path = dir.path().join("a.svlog");
        let device = PingDevice::Surveyor240;
        let mut svlog = svlog::create(&path, device, "", UtcNs(0)).expect("creates");
        let mut ends = vec![length(&path)];
        for _ in 0..4 {
            let mut frame = Vec::new();
            emit_frame(&mut frame, message_id::WATER_STATS, 1, 0, |buf| {
                buf.extend([0; 8])
            });
            svlog.write(&frame).expect("writes");
            ends.push(length(&path));
        }
        svlog.close(&[]).expect("closes");
        assert_repaired_wherever_it_is_cut(&path, &ends);

        let path = dir.path().join("faults-1.jsonl");
        let mut log = FaultLog::create(&path).expect("creates");
        let mut ends = vec![0];
        for k in 0..4 {
            log.write(&["x".repeat(40 * k)]).expect("writes");
            ends.push(length(&path));
        }
        drop(log);
        assert_repaired_wherever_it_is_cut(&path, &ends);
    }

    #[test]
    fn a_wav_ends_where_its_header_says_after_the_last_whole_ping() {
        let dir = tempfile::tempdir().expect("folder");
        let path = dir.path().join("a.wav");
        let output = WavSpec {
            arrays: vec![0],
            rate_hz: 1_000_000,
            is_float: false,
        };
        let mut wav = WavRecorder::create(&path, &output, &testing::sonar()).expect("creates");
        wav.push(&testing::plan(1), &testing::output(1))
            .expect("writes");
        let (one, end) = (std::fs::read(&path).expect("there"), length(&path));
        wav.push(&testing::plan(2), &testing::output(2))
            .expect("writes");
        wav.close().expect("closes");
        let two = std::fs::read(&path).expect("there");
        let copy = dir.path().join("cut.wav");
        // The samples of the second ping are partly written, and the header does not count them.
        for cut in [
            one.len(),
            one.len() + 1,
            (one.len() + two.len()) / 2,
            two.len(),
        ] {
            let bytes = [&one[..HEADER_BYTES], &two[HEADER_BYTES..cut]].concat();
            std::fs::write(&copy, &bytes).expect("written");
            recover(&copy).expect("repaired");
            assert!(std::fs::read(&copy).expect("there") == one, "cut at {cut}");
        }
        assert_eq!(length(&copy), end);
        assert_eq!(recover(&path).expect("looked at"), Recovered::Whole);
    }

    #[test]
    fn an_mcap_file_cut_off_at_any_byte_keeps_every_whole_ping() {
        let dir = tempfile::tempdir().expect("folder");
        let path = dir.path().join("a.mcap");
        let mut recorder =
            McapRecorder::create(&path, &McapSpec::ALL, &testing::sonar()).expect("creates");
        let length = |path: &Path| std::fs::metadata(path).expect("there").len() as usize;
        let mut ends = vec![length(&path)];
        for number in 1..=3 {
            let (plan, output) = (testing::plan(number), testing::output(number));
            recorder.push(&plan, &output).expect("writes");
            ends.push(length(&path));
        }
        assert_eq!(recover(&path).expect("looked at"), Recovered::InUse);
        recorder.close().expect("closes");
        assert_eq!(recover(&path).expect("looked at"), Recovered::Whole);
        let whole = std::fs::read(&path).expect("there");
        // Sequence numbers of the poses, which the reader takes from the chunks.
        let pings = |path: &Path| -> Vec<u32> {
            let bytes = std::fs::read(path).expect("there");
            let messages = mcap::MessageStream::new(&bytes).expect("an MCAP file");
            let messages = messages.map(|message| message.expect("a whole message"));
            let poses = messages.filter(|message| message.channel.topic.ends_with("/pose"));
            poses.map(|message| message.sequence).collect()
        };
        assert_eq!(pings(&path), [1, 2, 3]);
        for cut in (ends[0]..whole.len()).step_by(97).chain(ends.clone()) {
            std::fs::write(&path, &whole[..cut]).expect("written");
            let outcome = recover(&path).expect("repaired");
            assert!(
                matches!(outcome, Recovered::Repaired { .. }),
                "{cut}: {outcome}"
            );
            // A chunk is whole before its index is.
            let kept = pings(&path).len();
            let ended = ends[1..].iter().filter(|&&end| end <= cut).count();
            assert!(kept == ended || kept == ended + 1, "cut at {cut}: {kept}");
            assert_eq!(pings(&path), (1..=kept as u32).collect::<Vec<_>>());
            assert_eq!(recover(&path).expect("again"), Recovered::Whole);
        }
        for cut in [0, 5, 8, 20] {
            std::fs::write(&path, &whole[..cut]).expect("written");
            recover(&path).expect("without a record");
            assert_eq!(length(&path), 0, "cut at {cut}");
        }
        let foreign = b"\x89MCAP0\r\n\x01\x09\0\0\0\0\0\0\0\0\0\0\0\x01\0\0\0x";
        std::fs::write(&path, foreign).expect("written");
        let why = recover(&path).expect_err("of another program").to_string();
        assert!(why.contains("an MCAP file of another program"), "{why}");
        assert_eq!(std::fs::read(&path).expect("kept"), foreign);
    }

    #[test]
    fn a_sigmf_recording_that_was_killed_gets_the_words_of_every_ping_whose_samples_are_there() {
        let dir = tempfile::tempdir().expect("folder");
        let stem = dir.path().join("killed");
        let mut recorder = SigmfRecorder::create(&stem, &[0], &testing::sonar()).expect("creates");
        let files = Paths::of(&stem);
        for number in 1..=7_u32 {
            recorder
                .push(&testing::plan(number), &testing::output(number))
                .expect("writes");
        }
        // State after a kill, with the samples of the next ping truncated.
        let killed = tempfile::tempdir().expect("folder");
        let copy = Paths::of(&killed.path().join("killed"));
        for (from, to) in [
            (&files.data, &copy.data),
            (&files.meta, &copy.meta),
            (&files.journal, &copy.journal),
        ] {
            std::fs::copy(from, to).expect("copied");
        }
        let whole = std::fs::read(&copy.data).expect("there");
        std::fs::write(&copy.data, [whole.as_slice(), &[1; 100]].concat()).expect("written");
        let said =
            Recording::parse(&std::fs::read_to_string(&copy.meta).expect("there")).expect("words");
        assert!(said.annotations.len() < 7, "some are in the journal alone");
        let outcome = recover(&copy.meta).expect("repaired");
        let want = Recovered::Repaired {
            records: 7,
            what: "pings",
            cut_bytes: 100,
        };
        assert_eq!(outcome, want);
        recorder.close().expect("closes");
        assert!(!files.journal.exists() && !copy.journal.exists());
        for (closed, mended) in [(&files.data, &copy.data), (&files.meta, &copy.meta)] {
            assert!(
                std::fs::read(closed).expect("there") == std::fs::read(mended).expect("there"),
                "as if closed"
            );
        }
        assert_eq!(recover(&copy.data).expect("again"), Recovered::Whole);
    }

    #[test]
    fn what_others_wrote_is_left_alone() {
        let dir = tempfile::tempdir().expect("folder");
        for name in ["a.jsf", "a.svlog", "a.wav", "notes.jsonl", "a.txt"] {
            std::fs::write(dir.path().join(name), [b'q'; 300]).expect("written");
        }
        let said = recover_folder(dir.path());
        assert_eq!(said.len(), 3, "{said:?}");
        assert!(
            said.iter().all(|line| line.starts_with("warning: ")),
            "{said:?}"
        );
        for name in ["a.jsf", "a.svlog", "a.wav", "notes.jsonl", "a.txt"] {
            assert_eq!(length(&dir.path().join(name)), 300, "{name}");
        }
        let unknown = recover(&dir.path().join("a.txt")).expect_err("no record");
        assert!(unknown.to_string().contains(".svlog"), "{unknown}");
    }
}
