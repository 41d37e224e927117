//! Tests of masks, ground range, fans and mosaics of a replay against independent geometry. The scene has a box on a flat bottom,
//! and a level sonar on a straight track.

use std::fs;
use std::path::Path;

use echotank_testing::track::COLUMNS;
use serde_json::Value;

use super::{files, replay_file};
use crate::run;

// The long form uses the rest of the module.
mod fan_masks;

/// Altitude of the sonar over a flat bottom, on a track due north. The box is 2 m wide across, 4 m along and 2 m high, with its
/// middle 30 m to starboard.
const ALTITUDE_M: f64 = 20.0;
const BOX_EAST_M: f64 = 30.0;
const BOX_HALF_ACROSS_M: f64 = 1.0;
const BOX_HALF_ALONG_M: f64 = 2.0;
const BOX_HEIGHT_M: f64 = 2.0;
const RANGE_M: f64 = 60.0;
const SPEED_M_PER_S: f64 = 2.0;
const RATE_HZ: f64 = 2.0;
/// One-way -3 dB beam width, radians: 0.886 lambda / L.
const BEAM_RAD: f64 = 0.886 * 0.00375 / 0.34;

const RIG: &str = r#"
[medium]
sound_speed_m_per_s = 1500.0
absorption = { db_per_km = 50.0 }

[nav]
origin = { latitude_deg = 54.5, longitude_deg = 10.2 }
mode = "settle"
vertical = "depth"

[[nav.source]]
name = "track"
kind = "csv"
path = "track.csv"
provides = ["position", "heading", "roll-pitch"]

[scene]
seed = 5
targets = "box.toml"
occlusion = "horizon"

[scene.seabed]
shape = "plane"
depth_m = 20.0
density_per_m2 = 6.0
lambert_db = -25.0

[[sonar]]
name = "side"

[sonar.pulse]
kind = "lfm"
center_frequency_khz = 400.0
bandwidth_khz = 8.0
duration_ms = 1.0
taper = 0.1

[[sonar.transmit]]
name = "tx"
roll_deg = -60.0
pattern = "rectangle"
length_m = 0.34
baffled = true

[[sonar.receive]]
name = "starboard"
transmit = "tx"
elements = 1
spacing_m = 0.34
roll_deg = -60.0
element_pattern = "rectangle"
element_length_m = 0.34
baffled = true
sensitivity_db = -190.0

[sonar.receiver]
sample_rate_khz = 24.0
rx_filter = "none"
noise_db = "none"
tvg = "30logr"
tvg_max_db = 100.0

[sonar.ping]
range_m = 60.0
rate_hz = 2.0
source_level_db = 210.0

[sonar.model]
path = "polyline"
doppler = "stretch"
synthesis = "direct"
error_check = false
cull_db = -30.0

[sonar.beams]
starboard = "starboard"

[sonar.picture]
m_per_pixel = 0.1
mosaic_m_per_pixel = 0.25
"#;

fn rig(folder: &Path) -> std::path::PathBuf {
    let mut track = COLUMNS.to_owned();
    for k in 0..13 {
        let north_m = f64::from(k - 6) * SPEED_M_PER_S;
        track += &format!("{},{north_m},0,0,0,0,0\n", 1_793_611_200 + k);
    }
    fs::write(folder.join("track.csv"), track).expect("written");
    let solid = format!(
        "[[target]]\nname = \"the box\"\nshape = \"box\"\nnorth_m = 0.0\neast_m = {BOX_EAST_M}\nsize_m = [{}, {}, {BOX_HEIGHT_M}]\nlambert_db = -5.0\ndensity_per_m2 = 60.0\n",
        2.0 * BOX_HALF_ALONG_M,
        2.0 * BOX_HALF_ACROSS_M
    );
    fs::write(folder.join("box.toml"), solid).expect("written");
    let rig = folder.join("rig.toml");
    fs::write(&rig, RIG).expect("written");
    rig
}

/// Grey picture with 8 or 16 bits.
struct Grey {
    width: usize,
    height: usize,
    values: Vec<u16>,
}

impl Grey {
    fn open(path: &Path) -> Self {
        let file = std::io::BufReader::new(fs::File::open(path).expect("picture"));
        let mut reader = png::Decoder::new(file).read_info().expect("png");
        let mut bytes = vec![0; reader.output_buffer_size().expect("size")];
        let info = reader.next_frame(&mut bytes).expect("pixels");
        let values = match info.bit_depth {
            png::BitDepth::Sixteen => bytes
                .chunks(2)
                .map(|b| u16::from_be_bytes([b[0], b[1]]))
                .collect(),
            _ => bytes.iter().map(|b| u16::from(*b)).collect(),
        };
        Self {
            width: info.width as usize,
            height: info.height as usize,
            values,
        }
    }
    fn at(&self, x: usize, y: usize) -> u16 {
        self.values[y * self.width + x]
    }
}

struct Masks {
    target: Grey,
    shadow: Grey,
    depth: Grey,
    json: Value,
}

impl Masks {
    fn open(folder: &Path, stem: &str) -> Self {
        let grey = |what: &str| Grey::open(&folder.join(format!("{stem}_{what}.png")));
        let text = fs::read_to_string(folder.join(format!("{stem}_masks.json"))).expect("json");
        Self {
            target: grey("target"),
            shadow: grey("shadow"),
            depth: grey("depth"),
            json: serde_json::from_str(&text).expect("json"),
        }
    }
    fn depth_m(&self, x: usize, y: usize) -> Option<f64> {
        let scale = |key: &str| self.json["depth"][key].as_f64().expect("a number");
        match self.depth.at(x, y) {
            0 => None,
            count => Some(scale("count_0_m") + f64::from(count) * scale("metres_per_count")),
        }
    }
}

/// First and last non-empty column of a row, metres from the middle of the image.
fn span_m(picture: &Grey, y: usize, metres_per_pixel: f64) -> Option<(f64, f64)> {
    let half = picture.width / 2;
    let lit: Vec<usize> = (half..picture.width)
        .filter(|&x| picture.at(x, y) > 0)
        .map(|x| x - half)
        .collect();
    let (first, last) = (*lit.first()?, *lit.last()?);
    Some((
        first as f64 * metres_per_pixel,
        (last + 1) as f64 * metres_per_pixel,
    ))
}

fn near(what: &str, got: f64, want: f64, within: f64) {
    assert!(
        (got - want).abs() <= within,
        "{what}: {got:.3} m, want {want:.3} within {within}"
    );
}

/// Extent of the box in the ping abeam of it, in slant or ground range.
fn holds_the_box(masks: &Masks, abeam: usize, across: impl Fn(f64) -> f64, water_ends_m: f64) {
    const PIXEL_M: f64 = 0.1;
    // A sample is 3 cm, a resolution cell is 9 cm, and an echo fills its whole pixel.
    const WITHIN_M: f64 = 0.2;
    let top_m = ALTITUDE_M - BOX_HEIGHT_M;
    let (wall_m, back_m) = (
        BOX_EAST_M - BOX_HALF_ACROSS_M,
        BOX_EAST_M + BOX_HALF_ACROSS_M,
    );
    let rows_per_ping = masks.target.height / pings();
    let y = abeam * rows_per_ping;
    let (from, to) = span_m(&masks.target, y, PIXEL_M).expect("the box in its ping");
    // The wall from its upper edge to its foot, then the roof to its far edge.
    near(
        "first of the box",
        from,
        across(wall_m.hypot(top_m)),
        WITHIN_M,
    );
    near("last of the box", to, across(back_m.hypot(top_m)), WITHIN_M);
    // The ray over the far upper edge reaches the bottom h/(H-h) x behind the wall.
    let length_m = BOX_HEIGHT_M / top_m * back_m;
    let end_m = (back_m + length_m).hypot(ALTITUDE_M);
    let (from, to) = span_m(&masks.shadow, y, PIXEL_M).expect("its shadow");
    near("shadow begins", from, across(back_m.hypot(top_m)), WITHIN_M);
    near("shadow ends", to, across(end_m), WITHIN_M);
    println!(
        "box {:.2} to {:.2} m, shadow {from:.2} to {to:.2} m",
        across(wall_m.hypot(top_m)),
        across(back_m.hypot(top_m))
    );
    // The bottom is 20 m deep everywhere. The water column is empty, and port has no line.
    let half = masks.depth.width / 2;
    for x in 0..masks.depth.width {
        let depth_m = masks.depth_m(x, y);
        let at_m = (x as f64 + 0.5 - half as f64) * PIXEL_M;
        if at_m < water_ends_m - 0.1 {
            assert_eq!(depth_m, None, "at {at_m}");
        } else if at_m > water_ends_m + 0.1 && at_m < across(RANGE_M) - 0.3 {
            near("depth", depth_m.expect("a bottom"), ALTITUDE_M, 0.002);
        }
    }
    // Along the track the box appears only while a footprint reaches it.
    let step_m = SPEED_M_PER_S / RATE_HZ;
    let slant_m = wall_m.hypot(ALTITUDE_M);
    for ping in 0..pings() {
        let off_m = (ping as f64 - abeam as f64).abs() * step_m;
        let shown = span_m(&masks.target, ping * rows_per_ping, PIXEL_M).is_some();
        if off_m < BOX_HALF_ALONG_M - 0.1 {
            assert!(shown, "{off_m} m along");
        }
        // The two-way -12 dB width is 1.3 of the half-power half width.
        if off_m > BOX_HALF_ALONG_M + BEAM_RAD * slant_m {
            assert!(!shown, "{off_m} m along");
        }
    }
}

/// Number of pings of the replay. The ping abeam of the box is counted from the newest ping.
fn pings() -> usize {
    21
}
const PINGS: &str = "2..22";

#[test]
fn masks_agree_with_the_geometry_of_a_box_and_its_shadow_in_slant_and_ground_range() {
    let folder = tempfile::tempdir().expect("a folder");
    let rig = rig(folder.path());
    // Ping 1 is at -12 m and ping 13 is abeam: the tenth of 2..22 from the newest.
    let abeam = 9;
    let arguments = ["--formats", "png,masks,mosaic", "--pings", PINGS];
    let out = replay_file(&arguments, &rig);
    let masks = Masks::open(out.path(), "waterfall");
    assert_eq!(masks.json["target"]["names"]["1"], "the box");
    assert_eq!(masks.target.width, 2 * (RANGE_M / 0.1) as usize);
    holds_the_box(&masks, abeam, |slant_m| slant_m, ALTITUDE_M);
    let names = files(out.path());
    assert!(names.contains_key("masks.npz") && names.contains_key("mosaic.tif"));

    // The mosaic has as many pixels as the image of the box covers, in the north-east of the map.
    let map = Masks::open(out.path(), "mosaic");
    let boxed: Vec<(usize, usize)> = (0..map.target.values.len())
        .filter(|&p| map.target.values[p] == 1)
        .map(|p| (p % map.target.width, p / map.target.width))
        .collect();
    let across = |slant_m: f64| (slant_m * slant_m - ALTITUDE_M * ALTITUDE_M).sqrt();
    let top_m = ALTITUDE_M - BOX_HEIGHT_M;
    let imaged_m =
        across((BOX_EAST_M + 1.0).hypot(top_m)) - across((BOX_EAST_M - 1.0).hypot(top_m));
    let wide = boxed.iter().map(|p| p.0).max().expect("pixels")
        - boxed.iter().map(|p| p.0).min().expect("pixels")
        + 1;
    // The map is rotated by the convergence of the grid, and a pixel is 0.25 m.
    near("width in the map", wide as f64 * 0.25, imaged_m, 0.75);

    for range in ["ground", "ground-first-return"] {
        let set = format!("sonar.picture.range={range}");
        let arguments = ["--formats", "png,masks", "--pings", PINGS, "--set", &set];
        let out = replay_file(&arguments, &rig);
        let masks = Masks::open(out.path(), "waterfall");
        if range == "ground" {
            holds_the_box(&masks, abeam, across, 0.0);
        } else {
            // The first return of this side-looking sonar is within a metre of the altitude.
            let y = abeam * masks.target.height / pings();
            let (from, to) = span_m(&masks.target, y, 0.1).expect("the box");
            let top = |east_m: f64| across(east_m.hypot(top_m));
            near("first of the box", from, top(BOX_EAST_M - 1.0), 1.0);
            near("last of the box", to, top(BOX_EAST_M + 1.0), 1.0);
        }
    }
}

#[test]
fn look_of_a_picture_is_chosen_in_the_configuration_and_raw_is_darker_far_away() {
    let folder = tempfile::tempdir().expect("a folder");
    let rig = rig(folder.path());
    let picture = |set: &[&str]| {
        let mut arguments = vec!["--formats", "png", "--pings", "12..14"];
        for one in set {
            arguments.extend(["--set", one]);
        }
        let out = replay_file(&arguments, &rig);
        super::Picture::open(&out.path().join("waterfall.png"))
    };
    let contrast = [
        "sonar.picture.contrast=fixed",
        "sonar.picture.low_db=-140",
        "sonar.picture.high_db=0",
    ];
    let grey = [contrast.as_slice(), &["sonar.picture.colours=grey"]].concat();
    let raw = [grey.as_slice(), &["sonar.picture.gain=raw"]].concat();
    let (plain, grey, raw) = (picture(&contrast), picture(&grey), picture(&raw));
    let y = plain.height() / 2;
    let pixel = |p: &super::Picture, x: usize| {
        let at = 3 * (y * p.width + x);
        [p.rgb[at], p.rgb[at + 1], p.rgb[at + 2]]
    };
    let far = plain.width - 30;
    let [r, g, b] = pixel(&grey, far);
    assert!(r == g && g == b && r > 0, "{r} {g} {b}");
    assert_ne!(pixel(&plain, far), pixel(&grey, far));
    // 30 log r + 2 alpha r at 57 m: 52.7 + 5.7 dB of the 140 that fill the grey.
    let level = |p: &super::Picture| {
        let near = (far - 20..far + 20).map(|x| f64::from(pixel(p, x)[0]));
        near.sum::<f64>() / 40.0
    };
    let fall_db = (level(&grey) - level(&raw)) / 255.0 * 140.0;
    near("gain taken out, dB", fall_db, 58.4, 1.0);
}

/// The command reads both outputs of the replay and shows the box at its position. Other files are refused.
#[test]
fn mosaic_of_a_recording_shows_the_box_at_its_place_from_s7k_and_npz() {
    use echotank_core::geodesy::LocalTangentPlane;
    use echotank_core::utm::UtmZone;
    let folder = tempfile::tempdir().expect("a folder");
    let rig = rig(folder.path());
    let out = replay_file(&["--formats", "s7k,npz", "--pings", PINGS], &rig);
    let plane = LocalTangentPlane::new(54.5f64.to_radians(), 10.2f64.to_radians());
    // The near edge of the roof, the brightest part of the box, at its flat-bottom position.
    let imaged_m = ((BOX_EAST_M - 1.0).powi(2) + 18.0f64.powi(2) - 400.0).sqrt();
    let (latitude, longitude) = plane.geodetic_rad(0.0, imaged_m + 0.5);
    let (east_m, north_m) = UtmZone::of(latitude, longitude).project_m(latitude, longitude);
    for name in ["side.s7k", "pings.npz"] {
        let tiff = out.path().join(format!("{name}.tif"));
        let done = mosaic(&[
            &out.path().join(name),
            Path::new("--out"),
            &tiff,
            Path::new("--pixel=0.5"),
        ]);
        assert!(done.0, "{name}: {}", done.1);
        assert!(tiff.with_extension("png").exists());
        let mut decoder =
            tiff::decoder::Decoder::new(fs::File::open(&tiff).expect("file")).expect("a TIFF");
        let tie = decoder
            .get_tag_f64_vec(tiff::tags::Tag::ModelTiepointTag)
            .expect("tie");
        let (width, _) = decoder.dimensions().expect("size");
        let tiff::decoder::DecodingResult::F32(db) = decoder.read_image().expect("pixels") else {
            panic!("32-bit floats");
        };
        // Mean power over the 4 m of the box along the track, at each easting.
        let x = ((east_m - tie[3]) / 0.5) as usize;
        let y = ((tie[4] - north_m) / 0.5) as usize;
        let column = |x: usize| {
            let rows = y - 3..=y + 3;
            rows.map(|y| 10f32.powf(db[y * width as usize + x] / 10.0))
                .filter(|p| p.is_finite())
                .sum::<f32>()
        };
        let brightest = (x - 8..=x + 8)
            .max_by(|a, b| column(*a).total_cmp(&column(*b)))
            .expect("columns");
        println!("{name}: brightest column {brightest}, want {x}");
        // Wall and roof fill 2 m (4 pixels), from half a metre before to one and a half metres behind.
        assert!(
            (x - 2..=x + 4).contains(&brightest),
            "{name}: {brightest}, want {x}"
        );
    }
    let junk = out.path().join("junk.s7k");
    fs::write(&junk, b"no recording").expect("written");
    let tiff = out.path().join("junk.tif");
    let (good, text) = mosaic(&[&junk, Path::new("--out"), &tiff]);
    assert!(!good && text.contains("holds no 7k record"), "{text}");
    let (good, text) = mosaic(&[&junk, Path::new("--out=x.gif"), Path::new("--pixel=0")]);
    assert!(
        !good && text.contains("--pixel 0: must be above 0") && text.contains(".tif"),
        "{text}"
    );
}

/// Both files have the lines of two pulses per ping and the position of the sonar at transmission. The command shows the lines of
/// either pulse.
#[test]
fn lines_and_mosaic_of_a_second_pulse_come_from_s7k_and_npz_alike() {
    use echotank_runtime::io::record::lines::read;
    const DELAY_S: f64 = 0.02;
    const PINGS: usize = 12;
    let rig = echotank_testing::repository().join("hil-configs/multipulse.toml");
    let arguments = [
        "--formats",
        "s7k,npz",
        "--pings",
        "1..12",
        "--set",
        "scene.seabed.density_per_m2=0.05",
        "--set",
        "sonar.receiver.full_scale_v=0.25",
        "--set",
        "sonar.ping.range_m=45",
        "--set",
        "sonar.more_pulse.0.delay_ms=20",
    ];
    let out = replay_file(&arguments, &rig);
    let files = ["sidescan.s7k", "pings.npz"].map(|name| out.path().join(name));
    let of = |pulse: u16| files.each_ref().map(|f| read(f, pulse).expect("lines"));
    let (first, second) = (of(1), of(2));
    // Correlation of two lines: 1 if they are equal except for scale.
    let alike = |a: &[f32], b: &[f32]| {
        let product = |a: &[f32], b: &[f32]| {
            let pairs = a.iter().zip(b);
            pairs
                .map(|(x, y)| f64::from(*x) * f64::from(*y))
                .sum::<f64>()
        };
        product(a, b) / (product(a, a) * product(b, b)).sqrt()
    };
    for pulse in [&first, &second] {
        let [wire, archive] = pulse;
        assert_eq!((wire.len(), archive.len()), (PINGS, PINGS));
        for (a, b) in wire.iter().zip(archive) {
            assert_eq!((a.ping_number, a.lines.len()), (b.ping_number, 1));
            let same = alike(&a.lines[0].amplitude, &b.lines[0].amplitude);
            assert!(same > 0.9999, "ping {}: {same}", a.ping_number);
            // 7KTIME has f32 seconds, 4 us.
            assert!(
                (a.utc_ns - b.utc_ns).abs() < 10_000,
                "{}",
                a.utc_ns - b.utc_ns
            );
        }
    }
    for (own, other) in first[1].iter().zip(&second[1]) {
        let late_s = (other.utc_ns - own.utc_ns) as f64 * 1e-9;
        assert!((late_s - DELAY_S).abs() < 1e-9, "{late_s}");
        let ahead_m = (other.arms_m[1] - own.arms_m[1]).length();
        let want_m = DELAY_S * 10.0 * 1852.0 / 3600.0;
        assert!((ahead_m - want_m).abs() < 1e-3, "{ahead_m}, want {want_m}");
        let same = alike(&own.lines[0].amplitude, &other.lines[0].amplitude);
        assert!(same < 0.9, "two pulses, not one: {same}");
    }
    for file in &files {
        let tiff = file.with_extension("tif");
        let altitude = Path::new("--altitude=20");
        let (good, text) = mosaic(&[
            file,
            Path::new("--out"),
            &tiff,
            altitude,
            Path::new("--pulse=2"),
            Path::new("--squint=-0.25"),
        ]);
        assert!(good && tiff.exists(), "{text}");
        let (good, text) = mosaic(&[file, Path::new("--out"), &tiff, Path::new("--pulse=3")]);
        assert!(
            !good && text.contains("pulse") && text.contains('3'),
            "{text}"
        );
    }
}

fn mosaic(arguments: &[&Path]) -> (bool, String) {
    let done = run("mosaic", arguments);
    (done.code == Some(0), done.err)
}
