//! Live outputs of one sonar: one module per protocol family. All outputs receive the same pings.

mod elements;
mod files;
mod imagenex872;
mod jsf;
mod page;
mod ping_protocol;
pub(crate) mod recording;
mod server_counts;
mod sevenk;
mod vita49;
mod wbms;
mod xtf;

use std::net::SocketAddr;
use std::ops::Range;
use std::path::Path;
use std::sync::Arc;

use thiserror::Error;

use crate::clock::Clock;
use crate::faults::link::{FaultyLink, LinkMark, RecordLayout};
use crate::histograms::Histograms;
use crate::io::datagrams::SendTimes;
use crate::io::link::Link as OutputLink;
use crate::io::pace::Sending;
use crate::io::record::RecordError;
use crate::io::sonar::{OpenError, RigTime, ServerSpec, ServerTimes, SonarServer, WhenFull};
use crate::settings::SettingsStore;
use echotank_config::spec::{ClockSpec, DeliverySpec, OutputSpec, RigSpec, RunSpec};
use echotank_core::ping::PingPlan;
use echotank_core::time::{MonoNs, UtcNs};
use echotank_emit::session::Protocol;
use echotank_ping::rig::{PingSlot, SonarUnit};

use page::Page;
pub use page::PageContext;
use recording::{End, Place, Recording, Recordings};

pub(super) use jsf::row_filter;

/// Errors of opening an output or of its recorder.
#[derive(Debug, Error)]
pub enum OutputError {
    /// A server cannot listen.
    #[error("output {name}: {source}")]
    Server {
        /// The configured name of the sonar.
        name: String,
        /// The cause.
        source: OpenError,
    },
    /// A datagram socket cannot be opened.
    #[error("output {name}: cannot send: {source}")]
    Sender {
        /// The configured name of the sonar.
        name: String,
        /// The cause.
        source: std::io::Error,
    },
    /// A serial port cannot be opened.
    #[error("output {name}: serial line {path}: {source}")]
    Line {
        /// The configured name of the sonar.
        name: String,
        /// The device file of the port.
        path: String,
        /// The cause.
        source: std::io::Error,
    },
    /// A recording cannot be written.
    #[error(transparent)]
    Record(#[from] RecordError),
}

/// A configured output, owned by the delivery thread of its sonar. Slow clients never block that thread.
trait Output: Send {
    /// Addresses of the output, one line each: `FAMILY NAME TRANSPORT ADDRESS`.
    fn addresses(&self) -> Vec<String>;
    /// Counters of the output, readable from another thread.
    fn report(&self) -> Arc<dyn Report>;
    /// Makes the records of a ping that a client or recorder wants, before the deadline of the ping.
    fn encode(&mut self, slot: &PingSlot);
    /// Sends the records of [`Self::encode`] at the deadline. Clients receive them even if the recorder fails.
    fn deliver(&mut self) -> Result<(), OutputError>;
    /// Whether the output sends samples while the ping is received: [`Self::stream`] then replaces `encode` and `deliver`.
    fn is_stream(&self) -> bool {
        false
    }
    /// Makes the packets of a range of a ping's samples and schedules each packet at its time.
    ///
    /// `pulse` is the start of the pulse on the rig's clock; `None` sends all packets at once.
    fn stream(&mut self, slot: &PingSlot, samples: Range<usize>, pulse: Option<MonoNs>) {
        let _ = (slot, samples, pulse);
    }
    /// Closes the recorder of the output. A server closes when its last handle is dropped.
    fn close(self: Box<Self>) -> Result<(), OutputError> {
        Ok(())
    }
}

/// Counters of one output.
pub trait Report: Send + Sync {
    /// Text: one line for the output and one per client.
    fn lines(&self) -> Vec<String>;
    /// Counters of every client.
    fn streams(&self) -> Vec<StreamCounts> {
        Vec::new()
    }
}

/// Whether there is a recording that takes the next ping.
fn is_recorded<R: Send + 'static>(recording: &mut Option<Recording<R>>) -> bool {
    recording.as_mut().is_some_and(Recording::is_on)
}

/// Closes the recording, if there is one.
fn close<R: Send + 'static>(recording: Option<Recording<R>>) -> Result<(), OutputError> {
    Ok(recording.map_or(Ok(()), Recording::close)?)
}

/// Writes to the recording, if there is one.
fn record<R: Send + 'static>(
    recording: &mut Option<Recording<R>>,
    write: impl FnOnce(&mut R) -> Result<(), RecordError>,
) -> Result<(), OutputError> {
    if let Some(recording) = recording {
        recording.write(write)?;
    }
    Ok(())
}

/// Counters of one client or datagram receiver.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize)]
pub struct StreamCounts {
    /// The protocol family, for example `7k` or `jsf-data`.
    pub family: &'static str,
    /// Transport and address, for example `TCP 127.0.0.1:51234`.
    pub peer: String,
    /// The subscribed record types, for families with subscriptions.
    pub(crate) receives: String,
    /// Bytes sent so far.
    pub bytes_sent: u64,
    /// Records or packets sent so far.
    pub records_sent: u64,
    /// Records dropped because the queue was full, or packets that failed.
    pub records_dropped: u64,
    /// Bytes waiting in the client's queue.
    pub queued_bytes: u64,
}

/// Context in which an output is opened.
struct OutputContext<'a> {
    spec: &'a RigSpec,
    unit: &'a SonarUnit,
    settings: &'a Arc<SettingsStore>,
    rig_time: &'a RigTime,
    clock: &'a Arc<dyn Clock>,
    sending: Sending,
    spread: Spread,
    mark: Arc<LinkMark>,
    recordings: &'a Arc<Recordings>,
}

/// Spread of the datagrams of a ping over time.
#[derive(Clone, Copy)]
struct Spread {
    /// System time per ping period over which datagrams are spread, as a fraction of the rig's period; 0 sends at once.
    share: f64,
    /// Block length and latency after the block's end of streaming outputs, seconds.
    streaming: Option<(f64, f64)>,
}

impl Spread {
    fn of(run: &RunSpec) -> Self {
        let machine_per_rig = match run.clock {
            ClockSpec::RealTime => 1.0,
            ClockSpec::Scaled(rate) => 1.0 / rate,
            // These clocks have no fixed ping period.
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

    /// Send times of the blocks of a ping whose pulse starts at `pulse`.
    fn send_times(self, pulse: Option<MonoNs>) -> SendTimes {
        match (self.streaming, pulse) {
            (Some((_, latency_s)), Some(pulse)) => SendTimes::AsReceived { pulse, latency_s },
            _ => SendTimes::Over(0.0),
        }
    }

    /// Seconds of system time over which this ping's datagrams are sent; 0 sends at once.
    fn over_s(self, plan: &PingPlan) -> f64 {
        match plan.ping_rate_hz > 0.0 {
            true => self.share / plan.ping_rate_hz,
            false => 0.0,
        }
    }
}

/// Maximum number of tiles of a ping in the send queue. Each tile is twice as long as the one before.
const MAX_TILES: usize = 16;

impl OutputContext<'_> {
    /// Opens one configured output.
    fn output(&self, output: &OutputSpec) -> Result<Box<dyn Output>, OutputError> {
        Ok(match output {
            OutputSpec::SevenK(output) => Box::new(sevenk::SevenK::open(output, self)?),
            OutputSpec::Jsf(output) => Box::new(jsf::Jsf::open(output, self)?),
            OutputSpec::Xtf(output) => Box::new(xtf::Xtf::open(output, self)?),
            OutputSpec::Imagenex872(output) => {
                Box::new(imagenex872::Imagenex872::open(output, self)?)
            }
            OutputSpec::Vita49(output) => Box::new(vita49::Vita49::open(output, self)?),
            OutputSpec::Elements(output) => Box::new(elements::Elements::open(output, self)?),
            OutputSpec::Sigmf(output) => Box::new(files::sigmf(output, self)?),
            OutputSpec::Mcap(output) => Box::new(files::mcap(output, self)?),
            OutputSpec::Ping(output) => Box::new(ping_protocol::PingProtocol::open(output, self)?),
            OutputSpec::Wbms(output) => Box::new(wbms::Wbms::open(output, self)?),
            OutputSpec::Wav(output) => Box::new(files::wav(output, self)?),
        })
    }

    /// Capacity of the send queue, in pings or tiles of pings.
    fn queue(&self) -> usize {
        let tiles = if self.spec.run.stream_tiles {
            MAX_TILES
        } else {
            1
        };
        tiles * self.spec.run.queue_pings
    }

    /// Link that injects faults into the records of this output.
    fn line(&self, layout: RecordLayout) -> Box<dyn OutputLink> {
        let faults = Arc::clone(&self.unit.faults);
        Box::new(FaultyLink::new(faults, layout, Arc::clone(&self.mark)))
    }

    /// Starts a server for `protocol` on TCP, and on UDP if `udp`. A client misses records if its queue of `client_queue_bytes` is full.
    fn serve(
        &self,
        protocol: Arc<dyn Protocol>,
        listen: SocketAddr,
        udp: bool,
        client_queue_bytes: usize,
        max_clients: usize,
    ) -> Result<SonarServer, OutputError> {
        let server = ServerSpec {
            listen,
            tcp: true,
            udp,
            client_queue_bytes,
            when_full: WhenFull::Skip,
            max_clients,
        };
        let rig_time = Arc::clone(self.rig_time);
        SonarServer::start(&server, protocol, rig_time, ServerTimes::default())
            .map_err(|source| self.server_error(source))
    }

    fn server_error(&self, source: OpenError) -> OutputError {
        OutputError::Server {
            name: self.unit.spec.name.clone(),
            source,
        }
    }

    /// Sets a server's link faults and its pacing.
    fn configure(&self, server: &SonarServer, layout: RecordLayout) {
        server.set_link(self.line(layout));
        server.set_sending(self.sending.clone());
        server.set_paces_tcp(self.spec.run.pace_tcp);
    }

    /// Opens a recording in the folder of recordings, with its first file if recording is on; `None` if the configuration names no folder.
    fn recording<R: Send + 'static>(
        &self,
        extension: &'static str,
        begin: impl FnMut(&Path, UtcNs) -> Result<R, RecordError> + Send + 'static,
        end: End<R>,
    ) -> Result<Option<Recording<R>>, RecordError> {
        let Some(record) = &self.spec.record else {
            return Ok(None);
        };
        let place = Place {
            directory: record.directory.clone(),
            name: self.unit.spec.name.clone(),
            extension,
            time: Arc::clone(self.rig_time),
        };
        Recording::open(place, Box::new(begin), end, Arc::clone(self.recordings)).map(Some)
    }
}

/// Outputs of one sonar.
pub(crate) struct Outputs {
    all: Vec<MarkedOutput>,
    recordings: Arc<Recordings>,
}

/// An output and the ping to which its link faults refer.
struct MarkedOutput {
    output: Box<dyn Output>,
    mark: Arc<LinkMark>,
}

/// Reads the outputs' counters from another thread.
pub struct OutputReports {
    all: Vec<Arc<dyn Report>>,
    recordings: Arc<Recordings>,
}

impl Outputs {
    /// Opens every configured output of `unit`, and the output to the operator's page if `page` is given.
    pub(crate) fn open(
        spec: &RigSpec,
        unit: &SonarUnit,
        settings: &Arc<SettingsStore>,
        rig_time: &RigTime,
        clock: &Arc<dyn Clock>,
        histograms: &Arc<Histograms>,
        page: Option<PageContext>,
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
        let recordings = Arc::<Recordings>::default();
        recordings.switch(spec.record.as_ref().is_none_or(|record| record.at_start));
        let mut all = unit
            .spec
            .outputs
            .iter()
            .map(|output| -> Result<MarkedOutput, OutputError> {
                let context = OutputContext {
                    spec,
                    unit,
                    settings,
                    rig_time,
                    clock,
                    sending: sending.clone(),
                    spread: Spread::of(&spec.run),
                    mark: Arc::default(),
                    recordings: &recordings,
                };
                Ok(MarkedOutput {
                    output: context.output(output)?,
                    mark: context.mark,
                })
            })
            .collect::<Result<Vec<_>, _>>()?;
        // The page is last, so that it does not delay the sonar's clients. It has no link faults.
        all.extend(page.map(|page| MarkedOutput {
            output: Box::new(Page::new(&unit.spec, page)),
            mark: Arc::default(),
        }));
        Ok(Self { all, recordings })
    }

    /// Addresses that the outputs listen on or send to.
    pub(crate) fn addresses(&self) -> Vec<String> {
        self.all
            .iter()
            .flat_map(|out| out.output.addresses())
            .collect()
    }

    pub(crate) fn reports(&self) -> OutputReports {
        OutputReports {
            all: self.all.iter().map(|out| out.output.report()).collect(),
            recordings: Arc::clone(&self.recordings),
        }
    }

    /// Splits into outputs sent at the end of a ping and streaming outputs.
    pub(crate) fn split(self) -> (Self, Self) {
        let (streams, rest) = self.all.into_iter().partition(|out| out.output.is_stream());
        let recordings = Arc::clone(&self.recordings);
        let of = |all| Self {
            all,
            recordings: Arc::clone(&recordings),
        };
        (of(rest), of(streams))
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.all.is_empty()
    }

    /// Streams a range of a ping's samples, each at its time of reception.
    pub(crate) fn stream(&mut self, slot: &PingSlot, samples: Range<usize>, pulse: Option<MonoNs>) {
        for out in &mut self.all {
            out.mark.set(&slot.plan);
            out.output.stream(slot, samples.clone(), pulse);
        }
    }

    /// Makes the records of a ping that a client or recorder wants.
    pub(crate) fn encode(&mut self, slot: &PingSlot) {
        for out in &mut self.all {
            out.mark.set(&slot.plan);
            out.output.encode(slot);
        }
    }

    /// Sends the records of [`Self::encode`]. Calls `failed` for each recorder that stops.
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
    /// One line per output, per client and per recording that has stopped.
    pub fn lines(&self) -> Vec<String> {
        let reports = self.all.iter().flat_map(|report| report.lines());
        reports.chain(self.recordings.lines()).collect()
    }

    /// Recordings of the outputs.
    pub(crate) fn recordings(&self) -> &Arc<Recordings> {
        &self.recordings
    }

    /// Counters of every client of every output.
    pub fn streams(&self) -> Vec<StreamCounts> {
        let reports = self.all.iter();
        reports.flat_map(|report| report.streams()).collect()
    }
}
