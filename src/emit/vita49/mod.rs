//! ANSI/VITA 49.2 packets of a ping: a context packet per stream, then the samples of all streams interleaved in time.
//!
//! The timestamp of a packet is the UTC time of its first sample in picoseconds, derived from the ping's timestamp. Frequencies are those
//! at the transducer. For passband samples, the intermediate frequency equals the radio frequency. The full scale in dBm refers to 50 ohm.

use std::ops::Range;

use echotank_protocols::vita49::{Context, SignalStream, Trailer, VrtTime};

use super::blocks::blocks;
use super::elements::{counts, elements_of, interleave_iq};
use super::packets::Packets;
use super::passband::{BLOCK, LANES, Passband};
use super::sevenk::EmitCounts;
use echotank_config::spec::{SonarSpec, Vita49Spec};
use echotank_core::ping::{PingOutput, PingPlan};
use echotank_core::simd::widest;

/// Converter of pings into packets. It owns its buffers and the packet counters of the streams, and serves one thread.
pub struct Vita49Emitter {
    arrays: Vec<usize>,
    full_scale_v: f64,
    /// Packets end at the boundaries of blocks of this duration, seconds.
    block_s: Option<f64>,
    streams: Vec<SignalStream>,
    passband: Option<Passband>,
    /// Latest context sent.
    last_context: Option<Context>,
    iq: Vec<[i16; 2]>,
    real: Vec<i16>,
    /// Samples of one packet, copied from the buffers above.
    cut_iq: Vec<[i16; 2]>,
    cut_real: Vec<i16>,
    packet: Vec<u8>,
    totals: EmitCounts,
}

impl Vita49Emitter {
    /// Emitter with one stream per element, or one vector stream for all elements of the output's arrays.
    pub fn new(output: &Vita49Spec, sonar: &SonarSpec) -> Self {
        let elements: usize = output
            .arrays
            .iter()
            .map(|&array| sonar.receive[array].elements)
            .sum();
        let (streams, vector) = if output.is_vector {
            (1, elements)
        } else {
            (elements, 1)
        };
        let sample_rate_hz = sonar.receiver.sample_rate_hz;
        let streams = (0..streams as u32)
            .map(|stream| {
                SignalStream::new(
                    output.first_stream + stream,
                    output.passband_rate_hz.is_none(),
                    vector as u32,
                    output.passband_rate_hz.unwrap_or(sample_rate_hz),
                    output.max_packet,
                )
            })
            .collect();
        Self {
            arrays: output.arrays.clone(),
            full_scale_v: sonar.receiver.full_scale_v,
            block_s: None,
            streams,
            passband: output
                .passband_rate_hz
                .map(|hz| Passband::new(sample_rate_hz, hz, sonar.pulse.center_frequency_hz)),
            last_context: None,
            iq: Vec::new(),
            real: Vec::new(),
            cut_iq: Vec::new(),
            cut_real: Vec::new(),
            packet: Vec::new(),
            totals: EmitCounts::default(),
        }
    }

    /// Makes packets end at the boundaries of blocks of `block_s` seconds.
    pub fn in_blocks_of(mut self, block_s: Option<f64>) -> Self {
        self.block_s = block_s;
        self
    }

    /// Counts since the start.
    pub fn totals(&self) -> EmitCounts {
        self.totals
    }

    /// Fills `into` with the packets of one ping. `lost` is true if packets before these were not sent.
    pub fn emit_ping(
        &mut self,
        plan: &PingPlan,
        output: &PingOutput,
        lost: bool,
        into: &mut Packets,
    ) -> EmitCounts {
        self.emit_rows(plan, output, 0..plan.sample_count, lost, into)
    }

    /// Like [`Self::emit_ping`], for the sample range `rows`, which starts and ends at block boundaries. `output` must hold the
    /// samples up to `rows.end`. Passband output requires all samples.
    pub fn emit_rows(
        &mut self,
        plan: &PingPlan,
        output: &PingOutput,
        rows: Range<usize>,
        lost: bool,
        into: &mut Packets,
    ) -> EmitCounts {
        into.clear();
        let elements = elements_of(output, &self.arrays).count();
        if elements == 0 || rows.is_empty() {
            return EmitCounts::default();
        }
        let saturated = match &mut self.passband {
            None => interleave_iq(
                output,
                &self.arrays,
                rows.end,
                self.full_scale_v,
                &mut self.iq,
            ),
            Some(passband) => {
                // An even number of samples fills whole words.
                let samples = passband.samples_of(plan.sample_count) / 2 * 2;
                passband.begin(plan.first_sample_s, samples, plan.first_sample_s);
                interleave_real(
                    passband,
                    output,
                    &self.arrays,
                    elements,
                    self.full_scale_v,
                    &mut self.real,
                )
            }
        };
        let start = VrtTime::from_utc_ns(plan.stamp_utc.0)
            .plus_ps((plan.first_sample_s.max(0.0) * 1e12).round() as u128);
        if rows.start == 0 {
            self.emit_contexts(plan, start, into);
        }
        let trailer = Trailer {
            calibrated_time: Some(true),
            valid_data: Some(true),
            over_range: Some(saturated > 0 || output.elements.iter().any(|f| f.saturated > 0)),
            sample_loss: Some(lost),
            // The indicator is absent without degradation, so the bits equal those of a machine without overload.
            degraded: output.overload_state.tolerance.map(|_| true),
        };
        self.emit_samples(
            plan.first_sample_s,
            start,
            (elements, rows.start),
            trailer,
            into,
        );
        let saturated = match rows.end == plan.sample_count {
            true => saturated,
            // The block is counted with the whole ping.
            false => 0,
        };
        let counts = EmitCounts {
            records: into.len() as u64,
            bytes: into.len_bytes() as u64,
            saturated,
        };
        self.totals += counts;
        counts
    }

    fn emit_contexts(&mut self, plan: &PingPlan, time: VrtTime, into: &mut Packets) {
        let pulse = &plan.pulse;
        let mut context = Context {
            bandwidth_hz: Some(pulse.bandwidth_hz.max(1.0 / pulse.duration_s)),
            rf_reference_hz: Some(pulse.center_frequency_hz),
            if_reference_hz: self.passband.is_some().then_some(pulse.center_frequency_hz),
            reference_level_dbm: Some(
                10.0 * (self.full_scale_v * self.full_scale_v / 50.0 * 1e3).log10(),
            ),
            ..self.streams[0].context()
        };
        context.is_change = self
            .last_context
            .is_some_and(|last_context| last_context != context);
        self.last_context = Some(Context {
            is_change: false,
            ..context
        });
        for stream in &mut self.streams {
            self.packet.clear();
            stream.emit_context(&mut self.packet, time, &context);
            into.push(&self.packet);
        }
    }

    /// Emits sample packets from a sample on. The packets of all streams for the same time are consecutive.
    fn emit_samples(
        &mut self,
        first_sample_s: f64,
        start: VrtTime,
        (elements, from): (usize, usize),
        trailer: Trailer,
        into: &mut Packets,
    ) {
        let streams = self.streams.len();
        let side_by_side = elements / streams;
        let is_complex = self.passband.is_none();
        let samples = match is_complex {
            true => self.iq.len(),
            false => self.real.len(),
        } / elements;
        let per_packet = self.streams[0].sample_times_per_packet();
        let rate_hz = self.streams[0].sample_rate_hz;
        // Two real samples fill a word. An odd last sample of a block is sent with the next block.
        let whole = |row: usize| if is_complex { row } else { row / 2 * 2 };
        let all = blocks(samples, rate_hz, self.block_s);
        for (block, end_s) in all.filter(|(block, _)| block.start >= from) {
            let block = whole(block.start)..whole(block.end);
            for first in block.clone().step_by(per_packet) {
                let rows = first..(first + per_packet).min(block.end);
                // Each time is computed from the start of the ping, so rounding errors do not accumulate.
                let time = start.plus_ps((first as f64 / rate_hz * 1e12).round() as u128);
                for (s, stream) in self.streams.iter_mut().enumerate() {
                    let columns = s * side_by_side..(s + 1) * side_by_side;
                    let (rows, trailer) = (rows.clone(), Some(trailer));
                    let packet = &mut self.packet;
                    if is_complex {
                        take(&self.iq, elements, rows, columns, &mut self.cut_iq);
                        stream.emit_complex(packet, time, &self.cut_iq, trailer, |packet| {
                            into.push(packet)
                        });
                    } else {
                        take(&self.real, elements, rows, columns, &mut self.cut_real);
                        stream.emit_real(packet, time, &self.cut_real, trailer, |packet| {
                            into.push(packet)
                        });
                    }
                }
            }
            if let Some(end_s) = end_s {
                into.end_block(first_sample_s.max(0.0) + end_s);
            }
        }
    }
}

/// Copies a range of columns of several rows, row by row.
fn take<T: Copy>(
    all: &[T],
    width: usize,
    rows: std::ops::Range<usize>,
    columns: std::ops::Range<usize>,
    into: &mut Vec<T>,
) {
    into.clear();
    if columns.len() == 1 {
        let column = all[rows.start * width..rows.end * width].iter();
        into.extend(column.skip(columns.start).step_by(width));
        return;
    }
    for row in rows {
        into.extend_from_slice(&all[row * width + columns.start..row * width + columns.end]);
    }
}

/// Interleaves the passband samples of all elements by sample time. Returns the number of clipped values.
fn interleave_real(
    passband: &mut Passband,
    output: &PingOutput,
    arrays: &[usize],
    elements: usize,
    full_scale_v: f64,
    into: &mut Vec<i16>,
) -> u64 {
    let mut saturated = 0;
    into.clear();
    into.resize(passband.samples() * elements, 0);
    let mut block = [[0; LANES]; BLOCK];
    passband.elements(elements_of(output, arrays), |columns, first, rows| {
        let (counted, width) = (&mut block, columns.len());
        saturated += widest(
            #[inline(always)]
            move || {
                let mut saturated = 0;
                for (out, volts) in counted.iter_mut().zip(rows) {
                    for lane in 0..LANES {
                        let (value, held) = counts(volts[lane] / full_scale_v);
                        out[lane] = value;
                        saturated += u64::from(held & (lane < width));
                    }
                }
                saturated
            },
        );
        let lines = into[first * elements..].chunks_mut(elements);
        for (line, block) in lines.zip(&block[..rows.len()]) {
            line[columns.clone()].copy_from_slice(&block[..width]);
        }
    });
    saturated
}

#[cfg(test)]
mod tests;
