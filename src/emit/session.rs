//! What a protocol is to the servers: bytes in, answers out, and which records a client wants. Sans I/O.
//!
//! A family implements [`Protocol`] once for each port it serves, and [`Session`] for one client of that port. The server
//! (`io::sonar::SonarServer`) does the rest: sockets, queues, counters, times.

use std::net::SocketAddr;
use std::ops::Range;

use echotank_core::flow::Datagram;
use echotank_core::time::UtcNs;

/// A set of a protocol's classes of records, small enough for an atomic. What the bits mean is the protocol's ([`Protocol::class`]).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub struct Wants(pub u64);

impl Wants {
    pub const NONE: Self = Self(0);
    pub const ALL: Self = Self(u64::MAX);

    /// The class with this number, 0 to 63.
    pub const fn class(number: u32) -> Self {
        Self(1 << number)
    }
    pub const fn is_empty(self) -> bool {
        self.0 == 0
    }
    pub const fn union(self, other: Self) -> Self {
        Self(self.0 | other.0)
    }
    pub const fn without(self, other: Self) -> Self {
        Self(self.0 & !other.0)
    }
    pub const fn meets(self, other: Self) -> bool {
        self.0 & other.0 != 0
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Transport {
    Tcp,
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

/// What a session wants done.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Outgoing {
    /// For this client.
    Reply(Datagram),
    /// For every client of the port that wants records of its class.
    Echo(Datagram),
    /// Records of these classes are to go to somebody who has not asked himself, until [`Outgoing::HangUp`].
    Dial {
        peer: SocketAddr,
        transport: Transport,
        wants: Wants,
    },
    HangUp {
        peer: SocketAddr,
        transport: Transport,
    },
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SessionCounts {
    /// Commands met, refused ones included.
    pub commands: u64,
    pub nacks: u64,
    /// Times that bytes were no record, or a record was wrong.
    pub framing_errors: u64,
    /// Whole records that are no commands.
    pub other_records: u64,
}

/// One client.
pub trait Session: Send {
    /// What is said to a client before it says anything.
    fn greet(&mut self, now: UtcNs, out: &mut Vec<Outgoing>) {
        let _ = (now, out);
    }
    /// Takes what came from the client (over UDP: one datagram) and appends the answers to `out`, in order. `now`: rig time.
    fn receive(&mut self, bytes: &[u8], now: UtcNs, out: &mut Vec<Outgoing>);
    /// Part of a command is there and waits for the rest.
    fn is_waiting(&self) -> bool {
        false
    }
    /// Says that the command begun will not go on: the client closed, or stalled.
    fn give_up_waiting(&mut self, now: UtcNs, out: &mut Vec<Outgoing>) {
        let _ = (now, out);
    }
    /// The client asked to be let go: what waits for it is written, and the connection closed.
    fn is_over(&self) -> bool {
        false
    }
    /// What it gets of every ping.
    fn wants(&self) -> Wants;
    /// What it gets of the next ping, once, since the last call.
    fn take_requested(&mut self) -> Wants {
        Wants::NONE
    }
    fn counts(&self) -> SessionCounts;
}

/// Puts a client's records on the wire.
pub trait Framer: Send {
    /// Appends the packets of one record to `wire` and where each lies in it to `packets`: over TCP they are sent as they are, over UDP each
    /// is a datagram.
    fn frame(&mut self, record: &[u8], wire: &mut Vec<u8>, packets: &mut Vec<Range<usize>>);
}

/// Records that go out as they are.
pub struct Plain;

impl Framer for Plain {
    fn frame(&mut self, record: &[u8], wire: &mut Vec<u8>, packets: &mut Vec<Range<usize>>) {
        let start = wire.len();
        wire.extend_from_slice(record);
        packets.push(start..wire.len());
    }
}

/// What is spoken on one port.
pub trait Protocol: Send + Sync {
    /// For names of threads and lines of counters.
    fn name(&self) -> &'static str;
    fn connect(&self, transport: Transport, peer: SocketAddr) -> Box<dyn Session>;
    fn framer(&self, transport: Transport) -> Box<dyn Framer> {
        let _ = transport;
        Box::new(Plain)
    }
    /// Which wants a record answers, by [`Datagram::record_type`].
    fn class(&self, record_type: u32) -> Wants;
    /// Whether a stranger's first datagram makes him a client. What does not is only counted.
    fn welcomes(&self, datagram: &[u8]) -> bool {
        let _ = datagram;
        true
    }
    /// The settings' version; [`Protocol::notices`] is asked when it goes up.
    fn version(&self) -> u64 {
        0
    }
    /// What clients are told, by their wants, of changes after `version` that were not made through this protocol.
    fn notices(&self, version: u64, now: UtcNs) -> Vec<Datagram> {
        let _ = (version, now);
        Vec::new()
    }
}
