//! Tests of the commands that print and exit: `check`, `nav`, `scene info`.

use std::path::Path;

use echotank_testing::seeds::{self, data};

use crate::{ends_quietly, run, run_well};

/// `echotank check rig.toml | head -1`
#[test]
fn commands_end_quietly_when_their_output_is_closed() {
    let folder = tempfile::tempdir().expect("a folder");
    let out = folder.path().to_str().expect("text");
    for (name, arguments) in [
        ("check", "hil-configs/points.toml"),
        (
            "replay",
            &format!("hil-configs/points.toml --pings 1..1 --quiet --out {out}"),
        ),
        ("scene", "info hil-configs/data/jd211_crop_400x400_2m.asc"),
    ] {
        ends_quietly(name, arguments.split(' '));
    }
}

/// A pipe without a writer would block, and a device may have no end.
#[test]
fn pipes_and_devices_are_refused_as_input_files() {
    let folder = tempfile::tempdir().expect("a folder");
    let pipe = folder.path().join("pipe");
    let made = std::process::Command::new("mkfifo").arg(&pipe).status();
    assert!(made.expect("mkfifo runs").success());
    let pipe = pipe.to_str().expect("text");
    for (name, arguments) in [
        ("check", &[pipe][..]),
        ("check", &["/dev/zero"]),
        ("check", &[pipe, "--set", "run.threads=1"]),
        ("scene", &["info", pipe]),
        ("nav", &[pipe]),
        ("nav", &["/dev/zero"]),
        ("nav", &["/"]),
    ] {
        let done = run(name, arguments);
        assert_ne!(done.code, Some(0), "{name} {arguments:?}");
        assert!(
            done.err.contains("not a"),
            "{name} {arguments:?}: {}",
            done.err
        );
    }
}

#[test]
fn the_report_is_printed_as_text_and_json_and_drawn() {
    let folder = tempfile::tempdir().expect("a folder");
    let png = folder.path().join("plot.png");
    let log = echotank_testing::repository().join("tests/data/nav/seapath330_90s.rvdas");
    let log = log.to_str().expect("text");
    let nav = |more: &[&str]| run_well("nav", [&[log], more].concat());
    let text = nav(&["--png", png.to_str().expect("text")]);
    for words in [
        "720: 452 used, 268 not taken",
        "roll-pitch    90 samples, every 1.000 s",
        "depth         no samples",
        "heading comes from PSXN,23",
    ] {
        assert!(text.contains(words), "no `{words}`:\n{text}");
    }
    let json: serde_json::Value = serde_json::from_str(&nav(&["--json"])).expect("JSON");
    assert_eq!(json["counters"]["used"], 452);
    assert_eq!(json["quantities"]["roll-pitch"]["samples"], 90);
    // The picture is not empty: it shows a track and four curves.
    let (info, pixels) = picture(&png);
    assert!(info.width > 1000 && info.height > 500);
    let channels = info.color_type.samples();
    let inked = pixels
        .chunks(channels)
        .filter(|p| p[0] < 100 && p[channels.min(3) - 1] > 120);
    assert!(inked.count() > 2000, "blue curves");
}

#[test]
fn binary_logs_are_named_and_refused_with_status_2() {
    let folder = tempfile::tempdir().expect("a folder");
    let log = folder.path().join("dvl.bin");
    std::fs::write(&log, [0x7F, 0x7F, 0, 1, 2, 3].repeat(100)).expect("written");
    let done = run("nav", [&log]);
    assert_eq!(done.code, Some(2), "{}", done.out);
    assert!(
        done.err.contains("binary file (Teledyne PD0)"),
        "{}",
        done.err
    );
    let quickstart = echotank_testing::repository().join("hil-configs/quickstart.toml");
    let out = folder.path().join("out");
    let done = run(
        "replay",
        [
            quickstart.as_os_str(),
            "--nav".as_ref(),
            log.as_os_str(),
            "--out".as_ref(),
            out.as_os_str(),
        ],
    );
    assert_eq!(done.code, Some(2), "{}", done.out);
    assert!(done.err.contains("Teledyne PD0"), "{}", done.err);
    for command in ["run", "check"] {
        let path = format!("nav.source.0.path=\"{}\"", log.display());
        let done = run(
            command,
            [quickstart.as_os_str(), "--set".as_ref(), path.as_ref()],
        );
        assert_eq!(done.code, Some(2), "{command}: {}", done.out);
        assert!(done.err.contains("Teledyne PD0"), "{command}: {}", done.err);
    }
}

#[test]
fn a_log_needs_no_list_of_its_quantities() {
    let folder = tempfile::tempdir().expect("a folder");
    let data = echotank_testing::repository().join("tests/data");
    let text = std::fs::read_to_string(data.join("config/minimal.toml")).expect("readable");
    let log = data.join("navlogs/zeus_1200.log");
    let source = format!("kind = \"log\"\npath = \"{}\"", log.display());
    let text = text.replace("kind = \"udp\"\nlisten = \"127.0.0.1:10110\"", &source);
    let config = folder.path().join("log.toml");
    std::fs::write(&config, text).expect("written");
    let done = run("check", [&config]);
    assert_ne!(done.code, Some(2), "{}", done.err);
    assert!(
        done.out
            .contains("provides position, course-speed, heading\n"),
        "{}",
        done.out
    );
    assert!(
        done.out.contains("no source gives roll and pitch"),
        "{}",
        done.out
    );
    let out = folder.path().join("out");
    let pings = [
        "--out".as_ref(),
        out.as_os_str(),
        "--pings".as_ref(),
        "1..3".as_ref(),
    ];
    let done = run("replay", [&[config.as_os_str()], &pings[..]].concat());
    assert_eq!(done.code, Some(0), "{}", done.err);
    assert!(done.out.contains("3 pings computed"), "{}", done.out);
}

fn picture(path: &Path) -> (png::OutputInfo, Vec<u8>) {
    let file = std::io::BufReader::new(std::fs::File::open(path).expect("drawn"));
    let mut reader = png::Decoder::new(file).read_info().expect("a PNG");
    let mut pixels = vec![0; reader.output_buffer_size().expect("small")];
    let info = reader.next_frame(&mut pixels).expect("whole");
    (info, pixels)
}

fn scene_info(args: &[&str]) -> (i32, String, String) {
    let done = run("scene", [&["info"], args].concat());
    (done.code.unwrap_or(-1), done.out, done.err)
}

#[test]
fn scene_info_prints_text_and_json_and_draws_relief() {
    let folder = tempfile::tempdir().expect("folder");
    let png = folder.path().join("reef.png");
    let reef = data("laparguera_hitw_bathy.tif");
    let (reef, png) = (reef.to_str().unwrap(), png.to_str().unwrap());
    let at = "--at=205732.37450969967,137484.22769317782";
    let (code, out, err) = scene_info(&[reef, at, "--png", png]);
    assert_eq!((code, err.as_str()), (0, ""));
    for part in [
        "system    projected metres (EPSG:32161)  [stated: in the file]",
        "heights   elevations, positive up  [guessed: most numbers are negative]",
        "size      75 rows x 75 columns, cells 3.9967432 north x 3.9967432 east",
        "first row north  [stated: by the format]",
        "holes     0.00 %",
        "depth 51.938763 m (row 35 from the south, column 2)",
        "picture   ",
    ] {
        assert!(out.contains(part), "{part} is not in\n{out}");
    }
    let (_, pixels) = picture(Path::new(png));
    assert!(
        pixels.chunks(3).any(|p| p[2] > 120 && p[0] < 60),
        "deep blue"
    );

    let (code, out, _) = scene_info(&[reef, at, "--json", "--values", "depth"]);
    let json: serde_json::Value = serde_json::from_str(&out).expect("JSON");
    assert_eq!(code, 0);
    assert_eq!(json["heights"], "depth");
    assert_eq!(json["layout"]["rows"], 75);
    assert_eq!(json["at"][0]["depth_m"], -51.93876266479492);
}

#[test]
fn check_warns_of_what_a_seabed_file_does_not_state_with_extent_and_depths() {
    let folder = tempfile::tempdir().expect("folder");
    let east_north = (0..=12).flat_map(|east| (0..=9).map(move |north| (east, north)));
    let soundings: String = east_north
        .map(|(east, north)| format!("{} {} -{}\n", 10 * east, 10 * north, 10 + east))
        .collect();
    std::fs::write(folder.path().join("bottom.xyz"), soundings).expect("written");
    let minimal = echotank_testing::repository().join("tests/data/config/minimal.toml");
    let text = std::fs::read_to_string(minimal).expect("readable");
    let text = text.replace(
        "shape = \"plane\"\ndepth_m = 40.0",
        "shape = \"file\"\npath = \"bottom.xyz\"\ncell_m = 5.0",
    );
    assert!(text.contains("bottom.xyz"), "{text}");
    let config = folder.path().join("rig.toml");
    std::fs::write(&config, text).expect("written");
    let done = run("check", [&config]);
    assert_ne!(done.code, Some(2), "{}", done.err);
    for words in [
        "warning      seabed, guessed: ",
        "heights are elevations",
        "90.0 m north x 120.0 m east, depths 10.",
    ] {
        assert!(
            done.out.contains(words),
            "no `{words}`:\n{}{}",
            done.out,
            done.err
        );
    }
}

#[test]
fn scene_info_refuses_with_status_2_and_the_files_name() {
    let folder = tempfile::tempdir().expect("folder");
    let file = |name: &str, bytes: &[u8]| {
        let path = folder.path().join(name);
        std::fs::write(&path, bytes).expect("write");
        path.to_str().expect("a name").to_owned()
    };
    let cut = file("cut.tif", &seeds::small()[3].bytes[..9000]);
    let mesh = file("pyramid.obj", seeds::OBJ.as_bytes());
    for (args, part) in [
        (vec![cut.as_str()], "cut.tif: "),
        (
            vec!["/no/such/file.bag"],
            "/no/such/file.bag: cannot be read",
        ),
        (vec![cut.as_str(), "--crs", "utm-61n"], "must be \"local\""),
        (vec![cut.as_str(), "--at", "1"], "expected two numbers"),
        (
            vec![mesh.as_str(), "--png", "a.png"],
            "this file is a 3-D model",
        ),
    ] {
        let (code, out, err) = scene_info(&args);
        assert_eq!((code, out.as_str()), (2, ""), "{args:?}: {err}");
        assert!(err.contains(part), "{args:?}: {err}");
    }
    let (code, out, _) = scene_info(&[&mesh]);
    assert!(
        code == 0 && out.contains("5 vertices, 6 triangles"),
        "{out}"
    );
}
