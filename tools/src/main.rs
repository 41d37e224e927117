//! The developers' commands: measurements of errors and run times, maps of failures, figures. Each has a script in `tools/`.

mod atlas;
mod bench;
mod draw;
mod errors;
mod ladder;
mod paper;
mod rigs;
mod soundings;
mod survey;
mod sweep;
#[cfg(test)]
mod tests;
mod wiredump;

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::Parser;

#[derive(Parser)]
#[command(
    name = "tools",
    bin_name = "tools",
    about = "Commands for developers of Echotank"
)]
enum Tool {
    Atlas(atlas::Arguments),
    Bench(bench::Arguments),
    Errors(errors::Arguments),
    Ladder(ladder::Arguments),
    Paper(paper::Arguments),
    Rigs(rigs::Arguments),
    Soundings(soundings::Arguments),
    Survey(survey::Arguments),
    Sweep(sweep::Arguments),
    Wiredump(wiredump::Arguments),
}

/// The root of the repository.
pub(crate) fn repository() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .parent()
        .expect("tools/ is in the repository")
}

/// A table of results that the repository keeps and that tests compare with.
pub(crate) fn kept(name: &str) -> PathBuf {
    repository().join("tools/kept").join(name)
}

fn main() -> ExitCode {
    let done = match Tool::parse() {
        Tool::Atlas(given) => atlas::run(given),
        Tool::Bench(given) => bench::run(given),
        Tool::Errors(given) => errors::run(given),
        Tool::Ladder(given) => ladder::run(given),
        Tool::Paper(given) => paper::run(given),
        Tool::Rigs(given) => rigs::run(given),
        Tool::Soundings(given) => soundings::run(given),
        Tool::Survey(given) => survey::run(given),
        Tool::Sweep(given) => sweep::run(given),
        Tool::Wiredump(given) => wiredump::run(given),
    };
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("{error}");
            ExitCode::FAILURE
        }
    }
}
