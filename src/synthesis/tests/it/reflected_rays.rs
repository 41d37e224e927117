//! Reflected rays against an integration of the ray equations of its own, and against the images of water of one speed.

use std::sync::Arc;

use glam::DVec3;

use echotank_core::ping::Reflections;
use echotank_core::sound_speed::SoundSpeedProfile;
use echotank_synthesis::echo::rays::virtual_point_error;
use echotank_synthesis::echo::reflected_rays::{BottomPlane, Reflected, ReflectedRays};
use echotank_testing::echo::*;

use crate::rays::water;

/// A warm layer, a thermocline, and warmer water at the bottom.
const CAST: [(f64, f64); 5] = [
    (1.0, 1510.0),
    (4.0, 1508.0),
    (7.0, 1492.0),
    (15.0, 1486.0),
    (40.0, 1490.0),
];
const SURFACE_M: f64 = 0.3;

fn layered() -> Arc<SoundSpeedProfile> {
    Arc::new(SoundSpeedProfile::new(CAST.to_vec()).expect("sound"))
}

fn linear(gradient_per_s: f64) -> Arc<SoundSpeedProfile> {
    let points = [0.0, 60.0].map(|z| (z, 1500.0 + gradient_per_s * z));
    Arc::new(SoundSpeedProfile::new(points.to_vec()).expect("sound"))
}

/// A layer of one gradient: its depths, and speed and gradient at the upper one.
#[derive(Clone, Copy)]
struct Layer {
    depths_m: (f64, f64),
    c: f64,
    gradient_per_s: f64,
}

/// The layer that a ray at a depth enters.
fn layer(profile: &SoundSpeedProfile, depth_m: f64, down: f64) -> Layer {
    let inside_m = depth_m + 1e-9 * down.signum();
    let points = profile.points();
    let below = points.partition_point(|point| point.0 <= inside_m);
    let upper_m = below.checked_sub(1).map_or(-1e3, |k| points[k].0);
    let lower_m = points.get(below).map_or(1e3, |point| point.0);
    let [c, end] = [upper_m, lower_m].map(|z| profile.at_m_per_s(z));
    Layer {
        depths_m: (upper_m, lower_m),
        c,
        gradient_per_s: (end - c) / (lower_m - upper_m),
    }
}

/// Place and slowness of a ray after a step of the ray equations dx/dt = c^2 s, ds/dt = -grad c / c (Runge and Kutta, fourth order).
fn step(layer: &Layer, (x, s): (DVec3, DVec3), h: f64) -> (DVec3, DVec3) {
    let rate = |x: DVec3, s: DVec3| {
        let c = layer.c + layer.gradient_per_s * (x.z - layer.depths_m.0);
        (c * c * s, DVec3::new(0.0, 0.0, -layer.gradient_per_s / c))
    };
    let (a, b) = rate(x, s);
    let (a2, b2) = rate(x + 0.5 * h * a, s + 0.5 * h * b);
    let (a3, b3) = rate(x + 0.5 * h * a2, s + 0.5 * h * b2);
    let (a4, b4) = rate(x + h * a3, s + h * b3);
    (
        x + h / 6.0 * (a + 2.0 * a2 + 2.0 * a3 + a4),
        s + h / 6.0 * (b + 2.0 * b2 + 2.0 * b3 + b4),
    )
}

/// End of the ray that leaves `from_m` in a direction, after a time: its place, direction and number of reflections. Surface and bottom reflect.
fn trace(
    profile: &SoundSpeedProfile,
    from_m: DVec3,
    direction: DVec3,
    time_s: f64,
    plane: &BottomPlane,
) -> (DVec3, DVec3, usize) {
    const STEP_S: f64 = 2e-5;
    let mut ray = (from_m, direction.normalize() / profile.at_m_per_s(from_m.z));
    let (mut left_s, mut bounces) = (time_s, 0);
    while left_s > 0.0 {
        let layer = layer(profile, ray.0.z, ray.1.z);
        // Inside of water and layer.
        let inside = |x: DVec3| {
            let (upper_m, lower_m) = layer.depths_m;
            let water = (x.z - SURFACE_M).min((x - plane.at_m).dot(plane.up));
            water.min(x.z - upper_m + 1e-9).min(lower_m - x.z + 1e-9)
        };
        let h = left_s.min(STEP_S);
        let next = step(&layer, ray, h);
        if inside(next.0) >= 0.0 {
            ray = next;
            left_s -= h;
            continue;
        }
        let (mut low, mut high) = (0.0, h);
        for _ in 0..60 {
            let middle = 0.5 * (low + high);
            match inside(step(&layer, ray, middle).0) >= 0.0 {
                true => low = middle,
                false => high = middle,
            }
        }
        ray = step(&layer, ray, low);
        left_s -= low;
        for (height_m, normal) in [
            (ray.0.z - SURFACE_M, DVec3::Z),
            ((ray.0 - plane.at_m).dot(plane.up), plane.up),
        ] {
            if height_m < 1e-8 && ray.1.dot(normal) < 0.0 {
                ray.1 -= 2.0 * ray.1.dot(normal) * normal;
                bounces += 1;
            }
        }
        assert!(low > 0.0 || bounces > 0, "stuck at {}", ray.0);
    }
    (ray.0, ray.1.normalize(), bounces)
}

/// Error of the time in seconds, of the place beside the ray in metres, and of the level in decibels, of one reflected ray.
fn errors(
    profile: &SoundSpeedProfile,
    array_m: DVec3,
    at_m: DVec3,
    plane: &BottomPlane,
    found: &Reflected,
    bounces: usize,
) -> [f64; 3] {
    let offset_m = found.position_m - array_m;
    let c0 = profile.at_m_per_s(array_m.z);
    let (ray, time_s) = (offset_m.normalize(), offset_m.length() / c0);
    let (end_m, end, count) = trace(profile, array_m, ray, time_s, plane);
    assert_eq!(count, bounces, "{at_m}");
    let off_m = at_m - end_m;
    let along_m = off_m.dot(end);
    let c = profile.at_m_per_s(at_m.z);
    // The tube of two rays beside it.
    let across = ray.any_orthonormal_vector();
    let e = 1e-4;
    let moved = [across, ray.cross(across)].map(|v| {
        let ends = [e, -e].map(|e| trace(profile, array_m, ray + e * v, time_s, plane).0);
        (ends[0] - ends[1]) / (2.0 * e)
    });
    let area_m2 = moved[0].cross(moved[1]).dot(end).abs();
    let want = (c / c0 / area_m2).sqrt();
    let got = found.gain / offset_m.length();
    [
        along_m.abs() / c,
        (off_m - along_m * end).length(),
        (20.0 * (got / want).log10()).abs(),
    ]
}

/// Rays by the surface, and by the bottom and the surface, over level and sloping bottoms: sent in the direction of the virtual point for its time, they end
/// at the scatterer, and their tube has the level.
#[test]
fn reflected_rays_agree_with_an_independent_integration() {
    for (name, profile) in [
        ("-0.5 /s", linear(-0.5)),
        ("0.2 /s", linear(0.2)),
        ("thermocline", layered()),
    ] {
        for (north, east) in [(0.0, 0.0), (0.08, -0.05)] {
            let array_m = DVec3::new(3.0, -2.0, 2.5);
            let plane = BottomPlane {
                at_m: DVec3::new(5.0, 0.0, 14.0),
                up: DVec3::new(north, east, -1.0).normalize(),
            };
            let down_m = |x: f64, y: f64| 14.0 + north * (x - 5.0) + east * y;
            let mut rays = ReflectedRays::new(profile.clone());
            rays.aim(&water(&profile, array_m), 0.0, SURFACE_M, 20.0);
            let (mut worst, mut compared) = ([0.0f64; 3], [0, 0]);
            for k in 0..60 {
                let range_m = 30.0 * weyl(k, 0);
                let (sin, cos) = (std::f64::consts::TAU * weyl(k, 1)).sin_cos();
                let (x, y) = (array_m.x + range_m * cos, array_m.y + range_m * sin);
                // Just above the bottom, or in the water.
                let share = if k % 2 == 0 { 0.99 } else { weyl(k, 2) };
                let at_m = DVec3::new(x, y, 1.0 + share * (down_m(x, y) - 1.0));
                let near_m = array_m.lerp(at_m, 0.4);
                let found = [rays.by_surface(at_m), rays.by_bottom(at_m, &plane, near_m)];
                for (bounces, found) in (1..).zip(found) {
                    let Some(found) = found else {
                        continue;
                    };
                    compared[bounces - 1] += 1;
                    let own = errors(&profile, array_m, at_m, &plane, &found, bounces);
                    worst = std::array::from_fn(|i| worst[i].max(own[i]));
                }
            }
            println!(
                "{name}, slopes {north} {east}: {compared:?} rays, {:.1e} s, {:.1e} m, {:.3} dB",
                worst[0], worst[1], worst[2]
            );
            assert!(compared.iter().all(|n| *n > 40), "{compared:?}");
            assert!(worst[0] < 1e-9, "{name}: {} s", worst[0]);
            assert!(worst[1] < 1e-4, "{name}: {} m", worst[1]);
            assert!(worst[2] < 0.1, "{name}: {} dB", worst[2]);
        }
    }
}

/// In water of one speed the virtual points are the mirror images, and normals those of the images.
#[test]
fn water_of_one_speed_has_the_mirror_images() {
    let profile = linear(0.0);
    let array_m = DVec3::new(0.0, 0.0, 2.0);
    let mut rays = ReflectedRays::new(profile.clone());
    rays.aim(&water(&profile, array_m), 0.05, SURFACE_M, 12.0);
    for up in [DVec3::NEG_Z, DVec3::new(-0.1, 0.06, -1.0).normalize()] {
        let plane = BottomPlane {
            at_m: DVec3::new(0.0, 0.0, 12.0),
            up,
        };
        for k in 0..50 {
            let at_m = DVec3::new(30.0 * weyl(k, 0), 20.0 * weyl(k, 1) - 10.0, 10.0);
            let mut image_m = at_m;
            image_m.z = 2.0 * SURFACE_M - at_m.z;
            let by_surface = rays.by_surface(at_m).expect("a ray");
            let normal = [0.6, 0.0, 0.8];
            for (found, image_m) in [
                (Some(by_surface), image_m),
                (
                    rays.by_bottom(at_m, &plane, array_m.lerp(at_m, 0.4)),
                    image_m - 2.0 * (image_m - plane.at_m).dot(up) * up,
                ),
            ] {
                let found = found.expect("a ray");
                // Where the bottom reflects is known to 1e-5 m.
                assert!(
                    found.position_m.distance(image_m) < 1e-4,
                    "{at_m}: {} {image_m}",
                    found.position_m
                );
                // The tube by a slope is that of a slope along the ray: 0.02 dB.
                let off = if up == DVec3::NEG_Z { 1e-6 } else { 2e-3 };
                assert!((found.gain - 1.0).abs() < off, "{}", found.gain);
                let turned = found.normal(normal);
                let off = (0..3).map(|i| (turned[i] - normal[i]).abs());
                assert!(off.fold(0.0, f32::max) < 1e-5, "{turned:?}");
            }
        }
    }
}

/// Delays at an element beside the array, by rays of its own, are off by less than the bound says.
#[test]
fn elements_beside_the_array_keep_the_bound_of_reflected_rays() {
    for (name, profile) in [("-0.5 /s", linear(-0.5)), ("thermocline", layered())] {
        let array_m = DVec3::new(0.0, 0.0, 2.5);
        let mut there = water(&profile, array_m);
        there.floor_m = 14.0;
        there.reflections = Some(Reflections {
            surface_m: SURFACE_M,
            by_bottom: true,
        });
        let c0 = there.sound_speed_m_per_s();
        let plane = BottomPlane {
            at_m: DVec3::new(0.0, 0.0, 14.0),
            up: DVec3::NEG_Z,
        };
        let beside_m = 0.25;
        let bound = virtual_point_error(&there, 400e3, (beside_m, 0.0), 14.0);
        let rays_at = |at_m: DVec3| {
            let mut rays = ReflectedRays::new(profile.clone());
            rays.aim(&water(&profile, at_m), 0.0, SURFACE_M, 14.0);
            rays
        };
        let mut worst = 0.0f64;
        for (cos, sin) in [(1.0, 0.0), (0.6, 0.8), (0.0, 1.0)] {
            let element_m = array_m + beside_m * DVec3::new(cos, sin, 0.0);
            let (of_array, of_element) = (rays_at(array_m), rays_at(element_m));
            for k in 0..40 {
                let at_m = DVec3::new(60.0 * weyl(k, 0), 0.0, 14.0);
                let near_m = array_m.lerp(at_m, 0.4);
                let pairs = [
                    (of_array.by_surface(at_m), of_element.by_surface(at_m)),
                    (
                        of_array.by_bottom(at_m, &plane, near_m),
                        of_element.by_bottom(at_m, &plane, near_m),
                    ),
                ];
                for (seen, own) in pairs {
                    let (Some(seen), Some(own)) = (seen, own) else {
                        continue;
                    };
                    let got_m = seen.position_m.distance(element_m);
                    let want_m = own.position_m.distance(element_m);
                    let phase = std::f64::consts::TAU * 400e3 * (got_m - want_m) / c0;
                    worst = worst.max(phase.abs());
                }
            }
        }
        println!("{name}: {worst:.1e} of a bound of {bound:.1e}");
        assert!(
            worst > 0.02 * bound,
            "the bound is no measure: {worst} {bound}"
        );
        assert!(worst <= 1.05 * bound, "{worst} {bound}");
    }
}
