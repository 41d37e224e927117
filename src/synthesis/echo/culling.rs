//! What `ModelChoice::cull_db` leaves out of the reverberation: a share of the incoherent energy, angle by angle.
//!
//! In: a transmit array, a receive array, the floor. Out: the share of the two-way energy of a flat, evenly scattering ring at one angle of
//! incidence that lies in directions where the two-way pattern is below the floor. In a window of reverberation from that angle the relative
//! error of the samples is the root of it. For what is stronger than the ground the floor lies lower (`Scatterers::loud`), so that it is not in this figure.

use glam::{DQuat, DVec3};

use echotank_core::flow::{ArrayGeometry, TransmitArray};

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
    let transmit_leg = Directivity::new(&transmit.pattern, wavelength_m);
    let element = Directivity::new(&array.element_pattern, wavelength_m);
    let floor = amplitude_from_db(cull_db);
    let (sin, cos) = libm::sincos(incidence_rad);
    let (mut all, mut left_out) = (0.0, 0.0);
    for k in 0..AZIMUTHS {
        let (east, north) = libm::sincos(std::f64::consts::TAU * k as f64 / AZIMUTHS as f64);
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

/// Windows after the first return that are looked at one by one, each put together of so many rings: there the incidence changes fastest.
const NEAR_WINDOWS: usize = 16;
const PARTS: usize = 4;
/// Rings from there to the end of the ping, evenly in time, each for the windows about it.
const FAR_RINGS: usize = 24;
/// Directions on each of them.
const RING_AZIMUTHS: usize = 3600;
/// Levels are counted in steps of this, dB, down to the least: what lies in the step that a floor cuts counts as left out.
const LEVEL_STEP_DB: f64 = 0.5;
const LEVELS: usize = 480;

/// What floors leave out of one ping's windows over flat ground.
pub struct Rings {
    /// A metre of range at the range of a window.
    windows: Vec<Ring>,
    mean: f64,
    window_m: f64,
    /// Ground by level, m^2.
    areas_m2: Box<[f64; LEVELS]>,
}

/// Ground per metre of range, by level below that of the axis.
#[derive(Clone)]
struct Ring {
    /// Energy, and the integral of its square over the ground: how few scatterers it comes from.
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

/// Where a ping's ground lies.
#[derive(Clone, Copy, Debug)]
pub struct Ground<Law> {
    /// The platform's attitude; its heading is of no consequence.
    pub world_from_body: DQuat,
    pub height_m: f64,
    pub farthest_m: f64,
    pub absorption_db_per_m: f64,
    /// Backscattered power over the cosine of incidence.
    pub law: Law,
    /// In metres of range: half the way that sound goes in it.
    pub window_m: f64,
}

/// A window of reverberation, as mean energies over that of the ping's mean window, silent ones included.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LeftOut {
    pub all: f64,
    pub left_out: f64,
    /// Scatterers of a square metre that these energies come from, were there one on each: energy squared over the sum of squares, whose strengths'
    /// own fluctuation is not in it.
    pub from_all: f64,
    pub from_left_out: f64,
}

impl Rings {
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
        let azimuths: Vec<(f64, f64)> = (0..RING_AZIMUTHS)
            .map(|k| libm::sincos(std::f64::consts::TAU * k as f64 / RING_AZIMUTHS as f64))
            .collect();
        let mut ring = |from_m: f64, to_m: f64| {
            let range_m = 0.5 * (from_m + to_m);
            let cos = height_m / range_m;
            let sin = (1.0 - cos * cos).sqrt();
            let area_m2_per_m = range_m * std::f64::consts::TAU / RING_AZIMUTHS as f64;
            let strength = (ground.law)(cos) / range_m.powi(4)
                * libm::exp10(-0.2 * ground.absorption_db_per_m * range_m);
            let mut ring = Ring::silent();
            for (east, north) in &azimuths {
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

    /// Ground in directions above the floor, m^2.
    pub fn above_m2(&self, cull_db: f64) -> f64 {
        self.areas_m2[..Self::first_below(cull_db)].iter().sum()
    }

    /// Of each window; none where nothing is heard at all.
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
    use echotank_core::flow::{Mounting, Pattern};

    /// Of the whole ground all is left out above the axis and nothing far below it; between, each window's share is that of its own ring.
    #[test]
    fn windows_leave_out_the_shares_of_their_rings_and_all_of_it_above_the_axis() {
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
            // Mean over the record of what has its own length is 1.
            let sum: f64 = near.iter().map(|w| w.all * WINDOW_M / PARTS as f64).sum();
            let sum = sum + far.iter().map(|w| w.all).sum::<f64>() * far_m / FAR_RINGS as f64;
            assert!((sum / 60.5 - 1.0).abs() < 0.03, "{sum}");
            for (k, window) in far.iter().enumerate() {
                let range_m = 60.0 - far_m * (1.0 - (k as f64 + 0.5) / FAR_RINGS as f64);
                let incidence_rad = libm::acos(10.0 / range_m);
                let share = |db| left_out_share(&transmit, &array, 0.005, db, incidence_rad);
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
