//! UDP clients: one shared socket, and one writing task per client.

use std::collections::HashMap;
use std::io::ErrorKind;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use tokio::net::UdpSocket;
use tokio::sync::watch;
use tokio::task::JoinSet;
use tokio::time::{Instant, interval, sleep, timeout};
use tracing::debug;

use super::paced::Burst;
use super::queue::Client;
use super::{ClientSlot, Shared, Transport, stopping};
use crate::io::icmp;
use crate::io::listening::is_own;
use echotank_emit::session::Session;

/// Maximum interval between searches for silent clients.
const SWEEP: Duration = Duration::from_millis(500);
/// Pause after a failed receive; with a broken socket the loop would otherwise not pause.
const RECEIVE_PAUSE: Duration = Duration::from_millis(10);
/// Longest UDP datagram, bytes.
const RECEIVE_BYTES: usize = 65_536;

struct Peer {
    session: Box<dyn Session>,
    client: Arc<Client>,
    last_received: Instant,
}

pub(super) async fn serve(
    socket: std::net::UdpSocket,
    shared: Arc<Shared>,
    mut stopped: watch::Receiver<bool>,
) {
    icmp::enable(&socket, shared.local_addr);
    let socket = Arc::new(UdpSocket::from_std(socket).expect("inside a runtime with I/O enabled"));
    let mut peers: HashMap<SocketAddr, Peer> = HashMap::new();
    let mut writers = JoinSet::new();
    let mut buffer = vec![0; RECEIVE_BYTES];
    let mut sweep = interval(SWEEP.min(shared.times.udp_idle));
    loop {
        tokio::select! {
            () = stopping(&mut stopped) => break,
            received = socket.recv_from(&mut buffer) => match received {
                Ok((len, from)) => {
                    let datagram = &buffer[..len];
                    // A leaving client that sends again is a new client.
                    peers.retain(|_, peer| !peer.client.is_leaving());
                    if let Some(peer) = peers.get_mut(&from) {
                        peer.last_received = Instant::now();
                        receive(&shared, peer, datagram);
                    } else if let Some((mut peer, slot)) = admit(&shared, from, datagram) {
                        writers.spawn(write_datagrams(Arc::clone(&socket), from, slot, stopped.clone()));
                        receive(&shared, &mut peer, datagram);
                        peers.insert(from, peer);
                    }
                }
                Err(error) if error.kind() == ErrorKind::ConnectionRefused => {
                    end_refused(&socket, &mut peers);
                }
                Err(error) => {
                    shared.span.in_scope(|| debug!(%error, "cannot receive a datagram"));
                    sleep(RECEIVE_PAUSE).await;
                }
            },
            _ = sweep.tick() => {
                end_refused(&socket, &mut peers);
                peers.retain(|_, peer| !is_over(&shared, peer));
            }
            Some(_) = writers.join_next() => {}
        }
    }
    let all_written = async { while writers.join_next().await.is_some() {} };
    let _ = timeout(shared.times.drain, all_written).await;
}

/// Disconnects clients whose port is closed.
fn end_refused(socket: &UdpSocket, peers: &mut HashMap<SocketAddr, Peer>) {
    while let Some(peer) = icmp::next_refused(socket) {
        if let Some(peer) = peers.remove(&peer) {
            peer.client.disconnect();
        }
    }
}

fn receive(shared: &Shared, peer: &mut Peer, datagram: &[u8]) {
    peer.client.note_received();
    shared.run_step(&peer.client, &mut *peer.session, |session, now, out| {
        session.receive(datagram, now, out);
    });
}

/// Admits a sender whose datagram belongs to the protocol; other datagrams are only counted.
fn admit(shared: &Arc<Shared>, from: SocketAddr, datagram: &[u8]) -> Option<(Peer, ClientSlot)> {
    // The source address is forged: answers would come back as commands.
    if is_own(from) || !shared.protocol.recognises(datagram) {
        shared.lock().gone.framing_errors += 1;
        return None;
    }
    let slot = shared.admit(from, Transport::Udp, false)?;
    let peer = Peer {
        session: shared.open_session(&slot.client),
        client: Arc::clone(&slot.client),
        last_received: Instant::now(),
    };
    Some((peer, slot))
}

/// Whether a client was silent for too long; such a client is disconnected.
fn is_over(shared: &Shared, peer: &Peer) -> bool {
    let allowed = if peer.client.wants().is_empty() {
        shared.times.udp_idle
    } else {
        shared.times.udp_silence
    };
    let is_over = peer.last_received.elapsed() > allowed;
    if is_over {
        peer.client.leave();
    }
    is_over
}

/// Writes records until the client's port is closed, or the client leaves and everything is written.
pub(super) async fn write_datagrams(
    socket: Arc<UdpSocket>,
    to: SocketAddr,
    slot: ClientSlot,
    mut stopped: watch::Receiver<bool>,
) {
    let client = &slot.client;
    let mut framer = slot.shared.protocol.framer(Transport::Udp);
    let mut burst = Burst::empty(socket, to, !client.dialled);
    loop {
        while let Some(taken) = client.take() {
            burst.wire.clear();
            burst.packets.clear();
            framer.frame(&taken.datagram.bytes, &mut burst.wire, &mut burst.packets);
            burst.bytes_per_s = client.pace_bytes_per_s(&taken);
            // A record is abandoned when one of its packets fails.
            let sent = match slot.shared.paced() {
                Some(sender) => sender.send(burst).await,
                None => None,
            };
            let Some(mut back) = sent else {
                client.written(taken, None);
                client.leave();
                return;
            };
            let error = back.error.take();
            client.written(taken, error.is_none().then_some(back.wire.len()));
            if error.is_some_and(|error| error.kind() == ErrorKind::ConnectionRefused) {
                client.leave();
                return;
            }
            burst = back;
        }
        if client.is_leaving() || *stopped.borrow() {
            return;
        }
        tokio::select! {
            () = client.wait_for_datagram() => {}
            () = stopping(&mut stopped) => {}
        }
    }
}
