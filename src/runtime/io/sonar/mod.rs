//! Servers for the sonar protocols: one thread per server, which never paces a ping.
//!
//! In: whole records from the delivery thread ([`SonarServer::deliver`]), commands from clients. Out: each client's own choice of records, over
//! TCP and UDP on one port; the settings, changed. What is spoken is a [`Protocol`]; the server knows sockets, queues, counters and times. The
//! thread runs a current-thread tokio runtime; the delivery thread only appends to queues and never waits for a socket.
//!
//! Each client has a bounded queue. What does not fit is dropped for that client only, by whole records, and counted, or ends the connection
//! ([`WhenFull`]); a record once begun is finished, unless its connection is ended. A record that finds the queue empty always fits, or one
//! larger than the queue could never be sent. Answers to commands go ahead of queued records; a client that does not read its answers is not
//! read from (TCP) or loses them, counted (UDP).
//!
//! Over UDP a client lasts as long as its subscriptions: until it has none and was silent for [`ServerTimes::udp_idle`], or it was silent for
//! [`ServerTimes::udp_silence`] whatever it subscribed to (any command renews it), or its port is reported closed. Records also go to
//! addresses that were dialled ([`SonarServer::dial`], or a session's word) until they are hung up or fail. A thread of its own sends to all UDP
//! clients, each at the rate that [`SonarServer::deliver_over`] gives it (`paced`).

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
use crate::io::pace::Sending;
use crate::io::priority::first_in_first_out_of;
use echotank_core::flow::Datagram;
use echotank_core::time::UtcNs;
pub use echotank_emit::session::Transport;
use echotank_emit::session::{Outgoing, Protocol, Session, Wants};
use paced::PacedSender;
use queue::{Client, Offer};
pub use sevenk::{start_sevenk, start_sevenk_with};

/// Tells rig time: what answers are stamped with.
pub type RigTime = Arc<dyn Fn() -> UtcNs + Send + Sync>;

/// Ports tried when any will do: TCP may get one that UDP has not free.
const PORT_ATTEMPTS: usize = 16;

/// Why a server could not be opened.
#[derive(Debug, thiserror::Error)]
pub enum OpenError {
    #[error("cannot listen on {transport} {address}: {source}")]
    Listen {
        transport: Transport,
        address: SocketAddr,
        source: std::io::Error,
    },
    #[error("max_packet = {max_packet}: must be from {min} to {max}")]
    MaxPacket {
        max_packet: usize,
        min: usize,
        max: usize,
    },
    #[error("cannot start the server's thread: {0}")]
    Thread(std::io::Error),
}

/// How often changes by others are looked for.
const NOTICE_INTERVAL: Duration = Duration::from_millis(20);

/// What becomes of a client whose queue is full.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum WhenFull {
    /// It misses whole records.
    #[default]
    Skip,
    /// It is disconnected.
    Disconnect,
}

#[derive(Clone, Copy)]
struct QueueLimit {
    bytes: usize,
    when_full: WhenFull,
}

/// Where a server listens and what it gives each client.
#[derive(Clone, Debug)]
pub struct ServerSpec {
    /// Port 0 picks one that all its transports have free.
    pub listen: SocketAddr,
    pub tcp: bool,
    pub udp: bool,
    /// Bytes that may wait for one client.
    pub client_queue_bytes: usize,
    pub when_full: WhenFull,
    pub max_clients: usize,
}

/// How long the server waits for what may never come.
#[derive(Clone, Copy, Debug)]
pub struct ServerTimes {
    /// For the rest of a command begun on TCP; then what it hid is looked at.
    pub stall: Duration,
    /// For a word from a UDP client without subscriptions.
    pub udp_idle: Duration,
    /// For a word from a UDP client with subscriptions.
    pub udp_silence: Duration,
    /// For queued records to be written when the server stops or a client closes.
    pub drain: Duration,
}

impl Default for ServerTimes {
    fn default() -> Self {
        Self {
            stall: Duration::from_secs(2),
            udp_idle: Duration::from_secs(10),
            udp_silence: Duration::from_secs(3600),
            drain: Duration::from_secs(1),
        }
    }
}

/// What one client was sent and sent us.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ClientCounts {
    /// On the wire, network frames included.
    pub bytes_sent: u64,
    pub records_sent: u64,
    /// Did not fit its queue, or its socket refused them.
    pub records_dropped: u64,
    /// Still queued when it left.
    pub records_unsent: u64,
    /// Refused ones included.
    pub commands: u64,
    pub nacks: u64,
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

/// A client as it is now.
#[derive(Clone, Copy, Debug)]
pub struct ClientReport {
    pub peer: SocketAddr,
    pub transport: Transport,
    pub subscribed: Wants,
    pub queued_bytes: usize,
    pub counts: ClientCounts,
}

#[derive(Clone, Debug, Default)]
pub struct ServerReport {
    pub clients: Vec<ClientReport>,
    /// Sum over the clients that left.
    pub gone: ClientCounts,
    /// Clients ever let in.
    pub admitted: u64,
    /// Turned away because there were `max_clients`.
    pub refused: u64,
}

impl ServerReport {
    /// Sum over all clients, gone or not.
    pub fn totals(&self) -> ClientCounts {
        self.clients.iter().fold(self.gone, |mut sum, client| {
            sum += client.counts;
            sum
        })
    }
}

/// A listening server. Stops when dropped.
pub struct SonarServer {
    shared: Arc<Shared>,
    local_addr: SocketAddr,
    stop: watch::Sender<bool>,
    thread: Option<JoinHandle<()>>,
    link: Mutex<Option<Box<dyn Link>>>,
}

impl SonarServer {
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
        })
    }

    pub fn local_addr(&self) -> SocketAddr {
        self.local_addr
    }

    /// What clients want of the next ping. One atomic read.
    pub fn wanted(&self) -> Wants {
        Wants(self.shared.wanted.load(Ordering::Acquire))
    }

    /// How its datagrams are sent; to be called before there are any.
    pub(crate) fn set_sending(&self, sending: Sending) {
        // Too late where the thread has started: then it stays as it is.
        let _ = self.shared.sending.set(sending);
    }

    /// Its thread runs under SCHED_FIFO from now on, where the system allows it; 0: as it is. For samples that stream: what clients ask for runs so too.
    pub(crate) fn hurry(&self, priority: u8) {
        if let Some(thread) = self.thread.as_ref().filter(|_| priority > 0) {
            // What is not allowed was said when the daemon started.
            let _ = first_in_first_out_of(thread, priority);
        }
    }

    /// What is spread over time is so for TCP clients too, from now on.
    pub fn set_paces_tcp(&self, paces_tcp: bool) {
        self.shared.paces_tcp.store(paces_tcp, Ordering::Relaxed);
    }

    /// Queues records for every client that wants them. Never waits for a client.
    pub fn deliver(&self, records: &[Arc<Datagram>]) {
        self.deliver_over(records, 0.0);
    }

    /// The same, and what then waits for a UDP client leaves evenly over the next `over_s` seconds; 0: at once. For a TCP client too, where
    /// [`Self::set_paces_tcp`] says so.
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

    /// All that is delivered passes `line` from now on.
    pub(crate) fn set_link(&self, link: Box<dyn Link>) {
        *self.link.lock().unwrap_or_else(PoisonError::into_inner) = Some(link);
    }

    /// How its connections are to be from now on.
    pub fn connect(&self, connection: Connection) {
        self.shared.connect(connection);
    }

    pub fn report(&self) -> ServerReport {
        self.shared.report()
    }

    /// Takes no more clients, writes what is queued for at most [`ServerTimes::drain`], and closes.
    pub fn stop(mut self) -> ServerReport {
        self.shut();
        self.shared.report()
    }

    fn shut(&mut self) {
        self.stop.send_replace(true);
        if let Some(thread) = self.thread.take() {
            // A panic in the server's thread was printed where it happened; there is nothing left to close.
            let _ = thread.join();
        }
    }
}

impl Drop for SonarServer {
    fn drop(&mut self) {
        self.shut();
    }
}

/// What a server listens at.
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

/// Tells the clients what others have changed.
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
    // An error means that the server is gone, which is a stop too.
    let _ = stopped.wait_for(|&stop| stop).await;
}

// ---------------------------------------------------------------- shared by the threads

struct Shared {
    /// Names the server in diagnostics, inside the span of whoever opened it.
    span: Span,
    protocol: Arc<dyn Protocol>,
    rig_time: RigTime,
    times: ServerTimes,
    sending: OnceLock<Sending>,
    /// TCP clients stay, and nothing is written or read.
    mute: watch::Sender<bool>,
    /// TCP clients get what is spread over time so.
    paces_tcp: AtomicBool,
    /// Begun with the first datagram; none where there can be no thread.
    paced: OnceLock<Option<PacedSender>>,
    queue: QueueLimit,
    max_clients: usize,
    local_addr: SocketAddr,
    /// Union of what the clients want; written with the table locked.
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

impl Shared {
    /// A thread that panicked with the table locked left whole clients in it.
    fn lock(&self) -> MutexGuard<'_, ClientTable> {
        self.table.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// A slot for a new client, unless all are taken.
    fn admit(
        self: &Arc<Self>,
        peer: SocketAddr,
        transport: Transport,
        dialled: bool,
    ) -> Option<ClientSlot> {
        let mut table = self.lock();
        if table.clients.len() >= self.max_clients {
            table.refused += 1;
            drop(table);
            let max_clients = self.max_clients;
            warn!(parent: &self.span, client = %peer, %transport, max_clients, "client refused: the server is full");
            return None;
        }
        table.admitted += 1;
        let client = Arc::new(Client::new(peer, transport, dialled));
        table.clients.push(Arc::clone(&client));
        // The delivery thread waits for this lock; standard error may block.
        drop(table);
        info!(parent: &self.span, client = %peer, %transport, dialled, "client connected");
        Some(ClientSlot {
            shared: Arc::clone(self),
            client,
        })
    }

    /// How the connections are to be from now on.
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

    /// Returns when something may be written and read.
    async fn unmuted(&self) {
        // An error means that the server is gone.
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

    /// `over_s`: of a ping's records, see [`SonarServer::deliver_over`].
    fn offer_all(&self, records: impl Iterator<Item = Arc<Datagram>>, over_s: Option<f64>) {
        let offers: Vec<_> = records
            .map(|datagram| Offer {
                class: self.protocol.class(datagram.record_type),
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
        // An error means that the server has stopped, and nobody is dialled any more.
        let _ = self.dials.send(dial::Dial {
            peer,
            transport,
            wants,
        });
    }

    /// Ends what was dialled; whether there was any.
    fn hang_up(&self, peer: SocketAddr, transport: Transport) {
        for client in &self.lock().clients {
            if client.dialled && client.peer == peer && client.transport == transport {
                client.leave();
            }
        }
    }

    /// A session for a client that has just come.
    fn welcome(&self, client: &Client) -> Box<dyn Session> {
        let mut session = self.protocol.connect(client.transport, client.peer);
        self.converse(client, &mut *session, |session, now, out| {
            session.greet(now, out);
        });
        session
    }

    /// Lets a session work, and carries out what it decided.
    fn converse(
        &self,
        client: &Client,
        session: &mut dyn Session,
        step: impl FnOnce(&mut dyn Session, UtcNs, &mut Vec<Outgoing>),
    ) {
        let mut outgoing = Vec::new();
        step(session, (self.rig_time)(), &mut outgoing);
        client.note(session.counts());
        // The answer is queued before the first record that it promises can be.
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

/// A client's place on the table; dropping it, for whatever reason, takes the client off and keeps its counts.
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
        info!(
            parent: &self.shared.span,
            client = %peer,
            %transport,
            records_sent = counts.records_sent,
            records_dropped = counts.records_dropped,
            "client disconnected"
        );
    }
}
