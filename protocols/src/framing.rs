//! Whole messages from the bytes of a connection or a file, for formats that say their length at their front.
//!
//! Memory is bounded by the largest message allowed. What is no start of a message is passed over byte by byte until one is: one error
//! per gap, and a counter.

use crate::WireError;

/// What the front of some bytes is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Look {
    /// Could be a message; more bytes are needed to tell, or to have it whole.
    More,
    /// A whole message of so many bytes (at least 1, at most what is there).
    Whole(usize),
    /// No message begins here.
    Wrong(WireError),
}

/// How a format shows where its messages end.
pub trait Framing {
    /// Bytes that always suffice to say something other than [`Look::More`].
    fn max_message_bytes(&self) -> usize;
    fn look(&self, bytes: &[u8]) -> Look;
}

/// Cuts messages from bytes as they come.
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

    /// Messages found so far.
    pub fn messages(&self) -> u64 {
        self.messages
    }

    /// Bytes that wait for the rest of their message.
    pub fn held_bytes(&self) -> usize {
        self.buf.len() - self.head
    }

    /// Bytes passed over because no message began at them.
    pub fn skipped_bytes(&self) -> u64 {
        self.skipped_bytes
    }

    /// Takes bytes, as many as there is room for, and returns how many; at least one after [`Splitter::next_message`] returned `None`.
    pub fn push(&mut self, bytes: &[u8]) -> usize {
        self.ended = false;
        self.buf.drain(..self.head);
        self.head = 0;
        let room = (self.framing.max_message_bytes() + 1).saturating_sub(self.buf.len());
        let taken = bytes.len().min(room);
        self.buf.extend_from_slice(&bytes[..taken]);
        taken
    }

    /// Says that what is held will not be continued.
    pub fn finish(&mut self) {
        self.ended = true;
    }

    /// The next whole message or error; `None` when more bytes are needed.
    pub fn next_message(&mut self) -> Option<Result<&[u8], WireError>> {
        loop {
            let held = &self.buf[self.head..];
            if held.is_empty() {
                return None;
            }
            let error = match self.framing.look(held) {
                Look::Whole(len) => {
                    let start = self.head;
                    self.head += len.clamp(1, held.len());
                    self.messages += 1;
                    self.searching = false;
                    return Some(Ok(&self.buf[start..self.head]));
                }
                Look::More if !self.ended && held.len() <= self.framing.max_message_bytes() => {
                    return None;
                }
                Look::More => WireError::Truncated {
                    what: "message",
                    need_bytes: held.len() as u64 + 1,
                    got_bytes: held.len() as u64,
                },
                Look::Wrong(error) => error,
            };
            self.head += 1;
            self.skipped_bytes += 1;
            if !self.searching {
                self.searching = true;
                return Some(Err(error));
            }
        }
    }

    /// Takes all of `bytes` and hands every message and error on as it is met.
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
