//! Error of pattern culling (`ModelChoice::cull_db`): the fraction of the incoherent reverberation
//! energy that is culled, by angle of incidence.
//!
//! The inputs are a transmit array, a receive array and the floor. The seabed at one angle of
//! incidence is a flat, uniformly scattering ring. The result is the fraction of two-way energy
//! from directions in which the two-way pattern is below the floor. Its square root is the relative
//! error of samples in a reverberation window from that angle.
//!
//! Scatterers stronger than the seabed have a lower floor (`Scatterers::loud`). This figure does
//! not include them.

use glam::{DQuat, DVec3};

use echotank_core::arrays::{ArrayGeometry, TransmitArray};

use super::levels::{Directivity, amplitude_from_db};

/// Number of directions on a ring. The lobes of the longest commercial arrays are a few hundredths
/// of a radian wide.
const AZIMUTHS: usize = 7200;

/// Fraction of the energy that is culled on a level platform, 0 to 1. Zero for a ring that the
/// element cannot receive. `incidence_rad` is measured from straight down.
pub fn left_out_share(
    transmit: &TransmitArray,
    array: &ArrayGeometry,
    wavelength_m: f64,
    cull_db: f64,
    incidence_rad: f64,
) -> f64 {
    share_of_ring(
        transmit,
        array,
        wavelength_m,
        cull_db,
        incidence_rad,
        AZIMUTHS,
    )
}

fn share_of_ring(
    transmit: &TransmitArray,
    array: &ArrayGeometry,
    wavelength_m: f64,
    cull_db: f64,
    incidence_rad: f64,
    azimuths: usize,
) -> f64 {
    let transmit_leg = Directivity::new(&transmit.pattern, wavelength_m);
    let element = Directivity::new(&array.element_pattern, wavelength_m);
    let floor = amplitude_from_db(cull_db);
    let (sin, cos) = libm::sincos(incidence_rad);
    let (mut all, mut left_out) = (0.0, 0.0);
    for k in 0..azimuths {
        let (east, north) = libm::sincos(std::f64::consts::TAU * k as f64 / azimuths as f64);
        let ray = DVec3::new(sin * north, sin * east, cos);
        let level = [
            (&transmit_leg, transmit.mounting.body_from_array),
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

/// Number of windows after the first return that are computed individually. Each has several rings,
/// because the incidence changes fastest there.
const NEAR_WINDOWS: usize = 16;
const PARTS: usize = 4;
/// Number of rings from there to the end of the ping, evenly spaced in time. Each ring represents
/// the windows around it.
const FAR_RINGS: usize = 24;
/// Number of directions on a ring at grazing incidence. A ring nearer to the vertical has fewer, at the same spacing of directions, but at least
/// the second number.
const RING_AZIMUTHS: f64 = 4500.0;
const MIN_RING_AZIMUTHS: f64 = 360.0;
/// Step of the level histogram, dB. Energy in the step that contains the floor counts as culled.
const LEVEL_STEP_DB: f64 = 0.5;
const LEVELS: usize = 256;

/// Level histograms of the windows of one ping over a flat seabed.
pub struct Rings {
    /// Rings, each of one metre of range at the range of its window.
    windows: Vec<Ring>,
    mean: f64,
    window_m: f64,
    /// Ground area by level, m^2.
    areas_m2: Box<[f64; LEVELS]>,
}

/// Energy per metre of range, by level below that of the axis.
#[derive(Clone)]
struct Ring {
    /// Energy, and the integral of its square over the seabed. Their ratio gives the number of
    /// contributing scatterers.
    energy: Box<[f64; LEVELS]>,
    square: Box<[f64; LEVELS]>,
}

impl Ring {
    fn silent() -> Self {
        Self {
            energy: Box::new([0.0; LEVELS]),
            square: Box::new([0.0; LEVELS]),
        }
    }

    fn add(&mut self, other: &Self, share: f64) {
        for (sums, values) in [
            (&mut self.energy, &other.energy),
            (&mut self.square, &other.square),
        ] {
            for (sum, value) in sums.iter_mut().zip(values.iter()) {
                *sum += share * value;
            }
        }
    }
}

/// Geometry and scattering of a flat seabed under a ping.
#[derive(Clone, Copy, Debug)]
pub struct Ground<Law> {
    /// Attitude of the platform. The heading has no effect.
    pub world_from_body: DQuat,
    /// Height of the sonar above the ground, metres.
    pub height_m: f64,
    /// Largest slant range, metres.
    pub farthest_m: f64,
    /// One-way absorption, dB/m.
    pub absorption_db_per_m: f64,
    /// Backscattered power over the cosine of the angle of incidence.
    pub law: Law,
    /// Window length in metres of range: half the distance that sound travels during the window.
    pub window_m: f64,
}

/// Energies of one reverberation window, relative to the mean window of the ping. The mean includes
/// windows without energy.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LeftOut {
    /// Energy without culling.
    pub all: f64,
    /// Energy that is culled.
    pub left_out: f64,
    /// Effective number of scatterers that contribute the energy, at one scatterer per square
    /// metre: energy squared over the sum of squares. Fluctuation of the strengths is not included.
    pub from_all: f64,
    /// Effective number of scatterers that contribute the culled energy, as for `from_all`.
    pub from_left_out: f64,
}

impl Rings {
    /// Computes the histograms of the two-way pattern of `transmit` and `array` over `ground`.
    pub fn new(
        transmit: &TransmitArray,
        array: &ArrayGeometry,
        wavelength_m: f64,
        ground: &Ground<impl Fn(f64) -> f64>,
    ) -> Self {
        let transmit_leg = Directivity::new(&transmit.pattern, wavelength_m);
        let element = Directivity::new(&array.element_pattern, wavelength_m);
        let faces = [
            (&transmit_leg, transmit.mounting.body_from_array),
            (&element, array.mounting.body_from_array),
        ]
        .map(|(pattern, body)| (pattern, (ground.world_from_body * body).inverse()));
        let height_m = ground.height_m.max(wavelength_m);
        let farthest_m = ground.farthest_m.max(1.01 * height_m);
        let mut areas_m2 = Box::new([0.0; LEVELS]);
        let mut all = 0.0;
        let mut ring = |from_m: f64, to_m: f64| {
            let range_m = 0.5 * (from_m + to_m);
            let cos = height_m / range_m;
            let sin = (1.0 - cos * cos).sqrt();
            // The same in every quadrant.
            let azimuths = 4.0 * (0.25 * (RING_AZIMUTHS * sin).max(MIN_RING_AZIMUTHS)).ceil();
            let azimuth_rad = std::f64::consts::TAU / azimuths;
            let area_m2_per_m = range_m * azimuth_rad;
            let strength = (ground.law)(cos) / range_m.powi(4)
                * libm::exp10(-0.2 * ground.absorption_db_per_m * range_m);
            let mut ring = Ring::silent();
            let (turn_sin, turn_cos) = libm::sincos(azimuth_rad);
            let (mut east, mut north) = (0.0, 1.0);
            for _ in 0..azimuths as usize {
                (east, north) = (
                    east * turn_cos + north * turn_sin,
                    north * turn_cos - east * turn_sin,
                );
                let ray = DVec3::new(sin * north, sin * east, cos);
                let [out, back] = faces.map(|(pattern, array_from_world)| {
                    let u = array_from_world * ray;
                    pattern.towards(u.x, u.y, u.z)
                });
                let two_way = (out * back).powi(2);
                if two_way > 0.0 {
                    let step = -10.0 * libm::log10(two_way) / LEVEL_STEP_DB;
                    let step = (step.max(0.0) as usize).min(LEVELS - 1);
                    ring.energy[step] += area_m2_per_m * strength * two_way;
                    ring.square[step] += area_m2_per_m * (strength * two_way).powi(2);
                    areas_m2[step] += area_m2_per_m * (to_m - from_m);
                }
            }
            all += ring.energy.iter().sum::<f64>() * (to_m - from_m);
            ring
        };
        let mut windows = Vec::with_capacity(NEAR_WINDOWS * PARTS + FAR_RINGS);
        let part_m = ground.window_m / PARTS as f64;
        let near = ((farthest_m - height_m) / part_m) as usize;
        let near: Vec<Ring> = (0..near.min(NEAR_WINDOWS * PARTS))
            .map(|k| {
                let from_m = height_m + k as f64 * part_m;
                ring(from_m, from_m + part_m)
            })
            .collect();
        for end in 1..=near.len() {
            let mut window = Ring::silent();
            for part in &near[end.saturating_sub(PARTS)..end] {
                window.add(part, 1.0 / PARTS as f64);
            }
            windows.push(window);
        }
        let from_m = height_m + near.len() as f64 * part_m;
        let step_m = (farthest_m - from_m) / FAR_RINGS as f64;
        if step_m > 0.0 {
            let far = (0..FAR_RINGS).map(|k| from_m + k as f64 * step_m);
            windows.extend(far.map(|from_m| ring(from_m, from_m + step_m)));
        }
        Self {
            windows,
            mean: all / (farthest_m + ground.window_m),
            window_m: ground.window_m,
            areas_m2,
        }
    }

    fn first_below(cull_db: f64) -> usize {
        ((-cull_db / LEVEL_STEP_DB).max(0.0) as usize).min(LEVELS)
    }

    /// Ground area in directions above the floor, m^2.
    pub fn above_m2(&self, cull_db: f64) -> f64 {
        self.areas_m2[..Self::first_below(cull_db)].iter().sum()
    }

    /// Energies of every window; none if no window has energy.
    pub fn left_out(&self, cull_db: f64) -> impl Iterator<Item = LeftOut> {
        let first = Self::first_below(cull_db);
        let of = move |values: &[f64; LEVELS]| {
            let below: f64 = values[first..].iter().sum();
            (values[..first].iter().sum::<f64>() + below, below)
        };
        let from = move |energy: f64, square: f64, window_m: f64| match square > 0.0 {
            true => window_m * energy * energy / square,
            false => 0.0,
        };
        self.windows
            .iter()
            .filter(|_| self.mean > 0.0)
            .map(move |ring| {
                let ((all, left_out), (squares, left_out_squares)) =
                    (of(&ring.energy), of(&ring.square));
                LeftOut {
                    all: all / self.mean,
                    left_out: left_out / self.mean,
                    from_all: from(all, squares, self.window_m),
                    from_left_out: from(left_out, left_out_squares, self.window_m),
                }
            })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use echotank_core::arrays::{Mounting, Pattern};

    /// A rectangular transmitter, and an omnidirectional element at its position.
    fn line_and_element(
        body_from_array: DQuat,
        length_m: f64,
        width_m: f64,
    ) -> (TransmitArray, ArrayGeometry) {
        let mounting = Mounting {
            position_m: DVec3::ZERO,
            body_from_array,
        };
        let transmit = TransmitArray {
            mounting,
            pattern: Pattern::Rectangle {
                length_m,
                width_m,
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
        (transmit, array)
    }

    /// A floor above the axis culls everything, and a very low floor culls nothing. For a floor
    /// between, the fraction of each window is that of its ring.
    #[test]
    fn windows_drop_the_shares_of_their_rings_and_everything_above_the_axis() {
        let turn = DQuat::from_rotation_x(f64::to_radians(-45.0));
        let (transmit, array) = line_and_element(turn, 0.1, 0.01);
        const WINDOW_M: f64 = 0.5;
        let ground = Ground {
            world_from_body: DQuat::IDENTITY,
            height_m: 10.0,
            farthest_m: 60.0,
            absorption_db_per_m: 0.05,
            law: |cos: f64| cos * cos,
            window_m: WINDOW_M,
        };
        let rings = Rings::new(&transmit, &array, 0.005, &ground);
        assert!(rings.left_out(1.0).all(|w| w.left_out == w.all));
        assert!(rings.left_out(-300.0).all(|w| w.left_out == 0.0));
        let disc_m2 = std::f64::consts::PI * (60.0 * 60.0 - 10.0 * 10.0);
        let above_m2 = rings.above_m2(-300.0);
        assert!(
            (above_m2 / disc_m2 - 1.0).abs() < 1e-3,
            "{above_m2} {disc_m2}"
        );
        let far_m = 50.0 - NEAR_WINDOWS as f64 * WINDOW_M;
        for db in [-50.0, -40.0, -30.0, -20.0] {
            let windows: Vec<LeftOut> = rings.left_out(db).collect();
            let (near, far) = windows.split_at(NEAR_WINDOWS * PARTS);
            // The mean over the record of windows with their own length is 1.
            let sum: f64 = near.iter().map(|w| w.all * WINDOW_M / PARTS as f64).sum();
            let sum = sum + far.iter().map(|w| w.all).sum::<f64>() * far_m / FAR_RINGS as f64;
            assert!((sum / 60.5 - 1.0).abs() < 0.03, "{sum}");
            for (k, window) in far.iter().enumerate() {
                let range_m = 60.0 - far_m * (1.0 - (k as f64 + 0.5) / FAR_RINGS as f64);
                let incidence_rad = libm::acos(10.0 / range_m);
                // So many directions that the edges of lobes at the floor are resolved.
                let share =
                    |db| share_of_ring(&transmit, &array, 0.005, db, incidence_rad, 40 * AZIMUTHS);
                let (got, low, high) = (
                    window.left_out / window.all,
                    share(db),
                    share(db + LEVEL_STEP_DB),
                );
                let around = 0.97 * low..=1.03 * high;
                assert!(
                    around.contains(&got),
                    "{db} dB, {range_m} m: {got} {low} {high}"
                );
            }
        }
    }

    #[test]
    fn the_dropped_share_of_a_line_is_that_of_its_side_lobes() {
        // An omnidirectional element and a line of 17 wavelengths, 45 degrees off the vertical. The
        // line has sinc^2 in all directions, or only below the floor.
        const WAVELENGTH_M: f64 = 0.00375;
        let (transmit, array) = line_and_element(DQuat::IDENTITY, 17.0 * WAVELENGTH_M, 0.0);
        let off_rad = std::f64::consts::FRAC_PI_4;
        let share = |db| left_out_share(&transmit, &array, WAVELENGTH_M, db, off_rad);
        // The integral of sinc^2 is 1 and that of its main lobe 0.9028 (Harris 1978). -13.2 dB is
        // just above the first side lobe. The part of the main lobe below the floor contributes
        // about 0.003.
        let got = share(-13.2);
        assert!((got - 0.0972).abs() < 0.01, "{got}");
        assert_eq!(share(-400.0), 0.0);
        assert!(share(-40.0) < share(-30.0) && share(-30.0) < share(-20.0));
    }
}
