//! What `ModelChoice::cull_db` leaves out of the reverberation: a share of the incoherent energy, angle by angle.
//!
//! In: a transmit array, a receive array, the floor. Out: the share of the two-way energy of a flat, evenly scattering ring at one angle of
//! incidence that lies in directions where the two-way pattern is below the floor. In a window of reverberation from that angle the relative
//! error of the samples is the root of it. For what is stronger than the ground the floor lies lower (`Scatterers::loud`), so that it is not in this figure.

use glam::{DQuat, DVec3};

use crate::flow::{ArrayGeometry, TransmitArray};

use super::levels::{Directivity, amplitude_from_db};

/// Directions on a ring. A pattern's lobes are a few hundredths of a radian wide for the longest arrays of the trade.
const AZIMUTHS: usize = 7200;

/// Share of the energy, 0 to 1, on a level platform; 0 where nothing is heard at all. `incidence_rad`: from straight down.
pub fn left_out_share(
    transmit: &TransmitArray,
    array: &ArrayGeometry,
    wavelength_m: f64,
    cull_db: f64,
    incidence_rad: f64,
) -> f64 {
    let lit = Directivity::new(&transmit.pattern, wavelength_m);
    let element = Directivity::new(&array.element_pattern, wavelength_m);
    let floor = amplitude_from_db(cull_db);
    let (sin, cos) = libm::sincos(incidence_rad);
    let (mut all, mut left_out) = (0.0, 0.0);
    for k in 0..AZIMUTHS {
        let (east, north) = libm::sincos(std::f64::consts::TAU * k as f64 / AZIMUTHS as f64);
        let ray = DVec3::new(sin * north, sin * east, cos);
        let level = [
            (&lit, transmit.mounting.body_from_array),
            (&element, array.mounting.body_from_array),
        ]
        .map(|(pattern, body_from_array)| {
            let u = body_from_array.inverse() * ray;
            pattern.towards(u.x, u.y, u.z).abs()
        });
        let two_way = level[0] * level[1];
        all += two_way * two_way;
        if two_way < floor {
            left_out += two_way * two_way;
        }
    }
    if all > 0.0 { left_out / all } else { 0.0 }
}

/// Rings of a flat Lambert bottom, evenly in time from the first return to the end of the window.
const RINGS: usize = 24;
/// Directions on each of them.
const RING_AZIMUTHS: usize = 3600;
/// Levels are counted in steps of this, dB, down to the least: what lies in the step that a floor cuts counts as left out.
const LEVEL_STEP_DB: f64 = 0.5;
const LEVELS: usize = 480;

/// What floors leave out of one ping's windows over flat ground, each against its own level or the ping's mean, whichever is louder: as errors of samples
/// are counted.
pub struct Rings {
    /// Energy of each ring by level below that of the axis.
    below: Vec<[f64; LEVELS]>,
    mean: f64,
}

/// Where a ping's ground lies.
#[derive(Clone, Copy, Debug)]
pub struct Ground {
    /// The platform's attitude; its heading is of no consequence.
    pub world_from_body: DQuat,
    pub height_m: f64,
    pub farthest_m: f64,
    pub absorption_db_per_m: f64,
}

impl Rings {
    pub fn new(
        transmit: &TransmitArray,
        array: &ArrayGeometry,
        wavelength_m: f64,
        ground: &Ground,
    ) -> Self {
        let lit = Directivity::new(&transmit.pattern, wavelength_m);
        let element = Directivity::new(&array.element_pattern, wavelength_m);
        let faces = [
            (&lit, transmit.mounting.body_from_array),
            (&element, array.mounting.body_from_array),
        ]
        .map(|(pattern, body)| (pattern, (ground.world_from_body * body).inverse()));
        let height_m = ground.height_m.max(wavelength_m);
        let farthest_m = ground.farthest_m.max(1.01 * height_m);
        let mut below = Vec::with_capacity(RINGS);
        for k in 0..RINGS {
            let range_m = height_m + (farthest_m - height_m) * (k as f64 + 0.5) / RINGS as f64;
            let cos = height_m / range_m;
            let sin = (1.0 - cos * cos).sqrt();
            // Area of a ring of even duration, Lambert's law, and both ways.
            let weight = range_m
                * (cos / (range_m * range_m)).powi(2)
                * libm::exp10(-0.2 * ground.absorption_db_per_m * range_m);
            let mut levels = [0.0; LEVELS];
            for azimuth in 0..RING_AZIMUTHS {
                let turn = std::f64::consts::TAU * azimuth as f64 / RING_AZIMUTHS as f64;
                let (east, north) = libm::sincos(turn);
                let ray = DVec3::new(sin * north, sin * east, cos);
                let [out, back] = faces.map(|(pattern, array_from_world)| {
                    let u = array_from_world * ray;
                    pattern.towards(u.x, u.y, u.z)
                });
                let two_way = (out * back).powi(2);
                if two_way > 0.0 {
                    let step = -10.0 * libm::log10(two_way) / LEVEL_STEP_DB;
                    levels[(step.max(0.0) as usize).min(LEVELS - 1)] += weight * two_way;
                }
            }
            below.push(levels);
        }
        let mean = below.iter().flatten().sum::<f64>() / RINGS as f64;
        Self { below, mean }
    }

    /// Relative error of the worst window's samples.
    pub fn left_out(&self, cull_db: f64) -> f64 {
        if self.mean == 0.0 {
            return 0.0;
        }
        let first = ((-cull_db / LEVEL_STEP_DB).max(0.0) as usize).min(LEVELS);
        let worst = self.below.iter().map(|levels| {
            let all: f64 = levels.iter().sum();
            levels[first..].iter().sum::<f64>() / all.max(self.mean)
        });
        worst.fold(0.0, f64::max).sqrt()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flow::{Mounting, Pattern};

    /// A ring may be silent where the ping is loud, and one that is all below the floor may be too weak to matter: never more than its own share.
    #[test]
    fn rings_leave_out_no_more_than_their_own_shares_and_all_of_it_above_the_axis() {
        let mounting = Mounting {
            position_m: DVec3::ZERO,
            body_from_array: DQuat::from_rotation_x(f64::to_radians(-45.0)),
        };
        let transmit = TransmitArray {
            mounting,
            pattern: Pattern::Rectangle {
                length_m: 0.1,
                width_m: 0.01,
                baffled: false,
            },
            level_offset_db: 0.0,
        };
        let array = ArrayGeometry {
            mounting,
            elements: 1,
            spacing_m: 0.0,
            element_pattern: Pattern::Omnidirectional,
            sensitivity_db: 0.0,
            transmit: 0,
        };
        let ground = Ground {
            world_from_body: DQuat::IDENTITY,
            height_m: 10.0,
            farthest_m: 60.0,
            absorption_db_per_m: 0.05,
        };
        let rings = Rings::new(&transmit, &array, 0.005, &ground);
        assert!((rings.left_out(1.0) - 1.0).abs() < 1e-12);
        assert_eq!(rings.left_out(-300.0), 0.0);
        for db in [-50.0, -40.0, -30.0, -20.0] {
            let of_each = (0..RINGS).map(|k| {
                let range_m = 10.0 + 50.0 * (k as f64 + 0.5) / RINGS as f64;
                let incidence_rad = libm::acos(10.0 / range_m);
                left_out_share(&transmit, &array, 0.005, db + LEVEL_STEP_DB, incidence_rad).sqrt()
            });
            let (got, own) = (rings.left_out(db), of_each.fold(0.0, f64::max));
            println!("{db} dB: {got:.2e}, the worst ring by itself {own:.2e}");
            assert!(got > 0.0 && got <= own, "{db} dB: {got} {own}");
        }
    }

    #[test]
    fn the_share_of_a_line_is_that_of_its_side_lobes() {
        // An omnidirectional element and a line of 17 wavelengths, 45 degrees off the vertical: sinc^2 with everything, or below the floor.
        const WAVELENGTH_M: f64 = 0.00375;
        let mounting = Mounting {
            position_m: DVec3::ZERO,
            body_from_array: glam::DQuat::IDENTITY,
        };
        let transmit = TransmitArray {
            mounting,
            pattern: Pattern::Rectangle {
                length_m: 17.0 * WAVELENGTH_M,
                width_m: 0.0,
                baffled: false,
            },
            level_offset_db: 0.0,
        };
        let array = ArrayGeometry {
            mounting,
            elements: 1,
            spacing_m: 0.0,
            element_pattern: Pattern::Omnidirectional,
            sensitivity_db: 0.0,
            transmit: 0,
        };
        let share = |db: f64| {
            left_out_share(
                &transmit,
                &array,
                WAVELENGTH_M,
                db,
                std::f64::consts::FRAC_PI_4,
            )
        };
        // The integral of sinc^2 is 1, that of its main lobe 0.9028 (Harris 1978), and -13.2 dB is just above the first side lobe; what the
        // main lobe has below the floor comes to some 0.003.
        let got = share(-13.2);
        assert!((got - 0.0972).abs() < 0.01, "{got}");
        assert_eq!(share(-400.0), 0.0);
        assert!(share(-40.0) < share(-30.0) && share(-30.0) < share(-20.0));
    }
}
