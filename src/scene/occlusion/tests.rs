//! Shadows compared with rays cast one by one.

use std::collections::HashSet;
use std::path::{Path, PathBuf};

use glam::{DVec2, DVec3};
use rayon::prelude::*;

use crate::Scene;
use crate::read::Survey;
use crate::seabed::Surface;
use crate::unit_tests::{self, Disk, seabed, surveyed};
use echotank_config::spec::{OcclusionSpec, SceneSpec, SeabedFileSpec, SeabedShape};
use echotank_core::scene::{Footprint, Scatterers};

const ROWS: usize = 61;
/// Metres.
const CELL: f64 = 2.0;
const DENSITY: f64 = 4.0;
const SPACING: f64 = 0.5;
const RANGE: f64 = 45.0;

/// Writes a grid of depths to a file, its centre at the scene's origin.
fn written(depth_m: impl Fn(f64, f64) -> f64) -> (tempfile::TempDir, PathBuf) {
    let half = (ROWS - 1) as f64 / 2.0;
    let mut text = format!("ncols {ROWS} nrows {ROWS} xllcorner 0 yllcorner 0 cellsize {CELL}\n");
    for row in 0..ROWS {
        for col in 0..ROWS {
            // The northern row first.
            let (n, e) = ((half - row as f64) * CELL, (col as f64 - half) * CELL);
            text += &format!("{:.6} ", depth_m(n, e));
        }
    }
    unit_tests::written("ground.asc", &text)
}

fn spec(path: PathBuf, occlusion: OcclusionSpec) -> SceneSpec {
    SceneSpec {
        seed: 7,
        occlusion,
        memory_limit_bytes: 1 << 26,
        ..unit_tests::spec(Some(seabed(surveyed(path), DENSITY, false)), 0)
    }
}

fn gathered(spec: &SceneSpec, footprints: &[Footprint]) -> (Vec<DVec3>, u64) {
    let mut scene = Scene::open(&Disk, spec).unwrap();
    scene.place(100.0, -50.0);
    let mut out = Scatterers::default();
    let anchor_m = DVec3::new(100.0, -50.0, 0.0);
    let moved: Vec<Footprint> = footprints
        .iter()
        .map(|f| Footprint {
            apex_m: f.apex_m + anchor_m,
            receiver_m: f.receiver_m + anchor_m,
            ..*f
        })
        .collect();
    let counts = scene.gather(&moved, &mut out);
    let places = (0..out.len()).map(|i| out.position_m(i) - anchor_m);
    (places.collect(), counts.shadowed)
}

fn key(at: DVec3) -> [i64; 2] {
    [at.x, at.y].map(|m| (m * 1e6).round() as i64)
}

/// The ground as `Scene` opens it.
fn ground(path: &Path) -> Surface {
    let survey = Survey::open(&Disk, &SeabedFileSpec::of(path.to_owned())).unwrap();
    Surface::from_grid(survey.field, false, 0.0, 0.0, 16.0)
}

/// Whether the ground rises above the straight line from a point to an eye, sampled every 2 centimetres.
fn hidden(ground: &Surface, at_m: DVec3, eye_m: DVec3) -> bool {
    let offset_m = eye_m - at_m;
    let steps = (offset_m.truncate().length() / 0.02).ceil();
    (1..steps as usize).any(|k| {
        let p = at_m + offset_m * (k as f64 / steps);
        // The position is rounded to 2 um.
        ground
            .sample(p.x, p.y)
            .is_some_and(|g| g.down_m < p.z - 1e-5)
    })
}

fn hills(n: f64, e: f64) -> f64 {
    20.0 - 3.0 * (n / 7.0).sin() * (e / 9.0 + 1.0).cos() - 1.5 * ((n + 2.0 * e) / 5.0).sin()
}

/// A wall 6 m high from north to south, with a gap.
fn wall(n: f64, e: f64) -> f64 {
    let on_wall = (15.0..=19.0).contains(&e) && !(-6.0..=6.0).contains(&n);
    if on_wall { 14.0 } else { 20.0 }
}

/// An even slope: nothing may be hidden.
fn slope(n: f64, e: f64) -> f64 {
    20.0 + 0.2 * n - 0.1 * e
}

#[test]
fn shadows_are_those_of_rays_cast_one_by_one_within_a_spacing() {
    let eyes_m = [
        (DVec3::new(-3.0, 1.0, 9.0), DVec3::new(-3.0, 1.0, 9.0)),
        (DVec3::new(4.3, -2.0, 12.0), DVec3::new(2.1, -3.0, 12.5)),
    ];
    for (name, depth_m) in [
        ("hills", hills as fn(f64, f64) -> f64),
        ("wall", wall),
        ("slope", slope),
    ] {
        let (_keep, path) = written(depth_m);
        let ground = ground(&path);
        for (apex_m, receiver_m) in eyes_m {
            let footprint = Footprint {
                receiver_m,
                ..Footprint::all_round(apex_m, RANGE)
            };
            let (all, none) = gathered(&spec(path.clone(), OcclusionSpec::None), &[footprint]);
            assert_eq!(none, 0);
            let (seen, shadowed) =
                gathered(&spec(path.clone(), OcclusionSpec::Horizon), &[footprint]);
            assert_eq!(all.len() as u64, seen.len() as u64 + shadowed);
            let seen: HashSet<_> = seen.into_iter().map(key).collect();
            let cast = |at: DVec3| hidden(&ground, at, apex_m) || hidden(&ground, at, receiver_m);
            let (mut edge, mut wrong, mut truth) = (0, Vec::new(), 0);
            let wanted: Vec<bool> = all.par_iter().map(|&at| cast(at)).collect();
            for (&at, want) in all.iter().zip(wanted) {
                truth += u64::from(want);
                let got = !seen.contains(&key(at));
                if got == want {
                    continue;
                }
                // Correct one spacing away: the edge of a shadow.
                let near = (0..32).any(|k| {
                    let (sin, cos) = (f64::from(k) * std::f64::consts::TAU / 32.0).sin_cos();
                    [0.1, 0.2, 0.4, 0.7, 1.0].into_iter().any(|share| {
                        let p = at.truncate() + DVec2::new(cos, sin) * SPACING * share;
                        ground
                            .sample(p.x, p.y)
                            .is_some_and(|g| cast(p.extend(g.down_m)) == got)
                    })
                });
                match near {
                    true => edge += 1,
                    false => wrong.push(at),
                }
            }
            println!(
                "{name}: {} scatterers, {truth} in shadow, {shadowed} found, {edge} at an edge, {} wrong",
                all.len(),
                wrong.len()
            );
            assert!(
                wrong.is_empty(),
                "{name}: {:?}",
                &wrong[..wrong.len().min(5)]
            );
            match name {
                "slope" => assert_eq!(shadowed, 0),
                _ => assert!(truth > 500, "{name}: only {truth} in shadow"),
            }
        }
    }
}

#[test]
fn the_same_is_hidden_whatever_the_number_of_threads() {
    let (_keep, path) = written(hills);
    let footprint = Footprint {
        receiver_m: DVec3::new(2.1, -3.0, 12.5),
        ..Footprint::all_round(DVec3::new(4.3, -2.0, 12.0), RANGE)
    };
    for rule in [OcclusionSpec::Horizon, OcclusionSpec::Paper] {
        let [one, two] = [1, 2].map(|threads| {
            let pool = rayon::ThreadPoolBuilder::new()
                .num_threads(threads)
                .build()
                .unwrap();
            pool.install(|| gathered(&spec(path.clone(), rule), &[footprint]))
        });
        assert!(one.1 > 500, "{rule:?}: {} in shadow", one.1);
        assert!(one == two, "{rule:?}");
    }
}

#[test]
fn the_papers_rule_ignores_an_obstacle_where_the_ground_behind_it_rises() {
    // A ridge 6 m high from east 10 to 14; behind it the ground lies at 20 m and rises to the east, still far below the ridge's shadow.
    let ridge = |_: f64, e: f64| match e {
        e if (10.0..=14.0).contains(&e) => 14.0,
        e => 20.0 - 0.15 * (e - 14.0).max(0.0),
    };
    let (_keep, path) = written(ridge);
    let footprint = Footprint::all_round(DVec3::new(0.0, 0.0, 12.0), RANGE);
    let strip = |occlusion| {
        let (seen, shadowed) = gathered(&spec(path.clone(), occlusion), &[footprint]);
        let inside = |at: &&DVec3| at.x.abs() < 5.0 && (18.0..38.0).contains(&at.y);
        (seen.iter().filter(inside).count(), shadowed)
    };
    let (all, horizon, paper) = (
        strip(OcclusionSpec::None),
        strip(OcclusionSpec::Horizon),
        strip(OcclusionSpec::Paper),
    );
    println!(
        "strip behind the ridge: {} scatterers, horizon shows {}, paper {}",
        all.0, horizon.0, paper.0
    );
    // The line over the ridge's far edge (14 m out, 2 m below the eye) reaches 17.4 m depth at 38 m, where the ground lies at 16.4.
    let insonified_from_m = (0..2400)
        .map(|k| 14.0 + 0.01 * f64::from(k))
        .find(|e| 12.0 + e * (2.0 / 14.0) > 20.0 - 0.15 * (e - 14.0))
        .unwrap();
    let want = 10.0 * (38.0 - insonified_from_m).max(0.0) * DENSITY;
    assert!(
        (horizon.0 as f64 - want).abs() < 60.0,
        "{} against {want}",
        horizon.0
    );
    assert!(
        paper.0 as f64 > 0.8 * all.0 as f64,
        "the paper's rule shows {}",
        paper.0
    );
    assert!(paper.1 < horizon.1 && paper.1 > 0);
}

#[test]
fn a_sphere_in_the_water_casts_its_geometric_shadow() {
    let (_keep, path) = written(|_, _| 20.0);
    let ball = "[[target]]\nname = \"ball\"\nshape = \"sphere\"\nnorth_m = 5.0\neast_m = 12.0\ndown_m = 15.0\nradius_m = 1.5\n";
    let (_keep_targets, targets) = unit_tests::written("ball.toml", ball);
    let (center_m, radius_m) = (DVec3::new(5.0, 12.0, 15.0), 1.5);
    let (apex_m, receiver_m) = (DVec3::new(0.0, 0.0, 5.0), DVec3::new(0.5, 0.3, 5.2));
    let footprint = Footprint {
        receiver_m,
        ..Footprint::all_round(apex_m, RANGE)
    };
    for shape in ["grid", "plane"] {
        let mut open = spec(path.clone(), OcclusionSpec::None);
        if shape == "plane" {
            open.seabed.as_mut().unwrap().shape = SeabedShape::Plane {
                depth_m: 20.0,
                slope_north: 0.0,
                slope_east: 0.0,
            };
        }
        let (all, _) = gathered(&open, &[footprint]);
        let mut shaded = open.clone();
        shaded.targets = Some(targets.clone());
        shaded.occlusion = OcclusionSpec::Horizon;
        let (seen, _) = gathered(&shaded, &[footprint]);
        let seen: HashSet<_> = seen.into_iter().map(key).collect();
        let blocked = |at: DVec3, eye_m: DVec3| {
            let along = (eye_m - at).normalize();
            let to = center_m - at;
            (to - along * to.dot(along)).length() < radius_m && to.dot(along) > 0.0
        };
        let mut dark = 0;
        for at in all {
            let want = blocked(at, apex_m) || blocked(at, receiver_m);
            dark += usize::from(want);
            assert_eq!(!seen.contains(&key(at)), want, "{shape}: {at}");
        }
        assert!(dark > 50, "{shape}: {dark} in the shadow");
    }
}
