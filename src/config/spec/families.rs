//! Outputs in the side-scan formats JSF, XTF and Imagenex 872.

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
    /// Envelope: data format 0.
    Envelope,
    /// Analytic signal after the matched filter.
    Analytic,
    /// Analytic signal before the matched filter.
    Unfiltered,
}

/// EdgeTech JSF output.
#[derive(Clone, Debug, PartialEq)]
pub struct JsfSpec {
    /// Address of the command port.
    pub listen: SocketAddr,
    /// Address of the data port.
    pub listen_data: SocketAddr,
    /// Subsystem number of the first pulse.
    pub subsystem: u8,
    /// Further subsystems. They accept and report commands but have no data.
    pub silent_subsystems: Vec<u8>,
    /// Meaning of a channel.
    pub channels: JsfChannels,
    /// Indices of the receive arrays in use, with [`JsfChannels::Staves`].
    pub arrays: Vec<usize>,
    /// Data format.
    pub format: JsfFormat,
    /// True if a file is also written.
    pub record: bool,
    /// Size of the queue of one client, bytes. Records beyond it are dropped.
    pub client_queue_bytes: usize,
    /// Maximum number of simultaneous connections.
    pub max_clients: usize,
}

/// Triton XTF output.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct XtfSpec {
    /// True for samples in volts, false for counts.
    pub is_float: bool,
}

/// Imagenex 872 output.
#[derive(Clone, Debug, PartialEq)]
pub struct ImagenexSpec {
    /// TCP address.
    pub listen: SocketAddr,
    /// Size of the queue of one client, bytes.
    pub client_queue_bytes: usize,
    /// Maximum number of simultaneous connections.
    pub max_clients: usize,
}
