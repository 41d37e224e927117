//! Commands of the developers: measurements of errors and run times, maps of failures, and figures. Each has a script in
//! `tools/`.

mod accuracy;
mod bench;
mod draw;
mod machine;
mod paper;
mod picture;
mod reference;
mod report;
#[cfg(test)]
mod tests;
mod wiredump;

use std::path::Path;
use std::process::ExitCode;

use clap::Parser;

#[derive(Parser)]
#[command(
    name = "tools",
    bin_name = "tools",
    about = "Commands for developers of Echotank"
)]
enum Tool {
    #[command(subcommand)]
    Accuracy(accuracy::Question),
    Bench(bench::Arguments),
    Paper(paper::Arguments),
    Wiredump(wiredump::Arguments),
}

/// Root folder of the repository.
pub(crate) fn repository() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .parent()
        .expect("tools/ is in the repository")
}

fn main() -> ExitCode {
    let done = match Tool::parse() {
        Tool::Accuracy(question) => accuracy::run(question),
        Tool::Bench(given) => bench::run(given),
        Tool::Paper(given) => paper::run(given),
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
