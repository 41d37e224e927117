//! 7k: a server on one TCP and UDP port, and the `.s7k` recorder behind it.

use std::sync::Arc;

use super::{Opening, Output, OutputError, Report, StreamCounts};
use crate::config::spec::SevenKSpec;
use crate::emit::sevenk::records::DeviceSheet;
use crate::emit::sevenk::{RecordSet, SevenKEmitter};
use crate::flow::{Datagram, SettingsPort};
use crate::io::record::make_folder;
use crate::io::record::s7k::S7kRecorder;
use crate::io::sonar::{SonarServer, start_sevenk};
use crate::run::recorders::begin_s7k;
use crate::run::rig::PingSlot;

pub struct SevenK {
    name: String,
    emitter: SevenKEmitter,
    server: Arc<SonarServer>,
    recorder: Option<S7kRecorder>,
    /// Records of the ping that waits for its deadline.
    pending: Vec<Arc<Datagram>>,
}

impl SevenK {
    pub fn open(output: &SevenKSpec, opening: &Opening) -> Result<Self, OutputError> {
        let Opening {
            spec,
            unit,
            settings,
            rig_time,
        } = opening;
        let sheet = Arc::new(DeviceSheet::new(
            output,
            &unit.spec,
            spec.medium.sound_speed_m_per_s,
            unit.absorption_db_per_m,
        ));
        let port: Arc<dyn SettingsPort> = Arc::clone(settings) as _;
        let server =
            start_sevenk(output, sheet.clone(), port, Arc::clone(rig_time)).map_err(|source| {
                OutputError::Server {
                    name: unit.spec.name.clone(),
                    source,
                }
            })?;
        let recorder = match &spec.record {
            None => None,
            Some(record) => {
                make_folder(&record.directory)?;
                let now = rig_time();
                let path = record.directory.join(opening.file_name(now, "s7k"));
                Some(begin_s7k(&path, &sheet, now)?)
            }
        };
        Ok(Self {
            name: unit.spec.name.clone(),
            emitter: SevenKEmitter::new(sheet, spec.run.queue_pings),
            server: Arc::new(server),
            recorder,
            pending: Vec::new(),
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
        let recorded = if self.recorder.is_some() {
            RecordSet::ALL
        } else {
            RecordSet::EMPTY
        };
        self.pending.clear();
        self.emitter.emit_ping(
            &slot.plan,
            &slot.output,
            RecordSet::from(self.server.wanted()).union(recorded),
            &mut self.pending,
        );
    }

    fn deliver(&mut self) -> Result<(), OutputError> {
        self.server.deliver(&self.pending);
        let mut outcome = Ok(());
        if let Some(recorder) = &mut self.recorder {
            outcome = self
                .pending
                .iter()
                .try_for_each(|record| recorder.write(&record.bytes));
            if outcome.is_err() {
                // What was written is closed and kept; nothing more is tried.
                self.recorder = None;
            }
        }
        self.pending.clear();
        Ok(outcome?)
    }

    fn close(self: Box<Self>) -> Result<(), OutputError> {
        Ok(self.recorder.map_or(Ok(()), S7kRecorder::close)?)
    }
}

struct SevenKReport {
    name: String,
    server: Arc<SonarServer>,
}

impl Report for SevenKReport {
    /// A line per client, and one for those that have gone.
    fn lines(&self) -> Vec<String> {
        let report = self.server.report();
        let totals = report.totals();
        let mut lines = vec![format!(
            "7k {}: {} clients now, {} ever, {} refused, {:.1} MB sent, {} commands, {} refused commands, {} framing errors",
            self.name,
            report.clients.len(),
            report.admitted,
            report.refused,
            totals.bytes_sent as f64 / 1e6,
            totals.commands,
            totals.nacks,
            totals.framing_errors,
        )];
        lines.extend(report.clients.iter().map(|client| {
            format!(
                "  {} {}: {:.1} MB, {} records sent, {} dropped, {:.1} MB waiting",
                client.transport,
                client.peer,
                client.counts.bytes_sent as f64 / 1e6,
                client.counts.records_sent,
                client.counts.records_dropped,
                client.queued_bytes as f64 / 1e6,
            )
        }));
        lines
    }

    fn streams(&self) -> Vec<StreamCounts> {
        let clients = self.server.report().clients.into_iter();
        let counts = clients.map(|client| StreamCounts {
            family: "7k",
            peer: format!("{} {}", client.transport, client.peer),
            bytes_sent: client.counts.bytes_sent,
            records_sent: client.counts.records_sent,
            records_dropped: client.counts.records_dropped,
            queued_bytes: client.queued_bytes as u64,
        });
        counts.collect()
    }
}
