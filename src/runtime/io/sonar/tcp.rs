//! TCP clients: one task each, which reads commands and writes records concurrently.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use socket2::SockRef;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::tcp::{OwnedReadHalf, OwnedWriteHalf};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::watch;
use tokio::task::JoinSet;
use tokio::time::{Instant, sleep, timeout, timeout_at};
use tracing::warn;

use super::queue::Client;
use super::{ClientSlot, Shared, Transport, stopping};
use crate::io::pace::stream::set_pace;
use crate::io::tcp;

const READ_BYTES: usize = 16 * 1024;

/// Pause after a failed accept: without free file descriptors the next one fails at once.
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);

pub(super) async fn serve(
    listener: std::net::TcpListener,
    shared: Arc<Shared>,
    mut stopped: watch::Receiver<bool>,
) {
    let listener = TcpListener::from_std(listener).expect("inside a runtime with I/O enabled");
    let mut clients = JoinSet::new();
    loop {
        tokio::select! {
            () = stopping(&mut stopped) => break,
            accepted = listener.accept() => match accepted {
                Ok((stream, peer)) => {
                    if let Some(slot) = shared.admit(peer, Transport::Tcp, false) {
                        clients.spawn(serve_client(stream, slot, stopped.clone()));
                    }
                }
                Err(error) => {
                    shared.span.in_scope(|| warn!(%error, "cannot accept a connection"));
                    sleep(ACCEPT_PAUSE).await;
                }
            },
            // Removes finished tasks. A task that panicked has already dropped its slot.
            Some(_) = clients.join_next() => {}
        }
    }
    drop(listener);
    while clients.join_next().await.is_some() {}
}

/// Sets the socket options of a client's connection. Failures are ignored, because the connection works without the options.
pub(super) fn prepare(stream: &TcpStream, shared: &Shared) {
    let _ = stream.set_nodelay(true);
    tcp::end_if_dead(stream, shared.times.tcp_unacknowledged);
    tcp::limit_unsent(stream);
}

async fn serve_client(stream: TcpStream, slot: ClientSlot, mut stopped: watch::Receiver<bool>) {
    prepare(&stream, &slot.shared);
    let (read_half, write_half) = stream.into_split();
    let (shared, client) = (&slot.shared, &slot.client);
    let drain = shared.times.drain;
    let mut writer = std::pin::pin!(write_records(write_half, shared, client, stopped.clone()));
    tokio::select! {
        () = &mut writer => {}
        () = read_commands(read_half, shared, client) => {
            client.leave();
            let _ = timeout(drain, &mut writer).await;
        }
        () = async { stopping(&mut stopped).await; sleep(drain).await } => {}
    }
}

/// Reads commands until the client closes the connection.
async fn read_commands(mut stream: OwnedReadHalf, shared: &Shared, client: &Client) {
    let mut session = shared.open_session(client);
    let mut buffer = vec![0; READ_BYTES];
    // Start of the incomplete command, or instant of the last decoded command.
    let mut since = Instant::now();
    loop {
        if session.is_over() {
            return;
        }
        client.room_for_replies().await;
        shared.unmuted().await;
        let read = if session.is_waiting() {
            timeout_at(since + shared.times.stall, stream.read(&mut buffer)).await
        } else {
            let read = stream.read(&mut buffer).await;
            since = Instant::now();
            Ok(read)
        };
        let before = session.counts();
        match read {
            Ok(Ok(len)) if len > 0 => {
                client.note_received();
                shared.run_step(client, &mut *session, |session, now, out| {
                    session.receive(&buffer[..len], now, out);
                });
                if session.counts() != before {
                    since = Instant::now();
                }
            }
            Err(_stalled) => {
                shared.run_step(client, &mut *session, |session, now, out| {
                    session.give_up_waiting(now, out);
                });
                since = Instant::now();
            }
            Ok(Ok(_) | Err(_)) => {
                return shared.run_step(client, &mut *session, |session, now, out| {
                    session.give_up_waiting(now, out);
                });
            }
        }
    }
}

/// Writes records until the socket fails, or the client leaves and everything is written.
pub(super) async fn write_records(
    mut stream: OwnedWriteHalf,
    shared: &Shared,
    client: &Client,
    stopped: watch::Receiver<bool>,
) {
    write_all(&mut stream, shared, client, stopped).await;
    if client.is_reset() {
        // Closing then resets the connection and discards unsent data.
        let _ = SockRef::from(stream.as_ref()).set_linger(Some(Duration::ZERO));
        stream.forget();
    }
}

async fn write_all(
    stream: &mut OwnedWriteHalf,
    shared: &Shared,
    client: &Client,
    mut stopped: watch::Receiver<bool>,
) {
    let mut framer = shared.protocol.framer(Transport::Tcp);
    let (mut wire, mut packets) = (Vec::new(), Vec::new());
    let mut pace_bytes_per_s = f64::INFINITY;
    loop {
        tokio::select! {
            () = shared.unmuted() => {}
            () = client.gone() => return,
            () = stopping(&mut stopped) => {}
        }
        while let Some(taken) = client.take() {
            let wanted = match shared.paces_tcp.load(Ordering::Relaxed) {
                true => client.pace_bytes_per_s(&taken),
                false => f64::INFINITY,
            };
            if wanted != pace_bytes_per_s {
                // Without SO_MAX_PACING_RATE the record is sent at once.
                let _ = set_pace(stream.as_ref(), wanted);
                pace_bytes_per_s = wanted;
            }
            wire.clear();
            packets.clear();
            framer.frame(&taken.datagram.bytes, &mut wire, &mut packets);
            let result = tokio::select! {
                result = stream.write_all(&wire) => result.is_ok(),
                () = client.gone() => false,
            };
            client.written(taken, result.then_some(wire.len()));
            if !result {
                return;
            }
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
