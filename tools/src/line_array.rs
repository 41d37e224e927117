//! The line-array engine on a side-scan scene: largest windowed error and milliseconds per ping, one line each.
//!
//! `cargo run --release --example line_array -- elements=256 scatterers=1000000 tolerance=1e-3 threads=2 pings=5 surge=5 sway=0.3 heave=0.3
//! sector=15 check=2`. `check` is the number of elements compared with the direct sum. Timed: the transmit leg, and from there to the time
//! samples of all elements. Not timed: noise, gain, packets.

use std::collections::HashMap;
use std::sync::Mutex;
use std::time::Instant;

use echotank_core::ping::EchoCounts;
use echotank_core::scene::Scatterers;
use echotank_synthesis::array::gridded::simd_level::SimdLevel;
use echotank_synthesis::array::gridded2d::{Bounds, Gridded2d, Spec};
use echotank_synthesis::echo::{LineEchoes, LineWorkspace, TransmitLeg, Window, insonify};
use glam::DVec3;
use num_complex::Complex64;

#[path = "../../tests/echo_model/rig.rs"]
#[allow(dead_code, reason = "shared with the tests")]
mod rig;
#[path = "../../tests/line_array/scene.rs"]
#[allow(dead_code, reason = "shared with the tests")]
mod scene;

use rig::C;
use scene::*;

/// Side of the squares in which scatterers are stored together, metres.
const TILE_M: f64 = 3.0;

fn main() {
    let given: HashMap<String, String> = std::env::args()
        .skip(1)
        .filter_map(|arg| {
            let (key, value) = arg.split_once('=')?;
            Some((key.to_owned(), value.to_owned()))
        })
        .collect();
    let number = |key: &str, default: f64| {
        given
            .get(key)
            .map_or(default, |v| v.parse().expect("a number"))
    };
    let threads = number("threads", 2.0) as usize;
    rayon::ThreadPoolBuilder::new()
        .num_threads(threads)
        .build()
        .expect("threads")
        .install(|| run(&number, threads));
}

fn run(number: &impl Fn(&str, f64) -> f64, threads: usize) {
    let drawn = Draw {
        elements: number("elements", 256.0) as usize,
        scatterers: number("scatterers", 1e6) as usize,
        sector_deg: number("sector", 15.0),
        velocity_m_per_s: DVec3::new(
            number("surge", 5.0),
            number("sway", 0.3),
            number("heave", 0.3),
        ),
        far_m: number("far", 150.0),
        ..SIDE_SCAN
    };
    let mut scene = draw(drawn);
    by_tiles(&mut scene.scatterers);
    let tolerance = number("tolerance", 1e-3);
    let simd_level = match number("avx512", 1.0) {
        0.0 => SimdLevel::available().nth(1).unwrap_or(SimdLevel::PORTABLE),
        _ => SimdLevel::best(),
    };
    let spec = Spec {
        array: &scene.rx,
        pulse: &scene.plan.pulse,
        sound_speed_m_per_s: C,
        sample_rate_hz: RATE_HZ,
        filter: Some(&scene.decimator),
        model: &scene.plan.model,
        bounds: Bounds {
            nearest_m: drawn.near_m,
            greatest_slope: drawn.sector_deg.to_radians().sin(),
            along_m_per_s: drawn.velocity_m_per_s.x.abs(),
            across_m_per_s: drawn.velocity_m_per_s.with_x(0.0).length(),
            turning_rad_per_s: 0.0,
        },
        tolerance,
        level_range_db: 60.0,
        samples: scene.plan.sample_count,
        scatterers: drawn.scatterers,
        simd_level,
    };
    let mut engine = Gridded2d::new(&spec).expect("within reach");
    println!("{}", engine.error_model().why);
    let plan = &scene.plan;
    let window = Window::of_samples(plan.first_sample_s, RATE_HZ, plan.sample_count);
    let work: Vec<_> = (0..threads)
        .map(|_| Mutex::new(LineWorkspace::default()))
        .collect();
    let mut transmit_leg = TransmitLeg::new();
    let mut iq = vec![Complex64::ZERO; scene.rx.elements * plan.sample_count];
    let (mut best_insonified, mut best_all) = (f64::INFINITY, f64::INFINITY);
    let mut counts = EchoCounts::default();
    for _ in 0..number("pings", 5.0) as usize {
        let start = Instant::now();
        counts = insonify(
            plan,
            &scene.tx,
            window,
            &scene.scatterers,
            &mut transmit_leg,
        );
        let insonified_ms = 1e3 * start.elapsed().as_secs_f64();
        let echoes = LineEchoes {
            plan,
            array: &scene.rx,
            transmit_leg: &transmit_leg,
            work: &work,
        };
        counts += engine.synthesise(plan, &echoes, &mut iq);
        best_all = best_all.min(1e3 * start.elapsed().as_secs_f64());
        best_insonified = best_insonified.min(insonified_ms);
    }
    let checked = number("check", 0.0) as usize;
    let error = (0..checked)
        .map(|k| {
            let e = k * (scene.rx.elements - 1) / (checked - 1).max(1);
            let got = &iq[e * plan.sample_count..][..plan.sample_count];
            worst_window(got, &truth(&scene, e, false), plan.pulse.duration_s)
        })
        .fold(f64::NAN, f64::max);
    println!(
        "{} elements, {} scatterers, {threads} threads: error {error:.1e} in the worst window of {checked} elements (asked {tolerance:e}, \
         left out {:.1e}); {best_all:.1} ms, of which the transmit leg {best_insonified:.1}; {} echoes",
        drawn.elements,
        drawn.scatterers,
        engine.left_out(),
        counts.used
    );
}

/// Reorders scatterers so that those of one square are adjacent, as in a scene's tiles.
fn by_tiles(scatterers: &mut Scatterers) {
    let mut order: Vec<usize> = (0..scatterers.len()).collect();
    let tile = |i: usize| {
        let at_m = scatterers.position_m(i) / TILE_M;
        (at_m.y.floor() as i64, at_m.x.floor() as i64)
    };
    order.sort_by_key(|&i| tile(i));
    let mut sorted = Scatterers::default();
    for (k, i) in order.into_iter().enumerate() {
        // Independent phases: those of a low-discrepancy sequence cancel far better than random ones.
        let phase = std::f64::consts::TAU * hash(k as u64);
        sorted.push(
            scatterers.position_m(i),
            scatterers.normal[i],
            Complex64::from_polar(scatterers.strength[i].norm(), phase),
            scatterers.law[i],
        );
    }
    *scatterers = sorted;
}

/// Uniform in 0..1, by splitmix64 (Steele, Lea and Flood 2014).
fn hash(k: u64) -> f64 {
    let mut z = k.wrapping_add(1).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 53) as f64
}
