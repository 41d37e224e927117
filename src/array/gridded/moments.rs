//! Points into moments, moments onto the grid: the two hot loops, for f32 and f64.
//!
//! In: points located in cells. Per point one (or, over a second dimension, a few neighbouring) aligned rows of a table of moments get
//! c x^k added, whatever the kernel's width; nothing is sorted. Out: grid values, a (width x moments) matrix per cell.
//!
//! The table is cell-major with `columns` rows per cell; the last cell is a drain for points that lie nowhere.
//! Every loop exists once in plain Rust here and, where the processor has it, in [`super::avx2`] and [`super::avx512`].

use num_complex::{Complex, Complex32, Complex64};
use rustfft::FftNum;

use super::dialect::Dialect;
use super::kernel::{Kernel, MAX_WIDTH};

/// Points worked on together.
pub const BLOCK: usize = 256;

/// Weights per point in the second dimension, at most.
pub const MAX_TAPS: usize = 8;

/// Moments of one cell: 8 complex f32 (one cache line) or 12 complex f64 (three), interleaved re, im.
#[derive(Clone, Copy, Debug)]
#[repr(C, align(64))]
pub struct Row<R, const N: usize>(pub [R; N]);

pub type Row32 = Row<f32, 16>;
pub type Row64 = Row<f64, 24>;

/// Up to [`BLOCK`] points, structure of arrays; all slices have the same length, but for `weight`.
#[derive(Clone, Copy, Debug)]
pub struct Points<'a, T> {
    /// First row each point adds to: its cell times the columns, plus its column.
    pub row: &'a [u32],
    /// Place across the cell, -1..1.
    pub x: &'a [T],
    pub amplitude: &'a [Complex<T>],
    /// Rows that each point adds to: `row`, `row + 1`, ...
    pub taps: usize,
    /// Of these rows, `taps` of each point's are read. With one tap the weight is 1 and nothing is read; empty will do.
    pub weight: &'a [[T; MAX_TAPS]],
}

/// Cells and places of up to [`BLOCK`] points, as [`locate`] finds them.
#[derive(Clone, Debug)]
pub struct Located<T> {
    pub row: [u32; BLOCK],
    pub x: [T; BLOCK],
}

/// The real numbers that moments are made of.
pub trait Real: FftNum + Default {
    type Row: Copy + Send + Sync + std::fmt::Debug;
    /// Complex moments per row.
    const MOMENTS: usize;
    const EMPTY: Self::Row;

    /// Rounds to this precision.
    fn narrow(value: f64) -> Self;

    /// Adds every point's moments. Panics if a point's last row is outside `rows`.
    fn accumulate(dialect: Dialect, points: Points<Self>, rows: &mut [Self::Row]);

    /// Puts column `column` of all cells but the drain on the grid: `out[cell + i]` is what tap i of each cell adds up to.
    /// `out` is overwritten; its length is cells + width - 1 without the drain.
    fn flush(
        dialect: Dialect,
        rows: &[Self::Row],
        columns: usize,
        column: usize,
        weights: &FlushWeights<Self>,
        out: &mut [Complex<Self>],
    );
}

/// The kernel's weights laid out for the loops: every weight twice (re, im), taps padded with zeros to a whole number of vectors.
#[derive(Clone, Debug)]
pub struct FlushWeights<T> {
    pub width: usize,
    /// `[k][2 i]` and `[k][2 i + 1]`: of tap i for moment k.
    pub doubled: Vec<[T; 2 * MAX_WIDTH]>,
}

impl<T: Real> FlushWeights<T> {
    pub fn new(kernel: &Kernel) -> Self {
        let doubled = (0..T::MOMENTS)
            .map(|k| {
                let mut weights = [T::default(); 2 * MAX_WIDTH];
                for i in 0..kernel.width.min(MAX_WIDTH) {
                    let weight = T::narrow(kernel.weight(k, i));
                    weights[2 * i] = weight;
                    weights[2 * i + 1] = weight;
                }
                weights
            })
            .collect();
        Self {
            width: kernel.width,
            doubled,
        }
    }
}

impl<T: Real> Located<T> {
    pub fn new() -> Self {
        Self {
            row: [0; BLOCK],
            x: [T::default(); BLOCK],
        }
    }
}

impl<T: Real> Default for Located<T> {
    fn default() -> Self {
        Self::new()
    }
}

/// Adding and subtracting it rounds to the nearest integer (|x| < 2^51) and leaves that integer in the low bits of the sum.
const ROUND: f64 = 6_755_399_441_055_744.0; // 1.5 * 2^52

/// Cell and place of up to [`BLOCK`] positions `scale * delay_s + offset`, in cells; those outside 0..`cells` go to the drain, which is
/// cell `cells`. Returns how many did. NaN is outside.
#[inline(always)]
fn locate_plain<T: Real>(
    delay_s: &[f64],
    scale: f64,
    offset: f64,
    cells: usize,
    row: &mut [u32; BLOCK],
    x: &mut [T; BLOCK],
) -> u64 {
    let end = cells as f64;
    let drain = end + 0.5;
    let mut outside = 0;
    for ((&delay_s, row), x) in delay_s.iter().zip(row).zip(x) {
        let position = delay_s * scale + offset;
        let inside = (position >= 0.0) & (position < end);
        outside += u64::from(!inside);
        let position = if inside { position } else { drain };
        // Truncation by rounding half a cell earlier; a position on a boundary may go to either cell, as x = 1 or x = -1.
        let shifted = (position - 0.5) + ROUND;
        *row = shifted.to_bits() as u32;
        *x = T::narrow(2.0 * (position - (shifted - ROUND)) - 1.0);
    }
    outside
}

/// The AVX2 and AVX-512 builds of [`locate_plain`]: the same arithmetic, so the same bits.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn locate_avx2<T: Real>(
    delay_s: &[f64],
    scale: f64,
    offset: f64,
    cells: usize,
    row: &mut [u32; BLOCK],
    x: &mut [T; BLOCK],
) -> u64 {
    locate_plain(delay_s, scale, offset, cells, row, x)
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512dq,avx512vl")]
fn locate_avx512<T: Real>(
    delay_s: &[f64],
    scale: f64,
    offset: f64,
    cells: usize,
    row: &mut [u32; BLOCK],
    x: &mut [T; BLOCK],
) -> u64 {
    locate_plain(delay_s, scale, offset, cells, row, x)
}

/// See [`locate_plain`].
pub fn locate<T: Real>(
    dialect: Dialect,
    delay_s: &[f64],
    scale: f64,
    offset: f64,
    cells: usize,
    row: &mut [u32; BLOCK],
    x: &mut [T; BLOCK],
) -> u64 {
    assert!(delay_s.len() <= BLOCK);
    match dialect.kind() {
        #[cfg(target_arch = "x86_64")]
        // SAFETY: a `Dialect` of this kind exists only where the processor has the features.
        super::dialect::Kind::Avx512 => unsafe {
            locate_avx512(delay_s, scale, offset, cells, row, x)
        },
        #[cfg(target_arch = "x86_64")]
        // SAFETY: a `Dialect` of this kind exists only where the processor has the features.
        super::dialect::Kind::Avx2 => unsafe { locate_avx2(delay_s, scale, offset, cells, row, x) },
        _ => locate_plain(delay_s, scale, offset, cells, row, x),
    }
}

/// What the vector loops rely on: slices long enough. (That every row exists each of them checks in its own first pass.)
fn check_points<T>(points: &Points<T>) {
    let Points { taps, weight, .. } = *points;
    let len = points.row.len();
    assert!(len <= BLOCK, "{len} points in a block of {BLOCK}");
    assert_eq!(points.x.len(), len, "places");
    assert_eq!(points.amplitude.len(), len, "amplitudes");
    assert!((1..=MAX_TAPS).contains(&taps), "{taps} taps");
    assert!(taps == 1 || weight.len() == len, "weights");
}

/// What the vector loops rely on: shapes that fit one another.
fn check_flush<T>(
    rows: usize,
    columns: usize,
    column: usize,
    weights: &FlushWeights<T>,
    moments: usize,
    out: usize,
) {
    assert!(column < columns, "column {column} of {columns}");
    assert_eq!(rows % columns, 0, "whole cells");
    assert!(
        (1..=MAX_WIDTH).contains(&weights.width),
        "width {}",
        weights.width
    );
    assert_eq!(weights.doubled.len(), moments, "weights for every moment");
    assert!(rows >= 2 * columns, "a cell and the drain");
    assert_eq!(out, rows / columns - 1 + weights.width - 1, "grid values");
}

macro_rules! real {
    ($real:ty, $row:ty, $complex:ty, $moments:literal, $accumulate:ident, $flush:ident) => {
        impl Real for $real {
            type Row = $row;
            const MOMENTS: usize = $moments;
            const EMPTY: $row = Row([0.0; 2 * $moments]);

            #[inline(always)]
            fn narrow(value: f64) -> Self {
                value as $real
            }

            fn accumulate(dialect: Dialect, points: Points<Self>, rows: &mut [$row]) {
                check_points(&points);
                match dialect.kind() {
                    #[cfg(target_arch = "x86_64")]
                    // SAFETY: a `Dialect` of this kind exists only where the processor has the features; the slices were checked above.
                    super::dialect::Kind::Avx512 => unsafe {
                        super::avx512::$accumulate(points, rows)
                    },
                    #[cfg(target_arch = "x86_64")]
                    // SAFETY: as above.
                    super::dialect::Kind::Avx2 => unsafe { super::avx2::$accumulate(points, rows) },
                    _ => accumulate_plain(points, rows),
                }
            }

            fn flush(
                dialect: Dialect,
                rows: &[$row],
                columns: usize,
                column: usize,
                weights: &FlushWeights<Self>,
                out: &mut [$complex],
            ) {
                check_flush(
                    rows.len(),
                    columns,
                    column,
                    weights,
                    Self::MOMENTS,
                    out.len(),
                );
                match dialect.kind() {
                    #[cfg(target_arch = "x86_64")]
                    // SAFETY: a `Dialect` of this kind exists only where the processor has the features; the shapes were checked above.
                    super::dialect::Kind::Avx512 => unsafe {
                        super::avx512::$flush(rows, columns, column, weights, out)
                    },
                    #[cfg(target_arch = "x86_64")]
                    // SAFETY: as above.
                    super::dialect::Kind::Avx2 => unsafe {
                        super::avx2::$flush(rows, columns, column, weights, out)
                    },
                    _ => flush_plain(rows, columns, column, weights, out),
                }
            }
        }
    };
}

real!(f32, Row32, Complex32, 8, accumulate_32, flush_32);
real!(f64, Row64, Complex64, 12, accumulate_64, flush_64);

/// The portable twin of the vector loops.
fn accumulate_plain<T: Real, const N: usize>(points: Points<T>, rows: &mut [Row<T, N>]) {
    for (j, &first) in points.row.iter().enumerate() {
        let mut moments = [T::zero(); N];
        let mut now = points.amplitude[j];
        for pair in moments.chunks_exact_mut(2) {
            pair[0] = now.re;
            pair[1] = now.im;
            now = now * points.x[j];
        }
        let rows = &mut rows[first as usize..first as usize + points.taps];
        if let [row] = rows {
            for (sum, moment) in row.0.iter_mut().zip(moments) {
                *sum = *sum + moment;
            }
            continue;
        }
        for (row, &weight) in rows.iter_mut().zip(&points.weight[j]) {
            for (sum, moment) in row.0.iter_mut().zip(moments) {
                *sum = *sum + weight * moment;
            }
        }
    }
}

/// The portable twin of the vector loops.
fn flush_plain<T: Real, const N: usize>(
    rows: &[Row<T, N>],
    columns: usize,
    column: usize,
    weights: &FlushWeights<T>,
    out: &mut [Complex<T>],
) {
    out.fill(Complex::new(T::zero(), T::zero()));
    let cells = rows.len() / columns - 1;
    for cell in 0..cells {
        let moments = &rows[cell * columns + column].0;
        for (i, value) in out[cell..cell + weights.width].iter_mut().enumerate() {
            for (pair, weight) in moments.chunks_exact(2).zip(&weights.doubled) {
                value.re = value.re + weight[2 * i] * pair[0];
                value.im = value.im + weight[2 * i] * pair[1];
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::TAU;

    /// Numbers in -1..1 that look like chance.
    fn chance(i: usize) -> f64 {
        let x = (i as u64 + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15);
        let x = (x ^ (x >> 31)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        (x >> 11) as f64 / (1u64 << 52) as f64 - 1.0
    }

    type Block<T> = (Located<T>, [Complex<T>; BLOCK], [[T; MAX_TAPS]; BLOCK]);

    fn block<T: Real>(cells: usize, columns: usize) -> Block<T> {
        let number = |i: usize| T::narrow(chance(i));
        let mut located = Located::new();
        for j in 0..BLOCK {
            located.row[j] = ((chance(7 * j).abs() * (cells - 1) as f64) as usize * columns) as u32;
            located.x[j] = number(7 * j + 1);
        }
        (
            located,
            std::array::from_fn(|j| Complex::new(number(7 * j + 2), number(7 * j + 3))),
            std::array::from_fn(|j| std::array::from_fn(|t| number(97 * j + t + 4))),
        )
    }

    fn points<T>(block: &Block<T>, len: usize, taps: usize) -> Points<'_, T> {
        Points {
            row: &block.0.row[..len],
            x: &block.0.x[..len],
            amplitude: &block.1[..len],
            taps,
            weight: &block.2[..len],
        }
    }

    fn largest_difference<T: Real + Into<f64>, const N: usize>(
        a: &[Row<T, N>],
        b: &[Row<T, N>],
    ) -> f64 {
        let flat = |rows: &[Row<T, N>]| -> Vec<f64> {
            rows.iter().flat_map(|r| r.0.map(Into::into)).collect()
        };
        let worst = flat(a)
            .iter()
            .zip(flat(b))
            .map(|(a, b)| (a - b).abs())
            .fold(0.0, f64::max);
        worst
    }

    fn every_dialect_agrees<T: Real<Row = Row<T, N>> + Into<f64>, const N: usize>(limit: f64) {
        const CELLS: usize = 23;
        for dialect in Dialect::available() {
            for taps in 1..=MAX_TAPS {
                let columns = taps;
                let block = block::<T>(CELLS, columns);
                let mut want = vec![T::EMPTY; CELLS * columns];
                let mut got = want.clone();
                for len in [0, 1, 17, BLOCK] {
                    let points = points(&block, len, taps);
                    accumulate_plain(points, &mut want);
                    T::accumulate(dialect, points, &mut got);
                }
                let error = largest_difference(&got, &want);
                assert!(error < limit, "{dialect:?}, {taps} taps: {error:e}");
                for width in 2..=MAX_WIDTH {
                    let weights = FlushWeights::<T>::new(&Kernel::new(width, 2.0, T::MOMENTS));
                    let zero = Complex::new(T::zero(), T::zero());
                    let mut want_grid = vec![zero; CELLS - 1 + width - 1];
                    let mut grid = vec![Complex::new(T::one(), T::one()); want_grid.len()];
                    flush_plain(&want, columns, columns - 1, &weights, &mut want_grid);
                    T::flush(dialect, &want, columns, columns - 1, &weights, &mut grid);
                    for (g, w) in grid.iter().zip(&want_grid) {
                        let error = (g.re - w.re).into().abs().max((g.im - w.im).into().abs());
                        assert!(error < limit, "{dialect:?}, width {width}: {g:?} {w:?}");
                    }
                }
            }
        }
    }

    // Sums of some 100 terms below 1: a few roundings of 6e-8 or 1.1e-16 each.
    #[test]
    fn every_dialect_gives_the_portable_f32_to_3e_5() {
        every_dialect_agrees::<f32, 16>(3e-5);
    }

    #[test]
    fn every_dialect_gives_the_portable_f64_to_1e_13() {
        every_dialect_agrees::<f64, 24>(1e-13);
    }

    #[test]
    fn locating_gives_the_same_bits_in_every_dialect_and_drains_what_lies_outside() {
        let mut delay_s: Vec<f64> = (0..BLOCK).map(|i| 1e-3 * (chance(i) + 1.0)).collect();
        for (i, odd) in [
            f64::NAN,
            f64::INFINITY,
            f64::NEG_INFINITY,
            -1e-9,
            1.0,
            1e300,
        ]
        .into_iter()
        .enumerate()
        {
            delay_s[10 * i] = odd;
        }
        let cells = 2000;
        let mut want = Located::<f64>::new();
        let scale = cells as f64 / 2e-3;
        let outside = locate_plain(&delay_s, scale, 0.0, cells, &mut want.row, &mut want.x);
        assert_eq!(outside, 6);
        for (j, delay_s) in delay_s.iter().enumerate() {
            if (0.0..2e-3).contains(delay_s) {
                let position = f64::from(want.row[j]) + 0.5 + 0.5 * want.x[j];
                assert!((position - delay_s * scale).abs() < 1e-11);
                assert!(want.x[j].abs() <= 1.0, "{}", want.x[j]);
            } else {
                assert_eq!(want.row[j] as usize, cells);
            }
        }
        for dialect in Dialect::available() {
            let mut got = Located::<f64>::new();
            let scale = cells as f64 / 2e-3;
            let count = locate(
                dialect,
                &delay_s,
                scale,
                0.0,
                cells,
                &mut got.row,
                &mut got.x,
            );
            assert_eq!(
                (count, got.row, got.x),
                (outside, want.row, want.x),
                "{dialect:?}"
            );
        }
    }

    #[test]
    fn moments_of_one_point_are_its_powers() {
        let mut rows = vec![f64::EMPTY; 2];
        let amplitude = Complex64::from_polar(1.0, 0.1 * TAU);
        let points = Points {
            row: &[0],
            x: &[0.5],
            amplitude: &[amplitude],
            taps: 1,
            weight: &[],
        };
        f64::accumulate(Dialect::best(), points, &mut rows);
        for k in 0..12 {
            let want = amplitude * 0.5f64.powi(k as i32);
            let got = Complex64::new(rows[0].0[2 * k], rows[0].0[2 * k + 1]);
            assert!((got - want).norm() < 1e-16, "{k}: {got} {want}");
        }
    }
}
