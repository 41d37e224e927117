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

use glam::DVec3;

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
    let element = Directivity::new(&array.envelope_pattern(), wavelength_m);
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

#[cfg(test)]
mod tests {
    use super::*;
    use echotank_core::arrays::{Mounting, Pattern};
    use glam::DQuat;

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
            radius_m: None,
            element_pattern: Pattern::Omnidirectional,
            sensitivity_db: 0.0,
            transmit: 0,
        };
        (transmit, array)
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
