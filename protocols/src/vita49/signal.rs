//! Signal data packets: the samples of a stream, divided into datagrams. Source: ANSI/VITA 49.2-2017, section 6.3.
//!
//! A complex sample is one word, with I in the upper and Q in the lower half. A word holds two real samples, so a packet has an
//! even number of them. A vector stream interleaves the elements by sample time.

use std::ops::Range;

use super::{Context, PacketType, PayloadFormat, SampleKind, Trailer, VrtTime, emit_packet};

/// Size of a packet without its payload: header, stream, time, trailer.
const AROUND_PAYLOAD_BYTES: usize = 4 + 4 + 4 + 8 + 4;

/// Stream of one element or of all elements. It owns the packet counters.
#[derive(Debug, Clone, PartialEq)]
pub struct SignalStream {
    /// Stream identifier.
    pub stream_id: u32,
    /// True for I and Q, false for real samples.
    pub is_complex: bool,
    /// Number of elements of a vector stream; otherwise 1.
    pub vector_size: u32,
    /// Sample rate of an element.
    pub sample_rate_hz: f64,
    max_packet_bytes: usize,
    data_count: u8,
    context_count: u8,
}

impl SignalStream {
    /// `max_packet_bytes` limits a packet including header and trailer.
    ///
    /// # Panics
    /// If there is no element or more than 65536, if the rate is not positive, or if a packet cannot hold one sample of each element (two
    /// for real samples, which fill whole words).
    pub fn new(
        stream_id: u32,
        is_complex: bool,
        vector_size: u32,
        sample_rate_hz: f64,
        max_packet_bytes: usize,
    ) -> Self {
        assert!(
            (1..=65_536).contains(&vector_size),
            "{vector_size} elements"
        );
        assert!(sample_rate_hz > 0.0, "rate of {sample_rate_hz} Hz");
        let stream = Self {
            stream_id,
            is_complex,
            vector_size,
            sample_rate_hz,
            max_packet_bytes: max_packet_bytes.min(4 * usize::from(u16::MAX)),
            data_count: 0,
            context_count: 0,
        };
        assert!(
            stream.sample_times_per_packet() > 0,
            "packets of {max_packet_bytes} bytes do not hold the samples of {vector_size} elements"
        );
        stream
    }

    /// Maximum number of samples per element in a packet.
    pub fn sample_times_per_packet(&self) -> usize {
        let payload = self.max_packet_bytes.saturating_sub(AROUND_PAYLOAD_BYTES);
        let sample_times = payload / (self.sample_bytes() * self.vector_size as usize);
        if self.is_complex {
            sample_times
        } else {
            sample_times / 2 * 2
        }
    }

    fn sample_bytes(&self) -> usize {
        if self.is_complex { 4 } else { 2 }
    }

    /// Properties of the samples of this stream. The caller adds frequency and bandwidth.
    pub fn context(&self) -> Context {
        Context {
            sample_rate_hz: Some(self.sample_rate_hz),
            payload_format: Some(PayloadFormat {
                is_complex: self.is_complex,
                kind: SampleKind::Fixed { bits: 16 },
                vector_size: self.vector_size,
            }),
            ..Context::default()
        }
    }

    /// Appends a context packet and returns its byte range.
    pub fn emit_context(
        &mut self,
        buf: &mut Vec<u8>,
        time: VrtTime,
        context: &Context,
    ) -> Range<usize> {
        let count = self.context_count;
        self.context_count = (count + 1) & 0xF;
        context.emit(buf, self.stream_id, count, time)
    }

    /// Passes packets of complex samples to the caller one by one, in `buf`, which is overwritten. `time` is the time of the first
    /// sample.
    ///
    /// # Panics
    /// If the stream is real, or the samples are not a whole number of vectors.
    pub fn emit_complex(
        &mut self,
        buf: &mut Vec<u8>,
        time: VrtTime,
        samples: &[[i16; 2]],
        trailer: Option<Trailer>,
        each: impl FnMut(&[u8]),
    ) {
        assert!(self.is_complex, "complex samples for a real stream");
        self.emit(
            buf,
            time,
            samples,
            trailer,
            |[i, q]| {
                let ([i0, i1], [q0, q1]) = (i.to_be_bytes(), q.to_be_bytes());
                [i0, i1, q0, q1]
            },
            each,
        );
    }

    /// Like [`Self::emit_complex`], for real samples.
    ///
    /// # Panics
    /// If the stream is complex, the samples are not a whole number of vectors, or their number is odd.
    pub fn emit_real(
        &mut self,
        buf: &mut Vec<u8>,
        time: VrtTime,
        samples: &[i16],
        trailer: Option<Trailer>,
        each: impl FnMut(&[u8]),
    ) {
        assert!(!self.is_complex, "real samples for a complex stream");
        assert!(
            samples.len().is_multiple_of(2),
            "{} real samples do not fill whole words",
            samples.len()
        );
        self.emit(buf, time, samples, trailer, i16::to_be_bytes, each);
    }

    fn emit<T: Copy, const N: usize>(
        &mut self,
        buf: &mut Vec<u8>,
        time: VrtTime,
        samples: &[T],
        trailer: Option<Trailer>,
        encode: impl Fn(T) -> [u8; N] + Copy,
        mut each: impl FnMut(&[u8]),
    ) {
        let vector = self.vector_size as usize;
        assert!(
            samples.len().is_multiple_of(vector),
            "{} samples of {vector} elements",
            samples.len()
        );
        let sample_times = self.sample_times_per_packet();
        for (packet, chunk) in samples.chunks(sample_times * vector).enumerate() {
            buf.clear();
            // Each time is computed from the start of the record, so rounding errors do not accumulate.
            let after_s = (packet * sample_times) as f64 / self.sample_rate_hz;
            emit_packet(
                buf,
                PacketType::SignalData,
                self.stream_id,
                self.data_count,
                time.plus_ps((after_s * 1e12).round() as u128),
                trailer,
                |buf| crate::sevenk::frame::extend_encoded(buf, chunk, encode),
            );
            self.data_count = (self.data_count + 1) & 0xF;
            each(buf);
        }
    }
}

/// Complex 16-bit samples of a data packet's payload.
pub fn complex_samples(payload: &[u8]) -> impl ExactSizeIterator<Item = [i16; 2]> + '_ {
    payload.chunks_exact(4).map(|bytes| {
        [
            i16::from_be_bytes([bytes[0], bytes[1]]),
            i16::from_be_bytes([bytes[2], bytes[3]]),
        ]
    })
}

/// Real 16-bit samples of a data packet's payload.
pub fn real_samples(payload: &[u8]) -> impl ExactSizeIterator<Item = i16> + '_ {
    payload
        .chunks_exact(2)
        .map(|bytes| i16::from_be_bytes([bytes[0], bytes[1]]))
}
