//! `echotank replay`: runs the pipeline offline and writes files.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use clap::{Args, ValueEnum};
use indicatif::{ProgressBar, ProgressStyle};

use super::{ConfigArgs, Failure, load};
use echotank_config::spec::RigSpec;
use echotank_runtime::io::signals;
use echotank_runtime::recorded::RecordedError;
use echotank_runtime::replay::{Formats, Replay, ReplayError, ReplayOptions, use_navigation};

#[derive(Args, Clone, Debug)]
pub(crate) struct ReplayArgs {
    #[command(flatten)]
    pub(crate) config: ConfigArgs,
    /// Navigation to use instead of the live sources and of the first source's file: a log, whose quantities are used, or what `run --record-nav`
    /// wrote, which repeats the pings of that run
    #[arg(long, value_name = "LOG")]
    pub(crate) nav: Option<PathBuf>,
    /// Folder for the results; created if absent
    #[arg(long, value_name = "DIR")]
    pub(crate) out: PathBuf,
    /// What to write, separated by commas; truth.jsonl is always written [default: s7k, and png for side-scan lines]
    #[arg(long, value_enum, value_delimiter = ',')]
    pub(crate) formats: Vec<Format>,
    /// Element samples in .npz and .zarr, and beams in .npz, as complex128 instead of complex64
    #[arg(long)]
    pub(crate) f64: bool,
    /// Only these pings, counted from 1, both ends included, e.g. 1..600
    #[arg(long, value_name = "A..B", value_parser = parse_range)]
    pub(crate) pings: Option<(u32, u32)>,
    /// Threads; 0 means one per core (default: the configuration's)
    #[arg(long)]
    pub(crate) threads: Option<usize>,
    /// Fail if a ping is predicted or measured above the tolerance
    #[arg(long)]
    pub(crate) strict: bool,
    /// Hide the progress bar
    #[arg(long)]
    pub(crate) quiet: bool,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum Format {
    /// Teledyne RESON 7k records, one file per sonar
    S7k,
    /// Element samples, beams and side-scan lines as NumPy arrays, one file per sonar
    Npz,
    /// The arrays of npz as a Zarr store (format 3) with a chunk for each ping, for xarray; with masks, their labels too
    Zarr,
    /// EdgeTech JSF, one file per sonar
    Jsf,
    /// Triton XTF, one file per sonar with side-scan lines
    Xtf,
    /// Side-scan waterfall, one image per sonar; styled by [sonar.picture] (e.g. --set sonar.picture.range=ground)
    Png,
    /// Synthetic-aperture image over all pings, for sonars with [sonar.beams.synthetic_aperture]
    Sas,
    /// The beam fan as polar images, and stacked along the track
    Fan,
    /// Georeferenced mosaic of the side-scan lines: GeoTIFF and PNG
    Mosaic,
    /// Label masks (target, shadow, depth) for each image, and for every line sample in masks.npz
    Masks,
    /// ROS 2 messages of elements, beams, side-scan lines, soundings and pose as MCAP, one file per sonar
    Mcap,
    /// Element samples as SigMF with an annotation per ping, two files per sonar
    Sigmf,
    /// Element signals at a converter's sample rate, one file per sonar
    Wav,
}

fn parse_range(text: &str) -> Result<(u32, u32), String> {
    let expected = "expected A..B, the first and the last ping, e.g. 1..600";
    let (a, b) = text.split_once("..").ok_or(expected)?;
    let parse = |s: &str| s.trim().parse::<u32>().map_err(|_| expected);
    let (a, b) = (parse(a)?, parse(b.trim_start_matches('='))?);
    if a == 0 || b < a {
        return Err("pings are numbered from 1, and B must not be below A".into());
    }
    Ok((a, b))
}

/// The requested formats, each of which must have data in this rig.
fn formats(asked: &[Format], spec: &RigSpec) -> Result<Formats, Failure> {
    let has_lines = spec.sonars.iter().any(|s| !s.beams.lines.is_empty());
    let asked = match (asked.is_empty(), has_lines) {
        (false, _) => asked,
        (true, true) => &[Format::S7k, Format::Png][..],
        (true, false) => &[Format::S7k],
    };
    let formats = Formats {
        s7k: asked.contains(&Format::S7k),
        jsf: asked.contains(&Format::Jsf),
        xtf: asked.contains(&Format::Xtf),
        npz: asked.contains(&Format::Npz),
        zarr: asked.contains(&Format::Zarr),
        png: asked.contains(&Format::Png),
        sas: asked.contains(&Format::Sas),
        fan: asked.contains(&Format::Fan),
        mosaic: asked.contains(&Format::Mosaic),
        masks: asked.contains(&Format::Masks),
        mcap: asked.contains(&Format::Mcap),
        sigmf: asked.contains(&Format::Sigmf),
        wav: asked.contains(&Format::Wav),
    };
    match formats.unfit(spec) {
        None => Ok(formats),
        Some((name, lacks)) => Err(Failure::Configuration(format!(
            "--formats {name}: would write nothing, because no sonar of this rig {lacks}"
        ))),
    }
}

pub(crate) fn main(args: &ReplayArgs) -> Result<(), Failure> {
    let mut spec = load(&args.config.config, &args.config.set)?;
    let formats = formats(&args.formats, &spec)?;
    if let Some(log) = &args.nav {
        use_navigation(&mut spec, log)
            .map_err(|why| Failure::Configuration(format!("--nav {}: {why}", log.display())))?;
    }
    if args.out.exists() && !args.out.is_dir() {
        return Err(Failure::Configuration(format!(
            "--out {}: is a file; name a folder",
            args.out.display()
        )));
    }
    let options = ReplayOptions {
        out: args.out.clone(),
        formats,
        f64: args.f64,
        pings: args.pings,
        threads: args.threads.unwrap_or(spec.run.threads),
    };
    let replay = Replay::open(spec, options).map_err(|error| refused_or_failed(&error))?;
    let expected = replay.pings_expected();
    let bar = match (args.quiet, expected) {
        (true, _) => ProgressBar::hidden(),
        (false, Some(pings)) => ProgressBar::new(pings),
        (false, None) => ProgressBar::new_spinner(),
    };
    bar.set_style(
        ProgressStyle::with_template("{bar:40} {pos}/{len} pings, {per_sec}, {eta} left {msg}")
            .unwrap_or_else(|_| ProgressStyle::default_bar()),
    );
    let stop = Arc::new(AtomicBool::new(false));
    signals::stop_on_signals(&stop).map_err(Failure::running)?;
    let summary = replay
        .run_until(&stop, |_| bar.inc(1))
        .map_err(|error| refused_or_failed(&error))?;
    let is_part = expected.is_none_or(|expected| bar.position() < expected);
    bar.finish_and_clear();
    println!("{summary}");
    if stop.load(Ordering::Acquire) && is_part {
        let of = expected.map_or(String::new(), |expected| format!(" of {expected}"));
        return Err(Failure::Running(format!(
            "stopped by a signal after {}{of} pings; the files above are complete and hold these pings",
            summary.pings
        )));
    }
    match summary.above_tolerance {
        n if args.strict && n > 0 => Err(Failure::Running(format!(
            "--strict: {n} of {} pings are predicted or measured above sonar.model.tolerance; `methods` and `error_check` of truth.jsonl name them",
            summary.pings
        ))),
        _ => Ok(()),
    }
}

fn refused_or_failed(error: &ReplayError) -> Failure {
    match error {
        ReplayError::Recorded(RecordedError::Rig(error)) => Failure::opening(error),
        ReplayError::Recorded(_)
        | ReplayError::Beams { .. }
        | ReplayError::PastEnd { .. }
        | ReplayError::NoPing(_) => Failure::Configuration(error.to_string()),
        ReplayError::Record(_) | ReplayError::Threads(_) => Failure::running(error),
    }
}
