//! `echotank score`: compares a device's fault report with the log of injected faults.

use std::path::{Path, PathBuf};

use clap::Args;

use super::Failure;
use echotank_runtime::io::sonar::verification::report::Report;
use echotank_runtime::io::text_of;
use echotank_runtime::score::{Score, log_of, score};

#[derive(Args, Clone, Debug)]
pub(crate) struct ScoreArgs {
    /// The daemon's log, faults-TIME.jsonl
    pub(crate) log: PathBuf,
    /// Report of a device or of `echotank listen --verify --report`: JSON lines, e.g. {"kind": "lost", "ping_number": 17, "record_type": 7038}.
    /// Kinds: lost, duplicate, late, damaged, different, reset, silent, or the kind of a fault. A header line has the keys report, line (7k, jsf,
    /// wbms, ping, imagenex872, vita49, elements), sonar, covers (record types), detects (kinds of faults), first_ping and last_ping
    pub(crate) report: PathBuf,
    /// Only faults of this sonar
    #[arg(long)]
    pub(crate) sonar: Option<String>,
    /// Print JSON
    #[arg(long)]
    pub(crate) json: bool,
}

fn read(path: &Path) -> Result<String, Failure> {
    text_of(path).map_err(|why| Failure::Configuration(format!("{}: {why}", path.display())))
}

pub(crate) fn main(args: &ScoreArgs) -> Result<(), Failure> {
    let log = log_of(&read(&args.log)?).map_err(|(line, why)| {
        Failure::Configuration(format!("{}: line {line}: {why}", args.log.display()))
    })?;
    let mut report = Report::parse(&read(&args.report)?)
        .map_err(|why| Failure::Configuration(format!("{}: {why}", args.report.display())))?;
    if args.sonar.is_some() {
        report.head.sonar = args.sonar.clone();
    }
    let score = score(&log, &report);
    if args.json {
        println!("{}", serde_json::json!(score));
    } else {
        print(&score);
    }
    match score.is_clean() {
        true => Ok(()),
        false => Err(Failure::Running(format!(
            "{} missed, {} false alarms",
            score.missed.len(),
            score.false_alarms.len()
        ))),
    }
}

/// Maximum number of printed entries of each list.
const MAX_LINES: usize = 20;

fn print(score: &Score) {
    println!(
        "{:<20} {:>8} {:>8} {:>8} {:>8} {:>8} {:>12} {:>8}",
        "", "injected", "found", "by count", "masked", "missed", "undetectable", "others"
    );
    for (kind, tally) in &score.kinds {
        println!(
            "{kind:<20} {:>8} {:>8} {:>8} {:>8} {:>8} {:>12} {:>8}",
            tally.injected,
            tally.found,
            tally.found_by_count,
            tally.masked,
            tally.missed,
            tally.undetectable,
            tally.not_covered
        );
    }
    println!(
        "{} further findings are consequences of these",
        score.consequences
    );
    for missed in score.missed.iter().take(MAX_LINES) {
        println!("missed: {missed}");
    }
    for finding in score.false_alarms.iter().take(MAX_LINES) {
        println!("false alarm: {}", serde_json::json!(finding));
    }
}
