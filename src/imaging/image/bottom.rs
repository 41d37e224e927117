//! Bottom detection: where each beam of a fan meets the bottom.
//!
//! Two beams of the same direction are made of the two halves of the line. Where the bottom crosses a beam, the phase between the halves goes
//! through zero: a straight line through the phases about there gives the instant (outer beams). Where the bottom lies flat under a beam the
//! echo is short, and the centre of its energy gives it (inner beams). Of the two the one with the smaller predicted error is taken.
//!
//! Sources: Lurton 2010, An Introduction to Underwater Acoustics, 8.3 (both methods); Ladroit, Lurton, Sintes and Garello 2012 (quality
//! factors). The predicted errors are ours: of the phase, the scatter of its residuals through the straight line; of the amplitude, the rms
//! length of the echo over the root of the independent samples in it.
//!
//! A beam is searched from `first_sample_s` on for its strongest stretch; nothing is known of the neighbours. Not modelled: several bottoms
//! in one beam, refraction, gates from other sounders.

use num_complex::Complex64;

use echotank_core::flow::{BeamFrame, Detection, Sounding};

/// Beams whose greatest smoothed level is not this far above the median of the beam have no bottom.
const MIN_ABOVE_MEDIAN_DB: f64 = 6.0;
/// The energy's centre is taken over samples within this of the greatest.
const AMPLITUDE_FLOOR: f64 = 0.25;
/// Phases beyond this belong to the ambiguity, not to the crossing, radians.
const PHASE_REACH_RAD: f64 = 2.2;
/// Fewest samples of a straight line.
const MIN_LINE: usize = 8;
/// Beams are taken for no flatter than this.
const STEEPEST_RAD: f64 = 1.45;
/// A footprint's centre of energy lies off its axis by this share of it, about: level falls with range and incidence.
const CENTRE_SHARE: f64 = 0.1;
/// A crossing is one only where the smoothed level is above this share of the greatest.
const CROSSING_FLOOR: f64 = 0.3;
/// Rounds of looking again about the crossing.
const ROUNDS: usize = 3;

/// Detects with buffers of its own.
pub struct BottomDetector {
    sample_rate_hz: f64,
    bandwidth_hz: f64,
    intensity: Vec<f64>,
    smooth: Vec<f64>,
    cross: Vec<Complex64>,
    sorted: Vec<f64>,
}

/// What one method found.
#[derive(Clone, Copy, Debug)]
struct Found {
    sample: f64,
    error_samples: f64,
}

impl BottomDetector {
    /// `bandwidth_hz` of the compressed pulse: samples closer than its inverse are not independent.
    pub fn new(sample_rate_hz: f64, bandwidth_hz: f64, samples: usize) -> Self {
        Self {
            sample_rate_hz,
            bandwidth_hz: bandwidth_hz.max(1.0),
            intensity: Vec::with_capacity(samples),
            smooth: Vec::with_capacity(samples),
            cross: Vec::with_capacity(samples),
            sorted: Vec::with_capacity(samples),
        }
    }

    /// One sounding for each beam that has a bottom. `halves` are the fans of the line's two halves, of the same beams and samples, whose sample k
    /// lies at `first_sample_s` + k / rate; no bottom is looked for before `min_s`.
    pub fn detect(
        &mut self,
        halves: [&BeamFrame; 2],
        first_sample_s: f64,
        min_s: f64,
        out: &mut Vec<Sounding>,
    ) {
        out.clear();
        let [a, b] = halves;
        let first = ((min_s - first_sample_s) * self.sample_rate_hz).max(0.0) as usize;
        for beam in 0..a.beams {
            // How long a flat bottom stays in the whole line's beam, over how long its echo has been under way.
            let stay = 0.5 * a.width_rad[beam] * a.angle_rad[beam].abs().min(STEEPEST_RAD).tan();
            let delayed = first_sample_s * self.sample_rate_hz;
            let row = (a.beam(beam), b.beam(beam));
            let found = self.one(row, first.min(a.samples), delayed, stay);
            let Some((detection, found, level)) = found else {
                continue;
            };
            out.push(Sounding {
                beam,
                angle_rad: a.angle_rad[beam],
                twtt_s: first_sample_s + found.sample / self.sample_rate_hz,
                error_s: found.error_samples / self.sample_rate_hz,
                detection,
                level_v: level.sqrt(),
            });
        }
    }

    fn one(
        &mut self,
        (a, b): (&[Complex64], &[Complex64]),
        first: usize,
        delayed: f64,
        stay: f64,
    ) -> Option<(Detection, Found, f64)> {
        let (a, b) = (&a[first..], &b[first..]);
        if a.len() < MIN_LINE {
            return None;
        }
        self.intensity.clear();
        self.intensity
            .extend(a.iter().zip(b).map(|(a, b)| (0.5 * (a + b)).norm_sqr()));
        self.cross.clear();
        self.cross
            .extend(a.iter().zip(b).map(|(a, b)| a * b.conj()));
        // Over about four resolution cells: speckle alone must not be the greatest.
        let cell = (self.sample_rate_hz / self.bandwidth_hz).max(1.0);
        let window = (4.0 * cell).ceil() as usize | 1;
        running_mean(&self.intensity, window, &mut self.smooth);
        let (rough, _) = greatest(&self.smooth)?;
        // Then over half of the time that a flat bottom there would stay in the beam: one bright spot is not the whole echo.
        let footprint = stay * ((rough + first) as f64 + delayed);
        let window = window.max((0.5 * footprint).ceil() as usize | 1);
        let window = window.min(a.len() | 1);
        running_mean(&self.intensity, window, &mut self.smooth);
        let (peak, level) = greatest(&self.smooth)?;
        self.sorted.clear();
        self.sorted.extend_from_slice(&self.smooth);
        let middle = self.sorted.len() / 2;
        let (_, median, _) = self.sorted.select_nth_unstable_by(middle, f64::total_cmp);
        if level.is_nan()
            || level <= 0.0
            || level < *median * 10f64.powf(MIN_ABOVE_MEDIAN_DB / 10.0)
        {
            return None;
        }
        let amplitude = self.by_amplitude(peak, level, footprint, cell);
        let phase = self.by_phase(peak as f64, level, footprint, cell);
        let (detection, found) = match phase {
            Some(phase) if phase.error_samples < amplitude.error_samples => {
                (Detection::Phase, phase)
            }
            _ => (Detection::Amplitude, amplitude),
        };
        let found = Found {
            sample: found.sample + first as f64,
            ..found
        };
        Some((detection, found, level))
    }

    /// Centre of the energy of the stretch about the peak.
    fn by_amplitude(&self, peak: usize, level: f64, footprint: f64, cell: f64) -> Found {
        let (from, to) = self.stretch(peak, level * AMPLITUDE_FLOOR);
        let (mut sum, mut first, mut second) = (0.0, 0.0, 0.0);
        for (k, i) in self.intensity[from..to].iter().enumerate() {
            let x = (from + k) as f64 - peak as f64;
            sum += i;
            first += i * x;
            second += i * x * x;
        }
        let mean = first / sum;
        let variance = (second / sum - mean * mean).max(0.0);
        let independent = ((to - from) as f64 / cell).max(1.0);
        Found {
            sample: peak as f64 + mean,
            // Not below what one cell allows, nor what the slope of level over a beam's footprint does to its centre.
            error_samples: (variance / independent)
                .sqrt()
                .max(0.1 * cell)
                .max(CENTRE_SHARE * footprint),
        }
    }

    /// Ends of the stretch about `peak` in which the smoothed intensity stays above `floor`.
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

    /// A straight line through the phases about their crossing of zero, each weighted with its energy: first about `centre`, then about the
    /// crossing, over no more than the `footprint` of the beam, in which the phase is not ambiguous.
    fn by_phase(&self, centre: f64, level: f64, footprint: f64, cell: f64) -> Option<Found> {
        if footprint < MIN_LINE as f64 {
            return None;
        }
        let mut crossing = centre;
        let mut error_samples = f64::INFINITY;
        for round in 0..ROUNDS {
            let half = footprint * if round == 0 { 0.7 } else { 0.5 };
            let from = (crossing - half).max(0.0) as usize;
            let to = ((crossing + half).max(0.0) as usize + 1).min(self.cross.len());
            let mut line = Line::default();
            for k in from..to {
                let z = self.cross[k];
                // Beyond lies the ambiguity, or noise.
                if z.arg().abs() <= PHASE_REACH_RAD {
                    line.add(k as f64, z.arg(), z.norm());
                }
            }
            let (slope, zero) = line.fit()?;
            if (zero - crossing).abs() > half {
                return None;
            }
            crossing = zero;
            // At the next ambiguity the line as a whole hears nothing.
            let heard = self.smooth.get(zero.max(0.0) as usize);
            if heard.is_none_or(|heard| *heard < CROSSING_FLOOR * level) {
                return None;
            }
            let independent = (line.count as f64 / cell - 1.0).max(1.0);
            error_samples = line.residual_rad() / slope.abs() / independent.sqrt();
        }
        Some(Found {
            sample: crossing,
            error_samples: error_samples.max(0.02 * cell),
        })
    }
}

/// Weighted sums of a straight line.
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

    /// Slope and where it crosses zero.
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

fn greatest(levels: &[f64]) -> Option<(usize, f64)> {
    let levels = levels.iter().copied().enumerate();
    levels.max_by(|x, y| x.1.total_cmp(&y.1))
}

/// Mean over `window` (odd) samples about each.
fn running_mean(from: &[f64], window: usize, out: &mut Vec<f64>) {
    out.clear();
    let half = window / 2;
    let mut sum: f64 = from[..half.min(from.len())].iter().sum();
    for k in 0..from.len() {
        if let Some(x) = from.get(k + half) {
            sum += x;
        }
        if k > half {
            sum -= from[k - half - 1];
        }
        out.push(sum / window as f64);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand_chacha::ChaCha12Rng;
    use rand_chacha::rand_core::{Rng, SeedableRng};
    use std::f64::consts::{PI, TAU};

    const C: f64 = 1500.0;
    const RATE_HZ: f64 = 40e3;
    const BANDWIDTH_HZ: f64 = 20e3;
    const DEPTH_M: f64 = 20.0;
    const LINE_WAVELENGTHS: f64 = 64.0;
    const SEEDS: usize = 6;

    /// Half beams of a line straight over a bottom z = depth + slope y of point scatterers with random strengths, Lambert's law and spreading.
    fn halves(slope: f64, angles: &[f64], seed: u64) -> [BeamFrame; 2] {
        let samples = 4500;
        let mut rng = ChaCha12Rng::seed_from_u64(seed);
        let mut uniform = || (rng.next_u64() as f64 + 0.5) / 2f64.powi(64);
        let mut frames = [BeamFrame::default(), BeamFrame::default()];
        for frame in &mut frames {
            frame.beams = angles.len();
            frame.samples = samples;
            frame.angle_rad = angles.to_vec();
            let width = |angle: &f64| 0.886 / (0.5 * LINE_WAVELENGTHS) / angle.cos();
            frame.width_rad = angles.iter().map(width).collect();
            frame.iq = vec![Complex64::ZERO; angles.len() * samples];
        }
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
                // The pattern of a half of a uniform line; far side lobes are left out.
                let u = 0.5 * LINE_WAVELENGTHS * off;
                if u.abs() > 12.0 {
                    continue;
                }
                let pattern = sinc(u);
                for (frame, sign) in frames.iter_mut().zip([-1.0, 1.0]) {
                    let phase = sign * 0.5 * PI * LINE_WAVELENGTHS * off;
                    let echo = strength * pattern * Complex64::from_polar(1.0, phase);
                    let first = (place as usize).saturating_sub(6);
                    for k in first..(first + 13).min(samples) {
                        let t = (k as f64 - place) / RATE_HZ;
                        let at = t * BANDWIDTH_HZ;
                        // A compressed pulse with Hann's side lobes.
                        let level = sinc(at) + 0.5 * (sinc(at - 1.0) + sinc(at + 1.0));
                        frame.iq[b * samples + k] += echo * level;
                    }
                }
            }
        }
        frames
    }

    #[test]
    fn flat_and_sloping_bottoms_are_sounded_within_a_percent_of_the_depth_at_every_angle() {
        let angles: Vec<f64> = (-6..=6)
            .map(|i| f64::from(i) * 10f64.to_radians())
            .collect();
        for slope in [0.0, 0.15, -0.25] {
            // Per beam, over the seeds: depth errors where the sounding lies, against the truth there.
            let mut errors = vec![Vec::new(); angles.len()];
            let mut by_phase = vec![0; angles.len()];
            let mut detector = BottomDetector::new(RATE_HZ, BANDWIDTH_HZ, 4500);
            let mut soundings = Vec::new();
            for seed in 0..SEEDS as u64 {
                let [a, b] = halves(slope, &angles, seed);
                detector.detect([&a, &b], 0.0, 0.005, &mut soundings);
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
    fn beams_of_nothing_or_of_even_noise_have_no_bottom() {
        let mut rng = ChaCha12Rng::seed_from_u64(3);
        let mut frame = BeamFrame {
            beams: 2,
            samples: 3000,
            angle_rad: vec![0.0; 2],
            width_rad: vec![0.0; 2],
            iq: vec![Complex64::ZERO; 6000],
        };
        for x in &mut frame.iq[3000..] {
            let mut draw = || rng.next_u32() as f64 / f64::from(u32::MAX) - 0.5;
            *x = Complex64::new(draw(), draw());
        }
        let mut soundings = Vec::new();
        let mut detector = BottomDetector::new(RATE_HZ, BANDWIDTH_HZ, 3000);
        detector.detect([&frame, &frame], 0.0, 0.005, &mut soundings);
        assert!(soundings.is_empty(), "{soundings:?}");
    }
}
