//! `echotank recover`: recovers truncated recordings.

use std::path::PathBuf;

use clap::Args;

use super::Failure;
use echotank_runtime::io::record::recover::recover;

#[derive(Args, Clone, Debug)]
pub(crate) struct RecoverArgs {
    /// .s7k, .jsf, .xtf, .svlog, .wav, .mcap, .jsonl, .sigmf-meta; modified in place
    #[arg(required = true)]
    pub(crate) files: Vec<PathBuf>,
}

pub(crate) fn main(args: &RecoverArgs) -> Result<(), Failure> {
    let mut failed = Vec::new();
    for file in &args.files {
        match recover(file) {
            Ok(outcome) => println!("{} {outcome}", file.display()),
            Err(error) => failed.push(error.to_string()),
        }
    }
    match failed.as_slice() {
        [] => Ok(()),
        some => Err(Failure::Running(some.join("\n"))),
    }
}
