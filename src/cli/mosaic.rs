//! `echotank mosaic`: writes the side-scan lines of a recording as a georeferenced image.

use std::path::PathBuf;

use clap::Args;
use glam::DVec3;

use super::{Failure, choice};
use echotank_config::spec::{ColourMap, Contrast, Overlap};
use echotank_core::geodesy::LocalTangentPlane;
use echotank_imaging::image::line::first_return_m;
use echotank_imaging::image::mosaic::{MosaicBuilder, MosaicSpec, SonarPose};
use echotank_runtime::io::record::lines::{self, RecordedPing};
use echotank_runtime::io::record::picture::write_mosaic;

/// Number of pings to each side over which the median first return gives the altitude. The median rejects echoes of single fish.
const NEIGHBOURS: usize = 7;

#[derive(Args, Clone, Debug)]
pub(crate) struct MosaicArgs {
    /// Recording of `echotank replay` or `run`: .s7k or pings.npz
    pub(crate) recording: PathBuf,
    /// GeoTIFF to write (dB, 32-bit floats, UTM on WGS84); a PNG of the same name is written beside it
    #[arg(long, value_name = "FILE.tif")]
    pub(crate) out: PathBuf,
    /// Pulse to show, if a ping has several: 1 is the sonar's own, 2 that of the first [[sonar.more_pulse]]
    #[arg(long, value_name = "NUMBER", default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..=64))]
    pub(crate) pulse: u16,
    /// Squint of the beams ahead of broadside; negative is astern. Recordings do not hold the transmitter's squint
    #[arg(
        long,
        value_name = "DEGREES",
        default_value_t = 0.0,
        allow_negative_numbers = true
    )]
    pub(crate) squint: f64,
    /// Side of a pixel
    #[arg(long, value_name = "METRES", default_value_t = 0.25)]
    pub(crate) pixel: f64,
    /// Ground range to each side [default: the longest recorded]
    #[arg(long, value_name = "METRES")]
    pub(crate) range: Option<f64>,
    /// Leave out directions closer to vertical than this
    #[arg(long, value_name = "DEGREES", default_value_t = 0.0)]
    pub(crate) nadir: f64,
    /// Distance of the sonar behind the recorded position; negative is ahead. Not needed for .npz, which holds array positions
    #[arg(
        long,
        value_name = "METRES",
        default_value_t = 0.0,
        allow_negative_numbers = true
    )]
    pub(crate) layback: f64,
    /// Altitude above the bottom [default: from the first return of each line]
    #[arg(long, value_name = "METRES")]
    pub(crate) altitude: Option<f64>,
    /// How a pixel combines several passes
    #[arg(long, value_parser = choice::<Overlap>(), default_value = "nearest")]
    pub(crate) overlap: Overlap,
    /// Colours of the PNG
    #[arg(long, value_parser = choice::<ColourMap>(), default_value = "copper")]
    pub(crate) colours: ColourMap,
    /// Percentiles of the pixels shown darkest and brightest, e.g. 2,99.8
    #[arg(long, value_name = "LOW,HIGH", value_parser = percentiles, default_value = "2,99.8")]
    pub(crate) percentiles: (f64, f64),
}

fn percentiles(text: &str) -> Result<(f64, f64), String> {
    let (low, high) = text.split_once(',').ok_or("expected LOW,HIGH")?;
    let parse = |s: &str| s.trim().parse::<f64>().map_err(|e| format!("{s}: {e}"));
    let (low, high) = (parse(low)?, parse(high)?);
    match 0.0 <= low && low < high && high <= 100.0 {
        true => Ok((low, high)),
        false => Err("expected 0 <= LOW < HIGH <= 100".into()),
    }
}

/// Reports all arguments that are out of range.
fn refuse(args: &MosaicArgs) -> Result<(), Failure> {
    let positive = |x: f64| x > 0.0 && x.is_finite();
    let faults: Vec<String> = [
        (
            positive(args.pixel),
            format!("--pixel {}: must be above 0", args.pixel),
        ),
        (
            args.range.is_none_or(positive),
            format!("--range {}: must be above 0", args.range.unwrap_or(0.0)),
        ),
        (
            args.altitude.is_none_or(positive),
            format!(
                "--altitude {}: must be above 0",
                args.altitude.unwrap_or(0.0)
            ),
        ),
        (
            (0.0..89.0).contains(&args.nadir),
            format!("--nadir {}: must be from 0 to below 89", args.nadir),
        ),
        (
            args.squint.abs() < 90.0,
            format!("--squint {}: must be between -90 and 90", args.squint),
        ),
        (
            args.layback.is_finite(),
            format!("--layback {}: must be a number", args.layback),
        ),
        (
            args.out
                .extension()
                .is_some_and(|e| e == "tif" || e == "tiff"),
            format!("--out {}: must end in .tif or .tiff", args.out.display()),
        ),
    ]
    .into_iter()
    .filter_map(|(good, fault)| (!good).then_some(fault))
    .collect();
    match faults.is_empty() {
        true => Ok(()),
        false => Err(Failure::Configuration(faults.join("\n"))),
    }
}

pub(crate) fn main(args: &MosaicArgs) -> Result<(), Failure> {
    refuse(args)?;
    let pings = lines::read(&args.recording, args.pulse).map_err(Failure::running)?;
    let altitudes = match args.altitude {
        Some(altitude_m) => vec![altitude_m; pings.len()],
        None => first_returns(&pings).ok_or_else(|| {
            Failure::Running(format!(
                "{}: no side-scan line has a first return from the bottom; give --altitude",
                args.recording.display()
            ))
        })?,
    };
    let longest_m = pings
        .iter()
        .flat_map(|p| {
            p.lines
                .iter()
                .map(|l| p.axis.slant_range_m(l.amplitude.len()))
        })
        .fold(0.0, f64::max);
    let spec = MosaicSpec {
        metres_per_pixel: args.pixel,
        overlap: args.overlap,
        range_m: args.range.unwrap_or(longest_m),
        nadir_rad: args.nadir.to_radians(),
        layback_m: args.layback,
        ..MosaicSpec::default()
    };
    let mut builder = MosaicBuilder::new(spec);
    for (k, (ping, altitude_m)) in pings.iter().zip(&altitudes).enumerate() {
        let mut place = place(&pings, k, *altitude_m);
        place.drift += args.squint.to_radians().sin();
        builder.push(&place, ping.axis, &ping.lines);
    }
    let mosaic = builder
        .finish()
        .map_err(|e| Failure::Running(format!("{}: {e}", args.recording.display())))?;
    let (low, high) = args.percentiles;
    let contrast = Contrast::Percentiles {
        low: low / 100.0,
        high: high / 100.0,
    };
    let png = args.out.with_extension("png");
    let written =
        write_mosaic(&args.out, &png, &mosaic, args.colours, contrast).map_err(Failure::running)?;
    if !written {
        return Err(Failure::Running(format!(
            "{}: no samples beyond the nadir limit and the first return; the mosaic would be empty",
            args.recording.display()
        )));
    }
    println!(
        "{} pings, {} x {} pixels of {} m, EPSG:{}, north-west corner {:.2} E {:.2} N\nwrote {}\nwrote {}",
        pings.len(),
        mosaic.width,
        mosaic.height,
        mosaic.metres_per_pixel,
        mosaic.zone.epsg(),
        mosaic.west_m,
        mosaic.north_m,
        args.out.display(),
        png.display()
    );
    Ok(())
}

/// Altitude of each ping, metres: the median first return of the neighbouring pings, or the last known altitude if there is no return.
fn first_returns(pings: &[RecordedPing]) -> Option<Vec<f64>> {
    let each: Vec<Option<f64>> = pings
        .iter()
        .map(|p| first_return_m(&p.lines, p.axis))
        .collect();
    let mut last = *each.iter().flatten().next()?;
    let smooth = (0..each.len()).map(|k| {
        let near = &each[k.saturating_sub(NEIGHBOURS)..(k + NEIGHBOURS + 1).min(each.len())];
        let mut near: Vec<f64> = near.iter().flatten().copied().collect();
        near.sort_by(f64::total_cmp);
        if let Some(middle) = near.get(near.len() / 2) {
            last = *middle;
        }
        last
    });
    Some(smooth.collect())
}

/// Position, attitude and forward speed of the arrays at a ping.
fn place(pings: &[RecordedPing], k: usize, altitude_m: f64) -> SonarPose {
    let ping = &pings[k];
    let plane = LocalTangentPlane::new(ping.latitude_rad, ping.longitude_rad);
    let [port, starboard] = ping.arms_m;
    let middle = match ping.lines.as_slice() {
        [one] => ping.arms_m[usize::from(one.side == echotank_core::ping::Side::Starboard)],
        _ => 0.5 * (port + starboard),
    };
    let (latitude_rad, longitude_rad) = plane.geodetic_rad(middle.x, middle.y);
    let (sin, cos) = ping.heading_rad.sin_cos();
    let to_starboard = |arm: DVec3| (arm - middle).dot(DVec3::new(-sin, cos, 0.0));
    // Forward speed from the positions of the neighbouring pings.
    let (a, b) = (
        &pings[k.saturating_sub(1)],
        &pings[(k + 1).min(pings.len() - 1)],
    );
    let seconds = (b.utc_ns - a.utc_ns) as f64 * 1e-9;
    let (n0, e0) = plane.local_m(a.latitude_rad, a.longitude_rad);
    let (n1, e1) = plane.local_m(b.latitude_rad, b.longitude_rad);
    let ahead_m = (n1 - n0) * cos + (e1 - e0) * sin;
    let speed = match seconds > 0.0 {
        true => ahead_m / seconds,
        false => 0.0,
    };
    SonarPose {
        latitude_rad,
        longitude_rad,
        heading_rad: ping.heading_rad,
        altitude_m,
        pitch_rad: ping.pitch_rad,
        drift: speed / ping.sound_speed_m_per_s,
        starboard_m: [to_starboard(port), to_starboard(starboard)],
    }
}
