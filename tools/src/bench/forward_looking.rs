//! A forward-looking ping of the shape that DAVE's multibeam sonar computes (Choi et al. 2021, its "full calculation"): 512 beams of 114
//! rays, 60 m, 29.9 kHz.
//!
//! Each beam is the spectrum of its own rays on 2392 frequencies; window; every beam hears its neighbours by their pattern (a 512 x 512
//! matrix that depends on the difference of sines, so here on even steps of sine a convolution); inverse transform. Timed: all of it.
//! Error: of the last result against the same arithmetic in f64 with every exponential written out, four beams.

use std::f64::consts::TAU;
use std::time::Instant;

use echotank::array::gridded::Dialect;
use echotank::array::gridded::transform::{Transform1d, Workspace};
use echotank_fft::Planned;
use num_complex::{Complex32, Complex64};
use rayon::prelude::*;

use super::report::Report;
use super::scene::Chance;

const BEAMS: usize = 512;
const RAYS: usize = 114;
const RANGE_M: f64 = 60.0;
const BANDWIDTH_HZ: f64 = 29.9e3;
const SOUND_SPEED_M_PER_S: f64 = 1500.0;
/// 2392 frequencies.
const BINS: usize = (BANDWIDTH_HZ * 2.0 * RANGE_M / SOUND_SPEED_M_PER_S) as usize;
const PERIOD_S: f64 = BINS as f64 / BANDWIDTH_HZ;
/// Half of the fan, as a sine, and the beams' width.
const SECTOR_SINE: f64 = 0.707;
const WIDTH_RAD: f64 = 0.017_453;
/// Beams of the convolution: none wraps round.
const PADDED: usize = 2 * BEAMS;

struct Rays {
    delay_s: Vec<f64>,
    amplitude: Vec<Complex32>,
}

fn rays() -> Vec<Rays> {
    let mut chance = Chance::seeded(5);
    (0..BEAMS)
        .map(|_| {
            let range_m: Vec<f64> = (0..RAYS)
                .map(|_| RANGE_M * (0.2 + 0.8 * chance.uniform()))
                .collect();
            let delay_s = range_m.iter().map(|r| 2.0 * r / SOUND_SPEED_M_PER_S);
            Rays {
                delay_s: delay_s.collect(),
                amplitude: range_m
                    .iter()
                    .map(|r| {
                        let level = 1.0 / (r * r);
                        let (re, im) = (chance.normal() * level, chance.normal() * level);
                        Complex32::new(re as f32, im as f32)
                    })
                    .collect(),
            }
        })
        .collect()
}

/// Hamming, over frequencies.
fn window(bin: usize) -> f64 {
    0.54 - 0.46 * (TAU * bin as f64 / (BINS - 1) as f64).cos()
}

/// How loud a beam is heard `steps` beams away.
fn neighbour(steps: i64) -> f64 {
    let sine = steps as f64 * 2.0 * SECTOR_SINE / (BEAMS - 1) as f64;
    let x = std::f64::consts::PI * 0.884 / WIDTH_RAD * sine;
    if x == 0.0 { 1.0 } else { x.sin() / x }
}

/// Beam `beam`'s spectrum before mixing, every exponential written out.
fn plain(rays: &Rays) -> Vec<Complex64> {
    (0..BINS)
        .map(|k| {
            let f_hz = (k as f64 - (BINS / 2) as f64) / PERIOD_S;
            let sum: Complex64 = rays
                .delay_s
                .iter()
                .zip(&rays.amplitude)
                .map(|(u, a)| {
                    let a = Complex64::new(a.re.into(), a.im.into());
                    a * Complex64::from_polar(1.0, -TAU * (f_hz * u).fract())
                })
                .sum();
            sum * window(k)
        })
        .collect()
}

/// Some beams by plain sums in f64.
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

/// Prints and keeps one line per tolerance and number of threads.
pub fn run(threads: &[usize], report: &mut Report) -> Result<(), String> {
    println!(
        "forward-looking: {BEAMS} beams x {RAYS} rays, {RANGE_M} m, {BINS} frequencies, beam mixing and inverse transforms included"
    );
    let rays = rays();
    let checked = [0, 100, 255, 511];
    let want = want(&rays, &checked);
    for &threads in threads {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
        let pool = pool.map_err(|e| e.to_string())?;
        for width in [4, 6, 7] {
            let (ms, got) = pool.install(|| measure(&rays, width));
            let (mut off, mut all) = (0.0, 0.0);
            for (beam, want) in checked.iter().zip(&want) {
                for (g, w) in got[beam * BINS..][..BINS].iter().zip(want) {
                    off += (Complex64::new(g.re.into(), g.im.into()) - w).norm_sqr();
                    all += w.norm_sqr();
                }
            }
            let error = (off / all).sqrt();
            let line = format!(
                "width {width}, {threads} threads: error {error:.1e}, {ms:.2} ms, {:.1} per second",
                1e3 / ms
            );
            let kept = serde_json::json!({
                "beams": BEAMS, "rays": RAYS, "frequencies": BINS, "threads": threads, "width": width, "error": error,
                "ms_per_ping": ms,
            });
            report.row(&line, kept);
        }
    }
    Ok(())
}

/// Best of some pings, and the last one's beams.
fn measure(rays: &[Rays], width: usize) -> (f64, Vec<Complex32>) {
    let plan = Transform1d::<f32>::new(BINS, PERIOD_S, width, 2.0, Dialect::best());
    let (forward, backward) = (f32::plan_forward(PADDED), f32::plan_inverse(PADDED));
    let inverse = f32::plan_inverse(BINS);
    // The mixing's own spectrum, even in beams.
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
    // Frequencies that a thread mixes together.
    const TOGETHER: usize = 8;
    let mut best_ms = f64::INFINITY;
    for _ in 0..8 {
        let start = Instant::now();
        spectra.par_chunks_mut(BINS).zip(rays).for_each_init(
            || plan.workspace(),
            |work: &mut Workspace<f32>, (out, rays)| {
                plan.execute(work, &rays.delay_s, &rays.amplitude, out);
            },
        );
        // Frequency by frequency: all beams of it, mixed.
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
        best_ms = best_ms.min(start.elapsed().as_secs_f64() * 1e3);
    }
    (best_ms, beams)
}
