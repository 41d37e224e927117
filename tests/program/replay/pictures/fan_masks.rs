//! Tests of the masks of a fan image against the geometry of the ping abeam of a box on a flat bottom.

use std::fs;
use std::path::Path;

use super::{Masks, RIG, near};
use crate::replay::{files, replay_file};

const ALTITUDE_M: f64 = 20.0;
const TOP_M: f64 = 18.0;
/// Easting of the near wall and of the far edge of the box, to starboard.
const EAST_M: (f64, f64) = (6.5, 9.5);
const RANGE_M: f64 = 45.0;
const BEAMS: usize = 81;
const STEP_DEG: f64 = 120.0 / (BEAMS - 1) as f64;
/// Beams are 1.6 degrees wide. The two-way -12 dB points are less than 2 degrees off their axes.
const LOBE_DEG: f64 = 2.0 + 0.5 * STEP_DEG;
/// Pixel size, metres: 480 pixels from the sonar to the end of the range.
const PIXEL_M: f64 = RANGE_M / 480.0;
/// Pixel row of the sonar.
const TOP_ROW: f64 = 10.0;

const FAN: &str = r#"
[[sonar.transmit]]
name = "tx"
pattern = "rectangle"
length_m = 0.34
width_m = 0.002
baffled = true

[[sonar.receive]]
name = "rx"
transmit = "tx"
elements = 64
spacing_m = 0.001875
yaw_deg = 90.0
element_pattern = "rectangle"
element_length_m = 0.0018
baffled = true
sensitivity_db = -190.0

[sonar.receiver]
sample_rate_khz = 24.0
rx_filter = "none"
tvg = "30logr"
tvg_max_db = 100.0

[sonar.ping]
range_m = 45.0
rate_hz = 2.0
source_level_db = 210.0

[sonar.model]
cull_db = -30.0

[sonar.beams.fan]
array = "rx"
beams = 81
sector_deg = 120.0
"#;

fn rig(folder: &Path) -> std::path::PathBuf {
    let plain = super::rig(folder);
    let solid = format!(
        "[[target]]\nname = \"the box\"\nshape = \"box\"\nnorth_m = 0.0\neast_m = {}\nsize_m = [4.0, {}, {}]\nlambert_db = -5.0\ndensity_per_m2 = 60.0\n",
        0.5 * (EAST_M.0 + EAST_M.1),
        EAST_M.1 - EAST_M.0,
        ALTITUDE_M - TOP_M
    );
    fs::write(folder.join("box.toml"), solid).expect("written");
    let head = RIG.split("[[sonar.transmit]]").next().expect("a head");
    fs::write(&plain, format!("{head}{FAN}")).expect("written");
    plain
}

#[test]
fn a_fan_s_masks_show_the_box_its_shadow_and_the_bottom_where_they_are() {
    let folder = tempfile::tempdir().expect("a folder");
    // Ping 13 is abeam.
    let out = replay_file(
        &["--formats", "fan,masks", "--pings", "13..13"],
        &rig(folder.path()),
    );
    let masks = Masks::open(out.path(), "fan_000013");
    assert_eq!(masks.json["target"]["names"]["1"], "the box");
    let half = masks.target.width as f64 / 2.0;
    let place = |x: usize, y: usize| {
        let across_m = (x as f64 + 0.5 - half) * PIXEL_M;
        let down_m = (y as f64 + 0.5 - TOP_ROW) * PIXEL_M;
        (across_m.hypot(down_m), across_m.atan2(down_m).to_degrees())
    };
    let pixel = |range_m: f64, angle_deg: f64| {
        let (sin, cos) = angle_deg.to_radians().sin_cos();
        let x = half + range_m * sin / PIXEL_M;
        let y = TOP_ROW + range_m * cos / PIXEL_M;
        (x as usize, y as usize)
    };
    let at = |east_m: f64, down_m: f64| {
        let angle_deg = east_m.atan2(down_m).to_degrees();
        (east_m.hypot(down_m), angle_deg)
    };
    // The wall from its edge to its foot and the roof are visible. The shadow ends where the ray over the far edge reaches the
    // bottom.
    let (nearest, farthest) = (at(EAST_M.0, TOP_M), at(EAST_M.0, ALTITUDE_M));
    let (inner_deg, outer_deg) = (farthest.1, at(EAST_M.1, TOP_M).1);
    let shadow_ends_m = EAST_M.1 * ALTITUDE_M / TOP_M;
    let (mut targets, mut shadows, mut depths) = (0, 0, 0);
    for y in 0..masks.target.height {
        for x in 0..masks.target.width {
            let (range_m, angle_deg) = place(x, y);
            if masks.target.at(x, y) == 1 {
                targets += 1;
                let inside = (nearest.0 - 0.2..farthest.0 + 0.2).contains(&range_m)
                    && (inner_deg - LOBE_DEG..outer_deg + LOBE_DEG).contains(&angle_deg);
                assert!(inside, "target at {range_m:.2} m, {angle_deg:.1} degrees");
            }
            let Some(depth_m) = masks.depth_m(x, y) else {
                assert_eq!(masks.shadow.at(x, y), 0, "no shadow without ground");
                continue;
            };
            depths += 1;
            near("depth", depth_m, ALTITUDE_M, 0.01);
            // The seabed of a beam is at the range of its pixel, in the part closest to its axis.
            let ground_deg = (ALTITUDE_M / range_m).min(1.0).acos().to_degrees();
            let off_deg = (angle_deg.abs() - ground_deg).abs();
            let pixel_deg = (PIXEL_M / range_m).to_degrees();
            // Near nadir, half a pixel of range is a large angle.
            let range_deg = (2.0 * PIXEL_M / ALTITUDE_M).sqrt().to_degrees();
            assert!(
                off_deg < STEP_DEG + pixel_deg + if ground_deg < 10.0 { range_deg } else { 0.3 },
                "ground at {range_m:.2} m, {angle_deg:.1} degrees"
            );
            if masks.shadow.at(x, y) > 0 {
                shadows += 1;
                let east_m = (range_m * range_m - ALTITUDE_M * ALTITUDE_M)
                    .max(0.0)
                    .sqrt();
                let inside = (EAST_M.0 - 0.3..shadow_ends_m + 0.3).contains(&east_m);
                assert!(inside && angle_deg > 0.0, "shadow at {east_m:.2} m");
            }
        }
    }
    println!("{targets} pixels of the box, {shadows} of shadow, {depths} of the bottom");
    // The comparison allows one pixel, the resolution of samples, pixels and scatterers.
    let around = |(range_m, angle_deg): (f64, f64), what: &dyn Fn(usize, usize) -> bool| {
        let (x, y) = pixel(range_m, angle_deg);
        (x - 1..=x + 1).any(|x| (y - 1..=y + 1).any(|y| what(x, y)))
    };
    for (what, (east_m, down_m)) in [
        ("near edge", (EAST_M.0 + 0.1, TOP_M)),
        ("roof", (8.0, TOP_M)),
        ("far edge", (EAST_M.1 - 0.1, TOP_M)),
        ("wall", (EAST_M.0, 19.0)),
    ] {
        assert!(
            around(at(east_m, down_m), &|x, y| masks.target.at(x, y) == 1),
            "{what}"
        );
    }
    let behind_m = 0.5 * (EAST_M.1 + shadow_ends_m);
    assert!(
        around(at(behind_m, ALTITUDE_M), &|x, y| masks.shadow.at(x, y)
            == 255),
        "behind the box"
    );
    for angle_deg in [-55.0_f64, -40.0, -25.0, -10.0, 10.0, 40.0, 55.0] {
        let range_m = ALTITUDE_M / angle_deg.to_radians().cos();
        assert!(
            around((range_m, angle_deg), &|x, y| masks.depth_m(x, y).is_some()),
            "bottom at {angle_deg}"
        );
    }
    // The strongest beam at each range over all pings is that of the box, between edge and foot of the wall.
    let stack = Masks::open(out.path(), "water_column");
    let rows =
        (0..stack.target.height).filter(|y| stack.target.at(stack.target.width - 1, *y) == 1);
    let rows: Vec<f64> = rows.map(|y| (y as f64 + 0.5) * PIXEL_M).collect();
    assert!(!rows.is_empty());
    for range_m in rows {
        assert!(
            (nearest.0 - 0.2..farthest.0 + 0.2).contains(&range_m),
            "{range_m}"
        );
    }
    assert!(files(out.path()).contains_key("fan_masks.npz"));
}
