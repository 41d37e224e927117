//! The command line: one file per subcommand.
//!
//! Exit status: 0 done, 1 something failed while running, 2 the configuration or the arguments are wrong.

pub(crate) mod chart;
pub(crate) mod check;
pub(crate) mod ctl;
pub(crate) mod doctor;
pub(crate) mod listen;
pub(crate) mod logging;
pub(crate) mod mosaic;
pub(crate) mod nav;
pub(crate) mod recover;
pub(crate) mod replay;
pub(crate) mod run;
pub(crate) mod scene;
pub(crate) mod score;

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::builder::{PossibleValuesParser, TypedValueParser};
use clap::{Args, Parser, Subcommand};

use self::logging::LogFormat;
use echotank_config::spec::{RigSpec, Words};

/// Feed a real sonar topside, DSP or acquisition board as though it were in the water.
///
/// Navigation comes in from a recorded log, UDP or a serial port. An echo model runs at the ping rate over a virtual seabed. Element
/// samples, beams and side-scan lines go out in the binary protocols of real sonars, such as Teledyne RESON 7k.
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
    /// Run the daemon: navigation in, pings in real time, sonar protocols out, until stopped
    Run(run::RunArgs),
    /// The same pipeline offline, without pacing: writes files, reproducible byte for byte
    Replay(replay::ReplayArgs),
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

/// Reads one of the words that a configuration has for a choice.
pub(crate) fn choice<T: Words + Send + Sync>() -> impl TypedValueParser<Value = T> {
    PossibleValuesParser::new(T::WORDS.iter().map(|(_, word)| *word))
        .map(|word| T::from_word(&word).expect("one of the words"))
}

pub(crate) fn main() -> ExitCode {
    let cli = Cli::parse();
    if !matches!(cli.command, None | Some(Command::Run(_))) {
        restore_sigpipe();
    }
    let done = logging::start(cli.log).and_then(|()| execute(cli.command));
    match done {
        Ok(()) => ExitCode::SUCCESS,
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
        Command::Run(args) => run::main(&args),
        Command::Recover(args) => recover::main(&args),
        Command::Replay(args) => replay::main(&args),
        Command::Chart(args) => chart::main(&args),
        Command::Check(args) => check::main(&args),
        Command::Ctl(args) => ctl::main(&args),
        Command::Doctor(args) => doctor::main(&args),
        Command::Listen(args) => listen::main(&args),
        Command::Score(args) => score::main(&args),
        Command::Mosaic(args) => mosaic::main(&args),
        Command::Nav(args) => nav::main(&args),
        Command::Scene(args) => scene::main(&args),
    }
}

/// Restores the default SIGPIPE action, so that `echotank check rig.toml | head` ends quietly. Sockets report a closed peer as an error in
/// either case.
fn restore_sigpipe() {
    #[cfg(unix)]
    // SAFETY: SIG_DFL installs no handler, so no Rust code runs in a signal context.
    unsafe {
        libc::signal(libc::SIGPIPE, libc::SIG_DFL);
    }
}

/// Why a command ended without success.
#[derive(Debug)]
pub(crate) enum Failure {
    /// Wrong configuration or arguments: every problem, one per line. Exit status 2.
    Configuration(String),
    /// Failure of a file, device, network or computation. Exit status 1.
    Running(String),
}

impl Failure {
    pub(crate) fn running(error: impl std::fmt::Display) -> Self {
        Self::Running(error.to_string())
    }
}

/// Reads a configuration, applies `--set` overrides and checks it.
pub(crate) fn load(path: &Path, set: &[String]) -> Result<RigSpec, Failure> {
    let refuse = |text: String| Failure::Configuration(text);
    if set.is_empty() {
        return echotank_runtime::config_files::load(path).map_err(|e| refuse(e.to_string()));
    }
    let text = echotank_runtime::config_files::read_text(path)
        .map_err(|why| refuse(format!("{}: {why}", path.display())))?;
    let mut table: toml::Table = text
        .parse()
        .map_err(|e| refuse(format!("{}: {e}", path.display())))?;
    for change in set {
        apply(&mut table, change).map_err(|why| refuse(format!("--set {change}: {why}")))?;
    }
    let text = toml::to_string(&table).map_err(|e| refuse(e.to_string()))?;
    let folder = path.parent().unwrap_or(Path::new("."));
    echotank_runtime::config_files::parse(&text, folder)
        .map_err(|e| refuse(format!("{} (with --set)\n{e}", path.display())))
}

/// Applies `a.b.c=VALUE`. In an array of tables every entry is changed, or only the one whose index the key gives; absent tables are created.
fn apply(table: &mut toml::Table, change: &str) -> Result<(), String> {
    let (key, value) = change.split_once('=').ok_or("expected KEY=VALUE")?;
    let value = parse_value(value.trim());
    let path: Vec<&str> = key.trim().split('.').collect();
    if path.iter().any(|part| part.is_empty()) {
        return Err("the key has an empty part".into());
    }
    set_in(table, &path, &value)
}

/// Parses a TOML value; other text becomes a string, so that simple words need no quotes.
fn parse_value(text: &str) -> toml::Value {
    match format!("v = {text}").parse::<toml::Table>() {
        Ok(mut table) => table
            .remove("v")
            .unwrap_or_else(|| toml::Value::String(text.into())),
        Err(_) => toml::Value::String(text.into()),
    }
}

fn set_in(table: &mut toml::Table, path: &[&str], value: &toml::Value) -> Result<(), String> {
    let (first, rest) = path.split_first().ok_or("empty key")?;
    if rest.is_empty() {
        table.insert((*first).to_string(), value.clone());
        return Ok(());
    }
    let next = table
        .entry((*first).to_string())
        .or_insert_with(|| toml::Value::Table(toml::Table::new()));
    match next {
        toml::Value::Table(inner) => set_in(inner, rest, value),
        toml::Value::Array(entries) => {
            let (one, below) = match rest[0].parse::<usize>() {
                Ok(index) => (Some(index), &rest[1..]),
                Err(_) => (None, rest),
            };
            if one.is_some_and(|index| index >= entries.len()) {
                return Err(format!("{first} has {} entries", entries.len()));
            }
            for (index, entry) in entries.iter_mut().enumerate() {
                if one.is_none_or(|wanted| wanted == index) {
                    let inner = entry
                        .as_table_mut()
                        .ok_or_else(|| format!("{first} is not a list of tables"))?;
                    set_in(inner, below, value)?;
                }
            }
            Ok(())
        }
        _ => Err(format!("{first} is a value, not a table")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn set_changes_every_sonar_or_the_indexed_one() {
        let mut table: toml::Table = "[[sonar]]\nname = 'a'\n[[sonar]]\nname = 'b'\n"
            .parse()
            .unwrap();
        apply(&mut table, "sonar.ping.range_m=75").unwrap();
        apply(&mut table, "sonar.1.name=c").unwrap();
        let text = toml::to_string(&table).unwrap();
        assert_eq!(text.matches("range_m = 75").count(), 2, "{text}");
        assert!(
            text.contains("name = \"a\"") && text.contains("name = \"c\""),
            "{text}"
        );
        assert!(apply(&mut table, "sonar.7.name=c").is_err());
        assert!(apply(&mut table, "sonar").is_err());
        assert!(apply(&mut table, "sonar..name=1").is_err());
    }

    #[test]
    fn command_line_is_well_formed() {
        use clap::CommandFactory;
        Cli::command().debug_assert();
    }
}
