//! What `ModelChoice::cull_db` leaves out of the reverberation: a share of the incoherent energy, angle by angle.
//!
//! In: a transmit array, a receive array, the floor. Out: the share of the two-way energy of a flat, evenly scattering ring at one angle of
//! incidence that lies in directions where the two-way pattern is below the floor. In a window of reverberation from that angle the relative
//! error of the samples is the root of it. For what is stronger than the ground the floor lies lower (`Scatterers::loud`), so that it is not in this figure.

use glam::DVec3;

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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flow::{Mounting, Pattern};

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
