//! Measures the echo engine: errors and milliseconds on one line. See `tools/bench --help`.

#[path = "bench/echo.rs"]
mod echo;
#[path = "bench/machine.rs"]
mod machine;
#[path = "bench/scene.rs"]
mod scene;
#[path = "bench/transform.rs"]
mod transform;

use std::path::PathBuf;

use clap::{Parser, Subcommand};

#[derive(Parser)]
#[command(about = "Error and time of the echo engine's methods")]
struct Arguments {
    #[command(subcommand)]
    what: What,
}

#[derive(Subcommand)]
enum What {
    /// Synthesis methods on the paper-like ping and on a dense one.
    Echo {
        /// The small scene only, fewer runs.
        #[arg(long)]
        quick: bool,
        /// Write the table as JSON too.
        #[arg(long)]
        json: Option<PathBuf>,
    },
    /// Write points and their direct sum for `transform-serve` and for peers.
    TransformDump {
        directory: PathBuf,
        #[arg(long, default_value_t = 1_000_000)]
        scatterers: usize,
    },
    /// Run transforms as standard input asks, one per line.
    TransformServe { directory: PathBuf },
}

fn main() -> std::process::ExitCode {
    let done = match Arguments::parse().what {
        What::Echo { quick, json } => echo::run(quick, json.as_deref()),
        What::TransformDump {
            directory,
            scatterers,
        } => transform::dump(&directory, scatterers),
        What::TransformServe { directory } => transform::serve(&directory),
    };
    match done {
        Ok(()) => std::process::ExitCode::SUCCESS,
        Err(message) => {
            eprintln!("{message}");
            std::process::ExitCode::FAILURE
        }
    }
}
