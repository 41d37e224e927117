//! Sender of unsolicited datagrams, with its own thread and a limited rate.
//!
//! The packets of a ping are sent to every address in groups, at the rate of a token bucket per address. Packets of a block are not sent before the
//! block is due. If the queue is full, the ping is dropped and counted. Packets to an unreachable address are counted as failed.

use std::net::{Ipv4Addr, SocketAddr, UdpSocket};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::{self, JoinHandle};

use crossbeam_channel::{Receiver, Sender, bounded};
use socket2::SockAddr;

use crate::clock::{Clock, SystemClock};
use crate::io::link::Link as OutputLink;
use crate::io::pace::Sending;
use crate::io::pace::batch::send_batch;
use crate::io::pace::bucket::Bucket;
use crate::io::sonar::SonarServer;
use echotank_core::time::MonoNs;
use echotank_emit::packets::Packets;
use echotank_emit::pool::DatagramPool;

/// Send buffer requested for each socket, bytes; it must hold a group.
const SEND_BUFFER_BYTES: usize = 1 << 20;

/// Maximum number of buffers kept for the clients of a server before new buffers are allocated.
const MAX_KEPT_BUFFERS: usize = 256;

/// Destinations and limits of a sender.
#[derive(Clone, Debug)]
pub(crate) struct Route {
    pub send_to: Vec<SocketAddr>,
    pub multicast_interface: Ipv4Addr,
    pub multicast_ttl: u32,
    /// Maximum rate to each address, bytes/s, independent of the spread of a ping.
    pub pace_bytes_per_s: f64,
    /// Maximum number of queued pings.
    pub queue: usize,
}

/// Send times of the packets of a ping.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum SendTimes {
    /// Evenly over this time from now, s; 0 sends as fast as the pace allows.
    Over(f64),
    /// Each block `latency_s` after its last sample. `pulse` is the start of the pulse on the rig's clock.
    AsReceived { pulse: MonoNs, latency_s: f64 },
}

/// Counters of a sender.
#[derive(Debug, Default)]
pub(crate) struct DatagramCounts {
    /// One entry per address, in the order of [`Route::send_to`]; empty if a server distributes the packets.
    pub(crate) receivers: Vec<ReceiverCounts>,
    /// Packets passed to a server, which counts per client.
    pub(crate) to_clients: AtomicU64,
    /// Pings dropped because the queue was full.
    pub(crate) dropped_pings: AtomicU64,
}

/// Counters of one address.
#[derive(Debug)]
pub(crate) struct ReceiverCounts {
    pub to: SocketAddr,
    pub packets: AtomicU64,
    pub bytes: AtomicU64,
    /// Packets that the operating system refused.
    pub failed: AtomicU64,
}

impl DatagramCounts {
    fn sum(&self, of: impl Fn(&ReceiverCounts) -> &AtomicU64) -> u64 {
        let each = self.receivers.iter().map(|r| of(r).load(Ordering::Relaxed));
        each.sum()
    }
    /// Packets sent to any address.
    pub(crate) fn packets(&self) -> u64 {
        self.to_clients.load(Ordering::Relaxed) + self.sum(|r| &r.packets)
    }
    /// Packets refused by the operating system.
    pub(crate) fn failed(&self) -> u64 {
        self.sum(|r| &r.failed)
    }
}

/// Queue of the sending thread. On drop, the queued pings are sent and the thread ends.
pub(crate) struct DatagramSender {
    full: Option<Sender<(Packets, SendTimes)>>,
    empty: Receiver<Packets>,
    counts: Arc<DatagramCounts>,
    thread: Option<JoinHandle<()>>,
    faulty: Mutex<Option<Box<dyn OutputLink>>>,
    /// Server that distributes the packets to its clients.
    server: Option<Arc<SonarServer>>,
}

impl DatagramSender {
    /// Opens a sender to fixed addresses. Blocks are due on `clock`, the rig's clock.
    pub(crate) fn open(
        route: Route,
        clock: Arc<dyn Clock>,
        sending: Sending,
    ) -> std::io::Result<Self> {
        let sockets = route
            .send_to
            .iter()
            .map(|to| Ok((socket_for(*to, &route)?, SockAddr::from(*to))))
            .collect::<std::io::Result<Vec<_>>>()?;
        let pace_bytes_per_s = route.pace_bytes_per_s;
        let receivers = route.send_to.iter().map(|&to| ReceiverCounts {
            to,
            packets: AtomicU64::new(0),
            bytes: AtomicU64::new(0),
            failed: AtomicU64::new(0),
        });
        let counts = DatagramCounts {
            receivers: receivers.collect(),
            ..DatagramCounts::default()
        };
        Self::start(
            (Destination::Addresses(sockets), counts),
            pace_bytes_per_s,
            route.queue,
            clock,
            sending,
        )
    }

    /// Opens a sender to the clients of a server, which limits the rate itself. Blocks are passed to the server when they are due.
    pub(crate) fn serve(
        server: Arc<SonarServer>,
        queue: usize,
        clock: Arc<dyn Clock>,
        sending: Sending,
    ) -> std::io::Result<Self> {
        let far = Destination::Clients {
            server: Arc::clone(&server),
            pool: DatagramPool::new(0, MAX_KEPT_BUFFERS),
        };
        let far = (far, DatagramCounts::default());
        let mut sender = Self::start(far, f64::INFINITY, queue, clock, sending)?;
        sender.server = Some(server);
        Ok(sender)
    }

    fn start(
        (far, counts): (Destination, DatagramCounts),
        pace_bytes_per_s: f64,
        queue: usize,
        clock: Arc<dyn Clock>,
        sending: Sending,
    ) -> std::io::Result<Self> {
        let (full, pings) = bounded(queue);
        let (give_back, empty) = bounded(queue + 1);
        let counts = Arc::new(counts);
        let machine = SystemClock::new();
        let mut line = Transmission {
            bucket: Bucket::new(pace_bytes_per_s, machine.mono()),
            pace_bytes_per_s,
            far,
            clock,
            machine,
            counts: Arc::clone(&counts),
            sending,
        };
        let thread = thread::Builder::new()
            .name("datagrams".into())
            .spawn(move || {
                line.sending.begin();
                for (ping, send_times) in pings {
                    line.send(&ping, send_times);
                    // Full only if more buffers exist than the queue holds. The buffer is then freed.
                    let _ = give_back.try_send(ping);
                }
            })?;
        Ok(Self {
            full: Some(full),
            empty,
            counts,
            thread: Some(thread),
            faulty: Mutex::default(),
            server: None,
        })
    }

    /// Sends all further pings through the faulty link `line`.
    pub(crate) fn set_line(&self, line: Box<dyn OutputLink>) {
        *self.faulty.lock().unwrap_or_else(PoisonError::into_inner) = Some(line);
    }

    pub(crate) fn counts(&self) -> &Arc<DatagramCounts> {
        &self.counts
    }

    /// Returns a buffer for the next ping, reused if possible.
    pub(crate) fn buffer(&self) -> Packets {
        self.empty.try_recv().unwrap_or_default()
    }

    /// Queues a ping. Returns false if the queue is full.
    pub(crate) fn send(&self, mut ping: Packets, send_times: SendTimes) -> bool {
        let mut faulty = self.faulty.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(line) = &mut *faulty {
            if let Some(server) = &self.server {
                server.connect(line.connection());
            }
            line.packets(&mut ping);
        }
        drop(faulty);
        let queued = self
            .full
            .as_ref()
            .is_some_and(|full| full.try_send((ping, send_times)).is_ok());
        if !queued {
            self.counts.dropped_pings.fetch_add(1, Ordering::Relaxed);
        }
        queued
    }
}

impl Drop for DatagramSender {
    fn drop(&mut self) {
        self.full = None;
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

fn socket_for(to: SocketAddr, route: &Route) -> std::io::Result<UdpSocket> {
    let any: SocketAddr = match to {
        SocketAddr::V4(_) => (Ipv4Addr::UNSPECIFIED, 0).into(),
        SocketAddr::V6(_) => (std::net::Ipv6Addr::UNSPECIFIED, 0).into(),
    };
    let domain = socket2::Domain::for_address(to);
    let socket = socket2::Socket::new(domain, socket2::Type::DGRAM, Some(socket2::Protocol::UDP))?;
    // The kernel may grant less.
    let _ = socket.set_send_buffer_size(SEND_BUFFER_BYTES);
    if to.ip().is_multicast() && to.is_ipv4() {
        socket.set_multicast_if_v4(&route.multicast_interface)?;
        socket.set_multicast_ttl_v4(route.multicast_ttl)?;
        socket.set_multicast_loop_v4(true)?;
    }
    socket.bind(&any.into())?;
    Ok(socket.into())
}

/// Destination of the packets.
enum Destination {
    Addresses(Vec<(UdpSocket, SockAddr)>),
    Clients {
        server: Arc<SonarServer>,
        pool: DatagramPool,
    },
}

/// State of the sending thread.
struct Transmission {
    far: Destination,
    bucket: Bucket,
    pace_bytes_per_s: f64,
    clock: Arc<dyn Clock>,
    /// Clock of the rate limit. The limit protects real links and boards, so it applies to machine time.
    machine: SystemClock,
    counts: Arc<DatagramCounts>,
    sending: Sending,
}

impl Transmission {
    fn send(&mut self, ping: &Packets, send_times: SendTimes) {
        let rate = match send_times {
            SendTimes::Over(over_s) if over_s > 0.0 => {
                self.pace_bytes_per_s.min(ping.len_bytes() as f64 / over_s)
            }
            _ => self.pace_bytes_per_s,
        };
        self.bucket.set_rate(rate, self.machine.mono());
        for (block, received_s) in ping.blocks() {
            if let (SendTimes::AsReceived { pulse, latency_s }, Some(received_s)) =
                (send_times, received_s)
            {
                let due = pulse.plus_s(received_s + latency_s);
                self.clock.sleep_until(due);
                self.sending.note(self.clock.mono().0 - due.0);
            }
            self.send_block(ping, block);
        }
    }

    fn send_block(&mut self, ping: &Packets, block: std::ops::Range<usize>) {
        let mut next = block.start;
        while next < block.end {
            let lengths = (next..block.end).map(|k| ping.packet(k).len());
            let (count, bytes) = self.bucket.group(lengths);
            let due = self.bucket.due(bytes, self.machine.mono());
            self.machine.sleep_until(due);
            let now = self.machine.mono();
            self.sending.note(now.0 - due.0);
            self.bucket.take(bytes, now);
            let group: Vec<&[u8]> = (next..next + count).map(|k| ping.packet(k)).collect();
            match &mut self.far {
                Destination::Addresses(sockets) => {
                    for ((socket, to), receiver) in sockets.iter().zip(&self.counts.receivers) {
                        receiver.send(socket, to, &group);
                    }
                }
                Destination::Clients { server, pool } => {
                    let frames = group
                        .iter()
                        .map(|frame| pool.write(|buffer| buffer.extend_from_slice(frame)));
                    server.deliver(&frames.collect::<Vec<_>>());
                    let handed_over = group.len() as u64;
                    self.counts
                        .to_clients
                        .fetch_add(handed_over, Ordering::Relaxed);
                }
            }
            next += count;
        }
    }
}

impl ReceiverCounts {
    fn sent(&self, packets: &[&[u8]]) {
        let bytes: usize = packets.iter().map(|packet| packet.len()).sum();
        self.packets
            .fetch_add(packets.len() as u64, Ordering::Relaxed);
        self.bytes.fetch_add(bytes as u64, Ordering::Relaxed);
    }

    /// Sends a group to one destination. A failure does not affect the other destinations.
    fn send(&self, socket: &UdpSocket, to: &SockAddr, group: &[&[u8]]) {
        let mut rest = group;
        while !rest.is_empty() {
            let (gone, result) = send_batch(socket, to, rest);
            let failed = usize::from(result.is_err());
            self.sent(&rest[..gone]);
            self.failed.fetch_add(failed as u64, Ordering::Relaxed);
            rest = &rest[(gone + failed).min(rest.len())..];
        }
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    fn route(send_to: Vec<SocketAddr>, pace_bytes_per_s: f64) -> Route {
        Route {
            send_to,
            multicast_interface: Ipv4Addr::LOCALHOST,
            multicast_ttl: 0,
            pace_bytes_per_s,
            queue: 2,
        }
    }

    fn open(route: Route) -> DatagramSender {
        let clock = Arc::new(SystemClock::new());
        DatagramSender::open(route, clock, Sending::default()).expect("opens")
    }

    const AT_ONCE: SendTimes = SendTimes::Over(0.0);

    fn ping_of(bytes: &[&[u8]]) -> Packets {
        let mut packets = Packets::default();
        bytes.iter().for_each(|packet| packets.push(packet));
        packets
    }

    #[test]
    fn every_address_gets_every_packet_in_order() {
        let inboxes = [(); 2].map(|()| UdpSocket::bind("127.0.0.1:0").expect("a socket"));
        let to = inboxes.each_ref().map(|s| s.local_addr().expect("address"));
        let sender = open(route(to.to_vec(), 1e9));
        assert!(sender.send(ping_of(&[b"one", b"three"]), AT_ONCE));
        let counts = sender.counts().clone();
        drop(sender);
        for (receiver, &to) in counts.receivers.iter().zip(&to) {
            let read = |count: &AtomicU64| count.load(Ordering::Relaxed);
            assert_eq!(receiver.to, to);
            assert_eq!((read(&receiver.packets), read(&receiver.bytes)), (2, 8));
            assert_eq!(read(&receiver.failed), 0);
        }
        for inbox in inboxes {
            inbox
                .set_read_timeout(Some(Duration::from_secs(10)))
                .expect("set");
            let mut buffer = [0; 16];
            for want in [&b"one"[..], b"three"] {
                let len = inbox.recv(&mut buffer).expect("a packet");
                assert_eq!(&buffer[..len], want);
            }
        }
    }

    #[test]
    fn a_group_is_reached_on_the_interface_that_was_named() {
        let inbox = UdpSocket::bind("0.0.0.0:0").expect("a socket");
        let group = Ipv4Addr::new(239, 255, 73, 1);
        if inbox
            .join_multicast_v4(&group, &Ipv4Addr::LOCALHOST)
            .is_err()
        {
            return; // the loopback of this machine has no multicast
        }
        inbox
            .set_read_timeout(Some(Duration::from_secs(10)))
            .expect("set");
        let port = inbox.local_addr().expect("address").port();
        let sender = open(route(vec![(group, port).into()], 1e9));
        sender.send(ping_of(&[b"group"]), AT_ONCE);
        drop(sender);
        let mut buffer = [0; 16];
        let len = inbox.recv(&mut buffer).expect("a packet");
        assert_eq!(&buffer[..len], b"group");
    }

    #[test]
    fn a_full_queue_drops_whole_pings_and_never_waits() {
        let inbox = UdpSocket::bind("127.0.0.1:0").expect("a socket");
        let to = inbox.local_addr().expect("address");
        // A burst lasts half a second at this rate.
        let sender = open(route(vec![to], 65_536.0));
        let large = vec![0; 32 * 1024];
        let queued = (0..20)
            .filter(|_| sender.send(ping_of(&[&large]), AT_ONCE))
            .count();
        assert!(queued < 20, "20 pings in a queue of 2");
        let dropped = sender.counts().dropped_pings.load(Ordering::Relaxed);
        assert_eq!(dropped as usize, 20 - queued);
    }

    #[test]
    fn a_block_leaves_when_it_has_been_heard_and_not_before() {
        let inbox = UdpSocket::bind("127.0.0.1:0").expect("a socket");
        let patience = Some(Duration::from_secs(10));
        inbox.set_read_timeout(patience).expect("set");
        let to = inbox.local_addr().expect("address");
        let clock = Arc::new(SystemClock::new());
        let route = route(vec![to], 1e9);
        let sender = DatagramSender::open(route, clock.clone(), Sending::default()).expect("opens");
        let mut ping = Packets::default();
        for k in 1..=3_u8 {
            ping.push(&[k]);
            ping.push(&[10 * k]);
            ping.end_block(f64::from(k) * 0.02);
        }
        let pulse = clock.mono().plus_s(0.05);
        let latency_s = 0.005;
        assert!(sender.send(ping, SendTimes::AsReceived { pulse, latency_s }));
        let mut buffer = [0; 4];
        for (k, want) in [1, 10, 2, 20, 3, 30].into_iter().enumerate() {
            assert_eq!(inbox.recv(&mut buffer).expect("a packet"), 1);
            assert_eq!(buffer[0], want);
            let after_s = clock.mono().seconds_since(pulse);
            let received_s = (k / 2 + 1) as f64 * 0.02;
            assert!(after_s >= received_s + latency_s, "{after_s} {received_s}");
        }
    }

    #[test]
    fn a_ping_is_spread_over_the_time_it_is_given() {
        let inbox = UdpSocket::bind("127.0.0.1:0").expect("a socket");
        let to = inbox.local_addr().expect("address");
        let sender = open(route(vec![to], 1e9));
        let packet = vec![0; 1472];
        let packets: Vec<&[u8]> = (0..100).map(|_| packet.as_slice()).collect();
        let began = std::time::Instant::now();
        sender.send(ping_of(&packets), SendTimes::Over(0.2));
        drop(sender);
        // All but the first bucketful.
        let min_s = 0.2 * (1.0 - 32.0 * 1024.0 / 147_200.0) - 1e-3;
        let took_s = began.elapsed().as_secs_f64();
        assert!(took_s >= min_s, "{took_s} s, not below {min_s} s");
    }
}
