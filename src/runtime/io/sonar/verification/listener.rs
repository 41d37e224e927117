//! The sockets of a verifying listener: TCP with reconnection after a reset, UDP for unsolicited datagrams.

use std::io::{ErrorKind, Read, Write};
use std::net::{SocketAddr, TcpStream, UdpSocket};
use std::time::{Duration, Instant};

use echotank_protocols::imagenex872::{Side, SwitchCommand};
use echotank_protocols::sevenk::{
    Command, ControlRequest, Packetiser, RecordStamp, SevenKTime, device_id,
};

use super::accounting::{Accounting, Checksums};
use super::decode::{Family, RecordDecoder};
use crate::clock::{Clock, SystemClock};

/// Read timeout, and interval between checks of the stop flag.
const READ_TIMEOUT: Duration = Duration::from_millis(50);
/// Interval and time limit of reconnection after a reset.
const RECONNECT_INTERVAL: Duration = Duration::from_millis(10);
const RECONNECT_TIMEOUT: Duration = Duration::from_secs(2);
/// Time after which an unanswered switch command is repeated.
const REPEAT_INTERVAL: Duration = Duration::from_millis(500);
/// Pause after an answer. A second answer to the same ping would otherwise count as the next answer.
const SETTLE: Duration = Duration::from_millis(10);
/// Receive buffer requested from the kernel, bytes.
const SOCKET_BUFFER_BYTES: usize = 8 << 20;
const READ_BYTES: usize = 256 * 1024;

/// Server and records that a listener receives.
#[derive(Clone, Debug)]
pub struct ListenerSpec {
    /// Protocol family.
    pub family: Family,
    /// Server address; for VITA 49 the local address.
    pub address: SocketAddr,
    /// 7k: record types to subscribe to.
    pub record_types: Vec<u32>,
    /// Imagenex 872: range setting, m; must be one of the device's ranges.
    pub range_m: u8,
    /// Pause between reads beyond which silence is reported; `None` disables the report.
    pub silence: Option<Duration>,
}

/// Reason for the end of a connection.
enum End {
    Stopped,
    Closed,
    Reset,
}

/// A client that verifies the records of a sonar.
pub struct Listener {
    what: ListenerSpec,
    link: Link,
    /// Findings so far.
    pub accounting: Accounting,
    decoders: Decoders,
    /// Bytes received.
    pub bytes: u64,
    /// Connections reset by the server.
    pub resets: u64,
    /// Number of pauses longer than [`ListenerSpec::silence`].
    pub silences: u64,
    /// Imagenex 872: switch commands sent.
    pub requests: u64,
    /// Imagenex 872: answers received.
    pub answers: u64,
}

enum Link {
    Tcp(TcpStream),
    Udp(UdpSocket),
}

/// Decoder of the current connection, and sums over the earlier connections.
struct Decoders {
    decoder: RecordDecoder,
    errors_before: u64,
    unnumbered_before: u64,
}

impl Listener {
    /// Connects and subscribes. `against` and `keeps_checksums` are as in [`Accounting::new`].
    ///
    /// # Errors
    /// The connection or the socket cannot be opened.
    pub fn open(
        what: ListenerSpec,
        against: Option<Checksums>,
        keeps_checksums: bool,
    ) -> std::io::Result<Self> {
        let link = match what.family {
            Family::Vita49 => {
                let socket = UdpSocket::bind(what.address)?;
                // The kernel may grant less.
                let _ = socket2::SockRef::from(&socket).set_recv_buffer_size(SOCKET_BUFFER_BYTES);
                socket.set_read_timeout(Some(READ_TIMEOUT))?;
                Link::Udp(socket)
            }
            _ => Link::Tcp(connect(&what)?),
        };
        Ok(Self {
            accounting: Accounting::new(what.family, against, keeps_checksums),
            decoders: Decoders {
                decoder: RecordDecoder::new(what.family),
                errors_before: 0,
                unnumbered_before: 0,
            },
            what,
            link,
            bytes: 0,
            resets: 0,
            silences: 0,
            requests: 0,
            answers: 0,
        })
    }

    /// The local address.
    pub fn local_addr(&self) -> std::io::Result<SocketAddr> {
        match &self.link {
            Link::Tcp(stream) => stream.local_addr(),
            Link::Udp(socket) => socket.local_addr(),
        }
    }

    /// Number of undecodable byte ranges and damaged records.
    pub fn errors(&self) -> u64 {
        self.decoders.errors_before + self.decoders.decoder.errors()
    }

    /// Number of undamaged records without a number.
    pub fn unnumbered(&self) -> u64 {
        self.decoders.unnumbered_before + self.decoders.decoder.unnumbered()
    }

    /// Receives until `stop` returns true or the server closes the connection.
    ///
    /// # Errors
    /// The socket fails other than by a reset.
    pub fn run(&mut self, stop: &mut dyn FnMut() -> bool) -> std::io::Result<()> {
        loop {
            match self.listen(stop)? {
                End::Stopped | End::Closed => return Ok(()),
                End::Reset => {
                    self.resets += 1;
                    // The reset lies between the last ping received and the next one.
                    self.accounting.found_until_next("reset");
                    if !self.reconnect(stop) {
                        return Ok(());
                    }
                    self.decoders.errors_before += self.decoders.decoder.errors();
                    self.decoders.unnumbered_before += self.decoders.decoder.unnumbered();
                    self.decoders.decoder = RecordDecoder::new(self.what.family);
                }
            }
        }
    }

    fn reconnect(&mut self, stop: &mut dyn FnMut() -> bool) -> bool {
        let until = Instant::now() + RECONNECT_TIMEOUT;
        while Instant::now() < until && !stop() {
            if let Ok(stream) = connect(&self.what) {
                self.link = Link::Tcp(stream);
                return true;
            }
            std::thread::sleep(RECONNECT_INTERVAL);
        }
        false
    }

    fn listen(&mut self, stop: &mut dyn FnMut() -> bool) -> std::io::Result<End> {
        let mut buffer = vec![0; READ_BYTES];
        let asks = self.what.family == Family::Imagenex872;
        if asks {
            self.requests += 1;
            self.ask()?;
        }
        let mut last_received = Instant::now();
        let mut is_answered = false;
        loop {
            if stop() {
                self.give_up();
                return Ok(End::Stopped);
            }
            let read = match &mut self.link {
                Link::Tcp(stream) => stream.read(&mut buffer),
                Link::Udp(socket) => socket.recv(&mut buffer),
            };
            let len = match read {
                Ok(0) if matches!(self.link, Link::Tcp(_)) => {
                    self.give_up();
                    return Ok(End::Closed);
                }
                Ok(len) => len,
                Err(error) => match error.kind() {
                    ErrorKind::WouldBlock | ErrorKind::TimedOut | ErrorKind::Interrupted => {
                        if asks && is_answered {
                            is_answered = false;
                            self.requests += 1;
                            self.ask()?;
                        } else if asks && last_received.elapsed() > REPEAT_INTERVAL {
                            last_received = Instant::now();
                            self.give_up();
                            self.requests += 1;
                            self.ask()?;
                        }
                        continue;
                    }
                    ErrorKind::ConnectionReset | ErrorKind::BrokenPipe => return Ok(End::Reset),
                    _ => return Err(error),
                },
            };
            self.bytes += len as u64;
            let now = Instant::now();
            if self
                .what
                .silence
                .is_some_and(|most| now - last_received > most)
                && self.accounting.last_ping().is_some()
            {
                self.silences += 1;
                self.accounting.found_until_next("silent");
            }
            last_received = now;
            let accounting = &mut self.accounting;
            let (mut records, errors) = (0, self.decoders.decoder.errors());
            self.decoders.decoder.decode(&buffer[..len], &mut |record| {
                records += 1;
                accounting.note(record);
            });
            if asks {
                self.damaged_since(errors);
                self.answers += records;
                // Each command has one answer; further answers are duplicates.
                for _ in self.requests..self.answers {
                    self.accounting.found("duplicate", None, None);
                    self.requests += 1;
                }
                if records > 0 {
                    is_answered = true;
                    self.wait_for(SETTLE)?;
                }
            }
        }
    }

    /// Sends a switch command to an Imagenex 872 and sets the timeout for its answer.
    fn ask(&mut self) -> std::io::Result<()> {
        if let Link::Tcp(stream) = &mut self.link {
            stream.write_all(&switch(self.what.range_m))?;
        }
        self.wait_for(READ_TIMEOUT)
    }

    fn wait_for(&self, timeout: Duration) -> std::io::Result<()> {
        match &self.link {
            Link::Tcp(stream) => stream.set_read_timeout(Some(timeout)),
            Link::Udp(socket) => socket.set_read_timeout(Some(timeout)),
        }
    }

    /// Counts an incomplete answer as truncated.
    fn give_up(&mut self) {
        let errors = self.decoders.decoder.errors();
        self.decoders.decoder.give_up();
        self.damaged_since(errors);
    }

    fn damaged_since(&mut self, errors: u64) {
        for _ in errors..self.decoders.decoder.errors() {
            self.accounting.found("damaged", None, None);
        }
    }
}

fn connect(what: &ListenerSpec) -> std::io::Result<TcpStream> {
    let mut stream = TcpStream::connect(what.address)?;
    stream.set_nodelay(true)?;
    stream.set_read_timeout(Some(READ_TIMEOUT))?;
    if what.family == Family::SevenK {
        let command = ControlRequest {
            ticket: 1,
            tracking_number: [0; 2],
            command: Command::Subscribe {
                record_type_ids: what.record_types.clone(),
            },
        };
        let stamp = RecordStamp {
            time: SevenKTime::from_utc_ns_clamped(SystemClock::new().host_utc().0),
            device_id: device_id::SONAR_SOURCE,
            system_enumerator: 0,
        };
        let (mut record, mut wire) = (Vec::new(), Vec::new());
        command.emit(&mut record, &stamp);
        Packetiser::default().packetise(&record, &mut wire);
        stream.write_all(&wire)?;
    }
    Ok(stream)
}

fn switch(range_m: u8) -> Vec<u8> {
    let mut bytes = Vec::new();
    SwitchCommand {
        range_m,
        frequency_index: 0,
        data_gain: 0,
        balance_gain: 0,
        side: Side::Port,
    }
    .emit(&mut bytes);
    bytes
}
