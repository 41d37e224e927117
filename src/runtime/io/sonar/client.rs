//! A small blocking 7k client over TCP: subscribes, requests records, sends commands and reassembles records.

use std::collections::VecDeque;
use std::io::{ErrorKind, Read, Write};
use std::net::{SocketAddr, TcpStream, ToSocketAddrs};
use std::time::{Duration, Instant};

use echotank_protocols::sevenk::control::{Ack7501, Nack7502};
use echotank_protocols::sevenk::stream::StreamCounters;
use echotank_protocols::sevenk::{
    Command, ControlRequest, DataRecordFrame, ErrorCode, Packetiser, Record, RecordStamp,
    SevenKTime, StreamDecoder, WireError, device_id,
};

use crate::clock::{Clock, SystemClock};

/// Longest record accepted, bytes.
const MAX_RECORD_BYTES: u32 = 256 << 20;
/// Time limit of a command's answer or a requested record.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(5);
const READ_BYTES: usize = 256 * 1024;

/// Errors of a client call.
#[derive(Debug, thiserror::Error)]
pub enum ClientError {
    /// The connection to the address failed.
    #[error(
        "cannot connect ({0}): is the daemon running, and does it print this address for the protocol?"
    )]
    Connect(std::io::Error),
    /// Reading or writing failed.
    #[error("connection failed: {0}")]
    Io(#[from] std::io::Error),
    /// The connection ended before the answer.
    #[error("the server closed the connection")]
    Closed,
    /// A refusal (NACK) in answer to a command.
    #[error("the server refused: {0}")]
    Refused(ErrorCode),
    /// No answer within the time allowed.
    #[error("no answer within {} s", ANSWER_TIMEOUT.as_secs())]
    NoAnswer,
}

/// A received record with a valid checksum, in its own buffer.
#[derive(Clone, Debug, PartialEq)]
pub struct OwnedRecord {
    /// The record's data record frame.
    pub frame: DataRecordFrame,
    bytes: Vec<u8>,
}

impl OwnedRecord {
    /// 7k record type.
    pub fn record_type(&self) -> u32 {
        self.frame.record_type_id
    }
    /// Frame, body and checksum, as in a file.
    pub fn bytes(&self) -> &[u8] {
        &self.bytes
    }
    /// Parses the record.
    pub fn record(&self) -> Result<Record<'_>, WireError> {
        Record::parse(&self.bytes)
    }
    /// Record type header and record data.
    pub fn body(&self) -> &[u8] {
        self.record().map_or(&[], |record| record.body())
    }
}

/// A client of one 7k server.
pub struct SevenKClient {
    stream: TcpStream,
    decoder: StreamDecoder,
    packetiser: Packetiser,
    ticket: u32,
    buffer: Vec<u8>,
    /// Records received while the client waited for an answer.
    waiting: VecDeque<OwnedRecord>,
}

impl SevenKClient {
    /// Connects over TCP.
    ///
    /// # Errors
    /// [`ClientError::Connect`] or [`ClientError::Io`].
    pub fn connect(address: impl ToSocketAddrs) -> Result<Self, ClientError> {
        let stream = TcpStream::connect(address).map_err(ClientError::Connect)?;
        stream.set_nodelay(true)?;
        Ok(Self {
            stream,
            decoder: StreamDecoder::new(MAX_RECORD_BYTES),
            packetiser: Packetiser::default(),
            ticket: 0,
            buffer: vec![0; READ_BYTES],
            waiting: VecDeque::new(),
        })
    }

    /// Address of the server.
    pub fn peer_addr(&self) -> Result<SocketAddr, ClientError> {
        Ok(self.stream.peer_addr()?)
    }
    /// Address of this end.
    pub fn local_addr(&self) -> Result<SocketAddr, ClientError> {
        Ok(self.stream.local_addr()?)
    }

    /// Counters of the decoder. On an undamaged connection only `records` is not zero.
    pub fn counters(&self) -> StreamCounters {
        self.decoder.counters()
    }

    /// Subscribes to further record types.
    pub fn subscribe(&mut self, record_types: &[u32]) -> Result<(), ClientError> {
        self.command(Command::Subscribe {
            record_type_ids: record_types.to_vec(),
        })
    }

    /// Requests one record and waits for it. A record of a ping arrives with the next ping.
    ///
    /// # Errors
    /// The connection fails, the server refuses, or no record arrives within 5 s.
    pub fn request(&mut self, record_type: u32) -> Result<OwnedRecord, ClientError> {
        self.command(Command::SingleRecord {
            record_type_id: record_type,
        })?;
        self.until(|record| (record.record_type() == record_type).then(|| record.clone()))
    }

    /// Sends a command and waits for the answer. Records that arrive first are kept for [`SevenKClient::next_record`].
    ///
    /// # Errors
    /// The connection fails, the server refuses, or no answer arrives within 5 s.
    pub fn command(&mut self, command: Command) -> Result<(), ClientError> {
        self.ticket = self.ticket.wrapping_add(1);
        let ticket = self.ticket;
        let request = ControlRequest {
            ticket,
            tracking_number: [0; 2],
            command,
        };
        let stamp = RecordStamp {
            time: SevenKTime::from_utc_ns_clamped(SystemClock::new().host_utc().0),
            device_id: device_id::SONAR_SOURCE,
            system_enumerator: 0,
        };
        let mut record = Vec::new();
        request.emit(&mut record, &stamp);
        let mut wire = Vec::new();
        self.packetiser.packetise(&record, &mut wire);
        self.stream.write_all(&wire)?;
        self.until(|record| answer(record, ticket))?
            .map_err(ClientError::Refused)
    }

    /// Returns the next record; `None` after `timeout`.
    pub fn next_record(&mut self, timeout: Duration) -> Result<Option<OwnedRecord>, ClientError> {
        if let Some(record) = self.waiting.pop_front() {
            return Ok(Some(record));
        }
        self.read_record(Instant::now() + timeout)
    }

    /// Reads until `pick` returns a value. The other records are kept.
    fn until<T>(
        &mut self,
        mut pick: impl FnMut(&OwnedRecord) -> Option<T>,
    ) -> Result<T, ClientError> {
        let deadline = Instant::now() + ANSWER_TIMEOUT;
        loop {
            let record = self.read_record(deadline)?.ok_or(ClientError::NoAnswer)?;
            match pick(&record) {
                Some(picked) => return Ok(picked),
                None => self.waiting.push_back(record),
            }
        }
    }

    fn read_record(&mut self, deadline: Instant) -> Result<Option<OwnedRecord>, ClientError> {
        loop {
            while let Some(item) = self.decoder.next_record() {
                // The decoder counts undecodable bytes.
                if let Ok(record) = item {
                    return Ok(Some(OwnedRecord {
                        frame: record.frame,
                        bytes: record.bytes().to_vec(),
                    }));
                }
            }
            let left = deadline.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return Ok(None);
            }
            self.stream.set_read_timeout(Some(left))?;
            let room = self.buffer.len();
            match self.stream.read(&mut self.buffer[..room]) {
                Ok(0) => return Err(ClientError::Closed),
                Ok(len) => {
                    let mut rest = &self.buffer[..len];
                    while !rest.is_empty() {
                        let taken = self.decoder.push(rest);
                        rest = &rest[taken..];
                        debug_assert!(taken > 0 || rest.is_empty());
                        if taken == 0 {
                            break; // the decoder is full, which does not happen with records within the limit
                        }
                    }
                }
                Err(error) => match error.kind() {
                    ErrorKind::WouldBlock | ErrorKind::TimedOut => return Ok(None),
                    ErrorKind::Interrupted => {}
                    _ => return Err(error.into()),
                },
            }
        }
    }
}

/// Answer to the command with this ticket, if the record is one.
fn answer(record: &OwnedRecord, ticket: u32) -> Option<Result<(), ErrorCode>> {
    match record.record_type() {
        Ack7501::RECORD_TYPE_ID => {
            let ack = Ack7501::parse(record.body()).ok()?;
            (ack.ticket == ticket).then_some(Ok(()))
        }
        Nack7502::RECORD_TYPE_ID => {
            let nack = Nack7502::parse(record.body()).ok()?;
            (nack.ticket == ticket).then_some(Err(nack.error))
        }
        _ => None,
    }
}
