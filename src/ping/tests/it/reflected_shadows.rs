//! Shadows of the legs by surface and bottom, behind walls of any length and known height: which echoes come, and where shadows end.

use std::path::Path;

use echotank_ping::threads::pool;
use glam::DVec3;

use crate::multipath::{C, DIRECT, OMNI, RATE_HZ, SONAR_M, Setup, gather_pings, pings, rig};

/// Depth of the bottom, metres.
const BOTTOM_M: f64 = 20.0;
/// Cells of the grid, metres.
const CELL_M: f64 = 0.5;
/// East of the sonar and depth of the crests of two walls, metres: one on the bottom, one shallower than the sonar.
const WALLS: [[f64; 2]; 2] = [[10.0, 8.0], [-3.0, 1.0]];

/// Writes the grid and returns `[scene]` with it.
fn scene(folder: &Path, seabed: &str, more: &str) -> String {
    let (rows, cols) = (241, 401);
    let mut text = format!("ncols {cols} nrows {rows} xllcorner 0 yllcorner 0 cellsize {CELL_M}\n");
    for _ in 0..rows {
        for col in 0..cols {
            let east_m = (f64::from(col) - f64::from(cols - 1) / 2.0) * CELL_M;
            let wall = WALLS.iter().find(|wall| wall[0] == east_m);
            text += &format!("{} ", wall.map_or(BOTTOM_M, |wall| wall[1]));
        }
    }
    let path = folder.join("walls.asc");
    std::fs::write(&path, text).expect("a grid");
    format!(
        "[scene]\nocclusion = \"horizon\"\n{more}\n[scene.seabed]\nshape = \"esri-ascii\"\nvalues = \"depth\"\npath = \"{}\"\n{seabed}",
        path.display()
    )
}

/// Places of a leg to a point on the bottom, from the sonar on: horizontal distance and depth.
fn leg(name: &str, range_m: f64) -> Vec<[f64; 2]> {
    let depths_m: &[f64] = match name {
        "D" => &[SONAR_M, BOTTOM_M],
        "S" => &[SONAR_M, 0.0, BOTTOM_M],
        _ => &[SONAR_M, BOTTOM_M, 0.0, BOTTOM_M],
    };
    let spans = depths_m.windows(2).map(|d| (d[1] - d[0]).abs());
    let height_m: f64 = spans.clone().sum();
    let mut passed_m = 0.0;
    let mut places = vec![[0.0, SONAR_M]];
    for (span_m, depth_m) in spans.zip(&depths_m[1..]) {
        passed_m += span_m;
        places.push([range_m * passed_m / height_m, *depth_m]);
    }
    places
}

/// Whether no wall on the side of the point crosses a leg.
fn is_free(name: &str, east_m: f64) -> bool {
    let places = leg(name, east_m.abs());
    let mut walls = WALLS.iter().filter(|wall| wall[0] * east_m > 0.0);
    walls.all(|wall| {
        let (at_m, crest_m) = (wall[0].abs(), wall[1]);
        places.windows(2).all(|span| {
            let [[x0, z0], [x1, z1]] = [span[0], span[1]];
            !(x0..x1).contains(&at_m) || z0 + (z1 - z0) * (at_m - x0) / (x1 - x0) < crest_m
        })
    })
}

/// Pressure of the echo of a pair, both orders, and its delay.
fn predicted(east_m: f64, out: &str, back: &str) -> (f64, f64) {
    let one = |name: &str| {
        let places = leg(name, east_m.abs());
        let spans = places.windows(2);
        let length_m: f64 = spans
            .map(|s| (s[1][0] - s[0][0]).hypot(s[1][1] - s[0][1]))
            .sum();
        let coefficient = match name {
            "SB" => {
                let (density, speed) = (2.0, 1.2);
                let sine = (3.0 * BOTTOM_M - SONAR_M) / length_m;
                let inside = f64::sqrt(1.0 / (speed * speed) - (1.0 - sine * sine));
                (density * sine - inside) / (density * sine + inside)
            }
            _ => 1.0,
        };
        (length_m, coefficient)
    };
    let ((out_m, a), (back_m, b)) = (one(out), one(back));
    let orders = if out == back { 1.0 } else { 2.0 };
    (orders * a * b / (out_m * back_m), (out_m + back_m) / C)
}

const PAIRS: [[&str; 2]; 6] = [
    ["D", "D"],
    ["D", "S"],
    ["S", "S"],
    ["D", "SB"],
    ["S", "SB"],
    ["SB", "SB"],
];

/// Makes a ping with one point on the bottom, and compares the level of each pair of legs with its prediction if both legs are free, and with nothing if not.
fn check_point(folder: &Path, at_m: [f64; 2], more: &str, free: [bool; 3]) {
    let points = folder.join("points.csv");
    let row = format!("{},{},{BOTTOM_M},1", at_m[0], at_m[1]);
    let text = format!("north_m,east_m,down_m,amplitude\n{row}\n");
    std::fs::write(&points, text).expect("points");
    let more = format!("points = \"{}\"\n{more}", points.display());
    let scene = scene(folder, "lambert_db = -100.0\ndensity_per_m2 = 0.01", &more);
    let setup = Setup {
        khz: 50.0,
        range_m: 97.0,
        medium: "[medium.multipath]\nbottom_density_ratio = 2.0\nbottom_speed_ratio = 1.2\nbottom_roughness_m = 0.0",
        scene: &scene,
        model: DIRECT,
        patterns: OMNI,
        speed: 0.0,
    };
    let spec = rig(folder, &setup);
    let range_m = at_m[0].hypot(at_m[1]);
    pool(2).expect("threads").install(|| {
        pings(&spec, 1, |_, slot, _| {
            let samples = slot.output.elements[0].element(0);
            let gain_db = 200.0 + spec.sonars[0].receive[0].sensitivity_db;
            let gain = 10f64.powf(gain_db / 20.0);
            for [out, back] in PAIRS {
                let (pressure, delay_s) = predicted(range_m, out, back);
                let want = pressure * gain;
                let first = (delay_s - slot.plan.first_sample_s) * RATE_HZ;
                let k = first.ceil() as usize;
                let inside = &samples[k + 1..k + 6];
                let level = inside.iter().map(|x| x.norm()).sum::<f64>() / inside.len() as f64;
                let is_free = |leg: &str| match leg {
                    "D" => free[0],
                    "S" => free[1],
                    _ => free[2],
                };
                let off_db = 20.0 * (level / want).log10();
                let comes = is_free(out) && is_free(back);
                println!("{at_m:?} m, {out} {back}: {off_db:+.2} dB, comes: {comes}");
                match comes {
                    true => assert!(off_db.abs() < 0.1, "{at_m:?}, {out} {back}: {off_db} dB"),
                    false => assert!(off_db < -40.0, "{at_m:?}, {out} {back}: {off_db} dB"),
                }
            }
        });
    });
}

/// Points behind walls: each pair of legs has its level where no wall crosses it, and is missing otherwise. There are points that the sonar sees by the surface
/// alone, by bottom and surface alone, and by all but these.
#[test]
fn walls_hide_a_point_from_each_leg_on_its_own() {
    let folder = tempfile::tempdir().expect("a folder");
    let mut seen = Vec::new();
    for east_m in [15.0, 25.0, 40.0, -20.0, -40.0, -75.0] {
        let free = ["D", "S", "SB"].map(|name| is_free(name, east_m));
        check_point(folder.path(), [0.0, east_m], "", free);
        seen.push(free);
    }
    // Above the wall that is shallower than the sonar, the leg by the surface may end on its way up.
    assert_eq!(
        seen,
        [
            [false, false, true],
            [false, true, false],
            [true, true, false],
            [false, false, false],
            [false, true, false],
            [false, false, false],
        ]
    );
}

/// Behind walls too, the bits of a ping do not depend on threads.
#[test]
fn reflected_shadows_have_the_same_bits_for_any_threads() {
    let folder = tempfile::tempdir().expect("a folder");
    let scene = scene(
        folder.path(),
        "lambert_db = -20.0\ndensity_per_m2 = 1.0",
        "",
    );
    let setup = Setup {
        khz: 50.0,
        range_m: 50.0,
        medium: "wind_m_per_s = 5.0\n[medium.multipath]",
        scene: &scene,
        model: DIRECT,
        patterns: OMNI,
        speed: 1.0,
    };
    let spec = rig(folder.path(), &setup);
    let with = |threads: usize| {
        let mut made = Vec::new();
        pool(threads).expect("threads").install(|| {
            pings(&spec, 2, |_, slot, _| {
                let scene = slot.output.scene;
                assert!(scene.images > 1000 && scene.shadowed > 1000, "{scene:?}");
                made.push(slot.output.elements.clone());
            });
        });
        made
    };
    let one = with(1);
    assert!(one[0] != one[1]);
    assert!(one == with(3));
}

/// A box just below the surface, where the leg by the surface is reflected, hides a point from that leg alone.
#[test]
fn a_box_at_the_surface_hides_a_point_from_the_leg_by_the_surface() {
    let folder = tempfile::tempdir().expect("a folder");
    let north_m = 30.0;
    let bounce_m = leg("S", north_m)[1][0];
    let table = format!(
        "[[target]]\nname = \"box\"\nshape = \"box\"\nnorth_m = {bounce_m}\neast_m = 0.0\ndown_m = 0.4\nsize_m = [0.6, 0.6, 0.6]\ntarget_strength_db = -140.0\n"
    );
    let targets = folder.path().join("targets.toml");
    std::fs::write(&targets, table).expect("targets");
    let more = format!("targets = \"{}\"", targets.display());
    check_point(folder.path(), [north_m, 0.0], &more, [true, false, true]);
    check_point(folder.path(), [2.0 * north_m, 0.0], &more, [true; 3]);
}

/// The ground behind the wall on the bottom: its echoes by the surface begin at the edge of the shadow that the mirror image of the sonar sees, within the
/// spacing of the scatterers, and have the density of the seabed from there on; direct ones begin at the edge of the direct shadow.
#[test]
fn the_shadow_of_the_surface_leg_ends_where_the_image_sees_past_the_wall() {
    const DENSITY_PER_M2: f64 = 4.0;
    let [wall_m, crest_m] = WALLS[0];
    // Similar triangles of the eye, the crest and the bottom.
    let edge = |eye_m: f64| wall_m * (BOTTOM_M - eye_m) / (crest_m - eye_m);
    let (direct_m, surface_m) = (edge(SONAR_M), edge(-SONAR_M));
    let folder = tempfile::tempdir().expect("a folder");
    let seabed = format!("lambert_db = -20.0\ndensity_per_m2 = {DENSITY_PER_M2}");
    let scene = scene(folder.path(), &seabed, "");
    let setup = Setup {
        khz: 50.0,
        range_m: 60.0,
        medium: "[medium.multipath]\nlegs = \"surface\"",
        scene: &scene,
        model: DIRECT,
        patterns: OMNI,
        speed: 0.0,
    };
    let spec = rig(folder.path(), &setup);
    gather_pings(&spec, 1, |_, all| {
        // East of the echoes behind the wall, of the direct ones and of those with both legs by the surface.
        let east = |rows: std::ops::Range<usize>, is_wanted: &dyn Fn(DVec3, DVec3) -> bool| {
            let mut east_m: Vec<f64> = rows
                .map(|i| (all.transmit_m(i), all.position_m(i)))
                .filter(|(out_m, back_m)| is_wanted(*out_m, *back_m))
                .map(|(_, back_m)| back_m)
                .filter(|m| m.y > wall_m + CELL_M && m.x.abs() < 20.0)
                .map(|m| m.y)
                .collect();
            east_m.sort_by(f64::total_cmp);
            east_m
        };
        let direct = east(0..all.of_scene(), &|_, _| true);
        let images = all.of_scene()..all.len();
        let both = east(images.clone(), &|out_m, back_m| {
            out_m.z < 0.0 && back_m.z < 0.0
        });
        let mixed = east(images, &|out_m, back_m| out_m.z * back_m.z < 0.0);
        for (name, east_m, edge_m, times) in [
            ("D D", direct, direct_m, 1.0),
            ("S S", both, surface_m, 1.0),
            ("D S and S D", mixed, direct_m, 2.0),
        ] {
            let first_m = east_m[0];
            let near = east_m.iter().filter(|m| **m < edge_m + 6.0).count() as f64;
            let want = times * DENSITY_PER_M2 * 40.0 * 6.0;
            println!("{name}: from {first_m:.3} m, edge at {edge_m:.3} m; {near} of {want} in 6 m");
            let spacing_m = DENSITY_PER_M2.sqrt().recip();
            assert!((first_m - edge_m).abs() < spacing_m, "{name}");
            assert!((near / want - 1.0).abs() < 0.05, "{name}: {near} of {want}");
        }
    });
}
