//! Servers for the sonar protocols: one thread per server, which never paces a ping.
//!
//! In: whole records from the delivery thread ([`SonarServer::deliver`]), commands from clients. Out: each client's own choice of records, over
//! TCP and UDP on one port; the settings, changed. The thread runs a current-thread tokio runtime; the delivery thread only appends to queues
//! and never waits for a socket.
//!
//! Each client has a bounded queue. What does not fit is dropped for that client only, by whole records, and counted; a record once begun is
//! finished. A record that finds the queue empty always fits, or one larger than the queue could never be sent. Answers to commands go
//! ahead of queued records; a client that does not read its answers is not read from (TCP) or loses them, counted (UDP).
//!
//! Over UDP a client lasts as long as its subscriptions: until 1052 or 1056 has ended them and it was silent for [`ServerTimes::udp_idle`], or
//! it was silent for [`ServerTimes::udp_silence`] whatever it subscribed to (any command renews it), or its port is reported closed.
//! UDP bursts are not paced: the DFD recommends TCP, and so do we.

pub mod client;
mod queue;
mod tcp;
mod udp;
pub mod verify;

use std::net::SocketAddr;
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

use tokio::sync::watch;

use crate::config::spec::SevenKSpec;
use crate::emit::sevenk::RecordSet;
use crate::emit::sevenk::records::DeviceSheet;
use crate::emit::sevenk::session::{Outgoing, Session, SessionContext};
use crate::flow::{Datagram, SettingsPort};
use crate::time::UtcNs;
use queue::Client;

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

#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Transport {
    Tcp,
    Udp,
}

impl std::fmt::Display for Transport {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Tcp => "TCP",
            Self::Udp => "UDP",
        })
    }
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
    pub subscribed: RecordSet,
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
    /// Connections that failed while being accepted.
    pub accept_errors: u64,
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

/// A listening 7k server. Stops when dropped.
pub struct SonarServer {
    shared: Arc<Shared>,
    local_addr: SocketAddr,
    stop: watch::Sender<bool>,
    thread: Option<JoinHandle<()>>,
}

impl SonarServer {
    /// Listens on TCP and UDP at `spec.listen`; port 0 picks one that both have free.
    pub fn start(
        spec: &SevenKSpec,
        sheet: Arc<DeviceSheet>,
        settings: Arc<dyn SettingsPort>,
        rig_time: RigTime,
    ) -> Result<Self, OpenError> {
        Self::start_with(spec, sheet, settings, rig_time, ServerTimes::default())
    }

    pub fn start_with(
        spec: &SevenKSpec,
        sheet: Arc<DeviceSheet>,
        settings: Arc<dyn SettingsPort>,
        rig_time: RigTime,
        times: ServerTimes,
    ) -> Result<Self, OpenError> {
        let packet = PacketLimits::of(spec.max_packet)?;
        let (listener, socket, local_addr) = open(spec.listen)?;
        let shared = Arc::new(Shared {
            sheet,
            settings,
            rig_time,
            times,
            packet,
            client_queue_bytes: spec.client_queue_bytes,
            max_clients: spec.max_clients,
            wanted: AtomicU32::new(0),
            roster: Mutex::new(Roster::default()),
        });
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .build()
            .map_err(OpenError::Thread)?;
        let (stop, stopped) = watch::channel(false);
        let thread = std::thread::Builder::new()
            .name(format!("sevenk-{}", local_addr.port()))
            .spawn({
                let shared = Arc::clone(&shared);
                move || runtime.block_on(serve(listener, socket, shared, stopped))
            })
            .map_err(OpenError::Thread)?;
        Ok(Self {
            shared,
            local_addr,
            stop,
            thread: Some(thread),
        })
    }

    pub fn local_addr(&self) -> SocketAddr {
        self.local_addr
    }

    /// What clients want of the next ping. One atomic read.
    pub fn wanted(&self) -> RecordSet {
        RecordSet::from_bits(self.shared.wanted.load(Ordering::Acquire))
    }

    /// Queues records for every client that wants them. Never waits for a client.
    pub fn deliver(&self, records: &[Arc<Datagram>]) {
        self.shared.deliver(records);
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

/// Bytes of a packet, network frame included.
#[derive(Clone, Copy)]
struct PacketLimits {
    tcp: u32,
    udp: u32,
}

impl PacketLimits {
    fn of(max_packet: usize) -> Result<Self, OpenError> {
        use echotank_protocols::sevenk::packet::{MAX_DATAGRAM_BYTES, MIN_MAX_PACKET_BYTES};
        let refused = || OpenError::MaxPacket {
            max_packet,
            min: MIN_MAX_PACKET_BYTES as usize,
            max: u32::MAX as usize,
        };
        let tcp = u32::try_from(max_packet).map_err(|_| refused())?;
        if tcp < MIN_MAX_PACKET_BYTES {
            return Err(refused());
        }
        Ok(Self {
            tcp,
            udp: tcp.min(MAX_DATAGRAM_BYTES),
        })
    }
}

fn open(
    address: SocketAddr,
) -> Result<(std::net::TcpListener, std::net::UdpSocket, SocketAddr), OpenError> {
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
        let listener =
            std::net::TcpListener::bind(address).map_err(failed(Transport::Tcp, address))?;
        let local = listener
            .local_addr()
            .map_err(failed(Transport::Tcp, address))?;
        match std::net::UdpSocket::bind(local) {
            Err(_) if address.port() == 0 && attempt < PORT_ATTEMPTS => continue,
            Err(source) => return Err(failed(Transport::Udp, local)(source)),
            Ok(socket) => {
                listener
                    .set_nonblocking(true)
                    .map_err(failed(Transport::Tcp, local))?;
                socket
                    .set_nonblocking(true)
                    .map_err(failed(Transport::Udp, local))?;
                return Ok((listener, socket, local));
            }
        }
    }
}

async fn serve(
    listener: std::net::TcpListener,
    socket: std::net::UdpSocket,
    shared: Arc<Shared>,
    stopped: watch::Receiver<bool>,
) {
    tokio::join!(
        tcp::serve(listener, Arc::clone(&shared), stopped.clone()),
        udp::serve(socket, shared, stopped)
    );
}

/// Resolves when the server stops.
async fn stopping(stopped: &mut watch::Receiver<bool>) {
    // An error means that the server is gone, which is a stop too.
    let _ = stopped.wait_for(|&stop| stop).await;
}

// ---------------------------------------------------------------- shared by the threads

struct Shared {
    sheet: Arc<DeviceSheet>,
    settings: Arc<dyn SettingsPort>,
    rig_time: RigTime,
    times: ServerTimes,
    packet: PacketLimits,
    client_queue_bytes: usize,
    max_clients: usize,
    /// Union of what the clients want; written with the roster locked.
    wanted: AtomicU32,
    roster: Mutex<Roster>,
}

#[derive(Default)]
struct Roster {
    clients: Vec<Arc<Client>>,
    gone: ClientCounts,
    admitted: u64,
    refused: u64,
    accept_errors: u64,
}

impl Shared {
    /// A thread that panicked with the roster locked left whole clients in it.
    fn lock(&self) -> MutexGuard<'_, Roster> {
        self.roster.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// A seat for a new client, unless all are taken.
    fn admit(self: &Arc<Self>, peer: SocketAddr, transport: Transport) -> Option<Seat> {
        let mut roster = self.lock();
        if roster.clients.len() >= self.max_clients {
            roster.refused += 1;
            return None;
        }
        roster.admitted += 1;
        let client = Arc::new(Client::new(peer, transport));
        roster.clients.push(Arc::clone(&client));
        Some(Seat {
            shared: Arc::clone(self),
            client,
        })
    }

    fn update_wanted(&self, roster: &Roster) {
        let wanted = roster
            .clients
            .iter()
            .fold(RecordSet::EMPTY, |all, client| all.union(client.wants()));
        self.wanted.store(wanted.bits(), Ordering::Release);
    }

    fn deliver(&self, records: &[Arc<Datagram>]) {
        let roster = self.lock();
        for client in &roster.clients {
            client.offer(records, self.client_queue_bytes);
        }
        self.update_wanted(&roster);
    }

    /// Lets a session work, and carries out what it decided.
    fn converse(
        &self,
        client: &Client,
        session: &mut Session,
        step: impl FnOnce(&mut Session, &SessionContext<'_>, &mut Vec<Outgoing>),
    ) {
        let context = SessionContext {
            sheet: &self.sheet,
            settings: self.settings.as_ref(),
            now: (self.rig_time)(),
        };
        let mut outgoing = Vec::new();
        step(session, &context, &mut outgoing);
        client.note(session.counts());
        // The answer is queued before the first record that it promises can be.
        let mut echoes = Vec::new();
        for item in outgoing {
            match item {
                Outgoing::Reply(datagram) => client.reply(Arc::new(datagram)),
                Outgoing::Echo(datagram) => echoes.push(Arc::new(datagram)),
            }
        }
        let requested = session.take_requested();
        let roster = self.lock();
        client.want(session.subscribed(), requested);
        self.update_wanted(&roster);
        for other in &roster.clients {
            other.offer(&echoes, self.client_queue_bytes);
        }
    }

    fn report(&self) -> ServerReport {
        let roster = self.lock();
        ServerReport {
            clients: roster
                .clients
                .iter()
                .map(|client| client.report())
                .collect(),
            gone: roster.gone,
            admitted: roster.admitted,
            refused: roster.refused,
            accept_errors: roster.accept_errors,
        }
    }
}

/// A client's place on the roster; dropping it, for whatever reason, takes the client off and keeps its counts.
struct Seat {
    shared: Arc<Shared>,
    client: Arc<Client>,
}

impl Drop for Seat {
    fn drop(&mut self) {
        let mut roster = self.shared.lock();
        roster
            .clients
            .retain(|other| !Arc::ptr_eq(other, &self.client));
        roster.gone += self.client.close();
        self.shared.update_wanted(&roster);
    }
}
