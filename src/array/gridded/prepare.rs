//! From a chunk of arrivals to points on the grids: middle of the echo, carrier phase there, place among the Doppler columns.
//!
//! An echo that leads at u with stretch eta = 1 + d has its middle at u + m, m = T/(2 eta), with the phase exp(j 2pi f_c (d m - u)). What
//! [`Coupling`] takes out of the templates moves it on by tau, with the phase exp(j pi f_c d tau).
//!
//! With curvature q its middle comes where eta m + q m^2 = T/2, the phase is exp(j 2pi f_c (d m + q m^2 - u)), and d from there on that of
//! the middle: sqrt(eta^2 + 2 q T) - 1.

use num_complex::Complex;

use crate::array::phasor::cis;
use crate::flow::{ArrivalChunk, CHUNK};

use super::dialect::{Dialect, Kind};
use super::doppler::{Coupling, DopplerGrid, DopplerSpan, POWERS};
use super::moments::{BLOCK, MAX_TAPS, Real};

const _: () = assert!(CHUNK == BLOCK, "a chunk is a block of points");

/// What does not change between the chunks of an element.
pub struct Frame {
    pub carrier_hz: f64,
    pub half_pulse_s: f64,
    /// Stretch is left out: eta is 1.
    pub still: bool,
    /// Greatest |q| and |p|; 0 where curvature is left out.
    pub greatest_q: f64,
    pub greatest_p: f64,
    pub coupling: Coupling,
}

/// Where echoes go among the columns of a grid of Dopplers.
pub struct Columns<T> {
    pub grid: DopplerGrid,
    /// The grid's weights as T.
    pub weights: [[T; MAX_TAPS]; POWERS],
}

/// A chunk's points; `delay_s` is that of the middle.
pub struct Prepared<T> {
    pub delay_s: [f64; BLOCK],
    pub amplitude: [Complex<T>; BLOCK],
    /// Of the middle.
    pub doppler: [f64; BLOCK],
    /// p over the greatest.
    pub bend: [T; BLOCK],
    /// Greatest |bend|.
    pub most_bent: f64,
    pub column: [u32; BLOCK],
    pub weight: [[T; MAX_TAPS]; BLOCK],
}

impl<T: Real> Prepared<T> {
    pub fn new() -> Self {
        Self {
            delay_s: [0.0; BLOCK],
            amplitude: [Complex::new(T::zero(), T::zero()); BLOCK],
            doppler: [0.0; BLOCK],
            bend: [T::zero(); BLOCK],
            most_bent: 0.0,
            column: [0; BLOCK],
            weight: [[T::zero(); MAX_TAPS]; BLOCK],
        }
    }
}

impl Frame {
    /// Fills the first `chunk.len` points but for their columns. Returns how many had a Doppler outside `span`, that of middles, or more
    /// curvature than there is room for; they sound like the nearest within.
    pub fn prepare<T: Real>(
        &self,
        dialect: Dialect,
        chunk: &ArrivalChunk,
        span: DopplerSpan,
        points: &mut Prepared<T>,
    ) -> u64 {
        match dialect.kind() {
            // SAFETY (twice): a `Dialect` of this kind exists only where the processor has the features.
            #[cfg(target_arch = "x86_64")]
            Kind::Avx512 => unsafe { self.prepare_avx512(chunk, span, points) },
            #[cfg(target_arch = "x86_64")]
            Kind::Avx2 => unsafe { self.prepare_avx2(chunk, span, points) },
            _ => self.prepare_plain(chunk, span, points),
        }
    }

    /// The AVX-512 and AVX2 builds of [`Self::prepare_plain`]: the same arithmetic, so the same bits.
    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx512f,avx512dq,avx512vl")]
    fn prepare_avx512<T: Real>(
        &self,
        chunk: &ArrivalChunk,
        span: DopplerSpan,
        points: &mut Prepared<T>,
    ) -> u64 {
        self.prepare_plain(chunk, span, points)
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2")]
    fn prepare_avx2<T: Real>(
        &self,
        chunk: &ArrivalChunk,
        span: DopplerSpan,
        points: &mut Prepared<T>,
    ) -> u64 {
        self.prepare_plain(chunk, span, points)
    }

    #[inline(always)]
    fn prepare_plain<T: Real>(
        &self,
        chunk: &ArrivalChunk,
        span: DopplerSpan,
        points: &mut Prepared<T>,
    ) -> u64 {
        let n = chunk.len.min(BLOCK);
        let DopplerSpan { least, greatest } = span;
        let mut outside = 0;
        let (mut cos, mut sin) = ([0.0; BLOCK], [0.0; BLOCK]);
        let doppler = &mut points.doppler;
        // Of the middle's emission before its reception: d m + q m^2.
        let mut ahead_s = [0.0; BLOCK];
        let mut middle_s = [0.0; BLOCK];
        points.most_bent = 0.0;
        if self.still {
            doppler[..n].fill(0.0);
            middle_s[..n].fill(self.half_pulse_s);
        } else if self.greatest_q == 0.0 {
            for j in 0..n {
                let d = chunk.doppler[j];
                outside += u64::from(!((d >= least) & (d <= greatest)));
                // In this order NaN becomes an end of the span too.
                let d = d.max(least).min(greatest);
                doppler[j] = d;
                middle_s[j] = self.half_pulse_s / (1.0 + d);
                ahead_s[j] = d * middle_s[j];
            }
        } else {
            let per_greatest = 1.0 / self.greatest_p;
            let mut most = 0.0f64;
            for j in 0..n {
                let (d, q) = (chunk.doppler[j], chunk.curvature_per_s[j]);
                outside +=
                    u64::from(!((d >= least) & (d <= greatest) & (q.abs() <= self.greatest_q)));
                let d = d.max(least).min(greatest);
                let q = q.max(-self.greatest_q).min(self.greatest_q);
                let eta = 1.0 + d;
                let of_middle = (eta * eta + 4.0 * self.half_pulse_s * q).sqrt();
                let m = 2.0 * self.half_pulse_s / (eta + of_middle);
                middle_s[j] = m;
                ahead_s[j] = (d + q * m) * m;
                // Its difference from d is a small one: no digits are lost.
                doppler[j] = (d + 2.0 * q * m).max(least).min(greatest);
                let bend = q / (of_middle * of_middle * of_middle) * per_greatest;
                points.bend[j] = T::narrow(bend);
                most = most.max(bend.abs());
            }
            points.most_bent = most;
        }
        for j in 0..n {
            let d = doppler[j];
            let per_eta = 1.0 / (1.0 + d);
            let shift_s = self.coupling.per_doppler_s * d * per_eta * per_eta;
            let turns = self.carrier_hz * chunk.delay_s[j];
            // Whole turns away first: the rest keeps its digits.
            let turns = self.carrier_hz * (ahead_s[j] + 0.5 * d * shift_s)
                - (turns - turns.round_ties_even());
            points.delay_s[j] = chunk.delay_s[j] + (middle_s[j] + shift_s);
            (cos[j], sin[j]) = cis(turns);
        }
        for j in 0..n {
            let a = chunk.amplitude[j];
            points.amplitude[j] = Complex::new(
                T::narrow(a.re * cos[j] - a.im * sin[j]),
                T::narrow(a.re * sin[j] + a.im * cos[j]),
            );
        }
        outside
    }
}

impl<T: Real> Columns<T> {
    pub fn new(grid: DopplerGrid) -> Self {
        Self {
            weights: grid.weights.map(|row| row.map(T::narrow)),
            grid,
        }
    }

    /// First columns, counted from `first_column`, and weights of the first `n` points.
    pub fn place(&self, dialect: Dialect, n: usize, first_column: usize, points: &mut Prepared<T>) {
        match dialect.kind() {
            // SAFETY (twice): a `Dialect` of this kind exists only where the processor has the features.
            #[cfg(target_arch = "x86_64")]
            Kind::Avx512 => unsafe { self.place_avx512(n, first_column, points) },
            #[cfg(target_arch = "x86_64")]
            Kind::Avx2 => unsafe { self.place_avx2(n, first_column, points) },
            _ => self.place_plain(n, first_column, points),
        }
    }

    /// The AVX-512 and AVX2 builds of [`Self::place_plain`]: the same arithmetic, so the same bits.
    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx512f,avx512dq,avx512vl")]
    fn place_avx512(&self, n: usize, first_column: usize, points: &mut Prepared<T>) {
        self.place_plain(n, first_column, points)
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2")]
    fn place_avx2(&self, n: usize, first_column: usize, points: &mut Prepared<T>) {
        self.place_plain(n, first_column, points)
    }

    #[inline(always)]
    fn place_plain(&self, n: usize, first_column: usize, points: &mut Prepared<T>) {
        let n = n.min(BLOCK);
        let mut place = [T::zero(); BLOCK];
        let placed = place.iter_mut().zip(&mut points.column);
        for ((place, column), &doppler) in placed.zip(&points.doppler).take(n) {
            let (cell, x) = self.grid.place(doppler);
            *column = (cell - first_column) as u32;
            *place = T::narrow(x);
        }
        let (highest, lower) = self.weights[..self.grid.powers]
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
    }
}
