//! Command line: one file per subcommand.
//!
//! Exit status: 0 success, 1 failure while running or a rig that runs otherwise than meant, 2 wrong configuration or arguments.

mod arguments;
pub(crate) mod campaign;
pub(crate) mod chart;
pub(crate) mod check;
pub(crate) mod ctl;
pub(crate) mod doctor;
pub(crate) mod generate;
pub(crate) mod listen;
pub(crate) mod logging;
pub(crate) mod mosaic;
pub(crate) mod nav;
pub(crate) mod new;
pub(crate) mod recover;
pub(crate) mod replay;
pub(crate) mod run;
pub(crate) mod scene;
pub(crate) mod score;

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::builder::{PossibleValuesParser, TypedValueParser};
use clap::{Args, CommandFactory, Parser, Subcommand};

use self::logging::LogFormat;
use echotank_config::spec::{NamedChoice, RigSpec};
use echotank_runtime::io::nav::NavOpenError;
use echotank_runtime::rig::OpenError;

/// Feed a real sonar topside, DSP or acquisition board as though it were in the water.
///
/// Navigation comes in from a recorded log, UDP, TCP or a serial port. An echo model runs at the ping rate over a virtual seabed. Element
/// samples, beams and side-scan lines go out in the binary protocols of real sonars: Teledyne RESON 7k, EdgeTech JSF, NORBIT WBMS,
/// Cerulean Ping, Imagenex 872, VITA 49.2 and a plain element stream. Recordings are .s7k, JSF, XTF, SVLOG, SigMF, WAV and MCAP files.
///
/// Without a subcommand: `run` with the quickstart configuration.
#[derive(Parser)]
#[command(name = "echotank", version, max_term_width = 120)]
struct Cli {
    /// How diagnostics are written to standard error; RUST_LOG selects their levels
    #[arg(
        long = "log",
        id = "log-format",
        global = true,
        value_name = "FORMAT",
        value_enum,
        default_value_t
    )]
    log: LogFormat,
    #[command(subcommand)]
    command: Option<Command>,
}

#[derive(Subcommand)]
enum Command {
    /// Write a rig for a kind of sonar, a frequency, a range and a protocol
    New(new::NewArgs),
    /// Run the daemon: navigation in, pings in real time, sonar protocols out, until stopped
    Run(run::RunArgs),
    /// The same pipeline offline, without pacing: writes files, reproducible byte for byte
    Replay(replay::ReplayArgs),
    /// Many replays of one rig, in shards that a scheduler computes
    Campaign(campaign::CampaignArgs),
    /// Measure every method on this scene and machine: error against run time, as plots, a page and tables
    Chart(chart::ChartArgs),
    /// Check a configuration; print derived values, cost estimates and the selected methods
    Check(check::CheckArgs),
    /// Control a running daemon (pause, step, change settings) or query its status
    Ctl(ctl::CtlArgs),
    /// Check whether this machine can run the daemon on time and without packet loss
    Doctor(doctor::DoctorArgs),
    /// A minimal topside: connect to a 7k server, subscribe and print records; or verify any protocol's stream
    Listen(listen::ListenArgs),
    /// Compare a device's fault report with the log of injected faults: found, missed, false alarms
    Score(score::ScoreArgs),
    /// Recover truncated recordings; `run` does this for those in its folder
    Recover(recover::RecoverArgs),
    /// Write a recording's side-scan lines as a georeferenced image (GeoTIFF and PNG)
    Mosaic(mosaic::MosaicArgs),
    /// Report what a recorded navigation log holds, what is used, and why the rest is not
    Nav(nav::NavArgs),
    /// Inspect seabeds and 3-D models
    Scene(scene::SceneArgs),
    /// Write manual pages or a shell's completion script
    Generate(generate::GenerateArgs),
}

/// A configuration file and its overrides from the command line.
#[derive(Args, Clone, Debug)]
pub(crate) struct ConfigArgs {
    /// Configuration file (TOML); `echotank check --template` prints one to start from
    pub(crate) config: PathBuf,
    /// Change a value before checking, e.g. --set 'sonar.model.synthesis="reference"' (every [[sonar]]) or --set sonar.0.ping.range_m=75
    #[arg(long = "set", value_name = "KEY=VALUE")]
    pub(crate) set: Vec<String>,
}

/// Parser for the words of a configuration choice.
pub(crate) fn choice<T: NamedChoice + Send + Sync>() -> impl TypedValueParser<Value = T> {
    PossibleValuesParser::new(T::WORDS.iter().map(|(_, word)| *word))
        .map(|word| T::from_word(&word).expect("one of the words"))
}

pub(crate) fn main() -> ExitCode {
    let cli = Cli::try_parse().unwrap_or_else(|error| arguments::exit(error));
    if !matches!(cli.command, None | Some(Command::Run(_))) {
        restore_sigpipe();
    }
    let done = logging::start(cli.log).and_then(|()| execute(cli.command));
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(Failure::Findings) => ExitCode::FAILURE,
        Err(Failure::Configuration(text)) => {
            logging::report_failure(cli.log, &text);
            ExitCode::from(2)
        }
        Err(Failure::Running(text)) => {
            logging::report_failure(cli.log, &format!("echotank: {text}"));
            ExitCode::FAILURE
        }
    }
}

fn execute(command: Option<Command>) -> Result<(), Failure> {
    match command.unwrap_or_else(|| Command::Run(run::RunArgs::default())) {
        Command::New(args) => new::main(&args),
        Command::Run(args) => run::main(&args),
        Command::Recover(args) => recover::main(&args),
        Command::Replay(args) => replay::main(&args),
        Command::Campaign(args) => campaign::main(&args),
        Command::Chart(args) => chart::main(&args),
        Command::Check(args) => check::main(&args),
        Command::Ctl(args) => ctl::main(&args),
        Command::Doctor(args) => doctor::main(&args),
        Command::Listen(args) => listen::main(&args),
        Command::Score(args) => score::main(&args),
        Command::Mosaic(args) => mosaic::main(&args),
        Command::Nav(args) => nav::main(&args),
        Command::Scene(args) => scene::main(&args),
        Command::Generate(args) => generate::main(&args, Cli::command()),
    }
}

/// Restores the default SIGPIPE action, so that `echotank check rig.toml | head` ends quietly. Sockets report a closed peer as an error with either
/// action.
fn restore_sigpipe() {
    #[cfg(unix)]
    // SAFETY: SIG_DFL installs no handler, so no Rust code runs in a signal context.
    unsafe {
        libc::signal(libc::SIGPIPE, libc::SIG_DFL);
    }
}

/// Reason why a command failed.
#[derive(Debug)]
pub(crate) enum Failure {
    /// Wrong configuration or arguments, one problem per line. Exit status 2.
    Configuration(String),
    /// Failure of a file, device, network or computation. Exit status 1.
    Running(String),
    /// The output of `check` has findings. Exit status 1.
    Findings,
}

impl Failure {
    pub(crate) fn running(error: impl std::fmt::Display) -> Self {
        Self::Running(error.to_string())
    }

    /// Classifies the failure to open a rig. An unsupported format of a navigation file, or a missing quantity, counts as a wrong configuration.
    pub(crate) fn opening(error: &OpenError) -> Self {
        let text = error.to_string();
        match error {
            OpenError::Nav(
                NavOpenError::Unreadable { .. }
                | NavOpenError::NothingUsable { .. }
                | NavOpenError::Recording(_)
                | NavOpenError::Missing(_),
            ) => Self::Configuration(text),
            _ => Self::Running(text),
        }
    }
}

/// Reads a configuration, applies `--set` overrides and checks it.
pub(crate) fn load(path: &Path, set: &[String]) -> Result<RigSpec, Failure> {
    echotank_runtime::config_files::load_with(path, set)
        .map_err(|error| Failure::Configuration(error.to_string()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn command_line_is_well_formed() {
        Cli::command().debug_assert();
    }
}
