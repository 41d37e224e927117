//! Servers of the sonar protocols: one thread per server. No server thread paces a ping.
//!
//! A server takes whole records from the delivery thread ([`SonarServer::deliver`]) and commands from clients over TCP and UDP on one port. A
//! [`Protocol`] encodes and decodes. The server owns sockets, queues, counters and timeouts. Its thread runs a current-thread tokio runtime. The
//! delivery thread only appends to queues and never waits for a socket.
//!
//! Each client has a bounded queue. If a record does not fit, it is dropped for this client and counted, or the client is disconnected
//! ([`WhenFull`]). An empty queue accepts any record. A record is sent completely unless the connection ends. Replies to commands precede queued
//! records. A TCP client that does not read its replies is not read from; a UDP client loses replies, which are counted.
//!
//! A UDP client ends after [`ServerTimes::udp_idle`] without subscriptions or commands, after [`ServerTimes::udp_silence`] without commands, or when
//! its port is reported closed. A TCP client whose host no longer answers ends by keep-alive probes or [`ServerTimes::tcp_unacknowledged`]. A full
//! server disconnects its idlest client for a new one, see [`ServerTimes::seat_idle`].
//!
//! Sessions can also connect to third-party addresses, which receive records until they fail or are disconnected, and over UDP for
//! [`ServerTimes::dial_udp`]. One thread sends to all UDP clients, each at the rate that [`SonarServer::deliver_over`] sets (`paced`).

pub mod client;
mod dial;
pub mod elements;

mod paced;
mod queue;
mod sevenk;
mod tcp;
mod udp;
pub mod verification;
pub mod verify;

use std::net::SocketAddr;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

use tokio::sync::{mpsc, watch};
use tokio::time::interval;
use tracing::{Span, info, info_span, warn};

use crate::io::link::{Connection, Link};
use crate::io::listening::Listening;
use crate::io::pace::Sending;
use crate::io::priority::first_in_first_out_of;
use echotank_core::records::Datagram;
use echotank_core::time::UtcNs;
pub use echotank_emit::session::Transport;
use echotank_emit::session::{Outgoing, Protocol, Session, Wants};
use paced::PacedSender;
use queue::{Client, Offer};
pub use sevenk::{start_sevenk, start_sevenk_with};

/// Reads rig time, which is the time stamp of replies.
pub type RigTime = Arc<dyn Fn() -> UtcNs + Send + Sync>;

/// Number of attempts to find a port that is free for both TCP and UDP if `listen` has port 0.
const PORT_ATTEMPTS: usize = 16;

/// Errors of starting a server.
#[derive(Debug, thiserror::Error)]
pub enum OpenError {
    /// The address could not be bound.
    #[error("cannot listen on {transport} {address}: {source}")]
    Listen {
        /// TCP or UDP.
        transport: Transport,
        /// The address that the configuration names.
        address: SocketAddr,
        /// The cause.
        source: std::io::Error,
    },
    /// The 7k packet size is out of range.
    #[error("max_packet = {max_packet}: must be from {min} to {max}")]
    MaxPacket {
        /// The configured size, bytes.
        max_packet: usize,
        /// The smallest size, bytes.
        min: usize,
        /// The largest size, bytes.
        max: usize,
    },
    /// The thread or its runtime could not start.
    #[error("cannot start the server's thread: {0}")]
    Thread(std::io::Error),
}

/// Interval between checks for settings that other clients changed.
const NOTICE_INTERVAL: Duration = Duration::from_millis(20);

/// Behaviour when a client's queue is full.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum WhenFull {
    /// The client misses whole records.
    #[default]
    Skip,
    /// The client is disconnected.
    Disconnect,
}

#[derive(Clone, Copy)]
struct QueueLimit {
    bytes: usize,
    when_full: WhenFull,
}

/// Configuration of a server.
#[derive(Clone, Debug)]
pub struct ServerSpec {
    /// Address; with port 0 the server picks a port that is free for every transport.
    pub listen: SocketAddr,
    /// Whether TCP connections are accepted.
    pub tcp: bool,
    /// Whether UDP datagrams are accepted.
    pub udp: bool,
    /// Limit of a client's queue, bytes.
    pub client_queue_bytes: usize,
    /// Behaviour beyond that limit.
    pub when_full: WhenFull,
    /// Maximum number of simultaneous clients.
    pub max_clients: usize,
}

/// Timeouts of a server.
#[derive(Clone, Copy, Debug)]
pub struct ServerTimes {
    /// TCP: time limit for the rest of an incomplete command. After the limit, decoding resumes after the first byte of the command.
    pub stall: Duration,
    /// UDP: time limit of silence of a client without subscriptions.
    pub udp_idle: Duration,
    /// UDP: time limit of silence of a client with subscriptions.
    pub udp_silence: Duration,
    /// TCP: time limit for the client's host to acknowledge sent data.
    pub tcp_unacknowledged: Duration,
    /// UDP: time limit of sending to a third party without a renewed request.
    pub dial_udp: Duration,
    /// Idle time after which a full server may disconnect a client. A client without subscriptions is idle if it sends nothing. A client with queued
    /// records is idle if it reads none.
    pub seat_idle: Duration,
    /// Silence after which a full server may disconnect a UDP client.
    pub seat_udp_silence: Duration,
    /// Time limit for writing queued records when the server stops or a client closes.
    pub drain: Duration,
}

impl Default for ServerTimes {
    fn default() -> Self {
        Self {
            stall: Duration::from_secs(2),
            udp_idle: Duration::from_secs(10),
            udp_silence: Duration::from_secs(3600),
            // A client that pauses reading for less than this, in a debugger for example, stays connected.
            tcp_unacknowledged: Duration::from_secs(120),
            dial_udp: Duration::from_secs(600),
            seat_idle: Duration::from_secs(10),
            seat_udp_silence: Duration::from_secs(60),
            drain: Duration::from_secs(1),
        }
    }
}

/// Traffic of one client.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ClientCounts {
    /// Bytes written, network frames included.
    pub bytes_sent: u64,
    /// Records and replies written.
    pub records_sent: u64,
    /// Records that did not fit in the queue or that the socket refused.
    pub records_dropped: u64,
    /// Records in the queue when the client left.
    pub records_unsent: u64,
    /// Commands received, refused ones included.
    pub commands: u64,
    /// Commands refused.
    pub nacks: u64,
    /// Undecodable stretches of bytes received.
    pub framing_errors: u64,
}

impl std::ops::AddAssign for ClientCounts {
    fn add_assign(&mut self, o: Self) {
        self.bytes_sent += o.bytes_sent;
        self.records_sent += o.records_sent;
        self.records_dropped += o.records_dropped;
        self.records_unsent += o.records_unsent;
        self.commands += o.commands;
        self.nacks += o.nacks;
        self.framing_errors += o.framing_errors;
    }
}

/// State of a client.
#[derive(Clone, Copy, Debug)]
pub struct ClientReport {
    /// The client's address.
    pub peer: SocketAddr,
    /// TCP or UDP.
    pub transport: Transport,
    /// Record classes subscribed to.
    pub subscribed: Wants,
    /// Bytes in the queue of the client.
    pub queued_bytes: usize,
    /// Traffic of the client.
    pub counts: ClientCounts,
}

/// State of a server.
#[derive(Clone, Debug, Default)]
pub struct ServerReport {
    /// Connected clients.
    pub clients: Vec<ClientReport>,
    /// Sum over the clients that left.
    pub gone: ClientCounts,
    /// Clients accepted so far.
    pub admitted: u64,
    /// Clients refused because of `max_clients`.
    pub refused: u64,
}

impl ServerReport {
    /// Sum over all clients, present and past.
    pub fn totals(&self) -> ClientCounts {
        self.clients.iter().fold(self.gone, |mut sum, client| {
            sum += client.counts;
            sum
        })
    }
}

/// A running server; it stops when dropped.
pub struct SonarServer {
    shared: Arc<Shared>,
    local_addr: SocketAddr,
    stop: watch::Sender<bool>,
    thread: Option<JoinHandle<()>>,
    link: Mutex<Option<Box<dyn Link>>>,
    _listening: Listening,
}

impl SonarServer {
    /// Binds the sockets and starts the server's thread.
    ///
    /// # Errors
    /// An address cannot be bound, or the thread or its runtime cannot start.
    pub fn start(
        spec: &ServerSpec,
        protocol: Arc<dyn Protocol>,
        rig_time: RigTime,
        times: ServerTimes,
    ) -> Result<Self, OpenError> {
        let listeners = open(spec)?;
        let local_addr = listeners.local_addr;
        let (dials, dialled) = mpsc::unbounded_channel();
        let shared = Arc::new(Shared {
            rig_time,
            times,
            queue: QueueLimit {
                bytes: spec.client_queue_bytes,
                when_full: spec.when_full,
            },
            max_clients: spec.max_clients,
            wanted: AtomicU64::new(0),
            table: Mutex::new(ClientTable::default()),
            dials,
            local_addr,
            span: info_span!("server", protocol = protocol.name(), address = %local_addr),
            protocol,
            sending: OnceLock::new(),
            mute: watch::Sender::new(false),
            paces_tcp: AtomicBool::new(false),
            paced: OnceLock::new(),
        });
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .build()
            .map_err(OpenError::Thread)?;
        let listening = Listening::at(shared.protocol.name(), local_addr);
        let (stop, stopped) = watch::channel(false);
        let thread = std::thread::Builder::new()
            .name(format!("{} {}", shared.protocol.name(), local_addr.port()))
            .spawn({
                let shared = Arc::clone(&shared);
                move || runtime.block_on(serve(listeners, shared, dialled, stopped))
            })
            .map_err(OpenError::Thread)?;
        Ok(Self {
            shared,
            local_addr,
            stop,
            thread: Some(thread),
            link: Mutex::default(),
            _listening: listening,
        })
    }

    /// Bound address.
    pub fn local_addr(&self) -> SocketAddr {
        self.local_addr
    }

    /// Record classes that clients want from the next ping. The call is one atomic read.
    pub fn wanted(&self) -> Wants {
        Wants(self.shared.wanted.load(Ordering::Acquire))
    }

    /// Sets how datagrams are sent. Call before the first datagram; later calls have no effect.
    pub(crate) fn set_sending(&self, sending: Sending) {
        // The call fails, and is ignored, once the sending thread has started.
        let _ = self.shared.sending.set(sending);
    }

    /// Runs the server's thread under SCHED_FIFO with this priority if the system permits; 0 changes nothing. Streams need this, because their
    /// commands are urgent too.
    pub(crate) fn set_priority(&self, priority: u8) {
        if let Some(thread) = self.thread.as_ref().filter(|_| priority > 0) {
            // The daemon reports a refused priority at its start.
            let _ = first_in_first_out_of(thread, priority);
        }
    }

    /// Sets whether TCP clients are paced like UDP clients.
    pub fn set_paces_tcp(&self, paces_tcp: bool) {
        self.shared.paces_tcp.store(paces_tcp, Ordering::Relaxed);
    }

    /// Queues records for each client that wants them. Never waits for a client.
    pub fn deliver(&self, records: &[Arc<Datagram>]) {
        self.deliver_over(records, 0.0);
    }

    /// Like [`Self::deliver`], but spreads each UDP client's queue evenly over the next `over_s` seconds; 0 sends at once. TCP clients are paced if
    /// [`Self::set_paces_tcp`] enables this.
    pub fn deliver_over(&self, records: &[Arc<Datagram>], over_s: f64) {
        let mut link = self.link.lock().unwrap_or_else(PoisonError::into_inner);
        let records = match &mut *link {
            Some(link) => {
                self.shared.connect(link.connection());
                link.records(records)
            }
            None => records,
        };
        self.shared.offer_all(records.iter().cloned(), Some(over_s));
    }

    /// Sends all further deliveries through `link`.
    pub(crate) fn set_link(&self, link: Box<dyn Link>) {
        *self.link.lock().unwrap_or_else(PoisonError::into_inner) = Some(link);
    }

    /// Sets the state of the connections of all clients.
    pub fn connect(&self, connection: Connection) {
        self.shared.connect(connection);
    }

    /// Counters of the server and its clients.
    pub fn report(&self) -> ServerReport {
        self.shared.report()
    }

    /// Stops accepting clients, writes queued records for at most [`ServerTimes::drain`], and closes the connections. Returns the final report.
    pub fn stop(mut self) -> ServerReport {
        self.shut();
        self.shared.report()
    }

    fn shut(&mut self) {
        self.stop.send_replace(true);
        if let Some(thread) = self.thread.take() {
            // The panic hook has reported a panic of the thread.
            let _ = thread.join();
        }
    }
}

impl Drop for SonarServer {
    fn drop(&mut self) {
        self.shut();
    }
}

/// Bound sockets of a server.
struct ListeningSockets {
    tcp: Option<std::net::TcpListener>,
    udp: Option<std::net::UdpSocket>,
    local_addr: SocketAddr,
}

fn open(spec: &ServerSpec) -> Result<ListeningSockets, OpenError> {
    let failed = |transport, address| {
        move |source| OpenError::Listen {
            transport,
            address,
            source,
        }
    };
    let mut attempt = 0;
    loop {
        attempt += 1;
        let mut listeners = ListeningSockets {
            tcp: None,
            udp: None,
            local_addr: spec.listen,
        };
        if spec.tcp {
            let failed = failed(Transport::Tcp, spec.listen);
            let listener = std::net::TcpListener::bind(spec.listen).map_err(failed)?;
            listeners.local_addr = listener.local_addr().map_err(failed)?;
            listener.set_nonblocking(true).map_err(failed)?;
            listeners.tcp = Some(listener);
        }
        if spec.udp {
            let failed = failed(Transport::Udp, listeners.local_addr);
            let socket = match std::net::UdpSocket::bind(listeners.local_addr) {
                Err(_) if spec.tcp && spec.listen.port() == 0 && attempt < PORT_ATTEMPTS => {
                    continue;
                }
                result => result.map_err(failed)?,
            };
            listeners.local_addr = socket.local_addr().map_err(failed)?;
            socket.set_nonblocking(true).map_err(failed)?;
            listeners.udp = Some(socket);
        }
        return Ok(listeners);
    }
}

async fn serve(
    listeners: ListeningSockets,
    shared: Arc<Shared>,
    dialled: mpsc::UnboundedReceiver<dial::Dial>,
    stopped: watch::Receiver<bool>,
) {
    let tcp = async {
        if let Some(listener) = listeners.tcp {
            tcp::serve(listener, Arc::clone(&shared), stopped.clone()).await;
        }
    };
    let udp = async {
        if let Some(socket) = listeners.udp {
            udp::serve(socket, Arc::clone(&shared), stopped.clone()).await;
        }
    };
    tokio::join!(
        tcp,
        udp,
        dial::serve(dialled, Arc::clone(&shared), stopped.clone()),
        notices(Arc::clone(&shared), stopped.clone()),
    );
}

/// Notifies clients of settings that other clients changed.
async fn notices(shared: Arc<Shared>, mut stopped: watch::Receiver<bool>) {
    let protocol = &shared.protocol;
    let mut version = protocol.version();
    let mut tick = interval(NOTICE_INTERVAL);
    loop {
        tokio::select! {
            () = stopping(&mut stopped) => return,
            _ = tick.tick() => {}
        }
        let now = protocol.version();
        if now != version {
            let notices = protocol.notices(version, (shared.rig_time)());
            version = now;
            shared.offer_all(notices.into_iter().map(Arc::new), None);
        }
    }
}

/// Resolves when the server stops.
async fn stopping(stopped: &mut watch::Receiver<bool>) {
    // An error means that the server was dropped.
    let _ = stopped.wait_for(|&stop| stop).await;
}

// ---------------------------------------------------------------- shared by the threads

struct Shared {
    /// Identifies the server in diagnostics, within the span of its opener.
    span: Span,
    protocol: Arc<dyn Protocol>,
    rig_time: RigTime,
    times: ServerTimes,
    sending: OnceLock<Sending>,
    /// If true, TCP connections stay open, but nothing is read or written.
    mute: watch::Sender<bool>,
    /// Whether TCP clients are paced.
    paces_tcp: AtomicBool,
    /// Sending thread, started by the first datagram; `None` if the thread could not start.
    paced: OnceLock<Option<PacedSender>>,
    queue: QueueLimit,
    max_clients: usize,
    local_addr: SocketAddr,
    /// Union of the clients' wants; written under the lock of `table`.
    wanted: AtomicU64,
    table: Mutex<ClientTable>,
    dials: mpsc::UnboundedSender<dial::Dial>,
}

#[derive(Default)]
struct ClientTable {
    clients: Vec<Arc<Client>>,
    gone: ClientCounts,
    admitted: u64,
    refused: u64,
}

impl ClientTable {
    /// Client that has been idle for the longest time, among those that a full server may disconnect; the first admitted among equals.
    fn idlest(&self, times: &ServerTimes) -> Option<Arc<Client>> {
        let idle = |client: &Arc<Client>| Some((client.idle(times)?, Arc::clone(client)));
        // `max_by_key` returns the last of equal ones.
        let idle = self.clients.iter().rev().filter_map(idle);
        idle.max_by_key(|(idle, _)| *idle).map(|(_, client)| client)
    }
}

impl Shared {
    /// A panic under the lock leaves only complete clients in the table.
    fn lock(&self) -> MutexGuard<'_, ClientTable> {
        self.table.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Adds a client; `None` if the server is full.
    fn admit(
        self: &Arc<Self>,
        peer: SocketAddr,
        transport: Transport,
        dialled: bool,
    ) -> Option<ClientSlot> {
        let mut table = self.lock();
        let idlest = match table.clients.len() < self.max_clients {
            true => None,
            false => table.idlest(&self.times),
        };
        if let Some(idlest) = &idlest {
            idlest.disconnect();
            table.clients.retain(|client| !Arc::ptr_eq(client, idlest));
        }
        if table.clients.len() >= self.max_clients {
            table.refused += 1;
            drop(table);
            let max_clients = self.max_clients;
            self.span.in_scope(|| warn!(client = %peer, %transport, max_clients, "client refused: the server is full"));
            return None;
        }
        table.admitted += 1;
        let client = Arc::new(Client::new(peer, transport, dialled));
        table.clients.push(Arc::clone(&client));
        // Log after the unlock: the delivery thread waits for this lock, and standard error can block.
        drop(table);
        self.span.in_scope(|| {
            if let Some(idlest) = idlest {
                warn!(client = %idlest.peer, transport = %idlest.transport, "idle client disconnected: the server was full");
            }
            info!(client = %peer, %transport, dialled, "client connected");
        });
        Some(ClientSlot {
            shared: Arc::clone(self),
            client,
        })
    }

    /// Sets the state of the connections.
    fn connect(&self, connection: Connection) {
        let is_mute = connection == Connection::Mute;
        self.mute
            .send_if_modified(|mute| std::mem::replace(mute, is_mute) != is_mute);
        if connection == Connection::Reset {
            for client in &self.lock().clients {
                if client.transport == Transport::Tcp {
                    client.reset();
                }
            }
        }
    }

    /// Waits until reading and writing are permitted.
    async fn unmuted(&self) {
        // An error means that the server was dropped.
        let _ = self.mute.subscribe().wait_for(|mute| !mute).await;
    }

    fn update_wanted(&self, table: &ClientTable) {
        let wanted = table
            .clients
            .iter()
            .fold(Wants::NONE, |all, client| all.union(client.wants()));
        self.wanted.store(wanted.0, Ordering::Release);
    }

    fn paced(&self) -> Option<&PacedSender> {
        let start = || {
            let name = format!("{} datagrams", self.protocol.name());
            let sending = self.sending.get().cloned().unwrap_or_default();
            PacedSender::start(name, sending).ok()
        };
        self.paced.get_or_init(start).as_ref()
    }

    /// Queues records for all clients. `over_s` is as in [`SonarServer::deliver_over`]; `None` keeps the current pace.
    fn offer_all(&self, records: impl Iterator<Item = Arc<Datagram>>, over_s: Option<f64>) {
        let offers: Vec<_> = records
            .map(|datagram| Offer {
                class: self.protocol.class(datagram.record_type),
                keeps_requests: self.protocol.has_more_requests(datagram.record_type),
                datagram,
            })
            .collect();
        let table = self.lock();
        for client in &table.clients {
            client.offer(&offers, self.queue, over_s);
        }
        self.update_wanted(&table);
    }

    fn dial(&self, peer: SocketAddr, transport: Transport, wants: Wants) {
        // An error means that the server has stopped.
        let _ = self.dials.send(dial::Dial {
            peer,
            transport,
            wants,
        });
    }

    /// Disconnects the clients that the server contacted at this address.
    fn hang_up(&self, peer: SocketAddr, transport: Transport) {
        for client in &self.lock().clients {
            if client.dialled && client.peer == peer && client.transport == transport {
                client.leave();
            }
        }
    }

    /// Opens a session for a new client.
    fn open_session(&self, client: &Client) -> Box<dyn Session> {
        let mut session = self.protocol.connect(client.transport, client.peer);
        self.run_step(client, &mut *session, |session, now, out| {
            session.greet(now, out);
        });
        session
    }

    /// Runs one step of a session and executes its requests.
    fn run_step(
        &self,
        client: &Client,
        session: &mut dyn Session,
        step: impl FnOnce(&mut dyn Session, UtcNs, &mut Vec<Outgoing>),
    ) {
        let mut outgoing = Vec::new();
        step(session, (self.rig_time)(), &mut outgoing);
        client.note(session.counts());
        // A reply is queued before the first record that the reply announces.
        let mut echoes = Vec::new();
        for item in outgoing {
            match item {
                Outgoing::Reply(datagram) => client.reply(Arc::new(datagram)),
                Outgoing::Echo(datagram) => echoes.push(Arc::new(datagram)),
                Outgoing::Dial {
                    peer,
                    transport,
                    wants,
                } => self.dial(peer, transport, wants),
                Outgoing::HangUp { peer, transport } => self.hang_up(peer, transport),
            }
        }
        client.want(session.wants(), session.take_requested());
        self.offer_all(echoes.into_iter(), None);
        if session.is_over() {
            client.leave();
        }
    }

    fn report(&self) -> ServerReport {
        let table = self.lock();
        ServerReport {
            clients: table.clients.iter().map(|client| client.report()).collect(),
            gone: table.gone,
            admitted: table.admitted,
            refused: table.refused,
        }
    }
}

/// A client's entry in the table; dropping it removes the client and keeps its counts.
struct ClientSlot {
    shared: Arc<Shared>,
    client: Arc<Client>,
}

impl Drop for ClientSlot {
    fn drop(&mut self) {
        let mut table = self.shared.lock();
        table
            .clients
            .retain(|other| !Arc::ptr_eq(other, &self.client));
        let counts = self.client.close();
        table.gone += counts;
        self.shared.update_wanted(&table);
        drop(table);
        let Client {
            peer, transport, ..
        } = &*self.client;
        self.shared.span.in_scope(|| {
            info!(client = %peer,
            %transport,
            records_sent = counts.records_sent,
            records_dropped = counts.records_dropped,
            "client disconnected")
        });
    }
}
