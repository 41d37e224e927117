//! A listener's sockets: TCP, connected anew after a reset; UDP for datagrams that nobody asks for.

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

/// How long a read waits before it is looked whether to stop.
const LOOK: Duration = Duration::from_millis(50);
/// A server that was reset from is tried again so often, so long.
const AGAIN: Duration = Duration::from_millis(10);
const PATIENCE: Duration = Duration::from_secs(2);
/// A question that has no answer for so long is asked again: the answer was lost or truncated.
const ASK_AGAIN: Duration = Duration::from_millis(500);
/// After an answer it is listened so long before the next question, or a second one of the same ping would pass for its answer.
const SETTLE: Duration = Duration::from_millis(10);
/// Asked of the kernel for a socket of datagrams.
const SOCKET_BUFFER_BYTES: usize = 8 << 20;
const READ_BYTES: usize = 256 * 1024;

/// What to listen to, and how.
#[derive(Clone, Debug)]
pub struct ListenerSpec {
    pub family: Family,
    /// Of the server; of VITA 49 where the datagrams come to.
    pub address: SocketAddr,
    /// 7k: what is subscribed to.
    pub record_types: Vec<u32>,
    /// Imagenex 872: the range asked for, m; one of its own.
    pub range_m: u8,
    /// No record for so long is a silence; none: that is not looked for.
    pub silence: Option<Duration>,
}

/// How a connection ended.
enum End {
    Stopped,
    Closed,
    Reset,
}

pub struct Listener {
    what: ListenerSpec,
    link: Link,
    pub accounting: Accounting,
    heard: Decoders,
    pub bytes: u64,
    pub resets: u64,
    pub silences: u64,
    /// Imagenex 872.
    pub asked: u64,
    pub answers: u64,
}

enum Link {
    Tcp(TcpStream),
    Udp(UdpSocket),
}

/// The ears, of all connections.
struct Decoders {
    decoder: RecordDecoder,
    errors_before: u64,
    unnumbered_before: u64,
}

impl Listener {
    /// Connects, and asks for what is to be had. `against`, `keeps_checksums`: see [`Accounting::new`].
    pub fn open(
        what: ListenerSpec,
        against: Option<Checksums>,
        keeps_checksums: bool,
    ) -> std::io::Result<Self> {
        let link = match what.family {
            Family::Vita49 => {
                let socket = UdpSocket::bind(what.address)?;
                // As much as the system gives.
                let _ = socket2::SockRef::from(&socket).set_recv_buffer_size(SOCKET_BUFFER_BYTES);
                socket.set_read_timeout(Some(LOOK))?;
                Link::Udp(socket)
            }
            _ => Link::Tcp(connect(&what)?),
        };
        Ok(Self {
            accounting: Accounting::new(what.family, against, keeps_checksums),
            heard: Decoders {
                decoder: RecordDecoder::new(what.family),
                errors_before: 0,
                unnumbered_before: 0,
            },
            what,
            link,
            bytes: 0,
            resets: 0,
            silences: 0,
            asked: 0,
            answers: 0,
        })
    }

    /// Where datagrams are to be sent.
    pub fn local_addr(&self) -> std::io::Result<SocketAddr> {
        match &self.link {
            Link::Tcp(stream) => stream.local_addr(),
            Link::Udp(socket) => socket.local_addr(),
        }
    }

    /// Times that bytes were no record, or one was wrong.
    pub fn errors(&self) -> u64 {
        self.heard.errors_before + self.heard.decoder.errors()
    }

    /// Sound records without a number.
    pub fn unnumbered(&self) -> u64 {
        self.heard.unnumbered_before + self.heard.decoder.unnumbered()
    }

    /// Listens until `stop` says so or the server closes.
    pub fn run(&mut self, stop: &mut dyn FnMut() -> bool) -> std::io::Result<()> {
        loop {
            match self.listen(stop)? {
                End::Stopped | End::Closed => return Ok(()),
                End::Reset => {
                    self.resets += 1;
                    // The ping it came with is one of those up to the next that is heard.
                    self.accounting.found_until_next("reset");
                    if !self.reconnect(stop) {
                        return Ok(());
                    }
                    self.heard.errors_before += self.heard.decoder.errors();
                    self.heard.unnumbered_before += self.heard.decoder.unnumbered();
                    self.heard.decoder = RecordDecoder::new(self.what.family);
                }
            }
        }
    }

    fn reconnect(&mut self, stop: &mut dyn FnMut() -> bool) -> bool {
        let until = Instant::now() + PATIENCE;
        while Instant::now() < until && !stop() {
            if let Ok(stream) = connect(&self.what) {
                self.link = Link::Tcp(stream);
                return true;
            }
            std::thread::sleep(AGAIN);
        }
        false
    }

    fn listen(&mut self, stop: &mut dyn FnMut() -> bool) -> std::io::Result<End> {
        let mut buffer = vec![0; READ_BYTES];
        let asks = self.what.family == Family::Imagenex872;
        if asks {
            self.asked += 1;
            self.ask()?;
        }
        let mut heard_at = Instant::now();
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
                            self.asked += 1;
                            self.ask()?;
                        } else if asks && heard_at.elapsed() > ASK_AGAIN {
                            heard_at = Instant::now();
                            self.give_up();
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
            if self.what.silence.is_some_and(|most| now - heard_at > most)
                && self.accounting.last_ping().is_some()
            {
                self.silences += 1;
                self.accounting.found_until_next("silent");
            }
            heard_at = now;
            let accounting = &mut self.accounting;
            let (mut came, errors) = (0, self.heard.decoder.errors());
            self.heard.decoder.decode(&buffer[..len], &mut |record| {
                came += 1;
                accounting.note(record);
            });
            if asks {
                self.damaged_since(errors);
                self.answers += came;
                // One answer to each question; those beyond are too many.
                for _ in self.asked..self.answers {
                    self.accounting.found("duplicate", None, None);
                    self.asked += 1;
                }
                if came > 0 {
                    is_answered = true;
                    self.wait_for(SETTLE)?;
                }
            }
        }
    }

    /// Asks an Imagenex 872, and waits for its answer.
    fn ask(&mut self) -> std::io::Result<()> {
        if let Link::Tcp(stream) = &mut self.link {
            stream.write_all(&switch(self.what.range_m))?;
        }
        self.wait_for(LOOK)
    }

    fn wait_for(&self, patience: Duration) -> std::io::Result<()> {
        match &self.link {
            Link::Tcp(stream) => stream.set_read_timeout(Some(patience)),
            Link::Udp(socket) => socket.set_read_timeout(Some(patience)),
        }
    }

    /// An answer that has begun is truncated: its rest will not come.
    fn give_up(&mut self) {
        let errors = self.heard.decoder.errors();
        self.heard.decoder.give_up();
        self.damaged_since(errors);
    }

    fn damaged_since(&mut self, errors: u64) {
        for _ in errors..self.heard.decoder.errors() {
            self.accounting.found("damaged", None, None);
        }
    }
}

fn connect(what: &ListenerSpec) -> std::io::Result<TcpStream> {
    let mut stream = TcpStream::connect(what.address)?;
    stream.set_nodelay(true)?;
    stream.set_read_timeout(Some(LOOK))?;
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
