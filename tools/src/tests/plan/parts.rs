//! Tests of side-scan lines from parts of their arrays, if no output has elements. The lines are compared with lines from all
//! elements. Other tests cover the conditions of the selection.

use std::fmt::Write;
use std::path::Path;

use echotank_config::spec::{RigSpec, SonarSpec, SynthesisOutput};
use echotank_core::model::{DopplerModel, PathModel, Synthesis};
use echotank_core::ping::{PingOutput, PingPlan};
use echotank_core::scene::{ScatterLaw, Scatterers};
use echotank_ping::conditions::conditions;
use echotank_ping::error_check::worst_window;
use echotank_ping::method_selection::costs::Costs;
use echotank_ping::method_selection::parts::partings;
use echotank_ping::method_selection::{MotionScale, Scene, rank, with_choice};
use echotank_ping::methods::{Choice, Family, Ranking};
use echotank_ping::pipeline::SonarPipeline;
use echotank_ping::polyline;
use echotank_ping::threads::pool;
use echotank_runtime::first_pings::pings;
use echotank_runtime::recorded::RecordedRig;
use echotank_runtime::replay::{Formats, Replay, ReplayOptions};
use glam::DVec3;
use num_complex::Complex64;

use super::each_ping;
use echotank_testing::track::{ALONG_TRACK, rows};

/// Side-scan sonar with a line on either side, moving at 2 m/s, with roll and yaw.
#[derive(Clone, Copy)]
struct Rig {
    elements: usize,
    spacing_m: f64,
    duration_ms: f64,
    bandwidth_khz: f64,
    model: &'static str,
    /// Additional keys of the receiver.
    receiver: &'static str,
    /// Additional keys of the beams.
    beams: &'static str,
    /// Additional keys of the outputs.
    output: &'static str,
    /// Additional lines at the end of the file.
    end: &'static str,
}

const RIG: Rig = Rig {
    elements: 24,
    spacing_m: 0.0125,
    duration_ms: 1.0,
    bandwidth_khz: 20.0,
    model: "path = \"continuous\"\ndoppler = \"stretch-quadratic\"\nsynthesis = \"direct\"",
    receiver: "",
    beams: "",
    output: "[sonar.output.xtf]\n",
    end: "",
};

impl Rig {
    fn text(&self) -> String {
        let Rig {
            elements,
            spacing_m,
            duration_ms,
            bandwidth_khz,
            model,
            receiver,
            beams,
            output,
            end,
        } = self;
        let noise = match receiver.contains("noise_db") {
            true => "",
            false => "noise_db = \"none\"",
        };
        let error_check = match model.contains("error_check") {
            true => "",
            false => "error_check = false",
        };
        let length_m = *elements as f64 * spacing_m;
        let element_m = 0.8 * spacing_m;
        let sides: String = [("port", 90.0), ("starboard", -90.0)]
            .iter()
            .map(|(name, roll_deg)| {
                format!(
                    r#"
[[sonar.transmit]]
name = "{name}"
position_m = [0.5, 0.0, 0.3]
roll_deg = {}
pattern = "rectangle"
length_m = {length_m}
width_m = 0.004
[[sonar.receive]]
name = "{name}"
transmit = "{name}"
elements = {elements}
spacing_m = {spacing_m}
position_m = [0.0, 0.0, 0.3]
roll_deg = {}
element_pattern = "rectangle"
element_length_m = {element_m}
element_width_m = 0.004
sensitivity_db = 0.0
"#,
                    roll_deg * 0.6,
                    roll_deg * 0.6
                )
            })
            .collect();
        format!(
            r#"[medium]
sound_speed_m_per_s = 1500.0
absorption = {{ db_per_km = 80.0 }}
{ALONG_TRACK}[scene]
anchor = "origin"
points = "points.csv"
[record]
directory = "records"
[run]
latency_ms = 600.0
[[sonar]]
name = "sidescan"
[sonar.pulse]
kind = "lfm"
center_frequency_khz = 450.0
bandwidth_khz = {bandwidth_khz}
duration_ms = {duration_ms}
taper = 0.1
{sides}
[sonar.receiver]
sample_rate_khz = 60.0
rx_filter = "fir"
tvg = "none"
{noise}
{receiver}
[sonar.ping]
range_m = 60.0
rate_hz = 4.0
source_level_db = 200.0
[sonar.limits]
range_m = [10.0, 60.0]
pulse_duration_ms = [{duration_ms}, {duration_ms}]
[sonar.model]
{error_check}
{model}
[sonar.beams]
port = "port"
starboard = "starboard"
{beams}
{output}
{end}
"#
        )
    }

    fn parse(&self, folder: &Path) -> Result<RigSpec, String> {
        echotank_runtime::config_files::parse(&self.text(), folder).map_err(|why| why.to_string())
    }

    fn open(&self) -> (tempfile::TempDir, RigSpec) {
        let folder = tempfile::tempdir().expect("folder");
        let track = rows(200, 0.1, |t_s| {
            let wave = |rate: f64| (rate * t_s).sin();
            let pitch = 1.5 * (0.9 * t_s).cos();
            [
                2.0 * t_s,
                0.1 * wave(0.7),
                3.0,
                6.0 * wave(1.1),
                pitch,
                2.0 * wave(0.8),
            ]
        });
        std::fs::write(folder.path().join("track.csv"), track).expect("written");
        let mut points = String::from("north_m,east_m,down_m,amplitude\n");
        for (along_m, east_m, amplitude) in POINTS {
            let down_m = 3.0 + 0.3 * f64::abs(east_m).min(20.0);
            let _ = writeln!(
                points,
                "{along_m:.4},{east_m:.4},{down_m:.4},{amplitude:.5}"
            );
        }
        std::fs::write(folder.path().join("points.csv"), points).expect("written");
        let rig = self
            .parse(folder.path())
            .unwrap_or_else(|why| panic!("{why}"));
        (folder, rig)
    }
}

/// Points along and across the track, near and far, in and beside the beam. Their strengths give about equal levels in the water.
const POINTS: [(f64, f64, f64); 14] = [
    (0.45, 4.0, 0.004),
    (0.46, -5.5, 0.009),
    (0.52, 7.0, 0.015),
    (0.60, -9.0, 0.026),
    (0.30, 12.0, 0.05),
    (0.55, -16.0, 0.09),
    (1.30, 15.0, 0.4),
    (0.50, 22.0, 0.18),
    (0.90, -27.0, 0.28),
    (0.40, 33.0, 0.45),
    (3.50, -36.0, 3.0),
    (0.70, 41.0, 0.73),
    (0.20, -48.0, 1.1),
    (0.60, 54.0, 1.5),
];

/// Lambert bottom with random phases. It has about 17 scatterers per metre of range, spread farther along the track with range.
fn ground() -> Scatterers {
    let mut all = Scatterers::default();
    let part = |k: usize, step: f64| (k as f64 * step).fract();
    for k in 0..900 {
        let side = if k % 2 == 0 { 1.0 } else { -1.0 };
        let across_m = 4.0 + 52.0 * part(k, 0.618_034);
        let along_m = 0.4 + 0.06 * across_m * (part(k, 0.754_878) - 0.5);
        let strength = Complex64::from_polar(across_m.sqrt(), 6.3 * part(k, 0.569_84));
        let place_m = DVec3::new(along_m, side * across_m, 9.0);
        all.push(place_m, [0.0, 0.0, -1.0], strength, ScatterLaw::Lambert);
    }
    all
}

struct Ping {
    rig: RigSpec,
    plan: PingPlan,
    points: Scatterers,
}

impl Ping {
    fn of(rig: &Rig) -> Self {
        let (_folder, rig) = rig.open();
        let (plan, points) = pings(&rig, 0).expect("a ping").swap_remove(0);
        Self { rig, plan, points }
    }

    fn spec(&self) -> &SonarSpec {
        &self.rig.sonars[0]
    }

    fn run(&self, spec: &SonarSpec, scatterers: &Scatterers) -> PingOutput {
        let mut pipeline = SonarPipeline::new(spec, &self.rig.medium).expect("a sonar");
        let mut plan = self.plan.clone();
        plan.model = spec.model;
        let window_s = plan.window_s(spec.receiver.sample_rate_hz);
        let segment_s = spec.model.segment_s;
        polyline(&plan.trajectory, window_s, segment_s, &mut plan.segments);
        let mut output = pipeline.blank_output();
        pipeline.compute_ping(&plan, scatterers, &mut output);
        output
    }

    fn in_parts(&self, of: usize) -> SonarSpec {
        let spec = self.spec();
        with_choice(
            spec,
            &Choice {
                model: spec.model,
                engine_tolerance: None,
                nearest_m: spec.synthesis.nearest_m,
                part_elements: of,
            },
        )
    }

    fn rank(&self, output: SynthesisOutput, tolerance: f64, scatterers: &Scatterers) -> Ranking {
        let mut spec = self.spec().clone();
        spec.synthesis.output = output;
        spec.synthesis.tolerance = tolerance;
        let costs = Costs::committed();
        let scene = Scene {
            spec: &spec,
            medium: &self.rig.medium,
            plan: &self.plan,
            scatterers,
            count: scatterers.len(),
            costs: &costs,
            motion_scale: MotionScale::NONE,
        };
        rank(&scene, &[]).expect("a plan")
    }
}

/// Input of the lines: the mean of the synthesised channels of each array.
fn means(output: &PingOutput) -> PingOutput {
    let mut means = output.clone();
    for frame in &mut means.elements {
        let elements = frame.elements;
        let whole = std::mem::take(&mut frame.iq);
        let sum = |k: usize| {
            (0..elements)
                .map(|e| whole[e * frame.samples + k])
                .sum::<Complex64>()
        };
        frame.iq = (0..frame.samples)
            .map(|k| sum(k) / elements as f64)
            .collect();
        frame.elements = 1;
    }
    means
}

/// Largest windowed error of the amplitudes of the lines after the matched filter.
fn worst_of_lines(got: &PingOutput, truth: &PingOutput, plan: &PingPlan, rate_hz: f64) -> f64 {
    let as_elements = |output: &PingOutput| {
        let mut lines = means(output);
        for (frame, line) in lines.elements.iter_mut().zip(&output.lines) {
            frame.samples = line.amplitude.len();
            let real = line
                .amplitude
                .iter()
                .map(|a| Complex64::from(f64::from(*a)));
            frame.iq = real.collect();
        }
        lines
    };
    let (got, truth) = (as_elements(got), as_elements(truth));
    worst_window(&got, &truth, plan.pulse.duration_s, rate_hz)
}

/// Ratio of measured to predicted error for every division of the lines. All errors must be within the prediction.
fn held(
    ping: &Ping,
    truth: &PingOutput,
    scatterers: &Scatterers,
    what: &str,
    ratios: &mut Vec<f64>,
) {
    let spec = ping.spec();
    let rate_hz = spec.receiver.sample_rate_hz;
    let spread = conditions(spec, &ping.plan, scatterers)
        .echo_statistics
        .expect("echoes")
        .spread;
    let whole = means(truth);
    for parting in partings(spec, &ping.plan, scatterers, spread, 1.0) {
        let predicted = parting
            .error(spec.model.path, spec.model.segment_s)
            .expect("no steps");
        if predicted > 0.2 {
            continue; // no method selects this division
        }
        let made = ping.run(&ping.in_parts(parting.of), scatterers);
        let measured = worst_window(&means(&made), &whole, ping.plan.pulse.duration_s, rate_hz);
        let line = worst_of_lines(&made, truth, &ping.plan, rate_hz);
        let said = format!(
            "{what}, {} as one: {measured:.1e} measured, {line:.1e} of the line, {predicted:.1e} predicted",
            parting.of
        );
        println!("{said}");
        assert!(measured <= predicted && line <= predicted, "{said}");
        ratios.push(predicted / measured);
    }
}

/// Elements of the reference, for points near and far.
#[test]
fn errors_of_lines_from_parts_are_bounded_over_range_length_and_pulse() {
    let mut ratios = Vec::new();
    for (elements, spacing_m, duration_ms, bandwidth_khz) in [
        (24, 0.0125, 1.0, 20.0),
        (12, 0.01, 0.5, 30.0),
        (32, 0.005, 2.0, 10.0),
    ] {
        let ping = Ping::of(&Rig {
            elements,
            spacing_m,
            duration_ms,
            bandwidth_khz,
            ..RIG
        });
        // The reference of 64 elements and 2 ms takes as long as all other cases.
        if elements < 32 {
            let mut reference = ping.spec().clone();
            reference.model.synthesis = Synthesis::Reference;
            let truth = ping.run(&reference, &ping.points);
            let what = format!("points, {elements} x {spacing_m} m, {duration_ms} ms");
            held(&ping, &truth, &ping.points, &what, &mut ratios);
        }
        // The same model from all elements leaves only the error of parts.
        let ground = ground();
        let truth = ping.run(ping.spec(), &ground);
        let what = format!("ground, {elements} x {spacing_m} m, {duration_ms} ms");
        held(&ping, &truth, &ground, &what, &mut ratios);
    }
    let near = ratios.iter().filter(|ratio| **ratio <= 10.0).count();
    println!("{near} of {} within ten times", ratios.len());
    assert!(
        ratios.len() >= 16 && 10 * near >= 8 * ratios.len(),
        "{ratios:?}"
    );
}

/// One attitude per chord, at its middle.
#[test]
fn errors_of_parts_on_chords_equal_the_rotation_within_a_chord() {
    let ping = Ping::of(&Rig {
        model: "path = \"k-segment\"\nsegment_ms = 40.0\ndoppler = \"stretch-quadratic\"\nsynthesis = \"direct\"",
        ..RIG
    });
    let ground = ground();
    let truth = ping.run(ping.spec(), &ground);
    let (mut still, mut ratios) = (Vec::new(), Vec::new());
    let spread = conditions(ping.spec(), &ping.plan, &ground)
        .echo_statistics
        .expect("echoes")
        .spread;
    for parting in partings(ping.spec(), &ping.plan, &ground, spread, 1.0) {
        still.push(parting.error(PathModel::Continuous, 0.0).expect("no steps"));
        assert!(parting.error(PathModel::Polyline, 0.04).is_none());
        assert!(
            parting.error(PathModel::StopAndHop, 0.04) > parting.error(PathModel::KSegment, 0.04)
        );
    }
    held(&ping, &truth, &ground, "chords of 40 ms", &mut ratios);
    println!("{still:?}");
}

#[test]
fn a_line_from_parts_has_the_noise_of_a_line_from_elements() {
    let ping = Ping::of(&Rig {
        receiver: "noise_db = 60.0",
        ..RIG
    });
    let silence = Scatterers::default();
    let spec = ping.spec();
    let rate_hz = spec.receiver.sample_rate_hz;
    let want = 10f64.powf(6.0) * rate_hz / spec.receive[0].elements as f64;
    let mut seen = Vec::new();
    for of in [1, 4, 24] {
        let lines = means(&ping.run(&ping.in_parts(of), &silence));
        for frame in &lines.elements {
            let square = frame.iq.iter().map(|x| x.norm_sqr()).sum::<f64>() / frame.samples as f64;
            // 3200 samples of an exponential law scatter by 1.8 % of the mean.
            let off = square / want - 1.0;
            println!("{of} as one: {off:+.3}");
            assert!(off.abs() < 0.07, "{of}: {off}");
            seen.push(frame.iq[100]);
        }
    }
    for (k, a) in seen.iter().enumerate() {
        assert!(
            seen[..k].iter().all(|b| a != b),
            "streams of their own: {seen:?}"
        );
    }
}

const AUTO_MODELS: &str =
    "path = \"auto\"\ndoppler = \"auto\"\nsynthesis = \"direct\"\noutput = \"auto\"";
const AUTO: &str = "path = \"auto\"\ndoppler = \"auto\"\nsynthesis = \"auto\"\noutput = \"auto\"";

#[test]
fn lines_alone_and_a_loose_tolerance_make_fewer_records_and_anything_else_makes_elements() {
    // A line engine may make single elements for less.
    let ping = Ping::of(&Rig {
        model: AUTO_MODELS,
        ..RIG
    });
    let ground = ground();
    let auto = |tolerance: f64| ping.rank(SynthesisOutput::Auto, tolerance, &ground);
    let loose = auto(3e-2);
    let chosen = loose.chosen();
    println!("{}", loose.reason(Family::Output));
    assert!(
        chosen.choice.part_elements > 1 && loose.is_within(),
        "{}",
        chosen.text()
    );
    let elements = loose.other_output().expect("elements are still a choice");
    assert_eq!(elements.choice.part_elements, 1);
    assert!(
        chosen.cost_ms() < elements.cost_ms(),
        "{} {}",
        chosen.text(),
        elements.text()
    );
    // Amount of work: records, and their echoes.
    let of = chosen.choice.part_elements as u64;
    let few = ping.run(&with_choice(ping.spec(), &chosen.choice), &ground);
    let same = Choice {
        part_elements: 1,
        ..chosen.choice
    };
    let many = ping.run(&with_choice(ping.spec(), &same), &ground);
    assert_eq!(few.elements[0].elements as u64 * of, 24);
    let share = many.counts.used as f64 / few.counts.used as f64;
    println!(
        "{}: {} echoes, {} of elements",
        chosen.text(),
        few.counts.used,
        many.counts.used
    );
    assert!((share / of as f64 - 1.0).abs() < 0.02, "{share} {of}");
    assert_eq!(few.lines[0].amplitude.len(), many.lines[0].amplitude.len());

    let fine = auto(1e-4);
    assert_eq!(fine.chosen().choice.part_elements, 1);
    assert!(
        fine.reason(Family::Output)
            .contains("elements as one would leave"),
        "{}",
        fine.reason(Family::Output)
    );
    // Fixed parts are used, and their error is reported.
    let fixed = ping.rank(SynthesisOutput::Beams, 1e-4, &ground);
    assert!(fixed.chosen().choice.part_elements > 1 && !fixed.is_within());
    assert!(fixed.chosen().part(Family::Output).error > 1e-4);
    let plain = ping.rank(SynthesisOutput::Elements, 3e-2, &ground);
    assert!(plain.candidates.iter().all(|c| c.choice.part_elements == 1));
    assert!(
        fixed
            .candidates
            .iter()
            .all(|c| c.choice.model.path != PathModel::Polyline)
    );
    assert!(
        plain
            .candidates
            .iter()
            .any(|c| c.choice.model.doppler == DopplerModel::Stretch)
    );
}

#[test]
fn elements_are_synthesised_if_an_output_needs_them_and_output_beams_is_refused() {
    let folder = tempfile::tempdir().expect("folder");
    let (_kept, _) = RIG.open();
    let whole = Rig { model: AUTO, ..RIG };
    let with = |rig: Rig, why: &str| {
        let spec = rig.open().1;
        assert_eq!(spec.sonars[0].synthesis.elements_for, Some(why));
        let fixed = rig
            .text()
            .replace("output = \"auto\"", "output = \"beams\"");
        let said = echotank_runtime::config_files::parse(&fixed, folder.path())
            .expect_err("refused")
            .to_string();
        assert!(
            said.contains("model.output") && said.contains(why),
            "{said}"
        );
    };
    assert_eq!(whole.open().1.sonars[0].synthesis.elements_for, None);
    with(
        Rig {
            output: "[sonar.output.sevenk]\narrays = [\"port\"]\nlisten = \"127.0.0.1:0\"\nid = 103",
            ..whole
        },
        "an output carries them",
    );
    with(
        Rig {
            receiver: "adc_bits = 16\nfull_scale_v = 1.0",
            ..whole
        },
        "each has its own A/D converter",
    );
    with(
        Rig {
            beams: "line_former = \"dynamic-focus\"",
            ..whole
        },
        "focused lines have different weights at every range",
    );
    with(
        Rig {
            elements: 1,
            ..whole
        },
        "the arrays cannot be divided into equal parts",
    );
    with(
        Rig {
            end: "[control]\nlisten = \"127.0.0.1:0\"",
            ..whole
        },
        "[control] shows elements and can inject faults into them",
    );
    with(
        Rig {
            end: "[[fault]]\nkind = \"dead\"\nelement = 3\nat_s = 1.0",
            ..whole
        },
        "the configuration contains an element fault",
    );
    with(
        Rig {
            model: "path = \"polyline\"\noutput = \"auto\"",
            ..whole
        },
        "the attitude steps of a polyline would break up a part",
    );
}

#[test]
fn a_replay_that_writes_elements_synthesises_them_or_refuses() {
    let open = |model: &'static str, npz: bool| {
        let (folder, rig) = Rig { model, ..RIG }.open();
        let options = ReplayOptions {
            out: folder.path().join("out"),
            formats: Formats {
                npz,
                png: true,
                ..Formats::default()
            },
            f64: false,
            pings: Some((1, 2)),
            threads: 1,
        };
        let made = Replay::open(rig, options).map_err(|why| why.to_string())?;
        made.run(|_| {}).expect("runs");
        let truth = std::fs::read_to_string(folder.path().join("out/truth.jsonl"));
        Ok::<String, String>(truth.expect("written"))
    };
    const LOOSE: &str = "path = \"auto\"\ndoppler = \"auto\"\nsynthesis = \"direct\"\noutput = \"auto\"\ntolerance = 5e-2";
    const FIXED: &str = "path = \"auto\"\ndoppler = \"auto\"\nsynthesis = \"direct\"\noutput = \"beams\"\ntolerance = 5e-2";
    let pictures = open(LOOSE, false).expect("lines are enough for pictures");
    assert!(pictures.contains("\"output\":\"beams\""), "{pictures}");
    let samples = open(LOOSE, true).expect("elements");
    assert!(samples.contains("\"output\":\"elements\""), "{samples}");
    let refused = open(FIXED, true).expect_err("refused");
    assert!(refused.contains("which npz needs"), "{refused}");
}

/// Selections of the first pings, and a checksum of their lines.
fn voyage(threads: usize, error_check: &str) -> (Vec<(u32, usize, u64)>, Option<f64>) {
    let model = "path = \"auto\"\ndoppler = \"auto\"\nsynthesis = \"direct\"\noutput = \"auto\"\ntolerance = 5e-2\n";
    let model: &'static str = Box::leak((model.to_owned() + error_check).into_boxed_str());
    let (_folder, spec) = Rig { model, ..RIG }.open();
    pool(threads).expect("threads").install(|| {
        let mut recorded = RecordedRig::open(&spec).expect("opens");
        if !error_check.is_empty() {
            let pipeline = &mut recorded.rig.sonars[0].pipeline;
            pipeline.allow_error_checks(f64::INFINITY);
        }
        let (mut seen, mut error) = (Vec::new(), None);
        each_ping(&mut recorded, &spec, (1, 4), |_, _, slot| {
            let mark = slot.output.methods.expect("a plan");
            let amplitudes = slot.output.lines.iter().flat_map(|line| &line.amplitude);
            let bits = amplitudes.fold(0u64, |sum, a| {
                sum.wrapping_mul(31).wrapping_add(u64::from(a.to_bits()))
            });
            seen.push((mark.plan, mark.part_elements, bits));
            error = slot.output.error_check.map(|c| c.error).or(error);
        });
        (seen, error)
    })
}

#[test]
fn lines_alone_are_the_same_bits_on_any_number_of_threads() {
    let (once, _) = voyage(1, "");
    println!("{once:?}");
    assert!(
        once.iter().all(|(_, of, bits)| *of > 1 && *bits != 0),
        "{once:?}"
    );
    assert_eq!(once, voyage(3, "").0);
}

/// Each sample of a part is compared with the mean of its elements by the equation of the reference.
#[test]
fn error_checks_compare_parts_with_their_elements() {
    let (seen, error) = voyage(2, "error_check = true");
    let error = error.expect("64 samples a ping");
    println!("{seen:?} {error:.1e}");
    assert!(seen.iter().all(|(_, of, _)| *of > 1), "{seen:?}");
    assert!((1e-4..5e-2).contains(&error), "{error:e}");
}
