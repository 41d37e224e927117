//! Orbital velocity of the surface of a wind sea.
//!
//! Pierson and Moskowitz 1964: the height of a fully developed sea has the spectrum alpha g^2 w^-5 exp(-beta (g / (U w))^4), with alpha = 8.1e-3 and
//! beta = 0.74. In deep water the vertical velocity has that spectrum times w^2, so its variance is
//!
//! ```text
//! alpha sqrt(pi) U^2 / (4 sqrt(beta)) = 4.17e-3 U^2
//! ```
//!
//! and the horizontal velocity has the same, a quarter of a period apart (Kinsman 1965, Wind Waves, section 3.4). With u = beta (g / (U w))^4 the variance
//! below u is erf(sqrt(u)) of the whole. Waves of equal variance therefore have the frequencies at even steps of erf(sqrt(u)). They come from all
//! directions alike.

use std::f64::consts::{PI, TAU};

use glam::{DVec2, DVec3};

const ALPHA: f64 = 8.1e-3;
const BETA: f64 = 0.74;
const GRAVITY_M_PER_S2: f64 = 9.81;
/// Waves of the sum.
const WAVES: usize = 32;

/// Variance of the vertical velocity of the surface, (m/s)^2; that of each horizontal component is half of it.
pub fn vertical_velocity_variance(wind_m_per_s: f64) -> f64 {
    ALPHA * PI.sqrt() * wind_m_per_s * wind_m_per_s / (4.0 * BETA.sqrt())
}

/// The velocity of a sea over place and time.
#[derive(Clone, Debug)]
pub struct WindSea {
    /// Of every wave.
    amplitude_m_per_s: f64,
    waves: [Wave; WAVES],
}

#[derive(Clone, Copy, Debug, Default)]
struct Wave {
    direction: DVec2,
    /// Waves per metre and per second, and the phase in turns.
    per_m: f64,
    per_s: f64,
    phase: f64,
}

impl WindSea {
    /// `fractions`: random numbers from 0 to 1 for the phases and the first direction.
    pub fn new(wind_m_per_s: f64, mut fractions: impl FnMut(u32) -> f64) -> Self {
        let first = fractions(0);
        let wave = |i: usize| {
            let root = erf_inverse((i as f64 + 0.5) / WAVES as f64);
            let over_u = libm::pow(BETA / (root * root), 0.25);
            let frequency_rad_per_s = over_u * GRAVITY_M_PER_S2 / wind_m_per_s.max(1e-3);
            // Even steps of the golden angle.
            let turns = first + i as f64 * 0.618_033_988_749_895;
            let (sin, cos) = libm::sincos(TAU * (turns - turns.floor()));
            Wave {
                direction: DVec2::new(cos, sin),
                per_m: frequency_rad_per_s * frequency_rad_per_s / (TAU * GRAVITY_M_PER_S2),
                per_s: frequency_rad_per_s / TAU,
                phase: fractions(1 + i as u32),
            }
        };
        Self {
            amplitude_m_per_s: (2.0 * vertical_velocity_variance(wind_m_per_s) / WAVES as f64)
                .sqrt(),
            waves: std::array::from_fn(wave),
        }
    }

    /// Velocity of the surface at a place, north and east in metres, and a time in seconds: world, m/s.
    pub fn velocity_m_per_s(&self, north_m: f64, east_m: f64, time_s: f64) -> DVec3 {
        let at_m = DVec2::new(north_m, east_m);
        let mut sum = DVec3::ZERO;
        for wave in &self.waves {
            let turns = wave.per_m * wave.direction.dot(at_m) - wave.per_s * time_s + wave.phase;
            let (sin, cos) = libm::sincos(TAU * (turns - turns.floor()));
            // Upward velocity a w sin, forward velocity a w cos.
            sum += (wave.direction * cos).extend(-sin);
        }
        sum * self.amplitude_m_per_s
    }
}

/// The x with erf(x) = `y`, 0 <= y < 1.
fn erf_inverse(y: f64) -> f64 {
    let (mut low, mut high) = (0.0, 6.0);
    for _ in 0..60 {
        let middle = 0.5 * (low + high);
        match libm::erf(middle) < y {
            true => low = middle,
            false => high = middle,
        }
    }
    0.5 * (low + high)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The second moment of the spectrum by sums, and the mean squares of a sea.
    #[test]
    fn a_sea_has_the_velocities_of_its_spectrum() {
        for wind in [3.0, 8.0, 15.0] {
            let step = 1e-3;
            let moment = |power: i32| {
                let of = |k: i32| {
                    let w = step * (f64::from(k) + 0.5);
                    let over = GRAVITY_M_PER_S2 / (wind * w);
                    let height = ALPHA * GRAVITY_M_PER_S2.powi(2) * w.powi(-5);
                    height * (-BETA * over.powi(4)).exp() * w.powi(power) * step
                };
                (1..400_000).map(of).sum::<f64>()
            };
            let want = vertical_velocity_variance(wind);
            assert!((moment(2) / want - 1.0).abs() < 1e-3, "{wind}");
            // A quarter of the significant height 0.0213 U^2.
            assert!((moment(0).sqrt() / (0.25 * 0.0213 * wind * wind) - 1.0).abs() < 5e-3);
            let sea = WindSea::new(wind, |i| f64::from(i) * 0.755 % 1.0);
            let n = 40_000;
            let mut squares = DVec3::ZERO;
            for k in 0..n {
                let k = f64::from(k);
                let v = sea.velocity_m_per_s(7919.0 * k, -104_729.0 * k, 1.37 * k);
                squares += v * v;
            }
            let mean = squares / f64::from(n);
            assert!((mean.z / want - 1.0).abs() < 0.03, "{wind}: {mean} {want}");
            for side in [mean.x, mean.y] {
                assert!(
                    (side / (0.5 * want) - 1.0).abs() < 0.1,
                    "{wind}: {mean} {want}"
                );
            }
        }
    }
}
