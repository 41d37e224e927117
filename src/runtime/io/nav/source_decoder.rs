//! Decoder of one live source, for received and for recorded bytes.

use super::Feed;
use echotank_config::spec::{NavInputSpec, NavSourceSpec};
use echotank_core::navigation::NavSample;
use echotank_core::time::{NS_PER_S, UtcNs};
use echotank_nav::NavDecoder;
use echotank_nav::decoder::ignore_events;

/// A decoder, and how the bytes of its source arrive.
pub(super) struct SourceDecoder {
    /// Index into `NavSpec::sources`.
    pub(super) index: usize,
    pub(super) decoder: NavDecoder,
    /// Duration of a byte on a serial line; 0 elsewhere.
    pub(super) byte_ns: i64,
    /// A byte stream; otherwise datagrams.
    stream: bool,
    samples: Vec<NavSample>,
}

impl SourceDecoder {
    pub(super) fn new(index: usize, spec: &NavSourceSpec) -> Self {
        Self {
            index,
            decoder: NavDecoder::new(u16::try_from(index).unwrap_or(u16::MAX), spec),
            byte_ns: match &spec.input {
                NavInputSpec::Serial { baud, line, .. } => {
                    line.bits_per_byte() * NS_PER_S / i64::from((*baud).max(1))
                }
                _ => 0,
            },
            stream: !matches!(spec.input, NavInputSpec::Udp { .. }),
            samples: Vec::new(),
        }
    }

    /// Decodes a datagram, or a read of a stream, whose first byte arrived at `arrival`. The samples are in `self.samples`.
    fn decode(&mut self, bytes: &[u8], arrival: UtcNs) {
        let out = &mut self.samples;
        if !self.stream {
            // A datagram that begins with a sentence ends an incomplete previous one; other datagrams continue it.
            let starts = [&b"$"[..], b"!", b"\\", b"UdPbC"];
            if starts.iter().any(|start| bytes.starts_with(start)) {
                self.decoder.flush(out);
            }
            self.decoder.push(bytes, arrival, out);
            return;
        }
        // Each sentence has the arrival time of its first byte.
        self.decoder
            .push_paced(bytes, arrival, self.byte_ns, out, &mut ignore_events);
    }

    /// Decodes bytes for their times only.
    pub(super) fn look(&mut self, bytes: &[u8], arrival: UtcNs) {
        self.decode(bytes, arrival);
        self.samples.clear();
    }

    /// Decodes bytes, after the faults of the feed, into the feed.
    pub(super) fn feed(&mut self, bytes: &mut Vec<u8>, arrival: UtcNs, feed: &mut Feed) {
        if let Some(fault_filter) = &mut feed.fault_filter {
            fault_filter.modify_bytes(self.index, arrival, bytes);
        }
        self.decode(bytes, arrival);
        let id = u16::try_from(self.index).unwrap_or(u16::MAX);
        for event in self.decoder.take_clock_events() {
            feed.clock_changed(id, event.arrival, event.state);
        }
        for sample in self.samples.drain(..) {
            feed.insert(&sample);
        }
    }
}
