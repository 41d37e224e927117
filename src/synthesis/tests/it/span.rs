//! Tests of the bounds on the Doppler of a ping against the actual values.

use glam::{DQuat, DVec3};

use echotank_core::model::{DopplerModel, PathModel};
use echotank_core::scene::Scatterers;
use echotank_synthesis::echo::{TransmitLeg, Workspace, arrivals, doppler_span, insonify};

use crate::paths::restless;
use echotank_testing::echo::*;

/// Scatterers in all directions, up to 150 m away.
fn around(nearest_m: f64) -> Scatterers {
    points((0..600).map(|k| {
        let r = nearest_m * (150.0 / nearest_m).powf(weyl(k, 0));
        let (sin, cos) = (std::f64::consts::TAU * weyl(k, 1)).sin_cos();
        let up = 2.0 * weyl(k, 2) - 1.0;
        let flat = (1.0 - up * up).sqrt();
        r * DVec3::new(flat * cos, flat * sin, up)
    }))
}

#[test]
fn no_echo_lies_outside_the_span_and_beyond_the_arms_it_is_not_much_too_wide() {
    for nearest_m in [0.3, 20.0] {
        held(&around(nearest_m), nearest_m);
    }
    let (mut transmit_leg, mut work) = (TransmitLeg::new(), Workspace::new());
    let array = element(DVec3::ZERO);
    let (plan, tx) = (ahead(5.0), transmitter(DVec3::ZERO));
    insonify(
        &plan,
        &tx,
        ALWAYS,
        &Scatterers::default(),
        &mut transmit_leg,
    );
    assert_eq!(
        doppler_span(&plan, &array, &transmit_leg, &mut work),
        (0.0, 0.0),
        "of nothing"
    );
}

fn held(scatterers: &Scatterers, nearest_m: f64) {
    for path in PathModel::ALL {
        for (moving, mut plan) in [
            ("ahead", ahead(5.0)),
            ("still", ahead(0.0)),
            (
                "turned",
                uniform(
                    DVec3::ZERO,
                    DVec3::new(2.0, -4.0, 1.0),
                    DQuat::from_rotation_z(0.7),
                ),
            ),
            ("restless", restless()),
        ] {
            chords(&mut plan, 0.25, 5);
            plan.model.path = path;
            for doppler in [DopplerModel::None, DopplerModel::Stretch] {
                plan.model.doppler = doppler;
                let tx = transmitter(DVec3::new(1.5, 0.2, 0.8));
                let array = line(DVec3::new(-2.0, 0.4, 0.2), 40);
                let (mut transmit_leg, mut work) = (TransmitLeg::new(), Workspace::new());
                insonify(&plan, &tx, ALWAYS, scatterers, &mut transmit_leg);
                let (least, greatest) = doppler_span(&plan, &array, &transmit_leg, &mut work);
                let mut seen = (f64::INFINITY, f64::NEG_INFINITY);
                for element in [0, 13, 39] {
                    let mut sink = Collected::default();
                    arrivals(&plan, &array, element, &transmit_leg, &mut work, &mut sink);
                    for arrival in sink.arrivals {
                        seen = (seen.0.min(arrival.doppler), seen.1.max(arrival.doppler));
                    }
                }
                println!(
                    "{} {moving} {}: {seen:?} in ({least:.2e}, {greatest:.2e})",
                    path.name(),
                    doppler.name()
                );
                // Tolerance for the rounding of a Doppler of zero.
                let rounding = 1e-17;
                assert!(
                    least <= seen.0 + rounding && seen.1 <= greatest + rounding,
                    "{path:?} {moving} {doppler:?}: {seen:?} in ({least:e}, {greatest:e})"
                );
                let width = seen.1 - seen.0;
                assert!(
                    nearest_m < 20.0 || greatest - least <= 1.5 * width + 1e-15,
                    "{path:?} {moving}: {width:e} in {:e}",
                    greatest - least
                );
            }
        }
    }
}
