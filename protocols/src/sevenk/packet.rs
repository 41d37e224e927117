//! Division of records into packets, and reassembly. Source: DFD 3.12, network frame.
//!
//! A record longer than the maximum packet is divided. All packets except the last have equal length, and only the first contains
//! the data record frame. The DFD permits 60 000 bytes per packet including the network frame. A widely used reader (MBARI's) does
//! not reassemble packets and needs [`Packetiser::whole_records`].
//!
//! [`Reassembler`] reassembles datagrams; [`StreamDecoder`](super::StreamDecoder) reads a TCP connection.

use std::iter::FusedIterator;
use std::ops::Range;

use super::frame::{
    DATA_RECORD_FRAME_BYTES, MIN_RECORD_BYTES, NETWORK_FRAME_BYTES, NetworkFrame, Record, u16_at,
    u32_at,
};
use super::{PROTOCOL_VERSION, WireError};

/// Maximum packet of the DFD including the network frame.
pub const DEFAULT_MAX_PACKET_BYTES: u32 = 60_000;
/// Minimum packet limit. A smaller limit would divide the data record frame.
pub const MIN_MAX_PACKET_BYTES: u32 = (NETWORK_FRAME_BYTES + DATA_RECORD_FRAME_BYTES) as u32;
/// Maximum payload of a UDP datagram over IPv4.
pub const MAX_DATAGRAM_BYTES: u32 = 65_507;

const DEVICE_ID_AT: usize = 36;
const SYSTEM_ENUMERATOR_AT: usize = 42;

/// The packet limit is below [`MIN_MAX_PACKET_BYTES`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error(
    "packets of at most {max_packet_bytes} bytes cannot hold both frames of 7k: the minimum is {MIN_MAX_PACKET_BYTES}"
)]
pub struct PacketLimitError {
    /// Limit requested.
    pub max_packet_bytes: u32,
}

/// Divider of records into packets. It numbers the transmissions.
#[derive(Debug, Clone)]
pub struct Packetiser {
    max_packet_bytes: u32,
    next_transmission_id: u16,
}

impl Default for Packetiser {
    fn default() -> Self {
        Self {
            max_packet_bytes: DEFAULT_MAX_PACKET_BYTES,
            next_transmission_id: 0,
        }
    }
}

impl Packetiser {
    /// `max_packet_bytes` includes the network frame. For datagrams it should not exceed [`MAX_DATAGRAM_BYTES`].
    pub fn new(max_packet_bytes: u32) -> Result<Self, PacketLimitError> {
        if max_packet_bytes < MIN_MAX_PACKET_BYTES {
            return Err(PacketLimitError { max_packet_bytes });
        }
        Ok(Self {
            max_packet_bytes,
            next_transmission_id: 0,
        })
    }

    /// Packetiser with one packet per record of any length, for TCP readers that do not reassemble.
    pub fn whole_records() -> Self {
        Self {
            max_packet_bytes: u32::MAX,
            next_transmission_id: 0,
        }
    }

    /// Appends the packets of one record and returns their ranges in `buf`. Send all of them over TCP, or each as a datagram over UDP.
    ///
    /// # Panics
    /// If `record` is shorter than 68 bytes, or its size with the network frame exceeds a u32.
    pub fn packetise(&mut self, record: &[u8], buf: &mut Vec<u8>) -> PacketRanges {
        assert!(
            record.len() >= MIN_RECORD_BYTES,
            "a record of {} bytes",
            record.len()
        );
        let longest_record = u32::MAX as usize - NETWORK_FRAME_BYTES;
        assert!(
            record.len() <= longest_record,
            "a record of {} bytes",
            record.len()
        );
        let fragment_bytes = self.max_packet_bytes as usize - NETWORK_FRAME_BYTES;
        let total_packets = record.len().div_ceil(fragment_bytes);
        let transmission_id = self.next_transmission_id;
        self.next_transmission_id = transmission_id.wrapping_add(1);
        let start = buf.len();
        buf.reserve(record.len() + total_packets * NETWORK_FRAME_BYTES);
        for (sequence_number, fragment) in record.chunks(fragment_bytes).enumerate() {
            let frame = NetworkFrame {
                protocol_version: PROTOCOL_VERSION,
                offset_bytes: NETWORK_FRAME_BYTES as u16,
                total_packets: total_packets as u32,
                total_records: 1,
                transmission_id,
                packet_size_bytes: (NETWORK_FRAME_BYTES + fragment.len()) as u32,
                total_size_bytes: record.len() as u32,
                sequence_number: sequence_number as u32,
                dest_device_id: 0,
                dest_enumerator: 0,
                source_enumerator: u16_at(record, SYSTEM_ENUMERATOR_AT).unwrap_or_default(),
                source_device_id: u32_at(record, DEVICE_ID_AT).unwrap_or_default(),
            };
            frame.emit(buf);
            buf.extend_from_slice(fragment);
        }
        PacketRanges {
            next: start,
            end: buf.len(),
            packet_bytes: self.max_packet_bytes as usize,
        }
    }
}

/// Byte ranges of the packets of one record in the buffer, in sending order.
#[derive(Debug, Clone)]
pub struct PacketRanges {
    next: usize,
    end: usize,
    packet_bytes: usize,
}

impl PacketRanges {
    /// Range of all packets, for a TCP connection.
    pub fn whole(&self) -> Range<usize> {
        self.next..self.end
    }
}

impl Iterator for PacketRanges {
    type Item = Range<usize>;

    fn next(&mut self) -> Option<Range<usize>> {
        if self.next == self.end {
            return None;
        }
        let packet = self.next..self.end.min(self.next.saturating_add(self.packet_bytes));
        self.next = packet.end;
        Some(packet)
    }

    fn size_hint(&self) -> (usize, Option<usize>) {
        let left = (self.end - self.next).div_ceil(self.packet_bytes);
        (left, Some(left))
    }
}

impl ExactSizeIterator for PacketRanges {}
impl FusedIterator for PacketRanges {}

// ------------------------------------------------------------------------------------------------------------------------- reassembly

/// Maximum number of incomplete records. A further record drops the oldest.
pub const PARTIAL_RECORDS: usize = 4;

/// Counters of a [`Reassembler`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct ReassemblyCounters {
    /// Whole records returned.
    pub records: u64,
    /// Packets refused, and complete records that were invalid.
    pub errors: u64,
    /// Packets that arrived before an earlier packet of their record. They are used.
    pub out_of_order_packets: u64,
    /// Packets received twice.
    pub duplicate_packets: u64,
    /// Records dropped with packets missing.
    pub abandoned_records: u64,
}

/// Reassembler of datagrams to records, for any order of packets. It holds at most [`PARTIAL_RECORDS`] incomplete records and one
/// complete record, each within the size limit.
#[derive(Debug)]
pub struct Reassembler {
    max_record_bytes: u32,
    /// Incomplete records, oldest first.
    partial: Vec<PartialRecord>,
    complete: Vec<u8>,
    counters: ReassemblyCounters,
}

#[derive(Debug)]
struct PartialRecord {
    /// Frame of the first packet received.
    frame: NetworkFrame,
    fragment_bytes: u32,
    bytes: Vec<u8>,
    received: Vec<bool>,
    missing: u32,
}

impl PartialRecord {
    /// True if a packet belongs to the same record.
    fn matches(&self, frame: &NetworkFrame, fragment_bytes: u32) -> bool {
        self.same_transmission(frame)
            && self.frame.total_size_bytes == frame.total_size_bytes
            && self.frame.total_packets == frame.total_packets
            && self.fragment_bytes == fragment_bytes
    }

    fn same_transmission(&self, frame: &NetworkFrame) -> bool {
        let key = |frame: &NetworkFrame| {
            (
                frame.transmission_id,
                frame.source_device_id,
                frame.source_enumerator,
            )
        };
        key(&self.frame) == key(frame)
    }
}

impl Reassembler {
    /// Reassembler that refuses records longer than `max_record_bytes`.
    pub fn new(max_record_bytes: u32) -> Self {
        Self {
            max_record_bytes,
            partial: Vec::new(),
            complete: Vec::new(),
            counters: ReassemblyCounters::default(),
        }
    }

    /// Counters so far.
    pub fn counters(&self) -> ReassemblyCounters {
        self.counters
    }

    /// Adds one datagram and returns the record if it is complete.
    pub fn push_datagram<'a>(
        &'a mut self,
        datagram: &'a [u8],
    ) -> Result<Option<Record<'a>>, WireError> {
        // Errors are counted here, which covers every error path. The borrow of the record ends before the counters change.
        let whole = match self.place(datagram) {
            Ok(Placed::Waiting) => return Ok(None),
            Ok(Placed::Alone) => &datagram[NETWORK_FRAME_BYTES..],
            Ok(Placed::Complete) => &self.complete[..],
            Err(error) => {
                self.counters.errors += 1;
                return Err(error);
            }
        };
        match Record::parse(whole) {
            Ok(record) => {
                self.counters.records += 1;
                Ok(Some(record))
            }
            Err(error) => {
                self.counters.errors += 1;
                Err(error)
            }
        }
    }

    fn place(&mut self, datagram: &[u8]) -> Result<Placed, WireError> {
        let frame = NetworkFrame::parse(datagram)?;
        frame.check(self.max_record_bytes)?;
        let fragment_bytes = frame.fragment_bytes()?;
        if frame.packet_size_bytes as usize != datagram.len() {
            return Err(WireError::truncated(
                "datagram",
                frame.packet_size_bytes,
                datagram.len(),
            ));
        }
        if frame.total_packets == 1 {
            return Ok(Placed::Alone);
        }
        let index = self.partial_of(&frame, fragment_bytes);
        let partial = &mut self.partial[index];
        let sequence = frame.sequence_number as usize;
        if partial.received[sequence] {
            self.counters.duplicate_packets += 1;
            return Ok(Placed::Waiting);
        }
        let has_later = partial.received[sequence..].contains(&true);
        self.counters.out_of_order_packets += u64::from(has_later);
        let data = &datagram[NETWORK_FRAME_BYTES..];
        let at = sequence * fragment_bytes as usize;
        partial.bytes[at..at + data.len()].copy_from_slice(data);
        partial.received[sequence] = true;
        partial.missing -= 1;
        if partial.missing > 0 {
            return Ok(Placed::Waiting);
        }
        self.complete = self.partial.remove(index).bytes;
        Ok(Placed::Complete)
    }

    /// Index of the incomplete record of a packet. The record is created if necessary.
    fn partial_of(&mut self, frame: &NetworkFrame, fragment_bytes: u32) -> usize {
        if let Some(index) = self
            .partial
            .iter()
            .position(|partial| partial.matches(frame, fragment_bytes))
        {
            return index;
        }
        // After a wrap of the counter, the same transmission number with other sizes is a new record. The old record is dropped.
        let stale = self
            .partial
            .iter()
            .position(|partial| partial.same_transmission(frame));
        if let Some(index) = stale.or_else(|| (self.partial.len() == PARTIAL_RECORDS).then_some(0))
        {
            self.partial.remove(index);
            self.counters.abandoned_records += 1;
        }
        self.partial.push(PartialRecord {
            frame: *frame,
            fragment_bytes,
            bytes: vec![0; frame.total_size_bytes as usize],
            received: vec![false; frame.total_packets as usize],
            missing: frame.total_packets,
        });
        self.partial.len() - 1
    }
}

enum Placed {
    Waiting,
    /// The datagram is the whole record.
    Alone,
    Complete,
}
