//! Transports of navigation outputs: a UDP socket, the clients of a TCP server, a serial port.

use std::io::{self, Write};
use std::net::{Ipv4Addr, SocketAddr, TcpListener, TcpStream, UdpSocket};
use std::time::{Duration, Instant};

use socket2::{Domain, Protocol, Socket, Type};

use crate::io::tcp::end_if_dead;

use super::super::live::{Port, open_serial};
use echotank_config::spec::{NavTargetSpec, PulseSpec, SerialLine};

/// Byte sent as a pulse on transports without a modem line: BEL.
pub(crate) const PULSE_BYTE: u8 = 0x07;
/// Pause before a lost serial port is reopened.
const REOPEN_INTERVAL: Duration = Duration::from_secs(1);
/// Maximum number of clients of one output.
const MAX_CLIENTS: usize = 64;
/// Time limit for a TCP client to acknowledge sent data.
const UNACKNOWLEDGED: Duration = Duration::from_secs(30);

pub(super) trait Transport: Send {
    /// Begins (`high`) or ends the pulse of a whole second.
    fn pulse(&mut self, high: bool) -> io::Result<()>;
    fn send(&mut self, bytes: &[u8]) -> io::Result<()>;
    /// Number of connected clients; 0 if unknown.
    fn clients(&mut self) -> u64 {
        0
    }
}

pub(super) fn name(target: &NavTargetSpec) -> String {
    match target {
        NavTargetSpec::Udp { to } => format!("UDP {to}"),
        NavTargetSpec::TcpListen { listen } => format!("TCP {listen}"),
        NavTargetSpec::Serial { port, baud, line } => {
            format!("{port} at {baud} Bd {}", line.name())
        }
    }
}

pub(super) fn transport(target: &NavTargetSpec) -> &'static str {
    match target {
        NavTargetSpec::Udp { .. } => "udp",
        NavTargetSpec::TcpListen { .. } => "tcp",
        NavTargetSpec::Serial { .. } => "serial",
    }
}

/// Opens a transport. Returns the transport and the address that it listens on or sends to.
pub(super) fn open(
    target: &NavTargetSpec,
    pulse: PulseSpec,
) -> io::Result<(Box<dyn Transport>, Option<SocketAddr>)> {
    Ok(match target {
        NavTargetSpec::Udp { to } => (Box::new(Udp::open(*to, pulse)?), Some(*to)),
        NavTargetSpec::TcpListen { listen } => {
            let listener = TcpListener::bind(listen)?;
            listener.set_nonblocking(true)?;
            let address = listener.local_addr()?;
            let transport = Tcp {
                listener,
                clients: Vec::new(),
                pulse,
            };
            (Box::new(transport), Some(address))
        }
        NavTargetSpec::Serial { port, baud, line } => {
            let mut transport = Serial {
                path: port.clone(),
                baud: *baud,
                line: *line,
                pulse,
                port: None,
                tried: None,
            };
            transport.port = Some(transport.connect()?);
            (Box::new(transport), None)
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

impl Transport for Udp {
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

impl Transport for Tcp {
    fn pulse(&mut self, high: bool) -> io::Result<()> {
        match high && self.pulse == PulseSpec::Byte {
            true => self.send(&[PULSE_BYTE]),
            false => Ok(()),
        }
    }
    /// A client that does not accept all bytes at once is disconnected, so that no client delays the others.
    fn send(&mut self, bytes: &[u8]) -> io::Result<()> {
        self.clients();
        self.clients
            .retain_mut(|client| matches!(client.write(bytes), Ok(n) if n == bytes.len()));
        Ok(())
    }
    fn clients(&mut self) -> u64 {
        while let Ok((stream, _)) = self.listener.accept() {
            end_if_dead(&stream, UNACKNOWLEDGED);
            let ready = stream.set_nonblocking(true).is_ok() && stream.set_nodelay(true).is_ok();
            if ready && self.clients.len() < MAX_CLIENTS {
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
        // Opening the port raises both modem lines. A pseudo-terminal has neither.
        match self.pulse {
            PulseSpec::Rts => drop(port.write_request_to_send(false)),
            PulseSpec::Dtr => drop(port.write_data_terminal_ready(false)),
            PulseSpec::None | PulseSpec::Byte => {}
        }
        Ok(port)
    }

    /// Calls `does` with the open port. A failed port is reopened at most once per second.
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

impl Transport for Serial {
    fn pulse(&mut self, high: bool) -> io::Result<()> {
        match self.pulse {
            PulseSpec::None => Ok(()),
            // A port without this line still transmits the sentences.
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

#[cfg(test)]
mod tests {
    use std::io::Read;
    use std::sync::{Arc, Mutex};

    use serialport::{
        ClearBuffer, DataBits, FlowControl, Parity, Result as PortResult, SerialPort, StopBits,
    };

    use super::*;

    /// A fake port with modem lines, which pseudo-terminals lack; it logs every action.
    #[derive(Clone, Default)]
    struct Bench(Arc<Mutex<Vec<String>>>);

    impl Bench {
        fn note(&self, what: String) {
            self.0.lock().expect("unspoiled").push(what);
        }
    }

    impl Read for Bench {
        fn read(&mut self, _: &mut [u8]) -> io::Result<usize> {
            Err(io::ErrorKind::TimedOut.into())
        }
    }

    impl Write for Bench {
        fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
            self.note(String::from_utf8_lossy(bytes).trim_end().to_owned());
            Ok(bytes.len())
        }
        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    #[rustfmt::skip]
    impl SerialPort for Bench {
        fn name(&self) -> Option<String> { None }
        fn baud_rate(&self) -> PortResult<u32> { Ok(9600) }
        fn data_bits(&self) -> PortResult<DataBits> { Ok(DataBits::Eight) }
        fn flow_control(&self) -> PortResult<FlowControl> { Ok(FlowControl::None) }
        fn parity(&self) -> PortResult<Parity> { Ok(Parity::None) }
        fn stop_bits(&self) -> PortResult<StopBits> { Ok(StopBits::One) }
        fn timeout(&self) -> Duration { Duration::ZERO }
        fn set_baud_rate(&mut self, _: u32) -> PortResult<()> { Ok(()) }
        fn set_data_bits(&mut self, _: DataBits) -> PortResult<()> { Ok(()) }
        fn set_flow_control(&mut self, _: FlowControl) -> PortResult<()> { Ok(()) }
        fn set_parity(&mut self, _: Parity) -> PortResult<()> { Ok(()) }
        fn set_stop_bits(&mut self, _: StopBits) -> PortResult<()> { Ok(()) }
        fn set_timeout(&mut self, _: Duration) -> PortResult<()> { Ok(()) }
        fn write_request_to_send(&mut self, level: bool) -> PortResult<()> { self.note(format!("RTS {level}")); Ok(()) }
        fn write_data_terminal_ready(&mut self, level: bool) -> PortResult<()> { self.note(format!("DTR {level}")); Ok(()) }
        fn read_clear_to_send(&mut self) -> PortResult<bool> { Ok(false) }
        fn read_data_set_ready(&mut self) -> PortResult<bool> { Ok(false) }
        fn read_ring_indicator(&mut self) -> PortResult<bool> { Ok(false) }
        fn read_carrier_detect(&mut self) -> PortResult<bool> { Ok(false) }
        fn bytes_to_read(&self) -> PortResult<u32> { Ok(0) }
        fn bytes_to_write(&self) -> PortResult<u32> { Ok(0) }
        fn clear(&self, _: ClearBuffer) -> PortResult<()> { Ok(()) }
        fn try_clone(&self) -> PortResult<Box<dyn SerialPort>> { Ok(Box::new(self.clone())) }
        fn set_break(&self) -> PortResult<()> { Ok(()) }
        fn clear_break(&self) -> PortResult<()> { Ok(()) }
    }

    #[test]
    fn a_pulse_raises_and_lowers_the_line_that_was_named_and_no_other() {
        for (pulse, want) in [
            (
                PulseSpec::Rts,
                &["RTS true", "$GPZDA", "RTS false", "$GPHDT"][..],
            ),
            (
                PulseSpec::Dtr,
                &["DTR true", "$GPZDA", "DTR false", "$GPHDT"],
            ),
            (PulseSpec::Byte, &["\u{7}", "$GPZDA", "$GPHDT"]),
            (PulseSpec::None, &["$GPZDA", "$GPHDT"]),
        ] {
            let bench = Bench::default();
            let mut transport = Serial {
                path: "/dev/none".into(),
                baud: 9600,
                line: SerialLine::default(),
                pulse,
                port: Some(Box::new(bench.clone())),
                tried: None,
            };
            transport.pulse(true).expect("raised");
            transport.send(b"$GPZDA\r\n").expect("sent");
            transport.pulse(false).expect("lowered");
            transport.send(b"$GPHDT\r\n").expect("sent");
            assert_eq!(*bench.0.lock().expect("unspoiled"), want, "{pulse:?}");
        }
    }
}
