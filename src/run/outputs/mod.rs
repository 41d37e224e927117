//! What leaves the house live: the configured outputs of one sonar, one file per family, all fed by the same pings.

mod files;
mod imagenex872;
mod jsf;
mod page;
mod ping_protocol;
mod server_counts;
mod sevenk;
mod vita49;
mod wbms;
mod xtf;

use std::sync::Arc;

use chrono::DateTime;
use thiserror::Error;

use crate::config::spec::{OutputSpec, RigSpec};
use crate::io::record::RecordError;
use crate::io::sonar::{OpenError, RigTime};
use crate::run::rig::{PingSlot, SonarUnit};
use crate::run::settings::SettingsStore;
use crate::time::UtcNs;

use page::Page;
pub use page::PageOpening;

pub(super) use jsf::row_filter;

#[derive(Debug, Error)]
pub enum OutputError {
    #[error("output {name}: {source}")]
    Server { name: String, source: OpenError },
    #[error("output {name}: cannot send: {source}")]
    Sender {
        name: String,
        source: std::io::Error,
    },
    #[error("output {name}: serial line {path}: {source}")]
    Line {
        name: String,
        path: String,
        source: std::io::Error,
    },
    #[error(transparent)]
    Record(#[from] RecordError),
}

/// One configured output. It belongs to its sonar's delivery thread; what its clients do never holds that thread up.
trait Output: Send {
    /// Where it listens or sends to, `FAMILY NAME TRANSPORT ADDRESS`, a line each.
    fn addresses(&self) -> Vec<String>;
    /// Its counters, to be read from another thread.
    fn report(&self) -> Arc<dyn Report>;
    /// Makes the records of a ping that somebody wants. The ping waits for its deadline meanwhile.
    fn encode(&mut self, slot: &PingSlot);
    /// Hands over what [`Self::encode`] made, at the deadline. The clients get theirs whatever becomes of a recorder.
    fn deliver(&mut self) -> Result<(), OutputError>;
    /// Closes its recorder. A server closes when its last handle goes.
    fn close(self: Box<Self>) -> Result<(), OutputError>;
}

/// The counters of one output as text.
pub trait Report: Send + Sync {
    /// A line for the output, and one for every client.
    fn lines(&self) -> Vec<String>;
    /// The same of every client in numbers.
    fn streams(&self) -> Vec<StreamCounts> {
        Vec::new()
    }
}

/// Writes with the recorder, if there is one. What a recorder that fails has written is kept, and nothing more is tried.
fn record<R>(
    recorder: &mut Option<R>,
    write: impl FnOnce(&mut R) -> Result<(), RecordError>,
) -> Result<(), OutputError> {
    let outcome = recorder.as_mut().map_or(Ok(()), write);
    if outcome.is_err() {
        *recorder = None;
    }
    Ok(outcome?)
}

/// What one client has had.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize)]
pub struct StreamCounts {
    pub family: &'static str,
    /// `TCP 127.0.0.1:51234`.
    pub peer: String,
    pub bytes_sent: u64,
    pub records_sent: u64,
    pub records_dropped: u64,
    pub queued_bytes: u64,
}

/// What an output is opened with.
struct Opening<'a> {
    spec: &'a RigSpec,
    unit: &'a SonarUnit,
    settings: &'a Arc<SettingsStore>,
    rig_time: &'a RigTime,
}

impl Opening<'_> {
    /// `NAME-20140801T000010.EXTENSION`: one run's recording does not overwrite another's.
    fn file_name(&self, utc: UtcNs, extension: &str) -> String {
        let stamp = DateTime::from_timestamp_nanos(utc.0).format("%Y%m%dT%H%M%S");
        format!("{}-{stamp}.{extension}", self.unit.spec.name)
    }
}

/// The outputs of one sonar.
pub struct Outputs {
    all: Vec<Box<dyn Output>>,
}

/// Reads the outputs' counters from another thread.
pub struct OutputReports {
    all: Vec<Arc<dyn Report>>,
}

impl Outputs {
    pub fn open(
        spec: &RigSpec,
        unit: &SonarUnit,
        settings: &Arc<SettingsStore>,
        rig_time: &RigTime,
        page: Option<PageOpening>,
    ) -> Result<Self, OutputError> {
        let opening = Opening {
            spec,
            unit,
            settings,
            rig_time,
        };
        let mut all = unit
            .spec
            .outputs
            .iter()
            .map(|output| -> Result<Box<dyn Output>, OutputError> {
                Ok(match output {
                    OutputSpec::SevenK(output) => Box::new(sevenk::SevenK::open(output, &opening)?),
                    OutputSpec::Jsf(output) => Box::new(jsf::Jsf::open(output, &opening)?),
                    OutputSpec::Xtf(output) => Box::new(xtf::Xtf::open(output, &opening)?),
                    OutputSpec::Imagenex872(output) => {
                        Box::new(imagenex872::Imagenex872::open(output, &opening)?)
                    }
                    OutputSpec::Vita49(output) => Box::new(vita49::Vita49::open(output, &opening)?),
                    OutputSpec::Sigmf(output) => Box::new(files::sigmf(output, &opening)?),
                    OutputSpec::Ping(output) => {
                        Box::new(ping_protocol::PingProtocol::open(output, &opening)?)
                    }
                    OutputSpec::Wbms(output) => Box::new(wbms::Wbms::open(output, &opening)?),
                    OutputSpec::Wav(output) => Box::new(files::wav(output, &opening)?),
                })
            })
            .collect::<Result<Vec<_>, _>>()?;
        // Last, after everything that a topside waits for.
        all.extend(page.map(|page| -> Box<dyn Output> { Box::new(Page::new(&unit.spec, page)) }));
        Ok(Self { all })
    }

    /// Where each output listens or sends to.
    pub fn addresses(&self) -> Vec<String> {
        self.all.iter().flat_map(|out| out.addresses()).collect()
    }

    pub fn reports(&self) -> OutputReports {
        OutputReports {
            all: self.all.iter().map(|out| out.report()).collect(),
        }
    }

    /// Makes the records of a ping that somebody wants.
    pub fn encode(&mut self, slot: &PingSlot) {
        for out in &mut self.all {
            out.encode(slot);
        }
    }

    /// Hands over what [`Self::encode`] made: every output its own, and the first error of any.
    pub fn deliver(&mut self) -> Result<(), OutputError> {
        let mut outcome = Ok(());
        for out in &mut self.all {
            let this = out.deliver();
            outcome = outcome.and(this);
        }
        outcome
    }

    /// Closes the recorders.
    pub fn close(self) -> Result<(), OutputError> {
        let mut outcome = Ok(());
        for out in self.all {
            let this = out.close();
            outcome = outcome.and(this);
        }
        outcome
    }
}

impl OutputReports {
    /// A line per output and client.
    pub fn lines(&self) -> Vec<String> {
        self.all.iter().flat_map(|report| report.lines()).collect()
    }

    /// Every client of every output.
    pub fn streams(&self) -> Vec<StreamCounts> {
        let reports = self.all.iter();
        reports.flat_map(|report| report.streams()).collect()
    }
}
