//! A serial port that is reopened after it vanishes.

use std::io::Read;
use std::sync::atomic::Ordering::Relaxed;

use serialport::{DataBits, Parity, SerialPortBuilder, StopBits};
use tracing::{info, warn};

use super::{Outlet, READ_TIMEOUT, REOPEN_INTERVAL, is_timeout};
use echotank_config::spec::{ParitySpec, SerialLine};

pub(crate) type Port = Box<dyn serialport::SerialPort>;

/// Opens a port at any baud rate, also non-standard ones.
pub(crate) fn open(port: &str, baud: u32, line: SerialLine) -> serialport::Result<Port> {
    settings(port, baud, line).open()
}

fn settings(port: &str, baud: u32, line: SerialLine) -> SerialPortBuilder {
    serialport::new(port, baud)
        .parity(match line.parity {
            ParitySpec::None => Parity::None,
            ParitySpec::Even => Parity::Even,
            ParitySpec::Odd => Parity::Odd,
        })
        .data_bits(match line.data_bits {
            5 => DataBits::Five,
            6 => DataBits::Six,
            7 => DataBits::Seven,
            _ => DataBits::Eight,
        })
        .stop_bits(match line.stop_bits {
            2 => StopBits::Two,
            _ => StopBits::One,
        })
        .timeout(READ_TIMEOUT)
}

pub(super) fn read(
    open: Port,
    reopen: impl Fn() -> serialport::Result<Port>,
    byte_ns: i64,
    outlet: &Outlet,
) {
    let mut port = Some(open);
    let mut buffer = vec![0; 4096];
    while !outlet.stopped() {
        let Some(open) = &mut port else {
            outlet.pause(REOPEN_INTERVAL);
            port = reopen().ok();
            if port.is_some() {
                info!(source = outlet.name, "serial port reopened");
            }
            outlet
                .stats
                .reopened
                .fetch_add(u64::from(port.is_some()), Relaxed);
            continue;
        };
        match open.read(&mut buffer) {
            Ok(len) if len > 0 => outlet.send(&buffer[..len], byte_ns),
            Err(error) if is_timeout(&error) => {}
            // A read of no bytes without a timeout means that the line hung up.
            ended => {
                let error = ended.err().map(|error| error.to_string());
                warn!(source = outlet.name, error, "serial port lost");
                outlet.stats.read_errors.fetch_add(1, Relaxed);
                port = None;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A pseudo-terminal ignores parity, so the test compares the requested settings.
    #[test]
    fn every_word_of_the_line_reaches_the_port() {
        let plain = serialport::new("port", 4800).timeout(READ_TIMEOUT);
        let line = |parity, data_bits, stop_bits| SerialLine {
            parity,
            data_bits,
            stop_bits,
        };
        for (line, want) in [
            (SerialLine::default(), plain.clone()),
            (
                line(ParitySpec::Even, 7, 2),
                plain
                    .clone()
                    .parity(Parity::Even)
                    .data_bits(DataBits::Seven)
                    .stop_bits(StopBits::Two),
            ),
            (
                line(ParitySpec::Odd, 5, 1),
                plain.parity(Parity::Odd).data_bits(DataBits::Five),
            ),
        ] {
            assert_eq!(settings("port", 4800, line), want, "{}", line.name());
        }
        assert_ne!(
            settings("port", 9600, SerialLine::default()),
            settings("port", 4800, SerialLine::default())
        );
    }
}
