//! Options of TCP connections that end those whose other end is gone.

use std::os::fd::AsFd;
use std::time::Duration;

use socket2::{SockRef, TcpKeepalive};

/// A host that no longer answers is noticed within 25 s.
const KEEP_ALIVE: TcpKeepalive = TcpKeepalive::new()
    .with_time(Duration::from_secs(10))
    .with_interval(Duration::from_secs(5))
    .with_retries(3);

/// Bytes that the kernel takes before the connection has room for them. Beyond them a client that does not read is noticed: on a stream of a few
/// kB/s the kernel's own buffer would hide it for many minutes.
const UNSENT_BYTES: u32 = 128 * 1024;

/// Sends probes on an idle connection. `unacknowledged`: limit for the other end to acknowledge or take what was sent. Without these options the
/// connection works.
pub(super) fn end_if_dead(stream: &impl AsFd, unacknowledged: Duration) {
    let socket = SockRef::from(stream);
    let _ = socket.set_tcp_keepalive(&KEEP_ALIVE);
    #[cfg(target_os = "linux")]
    let _ = socket.set_tcp_user_timeout(Some(unacknowledged));
    #[cfg(not(target_os = "linux"))]
    let _ = unacknowledged;
}

/// Limits what the kernel keeps unsent.
pub(super) fn limit_unsent(stream: &impl AsFd) {
    #[cfg(target_os = "linux")]
    let _ = SockRef::from(stream).set_tcp_notsent_lowat(UNSENT_BYTES);
    #[cfg(not(target_os = "linux"))]
    let _ = stream;
}
