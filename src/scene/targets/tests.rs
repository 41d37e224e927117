//! Tests of target files, of shapes against closed forms, and of strengths.

use std::path::Path;

use super::mesh::Mesh;
use super::surface::SurfacePoint;
use super::*;
use crate::read::TriangleMesh;
use crate::unit_tests::Disk;

fn meshes_in(path: &Path) -> MeshFolder<'_> {
    MeshFolder { files: &Disk, path }
}

/// Targets of a table on a level seabed, with meshes from `folder`.
fn parsed(text: &str, folder: &Path, seed: u64) -> Result<Targets, crate::read::text::TextError> {
    let meshes = Some(meshes_in(folder));
    Targets::parse(text.as_bytes(), meshes, seed, |_, _| Some(30.0))
}

const HEAD: &str = "name,north_m,east_m,height_above_seabed_m,target_strength_db\n";

#[test]
fn a_target_stands_at_its_height_over_the_seabed_with_the_pressure_of_its_strength() {
    let text = format!("{HEAD}wreck A,10,-20,1.5,6\nmine,0,0,0,-20\n");
    let targets = parse(text.as_bytes(), |n, e| Some(50.0 + 0.1 * n + 0.2 * e)).unwrap();
    assert_eq!(targets[0].name, "wreck A");
    assert_eq!(targets[0].position_m, DVec3::new(10.0, -20.0, 45.5));
    let got = strength(&targets[0]).re;
    assert!(
        (got - 1.995_262_314_968_88).abs() < 1e-12,
        "6 dB are a pressure of {got}"
    );
    assert_eq!(strength(&targets[1]), Complex64::from(0.1));
}

#[test]
fn targets_without_a_seabed_or_with_a_repeated_name_are_rejected_by_name() {
    let message = |rows: &str, seabed: Option<f64>| {
        parse(format!("{HEAD}{rows}").as_bytes(), |_, _| seabed)
            .unwrap_err()
            .to_string()
    };
    assert_eq!(
        message("a,1,2,0,0\n", None),
        "line 2, column `name`: `a`: needs a seabed below it; at north 1, east 2 the scene has none"
    );
    assert_eq!(
        message("a,1,2,0,0\na,3,4,0,0\n", Some(1.0)),
        "line 3, column `name`: `a`: must be unique among the targets"
    );
    assert_eq!(
        message("a,1,2,-1,0\n", Some(1.0)),
        "line 2, column `height_above_seabed_m`: `-1`: must lie in 0 ..= 20000"
    );
    assert_eq!(
        message(",1,2,0,0\n", Some(1.0)),
        "line 2, column `name`: ``: must have 1 to 64 characters"
    );
}

proptest::proptest! {
    #[test]
    fn any_bytes_yield_targets_or_an_error(tail in ".{0,80}") {
        let _ = parse(tail.as_bytes(), |_, _| Some(1.0));
        let _ = parse(format!("{HEAD}a,1,2,0,0\n{tail}").as_bytes(), |_, _| Some(1.0));
    }
}

// Shapes

/// Whether a point lies inside, by the definition of the shape and not by its ray test. Not implemented for meshes.
fn inside(solid: &Solid, at_m: DVec3) -> bool {
    match solid {
        Solid::Sphere { center_m, radius_m } => at_m.distance(*center_m) < *radius_m,
        Solid::Cylinder { ends_m, radius_m } => {
            let axis = ends_m[1] - ends_m[0];
            let along = (at_m - ends_m[0]).dot(axis) / axis.length_squared();
            let foot = ends_m[0] + axis * along;
            (0.0..=1.0).contains(&along) && at_m.distance(foot) < *radius_m
        }
        Solid::Box {
            center_m,
            axes,
            half_m,
        } => {
            let own = axes.inverse() * (at_m - center_m);
            own.abs().cmplt(*half_m).all()
        }
        Solid::Rope {
            vertices_m,
            radius_m,
        } => {
            let link = |pair: &[DVec3]| {
                let ends_m = [pair[0], pair[1]];
                inside(
                    &Solid::Cylinder {
                        ends_m,
                        radius_m: *radius_m,
                    },
                    at_m,
                )
            };
            let joint = |v: &DVec3| at_m.distance(*v) < *radius_m;
            vertices_m.windows(2).any(link) || vertices_m[1..vertices_m.len() - 1].iter().any(joint)
        }
        // Not used: meshes are compared with boxes.
        Solid::Mesh(_) => false,
    }
}

fn shapes() -> Vec<(&'static str, Solid)> {
    let at = DVec3::new(0.3, -0.2, 0.1);
    vec![
        (
            "sphere",
            Solid::Sphere {
                center_m: at,
                radius_m: 1.1,
            },
        ),
        (
            "cylinder",
            Solid::Cylinder {
                ends_m: [
                    at - DVec3::new(0.5, 0.4, 0.9),
                    at + DVec3::new(0.5, 0.4, 0.9),
                ],
                radius_m: 0.4,
            },
        ),
        (
            "box",
            Solid::Box {
                center_m: at,
                axes: glam::DMat3::from_euler(glam::EulerRot::XYZ, 0.3, 1.0, -0.7),
                half_m: DVec3::new(0.4, 0.9, 0.6),
            },
        ),
        (
            "rope",
            Solid::Rope {
                vertices_m: vec![
                    DVec3::new(-1.2, 0.0, 0.1),
                    DVec3::new(0.0, 0.5, -0.2),
                    DVec3::new(0.9, -0.7, 0.3),
                    DVec3::new(0.9, -0.7, -1.0),
                ],
                radius_m: 0.2,
            },
        ),
    ]
}

fn mesh_of(vertices_m: Vec<DVec3>, triangles: Vec<[u32; 3]>) -> Option<Mesh> {
    Mesh::new(&TriangleMesh {
        vertices_m,
        triangles,
    })
}

fn cube_mesh(center_m: DVec3, axes: glam::DMat3, half_m: DVec3) -> Mesh {
    let (corners, triangles) = cube();
    let place = |corner: [f64; 3]| center_m + axes * ((DVec3::from(corner) - 6.0) * half_m);
    let triangles = triangles.into_iter().map(|t| t.map(|k| k as u32));
    mesh_of(
        corners.into_iter().map(place).collect(),
        triangles.collect(),
    )
    .unwrap()
}

fn unit(a: f64, b: f64) -> DVec3 {
    let z = 2.0 * a - 1.0;
    let (sin, cos) = (std::f64::consts::TAU * b).sin_cos();
    let ring = (1.0 - z * z).sqrt();
    DVec3::new(ring * cos, ring * sin, z)
}

proptest::proptest! {
    #![proptest_config(proptest::prelude::ProptestConfig::with_cases(300))]

    #[test]
    fn rays_meet_shapes_where_their_definition_requires(
        origin in proptest::array::uniform3(-3.0..3.0f64),
        (a, b) in (0.0..1.0f64, 0.0..1.0f64),
    ) {
        let (origin_m, direction) = (DVec3::from_array(origin), unit(a, b));
        for (name, solid) in shapes() {
            let began = inside(&solid, origin_m);
            let hit = solid.first_hit_m(origin_m, direction);
            let until_m = hit.unwrap_or(8.0);
            // The walk can miss a chord shorter than its step. It therefore checks the hit, not the reverse.
            let step_m = 1e-3;
            let mut at_m = step_m;
            while at_m < until_m - step_m {
                let here = inside(&solid, origin_m + direction * at_m);
                // A ray leaves a rope's sphere inside the next link and meets it again: its first surface may lie inside.
                assert!(here == began || name == "rope" && began, "{name} at {at_m} of {until_m}");
                at_m += step_m;
            }
            if let Some(met_m) = hit {
                let before = inside(&solid, origin_m + direction * (met_m - 1e-7));
                let after = inside(&solid, origin_m + direction * (met_m + 1e-7));
                assert!(before != after || name == "rope" && began, "{name}: no surface at {met_m}");
                assert!(solid.hits(origin_m, direction, met_m + 1e-9));
                assert!(!solid.hits(origin_m, direction, met_m));
            }
        }
    }

    #[test]
    fn a_mesh_of_a_box_is_met_where_the_box_is(
        origin in proptest::array::uniform3(-3.0..3.0f64),
        (a, b) in (0.0..1.0f64, 0.0..1.0f64),
        turn in 0.0..6.0f64,
    ) {
        let (center_m, half_m) = (DVec3::new(0.1, 0.2, -0.3), DVec3::new(0.4, 0.9, 0.6));
        let axes = glam::DMat3::from_euler(glam::EulerRot::XYZ, turn, 0.4, 0.2 * turn);
        let solid = Solid::Box { center_m, axes, half_m };
        let mesh = cube_mesh(center_m, axes, half_m);
        let (origin_m, direction) = (DVec3::from_array(origin), unit(a, b));
        let (got, want) = (mesh.first_hit_m(origin_m, direction), solid.first_hit_m(origin_m, direction));
        assert!(
            (got.unwrap_or(-1.0) - want.unwrap_or(-1.0)).abs() < 1e-9,
            "got {got:?} want {want:?}"
        );
    }

    #[test]
    fn the_tree_agrees_with_a_test_of_every_triangle(
        corners in proptest::collection::vec(proptest::array::uniform9(-1.0..1.0f64), 1..60),
        (a, b) in (0.0..1.0f64, 0.0..1.0f64),
    ) {
        let vertices: Vec<DVec3> = corners
            .iter()
            .flat_map(|c| c.chunks(3).map(|v| DVec3::new(v[0], v[1], v[2])).collect::<Vec<_>>())
            .collect();
        let triangles: Vec<[u32; 3]> =
            (0..corners.len() as u32).map(|k| [3 * k, 3 * k + 1, 3 * k + 2]).collect();
        let all = mesh_of(vertices.clone(), triangles.clone()).unwrap();
        let direction = unit(a, b);
        let origin_m = -2.0 * direction;
        let one_by_one = triangles
            .iter()
            .filter_map(|t| mesh_of(vertices.clone(), vec![*t])?.first_hit_m(origin_m, direction))
            .reduce(f64::min);
        assert_eq!(all.first_hit_m(origin_m, direction), one_by_one);
    }
}

#[test]
fn rays_along_a_boxs_own_planes_and_a_cylinders_axis_are_met_too() {
    let solid = Solid::Cylinder {
        ends_m: [DVec3::ZERO, DVec3::new(0.0, 0.0, 2.0)],
        radius_m: 0.5,
    };
    let from = DVec3::new(0.1, 0.0, -3.0);
    assert_eq!(solid.first_hit_m(from, DVec3::Z), Some(3.0));
    assert_eq!(solid.first_hit_m(from, -DVec3::Z), None);
    assert_eq!(
        solid.first_hit_m(DVec3::new(0.6, 0.0, -3.0), DVec3::Z),
        None
    );
    let half_m = DVec3::splat(0.5);
    let mesh = cube_mesh(DVec3::ZERO, glam::DMat3::IDENTITY, half_m);
    for origin_m in [DVec3::new(-2.0, 0.1, 0.2), DVec3::new(-2.0, 0.5, 0.2)] {
        assert_eq!(mesh.first_hit_m(origin_m, DVec3::X), Some(1.5));
    }
    assert_eq!(mesh.first_hit_m(DVec3::new(-2.0, 0.6, 0.0), DVec3::X), None);
}

#[test]
fn scatterers_lie_on_the_surface_with_normals_outward_and_evenly_by_area() {
    let mut all = shapes();
    let (center_m, half_m) = (DVec3::new(0.1, 0.2, -0.3), DVec3::new(0.4, 0.9, 0.6));
    let mesh = Solid::Mesh(cube_mesh(center_m, glam::DMat3::IDENTITY, half_m));
    let twin = Solid::Box {
        center_m,
        axes: glam::DMat3::IDENTITY,
        half_m,
    };
    all.push(("mesh", mesh));
    for (name, solid) in &all {
        let defined = if *name == "mesh" { &twin } else { solid };
        let mut mean = DVec3::ZERO;
        const COUNT: usize = 20_000;
        let mut buried = 0;
        solid.sample(COUNT, &mut KeyedRandom::new(1, KEY_LABEL, 0), |point, _| {
            let SurfacePoint { position_m, normal } = point;
            assert!((normal.length() - 1.0).abs() < 1e-12, "{name}: {normal}");
            assert!(
                inside(defined, position_m - normal * 1e-7),
                "{name} at {position_m}"
            );
            // The lateral surface of a link may run into the next link.
            buried += usize::from(inside(defined, position_m + normal * 1e-7));
            mean += normal / COUNT as f64;
        });
        assert!(
            buried == 0 || *name == "rope" && buried < COUNT / 10,
            "{name}: {buried} buried"
        );
        // Over a closed surface the normals cancel. Six standard errors of the stratified samples are far below this limit.
        assert!(mean.length() < 0.02, "{name}: mean normal {mean}");
    }
}

#[test]
fn areas_are_the_closed_forms() {
    use std::f64::consts::PI;
    let want = [
        4.0 * PI * 1.1 * 1.1,
        2.0 * PI * 0.4 * ((1.0f64 + 0.64 + 3.24).sqrt() + 0.4),
        8.0 * (0.4 * 0.9 + 0.9 * 0.6 + 0.6 * 0.4),
    ];
    for ((name, solid), want) in shapes().iter().zip(want) {
        let got = solid.area_m2();
        assert!(
            (got / want - 1.0).abs() < 1e-12,
            "{name}: {got} want {want}"
        );
    }
}

// Strengths

/// Energy scattered to the direction `to_sonar` with random phases: the sum of |strength|^2 cos^2 over the facing side.
fn incoherent(s: &Scatterers, to_sonar: DVec3) -> f64 {
    (0..s.len())
        .map(|i| {
            let cos = DVec3::from_array(s.normal[i].map(f64::from)).dot(to_sonar);
            s.strength[i].norm_sqr() * cos.max(0.0).powi(2)
        })
        .sum()
}

fn one(text: &str, seed: u64) -> Targets {
    parsed(text, Path::new("."), seed).unwrap()
}

#[test]
fn a_spheres_target_strength_is_20_log_half_its_radius_from_everywhere() {
    const SPHERE: &str = "[[target]]\nname = 's'\nshape = 'sphere'\nnorth_m = 0\neast_m = 0\nradius_m = 1.6\ndensity_per_m2 = 60\n";
    let want_db = 20.0 * (1.6f64 / 2.0).log10();
    assert!((one(SPHERE, 1).named()[0].target_strength_db - want_db).abs() < 1e-12);
    // 150 seeds of 1930 scatterers, a third of whose energy counts: relative standard error 0.4 % of the incoherent sum.
    for (a, b) in [(0.0, 0.0), (0.5, 0.1), (0.8, 0.6), (1.0, 0.0)] {
        let mean = (0..150)
            .map(|seed| incoherent(one(SPHERE, seed).scatterers(), unit(a, b)))
            .sum::<f64>()
            / 150.0;
        let got_db = 10.0 * mean.log10();
        assert!(
            (got_db - want_db).abs() < 0.03,
            "towards {a} {b}: {got_db} want {want_db}"
        );
    }
    // With the phase of the carrier the intensity is exponential: 600 seeds have a standard error of 4 %, 0.18 dB.
    let wavenumber_per_m = 2.0 * std::f64::consts::PI / 0.00375;
    let mean = (0..600)
        .map(|seed| {
            let targets = one(SPHERE, seed);
            let s = targets.scatterers();
            let field: Complex64 = (0..s.len())
                .map(|i| {
                    let cos = DVec3::from_array(s.normal[i].map(f64::from)).x.max(0.0);
                    let phase = 2.0 * wavenumber_per_m * s.north_m[i];
                    s.strength[i] * cos * Complex64::from_polar(1.0, phase)
                })
                .sum();
            field.norm_sqr()
        })
        .sum::<f64>()
        / 600.0;
    let got_db = 10.0 * mean.log10();
    assert!(
        (got_db - want_db).abs() < 0.7,
        "coherent: {got_db} want {want_db}"
    );
}

#[test]
fn a_convex_solids_strength_is_its_mean_over_all_directions() {
    for shape in [
        "shape = 'box'\nsize_m = [1, 2, 0.5]\nheading_deg = 30",
        "shape = 'cylinder'\nradius_m = 0.5\nlength_m = 3\nelevation_deg = 20",
    ] {
        let text = format!(
            "[[target]]\nname = 'b'\nnorth_m = 0\neast_m = 0\ntarget_strength_db = -3\ndensity_per_m2 = 2000\n{shape}\n"
        );
        let targets = one(&text, 3);
        let s = targets.scatterers();
        const DIRECTIONS: usize = 2000;
        let mean = (0..DIRECTIONS)
            .map(|k| {
                // Fibonacci lattice on the sphere.
                let a = (k as f64 + 0.5) / DIRECTIONS as f64;
                incoherent(s, unit(a, (k as f64 * 0.618_033_988_749_895).fract()))
            })
            .sum::<f64>()
            / DIRECTIONS as f64;
        // Some 15000 scatterers of exponential energy have a standard error of 0.8 %, 0.04 dB.
        let got_db = 10.0 * mean.log10();
        assert!((got_db + 3.0).abs() < 0.15, "{shape}: {got_db} want -3");
        assert!((targets.named()[0].target_strength_db + 3.0).abs() < 1e-9);
        let area: f64 = (0..s.len()).map(|i| targets.area_m2(i)).sum();
        assert!((area / targets.solid(0).unwrap().area_m2() - 1.0).abs() < 1e-9);
    }
}

// Files and sets

#[test]
fn solids_stand_on_the_seabed_or_hang_at_their_depth() {
    let targets = one(
        "[[target]]\nname = 'pier'\nshape = 'cylinder'\nnorth_m = 1\neast_m = -20\nradius_m = 1\nlength_m = 12\nlambert_db = -10\n\
         [[target]]\nname = 'fish'\nnorth_m = 1\neast_m = 2\ndown_m = 7\ntarget_strength_db = -35\n\
         [[target]]\nname = 'pipe'\nshape = 'rope'\nradius_m = 0.5\nlambert_db = -10\npath_m = [[0, 0], [10, 0], [10, 5]]\n\
         [[target]]\nname = 'chain'\nshape = 'rope'\nradius_m = 0.05\nlambert_db = -10\npath_m = [[0, 0, 30], [0, 5, 2]]\n",
        1,
    );
    let names: Vec<&str> = targets.named().iter().map(|t| t.name.as_str()).collect();
    assert_eq!(names, ["pier", "fish", "pipe", "chain"]);
    assert_eq!(
        targets.named()[0].position_m,
        DVec3::new(1.0, -20.0, 24.0),
        "foot on 30 m"
    );
    assert_eq!(targets.named()[1].position_m, DVec3::new(1.0, 2.0, 7.0));
    let (low, high) = targets.solid(2).unwrap().bounds_m();
    assert_eq!(
        (low, high),
        (DVec3::new(-0.5, -0.5, 29.0), DVec3::new(10.5, 5.5, 30.0))
    );
    // Labels: every scatterer maps to its target.
    for target in 0..4 {
        assert!(targets.span(target).all(|i| targets.target_of(i) == target));
    }
    assert_eq!(
        targets.scatterers().law[targets.span(1).start],
        ScatterLaw::Point
    );
    // From above the pier's middle straight down, and beside it.
    let all: Vec<usize> = (0..targets.len()).collect();
    assert!(targets.hits(&all, DVec3::new(1.0, -20.0, 0.0), DVec3::Z, 18.1));
    assert!(!targets.hits(&all, DVec3::new(1.0, -20.0, 0.0), DVec3::Z, 17.9));
    assert!(!targets.hits(&all, DVec3::new(3.0, 8.0, 0.0), DVec3::Z, 30.0));
    // The outward path from a scatterer on a convex shape is free.
    for i in targets.span(0) {
        let s = targets.scatterers();
        let normal = DVec3::from_array(s.normal[i].map(f64::from)).normalize();
        assert!(!targets.hits(&all, s.position_m(i) + normal * 1e-5, normal, 5.0));
    }
}

#[test]
fn the_same_seed_gives_the_same_scatterers_and_targets_do_not_disturb_each_other() {
    let a = "[[target]]\nname = 'a'\nshape = 'sphere'\nnorth_m = 0\neast_m = 0\nradius_m = 1\n";
    let b = "[[target]]\nname = 'b'\nshape = 'box'\nnorth_m = 5\neast_m = 0\nsize_m = [1, 1, 1]\nlambert_db = -9\n";
    let (alone, both) = (one(a, 7), one(&format!("{a}{b}"), 7));
    let span = both.span(0);
    assert_eq!(
        alone.scatterers().strength,
        both.scatterers().strength[span.clone()]
    );
    assert_eq!(alone.scatterers().north_m, both.scatterers().north_m[span]);
    assert_ne!(alone.scatterers().strength, one(a, 8).scatterers().strength);
}

#[test]
fn every_error_of_a_toml_table_names_line_field_value_and_rule() {
    let message = |rows: &str| {
        Targets::parse(
            rows.as_bytes(),
            Some(meshes_in(Path::new("."))),
            1,
            |n, _| (n < 100.0).then_some(30.0),
        )
        .unwrap_err()
        .to_string()
    };
    let sphere = "[[target]]\nname = \"a\"\nshape = \"sphere\"\nnorth_m = 0\neast_m = 0\n";
    for (text, want) in [
        (
            format!("{sphere}radius_m = 0\n"),
            "line 6, column `radius_m`: `0`: must lie in 0.0001 ..= 10000",
        ),
        (
            format!("{sphere}radius_m = \"big\"\n"),
            "line 6, column `radius_m`: `\"big\"`: must be a number",
        ),
        (
            format!("{sphere}radius_m = nan\n"),
            "line 6, column `radius_m`: `nan`: must lie in 0.0001 ..= 10000",
        ),
        (sphere.to_owned(), "line 1, column `radius_m`: ``: is missing"),
        (
            format!("{sphere}radius_m = 1\nlength_m = 2\n"),
            "line 7: `length_m`: is not a field of a sphere; its fields are name, shape, north_m, east_m, height_above_seabed_m, down_m, target_strength_db, lambert_db, density_per_m2, velocity_m_per_s, track, radius_m",
        ),
        (
            format!("{sphere}radius_m = 1\n{sphere}radius_m = 1\n"),
            "line 8, column `name`: `\"a\"`: must be unique among the targets",
        ),
        (
            format!("{sphere}radius_m = 1\nlambert_db = -3\ntarget_strength_db = 1\n"),
            "line 8, column `target_strength_db`: `1`: must not be given with lambert_db: one determines the other",
        ),
        (
            sphere.replace("north_m = 0", "north_m = 200") + "radius_m = 1\n",
            "line 2, column `name`: `\"a\"`: needs a seabed below it; at north 200, east 0 the scene has none",
        ),
        (
            sphere.replace("sphere", "blob"),
            "line 3, column `shape`: `\"blob\"`: must be one of point, sphere, cylinder, box, rope, mesh, school, plume",
        ),
        (
            format!("{sphere}radius_m = 5000\n"),
            "line 1, column `name`: `a`: has an area of 314159265.4 m2 and would take 31415926536 scatterers; all targets together may take 4194304: lower its density_per_m2",
        ),
        (
            "[[target]]\nname = \"r\"\nshape = \"rope\"\nradius_m = 1\nlambert_db = 1\npath_m = [[0, 0], [0, 0]]\n".into(),
            "line 6, column `path_m`: `[[0, 0], [0, 0]]`: must have at least 1 mm between neighbours",
        ),
        (
            "[[targets]]\n".into(),
            "line 1: `targets`: must be [[target]]; a table of targets has no other key",
        ),
    ] {
        assert_eq!(message(&text), want, "{text}");
    }
}

proptest::proptest! {
    #[test]
    fn any_table_of_targets_is_read_or_rejected(tail in ".{0,120}", number in proptest::num::f64::ANY, shape in 0..6usize) {
        let _ = Targets::parse(tail.as_bytes(), Some(meshes_in(Path::new("."))), 1, |_, _| Some(1.0));
        let shape = ["point", "sphere", "cylinder", "box", "rope", "mesh"][shape];
        for field in ["radius_m", "length_m", "down_m", "heading_deg", "density_per_m2", "lambert_db", "scale"] {
            let text = format!("[[target]]\nname = 'a'\nshape = '{shape}'\nnorth_m = 1\neast_m = 2\nfile = '{shape}.obj'\n{field} = {number:?}\n{tail}");
            let _ = Targets::parse(text.as_bytes(), Some(meshes_in(Path::new("."))), 1, |_, _| Some(1.0));
        }
    }
}

// Meshes from files

/// A cube of side 2 about (6, 6, 6), x east, y north, z up, anticlockwise seen from outside.
fn cube() -> (Vec<[f64; 3]>, Vec<[usize; 3]>) {
    let side = |k: usize, bit: usize| if k >> bit & 1 == 1 { 7.0 } else { 5.0 };
    let vertices = (0..8).map(|k| [side(k, 0), side(k, 1), side(k, 2)]);
    let faces = [
        [0, 2, 3, 1],
        [4, 5, 7, 6],
        [0, 1, 5, 4],
        [2, 6, 7, 3],
        [0, 4, 6, 2],
        [1, 3, 7, 5],
    ];
    let triangles = faces
        .iter()
        .flat_map(|[a, b, c, d]| [[*a, *b, *c], [*a, *c, *d]]);
    (vertices.collect(), triangles.collect())
}

fn obj((vertices, triangles): &(Vec<[f64; 3]>, Vec<[usize; 3]>)) -> String {
    let mut text = String::new();
    for [x, y, z] in vertices {
        text += &format!("v {x} {y} {z}\n");
    }
    for t in triangles {
        let [a, b, c] = t.map(|k| k + 1);
        text += &format!("f {a} {b} {c}\n");
    }
    text
}

fn stl((vertices, triangles): &(Vec<[f64; 3]>, Vec<[usize; 3]>)) -> String {
    let mut text = "solid cube\n".to_owned();
    for t in triangles {
        text += "facet normal 0 0 0\nouter loop\n";
        for [x, y, z] in t.map(|k| vertices[k]) {
            text += &format!("vertex {x} {y} {z}\n");
        }
        text += "endloop\nendfacet\n";
    }
    text + "endsolid cube\n"
}

fn ply((vertices, triangles): &(Vec<[f64; 3]>, Vec<[usize; 3]>)) -> String {
    let mut text = format!(
        "ply\nformat ascii 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\nelement face {}\nproperty list uchar int vertex_indices\nend_header\n",
        vertices.len(),
        triangles.len()
    );
    for [x, y, z] in vertices {
        text += &format!("{x} {y} {z}\n");
    }
    for [a, b, c] in triangles {
        text += &format!("3 {a} {b} {c}\n");
    }
    text
}

/// A mesh of a box in every format, scaled, rotated, placed on the seabed, and with inverted triangles. It must have the position, strength and hits
/// of the box.
#[test]
fn a_mesh_of_a_file_stands_where_the_same_box_would() {
    let folder = tempfile::tempdir().unwrap();
    let cube = cube();
    let mut turned = cube.clone();
    turned.1.iter_mut().for_each(|t| t.swap(1, 2));
    let files = [
        ("cube.obj", obj(&cube)),
        ("cube.stl", stl(&cube)),
        ("cube.PLY", ply(&cube)),
        ("turned.obj", obj(&turned)),
    ];
    for (name, text) in &files {
        std::fs::write(folder.path().join(name), text).unwrap();
    }
    let common = "north_m = 3.0\neast_m = -4.0\nheading_deg = 30.0\nlambert_db = -10.0\n";
    let table = |file: &str| {
        format!(
            "[[target]]\nname = \"mesh\"\nshape = \"mesh\"\nfile = \"{file}\"\nscale = 0.5\n{common}[[target]]\nname = \"box\"\nshape = \"box\"\nsize_m = [1.0, 1.0, 1.0]\n{common}"
        )
    };
    for (name, _) in &files {
        let targets = parsed(&table(name), folder.path(), 1).unwrap();
        let (mesh, cube) = (&targets.named()[0], &targets.named()[1]);
        assert!(mesh.position_m.distance(cube.position_m) < 1e-12, "{name}");
        assert!((mesh.position_m - DVec3::new(3.0, -4.0, 29.5)).length() < 1e-12);
        assert!((mesh.target_strength_db - cube.target_strength_db).abs() < 1e-9);
        let [mesh, cube] = [0, 1].map(|k| targets.solid(k).unwrap());
        let mut met = 0;
        for k in 0..500 {
            let share = |step: f64| (f64::from(k) * step).fract() - 0.5;
            let from = DVec3::new(9.0 * share(0.754_877_666) + 3.0, -9.0, 20.0);
            let to = DVec3::new(3.0, -4.0, 29.5)
                + DVec3::new(share(0.569_840_291), share(0.32), share(0.91)) * 1.6;
            let along = (to - from).normalize();
            let [mesh_hides, cube_hides] = [0, 1].map(|k| targets.hits(&[k], from, along, 40.0));
            assert_eq!(mesh_hides, cube_hides, "{name}");
            match (mesh.first_hit_m(from, along), cube.first_hit_m(from, along)) {
                (Some(a), Some(b)) => {
                    met += 1;
                    assert!((a - b).abs() < 1e-9, "{name}: {a} {b}");
                }
                (a, b) => assert!(a.is_none() && b.is_none(), "{name}: {a:?} {b:?}"),
            }
        }
        assert!(met > 100, "{name}: only {met} rays met it");
        // Energy scattered to one side: the area of a face times mu, within the scatter of a tenth of the random draws.
        let own = targets.span(0);
        let seen: f64 = own
            .map(|i| {
                let normal = DVec3::from_array(targets.scatterers().normal[i].map(f64::from));
                let to_sonar = DVec3::new(-0.5, 3.0_f64.sqrt() / 2.0, 0.0);
                let cos = normal.dot(to_sonar).max(0.0);
                targets.scatterers().strength[i].norm_sqr() * cos * cos
            })
            .sum();
        assert!((seen / 0.1 - 1.0).abs() < 0.4, "{name}: {seen}");
    }
}

#[test]
fn files_that_are_not_meshes_are_rejected_with_line_and_reason() {
    let folder = tempfile::tempdir().unwrap();
    let cube = cube();
    for (name, bytes) in [
        ("cube.obj", obj(&cube)),
        ("cube.txt", obj(&cube)),
        ("cut.ply", ply(&cube)[..ply(&cube).len() - 40].to_owned()),
        ("flat.obj", "v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n".into()),
        ("points.obj", "v 0 0 0\nv 1 0 0\nv 2 0 0\n".into()),
        ("beyond.ply", ply(&cube).replace("3 0 2 3", "3 0 2 9")),
        ("words.stl", "solid nothing here".into()),
    ] {
        std::fs::write(folder.path().join(name), bytes).unwrap();
    }
    let table = "[[target]]\nname = \"mesh\"\nshape = \"mesh\"\nfile = \"cube.obj\"\nscale = 0.5\nnorth_m = 3.0\neast_m = -4.0\nlambert_db = -10.0\n";
    assert!(parsed(table, folder.path(), 1).is_ok());
    for (from, to, want) in [
        ("cube.obj", "none.obj", "none.obj: cannot be read"),
        ("cube.obj", "cube.txt", "must end in .obj, .stl or .ply"),
        ("cube.obj", "cut.ply", "damaged or cut short"),
        (
            "cube.obj",
            "flat.obj",
            "has no triangle with a nonzero area",
        ),
        ("cube.obj", "points.obj", "has no triangles"),
        ("cube.obj", "beyond.ply", "refers to a missing vertex"),
        ("cube.obj", "words.stl", "words.stl: "),
        ("file = \"cube.obj\"\n", "", "is missing"),
        ("scale = 0.5", "scale = 0.0", "must lie in"),
        (
            "scale = 0.5",
            "axes = \"up\"",
            "must be one of east-north-up",
        ),
        (
            "scale = 0.5",
            "size_m = [1, 1, 1]",
            "is not a field of a mesh",
        ),
        (
            "lambert_db = -10.0\n",
            "",
            "needs lambert_db or target_strength_db",
        ),
    ] {
        let error = parsed(&table.replace(from, to), folder.path(), 1).unwrap_err();
        let message = error.to_string();
        assert!(message.contains(want), "{to}: {message}");
        assert!(message.starts_with("line "), "{message}");
    }
}

/// Corners on the sphere, at every `180 / n` degrees of latitude and longitude.
fn globe(n: usize, radius_m: f64) -> (Vec<[f64; 3]>, Vec<[usize; 3]>) {
    let round = 2 * n;
    let vertices = (0..=n).flat_map(|i| {
        (0..round).map(move |j| {
            let (ring, z) = (std::f64::consts::PI * i as f64 / n as f64).sin_cos();
            let (sin, cos) = (std::f64::consts::TAU * j as f64 / round as f64).sin_cos();
            [ring * cos, ring * sin, z].map(|x| radius_m * x)
        })
    });
    let triangles = (0..n).flat_map(|i| {
        (0..round).flat_map(move |j| {
            let at = |i: usize, j: usize| i * round + j % round;
            [
                [at(i, j), at(i + 1, j), at(i + 1, j + 1)],
                [at(i, j), at(i + 1, j + 1), at(i, j + 1)],
            ]
        })
    });
    (vertices.collect(), triangles.collect())
}

/// With steps of d radians the facets lie at most R d^2 / 4 below the sphere, at R cos^2(d / 2).
#[test]
fn a_mesh_of_a_sphere_is_the_sphere_to_the_depth_of_its_facets() {
    const RADIUS: f64 = 1.5;
    let folder = tempfile::tempdir().unwrap();
    let common = "north_m = 3.0\neast_m = -4.0\ndown_m = 12.0\nlambert_db = -10.0\n";
    let mut shortfalls = Vec::new();
    for n in [12, 24, 48] {
        std::fs::write(folder.path().join("globe.obj"), obj(&globe(n, RADIUS))).unwrap();
        let table = format!(
            "[[target]]\nname = \"mesh\"\nshape = \"mesh\"\nfile = \"globe.obj\"\n{common}[[target]]\nname = \"ball\"\nshape = \"sphere\"\nradius_m = {RADIUS}\n{common}"
        );
        let targets = parsed(&table, folder.path(), 1).unwrap();
        let [mesh, ball] = [0, 1].map(|k| targets.solid(k).unwrap());
        let depth_m = RADIUS * (std::f64::consts::PI / n as f64).powi(2) / 4.0;
        let shortfall = 1.0 - mesh.area_m2() / ball.area_m2();
        let strengths = [0, 1].map(|k| targets.named()[k].target_strength_db);
        let off_db = strengths[1] - strengths[0] + 10.0 * (1.0 - shortfall).log10();
        assert!(off_db.abs() < 1e-9, "strength goes with the area: {off_db}");
        let (mut worst_m, mut met) = (0.0_f64, 0);
        for k in 0..2000 {
            let share = |step: f64| (f64::from(k) * step).fract();
            let along = unit(share(0.754_877_666), share(0.569_840_291));
            // Rays through points up to 0.9 R off the middle.
            let aside = along.any_orthonormal_vector() * (0.9 * RADIUS * share(0.32));
            let from = DVec3::new(3.0, -4.0, 12.0) + aside - along * 10.0;
            let (a, b) = (mesh.first_hit_m(from, along), ball.first_hit_m(from, along));
            let (a, b) = (a.unwrap(), b.unwrap());
            let facing = (1.0 - (aside.length() / RADIUS).powi(2)).sqrt();
            met += 1;
            // A ray meets a surface that is lower by h along its normal h / cos later, to first order; 1.3 covers the second order at 26 degrees of
            // grazing.
            assert!(
                a > b - 1e-6 && (a - b) * facing < 1.3 * depth_m,
                "{n}: {a} {b}"
            );
            worst_m = worst_m.max(a - b);
        }
        println!(
            "{n}: area short by {shortfall:.5}, hits late by {worst_m:.5} m at most, of {met}"
        );
        shortfalls.push(shortfall);
    }
    for pair in shortfalls.windows(2) {
        let ratio = pair[0] / pair[1];
        assert!(
            (ratio - 4.0).abs() < 0.2,
            "second order in the step: {ratio}"
        );
    }
}
