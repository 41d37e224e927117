//! The ways out: a UDP socket, the clients of a TCP server, a serial port.

use std::io::{self, Write};
use std::net::{Ipv4Addr, SocketAddr, TcpListener, TcpStream, UdpSocket};
use std::time::{Duration, Instant};

use socket2::{Domain, Protocol, Socket, Type};

use super::super::live::{Port, open_serial};
use crate::config::spec::{NavTargetSpec, PulseSpec, SerialLine};

/// What stands for a pulse where there is no line for it: BEL.
pub const PULSE_BYTE: u8 = 0x07;
/// A vanished serial port is looked for this often.
const REOPEN_INTERVAL: Duration = Duration::from_secs(1);
/// Clients of one output; more are turned away.
const MOST_CLIENTS: usize = 64;

pub trait Way: Send {
    /// The whole second begins (`high`), or its pulse ends.
    fn pulse(&mut self, high: bool) -> io::Result<()>;
    fn send(&mut self, bytes: &[u8]) -> io::Result<()>;
    /// Listening at present; 0 where that cannot be known.
    fn clients(&mut self) -> u64 {
        0
    }
}

pub fn name(target: &NavTargetSpec) -> String {
    match target {
        NavTargetSpec::Udp { to } => format!("UDP {to}"),
        NavTargetSpec::TcpListen { listen } => format!("TCP {listen}"),
        NavTargetSpec::Serial { port, baud, line } => {
            format!("{port} at {baud} Bd {}", line.name())
        }
    }
}

pub fn transport(target: &NavTargetSpec) -> &'static str {
    match target {
        NavTargetSpec::Udp { .. } => "udp",
        NavTargetSpec::TcpListen { .. } => "tcp",
        NavTargetSpec::Serial { .. } => "serial",
    }
}

/// The way, and the address it listens at or sends to.
pub fn open(
    target: &NavTargetSpec,
    pulse: PulseSpec,
) -> io::Result<(Box<dyn Way>, Option<SocketAddr>)> {
    Ok(match target {
        NavTargetSpec::Udp { to } => (Box::new(Udp::open(*to, pulse)?), Some(*to)),
        NavTargetSpec::TcpListen { listen } => {
            let listener = TcpListener::bind(listen)?;
            listener.set_nonblocking(true)?;
            let address = listener.local_addr()?;
            let way = Tcp {
                listener,
                clients: Vec::new(),
                pulse,
            };
            (Box::new(way), Some(address))
        }
        NavTargetSpec::Serial { port, baud, line } => {
            let mut way = Serial {
                path: port.clone(),
                baud: *baud,
                line: *line,
                pulse,
                port: None,
                tried: None,
            };
            way.port = Some(way.connect()?);
            (Box::new(way), None)
        }
    })
}

struct Udp {
    socket: UdpSocket,
    to: SocketAddr,
    pulse: PulseSpec,
}

impl Udp {
    fn open(to: SocketAddr, pulse: PulseSpec) -> io::Result<Self> {
        let socket = Socket::new(Domain::for_address(to), Type::DGRAM, Some(Protocol::UDP))?;
        let any: SocketAddr = match to {
            SocketAddr::V4(_) => (Ipv4Addr::UNSPECIFIED, 0).into(),
            SocketAddr::V6(_) => (std::net::Ipv6Addr::UNSPECIFIED, 0).into(),
        };
        socket.set_broadcast(true)?;
        socket.set_nonblocking(true)?;
        socket.bind(&any.into())?;
        Ok(Self {
            socket: socket.into(),
            to,
            pulse,
        })
    }
}

impl Way for Udp {
    fn pulse(&mut self, high: bool) -> io::Result<()> {
        match high && self.pulse == PulseSpec::Byte {
            true => self.send(&[PULSE_BYTE]),
            false => Ok(()),
        }
    }
    fn send(&mut self, bytes: &[u8]) -> io::Result<()> {
        self.socket.send_to(bytes, self.to).map(|_| ())
    }
}

struct Tcp {
    listener: TcpListener,
    clients: Vec<TcpStream>,
    pulse: PulseSpec,
}

impl Way for Tcp {
    fn pulse(&mut self, high: bool) -> io::Result<()> {
        match high && self.pulse == PulseSpec::Byte {
            true => self.send(&[PULSE_BYTE]),
            false => Ok(()),
        }
    }
    /// A client that does not take all of it at once is dropped: it costs only itself.
    fn send(&mut self, bytes: &[u8]) -> io::Result<()> {
        self.clients();
        self.clients
            .retain_mut(|client| matches!(client.write(bytes), Ok(n) if n == bytes.len()));
        Ok(())
    }
    fn clients(&mut self) -> u64 {
        while let Ok((stream, _)) = self.listener.accept() {
            let ready = stream.set_nonblocking(true).is_ok() && stream.set_nodelay(true).is_ok();
            if ready && self.clients.len() < MOST_CLIENTS {
                self.clients.push(stream);
            }
        }
        self.clients.len() as u64
    }
}

struct Serial {
    path: String,
    baud: u32,
    line: SerialLine,
    pulse: PulseSpec,
    port: Option<Port>,
    tried: Option<Instant>,
}

impl Serial {
    fn connect(&self) -> io::Result<Port> {
        let mut port = open_serial(&self.path, self.baud, self.line)?;
        // Opening raises both; a pseudo-terminal has neither.
        match self.pulse {
            PulseSpec::Rts => drop(port.write_request_to_send(false)),
            PulseSpec::Dtr => drop(port.write_data_terminal_ready(false)),
            PulseSpec::None | PulseSpec::Byte => {}
        }
        Ok(port)
    }

    /// Does something with the port; one that fails is opened anew, not more than once a second.
    fn with(&mut self, does: impl FnOnce(&mut Port) -> io::Result<()>) -> io::Result<()> {
        if self.port.is_none() && self.tried.is_none_or(|t| t.elapsed() > REOPEN_INTERVAL) {
            self.tried = Some(Instant::now());
            self.port = self.connect().ok();
        }
        let port = self.port.as_mut().ok_or(io::ErrorKind::NotConnected)?;
        let done = does(port);
        if done.is_err() {
            self.port = None;
        }
        done
    }
}

impl Way for Serial {
    fn pulse(&mut self, high: bool) -> io::Result<()> {
        match self.pulse {
            PulseSpec::None => Ok(()),
            // A port without such a line still carries the sentences.
            PulseSpec::Rts => match &mut self.port {
                Some(port) => Ok(port.write_request_to_send(high)?),
                None => Ok(()),
            },
            PulseSpec::Dtr => match &mut self.port {
                Some(port) => Ok(port.write_data_terminal_ready(high)?),
                None => Ok(()),
            },
            PulseSpec::Byte if high => self.with(|port| port.write_all(&[PULSE_BYTE])),
            PulseSpec::Byte => Ok(()),
        }
    }
    fn send(&mut self, bytes: &[u8]) -> io::Result<()> {
        self.with(|port| port.write_all(bytes))
    }
}
