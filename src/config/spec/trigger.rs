//! What makes a sonar ping, whom it tells of it, and what happens when pings are too much.

use std::net::SocketAddr;

/// What makes a sonar ping.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TriggerSpec {
    /// Source of pings.
    pub from: TriggerFrom,
    /// Treatment of a trigger during a listening window.
    pub early: EarlyTrigger,
    /// From pulse to pulse at least, beside what the range needs; seconds.
    pub min_interval_s: f64,
    /// A trigger that has not come for so long is missed, seconds.
    pub watchdog_s: Option<f64>,
}

/// Source of pings.
#[derive(Clone, Debug, Default, PartialEq)]
pub enum TriggerFrom {
    /// Its own beat.
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
    /// A topside that asks for pings by number, over any protocol or `echotank ctl trigger`.
    Protocol,
    /// Every pulse of another sonar, index into `RigSpec::sonars`, so long after it.
    Sonar {
        /// Index of the sonar that is followed.
        sonar: usize,
        /// Delay after its pulse.
        delay_s: f64,
    },
}

impl TriggerFrom {
    /// It comes from outside of this program through a door of its own.
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

/// What becomes of a trigger that comes while the ping before is listened to.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum EarlyTrigger {
    /// The trigger is refused and counted.
    #[default]
    Refuse,
    /// One waits until the sonar is free.
    Queue,
}

/// Whom a sonar tells that it pings.
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
