//! Deliberate mistakes in two rigs that `echotank new` wrote, and the verdict that each gets: a side-scan of 455 kHz with NMEA over UDP, JSF and XTF,
//! and a multibeam of 256 elements on 7k over a survey in GeoTIFF. `docs/configure/recipes.md` has the table.

use std::path::{Path, PathBuf};

use crate::{run, run_well};

/// A mistake: what it is, texts of the rig with their replacements, the exit status, and words of the answer.
type Mistake = (
    &'static str,
    &'static [(&'static str, &'static str)],
    i32,
    &'static [&'static str],
);

const SIDESCAN: &[Mistake] = &[
    (
        "arrays that hear both sides",
        &[
            ("baffled = true", "baffled = false"),
            ("width_m = 0.0033", "width_m = 0.0"),
        ],
        1,
        &["verdict      saturates, sides mirrored", "baffled = true"],
    ),
    (
        "a density of one",
        &[("density = \"auto\"", "density_per_m2 = 1.0")],
        1,
        &[
            "verdict      speckle undersampled",
            "density_per_m2 of at least ",
        ],
    ),
    (
        "sixteen times the elements",
        &[
            ("elements = 4 ", "elements = 64 "),
            ("spacing_m = 0.0837", "spacing_m = 0.0052"),
            ("length_m = 0.0837", "length_m = 0.0052"),
            ("[run]", "[run]\nthreads = 1"),
        ],
        1,
        &["too slow", "sonar.ping.rate_hz of at most "],
    ),
    (
        "a bottom beyond the range",
        &[("depth_m = 12.0", "depth_m = 120.0")],
        1,
        &["verdict      sees no seabed", "range_m above 120"],
    ),
    (
        "a method that cannot keep the tolerance",
        &[
            ("doppler = \"auto\"", "doppler = \"none\""),
            ("synthesis = \"auto\"", "synthesis = \"nearest\""),
        ],
        1,
        &["inaccurate", "synthesis = \"auto\""],
    ),
    (
        "forty decibels too many",
        &[("gain_db = 0.0", "gain_db = 40.0")],
        1,
        &["verdict      saturates", "sonar.ping.gain_db of at most "],
    ),
    (
        "a sharp pulse without the receiver filter",
        &[
            ("rx_filter = \"fir\"", "rx_filter = \"none\""),
            ("taper = 0.1", "taper = 0.0"),
        ],
        1,
        &["aliased band", "rx_filter = \"fir\""],
    ),
    (
        "two servers on one port",
        &[("127.0.0.1:1701", "127.0.0.1:1700")],
        2,
        &["listen_data = \"127.0.0.1:1700\": TCP port already used by "],
    ),
];

const MULTIBEAM: &[Mistake] = &[
    (
        "elements a wavelength apart",
        &[("spacing_m = 0.00188", "spacing_m = 0.0038")],
        1,
        &["grating lobes", "spacing_m of at most 0.00196"],
    ),
    (
        "eight times the sample rate",
        &[
            ("sample_rate_khz = 38.7", "sample_rate_khz = 300.0"),
            ("[run]", "[run]\nthreads = 1"),
        ],
        1,
        &[
            "verdict      records exceed the link, too slow",
            "a lower sonar.receiver.sample_rate_khz",
        ],
    ),
    (
        "a range short of the survey",
        &[("range_m = 90.0 ", "range_m = 20.0 ")],
        1,
        &["verdict      sees no seabed", "range_m above "],
    ),
];

fn rig(folder: &Path, name: &str, arguments: &[&str]) -> PathBuf {
    let file = folder.join(name);
    let out = ["--out", file.to_str().expect("text")];
    run_well("new", arguments.iter().chain(&out));
    file
}

/// The rig as written works; with each mistake it gets its verdict.
fn answers(rig: &Path, mistakes: &[Mistake]) {
    run_well("check", [rig]);
    let text = std::fs::read_to_string(rig).expect("readable");
    for (mistake, replacements, code, words) in mistakes {
        let mut wrong = text.clone();
        for (right, replacement) in *replacements {
            assert!(wrong.contains(right), "{mistake}: {right}");
            wrong = wrong.replace(right, replacement);
        }
        let file = rig.with_file_name("mistake.toml");
        std::fs::write(&file, wrong).expect("written");
        let done = run("check", [&file]);
        let said = format!("{}{}", done.out, done.err);
        assert_eq!(done.code, Some(*code), "{mistake}: {said}");
        for words in *words {
            assert!(said.contains(words), "{mistake}: no `{words}`:\n{said}");
        }
    }
}

#[test]
fn mistakes_in_a_new_sidescan_get_their_verdicts() {
    let folder = tempfile::tempdir().expect("a folder");
    let arguments = "sidescan --frequency-khz 455 --range-m 75 --protocol jsf,xtf --nav udp:10110";
    let arguments: Vec<_> = arguments.split(' ').collect();
    let rig = rig(folder.path(), "sidescan.toml", &arguments);
    answers(&rig, SIDESCAN);
    // Formats of another sonar.
    let out = folder.path().join("out");
    let log = echotank_testing::repository().join("tests/data/nav/seapath330_90s.rvdas");
    let replay = [
        rig.as_os_str(),
        "--nav".as_ref(),
        log.as_os_str(),
        "--out".as_ref(),
        out.as_os_str(),
        "--formats".as_ref(),
        "fan".as_ref(),
    ];
    let done = run("replay", replay);
    assert_eq!(done.code, Some(2), "{}{}", done.out, done.err);
    assert!(done.err.contains("fan"), "{}", done.err);
}

#[test]
fn mistakes_in_a_new_multibeam_get_their_verdicts() {
    let folder = tempfile::tempdir().expect("a folder");
    let survey = echotank_testing::repository().join("tests/data/bathy/laparguera_hitw_bathy.tif");
    let mut arguments: Vec<_> =
        "multibeam --frequency-khz 400 --range-m 90 --protocol 7k --elements 256 --seabed"
            .split(' ')
            .collect();
    arguments.push(survey.to_str().expect("text"));
    let rig = rig(folder.path(), "multibeam.toml", &arguments);
    answers(&rig, MULTIBEAM);
}
