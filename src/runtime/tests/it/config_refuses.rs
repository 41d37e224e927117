//! Every broken configuration is refused with its whole list of problems, and no input causes a panic.

use std::fs;
use std::path::{Path, PathBuf};

use echotank_config as config;
use echotank_runtime::config_files;
use proptest::prelude::*;

fn broken_dir() -> PathBuf {
    echotank_testing::repository().join("tests/data/config/broken")
}

/// Files `NN-name.toml` of the folder, in order.
fn broken_files() -> Vec<PathBuf> {
    let mut files: Vec<_> = fs::read_dir(broken_dir())
        .expect("folder of broken configurations")
        .map(|entry| entry.expect("entry").path())
        .filter(|path| path.extension().is_some_and(|e| e == "toml"))
        .collect();
    files.sort();
    files
}

/// Difference between `got` and the text of a file. The environment variable ECHOTANK_BLESS=1 rewrites the file for review.
pub(crate) fn difference(file: &Path, got: &str) -> Option<String> {
    if std::env::var_os("ECHOTANK_BLESS").is_some() {
        fs::write(file, got).expect("writable");
    }
    let want = fs::read_to_string(file).unwrap_or_default();
    let text = || format!("{}\n--- want\n{want}--- got\n{got}", file.display());
    (got != want).then(text)
}

/// `NN-name.txt` holds the expected message for `NN-name.toml`.
#[test]
fn each_broken_configuration_prints_its_whole_list_of_problems() {
    let files = broken_files();
    assert!(
        files.len() >= 20,
        "only {} broken configurations",
        files.len()
    );
    let mut differences = Vec::new();
    for file in files {
        let text = fs::read_to_string(&file).expect("readable");
        let got = match config_files::parse(&text, &broken_dir()) {
            Ok(_) => "accepted\n".to_owned(),
            Err(errors) => format!("{errors}\n"),
        };
        differences.extend(difference(&file.with_extension("txt"), &got));
    }
    assert!(differences.is_empty(), "{}", differences.join("\n"));
}

#[test]
fn a_bad_profile_is_refused_with_place_value_and_rule() {
    let minimal = fs::read_to_string(broken_dir().join("../minimal.toml")).expect("readable");
    for (medium, words) in [
        (
            "profile = { points = [[0, 1500], [9, 1490], [9, 1489]] }",
            "medium.profile.points = [[0, 1500], [9, 1490], [9, 1489]]: point 3: depth 9 m: must be greater than 9 m",
        ),
        (
            "profile = { points = [[0, 1500]] }",
            "medium.profile.points = [[0, 1500]]: 1 points: must be 2 to 1000",
        ),
        (
            "profile = { points = [[-1, 1500], [9, 1490]] }",
            "point 1: depth -1 m: must not lie above the surface",
        ),
        (
            "profile = { points = [[0, 1500], [9, 1790]] }",
            "point 2: sound speed 1790 m/s: must be from 1300 to 1700 m/s",
        ),
        (
            "profile = { points = [[11, 1500], [19, 1490]] }",
            "point 1: depth 11 m: the first point must lie at most 10 m below the surface",
        ),
        (
            "profile = { points = [[0, 1500, 1], [9, 1490]] }",
            "must be 1 to 10000 pairs of numbers [[depth_m, m_per_s], ...]",
        ),
        (
            "profile = { file = \"cast.csv\" }",
            "medium.profile.file = \"cast.csv\": line 4: depth 7 m: must be greater than 8 m, the depth of the point before",
        ),
        (
            "profile = { file = \"nowhere.asvp\" }",
            "medium.profile.file = \"nowhere.asvp\": must be a file that can be read: not found",
        ),
        (
            "profile = {}",
            "medium.profile: must have either `file` or `points`",
        ),
        (
            "sound_speed_m_per_s = 1500\nprofile = { points = [[0, 1500], [9, 1490]] }",
            "medium.sound_speed_m_per_s = 1500: only with one sound speed: [medium.profile] holds the sound speeds",
        ),
    ] {
        let text = format!("{minimal}\n[medium]\n{medium}\n");
        let errors = config_files::parse(&text, &broken_dir()).expect_err(medium);
        let said = errors.to_string();
        assert!(said.contains(words), "{medium}:\n{said}\nwant {words}");
    }
}

#[test]
fn a_bad_surface_is_refused_with_value_and_rule() {
    let minimal = fs::read_to_string(broken_dir().join("../minimal.toml")).expect("readable");
    for (medium, words) in [
        (
            "multipath = { legs = \"bottom\" }",
            "medium.multipath.legs = \"bottom\": must be \"surface\" or \"surface-bottom\"",
        ),
        (
            "wind_m_per_s = 41",
            "medium.wind_m_per_s = 41: must be a number from 0 to 40",
        ),
        (
            "surface = { correlation_time_ms = 10 }",
            "medium.surface.correlation_time_ms = 10: only with scattering = true",
        ),
    ] {
        let text = format!("{minimal}\n[medium]\n{medium}\n");
        let errors = config_files::parse(&text, &broken_dir()).expect_err(medium);
        let said = errors.to_string();
        assert!(said.contains(words), "{medium}:\n{said}\nwant {words}");
    }
}

#[test]
fn bad_volume_reverberation_is_refused_with_key_value_and_rule() {
    let minimal = fs::read_to_string(broken_dir().join("../minimal.toml")).expect("readable");
    for (medium, words) in [
        (
            "volume = [{ top_m = 9, bottom_m = 9, sv_db = -70 }]",
            "bottom_m = 9: must be greater than top_m = 9",
        ),
        (
            "volume = [{ top_m = 0, bottom_m = 9, sv_db = -70 }, { top_m = 8, bottom_m = 12, sv_db = -70 }]",
            "top_m = 8: the layer must not overlap that from 0 to 9 m",
        ),
        (
            "volume = [{ top_m = 0, bottom_m = 9, sv_db = 70 }]",
            "sv_db = 70: must be",
        ),
        ("volume = [{ top_m = 0, bottom_m = 9 }]", "sv_db: missing"),
        (
            "volume_scatterers_per_cell = 2.0",
            "medium.volume_scatterers_per_cell = 2.0: only with a layer: [[medium.volume]]",
        ),
    ] {
        let text = format!("{minimal}\n[medium]\n{medium}\n");
        let errors = config_files::parse(&text, &broken_dir()).expect_err(medium);
        let said = errors.to_string();
        assert!(said.contains(words), "{medium}:\n{said}\nwant {words}");
    }
}

#[test]
fn a_bad_instrument_is_refused_with_place_value_and_rule() {
    let minimal = fs::read_to_string(broken_dir().join("../minimal.toml")).expect("readable");
    let second =
        "[[sonar.instrument.second_sonar]]\nkind = \"cw\"\nbearing_deg = 10.0\nlevel_db = 120.0\n";
    let second = |lines: &str| format!("{second}{lines}");
    for (instrument, words) in [
        (
            "[sonar.instrument]\nring_down_q = 9.0".into(),
            "sonar[0].instrument.ring_down_q = 9.0: only with leakage_db",
        ),
        (
            "[sonar.instrument]\nleakage_db = -70.0\nring_down_khz = 9.0".into(),
            "sonar[0].instrument.ring_down_khz = 9.0: only with ring_down_q",
        ),
        (
            "[sonar.instrument]\nleakage_db = -70.0\nring_down_q = 0.1".into(),
            "sonar[0].instrument.ring_down_q = 0.1: must be a number from 0.5 to 1000",
        ),
        (
            "[sonar.instrument]\ncrosstalk_arrays_db = -40.0".into(),
            "sonar[0].instrument.crosstalk_arrays_db = -40.0: needs at least two receive arrays",
        ),
        (
            "[sonar.instrument]\nelement_seed = 4".into(),
            "sonar[0].instrument.element_seed = 4: only with element_gain_db or element_phase_deg",
        ),
        (
            "[sonar.instrument]\nelement_file = \"elements.csv\"\nelement_gain_db = 1.0".into(),
            "sonar[0].instrument.element_gain_db = 1.0: only with no element_file",
        ),
        (
            "[sonar.instrument]\nelement_file = \"elements.csv\"".into(),
            "sonar[0].instrument.element_file = \"elements.csv\": line 3: element 16: must be a whole number from 0 to 15",
        ),
        (
            "[sonar.instrument]\nelement_file = \"track.csv\"".into(),
            "must be the name of a receive array: rx",
        ),
        (
            "[sonar.instrument]\nresponse = {}".into(),
            "sonar[0].instrument.response: must have either `q` or `file`",
        ),
        (
            "[sonar.instrument]\nresponse = { file = \"response.csv\" }".into(),
            "sonar[0].instrument.response.file = \"response.csv\": line 4: 200 kHz: must be greater than 200 kHz, the frequency before",
        ),
        (
            "[sonar.instrument]\nresponse = { file = \"../response.csv\" }".into(),
            "400 to 500 kHz: must cover the band of the pulse, 190 to 210 kHz",
        ),
        (
            "[sonar.instrument]\nresponse = { file = \"elements.csv\" }".into(),
            "line 2: \"rx,0,0.5,3\": must be a frequency in kHz, dB and degrees",
        ),
        (
            second("center_frequency_khz = 900.0\nduration_ms = 1.0\nperiod_ms = 100.0"),
            "second_sonar[0].center_frequency_khz = 900.0: must keep its band within 240 kHz of sonar.pulse.center_frequency_khz = 200",
        ),
        (
            second("center_frequency_khz = 190.0\nduration_ms = 100.0\nperiod_ms = 100.0"),
            "second_sonar[0].period_ms = 100.0: must be longer than duration_ms",
        ),
        (
            "[sonar.instrument]\nleakage_db = -70.0\n[sonar.model]\noutput = \"beams\"\n[sonar.beams]\nport = \"rx\"".into(),
            "sonar[0].model.output = \"beams\": must be \"elements\" or \"auto\": sonar.instrument acts on single elements",
        ),
    ] {
        let text = format!("{minimal}\n{instrument}\n");
        let errors = config_files::parse(&text, &broken_dir()).expect_err(&instrument);
        let said = errors.to_string();
        assert!(said.contains(words), "{instrument}:\n{said}\nwant {words}");
    }
}

#[test]
fn no_broken_configuration_is_accepted_and_each_problem_is_one_line() {
    for file in broken_files() {
        let text = fs::read_to_string(&file).expect("readable");
        let errors = config_files::parse(&text, &broken_dir())
            .err()
            .unwrap_or_else(|| panic!("{} was accepted", file.display()));
        for problem in &errors.problems {
            let printed = problem.to_string();
            assert!(
                !printed.contains('\n') && !printed.is_empty(),
                "{}: {printed:?}",
                file.display()
            );
        }
    }
}

#[test]
fn lists_have_a_longest_length_and_a_long_one_is_refused_at_once() {
    let minimal = echotank_testing::repository().join("tests/data/config/minimal.toml");
    let minimal = fs::read_to_string(minimal).expect("readable");
    let (head, sonar) = minimal.split_at(minimal.find("[[sonar]]").expect("a sonar"));
    let names = vec!["\"rx\""; 100_000].join(", ");
    let rows = vec!["[1, 2]"; 100_000].join(", ");
    let unknown: String = (0..100_000).map(|k| format!("k{k} = 1\n")).collect();
    let source = "[[nav.source]]\nname = \"gnss\"\nkind = \"udp\"\nlisten = \"127.0.0.1:0\"\n";
    for (what, text, want) in [
        (
            "sonars",
            head.to_owned() + &sonar.repeat(20_000),
            "sonar: has 20000 entries; must be 1 to 32 tables, each under its own [[...]]",
        ),
        (
            "sources",
            minimal.replace("[scene.seabed]", &(source.repeat(5000) + "[scene.seabed]")),
            "nav.source: has 5001 entries; must be 1 to 32 tables",
        ),
        (
            "arrays",
            minimal.clone() + &"[[sonar.receive]]\nname = \"x\"\n".repeat(5000),
            "sonar[0].receive: has",
        ),
        (
            "pulses",
            minimal.clone() + &"[[sonar.more_pulse]]\n".repeat(5000),
            "sonar[0].more_pulse: has 5000 entries; must be 1 to 32 tables",
        ),
        (
            "faults",
            minimal.clone() + &"[[fault]]\n".repeat(5000),
            "fault: has 5000 entries; must be 1 to 1000 tables",
        ),
        (
            "names",
            format!("{minimal}[sonar.output.elements]\narrays = [{names}]\n"),
            "has 100000 entries; must be 1 to 256 names in brackets",
        ),
        (
            "rows",
            minimal.replace("[sonar.ping]", &format!("tvg = [{rows}]\n[sonar.ping]")),
            "1 to 10000 pairs of numbers",
        ),
        (
            "unknown keys",
            unknown + &minimal,
            "99980 more unknown keys",
        ),
    ] {
        let started = std::time::Instant::now();
        let errors = config_files::parse(&text, Path::new(".")).expect_err(what);
        let seconds = started.elapsed().as_secs_f64();
        assert!(errors.to_string().contains(want), "{what}: {errors}");
        assert!(seconds < 20.0, "{what}: {seconds} s");
        assert!(
            errors.problems.len() < 30,
            "{what}: {}",
            errors.problems.len()
        );
    }
}

#[test]
fn a_file_that_cannot_be_read_is_named_with_the_reason() {
    let folder = tempfile::tempdir().expect("temporary folder");
    let missing = folder.path().join("missing.toml");
    let said = config_files::load(&missing)
        .expect_err("missing")
        .to_string();
    let want = format!(
        "{}: 1 problem\ncannot be read: not found",
        missing.display()
    );
    assert_eq!(said, want);

    let latin = folder.path().join("latin.toml");
    fs::write(&latin, b"# caf\xe9\n").expect("writable");
    let said = config_files::load(&latin)
        .expect_err("not UTF-8")
        .to_string();
    assert!(
        said.ends_with("cannot be read: byte 5 is not UTF-8"),
        "{said}"
    );
}

/// A template with a few bytes inserted, removed or changed.
fn mutated(seed_bytes: &[(usize, u8, u8)]) -> String {
    let mut bytes = config::template().as_bytes().to_vec();
    for &(place, action, byte) in seed_bytes {
        let at = place % bytes.len();
        match action % 4 {
            0 => bytes[at] = byte,
            1 => bytes.insert(at, byte),
            2 => {
                bytes.remove(at);
            }
            // Uncomments lines, because most of the template is comments.
            _ => {
                let hash = bytes[at..].iter().position(|&b| b == b'#');
                if let Some(hash) = hash {
                    bytes[at + hash] = b' ';
                }
            }
        }
    }
    String::from_utf8_lossy(&bytes).into_owned()
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 400, ..ProptestConfig::default() })]

    #[test]
    fn mutations_of_the_template_never_panic(
        changes in prop::collection::vec((any::<usize>(), any::<u8>(), any::<u8>()), 1..20)
    ) {
        let text = mutated(&changes);
        if let Ok(spec) = config_files::parse(&text, Path::new("/nonexistent")) {
            config::summary(&spec);
        }
    }

    #[test]
    fn any_value_behind_any_key_never_panics(
        line in any::<usize>(),
        value in prop::sample::select(vec![
            "0", "-1", "1e308", "-1e308", "1e-308", "5e-324", "nan", "-inf", "9223372036854775807", "-9223372036854775808", "0xff",
            "99999999999999999999999", "1_000.5", "\"\"", "\"\\u0000\"", "[]", "[[]]", "[[0.0, 0.0]]", "{}", "{ a = 1 }", "true",
            "1979-05-27", "[\"rx\", 1]", "[nan, nan]", "[1, 2, 3]", "\"rx\"", "\"none\"",
        ]),
    ) {
        let lines: Vec<&str> = config::template().lines().collect();
        let at = line % lines.len();
        let text: String = lines
            .iter()
            .enumerate()
            .map(|(i, l)| match l.split_once(" = ") {
                Some((key, _)) if i >= at && i < at + 12 => {
                    format!("{} = {value}\n", key.trim_start_matches("# "))
                }
                _ => format!("{l}\n"),
            })
            .collect();
        if let Ok(spec) = config_files::parse(&text, Path::new("/nonexistent")) {
            config::summary(&spec);
        }
    }
}
