//! Buffers for records, used again once every client and recorder has let go of them.

use std::sync::Arc;

use echotank_core::flow::Datagram;

/// Buffers of one record type, at most `capacity`: as many as may wait in the queues. Beyond that a record gets a buffer of its own, and
/// `misses` counts it.
#[derive(Debug)]
pub struct DatagramPool {
    record_type: u32,
    capacity: usize,
    slots: Vec<Arc<Datagram>>,
    misses: u64,
}

impl DatagramPool {
    pub fn new(record_type: u32, capacity: usize) -> Self {
        Self {
            record_type,
            capacity,
            slots: Vec::with_capacity(capacity),
            misses: 0,
        }
    }

    /// A record written by `fill` into an empty buffer.
    pub fn write(&mut self, fill: impl FnOnce(&mut Vec<u8>)) -> Arc<Datagram> {
        if let Some(slot) = self
            .slots
            .iter_mut()
            .find(|slot| Arc::strong_count(slot) == 1)
            && let Some(datagram) = Arc::get_mut(slot)
        {
            datagram.bytes.clear();
            fill(&mut datagram.bytes);
            return Arc::clone(slot);
        }
        let mut datagram = Datagram {
            record_type: self.record_type,
            bytes: Vec::new(),
        };
        fill(&mut datagram.bytes);
        let datagram = Arc::new(datagram);
        if self.slots.len() < self.capacity {
            self.slots.push(Arc::clone(&datagram));
        } else {
            self.misses += 1;
        }
        datagram
    }

    /// Records that found every buffer in use.
    pub fn misses(&self) -> u64 {
        self.misses
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_buffer_comes_back_when_everybody_has_let_go_of_it() {
        let mut pool = DatagramPool::new(7038, 2);
        let first = pool.write(|bytes| bytes.extend_from_slice(&[1; 1000]));
        let place = first.bytes.as_ptr();
        let second = pool.write(|bytes| bytes.push(2));
        assert_ne!(place, second.bytes.as_ptr(), "the first is still held");
        drop(first);
        let third = pool.write(|bytes| bytes.push(3));
        assert_eq!((place, &third.bytes[..]), (third.bytes.as_ptr(), &[3][..]));
        assert_eq!(pool.misses(), 0);
        let fourth = pool.write(|bytes| bytes.push(4));
        assert_eq!((pool.misses(), &fourth.bytes[..]), (1, &[4][..]));
        assert_eq!((&second.bytes[..], &third.bytes[..]), (&[2][..], &[3][..]));
    }
}
