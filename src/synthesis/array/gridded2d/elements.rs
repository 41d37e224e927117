//! Powers along the section to elements, and elements back to time.

use num_complex::Complex;

use crate::array::phasor::{LANES, cis, cis_lanes};
use echotank_core::simd::Kind;

use super::engine::Work;
use super::lanes::{BLOCK, Lanes};
use super::sample::Sample;
use super::stages::{self, Stage};
use super::task::Task;

/// Pairs of elements and lanes processed together: as many sums as there are registers.
const PAIRS: usize = 2;
const PART: usize = 16;
/// Columns whose powers stay in the nearest cache while all pairs are processed.
const NEAR: usize = 8;

/// Real and imaginary parts.
type Part<T> = [[T; PART]; 2];

/// Of a pair of elements and a block: the common part, and the part with opposite signs, each as
/// real and imaginary parts.
pub(crate) type PairSums<T> = [[T; BLOCK]; 4];

/// Some columns of one block, the input of [`Sample::elements_wide`].
pub struct Columns<'a, T> {
    /// Of `count` columns, `[column][power][lane]`.
    pub(super) re: &'a [T],
    pub(super) im: &'a [T],
    pub(super) powers: usize,
    pub(super) first: usize,
    pub(super) count: usize,
    /// `[pair][column]`, with `room` entries per pair.
    pub(super) rotors: &'a [[T; 2]],
    pub(super) room: usize,
    /// Position of each pair, relative to half the section.
    pub(super) x: &'a [T],
    pub(super) sums: &'a mut [PairSums<T>],
}

impl<T: Sample> Task<'_, T> {
    /// From the filled grid to the samples of all elements.
    pub(super) fn run(&self, work: &mut Work<T>, output: &mut Vec<Complex<T>>) {
        #[cfg(target_arch = "x86_64")]
        match self.engine.simd_level.kind() {
            // SAFETY: such a `SimdLevel` proves that the processor has these features.
            Kind::Avx512 => return unsafe { self.run_avx512(work, output) },
            // SAFETY: as above.
            Kind::Avx2 => return unsafe { self.run_avx2(work, output) },
            Kind::Portable => {}
        }
        self.run_plain::<false>(work, output);
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx512f,avx512dq,avx512vl,avx2,fma")]
    fn run_avx512(&self, work: &mut Work<T>, output: &mut Vec<Complex<T>>) {
        self.run_plain::<true>(work, output);
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2,fma")]
    fn run_avx2(&self, work: &mut Work<T>, output: &mut Vec<Complex<T>>) {
        self.run_plain::<true>(work, output);
    }

    #[inline(always)]
    fn run_plain<const FUSED: bool>(&self, work: &mut Work<T>, output: &mut Vec<Complex<T>>) {
        self.to_spectra::<FUSED>(work);
        self.to_elements::<FUSED>(work);
        let mut since = stages::now();
        self.to_time::<FUSED>(work, output);
        work.stages.lap(Stage::Return, &mut since);
    }

    /// Sums all columns into all elements, block by block and a few columns at a time. The tables
    /// of the pulse for a block and the powers of those columns stay in the cache.
    #[inline(always)]
    fn to_elements<const FUSED: bool>(&self, work: &mut Work<T>) {
        let elements = self.section.along_m.len();
        let pairs = elements.div_ceil(2);
        let room = self.columns.next_multiple_of(LANES);
        work.elements.resize(elements * self.passed_bins());
        work.rotors.resize(pairs * room, [T::ZERO; 2]);
        let half_m = self.half_m();
        let places = self.section.along_m[..pairs].iter();
        work.places.clear();
        work.places.extend(places.map(|&y| T::narrow(y / half_m)));
        let near = NEAR.min(self.columns) * work.powers * BLOCK;
        work.moments.resize(near);
        let mut since = stages::now();
        for block in 0..self.engine.blocks.len() {
            self.chords::<FUSED>(work, block);
            work.stages.lap(Stage::Combine, &mut since);
            for (rotors, &y) in work
                .rotors
                .chunks_exact_mut(room)
                .zip(&self.section.along_m)
            {
                self.rotors(rotors, block, y);
            }
            work.sums.clear();
            work.sums.resize(pairs, [[T::ZERO; BLOCK]; 4]);
            for first in (0..self.columns).step_by(NEAR) {
                let count = NEAR.min(self.columns - first);
                work.stages.lap(Stage::Elements, &mut since);
                for near in 0..count {
                    self.block::<FUSED>(work, first + near, block, near);
                }
                work.stages.lap(Stage::Combine, &mut since);
                let len = count * work.powers * BLOCK;
                let columns = Columns {
                    re: &work.moments.re[..len],
                    im: &work.moments.im[..len],
                    powers: work.powers,
                    first,
                    count,
                    rotors: &work.rotors,
                    room,
                    x: &work.places,
                    sums: &mut work.sums,
                };
                if FUSED && T::takes_wide(work.powers, self.engine.simd_level) {
                    T::elements_wide(columns, self.engine.simd_level);
                } else {
                    all_pairs::<T, FUSED>(columns);
                }
            }
            self.part_of_elements::<FUSED>(work, block);
            work.stages.lap(Stage::Elements, &mut since);
        }
    }

    /// Separates pairs: the elements at y and -y have conjugate rotors, and the same even and odd
    /// powers.
    #[inline(always)]
    fn part_of_elements<const FUSED: bool>(&self, work: &mut Work<T>, block: usize) {
        let (elements, passed_bins) = (self.section.along_m.len(), self.passed_bins());
        for (pair, [re, im, opposite_re, opposite_im]) in work.sums.iter().enumerate() {
            for (e, sign) in [(elements - 1 - pair, -T::one()), (pair, T::one())] {
                let at = e * passed_bins + block * BLOCK;
                let (to_re, to_im) = (
                    &mut work.elements.re[at..][..BLOCK],
                    &mut work.elements.im[at..][..BLOCK],
                );
                for lane in 0..BLOCK {
                    to_re[lane] = sign.times_plus::<FUSED>(opposite_re[lane], re[lane]);
                    to_im[lane] = sign.times_plus::<FUSED>(opposite_im[lane], im[lane]);
                }
            }
        }
    }

    /// Rotors of an element at `y` for all columns, at the middle of a block: cosine and sine. Each
    /// eight follow from the eight before.
    #[inline(always)]
    fn rotors(&self, rotors: &mut [[T; 2]], block: usize, y: f64) {
        let carrier_hz = self.engine.ping.carrier_hz;
        let per_m = (carrier_hz + self.middle_hz(block)) / self.engine.ping.sound_speed_m_per_s;
        let (turn, start) = (per_m * self.step * y, per_m * self.slope(0) * y);
        let turns: [f64; LANES] = std::array::from_fn(|k| start + turn * k as f64);
        let (mut cos, mut sin) = cis_lanes(turns);
        let (cos_on, sin_on) = cis(LANES as f64 * turn);
        for rotors in rotors.chunks_exact_mut(LANES) {
            for (k, rotor) in rotors.iter_mut().enumerate() {
                *rotor = [T::narrow(cos[k]), T::narrow(sin[k])];
            }
            for k in 0..LANES {
                (cos[k], sin[k]) = (
                    cos[k] * cos_on - sin[k] * sin_on,
                    sin[k] * cos_on + cos[k] * sin_on,
                );
            }
        }
    }

    /// Transforms elements back to time.
    #[inline(always)]
    fn to_time<const FUSED: bool>(&self, work: &mut Work<T>, output: &mut Vec<Complex<T>>) {
        let bins = self.engine.bins();
        let c = self.engine.ping.sound_speed_m_per_s;
        let step_hz = self.engine.rate_hz / bins as f64;
        let zero = Complex::new(T::ZERO, T::ZERO);
        let first = self.engine.blocks.start * BLOCK;
        output.resize(self.section.along_m.len() * bins, zero);
        for (e, row) in output.chunks_exact_mut(bins).enumerate() {
            let per_hz = self.section.along_m[e] * self.step / c;
            row.fill(zero);
            for block in 0..self.engine.blocks.len() {
                let at = first + block * BLOCK;
                let start_hz =
                    self.engine.ping.carrier_hz + (at as f64 - (bins / 2) as f64) * step_hz;
                let inverse: [T; BLOCK] = self
                    .engine
                    .slope_inverse
                    .block::<T, FUSED>(|lane| per_hz * (start_hz + lane as f64 * step_hz));
                let from = Lanes::load(&work.elements, e * self.passed_bins() + block * BLOCK);
                // bins / 2 and the blocks are whole multiples of a block, so none wraps.
                let to = (at + bins - bins / 2) % bins;
                let (band, to) = (&self.engine.band[at..][..BLOCK], &mut row[to..][..BLOCK]);
                for lane in 0..BLOCK {
                    let factor = inverse[lane] * T::narrow(band[lane]);
                    to[lane] = Complex::new(from.re[lane] * factor, from.im[lane] * factor);
                }
            }
            self.engine
                .inverse
                .process_with_scratch(row, &mut work.scratch);
        }
    }
}

/// Adds columns to the sums of all pairs.
#[inline(always)]
pub(crate) fn all_pairs<T: Sample, const FUSED: bool>(mut columns: Columns<T>) {
    let pairs = columns.sums.len();
    for part in (0..BLOCK).step_by(PART) {
        let mut pair = 0;
        while pair + PAIRS <= pairs {
            add_columns::<T, PAIRS, FUSED>(&mut columns, part, pair);
            pair += PAIRS;
        }
        while pair < pairs {
            add_columns::<T, 1, FUSED>(&mut columns, part, pair);
            pair += 1;
        }
    }
}

/// Adds columns to the sums of some pairs, for part of a block's lanes.
#[inline(always)]
fn add_columns<T: Sample, const PAIRS: usize, const FUSED: bool>(
    columns: &mut Columns<T>,
    part: usize,
    pair: usize,
) {
    let powers = columns.powers;
    let zero = [[[T::ZERO; PART]; 2]; PAIRS];
    let odd_powers = powers / 2;
    let even_powers = powers - odd_powers;
    let x: [T; PAIRS] = std::array::from_fn(|p| columns.x[pair + p]);
    let square = x.map(|x| x * x);
    let lanes =
        |sums: &[T; BLOCK]| -> [T; PART] { sums[part..][..PART].try_into().expect("a part") };
    let mut sums: [[[T; PART]; 4]; PAIRS] =
        std::array::from_fn(|p| std::array::from_fn(|k| lanes(&columns.sums[pair + p][k])));
    let re = columns.re.chunks_exact(powers * BLOCK);
    let im = columns.im.chunks_exact(powers * BLOCK);
    for (column, (re, im)) in re.zip(im).enumerate() {
        let rotor = |p: usize| columns.rotors[(pair + p) * columns.room + columns.first + column];
        // From the highest power down. Even powers are finished before odd ones begin, to limit the
        // number of registers.
        let mut even = zero;
        for q in (0..even_powers).rev() {
            let next = part_of(re, im, 2 * q * BLOCK + part);
            horner::<T, PAIRS, FUSED>(&mut even, &square, next);
        }
        for p in 0..PAIRS {
            let [cos, sin] = rotor(p);
            let ([re, im], sums) = (even[p], &mut sums[p]);
            add_scaled::<T, FUSED>(&mut sums[0], &re, cos);
            add_scaled::<T, FUSED>(&mut sums[1], &im, cos);
            add_scaled::<T, FUSED>(&mut sums[2], &im, T::ZERO - sin);
            add_scaled::<T, FUSED>(&mut sums[3], &re, sin);
        }
        let mut odd = zero;
        for q in (0..odd_powers).rev() {
            let next = part_of(re, im, (2 * q + 1) * BLOCK + part);
            horner::<T, PAIRS, FUSED>(&mut odd, &square, next);
        }
        for p in 0..PAIRS {
            let [cos, sin] = rotor(p).map(|part| part * x[p]);
            let ([re, im], sums) = (odd[p], &mut sums[p]);
            add_scaled::<T, FUSED>(&mut sums[0], &im, T::ZERO - sin);
            add_scaled::<T, FUSED>(&mut sums[1], &re, sin);
            add_scaled::<T, FUSED>(&mut sums[2], &re, cos);
            add_scaled::<T, FUSED>(&mut sums[3], &im, cos);
        }
    }
    for (p, sums) in sums.iter().enumerate() {
        for (k, sum) in sums.iter().enumerate() {
            columns.sums[pair + p][k][part..][..PART].copy_from_slice(sum);
        }
    }
}

#[inline(always)]
fn part_of<'a, T>(re: &'a [T], im: &'a [T], at: usize) -> [&'a [T; PART]; 2] {
    let re: &[T; PART] = re[at..][..PART].try_into().expect("a part");
    let im: &[T; PART] = im[at..][..PART].try_into().expect("a part");
    [re, im]
}

#[inline(always)]
fn add_scaled<T: Sample, const FUSED: bool>(to: &mut [T; PART], from: &[T; PART], by: T) {
    for (to, from) in to.iter_mut().zip(from) {
        *to = from.times_plus::<FUSED>(by, *to);
    }
}

/// Horner step for polynomials of several positions: value times square plus the next coefficient.
#[inline(always)]
fn horner<T: Sample, const PAIRS: usize, const FUSED: bool>(
    value: &mut [Part<T>; PAIRS],
    square: &[T; PAIRS],
    [re, im]: [&[T; PART]; 2],
) {
    for p in 0..PAIRS {
        for j in 0..PART {
            value[p][0][j] = value[p][0][j].times_plus::<FUSED>(square[p], re[j]);
            value[p][1][j] = value[p][1][j].times_plus::<FUSED>(square[p], im[j]);
        }
    }
}
