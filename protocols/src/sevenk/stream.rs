//! Decoder of the bytes of a TCP connection to records, with resynchronisation. Source: DFD 3.12, network frame.
//!
//! A record is accepted only when it is complete and valid: all network frames, the data record frame, and the checksum. Its bytes
//! are kept until then. After an error, the search for the next frame starts one byte later. A record after a damaged one is
//! therefore found, even if the damaged record states an excessive length.
//!
//! The packets of one record must be consecutive, because TCP preserves their order. Memory stays below
//! [`StreamDecoder::capacity_bytes`]. A peer that sends only forged frames can cause a checksum calculation for each; the record
//! limit bounds its cost.

use std::ops::Range;

use super::frame::{
    DATA_RECORD_FRAME_BYTES, DataRecordFrame, NETWORK_FRAME_BYTES, NetworkFrame, Record, u16_at,
};
use super::{PROTOCOL_VERSION, WireError};

/// Maximum record size for a server. Commands are short.
pub const DEFAULT_MAX_COMMAND_BYTES: u32 = 1 << 20;

/// Buffer space beyond the longest record, so that `push` accepts large pieces.
const SLACK_BYTES: usize = 4096;

/// Counters of a [`StreamDecoder`]. Each error is counted once, not for every invalid byte after it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct StreamCounters {
    /// Complete, valid records.
    pub records: u64,
    /// Bytes outside any record.
    pub skipped_bytes: u64,
    /// Number of times that a record was found after an error.
    pub resyncs: u64,
    /// Network frames with the wrong version.
    pub network_version_errors: u64,
    /// Network frames with the wrong offset.
    pub network_offset_errors: u64,
    /// Records beyond the size limit.
    pub oversized_errors: u64,
    /// Network frames with inconsistent sizes.
    pub packet_size_errors: u64,
    /// Packets out of order.
    pub fragment_sequence_errors: u64,
    /// Records with a wrong sync pattern.
    pub sync_pattern_errors: u64,
    /// Records with a wrong checksum.
    pub checksum_errors: u64,
    /// Records that ended early.
    pub truncated_errors: u64,
    /// Data record frames with another error: version, offset, size, optional data.
    pub data_frame_errors: u64,
}

impl StreamCounters {
    /// Sum of all errors.
    pub fn errors(&self) -> u64 {
        self.network_version_errors
            + self.network_offset_errors
            + self.oversized_errors
            + self.packet_size_errors
            + self.fragment_sequence_errors
            + self.sync_pattern_errors
            + self.checksum_errors
            + self.truncated_errors
            + self.data_frame_errors
    }

    fn count(&mut self, error: &WireError) {
        let counter = match error {
            WireError::NetworkVersion { .. } => &mut self.network_version_errors,
            WireError::NetworkOffset { .. } => &mut self.network_offset_errors,
            WireError::Oversized { .. } => &mut self.oversized_errors,
            WireError::PacketSizes { .. } => &mut self.packet_size_errors,
            WireError::FragmentSequence { .. } => &mut self.fragment_sequence_errors,
            WireError::SyncPattern { .. } => &mut self.sync_pattern_errors,
            WireError::Checksum { .. } => &mut self.checksum_errors,
            WireError::Truncated { .. } => &mut self.truncated_errors,
            WireError::DataVersion { .. }
            | WireError::RecordOffset { .. }
            | WireError::RecordSize { .. }
            | WireError::OptionalData { .. }
            | WireError::Unsupported { .. } => &mut self.data_frame_errors,
        };
        *counter += 1;
    }
}

/// Decoder of records from a byte stream. Push bytes, then read records until there is none; [`StreamDecoder::feed`] does both.
#[derive(Debug)]
pub struct StreamDecoder {
    max_record_bytes: u32,
    buf: Vec<u8>,
    /// Number of processed bytes at the front of `buf`.
    head: usize,
    /// True after an error. Bytes that are not a frame are skipped without another error.
    searching: bool,
    /// True if no further bytes complete the stored data.
    ended: bool,
    /// Last record reassembled from several packets.
    joined: Vec<u8>,
    counters: StreamCounters,
}

impl Default for StreamDecoder {
    fn default() -> Self {
        Self::new(DEFAULT_MAX_COMMAND_BYTES)
    }
}

/// Result of examining the front of the stream.
enum Scan {
    /// More bytes are needed. `believable` is true if the bytes so far passed every check, so that an early end is an error.
    Wait { need_bytes: u64, believable: bool },
    /// The bytes are not a record. `believable` is true if the headers are valid.
    Bad { error: WireError, believable: bool },
    /// Complete record with its size in the stream, reassembled from its packets.
    Good {
        wire_bytes: usize,
        frame: DataRecordFrame,
        body_end: usize,
        is_joined: bool,
    },
}

/// Location of a complete record.
struct Found {
    /// Range in `buf`; `None` if the record is in `joined`.
    range: Option<Range<usize>>,
    frame: DataRecordFrame,
    body_end: usize,
}

impl StreamDecoder {
    /// Decoder that refuses records longer than `max_record_bytes` by their header.
    pub fn new(max_record_bytes: u32) -> Self {
        Self {
            max_record_bytes,
            buf: Vec::new(),
            head: 0,
            searching: false,
            ended: false,
            joined: Vec::new(),
            counters: StreamCounters::default(),
        }
    }

    /// Counters so far.
    pub fn counters(&self) -> StreamCounters {
        self.counters
    }

    /// Maximum number of bytes held: the longest record in the shortest packets, plus reserve.
    pub fn capacity_bytes(&self) -> usize {
        let packets = self.max_record_bytes as usize / DATA_RECORD_FRAME_BYTES + 1;
        self.max_record_bytes as usize + packets * NETWORK_FRAME_BYTES + SLACK_BYTES
    }

    /// Number of bytes of an incomplete record.
    pub fn held_bytes(&self) -> usize {
        self.buf.len() - self.head
    }

    /// Bytes from the invalid record on, directly after [`StreamDecoder::next_record`] returned an error. A server reads the ticket
    /// of its refusal from these bytes.
    pub fn refused_bytes(&self) -> &[u8] {
        &self.buf[self.head.saturating_sub(1)..]
    }

    /// Copies bytes while there is room and returns their number. The number is at least one after [`StreamDecoder::next_record`]
    /// returned `None`.
    pub fn push(&mut self, bytes: &[u8]) -> usize {
        if bytes.is_empty() {
            return 0;
        }
        self.ended = false;
        self.buf.drain(..self.head);
        self.head = 0;
        let taken = bytes.len().min(self.capacity_bytes() - self.buf.len());
        self.buf.extend_from_slice(&bytes[..taken]);
        taken
    }

    /// Marks the end of the input, because the peer closed or stalled. An incomplete record becomes an error. Further calls of
    /// [`StreamDecoder::next_record`] return the records after its first byte. More bytes may be pushed afterwards.
    pub fn finish(&mut self) {
        self.ended = true;
    }

    /// Returns the next record or error; `None` if more bytes are needed.
    pub fn next_record(&mut self) -> Option<Result<Record<'_>, WireError>> {
        match self.advance()? {
            Ok(Found {
                range,
                frame,
                body_end,
            }) => {
                let bytes = match range {
                    Some(range) => &self.buf[range],
                    None => &self.joined[..],
                };
                Some(Ok(Record::from_checked(frame, bytes, body_end)))
            }
            Err(error) => Some(Err(error)),
        }
    }

    /// Decodes all of `bytes` and passes every record and error to `each`.
    pub fn feed(&mut self, mut bytes: &[u8], mut each: impl FnMut(Result<Record<'_>, WireError>)) {
        loop {
            while let Some(item) = self.next_record() {
                each(item);
            }
            if bytes.is_empty() {
                return;
            }
            let taken = self.push(bytes);
            bytes = &bytes[taken..];
        }
    }

    fn advance(&mut self) -> Option<Result<Found, WireError>> {
        loop {
            if self.head == self.buf.len() {
                return None;
            }
            let (error, believable) = match self.scan() {
                Scan::Good {
                    wire_bytes,
                    frame,
                    body_end,
                    is_joined,
                } => {
                    let start = self.head;
                    self.head += wire_bytes;
                    self.counters.records += 1;
                    self.counters.resyncs += u64::from(self.searching);
                    self.searching = false;
                    let range =
                        (!is_joined).then_some(start + NETWORK_FRAME_BYTES..start + wire_bytes);
                    return Some(Ok(Found {
                        range,
                        frame,
                        body_end,
                    }));
                }
                Scan::Wait { .. } if !self.ended => return None,
                Scan::Wait {
                    need_bytes,
                    believable,
                } => {
                    let got_bytes = self.buf.len() - self.head;
                    (
                        WireError::truncated("record on the stream", need_bytes, got_bytes),
                        believable,
                    )
                }
                Scan::Bad { error, believable } => (error, believable),
            };
            self.head += 1;
            self.counters.skipped_bytes += 1;
            let is_news = believable || !self.searching;
            self.searching = true;
            if is_news {
                self.counters.count(&error);
                return Some(Err(error));
            }
        }
    }

    fn scan(&mut self) -> Scan {
        let held = &self.buf[self.head..];
        let first = match self.scan_headers(held) {
            Ok(frame) => frame,
            Err(look) => return look,
        };
        // From this point, the bytes are likely a record.
        let bad = |error| Scan::Bad {
            error,
            believable: true,
        };
        let wait = |need_bytes| Scan::Wait {
            need_bytes,
            believable: true,
        };
        let mut at = 0_u64;
        for expected in 0..first.total_packets {
            let need = at + NETWORK_FRAME_BYTES as u64;
            if (held.len() as u64) < need {
                return wait(need);
            }
            let frame = match NetworkFrame::parse(&held[at as usize..])
                .and_then(|frame| frame.check(self.max_record_bytes).map(|()| frame))
            {
                Ok(frame) => frame,
                Err(error) => return bad(error),
            };
            let is_next = frame.transmission_id == first.transmission_id
                && frame.total_size_bytes == first.total_size_bytes
                && frame.total_packets == first.total_packets
                && frame.fragment_bytes() == first.fragment_bytes()
                && frame.sequence_number == expected;
            if !is_next {
                return bad(WireError::FragmentSequence {
                    expected,
                    got: frame.sequence_number,
                });
            }
            at += u64::from(frame.packet_size_bytes);
            if (held.len() as u64) < at {
                return wait(at);
            }
        }
        let wire_bytes = at as usize;
        let is_joined = first.total_packets > 1;
        if is_joined {
            self.joined.clear();
            // `check` ensures that every packet except the last is as long as the first.
            for packet in held[..wire_bytes].chunks(first.packet_size_bytes as usize) {
                self.joined
                    .extend_from_slice(&packet[NETWORK_FRAME_BYTES..]);
            }
        }
        let record = if is_joined {
            &self.joined[..]
        } else {
            &held[NETWORK_FRAME_BYTES..wire_bytes]
        };
        match Record::dissect(record) {
            Ok((frame, body_end)) => Scan::Good {
                wire_bytes,
                frame,
                body_end,
                is_joined,
            },
            Err(error) => bad(error),
        }
    }

    /// Validates the first network frame and the data record frame as soon as their bytes are available.
    fn scan_headers(&self, held: &[u8]) -> Result<NetworkFrame, Scan> {
        let bad = |error| Scan::Bad {
            error,
            believable: false,
        };
        let wait = |need: usize, believable| Scan::Wait {
            need_bytes: need as u64,
            believable,
        };
        // The version is checked from the first bytes, so a peer with another protocol is refused before 36 bytes.
        if let Some(got) = u16_at(held, 0).filter(|&got| got != PROTOCOL_VERSION) {
            return Err(bad(WireError::NetworkVersion { got }));
        }
        if let Some(got) = u16_at(held, 2).filter(|&got| usize::from(got) != NETWORK_FRAME_BYTES) {
            return Err(bad(WireError::NetworkOffset { got }));
        }
        let Ok(frame) = NetworkFrame::parse(held) else {
            return Err(wait(NETWORK_FRAME_BYTES, false));
        };
        frame.check(self.max_record_bytes).map_err(bad)?;
        if frame.sequence_number != 0 {
            return Err(bad(WireError::FragmentSequence {
                expected: 0,
                got: frame.sequence_number,
            }));
        }
        let Ok(data_frame) = DataRecordFrame::parse(&held[NETWORK_FRAME_BYTES..]) else {
            return Err(wait(NETWORK_FRAME_BYTES + DATA_RECORD_FRAME_BYTES, true));
        };
        data_frame.check().map_err(bad)?;
        if data_frame.size_bytes != frame.total_size_bytes {
            let got_bytes = u64::from(frame.total_size_bytes);
            return Err(bad(WireError::RecordSize {
                stated_bytes: data_frame.size_bytes,
                got_bytes,
            }));
        }
        Ok(frame)
    }
}
