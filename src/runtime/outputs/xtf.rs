//! Triton XTF: a file recorder.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use super::recording::Recording;
use super::{Output, OutputContext, OutputError, Report, close, is_recorded, record};
use crate::io::record::stream::StreamRecorder;
use echotank_config::spec::XtfSpec;
use echotank_emit::xtf::XtfEmitter;
use echotank_ping::rig::PingSlot;

pub(super) struct Xtf {
    emitter: XtfEmitter,
    recorder: Option<Recording<StreamRecorder>>,
    /// Packets of the encoded ping, written at its deadline.
    pending: Vec<u8>,
    report: Arc<XtfReport>,
}

impl Xtf {
    pub(super) fn open(output: &XtfSpec, context: &OutputContext) -> Result<Self, OutputError> {
        let c = context.spec.medium.sound_speed_m_per_s;
        let emitter = XtfEmitter::new(output, &context.unit.spec, c);
        // The configuration check ensures that the folder is set.
        let head = emitter.file_head();
        let recorder = context.recording(
            "xtf",
            move |path, _| StreamRecorder::create(path, &head),
            |recorder, _| recorder.close(&[]),
        )?;
        Ok(Self {
            emitter,
            recorder,
            pending: Vec::new(),
            report: Arc::new(XtfReport {
                name: context.unit.spec.name.clone(),
                bytes: AtomicU64::new(0),
                saturated: AtomicU64::new(0),
            }),
        })
    }
}

impl Output for Xtf {
    fn addresses(&self) -> Vec<String> {
        let recorder = self.recorder.iter();
        recorder
            .map(|file| format!("xtf {} file {}", self.report.name, file.path().display()))
            .collect()
    }

    fn report(&self) -> Arc<dyn Report> {
        Arc::clone(&self.report) as _
    }

    fn encode(&mut self, slot: &PingSlot) {
        self.pending.clear();
        if is_recorded(&mut self.recorder) {
            let saturated = self
                .emitter
                .emit_ping(&slot.plan, &slot.output, &mut self.pending);
            self.report
                .saturated
                .fetch_add(saturated, Ordering::Relaxed);
        }
    }

    fn deliver(&mut self) -> Result<(), OutputError> {
        let bytes = self.pending.len() as u64;
        self.report.bytes.fetch_add(bytes, Ordering::Relaxed);
        record(&mut self.recorder, |recorder| recorder.write(&self.pending))
    }

    fn close(self: Box<Self>) -> Result<(), OutputError> {
        close(self.recorder)
    }
}

struct XtfReport {
    name: String,
    bytes: AtomicU64,
    saturated: AtomicU64,
}

impl Report for XtfReport {
    fn lines(&self) -> Vec<String> {
        vec![format!(
            "xtf {}: {:.1} MB written, {} samples saturated",
            self.name,
            self.bytes.load(Ordering::Relaxed) as f64 / 1e6,
            self.saturated.load(Ordering::Relaxed),
        )]
    }
}
