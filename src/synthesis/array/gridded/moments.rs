//! Points into moments, moments onto the grid: the two hot loops, for f32 and f64.
//!
//! In: points located in cells. Per point one aligned row of a table of moments gets c x^k added, whatever the kernel's width; nothing is
//! sorted ([`Real::accumulate`]). Out: grid values, by a (width x moments) matrix per cell ([`Real::flush`]).
//! Over two dimensions a table of moments would outgrow the caches: there each point's few grid values are added at once
//! ([`Real::spread`]), with the columns of the second dimension side by side, so that a point's share of all of them is two additions per
//! tap of the first ([`super::batched_fft`]).
//!
//! Points that lie nowhere go to a cell of their own, the drain: the last of a table, one far past the end of a grid.
//! Every loop exists once in plain Rust here and, where the processor has it, in [`super::avx2`] and [`super::avx512`].

use echotank_fft::Planned;
use num_complex::{Complex, Complex32, Complex64};

use super::batched_fft::{BatchedFft, Job};
use super::kernel::{Kernel, MAX_WIDTH};
use super::prepare::{Sharing, share_plain};
use super::simd_level::{Kind, SimdLevel};

/// Points worked on together.
pub const BLOCK: usize = 256;

/// Neighbouring columns that a point goes to in the second dimension, at most.
pub(crate) const MAX_TAPS: usize = 8;

/// Moments of one cell: 8 complex f32 (one cache line) or 12 complex f64 (three), interleaved re, im.
#[derive(Clone, Copy, Debug)]
#[repr(C, align(64))]
pub struct Row<R, const N: usize>(pub [R; N]);

pub(crate) type Row32 = Row<f32, 16>;
pub(crate) type Row64 = Row<f64, 24>;

/// Up to [`BLOCK`] points, structure of arrays; all slices have the same length.
#[derive(Clone, Copy, Debug)]
pub struct Points<'a, T> {
    pub cell: &'a [u32],
    /// Place across the cell, -1..1.
    pub x: &'a [T],
    pub amplitude: &'a [Complex<T>],
}

/// What of a point's amplitude goes to each tap, real parts first, then imaginary ones.
pub type Shared<T> = [T; 2 * MAX_TAPS];

/// Where the same points go in the second dimension: to `taps` neighbouring columns from `column` on, and what of each point's amplitude
/// goes there: 0 from `taps` on.
#[derive(Clone, Copy, Debug)]
pub struct Across<'a, T> {
    pub column: &'a [u32],
    pub value: &'a [Shared<T>],
    pub taps: usize,
    /// Columns of a table: of row v the real part of column q is number `2 v lanes + q`, the imaginary one `lanes` on.
    pub lanes: usize,
}

/// Cells and places of up to [`BLOCK`] points, as [`locate`] finds them.
#[derive(Clone, Debug)]
pub struct Located<T> {
    pub cell: [u32; BLOCK],
    pub x: [T; BLOCK],
}

/// The real numbers that moments are made of.
pub trait Real: Planned + Default {
    type Row: Copy + Send + Sync + std::fmt::Debug;
    /// Complex moments per row.
    const MOMENTS: usize;
    const EMPTY: Self::Row;

    /// Rounds to this precision.
    fn narrow(value: f64) -> Self;

    /// Adds every point's moments to the row of its cell. Panics where there is none.
    fn accumulate(simd_level: SimdLevel, points: Points<Self>, rows: &mut [Self::Row]);

    /// Puts all cells but the drain on the grid: `out[cell + i]` is what tap i of each cell adds up to.
    /// `out` is overwritten; its length is cells + width - 1 without the drain.
    fn flush(
        simd_level: SimdLevel,
        rows: &[Self::Row],
        weights: &FlushWeights<Self>,
        out: &mut [Complex<Self>],
    );

    /// Adds every point's values across to a few of many grids: tap i of column q to row `cell + i` of the table. May add zeros to the next
    /// [`MAX_TAPS`] numbers. Panics where the table ends before that. The points' amplitudes are not looked at.
    fn spread(
        simd_level: SimdLevel,
        points: Points<Self>,
        across: Across<Self>,
        weights: &FlushWeights<Self>,
        table: &mut [Self],
    );

    /// What rows are made of, one number after another.
    fn numbers(rows: &mut [Self::Row]) -> &mut [Self];

    /// All columns of a table into a spectrum; the table is empty afterwards.
    fn transform(simd_level: SimdLevel, batched_fft: &BatchedFft<Self>, job: Job<Self>);

    /// The values of points across: their amplitudes times weights read from a table. Panics where entries are missing.
    fn share<const BENT: bool>(
        simd_level: SimdLevel,
        points: Sharing<Self>,
        values: &mut [Shared<Self>],
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
            cell: [0; BLOCK],
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
pub(crate) const ROUND: f64 = 6_755_399_441_055_744.0; // 1.5 * 2^52

/// Delays in cells: `per_s * delay_s + offset`. What lies outside 0..`cells` goes to cell `drain`.
#[derive(Clone, Copy, Debug)]
pub struct Axis {
    pub per_s: f64,
    pub offset: f64,
    pub cells: usize,
    pub drain: usize,
}

/// Cells and places of up to [`BLOCK`] delays. Returns how many went to the drain; NaN does.
#[inline(always)]
fn locate_plain<T: Real>(axis: Axis, delay_s: &[f64], located: &mut Located<T>) -> u64 {
    let end = axis.cells as f64;
    let drain = axis.drain as f64 + 0.5;
    let mut outside = 0;
    let Located { cell, x } = located;
    for ((&delay_s, cell), x) in delay_s.iter().zip(cell).zip(x) {
        let position = delay_s * axis.per_s + axis.offset;
        let inside = (position >= 0.0) & (position < end);
        outside += u64::from(!inside);
        let position = if inside { position } else { drain };
        // Truncation by rounding half a cell earlier; a position on a boundary may go to either cell, as x = 1 or x = -1.
        let shifted = (position - 0.5) + ROUND;
        *cell = shifted.to_bits() as u32;
        *x = T::narrow(2.0 * (position - (shifted - ROUND)) - 1.0);
    }
    outside
}

/// The AVX2 and AVX-512 builds of [`locate_plain`]: the same arithmetic, so the same bits.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn locate_avx2<T: Real>(axis: Axis, delay_s: &[f64], located: &mut Located<T>) -> u64 {
    locate_plain(axis, delay_s, located)
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512dq,avx512vl")]
fn locate_avx512<T: Real>(axis: Axis, delay_s: &[f64], located: &mut Located<T>) -> u64 {
    locate_plain(axis, delay_s, located)
}

/// Cells and places of up to [`BLOCK`] delays. Returns how many went to the drain; NaN does.
pub fn locate<T: Real>(
    simd_level: SimdLevel,
    axis: Axis,
    delay_s: &[f64],
    located: &mut Located<T>,
) -> u64 {
    assert!(delay_s.len() <= BLOCK);
    match simd_level.kind() {
        // SAFETY (twice): a `SimdLevel` of this kind exists only where the processor has the features.
        #[cfg(target_arch = "x86_64")]
        Kind::Avx512 => unsafe { locate_avx512(axis, delay_s, located) },
        #[cfg(target_arch = "x86_64")]
        Kind::Avx2 => unsafe { locate_avx2(axis, delay_s, located) },
        _ => locate_plain(axis, delay_s, located),
    }
}

/// What the vector loops rely on: slices long enough. (That every row exists each of them checks in its own first pass.)
fn check_points<T>(points: &Points<T>) {
    let len = points.cell.len();
    assert!(len <= BLOCK, "{len} points in a block of {BLOCK}");
    assert_eq!(points.x.len(), len, "places");
    assert_eq!(points.amplitude.len(), len, "amplitudes");
}

fn check_weights<T: Real>(weights: &FlushWeights<T>) {
    let width = weights.width;
    assert!((1..=MAX_WIDTH).contains(&width), "width {width}");
    assert_eq!(weights.doubled.len(), T::MOMENTS, "weights for each moment");
}

macro_rules! real {
    ($real:ty, $row:ty, $complex:ty, $moments:literal, $accumulate:ident, $flush:ident, $spread:ident, $transform:ident, $share:ident) => {
        impl Real for $real {
            type Row = $row;
            const MOMENTS: usize = $moments;
            const EMPTY: $row = Row([0.0; 2 * $moments]);

            #[inline(always)]
            fn narrow(value: f64) -> Self {
                value as $real
            }

            fn accumulate(simd_level: SimdLevel, points: Points<Self>, rows: &mut [$row]) {
                check_points(&points);
                match simd_level.kind() {
                    // SAFETY (twice): a `SimdLevel` of this kind exists only where the processor has the features; slices checked above.
                    #[cfg(target_arch = "x86_64")]
                    Kind::Avx512 => unsafe { super::avx512::$accumulate(points, rows) },
                    #[cfg(target_arch = "x86_64")]
                    Kind::Avx2 => unsafe { super::avx2::$accumulate(points, rows) },
                    _ => accumulate_plain(points, rows),
                }
            }

            fn flush(
                simd_level: SimdLevel,
                rows: &[$row],
                weights: &FlushWeights<Self>,
                out: &mut [$complex],
            ) {
                check_weights(weights);
                assert!(rows.len() >= 2, "a cell and the drain");
                assert_eq!(out.len(), rows.len() - 1 + weights.width - 1, "grid values");
                match simd_level.kind() {
                    // SAFETY (twice): a `SimdLevel` of this kind exists only where the processor has the features; shapes checked above.
                    #[cfg(target_arch = "x86_64")]
                    Kind::Avx512 => unsafe { super::avx512::$flush(rows, weights, out) },
                    #[cfg(target_arch = "x86_64")]
                    Kind::Avx2 => unsafe { super::avx2::$flush(rows, weights, out) },
                    _ => flush_plain(rows, weights, out),
                }
            }

            fn spread(
                simd_level: SimdLevel,
                points: Points<Self>,
                across: Across<Self>,
                weights: &FlushWeights<Self>,
                table: &mut [Self],
            ) {
                check_points(&points);
                check_weights(weights);
                super::batched_fft::$spread(simd_level, points, across, weights, table);
            }

            fn numbers(rows: &mut [$row]) -> &mut [Self] {
                let len = 2 * $moments * rows.len();
                // SAFETY: a row is so many numbers and, its length being a multiple of its alignment, nothing else.
                unsafe { std::slice::from_raw_parts_mut(rows.as_mut_ptr().cast(), len) }
            }

            fn transform(simd_level: SimdLevel, batched_fft: &BatchedFft<Self>, job: Job<Self>) {
                super::batched_fft::$transform(simd_level, batched_fft, job);
            }

            fn share<const BENT: bool>(
                simd_level: SimdLevel,
                points: Sharing<Self>,
                values: &mut [Shared<Self>],
            ) {
                check_sharing(&points, values.len());
                $share::<BENT>(simd_level, points, values)
            }
        }
    };
}

real!(
    f32,
    Row32,
    Complex32,
    8,
    accumulate_32,
    flush_32,
    spread_32,
    transform_32,
    share_32
);
real!(
    f64,
    Row64,
    Complex64,
    12,
    accumulate_64,
    flush_64,
    spread_64,
    transform_64,
    share_64
);

fn share_32<const BENT: bool>(
    simd_level: SimdLevel,
    points: Sharing<f32>,
    values: &mut [Shared<f32>],
) {
    match simd_level.kind() {
        // SAFETY: a `SimdLevel` of these kinds exists only where the processor has AVX2 and FMA; `Real::share` has checked the slices.
        #[cfg(target_arch = "x86_64")]
        Kind::Avx512 | Kind::Avx2 => unsafe { super::avx2::share_32::<BENT>(points, values) },
        _ => share_plain::<f32, BENT>(points, values),
    }
}

/// Seldom needed: plain for all.
fn share_64<const BENT: bool>(_: SimdLevel, points: Sharing<f64>, values: &mut [Shared<f64>]) {
    share_plain::<f64, BENT>(points, values);
}

/// What the vector loop relies on: a number of each for every value, and every entry in the table.
fn check_sharing<T>(points: &Sharing<T>, len: usize) {
    assert_eq!(points.entry.len(), len, "entries");
    assert_eq!(points.beyond.len(), len, "places");
    assert_eq!(points.amplitude.len(), len, "amplitudes");
    assert_eq!(points.bend.len(), len, "curvatures");
    let last = points.entry.iter().fold(0, |a, &b| a.max(b)) as usize;
    assert!(
        len == 0 || last < points.table.len(),
        "entry {last} of {}",
        points.table.len()
    );
}

/// The portable twin of the vector loops.
fn accumulate_plain<T: Real, const N: usize>(points: Points<T>, rows: &mut [Row<T, N>]) {
    for ((&cell, &x), &amplitude) in points.cell.iter().zip(points.x).zip(points.amplitude) {
        let mut moment = amplitude;
        for pair in rows[cell as usize].0.chunks_exact_mut(2) {
            pair[0] = pair[0] + moment.re;
            pair[1] = pair[1] + moment.im;
            moment = moment * x;
        }
    }
}

/// The portable twin of the vector loops.
fn flush_plain<T: Real, const N: usize>(
    rows: &[Row<T, N>],
    weights: &FlushWeights<T>,
    out: &mut [Complex<T>],
) {
    out.fill(Complex::new(T::zero(), T::zero()));
    for (cell, moments) in rows[..rows.len() - 1].iter().enumerate() {
        for (i, value) in out[cell..cell + weights.width].iter_mut().enumerate() {
            for (pair, weight) in moments.0.chunks_exact(2).zip(&weights.doubled) {
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

    type Block<T> = (Located<T>, [Complex<T>; BLOCK]);

    /// Points in all cells but the last of `cells`.
    fn block<T: Real>(cells: usize) -> Block<T> {
        let number = |i: usize| T::narrow(chance(i));
        let below = |i: usize, end: usize| (chance(i).abs() * end as f64) as u32;
        let mut located = Located::new();
        for j in 0..BLOCK {
            located.cell[j] = below(7 * j, cells - 1);
            located.x[j] = number(7 * j + 1);
        }
        (
            located,
            std::array::from_fn(|j| Complex::new(number(7 * j + 2), number(7 * j + 3))),
        )
    }

    fn points<T>(block: &Block<T>, len: usize) -> Points<'_, T> {
        Points {
            cell: &block.0.cell[..len],
            x: &block.0.x[..len],
            amplitude: &block.1[..len],
        }
    }

    fn worst<T: Real + Into<f64>>(got: &[Complex<T>], want: &[Complex<T>]) -> f64 {
        let pairs = got.iter().zip(want).map(|(g, w)| g - w);
        pairs.fold(0.0, |worst: f64, d| {
            worst.max(d.re.into().abs()).max(d.im.into().abs())
        })
    }

    /// Accumulate and flush against their portable twins.
    fn every_dialect_agrees<T: Real<Row = Row<T, N>> + Into<f64>, const N: usize>(limit: f64) {
        const CELLS: usize = 23;
        let one = Complex::new(T::one(), T::one());
        let block = block::<T>(CELLS);
        for simd_level in SimdLevel::available() {
            let mut want = vec![T::EMPTY; CELLS];
            let mut got = want.clone();
            for len in [0, 1, 17, BLOCK] {
                accumulate_plain(points(&block, len), &mut want);
                T::accumulate(simd_level, points(&block, len), &mut got);
            }
            for width in 2..=MAX_WIDTH {
                let weights = FlushWeights::<T>::new(&Kernel::new(width, 2.0, T::MOMENTS));
                let mut want_grid = vec![one; CELLS - 1 + width - 1];
                let mut grid = want_grid.clone();
                flush_plain(&want, &weights, &mut want_grid);
                T::flush(simd_level, &got, &weights, &mut grid);
                let error = worst(&grid, &want_grid);
                assert!(
                    error < limit,
                    "{simd_level:?}, flush, width {width}: {error:e}"
                );
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
    fn every_dialect_shares_points_like_the_portable_f32_to_1e_6() {
        use crate::array::gridded::prepare::Entry;
        let eight = |i: usize| std::array::from_fn(|t| chance(8 * i + t) as f32);
        let table: Vec<Entry<f32>> = (0..16)
            .map(|e| Entry {
                plain: [0, 1, 2].map(|k| eight(7 * e + k)),
                imaginary: [3, 4].map(|k| eight(7 * e + k)),
                real: eight(7 * e + 5),
                real_2: eight(7 * e + 6),
            })
            .collect();
        let number = |i: usize| chance(i) as f32;
        let entry: Vec<u32> = (0..BLOCK)
            .map(|j| (chance(j).abs() * 15.9) as u32)
            .collect();
        let beyond: Vec<f32> = (0..BLOCK).map(|j| number(3 * j)).collect();
        let bend: Vec<f32> = (0..BLOCK).map(|j| number(5 * j + 1)).collect();
        let amplitude: Vec<Complex32> = (0..BLOCK)
            .map(|j| Complex32::new(number(7 * j), number(11 * j)))
            .collect();
        let sharing = || Sharing {
            table: &table,
            entry: &entry,
            beyond: &beyond,
            amplitude: &amplitude,
            bend: &bend,
        };
        let made = |run: &dyn Fn(&mut [Shared<f32>])| {
            let mut values = vec![[0f32; 2 * MAX_TAPS]; BLOCK];
            run(&mut values);
            values.concat()
        };
        for simd_level in SimdLevel::available() {
            for (got, want) in [
                (
                    made(&|v| f32::share::<true>(simd_level, sharing(), v)),
                    made(&|v| share_plain::<f32, true>(sharing(), v)),
                ),
                (
                    made(&|v| f32::share::<false>(simd_level, sharing(), v)),
                    made(&|v| share_plain::<f32, false>(sharing(), v)),
                ),
            ] {
                let off = got.iter().zip(&want).map(|(g, w)| (g - w).abs());
                let worst = off.fold(0.0, f32::max);
                assert!(worst < 1e-6, "{simd_level:?}: {worst:e}");
            }
        }
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
        let axis = Axis {
            per_s: 1e6,
            offset: 0.0,
            cells: 2000,
            drain: 2007,
        };
        let mut want = Located::<f64>::new();
        let outside = locate_plain(axis, &delay_s, &mut want);
        assert_eq!(outside, 6);
        for (j, delay_s) in delay_s.iter().enumerate() {
            if (0.0..2e-3).contains(delay_s) {
                let position = f64::from(want.cell[j]) + 0.5 + 0.5 * want.x[j];
                assert!((position - delay_s * 1e6).abs() < 1e-11);
                assert!(want.x[j].abs() <= 1.0, "{}", want.x[j]);
            } else {
                assert_eq!(want.cell[j] as usize, axis.drain);
            }
        }
        for simd_level in SimdLevel::available() {
            let mut got = Located::<f64>::new();
            let count = locate(simd_level, axis, &delay_s, &mut got);
            assert_eq!(
                (count, got.cell, got.x),
                (outside, want.cell, want.x),
                "{simd_level:?}"
            );
        }
    }

    #[test]
    fn moments_of_one_point_are_its_powers() {
        let mut rows = vec![f64::EMPTY; 2];
        let amplitude = Complex64::from_polar(1.0, 0.1 * TAU);
        let points = Points {
            cell: &[0],
            x: &[0.5],
            amplitude: &[amplitude],
        };
        f64::accumulate(SimdLevel::best(), points, &mut rows);
        for k in 0..12 {
            let want = amplitude * 0.5f64.powi(k as i32);
            let got = Complex64::new(rows[0].0[2 * k], rows[0].0[2 * k + 1]);
            assert!((got - want).norm() < 1e-16, "{k}: {got} {want}");
        }
    }
}
