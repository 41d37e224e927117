//! The inner loop: echoes of one chunk onto the grid of one block of elements.
//!
//! A grid has columns of Doppler; a column has rows of delay; a cell has the real parts of [`LANES`] neighbouring elements (of [`NARROW`] in a narrow block) and then their
//! imaginary parts. A cell of a quarter block has two rows of [`QUARTER`] elements, which fill the lanes of a narrow one.

use std::f32::consts::TAU;

use crate::array::gridded::lanes::Lanes;
use crate::arrivals::CHUNK;
use crate::echo::walk::{MAX_GAIN_NODES, MAX_NODES};
use echotank_core::simd::{Kind, SimdLevel};

#[cfg(target_arch = "x86_64")]
use std::arch::x86_64::{__m256, __m512};

use super::dopplers::{MAX_TAPS, WEIGHT_TERMS};
use super::kernel::TERMS;
use super::nodes::{BlockWeights, GAIN_TERMS};

/// Elements of a block.
pub(super) const LANES: usize = 16;
/// Elements of the last block of a line, if no more are left.
pub(super) const NARROW: usize = 8;
/// ... if no more are left.
pub(super) const QUARTER: usize = 4;
/// Numbers of a cell.
pub(super) const CELL: usize = 2 * LANES;

/// Lanes of a block where so many elements of the line are left.
pub(super) const fn lanes_for(left: usize) -> usize {
    if left <= QUARTER {
        QUARTER
    } else if left <= NARROW {
        NARROW
    } else {
        LANES
    }
}

/// Lanes of a cell of a block of so many lanes.
pub(super) const fn cell_lanes(lanes: usize) -> usize {
    match lanes {
        LANES => LANES,
        _ => NARROW,
    }
}

/// Rows of such a cell.
pub(super) const fn cell_rows(lanes: usize) -> usize {
    cell_lanes(lanes) / lanes
}

/// Cells between the columns of a grid with so many of them. The cells of one row in neighbouring columns lie 8 cells apart but for multiples of the page,
/// so that they do not share sets of the innermost cache.
pub(super) fn column_stride(cells: usize) -> usize {
    cells.next_multiple_of(32) + 8
}

/// The middle of a block of so many elements lies at this lane.
const fn middle(lanes: usize) -> f32 {
    0.5 * (lanes as f32 - 1.0)
}

/// Echoes of one slab at the nodes of the line, in order of delay.
pub(super) struct EchoChunk {
    pub len: usize,
    /// Arrival of mid-pulse, rows of the slab's grid: coefficients of Chebyshev polynomials along the line, of which the first is apart.
    pub middle: [f64; CHUNK],
    pub along: [[f32; CHUNK]; MAX_NODES - 1],
    /// Stretch, steps of columns.
    pub doppler: [[f32; CHUNK]; MAX_GAIN_NODES],
    pub gain: [[f32; CHUNK]; MAX_GAIN_NODES],
    /// Phase at the ends of the pulse from the change of the Doppler, radians.
    pub curvature_rad: [f32; CHUNK],
    pub re: [f32; CHUNK],
    pub im: [f32; CHUNK],
}

impl Default for EchoChunk {
    fn default() -> Self {
        let zero = [0.0; CHUNK];
        Self {
            len: 0,
            middle: [0.0; CHUNK],
            along: [zero; MAX_NODES - 1],
            doppler: [zero; MAX_GAIN_NODES],
            gain: [zero; MAX_GAIN_NODES],
            curvature_rad: zero,
            re: zero,
            im: zero,
        }
    }
}

/// Numbers that all echoes of a task share.
#[derive(Clone, Copy, Debug)]
pub(super) struct Shape {
    /// Elements of the block: [`LANES`], [`NARROW`] or [`QUARTER`].
    pub lanes: usize,
    /// Nodes with delays, and those with gains.
    pub nodes: usize,
    pub gain_nodes: usize,
    /// Rows of the grid.
    pub rows: usize,
    /// Columns of the grid, and the first one's Doppler in steps.
    pub columns: usize,
    pub first_column: i32,
    pub taps: usize,
    /// Phase at the ends of the pulse between neighbouring columns, radians, and the largest that the second order along a block may make unless
    /// weights follow it.
    pub turn_rad: f32,
    pub straight_rad: f32,
    pub weights: [[f32; WEIGHT_TERMS]; MAX_TAPS],
    /// Imaginary and real parts of those of the change of the Doppler during the pulse, if it counts; the real parts with a sweep only.
    pub curvature_weights: Option<[[f32; WEIGHT_TERMS]; MAX_TAPS]>,
    pub sweep_weights: Option<[[f32; WEIGHT_TERMS]; MAX_TAPS]>,
    /// Width of the kernel, rows, and its coefficients.
    pub width: f32,
    pub terms: [f32; TERMS],
    /// Carrier cycles per row, and the carrier's phase at row 0, cycles.
    pub turns_per_row: f64,
    pub turns: f64,
}

impl Shape {
    /// Cells of a column.
    pub(super) fn cells(&self) -> usize {
        self.rows / cell_rows(self.lanes)
    }

    /// Numbers from one column to the next.
    pub(super) fn stride(&self) -> usize {
        column_stride(self.cells()) * 2 * cell_lanes(self.lanes)
    }
}

/// A chunk at one block.
pub(super) struct Located {
    /// Echoes by number of cells, so that the processor predicts the loop over them; those without cells are left out.
    len: usize,
    order: [u16; CHUNK + 1],
    /// First cell and number of cells.
    cell: [u32; CHUNK],
    cells: [u32; CHUNK],
    /// Middle of the block after the first row of the first cell, rows; its change per element, element squared and cubed.
    x: [f32; CHUNK],
    slope: [f32; CHUNK],
    curvature: [f32; CHUNK],
    cubic: [f32; CHUNK],
    /// Phase in the middle, cycles.
    turns: [f32; CHUNK],
    re: [f32; CHUNK],
    im: [f32; CHUNK],
    /// Gain as a polynomial of the element, by powers.
    gain: [[f32; CHUNK]; GAIN_TERMS],
    column: [u32; CHUNK],
    weight: [[f32; CHUNK]; MAX_TAPS],
    /// Change of the weight per element, from the change of the Doppler along the block.
    weight_slope: [[f32; CHUNK]; MAX_TAPS],
    /// Its change per element squared, where any echo needs it.
    weight_square: [[f32; CHUNK]; MAX_TAPS],
    bends: bool,
    /// Imaginary part of the weight.
    weight_im: [[f32; CHUNK]; MAX_TAPS],
}

impl Default for Located {
    fn default() -> Self {
        let (zero, none) = ([0.0; CHUNK], [0; CHUNK]);
        Self {
            len: 0,
            order: [0; CHUNK + 1],
            cell: none,
            cells: none,
            x: zero,
            slope: zero,
            curvature: zero,
            cubic: zero,
            turns: zero,
            re: zero,
            im: zero,
            gain: [zero; GAIN_TERMS],
            column: none,
            weight: [zero; MAX_TAPS],
            weight_slope: [zero; MAX_TAPS],
            weight_square: [zero; MAX_TAPS],
            bends: false,
            weight_im: [zero; MAX_TAPS],
        }
    }
}

/// Adds the echoes of `chunk` to the grid of a block: [`Shape::stride`] numbers a column.
pub(super) fn add(
    simd_level: SimdLevel,
    shape: &Shape,
    block: &BlockWeights,
    chunk: &EchoChunk,
    located: &mut Located,
    grid: &mut [f32],
) {
    assert_eq!(grid.len(), shape.columns * shape.stride(), "grid");
    assert!(
        matches!(shape.lanes, LANES | NARROW | QUARTER),
        "{} lanes",
        shape.lanes
    );
    assert!(
        (1..=MAX_TAPS).contains(&shape.taps) && shape.taps <= shape.columns,
        "{} taps of {} columns",
        shape.taps,
        shape.columns
    );
    match simd_level.kind() {
        // SAFETY (of all): a `SimdLevel` of this kind exists only on processors with the features; `locate` keeps all rows in the grid.
        #[cfg(target_arch = "x86_64")]
        Kind::Avx512 if shape.lanes == LANES => unsafe {
            add_avx512(shape, block, chunk, located, grid)
        },
        #[cfg(target_arch = "x86_64")]
        Kind::Avx512 | Kind::Avx2 => unsafe {
            match shape.lanes {
                QUARTER => add_avx2::<QUARTER>(shape, block, chunk, located, grid),
                NARROW => add_avx2::<NARROW>(shape, block, chunk, located, grid),
                _ => add_avx2::<LANES>(shape, block, chunk, located, grid),
            }
        },
        _ => unsafe {
            match shape.lanes {
                QUARTER => add_on::<[f32; 8], QUARTER, false>(shape, block, chunk, located, grid),
                NARROW => add_on::<[f32; 8], NARROW, false>(shape, block, chunk, located, grid),
                _ => add_on::<[f32; 8], LANES, false>(shape, block, chunk, located, grid),
            }
        },
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
    unsafe { add_on::<__m512, LANES, true>(shape, block, chunk, located, grid) }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
unsafe fn add_avx2<const L: usize>(
    shape: &Shape,
    block: &BlockWeights,
    chunk: &EchoChunk,
    located: &mut Located,
    grid: &mut [f32],
) {
    unsafe { add_on::<__m256, L, true>(shape, block, chunk, located, grid) }
}

/// `L`: lanes of the block.
///
/// SAFETY: the processor must have V, and fused multiplication and addition if `FUSED`.
#[inline(always)]
unsafe fn add_on<V: Lanes<Number = f32>, const L: usize, const FUSED: bool>(
    shape: &Shape,
    block: &BlockWeights,
    chunk: &EchoChunk,
    located: &mut Located,
    grid: &mut [f32],
) {
    locate::<L, FUSED>(shape, block, chunk, located);
    order(chunk.len, located);
    // SAFETY: the caller guarantees V.
    unsafe {
        match shape.taps {
            1 => spread::<V, L, 1>(shape, located, grid),
            2 => spread::<V, L, 2>(shape, located, grid),
            3 => spread::<V, L, 3>(shape, located, grid),
            _ => spread::<V, L, MAX_TAPS>(shape, located, grid),
        }
    }
}

/// The smaller and the larger of two numbers; not `min` and `max`, whose treatment of NaN keeps the compiler from vectorising them.
#[inline(always)]
fn least<T: PartialOrd>(a: T, b: T) -> T {
    if a < b { a } else { b }
}

#[inline(always)]
fn greater<T: PartialOrd>(a: T, b: T) -> T {
    if a > b { a } else { b }
}

/// a b + c, rounded once if `FUSED`.
#[inline(always)]
fn mul_add<const FUSED: bool>(a: f32, b: f32, c: f32) -> f32 {
    if FUSED { a.mul_add(b, c) } else { a * b + c }
}

/// Sorts the echoes by number of cells.
#[inline(always)]
fn order(len: usize, located: &mut Located) {
    let cells = &located.cells[..len.min(CHUNK)];
    let (mut least, mut most) = (u32::MAX, 0);
    for &cells in cells {
        least = least.min(cells);
        most = most.max(cells);
    }
    let mut end = 0;
    for wanted in least.max(1)..=most {
        // Without a branch.
        for (i, &cells) in cells.iter().enumerate() {
            located.order[end.min(CHUNK)] = i as u16;
            end += usize::from(cells == wanted);
        }
    }
    located.len = end;
}

#[inline(always)]
fn locate<const L: usize, const FUSED: bool>(
    shape: &Shape,
    block: &BlockWeights,
    chunk: &EchoChunk,
    out: &mut Located,
) {
    let half_width = 0.5 * f64::from(shape.width);
    let last = shape.rows as f64 - f64::from(shape.width) - 1.0;
    let mut later = [0.0f32; CHUNK];
    out.slope = [0.0; CHUNK];
    out.curvature = [0.0; CHUNK];
    out.cubic = [0.0; CHUNK];
    let along = &chunk.along[..shape.nodes.clamp(1, MAX_NODES) - 1];
    for (order, at) in (1..).zip(along) {
        let (a, b) = (block.value[order], block.slope[order]);
        let (c, d) = (block.curvature[order], block.cubic[order]);
        for i in 0..CHUNK {
            later[i] = mul_add::<FUSED>(a, at[i], later[i]);
            out.slope[i] = mul_add::<FUSED>(b, at[i], out.slope[i]);
            out.curvature[i] = mul_add::<FUSED>(c, at[i], out.curvature[i]);
            out.cubic[i] = mul_add::<FUSED>(d, at[i], out.cubic[i]);
        }
    }
    // Adding and subtracting these rounds to a whole number; the low bits of a sum with the third are the number.
    const ROUND: f64 = 1.5 * (1u64 << 52) as f64;
    const ROUND_F32: f32 = 1.5 * (1u32 << 23) as f32;
    const WHOLE: f64 = (1u64 << 52) as f64;
    const WHOLE_F32: f32 = (1u32 << 23) as f32;
    for (i, later) in later.iter().enumerate() {
        let value = chunk.middle[i] + f64::from(*later);
        let end = (out.cubic[i].abs() * middle(L) + out.curvature[i].abs()) * middle(L);
        let reach = f64::from((end + out.slope[i].abs()) * middle(L));
        // Smallest whole number not below, largest not above.
        let low = least(greater(value - reach - half_width, 0.0), last);
        let whole = (low + ROUND) - ROUND;
        let first = whole + if whole < low { 1.0 } else { 0.0 };
        let cell = match cell_rows(L) {
            1 => first,
            _ => (0.5 * first - 0.25 + ROUND) - ROUND,
        };
        let first = cell_rows(L) as f64 * cell;
        let high = least(value + reach + half_width, shape.rows as f64 - 1.0);
        let rows = greater(high - first, -1.0) + 1.0;
        let whole = (rows + ROUND) - ROUND;
        let rows = whole - if whole > rows { 1.0 } else { 0.0 };
        let cells = match cell_rows(L) {
            1 => rows,
            _ => (0.5 * rows + 0.25 + ROUND) - ROUND,
        };
        let cycles = -(shape.turns_per_row * value + shape.turns);
        out.cell[i] = (cell + WHOLE).to_bits() as u32;
        out.cells[i] = (cells + WHOLE).to_bits() as u32;
        out.x[i] = (value - first) as f32;
        out.turns[i] = (cycles - ((cycles + ROUND) - ROUND)) as f32;
    }
    out.re = chunk.re;
    out.im = chunk.im;
    out.gain = [[0.0; CHUNK]; GAIN_TERMS];
    let (mut at, mut at_slope) = ([0.0f32; CHUNK], [0.0f32; CHUNK]);
    let mut at_square = [0.0f32; CHUNK];
    for k in 0..shape.gain_nodes.clamp(1, MAX_GAIN_NODES) {
        let (gain, doppler) = (&chunk.gain[k], &chunk.doppler[k]);
        for (sum, terms) in out.gain.iter_mut().zip(&block.gain) {
            for i in 0..CHUNK {
                sum[i] = mul_add::<FUSED>(terms[k], gain[i], sum[i]);
            }
        }
        for i in 0..CHUNK {
            at[i] = mul_add::<FUSED>(block.gain[0][k], doppler[i], at[i]);
            at_slope[i] = mul_add::<FUSED>(block.gain[1][k], doppler[i], at_slope[i]);
            at_square[i] = mul_add::<FUSED>(block.gain[2][k], doppler[i], at_square[i]);
        }
    }
    let (slope_rad, square_rad) = (
        shape.turn_rad * middle(L),
        shape.turn_rad * middle(L) * middle(L),
    );
    let mut bend_rad = 0.0f32;
    for (slope, square) in at_slope.iter().zip(&at_square).take(chunk.len) {
        let slope = slope * slope_rad;
        bend_rad = greater(bend_rad, 0.5 * slope * slope + (square * square_rad).abs());
    }
    out.bends = bend_rad > shape.straight_rad;
    let middle = 0.5 * (shape.taps as f32 - 1.0);
    let greatest = (shape.columns - shape.taps) as f32;
    for (at, to) in at.iter_mut().zip(&mut out.column) {
        let place = *at - shape.first_column as f32 - middle;
        let column = least(greater((place + ROUND_F32) - ROUND_F32, 0.0), greatest);
        *to = (column + WHOLE_F32).to_bits() & ((1 << 23) - 1);
        *at = least(greater(place - column, -0.5), 0.5);
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
    if out.bends {
        let squares = out.weight_square.iter_mut().zip(&shape.weights);
        for (square, terms) in squares.take(shape.taps) {
            for i in 0..CHUNK {
                // With half the second derivative.
                let (mut sum, mut slope, mut half) = (terms[WEIGHT_TERMS - 1], 0.0, 0.0);
                for term in terms[..WEIGHT_TERMS - 1].iter().rev() {
                    half = mul_add::<FUSED>(half, at[i], slope);
                    slope = mul_add::<FUSED>(slope, at[i], sum);
                    sum = mul_add::<FUSED>(sum, at[i], *term);
                }
                square[i] = half * at_slope[i] * at_slope[i] + slope * at_square[i];
            }
        }
    }
    let Some(curvature_weights) = &shape.curvature_weights else {
        return;
    };
    for (weight, terms) in out
        .weight_im
        .iter_mut()
        .zip(curvature_weights)
        .take(shape.taps)
    {
        for i in 0..CHUNK {
            weight[i] = polynomial::<FUSED>(terms, at[i]) * chunk.curvature_rad[i];
        }
    }
    let Some(sweep_weights) = &shape.sweep_weights else {
        return;
    };
    let weights = out.weight.iter_mut().zip(sweep_weights);
    for (weight, terms) in weights.take(shape.taps) {
        for i in 0..CHUNK {
            let sum = polynomial::<FUSED>(terms, at[i]);
            weight[i] = mul_add::<FUSED>(sum, chunk.curvature_rad[i], weight[i]);
        }
    }
}

/// Horner's scheme.
#[inline(always)]
fn polynomial<const FUSED: bool>(terms: &[f32; WEIGHT_TERMS], x: f32) -> f32 {
    let mut sum = terms[WEIGHT_TERMS - 1];
    for term in terms[..WEIGHT_TERMS - 1].iter().rev() {
        sum = mul_add::<FUSED>(sum, x, *term);
    }
    sum
}

/// Cosine and sine of `x` turns, |x| < 2^22; error 7e-7.
///
/// SAFETY: the processor must have V.
#[inline(always)]
unsafe fn turn<V: Lanes<Number = f32>>(x: V) -> (V, V) {
    // Adding and subtracting this rounds to a whole number.
    const ROUND: f32 = 12_582_912.0;
    // Interpolation in Chebyshev nodes of z^2 over -1/2..1/2 turns: errors 1e-8 and 2e-7.
    const COSINE: [f32; 7] = [
        1.0,
        -19.739_204,
        64.939_12,
        -85.450_14,
        60.167_63,
        -25.967_6,
        6.528_658,
    ];
    const SINE: [f32; 6] = [
        TAU,
        -41.341_59,
        81.599_945,
        -76.614_47,
        41.342_88,
        -12.471_244,
    ];
    // SAFETY: the caller guarantees V.
    unsafe {
        let whole = x.add(V::splat(ROUND)).sub(V::splat(ROUND));
        let z = x.sub(whole);
        let z2 = z.mul(z);
        (horner(&COSINE, z2), horner(&SINE, z2).mul(z))
    }
}

/// SAFETY: the processor must have V.
#[inline(always)]
unsafe fn horner<V: Lanes<Number = f32>, const N: usize>(terms: &[f32; N], x: V) -> V {
    // SAFETY: the caller guarantees V.
    unsafe {
        let mut sum = V::splat(terms[N - 1]);
        for term in terms[..N - 1].iter().rev() {
            sum = sum.mul_add(x, V::splat(*term));
        }
        sum
    }
}

/// SAFETY: the processor must have V.
#[inline(always)]
unsafe fn spread<V: Lanes<Number = f32>, const L: usize, const TAPS: usize>(
    shape: &Shape,
    located: &Located,
    grid: &mut [f32],
) {
    let (width, cell_rows) = (cell_lanes(L), cell_rows(L));
    let stride = shape.stride();
    let per_half = 2.0 / shape.width;
    let turns_per_row = shape.turns_per_row as f32;
    // Element of every lane from the middle of the block, and its row, half widths.
    let (mut elements, mut rows_before) = ([0.0f32; LANES], [0.0f32; LANES]);
    for (lane, (element, row)) in elements.iter_mut().zip(&mut rows_before).enumerate() {
        *element = (lane % L) as f32 - middle(L);
        *row = (lane / L) as f32 * per_half;
    }
    for &i in &located.order[..located.len.min(CHUNK)] {
        let i = i as usize % CHUNK;
        let (count, first) = (located.cells[i] as usize, located.cell[i] as usize);
        // Checks once what the cells below write.
        let begin = located.column[i] as usize * stride + first * 2 * width;
        let cells = &mut grid[begin..begin + (TAPS - 1) * stride + count * 2 * width];
        for part in (0..width).step_by(V::COUNT) {
            // SAFETY: the caller guarantees V; `part` + V's lanes <= `width`; rows and taps lie within `cells`.
            unsafe {
                let place = V::load(elements.as_ptr().add(part));
                let off = V::splat(located.cubic[i])
                    .mul_add(place, V::splat(located.curvature[i]))
                    .mul_add(place, V::splat(located.slope[i]))
                    .mul(place);
                let cycles = off.neg_mul_add(V::splat(turns_per_row), V::splat(located.turns[i]));
                let (cosine, sine) = turn(cycles);
                let [first, slope, square, cube] =
                    located.gain.each_ref().map(|of| V::splat(of[i]));
                let strength = cube
                    .mul_add(place, square)
                    .mul_add(place, slope)
                    .mul_add(place, first);
                let (cosine, sine) = (cosine.mul(strength), sine.mul(strength));
                let (u, v) = (V::splat(located.re[i]), V::splat(located.im[i]));
                let re = u.mul_sub(cosine, v.mul(sine));
                let im = v.mul_add(cosine, u.mul(sine));
                // A loop: closures that are not inlined would call every instruction.
                let mut parts = [(re, im); TAPS];
                for (tap, part) in parts.iter_mut().enumerate() {
                    let mut slope = V::splat(located.weight_slope[tap][i]);
                    if located.bends {
                        slope = V::splat(located.weight_square[tap][i]).mul_add(place, slope);
                    }
                    let weight = slope.mul_add(place, V::splat(located.weight[tap][i]));
                    *part = (re.mul(weight), im.mul(weight));
                    if shape.curvature_weights.is_some() {
                        let across = V::splat(located.weight_im[tap][i]);
                        *part = (im.neg_mul_add(across, part.0), re.mul_add(across, part.1));
                    }
                }
                let (one, zero) = (V::splat(1.0), V::splat(0.0));
                let step = V::splat(cell_rows as f32 * per_half);
                let mut z = off.add(V::splat(located.x[i])).mul(V::splat(per_half));
                if cell_rows > 1 {
                    z = z.sub(V::load(rows_before.as_ptr().add(part)));
                }
                let mut to = cells.as_mut_ptr().add(part);
                for _ in 0..count {
                    let t = z.neg_mul_add(z, one).max(zero);
                    let k = horner(&shape.terms, t).mul(t);
                    for (tap, (re, im)) in parts.iter().enumerate() {
                        let (at_re, at_im) = (to.add(tap * stride), to.add(tap * stride + width));
                        re.mul_add(k, V::load(at_re)).store(at_re);
                        im.mul_add(k, V::load(at_im)).store(at_im);
                    }
                    z = z.sub(step);
                    to = to.wrapping_add(2 * width);
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
            // SAFETY: every processor has arrays.
            let (low, high) = unsafe {
                let half = |from: usize| turn(<[f32; 8]>::load(x[from..].as_ptr()));
                (half(0), half(8))
            };
            let cosine: Vec<f32> = low.0.into_iter().chain(high.0).collect();
            let sine: Vec<f32> = low.1.into_iter().chain(high.1).collect();
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
