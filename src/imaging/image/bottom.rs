//! Bottom detection: the time at which each beam of a fan meets the bottom.
//!
//! Each half of the line forms a beam of the same direction. Where the bottom crosses the beam, the phase between the halves passes through
//! zero. A straight line through the phases near the crossing gives the time (outer beams). Where the bottom is flat under a beam, the echo
//! is short and the centre of its energy gives the time (inner beams). The method with the smaller predicted error is used.
//!
//! Sources: Lurton 2010, An Introduction to Underwater Acoustics, 8.3 (both methods); Ladroit, Lurton, Sintes and Garello 2012 (quality
//! factors). The predicted errors are specific to Echotank. For phase it is the scatter of the residuals about the straight line. For
//! amplitude it is the rms length of the echo divided by the root of its number of independent samples.
//!
//! The search starts at `first_sample_s` and takes the strongest interval of each beam; neighbouring beams are not used. Not modelled:
//! several bottoms in one beam, refraction, gates from other sounders.

use num_complex::Complex32;
use rayon::prelude::*;

use echotank_core::ping::{BeamFrame, Detection, Sounding};
use echotank_core::simd::widest;

/// A beam has a bottom only if its largest smoothed level exceeds its median by this much.
const MIN_ABOVE_MEDIAN_DB: f64 = 6.0;
/// The energy centre uses samples within this fraction of the maximum.
const AMPLITUDE_FLOOR: f64 = 0.25;
/// Phases beyond this limit belong to the next ambiguity, radians.
const PHASE_REACH_RAD: f64 = 2.2;
/// Minimum number of samples in a straight-line fit.
const MIN_LINE: usize = 8;
/// Limit on the beam angle in the footprint estimate.
const MAX_ANGLE_RAD: f64 = 1.45;
/// Approximate offset of a footprint's energy centre from its axis, as a fraction of the footprint: level falls with range and incidence.
const CENTRE_SHARE: f64 = 0.1;
/// A crossing requires a smoothed level above this fraction of the maximum.
const CROSSING_FLOOR: f64 = 0.3;
/// Number of iterations about the crossing.
const ROUNDS: usize = 3;

/// Bottom detector with its own buffers.
pub struct BottomDetector {
    sample_rate_hz: f64,
    bandwidth_hz: f64,
    workers: Vec<Worker>,
    /// Of each beam.
    found: Vec<Option<Sounding>>,
}

/// Buffers of one share of the beams.
struct Worker {
    /// Sums of the intensities of all samples before each, one more than samples.
    before: Vec<f64>,
    smooth: Vec<f64>,
}

/// Samples of one beam, from the first that may be a bottom on.
#[derive(Clone, Copy)]
struct Beam<'a> {
    whole: &'a [Complex32],
    /// Products of the halves; the phase is that between them.
    products: &'a [Complex32],
}

/// Result of one method.
#[derive(Clone, Copy, Debug)]
struct Estimate {
    sample: f64,
    error_samples: f64,
}

impl BottomDetector {
    /// `bandwidth_hz` is that of the compressed pulse: samples closer than its inverse are not independent. `samples` sizes the buffers. Work
    /// is shared among the threads of the current pool.
    pub fn new(sample_rate_hz: f64, bandwidth_hz: f64, samples: usize) -> Self {
        let worker = || Worker {
            before: Vec::with_capacity(samples + 1),
            smooth: Vec::with_capacity(samples),
        };
        Self {
            sample_rate_hz,
            bandwidth_hz: bandwidth_hz.max(1.0),
            workers: (0..rayon::current_num_threads().max(1))
                .map(|_| worker())
                .collect(),
            found: Vec::new(),
        }
    }

    /// Returns one sounding for each beam with a bottom. `whole` is the fan of the whole line; sample k lies at `first_sample_s` + k / rate.
    /// `products` holds, in its order, the products of the beams of one half and the conjugates of those of the other. Soundings before `min_s`
    /// are not considered.
    pub fn detect(
        &mut self,
        whole: &BeamFrame,
        products: &[Complex32],
        first_sample_s: f64,
        min_s: f64,
        out: &mut Vec<Sounding>,
    ) {
        assert_eq!(whole.iq.len(), products.len(), "products of another fan");
        let rate_hz = self.sample_rate_hz;
        let first = (((min_s - first_sample_s) * rate_hz).max(0.0) as usize).min(whole.samples);
        let delayed = first_sample_s * rate_hz;
        // Averaged over about four resolution cells, so that speckle alone is not the maximum.
        let cell = (rate_hz / self.bandwidth_hz).max(1.0);
        self.found.clear();
        self.found.resize(whole.beams, None);
        let share = whole.beams.div_ceil(self.workers.len()).max(1);
        self.found
            .par_chunks_mut(share)
            .zip(&mut self.workers)
            .enumerate()
            .for_each(|(w, (found, worker))| {
                for (i, found) in found.iter_mut().enumerate() {
                    let beam = w * share + i;
                    let angle_rad = whole.angle_rad[beam];
                    // Time that a flat bottom stays in the whole line's beam, relative to the travel time of its echo.
                    let stay =
                        0.5 * whole.width_rad[beam] * angle_rad.abs().min(MAX_ANGLE_RAD).tan();
                    let samples = beam * whole.samples + first..(beam + 1) * whole.samples;
                    let of_beam = Beam {
                        whole: &whole.iq[samples.clone()],
                        products: &products[samples],
                    };
                    let echo = worker.find(of_beam, first as f64 + delayed, stay, cell);
                    *found = echo.map(|(detection, found, level)| Sounding {
                        beam,
                        angle_rad,
                        twtt_s: first_sample_s + (found.sample + first as f64) / rate_hz,
                        error_s: found.error_samples / rate_hz,
                        detection,
                        level_v: level.sqrt(),
                    });
                }
            });
        out.clear();
        out.extend(self.found.iter().flatten().copied());
    }
}

impl Worker {
    /// The bottom of one beam whose first sample is `delayed` samples after the pulse.
    fn find(
        &mut self,
        beam: Beam,
        delayed: f64,
        stay: f64,
        cell: f64,
    ) -> Option<(Detection, Estimate, f64)> {
        let samples = beam.whole.len();
        if samples < MIN_LINE {
            return None;
        }
        add_intensities(beam.whole, &mut self.before);
        if !self.before[samples].is_finite() {
            return None;
        }
        let limit = (samples - 1) | 1;
        let window = ((4.0 * cell).ceil() as usize | 1).min(limit);
        running_mean(&self.before, window, &mut self.smooth);
        let (rough, _) = largest(&self.smooth);
        // Then averaged over half the time that a flat bottom stays in the beam, so that one bright spot is not taken for the whole echo.
        let footprint = stay * (rough as f64 + delayed);
        let wider = window.max((0.5 * footprint).ceil() as usize | 1);
        let wider = wider.min(limit);
        if wider != window {
            running_mean(&self.before, wider, &mut self.smooth);
        }
        let (peak, level) = largest(&self.smooth);
        // The median exceeds this floor if no more than half of the samples, rounded down, do not.
        let floor = level / 10f64.powf(MIN_ABOVE_MEDIAN_DB / 10.0);
        let smooth = &self.smooth;
        let below = widest(
            #[inline(always)]
            || smooth.iter().filter(|level| **level <= floor).count(),
        );
        if level <= 0.0 || below <= self.smooth.len() / 2 {
            return None;
        }
        let amplitude = self.by_amplitude(beam.whole, peak, level, footprint, cell);
        let phase = self.by_phase(beam.products, peak as f64, level, footprint, cell);
        let (detection, found) = match phase {
            Some(phase) if phase.error_samples < amplitude.error_samples => {
                (Detection::Phase, phase)
            }
            _ => (Detection::Amplitude, amplitude),
        };
        Some((detection, found, level))
    }

    /// Centre of the energy in the interval about the peak.
    fn by_amplitude(
        &self,
        whole: &[Complex32],
        peak: usize,
        level: f64,
        footprint: f64,
        cell: f64,
    ) -> Estimate {
        let (from, to) = self.stretch(peak, level * AMPLITUDE_FLOOR);
        let (mut sum, mut first, mut second) = (0.0, 0.0, 0.0);
        for (k, sample) in whole[from..to].iter().enumerate() {
            let i = intensity(*sample);
            let x = (from + k) as f64 - peak as f64;
            sum += i;
            first += i * x;
            second += i * x * x;
        }
        let mean = first / sum;
        let variance = (second / sum - mean * mean).max(0.0);
        let independent = ((to - from) as f64 / cell).max(1.0);
        Estimate {
            sample: peak as f64 + mean,
            // The error is at least that of one cell, and at least the shift of the centre by the slope of the level over the footprint.
            error_samples: (variance / independent)
                .sqrt()
                .max(0.1 * cell)
                .max(CENTRE_SHARE * footprint),
        }
    }

    /// Ends of the interval about `peak` in which the smoothed intensity exceeds `floor`.
    fn stretch(&self, peak: usize, floor: f64) -> (usize, usize) {
        let mut from = peak;
        while from > 0 && self.smooth[from - 1] > floor {
            from -= 1;
        }
        let mut to = peak + 1;
        while to < self.smooth.len() && self.smooth[to] > floor {
            to += 1;
        }
        (from, to)
    }

    /// Fits an energy-weighted straight line to the phases about their zero crossing: first about `centre`, then about the crossing. The
    /// interval is at most the beam's `footprint`, within which the phase is unambiguous.
    fn by_phase(
        &self,
        products: &[Complex32],
        centre: f64,
        level: f64,
        footprint: f64,
        cell: f64,
    ) -> Option<Estimate> {
        if footprint < MIN_LINE as f64 {
            return None;
        }
        let mut crossing = centre;
        let mut error_samples = f64::INFINITY;
        for round in 0..ROUNDS {
            let half = footprint * if round == 0 { 0.7 } else { 0.5 };
            let from = (crossing - half).max(0.0) as usize;
            let to = ((crossing + half).max(0.0) as usize + 1).min(products.len());
            let mut line = Line::default();
            for (k, z) in (from..).zip(&products[from..to.max(from)]) {
                let phase = f64::from(z.arg());
                // Larger phases are the next ambiguity, or noise.
                if phase.abs() <= PHASE_REACH_RAD {
                    let (re, im) = (f64::from(z.re), f64::from(z.im));
                    line.add(k as f64, phase, (re * re + im * im).sqrt());
                }
            }
            let (slope, zero) = line.fit()?;
            if (zero - crossing).abs() > half {
                return None;
            }
            crossing = zero;
            // At the next ambiguity the whole line receives nothing.
            let level_there = self.smooth.get(zero.max(0.0) as usize);
            if level_there.is_none_or(|level_there| *level_there < CROSSING_FLOOR * level) {
                return None;
            }
            let independent = (line.count as f64 / cell - 1.0).max(1.0);
            error_samples = line.residual_rad() / slope.abs() / independent.sqrt();
        }
        Some(Estimate {
            sample: crossing,
            error_samples: error_samples.max(0.02 * cell),
        })
    }
}

/// Weighted sums of a straight-line fit.
#[derive(Clone, Copy, Default)]
struct Line {
    count: usize,
    origin: f64,
    w: f64,
    x: f64,
    y: f64,
    xx: f64,
    xy: f64,
    yy: f64,
}

impl Line {
    fn add(&mut self, x: f64, y: f64, w: f64) {
        if self.count == 0 {
            self.origin = x;
        }
        let x = x - self.origin;
        self.count += 1;
        self.w += w;
        self.x += w * x;
        self.y += w * y;
        self.xx += w * x * x;
        self.xy += w * x * y;
        self.yy += w * y * y;
    }

    fn moments(&self) -> Option<(f64, f64, f64, f64, f64)> {
        if self.count < MIN_LINE || self.w <= 0.0 {
            return None;
        }
        let (x, y) = (self.x / self.w, self.y / self.w);
        let xx = self.xx / self.w - x * x;
        let xy = self.xy / self.w - x * y;
        let yy = self.yy / self.w - y * y;
        (xx > 0.0).then_some((x, y, xx, xy, yy))
    }

    /// Slope and zero crossing.
    fn fit(&self) -> Option<(f64, f64)> {
        let (x, y, xx, xy, _) = self.moments()?;
        let slope = xy / xx;
        (slope != 0.0).then(|| (slope, self.origin + x - y / slope))
    }

    fn residual_rad(&self) -> f64 {
        self.moments().map_or(f64::INFINITY, |(_, _, xx, xy, yy)| {
            (yy - xy * xy / xx).max(0.0).sqrt()
        })
    }
}

/// Number of samples that the loops over a beam take together.
const LANES: usize = 8;

/// Sums of the intensities before each sample, and of all.
fn add_intensities(beam: &[Complex32], before: &mut Vec<f64>) {
    before.clear();
    before.push(0.0);
    let mut sum = 0.0;
    let (chunks, rest) = beam.as_chunks::<LANES>();
    for chunk in chunks {
        // Sums within a chunk do not wait for those before it.
        let mut within = chunk.map(intensity);
        for i in 1..LANES {
            within[i] += within[i - 1];
        }
        before.extend_from_slice(&within.map(|within| sum + within));
        sum += within[LANES - 1];
    }
    for sample in rest {
        sum += intensity(*sample);
        before.push(sum);
    }
}

/// Squared magnitude, of numbers whose squares are too small for single precision as well.
#[inline(always)]
fn intensity(sample: Complex32) -> f64 {
    let (re, im) = (f64::from(sample.re), f64::from(sample.im));
    re * re + im * im
}

/// The first largest level, of at least one.
fn largest(levels: &[f64]) -> (usize, f64) {
    let top = widest(
        #[inline(always)]
        || {
            let (chunks, rest) = levels.as_chunks::<LANES>();
            let mut tops = [f64::NEG_INFINITY; LANES];
            for chunk in chunks {
                for i in 0..LANES {
                    tops[i] = if chunk[i] > tops[i] {
                        chunk[i]
                    } else {
                        tops[i]
                    };
                }
            }
            let tops = tops.iter().chain(rest).copied();
            tops.fold(f64::NEG_INFINITY, f64::max)
        },
    );
    let at = levels.iter().position(|level| *level == top);
    (at.unwrap_or(0), top)
}

/// Mean over `window` samples centred on each sample, from the sums before each. The window is odd, and not longer than the samples.
fn running_mean(before: &[f64], window: usize, out: &mut Vec<f64>) {
    let (samples, half) = (before.len() - 1, window / 2);
    let scale = 1.0 / window as f64;
    out.clear();
    out.extend(before[half + 1..window].iter().map(|sum| sum * scale));
    widest(
        #[inline(always)]
        || {
            let pairs = before[window..].iter().zip(before);
            out.extend(pairs.map(|(to, from)| (to - from) * scale));
        },
    );
    let from = &before[samples + 1 - window..samples - half];
    out.extend(from.iter().map(|from| (before[samples] - from) * scale));
}

#[cfg(test)]
mod tests {
    use super::*;
    use num_complex::Complex64;
    use rand_chacha::ChaCha12Rng;
    use rand_chacha::rand_core::{Rng, SeedableRng};
    use std::f64::consts::{PI, TAU};

    const C: f64 = 1500.0;
    const RATE_HZ: f64 = 40e3;
    const BANDWIDTH_HZ: f64 = 20e3;
    const DEPTH_M: f64 = 20.0;
    const LINE_WAVELENGTHS: f64 = 64.0;
    const SEEDS: usize = 6;

    /// The whole line's beams and the products of its halves above a bottom z = depth + slope y of point scatterers with random strengths, Lambert's law and spreading.
    fn beams(slope: f64, angles: &[f64], seed: u64) -> (BeamFrame, Vec<Complex32>) {
        let samples = 4500;
        let mut rng = ChaCha12Rng::seed_from_u64(seed);
        let mut uniform = || (rng.next_u64() as f64 + 0.5) / 2f64.powi(64);
        let width = |angle: &f64| 0.886 / (0.5 * LINE_WAVELENGTHS) / angle.cos();
        let mut whole = BeamFrame {
            beams: angles.len(),
            samples,
            angle_rad: angles.to_vec(),
            width_rad: angles.iter().map(width).collect(),
            iq: Vec::new(),
        };
        let mut halves = [(); 2].map(|()| vec![Complex64::ZERO; angles.len() * samples]);
        let sinc = |x: f64| {
            if x.abs() < 1e-9 {
                1.0
            } else {
                (PI * x).sin() / (PI * x)
            }
        };
        for _ in 0..55_000 {
            let y = -110.0 + 220.0 * uniform();
            let z = DEPTH_M + slope * y;
            let r = y.hypot(z);
            let place = 2.0 * r / C * RATE_HZ;
            let normal = (z - slope * y) / (r * 1f64.hypot(slope));
            let strength = Complex64::from_polar(
                (-uniform().ln()).sqrt() * normal.max(0.0) / (r * r),
                TAU * uniform(),
            );
            for (b, angle) in angles.iter().enumerate() {
                let off = y / r - angle.sin();
                // Pattern of half a uniform line, without far side lobes.
                let u = 0.5 * LINE_WAVELENGTHS * off;
                if u.abs() > 12.0 {
                    continue;
                }
                let pattern = sinc(u);
                for (half, sign) in halves.iter_mut().zip([-1.0, 1.0]) {
                    let phase = sign * 0.5 * PI * LINE_WAVELENGTHS * off;
                    let echo = strength * pattern * Complex64::from_polar(1.0, phase);
                    let first = (place as usize).saturating_sub(6);
                    for k in first..(first + 13).min(samples) {
                        let t = (k as f64 - place) / RATE_HZ;
                        let at = t * BANDWIDTH_HZ;
                        // A compressed pulse with the side lobes of a Hann weighting.
                        let level = sinc(at) + 0.5 * (sinc(at - 1.0) + sinc(at + 1.0));
                        half[b * samples + k] += echo * level;
                    }
                }
            }
        }
        let narrow = |z: Complex64| Complex32::new(z.re as f32, z.im as f32);
        let mut products = Vec::new();
        for (a, b) in halves[0].iter().zip(&halves[1]) {
            products.push(narrow(a * b.conj()));
            whole.iq.push(narrow(0.5 * (a + b)));
        }
        (whole, products)
    }

    #[test]
    fn soundings_of_flat_and_sloping_bottoms_are_within_a_percent_of_the_depth() {
        let angles: Vec<f64> = (-6..=6)
            .map(|i| f64::from(i) * 10f64.to_radians())
            .collect();
        for slope in [0.0, 0.15, -0.25] {
            // Depth errors of each beam over the seeds, against the true depth at the sounding.
            let mut errors = vec![Vec::new(); angles.len()];
            let mut by_phase = vec![0; angles.len()];
            let mut detector = BottomDetector::new(RATE_HZ, BANDWIDTH_HZ, 4500);
            let mut soundings = Vec::new();
            for seed in 0..SEEDS as u64 {
                let (whole, products) = beams(slope, &angles, seed);
                detector.detect(&whole, &products, 0.0, 0.005, &mut soundings);
                for s in &soundings {
                    let r = 0.5 * C * s.twtt_s;
                    let (y, z) = (r * s.angle_rad.sin(), r * s.angle_rad.cos());
                    errors[s.beam].push(z - (DEPTH_M + slope * y));
                    by_phase[s.beam] += usize::from(s.detection == Detection::Phase);
                }
            }
            for (b, errors) in errors.iter_mut().enumerate() {
                assert_eq!(errors.len(), SEEDS, "beam {b}: soundings missing");
                let mean = errors.iter().sum::<f64>() / SEEDS as f64;
                errors.sort_by(|x, y| x.abs().total_cmp(&y.abs()));
                let worst = errors[SEEDS - 1].abs();
                println!(
                    "slope {slope}, {:>4.0} deg: mean {mean:+.3} m, worst {worst:.3} m, {} of {SEEDS} by phase",
                    angles[b].to_degrees(),
                    by_phase[b]
                );
                assert!(mean.abs() < 0.01 * DEPTH_M, "beam {b}: mean {mean}");
                assert!(worst < 0.03 * DEPTH_M, "beam {b}: {errors:?}");
            }
            if slope == 0.0 {
                assert!(by_phase[0] >= 5 && by_phase[12] >= 5, "{by_phase:?}");
            }
        }
    }

    #[test]
    fn empty_beams_and_stationary_noise_have_no_bottom() {
        let mut rng = ChaCha12Rng::seed_from_u64(3);
        let mut frame = BeamFrame {
            beams: 2,
            samples: 3000,
            angle_rad: vec![0.0; 2],
            width_rad: vec![0.0; 2],
            iq: vec![Complex32::ZERO; 6000],
        };
        for x in &mut frame.iq[3000..] {
            let mut draw = || rng.next_u32() as f32 / u32::MAX as f32 - 0.5;
            *x = Complex32::new(draw(), draw());
        }
        let mut soundings = Vec::new();
        let mut detector = BottomDetector::new(RATE_HZ, BANDWIDTH_HZ, 3000);
        let products = vec![Complex32::ONE; 6000];
        detector.detect(&frame, &products, 0.0, 0.005, &mut soundings);
        assert!(soundings.is_empty(), "{soundings:?}");
    }
}
