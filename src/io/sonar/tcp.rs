//! TCP clients: one task each, that reads commands and writes records side by side.

use std::sync::Arc;
use std::time::Duration;

use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::tcp::{OwnedReadHalf, OwnedWriteHalf};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::watch;
use tokio::task::JoinSet;
use tokio::time::{Instant, sleep, timeout, timeout_at};

use echotank_protocols::sevenk::Packetiser;

use super::queue::Client;
use super::{Seat, Shared, Transport, stopping};
use crate::emit::sevenk::session::Session;

const READ_BYTES: usize = 16 * 1024;

/// Pause after a failed accept: with no file descriptors left, the next one would fail at once.
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
                    if let Some(seat) = shared.admit(peer, Transport::Tcp) {
                        clients.spawn(attend(stream, seat, stopped.clone()));
                    }
                }
                Err(_) => {
                    shared.lock().accept_errors += 1;
                    sleep(ACCEPT_PAUSE).await;
                }
            },
            // Keeps the set small; a task that panicked has given up its seat and hurts nobody else.
            Some(_) = clients.join_next() => {}
        }
    }
    drop(listener);
    while clients.join_next().await.is_some() {}
}

async fn attend(stream: TcpStream, seat: Seat, mut stopped: watch::Receiver<bool>) {
    // Records go out as they are ready; a socket that cannot be told so is still a socket.
    let _ = stream.set_nodelay(true);
    let (read_half, write_half) = stream.into_split();
    let (shared, client) = (&seat.shared, &seat.client);
    let drain = shared.times.drain;
    let mut writer = std::pin::pin!(write_records(
        write_half,
        client,
        shared.packet.tcp,
        stopped.clone()
    ));
    tokio::select! {
        () = &mut writer => {}
        () = read_commands(read_half, shared, client) => {
            client.leave();
            let _ = timeout(drain, &mut writer).await;
        }
        () = async { stopping(&mut stopped).await; sleep(drain).await } => {}
    }
}

/// Returns when the client has closed.
async fn read_commands(mut stream: OwnedReadHalf, shared: &Shared, client: &Client) {
    let mut session = Session::stream();
    let mut buffer = vec![0; READ_BYTES];
    // When the record that waits for its rest was begun, or something last came of the bytes.
    let mut since = Instant::now();
    loop {
        client.room_for_replies().await;
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
                shared.converse(client, &mut session, |session, context, out| {
                    session.receive(&buffer[..len], context, out);
                });
                if session.counts() != before {
                    since = Instant::now();
                }
            }
            Err(_stalled) => {
                shared.converse(client, &mut session, |session, context, out| {
                    session.give_up_waiting(context, out);
                });
                since = Instant::now();
            }
            Ok(Ok(_) | Err(_)) => {
                return shared.converse(client, &mut session, |session, context, out| {
                    session.give_up_waiting(context, out);
                });
            }
        }
    }
}

/// Returns when the socket fails, or all is written and no more comes.
async fn write_records(
    mut stream: OwnedWriteHalf,
    client: &Client,
    max_packet_bytes: u32,
    mut stopped: watch::Receiver<bool>,
) {
    let mut packetiser = Packetiser::new(max_packet_bytes).expect("checked when the server opened");
    let mut wire = Vec::new();
    loop {
        while let Some(taken) = client.take() {
            wire.clear();
            packetiser.packetise(&taken.datagram.bytes, &mut wire);
            let result = stream.write_all(&wire).await;
            client.written(taken, result.is_ok().then_some(wire.len()));
            if result.is_err() {
                return;
            }
        }
        if client.is_leaving() || *stopped.borrow() {
            return;
        }
        tokio::select! {
            () = client.woken() => {}
            () = stopping(&mut stopped) => {}
        }
    }
}
