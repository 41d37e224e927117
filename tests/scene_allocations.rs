//! Gathering allocates nothing once its buffers have been full and the pool of tiles has reached its limit.

mod counting;

use echotank::config::spec::{
    BottomSpec, Density, IncidenceSpec, OcclusionSpec, SceneSpec, SeabedShape, SeabedSpec,
};
use echotank::flow::{Footprint, Scatterers};
use echotank::scene::Scene;
use echotank::scene::tiles::TILE_BYTES;
use glam::DVec3;

#[test]
fn a_moving_platform_gathers_without_allocating_after_warm_up() {
    // In a pool, as every ping is: to hand work to one from outside takes memory.
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(2)
        .build()
        .unwrap();
    pool.install(gather_on_the_move);
}

fn gather_on_the_move() {
    let spec = SceneSpec {
        seed: 1,
        anchor_first_fix: false,
        mirror: false,
        seabed: Some(SeabedSpec {
            shape: SeabedShape::Plane {
                depth_m: 20.0,
                slope_north: 0.0,
                slope_east: 0.0,
            },
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
    let mut scene = Scene::open(&spec).unwrap();
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
    // The circle's count varies by a few as the platform moves; the doubling of a vector usually leaves room for them, this makes sure.
    let room = out.len() / 10;
    out.north_m.reserve(room);
    out.east_m.reserve(room);
    out.down_m.reserve(room);
    out.normal.reserve(room);
    out.strength.reserve(room);
    out.law.reserve(room);
    let before = counting::in_all_threads();
    let mut made = 0;
    for i in 40..540 {
        made += ping(4.0 * f64::from(i), &mut out).tiles_made;
    }
    let allocations = counting::in_all_threads() - before;
    println!("{made} tiles made, {allocations} allocations");
    assert!(made > 300, "only {made} tiles made: nothing was tried");
    assert_eq!(
        allocations, 0,
        "{allocations} allocations, {made} tiles made"
    );
}
