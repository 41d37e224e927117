//! Outputs that emulate the device of one manufacturer.

use std::net::SocketAddr;

use echotank_core::ping::Side;

/// Emulated device of the Ping protocol.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PingDevice {
    /// Side-scan sonar. It sends one line of this side.
    Omniscan450 {
        /// Side of the line.
        side: Side,
    },
    /// Multibeam echo sounder. It sends the soundings of the fan.
    Surveyor240,
}

impl PingDevice {
    /// Name in the configuration.
    pub fn name(self) -> &'static str {
        match self {
            Self::Omniscan450 { .. } => "omniscan450",
            Self::Surveyor240 => "surveyor240",
        }
    }
}

/// Ping protocol output.
#[derive(Clone, Debug, PartialEq)]
pub struct PingProtocolSpec {
    /// Device that is emulated.
    pub device: PingDevice,
    /// TCP and UDP address.
    pub listen: SocketAddr,
    /// Name and bits per second of a serial port.
    pub serial: Option<(String, u32)>,
    /// Number of this device, and number of synchronised devices.
    pub channel: (u8, u8),
    /// Size of the queue of one client, bytes.
    pub client_queue_bytes: usize,
    /// Maximum number of simultaneous connections.
    pub max_clients: usize,
}

/// NORBIT WBMS output: four TCP servers for control, bathymetry, water column, and side-scan or snippets.
#[derive(Clone, Debug, PartialEq)]
pub struct WbmsSpec {
    /// Control port. The other servers use the next three ports. Port 0 means four free ports.
    pub listen: SocketAddr,
    /// Size of the queue of one client, bytes.
    pub client_queue_bytes: usize,
    /// Maximum number of simultaneous connections.
    pub max_clients: usize,
}

impl WbmsSpec {
    /// Address of the server with index `number`, from 0.
    pub fn address(&self, number: u16) -> SocketAddr {
        let mut address = self.listen;
        if address.port() != 0 {
            address.set_port(address.port() + number);
        }
        address
    }
}
