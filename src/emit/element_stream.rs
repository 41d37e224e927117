//! Emits frames of element samples (`echotank_protocols::elements`) and implements the client session for them.

use std::net::SocketAddr;
use std::ops::Range;

use echotank_protocols::elements::{FrameHead, HEADER_BYTES, SampleType};
use echotank_protocols::extend_encoded;

use super::blocks::blocks;
use super::elements::{elements_of, interleave_iq};
use super::packets::Packets;
use super::session::{Outgoing, Protocol, Session, SessionCounts, Transport, Wants};
use super::sevenk::quantise::IQ_FULL_SCALE;
use echotank_config::spec::{ElementStreamSpec, SonarSpec};
use echotank_core::ping::{PingOutput, PingPlan};
use echotank_core::time::UtcNs;

/// Converter of pings into element frames. It owns its buffers and the frame counter, and serves one thread.
pub struct ElementStreamEmitter {
    arrays: Vec<usize>,
    sample_type: SampleType,
    full_scale_v: f64,
    sample_rate_hz: f64,
    max_frame_bytes: usize,
    /// Frames end at the boundaries of blocks of this duration, seconds.
    block_s: Option<f64>,
    frame_number: u32,
    counts: Vec<[i16; 2]>,
    volts: Vec<[f32; 2]>,
    frame: Vec<u8>,
}

impl ElementStreamEmitter {
    /// `max_frame_bytes` limits a frame including its header. With `block_s` (seconds), frames end at block boundaries.
    pub fn new(
        output: &ElementStreamSpec,
        sonar: &SonarSpec,
        max_frame_bytes: usize,
        block_s: Option<f64>,
    ) -> Self {
        Self {
            arrays: output.arrays.clone(),
            sample_type: match output.is_float {
                true => SampleType::F32,
                false => SampleType::I16,
            },
            full_scale_v: sonar.receiver.full_scale_v,
            sample_rate_hz: sonar.receiver.sample_rate_hz,
            max_frame_bytes,
            block_s,
            frame_number: 0,
            counts: Vec::new(),
            volts: Vec::new(),
            frame: Vec::new(),
        }
    }

    /// Fills `into` with the frames of one ping. Returns the number of values clipped at full scale.
    pub fn emit_ping(&mut self, plan: &PingPlan, output: &PingOutput, into: &mut Packets) -> u64 {
        self.emit_rows(plan, output, 0..plan.sample_count, into)
    }

    /// Like [`Self::emit_ping`], for the sample range `rows`, which starts and ends at block boundaries. `output` must hold the
    /// samples up to `rows.end`.
    pub fn emit_rows(
        &mut self,
        plan: &PingPlan,
        output: &PingOutput,
        rows: Range<usize>,
        into: &mut Packets,
    ) -> u64 {
        into.clear();
        let (elements, sample_times) = (elements_of(output, &self.arrays).count(), rows.end);
        if elements == 0 {
            return 0;
        }
        let saturated = match self.sample_type {
            SampleType::I16 => {
                let full = self.full_scale_v;
                interleave_iq(output, &self.arrays, sample_times, full, &mut self.counts)
            }
            SampleType::F32 => {
                self.volts.clear();
                self.volts.resize(elements * sample_times, [0.0; 2]);
                for (e, iq) in elements_of(output, &self.arrays).enumerate() {
                    let column = self.volts.iter_mut().skip(e).step_by(elements);
                    for (out, v) in column.zip(iq) {
                        *out = [v.re as f32, v.im as f32];
                    }
                }
                0
            }
        };
        let sample_time_bytes = elements * self.sample_type.bytes();
        let fit = ((self.max_frame_bytes - HEADER_BYTES) / sample_time_bytes).max(1);
        let all = blocks(sample_times, self.sample_rate_hz, self.block_s);
        for (block, end_s) in all.filter(|(block, _)| block.start >= rows.start) {
            for first in block.clone().step_by(fit) {
                let count = fit.min(block.end - first);
                self.emit_frame(plan, elements, first, count);
                into.push(&self.frame);
            }
            if let Some(end_s) = end_s {
                into.end_block(plan.first_sample_s + end_s);
            }
        }
        saturated
    }

    fn emit_frame(&mut self, plan: &PingPlan, elements: usize, first: usize, count: usize) {
        let head = FrameHead {
            frame_number: self.frame_number,
            ping_number: plan.ping_number,
            first_sample: first as u32,
            ping_samples: plan.sample_count as u32,
            // The configuration limits the number of elements to the 16 bits of the field.
            elements: elements as u16,
            sample_type: self.sample_type,
            volts_per_unit: match self.sample_type {
                SampleType::I16 => (self.full_scale_v / IQ_FULL_SCALE) as f32,
                SampleType::F32 => 1.0,
            },
            pulse_utc_ns: plan.stamp_utc.0,
            first_sample_s: plan.first_sample_s,
            sample_rate_hz: self.sample_rate_hz,
            center_frequency_hz: plan.pulse.center_frequency_hz,
        };
        self.frame_number = self.frame_number.wrapping_add(1);
        self.frame.clear();
        let values = first * elements..(first + count) * elements;
        let (counts, volts) = (&self.counts, &self.volts);
        head.emit(&mut self.frame, count as u32, |buf| {
            match head.sample_type {
                SampleType::I16 => {
                    extend_encoded(buf, counts[values].as_flattened(), i16::to_le_bytes);
                }
                SampleType::F32 => {
                    extend_encoded(buf, volts[values].as_flattened(), f32::to_le_bytes);
                }
            }
        });
    }
}

/// Protocol of the element stream: every client receives every frame.
pub struct ElementsProtocol;

impl Protocol for ElementsProtocol {
    fn name(&self) -> &'static str {
        "elements"
    }
    fn connect(&self, _transport: Transport, _peer: SocketAddr) -> Box<dyn Session> {
        Box::new(Listener::default())
    }
    fn class(&self, _record_type: u32) -> Wants {
        Wants::class(0)
    }
}

/// Session of a client. Input from the client is ignored and counted as framing errors.
#[derive(Default)]
struct Listener(SessionCounts);

impl Session for Listener {
    fn receive(&mut self, _bytes: &[u8], _now: UtcNs, _out: &mut Vec<Outgoing>) {
        self.0.framing_errors += 1;
    }
    fn wants(&self) -> Wants {
        Wants::class(0)
    }
    fn counts(&self) -> SessionCounts {
        self.0
    }
}
