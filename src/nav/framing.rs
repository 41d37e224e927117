//! Bytes to sentences. Comes in: any bytes, cut anywhere. Goes out: what stands between `$` (or `!`) and `*`, with the checksum's verdict.
//!
//! NMEA 0183 is a line protocol, but logs and gateways lose line ends, so a sentence ends at its checksum, at a line end, or where the
//! next one begins. TAG blocks (NMEA 4.0) and the `UdPbC` header of IEC 61162-450 are stepped over. Memory is bounded by [`MAX_SENTENCE`].

use echotank_core::time::UtcNs;

/// Longest sentence taken, bytes. NMEA allows 82; proprietary attitude reaches about 130.
pub(crate) const MAX_SENTENCE: usize = 256;

/// What precedes the sentences of an IEC 61162-450 datagram.
const UDP_HEADER: &[u8; 6] = b"UdPbC\0";

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Checksum {
    Right,
    Wrong,
    Missing,
}

/// One sentence: printable ASCII without its start, checksum and line end.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RawSentence<'a> {
    pub body: &'a str,
    pub checksum: Checksum,
    /// Of its first byte.
    pub arrival: UtcNs,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum State {
    Outside,
    /// In a TAG block, so many bytes so far.
    Tag(usize),
    Body,
    FirstDigit,
    SecondDigit(u8),
}

/// What a byte did.
enum Step {
    Took,
    /// The sentence is complete; the byte belongs to it.
    Ended(Checksum),
    /// The sentence is complete; the byte is still to be looked at.
    EndedBefore(Checksum),
}

#[derive(Debug)]
pub struct Framing {
    state: State,
    body: Vec<u8>,
    sum: u8,
    header: usize,
    arrival: UtcNs,
    resync_bytes: u64,
}

impl Framing {
    pub fn new() -> Self {
        Self {
            state: State::Outside,
            body: Vec::with_capacity(MAX_SENTENCE),
            sum: 0,
            header: 0,
            arrival: UtcNs(0),
            resync_bytes: 0,
        }
    }

    /// Bytes that belonged to nothing: neither sentence, line end, TAG block nor datagram header.
    pub fn resync_bytes(&self) -> u64 {
        self.resync_bytes
    }

    /// Takes bytes off the front of `bytes`, the first of which arrived at `arrival` and each later one `byte_ns` after it, until a sentence
    /// is complete or none are left.
    pub fn next(
        &mut self,
        bytes: &mut &[u8],
        arrival: UtcNs,
        byte_ns: i64,
    ) -> Option<RawSentence<'_>> {
        let mut at = arrival;
        while let Some((&byte, rest)) = bytes.split_first() {
            let step = self.step(byte, at);
            if !matches!(step, Step::EndedBefore(_)) {
                *bytes = rest;
                at = at.plus_ns(byte_ns);
            }
            if let Step::Ended(checksum) | Step::EndedBefore(checksum) = step {
                return Some(self.sentence(checksum));
            }
        }
        None
    }

    /// Nothing follows (end of a datagram or file): an open sentence ends here.
    pub fn flush(&mut self) -> Option<RawSentence<'_>> {
        self.header = 0;
        let checksum = match self.state {
            State::Body if !self.body.is_empty() => Checksum::Missing,
            State::FirstDigit => Checksum::Missing,
            State::SecondDigit(_) => Checksum::Wrong,
            State::Outside | State::Tag(_) | State::Body => {
                self.state = State::Outside;
                return None;
            }
        };
        self.state = State::Outside;
        Some(self.sentence(checksum))
    }

    fn sentence(&self, checksum: Checksum) -> RawSentence<'_> {
        RawSentence {
            // Only printable ASCII gets in.
            body: std::str::from_utf8(&self.body).unwrap_or(""),
            checksum,
            arrival: self.arrival,
        }
    }

    fn step(&mut self, byte: u8, arrival: UtcNs) -> Step {
        if matches!(byte, b'$' | b'!') {
            return match self.state {
                State::FirstDigit => self.end_before(Checksum::Missing),
                State::SecondDigit(_) => self.end_before(Checksum::Wrong),
                State::Outside | State::Tag(_) | State::Body => {
                    self.begin(arrival);
                    Step::Took
                }
            };
        }
        match self.state {
            State::Outside => self.outside(byte),
            State::Tag(len) => {
                let closed = matches!(byte, b'\\' | b'\r' | b'\n') || len >= MAX_SENTENCE;
                self.state = if closed {
                    State::Outside
                } else {
                    State::Tag(len + 1)
                };
            }
            State::Body => match byte {
                b'*' => self.state = State::FirstDigit,
                b'\r' | b'\n' if self.body.is_empty() => self.abandon(0),
                b'\r' | b'\n' => {
                    self.state = State::Outside;
                    return Step::Ended(Checksum::Missing);
                }
                b' '..=b'~' if self.body.len() < MAX_SENTENCE => {
                    self.body.push(byte);
                    self.sum ^= byte;
                }
                _ => self.abandon(1),
            },
            State::FirstDigit => match hex(byte) {
                Some(digit) => self.state = State::SecondDigit(digit),
                None => return self.end_before(Checksum::Missing),
            },
            State::SecondDigit(first) => match hex(byte) {
                Some(second) => {
                    self.state = State::Outside;
                    return Step::Ended(if first << 4 | second == self.sum {
                        Checksum::Right
                    } else {
                        Checksum::Wrong
                    });
                }
                None => return self.end_before(Checksum::Wrong),
            },
        }
        Step::Took
    }

    fn outside(&mut self, byte: u8) {
        match byte {
            b'\r' | b'\n' => self.header = 0,
            b'\\' => self.state = State::Tag(0),
            _ => {
                self.resync_bytes += 1;
                self.header = if byte == UDP_HEADER[self.header] {
                    self.header + 1
                } else {
                    usize::from(byte == UDP_HEADER[0])
                };
                if self.header == UDP_HEADER.len() {
                    self.resync_bytes -= UDP_HEADER.len() as u64;
                    self.header = 0;
                }
            }
        }
    }

    fn begin(&mut self, arrival: UtcNs) {
        if self.state == State::Body {
            self.abandon(0);
        }
        self.state = State::Body;
        self.header = 0;
        self.body.clear();
        self.sum = 0;
        self.arrival = arrival;
    }

    /// Gives up the open sentence: its start, its body and `more` bytes belonged to nothing.
    fn abandon(&mut self, more: u64) {
        self.resync_bytes += 1 + self.body.len() as u64 + more;
        self.state = State::Outside;
    }

    fn end_before(&mut self, checksum: Checksum) -> Step {
        self.state = State::Outside;
        Step::EndedBefore(checksum)
    }
}

impl Default for Framing {
    fn default() -> Self {
        Self::new()
    }
}

fn hex(byte: u8) -> Option<u8> {
    (byte as char).to_digit(16).map(|d| d as u8)
}

/// Exclusive or of all bytes: what `*hh` says.
pub fn checksum_of(body: &str) -> u8 {
    body.bytes().fold(0, |sum, byte| sum ^ byte)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn all(bytes: &[u8], cut: usize) -> (Vec<(String, Checksum)>, u64) {
        let mut framing = Framing::new();
        let mut found = Vec::new();
        for mut piece in bytes.chunks(cut) {
            while let Some(s) = framing.next(&mut piece, UtcNs(0), 0) {
                found.push((s.body.to_string(), s.checksum));
            }
        }
        found.extend(framing.flush().map(|s| (s.body.to_string(), s.checksum)));
        (found, framing.resync_bytes())
    }

    fn check(bytes: &[u8], want: &[(&str, Checksum)], want_resync: u64) {
        for cut in [1, 2, 7, 1000] {
            let (found, resync) = all(bytes, cut);
            let found: Vec<_> = found.iter().map(|(b, c)| (b.as_str(), *c)).collect();
            assert_eq!(found, want, "cut {cut}");
            assert_eq!(resync, want_resync, "cut {cut}");
        }
    }

    #[test]
    fn checksums_in_either_case_wrong_and_missing_are_told_apart() {
        use Checksum::{Missing, Right, Wrong};
        check(
            b"$HEHDT,218.19,T*1c\r\n$HEHDT,218.19,T*1C\n$HEHDT,218.19,T*00\r$HEHDT,218.19,T\r\n$HEHDT,218.19,T*\r\n$HEHDT,218.19,T*1",
            &[
                ("HEHDT,218.19,T", Right),
                ("HEHDT,218.19,T", Right),
                ("HEHDT,218.19,T", Wrong),
                ("HEHDT,218.19,T", Missing),
                ("HEHDT,218.19,T", Missing),
                ("HEHDT,218.19,T", Wrong),
            ],
            0,
        );
    }

    #[test]
    fn several_on_a_line_and_torn_ones_resync_on_the_next_start() {
        check(
            b"$HEHDT,218.19,T*1C$HEHDT,218.19,T*1C$SDVLW,$SDVLW,,N*",
            &[
                ("HEHDT,218.19,T", Checksum::Right),
                ("HEHDT,218.19,T", Checksum::Right),
                ("SDVLW,,N", Checksum::Missing),
            ],
            7,
        );
        check(
            b"abc$HEHDT,2\x81,T*1C\r\n$HEHDT,218.19,T*1C",
            &[("HEHDT,218.19,T", Checksum::Right)],
            3 + 9 + 5,
        );
    }

    #[test]
    fn tag_blocks_and_the_udp_header_are_stepped_over() {
        check(
            b"UdPbC\0\\s:GN9999,n:216*0D\\$HEHDT,218.19,T*1C\r\n\\s:x\\$HEHDT,218.19,T*1C\r\n",
            &[
                ("HEHDT,218.19,T", Checksum::Right),
                ("HEHDT,218.19,T", Checksum::Right),
            ],
            0,
        );
    }

    #[test]
    fn a_sentence_without_end_is_dropped_at_the_limit() {
        let mut bytes = vec![b'$'];
        bytes.resize(1000, b'a');
        bytes.extend(b"\r\n$HEHDT,218.19,T*1C");
        check(&bytes, &[("HEHDT,218.19,T", Checksum::Right)], 1000);
    }
}
