//! `echotank replay`: runs the pipeline offline and writes files.

use std::path::PathBuf;

use clap::{Args, ValueEnum};
use indicatif::{ProgressBar, ProgressStyle};

use super::{ConfigArgs, Failure, load};
use echotank_config::spec::{NavChannel, NavInputSpec, RigSpec, SonarSpec};
use echotank_runtime::recorded::RecordedError;
use echotank_runtime::replay::{Formats, Replay, ReplayError, ReplayOptions};

#[derive(Args, Clone, Debug)]
pub(crate) struct ReplayArgs {
    #[command(flatten)]
    pub(crate) config: ConfigArgs,
    /// Recorded navigation to use instead of the first source's file; the quantities that it holds are used
    #[arg(long, value_name = "LOG")]
    pub(crate) nav: Option<PathBuf>,
    /// Folder for the results; created if absent
    #[arg(long, value_name = "DIR")]
    pub(crate) out: PathBuf,
    /// What to write, separated by commas; truth.jsonl is always written
    #[arg(long, value_enum, value_delimiter = ',', default_value = "s7k,png")]
    pub(crate) formats: Vec<Format>,
    /// Element samples and beams in .npz as complex128 instead of complex64
    #[arg(long)]
    pub(crate) f64: bool,
    /// Only these pings, counted from 1, both ends included, e.g. 1..600
    #[arg(long, value_name = "A..B", value_parser = parse_range)]
    pub(crate) pings: Option<(u32, u32)>,
    /// Threads; 0 means one per core (default: the configuration's)
    #[arg(long)]
    pub(crate) threads: Option<usize>,
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
    /// Element samples as SigMF with an annotation per ping, two files per sonar
    Sigmf,
    /// Element signals at a converter's sample rate, one file per sonar
    Wav,
}

fn parse_range(text: &str) -> Result<(u32, u32), String> {
    let (a, b) = text.split_once("..").ok_or("expected A..B")?;
    let parse = |s: &str| s.trim().parse::<u32>().map_err(|e| format!("{s}: {e}"));
    let (a, b) = (parse(a)?, parse(b.trim_start_matches('='))?);
    if a == 0 || b < a {
        return Err("pings are numbered from 1, and B must not be below A".into());
    }
    Ok((a, b))
}

/// Replaces the file of the first recorded navigation source. The source then provides all quantities of the new log.
fn replace_log(spec: &mut RigSpec, log: &std::path::Path) -> Result<(), Failure> {
    for source in &mut spec.nav.sources {
        if let NavInputSpec::Log { path, .. } | NavInputSpec::Csv { path } = &mut source.input {
            *path = log.to_path_buf();
            if let NavInputSpec::Log { .. } = source.input {
                source.provides = NavChannel::ALL.to_vec();
                source.detect = true;
            }
            return Ok(());
        }
    }
    Err(Failure::Configuration(
        "--nav: the configuration has no recorded source (kind = \"log\" or \"csv\") to replace"
            .into(),
    ))
}

pub(crate) fn main(args: &ReplayArgs) -> Result<(), Failure> {
    let mut spec = load(&args.config.config, &args.config.set)?;
    if let Some(log) = &args.nav {
        replace_log(&mut spec, log)?;
    }
    let formats = Formats {
        s7k: args.formats.contains(&Format::S7k),
        jsf: args.formats.contains(&Format::Jsf),
        xtf: args.formats.contains(&Format::Xtf),
        npz: args.formats.contains(&Format::Npz),
        png: args.formats.contains(&Format::Png),
        sas: args.formats.contains(&Format::Sas),
        fan: args.formats.contains(&Format::Fan),
        mosaic: args.formats.contains(&Format::Mosaic),
        masks: args.formats.contains(&Format::Masks),
        sigmf: args.formats.contains(&Format::Sigmf),
        wav: args.formats.contains(&Format::Wav),
    };
    let has_patch = |sonar: &SonarSpec| sonar.beams.synthetic_aperture.is_some();
    if formats.sas && !spec.sonars.iter().any(has_patch) {
        return Err(Failure::Configuration(
            "--formats sas: no sonar of the configuration has [sonar.beams.synthetic_aperture]"
                .into(),
        ));
    }
    let options = ReplayOptions {
        out: args.out.clone(),
        formats,
        f64: args.f64,
        pings: args.pings,
        threads: args.threads.unwrap_or(spec.run.threads),
    };
    let replay = Replay::open(spec, options).map_err(|error| match &error {
        ReplayError::Recorded(RecordedError::Rig(error)) => Failure::opening(error),
        _ => Failure::running(error),
    })?;
    let bar = match (args.quiet, replay.pings_expected()) {
        (true, _) => ProgressBar::hidden(),
        (false, Some(pings)) => ProgressBar::new(pings),
        (false, None) => ProgressBar::new_spinner(),
    };
    bar.set_style(
        ProgressStyle::with_template("{bar:40} {pos}/{len} pings, {per_sec}, {eta} left {msg}")
            .unwrap_or_else(|_| ProgressStyle::default_bar()),
    );
    let summary = replay.run(|_| bar.inc(1)).map_err(Failure::running)?;
    bar.finish_and_clear();
    println!("{summary}");
    Ok(())
}
