//! SigMF, WAV and MCAP recordings. A ping is written when it is encoded, before its deadline.

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use super::recording::Recording;
use super::{Output, OutputContext, OutputError, Report};
use crate::io::record::RecordError;
use crate::io::record::mcap::McapRecorder;
use crate::io::record::sigmf::SigmfRecorder;
use crate::io::record::wav::WavRecorder;
use echotank_config::spec::{McapSpec, SigmfSpec, WavSpec};
use echotank_core::time::UtcNs;
use echotank_ping::rig::PingSlot;

/// A SigMF, WAV or MCAP recorder.
trait Recorder: Send {
    /// Writes a ping. Returns the number of values clipped at full scale.
    fn push(&mut self, slot: &PingSlot) -> Result<u64, RecordError>;
    fn close(self: Box<Self>) -> Result<(), RecordError>;
}

impl Recorder for SigmfRecorder {
    fn push(&mut self, slot: &PingSlot) -> Result<u64, RecordError> {
        self.push(&slot.plan, &slot.output)
    }
    fn close(self: Box<Self>) -> Result<(), RecordError> {
        (*self).close()
    }
}

impl Recorder for WavRecorder {
    fn push(&mut self, slot: &PingSlot) -> Result<u64, RecordError> {
        self.push(&slot.plan, &slot.output)
    }
    fn close(self: Box<Self>) -> Result<(), RecordError> {
        (*self).close()
    }
}

impl Recorder for McapRecorder {
    fn push(&mut self, slot: &PingSlot) -> Result<u64, RecordError> {
        self.push(&slot.plan, &slot.output).map(|()| 0)
    }
    fn close(self: Box<Self>) -> Result<(), RecordError> {
        (*self).close()
    }
}

/// A recording of one sonar's pings.
pub(super) struct SampleFile {
    name: String,
    kind: &'static str,
    recording: Recording<Box<dyn Recorder>>,
    outcome: Result<(), RecordError>,
    counts: Arc<Counts>,
}

#[derive(Default)]
struct Counts {
    pings: AtomicU64,
    saturated: AtomicU64,
}

impl SampleFile {
    fn open(
        kind: &'static str,
        extension: &'static str,
        context: &OutputContext,
        begin: impl FnMut(&Path, UtcNs) -> Result<Box<dyn Recorder>, RecordError> + Send + 'static,
    ) -> Result<Self, OutputError> {
        let recording = context.recording(extension, begin, |recorder, _| recorder.close())?;
        Ok(Self {
            name: context.unit.spec.name.clone(),
            kind,
            // The configuration check ensures that the folder is set.
            recording: recording.expect("a folder of recordings"),
            outcome: Ok(()),
            counts: Arc::default(),
        })
    }

    fn push(&mut self, slot: &PingSlot) {
        if !self.recording.is_on() {
            return;
        }
        match self.recording.write(|recorder| recorder.push(slot)) {
            Ok(None) => {}
            Ok(Some(saturated)) => {
                self.counts.pings.fetch_add(1, Ordering::Relaxed);
                self.counts
                    .saturated
                    .fetch_add(saturated, Ordering::Relaxed);
            }
            Err(error) => self.outcome = Err(error),
        }
    }
}

/// Opens the SigMF recording of a sonar.
pub(super) fn sigmf(
    output: &SigmfSpec,
    context: &OutputContext,
) -> Result<SampleFile, OutputError> {
    let (sonar, arrays) = (context.unit.spec.clone(), output.arrays.clone());
    SampleFile::open("sigmf", "sigmf-data", context, move |path, _| {
        // The recorder adds the extensions of its files.
        let recorder = SigmfRecorder::create(&path.with_extension(""), &arrays, &sonar)?;
        Ok(Box::new(recorder))
    })
}

/// Opens the WAV recording of a sonar.
pub(super) fn wav(output: &WavSpec, context: &OutputContext) -> Result<SampleFile, OutputError> {
    let (sonar, output) = (context.unit.spec.clone(), output.clone());
    SampleFile::open("wav", "wav", context, move |path, _| {
        Ok(Box::new(WavRecorder::create(path, &output, &sonar)?))
    })
}

/// Opens the MCAP recording of a sonar.
pub(super) fn mcap(output: &McapSpec, context: &OutputContext) -> Result<SampleFile, OutputError> {
    let (sonar, output) = (context.unit.spec.clone(), *output);
    SampleFile::open("mcap", "mcap", context, move |path, _| {
        Ok(Box::new(McapRecorder::create(path, &output, &sonar)?))
    })
}

impl Output for SampleFile {
    fn addresses(&self) -> Vec<String> {
        let path = match self.kind {
            "sigmf" => self.recording.path().with_extension(""),
            _ => self.recording.path().to_owned(),
        };
        vec![format!(
            "{} {} file {}",
            self.kind,
            self.name,
            path.display()
        )]
    }

    fn report(&self) -> Arc<dyn Report> {
        Arc::new(FileReport {
            name: self.name.clone(),
            kind: self.kind,
            counts: Arc::clone(&self.counts),
        })
    }

    fn encode(&mut self, slot: &PingSlot) {
        self.push(slot);
    }

    fn deliver(&mut self) -> Result<(), OutputError> {
        Ok(std::mem::replace(&mut self.outcome, Ok(()))?)
    }

    fn close(self: Box<Self>) -> Result<(), OutputError> {
        Ok(self.recording.close()?)
    }
}

struct FileReport {
    name: String,
    kind: &'static str,
    counts: Arc<Counts>,
}

impl Report for FileReport {
    fn lines(&self) -> Vec<String> {
        vec![format!(
            "{} {}: {} pings recorded, {} values clipped at full scale",
            self.kind,
            self.name,
            self.counts.pings.load(Ordering::Relaxed),
            self.counts.saturated.load(Ordering::Relaxed),
        )]
    }
}
