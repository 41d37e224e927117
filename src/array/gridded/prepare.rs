//! From a chunk of arrivals to points on the grids: middle of the echo, carrier phase there, place among the Doppler columns.
//!
//! An echo that leads at u with stretch eta = 1 + d has its middle at u + m, m = T/(2 eta), with the phase exp(j 2pi f_c (d m - u)). What
//! [`Coupling`] takes out of the templates moves it on by tau, with the phase exp(j pi f_c d tau).

use num_complex::Complex;

use crate::array::phasor::cis;
use crate::flow::{ArrivalChunk, CHUNK};

use super::dialect::{Dialect, Kind};
use super::doppler::{Coupling, DopplerGrid, DopplerSpan, POWERS};
use super::moments::{BLOCK, MAX_TAPS, Real};

const _: () = assert!(CHUNK == BLOCK, "a chunk is a block of points");

/// What does not change between the chunks of an element.
pub struct Frame<T> {
    pub carrier_hz: f64,
    pub half_pulse_s: f64,
    /// Stretch is left out: eta is 1.
    pub still: bool,
    pub coupling: Coupling,
    pub grid: DopplerGrid,
    /// The grid's weights as T.
    pub weights: [[T; MAX_TAPS]; POWERS],
    pub powers: usize,
}

/// What an element's Dopplers were said to be.
#[derive(Clone, Copy)]
pub struct Bounds {
    pub span: DopplerSpan,
    /// Column of the grid that is column 0 of the element.
    pub first_column: usize,
}

/// A chunk's points; `delay_s` is that of the middle.
pub struct Prepared<T> {
    pub delay_s: [f64; BLOCK],
    pub amplitude: [Complex<T>; BLOCK],
    pub column: [u32; BLOCK],
    pub weight: [[T; MAX_TAPS]; BLOCK],
}

impl<T: Real> Prepared<T> {
    pub fn new() -> Self {
        Self {
            delay_s: [0.0; BLOCK],
            amplitude: [Complex::new(T::zero(), T::zero()); BLOCK],
            column: [0; BLOCK],
            weight: [[T::zero(); MAX_TAPS]; BLOCK],
        }
    }
}

impl<T: Real> Frame<T> {
    /// Fills the first `chunk.len` points. Returns how many had a Doppler outside the span; they sound like the nearest in it.
    pub fn prepare(
        &self,
        dialect: Dialect,
        chunk: &ArrivalChunk,
        bounds: Bounds,
        points: &mut Prepared<T>,
    ) -> u64 {
        match dialect.kind() {
            // SAFETY (twice): a `Dialect` of this kind exists only where the processor has the features.
            #[cfg(target_arch = "x86_64")]
            Kind::Avx512 => unsafe { self.prepare_avx512(chunk, bounds, points) },
            #[cfg(target_arch = "x86_64")]
            Kind::Avx2 => unsafe { self.prepare_avx2(chunk, bounds, points) },
            _ => self.prepare_plain(chunk, bounds, points),
        }
    }

    /// The AVX-512 and AVX2 builds of [`Self::prepare_plain`]: the same arithmetic, so the same bits.
    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx512f,avx512dq,avx512vl")]
    fn prepare_avx512(
        &self,
        chunk: &ArrivalChunk,
        bounds: Bounds,
        points: &mut Prepared<T>,
    ) -> u64 {
        self.prepare_plain(chunk, bounds, points)
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2")]
    fn prepare_avx2(&self, chunk: &ArrivalChunk, bounds: Bounds, points: &mut Prepared<T>) -> u64 {
        self.prepare_plain(chunk, bounds, points)
    }

    #[inline(always)]
    fn prepare_plain(&self, chunk: &ArrivalChunk, bounds: Bounds, points: &mut Prepared<T>) -> u64 {
        let n = chunk.len.min(BLOCK);
        let DopplerSpan { least, greatest } = bounds.span;
        let mut doppler = [0.0; BLOCK];
        let mut outside = 0;
        if !self.still {
            for (held, &d) in doppler[..n].iter_mut().zip(&chunk.doppler) {
                outside += u64::from(!((d >= least) & (d <= greatest)));
                // In this order NaN becomes an end of the span too.
                *held = d.max(least).min(greatest);
            }
        }
        let (mut cos, mut sin) = ([0.0; BLOCK], [0.0; BLOCK]);
        for j in 0..n {
            let d = doppler[j];
            let per_eta = 1.0 / (1.0 + d);
            let middle_s = self.half_pulse_s * per_eta;
            let shift_s = self.coupling.per_doppler_s * d * per_eta * per_eta;
            let turns = self.carrier_hz * chunk.delay_s[j];
            // Whole turns away first: the rest keeps its digits.
            let turns = self.carrier_hz * d * (middle_s + 0.5 * shift_s)
                - (turns - turns.round_ties_even());
            points.delay_s[j] = chunk.delay_s[j] + (middle_s + shift_s);
            (cos[j], sin[j]) = cis(turns);
        }
        for j in 0..n {
            let a = chunk.amplitude[j];
            points.amplitude[j] = Complex::new(
                T::narrow(a.re * cos[j] - a.im * sin[j]),
                T::narrow(a.re * sin[j] + a.im * cos[j]),
            );
        }
        if self.grid.taps == 1 {
            return outside;
        }
        let mut place = [T::zero(); BLOCK];
        for j in 0..n {
            let (column, x) = self.grid.place(doppler[j]);
            points.column[j] = (column - bounds.first_column) as u32;
            place[j] = T::narrow(x);
        }
        let (highest, lower) = self.weights[..self.powers]
            .split_last()
            .expect("a power at least");
        for (weight, &x) in points.weight[..n].iter_mut().zip(&place) {
            let mut sum = *highest;
            for weights in lower.iter().rev() {
                for (sum, weight) in sum.iter_mut().zip(weights) {
                    *sum = *sum * x + *weight;
                }
            }
            *weight = sum;
        }
        outside
    }
}
