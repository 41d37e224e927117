//! Element stream of Echotank: I and Q samples of all elements with a minimal header.
//!
//! Frames are consecutive over TCP; over UDP each datagram holds one frame. Numbers are little endian. Every frame is
//! self-contained. Each sample time has one sample of each element.
//!
//! ```text
//!  0  4s   "ETEL"
//!  4  u16  version, 1
//!  6  u16  bytes of this header, 72: where the samples begin
//!  8  u32  bytes of the whole frame
//! 12  u32  frame number, counted by the stream: a gap is a loss
//! 16  u32  ping number
//! 20  u32  first sample time of the frame, counted from the first of the ping
//! 24  u32  sample times in the frame
//! 28  u32  sample times of the whole ping
//! 32  u16  elements
//! 34  u16  1: i16, 2: f32
//! 36  f32  volts rms of one count (1) or of 1.0 (2)
//! 40  i64  start of the pulse, UTC, ns since 1970
//! 48  f64  sample time 0, seconds after the start of the pulse
//! 56  f64  sample times per second
//! 64  f64  centre frequency, Hz: I and Q are about it
//! 72       sample time by sample time, element by element: I, Q
//! ```

use crate::WireError;
use crate::framing::{Framing, Scan, Splitter};
use crate::layout::data_at;

/// Size of the frame header.
pub const HEADER_BYTES: usize = 72;
/// First four bytes of a frame.
pub const MAGIC: [u8; 4] = *b"ETEL";
/// Version of the format.
pub const VERSION: u16 = 1;
/// Maximum size of a frame.
pub const MAX_FRAME_BYTES: usize = 1 << 26;

const WHAT: &str = "element frame";

/// Number type of I and Q.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SampleType {
    /// Signed 16-bit integers.
    I16,
    /// 32-bit floats.
    F32,
}

impl SampleType {
    /// Size of I and Q together.
    pub fn bytes(self) -> usize {
        match self {
            Self::I16 => 4,
            Self::F32 => 8,
        }
    }
}

/// Frame header without the lengths.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FrameHead {
    /// Counter of the stream; a gap means lost frames.
    pub frame_number: u32,
    /// Ping that the samples belong to.
    pub ping_number: u32,
    /// Index of the frame's first sample time in the ping.
    pub first_sample: u32,
    /// Number of sample times in the whole ping.
    pub ping_samples: u32,
    /// Number of elements.
    pub elements: u16,
    /// Number type of the samples.
    pub sample_type: SampleType,
    /// Volts rms of one count, or of 1.0 for floats.
    pub volts_per_unit: f32,
    /// Start of the pulse, UTC nanoseconds since 1970.
    pub pulse_utc_ns: i64,
    /// Time of sample time 0, seconds after the start of the pulse.
    pub first_sample_s: f64,
    /// Sample rate.
    pub sample_rate_hz: f64,
    /// Carrier frequency of the complex samples.
    pub center_frequency_hz: f64,
}

/// A parsed frame that borrows its samples.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Frame<'a> {
    /// Header fields.
    pub head: FrameHead,
    /// Number of sample times in this frame.
    pub sample_times: u32,
    /// Samples as transmitted: by sample time, by element, I then Q.
    pub samples: &'a [u8],
}

impl FrameHead {
    /// Appends a frame. `write_samples` must append I and Q of `sample_times` sample times.
    ///
    /// # Panics
    /// If `write_samples` appends another number of bytes, or the frame exceeds [`MAX_FRAME_BYTES`].
    pub fn emit(
        &self,
        buf: &mut Vec<u8>,
        sample_times: u32,
        write_samples: impl FnOnce(&mut Vec<u8>),
    ) {
        let sample_bytes =
            self.sample_type.bytes() * usize::from(self.elements) * sample_times as usize;
        let size = HEADER_BYTES + sample_bytes;
        assert!(size <= MAX_FRAME_BYTES, "element frame of {size} bytes");
        buf.extend(MAGIC);
        buf.extend(VERSION.to_le_bytes());
        buf.extend((HEADER_BYTES as u16).to_le_bytes());
        for word in [
            size as u32,
            self.frame_number,
            self.ping_number,
            self.first_sample,
            sample_times,
            self.ping_samples,
        ] {
            buf.extend(word.to_le_bytes());
        }
        buf.extend(self.elements.to_le_bytes());
        let sample_type: u16 = match self.sample_type {
            SampleType::I16 => 1,
            SampleType::F32 => 2,
        };
        buf.extend(sample_type.to_le_bytes());
        buf.extend(self.volts_per_unit.to_le_bytes());
        buf.extend(self.pulse_utc_ns.to_le_bytes());
        buf.extend(self.first_sample_s.to_le_bytes());
        buf.extend(self.sample_rate_hz.to_le_bytes());
        buf.extend(self.center_frequency_hz.to_le_bytes());
        let start = buf.len();
        write_samples(buf);
        assert_eq!(
            buf.len() - start,
            sample_bytes,
            "samples of an element frame"
        );
    }
}

impl<'a> Frame<'a> {
    /// Parses the frame at the front of `bytes`.
    pub fn parse(bytes: &'a [u8]) -> Result<Self, WireError> {
        let head = data_at(bytes, 0, HEADER_BYTES as u64, WHAT)?;
        let u16_at = |at: usize| u16::from_le_bytes([head[at], head[at + 1]]);
        let u32_at = |at: usize| u32::from(u16_at(at)) | u32::from(u16_at(at + 2)) << 16;
        let u64_at = |at: usize| u64::from(u32_at(at)) | u64::from(u32_at(at + 4)) << 32;
        let f64_at = |at: usize| f64::from_bits(u64_at(at));
        if head[..4] != MAGIC {
            return Err(WireError::mark(WHAT, u32::from_le_bytes(MAGIC), u32_at(0)));
        }
        if u16_at(4) != VERSION || usize::from(u16_at(6)) != HEADER_BYTES {
            return Err(WireError::unsupported(
                "element frame of version",
                u16_at(4),
            ));
        }
        let sample_type = match u16_at(34) {
            1 => SampleType::I16,
            2 => SampleType::F32,
            other => return Err(WireError::unsupported("sample type", other)),
        };
        let (elements, sample_times) = (u16_at(32), u32_at(24));
        let sample_bytes =
            sample_type.bytes() as u64 * u64::from(elements) * u64::from(sample_times);
        let size = u64::from(u32_at(8));
        if size != HEADER_BYTES as u64 + sample_bytes || size > MAX_FRAME_BYTES as u64 {
            return Err(WireError::unsupported("size of an element frame", size));
        }
        Ok(Self {
            head: FrameHead {
                frame_number: u32_at(12),
                ping_number: u32_at(16),
                first_sample: u32_at(20),
                ping_samples: u32_at(28),
                elements,
                sample_type,
                volts_per_unit: f32::from_bits(u32_at(36)),
                pulse_utc_ns: u64_at(40) as i64,
                first_sample_s: f64_at(48),
                sample_rate_hz: f64_at(56),
                center_frequency_hz: f64_at(64),
            },
            sample_times,
            samples: data_at(bytes, HEADER_BYTES, sample_bytes, WHAT)?,
        })
    }

    /// Size of the whole frame.
    pub fn size_bytes(&self) -> usize {
        HEADER_BYTES + self.samples.len()
    }
}

/// Splits the bytes of a TCP connection into frames.
#[derive(Debug, Clone, Copy)]
pub struct ElementFraming;

/// Splitter of a connection into frames.
pub type ElementStream = Splitter<ElementFraming>;

impl Framing for ElementFraming {
    fn max_message_bytes(&self) -> usize {
        MAX_FRAME_BYTES
    }

    fn scan(&self, bytes: &[u8]) -> Scan {
        if bytes.iter().zip(MAGIC).any(|(&byte, mark)| byte != mark) {
            return Scan::Wrong(WireError::mark(WHAT, u32::from_le_bytes(MAGIC), bytes[0]));
        }
        if bytes.len() < HEADER_BYTES {
            return Scan::More;
        }
        let size = u32::from_le_bytes([bytes[8], bytes[9], bytes[10], bytes[11]]) as usize;
        if !(HEADER_BYTES..=MAX_FRAME_BYTES).contains(&size) {
            return Scan::Wrong(WireError::unsupported(
                "size of an element frame",
                size as u64,
            ));
        }
        match bytes.get(..size).map(Frame::parse) {
            None => Scan::More,
            Some(Ok(_)) => Scan::Whole(size),
            Some(Err(error)) => Scan::Wrong(error),
        }
    }
}
