//! Prints the messages of any supported protocol, one per line, from a file, a capture or a socket.

use std::io::{ErrorKind, Read, Write};
use std::net::{Ipv4Addr, SocketAddr, TcpStream, UdpSocket};
use std::time::{Duration, Instant};

use clap::Args;
use echotank_nav::capture;
use echotank_protocols::describer::{Datagrams, Format, MessageDescriber};
use echotank_runtime::io::capture_text::describe_capture;

#[derive(Args)]
#[command(about = "Print the messages of any supported protocol, one per line")]
pub(crate) struct Arguments {
    /// A file; a capture (pcap, pcapng) of UDP and TCP; tcp:HOST:PORT to connect; udp:ADDRESS:PORT to listen, also to multicast groups; `-`
    /// for standard input
    source: String,
    /// Protocol: sevenk, s7k, jsf, vita49, ping, wbms, wbms-text, xtf, imagenex872, sigmf, wav (default: detected from its first bytes or
    /// its port)
    #[arg(long, value_parser = format_of)]
    format: Option<Format>,
    /// Request sent first to a tcp: source, in hexadecimal
    #[arg(long, default_value = "")]
    send: String,
    /// Time to read from sockets, seconds; 0 is without limit
    #[arg(long, default_value_t = 0.0)]
    seconds: f64,
    /// Stop after this many lines; 0 is without limit
    #[arg(long, default_value_t = 0)]
    lines: u64,
}

fn format_of(name: &str) -> Result<Format, String> {
    Format::of_name(name).ok_or_else(|| {
        let names: Vec<_> = Format::ALL.iter().map(|f| f.name()).collect();
        format!("none of {}", names.join(", "))
    })
}

/// Printer of lines up to the limit.
struct Printer {
    left: Option<u64>,
}

impl Printer {
    fn print(&mut self, line: &str) {
        if let Some(left) = &mut self.left {
            if *left == 0 {
                return;
            }
            *left -= 1;
        }
        // The reader may have closed the output.
        let _ = writeln!(std::io::stdout(), "{line}");
    }
    fn is_done(&self) -> bool {
        self.left == Some(0)
    }
}

pub(crate) fn run(args: Arguments) -> Result<(), Box<dyn std::error::Error>> {
    let mut printer = Printer {
        left: (args.lines > 0).then_some(args.lines),
    };
    let outcome = match args.source.split_once(':') {
        Some(("tcp", address)) => tcp(address, &args, &mut printer),
        Some(("udp", address)) => udp(address, &args, &mut printer),
        _ => file(&args, &mut printer),
    };
    outcome.map_err(|why| format!("{}: {why}", args.source).into())
}

const UNKNOWN: &str = "unknown format (first bytes not recognised); name it with --format";

fn file(args: &Arguments, printer: &mut Printer) -> Result<(), String> {
    let bytes = if args.source == "-" {
        let mut bytes = Vec::new();
        std::io::stdin().read_to_end(&mut bytes).map(|_| bytes)
    } else {
        std::fs::read(&args.source)
    };
    let bytes = bytes.map_err(|error| error.to_string())?;
    if capture::is_capture(&bytes) {
        describe_capture(&bytes, args.format, &mut |line| {
            printer.print(&line);
            !printer.is_done()
        });
        return Ok(());
    }
    let format = args.format.or(Format::of_bytes(&bytes)).ok_or(UNKNOWN)?;
    let mut describer = MessageDescriber::new(format);
    describer.push(&bytes, &mut |line| printer.print(&line));
    describer.finish(&mut |line| printer.print(&line));
    Ok(())
}

/// Time at which to stop; `None` without a limit.
fn end(args: &Arguments) -> Option<Instant> {
    (args.seconds > 0.0).then(|| Instant::now() + Duration::from_secs_f64(args.seconds.min(1e9)))
}

/// Timeout of a read, after which the clock is checked.
const READ_TIMEOUT: Duration = Duration::from_millis(100);

fn is_silence(error: &std::io::Error) -> bool {
    matches!(
        error.kind(),
        ErrorKind::WouldBlock | ErrorKind::TimedOut | ErrorKind::Interrupted
    )
}

fn tcp(address: &str, args: &Arguments, printer: &mut Printer) -> Result<(), String> {
    let say = |error: std::io::Error| error.to_string();
    let mut stream = TcpStream::connect(address).map_err(say)?;
    stream.set_read_timeout(Some(READ_TIMEOUT)).map_err(say)?;
    stream.write_all(&bytes_of(&args.send)?).map_err(say)?;
    let port = stream.peer_addr().map_err(say)?.port();
    let mut describer = None;
    let mut buffer = vec![0; 1 << 16];
    let end = end(args);
    while !printer.is_done() && end.is_none_or(|end| Instant::now() < end) {
        let len = match stream.read(&mut buffer) {
            Ok(0) => break,
            Ok(len) => len,
            Err(error) if is_silence(&error) => continue,
            Err(error) => return Err(error.to_string()),
        };
        let bytes = &buffer[..len];
        let describer = match &mut describer {
            Some(describer) => describer,
            none => {
                let told = args.format.or(Format::of_port(port));
                let format = told.or(Format::of_bytes(bytes)).ok_or(UNKNOWN)?;
                none.insert(MessageDescriber::new(format))
            }
        };
        describer.push(bytes, &mut |line| printer.print(&line));
    }
    if let Some(describer) = describer {
        describer.finish(&mut |line| printer.print(&line));
    }
    Ok(())
}

fn bytes_of(hexadecimal: &str) -> Result<Vec<u8>, String> {
    let digits: Vec<u8> = hexadecimal
        .bytes()
        .filter(|b| !b.is_ascii_whitespace())
        .collect();
    if !digits.len().is_multiple_of(2) {
        return Err("--send takes two digits a byte".into());
    }
    digits
        .chunks(2)
        .map(|pair| {
            let text = String::from_utf8_lossy(pair);
            u8::from_str_radix(&text, 16).map_err(|error| format!("--send: {text}: {error}"))
        })
        .collect()
}

fn udp(address: &str, args: &Arguments, printer: &mut Printer) -> Result<(), String> {
    let say = |error: std::io::Error| error.to_string();
    let address: SocketAddr = address
        .parse()
        .map_err(|error| format!("{address}: {error}"))?;
    let socket = match address {
        SocketAddr::V4(v4) if v4.ip().is_multicast() => {
            let socket = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, v4.port())).map_err(say)?;
            for interface in [Ipv4Addr::UNSPECIFIED, Ipv4Addr::LOCALHOST] {
                // The machine may support only one of IPv4 and IPv6.
                let _ = socket.join_multicast_v4(v4.ip(), &interface);
            }
            socket
        }
        address => UdpSocket::bind(address).map_err(say)?,
    };
    socket.set_read_timeout(Some(READ_TIMEOUT)).map_err(say)?;
    let mut buffer = vec![0; 1 << 16];
    let mut datagrams = Datagrams::default();
    let end = end(args);
    while !printer.is_done() && end.is_none_or(|end| Instant::now() < end) {
        let len = match socket.recv(&mut buffer) {
            Ok(len) => len,
            Err(error) if is_silence(&error) => continue,
            Err(error) => return Err(error.to_string()),
        };
        let told = args.format.or(Format::of_port(address.port()));
        match told.or(Format::of_bytes(&buffer[..len])) {
            Some(format) => {
                datagrams.push(format, &buffer[..len], &mut |line| printer.print(&line));
            }
            None => printer.print(&format!("{len} B of unknown format")),
        }
    }
    Ok(())
}
