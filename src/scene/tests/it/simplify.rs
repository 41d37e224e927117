//! Simplification: the paper's seabeds in a scene, and allocation-free pings.

use echotank_config::spec::{
    AnchorSpec, BottomSpec, Density, EnergyWeights, IncidenceSpec, OcclusionSpec, PaperShape,
    SceneSpec, SeabedShape, SeabedSpec, SimplifyMethod, SimplifySpec,
};
use echotank_core::scene::{Footprint, Scatterers};
use echotank_runtime::io::files::FileSystem;
use echotank_scene::Scene;
use echotank_scene::simplify::energy::{Beam, View};
use echotank_scene::simplify::stage::Stage;
use echotank_testing::allocations;
use glam::DVec3;

fn scene(shape: PaperShape) -> Scene {
    Scene::open(
        &FileSystem,
        &SceneSpec {
            seed: 3,
            anchor: AnchorSpec::Origin,
            mirror: false,
            seabed: Some(SeabedSpec {
                shape: SeabedShape::Paper(shape),
                density: Density::PerM2(4.0),
                bottom: BottomSpec::BistaticLambert { mu_db: -20.0 },
                incidence: IncidenceSpec::Normal,
                mosaic: None,
                speckle: true,
            }),
            points: None,
            targets: None,
            occlusion: OcclusionSpec::None,
            memory_limit_bytes: 64 << 20,
            simplify: None,
        },
    )
    .unwrap()
}

fn around(north_m: f64) -> Footprint {
    Footprint::all_round(DVec3::new(north_m, 45.0, 0.0), 60.0)
}

#[test]
fn the_papers_bottoms_have_the_shapes_that_are_stated() {
    let down = |shape, north_m, east_m| scene(shape).seabed_down_m(north_m, east_m).unwrap();
    // Five crests a metre high, 12 m apart, swinging by 2 m.
    for k in 0..5 {
        let crest_m = 20.0 + 12.0 * f64::from(k);
        assert!((down(PaperShape::Curves, 0.0, crest_m) - 29.0).abs() < 1e-6);
        assert!((down(PaperShape::Curves, 5.0, crest_m + 2.0) - 29.0).abs() < 1e-6);
        assert!((down(PaperShape::Curves, 0.0, crest_m + 6.0) - 30.0).abs() < 1e-6);
    }
    // On the strokes of the letters, and between them.
    for (north_m, east_m) in [(10.0, 28.0), (13.5, 35.0), (6.5, 35.0), (10.0, 58.0)] {
        assert!((down(PaperShape::Relief, north_m, east_m) - 28.5).abs() < 1e-9);
    }
    for (north_m, east_m) in [(10.0, 40.0), (10.0, 50.0), (10.0, 20.0), (10.0, 70.0)] {
        assert!((down(PaperShape::Relief, north_m, east_m) - 30.0).abs() < 1e-9);
    }
    // 6 % down, and up by 5 m over the bank.
    assert!((down(PaperShape::Lake, 0.0, 50.0) - 23.0).abs() < 1e-9);
    assert!((down(PaperShape::Lake, 0.0, 70.0) - 19.2).abs() < 1e-9);
    // Scatterers lie on them with their normals.
    let mut s = Scatterers::default();
    scene(PaperShape::Curves).gather(&[around(10.0)], &mut s);
    assert!(s.len() > 10_000, "{}", s.len());
    for i in (0..s.len()).step_by(37) {
        let (n, e) = (s.north_m[i], s.east_m[i]);
        let step = 1e-3;
        let slope = |dn: f64, de: f64| {
            (down(PaperShape::Curves, n + dn, e + de) - down(PaperShape::Curves, n - dn, e - de))
                / (2.0 * step)
        };
        let want = DVec3::new(slope(step, 0.0), slope(0.0, step), -1.0).normalize();
        let got = DVec3::from_array(s.normal[i].map(f64::from));
        assert!(got.distance(want) < 1e-4, "at {n} {e}: {got} want {want}");
    }
}

#[test]
fn a_thinned_ping_allocates_nothing_after_warm_up() {
    let mut scene = scene(PaperShape::Relief);
    let (mut s, mut all) = (Scatterers::default(), 0);
    let beam = Beam {
        along: DVec3::X,
        across: DVec3::Z,
        boresight: DVec3::Y,
        lengths: [90.0; 2],
        widths: [0.0; 2],
        baffled: true,
    };
    let mut view = View {
        slack_m: 0.3,
        slack_rad: 0.01,
        shadows: true,
        beams: vec![beam],
        ..View::default()
    };
    for (method, weights) in [
        (SimplifyMethod::Unbiased, EnergyWeights::ECHO),
        (SimplifyMethod::Acoustic, EnergyWeights::PAPER),
        (SimplifyMethod::Paper, EnergyWeights::PAPER),
    ] {
        let spec = SimplifySpec {
            method,
            keep: 500,
            weights,
            hold_m: 0.3,
            hold_rad: 0.01,
            shadows: true,
        };
        let mut stage = Stage::of_spec(&spec, 1);
        let mut ping = |north_m: f64| {
            let counts = scene.gather(&[around(north_m)], &mut s);
            all = s.len();
            view.apex_m = DVec3::new(north_m, 0.0, 0.0);
            let before = allocations::on_this_thread();
            let done = stage.thin(&mut s, counts.scatterers as usize, &view);
            assert_eq!(done.offered, all as u64);
            (done, allocations::on_this_thread() - before)
        };
        for k in 0..8 {
            ping(f64::from(k));
        }
        for k in 0..8 {
            let (done, allocations) = ping(f64::from(k));
            assert_eq!(allocations, 0, "{method:?} ping {k}: {done:?}");
        }
    }
}
