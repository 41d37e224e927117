//! The error check of whole pings: its estimate compared with the error of every window.

use echotank_config::spec::RigSpec;
use echotank_core::frames::{Trajectory, rotation_from_angles};
use echotank_core::ping::{ErrorCheck, PingPlan};
use echotank_core::scene::Scatterers;
use echotank_ping::error_check::{FAULT, KEPT, LEAST};
use echotank_ping::pipeline::SonarPipeline;
use echotank_ping::threads::pool;
use echotank_testing::pings::{plan_on, small_rig};
use glam::DVec3;
use num_complex::Complex64;

use crate::engines::ring;

/// `model`: lines of `[sonar.model]`; `receiver`: additional lines of `[sonar.receiver]`.
fn rig(model: &str, receiver: &str) -> RigSpec {
    small_rig(4, receiver, "", model)
}

/// Points on a ring 10 to 28 m away, the same for every ping.
fn scene(count: usize) -> Scatterers {
    ring(count, [10.0, 18.0], 8.0)
}

fn plan(rig: &RigSpec, number: u32) -> PingPlan {
    let trajectory = Trajectory::uniform(
        // Back and forth over the scene.
        DVec3::new(0.01 * f64::from(number % 400), 0.0, 0.0),
        DVec3::new(5.0, 1.0, 0.3),
        rotation_from_angles(0.02, 0.01, 0.3),
    );
    plan_on(trajectory, rig, number, rig.sonars[0].settings)
}

/// Error checks of `pings` pings, and the last one's samples before the receiver stage (which does nothing here).
fn run(
    rig: &RigSpec,
    scatterers: &Scatterers,
    pings: u32,
) -> (Vec<Option<ErrorCheck>>, Vec<Complex64>) {
    let mut pipeline = SonarPipeline::new(&rig.sonars[0], &rig.medium).expect("fits");
    let mut output = pipeline.blank_output();
    let error_checks = (1..=pings)
        .map(|number| {
            pipeline.compute_ping(&plan(rig, number), scatterers, &mut output);
            output.error_check
        })
        .collect();
    (error_checks, output.elements[0].iq.clone())
}

/// The error that an error check estimates, over every window: rms of the windows' errors, each over the larger of its own rms and a floor 55 dB
/// below the strongest window of the element.
fn true_error(got: &[Complex64], want: &[Complex64], samples: usize, window: usize) -> f64 {
    let mean_square =
        |x: &[Complex64]| x.iter().map(|s| s.norm_sqr()).sum::<f64>() / x.len() as f64;
    let (mut sum, mut windows) = (0.0, 0.0);
    for (got, want) in got.chunks(samples).zip(want.chunks(samples)) {
        let level = |first: usize| mean_square(&want[first..first + window]);
        let floor = (0..=samples - window).map(level).fold(0.0, f64::max) * 10f64.powf(-5.5);
        for first in 0..=samples - window {
            let off = |k: usize| (got[k] - want[k]).norm_sqr();
            let off = (first..first + window).map(off).sum::<f64>() / window as f64;
            sum += off / level(first).max(floor);
            windows += 1.0;
        }
    }
    (sum / windows).sqrt()
}

const QUIET: &str = "tvg = \"none\"";

#[test]
fn the_interval_of_an_error_check_contains_the_error_of_every_window() {
    let scatterers = scene(150);
    // The reference is slow: compute it once per receiver.
    let mut known: Option<(&str, Vec<Complex64>)> = None;
    for (model, receiver) in [
        (
            "doppler = \"stretch\"\nsynthesis = \"direct\"",
            "rx_filter = \"fir\"",
        ),
        (
            "doppler = \"none\"\nsynthesis = \"direct\"",
            "rx_filter = \"fir\"",
        ),
        (
            "doppler = \"stretch\"\nsynthesis = \"gridded-1d\"\ntolerance = 1e-1",
            "rx_filter = \"fir\"",
        ),
        (
            "doppler = \"none\"\nsynthesis = \"linear\"",
            "rx_filter = \"fir\"",
        ),
        ("doppler = \"stretch\"", "rx_filter = \"none\""),
    ] {
        let lines = format!("{receiver}\n{QUIET}");
        let checked = rig(&format!("{model}\nerror_check = true"), &lines);
        // The budget for checking a cheap method is small.
        let pings = if model.contains("gridded") {
            4000
        } else {
            1600
        };
        let (error_checks, got) = run(&checked, &scatterers, pings);
        let none = error_checks.iter().take_while(|c| c.is_none()).count();
        let last = error_checks
            .last()
            .copied()
            .flatten()
            .expect("enough windows by now");
        assert!(
            (LEAST..=KEPT).contains(&(last.windows as usize)),
            "{last:?}"
        );
        assert!(none > 0, "16 windows in the first ping cost more than 1 %");

        let truth = rig("synthesis = \"reference\"", &lines);
        let reference = plan(&truth, pings);
        if known.as_ref().is_none_or(|(of, _)| *of != receiver) {
            let mut pipeline = SonarPipeline::new(&truth.sonars[0], &truth.medium).expect("fits");
            let mut output = pipeline.blank_output();
            pipeline.compute_ping(&reference, &scatterers, &mut output);
            known = Some((receiver, output.elements[0].iq.clone()));
        }
        let want = &known.as_ref().expect("made above").1;
        let error = true_error(&got, want, reference.sample_count, 120);
        println!(
            "{model:?}, {receiver:?}: true {error:.2e}, error check {:.2e} ({:.2e} to {:.2e}) after {none} pings",
            last.error, last.low, last.high
        );
        // The interval has 95 % confidence: one in twenty may miss slightly. The seed is fixed, so the result is deterministic.
        assert!(
            error > 0.9 * last.low && error < 1.1 * last.high,
            "{error:e}, {last:?}"
        );
    }
}

/// A wrong model is detected; checking does not change the samples.
#[test]
fn an_error_check_changes_no_sample_and_detects_a_wrong_model() {
    let scatterers = scene(150);
    let bits = |error_check: bool| {
        let model = format!("path = \"stop-and-hop\"\nerror_check = {error_check}");
        run(&rig(&model, QUIET), &scatterers, 1600)
    };
    let ((error_checks, watched), (nothing, plain)) = (bits(true), bits(false));
    assert_eq!(watched, plain);
    assert!(nothing.iter().all(Option::is_none));
    let last = error_checks.last().copied().flatten().expect("enough");
    assert!(last.low > 0.5, "{last:?}");
}

/// One error check above 1.3 tolerances is chance, two in a row are a fault; a method within its tolerance has none.
#[test]
fn a_fault_is_an_error_above_1p3_tolerances_on_two_consecutive_pings() {
    let scatterers = scene(150);
    for (tolerance, faulty) in [(1e-1, false), (1e-5, true)] {
        let model = format!("error_check = true\ntolerance = {tolerance}\nsegment_ms = 5.0");
        let (error_checks, _) = run(&rig(&model, QUIET), &scatterers, 1600);
        let known: Vec<ErrorCheck> = error_checks.into_iter().flatten().collect();
        let last = known[known.len() - 1];
        assert_eq!(last.tolerance, tolerance);
        assert_eq!(known.iter().any(|c| c.fault), faulty, "{last:?}");
        assert_eq!(known.iter().any(|c| c.exceeded), faulty, "{last:?}");
        assert_eq!(last.worst > FAULT * tolerance, faulty, "{last:?}");
    }
}

#[test]
fn an_error_check_is_the_same_for_any_number_of_threads() {
    let scatterers = scene(150);
    let rig = rig("error_check = true", QUIET);
    let with = |threads: usize| {
        let pool = pool(threads).expect("a pool");
        pool.install(|| run(&rig, &scatterers, 1600).0)
    };
    let one = with(1);
    assert_eq!(one, with(3));
    assert!(one.last().is_some_and(Option::is_some));
}

#[test]
fn an_empty_scene_has_zero_error() {
    let rig = rig("error_check = true", QUIET);
    let (error_checks, _) = run(&rig, &Scatterers::default(), 20);
    assert!(error_checks.iter().flatten().all(|c| c.error == 0.0));
}
