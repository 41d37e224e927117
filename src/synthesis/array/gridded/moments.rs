//! The two inner loops, points to moments and moments to grid values, for f32 and f64.
//!
//! [`Real::accumulate`] adds c x^k of every located point to one aligned row of a table of moments,
//! for any width of the kernel. It needs no sorting. [`Real::flush`] applies a (width x moments)
//! matrix per cell to obtain grid values.
//!
//! In two dimensions a table of moments would exceed the caches. Therefore [`Real::spread`] adds
//! the few grid values of each point directly. The columns of the second dimension are adjacent, so
//! each tap of the first dimension costs two vector additions ([`super::batched_fft`]).
//!
//! Points outside the grid are added to the drain: a cell at the end of a table and far past the
//! end of a grid. Every loop has a portable version here and, if the processor supports them,
//! versions in [`super::avx2`] and [`super::avx512`].

use echotank_fft::Planned;
use num_complex::{Complex, Complex32, Complex64};

use super::batched_fft::{BatchedFft, Job};
use super::kernel::{Kernel, MAX_WIDTH};
use super::prepare::{Sharing, share_plain};
use echotank_core::simd::{Kind, SimdLevel};

/// Number of points processed together.
pub const BLOCK: usize = 256;

/// Maximum number of adjacent columns of a point in the second dimension.
pub(crate) const MAX_TAPS: usize = 8;

/// Moments of one cell: 8 complex f32 (one cache line) or 12 complex f64 (three cache lines), with
/// interleaved real and imaginary parts.
#[derive(Clone, Copy, Debug)]
#[repr(C, align(64))]
pub struct Row<R, const N: usize>(pub [R; N]);

pub(crate) type Row32 = Row<f32, 16>;
pub(crate) type Row64 = Row<f64, 24>;

/// Up to [`BLOCK`] points as a structure of arrays; all slices have the same length.
#[derive(Clone, Copy, Debug)]
pub struct Points<'a, T> {
    /// Cell of each point.
    pub cell: &'a [u32],
    /// Position across the cell, -1..1.
    pub x: &'a [T],
    /// Complex amplitude of each point.
    pub amplitude: &'a [Complex<T>],
}

/// Amplitude of a point times each tap's weight: real parts first, then imaginary parts.
pub type Shared<T> = [T; 2 * MAX_TAPS];

/// Second dimension of the same points. Each point is added to `taps` adjacent columns.
#[derive(Clone, Copy, Debug)]
pub struct Across<'a, T> {
    /// First column of each point.
    pub column: &'a [u32],
    /// Value of each point for these columns; 0 from tap `taps` on.
    pub value: &'a [Shared<T>],
    /// Number of columns per point.
    pub taps: usize,
    /// Number of columns of a table. In row v, the real part of column q has index `2 v lanes + q`.
    /// The imaginary part follows `lanes` later.
    pub lanes: usize,
}

/// Cells and positions of up to [`BLOCK`] points, as computed by [`locate`].
#[derive(Clone, Debug)]
pub struct Located<T> {
    /// Cell of each point.
    pub cell: [u32; BLOCK],
    /// Position across the cell, -1..1.
    pub x: [T; BLOCK],
}

/// Floating-point precision of the moments.
pub trait Real: Planned + Default {
    /// Moments of one cell.
    type Row: Copy + Send + Sync + std::fmt::Debug;
    /// Complex moments per row.
    const MOMENTS: usize;
    /// A row of zeros.
    const EMPTY: Self::Row;

    /// Rounds to this precision.
    fn narrow(value: f64) -> Self;

    /// Adds the moments of every point to the row of its cell. Panics if a cell does not exist.
    fn accumulate(simd_level: SimdLevel, points: Points<Self>, rows: &mut [Self::Row]);

    /// Maps all cells except the drain to the grid: `out[cell + i]` is the sum of tap i over the
    /// cells. Overwrites `out`, with a length of cells + width - 1 without the drain.
    fn flush(
        simd_level: SimdLevel,
        rows: &[Self::Row],
        weights: &FlushWeights<Self>,
        out: &mut [Complex<Self>],
    );

    /// Adds the values of every point to several grids. Tap i of column q is added to row `cell +
    /// i` of the table. The function may add zeros to the next [`MAX_TAPS`] numbers, and it ignores
    /// the amplitudes of the points. Panics if the table is too short.
    fn spread(
        simd_level: SimdLevel,
        points: Points<Self>,
        across: Across<Self>,
        weights: &FlushWeights<Self>,
        table: &mut [Self],
    );

    /// The numbers of the rows as one slice.
    fn numbers(rows: &mut [Self::Row]) -> &mut [Self];

    /// Transforms all columns of a table into a spectrum and clears the table.
    fn transform(simd_level: SimdLevel, batched_fft: &BatchedFft<Self>, job: Job<Self>);

    /// Computes the values of points across columns: amplitudes times weights read from a table.
    /// Panics if an entry is missing.
    fn share<const BENT: bool>(
        simd_level: SimdLevel,
        points: Sharing<Self>,
        values: &mut [Shared<Self>],
    );
}

/// Kernel weights in the layout of the loops: each weight twice (re, im), with taps padded by zeros
/// to whole vectors.
#[derive(Clone, Debug)]
pub struct FlushWeights<T> {
    /// Number of taps of the kernel.
    pub width: usize,
    /// Weight of tap i for moment k, at `[k][2 i]` and `[k][2 i + 1]`.
    pub doubled: Vec<[T; 2 * MAX_WIDTH]>,
}

impl<T: Real> FlushWeights<T> {
    /// Converts the weights of `kernel`.
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
    /// Zeroed buffers.
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

/// Addition and subtraction of this number round to the nearest integer (|x| < 2^51). The low bits
/// of the sum hold that integer.
pub(crate) const ROUND: f64 = 6_755_399_441_055_744.0; // 1.5 * 2^52

/// Conversion of delays to cells: `per_s * delay_s + offset`. Delays outside 0..`cells` are mapped
/// to cell `drain`.
#[derive(Clone, Copy, Debug)]
pub struct Axis {
    /// Cells per second.
    pub per_s: f64,
    /// Cell coordinate of delay 0.
    pub offset: f64,
    /// Number of cells.
    pub cells: usize,
    /// Index of the drain.
    pub drain: usize,
}

/// Computes cells and positions of up to [`BLOCK`] delays. Returns the number of delays in the
/// drain, including NaN.
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
        // Truncates by rounding half a cell earlier. A position on a boundary may go to either
        // cell, with x = 1 or x = -1.
        let shifted = (position - 0.5) + ROUND;
        *cell = shifted.to_bits() as u32;
        *x = T::narrow(2.0 * (position - (shifted - ROUND)) - 1.0);
    }
    outside
}

/// AVX2 and AVX-512 builds of [`locate_plain`], with the same arithmetic, so the same bits.
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

/// Computes cells and positions of up to [`BLOCK`] delays. Returns the number of delays in the
/// drain, including NaN.
pub fn locate<T: Real>(
    simd_level: SimdLevel,
    axis: Axis,
    delay_s: &[f64],
    located: &mut Located<T>,
) -> u64 {
    assert!(delay_s.len() <= BLOCK);
    match simd_level.kind() {
        // SAFETY (both calls): a `SimdLevel` of this kind exists only on processors with the
        // features.
        #[cfg(target_arch = "x86_64")]
        Kind::Avx512 => unsafe { locate_avx512(axis, delay_s, located) },
        #[cfg(target_arch = "x86_64")]
        Kind::Avx2 => unsafe { locate_avx2(axis, delay_s, located) },
        _ => locate_plain(axis, delay_s, located),
    }
}

/// Checks the slice lengths that the vector loops require. Each loop checks the row indices in its
/// own first pass.
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
                    // SAFETY (both calls): a `SimdLevel` of this kind exists only on processors
                    // with the features; slices are checked above.
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
                    // SAFETY (both calls): a `SimdLevel` of this kind exists only on processors
                    // with the features; shapes are checked above.
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
                // SAFETY: a row consists only of its numbers, because its length is a multiple of
                // its alignment.
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
        // SAFETY: a `SimdLevel` of these kinds exists only on processors with AVX2 and FMA;
        // `Real::share` has checked the slices.
        #[cfg(target_arch = "x86_64")]
        Kind::Avx512 | Kind::Avx2 => unsafe { super::avx2::share_32::<BENT>(points, values) },
        _ => share_plain::<f32, BENT>(points, values),
    }
}

/// Values of points in f64. This case is rare, so there is only a portable version.
fn share_64<const BENT: bool>(_: SimdLevel, points: Sharing<f64>, values: &mut [Shared<f64>]) {
    share_plain::<f64, BENT>(points, values);
}

/// Checks the requirements of the vector loop: one number of each kind per value, and table entries
/// within bounds.
fn check_sharing<T>(points: &Sharing<T>, len: usize) {
    assert_eq!(points.entry.len(), len, "entries");
    assert_eq!(points.beyond.len(), len, "places");
    assert_eq!(points.amplitude.len(), len, "amplitudes");
    assert_eq!(points.curvature.len(), len, "curvatures");
    let last = points.entry.iter().fold(0, |a, &b| a.max(b)) as usize;
    assert!(
        len == 0 || last < points.table.len(),
        "entry {last} of {}",
        points.table.len()
    );
}

/// Portable version of the vector loops.
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

/// Portable version of the vector loops.
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

    /// Pseudo-random numbers in -1..1.
    fn chance(i: usize) -> f64 {
        let x = (i as u64 + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15);
        let x = (x ^ (x >> 31)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        (x >> 11) as f64 / (1u64 << 52) as f64 - 1.0
    }

    type Block<T> = (Located<T>, [Complex<T>; BLOCK]);

    /// Points in all of `cells` cells except the last.
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

    /// Compares accumulate and flush with their portable versions.
    fn every_simd_level_agrees<T: Real<Row = Row<T, N>> + Into<f64>, const N: usize>(limit: f64) {
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

    // Sums of about 100 terms below 1: a few roundings of 6e-8 or 1.1e-16 each.
    #[test]
    fn every_simd_level_gives_the_portable_f32_to_3e_5() {
        every_simd_level_agrees::<f32, 16>(3e-5);
    }

    #[test]
    fn every_simd_level_gives_the_portable_f64_to_1e_13() {
        every_simd_level_agrees::<f64, 24>(1e-13);
    }

    #[test]
    fn every_simd_level_shares_points_like_the_portable_f32_to_1e_6() {
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
        let curvature: Vec<f32> = (0..BLOCK).map(|j| number(5 * j + 1)).collect();
        let amplitude: Vec<Complex32> = (0..BLOCK)
            .map(|j| Complex32::new(number(7 * j), number(11 * j)))
            .collect();
        let sharing = || Sharing {
            table: &table,
            entry: &entry,
            beyond: &beyond,
            amplitude: &amplitude,
            curvature: &curvature,
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
    fn locating_gives_the_same_bits_in_every_simd_level_and_drains_what_lies_outside() {
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
