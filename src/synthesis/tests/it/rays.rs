//! Rays and virtual points against closed forms, an independent integration (tools/rays_reference.py), and rays to every element.

use std::f64::consts::TAU;
use std::sync::Arc;

use glam::{DQuat, DVec3};
use num_complex::Complex64;

use echotank_core::ping::Refraction;
use echotank_core::scene::{ScatterLaw, Scatterers};
use echotank_core::sound_speed::SoundSpeedProfile;
use echotank_synthesis::echo::rays::{VirtualPoints, place_error, ray, seen, virtual_point_error};
use echotank_testing::echo::*;

const REFERENCE: &str = include_str!("../../../../tests/data/rays/reference.csv");

/// Rows of the reference that begin with a word.
fn rows(word: &str) -> Vec<Vec<f64>> {
    let lines = REFERENCE.lines().filter_map(|line| line.strip_prefix(word));
    lines
        .map(|line| {
            let cells = line.split(',').filter(|cell| !cell.is_empty());
            cells.map(|cell| cell.parse().expect("a number")).collect()
        })
        .collect()
}

fn layered() -> Arc<SoundSpeedProfile> {
    let points = rows("profile").iter().map(|row| (row[0], row[1])).collect();
    Arc::new(SoundSpeedProfile::new(points).expect("sound"))
}

/// One gradient from the surface down.
fn linear(c_m_per_s: f64, gradient_per_s: f64, deepest_m: f64) -> Arc<SoundSpeedProfile> {
    let points = [0.0, deepest_m].map(|z| (z, c_m_per_s + gradient_per_s * z));
    Arc::new(SoundSpeedProfile::new(points.to_vec()).expect("sound"))
}

pub(crate) fn water(profile: &Arc<SoundSpeedProfile>, array_m: DVec3) -> Refraction {
    Refraction {
        profile: profile.clone(),
        array_m,
        floor_m: SoundSpeedProfile::MAX_DEPTH_M,
        reflections: None,
        places: Default::default(),
    }
}

/// Time, elevation at the start and at the end of the arc of a circle between two depths, in water of one gradient.
fn arc(c: f64, g: f64, from_m: f64, to_m: f64, range_m: f64) -> [f64; 3] {
    let (c1, c2) = (c + g * from_m, c + g * to_m);
    let square = range_m * range_m + (to_m - from_m).powi(2);
    // arccosh(1 + x), without the loss of digits of a small x.
    let x = g * g * square / (2.0 * c1 * c2);
    let time_s = (x + (x * (2.0 + x)).sqrt()).ln_1p() / g.abs();
    // Centre of the circle, at the depth of no speed.
    let (h1, h2) = (c1 / g, c2 / g);
    let middle_m = (range_m * range_m + h2 * h2 - h1 * h1) / (2.0 * range_m);
    let elevation = |x_m: f64, h: f64| (h.signum() * x_m).atan2(h.abs());
    [
        time_s,
        elevation(middle_m, h1),
        elevation(middle_m - range_m, h2),
    ]
}

#[test]
fn rays_in_one_gradient_are_arcs_of_circles() {
    let mut compared = 0;
    for g in [0.016, -0.1, 1.0, -1.0, 0.1] {
        let profile = linear(1500.0, g, 150.0);
        for (from_m, to_m) in [
            (60.0, 80.0),
            (80.0, 60.0),
            (60.0, 60.0),
            (70.0, 70.01),
            (5.0, 140.0),
        ] {
            for range_m in [0.5, 5.0, 40.0, 150.0] {
                let [time_s, start, end] = arc(1500.0, g, from_m, to_m, range_m);
                let found = ray(&profile, from_m, to_m, range_m, 149.0);
                let found = found.unwrap_or_else(|| panic!("{g} {from_m} {to_m} {range_m}"));
                let case = format!("{g} /s, {from_m} to {to_m} m, {range_m} m: {found:?}");
                assert!(
                    (found.time_s - time_s).abs() < 1e-10,
                    "{case} want {time_s}"
                );
                for (got, want) in [(found.start, start), (found.end, end)] {
                    let angle = got.down.atan2(got.outward);
                    assert!((angle - want).abs() < 1e-8, "{case} want {want}");
                }
                compared += 1;
            }
        }
    }
    assert_eq!(compared, 100);
}

#[test]
fn rays_through_layers_agree_with_an_independent_integration() {
    let profile = layered();
    let cases = rows("ray");
    assert!(cases.len() >= 18);
    for row in cases {
        let [
            from_m,
            to_m,
            range_m,
            start,
            end,
            time_s,
            length_m,
            pressure,
        ] = row[..]
        else {
            panic!("eight columns");
        };
        let found = ray(&profile, from_m, to_m, range_m, 200.0).expect("a ray");
        let near = |got: f64, want: f64, error: f64, what: &str| {
            let off = (got - want).abs();
            assert!(off <= error, "{what} of {row:?}: {got}, off by {off:.1e}");
        };
        near(found.time_s, time_s, 1e-8 * time_s, "time");
        near(found.length_m, length_m, 1e-8 * length_m, "length");
        near(
            found.start.down.atan2(found.start.outward),
            start,
            1e-8,
            "start",
        );
        near(found.end.down.atan2(found.end.outward), end, 1e-8, "end");
        // The reference takes a difference of ranges.
        near(
            found.spreading_per_m,
            pressure,
            1e-6 * pressure,
            "spreading",
        );
        let back = ray(&profile, to_m, from_m, range_m, 200.0).expect("reciprocal");
        near(back.time_s, time_s, 1e-8 * time_s, "time back");
        near(
            back.spreading_per_m,
            pressure,
            1e-6 * pressure,
            "spreading back",
        );
    }
}

/// That two places agree to 1e-8 rad and 1e-11 s as seen from the array.
fn agrees(array_m: DVec3, got_m: DVec3, want_m: DVec3) {
    let (got, want) = (got_m - array_m, want_m - array_m);
    let angle = got.cross(want).length() / (got.length() * want.length());
    assert!(angle < 1e-8, "{want_m}: {got_m}, {angle:.1e} rad off");
    let off_m = got.length() - want.length();
    assert!(off_m.abs() < 1500.0 * 1e-11, "{want_m}: {off_m:.1e} m");
}

#[test]
fn water_of_one_speed_leaves_every_scatterer_where_it_is() {
    let profile = linear(1500.0, 0.0, 50.0);
    let array_m = DVec3::new(100.0, -20.0, 2.0);
    let mut points = VirtualPoints::new(profile.clone());
    points.aim(&water(&profile, array_m), 0.05, 60.0);
    for k in 0..200 {
        let at_m = array_m
            + DVec3::new(
                300.0 * weyl(k, 0) - 150.0,
                90.0 * weyl(k, 1),
                60.0 * weyl(k, 2) - 2.0,
            );
        let found = points.seen(at_m).expect("seen");
        agrees(array_m, found.position_m, at_m);
        assert!((found.gain - 1.0).abs() < 1e-9, "{at_m}: {found:?}");
        let normal = [0.6, 0.0, -0.8];
        let off = DVec3::from_array(found.normal(normal).map(f64::from))
            - DVec3::from_array(normal.map(f64::from));
        assert!(off.length() < 1e-6, "{at_m}");
    }
}

#[test]
fn the_table_agrees_with_a_ray_of_its_own_for_every_scatterer() {
    for (profile, array_m) in [
        (layered(), DVec3::new(10.0, 20.0, 3.0)),
        (layered(), DVec3::new(10.0, 20.0, 47.0)),
        (linear(1500.0, -0.5, 100.0), DVec3::new(0.0, 0.0, 0.7)),
    ] {
        let water = water(&profile, array_m);
        let mut points = VirtualPoints::new(profile.clone());
        points.aim(&water, 0.05, 80.0);
        for k in 0..2000 {
            let range_m = 0.01 * 20_000f64.powf(weyl(k, 0));
            let (sin, cos) = (TAU * weyl(k, 1)).sin_cos();
            let at_m = DVec3::new(
                array_m.x + range_m * cos,
                array_m.y + range_m * sin,
                array_m.z + (80.0 - array_m.z) * weyl(k, 2),
            );
            let nepers = 0.05 * 10f64.ln() / 20.0;
            let (got, want) = (points.seen(at_m), seen(&water, nepers, at_m));
            let (Some(got), Some(want)) = (got, want) else {
                assert_eq!(got, want);
                continue;
            };
            agrees(array_m, got.position_m, want.position_m);
            // A hundredth of a decibel.
            assert!(
                (got.gain / want.gain - 1.0).abs() < 1e-3,
                "{k} {at_m}: {got:?} {want:?}"
            );
            let normals =
                [got, want].map(|s| DVec3::from_array(s.normal([0.0, 0.6, -0.8]).map(f64::from)));
            assert!(normals[0].distance(normals[1]) < 1e-6, "{k} {at_m}");
        }
    }
}

#[test]
fn the_incidence_at_a_virtual_point_is_that_of_the_ray() {
    let profile = linear(1500.0, -0.8, 100.0);
    let array_m = DVec3::new(0.0, 0.0, 2.0);
    let at_m = DVec3::new(60.0, 80.0, 30.0);
    let found = seen(&water(&profile, array_m), 0.0, at_m).expect("seen");
    let own = ray(&profile, 2.0, 30.0, 100.0, 100.0).expect("a ray");
    let outward = DVec3::new(0.6, 0.8, 0.0);
    let back = -(own.end.outward * outward + own.end.down * DVec3::Z);
    for normal in [[0.0, 0.0, -1.0], [0.6, 0.0, -0.8], [0.0, -0.28, -0.96]] {
        let want = back.dot(DVec3::from_array(normal.map(f64::from)));
        let turned = DVec3::from_array(found.normal(normal.map(|n: f32| n)).map(f64::from));
        let got = (array_m - found.position_m).normalize().dot(turned);
        assert!((got - want).abs() < 1e-6, "{normal:?}: {got} {want}");
        let straight = (array_m - at_m)
            .normalize()
            .dot(DVec3::from_array(normal.map(f64::from)));
        assert!(
            (straight - want).abs() > 1e-3,
            "a straight line is told apart"
        );
    }
}

#[test]
fn scatterers_in_a_shadow_of_the_water_lose_their_strength_and_are_counted() {
    // Sound bends upwards: the level ray from the bottom at 20 m meets 2 m of depth at about 232 m.
    let profile = linear(1500.0, 1.0, 20.0);
    let mut water = water(&profile, DVec3::new(0.0, 0.0, 2.0));
    water.floor_m = 20.0;
    let limit_m = (2.0 * 1520.0f64 * 18.0 - 18.0 * 18.0).sqrt();
    let mut scatterers =
        points([0.99 * limit_m, 1.01 * limit_m].map(|north_m| DVec3::new(north_m, 0.0, 20.0)));
    let mut table = VirtualPoints::new(profile);
    table.aim(&water, 0.0, 20.0);
    assert_eq!(table.replace(&mut scatterers), 1);
    assert!(scatterers.strength[0].norm() > 0.0);
    assert_eq!(scatterers.strength[1], Complex64::ZERO);
}

/// Samples of echoes of an LFM pulse with delays and amplitudes at one element.
fn samples(echoes: &[(f64, Complex64)], rate_hz: f64, count: usize) -> Vec<Complex64> {
    let (bandwidth_hz, duration_s) = (30e3, 5e-3);
    let mut out = vec![Complex64::ZERO; count];
    for &(delay_s, amplitude) in echoes {
        let first = (delay_s * rate_hz).ceil().max(0.0) as usize;
        let last = (((delay_s + duration_s) * rate_hz).floor() as usize).min(count - 1);
        for (k, sample) in out.iter_mut().enumerate().take(last + 1).skip(first) {
            let t = k as f64 / rate_hz - delay_s - 0.5 * duration_s;
            *sample += amplitude * Complex64::cis(0.5 * TAU * bandwidth_hz / duration_s * t * t);
        }
    }
    out
}

/// Largest error of windows of one pulse length, for a line of `elements` over a bottom 20 m below it, from 20 to 150 m, and its stated bound.
fn element_errors(profile: &Arc<SoundSpeedProfile>, elements: usize) -> (f64, f64) {
    let array_m = DVec3::new(0.0, 0.0, 2.0);
    let water = water(profile, array_m);
    let mut plan = uniform(array_m, DVec3::ZERO, DQuat::IDENTITY);
    plan.absorption_db_per_m = 0.0;
    plan.sound_speed_m_per_s = water.sound_speed_m_per_s();
    let rays = |k: usize| {
        let range_m = 5.0 + 140.0 * weyl(k, 0);
        let (sin, cos) = (TAU * weyl(k, 1)).sin_cos();
        DVec3::new(range_m * cos, range_m * sin, 22.0)
    };
    let places: Vec<DVec3> = (0..400).map(rays).collect();
    let mut scatterers = Scatterers::default();
    for (k, &at_m) in places.iter().enumerate() {
        let phase = Complex64::cis(TAU * weyl(k, 2));
        scatterers.push(at_m, [0.0, 0.0, -1.0], phase, ScatterLaw::Point);
    }
    let mut table = VirtualPoints::new(profile.clone());
    table.aim(&water, 0.0, 22.0);
    assert_eq!(table.replace(&mut scatterers), 0);
    let (tx, line) = (transmitter(DVec3::ZERO), line(DVec3::ZERO, elements));
    let carrier_hz = plan.pulse.center_frequency_hz;
    let rate_hz = 40e3;
    let window = (5e-3 * rate_hz) as usize;
    let (count, mut worst) = (10_000, 0.0f64);
    for element in [0, elements / 3, elements - 1] {
        let (found, _) = collect(&plan, &tx, &line, element, ALWAYS, &scatterers);
        assert_eq!(found.arrivals.len(), places.len());
        let element_m = array_m + line.element_body_m(element);
        let (mut seen, mut own) = (Vec::new(), Vec::new());
        for (arrival, at_m) in found.arrivals.iter().zip(&places) {
            let time_s = |from_m: DVec3| {
                let range_m = (at_m - from_m).truncate().length();
                let found = ray(profile, from_m.z, at_m.z, range_m, water.floor_m);
                found.expect("a ray").time_s
            };
            let delay_s = time_s(array_m) + time_s(element_m);
            let turn = -TAU * carrier_hz * (delay_s - arrival.delay_s);
            seen.push((arrival.delay_s, arrival.amplitude));
            own.push((delay_s, arrival.amplitude * Complex64::cis(turn)));
        }
        let (got, want) = (
            samples(&seen, rate_hz, count),
            samples(&own, rate_hz, count),
        );
        let windows = got.chunks(window).zip(want.chunks(window));
        let energy = |w: &[Complex64]| w.iter().map(|x| x.norm_sqr()).sum::<f64>();
        let floor = want.chunks(window).map(energy).fold(0.0, f64::max) * 1e-6;
        for (got, want) in windows.filter(|(_, want)| energy(want) > floor) {
            worst = worst.max(relative_l2(got, want));
        }
    }
    let half_m = 0.5 * (elements - 1) as f64 * line.spacing_m;
    (
        worst,
        virtual_point_error(&water, carrier_hz, (half_m, 0.0), 22.0),
    )
}

#[test]
fn element_samples_through_virtual_points_keep_their_bound() {
    for (profile, least) in [
        (linear(1500.0, 0.016, 100.0), 1e-7),
        (linear(1500.0, -0.1, 100.0), 1e-6),
        (linear(1500.0, -1.0, 100.0), 1e-5),
        (layered(), 1e-5),
    ] {
        // A line of 0.48 m.
        let (error, bound) = element_errors(&profile, 257);
        println!(
            "{:?}: error {error:.2e}, bound {bound:.2e}",
            &profile.points()[..2]
        );
        assert!(error <= bound, "{error:.2e} above {bound:.2e}");
        // The bound is of use, and the comparison is not of equals.
        assert!(
            error > least && bound < 1e3 * error,
            "{error:.2e} {bound:.2e}"
        );
    }
}

/// Delays at elements beside the array through sharp thermoclines, to scatterers at all depths, by rays of their own: up, down and with a turn. The error of
/// each place is what is predicted for it.
#[test]
fn elements_keep_the_predicted_error_of_each_place_up_down_and_by_turns() {
    let carrier_hz = 400e3;
    let step = |top_m: f64, bottom_m: f64, rise: f64| {
        let points = [(0.0, 0.0), (top_m, 0.0), (bottom_m, rise), (100.0, rise)];
        let points = points.map(|(z, more)| (z, 1500.0 + more));
        Arc::new(SoundSpeedProfile::new(points.to_vec()).expect("sound"))
    };
    let mut turns = 0;
    for (name, profile) in [
        ("nine layers", layered()),
        ("-15 m/s from 6 to 7 m", step(6.0, 7.0, -15.0)),
        ("-25 m/s from 6 to 6.5 m", step(6.0, 6.5, -25.0)),
        ("+15 m/s from 6 to 7 m", step(6.0, 7.0, 15.0)),
        ("-20 m/s from 1 to 3 m", step(1.0, 3.0, -20.0)),
        ("+20 m/s from 1 to 3 m", step(1.0, 3.0, 20.0)),
        ("+1 /s", linear(1500.0, 1.0, 100.0)),
    ] {
        let array_m = DVec3::new(0.0, 0.0, 2.0);
        let mut water = water(&profile, array_m);
        water.floor_m = 22.0;
        let c0 = water.sound_speed_m_per_s();
        let (mut worst, mut worst_ratio, mut seabed) = (0.0f64, 0.0f64, 0.0f64);
        for depth_m in [0.3, 1.0, 2.5, 4.0, 6.2, 7.1, 8.0, 10.0, 15.0, 22.0] {
            for offset_m in [
                DVec3::new(0.24, 0.0, 0.0),
                DVec3::new(0.0, 0.24, 0.0),
                DVec3::new(-0.1, 0.15, 0.02),
            ] {
                let offsets_m = (offset_m.truncate().length(), offset_m.z.abs());
                for k in 0..240 {
                    let range_m = 2.5 + 0.6 * f64::from(k);
                    let at_m = DVec3::new(range_m, 0.0, depth_m);
                    let Some(seen) = seen(&water, 0.0, at_m) else {
                        continue;
                    };
                    let element_m = array_m + offset_m;
                    let beside_m = (at_m - element_m).truncate().length();
                    let own = ray(&profile, element_m.z, depth_m, beside_m, water.floor_m);
                    let Some(own) = own else { continue };
                    let seen_s = seen.position_m.distance(element_m) / c0;
                    let error = TAU * carrier_hz * (own.time_s - seen_s).abs();
                    let predicted = place_error(&water, carrier_hz, offsets_m, at_m);
                    // Of second order in the offset; near a caustic, which the prediction shows, neighbours have other rays.
                    if predicted > 0.3 {
                        continue;
                    }
                    let here = ray(&profile, array_m.z, depth_m, range_m, water.floor_m);
                    turns += usize::from(here.is_some_and(|r| r.start.down * r.end.down < 0.0));
                    worst = worst.max(error);
                    if error > 1e-4 {
                        worst_ratio = worst_ratio.max(error / predicted);
                    }
                    assert!(
                        error <= 1.2 * predicted + 1e-5,
                        "{name}, {at_m} from {offset_m}: {error:.2e}, predicted {predicted:.2e}"
                    );
                }
                if depth_m == 22.0 {
                    seabed =
                        seabed.max(virtual_point_error(&water, carrier_hz, offsets_m, depth_m));
                }
            }
        }
        println!(
            "{name}: largest error {worst:.2e}, bound at the seabed {seabed:.2e}; at most {worst_ratio:.3} of the prediction of its place"
        );
    }
    assert!(turns > 100, "{turns}");
}
