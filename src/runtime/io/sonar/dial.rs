//! Outgoing connections: clients that the server contacts at the request of a session.

use std::io::ErrorKind;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use tokio::io::AsyncReadExt;
use tokio::net::{TcpStream, UdpSocket};
use tokio::sync::{mpsc, watch};
use tokio::task::JoinSet;
use tokio::time::{sleep, timeout};
use tracing::warn;

use crate::io::icmp;

use super::{ClientSlot, Shared, Transport, Wants, stopping, tcp, udp};

/// Time limit of a TCP connection attempt.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(5);

pub(super) struct Dial {
    pub peer: SocketAddr,
    pub transport: Transport,
    pub wants: Wants,
}

pub(super) async fn serve(
    mut dials: mpsc::UnboundedReceiver<Dial>,
    shared: Arc<Shared>,
    mut stopped: watch::Receiver<bool>,
) {
    let mut clients = JoinSet::new();
    loop {
        tokio::select! {
            () = stopping(&mut stopped) => break,
            dial = dials.recv() => match dial {
                Some(dial) => {
                    // A repeated request replaces the selection of records.
                    shared.hang_up(dial.peer, dial.transport);
                    if let Some(slot) = shared.admit(dial.peer, dial.transport, true) {
                        clients.spawn(serve_client(dial, slot, stopped.clone()));
                    }
                }
                None => break,
            },
            Some(_) = clients.join_next() => {}
        }
    }
    let all_written = async { while clients.join_next().await.is_some() {} };
    let _ = timeout(shared.times.drain, all_written).await;
}

async fn serve_client(dial: Dial, slot: ClientSlot, mut stopped: watch::Receiver<bool>) {
    let begin = |slot: &ClientSlot| {
        slot.client.want(dial.wants, Wants::NONE);
        slot.shared.update_wanted(&slot.shared.lock());
    };
    match dial.transport {
        Transport::Udp => {
            let from = SocketAddr::new(slot.shared.local_addr.ip(), 0);
            let socket = match UdpSocket::bind(from).await {
                Ok(socket) => socket,
                Err(error) => {
                    slot.shared.span.in_scope(
                        || warn!(client = %dial.peer, %error, "cannot open a UDP socket"),
                    );
                    return;
                }
            };
            icmp::enable(&socket, from);
            begin(&slot);
            let (client, unrenewed) = (Arc::clone(&slot.client), slot.shared.times.dial_udp);
            let end = async {
                sleep(unrenewed).await;
                client.leave();
                std::future::pending().await
            };
            tokio::select! {
                () = udp::write_datagrams(Arc::new(socket), dial.peer, slot, stopped) => {}
                () = end => {}
            }
        }
        Transport::Tcp => {
            let connect = timeout(CONNECT_TIMEOUT, TcpStream::connect(dial.peer));
            let stream = tokio::select! {
                stream = connect => stream,
                () = stopping(&mut stopped) => return,
            };
            let stream = match stream.unwrap_or_else(|_| Err(ErrorKind::TimedOut.into())) {
                Ok(stream) => stream,
                Err(error) => {
                    slot.shared
                        .span
                        .in_scope(|| warn!(client = %dial.peer, %error, "cannot connect"));
                    return;
                }
            };
            tcp::prepare(&stream, &slot.shared);
            begin(&slot);
            let (mut read_half, write_half) = stream.into_split();
            let closed = async {
                let mut rubbish = [0; 256];
                while matches!(read_half.read(&mut rubbish).await, Ok(1..)) {}
            };
            let drain = slot.shared.times.drain;
            tokio::select! {
                () = tcp::write_records(write_half, &slot.shared, &slot.client, stopped.clone()) => {}
                () = closed => {}
                () = async { stopping(&mut stopped).await; sleep(drain).await } => {}
            }
        }
    }
}
