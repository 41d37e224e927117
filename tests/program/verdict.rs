//! The verdict of `check`: one test for each finding, with its remedy and the exit status.

use crate::{run, run_well, sets};

const MINIMAL: &str = "tests/data/config/minimal.toml";
const SEABED: &str = "hil-configs/seabed.toml";

/// Checks a configuration with settings that make a mistake; the output holds these words, and the exit status is 1.
fn finds(config: &str, settings: &[&str], words: [&str; 3]) {
    let mut arguments = vec![config.to_owned()];
    arguments.extend(sets(settings));
    let done = run("check", arguments);
    assert_eq!(done.code, Some(1), "{}{}", done.out, done.err);
    for words in words {
        assert!(done.out.contains(words), "no `{words}`:\n{}", done.out);
    }
    let verdict = done.out.lines().last().expect("a line");
    assert!(verdict.starts_with("verdict      "), "{verdict}");
    assert!(verdict.contains(words[0]), "{verdict}");
    assert!(done.err.is_empty(), "{}", done.err);
}

#[test]
fn a_rig_that_does_what_is_meant_works() {
    let text = run_well("check", [SEABED]);
    let verdict = text.lines().last().expect("a line");
    assert!(
        verdict.starts_with("verdict      works: pings take "),
        "{verdict}"
    );
    let json = run_well("check", [SEABED, "--json"]);
    let json: serde_json::Value = serde_json::from_str(&json).expect("JSON");
    assert_eq!(json["verdict"], "works");
    assert_eq!(json["findings"].as_array().map(Vec::len), Some(0));
    assert!(json["sonars"][0]["cost_ms"]["stages"]["beams"].is_number());
}

#[test]
fn findings_are_in_the_json_form_too() {
    let done = run(
        "check",
        [
            &[MINIMAL.to_owned(), "--json".to_owned()][..],
            &sets(["sonar.ping.range_m=30"]),
        ]
        .concat(),
    );
    assert_eq!(done.code, Some(1), "{}", done.err);
    let json: serde_json::Value = serde_json::from_str(&done.out).expect("JSON");
    let findings = json["findings"].as_array().expect("a list");
    let no_seabed = findings.iter().find(|f| f["finding"] == "sees no seabed");
    let remedy = no_seabed.expect("found")["remedy"].as_str();
    assert_eq!(
        remedy,
        Some("sonar.ping.range_m above 40, or a shallower seabed")
    );
}

#[test]
fn pings_that_take_longer_than_their_period_are_too_slow() {
    finds(
        MINIMAL,
        &[
            "scene.seabed.density_per_m2=100",
            "sonar.receive.0.elements=64",
        ],
        [
            "too slow",
            "its period is 200.0 ms",
            "sonar.ping.rate_hz of at most ",
        ],
    );
}

#[test]
fn a_tolerance_that_no_method_keeps_is_inaccurate() {
    finds(
        MINIMAL,
        &[
            "sonar.model.synthesis=\"nearest\"",
            "sonar.model.doppler=\"none\"",
            "sonar.model.tolerance=1e-4",
        ],
        [
            "inaccurate",
            "nearest",
            "path, doppler and synthesis = \"auto\"",
        ],
    );
}

#[test]
fn a_bottom_beyond_the_range_is_not_seen() {
    finds(
        MINIMAL,
        &["sonar.ping.range_m=30"],
        [
            "sees no seabed",
            "it lies 40.0 m below the sonar, the range is 30 m",
            "remedy     sonar.ping.range_m above 40",
        ],
    );
}

#[test]
fn few_scatterers_a_cell_undersample_speckle() {
    finds(
        MINIMAL,
        &["scene.seabed.density_per_m2=0.01"],
        [
            "speckle undersampled",
            "scatterers in a resolution cell in the middle of the range; speckle needs 5",
            "density_per_m2 of at least ",
        ],
    );
}

#[test]
fn a_side_scan_without_patterns_receives_both_sides() {
    finds(
        MINIMAL,
        &[
            "sonar.receive.0.yaw_deg=0",
            "sonar.receive.0.roll_deg=60",
            "sonar.beams.port=\"rx\"",
        ],
        [
            "sides mirrored",
            "the port line receives the other side at ",
            "pattern = \"rectangle\" with length_m, width_m and baffled = true",
        ],
    );
}

#[test]
fn wide_spacing_of_a_fan_has_grating_lobes() {
    finds(
        "hil-configs/multibeam.toml",
        &["sonar.receive.0.spacing_m=0.01"],
        [
            "grating lobes",
            " wavelengths apart; its outer beams have grating lobes",
            "spacing_m of at most ",
        ],
    );
}

#[test]
fn samples_beyond_the_full_scale_saturate() {
    finds(
        MINIMAL,
        &[
            "sonar.receiver.adc_bits=16",
            "sonar.receiver.full_scale_v=1e-6",
        ],
        [
            "saturates",
            "dB above the full scale of the converter",
            "sonar.ping.gain_db of at most -",
        ],
    );
}

#[test]
fn a_sharp_pulse_without_a_receiver_filter_is_aliased() {
    finds(
        MINIMAL,
        &["sonar.receiver.rx_filter=none"],
        [
            "aliased band",
            "lies beyond half the sample rate",
            "rx_filter = \"fir\" in [sonar.receiver], a longer pulse.taper, or sample_rate_khz of at least ",
        ],
    );
}

#[test]
fn more_data_than_gigabit_ethernet_carries_is_found() {
    finds(
        MINIMAL,
        &[
            "scene.seabed.density_per_m2=1",
            "sonar.receive.0.elements=512",
            "sonar.receiver.sample_rate_khz=600",
            "sonar.output.sevenk.listen=\"127.0.0.1:0\"",
            "sonar.output.sevenk.id=7125",
            "sonar.output.sevenk.client_queue_mib=256",
        ],
        [
            "records exceed the link",
            "gigabit Ethernet carries 1000",
            "fewer elements or beams, a lower sonar.receiver.sample_rate_khz, or at most ",
        ],
    );
}

#[test]
fn a_band_beyond_the_sample_rate_is_refused() {
    let arguments = [
        &[MINIMAL.to_owned()][..],
        &sets(["sonar.receiver.sample_rate_khz=10"]),
    ]
    .concat();
    let done = run("check", arguments);
    assert_eq!(done.code, Some(2), "{}", done.out);
    assert!(
        done.err.contains("sample_rate_khz = 10: must be at least "),
        "{}",
        done.err
    );
}
