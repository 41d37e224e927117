//! Teledyne RESON 7k: a server on one TCP and UDP port, and a `.s7k` recorder.

use std::path::Path;
use std::sync::Arc;

use super::recording::Recording;
use super::server_counts::{server_lines, server_streams};
use super::{
    Output, OutputContext, OutputError, Report, Spread, StreamCounts, close, is_recorded, record,
};
use crate::faults::link::RecordLayout;
use crate::io::record::s7k::S7kRecorder;
use crate::io::sonar::{SonarServer, start_sevenk};
use crate::recorders::begin_s7k;
use crate::settings::SettingsStore;
use echotank_config::spec::SevenKSpec;
use echotank_core::records::Datagram;
use echotank_core::settings::SettingsPort;
use echotank_emit::sevenk::records::DeviceSheet;
use echotank_emit::sevenk::stored_settings::StoredSettings;
use echotank_emit::sevenk::{RecordSet, SevenKEmitter};
use echotank_ping::rig::PingSlot;

pub(super) struct SevenK {
    name: String,
    emitter: SevenKEmitter,
    server: Arc<SonarServer>,
    recorder: Option<Recording<S7kRecorder>>,
    settings: Arc<SettingsStore>,
    /// Version of the settings that the emitter reports.
    kept_version: Option<u64>,
    /// Records of the encoded ping, sent at its deadline.
    pending: Vec<Arc<Datagram>>,
    spread: Spread,
    /// Seconds over which the pending ping is sent.
    over_s: f64,
}

impl SevenK {
    pub(super) fn open(output: &SevenKSpec, context: &OutputContext) -> Result<Self, OutputError> {
        let OutputContext {
            spec,
            unit,
            settings,
            rig_time,
            ..
        } = context;
        let sheet = DeviceSheet::new(
            output,
            &unit.spec,
            spec.medium.sound_speed_m_per_s,
            unit.absorption_db_per_m,
        );
        let sheet = Arc::new(
            sheet
                .with_navigation(&spec.nav)
                .with_profile(spec.medium.profile.as_ref()),
        );
        let port: Arc<dyn SettingsPort> = Arc::clone(settings) as _;
        let server = start_sevenk(output, sheet.clone(), port, Arc::clone(rig_time))
            .map_err(|source| context.server_error(source))?;
        context.configure(&server, RecordLayout::SEVENK);
        let begin = {
            let sheet = Arc::clone(&sheet);
            move |path: &Path, utc| begin_s7k(path, &sheet, utc)
        };
        let recorder = context.recording("s7k", begin, |recorder, _| recorder.close())?;
        Ok(Self {
            name: unit.spec.name.clone(),
            emitter: SevenKEmitter::new(sheet, spec.run.queue_pings),
            server: Arc::new(server),
            recorder,
            settings: Arc::clone(settings),
            kept_version: None,
            pending: Vec::new(),
            spread: context.spread,
            over_s: 0.0,
        })
    }
}

impl Output for SevenK {
    fn addresses(&self) -> Vec<String> {
        ["tcp", "udp"]
            .map(|transport| format!("7k {} {transport} {}", self.name, self.server.local_addr()))
            .into()
    }

    fn report(&self) -> Arc<dyn Report> {
        Arc::new(SevenKReport {
            name: self.name.clone(),
            server: self.server.clone(),
        })
    }

    fn encode(&mut self, slot: &PingSlot) {
        let recorded = if is_recorded(&mut self.recorder) {
            self.emitter.sheet().file_records()
        } else {
            RecordSet::EMPTY
        };
        if self.kept_version != Some(self.settings.version()) {
            self.kept_version = Some(self.settings.version());
            self.emitter
                .set_stored(StoredSettings::of(self.settings.as_ref()));
        }
        self.pending.clear();
        self.over_s = self.spread.over_s(&slot.plan);
        self.emitter.emit_ping(
            &slot.plan,
            &slot.output,
            RecordSet::from(self.server.wanted()).union(recorded),
            &mut self.pending,
        );
    }

    fn deliver(&mut self) -> Result<(), OutputError> {
        self.server.deliver_over(&self.pending, self.over_s);
        let in_files = self.emitter.sheet().file_records();
        let mut pending = (self.pending.drain(..)).filter(|r| in_files.contains(r.record_type));
        record(&mut self.recorder, |recorder| {
            pending.try_for_each(|record| recorder.write(&record.bytes))
        })
    }

    fn close(self: Box<Self>) -> Result<(), OutputError> {
        close(self.recorder)
    }
}

struct SevenKReport {
    name: String,
    server: Arc<SonarServer>,
}

impl Report for SevenKReport {
    fn lines(&self) -> Vec<String> {
        server_lines("7k", &self.name, &self.server.report())
    }

    fn streams(&self) -> Vec<StreamCounts> {
        let report = self.server.report();
        let mut streams = server_streams("7k", &report);
        for (stream, client) in streams.iter_mut().zip(&report.clients) {
            let records = RecordSet::from(client.subscribed).iter();
            let records: Vec<_> = records.map(|id| id.to_string()).collect();
            stream.receives = records.join(" ");
        }
        streams
    }
}
