//! Tests that compare predicted errors with measured errors.

use glam::DVec3;
use num_complex::Complex64;

use echotank_core::arrays::ReceiverFilter;
use echotank_core::model::{DopplerModel, PathModel, Synthesis};
use echotank_core::ping::PingPlan;
use echotank_synthesis::array::error_models::synthesis_error_model;
use echotank_synthesis::array::{Direct, FilterDesign, oversample};
use echotank_synthesis::echo::error_models::{
    doppler_error_model, doppler_within, path_error_model,
};
use echotank_synthesis::echo::{Window, reference};
use echotank_synthesis::error_model::Conditions;

use crate::paths::restless;
use echotank_testing::echo::*;

pub(crate) fn conditions(plan: &PingPlan, range_m: (f64, f64)) -> Conditions {
    Conditions {
        pulse: plan.pulse,
        sound_speed_m_per_s: C,
        sample_rate_hz: 100e3,
        filter: ReceiverFilter::None,
        speed_m_per_s: plan.trajectory.pose_at(0.0).velocity_m_per_s.length(),
        acceleration_m_per_s2: 0.0,
        turning_m_per_s: 0.0,
        range_m,
        segment_s: plan.model.segment_s,
        scatterers: 1_000_000,
        elements: 1,
        tolerance: 1e-3,
        echo_statistics: None,
    }
}

/// Error of the direct sum with the selected models against the reference, with a taper so that edges have no effect.
fn measured(plan: &PingPlan, tx_m: DVec3, rx_m: DVec3, at_m: &[DVec3]) -> f64 {
    let (tx, rx) = (transmitter(tx_m), element(rx_m));
    let mut worst: f64 = 0.0;
    for &at_m in at_m {
        let one = points([at_m]);
        let (rate_hz, count) = (100e3, 900);
        let first_s = 2.0 * at_m.length() / C - 2e-3;
        let mut got = vec![Complex64::ZERO; count];
        let mut sink = Direct::new(plan, rate_hz, first_s, &mut got);
        let window = Window::of_samples(first_s, rate_hz, count);
        walk(plan, &tx, &rx, 0, window, &one, &mut sink);
        let mut want = vec![Complex64::ZERO; count];
        reference(plan, &tx, &rx, 0, &one, None, rate_hz, first_s, &mut want);
        worst = worst.max(relative_l2(&got, &want));
    }
    worst
}

/// Points in all directions, near and far.
fn around(range_m: (f64, f64)) -> Vec<DVec3> {
    (0..24)
        .map(|k| {
            let (sin, cos) = (0.5 * k as f64).sin_cos();
            let r = if k % 2 == 0 { range_m.0 } else { range_m.1 };
            DVec3::new(r * cos, 0.8 * r * sin, 0.6 * r * sin)
        })
        .collect()
}

/// The combined error of two models is bounded by the sum of their error models.
#[test]
fn error_models_bound_the_error_and_are_at_most_ten_times_too_high() {
    let range_m = (36.0, 150.0);
    let at_m = around(range_m);
    for v in [0.01, 0.2, 5.0] {
        for path in PathModel::ALL {
            for doppler in DopplerModel::ALL {
                let mut plan = ahead(v);
                plan.pulse.taper = 0.1;
                plan.model.path = path;
                plan.model.doppler = doppler;
                let c = conditions(&plan, range_m);
                let error_models = [
                    path_error_model(path, &c),
                    doppler_error_model(doppler, path, &c),
                ];
                let want: f64 = error_models
                    .iter()
                    .map(|error_model| error_model.error)
                    .sum();
                let got = measured(&plan, DVec3::ZERO, DVec3::ZERO, &at_m);
                let name = format!("{} {} {v} m/s", path.name(), doppler.name());
                println!("{name}: {got:.1e}, error model {want:.1e}");
                assert!(got <= 1.1 * want, "{name}: {got:e}, error model {want:e}");
                // Smaller errors are rounding of f64 or of the cubic chirp.
                let floor = 2e-5;
                assert!(
                    want < 10.0 * got + floor,
                    "{name}: {got:e}, error model {want:e}"
                );
            }
        }
    }
}

#[test]
fn on_a_moving_platform_error_models_bound_the_error() {
    let range_m = (40.0, 120.0);
    let (tx_m, rx_m) = (DVec3::new(1.5, 0.2, 0.8), DVec3::new(-3.0, 0.4, 0.2));
    for (path, count) in [
        (PathModel::Polyline, 64),
        (PathModel::KSegment, 64),
        (PathModel::KSegment, 256),
        (PathModel::Continuous, 5),
    ] {
        for doppler in [DopplerModel::Stretch, DopplerModel::StretchQuadratic] {
            let mut plan = restless();
            plan.pulse.taper = 0.1;
            chords(&mut plan, 0.256, count);
            plan.model.path = path;
            plan.model.doppler = doppler;
            let c = Conditions {
                speed_m_per_s: 3.6,
                acceleration_m_per_s2: 1.9,
                turning_m_per_s: 0.14 * 3.1,
                ..conditions(&plan, range_m)
            };
            let error_models = [
                path_error_model(path, &c),
                doppler_error_model(doppler, path, &c),
            ];
            let want: f64 = error_models
                .iter()
                .map(|error_model| error_model.error)
                .sum();
            let got = measured(&plan, tx_m, rx_m, &around(range_m));
            let name = format!("{} of {count}, {}", path.name(), doppler.name());
            println!("{name}: {got:.1e}, error model {want:.1e}");
            assert!(got <= 1.1 * want, "{name}: {got:e}, error model {want:e}");
        }
    }
}

#[test]
fn a_method_that_cannot_reach_what_is_asked_refuses_with_its_reason() {
    let plan = ahead(5.144);
    let mut c = conditions(&plan, (36.0, 250.0));
    c.sample_rate_hz = 37.5e3;
    let error_model = path_error_model(PathModel::StopAndHop, &c);
    let refused = error_model
        .within(1e-3)
        .expect_err("a metre is many wavelengths");
    assert_eq!(
        refused.to_string(),
        "stop-and-hop has an error of 2.0e0 here, above the tolerance of 1.0e-3: the platform moves 1.7e0 m during the travel time"
    );
    assert!(
        path_error_model(PathModel::Continuous, &c)
            .within(1e-8)
            .is_ok()
    );
    // Without a filter, a window with one end of the pulse has that end's whole error.
    let spectral = synthesis_error_model(Synthesis::Spectral, &c, &plan, None);
    assert!(spectral.within(1e-2).is_err());
    c.filter = ReceiverFilter::Fir;
    for (synthesis, reaches, fails) in [
        (Synthesis::Reference, 1e-7, 1e-9),
        (Synthesis::Direct, 1e-4, 1e-7),
        // A truncated spectrum of a sharp pulse rings into weaker windows.
        (Synthesis::Spectral, 1e-3, 1e-4),
        (Synthesis::Nearest, 2.0, 0.7),
        (Synthesis::Linear, 2.0, 0.3),
    ] {
        let filter = FilterDesign {
            pulse: plan.pulse,
            sample_rate_hz: c.sample_rate_hz,
            doppler_hz: 300.0,
            oversample: oversample(&plan.pulse, c.sample_rate_hz, synthesis),
        };
        let error_model = synthesis_error_model(synthesis, &c, &plan, Some(filter));
        assert!(
            error_model.clone().within(reaches).is_ok(),
            "{error_model:?}"
        );
        assert!(
            error_model.clone().within(fails).is_err(),
            "{error_model:?}"
        );
    }
}

#[test]
fn the_second_order_is_taken_where_the_tolerance_needs_it() {
    let at = |v: f64, tolerance: f64| {
        let mut plan = ahead(v);
        plan.pulse.taper = 0.1;
        let c = conditions(&plan, (36.0, 150.0));
        doppler_within(tolerance, PathModel::Continuous, &c).map(|(doppler, _)| doppler)
    };
    assert_eq!(at(1e-4, 1e-2), Ok(DopplerModel::None));
    assert_eq!(at(0.5, 1e-3), Ok(DopplerModel::Stretch));
    assert_eq!(at(5.0, 2e-2), Ok(DopplerModel::Stretch));
    assert_eq!(at(5.0, 1e-3), Ok(DopplerModel::StretchQuadratic));
    let refused = at(5.0, 1e-8).expect_err("beyond the second derivative");
    assert_eq!(
        (refused.name, refused.tolerance),
        ("stretch-quadratic", 1e-8)
    );
}
