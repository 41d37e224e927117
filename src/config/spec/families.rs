//! Side-scan families: JSF, XTF, Imagenex 872.

use std::net::SocketAddr;

/// What a channel of JSF is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum JsfChannels {
    /// A side-scan line each.
    Sides,
    /// An element each.
    Staves,
}

/// Data format of JSF sonar records.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum JsfFormat {
    /// Format 0.
    Envelope,
    /// Behind the matched filter.
    Analytic,
    /// Before it.
    Unfiltered,
}

/// EdgeTech JSF output.
#[derive(Clone, Debug, PartialEq)]
pub struct JsfSpec {
    /// Commands.
    pub listen: SocketAddr,
    /// Data port.
    pub listen_data: SocketAddr,
    /// Subsystem number of the first pulse.
    pub subsystem: u8,
    /// Further ones that only keep what they are told.
    pub silent_subsystems: Vec<u8>,
    /// Meaning of a channel.
    pub channels: JsfChannels,
    /// Of staves.
    pub arrays: Vec<usize>,
    /// Data format.
    pub format: JsfFormat,
    /// Also write a file.
    pub record: bool,
    /// Bytes that may wait for one client before its records are dropped.
    pub client_queue_bytes: usize,
    /// Connections at the same time.
    pub max_clients: usize,
}

/// Triton XTF output.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct XtfSpec {
    /// Volts instead of counts.
    pub is_float: bool,
}

/// Imagenex 872 output.
#[derive(Clone, Debug, PartialEq)]
pub struct ImagenexSpec {
    /// TCP address.
    pub listen: SocketAddr,
    /// Queue of one client.
    pub client_queue_bytes: usize,
    /// Connections at the same time.
    pub max_clients: usize,
}
