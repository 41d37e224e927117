//! Conversion of a chunk of arrivals to points on the grids. A point has the delay of the echo's
//! middle, the carrier phase there, and a position among the Doppler columns.
//!
//! An echo with leading edge u and stretch eta = 1 + d has its middle at u + m, m = T/(2 eta), with
//! the phase exp(j 2pi f_c (d m - u)).
//!
//! With curvature q the middle is where eta m + q m^2 = T/2, and the phase is exp(j 2pi f_c (d m +
//! q m^2 - u)). The Doppler at the middle is sqrt(eta^2 + 2 q T) - 1. Where weights carry the
//! curvature ([`super::doppler`]), a delay and a Doppler correct their error at the ends of the
//! pulse.

use std::ops::Range;

use num_complex::Complex;

use crate::array::phasor::cis;
use crate::arrivals::{ArrivalChunk, CHUNK};

use super::doppler::{
    CurvatureWeights, DopplerGrid, DopplerSpan, POWERS, Polynomials, derivative, value_of,
};
use super::moments::{BLOCK, MAX_TAPS, ROUND, Real, Shared};
use echotank_core::simd::{Kind, SimdLevel};

const _: () = assert!(CHUNK == BLOCK, "a chunk is a block of points");

/// Parameters common to the chunks of an element.
#[derive(Clone, Copy)]
pub(super) struct Frame {
    pub carrier_hz: f64,
    pub(crate) half_pulse_s: f64,
    /// True without stretch: eta is 1.
    pub still: bool,
    /// Largest |q| and |p|; 0 without curvature.
    pub(crate) greatest_q: f64,
    pub(crate) greatest_p: f64,
    /// True if weights carry the curvature.
    pub(crate) curved: bool,
    /// Sweep rate of the pulse; 0 without a sweep.
    pub sweep_hz_per_s: f64,
}

/// Distribution of echoes over the columns of a Doppler grid.
pub(super) struct Columns<T> {
    pub grid: DopplerGrid,
    /// True if weights carry a curvature.
    curved: bool,
    /// Table of weights across a cell, with [`ENTRIES`] entries.
    table: Vec<Entry<T>>,
}

/// Numbers of entries of a table of weights across a cell, powers of two. Each entry is the centre of
/// a second-order Taylor series. The error is 1e-7, or 1e-11 with the finer table. Tolerances with
/// f64 moments need the finer table.
const ENTRIES: [usize; 2] = [128, 2048];

/// Weights at one position in a cell for each tap, with their derivatives and their curvature terms.
#[derive(Clone, Copy)]
#[repr(C)]
pub struct Entry<T> {
    /// Weights, their first derivative in x, and half the second derivative.
    pub plain: [[T; MAX_TAPS]; 3],
    /// Imaginary part of the factors of the curvature, and its derivative.
    pub imaginary: [[T; MAX_TAPS]; 2],
    /// Real part of the factors of the curvature.
    pub real: [T; MAX_TAPS],
    /// Real part of the factors of the squared curvature.
    pub(crate) real_2: [T; MAX_TAPS],
}

/// Inputs to the values of a chunk's points. `beyond` is the position of each point relative to the
/// centre of its table entry.
pub struct Sharing<'a, T> {
    pub table: &'a [Entry<T>],
    pub entry: &'a [u32],
    pub beyond: &'a [T],
    pub amplitude: &'a [Complex<T>],
    pub curvature: &'a [T],
}

/// Points of a chunk. `delay_s` is that of the echo's middle.
pub(super) struct Prepared<T> {
    pub delay_s: [f64; BLOCK],
    pub amplitude: [Complex<T>; BLOCK],
    /// Doppler at the middle.
    pub doppler: [f64; BLOCK],
    /// p relative to its largest value. If weights carry the curvature, p eta^4 relative to the
    /// largest p.
    pub curvature: [T; BLOCK],
    /// Largest |curvature|.
    pub(crate) max_curvature: f64,
    pub column: [u32; BLOCK],
    /// Weight times amplitude.
    pub value: [Shared<T>; BLOCK],
}

impl<T: Real> Prepared<T> {
    pub(super) fn new() -> Self {
        Self {
            delay_s: [0.0; BLOCK],
            amplitude: [Complex::new(T::zero(), T::zero()); BLOCK],
            doppler: [0.0; BLOCK],
            curvature: [T::zero(); BLOCK],
            max_curvature: 0.0,
            column: [0; BLOCK],
            value: [[T::zero(); 2 * MAX_TAPS]; BLOCK],
        }
    }
}

impl Frame {
    /// Writes the first `chunk.len` points except their columns. Echoes with a Doppler outside `span`
    /// (of the middles), or with too much curvature, are clamped. Returns their number.
    pub(super) fn prepare<T: Real>(
        &self,
        simd_level: SimdLevel,
        chunk: &ArrivalChunk,
        span: DopplerSpan,
        points: &mut Prepared<T>,
    ) -> u64 {
        match simd_level.kind() {
            // SAFETY (both calls): a `SimdLevel` of this kind exists only on processors with the
            // features.
            #[cfg(target_arch = "x86_64")]
            Kind::Avx512 => unsafe { self.prepare_avx512(chunk, span, points) },
            #[cfg(target_arch = "x86_64")]
            Kind::Avx2 => unsafe { self.prepare_avx2(chunk, span, points) },
            _ => self.prepare_plain(chunk, span, points),
        }
    }

    /// AVX-512 and AVX2 builds of [`Self::prepare_plain`], with the same arithmetic, so the same
    /// bits.
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
        // Difference between emission and reception of the middle: d m + q m^2.
        let mut ahead_s = [0.0; BLOCK];
        let mut middle_s = [0.0; BLOCK];
        let mut later_s = [0.0; BLOCK];
        points.max_curvature = 0.0;
        if self.still {
            points.doppler[..n].fill(0.0);
            middle_s[..n].fill(self.half_pulse_s);
        } else if self.greatest_q == 0.0 {
            for j in 0..n {
                let d = chunk.doppler[j];
                outside += u64::from(!((d >= least) & (d <= greatest)));
                // This order of operations also clamps NaN to an end of the span.
                let d = d.max(least).min(greatest);
                points.doppler[j] = d;
                middle_s[j] = self.half_pulse_s / (1.0 + d);
                ahead_s[j] = d * middle_s[j];
            }
        } else {
            let middles = Middles {
                ahead_s: &mut ahead_s,
                middle_s: &mut middle_s,
                later_s: &mut later_s,
            };
            outside = match self.gentle() {
                true => self.set_curvatures::<T, true>(chunk, span, points, middles),
                false => self.set_curvatures::<T, false>(chunk, span, points, middles),
            };
        }
        for j in 0..n {
            let turns = self.carrier_hz * chunk.delay_s[j];
            // Whole turns are removed first, which preserves the digits of the rest.
            let turns = self.carrier_hz * ahead_s[j] - (turns - turns.round_ties_even());
            points.delay_s[j] = chunk.delay_s[j] + (middle_s[j] + later_s[j]);
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

    /// Whether series give the roots of curved echoes with an error of at most 1e-13 of a middle.
    fn gentle(&self) -> bool {
        const MOST: f64 = 1e-3;
        4.0 * self.half_pulse_s * self.greatest_q <= 0.8 * MOST
    }

    /// Computes middles, their Dopplers and curvatures. Returns the number of echoes outside the
    /// design range.
    #[inline(always)]
    fn set_curvatures<T: Real, const GENTLE: bool>(
        &self,
        chunk: &ArrivalChunk,
        DopplerSpan { least, greatest }: DopplerSpan,
        points: &mut Prepared<T>,
        middles: Middles,
    ) -> u64 {
        let n = chunk.len.min(BLOCK);
        let half_s = self.half_pulse_s;
        let per_greatest = 1.0 / self.greatest_p;
        let (later_s2, faster) = match self.curved {
            true => (
                half_s.powi(2),
                half_s.powi(2) * self.sweep_hz_per_s / self.carrier_hz,
            ),
            false => (0.0, 0.0),
        };
        // The maximum of |curvature| is found through its bits, which have the same order. Compilers
        // vectorise the maximum of integers.
        let (mut outside, mut most) = (0, 0u64);
        for j in 0..n {
            let (d, q) = (chunk.doppler[j], chunk.curvature_per_s[j]);
            outside += u64::from(!((d >= least) & (d <= greatest) & (q.abs() <= self.greatest_q)));
            // This order of operations also clamps NaN to an end of the span.
            let d = d.max(least).min(greatest);
            let q = q.max(-self.greatest_q).min(self.greatest_q);
            let eta = 1.0 + d;
            // The eta of the middle is the root of eta^2 (1 + z).
            let (m, p, of_middle) = if GENTLE {
                let per_eta = 1.0 / eta;
                let z = 4.0 * half_s * q * per_eta * per_eta;
                (
                    half_s * per_eta * (1.0 - z * (0.25 - z * (0.125 - z * 0.078125))),
                    q * per_eta * per_eta * per_eta * (1.0 - z * (1.5 - z * 1.875)),
                    eta * (1.0 + z * (0.5 - z * 0.125)),
                )
            } else {
                let of_middle = (eta * eta + 4.0 * half_s * q).sqrt();
                (
                    2.0 * half_s / (eta + of_middle),
                    q / (of_middle * of_middle * of_middle),
                    of_middle,
                )
            };
            middles.middle_s[j] = m;
            middles.ahead_s[j] = (d + q * m) * m;
            middles.later_s[j] = later_s2 * p;
            // The difference from d is small, so this form loses no digits.
            points.doppler[j] = (d + 2.0 * q * m + faster * p).max(least).min(greatest);
            let curvature = match self.curved {
                true => q * of_middle * per_greatest,
                false => p * per_greatest,
            };
            points.curvature[j] = T::narrow(curvature);
            most = most.max(curvature.abs().to_bits());
        }
        points.max_curvature = f64::from_bits(most);
        outside
    }
}

/// For each echo of a chunk: emission minus reception time of the middle, delay of the middle after
/// the leading edge, and the correction of that delay.
struct Middles<'a> {
    ahead_s: &'a mut [f64; BLOCK],
    middle_s: &'a mut [f64; BLOCK],
    later_s: &'a mut [f64; BLOCK],
}

impl<T: Real> Columns<T> {
    /// `weights` has the curvature terms, and the phase at the ends of pulses for which
    /// they are designed.
    pub(super) fn new(grid: DopplerGrid, weights: Option<(CurvatureWeights, f64)>) -> Self {
        let entries = ENTRIES[usize::from(T::MOMENTS != 8)];
        let (b, max_rad) = match &weights {
            Some((weights, max_rad)) => (Some(weights), *max_rad),
            None => (None, 0.0),
        };
        let none = [[0.0; MAX_TAPS]; POWERS];
        let imaginary = b.map_or(none, |b| b.imaginary);
        let imaginary_slope = derivative(&imaginary, 1);
        let real = b.map_or(none, |b| b.real);
        let real_2 = b.map_or(none, |b| b.real_2);
        let (slope, bow) = (derivative(&grid.weights, 1), derivative(&grid.weights, 2));
        let table = (0..entries)
            .map(|e| {
                let x = (2 * e + 1) as f64 / entries as f64 - 1.0;
                let at = |powers: &Polynomials, factor: f64| -> [T; MAX_TAPS] {
                    std::array::from_fn(|tap| T::narrow(factor * value_of(powers, tap, x)))
                };
                Entry {
                    plain: [at(&grid.weights, 1.0), at(&slope, 1.0), at(&bow, 0.5)],
                    imaginary: [at(&imaginary, max_rad), at(&imaginary_slope, max_rad)],
                    real: at(&real, max_rad),
                    real_2: at(&real_2, max_rad * max_rad),
                }
            })
            .collect();
        Self {
            grid,
            curved: weights.is_some(),
            table,
        }
    }

    /// Computes the first columns of the first `n` points, relative to the first of `columns`, and
    /// the values there.
    pub(super) fn place(
        &self,
        simd_level: SimdLevel,
        n: usize,
        columns: Range<usize>,
        points: &mut Prepared<T>,
    ) {
        let n = n.min(BLOCK);
        let mut entry = [0u32; BLOCK];
        let mut beyond = [T::zero(); BLOCK];
        match simd_level.kind() {
            // SAFETY (both calls): a `SimdLevel` of this kind exists only on processors with the
            // features.
            #[cfg(target_arch = "x86_64")]
            Kind::Avx512 => unsafe {
                self.enter_avx512(n, columns, points, &mut entry, &mut beyond);
            },
            #[cfg(target_arch = "x86_64")]
            Kind::Avx2 => unsafe {
                self.enter_avx2(n, columns, points, &mut entry, &mut beyond);
            },
            _ => self.enter(n, columns, points, &mut entry, &mut beyond),
        }
        let sharing = Sharing {
            table: &self.table,
            entry: &entry[..n],
            beyond: &beyond[..n],
            amplitude: &points.amplitude[..n],
            curvature: &points.curvature[..n],
        };
        let value = &mut points.value[..n];
        match self.curved {
            true => T::share::<true>(simd_level, sharing, value),
            false => T::share::<false>(simd_level, sharing, value),
        }
    }

    /// AVX-512 and AVX2 builds of [`Self::enter`], with the same arithmetic, so the same bits.
    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx512f,avx512dq,avx512vl")]
    fn enter_avx512(
        &self,
        n: usize,
        columns: Range<usize>,
        points: &mut Prepared<T>,
        entry: &mut [u32; BLOCK],
        beyond: &mut [T; BLOCK],
    ) {
        self.enter(n, columns, points, entry, beyond)
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2")]
    fn enter_avx2(
        &self,
        n: usize,
        columns: Range<usize>,
        points: &mut Prepared<T>,
        entry: &mut [u32; BLOCK],
        beyond: &mut [T; BLOCK],
    ) {
        self.enter(n, columns, points, entry, beyond)
    }

    /// Computes the first columns of the points, their table entries, and the positions relative to
    /// the entries.
    #[inline(always)]
    fn enter(
        &self,
        n: usize,
        columns: Range<usize>,
        points: &mut Prepared<T>,
        entry: &mut [u32; BLOCK],
        beyond: &mut [T; BLOCK],
    ) {
        let first = columns.start as u32;
        let per_cell = self.table.len() as f64;
        // Entries of the columns that there are, halfway to the neighbours of the first and the last: rounding at an end of the ping's span selects none else.
        let cells = columns.len() - self.grid.taps + 1;
        let least = columns.start as f64 * per_cell - 0.5;
        let greatest = (columns.start + cells) as f64 * per_cell - 0.5;
        let greatest = greatest - greatest * f64::EPSILON;
        let (per_doppler, offset) = (
            self.grid.per_doppler * per_cell,
            self.grid.offset * per_cell,
        );
        let (shift, mask) = (
            self.table.len().trailing_zeros(),
            self.table.len() as u32 - 1,
        );
        for j in 0..n {
            // Entries count from the start of the span. Rounding half an entry earlier truncates, and
            // the low bits of the sum are the index.
            let position = (points.doppler[j] * per_doppler + offset - 0.5)
                .max(least)
                .min(greatest);
            let rounded = position + ROUND;
            let number = rounded.to_bits() as u32;
            points.column[j] = (number >> shift) - first;
            entry[j] = number & mask;
            beyond[j] = T::narrow((position - (rounded - ROUND)) * (2.0 / per_cell));
        }
    }
}

/// Portable version of the vector loops.
pub(crate) fn share_plain<T: Real, const BENT: bool>(points: Sharing<T>, values: &mut [Shared<T>]) {
    let Sharing {
        table,
        entry,
        beyond,
        amplitude,
        curvature,
    } = points;
    let all = values
        .iter_mut()
        .zip(entry)
        .zip(beyond)
        .zip(amplitude)
        .zip(curvature);
    for ((((value, &entry), &x), &c), &curvature) in all {
        let weights = &table[entry as usize];
        let (re, im) = value.split_at_mut(MAX_TAPS);
        for i in 0..MAX_TAPS {
            let [plain, slope, bow] = [0, 1, 2].map(|k| weights.plain[k][i]);
            let plain = plain + x * (slope + x * bow);
            if BENT {
                let real = plain + curvature * (weights.real[i] + curvature * weights.real_2[i]);
                let imaginary = curvature * (weights.imaginary[0][i] + x * weights.imaginary[1][i]);
                re[i] = c.re * real - c.im * imaginary;
                im[i] = c.re * imaginary + c.im * real;
            } else {
                re[i] = c.re * plain;
                im[i] = c.im * plain;
            }
        }
    }
}
