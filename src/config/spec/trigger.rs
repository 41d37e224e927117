//! Triggers of a sonar, and signals at its pulses.

use std::net::SocketAddr;

/// Trigger of a sonar.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TriggerSpec {
    /// Source of pings.
    pub from: TriggerFrom,
    /// Treatment of a trigger during a listening window.
    pub early: EarlyTrigger,
    /// Minimum interval between pulses, besides that of the range; seconds.
    pub min_interval_s: f64,
    /// A trigger is counted as missing after this time, seconds.
    pub watchdog_s: Option<f64>,
}

/// Source of pings.
#[derive(Clone, Debug, Default, PartialEq)]
pub enum TriggerFrom {
    /// The internal ping rate.
    #[default]
    Internal,
    /// Every datagram.
    Udp {
        /// Local address.
        listen: SocketAddr,
    },
    /// Every line of every client.
    Tcp {
        /// Local address.
        listen: SocketAddr,
    },
    /// Every edge of a modem line.
    Serial {
        /// Name of the serial port.
        port: String,
        /// Input line.
        line: ModemLine,
        /// The rising edge triggers, else the falling one.
        rising: bool,
    },
    /// Pings that a topside requests by number, over any protocol or `echotank ctl trigger`.
    Protocol,
    /// Every pulse of another sonar of `RigSpec::sonars`.
    Sonar {
        /// Index of the sonar that is followed.
        sonar: usize,
        /// Delay after its pulse.
        delay_s: f64,
    },
}

impl TriggerFrom {
    /// Whether the trigger arrives over a socket or serial port of its own.
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
    /// CTS.
    ClearToSend,
    /// DCD.
    CarrierDetect,
}

/// Action for a trigger during the listening window of the previous ping.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum EarlyTrigger {
    /// The trigger is refused and counted.
    #[default]
    Refuse,
    /// One trigger waits until the window ends.
    Queue,
}

/// Signals at each pulse.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TriggerOutSpec {
    /// A datagram for every pulse.
    pub to: Option<SocketAddr>,
    /// Serial line that is raised; none: no line.
    pub serial: Option<TriggerLineSpec>,
}

/// A serial port's line that is raised for every pulse.
#[derive(Clone, Debug, PartialEq)]
pub struct TriggerLineSpec {
    /// Name of the serial port.
    pub port: String,
    /// Output line.
    pub line: OutLine,
    /// Time for which the line stays raised.
    pub pulse_s: f64,
}

/// Modem output line of a serial port.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum OutLine {
    /// RTS.
    RequestToSend,
    /// DTR.
    DataTerminalReady,
}
