//! Trigger inputs: UDP datagrams, TCP lines or edges on a serial line, passed on with their age. [`out`] sends triggers.
//!
//! Each input has one thread. Invalid sentences are counted. A lost serial port is reopened.

pub mod out;
pub mod sentence;
pub mod serial;

use std::io::{self, ErrorKind, Read};
use std::net::{SocketAddr, TcpListener, TcpStream, UdpSocket};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use thiserror::Error;

use crate::io::listening::Listening;
use crate::io::priority::first_in_first_out_of;
use crate::io::stamp;
use crate::io::tcp::end_if_dead;
use echotank_config::spec::{ModemLine, TriggerFrom};
use sentence::{MAX_BYTES, TriggerSentence};
use serial::{Edges, InputLevel, POLL_INTERVAL, PortLine};

/// Read timeout, and interval between checks of the stop flag.
const READ_TIMEOUT: Duration = Duration::from_millis(100);
/// Pause before a lost serial port is reopened.
const REOPEN_INTERVAL: Duration = Duration::from_secs(1);
/// Maximum number of clients of a TCP input.
const MAX_CLIENTS: u64 = 16;
/// Time limit for a TCP client to acknowledge a probe.
const UNACKNOWLEDGED: Duration = Duration::from_secs(30);

/// One received trigger.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Trigger {
    /// Time since reception on the machine's clock, ns.
    pub(crate) age_ns: i64,
    /// Number of the pulse, if the sentence holds one.
    pub number: Option<u32>,
}

/// Callback for received triggers. The input's thread calls it, so it must not block.
pub(crate) type Sink = Arc<dyn Fn(Trigger) + Send + Sync>;

/// Counters of a trigger input.
#[derive(Debug, Default)]
pub struct TriggerListenerCounts {
    /// Triggers received.
    pub received: AtomicU64,
    /// Incomplete trigger sentences and overlong lines.
    pub spoiled: AtomicU64,
    /// Failures of the socket or port.
    pub errors: AtomicU64,
    /// Connected TCP clients.
    pub clients: AtomicU64,
}

/// Error of opening a trigger input.
#[derive(Debug, Error)]
#[error("trigger: cannot open {what}: {why}")]
pub struct ListenerError {
    what: String,
    why: io::Error,
}

/// An open trigger input; closes when dropped.
pub(crate) struct TriggerListener {
    address: Option<(&'static str, SocketAddr)>,
    _listening: Option<Listening>,
    counts: Arc<TriggerListenerCounts>,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

/// State of an input's thread.
#[derive(Clone)]
struct Reader {
    sink: Sink,
    counts: Arc<TriggerListenerCounts>,
    stop: Arc<AtomicBool>,
}

impl TriggerListener {
    /// Opens the input; `None` if the sonar has no external trigger.
    pub(crate) fn open(from: &TriggerFrom, sink: Sink) -> Result<Option<Self>, ListenerError> {
        let reader = Reader {
            sink,
            counts: Arc::default(),
            stop: Arc::default(),
        };
        let mut opened = Self {
            address: None,
            _listening: None,
            counts: reader.counts.clone(),
            stop: reader.stop.clone(),
            thread: None,
        };
        let refused = |what: String| move |why| ListenerError { what, why };
        let serve: Box<dyn FnOnce() + Send> = match from {
            TriggerFrom::Udp { listen } => {
                let refused = refused(format!("udp {listen}"));
                let socket = UdpSocket::bind(listen).and_then(|socket| {
                    socket.set_read_timeout(Some(READ_TIMEOUT))?;
                    opened.address = Some(("udp", socket.local_addr()?));
                    Ok(socket)
                });
                let socket = socket.map_err(refused)?;
                Box::new(move || reader.udp(&socket))
            }
            TriggerFrom::Tcp { listen } => {
                let refused = refused(format!("tcp {listen}"));
                let listener = TcpListener::bind(listen).and_then(|listener| {
                    listener.set_nonblocking(true)?;
                    opened.address = Some(("tcp", listener.local_addr()?));
                    Ok(listener)
                });
                let listener = listener.map_err(refused)?;
                Box::new(move || reader.tcp(&listener))
            }
            TriggerFrom::Serial { port, line, rising } => {
                let open = PortLine::open(port, *line).map_err(refused(port.clone()))?;
                let (port, line, rising): (String, ModemLine, bool) =
                    (port.clone(), *line, *rising);
                Box::new(move || {
                    reader.line(open, || PortLine::open(&port, line), Edges::new(rising));
                })
            }
            TriggerFrom::Internal | TriggerFrom::Protocol | TriggerFrom::Sonar { .. } => {
                return Ok(None);
            }
        };
        opened._listening = opened
            .address
            .map(|(_, address)| Listening::at("trigger", address));
        let thread = thread::Builder::new().name("trigger".into()).spawn(serve);
        opened.thread = Some(thread.map_err(refused("its thread".to_owned()))?);
        Ok(Some(opened))
    }

    /// Runs the input's threads under SCHED_FIFO if the system permits, including those of later clients; 0 changes nothing.
    pub(crate) fn set_priority(&self, priority: u8) {
        if let Some(thread) = self.thread.as_ref().filter(|_| priority > 0) {
            // The daemon reports a refused priority at its start.
            let _ = first_in_first_out_of(thread, priority);
        }
    }

    pub(crate) fn counts(&self) -> &Arc<TriggerListenerCounts> {
        &self.counts
    }

    /// Transport and bound address; `None` for a serial line.
    pub(crate) fn address(&self) -> Option<(&'static str, SocketAddr)> {
        self.address
    }
}

impl Drop for TriggerListener {
    fn drop(&mut self) {
        self.stop.store(true, Relaxed);
        if let Some(thread) = self.thread.take() {
            // The panic hook has reported a panic of the thread.
            let _ = thread.join();
        }
    }
}

fn is_silence(error: &io::Error) -> bool {
    use ErrorKind::{Interrupted, TimedOut, WouldBlock};
    matches!(error.kind(), WouldBlock | TimedOut | Interrupted)
}

impl Reader {
    fn stopped(&self) -> bool {
        self.stop.load(Relaxed)
    }

    fn error(&self, error: &io::Error) {
        tracing::debug!(thread = thread::current().name(), %error, "trigger input failed");
        self.counts.errors.fetch_add(1, Relaxed);
        thread::sleep(READ_TIMEOUT);
    }

    fn receive(&self, bytes: &[u8], age_ns: i64) {
        let number = match sentence::read(bytes) {
            TriggerSentence::Plain => None,
            TriggerSentence::Numbered(number) => Some(number),
            TriggerSentence::Invalid => {
                self.counts.spoiled.fetch_add(1, Relaxed);
                return;
            }
        };
        self.counts.received.fetch_add(1, Relaxed);
        (self.sink)(Trigger { age_ns, number });
    }

    fn udp(&self, socket: &UdpSocket) {
        let mut buffer = [0; MAX_BYTES];
        stamp::enable(socket);
        while !self.stopped() {
            match stamp::receive(socket, &mut buffer) {
                Ok((len, age_ns)) => self.receive(&buffer[..len], age_ns),
                Err(error) if is_silence(&error) => {}
                Err(error) => self.error(&error),
            }
        }
    }

    fn tcp(&self, listener: &TcpListener) {
        let mut clients: Vec<JoinHandle<()>> = Vec::new();
        while !self.stopped() {
            clients.retain(|client| !client.is_finished());
            self.counts.clients.store(clients.len() as u64, Relaxed);
            match listener.accept() {
                Ok((stream, _)) if (clients.len() as u64) < MAX_CLIENTS => {
                    let reader = self.clone();
                    let thread = thread::Builder::new().name("trigger client".into());
                    match thread.spawn(move || reader.client(stream)) {
                        Ok(client) => clients.push(client),
                        Err(error) => self.error(&error),
                    }
                }
                // The server is full; the connection is closed.
                Ok(_) => {}
                Err(error) if is_silence(&error) => thread::sleep(READ_TIMEOUT / 10),
                Err(error) => self.error(&error),
            }
        }
        for client in clients {
            let _ = client.join();
        }
    }

    /// Reads lines of a client. Each line is a trigger at the instant at which its end arrives.
    fn client(&self, mut stream: TcpStream) {
        end_if_dead(&stream, UNACKNOWLEDGED);
        let ready = stream.set_nonblocking(false);
        let ready = ready.and_then(|()| stream.set_read_timeout(Some(READ_TIMEOUT)));
        if ready.is_err() {
            return;
        }
        let (mut line, mut buffer) = (Vec::new(), [0; 4096]);
        while !self.stopped() {
            let len = match stream.read(&mut buffer) {
                Ok(0) => return,
                Ok(len) => len,
                Err(error) if is_silence(&error) => continue,
                Err(_) => return,
            };
            for &byte in &buffer[..len] {
                if byte == b'\n' {
                    let text = line.trim_ascii();
                    if !text.is_empty() {
                        self.receive(text, 0);
                    }
                    line.clear();
                } else if line.len() < MAX_BYTES {
                    line.push(byte);
                } else {
                    // An overlong line contains no trigger.
                    self.counts.spoiled.fetch_add(1, Relaxed);
                    return;
                }
            }
        }
    }

    fn line<L: InputLevel>(&self, open: L, reopen: impl Fn() -> io::Result<L>, mut edges: Edges) {
        let mut port = Some(open);
        let fresh = edges;
        while !self.stopped() {
            let Some(open) = &mut port else {
                self.pause(REOPEN_INTERVAL);
                port = reopen().ok();
                edges = fresh;
                continue;
            };
            match open.is_high() {
                Ok(high) => {
                    if edges.look(high) {
                        self.counts.received.fetch_add(1, Relaxed);
                        let age_ns = 0;
                        (self.sink)(Trigger {
                            age_ns,
                            number: None,
                        });
                    }
                    thread::sleep(POLL_INTERVAL);
                }
                Err(error) => {
                    tracing::warn!(thread = thread::current().name(), %error, "trigger line lost");
                    self.counts.errors.fetch_add(1, Relaxed);
                    port = None;
                }
            }
        }
    }

    fn pause(&self, time: Duration) {
        let end = std::time::Instant::now() + time;
        while !self.stopped() && std::time::Instant::now() < end {
            thread::sleep(READ_TIMEOUT);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Write;
    use std::sync::mpsc;

    fn open(from: &TriggerFrom) -> (TriggerListener, mpsc::Receiver<Trigger>) {
        let (sender, triggers) = mpsc::channel();
        let sink: Sink = Arc::new(move |trigger| {
            let _ = sender.send(trigger);
        });
        let listener = TriggerListener::open(from, sink)
            .expect("opens")
            .expect("a door");
        (listener, triggers)
    }

    const PATIENCE: Duration = Duration::from_secs(20);
    const ANY: SocketAddr = SocketAddr::new(std::net::IpAddr::V4(std::net::Ipv4Addr::LOCALHOST), 0);

    #[test]
    fn every_datagram_is_a_trigger_and_a_numbered_one_tells_its_number() {
        let (listener, triggers) = open(&TriggerFrom::Udp { listen: ANY });
        let (_, to) = listener.address().expect("bound");
        let sender = UdpSocket::bind(ANY).expect("a socket");
        let numbered = sentence::write(9, echotank_core::time::UtcNs(5), "main");
        for text in [
            b"\xff\x00".as_slice(),
            numbered.as_bytes(),
            b"$PETKT,1*00",
            b"x",
        ] {
            sender.send_to(text, to).expect("sent");
        }
        let got: Vec<_> = (0..3)
            .map(|_| triggers.recv_timeout(PATIENCE).expect("one"))
            .collect();
        let numbers: Vec<_> = got.iter().map(|trigger| trigger.number).collect();
        assert_eq!(numbers, [None, Some(9), None]);
        assert!(got.iter().all(|trigger| trigger.age_ns >= 0));
        assert_eq!(listener.counts().spoiled.load(Relaxed), 1);
    }

    #[test]
    fn every_line_of_every_client_is_a_trigger_and_one_without_end_ends_its_client() {
        let (listener, triggers) = open(&TriggerFrom::Tcp { listen: ANY });
        let (_, to) = listener.address().expect("bound");
        let mut first = TcpStream::connect(to).expect("accepted");
        let mut second = TcpStream::connect(to).expect("accepted");
        first.write_all(b"go\r\n\r\n").expect("written");
        second.write_all(b"go").expect("written");
        triggers.recv_timeout(PATIENCE).expect("of the first");
        second.write_all(b"\ngo\n").expect("written");
        for _ in 0..2 {
            triggers.recv_timeout(PATIENCE).expect("of the second");
        }
        first.write_all(&[b'x'; 2 * MAX_BYTES]).expect("written");
        first.set_read_timeout(Some(PATIENCE)).expect("set");
        // The server closed the connection: end of file, or a reset if bytes were unread.
        assert!(!matches!(first.read(&mut [0; 1]), Ok(1)));
        assert_eq!(listener.counts().spoiled.load(Relaxed), 1);
        assert!(triggers.try_recv().is_err());
    }

    /// Input that is high at every third sample and fails once.
    struct Fake(mpsc::Sender<()>, u32);

    impl InputLevel for Fake {
        fn is_high(&mut self) -> io::Result<bool> {
            self.1 += 1;
            if self.1 > 9 {
                return Err(ErrorKind::NotConnected.into());
            }
            let _ = self.0.send(());
            Ok(self.1.is_multiple_of(3))
        }
    }

    #[test]
    fn edges_of_a_line_are_triggers_and_a_line_that_fails_is_opened_again() {
        let (sender, triggers) = mpsc::channel();
        let reader = Reader {
            sink: Arc::new(move |trigger| {
                let _ = sender.send(trigger);
            }),
            counts: Arc::default(),
            stop: Arc::default(),
        };
        let (counts, stop) = (reader.counts.clone(), reader.stop.clone());
        let (looks, looked) = mpsc::channel();
        let thread = thread::spawn(move || {
            let again = looks.clone();
            let reopen = || Ok(Fake(again.clone(), 0));
            reader.line(Fake(looks, 0), reopen, Edges::new(true));
        });
        for _ in 0..6 {
            triggers.recv_timeout(PATIENCE).expect("an edge");
        }
        stop.store(true, Relaxed);
        thread.join().expect("ends");
        assert!(counts.errors.load(Relaxed) >= 1);
        assert!(looked.try_iter().count() >= 18);
    }

    #[test]
    fn a_door_that_cannot_be_opened_says_which() {
        let (listener, _triggers) = open(&TriggerFrom::Tcp { listen: ANY });
        let (_, taken) = listener.address().expect("bound");
        let sink: Sink = Arc::new(|_| {});
        for (from, word) in [
            (TriggerFrom::Tcp { listen: taken }, taken.to_string()),
            (
                TriggerFrom::Serial {
                    port: "/nowhere".into(),
                    line: ModemLine::ClearToSend,
                    rising: true,
                },
                "/nowhere".to_owned(),
            ),
        ] {
            let said = TriggerListener::open(&from, sink.clone())
                .err()
                .expect("refused");
            assert!(said.to_string().contains(&word), "{said}");
        }
    }
}
