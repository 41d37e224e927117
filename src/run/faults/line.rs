//! Faults of the line between an output and its clients: records are lost, doubled, held back or spoiled on their way.

use std::sync::Arc;

use echotank_protocols::sevenk::checksum;

use super::{Faults, PingMark};
use crate::config::spec::TransportFault;
use crate::flow::Datagram;
use crate::time::UtcNs;

/// The line of one output.
pub struct Line {
    faults: Arc<Faults>,
    ping: PingMark,
    /// Held back, with when they may go.
    held: Vec<(UtcNs, Arc<Datagram>)>,
    out: Vec<Arc<Datagram>>,
}

/// Bytes that a packetiser takes for a record at least.
const LEAST_BYTES: usize = 68;
/// Bytes at the start of a record that stay as they are: its frame, and a ping number in the body.
const KEPT_BYTES: usize = 80;
const CHECKSUM_BYTES: usize = 4;

impl Line {
    pub fn new(faults: Arc<Faults>) -> Self {
        Self {
            faults,
            ping: PingMark {
                sonar: 0,
                number: 0,
                utc: UtcNs(0),
            },
            held: Vec::new(),
            out: Vec::new(),
        }
    }

    /// The next records are of this ping.
    pub fn begin(&mut self, ping: PingMark) {
        self.ping = ping;
    }

    /// What comes out at the clients' end when `records` are sent.
    pub fn pass<'a>(&'a mut self, records: &'a [Arc<Datagram>]) -> &'a [Arc<Datagram>] {
        if self.faults.standing() == 0 && self.held.is_empty() {
            return records;
        }
        self.out.clear();
        for record in records {
            self.record(record);
        }
        let now = self.ping.utc;
        let out = &mut self.out;
        self.held.retain(|(due, record)| {
            let stays = *due > now;
            if !stays {
                out.push(record.clone());
            }
            stays
        });
        &self.out
    }

    fn record(&mut self, record: &Arc<Datagram>) {
        let ping = self.ping;
        let mut copies = 1;
        let mut until = None;
        let mut spoiled: Option<Datagram> = None;
        self.faults.record(ping, record.record_type, |fault| {
            let spoil = || (**record).clone();
            match fault {
                TransportFault::Drop | TransportFault::LinkDown => copies = 0,
                TransportFault::Duplicate => copies *= 2,
                // Until the next ping's delivery, which is later.
                TransportFault::Reorder => until = Some(ping.utc.plus_ns(1)),
                TransportFault::Delay { s } => until = Some(ping.utc.plus_s(s)),
                TransportFault::Corrupt { mended } => {
                    corrupt(&mut spoiled.get_or_insert_with(spoil).bytes, mended);
                }
                TransportFault::Truncate => {
                    let bytes = &mut spoiled.get_or_insert_with(spoil).bytes;
                    let half = KEPT_BYTES.max(bytes.len() / 2);
                    bytes.truncate(half.min(bytes.len() - 1).max(LEAST_BYTES));
                }
            }
        });
        let record = match spoiled {
            Some(spoiled) => Arc::new(spoiled),
            None => record.clone(),
        };
        for _ in 0..copies {
            match until {
                Some(due) => self.held.push((due, record.clone())),
                None => self.out.push(record.clone()),
            }
        }
    }
}

/// Changes a byte of the body.
fn corrupt(bytes: &mut [u8], mended: bool) {
    let end = bytes.len().saturating_sub(CHECKSUM_BYTES);
    // Records too short for a body beyond the ping number lose their last byte before the checksum.
    let at = if end > KEPT_BYTES {
        (KEPT_BYTES + end) / 2
    } else {
        end.saturating_sub(1)
    };
    let Some(byte) = bytes.get_mut(at) else {
        return;
    };
    *byte ^= 0x55;
    if mended {
        let sum = checksum(&bytes[..end]);
        bytes[end..].copy_from_slice(&sum.to_le_bytes());
    }
}
