use std::sync::Arc;

use glam::DVec3;
use num_complex::Complex64;

use echotank_core::arrays::Pattern;
use echotank_core::frames::rotation_from_angles;
use echotank_core::model::PathModel;
use echotank_core::ping::{EchoCounts, Segment};
use echotank_core::scene::{LawCurve, ScatterLaw, Scatterers};
use echotank_synthesis::echo::Window;

use crate::paths::restless;
use echotank_testing::echo::*;

fn piston(length_m: f64, width_m: f64) -> Pattern {
    Pattern::Rectangle {
        length_m,
        width_m,
        baffled: true,
    }
}

/// sin(pi x) / (pi x), evaluated directly.
fn sinc(x: f64) -> f64 {
    let a = std::f64::consts::PI * x;
    if a == 0.0 { 1.0 } else { a.sin() / a }
}

/// The sonar equation in decibels, factor by factor.
#[test]
fn an_amplitude_is_the_sonar_equation_by_hand() {
    let mut plan = ahead(0.0);
    plan.settings.source_level_db = 210.0;
    let mut tx = transmitter(DVec3::new(0.2, 0.0, 0.0));
    tx.pattern = piston(0.01, 0.004);
    tx.level_offset_db = -3.0;
    tx.mounting.body_from_array = starboard();
    let mut rx = line(DVec3::new(-0.2, 0.1, 0.0), 2);
    rx.element_pattern = piston(0.006, 0.002);
    rx.sensitivity_db = -190.0;
    rx.mounting.body_from_array = starboard();

    let at_m = DVec3::new(3.0, 40.0, 20.0);
    let normal = DVec3::new(0.1, -0.2, -1.0).normalize();
    let strength = Complex64::new(0.02, -0.05);
    let mut scatterers = points([]);
    scatterers.push(
        at_m,
        normal.to_array().map(|n| n as f32),
        strength,
        ScatterLaw::Lambert,
    );
    let (sink, counts) = collect(&plan, &tx, &rx, 1, ALWAYS, &scatterers);
    assert_eq!(counts.used, 1);

    let element_m = rx.mounting.position_m + DVec3::new(0.25 * WAVELENGTH_M, 0.0, 0.0);
    let (out, back) = (at_m - tx.mounting.position_m, at_m - element_m);
    // Array axes of a sonar that points 30 degrees below starboard: x ahead, y up the tilted face, z the
    // boresight.
    let (sin30, cos30) = 30f64.to_radians().sin_cos();
    let y_axis = DVec3::new(0.0, sin30, -cos30);
    let z_axis = DVec3::new(0.0, cos30, sin30);
    let response = |ray: DVec3, length_m: f64, width_m: f64| {
        let u = ray.normalize();
        assert!(u.dot(z_axis) > 0.0);
        sinc(length_m / WAVELENGTH_M * u.x) * sinc(width_m / WAVELENGTH_M * u.dot(y_axis))
    };
    let (cos_i, cos_s) = (-normal.dot(out.normalize()), -normal.dot(back.normalize()));
    let level_db = 210.0
        - 3.0
        - 20.0 * out.length().log10()
        - 0.05 * out.length()
        - 20.0 * back.length().log10()
        - 0.05 * back.length()
        + 10.0 * (cos_i * cos_s).log10()
        - 190.0;
    let want = strength
        * 10f64.powf(level_db / 20.0)
        * response(out, 0.01, 0.004)
        * response(back, 0.006, 0.002);
    let error = (sink.arrivals[0].amplitude / want - 1.0).norm();
    // Normals are stored in f32.
    assert!(error < 2e-7, "{error:e}");
}

#[test]
fn transmitter_and_element_may_be_exchanged() {
    let plan = ahead(0.0);
    let (a_m, b_m) = (DVec3::new(1.0, 0.3, 0.0), DVec3::new(-0.7, 0.0, 0.4));
    let mut scatterers = points([]);
    for k in 0..200 {
        let at_m = DVec3::new(
            60.0 * (weyl(k, 0) - 0.5),
            60.0 * (weyl(k, 1) - 0.5),
            5.0 + 30.0 * weyl(k, 2),
        );
        scatterers.push(at_m, [0.0, 0.6, -0.8], Complex64::ONE, ScatterLaw::Lambert);
    }
    let run = |tx_m: DVec3, tx_pattern: Pattern, rx_m: DVec3, rx_pattern: Pattern| {
        let mut tx = transmitter(tx_m);
        tx.pattern = tx_pattern;
        let mut rx = element(rx_m);
        rx.element_pattern = rx_pattern;
        collect(&plan, &tx, &rx, 0, ALWAYS, &scatterers).0.arrivals
    };
    let (p, q) = (piston(0.02, 0.0), piston(0.005, 0.01));
    let (there, back) = (run(a_m, p, b_m, q), run(b_m, q, a_m, p));
    assert_eq!(there.len(), back.len());
    assert!(there.len() > 100, "{}", there.len());
    for (x, y) in there.iter().zip(&back) {
        assert!((x.delay_s - y.delay_s).abs() < 1e-16, "{x:?} {y:?}");
        let error = (x.amplitude - y.amplitude).norm() / x.amplitude.norm();
        assert!(error < 1e-11, "{x:?} {y:?} {error:e}");
    }
}

#[test]
fn culled_echoes_are_below_the_floor_and_kept_echoes_are_not() {
    let mut plan = ahead(0.0);
    let mut tx = transmitter(DVec3::ZERO);
    tx.pattern = piston(0.05, 0.0);
    let mut rx = element(DVec3::ZERO);
    rx.element_pattern = piston(0.03, 0.0);
    let scatterers = points((0..3000).map(|k| {
        DVec3::new(
            80.0 * (weyl(k, 0) - 0.5),
            40.0 * (weyl(k, 1) - 0.5),
            40.0 * (weyl(k, 2) - 0.2),
        )
    }));
    plan.model.cull_db = Some(-40.0);
    let (kept, counts) = collect(&plan, &tx, &rx, 0, ALWAYS, &scatterers);
    let want: Vec<bool> = (0..scatterers.len())
        .map(|i| {
            let u = scatterers.position_m(i).normalize();
            let level = sinc(0.05 / WAVELENGTH_M * u.x) * sinc(0.03 / WAVELENGTH_M * u.x);
            u.z >= 0.0 && level.abs() >= 0.01
        })
        .collect();
    let above = want.iter().filter(|&&w| w).count();
    assert!(above > 150 && above < 2000, "{above}");
    assert_eq!(counts.used, above as u64);
    assert_eq!(counts.culled, 3000 - above as u64);

    plan.model.cull_db = None;
    let (all, counts) = collect(&plan, &tx, &rx, 0, ALWAYS, &scatterers);
    let before = (0..3000).filter(|&i| scatterers.down_m[i] >= 0.0).count();
    assert_eq!(
        counts.used, before as u64,
        "only what is behind the baffle goes"
    );
    // The kept echoes are identical, bit for bit.
    assert!(kept.arrivals.iter().all(|a| all.arrivals.contains(a)));
}

#[test]
fn an_echo_that_overlaps_the_window_is_kept_and_others_are_counted() {
    let plan = ahead(0.0);
    let window = Window {
        first_s: 0.020,
        last_s: 0.040,
    };
    // Leading edges in milliseconds; the pulse lasts 5 ms.
    let inside = [15.1, 19.0, 20.0, 39.9];
    let outside = [14.9, 2.0, 40.1, 41.0, 500.0];
    let scatterers = points(
        inside
            .iter()
            .chain(&outside)
            .map(|ms| DVec3::new(0.0, 0.75 * ms, 0.0)),
    );
    let (sink, counts) = collect(
        &plan,
        &transmitter(DVec3::ZERO),
        &element(DVec3::ZERO),
        0,
        window,
        &scatterers,
    );
    assert_eq!((counts.used, counts.outside_window), (4, 5));
    for (arrival, ms) in sink.arrivals.iter().zip(inside) {
        assert!((arrival.delay_s - 1e-3 * ms).abs() < 1e-15);
    }
}

#[test]
fn an_empty_scene_and_a_scene_facing_away_are_silent() {
    let plan = ahead(5.0);
    let (tx, rx) = (transmitter(DVec3::ZERO), element(DVec3::ZERO));
    let (sink, counts) = collect(&plan, &tx, &rx, 0, ALWAYS, &points([]));
    assert!(sink.chunks.is_empty() && counts == EchoCounts::default());
    let mut away = points([]);
    away.push(
        DVec3::new(0.0, 10.0, 10.0),
        [0.0, 0.0, 1.0],
        Complex64::ONE,
        ScatterLaw::Lambert,
    );
    let (sink, counts) = collect(&plan, &tx, &rx, 0, ALWAYS, &away);
    assert!(sink.chunks.is_empty());
    assert_eq!((counts.used, counts.culled), (0, 1));
}

#[test]
fn a_scatterer_on_the_array_is_limited_to_one_wavelength_and_counted() {
    let plan = ahead(5.0);
    let rx = line(DVec3::ZERO, 4);
    let on_element = points([rx.element_body_m(2)]);
    let (sink, counts) = collect(&plan, &transmitter(DVec3::X), &rx, 2, ALWAYS, &on_element);
    assert_eq!((counts.used, counts.too_close), (1, 1));
    let leg = |r: f64| 10f64.powf(-0.05 * r / 20.0) / r;
    let first_m = (rx.element_body_m(2) - DVec3::X).length();
    let want = leg(first_m) * leg(WAVELENGTH_M);
    let got = sink.arrivals[0].amplitude.re;
    // The element has moved 3 mm at the time of reception. This is less than the wavelength, which is the minimum
    // range.
    assert!((got / want - 1.0).abs() < 1e-12, "{got} {want}");
}

#[test]
fn chunks_are_full_but_the_last_and_keep_the_order_of_the_scatterers() {
    let plan = ahead(5.0);
    let scatterers = points((0..1000).map(|k| DVec3::new(0.0, 10.0 + 0.1 * k as f64, 5.0)));
    let (sink, _) = collect(
        &plan,
        &transmitter(DVec3::ZERO),
        &element(DVec3::ZERO),
        0,
        ALWAYS,
        &scatterers,
    );
    assert_eq!(sink.chunks, [256, 256, 256, 232]);
    assert!(
        sink.arrivals
            .windows(2)
            .all(|w| w[0].delay_s < w[1].delay_s)
    );
}

/// The pattern of an element has the platform's attitude at reception; the pattern of the transmitter has that at
/// transmission.
#[test]
fn patterns_turn_with_the_platform_between_transmission_and_reception() {
    let mut plan = ahead(0.0);
    plan.model.segment_s = 0.05;
    plan.segments = (0..4)
        .map(|k| Segment {
            start_s: 0.05 * k as f64,
            position_m: DVec3::ZERO,
            velocity_m_per_s: DVec3::ZERO,
            world_from_body: rotation_from_angles(0.0, 0.0, 0.002 * k as f64),
        })
        .collect();
    let mut tx = transmitter(DVec3::ZERO);
    tx.pattern = piston(0.4, 0.0);
    tx.mounting.body_from_array = starboard();
    let mut rx = element(DVec3::ZERO);
    rx.element_pattern = piston(0.4, 0.0);
    rx.mounting.body_from_array = starboard();
    // Abeam at 120 m: transmitted on the boresight, and received 160 ms later on the fourth leg, 6 mrad off the
    // boresight.
    let (sink, _) = collect(&plan, &tx, &rx, 0, ALWAYS, &points([DVec3::Y * 120.0]));
    let leg = 10f64.powf(-0.05 * 120.0 / 20.0) / 120.0;
    let want = leg * leg * sinc(0.4 / WAVELENGTH_M * 0.006f64.sin());
    let got = sink.arrivals[0].amplitude.re;
    assert!((got / want - 1.0).abs() < 1e-9, "{got} {want}");
}

/// Constant axes per chord would be wrong by 4 mrad at the ends of the longer chords, first order in their length.
#[test]
fn on_chords_an_element_turns_as_it_does_on_the_track_itself() {
    let tx = transmitter(DVec3::ZERO);
    let mut rx = element(DVec3::new(0.0, 0.3, 0.1));
    rx.element_pattern = Pattern::Rectangle {
        length_m: 3.0 * WAVELENGTH_M,
        width_m: 3.0 * WAVELENGTH_M,
        baffled: false,
    };
    rx.mounting.body_from_array = starboard();
    // The points are off the beam axis, where the pattern is steep.
    let scatterers = points((0..50).map(|k| {
        let ground_m = 60.0 + 1.6 * k as f64;
        DVec3::new(0.15 * ground_m, ground_m, 0.45 * ground_m)
    }));
    let heard = |path: PathModel, chord_count: usize| {
        let mut plan = restless();
        plan.model.path = path;
        chords(&mut plan, 0.256, chord_count);
        collect(&plan, &tx, &rx, 0, ALWAYS, &scatterers).0.arrivals
    };
    let want = heard(PathModel::Continuous, 4);
    let worst = [4, 16].map(|chord_count| {
        let got = heard(PathModel::KSegment, chord_count);
        let errors = got.iter().zip(&want);
        errors
            .map(|(got, want)| (got.amplitude / want.amplitude - 1.0).norm())
            .fold(0.0, f64::max)
    });
    println!("{worst:?}");
    assert!(worst[0] < 1e-3 && worst[1] < 0.1 * worst[0], "{worst:?}");
}

#[test]
fn every_scattering_law_matches_its_formula_and_is_zero_from_behind() {
    // Transmitter and element are 4 m apart, so that the two angles differ by several degrees.
    let (tx_m, rx_m) = (DVec3::new(0.0, -2.0, 0.0), DVec3::new(0.0, 2.0, 0.0));
    let strength = |cosine: f64| 0.3 * cosine.powi(4) + 0.01;
    let curve = Arc::new(LawCurve::new(strength));
    let normal = DVec3::new(0.1, 0.5, -0.8).normalize();
    let mut plan = ahead(0.0);
    plan.absorption_db_per_m = 0.0;
    for at_m in [
        DVec3::new(3.0, 5.0, 20.0),
        DVec3::new(-4.0, -9.0, 15.0),
        DVec3::new(0.0, 1.0, 30.0),
        DVec3::new(0.0, -30.0, 1.0),
        DVec3::new(0.0, 40.0, 1.0),
    ] {
        let cosine = |from_m: DVec3| (-normal.dot((at_m - from_m).normalize())).max(0.0);
        let (cos_in, cos_out) = (cosine(tx_m), cosine(rx_m));
        let legs = at_m.distance(tx_m) * at_m.distance(rx_m);
        for (law, want) in [
            (ScatterLaw::Point, 1.0),
            (ScatterLaw::Lambert, (cos_in * cos_out).sqrt()),
            (ScatterLaw::LambertOneWay, cos_in),
            (
                ScatterLaw::Curve,
                match cos_in > 0.0 && cos_out > 0.0 {
                    true => (strength(cos_in) * strength(cos_out)).powf(0.25),
                    false => 0.0,
                },
            ),
        ] {
            let mut scatterers = Scatterers {
                curve: Some(curve.clone()),
                ..Scatterers::default()
            };
            scatterers.push(
                at_m,
                normal.to_array().map(|n| n as f32),
                Complex64::ONE,
                law,
            );
            let (tx, rx) = (transmitter(tx_m), element(rx_m));
            let echoes = collect(&plan, &tx, &rx, 0, ALWAYS, &scatterers).0.arrivals;
            let got = echoes.first().map_or(0.0, |e| e.amplitude.norm()) * legs;
            // The curve is linear between its nodes.
            assert!(
                (got - want).abs() < 1e-5,
                "{law:?} at {at_m}: {got}, {want}"
            );
        }
    }
}
