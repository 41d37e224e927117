//! Options of TCP connections that detect a vanished peer.

use std::os::fd::AsFd;
use std::time::Duration;

use socket2::{SockRef, TcpKeepalive};

/// Probe times that detect an unreachable host within 25 s.
const KEEP_ALIVE: TcpKeepalive = TcpKeepalive::new()
    .with_time(Duration::from_secs(10))
    .with_interval(Duration::from_secs(5))
    .with_retries(3);

/// Maximum number of bytes that the kernel accepts before the connection has room for them. On a stream of a few kB/s the default buffer of the
/// kernel would hide a client that does not read for many minutes.
const UNSENT_BYTES: u32 = 128 * 1024;

/// Enables probes on an idle connection. `unacknowledged` is the time limit for the peer to acknowledge or accept sent data. Failures are ignored,
/// because the connection works without these options.
pub(super) fn end_if_dead(stream: &impl AsFd, unacknowledged: Duration) {
    let socket = SockRef::from(stream);
    let _ = socket.set_tcp_keepalive(&KEEP_ALIVE);
    #[cfg(target_os = "linux")]
    let _ = socket.set_tcp_user_timeout(Some(unacknowledged));
    #[cfg(not(target_os = "linux"))]
    let _ = unacknowledged;
}

/// Limits the unsent data in the kernel's buffer.
pub(super) fn limit_unsent(stream: &impl AsFd) {
    #[cfg(target_os = "linux")]
    let _ = SockRef::from(stream).set_tcp_notsent_lowat(UNSENT_BYTES);
    #[cfg(not(target_os = "linux"))]
    let _ = stream;
}
