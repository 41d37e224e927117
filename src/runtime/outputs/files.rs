//! SigMF and WAV recordings of element samples. A ping is written when it is encoded, before its deadline.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use super::{Output, OutputContext, OutputError, Report};
use crate::io::record::RecordError;
use crate::io::record::sigmf::SigmfRecorder;
use crate::io::record::wav::WavRecorder;
use echotank_config::spec::{SigmfSpec, SonarSpec, WavSpec};
use echotank_ping::rig::PingSlot;

/// The path of a new recording. The configuration check ensures that the folder is set.
fn path(context: &OutputContext, extension: &str) -> Result<PathBuf, RecordError> {
    let path = context.recording((context.rig_time)(), extension)?;
    Ok(path.expect("a folder of recordings"))
}

/// A SigMF or WAV recorder.
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

/// A recording of one sonar's element samples.
pub(super) struct Recording {
    name: String,
    kind: &'static str,
    path: PathBuf,
    /// `None` after an error. The file is then closed and kept.
    recorder: Option<Box<dyn Recorder>>,
    outcome: Result<(), RecordError>,
    counts: Arc<Counts>,
}

#[derive(Default)]
struct Counts {
    pings: AtomicU64,
    saturated: AtomicU64,
}

impl Recording {
    fn of(
        kind: &'static str,
        sonar: &SonarSpec,
        path: PathBuf,
        recorder: Box<dyn Recorder>,
    ) -> Self {
        Self {
            name: sonar.name.clone(),
            kind,
            path,
            recorder: Some(recorder),
            outcome: Ok(()),
            counts: Arc::default(),
        }
    }

    fn push(&mut self, slot: &PingSlot) {
        let Some(recorder) = &mut self.recorder else {
            return;
        };
        match recorder.push(slot) {
            Ok(saturated) => {
                self.counts.pings.fetch_add(1, Ordering::Relaxed);
                self.counts
                    .saturated
                    .fetch_add(saturated, Ordering::Relaxed);
            }
            Err(error) => {
                self.recorder = None;
                self.outcome = Err(error);
            }
        }
    }
}

/// Opens the SigMF recording of a sonar.
pub(super) fn sigmf(output: &SigmfSpec, context: &OutputContext) -> Result<Recording, OutputError> {
    let sonar = &context.unit.spec;
    // The recorder adds the extensions of its files.
    let stem = path(context, "sigmf-data")?.with_extension("");
    let recorder = SigmfRecorder::create(&stem, &output.arrays, sonar)?;
    Ok(Recording::of("sigmf", sonar, stem, Box::new(recorder)))
}

/// Opens the WAV recording of a sonar.
pub(super) fn wav(output: &WavSpec, context: &OutputContext) -> Result<Recording, OutputError> {
    let sonar = &context.unit.spec;
    let path = path(context, "wav")?;
    let recorder = WavRecorder::create(&path, output, sonar)?;
    Ok(Recording::of("wav", sonar, path, Box::new(recorder)))
}

impl Output for Recording {
    fn addresses(&self) -> Vec<String> {
        vec![format!(
            "{} {} file {}",
            self.kind,
            self.name,
            self.path.display()
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
        Ok(self.recorder.map_or(Ok(()), |recorder| recorder.close())?)
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
