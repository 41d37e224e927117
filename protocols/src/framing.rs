//! Division of the bytes of a connection or file into messages, for formats with a length near the front of a message.
//!
//! The largest permitted message limits the memory. Bytes that do not start a message are skipped one by one. Each gap gives one
//! error and increases a counter.

use crate::WireError;

/// Result of examining the front of some bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Scan {
    /// The bytes may be the start of a message; more bytes are needed.
    More,
    /// The front is a complete message of this many bytes (at least 1, at most those available).
    Whole(usize),
    /// No message begins at the front.
    Wrong(WireError),
}

/// Rule by which a format delimits its messages.
pub trait Framing {
    /// Number of bytes that always suffice for a result other than [`Scan::More`].
    fn max_message_bytes(&self) -> usize;
    /// Examines the front of `bytes`.
    fn scan(&self, bytes: &[u8]) -> Scan;
}

/// Splits arriving bytes into messages.
#[derive(Debug)]
pub struct Splitter<F> {
    framing: F,
    buf: Vec<u8>,
    head: usize,
    searching: bool,
    ended: bool,
    messages: u64,
    skipped_bytes: u64,
}

impl<F: Framing> Splitter<F> {
    /// An empty splitter.
    pub fn new(framing: F) -> Self {
        Self {
            framing,
            buf: Vec::new(),
            head: 0,
            searching: false,
            ended: false,
            messages: 0,
            skipped_bytes: 0,
        }
    }

    /// Number of messages so far.
    pub fn messages(&self) -> u64 {
        self.messages
    }

    /// Number of bytes of an incomplete message.
    pub fn held_bytes(&self) -> usize {
        self.buf.len() - self.head
    }

    /// Number of bytes skipped because no message began at them.
    pub fn skipped_bytes(&self) -> u64 {
        self.skipped_bytes
    }

    /// Copies bytes while there is room and returns their number. The number is at least one after [`Splitter::next_message`]
    /// returned `None`.
    pub fn push(&mut self, bytes: &[u8]) -> usize {
        self.ended = false;
        self.buf.drain(..self.head);
        self.head = 0;
        let room = (self.framing.max_message_bytes() + 1).saturating_sub(self.buf.len());
        let taken = bytes.len().min(room);
        self.buf.extend_from_slice(&bytes[..taken]);
        taken
    }

    /// Marks the end of the input. An incomplete message becomes an error.
    pub fn finish(&mut self) {
        self.ended = true;
    }

    /// Returns the next complete message or error; `None` if more bytes are needed.
    pub fn next_message(&mut self) -> Option<Result<&[u8], WireError>> {
        loop {
            let held = &self.buf[self.head..];
            if held.is_empty() {
                return None;
            }
            let error = match self.framing.scan(held) {
                Scan::Whole(len) => {
                    let start = self.head;
                    self.head += len.clamp(1, held.len());
                    self.messages += 1;
                    self.searching = false;
                    return Some(Ok(&self.buf[start..self.head]));
                }
                Scan::More if !self.ended && held.len() <= self.framing.max_message_bytes() => {
                    return None;
                }
                Scan::More => WireError::truncated("message", held.len() as u64 + 1, held.len()),
                Scan::Wrong(error) => error,
            };
            self.head += 1;
            self.skipped_bytes += 1;
            if !self.searching {
                self.searching = true;
                return Some(Err(error));
            }
        }
    }

    /// Splits all of `bytes` and passes every message and error to `each`.
    pub fn feed(&mut self, mut bytes: &[u8], mut each: impl FnMut(Result<&[u8], WireError>)) {
        loop {
            while let Some(item) = self.next_message() {
                each(item);
            }
            if bytes.is_empty() {
                return;
            }
            let taken = self.push(bytes);
            bytes = &bytes[taken..];
        }
    }
}
