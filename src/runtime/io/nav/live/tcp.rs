//! TCP sources: a client of a server, or a server that reads its newest client.

use std::io::Read;
use std::net::{SocketAddr, TcpListener, TcpStream, ToSocketAddrs};
use std::sync::atomic::Ordering::Relaxed;
use std::time::Duration;

use tracing::{info, warn};

use crate::io::tcp::end_if_dead;

use super::{Outlet, READ_TIMEOUT, REOPEN_INTERVAL, is_timeout};

/// Time limit for the other end to acknowledge a probe.
const UNACKNOWLEDGED: Duration = Duration::from_secs(30);
/// Time limit of a connection attempt.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(1);

pub(super) fn listen(address: SocketAddr) -> std::io::Result<TcpListener> {
    let listener = TcpListener::bind(address)?;
    listener.set_nonblocking(true)?;
    Ok(listener)
}

/// Reads from the server at `address` and reconnects until stopped.
pub(super) fn read_server(address: &str, outlet: &Outlet) {
    let mut failing = false;
    while !outlet.stopped() {
        match connect(address) {
            Ok(stream) => {
                failing = false;
                info!(source = outlet.name, server = address, "connected");
                outlet.stats.reopened.fetch_add(1, Relaxed);
                read(stream, outlet, || false);
                info!(source = outlet.name, server = address, "disconnected");
            }
            Err(error) => {
                if !std::mem::replace(&mut failing, true) {
                    warn!(source = outlet.name, server = address, %error, "cannot connect; trying again");
                }
                outlet.stats.read_errors.fetch_add(1, Relaxed);
            }
        }
        outlet.pause(REOPEN_INTERVAL);
    }
}

fn connect(address: &str) -> std::io::Result<TcpStream> {
    let mut last = std::io::Error::other("no address");
    for address in address.to_socket_addrs()? {
        match TcpStream::connect_timeout(&address, CONNECT_TIMEOUT) {
            Ok(stream) => return Ok(stream),
            Err(error) => last = error,
        }
    }
    Err(last)
}

/// Reads from one client at a time; a new client replaces the previous one.
pub(super) fn read_clients(listener: &TcpListener, outlet: &Outlet) {
    let mut waiting = None;
    while !outlet.stopped() {
        let Some((stream, client)) = waiting.take().or_else(|| accept(listener)) else {
            std::thread::sleep(READ_TIMEOUT);
            continue;
        };
        outlet.stats.reopened.fetch_add(1, Relaxed);
        info!(source = outlet.name, %client, "client connected");
        read(stream, outlet, || {
            waiting = accept(listener);
            waiting.is_some()
        });
        info!(source = outlet.name, %client, "client disconnected");
    }
}

fn accept(listener: &TcpListener) -> Option<(TcpStream, SocketAddr)> {
    let (stream, client) = listener.accept().ok()?;
    stream.set_nonblocking(false).ok()?;
    Some((stream, client))
}

/// Reads until the other end closes the connection or `relieved` returns true. `relieved` is called between reads.
fn read(mut stream: TcpStream, outlet: &Outlet, mut relieved: impl FnMut() -> bool) {
    if stream.set_read_timeout(Some(READ_TIMEOUT)).is_err() {
        return;
    }
    // Keep-alive probes detect a server that vanished, so that the client reconnects.
    end_if_dead(&stream, UNACKNOWLEDGED);
    let mut buffer = vec![0; 65_536];
    while !outlet.stopped() && !relieved() {
        match stream.read(&mut buffer) {
            Ok(0) => return,
            Ok(len) => outlet.send(&buffer[..len], 0),
            Err(error) if is_timeout(&error) => {}
            Err(error) => {
                warn!(source = outlet.name, %error, "cannot read");
                outlet.stats.read_errors.fetch_add(1, Relaxed);
                return;
            }
        }
    }
}
