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

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum JsfFormat {
    Envelope,
    /// Behind the matched filter.
    Analytic,
    /// Before it.
    Unfiltered,
}

#[derive(Clone, Debug, PartialEq)]
pub struct JsfSpec {
    /// Commands.
    pub listen: SocketAddr,
    pub listen_data: SocketAddr,
    pub subsystem: u8,
    /// Further ones that only keep what they are told.
    pub silent_subsystems: Vec<u8>,
    pub channels: JsfChannels,
    /// Of staves.
    pub arrays: Vec<usize>,
    pub format: JsfFormat,
    pub record: bool,
    /// Bytes that may wait for one client before its records are dropped.
    pub client_queue_bytes: usize,
    pub max_clients: usize,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct XtfSpec {
    /// Volts instead of counts.
    pub is_float: bool,
}

#[derive(Clone, Debug, PartialEq)]
pub struct ImagenexSpec {
    pub listen: SocketAddr,
    pub client_queue_bytes: usize,
    pub max_clients: usize,
}
