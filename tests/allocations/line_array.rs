//! Test that the line-array engine does not allocate after its buffers have processed the largest
//! task.

use echotank_testing::allocations;
use std::sync::Mutex;

use echotank_core::simd::SimdLevel;
use echotank_synthesis::array::gridded2d::{Filter, LineEngine, PulseMotion, Resolution};
use echotank_synthesis::echo::{LineWorkspace, TransmitLeg, insonify};
use glam::DVec3;
use num_complex::Complex64;

use echotank_testing::echo::ALWAYS;
use echotank_testing::line_scene::*;

#[test]
fn pings_of_changing_motion_allocate_nothing_after_the_first_round() {
    let _alone = allocations::alone();
    let drawn = |speed: f64| Draw {
        scatterers: 500,
        velocity_m_per_s: DVec3::new(speed, 0.1 * speed, 0.1 * speed),
        ..SIDE_SCAN
    };
    let scenes = [5.0, 4.0, 1.0].map(|speed| draw(drawn(speed)));
    let resolution = Resolution {
        section_elements: 16,
        slab_samples: 2048,
        time_width: 4,
        slope_width: 4,
        time_oversampling: 2.0,
        time_core: 1.0,
        slope_oversampling: 2.0,
        moments: 8,
        series: 2e-4,
        far: 1e-9,
        motion: PulseMotion::Stretch,
    };
    let decimator = &scenes[0].decimator;
    let filter = Filter {
        gain: &|f| decimator.gain(f),
        half_s: decimator.half_s(),
    };
    let rx = &scenes[0].rx;
    let mut engine = LineEngine::<f32>::new(rx, RATE_HZ, filter, resolution, SimdLevel::best());
    let mut transmit_leg = TransmitLeg::new();
    let walk = [Mutex::new(LineWorkspace::default())];
    let mut work = engine.work();
    let mut outputs = Vec::new();
    let mut record = vec![Complex64::ZERO; scenes[0].plan.sample_count];
    let mut counted = Vec::new();
    for scene in scenes.iter().chain(&scenes) {
        let before = allocations::in_all_threads();
        engine.prepare(&scene.plan);
        insonify(
            &scene.plan,
            &scene.tx,
            ALWAYS,
            &scene.scatterers,
            &mut transmit_leg,
        );
        let echoes = scene.echoes(&transmit_leg, &walk);
        outputs.resize_with(engine.tasks(), Vec::new);
        for (task, output) in outputs.iter_mut().enumerate() {
            engine.run(task, &echoes, &mut work, output);
        }
        engine.assemble(|task| &outputs[task], 3, &mut record);
        counted.push(allocations::in_all_threads() - before);
    }
    println!("allocations by ping: {counted:?}");
    assert!(counted[0] > 0 && counted[3..] == [0, 0, 0], "{counted:?}");
}
