//! Milliseconds of the line-array engine on a side-scan scene: `cargo run --release --example line_array -- ELEMENTS SCATTERERS STRETCH EPS SURGE SWAY HEAVE`.

use std::time::Instant;

use echotank::array::gridded::dialect::Dialect;
use echotank::array::gridded2d::{Filter, Fineness, LineEngine, PulseMotion};
use echotank::echo::{Illuminated, LineWorkspace, Window, illuminate, line_arrivals};
use glam::DVec3;

#[path = "../tests/echo_model/rig.rs"]
#[allow(dead_code, reason = "shared with the tests")]
mod rig;
#[path = "../tests/line_array/scene.rs"]
#[allow(dead_code, reason = "shared with the tests")]
mod scene;

use scene::*;

fn main() {
    let args: Vec<f64> = std::env::args()
        .skip(1)
        .map(|a| a.parse().expect("numbers"))
        .collect();
    let arg = |i: usize, default: f64| args.get(i).copied().unwrap_or(default);
    let scene = draw(Draw {
        elements: arg(0, 64.0) as usize,
        scatterers: arg(1, 1e5) as usize,
        velocity_m_per_s: DVec3::new(arg(4, 5.0), arg(5, 0.3), arg(6, 0.3)),
        far_m: 150.0,
        ..SIDE_SCAN
    });
    let eps = arg(3, 1e-3);
    let width = if eps >= 1e-3 { 4 } else { 6 };
    let fineness = Fineness {
        stretch: arg(2, 64.0) as usize,
        slab_samples: 2048,
        time_width: width,
        slope_width: width,
        moments: 8,
        series: eps / 10.0,
        motion: PulseMotion::Stretch,
    };
    let filter = Filter {
        gain: &|f| scene.decimator.gain(f),
        half_s: scene.decimator.half_s(),
    };
    let mut engine = LineEngine::<f32>::new(&scene.rx, RATE_HZ, filter, fineness, Dialect::best());
    engine.prepare(&scene.plan);
    let mut lit = Illuminated::new();
    let window = Window::of_samples(0.0, RATE_HZ, 20_000);
    illuminate(&scene.plan, &scene.tx, window, &scene.scatterers, &mut lit);
    let mut walk = LineWorkspace::default();
    let mut work = engine.work();
    let mut outputs = vec![Vec::new(); engine.tasks()];
    for _ in 0..2 {
        let (mut gathered, mut made) = (0.0, 0.0);
        let start = Instant::now();
        for (task, output) in outputs.iter_mut().enumerate() {
            let stretch = engine.wanted(task);
            let t = Instant::now();
            let mut gather = engine.gather(task, &mut work);
            line_arrivals(
                &scene.plan,
                &scene.rx,
                stretch,
                &lit,
                &mut walk,
                &mut gather,
            );
            gathered += t.elapsed().as_secs_f64();
            let t = Instant::now();
            let report = engine.synthesise(task, &mut work, output);
            made += t.elapsed().as_secs_f64();
            if task == 2 {
                println!("{report:?}");
            }
        }
        println!(
            "{} tasks: {:.0} ms one thread; geometry {:.0}, synthesis {:.0}",
            outputs.len(),
            1e3 * start.elapsed().as_secs_f64(),
            1e3 * gathered,
            1e3 * made
        );
    }
}
