//! Tests of energies against closed forms, of the properties of selections, and of degenerate scenes.

use std::f64::consts::PI;

use glam::DVec3;
use num_complex::Complex64;
use proptest::prelude::*;

use super::collapse::{Quadric, collapse};
use super::curvature::Curvatures;
use super::energy::{Beam, Energies, View};
use super::shadow::Horizon;
use super::stage::Stage;
use super::*;
use crate::paper;
use echotank_config::spec::PaperShape;
use echotank_core::scene::ScatterLaw;

const SONAR_M: DVec3 = DVec3::new(10.0, 0.0, 0.0);

fn push(s: &mut Scatterers, position_m: DVec3, strength: f64) {
    s.push(
        position_m,
        [0.0, 0.0, -1.0],
        Complex64::from(strength),
        ScatterLaw::Lambert,
    );
}

/// A patch of `down(n, e)` around (0, 0) with `side` points a side, `step` apart, on a sheared lattice.
fn patch(side: i32, step_m: f64, down_m: impl Fn(f64, f64) -> f64) -> Scatterers {
    let mut s = Scatterers::default();
    for r in -side / 2..=side / 2 {
        for c in -side / 2..=side / 2 {
            let (n, e) = (
                f64::from(r) * step_m,
                (f64::from(c) + 0.3 * f64::from(r)) * step_m,
            );
            push(&mut s, DVec3::new(n, e, down_m(n, e)), 1.0);
        }
    }
    s
}

fn looking_east(slack_m: f64) -> View {
    View {
        apex_m: SONAR_M,
        beams: vec![Beam {
            along: DVec3::X,
            across: DVec3::new(0.0, -0.5, 0.75f64.sqrt()),
            boresight: DVec3::new(0.0, 0.75f64.sqrt(), 0.5),
            lengths: [90.0; 2],
            widths: [0.0; 2],
            baffled: true,
        }],
        slack_m,
        slack_rad: 0.0,
        shadows: true,
    }
}

fn settings(method: Method, keep: usize) -> Settings {
    Settings {
        method,
        keep,
        weights: Weights::default_of(method),
        seed: 7,
    }
}

fn relief(speckle_seed: u64) -> Scatterers {
    paper::cloud(PaperShape::Relief, 1, speckle_seed, -20.0).scatterers
}

/// The selection from scatterers without deterministic targets.
fn chosen_of(s: &Scatterers, view: &View, settings: Settings) -> Selection {
    select(s, s.len(), view, &settings)
}

/// What the horizon scan hides from the sonar.
fn hidden(s: &Scatterers, apex_m: DVec3) -> Vec<bool> {
    let mut hidden = vec![false; s.len()];
    Horizon::default().hide(s, s.len(), apex_m, None, &mut hidden);
    hidden
}

// Curvature

#[test]
fn curvature_of_a_plane_a_cylinder_a_sphere_and_a_saddle_are_the_closed_forms() {
    let middle = |s: &Scatterers| {
        let mut c = Curvatures::default();
        c.fit(s, s.len());
        let at = s.len() / 2;
        (c.per_m2[at], c.as_printed_per_m2[at], s.position_m(at))
    };
    let plane = middle(&patch(9, 0.1, |n, e| 3.0 + 0.7 * n - 0.4 * e)).0;
    assert!(plane.abs() < 1e-10, "plane: {plane}");
    let cylinder = middle(&patch(9, 0.01, |n, _| 5.0 - (25.0 - n * n).sqrt())).0;
    assert!(cylinder.abs() < 1e-6, "cylinder: {cylinder}");
    // 1/R^2 everywhere on the sphere. The error of the quadratic is the square of the patch size over R.
    for off in [0.0, 1.5, 3.0] {
        let sphere = patch(9, 0.01, |n, e| {
            5.0 - (25.0 - (n + off).powi(2) - e * e).sqrt()
        });
        let (got, printed, _) = middle(&sphere);
        let want = 1.0 / 25.0;
        assert!(
            (got / want - 1.0).abs() < 2e-3,
            "sphere off {off}: {got} want {want}"
        );
        // Eq. 28's denominator is unsquared: too large by 1 + t^2 + u^2 = R^2/(R^2 - off^2).
        let factor = 25.0 / (25.0 - off * off);
        assert!(
            (printed / (want * factor) - 1.0).abs() < 2e-3,
            "printed off {off}: {printed}"
        );
    }
    let saddle = middle(&patch(9, 0.01, |n, e| 0.2 * n * e)).0;
    assert!((saddle + 0.04).abs() < 1e-6, "saddle: {saddle}");
}

#[test]
fn curvature_is_zero_where_points_do_not_determine_it() {
    for count in [0, 1, 3, 6, 40] {
        let mut line = Scatterers::default();
        for k in 0..count {
            push(
                &mut line,
                DVec3::new(f64::from(k), 2.0 * f64::from(k), 5.0),
                1.0,
            );
        }
        let mut same = Scatterers::default();
        (0..count).for_each(|_| push(&mut same, DVec3::ONE, 1.0));
        for s in [line, same] {
            let mut c = Curvatures::default();
            c.fit(&s, s.len());
            assert!(c.per_m2.iter().all(|k| *k == 0.0) && c.per_m2.len() == s.len());
        }
    }
}

// Shadows

/// Visibility by marching along the ray over the surface itself.
fn hidden_by_ray(shape: PaperShape, from: DVec3, to: DVec3) -> bool {
    const STEPS: usize = 4000;
    (1..STEPS).any(|k| {
        let at = from.lerp(to, k as f64 / STEPS as f64);
        at.distance(to) > 0.02 && paper::sample(shape, at.x, at.y).unwrap().down_m < at.z - 1e-3
    })
}

#[test]
fn the_horizon_scan_hides_what_rays_do_not_reach() {
    let s = relief(1);
    let hidden = hidden(&s, SONAR_M);
    let share = hidden.iter().filter(|h| **h).count() as f64 / s.len() as f64;
    assert!((0.02..0.2).contains(&share), "{share} hidden");
    let (mut wrong, mut far_wrong, mut tested) = (0, 0, 0);
    for i in (0..s.len()).step_by(29) {
        let at = s.position_m(i);
        let want = hidden_by_ray(PaperShape::Relief, SONAR_M, at);
        tested += 1;
        if want == hidden[i] {
            continue;
        }
        wrong += 1;
        // At the edge of a shadow the answer changes within two spacings along the ray or across it (0.35 m; a sector is 0.28 m wide at the far end).
        let ray = (at - SONAR_M).truncate().normalize();
        let edge = [(0.35, 0.0), (-0.35, 0.0), (0.0, 0.35), (0.0, -0.35)]
            .iter()
            .any(|(a, b)| {
                let to = at.truncate() + ray * *a + ray.perp() * *b;
                let down = paper::sample(PaperShape::Relief, to.x, to.y)
                    .unwrap()
                    .down_m;
                hidden_by_ray(PaperShape::Relief, SONAR_M, to.extend(down)) != want
            });
        if !edge {
            println!(
                "{at}: hidden {want}, scan says {}, normal {:?}",
                hidden[i], s.normal[i]
            );
            far_wrong += 1;
        }
    }
    println!("{wrong} of {tested} differ, {far_wrong} of them away from an edge");
    assert!(wrong * 50 < tested, "{wrong} of {tested} differ");
    // On side walls of 63 degrees, a nearer neighbour in the same sector stands a step higher.
    assert!(
        far_wrong * 200 < tested,
        "{far_wrong} of {tested} wrong away from a shadow's edge"
    );
}

#[test]
fn a_level_bottom_hides_nothing_and_the_rule_by_incidence_agrees_with_the_slopes() {
    let flat = patch(60, 0.5, |_, _| 30.0);
    let none = hidden(&flat, DVec3::new(0.0, -40.0, 0.0));
    assert!(none.iter().all(|h| !h));
    let s = relief(1);
    let (slopes, mut angles) = (hidden(&s, SONAR_M), vec![false; s.len()]);
    Horizon::default().hide_by_incidence(&s, s.len(), SONAR_M, None, &mut angles);
    let differ = slopes.iter().zip(&angles).filter(|(a, b)| a != b).count();
    assert!(differ <= 2, "{differ} differ, by rounding at most");
}

#[test]
fn shadowed_points_go_last() {
    let s = relief(1);
    let view = looking_east(0.0);
    let hidden = hidden(&s, SONAR_M);
    let visible = hidden.iter().filter(|h| !**h).count();
    for keep in [176, 3000, visible] {
        let chosen = chosen_of(&s, &view, settings(Method::Acoustic, keep));
        assert_eq!(chosen.kept.len(), keep);
        assert!(chosen.kept.iter().all(|i| !hidden[*i as usize]));
    }
    let chosen = chosen_of(&s, &view, settings(Method::Acoustic, visible + 5));
    assert_eq!(
        chosen.kept.iter().filter(|i| hidden[**i as usize]).count(),
        5
    );
    // As printed they tie with the best, and the weakest come first: hardly any kept point lies in the beam.
    let in_beam = |chosen: &Selection| {
        let near = |i: &&u32| (s.north_m[**i as usize] - 10.0).abs() < 0.4;
        chosen.kept.iter().filter(near).count()
    };
    let [paper, mended] = [Method::Paper, Method::Acoustic]
        .map(|method| in_beam(&chosen_of(&s, &view, settings(method, 1000))));
    assert!(paper * 4 < mended, "paper {paper}, mended {mended}");
}

// Choices

#[test]
fn probabilities_add_up_to_the_number_to_keep() {
    let s = relief(1);
    for slack_m in [0.0, 10.0] {
        let mut energies = Energies::default();
        for keep in [1, 176, 1000, 3000, 5125, 20_000] {
            let settings = settings(Method::Unbiased, keep);
            energies.evaluate(&s, s.len(), &looking_east(slack_m), &settings, None);
            let rule = Selection::default().rule(&energies, s.len(), &settings);
            let Rule::Probability { per_energy } = rule else {
                panic!("{rule:?}");
            };
            let sum: f64 = (0..s.len())
                .map(|i| probability(per_energy, &energies, i))
                .sum();
            assert!(
                (sum / keep as f64 - 1.0).abs() < 1e-9,
                "slack {slack_m}: {sum} want {keep}"
            );
        }
    }
}

#[test]
fn the_expected_energy_of_any_part_is_unbiased_at_every_retention() {
    let s = relief(3);
    let view = View {
        shadows: false,
        ..looking_east(10.0)
    };
    let energy = |i: usize| {
        let ray = (s.position_m(i) - SONAR_M).normalize();
        let cos = -DVec3::from_array(s.normal[i].map(f64::from)).dot(ray);
        s.strength[i].norm_sqr() * cos.max(0.0).powi(2)
    };
    // Two halves of the scene by easting: a level that holds only in total would fail here.
    for (low_m, high_m) in [(15.0, 40.0), (40.0, 75.0)] {
        let within = |i: usize| (low_m..high_m).contains(&s.east_m[i]);
        let all: f64 = (0..s.len()).filter(|i| within(*i)).map(energy).sum();
        for keep in [176, 1000, 3000, 5125] {
            let (mut sum, mut kept) = (0.0, 0);
            const SEEDS: u64 = 64;
            for seed in 0..SEEDS {
                let settings = Settings {
                    seed,
                    ..settings(Method::Unbiased, keep)
                };
                let chosen = chosen_of(&s, &view, settings);
                kept += chosen.kept.len();
                for (&i, gain) in chosen.kept.iter().zip(&chosen.gain) {
                    if within(i as usize) {
                        sum += energy(i as usize) * gain * gain;
                    }
                }
            }
            let got_db = 10.0 * (sum / SEEDS as f64 / all).log10();
            // 64 draws of at least some 80 in each half: a standard error of 1.5 %, 0.06 dB, or less.
            assert!(
                got_db.abs() < 0.3,
                "keep {keep}, {low_m}..{high_m} m: {got_db} dB"
            );
            let mean_kept = kept as f64 / SEEDS as f64;
            // Poisson sampling: standard error sqrt(N/64).
            assert!(
                (mean_kept - keep as f64).abs() < 5.0 * (keep as f64 / 64.0).sqrt(),
                "{mean_kept} kept of {keep}"
            );
        }
    }
}

#[test]
fn smaller_selections_are_subsets_of_larger_ones_and_gains_are_at_least_one() {
    let s = relief(1);
    for method in [Method::Unbiased, Method::Acoustic] {
        let mut larger: Option<Vec<u32>> = None;
        for keep in [20_000, 5125, 3000, 1000, 176, 20, 1, 0] {
            let chosen = chosen_of(&s, &looking_east(0.0), settings(method, keep));
            if let Some(larger) = larger {
                assert!(
                    chosen.kept.iter().all(|i| larger.binary_search(i).is_ok()),
                    "{method:?} {keep}"
                );
            }
            assert!(chosen.gain.iter().all(|g| *g >= 1.0));
            larger = Some(chosen.kept);
        }
    }
}

#[test]
fn permanent_numbers_are_uniform_and_depend_on_position_and_seed() {
    let s = relief(1);
    let mut numbers: Vec<f64> = (0..s.len()).map(|i| permanent_number(&s, i, 7)).collect();
    assert_eq!(
        permanent_number(&relief(99), 5, 7),
        numbers[5],
        "speckle does not matter"
    );
    let other: Vec<f64> = (0..s.len()).map(|i| permanent_number(&s, i, 8)).collect();
    let correlation = numbers
        .iter()
        .zip(&other)
        .map(|(a, b)| (a - 0.5) * (b - 0.5))
        .sum::<f64>()
        * 12.0
        / s.len() as f64;
    assert!(
        correlation.abs() < 5.0 / (s.len() as f64).sqrt(),
        "{correlation}"
    );
    numbers.sort_by(f64::total_cmp);
    let count = numbers.len() as f64;
    let worst = numbers
        .iter()
        .enumerate()
        .map(|(k, u)| (u - (k as f64 + 0.5) / count).abs())
        .fold(0.0, f64::max);
    // Kolmogorov-Smirnov at p = 0.001: 1.95 / sqrt(n).
    assert!(worst < 1.95 / count.sqrt(), "{worst}");
}

#[test]
fn deterministic_targets_stay_as_they_are() {
    let mut s = relief(1);
    let free = s.len();
    for k in 0..10 {
        let far_m = DVec3::new(500.0, 0.0, f64::from(k));
        s.push(far_m, [0.0; 3], Complex64::from(1e-9), ScatterLaw::Point);
    }
    for method in Method::ALL {
        for keep in [0, 1, 176] {
            let chosen = select(&s, free, &looking_east(0.0), &settings(method, keep));
            let seabed = chosen.kept.len() - 10;
            let last: Vec<usize> = chosen.kept[seabed..]
                .iter()
                .map(|i| *i as usize - free)
                .collect();
            assert_eq!(last, [0, 1, 2, 3, 4, 5, 6, 7, 8, 9], "{method:?}");
            assert!(chosen.gain[seabed..].iter().all(|g| *g == 1.0));
            if method != Method::Unbiased {
                assert_eq!(seabed, keep);
            }
        }
    }
}

// The stage of the ping

#[test]
fn the_selection_is_constant_within_the_slack_and_changes_little_beyond() {
    let bottom = relief(1);
    for method in [Method::Acoustic, Method::Unbiased] {
        let mut stage = Stage::new(settings(method, 1000));
        let mut before: Vec<u64> = Vec::new();
        let mut chosen = 0;
        for ping in 0..21 {
            let mut view = looking_east(0.5);
            view.apex_m.x += 0.1 * f64::from(ping);
            let mut s = bottom.clone();
            // Other scatterers appear and disappear outside the beam without effect on the rest.
            push(&mut s, DVec3::new(60.0 + f64::from(ping), 40.0, 30.0), 1e-3);
            let counts = stage.thin(&mut s, usize::MAX, &view);
            chosen += counts.chosen;
            assert_eq!(counts.kept, s.len() as u64);
            let after: Vec<u64> = (0..s.len())
                .filter(|i| s.north_m[*i] < 50.0)
                .map(|i| s.north_m[i].to_bits())
                .collect();
            if counts.chosen == 0 {
                assert!(after == before, "{method:?} ping {ping}");
            } else if method == Method::Unbiased && ping > 0 {
                let stay = after.iter().filter(|n| before.contains(n)).count();
                assert!(
                    stay * 4 > after.len(),
                    "ping {ping}: {stay} of {} stay",
                    after.len()
                );
            }
            before = after;
        }
        assert_eq!(chosen, 4, "{method:?}: at 0, 0.6, 1.2 and 1.8 m");
    }
}

#[test]
fn a_thinned_ping_is_the_selection_in_its_order_with_its_gains() {
    let bottom = relief(1);
    let (view, settings) = (looking_east(0.5), settings(Method::Unbiased, 500));
    let mut thinned = bottom.clone();
    Stage::new(settings).thin(&mut thinned, usize::MAX, &view);
    let mut want = Scatterers::default();
    select(&bottom, bottom.len(), &view, &settings).gather(&bottom, &mut want);
    assert_eq!(thinned.strength, want.strength);
    assert_eq!(thinned.north_m, want.north_m);
}

// Collapse

#[test]
fn a_quadric_is_the_squared_distance_from_its_planes() {
    let normal = DVec3::new(1.0, 2.0, -2.0) / 3.0;
    let q = Quadric::of_plane(DVec3::new(1.0, 0.0, 0.0), normal, 2.0);
    for (p, distance) in [
        (DVec3::new(1.0, 0.0, 0.0), 0.0),
        (DVec3::new(1.0, 0.0, 0.0) + normal * 0.3, 0.3),
        (DVec3::new(1.0, 1.0, 1.0), 0.0),
        (DVec3::ZERO, 1.0 / 3.0),
    ] {
        let (got, want) = (q.at(p), 2.0 * distance * distance);
        assert!((got - want).abs() < 1e-14, "{p}: {got} want {want}");
    }
}

fn lattice(side: usize, down_m: impl Fn(f64, f64) -> f64) -> (Vec<DVec3>, Vec<[u32; 3]>) {
    let places = (0..side * side)
        .map(|k| {
            let (n, e) = ((k / side) as f64, (k % side) as f64);
            DVec3::new(n, e, down_m(n, e))
        })
        .collect();
    let at = |r: usize, c: usize| (r * side + c) as u32;
    let triangles = (0..side - 1)
        .flat_map(|r| (0..side - 1).map(move |c| (r, c)))
        .flat_map(|(r, c)| {
            [
                [at(r, c), at(r, c + 1), at(r + 1, c + 1)],
                [at(r, c), at(r + 1, c + 1), at(r + 1, c)],
            ]
        })
        .collect();
    (places, triangles)
}

#[test]
fn a_plane_collapses_to_its_corners_and_a_ridge_keeps_its_crest() {
    let (places, triangles) = lattice(12, |n, e| 0.1 * n + 0.2 * e);
    let got = collapse(&places, &triangles, 4);
    assert_eq!(got.kept, [0, 11, 132, 143], "the rim holds the corners");
    assert_eq!(got.area_share.iter().sum::<f64>(), 144.0);
    let area: f64 = got
        .triangles
        .iter()
        .map(|t| {
            let [a, b, c] = t.map(|i| places[i as usize]);
            (b - a).cross(c - a).length() / 2.0
        })
        .sum();
    assert!(
        (area - 121.0 * (1.0f64 + 0.01 + 0.04).sqrt()).abs() < 1e-9,
        "{area}"
    );
    // A roof: after much collapsing the remaining corners lie on the crest and at the corners.
    let (places, triangles) = lattice(21, |_, e| (e - 10.0).abs());
    let got = collapse(&places, &triangles, 6);
    let crest = got.kept.iter().filter(|i| **i % 21 == 10).count();
    assert_eq!((got.kept.len(), crest), (6, 2), "{:?}", got.kept);
}

#[test]
fn collapse_keeps_the_requested_number_and_removes_flat_parts_first() {
    let cloud = paper::cloud(PaperShape::Relief, 1, 1, -20.0);
    let places: Vec<DVec3> = (0..cloud.scatterers.len())
        .map(|i| cloud.scatterers.position_m(i))
        .collect();
    let got = collapse(&places, &cloud.triangles, 3000);
    assert_eq!(got.kept.len(), 3000);
    assert_eq!(got.area_share.iter().sum::<f64>(), places.len() as f64);
    let sloping = |i: usize| cloud.scatterers.normal[i][2] > -0.999;
    let share = |indices: &mut dyn Iterator<Item = usize>| {
        let (mut all, mut sloped) = (0.0, 0.0);
        for i in indices {
            all += 1.0;
            sloped += f64::from(u8::from(sloping(i)));
        }
        sloped / all
    };
    let before = share(&mut (0..places.len()));
    let after = share(&mut got.kept.iter().map(|i| *i as usize));
    assert!(
        after > 2.0 * before,
        "{after} of the kept slope, {before} of all"
    );
}

// Degenerate input

#[test]
fn degenerate_scenes_have_defined_selections() {
    let empty = Scatterers::default();
    let mut one = Scatterers::default();
    push(&mut one, DVec3::new(10.0, 20.0, 30.0), 1.0);
    let mut same = Scatterers::default();
    (0..50).for_each(|_| push(&mut same, DVec3::new(10.0, 20.0, 30.0), 1.0));
    let flat = patch(20, 0.5, |_, _| 30.0);
    let mut silent = flat.clone();
    silent.strength.fill(Complex64::ZERO);
    for method in Method::ALL {
        for weights in [
            Weights::PAPER,
            Weights::ECHO,
            Weights {
                curvature: 1.0,
                scattering: 0.0,
                axis: 0.0,
                echo: 0.0,
            },
        ] {
            for (name, s) in [
                ("empty", &empty),
                ("one", &one),
                ("same", &same),
                ("flat", &flat),
                ("silent", &silent),
            ] {
                for keep in [0, 1, 10, 1000] {
                    let settings = Settings {
                        weights,
                        ..settings(method, keep)
                    };
                    let chosen = chosen_of(s, &looking_east(0.0), settings);
                    if method != Method::Unbiased || keep == 1000 {
                        let want = keep.min(s.len());
                        assert_eq!(chosen.kept.len(), want, "{method:?} {name} {keep}");
                    }
                    assert!(chosen.gain.iter().all(|g| g.is_finite()));
                }
            }
        }
    }
}

#[test]
fn with_everything_in_shadow_the_requested_number_is_still_kept_and_unbiased_keeps_none() {
    // A deterministic wall in front of everything.
    let mut s = Scatterers::default();
    for k in 0..2000 {
        let wall_m = DVec3::new(10.0 + f64::from(k) * 1e-4, 1.0, -100.0);
        push(&mut s, wall_m, 0.0);
    }
    for k in 0..500 {
        let behind_m = DVec3::new(10.0 + f64::from(k) * 1e-3, 40.0, 30.0);
        push(&mut s, behind_m, 1.0);
    }
    let view = looking_east(0.0);
    let chosen = chosen_of(&s, &view, settings(Method::Acoustic, 2100));
    assert_eq!(chosen.kept.len(), 2100);
    let mut energies = Energies::default();
    let unbiased = settings(Method::Unbiased, 100);
    energies.evaluate(&s, s.len(), &view, &unbiased, None);
    energies.hidden.fill(true);
    let mut selection = Selection::default();
    let rule = selection.rule(&energies, s.len(), &unbiased);
    selection.apply(rule, &s, &energies, s.len(), 1);
    assert!(selection.kept.is_empty(), "nothing can be heard");
}

fn any_scatterers() -> impl Strategy<Value = Vec<([f64; 3], [f32; 3], f64)>> {
    let odd = prop_oneof![
        8 => -50.0..50.0f64,
        1 => Just(0.0),
        1 => proptest::num::f64::ANY,
    ];
    let odd_small = prop_oneof![8 => -1.0..1.0f32, 1 => proptest::num::f32::ANY];
    proptest::collection::vec(
        (
            proptest::array::uniform3(odd.clone()),
            proptest::array::uniform3(odd_small),
            odd,
        ),
        0..60,
    )
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(300))]

    #[test]
    fn any_scatterers_are_simplified_without_panic(
        raw in any_scatterers(),
        keep in 0..70usize,
        free in 0..70usize,
        apex in proptest::array::uniform3(-50.0..50.0f64),
    ) {
        let mut s = Scatterers::default();
        for (at, normal, strength) in &raw {
            s.push(DVec3::from_array(*at), *normal, Complex64::from(*strength), ScatterLaw::Lambert);
        }
        let free = free.min(s.len());
        let view = View { apex_m: DVec3::from_array(apex), ..looking_east(0.1) };
        for method in Method::ALL {
            let settings = Settings { weights: Weights { echo: 1.0, ..Weights::PAPER }, ..settings(method, keep) };
            let chosen = select(&s, free, &view, &settings);
            prop_assert!(chosen.kept.len() >= s.len() - free && chosen.kept.len() <= s.len());
            prop_assert!(chosen.kept.windows(2).all(|w| w[0] < w[1]));
            if method != Method::Unbiased {
                prop_assert_eq!(chosen.kept.len(), s.len() - free + keep.min(free));
            }
        }
        let places: Vec<DVec3> = (0..s.len()).map(|i| s.position_m(i)).collect();
        let triangles: Vec<[u32; 3]> = (0..s.len() as u32).map(|i| [i, i * 7 % 61, i * 13 % 59]).collect();
        let got = collapse(&places, &triangles, keep);
        prop_assert!(got.kept.len() <= s.len() && got.kept.len() >= keep.min(s.len()));
    }

    #[test]
    fn the_area_of_collapsed_corners_goes_to_the_kept_ones(
        heights in proptest::collection::vec(-1.0..1.0f64, 64),
        keep in 4..64usize,
    ) {
        let (places, triangles) = lattice(8, |n, e| heights[(n * 8.0 + e) as usize]);
        let got = collapse(&places, &triangles, keep);
        prop_assert!((got.area_share.iter().sum::<f64>() - 64.0).abs() < 1e-9);
        prop_assert!(got.triangles.iter().flatten().all(|i| got.kept.contains(i)));
    }
}

#[test]
fn the_axis_energy_is_the_two_way_pattern_and_reaches_as_far_as_the_slack() {
    let mut s = Scatterers::default();
    for n in [10.0, 10.3, 10.6] {
        push(&mut s, DVec3::new(n, 40.0, 30.0), 1.0);
    }
    let axis_only = Settings {
        weights: Weights {
            curvature: 0.0,
            scattering: 0.0,
            axis: 1.0,
            echo: 0.0,
        },
        ..settings(Method::Acoustic, 1)
    };
    let mut energies = Energies::default();
    energies.evaluate(&s, s.len(), &looking_east(0.0), &axis_only, None);
    for (i, off_m) in [(1, 0.3), (2, 0.6)] {
        let sine: f64 = off_m / (off_m * off_m + 2500.0f64).sqrt();
        let x = PI * 90.0 * sine;
        let want = (x.sin() / x).powi(4);
        assert!(
            (energies.energy[i] - want).abs() < 1e-12,
            "{} want {want}",
            energies.energy[i]
        );
    }
    energies.evaluate(&s, s.len(), &looking_east(0.31), &axis_only, None);
    assert_eq!(energies.energy[1], 1.0, "within the slack");
    assert!(energies.energy[2] < 1.0);
}
