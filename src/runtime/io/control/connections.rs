//! Connections of the control server. Limits on their number and duration keep sockets available for other clients and the sonar protocols.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use axum::extract::connect_info::ConnectInfo;
use axum::{Extension, Router};
use hyper::server::conn::http1;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{Semaphore, watch};
use tokio::task::JoinSet;
use tokio::time::sleep;
use tracing::{debug, warn};

use crate::io::tcp::end_if_dead;

/// Maximum number of connections, apart from those of open pages, which [`super::socket`] limits.
const MAX_CONNECTIONS: usize = 64;
/// Time limit for the header of a request, and for the pause between two requests.
const HEADER_TIMEOUT: Duration = Duration::from_secs(5);
/// Time limit for the client to acknowledge a response.
const UNACKNOWLEDGED: Duration = Duration::from_secs(30);
/// Pause after a failed accept: without free file descriptors the next one fails at once.
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);

/// Serves connections until the server stops, then waits until the current requests are complete.
pub(super) async fn serve(
    listener: TcpListener,
    routes: Router,
    mut stopped: watch::Receiver<bool>,
) {
    let seats = Arc::new(Semaphore::new(MAX_CONNECTIONS));
    let mut connections = JoinSet::new();
    let mut is_full = false;
    loop {
        let accepted = tokio::select! {
            _ = stopped.wait_for(|&stop| stop) => break,
            Some(_) = connections.join_next() => continue,
            accepted = listener.accept() => accepted,
        };
        let (stream, peer) = match accepted {
            Ok(accepted) => accepted,
            Err(error) => {
                warn!(%error, "cannot accept a connection");
                sleep(ACCEPT_PAUSE).await;
                continue;
            }
        };
        let Ok(seat) = Arc::clone(&seats).try_acquire_owned() else {
            if !std::mem::replace(&mut is_full, true) {
                warn!(client = %peer, MAX_CONNECTIONS, "connections refused: the server is full");
            }
            continue;
        };
        is_full = false;
        let (routes, stopped) = (routes.clone(), stopped.clone());
        connections.spawn(async move {
            serve_connection(stream, peer, routes, stopped).await;
            drop(seat);
        });
    }
    drop(listener);
    while connections.join_next().await.is_some() {}
}

async fn serve_connection(
    stream: TcpStream,
    peer: SocketAddr,
    routes: Router,
    mut stopped: watch::Receiver<bool>,
) {
    let _ = stream.set_nodelay(true);
    end_if_dead(&stream, UNACKNOWLEDGED);
    let service = TowerToHyperService::new(routes.layer(Extension(ConnectInfo(peer))));
    let connection = http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(HEADER_TIMEOUT)
        .serve_connection(TokioIo::new(stream), service)
        .with_upgrades();
    let mut connection = std::pin::pin!(connection);
    let stopping = async {
        let _ = stopped.wait_for(|&stop| stop).await;
    };
    let result = tokio::select! {
        result = &mut connection => Some(result),
        () = stopping => None,
    };
    let result = match result {
        Some(result) => result,
        None => {
            connection.as_mut().graceful_shutdown();
            connection.await
        }
    };
    if let Err(error) = result {
        debug!(client = %peer, %error, "connection ended");
    }
}
