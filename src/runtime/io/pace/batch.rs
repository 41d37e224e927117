//! Sends several datagrams to one address in one system call (`sendmmsg`, Linux); elsewhere one call each.

use std::io::{self, ErrorKind};
use std::os::fd::{AsFd, AsRawFd};

use socket2::{SockAddr, SockRef};

/// Maximum number of datagrams per call. A 1 ms group at 41 MB/s in Ethernet frames has 28 datagrams.
#[cfg(target_os = "linux")]
const MAX_BATCH: usize = 64;
/// Maximum wait for room in a full send buffer, ms. After this time the datagram fails.
const POLL_TIMEOUT_MS: libc::c_int = 200;

/// Sends in order until all datagrams are sent or one fails. Returns the number sent. Waits for room in a full buffer on non-blocking sockets too.
pub(crate) fn send_batch(
    socket: &impl AsFd,
    to: &SockAddr,
    packets: &[&[u8]],
) -> (usize, io::Result<()>) {
    send_with(socket, to, packets, send_some)
}

fn send_with<S: AsFd>(
    socket: &S,
    to: &SockAddr,
    packets: &[&[u8]],
    send: impl Fn(&S, &SockAddr, &[&[u8]]) -> io::Result<usize>,
) -> (usize, io::Result<()>) {
    let (mut gone, mut waited) = (0, false);
    while gone < packets.len() {
        match send(socket, to, &packets[gone..]) {
            Ok(count) => {
                gone += count;
                waited = false;
            }
            Err(error) if error.kind() == ErrorKind::Interrupted => {}
            Err(error) if error.kind() == ErrorKind::WouldBlock && !waited => {
                wait_for_room(socket);
                waited = true;
            }
            Err(error) => return (gone, Err(error)),
        }
    }
    (gone, Ok(()))
}

fn wait_for_room(socket: &impl AsFd) {
    let mut poll = libc::pollfd {
        fd: socket.as_fd().as_raw_fd(),
        events: libc::POLLOUT,
        revents: 0,
    };
    // SAFETY: one live structure, as the count says. The result is ignored: the next send shows the socket's state.
    unsafe { libc::poll(&mut poll, 1, POLL_TIMEOUT_MS) };
}

/// Sends one datagram. Returns the number sent.
#[cfg_attr(all(target_os = "linux", not(test)), allow(dead_code))]
fn send_one(socket: &impl AsFd, to: &SockAddr, packets: &[&[u8]]) -> io::Result<usize> {
    match packets.first() {
        Some(packet) => SockRef::from(socket).send_to(packet, to).map(|_| 1),
        None => Ok(0),
    }
}

#[cfg(not(target_os = "linux"))]
fn send_some(socket: &impl AsFd, to: &SockAddr, packets: &[&[u8]]) -> io::Result<usize> {
    send_one(socket, to, packets)
}

/// Sends at most [`MAX_BATCH`] datagrams. Returns the number sent, or the error of the first datagram.
#[cfg(target_os = "linux")]
fn send_some(socket: &impl AsFd, to: &SockAddr, packets: &[&[u8]]) -> io::Result<usize> {
    let count = packets.len().min(MAX_BATCH);
    let mut parts = [libc::iovec {
        iov_base: std::ptr::null_mut(),
        iov_len: 0,
    }; MAX_BATCH];
    // SAFETY: all zero is a valid mmsghdr: no address, no parts, no control data.
    let mut heads: [libc::mmsghdr; MAX_BATCH] = unsafe { std::mem::zeroed() };
    for ((packet, part), head) in packets.iter().zip(&mut parts).zip(&mut heads) {
        *part = libc::iovec {
            iov_base: packet.as_ptr().cast_mut().cast(),
            iov_len: packet.len(),
        };
        head.msg_hdr.msg_name = to.as_ptr().cast_mut().cast();
        head.msg_hdr.msg_namelen = to.len();
        head.msg_hdr.msg_iov = part;
        head.msg_hdr.msg_iovlen = 1;
    }
    let fd = socket.as_fd().as_raw_fd();
    // SAFETY: the first `count` heads are filled, each with one part that is a live slice and the live address; the kernel reads through
    // these pointers and writes only each head's msg_len. All of it outlives the call.
    let sent = unsafe { libc::sendmmsg(fd, heads.as_mut_ptr(), count as libc::c_uint, 0) };
    match usize::try_from(sent) {
        Ok(sent) => Ok(sent),
        Err(_) => Err(io::Error::last_os_error()),
    }
}

#[cfg(test)]
mod tests {
    use std::net::UdpSocket;
    use std::time::Duration;

    use super::*;

    fn pair() -> (UdpSocket, UdpSocket, SockAddr) {
        let inbox = UdpSocket::bind("127.0.0.1:0").expect("a socket");
        let patience = Some(Duration::from_secs(10));
        inbox.set_read_timeout(patience).expect("set");
        let outbox = UdpSocket::bind("127.0.0.1:0").expect("a socket");
        let to = inbox.local_addr().expect("an address").into();
        (outbox, inbox, to)
    }

    fn received(inbox: &UdpSocket, count: usize) -> Vec<Vec<u8>> {
        let mut buffer = vec![0; 65_536];
        (0..count)
            .map(|_| {
                let len = inbox.recv(&mut buffer).expect("a datagram");
                buffer[..len].to_vec()
            })
            .collect()
    }

    #[test]
    fn in_one_call_or_one_by_one_the_same_datagrams_arrive_in_order() {
        let (outbox, inbox, to) = pair();
        let packets: Vec<Vec<u8>> = (0..150_u8).map(|k| vec![k; usize::from(k)]).collect();
        let slices: Vec<&[u8]> = packets.iter().map(Vec::as_slice).collect();
        // Few enough for a default socket buffer.
        for part in slices.chunks(75) {
            let (gone, result) = send_batch(&outbox, &to, part);
            assert_eq!((gone, result.is_ok()), (part.len(), true));
            assert_eq!(received(&inbox, part.len()), part);
            let (gone, result) = send_with(&outbox, &to, part, send_one);
            assert_eq!((gone, result.is_ok()), (part.len(), true));
            assert_eq!(received(&inbox, part.len()), part);
        }
    }

    #[test]
    fn a_datagram_that_is_too_long_fails_and_those_before_it_have_gone() {
        let (outbox, inbox, to) = pair();
        outbox.set_nonblocking(true).expect("set");
        let long = vec![7; 70_000];
        let (gone, result) = send_batch(&outbox, &to, &[b"one", b"two", &long, b"four"]);
        assert_eq!((gone, result.is_err()), (2, true));
        assert_eq!(received(&inbox, 2), [b"one", b"two"]);
    }
}
