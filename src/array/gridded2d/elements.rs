//! Powers along the stretch to elements, and elements back to time.

use num_complex::Complex;

use crate::array::gridded::dialect::Kind;
use crate::array::phasor::{LANES, cis_lanes};

use super::engine::Work;
use super::lanes::{BLOCK, Lanes, Split};
use super::sample::Sample;
use super::task::Task;

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
        self.to_elements::<FUSED>(work);
        self.to_time::<FUSED>(work, output);
    }

    /// All columns to all elements, block by block, two pairs of elements at a time so that the powers are read half as often.
    #[inline(always)]
    fn to_elements<const FUSED: bool>(&self, work: &mut Work<T>) {
        let elements = self.stretch.along_m.len();
        let pairs = elements.div_ceil(2);
        work.elements.resize(elements * self.heard());
        work.rotors.clear();
        work.rotors
            .resize(2 * self.columns.next_multiple_of(LANES), [T::ZERO; 2]);
        for block in 0..self.engine.blocks.len() {
            let mut e = 0;
            while e + 2 <= pairs {
                self.pairs::<2, FUSED>(work, block, e);
                e += 2;
            }
            if e < pairs {
                self.pairs::<1, FUSED>(work, block, e);
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
        let powers = self.powers();
        let elements = self.stretch.along_m.len();
        let heard = self.heard();
        let carrier_hz = self.engine.ping.carrier_hz;
        let per_m = (carrier_hz + self.middle_hz(block)) / self.engine.ping.sound_speed_m_per_s;
        let room = self.columns.next_multiple_of(LANES);
        let mut x = [T::ZERO; PAIRS];
        let mut square = [T::ZERO; PAIRS];
        for p in 0..PAIRS {
            let y = self.stretch.along_m[first + p];
            let (turn, start) = (per_m * self.step * y, per_m * self.slope(0) * y);
            let rotors = &mut work.rotors[p * room..][..room];
            for (eight, rotors) in rotors.chunks_exact_mut(LANES).enumerate() {
                let turns = std::array::from_fn(|k| start + turn * (eight * LANES + k) as f64);
                let (cos, sin) = cis_lanes(turns);
                for (k, rotor) in rotors.iter_mut().enumerate() {
                    *rotor = [T::narrow(cos[k]), T::narrow(sin[k])];
                }
            }
            x[p] = T::narrow(y / self.half_m());
            square[p] = x[p] * x[p];
        }
        let (mut common, mut opposite) = ([Lanes::<T>::ZERO; PAIRS], [Lanes::<T>::ZERO; PAIRS]);
        for column in 0..self.columns {
            let at = (block * self.columns + column) * powers * BLOCK;
            for p in 0..PAIRS {
                let [cos, sin] = work.rotors[p * room + column];
                let even = every_second::<T, FUSED>(&work.moments, at, powers, 0, square[p]);
                common[p].add_real::<FUSED>(&even, cos);
                opposite[p].add_imaginary::<FUSED>(&even, sin);
                if powers > 1 {
                    let odd = every_second::<T, FUSED>(&work.moments, at, powers, 1, square[p]);
                    common[p].add_imaginary::<FUSED>(&odd, sin * x[p]);
                    opposite[p].add_real::<FUSED>(&odd, cos * x[p]);
                }
            }
        }
        for p in 0..PAIRS {
            let e = first + p;
            for (e, sign) in [(elements - 1 - e, -T::one()), (e, T::one())] {
                let at = e * heard + block * BLOCK;
                for lane in 0..BLOCK {
                    work.elements.re[at + lane] =
                        sign.times_plus::<FUSED>(opposite[p].re[lane], common[p].re[lane]);
                    work.elements.im[at + lane] =
                        sign.times_plus::<FUSED>(opposite[p].im[lane], common[p].im[lane]);
                }
            }
        }
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

/// The polynomial of every second of `powers` powers from the `parity`th on, in the square of the place.
#[inline(always)]
fn every_second<T: Sample, const FUSED: bool>(
    moments: &Split<T>,
    at: usize,
    powers: usize,
    parity: usize,
    square: T,
) -> Lanes<T> {
    let last = powers - 1 - (powers - 1 - parity) % 2;
    let mut value = Lanes::load(moments, at + last * BLOCK);
    let mut q = last;
    while q > parity {
        q -= 2;
        value.horner::<FUSED>(square, &Lanes::load(moments, at + q * BLOCK));
    }
    value
}
