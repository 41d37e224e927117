//! A ping does not allocate after buffers have processed the largest: every synthesis, with an error check.

use echotank_testing::allocations;
use std::path::Path;

use echotank_core::frames::{Trajectory, rotation_from_angles};
use echotank_core::navigation::NavState;
use echotank_core::ping::PingPlan;
use echotank_core::scene::{ScatterLaw, Scatterers};
use echotank_core::time::UtcNs;
use echotank_ping::pipeline::SonarPipeline;
use echotank_ping::{self as ping, PingOrder};
use glam::DVec3;
use num_complex::Complex64;

const CONFIGURATION: &str = r#"
[[nav.source]]
name = "gnss"
kind = "udp"
listen = "127.0.0.1:10110"
[scene.seabed]
shape = "plane"
depth_m = 40.0
[[sonar]]
name = "main"
[sonar.pulse]
kind = "lfm"
center_frequency_khz = 400.0
bandwidth_khz = 30.0
duration_ms = 2.0
[[sonar.transmit]]
name = "tx"
[[sonar.receive]]
name = "rx"
elements = 12
spacing_m = 0.002
[sonar.receiver]
sample_rate_khz = 60.0
rx_filter = "fir"
[sonar.ping]
range_m = 30.0
rate_hz = 5.0
source_level_db = 200.0
[sonar.limits]
pulse_duration_ms = [1.0, 2.0]
[sonar.model]
error_check = true
"#;

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
        "path = \"k-segment\"\ndoppler = \"stretch-quadratic\"",
        "path = \"continuous\"\ndoppler = \"stretch-quadratic\"",
        "doppler = \"paper-eq21\"",
        "doppler = \"none\"\nsynthesis = \"spectral\"",
        "doppler = \"none\"\nsynthesis = \"nearest\"",
        "doppler = \"none\"\nsynthesis = \"linear\"",
    ] {
        let text = format!("{CONFIGURATION}{model}\n");
        let rig = echotank_runtime::config_files::parse(&text, Path::new("."))
            .expect("a good configuration");
        let sonar = &rig.sonars[0];
        // One thread with its own pool: allocations of the pool itself do not count.
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(1)
            .build()
            .expect("a pool");
        let mut plans: Vec<PingPlan> = (1..=100)
            .map(|number| {
                let mut plan = ping::blank(0, sonar, &rig.medium, 0.05);
                plan.trajectory = Trajectory::uniform(
                    DVec3::ZERO,
                    DVec3::new(5.0, 1.0, 0.3),
                    rotation_from_angles(0.0, 0.0, 0.0),
                );
                let mut settings = sonar.settings;
                // The pulse changes now and then, the longest first. "gridded-2d" makes new tables for another pulse.
                let shorter = number / 10 % 2 == 1 && !model.contains("gridded-2d");
                settings.pulse_duration_s = if shorter { 1.5e-3 } else { 2e-3 };
                let order = PingOrder {
                    ping_number: number,
                    transmit_utc: UtcNs(0),
                    settings,
                    period_s: 0.2,
                };
                ping::fill(&mut plan, sonar, &order, NavState::default(), UtcNs(0));
                plan
            })
            .collect();
        let measured = plans.split_off(60);
        let (allocations, checked) = pool.install(|| {
            let mut pipeline = SonarPipeline::new(sonar, &rig.medium).expect("fits");
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
        // The budget of cheap methods allows few samples; the others have enough by now.
        let cheap = model.contains("synthesis") && !model.contains("direct");
        assert!(checked || cheap, "{model}");
    }
}
