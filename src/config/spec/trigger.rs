//! Trigger inputs of a sonar, and its output signals at each pulse.

use std::net::SocketAddr;

/// Trigger of a sonar, and rules for early and missing triggers.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TriggerSpec {
    /// Origin of the triggers.
    pub from: TriggerFrom,
    /// Treatment of a trigger during a listening window.
    pub early: EarlyTrigger,
    /// Minimum interval between pulses, seconds, in addition to the limit from the range.
    pub min_interval_s: f64,
    /// Time without a trigger after which a trigger is counted as missing, seconds.
    pub watchdog_s: Option<f64>,
}

/// Origin of the triggers.
#[derive(Clone, Debug, Default, PartialEq)]
pub enum TriggerFrom {
    /// The internal ping rate.
    #[default]
    Internal,
    /// Each received datagram is a trigger.
    Udp {
        /// Local address.
        listen: SocketAddr,
    },
    /// Each received line of any client is a trigger.
    Tcp {
        /// Local address.
        listen: SocketAddr,
    },
    /// Each edge of a modem line is a trigger.
    Serial {
        /// Name of the serial port.
        port: String,
        /// Input line.
        line: ModemLine,
        /// True for the rising edge, false for the falling edge.
        rising: bool,
    },
    /// Requests for pings by number, over any protocol or `echotank ctl trigger`.
    Protocol,
    /// Each pulse of another sonar of `RigSpec::sonars` is a trigger.
    Sonar {
        /// Index of the other sonar.
        sonar: usize,
        /// Delay after the pulse of the other sonar, seconds.
        delay_s: f64,
    },
}

impl TriggerFrom {
    /// Whether the trigger arrives over its own socket or serial port.
    pub fn is_wired(&self) -> bool {
        matches!(
            self,
            Self::Udp { .. } | Self::Tcp { .. } | Self::Serial { .. }
        )
    }
}

/// Modem input line of a serial port.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ModemLine {
    /// Clear to send (CTS).
    ClearToSend,
    /// Data carrier detect (DCD).
    CarrierDetect,
}

/// Action for a trigger during the listening window of the previous ping.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum EarlyTrigger {
    /// The trigger is refused and counted.
    #[default]
    Refuse,
    /// The trigger waits until the window ends. At most one trigger waits.
    Queue,
}

/// Output signals at each pulse.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TriggerOutSpec {
    /// Destination of a datagram for every pulse.
    pub to: Option<SocketAddr>,
    /// Serial line that is active at every pulse; `None` uses no line.
    pub serial: Option<TriggerLineSpec>,
}

/// Serial line that is active for a time at every pulse.
#[derive(Clone, Debug, PartialEq)]
pub struct TriggerLineSpec {
    /// Name of the serial port.
    pub port: String,
    /// Output line.
    pub line: OutLine,
    /// Time for which the line is active, seconds.
    pub pulse_s: f64,
}

/// Modem output line of a serial port.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum OutLine {
    /// Request to send (RTS).
    RequestToSend,
    /// Data terminal ready (DTR).
    DataTerminalReady,
}
