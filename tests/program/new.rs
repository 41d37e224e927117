//! Tests of `echotank new`: the rigs that it writes check clean and ping, and wrong arguments are refused.

use std::path::{Path, PathBuf};

use echotank_protocols::sevenk::RecordBody;
use echotank_protocols::sevenk::file::FileReader;

use crate::{Ended, file_of, replay_into, run, run_well};

/// `echotank new KIND --frequency-khz F --range-m R --protocol P --out FILE`
fn arguments(kind: &str, khz: f64, range_m: f64, protocol: &str, out: &Path) -> Vec<String> {
    let out = out.to_str().expect("text").to_owned();
    let pairs = [
        ("--frequency-khz", khz.to_string()),
        ("--range-m", range_m.to_string()),
        ("--protocol", protocol.to_owned()),
        ("--out", out),
    ];
    let pairs = pairs.into_iter();
    let pairs = pairs.flat_map(|(name, value)| [name.to_owned(), value]);
    std::iter::once(kind.to_owned()).chain(pairs).collect()
}

/// Writes a rig and checks it: `quick`ly, because `new` itself refuses a rig whose methods miss the tolerance, or with all that `check` has to say.
fn rig(
    folder: &Path,
    kind: &str,
    khz: f64,
    range_m: f64,
    protocol: &str,
    quick: Option<&str>,
) -> PathBuf {
    let rig = folder.join(format!("{kind}-{protocol}-{range_m}.toml"));
    run_well("new", arguments(kind, khz, range_m, protocol, &rig));
    let path = rig.to_str().expect("text");
    let said = run_well("check", std::iter::once(path).chain(quick));
    for wrong in ["warning", "NOT MET"] {
        assert!(!said.contains(wrong), "{}: {said}", rig.display());
    }
    rig
}

/// The rigs of a kind with each protocol and at three ranges check clean. At one range each they ping, and the records of their protocol are in a
/// file; protocols without a file write their samples.
fn checks_clean_and_pings(kind: &str, khz: f64, ranges_m: [f64; 3], protocols: &[&str]) {
    let folder = tempfile::tempdir().expect("a folder");
    for (number, protocol) in protocols.iter().enumerate() {
        for (at, range_m) in ranges_m.into_iter().enumerate() {
            let pings = at == number % ranges_m.len();
            let quick = (!pings).then_some("--quick");
            let rig = rig(folder.path(), kind, khz, range_m, protocol, quick);
            if !pings {
                continue;
            }
            let (format, begins): (_, &[u8]) = match *protocol {
                "7k" => ("s7k", &[]),
                "jsf" => ("jsf", &[0x01, 0x16]),
                "xtf" => ("xtf", &[123]),
                _ => ("npz", b"PK"),
            };
            let out = rig.with_extension("out");
            replay_into(&out, &rig, &["--formats", format, "--pings", "1..3"]);
            // Each of several sonars has a folder.
            let port = out.join("sidescan-port");
            let place = if port.is_dir() { &port } else { &out };
            let bytes = std::fs::read(file_of(place, "", format)).expect("records");
            assert!(bytes.starts_with(begins), "{protocol}: {:?}", &bytes[..4]);
            if *protocol == "7k" {
                let records = FileReader::new(&bytes).map(|read| read.expect("sound").record);
                let pings = records.filter(|r| r.frame.record_type_id == 7000).count();
                assert_eq!(pings, 3, "{kind}");
            }
        }
    }
}

#[test]
fn a_new_sidescan_checks_clean_and_pings_on_each_protocol() {
    let protocols = [
        "7k",
        "jsf",
        "xtf",
        "ping",
        "imagenex872",
        "vita49",
        "elements",
    ];
    checks_clean_and_pings("sidescan", 455.0, [10.0, 30.0, 75.0], &protocols);
}

#[test]
fn a_new_multibeam_checks_clean_and_pings_on_each_protocol() {
    let protocols = ["7k", "wbms", "ping", "vita49", "elements"];
    checks_clean_and_pings("multibeam", 400.0, [10.0, 45.0, 100.0], &protocols);
}

#[test]
fn a_new_forward_looking_sonar_checks_clean_and_pings_on_each_protocol() {
    let protocols = ["7k", "wbms", "vita49", "elements"];
    checks_clean_and_pings("forward-looking", 300.0, [10.0, 30.0, 50.0], &protocols);
}

#[test]
fn a_new_board_checks_clean_and_pings_on_each_protocol() {
    let protocols = ["vita49", "elements", "7k"];
    checks_clean_and_pings("board", 100.0, [10.0, 40.0, 150.0], &protocols);
}

#[test]
fn a_new_multibeam_detects_the_bottom_at_its_depth() {
    let folder = tempfile::tempdir().expect("a folder");
    let rig = rig(folder.path(), "multibeam", 400.0, 45.0, "7k", None);
    let out = folder.path().join("out");
    replay_into(&out, &rig, &["--formats", "s7k", "--pings", "1..3"]);
    let bytes = std::fs::read(file_of(&out, "", "s7k")).expect("records");
    let mut pings = 0;
    for read in FileReader::new(&bytes) {
        let record = read.expect("sound").record;
        let Ok(RecordBody::RawDetections(found)) = RecordBody::parse(&record) else {
            continue;
        };
        pings += 1;
        let samples = found.detections().map(|d| d.detection_sample);
        let first = f64::from(samples.fold(f32::INFINITY, f32::min));
        let first_m = 750.0 * first / f64::from(found.rth.sampling_rate_hz);
        // The bottom lies at 18 m, the transducer at 1 m, and the swell has 0.1 m. The first sounding of a flat bottom is straight below.
        assert!((first_m - 17.0).abs() < 0.1 + 0.15, "{first_m} m");
        assert!(
            found.rth.detections > 180,
            "{} of 192",
            found.rth.detections
        );
    }
    assert_eq!(pings, 3);
}

#[test]
fn a_new_rig_takes_a_log_or_a_live_source_and_a_survey() {
    let folder = tempfile::tempdir().expect("a folder");
    let root = echotank_testing::repository();
    let log = root.join("tests/data/nav/seapath330_90s.rvdas");
    let survey = root.join("hil-configs/data/jd211_crop_400x400_2m.asc");
    let navs = [
        (log.to_str().expect("text"), "kind = \"log\""),
        ("udp:10110", "listen = \"0.0.0.0:10110\""),
        ("udp://127.0.0.1:10110", "listen = \"127.0.0.1:10110\""),
        ("tcp://gnss:5000", "connect = \"gnss:5000\""),
        ("serial:/dev/ttyUSB0:4800", "baud = 4800"),
    ];
    for (nav, line) in navs {
        let rig = folder.path().join("rig.toml");
        let mut all = arguments("sidescan", 200.0, 100.0, "jsf,xtf", &rig);
        let more = [
            "--force",
            "--nav",
            nav,
            "--seabed",
            survey.to_str().unwrap(),
        ];
        all.extend(more.map(str::to_owned));
        run_well("new", all);
        let text = std::fs::read_to_string(&rig).expect("written");
        assert!(text.contains(line), "{nav}: {text}");
        assert!(run_well("check", [&rig]).contains("xtf"), "{nav}");
    }
}

#[test]
fn wrong_arguments_are_refused_with_argument_value_and_rule() {
    let folder = tempfile::tempdir().expect("a folder");
    let there = folder.path().join("there.toml");
    std::fs::write(&there, "mine").expect("written");
    let free = folder.path().join("free.toml");
    let right = ("sidescan", 455.0, 75.0, "jsf");
    let of = |(kind, khz, range_m, protocol), out: &Path, more: &[&str]| -> Ended {
        let mut all = arguments(kind, khz, range_m, protocol, out);
        all.extend(more.iter().map(|&text| text.to_owned()));
        run("new", all)
    };
    let survey = "hil-configs/data/jd211_crop_400x400_2m.asc";
    for (done, words) in [
        (
            of(("sidescan", 0.0, 75.0, "jsf"), &free, &[]),
            "--frequency-khz 0: must be 5 to 1500 kHz",
        ),
        (
            of(("sidescan", 455.0, 75.0, "wbms"), &free, &[]),
            "--protocol wbms: does not suit a side-scan: one of 7k, jsf, xtf,",
        ),
        (
            of(("sidescan", 455.0, 75.0, "ping,jsf"), &free, &[]),
            "`ping` must be the only protocol",
        ),
        (
            of(("sidescan", 455.0, 1e6, "jsf"), &free, &[]),
            "--range-m 1000000: must be 0.99 to ",
        ),
        (
            of(right, &there, &[]),
            "there.toml: exists already: give another file, or --force",
        ),
        (
            of(right, &free, &["--elements", "0"]),
            "--elements 0: must be 1 to 64",
        ),
        (
            of(right, &free, &["--nav", "udp:port"]),
            "--nav udp:port: must be udp:PORT",
        ),
        (
            of(right, &free, &["--nav", "no.log"]),
            "--nav no.log: no address (udp:, tcp:, serial:), and as a file: not found",
        ),
        (
            of(right, &free, &["--seabed", "no.tif"]),
            "--seabed no.tif: no.tif: cannot be read",
        ),
        (
            of(
                ("sidescan", 455.0, 30.0, "jsf"),
                &free,
                &["--seabed", survey],
            ),
            "--range-m 30: must be above 58 m: half of hil-configs/data/jd211",
        ),
        (
            run("new", ["board"]),
            "--frequency-khz is missing, for example",
        ),
        (
            run::<&str>("new", []),
            "the kind of sonar (sidescan, multibeam,",
        ),
    ] {
        assert_eq!(done.code, Some(2), "{words}: {}", done.err);
        assert!(done.err.contains(words), "no `{words}`: {}", done.err);
        assert!(done.out.is_empty(), "{words}: {}", done.out);
    }
    assert_eq!(std::fs::read(&there).expect("there"), b"mine");
    let files: Vec<_> = crate::files_in(folder.path()).collect();
    assert_eq!(files, [there], "nothing else was written");
}
