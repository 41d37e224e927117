//! Age of a received datagram from the kernel's time stamp. The age corrects the delay of a late read for navigation and triggers.
//!
//! Linux stamps datagrams on request (`SO_TIMESTAMPNS`, socket(7)). On other systems, or if Linux refuses, the age is 0.

use std::io;
use std::net::UdpSocket;

/// Requests time stamps. Returns false if they are unavailable.
pub(super) fn enable(socket: &UdpSocket) -> bool {
    system::enable(socket)
}

/// Receives one datagram. Returns its length, bytes, and its age, ns (0 if unknown).
pub(super) fn receive(socket: &UdpSocket, buffer: &mut [u8]) -> io::Result<(usize, i64)> {
    system::receive(socket, buffer)
}

#[cfg(not(target_os = "linux"))]
mod system {
    use super::*;

    pub fn enable(_: &UdpSocket) -> bool {
        false
    }

    pub fn receive(socket: &UdpSocket, buffer: &mut [u8]) -> io::Result<(usize, i64)> {
        Ok((socket.recv(buffer)?, 0))
    }
}

#[cfg(target_os = "linux")]
mod system {
    use std::mem::{size_of, size_of_val, zeroed};
    use std::os::fd::AsRawFd;
    use std::time::{Duration, SystemTime, UNIX_EPOCH};

    use super::*;

    /// Maximum age. A greater age means that the host's clock was set after the reception.
    const OLDEST: Duration = Duration::from_secs(10);
    /// Buffer for the control message of the time stamp, which takes 32 bytes; aligned to 8 bytes.
    type Control = [u64; 16];

    pub(super) fn enable(socket: &UdpSocket) -> bool {
        let on: libc::c_int = 1;
        // SAFETY: the descriptor is open for as long as `socket` is borrowed; the option's value is one int, alive during the call.
        let done = unsafe {
            libc::setsockopt(
                socket.as_raw_fd(),
                libc::SOL_SOCKET,
                libc::SO_TIMESTAMPNS,
                (&raw const on).cast(),
                size_of_val(&on) as libc::socklen_t,
            )
        };
        done == 0
    }

    pub(super) fn receive(socket: &UdpSocket, buffer: &mut [u8]) -> io::Result<(usize, i64)> {
        let mut control: Control = [0; 16];
        let mut part = libc::iovec {
            iov_base: buffer.as_mut_ptr().cast(),
            iov_len: buffer.len(),
        };
        // SAFETY: all bytes zero is a valid msghdr: null pointers with lengths 0.
        let mut message: libc::msghdr = unsafe { zeroed() };
        message.msg_iov = &raw mut part;
        message.msg_iovlen = 1;
        message.msg_control = control.as_mut_ptr().cast();
        message.msg_controllen = size_of::<Control>() as _;
        // SAFETY: `message` points to `part` (which is `buffer`) and `control`, each with its own length; all outlive the call.
        let len = unsafe { libc::recvmsg(socket.as_raw_fd(), &raw mut message, 0) };
        let Ok(len) = usize::try_from(len) else {
            return Err(io::Error::last_os_error());
        };
        Ok((len, stamp(&message).map_or(0, age_ns)))
    }

    /// Reception time from the kernel, since 1970.
    fn stamp(message: &libc::msghdr) -> Option<Duration> {
        // SAFETY: `message` has been filled by recvmsg, its control buffer is alive: the macros walk within msg_controllen, and end in null.
        unsafe {
            let mut header = libc::CMSG_FIRSTHDR(message);
            while let Some(h) = header.as_ref() {
                let is_stamp = h.cmsg_level == libc::SOL_SOCKET
                    && h.cmsg_type == libc::SCM_TIMESTAMPNS
                    && h.cmsg_len >= libc::CMSG_LEN(size_of::<libc::timespec>() as u32) as _;
                if is_stamp {
                    // The data may be unaligned.
                    let time = libc::CMSG_DATA(header)
                        .cast::<libc::timespec>()
                        .read_unaligned();
                    let seconds = u64::try_from(time.tv_sec).ok()?;
                    return Some(Duration::new(seconds, u32::try_from(time.tv_nsec).ok()?));
                }
                header = libc::CMSG_NXTHDR(message, header);
            }
        }
        None
    }

    /// Age in ns; 0 for an impossible time stamp.
    fn age_ns(stamp: Duration) -> i64 {
        let now = SystemTime::now().duration_since(UNIX_EPOCH).ok();
        let age = now.and_then(|now| now.checked_sub(stamp));
        age.filter(|age| *age <= OLDEST)
            .map_or(0, |age| age.as_nanos() as i64)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::{Duration, Instant};

    #[test]
    fn a_datagram_read_late_is_as_old_as_it_has_waited() {
        let socket = UdpSocket::bind("127.0.0.1:0").expect("a socket");
        let to = socket.local_addr().expect("bound");
        let sender = UdpSocket::bind("127.0.0.1:0").expect("a socket");
        let mut buffer = [0; 64];
        // Without a request there is no time stamp; this is the portable path.
        sender.send_to(b"one", to).expect("sent");
        assert_eq!(receive(&socket, &mut buffer).expect("read"), (3, 0));
        let stamped = enable(&socket);
        // A kernel begins stamping shortly after the first request; earlier datagrams are stamped when read.
        for _ in 0..200 {
            sender.send_to(b"early", to).expect("sent");
            std::thread::sleep(Duration::from_millis(5));
            let (_, age_ns) = receive(&socket, &mut buffer).expect("read");
            if !stamped || age_ns >= 5_000_000 {
                break;
            }
        }
        let begun = Instant::now();
        for text in [&b"two"[..], b"three"] {
            sender.send_to(text, to).expect("sent");
            std::thread::sleep(Duration::from_millis(40));
        }
        let ages: Vec<_> = (0..2)
            .map(|_| receive(&socket, &mut buffer).expect("read"))
            .collect();
        let most = begun.elapsed().as_nanos() as i64;
        assert_eq!((ages[0].0, ages[1].0, &buffer[..5]), (3, 5, &b"three"[..]));
        if stamped {
            let (two, three) = (ages[0].1, ages[1].1);
            assert!((80_000_000..=most).contains(&two), "{two} of {most}");
            assert!(
                three >= 40_000_000 && two - three >= 40_000_000,
                "{two} {three}"
            );
        } else {
            assert_eq!((ages[0].1, ages[1].1), (0, 0));
        }
    }
}
