//! The inner loop: echoes of one chunk onto the grid of one block of elements.
//!
//! A grid has rows of delay; a row has columns of Doppler; a cell has the real parts of [`LANES`] neighbouring elements and then their
//! imaginary parts.

use std::f32::consts::TAU;

use crate::array::gridded::lanes::Lanes;
use crate::arrivals::CHUNK;
use crate::echo::walk::{GAIN_NODES, MAX_NODES};
use echotank_core::simd::{Kind, SimdLevel};

#[cfg(target_arch = "x86_64")]
use std::arch::x86_64::{__m256, __m512};

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
    match simd_level.kind() {
        // SAFETY (of the three): a `SimdLevel` of this kind exists only on processors with the features; `locate` keeps all rows in the grid.
        #[cfg(target_arch = "x86_64")]
        Kind::Avx512 => unsafe { add_avx512(shape, block, chunk, located, grid) },
        #[cfg(target_arch = "x86_64")]
        Kind::Avx2 => unsafe { add_avx2(shape, block, chunk, located, grid) },
        _ => unsafe { add_on::<[f32; 8], false>(shape, block, chunk, located, grid) },
    }
}

// SAFETY (of both): the processor must have the features; as `add_on`.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512dq,avx512vl,avx2,fma")]
unsafe fn add_avx512(
    shape: &Shape,
    block: &BlockWeights,
    chunk: &EchoChunk,
    located: &mut Located,
    grid: &mut [f32],
) {
    unsafe { add_on::<__m512, true>(shape, block, chunk, located, grid) }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
unsafe fn add_avx2(
    shape: &Shape,
    block: &BlockWeights,
    chunk: &EchoChunk,
    located: &mut Located,
    grid: &mut [f32],
) {
    unsafe { add_on::<__m256, true>(shape, block, chunk, located, grid) }
}

/// SAFETY: the processor must have V, and fused multiplication and addition if `FUSED`.
#[inline(always)]
unsafe fn add_on<V: Lanes<Number = f32>, const FUSED: bool>(
    shape: &Shape,
    block: &BlockWeights,
    chunk: &EchoChunk,
    located: &mut Located,
    grid: &mut [f32],
) {
    locate::<FUSED>(shape, block, chunk, located);
    // SAFETY: the caller guarantees V.
    unsafe {
        match shape.taps {
            1 => spread::<V, 1, FUSED>(shape, chunk.len, located, grid),
            2 => spread::<V, 2, FUSED>(shape, chunk.len, located, grid),
            3 => spread::<V, 3, FUSED>(shape, chunk.len, located, grid),
            _ => spread::<V, MAX_TAPS, FUSED>(shape, chunk.len, located, grid),
        }
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
    for (at, to) in at.iter_mut().zip(&mut out.column) {
        let place = *at - shape.first_column as f32 - middle;
        let column = (place + 0.5).floor().max(0.0).min(greatest);
        *to = column as u32;
        *at = (place - column).clamp(-0.5, 0.5);
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

/// SAFETY: the processor must have V.
#[inline(always)]
unsafe fn spread<V: Lanes<Number = f32>, const TAPS: usize, const FUSED: bool>(
    shape: &Shape,
    len: usize,
    located: &Located,
    grid: &mut [f32],
) {
    let stride = shape.columns * CELL;
    let per_half = 2.0 / shape.width;
    let turns_per_row = shape.turns_per_row as f32;
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
        let (rows, first) = (located.rows[i] as usize, located.row[i] as usize);
        if rows == 0 {
            continue;
        }
        // Checks once what the rows below write.
        let begin = first * stride + located.column[i] as usize * CELL;
        let cells = &mut grid[begin..begin + (rows - 1) * stride + TAPS * CELL];
        for part in (0..LANES).step_by(V::COUNT) {
            // SAFETY: the caller guarantees V; `part` + V's lanes <= LANES; rows and taps lie within `cells`.
            unsafe {
                let x = V::load(x.as_ptr().add(part));
                let (re, im) = (
                    V::load(re.as_ptr().add(part)),
                    V::load(im.as_ptr().add(part)),
                );
                let place = V::load(lanes.as_ptr().add(part));
                let weights: [V; TAPS] = std::array::from_fn(|tap| {
                    let change = V::splat(located.weight_slope[tap][i]);
                    change.mul_add(place, V::splat(located.weight[tap][i]))
                });
                let [a, b, c, d] = shape.terms.map(|term| V::splat(term));
                let (one, zero) = (V::splat(1.0), V::splat(0.0));
                let mut to = cells.as_mut_ptr().add(part);
                for row in 0..rows {
                    let z = x.sub(V::splat(row as f32 * per_half));
                    let t = one.sub(z.mul(z)).max(zero);
                    let k = t.mul_add(t.mul_add(t.mul_add(d, c), b), a).mul(t.mul(t));
                    let (along_re, along_im) = (k.mul(re), k.mul(im));
                    for (tap, weight) in weights.iter().enumerate() {
                        let (at_re, at_im) = (to.add(tap * CELL), to.add(tap * CELL + LANES));
                        weight.mul_add(along_re, V::load(at_re)).store(at_re);
                        weight.mul_add(along_im, V::load(at_im)).store(at_im);
                    }
                    to = to.wrapping_add(stride);
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
