//! A survey far beyond memory: the cost of a ping does not depend on the survey's size.

use echotank_config::spec::*;
use echotank_core::scene::{Footprint, Scatterers};
use echotank_runtime::io::files::FileSystem;
use echotank_scene::Scene;
use echotank_scene::TILE_BYTES;
use glam::DVec3;

/// 10 km along the track at 500 scatterers per square metre; a limit of 500 tiles, fewer than two pings need.
#[test]
fn pings_along_ten_kilometres_make_the_same_number_of_tiles_and_come_back_to_the_same_scatterers() {
    let spec = SceneSpec {
        seed: 5,
        anchor: AnchorSpec::Origin,
        mirror: false,
        seabed: Some(SeabedSpec {
            shape: SeabedShape::Plane {
                depth_m: 10.0,
                slope_north: 0.0,
                slope_east: 0.01,
            },
            density: Density::PerM2(500.0),
            bottom: BottomSpec::Sediment(Sediment::Sand),
            incidence: IncidenceSpec::Normal,
            mosaic: None,
            speckle: true,
        }),
        points: None,
        targets: None,
        occlusion: OcclusionSpec::Horizon,
        memory_limit_bytes: 500 * TILE_BYTES,
        simplify: None,
    };
    let mut scene = Scene::open(&FileSystem, &spec).expect("a plane");
    let mut out = Scatterers::default();
    let mut gather = |km: f64| {
        let at_m = DVec3::new(1000.0 * km, 0.0, 0.0);
        let footprint = Footprint::fan(at_m, 50.0, DVec3::X, 0.05);
        let counts = scene.gather(&[footprint], &mut out);
        (counts, out.strength.clone(), out.north_m.clone())
    };
    let first = gather(-5.0);
    for ping in 1..=100 {
        let (counts, ..) = gather(-5.0 + 0.1 * f64::from(ping));
        let relative = counts.made as f64 / first.0.made as f64;
        assert!((0.9..1.1).contains(&relative), "ping {ping}: {counts:?}");
        assert_eq!(
            counts.tiles_made, counts.tiles_used,
            "far from the last ping"
        );
    }
    println!("{:?}", first.0);
    assert!(first.0.scatterers > 100_000);
    let again = gather(-5.0);
    assert!(again == first, "the same scatterers, made anew");
}
