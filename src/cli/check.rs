//! `echotank check`: is a configuration right, and what follows from it.

use std::path::PathBuf;

use clap::Args;

use super::{Failure, load};
use crate::config;

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
        println!("{}: ok", path.display());
    }
    Ok(())
}
