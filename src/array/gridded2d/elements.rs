//! Powers along the stretch to elements, and elements back to time.

use std::time::Instant;

use num_complex::Complex;

use crate::array::gridded::dialect::Kind;
use crate::array::phasor::{LANES, cis, cis_lanes};

use super::engine::Work;
use super::lanes::{BLOCK, Lanes};
use super::sample::Sample;
use super::stages::Stage;
use super::task::Task;

/// Pairs of elements worked on together, and lanes: as many sums as there are registers for.
const PAIRS: usize = 4;
const PART: usize = 16;

/// Real and imaginary parts, pair by pair.
type Sums<T, const PAIRS: usize> = [[[T; PART]; 2]; PAIRS];

impl<T: Sample> Task<'_, T> {
    /// From the filled grid to the samples of all elements.
    pub fn run(&self, work: &mut Work<T>, output: &mut Vec<Complex<T>>) {
        #[cfg(target_arch = "x86_64")]
        match self.engine.dialect.kind() {
            // SAFETY: a `Dialect` of that kind is proof that the processor has these.
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
        self.to_moments::<FUSED>(work);
        let mut since = Instant::now();
        self.to_elements::<FUSED>(work);
        work.stages.lap(Stage::Elements, &mut since);
        self.to_time::<FUSED>(work, output);
        work.stages.lap(Stage::Return, &mut since);
    }

    /// All columns to all elements, block by block, some pairs of elements at a time so that the powers are read less often.
    #[inline(always)]
    fn to_elements<const FUSED: bool>(&self, work: &mut Work<T>) {
        let elements = self.stretch.along_m.len();
        let pairs = elements.div_ceil(2);
        work.elements.resize(elements * self.heard());
        work.rotors.clear();
        work.rotors
            .resize(PAIRS * self.columns.next_multiple_of(LANES), [T::ZERO; 2]);
        for block in 0..self.engine.blocks.len() {
            let mut e = 0;
            while e + PAIRS <= pairs {
                self.pairs::<PAIRS, FUSED>(work, block, e);
                e += PAIRS;
            }
            while e < pairs {
                self.pairs::<1, FUSED>(work, block, e);
                e += 1;
            }
        }
    }

    /// Elements `first`, ... and their images: at y and -y they have conjugate rotors, and the same even and odd powers.
    #[inline(always)]
    fn pairs<const PAIRS: usize, const FUSED: bool>(
        &self,
        work: &mut Work<T>,
        block: usize,
        first: usize,
    ) {
        let elements = self.stretch.along_m.len();
        let heard = self.heard();
        let mut x = [T::ZERO; PAIRS];
        let room = self.columns.next_multiple_of(LANES);
        for (p, x) in x.iter_mut().enumerate() {
            let y = self.stretch.along_m[first + p];
            self.rotors(&mut work.rotors[p * room..][..room], block, y);
            *x = T::narrow(y / self.half_m());
        }
        for part in (0..BLOCK).step_by(PART) {
            let [common, opposite] = self.sums::<PAIRS, FUSED>(work, block, part, &x);
            for p in 0..PAIRS {
                let e = first + p;
                for (e, sign) in [(elements - 1 - e, -T::one()), (e, T::one())] {
                    let at = e * heard + block * BLOCK + part;
                    for lane in 0..PART {
                        work.elements.re[at + lane] =
                            sign.times_plus::<FUSED>(opposite[p][0][lane], common[p][0][lane]);
                        work.elements.im[at + lane] =
                            sign.times_plus::<FUSED>(opposite[p][1][lane], common[p][1][lane]);
                    }
                }
            }
        }
    }

    /// Of an element at `y` to all columns, at the middle of a block: cosine and sine. Each eight follow from the eight before.
    #[inline(always)]
    fn rotors(&self, rotors: &mut [[T; 2]], block: usize, y: f64) {
        let carrier_hz = self.engine.ping.carrier_hz;
        let per_m = (carrier_hz + self.middle_hz(block)) / self.engine.ping.sound_speed_m_per_s;
        let (turn, start) = (per_m * self.step * y, per_m * self.slope(0) * y);
        let (mut cos, mut sin) = cis_lanes(std::array::from_fn(|k: usize| start + turn * k as f64));
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

    /// Over all columns, for part of a block's lanes: what both elements of a pair have in common, and what with opposite signs.
    #[inline(always)]
    fn sums<const PAIRS: usize, const FUSED: bool>(
        &self,
        work: &Work<T>,
        block: usize,
        part: usize,
        x: &[T; PAIRS],
    ) -> [Sums<T, PAIRS>; 2] {
        let powers = work.powers;
        let room = self.columns.next_multiple_of(LANES);
        let zero = [[[T::ZERO; PART]; 2]; PAIRS];
        let (mut common, mut opposite) = (zero, zero);
        let odd_powers = powers / 2;
        let even_powers = powers - odd_powers;
        let mut square = *x;
        for x in &mut square {
            *x = *x * *x;
        }
        let per_column = powers * BLOCK;
        let from = block * self.columns * per_column;
        let re = work.moments.re[from..][..self.columns * per_column].chunks_exact(per_column);
        let im = work.moments.im[from..][..self.columns * per_column].chunks_exact(per_column);
        for (column, (re, im)) in re.zip(im).enumerate() {
            // From the highest power down.
            let mut even = zero;
            for q in (0..even_powers).rev() {
                let next = part_of(re, im, 2 * q * BLOCK + part);
                horner::<T, PAIRS, FUSED>(&mut even, &square, next);
            }
            let mut odd = zero;
            for q in (0..odd_powers).rev() {
                let next = part_of(re, im, (2 * q + 1) * BLOCK + part);
                horner::<T, PAIRS, FUSED>(&mut odd, &square, next);
            }
            for p in 0..PAIRS {
                let [cos, sin] = work.rotors[p * room + column];
                let (cos_x, sin_x) = (cos * x[p], sin * x[p]);
                let ([even_re, even_im], [odd_re, odd_im]) = (even[p], odd[p]);
                for j in 0..PART {
                    let c = common[p][0][j];
                    common[p][0][j] = (T::ZERO - odd_im[j])
                        .times_plus::<FUSED>(sin_x, even_re[j].times_plus::<FUSED>(cos, c));
                    let c = common[p][1][j];
                    common[p][1][j] = odd_re[j]
                        .times_plus::<FUSED>(sin_x, even_im[j].times_plus::<FUSED>(cos, c));
                    let o = opposite[p][0][j];
                    opposite[p][0][j] = odd_re[j].times_plus::<FUSED>(
                        cos_x,
                        (T::ZERO - even_im[j]).times_plus::<FUSED>(sin, o),
                    );
                    let o = opposite[p][1][j];
                    opposite[p][1][j] = odd_im[j]
                        .times_plus::<FUSED>(cos_x, even_re[j].times_plus::<FUSED>(sin, o));
                }
            }
        }
        [common, opposite]
    }

    /// Elements back to time.
    #[inline(always)]
    fn to_time<const FUSED: bool>(&self, work: &mut Work<T>, output: &mut Vec<Complex<T>>) {
        let bins = self.engine.bins();
        let c = self.engine.ping.sound_speed_m_per_s;
        let step_hz = self.engine.rate_hz / bins as f64;
        let zero = Complex::new(T::ZERO, T::ZERO);
        let first = self.engine.blocks.start * BLOCK;
        output.resize(self.stretch.along_m.len() * bins, zero);
        for (e, row) in output.chunks_exact_mut(bins).enumerate() {
            let per_hz = self.stretch.along_m[e] * self.step / c;
            row.fill(zero);
            for block in 0..self.engine.blocks.len() {
                let at = first + block * BLOCK;
                let start_hz =
                    self.engine.ping.carrier_hz + (at as f64 - (bins / 2) as f64) * step_hz;
                let inverse: [T; BLOCK] = self
                    .engine
                    .slope_inverse
                    .block::<T, FUSED>(|lane| per_hz * (start_hz + lane as f64 * step_hz));
                let from = Lanes::load(&work.elements, e * self.heard() + block * BLOCK);
                // Both bins / 2 and blocks are whole multiples of a block, so that none wraps.
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

#[inline(always)]
fn part_of<'a, T>(re: &'a [T], im: &'a [T], at: usize) -> [&'a [T; PART]; 2] {
    let re: &[T; PART] = re[at..][..PART].try_into().expect("a part");
    let im: &[T; PART] = im[at..][..PART].try_into().expect("a part");
    [re, im]
}

/// Polynomials of several places at once: value times square plus the next coefficient.
#[inline(always)]
fn horner<T: Sample, const PAIRS: usize, const FUSED: bool>(
    value: &mut Sums<T, PAIRS>,
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
