//! Outputs that imitate one maker's device.

use std::net::SocketAddr;

use echotank_core::flow::Side;

/// What a device of the Ping protocol is.
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
    /// As the configuration spells it.
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
    /// A serial line's name and bits per second.
    pub serial: Option<(String, u32)>,
    /// Which of how many synchronised devices this is.
    pub channel: (u8, u8),
    /// Queue of one client.
    pub client_queue_bytes: usize,
    /// Connections at the same time.
    pub max_clients: usize,
}

/// Four TCP servers: control, bathymetry, water column, side-scan or snippets.
#[derive(Clone, Debug, PartialEq)]
pub struct WbmsSpec {
    /// Of the control; the others are on the ports behind it. Port 0 takes any four.
    pub listen: SocketAddr,
    /// Queue of one client.
    pub client_queue_bytes: usize,
    /// Connections at the same time.
    pub max_clients: usize,
}

impl WbmsSpec {
    /// Where the server `number`, from 0, listens.
    pub fn address(&self, number: u16) -> SocketAddr {
        let mut address = self.listen;
        if address.port() != 0 {
            address.set_port(address.port() + number);
        }
        address
    }
}
