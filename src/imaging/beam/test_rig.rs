//! Arrays, plans and plane waves for the tests of beamforming.

use std::f64::consts::TAU;

use glam::DVec3;
use num_complex::Complex64;

use echotank_core::arrays::{ArrayGeometry, Mounting, Pattern};
use echotank_core::frames::rotation_from_angles;
use echotank_core::ping::ElementFrame;
use echotank_core::pulse::Pulse;

/// A line array at the body's origin, pointing down, rotated by `yaw_deg` (0: fore and aft, 90: x to starboard).
pub(crate) fn array(elements: usize, spacing_m: f64, yaw_deg: f64) -> ArrayGeometry {
    ArrayGeometry {
        mounting: Mounting {
            position_m: DVec3::ZERO,
            body_from_array: rotation_from_angles(0.0, 0.0, yaw_deg.to_radians()),
        },
        elements,
        spacing_m,
        element_pattern: Pattern::Omnidirectional,
        sensitivity_db: 0.0,
        transmit: 0,
    }
}

/// Every element receives the pulse of `echo` with its leading edge's delay: exp(-j 2pi f_c u) a(t - u).
pub(crate) fn elements_of_plane_wave(
    array: &ArrayGeometry,
    rate_hz: f64,
    samples: usize,
    echo: impl Fn(usize) -> (Pulse, f64),
) -> ElementFrame {
    let mut iq = Vec::new();
    for e in 0..array.elements {
        let (pulse, delay_s) = echo(e);
        let carrier = Complex64::from_polar(1.0, -TAU * pulse.center_frequency_hz * delay_s);
        iq.extend((0..samples).map(|k| carrier * pulse.envelope(k as f64 / rate_hz - delay_s)));
    }
    ElementFrame {
        array: 0,
        elements: array.elements,
        samples,
        iq,
        saturated: 0,
    }
}

/// An endless tone from `sine` towards the array's +x.
pub(crate) fn tone(
    array: &ArrayGeometry,
    samples: usize,
    frequency_hz: f64,
    sine: f64,
    sound_speed_m_per_s: f64,
) -> ElementFrame {
    let iq = (0..array.elements)
        .flat_map(|e| {
            let early_s = array.element_x_m(e) * sine / sound_speed_m_per_s;
            std::iter::repeat_n(
                Complex64::from_polar(1.0, TAU * frequency_hz * early_s),
                samples,
            )
        })
        .collect();
    ElementFrame {
        array: 0,
        elements: array.elements,
        samples,
        iq,
        saturated: 0,
    }
}
