//! Interface between the sonar protocols and the servers: received bytes, answers, and the records that each client subscribes to.
//! Sans I/O.
//!
//! The module of a sonar family implements [`Protocol`] for each of its ports and [`Session`] for one client of a port. The server
//! in the runtime crate handles sockets, queues, counters and times.

use std::net::SocketAddr;
use std::ops::Range;

use echotank_core::records::Datagram;
use echotank_core::time::UtcNs;

/// Bit set of a protocol's record classes, small enough for an atomic. The protocol defines the meaning of the bits ([`Protocol::class`]).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub struct Wants(pub u64);

impl Wants {
    /// No record.
    pub const NONE: Self = Self(0);
    /// Every class of records.
    pub const ALL: Self = Self(u64::MAX);

    /// The class with this number, 0 to 63.
    pub const fn class(number: u32) -> Self {
        Self(1 << number)
    }
    /// True if the set holds no class.
    pub const fn is_empty(self) -> bool {
        self.0 == 0
    }
    /// Classes in either set.
    pub const fn union(self, other: Self) -> Self {
        Self(self.0 | other.0)
    }
    /// Classes in this set and not in `other`.
    pub const fn without(self, other: Self) -> Self {
        Self(self.0 & !other.0)
    }
    /// True if the sets have a class in common.
    pub const fn meets(self, other: Self) -> bool {
        self.0 & other.0 != 0
    }
}

/// Transport protocol of a client's connection.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Transport {
    /// Stream: the server sends records one after the other.
    Tcp,
    /// Datagrams: the server sends each packet as one datagram.
    Udp,
}

impl std::fmt::Display for Transport {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Tcp => "TCP",
            Self::Udp => "UDP",
        })
    }
}

/// An action that a session requests from the server.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Outgoing {
    /// Send this record to the session's client.
    Reply(Datagram),
    /// Send this record to every client of the port that subscribes to its class.
    Echo(Datagram),
    /// Send records of these classes to a third party, until [`Outgoing::HangUp`].
    Dial {
        /// Address of the third party.
        peer: SocketAddr,
        /// Transport to use.
        transport: Transport,
        /// Classes of records to send.
        wants: Wants,
    },
    /// Stop sending records to a third party.
    HangUp {
        /// Address of the third party.
        peer: SocketAddr,
        /// Transport in use.
        transport: Transport,
    },
}

/// Counts of the commands and bytes that a session received.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SessionCounts {
    /// Commands received, refused ones included.
    pub commands: u64,
    /// Commands refused.
    pub nacks: u64,
    /// Number of invalid byte sequences and malformed records.
    pub framing_errors: u64,
    /// Complete records that are not commands.
    pub other_records: u64,
}

/// Protocol state of one client: processes commands and appends answers.
pub trait Session: Send {
    /// Appends the messages to send when a client connects.
    fn greet(&mut self, now: UtcNs, out: &mut Vec<Outgoing>) {
        let _ = (now, out);
    }
    /// Processes bytes from the client (over UDP: one datagram) and appends the answers to `out` in order. `now` is rig time.
    fn receive(&mut self, bytes: &[u8], now: UtcNs, out: &mut Vec<Outgoing>);
    /// True if only a part of a command has arrived.
    fn is_waiting(&self) -> bool {
        false
    }
    /// Ends the wait for the rest of a command, because the client closed the connection or stalled.
    fn give_up_waiting(&mut self, now: UtcNs, out: &mut Vec<Outgoing>) {
        let _ = (now, out);
    }
    /// True if the client requested to disconnect. The server sends the waiting records and closes the connection.
    fn is_over(&self) -> bool {
        false
    }
    /// Classes of records that the client receives from every ping.
    fn wants(&self) -> Wants;
    /// Removes and returns the record classes requested since the last call. These records are sent once, from the next ping.
    fn take_requested(&mut self) -> Wants {
        Wants::NONE
    }
    /// Counters of the session so far.
    fn counts(&self) -> SessionCounts;
}

/// Divides records into packets for the wire.
pub trait Framer: Send {
    /// Appends the packets of one record to `wire` and their byte ranges to `packets`. TCP sends the bytes as they are; UDP sends each
    /// packet as a datagram.
    fn frame(&mut self, record: &[u8], wire: &mut Vec<u8>, packets: &mut Vec<Range<usize>>);
}

/// Framer that sends each record unchanged as one packet.
pub struct Plain;

impl Framer for Plain {
    fn frame(&mut self, record: &[u8], wire: &mut Vec<u8>, packets: &mut Vec<Range<usize>>) {
        let start = wire.len();
        wire.extend_from_slice(record);
        packets.push(start..wire.len());
    }
}

/// Protocol of one port: creates sessions and framers, and classifies records.
pub trait Protocol: Send + Sync {
    /// Name for threads and counters.
    fn name(&self) -> &'static str;
    /// Creates the session of a client that connects from `peer`.
    fn connect(&self, transport: Transport, peer: SocketAddr) -> Box<dyn Session>;
    /// Creates the framer for a client's transport.
    fn framer(&self, transport: Transport) -> Box<dyn Framer> {
        let _ = transport;
        Box::new(Plain)
    }
    /// Record classes of a record, by [`Datagram::record_type`].
    fn class(&self, record_type: u32) -> Wants;
    /// True if requests for a record outlast the delivery of one, because a later request waits for another ping.
    fn has_more_requests(&self, record_type: u32) -> bool {
        let _ = record_type;
        false
    }
    /// True if this first datagram from an unknown address starts a session. Other datagrams are only counted.
    fn recognises(&self, datagram: &[u8]) -> bool {
        let _ = datagram;
        true
    }
    /// Version of the settings. The server calls [`Protocol::notices`] when it increases.
    fn version(&self) -> u64 {
        0
    }
    /// Records that report setting changes after `version` that other protocols made. Clients receive them by their subscriptions.
    fn notices(&self, version: u64, now: UtcNs) -> Vec<Datagram> {
        let _ = (version, now);
        Vec::new()
    }
}
