//! Tests of method selection: transitions between models, predictions on random rigs, and independence of run time.

mod parts;

use std::f64::consts::TAU;
use std::path::Path;
use std::sync::Arc;

use echotank_config::spec::{Density, RigSpec};
use echotank_core::frames::Trajectory;
use echotank_core::model::{DopplerModel, PathModel, Synthesis};
use echotank_core::ping::{ErrorCheck, PingPlan};
use echotank_core::scene::Scatterers;
use echotank_core::sound_speed::SoundSpeedProfile;
use echotank_core::time::UtcNs;
use echotank_ping::method_selection::costs::Costs;
use echotank_ping::method_selection::{MotionScale, Scene, rank};
use echotank_ping::threads::pool;
use echotank_runtime::first_pings::{first, pings};
use echotank_runtime::recorded::RecordedRig;
use glam::{DQuat, DVec3};
use rayon::prelude::*;

use crate::accuracy::rigs::case;
use crate::accuracy::rigs::measure::measure;
use echotank_ping::PingOrder;
use echotank_ping::rig::PingSlot;
use echotank_testing::track::{ALONG_TRACK, rows};

const C: f64 = 1500.0;
const CARRIER_HZ: f64 = 400e3;
const PULSE_S: f64 = 5e-3;
/// Length of both apertures.
const APERTURE_M: f64 = 0.2;
const RANGE_M: f64 = 75.0;

/// Rig with one point at 75 m, `angle_deg` from the track. Transmitter and element are omnidirectional or, if `focused`, 0.2 m
/// long.
fn rig(folder: &Path, angle_deg: f64, focused: bool, model: &str) -> RigSpec {
    let (sin, cos) = angle_deg.to_radians().sin_cos();
    let point = format!(
        "north_m,east_m,down_m,amplitude\n{:.6},{:.6},5.0,1.0\n",
        RANGE_M * cos,
        RANGE_M * sin
    );
    std::fs::write(folder.join("points.csv"), point).expect("write");
    at_speed(folder, |_| 0.0);
    let pattern = |prefix: &str| match focused {
        true => format!(
            "{prefix}pattern = \"rectangle\"\n{prefix}length_m = {APERTURE_M}\n{prefix}width_m = 0.0\n"
        ),
        false => String::new(),
    };
    let (lit, heard) = (pattern(""), pattern("element_"));
    let error_check = match model.contains("error_check") {
        true => "",
        false => "error_check = false",
    };
    let text = format!(
        r#"[medium]
sound_speed_m_per_s = {C}
absorption = "none"
{ALONG_TRACK}[scene]
points = "points.csv"
[run]
latency_ms = 600.0
[[sonar]]
name = "one"
[sonar.pulse]
kind = "lfm"
sweep = "up"
center_frequency_khz = {carrier_khz}
bandwidth_khz = 30.0
duration_ms = {pulse_ms}
taper = 0.1
[[sonar.transmit]]
name = "tx"
position_m = [0.0, 0.0, 0.0]
roll_deg = -90.0
{lit}
[[sonar.receive]]
name = "rx"
transmit = "tx"
elements = 1
spacing_m = 0.1
position_m = [0.0, 0.0, 0.0]
roll_deg = -90.0
sensitivity_db = 0.0
{heard}
[sonar.receiver]
sample_rate_khz = 60.0
rx_filter = "none"
noise_db = "none"
tvg = "none"
full_scale_v = 1.0
[sonar.ping]
range_m = 90.0
rate_hz = 2.0
source_level_db = 200.0
gain_db = 0.0
[sonar.limits]
range_m = [1.0, 90.0]
ping_rate_hz = [0.1, 20.0]
source_level_db = [170.0, 220.0]
gain_db = [-30.0, 40.0]
pulse_duration_ms = [{pulse_ms}, {pulse_ms}]
[sonar.model]
{error_check}
{model}
"#,
        carrier_khz = CARRIER_HZ / 1e3,
        pulse_ms = PULSE_S * 1e3,
    );
    echotank_runtime::config_files::parse(&text, folder)
        .unwrap_or_else(|why| panic!("{why}\n{text}"))
}

struct One {
    rig: RigSpec,
    plan: PingPlan,
    scatterers: Scatterers,
    costs: Costs,
}

impl One {
    fn new(angle_deg: f64, focused: bool, model: &str) -> Self {
        let folder = tempfile::tempdir().expect("folder");
        let rig = rig(folder.path(), angle_deg, focused, model);
        let (plan, scatterers) = pings(&rig, 0).expect("a ping").swap_remove(0);
        Self {
            rig,
            plan,
            scatterers,
            costs: Costs::committed(),
        }
    }

    /// The selection at this speed and tolerance.
    fn at(&self, speed: f64, tolerance: f64) -> (PathModel, DopplerModel) {
        let mut spec = self.rig.sonars[0].clone();
        spec.synthesis.tolerance = tolerance;
        let mut plan = self.plan.clone();
        let here = plan.trajectory.pose_at(0.0).position_m;
        plan.trajectory = Trajectory::uniform(here, DVec3::X * speed, DQuat::IDENTITY);
        let scene = Scene {
            spec: &spec,
            medium: &self.rig.medium,
            plan: &plan,
            scatterers: &self.scatterers,
            count: self.scatterers.len(),
            costs: &self.costs,
            motion_scale: MotionScale::NONE,
        };
        let model = rank(&scene, &[]).expect("a plan").chosen().choice.model;
        (model.path, model.doppler)
    }
}

/// Limit of validity of `cheap`, by bisection in logarithms. `cheap` is valid at `holds` and not at `fails`.
fn crossing(holds: f64, fails: f64, cheap: impl Fn(f64) -> bool) -> f64 {
    assert!(cheap(holds) && !cheap(fails), "{holds} to {fails}");
    let (mut holds, mut fails) = (holds, fails);
    for _ in 0..24 {
        let middle = (holds * fails).sqrt();
        match cheap(middle) {
            true => holds = middle,
            false => fails = middle,
        }
    }
    holds
}

fn near(got: f64, want: f64, what: &str) {
    println!("{what}: crosses at {got:.3e}, the formula says {want:.3e}");
    assert!(
        (got / want - 1.0).abs() < 0.2,
        "{what}: {got:e}, formula {want:e}"
    );
}

/// rms(4 pi v r cos(theta)/(c lambda)) of samples: the limit for ignoring motion.
#[test]
fn samples_need_more_than_stop_and_hop_above_the_formulas_limit() {
    let model = "path = \"auto\"\ndoppler = \"stretch-quadratic\"\nsynthesis = \"direct\"";
    for angle_deg in [30.0, 60.0] {
        let one = One::new(angle_deg, false, model);
        let lambda_m = C / CARRIER_HZ;
        let cos = f64::to_radians(angle_deg).cos();
        for tolerance in [1e-3, 1e-2] {
            let got = crossing(1e-9, 1.0, |v| {
                one.at(v, tolerance).0 == PathModel::StopAndHop
            });
            let want = tolerance * C * lambda_m / (2.0 * TAU * RANGE_M * cos);
            near(got, want, "stop-and-hop, m/s");
        }
    }
}

/// 2 pi f_c |d| T/sqrt(12) if an unstretched pulse is centred on its echo. Here its leading edge is that of the echo, and the phase
/// error grows from there, so the error is twice that. A window may hold only the last quarter of the echo. From a to 1 of the
/// pulse, the mean square of the phase is 1 + a + a^2 times that of the whole pulse.
#[test]
fn samples_need_doppler_above_the_formulas_limit() {
    let model = "path = \"continuous\"\ndoppler = \"auto\"\nsynthesis = \"direct\"";
    let one = One::new(60.0, false, model);
    let cos = f64::to_radians(60.0).cos();
    for tolerance in [1e-3, 1e-2] {
        let got = crossing(1e-9, 1.0, |v| one.at(v, tolerance).1 == DopplerModel::None);
        let d_per_m_per_s = 2.0 * cos / C;
        let middle = TAU * CARRIER_HZ * d_per_m_per_s * PULSE_S / 12f64.sqrt();
        let last_quarter = (1.0 + 0.75 + 0.75f64.powi(2)).sqrt();
        let want = tolerance / (2.0 * middle * last_quarter);
        near(got, want, "no Doppler, m/s");
    }
}

/// v r/c of a quarter of a cell along the track, and |d| f_c T/B of a tenth of a cell in range.
#[test]
fn images_need_better_models_above_their_formulas_limits() {
    let model =
        "path = \"auto\"\ndoppler = \"stretch\"\nsynthesis = \"direct\"\ntolerance_image = 0.1";
    let broadside = One::new(90.0, true, model);
    let lambda_m = C / CARRIER_HZ;
    let got = crossing(1e-3, 100.0, |v| {
        broadside.at(v, 1e-3).0 == PathModel::StopAndHop
    });
    let cell_m = 0.64 * lambda_m * RANGE_M / APERTURE_M;
    near(
        got,
        0.25 * cell_m * C / RANGE_M,
        "a picture's stop-and-hop, m/s",
    );

    let model =
        "path = \"continuous\"\ndoppler = \"auto\"\nsynthesis = \"direct\"\ntolerance_image = 0.1";
    let ahead = One::new(60.0, false, model);
    let got = crossing(1e-6, 10.0, |v| ahead.at(v, 1e-3).1 == DopplerModel::None);
    let d_per_m_per_s = 2.0 * f64::to_radians(60.0).cos() / C;
    near(
        got,
        0.1 / (d_per_m_per_s * CARRIER_HZ * PULSE_S),
        "a picture's Doppler, m/s",
    );
}

#[test]
fn slow_or_tolerant_sonars_get_cheap_models_and_ten_knots_at_1e_4_does_not() {
    let one = One::new(
        60.0,
        false,
        "path = \"auto\"\ndoppler = \"auto\"\nsynthesis = \"direct\"",
    );
    assert_eq!(
        one.at(0.0, 1e-4),
        (PathModel::StopAndHop, DopplerModel::None)
    );
    assert_eq!(
        one.at(1e-6, 1e-2),
        (PathModel::StopAndHop, DopplerModel::None)
    );
    let (path, doppler) = one.at(5.144, 1e-4);
    assert!(
        path != PathModel::StopAndHop && doppler != DopplerModel::None,
        "{path:?} {doppler:?}"
    );
}

/// A virtual point is exact at the place of the sonar at the pulse, not at the ends of an array and where it is when it hears the echo.
#[test]
fn predicted_errors_include_the_virtual_points_of_water_that_bends_sound() {
    let file = crate::repository().join("hil-configs/surveyor240.toml");
    let mut spec = echotank_runtime::config_files::load(&file).expect("a rig");
    let error = |spec: &RigSpec| {
        let firsts = first(spec, &Costs::committed()).expect("a ping");
        firsts[0].ranking.as_ref().expect("a plan").chosen().error()
    };
    let straight = error(&spec);
    let mut bent = |gradient_per_s: f64| {
        let points = vec![(0.0, 1500.0), (100.0, 1500.0 + 100.0 * gradient_per_s)];
        let profile = SoundSpeedProfile::new(points).expect("sound");
        spec.medium.profile = Some(Arc::new(profile));
        error(&spec)
    };
    let (weak, strong) = (bent(-0.016), bent(-1.5));
    println!("{straight:.1e}, -0.016 /s {weak:.1e}, -1.5 /s {strong:.1e}");
    assert!(weak < strong && straight < strong && strong < 1.0);
}

/// `tools/accuracy rigs` is the long form.
#[test]
fn on_small_random_rigs_the_predicted_error_is_an_upper_bound() {
    let costs = Costs::committed();
    let pool = pool(2).expect("threads");
    for seed in [3, 8, 21, 13, 5] {
        let folder = tempfile::tempdir().expect("folder");
        let (spec, about) = case::random(seed, folder.path(), true);
        let measured = pool
            .install(|| measure(&spec, &costs, false))
            .unwrap_or_else(|why| panic!("seed {seed}: {why}: {about}"));
        for of in measured.iter().filter(|of| !of.out_of_reach) {
            let said = format!("seed {seed}, {about}: {}", of.said());
            println!("{said}");
            assert!(of.plan.error <= of.tolerance, "{said}");
            assert!(of.plan.error <= of.plan.predicted_error, "{said}");
        }
    }
}

/// For explicit floors, the prediction also bounds the worst window, and is at most ten times too high.
#[test]
fn the_error_of_a_fixed_floor_is_bounded_within_ten_times() {
    let costs = Costs::committed();
    let folder = crate::repository().join("tests/data/rigs");
    for (file, floor_db) in [("omniscan450", -40.0), ("board", -30.0)] {
        let mut spec = echotank_runtime::config_files::load(&folder.join(format!("{file}.toml")))
            .expect("good");
        spec.scene.seabed.as_mut().expect("a seabed").density = Density::PerM2(1.0);
        for sonar in &mut spec.sonars {
            sonar.synthesis.culls_by_window = false;
            sonar.model.cull_db = Some(floor_db);
        }
        let measured = pool(2)
            .expect("threads")
            .install(|| measure(&spec, &costs, false))
            .unwrap_or_else(|why| panic!("{file}: {why}"));
        for of in measured {
            let said = format!("{file} at {floor_db} dB: {}", of.said());
            println!("{said}");
            assert!(of.out_of_reach, "{said}");
            assert!(of.plan.error <= of.plan.predicted_error, "{said}");
            assert!(of.plan.predicted_error <= 10.0 * of.plan.error, "{said}");
        }
    }
}

/// The cost by the committed table fits two cores.
#[test]
fn every_configurations_selection_meets_its_tolerance() {
    let costs = Costs::committed();
    let folder = crate::repository().join("hil-configs");
    let mut files: Vec<_> = std::fs::read_dir(&folder)
        .expect("folder")
        .map(|entry| entry.expect("entry").path())
        .filter(|path| path.extension().is_some_and(|e| e == "toml"))
        .collect();
    files.sort();
    assert!(files.len() >= 18, "{files:?}");
    pool(2).expect("threads").install(|| {
        files.par_iter().for_each(|file| {
            let spec =
                echotank_runtime::config_files::load(file).unwrap_or_else(|why| panic!("{why}"));
            let firsts = first(&spec, &costs).unwrap_or_else(|why| panic!("{file:?}: {why}"));
            let mut each_ms = 0.0;
            for (sonar, first) in spec.sonars.iter().zip(&firsts) {
                let ranking = first.ranking.as_ref().expect("can be made");
                let chosen = ranking.chosen();
                let said = format!(
                    "{file:?} {}: {}: {:.1e} of {:.1e}, {:.1} ms",
                    sonar.name,
                    chosen.text(),
                    chosen.error(),
                    ranking.goal.tolerance,
                    chosen.cost_ms()
                );
                println!("{said}");
                // The line of the soak rig remains whole with the full tolerance, and its error checks meet it. At 4 m no section
                // is short enough for a smaller tolerance.
                let is_soak = file.ends_with("soak.toml");
                assert!(ranking.is_within() != is_soak, "{said}");
                if is_soak {
                    continue;
                }
                // On two threads.
                each_ms += 0.5 * chosen.cost_ms() * sonar.settings.max_ping_rate_hz;
            }
            assert!(each_ms < 900.0, "{file:?}: {each_ms:.0} ms of every second");
        });
    });
}

/// Writes a track of 28 s. `north_m` gives the position along it, metres, at a time in seconds.
fn at_speed(folder: &Path, north_m: impl Fn(f64) -> f64) {
    let track = rows(280, 0.1, |t_s| [north_m(t_s), 0.0, 5.0, 0.0, 0.0, 0.0]);
    std::fs::write(folder.join("track.csv"), track).expect("write");
}

/// Computes pings of the first sonar, and passes each on.
fn each_ping(
    recorded: &mut RecordedRig,
    spec: &RigSpec,
    (first, last): (u32, u32),
    mut then: impl FnMut(&mut RecordedRig, &PingOrder, &PingSlot),
) {
    let mut slot = recorded.rig.slot(0);
    while let Some((sonar, order)) = recorded.next_order(last) {
        if order.ping_number < first {
            assert!(recorded.pass_over(first, sonar, &order, &mut slot));
            continue;
        }
        assert!(recorded.settle(sonar, &order), "the track is long enough");
        let (rig, mode) = (&mut recorded.rig, spec.nav.mode);
        echotank_ping::make_ping(rig, sonar, &order, mode, UtcNs(0), &mut slot).expect("no gap");
        then(recorded, &order, &slot);
    }
}

/// A ping: its number, whether it has Doppler, and a checksum of its samples.
type Seen = (u32, bool, u64);

/// The pings from `first` on of a platform that is at rest and moves from 4 s on.
fn voyage(threads: usize, first: u32) -> Vec<Seen> {
    let folder = tempfile::tempdir().expect("folder");
    let model = "path = \"auto\"\ndoppler = \"auto\"\nsynthesis = \"direct\"\ntolerance = 1e-2";
    let spec = rig(folder.path(), 60.0, false, model);
    at_speed(folder.path(), |t_s| 0.5 * (t_s - 4.0).max(0.0));
    pool(threads).expect("threads").install(|| {
        let mut recorded = RecordedRig::open(&spec).expect("opens");
        let mut seen = Vec::new();
        each_ping(&mut recorded, &spec, (first, 45), |_, order, slot| {
            let bits = slot.output.elements[0].iq.iter().fold(0u64, |sum, x| {
                sum.wrapping_mul(31)
                    .wrapping_add(x.re.to_bits() ^ x.im.to_bits().rotate_left(7))
            });
            let doppler = slot.plan.model.doppler;
            seen.push((order.ping_number, doppler != DopplerModel::None, bits));
        });
        seen
    })
}

/// Blocks are of 8 pings (2 Hz, 4 s). The platform moves from ping 9 on, the first of block 1. The selection for block 2 sees that.
#[test]
fn a_platform_that_starts_moving_changes_the_selection_with_a_block_of_pings() {
    let once = voyage(1, 1);
    let changed = once.iter().find(|(_, has_doppler, _)| *has_doppler);
    let changed = changed.expect("another selection").0;
    assert!([17, 25].contains(&changed), "{changed}");
    assert!(
        once.iter()
            .all(|(number, has_doppler, _)| (*number >= changed) == *has_doppler)
    );
    assert_eq!(once, voyage(2, 1));
}

/// The selection looks back at no more than it may: a replay that begins anywhere makes the same samples.
#[test]
fn a_replay_that_begins_later_has_the_same_methods_and_samples() {
    let whole = voyage(1, 1);
    for first in [2, 8, 9, 16, 17, 20, 24, 25, 31, 33, 45] {
        assert_eq!(
            voyage(1, first),
            whole[first as usize - 1..],
            "from {first}"
        );
    }
}

/// A platform that stands still for three pings and then starts: the pings until the next selection are made on the exact trajectory and predict
/// what their Doppler model leaves.
#[test]
fn pings_that_move_more_than_their_selection_expected_say_so() {
    let folder = tempfile::tempdir().expect("folder");
    let model = "path = \"auto\"\ndoppler = \"auto\"\nsynthesis = \"direct\"\ntolerance = 1e-2";
    let spec = rig(folder.path(), 60.0, false, model);
    at_speed(folder.path(), |t_s| 3.0 * (t_s - 2.0).max(0.0));
    let mut pings = Vec::new();
    pool(1).expect("threads").install(|| {
        let mut recorded = RecordedRig::open(&spec).expect("opens");
        each_ping(&mut recorded, &spec, (1, 20), |_, _, slot| {
            let methods = slot.output.methods.expect("a plan");
            pings.push((slot.plan.model, methods));
        });
    });
    let tolerance = 1e-2;
    let (first, resting) = pings[0];
    assert_eq!(first.doppler, DopplerModel::None);
    assert!(resting.predicted_error <= tolerance, "{resting:?}");
    // 2 Hz: ping 8 moves at 3 m/s, by the methods for a platform at rest. The exact trajectory would leave the same error, that of no Doppler.
    let (model, moving) = pings[7];
    assert_eq!(
        (model.path, model.doppler),
        (PathModel::KSegment, DopplerModel::None)
    );
    assert!(moving.predicted_error > tolerance, "{moving:?}");
    let (model, selected) = pings[19];
    assert!(model.doppler != DopplerModel::None);
    assert!(selected.predicted_error <= tolerance, "{selected:?}");
}

/// The next costlier methods are selected from a later ping that depends only on the ping of the fault. The fault is counted.
#[test]
fn a_failed_error_check_selects_costlier_methods() {
    let folder = tempfile::tempdir().expect("folder");
    let model = "path = \"auto\"\ndoppler = \"auto\"\nsynthesis = \"direct\"\ntolerance = 1e-2";
    let spec = rig(folder.path(), 60.0, false, model);
    at_speed(folder.path(), |t_s| 0.5 * t_s);
    let marks: Vec<_> = pool(1).expect("threads").install(|| {
        let mut recorded = RecordedRig::open(&spec).expect("opens");
        let mut marks = Vec::new();
        each_ping(&mut recorded, &spec, (1, 16), |recorded, order, slot| {
            marks.push((slot.plan.model, slot.output.methods.expect("a plan")));
            if order.ping_number == 3 {
                let scatterers = recorded.rig.scatterers().clone();
                let failed = ErrorCheck {
                    windows: 64,
                    error: 2e-2,
                    low: 1e-2,
                    high: 3e-2,
                    worst: 3e-2,
                    tolerance: 1e-2,
                    exceeded: true,
                    fault: true,
                };
                let method_selector = recorded.rig.sonars[0]
                    .method_selector
                    .as_mut()
                    .expect("auto");
                // As in a live rig.
                method_selector.correct(true);
                method_selector.after_ping(&slot.plan, &scatterers, Some(&failed));
                assert_eq!(method_selector.counts.given_up, 1);
            }
        });
        marks
    });
    // 2 Hz and 4 s: ping 11.
    let ((refuted, before), (model, after)) = (marks[9], marks[10]);
    assert_eq!(refuted, marks[0].0, "{marks:?}");
    assert!(model != refuted, "{marks:?}");
    assert!(after.predicted_ms >= before.predicted_ms, "{marks:?}");
    assert!(after.predicted_error <= 1e-2, "{marks:?}");
}

/// Without a receiver filter the engine cannot be designed for the shortest of these pulses. If it were selected for the current
/// pulse, a later change would fail.
#[test]
fn an_engine_that_the_limits_exclude_is_never_selected() {
    let costs = Costs::committed();
    let file = crate::repository().join("hil-configs/paper.toml");
    for (shortest_ms, want) in [(2.0, Synthesis::Direct), (5.0, Synthesis::Gridded1d)] {
        let mut spec = echotank_runtime::config_files::load(&file).expect("a rig");
        let sonar = &mut spec.sonars[0];
        sonar.limits.pulse_duration_s.0 = 1e-3 * shortest_ms;
        let firsts = first(&spec, &costs).expect("pings");
        let ranking = firsts[0].ranking.as_ref().expect("can be made");
        let chosen = ranking.chosen();
        println!("{shortest_ms} ms: {}", chosen.text());
        assert_eq!(chosen.choice.model.synthesis, want, "{}", chosen.text());
        assert!(ranking.is_within());
    }
}
