//! Buffers that begin with a cache line. Vectors of 16 numbers that straddle two lines take twice the time to load and to store.

/// Numbers of a cache line.
const LINE: usize = 16;

/// Numbers of which the first begins a cache line.
#[derive(Default)]
pub(super) struct Aligned {
    numbers: Vec<f32>,
    /// Index of the first number.
    first: usize,
}

impl Aligned {
    pub(super) fn len(&self) -> usize {
        self.numbers.len() - self.first
    }

    /// Removes all numbers and keeps the room.
    pub(super) fn clear(&mut self) {
        self.numbers.clear();
        self.first = 0;
    }

    /// Makes room for `len` numbers.
    pub(super) fn reserve(&mut self, len: usize) {
        let more = (len + LINE).saturating_sub(self.numbers.len());
        self.numbers.reserve_exact(more);
    }

    /// Sets the number of zeros. Every number must be zero, or there must be none.
    pub(super) fn resize_zeros(&mut self, len: usize) {
        self.reserve(len);
        // `align_offset` may find none; the buffer then works, slower.
        self.first = self.numbers.as_ptr().align_offset(4 * LINE).min(LINE);
        self.numbers.resize(self.first + len, 0.0);
    }

    pub(super) fn numbers(&self) -> &[f32] {
        &self.numbers[self.first..]
    }

    pub(super) fn numbers_mut(&mut self) -> &mut [f32] {
        &mut self.numbers[self.first..]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn buffers_begin_with_a_cache_line_and_keep_their_room() {
        for len in [1, 15, 16, 100, 5000] {
            let mut buffer = Aligned::default();
            assert!(buffer.numbers().is_empty());
            buffer.resize_zeros(len);
            assert_eq!(buffer.numbers().as_ptr().align_offset(64), 0);
            assert_eq!(buffer.numbers(), vec![0.0; len]);
            buffer.numbers_mut().fill(1.0);
            let at = buffer.numbers().as_ptr();
            buffer.clear();
            assert!(buffer.numbers().is_empty());
            buffer.resize_zeros(len);
            assert_eq!(buffer.numbers(), vec![0.0; len]);
            assert_eq!(buffer.numbers().as_ptr(), at);
        }
    }
}
