//! Moving targets, schools and plumes in whole pings, against their tracks.

use std::f64::consts::TAU;
use std::path::Path;

use glam::DVec3;
use num_complex::Complex64;

use echotank_config::spec::RigSpec;
use echotank_core::ping::{PingOutput, PingPlan};
use echotank_core::scene::MovingScatterer;
use echotank_ping::line_truth::line_truths;
use echotank_ping::make_ping;
use echotank_ping::method_selection::costs::Costs;
use echotank_ping::method_selection::{MotionScale, Scene, rank};
use echotank_ping::methods::Family;
use echotank_ping::threads::pool;
use echotank_runtime::config_files::parse;
use echotank_runtime::recorded::RecordedRig;

const C: f64 = 1500.0;
const CARRIER_HZ: f64 = 100e3;
const RATE_HZ: f64 = 40e3;
const PULSE_S: f64 = 1e-3;
const START_UTC_S: f64 = 1.7e9;
const SPEED_M_PER_S: f64 = 2.0;
const SONAR_M: f64 = 3.0;
const PINGS: u32 = 12;

/// Track of the target, seconds after the first fix: a parabola.
fn target_m(t: f64) -> DVec3 {
    DVec3::new(12.0 - 1.5 * t, 15.0 + 0.8 * t + 0.05 * t * t, 8.0 - 0.3 * t)
}

/// One omnidirectional transmitter and element on a platform that moves north.
fn config(folder: &Path, targets: &str, synthesis: &str, water: &str) -> RigSpec {
    config_of_pulse(
        folder,
        targets,
        synthesis,
        water,
        "kind = \"cw\"\nduration_ms = 1.0",
    )
}

fn config_of_pulse(
    folder: &Path,
    targets: &str,
    synthesis: &str,
    water: &str,
    pulse: &str,
) -> RigSpec {
    let mut rows = "time_s,north_m,east_m,down_m,roll_deg,pitch_deg,heading_deg\n".to_owned();
    for k in 0..60 {
        let t = f64::from(k) * 0.5;
        rows += &format!("{:.1},{},0,0,0,0,0\n", START_UTC_S + t, SPEED_M_PER_S * t);
    }
    std::fs::write(folder.join("nav.csv"), rows).expect("a track");
    let mut rows = "elapsed_s,north_m,east_m,down_m\n".to_owned();
    for k in 0..20 {
        let t = f64::from(k) * 1.5 - 3.0;
        let [north, east, down] = target_m(t).to_array();
        rows += &format!("{t},{north},{east},{down}\n");
    }
    std::fs::write(folder.join("target.csv"), rows).expect("a track");
    std::fs::write(folder.join("targets.toml"), targets).expect("targets");
    let text = format!(
        r#"
[medium]
{water}
absorption = "none"
[nav]
origin = {{ latitude_deg = 54.3, longitude_deg = 10.2 }}
mode = "settle"
vertical = "depth"
[[nav.source]]
name = "track"
kind = "csv"
path = "nav.csv"
[scene]
targets = "targets.toml"
[[sonar]]
name = "one"
[sonar.pulse]
{pulse}
center_frequency_khz = 100.0
[[sonar.transmit]]
name = "tx"
position_m = [0.0, 0.0, {SONAR_M}]
pattern = "omnidirectional"
[[sonar.receive]]
name = "rx"
elements = 1
spacing_m = 0.0075
position_m = [0.0, 0.0, {SONAR_M}]
element_pattern = "omnidirectional"
sensitivity_db = 0.0
[sonar.receiver]
sample_rate_khz = 40.0
rx_filter = "none"
noise_db = "none"
[sonar.ping]
range_m = 60.0
rate_hz = 1.0
source_level_db = 200.0
[sonar.model]
path = "polyline"
synthesis = "{synthesis}"
"#
    );
    parse(&text, folder).unwrap_or_else(|why| panic!("{why}"))
}

fn pings(
    spec: &RigSpec,
    threads: usize,
    mut take: impl FnMut(f64, f64, &RecordedRig, &PingOutput) + Send,
) {
    pool(threads).expect("threads").install(|| {
        let mut recorded = RecordedRig::open(spec).expect("opens");
        let mut slot = recorded.rig.slot(0);
        for _ in 0..PINGS {
            let (sonar, order) = recorded.next_order(PINGS).expect("an order");
            assert!(recorded.settle(sonar, &order));
            let (mode, utc) = (spec.nav.mode, order.transmit_utc);
            make_ping(&mut recorded.rig, sonar, &order, mode, utc, &mut slot).expect("a ping");
            let since_s = (utc.0 as f64 - START_UTC_S * 1e9) * 1e-9;
            take(since_s, slot.plan.first_sample_s, &recorded, &slot.output);
        }
    });
}

/// Water of one sound speed, and of a profile that has the same speed at all depths.
const WATERS: [&str; 2] = [
    "sound_speed_m_per_s = 1500.0",
    "profile = { points = [[0.0, 1500.0], [60.0, 1500.0]] }",
];

const POINT: &str = r#"
[[target]]
name = "diver"
track = "target.csv"
target_strength_db = -20.0
"#;

/// Sound speed at the surface in water of one gradient, m/s.
const SURFACE_C: f64 = 1515.0;

/// Travel time between two places in water of a gradient, in closed form: the ray is the arc of a circle.
fn travel_s(gradient_per_s: f64, a_m: DVec3, b_m: DVec3) -> f64 {
    let apart_m = a_m.distance(b_m);
    if gradient_per_s == 0.0 {
        return apart_m / C;
    }
    let [a, b] = [a_m, b_m].map(|m| SURFACE_C + gradient_per_s * m.z);
    let half = 0.5 * gradient_per_s.abs() * apart_m / (a * b).sqrt();
    2.0 * half.asinh() / gradient_per_s.abs()
}

/// Emission time of the sound that the element receives `after_s` seconds after the start of the pulse at `since_s`, by bisection.
fn emitted_s(gradient_per_s: f64, since_s: f64, after_s: f64) -> f64 {
    let sonar_m = |t: f64| DVec3::new(SPEED_M_PER_S * (since_s + t), 0.0, SONAR_M);
    let root = |mut low: f64, mut high: f64, f: &dyn Fn(f64) -> f64| {
        for _ in 0..100 {
            let middle = 0.5 * (low + high);
            match f(middle) < 0.0 {
                true => low = middle,
                false => high = middle,
            }
        }
        0.5 * (low + high)
    };
    let receive_m = sonar_m(after_s);
    let back_s = |hit: f64| travel_s(gradient_per_s, target_m(since_s + hit), receive_m);
    let hit_s = root(0.0, after_s, &|hit| hit + back_s(hit) - after_s);
    let hit_m = target_m(since_s + hit_s);
    root(-0.1, hit_s, &|sent| {
        sent + travel_s(gradient_per_s, sonar_m(sent), hit_m) - hit_s
    })
}

#[test]
fn records_of_a_moving_target_agree_with_its_track() {
    for water in WATERS {
        records_agree(water, 0.0);
    }
}

/// Through water of one gradient, the phase of every sample is that of the rays to the target and back, and with it delay and Doppler. The straight ways would
/// be off by several turns.
#[test]
fn a_moving_target_in_a_gradient_has_the_phase_of_its_rays() {
    let gradient_per_s = -0.5;
    let water = format!(
        "profile = {{ points = [[0.0, {SURFACE_C}], [60.0, {}]] }}",
        SURFACE_C + 60.0 * gradient_per_s
    );
    records_agree(&water, gradient_per_s);
}

fn records_agree(water: &str, gradient_per_s: f64) {
    // Greatest error of the phase, radians.
    let most_rad = 1e-3;
    let emitted_s = |since_s: f64, after_s: f64| emitted_s(gradient_per_s, since_s, after_s);
    let folder = tempfile::tempdir().expect("a folder");
    let spec = config(folder.path(), POINT, "direct", water);
    let (mut late, mut turned, mut shifted, mut seen) = (0.0_f64, 0.0_f64, 0.0_f64, 0);
    pings(&spec, 2, |since_s, first_s, recorded, output| {
        assert_eq!(output.scene.moving, 1);
        let iq = output.elements[0].element(0);
        let time_s = |k: usize| first_s + k as f64 / RATE_HZ;
        let first = iq.iter().position(|x| x.norm() > 0.0).expect("an echo");
        // The leading edge lies within the sample before the first of the echo.
        let off_s = 1e-9 + most_rad / (TAU * CARRIER_HZ);
        assert!(emitted_s(since_s, time_s(first)) >= -off_s);
        assert!(emitted_s(since_s, time_s(first - 1)) <= off_s);
        late = late.max(emitted_s(since_s, time_s(first)) * RATE_HZ);
        for k in [first, first + 20, first + 39] {
            let t = time_s(k);
            let cycles = CARRIER_HZ * (emitted_s(since_s, t) - t);
            let want = Complex64::cis(TAU * (cycles - cycles.round()));
            turned = turned.max((iq[k] / iq[k].norm() / want).arg().abs());
        }
        // Doppler over the echo, against the range rate of the truth.
        let target = &recorded.rig.targets()[0];
        let utc = recorded
            .rig
            .history
            .first_fix_utc()
            .expect("a fix")
            .plus_s(since_s);
        let (at_m, velocity) = target.at(utc, 0.0);
        assert!(at_m.distance(target_m(since_s)) < 1e-6, "{at_m}");
        let offset_m = at_m - DVec3::new(SPEED_M_PER_S * since_s, 0.0, SONAR_M);
        let rate = (velocity - DVec3::X * SPEED_M_PER_S).dot(offset_m) / offset_m.length();
        let measured_hz = (iq[first + 30] / iq[first]).arg() / TAU * RATE_HZ / 30.0;
        let turns = ((-2.0 * rate / C * CARRIER_HZ - measured_hz) * 30.0 / RATE_HZ).round();
        let measured_hz = measured_hz + turns * RATE_HZ / 30.0;
        shifted = shifted.max((measured_hz + 2.0 * rate / C * CARRIER_HZ).abs());
        seen += 1;
    });
    println!(
        "{seen} pings: phase within {turned:.1e} rad, Doppler within {shifted:.2} Hz of the range rate at the pulse"
    );
    assert!(late <= 1.0 + 1e-6);
    assert!(turned < most_rad, "{turned}");
    // Second order of (v/c), and the change of the range rate until the sound arrives: 133 Hz per m/s times 0.02 m/s.
    assert!(
        shifted < 3.0 || gradient_per_s != 0.0,
        "{shifted} Hz: a straight range rate"
    );
}

const SWARMS: &str = r#"
[[target]]
name = "diver"
north_m = 9.0
east_m = 14.0
down_m = 9.0
velocity_m_per_s = [-1.0, 0.5, 0.0]
target_strength_db = -20.0
[[target]]
name = "drum"
shape = "cylinder"
north_m = 3.0
east_m = 20.0
down_m = 9.0
radius_m = 0.3
length_m = 1.0
velocity_m_per_s = [0.5, 0.0, 0.0]
target_strength_db = -15.0
[[target]]
name = "herring"
shape = "school"
north_m = 15.0
east_m = 25.0
down_m = 12.0
size_m = [6.0, 4.0, 2.0]
individuals = 300
swim_m_per_s = 0.5
velocity_m_per_s = [0.2, 0.1, 0.0]
target_strength_db = -45.0
[[target]]
name = "resting"
shape = "school"
north_m = -10.0
east_m = -15.0
down_m = 12.0
size_m = [2.0, 2.0, 2.0]
individuals_per_m3 = 20.0
target_strength_db = -45.0
[[target]]
name = "seep"
shape = "plume"
north_m = 5.0
east_m = -30.0
down_m = 20.0
radius_m = 0.2
spread = 0.1
bubbles_per_m = 20.0
drift_m_per_s = [0.05, 0.0]
target_strength_db = -60.0
"#;

#[test]
fn schools_and_plumes_are_the_same_with_any_engine_and_threads() {
    let folder = tempfile::tempdir().expect("a folder");
    let of = |synthesis, threads| {
        let spec = config(folder.path(), SWARMS, synthesis, WATERS[0]);
        let mut all: Vec<Complex64> = Vec::new();
        pings(&spec, threads, |_, _, _, output| {
            // A point, a cylinder, 300 fish and 400 bubbles; 84 fish rest.
            assert!(
                output.scene.moving > 1 + 64 + 690,
                "{}",
                output.scene.moving
            );
            assert_eq!(output.scene.targets, 1);
            all.extend(output.elements[0].iq.iter());
        });
        all
    };
    let one = of("direct", 1);
    assert!(one == of("direct", 3));
    let gridded = of("reference", 2);
    let off: f64 = one
        .iter()
        .zip(&gridded)
        .map(|(a, b)| (a - b).norm_sqr())
        .sum();
    let all: f64 = one.iter().map(|a| a.norm_sqr()).sum();
    assert!((off / all).sqrt() < 1e-3, "{}", (off / all).sqrt());
}

/// The line's label of a moving target lies where its echo does, also where the water scatters.
#[test]
fn a_moving_target_has_its_label_among_other_scatterers() {
    let folder = tempfile::tempdir().expect("a folder");
    let water = format!(
        "{}\nvolume = [{{ top_m = 5.0, bottom_m = 12.0, sv_db = -110.0 }}]",
        WATERS[0]
    );
    let line = "direct\"\n[sonar.beams]\nstarboard = \"rx";
    let spec = config(folder.path(), POINT, line, &water);
    pool(2).expect("threads").install(|| {
        let mut recorded = RecordedRig::open(&spec).expect("opens");
        let mut slot = recorded.rig.slot(0);
        for _ in 0..3 {
            let (sonar, order) = recorded.next_order(3).expect("an order");
            assert!(recorded.settle(sonar, &order));
            let (mode, utc) = (spec.nav.mode, order.transmit_utc);
            make_ping(&mut recorded.rig, sonar, &order, mode, utc, &mut slot).expect("a ping");
            assert!(slot.output.scene.volume > 100);
            let since_s = (utc.0 as f64 - START_UTC_S * 1e9) * 1e-9;
            let sonar_m = DVec3::new(SPEED_M_PER_S * since_s, 0.0, SONAR_M);
            let range_m = target_m(since_s).distance(sonar_m);
            let want = 2.0 * range_m / C * RATE_HZ;
            let truth = &line_truths(&recorded.rig, &slot)[0];
            let labelled: Vec<usize> = (0..truth.target.len())
                .filter(|k| truth.target[*k] == 1)
                .collect();
            let middle = labelled.iter().sum::<usize>() as f64 / labelled.len().max(1) as f64;
            println!(
                "{} samples about {middle}, echo at {want:.1}",
                labelled.len()
            );
            assert!(!labelled.is_empty() && (middle - want).abs() < 3.0);
            // As long as the pulse.
            assert!(labelled.len() as f64 <= PULSE_S * RATE_HZ + 2.0);
        }
    });
}

/// Mean intensity of a school over pings: the sum of the individuals' strengths over range to the fourth power.
#[test]
fn the_level_of_a_school_is_that_of_its_individuals() {
    let folder = tempfile::tempdir().expect("a folder");
    let school = r#"
[[target]]
name = "school"
shape = "school"
north_m = 11.0
east_m = 40.0
down_m = 5.0
size_m = [30.0, 0.02, 0.02]
heading_deg = 90.0
individuals = 1500
swim_m_per_s = 1.0
target_strength_db = -40.0
"#;
    let spec = config(folder.path(), school, "direct", WATERS[0]);
    let (mut energy, mut want) = (0.0, 0.0);
    pings(&spec, 2, |since_s, _, recorded, output| {
        energy += output.elements[0]
            .iq
            .iter()
            .map(|x| x.norm_sqr())
            .sum::<f64>();
        let moving = &recorded.rig.scatterers().moving;
        assert_eq!(moving.len(), 1500);
        let sonar_m = DVec3::new(SPEED_M_PER_S * since_s, 0.0, SONAR_M);
        for s in moving {
            let range_m = s.position_m.distance(sonar_m);
            want += 1e20 * 1e-4 / range_m.powi(4) * PULSE_S * RATE_HZ;
        }
    });
    let db = 10.0 * (energy / want).log10();
    println!("{db:+.2} dB");
    assert!(db.abs() < 0.5, "{db} dB");
}

/// A school whose fish turn fast while it passes at speed, in long pulses: errors of windows against the sum of exact waves, and what is predicted.
#[test]
fn the_error_of_moving_scatterers_is_predicted() {
    let folder = tempfile::tempdir().expect("a folder");
    for (name, pulse, speed, individuals) in [
        (
            "one, chirp",
            "kind = \"lfm\"\nbandwidth_khz = 12.0\nduration_ms = 8.0",
            18.0,
            1,
        ),
        (
            "school, chirp",
            "kind = \"lfm\"\nbandwidth_khz = 12.0\nduration_ms = 8.0",
            18.0,
            80,
        ),
        (
            "school, tone",
            "kind = \"cw\"\nduration_ms = 10.0",
            12.0,
            60,
        ),
        (
            "slow school, tone",
            "kind = \"cw\"\nduration_ms = 4.0",
            1.0,
            60,
        ),
    ] {
        let school = format!(
            "[[target]]\nname = \"school\"\nshape = \"school\"\nnorth_m = 2.0\neast_m = 11.0\ndown_m = 6.0\n\
             size_m = [7.0, 5.0, 2.0]\nindividuals = {individuals}\nswim_m_per_s = 2.0\n\
             velocity_m_per_s = [-{speed}, {}, 0.0]\ntarget_strength_db = -45.0\n",
            0.5 * speed
        );
        let spec = config_of_pulse(folder.path(), &school, "direct", WATERS[0], pulse);
        pool(2).expect("threads").install(|| {
            let mut recorded = RecordedRig::open(&spec).expect("opens");
            let mut slot = recorded.rig.slot(0);
            let (sonar, order) = recorded.next_order(1).expect("an order");
            assert!(recorded.settle(sonar, &order));
            let (mode, utc) = (spec.nav.mode, order.transmit_utc);
            make_ping(&mut recorded.rig, sonar, &order, mode, utc, &mut slot).expect("a ping");
            let (plan, scatterers) = (&slot.plan, recorded.rig.scatterers());
            assert_eq!(scatterers.moving.len(), individuals);
            let ranking = rank(
                &Scene {
                    spec: &spec.sonars[0],
                    medium: &spec.medium,
                    plan,
                    scatterers,
                    count: 0,
                    costs: &Costs::committed(),
                    motion_scale: MotionScale::NONE,
                },
                &[],
            );
            let part = ranking
                .expect("methods")
                .chosen()
                .part(Family::Moving)
                .clone();
            let iq = slot.output.elements[0].element(0);
            let want = exact_samples(plan, &scatterers.moving, iq.len());
            let window = (plan.pulse.duration_s * RATE_HZ) as usize;
            let energy = |w: &[Complex64]| w.iter().map(|x| x.norm_sqr()).sum::<f64>();
            let starts = || (0..iq.len() - window).step_by(window / 8);
            let strongest = starts().map(|k| energy(&want[k..k + window]));
            let floor = strongest.fold(0.0, f64::max) * 10f64.powf(-5.5);
            let errors = starts().map(|k| {
                let pairs = iq[k..k + window].iter().zip(&want[k..k + window]);
                let off: f64 = pairs.map(|(a, b)| (a - b).norm_sqr()).sum();
                (off / energy(&want[k..k + window]).max(floor)).sqrt()
            });
            let worst = errors.fold(0.0, f64::max);
            println!(
                "{name}: {worst:.2e}, predicted {:.2e} ({})",
                part.error, part.why
            );
            assert!(
                worst <= part.error,
                "{name}: {worst:.2e} {:.2e}",
                part.error
            );
            assert!(
                part.error < 12.0 * worst,
                "{name}: {worst:.2e} {:.2e}",
                part.error
            );
            assert!(part.cost_ms > 0.0);
        });
    }
}

/// Sum of the waves of all scatterers, each emission time by Newton's iteration on the whole trajectory.
fn exact_samples(plan: &PingPlan, moving: &[MovingScatterer], count: usize) -> Vec<Complex64> {
    let sonar_m = |t: f64| plan.trajectory.pose_at(t).point_m(DVec3::Z * SONAR_M);
    let mut sum = vec![Complex64::ZERO; count];
    for s in moving {
        let at_m = |t: f64| {
            let since_s = t - s.hit_s;
            s.position_m
                + s.velocity_m_per_s * t
                + s.acceleration_m_per_s2 * (0.5 * since_s * since_s)
        };
        // Fixed points: each round is better by the ratio of the speeds.
        let emitted = |t: f64| {
            let receive_m = sonar_m(t);
            let mut hit_s = t - at_m(t).distance(receive_m) / C;
            for _ in 0..12 {
                hit_s = t - at_m(hit_s).distance(receive_m) / C;
            }
            let hit_m = at_m(hit_s);
            let mut sent_s = hit_s - sonar_m(hit_s).distance(hit_m) / C;
            for _ in 0..12 {
                sent_s = hit_s - sonar_m(sent_s).distance(hit_m) / C;
            }
            (sent_s, (hit_s - sent_s) * C, (t - hit_s) * C)
        };
        let (mut low, mut high) = (0.0, 0.2);
        for _ in 0..60 {
            let middle = 0.5 * (low + high);
            match emitted(middle).0 < 0.0 {
                true => low = middle,
                false => high = middle,
            }
        }
        let (_, out_m, back_m) = emitted(low);
        let amplitude = s.strength * 1e10 / (out_m * back_m);
        for (k, sum) in sum.iter_mut().enumerate() {
            let t = plan.first_sample_s + k as f64 / RATE_HZ;
            if t < low || t > low + 1.1 * plan.pulse.duration_s {
                continue;
            }
            let (sent_s, ..) = emitted(t);
            let cycles = CARRIER_HZ * (sent_s - t);
            *sum += amplitude
                * plan.pulse.envelope(sent_s)
                * Complex64::cis(TAU * (cycles - cycles.round()));
        }
    }
    sum
}
