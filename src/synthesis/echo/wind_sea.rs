//! Height and orbital velocity of the surface of a wind sea.
//!
//! Pierson and Moskowitz 1964: the height of a fully developed sea has the spectrum alpha g^2 w^-5 exp(-beta (g / (U w))^4), with alpha = 8.1e-3 and
//! beta = 0.74. In deep water the vertical velocity has that spectrum times w^2, so its variance is
//!
//! ```text
//! alpha sqrt(pi) U^2 / (4 sqrt(beta)) = 4.17e-3 U^2
//! ```
//!
//! and the horizontal velocity has the same, a quarter of a period apart (Kinsman 1965, Wind Waves, section 3.4). With u = beta (g / (U w))^4 the variance
//! below u is erf(sqrt(u)) of the whole. Waves of equal variance therefore have the frequencies at even steps of erf(sqrt(u)).
//!
//! Without a wind direction they come from all directions alike. With one, their directions spread about it by (2/pi) cos^2 (Pierson, Neumann and James
//! 1955; ITTC 2002), at even steps of its distribution, and the surface drifts with the waves (Kenyon 1969): the Stokes drift of the spectrum is
//!
//! ```text
//! 2/g * integral of w^3 S(w) dw * mean cosine = alpha Gamma(1/4) / (2 beta^(1/4)) * 8/(3 pi) U = 0.0134 U
//! ```

use std::f64::consts::{PI, TAU};

use glam::{DVec2, DVec3};

const ALPHA: f64 = 8.1e-3;
const BETA: f64 = 0.74;
const GRAVITY_M_PER_S2: f64 = 9.81;
/// Waves of the sum.
const WAVES: usize = 32;
/// Gamma(1/4).
const GAMMA_OF_QUARTER: f64 = 3.625_609_908_221_908;
/// Mean cosine of the directions.
const MEAN_COSINE: f64 = 8.0 / (3.0 * PI);

/// Variance of the vertical velocity of the surface, (m/s)^2; that of each horizontal component is half of it.
pub fn vertical_velocity_variance(wind_m_per_s: f64) -> f64 {
    ALPHA * PI.sqrt() * wind_m_per_s * wind_m_per_s / (4.0 * BETA.sqrt())
}

/// Speed at which the surface drifts with the waves of a wind of one direction, m/s.
pub fn stokes_drift_m_per_s(wind_m_per_s: f64) -> f64 {
    0.5 * ALPHA * GAMMA_OF_QUARTER / libm::pow(BETA, 0.25) * MEAN_COSINE * wind_m_per_s
}

/// A sea over place and time.
#[derive(Clone, Debug)]
pub struct WindSea {
    /// Of every wave.
    amplitude_m_per_s: f64,
    /// The longest last.
    waves: [Wave; WAVES],
    drift_m_per_s: DVec3,
}

/// Motion of a point of the surface, world.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct SurfaceMotion {
    /// Metres per second.
    pub velocity_m_per_s: DVec3,
    /// Metres per second squared.
    pub acceleration_m_per_s2: DVec3,
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
    /// `from_rad`: where the wind comes from, clockwise from north. `fractions`: random numbers from 0 to 1 for the phases and the first direction.
    pub fn new(
        wind_m_per_s: f64,
        from_rad: Option<f64>,
        mut fractions: impl FnMut(u32) -> f64,
    ) -> Self {
        let first = fractions(0);
        let wave = |i: usize| {
            let root = erf_inverse((i as f64 + 0.5) / WAVES as f64);
            let over_u = libm::pow(BETA / (root * root), 0.25);
            let frequency_rad_per_s = over_u * GRAVITY_M_PER_S2 / wind_m_per_s.max(1e-3);
            // Even steps of the golden angle.
            let turns = first + i as f64 * 0.618_033_988_749_895;
            let turns = turns - turns.floor();
            let (sin, cos) = libm::sincos(match from_rad {
                None => TAU * turns,
                Some(from_rad) => from_rad + PI + spread_rad(turns),
            });
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
            drift_m_per_s: from_rad.map_or(DVec3::ZERO, |from_rad| {
                let (sin, cos) = libm::sincos(from_rad + PI);
                DVec3::new(cos, sin, 0.0) * stokes_drift_m_per_s(wind_m_per_s)
            }),
        }
    }

    /// Motion of the surface at a place, north and east in metres, and a time in seconds.
    pub fn motion(&self, north_m: f64, east_m: f64, time_s: f64) -> SurfaceMotion {
        let at_m = DVec2::new(north_m, east_m);
        let (mut velocity, mut acceleration) = (DVec3::ZERO, DVec3::ZERO);
        for wave in &self.waves {
            let (sin, cos) = libm::sincos(wave.angle_rad(at_m, time_s));
            // Height a cos, upward velocity a w sin, forward velocity a w cos.
            velocity += (wave.direction * cos).extend(-sin);
            acceleration += (wave.direction * sin).extend(cos) * wave.per_s;
        }
        SurfaceMotion {
            velocity_m_per_s: velocity * self.amplitude_m_per_s + self.drift_m_per_s,
            acceleration_m_per_s2: acceleration * (TAU * self.amplitude_m_per_s),
        }
    }

    /// Height of the surface above its mean, metres, and how fast it rises, m/s, at a place, north and east in metres, and a time in seconds, by the waves
    /// longer than `longer_m`.
    pub fn height_m(&self, north_m: f64, east_m: f64, time_s: f64, longer_m: f64) -> (f64, f64) {
        let at_m = DVec2::new(north_m, east_m);
        let (mut height_m, mut rise) = (0.0, 0.0);
        for wave in self.longer(longer_m) {
            let (sin, cos) = libm::sincos(wave.angle_rad(at_m, time_s));
            height_m += cos / (TAU * wave.per_s);
            rise += sin;
        }
        (
            height_m * self.amplitude_m_per_s,
            rise * self.amplitude_m_per_s,
        )
    }

    /// Variance of the height by the waves longer than `longer_m`, square metres.
    pub fn height_variance_m2(&self, longer_m: f64) -> f64 {
        let variances = self.longer(longer_m).map(|wave| {
            let amplitude_m = self.amplitude_m_per_s / (TAU * wave.per_s);
            0.5 * amplitude_m * amplitude_m
        });
        variances.sum()
    }

    fn longer(&self, longer_m: f64) -> impl Iterator<Item = &Wave> {
        let waves = self.waves.iter().rev();
        waves.take_while(move |wave| wave.per_m * longer_m < 1.0)
    }
}

impl Wave {
    fn angle_rad(&self, at_m: DVec2, time_s: f64) -> f64 {
        let turns = self.per_m * self.direction.dot(at_m) - self.per_s * time_s + self.phase;
        TAU * (turns - turns.floor())
    }
}

/// The angle from the mean direction below which lies `share` of (2/pi) cos^2.
fn spread_rad(share: f64) -> f64 {
    let below = |rad: f64| 0.5 + (rad + 0.5 * libm::sin(2.0 * rad)) / PI;
    let (mut low, mut high) = (-0.5 * PI, 0.5 * PI);
    for _ in 0..60 {
        let middle = 0.5 * (low + high);
        match below(middle) < share {
            true => low = middle,
            false => high = middle,
        }
    }
    0.5 * (low + high)
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
            let sea = WindSea::new(wind, None, |i| f64::from(i) * 0.755 % 1.0);
            let n = 40_000;
            let (mut squares, mut heights2) = (DVec3::ZERO, 0.0);
            for k in 0..n {
                let k = f64::from(k);
                let (north_m, east_m, time_s) = (7919.0 * k, -104_729.0 * k, 1.37 * k);
                let v = sea.motion(north_m, east_m, time_s).velocity_m_per_s;
                squares += v * v;
                heights2 += sea.height_m(north_m, east_m, time_s, 0.0).0.powi(2);
            }
            let mean = squares / f64::from(n);
            // The variance of the height, of the spectrum and of a quarter of its waves and more.
            let height2 = heights2 / f64::from(n);
            assert!((height2 / moment(0) - 1.0).abs() < 0.03, "{height2}");
            assert!((sea.height_variance_m2(0.0) / moment(0) - 1.0).abs() < 0.01);
            let longest_m = 1.0 / sea.waves[WAVES - 1].per_m;
            assert_eq!(sea.height_variance_m2(1.01 * longest_m), 0.0);
            assert!(sea.height_variance_m2(0.99 * longest_m) > 0.05 * moment(0));
            assert!((mean.z / want - 1.0).abs() < 0.03, "{wind}: {mean} {want}");
            for side in [mean.x, mean.y] {
                assert!(
                    (side / (0.5 * want) - 1.0).abs() < 0.1,
                    "{wind}: {mean} {want}"
                );
            }
        }
    }

    /// Velocity and acceleration are the derivatives of the height and of the velocity.
    #[test]
    fn a_sea_moves_as_its_height_changes() {
        let sea = WindSea::new(9.0, Some(0.7), |i| f64::from(i) * 0.3819 % 1.0);
        for k in 0..200 {
            let k = f64::from(k);
            let (north_m, east_m, time_s) = (3.1 * k, -7.7 * k, 0.31 * k);
            let step_s = 1e-4;
            let [a, b] = [-step_s, step_s].map(|step_s| time_s + step_s);
            let height_m = |time_s: f64| sea.height_m(north_m, east_m, time_s, 0.0).0;
            let rise = (height_m(b) - height_m(a)) / (2.0 * step_s);
            let (_, rises) = sea.height_m(north_m, east_m, time_s, 0.0);
            assert!((rise - rises).abs() < 1e-6);
            let motion = |time_s: f64| sea.motion(north_m, east_m, time_s);
            let at = motion(time_s);
            assert!((rise + at.velocity_m_per_s.z).abs() < 1e-6);
            let turned = motion(b).velocity_m_per_s - motion(a).velocity_m_per_s;
            let off = turned / (2.0 * step_s) - at.acceleration_m_per_s2;
            assert!(off.length() < 1e-5, "{off}");
        }
    }

    /// Drift and mean squares along and across the wind against sums over the spectrum and its directions.
    #[test]
    fn a_wind_of_one_direction_has_the_drift_and_the_spread_of_its_spectrum() {
        let wind: f64 = 7.0;
        let (step, turn) = (2e-3, 1e-3);
        let (mut drift, mut along2, mut across2) = (0.0, 0.0, 0.0);
        let angles = (0..(PI / turn) as usize).map(|k| turn * (k as f64 + 0.5) - 0.5 * PI);
        let spreads: Vec<f64> = angles.collect();
        let [c, cc, ss] = [
            |a: f64| a.cos(),
            |a: f64| a.cos().powi(2),
            |a: f64| a.sin().powi(2),
        ]
        .map(|of: fn(f64) -> f64| {
            let all = spreads
                .iter()
                .map(|a| 2.0 / PI * a.cos().powi(2) * of(*a) * turn);
            all.sum::<f64>()
        });
        for k in 1..200_000 {
            let w = step * (f64::from(k) + 0.5);
            let over = GRAVITY_M_PER_S2 / (wind * w);
            let height = ALPHA * GRAVITY_M_PER_S2.powi(2) * w.powi(-5);
            let s = height * (-BETA * over.powi(4)).exp() * step;
            drift += 2.0 / GRAVITY_M_PER_S2 * w.powi(3) * s * c;
            along2 += w * w * s * cc;
            across2 += w * w * s * ss;
        }
        let got = stokes_drift_m_per_s(wind);
        assert!((got / drift - 1.0).abs() < 0.01, "{got} {drift}");
        let from_rad: f64 = 0.4;
        let towards = DVec2::new(-from_rad.cos(), -from_rad.sin());
        let n = 20_000;
        // The directions of a few waves differ from their distribution; the mean of many seas does not.
        let (mut mean, mut squares) = (DVec2::ZERO, DVec2::ZERO);
        for seed in 0..32 {
            let sea = WindSea::new(wind, Some(from_rad), |i| {
                (f64::from(i) * 0.755 + f64::from(seed) * 0.414_213_562) % 1.0
            });
            for k in 0..n / 32 {
                let k = f64::from(k);
                let v = sea
                    .motion(7919.0 * k, -104_729.0 * k, 1.37 * k)
                    .velocity_m_per_s;
                let v = DVec2::new(v.truncate().dot(towards), v.truncate().perp_dot(towards));
                mean += v / f64::from(n / 32 * 32);
                squares += v * v / f64::from(n / 32 * 32);
            }
        }
        let spread = squares - mean * mean;
        println!("drift {mean}, {drift}; spread {spread}, {along2} {across2}");
        assert!(
            (mean.x - drift).abs() < 0.05 * along2.sqrt() && mean.y.abs() < 0.05 * along2.sqrt()
        );
        assert!((spread.x / along2 - 1.0).abs() < 0.05 && (spread.y / across2 - 1.0).abs() < 0.08);
    }
}
