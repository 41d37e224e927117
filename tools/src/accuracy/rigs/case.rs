//! Random rig for a seed: sonar, scene, motion and tolerance, as a configuration with its files.

use std::fmt::Write;
use std::path::Path;

use echotank_config::spec::RigSpec;

use crate::draw::SplitMix as Chance;
use echotank_testing::track::{ALONG_TRACK, rows};

/// Writes the rig of `seed` into `folder`, reads it, and describes it. `small` suits tests that run in seconds.
pub(crate) fn random(seed: u64, folder: &Path, small: bool) -> (RigSpec, String) {
    let mut chance = Chance::new(seed);
    let (text, about) = write(&mut chance, folder, small);
    let spec = echotank_runtime::config_files::parse(&text, folder)
        .unwrap_or_else(|why| panic!("seed {seed}: {why}\n{text}"));
    (spec, about)
}

fn write(chance: &mut Chance, folder: &Path, small: bool) -> (String, String) {
    let c = chance.between(1440.0, 1540.0);
    let carrier_khz = chance.decades(20.0, 460.0);
    let cw = chance.one_in(6);
    let duration_ms = chance.decades(0.3, if small { 2.0 } else { 6.0 });
    let bandwidth_khz = chance
        .decades(2.0, if small { 10.0 } else { 30.0 })
        .min(0.2 * carrier_khz);
    let taper = if chance.one_in(3) {
        0.0
    } else {
        chance.between(0.05, 0.6)
    };
    let filtered = !chance.one_in(4);
    // 1.25 (max(B, 4/T) + 2 f_d) at the maximum platform speed, plus a margin.
    let doppler_khz = 2.0 * 10.0 / c * (carrier_khz + 0.5 * bandwidth_khz);
    let band_khz = if cw { 0.0 } else { bandwidth_khz };
    let rate_khz =
        1.3 * (band_khz.max(4.0 / duration_ms) + 2.0 * doppler_khz) * chance.between(1.0, 1.4);
    let depth_m = chance.decades(4.0, 40.0);
    let range_m = (depth_m * chance.between(1.5, 4.0)).min(if small { 40.0 } else { 120.0 });
    let depth_m = depth_m.min(0.7 * range_m);
    let tolerance = chance.decades(1e-4, 5e-2);
    let wavelength_m = c / (carrier_khz * 1e3);
    let line = chance.one_in(3);
    let elements = match line {
        true => 16 << chance.of(if small { 1 } else { 2 }),
        false => 1 + chance.of(4),
    };
    // The array is across the track as in a fan sonar, or along it as in a side-scan sonar.
    let yaw_deg = if line && chance.one_in(2) { 90.0 } else { 0.0 };
    let roll_deg = if yaw_deg > 0.0 {
        0.0
    } else {
        -chance.between(20.0, 60.0)
    };
    let spacing_m = match line {
        true => 0.5 * wavelength_m,
        false => chance.between(0.03, 0.1),
    };
    let insonified_m = wavelength_m * chance.decades(5.0, 60.0);
    let omnidirectional = chance.one_in(5);
    let speed = match chance.of(4) {
        0 => chance.decades(1e-4, 0.1),
        1 => 0.0,
        _ => chance.between(0.2, 6.0),
    };
    let swell = !chance.one_in(3);
    let heave_m = if swell { chance.between(0.0, 0.8) } else { 0.0 };
    let roll = if swell { chance.between(0.0, 8.0) } else { 0.0 };
    let yaw_rate = if swell {
        chance.between(-3.0, 3.0)
    } else {
        0.0
    };
    let period_s = chance.between(4.0, 10.0);
    let phase = chance.between(0.0, std::f64::consts::TAU);
    let track = rows(400, 0.05, |t_s| {
        let wave = |shift: f64| (std::f64::consts::TAU * t_s / period_s + phase + shift).sin();
        [
            0.1 * speed * t_s,
            speed * t_s,
            1.5 + heave_m * wave(0.0),
            roll * wave(1.0),
            0.4 * roll * wave(2.0),
            (90.0 + yaw_rate * t_s).rem_euclid(360.0),
        ]
    });
    std::fs::write(folder.join("track.csv"), track).expect("the folder takes files");
    let most = if small { 800.0 } else { 20_000.0 };
    let wanted = chance.decades(0.1 * most, most);
    let points = chance.one_in(3);
    let scene = match points {
        true => {
            let count = (0.1 * wanted) as usize + 10;
            scatter(folder, chance, count, depth_m, range_m);
            "points = \"points.csv\"\n".to_owned()
        }
        false => {
            let ground_m = (range_m * range_m - depth_m * depth_m).sqrt();
            let density = wanted / (std::f64::consts::PI * ground_m * ground_m);
            format!(
                "[scene.seabed]\nshape = \"plane\"\ndepth_m = {depth_m:.3}\ndensity_per_m2 = {density:.5}\nlambert_db = -27.0\n"
            )
        }
    };
    let pattern = match omnidirectional {
        true => String::new(),
        false => format!(
            "pattern = \"rectangle\"\nlength_m = {insonified_m:.5}\nwidth_m = {:.5}\n",
            wavelength_m * chance.between(1.0, 4.0)
        ),
    };
    let mut text = String::new();
    let _ = write!(
        text,
        r#"[medium]
sound_speed_m_per_s = {c:.2}
absorption = "none"
{ALONG_TRACK}[scene]
seed = 7
{scene}
[run]
threads = 0
latency_ms = 600.0
[[sonar]]
name = "any"
[sonar.pulse]
kind = "{kind}"
{sweep}
center_frequency_khz = {carrier_khz:.3}
duration_ms = {duration_ms:.4}
taper = {taper:.3}
[[sonar.transmit]]
name = "tx"
position_m = [1.0, 0.0, 0.5]
roll_deg = {roll_deg:.2}
{pattern}
[[sonar.receive]]
name = "rx"
transmit = "tx"
elements = {elements}
spacing_m = {spacing_m:.6}
position_m = [0.5, 0.2, 0.5]
roll_deg = {roll_deg:.2}
yaw_deg = {yaw_deg:.1}
element_pattern = "omnidirectional"
sensitivity_db = -190.0
[sonar.receiver]
sample_rate_khz = {rate_khz:.3}
rx_filter = "{filter}"
noise_db = "none"
tvg = "none"
full_scale_v = 5.0
[sonar.ping]
range_m = {range_m:.3}
rate_hz = 2.0
source_level_db = 210.0
gain_db = 0.0
[sonar.limits]
range_m = [1.0, {range_m:.3}]
ping_rate_hz = [0.1, 20.0]
source_level_db = [170.0, 220.0]
gain_db = [-30.0, 40.0]
pulse_duration_ms = [{duration_ms:.4}, {duration_ms:.4}]
[sonar.model]
path = "auto"
doppler = "auto"
synthesis = "auto"
tolerance = {tolerance:.3e}
error_check = false
"#,
        kind = if cw { "cw" } else { "lfm" },
        sweep = match cw {
            true => String::new(),
            false => format!("sweep = \"up\"\nbandwidth_khz = {bandwidth_khz:.4}"),
        },
        filter = if filtered { "fir" } else { "none" },
    );
    let about = format!(
        "{carrier_khz:.0} kHz {}, {duration_ms:.2} ms, taper {taper:.2}, {}, {elements} elements{}, {range_m:.0} m over {depth_m:.0} m, {speed:.2e} m/s{}, {}",
        if cw {
            "CW".to_owned()
        } else {
            format!("{bandwidth_khz:.0} kHz LFM")
        },
        if filtered { "filter" } else { "no filter" },
        if yaw_deg > 0.0 { " across" } else { "" },
        if swell {
            format!(", heave {heave_m:.1} m, roll {roll:.0} deg")
        } else {
            String::new()
        },
        if points { "points" } else { "seabed" },
    );
    (text, about)
}

/// Points around the first position, within the range.
fn scatter(folder: &Path, chance: &mut Chance, count: usize, depth_m: f64, range_m: f64) {
    let mut text = String::from("north_m,east_m,down_m,amplitude\n");
    for _ in 0..count {
        let ground_m = range_m * chance.even().sqrt() * 0.95;
        let azimuth = chance.between(0.0, std::f64::consts::TAU);
        let _ = writeln!(
            text,
            "{:.3},{:.3},{:.3},{:.3}",
            ground_m * azimuth.cos(),
            ground_m * azimuth.sin(),
            depth_m * chance.between(0.6, 1.0),
            chance.decades(0.1, 1.0)
        );
    }
    std::fs::write(folder.join("points.csv"), text).expect("the folder takes files");
}
