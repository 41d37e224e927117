//! Where what is no way to sum breaks: places at the ends of latitude and longitude, surfaces without curvature. `tools/atlas` draws the map of
//! all failures.

use std::f64::consts::TAU;

use echotank::flow::{ScatterLaw, Scatterers};
use echotank::geodesy::LocalTangentPlane;
use echotank::scene::simplify::energy::{Energies, View};
use echotank::scene::simplify::{Method, Selection, Settings, Weights};
use glam::DVec3;
use num_complex::Complex64;

#[test]
fn places_come_back_over_poles_and_antimeridian() {
    for latitude_deg in [0.0, 60.0, 89.9999, 90.0, -90.0] {
        for longitude_deg in [0.0f64, 179.99999, -180.0] {
            let plane =
                LocalTangentPlane::new(f64::to_radians(latitude_deg), longitude_deg.to_radians());
            for k in 0..8 {
                let (sin, cos) = (TAU * f64::from(k) / 8.0).sin_cos();
                let (want_n, want_e) = (1000.0 * cos, 1000.0 * sin);
                let (latitude, longitude) = plane.geodetic_rad(want_n, want_e);
                let (got_n, got_e) = plane.local_m(latitude, longitude);
                let off_m = (got_n - want_n).hypot(got_e - want_e);
                assert!(off_m < 1e-6, "{latitude_deg} {longitude_deg}: {off_m} m");
            }
        }
    }
}

#[test]
fn simplification_has_a_number_for_every_surface() {
    let ground = |count: u32, down_m: fn(f64, f64) -> f64| {
        let mut scatterers = Scatterers::default();
        for k in 0..count {
            let (n, e) = (0.5 * f64::from(k % 11), 0.5 * f64::from(k / 11));
            let strength = Complex64::from_polar(1.0, f64::from(k));
            let at_m = DVec3::new(n, 20.0 + e, down_m(n, e));
            scatterers.push(at_m, [0.0, 0.0, -1.0], strength, ScatterLaw::Lambert);
        }
        scatterers
    };
    let view = View {
        apex_m: DVec3::ZERO,
        shadows: true,
        ..View::default()
    };
    for scatterers in [
        ground(121, |_, _| 10.0),
        ground(121, |n, e| 10.0 + 0.2 * n - 0.1 * e),
        ground(121, |n, _| 10.0 + 0.3 * (n - 2.5).abs()),
        ground(1, |_, _| 10.0),
        ground(3, |_, _| 10.0),
        ground(0, |_, _| 10.0),
    ] {
        let count = scatterers.len();
        for method in [Method::Acoustic, Method::Unbiased, Method::Paper] {
            let settings = Settings {
                method,
                keep: count.div_ceil(2),
                weights: Weights::default_of(method),
                seed: 3,
            };
            let mut energies = Energies::default();
            energies.evaluate(&scatterers, count, &view, &settings, None);
            let numbers = energies.energy.iter().all(|e| e.is_finite());
            assert!(numbers || method == Method::Paper, "{method:?} of {count}");
            let mut selection = Selection::default();
            let rule = selection.rule(&energies, count, &settings);
            selection.apply(rule, &scatterers, &energies, count, 3);
            assert!(selection.gain.iter().all(|g| g.is_finite() && *g > 0.0));
            assert!(method == Method::Unbiased || selection.kept.len() == count.div_ceil(2));
        }
    }
}
