//! The engines in the pipeline: whole pings against the direct sum, and changes of settings.

use std::path::Path;

use echotank_config::spec::{Density, RigSpec, SonarSpec};
use echotank_core::arrays::Pattern;
use echotank_core::frames::{AttitudeKnot, Trajectory, VectorKnot, rotation_from_angles};
use echotank_core::model::{DopplerModel, ModelChoice, PathModel, Synthesis};
use echotank_core::ping::{EchoCounts, PingOutput, PingPlan};
use echotank_core::scene::{ScatterLaw, Scatterers};
use echotank_core::settings::SonarSettings;
use echotank_ping::element_synthesis::engine_error_models;
use echotank_ping::pipeline::{PipelineError, SonarPipeline};
use echotank_ping::threads::pool;
use echotank_runtime::config_files::{load, parse};
use echotank_runtime::recorded::RecordedRig;
use echotank_testing::pings::{LoggedPings, plan_on};
use glam::DVec3;
use num_complex::Complex64;

/// `model`: lines of `[sonar.model]`; `receiver`: additional lines of `[sonar.receiver]`; `taper` of the pulse.
fn rig(model: &str, receiver: &str, taper: f64) -> RigSpec {
    rig_of([(3, 0.05), (2, 0.002)], model, receiver, taper)
}

/// Elements and spacing of both arrays.
fn rig_of(arrays: [(usize, f64); 2], model: &str, receiver: &str, taper: f64) -> RigSpec {
    let [(along, along_m), (across, across_m)] = arrays;
    let filter = match receiver.contains("rx_filter") {
        true => "",
        false => "rx_filter = \"none\"",
    };
    let noise = match receiver.contains("noise_db") {
        true => "",
        false => "noise_db = \"none\"",
    };
    let text = format!(
        r#"
[[nav.source]]
name = "gnss"
kind = "udp"
listen = "127.0.0.1:10110"
[scene.seabed]
shape = "plane"
depth_m = 40.0
density_per_m2 = 1.0
[[sonar]]
name = "main"
[sonar.pulse]
kind = "lfm"
center_frequency_khz = 100.0
bandwidth_khz = 24.0
duration_ms = 2.0
taper = {taper}
[[sonar.transmit]]
name = "tx"
position_m = [0.4, 0.1, 0.3]
[[sonar.receive]]
name = "along"
elements = {along}
spacing_m = {along_m}
element_pattern = "omnidirectional"
[[sonar.receive]]
name = "across"
elements = {across}
spacing_m = {across_m}
element_pattern = "omnidirectional"
position_m = [-1.0, 0.3, 0.2]
yaw_deg = 90.0
[sonar.receiver]
sample_rate_khz = 50.0
{filter}
{noise}
{receiver}
[sonar.ping]
range_m = 30.0
rate_hz = 5.0
source_level_db = 200.0
[sonar.limits]
range_m = [5.0, 45.0]
pulse_duration_ms = [1.0, 3.0]
[sonar.model]
{model}
"#
    );
    parse(&text, Path::new(".")).unwrap_or_else(|problems| panic!("{model}: {problems}"))
}

const FILTER: &str = "rx_filter = \"fir\"";

/// Points in all directions, 4 to 34 m away, and one target.
fn scene(count: usize) -> Scatterers {
    let mut scatterers = ring(count, [4.0, 30.0], 3.0);
    let target_m = DVec3::new(3.0, 15.0, 3.0);
    let strength = Complex64::new(20.0, 0.0);
    scatterers.push(target_m, [0.0; 3], strength, ScatterLaw::Point);
    scatterers
}

/// Points in all directions, from `near_m` on.
pub(crate) fn ring(count: usize, [near_m, width_m]: [f64; 2], down_m: f64) -> Scatterers {
    let mut scatterers = Scatterers::default();
    for k in 0..count {
        let part = |step: f64| (0.5 + k as f64 * step).fract();
        let (r, a) = (
            near_m + width_m * part(0.754_877_666_246_693),
            std::f64::consts::TAU * part(0.569_840_290_998_053),
        );
        scatterers.push(
            DVec3::new(r * a.cos(), r * a.sin(), down_m),
            [0.0; 3],
            Complex64::from_polar(1.0, std::f64::consts::TAU * part(0.618_033_988_749_895)),
            ScatterLaw::Point,
        );
    }
    scatterers
}

/// Surging, heaving, rolling; `speed` along the track.
fn restless(speed: f64) -> Trajectory {
    let knots = || (-2..8).map(|k| 0.1 * f64::from(k));
    let swing = |t: f64| (1.3 * t).sin_cos();
    Trajectory {
        position: knots()
            .map(|t| VectorKnot {
                time_s: t,
                value: DVec3::new(speed * t + 0.4 * t * t, 0.2 * swing(t).0, 0.0),
                rate_per_s: DVec3::new(speed + 0.8 * t, 0.26 * swing(t).1, 0.0),
            })
            .collect(),
        heave: knots()
            .map(|t| VectorKnot {
                time_s: t,
                value: DVec3::Z * swing(t).1,
                rate_per_s: DVec3::Z * (-1.3 * swing(t).0),
            })
            .collect(),
        attitude: knots()
            .map(|t| AttitudeKnot {
                time_s: t,
                world_from_body: rotation_from_angles(0.1 * swing(t).0, 0.0, 0.05 * t),
                body_rate_rad_per_s: DVec3::new(0.13 * swing(t).1, 0.0, 0.05),
            })
            .collect(),
        lever_arm_m: DVec3::ZERO,
    }
}

fn plan(rig: &RigSpec, number: u32, change: impl Fn(&mut SonarSettings)) -> PingPlan {
    plan_at(rig, number, 4.0, change)
}

fn plan_at(
    rig: &RigSpec,
    number: u32,
    speed: f64,
    change: impl Fn(&mut SonarSettings),
) -> PingPlan {
    let mut settings = rig.sonars[0].settings;
    change(&mut settings);
    plan_on(restless(speed), rig, number, settings)
}

fn once(rig: &RigSpec, plan: &PingPlan, scatterers: &Scatterers) -> PingOutput {
    let mut pipeline = SonarPipeline::new(&rig.sonars[0], &rig.medium).expect("fits");
    let mut output = pipeline.blank_output();
    pipeline.compute_ping(plan, scatterers, &mut output);
    output
}

/// Over all elements and windows of a pulse length at half-pulse steps: the largest relative error of windows with an echo, and the
/// strongest window without one, over the median.
///
/// A band-limited echo rings around itself. A window therefore counts as strong as the strongest within a pulse of it, and where the sum is
/// zero, an engine is only nearly zero.
fn worst_window(got: &PingOutput, want: &PingOutput, plan: &PingPlan, rate_hz: f64) -> (f64, f64) {
    let length = ((plan.pulse.duration_s * rate_hz) as usize).max(32);
    let energy = |x: &[Complex64]| x.iter().map(|s| s.norm_sqr()).sum::<f64>();
    let (mut worst, mut silent) = (0.0f64, 0.0f64);
    assert_eq!(got.elements.len(), want.elements.len());
    for (got, want) in got.elements.iter().zip(&want.elements) {
        assert_eq!((got.elements, got.samples), (want.elements, want.samples));
        for e in 0..got.elements {
            let (got, want) = (got.element(e), want.element(e));
            let starts = || (0..=got.len() - length).step_by(length / 2);
            let all: Vec<f64> = starts().map(|k| energy(&want[k..k + length])).collect();
            let mut sorted = all.clone();
            sorted.sort_by(f64::total_cmp);
            let median = sorted[all.len() / 2];
            for (w, k) in starts().enumerate() {
                let off: Vec<Complex64> = (k..k + length).map(|i| got[i] - want[i]).collect();
                let around = w.saturating_sub(2)..(w + 3).min(all.len());
                let level = all[around].iter().copied().fold(0.0, f64::max);
                // 80 dB below the median there is no echo, at most the filter's onset.
                match all[w] > 1e-8 * median {
                    true => worst = worst.max((energy(&off) / level).sqrt()),
                    false => silent = silent.max((energy(&off) / median).sqrt()),
                }
            }
        }
    }
    (worst, silent)
}

/// Every pair of models that an engine supports, behind the filter, against the direct sum of the same models.
#[test]
fn every_path_and_doppler_is_the_direct_sum_within_the_tolerance() {
    let scatterers = scene(300);
    for path in PathModel::ALL {
        for doppler in [
            DopplerModel::None,
            DopplerModel::Stretch,
            DopplerModel::StretchQuadratic,
        ] {
            let model = |synthesis: &str, tolerance: f64| {
                let (path, doppler) = (path.name(), doppler.name());
                rig(
                    &format!(
                        "path = \"{path}\"\ndoppler = \"{doppler}\"\nsegment_ms = 10.0\nsynthesis = \"{synthesis}\"\ntolerance = {tolerance}"
                    ),
                    FILTER,
                    1.0,
                )
            };
            let direct = model("direct", 1e-3);
            let ping = plan(&direct, 1, |_| {});
            let want = once(&direct, &ping, &scatterers);
            // The direct sum's own density behind the filter leaves an error of 2e-5 for a tapered pulse.
            for tolerance in [1e-1, 1e-2, 1e-3, 1e-4] {
                let engine = model("gridded-1d", tolerance);
                let ping = plan(&engine, 1, |_| {});
                let got = once(&engine, &ping, &scatterers);
                let (error, silent) = worst_window(&got, &want, &ping, 50e3);
                println!(
                    "{} {} {tolerance:.0e}: {error:.1e}, silent {silent:.1e}",
                    path.name(),
                    doppler.name()
                );
                assert!(
                    error < tolerance && silent < tolerance,
                    "{path:?} {doppler:?}: {error:e}, {silent:e} of {tolerance:e}"
                );
                assert!(got.counts.used > 1000 && got.counts.beyond_engine == 0);
                // Its filter is slightly longer, so an echo at the window's ends may differ.
                assert!(got.counts.used.abs_diff(want.counts.used) < 30);
            }
        }
    }
}

/// A record many echoes long is processed in slabs; echoes that overlap two are received in both and counted once.
#[test]
fn a_long_record_in_slabs_is_the_direct_sum_and_counts_every_pair_once() {
    let scatterers = scene(300);
    let long = |synthesis: &str| {
        let model = format!(
            "path = \"polyline\"\ndoppler = \"stretch-quadratic\"\nsegment_ms = 10.0\ncull_db = -20.0\nsynthesis = \"{synthesis}\"\ntolerance = 1e-3"
        );
        let mut rig = rig(&model, FILTER, 1.0);
        let sonar = &mut rig.sonars[0];
        sonar.settings.range_m = 45.0;
        sonar.settings.pulse_duration_s = 1e-3;
        sonar.transmit[0].pattern = Pattern::Rectangle {
            length_m: 0.03,
            width_m: 0.0,
            baffled: false,
        };
        rig
    };
    let (direct, engine) = (long("direct"), long("gridded-1d"));
    let error_models =
        engine_error_models(&engine.sonars[0], &engine.medium).expect("within reach");
    assert!(
        error_models[0].why.contains("each of 4 slabs"),
        "{}",
        error_models[0].why
    );
    let ping = plan(&engine, 1, |_| {});
    let (want, got) = (
        once(&direct, &plan(&direct, 1, |_| {}), &scatterers),
        once(&engine, &ping, &scatterers),
    );
    let (error, silent) = worst_window(&got, &want, &ping, 50e3);
    println!("{error:.1e}, silent {silent:.1e}, {:?}", got.counts);
    assert!(error < 1e-3 && silent < 1e-3, "{error:e}, {silent:e}");
    let pairs = |counts: EchoCounts| counts.used + counts.culled + counts.outside_window;
    // A scatterer culled before the second leg counts once, whatever the number of elements.
    assert_eq!(pairs(got.counts), pairs(want.counts));
    assert!(got.counts.culled > 10 && got.counts.culled.abs_diff(want.counts.culled) < 10);
    assert!(got.counts.used > 900 && got.counts.used.abs_diff(want.counts.used) < 30);
    let roots = |counts: EchoCounts| (counts.no_root, counts.two_roots, counts.beyond_track);
    assert_eq!(roots(got.counts), roots(want.counts));
}

/// The start of a ping is independent of its end: its tiles are identical bits, electronics included.
#[test]
fn the_first_samples_alone_are_those_of_the_whole_ping_bit_for_bit() {
    let scatterers = scene(40);
    let electronics = "noise_db = 40.0\nadc_bits = 16\nfull_scale_v = 5.0";
    let dopplers = ["none", "stretch"];
    for (path, filter) in [
        ("polyline", ""),
        ("k-segment", FILTER),
        ("continuous", FILTER),
    ] {
        for doppler in dopplers {
            let model = format!(
                "path = \"{path}\"\ndoppler = \"{doppler}\"\nsegment_ms = 10.0\nsynthesis = \"direct\""
            );
            let rig = rig(&model, &format!("{filter}\n{electronics}"), 0.0);
            let mut ping = plan(&rig, 1, |_| {});
            let want = once(&rig, &ping, &scatterers);
            let mut pipeline = SonarPipeline::new(&rig.sonars[0], &rig.medium).expect("fits");
            let mut tile = pipeline.blank_output();
            let total = ping.sample_count;
            // A sample that ends no block of eight, and most of the ping.
            for (end, is_first) in [(50, true), (333, false), (total - 13, false)] {
                let elements = &mut tile.elements;
                pipeline.begin_ping(&mut ping, end, is_first, &scatterers, elements);
                assert_eq!(ping.sample_count, total);
                for (got, want) in tile.elements.iter().zip(&want.elements) {
                    assert_eq!(got.samples, end);
                    for e in 0..got.elements {
                        let same = got.element(e) == &want.element(e)[..end];
                        assert!(same, "{model}: element {e}, {end} samples");
                    }
                }
            }
            assert!(tile.elements[0].iq.iter().any(|v| v.norm() > 0.0));
        }
    }
}

/// Without the receiver filter a smooth pulse is possible; other pulses are refused with numbers.
#[test]
fn without_the_filter_the_pulse_determines_the_error() {
    let scatterers = scene(300);
    let soft = |synthesis: &str| rig(&format!("synthesis = \"{synthesis}\""), "", 1.0);
    let ping = plan(&soft("direct"), 1, |_| {});
    let want = once(&soft("direct"), &ping, &scatterers);
    let engine = soft("gridded-1d");
    let ping = plan(&engine, 1, |_| {});
    let (error, silent) = worst_window(&once(&engine, &ping, &scatterers), &want, &ping, 50e3);
    println!("no filter: {error:.1e}, silent {silent:.1e}");
    assert!(error < 1e-3 && silent < 1e-3, "{error:e}, {silent:e}");

    let sharp = rig("synthesis = \"gridded-1d\"\ntolerance = 1e-4", "", 0.0);
    let refused = SonarPipeline::new(&sharp.sonars[0], &sharp.medium)
        .err()
        .expect("a sharp pulse is as wide as one likes");
    assert!(matches!(refused, PipelineError::Engine { .. }));
    let said = refused.to_string();
    assert!(
        said.starts_with("sonar.model.tolerance = 1e-4: gridded-1d: tolerance 1e-4 cannot be met")
            && said.contains("use the receiver filter"),
        "{said}"
    );
    let again = engine_error_models(&sharp.sonars[0], &sharp.medium).expect_err("the same");
    assert_eq!(again.to_string(), said);
}

/// Without navigation for a first selection.
#[test]
fn a_selected_synthesis_starts_with_its_engine_or_the_direct_sum_where_that_is_refused() {
    let auto = "path = \"auto\"\ndoppler = \"auto\"\nsynthesis = \"auto\"";
    for (duration_s, started) in [(2e-3, Synthesis::Gridded1d), (30e-3, Synthesis::Direct)] {
        let mut spec = rig(auto, FILTER, 0.1);
        let sonar = &mut spec.sonars[0];
        sonar.settings.pulse_duration_s = duration_s;
        sonar.limits.pulse_duration_s = (duration_s, duration_s);
        let made = SonarPipeline::new(sonar, &spec.medium);
        assert_eq!(made.is_err(), started == Synthesis::Direct);
        let mut rig = echotank_runtime::rig::open(&spec).expect("opens");
        assert_eq!(rig.sonars[0].pipeline.model().synthesis, Synthesis::Direct);
        rig.make_starting_engines();
        assert_eq!(rig.sonars[0].pipeline.model().synthesis, started);
    }
}

#[test]
fn the_error_model_names_the_limits_of_its_engine() {
    for tolerance in [1e-1, 1e-3, 1e-6, 1e-8] {
        let rig = rig(&format!("tolerance = {tolerance}"), FILTER, 0.1);
        assert_eq!(rig.sonars[0].model.synthesis, Synthesis::Gridded1d);
        let error_models = engine_error_models(&rig.sonars[0], &rig.medium).expect("within reach");
        let [error_model] = &error_models[..] else {
            panic!("one engine for all elements: {error_models:?}");
        };
        assert_eq!(error_model.name, "gridded-1d");
        assert!(
            error_model.error <= tolerance && error_model.cost_ms > 0.0,
            "{error_model:?}"
        );
    }
    let direct = rig("synthesis = \"direct\"", FILTER, 0.1);
    let error_models =
        engine_error_models(&direct.sonars[0], &direct.medium).expect("nothing to refuse");
    assert!(error_models.is_empty());
}

/// Changes of pulse and range during a run, within the declared limits or not: each ping equals that of a sonar with these settings from
/// the start.
#[test]
fn changed_settings_give_the_bits_of_a_sonar_started_with_them() {
    let scatterers = scene(200);
    let rig = rig("", FILTER, 0.1);
    assert_eq!(rig.sonars[0].model.synthesis, Synthesis::Gridded1d);
    let changes: [(f64, f64); 9] = [
        (30.0, 2e-3),
        (30.0, 1.37e-3),
        (12.0, 1.37e-3),
        (45.0, 3e-3),
        (30.0, 2e-3),
        (30.5, 1e-3),
        (10.0, 1e-3),
        (44.0, 1.5e-3),
        (12.0, 1.37e-3),
    ];
    let of = |number: usize| {
        let (range_m, pulse_s) = changes[number];
        plan(&rig, 1 + number as u32, |settings| {
            settings.range_m = range_m;
            settings.pulse_duration_s = pulse_s;
        })
    };
    let alone: Vec<PingOutput> = (0..changes.len())
        .map(|number| once(&rig, &of(number), &scatterers))
        .collect();
    for known in [0, 1, 3] {
        let mut pipeline = SonarPipeline::new(&rig.sonars[0], &rig.medium).expect("fits");
        let mut output = pipeline.blank_output();
        for (number, want) in alone.iter().enumerate() {
            for ahead in number + 1..(number + 1 + known).min(changes.len()) {
                pipeline.expect(&of(ahead).settings);
            }
            let ping = of(number);
            pipeline.compute_ping(&ping, &scatterers, &mut output);
            assert_eq!(output.elements, want.elements, "{:?}", changes[number]);
            assert_eq!(output.elements[0].samples, ping.sample_count);
        }
    }
    // All of them agree with the direct sum.
    let direct = self::rig("synthesis = \"direct\"", FILTER, 0.1);
    for (number, got) in alone.iter().enumerate() {
        let ping = of(number);
        let sum = PingPlan {
            model: direct.sonars[0].model,
            ..ping.clone()
        };
        let want = once(&direct, &sum, &scatterers);
        let (error, silent) = worst_window(got, &want, &ping, 50e3);
        assert!(
            error < 1e-3 && silent < 1e-3,
            "{:?}: {error:e}, {silent:e}",
            changes[number]
        );
    }
}

#[test]
fn the_bits_are_the_same_for_any_number_of_threads() {
    let scatterers = scene(2000);
    let rig = rig("path = \"k-segment\"", FILTER, 0.1);
    let with = |threads: usize| {
        let pool = pool(threads).expect("a pool");
        pool.install(|| once(&rig, &plan(&rig, 1, |_| {}), &scatterers))
    };
    let one = with(1);
    for threads in [2, 3] {
        let several = with(threads);
        assert_eq!(one.elements, several.elements, "{threads} threads");
        assert_eq!(one.counts, several.counts);
    }
}

/// A platform faster than the limit: its echoes are counted, and the direct sum makes them.
#[test]
fn echoes_too_fast_for_the_engine_are_counted_and_made_by_the_direct_sum() {
    let scatterers = scene(300);
    let rig = rig("", FILTER, 0.1);
    let slow = once(&rig, &plan_at(&rig, 1, 9.0, |_| {}), &scatterers);
    assert_eq!(slow.counts.beyond_engine, 0);
    let plan = plan_at(&rig, 1, 25.0, |_| {});
    let fast = once(&rig, &plan, &scatterers);
    assert!(fast.counts.beyond_engine > 100, "{:?}", fast.counts);
    let direct = self::rig("synthesis = \"direct\"", FILTER, 0.1);
    let rate_hz = rig.sonars[0].receiver.sample_rate_hz;
    let (off, _) = worst_window(&fast, &once(&direct, &plan, &scatterers), &plan, rate_hz);
    assert!(off < 2e-4, "{off:e}");
}

#[test]
fn a_scene_that_is_empty_or_out_of_reach_is_silent() {
    let rig = rig("", FILTER, 0.1);
    let mut far = Scatterers::default();
    far.push(DVec3::X * 1e4, [0.0; 3], Complex64::ONE, ScatterLaw::Point);
    for scatterers in [Scatterers::default(), far] {
        let output = once(&rig, &plan(&rig, 1, |_| {}), &scatterers);
        assert!(output.elements[0].iq.iter().all(|x| x.norm() == 0.0));
    }
}

// ---------------------------------------------------------------- whole line arrays

/// Two lines at half a wavelength.
fn lines(model: &str, taper: f64) -> RigSpec {
    rig_of([(40, 0.0075), (24, 0.0075)], model, FILTER, taper)
}

#[test]
fn whole_line_arrays_are_the_direct_sum_within_the_tolerance() {
    let scatterers = scene(200);
    for path in PathModel::ALL {
        for doppler in DopplerModel::ALL {
            if !Synthesis::Gridded2d.takes(doppler) || path == PathModel::Polyline {
                continue;
            }
            let model = |synthesis: &str| {
                let (path, doppler) = (path.name(), doppler.name());
                format!(
                    "path = \"{path}\"\ndoppler = \"{doppler}\"\nsegment_ms = 10.0\nsynthesis = {synthesis}"
                )
            };
            let direct = lines(&model("\"direct\""), 1.0);
            let ping = plan(&direct, 1, |_| {});
            let want = once(&direct, &ping, &scatterers);
            let of_each = |tolerance: f64| {
                ["\"gridded-2d\"\nnearest_m = 2.0", "\"gridded-lines\""]
                    .map(|engine| (engine, tolerance))
            };
            for (engine, tolerance) in [1e-1, 1e-2, 1e-3].into_iter().flat_map(of_each) {
                let rig = lines(&model(&format!("{engine}\ntolerance = {tolerance}")), 1.0);
                let ping = plan(&rig, 1, |_| {});
                let got = once(&rig, &ping, &scatterers);
                let (error, silent) = worst_window(&got, &want, &ping, 50e3);
                println!(
                    "{engine} {} {} {tolerance:.0e}: {error:.1e}, silent {silent:.1e}, {:?}",
                    path.name(),
                    doppler.name(),
                    got.counts
                );
                assert!(
                    error < tolerance && silent < tolerance,
                    "{engine} {path:?} {doppler:?}: {error:e}, {silent:e} of {tolerance:e}"
                );
                assert!(got.counts.used > 6000);
                // At 1e-3 the nearest, 4 m away, are too near for 16 elements at 100 kHz, and counted.
                let near = engine == "\"gridded-lines\"" && tolerance < 1e-2;
                assert!(near || got.counts.beyond_engine == 0);
            }
        }
    }
}

/// A head of 40 elements at 200 kHz with a short pulse, over a bottom 8 m below: `model` and the number of elements of a second array.
fn multibeam(model: &str, second: usize) -> RigSpec {
    let text = format!(
        r#"
[[nav.source]]
name = "gnss"
kind = "udp"
listen = "127.0.0.1:10110"
[scene.seabed]
shape = "plane"
depth_m = 8.0
[[sonar]]
name = "main"
[sonar.pulse]
kind = "cw"
center_frequency_khz = 200.0
duration_ms = 0.2
taper = 0.1
[[sonar.transmit]]
name = "tx"
[[sonar.receive]]
name = "head"
elements = 40
spacing_m = 0.00375
yaw_deg = 90.0
element_pattern = "omnidirectional"
[[sonar.receive]]
name = "second"
elements = {second}
spacing_m = 0.00375
element_pattern = "omnidirectional"
[sonar.receiver]
sample_rate_khz = 60.0
rx_filter = "fir"
noise_db = "none"
[sonar.ping]
range_m = 20.0
rate_hz = 5.0
source_level_db = 200.0
[sonar.limits]
range_m = [5.0, 25.0]
pulse_duration_ms = [0.1, 0.4]
[sonar.model]
{model}
"#
    );
    parse(&text, Path::new(".")).unwrap_or_else(|problems| panic!("{model}: {problems}"))
}

/// A still and a moving multibeam, with a second array of one element and of several, against the reference solution.
#[test]
fn a_multibeam_by_lines_is_the_reference_within_the_tolerance() {
    let scatterers = ring(300, [4.0, 14.0], 6.0);
    let models = "path = \"continuous\"\ndoppler = \"stretch-quadratic\"";
    for (second, speed) in [(1, 0.0), (5, 4.0)] {
        let truth = multibeam("synthesis = \"reference\"", second);
        let at_speed = |rig: &RigSpec| {
            let settings = rig.sonars[0].settings;
            let trajectory = match speed > 0.0 {
                true => restless(speed),
                false => Trajectory::uniform(DVec3::ZERO, DVec3::ZERO, glam::DQuat::IDENTITY),
            };
            plan_on(trajectory, rig, 1, settings)
        };
        let want = once(&truth, &at_speed(&truth), &scatterers);
        for tolerance in [1e-2, 1e-3] {
            let engine = multibeam(
                &format!("{models}\nsynthesis = \"gridded-lines\"\ntolerance = {tolerance}"),
                second,
            );
            let ping = at_speed(&engine);
            let got = once(&engine, &ping, &scatterers);
            let (error, silent) = worst_window(&got, &want, &ping, 60e3);
            println!("{second}, {speed} m/s, {tolerance:.0e}: {error:.1e}, {silent:.1e}");
            assert!(
                error < tolerance && silent < tolerance,
                "{error:e}, {silent:e} of {tolerance:e}"
            );
            assert_eq!(got.counts.beyond_engine, 0);
            assert_eq!(got.elements[1].elements, second);
        }
    }
}

#[test]
fn whole_line_arrays_give_the_same_bits_for_any_threads_and_history() {
    for engine in ["gridded-2d", "gridded-lines"] {
        same_bits(engine);
    }
}

fn same_bits(engine: &str) {
    let scatterers = scene(500);
    let rig = lines(
        &format!("path = \"k-segment\"\nsynthesis = \"{engine}\"\ntolerance = 2e-2"),
        0.1,
    );
    let with = |threads: usize, past: &[(f64, f64)], expected: bool| {
        let pool = pool(threads).expect("a pool");
        pool.install(|| {
            let mut pipeline = SonarPipeline::new(&rig.sonars[0], &rig.medium).expect("fits");
            let mut output = pipeline.blank_output();
            for &(range_m, pulse_s) in past.iter().chain(&[(30.0, 2e-3)]) {
                let ping = plan(&rig, 1, |settings| {
                    settings.range_m = range_m;
                    settings.pulse_duration_s = pulse_s;
                });
                if expected {
                    pipeline.expect(&ping.settings);
                }
                pipeline.compute_ping(&ping, &scatterers, &mut output);
            }
            output
        })
    };
    let one = with(1, &[], false);
    for (threads, past) in [
        (2, &[][..]),
        (8, &[(45.0, 3e-3), (12.0, 1e-3), (30.0, 2e-3), (45.0, 3e-3)]),
        (1, &[(12.0, 2e-3), (30.0, 1.3e-3)]),
    ] {
        for expected in [false, true] {
            let other = with(threads, past, expected);
            assert_eq!(
                one.elements, other.elements,
                "{threads} threads after {past:?}"
            );
            assert_eq!(one.counts, other.counts);
        }
    }
}

/// Scatterers too close for the interpolation along the line are counted, and the direct sum makes the ping.
#[test]
fn a_ping_beyond_the_engines_bounds_is_counted_and_made_by_the_direct_sum() {
    let beyond = |model: &str, place_m: &dyn Fn(f64) -> DVec3| {
        let mut scatterers = scene(100);
        for k in 0..20 {
            let at_m = place_m(f64::from(k));
            scatterers.push(at_m, [0.0; 3], Complex64::ONE, ScatterLaw::Point);
        }
        let of = |model: &str| {
            let rig = lines(&format!("path = \"k-segment\"\nsynthesis = {model}"), 0.1);
            let plan = plan(&rig, 1, |_| {});
            let rate_hz = rig.sonars[0].receiver.sample_rate_hz;
            (once(&rig, &plan, &scatterers), plan, rate_hz)
        };
        let ((made, plan, rate_hz), (direct, ..)) = (of(model), of("\"direct\""));
        assert!(made.counts.beyond_engine > 0, "{:?}", made.counts);
        let (off, _) = worst_window(&made, &direct, &plan, rate_hz);
        assert!(off < 2e-4, "{model}: {off:e}");
    };
    beyond("\"gridded-2d\"\nnearest_m = 30.0\ntolerance = 2e-2", &|k| {
        DVec3::new(0.1 * k - 1.0, 0.3, 0.7)
    });
    beyond("\"gridded-lines\"\ntolerance = 1e-3", &|k| {
        DVec3::new(0.4, 0.1 + 1e-3 * k, 0.31)
    });
}

#[test]
fn the_line_engine_reports_its_error_model_or_what_it_refuses() {
    let model = |engine: &str, tolerance: &str| {
        lines(
            &format!("path = \"k-segment\"\nsynthesis = \"{engine}\"\ntolerance = {tolerance}"),
            0.1,
        )
    };
    for engine in ["gridded-2d", "gridded-lines"] {
        let rig = model(engine, "2e-2");
        let error_models = engine_error_models(&rig.sonars[0], &rig.medium).expect("within reach");
        assert_eq!(error_models.len(), 2, "one per array");
        for error_model in &error_models {
            assert!(
                error_model.name == engine && error_model.error <= 2e-2,
                "{error_model:?}"
            );
        }
    }
    let fine = model("gridded-lines", "1e-4");
    let refused = SonarPipeline::new(&fine.sonars[0], &fine.medium).err();
    assert_eq!(
        refused.map(|why| why.to_string()).as_deref(),
        Some(
            "sonar.model.synthesis = \"gridded-lines\": tolerance 1e-4 is below its minimum of 3e-4"
        )
    );
    let mixed = multibeam("path = \"k-segment\"\nsynthesis = \"gridded-lines\"", 1);
    let error_models = engine_error_models(&mixed.sonars[0], &mixed.medium).expect("within reach");
    let names: Vec<&str> = error_models.iter().map(|model| model.name).collect();
    assert_eq!(names, ["gridded-1d", "gridded-lines"]);
}

// ---------------------------------------------------------------- the quickstart

/// A configuration of the repository with a thinner seabed, without noise and converter.
fn thinned(file: &str, change: impl Fn(&mut SonarSpec)) -> RigSpec {
    let path = echotank_testing::repository()
        .join("hil-configs")
        .join(file);
    let mut spec = load(&path).expect("a good configuration");
    if let Some(seabed) = &mut spec.scene.seabed {
        seabed.density = Density::PerM2(1.0);
    }
    for sonar in &mut spec.sonars {
        sonar.receiver.noise_db = None;
        sonar.receiver.adc_bits = None;
        change(sonar);
    }
    spec
}

/// Pings of the first sonar along its log, each passed on with its plan.
fn along_the_log(spec: &RigSpec, pings: usize, mut each: impl FnMut(&PingPlan, &PingOutput)) {
    let mut log = LoggedPings::open(spec).expect("a rig").expect("nav");
    for _ in 0..pings {
        log.next_ping();
        each(&log.slot.plan, &log.slot.output);
    }
}

/// Both engines, each with a configuration's sonar, on a real ship's log over a real seabed, against the direct sum with the same path and
/// Doppler, by window.
#[test]
fn the_repositorys_engines_are_the_direct_sum_within_the_tolerance() {
    for (file, engine, cull_db, tolerance) in [
        ("certified.toml", Synthesis::Gridded1d, -34.0, 1e-3),
        // A line culls by section or at its middle, the direct sum by element: with a floor of -40 dB this alone is up to 2e-2.
        ("multibeam.toml", Synthesis::Gridded2d, -60.0, 2e-2),
        ("multibeam.toml", Synthesis::GriddedLines, -60.0, 2e-2),
    ] {
        let of = |synthesis: Option<Synthesis>| {
            let spec = thinned(file, |sonar| {
                sonar.synthesis.error_check = false;
                sonar.synthesis.tolerance = tolerance;
                // Fixed methods that method selection might choose.
                sonar.synthesis.auto = Default::default();
                sonar.synthesis.nearest_m = 10.0;
                sonar.model = ModelChoice {
                    path: PathModel::KSegment,
                    doppler: DopplerModel::Stretch,
                    synthesis: synthesis.unwrap_or(engine),
                    segment_s: 0.01,
                    cull_db: Some(cull_db),
                };
            });
            let mut outputs = Vec::new();
            let mut keep = |plan: &PingPlan, output: &PingOutput| {
                outputs.push((plan.clone(), output.clone()));
            };
            along_the_log(&spec, 2, &mut keep);
            (spec, outputs)
        };
        let ((spec, got), (_, want)) = (of(None), of(Some(Synthesis::Direct)));
        assert!(spec.sonars[0].model.synthesis.keeps_tolerance(), "{file}");
        for ((plan, got), (_, want)) in got.iter().zip(&want) {
            let rate_hz = spec.sonars[0].receiver.sample_rate_hz;
            let (error, silent) = worst_window(got, want, plan, rate_hz);
            println!("{file}: {error:.1e}, silent {silent:.1e} of {tolerance:.0e}");
            assert!(
                error < tolerance && silent < tolerance,
                "{file}: {error:e}, {silent:e}"
            );
            assert_eq!(got.counts.beyond_engine, 0, "{file}");
        }
    }
}

/// Every ping along a ship's log, and every third one with the others only examined, as if they had been skipped: the same selections and samples.
#[test]
fn skipped_pings_do_not_change_the_selections_of_later_pings() {
    let spec = thinned("certified.toml", |sonar| {
        sonar.synthesis.error_check = false;
        sonar.settings.max_ping_rate_hz = 1.0;
    });
    let pings = |every: u32| {
        let mut recorded = RecordedRig::open(&spec).expect("a log");
        let mut slot = recorded.rig.slot(0);
        let mode = recorded.rig.spec.nav.mode;
        let mut all = Vec::new();
        while let Some((sonar, order)) = recorded.next_order(14) {
            assert!(recorded.settle(sonar, &order));
            let rig = &mut recorded.rig;
            if order.ping_number % every != 0 {
                rig.examine(sonar, &order, mode, &mut slot).expect("no gap");
                continue;
            }
            let utc = order.transmit_utc;
            echotank_ping::make_ping(rig, sonar, &order, mode, utc, &mut slot).expect("no gap");
            let mark = slot.output.methods.expect("selected methods");
            all.push((order.ping_number, mark, slot.output.elements[0].iq.clone()));
        }
        all
    };
    let (all, some) = (pings(1), pings(3));
    assert_eq!((all.len(), some.len()), (14, 4));
    let blocks: Vec<u32> = all.iter().map(|(_, mark, _)| mark.plan).collect();
    assert!(blocks[0] < blocks[13], "one selection: {blocks:?}");
    for (number, mark, iq) in some {
        let (_, want, samples) = &all[number as usize - 1];
        assert_eq!(mark, *want, "ping {number}");
        assert!(iq == *samples, "ping {number}");
    }
}

/// As configured, including culling, against the reference: the error check of every ping.
#[test]
fn the_error_check_finds_the_quickstart_within_its_tolerance() {
    let spec = thinned("certified.toml", |_| {});
    let mut log = LoggedPings::open(&spec).expect("a rig").expect("nav");
    let mut last = None;
    for _ in 0..10 {
        // The share of a cheap method's cost is too small for enough samples.
        log.rig.sonars[0].pipeline.allow_error_checks(f64::INFINITY);
        log.next_ping();
        last = log.slot.output.error_check.or(last);
    }
    let last = last.expect("enough samples");
    println!("{last:?}");
    assert!(!last.fault && last.error < 1.3 * last.tolerance, "{last:?}");
}

// ---------------------------------------------------------------- echoes whose legs differ

/// Lambert patches, and their images at a surface 2 m above as the receiver or the transmitter sees them.
fn with_images(count: usize) -> Scatterers {
    let mut scatterers = ring(count, [4.0, 12.0], 6.0);
    scatterers.law.fill(ScatterLaw::Lambert);
    scatterers.normal.fill([0.1, 0.0, -0.995]);
    let mut images = Scatterers::default();
    for i in 0..count {
        let (at_m, strength) = (scatterers.position_m(i), scatterers.strength[i]);
        let image_m = DVec3::new(at_m.x, at_m.y, -4.0 - at_m.z);
        let (up, down) = ([0.1, 0.0, -0.995], [0.1, 0.0, 0.995]);
        let (out, back) = match i % 3 {
            0 => ((at_m, up), (image_m, down)),
            1 => ((image_m, down), (at_m, up)),
            _ => ((image_m, down), (image_m, down)),
        };
        images.push(back.0, back.1, -strength, ScatterLaw::Lambert);
        images.push_transmit(out.0, out.1);
    }
    scatterers.append(&images);
    assert_eq!(scatterers.of_scene(), count);
    scatterers
}

/// Every engine against the reference, and the error check of a ping against both.
#[test]
fn echoes_whose_legs_differ_are_the_reference_within_the_tolerance() {
    let scatterers = with_images(60);
    let truth = multibeam("synthesis = \"reference\"", 5);
    let at_speed =
        |rig: &RigSpec, number: u32| plan_on(restless(4.0), rig, number, rig.sonars[0].settings);
    let want = once(&truth, &at_speed(&truth, 1), &scatterers);
    let only_direct = once(&truth, &at_speed(&truth, 1), &{
        let mut direct = scatterers.clone();
        direct.truncate_to_scene();
        direct
    });
    let (without, _) = worst_window(&only_direct, &want, &at_speed(&truth, 1), 60e3);
    assert!(without > 0.5, "the images matter: {without}");
    let models = "path = \"continuous\"\ndoppler = \"stretch-quadratic\"";
    for (engine, tolerance) in [
        ("\"direct\"", 1e-3),
        ("\"gridded-1d\"", 1e-3),
        ("\"gridded-2d\"\nnearest_m = 2.0", 1e-2),
        ("\"gridded-2d\"\nnearest_m = 2.0", 1e-3),
        ("\"gridded-lines\"", 1e-2),
        ("\"gridded-lines\"", 1e-3),
    ] {
        let model =
            format!("{models}\nsynthesis = {engine}\ntolerance = {tolerance}\nerror_check = true");
        let rig = multibeam(&model, 5);
        let mut pipeline = SonarPipeline::new(&rig.sonars[0], &rig.medium).expect("fits");
        pipeline.allow_error_checks(f64::INFINITY);
        let mut output = pipeline.blank_output();
        let ping = at_speed(&rig, 1);
        pipeline.compute_ping(&ping, &scatterers, &mut output);
        let (error, silent) = worst_window(&output, &want, &ping, 60e3);
        println!("{engine} {tolerance:.0e}: {error:.1e}, silent {silent:.1e}");
        assert!(
            error < tolerance && silent < tolerance,
            "{engine}: {error:e}, {silent:e} of {tolerance:e}"
        );
        assert_eq!(output.counts.beyond_engine, 0, "{engine}");
        for number in 2..=8 {
            pipeline.compute_ping(&at_speed(&rig, number), &scatterers, &mut output);
        }
        let check = output.error_check.expect("enough windows");
        println!("{engine} {tolerance:.0e}: checked {:.1e}", check.error);
        assert!(check.error < tolerance, "{engine}: {:e}", check.error);
    }
}
