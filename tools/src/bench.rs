//! Measures the echo engine: errors and run times, one line each. See `tools/bench --help`.

mod beams;
mod forward_looking;
mod nav;
mod ping;
mod rates;
pub(crate) mod scene;
mod stages;
mod transform;
mod whole;
mod wire;

use std::path::PathBuf;

use clap::{Args, Subcommand};

use crate::report::{Common, Report};

#[derive(Args)]
#[command(about = "Measure errors and run times of the emulator's parts")]
pub(crate) struct Arguments {
    #[command(subcommand)]
    what: BenchCommand,
}

#[derive(Subcommand)]
enum BenchCommand {
    /// Synthesis methods: whole pings, a forward-looking ping.
    Echo(whole::Selection),
    /// Fans of 128 elements, 256 beams and 8000 samples with every beamformer.
    Beams {
        #[command(flatten)]
        common: Common,
    },
    /// Pings of a configuration through the whole pipeline, including beams and side-scan lines.
    Ping {
        #[command(flatten)]
        common: Common,
        #[arg(long, default_value = "hil-configs/quickstart.toml")]
        config: PathBuf,
    },
    /// The rigs of tools/rates.toml at the rates of their devices: milliseconds by stage, headroom, cost estimate, errors of sampled windows.
    Rates(rates::Selection),
    /// Navigation sentences per second, compared with the nmea crate and, with --python, pynmea2 on the same lines.
    Nav {
        #[command(flatten)]
        common: Common,
        /// A text log; its sentences are repeated.
        #[arg(long, default_value = "tests/data/nav/seapath330_90s.rvdas")]
        log: PathBuf,
        /// A Python interpreter with pynmea2.
        #[arg(long)]
        python: Option<PathBuf>,
    },
    /// Records per second of each protocol family.
    Wire {
        #[command(flatten)]
        common: Common,
    },
    /// Write points and their direct sum for `transform-serve` and for peers.
    TransformDump {
        directory: PathBuf,
        #[arg(long, default_value_t = 1_000_000)]
        scatterers: usize,
        /// Number of elements of the line.
        #[arg(long, default_value_t = 1)]
        elements: usize,
        /// Index of the element.
        #[arg(long, default_value_t = 0)]
        element: usize,
    },
    /// Run transforms requested on standard input, one per line.
    TransformServe { directory: PathBuf },
    /// Write matched-filtered element samples and the points of some beams for peers.
    BeamsDump { directory: PathBuf },
    /// Form the fan as requested on standard input, one beamformer per line.
    BeamsServe,
}

fn echo(selection: &whole::Selection) -> Result<(), String> {
    let mut report = Report::new();
    if matches!(selection.only.as_deref(), None | Some("forward-looking")) {
        forward_looking::run(&selection.threads, &mut report)?;
    }
    whole::run(selection, &mut report)?;
    report.finish(selection.common.json.as_deref())
}

pub(crate) fn run(given: Arguments) -> Result<(), Box<dyn std::error::Error>> {
    let done = match given.what {
        BenchCommand::Echo(selection) => echo(&selection),
        BenchCommand::Beams { common } => beams::run(common.quick, common.json.as_deref()),
        BenchCommand::BeamsDump { directory } => beams::dump(&directory),
        BenchCommand::BeamsServe => beams::serve(),
        BenchCommand::Ping { common, config } => {
            ping::run(&config, common.quick, common.json.as_deref())
        }
        BenchCommand::Rates(selection) => rates::run(&selection),
        BenchCommand::Nav {
            common,
            log,
            python,
        } => nav::run(
            &log,
            python.as_deref(),
            common.quick,
            common.json.as_deref(),
        ),
        BenchCommand::Wire { common } => wire::run(common.quick, common.json.as_deref()),
        BenchCommand::TransformDump {
            directory,
            scatterers,
            elements,
            element,
        } => transform::dump(&directory, scatterers, elements, element),
        BenchCommand::TransformServe { directory } => transform::serve(&directory),
    };
    Ok(done?)
}
