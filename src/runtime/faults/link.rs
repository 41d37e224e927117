//! Faults of the link between an output and its clients: records and packets are lost, duplicated, delayed or corrupted.
//!
//! One implementation serves all protocol families. The families differ in the bytes that may be corrupted so that a record is still recognised
//! ([`RecordLayout`]). Recordings are not affected.

use std::sync::{Arc, Mutex, PoisonError};

use echotank_protocols::{elements, ping_protocol, sevenk, wbms};

use crate::io::link::{Connection, Link as OutputLink};
use crate::io::sonar::verification::decode;
use echotank_config::spec::{ConnectionFault, FaultKind, TransportFault};
use echotank_core::ping::PingPlan;
use echotank_core::records::Datagram;
use echotank_core::time::UtcNs;
use echotank_emit::packets::Packets;
use echotank_ping::faults::{Faults, PingMark, Place, unit};

/// Bytes of a record that stay intact under corruption, and its checksum.
#[derive(Clone, Copy, Debug)]
pub struct RecordLayout {
    /// Name of the family in the log.
    name: &'static str,
    /// Reads a packet's stream, frame number and time for the log.
    place: fn(&[u8]) -> Place,
    /// Number of bytes intact at the start: the header, and a ping number in the body.
    kept_bytes: usize,
    /// Minimum length after truncation.
    min_bytes: usize,
    /// Length of the checksum after the body.
    tail_bytes: usize,
    /// Recomputes the checksum, if the family has one.
    update_checksum: fn(&mut [u8]),
}

fn no_checksum(_: &mut [u8]) {}

/// Location of records that are identified by type and ping number.
fn no_place(_: &[u8]) -> Place {
    Place::default()
}

impl RecordLayout {
    /// Teledyne RESON 7k records.
    pub const SEVENK: Self = Self {
        name: "7k",
        place: no_place,
        kept_bytes: 80,
        // The packetiser rejects shorter records.
        min_bytes: 68,
        tail_bytes: 4,
        update_checksum: |bytes| {
            if let Some((body, tail)) = bytes.split_last_chunk_mut::<4>() {
                *tail = sevenk::checksum(body).to_le_bytes();
            }
        },
    };
    /// EdgeTech JSF messages; the header and the ping number of a sonar message stay intact.
    pub const JSF: Self = Self::plain("jsf", 32);
    /// NORBIT WBMS packets.
    pub const WBMS: Self = Self {
        update_checksum: |bytes| {
            if let Some((head, body)) = bytes.split_first_chunk_mut::<24>() {
                head[20..].copy_from_slice(&wbms::crc32(body).to_le_bytes());
            }
        },
        ..Self::plain("wbms", 32)
    };
    /// Ping protocol frames over TCP and UDP.
    pub const PING: Self = Self {
        name: "ping",
        place: no_place,
        kept_bytes: 12,
        min_bytes: ping_protocol::HEADER_BYTES,
        tail_bytes: ping_protocol::CHECKSUM_BYTES,
        update_checksum: |bytes| {
            if let Some((body, tail)) = bytes.split_last_chunk_mut::<2>() {
                *tail = ping_protocol::checksum(body).to_le_bytes();
            }
        },
    };
    /// Ping protocol frames on a serial port.
    pub(crate) const PING_SERIAL: Self = Self {
        name: "ping-serial",
        ..Self::PING
    };
    /// Imagenex 872 answers.
    pub const IMAGENEX872: Self = Self::plain("imagenex872", 12);
    /// VITA 49.2 packets; header, stream, class and time stay intact.
    pub const VITA49: Self = Self {
        place: |bytes| {
            let place = decode::position_of(bytes);
            Place {
                stream: place.map(|p| p.stream),
                context: place.map(|p| p.context),
                packet_utc_ns: place.map(|p| p.utc_ns),
                ..Place::default()
            }
        },
        ..Self::plain("vita49", 28)
    };
    /// Frames of the element stream.
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
            update_checksum: no_checksum,
        }
    }

    /// Changes a byte of the body, or the last byte before the checksum if there is no body.
    ///
    /// `mended` recomputes the checksum afterwards.
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
            (self.update_checksum)(bytes);
        }
    }

    /// Length of a record of `bytes` bytes after its second half is removed.
    fn cut_bytes(&self, bytes: usize) -> usize {
        let half = self.kept_bytes.max(bytes / 2);
        half.min(bytes.saturating_sub(1))
            .max(self.min_bytes.min(bytes))
    }
}

/// Separates the random stream of jitter from all others.
const JITTER_TAG: [u8; 8] = *b"faultjit";

/// Draws the state of the connections at this ping.
fn connection(faults: &Faults, ping: PingMark, link: &'static str) -> Connection {
    let mut connection = Connection::Up;
    let of_connection = |kind: &FaultKind| matches!(kind, FaultKind::Connection(_));
    faults.inject(ping, 0, of_connection, |spec, _, injection| {
        injection.line = Some(link);
        connection = match spec.kind {
            FaultKind::Connection(ConnectionFault::Reset) => Connection::Reset,
            _ => Connection::Mute,
        };
    });
    connection
}

/// Draws the faults of one record and passes each to `apply`, with a uniform draw in [0, 1) for jitter.
fn record(
    faults: &Faults,
    ping: PingMark,
    record_type: u32,
    link: &'static str,
    place: impl Fn() -> Place,
    mut apply: impl FnMut(TransportFault, f64),
) {
    let of_link = |kind: &FaultKind| matches!(kind, FaultKind::Transport(_));
    faults.inject(ping, record_type, of_link, |spec, _, injection| {
        injection.line = Some(link);
        injection.place = place();
        if let FaultKind::Transport(fault) = spec.kind {
            // Independent of the draw that decides on the injection.
            let part = || {
                unit(
                    spec.seed,
                    injection.fault,
                    ping.number,
                    record_type,
                    JITTER_TAG,
                )
            };
            apply(
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

/// Ping whose records an output currently sends, shared with all links of the output.
#[derive(Debug)]
pub struct LinkMark(Mutex<PingMark>);

impl Default for LinkMark {
    fn default() -> Self {
        let none = PingMark {
            sonar: 0,
            number: 0,
            utc: UtcNs(0),
        };
        Self(Mutex::new(none))
    }
}

impl LinkMark {
    /// Sets the ping of the records sent from now on.
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

/// Link of one server or sender, with fault injection.
pub struct FaultyLink {
    faults: Arc<Faults>,
    layout: RecordLayout,
    mark: Arc<LinkMark>,
    /// Delayed records with their release times.
    held: Vec<(UtcNs, Arc<Datagram>)>,
    out: Vec<Arc<Datagram>>,
    held_packets: Vec<(UtcNs, Vec<u8>)>,
    packets: Packets,
    /// Newest ping with a drawn connection state, and that state.
    connected: Option<(u32, Connection)>,
}

impl FaultyLink {
    /// Creates a link for records of `layout` that injects `faults` into the ping of `mark`.
    pub fn new(faults: Arc<Faults>, layout: RecordLayout, mark: Arc<LinkMark>) -> Self {
        Self {
            faults,
            layout,
            mark,
            held: Vec::new(),
            out: Vec::new(),
            held_packets: Vec::new(),
            packets: Packets::default(),
            connected: None,
        }
    }

    /// Draws the faults of one record. Returns the number of copies and their release time. Corruptions are passed to `corrupt`.
    fn draw(
        &self,
        ping: PingMark,
        record_type: u32,
        bytes: &[u8],
        corrupt: &mut dyn FnMut(Corruption),
    ) -> Delivery {
        let mut delivery = Delivery {
            copies: 1,
            until: None,
        };
        let place = || (self.layout.place)(bytes);
        let apply = |fault, part: f64| match fault {
            TransportFault::Drop | TransportFault::LinkDown => delivery.copies = 0,
            TransportFault::Duplicate => delivery.copies *= 2,
            // The delivery of the next ping is later and therefore releases the record.
            TransportFault::Reorder => delivery.until = Some(ping.utc.plus_ns(1)),
            TransportFault::Delay { s } => delivery.until = Some(ping.utc.plus_s(s)),
            TransportFault::Jitter { s } => {
                delivery.until = Some(ping.utc.plus_s(s * part).plus_ns(1));
            }
            TransportFault::Corrupt { mended } => corrupt(Corruption::Change { mended }),
            TransportFault::Truncate => corrupt(Corruption::Truncate),
        };
        record(
            &self.faults,
            ping,
            record_type,
            self.layout.name,
            place,
            apply,
        );
        delivery
    }

    fn corrupt(layout: RecordLayout, corruption: Corruption, bytes: &mut Vec<u8>) {
        match corruption {
            Corruption::Change { mended } => layout.corrupt(bytes, mended),
            Corruption::Truncate => bytes.truncate(layout.cut_bytes(bytes.len())),
        }
    }

    fn record(&mut self, ping: PingMark, record: &Arc<Datagram>) {
        let mut corrupted: Option<Datagram> = None;
        let layout = self.layout;
        let mut corrupt = |corruption| {
            let intact = || (**record).clone();
            let bytes = &mut corrupted.get_or_insert_with(intact).bytes;
            Self::corrupt(layout, corruption, bytes);
        };
        let delivery = self.draw(ping, record.record_type, &record.bytes, &mut corrupt);
        let record = match corrupted {
            Some(corrupted) => Arc::new(corrupted),
            None => record.clone(),
        };
        for _ in 0..delivery.copies {
            match delivery.until {
                Some(due) => self.held.push((due, record.clone())),
                None => self.out.push(record.clone()),
            }
        }
    }

    /// Applies the faults to a packet. `number` is the number of the packet within its ping, from 1.
    fn packet(&mut self, ping: PingMark, number: u32, packet: &[u8]) {
        let mut bytes = packet.to_vec();
        let layout = self.layout;
        let delivery = self.draw(ping, number, packet, &mut |corruption| {
            Self::corrupt(layout, corruption, &mut bytes);
        });
        for _ in 0..delivery.copies {
            match delivery.until {
                Some(due) => self.held_packets.push((due, bytes.clone())),
                None => self.packets.push(&bytes),
            }
        }
    }
}

/// Number of copies and release time of a record.
struct Delivery {
    copies: u32,
    /// Release time of a delayed record.
    until: Option<UtcNs>,
}

enum Corruption {
    /// A changed byte; `mended` states whether the checksum is valid.
    Change {
        mended: bool,
    },
    Truncate,
}

impl OutputLink for FaultyLink {
    fn connection(&mut self) -> Connection {
        let ping = self.mark.now();
        let before = self.connected.filter(|(number, _)| *number == ping.number);
        match before {
            // One reset per ping.
            Some((_, Connection::Reset)) => Connection::Up,
            Some((_, connection)) => connection,
            None => {
                let connection = connection(&self.faults, ping, self.layout.name);
                self.connected = Some((ping.number, connection));
                connection
            }
        }
    }

    fn records<'a>(&'a mut self, records: &'a [Arc<Datagram>]) -> &'a [Arc<Datagram>] {
        if self.faults.scheduled() == 0 && self.held.is_empty() {
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
        if self.faults.scheduled() == 0 && self.held_packets.is_empty() {
            return;
        }
        let ping = self.mark.now();
        self.packets.clear();
        for (block, end_s) in packets.blocks() {
            for number in block {
                // A ping has far fewer than 2^32 packets.
                self.packet(ping, number as u32 + 1, packets.packet(number));
            }
            if let Some(end_s) = end_s {
                self.packets.end_block(end_s);
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

    const SHAPES: [(&str, RecordLayout); 7] = [
        ("7k", RecordLayout::SEVENK),
        ("jsf", RecordLayout::JSF),
        ("wbms", RecordLayout::WBMS),
        ("ping", RecordLayout::PING),
        ("872", RecordLayout::IMAGENEX872),
        ("vita49", RecordLayout::VITA49),
        ("elements", RecordLayout::ELEMENTS),
    ];

    /// Packets of ping `number`, filled with the ping and packet numbers.
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

    fn link(layout: RecordLayout, json: &str) -> (FaultyLink, Arc<Faults>) {
        let faults = Arc::new(super::super::testing::faults());
        faults.begin(UtcNs(0));
        let request: FaultRequest = serde_json::from_str(json).expect("JSON");
        faults.add(&request).expect("sound");
        let mark = Arc::new(LinkMark::default());
        (FaultyLink::new(faults.clone(), layout, mark), faults)
    }

    /// Sends twenty pings, 0.1 s apart. Returns ping number, packet number and integrity of each packet received, and the injection count.
    fn passed(layout: RecordLayout, json: &str) -> (Vec<(u8, u8, bool)>, usize) {
        let (mut link, faults) = link(layout, json);
        let mut came = Vec::new();
        for number in 1..=20 {
            *link.mark.0.lock().expect("whole") = PingMark {
                sonar: 0,
                number,
                utc: UtcNs(i64::from(number) * 100_000_000),
            };
            let mut sent = packets(number);
            link.packets(&mut sent);
            came.extend(sent.iter().map(|packet| {
                let (ping, k) = (packet[0], packet[1]);
                let whole = *packet == [ping, k, 0, 0].repeat(50)[..];
                (ping, k, whole)
            }));
        }
        (came, faults.take_injections().len())
    }

    #[test]
    fn packets_of_every_family_have_as_many_faults_as_the_log() {
        for (name, layout) in SHAPES {
            let all = |kind| {
                passed(
                    layout,
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
                let (came, corrupted) = all(kind);
                assert_eq!(
                    (came.len(), whole(&came)),
                    (100, 100 - corrupted),
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
        let (mut link, _) = link(RecordLayout::VITA49, r#"{"kind": "duplicate"}"#);
        let mut sent = packets(1);
        link.packets(&mut sent);
        let blocks: Vec<_> = sent.blocks().collect();
        assert_eq!(blocks, [(0..4, Some(0.5)), (4..10, None)]);
    }

    #[test]
    fn a_mended_record_passes_the_familys_checksum_and_a_corrupt_one_does_not() {
        let mut ping = vec![b'B', b'R', 90, 0, 1, 0, 0, 0];
        ping.extend((0..90).map(|k| k as u8));
        ping.extend([0, 0]);
        (RecordLayout::PING.update_checksum)(&mut ping);
        let ping_sum = |bytes: &[u8]| {
            let (body, sum) = bytes.split_last_chunk::<2>().expect("long");
            ping_protocol::checksum(body) == u16::from_le_bytes(*sum)
        };
        let mut packet = vec![7; 200];
        (RecordLayout::WBMS.update_checksum)(&mut packet);
        let crc = |bytes: &[u8]| {
            u32::from_le_bytes(bytes[20..24].try_into().expect("four")) == wbms::crc32(&bytes[24..])
        };
        let mut record = vec![9; 200];
        (RecordLayout::SEVENK.update_checksum)(&mut record);
        let sum = |bytes: &[u8]| {
            let (body, sum) = bytes.split_last_chunk::<4>().expect("long");
            sevenk::checksum(body) == u32::from_le_bytes(*sum)
        };
        for (layout, bytes, check) in [
            (
                RecordLayout::PING,
                &ping,
                &ping_sum as &dyn Fn(&[u8]) -> bool,
            ),
            (RecordLayout::WBMS, &packet, &crc),
            (RecordLayout::SEVENK, &record, &sum),
        ] {
            assert!(check(bytes));
            for mended in [false, true] {
                let mut corrupted = bytes.clone();
                layout.corrupt(&mut corrupted, mended);
                assert!(
                    corrupted != *bytes && check(&corrupted) == mended,
                    "{layout:?}"
                );
                assert_eq!(
                    corrupted[..layout.kept_bytes.min(20)],
                    bytes[..layout.kept_bytes.min(20)]
                );
            }
        }
    }

    #[test]
    fn records_of_any_length_can_be_corrupted_and_truncated() {
        for (_, layout) in SHAPES {
            for len in 0..200 {
                let mut bytes = vec![1; len];
                layout.corrupt(&mut bytes, true);
                assert!(layout.cut_bytes(len) <= len, "{len} {layout:?}");
            }
        }
    }
}
