//! A small blocking client of the element stream, with a tally of received, lost and late frames.

use std::io::{ErrorKind, Read};
use std::net::{TcpStream, ToSocketAddrs};
use std::time::Duration;

use echotank_protocols::elements::{ElementFraming, ElementStream, Frame};

use crate::clock::{Clock, SystemClock};
use echotank_core::time::UtcNs;

const READ_BYTES: usize = 64 * 1024;

/// A client of one element server.
pub struct ElementClient {
    stream: TcpStream,
    frames: ElementStream,
    buffer: Vec<u8>,
    clock: SystemClock,
}

impl ElementClient {
    /// Connects over TCP.
    pub fn connect(address: impl ToSocketAddrs) -> std::io::Result<Self> {
        Ok(Self {
            stream: TcpStream::connect(address)?,
            frames: ElementStream::new(ElementFraming),
            buffer: vec![0; READ_BYTES],
            clock: SystemClock::new(),
        })
    }

    /// Waits for bytes and calls `each` for every complete frame, with the host time of its last byte. Returns false once the server has closed.
    pub fn read(
        &mut self,
        timeout: Duration,
        mut each: impl FnMut(&Frame<'_>, UtcNs),
    ) -> std::io::Result<bool> {
        self.stream.set_read_timeout(Some(timeout))?;
        let len = match self.stream.read(&mut self.buffer) {
            Ok(0) => return Ok(false),
            Ok(len) => len,
            Err(error) => {
                return match error.kind() {
                    ErrorKind::WouldBlock | ErrorKind::TimedOut | ErrorKind::Interrupted => {
                        Ok(true)
                    }
                    _ => Err(error),
                };
            }
        };
        let now = self.clock.host_utc();
        self.frames.feed(&self.buffer[..len], |item| {
            // `frames` counts undecodable bytes.
            if let Some(frame) = item.ok().and_then(|bytes| Frame::parse(bytes).ok()) {
                each(&frame, now);
            }
        });
        Ok(true)
    }

    /// Bytes that belonged to no frame.
    pub fn skipped_bytes(&self) -> u64 {
        self.frames.skipped_bytes()
    }
}

/// Counts of frames and pings.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct FrameTally {
    /// Frames received.
    pub frames: u64,
    /// Frame numbers missing.
    pub lost_frames: u64,
    /// Pings received, incomplete ones included.
    pub pings: u64,
    /// Pings without their last frame before the next ping began.
    pub incomplete_pings: u64,
    next: Option<u32>,
    ping: Option<(u32, u32)>,
}

impl FrameTally {
    /// Counts a frame. Returns true for the first frame of a ping.
    pub fn note(&mut self, frame: &Frame<'_>) -> bool {
        let head = &frame.head;
        self.frames += 1;
        if let Some(next) = self.next {
            self.lost_frames += u64::from(head.frame_number.wrapping_sub(next));
        }
        self.next = Some(head.frame_number.wrapping_add(1));
        let is_first = head.first_sample == 0;
        match self.ping {
            Some((number, had)) if number == head.ping_number => {
                let in_order = had == head.first_sample;
                let had = if in_order {
                    had + frame.sample_times
                } else {
                    had
                };
                self.ping = Some((number, had));
            }
            other => {
                // `self.ping` is `None` after a complete ping.
                self.incomplete_pings += u64::from(other.is_some());
                self.pings += 1;
                self.ping = Some((
                    head.ping_number,
                    if is_first { frame.sample_times } else { 0 },
                ));
            }
        }
        if self.ping == Some((head.ping_number, head.ping_samples)) {
            self.ping = None;
        }
        is_first
    }
}

#[cfg(test)]
mod tests {
    use echotank_protocols::elements::{FrameHead, SampleType};

    use super::*;

    #[test]
    fn lost_frames_and_torn_pings_are_told_from_whole_ones() {
        let mut tally = FrameTally::default();
        // Frame number, ping, first of 4 sample times; each frame has 2.
        let frames = [
            (7, 1, 0),
            (8, 1, 2),
            (10, 2, 2),
            (11, 3, 0),
            (12, 3, 2),
            (13, 4, 0),
            (15, 5, 0),
        ];
        let firsts = frames.map(|(frame_number, ping_number, first_sample)| {
            let mut bytes = Vec::new();
            FrameHead {
                frame_number,
                ping_number,
                first_sample,
                ping_samples: 4,
                elements: 1,
                sample_type: SampleType::I16,
                volts_per_unit: 1.0,
                pulse_utc_ns: 0,
                first_sample_s: 0.0,
                sample_rate_hz: 1.0,
                center_frequency_hz: 1.0,
            }
            .emit(&mut bytes, 2, |buf| buf.extend([0; 8]));
            tally.note(&Frame::parse(&bytes).expect("whole"))
        });
        assert_eq!(firsts, [true, false, false, true, false, true, true]);
        assert_eq!((tally.frames, tally.lost_frames), (7, 2));
        assert_eq!((tally.pings, tally.incomplete_pings), (5, 2), "2 and 4");
    }
}
