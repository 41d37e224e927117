//! `echotank check`: is a configuration right, and what follows from it.

use std::path::PathBuf;

use clap::Args;

use super::{Failure, load};
use crate::config;
use crate::run::pipeline::engine_card;

#[derive(Args, Clone, Debug)]
pub struct CheckArgs {
    /// Configuration file (TOML)
    #[arg(required_unless_present_any = ["template", "schema"])]
    pub config: Option<PathBuf>,
    /// Change a value before checking (see `run --help`)
    #[arg(long = "set", value_name = "KEY=VALUE")]
    pub set: Vec<String>,
    /// Print a commented configuration with every key to start from
    #[arg(long)]
    pub template: bool,
    /// Print the JSON Schema of a configuration
    #[arg(long, conflicts_with = "template")]
    pub schema: bool,
}

pub fn main(args: &CheckArgs) -> Result<(), Failure> {
    if args.template {
        print!("{}", config::template());
    } else if args.schema {
        println!("{}", config::schema());
    } else if let Some(path) = &args.config {
        let spec = load(path, &args.set)?;
        print!("{}", config::summary(&spec));
        for sonar in &spec.sonars {
            let refuse = |why| {
                Failure::Configuration(format!("{}: sonar {}: {why}", path.display(), sonar.name))
            };
            if let Some(card) = engine_card(sonar, &spec.medium).map_err(refuse)? {
                println!(
                    "engine       {}: {} within {:.1e}, {:.2} ms per element on one core ({})",
                    sonar.name, card.name, card.error, card.cost_ms, card.why
                );
            }
        }
        println!("{}: ok", path.display());
    }
    Ok(())
}
