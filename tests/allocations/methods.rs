//! Test that a ping does not allocate after the buffers have processed the largest ping, for every synthesis method
//! with an error check.

use echotank_testing::allocations;
use echotank_testing::pings::{plan_on, small_rig};

use echotank_core::frames::{Trajectory, rotation_from_angles};
use echotank_core::ping::PingPlan;
use echotank_core::scene::{ScatterLaw, Scatterers};
use echotank_ping::pipeline::SonarPipeline;
use glam::DVec3;
use num_complex::Complex64;

#[test]
fn no_path_model_and_no_synthesis_allocates_after_warm_up() {
    let _alone = allocations::alone();
    let mut scatterers = Scatterers::default();
    for k in 0..300 {
        let at_m = DVec3::new(8.0 + 0.03 * f64::from(k), 10.0, 8.0);
        scatterers.push(at_m, [0.0; 3], Complex64::ONE, ScatterLaw::Point);
    }
    for model in [
        "path = \"polyline\"\nsynthesis = \"direct\"",
        "path = \"polyline\"\nsynthesis = \"gridded-1d\"",
        "doppler = \"none\"\nsynthesis = \"gridded-1d\"",
        "path = \"k-segment\"\nsynthesis = \"gridded-2d\"\ntolerance = 2e-2",
        "path = \"k-segment\"\nsynthesis = \"gridded-lines\"\ntolerance = 2e-2",
        "path = \"k-segment\"\ndoppler = \"stretch-quadratic\"",
        "path = \"continuous\"\ndoppler = \"stretch-quadratic\"",
        "doppler = \"paper-eq21\"",
        "doppler = \"none\"\nsynthesis = \"spectral\"",
        "doppler = \"none\"\nsynthesis = \"nearest\"",
        "doppler = \"none\"\nsynthesis = \"linear\"",
    ] {
        let rig = small_rig(
            12,
            "rx_filter = \"fir\"",
            "[sonar.limits]\npulse_duration_ms = [1.0, 2.0]",
            &format!("error_check = true\n{model}"),
        );
        let sonar = &rig.sonars[0];
        // The thread pool is created first, so its allocations do not count.
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(1)
            .build()
            .expect("a pool");
        // The budget of fast methods allows only a few samples. The other methods have enough samples after their
        // warm-up.
        let cheap = model.contains("synthesis") && !model.contains("direct");
        let (warm_up, all) = if cheap { (20, 40) } else { (60, 100) };
        let mut plans: Vec<PingPlan> = (1..=all)
            .map(|number| {
                let mut settings = sonar.settings;
                // The pulse changes occasionally, the longest first. "gridded-2d" computes new tables for another
                // pulse.
                let shorter = number / 10 % 2 == 1 && !model.contains("gridded-2d");
                settings.pulse_duration_s = if shorter { 1.5e-3 } else { 2e-3 };
                let trajectory = Trajectory::uniform(
                    DVec3::ZERO,
                    DVec3::new(5.0, 1.0, 0.3),
                    rotation_from_angles(0.0, 0.0, 0.0),
                );
                plan_on(trajectory, &rig, number, settings)
            })
            .collect();
        let measured = plans.split_off(warm_up);
        let (allocations, checked) = pool.install(|| {
            let mut pipeline = SonarPipeline::new(sonar, &rig.medium).expect("fits");
            // As many windows as a ping can have checked.
            pipeline.allow_error_checks(f64::INFINITY);
            let mut output = pipeline.blank_output();
            for plan in &plans {
                pipeline.compute_ping(plan, &scatterers, &mut output);
            }
            let before = allocations::in_all_threads();
            for plan in &measured {
                pipeline.compute_ping(plan, &scatterers, &mut output);
            }
            let during = allocations::in_all_threads() - before;
            (during, output.error_check.is_some())
        });
        println!("{model}: {allocations} allocations, checked: {checked}");
        assert_eq!(allocations, 0, "{model}");
        assert!(checked || cheap, "{model}");
    }
}
