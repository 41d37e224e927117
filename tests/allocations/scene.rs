//! Test that gathering scatterers does not allocate after its buffers have been full and the tile pool has reached its limit.

use echotank_config::spec::{
    AnchorSpec, BottomSpec, Density, IncidenceSpec, OcclusionSpec, SceneSpec, SeabedFileSpec,
    SeabedShape, SeabedSpec,
};
use echotank_core::scene::{Footprint, Scatterers};
use echotank_runtime::io::files::FileSystem;
use echotank_scene::Scene;
use echotank_scene::TILE_BYTES;
use echotank_testing::allocations;
use glam::DVec3;

#[test]
fn a_moving_platform_gathers_without_allocating_after_warm_up() {
    let _alone = allocations::alone();
    // The work runs in a thread pool, as in every ping. Work from outside the pool would allocate.
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(2)
        .build()
        .unwrap();
    let plane = SeabedShape::Plane {
        depth_m: 20.0,
        slope_north: 0.0,
        slope_east: 0.0,
    };
    assert_eq!(pool.install(|| gather_on_the_move(plane)), 0);
    let hills = tempfile::tempdir().unwrap();
    let path = hills.path().join("hills.asc");
    std::fs::write(&path, ground()).unwrap();
    let hills = SeabedShape::File {
        file: SeabedFileSpec::of(path),
        offset_north_m: 0.0,
        offset_east_m: 0.0,
    };
    let shadowed = pool.install(|| gather_on_the_move(hills));
    assert!(shadowed > 1000, "only {shadowed} in shadow");
}

/// Hills that cast shadows, 480 m x 480 m.
fn ground() -> String {
    let mut text = "ncols 240 nrows 240 xllcorner 0 yllcorner 0 cellsize 2\n".to_owned();
    for row in 0..240 {
        for col in 0..240 {
            let (n, e) = (f64::from(row), f64::from(col));
            text += &format!("{:.3} ", 20.0 - 3.0 * (n / 3.0).sin() * (e / 4.0).cos());
        }
    }
    text
}

/// Number of scatterers in shadow while the platform moves.
fn gather_on_the_move(shape: SeabedShape) -> u64 {
    let spec = SceneSpec {
        seed: 1,
        anchor: AnchorSpec::Origin,
        mirror: true,
        seabed: Some(SeabedSpec {
            shape,
            density: Density::PerM2(1.0),
            bottom: BottomSpec::BistaticLambert { mu_db: -27.0 },
            incidence: IncidenceSpec::Normal,
            mosaic: None,
            speckle: true,
        }),
        points: None,
        targets: None,
        occlusion: OcclusionSpec::Horizon,
        memory_limit_bytes: 40 * TILE_BYTES,
        simplify: None,
    };
    let mut scene = Scene::open(&FileSystem, &spec).unwrap();
    let mut out = Scatterers::default();
    let mut ping = |north_m: f64, out: &mut Scatterers| {
        let side = |axis| {
            let apex_m = DVec3::new(north_m, 0.0, 0.0);
            Footprint::fan(apex_m, 80.0, axis, 1.0)
        };
        scene.gather(&[side(DVec3::X), side(DVec3::Y)], out)
    };
    let mut warm_up_made = 0;
    for i in 0..40 {
        warm_up_made += ping(4.0 * f64::from(i), &mut out).tiles_made;
    }
    assert!(
        warm_up_made > 40,
        "{warm_up_made}: the pool is not full yet"
    );
    // The number of scatterers in the circle varies as the platform moves. The reserve ensures sufficient capacity.
    let room = out.len() / 10;
    out.north_m.reserve(room);
    out.east_m.reserve(room);
    out.down_m.reserve(room);
    out.normal.reserve(room);
    out.strength.reserve(room);
    out.law.reserve(room);
    let before = allocations::in_all_threads();
    let (mut made, mut shadowed) = (0, 0);
    for i in 40..540 {
        let counts = ping(4.0 * f64::from(i), &mut out);
        made += counts.tiles_made;
        shadowed += counts.shadowed;
    }
    let allocations = allocations::in_all_threads() - before;
    println!("{made} tiles made, {allocations} allocations");
    assert!(made > 300, "only {made} tiles made: nothing was tried");
    assert_eq!(
        allocations, 0,
        "{allocations} allocations, {made} tiles made"
    );
    shadowed
}
