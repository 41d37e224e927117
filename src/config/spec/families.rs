//! Side-scan families: JSF, XTF, Imagenex 872.

use std::net::SocketAddr;

/// Meaning of a JSF channel.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum JsfChannels {
    /// One channel per side-scan line.
    Sides,
    /// One channel per element.
    Staves,
}

/// Data format of JSF sonar records.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum JsfFormat {
    /// Format 0.
    Envelope,
    /// After the matched filter.
    Analytic,
    /// Before the matched filter.
    Unfiltered,
}

/// EdgeTech JSF output.
#[derive(Clone, Debug, PartialEq)]
pub struct JsfSpec {
    /// Command port.
    pub listen: SocketAddr,
    /// Data port.
    pub listen_data: SocketAddr,
    /// Subsystem number of the first pulse.
    pub subsystem: u8,
    /// Further subsystems that only accept and report commands.
    pub silent_subsystems: Vec<u8>,
    /// Meaning of a channel.
    pub channels: JsfChannels,
    /// Indices of the receive arrays with staves.
    pub arrays: Vec<usize>,
    /// Data format.
    pub format: JsfFormat,
    /// Also write a file.
    pub record: bool,
    /// Queue of one client; further records are dropped.
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
