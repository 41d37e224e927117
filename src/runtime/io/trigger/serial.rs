//! Triggers on a modem line of a serial port, detected by polling.
//!
//! [`Edges`] detects edges; [`InputLevel`] abstracts the port. The polling interval of 0.5 ms limits the delay of an edge and the shortest detectable
//! pulse.

use std::io;
use std::time::Duration;

use echotank_config::spec::ModemLine;

/// Polling interval.
pub const POLL_INTERVAL: Duration = Duration::from_micros(500);

/// A line that is high or low.
pub(crate) trait InputLevel: Send {
    fn is_high(&mut self) -> io::Result<bool>;
}

/// A modem line of a serial port.
pub(crate) struct PortLine {
    port: Box<dyn serialport::SerialPort>,
    line: ModemLine,
}

impl PortLine {
    /// Opens the port. The baud rate is arbitrary, because no data is transferred.
    pub(crate) fn open(port: &str, line: ModemLine) -> io::Result<Self> {
        let port = serialport::new(port, 9600).open()?;
        Ok(Self { port, line })
    }
}

impl InputLevel for PortLine {
    fn is_high(&mut self) -> io::Result<bool> {
        Ok(match self.line {
            ModemLine::ClearToSend => self.port.read_clear_to_send()?,
            ModemLine::CarrierDetect => self.port.read_carrier_detect()?,
        })
    }
}

/// Detects edges of one direction. The first sample sets the initial level.
#[derive(Clone, Copy, Debug)]
pub struct Edges {
    rising: bool,
    high: Option<bool>,
}

impl Edges {
    /// Creates a detector of rising or falling edges.
    pub fn new(rising: bool) -> Self {
        Self { rising, high: None }
    }

    /// Evaluates a sample. Returns true at an edge of the selected direction.
    pub fn look(&mut self, high: bool) -> bool {
        let before = self.high.replace(high);
        before == Some(!self.rising) && high == self.rising
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn edges(rising: bool, levels: &str) -> Vec<usize> {
        let mut edges = Edges::new(rising);
        let looks = levels.bytes().map(|level| level == b'1').enumerate();
        looks
            .filter(|(_, high)| edges.look(*high))
            .map(|(at, _)| at)
            .collect()
    }

    #[test]
    fn edges_are_changes_in_one_direction_and_the_first_look_is_none() {
        assert_eq!(edges(true, "0011100101"), [2, 7, 9]);
        assert_eq!(edges(false, "0011100101"), [5, 8]);
        assert_eq!(edges(true, "1110"), [0; 0]);
        assert_eq!(edges(false, "000"), [0; 0]);
    }
}
