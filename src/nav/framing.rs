//! Finds NMEA 0183 sentences in a byte stream and verifies their checksums.
//!
//! NMEA 0183 separates sentences by line ends, but logs and gateways lose line ends. A sentence therefore ends at its checksum, at
//! a line end, or at the start of the next sentence. TAG blocks (NMEA 4.0) and the `UdPbC` header of IEC 61162-450 are skipped.
//! `MAX_SENTENCE` limits the memory.

use echotank_core::time::UtcNs;

/// Longest accepted sentence, bytes. NMEA allows 82; proprietary attitude sentences reach about 130.
pub(crate) const MAX_SENTENCE: usize = 256;

/// Header of an IEC 61162-450 datagram.
const UDP_HEADER: &[u8; 6] = b"UdPbC\0";

/// Result of a checksum test.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Checksum {
    /// Present and correct.
    Right,
    /// Present and wrong.
    Wrong,
    /// Absent.
    Missing,
}

/// Sentence without its start character, checksum and line end.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RawSentence<'a> {
    /// Printable ASCII.
    pub body: &'a str,
    /// Result of the checksum test.
    pub checksum: Checksum,
    /// Arrival of the first byte.
    pub arrival: UtcNs,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum State {
    Outside,
    /// Inside a TAG block, with the number of its bytes so far.
    Tag(usize),
    Body,
    FirstDigit,
    SecondDigit(u8),
}

/// Effect of one byte.
enum Step {
    Took,
    /// The sentence is complete and includes this byte.
    Ended(Checksum),
    /// The sentence is complete; this byte is not yet consumed.
    EndedBefore(Checksum),
}

/// Incremental detector of sentences in a byte stream.
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
    /// Detector in the state outside any sentence.
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

    /// Bytes outside any sentence, line end, TAG block and datagram header.
    pub fn resync_bytes(&self) -> u64 {
        self.resync_bytes
    }

    /// Consumes `bytes` from the front until a sentence is complete. `arrival` is the arrival of the first byte. `byte_ns` is the
    /// time between bytes.
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

    /// Ends a datagram or file. An open sentence counts as complete.
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
            // The state machine admits only printable ASCII.
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

    /// Discards the open sentence and counts its start, its body and `more` bytes as resync bytes.
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

/// NMEA checksum of a body: the exclusive or of its bytes.
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
    fn distinguishes_right_wrong_and_missing_checksums() {
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
    fn resyncs_on_the_next_start() {
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
    fn tag_blocks_and_the_udp_header_are_skipped() {
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
