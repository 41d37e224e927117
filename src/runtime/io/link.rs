//! The link between an output and its clients, where link faults act on the records and packets of every family.

use std::sync::Arc;

use echotank_core::records::Datagram;
use echotank_emit::packets::Packets;

/// State of the connections of an output.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Connection {
    /// Normal operation.
    #[default]
    Up,
    /// Connections stay open, but nothing is sent or received.
    Mute,
    /// TCP clients are disconnected with a reset.
    Reset,
}

/// Link faults that act on the records or packets of a ping.
pub trait Link: Send {
    /// State of the connections at this ping.
    fn connection(&mut self) -> Connection;
    /// Returns the records to send in place of `records`.
    fn records<'a>(&'a mut self, records: &'a [Arc<Datagram>]) -> &'a [Arc<Datagram>];
    /// Applies the faults to packets in place.
    fn packets(&mut self, packets: &mut Packets);
}
