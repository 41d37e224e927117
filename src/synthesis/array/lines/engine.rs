//! One ping: geometry, order, spreading, transforms.
//!
//! Slabs of delay lie at fixed samples of the record. Each echo belongs to the slab of its arrival at the middle of the line. A task is one slab
//! of one block of elements; no sum crosses tasks but the addition of overlapping slabs, in order. The samples are therefore the same bits for any
//! number of threads.

use std::f64::consts::TAU;
use std::sync::{Mutex, PoisonError};

use num_complex::{Complex, Complex64};
use rayon::prelude::*;

use crate::array::filter::Decimator;
use crate::array::gridded::batched_fft::{BatchedFft, LaneTable, transform_lanes};
use crate::array::gridded::pulse_spectrum::PulseSpectrum;
use crate::arrivals::CHUNK;
use crate::echo::walk::{MAX_NODES, NodeBatch, NodeTracks, NodeWorkspace, TransmitLeg};
use crate::error_model::ErrorModel;
use echotank_core::arrays::ArrayGeometry;
use echotank_core::model::DopplerModel;
use echotank_core::ping::{EchoCounts, PingPlan};
use echotank_core::simd::{SimdLevel, widest};

use super::aligned::Aligned;
use super::design::{BEYOND_SHARE, Design, Refusal, Spec};
use super::dopplers::{MAX_TAPS, MEAN_CURVATURE, WEIGHT_TERMS};
use super::kernel::BAND;
use super::nodes::{BlockWeights, NODES, NodeCounts, block_weights, coefficients, places};
use super::products::{Bin, add_products};
use super::spread::{
    CELL, EchoChunk, LANES, Located, Shape, add, cell_lanes, cell_rows, column_stride, lanes_for,
};

/// Echoes are ordered by arrival in steps of this many rows.
const BUCKET_ROWS: usize = 8;
/// Energies are compared over windows of half a pulse, in steps of a quarter.
const PARTS_OF_PULSE: f64 = 4.0;
/// Energy below the strongest window that counts as noise.
const NOISE: f32 = 3.162e-6;
/// Mean squared error of an echo at a wrong Doppler.
const WRONG: f64 = 2.0;
/// Columns that are transformed before their templates are applied: they fit the second-level cache.
const TOGETHER: usize = 4;
/// Marks echoes that no slab takes.
const NOWHERE: u32 = u32::MAX;

/// The engine for one line array and one pulse.
pub struct GriddedLines {
    design: Design,
    simd_level: SimdLevel,
    array: ArrayGeometry,
    sample_rate_hz: f64,
    pulse_s: f64,
    tolerance: f64,
    forward: BatchedFft<f32>,
    /// Of half as many rows: of blocks with two rows a cell.
    forward_half: BatchedFft<f32>,
    inverse: BatchedFft<f32>,
    /// Every used bin.
    bins: Vec<Bin>,
    /// `[column][bin]`
    templates: Vec<Complex<f32>>,
    /// Whether the change of the Doppler during the pulse counts.
    models_curvature: bool,
    /// Smallest range at which each of [`NODES`] is enough, metres.
    near_m: [f64; NODES.len()],
    /// Range from which on the first, the middle and the last of them are enough, metres.
    coarse_m: [f64; NODES.len()],
    /// Row of the transformed spectrum that holds each sample.
    row_of_sample: Vec<u32>,
    state: State,
}

/// Buffers, reused from ping to ping.
#[derive(Default)]
struct State {
    tracks: NodeTracks,
    /// Nodes along the line, how many of them have gains, and the weights of every block on them.
    nodes: Vec<f64>,
    gain_nodes: usize,
    along_m: Vec<f64>,
    blocks: Vec<BlockWeights>,
    batches: Vec<Batch>,
    /// Echoes in order: batch and index.
    order: Vec<u32>,
    /// First echo of every bucket in `order`.
    firsts: Vec<u32>,
    chunks: Vec<EchoChunk>,
    slabs: Vec<SlabPlan>,
    /// Energy by part of a slab and column; the parts are as long as a part of the pulse.
    energy: Vec<f32>,
    outputs: Vec<Aligned>,
    geometry: Vec<Mutex<Solving>>,
    work: Vec<Mutex<Work>>,
}

/// Buffers of one thread.
#[derive(Default)]
struct Work {
    located: Box<Located>,
    grid: Aligned,
    scratch: Aligned,
}

/// Buffers of one thread while it solves echoes at the nodes.
#[derive(Default)]
struct Solving {
    work: NodeWorkspace,
    solved: Box<NodeBatch>,
}

/// Stored geometry of [`CHUNK`] scatterers.
struct Batch {
    chunk: EchoChunk,
    bucket: [u32; CHUNK],
    /// Energy, and its place in [`State::energy`].
    energy: [f32; CHUNK],
    energy_at: [u32; CHUNK],
    counts: EchoCounts,
}

impl Default for Batch {
    fn default() -> Self {
        Self {
            chunk: EchoChunk::default(),
            bucket: [NOWHERE; CHUNK],
            energy: [0.0; CHUNK],
            energy_at: [0; CHUNK],
            counts: EchoCounts::default(),
        }
    }
}

/// Parts of a slab, each a part of a pulse long.
struct Parts {
    parts: usize,
    /// Parts of a bucket.
    per_part: f64,
}

/// One slab of a ping.
#[derive(Clone, Default)]
struct SlabPlan {
    /// First sample of its transform, relative to the record.
    origin: isize,
    /// Time of its first row after the start of the pulse, seconds.
    start_s: f64,
    /// Its echoes in the order of arrival.
    echoes: std::ops::Range<usize>,
    /// Chunks of its echoes.
    chunks: std::ops::Range<usize>,
    first_column: i32,
    columns: usize,
}

impl GriddedLines {
    /// Designs and builds the engine.
    ///
    /// Returns a [`Refusal`] if no sizes keep the tolerance.
    pub fn new(spec: &Spec) -> Result<Self, Refusal> {
        Self::of_design(spec, Design::new(spec)?)
    }

    /// Builds the engine of a design for the same requirements. Build it inside the thread pool that runs it.
    ///
    /// Returns a [`Refusal`] if there is no receiver filter.
    pub fn of_design(spec: &Spec, design: Design) -> Result<Self, Refusal> {
        let filter = spec.filter.ok_or(Refusal::NoFilter)?;
        let forward = BatchedFft::new(design.slab_rows);
        let inverse = BatchedFft::new(design.slab_samples);
        let (rows, samples) = (design.slab_rows, design.slab_samples);
        let forward_half = BatchedFft::new(rows / 2);
        let places_of = |fft: &BatchedFft<f32>, size: usize| {
            let mut row_of_bin = vec![0u32; size];
            for (row, frequency) in fft.frequencies().enumerate() {
                row_of_bin[frequency] = row as u32;
            }
            row_of_bin
        };
        let row_of_bin = places_of(&forward, rows);
        let row_of_half = places_of(&forward_half, rows / 2);
        let mut row_of_sample = vec![0u32; samples];
        for (row, sample) in inverse.frequencies().enumerate() {
            row_of_sample[sample] = row as u32;
        }
        let half = (rows.min(samples) / 2).max((BAND * rows as f64) as usize) as isize;
        let numbers: Vec<isize> = (1 - half..half).collect();
        let bins = numbers.iter().map(|&k| {
            let bin = k.rem_euclid(rows as isize) as usize;
            let (sin, cos) = libm::sincos(-TAU * bin as f64 / rows as f64);
            Bin {
                cell: row_of_bin[bin],
                cell_of_two: row_of_half[bin % (rows / 2)],
                turn: Complex::new(cos as f32, sin as f32),
                to: k.rem_euclid(samples as isize) as u32,
            }
        });
        let bins = bins.collect();
        let templates = templates(spec, &design, filter, &numbers);
        let array = spec.array;
        let near_m = design.near_m(array);
        let coarse_m = design.coarse_m(array);
        Ok(Self {
            simd_level: spec.simd_level,
            array: spec.array.clone(),
            sample_rate_hz: spec.sample_rate_hz,
            pulse_s: spec.pulse.duration_s,
            tolerance: spec.tolerance,
            forward,
            forward_half,
            inverse,
            bins,
            templates,
            models_curvature: spec.doppler == DopplerModel::StretchQuadratic
                && design.columns.taps > 2,
            near_m,
            coarse_m,
            row_of_sample,
            design,
            state: State::default(),
        })
    }

    /// Predicted windowed error, and cost in milliseconds of one core per ping.
    pub fn error_model(&self) -> &ErrorModel {
        self.design.error_model()
    }

    /// Length of the pulse that the engine is made for, seconds.
    pub fn pulse_s(&self) -> f64 {
        self.pulse_s
    }

    /// Exchanges the buffers with those of another engine for the same array, so that a change of engines allocates nothing.
    pub fn swap_buffers(&mut self, other: &mut Self) {
        std::mem::swap(&mut self.state, &mut other.state);
        // They depend on the engine's own nodes.
        self.state.nodes.clear();
        other.state.nodes.clear();
    }

    /// Makes room for every thread of the current pool.
    fn make_room(&mut self) {
        let threads = rayon::current_num_threads();
        let fft_scratch = [&self.forward, &self.forward_half, &self.inverse]
            .map(BatchedFft::scratch_len)
            .into_iter()
            .fold(0, usize::max);
        let State { geometry, work, .. } = &mut self.state;
        if work.len() < threads {
            geometry.resize_with(threads, Mutex::default);
            work.resize_with(threads, Mutex::default);
        }
        for work in work {
            let scratch = &mut work
                .get_mut()
                .unwrap_or_else(PoisonError::into_inner)
                .scratch;
            if scratch.len() < fft_scratch {
                scratch.clear();
                scratch.resize_zeros(fft_scratch);
            }
        }
    }

    /// Synthesises one ping. Overwrites `iq`, element-major as in [`echotank_core::ping::ElementFrame`]. The samples are the same bits for any
    /// number of threads. It allocates nothing after the largest ping.
    ///
    /// Where scatterers are nearer than any number of nodes allows, or faster than the columns, their echoes are counted as beyond the engine.
    pub fn synthesise(
        &mut self,
        plan: &PingPlan,
        transmit_leg: &TransmitLeg,
        iq: &mut [Complex64],
    ) -> EchoCounts {
        assert_eq!(
            iq.len(),
            self.array.elements * plan.sample_count,
            "element-major samples"
        );
        self.make_room();
        let mut counts = self.solve(plan, transmit_leg);
        let all = transmit_leg.len() as u64 * self.array.elements as u64;
        self.sort(&mut counts);
        counts.outside_window = all.saturating_sub(counts.used + counts.culled);
        self.run_tasks(plan);
        self.assemble(plan, iq);
        counts
    }

    /// Half the length of the line, metres.
    fn half_m(&self) -> f64 {
        0.5 * (self.array.elements - 1) as f64 * self.array.spacing_m
    }

    /// Time of a slab's first row after the start of the pulse, seconds.
    fn slab_start_s(&self, plan: &PingPlan, origin: isize) -> f64 {
        plan.first_sample_s + origin as f64 / self.sample_rate_hz
    }

    fn rows_per_s(&self) -> f64 {
        self.sample_rate_hz * self.design.slab_rows as f64 / self.design.slab_samples as f64
    }

    /// Number of slabs of a ping.
    fn slab_count(&self, plan: &PingPlan) -> usize {
        let Design {
            payload, extent, ..
        } = self.design;
        (plan.sample_count + 2 * extent) / payload + 1
    }

    /// Parts of a slab of so many buckets.
    fn parts(&self, buckets: usize) -> Parts {
        let pulse_rows = self.pulse_s * self.rows_per_s();
        let of_part = ((pulse_rows / PARTS_OF_PULSE) as usize / BUCKET_ROWS).max(1);
        Parts {
            parts: buckets.div_ceil(of_part),
            // Of whole numbers, whose quotients lie a part of a bucket from the next one.
            per_part: (1.0 + 1e-9) / of_part as f64,
        }
    }

    /// First sample of slab `s`.
    fn slab_origin(&self, s: usize) -> isize {
        let Design {
            payload,
            extent,
            guard,
            ..
        } = self.design;
        (s * payload) as isize - (2 * extent + guard) as isize
    }

    /// The echoes at the nodes, batch by batch.
    fn solve(&mut self, plan: &PingPlan, transmit_leg: &TransmitLeg) -> EchoCounts {
        let (half_m, spacing_m) = (self.half_m(), self.array.spacing_m);
        let near_m = self.near_m;
        let finite = near_m
            .iter()
            .chain(&self.coarse_m)
            .filter(|m| m.is_finite());
        let enough_m = finite.copied().fold(0.0, f64::max);
        let nearest_m = self
            .state
            .tracks
            .measure(plan, &self.array, transmit_leg, enough_m);
        let enough = (0..NODES.len()).find(|&k| nearest_m >= near_m[k]);
        let selected = enough.unwrap_or(NODES.len() - 1);
        let NodeCounts {
            delays: count,
            gains,
        } = NODES[selected];
        let coarse_m = self.coarse_m[selected];
        let (per_s, slabs) = (self.rows_per_s(), self.slab_count(plan));
        let Design {
            payload,
            extent,
            step,
            reach,
            ..
        } = self.design;
        let per_step = if step > 0.0 { 1.0 / step } else { 0.0 };
        let buckets_per_s = per_s / BUCKET_ROWS as f64;
        let (first_s, rate_hz) = (plan.first_sample_s, self.sample_rate_hz);
        let first_middle_s = first_s - extent as f64 / rate_hz;
        let per_payload = rate_hz / payload as f64;
        let buckets = (payload as f64 * buckets_per_s / rate_hz).ceil() as usize + 1;
        // Place of energies by slab, part and column.
        let Parts { per_part, parts } = self.parts(buckets);
        let width = 2 * reach + 1;
        let array = &self.array;
        let state = &mut self.state;
        if (state.nodes.len(), state.gain_nodes) != (count, gains) {
            state.gain_nodes = gains;
            state.nodes.clear();
            state.nodes.extend(places(count));
            let nodes = &state.nodes;
            state.along_m.clear();
            state.along_m.extend(nodes.iter().map(|at| at * half_m));
            let per_element = spacing_m / half_m;
            state.blocks.clear();
            state
                .blocks
                .extend((0..array.elements.div_ceil(LANES)).map(|block| {
                    let lanes = lanes_for(array.elements - block * LANES);
                    let middle = (block * LANES) as f64 + 0.5 * (lanes as f64 - 1.0);
                    let x = (middle - 0.5 * (array.elements - 1) as f64) * per_element;
                    block_weights(nodes, gains, lanes, x, per_element)
                }));
        }
        let matrix = coefficients(&state.nodes);
        state
            .tracks
            .compute(plan, array, transmit_leg, &state.along_m, gains, coarse_m);
        let batches = NodeTracks::batches(transmit_leg);
        if state.batches.len() < batches {
            state.batches.resize_with(batches, Batch::default);
        }
        let models_curvature = self.models_curvature;
        // Change of the Doppler along a block, of that between the first and the last node; steps.
        let half_block_m = 0.5 * array.elements.min(LANES) as f64 * spacing_m;
        let block_share = half_block_m / (state.along_m[count - 1] - state.along_m[0]);
        let max_swing = (self.design.max_swing_rad
            / self.design.columns.turn_rad.max(1e-12)
            / block_share) as f32;
        let max_curvature_rad = self.design.max_curvature_rad as f32;
        let half_s = 0.5 * plan.pulse.duration_s;
        let carrier_hz = plan.pulse.center_frequency_hz;
        let is_arc = array.radius_m.is_some();
        let (tracks, geometry) = (&state.tracks, &state.geometry);
        state.batches[..batches]
            .par_iter_mut()
            .enumerate()
            .for_each(|(b, batch)| {
                let thread = rayon::current_thread_index().unwrap_or(0);
                // A panic in another ping leaves the buffers as good as any: every use overwrites them.
                let mut work = geometry[thread]
                    .lock()
                    .unwrap_or_else(PoisonError::into_inner);
                let Solving { work, solved } = &mut *work;
                batch.counts = tracks.batch(plan, array, transmit_leg, b, work, solved);
                let Batch {
                    chunk,
                    bucket,
                    energy,
                    energy_at,
                    ..
                } = batch;
                let beyond = widest(
                    #[inline(always)]
                    || {
                        chunk.len = solved.len;
                        expand(&matrix, &solved.middle_s[..count], per_s, chunk);
                        for k in 0..gains {
                            for i in 0..CHUNK {
                                chunk.gain[k][i] = solved.gain[k][i] as f32;
                                chunk.doppler[k][i] = (solved.doppler[k][i] * per_step) as f32;
                            }
                        }
                        for i in 0..CHUNK {
                            chunk.re[i] = solved.amplitude[i].re as f32;
                            chunk.im[i] = solved.amplitude[i].im as f32;
                        }
                        if models_curvature {
                            let curvature_per_s = &solved.curvature_per_s;
                            delay_by_curvature(chunk, curvature_per_s, half_s, carrier_hz);
                        }
                        let most = (reach + 1) as f32;
                        let middles = &solved.middle_s[count / 2];
                        let mut beyond = 0;
                        for i in 0..CHUNK {
                            let after_s = middles[i] - first_middle_s;
                            let slab = (after_s * per_payload).floor();
                            let inside = solved.keep[i]
                                & (slab >= 0.0)
                                & (slab < slabs as f64)
                                & (i < solved.len);
                            let rest_s = after_s - slab / per_payload;
                            let at = (rest_s * buckets_per_s).max(0.0).min((buckets - 1) as f64);
                            let at = at.floor();
                            let all = (slab * buckets as f64 + at) as u32;
                            bucket[i] = if inside { all } else { NOWHERE };
                            let part = slab * parts as f64 + (at * per_part).floor();
                            let column = chunk.doppler[gains / 2][i].round() + reach as f32;
                            let column = column.max(0.0).min((width - 1) as f32);
                            energy_at[i] = (part * width as f64 + f64::from(column)) as u32;
                            let (re, im) = (chunk.re[i], chunk.im[i]);
                            let gain = match is_arc {
                                false => chunk.gain[gains / 2][i],
                                true => chunk.gain[..gains]
                                    .iter()
                                    .fold(0.0, |most: f32, gain| most.max(gain[i].abs())),
                            };
                            energy[i] = gain * gain * (re * re + im * im);
                            let swing = (chunk.doppler[gains - 1][i] - chunk.doppler[0][i]).abs();
                            let fast = (chunk.doppler[gains / 2][i].abs() > most)
                                | (swing > max_swing)
                                | (models_curvature
                                    & (chunk.curvature_rad[i].abs() > max_curvature_rad));
                            beyond += u64::from(inside & (fast | enough.is_none()));
                        }
                        beyond
                    },
                );
                batch.counts.beyond_engine = beyond * array.elements as u64;
            });
        let mut counts = EchoCounts::default();
        for batch in &state.batches[..batches] {
            counts += batch.counts;
        }
        // What lies past the last batch is of an earlier ping.
        for batch in &mut state.batches[batches..] {
            batch.chunk.len = 0;
            batch.bucket = [NOWHERE; CHUNK];
        }
        state.firsts.clear();
        state.firsts.resize(slabs * buckets + 1, 0);
        let mut plans = std::mem::take(&mut state.slabs);
        plans.clear();
        plans.extend((0..slabs).map(|s| {
            let origin = self.slab_origin(s);
            SlabPlan {
                origin,
                start_s: self.slab_start_s(plan, origin),
                ..SlabPlan::default()
            }
        }));
        self.state.slabs = plans;
        counts
    }

    /// Orders the echoes by slab and arrival, selects the columns of each slab, and gathers the echoes into chunks of one slab.
    fn sort(&mut self, counts: &mut EchoCounts) {
        let per_s = self.rows_per_s();
        let Design { columns, reach, .. } = self.design;
        let of_slab = (self.state.firsts.len() - 1) / self.state.slabs.len().max(1);
        let Parts { parts, .. } = self.parts(of_slab.max(1));
        let beside = (BEYOND_SHARE / WRONG * self.tolerance * self.tolerance) as f32;
        let state = &mut self.state;
        let buckets = state.firsts.len() - 1;
        let slabs = state.slabs.len();
        let per_slab = (buckets / slabs.max(1)).max(1);
        let width = 2 * reach + 1;
        let moving = reach > 0;
        let gains = state.gain_nodes;
        if moving {
            state.energy.clear();
            state.energy.resize(slabs * parts * width, 0.0);
        }
        for batch in &state.batches {
            for (i, &bucket) in batch.bucket[..batch.chunk.len].iter().enumerate() {
                if bucket == NOWHERE {
                    continue;
                }
                state.firsts[bucket as usize + 1] += 1;
                if moving {
                    state.energy[batch.energy_at[i] as usize] += batch.energy[i];
                }
            }
        }
        for k in 0..buckets {
            state.firsts[k + 1] += state.firsts[k];
        }
        let total = state.firsts[buckets] as usize;
        counts.used = total as u64 * self.array.elements as u64;
        state.order.clear();
        state.order.resize(total, 0);
        let mut next = std::mem::take(&mut state.firsts);
        for (b, batch) in state.batches.iter().enumerate() {
            for (i, &bucket) in batch.bucket[..batch.chunk.len].iter().enumerate() {
                if bucket != NOWHERE {
                    let at = &mut next[bucket as usize];
                    state.order[*at as usize] = (b * CHUNK + i) as u32;
                    *at += 1;
                }
            }
        }
        let strongest = windows(&state.energy, width)
            .map(|window| window.by_column().sum())
            .fold(0.0, f32::max);
        // `next` now holds the ends of the buckets.
        let mut chunks = 0;
        for (s, slab) in state.slabs.iter_mut().enumerate() {
            let begin = match s {
                0 => 0,
                _ => next[s * per_slab - 1] as usize,
            };
            let end = next[(s + 1) * per_slab - 1] as usize;
            let of_slab = (end - begin).div_ceil(CHUNK);
            slab.chunks = chunks..chunks + of_slab;
            chunks += of_slab;
            slab.echoes = begin..end;
            (slab.first_column, slab.columns) = match moving {
                false => (0, 1),
                true => {
                    // With the parts before and after, which share windows with it.
                    let begin = (s * parts).saturating_sub(1) * width;
                    let end = (((s + 1) * parts + 1) * width).min(state.energy.len());
                    let energy = &state.energy[begin..end];
                    let (first, last) = used_columns(energy, width, beside, NOISE * strongest);
                    // The taps of echoes at either end.
                    let before = (columns.taps / 2) as i32;
                    let first_column = first as i32 - reach as i32 - before;
                    let count = last - first + 1 + 2 * (columns.taps / 2);
                    (first_column, count.max(columns.taps))
                }
            };
        }
        state.firsts = next;
        // As many as any distribution of the echoes over the slabs needs, so that none allocates later.
        let most = total / CHUNK + slabs;
        if state.chunks.len() < most {
            state.chunks.resize_with(most, EchoChunk::default);
        }
        let nodes = state.tracks.count();
        let (batches, order, slabs) = (&state.batches, &state.order, &state.slabs);
        state.chunks[..chunks]
            .par_iter_mut()
            .enumerate()
            .for_each(|(number, chunk)| {
                let slab = &slabs[slabs.partition_point(|slab| slab.chunks.end <= number)];
                let begin = slab.echoes.start + (number - slab.chunks.start) * CHUNK;
                let ids = &order[begin..slab.echoes.end.min(begin + CHUNK)];
                chunk.len = ids.len();
                let start_s = slab.start_s;
                for (i, &id) in ids.iter().enumerate() {
                    let (from, k) = (&batches[id as usize / CHUNK].chunk, id as usize % CHUNK);
                    chunk.middle[i] = (from.middle[k] - start_s) * per_s;
                    for (to, from) in chunk.along.iter_mut().zip(&from.along[..nodes - 1]) {
                        to[i] = from[k];
                    }
                    for g in 0..gains {
                        chunk.gain[g][i] = from.gain[g][k];
                        chunk.doppler[g][i] = from.doppler[g][k];
                    }
                    chunk.curvature_rad[i] = from.curvature_rad[k];
                    chunk.re[i] = from.re[k];
                    chunk.im[i] = from.im[k];
                }
            });
    }

    fn shape(&self, plan: &PingPlan, slab: &SlabPlan, lanes: usize) -> Shape {
        let Design {
            kernel, columns, ..
        } = &self.design;
        let carrier_hz = plan.pulse.center_frequency_hz;
        let narrow = |weights: &[[f64; WEIGHT_TERMS]; MAX_TAPS]| {
            weights.map(|terms| terms.map(|term| term as f32))
        };
        Shape {
            lanes,
            nodes: self.state.tracks.count(),
            gain_nodes: self.state.gain_nodes,
            rows: self.design.slab_rows,
            columns: slab.columns,
            first_column: slab.first_column,
            taps: columns.taps,
            turn_rad: columns.turn_rad as f32,
            straight_rad: self.design.straight_rad as f32,
            weights: narrow(&columns.weights),
            curvature_weights: self
                .models_curvature
                .then(|| narrow(&columns.curvature.imaginary)),
            sweep_weights: (self.models_curvature && plan.pulse.sweep_hz_per_s() != 0.0)
                .then(|| narrow(&columns.curvature.real)),
            width: kernel.width as f32,
            terms: kernel.terms.map(|term| term as f32),
            turns_per_row: carrier_hz / self.rows_per_s(),
            turns: carrier_hz * (slab.start_s - 0.5 * plan.pulse.duration_s),
        }
    }

    /// Spreads and transforms every slab of every block.
    fn run_tasks(&mut self, plan: &PingPlan) {
        let blocks = self.state.blocks.len();
        let tasks = blocks * self.state.slabs.len();
        let mut outputs = std::mem::take(&mut self.state.outputs);
        if outputs.len() < tasks {
            outputs.resize_with(tasks, Aligned::default);
        }
        let this = &*self;
        outputs[..tasks]
            .par_iter_mut()
            .with_max_len(1)
            .enumerate()
            .for_each(|(task, output)| {
                let slab = &this.state.slabs[task / blocks];
                output.clear();
                output.reserve(this.design.slab_samples * CELL);
                if slab.chunks.is_empty() {
                    return;
                }
                let thread = rayon::current_thread_index().unwrap_or(0);
                // As above.
                let mut work = this.state.work[thread]
                    .lock()
                    .unwrap_or_else(PoisonError::into_inner);
                this.run_task(
                    plan,
                    slab,
                    &this.state.blocks[task % blocks],
                    &mut work,
                    output,
                );
            });
        self.state.outputs = outputs;
    }

    /// One slab of one block: `output` gets `slab_samples` cells, in the order of the inverse transform.
    fn run_task(
        &self,
        plan: &PingPlan,
        slab: &SlabPlan,
        block: &BlockWeights,
        work: &mut Work,
        output: &mut Aligned,
    ) {
        let Work {
            located,
            grid,
            scratch,
        } = work;
        let (lanes, width) = (block.lanes, cell_lanes(block.lanes));
        let shape = self.shape(plan, slab, lanes);
        // Each task leaves zeros.
        let stride = shape.stride();
        let used = shape.columns * stride;
        if grid.len() < used {
            // Room for all columns of any block: a ping of the same size may use more of them.
            let cells = column_stride(shape.rows) * CELL;
            let most = (2 * template_reach(&self.design) + 1) * cells;
            grid.reserve(most.max(used));
            grid.resize_zeros(used);
        }
        let grid = &mut grid.numbers_mut()[..used];
        let scratch = scratch.numbers_mut();
        for chunk in &self.state.chunks[slab.chunks.clone()] {
            add(self.simd_level, &shape, block, chunk, located, grid);
        }
        output.clear();
        output.resize_zeros(self.design.slab_samples * 2 * width);
        let output = output.numbers_mut();
        let first = (slab.first_column + template_reach(&self.design) as i32) as usize;
        let bins = self.bins.len();
        let templates = self.templates[first * bins..].chunks(TOGETHER * bins);
        let forward = match cell_rows(lanes) {
            1 => &self.forward,
            _ => &self.forward_half,
        };
        for (columns, templates) in grid.chunks_mut(TOGETHER * stride).zip(templates) {
            for column in columns.chunks_exact_mut(stride) {
                let table = LaneTable {
                    table: column,
                    stride: 2 * width,
                    first: 0,
                    lanes: width,
                    scratch,
                };
                transform_lanes(self.simd_level, forward, table);
            }
            add_products(
                self.simd_level,
                &shape,
                &self.bins,
                templates,
                columns,
                output,
            );
            columns.fill(0.0);
        }
        let table = LaneTable {
            table: output,
            stride: 2 * width,
            first: 0,
            lanes: width,
            scratch,
        };
        transform_lanes(self.simd_level, &self.inverse, table);
    }

    /// Adds the slabs of each element, in order.
    fn assemble(&self, plan: &PingPlan, iq: &mut [Complex64]) {
        let count = plan.sample_count;
        if count == 0 {
            return;
        }
        let State {
            slabs,
            blocks,
            outputs,
            ..
        } = &self.state;
        iq.par_chunks_mut(count * LANES)
            .enumerate()
            .for_each(|(block, iq)| {
                let (width, blocks) = (cell_lanes(blocks[block].lanes), blocks.len());
                iq.fill(Complex64::ZERO);
                let elements = iq.len() / count;
                for (s, slab) in slabs.iter().enumerate() {
                    let output = outputs[s * blocks + block].numbers();
                    if output.is_empty() {
                        continue;
                    }
                    let begin = slab.origin.max(0);
                    let end = (slab.origin + self.design.slab_samples as isize).min(count as isize);
                    for k in begin..end {
                        let row = self.row_of_sample[(k - slab.origin) as usize] as usize;
                        let cell = &output[row * 2 * width..][..2 * width];
                        for lane in 0..elements {
                            // Real and imaginary parts are exchanged, which makes the transform an inverse one.
                            let value =
                                Complex64::new(cell[width + lane].into(), cell[lane].into());
                            iq[lane * count + k as usize] += value;
                        }
                    }
                }
            });
    }
}

/// Coefficients of the delays along the line from those at the nodes.
#[inline(always)]
fn expand(
    matrix: &[[f64; MAX_NODES]; MAX_NODES],
    middle_s: &[[f64; CHUNK]],
    per_s: f64,
    chunk: &mut EchoChunk,
) {
    let base = &middle_s[middle_s.len() / 2];
    for (order, row) in matrix[..middle_s.len()].iter().enumerate() {
        let mut sum = [0.0f64; CHUNK];
        for (weight, at_s) in row.iter().zip(middle_s) {
            for ((sum, at_s), base) in sum.iter_mut().zip(at_s).zip(base) {
                *sum += weight * (at_s - base);
            }
        }
        match order {
            0 => {
                for ((middle, sum), base) in chunk.middle.iter_mut().zip(&sum).zip(base) {
                    *middle = base + sum;
                }
            }
            _ => {
                for (along, sum) in chunk.along[order - 1].iter_mut().zip(&sum) {
                    *along = (sum * per_s) as f32;
                }
            }
        }
    }
}

/// Sets the phases at the ends of the pulse from the change of the Doppler. Delays echoes without the phase of the carrier, and turns them by the mean over
/// the pulse; the weights of the columns do the rest, see [`dopplers`](super::dopplers).
#[inline(always)]
fn delay_by_curvature(
    chunk: &mut EchoChunk,
    curvature_per_s: &[f64; CHUNK],
    half_s: f64,
    carrier_hz: f64,
) {
    let half2_s2 = half_s * half_s;
    let rad_per_curvature = TAU * carrier_hz * half2_s2;
    for (i, curvature_per_s) in curvature_per_s.iter().enumerate() {
        chunk.middle[i] += curvature_per_s * half2_s2;
        chunk.curvature_rad[i] = (curvature_per_s * rad_per_curvature) as f32;
        let x = (MEAN_CURVATURE + 1.0) as f32 * chunk.curvature_rad[i];
        let (sine, cosine) = (x - x * x * x / 6.0, 1.0 - 0.5 * x * x);
        let (re, im) = (chunk.re[i], chunk.im[i]);
        chunk.re[i] = re * cosine - im * sine;
        chunk.im[i] = re * sine + im * cosine;
    }
}

/// Energies of two parts that follow each other, by column.
struct Pair<'a>(&'a [f32], &'a [f32]);

impl Pair<'_> {
    fn by_column(&self) -> impl DoubleEndedIterator<Item = f32> + ExactSizeIterator {
        self.0.iter().zip(self.1).map(|(a, b)| a + b)
    }
}

/// All pairs of neighbouring parts.
fn windows(energy: &[f32], width: usize) -> impl Iterator<Item = Pair<'_>> {
    let parts = energy.chunks_exact(width);
    parts.clone().zip(parts.skip(1)).map(|(a, b)| Pair(a, b))
}

/// First and last column, of `width`, beyond which no window has more than a `share` of its energy or of the noise.
fn used_columns(energy: &[f32], width: usize, share: f32, noise: f32) -> (usize, usize) {
    let (mut first, mut last) = (width, 0);
    for window in windows(energy, width) {
        let room = share * window.by_column().sum::<f32>().max(noise);
        let skipped = |of: &mut dyn Iterator<Item = f32>| {
            let mut sum = 0.0;
            let beyond = |power: &f32| {
                sum += *power;
                sum <= room
            };
            of.take_while(beyond).count()
        };
        let before = skipped(&mut window.by_column());
        if before == width {
            continue;
        }
        let after = skipped(&mut window.by_column().rev());
        first = first.min(before);
        last = last.max(width - 1 - after);
    }
    match first <= last {
        true => (first, last),
        false => (width / 2, width / 2),
    }
}

/// Columns of the templates to either side of zero Doppler: the taps of the fastest echoes, too.
fn template_reach(design: &Design) -> usize {
    match design.reach {
        0 => 0,
        reach => reach + design.columns.taps / 2,
    }
}

/// Spectrum of the pulse as each column stretches it, behind the receiver filter, with the correction of the kernel: `[column][bin]`.
fn templates(
    spec: &Spec,
    design: &Design,
    filter: &Decimator,
    bins: &[isize],
) -> Vec<Complex<f32>> {
    let bin_hz = spec.sample_rate_hz / design.slab_samples as f64;
    let carrier_hz = spec.pulse.center_frequency_hz;
    let reach = template_reach(design) as isize;
    let greatest = design.step * reach as f64;
    let highest_hz =
        (0.5 * bin_hz * design.slab_rows as f64 + carrier_hz * greatest) / (1.0 - greatest);
    let spectrum = PulseSpectrum::new(spec.pulse, highest_hz + bin_hz);
    let commons: Vec<f64> = bins
        .iter()
        .map(|&k| {
            let per_row = k as f64 / design.slab_rows as f64;
            bin_hz * filter.gain(k as f64 * bin_hz) / design.kernel.gain(per_row)
        })
        .collect();
    let of_column = |column: isize| {
        let stretch = design.step * column as f64;
        let per = 1.0 / (1.0 + stretch);
        let spectrum = &spectrum;
        bins.iter().zip(&commons).map(move |(&k, common)| {
            let at_hz = (k as f64 * bin_hz - carrier_hz * stretch) * per;
            let value = spectrum.at(at_hz) * (common * per);
            Complex::new(value.re as f32, value.im as f32)
        })
    };
    (-reach..=reach).flat_map(of_column).collect()
}
