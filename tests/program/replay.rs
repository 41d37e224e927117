//! Tests of the command `echotank replay`: the same bytes for any number of threads, and correct target positions.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use serde_json::Value;

use crate::{files_in, replay_into};

mod pictures;
mod starts;
mod stopped;
mod times;

fn config(name: &str) -> PathBuf {
    echotank_testing::repository()
        .join("hil-configs")
        .join(name)
}

/// Replays into a new folder and returns it.
fn replay(arguments: &[&str], name: &str) -> tempfile::TempDir {
    replay_file(arguments, &config(name))
}

fn replay_file(arguments: &[&str], config: &Path) -> tempfile::TempDir {
    let out = tempfile::tempdir().expect("a folder");
    replay_into(out.path(), config, arguments);
    out
}

fn files(folder: &Path) -> BTreeMap<String, Vec<u8>> {
    let bytes_of = |path: PathBuf| {
        let name = path.file_name().expect("a name").to_string_lossy();
        (name.into_owned(), fs::read(&path).expect("file"))
    };
    files_in(folder).map(bytes_of).collect()
}

fn assert_equal(a: &BTreeMap<String, Vec<u8>>, b: &BTreeMap<String, Vec<u8>>) {
    assert_eq!(a.keys().collect::<Vec<_>>(), b.keys().collect::<Vec<_>>());
    for (name, bytes) in a {
        let other = &b[name];
        let first = bytes.iter().zip(other).position(|(x, y)| x != y);
        assert!(
            bytes.len() == other.len() && first.is_none(),
            "{name}: {} and {} bytes, first difference at {first:?}",
            bytes.len(),
            other.len()
        );
    }
}

#[test]
fn replay_gives_the_same_bytes_again_with_another_number_of_threads() {
    for (name, extra) in [
        ("points.toml", vec!["--f64", "--pings", "1..2"]),
        ("quickstart.toml", vec!["--pings", "1..3"]),
    ] {
        let arguments = |threads: &'static str| {
            let mut all = vec!["--formats", "s7k,npz,png", "--threads", threads];
            all.extend(extra.iter().copied());
            all
        };
        let one = replay(&arguments("1"), name);
        let two = replay(&arguments("2"), name);
        let first = files(one.path());
        assert_eq!(first.len(), 4, "{name}: {:?}", first.keys());
        assert!(first.values().all(|bytes| bytes.len() > 1000));
        assert_equal(&first, &files(two.path()));
    }
}

/// Removes values that depend on the first ping of a replay. The error check also uses samples of earlier pings, and the scene
/// reports newly generated tiles.
fn without_history(line: &str) -> String {
    let mut ping: serde_json::Value = serde_json::from_str(line).expect("JSON");
    let fields = ping.as_object_mut().expect("an object");
    fields.remove("error_check");
    let scene = fields["scene"].as_object_mut().expect("an object");
    for made in ["made", "tiles_made"] {
        assert!(scene.remove(made).is_some());
    }
    ping.to_string()
}

#[test]
fn a_7k_file_describes_the_rig_and_its_water_before_the_first_ping() {
    let out = replay(&["--formats", "s7k", "--pings", "1..2"], "quickstart.toml");
    let bytes = fs::read(out.path().join("hull.s7k")).expect("s7k");
    let ids: Vec<u32> = echotank_protocols::sevenk::file::FileReader::new(&bytes)
        .map(|found| found.expect("a record").record.frame.record_type_id)
        .collect();
    assert_eq!(ids[..6], [7200, 7001, 7030, 1009, 7610, 7000]);
    let count = |id: u32| ids.iter().filter(|&&i| i == id).count();
    assert_eq!([7001, 7030, 1009, 7610, 7000].map(count), [1, 1, 1, 2, 2]);
}

#[test]
fn a_part_of_a_replay_is_the_same_as_in_the_whole() {
    // Methods are selected on the first requested ping.
    let fixed = ["path=k-segment", "doppler=stretch", "synthesis=gridded-1d"];
    let fixed = fixed.map(|model| format!("--set=sonar.model.{model}"));
    let of = |pings: &str| {
        let mut arguments = vec!["--formats", "s7k", "--pings", pings];
        arguments.extend(fixed.iter().map(String::as_str));
        replay(&arguments, "quickstart.toml")
    };
    let (whole, part) = (of("1..3"), of("2..3"));
    let lines = |folder: &tempfile::TempDir| -> Vec<String> {
        fs::read_to_string(folder.path().join("truth.jsonl"))
            .expect("truth")
            .lines()
            .map(without_history)
            .collect()
    };
    assert_eq!(lines(&whole)[1..], lines(&part)[..]);
    let records = |folder: &tempfile::TempDir, ping: u32| -> Vec<Vec<u8>> {
        let bytes = fs::read(folder.path().join("hull.s7k")).expect("s7k");
        echotank_protocols::sevenk::file::FileReader::new(&bytes)
            .filter_map(Result::ok)
            .filter(|found| {
                let record = &found.record;
                echotank_runtime::io::sonar::verify::ping_number(
                    record.frame.record_type_id,
                    record.body(),
                ) == Some(ping)
            })
            .map(|found| found.record.bytes().to_vec())
            .collect()
    };
    assert_eq!(records(&whole, 3).len(), 5, "7000, 7503, 7007, 7018, 7038");
    assert_eq!(records(&whole, 3), records(&part, 3));
}

#[test]
fn two_sonars_on_one_platform_each_ping_at_their_own_rate() {
    let points = fs::read_to_string(config("points.toml")).expect("configuration");
    let (rig, sonar) = points.split_at(points.find("[[sonar]]").expect("a sonar"));
    let second = sonar
        .replace("name = \"points\"", "name = \"second\"")
        .replace("rate_hz = 2.0", "rate_hz = 3.0")
        .replace("127.0.0.1:7000", "127.0.0.1:7002")
        .replace("\"reference\"", "\"direct\"");
    let folder = tempfile::tempdir().expect("a folder");
    std::os::unix::fs::symlink(config("data"), folder.path().join("data")).expect("link");
    let two = folder.path().join("two.toml");
    fs::write(&two, format!("{rig}{sonar}\n{second}")).expect("written");
    let out = replay_file(&["--formats", "s7k,npz", "--pings", "1..4"], &two);
    let truth = fs::read_to_string(out.path().join("truth.jsonl")).expect("truth");
    let mut pings: BTreeMap<String, Vec<(u64, i64)>> = BTreeMap::new();
    for line in truth.lines() {
        let line: Value = serde_json::from_str(line).expect("json");
        let name = line["sonar"].as_str().expect("name").to_owned();
        let number = line["ping_number"].as_u64().expect("number");
        let utc_ns = line["utc_ns"].as_i64().expect("time");
        pings.entry(name).or_default().push((number, utc_ns));
    }
    for (name, period_ns) in [("points", 500_000_000), ("second", 333_333_333)] {
        let made = &pings[name];
        assert_eq!(
            made.iter().map(|p| p.0).collect::<Vec<_>>(),
            [1, 2, 3, 4],
            "{name}"
        );
        assert!(
            made.windows(2).all(|w| w[1].1 - w[0].1 == period_ns),
            "{name}: {made:?}"
        );
        assert!(out.path().join(name).join("pings.npz").exists(), "{name}");
        assert!(
            out.path().join(name).join(format!("{name}.s7k")).exists(),
            "{name}"
        );
    }
}

/// Picture in RGB.
struct Picture {
    width: usize,
    rgb: Vec<u8>,
}

impl Picture {
    fn open(path: &Path) -> Self {
        let decoder = png::Decoder::new(std::io::BufReader::new(
            fs::File::open(path).expect("picture"),
        ));
        let mut reader = decoder.read_info().expect("png");
        let mut rgb = vec![0; reader.output_buffer_size().expect("size")];
        let info = reader.next_frame(&mut rgb).expect("pixels");
        assert_eq!(info.color_type, png::ColorType::Rgb);
        Self {
            width: info.width as usize,
            rgb,
        }
    }
    fn height(&self) -> usize {
        self.rgb.len() / 3 / self.width
    }
    fn brightness(&self, x: usize, y: usize) -> u32 {
        let at = 3 * (y * self.width + x);
        self.rgb[at..at + 3].iter().map(|&v| u32::from(v)).sum()
    }
}

/// The waterfall shows targets where the truth file states: in the row of the ping with the target closest to broadside, at its
/// slant range. The brightest pixel nearby must be within one pixel across, and within the rows of the beam's dwell.
#[test]
fn waterfall_shows_the_targets_at_their_predicted_places_within_one_pixel() {
    let (first, last) = (1_u32, 140_u32);
    let out = replay(
        &[
            "--formats",
            "png",
            "--pings",
            &format!("{first}..{last}"),
            "--set",
            "scene.seabed.density_per_m2=0.1",
        ],
        "quickstart.toml",
    );
    let picture = Picture::open(&out.path().join("waterfall.png"));
    let truth: Vec<Value> = fs::read_to_string(out.path().join("truth.jsonl"))
        .expect("truth")
        .lines()
        .map(|line| serde_json::from_str(line).expect("json"))
        .collect();
    assert_eq!(truth.len(), (last - first + 1) as usize);
    let range_m = truth[0]["plan"]["settings"]["range_m"]
        .as_f64()
        .expect("range");
    let metres_per_pixel = range_m / (picture.width as f64 / 2.0);
    let rows_per_ping = picture.height() / truth.len();
    let targets = truth[0]["targets"].as_array().expect("targets").len();
    let mut seen = 0;
    for target in 0..targets {
        let along = |k: usize| {
            truth[k]["targets"][target]["along_m"]
                .as_f64()
                .expect("along-track offset")
        };
        let nearest = (0..truth.len())
            .min_by(|&a, &b| along(a).abs().total_cmp(&along(b).abs()))
            .expect("pings");
        let margin = 6;
        let here = &truth[nearest]["targets"][target];
        let starboard = here["side"].as_str() == Some("starboard");
        // Receive arrays of the quickstart: port, starboard, fan.
        let delay_s = here["delays_s"][usize::from(starboard)]
            .as_f64()
            .expect("delay");
        let sound_speed_m_per_s = truth[nearest]["plan"]["sound_speed_m_per_s"]
            .as_f64()
            .expect("c");
        let slant_m = 0.5 * sound_speed_m_per_s * delay_s;
        if nearest < margin || nearest + margin >= truth.len() || slant_m > range_m - 5.0 {
            continue; // outside the beam in these pings
        }
        seen += 1;
        let offset = (slant_m / metres_per_pixel).floor() as i64;
        let half = picture.width as i64 / 2;
        let x = if starboard {
            half + offset
        } else {
            half - 1 - offset
        };
        // The newest ping is on top.
        let row_of = |ping: usize| (truth.len() - 1 - ping) * rows_per_ping + rows_per_ping / 2;
        let y = row_of(nearest);
        let found = (x - 12..=x + 12)
            .max_by_key(|&column| picture.brightness(column as usize, y))
            .expect("columns");
        let name = here["name"].as_str().unwrap_or("");
        let best = picture.brightness(found as usize, y);
        let ground = (30..60)
            .map(|k| picture.brightness((x - k) as usize, y))
            .sum::<u32>()
            / 30;
        println!(
            "{name}: predicted column {x}, found {found}, row {y}, brightness {best} over {ground}"
        );
        assert!(
            (found - x).abs() <= 1,
            "{name}: predicted column {x}, found {found} in row {y}"
        );
        assert!(
            best > ground + 60,
            "{name} stands out: {best} over {ground}"
        );
    }
    assert!(seen >= 3, "{seen} targets were passed");
}

/// Rigs that emulate devices. Each rig pings offline and receives the flat bottom at 12 m. Their file headers describe further
/// properties.
#[test]
fn every_rig_that_imitates_a_device_pings() {
    for rig in ["seabat", "wbms", "surveyor240", "omniscan450", "board"] {
        let out = replay(
            &["--pings", "1..1", "--formats", "npz"],
            &format!("{rig}.toml"),
        );
        let truth = fs::read_dir(out.path()).expect("folder");
        assert!(truth.count() > 0, "{rig}");
        let text = fs::read_to_string(out.path().join("truth.jsonl")).expect("truth");
        let pings: Vec<Value> = text
            .lines()
            .map(|line| serde_json::from_str(line).expect("JSON"))
            .collect();
        let heads = if rig == "omniscan450" { 2 } else { 1 };
        assert_eq!(pings.len(), heads, "{rig}");
        for ping in &pings {
            let heard = ping["scene"]["used"].as_u64().unwrap_or(0);
            assert!(heard > 100, "{rig}: {heard} scatterers\n{ping}");
        }
    }
}

/// Sample files and their metadata, from a rig with a configuration of neither.
#[test]
fn sigmf_and_wav_hold_the_same_pings() {
    let board = echotank_testing::repository().join("tests/data/rigs/board.toml");
    let out = replay_file(&["--pings", "1..2", "--formats", "sigmf,wav"], &board);
    let meta = fs::read_to_string(out.path().join("board.sigmf-meta")).expect("words");
    let words = echotank_protocols::sigmf::Recording::parse(&meta).expect("SigMF");
    assert_eq!(
        (
            words.channels,
            words.captures.len(),
            words.annotations.len()
        ),
        (8, 2, 2)
    );
    let data = fs::metadata(out.path().join("board.sigmf-data")).expect("samples");
    let last = words.annotations.last().expect("two");
    assert_eq!(data.len(), (last.sample_start + last.sample_count) * 8 * 4);
    let wav = fs::read(out.path().join("board.wav")).expect("a WAV");
    let header = echotank_protocols::wav::WavHeader::parse(&wav).expect("a WAV");
    // 2.5 times 105 kHz, rounded up to the next usual rate.
    assert_eq!(
        (header.format.channels, header.format.sample_rate_hz),
        (8, 384_000)
    );
    // The second ping begins a quarter of a second after the first. It lasts 2 x 40 m / 1480 m/s plus a pulse.
    let lasts_s = header.sample_times() as f64 / 384e3;
    assert!(
        (lasts_s - (0.25 + 80.0 / 1480.0 + 2e-3)).abs() < 1e-3,
        "{lasts_s}"
    );
    let loudest = wav[header.data_at..]
        .chunks_exact(2)
        .map(|b| i16::from_le_bytes([b[0], b[1]]).unsigned_abs())
        .max();
    assert!(loudest.is_some_and(|counts| counts > 10), "{loudest:?}");
}
