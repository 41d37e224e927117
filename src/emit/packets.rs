//! Holds the datagrams of one ping in order, with the time at which each block of them may be sent.

/// Datagrams of one ping, stored in reusable buffers.
#[derive(Debug, Default)]
pub struct Packets {
    bytes: Vec<u8>,
    ends: Vec<usize>,
    blocks: Vec<Block>,
}

/// Datagrams that are sent together.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Block {
    /// Index after the last datagram of the block.
    end: usize,
    /// Time at which the last sample of the block is received, seconds after the start of the pulse.
    received_s: f64,
}

impl Packets {
    /// Removes all datagrams and blocks, and keeps the buffers.
    pub fn clear(&mut self) {
        self.bytes.clear();
        self.ends.clear();
        self.blocks.clear();
    }

    /// Appends a copy of `packet` as one datagram.
    pub fn push(&mut self, packet: &[u8]) {
        self.bytes.extend_from_slice(packet);
        self.ends.push(self.bytes.len());
    }

    /// Ends a block: it holds the datagrams pushed since the previous block. `received_s` is the time of its last sample, seconds after the
    /// start of the pulse.
    pub fn end_block(&mut self, received_s: f64) {
        let end = self.ends.len();
        self.blocks.push(Block { end, received_s });
    }

    /// Number of datagrams.
    pub fn len(&self) -> usize {
        self.ends.len()
    }

    /// True if there is no datagram.
    pub fn is_empty(&self) -> bool {
        self.ends.is_empty()
    }

    /// Total size of all datagrams, bytes.
    pub fn len_bytes(&self) -> usize {
        self.bytes.len()
    }

    /// The datagram with index `number`, counted from 0. Panics if there is none.
    pub fn packet(&self, number: usize) -> &[u8] {
        let start = number.checked_sub(1).map_or(0, |before| self.ends[before]);
        &self.bytes[start..self.ends[number]]
    }

    /// Iterates over the datagrams in order.
    pub fn iter(&self) -> impl Iterator<Item = &[u8]> {
        (0..self.len()).map(|number| self.packet(number))
    }

    /// Iterates over the blocks in order: the indices of their datagrams and the reception time of their last sample. Datagrams outside any
    /// block form a last block without a time.
    pub fn blocks(&self) -> impl Iterator<Item = (std::ops::Range<usize>, Option<f64>)> {
        let ended = self
            .blocks
            .iter()
            .map(|block| (block.end, Some(block.received_s)));
        let rest = (self.len(), None);
        let mut start = 0;
        ended.chain([rest]).filter_map(move |(end, received_s)| {
            let range = start..end;
            start = end;
            (!range.is_empty()).then_some((range, received_s))
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn blocks_hold_every_packet_once_and_in_order() {
        let mut packets = Packets::default();
        for (packet, end) in [
            ("a", None),
            ("bc", Some(1e-3)),
            ("", Some(2e-3)),
            ("d", None),
        ] {
            packets.push(packet.as_bytes());
            if let Some(received_s) = end {
                packets.end_block(received_s);
            }
        }
        let all: Vec<_> = packets.iter().collect();
        assert_eq!(all, [&b"a"[..], b"bc", b"", b"d"]);
        let blocks: Vec<_> = packets.blocks().collect();
        assert_eq!(
            blocks,
            [(0..2, Some(1e-3)), (2..3, Some(2e-3)), (3..4, None)]
        );
        packets.clear();
        assert_eq!(packets.blocks().count(), 0);
    }
}
