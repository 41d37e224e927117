//! Diagnostics on standard error, for people, for the systemd journal or as JSON.
//!
//! The environment variable `RUST_LOG` selects levels and crates with the syntax of `tracing_subscriber::filter::Targets`.

use std::fs::File;
use std::io::{self, IsTerminal, Write};
use std::os::fd::AsFd;
use std::os::unix::fs::MetadataExt;

use clap::ValueEnum;
use tracing_subscriber::filter::Targets;
use tracing_subscriber::{Layer, fmt, prelude::*};

use super::Failure;

/// Default levels: information from the crates of this program, warnings from its dependencies.
const DEFAULT_FILTER: &str = "warn,echotank=info";

/// Format of the diagnostics on standard error.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub(crate) enum LogFormat {
    /// One line per event
    #[default]
    Text,
    /// One JSON object per line
    Json,
}

/// Installs the `tracing` subscriber of the program.
pub(crate) fn start(format: LogFormat) -> Result<(), Failure> {
    let filter = filter(std::env::var("RUST_LOG").ok().as_deref())?;
    let is_journal = is_journal(std::env::var("JOURNAL_STREAM").ok().as_deref());
    let is_colored = !is_journal
        && io::stderr().is_terminal()
        && std::env::var_os("NO_COLOR").is_none_or(|value| value.is_empty());
    let layer = fmt::layer().with_writer(io::stderr).with_ansi(is_colored);
    // Diagnostics are dropped if standard error is closed; the program must not panic.
    let layer = layer.log_internal_errors(false);
    let layer = match (format, is_journal) {
        (LogFormat::Text, false) => layer.boxed(),
        (LogFormat::Text, true) => layer.without_time().boxed(),
        (LogFormat::Json, false) => layer.json().flatten_event(true).boxed(),
        (LogFormat::Json, true) => layer.json().flatten_event(true).without_time().boxed(),
    };
    tracing_subscriber::registry()
        .with(layer)
        .with(filter)
        .init();
    Ok(())
}

/// Reports the failure of a command as plain text, or as an event if standard error holds JSON.
pub(crate) fn report_failure(format: LogFormat, text: &str) {
    match format {
        // If RUST_LOG is invalid, no subscriber is installed.
        LogFormat::Json if tracing::dispatcher::has_been_set() => tracing::error!("{text}"),
        _ => drop(writeln!(io::stderr(), "{text}")),
    }
}

fn filter(rust_log: Option<&str>) -> Result<Targets, Failure> {
    let text = rust_log
        .filter(|text| !text.trim().is_empty())
        .unwrap_or(DEFAULT_FILTER);
    text.parse().map_err(|why: tracing_subscriber::filter::ParseError| {
        Failure::Configuration(format!(
            "RUST_LOG = {text:?}: {why}; expected directives such as info or echotank_runtime=debug"
        ))
    })
}

/// Whether standard error is the socket of the journal. systemd gives its device and inode in `JOURNAL_STREAM` (systemd.exec(5)).
fn is_journal(journal_stream: Option<&str>) -> bool {
    let Some((device, inode)) = journal_stream.and_then(|stream| stream.split_once(':')) else {
        return false;
    };
    let stderr = io::stderr().as_fd().try_clone_to_owned().map(File::from);
    stderr
        .and_then(|file| file.metadata())
        .is_ok_and(|found| device.parse() == Ok(found.dev()) && inode.parse() == Ok(found.ino()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_the_stream_that_systemd_names_is_the_journal() {
        let stderr = File::from(io::stderr().as_fd().try_clone_to_owned().unwrap());
        let found = stderr.metadata().unwrap();
        let named = |inode: u64| format!("{}:{inode}", found.dev());
        assert!(is_journal(Some(&named(found.ino()))));
        assert!(!is_journal(Some(&named(found.ino() + 1))));
        assert!(!is_journal(Some("journal")));
        assert!(!is_journal(None));
    }

    #[test]
    fn an_invalid_filter_is_refused() {
        assert!(filter(None).is_ok());
        assert!(filter(Some("")).is_ok());
        assert!(filter(Some("off")).is_ok());
        assert!(filter(Some("echotank_runtime=loud")).is_err());
    }
}
