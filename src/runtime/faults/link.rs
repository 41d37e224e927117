//! Faults of the line between an output and its clients: records and packets are lost, doubled, held back or spoiled on their way.
//!
//! One line for all families, which differ in where a record may be spoiled so that it is still found ([`Shape`]). What is recorded does not pass
//! here.

use std::sync::{Arc, Mutex, PoisonError};

use echotank_protocols::{elements, ping_protocol, sevenk, wbms};

use crate::io::line::{Connection, Line as Passage};
use crate::io::sonar::heard::ear as heard;
use echotank_config::spec::{ConnectionFault, FaultKind, TransportFault};
use echotank_core::flow::{Datagram, PingPlan};
use echotank_core::time::UtcNs;
use echotank_emit::packets::Packets;
use echotank_ping::faults::{Faults, PingMark, Place, unit};

/// What a spoiled record keeps, and how it is known again.
#[derive(Clone, Copy, Debug)]
pub struct Shape {
    /// Of the family, in the log.
    name: &'static str,
    /// Where a packet says that it belongs.
    place: fn(&[u8]) -> Place,
    /// At its start: the frame, and a ping number in the body.
    kept_bytes: usize,
    /// Of its length, however it is cut.
    min_bytes: usize,
    /// Behind the body: a checksum.
    tail_bytes: usize,
    /// Makes the checksum fit; nothing where there is none.
    mend: fn(&mut [u8]),
}

fn mend_nothing(_: &mut [u8]) {}

/// Its record type and its ping say it all.
fn no_place(_: &[u8]) -> Place {
    Place::default()
}

impl Shape {
    pub const SEVENK: Self = Self {
        name: "7k",
        place: no_place,
        kept_bytes: 80,
        // A packetiser takes no less for a record.
        min_bytes: 68,
        tail_bytes: 4,
        mend: |bytes| {
            if let Some((body, tail)) = bytes.split_last_chunk_mut::<4>() {
                *tail = sevenk::checksum(body).to_le_bytes();
            }
        },
    };
    /// The message's header, and the ping number of a sonar message.
    pub const JSF: Self = Self::plain("jsf", 32);
    pub const WBMS: Self = Self {
        mend: |bytes| {
            if let Some((head, body)) = bytes.split_first_chunk_mut::<24>() {
                head[20..].copy_from_slice(&wbms::crc32(body).to_le_bytes());
            }
        },
        ..Self::plain("wbms", 32)
    };
    pub const PING: Self = Self {
        name: "ping",
        place: no_place,
        kept_bytes: 12,
        min_bytes: ping_protocol::HEADER_BYTES,
        tail_bytes: ping_protocol::CHECKSUM_BYTES,
        mend: |bytes| {
            if let Some((body, tail)) = bytes.split_last_chunk_mut::<2>() {
                *tail = ping_protocol::checksum(body).to_le_bytes();
            }
        },
    };
    /// The same on a serial line.
    pub(crate) const PING_SERIAL: Self = Self {
        name: "ping-serial",
        ..Self::PING
    };
    pub const IMAGENEX872: Self = Self::plain("imagenex872", 12);
    /// Header, stream, class and time of a packet.
    pub const VITA49: Self = Self {
        place: |bytes| {
            let place = heard::place_of(bytes);
            Place {
                stream: place.map(|p| p.stream),
                context: place.map(|p| p.context),
                packet_utc_ns: place.map(|p| p.utc_ns),
                ..Place::default()
            }
        },
        ..Self::plain("vita49", 28)
    };
    pub const ELEMENTS: Self = Self {
        place: |bytes| {
            let frame = elements::Frame::parse(bytes).ok();
            Place {
                frame_number: frame.map(|frame| frame.head.frame_number),
                ..Place::default()
            }
        },
        ..Self::plain("elements", elements::HEADER_BYTES)
    };

    const fn plain(name: &'static str, kept_bytes: usize) -> Self {
        Self {
            name,
            place: no_place,
            kept_bytes,
            min_bytes: kept_bytes,
            tail_bytes: 0,
            mend: mend_nothing,
        }
    }

    /// Changes a byte of the body; of one too short for a body the last before the checksum.
    fn corrupt(&self, bytes: &mut [u8], mended: bool) {
        let end = bytes.len().saturating_sub(self.tail_bytes);
        let at = match end > self.kept_bytes {
            true => (self.kept_bytes + end) / 2,
            false => end.saturating_sub(1),
        };
        let Some(byte) = bytes.get_mut(at) else {
            return;
        };
        *byte ^= 0x55;
        if mended {
            (self.mend)(bytes);
        }
    }

    /// How long it is when its second half is missing.
    fn cut_bytes(&self, bytes: usize) -> usize {
        let half = self.kept_bytes.max(bytes / 2);
        half.min(bytes.saturating_sub(1))
            .max(self.min_bytes.min(bytes))
    }
}

/// Keeps the draws of how late a record comes apart from all others.
const JITTER_TAG: [u8; 8] = *b"faultjit";

/// What becomes of the connections to the clients at this ping.
fn connection(faults: &Faults, ping: PingMark, line: &'static str) -> Connection {
    let mut connection = Connection::Up;
    let of_connection = |kind: &FaultKind| matches!(kind, FaultKind::Connection(_));
    faults.inject(ping, 0, of_connection, |spec, _, injection| {
        injection.line = Some(line);
        connection = match spec.kind {
            FaultKind::Connection(ConnectionFault::Reset) => Connection::Reset,
            _ => Connection::Mute,
        };
    });
    connection
}

/// What becomes of one record on the line.
fn record(
    faults: &Faults,
    ping: PingMark,
    record_type: u32,
    line: &'static str,
    place: impl Fn() -> Place,
    mut strike: impl FnMut(TransportFault, f64),
) {
    let of_line = |kind: &FaultKind| matches!(kind, FaultKind::Transport(_));
    faults.inject(ping, record_type, of_line, |spec, _, injection| {
        injection.line = Some(line);
        injection.place = place();
        if let FaultKind::Transport(fault) = spec.kind {
            // Another draw than whether it strikes.
            let part = || {
                unit(
                    spec.seed,
                    injection.fault,
                    ping.number,
                    record_type,
                    JITTER_TAG,
                )
            };
            strike(
                fault,
                if matches!(fault, TransportFault::Jitter { .. }) {
                    part()
                } else {
                    0.0
                },
            );
        }
    });
}

/// Of which ping the records are that an output hands over; shared with all its lines.
#[derive(Debug)]
pub struct LineMark(Mutex<PingMark>);

impl Default for LineMark {
    fn default() -> Self {
        let none = PingMark {
            sonar: 0,
            number: 0,
            utc: UtcNs(0),
        };
        Self(Mutex::new(none))
    }
}

impl LineMark {
    /// What is handed over from now on is of this ping.
    pub fn set(&self, plan: &PingPlan) {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = PingMark {
            sonar: plan.sonar,
            number: plan.ping_number,
            utc: plan.transmit_utc,
        };
    }

    fn now(&self) -> PingMark {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// The line of one server or sender.
pub struct Line {
    faults: Arc<Faults>,
    shape: Shape,
    mark: Arc<LineMark>,
    /// Held back, with when they may go.
    held: Vec<(UtcNs, Arc<Datagram>)>,
    out: Vec<Arc<Datagram>>,
    held_packets: Vec<(UtcNs, Vec<u8>)>,
    packets: Packets,
    /// The last ping that was asked how connections stand, and how they did.
    connected: Option<(u32, Connection)>,
}

impl Line {
    pub fn new(faults: Arc<Faults>, shape: Shape, mark: Arc<LineMark>) -> Self {
        Self {
            faults,
            shape,
            mark,
            held: Vec::new(),
            out: Vec::new(),
            held_packets: Vec::new(),
            packets: Packets::default(),
            connected: None,
        }
    }

    /// How many of it leave, until when they are held back, and how it is spoiled.
    fn fate(
        &self,
        ping: PingMark,
        record_type: u32,
        bytes: &[u8],
        spoil: &mut dyn FnMut(Spoiling),
    ) -> Fate {
        let mut fate = Fate {
            copies: 1,
            until: None,
        };
        let place = || (self.shape.place)(bytes);
        let strike = |fault, part: f64| match fault {
            TransportFault::Drop | TransportFault::LinkDown => fate.copies = 0,
            TransportFault::Duplicate => fate.copies *= 2,
            // Until the next ping's delivery, which is later.
            TransportFault::Reorder => fate.until = Some(ping.utc.plus_ns(1)),
            TransportFault::Delay { s } => fate.until = Some(ping.utc.plus_s(s)),
            TransportFault::Jitter { s } => fate.until = Some(ping.utc.plus_s(s * part).plus_ns(1)),
            TransportFault::Corrupt { mended } => spoil(Spoiling::Corrupt { mended }),
            TransportFault::Truncate => spoil(Spoiling::Truncate),
        };
        record(
            &self.faults,
            ping,
            record_type,
            self.shape.name,
            place,
            strike,
        );
        fate
    }

    fn spoil(shape: Shape, spoiling: Spoiling, bytes: &mut Vec<u8>) {
        match spoiling {
            Spoiling::Corrupt { mended } => shape.corrupt(bytes, mended),
            Spoiling::Truncate => bytes.truncate(shape.cut_bytes(bytes.len())),
        }
    }

    fn record(&mut self, ping: PingMark, record: &Arc<Datagram>) {
        let mut spoiled: Option<Datagram> = None;
        let shape = self.shape;
        let fate = self.fate(ping, record.record_type, &record.bytes, &mut |spoiling| {
            let whole = || (**record).clone();
            Self::spoil(
                shape,
                spoiling,
                &mut spoiled.get_or_insert_with(whole).bytes,
            );
        });
        let record = match spoiled {
            Some(spoiled) => Arc::new(spoiled),
            None => record.clone(),
        };
        for _ in 0..fate.copies {
            match fate.until {
                Some(due) => self.held.push((due, record.clone())),
                None => self.out.push(record.clone()),
            }
        }
    }

    /// `number`: of the packet within its ping, from 1.
    fn packet(&mut self, ping: PingMark, number: u32, packet: &[u8]) {
        let mut bytes = packet.to_vec();
        let shape = self.shape;
        let fate = self.fate(ping, number, packet, &mut |spoiling| {
            Self::spoil(shape, spoiling, &mut bytes);
        });
        for _ in 0..fate.copies {
            match fate.until {
                Some(due) => self.held_packets.push((due, bytes.clone())),
                None => self.packets.push(&bytes),
            }
        }
    }
}

struct Fate {
    copies: u32,
    until: Option<UtcNs>,
}

enum Spoiling {
    Corrupt { mended: bool },
    Truncate,
}

impl Passage for Line {
    fn connection(&mut self) -> Connection {
        let ping = self.mark.now();
        let before = self.connected.filter(|(number, _)| *number == ping.number);
        match before {
            // Of one ping one reset is enough.
            Some((_, Connection::Reset)) => Connection::Up,
            Some((_, connection)) => connection,
            None => {
                let connection = connection(&self.faults, ping, self.shape.name);
                self.connected = Some((ping.number, connection));
                connection
            }
        }
    }

    fn records<'a>(&'a mut self, records: &'a [Arc<Datagram>]) -> &'a [Arc<Datagram>] {
        if self.faults.standing() == 0 && self.held.is_empty() {
            return records;
        }
        let ping = self.mark.now();
        self.out.clear();
        for record in records {
            self.record(ping, record);
        }
        let out = &mut self.out;
        self.held.retain(|(due, record)| {
            let stays = *due > ping.utc;
            if !stays {
                out.push(record.clone());
            }
            stays
        });
        &self.out
    }

    fn packets(&mut self, packets: &mut Packets) {
        if self.faults.standing() == 0 && self.held_packets.is_empty() {
            return;
        }
        let ping = self.mark.now();
        self.packets.clear();
        for (block, heard_s) in packets.blocks() {
            for number in block {
                // Far fewer packets than 2^32 make a ping.
                self.packet(ping, number as u32 + 1, packets.packet(number));
            }
            if let Some(heard_s) = heard_s {
                self.packets.end_block(heard_s);
            }
        }
        let out = &mut self.packets;
        self.held_packets.retain(|(due, bytes)| {
            let stays = *due > ping.utc;
            if !stays {
                out.push(bytes);
            }
            stays
        });
        std::mem::swap(packets, &mut self.packets);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use echotank_config::spec::FaultRequest;

    const SHAPES: [(&str, Shape); 7] = [
        ("7k", Shape::SEVENK),
        ("jsf", Shape::JSF),
        ("wbms", Shape::WBMS),
        ("ping", Shape::PING),
        ("872", Shape::IMAGENEX872),
        ("vita49", Shape::VITA49),
        ("elements", Shape::ELEMENTS),
    ];

    /// Ping `number`'s packets: its number and their own, again and again.
    fn packets(number: u32) -> Packets {
        let mut packets = Packets::default();
        for k in 0..5 {
            packets.push(&[number as u8, k, 0, 0].repeat(50));
            if k == 1 {
                packets.end_block(0.5);
            }
        }
        packets
    }

    fn line(shape: Shape, json: &str) -> (Line, Arc<Faults>) {
        let faults = Arc::new(super::super::testing::faults());
        faults.begin(UtcNs(0));
        let request: FaultRequest = serde_json::from_str(json).expect("JSON");
        faults.add(&request).expect("sound");
        let mark = Arc::new(LineMark::default());
        (Line::new(faults.clone(), shape, mark), faults)
    }

    /// What comes of twenty pings, a tenth of a second apart: ping and packet of each, and whether it is whole.
    fn passed(shape: Shape, json: &str) -> (Vec<(u8, u8, bool)>, usize) {
        let (mut line, faults) = line(shape, json);
        let mut came = Vec::new();
        for number in 1..=20 {
            *line.mark.0.lock().expect("whole") = PingMark {
                sonar: 0,
                number,
                utc: UtcNs(i64::from(number) * 100_000_000),
            };
            let mut sent = packets(number);
            line.packets(&mut sent);
            came.extend(sent.iter().map(|packet| {
                let (ping, k) = (packet[0], packet[1]);
                let whole = *packet == [ping, k, 0, 0].repeat(50)[..];
                (ping, k, whole)
            }));
        }
        (came, faults.take_injections().len())
    }

    #[test]
    fn packets_of_every_family_are_struck_as_often_as_the_log_says() {
        for (name, shape) in SHAPES {
            let all = |kind| {
                passed(
                    shape,
                    &format!(r#"{{"kind": "{kind}", "probability": 0.4, "seed": 7}}"#),
                )
            };
            let whole = |came: &[(u8, u8, bool)]| came.iter().filter(|c| c.2).count();
            let (came, injected) = all("drop");
            assert!((20..60).contains(&injected), "{name}: {injected} of 100");
            assert_eq!(
                (came.len(), whole(&came)),
                (100 - injected, 100 - injected),
                "{name}"
            );
            let (came, doubled) = all("duplicate");
            assert_eq!(doubled, injected, "the same draws");
            assert_eq!((came.len(), whole(&came)), (100 + injected, 100 + injected));
            for kind in ["corrupt", "corrupt-mended", "truncate"] {
                let (came, spoiled) = all(kind);
                assert_eq!(
                    (came.len(), whole(&came)),
                    (100, 100 - spoiled),
                    "{name} {kind}"
                );
            }
            let (came, _) = all("reorder");
            let late = came.windows(2).filter(|w| w[1].0 < w[0].0).count();
            assert!(
                late > 5 && came.len() > 95,
                "{name}: {late} of {}",
                came.len()
            );
            let (came, _) = all("link-down");
            assert_eq!(came.len(), 100 - injected, "{name}");
        }
    }

    #[test]
    fn blocks_keep_their_times() {
        let (mut line, _) = line(Shape::VITA49, r#"{"kind": "duplicate"}"#);
        let mut sent = packets(1);
        line.packets(&mut sent);
        let blocks: Vec<_> = sent.blocks().collect();
        assert_eq!(blocks, [(0..4, Some(0.5)), (4..10, None)]);
    }

    #[test]
    fn a_mended_record_passes_its_familys_own_check_and_a_corrupt_one_does_not() {
        let mut ping = vec![b'B', b'R', 90, 0, 1, 0, 0, 0];
        ping.extend((0..90).map(|k| k as u8));
        ping.extend([0, 0]);
        (Shape::PING.mend)(&mut ping);
        let ping_sum = |bytes: &[u8]| {
            let (body, sum) = bytes.split_last_chunk::<2>().expect("long");
            ping_protocol::checksum(body) == u16::from_le_bytes(*sum)
        };
        let mut packet = vec![7; 200];
        (Shape::WBMS.mend)(&mut packet);
        let crc = |bytes: &[u8]| {
            u32::from_le_bytes(bytes[20..24].try_into().expect("four")) == wbms::crc32(&bytes[24..])
        };
        let mut record = vec![9; 200];
        (Shape::SEVENK.mend)(&mut record);
        let sum = |bytes: &[u8]| {
            let (body, sum) = bytes.split_last_chunk::<4>().expect("long");
            sevenk::checksum(body) == u32::from_le_bytes(*sum)
        };
        for (shape, bytes, check) in [
            (Shape::PING, &ping, &ping_sum as &dyn Fn(&[u8]) -> bool),
            (Shape::WBMS, &packet, &crc),
            (Shape::SEVENK, &record, &sum),
        ] {
            assert!(check(bytes));
            for mended in [false, true] {
                let mut spoiled = bytes.clone();
                shape.corrupt(&mut spoiled, mended);
                assert!(spoiled != *bytes && check(&spoiled) == mended, "{shape:?}");
                assert_eq!(
                    spoiled[..shape.kept_bytes.min(20)],
                    bytes[..shape.kept_bytes.min(20)]
                );
            }
        }
    }

    #[test]
    fn no_record_is_too_short_to_be_spoiled() {
        for (_, shape) in SHAPES {
            for len in 0..200 {
                let mut bytes = vec![1; len];
                shape.corrupt(&mut bytes, true);
                assert!(shape.cut_bytes(len) <= len, "{len} {shape:?}");
            }
        }
    }
}
