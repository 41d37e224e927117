//! Measures the echo engine: errors and run times, one line each. See `tools/bench --help`.

mod beams;
mod echo;
mod forward_looking;
pub(crate) mod machine;
mod nav;
mod ping;
mod report;
pub(crate) mod scene;
mod stages;
mod transform;
mod whole;
mod wire;

use std::path::PathBuf;

use clap::{Args, Subcommand};

use report::Report;

#[derive(Args)]
#[command(about = "Measure errors and run times of the emulator's parts")]
pub(crate) struct Arguments {
    #[command(subcommand)]
    what: What,
}

#[derive(Args)]
struct Common {
    /// Fewer scenes and runs; takes less than a minute on an idle machine.
    #[arg(long)]
    quick: bool,
    /// Also write the table as JSON.
    #[arg(long)]
    json: Option<PathBuf>,
}

#[derive(Subcommand)]
enum What {
    /// Synthesis methods: the sum alone, whole pings, a forward-looking ping.
    Echo {
        #[command(flatten)]
        common: Common,
        /// Only whole pings whose name, elements, scatterers, sector, velocity and tolerance contain this ("line 256 1000000 15 5 0.3").
        /// Default: all, and the other tables.
        #[arg(long)]
        only: Option<String>,
        /// Only this method for whole pings: direct, spectral, gridded-1d, gridded-2d.
        #[arg(long)]
        method: Option<String>,
        /// SIMD level: best, portable, avx2, avx512.
        #[arg(long, value_delimiter = ',', default_value = "best")]
        simd_levels: Vec<String>,
        #[arg(long, value_delimiter = ',', default_values_t = [1, 2])]
        threads: Vec<usize>,
        /// Print the time of gridded-2d stage by stage.
        #[arg(long)]
        stages: bool,
    },
    /// Fans of 128 elements, 256 beams and 8000 samples with every beamformer, and focused beams concurrent with echo synthesis.
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
    /// Records per second of each protocol family, and the load of several topsides.
    Wire {
        #[command(flatten)]
        common: Common,
        /// Deliver in real time for this many seconds.
        #[arg(long)]
        load: Option<u32>,
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

fn echo(common: &Common, selection: &whole::Selection) -> Result<(), String> {
    let mut report = Report::new();
    let only = (!selection.only.is_empty()).then_some(selection.only);
    if only.is_none() {
        echo::run(common.quick, &mut report);
    }
    if only.is_none() || only == Some("forward-looking") {
        forward_looking::run(selection.threads, &mut report)?;
    }
    whole::run(selection, &mut report)?;
    report.keep(common.json.as_deref())
}

pub(crate) fn run(given: Arguments) -> Result<(), Box<dyn std::error::Error>> {
    let done = match given.what {
        What::Echo {
            common,
            only,
            method,
            simd_levels,
            threads,
            stages,
        } => {
            let selection = whole::Selection {
                only: only.as_deref().unwrap_or(""),
                method: method.as_deref(),
                simd_levels: &simd_levels,
                threads: &threads,
                stages,
                effort: if common.quick {
                    whole::QUICK
                } else {
                    whole::FULL
                },
            };
            echo(&common, &selection)
        }
        What::Beams { common } => beams::run(common.quick, common.json.as_deref()),
        What::BeamsDump { directory } => beams::dump(&directory),
        What::BeamsServe => beams::serve(),
        What::Ping { common, config } => ping::run(&config, common.quick, common.json.as_deref()),
        What::Nav {
            common,
            log,
            python,
        } => nav::run(
            &log,
            python.as_deref(),
            common.quick,
            common.json.as_deref(),
        ),
        What::Wire { common, load } => wire::run(common.quick, load, common.json.as_deref()),
        What::TransformDump {
            directory,
            scatterers,
            elements,
            element,
        } => transform::dump(&directory, scatterers, elements, element),
        What::TransformServe { directory } => transform::serve(&directory),
    };
    Ok(done?)
}
