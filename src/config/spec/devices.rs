//! Outputs that imitate one maker's device.

use std::net::SocketAddr;

use echotank_core::ping::Side;

/// Device of the Ping protocol.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PingDevice {
    /// Side-scan: one line, of this side.
    Omniscan450 {
        /// The side-scan line that is sent.
        side: Side,
    },
    /// Multibeam: the soundings of the fan.
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
    /// TCP and UDP.
    pub listen: SocketAddr,
    /// Name and bits per second of a serial port.
    pub serial: Option<(String, u32)>,
    /// Number of this device and number of synchronised devices.
    pub channel: (u8, u8),
    /// Queue of one client.
    pub client_queue_bytes: usize,
    /// Connections at the same time.
    pub max_clients: usize,
}

/// Four TCP servers: control, bathymetry, water column, side-scan or snippets.
#[derive(Clone, Debug, PartialEq)]
pub struct WbmsSpec {
    /// Control port; the others follow it. Port 0 takes any four.
    pub listen: SocketAddr,
    /// Queue of one client.
    pub client_queue_bytes: usize,
    /// Connections at the same time.
    pub max_clients: usize,
}

impl WbmsSpec {
    /// Address of server `number`, from 0.
    pub fn address(&self, number: u16) -> SocketAddr {
        let mut address = self.listen;
        if address.port() != 0 {
            address.set_port(address.port() + number);
        }
        address
    }
}
