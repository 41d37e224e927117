//! Trigger outputs: a datagram and a raised serial line at the start of every pulse.
//!
//! The caller sends the datagram without waiting. A thread raises and lowers the line. Pulses during this time count as failed.

use std::io;
use std::net::{Ipv4Addr, SocketAddr, UdpSocket};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use crossbeam_channel::{Receiver, Sender, bounded};
use thiserror::Error;

use super::sentence;
use echotank_config::spec::{OutLine, TriggerOutSpec};
use echotank_core::time::UtcNs;

/// Error of opening a trigger output.
#[derive(Debug, Error)]
#[error("trigger_out: cannot open {what}: {why}")]
pub struct TriggerOutputError {
    what: String,
    why: io::Error,
}

/// Counters of a trigger output.
#[derive(Debug, Default)]
pub struct TriggerOutputCounts {
    /// Triggers sent.
    pub sent: AtomicU64,
    /// Triggers that could not be sent.
    pub failed: AtomicU64,
}

/// A line that can be raised and lowered.
pub(crate) trait OutputLine: Send {
    fn raise(&mut self, high: bool) -> io::Result<()>;
}

struct PortLine {
    port: Box<dyn serialport::SerialPort>,
    line: OutLine,
}

impl OutputLine for PortLine {
    fn raise(&mut self, high: bool) -> io::Result<()> {
        match self.line {
            OutLine::RequestToSend => self.port.write_request_to_send(high)?,
            OutLine::DataTerminalReady => self.port.write_data_terminal_ready(high)?,
        }
        Ok(())
    }
}

/// An open trigger output; stops when dropped.
pub struct TriggerOut {
    sonar: String,
    socket: Option<(UdpSocket, SocketAddr)>,
    line: Option<Pulser>,
    counts: Arc<TriggerOutputCounts>,
}

impl TriggerOut {
    /// Opens the configured trigger outputs of a sonar; `None` if no output is configured.
    ///
    /// # Errors
    /// The socket, the serial port or the thread cannot be opened.
    pub fn open(spec: &TriggerOutSpec, sonar: &str) -> Result<Option<Self>, TriggerOutputError> {
        if *spec == TriggerOutSpec::default() {
            return Ok(None);
        }
        let refused = |what: String| move |why| TriggerOutputError { what, why };
        let counts = Arc::new(TriggerOutputCounts::default());
        let socket = match spec.to {
            None => None,
            Some(to) => {
                let socket = socket(to).map_err(refused(format!("udp {to}")))?;
                Some((socket, to))
            }
        };
        let line = match &spec.serial {
            None => None,
            Some(line) => {
                let port = serialport::new(&line.port, 9600).open();
                let port = port.map_err(|why| refused(line.port.clone())(why.into()))?;
                let mut port = PortLine {
                    port,
                    line: line.line,
                };
                // Opening the port raises both modem lines. A pseudo-terminal has neither.
                let _ = port.raise(false);
                let length = Duration::from_secs_f64(line.pulse_s);
                let pulser = Pulser::start(port, length, counts.clone());
                Some(pulser.map_err(refused(line.port.clone()))?)
            }
        };
        Ok(Some(Self {
            sonar: sonar.to_owned(),
            socket,
            line,
            counts,
        }))
    }

    /// Counters so far.
    pub fn counts(&self) -> &Arc<TriggerOutputCounts> {
        &self.counts
    }

    /// Reports the pulse `number`, which begins now. `utc` is its time stamp.
    pub fn pulse(&self, number: u32, utc: UtcNs) {
        if let Some(line) = &self.line
            && line.pulses.try_send(()).is_err()
        {
            self.counts.failed.fetch_add(1, Relaxed);
        }
        if let Some((socket, to)) = &self.socket {
            let text = sentence::write(number, utc, &self.sonar);
            let counter = match socket.send_to(text.as_bytes(), to) {
                Ok(_) => &self.counts.sent,
                Err(_) => &self.counts.failed,
            };
            counter.fetch_add(1, Relaxed);
        }
    }
}

fn socket(to: SocketAddr) -> io::Result<UdpSocket> {
    let any: SocketAddr = match to {
        SocketAddr::V4(_) => (Ipv4Addr::UNSPECIFIED, 0).into(),
        SocketAddr::V6(_) => (std::net::Ipv6Addr::UNSPECIFIED, 0).into(),
    };
    let socket = UdpSocket::bind(any)?;
    socket.set_broadcast(true)?;
    socket.set_nonblocking(true)?;
    Ok(socket)
}

/// Thread that raises a line for a fixed duration.
struct Pulser {
    pulses: Sender<()>,
    thread: Option<JoinHandle<()>>,
}

impl Pulser {
    fn start(
        line: impl OutputLine + 'static,
        length: Duration,
        counts: Arc<TriggerOutputCounts>,
    ) -> io::Result<Self> {
        // Unbuffered, because a pulse that waited for the end of another would be late.
        let (pulses, wanted) = bounded(0);
        let thread = thread::Builder::new()
            .name("trigger out".into())
            .spawn(move || raise(line, length, &wanted, &counts))?;
        Ok(Self {
            pulses,
            thread: Some(thread),
        })
    }
}

fn raise(
    mut line: impl OutputLine,
    length: Duration,
    wanted: &Receiver<()>,
    counts: &TriggerOutputCounts,
) {
    while wanted.recv().is_ok() {
        let raised = line.raise(true);
        thread::sleep(length);
        let done = raised.and_then(|()| line.raise(false));
        let counter = match done {
            Ok(()) => &counts.sent,
            Err(_) => &counts.failed,
        };
        counter.fetch_add(1, Relaxed);
    }
}

impl Drop for Pulser {
    fn drop(&mut self) {
        self.pulses = bounded(0).0;
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::Mutex;
    use std::time::Instant;

    #[test]
    fn a_pulse_goes_out_as_the_datagram_that_is_documented() {
        let inbox = UdpSocket::bind("127.0.0.1:0").expect("a socket");
        inbox
            .set_read_timeout(Some(Duration::from_secs(20)))
            .expect("set");
        let spec = TriggerOutSpec {
            to: Some(inbox.local_addr().expect("bound")),
            serial: None,
        };
        let out = TriggerOut::open(&spec, "bow").expect("opens").expect("one");
        out.pulse(3, UtcNs(1_500_000_000));
        let mut buffer = [0; 128];
        let len = inbox.recv(&mut buffer).expect("a datagram");
        assert_eq!(&buffer[..len], b"$PETKT,3,1.500000000,bow*11\r\n");
        assert_eq!(out.counts().sent.load(Relaxed), 1);
        let nobody = TriggerOut::open(&TriggerOutSpec::default(), "bow");
        assert!(nobody.expect("opens").is_none());
    }

    struct Fake(Arc<Mutex<Vec<(bool, Instant)>>>);

    impl OutputLine for Fake {
        fn raise(&mut self, high: bool) -> io::Result<()> {
            let mut seen = self.0.lock().expect("whole");
            seen.push((high, Instant::now()));
            Ok(())
        }
    }

    #[test]
    fn a_line_is_raised_for_as_long_as_it_is_told() {
        let seen = Arc::new(Mutex::new(Vec::new()));
        let length = Duration::from_millis(5);
        let counts = Arc::new(TriggerOutputCounts::default());
        let pulser = Pulser::start(Fake(seen.clone()), length, counts.clone()).expect("starts");
        for _ in 0..2 {
            pulser.pulses.send(()).expect("taken");
        }
        drop(pulser);
        let seen = seen.lock().expect("whole");
        let levels: Vec<_> = seen.iter().map(|(high, _)| *high).collect();
        assert_eq!(levels, [true, false, true, false]);
        for pair in seen.chunks(2) {
            assert!(pair[1].1 - pair[0].1 >= length);
        }
        assert_eq!(counts.sent.load(Relaxed), 2);
    }
}
