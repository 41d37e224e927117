//! The line between an output and whoever is at its other end, where it may go wrong: the one place that every family's records and packets pass.

use std::sync::Arc;

use echotank_core::flow::Datagram;
use echotank_emit::packets::Packets;

/// How the connections stand.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Connection {
    #[default]
    Up,
    /// Nothing is sent and nothing is heard, and nobody is told.
    Mute,
    /// TCP clients are reset.
    Reset,
}

/// What becomes of a ping's records or packets on their way.
pub trait Link: Send {
    /// How the connections stand at this ping.
    fn connection(&mut self) -> Connection;
    /// What comes out when `records` are sent.
    fn records<'a>(&'a mut self, records: &'a [Arc<Datagram>]) -> &'a [Arc<Datagram>];
    /// The same of packets, in their place.
    fn packets(&mut self, packets: &mut Packets);
}
