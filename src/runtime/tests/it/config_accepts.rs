//! Accepted configurations and their meaning; the template and the schema agree with the parser.

use std::fs;
use std::path::Path;

use echotank_config::{self as config, spec::*};
use echotank_core::arrays::{Pattern, ReceiverFilter};
use echotank_core::model::{DopplerModel, PathModel, Synthesis};
use echotank_runtime::config_files;
use echotank_testing::repository;
use glam::DVec3;
use proptest::prelude::*;
use serde_json::Value;

use super::config_refuses::difference;

/// Names of the accepted configurations in tests/data/config.
const ACCEPTED: [&str; 5] = ["minimal", "everything", "towed", "streaming", "instrument"];

fn load(path: &Path) -> RigSpec {
    config_files::load(path).unwrap_or_else(|errors| panic!("{}: {errors}", path.display()))
}

fn parsed(text: &str) -> Result<RigSpec, config::ConfigErrors> {
    config_files::parse(text, &repository().join("tests/data/config"))
}

fn parse(text: &str) -> RigSpec {
    parsed(text).unwrap_or_else(|errors| panic!("{errors}"))
}

/// Text of a configuration in tests/data/config.
fn text_of(name: &str) -> String {
    let path = repository().join(format!("tests/data/config/{name}.toml"));
    fs::read_to_string(path).expect("readable")
}

fn minimal() -> String {
    text_of("minimal")
}

// ---------------------------------------------------------------- what the keys mean

/// Rounds the number in a line of a specification, because the last digits of an angle's sine differ between machines.
fn rounded(line: &str) -> String {
    let (head, last) = line.rsplit_once(' ').unwrap_or(("", line));
    match last.trim_end_matches(',').parse::<f64>() {
        Ok(value) if last.len() > 15 => format!("{head} {value:.12},\n"),
        _ => format!("{line}\n"),
    }
}

/// `NAME.txt` holds the whole specification of `NAME.toml`. The environment variable ECHOTANK_BLESS=1 rewrites the file for review.
#[test]
fn each_accepted_configuration_sets_its_whole_specification() {
    let root = format!("{}/", repository().display());
    let mut differences = Vec::new();
    for name in ACCEPTED {
        let mut rig = parse(&text_of(name));
        assert_eq!(std::mem::take(&mut rig.source_text), text_of(name));
        let faults: Vec<_> = rig.faults.iter().map(|fault| fault.checked()).collect();
        let got = format!("{rig:#?}\nchecked faults: {faults:#?}\n").replace(&root, "");
        let got: String = got.lines().map(rounded).collect();
        let file = repository().join(format!("tests/data/config/{name}.txt"));
        differences.extend(difference(&file, &got));
    }
    assert!(differences.is_empty(), "{}", differences.join("\n"));
}

#[test]
fn overload_stretches_on_request_and_degrades_to_looser_tolerances() {
    let rig = parse(&(minimal() + "\n[run]\noverload = \"stretch\"\n"));
    assert_eq!(rig.run.overload, OverloadSpec::Stretch);
    let gridded = "\n[sonar.model]\nsynthesis = \"gridded-1d\"\ntolerance = 2e-3\n";
    let rig = parse(&(minimal() + gridded + "\n[run]\noverload = \"degrade\"\n"));
    assert_eq!(rig.run.overload, OverloadSpec::Degrade);
    assert_eq!(rig.sonars[0].looser_tolerances(), [0.02, 0.1]);
}

#[test]
fn units_are_shifted_without_rounding_twice() {
    // For some of these numbers, multiplying by 1e-3 or dividing by 1e3 is one bit off.
    for digits in ["0.9", "2.1", "4.9", "5.9e0", "59e-1", "1_000.7", "4"] {
        let text = minimal().replace("duration_ms = 2.0", &format!("duration_ms = {digits}"));
        let text = text.replace("sample_rate_khz = 40.0", "sample_rate_khz = 400.7");
        let sonar = &parse(&text).sonars[0];
        let (mantissa, exponent) = digits.split_once('e').unwrap_or((digits, "0"));
        let exponent: i32 = exponent.parse::<i32>().expect("exponent") - 3;
        let want: f64 = format!("{}e{exponent}", mantissa.replace('_', ""))
            .parse()
            .expect("number");
        assert_eq!(
            sonar.pulse.duration_s.to_bits(),
            want.to_bits(),
            "{digits} ms"
        );
        assert_eq!(
            sonar.receiver.sample_rate_hz.to_bits(),
            400_700f64.to_bits()
        );
    }
}

#[test]
fn angles_of_an_array_turn_its_axes() {
    let sonar = &parse(&text_of("everything")).sonars[0];
    let boresight = sonar.transmit[1].mounting.body_from_array * DVec3::Z;
    assert!(
        (boresight.y - 0.75f64.sqrt()).abs() < 1e-15 && (boresight.z - 0.5).abs() < 1e-15,
        "roll -60 looks to starboard and 30 degrees below the horizon: {boresight}"
    );
    let along = sonar.receive[1].mounting.body_from_array * DVec3::X;
    assert!((along - DVec3::Y).length() < 1e-15, "{along}");
}

// ---------------------------------------------------------------- the configurations in the repository

#[test]
fn quickstart_is_accepted_and_its_summary_is_complete() {
    let rig = load(&repository().join("hil-configs/quickstart.toml"));
    let summary = config::summary(&rig);
    for expected in [
        "wavelength 15.25 mm, range resolution 15.2 cm", // 1525/100e3; 1525/(2 x 5e3)
        "configured 4.00, used 4.00",
        "2397 samples per element and ping", // (2 x 150/1525 + 3e-3) s at 12 kHz
        "together 1.99 deg",                 // 2 asin(0.443 x 15.25e-3/0.39)
        "elements (7038) 14.73 Mbit/s",      // 48 x 2397 x 4 B x 4 Hz
        "127.0.0.1:7000",
    ] {
        assert!(
            summary.contains(expected),
            "no \"{expected}\" in\n{summary}"
        );
    }
}

/// sin 10 deg = 0.1736, 1 - cos 10 deg = 0.0152.
#[test]
fn the_summary_states_the_tilt_of_an_array() {
    let text = minimal().replace(
        "[[sonar.transmit]]\nname = \"tx\"\n",
        "[[sonar.transmit]]\nname = \"tx\"\nposition_m = [3.0, 2.0, 1.0]\n",
    );
    assert_ne!(text, minimal(), "the position is in");
    let summary = config::summary(&parse(&text));
    // Roll: y sin - z (1 - cos) = 0.347 - 0.015; pitch: -x sin - z (1 - cos) = -0.521 - 0.015.
    let want = "at 3.000 m forward, 2.000 starboard, 1.000 down; roll +10 deg (starboard down): sinks 0.332 m; pitch +10 deg (bow up): rises 0.536 m";
    assert!(summary.contains(want), "{summary}");
}

#[test]
fn a_range_too_long_for_the_rate_is_a_note_and_no_error() {
    let text = minimal().replace("rate_hz = 5.0", "rate_hz = 50.0");
    let summary = config::summary(&parse(&text));
    // 2 x 100/1500 s, 2 ms pulse, 1 ms between the pings.
    let want =
        "main: the range of 100 m is too long for 50.00 pings/s; the rate is reduced to 7.33";
    assert!(summary.contains(want), "{summary}");
}

/// Rows of a CSV of numbers, without comments and heading.
fn rows(file: &str) -> Vec<Vec<f64>> {
    let text = fs::read_to_string(repository().join(file)).expect("readable");
    text.lines()
        .filter(|line| !line.starts_with('#'))
        .skip(1)
        .map(|line| {
            line.split(',')
                .map(|n| n.parse().expect("a number"))
                .collect()
        })
        .collect()
}

#[test]
fn the_points_and_their_track_match_their_comments() {
    let rig = load(&repository().join("hil-configs/points.toml"));
    let sonar = &rig.sonars[0];
    assert_eq!(rig.medium.absorption, AbsorptionSpec::None);
    assert_eq!(sonar.model.synthesis, Synthesis::Reference);
    assert_eq!(sonar.receiver.noise_db, None);
    assert_eq!(sonar.limits.range_m, (75.0, 75.0), "a fixed range");

    let track = rows("hil-configs/data/points_nav.csv");
    assert_eq!(track.len(), 21);
    for row in &track {
        let t = row[0] - track[0][0];
        for (k, (start, speed)) in [(0.0, 4.0), (0.0, 2.0), (5.0, 0.3)].into_iter().enumerate() {
            let want = start + speed * t;
            assert!(
                (row[1 + k] - want).abs() < 1e-12,
                "t = {t}: {} against {want}",
                row[1 + k]
            );
        }
        assert_eq!(row[4..], [3.0, -2.0, 35.0]);
    }

    let points = rows("hil-configs/data/points.csv");
    assert_eq!(points.len(), 40);
    let mut starboard = 0;
    for point in &points {
        let position = DVec3::new(point[0], point[1], point[2]);
        for row in &track {
            let slant_m = (position - DVec3::new(row[1], row[2], row[3])).length();
            assert!((20.0..=70.0).contains(&slant_m), "{position}: {slant_m} m");
        }
        // Across the course (4, 2): starboard is (-2, 4).
        if -2.0 * point[0] + 4.0 * point[1] > 0.0 {
            starboard += 1;
        }
    }
    assert_eq!(starboard, 20);
}

// ---------------------------------------------------------------- template and schema

#[test]
fn the_summary_states_mounting_towing_and_navigation_output() {
    let said = config::summary(&parse(&text_of("towed")));
    for words in [
        "tty: heave is measured at 1.000 m forward, 2.000 starboard, 3.000 down",
        "tty: on a level platform measures roll +30.000",
        "120.0 m of cable",
        "from the depth sensor",
        "board: GPZDA to /dev/ttyS0 at 9600 Bd 8N2, 1 a second, RTS at each second ahead of its ZDA",
        "bridge: INZDA INGGA INHDT to UDP 239.192.0.2:60002, 0.5 a second",
    ] {
        assert!(said.contains(words), "no `{words}` in\n{said}");
    }
}

#[test]
fn the_template_is_accepted_as_it_stands() {
    let rig = parse_template(config::template());
    assert_eq!(rig.sonars.len(), 1);
    for line in config::template().lines() {
        assert!(line.len() <= 110, "{} columns: {line}", line.len());
    }
}

#[test]
fn a_default_in_the_template_may_be_uncommented_and_changes_nothing() {
    let lines: Vec<&str> = config::template().lines().collect();
    let plain = format!("{:?}", parse_template(config::template()));
    let mut uncommented = 0;
    for (i, line) in lines.iter().enumerate() {
        let Some(assignment) = line.strip_prefix("# ") else {
            continue;
        };
        let is_default = line.ends_with("; the default")
            || lines[i.saturating_sub(1)].ends_with("; the default]");
        // Keys that have an effect only with another choice are refused without this choice.
        let only_beside = lines[..i]
            .iter()
            .rev()
            .take_while(|l| l.starts_with("# ") && !l.contains(" = ") || l.contains("Only with"))
            .any(|l| l.contains("Only with"));
        // The same holds for keys of a table that is itself commented out.
        let is_header = |l: &&&str| {
            let text = l.trim_start_matches("# ");
            text.starts_with('[') && text.ends_with(']') && !text.contains(' ')
        };
        let header = lines[..i].iter().rev().find(is_header);
        let table_is_out = header.is_some_and(|h| h.starts_with("# "));
        if !is_default || !assignment.contains(" = ") || only_beside || table_is_out {
            continue;
        }
        let mut changed = lines.clone();
        changed[i] = assignment;
        let mut rig = parse_template(&changed.join("\n"));
        rig.source_text = config::template().to_owned();
        assert_eq!(format!("{rig:?}"), plain, "{assignment}");
        uncommented += 1;
    }
    assert!(uncommented >= 30, "only {uncommented} defaults were tried");
}

fn parse_template(text: &str) -> RigSpec {
    config_files::parse(text, Path::new("/nonexistent")).unwrap_or_else(|errors| panic!("{errors}"))
}

fn schema() -> Value {
    serde_json::from_str(&config::schema()).expect("the schema is JSON")
}

/// Every property name in a schema, with its path.
fn property_names(schema: &Value, path: &str, names: &mut Vec<(String, String)>) {
    for inner in schema["anyOf"].as_array().into_iter().flatten() {
        property_names(inner, path, names);
    }
    if schema["items"].is_object() {
        property_names(&schema["items"], path, names);
    }
    for (name, inner) in schema["properties"].as_object().into_iter().flatten() {
        let path = format!("{path}.{name}");
        names.push((name.clone(), path.clone()));
        property_names(inner, &path, names);
    }
}

#[test]
fn every_key_of_the_schema_stands_in_the_template() {
    let mut names = Vec::new();
    property_names(&schema(), "", &mut names);
    assert!(names.len() > 120, "only {} keys", names.len());
    let mut missing = Vec::new();
    for (name, path) in names {
        let header = path.trim_start_matches('.');
        let stands = config::template().lines().any(|line| {
            let line = line.trim_start_matches("# ");
            line.starts_with(&format!("{name} = "))
                || line.starts_with(&format!("[{header}]"))
                || line.starts_with(&format!("[[{header}]]"))
                || line.contains(&format!("{{ {name} = "))
                || line.contains(&format!(", {name} = "))
        });
        if !stands {
            missing.push(path);
        }
    }
    assert!(missing.is_empty(), "{missing:?}");
}

fn list(rule: &Value) -> &[Value] {
    rule.as_array().expect("a list")
}

/// Whether `value` is valid under the subset of JSON Schema that the schema uses; unknown keywords fail the test.
fn valid(schema: &Value, value: &Value) -> bool {
    let rules = schema.as_object().expect("a schema is an object");
    rules.iter().all(|(word, rule)| {
        let number = |v: &Value| v.as_f64().expect("a number");
        match word.as_str() {
            "type" => match rule.as_str().expect("a type") {
                "object" => value.is_object(),
                "array" => value.is_array(),
                "string" => value.is_string(),
                "boolean" => value.is_boolean(),
                "integer" => value.is_i64() || value.is_u64(),
                _ => value.is_number(),
            },
            "enum" => list(rule).contains(value),
            "anyOf" => list(rule).iter().any(|s| valid(s, value)),
            "properties" => value.as_object().is_none_or(|table| {
                table
                    .iter()
                    .all(|(name, inner)| rule.get(name).is_some_and(|s| valid(s, inner)))
            }),
            "required" => list(rule)
                .iter()
                .all(|name| value.get(name.as_str().expect("a name")).is_some()),
            "items" => value
                .as_array()
                .is_none_or(|items| items.iter().all(|i| valid(rule, i))),
            "minItems" => value
                .as_array()
                .is_none_or(|i| i.len() as f64 >= number(rule)),
            "maxItems" => value
                .as_array()
                .is_none_or(|i| i.len() as f64 <= number(rule)),
            "minLength" => value.as_str().is_none_or(|s| !s.is_empty()),
            "pattern" => value.as_str().is_none_or(|s| {
                (1..=32).contains(&s.len())
                    && s.chars()
                        .all(|c| c.is_ascii_alphanumeric() || c == '-' || c == '_')
            }),
            "minimum" => value.as_f64().is_none_or(|v| v >= number(rule)),
            "exclusiveMinimum" => value.as_f64().is_none_or(|v| v > number(rule)),
            "maximum" => value.as_f64().is_none_or(|v| v <= number(rule)),
            "$schema" | "title" | "description" | "default" | "additionalProperties" => true,
            _ => panic!("{word}"),
        }
    })
}

fn as_json(text: &str) -> Value {
    let table: toml::Table = text.parse().expect("TOML");
    serde_json::to_value(table).expect("plain data")
}

#[test]
fn accepted_configurations_are_valid_under_the_schema() {
    let schema = schema();
    let mut texts = vec![config::template().to_owned()];
    texts.extend(ACCEPTED.map(text_of));
    for file in ["hil-configs/points.toml", "hil-configs/quickstart.toml"] {
        texts.push(fs::read_to_string(repository().join(file)).expect("readable"));
    }
    for text in texts {
        assert!(valid(&schema, &as_json(&text)), "{text}");
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 600, ..ProptestConfig::default() })]

    /// Replaces single values. An accepted value is valid, so an editor with the schema never marks a correct value.
    #[test]
    fn a_changed_configuration_that_is_accepted_is_valid_under_the_schema(
        line in any::<usize>(),
        value in prop::sample::select(vec![
            "0", "1", "-1", "0.5", "7", "60.0", "1e6", "-45.0", "true", "false", "\"none\"", "\"rectangle\"", "\"line\"", "\"one\"",
            "[1.0, 2.0]", "[1, 2, 3]", "[\"line\"]", "[[0.0, 1.0]]", "{ db_per_km = 1.0 }", "\"settle\"", "\"127.0.0.1:0\"", "12000",
        ]),
    ) {
        let text = text_of("everything");
        let lines: Vec<&str> = text.lines().collect();
        let at = line % lines.len();
        let mut changed: Vec<String> = lines.iter().map(|l| (*l).to_owned()).collect();
        if let Some((key, _)) = lines[at].split_once(" = ") {
            changed[at] = format!("{key} = {value}");
        }
        let text = changed.join("\n");
        if parsed(&text).is_ok() {
            prop_assert!(valid(&schema(), &as_json(&text)), "{}", changed[at]);
        }
    }
}

#[test]
fn any_line_may_be_left_out_and_is_either_not_needed_or_missed_by_name() {
    for text in [text_of("everything"), config::template().to_owned()] {
        let lines: Vec<&str> = text.lines().collect();
        for i in 0..lines.len() {
            let mut left = lines.clone();
            left.remove(i);
            if let Err(errors) = parsed(&left.join("\n")) {
                assert!(!errors.problems.is_empty());
                let said = errors.to_string();
                assert!(
                    !said.contains("without a stated rule"),
                    "{}: {said}",
                    lines[i]
                );
            }
        }
    }
}

/// The minimal configuration with `lines` in `[sonar.model]`.
fn with_model(lines: &str) -> RigSpec {
    let filtered = minimal().replace(
        "sample_rate_khz = 40.0",
        "sample_rate_khz = 40.0\nrx_filter = \"fir\"",
    );
    parse(&format!("{filtered}\n[sonar.model]\n{lines}\n"))
}

#[test]
fn every_path_doppler_and_synthesis_is_selected_by_its_name() {
    for path in PathModel::ALL {
        for doppler in DopplerModel::ALL {
            for synthesis in Synthesis::ALL {
                let torn = path == PathModel::Polyline && synthesis.makes_lines();
                if !synthesis.takes(doppler) || torn {
                    continue;
                }
                let rig = with_model(&format!(
                    "path = \"{}\"\ndoppler = \"{}\"\nsynthesis = \"{}\"\ntolerance = 2e-2",
                    path.name(),
                    doppler.name(),
                    synthesis.name()
                ));
                let model = &rig.sonars[0].model;
                assert_eq!(
                    (model.path, model.doppler, model.synthesis),
                    (path, doppler, synthesis)
                );
                if synthesis != Synthesis::Reference {
                    let summary = config::summary(&rig);
                    assert!(summary.contains(path.name()), "{summary}");
                }
            }
        }
    }
    let spec = with_model("").sonars[0].synthesis;
    assert_eq!((spec.error_check, spec.frequency_step_hz), (true, None));
    assert_eq!(spec.tolerance, 1e-3);
    let spec = with_model(
        "error_check = true\ntolerance = 2e-5\nsynthesis = \"spectral\"\ndoppler = \"none\"\nfrequency_step_hz = 2.5",
    );
    let spec = spec.sonars[0].synthesis;
    assert_eq!(
        (spec.error_check, spec.frequency_step_hz),
        (true, Some(2.5))
    );
    assert_eq!(spec.tolerance, 2e-5);
}

/// What absent keys mean: the table is in CHANGELOG.md.
#[test]
fn absent_keys_mean_what_most_rigs_want() {
    let rig = parse(&minimal());
    let sonar = &rig.sonars[0];
    let auto = sonar.synthesis.auto;
    assert!(auto.path && auto.doppler && auto.synthesis && sonar.synthesis.error_check);
    assert_eq!(sonar.receiver.filter, ReceiverFilter::Fir);
    // Coates 1990 at 200 kHz: 31.0 dB of thermal noise and 20.7 dB of the surface at 5 m/s.
    let noise_db = sonar.receiver.noise_db.expect("noise");
    assert!((noise_db - 31.4).abs() < 0.05, "{noise_db}");
    assert_eq!(sonar.transmit[0].pattern, Pattern::Omnidirectional);
    let of_its_spacing = Pattern::Rectangle {
        length_m: sonar.receive[0].spacing_m,
        width_m: 0.0,
        baffled: true,
    };
    assert_eq!(sonar.receive[0].element_pattern, of_its_spacing);
    let density = |rig: &RigSpec| rig.scene.seabed.as_ref().expect("a seabed").density;
    assert!(matches!(density(&rig), Density::Auto { .. }));

    let told = minimal()
        .replace("depth_m = 40.0", "depth_m = 40.0\ndensity_per_m2 = 2.0")
        .replace("name = \"tx\"", "name = \"tx\"\nlength_m = 0.1")
        .replace("elements = 16", "elements = 1")
        .replace(
            "sample_rate_khz = 40.0",
            "sample_rate_khz = 40.0\nnoise_db = \"none\"",
        );
    let rig = parse(&told);
    let sonar = &rig.sonars[0];
    assert!(matches!(density(&rig), Density::PerM2(2.0)));
    assert!(
        matches!(sonar.transmit[0].pattern, Pattern::Rectangle { length_m, .. } if length_m == 0.1)
    );
    assert_eq!(sonar.receive[0].element_pattern, Pattern::Omnidirectional);
    assert_eq!(sonar.receiver.noise_db, None);
    // The reference leaves nothing to select, and nothing to check.
    let spec = with_model("synthesis = \"reference\"").sonars[0].synthesis;
    assert!(!spec.auto.any() && !spec.error_check);
}

/// Before the first selection: the fast engine if it is certain to reach its tolerance, otherwise the exact sum.
#[test]
fn an_unselected_synthesis_is_an_engine_with_the_filter_and_the_direct_sum_without() {
    let chosen = |filter: &str, doppler: &str| {
        let text = minimal().replace(
            "sample_rate_khz = 40.0",
            &format!("sample_rate_khz = 40.0\nrx_filter = \"{filter}\""),
        );
        let text = format!("{text}\n[sonar.model]\ndoppler = \"{doppler}\"\n");
        parse(&text).sonars[0].model.synthesis
    };
    for doppler in ["none", "stretch", "stretch-quadratic"] {
        assert_eq!(chosen("fir", doppler), Synthesis::Gridded1d);
        assert_eq!(chosen("none", doppler), Synthesis::Direct);
    }
    assert_eq!(chosen("fir", "paper-eq21"), Synthesis::Direct);
}

#[test]
fn every_rig_of_the_repository_is_accepted() {
    let folder = repository().join("hil-configs");
    let mut seen = 0;
    for entry in std::fs::read_dir(folder).expect("a folder") {
        let path = entry.expect("an entry").path();
        if path.extension().is_some_and(|e| e == "toml") {
            load(&path);
            seen += 1;
        }
    }
    assert!(seen > 10, "{seen} rigs");
}
