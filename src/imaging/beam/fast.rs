//! Far-field fan of a line array by FFTs over time and over the line, in f32. It computes the same beams as `exact` at a fraction of the
//! cost.
//!
//! At every frequency of the record, each beam is one sum over equally spaced elements,
//!
//! ```text
//! Y_b(f) = sum_e w_e X_e(f) exp(-j 2pi u_b (e - (E-1)/2)),    u_b = (f + f_c) d sin(theta_b)/c cycles per element
//! ```
//!
//! The directions u_b are arbitrary: equal steps of angle, of distance or of sine, with or without roll stabilisation. (A chirp-z transform
//! supports equal steps of sine only and needs two transforms of E + B points; this method needs one of 2 E.) The elements are transformed
//! onto a grid of at least 2 E directions. Each beam is interpolated from [`TAPS`] grid values with a kernel whose transform has been
//! divided out of the element weights. This is a nonuniform FFT of type 2 with a Kaiser-Bessel kernel (Fessler and Sutton 2003). Directions
//! are periodic in u with period 1, so that sparse arrays (subarrays with grating lobes) need no special treatment.
//!
//! Rows are transformed and matched-filtered in f64. The sum over elements and the inverse transform use f32, with rounding about 140 dB
//! below the largest sample of a beam. Work is split by element, by frequency and by beam; no sum crosses threads.
//!
//! Not modelled: near-field focus, motion. The samples contain the element patterns.

use std::f64::consts::{PI, TAU};
use std::sync::Arc;

use echotank_fft::{Fft, Planned};
use num_complex::{Complex32, Complex64};
use rayon::prelude::*;

use super::steered::SteeredArray;
use super::weights;
use echotank_core::ping::{BeamFrame, ElementFrame, PingPlan};
use echotank_core::simd::SimdLevel;

/// Width of the interpolation kernel in steps of the direction grid. With a grid oversampled by two, its error is 1e-7.
const TAPS: usize = 8;
/// Number of tabulated kernel positions per grid step; linear interpolation between them has an error of 5e-7.
const KERNEL_STEPS: usize = 512;
/// Number of frequencies processed together: one cache line per element.
const TILE: usize = 16;
/// Far-field fan of one receive array.
pub struct FastFan {
    steered: SteeredArray,
    /// Element weights divided by the kernel's transform.
    spread: Vec<f32>,
    inverse: Arc<dyn Fft<f32>>,
    /// Transform over the elements.
    line: Arc<dyn Fft<f32>>,
    /// exp(-j pi k/N) over the unwrapped grid for an even number of elements, whose centre lies between two elements; ones for an odd
    /// number.
    half_step: Vec<Complex32>,
    kernel: Vec<[f32; TAPS]>,
    /// Element-major spectra in f32 after the matched filter. Rows are a tile longer than the transform, so that elements do not collide in
    /// the caches.
    spectra: Vec<Complex32>,
    stride: usize,
    /// Beam spectra by tiles of frequencies: for each beam the values of the tile.
    mixed: Vec<Complex32>,
    simd_level: SimdLevel,
    workers: Vec<Worker>,
}

/// Buffers of one share of the work.
struct Worker {
    row: Vec<Complex64>,
    scratch: Vec<Complex64>,
    beam: Vec<Complex32>,
    beam_scratch: Vec<Complex32>,
    /// One tile of weighted element values: all elements for each frequency.
    tile: Vec<Complex32>,
    line: Vec<Complex32>,
    line_scratch: Vec<Complex32>,
    grid: Grid,
    indices: Vec<GridIndex>,
}

/// Values of one frequency over the directions from -1/2 to 1/2, extended by half a kernel on each side: real parts, imaginary parts.
struct Grid {
    re: Vec<f32>,
    im: Vec<f32>,
}

/// Position of one beam on the direction grid.
#[derive(Clone, Copy, Default)]
struct GridIndex {
    first: u32,
    /// Position in the kernel table: index and fraction.
    entry: u32,
    fraction: f32,
    sign: f32,
}

impl FastFan {
    /// Work is shared among the threads of the current pool.
    pub(super) fn new(steered: SteeredArray) -> Self {
        let elements = steered.elements();
        let correlator = &steered.correlator;
        let length = correlator.length();
        let grid = (2 * elements).next_power_of_two().max(2 * TAPS);
        let kernel = Kernel::new(grid as f64 / elements as f64);
        let spread = steered.weights.iter().enumerate().map(|(e, w)| {
            let index = e as f64 - (elements / 2) as f64 + middle(elements);
            (w / kernel.transform(index / grid as f64)) as f32
        });
        let (inverse, line) = (f32::plan_inverse(length), f32::plan_forward(grid));
        let zero = Complex32::new(0.0, 0.0);
        let worker = || Worker {
            row: vec![Complex64::ZERO; length],
            scratch: correlator.make_scratch(),
            beam: vec![zero; length],
            beam_scratch: vec![zero; inverse.get_inplace_scratch_len()],
            tile: vec![zero; TILE * elements],
            line: vec![zero; grid],
            line_scratch: vec![zero; line.get_inplace_scratch_len()],
            grid: Grid {
                re: vec![0.0; grid + TAPS + 1],
                im: vec![0.0; grid + TAPS + 1],
            },
            indices: vec![GridIndex::default(); steered.beams()],
        };
        let half_step = (0..grid + TAPS + 1).map(|i| {
            let k = i as f64 - (grid / 2 + TAPS / 2) as f64;
            let turn = Complex64::from_polar(1.0, -TAU * middle(elements) * k / grid as f64);
            Complex32::new(turn.re as f32, turn.im as f32)
        });
        Self {
            spread: spread.collect(),
            half_step: half_step.collect(),
            kernel: kernel.table(),
            spectra: vec![zero; (length + TILE) * elements],
            stride: length + TILE,
            mixed: vec![zero; length * steered.beams()],
            simd_level: SimdLevel::best(),
            workers: (0..rayon::current_num_threads().max(1))
                .map(|_| worker())
                .collect(),
            steered,
            inverse,
            line,
        }
    }

    /// Index of the fan's receive array.
    pub fn array(&self) -> usize {
        self.steered.array()
    }

    /// Forms the beams of one ping. `frame` holds the samples of the fan's array; `out` grows once to its maximum size and is reused.
    pub fn form(&mut self, plan: &PingPlan, frame: &ElementFrame, out: &mut BeamFrame) {
        self.steered.begin(plan, frame);
        self.steered.size(frame.samples, out);
        if frame.samples == 0 {
            return;
        }
        self.transform_elements(frame);
        self.mix();
        self.transform_beams(frame.samples, &mut out.iq);
    }

    fn transform_elements(&mut self, frame: &ElementFrame) {
        let (correlator, stride) = (&self.steered.correlator, self.stride);
        let share = self.steered.elements().div_ceil(self.workers.len());
        self.spectra
            .par_chunks_mut(share * stride)
            .zip(&mut self.workers)
            .enumerate()
            .for_each(|(w, (spectra, worker))| {
                for (i, spectrum) in spectra.chunks_exact_mut(stride).enumerate() {
                    let (head, tail) = worker.row.split_at_mut(frame.samples);
                    head.copy_from_slice(frame.element(w * share + i));
                    tail.fill(Complex64::ZERO);
                    correlator.forward(&mut worker.row, &mut worker.scratch);
                    for (to, from) in spectrum.iter_mut().zip(&worker.row) {
                        *to = Complex32::new(from.re as f32, from.im as f32);
                    }
                }
            });
    }

    /// Computes all beams at every frequency.
    fn mix(&mut self) {
        let (beams, length) = (self.steered.beams(), self.steered.correlator.length());
        let share = (length / TILE).div_ceil(self.workers.len());
        let mut workers = std::mem::take(&mut self.workers);
        let mut mixed = std::mem::take(&mut self.mixed);
        let this = &*self;
        mixed
            .par_chunks_mut(share * TILE * beams)
            .zip(&mut workers)
            .enumerate()
            .for_each(|(w, (mixed, worker))| {
                for (t, tile) in mixed.chunks_exact_mut(TILE * beams).enumerate() {
                    let first = (w * share + t) * TILE;
                    this.gather(first, &mut worker.tile);
                    for bin in 0..TILE {
                        this.mix_one(first + bin, bin, worker, tile);
                    }
                }
            });
        self.workers = workers;
        self.mixed = mixed;
    }

    /// Gathers the weighted element values for a tile of frequencies.
    fn gather(&self, first: usize, tile: &mut [Complex32]) {
        let elements = self.steered.elements();
        for (e, w) in self.spread.iter().enumerate() {
            let from = &self.spectra[e * self.stride + first..][..TILE];
            for (i, x) in from.iter().enumerate() {
                tile[i * elements + e] = x * *w;
            }
        }
    }

    /// Computes all beams at frequency `bin`, which has index `at` in its tile.
    fn mix_one(&self, bin: usize, at: usize, worker: &mut Worker, tile: &mut [Complex32]) {
        let (elements, grid) = (self.steered.elements(), worker.line.len());
        // Element E/2 is at index 0 of the grid; earlier elements are at its end.
        let values = &worker.tile[at * elements..][..elements];
        let (before, behind) = values.split_at(elements / 2);
        worker.line[..behind.len()].copy_from_slice(behind);
        worker.line[behind.len()..grid - before.len()].fill(Complex32::new(0.0, 0.0));
        worker.line[grid - before.len()..].copy_from_slice(before);
        self.line
            .process_with_scratch(&mut worker.line, &mut worker.line_scratch);
        // The grid starts half a kernel before -1/2 cycle per element; positive u has positive transform indices.
        let start = grid - grid / 2 - TAPS / 2;
        for (i, turn) in self.half_step.iter().enumerate() {
            let y = worker.line[(start + i) & (grid - 1)] * turn;
            worker.grid.re[i] = y.re;
            worker.grid.im[i] = y.im;
        }
        let band = Band {
            per_sine: self.steered.band().frequency_hz(bin) * self.steered.spacing_m()
                / self.steered.sound_speed_m_per_s,
            grid: grid as f64,
            alternates: elements.is_multiple_of(2),
        };
        let steering = (&band, &self.steered.directions.sine[..]);
        let Worker { grid, indices, .. } = worker;
        self.simd_level.run(
            #[inline(always)]
            || interpolate(&self.kernel, grid, steering, indices, &mut tile[at..]),
        );
    }

    fn transform_beams(&mut self, samples: usize, out: &mut [Complex32]) {
        let beams = self.steered.beams();
        let (mixed, inverse) = (&self.mixed, &self.inverse);
        let share = beams.div_ceil(self.workers.len());
        out.par_chunks_mut(share * samples)
            .zip(&mut self.workers)
            .enumerate()
            .for_each(|(w, (rows, worker))| {
                for (i, row) in rows.chunks_exact_mut(samples).enumerate() {
                    let b = w * share + i;
                    for (to, tile) in worker
                        .beam
                        .chunks_exact_mut(TILE)
                        .zip(mixed.chunks_exact(TILE * beams))
                    {
                        to.copy_from_slice(&tile[b * TILE..][..TILE]);
                    }
                    inverse.process_with_scratch(&mut worker.beam, &mut worker.beam_scratch);
                    row.copy_from_slice(&worker.beam[..samples]);
                }
            });
    }
}

/// Offset from the reference element to the line's centre: half a step for an even number of elements.
fn middle(elements: usize) -> f64 {
    match elements.is_multiple_of(2) {
        true => 0.5,
        false => 0.0,
    }
}

/// Mapping from directions to the grid at one frequency.
struct Band {
    /// Cycles per element at a sine of 1.
    per_sine: f64,
    grid: f64,
    /// One cycle per element shifts an even number of elements, counted from their centre, by half a cycle.
    alternates: bool,
}

impl Band {
    #[inline(always)]
    fn index(&self, sine: f64) -> GridIndex {
        // Adding SHIFT rounds to the nearest integer without a function call, so that loops vectorise.
        const SHIFT: f64 = 6_755_399_441_055_744.0;
        let u = self.per_sine * sine;
        let whole = (u + SHIFT) - SHIFT;
        // The first tap of the kernel lies TAPS/2 - 1 steps before the direction's step; the grid begins TAPS/2 before -1/2.
        let at = (u - whole + 0.5) * self.grid + 1.0;
        let first = at as i32;
        let entry = (at - f64::from(first)) * KERNEL_STEPS as f64;
        let odd = (whole as i32) & 1 != 0;
        GridIndex {
            first: first as u32,
            entry: entry as i32 as u32,
            fraction: (entry - f64::from(entry as i32)) as f32,
            sign: if self.alternates && odd { -1.0 } else { 1.0 },
        }
    }
}

/// Writes the value of beam b to `out[b TILE]`. `indices` is a buffer.
#[inline(always)]
fn interpolate(
    kernel: &[[f32; TAPS]],
    grid: &Grid,
    (band, sines): (&Band, &[f64]),
    indices: &mut [GridIndex],
    out: &mut [Complex32],
) {
    for (index, sine) in indices.iter_mut().zip(sines) {
        *index = band.index(*sine);
    }
    for (index, out) in indices.iter().zip(out.iter_mut().step_by(TILE)) {
        let entry = index.entry as usize;
        let (near, next) = (&kernel[entry], &kernel[entry + 1]);
        let first = index.first as usize;
        let re: &[f32; TAPS] = grid.re[first..first + TAPS].try_into().expect("as long");
        let im: &[f32; TAPS] = grid.im[first..first + TAPS].try_into().expect("as long");
        let (mut a, mut b) = ([0.0f32; TAPS], [0.0f32; TAPS]);
        for i in 0..TAPS {
            let w = near[i] + index.fraction * (next[i] - near[i]);
            a[i] = w * re[i];
            b[i] = w * im[i];
        }
        *out = Complex32::new(sum(a) * index.sign, sum(b) * index.sign);
    }
}

/// Sums pairwise in a fixed order.
#[inline(always)]
fn sum(x: [f32; TAPS]) -> f32 {
    ((x[0] + x[4]) + (x[2] + x[6])) + ((x[1] + x[5]) + (x[3] + x[7]))
}

/// Kaiser-Bessel kernel: I0(beta sqrt(1 - (x / half)^2)).
struct Kernel {
    beta: f64,
}

impl Kernel {
    /// Kernel for a grid with the given oversampling (Beatty, Nishimura and Pauly 2005, Eq. 5).
    fn new(oversampling: f64) -> Self {
        let s = oversampling;
        let width = TAPS as f64;
        Self {
            beta: PI * ((width / s * (s - 0.5)).powi(2) - 0.8).sqrt(),
        }
    }

    fn at(&self, x: f64) -> f64 {
        let half = 0.5 * TAPS as f64;
        weights::Taper::Kaiser(self.beta).at(0.5 * x / half)
    }

    /// integral of kernel(x) exp(-j 2pi x xi) dx, with [`Kernel::at`] normalised to 1 at its centre.
    fn transform(&self, xi: f64) -> f64 {
        let half = 0.5 * TAPS as f64;
        let s2 = self.beta.powi(2) - (TAU * half * xi).powi(2);
        // sinh(beta) and I0(beta) both grow as exp(beta), which is factored out.
        let scale = 2.0 * half * (-self.beta).exp() / scaled_i0(self.beta);
        match s2 > 0.0 {
            true => scale * s2.sqrt().sinh() / s2.sqrt(),
            false => scale * (-s2).sqrt().sin() / (-s2).sqrt().max(1e-12),
        }
    }

    /// Tap weights at every tabulated position of a grid step, one more than [`KERNEL_STEPS`].
    fn table(&self) -> Vec<[f32; TAPS]> {
        (0..=KERNEL_STEPS)
            .map(|p| {
                let index = p as f64 / KERNEL_STEPS as f64;
                // Tap i lies i - (TAPS/2 - 1) - position from the direction.
                std::array::from_fn(|i| self.at(i as f64 - (TAPS / 2 - 1) as f64 - index) as f32)
            })
            .collect()
    }
}

/// I0(x) exp(-x).
fn scaled_i0(x: f64) -> f64 {
    weights::bessel_i0(x) * (-x).exp()
}

#[cfg(test)]
mod tests;
