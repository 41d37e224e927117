//! `NAME.mcap`: ROS 2 messages of one sonar ([`echotank_emit::ros2`]). Container: MCAP specification, version 0; profile `ros2`.
//!
//! Each ping is one chunk without compression, which reaches the file with its index in one piece. An interrupted file holds every whole ping;
//! `recover` ends it. The index of the chunks stays in memory until the end, some hundred bytes for each ping.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use mcap::records::MessageHeader;
use mcap::write::NoSeek;
use mcap::{McapError, WriteOptions, Writer};

use super::RecordError;
use echotank_config::spec::{McapSpec, SonarSpec};
use echotank_core::ping::{PingOutput, PingPlan};
use echotank_emit::ros2::Ros2Emitter;

/// A file that takes the bytes between two flushes as one piece, or none of them.
struct WholePieces {
    file: File,
    pending: Vec<u8>,
    length_bytes: u64,
    has_failed: bool,
}

impl Write for WholePieces {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.pending.extend_from_slice(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        if self.has_failed {
            return Err(io::Error::other("an earlier write failed"));
        }
        let written = self.file.write_all(&self.pending);
        if written.is_err() {
            self.has_failed = true;
            // If this fails too, `recover` removes the incomplete piece.
            let _ = self.file.set_len(self.length_bytes);
        }
        self.length_bytes += self.pending.len() as u64;
        self.pending.clear();
        written
    }
}

/// Recorder of one MCAP file. Drop ends the file if possible.
pub(crate) struct McapRecorder {
    path: PathBuf,
    writer: Writer<NoSeek<WholePieces>>,
    emitter: Ros2Emitter,
    /// Identifiers of the topics.
    channels: Vec<u16>,
    has_pings: bool,
    is_stopped: bool,
}

impl McapRecorder {
    /// Creates the file, replacing an existing one.
    pub(crate) fn create(
        path: &Path,
        output: &McapSpec,
        sonar: &SonarSpec,
    ) -> Result<Self, RecordError> {
        let file = File::create(path).map_err(RecordError::io(path, "create"))?;
        // The lock prevents `recover` from changing the file.
        let _ = file.try_lock();
        let pieces = WholePieces {
            file,
            pending: Vec::new(),
            length_bytes: 0,
            has_failed: false,
        };
        let options = WriteOptions::new()
            .compression(None)
            .profile("ros2")
            .library(concat!("echotank ", env!("CARGO_PKG_VERSION")))
            .chunk_size(None)
            .disable_seeking(true);
        let wrong = |error| RecordError::io(path, "write")(of_mcap(error));
        let mut writer = options.create(NoSeek::new(pieces)).map_err(wrong)?;
        writer.flush().map_err(wrong)?;
        let emitter = Ros2Emitter::new(output, sonar);
        let mut channels = Vec::new();
        for topic in emitter.topics() {
            let definition = topic.definition.as_bytes();
            let channel = writer
                .add_schema(&topic.type_name, "ros2msg", definition)
                .and_then(|schema| {
                    writer.add_channel(schema, &topic.name, "cdr", &BTreeMap::new())
                });
            channels.push(channel.map_err(wrong)?);
        }
        Ok(Self {
            path: path.to_owned(),
            writer,
            emitter,
            channels,
            has_pings: false,
            is_stopped: false,
        })
    }

    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    /// Appends a ping. A file system error removes what was written of it and stops the recorder.
    pub(crate) fn push(&mut self, plan: &PingPlan, output: &PingOutput) -> Result<(), RecordError> {
        if self.is_stopped {
            return Err(RecordError::Stopped {
                path: self.path.clone(),
            });
        }
        let log_time = plan.stamp_utc.0.max(0) as u64;
        let (writer, channels) = (&mut self.writer, &self.channels);
        let is_first = !std::mem::replace(&mut self.has_pings, true);
        let written = self
            .emitter
            .emit_ping(plan, output, is_first, |topic, message| {
                let header = MessageHeader {
                    channel_id: channels[topic],
                    sequence: plan.ping_number,
                    log_time,
                    publish_time: log_time,
                };
                writer.write_to_known_channel(&header, message)
            });
        written.and_then(|()| writer.flush()).map_err(|error| {
            self.is_stopped = true;
            RecordError::io(&self.path, "write")(of_mcap(error))
        })
    }

    /// Writes the index and flushes the file to disk.
    pub(crate) fn close(mut self) -> Result<(), RecordError> {
        let io = RecordError::io(&self.path, "close");
        let finished = self.writer.finish().map_err(of_mcap);
        let pieces = self.writer.into_inner().into_inner();
        finished.and_then(|_| pieces.file.sync_data()).map_err(io)
    }
}

fn of_mcap(error: McapError) -> io::Error {
    match error {
        McapError::Io(error) => error,
        other => io::Error::other(other),
    }
}

#[cfg(all(test, target_os = "linux"))]
mod tests {
    use super::*;
    use crate::io::record::testing::{output, plan, sonar};

    #[test]
    fn a_missing_folder_and_a_full_disk_are_errors_that_name_the_file() {
        let path = Path::new("/no/such/folder/a.mcap");
        let error = McapRecorder::create(path, &McapSpec::ALL, &sonar()).err();
        let text = error.expect("no folder").to_string();
        assert!(
            text.starts_with("/no/such/folder/a.mcap: cannot create"),
            "{text}"
        );
        let error = McapRecorder::create(Path::new("/dev/full"), &McapSpec::ALL, &sonar()).err();
        let text = error.expect("full disk").to_string();
        assert!(text.starts_with("/dev/full: cannot write"), "{text}");
    }

    #[test]
    fn equal_pings_make_equal_files_with_the_chosen_messages() {
        let dir = tempfile::tempdir().expect("folder");
        let lines = McapSpec {
            elements: false,
            beams: false,
            image: false,
            ..McapSpec::ALL
        };
        let bytes = |name: &str, output_spec: &McapSpec| {
            let path = dir.path().join(name);
            let mut recorder = McapRecorder::create(&path, output_spec, &sonar()).expect("creates");
            for number in [4, 5] {
                recorder
                    .push(&plan(number), &output(number))
                    .expect("writes");
            }
            recorder.close().expect("closes");
            std::fs::read(path).expect("there")
        };
        let all = bytes("a.mcap", &McapSpec::ALL);
        assert!(all == bytes("b.mcap", &McapSpec::ALL));
        let topics = |bytes: &[u8]| -> Vec<String> {
            let summary = mcap::Summary::read(bytes)
                .expect("readable")
                .expect("has an index");
            let mut topics: Vec<_> = summary.channels.values().map(|c| c.topic.clone()).collect();
            topics.sort();
            topics
        };
        let own = |names: &[&str]| -> Vec<String> {
            let names = names.iter().map(|name| format!("/echotank/bow/{name}"));
            let mut all: Vec<String> = names.collect();
            all.extend(["/tf", "/tf_static"].map(String::from));
            all
        };
        let lines = bytes("c.mcap", &lines);
        assert_eq!(
            topics(&lines),
            own(&["fix", "port/line", "pose", "starboard/line"])
        );
        assert_eq!(
            topics(&all),
            own(&[
                "fix",
                "port/elements",
                "port/line",
                "pose",
                "starboard/beams",
                "starboard/elements",
                "starboard/image",
                "starboard/line",
            ])
        );
    }
}
