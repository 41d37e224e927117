//! What leaves the house live: one server per configured output, and the recorder behind it.

use std::sync::Arc;

use chrono::DateTime;
use thiserror::Error;

use crate::config::spec::{OutputSpec, RigSpec, SonarSpec};
use crate::emit::sevenk::records::DeviceSheet;
use crate::emit::sevenk::{RecordSet, SevenKEmitter};
use crate::flow::{Datagram, SettingsPort};
use crate::io::record::s7k::S7kRecorder;
use crate::io::record::{RecordError, make_folder};
use crate::io::sonar::{OpenError, RigTime, SonarServer};
use crate::run::recorders::begin_s7k;
use crate::run::rig::{PingSlot, SonarUnit};
use crate::run::settings::SettingsStore;
use crate::time::UtcNs;

#[derive(Debug, Error)]
pub enum OutputError {
    #[error("output {name}: {source}")]
    Server { name: String, source: OpenError },
    #[error(transparent)]
    Record(#[from] RecordError),
}

/// One 7k output.
struct SevenK {
    name: String,
    emitter: SevenKEmitter,
    server: Arc<SonarServer>,
    recorder: Option<S7kRecorder>,
    /// Records of the ping that waits for its deadline.
    pending: Vec<Arc<Datagram>>,
}

/// The outputs of one sonar; they belong to its delivery thread.
pub struct Outputs {
    sevenk: Vec<SevenK>,
}

/// Reads the servers' counters from another thread.
pub struct OutputReports {
    servers: Vec<(String, Arc<SonarServer>)>,
}

impl Outputs {
    pub fn open(
        spec: &RigSpec,
        unit: &SonarUnit,
        settings: &Arc<SettingsStore>,
        rig_time: &RigTime,
    ) -> Result<Self, OutputError> {
        let mut sevenk = Vec::new();
        for output in &unit.spec.outputs {
            let OutputSpec::SevenK(output) = output;
            let sheet = Arc::new(DeviceSheet::new(
                output,
                &unit.spec,
                spec.medium.sound_speed_m_per_s,
                unit.absorption_db_per_m,
            ));
            let port: Arc<dyn SettingsPort> = settings.clone();
            let server = SonarServer::start(output, sheet.clone(), port, rig_time.clone())
                .map_err(|source| OutputError::Server {
                    name: unit.spec.name.clone(),
                    source,
                })?;
            let recorder = match &spec.record {
                None => None,
                Some(record) => {
                    make_folder(&record.directory)?;
                    let now = rig_time();
                    let path = record.directory.join(file_name(&unit.spec, now));
                    Some(begin_s7k(&path, &sheet, now)?)
                }
            };
            sevenk.push(SevenK {
                name: unit.spec.name.clone(),
                emitter: SevenKEmitter::new(sheet, spec.run.queue_pings),
                server: Arc::new(server),
                recorder,
                pending: Vec::new(),
            });
        }
        Ok(Self { sevenk })
    }

    /// Where each output listens, `7k NAME tcp ADDRESS` and the same for UDP.
    pub fn addresses(&self) -> Vec<String> {
        let address = |out: &SevenK, transport: &str| {
            format!("7k {} {transport} {}", out.name, out.server.local_addr())
        };
        self.sevenk
            .iter()
            .flat_map(|out| [address(out, "tcp"), address(out, "udp")])
            .collect()
    }

    pub fn reports(&self) -> OutputReports {
        OutputReports {
            servers: self
                .sevenk
                .iter()
                .map(|out| (out.name.clone(), out.server.clone()))
                .collect(),
        }
    }

    /// Makes the records of a ping that somebody wants.
    pub fn encode(&mut self, slot: &PingSlot) {
        for out in &mut self.sevenk {
            let recorded = if out.recorder.is_some() {
                RecordSet::ALL
            } else {
                RecordSet::EMPTY
            };
            out.pending.clear();
            out.emitter.emit_ping(
                &slot.plan,
                &slot.output,
                out.server.wanted().union(recorded),
                &mut out.pending,
            );
        }
    }

    /// Hands over what [`Self::encode`] made. The clients get theirs whatever becomes of the recorder.
    pub fn deliver(&mut self) -> Result<(), OutputError> {
        let mut outcome = Ok(());
        for out in &mut self.sevenk {
            out.server.deliver(&out.pending);
            if let Some(recorder) = &mut out.recorder {
                for record in &out.pending {
                    if let Err(error) = recorder.write(&record.bytes) {
                        outcome = Err(error.into());
                        break;
                    }
                }
                if outcome.is_err() {
                    // What was written is closed and kept; nothing more is tried.
                    out.recorder = None;
                }
            }
            out.pending.clear();
        }
        outcome
    }

    /// Closes the recorders. The servers close when the last handle goes.
    pub fn close(self) -> Result<(), OutputError> {
        for out in self.sevenk {
            if let Some(recorder) = out.recorder {
                recorder.close()?;
            }
        }
        Ok(())
    }
}

/// `NAME-20140801T000010.s7k`: one run's recording does not overwrite another's.
fn file_name(spec: &SonarSpec, utc: UtcNs) -> String {
    let stamp = DateTime::from_timestamp_nanos(utc.0).format("%Y%m%dT%H%M%S");
    format!("{}-{stamp}.s7k", spec.name)
}

impl OutputReports {
    /// A line per client, and one for those that have gone.
    pub fn lines(&self) -> Vec<String> {
        let mut lines = Vec::new();
        for (name, server) in &self.servers {
            let report = server.report();
            let totals = report.totals();
            lines.push(format!(
                "7k {name}: {} clients now, {} ever, {} refused, {:.1} MB sent, {} commands, {} refused commands, {} framing errors",
                report.clients.len(),
                report.admitted,
                report.refused,
                totals.bytes_sent as f64 / 1e6,
                totals.commands,
                totals.nacks,
                totals.framing_errors,
            ));
            for client in &report.clients {
                lines.push(format!(
                    "  {} {}: {:.1} MB, {} records sent, {} dropped, {:.1} MB waiting",
                    client.transport,
                    client.peer,
                    client.counts.bytes_sent as f64 / 1e6,
                    client.counts.records_sent,
                    client.counts.records_dropped,
                    client.queued_bytes as f64 / 1e6,
                ));
            }
        }
        lines
    }
}
