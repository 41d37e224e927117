//! Imperfections of transducers and receiver in whole pings.

use std::path::Path;

use echotank_config::spec::RigSpec;
use echotank_core::frames::{Trajectory, rotation_from_angles};
use echotank_core::ping::{PingOutput, PingPlan};
use echotank_core::scene::Scatterers;
use echotank_core::time::UtcNs;
use echotank_ping::pipeline::SonarPipeline;
use echotank_ping::threads::pool;
use echotank_runtime::config_files::parse;
use echotank_testing::pings::plan_on;
use glam::DVec3;

use crate::engines::ring;

/// Every effect at once.
const ALL: &str = r#"
[sonar.instrument]
leakage_db = -60.0
ring_down_q = 12.0
crosstalk_elements_db = -30.0
crosstalk_arrays_db = -40.0
element_gain_db = 0.5
element_phase_deg = 4.0
element_seed = 3
[sonar.instrument.response]
q = 6.0
resonance_khz = 103.0
[[sonar.instrument.tone]]
frequency_khz = 98.2
level_db = -70.0
[[sonar.instrument.tone]]
frequency_khz = 0.05
level_db = -75.0
entry = "baseband"
[[sonar.instrument.second_sonar]]
kind = "lfm"
center_frequency_khz = 101.0
bandwidth_khz = 6.0
duration_ms = 1.5
period_ms = 13.0
bearing_deg = 60.0
level_db = 130.0
"#;

/// Sonar of 100 kHz with an array of six elements to either side.
fn rig(medium: &str, receiver: &str, instrument: &str, model: &str) -> RigSpec {
    let text = format!(
        r#"
[medium]
{medium}
[[nav.source]]
name = "gnss"
kind = "udp"
listen = "127.0.0.1:10110"
[[sonar]]
name = "main"
[sonar.pulse]
kind = "lfm"
center_frequency_khz = 100.0
bandwidth_khz = 12.0
duration_ms = 2.0
taper = 0.1
[[sonar.transmit]]
name = "tx"
position_m = [-0.3, 0.0, 0.1]
[[sonar.receive]]
name = "port"
elements = 6
spacing_m = 0.01
position_m = [0.0, -0.2, 0.0]
element_pattern = "omnidirectional"
[[sonar.receive]]
name = "starboard"
elements = 6
spacing_m = 0.01
position_m = [0.0, 0.2, 0.0]
element_pattern = "omnidirectional"
[sonar.receiver]
sample_rate_khz = 40.0
{receiver}
[sonar.ping]
range_m = 30.0
rate_hz = 5.0
source_level_db = 210.0
{instrument}
[sonar.model]
path = "k-segment"
doppler = "stretch"
{model}
"#
    );
    parse(&text, Path::new(".")).unwrap_or_else(|problems| panic!("{problems}"))
}

const ELECTRONICS: &str = "noise_db = 40.0\ntvg = \"20logr\"\nadc_bits = 16\nfull_scale_v = 1e-3";

fn scene() -> Scatterers {
    ring(200, [6.0, 24.0], 4.0)
}

fn plan(rig: &RigSpec, number: u32) -> PingPlan {
    let trajectory = Trajectory::uniform(
        DVec3::new(0.3 * f64::from(number), 0.0, 0.0),
        DVec3::new(3.0, 0.5, 0.2),
        rotation_from_angles(0.02, 0.01, 0.3),
    );
    let mut plan = plan_on(trajectory, rig, number, rig.sonars[0].settings);
    plan.transmit_utc = UtcNs(1_400_000_000_000_000_000 + i64::from(number) * 200_000_000);
    plan
}

fn pings(rig: &RigSpec, threads: usize, count: u32) -> Vec<PingOutput> {
    let scatterers = scene();
    pool(threads).expect("threads").install(|| {
        let mut pipeline = SonarPipeline::new(&rig.sonars[0], &rig.medium).expect("fits");
        let mut output = pipeline.blank_output();
        let ping = |number| {
            pipeline.compute_ping(&plan(rig, number), &scatterers, &mut output);
            output.clone()
        };
        (1..=count).map(ping).collect()
    })
}

#[test]
fn imperfections_are_the_same_bits_for_any_number_of_threads() {
    for model in ["synthesis = \"direct\"", "synthesis = \"gridded-1d\""] {
        let rig = rig("", ELECTRONICS, ALL, model);
        let one = pings(&rig, 1, 3);
        for threads in [2, 5] {
            for (one, many) in one.iter().zip(pings(&rig, threads, 3)) {
                assert_eq!(one.elements, many.elements, "{model}");
            }
        }
        let without = pings(&rig_without(model), 1, 3);
        assert_ne!(one[0].elements[0].iq, without[0].elements[0].iq);
    }
}

fn rig_without(model: &str) -> RigSpec {
    rig("", ELECTRONICS, "", model)
}

/// A ping that depends on nothing but its plan: the third ping of a pipeline, and the first of another.
#[test]
fn a_ping_does_not_depend_on_the_pings_before_it() {
    let rig = rig("", ELECTRONICS, ALL, "synthesis = \"direct\"");
    let third = pings(&rig, 2, 3).pop().expect("three");
    let scatterers = scene();
    let mut pipeline = SonarPipeline::new(&rig.sonars[0], &rig.medium).expect("fits");
    let mut output = pipeline.blank_output();
    pipeline.compute_ping(&plan(&rig, 3), &scatterers, &mut output);
    assert_eq!(output.elements, third.elements);
}

#[test]
fn tiles_of_a_ping_with_imperfections_are_those_of_the_whole_ping() {
    let model = "synthesis = \"direct\"\nerror_check = false";
    let rig = rig("", ELECTRONICS, ALL, model);
    let scatterers = scene();
    for scatterers in [scatterers, Scatterers::default()] {
        let mut pipeline = SonarPipeline::new(&rig.sonars[0], &rig.medium).expect("fits");
        let mut plan = plan(&rig, 1);
        let mut whole = pipeline.blank_output();
        pipeline.compute_ping(&plan, &scatterers, &mut whole);
        let mut pipeline = SonarPipeline::new(&rig.sonars[0], &rig.medium).expect("fits");
        let mut tile = pipeline.blank_output();
        let total = plan.sample_count;
        for (end, is_first) in [(50, true), (333, false), (total - 3, false), (total, false)] {
            pipeline.begin_ping(&mut plan, end, is_first, &scatterers, &mut tile.elements);
            assert_eq!(plan.sample_count, total);
            for (got, want) in tile.elements.iter().zip(&whole.elements) {
                assert_eq!((got.samples, got.iq.len()), (end, 6 * end));
                for e in 0..got.elements {
                    assert!(
                        got.element(e) == &want.element(e)[..end],
                        "{e}, {end} samples"
                    );
                }
            }
        }
        assert!(tile.elements[0].iq.iter().any(|v| v.norm() > 0.0));
    }
}

/// The error check is that of the echoes alone.
#[test]
fn error_checks_compare_echoes_only() {
    let checks = |instrument: &str| {
        let model = "synthesis = \"gridded-1d\"\ntolerance = 1e-3\nerror_check = true";
        let rig = rig("", "noise_db = \"none\"", instrument, model);
        let scatterers = scene();
        let mut pipeline = SonarPipeline::new(&rig.sonars[0], &rig.medium).expect("fits");
        pipeline.allow_error_checks(1.0);
        let mut output = pipeline.blank_output();
        let ping = |number| {
            pipeline.compute_ping(&plan(&rig, number), &scatterers, &mut output);
            output.error_check
        };
        (1..=60).map(ping).collect::<Vec<_>>()
    };
    let with = checks(ALL);
    assert_eq!(with, checks(""));
    let last = with.last().copied().flatten();
    let last = last.expect("windows were compared");
    assert!(last.error < 1e-3, "{last:?}");
}

/// Leakage of -20 dB: 190 dB re 1 uPa at a sensitivity of -190 dB is 1 V.
#[test]
fn leakage_passes_gain_and_converter() {
    let leakage = "[sonar.instrument]\nleakage_db = -20.0";
    let ping = |full_scale_v: &str| {
        let receiver = format!("noise_db = \"none\"\nadc_bits = 14\nfull_scale_v = {full_scale_v}");
        let rig = rig("", &receiver, leakage, "synthesis = \"direct\"");
        pings(&rig, 1, 1).pop().expect("a ping")
    };
    // The middle of the pulse, before the first echo.
    let whole = ping("2.0");
    let level_db = 20.0 * whole.elements[0].element(3)[48].norm().log10();
    assert!(level_db.abs() < 0.5, "{level_db} dB");
    assert_eq!(whole.elements[0].saturated, 0);
    let clipped = ping("0.1");
    let largest = clipped.elements[0].iq.iter();
    let largest = largest
        .map(|v| v.re.abs().max(v.im.abs()))
        .fold(0.0, f64::max);
    // Most I and Q of 80 samples of six elements.
    let saturated = clipped.elements[0].saturated;
    assert!(saturated > 500 && largest <= 0.1, "{saturated} {largest}");
}

/// Samples without echoes hold the ambient noise of medium.wind_m_per_s within 0.5 dB.
#[test]
fn ambient_noise_follows_wind_and_frequency_into_samples() {
    for (wind, khz) in [
        (0.0, 100.0),
        (5.0, 100.0),
        (20.0, 100.0),
        (12.0, 15.0),
        (3.0, 400.0),
    ] {
        let medium = format!("wind_m_per_s = {wind:.1}");
        let mut rig = rig(&medium, "", "", "synthesis = \"direct\"");
        if khz != 100.0 {
            let text = rig.source_text.replace(
                "center_frequency_khz = 100.0",
                &format!("center_frequency_khz = {khz:.1}"),
            );
            rig = parse(&text, Path::new(".")).unwrap_or_else(|why| panic!("{why}"));
        }
        let mut pipeline = SonarPipeline::new(&rig.sonars[0], &rig.medium).expect("fits");
        let mut output = pipeline.blank_output();
        let mut power = 0.0;
        let mut count = 0;
        for number in 1..=20 {
            pipeline.compute_ping(&plan(&rig, number), &Scatterers::default(), &mut output);
            for frame in &output.elements {
                power += frame.iq.iter().map(|v| v.norm_sqr()).sum::<f64>();
                count += frame.iq.len();
            }
        }
        let got_db = 10.0 * (power / f64::from(count as u32)).log10();
        // Coates 1990; sensitivity -190 dB re 1 V/uPa, 40 kHz of bandwidth.
        let thermal_db = -15.0 + 20.0 * f64::log10(khz);
        let wind_db =
            50.0 + 7.5 * f64::sqrt(wind) + 20.0 * f64::log10(khz) - 40.0 * f64::log10(khz + 0.4);
        let density_db =
            10.0 * (10f64.powf(thermal_db / 10.0) + 10f64.powf(wind_db / 10.0)).log10();
        let want_db = density_db - 190.0 + 10.0 * 40e3f64.log10();
        println!(
            "{wind} m/s, {khz} kHz: {density_db:.1} dB re 1 uPa^2/Hz, off {:.2} dB",
            got_db - want_db
        );
        assert!(
            (got_db - want_db).abs() < 0.1,
            "{wind} {khz}: {got_db} {want_db}"
        );
    }
}
