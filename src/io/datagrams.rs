//! Datagrams that are sent whether or not anybody listens, no faster than a given pace, by a thread of their own.
//!
//! In: the packets of a ping. A ping that finds the queue full is not sent at all, and counted. An address that cannot be reached costs its
//! packets only, counted too.

use std::net::{Ipv4Addr, SocketAddr, UdpSocket};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use crossbeam_channel::{Receiver, Sender, bounded};

use crate::emit::vita49::Packets;

/// Asked of the operating system for each socket, so that a burst is not lost between two of our looks at the clock.
const SEND_BUFFER_BYTES: usize = 1 << 20;
/// Packets are sent in bursts of at most this, then the clock is looked at.
const BURST_BYTES: usize = 32 * 1024;

/// Where packets go.
#[derive(Clone, Debug)]
pub struct Route {
    pub send_to: Vec<SocketAddr>,
    pub multicast_interface: Ipv4Addr,
    pub multicast_ttl: u32,
    pub pace_bytes_per_s: f64,
    /// Pings that may wait.
    pub queue: usize,
}

/// What was sent.
#[derive(Debug, Default)]
pub struct DatagramCounts {
    /// One for each address, in the order of [`Route::send_to`].
    pub receivers: Vec<ReceiverCounts>,
    /// Pings that found the queue full.
    pub dropped_pings: AtomicU64,
}

/// What was sent to one address.
#[derive(Debug)]
pub struct ReceiverCounts {
    pub to: SocketAddr,
    pub packets: AtomicU64,
    pub bytes: AtomicU64,
    /// Packets that the operating system refused.
    pub failed: AtomicU64,
}

/// The near end of the sending thread. Stops, with everything queued sent, when dropped.
pub struct DatagramSender {
    full: Option<Sender<Packets>>,
    empty: Receiver<Packets>,
    counts: Arc<DatagramCounts>,
    thread: Option<JoinHandle<()>>,
}

impl DatagramSender {
    pub fn open(route: Route) -> std::io::Result<Self> {
        let sockets = route
            .send_to
            .iter()
            .map(|to| Ok((socket_for(*to, &route)?, *to)))
            .collect::<std::io::Result<Vec<_>>>()?;
        let (full, packets) = bounded::<Packets>(route.queue);
        let (give_back, empty) = bounded(route.queue + 1);
        let receivers = route.send_to.iter().map(|&to| ReceiverCounts {
            to,
            packets: AtomicU64::new(0),
            bytes: AtomicU64::new(0),
            failed: AtomicU64::new(0),
        });
        let counts = Arc::new(DatagramCounts {
            receivers: receivers.collect(),
            dropped_pings: AtomicU64::new(0),
        });
        let shared = Arc::clone(&counts);
        let thread = thread::Builder::new()
            .name("datagrams".into())
            .spawn(move || {
                let mut pace = Pace::new(route.pace_bytes_per_s);
                for ping in packets {
                    send(&ping, &sockets, &mut pace, &shared);
                    // Full only if somebody keeps more buffers than the queue holds: then this one is let go.
                    let _ = give_back.try_send(ping);
                }
            })?;
        Ok(Self {
            full: Some(full),
            empty,
            counts,
            thread: Some(thread),
        })
    }

    pub fn counts(&self) -> &Arc<DatagramCounts> {
        &self.counts
    }

    /// A buffer for the next ping, used before if there is one.
    pub fn buffer(&self) -> Packets {
        self.empty.try_recv().unwrap_or_default()
    }

    /// Queues a ping; false if there was no room.
    pub fn send(&self, ping: Packets) -> bool {
        let queued = self
            .full
            .as_ref()
            .is_some_and(|full| full.try_send(ping).is_ok());
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
    // As much as the system gives.
    let _ = socket.set_send_buffer_size(SEND_BUFFER_BYTES);
    if to.ip().is_multicast() && to.is_ipv4() {
        socket.set_multicast_if_v4(&route.multicast_interface)?;
        socket.set_multicast_ttl_v4(route.multicast_ttl)?;
        socket.set_multicast_loop_v4(true)?;
    }
    socket.bind(&any.into())?;
    Ok(socket.into())
}

fn send(
    ping: &Packets,
    sockets: &[(UdpSocket, SocketAddr)],
    pace: &mut Pace,
    counts: &DatagramCounts,
) {
    for packet in ping.iter() {
        for ((socket, to), receiver) in sockets.iter().zip(&counts.receivers) {
            match socket.send_to(packet, to) {
                Ok(sent) => {
                    receiver.packets.fetch_add(1, Ordering::Relaxed);
                    receiver.bytes.fetch_add(sent as u64, Ordering::Relaxed);
                }
                Err(_) => {
                    receiver.failed.fetch_add(1, Ordering::Relaxed);
                }
            }
        }
        pace.after(packet.len());
    }
}

/// Sleeps so that no more than so many bytes a second go out.
struct Pace {
    bytes_per_s: f64,
    burst: usize,
    /// When the next burst may begin.
    next: Instant,
}

impl Pace {
    fn new(bytes_per_s: f64) -> Self {
        Self {
            bytes_per_s,
            burst: 0,
            next: Instant::now(),
        }
    }

    fn after(&mut self, bytes: usize) {
        self.burst += bytes;
        if self.burst < BURST_BYTES {
            return;
        }
        let lasts = Duration::from_secs_f64(self.burst as f64 / self.bytes_per_s);
        self.burst = 0;
        let now = Instant::now();
        // Time that was not used is not saved up.
        self.next = self.next.max(now) + lasts;
        thread::sleep(self.next - now);
    }
}

#[cfg(test)]
mod tests {
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

    fn ping_of(bytes: &[&[u8]]) -> Packets {
        let mut packets = Packets::default();
        bytes.iter().for_each(|packet| packets.push(packet));
        packets
    }

    #[test]
    fn every_address_gets_every_packet_in_order() {
        let inboxes = [(); 2].map(|()| UdpSocket::bind("127.0.0.1:0").expect("a socket"));
        let to = inboxes.each_ref().map(|s| s.local_addr().expect("address"));
        let sender = DatagramSender::open(route(to.to_vec(), 1e9)).expect("opens");
        assert!(sender.send(ping_of(&[b"one", b"three"])));
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
            return; // a machine whose loopback knows no groups
        }
        inbox
            .set_read_timeout(Some(Duration::from_secs(10)))
            .expect("set");
        let port = inbox.local_addr().expect("address").port();
        let sender = DatagramSender::open(route(vec![(group, port).into()], 1e9)).expect("opens");
        sender.send(ping_of(&[b"group"]));
        drop(sender);
        let mut buffer = [0; 16];
        let len = inbox.recv(&mut buffer).expect("a packet");
        assert_eq!(&buffer[..len], b"group");
    }

    #[test]
    fn a_full_queue_drops_whole_pings_and_never_waits() {
        let inbox = UdpSocket::bind("127.0.0.1:0").expect("a socket");
        let to = inbox.local_addr().expect("address");
        // A burst lasts half a second at this pace.
        let sender = DatagramSender::open(route(vec![to], 65_536.0)).expect("opens");
        let large = vec![0; BURST_BYTES];
        let queued = (0..20).filter(|_| sender.send(ping_of(&[&large]))).count();
        assert!(queued < 20, "20 pings in a queue of 2");
        let dropped = sender.counts().dropped_pings.load(Ordering::Relaxed);
        assert_eq!(dropped as usize, 20 - queued);
    }
}
