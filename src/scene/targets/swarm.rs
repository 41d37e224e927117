//! Schools of fish and plumes of bubbles: many individuals with a motion of their own.
//!
//! Each individual is a point with a constant strength and a random phase. Its place is a function of time: nothing is remembered from ping to ping.

use std::f64::consts::TAU;

use glam::{DMat3, DVec2, DVec3};
use num_complex::Complex64;

use crate::draws::{fraction, philox};

/// Separates these numbers from other uses of the same seed. A change of the algorithm needs a new value.
const SWARM: u32 = 0x5A4A_0101;
/// Shortest turn of a fish, seconds, and ratio of the longest to it.
const TURN_S: (f64, f64) = (4.0, 3.0);

/// Individuals and their motion.
#[derive(Clone, Debug)]
pub(crate) struct Swarm {
    pub shape: SwarmShape,
    /// Number of individuals.
    pub count: usize,
    /// Echo pressure of an individual at 1 m for unit incident pressure.
    pub strength: f64,
    key: [u32; 2],
    target: u32,
}

#[derive(Clone, Copy, Debug)]
pub enum SwarmShape {
    /// An ellipsoid, evenly filled. Every fish swims in a level circle.
    School {
        /// Half axes, metres, in axes of the school.
        half_m: DVec3,
        world_from_school: DMat3,
        swim_m_per_s: f64,
    },
    /// A column of bubbles that rise from its foot and drift.
    Plume {
        /// Height of the column, metres.
        height_m: f64,
        /// Radius at the foot, metres, and its growth per metre of height.
        radius_m: f64,
        spread: f64,
        rise_m_per_s: f64,
        drift_m_per_s: DVec2,
    },
}

/// An individual at one instant, relative to the middle of a school or the foot of a plume.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Individual {
    pub offset_m: DVec3,
    pub velocity_m_per_s: DVec3,
    pub acceleration_m_per_s2: DVec3,
    pub strength: Complex64,
}

impl Swarm {
    /// `target`: number of the target, which separates its numbers from those of others.
    pub(crate) fn new(
        shape: SwarmShape,
        count: usize,
        strength: f64,
        seed: u64,
        target: usize,
    ) -> Self {
        Self {
            shape,
            count,
            strength,
            key: [seed as u32, (seed >> 32) as u32],
            target: target as u32,
        }
    }

    /// Centre, relative to the place of the target, and radius of a sphere that holds all individuals at all times.
    pub(crate) fn ball_m(&self) -> (DVec3, f64) {
        match self.shape {
            SwarmShape::School {
                half_m,
                swim_m_per_s,
                ..
            } => {
                let circle_m = swim_m_per_s * TURN_S.0 * TURN_S.1 / TAU;
                (DVec3::ZERO, half_m.max_element() + circle_m)
            }
            SwarmShape::Plume {
                height_m,
                radius_m,
                spread,
                rise_m_per_s,
                drift_m_per_s,
            } => {
                let top_m = (drift_m_per_s * (height_m / rise_m_per_s)).extend(-height_m);
                let wide_m = radius_m + spread * height_m;
                (0.5 * top_m, 0.5 * top_m.length() + wide_m)
            }
        }
    }

    /// Whether its individuals move relative to the place of the target.
    pub(crate) fn is_moving(&self) -> bool {
        match self.shape {
            SwarmShape::School { swim_m_per_s, .. } => swim_m_per_s > 0.0,
            SwarmShape::Plume { .. } => true,
        }
    }

    /// Four random numbers of an individual: `pass` counts its lives, or tells uses apart.
    fn draw(&self, index: usize, pass: u32) -> [f64; 4] {
        philox([index as u32, pass, self.target, SWARM], self.key).map(fraction)
    }

    /// Individual `index` at a time since the first fix, seconds.
    pub(crate) fn individual(&self, index: usize, time_s: f64) -> Individual {
        let (offset_m, velocity_m_per_s, acceleration_m_per_s2, phase) = match self.shape {
            SwarmShape::School {
                half_m,
                world_from_school,
                swim_m_per_s,
            } => {
                let [radius, height, turn, phase] = self.draw(index, 0);
                let (sin, cos) = libm::sincos(TAU * turn);
                let down = 2.0 * height - 1.0;
                let level = (1.0 - down * down).sqrt();
                let unit = DVec3::new(level * cos, level * sin, down) * libm::cbrt(radius);
                let base_m = world_from_school * (unit * half_m);
                let [period, start, way, _] = self.draw(index, 1);
                let period_s = TURN_S.0 * (1.0 + (TURN_S.1 - 1.0) * period);
                let sense = if way < 0.5 { 1.0 } else { -1.0 };
                let turns = start + sense * time_s / period_s;
                let (sin, cos) = libm::sincos(TAU * (turns - turns.floor()));
                let circle_m = swim_m_per_s * period_s / TAU;
                let outward = DVec3::new(cos, sin, 0.0);
                (
                    base_m + circle_m * outward,
                    sense * swim_m_per_s * DVec3::new(-sin, cos, 0.0),
                    outward * (-swim_m_per_s * TAU / period_s),
                    phase,
                )
            }
            SwarmShape::Plume {
                height_m,
                radius_m,
                spread,
                rise_m_per_s,
                drift_m_per_s,
            } => {
                // Bubbles leave the foot one after the other, each once per lifetime.
                let [late, ..] = self.draw(index, u32::MAX);
                let lives =
                    time_s * rise_m_per_s / height_m + (index as f64 + late) / self.count as f64;
                let life = lives.floor();
                let up_m = (lives - life) * height_m;
                let [radius, turn, phase, _] = self.draw(index, life as i64 as u32);
                let (sin, cos) = libm::sincos(TAU * turn);
                let beside = DVec2::new(cos, sin) * radius.sqrt();
                let age_s = up_m / rise_m_per_s;
                let level_m = beside * (radius_m + spread * up_m) + drift_m_per_s * age_s;
                let level = beside * (spread * rise_m_per_s) + drift_m_per_s;
                (
                    level_m.extend(-up_m),
                    level.extend(-rise_m_per_s),
                    DVec3::ZERO,
                    phase,
                )
            }
        };
        let (sin, cos) = libm::sincos(TAU * phase);
        Individual {
            offset_m,
            velocity_m_per_s,
            acceleration_m_per_s2,
            strength: self.strength * Complex64::new(cos, sin),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn school(swim_m_per_s: f64) -> Swarm {
        let shape = SwarmShape::School {
            half_m: DVec3::new(4.0, 2.0, 1.0),
            world_from_school: DMat3::from_rotation_z(0.5),
            swim_m_per_s,
        };
        Swarm::new(shape, 20_000, 1e-2, 3, 1)
    }

    fn plume() -> Swarm {
        let shape = SwarmShape::Plume {
            height_m: 20.0,
            radius_m: 0.5,
            spread: 0.1,
            rise_m_per_s: 0.25,
            drift_m_per_s: DVec2::new(0.1, 0.0),
        };
        Swarm::new(shape, 5000, 1e-3, 3, 2)
    }

    /// Mean of the squared coordinates of an evenly filled ellipsoid: half axis squared over 5.
    #[test]
    fn a_school_fills_its_ellipsoid_evenly() {
        let school = school(0.0);
        let mut squares = DVec3::ZERO;
        for k in 0..school.count {
            let one = school.individual(k, 7.0);
            let own = DMat3::from_rotation_z(-0.5) * one.offset_m;
            assert!((own / DVec3::new(4.0, 2.0, 1.0)).length() <= 1.0);
            assert_eq!(one.velocity_m_per_s, DVec3::ZERO);
            assert!((one.strength.norm() - 1e-2).abs() < 1e-12);
            squares += own * own;
        }
        let got = squares / school.count as f64;
        let want = DVec3::new(16.0, 4.0, 1.0) / 5.0;
        assert!(((got - want) / want).abs().max_element() < 0.03, "{got}");
    }

    /// Velocities are the derivatives of the places, and no individual leaves the ball.
    #[test]
    fn individuals_move_at_their_velocities() {
        for swarm in [school(0.6), plume()] {
            let (middle_m, radius_m) = swarm.ball_m();
            for k in (0..swarm.count).step_by(37) {
                for time_s in [0.0, 11.3, 1e5, -4.0] {
                    const STEP_S: f64 = 1e-3;
                    let [a, b] = [-1.0, 1.0].map(|s| swarm.individual(k, time_s + s * STEP_S));
                    let middle = swarm.individual(k, time_s);
                    let moved = (b.offset_m - a.offset_m) / (2.0 * STEP_S);
                    // A bubble that leaves the top appears at the foot.
                    if moved.length() < 10.0 {
                        let off = (moved - middle.velocity_m_per_s).length();
                        assert!(off < 1e-4, "{k} {time_s}: {off}");
                        let turned = (b.velocity_m_per_s - a.velocity_m_per_s) / (2.0 * STEP_S);
                        let off = (turned - middle.acceleration_m_per_s2).length();
                        assert!(off < 1e-4, "{k} {time_s}: {off}");
                    }
                    assert!(middle.offset_m.distance(middle_m) <= radius_m * (1.0 + 1e-9));
                }
            }
        }
    }

    /// Heights of a plume are even, and its width grows.
    #[test]
    fn a_plume_is_a_column_that_widens() {
        let plume = plume();
        let (mut low, mut wide) = (0, [0.0_f64; 2]);
        for k in 0..plume.count {
            let one = plume.individual(k, 33.0);
            let up_m = -one.offset_m.z;
            assert!((0.0..=20.0).contains(&up_m));
            low += usize::from(up_m < 10.0);
            let middle_m = DVec2::new(0.1 * up_m / 0.25, 0.0);
            let beside_m = one.offset_m.truncate().distance(middle_m);
            assert!(beside_m <= 0.5 + 0.1 * up_m + 1e-9);
            let half = usize::from(up_m > 10.0);
            wide[half] = wide[half].max(beside_m);
        }
        assert!(
            (low as f64 / plume.count as f64 - 0.5).abs() < 0.03,
            "{low}"
        );
        assert!(wide[0] < 1.51 && wide[1] > 2.3, "{wide:?}");
    }
}
