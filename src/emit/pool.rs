//! Pools of record buffers. A buffer is reused after all clients and recorders have dropped it.

use std::sync::Arc;

use echotank_core::records::Datagram;

/// Pool of at most `capacity` buffers for one record type. If all buffers are in use, a record gets a new buffer, and `misses`
/// counts it.
#[derive(Debug)]
pub struct DatagramPool {
    record_type: u32,
    capacity: usize,
    slots: Vec<Arc<Datagram>>,
    misses: u64,
}

impl DatagramPool {
    /// `capacity` is the number of records that may wait in queues at the same time.
    pub fn new(record_type: u32, capacity: usize) -> Self {
        Self {
            record_type,
            capacity,
            slots: Vec::with_capacity(capacity),
            misses: 0,
        }
    }

    /// Returns a record whose bytes `fill` writes into an empty buffer. The result of `fill` is not used.
    pub fn write<R>(&mut self, fill: impl FnOnce(&mut Vec<u8>) -> R) -> Arc<Datagram> {
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

    /// Number of records for which all buffers were in use.
    pub fn misses(&self) -> u64 {
        self.misses
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_buffer_is_reused_when_all_references_are_dropped() {
        let mut pool = DatagramPool::new(7038, 2);
        let first = pool.write(|bytes| bytes.extend_from_slice(&[1; 1000]));
        let place = first.bytes.as_ptr();
        let second = pool.write(|bytes| bytes.push(2));
        assert_ne!(place, second.bytes.as_ptr(), "the first is still in use");
        drop(first);
        let third = pool.write(|bytes| bytes.push(3));
        assert_eq!((place, &third.bytes[..]), (third.bytes.as_ptr(), &[3][..]));
        assert_eq!(pool.misses(), 0);
        let fourth = pool.write(|bytes| bytes.push(4));
        assert_eq!((pool.misses(), &fourth.bytes[..]), (1, &[4][..]));
        assert_eq!((&second.bytes[..], &third.bytes[..]), (&[2][..], &[3][..]));
    }
}
