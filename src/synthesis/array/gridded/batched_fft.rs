//! Batched FFT. Points are spread over interleaved columns, and all columns are transformed together.
//!
//! A table has a row for every value of the delay grid and a column for every Doppler. A row consists of `lanes` real parts and
//! then `lanes` imaginary parts. A vector thus holds the same value of several columns, and no operation moves data between lanes.
//! The transform of all columns is the transform of one column with vectors in place of numbers. Bins are in transform order
//! ([`BatchedFft::frequencies`]), and so are the stored templates. The sum is reordered at the end.
//!
//! The transform makes two passes through the table. The first transforms every `short`-th row, and
//! the second `short` neighbouring rows at a time, which fit the innermost cache (Cooley and Tukey
//! 1965). Each pass runs in place in steps of radix 5, 3, 4 and 2 with decimation in frequency.

use std::f64::consts::TAU;

use num_complex::Complex;

use super::kernel::MAX_WIDTH;
use super::lanes::{Lanes, Pair};
use super::moments::{Across, FlushWeights, MAX_TAPS, Points, Real};
use echotank_core::simd::{Kind, SimdLevel};

#[cfg(target_arch = "x86_64")]
use std::arch::x86_64::*;

/// The number of lanes is a multiple of this number.
pub(super) const LANES: usize = 8;

/// Maximum number of consecutive rows transformed together: 32 KB for 16 columns in f32.
const SHORT: usize = 256;

/// Maximum number of lanes transformed together: one full vector in f32. A table of twenty thousand rows then fits the second-level
/// cache.
pub(crate) const MAX_TOGETHER: usize = 16;

/// Number of lanes for `columns` columns.
pub(crate) fn lanes_for(columns: usize) -> usize {
    columns.next_multiple_of(LANES)
}

/// Tables of the transform of one size.
pub struct BatchedFft<T> {
    size: usize,
    long: Steps<T>,
    short: Steps<T>,
    /// Twiddle factors of value k of the long transform of rows j, j + short, ...: `[j * long +
    /// k]`.
    turns: Vec<Complex<T>>,
}

/// Steps of one transform in place.
struct Steps<T> {
    size: usize,
    /// Radix, and factors `[j * (radix - 1) + m - 1]`.
    steps: Vec<(usize, Vec<Complex<T>>)>,
}

/// Row of a transformed table that holds a bin, with the index of the bin in the spectrum. Places are sorted by row.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Place {
    pub row: u32,
    pub to: u32,
}

/// Transform of a table. The result is multiplied by templates and summed, and the table is cleared.
pub struct Job<'a, T> {
    /// Table in the layout `[row][2 * lanes]`.
    pub table: &'a mut [T],
    pub lanes: usize,
    pub places: &'a [Place],
    /// Templates in the layout `[place][2 * template_lanes]`; those of the table start at `first_template`.
    pub templates: &'a [T],
    pub(crate) template_lanes: usize,
    pub(crate) first_template: usize,
    pub spectrum: &'a mut [Complex<T>],
    pub scratch: &'a mut [T],
}

fn turn<T: Real>(part: usize, whole: usize) -> Complex<T> {
    let (sin, cos) = (-TAU * (part % whole) as f64 / whole as f64).sin_cos();
    Complex::new(T::narrow(cos), T::narrow(sin))
}

impl<T: Real> Steps<T> {
    fn new(size: usize) -> Self {
        let mut steps = Vec::new();
        let mut rest = size;
        while rest > 1 {
            let radix = [5, 3, 4, 2]
                .into_iter()
                .find(|radix| rest.is_multiple_of(*radix))
                .expect("grid sizes have no other factors");
            let turns = (0..rest / radix)
                .flat_map(|j| (1..radix).map(move |m| turn(j * m, rest)))
                .collect();
            steps.push((radix, turns));
            rest /= radix;
        }
        Self { size, steps }
    }

    /// Frequency of the row at `place`.
    fn frequency(&self, mut place: usize) -> usize {
        let (mut rest, mut frequency, mut weight) = (self.size, 0, 1);
        for (radix, _) in &self.steps {
            rest /= radix;
            frequency += weight * (place / rest);
            place %= rest;
            weight *= radix;
        }
        frequency
    }
}

impl<T: Real> BatchedFft<T> {
    /// Prepares a transform of `size` rows, a size returned by [`super::transform::grid_size`].
    pub fn new(size: usize) -> Self {
        let short = SHORT.min(1 << size.trailing_zeros());
        let long = size / short;
        let (short, long) = (Steps::new(short), Steps::new(long));
        let turns = (0..short.size)
            .flat_map(|j| (0..long.size).map(move |k| (j, k)))
            .map(|(j, k)| turn(j * long.frequency(k), size))
            .collect();
        Self {
            size,
            long,
            short,
            turns,
        }
    }

    /// Frequency of every row of a transformed table, 0 to size - 1.
    pub fn frequencies(&self) -> impl Iterator<Item = usize> {
        let of_row = |row: usize| {
            let (k, j) = (row / self.short.size, row % self.short.size);
            self.long.frequency(k) + self.long.size * self.short.frequency(j)
        };
        (0..self.size).map(of_row)
    }

    /// Length of the scratch buffer of a [`Job`].
    pub(crate) fn scratch_len(&self) -> usize {
        2 * 16 * self.long.size
    }

    fn check(&self, job: &Job<T>) {
        assert!(
            job.lanes.is_multiple_of(LANES) && job.lanes > 0,
            "{} lanes",
            job.lanes
        );
        let width = 2 * job.lanes;
        assert!(job.table.len() >= self.size * width, "rows");
        let of_templates = 2 * job.template_lanes;
        assert_eq!(
            job.templates.len(),
            job.places.len() * of_templates,
            "templates"
        );
        assert!(
            job.first_template + job.lanes <= job.template_lanes,
            "templates' lanes"
        );
        assert!(job.scratch.len() >= self.scratch_len(), "scratch");
        assert!(
            job.places.is_sorted_by_key(|place| place.row)
                && job
                    .places
                    .last()
                    .is_none_or(|place| (place.row as usize) < self.size),
            "places by rows"
        );
    }

    /// First pass: the long transform of every `short`-th row.
    ///
    /// SAFETY: `size` rows must exist in the table and `long` rows in the scratch; the processor must have V.
    #[inline(always)]
    unsafe fn long_pass<V: Lanes<Number = T>>(&self, table: Columns<T>, scratch: Columns<T>) {
        let (long, short) = (self.long.size, self.short.size);
        if long == 1 {
            return;
        }
        for j in 0..short {
            // SAFETY: the caller guarantees it.
            unsafe {
                let rows = Columns {
                    re: table.re.add(j * table.step),
                    step: table.step * short,
                    ..table
                };
                let turns = self.turns.get_unchecked(j * long..(j + 1) * long);
                self.long.run_turned::<V>(rows, scratch, turns);
            }
        }
    }

    /// Processes the columns from lane `first`, as many as V has lanes.
    ///
    /// SAFETY: the processor must have V; `job` is as [`Self::check`] requires, and `first` + V's
    /// lanes <= its lanes.
    #[inline(always)]
    unsafe fn group<V: Lanes<Number = T>>(&self, job: &mut Job<T>, first: usize) {
        // SAFETY: rows up to size exist in the table, `long` rows of 2 V in the scratch, a row of templates for every place.
        unsafe {
            let table = Columns::<T> {
                re: job.table.as_mut_ptr().add(first),
                step: 2 * job.lanes,
                apart: job.lanes,
            };
            let scratch = Columns::<T> {
                re: job.scratch.as_mut_ptr(),
                step: 2 * V::COUNT,
                apart: V::COUNT,
            };
            self.long_pass::<V>(table, scratch);
            let short = self.short.size;
            let templates = job
                .templates
                .as_ptr()
                .wrapping_add(job.first_template + first);
            let of_templates = 2 * job.template_lanes;
            let zero = Pair::<V>::splat(Complex::new(T::zero(), T::zero()));
            let mut place = 0;
            for block in (0..self.size).step_by(short) {
                let rows = table.from(block);
                self.short.run::<V>(rows);
                while let Some(Place { row, to }) = job.places.get(place)
                    && (*row as usize) < block + short
                {
                    let template = templates.add(place * of_templates);
                    let template = Pair::load(template, template.add(job.template_lanes));
                    let product = table.at::<V>(*row as usize).times(template);
                    let to = &mut job.spectrum[*to as usize];
                    *to = *to + V::sums(product.re, product.im);
                    place += 1;
                }
                for row in 0..short {
                    rows.put::<V>(row, zero);
                }
            }
        }
    }
}

/// Columns of a table that are transformed in place, in the layout `[row][stride]`. The real parts are `lanes` numbers from
/// `first`, followed by as many imaginary parts.
pub(crate) struct LaneTable<'a> {
    pub table: &'a mut [f32],
    pub stride: usize,
    pub first: usize,
    pub lanes: usize,
    pub scratch: &'a mut [f32],
}

/// Transforms every column of `job`. Row r then holds frequency [`BatchedFft::frequencies`]\[r].
pub(crate) fn transform_lanes(simd_level: SimdLevel, fft: &BatchedFft<f32>, mut job: LaneTable) {
    assert!(
        job.lanes > 0 && job.lanes.is_multiple_of(LANES),
        "{} lanes",
        job.lanes
    );
    assert!(job.first + 2 * job.lanes <= job.stride, "stride");
    assert!(job.table.len() >= fft.size * job.stride, "rows");
    assert!(job.scratch.len() >= fft.scratch_len(), "scratch");
    match simd_level.kind() {
        // SAFETY (all three calls): a `SimdLevel` of this kind exists only on processors with the features; shapes are checked
        // above.
        #[cfg(target_arch = "x86_64")]
        Kind::Avx512 if job.lanes.is_multiple_of(2 * LANES) => unsafe {
            lanes_avx512(fft, &mut job)
        },
        #[cfg(target_arch = "x86_64")]
        Kind::Avx512 | Kind::Avx2 => unsafe { lanes_avx2(fft, &mut job) },
        _ => unsafe { all_lanes::<[f32; 8]>(fft, &mut job) },
    }
}

// SAFETY (both functions): the processor must have the features, and shapes must be as [`transform_lanes`] checks them.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
unsafe fn lanes_avx2(fft: &BatchedFft<f32>, job: &mut LaneTable) {
    unsafe { all_lanes::<__m256>(fft, job) }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512dq,avx512vl,avx2,fma")]
unsafe fn lanes_avx512(fft: &BatchedFft<f32>, job: &mut LaneTable) {
    unsafe { all_lanes::<__m512>(fft, job) }
}

/// SAFETY: the processor must have V; shapes as [`transform_lanes`] checks them.
#[inline(always)]
unsafe fn all_lanes<V: Lanes<Number = f32>>(fft: &BatchedFft<f32>, job: &mut LaneTable) {
    for first in (0..job.lanes).step_by(V::COUNT) {
        // SAFETY: the caller guarantees it.
        unsafe {
            let table = Columns::<f32> {
                re: job.table.as_mut_ptr().add(job.first + first),
                step: job.stride,
                apart: job.lanes,
            };
            let scratch = Columns::<f32> {
                re: job.scratch.as_mut_ptr(),
                step: 2 * V::COUNT,
                apart: V::COUNT,
            };
            fft.long_pass::<V>(table, scratch);
            for block in (0..fft.size).step_by(fft.short.size) {
                fft.short.run::<V>(table.from(block));
            }
        }
    }
}

/// Columns of a table: pointer to the real parts. The imaginary parts follow `apart` numbers later, and the next row `step` numbers
/// later.
#[derive(Clone, Copy)]
struct Columns<T> {
    re: *mut T,
    step: usize,
    apart: usize,
}

impl<T: Real> Columns<T> {
    /// SAFETY (of all): the row must exist, and the processor must have V.
    #[inline(always)]
    unsafe fn at<V: Lanes<Number = T>>(self, row: usize) -> Pair<V> {
        // SAFETY: the caller guarantees it.
        unsafe {
            let re = self.re.add(row * self.step);
            Pair::load(re, re.add(self.apart))
        }
    }

    #[inline(always)]
    unsafe fn put<V: Lanes<Number = T>>(self, row: usize, value: Pair<V>) {
        // SAFETY: the caller guarantees it.
        unsafe {
            let re = self.re.add(row * self.step);
            value.store(re, re.add(self.apart));
        }
    }

    #[inline(always)]
    unsafe fn from(self, row: usize) -> Self {
        // SAFETY: the caller guarantees it.
        let re = unsafe { self.re.add(row * self.step) };
        Self { re, ..self }
    }
}

impl<T: Real> Steps<T> {
    /// The transform of `rows`, in place.
    ///
    /// SAFETY: `size` rows must exist, and the processor must have V.
    #[inline(always)]
    unsafe fn run<V: Lanes<Number = T>>(&self, rows: Columns<T>) {
        let mut size = self.size;
        for (radix, turns) in &self.steps {
            size /= radix;
            // SAFETY: the caller guarantees it.
            unsafe { self.step::<V>(*radix, rows, rows, size, turns) }
        }
    }

    /// As [`Self::run`], through `scratch`, with the result multiplied by `turns`.
    ///
    /// SAFETY: `size` rows must exist in either, as many turns, and the processor must have V.
    #[inline(always)]
    unsafe fn run_turned<V: Lanes<Number = T>>(
        &self,
        rows: Columns<T>,
        scratch: Columns<T>,
        turns: &[Complex<T>],
    ) {
        let mut size = self.size;
        let mut from = rows;
        for (radix, factors) in &self.steps {
            size /= radix;
            // SAFETY: the caller guarantees it.
            unsafe {
                if size > 1 {
                    self.step::<V>(*radix, from, scratch, size, factors);
                    from = scratch;
                    continue;
                }
                match radix {
                    2 => last::<V, Two, 2>(from, rows, turns),
                    3 => last::<V, Three, 3>(from, rows, turns),
                    4 => last::<V, Four, 4>(from, rows, turns),
                    _ => last::<V, Five, 5>(from, rows, turns),
                }
            }
        }
    }

    /// SAFETY: `size` rows must exist in either, radix - 1 turns for each of `next`, and the processor must have V.
    #[inline(always)]
    unsafe fn step<V: Lanes<Number = T>>(
        &self,
        radix: usize,
        from: Columns<T>,
        to: Columns<T>,
        next: usize,
        turns: &[Complex<T>],
    ) {
        for first in (0..self.size).step_by(radix * next) {
            // SAFETY: the caller guarantees it; first + radix next <= size.
            unsafe {
                let (from, to) = (from.from(first), to.from(first));
                match radix {
                    2 => step::<V, Two, 2>(from, to, next, turns),
                    3 => step::<V, Three, 3>(from, to, next, turns),
                    4 => step::<V, Four, 4>(from, to, next, turns),
                    _ => step::<V, Five, 5>(from, to, next, turns),
                }
            }
        }
    }
}

/// Transform of R values, with R small.
trait Small<V: Lanes, const R: usize> {
    /// SAFETY: the processor must have V.
    unsafe fn of(values: [Pair<V>; R]) -> [Pair<V>; R];
}

/// One step over R times `next` rows.
///
/// SAFETY: they must exist in either, R - 1 turns for each of `next`, and the processor must have V.
#[inline(always)]
unsafe fn step<V: Lanes, S: Small<V, R>, const R: usize>(
    from: Columns<V::Number>,
    to: Columns<V::Number>,
    next: usize,
    turns: &[Complex<V::Number>],
) where
    V::Number: Real,
{
    // SAFETY: the caller guarantees it.
    unsafe {
        if next == 1 {
            let out = S::of(std::array::from_fn(|m| from.at::<V>(m)));
            for (m, out) in out.into_iter().enumerate() {
                to.put::<V>(m, out);
            }
            return;
        }
        for j in 0..next {
            let out = S::of(std::array::from_fn(|m| from.at::<V>(j + m * next)));
            to.put::<V>(j, out[0]);
            let turns = turns.get_unchecked(j * (R - 1)..(j + 1) * (R - 1));
            for (m, (out, turn)) in out[1..].iter().zip(turns).enumerate() {
                to.put::<V>(j + (m + 1) * next, out.times(Pair::splat(*turn)));
            }
        }
    }
}

/// The last step, over all rows; the result is multiplied by `turns`.
///
/// SAFETY: rows must exist in either, and the processor must have V.
#[inline(always)]
unsafe fn last<V: Lanes, S: Small<V, R>, const R: usize>(
    from: Columns<V::Number>,
    to: Columns<V::Number>,
    turns: &[Complex<V::Number>],
) where
    V::Number: Real,
{
    for (k, turns) in turns.chunks_exact(R).enumerate() {
        // SAFETY: the caller guarantees it.
        unsafe {
            let out = S::of(std::array::from_fn(|m| from.at::<V>(R * k + m)));
            for (m, (out, turn)) in out.into_iter().zip(turns).enumerate() {
                to.put::<V>(R * k + m, out.times(Pair::splat(*turn)));
            }
        }
    }
}

struct Two;
struct Three;
struct Four;
struct Five;

impl<V: Lanes> Small<V, 2> for Two {
    #[inline(always)]
    unsafe fn of([a, b]: [Pair<V>; 2]) -> [Pair<V>; 2] {
        // SAFETY: the caller guarantees V.
        unsafe { [a.add(b), a.sub(b)] }
    }
}

impl<V: Lanes> Small<V, 3> for Three
where
    V::Number: Real,
{
    #[inline(always)]
    unsafe fn of([a, b, c]: [Pair<V>; 3]) -> [Pair<V>; 3] {
        // sin(2 pi / 3)
        const SIN: f64 = 0.866_025_403_784_438_6;
        // SAFETY: the caller guarantees V.
        unsafe {
            let real = |x: f64| V::splat(V::Number::narrow(x));
            let both = b.add(c);
            let off = b.sub(c).scale(real(SIN));
            let rest = both.scale_add(real(-0.5), a);
            [a.add(both), rest.sub_turned(off), rest.add_turned(off)]
        }
    }
}

impl<V: Lanes> Small<V, 4> for Four {
    #[inline(always)]
    unsafe fn of([a, b, c, d]: [Pair<V>; 4]) -> [Pair<V>; 4] {
        // SAFETY: the caller guarantees V.
        unsafe {
            let (even, even_off) = (a.add(c), a.sub(c));
            let (odd, odd_off) = (b.add(d), b.sub(d));
            [
                even.add(odd),
                even_off.sub_turned(odd_off),
                even.sub(odd),
                even_off.add_turned(odd_off),
            ]
        }
    }
}

impl<V: Lanes> Small<V, 5> for Five
where
    V::Number: Real,
{
    #[inline(always)]
    unsafe fn of([a, b, c, d, e]: [Pair<V>; 5]) -> [Pair<V>; 5] {
        // cos and sin of 2 pi / 5 and 4 pi / 5
        const COS: [f64; 2] = [0.309_016_994_374_947_45, -0.809_016_994_374_947_5];
        const SIN: [f64; 2] = [0.951_056_516_295_153_5, 0.587_785_252_292_473_1];
        // SAFETY: the caller guarantees V.
        unsafe {
            let real = |x: f64| V::splat(V::Number::narrow(x));
            let (outer, outer_off) = (b.add(e), b.sub(e));
            let (inner, inner_off) = (c.add(d), c.sub(d));
            let first = inner.scale_add(real(COS[1]), outer.scale_add(real(COS[0]), a));
            let second = inner.scale_add(real(COS[0]), outer.scale_add(real(COS[1]), a));
            let first_off = inner_off.scale_add(real(SIN[1]), outer_off.scale(real(SIN[0])));
            let second_off = inner_off.scale_add(real(-SIN[0]), outer_off.scale(real(SIN[1])));
            [
                a.add(outer.add(inner)),
                first.sub_turned(first_off),
                second.sub_turned(second_off),
                second.add_turned(second_off),
                first.add_turned(first_off),
            ]
        }
    }
}

/// Checks the assumptions of the vector loops: every lane that a point adds to exists, with [`MAX_TAPS`] numbers from its first
/// column.
fn check_spread<T: Real>(points: &Points<T>, across: &Across<T>, width: usize, table: usize) {
    let len = points.cell.len();
    assert_eq!(points.x.len(), len, "places");
    assert_eq!(across.column.len(), len, "columns");
    assert_eq!(across.value.len(), len, "values");
    let greatest = |v: &[u32]| v.iter().fold(0, |a, &b| a.max(b)) as usize;
    let last_column = greatest(across.column) + across.taps;
    assert!(
        last_column <= across.lanes && across.taps <= MAX_TAPS,
        "column {last_column} of {}",
        across.lanes
    );
    // One more row is needed for additions past the last imaginary part.
    let rows = greatest(points.cell) + width + 1;
    assert!(
        rows * 2 * across.lanes <= table && (1..=MAX_WIDTH).contains(&width),
        "{rows} rows of {} lanes in {table} numbers",
        across.lanes
    );
}

/// SAFETY: the processor must have V, and shapes must be as [`check_spread`] requires.
#[inline(always)]
unsafe fn spread<V: Lanes>(
    points: Points<V::Number>,
    across: Across<V::Number>,
    weights: &FlushWeights<V::Number>,
    table: &mut [V::Number],
) where
    V::Number: Real,
{
    // SAFETY: the caller guarantees it.
    unsafe {
        match weights.width {
            4 => spread_of::<V, 4>(points, across, weights, table),
            5 => spread_of::<V, 5>(points, across, weights, table),
            6 => spread_of::<V, 6>(points, across, weights, table),
            7 => spread_of::<V, 7>(points, across, weights, table),
            8 => spread_of::<V, 8>(points, across, weights, table),
            _ => spread_of::<V, MAX_WIDTH>(points, across, weights, table),
        }
    }
}

/// Loops of fixed length for kernels of width W. The largest W handles all other widths.
///
/// SAFETY: as [`spread`].
#[inline(always)]
unsafe fn spread_of<V: Lanes, const W: usize>(
    points: Points<V::Number>,
    across: Across<V::Number>,
    weights: &FlushWeights<V::Number>,
    table: &mut [V::Number],
) where
    V::Number: Real,
{
    const PARTS: usize = 2;
    let parts = MAX_TAPS / V::COUNT;
    let width = if W == MAX_WIDTH { weights.width } else { W };
    let step = 2 * across.lanes;
    let mut x = [V::Number::default(); STRIP];
    let mut values = [x; MAX_WIDTH];
    // SAFETY: MAX_TAPS numbers exist from lane `column` on in both halves of rows cell to cell +
    // width - 1; all slices have one entry per point. A value is MAX_TAPS real parts and as many
    // imaginary parts; no V has fewer lanes than a PARTS-th of them.
    unsafe {
        let table = table.as_mut_ptr();
        for j in 0..points.cell.len() {
            if j % STRIP == 0 {
                let count = points.x.len().min(j + STRIP) - j;
                x[..count].copy_from_slice(&points.x[j..j + count]);
                for (i, values) in values[..width].iter_mut().enumerate() {
                    along::<V>(&x, i, weights, values);
                }
            }
            let shares = across.value.as_ptr().add(j).cast::<V::Number>();
            let row: [Pair<V>; PARTS] = std::array::from_fn(|part| {
                let at = shares.add(part % parts * V::COUNT);
                Pair::load(at, at.add(MAX_TAPS))
            });
            let cell = *points.cell.get_unchecked(j) as usize;
            let column = *across.column.get_unchecked(j) as usize;
            let mut at = table.add(cell * step + column);
            for values in values.get_unchecked(..width) {
                let value = V::splat(*values.get_unchecked(j % STRIP));
                for (part, row) in row[..parts].iter().enumerate() {
                    let re = at.add(part * V::COUNT);
                    let im = re.add(across.lanes);
                    let sum = row.scale_add(value, Pair::load(re, im));
                    sum.store(re, im);
                }
                at = at.wrapping_add(step);
            }
        }
    }
}

/// Number of points whose row weights are computed together.
const STRIP: usize = 64;

/// Weights of points at `x` for tap `tap`.
///
/// SAFETY: the processor must have V; `weights` has a row for every moment.
#[inline(always)]
unsafe fn along<V: Lanes>(
    x: &[V::Number; STRIP],
    tap: usize,
    weights: &FlushWeights<V::Number>,
    out: &mut [V::Number; STRIP],
) where
    V::Number: Real,
{
    let (last, rest) = weights.doubled.split_last().expect("there are moments");
    for at in (0..STRIP).step_by(V::COUNT) {
        // SAFETY: STRIP is a multiple of every V's lanes.
        unsafe {
            let x = V::load(x.as_ptr().add(at));
            let sum = rest
                .iter()
                .rev()
                .fold(V::splat(last[2 * tap]), |sum, weights| {
                    sum.mul_add(x, V::splat(weights[2 * tap]))
                });
            sum.store(out.as_mut_ptr().add(at));
        }
    }
}

macro_rules! batched_fft {
    ($number:ty, $portable:ty, $avx2:ty, $spread_512:ty, $wide_512:ty, $mod:ident, $spread:ident, $transform:ident) => {
        #[cfg(target_arch = "x86_64")]
        mod $mod {
            use super::*;

            // SAFETY (of all): the processor must have the features; shapes as for the functions they call.
            #[target_feature(enable = "avx2,fma")]
            pub(crate) unsafe fn spread_avx2(
                points: Points<$number>,
                across: Across<$number>,
                weights: &FlushWeights<$number>,
                table: &mut [$number],
            ) {
                unsafe { spread::<$avx2>(points, across, weights, table) }
            }

            #[target_feature(enable = "avx512f,avx512dq,avx512vl,avx2,fma")]
            pub(crate) unsafe fn spread_avx512(
                points: Points<$number>,
                across: Across<$number>,
                weights: &FlushWeights<$number>,
                table: &mut [$number],
            ) {
                unsafe { spread::<$spread_512>(points, across, weights, table) }
            }

            #[target_feature(enable = "avx2,fma")]
            pub(crate) unsafe fn transform_avx2(
                batched_fft: &BatchedFft<$number>,
                job: &mut Job<$number>,
            ) {
                for first in (0..job.lanes).step_by(<$avx2>::COUNT) {
                    unsafe { batched_fft.group::<$avx2>(job, first) }
                }
            }

            #[target_feature(enable = "avx512f,avx512dq,avx512vl,avx2,fma")]
            pub(crate) unsafe fn transform_avx512(
                batched_fft: &BatchedFft<$number>,
                job: &mut Job<$number>,
            ) {
                let mut first = 0;
                while first + <$wide_512>::COUNT <= job.lanes {
                    unsafe { batched_fft.group::<$wide_512>(job, first) }
                    first += <$wide_512>::COUNT;
                }
                if first < job.lanes {
                    unsafe { batched_fft.group::<$spread_512>(job, first) }
                }
            }
        }

        /// See [`Real::spread`].
        pub(crate) fn $spread(
            simd_level: SimdLevel,
            points: Points<$number>,
            across: Across<$number>,
            weights: &FlushWeights<$number>,
            table: &mut [$number],
        ) {
            check_spread(&points, &across, weights.width, table.len());
            match simd_level.kind() {
                // SAFETY (all three calls): a `SimdLevel` of this kind exists only on processors with the features; shapes are
                // checked above.
                #[cfg(target_arch = "x86_64")]
                Kind::Avx512 => unsafe { $mod::spread_avx512(points, across, weights, table) },
                #[cfg(target_arch = "x86_64")]
                Kind::Avx2 => unsafe { $mod::spread_avx2(points, across, weights, table) },
                _ => unsafe { spread::<$portable>(points, across, weights, table) },
            }
        }

        /// See [`Real::transform`].
        pub(crate) fn $transform(
            simd_level: SimdLevel,
            batched_fft: &BatchedFft<$number>,
            mut job: Job<$number>,
        ) {
            batched_fft.check(&job);
            match simd_level.kind() {
                // SAFETY (all three calls): a `SimdLevel` of this kind exists only on processors with the features; shapes are
                // checked above.
                #[cfg(target_arch = "x86_64")]
                Kind::Avx512 => unsafe { $mod::transform_avx512(batched_fft, &mut job) },
                #[cfg(target_arch = "x86_64")]
                Kind::Avx2 => unsafe { $mod::transform_avx2(batched_fft, &mut job) },
                _ => {
                    for first in (0..job.lanes).step_by(<$portable>::COUNT) {
                        unsafe { batched_fft.group::<$portable>(&mut job, first) }
                    }
                }
            }
        }
    };
}

batched_fft!(
    f32,
    [f32; 8],
    __m256,
    __m256,
    __m512,
    of_f32,
    spread_32,
    transform_32
);
batched_fft!(
    f64,
    [f64; 8],
    __m256d,
    __m512d,
    __m512d,
    of_f64,
    spread_64,
    transform_64
);

#[cfg(test)]
mod tests {
    use super::*;
    use crate::array::gridded::kernel::Kernel;
    use crate::array::gridded::moments::{BLOCK, Shared};

    /// Pseudo-random numbers in -1..1.
    fn chance(i: usize) -> f64 {
        let x = (i as u64 + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15);
        let x = (x ^ (x >> 31)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        (x >> 11) as f64 / (1u64 << 52) as f64 - 1.0
    }

    /// Expected `spectrum` of columns with templates, in f64. `place.to` is the index of the frequency among the places.
    fn summed(rows: usize, lanes: usize, table: &[f64], templates: &[f64]) -> Vec<(f64, f64)> {
        let number = |all: &[f64], row: usize, lane: usize| {
            let at = 2 * lanes * row + lane;
            Complex::new(all[at], all[at + lanes])
        };
        let bin = |f: usize| {
            let all = (0..rows).flat_map(|row| (0..lanes).map(move |lane| (row, lane)));
            let sum = all.fold(Complex::new(0.0, 0.0), |sum, (row, lane)| {
                sum + number(table, row, lane)
                    * turn::<f64>(row * f, rows)
                    * number(templates, f, lane)
            });
            (sum.re, sum.im)
        };
        (0..rows).map(bin).collect()
    }

    /// Compares the transform with the definition of the sum, for every odd part of a grid size and for full and partial vectors of
    /// lanes.
    fn columns_add_up<T: Real + Into<f64>>(limit: f64) {
        for size in [8, 24, 40, 48, 72, 120, 512] {
            for lanes in [8, 16, 24] {
                let batched_fft = BatchedFft::<T>::new(size);
                let frequencies: Vec<usize> = batched_fft.frequencies().collect();
                let mut sorted = frequencies.clone();
                sorted.sort();
                assert!(sorted.into_iter().eq(0..size), "{size}");
                let of_table = |i: usize| chance(3 * i);
                let of_template = |i: usize| chance(3 * i + 1);
                let count = 2 * lanes * size;
                let table: Vec<f64> = (0..count).map(of_table).collect();
                let by_frequency: Vec<f64> = (0..count).map(of_template).collect();
                let want = summed(size, lanes, &table, &by_frequency);
                // The last frequency is not a bin. All others are stored at twice their spacing.
                let places: Vec<Place> = (0..size)
                    .filter(|&row| frequencies[row] + 1 < size)
                    .map(|row| Place {
                        row: row as u32,
                        to: 2 * frequencies[row] as u32,
                    })
                    .collect();
                let templates: Vec<T> = places
                    .iter()
                    .flat_map(|place| {
                        let f = place.to as usize / 2;
                        by_frequency[2 * lanes * f..][..2 * lanes].iter()
                    })
                    .map(|x| T::narrow(*x))
                    .collect();
                for simd_level in SimdLevel::available() {
                    let mut made: Vec<T> = table.iter().map(|x| T::narrow(*x)).collect();
                    let one = Complex::new(T::one(), T::zero());
                    let mut spectrum = vec![one; 2 * size];
                    let job = Job {
                        table: &mut made,
                        lanes,
                        places: &places,
                        templates: &templates,
                        template_lanes: lanes,
                        first_template: 0,
                        spectrum: &mut spectrum,
                        scratch: &mut vec![T::zero(); batched_fft.scratch_len()],
                    };
                    T::transform(simd_level, &batched_fft, job);
                    assert!(made.iter().all(|x| *x == T::zero()), "not emptied");
                    let mut worst: f64 = 0.0;
                    for (to, got) in spectrum.iter().enumerate() {
                        let bin = to % 2 == 0 && to / 2 + 1 < size;
                        let want = if bin { want[to / 2] } else { (0.0, 0.0) };
                        let (re, im): (f64, f64) = (got.re.into(), got.im.into());
                        worst = worst.max((re - 1.0 - want.0).hypot(im - want.1));
                    }
                    let scale = (lanes * size) as f64;
                    assert!(
                        worst < limit * scale.sqrt(),
                        "{simd_level:?}, {size} rows, {lanes} lanes: {worst:e}"
                    );
                }
            }
        }
    }

    // The result is a sum of up to 12,000 products of numbers below 1, rounded about ten times. In f64 the definition rounds as
    // much as the transform.
    #[test]
    fn columns_add_up_as_defined_in_f32_to_1e_6() {
        columns_add_up::<f32>(1e-6);
    }

    #[test]
    fn columns_add_up_as_defined_in_f64_to_5e_14() {
        columns_add_up::<f64>(5e-14);
    }

    /// Spreads points onto a table, one number at a time.
    fn spread_plainly<T: Real + Into<f64>>(
        points: &Points<T>,
        across: &Across<T>,
        kernel: &Kernel,
        table: &mut [f64],
    ) {
        for j in 0..points.cell.len() {
            let x: f64 = points.x[j].into();
            for i in 0..kernel.width {
                let weight = (0..T::MOMENTS)
                    .rev()
                    .fold(0.0, |sum, k| sum * x + kernel.weight(k, i));
                let row = 2 * across.lanes * (points.cell[j] as usize + i);
                for tap in 0..across.taps {
                    let at = row + across.column[j] as usize + tap;
                    let share = |q: usize| -> f64 { across.value[j][q].into() };
                    table[at] += weight * share(tap);
                    table[at + across.lanes] += weight * share(MAX_TAPS + tap);
                }
            }
        }
    }

    fn every_simd_level_spreads<T: Real + Into<f64>>(limit: f64) {
        const CELLS: usize = 23;
        let number = |i: usize| T::narrow(chance(i));
        let below = |i: usize, end: usize| (chance(i).abs() * end as f64) as u32;
        let cell: Vec<u32> = (0..BLOCK).map(|j| below(7 * j, CELLS)).collect();
        let x: Vec<T> = (0..BLOCK).map(|j| number(7 * j + 1)).collect();
        let amplitude = vec![Complex::new(T::one(), T::one()); BLOCK];
        for width in 2..=MAX_WIDTH {
            let kernel = Kernel::rough(width, 2.0, T::MOMENTS);
            let weights = FlushWeights::<T>::new(&kernel);
            for (taps, lanes) in [(1, 8), (5, 8), (8, 16), (6, 24)] {
                let column: Vec<u32> = (0..BLOCK)
                    .map(|j| below(7 * j + 4, lanes - taps + 1))
                    .collect();
                let value: Vec<Shared<T>> = (0..BLOCK)
                    .map(|j| {
                        let of = |q: usize| match q % MAX_TAPS < taps {
                            true => number(97 * j + q + 5),
                            false => T::zero(),
                        };
                        std::array::from_fn(of)
                    })
                    .collect();
                let points = Points {
                    cell: &cell,
                    x: &x,
                    amplitude: &amplitude,
                };
                let across = Across {
                    column: &column,
                    value: &value,
                    taps,
                    lanes,
                };
                let count = 2 * lanes * (CELLS + width + 1);
                let mut want = vec![1.0; count];
                spread_plainly(&points, &across, &kernel, &mut want);
                for simd_level in SimdLevel::available() {
                    let mut got = vec![T::one(); count];
                    T::spread(simd_level, points, across, &weights, &mut got);
                    let off = got.iter().zip(&want).map(|(&g, w)| (g.into() - w).abs());
                    let worst = off.fold(0.0, f64::max);
                    assert!(
                        worst < limit,
                        "{simd_level:?}, {width} x {taps} of {lanes}: {worst:e}"
                    );
                }
            }
        }
    }

    // Sums of about 100 terms below 1: a few roundings of 6e-8 or 1.1e-16 each.
    #[test]
    fn every_simd_level_spreads_points_over_columns_in_f32_to_3e_5() {
        every_simd_level_spreads::<f32>(3e-5);
    }

    #[test]
    fn every_simd_level_spreads_points_over_columns_in_f64_to_1e_13() {
        every_simd_level_spreads::<f64>(1e-13);
    }
}
