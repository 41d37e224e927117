//! The datagrams of one ping, one after the other, and when they are due where they leave as they arise.

/// Buffers are used again.
#[derive(Debug, Default)]
pub struct Packets {
    bytes: Vec<u8>,
    ends: Vec<usize>,
    blocks: Vec<Block>,
}

/// Datagrams that leave together.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Block {
    /// The number of the last one's successor.
    end: usize,
    /// When the last of their samples has been heard, seconds after the start of the pulse.
    heard_s: f64,
}

impl Packets {
    pub fn clear(&mut self) {
        self.bytes.clear();
        self.ends.clear();
        self.blocks.clear();
    }

    pub fn push(&mut self, packet: &[u8]) {
        self.bytes.extend_from_slice(packet);
        self.ends.push(self.bytes.len());
    }

    /// What was pushed since the last block, or the start, is one whose last sample is heard so long after the start of the pulse.
    pub fn end_block(&mut self, heard_s: f64) {
        let end = self.ends.len();
        self.blocks.push(Block { end, heard_s });
    }

    pub fn len(&self) -> usize {
        self.ends.len()
    }

    pub fn is_empty(&self) -> bool {
        self.ends.is_empty()
    }

    pub fn len_bytes(&self) -> usize {
        self.bytes.len()
    }

    pub fn packet(&self, number: usize) -> &[u8] {
        let start = number.checked_sub(1).map_or(0, |before| self.ends[before]);
        &self.bytes[start..self.ends[number]]
    }

    pub fn iter(&self) -> impl Iterator<Item = &[u8]> {
        (0..self.len()).map(|number| self.packet(number))
    }

    /// The blocks in order: the numbers of their packets, and when their last sample was heard. What no block was made of is one without a
    /// time, at the end.
    pub fn blocks(&self) -> impl Iterator<Item = (std::ops::Range<usize>, Option<f64>)> {
        let ended = self
            .blocks
            .iter()
            .map(|block| (block.end, Some(block.heard_s)));
        let rest = (self.len(), None);
        let mut start = 0;
        ended.chain([rest]).filter_map(move |(end, heard_s)| {
            let range = start..end;
            start = end;
            (!range.is_empty()).then_some((range, heard_s))
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
            if let Some(heard_s) = end {
                packets.end_block(heard_s);
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
