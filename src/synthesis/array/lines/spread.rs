//! The inner loop: echoes of one chunk onto the grid of one block of elements.
//!
//! A grid has rows of delay; a row has columns of Doppler; a cell has the real parts of [`LANES`] neighbouring elements and then their
//! imaginary parts.

use std::f32::consts::TAU;

use crate::arrivals::CHUNK;
use crate::echo::walk::{GAIN_NODES, MAX_NODES};
use echotank_core::simd::{Kind, SimdLevel};

use super::dopplers::{MAX_TAPS, WEIGHT_TERMS};
use super::kernel::TERMS;
use super::nodes::BlockWeights;

/// Elements of a block.
pub(super) const LANES: usize = 16;
/// Numbers of a cell.
pub(super) const CELL: usize = 2 * LANES;
/// The middle of a block lies at this lane.
const MIDDLE: f32 = 0.5 * (LANES as f32 - 1.0);

/// Echoes of one slab at the nodes of the line, in order of delay.
pub(super) struct EchoChunk {
    pub len: usize,
    /// Arrival of mid-pulse, rows of the slab's grid: `[node * CHUNK + echo]`.
    pub middle: Vec<f64>,
    /// Stretch, steps of columns.
    pub doppler: [[f32; CHUNK]; GAIN_NODES],
    pub gain: [[f32; CHUNK]; GAIN_NODES],
    pub re: [f32; CHUNK],
    pub im: [f32; CHUNK],
}

impl Default for EchoChunk {
    fn default() -> Self {
        let zero = [0.0; CHUNK];
        Self {
            len: 0,
            middle: vec![0.0; MAX_NODES * CHUNK],
            doppler: [zero; GAIN_NODES],
            gain: [zero; GAIN_NODES],
            re: zero,
            im: zero,
        }
    }
}

/// Numbers that all echoes of a task share.
#[derive(Clone, Copy, Debug)]
pub(super) struct Shape {
    pub nodes: usize,
    /// Rows of the grid.
    pub rows: usize,
    /// Columns of the grid, and the first one's Doppler in steps.
    pub columns: usize,
    pub first_column: i32,
    pub taps: usize,
    pub weights: [[f32; WEIGHT_TERMS]; MAX_TAPS],
    /// Width of the kernel, rows, and its coefficients.
    pub width: f32,
    pub terms: [f32; TERMS],
    /// Carrier cycles per row, and the carrier's phase at row 0, cycles.
    pub turns_per_row: f64,
    pub turns: f64,
}

/// A chunk at one block.
pub(super) struct Located {
    /// First row and number of rows.
    row: [u32; CHUNK],
    rows: [u32; CHUNK],
    /// Middle of the block after the first row, rows; its change per element and element squared.
    x: [f32; CHUNK],
    slope: [f32; CHUNK],
    bend: [f32; CHUNK],
    /// Phase in the middle, cycles.
    turns: [f32; CHUNK],
    re: [f32; CHUNK],
    im: [f32; CHUNK],
    /// Relative change of the amplitude per element.
    fade: [f32; CHUNK],
    column: [u32; CHUNK],
    weight: [[f32; CHUNK]; MAX_TAPS],
    /// Change of the weight per element, from the change of the Doppler along the block.
    weight_slope: [[f32; CHUNK]; MAX_TAPS],
}

impl Default for Located {
    fn default() -> Self {
        let (zero, none) = ([0.0; CHUNK], [0; CHUNK]);
        Self {
            row: none,
            rows: none,
            x: zero,
            slope: zero,
            bend: zero,
            turns: zero,
            re: zero,
            im: zero,
            fade: zero,
            column: none,
            weight: [zero; MAX_TAPS],
            weight_slope: [zero; MAX_TAPS],
        }
    }
}

/// Adds the echoes of `chunk` to the grid of a block: `rows * columns * CELL` numbers.
pub(super) fn add(
    simd_level: SimdLevel,
    shape: &Shape,
    block: &BlockWeights,
    chunk: &EchoChunk,
    located: &mut Located,
    grid: &mut [f32],
) {
    assert_eq!(grid.len(), shape.rows * shape.columns * CELL, "grid");
    assert!(
        (1..=MAX_TAPS).contains(&shape.taps) && shape.taps <= shape.columns,
        "{} taps of {} columns",
        shape.taps,
        shape.columns
    );
    if simd_level.kind() == Kind::Portable {
        locate::<false>(shape, block, chunk, located);
        spread::<false>(shape, chunk.len, located, grid);
    } else {
        simd_level.run(
            #[inline(always)]
            || {
                locate::<true>(shape, block, chunk, located);
                spread::<true>(shape, chunk.len, located, grid);
            },
        );
    }
}

/// a b + c, rounded once if `FUSED`.
#[inline(always)]
fn mul_add<const FUSED: bool>(a: f32, b: f32, c: f32) -> f32 {
    if FUSED { a.mul_add(b, c) } else { a * b + c }
}

#[inline(always)]
fn locate<const FUSED: bool>(
    shape: &Shape,
    block: &BlockWeights,
    chunk: &EchoChunk,
    out: &mut Located,
) {
    let half_width = 0.5 * f64::from(shape.width);
    let last = shape.rows as f64 - f64::from(shape.width) - 1.0;
    let mut sums = [[0.0f64; CHUNK]; 3];
    for node in 0..shape.nodes.min(MAX_NODES) {
        let middle = &chunk.middle[node * CHUNK..][..CHUNK];
        let [value, slope, bend] = &mut sums;
        let (a, b, c) = (block.value[node], block.slope[node], block.bend[node]);
        for i in 0..CHUNK {
            value[i] += a * middle[i];
            slope[i] += b * middle[i];
            bend[i] += c * middle[i];
        }
    }
    let [value, slope, bend] = &sums;
    let middle = f64::from(MIDDLE);
    // Adding and subtracting this rounds to a whole number.
    const ROUND: f64 = 1.5 * (1u64 << 52) as f64;
    for i in 0..CHUNK {
        let reach = slope[i].abs() * middle + bend[i].abs() * (middle * middle);
        // Smallest whole number not below, largest not above.
        let low = value[i] - reach - half_width;
        let low = low.max(0.0).min(last);
        let whole = (low + ROUND) - ROUND;
        let first = whole + if whole < low { 1.0 } else { 0.0 };
        let high = (value[i] + reach + half_width).min(shape.rows as f64 - 1.0);
        let cycles = -(shape.turns_per_row * value[i] + shape.turns);
        out.row[i] = first as u32;
        out.rows[i] = ((high - first).max(-1.0) + 1.0) as u32;
        out.x[i] = (value[i] - first) as f32;
        out.slope[i] = slope[i] as f32;
        out.bend[i] = bend[i] as f32;
        out.turns[i] = (cycles - ((cycles + ROUND) - ROUND)) as f32;
    }
    let (mut at, mut at_slope) = ([0.0f32; CHUNK], [0.0f32; CHUNK]);
    for i in 0..CHUNK {
        let (mut gain, mut change, mut doppler, mut turning) = (0.0, 0.0, 0.0, 0.0);
        for k in 0..GAIN_NODES {
            gain = mul_add::<FUSED>(block.gain[k], chunk.gain[k][i], gain);
            change = mul_add::<FUSED>(block.gain_slope[k], chunk.gain[k][i], change);
            doppler = mul_add::<FUSED>(block.gain[k], chunk.doppler[k][i], doppler);
            turning = mul_add::<FUSED>(block.gain_slope[k], chunk.doppler[k][i], turning);
        }
        out.re[i] = gain * chunk.re[i];
        out.im[i] = gain * chunk.im[i];
        out.fade[i] = if gain != 0.0 { change / gain } else { 0.0 };
        at[i] = doppler;
        at_slope[i] = turning;
    }
    let middle = 0.5 * (shape.taps as f32 - 1.0);
    let greatest = (shape.columns - shape.taps) as f32;
    for i in 0..CHUNK {
        let place = at[i] - shape.first_column as f32 - middle;
        let column = (place + 0.5).floor().max(0.0).min(greatest);
        out.column[i] = column as u32;
        at[i] = (place - column).max(-0.5).min(0.5);
    }
    let weights = out.weight.iter_mut().zip(&mut out.weight_slope);
    for ((weight, change), terms) in weights.zip(&shape.weights).take(shape.taps) {
        for i in 0..CHUNK {
            // Horner's scheme for the polynomial and its derivative.
            let (mut sum, mut slope) = (terms[WEIGHT_TERMS - 1], 0.0);
            for term in terms[..WEIGHT_TERMS - 1].iter().rev() {
                slope = mul_add::<FUSED>(slope, at[i], sum);
                sum = mul_add::<FUSED>(sum, at[i], *term);
            }
            weight[i] = sum;
            change[i] = slope * at_slope[i];
        }
    }
}

#[inline(always)]
fn spread<const FUSED: bool>(shape: &Shape, len: usize, located: &Located, grid: &mut [f32]) {
    match shape.taps {
        1 => spread_on::<1, FUSED>(shape, len, located, grid),
        2 => spread_on::<2, FUSED>(shape, len, located, grid),
        3 => spread_on::<3, FUSED>(shape, len, located, grid),
        _ => spread_on::<MAX_TAPS, FUSED>(shape, len, located, grid),
    }
}

/// Cosine and sine of `x` turns; error 4e-7 for |x| below 100.
#[inline(always)]
fn turn<const FUSED: bool>(x: &[f32; LANES], cosine: &mut [f32; LANES], sine: &mut [f32; LANES]) {
    // 1.5 * 2^23: the low bits of the sum are the number of quarter turns.
    const ROUND: f32 = 12_582_912.0;
    for lane in 0..LANES {
        let quarters = mul_add::<FUSED>(x[lane], 4.0, ROUND);
        let q = quarters.to_bits();
        // -1/8..1/8 turns
        let z = mul_add::<FUSED>(-(quarters - ROUND), 0.25, x[lane]);
        let z2 = z * z;
        // Least-squares polynomials: errors 1e-9 and 3e-8.
        let s = mul_add::<FUSED>(z2, -75.239_84, 81.588_12);
        let s = mul_add::<FUSED>(z2, s, -41.341_63);
        let s = z * mul_add::<FUSED>(z2, s, TAU);
        let c = mul_add::<FUSED>(z2, -83.592_21, 64.921_24);
        let c = mul_add::<FUSED>(z2, c, -19.739_152);
        let c = mul_add::<FUSED>(z2, c, 1.0);
        let (s, c) = (s.to_bits(), c.to_bits());
        let swap = 0u32.wrapping_sub(q & 1);
        cosine[lane] = f32::from_bits((c & !swap | s & swap) ^ ((q.wrapping_add(1) & 2) << 30));
        sine[lane] = f32::from_bits((s & !swap | c & swap) ^ ((q & 2) << 30));
    }
}

#[inline(always)]
fn spread_on<const TAPS: usize, const FUSED: bool>(
    shape: &Shape,
    len: usize,
    located: &Located,
    grid: &mut [f32],
) {
    let stride = shape.columns * CELL;
    let per_half = 2.0 / shape.width;
    let turns_per_row = shape.turns_per_row as f32;
    let [a, b, c, d] = shape.terms;
    let mut lanes = [0.0f32; LANES];
    for (lane, place) in lanes.iter_mut().enumerate() {
        *place = lane as f32 - MIDDLE;
    }
    for i in 0..len.min(CHUNK) {
        let (x0, slope, bend) = (located.x[i], located.slope[i], located.bend[i]);
        let (mut x, mut cycles) = ([0.0f32; LANES], [0.0f32; LANES]);
        let (mut re, mut im) = ([0.0f32; LANES], [0.0f32; LANES]);
        for lane in 0..LANES {
            let off = lanes[lane] * mul_add::<FUSED>(bend, lanes[lane], slope);
            x[lane] = (x0 + off) * per_half;
            cycles[lane] = mul_add::<FUSED>(-off, turns_per_row, located.turns[i]);
        }
        let (mut cosine, mut sine) = ([0.0f32; LANES], [0.0f32; LANES]);
        turn::<FUSED>(&cycles, &mut cosine, &mut sine);
        let (u, v, fade) = (located.re[i], located.im[i], located.fade[i]);
        for lane in 0..LANES {
            let strength = mul_add::<FUSED>(fade, lanes[lane], 1.0);
            let (cosine, sine) = (strength * cosine[lane], strength * sine[lane]);
            re[lane] = mul_add::<FUSED>(u, cosine, -(v * sine));
            im[lane] = mul_add::<FUSED>(v, cosine, u * sine);
        }
        let mut weights = [[0.0f32; LANES]; TAPS];
        for (tap, weights) in weights.iter_mut().enumerate() {
            let (weight, change) = (located.weight[tap][i], located.weight_slope[tap][i]);
            for lane in 0..LANES {
                weights[lane] = mul_add::<FUSED>(change, lanes[lane], weight);
            }
        }
        let first = located.row[i] as usize * stride + located.column[i] as usize * CELL;
        for row in 0..located.rows[i] as usize {
            let at = first + row * stride;
            let cells = &mut grid[at..at + TAPS * CELL];
            let step = row as f32 * per_half;
            let (mut along_re, mut along_im) = ([0.0f32; LANES], [0.0f32; LANES]);
            for lane in 0..LANES {
                let z = x[lane] - step;
                let t = mul_add::<FUSED>(-z, z, 1.0).max(0.0);
                let k = mul_add::<FUSED>(t, mul_add::<FUSED>(t, d, c), b);
                let k = mul_add::<FUSED>(t, k, a) * (t * t);
                along_re[lane] = k * re[lane];
                along_im[lane] = k * im[lane];
            }
            for (tap, weight) in weights.iter().enumerate() {
                let (to_re, to_im) = cells[tap * CELL..][..CELL].split_at_mut(LANES);
                for lane in 0..LANES {
                    to_re[lane] = mul_add::<FUSED>(weight[lane], along_re[lane], to_re[lane]);
                }
                for lane in 0..LANES {
                    to_im[lane] = mul_add::<FUSED>(weight[lane], along_im[lane], to_im[lane]);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn turns_are_cosines_and_sines_within_1e_6() {
        let mut worst: f64 = 0.0;
        for k in 0..2000 {
            let x: [f32; LANES] =
                std::array::from_fn(|lane| (k * LANES + lane) as f32 * 3.7e-4 - 5.9);
            let (mut cosine, mut sine) = ([0.0; LANES], [0.0; LANES]);
            turn::<false>(&x, &mut cosine, &mut sine);
            for lane in 0..LANES {
                let phase = std::f64::consts::TAU * f64::from(x[lane]);
                worst = worst
                    .max((f64::from(cosine[lane]) - phase.cos()).abs())
                    .max((f64::from(sine[lane]) - phase.sin()).abs());
            }
        }
        println!("{worst:e}");
        assert!(worst < 1e-6, "{worst:e}");
    }
}
