//! Live sources: a blocking thread per UDP socket, TCP connection or serial port, a bounded queue, and rig time.
//!
//! The threads queue raw bytes with the monotonic arrival time of the first byte. For datagrams this is the time stamp of the kernel.
//! [`Live::pull`] decodes the bytes. Until rig time is known the bytes are kept, so that every sample is decoded on the right timeline.

mod serial;
mod tcp;

pub(super) use serial::{Port, open as open_serial};

use std::cell::Cell;
use std::collections::VecDeque;
use std::net::{IpAddr, Ipv4Addr, SocketAddr, UdpSocket};
use std::sync::Arc;
use std::sync::atomic::{
    AtomicBool, AtomicU64, AtomicUsize,
    Ordering::{Acquire, Relaxed, Release},
};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use crossbeam_channel::{Receiver, Sender, bounded};
use socket2::{Domain, Protocol, Socket, Type};
use tracing::warn;

use super::recorder::NavRecorder;
use super::source_decoder::SourceDecoder;
use super::{Feed, LiveCounters, NavOpenError, SourceCounters};
use crate::clock::Clock;
use crate::io::listening::Listening;
use crate::io::stamp;
use echotank_config::spec::{NavInputSpec, NavSourceSpec, NavSpec, TimePolicy};
use echotank_core::time::{MonoNs, NS_PER_S, Timeline};
use echotank_nav::recording::Entry;

/// Maximum number of datagrams or reads that wait for decoding: 40 s of a 100 Hz sensor.
const QUEUE: usize = 4096;
/// Maximum size of the waiting data, bytes. The limit bounds memory and the decoding time after a pause of the pipeline.
const QUEUE_BYTES: usize = 8 << 20;
/// Limit of a source's data rate, bytes/s, and of a burst, bytes: a hundred times the rate of instruments. A stream beyond the limit is read
/// later. Datagrams beyond the limit are lost; shorter ones of the same source can still fit.
const SOURCE_BYTES_PER_S: f64 = 4.0 * 1024.0 * 1024.0;
const SOURCE_BURST_BYTES: f64 = 1024.0 * 1024.0;
/// Limits of the decoding in one turn of the pacer. The remaining data waits for the next turn.
const TURN_BYTES: usize = 256 * 1024;
const TURN_NS: i64 = 2_000_000;
/// Socket buffer requested from the kernel, bytes: a second of navigation at any rate. The kernel may grant less.
const SOCKET_BUFFER_BYTES: usize = 1 << 20;
/// Read timeout; the threads check the stop flag this often.
const READ_TIMEOUT: Duration = Duration::from_millis(100);
/// Pause in reading a stream whose data rate exceeds the limit.
const LIMIT_PAUSE: Duration = Duration::from_millis(5);
/// Pause before a lost serial port or connection is tried again.
const REOPEN_INTERVAL: Duration = Duration::from_secs(1);
/// Navigation time within this of the host's clock uses the host's timeline.
const HOST_TOLERANCE_NS: i64 = 2 * NS_PER_S;
/// Time of received bytes without a dated message after which the host's clock becomes rig time.
const UNDATED_LIMIT_NS: i64 = 5 * NS_PER_S;

/// Received bytes.
struct Chunk {
    /// Index into `Live::sources`.
    source: usize,
    /// Arrival of the first byte.
    mono: MonoNs,
    bytes: Vec<u8>,
}

/// Counters of a source's thread.
#[derive(Default)]
struct Stats {
    received: AtomicU64,
    dropped_full: AtomicU64,
    dropped_flood: AtomicU64,
    read_errors: AtomicU64,
    reopened: AtomicU64,
}

struct LiveSource {
    name: String,
    decoder: SourceDecoder,
    /// Decoder that searches for the first dated message before there is a timeline. `None` for sources timed by arrival.
    scout: Option<SourceDecoder>,
    address: Option<SocketAddr>,
    _listening: Option<Listening>,
    stats: Arc<Stats>,
}

pub(super) struct Live {
    sources: Vec<LiveSource>,
    chunks: Receiver<Chunk>,
    clock: Arc<dyn Clock>,
    host: Timeline,
    timeline: Option<Timeline>,
    /// Whether the timeline is set by [`NavInputs::set_timeline`](super::NavInputs::set_timeline).
    foreign: bool,
    kept: VecDeque<Chunk>,
    /// Total size of the chunks in `chunks` and `kept`, bytes.
    waiting_bytes: Arc<AtomicUsize>,
    stop: Arc<AtomicBool>,
    threads: Vec<JoinHandle<()>>,
}

impl Live {
    /// Opens the live sources. With `foreign`, rig time is set by `set_timeline`.
    pub(super) fn open(
        spec: &NavSpec,
        clock: Arc<dyn Clock>,
        foreign: bool,
    ) -> Result<Self, NavOpenError> {
        let (sender, chunks) = bounded(QUEUE);
        let host = Timeline::through(clock.mono(), clock.host_utc());
        let mut live = Self {
            sources: Vec::new(),
            chunks,
            clock,
            host,
            timeline: None,
            foreign,
            kept: VecDeque::new(),
            waiting_bytes: Arc::default(),
            stop: Arc::new(AtomicBool::new(false)),
            threads: Vec::new(),
        };
        for (index, source) in spec.sources.iter().enumerate() {
            live.start(index, source, &sender)?;
        }
        let by_messages = live.sources.iter().any(|s| s.scout.is_some());
        if !foreign && !by_messages {
            live.timeline = Some(host);
        }
        Ok(live)
    }

    fn start(
        &mut self,
        index: usize,
        spec: &NavSourceSpec,
        sender: &Sender<Chunk>,
    ) -> Result<(), NavOpenError> {
        let stats = Arc::new(Stats::default());
        let mut source = LiveSource {
            name: spec.name.clone(),
            decoder: SourceDecoder::new(index, spec),
            scout: (!matches!(spec.time, TimePolicy::Arrival { .. }))
                .then(|| SourceDecoder::new(index, spec)),
            address: None,
            _listening: None,
            stats: stats.clone(),
        };
        let outlet = Outlet {
            source: self.sources.len(),
            name: spec.name.clone(),
            sender: sender.clone(),
            clock: self.clock.clone(),
            stats,
            waiting_bytes: self.waiting_bytes.clone(),
            inflow: Cell::new((SOURCE_BURST_BYTES, Instant::now())),
            stop: self.stop.clone(),
        };
        let thread = std::thread::Builder::new().name(format!("nav {}", spec.name));
        let failed = |what: String| {
            move |reason: std::io::Error| {
                NavOpenError::source(&spec.name, format!("{what}: {reason}"))
            }
        };
        let started = match &spec.input {
            NavInputSpec::Udp { listen, multicast } => {
                let socket = open_udp(*listen, *multicast)
                    .map_err(failed(format!("cannot listen on udp {listen}")))?;
                source.address = socket.local_addr().ok();
                thread.spawn(move || read_udp(&socket, &outlet))
            }
            NavInputSpec::Serial { port, baud, line } => {
                let open = open_serial(port, *baud, *line).map_err(|reason| {
                    let what = format!("cannot open serial port {port} at {baud} baud");
                    NavOpenError::source(&spec.name, format!("{what}: {reason}"))
                })?;
                let byte_ns = source.decoder.byte_ns;
                let (port, baud, line) = (port.clone(), *baud, *line);
                thread.spawn(move || {
                    serial::read(open, || open_serial(&port, baud, line), byte_ns, &outlet);
                })
            }
            NavInputSpec::TcpConnect { address } => {
                let address = address.clone();
                thread.spawn(move || tcp::read_server(&address, &outlet))
            }
            NavInputSpec::TcpListen { listen } => {
                let listener = tcp::listen(*listen)
                    .map_err(failed(format!("cannot listen on tcp {listen}")))?;
                source.address = listener.local_addr().ok();
                thread.spawn(move || tcp::read_clients(&listener, &outlet))
            }
            NavInputSpec::Log { .. } | NavInputSpec::Csv { .. } => return Ok(()),
        };
        let handle = started.map_err(failed("cannot start its thread".into()))?;
        self.threads.push(handle);
        source._listening = source
            .address
            .map(|address| Listening::at("navigation", address));
        self.sources.push(source);
        Ok(())
    }

    pub(super) fn timeline(&self) -> Option<Timeline> {
        self.timeline
    }

    pub(super) fn set_timeline(&mut self, timeline: Timeline) {
        self.timeline.get_or_insert(timeline);
    }

    pub(super) fn listening(&self) -> Vec<(String, SocketAddr)> {
        let bound = |s: &LiveSource| Some((s.name.clone(), s.address?));
        self.sources.iter().filter_map(bound).collect()
    }

    pub(super) fn count(&self, counters: &mut [SourceCounters]) {
        for source in &self.sources {
            let Stats {
                received,
                dropped_full,
                dropped_flood,
                read_errors,
                reopened,
            } = &*source.stats;
            let SourceDecoder { index, decoder, .. } = &source.decoder;
            counters[*index].decoder = *decoder.counters();
            counters[*index].live = LiveCounters {
                received: received.load(Acquire),
                dropped_full: dropped_full.load(Relaxed),
                dropped_flood: dropped_flood.load(Relaxed),
                read_errors: read_errors.load(Relaxed),
                reopened: reopened.load(Relaxed),
            };
        }
    }

    /// Whether received bytes wait for another turn.
    pub(super) fn is_behind(&self) -> bool {
        self.timeline.is_some() && !(self.kept.is_empty() && self.chunks.is_empty())
    }

    /// Decodes received bytes, within the limits of a turn, or keeps them while rig time is unknown. `recorder` receives the decoded bytes.
    pub(super) fn pull(&mut self, feed: &mut Feed, mut recorder: Option<&mut NavRecorder>) {
        if self.timeline.is_none() {
            self.keep();
        }
        let Some(timeline) = self.timeline else {
            return;
        };
        let (begun, mut left_bytes) = (self.clock.mono(), TURN_BYTES);
        while left_bytes > 0 && self.clock.mono().0 - begun.0 < TURN_NS {
            let Some(mut chunk) = self
                .kept
                .pop_front()
                .or_else(|| self.chunks.try_recv().ok())
            else {
                return;
            };
            left_bytes = left_bytes.saturating_sub(chunk.bytes.len());
            self.waiting_bytes.fetch_sub(chunk.bytes.len(), Relaxed);
            let arrival = timeline.utc(chunk.mono);
            if let Some(recorder) = &mut recorder {
                recorder.note(Entry::Bytes {
                    source: chunk.source,
                    arrival,
                    bytes: chunk.bytes.clone(),
                });
            }
            let source = &mut self.sources[chunk.source].decoder;
            source.feed(&mut chunk.bytes, arrival, feed);
        }
    }

    /// Keeps received bytes and searches them for rig time.
    fn keep(&mut self) {
        while let Ok(chunk) = self.chunks.try_recv() {
            let source = &mut self.sources[chunk.source];
            if self.timeline.is_none()
                && !self.foreign
                && let Some(scout) = &mut source.scout
            {
                scout.look(&chunk.bytes, self.host.utc(chunk.mono));
                self.timeline = timeline_of(scout, self.host);
            }
            if self.kept.len() == QUEUE {
                let oldest = self.kept.pop_front();
                let bytes = oldest.as_ref().map_or(0, |c| c.bytes.len());
                self.waiting_bytes.fetch_sub(bytes, Relaxed);
                let source = oldest.map_or(chunk.source, |c| c.source);
                self.sources[source]
                    .stats
                    .dropped_full
                    .fetch_add(1, Relaxed);
            }
            self.kept.push_back(chunk);
        }
        let waited_ns = self
            .kept
            .front()
            .map_or(0, |first| self.clock.mono().0 - first.mono.0);
        if self.timeline.is_none() && !self.foreign && waited_ns > UNDATED_LIMIT_NS {
            self.timeline = Some(self.host);
        }
    }
}

impl Drop for Live {
    fn drop(&mut self) {
        self.stop.store(true, Relaxed);
        for thread in self.threads.drain(..) {
            // The panic hook has reported a panic of the thread.
            let _ = thread.join();
        }
    }
}

/// Rig time from the first dated message; `None` until there is one.
fn timeline_of(scout: &SourceDecoder, host: Timeline) -> Option<Timeline> {
    let scout = &scout.decoder;
    let (message, arrival) = scout.last_message_time().filter(|_| scout.is_dated())?;
    let off_ns = message.0.saturating_sub(arrival.0).saturating_abs();
    Some(if off_ns > HOST_TOLERANCE_NS {
        Timeline::through(host.mono(arrival), message)
    } else {
        host
    })
}

/// Sending side of the queue, one per source thread.
struct Outlet {
    source: usize,
    /// The source's name, for diagnostics.
    name: String,
    sender: Sender<Chunk>,
    clock: Arc<dyn Clock>,
    stats: Arc<Stats>,
    waiting_bytes: Arc<AtomicUsize>,
    /// Remaining burst allowance of the source, bytes, and the instant of its last update.
    inflow: Cell<(f64, Instant)>,
    stop: Arc<AtomicBool>,
}

impl Outlet {
    fn stopped(&self) -> bool {
        self.stop.load(Relaxed)
    }

    /// Takes bytes from the source's rate allowance. Returns false if the bytes exceed the allowance.
    fn is_within_limit(&self, bytes: usize) -> bool {
        let (left, at) = self.inflow.get();
        let now = Instant::now();
        let come = SOURCE_BYTES_PER_S * now.duration_since(at).as_secs_f64();
        let left = (left + come).min(SOURCE_BURST_BYTES);
        let fits = bytes as f64 <= left;
        let taken = if fits { bytes as f64 } else { 0.0 };
        self.inflow.set((left - taken, now));
        fits
    }

    /// Queues bytes of a stream, the last of which has just arrived. Waits while the bytes exceed the rate allowance.
    fn send(&self, bytes: &[u8], byte_ns: i64) {
        while !self.is_within_limit(bytes.len()) && !self.stopped() {
            std::thread::sleep(LIMIT_PAUSE);
        }
        self.send_old(bytes, byte_ns, 0);
    }

    /// Queues bytes, the last of which arrived `age_ns` ago.
    fn send_old(&self, bytes: &[u8], byte_ns: i64, age_ns: i64) {
        if self.waiting_bytes.load(Relaxed) > QUEUE_BYTES {
            self.stats.dropped_full.fetch_add(1, Relaxed);
            self.stats.received.fetch_add(1, Release);
            return;
        }
        let since_first_ns = age_ns + byte_ns * bytes.len() as i64;
        let mono = self.clock.mono().plus_ns(-since_first_ns);
        let chunk = Chunk {
            source: self.source,
            mono,
            bytes: bytes.to_vec(),
        };
        // Counted first, because the pacer can take the chunk at once.
        self.waiting_bytes.fetch_add(bytes.len(), Relaxed);
        if self.sender.try_send(chunk).is_err() {
            self.waiting_bytes.fetch_sub(bytes.len(), Relaxed);
            self.stats.dropped_full.fetch_add(1, Relaxed);
        }
        // Counted after queueing, so a reader of the counter finds the bytes.
        self.stats.received.fetch_add(1, Release);
    }

    /// Waits in short steps, so that stopping is not delayed.
    fn pause(&self, time: Duration) {
        let end = Instant::now() + time;
        while !self.stopped() && Instant::now() < end {
            std::thread::sleep(READ_TIMEOUT);
        }
    }
}

fn is_timeout(error: &std::io::Error) -> bool {
    use std::io::ErrorKind::{Interrupted, TimedOut, WouldBlock};
    matches!(error.kind(), WouldBlock | TimedOut | Interrupted)
}

// ---------------------------------------------------------------- UDP

fn open_udp(listen: SocketAddr, multicast: Option<Ipv4Addr>) -> std::io::Result<UdpSocket> {
    // Multicast datagrams are addressed to no interface: `listen` selects the interface, and the socket binds to all addresses.
    let (bound, interface) = match (multicast, listen.ip()) {
        (None, _) => (listen, Ipv4Addr::UNSPECIFIED),
        (Some(_), IpAddr::V4(interface)) => (any_at(listen.port()), interface),
        (Some(_), IpAddr::V6(_)) => (any_at(listen.port()), Ipv4Addr::UNSPECIFIED),
    };
    let socket = Socket::new(Domain::for_address(bound), Type::DGRAM, Some(Protocol::UDP))?;
    // Several programs may join one group, and programs of one user may listen to the same broadcasts. The address of one interface is not
    // shared, because the kernel would deliver only to the last program that binds the address.
    match multicast {
        Some(_) => socket.set_reuse_address(true)?,
        None => socket.set_reuse_port(listen.ip().is_unspecified())?,
    }
    // The kernel counts datagrams that a smaller buffer loses.
    let _ = socket.set_recv_buffer_size(SOCKET_BUFFER_BYTES);
    socket.set_read_timeout(Some(READ_TIMEOUT))?;
    socket.bind(&bound.into())?;
    if let Some(group) = multicast {
        socket.join_multicast_v4(&group, &interface)?;
        // Otherwise the socket would receive groups that other programs joined.
        #[cfg(target_os = "linux")]
        socket.set_multicast_all_v4(false)?;
    }
    Ok(socket.into())
}

fn any_at(port: u16) -> SocketAddr {
    (Ipv4Addr::UNSPECIFIED, port).into()
}

fn read_udp(socket: &UdpSocket, outlet: &Outlet) {
    let mut buffer = vec![0; 65_536];
    stamp::enable(socket);
    let mut failing = false;
    while !outlet.stopped() {
        match stamp::receive(socket, &mut buffer) {
            Ok((len, age_ns)) => {
                failing = false;
                if !outlet.is_within_limit(len) {
                    outlet.stats.dropped_flood.fetch_add(1, Relaxed);
                    outlet.stats.received.fetch_add(1, Release);
                    continue;
                }
                outlet.send_old(&buffer[..len], 0, age_ns);
            }
            Err(error) if is_timeout(&error) => {}
            Err(error) => {
                if !std::mem::replace(&mut failing, true) {
                    warn!(source = outlet.name, %error, "cannot receive navigation");
                }
                outlet.stats.read_errors.fetch_add(1, Relaxed);
                outlet.pause(READ_TIMEOUT);
            }
        }
    }
}
