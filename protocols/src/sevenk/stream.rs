//! The bytes of a TCP connection to records, with resynchronisation. Source: DFD 3.12, network frame.
//!
//! A record is believed only when all of it is there and right: every network frame of it, the data record frame, the checksum. Until then
//! no byte of it is given up; when something is wrong, the search for the next frame starts one byte further. A record behind a damaged
//! one is therefore found even when the damaged one claims to be longer than it is.
//!
//! The packets of one record are taken to follow each other, as TCP keeps them. Memory stays below [`StreamDecoder::capacity_bytes`].
//! A peer that sends nothing but forged frames can make each one cost a checksum over the record it claims: the record limit bounds that.

use std::ops::Range;

use super::frame::{
    DATA_RECORD_FRAME_BYTES, DataRecordFrame, NETWORK_FRAME_BYTES, NetworkFrame, Record, u16_at,
};
use super::{PROTOCOL_VERSION, WireError};

/// Record limit for a server: commands are short.
pub const DEFAULT_MAX_COMMAND_BYTES: u32 = 1 << 20;

/// Room beyond the longest record, so that reading one never hands bytes back in driblets.
const SLACK_BYTES: usize = 4096;

/// What a [`StreamDecoder`] has seen. Errors are counted once where they are met, not for every byte of rubbish behind them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct StreamCounters {
    /// Whole, right records.
    pub records: u64,
    /// Bytes that belonged to no record.
    pub skipped_bytes: u64,
    /// Times that a record was found again after an error.
    pub resyncs: u64,
    pub network_version_errors: u64,
    pub network_offset_errors: u64,
    pub oversized_errors: u64,
    pub packet_size_errors: u64,
    pub fragment_sequence_errors: u64,
    pub sync_pattern_errors: u64,
    pub checksum_errors: u64,
    pub truncated_errors: u64,
    /// Data record frames otherwise wrong: version, offset, size, optional data.
    pub data_frame_errors: u64,
}

impl StreamCounters {
    /// All errors.
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

/// Reads records from a byte stream. Push bytes, pull records until there is none; [`StreamDecoder::feed`] does both.
#[derive(Debug)]
pub struct StreamDecoder {
    max_record_bytes: u32,
    buf: Vec<u8>,
    /// Bytes of `buf` that are done with.
    head: usize,
    /// After an error: what does not look like a frame is passed over in silence.
    searching: bool,
    /// Nothing will come to complete what is held.
    ended: bool,
    /// The record last put together from several packets.
    joined: Vec<u8>,
    counters: StreamCounters,
}

impl Default for StreamDecoder {
    fn default() -> Self {
        Self::new(DEFAULT_MAX_COMMAND_BYTES)
    }
}

/// What stands at the head of the stream.
enum Look {
    /// More bytes are needed. `believable`: what is there passed every check so far, so that its end is worth a word.
    Wait { need_bytes: u64, believable: bool },
    /// Not a record. `believable`: it looked like one from its headers.
    Bad { error: WireError, believable: bool },
    /// A record of as many bytes on the wire; joined if it came in several packets.
    Good {
        wire_bytes: usize,
        frame: DataRecordFrame,
        body_end: usize,
        is_joined: bool,
    },
}

/// Where a record that was found lies.
struct Found {
    /// In `buf`; none if it lies in `joined`.
    range: Option<Range<usize>>,
    frame: DataRecordFrame,
    body_end: usize,
}

impl StreamDecoder {
    /// Records longer than `max_record_bytes` are refused from their header.
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

    pub fn counters(&self) -> StreamCounters {
        self.counters
    }

    /// The most bytes held: the longest record, cut into the shortest packets, and some slack.
    pub fn capacity_bytes(&self) -> usize {
        let packets = self.max_record_bytes as usize / DATA_RECORD_FRAME_BYTES + 1;
        self.max_record_bytes as usize + packets * NETWORK_FRAME_BYTES + SLACK_BYTES
    }

    /// Bytes that wait for the rest of their record.
    pub fn held_bytes(&self) -> usize {
        self.buf.len() - self.head
    }

    /// Right after [`StreamDecoder::next_record`] returned an error: the bytes held, from the one on that was no start of a record. From
    /// a refused command's frame a server learns what to answer to.
    pub fn refused_bytes(&self) -> &[u8] {
        &self.buf[self.head.saturating_sub(1)..]
    }

    /// Takes bytes, as many as there is room for, and returns how many. After [`StreamDecoder::next_record`] returned `None` there is room
    /// for at least one.
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

    /// Says that what is held will not be continued: the peer closed, or stalled for too long. An unfinished record becomes an error, and
    /// records that it hid come to light by further calls of [`StreamDecoder::next_record`]. Pushing again afterwards is allowed.
    pub fn finish(&mut self) {
        self.ended = true;
    }

    /// The next record or error; `None` when more bytes are needed.
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

    /// Takes all of `bytes` and hands every record and error on as it is met.
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
            let (error, believable) = match self.look() {
                Look::Good {
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
                Look::Wait { .. } if !self.ended => return None,
                Look::Wait {
                    need_bytes,
                    believable,
                } => {
                    let got_bytes = (self.buf.len() - self.head) as u64;
                    (
                        WireError::Truncated {
                            what: "record on the stream",
                            need_bytes,
                            got_bytes,
                        },
                        believable,
                    )
                }
                Look::Bad { error, believable } => (error, believable),
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

    fn look(&mut self) -> Look {
        let held = &self.buf[self.head..];
        let first = match self.look_at_headers(held) {
            Ok(frame) => frame,
            Err(look) => return look,
        };
        // From here on it looks like a record.
        let bad = |error| Look::Bad {
            error,
            believable: true,
        };
        let wait = |need_bytes| Look::Wait {
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
            // `check` saw to it that every packet but the last is as long as the first.
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
            Ok((frame, body_end)) => Look::Good {
                wire_bytes,
                frame,
                body_end,
                is_joined,
            },
            Err(error) => bad(error),
        }
    }

    /// Judges the first network frame and the data record frame behind it, as early as their bytes allow.
    fn look_at_headers(&self, held: &[u8]) -> Result<NetworkFrame, Look> {
        let bad = |error| Look::Bad {
            error,
            believable: false,
        };
        let wait = |need: usize, believable| Look::Wait {
            need_bytes: need as u64,
            believable,
        };
        // A peer that does not speak 7k is told so by its first bytes, not when it has sent 36.
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
