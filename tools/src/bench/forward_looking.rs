//! Forward-looking ping with the parameters of DAVE's multibeam sonar (Choi et al. 2021, its "full calculation"): 512 beams of 114
//! rays, 60 m, 29.9 kHz.
//!
//! Timed, from each ray's range and fixed complex reflectivity to time samples of every beam:
//! - delay and two-way spreading of the ray;
//! - spectrum of each beam from its own rays on 2392 frequencies;
//! - window;
//! - leakage between beams by their pattern. The 512 x 512 matrix depends on the difference of sines, so it is a convolution on
//!   uniform steps of sine;
//! - inverse transform.
//!
//! Not timed: casting the rays (DAVE takes them from a depth camera), drawing the reflectivities, noise, images. This is DAVE's
//! arithmetic with the transform of this library, not a ping of the pipeline. Error: all samples of four beams of the last result
//! against the same arithmetic in f64, with every exponential and the whole matrix evaluated directly.

use std::f64::consts::TAU;
use std::time::Instant;

use echotank_core::simd::SimdLevel;
use echotank_fft::Planned;
use echotank_synthesis::array::gridded::transform::{Transform1d, Workspace};
use num_complex::{Complex32, Complex64};
use rayon::prelude::*;

use crate::draw::Chance;
use crate::report::Report;

const BEAMS: usize = 512;
const RAYS: usize = 114;
const RANGE_M: f64 = 60.0;
const BANDWIDTH_HZ: f64 = 29.9e3;
const SOUND_SPEED_M_PER_S: f64 = 1500.0;
/// Number of frequencies, 2392.
const BINS: usize = (BANDWIDTH_HZ * 2.0 * RANGE_M / SOUND_SPEED_M_PER_S) as usize;
const PERIOD_S: f64 = BINS as f64 / BANDWIDTH_HZ;
/// Sine of half the fan.
const SECTOR_SINE: f64 = 0.707;
/// Beam width, radians.
const WIDTH_RAD: f64 = 0.017_453;
/// Number of timed pings.
const RUNS: usize = 9;
/// Number of beams of the circular convolution, padded so that none wraps around.
const PADDED: usize = 2 * BEAMS;

struct Rays {
    range_m: Vec<f64>,
    reflectivity: Vec<Complex32>,
}

impl Rays {
    /// Delays and amplitudes of the rays with two-way spherical spreading.
    fn heard(&self) -> impl Iterator<Item = (f64, Complex32)> {
        let rays = self.range_m.iter().zip(&self.reflectivity);
        rays.map(|(r, strength)| (2.0 * r / SOUND_SPEED_M_PER_S, strength / (r * r) as f32))
    }
}

fn rays() -> Vec<Rays> {
    let mut chance = Chance::new(5);
    (0..BEAMS)
        .map(|_| {
            let range_m: Vec<f64> = (0..RAYS)
                .map(|_| RANGE_M * (0.2 + 0.8 * chance.uniform()))
                .collect();
            let normal = |_: &f64| Complex32::new(chance.normal() as f32, chance.normal() as f32);
            Rays {
                reflectivity: range_m.iter().map(normal).collect(),
                range_m,
            }
        })
        .collect()
}

/// Hamming window over frequency.
fn window(bin: usize) -> f64 {
    0.54 - 0.46 * (TAU * bin as f64 / (BINS - 1) as f64).cos()
}

/// Leakage from a beam `steps` beams away.
fn neighbour(steps: i64) -> f64 {
    let sine = steps as f64 * 2.0 * SECTOR_SINE / (BEAMS - 1) as f64;
    let x = std::f64::consts::PI * 0.884 / WIDTH_RAD * sine;
    if x == 0.0 { 1.0 } else { x.sin() / x }
}

/// Spectrum of beam `beam` before leakage, with direct evaluation of every exponential.
fn plain(rays: &Rays) -> Vec<Complex64> {
    (0..BINS)
        .map(|k| {
            let f_hz = (k as f64 - (BINS / 2) as f64) / PERIOD_S;
            let sum: Complex64 = rays
                .heard()
                .map(|(u, a)| {
                    let a = Complex64::new(a.re.into(), a.im.into());
                    a * Complex64::from_polar(1.0, -TAU * (f_hz * u).fract())
                })
                .sum();
            sum * window(k)
        })
        .collect()
}

/// Some beams by direct sums in f64.
fn want(rays: &[Rays], beams: &[usize]) -> Vec<Vec<Complex64>> {
    let all: Vec<Vec<Complex64>> = rays.par_iter().map(plain).collect();
    let inverse = f64::plan_inverse(BINS);
    beams
        .iter()
        .map(|&beam| {
            let mut out: Vec<Complex64> = (0..BINS)
                .map(|k| {
                    (0..BEAMS)
                        .map(|b| all[b][k] * neighbour(beam as i64 - b as i64))
                        .sum()
                })
                .collect();
            inverse.process(&mut out);
            out
        })
        .collect()
}

/// Prints and records one line per tolerance and number of threads.
pub(crate) fn run(threads: &[usize], report: &mut Report) -> Result<(), String> {
    println!(
        "forward-looking: {BEAMS} beams x {RAYS} rays, {RANGE_M} m, {BINS} frequencies, from ranges and reflectivities to every beam's time samples, \
         beam mixing included, ray casting not; median and best of {RUNS}"
    );
    let rays = rays();
    let checked = [0, 100, 255, 511];
    let want = want(&rays, &checked);
    for &threads in threads {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
        let pool = pool.map_err(|e| e.to_string())?;
        for width in [4, 6, 7] {
            let (mut ms, got) = pool.install(|| measure(&rays, width));
            ms.sort_by(f64::total_cmp);
            let (best_ms, median_ms) = (ms[0], ms[ms.len() / 2]);
            let (mut off, mut all) = (0.0, 0.0);
            for (beam, want) in checked.iter().zip(&want) {
                for (g, w) in got[beam * BINS..][..BINS].iter().zip(want) {
                    off += (Complex64::new(g.re.into(), g.im.into()) - w).norm_sqr();
                    all += w.norm_sqr();
                }
            }
            let error = (off / all).sqrt();
            let line = format!(
                "width {width}, {threads} threads: error {error:.1e}, {median_ms:.2} ms, best {best_ms:.2}, {:.1} per second by the median",
                1e3 / median_ms
            );
            let kept = serde_json::json!({
                "beams": BEAMS, "rays": RAYS, "frequencies": BINS, "threads": threads, "width": width, "error": error,
                "ms_best": best_ms, "ms_median": median_ms, "runs": RUNS,
            });
            report.row(&line, kept);
        }
    }
    Ok(())
}

/// Milliseconds of each ping, and the beams of the last ping.
fn measure(rays: &[Rays], width: usize) -> (Vec<f64>, Vec<Complex32>) {
    let plan = Transform1d::<f32>::new(BINS, PERIOD_S, width, 2.0, SimdLevel::best());
    let (forward, backward) = (f32::plan_forward(PADDED), f32::plan_inverse(PADDED));
    let inverse = f32::plan_inverse(BINS);
    // Transform of the leakage over beams.
    let mut mixing: Vec<Complex32> = (0..PADDED)
        .map(|k| {
            let steps = if k < BEAMS { k } else { PADDED - k };
            Complex32::new((neighbour(steps as i64) / PADDED as f64) as f32, 0.0)
        })
        .collect();
    forward.process(&mut mixing);
    let windows: Vec<f32> = (0..BINS).map(|k| window(k) as f32).collect();
    let mut spectra = vec![Complex32::ZERO; BEAMS * BINS];
    let mut turned = vec![Complex32::ZERO; BEAMS * BINS];
    let mut beams = vec![Complex32::ZERO; BEAMS * BINS];
    // Number of frequencies that a thread processes together.
    const TOGETHER: usize = 8;
    let mut took_ms = Vec::new();
    for _ in 0..RUNS {
        let start = Instant::now();
        spectra.par_chunks_mut(BINS).zip(rays).for_each_init(
            || {
                (
                    plan.workspace(),
                    vec![0.0; RAYS],
                    vec![Complex32::ZERO; RAYS],
                )
            },
            |(work, delay_s, amplitude): &mut (Workspace<f32>, _, _), (out, rays)| {
                for (k, heard) in rays.heard().enumerate() {
                    (delay_s[k], amplitude[k]) = heard;
                }
                plan.execute(work, delay_s, amplitude, out);
            },
        );
        // The beams of each frequency are convolved.
        turned
            .par_chunks_mut(TOGETHER * BEAMS)
            .enumerate()
            .for_each_init(
                || {
                    let scratch = forward
                        .get_inplace_scratch_len()
                        .max(backward.get_inplace_scratch_len());
                    (
                        vec![Complex32::ZERO; TOGETHER * PADDED],
                        vec![Complex32::ZERO; scratch],
                    )
                },
                |(padded, scratch), (block, out)| {
                    let first = block * TOGETHER;
                    let count = out.len() / BEAMS;
                    padded.fill(Complex32::ZERO);
                    for b in 0..BEAMS {
                        let from = &spectra[b * BINS + first..][..count];
                        for (j, value) in from.iter().enumerate() {
                            padded[j * PADDED + b] = value * windows[first + j];
                        }
                    }
                    for (padded, out) in padded.chunks_mut(PADDED).zip(out.chunks_mut(BEAMS)) {
                        forward.process_with_scratch(padded, scratch);
                        padded.iter_mut().zip(&mixing).for_each(|(a, b)| *a *= b);
                        backward.process_with_scratch(padded, scratch);
                        out.copy_from_slice(&padded[..BEAMS]);
                    }
                },
            );
        beams
            .par_chunks_mut(BINS * TOGETHER)
            .enumerate()
            .for_each_init(
                || vec![Complex32::ZERO; inverse.get_inplace_scratch_len()],
                |scratch, (block, out)| {
                    let first = block * TOGETHER;
                    let count = out.len() / BINS;
                    for (k, from) in turned.chunks(BEAMS).enumerate() {
                        for j in 0..count {
                            out[j * BINS + k] = from[first + j];
                        }
                    }
                    for beam in out.chunks_mut(BINS) {
                        inverse.process_with_scratch(beam, scratch);
                    }
                },
            );
        took_ms.push(start.elapsed().as_secs_f64() * 1e3);
    }
    (took_ms, beams)
}
