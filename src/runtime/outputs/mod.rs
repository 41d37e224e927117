//! What leaves the house live: the configured outputs of one sonar, one file per family, all fed by the same pings.

mod elements;
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

use std::ops::Range;
use std::sync::Arc;

use chrono::DateTime;
use thiserror::Error;

use crate::clock::Clock;
use crate::faults::link::{Line, LineMark, Shape};
use crate::histograms::Histograms;
use crate::io::datagrams::Leaving;
use crate::io::line::Line as Passage;
use crate::io::pace::Sending;
use crate::io::record::RecordError;
use crate::io::sonar::{OpenError, RigTime, SonarServer};
use crate::settings::SettingsStore;
use echotank_config::spec::{ClockSpec, DeliverySpec, OutputSpec, RigSpec, RunSpec};
use echotank_core::flow::PingPlan;
use echotank_core::time::{MonoNs, UtcNs};
use echotank_ping::rig::{PingSlot, SonarUnit};

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
    /// It leaves by itself, as its samples would be heard: [`Self::stream`] is called, and neither `encode` nor `deliver`.
    fn is_stream(&self) -> bool {
        false
    }
    /// Makes the packets of some of a ping's samples, and lets them leave each at its time. The pulse begins at this instant of the rig's clock;
    /// none: all leave at once.
    fn stream(&mut self, slot: &PingSlot, samples: Range<usize>, pulse: Option<MonoNs>) {
        let _ = (slot, samples, pulse);
    }
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
    /// What it subscribed to, where the family has names for it.
    pub(crate) receives: String,
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
    clock: &'a Arc<dyn Clock>,
    sending: Sending,
    spread: Spread,
    mark: Arc<LineMark>,
}

/// How a ping's datagrams are spread.
#[derive(Clone, Copy)]
struct Spread {
    /// Machine time per rig time, times the configured share; 0: not at all.
    share: f64,
    /// Length of the blocks of those that stream, and how long after its end each leaves, seconds.
    streaming: Option<(f64, f64)>,
}

impl Spread {
    fn of(run: &RunSpec) -> Self {
        let machine_per_rig = match run.clock {
            ClockSpec::RealTime => 1.0,
            ClockSpec::Scaled(rate) => 1.0 / rate,
            // The next ping comes when it comes.
            ClockSpec::Fast | ClockSpec::Lockstep => 0.0,
        };
        Self {
            share: run.spread_share.unwrap_or(0.0) * machine_per_rig,
            streaming: match run.delivery {
                DeliverySpec::PingEnd => None,
                DeliverySpec::Streaming { block_s, latency_s } => Some((block_s, latency_s)),
            },
        }
    }

    fn block_s(self) -> Option<f64> {
        self.streaming.map(|(block_s, _)| block_s)
    }

    /// When the blocks of a ping leave whose pulse begins then.
    fn leaving(self, pulse: Option<MonoNs>) -> Leaving {
        match (self.streaming, pulse) {
            (Some((_, latency_s)), Some(pulse)) => Leaving::AsHeard { pulse, latency_s },
            _ => Leaving::Over(0.0),
        }
    }

    /// Seconds of the machine's time over which this ping's datagrams leave; 0: at once.
    fn over_s(self, plan: &PingPlan) -> f64 {
        match plan.ping_rate_hz > 0.0 {
            true => self.share / plan.ping_rate_hz,
            false => 0.0,
        }
    }
}

/// Tiles of a ping that wait to leave, at most: each is twice as long as the one before.
const MAX_TILES: usize = 16;

impl Opening<'_> {
    /// Pings, or tiles of pings, that may wait to be sent.
    fn queue(&self) -> usize {
        let tiles = if self.spec.run.stream_tiles {
            MAX_TILES
        } else {
            1
        };
        tiles * self.spec.run.queue_pings
    }

    /// What everything that this output hands over passes on its way.
    fn line(&self, shape: Shape) -> Box<dyn Passage> {
        let faults = Arc::clone(&self.unit.faults);
        Box::new(Line::new(faults, shape, Arc::clone(&self.mark)))
    }

    /// What a server's records pass on their way, and how they are spread.
    fn lay(&self, server: &SonarServer, shape: Shape) {
        server.set_line(self.line(shape));
        server.set_sending(self.sending.clone());
        server.set_paces_tcp(self.spec.run.pace_tcp);
    }

    /// `NAME-20140801T000010.EXTENSION`: one run's recording does not overwrite another's.
    fn file_name(&self, utc: UtcNs, extension: &str) -> String {
        let stamp = DateTime::from_timestamp_nanos(utc.0).format("%Y%m%dT%H%M%S");
        format!("{}-{stamp}.{extension}", self.unit.spec.name)
    }
}

/// The outputs of one sonar.
pub(crate) struct Outputs {
    all: Vec<Marked>,
}

/// An output, and which ping it is at: what its lines strike.
struct Marked {
    output: Box<dyn Output>,
    mark: Arc<LineMark>,
}

/// Reads the outputs' counters from another thread.
pub struct OutputReports {
    all: Vec<Arc<dyn Report>>,
}

impl Outputs {
    pub(crate) fn open(
        spec: &RigSpec,
        unit: &SonarUnit,
        settings: &Arc<SettingsStore>,
        rig_time: &RigTime,
        clock: &Arc<dyn Clock>,
        histograms: &Arc<Histograms>,
        page: Option<PageOpening>,
    ) -> Result<Self, OutputError> {
        let lateness = {
            let histograms = Arc::clone(histograms);
            move |ns| histograms.pacing_us(ns)
        };
        let _span = tracing::info_span!("outputs", sonar = unit.spec.name).entered();
        let sending = Sending {
            priority: spec.run.priority,
            lateness: Some(Arc::new(lateness)),
        };
        let mut all = unit
            .spec
            .outputs
            .iter()
            .map(|output| -> Result<Marked, OutputError> {
                let opening = Opening {
                    spec,
                    unit,
                    settings,
                    rig_time,
                    clock,
                    sending: sending.clone(),
                    spread: Spread::of(&spec.run),
                    mark: Arc::default(),
                };
                let output: Box<dyn Output> = match output {
                    OutputSpec::SevenK(output) => Box::new(sevenk::SevenK::open(output, &opening)?),
                    OutputSpec::Jsf(output) => Box::new(jsf::Jsf::open(output, &opening)?),
                    OutputSpec::Xtf(output) => Box::new(xtf::Xtf::open(output, &opening)?),
                    OutputSpec::Imagenex872(output) => {
                        Box::new(imagenex872::Imagenex872::open(output, &opening)?)
                    }
                    OutputSpec::Vita49(output) => Box::new(vita49::Vita49::open(output, &opening)?),
                    OutputSpec::Elements(output) => {
                        Box::new(elements::Elements::open(output, &opening)?)
                    }
                    OutputSpec::Sigmf(output) => Box::new(files::sigmf(output, &opening)?),
                    OutputSpec::Ping(output) => {
                        Box::new(ping_protocol::PingProtocol::open(output, &opening)?)
                    }
                    OutputSpec::Wbms(output) => Box::new(wbms::Wbms::open(output, &opening)?),
                    OutputSpec::Wav(output) => Box::new(files::wav(output, &opening)?),
                };
                Ok(Marked {
                    output,
                    mark: opening.mark,
                })
            })
            .collect::<Result<Vec<_>, _>>()?;
        // Last, after everything that a topside waits for.
        // Nothing of it passes a line.
        all.extend(page.map(|page| Marked {
            output: Box::new(Page::new(&unit.spec, page)),
            mark: Arc::default(),
        }));
        Ok(Self { all })
    }

    /// Where each output listens or sends to.
    pub(crate) fn addresses(&self) -> Vec<String> {
        self.all
            .iter()
            .flat_map(|out| out.output.addresses())
            .collect()
    }

    pub(crate) fn reports(&self) -> OutputReports {
        OutputReports {
            all: self.all.iter().map(|out| out.output.report()).collect(),
        }
    }

    /// Those that leave at the end of a ping, and those that stream.
    pub(crate) fn split(self) -> (Self, Self) {
        let (streams, rest) = self.all.into_iter().partition(|out| out.output.is_stream());
        (Self { all: rest }, Self { all: streams })
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.all.is_empty()
    }

    /// Lets some of a ping's samples leave as they would be heard.
    pub(crate) fn stream(&mut self, slot: &PingSlot, samples: Range<usize>, pulse: Option<MonoNs>) {
        for out in &mut self.all {
            out.mark.set(&slot.plan);
            out.output.stream(slot, samples.clone(), pulse);
        }
    }

    /// Makes the records of a ping that somebody wants.
    pub(crate) fn encode(&mut self, slot: &PingSlot) {
        for out in &mut self.all {
            out.mark.set(&slot.plan);
            out.output.encode(slot);
        }
    }

    /// Hands over what [`Self::encode`] made, every output its own; `failed` is told of each recorder that stops.
    pub(crate) fn deliver(&mut self, mut failed: impl FnMut(OutputError)) {
        for out in &mut self.all {
            if let Err(error) = out.output.deliver() {
                failed(error);
            }
        }
    }

    /// Closes the recorders.
    pub(crate) fn close(self) -> Result<(), OutputError> {
        let mut outcome = Ok(());
        for out in self.all {
            let this = out.output.close();
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
