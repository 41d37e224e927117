//! The kernel's pacing of a TCP connection (`SO_MAX_PACING_RATE`, Linux); unavailable elsewhere.

use std::io;
use std::os::fd::{AsFd, AsRawFd};

/// Limits the rate of a connection, bytes/s. Infinity, or at least 4 GB/s, means unlimited.
#[cfg(target_os = "linux")]
pub(crate) fn set_pace(socket: &impl AsFd, bytes_per_s: f64) -> io::Result<()> {
    // The conversion saturates at the largest value, which means unlimited.
    let rate = (bytes_per_s.ceil() as u32).max(1);
    // SAFETY: the option's value is a live u32 and its length is given; the descriptor is open while it is borrowed.
    let result = unsafe {
        libc::setsockopt(
            socket.as_fd().as_raw_fd(),
            libc::SOL_SOCKET,
            libc::SO_MAX_PACING_RATE,
            std::ptr::from_ref(&rate).cast(),
            size_of::<u32>() as libc::socklen_t,
        )
    };
    match result {
        0 => Ok(()),
        _ => Err(io::Error::last_os_error()),
    }
}

#[cfg(not(target_os = "linux"))]
pub(crate) fn set_pace(socket: &impl AsFd, bytes_per_s: f64) -> io::Result<()> {
    let _ = (socket.as_fd().as_raw_fd(), bytes_per_s);
    Err(io::ErrorKind::Unsupported.into())
}

#[cfg(all(test, target_os = "linux"))]
mod tests {
    use std::io::{Read, Write};
    use std::net::{TcpListener, TcpStream};
    use std::time::Instant;

    use super::*;

    /// Time from the first to the last of 2 MB received, s.
    fn lasts_s(bytes_per_s: f64) -> f64 {
        const BYTES: usize = 2_000_000;
        let listener = TcpListener::bind("127.0.0.1:0").expect("a port");
        let mut sender =
            TcpStream::connect(listener.local_addr().expect("bound")).expect("loopback");
        let (mut receiver, _) = listener.accept().expect("a client");
        set_pace(&sender, bytes_per_s).expect("taken");
        let thread = std::thread::spawn(move || sender.write_all(&vec![7; BYTES]));
        let mut buffer = vec![0; 65_536];
        let mut left = BYTES - receiver.read(&mut buffer).expect("bytes");
        let began = Instant::now();
        while left > 0 {
            left -= receiver.read(&mut buffer).expect("bytes");
        }
        let lasted_s = began.elapsed().as_secs_f64();
        thread.join().expect("ends").expect("sent");
        lasted_s
    }

    #[test]
    fn a_paced_stream_lasts_as_long_as_its_bytes_at_that_rate() {
        // 0.1 s, less a short initial burst. A loaded machine can be slower but never faster.
        let lasted_s = lasts_s(20e6);
        assert!(lasted_s > 0.07, "{lasted_s} s");
        // An unlimited rate is accepted.
        lasts_s(f64::INFINITY);
    }
}
