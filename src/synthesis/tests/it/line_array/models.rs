//! Tests of the line-array engine in the pipeline, with every supported path and Doppler model.

use std::sync::Mutex;

use echotank_core::frames::AttitudeKnot;
use echotank_core::model::{DopplerModel, ModelChoice, PathModel};
use echotank_core::ping::EchoCounts;
use echotank_synthesis::array::gridded2d::{Bounds, Gridded2d, Refusal, Spec};
use echotank_synthesis::echo::LineWorkspace;
use glam::{DQuat, DVec3};
use num_complex::Complex64;

use echotank_testing::echo::*;
use echotank_testing::line_scene::*;

const TOLERANCE: f64 = 1e-3;

fn spec(scene: &Scene) -> Spec<'_> {
    let bounds = Bounds {
        nearest_m: 36.0,
        greatest_slope: 0.26,
        along_m_per_s: 5.0,
        across_m_per_s: 0.5,
        turning_rad_per_s: 0.0,
    };
    scene.spec(bounds, TOLERANCE)
}

/// Samples of all elements, element-major, with the counts, computed on this number of threads.
fn run(scene: &Scene, threads: usize) -> (Vec<Complex64>, EchoCounts, f64) {
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(threads)
        .build()
        .expect("threads");
    pool.install(|| {
        let mut engine = Gridded2d::new(&spec(scene)).expect("within reach");
        let work: Vec<_> = (0..threads)
            .map(|_| Mutex::new(LineWorkspace::default()))
            .collect();
        let (transmit_leg, mut counts) = scene.transmit_leg();
        let echoes = scene.echoes(&transmit_leg, &work);
        let mut iq = vec![Complex64::ZERO; scene.rx.elements * scene.plan.sample_count];
        counts += engine.synthesise(&scene.plan, &echoes, &mut iq);
        (iq, counts, engine.left_out())
    })
}

fn worst(scene: &Scene, iq: &[Complex64]) -> f64 {
    let last = scene.rx.elements - 1;
    [0, last / 3, last]
        .into_iter()
        .map(|e| {
            let got = &iq[e * scene.plan.sample_count..][..scene.plan.sample_count];
            worst_window(got, &truth(scene, e, false), scene.plan.pulse.duration_s)
        })
        .fold(0.0, f64::max)
}

/// Checks that the engine meets the tolerance. Returns its counts.
fn assert_within(scene: &Scene) -> EchoCounts {
    let (iq, counts, left_out) = run(scene, 1);
    let error = worst(scene, &iq);
    let ModelChoice { path, doppler, .. } = scene.plan.model;
    let name = format!("{}, {}", path.name(), doppler.name());
    println!("{name}: {error:.1e}, left out {left_out:.1e}");
    assert!(error < TOLERANCE, "{name}: {error:e}");
    counts
}

const DRAWN: Draw = Draw {
    elements: 48,
    scatterers: 300,
    far_m: 55.0,
    velocity_m_per_s: DVec3::new(5.0, 0.3, 0.3),
    ..SIDE_SCAN
};

/// Motion with roll, pitch and yaw rates of a tenth of a radian per second.
fn turning() -> Scene {
    let mut scene = draw(DRAWN);
    let rate_rad_per_s = DVec3::new(0.1, -0.1, 0.1);
    scene.plan.trajectory.attitude = vec![AttitudeKnot {
        time_s: 0.0,
        world_from_body: DQuat::IDENTITY,
        body_rate_rad_per_s: rate_rad_per_s,
    }];
    chords(&mut scene.plan, 0.1, 4);
    scene
}

#[test]
fn every_path_and_doppler_model_keeps_the_tolerance() {
    for (path, doppler) in [
        (PathModel::StopAndHop, DopplerModel::None),
        (PathModel::StopAndHop, DopplerModel::Stretch),
        (PathModel::Polyline, DopplerModel::None),
        (PathModel::Polyline, DopplerModel::Stretch),
        (PathModel::Polyline, DopplerModel::StretchQuadratic),
        (PathModel::KSegment, DopplerModel::Stretch),
        (PathModel::Continuous, DopplerModel::Stretch),
    ] {
        let mut scene = draw(DRAWN);
        scene.plan.model.path = path;
        scene.plan.model.doppler = doppler;
        let counts = assert_within(&scene);
        assert_eq!(counts.used, 48 * 300, "{counts:?}");
    }
}

#[test]
fn a_turning_platform_keeps_the_tolerance_on_chords_and_on_the_trajectory() {
    for (path, doppler) in [
        (PathModel::KSegment, DopplerModel::Stretch),
        (PathModel::KSegment, DopplerModel::StretchQuadratic),
        (PathModel::Continuous, DopplerModel::Stretch),
        (PathModel::Continuous, DopplerModel::StretchQuadratic),
    ] {
        let mut scene = turning();
        scene.plan.model.path = path;
        scene.plan.model.doppler = doppler;
        assert_within(&scene);
    }
}

#[test]
fn one_thread_and_two_give_the_same_bits() {
    let scene = draw(DRAWN);
    let (one, two) = (run(&scene, 1), run(&scene, 2));
    assert!(one.0 == two.0, "the number of threads shows");
    assert_eq!(one.1, two.1);
}

#[test]
fn unsupported_models_are_refused() {
    let mut scene = draw(DRAWN);
    scene.plan.model.doppler = DopplerModel::PaperEq21;
    let refusal = Gridded2d::new(&spec(&scene)).err();
    assert_eq!(refusal, Some(Refusal::Doppler(DopplerModel::PaperEq21)));

    let scene = draw(DRAWN);
    let unfiltered = Spec {
        filter: None,
        ..spec(&scene)
    };
    assert_eq!(Gridded2d::new(&unfiltered).err(), Some(Refusal::NoFilter));

    // 0.1 rad/s for 0.05 s is five milliradians at each vertex.
    let mut turning = spec(&scene);
    turning.bounds.turning_rad_per_s = 0.1;
    let mut model = scene.plan.model;
    model.segment_s = 0.05;
    turning.model = &model;
    let why = |spec: &Spec| Gridded2d::new(spec).map(|engine| engine.error_model().why.clone());
    let said = why(&turning).expect("short sections follow the steps");
    assert!(said.contains("sections of 1 "), "{said}");
    let chords = ModelChoice {
        path: PathModel::KSegment,
        ..model
    };
    turning.model = &chords;
    let said = why(&turning).expect("chords have no steps");
    assert!(said.contains("sections of 128 "), "{said}");

    let mut nowhere = spec(&scene);
    nowhere.bounds.nearest_m = f64::NAN;
    let refusal = Gridded2d::new(&nowhere).err().map(|r| r.to_string());
    assert!(refusal.is_some_and(|r| r.contains("nearest_m")));
}
