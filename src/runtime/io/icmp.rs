//! Closed ports of the peers of an unconnected UDP socket, from ICMP.
//!
//! Linux keeps ICMP errors with the datagram's destination in the socket's error queue (`IP_RECVERR`, ip(7)). Other systems report no closed ports.

use std::net::SocketAddr;
use std::os::fd::AsFd;

/// Enables the error queue. Calls on the socket then also fail with [`std::io::ErrorKind::ConnectionRefused`], once per error.
pub(super) fn enable(socket: &impl AsFd, local: SocketAddr) {
    system::enable(socket, local);
}

/// Next peer that refused a datagram; `None` if there is no further peer.
pub(super) fn next_refused(socket: &impl AsFd) -> Option<SocketAddr> {
    system::next_refused(socket)
}

#[cfg(not(target_os = "linux"))]
mod system {
    use super::*;

    pub(super) fn enable(_: &impl AsFd, _: SocketAddr) {}

    pub(super) fn next_refused(_: &impl AsFd) -> Option<SocketAddr> {
        None
    }
}

#[cfg(target_os = "linux")]
mod system {
    use std::io;
    use std::mem::{size_of, size_of_val, zeroed};
    use std::os::fd::AsRawFd;

    use socket2::SockAddr;

    use super::*;

    /// Buffer for the control message of an error, which takes 48 bytes with the address of the sender; aligned to 8 bytes.
    type Control = [u64; 32];

    pub(super) fn enable(socket: &impl AsFd, local: SocketAddr) {
        let (level, option) = match local {
            SocketAddr::V4(_) => (libc::IPPROTO_IP, libc::IP_RECVERR),
            SocketAddr::V6(_) => (libc::IPPROTO_IPV6, libc::IPV6_RECVERR),
        };
        let on: libc::c_int = 1;
        // SAFETY: the descriptor is open for as long as `socket` is borrowed; the option's value is one int, alive during the call. Without the
        // option, silent clients end by their timeouts.
        unsafe {
            libc::setsockopt(
                socket.as_fd().as_raw_fd(),
                level,
                option,
                (&raw const on).cast(),
                size_of_val(&on) as libc::socklen_t,
            );
        }
    }

    pub(super) fn next_refused(socket: &impl AsFd) -> Option<SocketAddr> {
        loop {
            match next_error(socket) {
                Ok((libc::ECONNREFUSED, peer)) => return peer,
                Ok(_) => {}
                // The queue is empty.
                Err(_) => return None,
            }
        }
    }

    /// Next error number, and the destination of the datagram that caused the error.
    fn next_error(socket: &impl AsFd) -> io::Result<(libc::c_int, Option<SocketAddr>)> {
        let mut control: Control = [0; 32];
        // SAFETY: all bytes zero is a valid msghdr: null pointers with lengths 0.
        let mut message: libc::msghdr = unsafe { zeroed() };
        message.msg_control = control.as_mut_ptr().cast();
        message.msg_controllen = size_of::<Control>() as _;
        let flags = libc::MSG_ERRQUEUE | libc::MSG_DONTWAIT;
        // SAFETY: `message` points to `control` and to the address, each with its own length; both outlive the call, which fills the address.
        let ((), peer) = unsafe {
            SockAddr::try_init(|address, length| {
                message.msg_name = address.cast();
                message.msg_namelen = *length;
                if libc::recvmsg(socket.as_fd().as_raw_fd(), &raw mut message, flags) < 0 {
                    return Err(io::Error::last_os_error());
                }
                *length = message.msg_namelen;
                Ok(())
            })
        }?;
        // SAFETY: recvmsg has filled `message`, and its control buffer is alive: the macro returns its first message or null.
        let number = unsafe {
            let header = libc::CMSG_FIRSTHDR(&raw const message);
            match header.is_null() {
                true => 0,
                // The data may be unaligned.
                false => {
                    libc::CMSG_DATA(header)
                        .cast::<libc::sock_extended_err>()
                        .read_unaligned()
                        .ee_errno
                }
            }
        };
        Ok((number as libc::c_int, peer.as_socket()))
    }
}

#[cfg(all(test, target_os = "linux"))]
mod tests {
    use std::net::UdpSocket;

    use super::*;

    #[test]
    fn only_the_closed_port_is_reported() {
        let socket = UdpSocket::bind("127.0.0.1:0").expect("bound");
        enable(&socket, socket.local_addr().expect("bound"));
        let open = UdpSocket::bind("127.0.0.1:0").expect("bound");
        let closed = {
            let gone = UdpSocket::bind("127.0.0.1:0").expect("bound");
            gone.local_addr().expect("bound")
        };
        socket
            .send_to(b"a", open.local_addr().expect("bound"))
            .expect("sent");
        socket.send_to(b"b", closed).expect("sent");
        assert_eq!(next_refused(&socket), Some(closed));
        assert_eq!(next_refused(&socket), None);
    }
}
