//! Default of the culling level.
//!
//! A ring is the seabed at one angle of incidence. Directions below a floor of the two-way pattern return a known fraction of the
//! ring's energy. The square root of the fraction is the relative error of the samples of that window. The default is the highest
//! floor with an error of at most [`SHARE_OF_TOLERANCE`] of the tolerance. It holds at all [`INCIDENCES_DEG`] and for all arrays,
//! on a level platform over a flat, uniform seabed.

use glam::DVec3;

use super::super::spec::SonarSpec;
use echotank_core::arrays::{ArrayGeometry, Pattern, TransmitArray};

/// Fraction of the tolerance for culling. Engines and models may use the rest.
const SHARE_OF_TOLERANCE: f64 = 0.5;
/// Angles of incidence, degrees: from near the first bottom return to near grazing.
const INCIDENCES_DEG: [f64; 4] = [20.0, 45.0, 70.0, 85.0];
/// Number of directions on a ring.
const AZIMUTHS: usize = 7200;
/// Minimum floor, dB. A lower floor culls almost nothing.
const MIN_DB: f64 = -120.0;

/// The default of [`ModelChoice::cull_db`](echotank_core::model::ModelChoice). `None` if culling has no effect.
pub(super) fn floor_db(sonar: &SonarSpec, sound_speed_m_per_s: f64) -> Option<f64> {
    let wavelength_m = sound_speed_m_per_s / sonar.pulse.center_frequency_hz;
    let share = (SHARE_OF_TOLERANCE * sonar.synthesis.tolerance).powi(2);
    let floors = sonar.receive.iter().flat_map(|array| {
        let transmit = &sonar.transmit[array.transmit];
        INCIDENCES_DEG.map(|deg| floor(transmit, array, wavelength_m, deg.to_radians(), share))
    });
    let least = floors.fold(f64::INFINITY, f64::min);
    // The floor is rounded down to a tenth, so the number in the records is exact.
    let db = (200.0 * libm::log10(least)).floor() / 10.0;
    (MIN_DB..0.0).contains(&db).then_some(db)
}

/// The highest level for which directions below it return at most the fraction `share` of a ring's energy.
fn floor(
    transmit: &TransmitArray,
    array: &ArrayGeometry,
    wavelength_m: f64,
    incidence_rad: f64,
    share: f64,
) -> f64 {
    let (sin, cos) = libm::sincos(incidence_rad);
    let element_pattern = array.envelope_pattern();
    let mut levels: Vec<f64> = (0..AZIMUTHS)
        .map(|k| {
            let (east, north) = libm::sincos(std::f64::consts::TAU * k as f64 / AZIMUTHS as f64);
            let ray = DVec3::new(sin * north, sin * east, cos);
            let out = transmit.mounting.body_from_array.inverse() * ray;
            let back = array.mounting.body_from_array.inverse() * ray;
            let out = response(&transmit.pattern, wavelength_m, out);
            (out * response(&element_pattern, wavelength_m, back)).abs()
        })
        .collect();
    levels.sort_unstable_by(f64::total_cmp);
    let all: f64 = levels.iter().map(|l| l * l).sum();
    let mut below = 0.0;
    let first_kept = levels.iter().find(|l| {
        below += **l * **l;
        below > share * all
    });
    // Without energy in any direction, there is nothing to cull.
    first_kept.copied().unwrap_or(1.0)
}

/// Response of [`Pattern`] towards a unit vector in array axes. The ping path uses `echo::levels::Directivity`;
/// `src/ping/tests/it/culling.rs` tests the default against it.
pub(crate) fn response(pattern: &Pattern, wavelength_m: f64, u: DVec3) -> f64 {
    let sinc = |x: f64| match x == 0.0 {
        true => 1.0,
        false => libm::sin(std::f64::consts::PI * x) / (std::f64::consts::PI * x),
    };
    match *pattern {
        Pattern::Omnidirectional => 1.0,
        Pattern::Rectangle { baffled, .. } | Pattern::Part { baffled, .. }
            if baffled && u.z < 0.0 =>
        {
            0.0
        }
        Pattern::Rectangle {
            length_m, width_m, ..
        }
        | Pattern::Part {
            length_m, width_m, ..
        } => sinc(length_m / wavelength_m * u.x) * sinc(width_m / wavelength_m * u.y),
    }
}
